"""What a LeafSystem declares about its own state and parameters.

A system of ours names the pieces of its numeric state x and parameters a in its constructor::

    self.variables = (
        parameter("period", self.DeclareNumericParameter(BasicVector([2.0])), unit="s", bounds=(0.1, 60.0)),
        discrete_state("phase", self.DeclareDiscreteState(1), unit="cycle"),
    )

and, if it keeps abstract state for which `vtbdrake.state.codecs` knows no way, how that state becomes arrays and back::

    self.codecs = {0: Codec(encode=lambda landmarks: {"p_WL": landmarks.p_WL},
                            decode=lambda arrays: Landmarks(**arrays))}
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import inf
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

CONTINUOUS = "continuous"
DISCRETE = "discrete"
PARAMETER = "parameter"


@dataclass(frozen=True)
class Element:
    """One named piece of a numeric group of a LeafSystem's context.

    ``shape`` ``()`` is a scalar. The values lie in the group ``group`` with number ``index``, from entry
    ``start`` on, in C order. ``bounds`` hold for every entry.
    """

    name: str
    group: str
    index: int
    shape: tuple[int, ...] = ()
    start: int = 0
    unit: str = "1"
    bounds: tuple[ArrayLike, ArrayLike] = (-inf, inf)


def parameter(
    name: str,
    index: int,
    *,
    shape: tuple[int, ...] = (),
    start: int = 0,
    unit: str = "1",
    bounds: tuple[float, float] = (-inf, inf),
) -> Element:
    """A piece of the numeric parameter group ``index``: part of a in s = [x, a]."""
    return Element(name, PARAMETER, int(index), shape, start, unit, bounds)


def discrete_state(
    name: str,
    index: int,
    *,
    shape: tuple[int, ...] = (),
    start: int = 0,
    unit: str = "1",
    bounds: tuple[float, float] = (-inf, inf),
) -> Element:
    """A piece of the discrete state group ``index``: part of x in s = [x, a]."""
    return Element(name, DISCRETE, int(index), shape, start, unit, bounds)


def continuous_state(
    name: str,
    *,
    shape: tuple[int, ...] = (),
    start: int = 0,
    unit: str = "1",
    bounds: tuple[float, float] = (-inf, inf),
) -> Element:
    """A piece of the continuous state: part of x in s = [x, a]."""
    return Element(name, CONTINUOUS, 0, shape, start, unit, bounds)


@dataclass(frozen=True)
class Codec:
    """How an abstract state becomes named arrays (for a snapshot) and back."""

    encode: Callable[[Any], Mapping[str, np.ndarray]]
    decode: Callable[[Mapping[str, np.ndarray]], Any]
