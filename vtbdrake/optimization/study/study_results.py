"""What a study has found: the best point, the Pareto front, a table of the points, and a summary in words."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np

from vtbdrake.common.argument_checks import counted
from vtbdrake.optimization.identity import unreadable_text
from vtbdrake.optimization.parameter import point_text, short_address
from vtbdrake.optimization.pareto import undominated
from vtbdrake.optimization.records import Outcome, RolloutKey, Trial
from vtbdrake.optimization.study.study_file import StudyFile
from vtbdrake.optimization.study.study_search import StudySearch


class StudyResults:
    """The results of a study as its file has them now: trials and rollouts are read once, when they are needed.

    Args:
        file: The file of the study.
        meta: The description of the study, see `StudyFile.meta`.
        search: The search as the interventions so far leave it.
    """

    def __init__(self, file: StudyFile, meta: Mapping[str, Any], search: StudySearch) -> None:
        self._file = file
        self._meta = meta
        self._search = search

    @cached_property
    def _trials(self) -> list[Trial]:
        return self._file.trials()

    @cached_property
    def _outcomes(self) -> dict[RolloutKey, Outcome]:
        return self._file.outcomes()

    @property
    def _names(self) -> tuple[str, ...]:
        return distinct_names(self._meta["problem"]["qualities"])

    def best(self) -> Trial:
        """Return the best point that keeps all constraints and lies in no forbidden region; see `Study.best`.

        Raises:
            ValueError: There are several qualities, or no point has a value and keeps the constraints.
        """
        if len(self._search.signs) > 1:
            raise ValueError("several qualities have no single best point: use pareto()")
        candidates = self._candidates()
        if not candidates:
            if not self._file.count():
                raise ValueError("no rollout is finished yet: call run()")
            feasible = " and keeps the constraints" if self._meta["problem"]["constraints"] else ""
            raise ValueError(f"no point has a quality{feasible}{self._failures()}")
        (sign,) = self._search.signs
        return max(candidates, key=lambda trial: sign * trial.value)

    def pareto(self) -> tuple[Trial, ...]:
        """Return the points that no other point beats in one quality without losing in another."""
        candidates, signs = self._candidates(), self._search.signs
        values = np.array([trial.values for trial in candidates]).reshape(len(candidates), len(signs))
        front = undominated(np.array(signs) * values)
        return tuple(trial for trial, best in zip(candidates, front, strict=True) if best)

    def _candidates(self) -> list[Trial]:
        return [trial for trial in self._trials if trial.counts and self._search.allows(trial.point)]

    def columns(self) -> dict[str, list[Any]]:
        """Return columns by name, one entry per trial; see `Study.to_dict`."""
        trials = self._trials
        addresses = [parameter.address for parameter in self._search.widest]
        columns: dict[str, list[Any]] = {address: [t.parameters[address] for t in trials] for address in addresses}
        for k, name in enumerate(self._names):
            columns[name if name not in columns else f"{name} {k}"] = [t.values[k] for t in trials]
        for k, constraint in enumerate(self._meta["problem"]["constraints"]):
            name = f"violation of {constraint['name']}"
            columns[name if name not in columns else f"{name} {k}"] = [t.violations[k] for t in trials]
        for name in ("feasible", "exact", "origin", "method", "batch"):
            columns[name] = [getattr(trial, name) for trial in trials]
        for key in dict.fromkeys(key for trial in trials for key in trial.attributes):
            columns[f"attribute {key}"] = [trial.attributes.get(key) for trial in trials]
        return columns

    def summary(self, ended: str) -> str:
        """Return a text with the progress, the results and the errors.

        Args:
            ended: Why the last run ended, in a sentence; empty before the first.
        """
        changes = self._meta.get("changes", [])
        lines = [
            self._progress(),
            *(f"the code changed on {change['at'][:10]}: {'; '.join(change['what'])}" for change in changes),
            unreadable_text(self._meta["problem"]),
            f"ended: {ended}" if ended else "",
            self._result(),
            self._dropped(),
            self._times(),
        ]
        return "\n".join(line for line in lines if line)

    def _progress(self) -> str:
        methods = Counter(trial.method for trial in self._trials)
        parallel = self._meta.get("parallel")
        width = "" if parallel is None else f", {parallel} rollouts side by side"
        return (
            f"{counted(len(self._trials), 'point')}, {counted(len(self._outcomes), 'rollout')}; solver "
            f"{self._meta['solver']}, seed {self._meta['seed']}{width}: "
            + ", ".join(f"{method} ({count})" for method, count in methods.items())
        )

    def _result(self) -> str:
        """Return the best point, or the size of the Pareto front, in a line."""
        if len(self._search.signs) > 1:
            return f"Pareto front of {counted(len(self.pareto()), 'point')}"
        try:
            best = self.best()
        except ValueError as error:
            return f"best: {error}"
        point = point_text(self._search.widest, best.point, self._meta["units"])
        return f"best: {self._names[0]} = {best.value:g} at {point}"

    def _dropped(self) -> str:
        """Return the number of points that racing dropped, in a line; empty if it dropped none."""
        dropped = sum(not trial.exact for trial in self._trials)
        if not dropped:
            return ""
        saved = len(self._trials) * len(self._meta["problem"]["conditions"]) - len(self._outcomes)
        return (
            f"racing dropped {counted(dropped, 'point')} before all conditions had run, "
            f"{counted(saved, 'rollout')} less"
        )

    def _times(self) -> str:
        """Return the times that rollouts took and their ends, in a line; empty before the first."""
        outcomes = self._outcomes.values()
        ends = Counter(outcome.end for outcome in outcomes)
        times = sorted(outcome.wall_time for outcome in outcomes if outcome.wall_time == outcome.wall_time)
        if not times:
            return ""
        return (
            f"rollouts took {sum(times):.3g} s in all, the median {times[len(times) // 2]:.3g} s; they ended by "
            + ", ".join(f"{end} ({count})" for end, count in ends.items())
            + self._failures()
        )

    def _failures(self) -> str:
        messages = [outcome.message for outcome in self._outcomes.values() if outcome.failed]
        if not messages:
            return ""
        first = "" if len(set(messages)) == 1 else ", the first"
        return f"; {counted(len(messages), 'rollout')} failed{first}: {messages[0]}"


def distinct_names(qualities: Sequence[Mapping[str, Any]]) -> tuple[str, ...]:
    """Return the names of the functions; with what they read where names alone are equal, and at last with numbers."""
    names = tuple(str(quality["name"]) for quality in qualities)
    if len(set(names)) == len(names):
        return names
    addresses = {address for quality in qualities for address in quality["of"]}
    read = [", ".join(short_address(address, addresses) for address in quality["of"]) for quality in qualities]
    names = tuple(f"{name} of {variables}" for name, variables in zip(names, read, strict=True))
    if len(set(names)) == len(names):
        return names
    names = tuple(f"{name} ({quality['reading']})" for name, quality in zip(names, qualities, strict=True))
    return names if len(set(names)) == len(names) else tuple(f"{name} {k}" for k, name in enumerate(names, 1))
