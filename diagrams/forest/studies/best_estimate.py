"""The best unbiased estimate of a position on a map with errors, and a localization unit beside it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import solve_triangular

from vtbdrake.common.arrays import Array
from vtbdrake_diagrams.forest.scenario import CarrierScenario
from vtbdrake_diagrams.forest.studies.drive import Track
from vtbdrake_diagrams.forest.world.stand import MAPS, MapErrors

REACH = 20.0
"""Trees within this distance of the path count as seen, in m; see `best_estimates`. Assumed."""
NOISE = 0.02
"""Standard deviation in m, per axis, of a tree's position relative to the carrier; see `best_estimates`. Assumed."""
_DRAWS = 4000  # of forests, for an interval


def best_estimates(
    path: Array, places: Array, displacements: Array, errors: MapErrors, *, noise: float = NOISE
) -> tuple[Array, Array]:
    """Return errors of the best unbiased estimate of the position along a path, and their variances.

    At each point of the path, this estimate (of Gauss and Markov) has seen every tree within `REACH` of the path up to
    there, and knows its position relative to the carrier to ``noise`` per axis. The heading is unknown. The map says
    where the trees are, with the covariances C_ij = s^2 exp(-r_ij^2 / (2 L^2)) + noise^2 delta_ij per axis: what the
    errors of all trees have in common can be inferred only from how they vary from place to place. An error [t; theta]
    of the pose displaces the tree at d from the carrier by t + theta J d, where J is the rotation by a right angle. So

        [t; theta] = (X' C^-1 X)^-1 X' C^-1 e,    X = [I, J d] for each tree,    covariance (X' C^-1 X)^-1.

    Args:
        path: The points in m, shape (m, 2).
        places: The true positions of the trees that are on the map in m, shape (n, 2).
        displacements: Their errors e on the map in m, shape (n, 2).
        errors: The errors of the map.
        noise: Standard deviation of the relative position of a tree, per axis, in m.

    Returns:
        The errors t in m, shape (m, 2), and their variances (of both axes together) in m^2, shape (m,). NaN where fewer
        than two trees have been seen.
    """
    is_near = np.hypot(*(places[:, np.newaxis] - path).transpose(2, 0, 1)) < REACH
    first = np.where(is_near.any(axis=1), is_near.argmax(axis=1), len(path))
    order = np.argsort(first, kind="stable")[: np.count_nonzero(first < len(path))]
    p, e = places[order], displacements[order]
    squares = ((p[:, np.newaxis] - p) ** 2).sum(axis=2)
    shared = np.exp(-0.5 * squares / errors.correlation**2) if errors.correlation > 0.0 else np.eye(len(p))
    # With the trees in the order in which they are seen, those that were seen first are a leading block of C = L L'.
    L = np.linalg.cholesky(errors.position**2 * shared + noise**2 * np.eye(len(p)))
    Y = solve_triangular(L, np.column_stack([np.ones(len(p)), p, e]), lower=True)
    sums = np.cumsum(Y[:, :, np.newaxis] * Y[:, np.newaxis, :], axis=0)
    count = np.searchsorted(first[order], np.arange(len(path)), side="right")
    is_seen = count >= 2
    # Sums over pairs of trees, weighted by C^-1: of 1, x and y (from the carrier), and of their products with e.
    G = np.empty((is_seen.sum(), 5, 5))
    G[:] = sums[count[is_seen] - 1]
    T = np.tile(np.eye(5), (len(G), 1, 1))
    T[:, 1:3, 0] = -path[is_seen]
    G = T @ G @ T.transpose(0, 2, 1)
    zero = np.zeros(len(G))
    A = np.array(
        [
            [G[:, 0, 0], zero, -G[:, 0, 2]],
            [zero, G[:, 0, 0], G[:, 0, 1]],
            [-G[:, 0, 2], G[:, 0, 1], G[:, 1, 1] + G[:, 2, 2]],
        ]
    ).transpose(2, 0, 1)
    b = np.array([G[:, 0, 3], G[:, 0, 4], G[:, 1, 4] - G[:, 2, 3]]).T
    covariance = np.linalg.inv(A)
    estimates, variances = np.full((len(path), 2), np.nan), np.full(len(path), np.nan)
    estimates[is_seen] = (covariance @ b[:, :, np.newaxis])[:, :2, 0]
    variances[is_seen] = covariance[:, 0, 0] + covariance[:, 1, 1]
    return estimates, variances


@dataclass(frozen=True)
class BestError:
    """The errors of a unit beside the errors of the best estimate, `best_estimates`, at the same scans.

    Attributes:
        least: RMS error of the best estimate over all maps of this kind, in m.
        on_maps: RMS error of the best estimate on the very maps of the drives, in m. It differs from ``least`` if the
            maps are few.
        ratio: RMS error of the unit over ``on_maps``.
        interval: The interval of ``ratio`` with 95 % confidence, by drawing the forests again (bootstrap).
    """

    least: float
    on_maps: float
    ratio: float
    interval: tuple[float, float]


def against_best(tracks: Mapping[int, Track], name: str, *, scenario: Callable[[int], CarrierScenario]) -> BestError:
    """Compare the errors of a unit with the errors of the best estimate on the same maps.

    Args:
        tracks: The tracks by the seed of their scenario.
        name: The name of the map in `MAPS`.
        scenario: The function that returns the scenario of a seed.
    """
    errors, sums, count = MAPS[name], [], 0
    for seed, track in tracks.items():
        survey = scenario(seed).surveyed_map
        # Without errors of the positions, the same survey has the same entries in the same order.
        mapped, places = (
            survey(survey_errors).positions()[:, :2] for survey_errors in (errors, replace(errors, position=0.0))
        )
        # A wrong entry is displaced from nothing.
        is_true = (mapped != places).any(axis=1)
        path = track.drive.truth[:, :2]
        best, variances = best_estimates(path, places[is_true], (mapped - places)[is_true], errors)
        both = track.is_localized & np.isfinite(variances)
        units = (track.poses[:, :2] - path)[both]
        sums.append([(units**2).sum(), (best[both] ** 2).sum(), variances[both].sum()])
        count += int(both.sum())
    unit, on_maps, least = (totals := np.array(sums)).sum(axis=0)
    drawn = totals[np.random.default_rng(0).integers(len(totals), size=(_DRAWS, len(totals)))].sum(axis=1)
    low, high = np.sqrt(np.quantile(drawn[:, 0] / drawn[:, 1], [0.025, 0.975])).tolist()
    return BestError(
        float(np.sqrt(least / count)), float(np.sqrt(on_maps / count)), float(np.sqrt(unit / on_maps)), (low, high)
    )
