"""Still pictures of scenes, rendered by Drake without a browser or a display."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from pydrake.geometry import HalfSpace, Mesh, Rgba, Shape
from pydrake.math import RigidTransform

from vtbdrake.common.failures import one_line
from vtbdrake.components.rendering import RenderingError, check_rendering
from vtbdrake.visualization.viewpoint import FIELD_OF_VIEW, Viewpoint

if TYPE_CHECKING:
    from pydrake.geometry import ColorRenderCamera, GeometryInstance, RenderEngine

# Name of renderer and source in a scene graph.
_NAME = "still"
# Each pixel of a picture is the mean of this number of points squared, which smooths edges.
_POINTS = 2
# Meshcat's camera sees what is nearer than this, in m.
_FARTHEST = 100.0
# Colour behind the scene.
_BACKGROUND = (0.95, 0.95, 1.0)
# Intensities of the light from the camera and of the light from above.
_LIGHTS = (0.7, 0.5)


class Still:
    """A picture of coloured shapes.

    Attributes:
        camera: From where they are looked at; None where there is nothing to look at.
        shapes: The shapes with their poses in the world and their colours.
    """

    def __init__(self, camera: Viewpoint | None = None) -> None:
        self.camera = camera
        self.shapes: list[tuple[Shape, RigidTransform, Rgba]] = []

    def add(self, shape: Shape, X_WG: RigidTransform, color: Rgba) -> None:
        """Add a shape; half spaces, which Meshcat does not show, are left out.

        Args:
            shape: The shape.
            X_WG: Its pose in the world.
            color: Its colour, with alpha as the opacity.
        """
        if not isinstance(shape, HalfSpace):
            self.shapes.append((shape, X_WG, color))

    def render(self, *, width: int = 640, height: int = 400) -> NDArray[np.uint8]:
        """Return the picture, shape (height, width, 3).

        Args:
            width: Width of the picture in pixels.
            height: Height of the picture in pixels.

        Raises:
            RenderingError: This machine cannot render, or not one of the shapes.
            ValueError: There is no camera.
        """
        return Studio(self, [], width=width, height=height).take([])

    def png(self, *, width: int = 640, height: int = 400) -> bytes:
        """Return the picture as PNG; raises as `render` does.

        Args:
            width: Width of the picture in pixels.
            height: Height of the picture in pixels.
        """
        file = io.BytesIO()
        Image.fromarray(self.render(width=width, height=height)).save(file, "png", optimize=True)
        return file.getvalue()


class Studio:
    """Takes pictures of the shapes of a still, and of shapes that move.

    Args:
        still: What stands still, and the camera.
        moving: Shapes and their colours.
        width: Width of the pictures in pixels.
        height: Height of the pictures in pixels.

    Raises:
        RenderingError: This machine cannot render, or not one of the shapes.
        ValueError: There is no camera.
    """

    def __init__(self, still: Still, moving: Sequence[tuple[Shape, Rgba]], *, width: int, height: int) -> None:
        from pydrake.geometry import GeometryFrame, SceneGraph

        if still.camera is None:
            raise ValueError("there is no camera, because nothing in the scene moves")
        check_rendering()
        self._scene_graph = SceneGraph()
        self._scene_graph.AddRenderer(_NAME, _renderer())
        self._source = self._scene_graph.RegisterSource(_NAME)
        for number, (shape, X_WG, color) in enumerate(still.shapes):
            instance = _instance(shape, X_WG, color, f"anchored {number}")
            _registered(self._scene_graph.RegisterAnchoredGeometry, self._source, instance)
        self._frames = []
        for number, (shape, color) in enumerate(moving):
            frame = self._scene_graph.RegisterFrame(self._source, GeometryFrame(f"frame {number}"))
            instance = _instance(shape, RigidTransform(), color, f"moving {number}")
            _registered(self._scene_graph.RegisterGeometry, self._source, frame, instance)
            self._frames.append(frame)
        self._context = self._scene_graph.CreateDefaultContext()
        self._camera, self._X_WC = _render_camera(still.camera, width, height), still.camera.pose

    def take(self, poses: Sequence[RigidTransform]) -> NDArray[np.uint8]:
        """Return a picture, shape (height, width, 3).

        Args:
            poses: The poses of the moving shapes in the world, in their order.
        """
        from pydrake.common.value import Value
        from pydrake.geometry import FramePoseVector

        if self._frames:
            vector = FramePoseVector()
            for frame, X_WG in zip(self._frames, poses, strict=True):
                vector.set_value(frame, X_WG)
            self._scene_graph.get_source_pose_port(self._source).FixValue(self._context, Value(vector))
        query = self._scene_graph.get_query_output_port().Eval(self._context)
        image = query.RenderColorImage(self._camera, self._scene_graph.world_frame_id(), self._X_WC).data
        return np.asarray(Image.fromarray(image[..., :3]).reduce(_POINTS))


def _renderer() -> RenderEngine:
    from pydrake.geometry import LightParameter, MakeRenderEngineVtk, RenderEngineVtkParams

    from_camera, from_above = _LIGHTS
    lights = [
        LightParameter(type="directional", frame="camera", direction=[0.0, 0.0, 1.0], intensity=from_camera),
        LightParameter(type="directional", frame="world", direction=[0.0, 0.0, -1.0], intensity=from_above),
    ]
    return MakeRenderEngineVtk(
        RenderEngineVtkParams(backend="EGL", lights=lights, default_clear_color=np.array(_BACKGROUND))
    )


def _render_camera(camera: Viewpoint, width: int, height: int) -> ColorRenderCamera:
    from pydrake.geometry import ClippingRange, ColorRenderCamera, RenderCameraCore
    from pydrake.systems.sensors import CameraInfo

    distance = float(np.linalg.norm(np.subtract(camera.position, camera.target)))
    clipping = ClippingRange(1e-3 * distance, max(_FARTHEST, 10.0 * distance))
    info = CameraInfo(_POINTS * width, _POINTS * height, FIELD_OF_VIEW)
    return ColorRenderCamera(RenderCameraCore(_NAME, info, clipping, RigidTransform()), False)


def _instance(shape: Shape, X_PG: RigidTransform, color: Rgba, name: str) -> GeometryInstance:
    from pydrake.geometry import GeometryInstance, PerceptionProperties

    geometry, properties = GeometryInstance(X_PG, shape, name), PerceptionProperties()
    if not _has_materials(shape):  # Drake would ignore the colour, and warn.
        properties.AddProperty("phong", "diffuse", color)
    geometry.set_perception_properties(properties)
    return geometry


def _registered(register: Callable[..., object], *arguments: object) -> None:
    try:
        register(*arguments)
    except RuntimeError as error:  # such as a mesh without normals, which Meshcat shows
        raise RenderingError(f"Drake cannot render a shape of the scene: {one_line(error)}") from error


def _has_materials(shape: Shape) -> bool:
    """Return whether a shape is a mesh of a file (.obj) that names its materials."""
    if not isinstance(shape, Mesh) or shape.extension() != ".obj":
        return False
    source = shape.source()
    content = source.path().read_bytes() if source.is_path() else source.in_memory().mesh_file.contents()
    return b"mtllib" in content
