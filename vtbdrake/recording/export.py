"""Export of logs to CSV, Parquet and MCAP."""

from __future__ import annotations

import csv
import json
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import cache
from heapq import merge
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np

from vtbdrake.common.extras import extra_module
from vtbdrake.common.json_data import plain
from vtbdrake.control.stepping import Change, ChangeKind
from vtbdrake.recording.log import Log, Series
from vtbdrake.recording.log_reader import ControlLog
from vtbdrake.state.archive import PRIVATE, whole_file


def export(log: ControlLog | Log, path: str | os.PathLike[str], *, mode: int = PRIVATE) -> None:
    """Write a log in the format that the file's suffix names: .csv, .mcap or .parquet.

    CSV and Parquet get the table of `columns`. MCAP gets JSON messages with their schemas, for Foxglove, under the
    topics ``/sense/<signal>``, ``/command/<signal>`` (actuator commands of the DPS) and ``/sent/<signal>`` (after the
    guards), wherever they have a new value; ``/cycle``; and, when they happen, ``/switches``, ``/variable/<address>``
    (variables that were changed, the commands u among them), ``/result/<slow part>``, ``/faults`` and ``/reset`` (of
    the guards). Their times are the log's times of day; values that are not finite are null. Abstract signals are left
    out.

    Args:
        log: The log.
        path: Path of the file. It is written as a whole or not at all.
        mode: Permissions of the file, as far as the umask leaves them; by default only its owner reads it.

    Raises:
        ValueError: The suffix is none of them.
        ModuleNotFoundError: The library for the format is not installed.
    """
    suffix = Path(path).suffix
    if suffix not in EXPORTS:
        raise ValueError(f"a log is exported to a file that ends in {', '.join(EXPORTS)}, unlike {os.fspath(path)!r}")
    with whole_file(path, mode=mode) as partial:
        EXPORTS[suffix](log, partial)


def columns(log: ControlLog | Log) -> dict[str, np.ndarray]:
    """Return a log as a table of n rows, one per cycle.

    The columns are ``cycle``, ``time`` (of the DPS, s), ``now`` (on the loop's clock, s), ``utime`` (us since 1970),
    ``ok``, and the entries of all vector signals: ``sense.<signal>`` is the newest value, ``command.<signal>`` the
    actuator command of the DPS and ``sent.<signal>`` the one sent after the guards. A signal of several entries has a
    column ``sense.<signal>[i]`` for each. Missing values are NaN.

    A `Log` has a row for each time of any signal, and the columns ``time``, ``sense.<signal>`` and ``sent.<signal>``; a
    signal without a sample at that time is NaN, so that `read_table` gives the same samples.
    """
    if isinstance(log, Log):
        times = np.unique(np.concatenate([series.times for series in (*log.sense.values(), *log.act.values())]))
        return {"time": times, **_entry_columns((name, _placed(series, times)) for name, series in _sides(log))}
    sides = (("sense", log.fed), ("command", log.actuation), ("sent", log.sent))
    table = {"cycle": log.numbers, "time": log.times, "now": log.now, "utime": log.utimes, "ok": log.ok}
    return table | _entry_columns((f"{kind}.{name}", values) for kind, each in sides for name, values in each.items())


