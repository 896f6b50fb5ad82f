"""Variables: the elements of s = [x, a], by address."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from html import escape
from math import inf
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from pydrake.systems.framework import Context, System

from vtbdrake.common.argument_checks import as_array, suggestion

X = "x"
A = "a"

Reader = Callable[[Context], ArrayLike]
Writer = Callable[[Context, np.ndarray], None]


class VariableError(ValueError):
    """A variable cannot take a value, or is derived and cannot be written."""


@dataclass(frozen=True)
class Place:
    """Where a value lies, entry by entry, in a numeric group of a leaf system's context.

    Attributes:
        system: The leaf system.
        group: ``continuous``, ``discrete`` or ``parameter``.
        index: Number of the group.
        start: First entry in the group.
    """

    system: System
    group: str
    index: int
    start: int


@dataclass(frozen=True, repr=False)
class Variable:
    """An addressed element of the state s = [x, a] of a Diagram.

    Attributes:
        address: Dotted path, such as ``sim.sys.payload.mass``.
        kind: ``"x"`` (dynamic part: may change while time runs) or ``"a"`` (static part).
        shape: The shape of its value; ``()`` is a scalar.
        unit: SI unit; ``"1"`` if it has none. Entries of several kinds have a list, see `entry_units`.
        read: Reads the value from a context of the Diagram.
        write: Writes a checked value into a context; None marks a derived quantity, which is read only.
        bounds: Closed interval, for all entries or of the variable's shape.
        carried_by: Empty if a copy of the numeric groups of a context contains the variable. Else (contact friction,
            camera poses, joint locks, switches) the address of the hidden variable that copies and snapshots must hold:
            the variable itself or one with more detail.
        order: Variables of a lower order are written first, as writing them changes others.
        place: Where the value lies as it is; None if it is computed from what lies somewhere.
        refuse: Raises a VariableError for an array that is finite and within the bounds, but not allowed.
        entry_names: The names of its entries; empty if they have none.
        choices: The words for its values; empty if it is no enumeration.
    """

    address: str
    kind: str
    shape: tuple[int, ...]
    unit: str
    read: Reader
    write: Writer | None = None
    bounds: tuple[ArrayLike, ArrayLike] = (-inf, inf)
    carried_by: str = ""
    order: int = 0
    place: Place | None = None
    refuse: Callable[[np.ndarray], object] | None = None
    entry_names: tuple[str, ...] = ()  # short names of the entries of an array, in C order; empty if they have none
    # the values that an entry can have, with their names, if it is one of an enumeration; empty if it is not
    choices: tuple[tuple[float, str], ...] = ()

    def __repr__(self) -> str:
        return f"Variable({self.address!r}, kind={self.kind!r}, shape={self.shape}, unit={self.unit!r})"

    @property
    def hidden(self) -> bool:
        """Return whether copies and snapshots must hold this variable beside the numeric groups."""
        return self.carried_by == self.address

    @property
    def derived(self) -> bool:
        """Return whether the variable is computed from others, so that it cannot be written."""
        return self.write is None

    def get(self, context: Context) -> float | np.ndarray:
        """Return the value in ``context``: a float where the shape is ``()``, else an array of that shape."""
        value = self.read(context)
        if not self.shape:
            return float(value)  # type: ignore[arg-type]
        return np.array(value, dtype=float).reshape(self.shape)

    def check(self, value: ArrayLike) -> np.ndarray:
        """Return ``value`` as an array of the variable's shape.

        Raises:
            VariableError: The variable is derived, or the value is no number, has another shape, is not finite, lies
                outside the bounds, or is impossible in another way.
        """
        if self.write is None:
            raise VariableError(f"{self.address} is derived from other variables and cannot be set")
        try:
            array = as_array(self.address, value)
        except ValueError:
            raise VariableError(f"{self.address} takes numbers of shape {self.shape}, not {value!r}") from None
        if array.shape != self.shape:
            raise VariableError(f"{self.address} has shape {self.shape}, but the value given has {array.shape}")
        lower, upper = self.bounds
        if not (np.isfinite(array) & (array >= lower) & (array <= upper)).all():
            if not np.isfinite(array).all():
                raise VariableError(f"{self.address} must be finite, but the value given is {value!r}")
            outside = np.flatnonzero((array < lower) | (array > upper))
            variable, number = (_entry(self, outside[0]), array.flat[outside[0]]) if self.shape else (self, array)
            allowed = with_unit(variable.bounds_text(), variable.unit)
            raise VariableError(f"{variable.address} must lie in {allowed}, but the value given is {float(number)}")
        if self.refuse is not None:
            self.refuse(array)
        return array

    def bounds_text(self) -> str:
        """Return the closed interval of the bounds as text; the first one of an array with several."""
        lower, upper = (float(np.ravel(bound)[0]) for bound in self.bounds)
        more = ", ..." if any(np.unique(bound).size > 1 for bound in self.bounds) else ""
        return f"[{lower:g}, {upper:g}]{more}"

    def set(self, context: Context, value: ArrayLike) -> None:
        """Check ``value`` and write it into ``context``.

        Args:
            context: The root context, which is changed.
            value: A number, or an array of the variable's shape, in its unit.

        Raises:
            VariableError: As `check`, or Drake rejects the value.
        """
        array = self.check(value)
        assert self.write is not None
        self.write(context, array)


def entry_units(unit: str, shape: tuple[int, ...]) -> tuple[str, ...]:
    """Return the unit of each entry of an array, row by row.

    A unit such as ``"rad/s, m/s"`` lists the units of equal groups of the entries of a row. A pose whose orientation is
    a quaternion has groups of one entry: ``"1, 1, 1, 1, m, m, m"``. In ``"s, N, ..."``, the unit before the dots
    continues to the end. If there are no equal groups, the list is the unit of every entry.

    Args:
        unit: The unit of the array.
        shape: The shape of the array; ``()`` of a number.
    """
    *rows, width = shape or (1,)
    units = [unit] if "(" in unit else unit.split(", ")
    if units[-1] == "..." and len(units) <= width + 1:
        units = [*units[:-1], *units[-2:-1] * (width - len(units) + 1)]
    if not width or width % len(units):
        units = [unit]
    row = [name for name in units for _ in range(width // len(units))]
    return tuple(row * math.prod(rows))


def with_unit(amount: str, unit: str) -> str:
    """Return a text of numbers with their unit behind it, if they have one.

    Args:
        amount: The numbers, as text.
        unit: The unit; empty or ``"1"`` for numbers without one.
    """
    return amount if unit in ("", "1") else f"{amount} {unit}"


class AddressError(KeyError, ValueError):
    """The Diagram does not have the address."""

    def __str__(self) -> str:
        return str(self.args[0])


# One entry of an array, in C order: ``address[3]``.
_ENTRY = re.compile(r"(.+)\[(0|[1-9][0-9]*)\]")


def html_table(rows: Sequence[Sequence[str]]) -> str:
    """Return an HTML table for a notebook, which scrolls if it is long."""
    body = "".join("<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>" for row in rows)
    return f'<div style="max-height: 30em; overflow: auto"><table>{body}</table></div>'


def text_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return rows as text in columns under their names, as wide as their longest cell.

    Args:
        header: The names of the columns.
        rows: The cells of each row, one per column.
    """
    widths = [max(map(len, column)) for column in zip(header, *rows, strict=True)]
    lines = (header, ["-" * width for width in widths], *rows)
    return "\n".join("  ".join(map(str.ljust, line, widths)).rstrip() for line in lines)


