import copy
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.stats import chi2

from tests.components.localization.drives import DRIFT, PERIOD, Drive, drive, error, nees
from vtbdrake.components.localization import health
from vtbdrake.components.localization.dead_reckoning import DriftModel
from vtbdrake.components.localization.landmarks import Landmarks
from vtbdrake.components.localization.planar import compose, inverse, rotation, transform
from vtbdrake.components.localization.track_state import TrackState
from vtbdrake.components.localization.tracking import Tracker
from vtbdrake.state.codecs import codec_of
from vtbdrake_diagrams.forest.studies.detections import Odometry
from vtbdrake_diagrams.forest.world.stand import ACCURATE, POOR, REMOTE

pytestmark = pytest.mark.one_python

START = np.diag([0.1, 0.1, 0.01]) ** 2


def tracked(one: Drive, **settings):
    """Track a drive from a first pose with errors of START; return the tracker and the states."""
    tracker = Tracker(one.map, **settings)
    first = one.poses[0] + np.random.default_rng(len(one.map)).multivariate_normal(np.zeros(3), START)
    states = [tracker.start(first, START, one.scans[0])[0]]
    for k in range(1, len(one.scans)):
        states.append(tracker.update(tracker.predict(states[-1], *one.motion(k), extent=PERIOD), one.scans[k])[0])
    return tracker, states


def scores(errors, *, drives, first=0, bias=0.0, **settings):
    """Return the errors of the last states (n, 3), and their normalized squares (n,)."""
    found = []
    for seed in range(first, first + drives):
        one = drive(seed, errors, bias=bias)
        state = tracked(one, correlation=errors.correlation, **settings)[1][-1]
        found.append((error(state.pose, one.poses[-1]), nees(state.pose, state.pose_covariance, one.poses[-1])))
    return tuple(np.array(column) for column in zip(*found, strict=True))


# The 95 % interval of the mean of 3 degrees of freedom over 16 independent drives.
BOUNDS = (1.92, 4.32)


@pytest.mark.slow_cases
@pytest.mark.parametrize("seed", [0, 1])
def test_a_drive_ends_within_its_covariance(seed):
    one = drive(seed, ACCURATE)
    tracker, states = tracked(one, correlation=ACCURATE.correlation)
    last = states[-1]
    assert nees(last.pose, last.pose_covariance, one.poses[-1]) < chi2.ppf(0.99, 3)
    assert np.hypot(*error(last.pose, one.poses[-1])[:2]) < 0.1
    assert 0.0 < last.distortion < chi2.ppf(0.999, 6) and not tracker.is_doubtful(last)
    factors = [state.drift for state in states]
    assert min(factors) == 1.0 and np.mean(factors) < 1.5


@pytest.mark.slow
@pytest.mark.parametrize("bias", [0.0, 0.02])
def test_errors_with_the_accurate_map_are_as_estimated(bias):
    errors, squares = scores(ACCURATE, drives=16, bias=bias)
    assert BOUNDS[0] < squares.mean() < BOUNDS[1]
    assert np.sqrt((errors[:, :2] ** 2).sum(axis=1).mean()) < 0.05
    assert np.sqrt((errors[:, 2] ** 2).mean()) < np.radians(0.2)


@pytest.mark.slow
def test_errors_with_the_remote_map_are_as_estimated():
    errors, squares = scores(REMOTE, drives=16)
    assert BOUNDS[0] < squares.mean() < BOUNDS[1]
    assert np.sqrt((errors[:, :2] ** 2).sum(axis=1).mean()) < 0.15


@pytest.mark.slow
def test_a_bias_without_a_state_is_inconsistent():
    _, squares = scores(ACCURATE, drives=8, bias=0.05, bias_deviation=1e-6)
    assert squares.mean() > BOUNDS[1]


def test_a_scan_that_may_be_displaced_says_less_of_the_position():
    one = drive(3, ACCURATE)
    exact, displaced = (
        Tracker(one.map, scan_deviation=deviation).start(one.poses[0], START, one.scans[0])[0].pose_covariance
        for deviation in (0.0, 0.05)
    )
    # A displacement of all detections is one of the carrier.
    np.testing.assert_allclose(displaced - exact, np.diag([0.05**2, 0.05**2, 0.0]), atol=3e-5)


def test_detections_that_are_displaced_together_are_matched():
    rng = np.random.default_rng(2)
    places = rng.uniform(-10.0, 10.0, (12, 2))
    exact = Landmarks(places, np.tile(1e-6 * np.eye(2), (12, 1, 1)), np.full(12, 0.3), np.full(12, np.inf))
    scan = exact.seen_from([0.12, -0.09, 0.0])
    surely = np.diag([0.01, 0.01, 0.001]) ** 2
    for deviation, count in ((0.1, 12), (0.0, 0)):
        tracker = Tracker(exact, scan_deviation=deviation)
        state, matches = tracker.update(tracker.start(np.zeros(3), surely)[0], scan)
        assert matches.is_fused == bool(count)
        assert sum(i == j for i, j in matches.pairs) == count
    # With it, the displacement is no motion of the carrier.
    tracker = Tracker(exact, scan_deviation=0.1)
    state, _ = tracker.update(tracker.start(np.zeros(3), surely)[0], scan)
    np.testing.assert_allclose(state.pose, 0.0, atol=0.01)


def test_pairs_that_are_improbable_together_are_dropped():
    """Each may be right, but four errors of 3.3 deviations in one scan are too many."""
    rng = np.random.default_rng(2)
    places = np.array([[x, y] for x in (-9.0, -3.0, 3.0, 9.0) for y in (-4.0, 4.0)])
    exact = Landmarks(places, np.tile(1e-8 * np.eye(2), (8, 1, 1)), np.full(8, 0.3), np.full(8, np.inf))
    tracker = Tracker(exact, least_deviation=0.0, bias_deviation=1e-6)
    surely = np.diag([1e-4, 1e-4, 1e-5]) ** 2
    scan = Landmarks(places, np.tile(0.01**2 * np.eye(2), (8, 1, 1)), np.full(8, 0.3), np.full(8, np.inf))
    state, matches = tracker.update(tracker.start(np.zeros(3), surely)[0], scan)
    assert len(matches.pairs) == 8
    angles = rng.uniform(0.0, 2.0 * np.pi, 4)
    shifts = np.vstack([0.033 * np.column_stack([np.cos(angles), np.sin(angles)]), np.zeros((4, 2))])
    displaced = Landmarks(places + shifts, scan.covariances, scan.diameters, scan.diameter_deviations)
    _, matches = tracker.update(state, displaced)
    assert 4 <= len(matches.pairs) < 8 and matches.is_fused
    assert {4, 5, 6, 7} <= set(matches.pairs[:, 0])
    assert 5.0 < matches.nis <= chi2.ppf(tracker.gate, 2 * len(matches.pairs))
    # With errors like these in all of them, a single one would be left: the scan does not show the place.
    angles = rng.uniform(0.0, 2.0 * np.pi, 8)
    shifts = 0.033 * np.column_stack([np.cos(angles), np.sin(angles)])
    displaced = Landmarks(places + shifts, scan.covariances, scan.diameters, scan.diameter_deviations)
    failed, matches = tracker.update(state, displaced)
    assert failed.failures == 1 and not matches.is_fused
    np.testing.assert_array_equal(failed.mean, state.mean)


