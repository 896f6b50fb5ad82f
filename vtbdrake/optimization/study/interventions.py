"""Interventions: what people change in a study while it runs, and the search that follows from their changes."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import ceil, floor, inf
from typing import TYPE_CHECKING, Any

import numpy as np

from vtbdrake.common.argument_checks import as_number, as_whole
from vtbdrake.optimization.identity import dimensions, plain
from vtbdrake.optimization.parameter import Choice, Dimension, Parameter
from vtbdrake.optimization.records import Intervention
from vtbdrake.optimization.solvers import Evaluation, Point, Solver, SolverError, make_solver
from vtbdrake.optimization.solvers.designs import Design
from vtbdrake.optimization.solvers.solver import rank_key

if TYPE_CHECKING:
    from vtbdrake.optimization.study.study_file import StudyFile

PAUSE = "pause"
RESUME = "resume"
STOP = "stop"
TRY = "try"
# What a person tells the process that runs the study; the points do not depend on these.
CONTROLS = (PAUSE, RESUME, STOP)

# The weight of the sum in an achievement scalarizing function: it makes every maximum Pareto optimal.
_AUGMENTATION = 1e-3

# A side of a box: the ends of an interval, of whole numbers or not, or a set of values without an order.
_Side = tuple[float, float] | frozenset[Any]


@dataclass(frozen=True)
class StudySearch:
    """The search of a study: as it was begun, or as its interventions have left it.

    Attributes:
        ranges: The parameters with the ranges that are searched, also those that are frozen.
        widest: The parameters with the widest ranges that the study has had; every point lies in them.
        frozen: The values of the parameters that are not varied at present, by address.
        forbidden: The forbidden regions by the number of their intervention: address -> [lower, upper], or the options
            of a choice; an end that is None is open.
        solver, options: The solver's name and options.
        budget: The number of rollouts that the study has in the end; None: no limit.
        budget_from: The number of the intervention that set the budget; None: `Study.run` set it.
        aspiration: The values that are aimed at, one per quality, a cost as a cost; None: the whole Pareto front.
        paused: Whether the study is paused.
        signs: By quality, 1, or -1 for a cost.
        limits: By parameter, the bounds that its range must not exceed; None for a choice.
        conditions: The number of conditions.
        constraints: The number of constraints.
        seed: The seed of the solver.
        parallel: The number of rollouts side by side that the solver asks points for, or None.
        solver_changed: Whether an intervention has changed the solver.
    """

    ranges: tuple[Dimension, ...]
    widest: tuple[Dimension, ...]
    solver: str
    options: Mapping[str, Any]
    budget: int | None
    signs: tuple[float, ...]
    limits: tuple[tuple[float, float] | None, ...] = field(repr=False)
    conditions: int = field(repr=False)
    constraints: int = field(repr=False)
    seed: int = field(repr=False)
    parallel: int | None = field(repr=False)
    frozen: Mapping[str, Any] = field(default_factory=dict)
    forbidden: Mapping[int, Mapping[str, Any]] = field(default_factory=dict)
    budget_from: int | None = None
    aspiration: tuple[float, ...] | None = None
    paused: bool = False
    solver_changed: bool = field(default=False, repr=False)

    @classmethod
    def of(cls, meta: Mapping[str, Any]) -> StudySearch:
        """Return the search with which a study begins, from the description in its file."""
        problem = meta["problem"]
        ranges = dimensions(problem)
        return cls(
            ranges=ranges,
            widest=ranges,
            solver=meta["solver"],
            options=meta["options"],
            budget=meta.get("budget"),
            signs=tuple(-1.0 if quality["minimize"] else 1.0 for quality in problem["qualities"]),
            limits=tuple(None if limits is None else (limits[0], limits[1]) for limits in meta["limits"]),
            conditions=len(problem["conditions"]),
            constraints=len(problem["constraints"]),
            seed=meta["seed"],
            parallel=meta.get("parallel"),
        )

    def after(self, interventions: Iterable[Intervention]) -> StudySearch:
        """Return the search after interventions, in their order.

        Raises:
            ValueError: One of them makes no sense at its place; the message names it.
        """
        search = self
        for intervention in interventions:
            try:
                search = _KINDS[intervention.kind](search, intervention.number, **intervention.payload)
            except (TypeError, ValueError) as error:
                raise ValueError(f"{intervention.kind} (intervention {intervention.number}): {error}") from error
        return search

    def same_points(self, other: StudySearch) -> bool:
        """Return whether another search differs in nothing but the budget and whether it is paused."""
        return replace(self, budget=None, budget_from=None, paused=False, widest=()) == replace(
            other, budget=None, budget_from=None, paused=False, widest=()
        )

    # -- its space

    @property
    def free(self) -> tuple[Dimension, ...]:
        """Return the parameters that are varied at present, with their ranges."""
        return tuple(parameter for parameter in self.ranges if parameter.address not in self.frozen)

    def complete(self, point: Point) -> Point:
        """Return a point of the free parameters, completed by the frozen ones."""
        values = iter(point)
        return tuple(self.frozen[p.address] if p.address in self.frozen else next(values) for p in self.ranges)

    def reduce(self, point: Point) -> Point:
        """Return the values of the free parameters at a point."""
        return tuple(x for p, x in zip(self.ranges, point, strict=True) if p.address not in self.frozen)

    def allows(self, point: Point) -> bool:
        """Return whether a point lies in no forbidden region."""
        if not self.forbidden:
            return True
        parameters = self.by_address
        values = dict(zip(parameters, point, strict=True))
        return not any(
            all(_contains(parameters[address], side, values[address]) for address, side in region.items())
            for region in self.forbidden.values()
        )

    def contains(self, point: Point) -> bool:
        """Return whether a point could be asked for: it lies in the ranges, has the frozen values, and is allowed."""
        for parameter, value in zip(self.ranges, point, strict=True):
            if parameter.address in self.frozen:
                if value != self.frozen[parameter.address]:
                    return False
            elif isinstance(parameter, Choice):
                if value not in parameter.options:
                    return False
            elif not parameter.lower <= value <= parameter.upper:
                return False
        return self.allows(point)

    @property
    def by_address(self) -> dict[str, Dimension]:
        """Return the parameters with the ranges that are searched, by address."""
        return {parameter.address: parameter for parameter in self.ranges}

    def parameter(self, address: Any) -> tuple[int, Dimension]:
        """Return the place and the present range of a parameter.

        Raises:
            ValueError: There is no such parameter.
        """
        for index, parameter in enumerate(self.ranges):
            if parameter.address == address:
                return index, parameter
        varied = ", ".join(parameter.address for parameter in self.ranges)
        raise ValueError(f"the study varies no parameter {address!r}; it varies {varied}")

    # -- its solver

    def check(self) -> None:
        """Check that a solver can perform the search.

        Raises:
            ValueError: No parameter is varied, no point is left, or the solver cannot search what is left.
        """
        if not self.free and self.ranges:
            raise ValueError("no parameter is left to vary: unfreeze one first")
        if not _is_left(_space(self), self.by_address, list(self.forbidden.values())):
            raise ValueError("the forbidden regions cover all that is searched: no point is left")
        solver = self.make_solver()
        solver.close()
        if solver.wants_gradient and self.solver_changed:
            raise SolverError(
                f"{solver.name} takes derivatives of the testbed, with which a study must be begun: give "
                "gradient='central'"
            )

    def make_solver(
        self, *, evaluations: float = inf, start: Point | None = None, racing: bool = False, begun: bool = False
    ) -> Solver:
        """Return a solver for the free parameters.

        Args:
            evaluations: The number of evaluations that it may ask for.
            start: A point of all parameters from which a local method starts.
            racing: Whether points are raced.
            begun: Whether the study has begun, so that the budget is the rest of one. A design of a fixed size that
                exceeds the rest is then cut, and not refused.

        Raises:
            SolverError: The solver cannot perform the search.
        """
        # The rollouts of a batch are its points under all conditions; a race begins with two of each.
        width = min(self.conditions, 2) if racing else self.conditions

        def make(budget: int | None) -> Solver:
            return make_solver(
                self.solver,
                self.free,
                objectives=1 if self.aspiration else len(self.signs),
                constraints=self.constraints,
                seed=self.seed,
                budget=budget,
                parallel=None if self.parallel is None else ceil(self.parallel / width),
                start=None if start is None else self.reduce(start),
                **self.options,
            )

        budget = None if evaluations == inf else max(1, int(evaluations + 1e-6))
        try:
            return make(budget)
        except SolverError:
            if not begun or budget is None:
                raise
            return make(None)

    def achievement(self, evaluations: Iterable[Evaluation]) -> Callable[[Evaluation], Evaluation]:
        """Return the function that replaces the values of an evaluation by one, which is largest at the aspiration.

        It is Wierzbicki's achievement scalarizing function, min_i w_i (f_i - a_i) + rho sum_i w_i (f_i - a_i), where
        f_i are the values (larger is better), a_i those that are aimed at, and 1 / w_i is the range of f_i among
        ``evaluations``.

        Wierzbicki, A. P. (1980): The use of reference objectives in multiobjective optimization. Lecture Notes in
        Economics and Mathematical Systems 177.
        """
        if self.aspiration is None:
            return lambda evaluation: evaluation
        values = np.array([e.values for e in evaluations if e.counts]).reshape(-1, len(self.signs))
        ranges = np.ptp(values, axis=0) if len(values) else np.zeros(len(self.signs))
        weights = 1.0 / np.where(ranges > 0.0, ranges, 1.0)
        target = np.array(self.signs) * np.array(self.aspiration)

        def scalar(evaluation: Evaluation) -> Evaluation:
            distances = weights * (np.array(evaluation.values) - target)
            return replace(
                evaluation, values=(float(distances.min() + _AUGMENTATION * distances.sum()),), gradient=None
            )

        return scalar


class FollowedSearch:
    """The search of a study's file as its interventions leave it.

    Interventions are read once, those that are added meanwhile when `now` is called. A point that is tried changes no
    search, so that the points of a queue may be edited at no cost.

    Args:
        file: The file of the study.
    """

    def __init__(self, file: StudyFile) -> None:
        self._file = file
        # The search before all interventions, how often one had been changed, the last one, and the search behind it.
        # They are replaced together, so that threads need no lock.
        self._read: tuple[StudySearch, int, int, StudySearch] | None = None

    def now(self) -> StudySearch:
        """Return the search behind the interventions so far."""
        # First the number of changes: a change that happens now is noticed next time.
        begun, changes = StudySearch.of(self._file.meta), self._file.changes_of_search
        last, search = 0, begun
        if self._read is not None and self._read[:2] == (begun, changes):
            last, search = self._read[2:]
        new = self._file.interventions(after=last)
        if new:
            last, search = new[-1].number, search.after(new)
        self._read = begun, changes, last, search
        return search


class StudySolver:
    """The solver of a study, begun anew whenever an intervention changes its search.

    It asks for points of all parameters, none of them in a forbidden region: the method is told that a point there has
    failed, at no cost. A new method starts at the best point so far, with the rest of the budget, and is told the
    evaluations so far that lie in its space. A change of the budget alone lets the method go on.

    Args:
        search: The search with which the study begins.
        racing: Whether points are raced.

    Attributes:
        circles: Whether the method has asked for all points of its last batch before.
    """

    # Numbers of forbidden points in a row that end a solver, and a design, whose points cost nothing.
    patience, patience_of_designs = 2000, 1_000_000

    def __init__(self, search: StudySearch, *, racing: bool) -> None:
        self.search = search
        self._racing = racing
        self._spent = 0.0
        self._evaluations: dict[Point, Evaluation] = {}
        self._proposed: list[Point] = []
        # The points that were known when the method began, and those that it has asked for.
        self._earlier: frozenset[Point] = frozenset()
        self._repeated: set[Point] = set()
        self._scalar = search.achievement(())
        self._solver = search.make_solver(evaluations=self._left, racing=racing)
        self._message = ""
        self.circles = False

    @property
    def _left(self) -> float:
        budget = self.search.budget
        return inf if budget is None else ceil(budget / self.search.conditions) - self._spent

    @property
    def name(self) -> str:
        """Return the solver's name in the catalogue."""
        return self._solver.name

    @property
    def method(self) -> str:
        """Return the name of the method in use at the moment."""
        return self._solver.method

    @property
    def success(self) -> bool | None:
        """Return whether the solver ended by its own criterion; None before the end."""
        return False if self._message else self._solver.success

    @property
    def message(self) -> str:
        """Return the end of the solver, in words."""
        return self._message or self._solver.message

    @property
    def wants_gradient(self) -> bool:
        """Return whether the solver needs `Evaluation.gradient`."""
        return self._solver.wants_gradient

    @property
    def evaluations(self) -> list[Evaluation]:
        """Return the exact evaluations so far."""
        return list(self._evaluations.values())

    def change(self, search: StudySearch) -> None:
        """Go on with another search."""
        before, self.search = self.search, search
        if search.same_points(before):
            if search.budget == before.budget:
                return
            if not self._solver.plans_for_budget:
                self._solver.change_budget(self._left)
                return
        self._solver.close()
        self._scalar = search.achievement(self._evaluations.values())
        inside = [e for point, e in self._evaluations.items() if search.contains(point)]
        scalar = [self._for_solver(evaluation, effort=0.0) for evaluation in inside]
        usable = [(rank_key(e), k) for k, e in enumerate(scalar) if e.usable]
        fresh = search.make_solver(evaluations=self._left, racing=self._racing, begun=True)
        # With several qualities there is no best point to start at.
        if usable and fresh.takes_start and fresh.search.objectives == 1:
            start = inside[min(usable)[1]].point
            fresh = search.make_solver(evaluations=self._left, start=start, racing=self._racing, begun=True)
        self._solver = fresh
        self._earlier, self._repeated = frozenset(self._evaluations), set()
        if scalar:
            self._solver.tell(scalar)

    def ask(self) -> list[Point]:
        """Return the points to be evaluated next; an empty list when the solver has ended."""
        patience = self.patience_of_designs if isinstance(self._solver, Design) else self.patience
        forbidden = 0
        while forbidden < patience:
            self._proposed = [self.search.complete(point) for point in self._solver.ask()]
            points = [point for point in self._proposed if self.search.allows(point)]
            if points or not self._proposed:
                self.circles = bool(points) and self._repeated.issuperset(points)
                self._repeated.update(points)
                return points
            forbidden += len(self._proposed)
            self._answer([])
        self._message = f"{forbidden} points in a row lay in forbidden regions"
        self._solver.close()
        return []

    def repeats(self, evaluation: Evaluation) -> bool:
        """Return whether the point was evaluated before the present method began."""
        return evaluation.point in self._earlier

    def tell(self, evaluations: Sequence[Evaluation]) -> None:
        """Tell the evaluations of the points asked for, in their order."""
        self._remember(evaluations)
        self._answer(evaluations)

    def tell_by_hand(self, evaluations: Sequence[Evaluation]) -> None:
        """Tell the evaluations of points that were not asked for."""
        self._remember(evaluations)
        inside = [evaluation for evaluation in evaluations if self.search.contains(evaluation.point)]
        if inside:
            self._solver.tell([self._for_solver(evaluation) for evaluation in inside])
        if len(inside) < len(evaluations):
            self._solver.change_budget(self._left)

    def close(self) -> None:
        """Release the resources of the solver."""
        self._solver.close()

    def _remember(self, evaluations: Sequence[Evaluation]) -> None:
        self._spent += sum(evaluation.effort for evaluation in evaluations)
        self._evaluations.update({e.point: e for e in evaluations if e.exact})

    def _answer(self, evaluations: Sequence[Evaluation]) -> None:
        allowed = iter(evaluations)
        nothing = (math.nan,) * len(self.search.signs), (math.nan,) * self.search.constraints
        answers = [
            next(allowed) if self.search.allows(point) else Evaluation(point, *nothing, effort=0.0)
            for point in self._proposed
        ]
        self._proposed = []
        self._solver.tell([self._for_solver(evaluation) for evaluation in answers])

    def _for_solver(self, evaluation: Evaluation, **changes: Any) -> Evaluation:
        """Return an evaluation as the solver sees it: with the free parameters, and one value if it aims at a point."""
        gradient = evaluation.gradient
        if gradient is not None:
            gradient = self.search.reduce(gradient)
        point = self.search.reduce(evaluation.point)
        return self._scalar(replace(evaluation, point=point, gradient=gradient, **changes))


