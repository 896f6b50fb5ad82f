"""Forbidden regions of a study: boxes in the space of its parameters, and what they leave of the space searched.

A region is {address: side}; a parameter without a side is not limited. A side is [lower, upper], where None is an open
end, or of a choice some of its options.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from math import ceil, floor, inf
from typing import Any

from vtbdrake.common.argument_checks import as_number
from vtbdrake.optimization.parameter import Choice, Dimension, Parameter

Region = Mapping[str, Sequence[Any]]

# A side of a box: the ends of an interval, of whole numbers or not, or a set of values without an order.
_Side = tuple[float, float] | frozenset[Any]
Box = dict[str, _Side]


def checked_side(parameter: Dimension, side: Any) -> list[Any]:
    """Return a side of a region as JSON data.

    Args:
        parameter: The parameter to which it belongs.
        side: What somebody has given as the side.

    Raises:
        ValueError: It is no side of this parameter, or is empty.
    """
    if not isinstance(side, Sequence) or isinstance(side, str) or not side:
        raise ValueError(f"a side of a region is [lower, upper], or options, not {side!r} of {parameter.address}")
    if isinstance(parameter, Choice):
        return [parameter.as_value(option) for option in side]
    if len(side) != 2:
        raise ValueError(f"a side of a region has two ends, [lower, upper], unlike {list(side)} of {parameter.address}")
    name = parameter.address
    ends = [None if end is None else as_number(f"an end of the region along {name}", end) for end in side]
    lower, upper = _open_ends(ends)
    if not (lower <= upper if parameter.integer else lower < upper):
        raise ValueError(f"the side [{lower:g}, {upper:g}] of the region along {name} is empty: lower < upper")
    return ends


def contains(region: Region, parameters: Mapping[str, Dimension], values: Mapping[str, Any]) -> bool:
    """Return whether a point lies in a region.

    Args:
        region: The region.
        parameters: The parameters by address.
        values: The values of the point by address.
    """
    return all(_side_contains(parameters[address], side, values[address]) for address, side in region.items())


def searched_box(ranges: Iterable[Dimension], frozen: Mapping[str, Any]) -> Box:
    """Return the space that is searched as a box. A whole number k of a range is the interval from k - 1/2 to k + 1/2.

    Args:
        ranges: The parameters with the ranges that are searched.
        frozen: The values of the parameters that are not varied, by address.
    """
    box: Box = {}
    for parameter in ranges:
        if parameter.address in frozen:
            box[parameter.address] = frozenset([frozen[parameter.address]])
        elif isinstance(parameter, Choice):
            box[parameter.address] = frozenset(parameter.options)
        else:
            margin = 0.5 if parameter.integer else 0.0
            box[parameter.address] = parameter.lower - margin, parameter.upper + margin
    return box


def overlaps(region: Region, parameters: Mapping[str, Dimension], box: Box) -> bool:
    """Return whether a region contains a part of a box.

    Args:
        region: The region.
        parameters: The parameters by address.
        box: The box.
    """
    return _remainder(box, parameters, region) != [box]


def leave_something(regions: Sequence[Region], parameters: Mapping[str, Dimension], box: Box) -> bool:
    """Return whether regions together leave a part of a box.

    Args:
        regions: The regions.
        parameters: The parameters by address.
        box: The box.
    """
    if not regions:
        return True
    return any(leave_something(regions[1:], parameters, piece) for piece in _remainder(box, parameters, regions[0]))


def _open_ends(side: Sequence[float | None]) -> tuple[float, float]:
    lower, upper = side
    return -inf if lower is None else lower, inf if upper is None else upper


def _side_contains(parameter: Dimension, side: Sequence[Any], value: Any) -> bool:
    if isinstance(parameter, Choice):
        return value in side
    lower, upper = _open_ends(side)
    return bool(lower <= value <= upper)


def _remainder(box: Box, parameters: Mapping[str, Dimension], region: Region) -> list[Box]:
    """Return boxes that together are a box without a region."""
    inner, pieces = dict(box), []
    for address, forbidden in region.items():
        within, outside = _divided(inner[address], parameters[address], forbidden)
        if within is None:
            return [dict(box)]
        pieces += [{**inner, address: side} for side in outside]
        inner[address] = within
    return pieces


def _divided(side: _Side, parameter: Dimension, forbidden: Sequence[Any]) -> tuple[_Side | None, list[_Side]]:
    """Return the part of a side that lies within a region's side, None if there is none, and the parts outside."""
    if isinstance(side, frozenset):
        within = frozenset(value for value in side if _side_contains(parameter, forbidden, value))
        return within or None, [side - within] if side - within else []
    lower, upper = _open_ends(forbidden)
    if isinstance(parameter, Parameter) and parameter.integer:
        lower = lower if lower == -inf else ceil(lower) - 0.5
        upper = upper if upper == inf else floor(upper) + 0.5
    if upper <= side[0] or lower >= side[1] or upper <= lower:
        return None, [side]
    outside: list[_Side] = [(side[0], lower)] if lower > side[0] else []
    outside += [(upper, side[1])] if upper < side[1] else []
    return (max(lower, side[0]), min(upper, side[1])), outside
