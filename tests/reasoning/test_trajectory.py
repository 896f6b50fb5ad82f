"""Trajectories as decisions: their limits between the knots, and their shift in time."""

from __future__ import annotations

import pickle
from functools import cache
from math import inf
from typing import Any

import numpy as np
import pytest
from scipy.optimize import nnls

from vtbdrake.common.spline import ORDERS, Spline
from vtbdrake.optimization import Parameter
from vtbdrake.reasoning import Trajectory

TIMES = np.linspace(0.0, 2.0, 1001)
LIMITS: dict[str, dict[str, Any]] = {
    "zero": {},
    "linear": {"rate": [9.0, 4.0]},
    "cubic": {"rate": [9.0, 4.0], "acceleration": [60.0, 25.0]},
    "bspline": {"rate": [9.0, 4.0], "acceleration": [60.0, 25.0]},
}


@cache
def sampling(order: str) -> np.ndarray:
    return Spline(order, 9, 2.0).matrix(TIMES)


def trajectory(order: str, **changes: Any) -> Trajectory:
    limits = {"lower": [-3.0, -1.0], "upper": [3.0, 2.0], **LIMITS[order], **changes}
    return Trajectory("u.plan", 9, 2.0, order, size=2, **limits)


def assert_kept(plan: Trajectory, knots: np.ndarray) -> None:
    """The limits hold at all times of a dense sampling, by differences of the values alone."""
    y = sampling(plan.order) @ knots.reshape(9, 2)
    step = TIMES[1] - TIMES[0]
    assert (y >= np.array(plan.lower) - 1e-6).all()
    assert (y <= np.array(plan.upper) + 1e-6).all()
    assert (np.abs(np.diff(y, axis=0)) / step <= np.array(plan.rate) * (1 + 1e-4)).all()
    assert (np.abs(np.diff(y, n=2, axis=0)) / step**2 <= np.array(plan.acceleration) * (1 + 1e-4)).all()


@pytest.mark.slow_cases
@pytest.mark.parametrize("start", [None, [3.0, 0.4]])
@pytest.mark.parametrize("order", ORDERS)
def test_limited_trajectories_keep_all_limits_between_the_knots(order: str, start: list[float] | None) -> None:
    plan = trajectory(order)
    rng = np.random.default_rng(1)
    for _ in range(25):
        wild = rng.uniform(-4.0, 4.0, size=18)
        tame = plan.limited(wild, start=start)
        assert tame.shape == (18,)
        assert_kept(plan, tame)
        assert not plan.excess(tame)
        for parameter, value in zip(plan.parameters, tame, strict=True):
            parameter.as_value(value)
        if start is not None:
            np.testing.assert_array_equal(plan.values(tame, [0.0])[0], start)


@pytest.mark.parametrize("order", ["linear", "cubic", "bspline"])
def test_wild_trajectories_exceed_what_limited_ones_keep(order: str) -> None:
    wild = np.random.default_rng(1).uniform(-3.0, 3.0, size=18)
    assert set(trajectory(order).excess(wild)) >= {"rate"}


@pytest.mark.parametrize("order", ORDERS)
def test_a_trajectory_within_its_limits_stays_as_it_is(order: str) -> None:
    plan = trajectory(order)
    once = 0.9 * plan.limited(np.random.default_rng(2).uniform(-4.0, 4.0, size=(9, 2)))
    np.testing.assert_array_equal(plan.limited(once), once)


def test_cubics_that_overshoot_between_good_knots_are_moved() -> None:
    plan = Trajectory("u.plan", 5, 1.0, "cubic", lower=-1.0, upper=1.0)
    knots = np.array([-1.0, 1.0, 1.0, 1.0, -1.0])
    assert plan.values(knots, TIMES).max() > 1.1
    assert plan.values(plan.limited(knots), TIMES).max() <= 1.0 + 1e-6


def test_limited_is_the_nearest_for_one_limit_that_binds() -> None:
    """Two knots whose slope is too steep: each moves by half of the excess."""
    plan = Trajectory("u.plan", 2, 1.0, "linear", lower=-5.0, upper=5.0, rate=1.0)
    np.testing.assert_allclose(plan.limited([0.0, 3.0]), [1.0, 2.0], atol=1e-4)
    np.testing.assert_allclose(plan.limited([0.0, 3.0], start=0.0), [0.0, 1.0], atol=1e-4)


def nearest(plan: Trajectory, knots: np.ndarray) -> np.ndarray:
    """The nearest knots that keep the limits at dense times, by Lawson's and Hanson's least distance programming."""
    S, step = sampling(plan.order)[::10], TIMES[10] - TIMES[0]
    columns = []
    for j in range(2):
        sides = [
            (S, np.asarray(plan.upper)[j]),
            (-S, -np.asarray(plan.lower)[j]),
            *((sign * np.diff(S, axis=0) / step, np.broadcast_to(plan.rate, 2)[j]) for sign in (1.0, -1.0)),
            *(
                (sign * np.diff(S, n=2, axis=0) / step**2, np.broadcast_to(plan.acceleration, 2)[j])
                for sign in (1.0, -1.0)
            ),
        ]
        sides = [(rows, limit) for rows, limit in sides if limit < inf]
        rows = np.concatenate([rows for rows, _ in sides])
        room = np.concatenate([np.full(len(rows), limit) for rows, limit in sides]) - rows @ knots[:, j]
        solution, _ = nnls(np.vstack([-rows.T, -room]), [*np.zeros(9), 1.0])
        residual = np.vstack([-rows.T, -room]) @ solution - [*np.zeros(9), 1.0]
        columns.append(knots[:, j] - residual[:-1] / residual[-1])
    return np.stack(columns, axis=1)


