"""How a robot with legs stands: which links are its feet, and in which posture its weight is above them."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import (
    Box,
    Capsule,
    Convex,
    Cylinder,
    Ellipsoid,
    GeometryId,
    Mesh,
    Role,
    SceneGraphInspector,
    Sphere,
)
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex, Joint, RigidBody
from pydrake.systems.framework import Context
from scipy.optimize import least_squares
from scipy.spatial import ConvexHull, QhullError

from vtbdrake.components.standing import Gains, Stance, WholeBodyModel

if TYPE_CHECKING:
    from vtbdrake.project.robot import RobotJoint

Array = NDArray[np.float64]

# Joints with limits between trunk and foot: a finger of a gripper has fewer, and a wheel's joint has no limits.
_LEAST_JOINTS = 2
# Feet end within this share of the robot's height above the ground, in the posture that the file gives.
_SHARE_OF_HEIGHT = 0.25
# What lies at most this much above the lowest point of a foot belongs to its sole, in m.
_SOLE = 0.002
# A sole is at least this long, in m; what is shorter is one point.
_LEAST_SOLE = 0.025
# Contact points lie on a line if they are this close to one, in m.
_LINE = 0.01
# The trunk is above this share of the height of the robot: what is lower stands on its trunk.
_TRUNK = 0.3
# Knees of legs that are stretched in the file are bent, until the trunk is at this share of its height.
_BENT = 0.93
# A joint that is this close to an end of its range bends in one direction only, relative to its range.
_ONE_SIDED = 0.2
# How strongly joints are kept at the posture, by whether they bend the legs in the plane in which the robot looks.
_BENDING = 0.03
_OTHER = 0.2
# The centre of mass lies at least this far inside the polygon of the contact points, in m.
_MARGIN = 0.005
# Contact points end at most this far above the ground, in m.
_UNEVEN = 0.003
# The directions in which the weight may be shifted: to the left, or to the front.
_SIDEWAYS = (0.0, 1.0)
_FORWARD = (1.0, 0.0)
# The weight is shifted by this share of the distance from the middle of the contact points to the outermost ones.
_SHIFT = 0.25
# A direction is good if the robot reaches this share of a shift within the time, in s.
_WELL_REACHED = 0.7
_SHIFT_TIME = 2.5
# A robot whose trunk sinks by this share of its height within this time in s is too heavy for its drives.
_SINKING = 0.01
_SINKING_TIME = 0.3
# Names of postures in which robots stand, in the order in which they are tried.
_POSTURES = ("half_sitting", "standing", "stand", "home", "nominal", "default", "init_qpos")


class StanceError(ValueError):
    """A robot does not stand on its legs; the message says why."""


@dataclass(frozen=True)
class StandingRobot:
    """How a robot with a free base stands.

    Attributes:
        base: Name of its trunk.
        X_WB: The pose of the trunk, with the feet on the ground at z = 0.
        posture: Joint -> position in rad or m.
        feet: Name of a body -> its contact points in the frame of the body in m, shape (k, 3).
        soles: The feet with a sole, or without collision geometry, and the upward direction in the frame of each.
            Drake's point contact gives one point to a pair of geometries, so that a small sphere at each contact point
            has to carry them.
        widths: How far the contact points are from their middle at most, in the directions of x and y in m.
        source: Where the posture comes from, in words.
        direction: The direction in the plane in which the robot can shift its weight.
        shift: A distance in m by which it can shift its weight.
        reached: The share of this distance that it reaches, without delays.
    """

    base: str
    X_WB: RigidTransform
    posture: Mapping[str, float]
    feet: Mapping[str, Array]
    soles: Mapping[str, Array]
    widths: Array
    source: str
    direction: tuple[float, float] = _SIDEWAYS
    shift: float = 0.0
    reached: float = 0.0

    def stance(self, joints: Sequence[str]) -> Stance:
        """Return the stance of a `StandingController` that gets the positions of ``joints``."""
        X_WB = np.concatenate([self.X_WB.rotation().ToQuaternion().wxyz(), self.X_WB.translation()])
        posture = np.array([self.posture[name] for name in joints])
        return Stance(self.base, X_WB, posture, tuple(joints), self.feet, self.direction)


class _Shape(NamedTuple):
    """What can touch the ground: the convex hull of spheres, in the frame of a body."""

    centers: Array  # m, shape (n, 3)
    radii: Array  # m, shape (n,)
    touches: bool = True  # whether it is in contact in the simulation, or only drawn


class _Foot(NamedTuple):
    body: RigidBody
    shape: _Shape  # of a sole, its corners
    normal: Array  # the upward direction in the frame of the body, where the foot has a sole
    is_sole: bool


def named_postures(path: Path, text: str) -> Iterator[tuple[str, dict[str, float]]]:
    """Yield the postures that are stated for a robot: where, and joint -> position in rad or m.

    These are the keyframes of a MJCF file, and the group states of the SRDF files beside a URDF or in a folder
    ``srdf`` near it, those first that are called as if the robot stood.

    Args:
        path: The model file.
        text: Its text.
    """
    postures = [*_keyframes(path, text), *_group_states(path)]

    def rank(item: tuple[str, str, dict[str, float]]) -> tuple[bool, int]:
        name, place, _ = item
        called = next((k for k, word in enumerate(_POSTURES) if word in name), len(_POSTURES))
        return Path(place).stem != path.stem, called

    for name, place, posture in sorted(postures, key=rank):
        yield f"{name} in {place}", posture


def _keyframes(path: Path, text: str) -> Iterator[tuple[str, str, dict[str, float]]]:
    root = parsed(text)
    if root is None or root.tag != "mujoco":
        return
    joints = [e for world in root.iter("worldbody") for e in world.iter("joint") if e.get("type") != "free"]
    keys = [(key.get("name", "key"), key.get("qpos", "")) for key in root.iter("key")]
    keys += [(n.get("name", ""), n.get("data", "")) for n in root.iter("numeric") if n.get("name") == "init_qpos"]
    for name, qpos in keys:
        values = [float(value) for value in qpos.split()]
        if len(values) == 7 + len(joints):  # [position, quaternion] of the base come first
            yield name, path.name, {j.get("name", ""): q for j, q in zip(joints, values[7:], strict=True)}


def _group_states(path: Path) -> Iterator[tuple[str, str, dict[str, float]]]:
    folders = [path.parent, path.parent / "srdf", path.parent.parent / "srdf"]
    for file in [file for folder in folders for file in sorted(folder.glob("*.srdf"))]:
        root = parsed(file.read_text(encoding="utf-8", errors="replace"))
        for state in root.iter("group_state") if root is not None else ():
            posture = {}
            for joint in state.iter("joint"):
                values = joint.get("value", "").split()
                if len(values) == 1:
                    posture[joint.get("name", "")] = float(values[0])
            yield state.get("name", ""), file.name, posture


def parsed(text: str) -> ElementTree.Element | None:
    """Return the outermost element of an XML file, or None where ElementTree does not read it."""
    try:
        return ElementTree.fromstring(re.sub(r"^\s+(?=<\?xml)", "", text))
    except ElementTree.ParseError:
        return None


def with_shift(robot: StandingRobot, model: Callable[[Stance], WholeBodyModel], joints: Sequence[str]) -> StandingRobot:
    """Return the robot with the direction in which it shifts its weight best, and by how much.

    Args:
        robot: How it stands.
        model: Function that returns its model by its stance.
        joints: The names of its joints.

    Raises:
        StanceError: The drives or the friction of the feet cannot hold it.
    """
    best: StandingRobot | None = None
    for direction in (_SIDEWAYS, _FORWARD):
        shift = float(f"{_SHIFT * (robot.widths @ np.abs(direction)):.2g}")
        tried = replace(robot, direction=direction, shift=shift)
        whole = model(tried.stance(joints))
        gains = Gains()
        still = whole.settled(gains=gains, shift=0.0, duration=_SINKING_TIME)
        if still is None or whole.rest.pose[6] - still.pose[6] > _SINKING * whole.rest.pose[6]:
            raise StanceError("the effort limits of its drives are too low to carry it in this posture")
        end = whole.settled(gains=gains, shift=shift, duration=_SHIFT_TIME)
        tried = replace(tried, reached=whole.shifted(end) / shift if end is not None else 0.0)
        best = tried if best is None or tried.reached > best.reached else best
        if best.reached >= _WELL_REACHED:
            break
    assert best is not None
    return best


class StanceFinder:
    """Finds out how a robot stands.

    Args:
        plant: The robot with its free base, finalized.
        context: A context of the plant.
        inspector: What knows its geometries.
        base: The free base.
        joints: The joints with one degree of freedom.
        soles: Whether feet may have soles, which stay level; otherwise each touches the ground in a point.
    """

    def __init__(
        self,
        plant: MultibodyPlant,
        context: Context,
        inspector: SceneGraphInspector,
        *,
        base: RigidBody,
        joints: Sequence[RobotJoint],
        soles: bool = True,
    ) -> None:
        self._plant, self._context, self._base, self._joints = plant, context, base, joints
        self._soles = soles
        self._home = np.array([joint.home for joint in joints])
        self._q = np.array([plant.GetJointByName(joint.name).position_start() for joint in joints])
        self._up = _inboard_joints(plant)
        bodies = [plant.get_body(BodyIndex(k)) for k in range(1, plant.num_bodies())]
        shapes = {body: _shape(plant, inspector, body) for body in bodies}
        self._shapes = {body: shape for body, shape in shapes.items() if shape is not None and self._is_below(body)}

    def stance(self, postures: Sequence[tuple[str, Mapping[str, float]]]) -> StandingRobot | None:
        """Return the stance of the robot, or None if it has no legs.

        Args:
            postures: Postures in which it may stand, with where each comes from: joint -> position in rad or m. Behind
                these, its home is tried.

        Raises:
            StanceError: It has legs, and does not stand on them.
        """
        names = [joint.name for joint in self._joints]
        tried: list[tuple[str, Array]] = []
        for source, posture in postures:
            if len(posture.keys() & set(names)) >= 0.5 * len(names):
                values = [posture.get(joint.name, joint.home) for joint in self._joints]
                tried.append((source, self._within(np.array(values))))
        error: StanceError | None = None
        for source, q in [*tried, ("", self._home)]:
            if feet := self._feet(q):
                try:
                    return self._on_feet(feet, q, source)
                except StanceError as failure:
                    error = error or failure
        if error is not None:
            raise error
        return None

    def _within(self, q: Array) -> Array:
        lower, upper = np.transpose([(joint.lower, joint.upper) for joint in self._joints])
        result: Array = np.clip(q, lower, upper)
        return result

    # -- which links are feet

    def _chain(self, body: RigidBody) -> list[str]:
        """Return the joints that move a body against the trunk, the nearest first."""
        chain, index = [], int(body.index())
        while index != int(self._base.index()) and index in self._up:
            joint, index = self._up[index]
            if joint.num_velocities():
                chain.append(joint.name())
        return chain

    def _is_below(self, body: RigidBody) -> bool:
        index = int(body.index())
        while index != int(self._base.index()):
            if index not in self._up:
                return False
            index = self._up[index][1]
        return True

    def _place(self, q: Array, X_WB: RigidTransform | None = None) -> None:
        positions = np.zeros(self._plant.num_positions())
        positions[self._base.floating_positions_start()] = 1.0
        positions[self._q] = q
        self._plant.SetPositions(self._context, positions)
        self._plant.SetFreeBodyPose(self._context, self._base, X_WB or RigidTransform())

    def _lowest(self, body: RigidBody, shape: _Shape) -> float:
        X_WL = self._plant.EvalBodyPoseInWorld(self._context, body)
        heights = (shape.centers @ X_WL.rotation().matrix()[2]) + X_WL.translation()[2] - shape.radii
        return float(heights.min())

    def _feet(self, q: Array) -> list[_Foot]:
        """Return the feet in a posture: the lowest links at the ends of legs, or none."""
        self._place(q)
        limited = {joint.name for joint in self._joints if "range" not in joint.assumed and joint.kind == "revolute"}
        chains = {body: self._chain(body) for body in self._shapes}
        inner = {name for chain in chains.values() for name in chain[1:]}
        heights = {body: self._lowest(body, shape) for body, shape in self._shapes.items()}
        ends = [
            body
            for body, chain in chains.items()
            if chain and chain[0] not in inner and len(limited & set(chain)) >= _LEAST_JOINTS
        ]
        rest = [heights[body] for body, chain in chains.items() if not chain]
        if not ends:
            return []
        ground = min(heights[body] for body in ends)
        height = -ground  # of the trunk's origin
        if height <= 0.0 or min(rest, default=math.inf) <= ground + _SHARE_OF_HEIGHT * height:
            return []
        if height < _TRUNK * (max(map(self._highest, self._shapes)) - ground):
            return []
        by_joint: dict[str, RigidBody] = {}
        for body in ends:  # The foot is the body that is farthest from the last joint of the leg.
            foot = by_joint.setdefault(chains[body][0], body)
            if self._reach(body) > self._reach(foot):
                by_joint[chains[body][0]] = body
        low = [body for body in by_joint.values() if heights[body] <= ground + _SHARE_OF_HEIGHT * height]
        return [self._foot(body) for body in low] if len(low) > 1 else []

    def _highest(self, body: RigidBody) -> float:
        X_WL, shape = self._plant.EvalBodyPoseInWorld(self._context, body), self._shapes[body]
        return float((shape.centers @ X_WL.rotation().matrix()[2] + X_WL.translation()[2] + shape.radii).max())

    def _reach(self, body: RigidBody) -> float:
        """Return the distance of the farthest point of a body from the last joint that moves it, in m."""
        shape, joint = self._shapes[body], self._plant.GetJointByName(self._chain(body)[0])
        p_LJ = joint.frame_on_child().CalcPose(self._context, body.body_frame()).translation()
        return float((np.linalg.norm(shape.centers - p_LJ, axis=1) + shape.radii).max())

    def _foot(self, body: RigidBody) -> _Foot:
        """Return a foot of the present posture, in which a sole is taken to be level."""
        shape = self._shapes[body]
        R_LW = self._plant.EvalBodyPoseInWorld(self._context, body).rotation().inverse()
        normal = R_LW.matrix()[:, 2]
        heights = shape.centers @ normal - shape.radii
        low = np.flatnonzero(heights <= heights.min() + _SOLE)
        lowest = shape.centers[low]
        is_sole = self._soles and float(np.ptp(lowest, axis=0).max()) > _LEAST_SOLE
        if is_sole:
            level = lowest @ R_LW.matrix()[:, :2]
            ends = {int(low[np.argmax(level @ direction)]) for direction in ((1, 1), (1, -1), (-1, 1), (-1, -1))}
            corners = sorted(ends)
            shape = _Shape(shape.centers[corners], shape.radii[corners], shape.touches)
        return _Foot(body, shape, normal, is_sole)

    # -- the posture

    def _on_feet(self, feet: list[_Foot], q: Array, source: str) -> StandingRobot:
        """Return the stance near a posture, with the feet level and the weight above their middle."""
        index_of = {joint.name: k for k, joint in enumerate(self._joints)}
        chains = {name for foot in feet for name in self._chain(foot.body)}
        if loose := [joint.name for joint in self._joints if joint.name in chains and not joint.effort]:
            raise StanceError(f"no actuator moves {', '.join(loose)} of its legs; give them actuators in the file")
        moved = np.array(sorted(index_of[name] for name in chains))
        self._place(q)
        height = -float(np.mean([self._lowest(foot.body, foot.shape) for foot in feet]))
        places_at_start = np.array([self._contacts_W(foot).mean(axis=0)[:2] for foot in feet])
        layout_at_start = places_at_start - places_at_start.mean(axis=0)
        lower, upper = np.transpose([(self._joints[k].lower, self._joints[k].upper) for k in moved])
        margin = 0.02 * (upper - lower)
        target_height = height if source else _BENT * height

        def errors(x: Array) -> Array:
            posture = q.copy()
            posture[moved] = x
            self._place(posture)
            places = np.array([self._contacts_W(foot).mean(axis=0) for foot in feet])
            middle, lows = places.mean(axis=0), places[:, 2]
            layout = (places - middle)[:, :2]
            centre = self._plant.CalcCenterOfMassPositionInWorld(self._context)
            tilts = [self._tilt(foot) for foot in feet if foot.is_sole]
            return np.concatenate(
                [
                    20.0 * (lows - lows.mean()) / height,
                    [2.0 * (lows.mean() + target_height) / height],
                    10.0 * (middle - centre)[:2] / height,
                    (layout - layout_at_start).ravel() / height,
                    *(5.0 * tilt for tilt in tilts),
                    stiffness * (x - q[moved]),
                ]
            )

        bounds = lower + margin, upper - margin
        random = np.random.default_rng(0)
        best = None
        # At stretched knees the derivative of the height is 0: the search starts where they are bent a little.
        bent = np.array([0.0 if source else self._bend(k, q[k]) for k in moved])
        is_bending = [self._is_lateral(k) for k in moved]
        stiffness = np.where(is_bending, _BENDING, _OTHER)
        for spread in (0.0, 0.1, 0.3, 0.3, 0.6, 0.6):
            start = np.clip(q[moved] + bent + spread * random.standard_normal(len(moved)), *bounds)
            solution = least_squares(errors, start, bounds=bounds, max_nfev=200)
            if best is None or solution.cost < best.cost - 1e-4:
                best = solution
            if best.cost < 0.01:
                break
        assert best is not None
        posture = q.copy()
        posture[moved] = best.x
        return self._checked(feet, posture, source)

    def _is_lateral(self, k: int) -> bool:
        """Return whether the axis of a joint points to the side, in the present posture."""
        joint = self._plant.GetJointByName(self._joints[k].name)
        if self._joints[k].kind != "revolute":
            return False
        axis = joint.frame_on_parent().CalcRotationMatrixInWorld(self._context).matrix() @ joint.revolute_axis()
        return bool(abs(axis[1]) > 0.9)

    def _bend(self, k: int, position: float) -> float:
        """Return by how much a knee is bent at first: a joint that bends in one direction only; else 0."""
        joint = self._joints[k]
        reach = joint.upper - joint.lower
        if not self._is_lateral(k) or min(position - joint.lower, joint.upper - position) > _ONE_SIDED * reach:
            return 0.0
        return float(math.copysign(0.25 * reach, joint.lower + joint.upper - 2.0 * position))

    def _tilt(self, foot: _Foot) -> Array:
        R_WL = self._plant.EvalBodyPoseInWorld(self._context, foot.body).rotation().matrix()
        tilt: Array = (R_WL @ foot.normal)[:2]
        return tilt

    def _contacts_W(self, foot: _Foot) -> Array:
        """Return the contact points of a foot in the world, in the present posture."""
        X_WL = self._plant.EvalBodyPoseInWorld(self._context, foot.body)
        centers = foot.shape.centers @ X_WL.rotation().matrix().T + X_WL.translation()
        points = centers - foot.shape.radii[:, np.newaxis] * [0.0, 0.0, 1.0]
        return points if foot.is_sole else points[[int(np.argmin(points[:, 2]))]]

    def _checked(self, feet: list[_Foot], q: Array, source: str) -> StandingRobot:
        """Return the stance in a posture in which the robot stands.

        Raises:
            StanceError: It would fall.
        """
        self._place(q)
        contacts = {foot.body.name(): self._contacts_W(foot) for foot in feet}
        points = np.vstack(list(contacts.values()))
        names = ", ".join(contacts)
        if np.ptp(points[:, 2]) > _UNEVEN:
            raise StanceError(f"its feet {names} do not reach the ground together within the ranges of the joints")
        centre = self._plant.CalcCenterOfMassPositionInWorld(self._context)
        if not _is_inside(points[:, :2], centre[:2], margin=_MARGIN):
            place = "lies on a line" if _is_line(points[:, :2]) else "does not lie below its centre of mass"
            raise StanceError(
                f"what it stands on ({len(points)} contact points of {names}) {place}, so that it would fall"
            )
        z = -float(points[:, 2].min())
        X_WB = RigidTransform([-centre[0], -centre[1], z])
        feet_B = {
            foot.body.name(): self._plant.EvalBodyPoseInWorld(self._context, foot.body)
            .inverse()
            .multiply(contacts[foot.body.name()].T)
            .T
            for foot in feet
        }
        return StandingRobot(
            self._base.name(),
            X_WB,
            {joint.name: float(value) for joint, value in zip(self._joints, q, strict=True)},
            feet_B,
            {
                foot.body.name(): self._plant.EvalBodyPoseInWorld(self._context, foot.body).rotation().matrix()[2]
                for foot in feet
                if foot.is_sole or not foot.shape.touches
            },
            widths=np.abs(points - points.mean(axis=0)).max(axis=0)[:2],
            source=source,
        )


def lowest_point(plant: MultibodyPlant, inspector: SceneGraphInspector, context: Context) -> float | None:
    """Return the height of the lowest point of all bodies in m, or None if they have no geometry.

    Args:
        plant: The plant, finalized.
        inspector: What knows its geometries.
        context: A context of the plant.
    """
    heights = []
    for k in range(1, plant.num_bodies()):
        body = plant.get_body(BodyIndex(k))
        if (shape := _shape(plant, inspector, body)) is not None:
            X_WL = plant.EvalBodyPoseInWorld(context, body)
            heights.append(
                float((shape.centers @ X_WL.rotation().matrix()[2] - shape.radii).min() + X_WL.translation()[2])
            )
    return min(heights, default=None)


def _inboard_joints(plant: MultibodyPlant) -> dict[int, tuple[Joint, int]]:
    """Return the joint that each body hangs on, and the index of the body that this joint is on."""
    joints = [plant.get_joint(index) for index in plant.GetJointIndices()]
    return {int(j.child_body().index()): (j, int(j.parent_body().index())) for j in joints}


def _shape(plant: MultibodyPlant, inspector: SceneGraphInspector, body: RigidBody) -> _Shape | None:
    """Return the collision geometries of a body, its visual ones if it has no others, or None if there are none."""
    frame = plant.GetBodyFrameIdOrThrow(body.index())
    for role in (Role.kProximity, Role.kIllustration):
        geometries = inspector.GetGeometries(frame, role)
        parts = [_spheres(inspector, geometry, inspector.GetPoseInFrame(geometry)) for geometry in geometries]
        if spheres := [part for part in parts if part is not None]:
            centers = np.vstack([part.centers for part in spheres])
            return _Shape(centers, np.concatenate([part.radii for part in spheres]), role == Role.kProximity)
    return None


def _spheres(inspector: SceneGraphInspector, geometry: GeometryId, X_LG: RigidTransform) -> _Shape | None:
    """Return spheres whose convex hull is a geometry (a cylinder's is a prism of 16 sides)."""
    shape, radius = inspector.GetShape(geometry), 0.0
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float)
    angles = np.arange(16) * math.pi / 8.0
    circle = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(16)])
    if isinstance(shape, Sphere):
        points, radius = np.zeros((1, 3)), shape.radius()
    elif isinstance(shape, Capsule):
        points, radius = np.outer([-0.5, 0.5], [0.0, 0.0, shape.length()]), shape.radius()
    elif isinstance(shape, Box):
        points = 0.5 * signs * shape.size()
    elif isinstance(shape, Cylinder):
        rim, end = shape.radius() * circle, np.array([0.0, 0.0, 0.5 * shape.length()])
        points = np.vstack([rim + end, rim - end])
    elif isinstance(shape, Ellipsoid):
        points = np.vstack([np.eye(3), -np.eye(3), signs / math.sqrt(3.0)]) * [shape.a(), shape.b(), shape.c()]
    elif isinstance(shape, Convex | Mesh):
        try:
            hull = shape.GetConvexHull()
        except RuntimeError:  # a format that Drake does not read
            return None
        points = np.array([hull.vertex(k) for k in range(hull.num_vertices())])
    else:
        return None
    return _Shape(X_LG.multiply(points.T).T.reshape(-1, 3), np.full(len(points), radius))


def _is_line(points: Array) -> bool:
    if len(points) < 3:
        return True
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(spread[1] < _LINE)


def _is_inside(points: Array, point: Array, *, margin: float) -> bool:
    """Return whether a point in the plane lies in the convex hull of points, this far from its edges."""
    if _is_line(points):
        return False
    try:
        hull = ConvexHull(points)
    except QhullError:
        return False
    return bool((hull.equations[:, :2] @ point + hull.equations[:, 2] <= -margin).all())
