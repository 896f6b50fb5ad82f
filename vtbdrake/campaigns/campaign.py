"""Campaigns: the rollouts of a scenario under several conditions and seeds, judged by criteria, in one study file."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from vtbdrake.campaigns.results import ALL, CampaignResult, CampaignRollout, RolloutName
from vtbdrake.common.argument_checks import as_result
from vtbdrake.common.failures import FAILURES, error_text
from vtbdrake.common.settings import setting
from vtbdrake.optimization import Motion, Problem, Study
from vtbdrake.optimization.problem import PLANT_STATE
from vtbdrake.optimization.problem_file import StatedConstraint, StatedRollouts
from vtbdrake.optimization.sweep import borrowed
from vtbdrake.rollout import Constraint, Executor, Quality, RolloutResult
from vtbdrake.rollout.executor import run_rollouts
from vtbdrake.rollout.named_function import LIBRARY, largest, named_function
from vtbdrake.rollout.testbeds import split
from vtbdrake.testbed import load_scenario
from vtbdrake.testbed.settings_file import scenario_beside

ATTRIBUTE = "campaign"
"""The attribute of a study that names its rollouts and criteria."""


class CampaignError(ValueError):
    """The file of a campaign cannot be used, or its study belongs to another campaign."""


@dataclass
class Criterion(StatedConstraint):
    """A number that is read of every rollout, with the limits that it has to keep, and how often.

    Without a limit the number is only reported.
    """

    rate: float = setting(
        1.0,
        "The share of rollouts that has to be shown to pass: the lower limit of its one-sided interval of Clopper and "
        "Pearson is at least this. With 1, every rollout has to pass.",
        gt=0.0,
        le=1.0,
    )
    confidence: float = setting(0.95, "The confidence of the interval.", gt=0.0, lt=1.0)
    over: str = setting(
        "condition",
        "Whether each condition is judged, or all conditions together.",
        choices=("condition", "all"),
    )
    conditions: list[str] = setting(default_factory=list, doc="The conditions that are judged; by default all.")

    @property
    def addresses(self) -> list[str]:
        """Return the addresses of the variables."""
        return [self.of] if isinstance(self.of, str) else list(self.of)

    @property
    def is_limited(self) -> bool:
        """Return whether rollouts can fail the criterion."""
        return self.at_most is not None or self.at_least is not None

    def passes(self, value: float) -> bool:
        """Return whether a number keeps the limits."""
        return not (
            (self.at_most is not None and value > self.at_most) or (self.at_least is not None and value < self.at_least)
        )

    def constraint(self) -> Constraint:
        """Return the constraint whose violation is the number, or its negative: the limits do not change a study."""
        limit = {"at_least": 0.0} if self.is_lower else {"at_most": 0.0}
        return Constraint(self.function(), of=self.addresses, reading=self.reading, unit=self.unit, **limit)

    def value(self, violation: float) -> float:
        """Return the number of a violation of `constraint`."""
        return (-violation if self.is_lower else violation) + 0.0


@dataclass
class Seeds:
    """The seeds of a campaign; every condition is simulated with each of them."""

    first: int = setting(0, "The first seed.", ge=0)
    count: int = setting(1, "The number of seeds. A campaign may get more of them later.", ge=1)
    set: list[str] = setting(
        default_factory=list,
        doc="The addresses of variables, and fields scenario.<field>, that are set to the seed.",
    )
    draw: str = setting(
        "", "A function package.module:function of the seed that returns what is set, {address: value}, instead."
    )

    @property
    def numbers(self) -> range:
        """Return all seeds."""
        return range(self.first, self.first + self.count)


@dataclass
class Stop:
    """The end of a rollout before the horizon: as soon as f exceeds a threshold."""

    of: str | list[str] = setting(default_factory=list, doc="The variables that f is a function of.")
    f: str = setting("", "The function of their values, package.module:function, at least 0; by default the value.")
    above: float = setting(0.0, "The threshold that ends the rollout.", ge=0.0)


@dataclass
class Campaign(StatedRollouts):
    """A campaign as its file states it: every condition is simulated with every seed, and judged by every criterion."""

    noun, example, error = "campaign", "scenario, conditions and criteria", CampaignError

    seeds: Seeds = field(default_factory=Seeds)
    criteria: dict[str, Criterion] = setting(default_factory=dict, doc="The criteria by their names.")
    stop: Stop | None = setting(None, "When a rollout ends before the horizon.")
    record: list[str] = setting(
        default_factory=list, doc="Further addresses in the log of a rollout that is run again."
    )

    # -- what it states

    @property
    def rollout_names(self) -> list[RolloutName]:
        """Return condition and seed of all rollouts; further seeds come behind."""
        return [(name, seed) for seed in self.seeds.numbers for name in self.conditions]

    @property
    def functions(self) -> list[str]:
        names = [criterion.f for criterion in self.criteria.values()]
        names += [self.seeds.draw, self.stop.f if self.stop is not None else ""]
        return [name for name in names if name not in ("", *LIBRARY)]

    @cached_property
    def problem(self) -> Problem:
        """Return the problem without parameters whose conditions are the rollouts, and whose constraints the criteria.

        Raises:
            ValueError: The scenario, an address, a value or a function does not exist or does not fit.
        """
        self._check()
        common, _ = split(self.values)
        scenario = load_scenario(scenario_beside(self.path, self.scenario)).with_fields(common)
        stop = self.stop
        if stop is None:
            quality = Quality(_elapsed, of="time")
        else:
            quality = Quality(named_function(stop.f) if stop.f else largest, of=stop.of)
        constraints = []
        for name, criterion in self.criteria.items():
            try:
                constraints.append(criterion.constraint())
            except ValueError as error:
                raise CampaignError(f"criteria.{name}: {error}") from error
        return Problem(
            scenario=scenario,
            parameters=[],
            quality=quality,
            threshold=None if stop is None else stop.above,
            horizon=self.horizon,
            sample_period=self.sample_period,
            constraints=constraints,
            conditions=self._all_values(),
        )

    def _all_values(self) -> list[dict[str, Any]]:
        """Return the values that each rollout sets, address -> value."""
        _, common = split(self.values)
        by_seed = {seed: self._seed_values(seed) for seed in self.seeds.numbers}
        all_values = []
        for name, seed in self.rollout_names:
            condition = {**common, **self.conditions[name]}
            if both := sorted(condition.keys() & by_seed[seed].keys()):
                raise CampaignError(
                    f"{', '.join(both)} is set by the seeds, and by the condition {name!r} or by values"
                )
            all_values.append({**condition, **by_seed[seed]})
        return all_values

    def _seed_values(self, seed: int) -> dict[str, Any]:
        if not self.seeds.draw:
            return dict.fromkeys(self.seeds.set, seed)
        draw = named_function(self.seeds.draw)
        try:
            drawn = draw(seed)
        except FAILURES as error:
            raise CampaignError(f"seeds.draw: {self.seeds.draw}({seed}) raises {error_text(error)}") from error
        if not isinstance(drawn, Mapping):
            raise CampaignError(f"seeds.draw: {self.seeds.draw} returns {{address: value}}, not {drawn!r}")
        return dict(drawn)

    def _check(self) -> None:
        """Refuse what the types allow and a campaign cannot be."""
        if not self.scenario:
            raise CampaignError("a campaign has a scenario: package.module:Class")
        for noun, parts in (("conditions", self.conditions), ("criteria", self.criteria)):
            if not parts:
                raise CampaignError(
                    f"a campaign has {noun}, by their names; {{}} is the condition that changes nothing"
                )
            for name in parts:
                if not name or "/" in name or name == ALL:
                    raise CampaignError(f"{noun} have names without a slash, other than {ALL!r}, not {name!r}")
        if self.seeds.set and self.seeds.draw:
            raise CampaignError("seeds are set at addresses (set) or given to a function (draw), not both")
        if self.seeds.count > 1 and not (self.seeds.set or self.seeds.draw):
            raise CampaignError(
                f"{self.seeds.count} seeds change nothing: name the addresses that are set to them (set), or a "
                "function that draws what is set (draw)"
            )
        for name, criterion in self.criteria.items():
            if unknown := [c for c in criterion.conditions if c not in self.conditions]:
                raise CampaignError(
                    f"criteria.{name}.conditions: there is no condition {unknown[0]!r}; there are: "
                    f"{', '.join(self.conditions)}"
                )
            both = criterion.at_most is not None and criterion.at_least is not None
            if both and criterion.reading in ("worst", "best"):
                raise CampaignError(
                    f"criteria.{name}: at_most and at_least have different {criterion.reading} numbers: make two "
                    "criteria of it, or read it at the end"
                )

    # -- running it

    def run(
        self,
        study: str | os.PathLike[str] | None = None,
        *,
        executor: str | Executor = "auto",
        workers: int | None = None,
        seconds: float | None = None,
        time_limit: float | None = None,
        on_error: str = "record",
        allow_changed_code: bool = False,
        progress: bool = True,
    ) -> CampaignResult:
        """Run the rollouts that are not in the study yet, and return the results.

        Args:
            study: The study file, which is created or resumed; None keeps the study in memory.
            executor: See `Problem.sweep`.
            workers: See `Problem.sweep`.
            seconds: The longest wall time of this run; the rest of the rollouts remains to be run.
            time_limit: See `Study.run`.
            on_error: See `Study.run`.
            allow_changed_code: See `Problem.study`.
            progress: See `Study.run`.

        Raises:
            CampaignError: The study is of another campaign.
            StudyError: The study cannot be used, or was made with other code.
        """
        if study is not None and Path(study).exists():
            self._refuse_other_rollouts(Path(study))
        with self.problem.study(
            study, solver="grid", allow_changed_code=allow_changed_code, more_conditions=True
        ) as opened:
            names = [list(name) for name in self.rollout_names]
            stated = {"rollouts": names, "criteria": {name: asdict(c) for name, c in self.criteria.items()}}
            opened.set_attribute(ATTRIBUTE, stated)
            if len(opened) < len(names):
                opened.run(
                    rollouts=len(names),
                    seconds=seconds,
                    racing=False,
                    executor=executor,
                    workers=workers,
                    time_limit=time_limit,
                    on_error=on_error,
                    progress=progress,
                )
            return self._result(opened, self.rollout_names)

    def baseline(self, study: str | os.PathLike[str]) -> CampaignResult:
        """Return the results in the study of another campaign, judged by the criteria of this one.

        Raises:
            CampaignError: It is no campaign's, or has other rollouts or criteria.
            StudyError: The file is no study.
        """
        path = Path(study)
        with Study.open(path) as opened:
            stated = opened.attributes.get(ATTRIBUTE)
            if stated is None:
                raise CampaignError(f"{path} is a study, but not one of a campaign")
            names = [(condition, seed) for condition, seed in stated["rollouts"]]
            criteria = {name: Criterion(**values) for name, values in stated["criteria"].items()}
            self._check_pairs(path, names, criteria)
            return self._result(opened, names, columns=list(stated["criteria"]))

    def check_pairs(self, other: Campaign) -> None:
        """Check that every rollout and criterion has its counterpart in another campaign.

        Raises:
            CampaignError: One has none, or is read in another way.
        """
        self._check_pairs(other.path, other.rollout_names, other.criteria)

    def _check_pairs(self, path: Path, names: Sequence[RolloutName], criteria: Mapping[str, Criterion]) -> None:
        _refuse_differences(path, "rollouts", map(_text, names), map(_text, self.rollout_names))
        _refuse_differences(path, "criteria", criteria, self.criteria)
        for name, criterion in self.criteria.items():
            other = criteria[name]
            if (other.reading, other.is_lower) != (criterion.reading, criterion.is_lower):
                raise CampaignError(
                    f"{path}: the criterion {name!r} is read in another way there ({other.reading}, "
                    f"{'at_least' if other.is_lower else 'at_most'}), so that its numbers cannot be compared"
                )

    def _result(
        self, study: Study, names: Sequence[RolloutName], columns: Sequence[str] | None = None
    ) -> CampaignResult:
        outcomes = study.rollouts
        order = list(self.criteria) if columns is None else columns
        rollouts = []
        for number, (condition, seed) in enumerate(names):
            outcome = outcomes.get(((), number))
            measures = dict(zip(order, outcome.measures, strict=False)) if outcome is not None else {}
            rollouts.append(
                CampaignRollout(
                    condition=condition,
                    seed=seed,
                    end="" if outcome is None else outcome.end,
                    message="" if outcome is None else outcome.message,
                    values={name: c.value(measures[name]) for name, c in self.criteria.items() if name in measures},
                )
            )
        return CampaignResult(self, tuple(rollouts))

    def _refuse_other_rollouts(self, path: Path) -> None:
        """Refuse a study of rollouts that are not the first ones of this campaign; its own message lists them all."""
        with Study.open(path) as opened:
            stated, described = opened.attributes.get(ATTRIBUTE), opened.record["problem"]["conditions"]
        if stated is None:
            raise CampaignError(f"{path} is not the study of a campaign: give another file, or another folder")
        names = [(condition, seed) for condition, seed in stated["rollouts"]][: len(described)]
        remedy = "give another folder, or remove the study"
        if names != self.rollout_names[: len(names)]:
            raise CampaignError(
                f"{path} has other rollouts, {len(names)} from {_text(names[0])} to {_text(names[-1])}: a campaign may "
                f"get more seeds, but neither fewer nor other conditions; {remedy}"
            )
        for name, theirs, ours in zip(names, described, self.problem.conditions, strict=False):
            plain = {address: np.asarray(value).tolist() for address, value in ours.items()}
            if plain != theirs:
                different = sorted(a for a in {*plain, *theirs} if plain.get(a) != theirs.get(a))
                raise CampaignError(
                    f"{path} was made with other values of {', '.join(different)} in {_text(name)}: {remedy}"
                )

    def run_again(self, condition: str, seed: int, *, executor: str | Executor = "serial") -> Rerun:
        """Run one rollout alone, and record what its criteria look at.

        Args:
            condition: The name of its condition.
            seed: Its seed.
            executor: See `Problem.sweep`.

        Raises:
            CampaignError: There is no such rollout.
        """
        if (condition, seed) not in self.rollout_names:
            raise CampaignError(
                f"there is no rollout {condition}/{seed}: the conditions are {', '.join(self.conditions)}, the seeds "
                f"{self.seeds.numbers[0]} to {self.seeds.numbers[-1]}"
            )
        problem, addresses = self.problem, [a for c in self.criteria.values() for a in c.addresses]
        state = [PLANT_STATE] if problem.testbed.plant is not None else []
        record = tuple(dict.fromkeys([*addresses, *self.record, *state]))
        values = problem.values((), condition=self.rollout_names.index((condition, seed)))
        task = replace(problem.task, record=record, catch=True)
        with borrowed(problem, executor, rollouts=1) as opened:
            (result,) = run_rollouts(opened, task, [values], progress=False)
        if result is None:
            raise KeyboardInterrupt
        numbers = {
            name: criterion.value(violation)
            for (name, criterion), violation in zip(self.criteria.items(), result.measures, strict=False)
        }
        rollout = CampaignRollout(condition, seed, result.end, result.message, numbers)
        motion = None
        if state and len(result.times) > 1:
            scenario = problem.scenario.with_fields(split(values)[0])
            motion = Motion(scenario, result.times, result.record[PLANT_STATE])
        return Rerun(rollout, result, motion, {name: self._samples(c, result) for name, c in self.criteria.items()})

    def _samples(self, criterion: Criterion, result: RolloutResult) -> np.ndarray:
        columns = [result.record.get(address, ()) for address in criterion.addresses]
        try:
            return np.array([as_result(criterion.function()(*row)) for row in zip(*columns, strict=True)])
        except FAILURES:  # It has failed the rollout, whose message names it.
            return np.array([])


@dataclass(frozen=True, eq=False)
class Rerun:
    """A rollout of a campaign that was run again, alone.

    Attributes:
        rollout: Its numbers, as in the campaign.
        result: The result, with its record.
        motion: The motion of the simulated world; None if there is no plant, or no motion.
        samples: By criterion the samples of f at the times of the result, shape (n,).
    """

    rollout: CampaignRollout
    result: RolloutResult
    motion: Motion | None
    samples: Mapping[str, np.ndarray]

    def first_violation(self, name: str, criterion: Criterion) -> float | None:
        """Return the time in s at which a criterion that holds all the time is violated first; None if it is not.

        Args:
            name: Name of the criterion, a key of ``samples``.
            criterion: The criterion itself.
        """
        samples = self.samples[name]
        wrong = [k for k, sample in enumerate(samples) if not criterion.passes(float(sample))]
        return float(self.result.times[wrong[0]]) if wrong and criterion.reading == "worst" else None


def _elapsed(time: float) -> float:
    """Return the simulation's clock: the quality of a rollout that only its criteria judge."""
    return time


def _text(name: RolloutName) -> str:
    return f"{name[0]}/{name[1]}"


def _refuse_differences(path: Path, noun: str, theirs: Any, ours: Any) -> None:
    theirs, ours = list(theirs), list(ours)
    here, there = set(ours), set(theirs)
    lacks, has = [n for n in ours if n not in there], [n for n in theirs if n not in here]
    if lacks or has:
        parts = [f"lacks {', '.join(lacks[:5])}"] * bool(lacks) + [f"has {', '.join(has[:5])}"] * bool(has)
        raise CampaignError(
            f"{path} has other {noun} than the campaign, so that there are no pairs: it {'; it '.join(parts)}"
        )