@pytest.mark.parametrize("limits", [{"rate": [9.0, 4.0]}, {"acceleration": [30.0, 10.0]}, LIMITS["cubic"]])
@pytest.mark.parametrize("order", ["cubic", "bspline"])
def test_limited_is_the_nearest_that_keeps_all_limits(order: str, limits: dict[str, Any]) -> None:
    plan = trajectory(order, **{"rate": inf, "acceleration": inf, **limits})
    knots = np.random.default_rng(3).uniform(-3.0, 3.0, size=(9, 2))
    moved, least = plan.limited(knots) - knots, nearest(plan, knots) - knots
    # Between the times, a limit may be exceeded; the limits of Bezier coefficients are a little stricter.
    assert np.linalg.norm(moved, axis=0) == pytest.approx(np.linalg.norm(least, axis=0), rel=0.12)


@pytest.mark.parametrize("order", ["cubic", "bspline"])
def test_limit_far_away_moves_nothing(order: str) -> None:
    knots = np.random.default_rng(3).uniform(-3.0, 3.0, size=(9, 2))
    near, far = (trajectory(order, rate=rate, acceleration=10.0).limited(knots) for rate in (inf, 1e6))
    np.testing.assert_allclose(far, near, atol=1e-4)


@pytest.mark.parametrize("order", ORDERS)
def test_shifted_plan_continues_the_plan_in_use(order: str) -> None:
    plan = trajectory(order)
    knots = plan.limited(np.random.default_rng(4).uniform(-3.0, 3.0, size=18))
    later = plan.shifted(knots, 0.3)
    np.testing.assert_allclose(plan.values(later, [0.0]), plan.values(knots, [0.3]), atol=1e-9)
    np.testing.assert_allclose(plan.values(later, [2.0]), plan.values(knots, [2.0]), atol=0.3)
    assert_kept(plan, later)
    after = plan.shifted(knots, 5.0).reshape(9, 2)
    np.testing.assert_allclose(after, np.tile(knots[-2:], (9, 1)), atol=1e-9)


def test_it_expands_into_parameters_of_its_plan() -> None:
    plan = Trajectory("dps.plan", 2, 1.0, "linear", size=2, lower=[-1.0, -2.0], upper=3.0)
    expected = [Parameter(f"dps.plan[{k}]", lower, 3.0) for k, lower in enumerate([-1.0, -2.0, -1.0, -2.0], 1)]
    assert list(plan.parameters) == expected
    assert plan.begin_address == "dps.plan[0]"
    np.testing.assert_array_equal(plan.plan([[1.0, 2.0], [3.0, 0.0]], 7.5), [7.5, 1.0, 2.0, 3.0, 0.0])


def test_it_travels_to_other_processes_and_compares() -> None:
    plan = trajectory("cubic")
    assert pickle.loads(pickle.dumps(plan)) == plan
    assert plan != trajectory("cubic", upper=[3.0, 2.5])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"order": "zero", "rate": 1.0}, "order 'zero' has no finite rate"),
        ({"order": "linear", "acceleration": 1.0}, "order 'linear' has no finite acceleration"),
        ({"rate": 0.0}, "rate limit of u.plan is positive, not"),
        ({"upper": -3.0}, "lower < upper"),
        ({"upper": float("inf")}, "finite"),
        ({"lower": [1.0, 2.0, 3.0]}, "one for each of its 2 entries"),
        ({"size": 0}, "at least one entry, not 0"),
    ],
)
def test_bad_trajectories_are_refused(changes: dict[str, Any], message: str) -> None:
    arguments = {"order": "cubic", "size": 2, "lower": -3.0, "upper": 3.0, **changes}
    with pytest.raises(ValueError, match=message):
        Trajectory("u.plan", 9, 2.0, **arguments)


@pytest.mark.parametrize("knots", [np.zeros(17), np.zeros((2, 9)), np.full(18, np.nan)])
def test_bad_knots_are_refused(knots: np.ndarray) -> None:
    with pytest.raises(ValueError, match="u.plan"):
        trajectory("cubic").limited(knots)


@pytest.mark.slow_cases
@pytest.mark.parametrize("scale", [1e-6, 1e-3, 1.0, 1e3, 1e6])
@pytest.mark.parametrize("duration", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize("order", ["linear", "cubic", "bspline"])
def test_limits_are_kept_at_any_scale_of_values_and_time(order: str, duration: float, scale: float) -> None:
    rng = np.random.default_rng(5)
    for share in (1e-4, 1e-2, 1.0):
        rate = share * scale / duration
        acceleration = inf if order == "linear" else 10.0 * rate / duration
        plan = Trajectory(
            "u.plan", 8, duration, order, lower=-scale, upper=2.0 * scale, rate=rate, acceleration=acceleration
        )
        for start in (None, 2.0 * scale, 0.3 * scale):
            knots = plan.limited(rng.uniform(-3.0 * scale, 3.0 * scale, 8), start=start)
            assert plan.excess(knots) == {}
            times = np.linspace(0.0, duration, 400)
            for derivative, limit in enumerate((2.0 * scale, rate, acceleration)):
                assert np.abs(plan.values(knots, times, derivative)).max() <= limit * (1.0 + 1e-9)
            # They use what is allowed.
            assert np.abs(plan.values(knots, times, 1)).max() > 0.3 * rate or share == 1.0
