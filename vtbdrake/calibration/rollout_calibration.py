"""Calibration by rollouts of the whole testbed, for what does not compile: contact, loops, a DPS in the loop."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import ceil, nan
from operator import attrgetter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vtbdrake.calibration.calibration_result import (
    WORSE,
    Calibrated,
    Calibration,
    Verdict,
    calibrated_scenario,
    kept_back,
)
from vtbdrake.calibration.fisher import Information
from vtbdrake.calibration.joint_model import CalibrationError
from vtbdrake.common.argument_checks import counted
from vtbdrake.common.arrays import Array
from vtbdrake.optimization import Parameter
from vtbdrake.optimization.solvers import Evaluation, Point, make_solver
from vtbdrake.recording.log import Log, Series
from vtbdrake.rollout import Executor, RolloutResult, RolloutTask, make_executor
from vtbdrake.rollout.executor import run_rollouts
from vtbdrake.testbed import Scenario, VirtualTestbed
from vtbdrake.testbed.pedigree import Posterior

Record = Mapping[str, Array]
Loss = Callable[[Array, Record, Record], float]
"""A function (times, measured, simulated) -> distance of two motions, at least 0; 0 if they are the same."""

# A recording that is farther from the simulations than they are from each other, in more than this share of the
# windows beyond what chance explains, is not explained by the model.
OUTSIDE = 0.3
# Number of draws of the bootstrap.
_BOOTSTRAPS = 400
# Number of rounds in which the surface is fitted, each in a smaller box.
_ROUNDS = 4
# Number of random points from which the next ones are chosen.
_CANDIDATES = 1024
# A difference is one if so large a share of the draws agrees about its sign.
_SURE = 0.975
# Half width of the box of the last fit at first, as a share of the range.
_RADIUS = 0.15
# A quadratic fits in a box that is neither much smaller nor much larger than the doubt.
# Largest ratio of the bootstrap's deviation to the half width: beyond it, the box is too narrow.
_NARROW = 0.35
# Least ratio: below it, the box is too wide.
_WIDE = 0.1


@dataclass(frozen=True, eq=False)
class Window:
    """A part of a recording that a rollout predicts from its measured state.

    Attributes:
        times: The times (n,) of the samples in s, equally spaced, beginning at the start.
        starts: Values of s0 by address: the measured state, and further states within its uncertainty. Past an impact
            trajectories are chaotic: what the model predicts is the spread of those that begin within the uncertainty.
        record: Address -> measured values (n, ...) at the times.
        source: The recording; windows of one recording are kept back, and drawn by the bootstrap, together.
    """

    times: Array
    starts: Sequence[Mapping[str, Any]]
    record: Record
    source: str

    def __post_init__(self) -> None:
        n = len(self.times)
        if n < 2 or not self.starts or not self.record:
            raise CalibrationError(f"a window of {self.source} has two samples, a start and a record, at least")
        steps = np.diff(self.times)
        if not (steps > 0.0).all() or np.ptp(steps) > 0.01 * steps.mean():
            raise CalibrationError(f"the samples of a window of {self.source} are equally spaced, within 1 %")
        for address, values in self.record.items():
            if len(values) != n or not np.isfinite(values).all():
                raise CalibrationError(f"{address} of {self.source} has one finite value for each of the {n} times")

    @property
    def digest(self) -> str:
        """Return the SHA-256 of what was measured, see `Log.digest`."""
        series = {
            address: Series(self.times, values.reshape(len(values), -1)) for address, values in self.record.items()
        }
        return Log(self.source, series, {}).digest

    @property
    def period(self) -> float:
        """Return the time between two samples, in s."""
        return float((self.times[-1] - self.times[0]) / (len(self.times) - 1))


@dataclass(frozen=True, eq=False, kw_only=True)
class RolloutCalibration(Calibration):
    """The result of `calibrate_by_rollouts`: a `Calibration` whose measure is the user's loss, not innovations.

    Attributes:
        outside: Share of the windows in which the recording is farther from the simulations than each of these is from
            the others; None with one start per window.
        chance: The share that chance alone gives.
        losses: Loss of each window of the fit, averaged over its starts.
        rollouts: Number of rollouts.
    """

    outside: float | None
    chance: float
    losses: Array
    rollouts: int

    @property
    def summary(self) -> str:
        """Return the recordings, the loss and the number of rollouts in a line."""
        outside = "" if self.outside is None else f", {self.outside:.0%} outside ({self.chance:.0%} by chance)"
        return (
            f"{counted(len(self.sources), 'recording')}, {counted(self.segments, 'window')}: loss {self.fit:.4g} "
            f"(hold-out {self.holdout:.4g}){outside}; {self.rollouts} rollouts"
        )


def calibrate_by_rollouts(
    scenario: Scenario,
    windows: Sequence[Window],
    parameters: Sequence[Parameter],
    loss: Loss,
    *,
    holdout: float = 0.2,
    solver: str = "auto",
    points: int | None = None,
    seed: int = 0,
    executor: str | Executor = "auto",
    workers: int | None = None,
    progress: bool = False,
) -> RolloutCalibration:
    """Fit parameters of any testbed by rollouts that predict windows of recordings.

    A solver searches the point with the least mean score over the windows. With several starts per window, the score is
    the energy score, mean_i d(x_i, y) - mean_(i != j) d(x_i, x_j) / 2, of a measured motion y and simulated ones x_i:
    the expected one is least for the true distribution, where the mean distance alone favours what scatters little
    (T. Gneiting, A. E. Raftery, "Strictly proper scoring rules, prediction, and estimation", JASA 102, 2007).

    Around the best point a quadratic is fitted to the scores of each window, in a box that is made as wide as the
    doubt. The estimate is the minimum of their mean. Its interval comes from a bootstrap over the recordings, which
    takes no further rollout.

    Args:
        scenario: The scenario; parameters begin at its values.
        windows: Windows with the same period; `loss` compares each on its own times.
        parameters: Variables or fields (``scenario.friction``), with their ranges.
        loss: The distance of a simulated motion and a measured one. Compare what both tell after an impact: times of
            events, velocities after them, rest poses, distances; or errors that do not grow without a bound.
        holdout: Share of the recordings that is kept back, to compare with.
        solver: The solver of the search.
        points: The points of the search; by default, 12 for each parameter and 12 more.
        seed: The seed of all random numbers.
        executor: Runs the rollouts, see `vtbdrake.Problem.sweep`.
        workers: The number of threads or processes.
        progress: Whether to show a progress bar.

    Raises:
        CalibrationError: Nothing is varied, a window does not fit the others, there are fewer than eight recordings, or
            all rollouts fail, or have losses that are not finite.
        ValueError: An address does not exist, or a range exceeds its bounds.
    """
    if not parameters:
        raise CalibrationError("nothing is varied: give parameters=[Parameter(address, lower, upper)]")
    if not 0.0 < holdout < 0.9:
        raise CalibrationError(f"the share that is kept back is above 0 and below 0.9, not {holdout}")
    for parameter in parameters:
        if not parameter.is_continuous:
            raise CalibrationError(f"{parameter.address} is an integer: an interval needs a continuous parameter")
    _check_periods(windows)
    testbed = scenario.build()
    for parameter in parameters:
        if not parameter.is_field:
            parameter.find(testbed.variables())
    start = [_start(scenario, testbed, parameter) for parameter in parameters]
    fitted, held_back = _split_sources(windows, holdout)
    count = sum(len(window.starts) for window in windows)
    opened = make_executor(executor, testbed=testbed, rollouts=count, workers=workers)
    try:
        scores = _Scores(scenario, parameters, loss, opened, progress=progress)
        best = _search(scores, fitted, solver=solver, points=points or 12 * (len(parameters) + 1), seed=seed)
        rng = np.random.default_rng(seed)
        weights = _bootstrap(fitted, rng)
        estimate, draws = _refined(scores, fitted, best, weights, rng, seed=seed)
        matters = _matters(scores, fitted, estimate, weights)
        # Then, every value is as good, and the start remains.
        draws[:, ~matters] = rng.uniform(size=(len(draws), np.count_nonzero(~matters)))
        estimate = tuple(
            value if matter else min(max(before, parameter.lower), parameter.upper)
            for parameter, value, matter, before in zip(parameters, estimate, matters, start, strict=True)
        )
        at_estimate, at_holdout = (scores.of(estimate, part) for part in (fitted, held_back))
        as_good = _is_as_good(scores, held_back, start, estimate, _bootstrap(held_back, rng))
        fit = _Fit(scores.parameters, start, estimate, draws, at_estimate, at_holdout, as_good)
    finally:
        if opened is not executor:
            opened.close()
    return _result(scenario, windows, fit, rollouts=scores.rollouts)


@dataclass(frozen=True, eq=False)
class _WindowScore:
    """The score of one window at one point.

    Attributes:
        score: The energy score, or the loss with one start.
        loss: The loss, averaged over the starts.
        outside: Whether the recording is farther from the simulations than each of them from the others.
    """

    score: float
    loss: float
    outside: bool


class _Scores:
    """The scores of windows at points, by rollouts; a point is evaluated once.

    Args:
        scenario: The scenario.
        parameters: The parameters, in the order of a point.
        loss: The distance of two motions.
        executor: Runs the rollouts.
        progress: Whether to show a progress bar.
    """

    def __init__(
        self, scenario: Scenario, parameters: Sequence[Parameter], loss: Loss, executor: Executor, *, progress: bool
    ) -> None:
        self.parameters = tuple(parameters)
        self.rollouts = 0
        self.message = ""
        self._scenario, self._loss, self._executor, self._progress = scenario, loss, executor, progress
        # Executors compare tasks by identity.
        self._tasks: dict[tuple[int, float], RolloutTask] = {}
        self._scores: dict[tuple[Point, int], _WindowScore] = {}

    def of(self, point: Point, windows: Sequence[Window]) -> list[_WindowScore]:
        """Return the scores of the windows at a point; NaN where a rollout failed."""
        self.evaluate([point], windows)
        return [self._scores[point, id(window)] for window in windows]

    def matrix(self, points: Sequence[Point], windows: Sequence[Window]) -> Array:
        """Return the scores (points, windows)."""
        self.evaluate(points, windows)
        return np.array([[self._scores[point, id(window)].score for window in windows] for point in points])

    def evaluated_points(self, windows: Sequence[Window]) -> list[Point]:
        """Return the points that all these windows were evaluated at."""
        first = dict.fromkeys(point for point, _ in self._scores)
        return [point for point in first if all((point, id(window)) in self._scores for window in windows)]

    def evaluate(self, points: Sequence[Point], windows: Sequence[Window]) -> None:
        """Run what is missing."""
        missing: dict[tuple[int, float], list[tuple[Point, Window]]] = {}
        for point in dict.fromkeys(points):
            for window in windows:
                if (point, id(window)) not in self._scores:
                    missing.setdefault((_horizon_steps(len(window.times) - 1), window.period), []).append(
                        (point, window)
                    )
        for (steps, period), pairs in missing.items():
            if (steps, period) not in self._tasks:
                self._tasks[steps, period] = RolloutTask(
                    scenario=self._scenario,
                    horizon=steps * period,
                    sample_period=period,
                    record=tuple(pairs[0][1].record),
                )
            self._run(self._tasks[steps, period], pairs)

    def _run(self, task: RolloutTask, pairs: Sequence[tuple[Point, Window]]) -> None:
        addresses = [parameter.address for parameter in self.parameters]
        values = [
            {**start, **dict(zip(addresses, point, strict=True))} for point, window in pairs for start in window.starts
        ]
        results = run_rollouts(self._executor, task, values, progress=self._progress, description="calibration")
        if None in results:
            raise KeyboardInterrupt
        self.rollouts += len(results)
        rest = iter(results)
        for point, window in pairs:
            self._scores[point, id(window)] = self._score(window, [next(rest) for _ in window.starts])

    def _score(self, window: Window, results: Sequence[RolloutResult | None]) -> _WindowScore:
        n = len(window.times)
        motions = []
        for result in results:
            assert result is not None
            if result.failed or len(result.times) < n:
                self.message = result.message or f"a rollout ended after {result.times[-1]:g} s: {result.end}"
                return _WindowScore(nan, nan, True)
            motions.append({address: np.asarray(result.record[address])[:n] for address in window.record})
        to_recording = np.array([self._loss(window.times, window.record, motion) for motion in motions])
        if not np.isfinite(to_recording).all():
            self.message = f"the loss of {window.source} is {to_recording[~np.isfinite(to_recording)][0]}"
            return _WindowScore(nan, nan, True)
        count = len(motions)
        if count == 1:
            return _WindowScore(float(to_recording[0]), float(to_recording[0]), False)
        between = np.zeros((count, count))
        for i in range(count):
            for j in range(i):
                between[i, j] = between[j, i] = self._loss(window.times, motions[i], motions[j])
        to_others = between.sum(axis=0) / (count - 1)
        mean = float(to_recording.mean())
        return _WindowScore(mean - 0.5 * float(to_others.mean()), mean, bool(mean > to_others.max()))


def _horizon_steps(steps: int) -> int:
    """Return the number of steps that are simulated for a window: few lengths, as an executor keeps few runners."""
    grain = min(32, max(1, 2 ** (steps.bit_length() - 2)))  # at most half as many more than are asked for
    return grain * ceil(steps / grain)


def _check_periods(windows: Sequence[Window]) -> None:
    periods = np.array([window.period for window in windows])
    sources = len({window.source for window in windows})
    if sources < 8:
        raise CalibrationError(f"{sources} recordings are too few for intervals by a bootstrap over them: give 8")
    if np.ptp(periods) > 1e-3 * periods.mean():
        raise CalibrationError(f"windows have one period, not {periods.min():g} to {periods.max():g} s")
    if len({tuple(window.record) for window in windows}) > 1 or len({len(window.starts) for window in windows}) > 1:
        raise CalibrationError("windows record the same addresses, and have as many starts as each other")


def _split_sources(windows: Sequence[Window], share: float) -> tuple[list[Window], list[Window]]:
    """Return the windows of the fit, and the windows of recordings that are kept back, spread over all."""
    sources = list(dict.fromkeys(window.source for window in windows))
    held_back = {sources[k] for k in np.flatnonzero(kept_back(len(sources), share))}
    parts: tuple[list[Window], list[Window]] = ([], [])
    for window in windows:
        parts[window.source in held_back].append(window)
    return parts


def _search(scores: _Scores, windows: Sequence[Window], *, solver: str, points: int, seed: int) -> Point:
    """Return the best point that the solver finds."""
    search = make_solver(solver, scores.parameters, seed=seed, budget=points)
    best: tuple[float, Point] | None = None
    try:
        while batch := search.ask():
            means = scores.matrix(batch, windows).mean(axis=1)
            search.tell([Evaluation(point, (-float(mean),)) for point, mean in zip(batch, means, strict=True)])
            for point, mean in zip(batch, means, strict=True):
                if np.isfinite(mean) and (best is None or mean < best[0]):
                    best = float(mean), point
    finally:
        search.close()
    if best is None:
        raise CalibrationError(f"at every point a rollout or its loss failed: {scores.message}")
    return best[1]


def _bootstrap(windows: Sequence[Window], rng: np.random.Generator) -> Array:
    """Return the counts of each window's draws, (_BOOTSTRAPS, windows), if whole recordings are drawn."""
    sources = list(dict.fromkeys(window.source for window in windows))
    owner = [sources.index(window.source) for window in windows]
    draws = rng.multinomial(len(sources), np.full(len(sources), 1.0 / len(sources)), size=_BOOTSTRAPS)
    return np.asarray(draws[:, owner], dtype=float)


