"""Camera and scanner in the loop: small images, and only the beginning of a capture."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from vtbdrake.state.systems import pose_from_array
from vtbdrake.testbed import VirtualTestbed
from vtbdrake_diagrams.satellite import SatelliteScenario
from vtbdrake_diagrams.satellite.supervisor import Mode
from vtbdrake_diagrams.satellite.views import looking, pictures

pytest.importorskip("cv2")


def seeing(perception: str) -> SatelliteScenario:
    return SatelliteScenario(seed=1, tumble_deg=2.0, perception=perception, image_width=240, image_height=180)


@cache
def built(perception: str) -> VirtualTestbed:
    return seeing(perception).build()


@pytest.mark.slow_cases
@pytest.mark.parametrize("perception", ["camera", "camera+scanner"])
def test_target_is_tracked_by_what_is_seen(perception: str) -> None:
    testbed = built(perception)
    context = testbed.default_context()
    testbed.simulator(context).AdvanceTo(1.5)
    # At the start, I is W.
    X_IT = pose_from_array(testbed.read(context, "dps.env.target.pose"))
    X_WT = pose_from_array(testbed.read(context, "sim.sys.target.body.pose"))
    error = X_WT.InvertAndCompose(X_IT)
    assert np.linalg.norm(error.translation()) < 0.03
    assert error.rotation().ToAngleAxis().angle() < np.radians(3.0)
    assert testbed.read(context, "dps.impl.supervisor.mode") == Mode.APPROACH
    assert testbed.read(context, "dps.env.markers.count") >= 3.0


def test_no_start_when_nothing_is_seen() -> None:
    testbed = built("camera")
    context = testbed.default_context()
    backwards = np.array([-0.7, 0.0, 0.4, -np.pi / 2, 0.0, np.pi / 2])
    testbed.write(context, {"sim.sense.docking_camera.pose": backwards})
    testbed.simulator(context).AdvanceTo(1.5)
    assert testbed.read(context, "dps.env.markers.count") == 0.0
    assert testbed.read(context, "dps.impl.supervisor.mode") == 0.0


def test_pictures_leave_the_context_as_it_is() -> None:
    testbed = built("camera")
    context = testbed.default_context()
    before = testbed.read(context, "sim.sense.docking_camera.pose")
    scene, seen = pictures(testbed, context)
    assert scene.shape == seen.shape == (180, 240, 3)
    assert (scene != seen).any()
    np.testing.assert_array_equal(testbed.read(context, "sim.sense.docking_camera.pose"), before)


def test_looking_has_the_point_in_the_middle() -> None:
    X = looking([1.0, -3.0, 2.0], [0.5, 0.5, 0.0])
    ahead = X.inverse() @ np.array([0.5, 0.5, 0.0])
    np.testing.assert_allclose(ahead[:2], 0.0, atol=1e-12)
    assert ahead[2] > 0.0
    assert (X.rotation().inverse() @ np.array([0.0, 0.0, 1.0]))[1] < 0.0  # upwards is up in the image