@pytest.mark.slow_cases
@pytest.mark.parametrize("seed", [0, 3, 5])
def test_track_is_judged_by_scans_of_two_detections_together(seed):
    one, rng = drive(seed, ACCURATE), np.random.default_rng(seed)
    pairs = [scan.select(rng.choice(len(scan), 2, replace=False)) for scan in one.scans]

    def health_along(shift):
        tracker = Tracker(one.map, correlation=ACCURATE.correlation)
        state, found = tracker.start(one.poses[0] + shift, START)[0], []
        for k in range(1, len(pairs)):
            state, _ = tracker.update(tracker.predict(state, *one.motion(k), extent=PERIOD), pairs[k])
            found.append((tracker.is_doubtful(state), tracker.is_lost(state)))
        return np.array(found).T

    doubtful, lost = health_along(np.zeros(3))
    assert not lost.any() and doubtful.mean() < 0.2
    # Elsewhere, most scans match nothing: six detections tell so, and then many more.
    doubtful, lost = health_along(np.array([6.0, -5.0, 0.0]))
    assert doubtful.argmax() <= 8 and lost[:24].any()


def spread_out(places, deviation):
    n = len(places)
    return Landmarks(places, np.tile(deviation**2 * np.eye(2), (n, 1, 1)), np.full(n, 0.3), np.full(n, np.inf))


@pytest.mark.parametrize(("view", "variance"), [(2.0 * np.pi, 0.045), (np.pi, 0.025)])
def test_landmarks_that_may_be_others_enter_with_less_certainty(view, variance):
    places = np.array([[2.0, 0.0], [0.0, -2.0]])
    settings = {"least_deviation": 0.0, "bias_deviation": 1e-6, "field_of_view": view, "first_gate": 0.999999}
    tracker = Tracker(spread_out(places, variance**0.5), **settings)
    state, _ = tracker.start(np.zeros(3), 1e-12 * np.eye(3))
    state, matches = tracker.update(state, spread_out(places, variance**0.5))
    assert len(matches.pairs) == 2
    # Two detections within 2 m; twice their density in the view competes with the normal density of a match without
    # error.
    density, others = 1.0 / (2.0 * np.pi * 2.0 * variance), 2.0 * 2.0 / (view / 2.0 * 2.0**2)
    p = density / (density + others)
    assert 0.8 < p < 0.9
    np.testing.assert_allclose(state.covariance[6:, 6:], np.eye(4) / (p**2 / variance + 1.0 / variance), atol=1e-6)


def test_landmarks_are_looked_for_as_far_as_they_may_be():
    """A map with deviations of 1.5 m: all detections are 3 m off together, two deviations, and are matched."""
    places = np.array([[x, y] for x in (-30.0, -10.0, 10.0, 30.0) for y in (-15.0, 15.0)])
    tracker = Tracker(spread_out(places, 1.5), correlation=200.0, bias_deviation=1e-6)
    state, _ = tracker.start(np.zeros(3), np.diag([0.1, 0.1, 0.001]) ** 2)
    scan = spread_out(places + np.array([3.0, 0.0]), 0.02)
    _, matches = tracker.update(state, scan)
    assert matches.is_fused and [i == j for i, j in matches.pairs] == [True] * 8


@pytest.mark.parametrize("axis", [0, 1])
def test_landmarks_are_looked_for_along_the_axis_of_an_uncertain_pose(axis):
    places = np.array([[x, y] for x in (-30.0, -10.0, 10.0, 30.0) for y in (-15.0, 15.0)])
    tracker = Tracker(spread_out(places, 0.01), bias_deviation=1e-6)
    deviations, shift = np.array([0.01, 0.01, 0.001]), np.zeros(2)
    deviations[axis], shift[axis] = 2.0, 3.0
    state, _ = tracker.start(np.zeros(3), np.diag(deviations) ** 2)
    state, matches = tracker.update(state, spread_out(places - shift, 0.02))
    assert matches.is_fused and [i == j for i, j in matches.pairs] == [True] * 8
    assert state.pose[axis] == pytest.approx(3.0, abs=0.05)


@pytest.mark.parametrize(("deviations", "is_lost"), [(0.5, False), (2.2, True)])
def test_first_matches_that_fit_badly_lose_the_track(deviations, is_lost):
    places = np.array([[x, y] for x in (-9.0, 0.0, 9.0) for y in (-9.0, -3.0, 3.0, 9.0)])
    tracker = Tracker(spread_out(places, 0.1), least_deviation=0.0, bias_deviation=1e-6)
    state, _ = tracker.start(np.zeros(3), 1e-12 * np.eye(3))
    angles = np.random.default_rng(1).uniform(0.0, 2.0 * np.pi, len(places))
    errors = deviations * np.hypot(0.1, 0.1) * np.column_stack([np.cos(angles), np.sin(angles)])
    for rows in np.arange(12).reshape(4, 3):
        state, matches = tracker.update(state, spread_out((places + errors)[rows], 0.1))
        assert len(matches.pairs) == 3
    assert tracker.is_lost(state) == is_lost


def test_an_uncertain_position_loses_the_track():
    tracker = Tracker(drive(0, ACCURATE).map, largest_deviation=0.5, odometry_deviation=0.0)
    state, _ = tracker.start(np.zeros(3), np.diag([0.1, 0.1, 0.0]) ** 2)
    for way, is_lost in ((100.0, False), (300.0, True)):
        motion = np.array([way, 0.0, 0.0])
        # Along the way, its deviation is 0.03 m times the root of the metres.
        after = tracker.predict(state, motion, np.diag([0.03**2 * way, 0.0, 0.0]), extent=0.0)
        assert tracker.is_lost(after) == is_lost


