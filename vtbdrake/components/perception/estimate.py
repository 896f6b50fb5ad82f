"""The result of a perception function: a pose with its covariance and its time."""

from __future__ import annotations

from math import inf, sin, sqrt

import numpy as np
from numpy.typing import ArrayLike
from pydrake.math import RigidTransform, RotationMatrix

from vtbdrake.common.arrays import Array, immutable


@immutable
class PoseEstimate:
    """An estimate of the pose X_AB of a frame B in a frame A, or the statement that there is none.

    The error is δ = [θ; d] with R_AB = exp([θ]×) R̂_AB and p_AoBo = p̂_AoBo + d, both expressed in A.

    An estimate is immutable. It is made of arrays and numbers, so it is a value of abstract ports, slow parts and
    snapshots. "No estimate" (`missing`) is a value like any other: read ``valid`` first.

    Attributes:
        matrix: X_AB as [R_AB, p_AoBo_A], (3, 4), translation in m.
        covariance: The covariance of δ, (6, 6), in rad and m.
        time: When the pose held, in s.
        valid: Whether there is an estimate.
    """

    matrix: Array
    covariance: Array
    time: float
    valid: bool = True

    def __post_init__(self) -> None:
        for name, shape in (("matrix", (3, 4)), ("covariance", (6, 6))):
            if getattr(self, name).shape != shape:
                raise ValueError(f"the {name} of a PoseEstimate has the shape {shape}, not {getattr(self, name).shape}")

    @staticmethod
    def of(X_AB: RigidTransform, covariance: ArrayLike, *, time: float) -> PoseEstimate:
        """Return a valid estimate of X_AB at ``time`` (s) with the covariance (6, 6) of its error δ.

        Args:
            X_AB: The estimated pose.
            covariance: The covariance of δ = [θ; d], in rad and m.
            time: When the pose held, in s.
        """
        return PoseEstimate(X_AB.GetAsMatrix34(), np.asarray(covariance, dtype=float), float(time))

    @staticmethod
    def missing(*, time: float = -inf) -> PoseEstimate:
        """Return "no estimate" at ``time`` in s."""
        return PoseEstimate(np.eye(3, 4), np.diag(np.full(6, inf)), float(time), valid=False)

    @property
    def X(self) -> RigidTransform:
        """The pose X_AB."""
        return RigidTransform(RotationMatrix(self.matrix[:, :3]), self.matrix[:, 3])

    def error_to(self, X_AB: RigidTransform) -> Array:
        """Return δ (6,) of this estimate if X_AB is the true pose."""
        R_AB = X_AB.rotation().matrix()
        return np.concatenate([rotation_vector(R_AB @ self.matrix[:, :3].T), X_AB.translation() - self.matrix[:, 3]])

    def seen_from(self, X_WA: RigidTransform) -> PoseEstimate:
        """Return the estimate of X_WB, for an exactly known pose X_WA."""
        if not self.valid:
            return self
        turn = np.kron(np.eye(2), X_WA.rotation().matrix())
        return PoseEstimate.of(X_WA @ self.X, turn @ self.covariance @ turn.T, time=self.time)


def cross_matrix(v: ArrayLike) -> Array:
    """Return [v]× (..., 3, 3), for which [v]× u = v × u, for vectors (..., 3)."""
    v = np.asarray(v, dtype=float)
    matrix = np.zeros((*v.shape, 3))
    matrix[..., 0, 1], matrix[..., 0, 2], matrix[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    matrix[..., 1, 0], matrix[..., 2, 0], matrix[..., 2, 1] = v[..., 2], -v[..., 1], v[..., 0]
    return matrix


def rotation_matrix(theta: ArrayLike) -> Array:
    """Return exp([θ]×) (..., 3, 3) for rotation vectors (..., 3) in rad, by Rodrigues' formula."""
    theta = np.asarray(theta, dtype=float)
    if theta.ndim == 1:  # Filters need one at a time: the arithmetic of arrays takes thirty times as long.
        x, y, z = theta.tolist()
        angle = sqrt(x * x + y * y + z * z)
        s = sin(angle) / angle if angle else 1.0
        c = 0.5 * (sin(0.5 * angle) / (0.5 * angle)) ** 2 if angle else 0.5
        rows = (
            (1.0 - c * (y * y + z * z), c * x * y - s * z, c * x * z + s * y),
            (c * x * y + s * z, 1.0 - c * (x * x + z * z), c * y * z - s * x),
            (c * x * z - s * y, c * y * z + s * x, 1.0 - c * (x * x + y * y)),
        )
        return np.array(rows)
    angle = np.sqrt(np.sum(theta**2, axis=-1))[..., None, None]
    K = cross_matrix(theta)
    half = np.sinc(angle / (2.0 * np.pi))  # sin(x / 2) / (x / 2)
    rotation: Array = np.eye(3) + np.sinc(angle / np.pi) * K + 0.5 * half**2 * (K @ K)
    return rotation


def rotation_vector(R: ArrayLike) -> Array:
    """Return θ (3,) in rad with exp([θ]×) = R (3, 3) and a length of at most π."""
    angle_axis = RotationMatrix.ProjectToRotationMatrix(np.asarray(R, dtype=float)).ToAngleAxis()
    theta: Array = angle_axis.angle() * angle_axis.axis()
    return theta
