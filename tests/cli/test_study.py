"""``vtbdrake study``: what it records is what the library finds."""

import json
import math
from pathlib import Path

import pytest

from tests.cli.program import ANGLE, DAMPING, PENDULUM, RATE, error_of, run
from tests.testbeds import PendulumScenario
from vtbdrake import Choice, Constraint, CVaR, Parameter, Problem, Quality, Study
from vtbdrake.rollout.named_function import largest, magnitude

BEGIN = [PENDULUM, "--horizon", 0.3, "--vary", f"{ANGLE}=-1.5:1.5", "--vary", f"{RATE}=-3:3", "--quality", ANGLE]
BEGIN += ["--sample-period", 0.1, "--minimize", "--condition", f"{DAMPING}=0.1", "--condition", f"{DAMPING}=0.2"]


def test_a_study_is_run_shown_given_points_and_resumed(tmp_path: Path) -> None:
    file = tmp_path / "a.db"
    begun = run("study", "run", file, *BEGIN, "--solver", "sobol", "--rollouts", 16, "--executor", "serial")
    assert (begun.exit_code, begun.stderr) == (0, "")
    problem = Problem(
        scenario=PendulumScenario(),
        parameters=[Parameter(ANGLE, -1.5, 1.5), Parameter(RATE, -3.0, 3.0)],
        quality=Quality(magnitude, ANGLE, minimize=True),
        horizon=0.3,
        sample_period=0.1,
        conditions=[{DAMPING: 0.1}, {DAMPING: 0.2}],
    )
    expected = problem.study(solver="sobol").run(rollouts=16, executor="serial", progress=False)
    assert f"best: magnitude = {expected.best.value:g} at" in begun.stdout

    for arguments in (
        ["intervene", file, "try", f"{ANGLE}=0.5", f"{RATE}=1"],
        ["intervene", file, "try", f"{ANGLE}=0.25", f"{RATE}=0"],
        ["edit", file, 1, f"{RATE}=2", f"{ANGLE}=-0.5"],
        ["intervene", file, "try", f"{ANGLE}=1", f"{RATE}=1"],
        ["remove", file, 3],
        ["attribute", file, "operator=somebody=else"],
        ["attribute", file, "marks=[1, 2]", "--trial", 0],
    ):
        done = run("study", *arguments)
        assert (done.exit_code, done.stderr) == (0, "")
    shown = run("study", "show", file, "--csv", tmp_path / "a.csv")
    rows = [line.split() for line in shown.stdout.splitlines()]
    assert ["1", "-0.5", "2.0"] in rows and ["2", "0.25", "0.0"] in rows
    assert 'attribute operator: "somebody=else"' in shown.stdout
    header, first, *_ = (tmp_path / "a.csv").read_text().splitlines()
    assert header.endswith("attribute marks") and first.endswith('"[1, 2]"')

    run("study", "run", file, *BEGIN, "--rollouts", 24, "--executor", "serial")
    with Study.open(file) as study:
        given = [tuple(trial.parameters.values()) for trial in study.trials if trial.origin == "user"]
        assert given == [(-0.5, 2.0), (0.25, 0.0)]


