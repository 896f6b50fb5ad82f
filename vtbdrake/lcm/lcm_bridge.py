"""The bridge between a testbed and a real machine that speaks LCM."""

from __future__ import annotations

import json
import logging
import os
import time
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from math import nan
from typing import Any

from vtbdrake.common.failures import FAILURES
from vtbdrake.control.bridge import Bridge, Reports
from vtbdrake.control.inbox import Inbox
from vtbdrake.control.limits import Bounds
from vtbdrake.control.message_order import CommandOrder, MachineOrder
from vtbdrake.control.received_signal import ReceivedSignal
from vtbdrake.control.robot_mode import RobotMode
from vtbdrake.lcm.connections import Handler, LcmLink
from vtbdrake.lcm.hub import KEEP_PREFIX, STATUS_CHANNEL, TAKE_PREFIX, HubStatistics
from vtbdrake.lcm.maps import LcmMap
from vtbdrake.lcm.messages import MalformedError
from vtbdrake.testbed import Interface, Signal

_log = logging.getLogger(__name__)

_HUB = "tcpq://"
_PRIVATE = ("memq://", "file://")

MARK_CHANNEL = "VTB_MARK"
"""The channel on which a bridge publishes a mark; the hub returns it after all messages that have waited there."""

FOREIGN_TIMEOUT = 1.0
"""Seconds for which a foreign actuator command prevents a switch to the real machine."""

REJECTED_CHANNEL = "VTB_REJECTED"
"""The channel on which a bridge answers rejected commands u, see `LcmBridge`."""

_MOST_ANSWERS = 10  # per poll: what is rejected in a flood of messages must not hold up the loop


