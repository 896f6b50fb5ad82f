"""What a solver is given: the space that it searches, and under which terms."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from vtbdrake.optimization.parameter import Choice, Dimension, Parameter
from vtbdrake.optimization.solvers.solver import Point, SolverError

# What random generators of numpy's legacy kind take (cmaes, Optuna).
SEEDS = 2**32


@dataclass(frozen=True)
class Search:
    """A search over the unit cube [0, 1]^n, one coordinate per parameter, in their order.

    Attributes:
        space: the parameters.
        objectives: how many values an evaluation has.
        constraints: how many violations it has.
        seed: of all random numbers, in [0, 2^32).
        budget: the number of evaluations that may be asked for; None: as many as the method needs.
        start: where a method that starts at a point starts; None: in the middle of the ranges.

    Raises:
        SolverError: one of them is none.
    """

    space: tuple[Dimension, ...]
    objectives: int = 1
    constraints: int = 0
    seed: int = 0
    budget: int | None = None
    start: Point | None = None

    def __post_init__(self) -> None:
        if not self.space:
            raise SolverError("there is no parameter to vary; give at least one")
        for name, lowest in (("objectives", 1), ("constraints", 0)):
            if getattr(self, name) < lowest:
                raise SolverError(f"the number of {name} is at least {lowest}, not {getattr(self, name)}")
        if not 0 <= self.seed < SEEDS:
            raise SolverError(f"a seed is a whole number in [0, 2^32), not {self.seed}")
        if self.budget is not None and self.budget < 1:
            raise SolverError(f"a budget is at least one evaluation, not {self.budget}")
        if self.start is not None:
            if len(self.start) != self.size:
                raise SolverError(f"a start has one value per parameter, {self.size}, not {len(self.start)}")
            try:
                start = tuple(parameter.check(value) for parameter, value in zip(self.space, self.start, strict=True))
            except ValueError as error:
                raise SolverError(f"the start lies outside of the space: {error}") from error
            object.__setattr__(self, "start", start)

    @property
    def size(self) -> int:
        """n, the number of parameters."""
        return len(self.space)

    def point(self, u: Any) -> Point:
        """The point at ``u`` in the unit cube, shape (n,); what lies outside is drawn to its face."""
        return tuple(parameter.from_unit(x) for parameter, x in zip(self.space, u, strict=True))

    def unit(self, point: Point) -> np.ndarray:
        """The place of a point in the unit cube, shape (n,)."""
        return np.array([parameter.to_unit(value) for parameter, value in zip(self.space, point, strict=True)])

    def start_unit(self) -> np.ndarray:
        """The start in the unit cube, shape (n,)."""
        return np.full(self.size, 0.5) if self.start is None else self.unit(self.start)

    def slope(self, point: Point) -> np.ndarray:
        """dx/du of continuous parameters, shape (n,), in their units."""
        return np.array([_slope(parameter, value) for parameter, value in zip(self.space, point, strict=True)])

    def require(
        self,
        name: str,
        *,
        continuous: bool = False,
        ordered: bool = False,
        one_objective: bool = False,
        no_constraints: bool = False,
        no_start: bool = False,
        several: bool = False,
    ) -> None:
        """Refuse what the method ``name`` cannot do.

        Args:
            name: of the method, for the message.
            continuous: it needs numbers between two numbers.
            ordered: it needs numbers, whole ones too.
            one_objective: it maximizes one value.
            no_constraints: it knows none.
            no_start: it does not start at a point.
            several: it needs at least two parameters.

        Raises:
            SolverError: names what it cannot do, and a solver that can.
        """
        for parameter in self.space:
            if isinstance(parameter, Choice) and (continuous or ordered):
                raise SolverError(
                    f"{name} varies numbers, but {parameter.address} is one of {parameter.range_text}; "
                    f"TPE or grid can do that"
                )
            if continuous and not parameter.is_continuous:
                raise SolverError(
                    f"{name} varies continuous parameters, but {parameter.address} is an integer; CMA-ES can do that"
                )
        if one_objective and self.objectives > 1:
            raise SolverError(f"{name} takes one objective, not {self.objectives}; NSGA-II can do that")
        if no_constraints and self.constraints:
            raise SolverError(f"{name} knows no constraints, and there are {self.constraints}; CMA-ES can do that")
        if several and self.size < 2:
            raise SolverError(f"{name} needs at least two parameters, and there is one; LN_COBYLA can do that")
        if no_start and self.start is not None:
            raise SolverError(f"{name} does not start at a point; leave start away, or tell it of that point")


def _slope(parameter: Dimension, value: float) -> float:
    assert isinstance(parameter, Parameter) and parameter.is_continuous
    return value * math.log(parameter.upper / parameter.lower) if parameter.log else parameter.upper - parameter.lower
