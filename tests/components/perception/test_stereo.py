"""Disparities of rendered pairs of images, against the depth that the renderer itself gives."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from numpy.typing import NDArray
from pydrake.geometry import (
    ClippingRange,
    ColorRenderCamera,
    DepthRange,
    DepthRenderCamera,
    GeometryInstance,
    MakeRenderEngineVtk,
    PerceptionProperties,
    QueryObject,
    RenderCameraCore,
    RenderEngineVtkParams,
    SceneGraph,
)
from pydrake.math import RigidTransform
from pydrake.systems.sensors import CameraInfo, ImageRgba8U

from vtbdrake.common.arrays import Array
from vtbdrake.components.perception.stereo import StereoCamera, StereoMatcher
from vtbdrake.components.textures import grain, textured_mesh

INFO = CameraInfo(320, 240, 300.0, 300.0, 150.0, 125.0)  # The axis does not meet the middle.
CAMERA = StereoCamera.of(INFO, baseline=0.3)
GREY = np.full((60, 200), 90, dtype=np.uint8)


def wall(corners: Array) -> GeometryInstance:
    """A textured quadrilateral with these corners in C, clockwise from the upper left one."""
    mesh = textured_mesh(
        corners,
        normals=np.tile([0.0, 0.0, -1.0], (4, 1)),
        coordinates=[[0.0, 1.0], [1.0, 1.0], [1.0, 0.0], [0.0, 0.0]],
        triangles=[[0, 3, 2], [0, 2, 1]],
        image=grain((0.6, 0.5, 0.4)),
    )
    geometry = GeometryInstance(RigidTransform(), mesh, f"wall {corners[0]}")
    geometry.set_perception_properties(PerceptionProperties())
    return geometry


def upright(*, left: float, right: float, depth: float) -> Array:
    return np.array([[left, -4.0, depth], [right, -4.0, depth], [right, 4.0, depth], [left, 4.0, depth]])


# From 3 m on the left to 12 m on the right.
OBLIQUE = np.array([[-2.5, -4.0, 3.0], [7.0, -12.0, 12.0], [7.0, 12.0, 12.0], [-2.5, 4.0, 3.0]])
# From 12 m above to 3 m below, as ground is.
SLOPE = np.array([[-8.0, -3.0, 12.0], [8.0, -3.0, 12.0], [8.0, 2.0, 3.0], [-8.0, 2.0, 3.0]])


class Scene:
    """Walls before the left camera, whose frame C is the world frame."""

    def __init__(self, *walls: Array) -> None:
        scene_graph = SceneGraph()
        source = scene_graph.RegisterSource("walls")
        self.world = scene_graph.world_frame_id()
        for corners in walls:
            scene_graph.RegisterGeometry(source, self.world, wall(corners))
        scene_graph.AddRenderer("vtk", MakeRenderEngineVtk(RenderEngineVtkParams(backend="EGL")))
        self.scene_graph, self.context = scene_graph, scene_graph.CreateDefaultContext()

    @property
    def query(self) -> QueryObject:
        return self.scene_graph.get_query_output_port().Eval(self.context)

    def image(self, x: float) -> ImageRgba8U:
        """Return the image of a camera at [x, 0, 0]."""
        core = RenderCameraCore("vtk", INFO, ClippingRange(0.05, 50.0), RigidTransform())
        return self.query.RenderColorImage(ColorRenderCamera(core), self.world, RigidTransform([x, 0.0, 0.0]))

    def depth(self, x: float) -> Array:
        core = RenderCameraCore("vtk", INFO, ClippingRange(0.05, 50.0), RigidTransform())
        camera = DepthRenderCamera(core, DepthRange(0.05, 50.0))
        image = self.query.RenderDepthImage(camera, self.world, RigidTransform([x, 0.0, 0.0]))
        return np.array(image.data[..., 0], dtype=float)

    def disparity(self, matcher: StereoMatcher | None = None) -> NDArray[np.float32]:
        return (matcher or StereoMatcher()).disparity(self.image(0.0), self.image(CAMERA.baseline))


@pytest.fixture(scope="module")
def oblique() -> Scene:
    return Scene(OBLIQUE)


def test_field_of_view_reaches_from_edge_to_edge() -> None:
    camera = StereoCamera(width=300, height=200, focal_length=100.0, center_x=100.0, center_y=90.0, baseline=0.3)
    # The left edge is at 45 deg from the axis, the right one at atan(2).
    assert np.degrees(camera.fov_x) == pytest.approx(45.0 + 63.434949)


def test_depth_errors_grow_with_the_square_of_depth(oblique: Scene) -> None:
    z, depth = oblique.depth(0.0), CAMERA.depth(oblique.disparity())
    known = np.isfinite(depth) & np.isfinite(z)
    assert known.mean() > 0.8
    for nearest, farthest in ((3.0, 5.0), (5.0, 8.0), (8.0, 12.0)):
        band = known & (z > nearest) & (z < farthest)
        error = (depth[band] - z[band]) / CAMERA.depth_deviation(z[band], disparity_deviation=1.0)  # In pixels.
        # By the left edge, some pixels that the right camera does not see find a wrong match.
        assert np.mean(np.abs(error) > 1.0) < 0.03
        assert 0.02 < error[np.abs(error) < 1.0].std() < 0.25
        assert abs(np.median(error)) < 0.08


def test_eight_directions_have_no_bias_on_slopes() -> None:
    scene = Scene(SLOPE)
    true = CAMERA.focal_length * CAMERA.baseline / scene.depth(0.0)
    errors = {count: scene.disparity(StereoMatcher(directions=count)) - true for count in (3, 5, 8)}
    bias = {count: abs(np.nanmedian(error)) for count, error in errors.items()}
    assert bias[8] < 0.04
    assert bias[5] > 0.1


def test_points_of_exact_disparities_lie_on_the_wall(oblique: Scene) -> None:
    true = CAMERA.focal_length * CAMERA.baseline / oblique.depth(0.0)
    points = CAMERA.points(np.where(np.isfinite(true), true, np.nan))
    normal = np.cross(OBLIQUE[1] - OBLIQUE[0], OBLIQUE[3] - OBLIQUE[0])
    distance = (points - OBLIQUE[0]) @ normal / np.linalg.norm(normal)
    # Half a pixel beside would be 4 to 16 mm.
    assert np.nanmax(np.abs(distance)) < 1e-3
    assert np.isnan(points).any(axis=2).sum() == np.isinf(true).sum() + np.isnan(true).sum() + (true == 0).sum()


def test_what_only_one_camera_sees_stays_unknown() -> None:
    scene = Scene(upright(left=-0.5, right=0.5, depth=3.0), upright(left=-8.0, right=8.0, depth=9.0))
    left, right = scene.depth(0.0), scene.depth(CAMERA.baseline)
    columns = np.arange(INFO.width()) - CAMERA.focal_length * CAMERA.baseline / left
    inside = np.clip(np.rint(columns), 0, INFO.width() - 1).astype(int)
    hidden = (columns >= 0.0) & (np.take_along_axis(right, inside, axis=1) < left - 1.0)
    disparity = scene.disparity()
    assert hidden.sum() > 2000
    assert np.isnan(disparity[hidden]).mean() > 0.75
    assert np.isnan(disparity[:, 1:9]).mean() > 0.75  # Its place would be beside the right image.
    seen = ~hidden & np.isfinite(disparity)
    assert np.mean(np.abs(disparity - CAMERA.focal_length * CAMERA.baseline / left)[seen] > 1.0) < 0.03


def test_nothing_is_known_without_texture() -> None:
    assert np.isnan(StereoMatcher().disparity(GREY, GREY)).all()
    ramp = GREY + np.linspace(0.0, 60.0, 60)[:, np.newaxis].astype(np.uint8)  # From top to bottom says nothing either.
    assert np.isnan(StereoMatcher().disparity(ramp, ramp)).all()
    noise = np.random.default_rng(1).normal(scale=1.0, size=(2, *GREY.shape))
    left, right = np.rint(GREY + noise).astype(np.uint8)
    assert np.isnan(StereoMatcher().disparity(left, right)).mean() > 0.99


def test_equal_images_show_nothing_at_a_finite_depth(oblique: Scene) -> None:
    image = oblique.image(0.0)
    disparity = StereoMatcher().disparity(image, image)
    assert np.nanmax(disparity) == 0.0
    assert np.isnan(CAMERA.points(disparity)).all()
    assert CAMERA.depth(0.0) == np.inf


def test_images_of_different_sizes_are_refused() -> None:
    with pytest.raises(ValueError, match="same size, not 200 x 60 and 100 x 60 pixels"):
        StereoMatcher().disparity(GREY, GREY[:, :100])
    with pytest.raises(ValueError, match=r"shape \(240, 320\)"):
        CAMERA.points(np.zeros((60, 200)))


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"largest_disparity": 50}, "multiple of 16 pixels, not 50"),
        ({"block": 4}, "odd number of pixels, not 4"),
        ({"directions": 4}, "directions must be one of 3, 5, 8, not 4"),
        ({"texture": -1.0}, "StereoMatcher.texture must be a number of at least 0, not -1.0"),
    ],
)
def test_matchers_that_cannot_be_are_refused(values: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        StereoMatcher(**values)


def test_cameras_that_cannot_be_are_refused() -> None:
    with pytest.raises(ValueError, match="StereoCamera.baseline must be a finite number above 0 m, not -0.1"):
        StereoCamera.of(INFO, baseline=-0.1)
    with pytest.raises(ValueError, match="square: .* not 300 and 310"):
        StereoCamera.of(CameraInfo(320, 240, 300.0, 310.0, 160.0, 120.0), baseline=0.3)


def test_missing_opencv_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(ImportError, match=r"vtbdrake\[perception\]"):
        StereoMatcher().disparity(GREY, GREY)