class LcmBridge(Bridge):
    """Carries the signals of a testbed over LCM.

    Every received message is checked: type, length, sizes, finite entries, the limits of the signals, and the order of
    the sender's times. What fails is counted in its `ReceivedSignal`, and never raised. The signals of a message are
    checked one by one: one that is out of its limits does not invalidate the others.

    What a machine sends has one sender: a message is ``out of order`` if its time is before the last accepted one's, a
    ``duplicate`` if it is the same, and ``ahead of time`` if it is farther ahead of this computer's clock than any
    message before, by more than `MAX_AHEAD` and the period of its channel, unless the bus was lost in between. A
    machine that was restarted, or whose clock was set, is accepted after ``reorder_window`` seconds in which no message
    has continued its old time, and all have continued each other; see `MachineOrder`.

    A command u may have several senders, whose clocks differ: the newest by arrival counts. Only if the messages name
    their senders (`command_map`, ``vector_map(..., sender=)``), one that arrives within ``reorder_window`` after a
    later one of the same sender is rejected; see `CommandOrder`. A rejected command u is answered on `REJECTED_CHANNEL`
    with JSON: ``{"channel": CHANNEL, "sender": NAME, "rejected": {COMMAND: REASON}, "count": N}``, at most 10 answers
    each time that messages are received. The loop raises an alarm, too.

    After a pause (`note_pause`) a hub, and the socket to it, may still hold old messages, or the hub may have closed
    the connection after sending them. So the bridge publishes a mark. Values that arrive before the mark has returned
    count as received at the beginning of the pause.

    The guards limit actuator commands. One that is nevertheless not finite, or not within its signal's limits, is never
    sent: its whole message is withheld and counted, as is a message that lacks a required signal.

    Attributes:
        url: The LCM URL of the bus.
        sent: By actuator signal, how many commands were sent, and why others were not.
        foreign_messages: By actuator channel, how many messages of other publishers were heard (with ``watch``).
        clock_jumps: By channel, how often a sender's time jumped, back or ahead, and was accepted.
        link: The connection to the bus, which counts losses and reconnections.
    """

    def __init__(
        self,
        interface: Interface,
        url: str,
        *,
        sense: Sequence[LcmMap],
        act: Sequence[LcmMap],
        commands: Sequence[LcmMap] = (),
        reported: Mapping[str, str] | None = None,
        robot_mode: RobotMode | None = None,
        periods: Mapping[str, float] | None = None,
        watch: bool | None = None,
        reorder_window: float = 0.1,
        connect_timeout: float = 2.0,
        burst: int = 200,
    ) -> None:
        """Check the maps; `open` connects.

        Args:
            interface: The DPS's signals.
            url: An LCM URL: ``tcpq://127.0.0.1:7700`` (a hub), ``udpm://239.255.76.67:7667?ttl=0``, ... ``memq://`` is
                private to the connection.
            sense: Maps of the sensor signals, each in exactly one of them.
            act: Maps of the actuator signals, each in exactly one of them.
            commands: Maps of those commands u that come over LCM.
            reported: By actuator signal, the name under which a map of ``sense`` carries the actuator command that the
                machine says it executes.
            robot_mode: The mode that the machine reports, in a map of ``sense``; None if it does not.
            periods: By channel of ``sense``, seconds between two messages, see `Protocol`; channels on which a message
                comes in each cycle need none.
            watch: Whether to listen on the actuator channels for other publishers. By default on every bus that others
                can be on.
            reorder_window: Window in seconds, see above.
            connect_timeout: Seconds that `open` waits for a hub.
            burst: The most messages that one `poll` receives.

        Raises:
            ValueError: A signal has no map or several, a map names a signal that does not exist or does not fit its
                message type, or two maps have one channel.
        """
        if "://" not in url:
            raise ValueError(f"an LCM URL has the form provider://network, not {url!r}; say tcpq://127.0.0.1:7700")
        self.interface = interface
        self.url = url
        self._burst = burst
        self._utime = 0
        # Never goes back, unlike the time of day that it starts from.
        self._time_of_day = time.time() - time.monotonic()

        reports = Reports(interface, reported or {}, robot_mode)
        published = [*interface.sense, *reports.signals]
        _check_maps(sense, act, commands, published, interface)
        self.channels = {name: map.channel for map in sense for name in map.signals}
        self.sensed = {signal.name: ReceivedSignal() for signal in interface.sense}
        self.reported, self.robot_mode = reports.acting, reports.robot_mode
        self.commands = {name: ReceivedSignal() for map in commands for name in map.signals}
        self.sent = {signal.name: SentSignal() for signal in interface.act}
        received = self.sensed | reports.received
        periods = periods or {}
        self._readers = [
            ChannelReader(map, _signals(published, map), received, reorder_window, period=periods.get(map.channel, 0.0))
            for map in sense
        ]
        self._rejections: Counter[tuple[str, str, tuple[tuple[str, str], ...]]] = Counter()  # to be answered
        self._readers += [self._command_reader(map, reorder_window) for map in commands]
        self._writers = [ChannelWriter(map, _signals(interface.act, map), self.sent) for map in act]

        self._watch = not url.startswith(_PRIVATE) if watch is None else watch
        self._foreign = ForeignCommands([map.channel for map in act], lambda: self.link.name)
        self.foreign_messages: Mapping[str, int] = self._foreign.heard
        self._paused: tuple[float, frozenset[str]] | None = None  # since when, and the signals; until the mark is back
        self._mark = b""
        self._mark_sent: int | None = None  # on which connection
        handlers = self._handlers([map.channel for map in act])
        self.link = LcmLink(url, handlers, connect_timeout=connect_timeout, reconnected=self._expect_gap)

    def _command_reader(self, map: LcmMap, reorder_window: float) -> ChannelReader:
        return ChannelReader(
            map,
            _signals(self.interface.commands, map),
            self.commands,
            reorder_window,
            several_senders=True,
            rejected=partial(self._note_rejected, map.channel),
        )

    def _handlers(self, act_channels: Sequence[str]) -> dict[str, Handler]:
        """Return the function that takes the messages of each channel that is listened on."""
        handlers: dict[str, Handler] = {reader.channel: self._tapped(reader) for reader in self._readers}
        if self._watch:
            handlers |= dict.fromkeys(act_channels, self._foreign.receive)
        if self.url.startswith(_HUB):
            handlers[STATUS_CHANNEL] = self._foreign.receive_status
            handlers[MARK_CHANNEL] = self._receive_mark
        return handlers

    @property
    def clock_jumps(self) -> dict[str, int]:
        return {reader.channel: reader.clock_jumps for reader in self._readers}

    @property
    def connected(self) -> bool:
        return self.link.connected

    @property
    def blocked_reason(self) -> str | None:
        if not self._foreign.blocked:
            return None
        return f"the hub protects {', '.join(sorted(self._foreign.blocked))} for another client"

    @property
    def foreign(self) -> int:
        return sum(self._foreign.heard.values()) + self._foreign.refused

    @property
    def competing_publisher(self) -> str | None:
        channels = self._foreign.recent(FOREIGN_TIMEOUT)
        if not channels:
            return None
        return f"another client publishes commands on {', '.join(sorted(channels))}: only one may command a machine"

    def open(self) -> None:
        self.link.open()

    def close(self) -> None:
        self.link.close()

    def poll(self, timeout: float = 0.0) -> int:
        count = self.link.receive(timeout, self._burst)
        if self._rejections:
            self._answer_rejected()
        if self._paused is not None:
            self._date_back(*self._paused)
            if self._mark_sent != self.link.reconnections:
                self._send_mark()
        return count

    def _note_rejected(self, channel: str, sender: str, reasons: Mapping[str, str]) -> None:
        self._rejections[channel, sender, tuple(reasons.items())] += 1

    def _answer_rejected(self) -> None:
        answers = [
            {"channel": channel, "sender": sender, "rejected": dict(reasons), "count": count}
            for (channel, sender, reasons), count in self._rejections.most_common(_MOST_ANSWERS)
        ]
        self._rejections.clear()
        self.link.publish(*[(REJECTED_CHANNEL, json.dumps(answer).encode()) for answer in answers])

    def note_pause(self, since: float, signals: Collection[str]) -> bool:
        """Date values back until all that has waited at the hub is read; on other buses nothing is done.

        Args:
            since: When everything that had arrived was read last, on the clock of `ReceivedSignal.arrived`, in seconds.
            signals: Names of the sensor signals whose values would be too old if they had arrived then.
        """
        if not self.url.startswith(_HUB):
            return False
        earlier, earlier_signals = self._paused or (since, frozenset())
        self._paused = min(earlier, since), earlier_signals.union(signals)
        self._send_mark()
        return True

    def _send_mark(self) -> None:
        self._mark = os.urandom(8)
        sent = self.link.publish((MARK_CHANNEL, self._mark))
        self._mark_sent = self.link.reconnections if sent else None

    def _receive_mark(self, _: str, data: bytes) -> None:
        if self._paused is not None and data == self._mark:
            self._date_back(*self._paused)
            self._paused = None

    def _date_back(self, since: float, signals: Collection[str]) -> None:
        for received in map(self.sensed.__getitem__, signals):
            if received.arrived > since:
                received.arrived, received.sent = since, nan  # The two no longer tell how long the message took.

    def publish(self, actuation: Mapping[str, Any]) -> Collection[str]:
        """Send actuator commands.

        Args:
            actuation: Actuator commands by signal.

        Returns:
            The signals whose actuator commands were not sent, or do not pass the hub.

        Raises:
            ValueError: There is no such actuator signal.
        """
        for name in actuation:
            if name not in self.sent:
                raise ValueError(f"there is no actuator signal {name}; there are {', '.join(self.sent)}")
        self._utime = utime = max(self._utime + 1, int((self._time_of_day + time.monotonic()) * 1e6))
        messages = [
            (writer.channel, *message)
            for writer in self._writers
            if (message := writer.message(actuation, utime)) is not None
        ]
        if self._watch:
            for channel, _, data in messages:
                self._foreign.expect(channel, data)
        sent = bool(messages) and self.link.publish(*[(channel, data) for channel, _, data in messages])
        passed: set[str] = set()
        for channel, names, data in messages:
            # A refused message was sent all the same: the hub lets it pass as soon as the channel is free.
            refused = "refused" if channel in self._foreign.blocked else ""
            problem = refused if sent else "no bus"
            for name in names:
                self.sent[name].record(problem)
            if not problem:
                passed.update(names)
            if sent and self.tap is not None:
                self.tap(channel, data)
        return () if len(passed) == len(actuation) else tuple(name for name in actuation if name not in passed)

    def keep(self, signals: Collection[str]) -> None:
        if self.url.startswith(_HUB):
            channels = [writer.channel for writer in self._writers if not writer.signals.isdisjoint(signals)]
            self.link.publish(*[(KEEP_PREFIX + channel, b"") for channel in channels])

    def _tapped(self, reader: ChannelReader) -> Handler:
        def receive(channel: str, data: bytes) -> None:
            if self.tap is not None:
                self.tap(channel, data)
            reader.receive(channel, data)

        return receive

    def _expect_gap(self) -> None:
        for reader in self._readers:
            reader.expect_gap()

    def claim(self) -> None:
        """Claim the protected actuator channels at the hub, which grants those whose owner has fallen silent.

        Raises:
            ValueError: The bus has no hub.
        """
        if not self.url.startswith(_HUB):
            raise ValueError(f"only a hub protects channels; {self.url} has none, so there is nothing to claim")
        self.link.publish(*[(TAKE_PREFIX + writer.channel, b"") for writer in self._writers])


