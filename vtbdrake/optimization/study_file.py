"""A study on disk: one SQLite file with a write-ahead log, into which every finished rollout goes at once.

Every row has a checksum. A file in which anything has changed that is not a study's own doing is damaged, and nothing
is read from it.
"""

from __future__ import annotations

import json
import os
import sqlite3
import threading
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from math import isnan
from pathlib import Path
from typing import Any

from vtbdrake.optimization.outcome import Outcome
from vtbdrake.optimization.solvers.solver import Point
from vtbdrake.optimization.study_error import StudyError, damaged, explained
from vtbdrake.optimization.study_lock import claim
from vtbdrake.optimization.study_name import sqlite_name
from vtbdrake.rollout.task import QUALITY_FAILED

VERSION = 2
_APPLICATION = 0x56544253  # "VTBS"

# Each table also has a last column, ``checksum``.
_TABLES = {
    "meta": "key TEXT PRIMARY KEY, value TEXT",
    # A rollout is there once, whatever asked for it, and how often.
    "rollouts": "point TEXT, condition INTEGER, h REAL, value REAL, measures TEXT, t_star REAL, end TEXT, "
    "message TEXT, wall_time REAL, finished TEXT",
    "trials": "batch INTEGER, position INTEGER, point TEXT, trial_values TEXT, violations TEXT, exact INTEGER, "
    "origin TEXT, method TEXT",
    "gradients": "point TEXT PRIMARY KEY, gradient TEXT",
    # Points given by hand; batch is that which they were judged with.
    "given": "number INTEGER PRIMARY KEY, point TEXT, batch INTEGER",
    "sessions": "number INTEGER PRIMARY KEY, started TEXT, ended TEXT, reason TEXT, versions TEXT, revision TEXT",
    # What users say of a point; of the study, where the point is empty.
    "attributes": "point TEXT, key TEXT, value TEXT",
}
_KEYS = {"rollouts": "point, condition", "trials": "batch, position", "attributes": "point, key"}
_ABOUT = {"problem", "solver", "seed", "options", "versions", "revision", "units"}


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
                if not self._is_empty():
                    self._refuse_damage()
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
        """Refuse a file of another kind or version. It only reads: a file that is not ours stays as it is."""
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
            raise damaged(self.path, verdict)
        for table in _TABLES:
            for _ in self._rows(table):
                pass
        missing = sorted(_ABOUT - self.meta.keys())
        if missing:
            raise damaged(self.path, f"it does not say the {', '.join(missing)}")

    def _create(self, meta: Mapping[str, Any]) -> None:
        self._db.execute("PRAGMA journal_mode = WAL")
        with self._transaction():
            if not self._is_empty():
                return  # Another process has made it meanwhile.
            for table, columns in _TABLES.items():
                key = f", PRIMARY KEY ({_KEYS[table]})" if table in _KEYS else ""
                self._db.execute(f"CREATE TABLE {table} ({columns}, checksum INTEGER{key})")
            self._insert("meta", [(key, json.dumps(value)) for key, value in meta.items()])
            self._db.execute(f"PRAGMA application_id = {_APPLICATION}")
            self._db.execute(f"PRAGMA user_version = {VERSION}")

    @contextmanager
    def _transaction(self) -> Iterator[None]:
        with self._lock, explained(self.path):
            self._db.execute("BEGIN IMMEDIATE")
            try:
                yield
            except BaseException:
                if self._db.in_transaction:  # On a full disk SQLite has ended it by itself.
                    self._db.execute("ROLLBACK")
                raise
            self._db.execute("COMMIT")

    def _insert(self, table: str, rows: Iterable[tuple[Any, ...]], *, instead: str = "ABORT") -> None:
        """Add rows with their checksums; ``instead`` is what SQLite does where there is a row of the same key."""
        sealed = [(*row, _checksum(table, row)) for row in rows]
        if sealed:
            marks = ", ".join("?" * len(sealed[0]))
            self._db.executemany(f"INSERT OR {instead} INTO {table} VALUES ({marks})", sealed)

    def _rows(self, table: str, more: str = "", values: Sequence[Any] = ()) -> Iterator[tuple[Any, ...]]:
        """Yield the rows of a table, checked and without their checksums; ``more`` says which, and in which order."""
        with self._lock, explained(self.path):
            found = self._db.execute(f"SELECT * FROM {table} {more}", values).fetchall()
        for *row, checksum in found:
            if checksum != _checksum(table, row):
                raise damaged(self.path, f"a row of {table} has changed")
            yield tuple(row)

    def _next_number(self, table: str) -> int:
        (last,) = self._db.execute(f"SELECT coalesce(max(number), 0) FROM {table}").fetchone()
        return int(last) + 1

    def close(self) -> None:
        with self._lock:
            self._db.close()

    @contextmanager
    def running(self, *, versions: Mapping[str, str], revision: str) -> Iterator[list[str]]:
        """Claim the file for this process, which runs the study. What it puts into the list is why the run ended.

        Raises:
            StudyError: another process has it.
        """
        with claim(self.path):
            with self._transaction():
                begun = (self._next_number("sessions"), _now())
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

    # -- what is in it

    @property
    def meta(self) -> dict[str, Any]:
        """What the study is about: the problem, the solver, the seed and so on, by name."""
        return {key: json.loads(value) for key, value in self._rows("meta")}

    def sessions(self) -> list[tuple[str, str | None, str | None, dict[str, str], str]]:
        """(started, ended, why, versions, git revision) of every run; one that was killed has no end."""
        rows = self._rows("sessions", "ORDER BY number")
        return [(a, b, c, json.loads(d), e) for _, a, b, c, d, e in rows]

    def add(self, point: Point, condition: int, outcome: Outcome) -> None:
        """Record a finished rollout, whole or not at all; one that is there already stays."""
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
        with self._lock, explained(self.path):
            self._insert("rollouts", [row], instead="IGNORE")

    def outcomes(self) -> dict[tuple[Point, int], Outcome]:
        """Return all finished rollouts by (point, number of the condition)."""
        return {
            (decode(point), condition): Outcome(
                _number(h), _number(value), tuple(json.loads(measures)), _number(t), end, message, _number(wall)
            )
            for point, condition, h, value, measures, t, end, message, wall, _ in self._rows(
                "rollouts", "ORDER BY rowid"
            )
        }

    def finished(self) -> dict[tuple[Point, int], datetime]:
        """Return when each rollout was finished, in UTC."""
        return {(decode(row[0]), row[1]): datetime.fromisoformat(row[-1]) for row in self._rows("rollouts")}

    def count(self) -> int:
        """Return the number of finished rollouts."""
        with self._lock, explained(self.path):
            return int(self._db.execute("SELECT count(*) FROM rollouts").fetchone()[0])

    def set(self, key: str, value: Any) -> None:
        """Set one entry of `meta`."""
        with self._transaction():
            self._set({key: value})

    def _set(self, values: Mapping[str, Any]) -> None:
        self._insert("meta", [(key, json.dumps(value)) for key, value in values.items()], instead="REPLACE")

    def told(self) -> int:
        """Return the number of batches that the solver was told of."""
        return int(self.meta.get("told", 0))

    def save_trials(self, rows: Sequence[TrialRow], *, told: int | None) -> None:
        """Record judged points.

        Args:
            rows: the points.
            told: how many batches the solver has now been told of, the last of which these points are; what an earlier
                run has left of that batch is replaced. None: the batch is not complete.
        """
        encoded = [
            (batch, position, encode(point), json.dumps(values), json.dumps(violations), int(exact), origin, method)
            for batch, position, point, values, violations, exact, origin, method in rows
        ]
        with self._transaction():
            if told is not None:
                # What was complete of this batch when a run ended in its midst.
                self._db.execute("DELETE FROM trials WHERE batch = ? AND position >= 0", (told - 1,))
            self._insert("trials", encoded, instead="REPLACE")
            if told is not None:
                self._set({"told": told})

    def begin_anew(self, *, budget: int | None, racing: bool) -> None:
        """Have a new solver told from the start: it is made for another budget of rollouts, or racing is another.

        Trials so far stay, at positions below 0.
        """
        with self._transaction():
            self._withdraw()
            self._set({"budget": budget, "racing": racing})

    def _withdraw(self) -> None:
        """Note that no solver was told of the trials so far; they stay, at positions below 0."""
        rows = list(self._rows("trials"))
        if rows:
            positions = [position for _, position, *_ in rows]
            shift = max(positions) - min(positions) + 1
            self._db.execute("DELETE FROM trials")
            self._insert("trials", [(batch, position - shift, *rest) for batch, position, *rest in rows])
        self._set({"told": 0})

    def change_code(
        self, problem: Mapping[str, Any], what: Sequence[str], *, versions: Mapping[str, str], revision: str
    ) -> None:
        """Note that the code of the problem has changed, and forget the rollouts in which a quality function failed.

        Raises:
            StudyError: another process runs the study.
        """
        with claim(self.path), self._transaction():
            failed = {row[0] for row in self._rows("rollouts") if row[7].startswith(QUALITY_FAILED)}
            self._db.execute("DELETE FROM gradients")
            for point in failed:
                self._db.execute("DELETE FROM trials WHERE point = ?", (point,))
            self._db.execute(
                "DELETE FROM rollouts WHERE substr(message, 1, ?) = ?", (len(QUALITY_FAILED), QUALITY_FAILED)
            )
            self._withdraw()
            change = {"at": _now(), "what": list(what), "versions": dict(versions), "revision": revision}
            self._set({"problem": problem, "changes": [*self.meta.get("changes", []), change]})

    def trials(self) -> list[TrialRow]:
        """Return all judged points, in the order of the study."""
        return [_trial(row) for row in self._rows("trials", "ORDER BY batch, position")]

    def trials_of(self, batch: int) -> tuple[int, list[TrialRow]]:
        """Return the number of the first trial of a batch among all trials, and the trials of that batch."""
        rows = self._rows("trials", "WHERE batch = ? AND position >= 0 ORDER BY position", (batch,))
        with self._lock, explained(self.path):
            (before,) = self._db.execute(
                "SELECT count(*) FROM trials WHERE batch < ? OR (batch = ? AND position < 0)", (batch, batch)
            ).fetchone()
        return before, [_trial(row) for row in rows]

    def add_gradient(self, point: Point, gradient: Sequence[float]) -> None:
        """Record the gradient at a point."""
        with self._transaction():
            self._insert("gradients", [(encode(point), json.dumps(list(gradient)))], instead="IGNORE")

    def gradients(self) -> dict[Point, tuple[float, ...]]:
        """Return all gradients by point."""
        return {decode(point): tuple(json.loads(gradient)) for point, gradient in self._rows("gradients")}

    # -- points given by hand

    def give(self, points: Sequence[Point]) -> None:
        """Put points into the queue, to be judged with the next batch."""
        with self._transaction():
            first = self._next_number("given")
            self._insert("given", [(first + k, encode(point), None) for k, point in enumerate(points)])

    def take(self, batch: int, *, new: bool) -> list[Point]:
        """Return the points given by hand that belong to a batch; with ``new``, those in the queue join it first."""
        if new and self.queue():
            with self._transaction():
                waiting = [(number, point, batch) for number, point, _ in self._rows("given", "WHERE batch IS NULL")]
                self._insert("given", waiting, instead="REPLACE")
        rows = self._rows("given", "WHERE batch = ? ORDER BY number", (batch,))
        return [decode(point) for _, point, _ in rows]

    def queue(self) -> dict[int, Point]:
        """Return the points given by hand that wait to be judged, by their numbers."""
        rows = self._rows("given", "WHERE batch IS NULL ORDER BY number")
        return {number: decode(point) for number, point, _ in rows}

    def change_queue(self, number: int, point: Point | None) -> None:
        """Put another point in the place of one that waits, or none.

        Raises:
            StudyError: none of that number waits.
        """
        with self._transaction():
            if not list(self._rows("given", "WHERE number = ? AND batch IS NULL", (number,))):
                waiting = [str(other) for other in self.queue()]
                which = f"{', '.join(waiting)} do" if len(waiting) > 1 else f"{''.join(waiting) or 'none'} does"
                raise StudyError(f"no point {number} waits to be judged in {self.path or 'the study'}; {which}")
            if point is None:
                self._db.execute("DELETE FROM given WHERE number = ?", (number,))
            else:
                self._insert("given", [(number, encode(point), None)], instead="REPLACE")

    # -- attributes

    def set_attribute(self, point: Point | None, key: str, value: Any) -> None:
        """Set an attribute of a point, or of the study."""
        with self._transaction():
            row = ("" if point is None else encode(point), key, json.dumps(value))
            self._insert("attributes", [row], instead="REPLACE")

    def attributes(self) -> dict[Point | None, dict[str, Any]]:
        """Return all attributes by point; those of the study under None."""
        found: dict[Point | None, dict[str, Any]] = {}
        for point, key, value in self._rows("attributes", "ORDER BY rowid"):
            found.setdefault(decode(point) if point else None, {})[key] = json.loads(value)
        return found


def _trial(row: tuple[Any, ...]) -> TrialRow:
    batch, position, point, values, violations, exact, origin, method = row
    numbers = tuple(json.loads(values)), tuple(json.loads(violations))
    return batch, position, decode(point), *numbers, bool(exact), origin, method


def _checksum(table: str, row: Sequence[Any]) -> int:
    return zlib.crc32(repr((table, *row)).encode())


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="milliseconds")


def encode(point: Point) -> str:
    """Return a point as text; exact, as JSON writes the shortest digits that lead back to the same number."""
    return json.dumps(list(point))


def decode(text: str) -> Point:
    """Return the point of a text, the inverse of `encode`."""
    return tuple(json.loads(text))


def _real(value: float) -> float | None:
    # SQLite has no NaN.
    return None if isnan(value) else float(value)


def _number(value: float | None) -> float:
    """Return a number of SQLite, the inverse of `_real`."""
    return float("nan") if value is None else value
