"""A study on disk: one SQLite file with a write-ahead log, to which every finished rollout is written at once.

Every row has a checksum. A file that was changed by anything but a study is damaged, and nothing is read from it.
"""

from __future__ import annotations

import fcntl
import json
import os
import sqlite3
import threading
import time
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from itertools import chain
from math import isnan, nan
from pathlib import Path
from typing import Any

from vtbdrake.optimization.records import DrivenTrial, Intervention, Outcome, RolloutKey, Trial
from vtbdrake.optimization.solvers.solver import Point
from vtbdrake.optimization.write_ahead_log import lost_writes
from vtbdrake.rollout.course import Course
from vtbdrake.rollout.task import QUALITY_FAILED

VERSION = 3
_APPLICATION = 0x56544253  # "VTBS"

# Each table also has a last column, ``checksum``.
_TABLES = {
    "meta": "key TEXT PRIMARY KEY, value TEXT",
    # A rollout is stored once, even if several points ask for it.
    "rollouts": "point TEXT, condition INTEGER, h REAL, value REAL, measures TEXT, t_star REAL, end TEXT, "
    "message TEXT, wall_time REAL, finished TEXT",
    # Trials at positions below meta's ``first_position`` (0 if missing) were made by an earlier solver.
    "trials": "batch INTEGER, position INTEGER, point TEXT, trial_values TEXT, violations TEXT, exact INTEGER, "
    "origin TEXT, method TEXT",
    "gradients": "point TEXT PRIMARY KEY, gradient TEXT",
    # What people change; ``batch`` is NULL while a change waits for the batch on which it has an effect.
    "interventions": "number INTEGER PRIMARY KEY, time TEXT, name TEXT, kind TEXT, payload TEXT, batch INTEGER",
    # Rollouts that somebody has driven, beside those of the points.
    "drives": "number INTEGER PRIMARY KEY, time TEXT, name TEXT, parameters TEXT, outcome TEXT, course TEXT",
    "sessions": "number INTEGER PRIMARY KEY, started TEXT, ended TEXT, reason TEXT, versions TEXT, revision TEXT",
    # The user's attributes of a point, or of the study if the point is empty.
    "attributes": "point TEXT, key TEXT, value TEXT",
}
_KEYS = {"rollouts": "point, condition", "trials": "batch, position", "attributes": "point, key"}
# The pages of the write-ahead log before they are written to the file, where every row is checked.
_LOG_PAGES = 200
_PROGRESS = {"told", "first_position", "rollouts_before"}
_ABOUT = {"problem", "solver", "seed", "options", "versions", "revision", "units", "limits"}


class StudyError(ValueError):
    """A file is no study, is damaged, belongs to another version or problem, or cannot be used."""


@dataclass(frozen=True)
class Mark:
    """How far a table was read: its last row, by number and checksum, and how many rows there are up to that one."""

    row: int = 0
    checksum: int = 0
    count: int = 0


