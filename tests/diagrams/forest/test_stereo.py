"""The localization unit that sees the forest with a pair of cameras."""

from __future__ import annotations

import numpy as np
import pytest
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context

from vtbdrake.components.localization.landmarks import Landmarks, map_landmarks
from vtbdrake.components.localization.planar import inverse, wrap
from vtbdrake.components.localization.unit import TRACKING
from vtbdrake.testbed import ScenarioError, VirtualTestbed
from vtbdrake_diagrams.forest.perception import SHOWN, LandmarkSensor, Localizer
from vtbdrake_diagrams.forest.scenario import ForestScenario
from vtbdrake_diagrams.forest.stereo import IMAGES, StereoConfig
from vtbdrake_diagrams.forest.studies.stereo_trials import errors

SCENARIO = ForestScenario(seed=1, perception="stereo", length=60.0, width=60.0, start=12.0)


@pytest.fixture(scope="module")
def driven() -> tuple[VirtualTestbed, Context]:
    """The testbed after a drive of some metres."""
    testbed = SCENARIO.build()
    context = testbed.default_context()
    testbed.simulator(context).AdvanceTo(8.0)
    return testbed, context


@pytest.mark.slow
def test_carrier_localizes_itself_by_images(driven: tuple[VirtualTestbed, Context]) -> None:
    testbed, context = driven
    assert testbed.read(context, "dps.env.pose.status") == TRACKING
    x, y, _, *_, yaw = testbed.read(context, "sim.sys.carrier.base.pose")
    error = testbed.read(context, "dps.env.pose.position") - [x, y]
    covariance = testbed.read(context, "dps.env.pose.covariance")[:2, :2]
    assert np.linalg.norm(error) < 0.3
    assert error @ np.linalg.solve(covariance, error) < 14.0
    assert abs(wrap(float(testbed.read(context, "dps.env.pose.heading")) - yaw)) < np.radians(1.5)


@pytest.mark.slow
def test_landmarks_stand_where_trees_are(driven: tuple[VirtualTestbed, Context]) -> None:
    testbed, context = driven
    rows = testbed.read(context, "dps.env.localizer.landmarks").reshape(SHOWN, 3)
    shown = rows[np.isfinite(rows[:, 0])]
    found = Landmarks(shown[:, :2], np.tile(np.eye(2), (len(shown), 1, 1)), shown[:, 2], shown[:, 2])
    # Positions in the world, by the odometry since the images were taken.
    x, y, _, *_, yaw = testbed.read(context, "sim.sys.carrier.base.pose")
    since = float(context.get_time() - testbed.read(context, "dps.env.localizer.time"))
    X_WH = np.array([x - SCENARIO.speed * since * np.cos(yaw), y - SCENARIO.speed * since * np.sin(yaw), yaw])
    trees = map_landmarks(SCENARIO.truth()).seen_from(inverse(X_WH)).positions
    distances = np.linalg.norm(found.positions[:, None] - trees, axis=2).min(axis=1)
    assert len(found) >= 3
    assert np.median(distances) < 0.4


def test_left_camera_is_on_the_left() -> None:
    poses = StereoConfig(baseline=0.4).poses()
    assert poses["left_image"].translation() == pytest.approx([0.0, 0.2, 0.0])
    between = poses["left_image"].inverse() @ poses["right_image"]
    # The baseline is along x of the left camera, as in `StereoCamera`.
    assert between.IsNearlyEqualTo(RigidTransform([0.4, 0.0, 0.0]), 1e-12)
    # Both look ahead, upright.
    assert poses["left_image"].rotation().matrix()[:, 2] == pytest.approx([1.0, 0.0, 0.0])
    assert poses["left_image"].rotation().matrix()[:, 1] == pytest.approx([0.0, 0.0, -1.0])


def test_images_of_different_times_are_not_compared() -> None:
    compared = []

    def see(left: int, right: int, history: np.ndarray, time: float) -> Landmarks:
        compared.append((left, right, time))
        return Landmarks.empty()

    unit = SCENARIO.unit(SCENARIO.global_map())
    localizer = Localizer((LandmarkSensor(see, IMAGES),), unit)
    history = np.zeros((3, 6))
    history[:, 0] = [2.0, 1.0, 0.0]
    for left_time, right_time in ((1.0, 1.5), (1.5, 1.5)):
        outputs, _ = localizer(
            request=np.ones(1),
            history=history.ravel(),
            memory=unit.start(),
            left_image=1,
            left_image_time=np.array([left_time]),
            right_image=2,
            right_image_time=np.array([right_time]),
        )
        assert outputs["time"] == [left_time]
    assert compared == [(1, 2, 1.5)]


def test_trials_count_errors_in_pixels() -> None:
    camera, eye = StereoConfig().camera(), np.array([1.0, 2.0])
    f, b = camera.focal_length, camera.baseline
    trees = Landmarks([[11.0, 2.0], [1.0, 10.0]], np.zeros((2, 2, 2)), [0.3, 0.2], [0.0, 0.0])
    # At 10 m: half a pixel of disparity too near, two pixels to the left. At 8 m: three pixels too thick.
    near, left, thick = 0.5 * 10.0**2 / (f * b), 2.0 * 10.0 / f, 3.0 * 8.0 / f
    found = Landmarks(
        [[11.0 - near, 2.0 + left], [1.0, 10.0]], np.tile(0.04 * np.eye(2), (2, 1, 1)), [0.3, 0.2 + thick], [0.1, 0.1]
    )
    squares = (near**2 + left**2) / 0.04
    expected = [[10.0, 0.5, 2.0, 0.0, squares], [8.0, 0.0, 0.0, 3.0, 0.0]]
    assert errors(found, trees, eye, camera) == pytest.approx(np.array(expected), abs=1e-9)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"perception": "sonar"}, "perception must be one of scanner, stereo, both, not 'sonar'"),
        ({"stereo": StereoConfig(baseline=0.0)}, "baseline must be a finite number above 0 m"),
        ({"stereo": StereoConfig(largest_disparity=20)}, "multiple of 16 pixels, not 20"),
        ({"stereo": StereoConfig(fps=0.0)}, "stereo.fps must be a finite number above 0 Hz"),
        ({"stereo": StereoConfig(width=0)}, "stereo.width must be a whole number of at least 1 pixels, not 0"),
    ],
)
def test_impossible_fields_are_refused(fields: dict[str, object], message: str) -> None:
    with pytest.raises(ScenarioError, match=message):
        ForestScenario(**{"perception": "stereo", **fields}).build()