# -- the kinds


def _pause(search: StudySearch, _: int) -> StudySearch:
    if search.paused:
        raise ValueError("the study is paused already: resume or stop it")
    return replace(search, paused=True)


def _resume(search: StudySearch, _: int) -> StudySearch:
    if not search.paused:
        raise ValueError("the study is not paused")
    return replace(search, paused=False)


def _stop(search: StudySearch, _: int) -> StudySearch:
    return replace(search, paused=False)


def _range(
    search: StudySearch, _: int, *, address: str, lower: Any = None, upper: Any = None, options: Any = None
) -> StudySearch:
    index, parameter = search.parameter(address)
    narrowed: Dimension
    if isinstance(parameter, Choice):
        if options is None or lower is not None or upper is not None:
            raise ValueError(f"{address} is a choice: give options=[option, option, ...], not a range")
        declared = search.widest[index]
        narrowed = Choice(address, [declared.as_value(option) for option in options])
    else:
        if options is not None:
            raise ValueError(f"{address} is a number: give lower= and upper=, not options")
        lower = parameter.lower if lower is None else as_number(f"the lower end of {address}", lower)
        upper = parameter.upper if upper is None else as_number(f"the upper end of {address}", upper)
        narrowed = replace(parameter, lower=lower, upper=upper)
        limits = search.limits[index]
        widest = search.widest[index]
        assert isinstance(widest, Parameter)
        if limits is None:
            if narrowed.lower < widest.lower or narrowed.upper > widest.upper:
                raise ValueError(
                    f"the range {narrowed.range_text} of {address} exceeds {widest.range_text}, the problem's range; "
                    "a field of the scenario is only checked there"
                )
        elif narrowed.lower < limits[0] or narrowed.upper > limits[1]:
            raise ValueError(
                f"the range {narrowed.range_text} of {address} exceeds its bounds [{limits[0]:g}, {limits[1]:g}]"
            )
        hull = replace(widest, lower=min(widest.lower, narrowed.lower), upper=max(widest.upper, narrowed.upper))
        search = replace(search, widest=_placed(search.widest, index, hull))
    return replace(search, ranges=_placed(search.ranges, index, narrowed))


