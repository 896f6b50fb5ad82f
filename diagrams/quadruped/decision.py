"""The decision about the steps of the quadruped: its cost, and the settings of the reasoner that searches a plan."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from vtbdrake.reasoning import Budget, SearchConfig, Trajectory
from vtbdrake.rollout import Quality
from vtbdrake_diagrams.quadruped.dps import OFFSET
from vtbdrake_diagrams.quadruped.gait import OFFSETS
from vtbdrake_diagrams.quadruped.model import Quadruped

if TYPE_CHECKING:
    from vtbdrake_diagrams.quadruped.scenario import QuadrupedScenario

LIMITS = np.array([0.2, 0.2, 0.2, 0.2, 0.2, 0.2])
"""The largest `OFFSETS`."""
SIGMA = 0.2
"""Standard deviation of the candidates about the plan in use, as a part of the range of an offset."""
_HEIGHT = Quadruped().stance


def cost(state: Any, velocity: Any, offset: Any) -> Any:
    """Return the cost of a state: 0 where the trunk is level and at its height, and moves as it should.

    Args:
        state: State of the plant, shape (37,).
        velocity: Velocity of the trunk as it should be, forwards and to the left, shape (2,), in m/s.
        offset: The offsets of the trot, shape (6,); see `OFFSETS`.
    """
    w, x, y, z = (state[k] for k in range(4))
    length = w * w + x * x + y * y + z * z
    up = 1.0 - 2.0 * (x * x + y * y) / length
    ahead, aside = w * w + x * x - y * y - z * z, 2.0 * (x * y + w * z)
    norm = np.sqrt(ahead * ahead + aside * aside + 1e-9)
    ahead, aside = ahead / norm, aside / norm
    rates, v = [state[19 + k] for k in range(3)], [state[22 + k] for k in range(3)]
    slip = (v[0] - ahead * velocity[0] + aside * velocity[1], v[1] - aside * velocity[0] - ahead * velocity[1])
    value = 20.0 * (1.0 - up) + 100.0 * (state[6] - _HEIGHT) * (state[6] - _HEIGHT)
    value = value + 1.0 * (slip[0] * slip[0] + slip[1] * slip[1]) + 0.05 * sum(rate * rate for rate in rates)
    return value + sum(0.1 * (offset[k] / LIMITS[k]) * (offset[k] / LIMITS[k]) for k in range(len(LIMITS)))


def reasoning(
    scenario: QuadrupedScenario, address: str, budget: Budget, *, executor: str = "compiled"
) -> dict[str, Any]:
    """Return the arguments of a `Reasoner` that decides the plan at ``address``; the horizon is the plan's."""
    limits = LIMITS.tolist()
    plan = Trajectory(
        address,
        scenario.knots,
        scenario.duration,
        "linear",
        size=len(OFFSETS),
        lower=[-limit for limit in limits],
        upper=limits,
    )
    return {
        "decision": [plan],
        "quality": Quality(cost, of=["plant.state", "u.velocity", OFFSET], reading="integral", minimize=True),
        "horizon": scenario.duration,
        "sample_period": 2.0 * scenario.mental_period,
        "budget": budget,
        "search": SearchConfig(method="predictive-sampling", options={"sigma": SIGMA}, executor=executor, workers=1),
    }
