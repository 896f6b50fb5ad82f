"""Rotation vectors and rotation matrices."""

from __future__ import annotations

import numpy as np
import pytest
from pydrake.common.eigen_geometry import AngleAxis
from pydrake.math import RotationMatrix

from vtbdrake.components.perception.estimate import rotation_matrix


@pytest.mark.parametrize("angle", [0.0, 1e-200, 1e-8, 0.3, 3.1, 7.0])
def test_rotation_of_a_vector_is_that_of_drake(angle: float) -> None:
    axis = np.array([2.0, -1.0, 2.0]) / 3.0
    expected = RotationMatrix(AngleAxis(angle, axis)).matrix()
    np.testing.assert_allclose(rotation_matrix(angle * axis), expected, atol=1e-15)
    np.testing.assert_allclose(rotation_matrix(np.tile(angle * axis, (2, 1))), [expected, expected], atol=1e-15)
