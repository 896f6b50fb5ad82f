"""What a page shows of a study: its trials as columns, and where it stands; read from its file as it changes."""

from __future__ import annotations

import threading
import time
from bisect import bisect_right
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from vtbdrake.common.failures import one_line
from vtbdrake.common.json_data import plain
from vtbdrake.optimization import Choice, Study, StudyError, Trial
from vtbdrake.optimization.parameter import Dimension
from vtbdrake.optimization.pareto import undominated
from vtbdrake.optimization.records import DrivenTrial, Intervention
from vtbdrake.optimization.solvers.solver import Point
from vtbdrake.optimization.study.study_file import Mark, StudyFile
from vtbdrake.optimization.study.study_search import StudySearch
from vtbdrake.rollout.task import FAILED

_POLL = 0.2  # s
READING_SHARE = 0.004  # of a core, that the reading takes at most, unless somebody would wait too long
_LONGEST_WAIT = 2.0  # s; the trials of a fast study must be read anyway, sooner or later
_SIGN_OF_LIFE = 1.0  # s between two looks at whether a process runs the study
_RATE_OVER = 60  # rollouts over which their rate is measured
_FAILURES = 40  # different reasons that are listed
_TEXT = 300  # letters of a reason
_DRIVEN = 200  # driven rollouts that are shown, the last ones
_LISTED = 200  # interventions that are listed, the last ones
_REVISIONS = 1000  # that are remembered, for pages that lag behind


@dataclass(frozen=True)
class Status:
    """Where a study stands.

    Attributes:
        state: ``new``, ``running``, ``ended`` or ``died``: its process has ended without a word.
        reason: Why the last run ended.
        message: Why the file cannot be read any more; empty while it can.
        rollouts: Finished rollouts.
        ends: Their number by the way in which they ended.
        rate: Rollouts per second, at present.
        failures: Reasons of failures: message, number, and the number of the first trial; the most frequent first.
        search: The search as the interventions have left it.
        interventions: The last interventions, in their order.
    """

    state: str
    reason: str
    message: str
    rollouts: int
    ends: dict[str, int]
    rate: float | None
    failures: tuple[tuple[str, int, int | None], ...]
    search: StudySearch
    interventions: tuple[Intervention, ...]