def _entry_columns(signals: Iterable[tuple[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Return a column for each entry of signals with values of shape (n, size)."""
    table = {}
    for name, values in signals:
        size = values.shape[1]
        for i in range(size):
            table[f"{name}[{i}]" if size > 1 else name] = values[:, i]
    return table


def _sides(log: Log) -> Iterator[tuple[str, Series]]:
    yield from ((f"sense.{name}", series) for name, series in log.sense.items())
    yield from ((f"sent.{name}", series) for name, series in log.act.items())


def _placed(series: Series, times: np.ndarray) -> np.ndarray:
    """Return the samples at their times among others, NaN at the latter."""
    values = np.full((len(times), series.values.shape[1]), np.nan)
    values[np.searchsorted(times, series.times)] = series.values
    return values


def _write_csv(log: ControlLog | Log, path: Path) -> None:
    """Write a CSV file whose numbers read back to the last bit."""
    table = columns(log)
    with path.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(table)
        writer.writerows(zip(*(column.tolist() for column in table.values()), strict=True))


def _write_parquet(log: ControlLog | Log, path: Path) -> None:
    pyarrow, parquet = (
        extra_module(name, purpose="Parquet", extra="recording") for name in ("pyarrow", "pyarrow.parquet")
    )
    parquet.write_table(pyarrow.table(columns(log)), path)


# -- MCAP

_NUMBERS = {"type": "array", "items": {"type": ["number", "null"]}}  # JSON has no NaN.
_TIME = {"type": "number", "description": "of the DPS, in seconds"}
# Levels of foxglove.Log.
_INFO = 2
_ERROR = 4

_SCHEMAS: Mapping[str, Mapping[str, Any]] = {
    "vtbdrake.Value": {"time": _TIME, "value": _NUMBERS},
    "vtbdrake.Cycle": {
        "time": _TIME,
        "cycle": {"type": "integer"},
        "now": {"type": "number", "description": "on the loop's clock, in seconds"},
        "since_last": {"type": ["number", "null"], "description": "cycle, in seconds"},
        "ok": {"type": "boolean", "description": "the DPS's commands were sent, not the fallbacks'"},
    },
    "vtbdrake.Switches": {"time": _TIME, "positions": {"type": "object", "additionalProperties": {"type": "string"}}},
    "vtbdrake.Result": {"time": _TIME, "tick": {"type": "integer"}, "missing": {"type": "boolean"}},
    "vtbdrake.Reset": {"time": _TIME},
    # As Foxglove's log panel expects it.
    "foxglove.Log": {
        "timestamp": {
            "type": "object",
            "title": "time",
            "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}},
        },
        "level": {"type": "integer"},
        "message": {"type": "string"},
        "name": {"type": "string"},
        "file": {"type": "string"},
        "line": {"type": "integer"},
    },
}

_Entry = tuple[int, str, str, Mapping[str, Any]]  # time in nanoseconds, topic, schema, message


def _write_mcap(log: ControlLog | Log, path: Path) -> None:
    mcap = extra_module("mcap.writer", purpose="MCAP", extra="recording")
    entries = _samples(log) if isinstance(log, Log) else _entries(log)
    with path.open("wb") as file:
        writer = mcap.Writer(file)
        writer.start(library="vtbdrake")

        @cache
        def schema(name: str) -> int:
            content = {"title": name, "type": "object", "properties": _SCHEMAS[name]}
            return int(writer.register_schema(name, "jsonschema", json.dumps(content).encode()))

        @cache
        def channel(topic: str, name: str) -> int:
            return int(writer.register_channel(topic, "json", schema(name)))

        for sequence, (time, topic, name, message) in enumerate(entries):
            data = json.dumps(message, allow_nan=False).encode()
            writer.add_message(channel(topic, name), time, data, time, sequence)
        writer.finish()


def _samples(log: Log) -> Iterator[_Entry]:
    """Yield all samples in the order of time."""
    origin = min(log.start, 0.0)  # MCAP has no negative times.

    def entries(name: str, series: Series) -> Iterator[_Entry]:
        topic = f"/{name.replace('.', '/', 1)}"
        for time, value in zip(series.times.tolist(), series.values.tolist(), strict=True):
            yield round(1e9 * (time - origin)), topic, "vtbdrake.Value", {"time": time, "value": value}

    yield from merge(*(entries(name, series) for name, series in _sides(log)), key=itemgetter(0))


def _entries(log: ControlLog) -> Iterator[_Entry]:
    """Yield all messages in the order of time."""
    times_ns = [1000 * utime for utime in log.utimes.tolist()]
    occasional: dict[int, list[_Entry]] = {}
    for i, topic, schema, message in [*_initial(log), *_changes(log), *_faults(log, times_ns)]:
        occasional.setdefault(i, []).append((times_ns[i], topic, schema, message))
    series = [(topic, _json_rows(values), present.tolist()) for topic, values, present in _series(log)]
    times = log.times.tolist()
    since_last = [None, *np.diff(log.now).tolist()]
    rows = zip(times, log.numbers.tolist(), log.now.tolist(), since_last, log.ok.tolist(), strict=False)
    for i, (ns, row) in enumerate(zip(times_ns, rows, strict=True)):
        yield from occasional.get(i, ())
        yield ns, "/cycle", "vtbdrake.Cycle", dict(zip(_SCHEMAS["vtbdrake.Cycle"], row, strict=True))
        for topic, values, present in series:
            if present[i]:
                yield ns, topic, "vtbdrake.Value", {"time": times[i], "value": values[i]}


def _series(log: ControlLog) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    for name, values in log.fed.items():
        yield f"/sense/{name}", values, log.sources[name] != 0
    for name, values in log.actuation.items():
        yield f"/command/{name}", values, log.commanded[name]
    for name, values in log.sent.items():
        yield f"/sent/{name}", values, ~np.isnan(values).all(axis=1)


def _json_rows(values: np.ndarray) -> list[list[float | None]]:
    rows: list[list[float | None]] = values.tolist()
    for i in np.flatnonzero(~np.isfinite(values).all(axis=1)):
        rows[i] = plain(values[i])
    return rows


def _initial(log: ControlLog) -> Iterator[tuple[int, str, str, Mapping[str, Any]]]:
    """Yield the initial values of switches and of variables that change later."""
    if not len(log):
        return
    time = log.start.time
    if log.header.positions:
        positions = {f"{side}.{name}": at for side, by in log.header.positions.items() for name, at in by.items()}
        yield 0, "/switches", "vtbdrake.Switches", {"time": time, "positions": positions}
    changed = {address for _, change in log.changes if change.kind == ChangeKind.WRITE for address in change.values}
    for address in sorted(changed & log.start.values.keys()):
        value = _json_rows(np.reshape(log.start[address], (1, -1)))[0]
        yield 0, f"/variable/{address}", "vtbdrake.Value", {"time": time, "value": value}


def _changes(log: ControlLog) -> Iterator[tuple[int, str, str, Mapping[str, Any]]]:
    for i, change in log.changes:
        for topic, schema, message in _change_messages(change):
            yield i, topic, schema, {"time": float(log.times[i]), **message}


def _change_messages(change: Change) -> Iterator[tuple[str, str, Mapping[str, Any]]]:
    if change.kind == ChangeKind.SWITCH:
        yield "/switches", "vtbdrake.Switches", {"positions": dict(change.values)}
    elif change.kind == ChangeKind.WRITE:
        for address, value in change.values.items():
            row = _json_rows(np.reshape(np.asarray(value, dtype=float), (1, -1)))[0]
            yield f"/variable/{address}", "vtbdrake.Value", {"value": row}
    elif change.kind == ChangeKind.RESET:
        yield "/reset", "vtbdrake.Reset", {}
    elif change.kind == ChangeKind.RESULT:
        for path, result in change.values.items():
            message = {"tick": int(result["tick"]), "missing": len(result) == 1}
            yield f"/result/{path}", "vtbdrake.Result", message


def _faults(log: ControlLog, times_ns: list[int]) -> Iterator[tuple[int, str, str, Mapping[str, Any]]]:
    for i, reasons in log.faults:
        seconds, nanoseconds = divmod(times_ns[i], 10**9)
        yield i, "/faults", "foxglove.Log", {
            "timestamp": {"sec": seconds, "nsec": nanoseconds},
            "level": _ERROR if reasons else _INFO,
            "message": "; ".join(reasons) or "no fault any more",
            "name": "guards",
            "file": "",
            "line": 0,
        }  # fmt: skip


EXPORTS: Mapping[str, Callable[[ControlLog | Log, Path], None]] = {
    ".csv": _write_csv,
    ".mcap": _write_mcap,
    ".parquet": _write_parquet,
}
"""Writers by the suffix of the file."""
