"""Application R1: the robot stands at the bottom of a crater; which heading takes it to the rim?

The question in the paper's words: s^0 = phi, the heading, in [-45, 45] deg; q(t) = z(t), the elevation; f = z; f_m is
infinite, and t_m is 300 s. The robot asks its own testbed: the rollouts begin at its belief, in its map of the crater.

The world differs from the map, see `differing`: its ground is wavy, its friction and the robot's mass are others.
Friction decides which slope is too steep. The robot knows a range of it, and reasons with the lower end (`CAUTION`), so
that only headings count as passable which are so for all of the range. Among boulders, a decimetre can make the
difference; so each heading can be tried from several samples of the belief; the worst counts.

``python -m vtbdrake_diagrams.space_climber.studies.crater`` draws h over a fine grid of headings (Figure 6), and
compares a continuous search with it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import click
import numpy as np
from pydrake.systems.analysis import SimulatorStatus

import vtbdrake as vtb
from vtbdrake.reasoning import BeliefConfig, Budget, Decision, Reasoner, SearchConfig
from vtbdrake.rollout import RolloutResult, make_executor
from vtbdrake.rollout.executor import run_rollouts
from vtbdrake.testbed import VirtualTestbed
from vtbdrake.visualization.plots import mark_best
from vtbdrake_diagrams.space_climber.crater_scenario import PASSED, CraterScenario

HEADING = "u.heading"
WALK = "u.walk"
ELEVATION = "sim.sys.climber.base.height"
MASS = "sim.sys.climber.base.mass"
POSE = "sim.sys.climber.base.pose"

HORIZON = 300.0
# A multiple of the DPS's period.
SAMPLE_PERIOD = 2.0
# How long the robot may really walk, in s: a heading that passes the rim in the mental copy just in time is not wrong.
LONGEST_CLIMB = 450.0
LIMIT = np.radians(45.0)
HEADINGS = np.radians(np.arange(-45.0, 46.0, 15.0))
PAPER = "0 deg works well"

# A simulated robot that has come no further for so long, in s, is stuck.
PATIENCE = 30.0
# How long the robot stands before it is asked, in s: its estimates are then its own.
STANDING = 2.0

# What a world differs by: ranges of the factors of friction and of the torso's mass, and the standard deviation of its
# ground from the map, in waves of some 2.5 m and more, in m.
FRICTION_RANGE = (0.9, 1.1)
MASS_RANGE = (0.9, 1.1)
WAVINESS = 0.03
# Standard deviations of the believed pose: x and y in m, yaw in rad.
POSE_UNCERTAINTY = (0.1, 0.1, 0.0, 0.0, 0.0, 0.02)
CAUTION = FRICTION_RANGE[0]

# A reason for which a heading may fail -> the change of the scenario's fields that takes it away.
COUNTERFACTUALS: dict[str, Mapping[str, Any]] = {
    "too steep for its friction": {"friction": 1.2},
    "boulders": {"boulders": False},
    "the gully": {"gullies": False},
}


def elevation(z: float) -> float:
    """Return f of the paper: the elevation z over the crater's floor, in m."""
    return max(z, 0.0)


def model(seed: int) -> CraterScenario:
    """Return the robot's model of the crater of this seed, from which it reasons."""
    nominal = CraterScenario(seed=seed, patience=PATIENCE)
    return replace(nominal, friction=CAUTION * nominal.friction)


@dataclass(frozen=True)
class World:
    """A simulated reality, which differs from the robot's model of it.

    Attributes:
        scenario: The scenario with its crater, its waves and its friction.
        mass: Factor of the torso's mass.
    """

    scenario: CraterScenario
    mass: float = 1.0


def differing(seed: int, difference: int) -> World:
    """Return a world with the crater ``seed``; ``difference`` is the seed of friction, mass and waves."""
    rng = np.random.default_rng([seed, difference])
    nominal = CraterScenario(seed=seed)
    friction = nominal.friction * float(rng.uniform(*FRICTION_RANGE))
    world = replace(nominal, friction=friction, waviness=WAVINESS, waviness_seed=difference)
    return World(world, mass=float(rng.uniform(*MASS_RANGE)))


