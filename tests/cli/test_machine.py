"""The machine, started from the command line."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from collections.abc import Iterator

import pytest

from tests.cli.program import ACROBOT, ROOT, error_of, run
from tests.machine.robot import ELBOW, Listener, RobotScenario, state
from vtbdrake.lcm.hub import Hub
from vtbdrake.machine import DIED, Machine, MachineConfig

ROBOT = "tests.machine.robot:RobotScenario"
MASS = "sim.sys.Acrobot.lower_link.mass"


@pytest.fixture(scope="module")
def hub() -> Iterator[Hub]:
    with Hub(port=0) as running:
        yield running


def start(*arguments: object) -> subprocess.Popen[str]:
    command = [sys.executable, "-u", "-m", "vtbdrake.cli", "machine", ROBOT, *map(str, arguments)]
    return subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def test_machine_has_the_parameters_that_are_asked_for(hub: Hub) -> None:
    listener = Listener(hub.url)
    options = ("--set", f"{ELBOW}=0.3", "--perturb", 0.1, "--seed", 3, "--noise", "position=0.01")
    program = run("machine", ROBOT, "--url", hub.url, "--cycles", 20, *options, "--period", 0.002)
    assert program.exit_code == 0, program.stderr

    config = MachineConfig(values={ELBOW: 0.3}, perturb=0.1, seed=3, noise={"position": 0.01}, period=0.002)
    expected = Machine(RobotScenario(), config)
    assert f"{MASS} = {expected.perturbed[MASS]}" in program.stdout.splitlines()
    [(_, first)] = expected.messages()
    assert (state(listener.next()) == state(first)).all()
    assert "0.04 s simulated" in program.stdout


@pytest.mark.slow_cases
@pytest.mark.parametrize("ending", [signal.SIGINT, signal.SIGTERM])
def test_machine_runs_until_it_is_interrupted(hub: Hub, ending: signal.Signals) -> None:
    with start("--url", hub.url) as program:
        assert program.stdout is not None
        assert program.stdout.readline() == f"ready on {hub.url}\n"
        program.send_signal(ending)
        output, errors = program.communicate(timeout=60)
    assert (program.returncode, errors) == (0, "")
    assert "deadlines missed" in output


def test_machine_dies_on_request(hub: Hub) -> None:
    listener = Listener(hub.url)
    with start("--url", hub.url) as program:
        assert program.stdout is not None
        program.stdout.readline()
        listener.next()
        listener.publish("VTB_MACHINE", json.dumps({"request": "die"}).encode())
        program.communicate(timeout=60)
    assert program.returncode == DIED


@pytest.mark.parametrize(
    ("scenario", "options", "code", "message"),
    [
        (ACROBOT, (), 2, "AcrobotScenario has no protocol for its machine"),
        (ROBOT, ("--perturb", "2"), 2, "perturb must be a number from 0 to below 1, not 2.0"),
        (ROBOT, ("--lock-step", "--sense-latency", "3"), 2, "a machine has no sense_latency, unlike 0.003 s"),
        (ROBOT, ("--noise", "torque=1"), 2, "noise is added to vector sensor signals"),
        (ROBOT, ("--noise", "position=[1,2]"), 2, "one standard deviation"),
        (ROBOT, ("--set", "sim.sys.Acrobot.elbow.angle=1"), 2, "there is no variable"),
        (ROBOT, ("--field", "masss=1"), 2, "no field 'masss'"),
        (ROBOT, ("--brake", "hard"), 2, "'hard' is not one of"),
        (ROBOT, ("--url", "tcpq://127.0.0.1:1"), 1, "no LCM bus at tcpq://127.0.0.1:1"),
    ],
)
def test_bad_input_is_one_line(hub: Hub, scenario: str, options: tuple[str, ...], code: int, message: str) -> None:
    assert message in error_of("machine", scenario, "--url", hub.url, *options, code=code)
