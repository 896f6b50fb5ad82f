"""The inbox of a bridge: a decoded message is checked, and updates its signals or is counted."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from vtbdrake.control.limits import Bounds
from vtbdrake.control.message_order import MachineOrder, MessageOrder
from vtbdrake.control.received_signal import ReceivedSignal

if TYPE_CHECKING:
    # So that a process that only listens on a bus need not load Drake.
    from vtbdrake.testbed import Signal


class Inbox:
    """Checks the messages of one sender and updates their signals; nothing that arrives raises.

    A message counts if its time continues the times of the last ones, and a value if it is finite, has the size of its
    signal and is within its limits. The signals of a message are checked one by one.

    Args:
        signals: The signals that the messages carry.
        received: The received signals by name; only these objects are updated.
        order: Which messages are new, by their times; by default `MachineOrder` with a window of 0.1 s.
    """

    def __init__(
        self, signals: Sequence[Signal], received: Mapping[str, ReceivedSignal], order: MessageOrder | None = None
    ) -> None:
        self.order = order or MachineOrder(0.1)
        self._signals = [(signal.name, received[signal.name], Bounds(signal)) for signal in signals]
        for _, received_signal, bounds in self._signals:
            received_signal.bounds = bounds

    def take(self, values: Mapping[str, Any], *, sent: float, now: float, sender: str = "") -> dict[str, str]:
        """Take a message, and return why signals were rejected, by signal.

        Args:
            values: The values by signal; one that lacks is rejected as ``missing``.
            sent: The sender's time in seconds; NaN if the message has none.
            now: The time of arrival on the clock of `time.monotonic`, in seconds.
            sender: The name of the sender, for an order that tells senders apart.
        """
        if problem := self.order.problem(sent, now, sender):
            return self.reject(problem)
        reasons: dict[str, str] = {}
        for name, received, bounds in self._signals:
            if reason := bounds.violation(values[name]) if name in values else "missing":
                received.reject(reason, values[name] if reason in ("limits", "not finite") else None)
                reasons[name] = reason
            else:
                received.accept(values[name], now, sent)
        if len(reasons) < len(self._signals):
            self.order.note(sent, now, sender)
        return reasons

    def reject(self, reason: str) -> dict[str, str]:
        """Count a message that cannot be decoded, such as ``truncated``, for all its signals, and return the reasons.

        Args:
            reason: The reason, in a word or two.
        """
        for _, received, _ in self._signals:
            received.reject(reason)
        return {name: reason for name, _, _ in self._signals}