def heading_reasoner(
    scenario: CraterScenario,
    *,
    method: str = "grid",
    candidates: int = HEADINGS.size,
    samples: int = 1,
    horizon: float = HORIZON,
    executor: str = "auto",
    workers: int | None = None,
) -> Reasoner:
    """Return the reasoner of the robot, which decides its heading.

    Args:
        scenario: The robot's model.
        method: ``grid`` for the discrete headings of the paper, or another method for a continuous search.
        candidates: How many headings are tried, beside the plan in use.
        samples: How many samples of the belief each is tried from; with more than one, pose and mass are uncertain.
        horizon: Length of a rollout, in s.
        executor: Where the rollouts run, see `SearchConfig`.
        workers: Number of threads or processes.
    """
    uncertainty = {POSE: POSE_UNCERTAINTY, MASS: _uncertain_mass} if samples > 1 else None
    return Reasoner(
        scenario=scenario,
        decision=[vtb.Parameter(HEADING, -LIMIT, LIMIT)],
        quality=vtb.Quality(elevation, of=ELEVATION),
        budget=Budget(rollouts=(candidates + 1) * samples),
        horizon=horizon,
        sample_period=SAMPLE_PERIOD,
        search=SearchConfig(
            method=method,
            options={"points": candidates} if method == "grid" else {},
            executor=executor,
            workers=workers,
        ),
        belief=BeliefConfig(samples=samples, uncertainty=uncertainty),
    )


