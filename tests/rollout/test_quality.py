"""Qualities, constraints and how their samples are read."""

import sys
from dataclasses import dataclass, replace
from fractions import Fraction
from math import inf, nan

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydrake.common.value import Value
from pydrake.systems.analysis import SimulatorConfig
from pydrake.systems.primitives import ZeroOrderHold
from scipy.special import ellipj, ellipk

from tests.testbeds import AcrobotScenario, PendulumScenario
from vtbdrake.rollout import Constraint, Quality, QualityError, RolloutRunner, RolloutTask
from vtbdrake.rollout.quality import READINGS, best_sample, exceeds, read_quality
from vtbdrake.state import AddressedSystem, Quantity

PERIOD = 0.1
SHOULDER = "sim.sys.Acrobot.shoulder.position"


def _roll(trajectory, *, threshold=inf, **options):
    """A rollout whose f' is ``trajectory`` at the sample times."""
    quality = Quality(lambda t: trajectory[round(t / PERIOD)], "time")
    horizon = PERIOD * (len(trajectory) - 1)
    task = RolloutTask(AcrobotScenario(), horizon, quality, threshold, sample_period=PERIOD, **options)
    runner = RolloutRunner(task)
    return runner.run({}), runner


@pytest.mark.parametrize(
    ("trajectory", "threshold", "t_star", "h", "end"),
    [
        # Two crossings: the first counts (Figure 5, f1).
        ([0.0, 0.5, 2.0, 0.5, 3.0], 1.0, 0.2, 2.0, "threshold"),
        # Never reached: the maximum (Figure 5, f2).
        ([0.0, 0.5, 0.9, 0.5, 0.3], 1.0, 0.2, 0.9, "horizon"),
        # Strictly greater: touching the threshold is not exceeding it.
        ([0.0, 1.0, 0.5, 1.0, 0.2], 1.0, 0.1, 1.0, "horizon"),
        # A plateau and a tie: the first maximum wins.
        ([0.2, 0.7, 0.7, 0.1, 0.7], 1.0, 0.1, 0.7, "horizon"),
        # The maximum at t = 0 counts, and so does a threshold exceeded there.
        ([0.9, 0.5, 0.2, 0.1, 0.0], 1.0, 0.0, 0.9, "horizon"),
        ([1.5, 0.5, 9.0, 0.1, 0.0], 1.0, 0.0, 1.5, "threshold"),
        # The last sample counts too.
        ([0.0, 0.0, 0.0, 0.0, 4.0], 1.0, 0.4, 4.0, "threshold"),
        # No threshold; a quality that is nowhere positive.
        ([0.0, 0.0, 0.0, 0.0, 0.0], inf, 0.0, 0.0, "horizon"),
        # A threshold of zero is exceeded by anything positive.
        ([0.0, 0.0, 1e-9, 5.0, 0.0], 0.0, 0.2, 1e-9, "threshold"),
    ],
)
def test_t_star_and_h(trajectory, threshold, t_star, h, end):
    result, runner = _roll(trajectory, threshold=threshold)
    assert (result.end, result.h) == (end, h)
    assert result.t_star == pytest.approx(t_star)
    # Early stop: no step after t*.
    stop = t_star if end == "threshold" else 0.4
    assert runner.context.get_time() == pytest.approx(stop)
    np.testing.assert_array_equal(result.quality, trajectory[: round(stop / PERIOD) + 1])


@pytest.mark.parametrize(
    ("returned", "shown"),
    [
        ("1.5", r"'1\.5'"),
        (b"1.5", r"b'1\.5'"),
        (np.array(["1.5"]), "array"),
        (None, "None"),
        (1j, "1j"),
        ([1.5], r"\[1\.5\]"),
        (np.zeros(2), r"an array of shape \(2,\)"),
        (np.ma.masked, "masked"),
    ],
)
@pytest.mark.parametrize("measure", [Quality, Constraint])
def test_what_is_no_number_is_refused_with_what_was_returned(measure, returned, shown):
    limits = {"at_most": 2.0} if measure is Constraint else {}
    f = measure(lambda t: returned, "time", **limits)
    with pytest.raises(QualityError, match=rf"at t = 0 s, time = 0\.0, must return a real number, not {shown}"):
        f([0.0], time=0.0)