def _freeze(search: StudySearch, _: int, *, address: str, value: Any) -> StudySearch:
    _, parameter = search.parameter(address)
    return replace(search, frozen={**search.frozen, address: parameter.as_value(value)})


def _unfreeze(search: StudySearch, _: int, *, address: str) -> StudySearch:
    search.parameter(address)
    if address not in search.frozen:
        raise ValueError(f"{address} is not frozen; frozen are: {', '.join(search.frozen) or 'none'}")
    return replace(search, frozen={key: v for key, v in search.frozen.items() if key != address})


def _forbid(search: StudySearch, number: int, *, region: Any) -> StudySearch:
    if not isinstance(region, Mapping) or not region:
        raise ValueError(f"a region is given as {{address: [lower, upper], ...}}, not as {region!r}")
    sides = {address: _given_side(search.parameter(address)[1], side) for address, side in region.items()}
    space = _space(search)
    if _remainder(space, search.by_address, sides) == [space]:
        raise ValueError("the region lies outside of all that is searched, and forbids nothing")
    return replace(search, forbidden={**search.forbidden, number: sides})


def _allow(search: StudySearch, _: int, *, number: Any) -> StudySearch:
    if number not in search.forbidden:
        regions = ", ".join(str(region) for region in search.forbidden) or "none"
        raise ValueError(f"there is no forbidden region {number!r}; the forbidden regions are: {regions}")
    return replace(search, forbidden={key: r for key, r in search.forbidden.items() if key != number})


