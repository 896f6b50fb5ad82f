"""Markers in rendered images, and the poses that follow from their corners."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from pydrake.common.eigen_geometry import AngleAxis
from pydrake.geometry import (
    ClippingRange,
    ColorRenderCamera,
    MakeRenderEngineVtk,
    RenderCameraCore,
    RenderEngineVtkParams,
)
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.multibody.tree import SpatialInertia
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Diagram, DiagramBuilder
from pydrake.systems.sensors import CameraInfo, ImageRgba8U

from vtbdrake.components.environment import Light, LightConfig
from vtbdrake.components.perception.markers import (
    Detections,
    MarkerBoard,
    MarkerDetectorConfig,
    add_markers,
    check_marker_size,
    detect_markers,
    pose_from_markers,
)
from vtbdrake.components.sensors import ErrorModel
from vtbdrake.components.sensors.camera import Camera, connect_camera
from vtbdrake.state.systems import collect

INTRINSICS = np.array([400.0, 410.0, 150.0, 125.0])  # Not in the middle, and not square.


def project(points: np.ndarray, X_CT: RigidTransform, intrinsics: np.ndarray) -> np.ndarray:
    """Return the pixels (n, 2) of points of T (n, 3), by the pinhole equations."""
    fx, fy, cx, cy = intrinsics
    x, y, z = X_CT.multiply(points.T)
    return np.stack([fx * x / z + cx, fy * y / z + cy], axis=1)


def board(size: float = 0.16) -> MarkerBoard:
    """Four markers that face along -z of T, in two planes, one of them turned."""
    away = RotationMatrix.MakeXRotation(np.pi)
    places = {3: (-0.3, -0.2, 0.0), 7: (0.3, -0.2, 0.1), 11: (-0.25, 0.2, 0.1), 580: (0.2, 0.25, 0.0)}
    poses = {k: RigidTransform(away, p) for k, p in places.items()}
    poses[7] = RigidTransform(away @ RotationMatrix.MakeZRotation(0.7), places[7])
    return MarkerBoard.of(poses, size=size)


@pytest.fixture(scope="module")
def world() -> Diagram:
    """A plant with the board on its only body."""
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 0.01)
    body = plant.AddRigidBody("target", SpatialInertia.SolidBoxWithMass(1.0, 1.0, 1.0, 1.0))
    add_markers(plant, body, board())
    plant.Finalize()
    scene_graph.AddRenderer("vtk", MakeRenderEngineVtk(RenderEngineVtkParams(backend="EGL")))
    return builder.Build()


def photograph(world: Diagram, X_CT: RigidTransform) -> ImageRgba8U:
    plant, scene_graph = world.GetSubsystemByName("plant"), world.GetSubsystemByName("scene_graph")
    context = world.CreateDefaultContext()
    body = plant.GetBodyByName("target")
    plant.SetFreeBodyPose(plant.GetMyMutableContextFromRoot(context), body, X_CT)
    info = CameraInfo(320, 240, *INTRINSICS)
    core = RenderCameraCore("vtk", info, ClippingRange(0.05, 20.0), RigidTransform())
    query = scene_graph.get_query_output_port().Eval(scene_graph.GetMyContextFromRoot(context))
    return query.RenderColorImage(ColorRenderCamera(core), scene_graph.world_frame_id(), RigidTransform())


OBLIQUE = RigidTransform(RollPitchYaw(0.3, -0.4, 0.5), [0.05, -0.1, 1.9])


def test_rendered_corners_are_where_the_pinhole_equations_say(world: Diagram) -> None:
    found = detect_markers(photograph(world, OBLIQUE))
    assert sorted(found.ids) == [3, 7, 11, 580]
    p_CQ = board().corners[board().find(found.ids)] @ OBLIQUE.rotation().matrix().T + OBLIQUE.translation()
    expected = INTRINSICS[:2] * p_CQ[..., :2] / p_CQ[..., 2:] + INTRINSICS[2:]
    error = found.corners - expected
    assert np.sqrt(np.mean(error**2)) < 0.2
    assert np.abs(error.mean(axis=(0, 1))).max() < 0.1  # Half a pixel of shift would show here.


@pytest.mark.parametrize(("refinement", "limit"), [("lines", 0.2), ("none", 1.0)])
def test_refinement_decides_the_accuracy(world: Diagram, refinement: str, limit: float) -> None:
    found = detect_markers(photograph(world, OBLIQUE), MarkerDetectorConfig(refinement=refinement))
    expected = project(board().corners[board().find(found.ids)].reshape(-1, 3), OBLIQUE, INTRINSICS)
    rms = np.sqrt(np.mean((found.corners.reshape(-1, 2) - expected) ** 2))
    assert limit / 5.0 < rms < limit


def test_upscaling_finds_smaller_markers_and_each_once(world: Diagram) -> None:
    """The markers are 8 pixels wide; what is found as it is stays as it was."""
    plain, finer = 0, 0
    for k in range(6):
        X_CT = RigidTransform(RollPitchYaw(0.05 * k, -0.03 * k, 0.3 * k), [0.03 * k, -0.1, 5.7])
        image = photograph(world, X_CT)
        first = detect_markers(image, MarkerDetectorConfig(min_width=4.0))
        found = detect_markers(image, MarkerDetectorConfig(min_width=4.0, upscaling=2))
        assert len(found.ids) == len(set(found.ids))
        np.testing.assert_array_equal(found.corners[: len(first.ids)], first.corners)
        expected = project(board().corners[board().find(found.ids)].reshape(-1, 3), X_CT, INTRINSICS)
        assert np.median(np.abs(found.corners.reshape(-1, 2) - expected)) < 0.5
        plain, finer = plain + len(first.ids), finer + len(found.ids)
    assert finer > 1.2 * plain > 0


def test_smallest_width_counts_in_pixels_of_any_image(world: Diagram) -> None:
    image = detect_markers(photograph(world, OBLIQUE)).corners
    narrowest = np.linalg.norm(np.diff(image, axis=1), axis=2).min()
    grey = photograph(world, OBLIQUE).data[:, :, 0]
    wider = np.pad(grey, ((0, 300), (0, 700)), mode="edge")  # The same markers, in an image three times as wide.
    for data in (grey, wider):
        found = detect_markers(np.ascontiguousarray(data), MarkerDetectorConfig(min_width=0.8 * narrowest))
        assert len(found.ids) == 4
        assert not len(detect_markers(np.ascontiguousarray(data), MarkerDetectorConfig(min_width=2.0 * narrowest)).ids)


def test_pose_from_an_image_is_within_its_covariance(world: Diagram) -> None:
    distances = []
    for turn in np.linspace(-0.4, 0.4, 8):
        X_CT = RigidTransform(RollPitchYaw(turn, -0.2 * turn, 2.0 * turn), [0.05, 0.0, 2.0])
        estimate = pose_from_markers(detect_markers(photograph(world, X_CT)), board(), INTRINSICS, time=1.5)
        assert estimate.valid
        assert estimate.time == 1.5
        error = estimate.error_to(X_CT)
        assert np.linalg.norm(error[3:]) < 0.006
        distances.append(error @ np.linalg.solve(estimate.covariance, error))
    assert np.mean(distances) < 12.0  # 6 are expected of independent errors of the corners.


@pytest.fixture(scope="module")
def photographed() -> tuple[Diagram, Camera]:
    """The board before a camera whose pixels are means of four points, with noise, in light of 0.7."""
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 0.01)
    body = plant.AddRigidBody("target", SpatialInertia.SolidBoxWithMass(1.0, 1.0, 1.0, 1.0))
    add_markers(plant, body, board())
    plant.Finalize()
    info = CameraInfo(320, 240, *INTRINSICS)
    options = {"info": info, "supersampling": 2, "errors": ErrorModel(noise=1.0)}
    camera = builder.AddNamedSystem("camera", Camera(plant, plant.world_frame(), period=0.1, **options))
    light = builder.AddNamedSystem("light", Light(LightConfig(direction=[0.3, 0.2, 1.0], intensity=0.7)))
    connect_camera(builder, camera, scene_graph, light=light)
    return builder.Build(), camera


@pytest.mark.slow
@pytest.mark.parametrize("distance", [1.8, 2.6, 4.0])
def test_errors_of_poses_are_as_large_as_their_covariances_say(photographed: tuple, distance: float) -> None:
    diagram, camera = photographed
    plant, generator = diagram.GetSubsystemByName("plant"), np.random.default_rng(int(10 * distance))
    body, squares, depths, corner_errors = plant.GetBodyByName("target"), [], [], []
    for seed in range(25):
        tilt = RollPitchYaw(*generator.uniform(-0.5, 0.5, 2), generator.uniform(-np.pi, np.pi))
        X_CT = RigidTransform(tilt, [*(0.05 * distance * generator.uniform(-1.0, 1.0, 2)), distance])
        context = diagram.CreateDefaultContext()
        plant.SetFreeBodyPose(plant.GetMyMutableContextFromRoot(context), body, X_CT)
        collect(diagram).write(context, {"camera.seed": seed})
        Simulator(diagram, context).Initialize()
        image = camera.GetOutputPort("color_image").Eval(camera.GetMyContextFromRoot(context))
        seen = detect_markers(image, MarkerDetectorConfig(min_width=4.0)).on(board())
        if len(seen.ids) < 3:
            continue
        expected = project(board().corners[board().find(seen.ids)].reshape(-1, 3), X_CT, INTRINSICS)
        corner_errors.append((seen.corners.reshape(-1, 2) - expected).ravel())
        estimate = pose_from_markers(seen, board(), INTRINSICS, time=0.0, prediction=X_CT)
        error = estimate.error_to(X_CT)
        squares.append(error @ np.linalg.solve(estimate.covariance, error))
        depths.append(error[5])
    assert len(squares) > 15
    assert np.sqrt(np.mean(np.concatenate(corner_errors) ** 2)) < 0.1
    # 6 are expected of errors that are exactly as large as supposed.
    assert 1.0 < np.mean(squares) < 8.0
    assert sum(square > 22.5 for square in squares) <= 1  # 0.1 % of chi-squared.
    assert abs(np.mean(depths)) < 4.0 * np.std(depths) / np.sqrt(len(depths)) + 2e-4


def errors_and_covariance(distance: float, *, count: int, noise: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the errors of poses from noisy corners (count, 6), and the covariance that they are told to have."""
    X_CT = RigidTransform(RollPitchYaw(0.3, -0.4, 0.5), [0.0, 0.0, distance])
    exact = project(board().corners.reshape(-1, 3), X_CT, INTRINSICS).reshape(-1, 4, 2)
    generator = np.random.default_rng(1)
    errors, options = [], {"corner_noise": noise, "edge_shift": 0.0}
    for _ in range(count):
        noisy = Detections(board().ids, exact + noise * generator.standard_normal(exact.shape))
        estimate = pose_from_markers(
            noisy, board(), INTRINSICS, time=0.0, prediction=X_CT, residual_limit=5.0 * noise, **options
        )
        errors.append(estimate.error_to(X_CT))
    exactly = pose_from_markers(Detections(board().ids, exact), board(), INTRINSICS, time=0.0, **options)
    return np.array(errors), exactly.covariance


