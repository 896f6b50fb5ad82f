"""One Ctrl-C ends a command in every kind of state: real processes, interrupted as soon as they say where they are.

Commands share how they import and build a scenario: one of them shows it, or one of each kind of loop.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, suppress
from functools import cached_property
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.campaigns.test_campaign import STATED
from tests.cli.lasting import BUILDING, JUDGING, STEPPING, judge
from tests.cli.program import ANGLE, PENDULUM, ROOT
from tests.interruptions import hanging_fails
from tests.recording.servo import Servo
from tests.testbeds import PendulumScenario
from vtbdrake import Parameter, Problem, Quality
from vtbdrake.lcm.hub import Hub
from vtbdrake.recording.recorder import Recorder

# s. A command ends within 3 s on an idle computer; without the repair, what is tried here takes many minutes.
BOUND = 120.0

IMPORT, BUILD, STEP = (
    "tests.cli.lasting_import:Scenario",
    "tests.cli.lasting:BuildScenario",
    "tests.cli.lasting:StepScenario",
)
IMPORTING = "it is being imported"
SERVO = "tests.control.scripted:ServoScenario"
MACHINE = "tests.control.servo_machine:ServoMachineScenario"
STEP_MACHINE = "tests.cli.lasting:StepMachineScenario"
TRUST = ("--trust", "tests")
# States that no line tells: a client has connected to the hub; a C compiler has been started.
CONNECTED = "connected"
COMPILING = "compiling"
ONCE = ("--horizon", 0.3, "--sample-period", 0.1)
GRID = ("--vary", f"{ANGLE}=-1:1:50", "--quality", ANGLE, *ONCE)
SEARCH = ("--vary", f"{ANGLE}=-1:1", "--quality", ANGLE, *ONCE, "--solver", "sobol", "--rollouts", 100_000)
LIMIT = ("--vary", f"{ANGLE}=0:1", "--threshold", 0.5, "--resolution", 0.1, "--coarse", 0.1, "--quality", ANGLE, *ONCE)
SERIAL, THREADS = ("--executor", "serial"), ("--executor", "threads", "--workers", 2)
PROCESSES = ("--executor", "processes", "--workers", 2)
PAGE = "--no-browser"
URL = "/#"

slow = pytest.mark.slow


class Places:
    """Files for the commands, made when they are asked for: ``{name}`` in a word stands for the method."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._stack = folder, ExitStack()
        compiler = folder / "cc"
        compiler.write_text(f"#!/bin/sh\ntouch {folder / COMPILING}\nexec sleep 1000\n")
        compiler.chmod(0o700)
        self.environment = os.environ | {"CC": str(compiler)}

    def filled(self, word: object) -> str:
        text = str(word)
        for name in ("tmp", "log", "study", "campaign", "hub"):
            if f"{{{name}}}" in text:
                text = text.replace(f"{{{name}}}", str(getattr(self, f"_{name}")))
        return text

    def wait(self, state: str) -> None:
        with hanging_fails(state):
            while not (self._folder / state).exists() and (
                state != CONNECTED or self._hub_process.statistics().clients < 1
            ):
                time.sleep(0.02)

    def close(self) -> None:
        self._stack.close()

    @property
    def _tmp(self) -> Path:
        return self._folder

    @property
    def _log(self) -> Path:
        servo, path = Servo(), self._folder / "a.lcm"
        with Recorder(servo.runtime, path):
            servo.runtime.run(cycles=20)
        return path

    @property
    def _study(self) -> Path:
        problem = Problem(
            scenario=PendulumScenario(),
            parameters=[Parameter(ANGLE, -1.0, 1.0)],
            quality=Quality(judge, ANGLE),
            horizon=0.3,
            sample_period=0.1,
        )
        problem.study(self._folder / "made.db", solver="sobol").close()
        return self._folder / "made.db"

    @property
    def _campaign(self) -> Path:
        criteria = {"never": {"of": ANGLE, "f": "tests.cli.lasting:judge", "at_most": 1.0}}
        stated = {
            **STATED,
            "criteria": criteria,
            "seeds": {"count": 1, "draw": "tests.campaigns.campaign_functions:start"},
        }
        (self._folder / "a.yaml").write_text(yaml.safe_dump(stated, sort_keys=False))
        return self._folder / "a.yaml"

    @cached_property
    def _hub_process(self) -> Hub:
        return self._stack.enter_context(Hub(port=0))

    @property
    def _hub(self) -> str:
        return self._hub_process.url


@pytest.fixture
def places(tmp_path: Path) -> Iterator[Places]:
    with closing(Places(tmp_path)) as made:
        yield made


