"""The Pareto front of many points in a time that hardly grows faster than their number."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

# Rows that are compared with each other, each with each; more are divided.
_TOGETHER = 64


def undominated(values: ArrayLike) -> np.ndarray:
    """Return a mask (n,) of the rows that no other row dominates: is nowhere smaller, and somewhere larger.

    Equal rows do not dominate each other. It takes O(n log n) comparisons for two columns, and O(n log^(k-2) n) for
    k > 2 of them: the rows are divided by one column after the other (Kung et al.).

    Kung, H. T., Luccio, F. and Preparata, F. P. (1975): On finding the maxima of a set of vectors. J. ACM 22.

    Args:
        values: The values, larger is better, none of them NaN, shape (n, k).
    """
    table = np.asarray(values, dtype=float)
    if not len(table):
        return np.zeros(0, bool)
    rows, which = np.unique(-table, axis=0, return_inverse=True)
    # Distinct rows, the largest first column first: a row is dominated by earlier ones only.
    best = np.zeros(len(rows), bool)
    best[_front(-rows, np.arange(len(rows)))] = True
    return np.asarray(best[which.reshape(-1)])


def _front(rows: np.ndarray, numbers: np.ndarray) -> np.ndarray:
    """Return the undominated ones among some rows, which are given by their numbers in increasing order."""
    if len(numbers) <= _TOGETHER:
        block = rows[numbers]
        reached = (block[:, np.newaxis] <= block).all(axis=2)  # each row by itself at least, as all are distinct
        return np.asarray(numbers[reached.sum(axis=1) == 1])
    half = len(numbers) // 2
    upper, lower = _front(rows, numbers[:half]), _front(rows, numbers[half:])
    return np.concatenate([upper, _beaten_by_none(rows, upper, lower, min(1, rows.shape[1] - 1))])


def _beaten_by_none(rows: np.ndarray, upper: np.ndarray, lower: np.ndarray, column: int) -> np.ndarray:
    """Return the rows ``lower`` to which no row ``upper`` is equal or superior in all columns from ``column`` on."""
    if not len(upper) or not len(lower):
        return lower
    last = rows.shape[1] - 1
    if column == last:
        return np.asarray(lower[rows[lower, column] > rows[upper, column].max()])
    if column == last - 1:
        return _beaten_in_two(rows, upper, lower, column)
    if min(len(upper), len(lower)) <= _TOGETHER:
        beaten = np.zeros(len(lower), bool)
        small, large = (upper, lower) if len(upper) <= len(lower) else (lower, upper)
        for row in small:
            if small is upper:
                beaten |= (rows[row, column:] >= rows[large, column:]).all(axis=1)
            else:
                beaten[lower == row] = (rows[large, column:] >= rows[row, column:]).all(axis=1).any()
        return np.asarray(lower[~beaten])
    levels = np.unique(rows[np.concatenate([upper, lower]), column])
    if len(levels) == 1:
        return _beaten_by_none(rows, upper, lower, column + 1)
    level = levels[len(levels) // 2]
    upper_high, lower_high = rows[upper, column] >= level, rows[lower, column] >= level
    high = _beaten_by_none(rows, upper[upper_high], lower[lower_high], column)
    low = _beaten_by_none(rows, upper[~upper_high], lower[~lower_high], column)
    low = _beaten_by_none(rows, upper[upper_high], low, column + 1)
    # In the order of the rows, by which `_front` divides them.
    return np.sort(np.concatenate([high, low]))


def _beaten_in_two(rows: np.ndarray, upper: np.ndarray, lower: np.ndarray, column: int) -> np.ndarray:
    order = upper[np.argsort(-rows[upper, column], kind="stable")]
    reached = np.maximum.accumulate(rows[order, column + 1])
    # The number of upper rows that are at least as large in the first of the two columns.
    count = np.searchsorted(-rows[order, column], -rows[lower, column], side="right")
    highest = np.where(count > 0, reached[np.maximum(count - 1, 0)], -np.inf)
    return np.asarray(lower[(count == 0) | (rows[lower, column + 1] > highest)])
