"""What others ask a DPS that runs, from the command line."""

from __future__ import annotations

import json
from collections.abc import Iterator

import pytest
from click.testing import CliRunner

from tests.control.live.rig import PATIENCE, Rig, served
from vtbdrake.cli import main
from vtbdrake.control.hub import Hub


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