class ChannelReader:
    """Checks the messages of one channel and updates its signals, by the rules of `LcmBridge`."""

    def __init__(
        self,
        map: LcmMap,
        signals: Sequence[Signal],
        received: Mapping[str, ReceivedSignal],
        reorder_window: float,
        *,
        period: float = 0.0,
        several_senders: bool = False,
        clock: Callable[[], float] = time.monotonic,
        rejected: Callable[[str, Mapping[str, str]], None] | None = None,
    ) -> None:
        """Prepare the decoder.

        Args:
            map: The map of the channel.
            signals: The signals of the map.
            received: The received signals, by name; the signals of the map are updated.
            reorder_window: Window in seconds, see `LcmBridge`.
            period: Time between two messages of a machine in seconds, see `MachineOrder`.
            several_senders: Whether the signals are commands u, which several may send.
            clock: The time at which messages arrive, in seconds.
            rejected: Called with the sender's name, and the reasons by signal, for a message with a rejected signal.

        Raises:
            ValueError: The map cannot carry the signals.
        """
        self.channel = map.channel  # name of the channel
        self._clock = clock
        self._map = map
        self._names_sender = several_senders and map.sender is not None
        self._decode = map.decoder(signals)
        order = CommandOrder(reorder_window) if several_senders else MachineOrder(reorder_window, period)
        self._inbox = Inbox(signals, received, order)
        self._rejected = rejected

    @property
    def clock_jumps(self) -> int:
        """Return the number of accepted jumps of a sender's time, back or ahead."""
        return self._inbox.order.clock_jumps

    def expect_gap(self) -> None:
        """Accept the next message however far ahead it is: after a loss of the bus, messages are missing."""
        self._inbox.order.expect_gap()

    def limit_lead(self, is_limited: bool) -> None:
        """Limit by how much a message may be ahead of this computer's clock, or not; see `MessageOrder.limit_lead`."""
        self._inbox.order.limit_lead(is_limited)

    def receive(self, channel: str, data: bytes) -> None:
        """Handle one message.

        Args:
            channel: Name of the channel, which is always the reader's.
            data: The bytes of the message.
        """
        now, sender = self._clock(), ""
        try:
            sent, values = self._decode(data)
            if self._names_sender:
                sender = self._map.sender_of(data)
        except MalformedError as error:
            reasons = self._inbox.reject(error.reason)
        except FAILURES:
            reasons = self._inbox.reject("decode")
        else:
            reasons = self._inbox.take(values, sent=sent, now=now, sender=sender)
        if reasons and self._rejected is not None:
            self._rejected(sender, reasons)


