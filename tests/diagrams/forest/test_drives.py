"""Tests of the scores of drives, with errors that are drawn from the covariances that are claimed."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from vtbdrake.components.localization.landmarks import Landmarks, map_landmarks
from vtbdrake.components.localization.planar import inverse
from vtbdrake.components.localization.unit import LOST, SEARCHING, TRACKING
from vtbdrake_diagrams.forest.scenario import CarrierScenario, ForestScenario
from vtbdrake_diagrams.forest.studies.drive import STANDING, Drive, Track, localize, recorded_drive, simulated_drive
from vtbdrake_diagrams.forest.studies.drives import GOALS, SOURCES, Drives, forest, main, nees_bounds, plain, score
from vtbdrake_diagrams.forest.world.stand import Stand
from vtbdrake_diagrams.plain.scenario import PlainScenario

pytestmark = pytest.mark.one_python

COVARIANCE = np.array([[4e-4, 1e-4, 0.0], [1e-4, 9e-4, 0.0], [0.0, 0.0, 1e-6]])


def track(seed: int, *, factor: float = 1.0, searching: int = 10, lost: slice = slice(0, 0)) -> Track:
    """Return a track along 50 m at 1 m/s, whose errors are ``factor`` times as large as its covariances say."""
    n = 251
    truth = np.column_stack([np.linspace(0.0, 50.0, n), np.full(n, 7.0), np.full(n, np.pi - 1e-4)])
    errors = factor * np.random.default_rng(seed).multivariate_normal(np.zeros(3), COVARIANCE, n)
    status = np.full(n, TRACKING)
    status[:searching] = SEARCHING
    status[lost] = LOST
    poses = np.where((status == TRACKING)[:, np.newaxis], truth + errors, np.nan)
    poses[:, 2] -= np.where(poses[:, 2] > np.pi, 2.0 * np.pi, 0.0)
    drive = Drive(np.arange(n) / 5.0, truth, truth, (Landmarks.empty(),) * n)
    return Track(drive, poses, np.tile(COVARIANCE, (n, 1, 1)), status)


def test_errors_are_those_that_were_drawn() -> None:
    found = score([track(seed) for seed in range(20)], deviation=0.1)
    assert found.forests == 20 and found.path == pytest.approx(1000.0)
    assert found.position == pytest.approx(np.sqrt(13e-4), rel=0.03)
    assert found.heading == pytest.approx(1e-3, rel=0.03)
    assert found.nees == pytest.approx(3.0, rel=0.05)
    assert found.is_consistent and not found.wrong
    assert GOALS["accurate"].is_met(found)


def test_covariances_that_are_too_small_show() -> None:
    found = score([track(seed, factor=1.4) for seed in range(20)], deviation=0.1)
    assert found.independent_nees > found.bounds[1]
    assert not found.is_consistent and not GOALS["accurate"].is_met(found)


def test_search_and_loss_are_counted() -> None:
    one = track(0, lost=slice(100, 120))
    found = score([one, track(1, searching=30)], deviation=0.1)
    assert one.first_fix == (pytest.approx(2.0), pytest.approx(2.0))
    assert found.first_fix == (pytest.approx(4.0), pytest.approx(6.0))
    assert found.losses == 1
    assert found.localized == pytest.approx((251 - 30 + 251 - 30) / 502)


def test_wrong_claim_is_counted() -> None:
    one = track(0)
    one.poses[50] += [1.0, 0.0, 0.0]
    assert score([one], deviation=0.1).wrong == 1
    assert score([one], deviation=0.35).wrong == 0


def test_independent_poses_are_apart() -> None:
    one = track(0)
    drive = replace(one.drive, truth=one.drive.truth * [5.0, 1.0, 1.0])
    places = drive.truth[one.is_localized][replace(one, drive=drive).independent, 0]
    assert places[-1] == 250.0
    assert np.diff(places).min() >= 99.0
    assert len(places) == 3
    assert one.independent.sum() == 1


def test_bounds_hold_for_95_percent_of_means() -> None:
    means = (np.random.default_rng(0).normal(size=(4000, 60, 3)) ** 2).sum(axis=2).mean(axis=1)
    low, high = nees_bounds(60)
    assert np.mean((means >= low) & (means <= high)) == pytest.approx(0.95, abs=0.01)


def test_simulated_drive_stays_in_the_stand() -> None:
    drive = simulated_drive(Stand(seed=1, density=300.0), seed=1, length=20.0)
    assert drive.travelled[-1] == pytest.approx(20.0, rel=1e-3)
    assert (drive.truth[:, :2] > 0.0).all() and (drive.truth[:, :2] < 100.0).all()
    assert len(drive.landmarks) == len(drive.times) == 101
    assert np.diff(drive.times) == pytest.approx(0.2)


BOTH = ForestScenario(seed=1, perception="both", length=60.0, width=60.0, start=12.0)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scenario", "kinds"),
    [
        (ForestScenario(seed=5, density=500.0, undergrowth=0.0), [[True]] * 6),
        (BOTH, [[True], [True], [False], [True], [True], [True, False]]),
    ],
)
def test_recorded_drive_gives_what_the_dps_itself_finds(scenario: ForestScenario, kinds: list[list[bool]]) -> None:
    drive = recorded_drive(scenario, length=1.5)
    assert [[view.is_scan for view in views] for views in drive.landmarks][:6] == kinds
    found = localize(drive, scenario.unit(scenario.global_map()))
    testbed = scenario.build()
    simulator = testbed.simulator()
    context = simulator.get_mutable_context()
    # The driver begins at the first scan after standing.
    testbed.write(context, {"sim.act.driver.speed": 0.0})
    simulator.AdvanceTo(STANDING + 0.2)
    testbed.write(context, {"sim.act.driver.speed": scenario.speed})
    # The result of the last scan is shown some periods later, and before the result of the next.
    simulator.AdvanceTo(drive.times[-1] + scenario.localizer_latency + 0.08)
    pose = testbed.read(context, "dps.env.localizer.pose")
    assert testbed.read(context, "dps.env.localizer.status") == TRACKING
    assert testbed.read(context, "dps.env.localizer.time") == pytest.approx(drive.times[-1])
    assert found.is_localized[-1] and drive.travelled[-1] == pytest.approx(1.5, abs=0.3)
    np.testing.assert_allclose(pose, found.poses[-1], atol=1e-9)
    np.testing.assert_allclose(pose, drive.truth[-1], atol=0.2)


@pytest.mark.slow
def test_recorded_cameras_see_trees_where_they_are() -> None:
    scenario = ForestScenario(seed=1, perception="stereo", length=60.0, width=60.0, start=12.0)
    drive = recorded_drive(scenario, length=0.2)
    assert np.diff(drive.times) == pytest.approx(1.0 / scenario.stereo.fps)
    squares = []
    for pose, [view] in zip(drive.truth, drive.landmarks, strict=True):
        landmarks = view.landmarks
        trees = map_landmarks(scenario.truth()).seen_from(inverse(pose)).positions
        errors = landmarks.positions[:, np.newaxis] - trees
        inverses = np.linalg.inv(landmarks.covariances)
        squares += np.einsum("nti,nij,ntj->nt", errors, inverses, errors).min(axis=1).tolist()
    # The trees are 13 to 18 m away. 99 % of the squares of normal errors in two dimensions are below 9.2, half below
    # 1.4.
    assert len(squares) >= 20
    assert np.mean(np.array(squares) < 9.2) > 0.8
    assert np.median(squares) < 2.0


@pytest.mark.parametrize("world", [forest, plain])
def test_worlds_differ_and_are_reproducible(world: Callable[..., CarrierScenario]) -> None:
    one = world(1)
    assert one == world(1) and one != world(2)
    # Nor do two drives share the noise of a sensor: their errors are independent.
    for name in ("scanner_errors", "imu_errors", "odometry_errors"):
        assert getattr(one, name).seed != getattr(world(2), name).seed
    assert world(1, range_bias=0.02) == replace(one, scanner_errors=replace(one.scanner_errors, bias=0.02))


def test_forests_are_of_both_kinds() -> None:
    assert {forest(seed).stand_kind for seed in range(3)} == {"natural", "clustered"}
    assert forest(1).stereo.seed != forest(2).stereo.seed


@pytest.mark.parametrize(("arguments", "source"), [([], "scanner"), *(([f"--{name}"], name) for name in SOURCES)])
def test_option_names_the_source(arguments: list[str], source: str) -> None:
    assert main.make_context("drives", arguments).params["source"] == source


@pytest.mark.parametrize("source", SOURCES)
def test_source_selects_the_world(source: str) -> None:
    scenario = Drives(source=source, range_bias=0.01).scenario(4)
    assert isinstance(scenario, PlainScenario if source == "plain" else ForestScenario)
    assert getattr(scenario, "perception", "scanner") == ("stereo" if source == "stereo" else "scanner")
    assert scenario.scanner_errors.bias == 0.01