@pytest.mark.slow
def test_covariance_is_that_of_many_noisy_poses() -> None:
    errors, covariance = errors_and_covariance(3.0, count=400, noise=0.05)
    whitened = np.linalg.solve(np.linalg.cholesky(covariance), errors.T)
    assert np.cov(whitened) == pytest.approx(np.eye(6), abs=0.3)


@pytest.mark.slow
def test_depth_error_grows_with_the_square_of_distance() -> None:
    near, far = (errors_and_covariance(z, count=150, noise=0.02)[0][:, 5].std() for z in (4.0, 12.0))
    assert far / near == pytest.approx(9.0, rel=0.25)


def test_no_marker_is_no_estimate() -> None:
    found = detect_markers(np.full((240, 320), 128, dtype=np.uint8))
    assert len(found.ids) == 0
    assert not pose_from_markers(found, board(), INTRINSICS, time=0.0).valid


def test_single_marker_needs_a_prediction() -> None:
    exact = project(board().corners.reshape(-1, 3), OBLIQUE, INTRINSICS).reshape(-1, 4, 2)
    one = Detections(board().ids[:1], exact[:1])
    assert not pose_from_markers(one, board(), INTRINSICS, time=0.0).valid
    nearby = OBLIQUE @ RigidTransform(RollPitchYaw(0.05, 0.05, 0.0), [0.02, 0.0, 0.1])
    estimate = pose_from_markers(one, board(), INTRINSICS, time=0.0, prediction=nearby)
    assert estimate.error_to(OBLIQUE) == pytest.approx(np.zeros(6), abs=1e-6)


