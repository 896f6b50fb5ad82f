"""A plan followed in time: the values of SciPy's splines at the sample times."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from scipy.interpolate import BSpline, interp1d, make_interp_spline

from vtbdrake.common.spline import ORDERS, Spline
from vtbdrake.components.spline_command import SplineCommand

PERIOD, DURATION, KNOTS, SIZE = 0.02, 0.5, 6, 2
W = np.random.default_rng(5).normal(size=(KNOTS, SIZE))


def command(order: str, **options: Any) -> SplineCommand:
    return SplineCommand(Spline(order, KNOTS, DURATION), period=PERIOD, size=SIZE, **options)


class Run:
    """A SplineCommand on its own; `plan` is what stands at its input from then on."""

    def __init__(self, system: SplineCommand) -> None:
        self._simulator = Simulator(system)
        self._system = system
        self._input = system.get_input_port().FixValue(self._simulator.get_mutable_context(), np.zeros(1 + W.size))

    def plan(self, begin: float, knots: np.ndarray = W) -> None:
        self._input.GetMutableData().set_value(np.concatenate(([begin], knots.ravel())))

    def at(self, k: int) -> np.ndarray:
        """The value after the sample at k * PERIOD."""
        self._simulator.AdvanceTo((k + 0.5) * PERIOD)
        value: np.ndarray = self._system.get_output_port().Eval(self._simulator.get_context())
        return value.copy()


def by_scipy(order: str, times: np.ndarray) -> np.ndarray:
    times = np.clip(times, 0.0, DURATION)
    grid = np.linspace(0.0, DURATION, KNOTS)
    if order == "zero":
        # A little later, because sample times are rounded.
        steps = np.append(np.linspace(0.0, DURATION, KNOTS + 1), 2.0)
        return interp1d(steps, np.vstack((W, W[-1:], W[-1:])), kind="previous", axis=0)(times + 1e-9)
    if order == "bspline":
        breaks = np.linspace(0.0, DURATION, KNOTS - 2)
        return BSpline(np.concatenate(([0.0] * 3, breaks, [DURATION] * 3)), W, 3)(times)
    return make_interp_spline(
        grid, W, k={"linear": 1, "cubic": 3}[order], bc_type=None if order == "linear" else "natural"
    )(times)


@pytest.mark.parametrize("order", ORDERS)
def test_values_are_those_of_scipy_from_begin_to_end(order: str) -> None:
    run = Run(command(order))
    run.plan(begin=5 * PERIOD)
    found = np.array([run.at(k) for k in range(40)])
    expected = by_scipy(order, PERIOD * (np.arange(40) - 5))
    np.testing.assert_allclose(found[5:], expected[5:], atol=1e-12)
    assert not found[:5].any()


def test_a_plan_that_arrives_late_is_joined_where_it_should_be() -> None:
    run = Run(command("cubic"))
    run.plan(begin=0.0, knots=np.zeros_like(W))
    assert not run.at(9).any()
    run.plan(begin=3 * PERIOD)
    np.testing.assert_allclose(run.at(10), by_scipy("cubic", np.array([7 * PERIOD]))[0], atol=1e-12)


def test_a_plan_that_arrives_early_keeps_the_value_until_it_begins() -> None:
    run = Run(command("linear"))
    run.plan(begin=0.0)
    before = run.at(3)
    run.plan(begin=6 * PERIOD, knots=-W)
    np.testing.assert_array_equal(run.at(4), before)
    np.testing.assert_array_equal(run.at(5), before)
    np.testing.assert_allclose(run.at(6), -W[0], atol=1e-12)


def test_after_the_end_the_declared_value_is_shown() -> None:
    run = Run(command("bspline", after=[0.5, -0.5]))
    run.plan(begin=0.0)
    np.testing.assert_allclose(run.at(25), W[-1], atol=1e-12)
    np.testing.assert_array_equal(run.at(26), [0.5, -0.5])


@pytest.mark.parametrize("begin", [0.0, 17.1, 1e4])
def test_each_step_begins_at_its_sample_however_times_are_rounded(begin: float) -> None:
    count = 50
    system = SplineCommand(Spline("zero", count, count * PERIOD), period=PERIOD)
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    first = round(begin / PERIOD)
    context.SetTime(first * PERIOD)
    system.get_input_port().FixValue(context, np.concatenate(([first * PERIOD], np.arange(1.0, count + 1.0))))
    seen = []
    for k in range(count):
        simulator.AdvanceTo((first + k + 0.5) * PERIOD)
        seen.append(float(system.get_output_port().Eval(context)[0]))
    np.testing.assert_array_equal(seen, np.arange(1.0, count + 1.0))


@pytest.mark.parametrize(("begin", "first"), [(np.nan, 0.0), (-np.inf, 0.0), (0.0, np.nan), (0.0, np.inf)])
def test_a_plan_that_is_not_finite_is_an_error(begin: float, first: float) -> None:
    run = Run(command("linear"))
    knots = W.copy()
    knots[0, 0] = first
    run.plan(begin, knots)
    with pytest.raises(ValueError, match="finite numbers"):
        run.at(0)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"period": 0.0}, "period is positive, in s, not 0.0"),
        ({"period": PERIOD, "size": 0}, "at least one entry, not 0"),
        ({"period": PERIOD, "size": 2, "after": [1.0, 2.0, 3.0]}, "or 2 of them"),
        ({"period": PERIOD, "after": float("nan")}, "one finite number"),
        ({"period": PERIOD, "after": "1.5"}, "SplineCommand: after must be a number or several, not '1.5'"),
    ],
)
def test_bad_declarations_are_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        SplineCommand(Spline("cubic", KNOTS, DURATION), **options)


def test_before_the_first_plan_it_is_the_initial_value() -> None:
    run = Run(command("cubic", initial=[0.5, -0.5]))
    run.plan(begin=5 * PERIOD)
    np.testing.assert_array_equal(run.at(4), [0.5, -0.5])
    np.testing.assert_allclose(run.at(5), W[0])


def test_a_repeated_plan_begins_again_at_its_end() -> None:
    run, once = Run(command("bspline", repeat=True)), Run(command("bspline"))
    run.plan(0.1)
    once.plan(0.1)
    period = round(DURATION / PERIOD)
    first = [once.at(5 + k) for k in range(period)]
    # The second and the third time, from the first sample after the end on.
    again = [run.at(5 + k) for k in range(3 * period)]
    np.testing.assert_allclose(again, first * 3, atol=1e-12)
