"""A study: what it finds, and that neither executor nor interruption changes it."""

import contextlib
import os
import random
import signal
import sqlite3
import subprocess
import sys
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pydrake.systems.analysis import SimulatorConfig
from scipy.optimize import brentq
from scipy.special import ellipj, ellipk

from tests.optimization.studies import (
    DAMPING,
    RATE,
    THETA,
    DoubleIntegratorScenario,
    StatedExecutor,
    gap,
    pendulum_problem,
)
from tests.testbeds import AcrobotScenario, PendulumScenario
from vtbdrake.optimization import Choice, Parameter, Problem, Study, StudyError
from vtbdrake.optimization.solvers import CATALOGUE, Solver
from vtbdrake.optimization.study.study_file import StudyFile
from vtbdrake.rollout import Constraint, Quality, QualityError

ROOT = Path(__file__).resolve().parents[3]


def table(study):
    """Return the points of a study and what is known of them, without the times that they took."""
    rollouts = {row: (o.h, o.value, o.measures, o.t_star, o.end, o.message) for row, o in study.rollouts.items()}
    return [(t.parameters, t.values, t.exact, t.origin, t.batch) for t in study.trials], rollouts


def on_one_python(*solvers):
    return [pytest.param(solver, marks=pytest.mark.one_python) for solver in solvers]


def slow(*solvers):
    return [pytest.param(solver, marks=[pytest.mark.slow, pytest.mark.one_python]) for solver in solvers]


# -- what it finds


def swing(start: float, t: float) -> float:
    """The angle of an undamped pendulum of 0.5 m released at rest, by Jacobi's elliptic functions."""
    k = np.sin(start / 2.0)
    sn, _, _, _ = ellipj(ellipk(k**2) - np.sqrt(9.81 / 0.5) * t, k**2)
    return float(2.0 * np.arcsin(k * sn))


@pytest.mark.parametrize("solver", ["cmaes", "LN_BOBYQA", *slow("auto", "sobol")])
def test_the_best_start_is_that_of_the_closed_form(solver):
    problem = pendulum_problem(parameters=[Parameter(THETA, 0.1, 2.5)], conditions=[{DAMPING: 0.0}])
    exact = brentq(lambda start: swing(start, 0.3) - 0.3, 0.1, 2.5)
    study = problem.study(solver=solver).run(rollouts=128, target=1e-3, executor="serial", progress=False)
    tolerance = 0.05 if solver == "sobol" else 5e-3
    assert study.best.parameters[THETA] == pytest.approx(exact, abs=tolerance)


@pytest.mark.slow
def test_best_gains_are_those_of_lqr():
    # For x'' = u and the cost of x^2 + u^2 over an infinite time, u = -x - sqrt(2) x', from every start.
    problem = Problem(
        scenario=DoubleIntegratorScenario(),
        parameters=[Parameter("scenario.stiffness", 0.3, 3.0), Parameter("scenario.damping", 0.5, 3.0)],
        quality=Quality(
            lambda x, u: x[0] ** 2 + u[0] ** 2, ["sim.sys.mass.y0", "dps.force"], minimize=True, reading="integral"
        ),
        horizon=8.0,
        sample_period=0.02,
        conditions=[{"sim.sys.mass.continuous_state[0]": 1.0}],
    )
    study = problem.study(solver="LN_BOBYQA").run(rollouts=80, executor="serial", progress=False)
    assert study.best.parameters["scenario.stiffness"] == pytest.approx(1.0, abs=0.02)
    assert study.best.parameters["scenario.damping"] == pytest.approx(np.sqrt(2.0), abs=0.02)
    # x(0) = 1: the cost is P11 of the Riccati equation's solution.
    assert study.best.value == pytest.approx(np.sqrt(2.0), abs=1e-3)
    assert study.reason == "solver" and "LN_BOBYQA" in study.message


def test_two_qualities_have_a_front_and_no_best():
    problem = pendulum_problem(
        quality=[Quality(gap, THETA, minimize=True, reading="end"), Quality(abs, RATE, reading="end")]
    )
    study = problem.study(solver="sobol")
    assert study.pareto() == ()
    study.run(rollouts=32, executor="serial", progress=False)
    values = np.array([trial.values for trial in study.trials])
    better = (values[None, :, 0] <= values[:, None, 0]) & (values[None, :, 1] >= values[:, None, 1])
    better &= (values[None, :, 0] < values[:, None, 0]) | (values[None, :, 1] > values[:, None, 1])
    assert [trial.number for trial in study.pareto()] == np.flatnonzero(~better.any(axis=1)).tolist()
    with pytest.raises(ValueError, match=r"use pareto\(\)"):
        study.best  # noqa: B018


@pytest.mark.parametrize(
    ("qualities", "names"),
    [
        ([Quality(gap, THETA), Quality(abs, THETA)], ("gap", "abs")),
        (
            [Quality(abs, THETA), Quality(abs, RATE), Quality(abs, DAMPING)],
            ("abs of position", "abs of velocity", "abs of damping"),
        ),
        (
            [Quality(abs, THETA), Quality(abs, THETA, reading="end")],
            ("abs of position (best)", "abs of position (end)"),
        ),
        (
            [Quality(lambda x: x, THETA), Quality(lambda x: x + 1, THETA)],
            ("f of position (best) 1", "f of position (best) 2"),
        ),
    ],
)
def test_qualities_have_different_names_and_their_units(qualities, names):
    qualities = [replace(quality, unit="rad") for quality in qualities]
    study = pendulum_problem(quality=qualities).study(solver="sobol")
    assert study.names == names and study.quality_units == ("rad",) * len(names)