@pytest.mark.parametrize("returned", [1.5, np.float32(1.5), np.array([1.5]), np.array(1.5), Fraction(3, 2)])
def test_numbers_of_other_types_are_taken(returned):
    assert Quality(lambda t: returned, "time")([0.0], time=0.0) == 1.5
    assert Quality(lambda t: returned > 1.0, "time")([0.0], time=0.0) == 1.0


def test_run_on_keeps_t_star():
    result, runner = _roll([0.0, 2.0, 0.5, 3.0, 0.0], threshold=1.0, run_on=True)
    assert result.exceedances == pytest.approx([0.1, 0.3])
    assert (result.end, result.t_star, result.h) == ("threshold", pytest.approx(0.1), 2.0)
    assert runner.context.get_time() == pytest.approx(0.4)


@given(
    st.lists(st.sampled_from([0.0, 0.25, 0.5, 1.0, 2.0]), min_size=1, max_size=20),
    st.sampled_from([0.0, 0.25, 0.5, 1.5, inf]),
)
def test_the_definitions_word_by_word(values, threshold):
    times = range(len(values))
    g1 = {t for t in times if values[t] > threshold}
    g2 = {t for t in times if all(values[t] >= values[s] for s in times)}
    assert best_sample(np.array(values), threshold=threshold) == (min(g1) if g1 else min(g2))
    assert set(np.flatnonzero(exceeds(np.array(values), threshold))) == g1
    # For a cost, all is mirrored.
    g1 = {t for t in times if values[t] < threshold}
    g2 = {t for t in times if all(values[t] <= values[s] for s in times)}
    cost = best_sample(np.array(values), threshold=threshold, minimize=True)
    assert cost == (min(g1) if g1 else min(g2))
    assert set(np.flatnonzero(exceeds(np.array(values), threshold, minimize=True))) == g1


@pytest.mark.parametrize("scale", [1e-18, 1e-12, 1.0, 1e12])
def test_costs_of_any_size_are_compared_themselves(scale):
    # 1 / (1 + c) is 1 for all costs below 1e-16.
    costs = [5.0 * scale, 3.0 * scale, 2.0 * scale, 4.0 * scale]
    quality = Quality(lambda t: costs[round(t / PERIOD)], "time", minimize=True)
    task = RolloutTask(AcrobotScenario(), 3 * PERIOD, quality, sample_period=PERIOD)
    result = RolloutRunner(task).run({})
    assert (result.t_star, result.value, result.end) == (pytest.approx(0.2), 2.0 * scale, "horizon")
    assert result.exceedances.size == 0
    stopped = RolloutRunner(replace(task, threshold=3.5 * scale)).run({})
    assert (stopped.t_star, stopped.value, stopped.end) == (pytest.approx(0.1), 3.0 * scale, "threshold")
    assert stopped.exceedances == pytest.approx([0.1])
    assert stopped.threshold == 1.0 / (1.0 + 3.5 * scale)


@pytest.mark.parametrize(
    ("f", "message"),
    [
        (lambda t: -0.1, "is -0.1, but a quality is finite and not negative"),
        (lambda t: nan, "is nan, but"),
        (lambda t: inf, "is inf, but"),
        (lambda t: 1 / 0, "raises ZeroDivisionError: division by zero"),
        (lambda t: "good", "must return a real number, not 'good'"),
        (lambda t: sys.exit("failure in Drake"), "raises SystemExit: failure in Drake"),
    ],
)
def test_invalid_quality_error_names_time_and_place(f, message):
    task = RolloutTask(AcrobotScenario(), 0.2, Quality(f, "time"))
    with pytest.raises(QualityError, match=f"at t = 0 s, time = 0.0, {message}"):
        RolloutRunner(task).run({})


