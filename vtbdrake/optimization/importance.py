"""Importances of parameters: their shares in whether a point of a study is among the best, by PED-ANOVA."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import scipy

from vtbdrake.common.arrays import Array
from vtbdrake.optimization.parameter import Choice, Dimension
from vtbdrake.optimization.records import Trial

if TYPE_CHECKING:
    from vtbdrake.optimization.study import Study

# Least number of points with a value.
FEWEST = 10
# Share of the points that counts as the best.
_BEST = 0.1
# Cells of a range.
_CELLS = 50
# Least width of a kernel, in cells: 90 % of it are in the cell of its point.
_NARROWEST = 0.5 / 1.64
# A probability that is as good as none.
_TINY = 1e-12


def importances(study: Study) -> tuple[dict[str, float], ...]:
    """Return the parameters' shares in deciding whether a point is among the best tenth: by quality and address.

    The shares of a quality sum to 1, the largest comes first. They are computed from the points that have a value, by
    PED-ANOVA: the Pearson divergence between the densities of the best and of all points, along each parameter.
    Watanabe, S., Bansal, A. and Hutter, F. (2023): PED-ANOVA. Efficiently quantifying hyperparameter importance in
    arbitrary subspaces. IJCAI.

    Raises:
        ValueError: Fewer than ten points have a value, or they all have the same.
    """
    trials = study.trials
    return tuple(
        importances_of(trials, study.parameters, quality=quality, name=name, sign=sign)
        for quality, (name, sign) in enumerate(zip(study.names, study.signs, strict=True))
    )


def importances_of(
    trials: Sequence[Trial], parameters: Sequence[Dimension], *, quality: int, name: str, sign: float
) -> dict[str, float]:
    """Return the parameters' shares for one quality, by address, the largest first; see `importances`.

    Args:
        trials: The points; those without a value are left out.
        parameters: The parameters, with ranges that have all points.
        quality: The number of the quality.
        name: Its name, for errors.
        sign: 1.0 if larger values are better, -1.0 for a cost.

    Raises:
        ValueError: Fewer than ten points have a value, or they all have the same.
    """
    valued = [trial for trial in trials if trial.exact and not trial.failed]
    if len(valued) < FEWEST:
        raise ValueError(f"importances need at least {FEWEST} points with a value, but the study has {len(valued)}")
    worth = sign * np.array([trial.values[quality] for trial in valued])
    if np.ptp(worth) == 0.0:
        raise ValueError(f"{name} is {valued[0].values[quality]:g} at all points, so no parameter is important")
    is_best = worth >= np.sort(worth)[-math.ceil(_BEST * len(worth))]
    divergences = {}
    for parameter in parameters:
        cells, count = _cells(parameter, [trial.parameters[parameter.address] for trial in valued])
        density = _choice_density if isinstance(parameter, Choice) else _density
        best, all_ = density(cells[is_best], count) + _TINY, density(cells, count) + _TINY
        divergences[parameter.address] = float(all_ @ (best / all_ - 1.0) ** 2) if count > 1 else 0.0
    total = sum(divergences.values())
    shares = {a: d / total if total > 0.0 else 1.0 / len(divergences) for a, d in divergences.items()}
    return dict(sorted(shares.items(), key=lambda item: -item[1]))


def _cells(parameter: Dimension, values: Sequence[float]) -> tuple[Array, int]:
    """Return the numbers of the cells in which the values of a parameter are, shape (n,), and how many cells it has."""
    if isinstance(parameter, Choice):
        return np.array([parameter.options.index(value) for value in values]), len(parameter.options)
    count, scale = _CELLS, np.log if parameter.log else np.asarray
    if parameter.integer:
        levels = int(parameter.upper) - int(parameter.lower) + 1
        count = min(count, math.ceil(math.log2(levels)) + 1 if parameter.log else levels)
    lower, upper = scale([parameter.lower, parameter.upper])
    cells = np.ceil((scale(values) - lower) / (upper - lower) * (count - 1) - 0.5).astype(int)
    return np.clip(cells, 0, count - 1), count


def _density(cells: Array, count: int) -> Array:
    """Return the probability of each of ``count`` cells, shape (count,): kernels at the points, and a wide one.

    A kernel is a normal distribution within the range, integrated over each cell; its width is by Scott's rule (1992).
    The wide one, in the middle, has the weight of one point.
    """
    points = np.sort(cells)
    n = len(points)
    quartiles = points[max(n // 4 - 1, 0)], points[min(3 * n // 4, n - 1)]
    deviation = np.sqrt(((points - points.mean()) ** 2).sum() / max(1, n - 1))
    scott = 1.059 * min((quartiles[1] - quartiles[0]) / 1.34, deviation) * n**-0.2
    centres = np.append(points, (count - 1) / 2.0)[:, np.newaxis]
    widths = np.append(np.full(n, max(scott, _NARROWEST)), count)[:, np.newaxis]
    below = scipy.special.ndtr((np.arange(count + 1) - 0.5 - centres) / widths)
    kernels = np.diff(below) / (below[:, -1:] - below[:, :1])
    density: Array = kernels.mean(axis=0)
    return density


def _choice_density(options: Array, count: int) -> Array:
    """Return the probability of each of ``count`` options, shape (count,): smoothed frequencies, and a uniform one."""
    base = 1.0 / (len(np.unique(options)) + 1)
    frequencies = (np.bincount(options, minlength=count) + len(options) * base) / (1.0 + count * base)
    density: Array = (frequencies + 1.0 / count) / (len(options) + 1)
    return density