def test_all_kinds_of_parameters_and_constraints_can_be_stated(tmp_path: Path) -> None:
    problem = Problem(
        scenario=PendulumScenario(),
        parameters=[
            Parameter(DAMPING, 0.05, 0.8, log=True),
            Parameter("scenario.stiffness", 0, 3, integer=True),
            Choice("scenario.damping", [0, 0.5]),
        ],
        quality=Quality(magnitude, ANGLE),
        horizon=0.3,
        sample_period=0.1,
        conditions=[{ANGLE: 0.2}, {ANGLE: 0.3}],
        risk=CVaR(0.5),
        constraints=[
            Constraint(largest, RATE, at_most=0.1),
            Constraint(math.hypot, [ANGLE, RATE], at_least=0.05),
        ],
    )
    file = tmp_path / "a.db"
    # A resumed study refuses another problem, so that the program states the same one.
    with problem.study(file, solver="sobol", options={"points": 4}, seed=3) as study:
        study.run(rollouts=8, racing=False, executor="serial", progress=False)
    arguments = ["--horizon", 0.3, "--sample-period", 0.1, "--quality", ANGLE, "--risk", "cvar:0.5"]
    arguments += ["--vary", f"{DAMPING}=0.05:0.8:log", "--vary", "scenario.stiffness=0:3:integer"]
    arguments += ["--choose", "scenario.damping=0,0.5", "--at-most", f"{RATE}=0.1"]
    arguments += ["--at-least", f"math:hypot({ANGLE},{RATE})=0.05", "--no-racing"]
    arguments += ["--solver", "sobol", "--option", "points=4", "--seed", 3]
    arguments += ["--condition", f"{ANGLE}=0.2", "--condition", f"{ANGLE}=0.3", "--on-error", "raise"]
    done = run("study", "run", file, PENDULUM, *arguments, "--rollouts", 8, "--executor", "serial")
    assert (done.exit_code, done.stderr) == (0, "")
    with Study.open(file) as study:
        assert len(study.trials) == 4 and all(trial.exact for trial in study.trials)


def test_what_makes_no_sense_is_one_line(tmp_path: Path) -> None:
    file = tmp_path / "a.db"
    run("study", "run", file, *BEGIN, "--rollouts", 4, "--executor", "serial")
    for arguments, message in (
        (["run", file, *BEGIN], "give rollouts=, seconds= or target="),
        (["show", tmp_path / "none.db"], "does not exist"),
        (["intervene", file, "try", f"{ANGLE}=9", f"{RATE}=0"], "outside its range"),
        (["intervene", file, "try", f"{ANGLE}=1", f"{ANGLE}=2"], "is set twice"),
        (["remove", file, 7], "no intervention 7 waits"),
        (["attribute", file, "a=1", "--trial", 99], "no trial 99"),
        (["run", file, *BEGIN, "--rollouts", 4, "--seed", 3], "was begun with seed 0, not 3"),
        (["run", file, *BEGIN, "--rollouts", 4, "--parallel", 8], "was begun with parallel None, not 8"),
    ):
        assert message in error_of("study", *arguments)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--vary", "a=0:1:lin"], "then :log, :integer or both, not 'a=0:1:lin'"),
        (["--vary", "a=0"], "expected ADDRESS=LOWER:UPPER"),
        (["--vary", "a=0:1:log"], "a logarithmic range begins above 0"),
        (["--choose", "a=1"], "at least two different options"),
        (["--choose", "a"], "expected ADDRESS=OPTION,OPTION[,...], not 'a'"),
        (["--at-most", "math:hypot=1"], "MODULE:FUNCTION(ADDRESS,...)=LIMIT"),
        (["--at-most", "a=fast"], "LIMIT a number"),
        (["--at-least", "math:hypo(a,b)=1"], "math has no function 'hypo'"),
        (["--risk", "cvar:2"], "a number in (0, 1], not '2'"),
        (["--risk", "median:0.5"], "mean, worst, quantile:LEVEL or cvar:LEVEL"),
        ([], "nothing is varied: add --vary or --choose"),
    ],
)
def test_a_wrong_option_says_what_it_takes(arguments: list[str], message: str, tmp_path: Path) -> None:
    common = (tmp_path / "a.db", PENDULUM, "--horizon", 0.3, "--quality", ANGLE)
    assert message in error_of("study", "run", *common, *arguments)


