"""A car that localizes itself in a park: simulated, and on recordings of a real one."""

from dataclasses import replace
from itertools import combinations, pairwise

import numpy as np
import pytest

from tests.real import recordings
from vtbdrake.components.localization.dead_reckoning import SteeringDriftModel
from vtbdrake.components.localization.landmarks import Landmarks
from vtbdrake.components.localization.planar import compose, inverse, rotation, transform
from vtbdrake.components.localization.range_bearing import RangeBearingConfig, range_bearing_landmarks
from vtbdrake.components.localization.unit import TRACKING
from vtbdrake.recording import Log, Series
from vtbdrake_diagrams.park import ParkScenario
from vtbdrake_diagrams.park.few_landmarks import (
    Case,
    Claims,
    as_published,
    claims,
    judging,
    stray_density,
    tabulated,
    thinned,
    turn_errors,
)
from vtbdrake_diagrams.park.reality import (
    Drive,
    judged_by_positions,
    laid_onto,
    localized,
    prepared,
    reckoned,
    slide,
    victoria_park,
)
from vtbdrake_diagrams.park.scenario import PERIOD, ROWS
from vtbdrake_diagrams.park.survey import Survey, SurveyConfig, survey

pytestmark = pytest.mark.one_python


@pytest.mark.slow
def test_simulated_car_finds_itself_and_says_how_well():
    testbed = ParkScenario(seed=1).build()
    context = testbed.default_context()
    simulator = testbed.simulator(context)
    position = np.zeros(2)
    squares = []
    for k in range(1, 13):
        simulator.AdvanceTo(k - PERIOD)
        position = np.array(testbed.read(context, "sim.sys.car.position"))
        simulator.AdvanceTo(k)
        if k < 3:
            continue
        # What is shown holds for the last update of the DPS, one period ago.
        assert testbed.read(context, "dps.env.pose.status") == TRACKING
        error = testbed.read(context, "dps.env.pose.position") - position
        C = np.reshape(testbed.read(context, "dps.env.pose.covariance"), (3, 3))[:2, :2]
        squares.append(error @ np.linalg.solve(C, error))
        claim = testbed.read(context, "sim.act.display.discrete_state_0")
        np.testing.assert_allclose(claim[:2], position, atol=0.3)
        assert claim[3] < 0.2
    # 2 are expected with a clock like the real car's; here, all scans are dated exactly.
    assert np.mean(squares) < 3.0


def test_survey_finds_trees_and_poses_from_positions_and_detections():
    """A simulated drive of two rounds with drifting odometry and positions that err by half a metre."""
    rng, n = np.random.default_rng(0), 240
    places = rng.uniform(-35.0, 35.0, (60, 2))
    angles = np.linspace(0.0, 4.0 * np.pi, n)
    poses = np.column_stack([20.0 * np.cos(angles), 20.0 * np.sin(angles), angles + 0.5 * np.pi])
    motions = [compose(inverse(a), b) for a, b in pairwise(poses)]
    reckoned_poses = [np.zeros(3)]
    for motion in motions:
        drift = [0.02 * rng.normal(), 0.0, 0.004 + 0.004 * rng.normal()]
        reckoned_poses.append(compose(reckoned_poses[-1], motion + np.array(drift)))
    odometry = np.array(reckoned_poses)
    odometry[:, 2] = np.unwrap(odometry[:, 2])
    scans = []
    for pose in poses:
        seen = transform(inverse(pose), places)
        rows = np.flatnonzero((np.hypot(*seen.T) < 25.0) & (seen[:, 0] > 0.0))
        noise = 0.05 * rng.normal(size=(len(rows), 2))
        C = np.tile(0.05**2 * np.eye(2), (len(rows), 1, 1))
        scans.append(Landmarks(seen[rows] + noise, C, np.full(len(rows), 0.3), np.full(len(rows), 0.05)))
    times = 0.5 * np.arange(n)
    positions = np.column_stack([times, poses[:, :2] + 0.5 * rng.normal(size=(n, 2))])[1:]
    result = survey(
        times, odometry, scans, positions, drift=SteeringDriftModel(), config=SurveyConfig(memory=0.4, deviation=0.5)
    )
    gaps = np.linalg.norm(result.trees.positions[:, None] - places, axis=2)
    assert len(result.trees) >= 50 and gaps.min(axis=1).max() < 0.3
    error = result.trees.positions - places[gaps.argmin(axis=1)]
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(result.trees.covariances), error).mean()
    assert 0.3 < nees < 5.0  # 2 are expected; the error of the whole map is one sample.
    assert np.hypot(*(result.poses[:, :2] - poses[:, :2]).T).max() < 0.4
    assert result.correlation > 20.0


