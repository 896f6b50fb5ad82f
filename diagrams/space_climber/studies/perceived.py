"""Application R1 from perception to action: the robot sees, builds its world, tries, acts, and looks again.

Before it starts, the robot has a survey from orbit, which is coarse and partly wrong (`survey`). At each stop it looks
around with its laser scanner, adds what it sees to its semantic world model, builds a mental world of that, tries
headings there from its belief, and walks `LEG` seconds in the best one. Slip that it felt on the way is friction of the
patches it walked on. Where it is blocked, it goes back as it came, remembers the place as an obstacle, looks and
decides again; if no heading gains much, it tries to walk backwards, too. It never sees the crater's seed, and of the
true terrain nothing but scans and its own motion.

What a heading is worth is the believed cost to the rim (`route`) at the end of its rollout: less is better. The rollout
tells what the robot's feet do among the rocks and on the slope next to it, the route what lies beyond.

``python -m vtbdrake_diagrams.space_climber.studies.perceived`` runs craters, and adds them to a file of results.
"""

from __future__ import annotations

import ast
import json
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from datetime import date
from functools import cache, cached_property
from hashlib import sha256
from pathlib import Path
from typing import Any

import click
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import ArrayLike
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import MultibodyPlantConfig
from pydrake.systems.analysis import SimulatorConfig

import vtbdrake as vtb
from vtbdrake.common.arrays import Array
from vtbdrake.common.scan import Scan
from vtbdrake.compiled import CompiledRollouts, FixedPiece, Terrain
from vtbdrake.components.world_model import WorldModel
from vtbdrake.reasoning import Budget, Reasoner, SearchConfig
from vtbdrake.rollout import Executor
from vtbdrake.rollout.compiled_executor import CompiledExecutor
from vtbdrake.testbed import VirtualTestbed
from vtbdrake_diagrams.space_climber.believed_scenario import BelievedCraterScenario, believed_world, level_world
from vtbdrake_diagrams.space_climber.believed_terrain import FRICTION, BelievedTerrain, NoReturnError
from vtbdrake_diagrams.space_climber.crater_scenario import ENDS, PASSED, X_BL, CraterScenario
from vtbdrake_diagrams.space_climber.ground_map import OffTheMapError
from vtbdrake_diagrams.space_climber.morphology import Morphology
from vtbdrake_diagrams.space_climber.route import CLEARANCE, Route, route
from vtbdrake_diagrams.space_climber.standing_scanner import StandingScanner
from vtbdrake_diagrams.space_climber.studies.crater import HEADING, LIMIT, MASS, POSE, WALK, differing
from vtbdrake_diagrams.space_climber.survey import survey
from vtbdrake_diagrams.space_climber.terrain import RIM_RADIUS, crater_shapes

PLACE = ("sim.sys.climber.base.x", "sim.sys.climber.base.y")
"""Where the robot is, in m."""

ROCK_COVER = 0.03
"""The share of the ground that rocks cover, as at the least rocky landing sites; see `terrain`."""

FIRST_SEED = 1300
"""Craters from this seed on are judged; those below were looked at."""

LEG = 20.0
"""How long the robot walks until it looks again, in s: 3.8 m on level ground."""

LOOKING = 5.0
"""How long it stands and looks, in s: until it stands, and one scan from then on."""

SEGMENT = 5.0
"""How long the simulated reality goes on in one call, in s."""

TRIED = 28.0
"""Horizon of a rollout in s: longer than a leg, so that it does not end in front of a rock."""

WIDEST_TRIED = np.radians(80.0)
"""How far beside the x axis headings are tried, in rad."""

CANDIDATES = 9
"""How many headings are tried beside the one along the route, 20 deg apart."""

SPEED = 0.19
"""What the robot walks on level ground, in m/s."""

ENOUGH = 0.75
"""The share of the best that is possible from which on no other headings are tried."""

LEAST_GAIN = 0.2
"""A rollout that brings the robot less far down the cost to the rim, in m, brings it nowhere."""

LONGEST = 600.0
"""The longest time that a robot may take, its stops included, in s. Without a detour it takes a little more than 300 s,
so there is time for one. With 450 s, as it was for craters below 1300, walks were cut that still gained; see
docs/crater.md."""

RADIUS = SPEED * TRIED + 3.0
"""How far a mental world reaches, in m."""

TRIED_BACKWARDS = 1.0
"""If no heading gains as much, in m, walking backwards is tried, too."""

BLOCKED_WITHIN = 10.0
"""A robot that came less far than `BLOCKED_WAY` within this time, in s, is blocked."""

BLOCKED_WAY = 0.4
"""See `BLOCKED_WITHIN`; in m. On level ground it would be 1.9 m."""

GOING_BACK = 10.0
"""How long a blocked robot goes back, as it came, before it looks, in s: 1.6 m on level ground."""

