"""Many rollouts of a compiled plant in one call."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import casadi
import numpy as np
from numpy.typing import ArrayLike, NDArray

from vtbdrake.common.arrays import Array
from vtbdrake.components.casadi_system.kernel import TRANSLATIONS, Buffers
from vtbdrake.components.compiled_plant.links import Expression


@dataclass(frozen=True)
class RolloutBatch:
    """The results of n rollouts.

    Attributes:
        costs: The costs, shape (n,).
        overruns: The largest one of all steps, shape (n,); see `plant_step`.
        extents: The sum of all |x| and |u| of a rollout, shape (n,): finite if all states and controls are. A cost may
            drop a NaN, as fmin and fmax do.
        final: The last states, shape (n, nx).
    """

    costs: Array
    overruns: Array
    extents: Array
    final: Array

    @property
    def valid(self) -> NDArray[np.bool_]:
        """Return a mask (n,) of the rollouts that are finite and stay clear of the joint stops, as the plant would.

        Finite are all states, all controls and the cost.
        """
        return np.isfinite(self.costs) & np.isfinite(self.extents) & (self.overruns <= 0.0)


class PlantRollouts:
    """Rolls out many candidates of a control u(t), in one call and without the interpreter lock.

    A candidate has the knots z, shape (K, nu). From x_0, u_k = sum_j B_kj z_j and x_k+1 = step(x_k, u_k), for the steps
    k = 0, ..., N - 1; its cost is sum_k cost(x_k, u_k) + final_cost(x_N). Column j of B is what knot j alone
    contributes, so that B can be a spline of any kind.

    Several threads may call it at once.

    Attributes:
        function: (x0, knots, inputs) -> cost, overrun, extent, final: the rollout of one candidate as a
            `casadi.Function`, for CasADi's solvers; its knots have the shape (nu, K). It is interpreted, and has
            derivatives.
    """

    def __init__(
        self,
        step: casadi.Function,
        *,
        control: ArrayLike,
        cost: Callable[[Expression, Expression], Expression],
        final_cost: Callable[[Expression], Expression] | None = None,
        compile: bool | None = None,
    ) -> None:
        """Translate the rollout of one candidate.

        Args:
            step: (x, u, inputs) -> x_next, overrun; see `plant_step`.
            control: B, shape (N, K).
            cost: Function (x, u) -> scalar, of casadi.SX of the shapes (nx, 1) and (nu, 1).
            final_cost: Function x -> scalar; zero if left out.
            compile: True makes machine code, which is kept for the next time; None does so if there is a C compiler.

        Raises:
            ValueError: B is not a finite matrix.
            CompilerError: There is no C compiler, or it fails.
        """
        B = np.array(control, dtype=float)
        if B.ndim != 2 or not B.size or not np.isfinite(B).all():
            raise ValueError(f"control is a finite matrix of shape (steps, knots), but is {control!r}.")
        self.function = _rollout(step, B, cost, final_cost)
        symbols = self.function.mx_in()
        results = self.function.call(symbols)
        value = results[0]
        slope = casadi.vec(casadi.gradient(value, symbols[1]))
        self._inputs = {name: self.function.numel_in(name) for name in self.function.name_in()[2:]}
        self._knots = self.function.size2_in("knots"), self.function.size1_in("knots")
        translate = TRANSLATIONS[compile]
        self._packed = translate(casadi.Function("plant_rollout", symbols, [casadi.vertcat(*results)]))
        self._sloped = casadi.Function("plant_rollout_slope", symbols, [casadi.vertcat(value, slope)])
        self._translate = translate
        self._buffers: dict[int, Buffers] = {}
        self._lock = threading.Lock()

    def __call__(self, x0: ArrayLike, knots: ArrayLike, **inputs: ArrayLike) -> RolloutBatch:
        """Roll out n candidates.

        Args:
            x0: [q; v] at the begin, of all candidates, shape (nx,), or of each, shape (n, nx).
            knots: Shape (n, K, nu); with one actuator also (n, K).
            inputs: Values of the inputs of ``step`` by name, of all candidates or of each, as ``x0``. So a belief of n
                samples takes one call.

        Raises:
            ValueError: A shape does not fit, or an input is missing or unknown.
        """
        z = self._checked_knots(knots, batch=True)
        n = len(z)
        with self._lock:
            if n not in self._buffers:
                self._buffers[n] = Buffers(self._packed.map(n), may_fail=False)
        result = self._evaluate(self._buffers[n], n, x0, z, inputs).reshape(n, -1)
        return RolloutBatch(result[:, 0], result[:, 1], result[:, 2], result[:, 3:])

    def gradient(self, x0: ArrayLike, knots: ArrayLike, **inputs: ArrayLike) -> tuple[float, Array]:
        """Return the cost of one candidate and its derivative by the knots, exact to rounding.

        Args:
            x0: [q; v] at the begin, shape (nx,).
            knots: Shape (K, nu), or (K,) with one actuator; the derivative has the same shape.
            inputs: Values of the inputs of ``step`` by name.

        Raises:
            ValueError: A shape does not fit, or an input is missing or unknown.
        """
        z = self._checked_knots(knots, batch=False)
        with self._lock:
            # No batch is empty, so 0 is free.
            if 0 not in self._buffers:
                self._buffers[0] = Buffers(self._translate(self._sloped), may_fail=False)
        result = self._evaluate(self._buffers[0], 1, x0, z, inputs)
        return float(result[0]), result[1:].reshape(np.shape(knots))

    def _checked_knots(self, knots: ArrayLike, *, batch: bool) -> Array:
        """Return knots as an array of shape (n, K, nu)."""
        z = np.asarray(knots, dtype=float)
        shapes = [self._knots] if self._knots[1] > 1 else [self._knots, self._knots[:1]]
        if (z.shape[1:] if batch else z.shape) not in shapes or not z.size:
            several = "(n, " if batch else "("
            raise ValueError(f"knots have the shape {several}{self._knots[0]}, {self._knots[1]}), not {z.shape}.")
        return z.reshape(-1, *self._knots)

    def _evaluate(self, buffers: Buffers, n: int, x0: ArrayLike, z: Array, inputs: Mapping[str, ArrayLike]) -> Array:
        if inputs.keys() != self._inputs.keys():
            passed, expected = (", ".join(names) or "none" for names in (inputs, self._inputs))
            raise ValueError(f"the inputs of the step are {expected}, but the values given are of {passed}.")
        arguments, evaluate, result = buffers.parts
        start = 0
        sizes = {"x0": self.function.numel_in("x0"), "knots": z[0].size, **self._inputs}
        for name, value in {"x0": x0, "knots": z.reshape(n, -1), **inputs}.items():
            size = sizes[name]
            array = np.asarray(value, dtype=float)
            if array.shape not in ((size,), (n, size)) and (size, array.ndim) != (1, 0):
                raise ValueError(f"{name} has the shape ({size},) or ({n}, {size}), not {array.shape}.")
            arguments[start : start + n * size].reshape(n, size)[:] = array
            start += n * size
        evaluate()
        # The thread's next call overwrites it.
        return result.copy()


def _rollout(
    step: casadi.Function,
    B: Array,
    cost: Callable[[Expression, Expression], Expression],
    final_cost: Callable[[Expression], Expression] | None,
) -> casadi.Function:
    """Return the function (x0, knots, inputs) -> cost, overrun, extent, final."""
    x, u, *further_inputs = step.sx_in()
    spent, worst, extent = (casadi.SX.sym(name) for name in ("spent", "worst", "extent"))
    x_next, overrun = step.call([x, u, *further_inputs])
    before = casadi.vertcat(x, spent, worst, extent)
    after = casadi.vertcat(
        x_next, spent + cost(x, u), casadi.fmax(worst, overrun), extent + casadi.norm_1(casadi.vertcat(x, u))
    )
    single_step = casadi.Function("one", [before, u, *further_inputs], [after], {"cse": True})
    names = step.name_in()[2:]
    x0, knots = casadi.MX.sym("x0", x.numel()), casadi.MX.sym("knots", u.numel(), B.shape[1])
    inputs = [casadi.MX.sym(name, symbol.numel()) for name, symbol in zip(names, further_inputs, strict=True)]
    steps = len(B)
    controls = knots @ casadi.DM(B.T)
    # B may be sparse (a spline has local support), but its zeros cost less than an index.
    last = single_step.fold(steps)(
        casadi.vertcat(x0, 0.0, -np.inf, 0.0), controls, *(casadi.repmat(value, 1, steps) for value in inputs)
    )
    final, total, largest, magnitude = casadi.vertsplit(last, [0, *range(x.numel(), x.numel() + 4)])
    if final_cost is not None:
        total += casadi.Function("final_cost", [x], [final_cost(x)])(final)
    return casadi.Function(
        "rollout",
        [x0, knots, *inputs],
        [total, largest, magnitude + casadi.norm_1(final), final],
        ["x0", "knots", *names],
        ["cost", "overrun", "extent", "final"],
    )
