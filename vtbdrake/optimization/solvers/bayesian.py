"""Bayesian optimization: a Gaussian process predicts where the values improve."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence, Set
from functools import cache
from itertools import islice
from typing import TYPE_CHECKING

import numpy as np
import scipy

from vtbdrake.optimization.parameter import Choice
from vtbdrake.optimization.solvers.designs import sobol_units
from vtbdrake.optimization.solvers.solver import Evaluation, Point, Search, Solver, SolverError, rank_key

if TYPE_CHECKING:
    from threadpoolctl import ThreadpoolController

# Candidates of the acquisition over the whole space.
SPREAD = 500
# Candidates around the best points.
AROUND = 200
# Candidates around each of the best candidates, per step of `WIDTHS`.
REFINED = 10
# Number of the best candidates.
BEST = 5
# Widths of these steps, as parts of the ranges.
WIDTHS = (0.1, 0.03, 0.01, 0.003, 0.001, 0.0003)
# Priors of the logarithms of the kernel's hyperparameters: median, width.
# The signal.
SIGNAL = (1.0, 1.0)
# The length scales, as parts of the ranges.
LENGTH = (0.5, 1.0)
# The noise.
NOISE = (1e-4, 3.0)
# Ranges of the hyperparameters.
SIGNAL_RANGE = (0.05, 20.0)
LENGTH_RANGE = (0.02, 20.0)
NOISE_RANGE = (1e-7, 0.5)
# What is added to the variances, so that the covariances can be factorized.
JITTER = 1e-10
# Draws of the posterior of several objectives.
DRAWS = 64


class Bayesian(Solver):
    """Bayesian optimization: asks for the points of the largest expected improvement (EI) of Gaussian processes.

    The first points are a Sobol design. After each batch, a Gaussian process is fitted to every objective and every
    constraint. A random search with shrinking steps then maximizes the EI times the probability that all constraints
    hold. Within a batch, the model takes its own predictions of the earlier points as known. Several objectives are
    weighed at random for every point (ParEGO), which covers the whole Pareto front.

    The kernel is Matern 5/2, with a length scale per parameter, and noise; its hyperparameters have the largest
    posterior density. Choices are coded one-hot. Objectives are transformed towards a normal distribution (Yeo and
    Johnson). A failed simulation counts as the worst value so far. Choosing a point takes tens of milliseconds: where a
    rollout takes less, CMA-ES may be the better choice.

    Args:
        search: Any parameters (20 at most are reasonable), objectives and constraints.
        name: Name in the catalogue.
        initial: Points of the design; by default 2 (n + 1), at least one batch, and half of the budget at most. There
            is no design if as many points were given by hand before.
        batch: How many points it asks for at a time; by default 4, or as many as run side by side (`Search.parallel`).
        memory: How many points the model is fitted to at most: the best ones and the latest.

    Jones, D. R., Schonlau, M. and Welch, W. J. (1998): Efficient global optimization of expensive black-box functions,
    J. Global Optimization 13. Knowles, J. (2006): ParEGO, IEEE Trans. Evolutionary Computation 10.
    """

    def __init__(
        self, search: Search, *, name: str, initial: int | None = None, batch: int | None = None, memory: int = 100
    ) -> None:
        super().__init__(search, name=name)
        for option, number in (("initial", initial), ("batch", batch), ("memory", memory)):
            if number is not None and number < 1:
                raise SolverError(f"{option} is a number of points, at least one, not {number}")
        most = search.budget if search.budget is None else max(1, search.budget // 2)
        self._initial = initial or min(search.batch(2 * (search.size + 1)), most or 1 << 16)
        self._batch = batch or search.batch(4)
        self._memory = memory
        self._evaluations: dict[Point, Evaluation] = {}
        self._begun = False
        self._rng = np.random.default_rng(search.seed)
        self._models = [_Model() for _ in range(search.objectives + search.constraints)]

    def _learn(self, evaluations: Sequence[Evaluation], by_hand: Sequence[Evaluation]) -> None:
        self._evaluations.update({evaluation.point: evaluation for evaluation in (*evaluations, *by_hand)})

    def _next(self) -> list[Point]:
        begun, self._begun = self._begun, True
        if not begun and len(self._evaluations) < self._initial:
            return self._design()
        with _linear_algebra().limit(limits=1, user_api="blas"):
            points = self._proposals()
        if not points:
            self._end(True, "every point of the space is known")
        return points

    def _design(self) -> list[Point]:
        units = islice(sobol_units(self.search), 1 << (self._initial - 1).bit_length())
        start = [] if self.search.start is None else [self.search.start]
        return list(dict.fromkeys([*start, *(self.search.point(u) for u in units)]))[: self._initial]

    # -- proposals

    def _proposals(self) -> list[Point]:
        remembered = self._remembered()
        if not any(evaluation.usable for evaluation in remembered):
            drawn = (self.search.point(u) for u in self._rng.random((SPREAD, self.search.size)))
            return list(dict.fromkeys(point for point in drawn if point not in self._evaluations))[: self._batch]
        units, X, targets = self._fit(remembered)
        counted = np.array([evaluation.counts for evaluation in remembered])
        best = self._best_first(remembered, targets)
        centres = units[best[: BEST if self.search.objectives == 1 else 4 * BEST]]
        points: list[Point] = []
        while len(points) < self._batch:
            u = self._maximize(self._acquisition(X, targets, counted), centres, exclude={*self._evaluations, *points})
            if u is None:
                break
            points.append(self.search.point(u))
            for model in self._models if len(points) < self._batch else ():
                model.believe(self._encoded(u[np.newaxis]))
        return points

    def _fit(self, evaluations: Sequence[Evaluation]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Fit the models; return the places of the evaluations, the kernel's input there, and the targets."""
        units = np.array([self.search.unit(evaluation.point) for evaluation in evaluations])
        targets = self._targets(evaluations)
        X = self._encoded(units)
        for model, target in zip(self._models, targets.T, strict=True):
            model.fit(X, target)
        return units, X, targets

    def mean(self, units: np.ndarray) -> np.ndarray:
        """Return the values that the models expect in places of the unit cube, (k, n) -> (k, objectives).

        A mean is taken over the transformed values and transformed back: rather a median. It lies between the worst and
        the best value so far. Without any value it is NaN.
        """
        remembered = self._remembered()
        usable = np.array([evaluation.usable for evaluation in remembered], dtype=bool)
        if not usable.any():
            return np.full((len(units), self.search.objectives), np.nan)
        with _linear_algebra().limit(limits=1, user_api="blas"):
            _, _, targets = self._fit(remembered)
            places = self._encoded(self._snapped(units))
            columns = []
            for k, model in enumerate(self._models[: self.search.objectives]):
                values = np.array([evaluation.values[k] for evaluation in remembered])[usable]
                order = np.argsort(targets[usable, k], kind="stable")
                columns.append(np.interp(model.predict(places)[0], targets[usable, k][order], values[order]))
        return np.column_stack(columns)

    def _remembered(self) -> list[Evaluation]:
        """Return the points that the model is fitted to: all, or the best and the latest, half each."""
        evaluations = list(self._evaluations.values())
        if len(evaluations) <= self._memory:
            return evaluations
        costs = np.array(
            [[-value for value in e.values] if e.usable else [np.inf] * len(e.values) for e in evaluations]
        )
        ranks = self._best_first(evaluations, costs)[: self._memory // 2].tolist()
        latest = [i for i in range(len(evaluations) - 1, -1, -1) if i not in set(ranks)][: self._memory - len(ranks)]
        return [evaluations[i] for i in sorted([*ranks, *latest])]

    def _best_first(self, evaluations: Sequence[Evaluation], costs: np.ndarray) -> np.ndarray:
        """Return the indices of evaluations, the best first; of several objectives, by how many points dominate."""
        if self.search.objectives == 1:
            return np.array(sorted(range(len(evaluations)), key=lambda i: rank_key(evaluations[i])))
        costs = costs[:, : self.search.objectives]
        feasible = np.array([evaluation.feasible for evaluation in evaluations])
        return np.lexsort((_domination(costs)[feasible].sum(axis=0), ~feasible))

    def _targets(self, evaluations: Sequence[Evaluation]) -> np.ndarray:
        """Return the models' targets, shape (k, objectives + constraints): costs, and violations scaled around 0."""
        rows = [
            [*(-value for value in e.values), *e.violations] if e.usable else [np.nan] * len(self._models)
            for e in evaluations
        ]
        table = np.array(rows)
        table[~np.isfinite(table)] = np.nan
        columns = []
        for i, column in enumerate(table.T):
            finite = column[np.isfinite(column)]
            filled = np.where(np.isfinite(column), column, finite.max() if finite.size else 0.0)
            columns.append(_normal(filled) if i < self.search.objectives else _scaled(filled))
        return np.column_stack(columns)

    def _acquisition(
        self, X: np.ndarray, targets: np.ndarray, counted: np.ndarray
    ) -> Callable[[np.ndarray], np.ndarray]:
        """Return the logarithm of EI and feasibility as a function of places in the unit cube, shape (k, n) -> (k,)."""
        objectives = self._models[: self.search.objectives]
        constraints = self._models[self.search.objectives :]
        # While no point is feasible, only feasibility counts.
        improvement = None
        if counted.any():
            improvement = (
                _expected_improvement(objectives[0], X[counted])
                if len(objectives) == 1
                else self._weighed_improvement(objectives, targets[counted, : len(objectives)])
            )

        def acquisition(units: np.ndarray) -> np.ndarray:
            places = self._encoded(units)
            value = np.zeros(len(units)) if improvement is None else improvement(places)
            for model in constraints:
                mean, deviation = model.predict(places)
                value = value + scipy.special.log_ndtr(-mean / deviation)
            return value

        return acquisition

    def _weighed_improvement(self, models: Sequence[_Model], costs: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
        """Return log EI of max_i(w_i c_i) + 0.05 sum_i(w_i c_i), with weights w drawn at random."""
        weights = self._rng.dirichlet(np.ones(len(models)))
        front = costs[~_domination(costs).any(axis=0)]
        lowest, width = front.min(axis=0), np.ptp(front, axis=0)
        width = np.where(width > 1e-6, width, 1.0)
        quantiles = scipy.special.ndtri((np.arange(DRAWS) + 0.5) / DRAWS)
        draws = [self._rng.permutation(quantiles) for _ in models]

        def weighed(each: Sequence[np.ndarray]) -> np.ndarray:
            """Return the weighed costs of one array per objective."""
            parts = [w * (c - low) / span for w, c, low, span in zip(weights, each, lowest, width, strict=True)]
            return np.asarray(np.maximum.reduce(parts) + 0.05 * np.add.reduce(parts))

        best = weighed(list(costs.T)).min()

        def improvement(places: np.ndarray) -> np.ndarray:
            means, deviations = zip(*(model.predict(places) for model in models), strict=True)
            drawn = [m[:, np.newaxis] + d[:, np.newaxis] * z for m, d, z in zip(means, deviations, draws, strict=True)]
            gains = np.maximum(best - weighed(drawn), 0.0)
            with np.errstate(divide="ignore"):  # log(0) is -inf, as it should be.
                expected = np.log(gains.mean(axis=1))
            # The small term leads to where a draw might improve, if none does. It must not underflow far from there.
            return np.asarray(np.logaddexp(expected, np.log(1e-9) + np.minimum(best - weighed(means), 0.0)))

        return improvement

    # -- candidates

    def _maximize(
        self, acquisition: Callable[[np.ndarray], np.ndarray], centres: np.ndarray, *, exclude: Set[Point]
    ) -> np.ndarray | None:
        """Return the best place found, shape (n,), that is none of some points; None if all places are."""
        around = [self._moved(np.repeat(centres, AROUND // len(centres), axis=0), width) for width in (0.1, 0.01)]
        units = np.vstack([self._rng.random((SPREAD, self.search.size)), *around])
        units = self._snapped(units)
        values = acquisition(units)
        for width in WIDTHS:
            top = np.argsort(-values, kind="stable")[: 2 * BEST]
            moved = self._moved(np.repeat(units[top], REFINED, axis=0), width)
            units, values = np.vstack([units[top], moved]), np.concatenate([values[top], acquisition(moved)])
        best = units[np.argsort(-values, kind="stable")]
        spare = self._snapped(self._rng.random((SPREAD, self.search.size)))
        return next((u for u in (*best, *spare) if self.search.point(u) not in exclude), None)

    def _moved(self, units: np.ndarray, width: float) -> np.ndarray:
        """Return normal steps along at least half of the coordinates; integers and choices may jump anywhere."""
        along = self._rng.random(units.shape) < max(0.5, 2.0 / self.search.size)
        moved = np.clip(units + width * along * self._rng.standard_normal(units.shape), 0.0, 1.0)
        for i, parameter in enumerate(self.search.space):
            if parameter.is_continuous:
                continue
            if isinstance(parameter, Choice):
                moved[:, i] = units[:, i]
            redrawn = self._rng.random(len(units)) < 0.2
            moved[redrawn, i] = self._rng.random(int(redrawn.sum()))
        return self._snapped(moved)

    def _snapped(self, units: np.ndarray) -> np.ndarray:
        """Move integers and choices to the middle of their shares of the unit cube."""
        snapped = units.copy()
        for i, parameter in enumerate(self.search.space):
            if not parameter.is_continuous:
                snapped[:, i] = [parameter.to_unit(parameter.from_unit(u)) for u in units[:, i]]
        return snapped

    def _encoded(self, units: np.ndarray) -> np.ndarray:
        """Return the kernel's input for places in the unit cube: numbers unchanged, choices one-hot."""
        columns = []
        for parameter, column in zip(self.search.space, units.T, strict=True):
            if isinstance(parameter, Choice):
                options = len(parameter.options)
                columns.append(0.5 * np.eye(options)[np.minimum((column * options).astype(int), options - 1)])
            else:
                columns.append(column[:, np.newaxis])
        return np.hstack(columns)


# -- the model


@cache
def _linear_algebra() -> ThreadpoolController:
    """Return a controller of the threads of the linear algebra: the last digits depend on their number."""
    # Imported and made once: it looks through all libraries of the process.
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()


class _Model:
    """A Gaussian process of one output, of mean 0: Matern 5/2 with a length scale per input, and noise."""

    def __init__(self) -> None:
        # The logarithms of the hyperparameters: signal, length scales, noise.
        self._theta: np.ndarray | None = None
        self._fitted = 0
        self._X, self._y = np.empty((0, 0)), np.empty(0)
        self._factor, self._alpha = np.empty((0, 0)), np.empty(0)

    def fit(self, X: np.ndarray, y: np.ndarray) -> None:
        """Fit the process to ``y``, shape (k,), at ``X``, shape (k, m); the kernel only if enough points are new."""
        theta = self._theta
        if theta is None:
            theta = np.log([SIGNAL[0], *[LENGTH[0] * X.shape[1] ** 0.25] * X.shape[1], NOISE[0]])
        if len(X) < 20 or abs(len(X) - self._fitted) > 0.05 * self._fitted:
            self._fitted = len(X)
            theta = _most_probable(X, y, theta)
        self._theta = theta
        self._set(X, y)

    def _set(self, X: np.ndarray, y: np.ndarray) -> None:
        assert self._theta is not None
        self._X, self._y = X, y
        K = self._kernel(X)
        K[np.diag_indices_from(K)] += math.exp(self._theta[-1]) + JITTER
        self._factor = scipy.linalg.cholesky(K, lower=True, check_finite=False)
        self._alpha = scipy.linalg.cho_solve((self._factor, True), y, check_finite=False)

    def _kernel(self, X: np.ndarray) -> np.ndarray:
        """Return the covariances of the signal at ``X``, shape (k, m), with the points of the fit: (k, points)."""
        assert self._theta is not None
        lengths = np.exp(self._theta[1:-1])
        r = math.sqrt(5.0) * scipy.spatial.distance.cdist(X / lengths, self._X / lengths)
        return np.asarray(math.exp(self._theta[0]) * (1.0 + r + r * r / 3.0) * np.exp(-r))

    def believe(self, x: np.ndarray) -> None:
        """Take the prediction at ``x``, shape (1, m), as known."""
        y = np.append(self._y, self._kernel(x) @ self._alpha)
        self._set(np.vstack([self._X, x]), y)

    def predict(self, X: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return mean and standard deviation without the noise, both of shape (k,)."""
        assert self._theta is not None
        K = self._kernel(X)
        projected = scipy.linalg.solve_triangular(self._factor, K.T, lower=True, check_finite=False)
        variance = math.exp(self._theta[0]) - np.einsum("ij,ij->j", projected, projected)
        return K @ self._alpha, np.sqrt(np.maximum(variance, 1e-12))


def _most_probable(X: np.ndarray, y: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Return the logarithms of a kernel's hyperparameters with the largest posterior density, from a start."""
    count, lengths = X.shape
    centre = np.log([SIGNAL[0], *[LENGTH[0] * lengths**0.25] * lengths, NOISE[0]])
    width = np.array([SIGNAL[1], *[LENGTH[1]] * lengths, NOISE[1]])
    squares = ((X[:, np.newaxis] - X) ** 2).reshape(count * count, lengths)
    diagonal = np.diag_indices(count)

    def density(theta: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the negative logarithm of the density, and its gradient."""
        signal, scales, noise = math.exp(theta[0]), np.exp(-2.0 * theta[1:-1]), math.exp(theta[-1])
        r = np.sqrt(5.0 * (squares @ scales)).reshape(count, count)
        decay = signal * np.exp(-r)
        K = decay * (1.0 + r + r * r / 3.0)
        noisy = K.copy()
        noisy[diagonal] += noise + JITTER
        try:
            factor = scipy.linalg.cholesky(noisy, lower=True, check_finite=False)
        except np.linalg.LinAlgError:
            return math.inf, np.zeros_like(theta)
        inverse = scipy.linalg.cho_solve((factor, True), np.eye(count), check_finite=False)
        alpha = inverse @ y
        weights = inverse - np.outer(alpha, alpha)
        slopes = (weights * decay * (1.0 + r)).ravel() @ squares * scales * (5.0 / 3.0)
        gradient = 0.5 * np.array([np.vdot(weights, K), *slopes, noise * np.trace(weights)])
        z = (theta - centre) / width
        value = 0.5 * float(y @ alpha) + float(np.log(factor[diagonal]).sum()) + 0.5 * float(z @ z)
        return value, gradient + z / width

    bounds = np.log([SIGNAL_RANGE, *[LENGTH_RANGE] * lengths, NOISE_RANGE])
    return np.asarray(
        scipy.optimize.minimize(density, start, jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": 15}).x
    )


def _expected_improvement(model: _Model, examined: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """Return the logarithm of the EI over the least mean at the ``examined`` places."""
    best = model.predict(examined)[0].min()

    def improvement(places: np.ndarray) -> np.ndarray:
        mean, deviation = model.predict(places)
        return np.log(deviation) + _log_h((best - mean) / deviation)

    return improvement


def _log_h(z: np.ndarray) -> np.ndarray:
    """Return log(phi(z) + z Phi(z)) of the standard normal distribution; by its asymptote phi(z) / z^2 if tiny."""
    log_phi = -0.5 * z**2 - 0.5 * np.log(2.0 * np.pi)
    near = np.maximum(z, -6.0)
    exact = np.log(np.exp(-0.5 * near**2) / np.sqrt(2.0 * np.pi) + near * np.exp(scipy.special.log_ndtr(near)))
    return np.where(z > -6.0, exact, log_phi - 2.0 * np.log(np.maximum(-z, 1.0)))


def _domination(costs: np.ndarray) -> np.ndarray:
    """Return whether row i of ``costs``, shape (k, m), dominates row j: nowhere worse, somewhere better; (k, k)."""
    no_worse = np.logical_and.reduce([column[:, np.newaxis] <= column for column in costs.T])
    return np.asarray(no_worse & ~no_worse.T)


def _normal(costs: np.ndarray) -> np.ndarray:
    """Transform costs, shape (k,), monotonically towards a standard normal distribution."""
    deviation = costs.std()
    if not deviation > 1e-12 * np.abs(costs).max():
        return np.zeros_like(costs)
    x = (costs - np.median(costs)) / deviation
    # The exponent is the most likely one on a grid, which is then refined.
    exponents = np.linspace(-4.0, 6.0, 51)
    for width in (0.2, 0.0):
        bent = np.where(
            x >= 0.0,
            scipy.special.boxcox1p(x, exponents[:, np.newaxis]),
            -scipy.special.boxcox1p(-x, 2.0 - exponents[:, np.newaxis]),
        )
        likelihood = (exponents - 1.0) * (np.sign(x) @ np.log1p(np.abs(x))) - 0.5 * len(x) * np.log(bent.var(axis=1))
        best = int(np.argmax(likelihood))
        exponents = np.linspace(exponents[best] - width, exponents[best] + width, 41)
    return np.asarray((bent[best] - bent[best].mean()) / (bent[best].std() or 1.0))


def _scaled(violations: np.ndarray) -> np.ndarray:
    """Return violations on a scale that is linear near 0 and logarithmic far from it."""
    scale = np.median(np.abs(violations)) or 1.0
    return np.asarray(np.sign(violations) * np.log1p(np.abs(violations) / scale))