def _matters(scores: _Scores, windows: Sequence[Window], estimate: Point, weights: Array) -> NDArray[np.bool]:
    """Return for each parameter whether an end of its range fits worse than the estimate, in 97.5 % of the draws."""
    here = scores.matrix([estimate], windows)[0]
    matters = []
    for k, parameter in enumerate(scores.parameters):
        ends = [(*estimate[:k], end, *estimate[k + 1 :]) for end in parameter.ends]
        worse = (scores.matrix(ends, windows) - here) @ weights.T > 0.0
        # An end where rollouts fail is not as good as the estimate.
        failed = np.isnan(scores.matrix(ends, windows)).any(axis=1)
        matters.append(bool((failed | (worse.mean(axis=1) >= _SURE)).any()))
    return np.array(matters)


def _refined(
    scores: _Scores, windows: Sequence[Window], best: Point, weights: Array, rng: np.random.Generator, *, seed: int
) -> tuple[Point, Array]:
    """Return the estimate, and draws of the bootstrap (_BOOTSTRAPS, n) in the unit cube."""
    parameters, n = scores.parameters, len(scores.parameters)
    center = np.array([parameter.to_unit(value) for parameter, value in zip(parameters, best, strict=True)])
    radius = np.full(n, _RADIUS)
    for round_number in range(_ROUNDS):
        lower, upper = np.maximum(center - radius, 0.0), np.minimum(center + radius, 1.0)
        _evaluate_design(scores, windows, lower, upper, seed=seed + round_number)
        surface = _Surface(scores, windows, lower, upper)
        estimate = surface.minima(np.ones((1, len(windows))), np.ones((1, surface.points)), rng)[0]
        # The points, too: where a quadratic fits badly, it depends on them.
        draws = surface.minima(weights, rng.exponential(size=(_BOOTSTRAPS, surface.points)), rng)
        half = 0.5 * (upper - lower)
        ratio = draws.std(axis=0) / half
        if (better := _better(scores, windows, estimate, weights)) is not None:
            # The quadratic does not fit in this box.
            center, radius = better, 0.5 * radius
            estimate = better
            continue
        moved = (abs(estimate - center) > 0.8 * radius) & (estimate > 0.0) & (estimate < 1.0)
        wider = ((lower > 0.0) | (upper < 1.0)) & (ratio > _NARROW)
        narrower = (ratio < _WIDE) & ~moved & (radius > 0.01)
        if not (wider | moved | narrower).any():
            break
        center = estimate
        radius = np.where(wider, 2.0 * radius, np.where(narrower, 0.5 * radius, radius))
    point = tuple(parameter.from_unit(float(u)) for parameter, u in zip(parameters, estimate, strict=True))
    return point, draws