def _uncertain_mass(believed: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return believed * rng.uniform(*MASS_RANGE)


def heading_problem(scenario: CraterScenario, *, horizon: float = HORIZON) -> vtb.Problem:
    """Return problem (18) over the heading in the mental copy of a scenario, from its own start, for the landscape."""
    return vtb.Problem(
        scenario=scenario.mental(),
        parameters=[vtb.Parameter(HEADING, -LIMIT, LIMIT)],
        quality=vtb.Quality(elevation, of=ELEVATION),
        horizon=horizon,
        sample_period=SAMPLE_PERIOD,
    )


@dataclass(frozen=True)
class Climb:
    """How a climb ended.

    Attributes:
        heading: Heading in rad.
        reached: Whether the robot has passed the rim.
        elevation: Elevation of the torso at the end, in m.
        duration: Duration in s, from the command on.
        distance: Distance from the crater's axis at the end, in m.
    """

    heading: float
    reached: bool
    elevation: float
    duration: float
    distance: float


class Expedition:
    """A robot in a world: it stands at the bottom, decides about its heading, and goes."""

    def __init__(self, world: World) -> None:
        self.testbed: VirtualTestbed = world.scenario.build()
        context = self.testbed.default_context()
        self.testbed.write(context, {WALK: 0.0, MASS: world.mass * self.testbed.read(context, MASS)})
        self._simulator = self.testbed.simulator(context)
        self._simulator.AdvanceTo(STANDING)

    def decide(self, reasoner: Reasoner) -> Decision:
        """Give the one command, to walk, and let the robot decide in which direction, before it makes a step."""
        context = self._simulator.get_mutable_context()
        self.testbed.write(context, {WALK: 1.0})
        return reasoner.decide(self.testbed, context)

    def climb(self, heading: float) -> Climb:
        """Walk with a heading (rad) until the end, for at most `LONGEST_CLIMB`."""
        context = self._simulator.get_mutable_context()
        self.testbed.write(context, {HEADING: heading, WALK: 1.0})
        begin = context.get_time()
        status = self._simulator.AdvanceTo(begin + LONGEST_CLIMB)
        x, y, z = self.testbed.read(context, POSE)[:3]
        ended = status.reason() == SimulatorStatus.ReturnReason.kReachedTerminationCondition
        return Climb(
            heading=heading,
            reached=ended and PASSED in status.FormatMessage(),
            elevation=float(z),
            duration=context.get_time() - begin,
            distance=float(np.hypot(x, y)),
        )


def passes(rollout: RolloutResult) -> bool:
    """Return whether the robot passes the rim in a rollout."""
    return PASSED in rollout.message


def explain(
    scenario: CraterScenario, headings: Sequence[float], *, executor: str = "processes"
) -> dict[float, list[str]]:
    """Find out why headings fail: which change of the crater takes the robot to the rim.

    Single changes are tried first; where none suffices, pairs of them, and then all three.

    Args:
        scenario: The robot's model.
        headings: Headings in rad.
        executor: See `Problem.sweep`.

    Returns:
        For each heading the reasons among `COUNTERFACTUALS`; several that count together are one, joined by "and". An
        empty list means that not even all changes suffice.
    """
    problem = heading_problem(scenario)
    reasons: dict[float, list[str]] = {heading: [] for heading in headings}
    tries = len(reasons) * len(COUNTERFACTUALS)
    with make_executor(executor, testbed=problem.testbed, rollouts=tries) as workers:
        for size in range(1, len(COUNTERFACTUALS) + 1):
            open_ = [heading for heading, explanations in reasons.items() if not explanations]
            keys = [(names, heading) for names in combinations(COUNTERFACTUALS, size) for heading in open_]
            points = [{HEADING: heading, **_changed(names)} for names, heading in keys]
            results = run_rollouts(workers, problem.task, points, description="counterfactuals")
            for (names, heading), result in zip(keys, results, strict=True):
                if result is not None and passes(result):
                    reasons[heading].append(" and ".join(names))
    return reasons


def _changed(names: Sequence[str]) -> dict[str, Any]:
    return {f"scenario.{field}": value for name in names for field, value in COUNTERFACTUALS[name].items()}


@dataclass(frozen=True)
class Case:
    """One crater: the robot's decision, and its result.

    Attributes:
        seed: Seed of the crater.
        decision: The decision of the robot.
        climb: The climb in the world; None if the robot found no way to the rim.
    """

    seed: int
    decision: Decision
    climb: Climb | None


def decide_and_climb(seed: int, difference: int, **options: Any) -> Case:
    """Let the robot decide in the crater ``seed`` and walk in a world that differs.

    Args:
        seed: Seed of the crater.
        difference: Difference of the world, see `differing`.
        options: Options of `heading_reasoner`.
    """
    expedition = Expedition(differing(seed, difference))
    with heading_reasoner(model(seed), **options) as reasoner:
        decision = expedition.decide(reasoner)
    promising = decision.chosen is not None and all(map(passes, decision.candidates[decision.chosen].rollouts))
    climb = expedition.climb(float(decision.values[HEADING])) if promising else None
    return Case(seed, decision, climb)


@click.command()
@click.option("--seed", default=0, show_default=True, help="Seed of the crater.")
@click.option("--step", default=1.5, show_default=True, help="Step of the grid of headings, in deg.")
@click.option("--candidates", default=24, show_default=True, help="How many headings the continuous search tries.")
@click.option("--horizon", default=HORIZON, show_default=True, help="Horizon of every rollout, in s.")
@click.option("--figure", default="headings.png", show_default=True, help="File of the picture.")
def main(seed: int, step: float, candidates: int, horizon: float, figure: str) -> None:
    """Draw h over the heading in the robot's model of a crater, and search continuously with CEM."""
    degrees = np.degrees(LIMIT)
    sweep = heading_problem(model(seed), horizon=horizon).sweep(round(2.0 * degrees / step) + 1, progress=False)
    passable = [f"{np.degrees(r.parameters[HEADING]):g}" for r in sweep.rollouts if passes(r)]
    click.echo(f"crater {seed}: {len(passable)} of {len(sweep)} headings pass the rim: {', '.join(passable)} deg")
    for method in ("grid", "CEM"):
        count = HEADINGS.size if method == "grid" else candidates
        case = decide_and_climb(seed, difference=seed, method=method, candidates=count, horizon=horizon)
        heading = float(case.decision.values[HEADING])
        ended = "no way seen" if case.climb is None else f"the rim reached in the world: {case.climb.reached}"
        click.echo(
            f"{method}, {count} headings: {np.degrees(heading):.1f} deg, h = {case.decision.quality:.3f} m, {ended}"
        )
        if method == "CEM":
            picture = sweep.plot()
            mark_best(picture.axes[0], heading, float(case.decision.quality), text="found by CEM", size=12)
            picture.savefig(figure, dpi=110)


if __name__ == "__main__":
    # Under its own name, so that worker processes find its functions.
    from vtbdrake_diagrams.space_climber.studies.crater import main as program

    program(prog_name="python -m vtbdrake_diagrams.space_climber.studies.crater")
