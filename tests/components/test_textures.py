"""Textures, as a decoder and a renderer see them."""

from __future__ import annotations

import numpy as np
import pytest
from pydrake.geometry import (
    ClippingRange,
    ColorRenderCamera,
    GeometryInstance,
    LightParameter,
    MakeRenderEngineVtk,
    Mesh,
    PerceptionProperties,
    RenderCameraCore,
    RenderEngineVtkParams,
    SceneGraph,
)
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.systems.sensors import CameraInfo

from vtbdrake.components.textures import grain, png, tiled_mesh

cv2 = pytest.importorskip("cv2")


def photograph(mesh: Mesh, X_WC: RigidTransform) -> np.ndarray:
    """Red, green and blue of a mesh at 100 pixels per metre and metre of distance."""
    scene_graph = SceneGraph()
    geometry = GeometryInstance(RigidTransform(), mesh, "mesh")
    geometry.set_perception_properties(PerceptionProperties())
    world = scene_graph.world_frame_id()
    scene_graph.RegisterGeometry(scene_graph.RegisterSource("mesh"), world, geometry)
    light = LightParameter(type="directional", frame="camera", direction=[0.0, 0.0, 1.0])
    scene_graph.AddRenderer("vtk", MakeRenderEngineVtk(RenderEngineVtkParams(backend="EGL", lights=[light])))
    core = RenderCameraCore(
        "vtk", CameraInfo(200, 200, 100.0, 100.0, 100.0, 100.0), ClippingRange(0.01, 9.0), RigidTransform()
    )
    query = scene_graph.get_query_output_port().Eval(scene_graph.CreateDefaultContext())
    return np.array(query.RenderColorImage(ColorRenderCamera(core), world, X_WC).data[..., :3])


# Red, green, blue and white, from the upper left clockwise, in each tile.
QUARTERS = np.array([[[255, 0, 0], [0, 255, 0]], [[255, 255, 255], [0, 0, 255]]], dtype=np.uint8).repeat(16, 0)
QUARTERS = QUARTERS.repeat(16, 1)
SQUARE = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
TWO = np.array([[0, 1, 2], [0, 2, 3]])


def test_tiles_lie_at_their_places_on_level_ground() -> None:
    ground = np.column_stack([SQUARE, np.zeros(4)])
    above = RigidTransform(RollPitchYaw(np.pi, 0.0, 0.0), [0.0, 0.0, 1.0])  # The image's x is the world's.
    image = photograph(tiled_mesh((ground, TWO), image=QUARTERS, tile=(2.0, 2.0)), above)
    for (x, y), color in {
        (0.4, 0.4): (255, 255, 255),
        (0.4, -0.4): (255, 0, 0),
        (-0.4, 0.4): (0, 0, 255),
        (-0.4, -0.4): (0, 255, 0),
    }.items():
        assert np.abs(image[int(100 - 100 * y), int(100 + 100 * x)] - np.array(color, dtype=float)).max() < 10, (x, y)


def test_tiles_stand_upright_on_walls() -> None:
    # The wall x = 0 from the side of negative x: y points to the left.
    wall = np.column_stack([np.zeros(4), -SQUARE[:, 0], SQUARE[:, 1]])
    before = RigidTransform(RollPitchYaw(-np.pi / 2, 0.0, -np.pi / 2), [-1.0, 0.0, 0.0])
    image = photograph(tiled_mesh((wall, TWO), image=QUARTERS, tile=(2.0, 4.0)), before)
    # One metre above the origin is the middle of a tile that is 4 m high.
    for (y, z), color in {(0.4, 0.5): (255, 255, 255), (0.4, -0.5): (255, 0, 0), (-0.4, 0.5): (0, 0, 255)}.items():
        assert np.abs(image[int(100 - 100 * z), int(100 - 100 * y)] - np.array(color, dtype=float)).max() < 10, (y, z)


def test_triangles_larger_than_the_image_are_refused() -> None:
    with pytest.raises(ValueError, match=r"extends over 2 x 2 m, more than the image of 0.5 x 3 m: give a larger"):
        tiled_mesh((np.column_stack([SQUARE, np.zeros(4)]), TWO), image=QUARTERS, tile=(0.5, 3.0))


def test_png_holds_the_colours() -> None:
    image = np.random.default_rng(0).integers(0, 256, (5, 7, 3), dtype=np.uint8)
    decoded = cv2.imdecode(np.frombuffer(png(image), dtype=np.uint8), cv2.IMREAD_COLOR)
    assert np.array_equal(decoded[..., ::-1], image)
    grey = cv2.imdecode(np.frombuffer(png(image[..., 0]), dtype=np.uint8), cv2.IMREAD_COLOR)
    assert np.array_equal(grey, np.repeat(image[..., :1], 3, axis=2))


def test_grain_repeats_without_a_seam() -> None:
    image = grain((0.5, 0.3, 0.2), seed=2).astype(float)
    assert image.mean(axis=(0, 1)) == pytest.approx([127.5, 76.5, 51.0], abs=2.0)
    for axis in (0, 1):
        inside = np.abs(np.diff(image, axis=axis)).mean()
        seam = np.abs(np.take(image, 0, axis) - np.take(image, -1, axis)).mean()
        assert 0.8 * inside < seam < 1.25 * inside
    assert np.array_equal(image, grain((0.5, 0.3, 0.2), seed=2))
    assert not np.array_equal(image, grain((0.5, 0.3, 0.2), seed=3))
