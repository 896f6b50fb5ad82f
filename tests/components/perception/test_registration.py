"""Poses by registration of laser points, against points computed by intersecting rays with boxes."""

from __future__ import annotations

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

from vtbdrake.components.perception.estimate import PoseEstimate, rotation_matrix
from vtbdrake.components.perception.registration import Faces, RegistrationConfig, deskew, register_points

pytestmark = pytest.mark.one_python

BOXES = [((0.8, 0.7, 0.6), (0.0, 0.0, 0.0)), ((0.3, 0.2, 0.9), (-0.3, 0.4, 0.1))]
FACES = Faces.of_boxes([(RigidTransform(center), edges) for edges, center in BOXES])
EYE = np.array([0.1, -0.2, 0.3])
# A corner of the big box is turned to the eye, so that all six directions are determined by its faces.
X_AT = RigidTransform(RollPitchYaw(0.2, 0.6, 0.7), [2.5, 0.1, 0.2])


def rays(count: int) -> np.ndarray:
    """Return ``count``² unit vectors around the x axis."""
    y, z = np.meshgrid(*2 * [np.tan(np.linspace(-0.3, 0.3, count))])
    directions = np.stack([np.ones_like(y), y, z], axis=-1).reshape(-1, 3)
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def cast(X: RigidTransform, directions: np.ndarray) -> np.ndarray:
    """Return the distances at which rays from the eye hit the boxes, by the slab method; infinite if they do not."""
    origin, inside = X.inverse() @ EYE, directions @ X.rotation().matrix()
    inside = np.where(np.abs(inside) < 1e-12, 1e-12, inside)
    nearest = np.full(len(directions), np.inf)
    for edges, center in BOXES:
        first, second = ((sign * np.array(edges) / 2 + center - origin) / inside for sign in (-1.0, 1.0))
        enter, leave = np.minimum(first, second).max(axis=1), np.maximum(first, second).min(axis=1)
        nearest = np.where((enter < leave) & (enter > 0.0), np.minimum(nearest, enter), nearest)
    return nearest


def measure(noise: float, *, seed: int, count: int = 40, X: RigidTransform = X_AT) -> np.ndarray:
    """Return the points of a scan of the boxes at X."""
    directions = rays(count)
    ranges = cast(X, directions)
    hit = np.isfinite(ranges)
    noisy = ranges[hit] + noise * np.random.default_rng(seed).standard_normal(hit.sum())
    return EYE + directions[hit] * noisy[:, None]


def near(X: RigidTransform, *, angle: float, distance: float, seed: int) -> RigidTransform:
    """Return X turned and moved in a random direction."""
    turn, move = np.random.default_rng(seed).standard_normal((2, 3))
    R = rotation_matrix(angle * turn / np.linalg.norm(turn)) @ X.rotation().matrix()
    return RigidTransform(RotationMatrix(R), X.translation() + distance * move / np.linalg.norm(move))


def register(points: np.ndarray, start: RigidTransform, *, noise: float = 0.01) -> PoseEstimate:
    settings = RegistrationConfig(range_noise=noise, systematic=0.0)
    return register_points(points, FACES, start, eye=EYE, time=2.0, registration=settings)


def root_mean_square_error(noise: float, *, count: int) -> float:
    errors = []
    for seed in range(12):
        start = near(X_AT, angle=0.02, distance=0.02, seed=seed)
        errors.append(register(measure(noise, seed=seed, count=count), start, noise=noise).error_to(X_AT)[3:])
    return float(np.sqrt(np.mean(np.square(errors))))


def test_error_is_proportional_to_the_noise_of_the_ranges() -> None:
    assert root_mean_square_error(0.008, count=30) / root_mean_square_error(0.002, count=30) == pytest.approx(
        4, rel=0.4
    )


def test_error_falls_with_the_root_of_the_number_of_points() -> None:
    assert root_mean_square_error(0.005, count=16) / root_mean_square_error(0.005, count=48) == pytest.approx(
        3, rel=0.4
    )


def test_errors_agree_with_their_covariance() -> None:
    distances = []
    for seed in range(30):
        estimate = register(measure(0.01, seed=seed), near(X_AT, angle=0.02, distance=0.02, seed=seed))
        error = estimate.error_to(X_AT)
        distances.append(error @ np.linalg.solve(estimate.covariance, error))
    # Chi-square with 30 * 6 degrees of freedom is 141 to 222 in 95 %; edges make the covariance cautious.
    assert 1.0 < np.mean(distances) < 7.4