def test_the_best_keeps_the_constraints():
    limit = Constraint(lambda rate: abs(rate), RATE, at_most=1.0)
    study = (
        pendulum_problem(constraints=[limit]).study(solver="sobol").run(rollouts=64, executor="serial", progress=False)
    )
    feasible = [t for t in study.trials if t.violations[0] <= 0.0]
    assert 0 < len(feasible) < 64
    assert study.best.value == min(t.value for t in feasible) > min(t.value for t in study.trials)


@pytest.mark.slow
def test_fields_choices_and_integers_can_be_varied():
    problem = Problem(
        scenario=PendulumScenario(),
        parameters=[
            Choice("scenario.simulator_config.integration_scheme", ["runge_kutta3", "implicit_euler"]),
            Parameter("scenario.stiffness", 0, 1, integer=True),
            Choice(DAMPING, [0.0, 0.3]),
        ],
        quality=Quality(gap, THETA, minimize=True, reading="end"),
        horizon=0.3,
        conditions=[{THETA: 0.8}],
    )
    study = problem.study(solver="grid").run(rollouts=100, executor="serial", progress=False)
    assert len(study) == len(study.trials) == 2 * 2 * 2 and study.reason == "solver"
    for trial in study.trials:
        fields = {k: v for k, v in trial.parameters.items() if k.startswith("scenario.")}
        alone = Problem(
            scenario=PendulumScenario().with_fields({k.removeprefix("scenario."): v for k, v in fields.items()}),
            parameters=[Parameter(DAMPING, 0.0, 1.0)],
            quality=Quality(gap, THETA, minimize=True, reading="end"),
            horizon=0.3,
            conditions=[{THETA: 0.8}],
        )
        assert alone.rollout([trial.parameters[DAMPING]]).value == trial.value


# -- executors and interruptions change nothing


@pytest.mark.slow
@pytest.mark.parametrize("solver", ["cmaes", *slow("TPE", "sobol")])
def test_a_study_is_the_same_in_series_and_in_parallel(solver):
    studies = []
    for executor, workers in (("serial", None), ("threads", 2), ("processes", 2)):
        problem = pendulum_problem(conditions=[{DAMPING: 0.0}, {DAMPING: 0.2}, {DAMPING: 0.4}])
        studies.append(
            problem.study(solver=solver, seed=5).run(rollouts=36, executor=executor, workers=workers, progress=False)
        )
    assert table(studies[0])[0] == table(studies[1])[0] == table(studies[2])[0]
    assert table(studies[0])[1] == table(studies[1])[1] == table(studies[2])[1]


class SideBySide(StatedExecutor):
    """Notes how many rollouts it gets at a time, and simulates none."""

    def __init__(self):
        super().__init__(lambda point: (gap(point[THETA] + 0.1 * point[RATE] + point[DAMPING]), ()))
        self.widths = []

    def run(self, task, points):
        self.widths.append(len(points))
        return super().run(task, points)


THREE = [{DAMPING: 0.0}, {DAMPING: 0.2}, {DAMPING: 0.4}]


@pytest.mark.slow_cases
@pytest.mark.parametrize("racing", [False, True])
@pytest.mark.parametrize("solver", [*on_one_python("cmaes", "TPE", "sobol"), *slow("auto")])
def test_a_wide_study_fills_as_many_workers(solver, racing):
    narrow, wide = SideBySide(), SideBySide()
    for parallel, executor in ((None, narrow), (30, wide)):
        study = pendulum_problem(conditions=THREE).study(solver=solver, parallel=parallel)
        study.run(rollouts=240, racing=racing, executor=executor, progress=False)
    # The race is between rollouts side by side, in a batch of 24 at least. What a race has left of it is smaller.
    shares = [sum(width for width in each.widths if width >= 24) / 240 for each in (narrow, wide)]
    assert shares[1] >= (0.7 if racing else 0.95)
    assert shares[0] <= 0.2 or solver == "sobol"


@pytest.mark.slow
def test_a_wide_study_is_the_same_with_any_number_of_workers():
    studies = []
    for executor, workers in (("serial", None), ("threads", 2), ("threads", 3)):
        study = pendulum_problem(conditions=THREE).study(seed=5, parallel=20)
        studies.append(study.run(rollouts=60, executor=executor, workers=workers, progress=False))
    assert table(studies[0]) == table(studies[1]) == table(studies[2])


def test_the_width_identifies_a_study(tmp_path):
    path = tmp_path / "wide.db"
    with pendulum_problem().study(path, solver="cmaes", parallel=20) as study:
        study.run(rollouts=30, executor="serial", progress=False)
        assert "seed 0, 20 rollouts side by side" in study.summary()
        assert [trial.batch for trial in study.trials] == [0] * 20 + [1] * 10
    with pytest.raises(StudyError, match="was begun with parallel 20, not 40: leave parallel out to resume it"):
        pendulum_problem().study(path, parallel=40)
    with pendulum_problem().study(path) as study:
        assert len(study.run(rollouts=60, executor="serial", progress=False).trials) == 60
        assert study.record["parallel"] == 20


