"""Still pictures of scenes, rendered by Drake without a browser or a display."""

from __future__ import annotations

import io

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from pydrake.geometry import HalfSpace, Mesh, Rgba, Shape
from pydrake.math import RigidTransform

from vtbdrake.common.failures import one_line
from vtbdrake.components.rendering import RenderingError, check_rendering
from vtbdrake.visualization.viewpoint import FIELD_OF_VIEW, Viewpoint

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
    """

    def __init__(self, camera: Viewpoint | None = None) -> None:
        self.camera = camera
        self._shapes: list[tuple[Shape, RigidTransform, Rgba]] = []

    def add(self, shape: Shape, X_WG: RigidTransform, color: Rgba) -> None:
        """Add a shape; half spaces, which Meshcat does not show, are left out.

        Args:
            shape: The shape.
            X_WG: Its pose in the world.
            color: Its colour, with alpha as the opacity.
        """
        if not isinstance(shape, HalfSpace):
            self._shapes.append((shape, X_WG, color))

    def render(self, *, width: int = 640, height: int = 400) -> NDArray[np.uint8]:
        """Return the picture, shape (height, width, 3).

        Args:
            width: Width of the picture in pixels.
            height: Height of the picture in pixels.

        Raises:
            RenderingError: This machine cannot render, or not one of the shapes.
            ValueError: There is no camera.
        """
        from pydrake.geometry import (
            ClippingRange,
            ColorRenderCamera,
            GeometryInstance,
            LightParameter,
            MakeRenderEngineVtk,
            PerceptionProperties,
            RenderCameraCore,
            RenderEngineVtkParams,
            SceneGraph,
        )
        from pydrake.systems.sensors import CameraInfo

        if self.camera is None:
            raise ValueError("there is no camera, because nothing in the scene moves")
        check_rendering()
        X_WC = self.camera.pose
        from_camera, from_above = _LIGHTS
        lights = [
            LightParameter(type="directional", frame="camera", direction=[0.0, 0.0, 1.0], intensity=from_camera),
            LightParameter(type="directional", frame="world", direction=[0.0, 0.0, -1.0], intensity=from_above),
        ]
        parameters = RenderEngineVtkParams(backend="EGL", lights=lights, default_clear_color=np.array(_BACKGROUND))
        scene_graph = SceneGraph()
        scene_graph.AddRenderer("still", MakeRenderEngineVtk(parameters))
        source = scene_graph.RegisterSource("still")
        for number, (shape, X_WG, color) in enumerate(self._shapes):
            geometry = GeometryInstance(X_WG, shape, f"{number}")
            properties = PerceptionProperties()
            if not _has_materials(shape):  # Drake would ignore the colour, and warn.
                properties.AddProperty("phong", "diffuse", color)
            geometry.set_perception_properties(properties)
            try:
                scene_graph.RegisterAnchoredGeometry(source, geometry)
            except RuntimeError as error:  # such as a mesh without normals, which Meshcat shows
                raise RenderingError(f"Drake cannot render a shape of the scene: {one_line(error)}") from error
        size = (_POINTS * width, _POINTS * height)
        distance = float(np.linalg.norm(np.subtract(self.camera.position, self.camera.target)))
        clipping = ClippingRange(1e-3 * distance, max(_FARTHEST, 10.0 * distance))
        core = RenderCameraCore("still", CameraInfo(*size, FIELD_OF_VIEW), clipping, RigidTransform())
        query = scene_graph.get_query_output_port().Eval(scene_graph.CreateDefaultContext())
        image = query.RenderColorImage(ColorRenderCamera(core, False), scene_graph.world_frame_id(), X_WC).data
        return np.asarray(Image.fromarray(image[..., :3]).reduce(_POINTS))

    def png(self, *, width: int = 640, height: int = 400) -> bytes:
        """Return the picture as PNG; raises as `render` does.

        Args:
            width: Width of the picture in pixels.
            height: Height of the picture in pixels.
        """
        file = io.BytesIO()
        Image.fromarray(self.render(width=width, height=height)).save(file, "png", optimize=True)
        return file.getvalue()


def _has_materials(shape: Shape) -> bool:
    """Return whether a shape is a mesh of a file (.obj) that names its materials."""
    if not isinstance(shape, Mesh) or shape.extension() != ".obj":
        return False
    source = shape.source()
    content = source.path().read_bytes() if source.is_path() else source.in_memory().mesh_file.contents()
    return b"mtllib" in content
