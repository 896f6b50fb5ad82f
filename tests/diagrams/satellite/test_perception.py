"""The perception parts of the DPS, against the true motion of the target."""

from __future__ import annotations

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

from vtbdrake.common.scan import Scan
from vtbdrake.components.perception.estimate import PoseEstimate, rotation_matrix
from vtbdrake.components.perception.registration import RegistrationConfig
from vtbdrake.components.perception.target_tracker import STATE_SIZE, body_state
from vtbdrake_diagrams.satellite.bodies import Servicer, Target
from vtbdrake_diagrams.satellite.estimation import HISTORY, POSE, pose_at
from vtbdrake_diagrams.satellite.perception import ScanPose, in_inertial_frame, target_board, target_faces

PERIOD = 0.02
W_IB, V_IB = np.array([0.02, -0.05, 0.04]), np.array([0.05, 0.0, -0.02])
W_IT, V_IT = np.array([0.05, 0.03, -0.04]), np.array([-0.06, 0.02, 0.0])


def moved(X: RigidTransform, w: np.ndarray, v: np.ndarray, dt: float) -> RigidTransform:
    return RigidTransform(RotationMatrix(rotation_matrix(w * dt)) @ X.rotation(), X.translation() + v * dt)


def base_at(time: float) -> RigidTransform:
    return moved(RigidTransform(RollPitchYaw(0.3, 0.1, -0.2), [0.4, 0.0, 0.1]), W_IB, V_IB, time)


def target_at(time: float) -> RigidTransform:
    return moved(base_at(0.0) @ RigidTransform(RollPitchYaw(0.2, 0.3, -0.1), [2.4, 0.1, 0.0]), W_IT, V_IT, time)


def history_until(time: float) -> np.ndarray:
    """Return what a BaseEstimator remembers of the moving base, newest first."""
    times = time - PERIOD * np.arange(HISTORY)
    poses = [base_at(t) for t in times]
    rows = [[t, *X.rotation().ToQuaternion().wxyz(), *X.translation()] for t, X in zip(times, poses, strict=True)]
    return np.array(rows).reshape(HISTORY * POSE)


def scan_until(stamp: float, *, duration: float, clock: float = 0.0) -> Scan:
    """Return the returns of rays at random points of the target's front face, each at its own time.

    The clock of the scanner is ahead by ``clock`` s.
    """
    generator = np.random.default_rng(0)
    times = np.linspace(-duration, 0.0, 900)
    target = Target()
    y, z = generator.uniform(-0.39, 0.39, (2, 900))
    panel = np.arange(900) % 3 == 0
    side = np.where(np.arange(900) % 2, 1.0, -1.0)
    p_TQ = np.column_stack([
        np.where(panel, -target.panel[0] / 2, -target.box[0] / 2),
        np.where(panel, side * generator.uniform(0.51, 1.49, 900), y),
        np.where(panel, generator.uniform(-0.29, 0.29, 900), z),
    ])  # fmt: skip
    p_LQ = []
    for t, p in zip(times, p_TQ, strict=True):
        X_IL = base_at(stamp + t) @ Servicer().X_BL
        p_LQ.append(X_IL.inverse() @ (target_at(stamp + t) @ p))
    points = np.array(p_LQ)
    ranges = np.linalg.norm(points, axis=1)
    return Scan(points / ranges[:, None], ranges, times, stamp + clock)


def scan_pose(*, deskew: bool, stamp: float = 2.0, clock: float = 0.0) -> PoseEstimate:
    """Return the estimate from a scan of half a second, with a tracker that is a little wrong."""
    function = ScanPose(
        faces=target_faces(),
        X_BL=Servicer().X_BL,
        registration=RegistrationConfig(),
        deskew=deskew,
        attitude=None,
        period=PERIOD,
    )
    newest = stamp  # A period after the arrival, which is one after the stamp, the base is known up to the stamp.
    near = moved(target_at(newest + PERIOD), np.array([0.02, 0.0, -0.01]), np.array([0.01, -0.01, 0.0]), 1.0)
    tracked = body_state(near, W_IT + 0.002, V_IT + 0.002)
    shown, remembered = function(
        scan=scan_until(stamp, duration=0.5, clock=clock),
        time=np.array([stamp]),
        request=np.ones(1),
        history=history_until(newest),
        target=tracked,
        status=np.array([1.0, 0.1, 0.01, 0.01]),
        memory=PoseEstimate.missing(),
    )
    assert shown is remembered
    return shown


