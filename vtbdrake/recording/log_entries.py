"""What a log tells, in the order of time: values of signals, and events."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from heapq import merge
from operator import itemgetter
from typing import NamedTuple

import numpy as np

from vtbdrake.control.stepping import Change, ChangeKind
from vtbdrake.recording.log import Log, Series
from vtbdrake.recording.log_reader import ControlLog


class LogEntry(NamedTuple):
    """One entry of a log.

    Attributes:
        time: Its time in ns since 1970; of a `Log`, in the log's time.
        stream: The stream that it belongs to, ``sense/position``.
        content: The entries of a vector, or what happened as a text.
        is_error: Whether it is an error that happened.
    """

    time: int
    stream: str
    content: Sequence[float] | str
    is_error: bool = False


def log_entries(log: ControlLog | Log) -> Iterator[LogEntry]:
    """Yield all entries of a log in the order of time.

    The streams are ``sense/<signal>``, ``command/<signal>`` (actuator commands of the DPS) and ``sent/<signal>`` (after
    the guards), wherever they have a new value; ``cycle/time`` (of the DPS, s), ``cycle/since_last`` (on the loop's
    clock, s) and ``cycle/ok``, 1 if the DPS's commands were sent; and, when they happen, ``variable/<address>``
    (variables that were changed, the commands u among them) and the texts ``switches``, ``result/<slow part>``,
    ``faults`` and ``reset`` (of the guards). A value that is not there is NaN. Abstract signals are left out.

    Args:
        log: The log; one of another program has samples alone.
    """
    return _samples(log) if isinstance(log, Log) else _entries(log)


def log_sides(log: Log) -> Iterator[tuple[str, Series]]:
    """Yield ``sense.<signal>`` and ``sent.<signal>`` with their samples.

    Args:
        log: The log.
    """
    yield from ((f"sense.{name}", series) for name, series in log.sense.items())
    yield from ((f"sent.{name}", series) for name, series in log.act.items())


def _samples(log: Log) -> Iterator[LogEntry]:
    origin = min(log.start, 0.0)  # MCAP has no negative times.

    def entries(name: str, series: Series) -> Iterator[LogEntry]:
        stream = name.replace(".", "/", 1)
        for time, value in zip(series.times.tolist(), series.values.tolist(), strict=True):
            yield LogEntry(round(1e9 * (time - origin)), stream, value)

    yield from merge(*(entries(name, series) for name, series in log_sides(log)), key=itemgetter(0))


def _entries(log: ControlLog) -> Iterator[LogEntry]:
    times = [1000 * utime for utime in log.utimes.tolist()]
    occasional: dict[int, list[LogEntry]] = {}
    for i, stream, content, is_error in [*_initial(log), *_changes(log), *_faults(log)]:
        occasional.setdefault(i, []).append(LogEntry(times[i], stream, content, is_error))
    series = [(stream, values.tolist(), present.tolist()) for stream, values, present in _series(log)]
    since_last, ok, dps_times = [None, *np.diff(log.now).tolist()], log.ok.tolist(), log.times.tolist()
    for i, time in enumerate(times):
        yield from occasional.get(i, ())
        yield LogEntry(time, "cycle/time", [dps_times[i]])
        if (since := since_last[i]) is not None:
            yield LogEntry(time, "cycle/since_last", [since])
        yield LogEntry(time, "cycle/ok", [float(ok[i])])
        for stream, values, present in series:
            if present[i]:
                yield LogEntry(time, stream, values[i])


def _series(log: ControlLog) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    for name, values in log.fed.items():
        yield f"sense/{name}", values, log.sources[name] != 0
    for name, values in log.actuation.items():
        yield f"command/{name}", values, log.commanded[name]
    for name, values in log.sent.items():
        yield f"sent/{name}", values, ~np.isnan(values).all(axis=1)


# Number of the cycle, stream, content, and whether it is an error.
_Event = tuple[int, str, Sequence[float] | str, bool]


def _initial(log: ControlLog) -> Iterator[_Event]:
    """Yield the initial positions of switches, and the initial values of variables that change later."""
    if not len(log):
        return
    if log.header.positions:
        positions = {f"{side}.{name}": at for side, by in log.header.positions.items() for name, at in by.items()}
        yield 0, "switches", _positions_text(positions), False
    changed = {address for _, change in log.changes if change.kind == ChangeKind.WRITE for address in change.values}
    for address in sorted(changed & log.start.values.keys()):
        yield 0, f"variable/{address}", _numbers(log.start[address]), False


def _changes(log: ControlLog) -> Iterator[_Event]:
    for i, change in log.changes:
        for stream, content in _change_contents(change):
            yield i, stream, content, False


def _change_contents(change: Change) -> Iterator[tuple[str, Sequence[float] | str]]:
    if change.kind == ChangeKind.SWITCH:
        yield "switches", _positions_text(change.values)
    elif change.kind == ChangeKind.WRITE:
        for address, value in change.values.items():
            yield f"variable/{address}", _numbers(value)
    elif change.kind == ChangeKind.RESET:
        yield "reset", "the guards were reset"
    elif change.kind == ChangeKind.RESULT:
        for path, result in change.values.items():
            missing = " is missing" if len(result) == 1 else ""
            yield f"result/{path}", f"the result of tick {int(result['tick'])}{missing}"


def _positions_text(positions: Mapping[str, str]) -> str:
    return ", ".join(f"{name}: {position}" for name, position in positions.items())


def _numbers(value: object) -> list[float]:
    return [float(entry) for entry in np.ravel(np.asarray(value, dtype=float))]


def _faults(log: ControlLog) -> Iterator[_Event]:
    for i, reasons in log.faults:
        yield i, "faults", "; ".join(reasons) or "no fault any more", bool(reasons)