@dataclass
class SentSignal:
    """The record of one actuator signal.

    Attributes:
        count: How many actuator commands were sent.
        withheld: How many were not, by reason: ``type``, ``size``, ``not finite``, ``limits``, ``incomplete`` (its
            message needs another signal), ``same message`` (another command of its message was withheld), ``encode``,
            ``no bus`` (lost, or it accepts nothing at present), ``refused`` (the hub protects the channel for another
            client; counted from the hub's first message about it).
    """

    count: int = 0
    withheld: dict[str, int] = field(default_factory=dict)

    def record(self, problem: str) -> None:
        """Count an actuator command as sent, or as withheld because of a problem."""
        if problem:
            self.withheld[problem] = self.withheld.get(problem, 0) + 1
        else:
            self.count += 1


class ChannelWriter:
    """Makes the messages of one channel.

    Args:
        map: The map of the channel.
        sent: By actuator signal, the record that is updated.

    Attributes:
        channel: Name of the channel.
        signals: Names of its actuator signals.
    """

    def __init__(self, map: LcmMap, signals: Sequence[Signal], sent: Mapping[str, SentSignal]) -> None:
        """Prepare the encoder.

        Raises:
            ValueError: The map cannot carry the signals.
        """
        self.channel = map.channel
        self._encode = map.encoder(signals)
        self._bounds = {signal.name: Bounds(signal) for signal in signals}
        self.signals = self._bounds.keys()
        self._sent = sent

    def message(self, actuation: Mapping[str, Any], utime: int) -> tuple[list[str], bytes] | None:
        """Return the signals and the bytes of the message with this channel's actuator commands.

        None if there are no such commands, or if one of them must not be sent: then all are withheld.

        Args:
            actuation: The actuator commands by signal; signals of other channels are left out.
            utime: The time stamp of the message, in microseconds.
        """
        values, faults = {}, {}
        for name, bounds in self._bounds.items():
            if name in actuation:
                values[name] = actuation[name]
                if reason := bounds.violation(values[name]):
                    faults[name] = reason
        if not values:
            return None
        if not faults:
            try:
                return list(values), self._encode(values, utime)
            except LookupError:
                faults = dict.fromkeys(values, "incomplete")
            except FAILURES:
                faults = dict.fromkeys(values, "encode")
        for name in values:
            self._sent[name].record(faults.get(name, "same message"))
        return None


