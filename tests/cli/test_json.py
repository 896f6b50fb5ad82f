"""``--json``: every command has it, and what it prints then is nothing but JSON, one object a line."""

from __future__ import annotations

import json
import math
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import click
import numpy as np
import pytest

from tests.cli.program import ACROBOT, ANGLE, PENDULUM, RATE, ROOT, run
from tests.recording.servo import Servo
from tests.testbeds import PendulumScenario
from vtbdrake import Parameter, Problem, Quality
from vtbdrake.cli import main
from vtbdrake.common.json_data import plain
from vtbdrake.recording.recorder import Recorder
from vtbdrake.rollout.named_function import magnitude

WITHOUT = {"completion": "it prints a script for a shell"}
SERVO = "tests.control.servo_machine:ServoMachineScenario"


def commands(group: click.Group, *above: str) -> Iterator[tuple[tuple[str, ...], click.Command]]:
    context = click.Context(group)
    for name in group.list_commands(context):
        command = group.get_command(context, name)
        assert command is not None
        if isinstance(command, click.Group):
            yield from commands(command, *above, name)
        else:
            yield (*above, name), command


def parsed(text: str) -> list[Any]:
    def refuse(constant: str) -> None:
        raise ValueError(f"{constant} is no JSON")

    return [json.loads(line, parse_constant=refuse) for line in text.splitlines()]


def result(*arguments: object) -> Any:
    """Run a command with ``--json``, and return the one object that it prints."""
    program = run(*arguments, "--json")
    assert (program.exit_code, program.stderr) == (0, "")
    (data,) = parsed(program.stdout)
    return data


def test_every_command_has_the_option_or_a_reason() -> None:
    lacking = [
        " ".join(path)
        for path, command in commands(main)
        if "--json" not in {o for p in command.params for o in p.opts}
    ]
    assert lacking == list(WITHOUT), "add vtbdrake.cli.output.json_option, and print by show, say and emit"


def test_plain_data_are_those_of_json() -> None:
    data = {"a": np.array([1.0, math.nan]), 2: (True, None, -math.inf), "path": Path("x"), "n": np.int64(3)}
    assert plain(data) == {"a": [1.0, None], "2": [True, None, None], "path": "x", "n": 3}


def test_an_error_is_an_object_on_stderr() -> None:
    for arguments, message in (
        (["rollout", PENDULUM, "--horizon", 1, "--set", "dps.none=1"], "dps.none"),
        (["rollout", PENDULUM], "Missing option '--horizon'"),
        (["rollout", PENDULUM, "--horizon", 1, "--no-such"], "No such option"),
        (["no-such"], "No such command"),
        (["--no-such", "rollout"], "No such option"),
    ):
        program = run(*arguments, "--json")
        (error,) = parsed(program.stderr)
        assert program.stdout == "" and message in error["error"]
        assert error["exit_code"] == program.exit_code == 2