BLOCKED_AHEAD = 0.6
"""How far ahead of its middle a blocked robot believes the obstacle to be, in m: beyond its front feet."""

HEADINGS = np.linspace(-LIMIT, LIMIT, 13)
"""Fixed headings in rad, 7.5 deg apart: a crater is passable if one passes; the least steep one is a strategy."""

SIDE_BY_SIDE = 3
"""How many fixed headings walk in one call, until one passes."""

FIXED_STRATEGIES = ("least slope", "straight")
LOOKING_STRATEGIES = ("reasoned", "perceived route")
STRATEGIES = ("reasoned", "surveyed route", "least slope", "straight", "perceived route")
COMPARED = STRATEGIES[:4]
"""The decision, and the baselines that it is compared with. The route over what is seen shows what trying adds."""

RESULTS = Path(__file__).with_name("perceived.jsonl")


@dataclass(frozen=True)
class Stop:
    """What the robot knew and did at one stop.

    Attributes:
        time: Simulated time in s.
        place: Believed place (x, y, z) in m.
        heading: Heading it went on with, in rad; None if it stood still.
        walk: 1 if it walked on in that heading, -1 if it walked backwards.
        tried: Headings in rad that were tried, each with its walk, and by how much it lowers the cost to the rim, in m.
        said: Why the decision is poor, or why it stands still; empty if it is neither.
    """

    time: float
    place: tuple[float, float, float]
    heading: float | None
    walk: float = 1.0
    tried: tuple[tuple[float, float, float], ...] = ()
    said: str = ""


@dataclass(frozen=True)
class Walk:
    """How a strategy ended in a crater.

    Attributes:
        seed: The crater's seed.
        strategy: One of `STRATEGIES`, or a fixed heading.
        reached: Whether the robot passed the rim.
        duration: Simulated time in s.
        end: (x, y, z) of the torso at the end, in m.
        reason: How the simulation ended.
        stops: The stops.
        thinking: Processor time in s of building and trying, over all stops.
    """

    seed: int
    strategy: str
    reached: bool
    duration: float
    end: tuple[float, float, float]
    reason: str
    stops: tuple[Stop, ...] = field(default=(), repr=False)
    thinking: float = 0.0


@dataclass
class CostToRim:
    """The quality of a rollout, which is to be small: the believed cost to the rim in m, see `route`.

    Attributes:
        route: The route over the terrain as it is believed to be now; each stop has another one.
    """

    route: Route

    def __call__(self, x: float, y: float) -> float:
        return self.route.cost_at([float(x), float(y)])


def true_world(seed: int) -> CraterScenario:
    """Return the simulated reality of a crater: friction and mass differ from what is usual, and its ground is wavy."""
    return replace(
        differing(seed, seed).scenario,
        rock_cover=ROCK_COVER,
        scans=True,
        simulator_config=SimulatorConfig(),
        plant_config=MultibodyPlantConfig(
            time_step=0.02,
            contact_model="point",
            discrete_contact_approximation="sap",
            # What contact switches see is then compiled, too.
            use_sampled_output_ports=False,
        ),
    )


class Rover:
    """The robot in the simulated reality, with what it has in its own sensors and estimates.

    Attributes:
        testbed: The simulated reality.
        context: Its state.
        ended: The message with which the simulation ended; empty while it goes on.
    """

    def __init__(self, testbed: VirtualTestbed, *, mass: float) -> None:
        self.testbed = testbed
        self.context = testbed.default_context()
        testbed.write(self.context, {WALK: 0.0, MASS: mass * testbed.read(self.context, MASS)})
        self._simulator = testbed.simulator(self.context)
        self.ended: str = ""

    @property
    def time(self) -> float:
        """Return the simulated time in s."""
        return float(self.context.get_time())

    @property
    def place(self) -> Array:
        """Return where the robot believes to be, (x, y) in m."""
        place: Array = np.array(self.testbed.read(self.context, "dps.impl.navigator.position"))
        return place

    @property
    def yaw(self) -> float:
        """Return the believed azimuth of the robot's x axis in rad."""
        return float(self.testbed.read(self.context, "dps.env.yaw"))

    @property
    def stepped(self) -> Array:
        """Return where its legs have stepped to, (x, y) in m: leg odometry."""
        stepped: Array = np.array(self.testbed.read(self.context, "dps.env.position"))[:2]
        return stepped

    def X_WL(self, terrain: BelievedTerrain) -> RigidTransform:
        """Return the believed pose of the scanner: the elevation is the believed ground's plus the legs' height."""
        rpy = [float(self.testbed.read(self.context, f"dps.env.{name}")) for name in ("roll", "pitch", "yaw")]
        height = float(self.testbed.read(self.context, "dps.env.position")[2])
        place = self.place
        z = float(terrain.ground.height([place])[0]) + height
        return RigidTransform(RollPitchYaw(rpy), [*place, z]) @ X_BL

    def scan(self) -> Scan:
        """Return the last complete scan."""
        scanner = self.testbed.diagram.GetSubsystemByName("sim.sense.scanner")
        scan: Scan = scanner.GetOutputPort("scan").Eval(scanner.GetMyContextFromRoot(self.context))
        return scan

    def advance(self, duration: float, **commands: float) -> None:
        """Give commands, and go on for a time in s, or to the end of the simulation."""
        self.testbed.write(self.context, {f"u.{name}": value for name, value in commands.items()})
        status = self._simulator.AdvanceTo(self.time + duration)
        if status.reason() == status.ReturnReason.kReachedTerminationCondition:
            message = status.FormatMessage()
            self.ended = next((end for end in ENDS if end in message), message)


