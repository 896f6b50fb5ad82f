"""Trunks in scans of exact cylinders, against these and against bounds from the rays that hit them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.components.localization.scans import BREAST, Scene, hills, pairs, raster, trunk_ranges
from vtbdrake.components.localization.trunks import TrunkDetectorConfig, detect_trunks

pytestmark = pytest.mark.one_python

EYE = np.array([0.2, -0.1, 2.0])
# The cylinders of these tests have neither bark nor a bend.
EXACT = TrunkDetectorConfig(roughness=0.0, position_floor=0.0, diameter_floor=0.0)


def ring(seed: int, *, count: int = 12, distance: tuple[float, float] = (3.0, 20.0), **options) -> Scene:
    """Return trunks all around the scanner, none behind another one."""
    rng = np.random.default_rng(seed)
    bearings = 2.0 * np.pi * (np.arange(count) + 0.6 * rng.random(count)) / count
    away = rng.uniform(*distance, (count, 1))
    places = EYE[:2] + away * np.stack([np.cos(bearings), np.sin(bearings)], axis=1)
    return Scene(places, rng.uniform(0.1, 0.4, count), **options)


def stand(seed: int, *, count: int = 200, bushes: int = 0, height=hills) -> Scene:
    """Return trunks at least 1 m apart on uneven ground, 800 to the hectare, and bushes."""
    rng = np.random.default_rng(seed)
    places: list[np.ndarray] = []
    while len(places) < count:
        place = rng.uniform(-25.0, 25.0, 2)
        if np.linalg.norm(place - EYE[:2]) > 1.5 and all(np.linalg.norm(place - other) > 1.0 for other in places):
            places.append(place)
    centers = rng.uniform(-25.0, 25.0, (bushes, 2))
    centers = centers[np.linalg.norm(centers - EYE[:2], axis=1) > 2.0]
    radii = rng.uniform(0.2, 0.6, len(centers))
    bushy = np.column_stack([centers, height(centers) + 0.5 * radii, radii, radii, radii, 0.0 * radii])
    leans = 0.02 * rng.normal(size=(count, 2))
    return Scene(np.array(places), rng.uniform(0.08, 0.4, count), leans, bushy, height)


def found_errors(scenes, detector=EXACT, *, noise=0.02):
    """Return, for all trunks found: distance, errors along and across the ray and of the diameter, NEES; the count."""
    rows, count = [], 0
    for seed, scene in enumerate(scenes):
        points, _ = scene.scan(EYE, noise=noise, turn=0.01 * seed, seed=seed)
        trunks = detect_trunks(points, detector, p_HoLo_H=EYE)
        which, truth = pairs(trunks.positions, scene.places, within=0.4)
        assert len(which) == len(trunks)
        count += len(scene.places)
        errors = trunks.positions - scene.places[truth]
        arms = scene.places[truth] - EYE[:2]
        distances = np.linalg.norm(arms, axis=1)
        e = arms / distances[:, None]
        nees = np.einsum("ki,kij,kj->k", errors, np.linalg.inv(trunks.covariances), errors)
        across = errors[:, 1] * e[:, 0] - errors[:, 0] * e[:, 1]
        thick = trunks.diameters - scene.diameters[truth]
        rows.append(np.stack([distances, np.sum(errors * e, axis=1), across, thick, nees], axis=1))
    return np.vstack(rows), count


def test_trunks_are_where_they_stand():
    errors, count = found_errors([ring(seed) for seed in range(20)])
    assert len(errors) >= 0.97 * count
    for low, high, limit in ((3.0, 8.0, 0.005), (8.0, 20.0, 0.01)):
        some = errors[(errors[:, 0] > low) & (errors[:, 0] < high)]
        assert len(some) >= 50
        # Errors of the position, and of the diameter, which algebraic fits make 2 to 5 cm too small.
        assert np.abs(some[:, 1:4].mean(axis=0)).max() < limit
    nees = errors[:, 4]
    # Two coordinates: the expected mean is 2, and 95 % lie below 5.99.
    assert 1.7 < nees.mean() < 2.3
    assert np.mean(nees < 5.99) > 0.94


@pytest.mark.slow
def test_variances_reach_the_bound_of_the_ranges():
    scenes = [ring(seed, count=12, distance=(5.0, 5.0)) for seed in range(20)]
    for scene in scenes:
        scene.diameters[:] = 0.3
    errors, _ = found_errors(scenes)
    bound = range_bound(5.0, 0.3, noise=0.02, detector=EXACT)
    variances = np.mean(errors[:, 1:4] ** 2, axis=0)
    # The edges say more than the ranges alone, but no fit with so few rays reaches the bound exactly.
    assert variances[0] < 1.25 * bound[0]
    assert variances[1] < 1.25 * bound[1]
    assert variances[2] < 1.25 * bound[2]
    trunks = detect_trunks(scenes[0].scan(EYE, noise=0.02)[0], EXACT, p_HoLo_H=EYE)
    claimed = np.mean(np.trace(trunks.covariances, axis1=1, axis2=2))
    assert 0.5 < claimed / variances[:2].sum() < 2.0
    assert 0.5 < np.mean(trunks.diameter_deviations**2) / variances[2] < 2.0


def range_bound(distance, diameter, *, noise, detector):
    """Return the Cramér-Rao bounds of the variances of x, y and diameter from ranges, by differences of exact ones."""
    rays, eye = raster(), np.array([0.0, 0.0, EYE[2]])

    def ranges(parameters):
        x, y, thickness, lean_x, lean_y = parameters
        return trunk_ranges(eye, rays, np.array([x, y, BREAST]), thickness, np.array([lean_x, lean_y]))

    truth, h = np.array([distance, 0.0, diameter, 0.0, 0.0]), 1e-4
    heights = eye[2] + rays[:, 2] * np.minimum(ranges(truth), 1e3)
    # Rays at the very edge miss the trunk when it moves.
    inner = np.abs(np.arctan2(rays[:, 1], rays[:, 0])) < np.arcsin(0.95 * diameter / 2.0 / distance)
    seen = inner & (heights > detector.heights[0]) & (heights < detector.heights[1])
    columns = [(ranges(truth + h * step)[seen] - ranges(truth - h * step)[seen]) / (2.0 * h) for step in np.eye(5)]
    derivatives = np.stack(columns, axis=1)
    information = derivatives.T @ derivatives / noise**2
    information[[3, 4], [3, 4]] += 1.0 / detector.lean**2
    return np.diagonal(np.linalg.inv(information))[:3]


def test_edges_that_are_not_seen_change_what_is_claimed_as_the_outline_says():
    """One edge of each trunk is dark, and returns no rays: the other ranges are as exact as before."""
    outline, rng, rows = 0.05, np.random.default_rng(3), []
    for seed in range(12):
        scene = ring(seed, count=10, distance=(4.0, 6.0))
        scene.diameters[:] = 0.4
        points, hit = scene.scan(EYE, noise=0.02, seed=seed)
        arms = (scene.places - EYE[:2]) / np.linalg.norm(scene.places - EYE[:2], axis=1)[:, None]
        left = np.stack([-arms[:, 1], arms[:, 0]], axis=1) * rng.choice([-1.0, 1.0], (len(arms), 1))
        dark = np.abs(outline * rng.normal(size=len(arms)))
        beside = np.sum((points[:, :2] - scene.places[hit]) * left[hit], axis=1)
        points = points[(hit < 0) | (beside < 0.2 - dark[hit])]
        exact, rough = (detect_trunks(points, each, p_HoLo_H=EYE) for each in (EXACT, replace(EXACT, outline=outline)))
        np.testing.assert_array_equal(exact.positions, rough.positions)
        np.testing.assert_array_equal(exact.diameters, rough.diameters)
        assert (np.linalg.eigvalsh(rough.covariances - exact.covariances) > -1e-12).all()
        which, stem = pairs(rough.positions, scene.places, within=0.3)
        errors, thick = rough.positions[which] - scene.places[stem], rough.diameters[which] - 0.4
        for each in (exact, rough):
            nees = np.einsum("ki,kij,kj->k", errors, np.linalg.inv(each.covariances[which]), errors)
            rows.append([nees.mean() / 2.0, np.mean((thick / each.diameter_deviations[which]) ** 2)])
    claimed, covered = np.array(rows).reshape(12, 2, 2).mean(axis=0)
    # One of two edges deviates, so that less than 1 is expected with the outline.
    assert (claimed > 2.0).all()
    assert (covered < 1.2).all() and (covered > 0.2).all()


@pytest.mark.parametrize("roughness", [0.0, 0.02])
def test_edges_and_the_prior_tell_as_much_as_their_variances(roughness):
    """Ranges that are known to half a metre tell next to nothing."""
    distance, left = 6.0, np.array([[0.0, 1.0], [1.0, 0.0], [0.0, 1.0], [1.0, 0.0]])
    places = EYE[:2] + distance * np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
    points, _ = Scene(places, np.full(4, 0.3)).scan(EYE)
    detector = replace(EXACT, range_noise=0.5, roughness=roughness, diameter_spread=10.0)
    trunks = detect_trunks(points, detector, p_HoLo_H=EYE)
    # The axis is in the middle of two edges, each uniform within a step of the rays, and rough.
    deviation = np.hypot(distance * EXACT.azimuth_step / 12.0**0.5, roughness) / 2.0**0.5
    _, order = pairs(trunks.positions, places, within=0.1)
    across = np.einsum("ki,kij,kj->k", left[order], trunks.covariances, left[order]) ** 0.5
    np.testing.assert_allclose(across, deviation, rtol=0.08)
    np.testing.assert_allclose(trunks.diameter_deviations, 2.0 * deviation, rtol=0.08)
    # A prior that is as sharp as the edges counts as much as they do.
    for k, diameter in enumerate(trunks.diameters):
        prior = replace(detector, diameter_spread=2.0 * deviation, typical_diameter=diameter + deviation)
        both = detect_trunks(points, prior, p_HoLo_H=EYE)
        assert both.diameters[k] == pytest.approx(diameter + 0.5 * deviation, abs=0.1 * deviation)
        assert both.diameter_deviations[k] == pytest.approx(2.0**0.5 * deviation, rel=0.08)


def test_without_measurements_the_lean_is_that_of_the_prior():
    # Along the ray, only ranges tell it. Its variance is the curvature, over the height, of the position's.
    points, _ = Scene(EYE[None, :2] + [[6.0, 0.0]], np.array([0.3])).scan(EYE)
    detector = replace(EXACT, range_noise=0.5, lean=0.01)
    variances = [
        detect_trunks(points, replace(detector, reference_height=height), p_HoLo_H=EYE).covariances[0, 0, 0]
        for height in (1.0, 3.0, 5.0)
    ]
    assert (np.diff(variances, n=2)[0] / 8.0) ** 0.5 == pytest.approx(0.01, rel=0.05)


def test_leaning_trunks_are_found_at_breast_height():
    leans = np.array([[0.08, 0.0], [0.0, 0.08], [-0.06, 0.06], [0.0, -0.1]])
    places = EYE[:2] + 5.0 * np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
    points, _ = Scene(places, np.full(4, 0.25), leans).scan(EYE, noise=0.01)
    trunks = detect_trunks(points, TrunkDetectorConfig(range_noise=0.01), p_HoLo_H=EYE)
    which, truth = pairs(trunks.positions, places, within=0.06)
    assert sorted(truth) == [0, 1, 2, 3]
    np.testing.assert_allclose(trunks.diameters[which], 0.25, atol=0.03)


@pytest.mark.parametrize("height", [1.3, 2.5])
def test_the_lean_aside_displaces_no_near_trunk(height):
    """Exact rays show trunks that lean by 3 degrees to a millimetre, although their rows lie beside each other."""
    directions = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
    left = np.array([[0.0, 1.0], [-1.0, 0.0], [0.0, -1.0], [1.0, 0.0]])
    detector = replace(EXACT, range_noise=0.003, reference_height=height)
    for distance in (2.0, 3.0):
        places = EYE[:2] + distance * directions
        points, _ = Scene(places, np.full(4, 0.25), 0.05 * left).scan(EYE, rows=32)
        trunks = detect_trunks(points, detector, p_HoLo_H=EYE)
        which, truth = pairs(trunks.positions, places, within=0.1)
        assert sorted(truth) == [0, 1, 2, 3]
        across = np.sum((trunks.positions[which] - places[truth]) * left[truth], axis=1)
        np.testing.assert_allclose(across, 0.05 * (height - 1.3), atol=0.001)


def test_the_lean_aside_displaces_no_far_trunk():
    """Few rows of rays: the edges tell where a trunk is that leans by 3 degrees."""
    directions = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
    left = np.array([[0.0, 1.0], [-1.0, 0.0], [0.0, -1.0], [1.0, 0.0]])
    places = EYE[:2] + 12.0 * directions
    points, _ = Scene(places, np.full(4, 0.25), 0.05 * left).scan(EYE, rows=16)
    trunks = detect_trunks(points, replace(EXACT, range_noise=0.02, lean=0.1), p_HoLo_H=EYE)
    which, truth = pairs(trunks.positions, places, within=0.1)
    assert sorted(truth) == [0, 1, 2, 3]
    across = np.sum((trunks.positions[which] - places[truth]) * left[truth], axis=1)
    assert np.abs(across).max() < 0.005
    # Their rows lie beside each other, which makes them no thicker.
    np.testing.assert_allclose(trunks.diameters[which], 0.25, atol=0.015)


@pytest.mark.slow
@pytest.mark.parametrize(("bushes", "recall", "precision"), [(0, 0.95, 0.99), (100, 0.93, 0.97)])
def test_stands_on_uneven_ground(bushes, recall, precision):
    shown = found = claimed = right = 0
    for seed in range(4):
        scene = stand(seed, bushes=bushes)
        points, hit = scene.scan(EYE, noise=0.02, seed=seed)
        trunks = detect_trunks(points, TrunkDetectorConfig(), p_HoLo_H=EYE)
        # Those in sight: by at least ten points in a slice that is a little smaller than the detector's.
        over = points[:, 2] - hills(points[:, :2])
        counts = np.bincount(hit[(hit >= 0) & (over > 0.9) & (over < 2.5)], minlength=len(scene.places))
        counts = counts[: len(scene.places)]
        near = np.linalg.norm(scene.places - EYE[:2], axis=1) < 18.0
        which, truth = pairs(trunks.positions, scene.places, within=0.25)
        shown += np.sum(near & (counts >= 10))
        found += len(set(truth) & set(np.flatnonzero(near & (counts >= 10))))
        claimed, right = claimed + len(trunks), right + len(which)
    assert found >= recall * shown
    assert right >= precision * claimed


def test_a_hidden_edge_is_not_an_edge_of_the_trunk():
    # The nearer trunk hides the left half of the farther one.
    places = np.array([[5.0, 0.2], [10.0, 0.2]]) + EYE[:2]
    diameters = np.array([0.2, 0.4])
    points, _ = Scene(places, diameters).scan(EYE, noise=0.02)
    trunks = detect_trunks(points, TrunkDetectorConfig(position_floor=0.0), p_HoLo_H=EYE)
    alone, _ = Scene(places[1:], diameters[1:]).scan(EYE, noise=0.02)
    (whole,) = detect_trunks(alone, TrunkDetectorConfig(position_floor=0.0), p_HoLo_H=EYE).covariances
    (far,) = np.flatnonzero(trunks.positions[:, 0] > 8.0)
    error = trunks.positions[far] - places[1]
    assert error @ np.linalg.solve(trunks.covariances[far], error) < 9.21
    assert trunks.covariances[far][1, 1] > 4.0 * whole[1, 1]
    assert abs(trunks.diameters[far] - 0.4) < 2.5 * trunks.diameter_deviations[far]


def test_hidden_edges_are_found_behind_the_carrier_too():
    # Where azimuths jump from pi to -pi, in steps of less than a column of rays.
    deviations = []
    for bearing in [0.0, *np.pi + np.arange(-0.02, 0.08, 0.0025)]:
        R = np.array([[np.cos(bearing), -np.sin(bearing)], [np.sin(bearing), np.cos(bearing)]])
        places = EYE[:2] + np.array([[5.0, -0.2], [10.0, -0.2]]) @ R.T
        points, _ = Scene(places, np.array([0.2, 0.4])).scan(EYE, noise=0.02, turn=bearing)
        trunks = detect_trunks(points, TrunkDetectorConfig(), p_HoLo_H=EYE)
        (far,) = np.flatnonzero(np.linalg.norm(trunks.positions - EYE[:2], axis=1) > 8.0)
        deviations.append(trunks.diameter_deviations[far])
    np.testing.assert_allclose(deviations, deviations[0], rtol=0.02)


def test_branches_beside_a_trunk_do_not_widen_it():
    # Points of one row each, 15 cm to both sides of the trunk, at its distance.
    place = EYE[:2] + np.array([4.0, 0.0])
    points, _ = Scene(place[None], np.array([0.2])).scan(EYE, noise=0.01)
    rows = np.repeat([1.1, 1.9], 12)
    sides = np.concatenate([np.linspace(0.11, 0.25, 12), -np.linspace(0.11, 0.25, 12)])
    branches = np.column_stack([np.full(24, place[0]), place[1] + sides, rows])
    for seen in (points, np.vstack([points, branches])):
        (diameter,) = detect_trunks(seen, TrunkDetectorConfig(range_noise=0.01), p_HoLo_H=EYE).diameters
        assert abs(diameter - 0.2) < 0.025


def test_other_objects_are_not_found():
    nothing = Scene(np.zeros((0, 2)), np.zeros(0), height=hills)
    ground, _ = nothing.scan(EYE, noise=0.02)
    wall = np.stack(np.meshgrid([6.0], np.linspace(-2, 2, 60), np.linspace(0, 3, 20)), axis=-1).reshape(-1, 3)
    for points in (np.zeros((0, 3)), ground, np.vstack([ground, wall]), wall[:1]):
        assert len(detect_trunks(points, TrunkDetectorConfig(), p_HoLo_H=EYE)) == 0


def test_the_order_of_points_does_not_matter():
    scene = ring(3)
    points, _ = scene.scan(EYE, noise=0.02)
    mixed = np.random.default_rng(0).permutation(points)
    one, other = (detect_trunks(some, TrunkDetectorConfig(), p_HoLo_H=EYE) for some in (points, mixed))
    np.testing.assert_allclose(one.positions, other.positions, atol=1e-9)


def test_bad_input_is_rejected():
    points = np.ones((3, 3))
    points[1, 1] = np.nan
    with pytest.raises(ValueError, match="finite numbers"):
        detect_trunks(points, TrunkDetectorConfig(), p_HoLo_H=EYE)
    with pytest.raises(ValueError, match="shape"):
        detect_trunks(np.ones((3, 2)), TrunkDetectorConfig(), p_HoLo_H=EYE)
    with pytest.raises(ValueError, match="TrunkDetectorConfig.range_noise must be a finite number above 0 m, not 0"):
        TrunkDetectorConfig(range_noise=0.0)
    with pytest.raises(ValueError, match="heights must be the lower one, then the upper one"):
        TrunkDetectorConfig(heights=(2.0, 1.0))
    with pytest.raises(ValueError, match="cell must be at least 0.02 m, a 2000th of the reach, not 0.01"):
        TrunkDetectorConfig(reach=40.0, cell=0.01)


def test_scan_with_the_ground_above_shows_nothing():
    scene = stand(3)
    points, _ = scene.scan(EYE, noise=0.02, seed=3)
    mirrored = EYE + (points - EYE) * [1.0, 1.0, -1.0]
    assert len(detect_trunks(points, EXACT, p_HoLo_H=EYE)) > 20
    assert not len(detect_trunks(mirrored, EXACT, p_HoLo_H=EYE))
    # Trunks without any ground are still seen.
    assert len(detect_trunks(points[points[:, 2] > 1.0], EXACT, p_HoLo_H=EYE)) > 10
