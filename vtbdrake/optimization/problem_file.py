"""Problems in YAML: the testbed, what is varied, the qualities, the conditions, and how the problem is solved."""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Self

from vtbdrake.common.settings import schema, setting
from vtbdrake.optimization.parameter import Choice, Dimension, Parameter
from vtbdrake.optimization.problem import Problem
from vtbdrake.optimization.risk import make_risk
from vtbdrake.rollout import Constraint, Quality
from vtbdrake.rollout.executor_choice import NAMES
from vtbdrake.rollout.named_function import LIBRARY, named_function
from vtbdrake.rollout.quality import READINGS
from vtbdrake.rollout.testbeds import split
from vtbdrake.state import Snapshot
from vtbdrake.testbed import load_scenario
from vtbdrake.testbed.scenario_file import is_trusted
from vtbdrake.testbed.settings_file import Lines, read_settings, scenario_beside

if TYPE_CHECKING:
    from vtbdrake.optimization.study import Study

_FUNCTION = f"The function of their values, package.module:function, or one of {', '.join(LIBRARY)}"


class ProblemFileError(ValueError):
    """The file of a problem cannot be used."""


@dataclass
class Varied:
    """A parameter: its range, or the options of a choice."""

    lower: float | None = setting(None, "The lower end of the range, in the unit of the variable.")
    upper: float | None = setting(None, "The upper end of the range.")
    integer: bool = setting(False, "Only whole numbers are values.")
    log: bool = setting(False, "Search on a logarithmic scale.")
    options: list[Any] = setting(
        default_factory=list, doc="Instead of a range, the values of a choice: numbers, words, true or false."
    )

    def dimension(self, address: str) -> Dimension:
        """Return the parameter at an address.

        Raises:
            ValueError: It is neither a range nor a choice, or not a possible one.
        """
        if self.options:
            if self != Varied(options=self.options):
                raise ValueError(f"{address} has options or a range with lower and upper, not both")
            return Choice(address, self.options)
        if self.lower is None or self.upper is None:
            raise ValueError(f"{address} needs lower and upper, the ends of its range, or options")
        return Parameter(address, self.lower, self.upper, integer=self.integer, log=self.log)


@dataclass
class StatedQuality:
    """A quality f, larger is better; or a cost."""

    of: str | list[str] = setting(
        default_factory=list, doc="The variables or vector output ports (path.port) that f is a function of."
    )
    f: str = setting("magnitude", f"{_FUNCTION}.")
    minimize: bool = setting(False, "f is a cost: smaller is better.")
    reading: str = setting("best", "How the samples of f become one number.", choices=tuple(READINGS))
    upper: float = setting(inf, "An upper bound of f, with which racing can drop points.", gt=0.0, finite=False)
    unit: str = setting("", "The unit of f, for plots.")

    def quality(self) -> Quality:
        """Return the quality.

        Raises:
            ValueError: The function does not exist.
        """
        return Quality(
            named_function(self.f),
            self.of,
            minimize=self.minimize,
            reading=self.reading,
            upper=self.upper,
            unit=self.unit,
        )


@dataclass
class StatedConstraint:
    """A limit that every rollout has to keep."""

    of: str | list[str] = setting(
        default_factory=list, doc="The variables or vector output ports (path.port) that f is a function of."
    )
    f: str = setting("", f"{_FUNCTION}; by default the largest value, with at_least alone the smallest.")
    at_most: float | None = setting(None, "The largest number that is allowed.")
    at_least: float | None = setting(None, "The smallest number that is allowed.")
    reading: str = setting(
        "worst",
        "How the samples of f become one number; worst and best refer to the limit.",
        choices=tuple(READINGS),
    )
    unit: str = setting("", "The unit of f, for plots and reports.")

    @property
    def is_lower(self) -> bool:
        """Return whether the smallest number is the worst."""
        return self.at_least is not None and self.at_most is None

    def function(self) -> Callable[..., float]:
        """Return f.

        Raises:
            ValueError: It does not exist.
        """
        return named_function(self.f or ("smallest" if self.is_lower else "largest"))

    def constraint(self) -> Constraint:
        """Return the constraint.

        Raises:
            ValueError: The function does not exist, or there is no limit.
        """
        stated = {"at_most": self.at_most, "at_least": self.at_least}
        limits: dict[str, Any] = {name: limit for name, limit in stated.items() if limit is not None}
        return Constraint(self.function(), self.of, reading=self.reading, unit=self.unit, **limits)


