"""Trunks in planar scans of exact circles and walls, in closed form."""

from __future__ import annotations

import numpy as np
import pytest

from tests.components.localization.scans import pairs, trunk_ranges
from vtbdrake.components.localization.trunks import TrunkDetectorConfig, detect_planar_trunks

pytestmark = pytest.mark.one_python

EYE = np.array([0.2, -0.1, 0.5])
STEP, NOISE = np.radians(0.5), 0.02
# Exact circles have neither bark nor a bend.
EXACT = TrunkDetectorConfig(
    azimuth_step=STEP, range_noise=NOISE, roughness=0.0, position_floor=0.0, diameter_floor=0.0, cell=0.2
)


def scan(places, diameters, *, walls=(), field=(-np.pi, np.pi), noise=NOISE, seed=0):
    """Return the points of a row of rays, (n, 3): on circles, and on walls from an end to the other, ((2,), (2,))."""
    angles = np.arange(field[0], field[1] - 1e-9, STEP) + 0.5 * STEP
    rays = np.stack([np.cos(angles), np.sin(angles), np.zeros_like(angles)], axis=1)
    ranges = np.full(len(rays), np.inf)
    for place, diameter in zip(places, diameters, strict=True):
        ranges = np.minimum(ranges, trunk_ranges(EYE, rays, np.append(place, 0.0), diameter, np.zeros(2)))
    for begin, end in walls:
        # eye + t ray = begin + s (end - begin)
        A = np.stack([rays[:, :2], np.broadcast_to(np.subtract(begin, end), (len(rays), 2))], axis=2)
        t, s = np.linalg.solve(A, np.broadcast_to(begin - EYE[:2], (len(rays), 2))[:, :, None])[:, :, 0].T
        ranges = np.where((t > 0.0) & (s > 0.0) & (s < 1.0), np.minimum(ranges, t), ranges)
    hit = np.flatnonzero(ranges < 30.0)
    measured = ranges[hit] + noise * np.random.default_rng(seed).normal(size=len(hit))
    return EYE + rays[hit] * measured[:, None]


def ring(rng):
    """Return places and diameters of twelve trunks around the scanner, none behind another one."""
    bearings = 2.0 * np.pi * (np.arange(12) + 0.6 * rng.random(12)) / 12.0
    away = rng.uniform(2.0, 15.0, 12)[:, None]
    return EYE[:2] + away * np.stack([np.cos(bearings), np.sin(bearings)], axis=1), rng.uniform(0.15, 0.6, 12)


def test_circles_are_where_they_are_and_as_certain_as_claimed():
    rows, shown = [], 0
    for seed in range(60):
        places, diameters = ring(np.random.default_rng(seed))
        trunks = detect_planar_trunks(scan(places, diameters, seed=seed), EXACT, p_HoLo_H=EYE)
        which, truth = pairs(trunks.positions, places, within=0.3)
        assert len(which) == len(trunks)
        rays = diameters / np.linalg.norm(places - EYE[:2], axis=1) / STEP
        shown += np.sum(rays > 4.0)
        errors, thick = trunks.positions - places[truth], trunks.diameters - diameters[truth]
        nees = np.einsum("ki,kij,kj->k", errors, np.linalg.inv(trunks.covariances), errors)
        rows.append(np.stack([rays[truth], nees, thick, thick / trunks.diameter_deviations], axis=1))
    rays, nees, thick, scaled = np.vstack(rows).T
    assert np.sum(rays > 4.0) > 0.98 * shown
    # 2 and 1 are expected; some 600 trunks tell them to 6 % and 3 %.
    assert 1.7 < nees.mean() < 2.4 and np.mean(nees < 5.99) > 0.93
    assert 0.9 < np.sqrt(np.mean(scaled**2)) < 1.2
    assert abs(np.mean(thick[rays > 4.0])) < 0.015


