"""Applications O4 and R1 in the table of answers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import isfinite
from typing import Any

import numpy as np

from vtbdrake.optimization import Boundary
from vtbdrake_diagrams.answers import Answer
from vtbdrake_diagrams.space_climber.scenario import SpaceClimberScenario
from vtbdrake_diagrams.space_climber.studies import crater
from vtbdrake_diagrams.space_climber.studies.other_engine import CONTACTS, MujocoClimber
from vtbdrake_diagrams.space_climber.studies.payload import (
    EARTH,
    ENVIRONMENTS,
    MOON,
    PAPER,
    PHASES,
    SLOPE,
    SOLVERS,
    locked_problem,
    payload_problem,
    static_limit,
    statics,
)

# How far simulated and static limit of the locked robot may be apart, in kg: the step at which masses were tried.
LOCKED_STEP = 1.0
# The environments that are simulated in MuJoCo, too.
SECOND_ENGINE = (MOON, EARTH, SLOPE)
# The masses that are tried in MuJoCo, in kg.
MUJOCO_MASSES = (20.0, 60.0)
# How far the boundaries of one environment in MuJoCo may be apart, in kg: a wider interval would agree with anything.
LARGEST_SPREAD = 6.0
# From how many samples of its belief the robot in the crater tries each heading.
SAMPLES = 3
# The share of the craters in which the robot must reach the rim, and by how much more than straight on.
LEAST_REACHED = 0.9
LEAST_GAIN = 0.2


@dataclass(frozen=True)
class PayloadAnswer:
    """The boundaries of the mass, and the case with locked legs for which statics knows the answer.

    Attributes:
        boundaries: The boundary in each of `ENVIRONMENTS`.
        solvers: The moon's boundary with each of `SOLVERS`.
        locked: The simulated boundary of the robot with locked legs.
        static: Its boundary by statics, in kg.
        mujoco: Environment -> (lower, upper) in kg in MuJoCo, over `CONTACTS`.
    """

    boundaries: Mapping[str, Boundary]
    solvers: Mapping[str, Boundary]
    locked: Boundary
    static: float
    mujoco: Mapping[str, tuple[float, float]]

    def interval(self, environment: str) -> tuple[float, float]:
        """Return (lower, upper) of an environment in kg; the moon's includes what settings of the solver move.

        Args:
            environment: One of `boundaries`.
        """
        bounds = [self.boundaries[environment], *(self.solvers.values() if environment == MOON else [])]
        return min(bound.lower for bound in bounds), max(bound.upper for bound in bounds)

    @property
    def apart(self) -> list[str]:
        """Return the environments in which the two engines disagree: intervals without a common mass, or too wide."""
        return [name for name, (lower, upper) in self.mujoco.items() if not self._common(name, lower, upper)]

    def _common(self, environment: str, lower: float, upper: float) -> bool:
        least, most = self.interval(environment)
        return max(lower, least) <= min(upper, most) and upper - lower <= LARGEST_SPREAD

    @property
    def open(self) -> list[str]:
        """Return the environments whose boundary is not found.

        The slower gaits are beside the question: they show where the order of the worlds comes from.
        """
        walked = {name: bound for name, bound in self.boundaries.items() if "stride" not in ENVIRONMENTS[name]}
        solvers = {f"{MOON}, {name}": bound for name, bound in self.solvers.items()}
        bounds = {**walked, **solvers}.items()
        return [name for name, bound in bounds if not (isfinite(bound.lower) and isfinite(bound.upper))]

    @property
    def agrees(self) -> bool:
        """Return whether simulation and statics agree about the robot with locked legs; an open interval never does."""
        lower, upper = self.locked.lower, self.locked.upper
        closed = isfinite(lower) and isfinite(upper)
        return closed and lower - LOCKED_STEP <= self.static <= upper + LOCKED_STEP

    @property
    def holds(self) -> bool:
        """Return whether each boundary is bounded, statics confirms one, and MuJoCo confirms `SECOND_ENGINE`."""
        return self.agrees and not self.open and not self.apart and set(SECOND_ENGINE) <= set(self.mujoco)


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
    solvers = {
        name: payload_problem(phases=PHASES if full else PHASES[::2], **fields).boundary(resolution=1.0, coarse=5.0)
        for name, fields in SOLVERS.items()
    }
    locked = locked_problem()
    simulated = locked.boundary(resolution=LOCKED_STEP, coarse=10.0, repeats=0)
    mujoco = {name: _in_mujoco(ENVIRONMENTS[name], full) for name in SECOND_ENGINE}
    result = PayloadAnswer(boundaries, solvers, simulated, static_limit(locked.testbed), mujoco)
    environments = "; ".join(f"{name} {_range(boundary)}" for name, boundary in boundaries.items())
    settings = "; ".join(f"{name} {_range(boundary)}" for name, boundary in solvers.items())
    feet = "; ".join(f"{name} {limit:.1f} kg" for name, limit in statics(payload_problem().testbed).items())
    engines = "; ".join(f"{name} {lower:g} to {upper:g} kg" for name, (lower, upper) in mujoco.items())
    return Answer(
        id="O4",
        question="How heavy may a component attached to the SpaceClimber's front be before it is no longer stable?",
        answer=moon.lower,
        unit="kg",
        interval=result.interval(MOON),
        paper=PAPER,
        cases=f"{len(boundaries)} environments, {len(moon.by_condition)} start phases of the gait on the moon, "
        f"{len(boundaries[EARTH].by_condition)} elsewhere",
        held_out=f"MuJoCo, its contact, with {len(CONTACTS)} settings: {engines}",
        baseline=f"statics while it walks: {feet}",
        refused=len(result.open),
        holds=result.holds,
        note=(
            "Stable in every rollout up to the first mass, and in none from some start phase at the second; undecided "
            f"between: {environments}. With other settings of the solver, on the moon: {settings}. With locked legs "
            f"{_range(simulated)}, by statics {result.static:.1f} kg. "
            + (f"The engines DISAGREE: {', '.join(result.apart)}." if result.apart else "The engines agree.")
        ),
    )


def _in_mujoco(fields: Mapping[str, Any], full: bool) -> tuple[float, float]:
    """Return the interval of the boundary in MuJoCo, over `CONTACTS`."""
    phases = PHASES if full else PHASES[::2]
    bounds = [
        MujocoClimber(SpaceClimberScenario(**fields), contact=contact).boundary(
            *MUJOCO_MASSES, resolution=1.0, coarse=5.0, phases=phases
        )
        for contact in CONTACTS
    ]
    return min(lower for lower, _ in bounds), max(upper for _, upper in bounds)


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


@dataclass(frozen=True)
class HeadingAnswer:
    """Decisions and climbs of the robot in each crater.

    Attributes:
        cases: The robot's decision among discrete headings in each crater, with the climb straight on beside it.
        searched: Its decisions by a continuous search; empty if not asked for.
        reasons: Crater -> heading that does not pass in the model, in rad -> why, see `crater.explain`.
    """

    cases: tuple[crater.Case, ...]
    searched: tuple[crater.Case, ...]
    reasons: Mapping[int, Mapping[float, list[str]]]

    @property
    def explained(self) -> bool:
        """Return whether there is a reason for each heading that does not pass."""
        return all(all(texts.values()) for texts in self.reasons.values())

    @property
    def warned(self) -> bool:
        """Return whether a decision says of itself that it is poor."""
        return any(case.decision.poor for case in [*self.cases, *self.searched])

    @property
    def straight(self) -> int:
        """Return in how many craters the robot reaches the rim straight on."""
        return sum(case.straight is not None and case.straight.reached for case in self.cases)

    @property
    def holds(self) -> bool:
        """Return whether decisions reach the rim often enough, and more often than without one; none is a miss."""
        reached = sum(case.reached for case in self.cases)
        enough = LEAST_REACHED * len(self.cases)
        better = reached - self.straight >= LEAST_GAIN * len(self.cases)
        searched = sum(case.reached for case in self.searched) >= LEAST_REACHED * len(self.searched)
        return bool(self.cases) and reached >= enough and better and searched and self.explained and not self.warned


def heading(full: bool) -> Answer:
    """Answer R1: which heading takes the robot from the bottom of a crater to its rim?

    The short version decides among the paper's discrete headings in 10 craters, each in a world that differs from the
    robot's model. The long one takes 20, and decides by a continuous search, too. Failing headings are explained in the
    first crater (in the long version in each), and wherever the robot sees no way: a start or a simulation that lets no
    robot walk must not pass for an impassable crater.
    """
    cases = [
        crater.decide_and_climb(seed, difference=seed, baseline=True, samples=SAMPLES)
        for seed in range(20 if full else 10)
    ]
    searched = [
        crater.decide_and_climb(case.seed, difference=case.seed, method="CEM", candidates=24, samples=SAMPLES)
        for case in cases
        if full
    ]
    reasons = {case.seed: _reasons(case) for case in cases if full or case is cases[0] or case.climb is None}
    result = HeadingAnswer(tuple(cases), tuple(searched), reasons)
    notes = [
        "; ".join(_climb(case) for case in cases),
        f"headings that do not pass: {'; '.join(_reasons_text(seed, texts) for seed, texts in reasons.items())}",
    ]
    if full:
        notes.append(f"continuous search: {'; '.join(_climb(case) for case in searched)}")
    heading_deg = np.degrees(cases[0].decision.values.get(crater.HEADING, np.nan))
    reached = sum(case.reached for case in cases)
    return Answer(
        id="R1",
        question="Which heading takes the robot from the bottom of a crater to its rim?",
        answer=f"{heading_deg:.0f} deg in crater 0; the rim reached in {reached} of {len(cases)} craters",
        unit="",
        interval=None,
        paper=crater.PAPER,
        cases=f"the robot's models of {len(cases)} craters",
        held_out="worlds that differ from these models in ground, friction and mass",
        baseline=f"straight on, without a decision, {result.straight} of {len(cases)}",
        refused=sum(case.climb is None for case in cases),
        holds=result.holds,
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