@dataclass
class Solving:
    """The solver of a study; see `Problem.study`."""

    name: str | None = setting(None, "The name of the solver; by default auto, or the one of the study's file.")
    options: dict[str, Any] = setting(default_factory=dict, doc="Options of the solver.")
    seed: int | None = setting(None, "The seed of the solver; by default 0, or the one of the study's file.")
    parallel: int | None = setting(None, "Ask for enough points for this number of rollouts side by side.", ge=1)


@dataclass
class StudyBudget:
    """The end of a study: the first limit that is reached."""

    rollouts: int | None = setting(None, "The number of rollouts that the study has in the end.", ge=1)
    seconds: float | None = setting(None, "The wall time of a run.", unit="s", gt=0.0)
    target: float | None = setting(None, "The study ends when a point is at least as good.")


@dataclass
class Running:
    """How the rollouts are run; see `Study.run`."""

    executor: str = setting("auto", "Where rollouts run.", choices=NAMES)
    workers: int | None = setting(None, "The number of threads or processes; by default one per core.", ge=1)
    time_limit: float | None = setting(None, "A rollout that takes longer fails.", unit="s", gt=0.0)
    racing: bool | None = setting(
        None, "Drop points that can no longer win before all conditions have run; by default with several conditions."
    )
    on_error: str = setting(
        "record", "If f raises: record the rollout as failed, or end the run.", choices=("record", "raise")
    )


@dataclass
class StatedRollouts(ABC):
    """Rollouts as a file states them: the file of a problem, or of a campaign.

    Attributes:
        noun, example, error: Class attributes: a word for what the file states and some of its keys, in messages, and
            the class of its errors.
    """

    noun: ClassVar[str]
    example: ClassVar[str]
    error: ClassVar[type[ValueError]]

    scenario: str = setting("", "The scenario, package.module:Class or package.module:Class@FILE.yaml.")
    horizon: float = setting(10.0, "The horizon t_m: the longest duration of a rollout.", unit="s", gt=0.0)
    sample_period: float = setting(0.05, "The period of the samples of all functions.", unit="s", gt=0.0)
    values: dict[str, Any] = setting(
        default_factory=dict, doc="What is set in all rollouts: variables by address, and fields scenario.<field>."
    )
    conditions: dict[str, dict[str, Any]] = setting(
        default_factory=dict, doc="By the name of each condition, what is set under it, as in values."
    )
    path: Path = field(default=Path("stated.yaml"), init=False, repr=False)  # the file
    lines: Lines = field(default_factory=Lines, init=False, repr=False, compare=False)

    @property
    @abstractmethod
    def problem(self) -> Problem:
        """Return the problem.

        Raises:
            ValueError: The scenario, an address, a value or a function does not exist or does not fit.
        """

    @property
    @abstractmethod
    def functions(self) -> list[str]:
        """Return the functions ``package.module:function`` that the file names, whose modules are imported."""

    @classmethod
    def load(cls, path: str | os.PathLike[str], *, trusted: Sequence[str] | None = None) -> Self:
        """Read a file.

        The modules that the file names are imported, which runs their code.

        Args:
            path: The file.
            trusted: The only modules, or packages of them, that may be imported because the file names them, beside
                vtbdrake's and the ones that are imported already; None for all.

        Raises:
            ValueError: The file cannot be read, it names a module that is not trusted, or something in it cannot be
                used; with the line.
        """
        path = Path(path)
        stated, lines = read_settings(cls, path, noun=cls.noun, example=cls.example, error=cls.error)
        stated.path, stated.lines = path, lines
        try:
            if trusted is not None:
                stated._refuse_strangers(trusted)
            stated.check()
        except (ValueError, OSError) as error:
            raise cls.error(lines.message(error)) from error
        return stated

    def check(self) -> None:
        """Check scenario, addresses and functions, whose modules are imported.

        Raises:
            ValueError: As for `problem`, which is kept.
        """
        _ = self.problem

    def _refuse_strangers(self, trusted: Sequence[str]) -> None:
        for name in (scenario_beside(self.path, self.scenario).partition("@")[0], *self.functions):
            if ":" in name and not is_trusted(name, trusted=trusted):
                module = name.partition(":")[0]
                raise ValueError(
                    f"it names {name}, and importing its module runs its code: if you trust it, add --trust {module}"
                )

    @classmethod
    def schema(cls) -> dict[str, Any]:
        """Return the JSON Schema of the file."""
        return schema(cls)