@pytest.mark.parametrize("solver", ["cmaes", *slow("SNOPT", "LN_COBYLA", "auto", "TPE")])
def test_a_resumed_study_goes_on_as_if_nothing_had_been(tmp_path, solver):
    whole = pendulum_problem().study(tmp_path / "whole.db", solver=solver, seed=2)
    whole.run(rollouts=45, executor="serial", progress=False)
    path = tmp_path / "parts.db"
    first = pendulum_problem().study(path, solver=solver, seed=2)
    # As if it had been interrupted: the budget that the solver is made for is the run's.
    with contextlib.closing(StudyFile(path)) as file:
        file.begin_anew(budget=45, racing=False)
    first.run(rollouts=17, executor="serial", progress=False).close()
    with pendulum_problem().study(path) as second:
        assert second.run(rollouts=45, executor="threads", progress=False).reason == whole.reason
        assert table(second) == table(whole)


@pytest.mark.parametrize(
    "solver", ["cmaes", *slow("SNOPT", "random", "TPE", "LN_COBYLA", "differential-evolution", "sobol")]
)
def test_larger_budget_continues_the_same_study(tmp_path, solver):
    whole = pendulum_problem().study(solver=solver, seed=2).run(rollouts=45, executor="serial", progress=False)
    study = pendulum_problem().study(tmp_path / "parts.db", solver=solver, seed=2)
    for rollouts in (1, 17, 20, 45):
        study.run(rollouts=rollouts, executor="serial", progress=False)
        assert len(study) == min(rollouts, len(whole))
    assert study.rollouts == _without_times(study, whole)
    points = [(tuple(t.parameters.values()), t.values) for t in study.trials]
    assert dict(points) == {tuple(t.parameters.values()): t.values for t in whole.trials}
    assert len(points) == len(set(points))


def _without_times(study, whole):
    """The rollouts of ``whole``, with the times that the ones in ``study`` took."""
    return {row: replace(o, wall_time=study.rollouts[row].wall_time) for row, o in whole.rollouts.items()}


@pytest.mark.slow
@pytest.mark.one_python
def test_a_larger_budget_loses_no_point(tmp_path):
    study = pendulum_problem().study(tmp_path / "a.db", seed=3)
    seen = {}
    for rollouts in (20, 60, 110):  # the model asks for 1, 2 and 4 points at a time
        study.run(rollouts=rollouts, executor="serial", progress=False)
        points = {tuple(t.parameters.values()): t.values for t in study.trials}
        assert len(study) == rollouts == len(points) and seen.items() <= points.items()
        seen = points
    with pendulum_problem().study(tmp_path / "a.db") as again:
        before = table(study)
        again.run(rollouts=110, executor="serial", progress=False)
        assert table(again) == before


def test_points_given_between_two_budgets_are_told(tmp_path):
    study = pendulum_problem().study(tmp_path / "a.db", solver="TPE", seed=1)
    study.run(rollouts=24, executor="serial", progress=False)
    study.add([0.25, 0.0])
    study.run(rollouts=40, executor="serial", progress=False)
    assert len(study) == len(study.trials) == 40
    assert [t.number for t in study.trials if t.origin == "user"] == [24]


def test_a_study_that_is_complete_runs_nothing_more(tmp_path):
    path = tmp_path / "a.db"
    pendulum_problem().study(path, solver="sobol").run(rollouts=16, executor="serial", progress=False).close()
    before = sqlite3.connect(path).execute("SELECT point, finished FROM rollouts").fetchall()
    with pendulum_problem().study(path) as again:
        again.run(rollouts=16, executor="serial", progress=False)
        assert sqlite3.connect(path).execute("SELECT point, finished FROM rollouts").fetchall() == before


@pytest.mark.one_python
@pytest.mark.slow
@pytest.mark.parametrize("executor", ["serial", "threads"])
def test_a_killed_study_keeps_every_finished_rollout(tmp_path, executor):
    path = tmp_path / "killed.db"
    chance = random.Random(1)
    counts = [0]
    for _ in range(2):
        process = subprocess.Popen(
            [sys.executable, "-m", "tests.optimization.studies", str(path), executor],
            cwd=ROOT,
            stdout=subprocess.PIPE,
            text=True,
        )
        assert process.stdout is not None and process.stdout.readline() == "ready\n"
        # It is killed while it works, at a moment that chance names.
        until = counts[-1] + chance.randrange(1, 40)
        while _rollouts(path) < until and _runs(process):
            pass
        process.send_signal(signal.SIGKILL)
        process.wait()
        process.stdout.close()
        with Study.open(path) as study:
            counts.append(len(study))
            assert len(study.rollouts) == counts[-1] >= counts[-2]
            assert all(o.end == "horizon" and np.isfinite(o.value) for o in study.rollouts.values())
    assert counts[-1] > 5
    with pendulum_problem().study(path) as study:
        study.run(rollouts=counts[-1] + 20, executor="serial", progress=False)
        resumed = table(study)
    whole = pendulum_problem().study(tmp_path / "whole.db", solver="cmaes", seed=3)
    with contextlib.closing(StudyFile(whole.path)) as file:
        file.begin_anew(budget=100_000, racing=False)
    whole.run(rollouts=counts[-1] + 20, executor="serial", progress=False)
    assert resumed == table(whole)


def _runs(process: subprocess.Popen) -> bool:
    """Return whether the process runs on for 10 ms."""
    try:
        process.wait(0.01)
    except subprocess.TimeoutExpired:
        return True
    return False


def _rollouts(path: Path) -> int:
    try:
        with Study.open(path) as study:
            return len(study)
    except StudyError:
        return 0


