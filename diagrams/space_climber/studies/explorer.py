"""The robot's head in question R1: what it believes of the terrain, and how it decides at a stop.

What a heading is worth is the believed cost to the rim (`route`) at the end of its rollout: less is better. The rollout
tells what the robot's feet do among the rocks and on the slope next to it, the route what lies beyond.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.typing import ArrayLike

import vtbdrake as vtb
from vtbdrake.common.arrays import Array
from vtbdrake.compiled import FixedPiece
from vtbdrake.components.world_model import WorldModel
from vtbdrake.reasoning import Budget, Reasoner, SearchConfig
from vtbdrake.rollout import Executor
from vtbdrake.rollout.compiled_executor import CompiledExecutor
from vtbdrake_diagrams.space_climber.believed_scenario import BelievedCraterScenario, believed_world, level_world
from vtbdrake_diagrams.space_climber.believed_terrain import FRICTION, BelievedTerrain, NoReturnError
from vtbdrake_diagrams.space_climber.crater_scenario import CraterScenario
from vtbdrake_diagrams.space_climber.ground_map import OffTheMapError
from vtbdrake_diagrams.space_climber.route import Route, route
from vtbdrake_diagrams.space_climber.studies.crater import HEADING, WALK
from vtbdrake_diagrams.space_climber.studies.rover import Rover, true_world

PLACE = ("sim.sys.climber.base.x", "sim.sys.climber.base.y")
"""The addresses of the robot's place in the simulated world, x and y in m."""

TRIED = 28.0
"""Horizon of a rollout in s: longer than a leg, so that it does not end in front of a rock."""

WIDEST_TRIED = np.radians(80.0)
"""Headings are tried up to this angle beside the x axis, in rad."""

CANDIDATES = 9
"""The number of headings, 20 deg apart, that are tried beside the one along the route."""

SPEED = 0.19
"""The robot's speed on level ground, in m/s."""

ENOUGH = 0.75
"""The share of the best that is possible from which on no other headings are tried."""

LEAST_GAIN = 0.2
"""A rollout that brings the robot less far down the cost to the rim, in m, brings it nowhere."""

TRIED_BACKWARDS = 1.0
"""If no heading gains as much, in m, walking backwards is tried, too."""

RADIUS = SPEED * TRIED + 3.0
"""The radius of a mental world around the robot, in m."""


@dataclass(frozen=True)
class Stop:
    """A stop of the robot: what it knew there, and what it decided.

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


@dataclass
class CostToRim:
    """The quality of a rollout, which is to be small: the believed cost to the rim in m, see `route`.

    Attributes:
        route: The route over the terrain as it is believed to be now; each stop has another one.
    """

    route: Route

    def __call__(self, x: float, y: float) -> float:
        return self.route.cost_at([float(x), float(y)])


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
