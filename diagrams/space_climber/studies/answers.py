"""Applications O4 and R1 in the table of answers."""

from __future__ import annotations

from math import isfinite

import numpy as np

from vtbdrake.optimization import Boundary
from vtbdrake_diagrams.answers import Answer
from vtbdrake_diagrams.space_climber.studies import crater
from vtbdrake_diagrams.space_climber.studies.payload import (
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
# From how many samples of its belief the robot in the crater tries each heading.
SAMPLES = 3


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
    # An open interval would contain any limit.
    closed = isfinite(simulated.lower) and isfinite(simulated.upper)
    agrees = closed and simulated.lower - LOCKED_STEP <= static <= simulated.upper + LOCKED_STEP
    # The slower gait is beside the question: it shows where the order of the worlds comes from.
    compared = [boundary for name, boundary in boundaries.items() if "stride" not in ENVIRONMENTS[name]]
    environments = "; ".join(f"{name} {_range(boundary)}" for name, boundary in boundaries.items())
    feet = "; ".join(f"{name} {limit:.1f} kg" for name, limit in statics(payload_problem().testbed).items())
    return Answer(
        id="O4",
        question="How heavy may a component attached to the SpaceClimber's front be before it is no longer stable?",
        answer=moon.lower,
        unit="kg",
        interval=(moon.lower, moon.upper),
        paper=PAPER,
        holds=agrees and all(isfinite(b.lower) and isfinite(b.upper) for b in compared),
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


def heading(full: bool) -> Answer:
    """Answer R1: which heading takes the robot from the bottom of a crater to its rim?

    The short version decides among the paper's discrete headings in 10 craters, each in a world that differs from the
    robot's model. The long one takes 20, and decides by a continuous search, too. Failing headings are explained in the
    first crater (in the long version in each), and wherever the robot sees no way: a start or a simulation that lets no
    robot walk must not pass for an impassable crater.
    """
    cases = [crater.decide_and_climb(seed, difference=seed, samples=SAMPLES) for seed in range(20 if full else 10)]
    searched = [
        crater.decide_and_climb(case.seed, difference=case.seed, method="CEM", candidates=24, samples=SAMPLES)
        for case in cases
        if full
    ]
    reasons = {case.seed: _reasons(case) for case in cases if full or case is cases[0] or case.climb is None}
    answered = [case.climb for case in cases if case.climb is not None]
    climbs = [case.climb for case in [*cases, *searched] if case.climb is not None]
    explained = all(all(texts.values()) for texts in reasons.values())
    warned = any(case.decision.poor for case in [*cases, *searched])
    notes = [
        "; ".join(_climb(case) for case in cases),
        f"headings that do not pass: {'; '.join(_reasons_text(seed, texts) for seed, texts in reasons.items())}",
    ]
    if full:
        notes.append(f"continuous search: {'; '.join(_climb(case) for case in searched)}")
    heading_deg = np.degrees(cases[0].decision.values.get(crater.HEADING, np.nan))
    reached = sum(climb.reached for climb in answered)
    return Answer(
        id="R1",
        question="Which heading takes the robot from the bottom of a crater to its rim?",
        answer=f"{heading_deg:.0f} deg in crater 0; {reached} of {len(answered)} chosen headings reach the rim",
        unit="",
        interval=None,
        paper=crater.PAPER,
        holds=bool(answered) and all(climb.reached for climb in climbs) and explained and not warned,
        note=". ".join(notes),
    )


def _climb(case: crater.Case) -> str:
    passable = [f"{np.degrees(angle):.0f}" for angle, passes in sorted(case.passable.items()) if passes]
    text = f"crater {case.seed}: passable {', '.join(passable) or 'none'}"
    if case.decision.poor:
        text += f" (POOR: {'; '.join(case.decision.warnings)})"
    if case.climb is None:
        return text
    heading_deg, climb = np.degrees(case.climb.heading), case.climb
    end = (
        f"reached the rim in {climb.duration:.0f} s" if climb.reached else f"ended {climb.distance:.0f} m from the axis"
    )
    return f"{text}; {heading_deg:.0f} deg {end}"


def _reasons(case: crater.Case) -> dict[float, list[str]]:
    """Return why headings do not pass in the robot's model, see `crater.explain`."""
    failing = [angle for angle, passes in sorted(case.passable.items()) if not passes]
    return crater.explain(crater.model(case.seed), failing)


def _reasons_text(seed: int, reasons: dict[float, list[str]]) -> str:
    texts = [f"{np.degrees(angle):.0f} deg {' or '.join(names) or 'UNEXPLAINED'}" for angle, names in reasons.items()]
    return f"crater {seed}: {', '.join(texts) or 'none'}"
