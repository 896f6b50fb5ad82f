"""Logs as MCAP files, which Foxglove opens and plots."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping
from functools import cache
from typing import Any

import numpy as np

from vtbdrake.control.cycle import RESET, RESULT, SWITCH, WRITE, Change
from vtbdrake.recording.control_log import ControlLog
from vtbdrake.state.files import whole_file

_NUMBERS = {"type": "array", "items": {"type": ["number", "null"]}}  # JSON has no NaN
_TIME = {"type": "number", "description": "of the DPS, in seconds"}
_INFO, _ERROR = 2, 4  # levels of foxglove.Log

SCHEMAS: Mapping[str, Mapping[str, Any]] = {
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
    # As Foxglove's panel for logs expects it.
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
"""The fields of the messages, by the names of their schemas."""

# Time in nanoseconds, topic, schema, message.
_Entry = tuple[int, str, str, Mapping[str, Any]]


def export_mcap(log: ControlLog, path: str | os.PathLike[str]) -> None:
    """Writes a log as JSON messages with their schemas.

    Topics: ``/sense/<signal>``, ``/command/<signal>`` (what the DPS commanded) and ``/sent/<signal>`` (after the
    guards), wherever they have a new value; ``/cycle``; and what happens now and then, ``/switches``,
    ``/variable/<address>`` (of those that were changed, the commands u among them), ``/result/<slow part>``,
    ``/faults`` and ``/reset`` (of the guards). Their times are the log's times of day; what is not finite is null.
    Abstract signals are left out.

    Raises:
        ModuleNotFoundError: mcap is not installed.
    """
    try:
        from mcap.writer import Writer
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError("MCAP needs mcap: pip install 'vtbdrake[recording]'") from error
    with whole_file(path) as partial, partial.open("wb") as file:
        writer = Writer(file)
        writer.start(library="vtbdrake")

        @cache
        def schema(name: str) -> int:
            content = {"title": name, "type": "object", "properties": SCHEMAS[name]}
            return int(writer.register_schema(name, "jsonschema", json.dumps(content).encode()))

        @cache
        def channel(topic: str, name: str) -> int:
            return int(writer.register_channel(topic, "json", schema(name)))

        for sequence, (time, topic, name, message) in enumerate(_entries(log)):
            data = json.dumps(message, allow_nan=False).encode()
            writer.add_message(channel(topic, name), time, data, time, sequence)
        writer.finish()


def _entries(log: ControlLog) -> Iterator[_Entry]:
    """All messages, in the order of time."""
    occasional: dict[int, list[_Entry]] = {}
    for i, entry in [*_beginning(log), *_occasions(log)]:
        occasional.setdefault(i, []).append(entry)
    series = [(topic, _plain(values), there.tolist(), log.times.tolist()) for topic, values, there in _series(log)]
    since = [None, *np.diff(log.now).tolist()]
    rows = zip(log.times.tolist(), log.numbers.tolist(), log.now.tolist(), since, log.ok.tolist(), strict=False)
    for i, (ns, row) in enumerate(zip(_nanoseconds(log), rows, strict=True)):
        yield from occasional.get(i, ())
        yield ns, "/cycle", "vtbdrake.Cycle", dict(zip(SCHEMAS["vtbdrake.Cycle"], row, strict=True))
        for topic, values, there, times in series:
            if there[i]:
                yield ns, topic, "vtbdrake.Value", {"time": times[i], "value": values[i]}


def _nanoseconds(log: ControlLog) -> list[int]:
    return [1000 * utime for utime in log.utimes.tolist()]


def _series(log: ControlLog) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    for name, values in log.fed.items():
        yield f"/sense/{name}", values, log.sources[name] != 0
    for name, values in log.commands.items():
        yield f"/command/{name}", values, log.commanded[name]
    for name, values in log.sent.items():
        yield f"/sent/{name}", values, ~np.isnan(values).all(axis=1)


def _plain(values: np.ndarray) -> list[list[float | None]]:
    rows: list[list[float | None]] = values.tolist()
    for i in np.flatnonzero(~np.isfinite(values).all(axis=1)):
        rows[i] = [entry if np.isfinite(entry) else None for entry in values[i].tolist()]
    return rows


def _beginning(log: ControlLog) -> Iterator[tuple[int, _Entry]]:
    """What held before the first cycle of what changes later."""
    if not len(log):
        return
    ns, time = _nanoseconds(log)[0], log.start.time
    if log.header.positions:
        positions = {f"{side}.{name}": at for side, by in log.header.positions.items() for name, at in by.items()}
        yield 0, (ns, "/switches", "vtbdrake.Switches", {"time": time, "positions": positions})
    changed = {address for _, change in log.changes if change.kind == WRITE for address in change.values}
    for address in sorted(changed & log.start.values.keys()):
        value = _plain(np.reshape(log.start[address], (1, -1)))[0]
        yield 0, (ns, f"/variable/{address}", "vtbdrake.Value", {"time": time, "value": value})


def _occasions(log: ControlLog) -> Iterator[tuple[int, _Entry]]:
    times = _nanoseconds(log)
    for i, change in log.changes:
        for topic, schema, message in _told(change):
            yield i, (times[i], topic, schema, {"time": float(log.times[i]), **message})
    for i, reasons in log.faults:
        seconds, nanoseconds = divmod(times[i], 10**9)
        message = {
            "timestamp": {"sec": seconds, "nsec": nanoseconds},
            "level": _ERROR if reasons else _INFO,
            "message": "; ".join(reasons) or "nothing is wrong any more",
            "name": "guards",
            "file": "",
            "line": 0,
        }
        yield i, (times[i], "/faults", "foxglove.Log", message)


def _told(change: Change) -> Iterator[tuple[str, str, Mapping[str, Any]]]:
    if change.kind == SWITCH:
        yield "/switches", "vtbdrake.Switches", {"positions": dict(change.values)}
    elif change.kind == WRITE:
        for address, value in change.values.items():
            row = _plain(np.reshape(np.asarray(value, dtype=float), (1, -1)))[0]
            yield f"/variable/{address}", "vtbdrake.Value", {"value": row}
    elif change.kind == RESET:
        yield "/reset", "vtbdrake.Reset", {}
    elif change.kind == RESULT:
        for path, result in change.values.items():
            message = {"tick": int(result["tick"]), "missing": len(result) == 1}
            yield f"/result/{path}", "vtbdrake.Result", message