def test_points_are_laid_onto_others_by_a_rigid_motion():
    X, points = np.array([3.0, -2.0, 2.5]), np.random.default_rng(0).normal(size=(20, 2))
    np.testing.assert_allclose(laid_onto(points, transform(X, points)), X)


def test_turned_scanner_makes_the_car_slide():
    """A survey with a scanner that is turned by 0.02 rad to the right, and an origin 0.1 m ahead of the axle."""
    rng, n, turned, ahead = np.random.default_rng(0), 200, 0.02, np.array([0.1, 0.0, 0.0])
    headings = np.cumsum(0.05 * np.sin(0.1 * np.arange(n)))
    places = np.cumsum(0.4 * np.column_stack([np.cos(headings), np.sin(headings)]), axis=0)
    axle = np.column_stack([places, headings])
    seen = np.array([compose(pose, ahead) for pose in axle]) - [0.0, 0.0, turned] + 0.005 * rng.normal(size=(n, 3))
    nothing = Landmarks.empty()
    assert slide(Survey(np.arange(n), seen, nothing, 0.0), axle) == pytest.approx(turned, abs=0.002)
    seen[100:] += [1.0, -1.0, 0.0]  # A jump is left out.
    assert slide(Survey(np.arange(n), seen, nothing, 0.0), axle) == pytest.approx(turned, abs=0.002)


@pytest.fixture(scope="module")
def drive():
    return victoria_park(recordings("victoria_park/inputs.dat")[0].parent)


@pytest.fixture(scope="module")
def half(drive):
    return prepared(drive.between(0.0, 200.0))


@pytest.mark.slow
def test_part_of_the_real_drive_is_localized_and_replayed(tmp_path, drive, half):
    """The end of the drive is where it began. The whole: python -m vtbdrake_diagrams.park.reality."""
    # The second half of the drive shows the same: see docs/reality_drives.md.
    assert np.degrees(half.scenario.detector.heading) == pytest.approx(-1.05, abs=0.15)
    end = drive.between(1477.0, 1500.0)
    found, report = localized(end, half.with_map(tmp_path), tmp_path / "drive.lcm")
    assert report.identical
    assert found.has_pose.mean() > 0.8
    judgement = judged_by_positions(found, end.steady_positions, half.antenna, noise=half.noise)
    assert judgement.rms < 2.5 and judgement.wrong == 0 and judgement.count > 20
    nowhere, _ = localized(end, half.with_map(tmp_path, mirrored=True), tmp_path / "mirrored.lcm")
    assert not nowhere.has_pose.any()


