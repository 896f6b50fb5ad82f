"""All variables of a Diagram by address: looked up, listed, selected."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike
from pydrake.systems.framework import Context

from vtbdrake.state.variable import Variable


class AddressError(KeyError, ValueError):
    """An address that the Diagram does not have."""

    def __str__(self) -> str:
        return str(self.args[0])


class Variables(Mapping[str, Variable]):
    """The variables of one Diagram, in the order of its systems.

    ``derived_by_demand`` gives, for an address that is not listed, a derived quantity that exists all the same
    (the height of any body, say), or None.
    """

    def __init__(
        self,
        variables: Iterable[Variable],
        *,
        derived_by_demand: Mapping[str, Callable[[], Variable]] | None = None,
    ) -> None:
        self._listed: dict[str, Variable] = {}
        for variable in variables:
            if variable.address in self._listed:
                raise AddressError(
                    f"two variables have the address {variable.address}: rename one of the systems, bodies or "
                    "joints that it comes from"
                )
            self._listed[variable.address] = variable
        self._by_demand = dict(derived_by_demand or {})

    def __getitem__(self, address: str) -> Variable:
        if address in self._listed:
            return self._listed[address]
        if address in self._by_demand:
            return self._by_demand[address]()
        raise AddressError(f"there is no variable {address!r}{self.suggestion(address)}")

    def __contains__(self, address: object) -> bool:
        return address in self._listed or address in self._by_demand

    def __iter__(self) -> Iterator[str]:
        return iter(self._listed)

    def __len__(self) -> int:
        return len(self._listed)

    def suggestion(self, address: str) -> str:
        """What to tell someone who asked for an address that does not exist."""
        known = [*self._listed, *self._by_demand]
        near = difflib.get_close_matches(address, known, n=3, cutoff=0.6)
        if near:
            return "; did you mean " + " or ".join(near) + "?"
        tops = sorted({".".join(name.split(".")[:2]) for name in known})
        return "; addresses begin with " + ", ".join(tops) if tops else ""

    def read(self, context: Context, addresses: Sequence[str]) -> dict[str, float | np.ndarray]:
        """sigma_s, equation (8), or sigma_q, equation (11): the values at ``addresses``."""
        return {address: self[address].get(context) for address in addresses}

    def write(self, context: Context, values: Mapping[str, ArrayLike]) -> None:
        """Checks all of ``values``, then sets the variables at their addresses."""
        checked = [(self[address], value) for address, value in values.items()]
        for variable, value in checked:
            variable.check(value)
        for variable, value in checked:
            variable.set(context, value)

    def complement(self, addresses: Sequence[str]) -> list[str]:
        """Equation (9): the addresses of all that is held constant when ``addresses`` are varied."""
        chosen = {self[address].address for address in addresses}
        return [v.address for v in self._listed.values() if not v.derived and v.address not in chosen]

    def table(self, context: Context, *, pattern: str = "") -> str:
        """The variables whose address contains ``pattern``, as a table of text."""
        rows = [("address", "kind", "shape", "unit", "bounds", "value")]
        for variable in self._listed.values():
            if pattern not in variable.address:
                continue
            kind = variable.kind + (" (derived)" if variable.derived else "")
            shape = "x".join(map(str, variable.shape)) or "scalar"
            lower, upper = variable.bounds
            bounds = "" if np.isinf(variable.bounds).all() else f"[{lower:g}, {upper:g}]"
            value = variable.get(context) + 0.0  # no negative zeros
            text = (
                f"{value:.6g}"
                if isinstance(value, float)
                else np.array2string(value, precision=4, threshold=8, suppress_small=True, max_line_width=10_000)
            )
            rows.append((variable.address, kind, shape, variable.unit, bounds, text))
        widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
        lines = ["  ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)).rstrip() for row in rows]
        lines.insert(1, "  ".join("-" * w for w in widths))
        return "\n".join(lines)
