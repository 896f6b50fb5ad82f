"""Statistics of the features of a data set, by which LeRobot normalizes what a policy gets and gives."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

QUANTILES = (0.01, 0.10, 0.50, 0.90, 0.99)
"""The quantiles that LeRobot keeps."""

LARGEST_SAMPLE = 100
"""Number of pictures of an episode from which statistics are computed."""

LARGEST_SIDE = 150
"""Number of pixels to which the longer side of these pictures is thinned out."""

Statistics = Mapping[str, NDArray[Any]]
"""Arrays by the name of the statistic: min, max, mean, std, count, q01, q10, q50, q90, q99."""


def statistics_of(values: NDArray[Any]) -> Statistics:
    """Return the statistics of the rows of a feature, each of shape (m,), and ``count`` of shape (1,).

    Args:
        values: Shape (n, m).
    """
    numbers = np.asarray(values, dtype=float)
    quantiles = np.quantile(numbers, QUANTILES, axis=0)
    return {
        "min": numbers.min(axis=0),
        "max": numbers.max(axis=0),
        "mean": numbers.mean(axis=0),
        "std": numbers.std(axis=0),
        "count": np.array([len(numbers)]),
        **{f"q{round(100 * q):02d}": value for q, value in zip(QUANTILES, quantiles, strict=True)},
    }


class PictureStatistics:
    """Statistics of the pictures of an episode, per channel, of pixels from 0 to 1; some pictures are looked at.

    Args:
        count: Number of pictures of the episode.
    """

    def __init__(self, count: int) -> None:
        looked_at = np.linspace(0, count - 1, min(count, LARGEST_SAMPLE)).round().astype(int)
        self._looked_at = set(looked_at.tolist())
        self._pixels: list[NDArray[np.uint8]] = []

    def add(self, number: int, picture: NDArray[np.uint8]) -> None:
        """Look at a picture.

        Args:
            number: Its number in the episode, from 0 on.
            picture: Shape (height, width, 3).
        """
        if number in self._looked_at:
            step = -(-max(picture.shape[:2]) // LARGEST_SIDE)
            self._pixels.append(picture[::step, ::step].reshape(-1, 3).copy())

    def statistics(self) -> Statistics:
        """Return the statistics, each of shape (3, 1, 1); ``count`` is the number of pictures that were looked at."""
        values = statistics_of(np.concatenate(self._pixels) / 255.0)
        shaped = {name: value.reshape(-1, 1, 1) for name, value in values.items()}
        return shaped | {"count": np.array([len(self._pixels)])}


def aggregated(parts: Sequence[Statistics]) -> Statistics:
    """Return the statistics of all episodes, from each one's, as ``aggregate_feature_stats`` of LeRobot does.

    Mean and deviation are exact; a quantile is the mean of the quantiles of the episodes, weighted by their rows.

    Args:
        parts: The statistics of a feature by episode.
    """
    counts = np.array([float(part["count"][0]) for part in parts])
    weights = counts / counts.sum()

    def mean(values: Iterable[NDArray[Any]]) -> NDArray[Any]:
        total: NDArray[Any] = np.tensordot(weights, np.stack(list(values)), axes=1)
        return total

    center = mean(part["mean"] for part in parts)
    spread = mean(part["std"] ** 2 + (part["mean"] - center) ** 2 for part in parts)
    return {
        "min": np.min([part["min"] for part in parts], axis=0),
        "max": np.max([part["max"] for part in parts], axis=0),
        "mean": center,
        "std": np.sqrt(spread),
        "count": np.array([int(counts.sum())]),
        **{name: mean(part[name] for part in parts) for name in parts[0] if name.startswith("q")},
    }
