"""Sweeps: where a problem starts, how far its rollouts go, under which condition, and what half a sweep shows."""

from dataclasses import replace

import numpy as np
import pytest

import vtbdrake as vtb
from tests.testbeds import PendulumScenario
from vtbdrake.optimization import Quantile, Risk, Sweep
from vtbdrake.rollout import Executor, QualityError, SerialExecutor

THETA = "sim.sys.Pendulum.theta.position"
OMEGA = "sim.sys.Pendulum.theta.velocity"
DAMPING = "sim.sys.Pendulum.theta.damping"


def _angle(theta):
    return abs(theta)


def _problem(**changes):
    arguments = dict(
        scenario=PendulumScenario(),
        parameters=[vtb.Parameter(OMEGA, 0.0, 8.0)],
        quality=vtb.Quality(_angle, THETA),
        horizon=3.0,
    )
    return vtb.Problem(**{**arguments, **changes})


def test_a_problem_starts_from_its_snapshot():
    scenario = PendulumScenario()
    testbed = scenario.build()
    context = testbed.default_context()
    testbed.write(context, {THETA: 0.7, OMEGA: 5.0, DAMPING: 0.03})
    context.SetTime(2.0)
    problem = _problem(scenario=scenario, start=testbed.snapshot(context), horizon=0.5)
    rollout = problem.rollout([0.25], record=[THETA, OMEGA, DAMPING, "time"])
    first = {address: values[0] for address, values in rollout.record.items()}
    # What is varied is the problem's, all else the snapshot's.
    assert first == {THETA: 0.7, OMEGA: 0.25, DAMPING: 0.03, "time": 2.0}
    assert rollout.times[0] == 0.0
    sweep = problem.sweep(values=[0.25], executor="serial", progress=False)
    np.testing.assert_array_equal(sweep.rollouts[0].quality, rollout.quality)
    assert problem.state([0.25], 0.0)[THETA] == 0.7
    assert problem.motion({OMEGA: 0.25}).states[0].tolist() == [0.7, 0.25]


def test_a_sweep_that_runs_on_has_all_exceedances():
    problem = _problem(threshold=1.0, conditions=[{DAMPING: 0.0}])
    stopped = problem.sweep(values=[2.0, 5.0], executor="serial", progress=False)
    whole = problem.sweep(values=[2.0, 5.0], executor="serial", progress=False, run_on=True)
    assert [rollout.exceedances.size for rollout in stopped.rollouts] == [0, 1]
    below, above = whole.rollouts
    assert below.exceedances.size == 0
    assert above.times[-1] == 3.0
    # It swings to both sides: the quality goes above the threshold, and falls below it again, several times.
    crossings = np.diff(above.quality > 1.0)
    assert np.count_nonzero(crossings) >= 3
    np.testing.assert_array_equal(above.exceedances, above.times[above.quality > 1.0])
    np.testing.assert_array_equal(whole.t_star, stopped.t_star)
    np.testing.assert_array_equal(whole.h, stopped.h)


def test_a_rollout_is_under_the_condition_asked_for():
    problem = _problem(conditions=[{THETA: 0.1}, {THETA: 0.2, DAMPING: 0.5}])
    sweep = problem.sweep(values=[1.0], executor="serial", progress=False)
    for number, theta in enumerate((0.1, 0.2)):
        rollout = problem.rollout([1.0], condition=number, record=[THETA])
        assert rollout.record[THETA][0] == theta
        assert rollout.condition == problem.conditions[number]
        assert rollout.parameters == {**problem.conditions[number], OMEGA: 1.0}
        assert rollout.h == sweep.h[number]
        assert problem.state([1.0], 0.0, condition=number)[THETA] == theta
    assert sweep.h[0] != sweep.h[1]


class Interrupted(Executor):
    """Ctrl-C comes after some rollouts."""

    def __init__(self, rollouts):
        self._rollouts = rollouts

    def run(self, task, points):
        yield from SerialExecutor().run(task, points[: self._rollouts])
        raise KeyboardInterrupt


def test_a_point_with_unfinished_conditions_is_not_the_best():
    problem = _problem(conditions=[{DAMPING: 0.0}, {DAMPING: 1.0}])
    speeds = [1.0, 2.0, 3.0]
    half = problem.sweep(values=speeds, executor=Interrupted(5), progress=False)
    assert half.points[:, 0].tolist() == [1.0, 1.0, 2.0, 2.0, 3.0]
    # The fastest swings highest, but only its first condition is known.
    assert np.argmax(half.h) == 4
    assert (half.best.parameters, half.best.value) == ({OMEGA: 2.0}, half.h[3])
    whole = problem.sweep(values=speeds, executor="serial", progress=False)
    assert (whole.best.parameters, whole.best.value) == ({OMEGA: 3.0}, whole.h[5])
    with pytest.raises(ValueError, match="no point of the sweep has a quality under all conditions"):
        _ = problem.sweep(values=speeds, executor=Interrupted(1), progress=False).best