def test_an_interruption_is_an_object(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(_: str) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("vtbdrake.testbed.load_scenario", interrupt)
    program = run("variables", PENDULUM, "--json")
    assert parsed(program.stderr) == [{"error": "interrupted", "exit_code": 1}] and program.exit_code == 1


def test_a_schema_is_an_object_in_one_line() -> None:
    for arguments in (["variables", PENDULUM], ["campaign"], ["study", "run"]):
        assert result(*arguments, "--schema")["type"] == "object"


def test_a_failure_is_an_object_behind_the_result() -> None:
    program = run("rollout", PENDULUM, "--horizon", 0.1, "--set", f"{RATE}=1e300", "--json")
    (data,), (error,) = parsed(program.stdout), parsed(program.stderr)
    assert data["end"] == "failed" and "the rollout failed" in error["error"]
    assert error["exit_code"] == program.exit_code == 1


def test_rollout_has_the_numbers_of_its_table() -> None:
    data = result("rollout", ACROBOT, "--horizon", 0.2, "--record", "dps.torque")
    assert data["end"] == "horizon" and math.isclose(data["simulated"], 0.2)
    assert data["recorded"][0]["min"] <= data["recorded"][0]["final"] <= data["recorded"][0]["max"]


def test_sweep_and_boundary_have_the_values_of_the_library() -> None:
    parameters, quality = [Parameter(ANGLE, 0.0, 3.0)], Quality(magnitude, of=RATE)
    problem = Problem(scenario=PendulumScenario(), parameters=parameters, quality=quality, horizon=2.0, threshold=4.0)
    common = ("--quality", RATE, "--threshold", 4, "--horizon", 2)
    swept, expected = result("sweep", PENDULUM, "--vary", f"{ANGLE}=0:3:4", *common), problem.sweep(4, progress=False)
    assert [entry["h"] for entry in swept["points"]] == expected.h.tolist()
    assert swept["best"] == {"point": expected.best.parameters, "h": expected.best.value}
    steps = {"resolution": 0.25, "coarse": 0.5, "repeats": 2}
    options = [f"--{name}={value}" for name, value in steps.items()]
    bounded = result("boundary", PENDULUM, "--vary", f"{ANGLE}=0:3", *common, *options)
    interval = problem.boundary(**steps, progress=False)
    assert (bounded["lower"], bounded["upper"]) == (interval.lower, interval.upper)


def test_study_has_its_points(tmp_path: Path) -> None:
    file = tmp_path / "a.db"
    begin = (PENDULUM, "--horizon", 0.3, "--vary", f"{ANGLE}=-1.5:1.5", "--quality", ANGLE, "--sample-period", 0.1)
    ran = result("study", "run", file, *begin, "--rollouts", 4, "--executor", "serial", "--solver", "sobol")
    assert ran["reason"] in ("budget", "solver") and len(ran["points"][ANGLE]) == 4
    tried = result("study", "intervene", file, "try", f"{ANGLE}=0.5", "--by", "me")
    assert (tried["number"], tried["name"], tried["payload"]) == (1, "me", {"point": {ANGLE: 0.5}})
    assert result("study", "history", file) == [tried]
    assert result("study", "attribute", file, "operator=me") == {"operator": "me"}
    shown = result("study", "show", file)
    assert shown["waiting"] == {"1": {ANGLE: 0.5}} and shown["attributes"] == {"operator": "me"}
    values = shown["points"]["magnitude"]
    assert shown["best"][0]["values"] == [max(values)] and shown["rollouts"] == 4


def test_replay_export_and_diagram(tmp_path: Path) -> None:
    servo = Servo()
    with Recorder(servo.runtime, tmp_path / "run.lcm"):
        servo.runtime.run(cycles=20)
    replayed = result("replay", tmp_path / "run.lcm", "--scenario", "tests.control.scripted:ServoScenario")
    assert (replayed["outcome"], replayed["cycles"], replayed["first_difference"]) == ("identical", 20, None)
    exported = result("export", tmp_path / "run.lcm", tmp_path / "run.csv")
    assert exported["cycles"] == 20 and Path(exported["file"]).exists()
    assert result("diagram", PENDULUM)["svg"].startswith("<")
    assert result("diagram", PENDULUM, "-o", tmp_path / "a.svg") == {"file": str(tmp_path / "a.svg")}


@contextmanager
def started(*arguments: object) -> Iterator[subprocess.Popen[str]]:
    command = [sys.executable, "-u", "-m", "vtbdrake.cli", *map(str, arguments), "--json"]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as program:
        try:
            yield program
        finally:
            program.kill()


def test_a_loop_prints_an_object_for_each_event() -> None:
    with started("hub", "--port", 0) as hub:
        assert hub.stdout is not None
        url = json.loads(hub.stdout.readline())["url"]
        with started("machine", SERVO, "--url", url) as machine:
            assert machine.stdout is not None
            assert json.loads(machine.stdout.readline()) == {"url": url, "perturbed": {}}
            with started("run", SERVO, "--url", url, "--priority", 0) as loop:
                assert loop.stdout is not None
                assert {grant["request"] for grant in json.loads(loop.stdout.readline())["real_time"]}
                common = ("--url", url, "--timeout", 60, "--json")
                while (program := run("get", "dps.gain", *common)).exit_code:  # until it answers
                    assert loop.poll() is None
                (before,) = parsed(program.stdout)
                assert parsed(run("set", "dps.gain=2.5", *common).stdout) == [{"dps.gain": 2.5}] != [before]
                assert parsed(run("reset", *common).stdout) == [{"released": []}]
                loop.send_signal(signal.SIGINT)
                output, _ = loop.communicate(timeout=60)
            statistics, faults = parsed(output)
            assert statistics["statistics"]["period"] > 0.0 and "faults" in faults
            machine.send_signal(signal.SIGINT)
            output, _ = machine.communicate(timeout=60)
            (ended,) = parsed(output)
            assert ended["simulated"] > 0.0
        hub.send_signal(signal.SIGINT)
        output, _ = hub.communicate(timeout=60)
        (counts,) = parsed(output)
        assert counts["messages"] > 0
