"""What the robot believes of the terrain: heights, rocks, friction, from a survey and what it sees and feels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike
from pydrake.math import RigidTransform
from scipy.ndimage import label

from vtbdrake.common.arrays import Array
from vtbdrake.common.scan import Scan
from vtbdrake.components.world_model import (
    AttributeValue,
    LifeCycleConfig,
    Part,
    Sighting,
    WorldModel,
    WorldObject,
    observe,
    position_estimate,
)
from vtbdrake_diagrams.space_climber.ground_map import GroundMap
from vtbdrake_diagrams.space_climber.terrain import GREY, prism

FRICTION = (0.6, 0.06)
"""Friction of feet and ground before any was felt: mean and standard deviation."""

SLIP_EXPONENT = 3.7
"""On a slope s (rise over run) with the friction mu, the robot advances by the share 1 - (s / mu)^3.7 of its steps: on
20 deg with 0.54 that is 0.77, and 0.76 in the table of docs/crater.md; on s = mu it stays where it is."""

# Range within which points count as ground, and as rocks, in m.
_GROUND_RANGE = 14.0
_ROCK_RANGE = 8.0
# Side of the squares in m whose lower points are taken as ground at first, and the quantile that is.
_SQUARE = 1.0
_QUANTILE = 0.25
# Points within these distances of the surface are ground, in m: at first, and when the surface is known.
_ABOUT_GROUND = 0.12
_ON_GROUND = 0.05
# A point so high over the ground is of a rock, in m.
_OVER_GROUND = 0.07
# Raster in which points of one rock touch each other, in m, and the least number of points.
_RASTER = 0.15
_LEAST_POINTS = 4
# What is wider than this is several rocks, in m.
_WIDEST = 1.2
# Standard deviations of a rock's place and sizes as the scanner sees them, in m.
_SEEN_PLACE = 0.1
_SEEN_SIZE = 0.08
# A rock that is nearer (m) and has at least this many points around it (m) should have been seen.
_EXPECTED_RANGE = 6.0
_AROUND = 0.4
_LEAST_AROUND = 6
# Standard deviation of a friction that follows from slip, and how far beside the path it holds, in m.
_FELT_DEVIATION = 0.04
_FELT_RANGE = 1.5
# Below this slope, or with a larger advance, slip says little about friction: turns and steps cost some of the way.
_LEAST_SLOPE = 0.2
_LARGEST_ADVANCE = 0.6

LIFE_CYCLE = LifeCycleConfig(confirm=1, forget=2, retire=2, revise=1)
"""One scan from a standing robot confirms a rock, two that should have shown it and do not remove it."""


class NoReturnError(ValueError):
    """A scan has no return: nothing can be said about the terrain."""


@dataclass(frozen=True, eq=False)
class BelievedTerrain:
    """The terrain as the robot believes it to be.

    Attributes:
        ground: Heights.
        rocks: The rocks, as objects of a semantic world model.
        friction: Friction of feet and ground at the vertices of ``ground``, shape (n, m); `FRICTION` by default.
        friction_variance: The variance of its error, likewise.
        obstacles: Places (x, y) in m where it walked and came no further, shape (k, 2).
    """

    ground: GroundMap
    rocks: WorldModel
    friction: Array = field(default_factory=lambda: np.zeros(0), repr=False)
    friction_variance: Array = field(default_factory=lambda: np.zeros(0), repr=False)
    obstacles: Array = field(default_factory=lambda: np.zeros((0, 2)), repr=False)

    def __post_init__(self) -> None:
        for name, value in (("friction", FRICTION[0]), ("friction_variance", FRICTION[1] ** 2)):
            if not getattr(self, name).size:
                object.__setattr__(self, name, np.full(self.ground.survey.shape, value))

    @property
    def cautious_friction(self) -> Array:
        """Return the friction less its standard deviation, at the vertices."""
        return np.maximum(self.friction - np.sqrt(self.friction_variance), 0.05)

    def after_scan(self, scan: Scan, X_WL: RigidTransform) -> BelievedTerrain:
        """Return the belief after a scan of a standing robot.

        Low points are ground. What stands out of the ground is a rock; rocks that should have been seen and were not
        are removed in the end (`observe`).

        Args:
            scan: The scan.
            X_WL: The believed pose of the scanner.

        Raises:
            NoReturnError: The scan has no return within range.
        """
        p_WL = X_WL.translation()
        points: Array = (X_WL @ scan.points().T).T if len(scan.ranges) else np.zeros((0, 3))
        away = np.hypot(*(points[:, :2] - p_WL[:2]).T)
        points = points[(away < _GROUND_RANGE) & self.ground.covers(points[:, :2])]
        if not len(points):
            raise NoReturnError(
                f"{scan!r} has no return within {_GROUND_RANGE:g} m on the map: look again, or elsewhere"
            )
        over = points[:, 2] - self.ground.height(points[:, :2])
        low = over - _lower(points[:, :2], over)
        about = self.ground.measured(points[np.abs(low) < _ABOUT_GROUND])
        over = points[:, 2] - about.height(points[:, :2])
        ground = self.ground.measured(points[np.abs(over) < _ON_GROUND])
        over = points[:, 2] - ground.height(points[:, :2])
        near = np.hypot(*(points[:, :2] - p_WL[:2]).T) < _ROCK_RANGE
        sightings = _rocks_of(points[near & (over > _OVER_GROUND)], over[near & (over > _OVER_GROUND)], p_WL, ground)
        expected = self._expected(points, p_WL)
        return replace(self, ground=ground, rocks=observe(self.rocks, sightings, expected=expected, rules=LIFE_CYCLE))

    def after_slip(self, path: ArrayLike, advance: float) -> BelievedTerrain:
        """Return the belief after the robot walked: where it came forward less than it stepped, friction is less.

        Args:
            path: Where it was, (x, y) from the begin to the end, shape (n, 2), in m.
            advance: Its way over the ground by the way that its legs stepped.
        """
        path = np.asarray(path, dtype=float)
        slope = float(np.hypot(*(self.slopes()[axis][self._vertex(path[-1])] for axis in range(2))))
        if slope < _LEAST_SLOPE or advance > _LARGEST_ADVANCE:
            return self
        held_back = np.clip(1.0 - advance, 0.0, 1.0) ** (1.0 / SLIP_EXPONENT)
        measured = slope / max(float(held_back), 0.3)
        if measured > FRICTION[0]:
            return self
        vertices = self.ground.vertices()
        beside = np.linalg.norm(vertices[:, None] - path[None], axis=2).min(axis=1) < _FELT_RANGE
        where = beside.reshape(self.friction.shape)
        gain = np.where(where, self.friction_variance / (self.friction_variance + _FELT_DEVIATION**2), 0.0)
        return replace(
            self,
            friction=self.friction + gain * (measured - self.friction),
            friction_variance=(1.0 - gain) * self.friction_variance,
        )

    def after_block(self, place: ArrayLike) -> BelievedTerrain:
        """Return the belief after the robot walked towards a place (x, y) in m, and came no further."""
        return replace(self, obstacles=np.vstack([self.obstacles, np.asarray(place, dtype=float)]))

    def slopes(self) -> Array:
        """Return the gradients of the believed heights at the vertices, shape (2, n, m)."""
        return np.stack(np.gradient(self.ground.heights, self.ground.cell))

    def steepness(self) -> Array:
        """Return the slopes (rise over run) of the cells between the vertices, shape (n - 1, m - 1).

        On the bottom of a gully the slopes of both banks cancel each other at a vertex, as `slopes` has them, but not
        in the cells.
        """
        along_x, along_y = (np.diff(self.ground.heights, axis=axis) / self.ground.cell for axis in range(2))
        return np.hypot(0.5 * (along_x[:, 1:] + along_x[:, :-1]), 0.5 * (along_y[1:] + along_y[:-1]))

    def world_model(
        self,
        *,
        near: Sequence[float],
        radius: float,
        heights: Array | None = None,
        datum: float = 0.0,
    ) -> WorldModel:
        """Return the semantic world model around a place: patches of ground, and rocks that stand on them.

        A patch is an object of the class ``ground``, square, with the heights of its corners over its origin, their
        standard deviation, and, if slip was felt there, its friction, from which the deviation is already taken away.

        Args:
            near: The place (x, y) in m.
            radius: How far it reaches, in m.
            heights: Heights at the vertices, for example a draw; the believed ones by default.
            datum: The height of the world's origin in m, over which the heights in the world are.

        Raises:
            OffTheMapError: The place is beside the map.
        """
        ground = self.ground
        ground.height([near])
        z = (ground.heights if heights is None else heights) - datum
        vertices = ground.vertices().reshape(*z.shape, 2)
        middles = 0.25 * (vertices[:-1, :-1] + vertices[1:, :-1] + vertices[:-1, 1:] + vertices[1:, 1:])
        offsets = middles - np.asarray(near, dtype=float)
        cells = np.argwhere(np.hypot(offsets[..., 0], offsets[..., 1]) < radius)
        corner = cells[:, :1] * z.shape[1] + cells[:, 1:]
        numbers = corner + np.array([0, z.shape[1], z.shape[1] + 1, 1])
        deviations = ground.deviations(np.unique(numbers))
        deviation_of = dict(zip(np.unique(numbers).tolist(), deviations.tolist(), strict=True))
        friction, untouched = self.cautious_friction, FRICTION[0] - FRICTION[1] - 1e-9
        patches = []
        for (i, j), four in zip(cells.tolist(), numbers.tolist(), strict=True):
            corners = z.ravel()[four]
            deviation = float(np.mean([deviation_of[k] for k in four]))
            height = float(corners.mean())
            attributes = {"size": AttributeValue(ground.cell, "m")}
            attributes |= {f"corner_{k}": AttributeValue(c - height, "m", deviation) for k, c in enumerate(corners)}
            if (felt := friction.ravel()[four]).min() < untouched:
                attributes["friction"] = AttributeValue(float(felt.min()))
            place = position_estimate([*middles[i, j], height], deviation=[0.0, 0.0, deviation])
            patches.append(WorldObject(f"ground-{i}-{j}", "ground", place, attributes))
        return WorldModel([*patches, *self._standing(z, near, radius)])

    def _standing(self, z: Array, near: Sequence[float], radius: float) -> list[WorldObject]:
        """Return the rocks around a place, each with its middle on the surface."""
        rocks = [each for each in self.rocks.find("rock", near=(list(near), radius)) if each.is_known]
        places = np.array([rock.p_WoOo_W for rock in rocks]).reshape(-1, 3)
        inside = self.ground.covers(places[:, :2])
        rocks, places = [rock for rock, is_in in zip(rocks, inside, strict=True) if is_in], places[inside]
        on = self.ground.height(places[:, :2], z)
        return [
            replace(rock, pose=position_estimate([*place[:2], height], deviation=_SEEN_PLACE))
            for rock, place, height in zip(rocks, places, on, strict=True)
        ]

    def _expected(self, points: Array, p_WL: Array) -> list[str]:
        """Return the rocks that a scan with these points should show: near ones, around which it has points."""
        rocks = [rock for rock in self.rocks.find("rock", near=(p_WL[:2], _EXPECTED_RANGE)) if rock.status != "retired"]
        places = np.array([rock.p_WoOo_W[:2] for rock in rocks]).reshape(-1, 2)
        distances = np.linalg.norm(places[:, None] - points[None, :, :2], axis=2)
        around = (distances < _AROUND).sum(axis=1)
        return [rock.identity for rock, count in zip(rocks, around, strict=True) if count >= _LEAST_AROUND]

    def _vertex(self, place: Array) -> tuple[int, int]:
        i, j = np.round((place - self.ground.origin) / self.ground.cell).astype(int).tolist()
        return i, j


def _lower(places: Array, over: Array) -> Array:
    """Return for each point the lower quantile of the heights in its square, shape (n,)."""
    squares = np.floor(places / _SQUARE).astype(int)
    _, square = np.unique(squares, axis=0, return_inverse=True)
    square = square.ravel()
    order = np.lexsort((over, square))
    begins = np.flatnonzero(np.diff(square[order], prepend=-1))
    counts = np.diff(np.append(begins, len(order)))
    lower: Array = over[order][begins + (_QUANTILE * (counts - 1)).astype(int)]
    return lower[square]


def _rocks_of(points: Array, over: Array, p_WL: Array, ground: GroundMap) -> list[Sighting]:
    """Return the rocks that points over the ground show: those that touch each other on a raster are of one.

    Only the side towards the scanner is seen. So a rock is taken as round: as deep as it is wide.
    """
    if not len(points):
        return []
    raster = np.floor(points[:, :2] / _RASTER).astype(int)
    raster -= raster.min(axis=0)
    occupied = np.zeros(raster.max(axis=0) + 1, dtype=bool)
    occupied[tuple(raster.T)] = True
    numbers, _ = label(occupied, structure=np.ones((3, 3)))
    cluster = numbers[tuple(raster.T)]
    sightings = []
    for number in np.unique(cluster):
        members, heights = points[cluster == number], over[cluster == number]
        parts = np.zeros(len(members), dtype=int)
        if np.ptp(members[:, :2], axis=0).max() > _WIDEST:
            _, parts = np.unique(np.floor(members[:, :2] / (0.5 * _WIDEST)).astype(int), axis=0, return_inverse=True)
        for part in np.unique(parts):
            members_of_part = parts.ravel() == part
            if members_of_part.sum() >= _LEAST_POINTS:
                sightings.append(
                    _sighting(members[members_of_part], float(heights[members_of_part].max()), p_WL, ground)
                )
    return sightings


def _sighting(points: Array, height: float, p_WL: Array, ground: GroundMap) -> Sighting:
    away = points[:, :2].mean(axis=0) - p_WL[:2]
    ahead = away / np.linalg.norm(away)
    along, across = points[:, :2] @ ahead, points[:, :2] @ [-ahead[1], ahead[0]]
    diameter = max(float(np.ptp(across)) + 0.05, 1.5 * height)
    u, v = float(along.min()) + 0.5 * diameter, float(0.5 * (across.min() + across.max()))
    x, y = u * ahead + v * np.array([-ahead[1], ahead[0]])
    z = float(ground.height([[x, y]])[0]) if ground.covers([[x, y]])[0] else float(points[:, 2].min())
    lengths = {"length": diameter, "width": diameter, "height": 2.0 * height}
    attributes = {name: AttributeValue(value, "m", _SEEN_SIZE) for name, value in lengths.items()}
    place = position_estimate([float(x), float(y), z], deviation=_SEEN_PLACE)
    return Sighting("rock", place, attributes, source="scanner")


def ground_parts(patch: WorldObject, *, feet: float) -> Sequence[Part]:
    """Return the two prisms of a patch of ground with the attributes of `BelievedTerrain.world_model`.

    Args:
        patch: The patch. Without a friction, it has the plant's default.
        feet: The coefficient of friction of the feet's material: Drake combines a and b of two bodies to
            2 a b / (a + b), which is to be the friction that was felt.
    """
    half = 0.5 * patch.number("size", unit="m")
    corners = np.array([[-half, -half, 0.0], [half, -half, 0.0], [half, half, 0.0], [-half, half, 0.0]])
    corners[:, 2] = [patch.number(f"corner_{k}", unit="m") for k in range(4)]
    friction = None
    if "friction" in patch.attributes:
        both = min(patch.number("friction", unit="1"), 1.9 * feet)
        friction = both * feet / (2.0 * feet - both)
    parts = []
    for name, triangle in (("south", [0, 1, 2]), ("north", [0, 2, 3])):
        X_OS, shape = prism(corners[triangle])
        parts.append(Part(name, shape, X_OS, tuple(GREY), friction=friction))
    return parts