@pytest.mark.slow
def test_points_given_by_another_process_are_evaluated_and_told(tmp_path):
    path = tmp_path / "a.db"
    pendulum_problem().study(path, solver="cmaes", seed=1).run(rollouts=12, executor="serial", progress=False).close()
    code = (
        "from vtbdrake.optimization import Study\n"
        f"study = Study.open({str(path)!r})\n"
        f"study.add({{{THETA!r}: 0.5, {RATE!r}: -1.0}}, [0.25, 0.0])\n"
        "print(len(study.trials))"
    )
    seen = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert int(seen.stdout) == 12
    with pendulum_problem().study(path) as study:
        study.run(rollouts=30, executor="serial", progress=False)
        given = [t for t in study.trials if t.origin == "user"]
        assert [tuple(t.parameters.values()) for t in given] == [(0.5, -1.0), (0.25, 0.0)]
        assert given[0].value == pendulum_problem().rollout([0.5, -1.0]).value
        first = table(study)
    with pendulum_problem().study(path) as again:
        again.run(rollouts=30, executor="serial", progress=False)
        assert table(again) == first


def _damping_study(dampings, path, **settings):
    problem = pendulum_problem(parameters=[], conditions=[{DAMPING: damping} for damping in dampings])
    return problem.study(path, solver="grid", **settings)


def test_a_grid_without_parameters_is_the_scenario_under_all_conditions(tmp_path):
    with _damping_study([0.1, 0.4], tmp_path / "a.db") as study:
        study.run(rollouts=2, executor="serial", progress=False)
        assert study.reason == "solver" and study.message.startswith("grid is finished")
        values = [study.rollouts[(), condition].value for condition in (0, 1)]
        assert study.best.value == max(values)  # A cost: the worst condition.
    for damping, value in zip([0.1, 0.4], values, strict=True):
        assert value == pendulum_problem(conditions=[{DAMPING: damping}]).rollout([0.0, 0.0]).value


def test_further_conditions_keep_the_rollouts_of_a_study(tmp_path):
    path = tmp_path / "a.db"
    _damping_study([0.1, 0.4], path).run(rollouts=2, executor="serial", progress=False).close()
    with pytest.raises(StudyError, match="another problem"):
        _damping_study([0.1, 0.4, 0.05], path)
    for others in ([0.4, 0.1, 0.05], [0.1], [0.1, 0.05]):
        with pytest.raises(StudyError, match="another problem"):
            _damping_study(others, path, more_conditions=True)
    with Study.open(path) as study:
        first = study.finished
    with _damping_study([0.1, 0.4, 0.05], path, more_conditions=True) as study:
        study.run(rollouts=3, executor="serial", progress=False)
        assert {key: study.finished[key] for key in first} == first and len(study) == 3
        whole = _damping_study([0.1, 0.4, 0.05], None).run(rollouts=3, executor="serial", progress=False)
        assert table(study) == table(whole)
    _damping_study([0.1, 0.4, 0.05], path, more_conditions=True).close()  # Nothing is new.


@pytest.mark.slow
def test_a_study_can_be_read_while_it_runs(tmp_path):
    path = tmp_path / "a.db"
    process = subprocess.Popen(
        [sys.executable, "-m", "tests.optimization.studies", str(path), "serial"], cwd=ROOT, stdout=subprocess.DEVNULL
    )
    try:
        counts = [0]
        # However seldom this process gets its turn beside the other one.
        while (counts[-1] < 30 or len(set(counts)) < 4) and _runs(process):
            counts.append(_rollouts(path))
        assert counts == sorted(counts) and len(set(counts)) >= 4
        with pytest.raises(StudyError, match="is being run by another process"):
            pendulum_problem().study(path).run(rollouts=100, progress=False)
        with Study.open(path) as study:
            assert study.best.value < 0.5
    finally:
        process.kill()
        process.wait()


def test_a_study_shows_itself_in_one_line_and_as_html(tmp_path):
    study = pendulum_problem().study(tmp_path / "a.db", solver="sobol")
    assert repr(study) == f"Study({tmp_path / 'a.db'}: 0 rollouts, solver sobol)"
    assert "no rollout is finished yet" in study._repr_html_() and "<img" not in study._repr_html_()
    study.run(rollouts=4, executor="serial", progress=False)
    html = study._repr_html_()
    assert "4 points, 4 rollouts" in html and f"{study.best.value:g}" in html
    assert html.count('<img src="data:image/png;base64,') == 1


def test_a_trial_and_its_parameters_show_themselves():
    study = pendulum_problem().study(solver="sobol").run(rollouts=2, executor="serial", progress=False)
    trial, parameter = study.trials[1], study.parameters[0]
    assert repr(trial).startswith(f"<Trial 1: {trial.value:.6g} (feasible) at ")
    for cells in (f"<td>{THETA}</td><td>{trial.parameters[THETA]}</td>", "<td>asked for by</td><td>sobol, batch"):
        assert cells in trial._repr_html_()
    assert f"<td>{THETA}</td>" in parameter._repr_html_() and "<td>[-1.5, 1.5]</td>" in parameter._repr_html_()


# -- budgets


def test_a_budget_of_rollouts_is_kept_to_the_rollout():
    conditions = [{DAMPING: d} for d in (0.0, 0.1, 0.2)]
    study = (
        pendulum_problem(conditions=conditions)
        .study(solver="cmaes")
        .run(rollouts=50, executor="threads", progress=False)
    )
    assert len(study) == 50 and study.reason == "budget"


