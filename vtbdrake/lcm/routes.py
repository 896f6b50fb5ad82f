"""What happens to the messages of one channel on their way in, and out."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping, MutableMapping, Sequence
from dataclasses import dataclass, field
from math import inf, isfinite
from typing import Any

from vtbdrake.control.bridge import ReceivedSignal
from vtbdrake.control.ranges import Range
from vtbdrake.lcm.maps import LcmMap
from vtbdrake.lcm.messages import MessageDecoder
from vtbdrake.lcm.wire import MalformedError
from vtbdrake.testbed import Signal

_log = logging.getLogger(__name__)

_LAYOUTS = 4  # that an inlet remembers: messages of a channel are laid out alike, or change between a few ways


AHEAD = 1.5
"""Seconds by which a sender's time may get ahead of ours from one message to the next: how much quicker the second may
have come, or how much faster than real time a sender runs that simulates."""


class ChannelReader:
    """Takes in the messages of one channel.

    By the sender's time, a message can be late (``out of order``), a ``duplicate``, or ``ahead of time``: further on
    from the last one than the time that has passed here and `AHEAD`. A sender whose clock was set, or which was
    restarted, is believed once no message has fitted to its old time for the reorder window.

    Attributes:
        channel: its name.
        clock_jumps: how often the sender's time jumped, back or ahead, and was believed.
    """

    def __init__(
        self, map: LcmMap, signals: Sequence[Signal], receptions: Mapping[str, ReceivedSignal], reorder_window: float
    ) -> None:
        """
        Raises:
            ValueError: the map cannot carry the signals.
        """
        self.channel = map.channel
        self.clock_jumps = 0
        self._read = map.reader(signals)
        self._receptions = {signal.name: receptions[signal.name] for signal in signals}
        self._ranges = {signal.name: Range(signal) for signal in signals}
        for name, reception in self._receptions.items():
            reception.range = self._ranges[name]
        self._map, self._signals = map, signals
        # By their size, the messages that can be taken in quickly; None for those that cannot.
        self._intakes: dict[int, MessageDecoder | None] = {}
        self._reorder_window = reorder_window
        self._last = -inf
        self._last_arrived = -inf
        # Since when no message has fitted to the sender's time.
        self._unfit_since = inf

    def take(self, channel: str, data: bytes) -> None:
        """Handles one message."""
        now = time.monotonic()
        intake = self._intakes.get(len(data))
        # Before the first message, that is infinite.
        most = self._last + (now - self._last_arrived) + AHEAD if self._last > -inf else inf
        if intake is not None and (taken := intake.take(data, self._last, most, now)) is not None:
            self._believe(taken, now)
            return
        try:
            sent, values = self._read(data)
            reason = "" if self._last < sent <= most else self._order(sent, now)
        except MalformedError as error:
            reason = error.reason
        except (Exception, SystemExit):  # a failed assertion in Drake's C++ is a SystemExit
            reason = "decode"
        if reason:
            for reception in self._receptions.values():
                reception.reject(reason)
            return
        accepted = self._sorted_out(values)
        for name, reception in accepted.items():
            reception.accept(values[name], now, sent)
        if len(accepted) == len(self._receptions):
            self._learn(data)
        if accepted:
            if isfinite(sent) and not self._last < sent <= most:
                self.clock_jumps += 1
            self._believe(sent, now)

    def _believe(self, sent: float, now: float) -> None:
        """Goes on from a message that was accepted."""
        self._unfit_since = inf
        if isfinite(sent):
            self._last, self._last_arrived = sent, now

    def _learn(self, data: bytes) -> None:
        """Takes in messages like an accepted one quickly from now on, if there is a way."""
        if len(data) not in self._intakes and len(self._intakes) < _LAYOUTS:
            receptions = list(self._receptions.values())
            self._intakes[len(data)] = self._map.intake(self._signals, receptions, data)

    def _sorted_out(self, values: Mapping[str, Any]) -> dict[str, ReceivedSignal]:
        """The receptions of those values that can be accepted; the others count theirs as rejected."""
        accepted = {}
        for name, reception in self._receptions.items():
            reason = self._ranges[name].check(values[name]) if name in values else "missing"
            if reason:
                reception.reject(reason)
            else:
                accepted[name] = reception
        return accepted

    def _order(self, sent: float, now: float) -> str:
        """Why a message that does not fit to the last one is not to be believed; empty if it is."""
        if not isfinite(sent):
            return ""
        if sent == self._last:
            return "duplicate"
        self._unfit_since = min(self._unfit_since, now)
        if now - self._unfit_since > self._reorder_window:
            return ""
        return "out of order" if sent < self._last else "ahead of time"


@dataclass
class SentSignal:
    """What is known of one actuator signal.

    Attributes:
        count: how many commands left.
        withheld: how many did not, by the reason: ``size``, ``not finite``, ``limits``, ``incomplete`` (its message
            cannot go without another signal), ``companion`` (another signal of its message was at fault), ``encode``,
            ``no bus`` (it is lost, or takes nothing at present), ``refused`` (its hub protects the channel for somebody
            else; counted from when the hub has said so).
    """

    count: int = 0
    withheld: dict[str, int] = field(default_factory=dict)

    def withhold(self, reason: str) -> None:
        """Counts a command that did not leave."""
        self.withheld[reason] = self.withheld.get(reason, 0) + 1


class ChannelWriter:
    """Makes the messages of one channel.

    Attributes:
        channel: its name.
        named: the signals of the last message.
    """

    def __init__(self, map: LcmMap, signals: Sequence[Signal], transmissions: MutableMapping[str, SentSignal]) -> None:
        """
        Raises:
            ValueError: the map cannot carry the signals.
        """
        self.channel = map.channel
        self._write = map.writer(signals)
        self._ranges = {signal.name: Range(signal) for signal in signals}
        # The quick way, if all signals are commanded.
        self._form = map.form(signals, self._ranges)
        self._transmissions = transmissions
        self._all = list(self._ranges)
        self.named: list[str] = []

    def message(self, commands: Mapping[str, Any], utime: int) -> bytes | None:
        """The message of those commands that are this channel's; None if there are none, or none may leave."""
        if self._form is not None and (message := self._form.fill(commands, utime)) is not None:
            self.named = self._all
            return message
        values = {name: commands[name] for name in self._ranges if name in commands}
        self.named = list(values)
        if not values:
            return None
        faults = {name: reason for name in values if (reason := self._ranges[name].check(values[name]))}
        if not faults:
            try:
                return self._write(values, utime)
            except LookupError:
                faults = dict.fromkeys(values, "incomplete")
            except (Exception, SystemExit):
                faults = dict.fromkeys(values, "encode")
        for name in values:
            self._transmissions[name].withhold(faults.get(name, "companion"))
        return None

    def count(self, problem: str) -> None:
        """Counts what became of the last message: it left, if there was no problem."""
        for name in self.named:
            if problem:
                self._transmissions[name].withhold(problem)
            else:
                self._transmissions[name].count += 1


