"""Problems in YAML are those that Python states, and an error names the line."""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path

import jsonschema
import pytest
import yaml

import vtbdrake_diagrams.space_climber.studies
from tests.cli.program import ANGLE, DAMPING, RATE, error_of, run
from tests.testbeds import PendulumScenario
from vtbdrake import Choice, Constraint, CVaR, Parameter, Problem, Quality, Study
from vtbdrake.optimization import ProblemFile, ProblemFileError
from vtbdrake.optimization.identity import describe
from vtbdrake.rollout.named_function import largest, magnitude
from vtbdrake_diagrams.space_climber import SpaceClimberScenario

GAIT = Path(vtbdrake_diagrams.space_climber.studies.__path__[0]) / "gait.yaml"
FULL = f"""
scenario: tests.testbeds:PendulumScenario
parameters:
  {DAMPING}: {{lower: 0.05, upper: 0.8, log: true}}
  scenario.stiffness: {{lower: 0, upper: 3, integer: true}}
  scenario.damping: {{options: [0, 0.5]}}
qualities:
  - of: {ANGLE}
values: {{{RATE}: 1e-1}}
conditions:
  small: {{{ANGLE}: 0.2}}
  large: {{{ANGLE}: 0.3}}
constraints:
  slow: {{of: {RATE}, at_most: 0.1}}
  moves: {{of: [{ANGLE}, {RATE}], f: "math:hypot", at_least: 0.05}}
risk: cvar:0.5
horizon: 0.3
sample_period: 0.1
solver: {{name: sobol, options: {{points: 4}}, seed: 3}}
budget: {{rollouts: 8}}
running: {{executor: serial, racing: false}}
"""


def full_problem() -> Problem:
    return Problem(
        scenario=PendulumScenario(),
        parameters=[
            Parameter(DAMPING, 0.05, 0.8, log=True),
            Parameter("scenario.stiffness", 0, 3, integer=True),
            Choice("scenario.damping", [0, 0.5]),
        ],
        quality=Quality(magnitude, ANGLE),
        conditions=[{RATE: 0.1, ANGLE: 0.2}, {RATE: 0.1, ANGLE: 0.3}],
        constraints=[
            Constraint(largest, RATE, at_most=0.1),
            Constraint(math.hypot, [ANGLE, RATE], at_least=0.05),
        ],
        risk=CVaR(0.5),
        horizon=0.3,
        sample_period=0.1,
    )


def written(folder: Path, text: str = FULL) -> Path:
    path = folder / "problem.yaml"
    path.write_text(text)
    return path


def test_a_file_and_python_state_the_same_study(tmp_path: Path) -> None:
    path, problem = written(tmp_path), full_problem()
    stated = ProblemFile.load(path)
    assert describe(stated.problem) == describe(problem)
    expected = problem.study(solver="sobol", options={"points": 4}, seed=3)
    expected.run(rollouts=8, racing=False, executor="serial", progress=False)
    assert stated.run(progress=False).trials == expected.trials

    done = run("study", "run", tmp_path / "a.db", path)
    assert (done.exit_code, done.stderr) == (0, "")
    with Study.open(tmp_path / "a.db") as study:
        assert study.trials == expected.trials
    # A resumed study refuses another problem, so that Python states the one in the file.
    with problem.study(tmp_path / "a.db") as resumed:
        assert len(resumed) == len(expected)


def test_options_of_the_command_replace_those_of_the_file(tmp_path: Path) -> None:
    path = written(tmp_path)
    done = run("study", "run", tmp_path / "a.db", path, "--rollouts", 10, "--seed", 5, "--json")
    printed = json.loads(done.stdout)
    assert (printed["solver"], printed["seed"], printed["rollouts"]) == ("sobol", 5, 8)
    for option in (["--horizon", 1], ["--quality", ANGLE], ["--vary", f"{ANGLE}=0:1"], ["--field", "damping=1"]):
        message = error_of("study", "run", tmp_path / "b.db", path, *option)
        assert f"states the problem: leave out {option[0]}" in message


@pytest.mark.slow
def test_the_gait_of_the_space_climber_is_that_of_python() -> None:
    stated = ProblemFile.load(GAIT)
    gait = Problem(
        scenario=SpaceClimberScenario(),
        parameters=[
            Parameter("dps.impl.gait.period", 1.0, 4.0, log=True),
            Parameter("dps.impl.gait.stroke", 0.05, 0.30),
        ],
        quality=Quality(largest, of="sim.sys.climber.base.x", reading="end", upper=3.0, unit="m"),
        constraints=[Constraint(magnitude, "sim.sys.climber.base.pitch", at_most=0.5, unit="rad")],
        conditions=[{"dps.impl.gait.phase": phase} for phase in (0.0, 0.25, 0.5, 0.75)],
        risk=CVaR(0.5),
        horizon=5.0,
    )
    assert describe(stated.problem) == describe(gait)
    assert stated.run_arguments["rollouts"] == 40 and stated.study_arguments["seed"] == 1


def test_the_schema_accepts_what_can_be_loaded(tmp_path: Path) -> None:
    schema = json.loads(run("study", "run", "--schema").stdout)
    jsonschema.Draft202012Validator.check_schema(schema)
    for text in (FULL, GAIT.read_text()):
        jsonschema.validate(yaml.safe_load(text.replace("1e-1", "0.1")), schema)
    for line in (
        "horizon: -1.0",
        "paramters: {}",
        f"parameters: {{{ANGLE}: {{lower: low}}}}",
        "qualities: [{reading: last}]",
        "constraints: {a: {atmost: 1}}",
        "running: {executor: cloud}",
    ):
        with pytest.raises(jsonschema.ValidationError):
            jsonschema.validate(yaml.safe_load(line), schema)
        key = line.partition(":")[0]
        kept = [node for node in FULL.split("\n\n") if not node.startswith(key)]
        with pytest.raises(ProblemFileError):
            ProblemFile.load(written(tmp_path, "\n".join(kept) + f"\n{line}\n"))


