"""What a testbed looks like, for any viewer: a tree of frames with shapes, joints and cameras."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import FrameId, HalfSpace, Role
from pydrake.math import RigidTransform

from vtbdrake.visualization.cameras import camera_view, cameras
from vtbdrake.visualization.drawing import Parts, box_corners, illustration_color, is_anchored, tinted_color
from vtbdrake.visualization.viewpoint import Viewpoint, fitting_camera

if TYPE_CHECKING:
    from matplotlib.typing import ColorType
    from pydrake.geometry import GeometryId, QueryObject, SceneGraph, SceneGraphInspector, Shape
    from pydrake.multibody.plant import MultibodyPlant
    from pydrake.multibody.tree import Joint, RigidBody
    from pydrake.systems.framework import Context, System

    from vtbdrake.testbed import VirtualTestbed

WORLD = "world"
"""The name of the world frame, the root of all frames."""

# What moves gets a field of view that is larger than it needs by this factor: Rerun's is narrower than Meshcat's.
_ROOM = 2.5


@dataclass(frozen=True)
class VisualShape:
    """A shape that is drawn in a frame.

    Attributes:
        name: Its name, unique in its frame.
        shape: The shape, in its own frame G.
        X_FG: The pose of G in the frame that it is fixed to.
        color: Red, green, blue and opacity, from 0 to 1.
        is_painted: Whether the model gives it this colour; a mesh that is not painted may have colours of its own.
    """

    name: str
    shape: Shape
    X_FG: RigidTransform
    color: tuple[float, float, float, float]
    is_painted: bool


@dataclass(frozen=True)
class SceneFrame:
    """A frame of the scene, in the tree of frames.

    Attributes:
        name: Its name, unique in the scene: ``model/body``, beneath the prefix of the scene.
        parent: The name of its parent frame; empty for the world.
        moves: Whether it moves in its parent.
        shapes: What is drawn in it.
        pose: Returns its pose in its parent, of a root context of the testbed.
    """

    name: str
    parent: str
    moves: bool
    shapes: tuple[VisualShape, ...]
    pose: Callable[[Context], RigidTransform]


class SceneModel:
    """The frames, shapes, joints and cameras of a testbed, in the poses of any of its contexts.

    Half spaces are left out, as in Meshcat: they would hide how large everything else is.

    A body's parent is the body that its joint hangs on, so that the tree of frames is the plant's. Frames of a scene
    graph that belong to no body, and cameras, hang on the world.

    Args:
        testbed: The testbed.
        prefix: The name of a frame beneath which all others hang; empty: they hang on the world.
        tint: Colour of what moves in the world, any matplotlib colour; None: its own colours.
        opacity: Opacity of what moves in the world, in (0, 1].
        parts: Whether moving shapes, anchored shapes or both are drawn.
        X_WP: The pose of the prefix's frame in the world.

    Attributes:
        prefix: The name of the frame beneath which all others hang, or an empty text.
        frames: The frames; each one stands after its parent.
        joints: The names ``model/joint`` of the joints with one position and one velocity.
        cameras: The cameras, by the names of their frames.
    """

    def __init__(
        self,
        testbed: VirtualTestbed,
        *,
        prefix: str = "",
        tint: ColorType | None = None,
        opacity: float = 1.0,
        parts: Parts = Parts.ALL,
        X_WP: RigidTransform | None = None,
    ) -> None:
        self.testbed, self.prefix = testbed, prefix
        self._tint, self._opacity, self._parts = tint, opacity, parts
        self._root = prefix or WORLD
        plant, scene_graph = testbed.plant, testbed.scene_graph
        self._shapes = {} if scene_graph is None else self._illustrated(scene_graph.model_inspector(), plant)
        X_WP = X_WP or RigidTransform()
        world = None if scene_graph is None else scene_graph.world_frame_id()
        root = SceneFrame(self._root, WORLD if prefix else "", False, self._shapes.get(world, ()), lambda _: X_WP)
        self.cameras: Mapping[str, System] = {self._below(path): system for path, system in cameras(testbed).items()}
        bodies = () if plant is None else self._body_frames(plant)
        bodiless = () if scene_graph is None else self._other_frames(scene_graph, plant)
        self.frames: tuple[SceneFrame, ...] = (root, *bodies, *bodiless, *self._camera_frames())
        joints = [] if plant is None else _single_joints(plant)
        self.joints = tuple(self._below(_scoped(plant, joint)) for joint in joints) if plant else ()
        self._positions = np.array([joint.position_start() for joint in joints], dtype=int)
        self._velocities = np.array([joint.velocity_start() for joint in joints], dtype=int)

    def topic(self, name: str) -> str:
        """Return the name of a stream of the scene's data: ``/name``, or ``/prefix/name``.

        Args:
            name: The name of the stream within the scene.
        """
        return f"/{self._below(name)}"

    def fitting_camera(self, context: Context) -> Viewpoint | None:
        """Return a camera that shows what moves in the world; None if nothing does.

        Args:
            context: A root context of the testbed.
        """
        poses, moving = {WORLD: RigidTransform()}, set[str]()
        corners = [np.empty((3, 0))]
        for frame in self.frames:
            poses[frame.name] = X_WF = poses[frame.parent or WORLD] @ frame.pose(context)
            if frame.moves or frame.parent in moving:
                moving.add(frame.name)
                corners += [X_WF @ visual.X_FG @ box_corners(visual.shape) for visual in frame.shapes]
        points_W = np.hstack(corners)
        return fitting_camera(points_W, margin=_ROOM) if points_W.size and np.isfinite(points_W).all() else None

    def joint_state(self, context: Context) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return positions and velocities of `joints`, shape (n,) each, in rad or m and their rates.

        Args:
            context: A root context of the testbed.
        """
        plant = self.testbed.plant
        if plant is None:
            return np.empty(0), np.empty(0)
        plant_context = plant.GetMyContextFromRoot(context)
        q, v = plant.GetPositions(plant_context), plant.GetVelocities(plant_context)
        return q[self._positions], v[self._velocities]

    def _below(self, name: str) -> str:
        return f"{self.prefix}/{name}" if self.prefix else name

    def _illustrated(
        self, inspector: SceneGraphInspector, plant: MultibodyPlant | None
    ) -> dict[FrameId, tuple[VisualShape, ...]]:
        """Return the shapes that are drawn, by frame."""
        shapes: dict[FrameId, tuple[VisualShape, ...]] = {}
        for frame in inspector.GetAllFrameIds():
            moves = frame != inspector.world_frame_id() and not is_anchored(plant, frame)
            if not self._parts & (Parts.MOVING if moves else Parts.ANCHORED):
                continue
            visuals: dict[str, VisualShape] = {}
            for geometry in inspector.GetGeometries(frame, Role.kIllustration):
                name = inspector.GetName(geometry).rpartition("::")[2]
                name = f"{name}-{len(visuals)}" if name in visuals else name
                visual = self._visual(inspector, geometry, name, moves)
                if not isinstance(visual.shape, HalfSpace):
                    visuals[name] = visual
            shapes[frame] = tuple(visuals.values())
        return shapes

    def _visual(self, inspector: SceneGraphInspector, geometry: GeometryId, name: str, moves: bool) -> VisualShape:
        color = illustration_color(inspector, geometry)
        if moves:
            color = tinted_color(color, self._tint, self._opacity)
        properties = inspector.GetIllustrationProperties(geometry)
        return VisualShape(
            name=name,
            shape=inspector.GetShape(geometry),
            X_FG=RigidTransform(inspector.GetPoseInFrame(geometry)),
            color=(color.r(), color.g(), color.b(), color.a()),
            is_painted=properties.HasProperty("phong", "diffuse") or (moves and self._tint is not None),
        )

    def _body_frames(self, plant: MultibodyPlant) -> Iterator[SceneFrame]:
        """Yield the frames of all bodies but the world, parents first."""
        joints = [plant.get_joint(index) for index in plant.GetJointIndices()]
        hanging: dict[int, list[Joint]] = {}
        for joint in joints:
            hanging.setdefault(int(joint.parent_body().index()), []).append(joint)
        queue = [plant.world_body()]
        for parent in queue:  # It grows meanwhile.
            for joint in hanging.get(int(parent.index()), ()):
                body = joint.child_body()
                queue.append(body)
                yield SceneFrame(
                    name=self._below(_scoped(plant, body)),
                    parent=self._root if parent is queue[0] else self._below(_scoped(plant, parent)),
                    moves=joint.num_velocities() > 0,
                    shapes=self._shapes.get(plant.GetBodyFrameIdIfExists(body.index()), ()),
                    pose=partial(_relative_pose, plant, parent, body),
                )

    def _other_frames(self, scene_graph: SceneGraph, plant: MultibodyPlant | None) -> Iterator[SceneFrame]:
        """Yield the frames of the scene graph that belong to no body."""
        inspector = scene_graph.model_inspector()
        for frame in inspector.GetAllFrameIds():
            if frame == inspector.world_frame_id() or (plant and plant.GetBodyFromFrameId(frame) is not None):
                continue
            name = self._below(inspector.GetName(frame).replace("::", "/"))
            pose = partial(_frame_pose, scene_graph, frame)
            yield SceneFrame(name, self._root, True, self._shapes.get(frame, ()), pose)

    def _camera_frames(self) -> Iterator[SceneFrame]:
        for name, camera in self.cameras.items():
            yield SceneFrame(name, self._root, True, (), partial(_camera_pose, camera))