def _budget(search: StudySearch, number: int, *, rollouts: Any) -> StudySearch:
    if rollouts is not None and as_whole("a budget of rollouts", rollouts) < 1:
        raise ValueError(f"a budget is at least one rollout, not {rollouts}")
    return replace(search, budget=None if rollouts is None else int(rollouts), budget_from=number)


def _solver(search: StudySearch, _: int, *, solver: Any, options: Any = None) -> StudySearch:
    if options is not None and not isinstance(options, Mapping):
        raise ValueError(f"the options of a solver are given as {{name: value, ...}}, not as {options!r}")
    options = plain(options or {}, "the options of its solver")
    return replace(search, solver=solver, options=options, solver_changed=True)


def _try(search: StudySearch, _: int, *, point: Any) -> StudySearch:
    return search  # The point was checked where it was written.


def _aspiration(search: StudySearch, _: int, *, targets: Any) -> StudySearch:
    if len(search.signs) < 2:
        raise ValueError("an aspiration belongs to several qualities, but the problem has one")
    if targets is None:
        return replace(search, aspiration=None)
    if not isinstance(targets, Sequence) or isinstance(targets, str) or len(targets) != len(search.signs):
        raise ValueError(f"an aspiration has one value per quality, {len(search.signs)}, not {targets!r}")
    values = tuple(as_number("a value of an aspiration", target) for target in targets)
    if not all(math.isfinite(value) for value in values):
        raise ValueError(f"the values of an aspiration are finite, not {list(values)}")
    return replace(search, aspiration=values)


