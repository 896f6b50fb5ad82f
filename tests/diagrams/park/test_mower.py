"""Dead reckoning of a real lawn mower against positions by RTK."""

import numpy as np
import pytest

from tests.real import recordings
from vtbdrake.components.estimation import squared_distances
from vtbdrake.components.localization.dead_reckoning import DriftModel
from vtbdrake.components.localization.planar import compose
from vtbdrake_diagrams.park.mower import RAW, Calibrated, Mowing, Windows, calibrated

pytestmark = pytest.mark.one_python


def simulated(odometry: Calibrated, *, slip: float, seed: int) -> Mowing:
    """Return a drive of 400 s at 1 m/s in curves, whose wheels slip at random, seen by an antenna."""
    rng, period, n = np.random.default_rng(seed), 0.2, 2000
    times = period * np.arange(n + 1)
    turns = 0.1 * np.sin(0.05 * times[:-1]) * period
    ways = np.full(n, period)
    poses = [np.zeros(3)]
    for way, turn, noise in zip(ways, turns, slip * np.sqrt(period) * rng.normal(size=n), strict=True):
        moved = odometry.scale * way + noise
        poses.append(compose(poses[-1], [moved * np.cos(0.5 * turn), moved * np.sin(0.5 * turn), turn]))
    x, y, heading = np.array(poses).T
    ahead, left = odometry.antenna
    c, s = np.cos(heading), np.sin(heading)
    positions = np.stack([x + c * ahead - s * left, y + s * ahead + c * left], axis=1)
    return Mowing(times, positions, heading - odometry.offset, ways, turns)


def test_odometry_and_its_drift_are_those_that_made_the_drive() -> None:
    truth = Calibrated(1.03, 0.02, (0.5, -0.2))
    drive = simulated(truth, slip=0.03, seed=1)
    estimate = calibrated(drive)
    assert estimate.scale == pytest.approx(1.03, abs=0.01)
    assert estimate.offset == pytest.approx(0.02, abs=0.01)
    assert estimate.antenna[0] == pytest.approx(0.5, abs=0.3)
    # With random slip along the path, the errors are as large as its model says.
    windows = Windows.of(drive, truth, 10.0)
    model = DriftModel(along=0.03, across=1e-4, heading=0.0, turn=0.0)
    along = windows.errors[:, 0] ** 2 / windows.covariances(model, start=0.0)[:, 0, 0]
    assert along.mean() == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / len(along)))


@pytest.mark.slow
def test_calibrated_with_one_half_it_is_better_in_the_other() -> None:
    drive = Mowing.read(recordings("plaza/Plaza1_.mat")[0])
    turns, ways = drive.likeness
    assert turns > 1.0 - 1e-9 and ways < 0.9995
    middle = len(drive.times) // 2
    odometry = calibrated(drive.part(0, middle))
    second = drive.part(middle, len(drive.times))
    raw, windows = Windows.of(second, RAW, 10.0), Windows.of(second, odometry, 10.0)
    median = np.median(np.hypot(*windows.errors.T))
    assert median < 0.08 < 0.15 < np.median(np.hypot(*raw.errors.T))
    assert np.mean(squared_distances(windows.errors, windows.covariances(DriftModel(), start=0.0)) < 5.99) > 0.9