@pytest.mark.parametrize(
    ("change", "before", "expected"),
    [
        ([0.5, 0.0, 0.0], 1.0, 1.525),  # s = 6.25
        ([0.2, 0.0, 0.0], 1.7, 1.7),  # s = 1
        ([0.1, 0.0, 0.0], 2.0, 1.85),  # s = 0.25
        ([0.1, 0.0, 0.0], 1.0, 1.0),
        ([9.0, 0.0, 0.0], 1.0, 3.4),  # s counts as 25
        ([9.0, 0.0, 0.0], 900.0, 1000.0),
        ([0.5, 7.0, 7.0], 1.0, 1.525),  # the scan says nothing of y and of the heading
    ],
)
@pytest.mark.parametrize("rounding", [0.0, 1e-16])
def test_drift_follows_what_a_scan_says(change, before, expected, rounding):
    tracker = Tracker(spread_out(np.zeros((1, 2)), 0.1))
    first = replace(tracker.start(np.zeros(3), np.diag([0.05, 0.01, 0.001]))[0], drift=before)
    after, _ = tracker.start(change, np.diag([0.01, 0.01 + rounding, 0.001 + rounding]))
    assert health.drift_after(first, after) == pytest.approx(expected)


# A car with a steering angle for a gyro: five to ten times the drift of the model.
STEERED = Odometry(scale=0.05, position=0.1, heading=0.01)


def test_worse_dead_reckoning_than_assumed_raises_the_drift():
    one = drive(0, ACCURATE, odometry=STEERED)
    tracker, states = tracked(one)
    assert not tracker.is_lost(states[-1])
    assert nees(states[-1].pose, tracker.pose_covariance(states[-1]), one.poses[-1]) < chi2.ppf(0.99, 3)
    assert 3.0 < np.mean([state.drift for state in states[5:]]) < 50.0


@pytest.mark.slow
@pytest.mark.parametrize("share", [1.0, 0.3])
def test_worse_dead_reckoning_than_assumed_is_noticed(share):
    """With all trees, and with few trees in each scan."""
    squares, drifts = [], []
    for seed in range(8):
        one = drive(seed, ACCURATE, odometry=STEERED)
        rng = np.random.default_rng(seed)
        thin = replace(one, scans=[scan.select(rng.random(len(scan)) < share) for scan in one.scans])
        tracker, states = tracked(thin)
        assert not tracker.is_lost(states[-1])
        squares.append(nees(states[-1].pose, tracker.pose_covariance(states[-1]), one.poses[-1]))
        drifts.append(np.mean([state.drift for state in states[5:]]))
    assert np.mean(squares) < 6.0
    assert 3.0 < np.median(drifts) < 50.0


@pytest.mark.slow
def test_dead_reckoning_as_assumed_is_believed():
    factors = [state.drift for seed in range(8) for state in tracked(drive(seed, ACCURATE))[1]]
    assert min(factors) == 1.0 and np.mean(factors) < 1.5


@pytest.mark.slow
@pytest.mark.parametrize("errors", [ACCURATE, REMOTE, POOR])
def test_right_maps_seem_no_more_distorted_than_by_chance(errors):
    """At most chi-square distributed with 6 degrees of freedom; less, as what is not known yet is not corrected."""
    found = np.array([tracked(drive(seed, errors), correlation=errors.correlation)[1][-1] for seed in range(8)])
    distortions = np.array([state.distortion for state in found])
    assert 0.0 < distortions.mean() < 6.0 + 3.0 * np.sqrt(12.0 / 8.0)
    assert distortions.max() < chi2.ppf(0.999, 6)


@pytest.mark.slow
def test_map_that_is_worse_than_it_says_is_noticed_and_its_pose_less_certain():
    """With a third of the true deviations, normalized squares of 27 are expected of a filter that believes them."""
    squares, scatters = [], []
    for seed in range(8):
        one = drive(seed, REMOTE)
        boasting = replace(one, map=replace(one.map, covariances=one.map.covariances / 9.0))
        tracker, states = tracked(boasting)
        squares.append(nees(states[-1].pose, tracker.pose_covariance(states[-1]), one.poses[-1]))
        scatters.append(states[-1].scatter)
    assert np.median(scatters) > 1.5 and np.mean(squares) < 13.5, (scatters, squares)


def distorted(landmarks, displacement):
    """Return the map with displacements by a function of the positions (n, 2)."""
    places = landmarks.positions
    return replace(landmarks, positions=places + displacement(places - places.mean(axis=0)))


DISTORTIONS = {
    "shear": lambda p: 0.01 * p[:, ::-1],
    "scale": lambda p: 0.01 * p,
    "stretch": lambda p: p * [0.015, 0.0],
}


@pytest.mark.slow_cases
@pytest.mark.parametrize("kind", DISTORTIONS)
def test_distorted_maps_make_the_pose_doubtful(kind):
    one = drive(3, ACCURATE, reach=18.0)
    tracker, states = tracked(replace(one, map=distorted(one.map, DISTORTIONS[kind])))
    right, rights = tracked(one)
    assert tracker.is_doubtful(states[-1]) and states[-1].failures == 0
    assert not any(right.is_doubtful(state) for state in rights)
    # Before there is doubt, the covariance grows.
    larger = [np.trace(tracker.pose_covariance(s)) / np.trace(s.pose_covariance) for s in states]
    ratios = [state.scatter * max(1.0, state.distortion / chi2.ppf(0.95, 6)) for state in states]
    np.testing.assert_allclose(larger, ratios)
    assert max(ratios) > 1.5


def test_a_displaced_or_turned_map_is_not_distorted():
    one = drive(3, ACCURATE, reach=18.0)
    middle, same = one.map.positions.mean(axis=0), tracked(one)[1]
    for X in ([3.0, -2.0, 0.0], [0.0, 0.0, 0.5]):
        around = np.array([*middle, 0.0])
        X_WV = compose(compose(around, X), inverse(around))
        moved = replace(one, map=one.map.seen_from(X_WV), poses=np.array([compose(X_WV, pose) for pose in one.poses]))
        assert tracked(moved)[1][-1].distortion == pytest.approx(same[-1].distortion, rel=1e-3)


def turned_by_the_odometry(drift):
    """Return a tracker, and its state after a bend on which the odometry drifts by an angle in rad.

    The map shows two landmarks beside the carrier, at first in view, and two 100 m behind, which have been seen, too.
    """
    places = np.array([[8.0, 4.0], [8.0, -4.0], [-100.0, 4.0], [-100.0, -4.0]])
    tracker = Tracker(spread_out(places, 0.03), bias_deviation=1e-6, horizon=200.0)
    surely = np.diag([0.01, 0.01, 1e-3]) ** 2
    state, _ = tracker.update(tracker.start(np.zeros(3), surely)[0], spread_out(places, 0.03))
    assert len(state.indices) == 4
    return tracker, tracker.predict(state, [0.0, 0.0, drift], np.diag([1e-4, 1e-4, drift]) ** 2, extent=0.0), places