class Variables(Mapping[str, Variable]):
    """The variables of one Diagram, in the order of its systems; ``address[3]`` is one entry of an array.

    ``by_demand`` maps addresses that are not listed to functions that make the variable, for example the height of a
    body.

    Args:
        variables: The variables, in the order of their systems.
        by_demand: Functions that make variables which are not listed, by address: the height of a body, for example.
    """

    def __init__(
        self, variables: Iterable[Variable], *, by_demand: Mapping[str, Callable[[], Variable]] | None = None
    ) -> None:
        self._listed: dict[str, Variable] = {}
        for variable in variables:
            if variable.address in self._listed:
                raise AddressError(
                    f"two variables have the address {variable.address}: rename one of the systems, bodies or "
                    "joints that it comes from"
                )
            self._listed[variable.address] = variable
        self._by_demand = dict(by_demand or {})

    def __getitem__(self, address: str) -> Variable:
        check_address(address)
        if address in self._listed:
            return self._listed[address]
        if address in self._by_demand:
            return self._by_demand[address]()
        entry = _ENTRY.fullmatch(address)
        if entry and entry[1] in self:
            return _entry(self[entry[1]], int(entry[2]))
        raise AddressError(f"there is no variable {address!r}{suggestion(address, [*self._listed, *self._by_demand])}")

    def __contains__(self, address: object) -> bool:
        if address in self._listed or address in self._by_demand:
            return True
        entry = _ENTRY.fullmatch(address) if isinstance(address, str) else None
        return entry is not None and entry[1] in self and int(entry[2]) < int(np.prod(self[entry[1]].shape, dtype=int))

    def __iter__(self) -> Iterator[str]:
        return iter(self._listed)

    def __len__(self) -> int:
        return len(self._listed)

    def __repr__(self) -> str:
        tops = dict.fromkeys(address.partition(".")[0] for address in self)
        return f"Variables({len(self)} addresses that begin with {', '.join(tops)})"

    def _repr_html_(self) -> str:
        """Show a table in a notebook."""
        return html_table([("address", "kind", "shape", "unit", "bounds"), *map(_row, self._listed.values())])

    def _ipython_key_completions_(self) -> list[str]:
        """Complete ``variables["dps.<TAB>`` in IPython."""
        return [*self._listed, *self._by_demand]

    def read(self, context: Context, addresses: Sequence[str]) -> dict[str, float | np.ndarray]:
        """Return sigma_s, equation (8), or sigma_q, equation (11): the values at ``addresses``, by address.

        Args:
            context: The root context.
            addresses: The addresses.

        Raises:
            ValueError: An address does not exist, or there is one string instead of a sequence of addresses.
        """
        if isinstance(addresses, str):
            raise ValueError(f"addresses are a sequence: read(context, [{addresses!r}])")
        return {address: self[address].get(context) for address in addresses}

    def write(self, context: Context, values: Mapping[str, ArrayLike]) -> None:
        """Check all of ``values`` (address -> value), then set the variables.

        Their order does not matter: entries of one array are set together, and variables that change others (a mass,
        which scales the inertia) are set first.

        Args:
            context: The root context, which is changed.
            values: Address -> value, in the variables' units.

        Raises:
            VariableError: ``values`` is no mapping, a value is refused, or an array is given both whole and by entries.
        """
        if not isinstance(values, Mapping):
            raise VariableError(f"variables are set by {{address: value, ...}}, not by {values!r}")
        checked = {address: self[address].check(value) for address, value in values.items()}
        whole: dict[str, Any] = {}
        for address, value in checked.items():
            entry = _ENTRY.fullmatch(address)
            if entry is None:
                whole[address] = value
            elif entry[1] in values:
                raise VariableError(f"{entry[1]} is set both whole and by its entry {address}")
            else:
                array = whole.setdefault(entry[1], np.array(self[entry[1]].get(context)))
                array.flat[int(entry[2])] = float(value)
        for address, array in whole.items():
            if address not in checked:
                self[address].check(array)
        for variable in sorted(map(self.__getitem__, whole), key=lambda variable: variable.order):
            assert variable.write is not None
            variable.write(context, whole[variable.address])

    def complement(self, addresses: Sequence[str]) -> list[str]:
        """Return the addresses of all that is held constant when ``addresses`` are varied, equation (9)."""
        varied_addresses = {self[address].address.partition("[")[0] for address in addresses}
        return [v.address for v in self._listed.values() if not v.derived and v.address not in varied_addresses]

    def table(self, context: Context, *, pattern: str = "") -> str:
        """Return a table of the variables whose address contains ``pattern``, as text.

        Args:
            context: The root context.
            pattern: A part of the addresses; empty for all.
        """
        rows = []
        for variable in self._listed.values():
            if pattern not in variable.address:
                continue
            value = variable.get(context) + 0.0  # no negative zeros
            text = (
                f"{value:.6g}"
                if isinstance(value, float)
                else np.array2string(value.ravel(), precision=4, threshold=8, suppress_small=True, max_line_width=999)
            )
            rows.append((*_row(variable), text))
        return text_table(("address", "kind", "shape", "unit", "bounds", "value"), rows)