class StudyFile:
    """The file of one study. Several processes may have it open; one of them may run the study.

    An existing file can also be read in a read-only folder, as long as no other process runs the study.

    Args:
        path: Path of the file; None keeps the study in memory.
        meta: Description of a new study, see `meta`; None opens an existing one.

    Raises:
        StudyError: The file does not exist, is damaged, or is of another version.
    """

    def __init__(self, path: str | os.PathLike[str] | None, *, meta: Mapping[str, Any] | None = None) -> None:
        self.path = None if path is None else Path(path)
        self._lock = threading.RLock()
        new = meta is not None
        if self.path is not None and not self.path.exists():
            if not new:
                raise StudyError(f"there is no study file {self.path}")
            if not self.path.parent.is_dir():
                raise StudyError(f"{self.path} lies in a folder that does not exist")
        if self.path is not None:
            _refuse_lost_writes(self.path)
        with _explained(self.path):
            # Commits are explicit; the lock of this object keeps threads apart.
            self._db = sqlite3.connect(
                _sqlite_name(self.path, new=new), uri=True, timeout=30.0, isolation_level=None, check_same_thread=False
            )
        try:
            with _explained(self.path):
                self._refuse_others(new=new)
                if not self._is_empty():
                    self._refuse_damage()
                # A killed process loses nothing that was committed; a power failure may lose the last rollouts.
                self._db.execute("PRAGMA synchronous = NORMAL")
                self._db.execute(f"PRAGMA wal_autocheckpoint = {_LOG_PAGES}")
                if meta is not None and self._is_empty():
                    self._create(meta)
            self._addresses = [parameter["address"] for parameter in self.meta["problem"]["parameters"]]
        except BaseException:
            self._db.close()
            raise
        self._db.row_factory = sqlite3.Row

    def _is_empty(self) -> bool:
        (tables,) = self._db.execute("SELECT count(*) FROM sqlite_master").fetchone()
        return bool(tables == 0)

    def _refuse_others(self, *, new: bool) -> None:
        """Refuse a file of another kind or version. It only reads, so that a file of others stays unchanged."""
        (application,) = self._db.execute("PRAGMA application_id").fetchone()
        (version,) = self._db.execute("PRAGMA user_version").fetchone()
        if application == 0 and self._is_empty():
            if not new:
                raise StudyError(f"{self.path} is not a study: it is empty")
            return
        if application != _APPLICATION:
            raise StudyError(f"{self.path} is not a study: it is an SQLite file of another kind")
        if version != VERSION:
            raise StudyError(
                f"{self.path} is a study of version {version}, but this vtbdrake reads version {VERSION}: open it with "
                "the vtbdrake that wrote it"
            )

    def _refuse_damage(self) -> None:
        (verdict,) = self._db.execute("PRAGMA integrity_check(1)").fetchone()
        if verdict != "ok":
            raise _damaged(self.path, verdict)
        for table in _TABLES:
            made = self._db.execute("SELECT sql FROM sqlite_master WHERE name = ?", (table,)).fetchone()
            if made is None or made[0] != _creation(table):
                raise _damaged(self.path, f"the table {table} has other columns")
            self._rows(table)
        missing = sorted(_ABOUT - self.meta.keys())
        if missing:
            raise _damaged(self.path, f"it lacks the entries {', '.join(missing)}")

    def _create(self, meta: Mapping[str, Any]) -> None:
        self._db.execute("PRAGMA journal_mode = WAL")
        with self._transaction():
            if not self._is_empty():
                return  # Another process has created it meanwhile.
            for table in _TABLES:
                self._db.execute(_creation(table))
            # The process that runs the study asks before every batch what waits.
            self._db.execute("CREATE INDEX batches ON interventions (batch)")
            self._set(meta)
            self._db.execute(f"PRAGMA application_id = {_APPLICATION}")
            self._db.execute(f"PRAGMA user_version = {VERSION}")
        self._empty_log()

    def _empty_log(self) -> None:
        """Write the log into the file; nothing happens while another process uses the log."""
        with self._lock, _explained(self.path):
            self._db.execute("PRAGMA wal_checkpoint(TRUNCATE)")

    @contextmanager
    def _transaction(self) -> Iterator[None]:
        with self._lock, _explained(self.path):
            self._db.execute("BEGIN IMMEDIATE")
            try:
                yield
            except BaseException:
                if self._db.in_transaction:  # On a full disk SQLite has already ended it.
                    self._db.execute("ROLLBACK")
                raise
            self._db.execute("COMMIT")

    def _insert(self, table: str, rows: Iterable[tuple[Any, ...]], *, instead: str = "ABORT") -> None:
        """Add rows with their checksums; ``instead`` is what SQLite does if there is a row of the same key."""
        sealed = [(*row, _checksum(table, row)) for row in rows]
        if sealed:
            marks = ", ".join("?" * len(sealed[0]))
            self._db.executemany(f"INSERT OR {instead} INTO {table} VALUES ({marks})", sealed)

    def _rows(self, table: str, more: str = "", values: Sequence[Any] = ()) -> list[sqlite3.Row]:
        """Return checked rows of a table; ``more`` says which, and in which order."""
        with self._lock, _explained(self.path):
            rows = self._db.execute(f"SELECT * FROM {table} {more}", values).fetchall()
        for *row, checksum in rows:
            if checksum != _checksum(table, row):
                raise _damaged(self.path, f"a row of {table} has changed")
        return rows

    def _number(self, query: str, values: Sequence[Any] = ()) -> int:
        """Return the single number that a query finds."""
        with self._lock, _explained(self.path):
            (number,) = self._db.execute(query, values).fetchone()
        return int(number)

    def close(self) -> None:
        """Close the file."""
        with self._lock:
            self._db.close()

    @contextmanager
    def running(self, *, versions: Mapping[str, str], revision: str) -> Iterator[list[str]]:
        """Claim the file for this process, which runs the study.

        Yields:
            A list, to which the reason why the run ended is appended.

        Raises:
            StudyError: Another process has claimed it.
        """
        with _claim(self.path):
            with self._transaction():
                begun = (self._number("SELECT coalesce(max(number), 0) + 1 FROM sessions"), _now())
                about = (json.dumps(dict(versions)), revision)
                self._insert("sessions", [(*begun, None, None, *about)])
            reason: list[str] = []
            try:
                yield reason
            except BaseException as error:
                reason.append(type(error).__name__)
                raise
            finally:
                with self._transaction():
                    self._insert("sessions", [(*begun, _now(), "; ".join(reason), *about)], instead="REPLACE")
                self._empty_log()

    # -- contents

    @property
    def meta(self) -> dict[str, Any]:
        """Return the description of the study by name: the problem, the solver, the seed and so on."""
        return {key: json.loads(value) for key, value, _ in self._rows("meta")}

    @property
    def description(self) -> dict[str, Any]:
        """Return the description without the progress, for another file."""
        return {key: value for key, value in self.meta.items() if key not in _PROGRESS}

    def _set(self, values: Mapping[str, Any]) -> None:
        self._insert("meta", [(key, json.dumps(value)) for key, value in values.items()], instead="REPLACE")

    def _get(self, key: str, default: int) -> int:
        rows = self._rows("meta", "WHERE key = ?", (key,))
        return int(json.loads(rows[0]["value"])) if rows else default

    def sessions(self) -> list[dict[str, Any]]:
        """Return every run: started, ended and reason (None if it was killed), versions and git revision."""
        rows = [dict(row) for row in self._rows("sessions", "ORDER BY number")]
        return [{**row, "versions": json.loads(row["versions"])} for row in rows]

    def add(self, point: Point, condition: int, outcome: Outcome) -> None:
        """Record a finished rollout, whole or not at all; an existing one stays."""
        row = (
            encode(point),
            condition,
            _real(outcome.h),
            _real(outcome.value),
            json.dumps(outcome.measures),
            _real(outcome.t_star),
            outcome.end,
            outcome.message,
            _real(outcome.wall_time),
            _now(),
        )
        # One statement is a transaction by itself.
        with self._lock, _explained(self.path):
            self._insert("rollouts", [row], instead="IGNORE")

    def outcomes(self) -> dict[RolloutKey, Outcome]:
        """Return all finished rollouts by (point, number of the condition)."""
        return dict(_outcomes(self._rows("rollouts", "ORDER BY rowid")))

    def outcomes_of(self, points: Sequence[Point]) -> dict[RolloutKey, Outcome]:
        """Return the finished rollouts of points."""
        rows = [self._rows("rollouts", "WHERE point = ? ORDER BY condition", (encode(point),)) for point in points]
        return dict(_outcomes(chain.from_iterable(rows)))

    def finished(self) -> dict[RolloutKey, datetime]:
        """Return when each rollout was finished, in UTC."""
        rows = self._rows("rollouts")
        return {(decode(row["point"]), row["condition"]): datetime.fromisoformat(row["finished"]) for row in rows}

    def count(self) -> int:
        """Return the number of finished rollouts."""
        return self._number("SELECT count(*) FROM rollouts")

    def completed_batches(self) -> int:
        """Return the number of batches whose evaluations the solver was told."""
        return self._get("told", 0)

    def batches(self) -> int:
        """Return the number of batches of the present solver that have trials."""
        query = "SELECT coalesce(max(batch) + 1, 0) FROM trials WHERE position >= ?"
        return max(self.completed_batches(), self._number(query, (self._get("first_position", 0),)))

    def rollouts_before(self) -> int:
        """Return the number of rollouts that were finished before the present solver began."""
        return self._get("rollouts_before", 0)

    def save_trials(self, batch: int, trials: Mapping[int, Trial], *, complete: bool) -> None:
        """Record trials of a batch, by their positions in it.

        Args:
            batch: The number of the batch.
            trials: Position -> trial.
            complete: Whether the solver was told the evaluations of the batch. Then the trials replace those of the
                batch that an interrupted run has recorded.
        """
        with self._transaction():
            first = self._get("first_position", 0)
            if complete:
                self._db.execute("DELETE FROM trials WHERE batch = ? AND position >= ?", (batch, first))
                self._set({"told": batch + 1})
            rows = [
                (
                    batch,
                    first + position,
                    encode(trial.point),
                    json.dumps(trial.values),
                    json.dumps(trial.violations),
                    int(trial.exact),
                    trial.origin,
                    trial.method,
                )
                for position, trial in trials.items()
            ]
            self._insert("trials", rows, instead="REPLACE")

    def begin_anew(self, *, budget: int | None, racing: bool) -> None:
        """Prepare the file for a new solver, with another budget or racing; the trials so far stay."""
        with self._transaction():
            self._withdraw()
            self._set({"budget": budget, "racing": racing})

    def _withdraw(self) -> None:
        """Mark all trials as those of an earlier solver."""
        after = self._number("SELECT coalesce(max(position) + 1, 0) FROM trials")
        first = max(after, self._get("first_position", 0))
        self._set({"told": 0, "first_position": first, "rollouts_before": self.count()})

    def change_code(
        self, problem: Mapping[str, Any], parts: Sequence[str], *, versions: Mapping[str, str], revision: str
    ) -> None:
        """Note that the code of the problem has changed, and forget the rollouts in which a quality function failed.

        Raises:
            StudyError: Another process runs the study.
        """
        with _claim(self.path), self._transaction():
            failed = {row["point"] for row in self._rows("rollouts") if row["message"].startswith(QUALITY_FAILED)}
            self._db.execute("DELETE FROM gradients")
            self._db.executemany("DELETE FROM trials WHERE point = ?", [(point,) for point in failed])
            self._db.execute(
                "DELETE FROM rollouts WHERE substr(message, 1, ?) = ?", (len(QUALITY_FAILED), QUALITY_FAILED)
            )
            self._withdraw()
            change = {"at": _now(), "what": list(parts), "versions": dict(versions), "revision": revision}
            self._set({"problem": problem, "changes": [*self.meta.get("changes", []), change]})

    def add_conditions(self, problem: Mapping[str, Any]) -> None:
        """Note that the problem has further conditions, and forget the trials, whose values were those of fewer.

        Raises:
            StudyError: Another process runs the study.
        """
        with _claim(self.path), self._transaction():
            self._withdraw()
            for table in ("trials", "gradients"):
                self._db.execute(f"DELETE FROM {table}")
            self._set({"problem": problem})

    def trials(self) -> list[Trial]:
        """Return all trials in the order of the study."""
        return self._trials(self._rows("trials", "ORDER BY batch, position"), first=0)

    # -- what is new, for those who watch

    def version(self) -> tuple[int, int]:
        """Return two numbers that differ after any change of the file, by this process or another."""
        return self._number("PRAGMA data_version"), self._db.total_changes

    @property
    def is_running(self) -> bool:
        """Return whether a process runs the study; of a study in memory, whether its last run has not ended."""
        if self.path is not None:
            return _is_claimed(self.path)
        sessions = self.sessions()
        return bool(sessions) and sessions[-1]["ended"] is None

    def trials_since(self, mark: Mark) -> tuple[int, list[Trial], Mark]:
        """Return what has changed since a mark: how many trials stay, the trials behind them, and the next mark.

        Trials are in the order in which they were recorded. Those of a batch that an interrupted run has left are
        returned each time, as they will be recorded again.
        """
        mark, rows, numbers = self._rows_since("trials", mark)
        first, complete = self._get("first_position", 0), self.completed_batches()
        final = [row["position"] < first or row["batch"] < complete for row in rows]
        settled = final.index(False) if False in final else len(final)
        after = _mark(numbers[settled - 1], rows[settled - 1], mark.count + settled) if settled else mark
        return mark.count, self._trials(rows, first=mark.count), after

    def outcomes_since(self, mark: Mark) -> tuple[int, list[tuple[RolloutKey, Outcome, datetime]], Mark]:
        """Return what has changed since a mark: how many rollouts stay, those behind them, and the next mark."""
        mark, rows, numbers = self._rows_since("rollouts", mark)
        after = _mark(numbers[-1], rows[-1], mark.count + len(rows)) if rows else mark
        times = [datetime.fromisoformat(row["finished"]) for row in rows]
        keyed = ((*pair, time) for pair, time in zip(_outcomes(rows), times, strict=True))
        return mark.count, list(keyed), after

    def _rows_since(self, table: str, mark: Mark) -> tuple[Mark, list[sqlite3.Row], list[int]]:
        """Return rows behind a mark with their numbers; if rows before it are gone, all, with the mark of none."""
        read = self._number(f"SELECT count(*) FROM {table} WHERE rowid <= ?", (mark.row,))
        # SQLite gives the numbers of rows that are gone to new ones.
        checksum = self._number(f"SELECT coalesce(max(checksum), 0) FROM {table} WHERE rowid = ?", (mark.row,))
        if (checksum, read) != (mark.checksum, mark.count):
            mark = Mark()
        # Rows that are added meanwhile come next time.
        last = self._number(f"SELECT coalesce(max(rowid), 0) FROM {table}")
        which = "WHERE rowid > ? AND rowid <= ? ORDER BY rowid", (mark.row, last)
        with self._lock, _explained(self.path):
            numbers = [number for (number,) in self._db.execute(f"SELECT rowid FROM {table} {which[0]}", which[1])]
        return mark, self._rows(table, *which), numbers

    def earlier_trials(self) -> list[Trial]:
        """Return the trials of earlier solvers, which were made for another budget or another code."""
        first = self._get("first_position", 0)
        return self._trials(self._rows("trials", "WHERE position < ? ORDER BY batch, position", (first,)), first=0)

    def trials_of(self, batch: int) -> list[Trial]:
        """Return the trials of a batch that the present solver asked for."""
        first = self._get("first_position", 0)
        rows = self._rows("trials", "WHERE batch = ? AND position >= ? ORDER BY position", (batch, first))
        query = "SELECT count(*) FROM trials WHERE batch < ? OR (batch = ? AND position < ?)"
        return self._trials(rows, first=self._number(query, (batch, batch, first)))

    def _trials(self, rows: Sequence[sqlite3.Row], *, first: int) -> list[Trial]:
        """Return trials, the first of which has the number ``first``."""
        attributes = self.attributes()
        points = [decode(row["point"]) for row in rows]
        return [
            Trial(
                parameters=self._by_address(point),
                values=tuple(json.loads(row["trial_values"])),
                violations=tuple(json.loads(row["violations"])),
                exact=bool(row["exact"]),
                origin=row["origin"],
                method=row["method"],
                batch=row["batch"],
                number=number,
                attributes=dict(attributes.get(point, {})),
            )
            for number, (point, row) in enumerate(zip(points, rows, strict=True), first)
        ]

    def _by_address(self, point: Point) -> dict[str, Any]:
        return dict(zip(self._addresses, point, strict=True))

    def add_gradient(self, point: Point, gradient: Sequence[float]) -> None:
        """Record the gradient at a point."""
        with self._transaction():
            self._insert("gradients", [(encode(point), json.dumps(list(gradient)))], instead="IGNORE")

    def gradients(self) -> dict[Point, tuple[float, ...]]:
        """Return all gradients by point."""
        return {decode(point): tuple(json.loads(gradient)) for point, gradient, _ in self._rows("gradients")}

    # -- rollouts that were driven

    def add_drive(self, parameters: Mapping[str, Any], outcome: Outcome, course: Course, *, name: str) -> DrivenTrial:
        """Record a rollout that was driven."""
        with self._transaction():
            number = self._number("SELECT coalesce(max(number), 0) + 1 FROM drives")
            drive = DrivenTrial(number, datetime.now(UTC), name, parameters, outcome, course)
            texts = [json.dumps(part) for part in (parameters, asdict(outcome), course.to_dict())]
            self._insert("drives", [(number, drive.time.isoformat(), name, *texts)])
        return drive

    def drives(self, *, after: int = 0) -> list[DrivenTrial]:
        """Return the rollouts that were driven, in their order, behind one of a number."""
        return [
            DrivenTrial(
                row["number"],
                datetime.fromisoformat(row["time"]),
                row["name"],
                json.loads(row["parameters"]),
                _outcome_of(json.loads(row["outcome"])),
                Course.from_dict(json.loads(row["course"])),
            )
            for row in self._rows("drives", "WHERE number > ? ORDER BY number", (after,))
        ]

    # -- interventions

    def intervene(
        self,
        kind: str,
        payloads: Sequence[Mapping[str, Any]],
        *,
        name: str,
        check: Callable[[Sequence[Intervention]], None],
    ) -> list[Intervention]:
        """Record interventions of a kind, all or none.

        Args:
            kind: Their kind.
            payloads: The arguments of each.
            name: Who makes them.
            check: Called with all interventions of the study and the new ones behind them; an exception records
                nothing.
        """
        with self._transaction():
            rows = self.interventions()
            first, now = 1 + max((row.number for row in rows), default=0), datetime.fromisoformat(_now())
            new = [Intervention(first + k, now, name, kind, payload) for k, payload in enumerate(payloads)]
            check([*rows, *new])
            self._insert("interventions", [_row(intervention) for intervention in new])
        return new

    def copy_interventions(self, interventions: Sequence[Intervention]) -> None:
        """Record interventions of another file as they are."""
        with self._transaction():
            self._insert("interventions", [_row(intervention) for intervention in interventions])

    def interventions(self, *, waiting: bool = False) -> list[Intervention]:
        """Return all interventions, or only those that wait for a batch, in their order."""
        return [
            Intervention(number, datetime.fromisoformat(time), name, kind, json.loads(payload), batch)
            for number, time, name, kind, payload, batch, _ in self._rows(
                "interventions", f"{'WHERE batch IS NULL ' if waiting else ''}ORDER BY number"
            )
        ]

    def begin(self, interventions: Sequence[Intervention], *, batch: int) -> list[Intervention]:
        """Record that interventions have an effect on a batch and on those after it; return those that still waited."""
        with self._transaction():
            waiting = {intervention.number for intervention in self.interventions(waiting=True)}
            begun = [replace(i, batch=batch) for i in interventions if i.number in waiting]
            self._insert("interventions", [_row(intervention) for intervention in begun], instead="REPLACE")
        return begun

    def change_waiting(
        self,
        number: int,
        payload: Mapping[str, Any] | None,
        *,
        kind: str | None = None,
        check: Callable[[Sequence[Intervention]], None],
    ) -> None:
        """Replace the payload of an intervention that waits, or remove it if ``payload`` is None.

        Args:
            number: Its number.
            payload: Its new arguments.
            kind: The kind that it must have; None: any.
            check: As in `intervene`.

        Raises:
            StudyError: No intervention of that number and kind waits.
        """
        with self._transaction():
            rows = {intervention.number: intervention for intervention in self.interventions()}
            waiting = [n for n, row in rows.items() if row.batch is None and kind in (None, row.kind)]
            if number not in waiting:
                raise StudyError(
                    f"no intervention {number}{f' of the kind {kind}' if kind else ''} waits in "
                    f"{self.path or 'the study'}; those that wait are: {', '.join(map(str, waiting)) or 'none'}"
                )
            intervention = rows.pop(number)
            self._db.execute("DELETE FROM interventions WHERE number = ?", (number,))
            if payload is not None:
                rows[number] = replace(intervention, payload=payload)
                self._insert("interventions", [_row(rows[number])])
            check([rows[key] for key in sorted(rows)])

    # -- attributes

    def set_attribute(self, point: Point | None, key: str, value: Any) -> None:
        """Set an attribute of a point, or of the study if ``point`` is None."""
        with self._transaction():
            row = ("" if point is None else encode(point), key, json.dumps(value))
            self._insert("attributes", [row], instead="REPLACE")

    def attributes(self) -> dict[Point | None, dict[str, Any]]:
        """Return all attributes by point; those of the study under None."""
        by_point: dict[Point | None, dict[str, Any]] = {}
        for point, key, value, _ in self._rows("attributes", "ORDER BY rowid"):
            by_point.setdefault(decode(point) if point else None, {})[key] = json.loads(value)
        return by_point