class CompiledRover(Rover):
    """The same robot in the same world, which is compiled once for all craters; the crater is data.

    It scans when it is asked, as if it had stood still before.

    Args:
        world: The simulated reality.
        terrain: Its ground and boulders.
        scanner: What looks at them.
        mass: Factor of the torso's mass.
    """

    def __init__(self, world: CraterScenario, terrain: Terrain, scanner: StandingScanner, *, mass: float) -> None:
        self.testbed, self._rollouts = compiled_world()
        self._terrain, self._scanner = terrain, scanner
        self.context = self.testbed.default_context()
        pose = np.array(self.testbed.read(self.context, POSE))
        # As high over the highest place under its feet as in the testbed that was compiled.
        pose[2] += _lowest_start(world) - _lowest_start(self.testbed.scenario)
        self.testbed.write(self.context, {WALK: 0.0, MASS: mass * self.testbed.read(self.context, MASS), POSE: pose})
        self.ended: str = ""

    def scan(self) -> Scan:
        pose = np.array(self.testbed.read(self.context, POSE))
        return self._scanner.scan(RigidTransform(RollPitchYaw(pose[3:]), pose[:3]), self.time)

    def advance(self, duration: float, **commands: float) -> None:
        self.testbed.write(self.context, {f"u.{name}": value for name, value in commands.items()})
        (z,), (end,), (self.ended,) = self.simulate(self.states([{}]), self.time, duration)
        self.set_state(z, end)

    def set_state(self, z: Array, time: float) -> None:
        """Set the state to a vector of state and parameters, and the time (s)."""
        self._rollouts.walker.write(z, self.context)
        self.context.SetTime(time)

    def states(self, values: Sequence[Mapping[str, float]]) -> Array:
        """Return the vectors of state and parameters with values by address, a row for each mapping."""
        rows = []
        for each in values:
            self.testbed.write(self.context, each)
            rows.append(self._rollouts.walker.read(self.context))
        return np.array(rows)

    def simulate(self, z: Array, begin: float, duration: float) -> tuple[Array, list[float], list[str]]:
        """Return the states at the end of walks, when they ended (s), and the messages of those that ended early.

        Args:
            z: The states at the begin, shape (n, nz).
            begin: The time at the begin in s.
            duration: How long they go on at most, in s.
        """
        self._rollouts.stand_on(self._terrain)
        z, now, finish = z.copy(), begin, begin + duration
        under_way, ends, messages = np.arange(len(z)), np.full(len(z), finish), [""] * len(z)
        while len(under_way) and now < finish - 0.5 * SEGMENT:
            batch = self._rollouts.from_z(z[under_way], now)
            z[under_way] = batch.final
            for row, k in enumerate(under_way.tolist()):
                if not batch.valid[row]:
                    messages[k], ends[k] = f"{NOT_COMPILED}: {batch.reasons[row]}", now
                elif batch.messages[row]:
                    messages[k] = next(end for end in ENDS if end in batch.messages[row])
                    ends[k] = now + batch.ends[row]
            now = self._rollouts.schedule_at(now)[-1].time
            under_way = np.array([k for k in under_way if not messages[k]], dtype=int)
        ends[under_way] = now
        return z, ends.tolist(), messages


NOT_COMPILED = "the compiled world does not hold"
"""A walk that ends so is none: the world has to be simulated in Drake."""


@cache
def compiled_world() -> tuple[VirtualTestbed, CompiledRollouts]:
    """Return a testbed of the simulated reality, and its compiled rollouts, which stand on any crater."""
    testbed = replace(true_world(0), scans=False, boulders=False, rock_cover=0.0).build()
    rollouts = testbed.compiled(horizon=SEGMENT, sample_period=SEGMENT, parameters=[HEADING, WALK, MASS], check=False)
    return testbed, rollouts


def terrain_of(world: CraterScenario) -> Terrain:
    """Return ground and boulders of a world for `compiled_world`, with its friction of feet and ground."""
    testbed, rollouts = compiled_world()
    feet = testbed.scenario.friction
    ground = combined_friction(world.friction, feet)
    return rollouts.terrain([FixedPiece(shape, X_WS, ground) for _, shape, X_WS in crater_shapes(world.crater)])


