"""The row O4 of the table of answers."""

from __future__ import annotations

from math import isfinite

from diagrams.answers import Answer
from diagrams.space_climber.payload import ENVIRONMENTS, PAPER, locked_problem, payload_problem, static_limit
from vtbdrake.optimization import Boundary

# How far simulated and static limit of the locked robot may be apart, in kg: the step at which masses were tried.
LOCKED_STEP = 1.0


def payload(full: bool) -> Answer:
    """How heavy may the attachment be, in all environments? The long version tries twice as fine masses."""
    resolution = 0.5 if full else 1.0
    boundaries = {
        name: payload_problem(**fields).boundary(resolution=resolution, coarse=5.0)
        for name, fields in ENVIRONMENTS.items()
    }
    moon = boundaries["moon"]
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
            f"{environments}. Each is an interval over {len(moon.by_condition)} start phases. With locked legs it is "
            f"{_range(simulated)}, by statics {statics:.1f} kg."
        ),
    )


def _range(boundary: Boundary) -> str:
    """The lowest interval, and how far the start phases are apart."""
    spread = f", phases up to {boundary.by_condition[:, 0].max():g}" if len(boundary.by_condition) > 1 else ""
    upper = f"{boundary.upper:g}" if isfinite(boundary.upper) else "more"
    return f"{boundary.lower:g} to {upper} kg{spread}"
