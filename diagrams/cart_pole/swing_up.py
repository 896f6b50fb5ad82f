"""The swing-up: the plan of forces is decided again and again, by rollouts of the testbed itself."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vtbdrake.reasoning import Budget, Decision, Reasoner, Trajectory
from vtbdrake.rollout import Quality
from vtbdrake_diagrams.cart_pole.scenario import CartPoleScenario

Array = NDArray[np.float64]


def cost(state: Array) -> float:
    """Return the cost of a state [x, theta, x', theta']: 0 where the pole stands still in the middle of the rail."""
    x, theta, speed, rate = state.tolist()
    return float(1.0 + np.cos(theta) + 0.1 * x**2 + 0.01 * speed**2 + 0.01 * rate**2)


def plan_of(scenario: CartPoleScenario, address: str = "u.plan") -> Trajectory:
    """Return what is decided: the knots of the plan, within the limits of the force."""
    limit = scenario.force_limit
    return Trajectory(address, scenario.knots, scenario.duration, scenario.order, lower=-limit, upper=limit)


def make_reasoner(scenario: CartPoleScenario, *, rollouts: int = 32, **options: Any) -> Reasoner:
    """Return the reasoner of the swing-up: predictive sampling with a horizon as long as a plan.

    Args:
        scenario: That of the running cart-pole.
        rollouts: Budget of a decision.
        options: Further arguments of `Reasoner`, which replace those given here.
    """
    given = {
        "decision": [plan_of(scenario)],
        "quality": Quality(cost, of="plant.state", reading="integral", minimize=True),
        "horizon": scenario.duration,
        "sample_period": 2.0 * scenario.period,
        "budget": Budget(rollouts=rollouts),
        "method": "predictive-sampling",
        "options": {"sigma": 0.3},
    }
    return Reasoner(scenario=scenario, **{**given, **options})


@dataclass(frozen=True)
class Swing:
    """A swing-up in simulation, one row per decision.

    Attributes:
        times: When each decision was made, in s, shape (n,).
        states: [x, theta, x', theta'] then, shape (n, 4), in m and rad.
        decisions: What was decided.
    """

    times: Array
    states: Array
    decisions: tuple[Decision, ...]

    @property
    def tilt(self) -> Array:
        """Return the angle between the pole and the upright, in [0, pi], in rad, shape (n,)."""
        return np.abs(np.angle(np.exp(1j * (self.states[:, 1] - np.pi))))


def swing_up(reasoner: Reasoner, scenario: CartPoleScenario, *, seconds: float = 6.0, every: float = 0.1) -> Swing:
    """Simulate a cart-pole that hangs at rest, and decide a new plan for it in regular intervals.

    The time that a decision takes is not simulated: the cart-pole waits.

    Args:
        reasoner: What decides, see `make_reasoner`.
        scenario: The cart-pole; it may differ from that of the reasoner.
        seconds: Duration of the simulation in seconds.
        every: Time from one decision to the next, in seconds.
    """
    rows = list(_decide(reasoner, scenario, np.arange(round(seconds / every)) * every))
    times, states, decisions = zip(*rows, strict=True)
    return Swing(np.array(times), np.array(states), decisions)


def _decide(reasoner: Reasoner, scenario: CartPoleScenario, times: Array) -> Iterator[tuple[float, Array, Decision]]:
    testbed = scenario.build()
    context = testbed.default_context()
    simulator = testbed.simulator(context)
    state = testbed.reader("plant.state")
    for time in times.tolist():
        simulator.AdvanceTo(time)
        decision = reasoner.decide(testbed, context)
        if decision:
            decision.apply(testbed, context)
        yield time, np.array(state(context)), decision
