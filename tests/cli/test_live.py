"""Tests of requests to a running DPS from the command line."""

from __future__ import annotations

import json
import os
import signal
from collections.abc import Iterator

import pytest
from click.testing import CliRunner

from tests.monitoring.live.rig import PATIENCE, Rig, served
from vtbdrake.cli import main
from vtbdrake.lcm.connections import TcpqConnection
from vtbdrake.lcm.hub import Hub


@pytest.fixture
def broken() -> Iterator[Rig]:
    """A DPS whose command is no number."""
    with Hub(port=0) as bus, served(bus.url) as (rig, _):
        rig.runtime.write({"dps.trouble": 2.0})
        rig.runtime.cycle()
        yield rig


def told(rig: Rig, *arguments: object) -> str:
    command = [*map(str, arguments), "--url", rig.url, "--timeout", str(PATIENCE)]
    result = rig.during(CliRunner().invoke, main, command, prog_name="vtbdrake")
    assert result.exit_code == 0, result.output
    return result.stdout


def refuse(constant: str) -> None:
    raise ValueError(f"{constant} is no JSON")


def test_what_is_no_number_is_null_in_a_line_of_json(broken: Rig) -> None:
    line = json.loads(told(broken, "watch", "dps.velocity", "--count", 1), parse_constant=refuse)
    assert line["dps.velocity"] == [None, 0.0]


def test_what_is_no_number_is_shown_as_it_is(broken: Rig) -> None:
    assert told(broken, "get", "dps.velocity") == "dps.velocity = [nan, 0.0]\n"


GET, WATCH = ("get", "dps.gain"), ("watch", "dps.gain")
COMMANDS = [GET, WATCH, ("set", "dps.gain=1"), ("reset",)]


def refused(url: str, *arguments: str) -> str:
    result = CliRunner().invoke(main, [*arguments, "--url", url, "--timeout", "0.3"], prog_name="vtbdrake")
    assert result.exit_code == 1, result.output
    assert result.stderr.startswith("Error: ") and result.stderr.count("\n") == 1
    return result.stderr


@pytest.mark.parametrize("command", COMMANDS)
def test_a_hub_that_is_full_is_one_line(command: tuple[str, ...]) -> None:
    with Hub(port=0, max_clients=1) as bus:
        other = TcpqConnection(bus.url, {"A": lambda *_: None}, PATIENCE)
        assert "rejects the connection: max_clients=1 reached" in refused(bus.url, *command)
        other.close()


@pytest.mark.parametrize("command", COMMANDS)
def test_a_hub_without_a_dps_is_one_line(command: tuple[str, ...]) -> None:
    with Hub(port=0) as bus:
        assert "does a DPS run there (vtbdrake run)?" in refused(bus.url, *command)


@pytest.mark.parametrize("command", [GET, WATCH])
def test_a_frozen_hub_is_one_line(command: tuple[str, ...]) -> None:
    with Hub(port=0) as bus:
        os.kill(bus.pid, signal.SIGSTOP)
        assert "it is frozen" in refused(bus.url, *command)
        os.kill(bus.pid, signal.SIGCONT)