def combined_friction(friction: float, feet: float) -> float:
    """Return the friction b of ground that makes a given one with feet of the friction a: Drake has 2 a b / (a + b)."""
    return friction * feet / (2.0 * feet - friction)


def _lowest_start(world: CraterScenario) -> float:
    return float(world.crater.mesh_height(Morphology().stance[:, :2]).max())


@cache
def mental_reasoner() -> tuple[Reasoner, CompiledExecutor, CostToRim, BelievedCraterScenario]:
    """Return the reasoner of all stops, its executor and its quality, whose world and route each stop sets."""
    scenario = believed_world(true_world(0), level_world(), friction=FRICTION[0] - FRICTION[1])
    quality, executor = CostToRim(Route((0.0, 0.0), np.zeros((2, 2)))), CompiledExecutor(compile=True, workers=1)
    return heading_reasoner(scenario, quality, executor=executor), executor, quality, scenario


@dataclass
class Explorer:
    """The robot's head: what it believes, and how it decides at a stop.

    Attributes:
        scenario: The robot's own scenario; of its crater nothing is used.
        terrain: What it believes of the terrain.
        tries: Whether it tries headings in mental worlds; False follows the route.
        draws: In how many draws of the terrain each heading is tried, beside the believed one.
        thinking: Processor time of building and trying so far, in s.
    """

    scenario: CraterScenario
    terrain: BelievedTerrain
    tries: bool = True
    draws: int = 0
    thinking: float = 0.0

    def look(self, rover: Rover) -> str:
        """Add what the robot sees to what it believes; return why it could not, or nothing."""
        try:
            self.terrain = self.terrain.after_scan(rover.scan(), rover.X_WL(self.terrain))
        except (NoReturnError, OffTheMapError) as error:
            return str(error)
        return ""

    def decide(self, rover: Rover) -> Stop:
        """Return the next heading, or why the robot stands still."""
        place = rover.place
        said = self.look(rover)
        here = (float(place[0]), float(place[1]), float(rover.X_WL(self.terrain).translation()[2]) if not said else 0.0)
        if said:
            return Stop(rover.time, here, None, said=said)
        way = route(self.terrain)
        ahead = way.heading(place)
        if not self.tries:
            return Stop(rover.time, here, ahead)
        begin = time.process_time()
        gains = self._try(rover, way, ahead)
        self.thinking += time.process_time() - begin
        (heading, walk), gain = max(gains.items(), key=lambda pair: pair[1])
        tried = tuple((angle, direction, value) for (angle, direction), value in gains.items())
        if gain < LEAST_GAIN:
            said = f"poor: of {len(gains)} headings none lowers the cost to the rim by {LEAST_GAIN:g} m"
        return Stop(rover.time, here, heading, walk, tried, said)

    def _try(self, rover: Rover, way: Route, ahead: float) -> dict[tuple[float, float], float]:
        """Return for the headings (rad) and walks that were tried by how much they lower the cost to the rim, in m."""
        start, grounds = way.cost_at(rover.place), self._grounds(rover.place)
        along = self._gains(rover, way, grounds, (ahead, 1.0), Budget(rollouts=1))
        # As far as the route goes down on the level, over the horizon and without a rock.
        end = way.path(rover.place, length=SPEED * TRIED)[-1]
        if min(along.values(), default=-np.inf) >= ENOUGH * (start - way.cost_at(end)):
            return along
        gains = self._gains(rover, way, grounds, (ahead, 1.0), None)
        if max(gains.values()) < TRIED_BACKWARDS:
            gains |= self._gains(rover, way, grounds, (rover.yaw, -1.0), None)
        return gains

    def _grounds(self, place: Array) -> list[list[FixedPiece]]:
        """Return the pieces of the believed world around a place (x, y) in m, and of draws of it."""
        ground, pieces = self.terrain.ground, mental_reasoner()[3].pieces
        draws = [ground.draw(np.random.default_rng(number)) for number in range(1, self.draws + 1)]
        return [pieces(self._world(place, heights=heights)) for heights in (None, *draws)]

    def _gains(
        self,
        rover: Rover,
        way: Route,
        grounds: Sequence[Sequence[FixedPiece]],
        first: tuple[float, float],
        budget: Budget | None,
    ) -> dict[tuple[float, float], float]:
        """Return for headings (rad) and a walk the least gain in the believed world and in draws of it, in m.

        A failed rollout is a loss of all.

        Args:
            rover: The robot.
            way: The route.
            grounds: The pieces of the believed world, and of draws of it.
            first: Heading and walk that are tried first; the walk is the same for all.
            budget: How many headings are tried.
        """
        reasoner, executor, quality, _ = mental_reasoner()
        (ahead, walk), quality.route, start = first, way, way.cost_at(rover.place)
        rover.testbed.write(rover.context, {HEADING: ahead, WALK: walk})
        gains: dict[tuple[float, float], float] = {}
        for pieces in grounds:
            executor.stand_on(pieces)
            for candidate in reasoner.decide(rover.testbed, rover.context, budget=budget).candidates:
                key = float(candidate.values.get(HEADING, ahead)), walk
                value = float(start - candidate.quality) if np.isfinite(candidate.quality) else -start
                gains[key] = min(gains.get(key, np.inf), value)
        return gains

    def _world(self, place: ArrayLike, *, heights: Array | None = None) -> WorldModel:
        """Return ground and rocks around a place, over the believed ground at this place."""
        near = np.asarray(place, dtype=float).tolist()
        datum = float(self.terrain.ground.height([near], heights)[0])
        return self.terrain.world_model(near=near, radius=RADIUS, heights=heights, datum=datum)

    def mental(self, place: ArrayLike, *, heights: Array | None = None) -> BelievedCraterScenario:
        """Return the mental world around a place as a scenario to simulate: what the robot believes.

        Args:
            place: The place (x, y) in m, whose believed height is 0 in that world.
            heights: Heights at the vertices of the map, for example a draw; the believed ones by default.
        """
        return replace(mental_reasoner()[3], world=self._world(place, heights=heights))

    def felt(self, path: Sequence[Array], stepped: float, *, blocked_by: ArrayLike | None = None) -> None:
        """Take what the robot felt on its way: how far it came by how far it stepped, and what blocked it.

        Args:
            path: Where it was, (x, y) from the begin to the end, in m.
            stepped: How far its legs stepped, in m.
            blocked_by: The place (x, y) in m towards which it came no further.
        """
        if blocked_by is not None:
            self.terrain = self.terrain.after_block(blocked_by)
        way = float(np.linalg.norm(np.diff(np.array(path), axis=0), axis=1).sum())
        if stepped > 0.5:
            self.terrain = self.terrain.after_slip(path, way / stepped)


