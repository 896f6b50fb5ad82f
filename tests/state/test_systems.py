"""Poses as six numbers, and where a constant velocity takes them."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from vtbdrake.state.systems import pose_later

pytestmark = pytest.mark.one_python

VECTOR = st.lists(st.floats(-2.0, 2.0), min_size=3, max_size=3)


@pytest.mark.parametrize("dt", [5e-324, 1.7e-162, 1e-155, 1e-140])
def test_turn_whose_square_is_zero_is_none(dt):
    np.testing.assert_allclose(
        pose_later(np.zeros(6), np.array([0.3, -0.5, 1.0, 0, 0, 0]), dt), np.zeros(6), atol=1e-139
    )


@given(VECTOR, st.lists(st.floats(-1.5, 1.5), min_size=3, max_size=3), VECTOR, VECTOR, st.floats(-1.0, 1.0))
def test_pose_after_constant_velocity_is_that_of_a_rotation_vector(place, angles, turn, speed, dt):
    later = pose_later(np.array([*place, *angles]), np.array([*turn, *speed]), dt)
    np.testing.assert_allclose(later[:3], np.array(place) + dt * np.array(speed), atol=1e-12)
    # Roll, pitch and yaw are about the fixed axes.
    expected = Rotation.from_rotvec(dt * np.array(turn)) * Rotation.from_euler("xyz", angles)
    np.testing.assert_allclose(Rotation.from_euler("xyz", later[3:]).as_matrix(), expected.as_matrix(), atol=1e-9)