def test_a_small_budget_under_many_conditions_has_a_best_point():
    conditions = [{DAMPING: d} for d in (0.0, 0.1, 0.2, 0.3)]
    study = pendulum_problem(conditions=conditions).study().run(rollouts=40, executor="serial", progress=False)
    left = 40 - len(study)
    rest = f" but for {left}, fewer than the 4 that a point takes" if left else ""
    assert study.best.exact and left < len(conditions)
    assert (study.reason, study.message) == ("budget", f"the budget of 40 rollouts is spent{rest}")


def test_a_target_ends_a_study():
    study = pendulum_problem().study(solver="sobol").run(target=0.05, executor="serial", progress=False)
    assert study.best.value <= 0.05 and study.reason == "target"
    last = study.trials[-1].batch
    assert all(t.value > 0.05 for t in study.trials if t.batch < last)


def test_a_budget_of_time_ends_a_study():
    study = pendulum_problem().study(solver="cmaes").run(seconds=0.3, executor="serial", progress=False)
    assert study.reason == "time" and len(study) > 0


def test_a_solver_that_asks_nothing_new_ends_a_study():
    problem = pendulum_problem(parameters=[Parameter("scenario.stiffness", 0, 1, integer=True)])
    study = problem.study(solver="random").run(rollouts=100, executor="serial", progress=False)
    assert study.reason == "solver" and len(study) == 2


@pytest.mark.parametrize(
    ("budget", "message"),
    [
        ({}, "give rollouts=, seconds= or target="),
        ({"rollouts": 0}, "at least one rollout, not 0"),
        ({"seconds": -1.0}, "positive and finite, not -1.0 s"),
        ({"target": float("nan")}, "a target is a number, not nan"),
        ({"rollouts": 1.5}, "a budget of rollouts must be a whole number, not 1.5"),
        ({"seconds": "3"}, "a budget of wall time must be a number, not '3'"),
    ],
)
def test_a_budget_that_makes_no_sense_is_refused(budget, message):
    with pytest.raises(ValueError, match=message):
        pendulum_problem().study().run(**budget)


def test_points_by_hand_precede_a_design():
    study = pendulum_problem().study(solver="sobol")
    study.add([0.25, 0.0], [0.5, 1.0])
    study.run(rollouts=10, executor="serial", progress=False)
    assert [t.origin for t in study.trials] == ["user"] * 2 + ["solver"] * 8
    # A design that is complete cannot be spared what was added since.
    study.add([0.75, 0.0])
    study.run(rollouts=11, executor="serial", progress=False)
    assert [tuple(t.parameters.values()) for t in study.trials if t.origin == "user"][2:] == [(0.75, 0.0)]


class Thinker(Solver):
    """A solver that asks for one point, and then thinks for ever."""

    def __init__(self, search, *, name, disturb=None):
        super().__init__(search, name=name)
        self._points = [(0.5, 0.5)]
        self._disturb = disturb
        self._never = threading.Event()

    def _next(self):
        if self._points:
            return [self._points.pop()]
        if self._disturb is not None:
            os.kill(os.getpid(), signal.SIGINT)
        self._never.wait()
        return []

    def _learn(self, evaluations, by_hand):
        return

    def close(self):
        self._never.set()


@pytest.mark.parametrize(
    ("disturb", "budget", "reason"),
    [(None, {"seconds": 0.5}, "time"), (1, {"seconds": 60.0}, "interrupted"), (1, {"rollouts": 10}, "interrupted")],
)
def test_a_study_ends_while_its_solver_thinks(tmp_path, monkeypatch, disturb, budget, reason):
    monkeypatch.setitem(CATALOGUE, "thinker", Thinker)
    options = {} if disturb is None else {"disturb": disturb}
    with pendulum_problem().study(tmp_path / "a.db", solver="thinker", options=options) as study:
        study.run(**budget, executor="serial", progress=False)
        assert study.reason == reason and len(study) == len(study.trials) == 1
    with Study.open(tmp_path / "a.db") as again:
        assert again.trials[0].parameters == {THETA: 0.5, RATE: 0.5}


# -- bad input


