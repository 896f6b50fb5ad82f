"""Uneven ground as a sum of waves: the same seed gives the same ground, whose height and slope are known everywhere."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from math import pi

import numpy as np
from numpy.typing import ArrayLike

from vtbdrake.common.arrays import Array
from vtbdrake.common.settings import check_settings, setting
from vtbdrake.components.meshes import Surface

# Least and largest wave length of hills, in m.
_HILLS = (40.0, 150.0)
# Least and largest wave length of bumps, in m.
_BUMPS = (2.5, 8.0)
# Number of waves that make the hills.
_HILL_WAVES = 16
# Number of waves that make the bumps.
_BUMP_WAVES = 48

# The stream of random numbers; `stand` has others.
_GROUND = 2

# The largest distance of the vertices of the ground's mesh, in m.
_MESH_CELL = 0.6


@dataclass(frozen=True)
class Ground:
    """Ground with hills and bumps.

    The height at (x, y) is

        z = sum_i a_i cos(k_i · (x, y) + phi_i)

    with random directions and phases, and wave lengths 2 pi / |k_i| of 40 to 150 m (hills) and 2.5 to 8 m (bumps). The
    waves of a kind have equal amplitudes a_i, so that the height has the given standard deviation. All of it is
    assumed: no survey of forest ground was used.
    """

    seed: int = setting(0, "Determines the waves.", ge=0)
    relief: float = setting(
        0.8, "Standard deviation of the height of hills.", unit="m", ge=0, le=2, remedy="a carrier must drive there"
    )
    bumps: float = setting(
        0.04, "Standard deviation of the height of bumps.", unit="m", ge=0, le=0.08, remedy="a carrier must drive there"
    )

    def __post_init__(self) -> None:
        check_settings(self)

    def height(self, x: ArrayLike, y: ArrayLike) -> Array:
        """Return the height of the ground in m; x and y are in m, of any shapes that broadcast."""
        k_x, k_y, phases, amplitudes = self._waves
        height: Array = np.cos(np.multiply.outer(x, k_x) + np.multiply.outer(y, k_y) + phases) @ amplitudes
        return height

    def height_and_slope(self, x: ArrayLike, y: ArrayLike) -> tuple[Array, Array]:
        """Return the height, and its gradient (dz/dx, dz/dy), shape (..., 2); x and y as for `height`."""
        k_x, k_y, phases, amplitudes = self._waves
        angles = np.multiply.outer(x, k_x) + np.multiply.outer(y, k_y) + phases
        return np.cos(angles) @ amplitudes, -np.sin(angles) @ self._steepness

    def mesh(self, lower: ArrayLike, upper: ArrayLike) -> Surface:
        """Return the ground of a rectangle as triangles whose vertices lie on it.

        Args:
            lower: The least x and y in m, shape (2,).
            upper: The largest x and y in m, shape (2,).
        """
        low, high = np.asarray(lower, dtype=float), np.asarray(upper, dtype=float)
        nx, ny = (np.ceil((high - low) / _MESH_CELL).astype(int) + 1).tolist()
        x, y = np.linspace(low[0], high[0], nx), np.linspace(low[1], high[1], ny)
        # cos(u + v) = cos u cos v - sin u sin v: each wave is a product, so that a grid is a product of two matrices.
        k_x, k_y, phases, amplitudes = self._waves
        u, v = np.multiply.outer(x, k_x) + phases, np.multiply.outer(y, k_y)
        z = (amplitudes * np.cos(u)) @ np.cos(v).T - (amplitudes * np.sin(u)) @ np.sin(v).T
        grid = np.stack([*np.broadcast_arrays(x[:, np.newaxis], y), z], axis=-1)
        a = (ny * np.arange(nx - 1)[:, np.newaxis] + np.arange(ny - 1)).ravel()
        triangles = np.concatenate([np.stack([a, a + ny, a + ny + 1], 1), np.stack([a, a + ny + 1, a + 1], 1)])
        return grid.reshape(-1, 3), triangles

    @cached_property
    def _waves(self) -> tuple[Array, Array, Array, Array]:
        """Wave vectors in x and y (1/m), phases (rad) and amplitudes (m), each (n,)."""
        rng = np.random.default_rng([self.seed, _GROUND])
        kinds = ((_HILLS, _HILL_WAVES, self.relief), (_BUMPS, _BUMP_WAVES, self.bumps))
        lengths = np.concatenate([np.exp(rng.uniform(*np.log(limits), count)) for limits, count, _ in kinds])
        amplitudes = np.concatenate([np.full(count, deviation * (2.0 / count) ** 0.5) for _, count, deviation in kinds])
        directions, phases = rng.uniform(0.0, 2.0 * pi, (2, len(lengths)))
        k = 2.0 * pi / lengths
        return k * np.cos(directions), k * np.sin(directions), phases, amplitudes

    @cached_property
    def _steepness(self) -> Array:
        """The amplitudes of the slopes, (n, 2)."""
        k_x, k_y, _, amplitudes = self._waves
        return np.column_stack([k_x * amplitudes, k_y * amplitudes])
