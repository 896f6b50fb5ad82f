from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise

import numpy as np
import pytest

from tests.components.localization.drives import PERIOD, drive, error, nees
from vtbdrake.components.localization.constellation import ConstellationMap
from vtbdrake.components.localization.landmarks import Landmarks
from vtbdrake.components.localization.map_errors import ShownErrors
from vtbdrake.components.localization.planar import compose, inverse
from vtbdrake.components.localization.tracking import Tracker
from vtbdrake.components.localization.unit import (
    DOUBTFUL,
    LOST,
    SEARCHING,
    TRACKING,
    UNIT_STATE_CODEC,
    LocalizationUnit,
)
from vtbdrake_diagrams.forest.world.stand import ACCURATE, REMOTE

pytestmark = pytest.mark.one_python


@cache
def unit_on(seed):
    """Return the unit on the accurate map of a drive that reaches far."""
    return unit_for(drive(seed, ACCURATE, reach=18.0).map)


def unit_for(landmarks, locator=None):
    return LocalizationUnit(locator or ConstellationMap(landmarks), Tracker(landmarks))


def run(unit, scans, reckoned, state=None, first=0):
    """Return the answers to scans, and the state at the end."""
    state, answers = state or unit.start(), []
    for k, (scan, X_OH) in enumerate(zip(scans, reckoned, strict=True)):
        answer, state = unit.step(state, scan, X_OH=X_OH, time=PERIOD * (first + k))
        answers.append(answer)
    return answers, state


def test_a_carrier_without_a_guess_is_found_and_tracked():
    one = drive(3, ACCURATE, reach=18.0)
    answers, state = run(unit_on(3), one.scans, one.reckoned)
    is_tracking = [answer.status == TRACKING for answer in answers]
    first = is_tracking.index(True)
    assert first < 10 and all(is_tracking[first:]) and state.losses == 0
    for answer, X_WH in list(zip(answers, one.poses, strict=True))[first:]:
        assert np.linalg.norm(error(answer.pose, X_WH)[:2]) < 0.15
        assert nees(answer.pose, answer.covariance, X_WH) < 25.0
    assert all(np.isnan(answer.pose).all() and np.isinf(answer.covariance[0, 0]) for answer in answers[:first])
    np.testing.assert_array_equal(answers[-1].X_OH, one.reckoned[-1])


@pytest.mark.slow
@pytest.mark.parametrize("errors", [ACCURATE, REMOTE])
def test_a_kidnapped_carrier_is_lost_and_found_again(errors):
    one, other = drive(3, errors, reach=18.0), drive(3, errors, reach=18.0, step=0.5, scans=60, start=(20.0, 40.0))
    unit = unit_for(one.map)
    answers, state = run(unit, one.scans, one.reckoned)
    assert answers[-1].status == TRACKING
    # The odometry goes on as if nothing had happened.
    moved = [compose(one.reckoned[-1], X_OH) for X_OH in other.reckoned]
    after, state = run(unit, other.scans, moved, state, first=len(answers))
    statuses = [answer.status for answer in after]
    lost = statuses.index(LOST)
    assert lost <= 5 and state.losses == 1
    # From the first scan on, there is no pose.
    assert set(statuses[:lost]) == {DOUBTFUL}
    assert all(np.isnan(answer.pose).all() and np.isinf(answer.covariance[0, 0]) for answer in after[:lost])
    found = statuses.index(TRACKING, lost)
    assert set(statuses[found:]) == {TRACKING}
    assert nees(after[-1].pose, after[-1].covariance, other.poses[-1]) < 25.0


def test_a_doubtful_pose_is_back_with_the_next_good_scan():
    one, other = drive(3, ACCURATE, reach=18.0), drive(3, ACCURATE, reach=18.0, step=0.5, start=(20.0, 40.0))
    scans = [*one.scans[:20], *other.scans[:2], *one.scans[22:]]
    answers, state = run(unit_on(3), scans, one.reckoned)
    assert [answer.status for answer in answers[19:23]] == [TRACKING, DOUBTFUL, DOUBTFUL, TRACKING]
    assert state.losses == 0
    assert nees(answers[22].pose, answers[22].covariance, one.poses[22]) < 25.0