class CommandWatch:
    """Tells messages on an own command channel that somebody else has sent.

    Our own come back, too, in any order and number of those that we sent: they are known by their bytes, in which our
    time stamp makes each different. A copy of one of ours is somebody else's.

    Attributes:
        alarms: how many there were.
        last: when the last one came, by `time.monotonic`; -inf before the first.
    """

    _MEMORY = 4096  # own messages that may be on their way at a time: some seconds of a hub that stands still

    def __init__(self, on_alarm: Callable[[str, bytes], None] | None) -> None:
        self.alarms = 0
        self.last = -inf
        self._on_alarm = on_alarm
        # How often each was sent and has not come back; the oldest first.
        self._own: dict[bytes, int] = {}

    def expect(self, data: bytes) -> None:
        """Remember a message that is about to be sent."""
        self._own[data] = self._own.pop(data, 0) + 1
        if len(self._own) > self._MEMORY:
            del self._own[next(iter(self._own))]

    def take(self, channel: str, data: bytes) -> None:
        """Handle one message that came."""
        if (left := self._own.pop(data, 0)) > 0:
            if left > 1:
                self._own[data] = left - 1
            return
        self.alarms += 1
        self.last = time.monotonic()
        if self._on_alarm is None:
            return
        try:
            self._on_alarm(channel, data)
        except Exception:
            _log.exception("what was to be told of alarms raised, and is told nothing from now on")
            self._on_alarm = None
