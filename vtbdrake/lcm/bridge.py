"""The bridge between a testbed and a real machine that speaks LCM."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any

from vtbdrake.control.bridge import Bridge, ReceivedSignal
from vtbdrake.control.reported import reported_signals
from vtbdrake.lcm.connections import Handler
from vtbdrake.lcm.hub import STATUS_CHANNEL, TAKE_PREFIX
from vtbdrake.lcm.link import LcmLink
from vtbdrake.lcm.maps import LcmMap
from vtbdrake.lcm.ownership import Ownership
from vtbdrake.lcm.routes import ChannelReader, ChannelWriter, CommandWatch, SentSignal
from vtbdrake.testbed import Interface, Signal

_HUB = "tcpq://"
_PRIVATE = ("memq://", "file://")

CONTENTION = 1.0
"""Seconds for which a command of somebody else speaks against commanding as well."""


class LcmBridge(Bridge):
    """Carries the signals of a testbed over LCM.

    Received messages are checked before anything of them is believed: type, length, sizes, finite entries, the limits
    of the signals, and the order of the sender's times. What fails is counted in its `ReceivedSignal`, and never
    raised. Each signal of a message stands for itself: one that is out of its limits does not take the others along.

    A late message (its time is below the last accepted one's) is ``out of order``, one with the same time a
    ``duplicate``, one whose time is 1.5 s further on than the time that has passed here ``ahead of time``. A sender
    that was restarted, or whose clock was set, is believed once none of its messages has fitted to its old time for
    ``reorder_window`` seconds.

    Commands are the guards' business, but what is not finite or not within a signal's limits does not leave here
    either: the whole message is withheld and counted, as is one that lacks a signal which it cannot do without.

    Attributes:
        url: the bus.
        sent: by actuator signal, how many commands left, and why others did not.
        alarms: by command channel, how many messages came there that are not ours (empty if ``watch`` is off).
        clock_jumps: by channel, how often a sender's time jumped, back or ahead, and was believed.
        losses, reconnections: how often the bus was lost and found again.
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
        watch: bool | None = None,
        on_alarm: Callable[[str, bytes], None] | None = None,
        reorder_window: float = 0.1,
        connect_timeout: float = 2.0,
        burst: int = 200,
    ) -> None:
        """
        Args:
            interface: the DPS's signals.
            url: an LCM URL: ``tcpq://127.0.0.1:7700`` (a hub), ``udpm://239.255.76.67:7667?ttl=0``, ... ``memq://`` is
                private to the connection, and used only if it is asked for by this name.
            sense: maps of the sensor signals, each in exactly one of them.
            act: maps of the actuator signals, each in exactly one of them.
            commands: maps of those commands u that come over LCM.
            reported: by actuator signal, the name under which a map of ``sense`` carries the command that the machine
                says acts on it; such a value is no sensor signal.
            watch: whether to listen to the own command channels for foreign publishers. Left out: on every bus that
                others can be on.
            on_alarm: called, in `poll`, with channel and bytes of a foreign message.
            reorder_window: in seconds, see above.
            connect_timeout: seconds that `open` waits for a hub.
            burst: the most messages that one `poll` takes in.

        Raises:
            ValueError: a signal has no map or several, a map names a signal that is not there or does not fit its
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

        _check_channels([*sense, *commands, *act])
        self.channels = {name: map.channel for map in sense for name in map.signals}
        self.sensed = {signal.name: ReceivedSignal() for signal in interface.sense}
        self.commanded: dict[str, ReceivedSignal] = {}
        self.sent = {signal.name: SentSignal() for signal in interface.act}
        _check_complete(interface.act, act, "actuator")
        carriers = reported_signals(interface, reported or {})
        self.reported = {name: ReceivedSignal() for name in carriers}
        heard = [*interface.sense, *carriers.values()]
        _check_complete(heard, sense, "sensor")
        receptions = self.sensed | {signal.name: self.reported[name] for name, signal in carriers.items()}
        self._inlets = [ChannelReader(map, _signals(heard, map, "sensor"), receptions, reorder_window) for map in sense]
        _check_unique(commands)
        for map in commands:
            signals = _signals(interface.commands, map, "command")
            self.commanded |= {signal.name: ReceivedSignal() for signal in signals}
            self._inlets.append(ChannelReader(map, signals, self.commanded, reorder_window))
        self._outlets = [ChannelWriter(map, _signals(interface.act, map, "actuator"), self.sent) for map in act]
        if watch is None:
            watch = not url.startswith(_PRIVATE)
        self._watches = {map.channel: CommandWatch(on_alarm) for map in act} if watch else {}
        handlers: dict[str, Handler] = {inlet.channel: self._tapped(inlet) for inlet in self._inlets}
        handlers |= {channel: watch.take for channel, watch in self._watches.items()}
        self._ownership = Ownership([map.channel for map in act], lambda: self._link.name)
        if url.startswith(_HUB):
            handlers[STATUS_CHANNEL] = self._ownership.take
        self._link = LcmLink(url, handlers, connect_timeout=connect_timeout)

    @property
    def alarms(self) -> dict[str, int]:
        return {channel: watch.alarms for channel, watch in self._watches.items()}

    @property
    def clock_jumps(self) -> dict[str, int]:
        return {inlet.channel: inlet.clock_jumps for inlet in self._inlets}

    @property
    def losses(self) -> int:
        return self._link.losses

    @property
    def reconnections(self) -> int:
        return self._link.reconnections

    @property
    def connected(self) -> bool:
        return self._link.connected

    @property
    def hindrance(self) -> str | None:
        if not self._ownership.foreign:
            return None
        return f"the hub protects {', '.join(sorted(self._ownership.foreign))} for somebody else"

    @property
    def foreign(self) -> int:
        return sum(watch.alarms for watch in self._watches.values()) + self._ownership.attempts

    @property
    def contention(self) -> str | None:
        # Of a channel that a hub protects, the hub tells who may command; see `hindrance`.
        since = time.monotonic() - CONTENTION
        found = {c for c, watch in self._watches.items() if watch.last > since} - self._ownership.protected
        found.update(self._ownership.contended(CONTENTION))
        if not found:
            return None
        return f"somebody else publishes commands on {', '.join(sorted(found))}: only one may command a machine"

    def open(self) -> None:
        self._link.open()

    def close(self) -> None:
        self._link.close()

    def poll(self, timeout: float = 0.0) -> int:
        return self._link.take(timeout, self._burst)

    def publish(self, commands: Mapping[str, Any]) -> Collection[str]:
        """
        Raises:
            ValueError: there is no such actuator signal.
        """
        for name in commands:
            if name not in self.sent:
                raise ValueError(f"there is no actuator signal {name}; there are {', '.join(self.sent)}")
        self._utime = utime = max(self._utime + 1, int((self._time_of_day + time.monotonic()) * 1e6))
        leaving = [(outlet, data) for outlet in self._outlets if (data := outlet.message(commands, utime)) is not None]
        if not leaving:
            return tuple(commands)
        if self._watches:
            for outlet, data in leaving:
                self._watches[outlet.channel].expect(data)
        left = self._link.publish(*[(outlet.channel, data) for outlet, data in leaving])
        gone: set[str] = set()
        for outlet, data in leaving:
            # What is refused has left all the same: the hub lets it pass as soon as the channel is free.
            refused = "refused" if outlet.channel in self._ownership.foreign else ""
            problem = refused if left else "no bus"
            outlet.count(problem)
            if not problem:
                gone.update(outlet.named)
            if left and self.tap is not None:
                self.tap(outlet.channel, data)
        return () if len(gone) == len(commands) else tuple(name for name in commands if name not in gone)

    def _tapped(self, inlet: ChannelReader) -> Handler:
        def take(channel: str, data: bytes) -> None:
            if self.tap is not None:
                self.tap(channel, data)
            inlet.take(channel, data)

        return take

    def take_over(self) -> None:
        """Asks a hub for the command channels that it protects; it grants those whose owner has fallen silent.

        Raises:
            ValueError: the bus has no hub.
        """
        if not self.url.startswith(_HUB):
            raise ValueError(f"only a hub protects channels; {self.url} has none, so there is nothing to take over")
        self._link.publish(*[(TAKE_PREFIX + outlet.channel, b"") for outlet in self._outlets])


def _signals(signals: Sequence[Signal], map: LcmMap, kind: str) -> list[Signal]:
    known = {signal.name: signal for signal in signals}
    for name in map.signals:
        if name not in known:
            there = ", ".join(known) or "none"
            raise ValueError(f"channel {map.channel} carries {name}, which is no {kind} signal; there are: {there}")
    return [known[name] for name in map.signals]


def _check_complete(signals: Sequence[Signal], maps: Sequence[LcmMap], kind: str) -> None:
    for signal in signals:
        channels = [map.channel for map in maps if signal.name in map.signals]
        if len(channels) != 1:
            found = f"several: {', '.join(channels)}" if channels else "none"
            raise ValueError(f"{kind} signal {signal.name} needs a map to one LCM channel, it has {found}")


def _check_unique(maps: Sequence[LcmMap]) -> None:
    names = [name for map in maps for name in map.signals]
    twins = sorted({name for name in names if names.count(name) > 1})
    if twins:
        raise ValueError(f"a command comes over one LCM channel, but these over several: {', '.join(twins)}")


def _check_channels(maps: Sequence[LcmMap]) -> None:
    channels = [map.channel for map in maps]
    twins = sorted({channel for channel in channels if channels.count(channel) > 1})
    if twins:
        raise ValueError(f"a channel has one map with all its signals, but these have several: {', '.join(twins)}")
