"""Replays a log: the DPS does again, bit for bit, what it did."""

from __future__ import annotations

import logging
import os
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any, cast

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context

from vtbdrake.control.cycle import SWITCH, times_after
from vtbdrake.recording.control_log import ControlLog
from vtbdrake.recording.log_format import LogError
from vtbdrake.recording.log_header import DPS, versions
from vtbdrake.recording.log_reader import read_log
from vtbdrake.recording.replay_report import (
    DIFFERENT,
    IDENTICAL,
    NOT_COMPARED,
    ReplayReport,
    largest_differences,
)
from vtbdrake.recording.replay_run import ReplayRun
from vtbdrake.recording.replay_sources import Sources, SourcesError
from vtbdrake.recording.replay_start import Target, recorded_target
from vtbdrake.testbed import DpsAlone

_log = logging.getLogger(__name__)


def replay(
    log: ControlLog | str | os.PathLike[str],
    target: Target | None = None,
    *,
    values: Mapping[str, Any] | None = None,
    record: Sequence[str] = (),
) -> ReplayReport:
    """Has the DPS do again what it did when ``log`` was recorded, and compares.

    It begins in the recorded state, gets in every cycle what it got, and is stepped as it was; its commands, its time
    and the digests of its state must be the same to the last bit. A cycle in which the DPS raised raises again. Where
    cycles are missing in the log, the replay ends.

    Args:
        log: as of `read_log`, or a file.
        target: what is stepped; by default what was recorded, built from the log's scenario. A `DpsAlone` can replay
            the log of a testbed whose sensor signals were all on real; a testbed can replay the log of a DPS alone,
            with its simulated world idle beside it.
        values: of variables, by address, that hold from the beginning on, whatever the log says of them: what would the
            DPS have commanded with another gain? Nothing is compared then.
        record: addresses of variables or output ports to be read after every cycle.

    Raises:
        OSError, LogError: the log cannot be read, or is of another scenario or another version of it; it says what
            differs.
        AddressError: an address is unknown.
    """
    log = log if isinstance(log, ControlLog) else read_log(log)
    run = None if target or values or record else _at_once(log)
    if run is None:
        run = ReplayRun(log, target or recorded_target(log), dict(values or {}), record)
        run.run()
    found = run.differences()
    outcome = NOT_COMPARED if values else DIFFERENT if found else IDENTICAL
    here = versions()
    return ReplayReport(
        outcome=outcome,
        cycles=run.count,
        ended=run.ended,
        first_difference=found[0] if outcome == DIFFERENT else None,
        max_difference={} if values else largest_differences(log, run.commands),
        digests=len(run.digests),
        versions=tuple(
            f"recorded with {name} {version}, replayed with {here.get(name)}"
            for name, version in log.header.versions.items()
            if here.get(name) != version
        ),
        times=run.times,
        commands=run.commands,
        errors=run.errors,
        record={address: _stacked(samples) for address, samples in run.record.items()},
    )


class _AtOnce(ReplayRun):
    """One replay of a DPS alone, with Python only where something is changed or looked at."""

    def __init__(self, log: ControlLog, target: DpsAlone) -> None:
        self._sources = Sources(log, target)
        super().__init__(log, target, {}, ())

    def _new_context(self) -> Context:
        return self._sources.diagram.CreateDefaultContext()

    def _new_simulator(self) -> Simulator:
        return self._sources.simulator(self._context, restored=self._log.header.initialized)

    def _look(self) -> None:
        """A DPS alone commands all its signals, from its beginning on."""

    def run(self) -> None:
        changes, digests = self._changes(), {i for i, _ in self._log.digests}
        switched = [i for i, change in self._log.changes if change.kind == SWITCH]
        first = min([*switched, self.count] if self._idle else [0])
        header, steps = self._log.header, self._steps + np.arange(self.count - first + 1)
        times = times_after(steps, start=header.start_time, period=header.period)
        self.times[:first], self.times[first:] = self._now, times[1:]
        if first < self.count and not self._sources.complete_from(first):
            raise SourcesError("the DPS begins without a value of every sensor signal")
        looked = {*changes, *(i + 1 for i in digests), *range(first + 1)}
        for i, end in pairwise([*sorted(i for i in looked if i < self.count), self.count]):
            for change in changes.get(i, ()):
                self._apply(change)
            if i >= first:
                self._sources.advance(self._simulator, i, end, times[i - first : end - first + 1])
            if end - 1 in digests:
                self.digests.append((end - 1, self._digest()))
        for name, values in self._sources.commands(self._context, times[1:]).items():
            self.commands[name][first:], self.commanded[name][first:] = values, True


def _at_once(log: ControlLog) -> ReplayRun | None:
    """The replay of the DPS alone that was recorded, or None if it needs every cycle looked at.

    What differs from the log proves nothing here: then a replay cycle by cycle tells.
    """
    if log.header.target != DPS:
        return None
    try:
        run = _AtOnce(log, cast(DpsAlone, recorded_target(log)))
        run.run()
    except LogError:
        raise
    except (Exception, SystemExit) as error:  # A failed assertion inside Drake arrives as SystemExit.
        _log.info("replayed cycle by cycle: %s", error)
        return None
    if found := run.differences():
        _log.info("replayed cycle by cycle: %s", found[0])
        return None
    return run


def _stacked(samples: list[Any]) -> Any:
    return np.array(samples) if all(isinstance(sample, float | np.ndarray) for sample in samples) else samples
