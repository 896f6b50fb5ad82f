"""Drives through simulated stands, for tests of tracking and of the localization unit."""

from dataclasses import dataclass
from functools import cache

import numpy as np

from vtbdrake.components.localization.dead_reckoning import DriftModel
from vtbdrake.components.localization.landmarks import Landmarks, map_landmarks
from vtbdrake.components.localization.planar import compose, inverse, wrap
from vtbdrake_diagrams.forest.studies.detections import Detector, Odometry, Wood, arc, dead_reckoned
from vtbdrake_diagrams.forest.world.stand import MapErrors, Stand

PERIOD = 0.2
SIZE = 60.0
DRIFT = DriftModel()
ODOMETRY = Odometry(scale=0.005)


@dataclass
class Drive:
    """A drive along an arc: true poses, odometry, what is detected, and the map."""

    poses: np.ndarray
    reckoned: np.ndarray
    scans: list[Landmarks]
    map: Landmarks

    def motion(self, k):
        """Return the motion that ends at scan k, and its covariance."""
        motion = compose(inverse(self.reckoned[k - 1]), self.reckoned[k])
        return motion, DRIFT.covariance(motion, PERIOD)


@cache
def drive(
    seed,
    errors: MapErrors,
    *,
    scans=30,
    step=0.4,
    density=800.0,
    false=0.3,
    bias=0.0,
    reach=13.0,
    elsewhere=None,
    start=None,
    odometry=ODOMETRY,
) -> Drive:
    """Simulate a drive; with ``elsewhere``, the map shows the stand with that seed."""
    rng = np.random.default_rng([seed, 11])
    stand = Stand(seed=seed, density=density, length=SIZE, width=SIZE)
    mapped = stand if elsewhere is None else Stand(seed=elsewhere, density=density, length=SIZE, width=SIZE)
    wood = Wood.of(stand, false=false, rng=rng)
    first = [*(start or rng.uniform(25.0, 35.0, 2)), rng.uniform(-3.0, 3.0)]
    poses = arc(first, length=step * (scans - 1), curvature=rng.uniform(-0.05, 0.05), step=step)
    reckoned = dead_reckoned(poses, odometry, rng)
    detector = Detector(reach=reach, false=false, range_bias=bias)
    seen = [wood.detected(pose, detector, rng)[0] for pose in poses]
    return Drive(poses, reckoned, seen, map_landmarks(mapped.map(errors)))


def error(pose, X_WH):
    return np.array([*(pose[:2] - X_WH[:2]), wrap(pose[2] - X_WH[2])])


def nees(pose, covariance, X_WH):
    e = error(pose, X_WH)
    return float(e @ np.linalg.solve(covariance, e))