def test_correction_of_the_heading_leaves_the_map_in_place():
    """Of 0.1 rad: an arc about the carrier would displace what lies 100 m behind by 0.5 m."""
    tracker, state, places = turned_by_the_odometry(0.1)
    state, matches = tracker.update(state, spread_out(places[:2], 0.03))
    assert matches.is_fused and state.pose[2] == pytest.approx(0.0, abs=0.005)
    order = np.argsort(state.indices)
    np.testing.assert_allclose(state.landmark_positions[order], places, atol=0.03)
    assert state.distortion < 6.0


def test_scan_with_one_landmark_that_is_tracked_corrects_the_heading():
    tracker, state, places = turned_by_the_odometry(0.1)
    state, matches = tracker.update(state, spread_out(places[:1], 0.03))
    assert matches.is_fused and state.pose[2] == pytest.approx(0.0, abs=0.01)


def test_scan_with_one_landmark_that_is_new_is_not_fused():
    """Nothing agrees with it."""
    tracker = Tracker(spread_out(np.array([[8.0, 4.0], [8.0, -4.0]]), 0.03))
    before, _ = tracker.start(np.zeros(3), np.diag([0.01, 0.01, 1e-3]) ** 2)
    after, matches = tracker.update(before, spread_out(np.array([[8.0, 4.0]]), 0.03))
    assert len(matches.pairs) == 1 and not matches.is_fused
    np.testing.assert_array_equal(after.mean, before.mean)


@pytest.mark.parametrize(
    ("stray_density", "aside", "ends"),
    [
        pytest.param(0.0, [[0.0, 0.0]], True, id="one match"),
        pytest.param(0.0, [[0.8, 0.0]], False, id="one far from where it should be"),
        pytest.param(8.0, [[0.0, 0.0], [0.0, 0.0]], False, id="two that may be something else"),
    ],
)
def test_doubt_ends_with_probable_matches(stray_density, aside, ends):
    """The doubt begins with a scan that shows nothing of the map."""
    places = np.array([[8.0, 4.0], [8.0, -4.0], [-8.0, 4.0], [-8.0, -4.0], [2.0, 9.0], [2.0, -9.0]])
    tracker = Tracker(spread_out(places, 0.02), stray_density=stray_density, bias_deviation=1e-6)
    surely = np.diag([0.01, 0.01, 1e-3]) ** 2
    state, _ = tracker.update(tracker.start(np.zeros(3), surely)[0], spread_out(places, 0.05))
    doubtful, _ = tracker.update(state, spread_out(places + np.array([0.0, 30.0]), 0.05))
    assert not tracker.is_doubtful(state) and tracker.is_doubtful(doubtful)
    vague = tracker.predict(doubtful, np.zeros(3), np.diag([0.3, 0.3, 1e-3]) ** 2 / doubtful.drift, extent=0.0)
    after, matches = tracker.update(vague, spread_out(places[: len(aside)] + np.array(aside), 0.05))
    assert matches.is_fused == ends and tracker.is_doubtful(after) == (not ends)


@pytest.mark.parametrize("order", [[0, 1], [1, 0]])
def test_single_detection_is_matched_with_the_nearer_of_two_neighbours(order):
    """Whatever their order on the map."""
    places = np.array([[20.0, 0.0], [20.0, 0.8]])[order]
    tracker = Tracker(spread_out(places, 0.02), bias_deviation=1e-6)
    surely = np.diag([0.01, 0.01, 1e-3]) ** 2
    state, _ = tracker.update(tracker.start(np.zeros(3), surely)[0], spread_out(places, 0.05))
    vague = tracker.predict(state, np.zeros(3), np.diag([0.3, 0.3, 1e-3]) ** 2, extent=0.0)
    for nearer in (0, 1):
        _, matches = tracker.update(vague, spread_out(places[nearer : nearer + 1], 0.05))
        assert matches.pairs.tolist() == [[0, nearer]]


def two_landmarks(stray_density, deviations):
    """Return a tracker, a state that has two landmarks, and their places; the pose has these standard deviations."""
    places = np.array([[15.0, 8.0], [12.0, -9.0]])
    tracker = Tracker(spread_out(places, 0.02), stray_density=stray_density, bias_deviation=1e-6, least_deviation=0.0)
    surely = np.diag([1e-4, 1e-4, 1e-5]) ** 2
    state, _ = tracker.update(tracker.start(np.zeros(3), surely)[0], spread_out(places, 1e-3))
    return tracker, tracker.predict(state, np.zeros(3), np.diag(deviations) ** 2, extent=0.0), places


def test_match_that_may_be_a_stray_is_weighed():
    """The mixture is computed by hand: the pose may be displaced in x and y, and one detection of many is a stray."""
    density, deviation, prior, aside = 0.5, 0.05, 0.4, np.array([0.5, -0.3])
    tracker, state, places = two_landmarks(density, [prior, prior, 1e-6])
    after, matches = tracker.update(state, spread_out(places[:1] - aside, deviation))
    S, gain = prior**2 + deviation**2, prior**2 / (prior**2 + deviation**2)
    anything = density + 2.0 / (np.pi * (places[0] - aside) @ (places[0] - aside))
    right = np.exp(-0.5 * aside @ aside / S) / (2.0 * np.pi * S)
    p, moved = right / (right + anything), gain * aside
    assert 0.2 < p < 0.8 and matches.is_fused
    np.testing.assert_allclose(after.pose[:2], state.pose[:2] + p * moved, atol=2e-3)
    spread = p * (1.0 - p) * np.outer(moved, moved)
    expected = (prior**2 - p * gain * prior**2) * np.eye(2) + spread
    np.testing.assert_allclose(after.pose_covariance[:2, :2], expected, rtol=0.01, atol=1e-4)


