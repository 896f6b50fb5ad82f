"""How one leaf system is written in CasADi: the base class of all equations, and the registry by class of system."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import casadi
from pydrake.systems.framework import Context, System

from vtbdrake.common.arrays import Array
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

    Attributes:
        period: The time between two updates, in seconds.
        offset: The time of the first update, in seconds.
        unrestricted: Whether the updates are unrestricted ones.
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
        numbers: Function (seeds of shape (n,), times of m updates in s) that returns them, shape (n, m, size); without
            a seed, n is 1.
    """

    size: int
    seed: tuple[int, int] | None
    numbers: Callable[[Array, Array], Array]


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
    def extra(self, name: str) -> Expression:
        """Return a parameter that is none of a numeric group; see `Equations.extras`."""

    @abstractmethod
    def constant(self, name: str) -> Expression:
        """Return a number that is in no context; see `Equations.constants`."""

    @abstractmethod
    def shared(self, name: str, make: Callable[[], Any]) -> Any:
        """Return the result of ``make``, made once for all outputs and the update of this instant.

        Args:
            name: The key of the result within the system.
            make: The function without arguments that computes it.
        """

    @abstractmethod
    def is_shared(self, name: str) -> bool:
        """Return whether `shared` has made this result."""

    @abstractmethod
    def draw(self, name: str) -> Expression:
        """Return numbers of `Equations.draws`, shape (n, 1); in an update only, if the system has updates."""


class Equations(ABC):
    """The equations of one leaf system.

    Attributes:
        system: The system.
        timing: When `update` is made; None: never.
        extras: Variables that lie in no numeric group, such as masses, by the name under which `At.extra` returns them,
            with their sizes; they are among those that vary.
        constants: Numbers that are in no context, such as the one of a terrain, with their values, by the name under
            which `At.constant` returns them; a call may replace them.
        draws: The random numbers of an update, and other data, by the name under which `At.draw` returns them.
        may_be_infinite: Whether its discrete state may be infinite or NaN in a valid rollout.
        doubtful: What is wrong where `doubt` is positive, as a sentence.
        endings: The messages with which the updates may end a simulation, see `ending`.
        agreement: The largest difference from the system's own state after one step, relative to the largest entry of
            its state, or to 1: what rounding makes, or where an iteration ends.
    """

    may_be_infinite = False
    doubtful = "its equations do not hold"
    endings: tuple[str, ...] = ()
    agreement = 1e-11
    extras: dict[str, int]
    constants: dict[str, float]
    draws: dict[str, Draw]

    def __init__(self, system: System, context: Context, varied: frozenset[str]) -> None:
        """Read the system.

        Args:
            system: The system.
            context: Its own Context, with what is compiled in.
            varied: Names of its variables that will be varied, so that they must not be compiled in; a plant's names
                are addresses within it.

        Raises:
            UnsupportedTestbedError: The system has no equations.
        """
        self.system = system
        self.extras, self.constants, self.draws = {}, {}, {}
        self.timing = unique_timing(system)

    @abstractmethod
    def output(self, port: str, at: At) -> Expression:
        """Return the value of an output port, shape (n, 1).

        Args:
            port: Name of the output port.
            at: Inputs, state and parameters at this instant.
        """

    def derived(self, name: str, at: At) -> Expression | None:
        """Return the value of a variable that is computed from the state, if it has an expression.

        Args:
            name: Name of the variable within the system.
            at: Inputs, state and parameters at this instant.
        """
        return None

    def update(self, at: At) -> dict[int, Expression]:
        """Return the next values of the discrete groups, by number."""
        return {}

    def doubt(self, at: At) -> Expression | None:
        """Return a number that is positive where the equations differ from the system, or None if they never do.

        Args:
            at: Inputs, state and parameters at this instant, after all its outputs and updates have been written.
        """
        return None

    def ending(self, at: At) -> Expression:
        """Return the number in `endings`, from 1 on, with which the update ends the simulation; 0: it goes on.

        Args:
            at: Inputs, state and parameters at the instant of the update.
        """
        return casadi.SX(0)

    def updates(self) -> Iterator[tuple[Timing, Callable[[At], dict[int, Expression]]]]:
        """Yield when the system is updated, and how; a system with updates at several timings has several."""
        if self.timing is not None:
            yield self.timing, self.update

    def fixed(self) -> Iterator[Fixed]:
        """Yield what is compiled in."""
        return iter(())

    def compiled_in(self, context: Context) -> Any:
        """Return the values compiled in beside `fixed`, of the system's own context, in a comparable form."""
        return None

    def refused(self, name: str) -> str:
        """Return the reason why a variable of the system, outside all compiled groups, cannot be varied."""
        return f"it is no number in the compiled state of {self.system.get_name()}"


def unique_timing(system: System) -> Timing | None:
    """Return the timing of a system with at most one kind of discrete update."""
    attribute = system.GetUniquePeriodicDiscreteUpdateAttribute()
    return None if attribute is None else Timing(attribute.period_sec(), attribute.offset_sec())


def refusal(system: System, why: str) -> RefusedSystemError:
    """Return the error that a system cannot be compiled.

    Args:
        system: The system, whose class the message names.
        why: The rest of the sentence, which tells the reason and the remedy.
    """
    return RefusedSystemError(f"{class_name(system)} {why}")


def zeros(size: int) -> Expression:
    """Return zeros, dense, shape (size, 1)."""
    return casadi.SX.zeros(size, 1)
