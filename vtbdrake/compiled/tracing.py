"""Functions of numbers, written in Python, as functions of CasADi."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from math import inf, isfinite, nan
from typing import Any

import casadi
import numpy as np

from vtbdrake.common.failures import FAILURES

_TRIALS = 5
_TOLERANCE = 1e-12
_PROBES = (0.0, -1.0, 0.5, -0.5, 1.5, 2.5, 1e3, -1e3)


def traced(f: Callable[..., Any], arguments: Sequence[Any]) -> casadi.Function | None:
    """Return a function of numbers and arrays as one of CasADi, or None if it cannot be written as one.

    It is called with symbols: sums, products and numpy's functions go through; a branch, a conversion to float or a
    call of another library does not. The result is compared with f near the arguments, and where f may branch: at 0,
    halves, and large numbers. It is NaN for arguments that are not finite, for which f may return a number.

    Args:
        f: The function, which returns a number; a `casadi.Function` is itself.
        arguments: Arguments for which it can be called, floats and arrays.
    """
    if isinstance(f, casadi.Function):
        return f
    try:
        symbols = [casadi.SX.sym(f"a{k}", int(np.size(a))) for k, a in enumerate(arguments)]
        with warnings.catch_warnings():  # CasADi announces another behaviour of numpy's functions.
            warnings.simplefilter("ignore")
            value = f(*(_symbolic(s, a) for s, a in zip(symbols, arguments, strict=True)))
        expression = casadi.SX(value)
        finite = casadi.sumsqr(casadi.vertcat(0.0, *casadi.symvar(expression))) < inf
        function = casadi.Function("f", symbols, [casadi.if_else(finite, expression, nan)])
        if function.size_out(0) != (1, 1) or function.has_free():
            return None
        random = np.random.default_rng(0)
        for trial in range(_TRIALS):
            near = [_near(a, random) if trial else a for a in arguments]
            expected, computed = float(f(*near)), float(function(*(np.ravel(a) for a in near)))
            if not abs(computed - expected) <= _TOLERANCE * max(1.0, abs(expected)):
                return None
        if not all(_agree(f, function, [_filled(a, probe) for a in arguments]) for probe in _PROBES):
            return None
    except (*FAILURES, NotImplementedError):
        return None
    return function


def _agree(f: Callable[..., Any], function: casadi.Function, arguments: Sequence[Any]) -> bool:
    """Return whether both functions have one value; f may fail, or have none, at numbers that it was not made for."""
    try:
        with np.errstate(all="ignore"):
            expected = float(f(*arguments))
    except FAILURES:
        return True
    computed = float(function(*(np.ravel(a) for a in arguments)))
    return not isfinite(expected) or abs(computed - expected) <= _TOLERANCE * max(1.0, abs(expected))


def _filled(like: Any, number: float) -> Any:
    return number if isinstance(like, float) else np.full(like.shape, number)


def _symbolic(symbol: casadi.SX, like: Any) -> Any:
    if isinstance(like, float):
        return symbol
    entries = np.empty(like.size, dtype=object)
    entries[:] = casadi.vertsplit(symbol)
    return entries.reshape(like.shape)


def _near(value: Any, random: np.random.Generator) -> Any:
    moved = value + 0.3 * random.standard_normal(np.shape(value)) * (1.0 + np.abs(value))
    return float(moved) if isinstance(value, float) else moved