def _better(scores: _Scores, windows: Sequence[Window], u: Array, weights: Array) -> Array | None:
    """Return the best point so far, (n,) in the unit cube, if it surely fits better than the point u."""
    parameters = scores.parameters
    here = tuple(parameter.from_unit(float(x)) for parameter, x in zip(parameters, u, strict=True))
    points = [*scores.evaluated_points(windows), here]
    table = scores.matrix(points, windows)
    means = np.where(np.isfinite(table).all(axis=1), table.mean(axis=1), np.inf)
    best = int(np.argmin(means))
    if not np.mean((table[-1] - table[best]) @ weights.T > 0.0) >= _SURE:
        return None
    return np.array([parameter.to_unit(x) for parameter, x in zip(parameters, points[best], strict=True)])


def _evaluate_design(scores: _Scores, windows: Sequence[Window], lower: Array, upper: Array, *, seed: int) -> None:
    """Evaluate a Sobol design in a box of the unit cube: two points for each coefficient of a quadratic."""
    box = [
        Parameter(p.address, p.from_unit(float(a)), p.from_unit(float(b)), log=p.log)
        for p, a, b in zip(scores.parameters, lower, upper, strict=True)
    ]
    n = len(box)
    design = make_solver("sobol", box, seed=seed, points=(n + 1) * (n + 2))
    while batch := design.ask():
        scores.evaluate(batch, windows)
        design.tell([Evaluation(point, (0.0,)) for point in batch])