# A kind is a function of the search before it, the number of the intervention, and its payload.
_KINDS: Mapping[str, Callable[..., StudySearch]] = {
    PAUSE: _pause,
    RESUME: _resume,
    STOP: _stop,
    "range": _range,
    "freeze": _freeze,
    "unfreeze": _unfreeze,
    "forbid": _forbid,
    "allow": _allow,
    "budget": _budget,
    "solver": _solver,
    TRY: _try,
    "aspiration": _aspiration,
}


def check_arguments(kind: Any, payload: Mapping[str, Any]) -> None:
    """Check the arguments of an intervention by their names.

    Args:
        kind: The kind of intervention, see `Study.intervene`.
        payload: Its arguments by name; their values are not checked.

    Raises:
        ValueError: There is no such kind, or it takes other arguments.
    """
    if kind not in _KINDS:
        raise ValueError(f"there is no intervention {kind!r}; there are {', '.join(_KINDS)}")
    _, _, *parameters = inspect.signature(_KINDS[kind]).parameters.values()
    names = [parameter.name for parameter in parameters]
    missing = [p.name for p in parameters if p.default is p.empty and p.name not in payload]
    if missing or not payload.keys() <= set(names):
        takes = ", ".join(f"{name}=" for name in names) or "no arguments"
        raise ValueError(f"{kind} takes {takes}, not {', '.join(f'{name}=' for name in payload) or 'none'}")