@pytest.mark.slow
def test_a_study_is_steered_by_commands_and_replayed_without_one(tmp_path: Path) -> None:
    file, new = tmp_path / "a.db", tmp_path / "b.db"
    begin = ["study", "run", file, *BEGIN, "--choose", f"{DAMPING}=0.1,0.2,0.4", "--executor", "serial"]
    begin = [text for text in begin if text not in ("--condition", f"{DAMPING}=0.1", f"{DAMPING}=0.2")]
    assert run(*begin, "--solver", "random", "--rollouts", 64).exit_code == 0
    for arguments in (
        ["budget", 70, "--by", "Ada"],
        ["range", f"{ANGLE}=-1:"],
        ["range", f"{DAMPING}=0.1,0.4"],
        ["forbid", f"{ANGLE}=:-0.5", f"{RATE}=1:2"],
        ["forbid", f"{DAMPING}=0.1"],
        ["allow", 4],
        ["freeze", f"{RATE}=0.5"],
        ["freeze", RATE],
        ["unfreeze", RATE],
        ["solver", "bayesian", "--option", "batch=2"],
        ["pause"],
        ["resume"],
        ["try", f"{ANGLE}=0.5", f"{RATE}=1", f"{DAMPING}=0.2"],
    ):
        done = run("study", "intervene", file, *arguments)
        assert (done.exit_code, done.stderr) == (0, ""), arguments
    assert "try" in done.stdout and "waits for the next batch, as soon as the study runs" in done.stdout

    listed = json.loads(run("study", "history", file, "--json").stdout)
    assert [row["number"] for row in listed] == list(range(1, 14)) and listed[0]["name"] == "Ada"
    assert listed[1]["payload"] == {"address": ANGLE, "lower": -1.0, "upper": None}
    assert listed[3]["payload"] == {"region": {ANGLE: [None, -0.5], RATE: [1.0, 2.0]}}
    assert run(*begin, "--rollouts", 64).exit_code == 0
    with Study.open(file) as study:
        later = study.trials[65:]
        assert len(study) == 70 and len(later) == 5 and {trial.method for trial in later} == {"bayesian"}
        assert all(trial.parameters[ANGLE] >= -1.0 and trial.parameters[DAMPING] == 0.4 for trial in later)
    # The pause and what ended it were noticed before the batch on which the others have an effect.
    rows = [line.split() for line in run("study", "history", file).stdout.splitlines()[2:]]
    assert len(rows) == 13 and all(row[4] in ("1", "2") for row in rows)

    shown = run("study", "replay", file, new, "--without", 10, "--executor", "serial", "--json")
    assert json.loads(shown.stdout)["rollouts"] == 70
    with Study.open(new) as study:
        assert {trial.method for trial in study.trials} == {"random", "by hand"}
    assert "no intervention 11 can be left out" in error_of("study", "replay", file, tmp_path / "c.db", "--without", 11)
    assert "exists already" in error_of("study", "replay", file, new)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["stop"], "no process runs"),
        (["resume"], "the study is not paused"),
        (["budget", "many"], "a budget of rollouts must be a number, not 'many'"),
        (["range", ANGLE], "expected ADDRESS=LOWER:UPPER"),
        (["range", f"{ANGLE}=a:b"], "LOWER:UPPER with numbers"),
        (["range", f"{ANGLE}=1:2:3"], "LOWER:UPPER with numbers"),
        (["forbid", f"{ANGLE}=:"], "no point is left"),
        (["aspiration", "-1"], "an aspiration belongs to several qualities"),
        (["solver", "nonsense"], "there is no solver 'nonsense'"),
        (["pause", "--bye", "Ada"], "pause takes no argument, not '--bye Ada'"),
        (["try"], "try takes ADDRESS=VALUE [...], and none is given"),
        (["allow", "first"], "allow takes NUMBER, not 'first'"),
        (["pause", "--option", "batch=2"], "--option is for another solver, not for pause"),
    ],
)
def test_an_intervention_that_makes_no_sense_is_one_line(arguments: list[str], message: str, tmp_path: Path) -> None:
    file = tmp_path / "a.db"
    Problem(
        scenario=PendulumScenario(),
        parameters=[Parameter(ANGLE, -1.5, 1.5)],
        quality=Quality(magnitude, ANGLE),
        horizon=0.3,
    ).study(file, solver="sobol").close()
    assert message in error_of("study", "intervene", file, *arguments)
