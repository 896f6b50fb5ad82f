r"""The ground as the robot believes it to be: a Gaussian Markov random field of heights on a grid.

Before the robot looks, the heights z at the vertices of the grid are a survey plus an error field e, which has the
standard deviation sigma and is correlated over some cells (Lindgren, Rue and Lindstroem, "An explicit link between
Gaussian fields and Gaussian Markov random fields", J. R. Stat. Soc. B 73, 2011):

    B e = s w,    B = k^2 I + L,    s^2 = 4 pi k^2 sigma^2,    k = sqrt(8) cell / range,    w white,

where L is the graph Laplacian of the grid. So the information of e is Q = B^T B / s^2, which is sparse. A measured
point at (x, y) is the bilinear interpolation of the four vertices around it, row A_i, plus an error of variance R:

    (Q + A^T A / R) z = Q survey + A^T m / R.

Where nothing was measured the survey stays, shifted as its surroundings are; a draw differs from it by what is unknown.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from math import pi

import numpy as np
from numpy.typing import ArrayLike
from scipy import sparse
from scipy.sparse.linalg import SuperLU, splu, spsolve_triangular

from vtbdrake.common.arrays import Array

POINT_DEVIATION = 0.1
"""Standard deviation in m that a point of a scan is given as a measurement of the ground: the scanner's, plus stones,
the error of the pose, which all points of a scan share, and the curvature between the vertices."""


class OffTheMapError(ValueError):
    """A place is asked for that the map does not cover."""


@dataclass(frozen=True, eq=False)
class GroundMap:
    """Heights at the vertices of a grid, as a survey and what was measured since.

    Attributes:
        origin: (x, y) of the first vertex in m.
        cell: Distance of the vertices in m.
        survey: Surveyed heights in m, shape (n, m), along x and y.
        deviation: Standard deviation of the survey in m.
        range: Distance in m at which its errors are nearly independent (correlated by 0.1).
        information: A^T A / R of all measured points, sparse, (n m, n m).
        moment: A^T m / R of all measured points, (n m,).
    """

    origin: tuple[float, float]
    cell: float
    survey: Array
    deviation: float
    range: float
    information: sparse.csr_matrix = field(repr=False)
    moment: Array = field(repr=False)

    @classmethod
    def surveyed(
        cls, origin: tuple[float, float], cell: float, survey: ArrayLike, *, deviation: float, range: float
    ) -> GroundMap:
        """Return a map of a survey alone; see the class."""
        survey = np.array(survey, dtype=float)
        n = survey.size
        return cls(origin, cell, survey, deviation, range, sparse.csr_matrix((n, n)), np.zeros(n))

    def covers(self, places: ArrayLike) -> np.ndarray:
        """Return which of the places (x, y), shape (n, 2), lie within the grid, shape (n,)."""
        u = (np.asarray(places, dtype=float).reshape(-1, 2) - self.origin) / self.cell
        inside: np.ndarray = ((u >= 0.0) & (u <= np.array(self.survey.shape) - 1.0)).all(axis=1)
        return inside

    def measured(self, points: Array, *, deviation: float = POINT_DEVIATION) -> GroundMap:
        """Return the map after points of the ground were measured; those beside the map are left out.

        Args:
            points: Points on the ground in m, shape (n, 3).
            deviation: Standard deviation of their heights in m.
        """
        points = points[self.covers(points[:, :2])]
        A = self._interpolation(points[:, :2])
        information = self.information + A.T @ A / deviation**2
        return replace(self, information=information, moment=self.moment + A.T @ points[:, 2] / deviation**2)

    def height(self, places: ArrayLike, heights: Array | None = None) -> Array:
        """Return the heights at places (x, y), shape (n, 2), in m.

        Args:
            places: The places.
            heights: Heights at the vertices, for example a draw; the believed ones by default.

        Raises:
            OffTheMapError: The map does not cover a place.
        """
        places = np.asarray(places, dtype=float).reshape(-1, 2)
        if not (inside := self.covers(places)).all():
            raise OffTheMapError(
                f"{places[~inside][0]} m is beside the map: it begins at {self.origin} m, with "
                f"{self.survey.shape} vertices every {self.cell:g} m"
            )
        z: Array = self._interpolation(places) @ (self.heights if heights is None else heights).ravel()
        return z

    @cached_property
    def heights(self) -> Array:
        """The believed heights at the vertices in m, shape (n, m)."""
        z: Array = self._factors.solve(self._prior_information @ self.survey.ravel() + self.moment)
        return z.reshape(self.survey.shape)

    def deviations(self, vertices: np.ndarray) -> Array:
        """Return the standard deviations in m of the heights at vertices, by their numbers in row-major order."""
        units = np.zeros((self.survey.size, len(vertices)))
        units[vertices, np.arange(len(vertices))] = 1.0
        return np.sqrt(self._factors.solve(units)[vertices, np.arange(len(vertices))])

    def draw(self, rng: np.random.Generator) -> Array:
        """Return heights that the ground may have, by what is known, at the vertices in m, shape (n, m).

        With P (Q + A^T A / R) P^T = L D L^T, they are the believed heights plus P^T L^-T D^-1/2 w, w white.
        """
        factors = self._factors
        white = rng.standard_normal(self.survey.size) / np.sqrt(factors.U.diagonal())
        error: Array = spsolve_triangular(factors.L.T.tocsr(), white, lower=False)[factors.perm_c]
        return self.heights + error.reshape(self.survey.shape)

    def vertices(self) -> Array:
        """Return (x, y) of the vertices in row-major order, shape (n m, 2)."""
        x, y = (
            start + self.cell * np.arange(count) for start, count in zip(self.origin, self.survey.shape, strict=True)
        )
        return np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)

    def _interpolation(self, places: Array) -> sparse.csr_matrix:
        u = (places - self.origin) / self.cell
        rows, columns = self.survey.shape
        i, j = (np.clip(np.floor(u[:, k]).astype(int), 0, count - 2) for k, count in enumerate((rows, columns)))
        a, b = u[:, 0] - i, u[:, 1] - j
        weights = np.stack([(1 - a) * (1 - b), (1 - a) * b, a * (1 - b), a * b], axis=1)
        corners = i * columns + j
        numbers = np.stack([corners, corners + 1, corners + columns, corners + columns + 1], axis=1)
        pointers = np.arange(0, 4 * len(places) + 1, 4)
        return sparse.csr_matrix((weights.ravel(), numbers.ravel(), pointers), shape=(len(places), rows * columns))

    @cached_property
    def _whitening(self) -> tuple[sparse.csr_matrix, float]:
        k = np.sqrt(8.0) * self.cell / self.range
        paths = [sparse.diags([-np.ones(n - 1), -np.ones(n - 1)], [-1, 1], shape=(n, n)) for n in self.survey.shape]
        rows, columns = (sparse.identity(n) for n in self.survey.shape)
        neighbours = sparse.kron(paths[0], columns) + sparse.kron(rows, paths[1])
        L = neighbours - sparse.diags([np.asarray(neighbours.sum(axis=1)).ravel()], [0])
        return (k**2 * sparse.identity(self.survey.size) + L).tocsr(), float(np.sqrt(4.0 * pi) * k * self.deviation)

    @cached_property
    def _prior_information(self) -> sparse.csr_matrix:
        B, s = self._whitening
        return (B.T @ B / s**2).tocsr()

    @cached_property
    def _factors(self) -> SuperLU:
        # Symmetric and positive definite: without pivoting, L U is L D L^T.
        return splu(
            (self._prior_information + self.information).tocsc(),
            permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=0.0,
            options={"SymmetricMode": True},
        )
