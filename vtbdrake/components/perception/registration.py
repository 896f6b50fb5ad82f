"""The pose of a known body from laser points: registration to the faces of its model, and de-skewing."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from pydrake.math import RigidTransform, RotationMatrix

from vtbdrake.common.arrays import Array, immutable
from vtbdrake.common.settings import check_settings, setting
from vtbdrake.components.perception.estimate import PoseEstimate, rotation_matrix


@immutable
class Faces:
    """The surface of a rigid body T as m rectangles.

    Attributes:
        poses: The pose X_TF of each rectangle, (m, 3, 4), translation in m: the origin of F is its centre, x and y run
            along its edges, and z points out of the body.
        half_sizes: Half of its edge lengths along x and y, (m, 2) in m.
    """

    poses: Array
    half_sizes: Array

    def __post_init__(self) -> None:
        poses, half_sizes = self.poses, self.half_sizes
        if poses.ndim != 3 or poses.shape[1:] != (3, 4) or half_sizes.shape != (len(poses), 2) or not len(poses):
            raise ValueError(f"Faces have poses (m, 3, 4) and half_sizes (m, 2), not {poses.shape}, {half_sizes.shape}")
        if not (half_sizes > 0.0).all():
            raise ValueError(f"the edges of faces have positive lengths, not {half_sizes.min()}")

    @staticmethod
    def of_boxes(boxes: Iterable[tuple[RigidTransform, ArrayLike]]) -> Faces:
        """Return the six faces of each box, given as its pose X_TG and its edge lengths (3,) in m."""
        poses, half_sizes = [], []
        for X_TG, size in boxes:
            half = 0.5 * np.asarray(size, dtype=float)
            for axis in range(3):
                x, y = (axis + 1) % 3, (axis + 2) % 3
                for sign in (1.0, -1.0):
                    R = np.zeros((3, 3))
                    R[x, 0], R[y, 1], R[axis, 2] = 1.0, sign, sign
                    p = np.zeros(3)
                    p[axis] = sign * half[axis]
                    poses.append((X_TG @ RigidTransform(RotationMatrix(R), p)).GetAsMatrix34())
                    half_sizes.append([half[x], half[y]])
        return Faces(np.array(poses), np.array(half_sizes))

    def nearest(self, points: Array, *, eye: Array) -> tuple[Array, Array, Array]:
        """Find the nearest point on the faces that are turned towards an eye.

        Args:
            points: Points in T, (n, 3) in m.
            eye: Position in T of the sensor that saw them, (3,) in m.

        Returns:
            The nearest points (n, 3), the outward normals of their faces (n, 3), and whether each point lies above its
            face rather than beyond an edge of it, (n,).
        """
        R, p = self.poses[:, :, :3], self.poses[:, :, 3]
        facing = np.einsum("mi,mi->m", R[:, :, 2], eye - p) > 0.0
        R, p, half = R[facing], p[facing], self.half_sizes[facing]
        if not len(p):
            return np.full_like(points, np.inf), np.zeros_like(points), np.zeros(len(points), dtype=bool)
        local = (points @ R.transpose(1, 0, 2).reshape(3, -1)).reshape(len(points), -1, 3)
        local -= np.einsum("mij,mi->mj", R, p)
        clamped = np.clip(local[..., :2], -half, half)
        beyond = local[..., :2] - clamped
        best = np.argmin(beyond[..., 0] ** 2 + beyond[..., 1] ** 2 + local[..., 2] ** 2, axis=1)
        rows = np.arange(len(points))
        on_face = clamped[rows, best]
        nearest = p[best] + R[best, :, 0] * on_face[:, :1] + R[best, :, 1] * on_face[:, 1:]
        return nearest, R[best, :, 2], ~beyond[rows, best].any(axis=1)

    def offsets(self, points: Array, *, eye: Array, thickness: float) -> tuple[Array, Array, Array, Array]:
        """Measure the offsets, in the plane of a face, of points that cover the face from one edge to the other.

        The distances of points from a plane do not determine a motion within the plane; the edges do. The face is cut
        into strips. The first and the last point of a strip lie within the mean distance s of points from the edges, so
        that their midpoint is the face's to ± s / 2. The offset is the mean over the strips. If the rows of
        points are parallel to an edge, the errors of all strips are equal: so the standard deviation equals one
        strip's, s / √12 for a uniform distribution.

        Args:
            points: Points in T, (n, 3) in m.
            eye: Position in T of the sensor that saw them, (3,) in m.
            thickness: Largest distance of its points from a face, in m.

        Returns:
            For each direction along a face in which both edges were seen: the centre of the face (k, 3), the direction
            (k, 3), the offset of the points (k,) in m and its standard deviation (k,) in m.
        """
        edges: list[tuple[Array, Array, float, float]] = []
        for pose, half in zip(self.poses, self.half_sizes, strict=True):
            if pose[:, 2] @ (eye - pose[:, 3]) <= 0.0:
                continue
            local = (points - pose[:, 3]) @ pose[:, :3]
            on = local[(np.abs(local[:, 2]) < thickness) & (np.abs(local[:, :2]) < half + thickness).all(axis=1), :2]
            # Where a face is hidden in part, the distance follows from the part that is seen.
            s = float(np.sqrt(np.prod(np.ptp(on, axis=0)) / len(on))) if len(on) > 10 else np.inf
            for k in range(2):
                count = int(2.0 * half[1 - k] / max(1.5 * s, 1e-6))
                if count < 3 or s > 0.2 * half[k]:
                    continue
                strip = ((on[:, 1 - k] / half[1 - k] + 1.0) * 0.5 * count).astype(int).clip(0, count - 1)
                low, high = np.full(count, np.inf), np.full(count, -np.inf)
                np.minimum.at(low, strip, on[:, k])
                np.maximum.at(high, strip, on[:, k])
                whole = (high > half[k] - 2.0 * s) & (low < 2.0 * s - half[k])
                if whole.sum() >= 3:
                    offset = float(np.mean(0.5 * (low[whole] + high[whole])))
                    edges.append((pose[:, 3], pose[:, k], offset, s / 12.0**0.5))
        centres, directions, offsets, deviations = zip(*edges, strict=True) if edges else ((), (), (), ())
        return np.reshape(centres, (-1, 3)), np.reshape(directions, (-1, 3)), np.array(offsets), np.array(deviations)


def deskew(points: ArrayLike, times: ArrayLike, *, origin: ArrayLike, velocity: ArrayLike, rate: ArrayLike) -> Array:
    """Return the points of a moving rigid body as they would be if all had been measured at time 0.

    With a constant twist, a point of the body that is at q at the time t is at o + exp(-[ω]× t) (q - o - v t) at 0.

    Args:
        points: Points in a fixed frame, (n, 3) in m.
        times: Time of the measurement of each, (n,) in s.
        origin: A point o of the body at time 0, (3,) in m.
        velocity: The velocity v of that point, (3,) in m/s.
        rate: The angular velocity ω of the body, (3,) in rad/s.
    """
    t = np.asarray(times, dtype=float)[:, None]
    o = np.asarray(origin, dtype=float)
    arms = np.asarray(points, dtype=float) - o - t * np.asarray(velocity)
    fixed: Array = o + np.einsum("nij,nj->ni", rotation_matrix(-t * np.asarray(rate)), arms)
    return fixed


@dataclass
class RegistrationConfig:
    """Noise and limits of the registration of laser points."""

    range_noise: float = setting(
        0.01, "The standard deviation of the distance of a point from its face.", unit="m", gt=0.0
    )
    systematic: float = setting(
        0.003,
        "The standard deviation of errors that more points do not reduce; assumed, not derived. As an angle "
        "it counts per metre.",
        unit="m",
        ge=0.0,
    )
    basin: float = setting(
        0.3,
        "Largest distance from the body of points that are used in the first step. It is halved in every "
        "step, down to four times the noise.",
        unit="m",
        gt=0.0,
    )
    most_points: int = setting(800, "Largest number of points that are used, evenly chosen.")
    fewest_points: int = setting(30, "Least number of points that must lie on the faces after the last step.")
    share: float = setting(0.6, "Least share that they must be of the points within ``basin`` of the body.")
    steps: int = setting(25, "Largest number of steps.")

    def __post_init__(self) -> None:
        check_settings(self)
        if not self.basin > 4.0 * self.range_noise:
            least = f"more than 4 times the range_noise, {4.0 * self.range_noise:g} m"
            raise ValueError(f"RegistrationConfig.basin must be {least}, not {self.basin!r}")


# So many steps at least minimize the offsets along the faces, too.
_LAST_STEPS = 6
# The covariance of an estimate counts a start with these deviations, so that it is finite.
_PRIOR = np.full(6, 0.3**-2)


def register_points(
    points: ArrayLike,
    faces: Faces,
    start: RigidTransform,
    *,
    eye: ArrayLike,
    time: float,
    registration: RegistrationConfig | None = None,
    deviation: tuple[float, float] = (0.3, 0.3),
) -> PoseEstimate:
    r"""Estimate the pose X_AT of a body from points on its surface, by the iterated closest point algorithm.

    In each step, every point p is assigned the nearest point q of the faces that are turned to the eye, and
    Σ w(r) r², r = n·(p - q), is minimized over small motions of T (Chen and Medioni, "Object modelling by registration
    of multiple range images", 1992). n is the face's normal, and for points beyond an edge the direction from q to p.
    Points farther from the body than a limit, which shrinks from step to step, are left out; the others have Tukey's
    weights w. Once the steps are small, the offsets along the faces (`Faces.offsets`) are minimized, too. The
    covariance is the inverse normal matrix of the points above faces and of these offsets.

    Args:
        points: Points in A, (n, 3) in m, measured at one instant, or de-skewed.
        faces: The model.
        start: X_AT to start from: a prediction, or the pose from markers.
        eye: Position in A of the sensor that saw the points, (3,) in m.
        time: The instant of the points, in s.
        registration: Noise and limits.
        deviation: The standard deviations of the start in rad and m. Motions that the points do not determine keep the
            start, and offsets along a face of more than four deviations are rejected. The covariance of the estimate
            does not depend on it: it belongs to a start with 0.3 rad and 0.3 m.

    Returns:
        An estimate of X_AT; a missing one if too few points lie on the body.
    """
    settings = registration or RegistrationConfig()
    points, eye = np.asarray(points, dtype=float).reshape(-1, 3), np.asarray(eye, dtype=float)
    R, p = start.rotation().matrix(), start.translation()
    near = _within(points, p, faces, settings.basin)
    if len(near) > settings.most_points:
        near = near[np.linspace(0, len(near) - 1, settings.most_points).astype(int)]
    limit, least = settings.basin, 4.0 * settings.range_noise
    offset, settled = np.zeros(6), False
    prior = np.repeat(np.array(deviation) ** -2, 3)
    for k in range(settings.steps):
        if len(near) < settings.fewest_points:
            return PoseEstimate.missing(time=time)
        in_T, eye_T = (near - p) @ R, (eye - p) @ R
        nearest, normals, above = faces.nearest(in_T, eye=eye_T)
        gap = in_T - nearest
        distance = np.linalg.norm(gap, axis=1)
        n_T = np.where(above[:, None] | (distance < 1e-9)[:, None], normals, gap / np.maximum(distance, 1e-9)[:, None])
        r = np.einsum("ni,ni->n", n_T, gap)
        weight = (1.0 - np.minimum(distance / limit, 1.0) ** 2) ** 2
        # A motion [θ; d] of T changes r by -n·(θ × (p - p_AT) + d).
        J = _jacobian(near - p, n_T @ R.T)
        edges, beside, deviations = _edges(faces, in_T, R, eye_T, least) if settled else _NO_EDGES
        believed = np.abs(beside + edges @ offset) < 4.0 * deviation[1]
        edges, beside, deviations = edges[believed], beside[believed], deviations[believed]
        information = (edges / deviations[:, None] ** 2).T @ edges
        H = (weight[:, None] * J).T @ J / settings.range_noise**2 + information + np.diag(prior)
        b = J.T @ (weight * r) / settings.range_noise**2 + edges.T @ (beside / deviations**2) - prior * offset
        step = np.linalg.solve(H, b)
        step *= min(1.0, 0.3 / max(float(np.linalg.norm(step[:3])), 1e-12))
        R, p, offset = rotation_matrix(step[:3]) @ R, p + step[3:], offset + step
        largest = float(np.abs(step).max())
        if settled and largest < 1e-4:
            break
        settled = settled or (limit == least and largest < 1e-3) or k >= settings.steps - _LAST_STEPS
        limit = max(least, 0.5 * limit)
    on_body = above & (distance < least)
    count, close = int(on_body.sum()), int((distance < settings.basin).sum())
    if count < settings.fewest_points or count < settings.share * close:
        return PoseEstimate.missing(time=time)
    variance = max(settings.range_noise**2, float(np.mean(r[on_body] ** 2)))
    covariance = np.linalg.inv(J[on_body].T @ J[on_body] / variance + information + np.diag(_PRIOR))
    covariance += settings.systematic**2 * np.eye(6)
    X_AT = RigidTransform(RotationMatrix.ProjectToRotationMatrix(R), p)
    return PoseEstimate.of(X_AT, 0.5 * (covariance + covariance.T), time=time)


def misfit(points: ArrayLike, faces: Faces, X_AT: RigidTransform, *, eye: ArrayLike, limit: float) -> float:
    """Return the mean of min(d, limit)² over points with the distances d to the body at X_AT, in m².

    The registration with the least misfit explains the points best.

    Args:
        points: Points in A, (n, 3) in m.
        faces: The model.
        X_AT: The pose of the body.
        eye: Position in A of the sensor that saw the points, (3,) in m.
        limit: The distance in m beyond which a point does not belong to the body.
    """
    X_TA = X_AT.inverse()
    in_T = np.asarray(points, dtype=float) @ X_TA.rotation().matrix().T + X_TA.translation()
    nearest, _, _ = faces.nearest(in_T, eye=X_TA @ np.asarray(eye, dtype=float))
    return float(np.mean(np.minimum(np.sum((in_T - nearest) ** 2, axis=1), limit**2)))


def _jacobian(arms: Array, directions: Array) -> Array:
    """Return the Jacobian of points at ``arms`` from To along ``directions`` by the motion [θ; d] of T, (n, 6)."""
    return np.concatenate([np.cross(arms, directions), directions], axis=1)


_NO_EDGES = np.zeros((0, 6)), np.zeros(0), np.zeros(0)


def _edges(faces: Faces, in_T: Array, R: Array, eye_T: Array, thickness: float) -> tuple[Array, Array, Array]:
    """Return the Jacobian, the value and the standard deviation of each offset along a face."""
    centres, directions, offsets, deviations = faces.offsets(in_T, eye=eye_T, thickness=thickness)
    return _jacobian(centres @ R.T, directions @ R.T), offsets, deviations


def _within(points: Array, centre: Array, faces: Faces, distance: float) -> Array:
    """Return the points that are not farther from the body than ``distance``, whatever its attitude."""
    reach = np.linalg.norm(faces.poses[:, :, 3], axis=1) + np.linalg.norm(faces.half_sizes, axis=1)
    return points[np.linalg.norm(points - centre, axis=1) < reach.max() + distance]