@pytest.mark.parametrize("clock", [0.0, 1.7e9])
def test_deskewed_scan_gives_the_pose_at_its_end(clock: float) -> None:
    estimate = scan_pose(deskew=True, clock=clock)
    assert estimate.time == 2.0
    error = estimate.error_to(target_at(2.0))
    assert np.linalg.norm(error[3:]) < 0.005
    assert np.linalg.norm(error[:3]) < 0.008


def test_raw_scan_of_a_moving_target_is_distorted() -> None:
    error = scan_pose(deskew=False).error_to(target_at(2.0))
    assert np.linalg.norm(error[3:]) > 0.015


def test_scan_without_a_track_or_an_attitude_is_no_estimate() -> None:
    function = ScanPose(target_faces(), Servicer().X_BL, RegistrationConfig(), True, None, PERIOD)
    history, lost = history_until(2.0), np.array([0.0, np.inf, np.inf, np.inf])
    scan = scan_until(2.0, duration=0.1)
    estimate, _ = function(
        scan=scan,
        time=np.array([2.0]),
        request=np.ones(1),
        history=history,
        target=np.zeros(STATE_SIZE),
        status=lost,
        memory=PoseEstimate.missing(),
    )
    assert not estimate.valid
    assert estimate.time == 2.0


def start(*, deskew: bool, scans: int) -> PoseEstimate:
    """Return the estimate from the last of some scans of half a second, while nothing is tracked."""
    attitude = target_at(2.0).rotation() @ RotationMatrix(RollPitchYaw(0.2, -0.3, 0.2))
    function = ScanPose(target_faces(), Servicer().X_BL, RegistrationConfig(), deskew, attitude, PERIOD)
    lost, memory = np.array([0.0, np.inf, np.inf, np.inf]), PoseEstimate.missing()
    for stamp in 2.0 - 0.5 * np.arange(scans)[::-1]:
        shown, memory = function(
            scan=scan_until(stamp, duration=0.5),
            time=np.array([stamp]),
            request=np.ones(1),
            history=history_until(stamp),
            target=np.zeros(STATE_SIZE),
            status=lost,
            memory=memory,
        )
    return shown


@pytest.mark.slow
def test_start_needs_only_the_rough_attitude() -> None:
    assert not start(deskew=True, scans=1).valid
    # The motion is not known for the first scan, but for the second.
    raw, corrected = (
        np.linalg.norm(estimate.error_to(target_at(2.0))[3:])
        for estimate in (start(deskew=False, scans=1), start(deskew=True, scans=2))
    )
    assert corrected < 0.01 < raw < 0.1


def test_points_are_related_to_the_base_at_their_own_times() -> None:
    history, times = history_until(1.0), np.array([0.31, 0.555, 0.999])
    points = np.random.default_rng(0).uniform(-3.0, 3.0, (3, 3))
    expected = [pose_at(history, t) @ p for t, p in zip(times, points, strict=True)]
    np.testing.assert_allclose(in_inertial_frame(points, times, history), expected, atol=1e-9)


def test_markers_lie_on_the_faces_and_look_outwards() -> None:
    board, faces = target_board(), target_faces()
    centers, outward = board.poses[:, :, 3], board.poses[:, :, 2]
    for center, normal in zip(centers, outward, strict=True):
        nearest, face, above = faces.nearest(center[None], eye=center + normal)
        assert above.all()
        assert normal == pytest.approx(face[0])
        assert center - nearest[0] == pytest.approx(0.001 * normal)