def test_a_quality_is_a_function_of_something():
    with pytest.raises(QualityError, match="not 3"):
        Quality(3, "time")
    with pytest.raises(ValueError, match=r"give what a quality is a function of as \[address, ...\]"):
        Quality(abs, 3)
    with pytest.raises(QualityError, match="at least one quality variable"):
        Quality(abs, [])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"horizon": 0.0}, "horizon t_m must be positive"),
        ({"horizon": -1.0}, "horizon t_m must be positive"),
        ({"horizon": inf}, "horizon t_m must be positive and finite"),
        ({"horizon": 1.0, "sample_period": 0.0}, "sample period must be positive"),
        ({"horizon": 1.0, "sample_period": 2.0}, "at most the horizon of 1 s, not 2.0 s"),
        ({"horizon": 1e9, "sample_period": 1e-3}, r"1e\+12 samples, one every 0.001 s, but at most 1e\+08"),
        ({"horizon": 1.0, "threshold": nan}, "threshold f_m"),
        ({"horizon": 1.0, "threshold": -1.0}, "threshold f_m"),
    ],
)
def test_a_task_that_makes_no_sense_is_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        RolloutTask(AcrobotScenario(), **arguments)


@pytest.mark.parametrize(
    ("horizon", "period", "expected"),
    [(0.3, 0.1, [0, 0.1, 0.2, 0.3]), (0.25, 0.1, [0, 0.1, 0.2, 0.25]), (0.1, 0.1, [0, 0.1])],
)
def test_samples_are_the_multiples_of_the_period_and_the_horizon(horizon, period, expected):
    np.testing.assert_allclose(RolloutTask(AcrobotScenario(), horizon, sample_period=period).sample_times(), expected)


@pytest.mark.parametrize(("period", "sample_period"), [(0.02, 0.1), (0.01, 0.07), (0.005, 0.015)])
@pytest.mark.parametrize("start", [0.0, 0.3, 12.34])
def test_samples_cost_no_steps_of_their_own_where_events_coincide(period, sample_period, start):
    # 3 * 0.1 and 15 * 0.02 differ in the last bit, and so do 0.3 + 0.1 k and 0.02 n.
    scenario = AcrobotScenario(period=period)
    testbed = scenario.build()
    context = testbed.default_context()
    context.SetTime(start)
    start_state = testbed.snapshot(context)
    count = 140
    task = RolloutTask(
        scenario, count * sample_period, Quality(abs, SHOULDER), sample_period=sample_period, start=start_state
    )
    assert any(k * sample_period != round(k * sample_period / period) * period for k in range(count + 1)), (
        "this would show nothing"
    )
    ((own_period, offset),) = testbed.event_timings()
    assert (own_period, offset) == (period, 0.0)
    instants = task.instants(start, testbed.event_timings())
    np.testing.assert_allclose(instants, start + task.sample_times(), rtol=0.0, atol=1e-14)
    # Where the clock is to be at an event, it is there to the last bit.
    events = np.round(instants / period) * period
    coincide = np.abs(instants - events) < 1e-12
    assert coincide.sum() >= count / 10
    np.testing.assert_array_equal(instants[coincide][1:], events[coincide][1:])


def test_a_rollout_steps_like_a_simulation_with_events():
    scenario = AcrobotScenario(simulator_config=SimulatorConfig(max_step_size=0.02, use_error_control=False))
    task = RolloutTask(scenario, 15.0, Quality(abs, SHOULDER), sample_period=0.1)
    runner = RolloutRunner(task)
    result = runner.run({SHOULDER: 0.5})
    testbed = scenario.build()
    context = testbed.default_context()
    testbed.write(context, {SHOULDER: 0.5})
    simulator = testbed.simulator(context)
    simulator.AdvanceTo(750 * 0.02)
    assert runner.steps == simulator.get_num_steps_taken() == 750
    assert result.quality[-1] == abs(testbed.read(context, SHOULDER))


class Ticks(AddressedSystem):
    """Counts unrestricted updates, whose period Drake does not tell."""

    def __init__(self, period):
        super().__init__()
        self._counter = self.declare_discrete_state(ticks=Quantity())
        self.DeclarePeriodicUnrestrictedUpdateEvent(period, 0.0, self._count)

    def _count(self, context, state):
        self._counter.mutable(state.get_mutable_discrete_state()).ticks += 1.0


