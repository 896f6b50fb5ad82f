"""Votes of pairs of landmarks for poses on a map: candidates for global localization.

Two local landmarks at a distance ℓ can be any pair of the map with that distance and with diameters like theirs. Each
such pair is a vote for a pose. Each local pair with both landmarks on the map votes for the right pose; for a
wrong pose, few vote by chance.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import pi

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from vtbdrake.common.arrays import Array

Singles = NDArray[np.float32]

# Least distance of a pair, in m: close pairs say little about the heading.
_NEAREST = 3.0
# Largest distance of a pair, in m: there are too many farther ones.
_FARTHEST = 15.0

# Local pairs vote until there are at least this number of votes.
_ENOUGH = 800_000
# Largest number of votes, by memory.
_LIMIT = 20_000_000
# They vote until the right cell has this number of standard deviations more votes than other cells, too.
_CONTRAST = 10.0
# Share of the pairs that vote for the right cell, assumed.
_RIGHT = 0.08
_FEWEST_PAIRS = 25

# Pairs agree within this many standard deviations of their distance and of each diameter.
_GATE = 1.5

# The width of a cell in standard deviations of the votes.
_CELL = 3.0

# Poses are searched up to this distance beyond the landmarks of the map, in m.
_MARGIN = 20.0


@dataclass(frozen=True, eq=False)
class LocalPairs:
    """Pairs of local landmarks in a frame C, in random order, so that the first ones involve many landmarks.

    Attributes:
        distances: Distances of the two landmarks in m, (n,).
        angles: Directions from the first to the second landmark in rad, (n,).
        middles: Midpoints in m, (n, 2).
        deviations: Standard deviations of the difference between a distance here and on the map in m, (n,).
        diameters: Diameters of the first and the second landmark in m, (n, 2).
        diameter_variances: Variances of the diameters in m², (n, 2).
    """

    distances: Array
    angles: Array
    middles: Array
    deviations: Array
    diameters: Array
    diameter_variances: Array

    @classmethod
    def of(
        cls,
        places: Array,
        variances: Array,
        *,
        diameters: Array,
        diameter_variances: Array,
        map_variance: float,
        correlation: float,
    ) -> LocalPairs:
        """Return the pairs of landmarks.

        Args:
            places: Their positions in C in m, (n, 2).
            variances: Variances of their positions per axis in m², (n,).
            diameters: Their diameters in m, (n,).
            diameter_variances: Variances of the diameters in m², (n,).
            map_variance: Variance of the positions on the map per axis in m².
            correlation: Length in m over which the errors of the map are correlated, 0 if they are independent.
        """
        pairs = _pairs(places, cKDTree(places))
        pairs = pairs[np.random.default_rng(0).permutation(len(pairs))]
        delta = places[pairs[:, 1]] - places[pairs[:, 0]]
        middles = 0.5 * (places[pairs[:, 0]] + places[pairs[:, 1]])
        distances = np.hypot(*delta.T)
        together = np.exp(-0.5 * (distances / correlation) ** 2) if correlation else 0.0
        square = variances[pairs].sum(axis=1) + 2.0 * map_variance * (1.0 - together)
        angles = np.arctan2(delta[:, 1], delta[:, 0])
        return cls(distances, angles, middles, np.sqrt(square), diameters[pairs], diameter_variances[pairs])


@dataclass(frozen=True, eq=False)
class PairTable:
    """All pairs of landmarks of a map that are 3 to 15 m apart, sorted by their distance.

    A pair takes 32 bytes; a stand with 800 trees/ha has 27 pairs per tree.

    Attributes:
        distances: Distances of the two landmarks in m, (n,).
        angles: Directions from the first to the second landmark in rad, (n,).
        middles: Midpoints in m, (2, n).
        diameters: Diameters of the first and the second landmark in m, (2, n).
        reaches: The map's share of the squared gate of each diameter in m², (2, n).
        low: The least coordinates of landmarks of the map in m, (2,).
        high: The largest coordinates in m, (2,).
    """

    distances: Singles
    angles: Singles
    middles: Singles
    diameters: Singles
    reaches: Singles
    low: Array
    high: Array

    @classmethod
    def of(cls, places: Array, tree: cKDTree, *, diameters: Array, diameter_variances: Array) -> PairTable:
        """Return the table of landmarks.

        Args:
            places: Their positions in a frame M near them in m, (n, 2).
            tree: The k-d tree of these positions.
            diameters: Their diameters in m, (n,).
            diameter_variances: Variances of the diameters in m², (n,).
        """
        pairs = _pairs(places, tree)
        delta = places[pairs[:, 1]] - places[pairs[:, 0]]
        distances = np.hypot(*delta.T)
        order = np.argsort(distances)
        pairs, delta = pairs[order], delta[order]
        return cls(
            distances[order].astype(np.float32),
            np.arctan2(delta[:, 1], delta[:, 0]).astype(np.float32),
            (0.5 * (places[pairs[:, 0]] + places[pairs[:, 1]])).T.astype(np.float32, order="C"),
            diameters[pairs.T].astype(np.float32),
            (_GATE**2 * diameter_variances[pairs.T]).astype(np.float32),
            places.min(axis=0),
            places.max(axis=0),
        )

    def favourites(self, local: LocalPairs, *, count: int) -> Array:
        """Return the poses X_MC with the most votes, (k, 3) in m and rad.

        Args:
            local: The pairs of local landmarks, in C.
            count: The largest number of poses.
        """
        reach = _GATE * local.deviations
        ends = np.array([local.distances - reach, local.distances + reach], dtype=np.float32)
        begin, end = np.asarray(np.searchsorted(self.distances, ends))
        if not len(begin):
            return np.zeros((0, 3))
        turn = float(np.median(local.deviations / local.distances))
        arms = np.hypot(*local.middles.T) / local.distances
        shift = float(np.median(local.deviations * np.sqrt(0.25 + arms**2)))
        cell, sectors = float(np.clip(_CELL * shift, 0.6, 3.0)), int(2.0 * pi / np.clip(_CELL * turn, 0.04, 0.4))
        low, high = self.low - _MARGIN, self.high + _MARGIN
        columns, lines = ((high - low) / cell).astype(int) + 2
        # With p pairs of v votes each and c cells, a cell has p v / c votes by chance; the right one has p _RIGHT more.
        sums = 2 * np.cumsum(end - begin)
        density = float(sums[-1]) / len(sums) / (columns * lines * sectors)
        needed = max(_FEWEST_PAIRS, _CONTRAST**2 * density / _RIGHT**2, np.searchsorted(sums, _ENOUGH) + 1)
        rows = range(min(len(sums), int(needed), int(np.searchsorted(sums, _LIMIT)) + 1))
        votes = np.concatenate([self._votes(local, row, slice(begin[row], end[row])) for row in rows])
        votes = votes[((votes[:, :2] > low) & (votes[:, :2] < high)).all(axis=1)]
        scaled = (votes[:, :2] - low.astype(np.float32)) / np.float32(cell)
        turned = votes[:, 2] * np.float32(sectors / (2.0 * pi))
        poses = []
        # Two grids, so that few places lie near the border of a cell in both.
        for offset in (np.float32(0.0), np.float32(0.5)):
            column, line = (scaled + offset).astype(np.int64).T
            sector = (turned + offset).astype(np.int64) % sectors
            poses.append(_crowded((sector * lines + line) * columns + column, votes, count // 2))
        return np.vstack(poses)

    def _votes(self, local: LocalPairs, row: int, part: slice) -> Singles:
        """Return the votes (n, 3) of one local pair, with headings in [0, 2π), for a part of the table."""
        votes = []
        x, y = local.middles[row].astype(np.float32)
        for flip in (False, True):
            alike = np.ones(part.stop - part.start, dtype=bool)
            for end in (0, 1):
                mapped_end = 1 - end if flip else end
                delta = self.diameters[mapped_end, part] - np.float32(local.diameters[row, end])
                reach = np.float32(_GATE**2 * local.diameter_variances[row, end])
                alike &= delta * delta <= self.reaches[mapped_end, part] + reach
            turn = np.float32(2.0 * pi)
            heading = self.angles[part][alike] - np.float32(local.angles[row] - pi * flip)
            heading -= turn * np.floor(heading / turn)
            c, s = np.cos(heading), np.sin(heading)
            middle = self.middles[:, part][:, alike]
            votes.append(np.column_stack([middle[0] - (c * x - s * y), middle[1] - (s * x + c * y), heading]))
        return np.concatenate(votes)


def _pairs(places: Array, tree: cKDTree) -> NDArray[np.intp]:
    """Return the pairs (n, 2) of places whose distance lies between `_NEAREST` and `_FARTHEST`."""
    pairs: NDArray[np.intp] = tree.query_pairs(_FARTHEST, output_type="ndarray")
    delta = places[pairs[:, 1]] - places[pairs[:, 0]]
    return pairs[(delta**2).sum(axis=1) >= _NEAREST**2]


def _crowded(cells: NDArray[np.int64], votes: Singles, count: int) -> Array:
    """Return the mean votes of the cells with the most votes, (k, 3), given the cell of each vote (n,)."""
    if not len(cells):
        return np.zeros((0, 3))
    # The index of the vote is in the lower bits, because np.sort is much faster than np.argsort.
    bits = len(cells).bit_length()
    packed = np.sort((cells << bits) | np.arange(len(cells)))
    sorted_cells = packed >> bits
    starts = np.flatnonzero(np.diff(sorted_cells, prepend=-1))
    sizes = np.diff(starts, append=len(cells))
    most = np.argsort(-sizes, kind="stable")[:count]
    runs = zip(starts[most], sizes[most], strict=True)
    rows = np.concatenate([packed[start : start + size] for start, size in runs]) & ((1 << bits) - 1)
    x, y, heading = votes[rows].astype(float).T
    columns = np.column_stack([x, y, np.cos(heading), np.sin(heading)])
    means = np.add.reduceat(columns, np.cumsum(sizes[most]) - sizes[most]) / sizes[most][:, np.newaxis]
    return np.column_stack([means[:, :2], np.arctan2(means[:, 3], means[:, 2])])