def _relative_pose(plant: MultibodyPlant, parent: RigidBody, body: RigidBody, context: Context) -> RigidTransform:
    plant_context = plant.GetMyContextFromRoot(context)
    X_WB = plant.EvalBodyPoseInWorld(plant_context, body)
    return plant.EvalBodyPoseInWorld(plant_context, parent).InvertAndCompose(X_WB)


def _frame_pose(scene_graph: SceneGraph, frame: FrameId, context: Context) -> RigidTransform:
    query: QueryObject = scene_graph.get_query_output_port().Eval(scene_graph.GetMyContextFromRoot(context))
    return RigidTransform(query.GetPoseInWorld(frame))  # a copy: Drake returns a reference


def _camera_pose(camera: System, context: Context) -> RigidTransform:
    return camera_view(camera, camera.GetMyContextFromRoot(context))[0]


def _single_joints(plant: MultibodyPlant) -> list[Joint]:
    joints = [plant.get_joint(index) for index in plant.GetJointIndices()]
    return [joint for joint in joints if joint.num_positions() == joint.num_velocities() == 1]


def _scoped(plant: MultibodyPlant, element: RigidBody | Joint) -> str:
    """Return the name of a body or joint with the one of its model instance: ``arm/link_1``."""
    return f"{plant.GetModelInstanceName(element.model_instance())}/{element.name()}".replace("::", "/")