def test_files_that_are_no_study_are_told_apart_and_left_alone(tmp_path):
    text, other, newer, truncated = (tmp_path / name for name in ("text", "other", "newer", "truncated"))
    text.write_text("point,h\n1,2\n" * 100)
    sqlite3.connect(other).execute("CREATE TABLE something (x)")
    pendulum_problem().study(newer, solver="sobol").run(rollouts=16, executor="serial", progress=False).close()
    truncated.write_bytes(newer.read_bytes()[:9000])
    database = sqlite3.connect(newer)
    database.execute("PRAGMA user_version = 7")
    database.close()
    for path, message in [
        (text, "cannot be read .file is not a database."),
        (other, "SQLite file of another kind"),
        (newer, "a study of version 7, but this vtbdrake reads version 3"),
        (truncated, "cannot be read"),
        (tmp_path / "none", "there is no study file"),
        (tmp_path / "no" / "folder", "there is no study file"),
    ]:
        before = path.read_bytes() if path.exists() else None
        with pytest.raises(StudyError, match=message):
            Study.open(path)
        if path.exists():
            with pytest.raises(StudyError, match=message):
                pendulum_problem().study(path)
        assert (path.read_bytes() if path.exists() else None) == before
    with pytest.raises(StudyError, match="lies in a folder that does not exist"):
        pendulum_problem().study(tmp_path / "no" / "folder.db")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"horizon": 0.4}, r"horizon: 0\.3 there, 0\.4 here"),
        ({"scenario": PendulumScenario(stiffness=2.0)}, r"scenario stiffness: 0\.0 there, 2\.0 here"),
        ({"quality": Quality(gap, THETA, minimize=True, reading="best")}, "reading"),
        ({"parameters": [Parameter(THETA, -1.0, 1.5), Parameter(RATE, -3.0, 3.0)]}, "parameters"),
        ({"conditions": [{DAMPING: 0.3}]}, "conditions"),
        ({"risk": "mean"}, r"risk: 'Worst\(\)' there, 'Mean\(\)' here"),
    ],
)
def test_a_study_of_another_problem_is_refused(tmp_path, change, message):
    path = tmp_path / "a.db"
    pendulum_problem().study(path, solver="sobol").run(rollouts=2, executor="serial", progress=False).close()
    with pytest.raises(StudyError, match=message):
        pendulum_problem(**change).study(path)
    with pytest.raises(StudyError, match="was begun with solver 'sobol', not 'CMA-ES'"):
        pendulum_problem().study(path, solver="cmaes")


def test_a_quality_function_that_has_changed_is_refused(tmp_path):
    path = tmp_path / "a.db"

    def f(theta):
        return theta**2

    pendulum_problem(quality=Quality(f, THETA)).study(path).close()

    def f(theta):
        return theta**4

    with pytest.raises(StudyError, match="the function f has other code"):
        pendulum_problem(quality=Quality(f, THETA)).study(path)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"solver": 3}, "a solver is given by its name, one of auto, "),
        ({"seed": 1.5}, "a seed must be a whole number, not 1.5"),
        ({"seed": True}, "a seed must be a number, not True"),
        ({"parallel": 0}, "parallel is the number of rollouts side by side, at least one, not 0"),
        ({"parallel": 2.5}, "parallel must be a whole number, not 2.5"),
        ({"options": 3}, "the options of a solver are given as {name: value, ...}, not as 3"),
    ],
)
def test_a_study_is_told_what_its_arguments_are(wrong, message):
    with pytest.raises(ValueError, match=message):
        pendulum_problem().study(**wrong)


def test_an_unknown_solver_is_told_the_known_ones(tmp_path):
    with pytest.raises(ValueError, match="did you mean 'CMA-ES'") as error:
        pendulum_problem().study(tmp_path / "a.db", solver="cmeas")
    assert all(name in str(error.value) for name in ("auto", "sobol", "TPE", "SNOPT", "LN_BOBYQA"))
    assert not (tmp_path / "a.db").exists()


def test_a_choice_for_a_gradient_solver_is_refused(tmp_path):
    problem = pendulum_problem(parameters=[Choice(DAMPING, [0.0, 0.5])])
    with pytest.raises(ValueError, match=f"{DAMPING}"):
        problem.study(tmp_path / "a.db", solver="snopt")


@pytest.mark.parametrize("executor", ["serial", "threads", pytest.param("processes", marks=pytest.mark.slow)])
def test_a_quality_function_that_raises_leaves_the_study_whole(tmp_path, executor):
    path = tmp_path / "a.db"
    problem = pendulum_problem(quality=Quality(_raises_beyond, THETA, reading="end"))
    study = problem.study(path, solver="sobol")
    with pytest.raises(QualityError, match="ValueError: too far"):
        study.run(rollouts=64, executor=executor, on_error="raise", progress=False)
    finished = len(study)
    study.close()
    with Study.open(path) as again:
        assert len(again) == finished < 64
        assert all(o.value <= 1.0 for o in again.rollouts.values())
        assert again.sessions[0]["reason"] == "QualityError"


@pytest.mark.parametrize(
    ("executor", "kinds"),
    [("serial", ["raise", "nan", "negative"]), pytest.param("processes", ["raise"], marks=pytest.mark.slow)],
)
def test_a_raising_quality_fails_its_rollout_until_repaired(tmp_path, caplog, executor, kinds):
    path = tmp_path / "a.db"

    def f(theta):
        return {"raise": lambda: 1 / 0, "nan": lambda: np.nan, "negative": lambda: -1.0}[fault]() if theta > 1 else 1.0

    for kind in kinds:
        fault = kind
        path.unlink(missing_ok=True)
        caplog.clear()
        with pendulum_problem(quality=Quality(f, THETA, reading="end")).study(path, solver="sobol") as study:
            study.run(rollouts=32, executor=executor, progress=False)
            failed = [o for o in study.rollouts.values() if o.end == "failed"]
            assert len(study) == len(study.trials) == 32 and study.reason == "solver"
            assert 0 < len(failed) == sum(t.failed for t in study.trials) < 32
            assert all(o.message.startswith("QualityError: the quality function f at t = ") for o in failed)
            (warning,) = [record.getMessage() for record in caplog.records if "on_error='raise'" in record.getMessage()]
            assert failed[0].message.removeprefix("QualityError: ") in warning
            kept = {row: o for row, o in study.rollouts.items() if o.end != "failed"}

    def f(theta):
        return 2.0 if theta > 1 else 1.0

    repaired = pendulum_problem(quality=Quality(f, THETA, reading="end"))
    with pytest.raises(StudyError, match="the function f has other code.*allow_changed_code=True"):
        repaired.study(path)
    with repaired.study(path, allow_changed_code=True) as study:
        study.run(rollouts=32, executor=executor, progress=False)
        assert len(study) == len(study.trials) == 32 and not any(t.failed for t in study.trials)
        assert {row: study.rollouts[row] for row in kept} == kept and study.best.value == 2.0