@pytest.mark.slow
def test_a_pose_on_a_sheared_map_becomes_doubtful():
    """A shear of 1 % displaces what is seen by two deviations of the map at most, but by metres along 200 m."""
    one = drive(3, ACCURATE, reach=18.0)
    places = one.map.positions
    sheared = replace(one.map, positions=places + 0.01 * (places - places.mean(axis=0))[:, ::-1])
    right, _ = run(unit_on(3), one.scans, one.reckoned)
    wrong, state = run(unit_for(sheared), one.scans, one.reckoned)
    assert DOUBTFUL not in [answer.status for answer in right]
    assert wrong[-1].status == DOUBTFUL and not state.track.failures
    assert np.isnan(wrong[-1].pose).all() and np.isinf(wrong[-1].covariance[0, 0])
    # It does not stay so for ever: after a while, the place is searched for again.
    again, state = run(replace(unit_for(sheared), doubt_length=2.0), one.scans, one.reckoned)
    first = [answer.status for answer in again].index(LOST)
    assert [answer.status for answer in wrong][first - 1 : first + 1] == [DOUBTFUL, DOUBTFUL] and state.losses


@pytest.mark.slow
@pytest.mark.parametrize("errors", [ACCURATE, REMOTE])
def test_unit_never_tracks_on_the_map_of_another_place(errors):
    for seed in range(2):
        one = drive(seed, errors, reach=18.0, elsewhere=seed + 50)
        answers, _ = run(unit_for(one.map), one.scans, one.reckoned)
        assert {answer.status for answer in answers} == {SEARCHING}


@dataclass(frozen=True)
class Wrong:
    """A locator that always returns a wrong pose, and is sure of it."""

    pose: np.ndarray
    covariance: np.ndarray
    is_sure: bool = True
    least_deviation: float = 0.02
    fewest: int = 2

    def locate(self, local):
        return self


@pytest.mark.parametrize(("speed", "calls"), [(0.0, [0, 10, 20]), (2.5, [0, 4, 8, 12, 16, 20])])
def test_matching_is_tried_after_some_metres_or_seconds(speed, calls):
    one = drive(3, ACCURATE, reach=18.0)
    tried = []
    locator = Wrong(np.zeros(3), np.eye(3), is_sure=False)
    unit = unit_for(one.map, locator)
    state = unit.start()
    for k in range(24):
        before = state.tried_at[1]
        _, state = unit.step(state, one.scans[0], X_OH=[speed * PERIOD * k, 0.0, 0.0], time=PERIOD * k)
        if state.tried_at[1] != before:
            tried.append(k)
    assert tried == calls


def test_too_few_landmarks_use_no_attempt_up():
    one = drive(3, ACCURATE, reach=18.0)
    few = one.scans[0].select(range(5))
    answers, state = run(unit_on(3), [few, *one.scans[1:4]], one.reckoned[:4])
    assert answers[0].status == SEARCHING and state.answer.status == TRACKING


@pytest.mark.slow_cases
@pytest.mark.parametrize("errors", [ACCURATE, REMOTE])
def test_a_wrong_first_pose_is_soon_lost(errors):
    for seed in range(2):
        one = drive(seed, errors)
        wrong = Wrong(compose(one.poses[0], [9.0, -7.0, 1.0]), np.diag([0.2, 0.2, 0.02]) ** 2)
        unit = unit_for(one.map, wrong)
        answers, _ = run(unit, one.scans, one.reckoned)
        tracking = [answer.status == TRACKING for answer in answers]
        # It may be claimed again, by this locator.
        longest = max(len(part) for part in "".join("x" if t else " " for t in tracking).split(" "))
        assert longest <= 12


def test_narrow_views_begin_with_all_gathered_landmarks():
    """Each scan shows three landmarks, fewer than a track begins with."""
    one = drive(3, ACCURATE, reach=18.0)
    narrow = [scan.select(np.arange(3 * k, 3 * k + 3) % len(scan)) for k, scan in enumerate(one.scans)]
    unit = unit_on(3)
    assert {answer.status for answer in run(unit, narrow, one.reckoned)[0]} == {SEARCHING}
    answers, _ = run(replace(unit, begins_with_submap=True), narrow, one.reckoned)
    assert answers[-1].status == TRACKING
    assert np.linalg.norm(error(answers[-1].pose, one.poses[-1])[:2]) < 0.3


def test_bad_times_and_poses_are_ignored_and_counted():
    one = drive(3, ACCURATE, reach=18.0)
    unit = unit_on(3)
    answers, state = run(unit, one.scans[:15], one.reckoned[:15])
    bad = [
        ([np.nan, 0.0, 0.0], 9.0),
        ([1e200, 0.0, 0.0], 9.0),
        (one.reckoned[15], 15 * PERIOD - 2.0),
        (one.reckoned[15], answers[-1].time),
        (one.reckoned[15], np.nan),
    ]
    for count, (X_OH, time) in enumerate(bad, start=1):
        answer, state = unit.step(state, one.scans[15], X_OH=X_OH, time=time)
        assert answer is answers[-1] and state.ignored == count
    rest, state = run(unit, one.scans[15:], one.reckoned[15:], state, first=15)
    assert rest[-1].status == TRACKING and state.ignored == len(bad)
    with pytest.raises(ValueError, match="planar pose"):
        unit.step(state, one.scans[0], X_OH=np.zeros(6), time=100.0)