@dataclass
class ProblemFile(StatedRollouts):
    """A problem as its file states it, and how it is solved.

    Attributes:
        solver: The solver of its study.
        budget: When the study ends.
        running: How the rollouts are run.
    """

    noun, example, error = "problem", "scenario, parameters and qualities", ProblemFileError

    parameters: dict[str, Varied] = setting(
        default_factory=dict, doc="What is varied: variables by address, and fields scenario.<field>."
    )
    qualities: list[StatedQuality] = setting(
        default_factory=list, doc="The quality, or several, which have a Pareto front."
    )
    threshold: float | None = setting(
        None, "The threshold f_m: a rollout ends when f exceeds it, or when a cost falls below it."
    )
    risk: str = setting(
        "worst",
        "How the qualities under several conditions become one: worst, mean, quantile:LEVEL or cvar:LEVEL.",
    )
    constraints: dict[str, StatedConstraint] = setting(default_factory=dict, doc="The constraints by their names.")
    start: str = setting("", "A file with a snapshot, which is s0 instead of the defaults.")
    solver: Solving = field(default_factory=Solving)
    budget: StudyBudget = field(default_factory=StudyBudget)
    running: Running = field(default_factory=Running)

    @property
    def functions(self) -> list[str]:
        names = [quality.f for quality in self.qualities] + [constraint.f for constraint in self.constraints.values()]
        return [name for name in names if name not in ("", *LIBRARY)]

    @cached_property
    def problem(self) -> Problem:
        if not self.scenario:
            raise ValueError("a problem has a scenario: package.module:Class")
        fields, common = split(self.values)
        at = self.lines.at
        with at("scenario"):
            scenario = load_scenario(scenario_beside(self.path, self.scenario))
        parameters, qualities, constraints = [], [], []
        for address, varied in self.parameters.items():
            with at(f"parameters.{address}"):
                parameters.append(varied.dimension(address))
        for number, quality in enumerate(self.qualities):
            with at(f"qualities.{number}"):
                qualities.append(quality.quality())
        for name, constraint in self.constraints.items():
            with at(f"constraints.{name}"):
                constraints.append(constraint.constraint())
        with at("risk"):
            risk = make_risk(self.risk)
        with at("start"):
            start = Snapshot.load(self.path.parent / self.start) if self.start else None
        with at("values"):
            scenario = scenario.with_fields(fields)
        return Problem(
            scenario=scenario,
            parameters=parameters,
            quality=qualities,
            horizon=self.horizon,
            threshold=self.threshold,
            sample_period=self.sample_period,
            conditions=[{**common, **condition} for condition in self.conditions.values()] or [common],
            risk=risk,
            constraints=constraints,
            start=start,
        )

    @property
    def study_arguments(self) -> dict[str, Any]:
        """Return the arguments of `Problem.study`."""
        solver = self.solver
        options = solver.options or None
        return {"solver": solver.name, "seed": solver.seed, "options": options, "parallel": solver.parallel}

    @property
    def run_arguments(self) -> dict[str, Any]:
        """Return the arguments of `Study.run`."""
        return {**asdict(self.budget), **asdict(self.running)}

    def run(self, path: str | os.PathLike[str] | None = None, *, progress: bool = True) -> Study:
        """Begin the study of the problem, or resume the one in ``path``, run it within the budget, and return it.

        Args:
            path: File of the study; None keeps it in memory.
            progress: Whether a progress bar is shown.
        """
        return self.problem.study(path, **self.study_arguments).run(**self.run_arguments, progress=progress)
