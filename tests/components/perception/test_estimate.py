"""Pose estimates as values, and rotation vectors."""

from __future__ import annotations

from copy import deepcopy

import numpy as np
import pytest
from pydrake.common.eigen_geometry import AngleAxis
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

from vtbdrake.components.perception.estimate import PoseEstimate, cross_matrix, rotation_matrix, rotation_vector
from vtbdrake.state.codecs import codec_of

X_AB = RigidTransform(RollPitchYaw(0.1, -0.4, 0.8), [1.0, 2.0, 3.0])
ROOT = np.random.default_rng(0).standard_normal((6, 6))
ESTIMATE = PoseEstimate.of(X_AB, ROOT @ ROOT.T, time=2.5)


@pytest.mark.parametrize("angle", [0.0, 1e-200, 1e-8, 0.3, 3.1, 7.0])
def test_rotation_of_a_vector_is_that_of_drake(angle: float) -> None:
    axis = np.array([2.0, -1.0, 2.0]) / 3.0
    expected = RotationMatrix(AngleAxis(angle, axis)).matrix()
    np.testing.assert_allclose(rotation_matrix(angle * axis), expected, atol=1e-15)
    np.testing.assert_allclose(rotation_matrix(np.tile(angle * axis, (2, 1))), [expected, expected], atol=1e-15)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 0.3, 3.1])
def test_rotation_vector_is_axis_times_angle(angle: float) -> None:
    theta = angle * np.array([2.0, -1.0, 2.0]) / 3.0
    np.testing.assert_allclose(rotation_vector(rotation_matrix(theta)), theta, atol=1e-12)


def test_cross_matrix_multiplies_like_the_cross_product() -> None:
    u, v = np.random.default_rng(1).standard_normal((2, 4, 3))
    np.testing.assert_allclose(np.einsum("nij,nj->ni", cross_matrix(u), v), np.cross(u, v))


def test_error_leads_to_the_true_pose() -> None:
    true = RigidTransform(RollPitchYaw(0.2, -0.3, 0.9), [1.1, 1.9, 3.0])
    error = ESTIMATE.error_to(true)
    np.testing.assert_allclose(rotation_matrix(error[:3]) @ X_AB.rotation().matrix(), true.rotation().matrix())
    np.testing.assert_allclose(error[3:], [0.1, -0.1, 0.0])


def test_distance_of_an_error_does_not_depend_on_the_frame() -> None:
    X_WA = RigidTransform(RollPitchYaw(1.0, 0.2, -2.0), [-4.0, 0.5, 1.0])
    true = X_AB @ RigidTransform(RollPitchYaw(0.01, 0.02, -0.03), [0.1, 0.0, 0.2])
    seen = ESTIMATE.seen_from(X_WA)
    assert seen.time == 2.5
    distances = []
    for estimate, X in ((ESTIMATE, true), (seen, X_WA @ true)):
        error = estimate.error_to(X)
        distances.append(error @ np.linalg.solve(estimate.covariance, error))
    assert distances[1] == pytest.approx(distances[0], rel=1e-9)


@pytest.mark.parametrize("estimate", [ESTIMATE, PoseEstimate.missing(time=1.0)])
def test_codec_carries_an_estimate_exactly(estimate: PoseEstimate) -> None:
    codec = codec_of(PoseEstimate.missing())
    back = codec.decode(codec.encode(estimate))
    np.testing.assert_array_equal(back.matrix, estimate.matrix)
    np.testing.assert_array_equal(back.covariance, estimate.covariance)
    assert (back.time, back.valid) == (estimate.time, estimate.valid)


def test_estimate_is_immutable_and_its_own_copy() -> None:
    assert deepcopy(ESTIMATE) is ESTIMATE
    with pytest.raises(ValueError, match="read-only"):
        ESTIMATE.covariance[0, 0] = 1.0


def test_covariance_of_another_shape_is_rejected() -> None:
    with pytest.raises(ValueError, match=r"covariance of a PoseEstimate has the shape \(6, 6\), not \(3, 3\)"):
        PoseEstimate.of(X_AB, np.eye(3), time=0.0)