class StudyFeed:
    """Reads a study while another process, or this one, runs it.

    Args:
        file: The file of the study.

    Attributes:
        trials: The trials in the order in which they were recorded.
        driven: The rollouts that somebody has driven, in their order.
        status: Where the study stands.
        revision: Counts the changes.
    """

    def __init__(self, file: StudyFile) -> None:
        self._file = file
        self._study = Study(file)
        # The options of choices stay, other ranges may be widened.
        self._parameters = self._study.parameters
        self.trials: list[Trial] = []
        self.driven: list[DrivenTrial] = []
        problem = self._study.record["problem"]
        self._conditions, self._qualities = len(problem["conditions"]), len(problem["qualities"])
        self._signs = np.array(self._study.signs)
        self.revision = 0
        self._trial_mark, self._outcome_mark = Mark(), Mark()
        self._failure_of: dict[Point, str] = {}
        self._first_trial: dict[str, int] = {}
        self._failures: Counter[str] = Counter()
        self._ends: Counter[str] = Counter()
        self._finished: list[datetime] = []
        # Number of trials that have stayed as they were, since each revision.
        self._stayed: dict[int, int] = {}
        self._oldest = 0  # revision; what was before it is forgotten
        self._changed = threading.Condition()
        self._closed = threading.Event()
        # Numbers of trials: those in forbidden regions, and the Pareto front along the first quality.
        self._excluded: list[int] = []
        self._front: list[int] = []
        self._version: tuple[int, int] | None = None
        self._message = ""
        self._identity = None if file.path is None else _identity(file.path)
        self._read()
        self.status = self._look()
        self._thread = threading.Thread(target=self._watch, name="vtbdrake study feed", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the reading."""
        self._closed.set()
        self._thread.join()
        with self._changed:
            self._changed.notify_all()

    def wait(self, revision: int, timeout: float) -> int:
        """Return the present revision, as soon as it is another one than ``revision``, or after ``timeout`` seconds.

        Args:
            revision: The revision that the caller has seen.
            timeout: The longest wall time to wait, in seconds.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._closed.is_set() or self.revision != revision, timeout)
            return self.revision

    def columns(self, first: int, revision: int) -> dict[str, Any]:
        """Return the trials that a page of ``revision``, which has the first ones, does not have yet, as columns.

        Attributes of the answer: ``first``, how many of the page's trials stay; ``points``, one list per parameter (of
        a choice the number of the option); ``values``, one per quality, None where there is none; ``kinds``,
        ``methods``, ``batches``, and by their places behind the first ones ``by_hand`` and ``reasons`` of failures;
        and by the numbers of trials the ``front`` of several qualities, along the first one (see `Study.pareto`), and
        the trials that are ``excluded`` by forbidden regions.

        Args:
            first: The number of trials that the page has.
            revision: The revision at which it got them.
        """
        with self._changed:
            lost = revision < self._oldest
            stay = 0 if lost else min([first, *(count for number, count in self._stayed.items() if number > revision)])
            new = self.trials[stay:]
            now, front, excluded = self.revision, self._front, self._excluded
        message = {"type": "trials", "first": stay, "revision": now, "front": front, "excluded": excluded}
        return message | self._as_columns(new)

    def driven_columns(self) -> dict[str, list[Any]]:
        """Return the driven rollouts as columns, of the last ones that are shown.

        Attributes of the answer: ``numbers`` and ``names``; ``points``, one list per rollout, with None for a value
        that is no option of a choice; ``values``, one list per rollout; ``kinds``, as for trials; ``messages``;
        and ``after``, the number of points that the study had at that time.
        """
        with self._changed:
            driven, finished = self.driven[-_DRIVEN:], self._finished
            after = [bisect_right(finished, drive.time) // self._conditions for drive in driven]
        return {
            "numbers": [drive.number for drive in driven],
            "names": [drive.name for drive in driven],
            "points": [[place(p, drive.parameters[p.address]) for p in self._parameters] for drive in driven],
            "values": plain([drive.values(self._qualities) for drive in driven]),
            "kinds": [drive.kind(self._qualities) for drive in driven],
            "messages": [drive.outcome.message[:_TEXT] for drive in driven],
            "after": after,
        }

    def _as_columns(self, trials: Sequence[Trial]) -> dict[str, Any]:
        columns: list[list[Any]] = [[trial.parameters[p.address] for trial in trials] for p in self._parameters]
        for k, parameter in enumerate(self._parameters):
            if isinstance(parameter, Choice):
                columns[k] = [place(parameter, value) for value in columns[k]]
        count = len(trials[0].values) if trials else 0
        failures = {k: self._failure_of.get(t.point, "")[:_TEXT] for k, t in enumerate(trials) if t.kind == FAILED}
        return {
            "points": columns,
            "values": plain([[trial.values[k] for trial in trials] for k in range(count)]),
            "kinds": [trial.kind for trial in trials],
            "methods": [trial.method for trial in trials],
            "batches": [trial.batch for trial in trials],
            "by_hand": [k for k, trial in enumerate(trials) if trial.origin == "user"],
            "reasons": failures,
        }

    # -- in the thread of the feed

    def _watch(self) -> None:
        next_look, wait = 0.0, _POLL
        while not self._closed.wait(wait):
            begin = time.thread_time()
            changed = self._read_if_changed()
            wait = min(max(_POLL, (time.thread_time() - begin) / READING_SHARE), _LONGEST_WAIT)
            now = time.monotonic()
            if not changed and now < next_look:
                continue
            next_look = now + _SIGN_OF_LIFE
            status = self._look()
            with self._changed:
                if changed or status != self.status:
                    self.status = status
                    self.revision += 1
                    self._changed.notify_all()

    def _read_if_changed(self) -> bool:
        try:
            if self._file.version() == self._version:
                return False
            self._read()
            self._message = ""
        except StudyError as error:  # It may come back: a disk that was full, a folder that was away.
            message = one_line(error)
            changed, self._message = message != self._message, message
            return changed
        return True

    def _read(self) -> None:
        version = self._file.version()
        self._search, self._interventions = self._study.search, tuple(self._file.last_interventions(_LISTED))
        earlier, outcomes, outcome_mark = self._file.outcomes_since(self._outcome_mark)
        stay, trials, trial_mark = self._file.trials_since(self._trial_mark)
        driven = self._file.drives(after=self.driven[-1].number if self.driven else 0)
        with self._changed:
            self.driven += driven
            if earlier == 0:
                self._finished.clear()
                self._ends.clear()
                self._failures.clear()
                self._failure_of.clear()
            for (point, _), outcome, finished in outcomes:
                self._ends[outcome.end] += 1
                self._finished.append(finished)
                if outcome.failed:
                    self._failures[outcome.message] += 1
                    self._failure_of.setdefault(point, outcome.message)
            if self.trials[stay:] != trials:
                self._stayed[self.revision + 1] = stay + _equal(self.trials[stay:], trials)
                if len(self._stayed) > _REVISIONS:
                    self._oldest = next(iter(self._stayed))
                    del self._stayed[self._oldest]
            self.trials[stay:] = trials
            self._judge()
            self._first_trial = {m: k for m, k in self._first_trial.items() if k < stay}
            for number, trial in enumerate(trials, stay):
                if trial.kind == FAILED:
                    self._first_trial.setdefault(self._failure_of.get(trial.point, ""), number)
            self._trial_mark, self._outcome_mark, self._version = trial_mark, outcome_mark, version

    def _judge(self) -> None:
        """Find the trials in forbidden regions, and the Pareto front of the others."""
        allows = self._search.allows
        trials = self.trials if self._search.forbidden else []
        self._excluded = [k for k, trial in enumerate(trials) if not allows(trial.point)]
        if self._qualities > 1:
            excluded = set(self._excluded)
            numbers = [k for k, trial in enumerate(self.trials) if trial.counts and k not in excluded]
            values = np.array([self.trials[k].values for k in numbers]).reshape(len(numbers), self._qualities)
            front = [number for number, best in zip(numbers, undominated(self._signs * values), strict=True) if best]
            self._front = sorted(front, key=lambda k: self.trials[k].values[0])

    def _look(self) -> Status:
        try:
            last, running = self._file.last_session(), self._file.is_running
            if self._file.path is not None and _identity(self._file.path) != self._identity:
                self._message = f"{self._file.path} has been removed or replaced: open it again"
        except StudyError as error:
            self._message, last, running = one_line(error), None, False
        if running:
            state = "running"
        elif last is None:
            state = "new"
        else:
            state = "died" if last["ended"] is None else "ended"
        failures = [(m[:_TEXT], count, self._first_trial.get(m)) for m, count in self._failures.most_common(_FAILURES)]
        reason = str(last["reason"] or "") if last is not None else ""
        ends = dict(self._ends)
        rate = self._rate() if running else None
        return Status(
            state=state,
            reason=reason,
            message=self._message,
            rollouts=sum(ends.values()),
            ends=ends,
            rate=rate,
            failures=tuple(failures),
            search=self._search,
            interventions=self._interventions,
        )

    def _rate(self) -> float | None:
        last = self._finished[-_RATE_OVER:]
        since = (last[-1] - last[0]).total_seconds() if last else 0.0
        return (len(last) - 1) / since if since > 0.0 else None


def _equal(before: Sequence[Trial], after: Sequence[Trial]) -> int:
    """Return the number of trials at the beginning that are equal."""
    return next(
        (k for k, (a, b) in enumerate(zip(before, after, strict=False)) if a != b), min(len(before), len(after))
    )


def _identity(path: Path) -> tuple[int, int] | None:
    """Return the numbers that tell a file from another one at its place; None if there is none."""
    try:
        stat = path.stat()
    except OSError:
        return None
    return stat.st_dev, stat.st_ino


def place(parameter: Dimension, value: Any) -> Any:
    """Return the value of a parameter, of a choice the number of the option; None if there is no such option.

    Args:
        parameter: The parameter, or a choice.
        value: Its value in a trial.
    """
    if not isinstance(parameter, Choice):
        return value
    option = parameter.as_value(value)
    return parameter.options.index(option) if option in parameter.options else None
