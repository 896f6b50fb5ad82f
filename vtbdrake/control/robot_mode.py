"""The mode that a machine reports: whether it executes commands, has braked without any, or was stopped."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import TYPE_CHECKING

from vtbdrake.control.received_signal import ReceivedSignal

if TYPE_CHECKING:
    # So that a process that only listens on a bus need not load Drake.
    from vtbdrake.testbed import Signal


@dataclass(frozen=True, kw_only=True)
class RobotMode:
    """The numbers by which a machine reports its mode, in a message of `Protocol.sense`.

    Any other number means that the machine must not be commanded, as ``stopped`` does.

    Attributes:
        carrier: The name under which a map of `Protocol.sense` carries the number, a vector of size 1.
        active: The machine executes the commands that arrive.
        braking: The machine does without commands, because none came; it executes the next ones that arrive.
        stopped: The machine was stopped by its own stop, whatever it is sent.
        max_cycles: Number of the loop's cycles without a new report, after which the mode counts as unknown.
    """

    carrier: str
    active: int = 0
    braking: int = 1
    stopped: int = 2
    max_cycles: int = 10

    def __post_init__(self) -> None:
        if len({self.active, self.braking, self.stopped}) < 3:
            raise ValueError(
                f"active, braking and stopped of the mode {self.carrier} are three different numbers, not "
                f"{self.active}, {self.braking} and {self.stopped}"
            )
        if self.max_cycles < 1:
            raise ValueError(f"max_cycles of the mode {self.carrier} is at least 1, not {self.max_cycles}")

    def signal(self, taken: Collection[str]) -> Signal:
        """Return the signal in the messages that carries the number.

        Args:
            taken: The names of the other signals that the machine sends.

        Raises:
            ValueError: The name of the carrier is among them.
        """
        from vtbdrake.testbed import Signal

        if self.carrier in taken:
            raise ValueError(f"the mode of the machine needs a name of its own: {self.carrier!r} is taken")
        return Signal(self.carrier, size=1)


class ReportedMode:
    """The mode that a machine has reported last.

    Attributes:
        mode: The meaning of its number.
        received: The received numbers.
    """

    def __init__(self, mode: RobotMode) -> None:
        self.mode = mode
        self.received = ReceivedSignal()
        self._count = 0
        self._cycles = 0  # of the loop, since the last report

    def note_cycle(self) -> None:
        """Count a cycle of the loop, whose messages have been received."""
        self._cycles = 0 if self.received.count > self._count else self._cycles + 1
        self._count = self.received.count

    @property
    def blocked_reason(self) -> str | None:
        """Return the reason why the machine must not be commanded, or None."""
        mode = self.mode
        if self.received.value is None:
            return f"it has never reported its mode {mode.carrier}, and is to (Protocol.robot_mode)"
        if self._cycles > mode.max_cycles:
            return f"it has not reported its mode {mode.carrier} in the last {self._cycles} cycles"
        number = self.received.value[0]
        if number in (mode.active, mode.braking):
            return None
        if number == mode.stopped:
            return f"its own stop is pressed (it reports the {mode.carrier} {number:g}): release it"
        return (
            f"it reports the {mode.carrier} {number:g}, which is neither active ({mode.active}) nor braking "
            f"({mode.braking})"
        )

    @property
    def is_released(self) -> bool:
        """Return whether the machine reports that it does without commands: it has braked, or was stopped."""
        return self.received.value is not None and self.received.value[0] in (self.mode.braking, self.mode.stopped)