def _row(variable: Variable) -> tuple[str, str, str, str, str]:
    kind = variable.kind + (" (derived)" if variable.derived else "")
    shape = "x".join(map(str, variable.shape)) or "scalar"
    bounded = any(np.isfinite(bound).any() for bound in variable.bounds)
    return variable.address, kind, shape, variable.unit, variable.bounds_text() if bounded else ""


def check_address(address: object) -> None:
    """Check that an address is a string.

    Raises:
        AddressError: ``address`` is no string.
    """
    if not isinstance(address, str):
        raise AddressError(f"an address is a text, such as 'plant.box.mass', not {address!r}")


def overlap(addresses: Iterable[str], others: Iterable[str]) -> tuple[str, str] | None:
    """Return the first address of each that are an array and an entry of it, or equal; None if there are none.

    If the addresses and the others are the same object, an address is not compared with itself.

    Args:
        addresses: Addresses of variables, or of entries such as ``arm.q[2]``.
        others: The addresses with which each of them is compared.
    """
    pairs = itertools.combinations(addresses, 2) if addresses is others else itertools.product(addresses, others)
    return next(((a, b) for a, b in pairs if a == b or a.startswith(f"{b}[") or b.startswith(f"{a}[")), None)


def _entry(variable: Variable, index: int) -> Variable:
    size = int(np.prod(variable.shape, dtype=int))
    if not variable.shape or index >= size:
        extent = f"has {size} entries" if variable.shape else "is a scalar"
        raise AddressError(f"there is no {variable.address}[{index}]: {variable.address} {extent}")

    def read(context: Context) -> float:
        return float(np.ravel(variable.get(context))[index])

    def write(context: Context, value: np.ndarray) -> None:
        array = np.array(variable.get(context))
        array.flat[index] = float(value)
        variable.set(context, array)

    def bound(which: int) -> float:
        return float(np.broadcast_to(np.asarray(variable.bounds[which], dtype=float), variable.shape).flat[index])

    return replace(
        variable,
        address=f"{variable.address}[{index}]",
        shape=(),
        unit=entry_units(variable.unit, variable.shape)[index],
        read=read,
        write=None if variable.derived else write,
        bounds=(bound(0), bound(1)),
        carried_by=variable.carried_by,
        refuse=None,  # The whole array is checked when it is written.
        place=variable.place and replace(variable.place, start=variable.place.start + index),
    )
