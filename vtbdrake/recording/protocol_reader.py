"""Reading an LCM log of another program, such as lcm-logger, through the protocol of its machine."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from vtbdrake.common.argument_checks import counted
from vtbdrake.common.arrays import Array
from vtbdrake.control.bridge import Reports
from vtbdrake.control.received_signal import ReceivedSignal
from vtbdrake.lcm.lcm_bridge import ChannelReader
from vtbdrake.lcm.maps import LcmMap
from vtbdrake.lcm.protocol import protocol_of
from vtbdrake.recording.log import Log, Series, checked_series
from vtbdrake.recording.log_events import NO_LCM_LOG, LogEvents
from vtbdrake.recording.log_format import LogError
from vtbdrake.testbed import Scenario, Signal

_REORDER_WINDOW = 0.1  # s, as in a bridge

_REASONS = {
    "fingerprint": "of another message type",
    "size": "of another size",
    "limits": "beyond the limits of the signal",
    "decode": "that the map cannot decode",
}
"""What a reason of `ReceivedSignal.rejected` means; the others speak for themselves."""


def read_by_protocol(events: LogEvents, source: str, scenario: Scenario) -> Log:
    """Return the vector signals in an LCM log; see `vtbdrake.recording.read_log`.

    Args:
        events: The events of the file.
        source: The file, for messages.
        scenario: The scenario of the machine that was recorded.

    Raises:
        LogError: The file has no event, or no message of it has a sample of a vector signal.
        ProtocolError: The scenario has no protocol.
    """
    if not events.channels:
        raise LogError(f"{source} is not an LCM log: it has no whole event; {NO_LCM_LOG}")
    protocol, interface = protocol_of(scenario), scenario.interface()
    reports = Reports(interface, protocol.reported, protocol.robot_mode)
    remarks = [f"{source}: recorded by another program: no switches, and no state of the DPS"]
    ordered = _OrderedEvents(events)
    remarks += [f"{source}: {remark}" for remark in ordered.remarks]
    trouble: list[str] = []

    def read(maps: Sequence[LcmMap], signals: Sequence[Signal], reported: Sequence[Signal] = ()) -> dict[str, Series]:
        vectors = {signal.name: _KeptSamples() for signal in signals if signal.is_vector}
        abstract = {signal.name: ReceivedSignal() for signal in (*signals, *reported) if signal.name not in vectors}
        for map in maps:
            period, carried = protocol.periods.get(map.channel, 0.0), [*signals, *reported]
            trouble.extend(_read_channel(ordered, map, carried, vectors | abstract, period))
        return {
            name: checked_series(f"{source}: {name}", np.array(samples.times), np.array(samples.values), remarks)
            for name, samples in vectors.items()
            if samples.values
        }

    sense, act = read(protocol.sense, interface.sense, reports.signals), read(protocol.act, interface.act)
    channels = [map.channel for map in (*protocol.sense, *protocol.act, *protocol.commands)]
    if not (sense or act):
        raise LogError(
            f"{source} has no sample of a vector signal of {scenario.name()}: {'; '.join(trouble)}; it has messages on "
            f"{', '.join(events.channels)}"
        )
    if unmapped := sorted({*events.channels}.difference(channels)):
        trouble.append(f"channels without a map: {', '.join(unmapped)}")
    return Log(source, sense, act, remarks + [f"{source}: {remark}" for remark in trouble])


class _KeptSamples(ReceivedSignal):
    """A received signal that keeps all samples that it accepts, and the times of their arrival in s."""

    def __init__(self) -> None:
        super().__init__()
        self.times: list[float] = []
        self.values: list[Array] = []

    def accept(self, value: Any, arrived: float, sent: float) -> None:
        super().accept(value, arrived, sent)
        self.times.append(arrived)
        self.values.append(value)


class _OrderedEvents:
    """The events of a log without those whose times run backwards in their channel; as few as possible are left out.

    Attributes:
        remarks: What was left out, and when the first event came.
        now: The time of the last message of `on`, in s since the first event of the log.
    """

    def __init__(self, events: LogEvents) -> None:
        self._events = events
        self._places = {channel: _in_order(events.places(channel)) for channel in events.channels}
        self._origin = min((int(places[0, 1]) for places in self._places.values()), default=0)
        self.remarks = [f"the first event, at time 0, is of {np.datetime64(self._origin, 'us')} UTC"]
        if events.damages:
            offset, kind = events.damages[0]
            self.remarks.append(
                f"{counted(len(events.damages), 'damaged place')} skipped, the first at byte {offset}: {kind}"
            )
        if backwards := sum(len(events.places(channel)) - len(places) for channel, places in self._places.items()):
            self.remarks.append(f"{counted(backwards, 'event')} left out, whose times run backwards")
        self.now = 0.0

    def on(self, channel: str) -> Iterator[bytes]:
        """Yield the messages of a channel; `now` is the time of the last one."""
        for _, utime, begin, end in self._places.get(channel, np.empty((0, 4), int)).tolist():
            self.now = 1e-6 * (utime - self._origin)
            yield self._events.data(begin, end)
        self._events.release()


def _in_order(places: np.ndarray) -> np.ndarray:
    """Return the longest part of the events of a channel, (n, 4), whose times do not run backwards."""
    if not (np.diff(places[:, 1]) < 0).any():
        return places
    # Patience sorting: the least last time of a sequence of each length, and its event; and each event's predecessor.
    times: list[int] = []
    last: list[int] = []
    before: list[int] = []
    for k, time in enumerate(places[:, 1].tolist()):
        length = bisect_right(times, time)
        before.append(last[length - 1] if length else -1)
        times[length : length + 1], last[length : length + 1] = [time], [k]
    rows = []
    k = last[-1]
    while k >= 0:
        rows.append(k)
        k = before[k]
    return places[rows[::-1]]


def _read_channel(
    events: _OrderedEvents,
    map: LcmMap,
    signals: Sequence[Signal],
    received: Mapping[str, ReceivedSignal],
    period: float = 0.0,
) -> Iterator[str]:
    """Receive the messages of a channel, ``period`` seconds apart, by the rules of a bridge; yield what is missing."""
    by_name = {signal.name: signal for signal in signals}
    carried = [by_name[name] for name in map.signals]
    try:
        reader = ChannelReader(map, carried, received, _REORDER_WINDOW, period=period, clock=lambda: events.now)
    except ValueError as error:  # A map of commands need not decode.
        yield f"{', '.join(map.signals)}: {error}"
        return
    count = 0
    for data in events.on(map.channel):
        reader.receive(map.channel, data)
        count += 1
    if not count:
        yield f"no message on {map.channel}, which carries {', '.join(map.signals)}"
        return
    for signal in carried:
        for reason, number in received[signal.name].rejected.items():
            yield (
                f"{signal.name}: {number} of {counted(count, 'message')} on {map.channel} rejected: "
                f"{_REASONS.get(reason, reason)}"
            )
        if not signal.is_vector and received[signal.name].count:
            yield f"{signal.name} is left out: it is abstract, and a Log has vectors"
