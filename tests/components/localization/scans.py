"""Scans of trunks, boulders and uneven ground, computed by intersecting rays with exact shapes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from vtbdrake.common.arrays import Array

BREAST = 1.3


def raster(rows: int = 16, columns: int = 1250, elevation: float = np.pi / 6) -> Array:
    """Return unit vectors all around, from the top row to the lowest, (rows columns, 3)."""
    up = np.repeat(elevation * (0.5 - (np.arange(rows) + 0.5) / rows), columns)
    left = np.tile(2.0 * np.pi * ((np.arange(columns) + 0.5) / columns - 0.5), rows)
    return np.stack([np.cos(up) * np.cos(left), np.cos(up) * np.sin(left), np.sin(up)], axis=1)


def flat(places: Array) -> Array:
    return np.zeros(places.shape[:-1])


def hills(places: Array) -> Array:
    """Return the height of a slope of 6 degrees with waves of 0.4 m, 0 at the origin."""
    x, y = places[..., 0], places[..., 1]
    return 0.1 * x + 0.4 * np.sin(2.0 * np.pi * x / 15.0) * np.cos(2.0 * np.pi * y / 18.0)


@dataclass
class Scene:
    """Trunks at places (k, 2) at breast height, with diameters (k,) and leans (k, 2); ellipsoids; the ground.

    An ellipsoid is a row of its centre (3) and its three semi-axes, along x and y turned by an angle (rad), and z.
    """

    places: Array
    diameters: Array
    leans: Array | None = None
    ellipsoids: Array = field(default_factory=lambda: np.zeros((0, 7)))
    height: Callable[[Array], Array] = flat

    def scan(
        self, eye: Array, *, noise: float = 0.0, turn: float = 0.0, seed: int = 0, rows: int = 16
    ) -> tuple[Array, Array]:
        """Return the points that are hit, (n, 3), and by which trunk (k and above: an ellipsoid; -1: the ground), (n,).

        Args:
            eye: Where the rays come from, (3,).
            noise: Standard deviation of the ranges in m.
            turn: By what the rays are turned about z, in rad.
            seed: The seed of the noise.
            rows: How many rows of rays there are.
        """
        c, s = np.cos(turn), np.sin(turn)
        rays = raster(rows) @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        ranges, hit = self._ground(eye, rays), np.full(len(rays), -1)
        leans = np.zeros_like(self.places) if self.leans is None else self.leans
        shapes = [
            trunk_ranges(eye, rays, np.append(place, self.height(place) + BREAST), diameter, lean)
            for place, diameter, lean in zip(self.places, self.diameters, leans, strict=True)
        ]
        shapes += [ellipsoid_ranges(eye, rays, row[:3], row[3:6], row[6]) for row in self.ellipsoids]
        for k, distances in enumerate(shapes):
            hit[distances < ranges] = k
            ranges = np.minimum(ranges, distances)
        seen = np.isfinite(ranges)
        measured = ranges[seen] + noise * np.random.default_rng(seed).normal(size=seen.sum())
        return eye + rays[seen] * measured[:, None], hit[seen]

    def _ground(self, eye: Array, rays: Array, *, reach: float = 35.0, step: float = 1.0) -> Array:
        """Return where rays first go under the ground: in closed form, or by steps and then by halving them."""
        down = np.flatnonzero(rays[:, 2] < 0.2)
        distances = np.full(len(rays), np.inf)
        if self.height is flat:
            down = np.flatnonzero(rays[:, 2] < 0.0)
            distances[down] = -eye[2] / rays[down, 2]
            return np.where(distances < reach, distances, np.inf)
        for far in np.arange(step, reach, step):
            points = eye + far * rays[down]
            under = points[:, 2] < self.height(points[:, :2])
            distances[down[under]] = far
            down = down[~under]
        (hit,) = np.nonzero(distances < np.inf)
        low, high = distances[hit] - step, distances[hit]
        for _ in range(16):
            middle = 0.5 * (low + high)
            points = eye + rays[hit] * middle[:, None]
            under = points[:, 2] < self.height(points[:, :2])
            low, high = np.where(under, low, middle), np.where(under, middle, high)
        distances[hit] = high
        return distances


def trunk_ranges(eye: Array, rays: Array, center: Array, diameter: float, lean: Array) -> Array:
    """Return the distances to an endless trunk whose sections are circles about center + lean z; infinite beside it."""
    start = eye[:2] - center[:2] - lean * (eye[2] - center[2])
    along = rays[:, :2] - lean * rays[:, 2:]
    a, b, c = np.sum(along**2, axis=1), along @ start, start @ start - diameter**2 / 4.0
    root = b**2 - a * c
    distances = (-b - np.sqrt(np.maximum(root, 0.0))) / a
    return np.where((root > 0.0) & (distances > 0.0), distances, np.inf)


def ellipsoid_ranges(eye: Array, rays: Array, center: Array, axes: Array, turn: float) -> Array:
    """Return the distances to an ellipsoid; infinite beside it."""
    c, s = np.cos(turn), np.sin(turn)
    # In coordinates in which it is the unit sphere.
    shrink = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) / axes
    start, along = (eye - center) @ shrink, rays @ shrink
    a, b, c = np.sum(along**2, axis=1), along @ start, start @ start - 1.0
    root = b**2 - a * c
    distances = (-b - np.sqrt(np.maximum(root, 0.0))) / a
    return np.where((root > 0.0) & (distances > 0.0), distances, np.inf)


def pairs(found: Array, places: Array, *, within: float) -> tuple[Array, Array]:
    """Return the indices of what was found and of the nearest place, if it is near enough."""
    distances = np.linalg.norm(found[:, None] - places[None], axis=2)
    nearest = distances.argmin(axis=1)
    matched = np.flatnonzero(distances.min(axis=1) < within)
    return matched, nearest[matched]
