"""The command ``vtbdrake hub``."""

import contextlib
import os
import signal
import socket
import subprocess
import sys

import click
import lcm
import pytest

from tests.cli.program import ROOT, error_of
from vtbdrake.cli.hub import hub
from vtbdrake.lcm.hub import HubConfig, HubStatistics


@contextlib.contextmanager
def running(*arguments: object):
    """Run the program; yield it and the URL that it has printed."""
    command = [sys.executable, "-m", "vtbdrake.cli", "hub", *map(str, arguments)]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as program:
        try:
            assert program.stdout is not None
            yield program, program.stdout.readline().strip()
        finally:
            program.kill()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_hub_prints_its_url_and_ends_cleanly(number: signal.Signals) -> None:
    with running("--port", 0, "--protect", "COMMAND") as (program, url):
        first, second = lcm.LCM(url), lcm.LCM(url)
        received: list[bytes] = []
        first.subscribe("COMMAND", lambda _, data: received.append(data))
        first.publish("COMMAND", b"command")
        assert first.handle_timeout(30_000)
        second.publish("COMMAND", b"intruder")
        second.subscribe("OTHER", lambda _, data: received.append(data))
        second.publish("OTHER", b"handled")
        assert second.handle_timeout(30_000)
        program.send_signal(number)
        stdout, stderr = program.communicate(timeout=60)
    assert received == [b"command", b"handled"]
    assert program.returncode == 0
    assert stdout == "2 messages relayed, 1 rejected, 0 dropped for slow clients\n"
    assert "COMMAND: publication by" in stderr
    assert "Traceback" not in stderr


def test_port_in_use_is_an_error() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        error = error_of("hub", "--port", port)
    assert error.startswith(f"Error: the hub cannot listen on 127.0.0.1:{port} (Address already in use)")


def test_hub_runs_on_the_given_processors() -> None:
    cpu = max(os.sched_getaffinity(0))
    with running("--port", 0, "--cpu", cpu) as (program, url):
        bus = lcm.LCM(url)
        bus.subscribe("VTB_HUB", lambda *_: None)
        assert bus.handle_timeout(30_000)
        assert os.sched_getaffinity(program.pid) == {cpu}


def protected(url: str) -> set[str]:
    """Return the protected channels in the published status."""
    bus, found = lcm.LCM(url), []
    bus.subscribe("VTB_HUB", lambda _, data: found.append(set(HubStatistics.from_json(data).protected)))
    while not found:
        assert bus.handle_timeout(30_000)
    return found[0]


@pytest.mark.slow_cases
@pytest.mark.parametrize(
    ("arguments", "channels", "warns"),
    [
        ((), set(), True),
        (("tests.control.servo_machine:ServoMachineScenario",), {"IIWA_COMMAND"}, False),
        (("--protect", "A", "tests.control.servo_machine:ServoMachineScenario"), {"A", "IIWA_COMMAND"}, False),
        (("--protect", "A", "--unprotected", "tests.control.servo_machine:ServoMachineScenario"), {"A"}, False),
        (("--unprotected",), set(), False),
    ],
)
def test_default_protection(arguments: tuple[str, ...], channels: set[str], warns: bool) -> None:
    with running("--port", 0, *arguments) as (program, url):
        assert protected(url) == channels
        program.send_signal(signal.SIGINT)
        _, stderr = program.communicate(timeout=60)
    assert ("no channel of actuator commands is protected: give a SCENARIO" in stderr) == warns
    for channel in channels:
        assert channel in stderr


def test_hub_without_scenario_does_not_import_drake() -> None:
    code = "import sys, vtbdrake.cli.hub; print([name for name in sys.modules if 'pydrake' in name])"
    result = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert result.stdout == "[]\n"


def test_options_have_defaults_and_ranges_of_the_configuration() -> None:
    options = {option.name: option for option in hub.params if isinstance(option, click.Option)}
    config = HubConfig()
    for name in ("host", "port", "lease", "max_clients", "patience", "priority"):
        assert options[name].default == getattr(config, name)
    for name in ("max_message", "max_queue", "max_memory"):
        assert options[name].default * 2**20 == getattr(config, name)
    assert "(from 0 to 65535)" in str(options["port"].help)
    assert "(above 0 s)" in str(options["lease"].help)


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (("--port", 70000), "port must be a whole number from 0 to 65535, not 70000"),
        (("--port", 0, "--max-message", 64), "max_queue must be at least"),
        (("--port", 0, "--max-message", 0), "max_message must be a whole number from 1 to"),
        (("--port", 0, "--max-queue", "inf"), "'inf' is not a valid integer"),
        (("--port", 0, "--protect", "VTB_HUB"), "cannot protect 'VTB_HUB'"),
        (("--port", 0, "--lease", 0), "lease must be a finite number above 0 s"),
        (("--port", 0, "--user", "no such user"), "no user 'no such user'"),
        (("--port", 0, "--max-memory", 1), "max_memory must be at least max_queue"),
        (("--port", 0, "--max-clients", 0), "max_clients must be a whole number of at least 1"),
        (("--port", 0, "nowhere.at_all:Scenario"), "cannot import nowhere.at_all"),
        (("--port", 0, "tests.testbeds:PendulumScenario"), "has no protocol for its machine"),
        (("--port", 0, "--cpu", -1), "cpus[0] must be a whole number of at least 0"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(arguments: tuple[object, ...], named: str) -> None:
    assert named in error_of("hub", *arguments)