@dataclass
class WithTicks(AcrobotScenario):
    other: float = 0.1

    def add_world(self, builder):
        super().add_world(builder)
        builder.add("env", "other", Ticks(self.other))
        builder.add("env", "hold", ZeroOrderHold(0.3, Value(0.0)))


@pytest.mark.parametrize(("period", "other", "sample_period"), [(0.02, 0.1, 0.1), (0.02, 0.05, 0.1), (0.1, 0.03, 0.3)])
def test_samples_come_before_all_updates_of_their_instant(period, other, sample_period):
    counts = {"dps.ticks": period, "sim.env.other.ticks": other}
    scenario = WithTicks(period=period, other=other, time_step=period)
    runner = RolloutRunner(RolloutTask(scenario, 15.0, record=list(counts), sample_period=sample_period))
    result = runner.run({})
    for address, own in counts.items():
        np.testing.assert_array_equal(result.record[address], np.ceil(np.round(result.times / own, 6)))
    assert {(0.3, 0.0), (other, 0.0)} <= set(runner.testbed.event_timings())


THETA = "sim.sys.Pendulum.theta.position"
START = 0.4
HORIZON, STEP = 1.5, 0.05
# Drake's Pendulum.urdf: a point of 1 kg at 0.5 m, damping 0.1 N m s/rad; the tests take the damping away.
LENGTH, GRAVITY = 0.5, 9.81
UNDAMPED = {"sim.sys.Pendulum.theta.damping": 0.0}
TIMES = np.linspace(0.0, HORIZON, 31)


def swing(times: np.ndarray) -> np.ndarray:
    """The angle of an undamped pendulum released at rest at START, by Jacobi's elliptic functions."""
    k = np.sin(START / 2.0)
    omega = np.sqrt(GRAVITY / LENGTH)
    sn, _, _, _ = ellipj(ellipk(k**2) - omega * times, k**2)
    return 2.0 * np.arcsin(k * sn)


def rollout(quality, measures=(), **task):
    task = RolloutTask(PendulumScenario(), HORIZON, quality, sample_period=STEP, measures=measures, **task)
    return RolloutRunner(task).run({THETA: START, **UNDAMPED})


def above(theta):
    return theta + 1.0


def square(theta):
    return theta**2


EXPECTED = {
    "best": lambda f: (TIMES[np.argmax(f)], f.max()),
    "worst": lambda f: (TIMES[np.argmin(f)], f.min()),
    "end": lambda f: (HORIZON, f[-1]),
    "integral": lambda f: (HORIZON, np.sum((f[1:] + f[:-1]) / 2.0 * np.diff(TIMES))),
}


@pytest.mark.parametrize("reading", EXPECTED)
def test_a_quality_is_read_as_asked(reading):
    result = rollout(Quality(above, THETA, reading=reading))
    t, h = EXPECTED[reading](swing(TIMES) + 1.0)
    assert result.t_star == t
    assert result.h == pytest.approx(h, abs=2e-4)
    assert result.value == result.h


@pytest.mark.parametrize(("reading", "mirrored"), [("best", "worst"), ("worst", "best"), ("end", "end")])
def test_a_cost_is_read_with_its_own_direction(reading, mirrored):
    result = rollout(Quality(square, THETA, reading=reading, minimize=True))
    t, cost = EXPECTED[mirrored](swing(TIMES) ** 2)
    assert result.value == pytest.approx(cost, abs=2e-4)
    assert result.h == pytest.approx(1.0 / (1.0 + cost), abs=2e-4)
    assert result.t_star == t


def test_the_integral_of_a_cost_is_that_of_the_cost_itself():
    result = rollout(Quality(square, THETA, reading="integral", minimize=True))
    _, cost = EXPECTED["integral"](swing(TIMES) ** 2)
    assert result.value == pytest.approx(cost, abs=2e-4)
    assert result.h == 1.0 / (1.0 + result.value)


def test_equations_hold_for_the_f_of_a_cost():
    result = rollout(Quality(square, THETA, minimize=True))
    assert np.all(result.quality > 0.0)
    assert result.h == result.quality.max()
    assert result.t_star == result.times[np.argmax(result.quality)]


