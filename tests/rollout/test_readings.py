"""How a quality over time becomes one number: against a pendulum in closed form, and by hand."""

import numpy as np
import pytest
from scipy.special import ellipj, ellipk

from tests.testbeds import PendulumScenario
from vtbdrake.rollout import Constraint, Quality, QualityError, RolloutRunner, RolloutTask

THETA = "sim.sys.Pendulum.theta.position"
START = 0.4
HORIZON, PERIOD = 1.5, 0.05
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
    task = RolloutTask(PendulumScenario(), HORIZON, quality, sample_period=PERIOD, measures=measures, **task)
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


def test_f_may_not_exceed_its_stated_upper_end():
    with pytest.raises(QualityError, match=r"is 1\.4, more than its stated upper end of 1\.2"):
        rollout(Quality(above, THETA, upper=1.2))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Quality(above, THETA, reading="mean"), "is read as one of best, worst, end, integral, not 'mean'"),
        (lambda: Quality(above, THETA, upper=0.0), "is positive, not 0.0"),
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
