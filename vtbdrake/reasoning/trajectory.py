"""Decisions that are whole trajectories: the knots of a spline, within limits that hold between the knots, too."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from math import inf

import numpy as np
from numpy.typing import ArrayLike

from vtbdrake.common.argument_checks import as_array, as_whole
from vtbdrake.common.arrays import Array
from vtbdrake.common.spline import Spline
from vtbdrake.optimization.parameter import Parameter
from vtbdrake.state import Variables

# Rows that are this small beside the largest one are rounding errors of zero.
_NEGLIGIBLE = 1e-12
# A limit this many times as far away as the largest violation is not reached.
_FAR = 1e3
# Limits that are exceeded by less than this share count as kept.
_ROUNDING = 1e-9
# The projection aims below the limits of rates by this share.
_ACCURACY = 1e-5
_LIMITS = ("lower", "upper", "rate", "acceleration")


@dataclass(frozen=True)
class Trajectory:
    """A decision that is a trajectory: a spline whose knots are searched, over a vector command.

    The variable at ``address`` is a plan [t_begin, w_0, ..., w_{n-1}] of 1 + n m entries, as a `SplineCommand` of the
    DPS takes it: the time at which the plan begins, and n knots of m entries. It may be a command (``u.plan``) or any
    other element of the DPS. A search varies one `Parameter` per knot and entry; the reasoner sets t_begin.

    The limits hold at every instant of the plan, not only at the knots: `limited` changes a candidate to keep them. If
    the rate is limited, the plan also begins at the value of the plan in use. (The rate may jump there, whatever the
    acceleration limit.)

    Attributes:
        address: Address of the plan.
        knots: Number n of knots.
        duration: Duration of the plan in seconds, usually the horizon. Afterwards the last value is held.
        order: Kind of the spline: ``zero``, ``linear``, ``cubic`` or ``bspline``, see `Spline`.
        size: Number m of entries of a knot.
        lower, upper: Limits of the value, scalars or one per entry, in its unit.
        rate: Limit of the first derivative by time, positive, a scalar or one per entry.
        acceleration: Limit of the second derivative by time, positive, a scalar or one per entry.

    Raises:
        ValueError: a limit is ill-formed or cannot be kept by splines of this order, or see `Spline`.
    """

    address: str
    knots: int
    duration: float
    order: str = "cubic"
    size: int = field(default=1, kw_only=True)
    lower: ArrayLike = field(kw_only=True)
    upper: ArrayLike = field(kw_only=True)
    rate: ArrayLike = field(default=inf, kw_only=True)
    acceleration: ArrayLike = field(default=inf, kw_only=True)

    def __post_init__(self) -> None:
        if not isinstance(self.address, str):
            raise ValueError(f"a trajectory is named by the address of its plan, a text, not by {self.address!r}")
        size = as_whole(f"the size of {self.address}", self.size)
        if size < 1:
            raise ValueError(f"{self.address} has at least one entry, not {size}")
        object.__setattr__(self, "size", size)
        for name in _LIMITS:
            object.__setattr__(self, name, self._limit(name))
        for derivative, name in enumerate(("rate", "acceleration"), 1):
            limit = np.asarray(getattr(self, name))
            if not (limit > 0.0).all():
                raise ValueError(f"the {name} limit of {self.address} is positive, not {limit.tolist()}")
            if (limit < inf).any() and self.spline.smoothness < derivative:
                raise ValueError(
                    f"a trajectory of order {self.order!r} has no finite {name}, so it cannot keep the {name} limit "
                    f"of {self.address}: take order='cubic' or 'bspline'"
                )
        assert self.parameters  # Their ranges are checked.

    def _limit(self, name: str) -> tuple[float, ...]:
        limit = getattr(self, name)
        try:
            values = np.broadcast_to(np.asarray(limit, dtype=float), (self.size,))
        except (TypeError, ValueError) as error:
            raise ValueError(
                f"{name} of {self.address} is a number, or one for each of its {self.size} entries, not {limit!r}"
            ) from error
        return tuple(values.tolist())

    @cached_property
    def _limits(self) -> Array:
        """Return lower, upper, rate and acceleration, shape (4, m)."""
        return np.array([getattr(self, name) for name in _LIMITS])

    @cached_property
    def spline(self) -> Spline:
        """Return the curve that the knots define."""
        return Spline(self.order, self.knots, self.duration)

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        """Return the n m parameters of a search, knot by knot."""
        ranges = self._limits[:2].T.tolist() * self.spline.knots
        return tuple(Parameter(f"{self.address}[{1 + k}]", *ends) for k, ends in enumerate(ranges))

    @property
    def begin_address(self) -> str:
        """Return the address of t_begin."""
        return f"{self.address}[0]"

    @cached_property
    def _has_only_range(self) -> bool:
        """Return whether neither rate nor acceleration is limited."""
        return not (self._limits[2:] < inf).any()

    @cached_property
    def is_continued(self) -> bool:
        """Return whether a plan begins at the value of the plan in use, as a limited rate requires."""
        return bool((self._limits[2] < inf).any())

    def find(self, variables: Variables) -> None:
        """Check that the testbed has this plan.

        Raises:
            ValueError: There is no such variable, it has another size, or its bounds are narrower than the limits.
        """
        shape = (1 + self.spline.knots * self.size,)
        variable = variables[self.address]
        if variable.shape != shape:
            raise ValueError(
                f"{self.address} has shape {variable.shape}; a plan of {self.spline.knots} knots with {self.size} "
                f"entries each, and the time at which it begins, has shape {shape}"
            )
        for parameter in self.parameters:
            parameter.find(variables)

    def as_numbers(self, plan: ArrayLike) -> list[float]:
        """Return a plan [t_begin, knots] as numbers.

        Raises:
            ValueError: It has another size, or is not finite.
        """
        count = 1 + self.spline.knots * self.size
        numbers = as_array(f"a plan of {self.address}", plan)
        if numbers.shape != (count,) or not np.isfinite(numbers).all():
            raise ValueError(f"a plan of {self.address} is [t_begin, knots], {count} finite numbers, not {plan!r}")
        return numbers.tolist()

    def plan(self, knots: ArrayLike, begin: float) -> Array:
        """Return the whole plan [t_begin, knots].

        Args:
            knots: Shape (n m,) or (n, m).
            begin: Time t_begin in seconds.
        """
        return np.concatenate(([float(begin)], self._matrix(knots).ravel()))

    def plans(self, knots: ArrayLike, begin: float, *, start: ArrayLike | None = None) -> Array:
        """Return the whole plans [t_begin, knots] of N trajectories within the limits, see `limited`.

        Args:
            knots: Shape (N, n m).
            begin: Time t_begin in seconds.
            start: The value at which the trajectories begin, a scalar or shape (m,); None: the value of the first knot.

        Returns:
            Shape (N, 1 + n m).
        """
        n, m = self.spline.knots, self.size
        W = self._within_limits(np.asarray(knots, dtype=float).reshape(-1, n, m), start)
        return np.column_stack((np.full(len(W), float(begin)), W.reshape(-1, n * m)))

    def values(self, knots: ArrayLike, times: ArrayLike, derivative: int = 0) -> Array:
        """Return the trajectory, or a derivative, at some times.

        Args:
            knots: Shape (n m,) or (n, m).
            times: Shape (p,), in seconds since t_begin.
            derivative: Order of the derivative, 0 to 3.

        Returns:
            Shape (p, m).
        """
        return self.spline.matrix(times, derivative) @ self._matrix(knots)

    def shifted(self, knots: ArrayLike, dt: float) -> Array:
        """Return the knots of the same trajectory for a plan that begins ``dt`` seconds later, within the limits.

        It ends with the old last value. Where the new knots cannot follow the old curve exactly, they agree with it
        at the `Spline.sites`.

        Args:
            knots: Shape (n m,) or (n, m).
            dt: Shift in seconds.

        Returns:
            Knots in the shape of those given.
        """
        shifted = self.spline.shift(dt) @ self._matrix(knots)
        return self.limited(shifted, start=shifted[0] if self.is_continued else None).reshape(np.shape(knots))

    def limited(self, knots: ArrayLike, *, start: ArrayLike | None = None) -> Array:
        """Return the nearest knots whose trajectory keeps all limits at every instant.

        A trajectory that keeps them already stays as it is. Any other one is projected, in the Euclidean distance of
        the knots, onto those whose Bezier points keep the limits, see `Spline.bezier`. It may end up a little inside
        the limits.

        Args:
            knots: Shape (n m,) or (n, m).
            start: The value at which the trajectory begins, a scalar or shape (m,); None: the value of the first knot.

        Returns:
            Knots in the shape of those given.
        """
        return self._within_limits(self._matrix(knots)[np.newaxis], start).reshape(np.shape(knots))

    def _within_limits(self, W: Array, start: ArrayLike | None) -> Array:
        """Return the nearest knots within the limits, of N trajectories, shape (N, n, m)."""
        lower, upper = self._limits[:2]
        W = np.clip(W, lower, upper)
        if start is not None:
            W[:, 0] = np.clip(start, lower, upper)
        if not (self.spline.stays_within_knots and self._has_only_range):
            for w in W:
                exceeded = np.max([*self._beyond(w).values()], axis=0) > 0.0
                for j in np.flatnonzero(exceeded).tolist():
                    projected = np.clip(self._projected(w[:, j], j, fixed=int(start is not None)), lower[j], upper[j])
                    w[:, j] = self._slowed(projected, j)
        return W

    def _slowed(self, w: Array, j: int) -> Array:
        """Return the knots of entry ``j``, drawn together towards the first one until the limits of rates are kept.

        The accuracy of the projection is relative to the largest violation, which may be far above what a small rate
        allows.
        """
        factor = 1.0
        for derivative, limit in enumerate(self._limits[2:, j], 1):
            if limit < inf:
                largest = np.abs(self.spline.extremes(w[:, None], derivative)).max()
                factor = min(factor, limit / largest) if largest > limit else factor
        return w if factor == 1.0 else w[0] + factor * (w - w[0])

    def _projected(self, w: Array, j: int, *, fixed: int) -> Array:
        """Return the knots of entry ``j`` nearest to ``w`` that keep its limits; the first ``fixed`` ones are kept."""
        value, speed, change = (self.spline.bezier(derivative) for derivative in range(3))
        lower, upper, rate, acceleration = self._limits[:, j]
        sides = (
            (value, upper),
            (-value, -lower),
            *((sign * speed, (1.0 - _ACCURACY) * rate) for sign in (1, -1)),
            *((sign * change, (1.0 - _ACCURACY) * acceleration) for sign in (1, -1)),
        )
        finite = [(rows, limit) for rows, limit in sides if limit < inf]
        rows = np.concatenate([rows for rows, _ in finite])
        room = np.concatenate([np.full(len(rows), limit) for rows, limit in finite]) - rows @ w
        return w + np.concatenate((np.zeros(fixed), _shortest(rows[:, fixed:], room)))

    def excess(self, knots: ArrayLike) -> dict[str, float]:
        """Return by how much a trajectory exceeds its limits, by ``lower``, ``upper``, ``rate`` and ``acceleration``.

        Args:
            knots: Shape (n m,) or (n, m).
        """
        beyond = {name: float(value.max()) for name, value in self._beyond(self._matrix(knots)).items()}
        return {name: value for name, value in beyond.items() if value > 0.0}

    def _beyond(self, w: Array) -> dict[str, Array]:
        """Return by how much each limit is exceeded, shape (m,) each; not positive where it is kept."""
        lower, upper, *rates = self._limits
        least, most = self.spline.extremes(w)
        tolerance = _ROUNDING * (upper - lower)
        beyond = {"lower": lower - least - tolerance, "upper": most - upper - tolerance}
        for derivative, (name, limit) in enumerate(zip(_LIMITS[2:], rates, strict=True), 1):
            if (limit < inf).any():
                largest = np.max(np.abs(self.spline.extremes(w, derivative)), axis=0)
                beyond[name] = largest - (1.0 + _ROUNDING) * limit
        return beyond

    def _matrix(self, knots: ArrayLike) -> Array:
        w = np.array(knots, dtype=float)
        n, m = self.spline.knots, self.size
        if w.shape not in ((n * m,), (n, m)):
            raise ValueError(f"{self.address} has {n} knots of {m} entries, but those given have shape {w.shape}")
        if not np.isfinite(w).all():
            raise ValueError(f"the knots of {self.address} are finite numbers, not {w.tolist()}")
        return w.reshape(n, m)


def _shortest(rows: Array, room: Array) -> Array:
    """Return the shortest x of shape (n,) with rows x <= room; rows has shape (k, n)."""
    # Imported here: it takes as long as the rest of the package.
    from pydrake.solvers import ClarabelSolver, MathematicalProgram

    length = np.linalg.norm(rows, axis=1)
    bound = length > _NEGLIGIBLE * length.max()
    rows, room = rows[bound] / length[bound, None], room[bound] / length[bound]
    # The largest violation, about the length of x. The solver's accuracy is relative to the largest number, so that
    # limits far away are taken as nearer than they are.
    scale = -room.min()
    if not scale > 0.0:
        return np.zeros(rows.shape[1])
    room = np.minimum(room, _FAR * scale)
    program = MathematicalProgram()
    x = program.NewContinuousVariables(rows.shape[1])
    program.AddQuadraticErrorCost(1.0, np.zeros(len(x)), x)
    program.AddLinearConstraint(rows, np.full(len(room), -inf), room / scale, x)
    result = ClarabelSolver().Solve(program)
    if not result.is_success():
        raise RuntimeError(f"no knots that keep the limits were found: {result.get_solution_result()}")
    return scale * np.asarray(result.GetSolution(x), dtype=float)
