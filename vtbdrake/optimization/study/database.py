"""The SQLite file of a study: rows with checksums, a write-ahead log, and several processes that have it open.

A file that was changed by anything but a study is damaged, and nothing is read from it.
"""

from __future__ import annotations

import os
import sqlite3
import threading
import time
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from vtbdrake.common.failures import one_line
from vtbdrake.common.interrupt import interrupts_postponed
from vtbdrake.optimization.study.claim import is_claimed
from vtbdrake.optimization.study.study_error import StudyError
from vtbdrake.optimization.study.write_ahead_log import lost_writes

_Result = TypeVar("_Result")

# s that a change waits for a process that is writing; and how long SQLite waits at a time, in which no Ctrl-C comes.
PATIENCE = 30.0
_TURN = 0.2
# The pages of the write-ahead log before they are written to the file, where every row is checked.
_LOG_PAGES = 200


@dataclass(frozen=True)
class Schema:
    """The tables of a file.

    Attributes:
        application: The number by which SQLite tells files of this kind from others.
        version: The version of the tables.
        tables: The columns of each table, but for the last one, ``checksum``.
        keys: The columns of the primary keys of several columns, by table.
        indices: Statements that make indices.
    """

    application: int
    version: int
    tables: Mapping[str, str]
    keys: Mapping[str, str]
    indices: Sequence[str] = ()

    def creation(self, table: str) -> str:
        """Return the statement that makes a table."""
        key = f", PRIMARY KEY ({self.keys[table]})" if table in self.keys else ""
        return f"CREATE TABLE {table} ({self.tables[table]}, checksum INTEGER{key})"


class Database:
    """An SQLite file with checked rows, which threads and processes may use at the same time.

    Attributes:
        path: The path of the file; None: it is in memory.
        had_log: Whether there was a write-ahead log when it was opened; SQLite makes one as soon as it reads.
    """

    def __init__(self, path: Path | None, schema: Schema, *, new: bool) -> None:
        """Open a file, or make a new one, which is empty until `create`.

        Args:
            path: The path of the file; None: it is in memory.
            schema: Its tables.
            new: Whether it may be empty.

        Raises:
            StudyError: It is damaged, of another kind or of another version.
        """
        self.path, self._schema = path, schema
        self._lock = threading.RLock()
        self.had_log = False
        if path is not None:
            _refuse_lost_writes(path)
            log = _log_of(path)
            self.had_log = log.exists() and log.stat().st_size > 0
        with _explained(path):
            # Commits are explicit; the lock of this object keeps threads apart.
            self._db = sqlite3.connect(
                _sqlite_name(path, new=new), uri=True, timeout=_TURN, isolation_level=None, check_same_thread=False
            )
        try:
            self._db.row_factory = sqlite3.Row
            with _explained(path):
                self._refuse_others(new=new)
                if not self._is_empty():
                    self._refuse_damage()
                # A killed process loses nothing that was committed; a power failure may lose the last rollouts.
                self._db.execute("PRAGMA synchronous = NORMAL")
                self._db.execute(f"PRAGMA wal_autocheckpoint = {_LOG_PAGES}")
        except BaseException:
            self._db.close()
            raise

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
        if application != self._schema.application:
            raise StudyError(f"{self.path} is not a study: it is an SQLite file of another kind")
        if version != self._schema.version:
            raise StudyError(
                f"{self.path} is a study of version {version}, but this vtbdrake reads version {self._schema.version}: "
                "open it with the vtbdrake that wrote it"
            )

    def _refuse_damage(self) -> None:
        (verdict,) = self._db.execute("PRAGMA integrity_check(1)").fetchone()
        if verdict != "ok":
            raise self.damaged(verdict)
        for table in self._schema.tables:
            made = self._db.execute("SELECT sql FROM sqlite_master WHERE name = ?", (table,)).fetchone()
            if made is None or made[0] != self._schema.creation(table):
                raise self.damaged(f"the table {table} has other columns")
            self.rows(table)

    def damaged(self, reason: object) -> StudyError:
        """Return the error of a file that cannot be read for a reason."""
        return _damaged(self.path, reason)

    def create(self, fill: Callable[[], None]) -> None:
        """Make the tables of an empty file, and fill them in the same transaction; otherwise nothing happens."""
        with _explained(self.path):
            if not self._is_empty():
                return
            self._db.execute("PRAGMA journal_mode = WAL")
        with self.transaction():
            if not self._is_empty():
                return  # Another process has created it meanwhile.
            for statement in (*map(self._schema.creation, self._schema.tables), *self._schema.indices):
                self._db.execute(statement)
            fill()
            self._db.execute(f"PRAGMA application_id = {self._schema.application}")
            self._db.execute(f"PRAGMA user_version = {self._schema.version}")
        self.empty_log()

    def empty_log(self, how: str = "TRUNCATE") -> None:
        """Write the log into the file; nothing happens while another process uses the log."""
        with self._lock, _explained(self.path):
            self._db.execute(f"PRAGMA wal_checkpoint({how})")

    @contextmanager
    def transaction(self) -> Iterator[None]:
        """All changes in its context are made, or none if it ends by an exception."""
        # Ctrl-C waits for its end, wherever it comes: an open transaction would lock out other processes and this one.
        with interrupts_postponed() as arrived, self._lock, _explained(self.path):
            try:
                self._patiently(lambda: self._db.execute("BEGIN IMMEDIATE"), unless=arrived)
                yield
            except BaseException:
                if self._db.in_transaction:  # On a full disk SQLite has already ended it.
                    self._db.execute("ROLLBACK")
                raise
            self._db.execute("COMMIT")

    def _patiently(self, use: Callable[[], _Result], *, unless: Sequence[int] = ()) -> _Result:
        """Use the file; while another process holds it, try again, until a signal has come."""
        deadline = time.monotonic() + PATIENCE
        while True:
            try:
                return use()
            except sqlite3.OperationalError as error:
                if _code(error) != sqlite3.SQLITE_BUSY or unless or time.monotonic() > deadline:
                    raise

    def execute(self, statement: str, values: Sequence[Any] = ()) -> None:
        """Execute a statement within a transaction.

        Args:
            statement: The statement in SQL.
            values: The values of its question marks.
        """
        self._db.execute(statement, values)

    def insert(self, table: str, rows: Iterable[tuple[Any, ...]], *, instead: str = "ABORT") -> None:
        """Add rows with their checksums, in a transaction of their own if there is none.

        Args:
            table: The name of the table.
            rows: The rows, without checksums.
            instead: What SQLite does if there is a row of the same key.
        """
        sealed = [(*row, _checksum(table, row)) for row in rows]
        if sealed:
            marks = ", ".join("?" * len(sealed[0]))
            insert = f"INSERT OR {instead} INTO {table} VALUES ({marks})"
            with self._lock, _explained(self.path):
                self._patiently(lambda: self._db.executemany(insert, sealed))

    def rows(self, table: str, more: str = "", values: Sequence[Any] = ()) -> list[sqlite3.Row]:
        """Return checked rows of a table.

        Args:
            table: The name of the table.
            more: What follows its name in SQL: which rows, in which order.
            values: The values of the question marks in ``more``.

        Raises:
            StudyError: A row has changed.
        """
        with self._lock, _explained(self.path):
            rows = self._patiently(lambda: self._db.execute(f"SELECT * FROM {table} {more}", values).fetchall())
        for *row, checksum in rows:
            if checksum != _checksum(table, row):
                raise self.damaged(f"a row of {table} has changed")
        return rows

    def row_numbers(self, table: str, more: str = "", values: Sequence[Any] = ()) -> list[int]:
        """Return the numbers that SQLite has given the rows that `rows` returns for the same arguments.

        Args:
            table: The name of the table.
            more: What follows its name in SQL.
            values: The values of the question marks in ``more``.
        """
        with self._lock, _explained(self.path):
            numbers = self._patiently(lambda: self._db.execute(f"SELECT rowid FROM {table} {more}", values).fetchall())
        return [number for (number,) in numbers]

    def version(self) -> tuple[int, int]:
        """Return two numbers that differ after any change of the file, by this process or another."""
        return self.number("PRAGMA data_version"), self._db.total_changes

    def number(self, query: str, values: Sequence[Any] = ()) -> int:
        """Return the single number that a query finds.

        Args:
            query: The query in SQL.
            values: The values of its question marks.
        """
        with self._lock, _explained(self.path):
            (number,) = self._patiently(lambda: self._db.execute(query, values).fetchone())
        return int(number)

    def close(self) -> None:
        """Close the file."""
        with self._lock:
            self._db.close()