def test_pair_that_contradicts_another_lowers_its_probability():
    """The mixture is computed by hand: one detection is as far to one side of its landmark as the other to the other.

    They share neither detection nor landmark, but only one of them can be right, or none is.
    """
    density, deviation, prior, aside = 0.5, 0.05, 0.4, np.array([0.3, 0.2])
    tracker, state, places = two_landmarks(density, [prior, prior, 1e-6])
    detected = places + np.array([-aside, aside])
    after, matches = tracker.update(state, spread_out(detected, deviation))
    S, gain = prior**2 + deviation**2, prior**2 / (prior**2 + deviation**2)
    anything = density + 2.0 * 2.0 / (np.pi * (detected**2).sum(axis=1).max())
    right = np.exp(-0.5 * aside @ aside / S) / (2.0 * np.pi * S)
    [(shown, _)] = matches.pairs
    p, moved = right / (2.0 * right + anything), gain * aside * (1.0 - 2.0 * shown)
    assert 0.3 < p < 0.4
    np.testing.assert_allclose(after.pose[:2], state.pose[:2] + p * moved, atol=2e-3)
    spread = p * (1.0 - p) * np.outer(moved, moved)
    expected = (prior**2 - p * gain * prior**2) * np.eye(2) + spread
    np.testing.assert_allclose(after.pose_covariance[:2, :2], expected, rtol=0.01, atol=1e-4)


def test_first_matches_that_others_contradict_are_not_fused():
    """Two against two show nothing; two against three, the three are believed."""
    places, aside = np.array([[15.0, 8.0], [12.0, -9.0], [-10.0, 9.0], [-14.0, -8.0], [3.0, 14.0]]), [0.3, 0.2]
    tracker = Tracker(spread_out(places, 0.02), stray_density=0.01, bias_deviation=1e-6, least_deviation=0.0)
    before, _ = tracker.start(np.zeros(3), np.diag([0.4, 0.4, 1e-4]) ** 2)
    detected = places - np.outer([1.0, 1.0, -1.0, -1.0, 1.0], aside)
    same, undecided = tracker.update(before, spread_out(detected[:4], 0.05))
    np.testing.assert_array_equal(same.mean, before.mean)
    assert not undecided.is_fused
    moved, decided = tracker.update(before, spread_out(detected, 0.05))
    assert decided.pairs[:, 1].tolist() == [0, 1, 4]
    np.testing.assert_allclose(moved.pose[:2], aside, atol=0.02)


def test_strays_do_not_make_an_uncertain_pose_too_sure():
    """One detection of twenty shows something else, up to a metre beside: 0.016 of them in a square metre."""
    deviations, rng, squares = np.array([0.4, 0.4, 0.05]), np.random.default_rng(0), {0.0: [], 0.016: []}
    units = {density: two_landmarks(density, deviations) for density in squares}
    for _ in range(200):
        truth = deviations * rng.normal(size=3)
        aside, turn = (rng.random(2) < 0.05) * np.sqrt(rng.random(2)), rng.uniform(0.0, 2.0 * np.pi, 2)
        noise = 0.05 * rng.normal(size=(2, 2)) + aside[:, None] * np.column_stack([np.cos(turn), np.sin(turn)])
        for density, (tracker, state, places) in units.items():
            detections = spread_out(transform(inverse(truth), places) + noise, 0.05)
            after, matches = tracker.update(state, detections)
            if matches.is_fused:
                squares[density].append(nees(after.pose, after.pose_covariance, truth))
    beyond = {density: np.mean(np.array(values) > chi2.ppf(0.999, 3)) for density, values in squares.items()}
    assert min(len(values) for values in squares.values()) > 190
    assert np.mean(squares[0.0]) > 6.0 and np.mean(squares[0.016]) < 4.0
    assert beyond[0.016] < 0.03 < beyond[0.0], beyond


def along_a_line(seed, share, *, told=0.1, way=30, deviation=0.1):
    """Drive along a line of landmarks whose detections err alike while they are seen, two in each scan.

    The map errs by 0.1 m. Three quarters of the variance of a detection last, over 8 m.

    Args:
        seed: Determines all errors.
        share: The share of the variance that the tracker takes as lasting.
        told: The standard deviation that the map says in m.
        way: The length of the drive in m.
        deviation: The standard deviation of detections in m.

    Returns:
        The normalized squared errors of the poses that are not doubtful, every 5 m, (n,), and the state at the end.
    """
    rng, step, length = np.random.default_rng(seed), 0.5, 8.0
    count = way // 5 + 14
    sides = np.where(np.arange(count) % 2, 1.0, -1.0)
    places = np.column_stack([5.0 * np.arange(count), sides * rng.uniform(4.0, 12.0, count)])
    known = spread_out(places + 0.1 * rng.normal(size=places.shape), told)
    tracker = Tracker(known, lasting_share=share, lasting_length=length, least_deviation=0.0, bias_deviation=1e-6)
    surely, model = np.diag([0.1, 0.1, 0.01]) ** 2, DriftModel(heading=0.002)
    state, truth = tracker.start(np.zeros(3), surely)[0], rng.multivariate_normal(np.zeros(3), surely)
    lasts, independent = deviation * np.sqrt(0.75), deviation * np.sqrt(0.25)
    lasting, rho = lasts * rng.normal(size=places.shape), np.exp(-step / length)
    motion, squares = np.array([step, 0.0, 0.0]), []
    C = model.covariance(motion, step)
    for k in range(2 * way + 1):
        if k:
            truth = compose(truth, motion + rng.multivariate_normal(np.zeros(3), C))
            state = tracker.predict(state, motion, C, extent=step)
            lasting = rho * lasting + np.sqrt(1.0 - rho**2) * lasts * rng.normal(size=places.shape)
        d = transform(inverse(truth), places)
        rows = np.flatnonzero((d[:, 0] > 2.0) & (d[:, 0] < 14.0))[:2]
        detected = d[rows] + lasting[rows] + independent * rng.normal(size=(len(rows), 2))
        state, _ = tracker.update(state, spread_out(detected, deviation))
        if k % 10 == 0 and k and not (tracker.is_doubtful(state) or tracker.is_lost(state)):
            squares.append(nees(state.pose, tracker.pose_covariance(state), truth))
    return squares, state


@pytest.mark.slow
def test_errors_of_detections_that_last_are_covered():
    """In 95 % of the poses, if the tracker knows of them; in fewer, if it takes them as independent."""
    squares = {share: np.concatenate([along_a_line(seed, share)[0] for seed in range(30)]) for share in (0.0, 0.75)}
    covered = {share: np.mean(values < chi2.ppf(0.95, 3)) for share, values in squares.items()}
    assert len(squares[0.75]) > 150
    assert covered[0.0] < 0.9 < 0.95 <= covered[0.75], covered
    assert 2.0 < squares[0.75].mean() < 3.5, squares[0.75].mean()


