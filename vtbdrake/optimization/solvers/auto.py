"""The default solver: it chooses its methods by the problem, and changes them when they make no more progress."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from vtbdrake.optimization.parameter import Choice
from vtbdrake.optimization.solvers.bayesian import Bayesian
from vtbdrake.optimization.solvers.cobyqa import Cobyqa
from vtbdrake.optimization.solvers.designs import Grid, Listed, Sobol, discrete_size
from vtbdrake.optimization.solvers.evolution import CmaEs, DifferentialEvolution, default_population
from vtbdrake.optimization.solvers.solver import SEEDS, Evaluation, Point, Search, Solver, best_of, rank_key

MODEL = "bayesian"

# Without a budget, whole and categorical parameters with up to this many combinations are searched exhaustively.
EXHAUSTIVE = 256
# A change of the best value is progress if it exceeds this part of the spread of the values found by the model.
PROGRESS = 1e-6
# The solver ends after this many global starts in a row without progress.
PATIENCE = 5
# A Gaussian process and a quadratic model help with up to this many parameters; beyond, both are expensive.
MODEL_SIZE = 20
# Beyond this number of parameters, a Gaussian process with few points tells little: evolution takes its place.
PROCESS_SIZE = 12
# Points of the Gaussian process per parameter and one more.
MODEL_POINTS = 25
# Largest number of points of the Gaussian process.
MODEL_LIMIT = 120
# Least number of batches of points of the Gaussian process, where batches are wide.
MODEL_BATCHES = 4
# Closest points that the Gaussian process learns from the other methods, as a part of the ranges.
MODEL_SPACING = 0.005
# The radius with which the first local search begins, as a part of the ranges: from their middle it tries the quarters.
FIRST_RADIUS = 0.25
# The radius of the later ones.
LOCAL_RADIUS = 0.1
# A local search has located its minimum when its best point moves by less than this part of the ranges.
LOCATED = 0.003
# A point that is closer than this to the start or the end of a local search is in its basin.
BASIN = 0.1
# The least share of a method that does not pay, relative to one that does.
LEAST_SHARE = 0.125
# A method does not pay if it has this many evaluations per parameter and two more without progress of the best point.
TRIAL = 2
# The standard deviation of a hop from the best point into a basin beside it, as a part of the ranges.
HOP = 0.1
# Local searches in a row that may have nothing better, before the others find something better.
BASINS = 6
# Turns in a row in which no method knows a new point: the space has none.
IDLE = 50
# Evolution beside the model begins around the best point with this standard deviation.
EVOLUTION_WIDTH = 0.15


@dataclass(eq=False)
class _Arm:
    """A method of the portfolio.

    Attributes:
        method: Its name, for the user.
        solver: The solver that runs it.
        patience: The number of evaluations without progress after which it stalls.
        limit: The number of evaluations after which it ends.
        start: The start of a local search, whose integers stay; None of a global method.
        before: The best evaluation of all when it began.
        spent: The number of its evaluations.
        best: Its best evaluation.
        without_progress: The number of its evaluations since its best one.
        path: The place of its best point after each evaluation of a local search, in the unit cube.
        ended: Whether it has ended.
    """

    method: str
    solver: Solver
    patience: float = math.inf
    limit: float = math.inf
    start: Point | None = None
    before: Evaluation | None = None
    spent: int = 0
    best: Evaluation | None = None
    without_progress: int = 0
    path: list[np.ndarray] = field(default_factory=list)
    ended: bool = False


@dataclass(eq=False)
class _Account:
    """The evaluations of methods of one kind, weighed by what they bring.

    Attributes:
        due: The evaluations so far, each divided by the share at its time: the least one is next.
        share: 1 while the methods pay, less while they do not.
        fruitless: The number of evaluations since the last progress, or the last change of the share.
    """

    due: float = 0.0
    share: float = 1.0
    fruitless: int = 0

    def charge(self, count: int, progress: bool, trial: int) -> None:
        """Charge evaluations, which have improved the best point or not."""
        self.due += count / self.share
        self.fruitless = 0 if progress else self.fruitless + count
        if progress:
            self.share = 1.0
        elif self.fruitless >= trial:
            self.share, self.fruitless = max(self.share / 2.0, LEAST_SHARE), 0


class Auto(Solver):
    """A solver that chooses its methods by the problem, and spends evaluations on those that pay.

    * whole and categorical parameters only, with no more combinations than the budget (256 without one), and one
      objective: a grid;
    * several objectives, or a categorical parameter: Bayesian optimization to the end;
    * else a portfolio of a local search and of global methods, which take turns.

    The *local search* is COBYQA: quadratic models in a trust region. It begins at once, in the middle of the ranges or
    at the given start, and has all evaluations until it has *located* a minimum: until its best point moves by less
    than 0.3 % of the ranges in n + 5 evaluations. From then on it takes turns with the others, until it has converged;
    one that locates a minimum that is not the best ends there. The next one begins at the best point, if another method
    has found that, and else in turns beside the best point and at the best point far from all basins that were
    searched. After six in a row without a better point they wait until another method finds one. They vary the
    continuous parameters only, and keep the integers of the start.

    The *global methods* are Bayesian optimization for 25 (n + 1) points, 120 at most, which learns from the points of
    all methods, with up to 12 parameters; and evolution: CMA-ES from the best point, which ends when it has converged,
    or when it stalls: when for 20 + 30 n / lambda generations, of lambda points each, its best value has not improved
    by more than 1e-6 of the spread of all values. Then it restarts at a random point with twice the population (IPOP);
    every third start is differential evolution. After five starts in a row without such an improvement the solver ends,
    with success. With more than 20 parameters, or if more points run side by side (`Search.parallel`), there are no
    local searches, which choose each point by the last one: a Sobol design of 2 (n + 1) points, or else Bayesian
    optimization, comes first, then evolution.

    *Turns* are given by what pays. Local search, Bayesian optimization and evolution have equal shares at first. The
    share of one is halved, to an eighth at least, whenever 2 (n + 2) of its evaluations have not improved the best
    point, and is full again once it improves it. Methods ask for one point at a time, evolution for a generation; for
    as many as run side by side, if that is more. No choice depends on the budget, a grid's excepted: with a larger
    budget, a study begins as with a smaller one.

    Auger, A. and Hansen, N. (2005): A restart CMA evolution strategy with increasing population size, CEC 2005.
    Ragonneau, T. M. (2022): Model-based derivative-free optimization methods and software, PhD thesis, The Hong Kong
    Polytechnic University.
    """

    def __init__(self, search: Search, *, name: str) -> None:
        super().__init__(search, name=name)
        self._best: Evaluation | None = None
        self._lowest_value, self._highest_value = math.inf, -math.inf
        self._count = 0
        self._changes: list[tuple[int, str]] = []
        # All evaluations of one objective, by their points.
        self._evaluations: dict[Point, Evaluation] = {}
        # Their places in the unit cube.
        self._places: dict[Point, np.ndarray] = {}
        # Those that the Gaussian process was not told of yet, and the places of those that it was told of.
        self._untold: list[Evaluation] = []
        self._told_places: list[np.ndarray] = []
        # Whether one method performs the whole search.
        self._alone = False
        self._arm: _Arm
        # Starts and ends of local searches, and their places in the unit cube.
        self._ends: set[Point] = set()
        self._basins: list[np.ndarray] = []
        self._local: _Arm | None = None
        self._local_count = 0
        self._fruitless_basins = 0
        self._accounts = {kind: _Account() for kind in ("local", "model", "evolution")}
        self._arms: list[_Arm] = []
        self._plan = self._stages()

    @property
    def method(self) -> str:
        return self._changes[-1][1] if self._changes else self._arm.method if self._alone else ""

    @property
    def changes(self) -> tuple[tuple[int, str], ...]:
        """Return the methods used so far, each with the number of evaluations asked for before its turn."""
        return tuple(self._changes)

    def change_budget(self, left: float) -> None:
        super().change_budget(left)
        if self._alone:
            self._arm.solver.change_budget(left)

    # -- the plan

    def _stages(self) -> Iterator[_Arm]:
        """Yield the method of each batch."""
        search = self.search
        discrete = not any(parameter.is_continuous for parameter in search.space)
        if search.objectives == 1 and discrete and discrete_size(search.space) <= (search.budget or EXHAUSTIVE):
            return self._single("grid", Grid(replace(search, start=None), name="grid"))
        if search.objectives > 1 or any(isinstance(parameter, Choice) for parameter in search.space):
            return self._single(MODEL, Bayesian(search, name=MODEL, batch=self._batch))
        return self._portfolio()

    def _single(self, method: str, solver: Solver) -> Iterator[_Arm]:
        self._alone = True
        self._arm = self._new_arm(method, solver)
        return self._to_the_end(self._arm)

    def _to_the_end(self, arm: _Arm) -> Iterator[_Arm]:
        while not arm.ended:
            yield arm
        self._end(bool(arm.solver.success), arm.solver.message)

    @property
    def _batch(self) -> int:
        """Return the number of points that Bayesian optimization to the end asks for at a time."""
        return self.search.batch(4 if self.search.budget is None else min(max(self.search.budget // 25, 1), 4))

    def _portfolio(self) -> Iterator[_Arm]:
        search = self.search
        if search.start is not None:
            first = Listed(replace(search, start=None, budget=None), name="start", points=[search.start])
            yield self._new_arm("start", first)
        if self._has_local:
            if self._best is not None and search.start is None:
                # The best of the points that were given by hand.
                self._begin_local(self._best.point, radius=LOCAL_RADIUS)
            else:
                self._begin_local(search.start or search.point(search.start_unit()), radius=FIRST_RADIUS)
            while self._local is not None and not self._is_located(self._local):
                yield self._local
                self._look_at_local()
        yield from self._turns()
        self._end(True, f"{PATIENCE} starts in a row found nothing better")

    def _turns(self) -> Iterator[_Arm]:
        """Yield the method of each batch, once a minimum is located: the one that is due by its account.

        It ends where no method has a new point, as in a range of a few floating-point numbers.
        """
        # Side by side in the first case, one after the other in the second.
        beside = self._has_local and self.search.size <= PROCESS_SIZE
        model = self._new_model() if not self._has_local or beside else None
        evolutions = self._evolutions()
        evolution: _Arm | None = None
        idle = 0
        while idle < IDLE:
            if evolution is None and (beside or model is None):
                evolution = next(evolutions, None)
                if evolution is None and model is None:
                    return
            local = self._local_search()
            arms = {"local": local, "model": model, "evolution": evolution}
            kinds = [kind for kind, arm in arms.items() if arm is not None]
            kind = min(kinds, key=lambda kind: self._accounts[kind].due)
            arm = arms[kind]
            assert arm is not None
            count, before = self._count, self._best
            yield arm
            idle = 0 if self._count > count else idle + 1
            progress = self._progress(before, self._best)
            self._accounts[kind].charge(self._count - count, progress, TRIAL * (self.search.size + 2))
            if progress:
                self._fruitless_basins = 0
            self._look_at_local()
            model = None if model is None or model.ended else model
            evolution = None if evolution is None or evolution.ended else evolution

    # -- local searches

    @property
    def _has_local(self) -> bool:
        return len(self._continuous) > 0 and self.search.size <= MODEL_SIZE and not self.search.is_wide

    @property
    def _continuous(self) -> list[int]:
        """Return the indices of the continuous parameters."""
        return [i for i, parameter in enumerate(self.search.space) if parameter.is_continuous]

    def _local_search(self) -> _Arm | None:
        """Return the local search under way, or a new one; None if there is no place for one that may pay."""
        if self._local is None and self._has_local and self._fruitless_basins < BASINS:
            start = self._next_start()
            if start is not None:
                self._begin_local(start, radius=LOCAL_RADIUS)
        return self._local

    def _next_start(self) -> Point | None:
        """Return the start of the next local search; None if there is none.

        It is the best point if no local search has found that; else in turns a place beside the best point, and the
        best point that is far from the starts and ends of all local searches.
        """
        best = self._best
        if best is None or not best.counts:
            return None
        if best.point not in self._ends:
            return best.point
        if self._local_count % 2:
            varied, u = self._continuous, self.search.unit(best.point)
            u[varied] += HOP * np.random.default_rng([self.search.seed, self._local_count]).normal(size=len(varied))
            beside = self.search.point(np.clip(u, 0.0, 1.0))
            return tuple(beside[i] if i in varied else value for i, value in enumerate(best.point))
        evaluations = [evaluation for evaluation in self._evaluations.values() if evaluation.counts]
        places = np.array([self._places[evaluation.point] for evaluation in evaluations])
        free = np.ones(len(evaluations), dtype=bool)
        for basin in self._basins:
            free &= np.abs(places - basin).max(axis=1) > BASIN
        far = min((evaluations[i] for i in np.flatnonzero(free)), key=rank_key, default=best)
        return far.point

    def _begin_local(self, start: Point, *, radius: float) -> None:
        """Begin a local search at a point, whose integers stay."""
        varied = self._continuous
        self._end_at(start)
        space, point = tuple(self.search.space[i] for i in varied), tuple(start[i] for i in varied)
        search = replace(self.search, space=space, start=point, budget=None)
        place = "from the start"
        if self._local_count:
            place = "around the best" if self._best is not None and start == self._best.point else "in another basin"
        self._local_count += 1
        self._local = self._new_arm(f"COBYQA {place}", Cobyqa(search, name="COBYQA", radius=radius), start=start)

    def _end_at(self, point: Point) -> None:
        """Note the start or the end of a local search."""
        self._ends.add(point)
        self._basins.append(self.search.unit(point))

    def _is_located(self, local: _Arm) -> bool:
        """Return whether the best point of a local search hardly moves any more."""
        size = len(self._continuous)
        window = size + 5
        if len(local.path) <= 2 * size + 1 + window:
            return False
        return bool(np.abs(local.path[-1] - local.path[-1 - window]).max() < LOCATED)

    def _look_at_local(self) -> None:
        """End the local search if it has converged, or has located a minimum that is not the best."""
        local = self._local
        if local is None or not (local.ended or (self._is_located(local) and local.best is not self._best)):
            return
        if local.best is not None:
            self._end_at(local.best.point)
        self._fruitless_basins += local.best is not self._best
        local.solver.close()
        self._local = None

    # -- global methods

    def _evolutions(self) -> Iterator[_Arm]:
        """Yield evolutionary methods, each to its end, until none has found anything better for a while."""
        fruitless, start = 0, 0
        while fruitless < PATIENCE:
            arm = self._new_evolution(start)
            yield arm
            start += 1
            fruitless = 0 if self._progress(arm.before, arm.best) else fruitless + 1

    def _new_model(self) -> _Arm:
        """Return the Gaussian process, or for many parameters a design."""
        search, size = replace(self.search, start=None, budget=None), self.search.size
        if size > MODEL_SIZE:
            points = int(search.batch(2 * (size + 1)))
            if self.search.budget is not None:
                points = min(points, max(1, self.search.budget // 2))
            return self._new_arm("sobol", Sobol(search, name="sobol", points=points))
        model = Bayesian(search, name=MODEL, batch=self.search.batch(1))
        points = max(min(MODEL_POINTS * (size + 1), MODEL_LIMIT), MODEL_BATCHES * search.batch(1))
        return self._new_arm(MODEL, model, limit=points)

    def _new_evolution(self, start: int) -> _Arm:
        """Return a global search, counted from 0: CMA-ES twice, differential evolution, and so on."""
        search = replace(self.search, start=None, seed=(self.search.seed + start) % SEEDS, budget=None)
        if start % 3 == 2:
            evolution = DifferentialEvolution(search, name="differential-evolution")
            generation = search.batch(15 * search.size)
            return self._stalling(f"differential-evolution, start {start + 1}", evolution, generation)
        population = search.batch(default_population(search.size)) << (start - start // 3)
        if start == 0 and self._best is not None:
            search = replace(search, start=self._best.point)
        else:
            generator = np.random.default_rng([self.search.seed, start])
            search = replace(search, start=search.point(generator.random(search.size)))
        width = EVOLUTION_WIDTH if start == 0 and self._has_local else 0.3
        strategy = CmaEs(search, name="CMA-ES", population=population, sigma=width)
        return self._stalling(f"CMA-ES, start {start + 1}, population {population}", strategy, population)

    def _stalling(self, method: str, solver: Solver, generation: int) -> _Arm:
        """Return a method that may stall, of ``generation`` points at a time."""
        return self._new_arm(method, solver, patience=20.0 * generation + 30.0 * self.search.size)

    # -- steps

    def _new_arm(self, method: str, solver: Solver, **settings: Any) -> _Arm:
        arm = _Arm(method, solver, before=self._best, **settings)
        self._arms.append(arm)
        return arm

    def _next(self) -> list[Point]:
        while self.success is None:
            arm = next(self._plan, None)
            if arm is None:
                break
            self._arm = arm
            points = self._proposals(arm)
            if points:
                if not self._changes or self._changes[-1][1] != arm.method:
                    self._changes.append((self._count, arm.method))
                self._count += len(points)
                return points
            arm.ended = True
            arm.solver.close()
        return []

    def _proposals(self, arm: _Arm) -> list[Point]:
        """Return the next points of a method; what is known already, it is told at once."""
        if arm.without_progress > arm.patience or arm.spent >= arm.limit:
            return []
        if arm.solver.name == MODEL and not self._alone:
            self._tell_model(arm.solver)
        while proposed := arm.solver.ask():
            points = [self._completed(arm, point) for point in proposed]
            repeated = [self._evaluations[point] for point in points if point in self._evaluations]
            if self._alone or len(repeated) < len(points):
                return points
            arm.solver.tell([replace(e, point=point) for e, point in zip(repeated, proposed, strict=True)])
            self._follow(arm, repeated)
        return []

    def _tell_model(self, model: Solver) -> None:
        """Tell the Gaussian process of the points of the other methods that are not too close to each other."""
        news = []
        for evaluation in self._untold:
            u = self._places[evaluation.point]
            if evaluation is self._best or all(np.abs(u - v).max() > MODEL_SPACING for v in self._told_places):
                news.append(evaluation)
                self._told_places.append(u)
        self._untold.clear()
        if news:
            model.tell(news)

    def _completed(self, arm: _Arm, point: Point) -> Point:
        """Return a point of the method, completed by the integers of the start."""
        if arm.start is None:
            return point
        varied = dict(zip(self._continuous, point, strict=True))
        return tuple(varied.get(i, value) for i, value in enumerate(arm.start))

    def _reduced(self, arm: _Arm, point: Point) -> Point:
        return point if arm.start is None else tuple(point[i] for i in self._continuous)

    def _learn(self, evaluations: Sequence[Evaluation], by_hand: Sequence[Evaluation]) -> None:
        if self._alone:
            self._arm.solver.tell([*evaluations, *by_hand])
            return
        news = [*evaluations, *by_hand]
        self._evaluations.update({evaluation.point: evaluation for evaluation in news})
        self._places.update({evaluation.point: self.search.unit(evaluation.point) for evaluation in news})
        for value in (evaluation.values[0] for evaluation in news if evaluation.counts):
            self._lowest_value, self._highest_value = min(self._lowest_value, value), max(self._highest_value, value)
        if evaluations:
            arm = self._arm
            arm.solver.tell([replace(e, point=self._reduced(arm, e.point)) for e in evaluations])
            self._best = best_of([self._best, *evaluations])
            self._follow(arm, evaluations)
            arm.spent += len(evaluations)
        self._best = best_of([self._best, *by_hand])
        of_model = evaluations if evaluations and self._arm.solver.name == MODEL else ()
        self._told_places += [self._places[evaluation.point] for evaluation in of_model]
        self._untold += [evaluation for evaluation in news if evaluation not in of_model]

    def _follow(self, arm: _Arm, evaluations: Sequence[Evaluation]) -> None:
        """Note the progress of a method."""
        for evaluation in evaluations:
            best = best_of([arm.best, evaluation])
            progress = self._progress(arm.best, best)
            arm.without_progress = 0 if progress else arm.without_progress + 1
            arm.best = best
            if arm.start is not None and best is not None:
                arm.path.append(self.search.unit(best.point))

    def _progress(self, before: Evaluation | None, after: Evaluation | None) -> bool:
        """Return whether the best has improved by more than `PROGRESS`."""
        if after is None or before is None:
            return after is not None
        (kind, cost), (kind_before, cost_before) = rank_key(after), rank_key(before)
        spread = max(self._highest_value - self._lowest_value, 0.0)
        return kind < kind_before or (kind == kind_before and cost < cost_before - PROGRESS * spread)

    def close(self) -> None:
        for arm in self._arms:
            arm.solver.close()
