"""A study on disk: what its file holds, to which every finished rollout is written at once."""

from __future__ import annotations

import json
import logging
import os
import sqlite3
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from itertools import chain
from math import isnan, nan
from pathlib import Path
from typing import Any

from vtbdrake.optimization.records import TRY, DrivenTrial, Intervention, Outcome, RolloutKey, Trial
from vtbdrake.optimization.solvers.solver import Point
from vtbdrake.optimization.study.claim import claimed, is_claimed
from vtbdrake.optimization.study.database import Database, Schema
from vtbdrake.optimization.study.study_error import StudyError
from vtbdrake.rollout.course import Course
from vtbdrake.rollout.task import QUALITY_FAILED

_log = logging.getLogger(__name__)

# Why a run ended, in a session of the file.
BUDGET = "budget"
TIME = "time"
TARGET = "target"
SOLVER = "solver"
INTERRUPTED = "interrupted"
STOPPED = "stopped"
REPLAYED = "replayed"

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
    # Rollouts that somebody has driven, beside the points' rollouts.
    "drives": "number INTEGER PRIMARY KEY, time TEXT, name TEXT, parameters TEXT, outcome TEXT, course TEXT",
    "sessions": "number INTEGER PRIMARY KEY, started TEXT, ended TEXT, reason TEXT, versions TEXT, revision TEXT",
    # The user's attributes of a point, or of the study if the point is empty.
    "attributes": "point TEXT, key TEXT, value TEXT",
}
_KEYS = {"rollouts": "point, condition", "trials": "batch, position", "attributes": "point, key"}
_SCHEMA = Schema(
    application=0x56544253,  # "VTBS"
    version=3,
    tables=_TABLES,
    keys=_KEYS,
    # The process that runs the study asks before every batch what waits.
    indices=["CREATE INDEX batches ON interventions (batch)"],
)
_PROGRESS = {"told", "first_position", "rollouts_before", "read_after_kill", "changes_of_rows", "changes_of_search"}
_ABOUT = {"problem", "solver", "seed", "options", "versions", "revision", "units", "limits"}