def test_standing_still_makes_a_pose_no_surer_than_one_scan():
    """Errors of detections that last entirely would be the same in each scan; here, half of their variance is."""
    places = np.array([[8.0, 4.0], [8.0, -4.0], [-5.0, 6.0]])
    tracker = Tracker(spread_out(places, 1e-3), lasting_share=0.5, least_deviation=0.0, bias_deviation=1e-6)
    state, deviations = tracker.start(np.zeros(3), np.diag([0.5, 0.5, 0.05]) ** 2)[0], []
    for _ in range(50):
        state, matches = tracker.update(state, spread_out(places, 0.1))
        assert len(matches.pairs) == 3
        deviations.append(np.sqrt(np.diagonal(state.pose_covariance)))
    np.testing.assert_allclose(deviations[-1], deviations[0], rtol=0.01)


@pytest.mark.slow
def test_few_landmarks_of_a_map_that_is_worse_than_it_says_are_noticed():
    """The map errs by 0.1 m and says 0.03 m; two of its landmarks are seen at a time, by accurate detections.

    Once that is known, in the last 100 m, the deviations of the poses are right.
    """
    drives = [along_a_line(seed, 0.75, told=0.03, way=200, deviation=0.03) for seed in range(6)]
    squares = np.concatenate([squares[-20:] for squares, _ in drives])
    assert np.mean(squares < chi2.ppf(0.95, 3)) > 0.8
    assert 3.0 < np.median([state.scatter for _, state in drives]) < 1.5 * (0.1 / 0.03) ** 2


@pytest.mark.slow
def test_fusing_the_map_in_each_scan_is_inconsistent():
    once, afresh = [], []
    for seed in range(8):
        one = drive(seed, ACCURATE, step=0.02)
        tracker, states = tracked(one)
        state = states[0]
        for k in range(1, len(one.scans)):
            # All landmarks are forgotten: they enter anew, with the error of the map.
            forgetful = TrackState(
                state.mean[:6], state.covariance[:6, :6], state.indices[:0], state.is_recent[:0], state.evidence
            )
            state, _ = tracker.update(tracker.predict(forgetful, *one.motion(k), extent=PERIOD), one.scans[k])
        for squares, last in ((once, states[-1]), (afresh, state)):
            squares.append(nees(last.pose, last.pose_covariance, one.poses[-1]))
    assert np.mean(once) < BOUNDS[1] < 2.0 * BOUNDS[1] < np.mean(afresh)


@pytest.mark.parametrize("correlation", [0.0, 10.0])
def test_the_filter_equals_batch_least_squares(correlation):
    rng = np.random.default_rng(4)
    places = np.array([[x, y] for x in (-6.0, 0.0, 6.0) for y in (-7.0, 5.0)])
    n, scans, share = len(places), 4, 0.9
    apart = np.linalg.norm(places[:, None] - places, axis=2)
    K = 0.05**2 * (share * np.exp(-0.5 * (apart / correlation) ** 2) if correlation else 0.0) * np.ones((n, n))
    np.fill_diagonal(K, 0.05**2)
    in_view = [np.arange(4 if k < 2 else n) for k in range(scans)]
    known = Landmarks(
        places + rng.multivariate_normal(np.zeros(n), K, 2).T,
        np.tile(0.05**2 * np.eye(2), (n, 1, 1)),
        np.full(n, 0.3),
        np.full(n, np.inf),
    )
    poses, duration = [np.array([0.5, -0.5, 0.2])], 2.0
    move, lasting, deviations = np.array([0.6, 0.1, 0.15]), np.array([0.2, -0.01]), np.array([0.1, 0.02])

    def corrected(measured, share, rate):
        way = (1.0 - share) * rotation(-0.5 * rate * duration) @ measured[:2]
        return np.array([*way, measured[2] - rate * duration])

    noise = np.array([[4e-4, 1e-4, 0.0], [1e-4, 4e-4, 5e-5], [0.0, 5e-5, 1e-4]])
    for _ in range(scans - 1):
        poses.append(compose(poses[-1], corrected(move, *lasting) + rng.multivariate_normal(np.zeros(3), noise)))
    sensor, bias, deviation = np.array([0.8, 0.0]), 0.05, 0.02

    def expected(pose, offset, landmarks):
        d = transform(inverse(pose), landmarks)
        ray = d - sensor
        return d + offset * ray / np.linalg.norm(ray, axis=1, keepdims=True)

    seen = [
        expected(pose, bias, places[rows]) + deviation * rng.normal(size=(len(rows), 2))
        for pose, rows in zip(poses, in_view, strict=True)
    ]
    tracker = Tracker(
        known,
        sensor=tuple(sensor),
        odometry_deviation=deviations[0],
        odometry_length=np.inf,
        rate_deviation=deviations[1],
        rate_walk=0.0,
        least_deviation=0.0,
        gate=0.99999,
        first_gate=0.99999,
        correlation=correlation,
        correlated_share=share,
    )
    state, _ = tracker.start(poses[0], START)
    for k, z in enumerate(seen):
        state = tracker.predict(state, move, noise, extent=duration) if k else state
        m = len(z)
        scan = Landmarks(z, np.tile(deviation**2 * np.eye(2), (m, 1, 1)), np.full(m, 0.3), np.full(m, np.inf))
        state, matches = tracker.update(state, scan)
        np.testing.assert_array_equal(matches.pairs, np.column_stack([in_view[k], in_view[k]]))

    def whitened(covariance, residual):
        return np.linalg.solve(np.linalg.cholesky(covariance), residual)

    def residuals(x):
        pose, (offset, *errors), landmarks = np.split(x, [3 * scans, 3 * scans + 3])
        pose, landmarks = pose.reshape(-1, 3), landmarks.reshape(-1, 2)
        parts = [whitened(START, pose[0] - poses[0]), [offset / tracker.bias_deviation], errors / deviations]
        parts += [whitened(noise, compose(inverse(a), b) - corrected(move, *errors)) for a, b in pairwise(pose)]
        parts += [whitened(K, landmarks - known.positions).ravel()]
        parts += [
            (z - expected(p, offset, landmarks[rows])).ravel() / deviation
            for z, p, rows in zip(seen, pose, in_view, strict=True)
        ]
        return np.concatenate(parts)

    batch = least_squares(residuals, np.concatenate([np.ravel(poses), np.zeros(3), known.positions.ravel()]))
    order = np.arange(3 * (scans - 1), batch.x.size)
    covariance = np.linalg.inv(batch.jac.T @ batch.jac)[np.ix_(order, order)]
    np.testing.assert_allclose(state.covariance, covariance, atol=0.02 * covariance.diagonal().max(), rtol=0.05)
    assert (np.abs(state.mean - batch.x[order]) < 0.15 * np.sqrt(covariance.diagonal())).all()
    assert abs(state.range_bias - bias) < 3.0 * np.sqrt(covariance[3, 3])