def _placed(space: tuple[Dimension, ...], index: int, parameter: Dimension) -> tuple[Dimension, ...]:
    return (*space[:index], parameter, *space[index + 1 :])


# -- boxes


def _given_side(parameter: Dimension, side: Any) -> list[Any]:
    """Return a side of a region as JSON data, checked."""
    if not isinstance(side, Sequence) or isinstance(side, str) or not side:
        raise ValueError(f"a side of a region is [lower, upper], or options, not {side!r} of {parameter.address}")
    if isinstance(parameter, Choice):
        return [parameter.as_value(option) for option in side]
    if len(side) != 2:
        raise ValueError(f"a side of a region has two ends, [lower, upper], unlike {list(side)} of {parameter.address}")
    name = parameter.address
    ends = [None if end is None else as_number(f"an end of the region along {name}", end) for end in side]
    lower, upper = _open_ends(ends)
    if not (lower <= upper if parameter.integer else lower < upper):
        raise ValueError(f"the side [{lower:g}, {upper:g}] of the region along {name} is empty: lower < upper")
    return ends


def _open_ends(side: Sequence[float | None]) -> tuple[float, float]:
    lower, upper = side
    return -inf if lower is None else lower, inf if upper is None else upper


def _contains(parameter: Dimension, side: Sequence[Any], value: Any) -> bool:
    if isinstance(parameter, Choice):
        return value in side
    lower, upper = _open_ends(side)
    return bool(lower <= value <= upper)