def case(name: str, *arguments: object, until: str, code: int = 1, number: int = signal.SIGINT, marks: Any = ()) -> Any:
    """Return a row: a command, the line that tells its state, a signal, and its exit code after that."""
    return pytest.param(arguments, until, number, code, id=name, marks=marks)


@pytest.mark.slow_cases
@pytest.mark.one_python
@pytest.mark.parametrize(
    ("arguments", "until", "number", "code"),
    [
        # A testbed is looked at.
        case("variables, importing", "variables", IMPORT, until=IMPORTING),
        case("rollout, building", "rollout", BUILD, *ONCE[:2], until=BUILDING, marks=slow),
        case("rollout, stepping", "rollout", STEP, *ONCE[:2], until=STEPPING, marks=slow),
        # Rollouts.
        case("sweep, serial", "sweep", STEP, *GRID, *SERIAL, until=STEPPING),
        case("sweep, processes", "sweep", STEP, *GRID, *PROCESSES, until=STEPPING, marks=slow),
        case("boundary, stepping", "boundary", STEP, *LIMIT, *SERIAL, until=STEPPING, marks=slow),
        case("study run, serial", "study", "run", "{tmp}/a.db", STEP, *SEARCH, *SERIAL, until=STEPPING),
        case("study run, threads", "study", "run", "{tmp}/a.db", STEP, *SEARCH, *THREADS, until=STEPPING, marks=slow),
        case("study continue", "study", "continue", "{study}", "--rollouts", 9, *TRUST, until=JUDGING, marks=slow),
        case("campaign, judging", "campaign", "{campaign}", until=JUDGING, marks=slow),
        # Pages.
        case("view, building", "view", BUILD, PAGE, until=BUILDING, marks=slow),
        case("view, serving", "view", PENDULUM, PAGE, until=URL, code=0, marks=slow),
        case("view, stepping", "view", STEP, PAGE, "--play", until=STEPPING, code=0),
        case("view, told to end", "view", STEP, PAGE, "--play", until=STEPPING, number=signal.SIGTERM, code=0),
        case("view, loop", "view", PENDULUM, PAGE, "--url", "{hub}", until=URL, code=0, marks=slow),
        case("view, log", "view", SERVO, PAGE, "--log", "{log}", until=URL, code=0, marks=slow),
        case("study open", "study", "open", "{study}", PAGE, *TRUST, until=URL, code=0, marks=slow),
        # Logs.
        case("doctor, compiling", "doctor", until=COMPILING, marks=slow),
        # A loop and its machine.
        case("hub", "hub", "--port", 0, until="tcpq", code=0),
        case("machine, importing", "machine", IMPORT, "--url", "{hub}", until=IMPORTING, marks=slow),
        case("machine, running", "machine", MACHINE, "--url", "{hub}", until="ready", code=0, marks=slow),
        case("machine, stepping", "machine", STEP_MACHINE, "--url", "{hub}", until=STEPPING),
        case("machine, told to end", "machine", STEP_MACHINE, "--url", "{hub}", until=STEPPING, number=signal.SIGTERM),
        case("run, waiting", "run", MACHINE, "--url", "{hub}", "--priority", 0, until="switch interval", code=0),
        case("watch, waiting", "watch", "--url", "{hub}", "a", "--timeout", 600, until=CONNECTED, code=0),
        case("get, waiting", "get", "--url", "{hub}", "a", "--timeout", 600, until=CONNECTED, marks=slow),
    ],
)
def test_one_ctrl_c_ends_a_command(
    arguments: tuple[object, ...], until: str, number: int, code: int, places: Places
) -> None:
    words = [places.filled(word) for word in arguments]
    command = [sys.executable, "-u", "-m", "vtbdrake.cli", *words]
    with subprocess.Popen(
        command,
        cwd=ROOT,
        env=places.environment,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        start_new_session=True,
    ) as process:
        killer = threading.Timer(BOUND, process.kill)  # Its state does not come.
        killer.start()
        try:
            assert process.stdout is not None
            seen = ""
            if until in (CONNECTED, COMPILING):
                places.wait(until)
            else:
                while until not in seen:
                    line = process.stdout.readline()
                    assert line, f"it has ended before: {seen}"
                    seen += line
            killer.cancel()
            os.killpg(process.pid, number)  # As a terminal does.
            output, _ = process.communicate(timeout=BOUND)
        finally:
            killer.cancel()
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
    assert "Traceback" not in output, output
    assert process.returncode == code, seen + output