@dataclass(frozen=True)
class Mark:
    """How far a table was read.

    Attributes:
        row: The number of its last row.
        checksum: The checksum of that row.
        count: The number of rows up to that one.
        changes: How often rows had been changed or removed, not only added.
    """

    row: int = 0
    checksum: int = 0
    count: int = 0
    changes: int = 0

    def after(self, numbers: Sequence[int], rows: Sequence[sqlite3.Row]) -> Mark:
        """Return the mark behind further rows, which have these numbers.

        Args:
            numbers: The numbers of the further rows, increasing; empty if there are none.
            rows: These rows, in the same order.
        """
        return Mark(numbers[-1], rows[-1]["checksum"], self.count + len(rows), self.changes) if rows else self


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
        if not isinstance(path, str | os.PathLike | None):
            raise StudyError(f"a study is a file, given by its path (or None, in memory), not by {path!r}")
        self.path = None if path is None else Path(path)
        new = meta is not None
        if self.path is not None and self.path.is_dir():
            raise StudyError(f"{self.path} is a folder: a study is a file, such as {self.path / 'study.db'}")
        if self.path is not None and not self.path.exists():
            if not new:
                raise StudyError(f"there is no study file {self.path}")
            if not self.path.parent.is_dir():
                raise StudyError(f"{self.path} lies in a folder that does not exist")
        self._db = Database(self.path, _SCHEMA, new=new)
        try:
            if meta is not None:
                self._db.create(lambda: self._set(meta))
            about = self.meta
            if missing := sorted(_ABOUT - about.keys()):
                raise self._db.damaged(f"it lacks the entries {', '.join(missing)}")
            self._addresses = [parameter["address"] for parameter in about["problem"]["parameters"]]
        except BaseException:
            self._db.close()
            raise
        # A batch, and the number of trials in the batches before it; counted on while this process runs the study.
        self._counted: tuple[int, int] | None = None
        if self.path is not None and not new and not is_claimed(self.path):
            self._look_for_log()

    def _look_for_log(self) -> None:
        """Warn if the last run did not end, and the log in which it wrote is gone.

        That such a log was read is noted, because SQLite then writes it into the file and removes it.
        """
        killed = self._db.number(
            "SELECT coalesce(max(number), 0) FROM sessions WHERE ended IS NULL AND number = "
            "(SELECT max(number) FROM sessions)"
        )
        if not killed or self._get("read_after_kill", 0) == killed:
            return
        if self._db.had_log:
            with suppress(StudyError):  # The file cannot be written: then its log stays, too.
                self._note_read(killed)
            return
        _log.warning(
            "the last run of the study %s was killed, or the file was copied during it, and its write-ahead log "
            "%s-wal is not there: the rollouts written last may be missing, and run again; to have them, copy both "
            "files",
            *(self.path, self.path),
        )

    def _note_read(self, session: int) -> None:
        with self._db.transaction():
            self._set({"read_after_kill": session})

    def close(self) -> None:
        """Close the file."""
        self._db.close()

    def while_claimed(self, run: Callable[[], str], *, versions: Mapping[str, str], revision: str) -> None:
        """Run the study in this process, which claims its file.

        Args:
            run: Runs the study, and returns the reason why the run has ended.
            versions: The versions of what computes.
            revision: The git revision of the scenario.

        Raises:
            StudyError: Another process has claimed it.
        """
        claimed(self.path, lambda: self._session(run, (json.dumps(dict(versions)), revision)))

    def _session(self, run: Callable[[], str], about: tuple[str, str]) -> None:
        begun = (0, "")
        reason = ""
        try:
            begun = self._begin_session(about)
            # From now on the file itself tells that its newest rows are in the log.
            self._db.empty_log("PASSIVE")
            self._counted = (0, 0)
            reason = run()
        except BaseException as error:
            reason = type(error).__name__
            raise
        finally:
            self._counted = None
            if any(begun):
                self._end_session((*begun, _now(), reason, *about))
                self._db.empty_log()

    def _begin_session(self, about: tuple[str, str]) -> tuple[int, str]:
        with self._db.transaction():
            begun = (self._db.number("SELECT coalesce(max(number), 0) + 1 FROM sessions"), _now())
            self._db.insert("sessions", [(*begun, None, None, *about)])
        return begun

    def _end_session(self, session: tuple[Any, ...]) -> None:
        with self._db.transaction():
            self._db.insert("sessions", [session], instead="REPLACE")

    # -- contents

    @property
    def meta(self) -> dict[str, Any]:
        """Return the description of the study by name: the problem, the solver, the seed and so on."""
        return {key: json.loads(value) for key, value, _ in self._db.rows("meta")}

    @property
    def description(self) -> dict[str, Any]:
        """Return the description without the progress, for another file."""
        return {key: value for key, value in self.meta.items() if key not in _PROGRESS}

    def _set(self, values: Mapping[str, Any]) -> None:
        self._db.insert("meta", [(key, json.dumps(value)) for key, value in values.items()], instead="REPLACE")

    def _get(self, key: str, default: int) -> int:
        rows = self._db.rows("meta", "WHERE key = ?", (key,))
        return int(json.loads(rows[0]["value"])) if rows else default

    @property
    def changes_of_search(self) -> int:
        """Return the number of interventions that change the search, and of their removals; others are only added."""
        return self._get("changes_of_search", 0)

    def _count_up(self, key: str) -> None:
        self._set({key: self._get(key, 0) + 1})

    def sessions(self) -> list[dict[str, Any]]:
        """Return every run: started, ended and reason (None if it was killed), versions and git revision."""
        rows = [dict(row) for row in self._db.rows("sessions", "ORDER BY number")]
        return [{**row, "versions": json.loads(row["versions"])} for row in rows]

    def last_session(self) -> dict[str, Any] | None:
        """Return the last of `sessions`; None if the study has not run."""
        rows = self._db.rows("sessions", "ORDER BY number DESC LIMIT 1")
        return {**rows[0], "versions": json.loads(rows[0]["versions"])} if rows else None

    def add(self, point: Point, condition: int, outcome: Outcome) -> None:
        """Record a finished rollout, whole or not at all; an existing one stays.

        Args:
            point: The values of the parameters, in order.
            condition: The number of the condition, from 0 on.
            outcome: The result of the rollout.
        """
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
        self._db.insert("rollouts", [row], instead="IGNORE")  # One statement is a transaction by itself.

    def outcomes(self) -> dict[RolloutKey, Outcome]:
        """Return all finished rollouts by (point, number of the condition)."""
        return dict(_outcomes(self._db.rows("rollouts", "ORDER BY rowid")))

    def outcomes_of(self, points: Sequence[Point]) -> dict[RolloutKey, Outcome]:
        """Return the finished rollouts of points."""
        rows = [self._db.rows("rollouts", "WHERE point = ? ORDER BY condition", (encode(point),)) for point in points]
        return dict(_outcomes(chain.from_iterable(rows)))

    def finished(self) -> dict[RolloutKey, datetime]:
        """Return the time at which each rollout was finished, in UTC."""
        rows = self._db.rows("rollouts")
        return {(decode(row["point"]), row["condition"]): datetime.fromisoformat(row["finished"]) for row in rows}

    def count(self) -> int:
        """Return the number of finished rollouts."""
        return self._db.number("SELECT count(*) FROM rollouts")

    def completed_batches(self) -> int:
        """Return the number of batches whose evaluations the solver was told."""
        return self._get("told", 0)

    def batches(self) -> int:
        """Return the number of batches of the present solver that have trials."""
        query = "SELECT coalesce(max(batch) + 1, 0) FROM trials WHERE position >= ?"
        return max(self.completed_batches(), self._db.number(query, (self._get("first_position", 0),)))

    def rollouts_before(self) -> int:
        """Return the number of rollouts that were finished before the present solver began."""
        return self._get("rollouts_before", 0)

    def save_trials(self, batch: int, trials: Mapping[int, Trial], *, complete: bool) -> None:
        """Record trials of a batch, by their positions in it.

        Args:
            batch: The number of the batch.
            trials: Position -> trial.
            complete: Whether the solver was told the evaluations of the batch. Then the trials replace the trials of
                the batch that an interrupted run has recorded.
        """
        with self._db.transaction():
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
            self._db.insert("trials", rows, instead="REPLACE")

    def begin_anew(self, *, budget: int | None, racing: bool) -> None:
        """Prepare the file for a new solver, with another budget or racing; the trials so far stay.

        Args:
            budget: The number of rollouts for which the solver is made; None: no limit.
            racing: Whether points race, see `Evaluator`.
        """
        with self._db.transaction():
            self._withdraw()
            self._set({"budget": budget, "racing": racing})

    def _withdraw(self) -> None:
        """Mark all trials as an earlier solver's."""
        after = self._db.number("SELECT coalesce(max(position) + 1, 0) FROM trials")
        first = max(after, self._get("first_position", 0))
        self._set({"told": 0, "first_position": first, "rollouts_before": self.count()})

    def change_code(
        self, problem: Mapping[str, Any], parts: Sequence[str], *, versions: Mapping[str, str], revision: str
    ) -> None:
        """Note that the code of the problem has changed, and forget the rollouts in which a quality function failed.

        Args:
            problem: The problem as it is now, as `describe` returns it.
            parts: The changes, each as a phrase, see `code_changes`.
            versions: Versions of Python and of the packages that run the study now, by name.
            revision: The git revision of the scenario's folder; empty if there is none.

        Raises:
            StudyError: Another process runs the study.
        """
        claimed(self.path, lambda: self._change_code(problem, parts, versions=versions, revision=revision))

    def _change_code(
        self, problem: Mapping[str, Any], parts: Sequence[str], *, versions: Mapping[str, str], revision: str
    ) -> None:
        with self._db.transaction():
            failed = {row["point"] for row in self._db.rows("rollouts") if row["message"].startswith(QUALITY_FAILED)}
            self._db.execute("DELETE FROM gradients")
            for point in failed:
                self._db.execute("DELETE FROM trials WHERE point = ?", (point,))
            self._db.execute(
                "DELETE FROM rollouts WHERE substr(message, 1, ?) = ?", (len(QUALITY_FAILED), QUALITY_FAILED)
            )
            self._withdraw()
            self._count_up("changes_of_rows")
            change = {"at": _now(), "what": list(parts), "versions": dict(versions), "revision": revision}
            self._set({"problem": problem, "changes": [*self.meta.get("changes", []), change]})

    def add_conditions(self, problem: Mapping[str, Any]) -> None:
        """Note that the problem has further conditions, and forget the trials, whose values came from fewer.

        Raises:
            StudyError: Another process runs the study.
        """
        claimed(self.path, lambda: self._add_conditions(problem))

    def _add_conditions(self, problem: Mapping[str, Any]) -> None:
        with self._db.transaction():
            self._withdraw()
            self._count_up("changes_of_rows")
            for table in ("trials", "gradients"):
                self._db.execute(f"DELETE FROM {table}")
            self._set({"problem": problem})

    def trials(self) -> list[Trial]:
        """Return all trials in the order of the study."""
        return self._trials(self._db.rows("trials", "ORDER BY batch, position"), first=0)

    # -- what is new, for those who watch

    def version(self) -> tuple[int, int]:
        """Return two numbers that differ after any change of the file, by this process or another."""
        return self._db.version()

    @property
    def is_running(self) -> bool:
        """Return whether a process runs the study; of a study in memory, whether its last run has not ended."""
        if self.path is not None:
            return is_claimed(self.path)
        session = self.last_session()
        return session is not None and session["ended"] is None

    def trials_since(self, mark: Mark) -> tuple[int, list[Trial], Mark]:
        """Return the changes since a mark: the number of trials that stay, the trials behind them, and the next mark.

        Trials are in the order in which they were recorded. Those of a batch that an interrupted run has left are
        returned each time, as they will be recorded again.
        """
        mark, rows, numbers = self._rows_since("trials", mark)
        first, complete = self._get("first_position", 0), self.completed_batches()
        final = [row["position"] < first or row["batch"] < complete for row in rows]
        settled = final.index(False) if False in final else len(final)
        after = mark.after(numbers[:settled], rows[:settled])
        # With many trials, reading all attributes together is faster.
        attributes = self._attributes_of(row["point"] for row in rows) if mark.count else None
        return mark.count, self._trials(rows, first=mark.count, attributes=attributes), after

    def outcomes_since(self, mark: Mark) -> tuple[int, list[tuple[RolloutKey, Outcome, datetime]], Mark]:
        """Return the changes since a mark: the number of rollouts that stay, the newer ones, and the next mark."""
        mark, rows, numbers = self._rows_since("rollouts", mark)
        after = mark.after(numbers, rows)
        times = [datetime.fromisoformat(row["finished"]) for row in rows]
        keyed = ((*pair, time) for pair, time in zip(_outcomes(rows), times, strict=True))
        return mark.count, list(keyed), after

    def _rows_since(self, table: str, mark: Mark) -> tuple[Mark, list[sqlite3.Row], list[int]]:
        """Return rows behind a mark with their numbers; if rows before it are gone, all, with the mark of none."""
        changes = self._get("changes_of_rows", 0)
        # SQLite gives the numbers of rows that are gone to new ones.
        checksum = self._db.number(f"SELECT coalesce(max(checksum), 0) FROM {table} WHERE rowid = ?", (mark.row,))
        if (checksum, changes) != (mark.checksum, mark.changes):
            mark = Mark(changes=changes)
        # Rows that are added meanwhile come next time.
        last = self._db.number(f"SELECT coalesce(max(rowid), 0) FROM {table}")
        which = "WHERE rowid > ? AND rowid <= ? ORDER BY rowid", (mark.row, last)
        return mark, self._db.rows(table, *which), self._db.row_numbers(table, *which)

    def earlier_trials(self) -> list[Trial]:
        """Return the trials of earlier solvers, which were made for another budget or another code."""
        first = self._get("first_position", 0)
        return self._trials(self._db.rows("trials", "WHERE position < ? ORDER BY batch, position", (first,)), first=0)

    def trials_of(self, batch: int) -> list[Trial]:
        """Return the trials of a batch that the present solver asked for."""
        first = self._get("first_position", 0)
        rows = self._db.rows("trials", "WHERE batch = ? AND position >= ? ORDER BY position", (batch, first))
        earlier = self._db.number("SELECT count(*) FROM trials WHERE batch = ? AND position < ?", (batch, first))
        points = [row["point"] for row in rows]
        return self._trials(rows, first=self._trials_before(batch) + earlier, attributes=self._attributes_of(points))

    def _trials_before(self, batch: int) -> int:
        """Return the number of trials in the batches before one; while this process runs the study it counts on."""
        since, count = (0, 0) if self._counted is None or self._counted[0] > batch else self._counted
        count += self._db.number("SELECT count(*) FROM trials WHERE batch >= ? AND batch < ?", (since, batch))
        if self._counted is not None:
            self._counted = batch, count
        return count

    def _trials(
        self,
        rows: Sequence[sqlite3.Row],
        *,
        first: int,
        attributes: Mapping[Point | None, Mapping[str, Any]] | None = None,
    ) -> list[Trial]:
        """Return trials, numbered from ``first``, with all attributes or the given ones."""
        attributes = self.attributes() if attributes is None else attributes
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
        """Record the gradient at a point.

        Args:
            point: The values of the parameters, in order.
            gradient: Derivatives, by the parameters, of the value that the solver maximizes, shape (n,).
        """
        with self._db.transaction():
            self._db.insert("gradients", [(encode(point), json.dumps(list(gradient)))], instead="IGNORE")

    def gradients(self) -> dict[Point, tuple[float, ...]]:
        """Return all gradients by point."""
        return {decode(point): tuple(json.loads(gradient)) for point, gradient, _ in self._db.rows("gradients")}

    # -- rollouts that were driven

    def add_drive(self, parameters: Mapping[str, Any], outcome: Outcome, course: Course, *, name: str) -> DrivenTrial:
        """Record a rollout that was driven.

        Args:
            parameters: Values of the parameters where the rollout began, by address.
            outcome: The result of the rollout.
            course: What was driven, from the state at its beginning.
            name: Who drove it.
        """
        with self._db.transaction():
            number = self._db.number("SELECT coalesce(max(number), 0) + 1 FROM drives")
            drive = DrivenTrial(number, datetime.now(UTC), name, parameters, outcome, course)
            texts = [json.dumps(part) for part in (parameters, asdict(outcome), course.to_dict())]
            self._db.insert("drives", [(number, drive.time.isoformat(), name, *texts)])
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
            for row in self._db.rows("drives", "WHERE number > ? ORDER BY number", (after,))
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
            check: Called with the new interventions, which come behind all others; an exception records nothing.
        """
        with self._db.transaction():
            first = self._db.number("SELECT coalesce(max(number), 0) + 1 FROM interventions")
            now = datetime.fromisoformat(_now())
            new = [Intervention(first + k, now, name, kind, payload) for k, payload in enumerate(payloads)]
            check(new)
            self._db.insert("interventions", [_row(intervention) for intervention in new])
        return new

    def copy_interventions(self, interventions: Sequence[Intervention]) -> None:
        """Record interventions of another file as they are."""
        with self._db.transaction():
            self._db.insert("interventions", [_row(intervention) for intervention in interventions])

    def interventions(self, *, waiting: bool = False, after: int = 0) -> list[Intervention]:
        """Return all interventions, or only those that wait for a batch, in their order, behind one of a number.

        Args:
            waiting: Whether to leave out those that have had their effect on a batch.
            after: The number behind which they begin; 0 for all, as numbers count from 1.
        """
        which = f"WHERE {'batch IS NULL AND ' if waiting else ''}number > ? ORDER BY number"
        return [_intervention(row) for row in self._db.rows("interventions", which, (after,))]

    def last_interventions(self, count: int) -> list[Intervention]:
        """Return the last ``count`` interventions, in their order."""
        rows = self._db.rows("interventions", "ORDER BY number DESC LIMIT ?", (count,))
        return [_intervention(row) for row in reversed(rows)]

    def intervention(self, number: int) -> Intervention | None:
        """Return the intervention of a number; None if there is none."""
        rows = self._db.rows("interventions", "WHERE number = ?", (number,))
        return _intervention(rows[0]) if rows else None

    def begin(self, interventions: Sequence[Intervention], *, batch: int) -> list[Intervention]:
        """Record that interventions have an effect on a batch and on those after it; return those that still waited.

        Args:
            interventions: The interventions.
            batch: The number of the first batch on which they have an effect.
        """
        with self._db.transaction():
            waiting = {intervention.number for intervention in self.interventions(waiting=True)}
            begun = [replace(i, batch=batch) for i in interventions if i.number in waiting]
            self._db.insert("interventions", [_row(intervention) for intervention in begun], instead="REPLACE")
        return begun

    def change_waiting(
        self,
        number: int,
        payload: Mapping[str, Any] | None,
        *,
        kind: str | None = None,
        check: Callable[[Intervention, Intervention | None], None],
    ) -> None:
        """Replace the payload of an intervention that waits, or remove it if ``payload`` is None.

        Args:
            number: Its number.
            payload: Its new arguments.
            kind: The kind that it must have; None: any.
            check: Called with the intervention as it was, and as it is now (None if it is removed), when the file has
                been changed; an exception takes the change back.

        Raises:
            StudyError: No intervention of that number and kind waits.
        """
        with self._db.transaction():
            intervention = self.intervention(number)
            if intervention is None or intervention.batch is not None or kind not in (None, intervention.kind):
                waiting = [i.number for i in self.interventions(waiting=True) if kind in (None, i.kind)]
                raise StudyError(
                    f"no intervention {number}{f' of the kind {kind}' if kind else ''} waits in "
                    f"{self.path or 'the study'}; those that wait are: {', '.join(map(str, waiting)) or 'none'}"
                )
            self._db.execute("DELETE FROM interventions WHERE number = ?", (number,))
            changed = None if payload is None else replace(intervention, payload=payload)
            if changed is not None:
                self._db.insert("interventions", [_row(changed)])
            if intervention.kind != TRY:
                self._count_up("changes_of_search")
            check(intervention, changed)

    # -- attributes

    def set_attribute(self, point: Point | None, key: str, value: Any) -> None:
        """Set an attribute of a point, or of the study if ``point`` is None.

        Args:
            point: The values of the parameters, in order; None for the study.
            key: The name of the attribute.
            value: Plain data that JSON can hold; it replaces an earlier value.
        """
        with self._db.transaction():
            row = ("" if point is None else encode(point), key, json.dumps(value))
            self._db.insert("attributes", [row], instead="REPLACE")

    def attributes(self) -> dict[Point | None, dict[str, Any]]:
        """Return all attributes by point; the study's attributes under None."""
        by_point: dict[Point | None, dict[str, Any]] = {}
        for point, key, value, _ in self._db.rows("attributes", "ORDER BY rowid"):
            by_point.setdefault(decode(point) if point else None, {})[key] = json.loads(value)
        return by_point

    def _attributes_of(self, points: Iterable[str]) -> dict[Point | None, dict[str, Any]]:
        """Return the attributes of encoded points by point."""
        tables = {point: self._db.rows("attributes", "WHERE point = ? ORDER BY rowid", (point,)) for point in points}
        return {decode(point): {r["key"]: json.loads(r["value"]) for r in rows} for point, rows in tables.items()}


def _outcomes(rows: Iterable[sqlite3.Row]) -> Iterator[tuple[RolloutKey, Outcome]]:
    for point, condition, h, value, measures, t_star, end, message, wall_time, *_ in rows:
        yield (
            (decode(point), condition),
            Outcome(
                _float(h), _float(value), tuple(json.loads(measures)), _float(t_star), end, message, _float(wall_time)
            ),
        )


def _intervention(row: sqlite3.Row) -> Intervention:
    number, time, name, kind, payload, batch, _ = row
    return Intervention(number, datetime.fromisoformat(time), name, kind, json.loads(payload), batch)


def _row(intervention: Intervention) -> tuple[Any, ...]:
    return (
        intervention.number,
        intervention.time.isoformat(timespec="milliseconds"),
        intervention.name,
        intervention.kind,
        json.dumps(dict(intervention.payload)),
        intervention.batch,
    )


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


def _outcome_of(fields: dict[str, Any]) -> Outcome:
    return Outcome(**{**fields, "measures": tuple(fields["measures"])})
