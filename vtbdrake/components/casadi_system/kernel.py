"""A function y(z) and its Jacobian on arrays, at the lowest cost that Python allows."""

from __future__ import annotations

import threading
import weakref
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import casadi
import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.autodiffutils import ExtractGradient, ExtractValue, InitializeAutoDiff

from vtbdrake.components.casadi_system.compiler import compiled, compiled_if_possible
from vtbdrake.components.casadi_system.handler import evaluator

# casadi.SX or casadi.MX, for which CasADi's functions are overloaded one by one.
Expression = Any

TRANSLATIONS: dict[bool | None, Callable[[casadi.Function], casadi.Function]] = {
    True: compiled,
    None: compiled_if_possible,
    False: lambda function: function,
}
LONGEST_JACOBIAN = 10_000
"""The most operations of a Jacobian that is compiled: the time of a compiler grows faster than their number.

The Jacobian of an arm's law with 29,000 operations takes gcc 24 s, with 185,000 minutes and 2.7 GB; interpreted, they
take 0.2 ms and 0.7 ms.
"""
_GENERATING = threading.Lock()
# The expressions and functions of kernels that are gone, until the next kernel is made. CasADi's expressions share
# nodes, and count the references to them without atomics; its Python package gives up the interpreter lock even where
# an object is freed. The garbage collector would do that in any thread, while another one makes expressions.
_SET_ASIDE: list[object] = []


def clamp(value: Expression, lower: Expression, upper: Expression) -> Expression:
    """Return a value within two limits; NaN, which fmin and fmax would drop, stays NaN.

    Args:
        value: The value, shape (n, m).
        lower: The least value, of the same shape or a scalar.
        upper: The largest value, of the same shape or a scalar.
    """
    return casadi.if_else(value > upper, upper, casadi.if_else(value < lower, lower, value))


class Kernel:
    """y(z), for z of shape (n,) and y of shape (m,).

    CasADi gives up the interpreter lock while it evaluates, and a system is evaluated in several threads at once: so
    every thread has its own arrays.

    Args:
        name: The name of the function in messages and files.
        arguments: Symbols of the shapes (n_i, 1), which z holds one after the other.
        y: An expression in the symbols, shape (m, 1).
        compile: Whether to make machine code; None: if there is a C compiler.

    Attributes:
        value: Returns y for the concatenated blocks of z. The thread's next call overwrites the result.
    """

    def __init__(self, name: str, arguments: Sequence[Expression], y: Expression, *, compile: bool | None):
        """Wrap ``y`` (m, 1), an expression in the symbols ``arguments`` (n_i, 1), which z holds one after the other.

        See `CasadiSystem` for ``compile``; a Jacobian above `LONGEST_JACOBIAN` is interpreted.
        """
        _SET_ASIDE.clear()
        self._name = casadi.Function.fix_name(name)
        self._arguments = list(arguments)
        self._y = y
        self._set_aside_at_end(self._arguments, y)
        self._translate = TRANSLATIONS[compile]
        self._jacobian: Buffers | None = None
        self.value = evaluator(self._buffers(self._name, y))

    def expression(self, arguments: Sequence[Expression]) -> Expression:
        """Return y of expressions, which stand for the arguments."""
        function = casadi.Function(self._name, self._arguments, [self._y])
        return function.call(list(arguments), True, False)[0]

    def autodiff(self, blocks: Sequence[ArrayLike]) -> NDArray[np.object_]:
        """Return y of AutoDiffXd, by the chain rule dy = (dy/dz) dz with CasADi's dy/dz."""
        z = np.concatenate(blocks)
        if not z.size:
            y = self.value(blocks)
            return InitializeAutoDiff(y, gradient=np.zeros((y.size, 0))).ravel()
        value = ExtractValue(z).ravel()
        return InitializeAutoDiff(self.value([value]), gradient=self._dy_dz(value) @ ExtractGradient(z)).ravel()

    def _dy_dz(self, z: NDArray[np.float64]) -> NDArray[np.float64]:
        with _GENERATING:
            if self._jacobian is None:
                parts = [casadi.jacobian(self._y, argument) for argument in self._arguments]
                self._jacobian = self._buffers(f"{self._name}_jacobian", casadi.densify(casadi.horzcat(*parts)))
        arguments, evaluate, y = self._jacobian.parts
        arguments[:] = z
        evaluate()
        return y.reshape(z.size, -1).T

    def _buffers(self, name: str, expression: Expression) -> Buffers:
        function = casadi.Function(name, self._arguments, [expression])
        # A function of scalar operations cannot fail; others (a root finder, a solver) report it.
        may_fail = not function.is_a("SXFunction")
        is_long = expression is not self._y and function.n_instructions() > LONGEST_JACOBIAN
        translated = function if is_long else self._translate(function)
        self._set_aside_at_end(function, translated)
        return Buffers(translated, may_fail)

    def _set_aside_at_end(self, *of_casadi: object) -> None:
        weakref.finalize(self, _SET_ASIDE.append, of_casadi).atexit = False


class Buffers(threading.local):
    """The arrays on which one thread evaluates a function.

    Args:
        function: The function.
        may_fail: Whether an evaluation can fail, so that it has to be checked.

    Attributes:
        parts: The array z of the arguments, the function, and the array y of the result; looking them up costs time.
    """

    def __init__(self, function: casadi.Function, may_fail: bool) -> None:
        # What evaluates keeps the buffer alive as little as the buffer keeps the arrays.
        buffer: Any  # whose stubs ask for a size that it does not take
        buffer, evaluate = function.buffer()
        self._buffer = buffer
        z, y = np.zeros(function.nnz_in()), np.zeros(function.nnz_out())
        start = 0
        for i in range(function.n_in()):
            end = start + function.nnz_in(i)
            buffer.set_arg(i, z[start:end].data)
            start = end
        buffer.set_res(0, y.data)
        if may_fail:
            evaluate = partial(_checked, buffer, evaluate, function.name(), z)
        self.parts = z, evaluate, y


def _checked(buffer: casadi.FunctionBuffer, evaluate: Callable[[], None], name: str, z: NDArray[np.float64]) -> None:
    evaluate()
    if buffer.ret():
        raise RuntimeError(f"CasADi could not evaluate {name} at {z.tolist()}")
