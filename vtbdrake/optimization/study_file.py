"""A study on disk: one SQLite file with a write-ahead log, into which every finished rollout goes at once."""

from __future__ import annotations

import json
import os
import sqlite3
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import Any

from vtbdrake.optimization.outcome import Outcome
from vtbdrake.optimization.solvers.solver import Point
from vtbdrake.optimization.study_error import StudyError, damaged, explained
from vtbdrake.optimization.study_lock import claim
from vtbdrake.optimization.study_name import sqlite_name

VERSION = 1
_APPLICATION = 0x56544253  # "VTBS"

_TABLES = (
    "CREATE TABLE meta (key TEXT PRIMARY KEY, value TEXT NOT NULL)",
    # A rollout is there once, whatever asked for it, and how often.
    "CREATE TABLE rollouts (point TEXT, condition INTEGER, h REAL, value REAL, measures TEXT, t_star REAL, end TEXT, "
    "message TEXT, wall_time REAL, finished TEXT DEFAULT (strftime('%Y-%m-%dT%H:%M:%fZ')), "
    "PRIMARY KEY (point, condition))",
    "CREATE TABLE trials (batch INTEGER, position INTEGER, point TEXT, trial_values TEXT, violations TEXT, "
    "exact INTEGER, origin TEXT, method TEXT, PRIMARY KEY (batch, position))",
    "CREATE TABLE gradients (point TEXT PRIMARY KEY, gradient TEXT)",
    # Points given by hand; batch is that which they were judged with.
    "CREATE TABLE given (number INTEGER PRIMARY KEY, point TEXT, batch INTEGER)",
    "CREATE TABLE sessions (number INTEGER PRIMARY KEY, started TEXT DEFAULT (strftime('%Y-%m-%dT%H:%M:%fZ')), "
    "ended TEXT, reason TEXT, versions TEXT, revision TEXT)",
)


# (batch, position, point, values, violations, exact, origin, method)
TrialRow = tuple[int, int, Point, tuple[float, ...], tuple[float, ...], bool, str, str]


