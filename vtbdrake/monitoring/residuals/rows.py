"""One row of numbers per cycle: all that residuals are made of, fit to be sent to another process."""

from __future__ import annotations

import logging
from collections.abc import Collection, Iterable, Mapping

import numpy as np
from numpy.typing import NDArray

from vtbdrake.control.cycle import Cycle
from vtbdrake.control.runtime import Runtime
from vtbdrake.monitoring.residuals.config import TWIN
from vtbdrake.testbed import Interface, VirtualTestbed
from vtbdrake.testbed.switch import REAL

_log = logging.getLogger(__name__)

Array = NDArray[np.float64]

INDEX, TIME = 0, 1


class RowLayout:
    """Where in a row is what; what is not known in a cycle, or not new, is NaN.

    Entry 0 is the index of the sample by the machine's own time, in periods since the first; entry 1 the DPS's time at
    the end of the cycle.

    Attributes:
        sense: by sensor signal, what the machine told.
        command: by actuator signal, what the DPS commanded.
        reported: by actuator signal, what the machine says acted on it in the period before the sample.
        estimates: by address, what the DPS believes.
        sensed: where all of ``sense`` is, one signal after another.
        commanded: indices of all of ``command``.
        reports: indices of all of ``reported``; ``compared`` are those of the commands that they are reports of.
        width: entries of a row.
    """

    def __init__(self, interface: Interface, reported: Collection[str], estimates: Mapping[str, int]) -> None:
        """``estimates`` are the sizes of them, by address."""
        self.width = 2
        actuators = {signal.name: signal.size or 0 for signal in interface.act}
        self.sense = self._place({signal.name: signal.size or 0 for signal in interface.sense})
        self.command = self._place(actuators)
        self.reported = self._place({name: size for name, size in actuators.items() if name in reported})
        self.estimates = self._place(estimates)
        self.sensed = slice(2, 2 + sum(signal.size or 0 for signal in interface.sense))
        self.commanded = _indices(self.command.values())
        self.reports = _indices(self.reported.values())
        self.compared = _indices(self.command[name] for name in self.reported)

    def _place(self, sizes: Mapping[str, int]) -> dict[str, slice]:
        places = {}
        for name, size in sizes.items():
            places[name] = slice(self.width, self.width + size)
            self.width += size
        return places

    def empty(self, count: int) -> Array:
        """Rows in which nothing is known yet."""
        return np.full((count, self.width), np.nan)


class Sampler:
    """Fills rows with what happened in the cycles of a loop.

    Args:
        runtime: the loop; its context is read after its steps.
        ages: by age of a belief, in periods, the addresses of its estimates, which are read once per horizon.
        horizon: in periods.
    """

    def __init__(
        self, runtime: Runtime, layout: RowLayout, ages: Mapping[int, Iterable[str]], *, mode: str, horizon: int
    ) -> None:
        self._runtime = runtime
        self._layout = layout
        self._sends = mode == TWIN
        self._horizon = horizon
        reader = runtime.target.reader
        self._estimates = [
            (age, [(layout.estimates[address], reader(address)) for address in addresses])
            for age, addresses in ages.items()
        ]
        self._sensed = runtime.bridge.sensed
        self._reported = [(name, runtime.bridge.reported[name]) for name in layout.reported]
        self._counts = dict.fromkeys(layout.reported, 0)
        self._first = np.nan
        self._trouble = ""

    def listens(self) -> bool:
        """Whether the DPS is fed by the machine alone, so that what it believes is about the machine."""
        target = self._runtime.target
        if not isinstance(target, VirtualTestbed):
            return not self._runtime.idle
        return set(target.positions(self._runtime.context)["sense"].values()) == {REAL}

    def fill(self, rows: Array, cycle: Cycle) -> int:
        """Fills rows, all NaN before, with what is new in a cycle; says how many: none without a new sample, and
        several where some of its samples are older than the others."""
        if not cycle.fed:
            return 0
        groups = self._by_index(cycle)
        for row, index in zip(rows, sorted(groups), strict=False):
            row[INDEX], row[TIME] = index, cycle.time
            for name in groups[index]:
                row[self._layout.sense[name]] = cycle.fed[name]
        try:
            self._answer(rows[len(groups) - 1], max(groups), cycle)
            self._trouble = ""
        except (Exception, SystemExit) as error:  # A failed assertion inside Drake arrives as SystemExit.
            # What is not known then is missing in its window. What happens in every cycle is told once.
            if str(error) != self._trouble:
                self._trouble = str(error)
                _log.warning("the DPS raised %s when it was asked for its answer: %s", type(error).__name__, error)
        return len(groups)

    def _by_index(self, cycle: Cycle) -> dict[int, list[str]]:
        """The signals that are new, by the index of their samples; one that does not tell its time is as new as the
        newest that does."""
        times = {name: self._sensed[name].sent for name in cycle.fed}
        if any(sent != sent for sent in times.values()):
            told = [reception.sent for reception in self._sensed.values() if reception.sent == reception.sent]
            if not told:
                return {cycle.number: list(times)}
            times = {name: sent if sent == sent else max(told) for name, sent in times.items()}
        oldest = min(times.values())
        if not self._first <= oldest:  # also at first, when it is NaN, and where the sender's time was set back
            self._first = oldest
        groups: dict[int, list[str]] = {}
        for name, sent in times.items():
            groups.setdefault(round((sent - self._first) / self._runtime.period), []).append(name)
        return groups

    def _answer(self, row: Array, index: int, cycle: Cycle) -> None:
        """What the DPS made of the newest sample, and what is reported beside it."""
        for name, reception in self._reported:
            if reception.count != self._counts[name]:
                self._counts[name] = reception.count
                row[self._layout.reported[name]] = reception.value
        for name, place in self._layout.command.items():
            command = cycle.verdict.commands.get(name) if self._sends else self._runtime.command(name)
            if command is not None:
                row[place] = command
        for age, estimates in self._estimates:
            if (index - age) % self._horizon == 0:
                for place, read in estimates:
                    row[place] = np.ravel(read(self._runtime.context))


def _indices(places: Iterable[slice]) -> list[int]:
    return [k for place in places for k in range(place.start, place.stop)]