def _creation(table: str) -> str:
    """Return the statement that makes a table."""
    key = f", PRIMARY KEY ({_KEYS[table]})" if table in _KEYS else ""
    return f"CREATE TABLE {table} ({_TABLES[table]}, checksum INTEGER{key})"


def _mark(number: int, row: sqlite3.Row, count: int) -> Mark:
    return Mark(number, row["checksum"], count)


def _outcomes(rows: Iterable[sqlite3.Row]) -> Iterator[tuple[RolloutKey, Outcome]]:
    for point, condition, h, value, measures, t_star, end, message, wall_time, *_ in rows:
        yield (
            (decode(point), condition),
            Outcome(
                _float(h), _float(value), tuple(json.loads(measures)), _float(t_star), end, message, _float(wall_time)
            ),
        )


def _row(intervention: Intervention) -> tuple[Any, ...]:
    return (
        intervention.number,
        intervention.time.isoformat(timespec="milliseconds"),
        intervention.name,
        intervention.kind,
        json.dumps(dict(intervention.payload)),
        intervention.batch,
    )


def _checksum(table: str, row: Sequence[Any]) -> int:
    return zlib.crc32(repr((table, *row)).encode())


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="milliseconds")


def encode(point: Point) -> str:
    """Return a point as text, from which `decode` restores the same numbers exactly."""
    return json.dumps(list(point))


