"""Splines: curves that are linear in their knots, with their exact extremes between the knots."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from math import comb, factorial, inf, perm
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from vtbdrake.common.argument_checks import as_number, as_whole
from vtbdrake.common.arrays import Array
from vtbdrake.common.spline_kernel import value_at, weights_at

# The least number of knots, by order; and how many derivatives are finite everywhere.
_LEAST_KNOTS = {"zero": 1, "linear": 2, "cubic": 2, "bspline": 4}
_SMOOTHNESS = {"zero": 0, "linear": 1, "cubic": 3, "bspline": 3}
ORDERS = tuple(_LEAST_KNOTS)


@dataclass(frozen=True)
class Spline:
    """A curve y(t) = B(t) w over [0, T], where the matrix B depends on the time alone and w are n knots.

    Before 0 and after T, the curve holds its first and its last value. Its pieces have equal lengths:

    * ``zero``: y = w_k on [k h, (k + 1) h), with h = T / n.
    * ``linear``: through w_k at k h, with h = T / (n - 1).
    * ``cubic``: the natural cubic spline through w_k at k h, with h = T / (n - 1): of all curves through these points
      it bends least, int y''^2 dt is minimal. It may exceed its knots in between.
    * ``bspline``: the uniform cubic B-spline with the control points w_k, clamped: it begins at w_0 and ends at
      w_{n-1}, stays within the range of its knots, and each knot acts on four of its n - 3 pieces.

    Attributes:
        order: ``zero``, ``linear``, ``cubic`` or ``bspline``.
        knots: The number n of knots; a B-spline needs four.
        duration: The duration T in seconds.

    Raises:
        ValueError: There is no such order, there are too few knots, or the duration is not positive.
    """

    order: str
    knots: int
    duration: float

    def __post_init__(self) -> None:
        if self.order not in ORDERS:
            raise ValueError(f"the order of a spline is one of {', '.join(ORDERS)}, not {self.order!r}")
        knots = as_whole("the number of knots", self.knots)
        if knots < _LEAST_KNOTS[self.order]:
            raise ValueError(
                f"a spline of order {self.order!r} has at least {_LEAST_KNOTS[self.order]} knots, not {knots}"
            )
        duration = as_number("the duration of a spline", self.duration)
        if not 0.0 < duration < inf:
            raise ValueError(f"the duration of a spline is positive, in s, not {duration}")
        object.__setattr__(self, "knots", knots)
        object.__setattr__(self, "duration", duration)

    @property
    def smoothness(self) -> int:
        """Return the number of derivatives that are finite everywhere: 0 for steps, 1 for lines, 3 for cubics."""
        return _SMOOTHNESS[self.order]

    @property
    def stays_within_knots(self) -> bool:
        """Return whether the curve never leaves the range of its knots; only a cubic spline may."""
        return self.order != "cubic"

    @cached_property
    def pieces(self) -> Array:
        """Return c of y(t_i + s) = sum_k s^k c[i, k] w for each piece i, shape (pieces, 4, n)."""
        # Imported here: it takes as long as the rest of the package.
        from scipy.interpolate import BSpline, CubicSpline

        n, identity = self.knots, np.eye(self.knots)
        if self.order == "zero":
            c = identity[:, None]
        elif self.order == "linear":
            c = np.stack((identity[:-1], np.diff(identity, axis=0) * (n - 1) / self.duration), axis=1)
        elif self.order == "cubic":
            c = CubicSpline(np.linspace(0.0, self.duration, n), identity, bc_type="natural").c[::-1].swapaxes(0, 1)
        else:
            begins = np.linspace(0.0, self.duration, n - 2)
            basis = BSpline(np.concatenate(([0.0] * 3, begins, [self.duration] * 3)), identity, 3)
            c = np.stack([basis(begins[:-1], nu=k) / factorial(k) for k in range(4)], axis=1)
        pieces = np.concatenate((c, np.zeros((len(c), 4 - c.shape[1], n))), axis=1)
        pieces.flags.writeable = False
        return pieces

    @cached_property
    def step(self) -> float:
        """Return the length h of a piece in seconds."""
        return self.duration / len(self.pieces)

    @cached_property
    def sites(self) -> Array:
        """Return the instants at which n values determine the knots, shape (n,), in seconds.

        They are the knots' times; for a B-spline its Greville abscissae, the means of three successive breaks.
        """
        if self.order == "zero":
            return self.step * np.arange(self.knots, dtype=float)
        if self.order != "bspline":
            return np.linspace(0.0, self.duration, self.knots)
        inner = np.linspace(0.0, self.duration, self.knots - 2)
        padded = np.concatenate(([0.0] * 2, inner, [self.duration] * 2))
        return (padded[:-2] + padded[1:-1] + padded[2:]) / 3.0

    @cached_property
    def _site_values(self) -> Array:
        return self.matrix(self.sites)

    def matrix(self, times: ArrayLike, derivative: int = 0) -> Array:
        """Return B at some times, or one of its derivatives, so that ``matrix(times) @ knots`` are values.

        Args:
            times: Shape (p,), in seconds from the beginning of the curve.
            derivative: 0, 1, 2 or 3.

        Returns:
            Shape (p, n). Where an order jumps, the value is taken from the right-hand side.
        """
        t = np.atleast_1d(np.asarray(times, dtype=float))
        rows = np.array([self.weights(min(max(instant, 0.0), self.duration), derivative) for instant in t.tolist()])
        if derivative:
            rows[(t < 0.0) | (t > self.duration)] = 0.0
        return rows.reshape(len(t), self.knots)

    def weights(self, t: float, derivative: int = 0) -> Array:
        """Return B(t), or a derivative, of one time within [0, duration]; shape (n,).

        Args:
            t: The time, in s.
            derivative: The order of the derivative by time; 0 for B itself.
        """
        return weights_at(self.pieces, self.step, t, derivative)

    def write_value(self, t: float, knots: Array, out: Array) -> None:
        """Write y(t) at one time within [0, duration] into an array, as a system does in every sample.

        Args:
            t: In seconds.
            knots: Shape (n m,), knot by knot.
            out: Shape (m,).
        """
        value_at(self.pieces, self.step, t, knots, out)

    def extremes(self, knots: ArrayLike, derivative: int = 0) -> tuple[Array, Array]:
        """Return the least and the largest value that a curve, or a derivative, takes on [0, duration].

        They are those at the ends of the pieces and at the roots of the next derivative in between: exact, for
        polynomials of third degree.

        Args:
            knots: Shape (n, m), of m curves.
            derivative: 0, 1 or 2.

        Returns:
            Two arrays of shape (m,).
        """
        c = np.einsum("ikn,nm->kim", self.pieces, np.asarray(knots, dtype=float))
        for _ in range(derivative):
            c = np.concatenate((c[1:] * np.array([1.0, 2.0, 3.0])[:, None, None], np.zeros((1, *c.shape[1:]))))
        s = np.stack((np.zeros(c.shape[1:]), np.full(c.shape[1:], self.step), *_roots(c[1], 2 * c[2], 3 * c[3])))
        s = np.clip(np.nan_to_num(s), 0.0, self.step)
        values = c[0] + s * (c[1] + s * (c[2] + s * c[3]))
        return values.min(axis=(0, 1)), values.max(axis=(0, 1))

    def bezier(self, derivative: int = 0) -> Array:
        """Return the matrix that makes the Bezier points of the curve, or of a derivative, from the knots.

        A piece stays within the range of its Bezier points (Farin, Curves and Surfaces for CAGD, ch. 5). So limits that
        hold for these points, which are linear in the knots, hold at every instant. For a B-spline itself, the knots
        take the place of the Bezier points.

        Args:
            derivative: 0, 1 or 2.

        Returns:
            Shape (k, n), where k depends on the order.
        """
        if self.order == "bspline" and not derivative:
            return np.eye(self.knots)
        degree = 3 - derivative
        powers = [
            perm(j + derivative, derivative) * self.step**j * self.pieces[:, j + derivative] for j in range(degree + 1)
        ]
        points = [sum(comb(k, j) / comb(degree, j) * powers[j] for j in range(k + 1)) for k in range(degree + 1)]
        rows = np.concatenate(points)
        # Adjacent pieces share points.
        _, first = np.unique(np.round(rows / np.abs(rows).max(initial=1e-300), 9), axis=0, return_index=True)
        return rows[np.sort(first)]

    def shift(self, dt: float) -> Array:
        """Return the matrix S of shape (n, n) for which S w is the curve w from ``dt`` seconds on.

        At `sites` the two curves agree. They agree everywhere if ``dt`` is a whole number of pieces, as far as the
        curve w reaches, for the orders ``zero`` and ``linear``.
        """
        shift = np.linalg.solve(self._site_values, self.matrix(self.sites + dt))
        return np.asarray(shift, dtype=float)


def _roots(a: Any, b: Any, c: Any) -> tuple[Any, Any]:
    """Return the real roots of a + b s + c s^2, without cancellation; others are NaN or infinite."""
    with np.errstate(divide="ignore", invalid="ignore"):
        q = -0.5 * (b + np.copysign(np.sqrt(b * b - 4.0 * a * c), b))
        return q / c, a / q
