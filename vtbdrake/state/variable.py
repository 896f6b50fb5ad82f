"""One element of s = [x, a]: how it is addressed, read and written on any Context of its Diagram."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import inf

import numpy as np
from numpy.typing import ArrayLike
from pydrake.systems.framework import Context

X = "x"
A = "a"

Reader = Callable[[Context], ArrayLike]
Writer = Callable[[Context, np.ndarray], None]


class VariableError(ValueError):
    """A value that a variable cannot take, or a write to a derived one."""


@dataclass(frozen=True)
class Variable:
    """An addressed element of the state s = [x, a] of a Diagram.

    Attributes:
        address: dotted path, such as ``sim.sys.payload.mass``.
        kind: ``"x"`` (dynamic part: may change while time runs) or ``"a"`` (static part).
        shape: of its value; ``()`` is a scalar.
        unit: SI unit; ``"1"`` if it has none.
        bounds: closed interval, for all entries or of the variable's shape.
        read: reads the value from a context of the Diagram.
        write: writes a checked value into a context; None marks a derived quantity, which is read only.
        carried_by: empty if a copy of the numeric groups of a context carries the variable. Else (contact friction,
            camera poses, joint locks, switches) the address of the hidden variable that copies and snapshots have to
            carry for it: itself, or a finer one.
        order: variables of a lower order are written first, as writing them changes others.
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

    @property
    def hidden(self) -> bool:
        """True if copies and snapshots have to carry this very variable."""
        return self.carried_by == self.address

    @property
    def derived(self) -> bool:
        """True if it is computed from other variables and cannot be written."""
        return self.write is None

    def get(self, context: Context) -> float | np.ndarray:
        """The value in ``context``: a float where the shape is ``()``, else an array of that shape."""
        value = self.read(context)
        if not self.shape:
            return float(value)  # type: ignore[arg-type]
        return np.array(value, dtype=float).reshape(self.shape)

    def check(self, value: ArrayLike) -> np.ndarray:
        """``value`` as an array of the variable's shape.

        Raises:
            VariableError: the variable is derived, or the value has another shape, is not finite, or lies
                outside the bounds.
        """
        if self.write is None:
            raise VariableError(f"{self.address} is derived from other variables and cannot be set")
        try:
            array = np.asarray(value, dtype=float)
        except (TypeError, ValueError) as error:
            raise VariableError(f"{self.address} takes numbers of shape {self.shape}, not {value!r}") from error
        if array.shape != self.shape:
            raise VariableError(f"{self.address} has shape {self.shape}, but the value given has {array.shape}")
        if not np.isfinite(array).all():
            raise VariableError(f"{self.address} must be finite, but the value given is {value!r}")
        lower, upper = (np.asarray(bound, dtype=float) for bound in self.bounds)
        if (array < lower).any() or (array > upper).any():
            raise VariableError(
                f"{self.address} must lie in {self.bounds_text()} {self.unit}, but the value given is {value!r}"
            )
        return array

    def bounds_text(self) -> str:
        """The closed interval of the bounds, to be read; of an array with several, the first."""
        lower, upper = (float(np.ravel(bound)[0]) for bound in self.bounds)
        more = ", ..." if any(np.unique(bound).size > 1 for bound in self.bounds) else ""
        return f"[{lower:g}, {upper:g}]{more}"

    def set(self, context: Context, value: ArrayLike) -> None:
        """Checks ``value`` and writes it into ``context``.

        Raises:
            VariableError: as `check`, or the value is refused by what it is written to.
        """
        array = self.check(value)
        assert self.write is not None
        self.write(context, array)
