r"""Routes over believed terrain: the cost from every place to beyond the rim, and the way down that cost.

A metre costs what it takes in time, in metres on level ground: on a slope s with the friction mu the robot advances by
1 - (s / mu)^3.7 of its steps (`SLIP_EXPONENT`), so a metre costs the inverse of it, `STEEPEST` at most. The slope s
is taken in the cells, so that the bottom of a gully costs what its banks cost. A rock that is higher than the feet are
lifted costs `ROCK_COST` more per metre within its radius plus half the robot's width. Around a place where the robot
came no further a metre costs `OBSTACLE_COST` more. The costs to the goal are the costs of shortest paths on a grid with
eight neighbours (Dijkstra; A* finds the same paths from one place).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy import sparse
from scipy.ndimage import map_coordinates
from scipy.sparse.csgraph import dijkstra

from vtbdrake.common.arrays import Array
from vtbdrake_diagrams.space_climber.believed_terrain import SLIP_EXPONENT, BelievedTerrain
from vtbdrake_diagrams.space_climber.terrain import RIM_RADIUS

STEEPEST = 20.0
"""The most that a metre costs on a slope, in m."""

ROCK_COST = 4.0
"""What a metre over a rock costs more, in m."""

HALF_WIDTH = 0.45
"""From the robot's middle to the outside of its feet, in m."""

OBSTACLE_COST = 8.0
"""The additional cost of a metre, in m, where the robot walked before and came no further."""

OBSTACLE_RADIUS = 0.9
"""The distance from such a place up to which `OBSTACLE_COST` holds, in m: the robot's width."""

CLEARANCE = 0.1
"""Height up to which the robot steps over a rock, in m."""

WIDEST = np.radians(45.0)
"""Azimuth to either side of x up to which the question asks for a way; beside it, a metre costs `STEEPEST` more."""

GOAL_RADIUS = RIM_RADIUS + 2.0
"""Distance from the axis at which a route ends, in m."""

# Distance of the nodes in m.
_STEP = 0.5
# (di, dj) of half of the eight neighbours; the way back costs the same.
_NEIGHBOURS = ((1, 0), (0, 1), (1, 1), (1, -1))


@dataclass(frozen=True, eq=False)
class Route:
    """The cost to the goal from every node of a grid.

    Attributes:
        origin: (x, y) of the first node in m.
        cost: The cost to the goal in m, shape (n, m), along x and y.
    """

    origin: tuple[float, float]
    cost: Array

    def cost_at(self, place: ArrayLike) -> float:
        """Return the cost at a place (x, y), interpolated between nodes, and at the next one beside the grid, in m."""
        u = (np.asarray(place, dtype=float)[:2] - self.origin) / _STEP
        return float(map_coordinates(self.cost, u[:, None], order=1, mode="nearest")[0])

    def path(self, place: ArrayLike, *, length: float) -> Array:
        """Return (x, y) of the nodes of the route from a place on, for a length in m, shape (n, 2)."""
        i, j = np.clip(
            np.round((np.asarray(place)[:2] - self.origin) / _STEP).astype(int), 0, np.array(self.cost.shape) - 1
        )
        nodes = [(int(i), int(j))]
        steps = [(di * s, dj * s) for di, dj in _NEIGHBOURS for s in (1, -1)]
        while len(nodes) * _STEP < length and self.cost[nodes[-1]] > 0.0:
            near = [(nodes[-1][0] + di, nodes[-1][1] + dj) for di, dj in steps]
            inside = [n for n in near if 0 <= n[0] < self.cost.shape[0] and 0 <= n[1] < self.cost.shape[1]]
            # By cost and way: a step aside that costs nothing more is none.
            way = {n: self.cost[n] + _STEP * np.hypot(n[0] - nodes[-1][0], n[1] - nodes[-1][1]) for n in inside}
            best = min(way, key=way.__getitem__)
            if self.cost[best] >= self.cost[nodes[-1]]:
                break
            nodes.append(best)
        return np.array(self.origin) + _STEP * np.array(nodes, dtype=float)

    def heading(self, place: ArrayLike, *, ahead: float = 3.0) -> float:
        """Return the azimuth in rad from a place to the route ``ahead`` metres on."""
        dx, dy = self.path(place, length=ahead)[-1] - np.asarray(place)[:2]
        return float(np.arctan2(dy, dx))


def route(terrain: BelievedTerrain) -> Route:
    """Return the route to beyond the rim over the terrain as it is believed to be."""
    ground = terrain.ground
    size = (np.array(ground.survey.shape) - 1.0) * ground.cell
    count = tuple((size / _STEP).astype(int) + 1)
    nodes = np.stack(np.meshgrid(*(np.arange(n) for n in count), indexing="ij")).astype(float)
    at = nodes * _STEP / ground.cell
    steepness = map_coordinates(terrain.steepness(), at - 0.5, order=1, mode="nearest")
    friction = map_coordinates(terrain.cautious_friction, at, order=1)
    share = steepness / friction
    price = 1.0 / np.maximum(1.0 - share**SLIP_EXPONENT, 1.0 / STEEPEST)
    places = nodes * _STEP + np.array(ground.origin)[:, None, None]
    for rock in terrain.rocks:
        if rock.is_known and rock.number("height", unit="m") > 2.0 * CLEARANCE:
            reach = 0.5 * rock.number("width", unit="m") + HALF_WIDTH
            x, y = rock.p_WoOo_W[:2]
            price[np.hypot(places[0] - x, places[1] - y) < reach] += ROCK_COST
    felt = np.zeros(price.shape, dtype=bool)
    for x, y in terrain.obstacles:
        felt |= np.hypot(places[0] - x, places[1] - y) < OBSTACLE_RADIUS
    price[felt] += OBSTACLE_COST
    # Near the axis, where it starts, the robot may be anywhere.
    price[(np.abs(np.arctan2(places[1], places[0])) > WIDEST) & (np.hypot(*places) > 5.0)] += STEEPEST
    return Route(ground.origin, _costs(price, np.hypot(*places) > GOAL_RADIUS))


def _costs(price: Array, is_goal: np.ndarray) -> Array:
    """Return the least cost from each node to a goal, for prices per metre at the nodes."""
    numbers = np.arange(price.size).reshape(price.shape)
    begins, ends, weights = [], [], []
    for di, dj in _NEIGHBOURS:
        a = numbers[: price.shape[0] - di, max(0, -dj) : price.shape[1] - max(0, dj)]
        b = numbers[di:, max(0, dj) : price.shape[1] + min(0, dj)]
        begins.append(a.ravel())
        ends.append(b.ravel())
        weights.append(0.5 * _STEP * np.hypot(di, dj) * (price.ravel()[a] + price.ravel()[b]).ravel())
    edges = (np.concatenate(weights), (np.concatenate(begins), np.concatenate(ends)))
    graph = sparse.csr_matrix(edges, shape=(price.size, price.size))
    cost: Array = dijkstra(graph, directed=False, indices=np.flatnonzero(is_goal.ravel()), min_only=True)
    return cost.reshape(price.shape)
