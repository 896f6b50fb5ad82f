"""A map that is revised on the way: landmarks that it lacks are added, those that are gone are dropped."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.stats import chi2

from tests.components.localization.drives import PERIOD, drive, nees
from vtbdrake.common.arrays import Array
from vtbdrake.components.localization.constellation import ConstellationMap
from vtbdrake.components.localization.landmarks import Landmarks, SensorView
from vtbdrake.components.localization.planar import compose, inverse, transform, wrap
from vtbdrake.components.localization.revision import is_in_plain_view
from vtbdrake.components.localization.track_state import TrackState
from vtbdrake.components.localization.tracking import Tracker
from vtbdrake.components.localization.unit import TRACKING, UNIT_STATE_CODEC, LocalizationUnit
from vtbdrake_diagrams.forest.world.stand import ACCURATE, MapErrors

pytestmark = pytest.mark.one_python

SURELY = np.diag([0.02, 0.02, 0.002]) ** 2
NOISE = 0.02
MOTION_NOISE = np.diag([0.03, 0.03, 0.004]) ** 2


def landmarks(places: Array, deviation: float, diameter: float = 0.3) -> Landmarks:
    """Return landmarks with equal deviations, and diameters that are known to 1 cm."""
    n = len(places)
    return Landmarks(places, np.tile(deviation**2 * np.eye(2), (n, 1, 1)), np.full(n, diameter), np.full(n, 0.01))


def grid(xs: Array, ys: Array) -> Array:
    """Return places at all pairs of x and y, each displaced a little so that no two views are alike, (n, 2)."""
    places = np.array([[x, y] for x in xs for y in ys], dtype=float)
    return places + np.random.default_rng(3).uniform(-0.8, 0.8, places.shape)


def scanned(places: Array, X_WH: Array, rng: np.random.Generator, reach: float = 12.0) -> Landmarks:
    """Return the detections of all places within reach; none of them hides another."""
    seen = transform(inverse(X_WH), places)
    seen = seen[np.hypot(*seen.T) < reach]
    return landmarks(seen + NOISE * rng.normal(size=seen.shape), NOISE)


def driven(
    tracker: Tracker, places: Array, poses: Array, *, seed: int = 1
) -> tuple[list[TrackState], list[Landmarks], list[Array]]:
    """Track a drive among landmarks at these places; return the states, the scans and the measured motions."""
    rng = np.random.default_rng(seed)
    states, scans, motions = [tracker.start(poses[0], SURELY)[0]], [], []
    for before, after in pairwise(poses):
        noise = np.sqrt(np.diagonal(MOTION_NOISE)) * rng.normal(size=3)
        motions.append(compose(inverse(before), after) + noise)
        scans.append(scanned(places, after, rng))
        predicted = tracker.predict(states[-1], motions[-1], MOTION_NOISE, extent=PERIOD)
        states.append(tracker.update(predicted, scans[-1])[0])
    return states, scans, motions


def straight(length: float, step: float = 0.5) -> Array:
    """Return poses along x, (n, 3)."""
    x = np.arange(0.0, length + 1e-9, step)
    return np.column_stack([x, 0.0 * x, 0.0 * x])


def test_one_missing_and_one_wrong_entry_are_found() -> None:
    trees = grid(np.arange(-10.0, 31.0, 5.0), (-6.0, 6.0))
    rng = np.random.default_rng(0)
    missing, wrong = 9, np.array([[12.0, 1.5]])
    for correlation in (0.0, 40.0):
        # Errors that neighbours share are nearly the same here.
        independent = np.sqrt(0.02) if correlation else 1.0
        errors = independent * rng.normal(size=(len(trees), 2)) + np.sqrt(1.0 - independent**2) * rng.normal(size=2)
        mapped = np.vstack([np.delete(trees, missing, axis=0), wrong]) + 0.05 * errors
        tracker = Tracker(landmarks(mapped, 0.05), revises=True, correlation=correlation)
        states, _, _ = driven(tracker, trees, straight(20.0))
        changes = tracker.changes(states[-1])
        assert changes.gone.tolist() == [len(mapped) - 1]
        assert len(changes.added) == 1 and not len(changes.moved)
        error = changes.added.positions[0] - trees[missing]
        assert error @ np.linalg.solve(changes.added.covariances[0], error) < chi2.ppf(0.999, 2)
        assert changes.added.diameters[0] == pytest.approx(0.3, abs=0.01)
    fixed = Tracker(landmarks(mapped, 0.05))
    states, _, _ = driven(fixed, trees, straight(20.0))
    assert not len(fixed.changes(states[-1]).added) and not len(states[-1].revision.identities)


def test_filter_agrees_with_least_squares_over_the_whole_drive() -> None:
    """Poses and landmarks by all measurements at once (Gauss and Newton), and the inverse of their information."""
    mapped, lacking = grid((-6.0, 0.0), (-6.0, 6.0)), grid((6.0, 12.0, 18.0), (-6.0, 6.0))
    exact = {"least_deviation": 0.0, "bias_deviation": 1e-7, "odometry_deviation": 1e-7, "rate_deviation": 1e-7}
    tracker = Tracker(landmarks(mapped, 1e-5), revises=True, gate=0.9999, first_gate=0.9999, rate_walk=0.0, **exact)
    there = straight(18.0, 1.5)
    poses = np.vstack([there, there[-2::-1]])
    poses[:, 1] = 0.02 * poses[:, 0] ** 1.5
    states, scans, motions = driven(tracker, np.vstack([mapped, lacking]), poses)
    last = states[-1]
    assert all(state.failures == 0 for state in states)
    is_added = last.indices >= len(mapped)
    assert is_added.sum() == len(lacking)
    drifts = [state.drift for state in states[:-1]]
    free = len(poses) - 1
    roots = [np.linalg.inv(np.linalg.cholesky(drift * MOTION_NOISE)) for drift in drifts]
    matches = []
    for k, scan in enumerate(scans):
        seen = transform(poses[k + 1], scan.positions)
        nearest = np.argmin(np.hypot(*(np.vstack([mapped, lacking])[:, None] - seen).transpose(2, 0, 1)), axis=0)
        matches.append(nearest)

    def residuals(x: Array) -> Array:
        path, places = x[: 3 * (free + 1)].reshape(-1, 3), np.vstack([mapped, x[3 * (free + 1) :].reshape(-1, 2)])
        parts = [(path[0] - poses[0]) / np.sqrt(np.diagonal(SURELY))]
        for k in range(free):
            off = compose(inverse(path[k]), path[k + 1]) - motions[k]
            parts.append(roots[k] @ [*off[:2], wrap(off[2])])
            expected = transform(inverse(path[k + 1]), places[matches[k]])
            parts.append((expected - scans[k].positions).ravel() / NOISE)
        return np.concatenate(parts)

    best = least_squares(residuals, np.concatenate([poses.ravel(), lacking.ravel()]), x_scale="jac")
    covariance = np.linalg.inv(best.jac.T @ best.jac)
    # Both have the last pose, and the landmarks, in the order in which they are near to each other.
    places = best.x[3 * (free + 1) :].reshape(-1, 2)
    rows = np.flatnonzero(is_added)
    order = np.argmin(np.hypot(*(places - last.landmark_positions[rows][:, None]).transpose(2, 0, 1)), axis=1)
    of_batch = np.concatenate([3 * free + np.arange(3), (3 * (free + 1) + 2 * order[:, None] + [0, 1]).ravel()])
    of_filter = np.concatenate([np.arange(3), (6 + 2 * rows[:, None] + [0, 1]).ravel()])
    deviations = np.sqrt(np.diagonal(covariance)[of_batch])
    np.testing.assert_allclose(last.mean[of_filter], best.x[of_batch], atol=0.15 * deviations.max())
    filtered = last.covariance[np.ix_(of_filter, of_filter)]
    np.testing.assert_allclose(np.sqrt(np.diagonal(filtered)), deviations, rtol=0.03)
    # The correlations, too.
    scaled = (filtered - covariance[np.ix_(of_batch, of_batch)]) / np.outer(deviations, deviations)
    assert np.abs(scaled).max() < 0.06


def test_loop_that_closes_corrects_what_was_found_outside() -> None:
    mapped, lacking = grid((-10.0, -5.0, 0.0, 5.0), (-6.0, 6.0)), grid(np.arange(10.0, 41.0, 5.0), (-6.0, 6.0))
    tracker = Tracker(landmarks(mapped, 0.01), revises=True)
    there = straight(35.0)
    poses = np.vstack([there, there[-2::-1]])
    states, _, _ = driven(tracker, np.vstack([mapped, lacking]), poses)

    def deviation(state: TrackState) -> float:
        return float(np.sqrt(np.trace(state.pose_covariance[:2, :2])))

    def of_landmark(state: TrackState, place: Array) -> tuple[float, float]:
        row = int(np.argmin(np.hypot(*(state.landmark_positions - place).T)))
        P = state.covariance[6 + 2 * row : 8 + 2 * row, 6 + 2 * row : 8 + 2 * row]
        return float(np.hypot(*(state.landmark_positions[row] - place))), float(np.sqrt(np.trace(P)))

    inside, outside, back = states[4], states[len(there) - 1], states[-1]
    assert deviation(outside) > 2.0 * deviation(inside) and deviation(back) < 1.5 * deviation(inside)
    assert np.hypot(*(back.pose - poses[-1])[:2]) < 4.0 * deviation(back)
    # The farthest ones were found first when the pose was least certain.
    for place in lacking[-2:]:
        (_, before), (error, after) = of_landmark(outside, place), of_landmark(back, place)
        assert after < before and error < 4.0 * after
    assert not any(tracker.is_doubtful(state) for state in states)
    # Without revision, the scans outside show nothing that is known.
    fixed = Tracker(landmarks(mapped, 0.01))
    assert any(fixed.is_lost(state) for state in driven(fixed, np.vstack([mapped, lacking]), poses)[0])


def test_landmarks_are_judged_again_only_after_a_way() -> None:
    trees = grid(np.arange(-10.0, 11.0, 5.0), (-6.0, 6.0))
    mapped = np.vstack([trees, [[2.0, 2.0]]])
    tracker = Tracker(landmarks(mapped, 0.02), revises=True)
    standing, _, _ = driven(tracker, trees, np.zeros((40, 3)))
    revision = standing[-1].revision
    assert not len(revision.gone)
    wrong = revision.rows(np.array([len(trees)]))
    one_miss, many = standing[1].revision, revision
    assert one_miss.log_odds[one_miss.rows(np.array([len(trees)]))] == many.log_odds[wrong]


def test_hidden_far_and_narrow_landmarks_are_not_in_plain_view() -> None:
    seen = landmarks(np.array([[5.0, 0.0], [0.0, 6.0], [-20.0, 0.0], [0.0, -4.0], [3.0, -6.0]]), 0.02)
    places = np.array([[9.0, 0.1], [9.0, 2.0], [-9.0, 16.0], [5.2, 0.1], [7.0, -7.0]])
    diameters = np.array([0.5, 0.5, 1.0, 0.5, 0.05])
    shown = is_in_plain_view(SensorView(seen), places, diameters)
    # Behind the first detection; free; beyond 0.7 of 20 m; may be the first detection itself; narrow.
    assert shown.tolist() == [False, True, False, True, False]
    behind = SensorView(seen, field_of_view=1.0)
    assert is_in_plain_view(behind, np.array([[-9.0, 0.5]]), np.array([0.5])).tolist() == [False]


def test_entry_that_is_always_hidden_is_kept() -> None:
    trees = grid(np.arange(-10.0, 31.0, 5.0), (-6.0, 6.0))
    # Nobody can see whether the last one is there: a trunk stands before it, seen from the way.
    way = np.column_stack([np.zeros(20), np.linspace(-2.0, 2.0, 20), np.zeros(20)])
    wall = np.column_stack([np.full(13, 4.0), np.linspace(-3.0, 3.0, 13)])
    world = np.vstack([trees, wall])
    tracker = Tracker(landmarks(np.vstack([world, [[8.0, 0.0]]]), 0.02, 0.6), revises=True)
    rng, state = np.random.default_rng(0), tracker.start(way[0], SURELY)[0]
    for before, pose in pairwise(way):
        wide = landmarks(scanned(world, pose, rng).positions, NOISE, 0.6)
        state, _ = tracker.update(tracker.predict(state, pose - before, MOTION_NOISE, extent=PERIOD), wide)
    assert len(world) not in state.revision.gone and len(world) not in state.revision.identities


def test_landmark_beside_its_place_on_the_map_is_moved() -> None:
    trees = grid(np.arange(-10.0, 31.0, 5.0), (-6.0, 6.0))
    mapped = trees.copy()
    mapped[9] += [0.9, 0.0]
    tracker = Tracker(landmarks(mapped, 0.3), revises=True)
    changes = tracker.changes(driven(tracker, trees, straight(20.0))[0][-1])
    assert changes.origins.tolist() == [9] and not len(changes.added) and not len(changes.gone)
    np.testing.assert_allclose(changes.moved.positions, trees[9:10], atol=0.3)


@pytest.mark.parametrize("seed", range(6))
def test_wrong_start_is_noticed_although_the_map_may_lack_everything(seed: int) -> None:
    one = drive(2000 + seed, MapErrors(0.35, missing=0.2, wrong=0.2, diameter=0.2))
    rng = np.random.default_rng(2000 + seed)
    tracker = Tracker(one.map, revises=True)
    first = one.poses[0] + [*rng.uniform(-6.0, 6.0, 2), rng.uniform(-3.0, 3.0)]
    state = tracker.start(first, np.diag([0.1, 0.1, 0.01]) ** 2, one.scans[0])[0]
    for k in range(1, 8):
        if not tracker.is_lost(state):
            state = tracker.update(tracker.predict(state, *one.motion(k), extent=PERIOD), one.scans[k])[0]
    assert tracker.is_lost(state)


def test_right_start_with_an_old_map_is_kept_within_its_covariance() -> None:
    one = drive(3, MapErrors(0.1, missing=0.2, wrong=0.2))
    tracker = Tracker(one.map, revises=True)
    state = tracker.start(one.poses[0], np.diag([0.1, 0.1, 0.01]) ** 2, one.scans[0])[0]
    for k in range(1, len(one.scans)):
        state = tracker.update(tracker.predict(state, *one.motion(k), extent=PERIOD), one.scans[k])[0]
    assert nees(state.pose, tracker.pose_covariance(state), one.poses[-1]) < chi2.ppf(0.999, 3)
    assert len(tracker.changes(state).added) > 3


def test_memory_of_a_unit_that_revises_its_map_goes_on_from_a_file() -> None:
    one = drive(3, replace(ACCURATE, missing=0.2, wrong=0.2))
    unit = LocalizationUnit(ConstellationMap(one.map), Tracker(one.map, revises=True))

    def after(memory, scans):
        for k in scans:
            answer, memory = unit.step(memory, one.scans[k], X_OH=one.reckoned[k], time=PERIOD * k)
        return answer, memory

    _, memory = after(unit.start(), range(20))
    again = UNIT_STATE_CODEC.decode(UNIT_STATE_CODEC.encode(memory))
    assert len(memory.track.revision.identities) and memory.track.revision.begun
    (answer, end), (other, other_end) = (after(each, range(20, 30)) for each in (memory, again))
    assert answer.status == TRACKING
    np.testing.assert_array_equal(answer.pose, other.pose)
    for name in ("identities", "log_odds", "diameters"):
        np.testing.assert_array_equal(getattr(end.track.revision, name), getattr(other_end.track.revision, name))