def flat_poses(distance: float, tilts: tuple[float, float], *, helped: bool = False) -> list[float]:
    """Return the squared Mahalanobis distances of the errors of 300 poses from three noisy markers in one plane.

    Args:
        distance: From the camera in m.
        tilts: The least and the largest angle between the plane's normal and the z axis of the camera, in rad.
        helped: Whether there is a prediction, 5 deg beside the truth.
    """
    away = RotationMatrix.MakeXRotation(np.pi)
    places = {3: (-0.15, -0.1, 0.0), 7: (0.15, -0.1, 0.0), 11: (0.02, 0.15, 0.0)}
    flat = MarkerBoard.of({k: RigidTransform(away, p) for k, p in places.items()}, size=0.1)
    generator, noise, found = np.random.default_rng(2), 0.15, []
    for _ in range(300):
        tilt, towards, turn = generator.uniform([tilts[0], -np.pi, -np.pi], [tilts[1], np.pi, np.pi])
        axis = AngleAxis(tilt, [np.cos(towards), np.sin(towards), 0.0])
        X_CT = RigidTransform(RotationMatrix(axis) @ RotationMatrix.MakeZRotation(turn), [0.0, 0.1, distance])
        exact = project(flat.corners.reshape(-1, 3), X_CT, INTRINSICS).reshape(-1, 4, 2)
        seen = Detections(flat.ids, exact + noise * generator.standard_normal(exact.shape))
        prediction = X_CT @ RigidTransform(RollPitchYaw(0.06, 0.06, 0.0), [0.0, 0.0, 0.0]) if helped else None
        options = {"prediction": prediction, "corner_noise": noise, "edge_shift": 0.0}
        estimate = pose_from_markers(seen, flat, INTRINSICS, time=0.0, **options)
        error = estimate.error_to(X_CT)
        found += [error @ np.linalg.solve(estimate.covariance, error)] if estimate.valid else []
    return found


