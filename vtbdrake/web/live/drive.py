"""A testbed is driven by hand: keys and sticks move commands u and actuators, in a fork of the simulation."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from vtbdrake.common.argument_checks import as_array, suggestion
from vtbdrake.common.json_data import plain
from vtbdrake.rollout.course import Course, DrivenRollout
from vtbdrake.testbed.switch import COMMAND, T_ACT, Position
from vtbdrake.web.live.written_course import add_writes

if TYPE_CHECKING:
    from pydrake.systems.framework import Context

    from vtbdrake.rollout import RolloutResult, RolloutTask
    from vtbdrake.state import Snapshot
    from vtbdrake.testbed import Signal, VirtualTestbed

_IDLE = ".idle"


class DriveError(ValueError):
    """Something cannot be driven by hand."""


@dataclass(frozen=True, eq=False)
class Handle:
    """A command u, or an actuator in place of the DPS, that can be driven by hand.

    Attributes:
        address: ``u.<signal>``, or ``T_act.<signal>.idle`` of an actuator.
        unit: Its unit.
        lower, upper: The bounds of its entries, shape (n,).
        rate: How fast each entry moves at full deflection, shape (n,), in units per second: the rate limit of the
            signal; without one, from bound to bound in two seconds; without bounds, one unit per second.
    """

    address: str
    unit: str
    lower: np.ndarray
    upper: np.ndarray
    rate: np.ndarray

    @classmethod
    def of(cls, address: str, signal: Signal) -> Handle:
        """Return the handle of a vector signal.

        Args:
            address: ``u.<signal>``, or ``T_act.<signal>.idle`` of an actuator.
            signal: The signal, whose unit, bounds and rate limit hold for the handle.
        """
        lower, upper, limit = (signal.vector(value) for value in (signal.lower, signal.upper, signal.rate))
        width = np.where(np.isfinite(upper - lower), upper - lower, 2.0)
        return cls(address, signal.unit, lower, upper, np.where(np.isfinite(limit), limit, 0.5 * width))

    @property
    def is_bounded(self) -> bool:
        """Return whether all entries have two bounds."""
        return bool(np.isfinite(self.upper - self.lower).all())

    def description(self) -> dict[str, Any]:
        """Return the description that a page shows."""
        is_actuator = self.address.startswith(T_ACT)
        return {
            "address": self.address,
            "unit": self.unit,
            "size": self.rate.size,
            "bounded": self.is_bounded,
            "actuator": is_actuator,
        }

    def moved(self, now: np.ndarray, deflection: np.ndarray, seconds: float, center: np.ndarray | None) -> np.ndarray:
        """Return the entries after a time.

        Args:
            now: The entries now, shape (n,).
            deflection: From -1 to 1, shape (n,).
            seconds: The time in seconds.
            center: Where a released stick goes: the entries follow the deflection, at full deflection to a bound, as
                fast as the rate allows. None: they move while the stick is held, and stay where they are.
        """
        most = self.rate * seconds
        if center is None:
            change = most * deflection
        else:
            reach = np.where(deflection > 0.0, self.upper - center, center - self.lower)
            change = np.clip(center + deflection * reach - now, -most, most)
        return np.clip(now + change, self.lower, self.upper)


def handles(testbed: VirtualTestbed) -> dict[str, Handle]:
    """Return the handles of all that can be driven in a testbed, by address."""
    variables = testbed.variables()
    commands = {f"{COMMAND}{signal.name}": signal for signal in testbed.interface.commands}
    actuators = {f"{T_ACT}{signal.name}{_IDLE}": signal for signal in testbed.interface.act if signal.is_vector}
    # A command that is the output of a system in the testbed is no variable.
    return {a: Handle.of(a, signal) for a, signal in {**commands, **actuators}.items() if a in variables}


@dataclass(frozen=True, eq=False)
class Driven:
    """A course that somebody has driven.

    Attributes:
        course: Where it began, and what was set when: `Course.rollout` computes it again, bit for bit.
        result: The rollout along it, with the quality of the session's problem.
    """

    course: Course
    result: RolloutResult

    def summary(self) -> dict[str, Any]:
        """Return the summary that a page shows."""
        result, steps = self.result, self.course.steps
        return {
            "seconds": float(result.times[-1]) if steps is None else steps * self.course.step,
            "end": result.message or result.end,
            "failed": result.failed,
            "value": plain(result.value),
            "t_star": plain(result.t_star),
        }


class Driver:
    """Moves handles in a fork of a simulation, step by step.

    An actuator is driven in place of the DPS: its switch is on real in the fork, where the simulated one gets its idle
    command, and that is what moves. It begins at the command of the DPS.

    Args:
        testbed: The testbed.
        start: Where the fork begins.
        task: The task whose quality is sampled.
        step: The time between two instants at which handles move, in seconds.
        addresses: The handles.
        returning: Those of them that return when they are released, see `Handle.moved`.

    Attributes:
        rollout: The rollout.
        notice: Why the sticks were released; empty if the driver did it.

    Raises:
        DriveError: There is no such handle, or one without bounds is to return.
    """

    def __init__(
        self,
        testbed: VirtualTestbed,
        start: Snapshot,
        task: RolloutTask,
        *,
        step: float,
        addresses: Sequence[str],
        returning: Collection[str] = (),
    ) -> None:
        self._testbed, self._step = testbed, step
        self._handles = _select(handles(testbed), addresses)
        self.rollout = DrivenRollout(task, start, step=step, testbed=testbed)
        self._deflections = {address: np.zeros(handle.rate.size) for address, handle in self._handles.items()}
        self._centers = {address: self._now(address) for address in returning}
        for address in returning:
            if address not in self._handles or not self._handles[address].is_bounded:
                raise DriveError(f"{address} has no bounds to which a stick could lead: it cannot return when released")
        self._pending: dict[str, Any] = {}
        self.notice = ""
        for address in self._handles:
            if address.startswith(T_ACT):
                self._pending |= self._taken(address)

    def _taken(self, address: str) -> dict[str, Any]:
        """Return the values that take an actuator away from the DPS, at its present command."""
        handle, name = self._handles[address], address.removeprefix(T_ACT).removesuffix(_IDLE)
        port = self._testbed.dps.GetOutputPort(name)
        command = port.Eval(self._testbed.dps.GetMyContextFromRoot(self.context))
        entries = np.where(np.isfinite(command), np.clip(command, handle.lower, handle.upper), self._now(address))
        return {f"{T_ACT}{name}": Position.REAL.number, address: self._shaped(address, entries)}

    def _now(self, address: str) -> np.ndarray:
        return np.atleast_1d(self._testbed.read(self.context, address))

    def _shaped(self, address: str, entries: np.ndarray) -> Any:
        return entries.reshape(self._testbed.variables()[address].shape)

    @property
    def context(self) -> Context:
        """Return the context of the fork."""
        return self.rollout.context

    @property
    def ended(self) -> str:
        """Return the reason why the rollout has ended; empty while it goes on."""
        result = self.rollout.result
        return "" if result is None else result.message or result.end

    def deflect(self, deflections: Mapping[str, Any]) -> None:
        """Deflect sticks: by address, a number from -1 to 1 for each entry; those left out are released.

        Raises:
            DriveError: The handle is not driven, or has another number of entries, or a deflection is out of range.
        """
        new = {address: np.zeros_like(old) for address, old in self._deflections.items()}
        for address, value in deflections.items():
            if address not in new:
                raise DriveError(f"{address} is not driven, but {', '.join(new)}")
            entries = np.atleast_1d(as_array(f"the deflection of {address}", value))
            if entries.shape != new[address].shape or not (np.abs(entries) <= 1.0).all():
                raise DriveError(
                    f"the deflection of {address} is {new[address].size} numbers from -1 to 1, not {value!r}"
                )
            new[address] = entries
        self._deflections = new

    def let_go(self, reason: str) -> None:
        """Release all sticks, as whoever drove is gone, and note the reason."""
        self.deflect({})
        self.notice = reason

    def set(self, values: Mapping[str, Any]) -> None:
        """Set other variables with the next step.

        Raises:
            ValueError: There is no such variable, or it does not take the value.
        """
        for address, value in values.items():
            self._testbed.variables()[address].check(value)
        for address in values:  # A handle moves as a whole.
            if (handle := address.partition("[")[0]) in self._handles:
                self._pending.setdefault(handle, self._shaped(handle, self._now(handle)))
        add_writes(self._pending, values)

    def advance(self) -> None:
        """Move the handles, and simulate one step."""
        values = dict(self._pending)
        for address, handle in self._handles.items():
            now = np.atleast_1d(values.get(address, self._now(address)))
            moved = handle.moved(now, self._deflections[address], self._step, self._centers.get(address))
            if not np.array_equal(moved, now):
                values[address] = self._shaped(address, moved)
        self._pending.clear()
        self.rollout.advance(values)

    def end(self) -> Driven:
        """End the rollout here, unless it has ended."""
        result = self.rollout.end()
        return Driven(self.rollout.course, result)

    def released(self) -> Snapshot:
        """Return the present state with the actuators given back to the DPS."""
        names = [a.removesuffix(_IDLE) for a in self._handles if a.startswith(T_ACT)]
        self._testbed.write(self.context, dict.fromkeys(names, Position.SIM.number))
        return self._testbed.snapshot(self.context)

    def status(self) -> dict[str, Any]:
        """Return the status that a page shows."""
        result = self.rollout.result
        f = self.rollout.value if result is None else result.value
        return {
            "values": {address: self._now(address).tolist() for address in self._handles},
            "seconds": self.rollout.steps * self._step,
            "value": plain(f),
            "t_star": None if result is None else plain(result.t_star),
            "ended": self.ended,
            "notice": self.notice,
        }


def _select(available: Mapping[str, Handle], addresses: Sequence[str]) -> dict[str, Handle]:
    if not addresses:
        raise DriveError("nothing is driven: name a command u or an actuator")
    for address in addresses:
        if address not in available:
            raise DriveError(f"{address} cannot be driven by hand{suggestion(address, available)}")
    return {address: available[address] for address in addresses}
