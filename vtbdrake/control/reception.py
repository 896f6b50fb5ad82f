"""How a loop receives what its bridge has got: also after a pause, in which messages have waited."""

from __future__ import annotations

from collections.abc import Mapping
from math import inf

from vtbdrake.control.bridge import Bridge
from vtbdrake.control.clock import Clock
from vtbdrake.control.guards import MOST_UNSENT
from vtbdrake.control.received_signal import ReceivedSignal
from vtbdrake.control.sensor_monitor import SensorMonitor

_MOST_POLLS = 100
"""Number of polls at most for messages that have waited while the loop was held up."""

_LONGEST_WAIT = 0.1
"""Time to wait for newer samples after a pause, in seconds."""


class Reception:
    """Receives by a bridge, and knows until when all that had arrived was received.

    Args:
        bridge: The bridge of the loop.
        clock: The clock of the loop.
        monitors: The monitor of each sensor signal, which knows how old its samples may be.
        period: Period of the loop, in seconds.

    Attributes:
        read_at: Time on the clock when all that had arrived was received, in seconds.
    """

    def __init__(self, bridge: Bridge, clock: Clock, monitors: Mapping[str, SensorMonitor], period: float) -> None:
        self._bridge = bridge
        self._clock = clock
        self._monitors = monitors
        self._period = period
        # Between two cycles; after a longer time, what has waited may be too old.
        shortest_age = min((monitor.max_age for monitor in monitors.values()), default=inf)
        self._longest_gap = max(shortest_age, (MOST_UNSENT + 1) * period)
        self.read_at = clock.now()

    def receive(self, watched: Mapping[str, ReceivedSignal], *, since: float, behind: bool) -> float:
        """Receive what a cycle needs besides its poll; return the time when all had been received, in seconds.

        Args:
            watched: The sensor signals that are on real.
            since: When the cycle began, on the clock in seconds.
            behind: Whether the loop was held up, so that several messages may wait.
        """
        if since - self.read_at > self._longest_gap:
            self.catch_up(watched, patience=_LONGEST_WAIT)
        elif behind:
            self._read_backlog()
        self.read_at = now = self._clock.now()
        return now

    def catch_up(self, watched: Mapping[str, ReceivedSignal], *, patience: float) -> None:
        """Receive all that has waited in a pause; where that may be too old, wait for newer values.

        Args:
            watched: The sensor signals that are on real.
            patience: The longest wait, in seconds; nothing is waited for longer than its ``max_age`` or 0.1 s.
        """
        begin, ages = self._clock.now(), {name: monitor.max_age for name, monitor in self._monitors.items()}
        gap = begin - self.read_at
        old = [name for name, age in ages.items() if gap > max(age, self._longest_gap)]
        dated_back = bool(old) and self._bridge.note_pause(self.read_at, old)
        self._read_backlog()
        limits = {name: begin + min(max(ages[name], _LONGEST_WAIT), patience) for name in old if name in watched}
        while dated_back and any(
            now < limit and self._bridge.sensed[name].age(now) > ages[name]
            for now in [self._clock.now()]
            for name, limit in limits.items()
        ):
            self._clock.wait_until(self._clock.now() + self._period)
            self._bridge.poll()
        self.read_at = self._clock.now()

    def _read_backlog(self) -> None:
        """Poll until nothing more has arrived: a message counts as new when it is received."""
        for _ in range(_MOST_POLLS):
            if not self._bridge.poll():
                return
