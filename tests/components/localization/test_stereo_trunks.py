"""Trunks from disparities: of exact cylinders on a slope, and of textured cylinders that are rendered and matched."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from pydrake.geometry import (
    ClippingRange,
    ColorRenderCamera,
    GeometryInstance,
    MakeRenderEngineVtk,
    PerceptionProperties,
    RenderCameraCore,
    RenderEngineVtkParams,
    SceneGraph,
)
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.systems.sensors import CameraInfo, ImageRgba8U
from scipy.optimize import brentq

from vtbdrake.common.arrays import Array
from vtbdrake.components.localization.landmarks import Landmarks
from vtbdrake.components.localization.stereo_trunks import StereoTrunkDetectorConfig, detect_stereo_trunks
from vtbdrake.components.perception.stereo import StereoCamera, StereoMatcher
from vtbdrake.components.textures import grain, tiled_mesh

CAMERA = StereoCamera(640, 480, 400.0, 320.0, 240.0, 0.3)
EXACT = StereoTrunkDetectorConfig(fattening=0.0)
# C looks along x of H.
R_HC = RotationMatrix(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]))
LEVEL = RigidTransform(R_HC, [0.4, 0.1, 2.0])
# x, y, diameter in m.
TREES = np.array([[6.0, 1.0, 0.3], [9.0, -4.0, 0.2], [12.0, 3.0, 0.35], [14.0, -1.0, 0.4], [5.0, -2.5, 0.15]])
SLOPE = np.array([0.08, -0.05])


def disparity(trees: Array, X_HC: RigidTransform, *, height: float = 10.0, ground: bool = True) -> Array:
    """The exact disparities of upright cylinders on a slope, by the intersections of all rays."""
    x, y = np.meshgrid(np.arange(640) + 0.5, np.arange(480) + 0.5)
    rays_C = np.stack([(x - 320.0) / 400.0, (y - 240.0) / 400.0, np.ones_like(x)], axis=-1)
    rays, eye = rays_C @ X_HC.rotation().matrix().T, X_HC.translation()
    depth = np.full(x.shape, np.inf)
    if ground:
        # z = SLOPE . p
        with np.errstate(divide="ignore"):
            along = (SLOPE @ eye[:2] - eye[2]) / (rays[..., 2] - rays[..., :2] @ SLOPE)
        depth = np.where(along > 0.0, along, np.inf)
    for tree in trees:
        a = np.sum(rays[..., :2] ** 2, axis=-1)
        b = rays[..., :2] @ (eye[:2] - tree[:2])
        root = b**2 - a * (np.sum((eye[:2] - tree[:2]) ** 2) - (0.5 * tree[2]) ** 2)
        with np.errstate(invalid="ignore"):
            along = (-b - np.sqrt(root)) / a
        z = eye[2] + along * rays[..., 2]
        hit = (root > 0.0) & (along > 0.0) & (z < height + SLOPE @ tree[:2]) & (along < depth)
        depth = np.where(hit, along, depth)
    return np.where(np.isfinite(depth), 120.0 / depth, np.nan)


def match(found: Landmarks, trees: Array) -> NDArray[np.intp]:
    """The landmark of each tree."""
    distances = np.linalg.norm(found.positions[:, None] - trees[:, :2], axis=2)
    assert sorted(np.argmin(distances, axis=0)) == list(range(len(trees)))
    return np.argmin(distances, axis=0)


def along_and_across(vectors: Array, trees: Array, X_HC: RigidTransform) -> Array:
    """Components (n, 2) along the line of sight and across it."""
    e = trees[:, :2] - X_HC.translation()[:2]
    e /= np.linalg.norm(e, axis=1, keepdims=True)
    return np.column_stack([np.sum(vectors * e, axis=1), e[:, 0] * vectors[:, 1] - e[:, 1] * vectors[:, 0]])


@pytest.mark.parametrize(("roll", "pitch"), [(0.0, 0.0), (0.07, 0.1), (-0.06, -0.05)])
def test_exact_disparities_give_axes_and_diameters(roll: float, pitch: float) -> None:
    X_HC = RigidTransform(RotationMatrix(RollPitchYaw(roll, pitch, 0.05)) @ R_HC, LEVEL.translation())
    found = detect_stereo_trunks(disparity(TREES, X_HC), CAMERA, EXACT, X_HC=X_HC)
    assert len(found) == len(TREES)
    order = match(found, TREES)
    error = along_and_across(found.positions[order] - TREES[:, :2], TREES, X_HC)
    distance = np.linalg.norm(TREES[:, :2] - X_HC.translation()[:2], axis=1)
    pixel = distance / 400.0
    # A tenth of a pixel: half of what is assumed for disparities that are measured.
    assert (np.abs(error[:, 0]) < 0.01 + CAMERA.depth_deviation(distance, disparity_deviation=0.1)).all()
    assert (np.abs(error[:, 1]) < pixel).all()
    assert (np.abs(found.diameters[order] - TREES[:, 2]) < 2.5 * pixel).all()


def test_deviations_are_those_of_disparity_and_pixels() -> None:
    found = detect_stereo_trunks(disparity(TREES, LEVEL), CAMERA, EXACT, X_HC=LEVEL)
    covariances = found.covariances[match(found, TREES)]
    for tree, covariance in zip(TREES, covariances, strict=True):
        e = tree[:2] - LEVEL.translation()[:2]
        distance = np.linalg.norm(e)
        e /= distance
        n = np.array([-e[1], e[0]])
        expected = distance**2 / 120.0 * np.hypot(EXACT.disparity_deviation, EXACT.disparity_bias)
        assert np.sqrt(e @ covariance @ e) == pytest.approx(np.hypot(expected, EXACT.least_deviation), rel=0.03)
        across = np.hypot(EXACT.middle_deviation * distance / 400.0, EXACT.least_deviation)
        assert np.sqrt(n @ covariance @ n) == pytest.approx(across, rel=0.03)
        assert e @ covariance @ n == pytest.approx(0.0, abs=1e-4)


def test_frame_of_the_result_is_the_level_frame() -> None:
    there = RigidTransform(RotationMatrix.MakeZRotation(2.0), [3.0, -7.0, 0.0])
    image = disparity(TREES, LEVEL, ground=False)
    here = detect_stereo_trunks(image, CAMERA, EXACT, X_HC=LEVEL)
    moved = detect_stereo_trunks(image, CAMERA, EXACT, X_HC=there @ LEVEL)
    expected = here.seen_from([3.0, -7.0, 2.0])
    assert moved.positions == pytest.approx(expected.positions, abs=1e-9)
    assert moved.covariances == pytest.approx(expected.covariances, abs=1e-9)


def test_diameter_of_a_trunk_that_is_half_hidden_is_unknown() -> None:
    behind = np.array([[5.0, 0.0, 0.3], [10.0, 0.35, 0.4]])
    found = detect_stereo_trunks(disparity(behind, LEVEL, ground=False), CAMERA, EXACT, X_HC=LEVEL)
    order = match(found, behind)
    assert np.isfinite(found.diameter_deviations[order[0]])
    assert np.isinf(found.diameter_deviations[order[1]])
    error = along_and_across(found.positions[order] - behind[:, :2], behind, LEVEL)
    assert abs(error[1, 1]) < 2.0 * np.sqrt(found.covariances[order[1]][1, 1])


def test_trunk_that_the_right_camera_sees_in_part_may_be_thicker() -> None:
    """The left part of the trunk is outside of the right image."""
    tree = np.array([[6.4, 4.6, 0.4]])
    whole = disparity(tree, LEVEL, ground=False)
    cut = np.where(whole > np.arange(640), np.nan, whole)
    assert 0.2 < np.isfinite(cut).sum() / np.isfinite(whole).sum() < 0.8
    found = detect_stereo_trunks(cut, CAMERA, EXACT, X_HC=LEVEL)
    assert np.isinf(found.diameter_deviations).all()
    across = along_and_across(found.positions - tree[:, :2], tree, LEVEL)[0, 1]
    e = (tree[0, :2] - LEVEL.translation()[:2]) @ np.array([[0.0, 1.0], [-1.0, 0.0]])
    deviation = np.sqrt(e @ found.covariances[0] @ e / (e @ e))
    # What is unseen is at most as wide as what is seen.
    assert 0.03 < abs(across) < 2.0 * deviation < found.diameters[0] + 0.1


@pytest.mark.parametrize("is_left", [True, False])
def test_diameter_is_known_if_both_cameras_see_all_of_the_trunk(is_left: bool) -> None:
    """At the left edge, the left camera sees as many columns more as the disparity is."""
    distance, diameter = 8.0, 0.3

    def edges(slope: float) -> Array:
        """The columns of the lines of sight that touch the trunk."""
        half = np.arcsin(0.5 * diameter / (distance * np.hypot(1.0, slope)))
        return 320.0 + 400.0 * np.tan(np.arctan(slope) + np.array([-half, half]))

    known = []
    # The number of pixels by which the trunk lies within what both cameras see. Two pixels beside it must be seen, too.
    for inside in (0.0, 4.0):
        column, edge = (120.0 / distance + inside, 0) if is_left else (640.0 - inside, 1)
        slope = brentq(lambda slope, edge=edge, column=column: edges(slope)[edge] - column, -1.0, 1.0)
        x, y, _ = LEVEL.translation()
        tree = np.array([[x + distance, y - slope * distance, diameter]])
        found = detect_stereo_trunks(disparity(tree, LEVEL, ground=False), CAMERA, EXACT, X_HC=LEVEL)
        known.append(np.isfinite(found.diameter_deviations).tolist())
    assert known == [[False], [True]]


def test_neither_ground_nor_stumps_nor_walls_are_trunks() -> None:
    nothing = np.full((480, 640), np.nan)
    stumps = disparity(TREES, LEVEL, height=1.0)
    wall = np.full((480, 640), 120.0 / 6.0)
    for image in (nothing, disparity(TREES[:0], LEVEL), stumps, wall):
        assert len(detect_stereo_trunks(image, CAMERA, EXACT, X_HC=LEVEL)) == 0


def test_far_trunks_are_left_out() -> None:
    near = StereoTrunkDetectorConfig(reach=8.0)
    found = detect_stereo_trunks(disparity(TREES, LEVEL), CAMERA, near, X_HC=LEVEL)
    assert sorted(np.round(found.positions[:, 0])) == [5.0, 6.0]


def cylinders(trees: Array) -> tuple[Array, NDArray[np.int64]]:
    """Vertices and triangles of upright cylinders of 10 m with 24 facets."""
    angle = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
    circle = np.column_stack([np.cos(angle), np.sin(angle)])
    vertices, triangles = [], []
    for k, (x, y, diameter) in enumerate(trees):
        ring = 0.5 * diameter * circle + [x, y]
        vertices += [np.column_stack([ring, np.full(24, z)]) for z in (0.0, 10.0)]
        a, b = 48 * k + np.arange(24), 48 * k + (np.arange(24) + 1) % 24
        triangles += [np.column_stack([a, b, b + 24]), np.column_stack([a, b + 24, a + 24])]
    return np.vstack(vertices), np.vstack(triangles)


def photographed(trees: Array, info: CameraInfo, baseline: float) -> list[ImageRgba8U]:
    """The left and the right image of trees with bark."""
    scene_graph = SceneGraph()
    mesh = tiled_mesh(cylinders(trees), image=grain((0.6, 0.5, 0.4)), tile=(2.0, 16.0))
    geometry = GeometryInstance(RigidTransform(), mesh, "trees")
    geometry.set_perception_properties(PerceptionProperties())
    world = scene_graph.world_frame_id()
    scene_graph.RegisterGeometry(scene_graph.RegisterSource("trees"), world, geometry)
    scene_graph.AddRenderer("vtk", MakeRenderEngineVtk(RenderEngineVtkParams(backend="EGL")))
    query = scene_graph.get_query_output_port().Eval(scene_graph.CreateDefaultContext())
    core = ColorRenderCamera(RenderCameraCore("vtk", info, ClippingRange(0.05, 100.0), RigidTransform()))
    return [query.RenderColorImage(core, world, LEVEL @ RigidTransform([x, 0.0, 0.0])) for x in (0.0, baseline)]


def test_rendered_trunks_are_found_within_their_covariances() -> None:
    info = CameraInfo(320, 240, 200.0, 200.0, 160.0, 120.0)
    camera, matcher = StereoCamera.of(info, baseline=0.3), StereoMatcher(largest_disparity=32)
    rng = np.random.default_rng(4)
    count, squares = 12, []
    for _ in range(3):
        x, slope = rng.uniform(4.0, 12.0, count), np.linspace(-0.6, 0.6, count)
        trees = np.column_stack([x, slope * x, rng.uniform(0.15, 0.4, count)])
        disparities = matcher.disparity(*photographed(trees, info, camera.baseline))
        found = detect_stereo_trunks(disparities, camera, StereoTrunkDetectorConfig(), X_HC=LEVEL)
        assert len(found) >= count - 3
        errors = found.positions[:, None] - trees[:, :2]
        each = np.einsum("nmi,nij,nmj->nm", errors, np.linalg.inv(found.covariances), errors)
        squares.extend(each.min(axis=1))
    # A chi-square distribution with two degrees of freedom has the median 1.4, and 14 is exceeded once in 1,000.
    assert 0.2 < np.median(squares) < 2.5
    assert np.mean(np.array(squares) > 14.0) < 0.1


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"heights": (1.0, -1.0)}, "heights must be the lower one, then the upper one"),
        ({"extent": 3.0}, "extent must be below the height of the slice, 2.8 m, not 3.0"),
        ({"largest_diameter": 0.01}, "least_diameter must be"),
        ({"disparity_deviation": 0.0}, "disparity_deviation must be a finite number above 0 pixels, not 0.0"),
    ],
)
def test_impossible_detectors_are_refused(values: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        StereoTrunkDetectorConfig(**values)
