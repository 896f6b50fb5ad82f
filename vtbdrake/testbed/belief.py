"""s_sim(t0) generated from s_dps(t): the robot's belief becomes the simulation's starting point."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import inf

from numpy.typing import ArrayLike
from pydrake.systems.framework import Context

from vtbdrake.state import Variables


@dataclass(frozen=True)
class Belief:
    """``target`` (an address in sim) is ``by`` of the estimates at the addresses ``of`` (in dps).

    ``age`` is the time in seconds from the instant of the world that the estimates are about to that of the sensor
    values from which they are made: that of sampling, say. What lies between machine and DPS does not count.

    Raises:
        ValueError: several estimates and no ``by``, or an age that is negative or infinite.
    """

    target: str
    of: tuple[str, ...]
    by: Callable[..., ArrayLike] | None = None
    age: float = 0.0

    def __post_init__(self) -> None:
        if not 0.0 <= self.age < inf:
            raise ValueError(f"the age of the belief about {self.target} is a time of at least 0 s, not {self.age!r}")
        if self.by is None and len(self.of) != 1:
            raise ValueError(f"the belief about {self.target} is of {len(self.of)} estimates: say with by= how")

    def check(self, variables: Variables) -> None:
        """Looks both sides up.

        Raises:
            ValueError: an address does not exist, the target is not simulated, or an estimate is not the DPS's.
        """
        variables[self.target]
        for address in self.of:
            variables[address]
            if not address.startswith("dps."):
                raise ValueError(f"the belief about {self.target} is of {address}, which the DPS does not hold")
        if not self.target.startswith("sim."):
            raise ValueError(f"a belief sets a variable of the simulated world, not {self.target}")

    def value(self, variables: Variables, context: Context) -> ArrayLike:
        """What the DPS in ``context`` believes the target to be."""
        return self.value_of([variables[address].get(context) for address in self.of])

    def value_of(self, estimates: Sequence[ArrayLike]) -> ArrayLike:
        """What estimates, in the order of `of`, say of the target."""
        return self.by(*estimates) if self.by is not None else estimates[0]