def heading_reasoner(
    scenario: BelievedCraterScenario, quality: Callable[[float, float], float], *, executor: str | Executor = "serial"
) -> Reasoner:
    """Return the reasoner that decides the next heading.

    Args:
        scenario: The mental world.
        quality: What the place (x, y) at the end of a rollout costs, in m.
        executor: Where the rollouts run.
    """
    return Reasoner(
        scenario=scenario,
        decision=[vtb.Parameter(HEADING, -WIDEST_TRIED, WIDEST_TRIED)],
        quality=vtb.Quality(quality, of=PLACE, reading="end", minimize=True),
        budget=Budget(rollouts=CANDIDATES + 1),
        horizon=TRIED,
        sample_period=4.0,
        search=SearchConfig(method="grid", options={"points": CANDIDATES}, executor=executor),
    )


class Site:
    """A crater with the simulated reality and the survey of it, for all strategies.

    Attributes:
        seed: The crater's seed.
        world: The simulated reality.
        terrain: What is known before the robot looks.
    """

    def __init__(self, seed: int, *, in_drake: bool = False) -> None:
        """Survey a crater.

        Args:
            seed: The crater's seed.
            in_drake: Whether Drake simulates the world, its scanner included, instead of `compiled_world`.
        """
        self.seed: int = seed
        self._in_drake = in_drake
        self.world: CraterScenario = true_world(seed)
        prior = survey(self.world.crater, seed=0)
        self.terrain: BelievedTerrain = BelievedTerrain(prior.ground, prior.rocks)

    @cached_property
    def _compiled_parts(self) -> tuple[Terrain, StandingScanner]:
        return terrain_of(self.world), StandingScanner(self.world.crater)

    def rover(self) -> Rover:
        """Return a robot that stands at the bottom."""
        mass = differing(self.seed, self.seed).mass
        if self._in_drake:
            return Rover(self.world.build(), mass=mass)
        return CompiledRover(self.world, *self._compiled_parts, mass=mass)

    def run(self, strategy: str) -> Walk:
        """Let a strategy of `STRATEGIES` find its way out.

        Raises:
            ValueError: There is no such strategy.
        """
        if strategy in FIXED_STRATEGIES:
            return self.fixed(self.heading_of(strategy), strategy)
        if strategy not in STRATEGIES:
            raise ValueError(f"a strategy is one of {', '.join(STRATEGIES)}, not {strategy!r}")
        return self.explore(strategy)

    def heading_of(self, strategy: str) -> float:
        """Return the heading (rad) of one of `FIXED_STRATEGIES`."""
        return least_slope(self.terrain) if strategy == "least slope" else 0.0

    def explore(self, strategy: str = "reasoned", *, draws: int = 0) -> Walk:
        """Let the robot find its way out with looking, or along the route over the survey.

        Args:
            strategy: ``reasoned`` tries headings, ``perceived route`` follows the route over what it sees, ``surveyed
                route`` that over the survey.
            draws: See `Explorer`.
        """
        rover = self.rover()
        explorer = Explorer(self.world, self.terrain, tries=strategy == "reasoned", draws=draws)
        way = route(self.terrain)
        stops: list[Stop] = []
        while not _is_over(rover):
            if strategy not in LOOKING_STRATEGIES:
                x, y = rover.place.tolist()
                stops.append(Stop(rover.time, (x, y, 0.0), way.heading([x, y])))
                rover.advance(min(LEG, LONGEST - rover.time), heading=way.heading([x, y]), walk=1.0)
                continue
            rover.advance(LOOKING, walk=0.0)
            stops.append(explorer.decide(rover))
            if stops[-1].heading is None or _is_over(rover):
                break
            self._leg(rover, explorer, stops[-1].heading, stops[-1].walk)
        return _walk(self.seed, strategy, rover, stops, explorer.thinking)

    @staticmethod
    def _leg(rover: Rover, explorer: Explorer, heading: float, walk: float) -> None:
        """Walk a leg; a robot that is blocked on its way goes back a little, as it came."""
        path, begun, blocked_by = [rover.place], rover.stepped, None
        within, end = round(BLOCKED_WITHIN / SEGMENT), rover.time + LEG
        while not _is_over(rover, end) and blocked_by is None:
            rover.advance(SEGMENT, heading=heading, walk=walk)
            path.append(rover.place)
            if len(path) > within and np.linalg.norm(path[-1] - path[-1 - within]) < BLOCKED_WAY:
                blocked_by = rover.place + walk * BLOCKED_AHEAD * np.array([np.cos(rover.yaw), np.sin(rover.yaw)])
        explorer.felt(path, float(np.linalg.norm(rover.stepped - begun)), blocked_by=blocked_by)
        if blocked_by is not None:
            yaw, end = rover.yaw, rover.time + GOING_BACK
            while not _is_over(rover, end):
                rover.advance(SEGMENT, heading=yaw, walk=-walk)

    def all_fixed(self, headings: Sequence[float]) -> list[Walk]:
        """Walk in each of the headings (rad) until the end, side by side in the compiled world."""
        if not headings:
            return []
        rover = self.rover()
        assert isinstance(rover, CompiledRover)
        rover.advance(LOOKING, walk=0.0)
        begin = rover.states([{HEADING: heading, WALK: 1.0} for heading in headings])
        z, ends, messages = rover.simulate(begin, rover.time, LONGEST - LOOKING)
        walks = []
        for heading, state, rover.ended, end in zip(headings, z, messages, ends, strict=True):
            rover.set_state(state, end)
            walks.append(_walk(self.seed, heading_name(heading), rover))
        return walks

    def fixed(self, heading: float, strategy: str = "") -> Walk:
        """Walk in one heading (rad) until the end."""
        rover = self.rover()
        rover.advance(LOOKING, walk=0.0)
        rover.advance(LONGEST - LOOKING, heading=heading, walk=1.0)
        return _walk(self.seed, strategy or heading_name(heading), rover)