def test_systematic_error_is_the_covariance_of_exact_points() -> None:
    settings = RegistrationConfig(range_noise=1e-4, systematic=0.01)
    points = measure(0.0, seed=0)
    estimate = register_points(points, FACES, X_AT, eye=EYE, time=2.0, registration=settings)
    np.testing.assert_allclose(estimate.covariance, 0.01**2 * np.eye(6), atol=0.01**3)


@pytest.mark.parametrize(("share", "valid"), [(0.75, True), (0.45, False)])
def test_most_of_the_points_close_by_must_be_on_the_body(share: float, valid: bool) -> None:
    points = measure(0.001, seed=0, count=24)
    count = round(len(points) * (1.0 / share - 1.0))
    # Between 5 and 15 cm in front of the body.
    before = np.random.default_rng(1).uniform(0.05, 0.15, (count, 1))
    ends = np.resize(points, (count, 3))
    clutter = ends - before * (ends - EYE) / np.linalg.norm(ends - EYE, axis=1, keepdims=True)
    assert register(np.concatenate([points, clutter]), X_AT, noise=0.001).valid == valid


def test_start_may_be_fifteen_degrees_and_ten_centimetres_away() -> None:
    for seed in range(8):
        start = near(X_AT, angle=np.radians(15.0), distance=0.1, seed=seed)
        estimate = register(measure(0.005, seed=seed), start, noise=0.005)
        assert np.linalg.norm(estimate.error_to(X_AT)[3:]) < 0.01


def test_points_of_other_things_do_not_matter() -> None:
    points = measure(0.005, seed=1)
    stray = EYE + np.random.default_rng(2).uniform(0.5, 0.9, (len(points) // 4, 1)) * (
        points[::4][: len(points) // 4] - EYE
    )
    estimate = register(np.concatenate([points, stray]), near(X_AT, angle=0.05, distance=0.03, seed=3), noise=0.005)
    assert np.linalg.norm(estimate.error_to(X_AT)[3:]) < 0.005


def test_motion_along_a_single_face_stays_as_predicted() -> None:
    X = RigidTransform([2.5, 0.0, 0.0])
    y, z = np.meshgrid(np.linspace(-0.2, 0.1, 12), np.linspace(-0.2, 0.1, 12))
    points = np.stack([np.full(144, 2.1), y.ravel(), z.ravel()], axis=1)  # Far from the edges.
    estimate = register(points, RigidTransform([2.52, 0.03, 0.0]))
    assert estimate.X.translation() == pytest.approx([2.5, 0.03, 0.0], abs=1e-4)
    deviations = np.sqrt(estimate.covariance.diagonal())
    assert deviations[3] < 0.01
    assert deviations[4:].min() > 0.1
    assert np.abs(estimate.error_to(X)[:3]).max() < 1e-4


def test_edges_of_a_covered_face_tell_where_it_is() -> None:
    errors = []
    for height in (0.24, 0.27, 0.29, 0.31):
        X = RigidTransform([2.5, 0.0, height])
        points = measure(0.002, seed=1, count=32, X=X)  # 4 cm apart.
        start = RigidTransform(X.rotation(), X.translation() + np.array([0.0, 0.03, -0.03]))
        estimate = register(points, start, noise=0.002)
        errors.append(estimate.error_to(X)[4:])
        assert np.sqrt(estimate.covariance.diagonal()).max() < 0.02
    assert np.abs(errors).max() < 0.015


@pytest.mark.parametrize(
    "points", [np.zeros((0, 3)), measure(0.0, seed=0)[::40], measure(0.0, seed=0) + np.array([0.9, 0.0, 0.0])]
)
def test_too_few_points_on_the_body_are_no_estimate(points: np.ndarray) -> None:
    estimate = register(points, X_AT)
    assert not estimate.valid
    assert estimate.time == 2.0


def test_deskewed_points_of_a_moving_body_are_rigid() -> None:
    v, w = np.array([-0.3, 0.05, 0.1]), np.array([0.1, -0.2, 0.4])
    times = np.linspace(-0.5, 0.0, 60)
    p_TQ = np.random.default_rng(0).uniform(-0.5, 0.5, (60, 3))
    measured = []
    for t, p in zip(times, p_TQ, strict=True):
        R = RotationMatrix(rotation_matrix(w * t)) @ X_AT.rotation()
        measured.append(RigidTransform(R, X_AT.translation() + v * t) @ p)
    fixed = deskew(np.array(measured), times, origin=X_AT.translation(), velocity=v, rate=w)
    assert fixed == pytest.approx(p_TQ @ X_AT.rotation().matrix().T + X_AT.translation(), abs=1e-12)


def test_faces_without_area_are_rejected() -> None:
    with pytest.raises(ValueError, match="positive lengths"):
        Faces.of_boxes([(RigidTransform(), (1.0, 0.0, 1.0))])
