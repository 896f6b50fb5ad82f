"""Applications O4 and R1 in the table of answers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import ceil, isfinite
from typing import Any

import numpy as np

from vtbdrake.optimization import Boundary
from vtbdrake_diagrams.answers import Answer
from vtbdrake_diagrams.space_climber.scenario import SpaceClimberScenario
from vtbdrake_diagrams.space_climber.studies import crater, perceived
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
from vtbdrake_diagrams.space_climber.studies.rover import FEW_ROCKS, GROUNDS, Ground

# How far simulated and static limit of the locked robot may be apart, in kg: the step at which masses were tried.
LOCKED_STEP = 1.0
# The environments that are simulated in MuJoCo, too.
SECOND_ENGINE = (MOON, EARTH, SLOPE)
# The masses that are tried in MuJoCo, in kg.
MUJOCO_MASSES = (20.0, 60.0)
# How far the boundaries of one environment in MuJoCo may be apart, in kg: a wider interval would agree with anything.
LARGEST_SPREAD = 6.0
# In how many craters of each kind the robot is judged, the share in which it must reach the rim, and by how much more
# than the best baseline.
LEAST_CRATERS = 100
LEAST_REACHED = 0.9
LEAST_GAIN = 0.2
# In how many craters walks are repeated in the short version.
REPEATED = 3


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
class GroundAnswer:
    """The walks of all strategies in the craters of a kind that are judged.

    Attributes:
        crossings: The passable craters in which all strategies have walked, see `perceived.judged`.
    """

    crossings: tuple[perceived.Crossing, ...]

    @property
    def count(self) -> int:
        """Return the number of craters."""
        return len(self.crossings)

    def reached(self, strategy: str) -> int:
        """Return in how many craters a strategy reaches the rim; a robot that stands still has not."""
        return sum(crossing.walks[strategy].reached for crossing in self.crossings)

    @property
    def baseline(self) -> str:
        """Return the best strategy that does not look."""
        return max(perceived.COMPARED[1:], key=self.reached)

    @property
    def refused(self) -> int:
        """Return in how many craters the robot stood still and said why."""
        walks = [crossing.walks[perceived.COMPARED[0]] for crossing in self.crossings]
        return sum(bool(walk.stops) and walk.stops[-1].heading is None for walk in walks)

    @property
    def gain(self) -> float:
        """Return by how much larger the share that reaches the rim is than with the best baseline."""
        return (self.reached(perceived.COMPARED[0]) - self.reached(self.baseline)) / max(self.count, 1)


@dataclass(frozen=True)
class HeadingAnswer:
    """The walks on all grounds, and whether those that were repeated end the same.

    Attributes:
        grounds: The walks by the name of the ground.
        repeated: Name of a walk that was repeated -> whether it ended as in the file.
    """

    grounds: Mapping[str, GroundAnswer]
    repeated: Mapping[str, bool]

    @property
    def together(self) -> GroundAnswer:
        """Return the walks on all grounds, as of one."""
        return GroundAnswer(tuple(crossing for each in self.grounds.values() for crossing in each.crossings))

    @property
    def holds(self) -> bool:
        """Return whether decisions reach the rim often enough, and by far more often than the best baseline.

        Both are judged by all craters together; each kind must have enough of them. On no ground a baseline may be
        better. A refusal is a miss. Walks that were repeated must end as before.
        """
        together, grounds = self.together, self.grounds.values()
        often = together.reached(perceived.COMPARED[0]) >= LEAST_REACHED * together.count
        enough = len(grounds) == len(GROUNDS) and all(each.count >= LEAST_CRATERS for each in grounds)
        better = together.gain >= LEAST_GAIN and all(each.gain >= 0.0 for each in grounds)
        return enough and often and better and all(self.repeated.values())


def heading(full: bool) -> Answer:
    """Answer R1: which heading takes the robot from the bottom of a crater to its rim?

    The robot has a survey, looks, and decides at each stop, see `perceived`. The walks are kept in a file; its program
    adds some. The short version repeats a baseline's in some craters; the long one all in a tenth, the robot's own
    among them.
    """
    walks = perceived.load()
    cases = {ground: perceived.judged(walks, ground) for ground in GROUNDS}
    grounds = {ground.name: GroundAnswer(crossings) for ground, crossings in cases.items()}
    result = HeadingAnswer(grounds, _repeated(cases, full=full))
    reasoned = perceived.COMPARED[0]
    reached = "; ".join(f"{name}: {each.reached(reasoned)} of {each.count}" for name, each in grounds.items())
    baselines = [
        f"{name}: {', '.join(f'{strategy} {each.reached(strategy)}' for strategy in perceived.COMPARED[1:])}"
        for name, each in grounds.items()
    ]
    impassable = sum(each.passable is False for ground in GROUNDS for each in perceived.crossings(walks, ground))
    missed = [
        f"crater {case.seed}: {case.walks[reasoned].reason}"
        for crossings in cases.values()
        for case in crossings
        if not case.walks[reasoned].reached
    ]
    return Answer(
        id="R1",
        question="Which heading takes the robot from the bottom of a crater to its rim?",
        answer=f"decided at each stop; the rim reached with {reached} craters",
        unit="",
        interval=None,
        paper=crater.PAPER,
        cases=f"craters below {FEW_ROCKS.first_seed}",
        held_out=f"craters in which some fixed heading passes; {LEAST_CRATERS} of each kind are asked for",
        baseline="; ".join(baselines),
        refused=sum(each.refused for each in grounds.values()),
        holds=result.holds,
        note=(
            f"No fixed heading passes in {impassable} more. Missed: {'; '.join(missed) or 'none'}. Repeated: "
            f"{', '.join(f'{name}, {_same(same)}' for name, same in result.repeated.items()) or 'none'}. "
            f"{perceived.older()} of the {len(walks)} walks are by an older version of the program."
        ),
    )


def _same(same: bool) -> str:
    return "as in the file" if same else "ANOTHER END"


def _repeated(cases: Mapping[Ground, Sequence[perceived.Crossing]], *, full: bool) -> dict[str, bool]:
    """Return whether walks in craters that are drawn at random end as in the file: in the long version in a tenth."""
    rng = np.random.default_rng()
    walked = [(ground, crossing) for ground, crossings in cases.items() for crossing in crossings]
    count = ceil(0.1 * len(walked)) if full else min(REPEATED, len(walked))
    strategies = perceived.COMPARED if full else ("straight",)
    repeated = {}
    for number in rng.choice(np.arange(len(walked)), count, replace=False):
        ground, crossing = walked[number]
        site = perceived.Site(crossing.seed, ground)
        for strategy in strategies:
            same = site.run(strategy).reached == crossing.walks[strategy].reached
            repeated[f"{strategy} in crater {crossing.seed}"] = same
    return repeated