def heading_name(heading: float) -> str:
    """Return the name of the walk in one heading (rad), which is none of `STRATEGIES`."""
    return f"{np.degrees(heading):g} deg"


def _is_over(rover: Rover, end: float = LONGEST) -> bool:
    return bool(rover.ended) or rover.time > min(end, LONGEST) - 0.5 * SEGMENT


def _walk(seed: int, strategy: str, rover: Rover, stops: Sequence[Stop] = (), thinking: float = 0.0) -> Walk:
    x, y, z = (float(value) for value in rover.testbed.read(rover.context, POSE)[:3])
    reached = PASSED in rover.ended
    reason = rover.ended or ("stands still: " + stops[-1].said if stops and stops[-1].heading is None else "time")
    return Walk(seed, strategy, reached, rover.time, (x, y, z), reason, tuple(stops), thinking)


def least_slope(terrain: BelievedTerrain) -> float:
    """Return the heading in rad, of those at most 45 deg aside, along which the steepest place is the least steep."""
    return by_slope(terrain)[0]


def by_slope(terrain: BelievedTerrain) -> list[float]:
    """Return `HEADINGS`, sorted by how steep the steepest place along them is."""
    gradients, ground = terrain.slopes(), terrain.ground
    along = np.arange(1.0, RIM_RADIUS + 1.0)

    def steepest(heading: float) -> float:
        ways = along[:, None] * [np.cos(heading), np.sin(heading)]
        return float(np.hypot(*(ground.height(ways, gradient) for gradient in gradients)).max())

    return sorted(HEADINGS.tolist(), key=steepest)


