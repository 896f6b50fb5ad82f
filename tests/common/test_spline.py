"""Splines against SciPy, Drake and dense sampling."""

from __future__ import annotations

import numpy as np
import pytest
from pydrake.math import BsplineBasis, KnotVectorType
from pydrake.trajectories import BsplineTrajectory
from scipy.interpolate import CubicSpline, interp1d, make_interp_spline

from vtbdrake.common.spline import ORDERS, Spline

DURATION, KNOTS = 1.3, 7
TIMES = np.linspace(0.0, DURATION, 1001)
W = np.random.default_rng(3).normal(size=(KNOTS, 2))
GRID = np.linspace(0.0, DURATION, KNOTS)


def test_steps_hold_each_knot_for_its_piece() -> None:
    times = np.linspace(0.0, DURATION, KNOTS + 1)
    expected = interp1d(times, np.vstack((W, W[-1:])), kind="previous", axis=0)(TIMES)
    np.testing.assert_array_equal(Spline("zero", KNOTS, DURATION).matrix(TIMES) @ W, expected)


@pytest.mark.parametrize("derivative", [0, 1])
def test_lines_are_those_of_scipy(derivative: int) -> None:
    expected = make_interp_spline(GRID, W, k=1)(TIMES, nu=derivative)
    np.testing.assert_allclose(Spline("linear", KNOTS, DURATION).matrix(TIMES, derivative) @ W, expected, atol=1e-12)


@pytest.mark.parametrize("derivative", [0, 1, 2])
def test_cubics_are_the_natural_ones_of_scipy(derivative: int) -> None:
    expected = make_interp_spline(GRID, W, k=3, bc_type="natural")(TIMES, nu=derivative)
    found = Spline("cubic", KNOTS, DURATION).matrix(TIMES, derivative) @ W
    np.testing.assert_allclose(found, expected, atol=1e-12 * 100.0**derivative)


@pytest.mark.parametrize("derivative", [0, 1, 2])
def test_bsplines_are_those_of_drake(derivative: int) -> None:
    basis = BsplineBasis(4, KNOTS, KnotVectorType.kClampedUniform, 0.0, DURATION)
    curve = BsplineTrajectory(basis, [w.reshape(-1, 1) for w in W])
    expected = np.hstack([curve.EvalDerivative(t, derivative) for t in TIMES]).T
    found = Spline("bspline", KNOTS, DURATION).matrix(TIMES, derivative) @ W
    np.testing.assert_allclose(found, expected, atol=1e-12 * 100.0**derivative)


@pytest.mark.parametrize("order", ORDERS)
def test_before_and_after_it_holds_its_ends(order: str) -> None:
    spline = Spline(order, KNOTS, DURATION)
    inside, outside = spline.matrix([0.0, DURATION]), spline.matrix([-1.0, DURATION + 1.0])
    np.testing.assert_array_equal(outside, inside)
    np.testing.assert_allclose(inside @ W, W[[0, -1]], atol=1e-14)
    assert not spline.matrix([-1.0, DURATION + 1.0], 1).any()


@pytest.mark.parametrize("step", [0.1, 0.7, 1e-3])
def test_instant_at_step_end_belongs_to_next(step: float) -> None:
    spline = Spline("zero", 50, 50 * step)
    for begin in (0.0, 0.3, 17.1):
        times = (begin + np.arange(50) * step) - begin
        np.testing.assert_array_equal(spline.matrix(times), np.eye(50))


@pytest.mark.parametrize("derivative", [0, 1, 2])
@pytest.mark.parametrize("order", ORDERS)
def test_extremes_are_those_of_a_dense_sampling(order: str, derivative: int) -> None:
    spline = Spline(order, KNOTS, DURATION)
    matrix = spline.matrix(np.linspace(0.0, DURATION, 3001), derivative)
    for seed in range(20):
        w = np.random.default_rng(seed).normal(size=(KNOTS, 3))
        sampled = matrix @ w
        least, most = spline.extremes(w, derivative)
        scale = np.abs(sampled).max() + 1e-12
        assert (least <= sampled.min(axis=0) + 1e-12 * scale).all()
        assert (most >= sampled.max(axis=0) - 1e-12 * scale).all()
        # A polynomial of second degree differs by some 1e-6 of its scale within half a sample; a line by 1e-3.
        np.testing.assert_allclose(
            np.c_[least, most], np.c_[sampled.min(axis=0), sampled.max(axis=0)], atol=4e-3 * scale
        )


@pytest.mark.parametrize("derivative", [0, 1, 2])
@pytest.mark.parametrize("order", ORDERS)
def test_bezier_points_enclose_the_curve(order: str, derivative: int) -> None:
    spline = Spline(order, KNOTS, DURATION)
    points = spline.bezier(derivative) @ W
    least, most = spline.extremes(W, derivative)
    scale = np.abs(points).max()
    assert (points.min(axis=0) <= least + 1e-12 * scale).all()
    assert (points.max(axis=0) >= most - 1e-12 * scale).all()


@pytest.mark.parametrize("order", ORDERS)
def test_only_a_cubic_leaves_the_range_of_its_knots(order: str) -> None:
    spline = Spline(order, KNOTS, DURATION)
    w = np.random.default_rng(0).normal(size=(KNOTS, 100))
    curve = spline.matrix(np.linspace(0.0, DURATION, 501)) @ w
    stays = (curve.min(axis=0) >= w.min(axis=0) - 1e-12) & (curve.max(axis=0) <= w.max(axis=0) + 1e-12)
    assert spline.stays_within_knots == stays.all()


def test_linear_extremes_of_a_cubic_are_its_bezier_points() -> None:
    spline = Spline("cubic", KNOTS, DURATION)
    bends = CubicSpline(GRID, W, bc_type="natural")(GRID, nu=2)
    points = spline.bezier(2) @ W
    np.testing.assert_allclose(points.max(axis=0), bends.max(axis=0), rtol=1e-9)
    np.testing.assert_allclose(points.min(axis=0), bends.min(axis=0), rtol=1e-9)


@pytest.mark.parametrize("order", ["zero", "linear"])
def test_shift_by_whole_pieces_is_exact(order: str) -> None:
    spline = Spline(order, KNOTS, DURATION)
    dt = 2 * spline.step
    np.testing.assert_allclose(
        spline.matrix(TIMES[:-1]) @ (spline.shift(dt) @ W), spline.matrix(TIMES[:-1] + dt) @ W, atol=1e-12
    )


@pytest.mark.parametrize("order", ORDERS)
def test_shift_agrees_at_the_sites(order: str) -> None:
    spline = Spline(order, KNOTS, DURATION)
    shifted = spline.matrix(spline.sites) @ (spline.shift(0.27) @ W)
    np.testing.assert_allclose(shifted, spline.matrix(spline.sites + 0.27) @ W, atol=1e-12)
    np.testing.assert_allclose(spline.shift(0.0), np.eye(KNOTS), atol=1e-12)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("quintic", 7, 1.0), "one of zero, linear, cubic, bspline, not 'quintic'"),
        (("bspline", 3, 1.0), "at least 4 knots, not 3"),
        (("linear", 2.5, 1.0), "whole number"),
        (("linear", 2, 0.0), "positive, in s, not 0.0"),
        (("linear", 2, float("nan")), "positive, in s, not nan"),
    ],
)
def test_bad_splines_are_refused(arguments: tuple[str, int, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Spline(*arguments)