def test_two_poses_that_fit_alike_are_no_estimate() -> None:
    found = flat_poses(5.0, (0.2, 0.8))
    # The better fit alone is wrong in 8 of 300.
    assert 150 < len(found) < 290
    assert sum(distance > 40.0 for distance in found) <= 1
    assert np.mean(found) == pytest.approx(6.0, abs=1.0)


def test_prediction_tells_two_poses_apart() -> None:
    found = flat_poses(5.0, (0.2, 0.8), helped=True)
    assert len(found) == 300
    assert sum(distance > 40.0 for distance in found) <= 1


@pytest.mark.slow
def test_covariance_covers_both_tilts_of_a_front_view() -> None:
    found = flat_poses(5.0, (0.0, 0.2))
    assert len(found) > 200
    assert sum(distance > 40.0 for distance in found) <= 1
    assert np.mean(found) == pytest.approx(6.0, abs=1.0)


def test_corners_that_do_not_fit_the_board_are_no_estimate() -> None:
    exact = project(board().corners.reshape(-1, 3), OBLIQUE, INTRINSICS).reshape(-1, 4, 2)
    assert pose_from_markers(Detections(board().ids, exact), board(), INTRINSICS, time=0.0).valid
    exchanged = Detections(board().ids[[1, 0, 2, 3]], exact)
    assert not pose_from_markers(exchanged, board(), INTRINSICS, time=0.0).valid


def test_corners_that_are_no_markers_are_no_estimate() -> None:
    together = Detections(board().ids, np.full((4, 4, 2), 100.0))
    assert not pose_from_markers(together, board(), INTRINSICS, time=0.0).valid
    with pytest.raises(ValueError, match="corners of markers are finite"):
        pose_from_markers(Detections(board().ids, np.full((4, 4, 2), np.nan)), board(), INTRINSICS, time=0.0)


def test_marker_that_the_board_lacks_is_ignored() -> None:
    found = Detections(np.array([5, 3, 3]), np.zeros((3, 4, 2)))
    assert found.on(board()).ids.tolist() == [3]


def test_marker_size_other_than_the_models_is_an_error(world: Diagram) -> None:
    inspector = world.GetSubsystemByName("scene_graph").model_inspector()
    check_marker_size(board(), inspector)
    with pytest.raises(ValueError, match=r"edges of 0.16 m, but the board of the detector says 0.1 m"):
        check_marker_size(board(0.1), inspector)


@pytest.mark.parametrize(
    ("ids", "size", "message"),
    [([1, 1], 0.1, "differ"), ([600, 1], 0.1, "586"), ([1, 2], 0.0, "positive length")],
)
def test_impossible_board_is_rejected(ids: list[int], size: float, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        MarkerBoard(np.array(ids), np.zeros((2, 3, 4)), size)


@pytest.mark.parametrize(("ids", "shape"), [([[1, 2]], (1, 3, 4)), ([], (0, 3, 4)), ([1, 2], (1, 3, 4))])
def test_board_whose_arrays_do_not_fit_is_rejected(ids: list[int], shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=r"has ids \(n,\) and poses \(n, 3, 4\), not"):
        MarkerBoard(np.array(ids), np.zeros(shape), 0.1)


def test_impossible_detector_is_rejected() -> None:
    with pytest.raises(ValueError, match="refinement must be one of lines, subpixel, none, not 'apriltag'"):
        MarkerDetectorConfig(refinement="apriltag")


def test_missing_opencv_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(ImportError, match=r"pip install 'vtbdrake\[perception\]"):
        detect_markers(np.zeros((8, 8), dtype=np.uint8))