def test_a_cost_below_its_threshold_ends_the_rollout():
    limit = 0.05
    full = rollout(Quality(square, THETA, minimize=True))
    first = int(np.argmax(swing(TIMES) ** 2 < limit))
    stopped = rollout(Quality(square, THETA, minimize=True), threshold=limit)
    assert stopped.end == "threshold" and stopped.t_star == TIMES[first]
    assert np.array_equal(stopped.quality, full.quality[: first + 1])


def test_measures_are_read_beside_the_quality():
    measures = (
        Quality(square, THETA, reading="end"),
        Constraint(lambda theta: theta, THETA, at_most=0.3),
        Constraint(lambda theta: theta, THETA, at_least=-0.5),
        Constraint(lambda theta: theta, THETA, at_least=-0.1, at_most=0.1, reading="end"),
    )
    result = rollout(Quality(above, THETA), measures)
    theta = swing(TIMES)
    expected = [theta[-1] ** 2, theta.max() - 0.3, -0.5 - theta.min(), max(theta[-1] - 0.1, -0.1 - theta[-1])]
    assert result.measures == pytest.approx(expected, abs=2e-4)
    assert result.identical(rollout(Quality(above, THETA), measures))


def test_f_may_write_into_its_arguments():
    def careless(state):
        state[:] = 99.0
        return 1.0

    result = rollout(Quality(careless, "plant.state"), (Constraint(max, "plant.state", at_most=START, reading="best"),))
    assert result.measures[0] < 0.0


def test_f_may_not_exceed_its_stated_upper_end():
    with pytest.raises(QualityError, match=r"is 1\.4, more than its stated upper end of 1\.2"):
        rollout(Quality(above, THETA, upper=1.2))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Quality(above, THETA, reading="mean"), "is read as one of best, worst, end, integral, not 'mean'"),
        (lambda: Quality(above, THETA, upper=0.0), "is positive, not 0.0"),
        (lambda: Quality(above, THETA, minimize="no"), "minimize of the quality above must be True or False, not 'no'"),
        (lambda: Quality(above, THETA, upper=1.0, minimize=True), "the best that a cost can be is 0"),
        (lambda: Constraint(above, THETA), "takes at_most, at_least or both"),
        (lambda: Constraint(above, THETA, at_least=1.0, at_most=0.0), "at_least 1, at_most 0"),
        (
            lambda: RolloutTask(PendulumScenario(), 1.0, Quality(above, THETA, reading="end"), threshold=1.0),
            "leave the threshold out, or read it as 'best'",
        ),
        (
            lambda: RolloutTask(PendulumScenario(), 1.0, Quality(above, THETA, minimize=True), threshold=0.0),
            "positive and finite, not 0.0",
        ),
    ],
)
def test_what_makes_no_sense_is_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_a_negative_cost_is_refused():
    with pytest.raises(QualityError, match="a cost is finite and not negative: state it so that 0 is the best"):
        rollout(Quality(lambda theta: theta - 1.0, THETA, minimize=True))


def test_a_quality_without_a_name_is_f():
    assert Quality(lambda z: z, of="time").name == "f"
    assert Quality(abs, of="time").name == "abs"


@pytest.mark.parametrize("reading", READINGS)
@pytest.mark.parametrize("minimize", [False, True])
@pytest.mark.parametrize("threshold", [None, 0.9])
def test_many_rollouts_are_read_as_each_of_them_is(reading: str, minimize: bool, threshold: float | None) -> None:
    times = np.linspace(0.0, 2.0, 301)
    samples = np.random.default_rng(3).uniform(size=(50, 301))
    quality = Quality(float, of=["q"], reading=reading, minimize=minimize)
    constraint = Constraint(float, of=["q"], reading=reading, at_least=0.2, at_most=0.7)
    together = [*read_quality(quality, times, samples, threshold), constraint.read(times, samples)]
    each = [(*read_quality(quality, times, row, threshold), constraint.read(times, row)) for row in samples]
    np.testing.assert_array_equal(np.array(together).T, each)
