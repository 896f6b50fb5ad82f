"""How one leaf system is written in CasADi: the base class of all equations, and the registry by class of system."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import casadi
from pydrake.systems.framework import Context, System

from vtbdrake.state.systems import class_name

# casadi.SX; for abstract ports, an object that holds expressions.
Expression = Any

REMEDY = "write its equation as a casadi.Function (see CasadiSystem), or keep this part in Drake"


class UnsupportedTestbedError(ValueError):
    """A part of a Diagram cannot be compiled."""


class RefusedSystemError(UnsupportedTestbedError):
    """A system cannot be compiled, whose address is not known where this is raised."""


@dataclass(frozen=True)
class Timing:
    """When a system is updated: at offset, offset + period, ..., in seconds.

    Drake makes the unrestricted updates of an instant before the discrete ones; all of one kind begin with the same
    state.
    """

    period: float
    offset: float = 0.0
    unrestricted: bool = False


@dataclass(frozen=True)
class Draw:
    """Numbers that are looked up before the rollout, for each update of a system: random ones, or samples of a log.

    A system that is never updated has them at each instant, also in its outputs.

    Attributes:
        size: How many numbers an update takes.
        seed: Where the seed lies in the system's parameters: (number of the group, entry); None: the numbers depend on
            the time alone.
        numbers: Function (seed, time of the update in s) that returns them, shape (size,); without a seed, it is 0.
    """

    size: int
    seed: tuple[int, int] | None
    numbers: Callable[[int, float], Any]


@dataclass(frozen=True)
class Fixed:
    """Entries of a parameter group whose present values are compiled in.

    Attributes:
        group: Number of the numeric parameter group.
        entries: Where they lie in it.
        reason: Why they cannot be varied.
    """

    group: int
    entries: slice
    reason: str


class At(ABC):
    """What a system reads at an instant, as expressions."""

    time: Expression

    @abstractmethod
    def input(self, port: int | str) -> Expression:
        """Return the value at an input port, shape (n, 1)."""

    @abstractmethod
    def is_connected(self, port: int | str) -> bool:
        """Return whether something is connected to an input port, or fixed there."""

    @abstractmethod
    def state(self, group: int) -> Expression:
        """Return a discrete state group, shape (n, 1)."""

    @abstractmethod
    def parameter(self, group: int) -> Expression:
        """Return a numeric parameter group, shape (n, 1)."""

    @abstractmethod
    def memory(self, name: str) -> Expression:
        """Return a number that the equations keep beside the system's own state; see `Equations.memory`."""

    @abstractmethod
    def extra(self, name: str) -> Expression:
        """Return a parameter that is none of a numeric group; see `Equations.extras`."""

    @abstractmethod
    def shared(self, name: str, make: Callable[[], Any]) -> Any:
        """Return what ``make`` returns, made once for all outputs and the update of this instant."""

    @abstractmethod
    def draw(self, name: str) -> Expression:
        """Return numbers of `Equations.draws`, shape (n, 1); in an update only, if the system has updates."""


class Equations(ABC):
    """The equations of one leaf system.

    Attributes:
        system: The system.
        timing: When `update` is made; None: never.
        memory: Numbers that the equations keep beside the system's own state, with their values at the begin.
        extras: Variables that lie in no numeric group, such as masses, by the name under which `At.extra` returns them,
            with their sizes; they are among those that vary.
        draws: The random numbers of an update, and other data, by the name under which `At.draw` returns them.
        may_be_infinite: Whether its discrete state may be infinite or NaN in a valid rollout.
    """

    may_be_infinite = False
    memory: dict[str, float]
    extras: dict[str, int]
    draws: dict[str, Draw]

    def __init__(self, system: System, context: Context, varied: frozenset[str]) -> None:
        """Read the system.

        Args:
            system: The system.
            context: Its own Context, with what is compiled in.
            varied: Names of its variables that will be varied, so that they must not be compiled in; those of a plant
                are addresses within it.

        Raises:
            UnsupportedTestbedError: The system has no equations.
        """
        self.system = system
        self.memory, self.extras, self.draws = {}, {}, {}
        self.timing = unique_timing(system)

    @abstractmethod
    def output(self, port: str, at: At) -> Expression:
        """Return the value of an output port, shape (n, 1)."""

    def derived(self, name: str, at: At) -> Expression | None:
        """Return the value of a variable that is computed from the state, if it has an expression."""
        return None

    def update(self, at: At) -> dict[int | str, Expression]:
        """Return the next values of the discrete groups, by number, and of the memory, by name."""
        return {}

    def updates(self) -> Iterator[tuple[Timing, Callable[[At], dict[int | str, Expression]]]]:
        """Yield when the system is updated, and how; a system with updates at several timings has several."""
        if self.timing is not None:
            yield self.timing, self.update

    def fixed(self) -> Iterator[Fixed]:
        """Yield what is compiled in."""
        return iter(())

    def compiled_in(self, context: Context) -> Any:
        """Return what is compiled in beside `fixed`, in a form that can be compared, of the system's own context."""
        return None

    def refused(self, name: str) -> str:
        """Return why a variable of the system, which lies in no group that is compiled, cannot be varied."""
        return f"it is no number in the compiled state of {self.system.get_name()}"


def unique_timing(system: System) -> Timing | None:
    """Return when a system with at most one kind of discrete update makes it."""
    attribute = system.GetUniquePeriodicDiscreteUpdateAttribute()
    return None if attribute is None else Timing(attribute.period_sec(), attribute.offset_sec())


def refusal(system: System, why: str) -> RefusedSystemError:
    """Return the error that a system cannot be compiled."""
    return RefusedSystemError(f"{class_name(system)} {why}")


def zeros(size: int) -> Expression:
    """Return zeros, dense, shape (size, 1)."""
    return casadi.SX.zeros(size, 1)