@pytest.mark.slow
def test_errors_of_real_detections_last_while_the_car_moves_on(drive, half):
    """A third of their variance along the ray, for some 8 m; more, as the trees are fitted to the same detections."""
    detected = drive.between(0.0, 200.0).log.sense["trees"]
    ways = np.cumsum([0.0, *np.hypot(*np.diff(half.mapped.poses[:, :2], axis=0).T)])
    errors: dict[int, list] = {}
    for way, pose, row in zip(ways, half.mapped.poses, detected.values, strict=True):
        scan = range_bearing_landmarks(row, half.scenario.detector)
        for place, seen in zip(transform(pose, scan.positions), scan.positions, strict=True):
            gaps = half.mapped.trees.positions - place
            k = int(np.argmin(np.hypot(*gaps.T)))
            ray = seen - [half.scenario.detector.x, half.scenario.detector.y]
            along = -gaps[k] @ rotation(pose[2]) @ ray / np.hypot(*ray)
            if np.hypot(*gaps[k]) < 0.4:
                errors.setdefault(k, []).append((way, along))

    def correlation(least, most):
        products = [
            (a * b, 0.5 * (a * a + b * b))
            for seen in errors.values()
            for (way, a), (later, b) in combinations(seen, 2)
            if least < later - way <= most
        ]
        assert len(products) > 1000
        return np.divide(*np.sum(products, axis=0))

    near, farther, far = correlation(0.2, 1.0), correlation(6.0, 10.0), correlation(20.0, 40.0)
    assert 0.3 < near < 0.5 and 0.2 * near < farther < 0.5 * near and abs(far) < 0.1


@pytest.mark.slow
def test_density_of_real_detections_beside_trees(drive, half):
    """The density is about what `ParkScenario` assumes; few_landmarks prints the one of the whole first half."""
    assert 0.005 < stray_density(drive.between(0.0, 200.0), half.mapped, half.scenario.detector) < 0.015


def test_density_of_simulated_detections_beside_a_tree():
    """One of ten lies between 0.4 and 1 m beside it: one ninth on 2.6 m^2."""
    rows = np.zeros((10, 3 * ROWS))
    rows[:, :3] = [10.0, 0.0, 0.3]
    rows[9, 0] = 10.7
    log = Log("one tree", {"trees": Series(np.arange(10.0), rows)}, {})
    tree = Landmarks(np.array([[10.0, 0.0]]), np.zeros((1, 2, 2)), np.array([0.3]), np.zeros(1))
    mapped = Survey(np.arange(10.0), np.zeros((10, 3)), tree, 0.0)
    density = stray_density(Drive(log, np.zeros((0, 3))), mapped, RangeBearingConfig())
    assert density == pytest.approx(1.0 / 9.0 / (np.pi * (1.0 - 0.16)))


@pytest.mark.slow
def test_real_steering_errs_in_turns_as_assumed(drive, half):
    """The shares are about what `ParkScenario` assumes; few_landmarks prints the whole first half's."""
    odometry = drive.between(0.0, 200.0).log.sense["odometry"]
    for scenario in (half.scenario, as_published(half.scenario)):
        errors = turn_errors(half.mapped, reckoned(odometry, scenario.car, half.mapped.times))
        assert len(errors) > 10
        assert 0.6 < np.sqrt(np.mean(errors**2)) / scenario.steering_deviation < 1.4


def test_turns_of_a_simulated_steering_with_a_wrong_scale():
    """Every 30 s, the car turns by 1 rad in 3 s, and 15 s later by half a rad, which does not count."""
    rates = np.zeros(1000)
    for first in range(0, 1000, 150):
        rates[first : first + 15], rates[first + 75 : first + 90] = 1.0 / 15.0, -0.5 / 15.0

    def path(turns):
        poses = [np.zeros(3)]
        for turn in turns:
            poses.append(compose(poses[-1], [0.2, 0.0, turn]))
        return np.array(poses)

    wheels = path(1.1 * rates)
    wheels[:, 2] = np.unwrap(wheels[:, 2])
    errors = turn_errors(Survey(0.2 * np.arange(1001), path(rates), Landmarks.empty(), 0.0), wheels)
    assert len(errors) == 7
    np.testing.assert_allclose(errors, 1.0 - 1.0 / 1.1, atol=1e-9)


@pytest.mark.slow
def test_published_steering_is_believed_less_than_a_calibrated_one(half):
    published = as_published(half.scenario)
    assert published.car == ParkScenario().car != half.scenario.car
    assert published.steering_deviation > half.scenario.steering_deviation > 0.0


