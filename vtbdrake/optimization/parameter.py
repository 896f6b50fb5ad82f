"""Parameters: the selection sigma_s, equation (8), of the elements of s0 that are varied, and their ranges."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from math import isfinite
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from vtbdrake.common.argument_checks import all_of, as_flag, as_number
from vtbdrake.common.summary_html import summary_html
from vtbdrake.rollout.testbeds import FIELD
from vtbdrake.state import Variable, Variables
from vtbdrake.state.variables import with_unit


class _Addressed:
    address: str

    def _repr_html_(self) -> str:
        """Show address and range in a notebook, and how it is searched."""
        kinds = {"integer": "whole numbers", "log": "on a logarithmic scale"}
        search = [text for name, text in kinds.items() if getattr(self, name, False)]
        rows = {"address": self.address, "range": self.range_text, **({"search": ", ".join(search)} if search else {})}
        return summary_html(type(self).__name__, rows)

    @property
    def range_text(self) -> str:
        """Return the range, or the options, as text."""
        raise NotImplementedError

    @property
    def is_field(self) -> bool:
        """Return whether the parameter is a field of the scenario."""
        return self.address.startswith(FIELD)

    def _variable(self, variables: Variables) -> Variable:
        variable = variables[self.address]
        if variable.derived:
            raise ValueError(f"{self.address} is derived from other variables and cannot be varied")
        if variable.shape:
            raise ValueError(
                f"{self.address} has shape {variable.shape}, but a parameter is one number, such as {self.address}[0]"
            )
        return variable


@dataclass(frozen=True)
class Parameter(_Addressed):
    """One varied number of s0: a scalar variable of the testbed, an entry of an array (``address[3]``), or a field.

    Attributes:
        address: Address of the variable; or ``scenario.<field>`` for a field, which needs another Diagram (gravity,
            geometry).
        lower, upper: The range, in the variable's unit.
        integer: Whether only whole numbers are values, both ends included.
        log: Whether to search on a logarithmic scale.

    Raises:
        ValueError: The range is empty, reversed, not finite, or too wide for floating-point numbers, an
            integer has ends that are not whole, or the lower end of a logarithmic scale is not positive.
    """

    address: str
    lower: float
    upper: float
    integer: bool = field(default=False, kw_only=True)
    log: bool = field(default=False, kw_only=True)

    def __post_init__(self) -> None:
        _check_address(self.address)
        for flag in ("integer", "log"):
            as_flag(f"{flag} of {self.address}", getattr(self, flag))
        kind = int if self.integer else float
        for end in ("lower", "upper"):
            as_number(f"the {end} end of {self.address}", getattr(self, end))
        if not (isfinite(self.lower) and isfinite(self.upper) and self.lower < self.upper):
            raise ValueError(
                f"the range of {self.address} must be finite and not empty, lower < upper, but it is "
                f"[{float(self.lower)}, {float(self.upper)}]"
            )
        if not isfinite(float(self.upper) - float(self.lower)):
            raise ValueError(f"the range of {self.address} is too wide for floating-point numbers: {self.range_text}")
        if self.integer and not (float(self.lower).is_integer() and float(self.upper).is_integer()):
            raise ValueError(
                f"{self.address} is an integer, so its range ends in whole numbers, unlike {self.range_text}"
            )
        if self.log and self.lower <= 0.0:
            raise ValueError(
                f"a logarithmic range begins above 0, but the range of {self.address} is {self.range_text}"
            )
        object.__setattr__(self, "lower", kind(self.lower))
        object.__setattr__(self, "upper", kind(self.upper))

    @property
    def is_continuous(self) -> bool:
        """Return whether all numbers of the range are values; gradients require it."""
        return not self.integer

    @property
    def ends(self) -> tuple[float, ...]:
        """Return the values at the ends of the range."""
        return self.lower, self.upper

    @property
    def range_text(self) -> str:
        """Return the range as text."""
        return f"[{self.lower:g}, {self.upper:g}]"

    def as_value(self, value: Any) -> float | int:
        """Return a value as a number of the range.

        Raises:
            ValueError: The value is no number, lies outside the range, or is not whole for an integer.
        """
        try:
            number = as_number(self.address, value)
        except ValueError:
            raise ValueError(f"{self.address} takes a number in {self.range_text}, not {value!r}") from None
        if not self.lower <= number <= self.upper:
            raise ValueError(f"{self.address} = {number:g} lies outside its range {self.range_text}")
        if self.integer and not number.is_integer():
            raise ValueError(f"{self.address} takes whole numbers, not {number:g}")
        return int(number) if self.integer else number

    def from_unit(self, u: float) -> float | int:
        """Return the value at ``u`` in [0, 1] of the range; each value of an integer has an equal share."""
        u = min(max(float(u), 0.0), 1.0)
        if not (self.integer or self.log):
            return min(max(self.lower + u * (self.upper - self.lower), self.lower), self.upper)
        if self.integer and not self.log:
            count = int(self.upper) - int(self.lower) + 1
            return int(self.lower) + min(int(u * count), count - 1)
        value = math.exp(math.log(self.lower) + u * (math.log(self.upper) - math.log(self.lower)))
        value = min(max(value, self.lower), self.upper)
        return round(value) if self.integer else value

    def to_unit(self, value: Any) -> float:
        """Return the place of a value in the range, in [0, 1]; the inverse of `from_unit`."""
        if self.log:
            return math.log(value / self.lower) / math.log(self.upper / self.lower)
        if self.integer:
            return (float(value) - self.lower + 0.5) / (int(self.upper) - int(self.lower) + 1)
        return (float(value) - self.lower) / (self.upper - self.lower)

    def find(self, variables: Variables) -> Variable:
        """Return the variable that is varied.

        Raises:
            ValueError: There is no such variable, it is derived or an array, or the range exceeds its bounds.
        """
        variable = self._variable(variables)
        lower, upper = (float(np.asarray(bound)) for bound in variable.bounds)
        if self.lower < lower or self.upper > upper:
            raise ValueError(
                f"the range {self.range_text} of {self.address} exceeds its bounds "
                f"{with_unit(variable.bounds_text(), variable.unit)}"
            )
        return variable


@dataclass(frozen=True)
class Choice(_Addressed):
    """One varied element of s0 that takes one of several values without an order: numbers, words, True or False.

    Attributes:
        address: Address of a scalar variable (the options are numbers then), or ``scenario.<field>``.
        options: At least two different values.

    Raises:
        ValueError: There are fewer than two options, or two are equal, as 1 and True are.
    """

    address: str
    options: tuple[Any, ...]

    def __init__(self, address: str, options: Sequence[Any]) -> None:
        _check_address(address)
        values: tuple[Any, ...] = all_of(
            object, options, name=f"the options of {address}", form="[option, option, ...]"
        )
        object.__setattr__(self, "address", address)
        object.__setattr__(self, "options", tuple(o.item() if isinstance(o, np.generic) else o for o in values))
        for option in self.options:
            if not isinstance(option, bool | int | float | str):
                raise ValueError(f"the options of {address} are numbers, words or booleans, unlike {option!r}")
            if option != option:
                raise ValueError(
                    f"the options of {address} are compared with values, which NaN never equals: leave it out"
                )
        if len(set(self.options)) < max(2, len(self.options)):
            raise ValueError(f"{address} needs at least two different options, not {list(self.options)}")

    is_continuous = False

    @property
    def ends(self) -> tuple[Any, ...]:
        """Return the options."""
        return self.options

    @property
    def range_text(self) -> str:
        """Return the options as text."""
        return "{" + ", ".join(repr(option) for option in self.options) + "}"

    def as_value(self, value: Any) -> Any:
        """Return the option that equals a value.

        Raises:
            ValueError: No option equals the value.
        """
        for option in self.options:
            if option == value and isinstance(option, bool) == isinstance(value, bool):
                return option
        raise ValueError(f"{self.address} is one of {self.range_text}, not {value!r}")

    def from_unit(self, u: float) -> Any:
        """Return the option at ``u`` in [0, 1]; each has an equal share."""
        count = len(self.options)
        return self.options[min(int(min(max(float(u), 0.0), 1.0) * count), count - 1)]

    def to_unit(self, value: Any) -> float:
        """Return the place of a value in [0, 1], the middle of its share."""
        return (self.options.index(self.as_value(value)) + 0.5) / len(self.options)

    def find(self, variables: Variables) -> Variable:
        """Return the variable that is varied.

        Raises:
            ValueError: There is no such variable, it is derived or an array, or it refuses an option.
        """
        variable = self._variable(variables)
        for option in self.options:
            variable.check(option)
        return variable


Dimension = Parameter | Choice

# A value is at an end of its range if it is closer than this part of the range.
_AT_END = 1e-6


def short_address(address: str, addresses: Iterable[str]) -> str:
    """Return the end of an address, as many of its words as tell it from all others.

    Args:
        address: The address.
        addresses: All addresses among which it is meant, the address itself included.
    """
    words, lists = address.split("."), [other.split(".") for other in addresses]
    for count in range(1, len(words)):
        if sum(other[-count:] == words[-count:] for other in lists) == 1:
            return ".".join(words[-count:])
    return address


def point_text(parameters: Sequence[Dimension], point: Sequence[Any], units: Sequence[str]) -> str:
    """Return the values of a point with six digits and units; a value at an end of its range is pointed out.

    Args:
        parameters: The parameters, in order.
        point: One value per parameter.
        units: One unit per parameter; empty or ``"1"`` for numbers without one.
    """
    texts = []
    for parameter, value, unit in zip(parameters, point, units, strict=True):
        if isinstance(parameter, Choice):
            texts.append(f"{parameter.address} = {value!r}")
            continue
        near = _AT_END * (parameter.upper - parameter.lower)
        end = "lower" if value - parameter.lower <= near else "upper" if parameter.upper - value <= near else ""
        end_text = f" (the {end} end of its range)" if end else ""
        texts.append(f"{parameter.address} = {with_unit(f'{value:.6g}', unit)}{end_text}")
    return ", ".join(texts)


def checked_point(parameters: Sequence[Dimension], point: ArrayLike | Mapping[str, Any]) -> tuple[Any, ...]:
    """Check a point s^0, given as values in the order of the parameters or by address, and return its values.

    Args:
        parameters: The parameters, in order.
        point: One value per parameter, or address -> value of all of them.

    Raises:
        ValueError: The point has another number of entries, sets what is not varied, or one lies outside its range.
    """
    addresses = [parameter.address for parameter in parameters]
    if isinstance(point, Mapping):
        unknown = set(point) ^ set(addresses)
        if unknown:
            raise ValueError(f"a point sets each parameter once; this one is wrong about {', '.join(sorted(unknown))}")
        point = [point[address] for address in addresses]
    shape = np.shape(point) or (1,)
    if shape != (len(addresses),):
        raise ValueError(f"a point has {len(addresses)} entries, but the one given has shape {shape}")
    entries = list(point) if isinstance(point, list | tuple) else np.atleast_1d(np.asarray(point)).tolist()
    return tuple(parameter.as_value(value) for parameter, value in zip(parameters, entries, strict=True))


def checked_points(parameters: Sequence[Dimension], points: Sequence[Sequence[Any]]) -> list[tuple[Any, ...]]:
    """Check points and return their values; see `checked_point`. Floats are compared with the ranges all at once.

    Args:
        parameters: The parameters, in order.
        points: Points of one value per parameter.
    """
    continuous = [parameter for parameter in parameters if isinstance(parameter, Parameter) and not parameter.integer]
    are_floats = {type(value) for point in points for value in point} == {float}
    if are_floats and len(continuous) == len(parameters) and {*map(len, points)} == {len(parameters)}:
        lower, upper = np.array([(parameter.lower, parameter.upper) for parameter in continuous]).T
        numbers = np.array(points)
        if ((numbers >= lower) & (numbers <= upper)).all():
            return [tuple(point) for point in points]
    return [checked_point(parameters, point) for point in points]


def _check_address(address: Any) -> None:
    if not isinstance(address, str):
        raise ValueError(f"a parameter is named by its address, a text, not by {address!r}")