class ForeignCommands:
    """Detects other publishers on the actuator channels: their messages, and a hub's reports on protected channels.

    Our own messages come back, too, in any order: they are recognized by their bytes, which the time stamp makes
    unique. A copy of one is foreign. A protected channel lets only its owner's messages pass.

    Attributes:
        heard: By channel, the number of messages received from other clients.
        refused: The number of messages of other clients that a hub has refused on the channels of this client.
        blocked: The channels that a hub protects for another client; it reports them within 10 ms of the first refusal.
    """

    _MEMORY = 4096  # own messages on their way per channel: enough for some seconds in which the hub is stopped

    def __init__(self, channels: Sequence[str], name: Callable[[], str | None]) -> None:
        """Start with nothing heard.

        Args:
            channels: The actuator channels.
            name: Returns the present name of our connection at the hub.
        """
        self.heard = dict.fromkeys(channels, 0)
        self.refused = 0
        self.blocked: frozenset[str] = frozenset()
        self._name = name
        self._protected: frozenset[str] = frozenset()
        # By channel and message, how often it was sent and has not come back; the oldest first.
        self._expected: dict[str, dict[bytes, int]] = {channel: {} for channel in channels}
        self._heard_at: dict[str, float] = {}
        self._refused_at: dict[str, float] = {}
        self._refusals: dict[str, int] = {}  # of the hub so far, by channel

    def expect(self, channel: str, data: bytes) -> None:
        """Remember a message that is about to be sent.

        Args:
            channel: The actuator channel on which it is sent.
            data: The bytes of the message.
        """
        expected = self._expected[channel]
        expected[data] = expected.pop(data, 0) + 1
        if len(expected) > self._MEMORY:
            del expected[next(iter(expected))]

    def receive(self, channel: str, data: bytes) -> None:
        """Handle a message that came on an actuator channel.

        Args:
            channel: The actuator channel.
            data: The bytes of the message.
        """
        expected = self._expected[channel]
        if (left := expected.pop(data, 0)) > 0:
            if left > 1:
                expected[data] = left - 1
            return
        self.heard[channel] += 1
        self._heard_at[channel] = time.monotonic()

    def receive_status(self, _: str, data: bytes) -> None:
        """Handle a message of the hub's status channel."""
        try:
            status = HubStatistics.from_json(data).protected
        except (ValueError, TypeError, KeyError, AttributeError):
            _log.warning("a message on the hub's status channel is no status: %r", data[:100])
            return
        ours, blocked = self._name(), set()
        self._protected = frozenset(status.keys() & self.heard.keys())
        for channel in self._protected:
            state = status[channel]
            if state.owner is not None and state.owner != ours:
                blocked.add(channel)
                if channel not in self.blocked:
                    _log.error("commands on %s are refused by the hub: the channel belongs to %s", channel, state.owner)
            # Refusals before the first status are not counted.
            before = self._refusals.get(channel, state.refused)
            self._refusals[channel] = state.refused
            if ours is not None and state.owner == ours != state.last_refused and state.refused > before:
                self.refused += state.refused - before
                self._refused_at[channel] = time.monotonic()
        self.blocked = frozenset(blocked)

    def recent(self, seconds: float) -> set[str]:
        """Return the channels on which another client has published within the last ``seconds``.

        On a protected channel of this client, the attempt counts: the hub has refused the message.
        """
        since = time.monotonic() - seconds
        heard = {channel for channel, at in self._heard_at.items() if at > since}
        return heard - self._protected | {channel for channel, at in self._refused_at.items() if at > since}


