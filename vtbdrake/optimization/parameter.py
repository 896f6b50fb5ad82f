"""The selection sigma_s, equation (8): which elements of s0 are varied, and where."""

from __future__ import annotations

from dataclasses import dataclass
from math import isfinite

import numpy as np

from vtbdrake.state import Variable, Variables


@dataclass(frozen=True)
class Parameter:
    """One varied element of s0: a scalar variable of the testbed, or an entry of an array (``address[3]``).

    Attributes:
        address: of the variable.
        lower, upper: the range, in the variable's unit.

    Raises:
        ValueError: the range is empty, reversed or not finite.
    """

    address: str
    lower: float
    upper: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "lower", float(self.lower))
        object.__setattr__(self, "upper", float(self.upper))
        if not (isfinite(self.lower) and isfinite(self.upper) and self.lower < self.upper):
            raise ValueError(
                f"the range of {self.address} must be finite and not empty, lower < upper, but it is "
                f"[{self.lower}, {self.upper}]"
            )

    def find(self, variables: Variables) -> Variable:
        """The variable that it varies.

        Raises:
            ValueError: there is none, it is derived or an array, or the range exceeds its bounds.
        """
        variable = variables[self.address]
        if variable.derived:
            raise ValueError(f"{self.address} is derived from other variables and cannot be varied")
        if variable.shape:
            raise ValueError(
                f"{self.address} has shape {variable.shape}; a parameter is one number: {self.address}[0], say"
            )
        lower, upper = (float(np.asarray(bound)) for bound in variable.bounds)
        if self.lower < lower or self.upper > upper:
            raise ValueError(
                f"the range [{self.lower:g}, {self.upper:g}] of {self.address} exceeds its bounds "
                f"{variable.bounds_text()} {variable.unit}"
            )
        return variable