def decode(text: str) -> Point:
    """Return the point of a text, the inverse of `encode`."""
    return tuple(json.loads(text))


def _real(value: float) -> float | None:
    # SQLite has no NaN.
    return None if isnan(value) else float(value)


def _float(value: float | None) -> float:
    """Return a number of SQLite as a float, the inverse of `_real`."""
    return nan if value is None else value


def _sqlite_name(path: Path | None, *, new: bool) -> str:
    """Return the name for ``sqlite3.connect(..., uri=True)``; None is a database in memory."""
    if path is None:
        return ":memory:"
    path = path.absolute()
    beside = (path.with_name(path.name + end) for end in ("-wal", "-journal"))
    unfinished = any(log.exists() and log.stat().st_size > 0 for log in beside)
    if new or unfinished or os.access(path.parent, os.W_OK, effective_ids=True):
        return str(path)
    # With a write-ahead log, SQLite creates files even to read, unless the database is declared immutable.
    return f"{path.as_uri()}?immutable=1"


@contextmanager
def _claim(path: Path | None) -> Iterator[None]:
    """Hold the lock of a study; the system releases it when the process dies.

    The lock is a separate file: closing any handle of the study itself would release SQLite's locks on it.
    """
    if path is None:
        yield
        return
    lock = path.with_name(path.name + "-lock")
    while True:
        try:
            handle = os.open(lock, os.O_CREAT | os.O_RDWR)
        except OSError as error:
            raise StudyError(f"the study {path} cannot be run, as its lock cannot be created: {error}") from error
        try:
            _lock_exclusively(handle)
        except BlockingIOError as error:
            os.close(handle)
            raise StudyError(
                f"the study {path} is being run by another process: wait for it, or give points to it with `add`"
            ) from error
        try:
            if os.path.samestat(os.fstat(handle), os.stat(lock)):
                break
        except FileNotFoundError:
            pass
        os.close(handle)  # Its former owner has removed the file meanwhile.
    try:
        yield
    finally:
        lock.unlink(missing_ok=True)
        os.close(handle)