class _Surface:
    """A quadratic for the mean score of windows, in a box of the unit cube, by least squares.

    Args:
        scores: The scores; all points in the box count at which no rollout failed.
        windows: The windows.
        lower, upper: The box, (n,).

    Attributes:
        points: Number of points.
    """

    def __init__(self, scores: _Scores, windows: Sequence[Window], lower: Array, upper: Array) -> None:
        self._lower, self._upper = lower, upper
        points = scores.evaluated_points(windows)
        u = np.array([[p.to_unit(x) for p, x in zip(scores.parameters, point, strict=True)] for point in points])
        table = scores.matrix(points, windows)
        rows = ((u >= lower - 1e-9) & (u <= upper + 1e-9)).all(axis=1) & np.isfinite(table).all(axis=1)
        self._terms, self._table = self._terms_at(u[rows]), table[rows]
        self.points = len(self._terms)
        if self.points < self._terms.shape[1]:
            raise CalibrationError(f"around the best point too many rollouts or losses fail: {scores.message}")

    def _terms_at(self, u: Array) -> Array:
        """Return the terms (points, m) of a quadratic at points (points, n) of the cube."""
        d = (u - 0.5 * (self._lower + self._upper)) / (0.5 * (self._upper - self._lower))
        pairs = np.triu_indices(d.shape[1])
        return np.column_stack([np.ones(len(d)), d, d[:, pairs[0]] * d[:, pairs[1]]])

    def minima(self, window_weights: Array, point_weights: Array, rng: np.random.Generator) -> Array:
        """Return the points (k, n) of the cube with the least score, for k weights of the windows and of the points.

        Where the quadratic has no minimum in the box, it is the least of random points; a random one if all are equal.
        """
        n = len(self._lower)
        candidates = rng.uniform(self._lower, self._upper, size=(_CANDIDATES, n))
        # The border belongs to the box: a random half of the candidates lies on one of its sides.
        sides = rng.integers(0, n, _CANDIDATES // 2)
        ends = np.where(rng.integers(0, 2, len(sides)) == 0, self._lower[sides], self._upper[sides])
        candidates[np.arange(len(sides)), sides] = ends
        corners = np.array(np.meshgrid(*zip(self._lower, self._upper, strict=True))).reshape(n, -1).T
        candidates = np.vstack([candidates, corners])
        terms = self._terms_at(candidates)
        pairs = np.triu_indices(n)
        minima = np.empty((len(window_weights), n))
        for k, (of_windows, of_points) in enumerate(zip(window_weights, point_weights, strict=True)):
            mean = self._table @ of_windows / of_windows.sum()
            root = np.sqrt(of_points)
            c = np.linalg.lstsq(root[:, np.newaxis] * self._terms, root * mean, rcond=None)[0]
            hessian = np.zeros((n, n))
            hessian[pairs] = c[n + 1 :]
            hessian += hessian.T
            if np.linalg.eigvalsh(hessian)[0] > 1e-9 * max(np.ptp(mean), 1e-300):
                d = -np.linalg.solve(hessian, c[1 : n + 1])
                if (abs(d) <= 1.0).all():
                    minima[k] = 0.5 * (self._lower + self._upper) + d * 0.5 * (self._upper - self._lower)
                    continue
            order = rng.permutation(len(candidates))
            minima[k] = candidates[order[np.argmin(terms[order] @ c)]]
        return minima


@dataclass(frozen=True, eq=False)
class _Fit:
    """The result of the search and of its bootstrap.

    Attributes:
        parameters: The parameters, in the order of a point.
        start: Their values in the scenario.
        estimate: Their best values.
        draws: Estimates by the draws of recordings, on the scale of the search, shape (draws, parameters).
        at_estimate: The scores of the fitted windows at the estimate.
        at_holdout: The scores of the windows that were kept back.
        start_is_as_good: Whether the start explains what was kept back about as well.
    """

    parameters: tuple[Parameter, ...]
    start: Sequence[float]
    estimate: Point
    draws: Array
    at_estimate: Sequence[_WindowScore]
    at_holdout: Sequence[_WindowScore]
    start_is_as_good: bool

    @property
    def losses(self) -> Array:
        """Return the losses of the fitted windows."""
        return np.array([each.loss for each in self.at_estimate])

    @property
    def holdout(self) -> float:
        """Return the mean loss of the windows that were kept back."""
        return float(np.mean([each.loss for each in self.at_holdout]))

    @property
    def outside(self) -> float:
        """Return the share of the fitted windows whose recording is outside of the simulations."""
        return float(np.mean([each.outside for each in self.at_estimate]))

    def information(self) -> Information:
        """Return the information of the recordings about the parameters, in units of half their ranges."""
        names = tuple(parameter.address for parameter in self.parameters)
        scales = np.array([0.5 * (parameter.upper - parameter.lower) for parameter in self.parameters])
        # The draws in units of half the ranges, on the scale of the search.
        spread = np.atleast_2d(np.cov(2.0 * self.draws.T)) + 1e-12 * np.eye(len(names))
        return Information(names, scales, np.asarray(np.linalg.inv(spread), dtype=float))

    def calibrated(self, k: int, verdict: Verdict, information: Information) -> Calibrated:
        """Return parameter number ``k`` with its interval; its verdict is ``verdict`` unless it has one of its own."""
        parameter, value = self.parameters[k], self.estimate[k]
        samples = np.array([parameter.from_unit(u) for u in self.draws[:, k]])
        lower, upper = np.quantile(samples, [0.025, 0.975])
        if not all(1e-3 < parameter.to_unit(x) < 1.0 - 1e-3 for x in (lower, value, upper)):
            verdict = Verdict.AT_BOUND
        if parameter.address not in information.identifiable:
            verdict = Verdict.NOT_IDENTIFIABLE
        return Calibrated(
            parameter.address,
            self.start[k],
            float(value),
            float(samples.std()),
            float(lower),
            float(upper),
            verdict,
        )

    def posterior(self) -> Posterior:
        """Return the distribution of the parameters by the draws."""
        values = np.array([[p.from_unit(u) for p, u in zip(self.parameters, draw, strict=True)] for draw in self.draws])
        return Posterior(
            addresses=[parameter.address for parameter in self.parameters],
            mean=[float(value) for value in self.estimate],
            covariance=np.atleast_2d(np.cov(values.T)).tolist(),
            lower=[float(parameter.lower) for parameter in self.parameters],
            upper=[float(parameter.upper) for parameter in self.parameters],
        )


def _judged(fit: _Fit, *, outside: float | None, chance: float) -> tuple[Verdict, list[str]]:
    """Return the verdict on a fit, and the reasons against it."""
    reasons = []
    loss = float(fit.losses.mean())
    if outside is not None and outside > chance + OUTSIDE:
        reasons.append(
            f"in {outside:.0%} of the windows the recording is farther from the simulations than these from each "
            f"other ({chance:.0%} by chance): the model lacks something, or the starts are not known as well as given"
        )
    if not fit.holdout <= WORSE * loss:
        reasons.append(f"the recordings that were kept back fit {fit.holdout / loss:.2g} times worse")
    if reasons:
        return Verdict.DISCREPANT, reasons
    if not fit.start_is_as_good:
        return Verdict.ACCEPTED, reasons
    return Verdict.NO_EVIDENCE, [
        "the start explains the recordings that were kept back about as well: little speaks for other values"
    ]


def _result(scenario: Scenario, windows: Sequence[Window], fit: _Fit, *, rollouts: int) -> RolloutCalibration:
    count = len(windows[0].starts)
    chance = 1.0 / (count + 1)
    outside = fit.outside if count > 1 else None
    verdict, reasons = _judged(fit, outside=outside, chance=chance)
    information = fit.information()
    results = {parameter.address: fit.calibrated(k, verdict, information) for k, parameter in enumerate(fit.parameters)}
    logs = {f"{window.source} from {window.times[0]:g} s": window.digest for window in windows}
    return RolloutCalibration(
        scenario=calibrated_scenario(scenario, results, fit.posterior(), logs=logs, reasons=reasons),
        parameters=results,
        combinations=information.combinations,
        noise=None,
        fit=float(fit.losses.mean()),
        holdout=fit.holdout,
        correlation=nan,
        reasons=tuple(reasons),
        remarks=(),
        information=information,
        segments=len(fit.at_estimate),
        sources=tuple(dict.fromkeys(window.source for window in windows)),
        outside=outside,
        chance=chance,
        losses=fit.losses,
        rollouts=rollouts,
    )


def _is_as_good(
    scores: _Scores, windows: Sequence[Window], start: Sequence[float], estimate: Point, weights: Array
) -> bool:
    """Return whether the start is in the ranges, and the estimate is not surely better in what was kept back.

    Sure is what holds in 97.5 % of the draws of recordings.
    """
    if not all(p.lower <= value <= p.upper for p, value in zip(scores.parameters, start, strict=True)):
        return False
    by_start, by_estimate = scores.matrix([tuple(start), estimate], windows)
    better = weights @ (by_start - by_estimate) > 0.0
    return bool(better.mean() < _SURE and not np.isnan(by_start).any())


def _start(scenario: Scenario, testbed: VirtualTestbed, parameter: Parameter) -> float:
    """Return the value that a parameter has in the scenario."""
    if not parameter.is_field:
        return float(testbed.read(testbed.default_context(), parameter.address))
    name = parameter.address.partition(".")[2]
    scenario.with_fields({name: 0.5 * (parameter.lower + parameter.upper)})  # It refuses what is no such field.
    return float(attrgetter(name)(scenario))