@pytest.mark.slow
def test_correlated_errors_of_the_map_are_expected():
    _, squares = scores(POOR, drives=16, first=16)
    assert BOUNDS[0] < squares.mean() < BOUNDS[1]


def test_the_heading_is_no_more_certain_than_the_map_allows():
    """Neighbours on the map may be displaced and rotated together, which scans do not show, however many there are."""
    rng = np.random.default_rng(8)
    n, deviation, length, share, noise = 49, 0.7, 40.0, 0.98, 0.03
    places = 6.0 * (np.array(np.divmod(np.arange(n), 7)).T - 3.0) + rng.uniform(-1.0, 1.0, (n, 2))
    squares = ((places[:, None] - places) ** 2).sum(axis=2)
    K = deviation**2 * (share * np.exp(-0.5 * squares / length**2) + (1.0 - share) * np.eye(n))
    shown = places + np.linalg.cholesky(K) @ rng.standard_normal((n, 2))
    covariances, diameters, known = np.tile(np.eye(2), (n, 1, 1)), np.full(n, 0.3), np.full(n, 0.01)
    surveyed = Landmarks(shown, deviation**2 * covariances, diameters, known)
    tracker = Tracker(surveyed, correlation=length, gate=0.9999, first_gate=0.9999)
    motion, drift = np.array([0.25, 0.0, 0.0]), np.diag([0.01, 0.01, 0.001]) ** 2
    truth = np.zeros(3)
    for k in range(40):
        truth = compose(truth, motion)
        z = transform(inverse(truth), places) + noise * rng.standard_normal((n, 2))
        scan = Landmarks(z, noise**2 * covariances, diameters, known)
        if k == 0:
            state, matches = tracker.start(truth, np.diag([0.7, 0.7, 0.02]) ** 2, scan)
        else:
            state, matches = tracker.update(tracker.predict(state, motion, drift, extent=PERIOD), scan)
    assert len(matches.pairs) > 0.9 * n
    # By generalized least squares (Gauss and Markov), where all places relative to the carrier are known.
    around = places - truth[:2]
    J = np.zeros((n, 2, 3))
    J[:, :, :2], J[:, :, 2] = np.eye(2), np.column_stack([-around[:, 1], around[:, 0]])
    J = J.reshape(-1, 3)
    least = np.linalg.inv(J.T @ np.linalg.solve(np.kron(K, np.eye(2)), J))
    found = state.pose_covariance
    assert (found.diagonal() > 0.98 * least.diagonal()).all()
    assert found[2, 2] < 1.2 * least[2, 2]
    assert nees(state.pose, found, truth) < chi2.ppf(0.999, 3)


@pytest.mark.slow
def test_landmarks_that_pass_the_gate_have_smaller_errors():
    """A map's largest errors are not matched: with all of its variance, the pose would seem worse than it is."""
    rng, n, deviation, noise, count = np.random.default_rng(3), 36, 0.3, 0.01, 300
    places = 7.0 * (np.array(np.divmod(np.arange(n), 6)).T - 2.5)
    covariances, diameters, known = np.tile(np.eye(2), (n, 1, 1)), np.full(n, 0.3), np.full(n, 0.01)
    squares = []
    for _ in range(count):
        shown = places + deviation * rng.standard_normal((n, 2))
        tracker = Tracker(Landmarks(shown, deviation**2 * covariances, diameters, known))
        z = places + noise * rng.standard_normal((n, 2))
        scan = Landmarks(z, noise**2 * covariances, diameters, known)
        state, matches = tracker.start(np.zeros(3), np.diag([0.05, 0.05, 0.005]) ** 2, scan)
        assert len(matches.pairs) > 0.8 * n
        squares.append(nees(state.pose, state.pose_covariance, np.zeros(3)))
    low, high = chi2(3 * count).ppf([0.025, 0.975]) / count
    assert low < np.mean(squares) < high


def test_without_detections_covariance_grows_by_the_odometry():
    one = drive(0, ACCURATE)
    tracker, states = tracked(one, odometry_deviation=0.0, rate_deviation=0.0, rate_walk=0.0)
    state = states[-1]
    before = state.pose_covariance
    for _ in range(50):
        motion = np.array([0.2, 0.0, 0.0])
        predicted = tracker.predict(state, motion, DRIFT.covariance(motion, PERIOD), extent=PERIOD)
        state, matches = tracker.update(predicted, Landmarks.empty())
        assert not matches.is_fused
    R_HW = rotation(-states[-1].pose[2])
    along, along_before = ((R_HW @ P[:2, :2] @ R_HW.T)[0, 0] for P in (state.pose_covariance, before))
    assert along - along_before == pytest.approx(DRIFT.along**2 * 10.0, rel=0.02)
    grown = before[2, 2] + DRIFT.heading**2 * 50 * PERIOD
    assert state.pose_covariance[2, 2] == pytest.approx(grown)
    # It is no loss not to see anything.
    assert not tracker.is_lost(state)


def test_landmarks_without_a_known_place_are_not_used():
    """The gate of a landmark that may be anywhere would contain all others in each scan."""
    one = drive(1, ACCURATE)
    C = one.map.covariances.copy()
    C[5] = 1e4 * np.eye(2)
    vague = Landmarks(one.map.positions, C, one.map.diameters, one.map.diameter_deviations)
    rest = one.map.select(np.arange(len(one.map)) != 5)
    poses = []
    for landmarks in (vague, rest):
        tracker = Tracker(landmarks)
        state, _ = tracker.start(one.poses[0], START, one.scans[0])
        for k in range(1, 6):
            state, matches = tracker.update(tracker.predict(state, *one.motion(k), extent=PERIOD), one.scans[k])
        assert matches.is_fused and len(state.indices) < 60
        poses.append(state.pose)
    # Only the distribution of all diameters differs.
    np.testing.assert_allclose(*poses, atol=2e-3)
    with pytest.raises(ValueError, match="no landmark .* largest_deviation=0.05 m: .* 0.1 m"):
        Tracker(one.map, largest_deviation=0.05)