def test_impossible_settings_are_refused():
    unit = unit_on(3)
    for settings, message in (
        ({"submap_length": 0.0}, "submap_length must be a finite number above 0 m, not 0.0"),
        ({"try_every": (2.0, -1.0)}, r"try_every\[1\] must be a number of at least 0 m, s, not -1"),
        ({"try_every": (2.0, np.nan)}, r"try_every\[1\] must be a number of at least 0 m, s, not nan"),
    ):
        with pytest.raises(ValueError, match=message):
            replace(unit, **settings)


def test_no_trees_in_sight_is_no_error():
    one = drive(3, ACCURATE, reach=18.0)
    unit = unit_on(3)
    answers, _ = run(unit, [Landmarks.empty()] * 5, one.reckoned[:5])
    assert {answer.status for answer in answers} == {SEARCHING}
    scans = [*one.scans[:12], *[Landmarks.empty()] * 8, *one.scans[20:]]
    answers, _ = run(unit, scans, one.reckoned)
    deviations = [answer.covariance[0, 0] for answer in answers[11:20]]
    assert (np.diff(deviations) > 0.0).all() and answers[20].covariance[0, 0] < deviations[-1]
    assert answers[-1].status == TRACKING


def test_scale_of_the_wheels_is_estimated_and_in_the_covariance():
    one = drive(3, ACCURATE, reach=18.0, scans=60)
    motions = [compose(inverse(a), b) for a, b in pairwise(one.poses)]
    reckoned = [np.zeros(3)]
    for motion in motions:
        reckoned.append(compose(reckoned[-1], motion * [1.03, 1.03, 1.0]))
    scans = [*one.scans[:10], *[Landmarks.empty()] * 50]
    answers, state = run(unit_for(one.map), scans, reckoned)
    assert answers[-1].status == TRACKING and not answers[-1].matched
    # Ten scans correct about a third of the scale error, which is 3 % of 20 m.
    assert 0.3 < np.linalg.norm(error(answers[-1].pose, one.poses[-1])[:2]) < 0.5
    assert nees(answers[-1].pose, answers[-1].covariance, one.poses[-1]) < 9.0
    # After a long time without detections, the track is lost.
    assert unit_for(one.map).step(state, scans[-1], X_OH=reckoned[-1], time=1e3)[0].status == LOST


def test_errors_of_the_map_that_a_lost_track_has_shown_are_kept():
    one, unit = drive(3, ACCURATE, reach=18.0), unit_on(3)
    _, state = run(unit, one.scans, one.reckoned)
    assert state.track.scatter < 1.2
    shown = ShownErrors(excess=500.0, freedom=60.0)
    state = replace(state, track=replace(state.track, gone=shown))
    later = 1_000_000
    answer, state = unit.step(state, Landmarks.empty(), X_OH=one.reckoned[-1], time=PERIOD * later)
    assert answer.status == LOST
    answers, state = run(unit, one.scans, one.reckoned, state, first=later + 1)
    assert answers[-1].status == TRACKING and state.track.gone is shown
    # 512 / 72 = 7.1 counts as much as 12 degrees of freedom that seem right.
    assert 1.2 < state.track.scatter < 7.1


def test_the_memory_survives_as_arrays():
    one = drive(3, ACCURATE, reach=18.0)
    unit = unit_on(3)
    straight, _ = run(unit, one.scans, one.reckoned)
    state, names = unit.start(), set(UNIT_STATE_CODEC.encode(unit.start()))
    for k, scan in enumerate(one.scans):
        arrays = UNIT_STATE_CODEC.encode(state)
        # A slow part wants the same arrays each time.
        assert set(arrays) == names
        answer, state = unit.step(UNIT_STATE_CODEC.decode(arrays), scan, X_OH=one.reckoned[k], time=PERIOD * k)
        np.testing.assert_array_equal(answer.pose, straight[k].pose)
        np.testing.assert_array_equal(answer.covariance, straight[k].covariance)


def test_answers_cannot_be_changed():
    one = drive(3, ACCURATE)
    answer, _ = unit_for(one.map).step(unit_for(one.map).start(), one.scans[0], X_OH=one.reckoned[0], time=0.0)
    for array in (answer.X_OH, answer.pose, answer.covariance):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1.0
