"""Interventions: a study that is changed while it runs repeats itself, and can be had without one of them."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest

from tests.folders import open_folder, that_cannot_be_written
from tests.optimization.studies import (
    DAMPING,
    RATE,
    THETA,
    DoubleIntegratorScenario,
    StatedExecutor,
    gap,
    pendulum_problem,
)
from vtbdrake.optimization import Choice, Parameter, Problem, Study, StudyError
from vtbdrake.rollout import Quality, SerialExecutor
from vtbdrake.visualization.study_plots import Points

ROOT = Path(__file__).resolve().parents[3]

X = "sim.sys.mass.continuous_state[0]"
SERIAL = {"executor": "serial", "progress": False}


def table(study: Study) -> list[tuple]:
    return [(trial.point, trial.values, trial.origin, trial.method, trial.batch) for trial in study.trials]


def intervening(*changes):
    """Return a callback that makes each change, (kind, payload), after a number of further trials."""

    def intervene(study: Study, trial) -> None:
        for number, kind, payload in changes:
            if trial.number == number:
                study.intervene(kind, by="Ada", **payload)

    return intervene


# Solvers that fit a Gaussian process.
FITTING = [pytest.param(name, marks=pytest.mark.slow) for name in ("auto", "bayesian")]

CHANGES = [
    (6, "range", {"address": THETA, "lower": -0.5, "upper": 1.0}),
    (6, "try", {"point": {THETA: 0.2, RATE: 0.1}}),
    (12, "forbid", {"region": {THETA: [0.0, 0.2], RATE: [-1.0, 1.0]}}),
    (14, "budget", {"rollouts": 40}),
    (18, "freeze", {"address": RATE, "value": 0.25}),
    (22, "unfreeze", {"address": RATE}),
    (25, "range", {"address": THETA, "lower": -2.0}),
]


@pytest.mark.slow_cases
@pytest.mark.parametrize(
    "solver", ["cmaes", "sobol", "SNOPT", *(pytest.param(name, marks=pytest.mark.slow) for name in ("auto", "TPE"))]
)
def test_a_study_with_interventions_is_replayed_to_the_last_bit(tmp_path, solver):
    if solver == "TPE":
        pytest.importorskip("optuna")
    study = pendulum_problem().study(tmp_path / "a.db", solver=solver, seed=1)
    study.run(rollouts=30, callbacks=[intervening(*CHANGES)], **SERIAL)
    assert len(study) == 40 and [i.name for i in study.interventions] == ["Ada"] * 7
    again = study.replay(tmp_path / "b.db", reuse=False, executor="threads", workers=2, progress=False)
    assert table(again) == table(study)
    assert again.interventions == study.interventions


@pytest.mark.slow
def test_a_change_of_another_process_has_its_effect_on_the_next_batch(tmp_path):
    """Another process narrows the range while this one runs; then every new point of the solver lies in it."""
    path = tmp_path / "a.db"
    code = (
        "import sys\nfrom vtbdrake.optimization import Study\n"
        f"with Study.open({str(path)!r}) as study:\n"
        f"    study.intervene('range', by='Eve', address={THETA!r}, lower=0.5, upper=1.0)\n"
    )

    def narrow(study, trial):
        if trial.number == 5:
            subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True)

    study = pendulum_problem().study(path, solver="cmaes", seed=1)
    study.run(rollouts=36, callbacks=[narrow], **SERIAL)
    (intervention,) = study.interventions
    assert intervention.name == "Eve" and intervention.batch == 1
    inside = [0.5 <= trial.parameters[THETA] <= 1.0 for trial in study.trials if trial.batch >= 1]
    assert len(inside) > 20 and all(inside)
    assert not all(0.5 <= trial.parameters[THETA] <= 1.0 for trial in study.trials if trial.batch == 0)
    # Told of the first batch, the method does not fall behind it within the range.
    assert study.search.ranges[0] == Parameter(THETA, 0.5, 1.0)


def test_a_paused_run_asks_nothing_until_another_process_resumes_it(tmp_path):
    path = tmp_path / "a.db"
    study = pendulum_problem().study(path, solver="cmaes", seed=1)
    paused = threading.Event()

    def pause(study, trial):
        if trial.number == 5:
            study.pause(by="Ada")
            paused.set()

    runner = threading.Thread(target=study.run, kwargs={"rollouts": 18, "callbacks": [pause], **SERIAL})
    runner.start()
    assert paused.wait(60.0)
    with Study.open(path) as page:
        while page.interventions[0].batch is None:  # Until the run has noticed it.
            runner.join(0.01)
        assert page.search.paused and page.is_running and len(page) == 6 and runner.is_alive()
        with pytest.raises(ValueError, match="paused already"):
            page.pause()
        page.resume()
    runner.join(60.0)
    assert study.reason == "budget" and len(study) == 18 and not study.search.paused
    whole = pendulum_problem().study(solver="cmaes", seed=1).run(rollouts=18, **SERIAL)
    assert table(study) == table(whole)


def test_a_pause_outlives_its_run_and_ends_at_the_deadline(tmp_path):
    path = tmp_path / "a.db"
    with pendulum_problem().study(path, solver="cmaes", seed=1) as study:
        study.pause(by="Ada")
    with pendulum_problem().study(path) as study:
        study.run(rollouts=12, seconds=0.3, **SERIAL)
        assert study.reason == "time" and len(study) == 0
        study.resume()
        study.run(rollouts=12, **SERIAL)
        assert len(study) == 12
        assert "paused" not in study.replay(progress=False).summary()


@pytest.mark.slow
@pytest.mark.one_python
def test_a_study_that_is_killed_and_changed_repeats_itself(tmp_path):
    """The run is killed within a batch; changes that wait then belong to the batch after it."""
    path = tmp_path / "killed.db"
    for k, lower in enumerate((-1.0, -0.5)):
        process = subprocess.Popen(
            [sys.executable, "-m", "tests.optimization.studies", str(path), "serial"],
            cwd=ROOT,
            stdout=subprocess.PIPE,
            text=True,
        )
        with process:
            assert process.stdout is not None and process.stdout.readline() == "ready\n"
            while _rollouts(path) < 20 * (k + 1):
                assert process.poll() is None
            with Study.open(path) as study:
                study.intervene("range", address=THETA, lower=lower)
            while _rollouts(path) < 20 * (k + 1) + 15:
                assert process.poll() is None
            process.send_signal(signal.SIGKILL)
        with Study.open(path) as study:
            study.add([1.0, k])
            study.intervene("forbid", region={RATE: [-3.0, -2.5 + k]})
    with pendulum_problem().study(path) as study:
        study.run(rollouts=len(study) + 20, **SERIAL)
        batches = [intervention.batch for intervention in study.interventions]
        assert None not in batches and batches == sorted(batches)
        assert study.search.ranges[0] == Parameter(THETA, -0.5, 1.5)
        # No rollout belongs to no trial: the batch that was interrupted was finished as it was begun.
        assert {(trial.point, 0) for trial in study.trials} == set(study.rollouts)
        again = study.replay(reuse=False, executor="threads", workers=2, progress=False)
        assert table(again) == table(study) and len(again) == len(study)


def _rollouts(path):
    try:
        with Study.open(path) as study:
            return len(study)
    except StudyError:
        return 0


def test_without_an_intervention_a_study_is_what_it_would_have_been(tmp_path):
    changes = [(6, "freeze", {"address": RATE, "value": 1.0}), (20, "range", {"address": THETA, "upper": 1.0})]
    study = pendulum_problem().study(tmp_path / "a.db", solver="cmaes", seed=1)
    study.run(rollouts=36, callbacks=[intervening(*changes)], **SERIAL)
    freeze, narrow = study.interventions
    counted = []

    class Counting(SerialExecutor):
        def run(self, task, points):
            counted.extend(points)
            return super().run(task, points)

    undone = study.replay(
        tmp_path / "b.db", without=[freeze.number, narrow.number], executor=Counting(), progress=False
    )
    whole = pendulum_problem().study(solver="cmaes", seed=1).run(rollouts=36, **SERIAL)
    assert table(undone) == table(whole) and undone.interventions == ()
    # The first batch is common to both, and was not simulated again.
    assert 0 < len(counted) == len(undone.rollouts.keys() - study.rollouts.keys()) < 36

    kept_first = study.replay(without=[narrow.number], executor="serial", progress=False)
    assert kept_first.interventions == (freeze,)
    first = [row for row in table(study) if row[4] < narrow.batch]
    assert table(kept_first)[: len(first)] == first


@pytest.mark.slow_cases
@pytest.mark.one_python
@pytest.mark.parametrize("solver", [*FITTING, "TPE", "NSGA-II", "cmaes", "differential-evolution", "CEM"])
def test_nothing_is_simulated_in_a_forbidden_region(solver):
    if solver in ("TPE", "NSGA-II"):
        pytest.importorskip("optuna")
    study = pendulum_problem().study(solver=solver, seed=1)
    # The optimum lies in it.
    study.intervene("forbid", region={THETA: [0.0, 0.6], RATE: [-1.0, 1.0]})
    study.run(rollouts=40, **SERIAL)
    assert len(study) == 40
    points = [trial.parameters for trial in study.trials]
    assert not any(0.0 <= p[THETA] <= 0.6 and -1.0 <= p[RATE] <= 1.0 for p in points)


def test_a_forbidden_point_is_no_longer_the_best_until_it_is_allowed():
    study = pendulum_problem().study(solver="sobol", seed=1).run(rollouts=16, **SERIAL)
    study.intervene("budget", rollouts=24)
    best = study.best
    region = {address: [x - 0.01, x + 0.01] for address, x in best.parameters.items()}
    number = study.intervene("forbid", region=region).number
    others = [trial for trial in study.trials if trial != best]
    assert study.best == min(others, key=lambda trial: trial.value)
    assert Points.of(study).best(study, 0) == study.best
    study.intervene("allow", number=number)
    assert study.best == best


@pytest.mark.one_python
@pytest.mark.slow
def test_a_race_is_not_won_by_a_forbidden_point():
    """The best point by far is forbidden; racing must not compare the others with it."""
    conditions = [{DAMPING: damping} for damping in (0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7)]
    problem = pendulum_problem(conditions=conditions, quality=Quality(gap, THETA, minimize=True, reading="end"))

    def forbid(study, trial):
        if trial.number == 0:
            study.intervene("forbid", region={THETA: [0.1, 0.5]})

    study = problem.study(solver="cmaes", seed=2)
    study.add([0.3, 0.0])
    study.run(rollouts=120, racing=True, callbacks=[forbid], **SERIAL)
    later = [trial for trial in study.trials if trial.batch > 0]
    assert any(trial.exact for trial in later) and any(not trial.exact for trial in later)
    assert study.best.batch > 0 and study.best.exact
    assert table(study.replay(reuse=False, executor="serial", progress=False)) == table(study)


def test_a_frozen_parameter_keeps_its_value_and_defaults_to_that_of_the_best():
    study = pendulum_problem().study(solver="cmaes", seed=1)
    best = []

    def freeze(study, trial):
        if trial.number == 11:
            best.append(study.best.parameters[RATE])
            study.intervene("freeze", address=RATE)

    study.run(rollouts=30, callbacks=[freeze], **SERIAL)
    later = {trial.parameters[RATE] for trial in study.trials if trial.batch >= study.interventions[0].batch}
    assert later == {best[0]}


def test_a_widened_range_is_searched_beyond_that_of_the_problem():
    problem = pendulum_problem(parameters=[Parameter(THETA, -1.5, 0.0), Parameter(RATE, -0.5, 0.5)])
    study = problem.study(solver="cmaes", seed=1)
    study.run(rollouts=60, callbacks=[intervening((11, "range", {"address": THETA, "upper": 1.5}))], **SERIAL)
    assert study.best.parameters[THETA] > 0.1
    assert study.parameters == (Parameter(THETA, -1.5, 1.5), Parameter(RATE, -0.5, 0.5))
    # What is found there can be simulated.
    assert study.problem.rollout(study.best.parameters).value == study.best.value


def test_another_budget_lets_the_method_go_on():
    """A study whose budget was raised on its way is the study of the larger budget, for a method without a plan."""
    for solver in ("cmaes", "sobol"):
        raised = pendulum_problem().study(solver=solver, seed=1)
        raised.run(rollouts=18, callbacks=[intervening((7, "budget", {"rollouts": 36}))], **SERIAL)
        whole = pendulum_problem().study(solver=solver, seed=1).run(rollouts=36, **SERIAL)
        assert [trial.point for trial in raised.trials] == [trial.point for trial in whole.trials]


def test_a_finished_study_goes_on_with_a_larger_budget(tmp_path, caplog):
    path = tmp_path / "a.db"
    with pendulum_problem().study(path, solver="cmaes", seed=1) as study:
        study.run(rollouts=15, **SERIAL)
        with pytest.raises(StudyError, match="is finished .*by budget, with 15 rollouts.*larger budget"):
            study.intervene("freeze", address=RATE, value=0.0)
        with pytest.raises(StudyError, match="is finished"):
            study.pause()
        study.intervene("budget", rollouts=30, by="Ada")
        study.intervene("freeze", address=RATE, value=0.0)
        # The command that began it is also the one that goes on.
        study.run(rollouts=15, **SERIAL)
        assert len(study) == 30 and "the budget of 30 rollouts (intervention 1) holds" in caplog.text
        assert table(study.replay(reuse=False, executor="serial", progress=False)) == table(study)


def test_a_pause_that_came_too_late_can_be_taken_back():
    """Within the last batch, which the budget cuts, someone pauses."""
    study = pendulum_problem(conditions=[{DAMPING: 0.1 * k} for k in range(4)]).study(solver="cmaes", seed=1)

    class Pausing(SerialExecutor):
        def run(self, task, points):
            study.pause()
            return super().run(task, points)

    study.run(rollouts=10, racing=False, executor=Pausing(), progress=False)
    assert study.reason == "budget" and study.search.paused
    study.resume()
    assert not study.search.paused
    with pytest.raises(ValueError, match="the study is not paused"):
        study.resume()


def test_a_smaller_budget_ends_the_run():
    study = pendulum_problem().study(solver="cmaes", seed=1)
    study.run(rollouts=600, callbacks=[intervening((11, "budget", {"rollouts": 20}))], **SERIAL)
    assert study.reason == "budget" and len(study) == 20
    assert study.message == "the budget of 20 rollouts (intervention 1) is spent"


def test_a_stop_ends_one_run_and_says_who_did_it(tmp_path):
    study = pendulum_problem().study(tmp_path / "a.db", solver="cmaes", seed=1)
    with pytest.raises(StudyError, match="no process runs .*a.db: there is nothing to stop"):
        study.stop()
    study.run(rollouts=60, callbacks=[intervening((7, "stop", {}))], **SERIAL)
    assert (study.reason, study.message) == ("stopped", "Ada stopped it (intervention 1)")
    study.run(rollouts=60, **SERIAL)
    assert study.reason == "budget" and len(study) == 60


def test_a_new_solver_goes_on_where_another_stopped():
    study = pendulum_problem().study(solver="sobol", seed=1)
    study.run(rollouts=120, callbacks=[intervening((60, "solver", {"solver": "cmaes"}))], **SERIAL)
    methods = [trial.method for trial in study.trials]
    assert methods == ["sobol"] * 64 + ["CMA-ES"] * (len(methods) - 64)
    first = next(trial for trial in study.trials if trial.method == "CMA-ES")
    assert study.best.method == "CMA-ES" and study.best.value < first.value


def test_a_point_that_was_run_elsewhere_becomes_a_trial_without_a_rollout(tmp_path):
    path = tmp_path / "a.db"
    study = pendulum_problem().study(path, solver="cmaes", seed=1)
    point = {THETA: 0.25, RATE: 0.5}
    result = pendulum_problem().rollout(point)

    def try_it(study, trial):
        if trial.number == 5:
            with Study.open(path) as page:
                page.add_results(point, [result], by="Eve")
                with pytest.raises(ValueError, match="one rollout per condition, 1, not 2"):
                    page.add_results(point, [result, result])

    class Refusing(SerialExecutor):
        def run(self, task, points):
            assert point not in [dict(values) for values in points]
            return super().run(task, points)

    study.run(rollouts=24, callbacks=[try_it], executor=Refusing(), progress=False)
    (trial,) = [trial for trial in study.trials if trial.origin == "user"]
    assert (trial.parameters, trial.value, trial.method, trial.batch) == (point, result.value, "by hand", 1)
    assert len(study) == 24
    assert table(study.replay(reuse=False, executor="serial", progress=False)) == table(study)


def _schaffer(values):
    """Return two costs, x^2 + y^2 and (x - 2)^2 + y^2, whose Pareto front is at 0 <= x <= 2 and y = 0."""
    x, y = values[THETA], values[RATE]
    return x**2 + y**2, ((x - 2.0) ** 2 + y**2,)


@pytest.mark.slow
@pytest.mark.one_python
def test_an_aspiration_leads_to_the_point_of_the_front_at_which_it_aims():
    end = {"minimize": True, "reading": "end"}
    problem = pendulum_problem(
        parameters=[Parameter(THETA, -3.0, 3.0), Parameter(RATE, -3.0, 3.0)],
        quality=[Quality(float, THETA, **end), Quality(float, RATE, **end)],
    )
    settings = {"rollouts": 60, "progress": False, "executor": StatedExecutor(_schaffer)}
    front = problem.study(solver="bayesian", seed=1).run(**settings)
    sums = np.zeros(2)
    for x in (0.5, 1.5):
        aim = (11, "aspiration", {"targets": [x**2, (x - 2.0) ** 2]})
        study = problem.study(solver="bayesian", seed=1).run(callbacks=[intervening(aim)], **settings)
        for k, run in enumerate((study, front)):
            sums[k] += np.sort([np.hypot(trial.point[0] - x, trial.point[1]) for trial in run.trials])[:6].mean()
        assert table(study.replay(reuse=False, executor=settings["executor"], progress=False)) == table(study)
    # The six nearest points are near, and nearer than the points of a study that spreads over the whole front.
    assert sums[0] < min(0.1, 0.6 * sums[1])


@pytest.mark.parametrize(
    ("kind", "payload", "message"),
    [
        ("narrow", {}, "there is no intervention 'narrow'; there are pause, resume"),
        ("range", {"lower": 0.0}, "range takes address=, lower=, upper=, options=, not lower="),
        ("range", {"address": "nonsense", "lower": 0.0}, "varies no parameter 'nonsense'; it varies"),
        ("range", {"address": THETA, "lower": 1.0, "upper": 1.0}, "must be finite and not empty"),
        ("range", {"address": THETA, "lower": 1.0, "upper": 0.0}, "must be finite and not empty"),
        ("range", {"address": DAMPING, "lower": -1.0}, r"\[-1, 1\] of .* exceeds its bounds \[0, inf\]"),
        ("range", {"address": THETA, "lower": "low"}, "must be a number, not 'low'"),
        ("range", {"address": THETA, "options": [1.0, 2.0]}, "is a number: give lower= and upper="),
        ("range", {"address": THETA, "lower": np.nan}, "must be finite and not empty"),
        ("freeze", {"address": THETA, "value": 2.0}, r"outside its range \[-1\.5, 1\.5\]"),
        ("unfreeze", {"address": THETA}, "is not frozen; frozen are: none"),
        ("forbid", {"region": {}}, "a region is given as"),
        ("forbid", {"region": {THETA: [-2.0, 2.0]}}, "cover all that is searched: no point is left"),
        ("forbid", {"region": {THETA: [None, None], RATE: [None, None]}}, "cover all that is searched"),
        ("forbid", {"region": {THETA: [2.0, 3.0]}}, "outside of all that is searched, and forbids nothing"),
        ("forbid", {"region": {THETA: [1.0, 0.0]}}, r"the side \[1, 0\] of the region along .* is empty"),
        ("forbid", {"region": {THETA: 1.0}}, r"a side of a region is \[lower, upper\]"),
        ("forbid", {"region": {"nonsense": [0.0, 1.0]}}, "varies no parameter 'nonsense'"),
        ("allow", {"number": 7}, "there is no forbidden region 7; the forbidden regions are: none"),
        ("budget", {"rollouts": 0}, "a budget is at least one rollout, not 0"),
        ("budget", {"rollouts": "many"}, "must be a number, not 'many'"),
        ("solver", {"solver": "nonsense"}, "there is no solver 'nonsense'"),
        ("solver", {"solver": "cmaes", "options": {"popsize": 3}}, "CMA-ES has no option 'popsize'"),
        ("solver", {"solver": "SNOPT", "options": {"gradient": "autodiff"}}, "SNOPT takes derivatives of the testbed"),
        ("try", {"point": [0.0]}, "a point has 3 entries"),
        ("try", {"point": [2.0, 0.0, 0.1]}, "outside its range"),
        ("aspiration", {"targets": [1.0]}, "an aspiration belongs to several qualities"),
        ("resume", {}, "the study is not paused"),
    ],
)
def test_an_intervention_that_makes_no_sense_is_refused_and_leaves_no_row(kind, payload, message):
    parameters = [Parameter(THETA, -1.5, 1.5), Parameter(RATE, -3.0, 3.0), Parameter(DAMPING, 0.05, 1.0)]
    study = pendulum_problem(parameters=parameters).study(solver="cmaes")
    with pytest.raises(ValueError, match=message):
        study.intervene(kind, **payload)
    assert study.interventions == ()


def test_a_range_may_be_all_that_the_testbed_allows():
    study = pendulum_problem(parameters=[Parameter("u.angle", -1.0, 1.0)]).study(solver="cmaes")
    study.intervene("range", address="u.angle", lower=-np.pi, upper=np.pi)
    assert (study.search.ranges[0].lower, study.search.ranges[0].upper) == (-np.pi, np.pi)
    for end in ("lower", "upper"):
        with pytest.raises(ValueError, match="exceeds its bounds"):
            study.intervene("range", address="u.angle", **{end: 3.2 if end == "upper" else -3.2})


def test_a_study_that_was_begun_with_derivatives_is_narrowed():
    study = pendulum_problem().study(solver="SNOPT", options={"gradient": "autodiff"})
    study.intervene("range", address=THETA, lower=0.0)
    assert study.search.ranges[0] == Parameter(THETA, 0.0, 1.5)


def test_a_design_is_cut_to_the_rest_of_the_budget():
    study = pendulum_problem().study(solver="grid", options={"points": [5, 4]})
    narrow = (11, "range", {"address": THETA, "lower": 0.1})
    executor = StatedExecutor(lambda values: (values[THETA], ()))
    study.run(rollouts=20, callbacks=[intervening(narrow)], executor=executor, progress=False)
    assert len(study) == 20 and study.reason == "budget"
    assert all(trial.parameters[THETA] >= 0.1 for trial in study.trials if trial.batch >= 1)


@pytest.mark.parametrize(
    ("solver", "options", "kind", "payload", "message"),
    [
        (
            "grid",
            {"points": [4, 4, 2]},
            "freeze",
            {"address": RATE, "value": 0.0},
            "one number per parameter, 2, not 3",
        ),
        ("grid", {}, "solver", {"solver": "LN_BOBYQA"}, "LN_BOBYQA varies continuous parameters, but .* CMA-ES can"),
        ("CMA-ES", {}, "solver", {"solver": "QMC", "options": {"batch": 0}}, "a batch has at least 1 point"),
    ],
)
def test_what_a_solver_cannot_search_is_refused_by_its_name(solver, options, kind, payload, message):
    parameters = [Parameter(THETA, -1.5, 1.5), Parameter(RATE, -3, 3), Parameter(DAMPING, 0, 1, integer=True)]
    study = pendulum_problem(parameters=parameters).study(solver=solver, options=options)
    with pytest.raises(ValueError, match=message):
        study.intervene(kind, **payload)
    assert study.interventions == ()


def test_a_method_for_one_quality_needs_an_aspiration():
    end = {"minimize": True, "reading": "end"}
    study = pendulum_problem(quality=[Quality(gap, THETA, **end), Quality(abs, RATE, **end)]).study()
    with pytest.raises(ValueError, match="COBYQA takes one objective, not 2"):
        study.intervene("solver", solver="COBYQA")
    with pytest.raises(ValueError, match="one value per quality, 2, not .0.1."):
        study.intervene("aspiration", targets=[0.1])
    study.intervene("aspiration", targets=[0.1, 0.2])
    study.intervene("solver", solver="COBYQA")
    with pytest.raises(ValueError, match="COBYQA takes one objective, not 2"):
        study.intervene("aspiration", targets=None)


def test_regions_that_cover_everything_only_together_are_refused():
    study = pendulum_problem().study(solver="cmaes")
    study.intervene("forbid", region={THETA: [None, 0.0]})
    study.intervene("forbid", region={THETA: [0.0, None], RATE: [0.0, None]})
    with pytest.raises(ValueError, match="cover all"):
        study.intervene("forbid", region={THETA: [-0.5, None], RATE: [None, 0.0]})
    with pytest.raises(ValueError, match="cover all"):
        study.intervene("range", address=THETA, upper=0.0)
    with pytest.raises(ValueError, match="cover all"):
        study.intervene("freeze", address=THETA, value=-1.0)
    study.intervene("freeze", address=THETA, value=1.0)
    with pytest.raises(ValueError, match="no parameter is left to vary"):
        study.intervene("freeze", address=RATE, value=-1.0)


def test_a_change_that_others_need_cannot_be_taken_back_or_left_out():
    study = pendulum_problem().study(solver="cmaes", seed=1)
    freeze = study.intervene("freeze", address=RATE, value=0.0).number
    study.intervene("unfreeze", address=RATE)
    with pytest.raises(ValueError, match="unfreeze .intervention 2.*not frozen"):
        study.remove(freeze)
    study.run(rollouts=12, **SERIAL)
    with pytest.raises(ValueError, match="unfreeze .intervention 2.*not frozen"):
        study.replay(without=[freeze], progress=False)
    with pytest.raises(ValueError, match=r"no intervention 9 can be left out; those with an effect are: \[1, 2\]"):
        study.replay(without=[9], progress=False)
    with pytest.raises(StudyError, match="no intervention 1 waits"):
        study.remove(freeze)


def test_choices_integers_and_fields_are_narrowed_and_forbidden():
    problem = Problem(
        scenario=DoubleIntegratorScenario(),
        parameters=[
            Choice("scenario.damping", [0.5, 1.0, 2.0]),
            Parameter("scenario.stiffness", 0.5, 1.5),
            Parameter(X, -1, 2, integer=True),
        ],
        quality=Quality(abs, X, minimize=True, reading="end"),
        horizon=0.2,
    )
    study = problem.study(solver="bayesian", seed=1)
    with pytest.raises(ValueError, match="at least two different options"):
        study.intervene("range", address="scenario.damping", options=[0.5])
    with pytest.raises(ValueError, match="is one of"):
        study.intervene("range", address="scenario.damping", options=[0.5, 7.0])
    with pytest.raises(ValueError, match="is a choice: give options="):
        study.intervene("range", address="scenario.damping", lower=0.5)
    with pytest.raises(ValueError, match=r"exceeds \[0\.5, 1\.5\], the problem's range; a field of the scenario"):
        study.intervene("range", address="scenario.stiffness", upper=2.0)
    study.intervene("range", address="scenario.damping", options=[0.5, 2.0])
    study.intervene("forbid", region={"scenario.damping": [2.0], X: [-0.5, None]})
    with pytest.raises(ValueError, match="cover all"):
        study.intervene("forbid", region={X: [-1, 2]})
    study.intervene("freeze", address=X, value=1)
    study.run(rollouts=6, **SERIAL)
    assert {(trial.point[0], trial.point[2]) for trial in study.trials} == {(0.5, 1)}


def test_a_study_in_a_folder_that_cannot_be_written_is_read_and_not_changed():
    with open_folder() as folder:
        path = folder / "a.db"
        pendulum_problem().study(path, solver="cmaes").close()
        with that_cannot_be_written(folder), Study.open(path) as study:
            assert (study.search.solver, study.interventions) == ("CMA-ES", ())
            with pytest.raises(StudyError, match="the permissions of the file and its folder"):
                study.intervene("freeze", address=RATE, value=0.0)


class Interrupting(StatedExecutor):
    """An executor in which Ctrl-C arrives before a rollout."""

    def __init__(self, outcome, *, before: int) -> None:
        super().__init__(outcome)
        self._left = before

    def run(self, task, points):
        for result in super().run(task, points):
            if self._left == 0:
                raise KeyboardInterrupt
            self._left -= 1
            yield result


@pytest.mark.slow_cases
@pytest.mark.parametrize("before", [3, 8, 14])
def test_a_batch_that_was_interrupted_is_finished_as_it_was_begun(tmp_path, before):
    """In a race, a second point would change which rollouts the first one takes."""

    def outcome(values):
        return abs(values[THETA] - 0.3) + values[DAMPING], ()

    conditions = [{DAMPING: 0.1 * k} for k in range(10)]
    problem = pendulum_problem(conditions=conditions, quality=Quality(gap, THETA, minimize=True, reading="end"))
    study = problem.study(tmp_path / "a.db", solver="cmaes", seed=1)
    study.add([0.2, 0.0])
    study.run(rollouts=120, racing=True, executor=Interrupting(outcome, before=before), progress=False)
    assert study.reason == "interrupted" and len(study) == before
    study.add([0.3, 0.0])
    study.intervene("range", address=THETA, lower=0.0)
    study.run(rollouts=120, racing=True, executor=StatedExecutor(outcome), progress=False)
    assert [intervention.batch for intervention in study.interventions] == [0, 1, 1]
    again = study.replay(reuse=False, executor=StatedExecutor(outcome), progress=False)
    assert table(again) == table(study)
    complete = {trial.point for trial in study.trials}
    assert {key for key in study.rollouts if key[0] in complete} == {
        key for key in again.rollouts if key[0] in complete
    }


@pytest.mark.slow
@pytest.mark.one_python
def test_a_long_design_goes_on_behind_its_known_points_and_counts_none_twice():
    executor = StatedExecutor(lambda values: (values[THETA], ()))
    study = pendulum_problem().study(solver="sobol", seed=1)
    forbid = (3500, "forbid", {"region": {THETA: [0.0, 1.4]}})
    study.run(rollouts=3700, callbacks=[intervening(forbid)], executor=executor, progress=False)
    assert len(study.trials) == len({trial.point for trial in study.trials}) == 3700
    last = [trial.parameters[THETA] for trial in study.trials if trial.batch >= study.interventions[0].batch]
    assert len(last) > 100 and not any(0.0 <= theta <= 1.4 for theta in last)


@pytest.mark.slow
def test_a_larger_budget_of_run_makes_the_changes_at_the_same_batches(tmp_path):
    study = pendulum_problem().study(tmp_path / "a.db", solver="cmaes", seed=1)
    changes = [(7, "range", {"address": THETA, "lower": 0.0}), (13, "freeze", {"address": RATE, "value": 0.25})]
    study.run(rollouts=24, callbacks=[intervening(*changes)], **SERIAL)
    study.run(rollouts=48, **SERIAL)
    whole = (
        pendulum_problem().study(seed=1, solver="cmaes").run(rollouts=48, callbacks=[intervening(*changes)], **SERIAL)
    )
    assert [trial.point for trial in study.trials] == [trial.point for trial in whole.trials]