class StudyFile:
    """The file of one study. Several processes may have it open; one of them may `run` it.

    One that exists can be read in a folder that cannot be written to as well, as long as nobody else runs it.

    Args:
        path: None keeps the study in memory.
        meta: what a new study is about; None opens one that exists.

    Raises:
        StudyError: there is none, it is damaged, or of another version.
    """

    def __init__(self, path: str | os.PathLike[str] | None, *, meta: Mapping[str, Any] | None = None) -> None:
        self.path = None if path is None else Path(path)
        self._lock = threading.RLock()
        if self.path is not None:
            self._look(new=meta is not None)
        with explained(self.path):
            # Commits are explicit; the lock of this object keeps threads apart.
            self._db = sqlite3.connect(
                sqlite_name(self.path, new=meta is not None),
                uri=True,
                timeout=30.0,
                isolation_level=None,
                check_same_thread=False,
            )
        try:
            with explained(self.path):
                self._refuse_others(new=meta is not None)
                # A killed process loses nothing that was committed; a machine without power may lose the last rollouts.
                self._db.execute("PRAGMA synchronous = NORMAL")
                if meta is not None and self._is_empty():
                    self._create(meta)
        except BaseException:
            self._db.close()
            raise

    def _look(self, *, new: bool) -> None:
        assert self.path is not None
        if not self.path.exists():
            if not new:
                raise StudyError(f"there is no study file {self.path}")
            if not self.path.parent.is_dir():
                raise StudyError(f"{self.path} lies in a folder that does not exist")

    def _is_empty(self) -> bool:
        (tables,) = self._db.execute("SELECT count(*) FROM sqlite_master").fetchone()
        return bool(tables == 0)

    def _refuse_others(self, *, new: bool) -> None:
        """Only reads: a file that is not ours stays as it is."""
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
        (verdict,) = self._db.execute("PRAGMA quick_check(1)").fetchone()
        if verdict != "ok":
            raise damaged(self.path, verdict)

    def _create(self, meta: Mapping[str, Any]) -> None:
        self._db.execute("PRAGMA journal_mode = WAL")
        with self._transaction():
            if not self._is_empty():
                return  # Another process has made it meanwhile.
            for table in _TABLES:
                self._db.execute(table)
            rows = [(key, json.dumps(value)) for key, value in meta.items()]
            self._db.executemany("INSERT INTO meta VALUES (?, ?)", rows)
            self._db.execute(f"PRAGMA application_id = {_APPLICATION}")
            self._db.execute(f"PRAGMA user_version = {VERSION}")

    @contextmanager
    def _transaction(self) -> Iterator[None]:
        with self._lock, explained(self.path):
            self._db.execute("BEGIN IMMEDIATE")
            try:
                yield
            except BaseException:
                self._db.execute("ROLLBACK")
                raise
            self._db.execute("COMMIT")

    def _read(self, query: str, values: Sequence[Any] = ()) -> list[Any]:
        with self._lock, explained(self.path):
            return self._db.execute(query, values).fetchall()

    def close(self) -> None:
        with self._lock:
            self._db.close()

    @contextmanager
    def running(self, *, versions: Mapping[str, str], revision: str) -> Iterator[list[str]]:
        """Claims the file for one process that runs the study. What is put into the list is why it ended.

        Raises:
            StudyError: another process has it.
        """
        with claim(self.path):
            with self._transaction():
                row = self._db.execute(
                    "INSERT INTO sessions (versions, revision) VALUES (?, ?)", (json.dumps(dict(versions)), revision)
                )
            reason: list[str] = []
            try:
                yield reason
            except BaseException as error:
                reason.append(type(error).__name__)
                raise
            finally:
                self._write(
                    "UPDATE sessions SET ended = strftime('%Y-%m-%dT%H:%M:%fZ'), reason = ? WHERE number = ?",
                    ["; ".join(reason), row.lastrowid],
                )

    def _write(self, query: str, values: Sequence[Any]) -> None:
        with self._transaction():
            self._db.execute(query, values)

    # -- what is in it

    @property
    def meta(self) -> dict[str, Any]:
        """What the study is about."""
        return {key: json.loads(value) for key, value in self._read("SELECT key, value FROM meta")}

    def sessions(self) -> list[tuple[str, str | None, str | None, dict[str, str], str]]:
        """(started, ended, why, versions, git revision) of every run; one that was killed has no end."""
        rows = self._read("SELECT started, ended, reason, versions, revision FROM sessions ORDER BY number")
        return [(a, b, c, json.loads(d), e) for a, b, c, d, e in rows]

    def add(self, point: Point, condition: int, outcome: Outcome) -> None:
        """Records a finished rollout, whole or not at all; one that is there already stays."""
        columns = (outcome.h, outcome.value, json.dumps(outcome.measures), outcome.t_star, outcome.end)
        # One statement is a transaction by itself.
        with self._lock, explained(self.path):
            self._db.execute(
                "INSERT OR IGNORE INTO rollouts "
                "(point, condition, h, value, measures, t_star, end, message, wall_time) "
                "VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)",
                (encode(point), condition, *columns, outcome.message, outcome.wall_time),
            )

    def outcomes(self) -> dict[tuple[Point, int], Outcome]:
        """All finished rollouts."""
        query = "SELECT point, condition, h, value, measures, t_star, end, message, wall_time FROM rollouts"
        return {
            (decode(point), condition): Outcome(
                _number(h), _number(value), tuple(json.loads(measures)), _number(t), end, message, _number(wall)
            )
            for point, condition, h, value, measures, t, end, message, wall in self._read(query + " ORDER BY rowid")
        }

    def finished(self) -> dict[tuple[Point, int], datetime]:
        """When each rollout was finished, in UTC."""
        rows = self._read("SELECT point, condition, finished FROM rollouts")
        return {(decode(point), condition): datetime.fromisoformat(at) for point, condition, at in rows}

    def count(self) -> int:
        """How many rollouts there are."""
        return int(self._read("SELECT count(*) FROM rollouts")[0][0])

    def set(self, key: str, value: Any) -> None:
        """Adds to what the study is about."""
        self._write("INSERT OR REPLACE INTO meta VALUES (?, ?)", (key, json.dumps(value)))

    def told(self) -> int:
        """How many batches the solver was told of."""
        return int(self.meta.get("told", 0))

    def save_trials(self, rows: Sequence[TrialRow], *, told: int | None) -> None:
        """Records judged points, and with them how many batches the solver has now been told of."""
        encoded = [
            (batch, position, encode(point), json.dumps(values), json.dumps(violations), int(exact), origin, method)
            for batch, position, point, values, violations, exact, origin, method in rows
        ]
        with self._transaction():
            self._db.executemany("INSERT OR REPLACE INTO trials VALUES (?, ?, ?, ?, ?, ?, ?, ?)", encoded)
            if told is not None:
                self._db.execute("INSERT OR REPLACE INTO meta VALUES ('told', ?)", (json.dumps(told),))

    def begin_anew(self, *, budget: int | None, racing: bool) -> None:
        """The solver is told from the start, for another budget of rollouts, or with racing where there was none, say.

        Trials so far stay, at positions below 0.
        """
        (first, last) = self._read("SELECT min(position), max(position) FROM trials")[0]
        with self._transaction():
            if first is not None:
                self._db.execute("UPDATE trials SET position = position - ?", (last - first + 1,))
            rows = [(key, json.dumps(value)) for key, value in (("budget", budget), ("racing", racing), ("told", 0))]
            self._db.executemany("INSERT OR REPLACE INTO meta VALUES (?, ?)", rows)

    def trials(self) -> list[TrialRow]:
        """All judged points, in the order of the study."""
        return [
            (
                batch,
                position,
                decode(point),
                tuple(json.loads(values)),
                tuple(json.loads(violations)),
                bool(exact),
                origin,
                method,
            )
            for batch, position, point, values, violations, exact, origin, method in self._read(
                "SELECT * FROM trials ORDER BY batch, position"
            )
        ]

    def add_gradient(self, point: Point, gradient: Sequence[float]) -> None:
        """Records the gradient at a point."""
        self._write("INSERT OR IGNORE INTO gradients VALUES (?, ?)", (encode(point), json.dumps(list(gradient))))

    def gradients(self) -> dict[Point, tuple[float, ...]]:
        """All gradients."""
        rows = self._read("SELECT point, gradient FROM gradients")
        return {decode(point): tuple(json.loads(gradient)) for point, gradient in rows}

    def give(self, points: Sequence[Point]) -> None:
        """Puts points into the queue, to be judged with the next batch."""
        with self._transaction():
            self._db.executemany("INSERT INTO given (point) VALUES (?)", [(encode(point),) for point in points])

    def take(self, batch: int, *, new: bool) -> list[Point]:
        """The points given by hand that belong to a batch; with ``new``, those that belong to none yet join it."""
        if new:
            self._write("UPDATE given SET batch = ? WHERE batch IS NULL", (batch,))
        rows = self._read("SELECT point FROM given WHERE batch = ? ORDER BY number", (batch,))
        return [decode(point) for (point,) in rows]

    def queue(self) -> list[Point]:
        """The points given by hand that wait to be judged."""
        rows = self._read("SELECT point FROM given WHERE batch IS NULL ORDER BY number")
        return [decode(point) for (point,) in rows]


def encode(point: Point) -> str:
    """Exact: JSON writes the shortest digits that lead back to the same number."""
    return json.dumps(list(point))


def decode(text: str) -> Point:
    """The inverse of `encode`."""
    return tuple(json.loads(text))


def _number(value: float | None) -> float:
    # SQLite has no NaN: it becomes NULL.
    return float("nan") if value is None else float(value)