@pytest.mark.slow
def test_the_map_is_used_once_on_a_closed_route():
    """No estimate by a map of n trees is better than s^2 / n, however often the carrier comes by."""
    rng = np.random.default_rng(4)
    angles = np.arange(48) * 2.0 * np.pi / 48
    ring = 25.0 * np.column_stack([np.cos(angles), np.sin(angles)])
    deviation, count = 0.1, len(ring)
    shown = ring + deviation * rng.standard_normal(ring.shape)
    tree_map = Landmarks(
        shown, np.tile(deviation**2 * np.eye(2), (count, 1, 1)), np.full(count, 0.3), np.full(count, 0.01)
    )
    tracker = Tracker(tree_map, first_gate=0.9999)
    motion, drift = np.array([2.0, 0.0, 2.0 / 20.0]), np.diag([0.005, 0.005, 0.0005]) ** 2
    truth = np.array([20.0, 0.0, np.pi / 2.0])
    state = tracker.start(truth, START)[0]
    seen = set()
    for _ in range(5 * 63):
        truth = compose(truth, motion)
        near = ring[np.hypot(*(ring - truth[:2]).T) < 25.0]
        places = transform(inverse(truth), near) + 0.01 * rng.standard_normal(near.shape)
        n = len(near)
        scan = Landmarks(places, np.tile(1e-4 * np.eye(2), (n, 1, 1)), np.full(n, 0.3), np.full(n, 0.01))
        slip = rng.multivariate_normal(np.zeros(3), drift)
        state, matches = tracker.update(tracker.predict(state, motion + slip, drift, extent=PERIOD), scan)
        seen |= set(matches.pairs[:, 1])
    assert matches.is_fused and len(seen) > 40
    assert (np.diagonal(state.pose_covariance)[:2] > deviation**2 / count).all()
    assert nees(state.pose, state.pose_covariance, truth) < chi2.ppf(0.999, 3)


def test_lasting_errors_of_dead_reckoning_are_expected():
    """Drive 100 m in a curve without landmarks, by the same odometry each time."""
    known, rng, steps, duration = drive(0, ACCURATE).map, np.random.default_rng(5), 50, 2.0
    measured = np.array([2.0, 0.1, 0.1])
    C, exactly = DRIFT.covariance(measured, duration), 1e-12 * np.eye(3)
    tracker, forgetful = Tracker(known), Tracker(known, odometry_deviation=0.0, rate_deviation=0.0, rate_walk=0.0)
    last, without = (one.start(np.zeros(3), exactly)[0] for one in (tracker, forgetful))
    for _ in range(steps):
        last, without = (
            one.predict(state, measured, C, extent=duration) for one, state in ((tracker, last), (forgetful, without))
        )
    wrong = []
    for _ in range(60):
        share, rate = rng.normal(size=2) * [tracker.odometry_deviation, tracker.rate_deviation]
        truth = np.zeros(3)
        for noise in rng.multivariate_normal(np.zeros(3), C, steps):
            way = (1.0 - share) * rotation(-0.5 * rate * duration) @ measured[:2]
            truth = compose(truth, np.array([*way, measured[2] - rate * duration]) + noise)
            rate += tracker.rate_walk * duration**0.5 * rng.normal()
            kept = np.exp(-np.hypot(*measured[:2]) / tracker.odometry_length)
            share = kept * share + (1.0 - kept**2) ** 0.5 * tracker.odometry_deviation * rng.normal()
        wrong.append(error(last.pose, truth))
    low, high = chi2(3 * 60).ppf([0.025, 0.975]) / 60.0
    honest, overconfident = (
        np.einsum("ni,ij,nj->n", wrong, np.linalg.inv(state.pose_covariance), wrong).mean() for state in (last, without)
    )
    assert low < honest < high < 2.0 * high < overconfident


def test_the_state_stays_small_and_is_a_value():
    one = drive(1, ACCURATE, scans=60, step=0.8)
    tracker, states = tracked(one, horizon=15.0, most=30)
    last = states[-1]
    assert max(len(state.indices) for state in states) <= 30
    distances = np.linalg.norm(last.mean[6:].reshape(-1, 2) - last.pose[:2], axis=1)
    assert distances.max() < 15.0 and len(last.indices) < len(np.unique(np.concatenate([s.indices for s in states])))
    assert copy.deepcopy(last) is last
    codec = codec_of(TrackState.none())
    again = codec.decode(codec.encode(last))
    motion = one.motion(3)
    for name, array in codec.encode(tracker.predict(again, *motion, extent=PERIOD)).items():
        np.testing.assert_array_equal(array, codec.encode(tracker.predict(last, *motion, extent=PERIOD))[name])
    with pytest.raises(ValueError):
        last.mean[0] = 1.0


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"gate": 1.0}, "Tracker.gate must be a number above 0 and below 1, not 1.0"),
        ({"first_gate": 0.0}, "first_gate must be a number above 0 and below 1, not 0.0"),
        ({"correlation": -1.0}, "correlation must be a finite number of at least 0 m"),
        ({"scan_deviation": -0.1}, "scan_deviation must be a finite number of at least 0 m"),
        ({"least_deviation": np.nan}, "least_deviation must be a finite number of at least 0 m, not nan"),
        ({"field_of_view": 7.0}, "field_of_view must be a number above 0 and at most 6.28319 rad"),
        ({"most": 0}, "most must be a whole number of at least 1"),
        ({"correlated_share": 1.0}, "correlated_share must be a number from 0 to below 1"),
    ],
)
def test_impossible_settings_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        Tracker(drive(0, ACCURATE).map, **settings)


def test_an_empty_map_is_refused():
    with pytest.raises(ValueError, match="empty"):
        Tracker(Landmarks.empty())


@pytest.mark.parametrize("correlation", [0.0, 20.0])
def test_nothing_to_match_and_exact_maps_are_no_errors(correlation):
    places = np.array([[0.0, 0.0], [4.0, 1.0], [-3.0, 5.0], [6.0, -4.0]])
    exact = Landmarks(places, np.zeros((4, 2, 2)), np.full(4, 0.3), np.zeros(4))
    tracker = Tracker(exact, correlation=correlation)
    for scan in (Landmarks.empty(), exact.select([0]).seen_from([50.0, 0.0, 0.0])):
        state, matches = tracker.start(np.zeros(3), START, scan)
        assert not matches.is_fused and tracker.is_lost(state)
    state, matches = tracker.start(np.zeros(3), START, exact)
    state, matches = tracker.update(state, exact)
    assert matches.is_fused and len(matches.pairs) == 4
    np.testing.assert_allclose(state.pose, 0.0, atol=1e-9)
    state, matches = tracker.update(state, exact.select([0]))
    assert matches.is_fused and len(matches.pairs) == 1