def _signals(signals: Sequence[Signal], map: LcmMap) -> list[Signal]:
    by_name = {signal.name: signal for signal in signals}
    return [by_name[name] for name in map.signals]


def _check_maps(
    sense: Sequence[LcmMap],
    act: Sequence[LcmMap],
    commands: Sequence[LcmMap],
    published: Sequence[Signal],
    interface: Interface,
) -> None:
    """Raise ValueError if the maps do not fit the signals; ``published`` are those that the machine publishes."""
    channels = [map.channel for map in [*sense, *commands, *act]]
    if twins := sorted({channel for channel in channels if channels.count(channel) > 1}):
        raise ValueError(f"a channel has one map with all its signals, but these have several: {', '.join(twins)}")
    for kind, maps, signals in (
        ("sensor", sense, published),
        ("actuator", act, interface.act),
        ("command", commands, interface.commands),
    ):
        carriers: dict[str, list[str]] = {signal.name: [] for signal in signals}
        for map in maps:
            for name in map.signals:
                if name not in carriers:
                    raise ValueError(
                        f"channel {map.channel} carries {name}, which is no {kind} signal; there are: "
                        f"{', '.join(carriers) or 'none'}"
                    )
                carriers[name].append(map.channel)
        for name, carrying in carriers.items():
            if len(carrying) > 1 or (not carrying and kind != "command"):
                several = f"several: {', '.join(carrying)}" if carrying else "none"
                raise ValueError(f"{kind} signal {name} needs a map to one LCM channel, it has {several}")
