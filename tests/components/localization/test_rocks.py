"""Rocks in scans of exact ellipsoids on a plain."""

from __future__ import annotations

import numpy as np
import pytest

from tests.components.localization.scans import Scene, flat, hills, pairs
from vtbdrake.components.localization.rocks import RockDetectorConfig, detect_rocks

pytestmark = pytest.mark.one_python

EYE = np.array([0.1, 0.2, 1.5])
# For waves of 0.2 m.
HIGH = RockDetectorConfig(least_height=0.2)


def waves(places):
    """Return the height of a slope of 3 degrees with waves of 0.2 m."""
    return 0.5 * hills(places)


def plain(seed: int, *, count: int = 30, elongation: float = 1.3, height=waves) -> Scene:
    """Return rocks on a plain; one axis of their outlines is up to ``elongation`` times as long as the other one."""
    rng = np.random.default_rng(seed)
    away, bearings = rng.uniform(5.0, 20.0, count), 2.0 * np.pi * (np.arange(count) + 0.5 * rng.random(count)) / count
    places = EYE[:2] + away[:, None] * np.stack([np.cos(bearings), np.sin(bearings)], axis=1)
    widths = rng.uniform(0.5, 1.6, count)
    halves = 0.5 * widths * rng.uniform(1.0, elongation, count)
    tall = rng.uniform(0.4, 0.9, count)
    rocks = [places, height(places), halves, 0.5 * widths, tall, rng.uniform(0.0, np.pi, count)]
    return Scene(np.zeros((0, 2)), np.zeros(0), ellipsoids=np.column_stack(rocks), height=height)


def seen(scene: Scene, detector: RockDetectorConfig = HIGH, *, seed: int = 0):
    points, hit = scene.scan(EYE, noise=0.02, seed=seed)
    return detect_rocks(points, detector, p_HoLo_H=EYE), points, hit


def test_rocks_are_found_on_uneven_ground():
    shown = found = claimed = right = 0
    nees, widths = [], []
    for seed in range(6):
        scene = plain(seed)
        rocks, points, hit = seen(scene, seed=seed)
        centers = scene.ellipsoids[:, :2]
        over = points[:, 2] - waves(points[:, :2]) > 0.25
        visible = np.bincount(hit[(hit >= 0) & over], minlength=len(centers)) >= 6
        which, truth = pairs(rocks.positions, centers, within=0.7)
        shown, found = shown + visible.sum(), found + len(set(truth) & set(np.flatnonzero(visible)))
        claimed, right = claimed + len(rocks), right + len(which)
        errors = rocks.positions[which] - centers[truth]
        nees.append(np.einsum("ki,kij,kj->k", errors, np.linalg.inv(rocks.covariances[which]), errors))
        widths.append((rocks.diameters[which] - 2.0 * scene.ellipsoids[truth, 4]) / rocks.diameter_deviations[which])
    assert found >= 0.85 * shown
    assert right >= 0.97 * claimed
    # With consistent covariances, the mean is 2 for two coordinates. Some rocks show their top alone.
    assert 0.5 < np.concatenate(nees).mean() < 2.5
    assert np.mean(np.abs(np.concatenate(widths)) < 2.0) > 0.85


def test_round_rocks_are_where_they_lie():
    scene = plain(1, elongation=1.0, count=12, height=flat)
    rocks, _, _ = seen(scene)
    which, truth = pairs(rocks.positions, scene.ellipsoids[:, :2], within=0.7)
    assert len(which) >= 9
    errors = np.linalg.norm(rocks.positions[which] - scene.ellipsoids[truth, :2], axis=1)
    assert np.median(errors) < 0.1


@pytest.mark.parametrize("away", [6.0, 9.0, 13.0])
def test_low_rounded_tops_do_not_displace_the_middle(away):
    # Many rows meet a near rock, few a far one: the error must not depend on it.
    bearings = 2.0 * np.pi * np.arange(16) / 16
    places = EYE[:2] + away * np.stack([np.cos(bearings), np.sin(bearings)], axis=1)
    shapes = np.tile([0.0, 0.4, 0.4, 0.4, 0.0], (16, 1))
    scene = Scene(np.zeros((0, 2)), np.zeros(0), ellipsoids=np.column_stack([places, shapes]))
    points, _ = scene.scan(EYE, rows=64)
    rocks = detect_rocks(points, RockDetectorConfig(elevation_step=np.pi / 6 / 64), p_HoLo_H=EYE)
    which, truth = pairs(rocks.positions, places, within=0.3)
    assert len(which) == 16
    too_far = np.hypot(*(rocks.positions[which] - EYE[:2]).T) - away
    assert np.abs(too_far).mean() < 0.03