@dataclass(frozen=True)
class Crossing:
    """All walks in one crater.

    Attributes:
        seed: The crater's seed.
        walks: The walks by the names of their strategies, and of fixed headings.
    """

    seed: int
    walks: Mapping[str, Walk]

    @property
    def passable(self) -> bool | None:
        """Return whether in the true world some fixed heading of `HEADINGS` reaches the rim; None: not known yet."""
        names = ["straight", "least slope", *map(heading_name, HEADINGS)]
        if any(self.walks[name].reached for name in names if name in self.walks):
            return True
        walked = {*self.walks, *([heading_name(0.0)] if "straight" in self.walks else [])}
        return False if walked.issuperset(map(heading_name, HEADINGS)) else None


def crossings(walks: Sequence[Walk]) -> tuple[Crossing, ...]:
    """Return walks by crater, in the order of the seeds."""
    seeds = sorted({walk.seed for walk in walks})
    return tuple(Crossing(seed, {walk.strategy: walk for walk in walks if walk.seed == seed}) for seed in seeds)


def judged(walks: Sequence[Walk]) -> tuple[Crossing, ...]:
    """Return the passable craters, from `FIRST_SEED` on, in which all of `COMPARED` have walked."""
    return tuple(
        crossing
        for crossing in crossings(walks)
        if crossing.seed >= FIRST_SEED and crossing.passable and crossing.walks.keys() >= set(COMPARED)
    )


@cache
def digest() -> str:
    """Return what a result depends on, as a hash of the code of this module and of the testbed's that it imports.

    Docstrings and comments are not part of it.
    """
    text = "".join(
        f"{path.name}\n{code_without_docstrings(path)}\n" for path in imported_modules(Path(__file__).resolve())
    )
    return sha256(text.encode()).hexdigest()[:16]


def imported_modules(path: Path) -> list[Path]:
    """Return the files of a module and of the testbed's modules that it imports, directly or not, sorted.

    Args:
        path: A file of the testbed.
    """
    folder, package = Path(__file__).resolve().parents[1], __package__.rpartition(".")[0]
    files, todo = set(), {path}
    while todo:
        files |= todo
        nodes = [node for file in todo for node in ast.walk(ast.parse(file.read_text(encoding="utf-8")))]
        names = {name.name for node in nodes if isinstance(node, ast.Import) for name in node.names}
        for node in nodes:
            if isinstance(node, ast.ImportFrom) and node.module:
                # What is imported from a package may be a module.
                names |= {node.module, *(f"{node.module}.{name.name}" for name in node.names)}
        inside = [name.removeprefix(package).lstrip(".") for name in names if f"{name}.".startswith(f"{package}.")]
        places = [folder.joinpath(*name.split(".")) for name in inside]
        modules = {place.with_suffix(".py") for place in places}
        todo = {file for file in modules if file.is_file()} - files
    return sorted(files)


