"""The geometry of a testbed in Meshcat, in the poses of any of its contexts."""

from __future__ import annotations

from enum import Flag
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.colors import to_rgb
from numpy.typing import NDArray
from pydrake.geometry import CalcObb, FrameId, GeometryId, Meshcat, QueryObject, Rgba, Role, SceneGraphInspector, Shape
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import Context

from vtbdrake.testbed import VirtualTestbed
from vtbdrake.visualization.still import Still
from vtbdrake.visualization.viewpoint import Viewpoint, fitting_camera

if TYPE_CHECKING:
    from matplotlib.typing import ColorType
    from numpy.typing import NDArray

# Brightness of the primaries of sRGB, to the eye.
_BRIGHTNESS = np.array([0.2126, 0.7152, 0.0722])

_CORNERS = np.array(list(product((-1.0, 1.0), repeat=3)))
# What moves in a live view gets a field of view that is larger than it needs by this factor.
_ROOM = 1.3
# Assumed width over height of the page beside its panel.
_ASPECT = 0.8


class Parts(Flag):
    """The parts of a scene that are drawn."""

    MOVING = 1
    ANCHORED = 2
    ALL = MOVING | ANCHORED


class Drawing:
    """What a testbed looks like, below a path in Meshcat.

    The objects are sent once; afterwards `pose` sends the poses of the moving frames, for any context of the testbed:
    of the simulation, or of a fork. So several drawings of a testbed show its futures side by side.

    Args:
        meshcat: The server that shows it; only the thread that made it may use it.
        testbed: A testbed with a SceneGraph.
        context: A root context of the testbed, whose poses are shown first.
        path: Where it is drawn; what is there is deleted.
        tint: Colour of the moving frames, any matplotlib colour; their brightness stays. Their own colours if left out.
        opacity: Opacity of the moving frames, in (0, 1].
        parts: Whether moving frames, anchored geometry or both are drawn.

    Raises:
        ValueError: The testbed has no SceneGraph.
    """

    def __init__(
        self,
        meshcat: Meshcat,
        testbed: VirtualTestbed,
        context: Context,
        path: str,
        *,
        tint: ColorType | None = None,
        opacity: float = 1.0,
        parts: Parts = Parts.ALL,
    ) -> None:
        if testbed.scene_graph is None:
            raise ValueError(f"{testbed!r} has no SceneGraph, so that there is nothing to draw")
        self.path = path
        self._looks: dict[str, Any] = {"tint": tint, "opacity": opacity, "parts": parts}
        self._testbed = testbed
        self._meshcat, self._scene_graph, self._plant = meshcat, testbed.scene_graph, testbed.plant
        query = self._query(context)
        inspector = query.inspector()
        self._frames: list[tuple[FrameId, str]] = []
        self._shapes: list[tuple[GeometryId, Rgba, bool]] = []  # with colour, and whether it moves
        self._boxes: list[tuple[FrameId, NDArray[np.float64]]] | None = None  # the corners in each frame, see `corners`
        meshcat.Delete(path)
        for frame in inspector.GetAllFrameIds():
            moves = frame != inspector.world_frame_id() and not is_anchored(testbed.plant, frame)
            geometries = inspector.GetGeometries(frame, Role.kIllustration)
            if not geometries or not parts & (Parts.MOVING if moves else Parts.ANCHORED):
                continue
            place = f"{path}/{inspector.GetName(frame)}".replace("::", "/")
            for geometry in geometries:
                color = illustration_color(inspector, geometry)
                color = tinted_color(color, tint, opacity) if moves else color
                self._shapes.append((geometry, color, moves))
                part = f"{place}/{inspector.GetName(geometry)}-{geometry.get_value()}".replace("::", "/")
                meshcat.SetObject(part, inspector.GetShape(geometry), color)
                meshcat.SetTransform(part, inspector.GetPoseInFrame(geometry))
            if moves:
                self._frames.append((frame, place))
            else:
                meshcat.SetTransform(place, query.GetPoseInWorld(frame))
        self.pose(context)

    @property
    def places(self) -> tuple[str, ...]:
        """Return the paths of the moving frames."""
        return tuple(place for _, place in self._frames)

    @property
    def floating(self) -> str:
        """Return the path of the body that floats, if there is one only: the base of a robot that walks away."""
        plant = self._plant
        if plant is None:
            return ""
        bases = plant.GetFloatingBaseBodies()
        floating = [place for frame, place in self._frames if plant.GetBodyFromFrameId(frame).index() in bases]
        return floating[0] if len(bases) == len(floating) == 1 else ""

    def pose(self, context: Context, *, time_in_recording: float | None = None) -> None:
        """Show the poses of a root context of the testbed; of a recording, at a time in seconds.

        Args:
            context: A root context of the testbed.
            time_in_recording: The time in a recording of Meshcat, in seconds; None: the poses are shown now.
        """
        query = self._query(context)
        for frame, place in self._frames:
            self._meshcat.SetTransform(place, query.GetPoseInWorld(frame), time_in_recording)

    def _query(self, context: Context) -> QueryObject:
        return self._scene_graph.get_query_output_port().Eval(self._scene_graph.GetMyContextFromRoot(context))

    def positions(self, context: Context) -> NDArray[np.float64]:
        """Return the origins of the moving frames in the world in m, shape (n, 3)."""
        query = self._query(context)
        return np.array([query.GetPoseInWorld(frame).translation() for frame, _ in self._frames]).reshape(-1, 3)

    def corners(self, context: Context) -> NDArray[np.float64]:
        """Return the corners of the boxes around what moves, in the world frame, shape (3, n)."""
        query = self._query(context)
        if self._boxes is None:
            self._boxes = [(frame, _boxes(query.inspector(), frame)) for frame, _ in self._frames]
        return np.hstack([np.empty((3, 0)), *(query.GetPoseInWorld(frame) @ box for frame, box in self._boxes)])

    def diagonal(self, context: Context) -> float:
        """Return the diagonal of the box around what moves, in m; 0 if nothing does."""
        corners = self.corners(context)
        return float(np.linalg.norm(np.ptp(corners, axis=1))) if corners.size else 0.0

    def fit_camera(self, context: Context, camera: Viewpoint | None = None) -> None:
        """Move the camera so that what moves is in view, with room around it; or to a camera.

        Args:
            context: A root context of the testbed, whose poses are to be in view.
            camera: The camera to move to; None: one that fits.
        """
        corners = self.corners(context)
        if camera is None and corners.size:
            camera = fitting_camera(corners, margin=_ROOM, aspect=_ASPECT)
        if camera is not None:
            self._meshcat.SetCameraPose(camera.position, camera.target)

    def add_to(
        self,
        still: Still,
        context: Context,
        *,
        parts: Parts = Parts.ALL,
        opacity: float = 1.0,
        X_WP: RigidTransform | None = None,
    ) -> None:
        """Add what is drawn to a still picture, in the poses of a context.

        Args:
            still: The picture.
            context: A root context of the testbed.
            parts: The parts of what is drawn that are added.
            opacity: A factor of the opacity of what moves.
            X_WP: The pose of the path in Meshcat, if it has been displaced.
        """
        query = self._query(context)
        inspector = query.inspector()
        for geometry, color, moves in self._shapes:
            if not parts & (Parts.MOVING if moves else Parts.ANCHORED):
                continue
            X_PG = RigidTransform(query.GetPoseInWorld(geometry))  # a copy: Drake returns a reference
            still.add(
                inspector.GetShape(geometry),
                X_PG if X_WP is None else X_WP @ X_PG,
                Rgba(color.r(), color.g(), color.b(), color.a() * (opacity if moves else 1.0)),
            )

    def moving(self) -> list[tuple[Shape, Rgba]]:
        """Return the shapes that move, and their colours."""
        inspector = self._scene_graph.model_inspector()
        return [(inspector.GetShape(geometry), color) for geometry, color in self._moving()]

    def poses(self, context: Context) -> list[RigidTransform]:
        """Return the poses of `moving` in the world.

        Args:
            context: A root context of the testbed.
        """
        query = self._query(context)
        return [RigidTransform(query.GetPoseInWorld(geometry)) for geometry, _ in self._moving()]

    def _moving(self) -> list[tuple[GeometryId, Rgba]]:
        return [(geometry, color) for geometry, color, moves in self._shapes if moves]

    def still(self, context: Context, camera: Viewpoint | None = None) -> Still:
        """Return a picture of what is drawn in the poses of a context, by default of all that moves.

        Args:
            context: A root context of the testbed.
            camera: From where the picture is taken; None: a camera that fits what moves.
        """
        corners = self.corners(context)
        if camera is None and corners.size and np.isfinite(corners).all():
            camera = fitting_camera(corners)
        still = Still(camera)
        self.add_to(still, context)
        return still

    def again(self, meshcat: Meshcat, context: Context) -> Drawing:
        """Return the same drawing in another Meshcat, in the poses of a context.

        Args:
            meshcat: The server that shows it; only the thread that made it may use it.
            context: A root context of the testbed, whose poses are shown first.
        """
        return Drawing(meshcat, self._testbed, context, self.path, **self._looks)

    def delete(self) -> None:
        """Remove it from the scene."""
        self._meshcat.Delete(self.path)