def _space(search: StudySearch) -> dict[str, _Side]:
    """Return the search space as a box. A whole number k of a range is the interval from k - 1/2 to k + 1/2."""
    box: dict[str, _Side] = {}
    for parameter in search.ranges:
        if parameter.address in search.frozen:
            box[parameter.address] = frozenset([search.frozen[parameter.address]])
        elif isinstance(parameter, Choice):
            box[parameter.address] = frozenset(parameter.options)
        else:
            margin = 0.5 if parameter.integer else 0.0
            box[parameter.address] = parameter.lower - margin, parameter.upper + margin
    return box


def _divided(side: _Side, parameter: Dimension, forbidden: Sequence[Any]) -> tuple[_Side | None, list[_Side]]:
    """Return the part of a side that lies within a region's side, None if there is none, and the parts outside."""
    if isinstance(side, frozenset):
        within = frozenset(value for value in side if _contains(parameter, forbidden, value))
        return within or None, [side - within] if side - within else []
    lower, upper = _open_ends(forbidden)
    if isinstance(parameter, Parameter) and parameter.integer:
        lower = lower if lower == -inf else ceil(lower) - 0.5
        upper = upper if upper == inf else floor(upper) + 0.5
    if upper <= side[0] or lower >= side[1] or upper <= lower:
        return None, [side]
    outside: list[_Side] = [(side[0], lower)] if lower > side[0] else []
    outside += [(upper, side[1])] if upper < side[1] else []
    return (max(lower, side[0]), min(upper, side[1])), outside


def _remainder(
    box: Mapping[str, _Side], parameters: Mapping[str, Dimension], region: Mapping[str, Any]
) -> list[dict[str, _Side]]:
    """Return boxes that together are a box without a region."""
    inner, pieces = dict(box), []
    for address, forbidden in region.items():
        within, outside = _divided(inner[address], parameters[address], forbidden)
        if within is None:
            return [dict(box)]
        pieces += [{**inner, address: side} for side in outside]
        inner[address] = within
    return pieces


def _is_left(
    box: Mapping[str, _Side], parameters: Mapping[str, Dimension], regions: Sequence[Mapping[str, Any]]
) -> bool:
    """Return whether regions leave a part of a box."""
    if not regions:
        return True
    return any(_is_left(piece, parameters, regions[1:]) for piece in _remainder(box, parameters, regions[0]))
