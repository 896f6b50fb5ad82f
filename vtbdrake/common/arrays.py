"""The types of arrays of floats and of indices, immutable values that hold arrays, and small functions of arrays."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, TypeVar, dataclass_transform

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

_Class = TypeVar("_Class", bound=type)


@dataclass_transform(frozen_default=True, eq_default=False)
def immutable(cls: _Class) -> _Class:
    """Make a class a frozen dataclass that is its own deep copy, and whose arrays are read-only.

    Drake copies abstract state in Python deeply, in each update and with each Context: an immutable value is shared
    instead. What is annotated as `Array` becomes an array of floats, and an array that somebody else could change is
    copied, before the class's own ``__post_init__`` and again after unpickling. Values are compared by identity.
    """
    check = cls.__dict__.get("__post_init__")
    is_of_floats: dict[str, bool] = {}

    def post_init(self: Any) -> None:
        _own_arrays(self, is_of_floats)
        if check is not None:
            check(self)

    def set_state(self: Any, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        _own_arrays(self, is_of_floats)

    methods = {"__post_init__": post_init, "__setstate__": set_state, "__deepcopy__": lambda self, memo: self}
    for name, method in methods.items():
        setattr(cls, name, method)
    dataclass(frozen=True, eq=False)(cls)
    is_of_floats |= {field.name: field.type in ("Array", Array) for field in fields(cls)}
    return cls


def set_read_only(value: Any, **arrays: NDArray[Any]) -> None:
    """Set fields of an immutable value, in its ``__post_init__``, to arrays that nobody else changes.

    Args:
        value: The object, such as a frozen dataclass.
        arrays: The arrays by field; they are not copied, and are read-only from now on.
    """
    for name, array in arrays.items():
        array.flags.writeable = False
        object.__setattr__(value, name, array)


def stacked(values: list[Any]) -> Any:
    """Return numbers, or arrays of one shape, as one array; other values as the list that they are."""
    return np.array(values) if all(isinstance(value, float | np.ndarray) for value in values) else values


def rms(values: ArrayLike) -> float:
    """Return the root mean square of some values; NaN of none."""
    squares = np.square(np.asarray(values, dtype=float))
    return float(np.sqrt(squares.mean())) if squares.size else np.nan


def _own_arrays(value: Any, is_of_floats: Mapping[str, bool]) -> None:
    """Make the arrays of an immutable value its own; ``is_of_floats`` tells of each field whether it is an `Array`."""
    for name, of_floats in is_of_floats.items():
        array: Any = getattr(value, name, None)  # None: a field that ``__post_init__`` computes.
        if array is None or not (of_floats or isinstance(array, np.ndarray)):
            continue
        is_right = isinstance(array, np.ndarray) and (array.dtype == float or not of_floats)
        # A view may be read-only while its base is not.
        if not is_right or array.flags.writeable or not array.flags.owndata:
            set_read_only(value, **{name: np.array(array, dtype=float if of_floats else None)})