def _boxes(inspector: SceneGraphInspector, frame: FrameId) -> NDArray[np.float64]:
    """Return the corners of the boxes around the shapes of a frame, in that frame, shape (3, n)."""
    corners = [np.empty((3, 0))]
    for geometry in inspector.GetGeometries(frame, Role.kIllustration):
        corners.append(inspector.GetPoseInFrame(geometry) @ box_corners(inspector.GetShape(geometry)))
    return np.hstack(corners)


def box_corners(shape: Shape) -> NDArray[np.float64]:
    """Return the corners of the box around a shape, in its own frame in m, shape (3, 8); (3, 0) if it has no end.

    Args:
        shape: The shape.
    """
    box = CalcObb(shape)
    return np.empty((3, 0)) if box is None else box.pose() @ (_CORNERS * box.half_width()).T


def is_anchored(plant: MultibodyPlant | None, frame: FrameId) -> bool:
    """Return whether a frame of the scene belongs to a body that is fixed to the world.

    Args:
        plant: The plant of the bodies, if there is one.
        frame: The frame, other than the world's.
    """
    body = plant.GetBodyFromFrameId(frame) if plant is not None else None
    return plant is not None and body is not None and plant.IsAnchored(body)


def illustration_color(inspector: SceneGraphInspector, geometry: GeometryId) -> Rgba:
    """Return the colour in which a geometry is illustrated.

    Args:
        inspector: It knows the geometry.
        geometry: A geometry with the role of illustration.
    """
    properties = inspector.GetIllustrationProperties(geometry)
    color: Rgba = properties.GetPropertyOrDefault("phong", "diffuse", Rgba(0.9, 0.9, 0.9, 1.0))
    return color


def tinted_color(color: Rgba, tint: ColorType | None, opacity: float) -> Rgba:
    """Return a colour in another tint, of the same brightness, so that the parts of a robot can be distinguished.

    Args:
        color: The colour.
        tint: The tint, any matplotlib colour; None keeps the colour.
        opacity: A factor of the opacity.
    """
    rgb = np.array([color.r(), color.g(), color.b()])
    if tint is not None:
        rgb = 0.75 * np.array(to_rgb(tint)) + 0.25 * rgb @ _BRIGHTNESS
    return Rgba(*rgb, color.a() * opacity)
