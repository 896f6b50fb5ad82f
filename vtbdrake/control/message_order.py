"""The order of messages by their senders' times: which message is new, late, repeated, or ahead of its time."""

from __future__ import annotations

from abc import ABC, abstractmethod
from math import inf, isnan
from typing import NamedTuple

from vtbdrake.common.lru import LruDict

MAX_AHEAD = 1.5
"""Seconds by which a sender's time may get ahead of ours from one message to the next: by a shorter latency, or because
the sender is a simulation that runs faster than real time."""

LATEST_TIME = 2.0**53 * 1e-6
"""The latest possible time of a sender, in seconds: the year 2255. Beyond it, times in microseconds are not exact."""

MAX_SENDERS = 64
"""The number of senders of one channel whose times are remembered: those that were heard last."""

LONGEST_SENDER = 64
"""The number of characters of a sender's name that tell it from others."""


class MessageOrder(ABC):
    """Decides whether a message is new, by the time that its sender has given it.

    A time before 1970 or after `LATEST_TIME` is an ``impossible time``. A message without a time is always new.
    """

    clock_jumps: int = 0
    """How often a sender's time jumped, back or ahead, and was accepted."""

    def problem(self, sent: float, now: float, sender: str = "") -> str:
        """Return the reason why a message is rejected; empty if it is new.

        Args:
            sent: The sender's time in seconds; NaN if the message has none.
            now: The time of arrival in seconds.
            sender: The name of the sender; empty if the message does not name it.
        """
        if 0.0 <= sent <= LATEST_TIME:
            return self._problem(sent, now, sender)
        return "" if isnan(sent) else "impossible time"

    @abstractmethod
    def _problem(self, sent: float, now: float, sender: str) -> str:
        """Return the reason why a message with a possible time is rejected; empty if it is new."""

    @abstractmethod
    def note(self, sent: float, now: float, sender: str = "") -> None:
        """Note a message that is new, after `problem` was asked, and whose content was accepted.

        Args:
            sent: The sender's time in seconds; NaN if the message has none.
            now: The time of arrival in seconds.
            sender: The name of the sender; empty if the message does not name it.
        """

    def expect_gap(self) -> None:  # noqa: B027 - most need not
        """Take note that messages may be missing, because the bus was lost."""

    def limit_lead(self, is_limited: bool) -> None:  # noqa: B027 - most do not
        """Let no message be ``ahead of time``, or limit again by how much it may be ahead.

        Args:
            is_limited: Whether to limit it: not where the sender waits for this computer, in lock-step.
        """


class MachineOrder(MessageOrder):
    """The order of the messages of one sender, a machine, which counts on a clock.

    A message is ``out of order`` if its time is before the last accepted one's, a ``duplicate`` if it is the same, and
    ``ahead of time`` if it is farther ahead of this computer's clock than any message before, by more than
    `MAX_AHEAD` and a ``period``, unless the bus was lost in between. If no message continues the old time for longer
    than ``window`` seconds, and all that came meanwhile continue each other, the sender was restarted or its clock was
    set: its time is accepted. A single message with a wrong time never is.

    Args:
        window: Time in seconds.
        period: The time between two messages by the sender's clock, in seconds: a simulation that runs faster than real
            time gets ahead by up to that from each to the next.
    """

    def __init__(self, window: float, period: float = 0.0) -> None:
        self._window, self._period = window, period
        self.limit_lead(True)
        self._last = -inf  # time of the sender in the last accepted message
        self._ahead = inf  # by how much it was ahead of ours, at most: a message that has waited does not count
        # The same of the messages that do not continue this time, but each other, and when the first of them came.
        self._other_last = -inf
        self._other_ahead = inf
        self._other_since = inf

    def expect_gap(self) -> None:
        self._ahead = inf

    def limit_lead(self, is_limited: bool) -> None:
        self._most = MAX_AHEAD + self._period if is_limited else inf

    def _problem(self, sent: float, now: float, sender: str) -> str:
        if self._last < sent <= now + self._ahead + self._most:
            return ""
        if sent == self._last:
            return "duplicate"
        if self._other_last < sent <= now + self._other_ahead + self._most and self._other_since < inf:
            if now - self._other_since > self._window:
                return ""
            self._other_last, self._other_ahead = sent, max(self._other_ahead, sent - now)
        elif not self._other_last - self._most <= sent <= self._other_last:  # else two of them were exchanged
            self._other_last, self._other_ahead, self._other_since = sent, sent - now, now
        return "out of order" if sent < self._last else "ahead of time"

    def note(self, sent: float, now: float, sender: str = "") -> None:
        if isnan(sent):
            return
        ahead, fits = sent - now, self._last < sent <= now + self._ahead + self._most
        if fits and self._ahead < inf:
            ahead = max(ahead, self._ahead)
        self.clock_jumps += not fits
        self._last, self._ahead = sent, ahead
        self._other_last, self._other_ahead, self._other_since = -inf, inf, inf


class _Newest(NamedTuple):
    sent: float  # time of the sender in its last accepted message, in seconds
    arrived: float  # when that arrived, in seconds


class CommandOrder(MessageOrder):
    """The order of the messages of several senders, which may all command the same.

    Their clocks differ. So what arrives is new, whatever its time is, and the newest counts, unless the message names
    its sender: then one that arrives within ``window`` seconds after a later one of the same sender is ``out of order``
    (the two have overtaken each other on the network), or a ``duplicate`` if its time is the same. After a longer time
    the clock of the sender was set. A time of 0 tells nothing.

    Args:
        window: Time in seconds.
    """

    def __init__(self, window: float) -> None:
        self._window = window
        self._newest: LruDict[str, _Newest] = LruDict(MAX_SENDERS)

    def _problem(self, sent: float, now: float, sender: str) -> str:
        newest = self._newest.use(sender[:LONGEST_SENDER]) if sender and sent else None
        if newest is None or sent > newest.sent or now - newest.arrived > self._window:
            return ""
        return "duplicate" if sent == newest.sent else "out of order"

    def note(self, sent: float, now: float, sender: str = "") -> None:
        if not sender or not sent or isnan(sent):
            return
        name = sender[:LONGEST_SENDER]
        newest = self._newest.use(name)
        self.clock_jumps += newest is not None and sent < newest.sent
        self._newest.add(name, _Newest(sent, now))
