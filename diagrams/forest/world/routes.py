"""Strip roads of a stand, and the closed routes along them that a driver can choose from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from math import atan2, cos, pi, sin

import numpy as np
from numpy.typing import ArrayLike

from vtbdrake.common.arrays import Array

# The stream of random numbers; `stand` and `ground` have others.
_ROADS = 3

# Distance of the points of a route, in m.
_STEP = 0.25
# Radius of its bends, in m.
_BEND = 6.0
# The distance of the outer roads from the border of the stand, in m.
_BORDER = 8.0
# Roads wind: length of the waves that displace them, in m.
_WINDING = 60.0
# Standard deviation of the displacement, in m.
_ASIDE = 0.8
# Number of waves.
_WAVES = 6


@dataclass(frozen=True, eq=False)
class Route:
    """A closed route in the plane, driven in one direction.

    Attributes:
        points: Points of the route in W at small distances, in m, shape (n, 2), read-only. The first follows the last.
    """

    points: Array

    def __post_init__(self) -> None:
        points = np.array(self.points, dtype=float)
        if points.ndim != 2 or points.shape[1] != 2 or len(points) < 3 or not np.isfinite(points).all():
            raise ValueError(f"a route has at least three finite points (n, 2), not {points.shape}")
        points.flags.writeable = False
        object.__setattr__(self, "points", points)

    @property
    def length(self) -> float:
        """The length of one lap in m."""
        return float(self._marks[-1])

    def position(self, along: float) -> Array:
        """Return the point (2,) in W that is ``along`` m from the beginning; laps follow each other."""
        k, share = self._segment(along)
        first, second = self.points[k], self.points[(k + 1) % len(self.points)]
        point: Array = first + share * (second - first)
        return point

    def heading(self, along: float) -> float:
        """Return the direction of the route (rad) ``along`` m from its beginning."""
        k, _ = self._segment(along)
        x, y = (self.points[(k + 1) % len(self.points)] - self.points[k]).tolist()
        return atan2(y, x)

    def nearest(self, point: ArrayLike) -> float:
        """Return the distance along the route, in m, at which it is nearest to a point (2,) in W."""
        distances = np.sum((self.points - np.asarray(point, dtype=float)) ** 2, axis=1)
        return float(self._marks[int(np.argmin(distances))])

    def distances(self, places: ArrayLike) -> Array:
        """Return the distances of places (n, 2) in W from the route, (n,), in m."""
        return distances([self], places)

    def _segment(self, along: float) -> tuple[int, float]:
        """Return the index of the point before a place on the route, and its share of the way to the next point."""
        along %= self.length
        k = min(int(np.searchsorted(self._marks, along, side="right")) - 1, len(self.points) - 1)
        return k, (along - self._marks.item(k)) / (self._marks.item(k + 1) - self._marks.item(k))

    @cached_property
    def _marks(self) -> Array:
        """The distance of each point from the beginning along the route, and last its length, in m, (n + 1,)."""
        gaps = np.linalg.norm(np.diff(self.points, axis=0, append=self.points[:1]), axis=1)
        return np.concatenate([[0.0], np.cumsum(gaps)])


def distances(routes: Sequence[Route], places: ArrayLike) -> Array:
    """Return the distances in m of places (n, 2) in W from the nearest route, (n,); infinite without routes."""
    from scipy.spatial import cKDTree

    p = np.asarray(places, dtype=float).reshape(-1, 2)
    if not routes:
        return np.full(len(p), np.inf)
    nearest: Array = cKDTree(np.concatenate([route.points for route in routes])).query(p)[0]
    return nearest


def strip_roads(length: float, width: float, *, spacing: float = 28.0, seed: int = 0) -> tuple[Route, ...]:
    """Return the routes along the strip roads of a stand from (0, 0) to (length, width).

    A main road crosses the stand along x in the middle. Side roads leave it to the left and to the right, about
    ``spacing`` apart; along the border, all of them lead back to where the main road begins. Each route begins there,
    follows the main road, takes one of the side roads and comes back. Routes 0, 2, ... turn left, and 1, 3, ... right,
    from the nearest side road to the farthest. Routes are the same until they part. All roads wind a little.

    Strip roads are 3 to 5 m wide and 20 to 70 m apart in Swedish calculations of 1981 ("Profitability of Thinning:
    Short- and Long-Term Considerations", Logging Research Foundation, Stockholm); the pattern is assumed.

    Args:
        length: Extent of the stand along x in m.
        width: Extent of the stand along y in m.
        spacing: Distance of the side roads in m, at least.
        seed: Determines how the roads wind.

    Raises:
        ValueError: The stand is too small for a road with bends, or the roads are too close together.
    """
    least = 2.0 * (_BORDER + 2.0 * _BEND)
    if length < least or width < least:
        raise ValueError(f"a stand with roads is at least {least:g} m long and wide, not {length:g} m x {width:g} m")
    if not spacing >= 2.0 * _BEND:
        raise ValueError(f"side roads are at least {2.0 * _BEND:g} m apart, as bends have a radius of {_BEND:g} m")
    wind = _Winding(seed)
    near, far = _BORDER, length - _BORDER
    sides = max(1, int((far - near) / spacing))
    routes = []
    for x in np.linspace(near, far, sides + 1)[1:].tolist():
        loop = _rounded_rectangle(x - near, width / 2.0 - _BORDER)
        for turn in (1.0, -1.0):
            routes.append(Route(_resampled(wind(loop * [1.0, turn] + [near, width / 2.0]))))
    return tuple(routes)


def _rounded_rectangle(length: float, width: float) -> Array:
    """Return points of a rectangle with two corners at (0, 0) and (length, width), counterclockwise, with bends.

    The first point is behind the bend at (0, 0).
    """
    points = []
    corners = ((length, 0.0), (length, width), (0.0, width), (0.0, 0.0))
    start = np.array([_BEND, 0.0])
    for quarter, corner in enumerate(corners):
        forward = np.array([cos(quarter * pi / 2.0), sin(quarter * pi / 2.0)])
        left = np.array([-forward[1], forward[0]])
        end = np.array(corner) - _BEND * forward
        count = max(1, round(float(np.linalg.norm(end - start)) / _STEP))
        points.append(start + np.linspace(0.0, 1.0, count, endpoint=False)[:, np.newaxis] * (end - start))
        angles = np.linspace(0.0, pi / 2.0, round(_BEND * pi / 2.0 / _STEP), endpoint=False)[:, np.newaxis]
        points.append(end + _BEND * (np.sin(angles) * forward + (1.0 - np.cos(angles)) * left))
        start = end + _BEND * (forward + left)
    return np.concatenate(points)


def _resampled(points: Array) -> Array:
    """Return points at equal distances along a closed polygon."""
    closed = np.vstack([points, points[:1]])
    marks = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))])
    along = np.linspace(0.0, marks[-1], round(marks[-1] / _STEP), endpoint=False)
    return np.column_stack([np.interp(along, marks, closed[:, k]) for k in range(2)])


class _Winding:
    """A smooth displacement of the plane, so that roads that share a place still share it afterwards."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng([seed, _ROADS])
        directions, self._phases = rng.uniform(0.0, 2.0 * pi, (2, 2, _WAVES))
        self._vectors = 2.0 * pi / _WINDING * np.stack([np.cos(directions), np.sin(directions)], axis=1)

    def __call__(self, points: Array) -> Array:
        aside = [np.cos(points @ k + phases).sum(axis=1) for k, phases in zip(self._vectors, self._phases, strict=True)]
        moved: Array = points + _ASIDE * (2.0 / _WAVES) ** 0.5 * np.column_stack(aside)
        return moved