def test_the_least_settings_are_accepted(tmp_path: Path) -> None:
    text = FULL.replace("seed: 3", "seed: 0, parallel: 1").replace("rollouts: 8", "rollouts: 1, seconds: 0.001")
    text = text.replace("racing: false", "workers: 1, time_limit: 0.001")
    stated = ProblemFile.load(written(tmp_path, text))
    assert (stated.solver.seed, stated.solver.parallel) == (0, 1)
    assert (stated.budget.rollouts, stated.budget.seconds) == (1, 0.001)
    assert (stated.running.workers, stated.running.time_limit) == (1, 0.001)
    for least in ("parallel: 1", "rollouts: 1", "seconds: 0.001", "workers: 1", "time_limit: 0.001"):
        name = least.partition(":")[0]
        with pytest.raises(ProblemFileError, match=f"{name} must be .*not 0"):
            ProblemFile.load(written(tmp_path, text.replace(least, f"{name}: 0")))


@pytest.mark.parametrize(
    ("old", "new", "line", "message"),
    [
        ("horizon: 0.3", "horizon: -1", 17, "ProblemFile.horizon must be a finite number above 0 s, not -1"),
        ("horizon", "horison", 17, "ProblemFile has no field 'horison'; did you mean horizon?"),
        ("upper: 0.8", "uper: 0.8", 4, "did you mean upper?"),
        ("upper: 0.8", "upper: high", 4, "upper must be a finite number or None, not 'high'"),
        (", upper: 0.8", "", 4, "needs lower and upper"),
        ("lower: 0.05", "lower: 2.0", 4, "must be finite and not empty, lower < upper"),
        ("lower: 0.05", "lower: -1.0", 4, "a logarithmic range begins above 0"),
        ("options: [0, 0.5]", "options: [1]", 6, "at least two different options"),
        ("options: [0, 0.5]", "options: [0, 1], lower: 2", 6, "not both"),
        (f"of: {ANGLE}", f"of: {ANGLE}s", 8, "did you mean"),
        ("math:hypot", "math:hypo", 15, "no function 'hypo'"),
        (f"  small: {{{ANGLE}", f"  small: {{{DAMPING}", 4, "is a parameter, so that no condition can set it"),
        (f"  small: {{{ANGLE}", "  small: {sim.sys.nothing", 11, "sim.sys.nothing"),
        ("budget: {rollouts: 8}", "budget: 5", 20, "budget is a mapping of rollouts, seconds, target, not 5"),
        ("cvar:0.5", "cvar:2", 16, "the level of cvar is a number in (0, 1]"),
        ("PendulumScenario", "PendulumScenari", 2, "has no scenario 'PendulumScenari'"),
        ("executor: serial", "executor: cloud", 21, "must be one of auto, serial"),
    ],
)
def test_an_error_names_the_line(tmp_path: Path, old: str, new: str, line: int, message: str) -> None:
    assert old in FULL
    path = written(tmp_path, FULL.replace(old, new))
    printed = error_of("study", "run", tmp_path / "a.db", path)
    assert f"{path}: line {line}: " in printed and message in printed
    assert not (tmp_path / "a.db").exists()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "its content is no mapping: it has keys such as scenario, parameters and qualities"),
        ("horizon: 1", "a problem has a scenario"),
        ("scenario: [", "is not YAML"),
        ("horizon: 010", "line 1: 010 is a number to the base 8 in YAML"),
        ("scenario: tests.testbeds:PendulumScenario", "a problem has at least one quality"),
        ("tests.testbeds:PendulumScenario: {stiffness: 1.0}", "has no field"),
    ],
)
def test_a_file_that_is_no_problem_is_refused(tmp_path: Path, text: str, message: str) -> None:
    assert message in error_of("study", "run", tmp_path / "a.db", written(tmp_path, text))
    assert "no problem file none.yaml" in error_of("study", "run", tmp_path / "a.db", "none.yaml")


def test_a_file_that_is_only_looked_at_imports_what_was_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "stranger.py").write_text(f"open({str(tmp_path / 'ran')!r}, 'w').close()")
    text = "scenario: tests.testbeds:PendulumScenario\nqualities:\n- f: stranger:nothing\n  of: time\n"
    path = written(tmp_path, text)
    for look in (lambda *options: error_of("view", path, *options), lambda *_: refusal(path)):
        message = look()
        assert "it names stranger:nothing, and importing its module runs its code: if you trust it, add" in message
        assert "line 3" in message and "--trust stranger" in message
    assert "it names stranger:nothing" in error_of("view", path, "--trust", "strange")
    assert not (tmp_path / "ran").exists()
    assert "stranger has no function 'nothing'" in error_of("view", path, "--trust", "stranger")
    assert (tmp_path / "ran").exists()
    del sys.modules["stranger"]
    (tmp_path / "ran").unlink()
    # To run a study is to run the code of its file.
    assert "stranger has no function 'nothing'" in error_of("study", "run", tmp_path / "a.db", path)
    assert (tmp_path / "ran").exists()
    # The scenario is asked about, too.
    assert "it names other.strangers:Scenario" in error_of(
        "view", written(tmp_path, "scenario: other.strangers:Scenario")
    )


def refusal(path: Path) -> str:
    with pytest.raises(ProblemFileError) as caught:
        ProblemFile.load(path, trusted=[])
    return str(caught.value)
