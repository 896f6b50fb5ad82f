"""The pose at present: the way since the last scan, and what it does to the covariance."""

from __future__ import annotations

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource

from vtbdrake.common.scan import Scan
from vtbdrake.components.localization.dead_reckoning import DriftModel
from vtbdrake.components.localization.landmarks import Landmarks
from vtbdrake.components.localization.planar import compose, inverse
from vtbdrake.components.localization.unit import TRACKING
from vtbdrake_diagrams.forest.perception import SHOWN, PresentPose, ScanLandmarks, moved, shown

X_WH, MOTION = np.array([3.0, -2.0, 2.5]), np.array([1.2, 0.3, 0.4])
C = np.array([[0.04, 0.01, 0.002], [0.01, 0.09, -0.003], [0.002, -0.003, 0.001]])


def test_covariance_is_carried_along_as_derivatives_say() -> None:
    drift, step = DriftModel(0.1, 0.05, 0.02, 0.03), 1e-6
    pose, covariance = moved(X_WH, C, MOTION, drift, 2.0)
    np.testing.assert_allclose(pose, compose(X_WH, MOTION))
    by_pose, by_motion = (
        np.column_stack([(compose(*at(h)) - pose) / step for h in step * np.eye(3)])
        for at in (lambda h: (X_WH + h, MOTION), lambda h: (X_WH, MOTION + h))
    )
    # The errors of the motion are the errors of its end, in the frame of its beginning.
    expected = by_pose @ C @ by_pose.T + by_motion @ drift.covariance(MOTION, 2.0) @ by_motion.T
    np.testing.assert_allclose(covariance, expected, rtol=1e-4)


def test_pose_goes_on_with_the_last_motion() -> None:
    """The axle is on a circle, and the localizer's answer is for where the carrier was half a second before."""
    speed, rate, then, known, period, axle = 1.5, 0.5, 0.5, 0.96, 0.02, -2.0

    def on_circle(time: float) -> np.ndarray:
        angle = rate * time
        p_OA = speed / rate * np.array([np.sin(angle), 1.0 - np.cos(angle)])
        return np.append(p_OA - axle * np.array([np.cos(angle), np.sin(angle)]), angle)

    builder = DiagramBuilder()
    system = builder.AddSystem(PresentPose(period=period, drift=DriftModel(), axle=axle))
    X_OH = on_circle(known)
    inputs = {
        "motion": [known, 0.0, 0.0, *X_OH, speed, rate],
        "pose": X_WH,
        "covariance": C.ravel(),
        "status": [TRACKING],
        "odometry": on_circle(then),
        "time": [then],
    }
    for name, value in inputs.items():
        source = builder.AddSystem(ConstantVectorSource(value))
        builder.Connect(source.get_output_port(), system.GetInputPort(name))
    simulator = Simulator(builder.Build())
    simulator.AdvanceTo(1.001)
    estimate = system.get_output_port().Eval(system.GetMyContextFromRoot(simulator.get_context()))
    assert estimate[0] == pytest.approx(1.0)
    expected = compose(X_WH, compose(inverse(on_circle(then)), on_circle(1.0)))
    np.testing.assert_allclose(estimate[1:4], expected, atol=1e-6)
    # The covariance has grown with the distance travelled in half a second, and with the time.
    _, grown = moved(X_WH, C, compose(inverse(on_circle(then)), on_circle(1.0)), DriftModel(), 1.0 - then)
    np.testing.assert_allclose(estimate[4:13].reshape(3, 3), grown, rtol=1e-6)


def test_landmarks_are_seen_in_the_level_frame() -> None:
    """A carrier that is tilted and turned sees a point of the world where it is in H."""
    roll, pitch, heading, time = 0.1, -0.2, 0.7, 5.0
    X_BL = RigidTransform(RollPitchYaw(0.0, 0.3, 0.0), [0.9, 0.1, 2.0])
    X_HB = RigidTransform(RollPitchYaw(roll, pitch, 0.0), [0.0, 0.0, 0.0])
    points_H = np.array([[8.0, 3.0, 0.5], [-2.0, 6.0, 1.0]])
    points_L = (X_HB @ X_BL).inverse().multiply(points_H.T).T
    ranges = np.linalg.norm(points_L, axis=1)
    scan = Scan(points_L / ranges[:, None], ranges, np.zeros(2), time)
    history = np.array([[t, roll, pitch, 4.0, -3.0, heading] for t in (5.02, 5.0, 4.98)]).ravel()
    seen = {}

    def detect(points: np.ndarray, settings: str, *, p_HoLo_H: np.ndarray) -> Landmarks:
        seen.update(points=points, settings=settings, origin=p_HoLo_H)
        return Landmarks.empty()

    assert len(ScanLandmarks(detect, "settings", X_BL)(scan, history, time)) == 0
    assert seen["settings"] == "settings"
    np.testing.assert_allclose(seen["points"], points_H, atol=1e-12)
    np.testing.assert_allclose(seen["origin"], (X_HB @ X_BL).translation(), atol=1e-12)
    # The rays were fired before the history begins: 20 ms were given as 20 s.
    seen.clear()
    late = Scan(scan.directions_L, scan.ranges, np.array([-20.0, 0.0]), time)
    assert len(ScanLandmarks(detect, "settings", X_BL)(late, history, time)) == 0
    assert not seen


def test_nearest_landmarks_are_shown() -> None:
    rng = np.random.default_rng(0)
    places, n = rng.uniform(-20.0, 20.0, (100, 2)), 100
    landmarks = Landmarks(places, np.tile(np.eye(2), (n, 1, 1)), np.arange(n) / 100.0, np.zeros(n))
    rows = shown(landmarks).reshape(SHOWN, 3)
    distances = np.sort(np.linalg.norm(places, axis=1))
    np.testing.assert_allclose(np.linalg.norm(rows[:, :2], axis=1), distances[:SHOWN])
    few = shown(landmarks.select([3, 7])).reshape(SHOWN, 3)
    assert set(few[:2, 2]) == {0.03, 0.07}
    assert np.isnan(few[2:]).all()
