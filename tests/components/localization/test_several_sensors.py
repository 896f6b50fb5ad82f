"""A scanner and a narrow sensor of another kind in one filter: each counts with its own covariance and view."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from vtbdrake.common.arrays import Array
from vtbdrake.components.localization.constellation import ConstellationMap
from vtbdrake.components.localization.landmarks import Landmarks, SensorView
from vtbdrake.components.localization.planar import rotation
from vtbdrake.components.localization.submap import Submap
from vtbdrake.components.localization.tracking import Tracker
from vtbdrake.components.localization.unit import TRACKING, LocalizationUnit

pytestmark = pytest.mark.one_python

PLACES = np.random.default_rng(5).uniform(-12.0, 12.0, (60, 2))
VIEW = np.radians(77.0)
SURELY = np.diag([0.05, 0.05, 0.01]) ** 2
AHEAD = np.flatnonzero(np.abs(np.arctan2(PLACES[:, 1], PLACES[:, 0])) < 0.45 * VIEW)[:5]


def seen(places: Array, deviation: float) -> Landmarks:
    """Return landmarks with unknown diameters."""
    n = len(places)
    return Landmarks(places, np.tile(deviation**2 * np.eye(2), (n, 1, 1)), np.full(n, 0.3), np.full(n, np.inf))


def tracker(**settings: float) -> Tracker:
    """Return a tracker on an exact map of `PLACES`."""
    return Tracker(seen(PLACES, 1e-6), **({"least_deviation": 0.0} | settings))


def test_sensors_are_fused_with_the_weights_of_their_covariances() -> None:
    rng = np.random.default_rng(1)
    filter = tracker(bias_deviation=1e-9)
    state, _ = filter.start(np.zeros(3), SURELY)
    truth = np.array([0.02, -0.03, 0.004])
    to_carrier = rotation(-truth[2])
    views, rows = [], []
    for which, deviation, is_scan in ((np.arange(30), 0.05, True), (AHEAD, 0.15, False)):
        exact = (PLACES[which] - truth[:2]) @ to_carrier.T
        noisy = exact + deviation * rng.normal(size=exact.shape)
        views.append(SensorView(seen(noisy, deviation), VIEW if not is_scan else 2.0 * np.pi, is_scan))
        for (x, y), detected, expected in zip(PLACES[which], noisy, PLACES[which], strict=True):
            # A detection is R(-theta) (l - p): to first order about 0, l - p + theta [y, -x].
            rows += [([-1.0, 0.0, y], detected[0] - expected[0], deviation)]
            rows += [([0.0, -1.0, -x], detected[1] - expected[1], deviation)]
    for view in views:
        state, matches = filter.update(state, view)
        assert matches.is_fused and len(matches.pairs) == len(view.landmarks)
    # The estimate of Gauss and Markov by all detections at once.
    A, b, deviations = (np.array(column) for column in zip(*rows, strict=True))
    weighted = A / deviations[:, None]
    information = weighted.T @ weighted + np.linalg.inv(SURELY)
    best = np.linalg.solve(information, weighted.T @ (b / deviations))
    np.testing.assert_allclose(state.pose, best, atol=1e-3)
    np.testing.assert_allclose(state.pose_covariance, np.linalg.inv(information), rtol=0.01, atol=5e-8)


def test_range_bias_is_the_scanner_s_alone() -> None:
    filter = tracker(bias_deviation=0.1)
    start, _ = filter.start(np.zeros(3), np.diag([1e-4, 1e-4, 1e-5]) ** 2)
    distances = np.linalg.norm(PLACES, axis=1, keepdims=True)
    farther = seen(PLACES * (1.0 + 0.05 / distances), 0.01)
    scanned, _ = filter.update(start, farther)
    assert scanned.range_bias == pytest.approx(0.05, abs=0.005)
    other, matches = filter.update(start, SensorView(seen(PLACES, 0.01), is_scan=False))
    assert matches.is_fused and other.range_bias == 0.0
    assert other.covariance[3, 3] == pytest.approx(0.1**2)
    # After the scan, exact detections of the other sensor contradict neither the bias nor the map.
    after, matches = filter.update(scanned, SensorView(seen(PLACES, 0.01), is_scan=False))
    assert len(matches.pairs) == len(PLACES) and after.range_bias == pytest.approx(0.05, abs=0.005)


def test_what_lies_outside_of_a_view_is_not_missed() -> None:
    filter = tracker()
    state, _ = filter.update(filter.start(np.zeros(3), SURELY)[0], seen(PLACES, 0.05))
    assert state.is_recent.sum() == len(PLACES)
    few = SensorView(seen(PLACES[AHEAD], 0.1), VIEW, is_scan=False)
    # For a sensor that sees all around, they would be too few.
    assert filter.update(state, few.landmarks)[0].failures == 1
    fused, _ = filter.update(state, few)
    assert fused.failures == 0
    # The scan that follows is still compared with all that the scan before showed outside of the view.
    places = PLACES[fused.indices]
    is_outside = np.abs(np.arctan2(places[:, 1], places[:, 0])) > 0.5 * VIEW
    np.testing.assert_array_equal(fused.is_recent, is_outside | np.isin(fused.indices, AHEAD))
    assert is_outside.sum() > 40


def test_places_outside_of_a_view_have_had_no_chance() -> None:
    behind, ahead = [[-4.0, 1.0]], [[5.0, 0.5], [8.0, -1.0]]
    gathered = Submap.empty().with_scan(seen(np.array(behind), 0.02), least_deviation=0.02)
    for _ in range(4):
        gathered = gathered.with_scan(SensorView(seen(np.array(ahead), 0.02), VIEW), least_deviation=0.02)
    assert len(gathered.landmarks()) == 3
    for _ in range(4):
        gathered = gathered.with_scan(seen(np.array(ahead), 0.02), least_deviation=0.02)
    assert len(gathered.landmarks()) == 2


def test_unit_takes_all_that_is_seen_at_one_time() -> None:
    survey = seen(PLACES, 0.05)
    unit = LocalizationUnit(ConstellationMap(survey), Tracker(survey))
    both = [SensorView(seen(PLACES, 0.03)), SensorView(seen(PLACES[AHEAD], 0.1), VIEW, is_scan=False)]
    answer, state = unit.step(unit.start(), both, X_OH=np.zeros(3), time=0.0)
    assert answer.status == TRACKING and answer.detected == len(PLACES) + len(AHEAD)
    answer, state = unit.step(state, both, X_OH=np.zeros(3), time=0.2)
    assert answer.matched == len(PLACES) + len(AHEAD)
    scanned, _ = unit.step(state, both[:1], X_OH=np.zeros(3), time=0.4)
    joined, _ = unit.step(state, both, X_OH=np.zeros(3), time=0.4)
    assert np.linalg.det(joined.covariance) < np.linalg.det(scanned.covariance)
    # A time without anything is dead reckoning.
    blind, _ = unit.step(state, [], X_OH=[0.1, 0.0, 0.0], time=0.4)
    assert blind.status == TRACKING and blind.matched == 0 and blind.pose[0] == pytest.approx(0.1, abs=0.01)
    none, _ = unit.step(unit.start(), [], X_OH=np.zeros(3), time=0.0)
    assert none.status != TRACKING


@pytest.mark.parametrize("view", [0.0, 7.0, np.nan])
def test_impossible_views_are_refused(view: float) -> None:
    with pytest.raises(ValueError, match="a field of view is above 0 and at most 2 pi rad"):
        replace(SensorView(seen(PLACES, 0.1)), field_of_view=view)