def test_a_trunk_that_is_half_hidden_is_less_certain_and_covered():
    place, diameter = EYE[:2] + np.array([6.0, 0.0]), 0.5
    # A post whose left edge is seen in the direction of the trunk's axis.
    post, width = EYE[:2] + np.array([3.0, -0.06]), 0.12
    squares, deviations = [], {"free": [], "half hidden": []}
    for seed in range(60):
        for name, (places, diameters) in {
            "free": ([place], [diameter]),
            "half hidden": ([place, post], [diameter, width]),
        }.items():
            trunks = detect_planar_trunks(scan(places, diameters, seed=seed), EXACT, p_HoLo_H=EYE)
            which, _ = pairs(trunks.positions, place[None], within=0.5)
            for k in which:
                error = trunks.positions[k] - place
                deviations[name].append(np.sqrt(np.trace(trunks.covariances[k])))
                if name == "half hidden":
                    squares.append(error @ np.linalg.solve(trunks.covariances[k], error))
    assert len(squares) > 50
    assert np.median(deviations["half hidden"]) > 1.5 * np.median(deviations["free"])
    assert np.mean(squares) < 3.0 and np.mean(np.array(squares) < 5.99) > 0.9


@pytest.mark.parametrize(
    "walls",
    [
        [([5.0, -4.0], [5.0, 4.0])],  # across
        [([2.0, 2.0], [14.0, 3.0])],  # along
        [([5.0, -4.0], [5.0, 2.0]), ([5.0, 2.0], [9.0, 2.0])],  # a corner that points to the scanner
        [([5.0, -4.0], [9.0, 0.0]), ([9.0, 0.0], [5.0, 4.0])],  # one that points away
    ],
)
def test_walls_are_no_trunks(walls):
    for seed in range(5):
        points = scan([], [], walls=[(np.array(a), np.array(b)) for a, b in walls], seed=seed)
        assert len(points) > 30 and not len(detect_planar_trunks(points, EXACT, p_HoLo_H=EYE))


def test_a_trunk_at_the_end_of_the_field_is_left_out():
    field = (-0.5 * np.pi, 0.5 * np.pi)
    places = EYE[:2] + np.array([[0.05, -4.0], [0.05, 4.0], [5.0, 0.0], [1.0, -4.0]])
    points = scan(places, [0.4] * 4, field=field)
    trunks = detect_planar_trunks(points, EXACT, p_HoLo_H=EYE, field=field)
    which, truth = pairs(trunks.positions, places, within=0.1)
    assert len(which) == len(trunks) and sorted(truth) == [2, 3]
    # Unless it is told of the field, it takes a part for a whole, and is wrong.
    assert len(detect_planar_trunks(points, EXACT, p_HoLo_H=EYE)) > 2


def test_the_tilt_and_the_height_of_the_scanner_do_not_matter():
    places, diameters = ring(np.random.default_rng(1))
    points = scan(places, diameters)
    trunks = detect_planar_trunks(points, EXACT, p_HoLo_H=EYE)
    up, down = np.array([0.0, 0.0, 7.0]), np.array([0.0, 0.0, -2.0])
    lifted = detect_planar_trunks(points + up, EXACT, p_HoLo_H=EYE + down)
    np.testing.assert_array_equal(trunks.positions, lifted.positions)
    assert len(trunks) >= 8


def test_bad_input_is_refused():
    assert not len(detect_planar_trunks(np.zeros((0, 3)), EXACT, p_HoLo_H=EYE, field=(-1.0, 1.0)))
    with pytest.raises(ValueError, match=r"shape \(n, 3\)"):
        detect_planar_trunks(np.zeros((4, 2)), EXACT, p_HoLo_H=EYE)
    with pytest.raises(ValueError, match="leave rays without a return out"):
        detect_planar_trunks([[np.inf, 0.0, 0.0]], EXACT, p_HoLo_H=EYE)
    with pytest.raises(ValueError, match="the ray to the right"):
        detect_planar_trunks(np.zeros((0, 3)), EXACT, p_HoLo_H=EYE, field=(1.0, -1.0))