def test_small_rocks_are_found_on_even_ground():
    scene = plain(2, count=20, height=flat)
    # Half a metre wide, and a hand's breadth over the ground.
    scene.ellipsoids[:, 3:5], scene.ellipsoids[:, 5] = 0.25, 0.15
    scene.ellipsoids[:, :2] = EYE[:2] + 0.5 * (scene.ellipsoids[:, :2] - EYE[:2])
    rocks, points, hit = seen(scene, RockDetectorConfig())
    which, truth = pairs(rocks.positions, scene.ellipsoids[:, :2], within=0.2)
    assert len(which) == len(rocks)
    clear = np.bincount(hit[(hit >= 0) & (points[:, 2] > 0.08)], minlength=20) >= 5
    assert clear.sum() >= 5
    assert len(set(np.flatnonzero(clear)) - set(truth)) <= 1


def test_three_points_are_the_least():
    rock = [16.0, 0.25, 0.0, 0.15, 0.15, 0.6, 0.0]
    points, hit = Scene(np.zeros((0, 2)), np.zeros(0), ellipsoids=np.array([rock])).scan(EYE)
    assert np.sum((hit == 0) & (points[:, 2] > 0.06)) == 3
    assert len(detect_rocks(points, RockDetectorConfig(), p_HoLo_H=EYE)) == 1
    assert len(detect_rocks(points, RockDetectorConfig(least_points=4), p_HoLo_H=EYE)) == 0


def test_a_rock_that_is_hidden_in_part_is_left_out():
    far, near = [10.0, 0.2, 0.0, 0.6, 0.6, 0.8, 0.0], [6.0, 0.5, 0.0, 0.3, 0.3, 1.0, 0.0]
    scene = Scene(np.zeros((0, 2)), np.zeros(0), ellipsoids=np.array([far, near]))
    alone = Scene(np.zeros((0, 2)), np.zeros(0), ellipsoids=np.array([far]))
    assert len(pairs(seen(alone)[0].positions, np.array([far[:2]]), within=0.5)[0]) == 1
    assert len(pairs(seen(scene)[0].positions, np.array([far[:2]]), within=0.8)[0]) == 0


def test_ground_alone_has_no_rocks():
    ground, _ = Scene(np.zeros((0, 2)), np.zeros(0), height=waves).scan(EYE, noise=0.02)
    for points in (ground, np.zeros((0, 3))):
        assert len(detect_rocks(points, HIGH, p_HoLo_H=EYE)) == 0


def test_bad_input_is_rejected():
    with pytest.raises(ValueError, match="finite numbers"):
        detect_rocks(np.full((3, 3), np.inf), RockDetectorConfig(), p_HoLo_H=EYE)
    with pytest.raises(ValueError, match="least_points must be a whole number of at least 2, not 1"):
        RockDetectorConfig(least_points=1)


def test_trunks_and_what_hangs_over_a_rock_are_no_rocks():
    trunks, rocks = np.array([[6.0, 0.0], [0.0, 9.0]]), np.array([[-7.0, 0.5], [0.5, -8.0]])
    shapes = [[*place, 0.0, 0.5, 0.5, 0.6, 0.0] for place in rocks]
    # A bough over the second rock.
    shapes.append([*rocks[1], 2.6, 0.5, 0.5, 0.3, 0.0])
    scene = Scene(trunks, np.array([0.4, 0.5]), ellipsoids=np.array(shapes))
    found = seen(scene)[0].positions
    assert len(found) == 2
    which, _ = pairs(found, rocks, within=0.3)
    assert len(which) == 2
    # Without a limit of the height, the trunks are taken for rocks.
    assert len(seen(scene, RockDetectorConfig(least_height=0.2, largest_height=100.0))[0]) > 2