def test_an_interrupted_sweep_has_no_boundary():
    problem = _problem(threshold=1.0)
    half = problem.sweep(values=[1.0, 2.0, 3.0], executor=Interrupted(2), progress=False)
    assert (len(half), half.complete) == (2, False)
    with pytest.raises(ValueError, match="the sweep was interrupted"):
        half.boundary()
    # If the same rollouts were all, it would be known.
    assert replace(half, complete=True).boundary().lower == 2.0


def test_an_interrupted_sweep_is_still_one_after_its_file(tmp_path):
    half = _problem().sweep(values=[1.0, 2.0], executor=Interrupted(1), progress=False)
    half.save(tmp_path / "half.vtb")
    loaded = Sweep.load(tmp_path / "half.vtb")
    assert not loaded.complete
    with pytest.raises(ValueError, match="the sweep was interrupted"):
        loaded.boundary()


def test_an_interrupted_search_says_nothing():
    with pytest.raises(KeyboardInterrupt):
        _problem(threshold=1.0).boundary(resolution=1.0, coarse=4.0, executor=Interrupted(2), progress=False)


def _speed(omega):
    return abs(omega)


# The risk has no part in what is feasible: each with one of the two.
@pytest.mark.slow_cases
@pytest.mark.parametrize(
    ("risk", "minimize", "limit"),
    [
        ("worst", False, 9.0),
        ("worst", True, 2.0),
        ("mean", False, 2.0),
        (Quantile(0.5), True, 2.0),
        (vtb.CVaR(0.7), False, 2.0),
    ],
)
def test_the_best_of_a_sweep_is_that_of_a_study(risk, minimize, limit, tmp_path):
    problem = _problem(
        parameters=[vtb.Parameter(OMEGA, 0.0, 6.0)],
        quality=vtb.Quality(lambda theta: (theta - 0.4) ** 2, THETA, minimize=minimize, reading="end"),
        conditions=[{DAMPING: 0.0}, {DAMPING: 0.3}, {DAMPING: 1.0, THETA: 0.5}],
        risk=risk,
        constraints=[vtb.Constraint(_speed, OMEGA, at_most=limit)],
        horizon=0.5,
    )
    speeds = [4.0, 1.0, 5.0, 2.0, 3.0, 0.0, 6.0]
    sweep = problem.sweep(values=speeds, executor="serial", progress=False)
    study = problem.study(solver="grid", options={"points": len(speeds)})
    study.run(rollouts=3 * len(speeds), executor="serial", progress=False, racing=False)
    assert sorted(trial.parameters[OMEGA] for trial in study.trials) == sorted(speeds)
    for name in ("parameters", "point", "values", "violations", "exact", "kind"):
        assert getattr(sweep.best, name) == getattr(study.best, name), name
    assert sweep.best.parameters == {OMEGA: speeds[sweep.best.number]}
    # With the lower limit, the fast ones violate the constraint.
    assert any(not trial.feasible for trial in study.trials) == (limit == 2.0)
    sweep.save(tmp_path / "sweep.vtb")
    assert Sweep.load(tmp_path / "sweep.vtb").best == sweep.best


def test_a_sweep_without_a_single_best_point_says_why():
    two = _problem(quality=[vtb.Quality(_angle, THETA), vtb.Quality(_speed, OMEGA)])
    with pytest.raises(ValueError, match="several qualities have no single best point"):
        _ = two.sweep(values=[1.0, 2.0], executor="serial", progress=False).best
    strict = _problem(constraints=[vtb.Constraint(_speed, OMEGA, at_least=50.0)])
    with pytest.raises(ValueError, match="no point .* under all conditions and keeps the constraints"):
        _ = strict.sweep(values=[1.0, 2.0], executor="serial", progress=False).best


class Best(Risk):
    """A class of the user's own."""

    def __call__(self, h):
        return float(max(h))


def test_the_table_of_a_sweep_has_what_decides():
    problem = _problem(
        quality=[vtb.Quality(_angle, THETA), vtb.Quality(_speed, OMEGA)],
        constraints=[vtb.Constraint(_speed, OMEGA, at_most=1.5)],
        horizon=0.1,
    )
    table = problem.sweep(values=[1.0, 2.0], executor="serial", progress=False).to_dict()
    assert table["quality 1"] == [1.0, 2.0]
    assert table["violation 0"] == [-0.5, 0.5]