def _checksum(table: str, row: Sequence[Any]) -> int:
    return zlib.crc32(repr((table, *row)).encode())


def _refuse_lost_writes(path: Path) -> None:
    """Refuse a file in whose write-ahead log damage would hide the last writes.

    Raises:
        StudyError: There is such damage.
    """
    if is_claimed(path):  # It is being written.
        return
    with _explained(path):
        lost = lost_writes(path)
        if lost is not None:
            time.sleep(0.05)  # A process that adds points may be about to complete a frame.
            lost = lost_writes(path)
    if lost is not None:
        log = _log_of(path)
        raise StudyError(
            f"the write-ahead log {log} is damaged after {lost.readable} bytes, which hides {lost.frames} pages that "
            f"were written later; it was left unchanged: restore both files from a copy, or cut the log (truncate "
            f"-s {lost.readable} {log}) to go on without these writes: their rollouts run again"
        )


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


_CHECK_BOTH = "check the free space of its disk, and the permissions of the file and its folder"
# What to do, by what SQLite says; anything else may be the disk or the permissions.
_REMEDIES = {
    sqlite3.SQLITE_BUSY: f"another process has been writing to it for {PATIENCE:g} s: wait for it, or end it",
    sqlite3.SQLITE_FULL: "free space on its disk",
    sqlite3.SQLITE_READONLY: "check the permissions of the file and its folder",
    sqlite3.SQLITE_CANTOPEN: "check the permissions of the file and its folder",
}


def _code(error: sqlite3.Error) -> int:
    """Return SQLite's code of an error, without the details of it."""
    return int(getattr(error, "sqlite_errorcode", sqlite3.SQLITE_ERROR)) & 0xFF


def _log_of(path: Path) -> Path:
    return path.with_name(path.name + "-wal")


def _damaged(path: Path | None, reason: object) -> StudyError:
    return StudyError(f"{path} cannot be read ({one_line(reason)}); it was left unchanged: restore it from a copy")


@contextmanager
def _explained(path: Path | None) -> Iterator[None]:
    """Raise the errors of SQLite as `StudyError`."""
    try:
        yield
    except sqlite3.ProgrammingError as error:
        raise StudyError(f"the study {path} is closed ({error}): open it again") from error
    except sqlite3.OperationalError as error:
        # SQL that SQLite does not understand, or text that it cannot decode, is a sign of damage.
        code = _code(error)
        if code == sqlite3.SQLITE_ERROR:
            raise _damaged(path, error) from error
        remedy = _REMEDIES.get(code, _CHECK_BOTH)
        raise StudyError(f"{path} cannot be used ({one_line(error)}); what was recorded is kept: {remedy}") from error
    except (sqlite3.DatabaseError, UnicodeDecodeError) as error:
        raise _damaged(path, error) from error