@pytest.mark.slow
def test_few_trees_are_enough_on_a_part_of_the_real_drive(drive, half):
    """With two landmarks in a scan. The whole: python -m vtbdrake_diagrams.park.few_landmarks."""
    begin = drive.between(0.0, 195.0)  # Few scans tie the end of the survey down.
    _, scans = thinned(begin, half.mapped, half.scenario, seed=0, trees=30)
    assert np.median([len(scan) for scan in scans]) == 2.0
    told = claims(begin, half.mapped, half.scenario, Case(), seed=0, trees=30)
    assert told.available > 0.5 and told.wrong == 0 and told.within(0.5) < 0.2
    nowhere = claims(begin, half.mapped, half.scenario, Case(is_mirrored=True), seed=0, trees=30)
    assert nowhere.available == 0.0


def straight_drive(*jumps):
    """Return a survey of a drive at 4 m/s for 200 s that jumps to the left, at (time, distance), and the wheels."""
    times = 0.2 * np.arange(1000)
    wheels = np.column_stack([0.8 * np.arange(1000), np.zeros((1000, 2))])
    aside = sum(distance * (times > time) for time, distance in jumps)
    poses = wheels + np.column_stack([np.zeros(1000), aside * np.ones(1000), np.zeros(1000)])
    return Survey(
        times, poses + 0.01 * np.random.default_rng(0).normal(size=poses.shape), Landmarks.empty(), 0.0
    ), wheels


@pytest.mark.parametrize(
    ("jumps", "silent"),
    [
        ([(0.0, 0.0)], []),
        ([(50.0, 1.0)], [(49.0, 60.9)]),  # Over a second, and for ten.
        ([(50.0, 1.0), (90.0, -1.0)], [(49.0, 100.9)]),  # It has come back.
        ([(50.0, 1.0), (130.0, -1.0)], [(49.0, 60.9), (129.0, 140.9)]),
        ([(50.0, 0.1)], []),  # As the wheels allow.
    ],
)
def test_survey_that_jumps_against_the_wheels_does_not_judge(jumps, silent):
    whole, wheels = straight_drive(*jumps)
    is_silent = np.zeros(len(whole.times), dtype=bool)
    for start, end in silent:
        is_silent |= (whole.times > start) & (whole.times < end)
    np.testing.assert_allclose((~judging(whole, wheels)).sum(), is_silent.sum(), atol=3)
    assert not judging(whole, wheels)[is_silent].any()


def test_wrong_claims_are_counted_with_and_without_the_judge():
    is_judged = np.array([True, True, True, False, True])
    claimed = Claims(np.array([0.1, 0.6, 0.7, 2.0, np.nan]), np.array([0.1, 0.3, 0.1, 0.1, np.inf]), is_judged)
    assert (claimed.wrong, claimed.is_off.sum(), claimed.judged, claimed.available) == (1, 2, 3, 0.8)
    row = tabulated({Case(): [claimed, claimed]}).splitlines()[-1]
    assert "80, 80 %" in row and "1, 1" in row and "2, 2" in row and "3, 3" in row


def test_steering_and_wheels_alone_follow_the_real_path(drive):
    """The odometry in the second half, calibrated in the first: over 25 s it keeps to the positions within a metre."""
    car = replace(ParkScenario().car, steering_scale=1.0445, steering_offset=0.0044)
    distances = []
    for start in np.arange(775.0, 1500.0, 25.0):
        rows = drive.positions[abs(drive.positions[:, 0] - start - 12.5) < 12.5]
        if len(rows) < 30:
            continue
        poses = reckoned(drive.log.sense["odometry"], car, rows[:, 0])
        path = transform(laid_onto(poses[:, :2], rows[:, 1:]), poses[:, :2])
        distances.extend(np.hypot(*(path - rows[:, 1:]).T))
    assert len(distances) > 1000 and np.median(distances) < 1.0