class MuteError(Exception):
    def __str__(self):
        raise RuntimeError("no text")


def _mute(theta):
    raise MuteError


def _half_a_pair(theta):
    raise ValueError("\ud800")


@pytest.mark.parametrize("executor", ["serial", pytest.param("processes", marks=pytest.mark.slow)])
@pytest.mark.parametrize(("f", "text"), [(_mute, "whose text raises RuntimeError"), (_half_a_pair, "\\ud800")])
def test_messages_that_are_no_text_are_kept_and_do_not_end_a_study(tmp_path, executor, f, text):
    path = tmp_path / "a.db"
    with pendulum_problem(quality=Quality(f, THETA, reading="end")).study(path, solver="sobol") as study:
        study.run(rollouts=4, executor=executor, progress=False)
        assert "4 rollouts failed" in study.summary()
    with Study.open(path) as study:
        assert len(study) == 4 and all(text in outcome.message for outcome in study.rollouts.values())
        with pytest.raises(ValueError, match="an attribute has a name"):
            study.set_attribute("\ud800", 1)


def test_all_failed_rollouts_are_counted_although_their_messages_differ():
    def f(theta):
        return 1.0 / 0.0

    with pendulum_problem(quality=Quality(f, THETA, reading="end")).study(solver="sobol") as study:
        study.run(rollouts=16, executor="serial", progress=False)
        assert "; 16 rollouts failed, the first: QualityError: the quality function f at t = " in study.summary()


def test_what_becomes_of_errors_is_one_of_two(tmp_path):
    with pytest.raises(ValueError, match="on_error is 'record' or 'raise', not 'ignore'"):
        pendulum_problem().study().run(rollouts=1, on_error="ignore")


def _raises_beyond(theta: float) -> float:
    if abs(theta) > 1.0:
        raise ValueError("too far")
    return abs(theta)


def test_given_points_are_checked_at_once(tmp_path):
    study = pendulum_problem().study(tmp_path / "a.db")
    with pytest.raises(ValueError, match=r"outside its range \[-1\.5, 1\.5\]"):
        study.add([2.0, 0.0])
    with pytest.raises(ValueError, match="a point has 2 entries, but the one given has shape"):
        study.add(2.0)
    with pytest.raises(ValueError, match="wrong about nonsense"):
        study.add({THETA: 0.0, RATE: 0.0, "nonsense": 1.0})
    assert study.queue == {}


def test_a_study_says_what_it_is_about_and_what_happened(tmp_path):
    study = (
        pendulum_problem()
        .study(tmp_path / "a.db", solver="sobol", seed=4)
        .run(rollouts=8, executor="serial", progress=False)
    )
    record = study.record
    assert record["seed"] == 4 and record["solver"] == "sobol"
    assert record["problem"]["scenario"]["scenario"] == "tests.testbeds:PendulumScenario"
    assert record["versions"]["drake"] and record["versions"]["python"]
    commit = subprocess.run(["git", "rev-parse", "HEAD"], cwd=ROOT, capture_output=True, text=True)
    assert record["revision"].rstrip("+") == commit.stdout.strip()
    text = study.summary()
    assert "8 points, 8 rollouts" in text and f"gap = {study.best.value:g}" in text


def test_failed_simulations_are_outcomes_and_are_told():
    # A mass that is nearly nothing fails inside Drake.
    problem = Problem(
        scenario=AcrobotScenario(),
        parameters=[Choice("sim.sys.Acrobot.lower_link.mass", [0.0, 0.5, 1.0, 2.0])],
        quality=Quality(abs, "sim.sys.Acrobot.shoulder.position", reading="end"),
        horizon=0.5,
        conditions=[{"sim.sys.Acrobot.upper_link.mass": mass} for mass in (0.0, 1.0)],
    )
    study = problem.study(solver="grid").run(rollouts=24, executor="serial", progress=False)
    failed = {row: o for row, o in study.rollouts.items() if o.end == "failed"}
    assert failed and len(failed) < len(study)
    lost = {point for point, _ in failed}
    assert [t.failed for t in study.trials] == [tuple(t.parameters.values()) in lost for t in study.trials]
    assert next(iter(failed.values())).message in study.summary()


@pytest.mark.slow
@pytest.mark.parametrize("solver", ["SNOPT", *slow("LD_SLSQP")])
def test_an_autodiff_gradient_finds_the_optimum_with_fewer_rollouts(solver):
    fixed = SimulatorConfig(
        integration_scheme="runge_kutta3", max_step_size=0.005, accuracy=1e-3, use_error_control=False
    )
    conditions = [{DAMPING: 0.0}, {DAMPING: 0.4}]

    def miss(theta, rate):
        return (theta - 0.3) ** 2 + 0.1 * (rate - 1.0) ** 2

    problem = pendulum_problem(
        scenario=PendulumScenario(simulator_config=fixed),
        quality=Quality(miss, [THETA, RATE], minimize=True, reading="end"),
        conditions=conditions,
        risk="mean",
    )
    studies = [
        problem.study(solver=solver, options={"gradient": gradient}).run(
            rollouts=400, executor="serial", racing=False, progress=False
        )
        for gradient in ("autodiff", "central")
    ]
    points = [list(study.best.parameters.values()) for study in studies]
    assert points[0] == pytest.approx(points[1], abs=1e-3)
    assert len(studies[0]) < len(studies[1])


