"""The decision about the cart-pole: its cost, and the settings of the reasoner that searches a plan of forces."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vtbdrake.reasoning import Budget, SearchConfig, Trajectory
from vtbdrake.rollout import Executor, Quality

if TYPE_CHECKING:
    from vtbdrake_diagrams.cart_pole.scenario import CartPoleScenario


def cost(state: NDArray[np.float64]) -> float:
    """Return the cost of a state [x, theta, x', theta']: 0 where the pole stands still in the middle of the rail."""
    x, theta, speed, rate = state.tolist()
    value: float = 1.0 + np.cos(theta) + 0.1 * x**2 + 0.01 * speed**2 + 0.01 * rate**2
    return value


def plan_of(scenario: CartPoleScenario, address: str) -> Trajectory:
    """Return the decision variables: the knots of the plan at ``address``, within the limits of the force."""
    limit = scenario.force_limit
    return Trajectory(address, scenario.knots, scenario.duration, scenario.order, lower=-limit, upper=limit)


def reasoning(
    scenario: CartPoleScenario, address: str, budget: Budget, *, executor: str | Executor = "auto"
) -> dict[str, Any]:
    """Return the arguments of a `Reasoner` that decides the plan at ``address``; the horizon is the plan's."""
    return {
        "decision": [plan_of(scenario, address)],
        "quality": Quality(cost, of="plant.state", reading="integral", minimize=True),
        "horizon": scenario.duration,
        "sample_period": 2.0 * scenario.period,
        "budget": budget,
        "search": SearchConfig(method="predictive-sampling", options={"sigma": 0.3}, executor=executor),
    }
