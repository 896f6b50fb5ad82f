"""What a study knows: its points and rollouts, the best of them, pictures and exports."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from vtbdrake.optimization.identity import dimensions
from vtbdrake.optimization.outcome import Outcome, Row, Trial
from vtbdrake.optimization.parameter import Dimension
from vtbdrake.optimization.solvers.solver import Point
from vtbdrake.optimization.study_file import StudyFile, TrialRow

if TYPE_CHECKING:
    import optuna
    import pandas
    from matplotlib.figure import Figure
    from optuna.storages import BaseStorage


class StudyRecord:
    """What can be read of a study; it reads the file anew each time, and sees what another process adds.

    Attributes:
        reason, message: why the last run in this process ended, in a word and in a sentence; empty before the first.
    """

    def __init__(self, file: StudyFile) -> None:
        self._file = file
        self._meta = file.meta
        self.reason = ""
        self.message = ""

    def close(self) -> None:
        """Closes the file."""
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def to_optuna(self, storage: str | BaseStorage, name: str) -> optuna.Study:
        """Writes the study into Optuna's storage, for ``optuna-dashboard <storage>``, Optuna's plots and importances.

        Every point becomes a trial: complete; failed, where a simulation failed; or pruned, where racing dropped it.
        Values, t*, ends and times of its rollouts are its user attributes, what the study is about those of the study.
        Writing it again adds the points that are new.

        Args:
            storage: a URL, such as ``sqlite:///study.db``, or a storage of Optuna's.
            name: the name of the study there.

        Raises:
            ModuleNotFoundError: Optuna is not installed.
            StudyError: the storage cannot be opened, or has another study of that name.
        """
        from vtbdrake.optimization.optuna_bridge import to_optuna

        return to_optuna(self, storage, name=name)

    @property
    def path(self) -> Path | None:
        """The path of the file; None if the study is in memory."""
        return self._file.path

    @property
    def parameters(self) -> tuple[Dimension, ...]:
        """The parameters that are varied."""
        return dimensions(self._meta["problem"])

    @property
    def units(self) -> tuple[str, ...]:
        """The units of the parameters, see `Problem.units`."""
        return tuple(self._meta["units"])

    @property
    def directions(self) -> tuple[str, ...]:
        """``maximize`` or ``minimize`` for each quality."""
        return tuple(
            "minimize" if quality["minimize"] else "maximize" for quality in self._meta["problem"]["qualities"]
        )

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the qualities."""
        return tuple(quality["name"] for quality in self._meta["problem"]["qualities"])

    @property
    def record(self) -> dict[str, Any]:
        """What the study is about: the problem, the scenario, the solver, the seed, the versions, the git revision, and
        the ``changes`` of the code that were allowed."""
        return dict(self._meta)

    @property
    def trials(self) -> tuple[Trial, ...]:
        """All judged points, as they are in the file now."""
        attributes = self._file.attributes()
        return tuple(self._trial(number, row, attributes) for number, row in enumerate(self._file.trials()))

    def _trials_of(self, batch: int) -> tuple[Trial, ...]:
        """The trials that were judged last in a batch."""
        first, rows = self._file.trials_of(batch)
        attributes = self._file.attributes()
        return tuple(self._trial(first + k, row, attributes) for k, row in enumerate(rows))

    def _trial(self, number: int, row: TrialRow, attributes: Mapping[Point | None, Mapping[str, Any]]) -> Trial:
        batch, _, point, values, violations, exact, origin, method = row
        own = dict(attributes.get(point, {}))
        return Trial(number, self._by_address(point), values, violations, exact, origin, method, batch, own)

    def _by_address(self, point: Point) -> dict[str, Any]:
        return {parameter.address: value for parameter, value in zip(self.parameters, point, strict=True)}

    @property
    def queue(self) -> dict[int, dict[str, Any]]:
        """The points given by hand that are not judged yet: number -> the point, address -> value."""
        return {number: self._by_address(point) for number, point in self._file.queue().items()}

    @property
    def attributes(self) -> dict[str, Any]:
        """The attributes of the study, see `Study.set_attribute`; those of a point are `Trial.attributes`."""
        return self._file.attributes().get(None, {})

    @property
    def rollouts(self) -> dict[Row, Outcome]:
        """All finished rollouts by (point, number of the condition), as they are in the file now."""
        return self._file.outcomes()

    @property
    def finished(self) -> dict[Row, datetime]:
        """When each rollout was finished, in UTC."""
        return self._file.finished()

    def __len__(self) -> int:
        """Return the number of finished rollouts."""
        return self._file.count()

    @property
    def best(self) -> Trial:
        """s^0*, equation (18), among the points examined: the best that keeps all constraints.

        Raises:
            ValueError: there are several qualities, or no point has a value and keeps the constraints.
        """
        if len(self.directions) > 1:
            raise ValueError("of several qualities there is no best point: ask for pareto()")
        found = [trial for trial in self.trials if trial.counts]
        if not found:
            kept = " and keeps the constraints" if self._meta["problem"]["constraints"] else ""
            raise ValueError(f"no point has a quality{kept}{self._why()}")
        sign = self.signs[0]
        return max(found, key=lambda trial: sign * trial.value)

    def pareto(self) -> tuple[Trial, ...]:
        """The points that no other point beats in one quality without losing in another."""
        found = [trial for trial in self.trials if trial.counts]
        signed = {t.number: [s * v for s, v in zip(self.signs, t.values, strict=True)] for t in found}
        return tuple(t for t in found if not any(_dominates(signed[o.number], signed[t.number]) for o in found))

    @property
    def signs(self) -> tuple[float, ...]:
        """1 for a quality, -1 for a cost."""
        return tuple(-1.0 if direction == "minimize" else 1.0 for direction in self.directions)

    def _why(self) -> str:
        messages = Counter(o.message for o in self.rollouts.values() if o.end == "failed")
        return "".join(f"; {count} rollouts failed: {message}" for message, count in messages.most_common(1))

    def to_dict(self) -> dict[str, list[Any]]:
        """Columns by name, one entry per trial.

        The parameters by address, the qualities, the violations of the constraints, how the trial came about, and its
        attributes (None where it does not have one).
        """
        trials = self.trials
        columns: dict[str, list[Any]] = {d.address: [t.parameters[d.address] for t in trials] for d in self.parameters}
        for k, name in enumerate(self.names):
            columns[name if name not in columns else f"{name} {k}"] = [t.values[k] for t in trials]
        for k, constraint in enumerate(self._meta["problem"]["constraints"]):
            name = f"violation of {constraint['name']}"
            columns[name if name not in columns else f"{name} {k}"] = [t.violations[k] for t in trials]
        for name in ("feasible", "exact", "origin", "method", "batch"):
            columns[name] = [getattr(trial, name) for trial in trials]
        for key in dict.fromkeys(key for trial in trials for key in trial.attributes):
            columns[f"attribute {key}"] = [trial.attributes.get(key) for trial in trials]
        return columns

    def to_dataframe(self) -> pandas.DataFrame:
        """The columns of `to_dict` as a DataFrame, one row per trial; its index is `Trial.number`.

        Raises:
            ModuleNotFoundError: pandas is not installed.
        """
        try:
            import pandas
        except ModuleNotFoundError as error:
            raise ModuleNotFoundError("a DataFrame needs pandas: pip install 'vtbdrake[dataframe]'") from error
        return pandas.DataFrame(self.to_dict(), index=pandas.RangeIndex(len(self.trials), name="number"))

    def summary(self) -> str:
        """What was done, what came out, and what went wrong, to be read."""
        trials, outcomes = self.trials, self.rollouts
        methods = Counter(trial.method for trial in trials)
        lines = [
            f"{len(trials)} points, {len(outcomes)} rollouts; solver {self._meta['solver']}, seed "
            f"{self._meta['seed']}: " + ", ".join(f"{method} ({count})" for method, count in methods.items())
        ]
        for change in self._meta.get("changes", []):
            lines.append(f"the code changed on {change['at'][:10]}: {'; '.join(change['what'])}")
        if self.message:
            lines.append(f"ended: {self.message}")
        if len(self.directions) > 1:
            lines.append(f"Pareto front of {len(self.pareto())} points")
        else:
            try:
                best = self.best
                at = ", ".join(f"{address} = {value!r}" for address, value in best.parameters.items())
                lines.append(f"best: {self.names[0]} = {best.value:g} at {at}")
            except ValueError as error:
                lines.append(f"best: {error}")
        dropped = sum(not trial.exact for trial in trials)
        if dropped:
            saved = len(trials) * len(self._meta["problem"]["conditions"]) - len(outcomes)
            lines.append(f"racing dropped {dropped} points before all their conditions had run, {saved} rollouts less")
        ends = Counter(outcome.end for outcome in outcomes.values())
        times = sorted(outcome.wall_time for outcome in outcomes.values() if outcome.wall_time == outcome.wall_time)
        if times:
            lines.append(
                f"rollouts took {sum(times):.3g} s in all, the median {times[len(times) // 2]:.3g} s; they ended by "
                + ", ".join(f"{end} ({count})" for end, count in ends.items())
                + self._why()
            )
        return "\n".join(lines)

    def plot_history(self) -> Figure:
        """The values in the order of the study, and the best so far."""
        from vtbdrake.visualization import study_plots

        return study_plots.plot_history(self)

    def plot_landscape(self, *addresses: str) -> Figure:
        """The quality over one or two parameters (Figure 6); the best value at each where there are more."""
        from vtbdrake.visualization import study_plots

        return study_plots.plot_landscape(self, *addresses)

    def plot_slices(self) -> Figure:
        """The quality over every parameter, each alone."""
        from vtbdrake.visualization import study_plots

        return study_plots.plot_slices(self)

    def plot_importances(self) -> Figure:
        """How much each parameter decides about whether a point is among the best; needs the extra ``optuna``."""
        from vtbdrake.visualization import study_plots

        return study_plots.plot_importances(self)

    def plot_pareto(self) -> Figure:
        """Two qualities against each other, the Pareto front marked."""
        from vtbdrake.visualization import study_plots

        return study_plots.plot_pareto(self)


def _dominates(a: Sequence[float], b: Sequence[float]) -> bool:
    """Whether signed values ``a`` are nowhere worse than ``b``, and somewhere better."""
    return all(x >= y for x, y in zip(a, b, strict=True)) and any(x > y for x, y in zip(a, b, strict=True))