def test_a_gradient_that_cannot_be_had_is_refused(tmp_path):
    with pytest.raises(ValueError, match="controls its error"):
        pendulum_problem().study(solver="SNOPT", options={"gradient": "autodiff"}).run(rollouts=10, progress=False)
    field = pendulum_problem(parameters=[Parameter("scenario.stiffness", 0.0, 1.0)])
    with pytest.raises(ValueError, match="there is no derivative by scenario.stiffness"):
        field.study(solver="SNOPT", options={"gradient": "autodiff"}).run(rollouts=10, progress=False)


def test_points_that_wait_can_be_changed_and_taken_back(tmp_path):
    path = tmp_path / "a.db"
    pendulum_problem().study(path, solver="sobol").close()
    with Study.open(path) as study:
        study.add([0.25, 0.0], [0.5, 0.0], [0.75, 0.0])
        first, second, third = study.queue
        assert study.queue[second] == {THETA: 0.5, RATE: 0.0}
        study.edit(second, {THETA: -0.5, RATE: 1.0})
        study.remove(first)
        with pytest.raises(ValueError, match="outside its range"):
            study.edit(third, [7.0, 0.0])
        with pytest.raises(
            StudyError, match=f"no intervention {first} waits in .*; those that wait are: {second}, {third}"
        ):
            study.remove(first)
    with pendulum_problem().study(path) as study:
        study.run(rollouts=6, executor="serial", progress=False)
        given = [tuple(t.parameters.values()) for t in study.trials if t.origin == "user"]
        assert given == [(-0.5, 1.0), (0.75, 0.0)] and study.queue == {}
        with pytest.raises(
            StudyError, match="no intervention 2 of the kind try waits in .*; those that wait are: none"
        ):
            study.edit(second, [0.0, 0.0])


def test_attributes_are_kept_and_come_with_the_table(tmp_path):
    pandas = pytest.importorskip("pandas")
    path = tmp_path / "a.db"
    limit = Constraint(abs, RATE, at_most=2.0)
    with pendulum_problem(constraints=[limit]).study(path, solver="sobol") as study:
        study.run(rollouts=4, executor="serial", progress=False)
        study.set_attribute("operator", "A")
        study.set_attribute("operator", "B")
        study.set_attribute("marks", np.array([1, 2]), point=study.trials[2].parameters)
    with Study.open(path) as study:
        assert study.attributes == {"operator": "B"} and study.trials[2].attributes == {"marks": [1, 2]}
        frame = study.to_dataframe()
        expected = [[t.parameters[THETA], t.parameters[RATE], t.value, t.violations[0]] for t in study.trials]
        np.testing.assert_array_equal(frame[[THETA, RATE, "gap", "violation of abs"]].to_numpy(dtype=float), expected)
        assert frame["attribute marks"].tolist() == [None, None, [1, 2], None] and list(frame.index) == [0, 1, 2, 3]
        assert isinstance(frame, pandas.DataFrame)
        for key, value, point, message in [
            ("", 1, None, "an attribute has a name"),
            ("a", {1j}, None, "a study keeps attributes, which are numbers, words"),
            ("a", 1, [9.0, 0.0], "outside its range"),
        ]:
            with pytest.raises(ValueError, match=message):
                study.set_attribute(key, value, point=point)


def test_callbacks_hear_of_every_trial_once_and_may_stop(tmp_path):
    seen = []

    def note(study, trial):
        seen.append(trial)
        study.set_attribute("number", trial.number, point=trial.parameters)
        if trial.number == 9:
            study.stop()

    study = pendulum_problem().study(tmp_path / "a.db", solver="cmaes")
    study.run(rollouts=40, executor="serial", callbacks=[note], progress=False)
    assert study.reason == "stopped" and 10 <= len(study.trials) < 40
    study.run(rollouts=60, executor="serial", callbacks=[note], progress=False)
    assert study.reason == "budget" and len(study.trials) > 40
    assert [t.parameters for t in seen] == [
        t.parameters for t in sorted(study.trials, key=lambda t: t.attributes["number"])
    ]
    assert len({tuple(t.parameters.values()) for t in seen}) == len(seen) == len(study.trials)

    def broken(study, trial):
        raise ZeroDivisionError("in the callback")

    with pytest.raises(ZeroDivisionError, match="in the callback"):
        study.run(rollouts=70, executor="serial", callbacks=[broken], progress=False)
    with pytest.raises(ValueError, match="a callback is a function of study, trial, not 3"):
        study.run(rollouts=70, callbacks=[3])


def test_a_study_without_a_terminal_logs_its_progress(monkeypatch, caplog):
    monkeypatch.setattr("vtbdrake.optimization.study.study_run.LOG_PERIOD", 0.0)
    caplog.set_level("INFO")
    study = pendulum_problem().study(solver="sobol").run(rollouts=8, executor="serial")
    lines = [record.getMessage() for record in caplog.records if record.name.startswith("vtbdrake.optimization")]
    assert lines[0] == "study (sobol): 1 of 8 rollouts" and lines[-1].startswith("study (sobol): 8 of 8 rollouts")
    caplog.clear()
    study.run(rollouts=9, executor="serial", progress=False)
    assert not caplog.records