def code_without_docstrings(path: Path) -> str:
    """Return the code of a module without comments and docstrings, also of constants and attributes."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        if isinstance(body := getattr(node, "body", None), list):
            texts = [each for each in body if isinstance(each, ast.Expr) and isinstance(each.value, ast.Constant)]
            node.body = [each for each in body if each not in texts]
    return ast.unparse(tree)


def save(walk: Walk, path: Path = RESULTS) -> None:
    """Append a walk to a file, a line of JSON each, with the digest of the program and the date."""
    record = {"digest": digest(), "date": date.today().isoformat(), **asdict(walk)}
    with path.open("a", encoding="utf-8") as file:
        file.write(json.dumps(record) + "\n")


def load(path: Path = RESULTS) -> tuple[Walk, ...]:
    """Return the walks of a file; none if there is no file.

    Raises:
        ValueError: A line of the file is no walk.
    """
    if not path.exists():
        return ()
    walks = []
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
        try:
            walks.append(_read_walk(json.loads(line)))
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(f"line {number} of {path} is no walk: {error!r}") from error
    return tuple(walks)


def older(path: Path = RESULTS) -> int:
    """Return how many walks of a file are by another version of the program, by its digest."""
    if not path.exists():
        return 0
    present, lines = digest(), path.read_text(encoding="utf-8").splitlines()
    return sum(json.loads(line).get("digest") != present for line in lines)


def _read_walk(record: Mapping[str, Any]) -> Walk:
    stops = tuple(
        Stop(**{**stop, "place": tuple(stop["place"]), "tried": tuple(map(tuple, stop["tried"]))})
        for stop in record["stops"]
    )
    values = {field.name: record[field.name] for field in fields(Walk)}
    return Walk(**{**values, "end": tuple(record["end"]), "stops": stops})


def draw(walk: Walk) -> Figure:
    """Draw a walk on the true crater: what was surveyed, where the robot stopped, and what it tried there.

    Args:
        walk: A walk with stops, from a file of results.
    """
    site = Site(walk.seed)
    crater, figure = site.world.crater, Figure(figsize=(8.0, 7.0), layout="constrained")
    axes = figure.add_subplot(xlabel="x in m", ylabel="y in m", aspect="equal")
    vertices = site.terrain.ground.vertices()
    shape = (*site.terrain.ground.survey.shape, 2)
    x, y = np.moveaxis(vertices.reshape(shape), -1, 0)
    lines = axes.contour(x, y, crater.height(x, y), levels=np.arange(0.5, 6.5, 0.5), cmap="copper", linewidths=0.7)
    axes.clabel(lines, fontsize=7)
    large = [block for block in crater.blocks if block.size[2] > 2.0 * CLEARANCE]
    axes.plot([b.x for b in large], [b.y for b in large], "k.", markersize=3, label="rocks higher than 0.1 m")
    listed = site.terrain.rocks.positions()
    axes.plot(*listed[:, :2].T, "s", color="tab:red", markersize=5, fillstyle="none", label="boulders of the survey")
    for stop in walk.stops:
        for heading, direction, gain in stop.tried:
            along = direction * np.array([np.cos(heading), np.sin(heading)])
            end = np.array(stop.place[:2]) + max(gain, 0.0) * along
            axes.plot(*np.column_stack([stop.place[:2], end]), color="tab:blue", alpha=0.4, linewidth=1.0)
    places = np.array([*(stop.place[:2] for stop in walk.stops), walk.end[:2]])
    axes.plot(*places.T, "o-", color="tab:blue", markersize=4, label="stops; tried headings, as long as they gain")
    axes.legend(loc="lower right", fontsize=8)
    axes.set_title(f"crater {walk.seed}: {_summary(walk)}", fontsize=9)
    return figure


def missing_walks(seed: int, walks: Sequence[Walk], strategies: Sequence[str] = COMPARED) -> Iterator[Walk]:
    """Yield the walks in a crater that are not among others: of strategies, and fixed ones until one passes.

    Args:
        seed: The crater's seed.
        walks: Walks that are there, in this and other craters.
        strategies: The strategies.
    """
    site, there = Site(seed), {walk.strategy: walk for walk in walks if walk.seed == seed}
    fixed = {name: site.heading_of(name) for name in strategies if name in FIXED_STRATEGIES and name not in there}
    for name, walk in zip(fixed, site.all_fixed(list(fixed.values())), strict=True):
        there[name] = replace(walk, strategy=name)
        yield there[name]
    for name in [name for name in strategies if name not in there]:
        there[name] = site.run(name)
        yield there[name]
    # Straight on is one of the fixed headings. Some walk side by side, the most promising ones first.
    open_ = [each for each in by_slope(site.terrain) if each and heading_name(each) not in there]
    while open_ and Crossing(seed, there).passable is None:
        for walk in site.all_fixed(open_[:SIDE_BY_SIDE]):
            there[walk.strategy] = walk
            yield walk
        open_ = open_[SIDE_BY_SIDE:]


@click.command()
@click.option("--first", default=FIRST_SEED, show_default=True, help="Seed of the first crater.")
@click.option("--count", default=1, show_default=True, help="Number of craters.")
@click.option("--file", default=str(RESULTS), show_default=True, help="File of results, to which walks are added.")
@click.option("--figure", default="", help="File of a picture of the first crater's reasoned walk, if there is one.")
@click.option("--strategy", "strategies", multiple=True, default=COMPARED, show_default=True, help="What to compare.")
def main(first: int, count: int, file: str, figure: str, strategies: tuple[str, ...]) -> None:
    """Let the robot find its way out of craters, and compare strategies; walks of the file are not repeated."""
    path = Path(file)
    for seed in range(first, first + count):
        for walk in missing_walks(seed, load(path), strategies):
            save(walk, path)
        crossing = next(each for each in crossings(load(path)) if each.seed == seed)
        for name, walk in crossing.walks.items():
            click.echo(f"crater {seed}, {name}: {_summary(walk)}")
    pictured = [walk for walk in load(path) if walk.seed == first and walk.strategy == "reasoned"]
    if figure and pictured:
        draw(pictured[0]).savefig(figure, dpi=110)
    cases = judged(load(path))
    for strategy in COMPARED:
        count_reached = sum(case.walks[strategy].reached for case in cases)
        click.echo(f"{strategy}: the rim in {count_reached} of {len(cases)} passable craters")


def _summary(walk: Walk) -> str:
    x, y, _ = walk.end
    end = (
        f"the rim in {walk.duration:.0f} s" if walk.reached else f"{np.hypot(x, y):.0f} m from the axis, {walk.reason}"
    )
    thought = f", {len(walk.stops)} stops, {walk.thinking:.0f} s of thinking" if walk.stops else ""
    return end + thought


if __name__ == "__main__":
    # Under its own name, so that its functions can be pickled.
    from vtbdrake_diagrams.space_climber.studies.perceived import main as program

    program(prog_name="python -m vtbdrake_diagrams.space_climber.studies.perceived")