def test_a_risk_that_a_file_cannot_hold_is_asked_for(tmp_path):
    problem = _problem(conditions=[{DAMPING: 0.0}, {DAMPING: 1.0}], risk=Best(), horizon=0.5)
    sweep = problem.sweep(values=[1.0, 2.0], executor="serial", progress=False)
    sweep.save(tmp_path / "sweep.vtb")
    loaded = Sweep.load(tmp_path / "sweep.vtb")
    with pytest.raises(ValueError, match=r"set it by dataclasses.replace\(sweep, risk=...\)"):
        _ = loaded.best
    assert replace(loaded, risk=Best()).best == sweep.best


def test_values_stay_in_their_order():
    problem = _problem(conditions=[{DAMPING: 0.0}, {DAMPING: 1.0}], horizon=0.2)
    sweep = problem.sweep(values=[3.0, 1.0, 2.0], executor="threads", workers=2, progress=False)
    assert sweep.points[:, 0].tolist() == [3.0, 3.0, 1.0, 1.0, 2.0, 2.0]
    assert sweep.condition.tolist() == [0, 1, 0, 1, 0, 1]
    assert [rollout.parameters[OMEGA] for rollout in sweep.rollouts] == sweep.points[:, 0].tolist()


def test_tiny_costs_have_a_best_point():
    quality = vtb.Quality(lambda omega: 1e-20 * (omega - 2.0) ** 2, OMEGA, minimize=True, reading="worst")
    sweep = _problem(quality=quality, horizon=0.05).sweep(values=[5.0, 2.0, 4.0], executor="serial", progress=False)
    assert len(set(sweep.h.tolist())) == 1
    assert sweep.best.parameters == {OMEGA: 2.0}


def test_a_grid_is_spaced_as_its_parameter_says():
    log = _problem(parameters=[vtb.Parameter(OMEGA, 0.01, 1.0, log=True)], horizon=0.1)
    np.testing.assert_allclose(log.sweep(3, executor="serial", progress=False).points[:, 0], [0.01, 0.1, 1.0])
    whole = _problem(parameters=[vtb.Parameter(OMEGA, 0, 5, integer=True)], horizon=0.1)
    points = whole.sweep(4, executor="serial", progress=False).points[:, 0].tolist()
    assert points == [0.0, 2.0, 3.0, 5.0]
    with pytest.raises(ValueError, match="does not have 7 different whole numbers in equal steps"):
        whole.sweep(7, executor="serial", progress=False)


def _raises_above_two(theta, omega):
    if omega > 2.0:
        raise ValueError("too fast")
    return abs(theta)


def _nan_above_two(theta, omega):
    return np.nan if omega > 2.0 else abs(theta)


@pytest.mark.parametrize(
    ("executor", "f"),
    [
        ("serial", _raises_above_two),
        ("serial", _nan_above_two),
        ("threads", _raises_above_two),
        pytest.param("processes", _nan_above_two, marks=pytest.mark.slow),
    ],
)
def test_points_at_which_f_fails_are_failed_rollouts(executor, f, caplog):
    problem = _problem(quality=vtb.Quality(f, [THETA, OMEGA]), threshold=3.0, horizon=0.2)
    sweep = problem.sweep(values=[0.5, 1.0, 3.0, 4.0], executor=executor, progress=False)
    assert sweep.complete
    assert sweep.failed.tolist() == sweep.unsafe.tolist() == [False, False, True, True]
    assert np.isfinite(sweep.h).tolist() == [True, True, False, False]
    assert sweep.rollouts[2].message.startswith(f"QualityError: the quality function {f.__name__} at t = 0 s")
    assert len(caplog.messages) == 1
    assert caplog.messages[0].endswith(
        "The rollout counts as failed, and so do others of this kind; on_error='raise' ends the run"
    )
    assert str(sweep.boundary()).startswith(f"{OMEGA}: safe up to 1 rad/s, not at 3 rad/s")


def test_f_that_fails_can_end_a_sweep():
    problem = _problem(quality=vtb.Quality(_nan_above_two, [THETA, OMEGA]), horizon=0.2)
    with pytest.raises(QualityError, match="_nan_above_two"):
        problem.sweep(values=[0.5, 3.0], executor="serial", progress=False, on_error="raise")
    with pytest.raises(ValueError, match="on_error is 'record' or 'raise', not 'ignore'"):
        problem.sweep(values=[0.5, 3.0], on_error="ignore")
