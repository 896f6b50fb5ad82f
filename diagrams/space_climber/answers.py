"""Application O4 in the table of answers."""

from __future__ import annotations

from math import isfinite

from vtbdrake.optimization import Boundary
from vtbdrake_diagrams.answers import Answer
from vtbdrake_diagrams.space_climber.payload import (
    EARTH,
    ENVIRONMENTS,
    MOON,
    PAPER,
    PHASES,
    locked_problem,
    payload_problem,
    static_limit,
    statics,
)

# How far simulated and static limit of the locked robot may be apart, in kg: the step at which masses were tried.
LOCKED_STEP = 1.0


def payload(full: bool) -> Answer:
    """Answer O4: how heavy may the attachment be, in each environment?

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
    static = static_limit(locked.testbed)
    simulated = locked.boundary(resolution=LOCKED_STEP, coarse=10.0, repeats=0)
    agrees = simulated.lower - LOCKED_STEP <= static <= simulated.upper + LOCKED_STEP
    # The slower gait is beside the question: it shows where the order of the worlds comes from.
    asked = [boundary for name, boundary in boundaries.items() if "stride" not in ENVIRONMENTS[name]]
    environments = "; ".join(f"{name} {_range(boundary)}" for name, boundary in boundaries.items())
    feet = "; ".join(f"{name} {limit:.1f} kg" for name, limit in statics(payload_problem().testbed).items())
    return Answer(
        id="O4",
        question="How heavy may a component attached to the SpaceClimber's front be before it is no longer stable?",
        answer=moon.lower,
        unit="kg",
        interval=(moon.lower, moon.upper),
        paper=PAPER,
        holds=agrees and all(isfinite(b.lower) and isfinite(b.upper) for b in asked),
        note=(
            "Stable in every rollout up to the first mass, and in none from some start phase at the second; undecided "
            f"between: {environments}. {len(moon.by_condition)} start phases on the moon, "
            f"{len(boundaries[EARTH].by_condition)} elsewhere. With locked legs {_range(simulated)}, by statics "
            f"{static:.1f} kg. Statics while it walks: {feet}."
        ),
    )


def _range(boundary: Boundary) -> str:
    """Return the interval as text, with the unsafe rollouts within it, and the interval of the best start phase."""
    upper = f"{boundary.upper:g}" if isfinite(boundary.upper) else "more"
    between = [c for c in boundary.worst_chances if boundary.lower < c.value < boundary.upper]
    counts = ", ".join(f"{c.unsafe} of {c.rollouts} at {c.value:g}" for c in between)
    parts = [counts] if counts else []
    best = boundary.by_condition[boundary.by_condition[:, 0].argmax()]
    if best[0] > boundary.lower:
        parts.append(f"best phase {best[0]:g} to {best[1]:g}")
    return f"{boundary.lower:g} to {upper} kg" + (f" ({'; '.join(parts)})" if parts else "")