def _lock_exclusively(handle: int) -> None:
    """Take the lock, which a process that asks `_is_claimed` holds for some microseconds."""
    for _ in range(10):
        with suppress(BlockingIOError):
            return fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        time.sleep(0.005)
    fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)


def _is_claimed(path: Path) -> bool:
    """Return whether a process runs the study."""
    try:
        with open(path.with_name(path.name + "-lock")) as lock:
            fcntl.flock(lock, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except FileNotFoundError:
        return False
    except OSError:
        return True
    return False


def _refuse_lost_writes(path: Path) -> None:
    """Refuse a file in whose write-ahead log damage would hide the last writes.

    Raises:
        StudyError: There is such damage.
    """
    if _is_claimed(path):  # It is being written.
        return
    with _explained(path):
        lost = lost_writes(path)
        if lost is not None:
            time.sleep(0.05)  # A process that adds points may be about to complete a frame.
            lost = lost_writes(path)
    if lost is not None:
        log = f"{path}-wal"
        raise StudyError(
            f"the write-ahead log {log} is damaged after {lost.readable} bytes, which hides {lost.frames} pages that "
            f"were written later; it was left unchanged: restore both files from a copy, or cut the log (truncate "
            f"-s {lost.readable} {log}) to go on without these writes: their rollouts run again"
        )


def _damaged(path: Path | None, reason: object) -> StudyError:
    return StudyError(f"{path} cannot be read ({reason}); it was left unchanged: restore it from a copy")


@contextmanager
def _explained(path: Path | None) -> Iterator[None]:
    """Raise the errors of SQLite as `StudyError`."""
    try:
        yield
    except sqlite3.ProgrammingError as error:
        raise StudyError(f"the study {path} is closed ({error}): open it again") from error
    except sqlite3.OperationalError as error:
        # SQL that SQLite does not understand, or text that it cannot decode, is a sign of damage.
        if getattr(error, "sqlite_errorcode", sqlite3.SQLITE_ERROR) == sqlite3.SQLITE_ERROR:
            raise _damaged(path, error) from error
        raise StudyError(
            f"{path} cannot be used ({error}); what was recorded is kept: check the free space of its disk, and the "
            "permissions of the file and its folder"
        ) from error
    except (sqlite3.DatabaseError, UnicodeDecodeError) as error:
        raise _damaged(path, error) from error


def _outcome_of(fields: dict[str, Any]) -> Outcome:
    return Outcome(**{**fields, "measures": tuple(fields["measures"])})
