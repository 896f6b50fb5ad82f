"""Functions of qualities and constraints that a command line or a file names as ``module:function``."""

from __future__ import annotations

import importlib
import re
import sys
from collections.abc import Callable
from typing import Any

import numpy as np

# The name of a function.
FUNCTION = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_]\w*")


def magnitude(value: float | np.ndarray) -> float:
    """Return abs(value); of an array, the largest entry."""
    return float(np.max(np.abs(value)))


def largest(value: float | np.ndarray) -> float:
    """Return the value; of an array, its largest entry."""
    return float(np.max(value))


def smallest(value: float | np.ndarray) -> float:
    """Return the value; of an array, its smallest entry."""
    return float(np.min(value))


LIBRARY: dict[str, Callable[..., float]] = {f.__name__: f for f in (magnitude, largest, smallest)}
"""The functions that need no module before their name."""


def named_function(text: str) -> Callable[..., Any]:
    """Return the function ``module:function``, or one of `LIBRARY`; its module is imported, which runs its code.

    Raises:
        ValueError: There is no such function, or its module cannot be imported.
    """
    if text in LIBRARY:
        return LIBRARY[text]
    if not FUNCTION.fullmatch(text):
        raise ValueError(f"a function is named package.module:function, not {text!r}")
    module_name, _, name = text.partition(":")
    try:
        module = importlib.import_module(module_name)
    except ModuleNotFoundError as error:
        raise ValueError(f"cannot import {module_name} of the function {text}: {error}") from error
    except Exception as error:
        raise ValueError(f"cannot import {module_name} of the function {text}: {error!r}") from error
    function = getattr(module, name, None)
    if not callable(function):
        raise ValueError(f"{module_name} has no function {name!r}")
    return function


def is_named(text: str, function: Callable[..., Any]) -> bool:
    """Return whether other processes find a function under the name ``module:function``.

    Args:
        text: The name, ``module:function``.
        function: The function that other processes are to find.
    """
    module_name, _, name = text.partition(":")
    module = sys.modules.get(module_name) if module_name != "__main__" and FUNCTION.fullmatch(text) else None
    return getattr(module, name, None) is function
