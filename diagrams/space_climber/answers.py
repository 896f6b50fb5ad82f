"""The row O4 of the table of answers."""

from __future__ import annotations

from math import isfinite

from diagrams.answers import Answer
from diagrams.space_climber.payload import (
    ENVIRONMENTS,
    MOON,
    PAPER,
    PHASES,
    locked_problem,
    payload_problem,
    static_limit,
)
from vtbdrake.optimization import Boundary

# How far simulated and static limit of the locked robot may be apart, in kg: the step at which masses were tried.
LOCKED_STEP = 1.0


def payload(full: bool) -> Answer:
    """How heavy may the attachment be, in all environments?

    The short version tries every other start phase in all environments but the moon's; the long one tries all, and
    masses twice as fine.
    """
    boundaries = {}
    for name, fields in ENVIRONMENTS.items():
        phases = PHASES if full or name == MOON else PHASES[::2]
        problem = payload_problem(phases=phases, **fields)
        boundaries[name] = problem.boundary(resolution=0.5 if full else 1.0, coarse=5.0)
    moon = boundaries[MOON]
    locked = locked_problem()
    statics = static_limit(locked.testbed)
    simulated = locked.boundary(resolution=LOCKED_STEP, coarse=10.0)
    agrees = simulated.lower - LOCKED_STEP <= statics <= simulated.upper + LOCKED_STEP
    environments = "; ".join(f"{name} {_range(boundary)}" for name, boundary in boundaries.items())
    return Answer(
        id="O4",
        question="How heavy may a component attached to the SpaceClimber's front be before it is no longer stable?",
        answer=moon.lower,
        unit="kg",
        interval=(moon.lower, moon.upper),
        paper=PAPER,
        holds=agrees and all(isfinite(boundary.lower) for boundary in boundaries.values()),
        note=(
            f"{environments}. Least of {len(moon.by_condition)} start phases on the moon, of "
            f"{len(boundaries['earth'].by_condition)} elsewhere. With locked legs {_range(simulated)}, by statics "
            f"{statics:.1f} kg."
        ),
    )


def _range(boundary: Boundary) -> str:
    """The interval of the worst start phase, and how far the best one gets."""
    best = boundary.by_condition[:, 0].max()
    spread = f" (best phase {best:g})" if best > boundary.lower else ""
    upper = f"{boundary.upper:g}" if isfinite(boundary.upper) else "more"
    return f"{boundary.lower:g} to {upper} kg{spread}"
