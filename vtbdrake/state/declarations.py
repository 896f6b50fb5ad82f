"""Declarations of a LeafSystem: named variables, codecs of its abstract state, and slots that let it be freed."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import inf
from typing import Any, TypedDict, Unpack

import numpy as np
from numpy.typing import ArrayLike

CONTINUOUS = "continuous"
DISCRETE = "discrete"
PARAMETER = "parameter"


@dataclass(frozen=True)
class Element:
    """One named piece of a numeric group of a LeafSystem's context."""

    name: str  # last part of the address
    group: str  # ``continuous``, ``discrete`` or ``parameter``
    index: int  # number of the group
    shape: tuple[int, ...] = ()  # ``()`` is a scalar; arrays lie in C order
    start: int = 0  # first entry in the group
    unit: str = "1"  # SI unit; ``"1"`` if it has none
    bounds: tuple[ArrayLike, ArrayLike] = (-inf, inf)  # closed interval, for every entry


class _Options(TypedDict, total=False):
    shape: tuple[int, ...]
    start: int
    unit: str
    bounds: tuple[ArrayLike, ArrayLike]


def parameter(name: str, index: int, **options: Unpack[_Options]) -> Element:
    """Name a piece of the numeric parameter group ``index``: part of a in s = [x, a].

    Args:
        name: Last part of the address.
        index: Number of the group.
        options: ``shape``, ``start``, ``unit`` and ``bounds``, see `Element`.
    """
    return Element(name, PARAMETER, int(index), **options)


def discrete_state(name: str, index: int, **options: Unpack[_Options]) -> Element:
    """Name a piece of the discrete state group ``index``: part of x in s = [x, a]; see `parameter`."""
    return Element(name, DISCRETE, int(index), **options)


def continuous_state(name: str, index: int = 0, **options: Unpack[_Options]) -> Element:
    """Name a piece of the continuous state: part of x in s = [x, a]; see `parameter`.

    Args:
        name: Last part of the address.
        index: What ``DeclareContinuousState`` returned: 0, as a system has one vector of continuous state.
        options: See `parameter`; ``start`` tells where the piece begins in that vector.

    Raises:
        ValueError: The index is not 0.
    """
    if int(index) != 0:
        raise ValueError(f"{name}: a system has one vector of continuous state, number 0, not {index}: give start=")
    return Element(name, CONTINUOUS, 0, **options)


@dataclass(frozen=True)
class Codec:
    """A pair of functions that turn an abstract state into named arrays and back."""

    encode: Callable[[Any], Mapping[str, np.ndarray]]
    decode: Callable[[Mapping[str, np.ndarray]], Any]


# The ``__slots__`` of every class that derives from LeafSystem. With an instance dict beside that of Drake's class, the
# collector visits it twice (drake 1.51) and considers it referenced from outside. Attributes go into Drake's dict.
NO_DICT: tuple[str, ...] = ()


def weakly(owner: Any, method: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function that calls ``method(owner, ...)`` and does not keep ``owner`` alive.

    Drake keeps the functions of output ports and cache entries in C++, where Python's garbage collector cannot follow
    references. A bound method there holds its system, which holds the method: neither would ever be freed, nor the
    Diagram around.
    """
    reference = weakref.ref(owner)

    def call(*arguments: Any) -> Any:
        # The wrapper of a system lives as long as its Diagram does.
        return method(reference(), *arguments)

    return call
