r"""Distances of the servicer's arm from its own base, its panels and itself: for planners, and by Drake as the judge.

For planners, the arm is covered by spheres: each tube (a cylinder of its link's radius), the joint housings, and the
hand with its fingers lie within them. The signed distance of a sphere from a box with half edges h is

    |max(d, 0)| + min(max(d), 0) - r,   d = |p| - h,

with the sphere's centre p in the box; that from a tube is the distance from its axis, less both radii. So what these
distances keep clear is clear, and they have derivatives. `DrakeClearance` computes the distances of the shapes
themselves, and shares nothing with it but the dimensions in the SDF file.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil, hypot

import casadi
import numpy as np
from numpy.typing import ArrayLike
from pydrake.geometry import (
    Capsule,
    CollisionFilterDeclaration,
    GeometryId,
    GeometryInstance,
    GeometrySet,
    ProximityProperties,
    QueryObject,
    RoleAssign,
)
from pydrake.math import RigidTransform
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, MultibodyPlant
from pydrake.multibody.tree import FixedOffsetFrame
from pydrake.systems.framework import DiagramBuilder

from vtbdrake.common.arrays import Array
from vtbdrake.components.compiled_plant import MomentumModel
from vtbdrake.components.compiled_plant.links import Expression
from vtbdrake_diagrams.satellite.bodies import (
    ARM_JOINT_NAMES,
    ARM_JOINTS,
    FINGER_JOINT_NAMES,
    FINGER_NAMES,
    LINK_NAMES,
    Servicer,
)
from vtbdrake_diagrams.satellite.plant import add_servicer

CLEARANCE = 0.02
"""The least distance in m that the arm keeps from base, panels and itself."""

# The largest distance of the spheres along a tube, in m: they bulge by less than 2 cm.
_SPACING = 0.1
# A joint housing is a cylinder of 1.1 radii and a length of 2.4 radii, see `vtbdrake_diagrams.satellite.model`.
_HOUSING = hypot(1.1, 1.2)
# A tube is drawn with this share of its link's radius.
_TUBE = 0.9
# In m: how sharp the smooth minimum of the distances is.
_SOFTNESS = 0.005
# Under the root of a distance, in m^2, so that it has a derivative at zero; and its root, in m.
_ROUND = 1e-10


@dataclass(frozen=True)
class Sphere:
    """A sphere that covers a piece of the arm.

    Attributes:
        link: The body that it belongs to.
        center: Its centre in the frame of that body, in m.
        radius: Its radius in m.
    """

    link: str
    center: tuple[float, float, float]
    radius: float


def arm_spheres(servicer: Servicer) -> list[Sphere]:
    """Return the spheres that cover the arm from its second joint on, from the inside out."""
    s, spheres = servicer, []
    for k in range(1, ARM_JOINTS):
        radius, length = s.radii[k], s.lengths[k]
        pieces = ceil(length / _SPACING - 1e-9)
        half = length / pieces / 2
        spheres += [Sphere(LINK_NAMES[k], (0.0, 0.0, (2 * i + 1) * half), hypot(radius, half)) for i in range(pieces)]
        if not s.axes[k][2]:
            spheres.append(Sphere(LINK_NAMES[k], (0.0, 0.0, 0.0), _HOUSING * radius))
    # The hand with the open fingers is a box, and that consists of four.
    x, y, z = max(s.hand[0] / 2, s.opening + s.finger[0]), s.hand[1] / 2, s.hand[2] + s.finger[2]
    radius = float(np.linalg.norm([x / 2, y, z / 4]))
    spheres += [
        Sphere("hand", (side * x / 2, 0.0, share * z), radius) for side in (-1.0, 1.0) for share in (0.25, 0.75)
    ]
    return spheres


class ArmClearance:
    """The distances of the arm's spheres from what they may touch, for positions q of the arm's joints, shape (7,).

    Attributes:
        names: What each distance is between.
        distances: The function (q) -> signed distances in m, shape (len(names), 1).
        soft: The function (q) -> a smooth lower bound of the distances of each group in `groups`, shape (groups, 1).
        groups: The names of the groups.
        centers: The function (q) -> the centres of the spheres in B, shape (3, spheres), in m.
        radii: Their radii in m, shape (spheres,).
        reaches: For each joint the farthest that a point of the arm is from its axis, shape (7,), in m. No distance
            changes faster than the sum of reach times rate.
    """

    groups = ("upper arm and base", "forearm and base", "hand and base", "hand and arm", "wrist")

    def __init__(self, servicer: Servicer) -> None:
        """Read the dimensions of a servicer, and the kinematics of the plant."""
        s, spheres = servicer, arm_spheres(servicer)
        plant = MultibodyPlant(0.0)
        instance = add_servicer(plant, s, servos=False)
        centers = [
            plant.AddFrame(
                FixedOffsetFrame(f"sphere_{i}", plant.GetFrameByName(c.link), RigidTransform(np.array(c.center)))
            )
            for i, c in enumerate(spheres)
        ]
        plant.Finalize()
        joints = [plant.GetJointByName(name, instance) for name in ARM_JOINT_NAMES]
        model = MomentumModel(plant, plant.CreateDefaultContext(), joints=joints)
        q = casadi.SX.sym("q", ARM_JOINTS)
        shoulder, elbow = (model.point(plant.GetFrameByName(name), q) for name in ("link_2", "link_4"))
        points = [model.point(frame, q) for frame in centers]
        self.centers = casadi.Function("centers", [q], [casadi.densify(casadi.horzcat(*points))], {"cse": True})
        self.radii = np.array([sphere.radius for sphere in spheres])
        clearances: dict[str, list[tuple[str, Expression]]] = {group: [] for group in self.groups}
        for sphere, p in zip(spheres, points, strict=True):
            outer = LINK_NAMES.index(sphere.link) if sphere.link in LINK_NAMES else ARM_JOINTS
            group = self.groups[0 if outer < 3 else 1 if outer < 5 else 2]
            for name, distance in _from_base(s, p).items():
                clearances[group].append((f"{sphere.link} and {name}", distance - sphere.radius))
            if outer >= 5:
                for name, distance in _from_inner_arm(s, p, shoulder, elbow).items():
                    clearances["hand and arm"].append((f"{sphere.link} and {name}", distance - sphere.radius))
        clearances["wrist"].append(("link_7 and link_5", _wrist(s, q[5])))
        pairs = [pair for group in self.groups for pair in clearances[group]]
        self.names = tuple(name for name, _ in pairs)
        self.distances = _function("distances", q, [distance for _, distance in pairs])
        self.soft = _function("soft", q, [_soft_minimum([d for _, d in clearances[group]]) for group in self.groups])
        upper, fore, hand = sum(s.lengths[1:3]), sum(s.lengths[3:5]), sum(s.lengths[5:])
        side, ahead = (np.max(np.abs([c.center[axis] for c in spheres if c.link == "hand"])) for axis in (0, 2))
        hand += hypot(side, ahead)
        self.reaches = np.array([*[upper + fore + hand] * 2, *[fore + hand] * 2, hand, hand, side])

    def nearest(self, q: ArrayLike) -> tuple[float, str]:
        """Return the least distance in m at one pose, shape (7,), and what it is between."""
        distances = self.distances(np.asarray(q, dtype=float)).full().ravel()
        k = int(np.argmin(distances))
        return float(distances[k]), self.names[k]

    def least(self, q: ArrayLike) -> Array:
        """Return the least distance in m at each of n poses, shape (n, 7)."""
        return np.asarray(self.distances(np.asarray(q, dtype=float).T).full().min(axis=0))

    def from_boxes(self, q: ArrayLike, X_TB: RigidTransform, boxes: Sequence[tuple[ArrayLike, ArrayLike]]) -> float:
        """Return the least signed distance in m of the spheres from boxes on another body T.

        Args:
            q: Positions of the joints in rad, shape (7,).
            X_TB: The pose of the base, seen from T.
            boxes: (edges, centre in T) of each box, in m.
        """
        p = np.asarray(X_TB @ self.centers(np.asarray(q, dtype=float)).full())
        distances = []
        for edges, center in boxes:
            beyond = np.abs(p - np.reshape(center, (3, 1))) - np.reshape(edges, (3, 1)) / 2.0
            outside = np.linalg.norm(np.maximum(beyond, 0.0), axis=0)
            distances.append(outside + np.minimum(beyond.max(axis=0), 0.0) - self.radii)
        return float(np.min(distances))


def _function(name: str, q: Expression, values: Sequence[Expression]) -> casadi.Function:
    return casadi.Function(name, [q], [casadi.densify(casadi.vertcat(*values))], {"cse": True})


def _from_base(s: Servicer, p: Expression) -> dict[str, Expression]:
    """Return the signed distances of a point p_BoP_B from box, panels (mirrored) and yoke."""
    yoke = (0.06, s.box[1] + 2 * s.panel_gap, 0.06)
    mirrored = casadi.vertcat(p[0], casadi.fabs(p[1]) - s.panel_centers[0], p[2])
    return {"the base": _from_box(p, s.box), "a panel": _from_box(mirrored, s.panel), "the yoke": _from_box(p, yoke)}


def _from_inner_arm(s: Servicer, p: Expression, shoulder: Expression, elbow: Expression) -> dict[str, Expression]:
    """Return the distances of a point p_BoP_B from the tubes before the elbow: foot and link 1, links 2 and 3."""
    foot = casadi.SX(casadi.DM(s.shoulder))
    return {
        "the foot": _from_segment(p, foot, shoulder) - s.radii[0],
        "the shoulder": _length(p - shoulder) - _HOUSING * s.radii[1],
        "the upper arm": _from_segment(p, shoulder, elbow) - max(s.radii[1:3]),
    }


def _from_box(p: Expression, edges: tuple[float, float, float]) -> Expression:
    beyond = casadi.fabs(p) - casadi.DM(edges) / 2
    return _length(casadi.fmax(beyond, 0.0)) + casadi.fmin(casadi.mmax(beyond), 0.0)


def _from_segment(p: Expression, begin: Expression, end: Expression) -> Expression:
    along = end - begin
    share = casadi.fmax(0.0, casadi.fmin(1.0, casadi.dot(p - begin, along) / casadi.sumsqr(along)))
    return _length(p - begin - share * along)


def _length(a: Expression) -> Expression:
    """Return the length of a vector, less than `_ROUND`'s root too short, with a derivative at zero."""
    return casadi.sqrt(casadi.sumsqr(a) + _ROUND) - _ROUND**0.5


def _wrist(s: Servicer, angle: Expression) -> Expression:
    """Return a lower bound of the distance of link 7 from link 5, two tubes as they are drawn, for joint 6.

    Both have their axes in one plane. The bound is the largest gap along the axis of link 5, along the axis of link 7,
    and
    across the axis of link 5: up to 90 deg the second, beyond it the third, which ends near 110 deg.
    """
    length, fore, hand = s.lengths[5], _TUBE * s.radii[4], _TUBE * s.radii[6]
    sine, cosine = casadi.fabs(casadi.sin(angle)), casadi.cos(angle)
    across = length * sine - hand * casadi.fabs(cosine) - fore
    ahead = casadi.if_else(cosine > 0.0, length - fore * sine, across)
    return casadi.fmax(casadi.fmax(length * cosine - hand * sine, ahead), across)


def _soft_minimum(distances: Sequence[Expression]) -> Expression:
    if len(distances) == 1:
        return distances[0]
    return -_SOFTNESS * casadi.log(sum(casadi.exp(-d / _SOFTNESS) for d in distances))


class DrakeClearance:
    """The least signed distance between the arm and base, panels and arm, by Drake's SceneGraph.

    The shapes are those that the SDF file shows; and a capsule of its radius around each link, which counts against the
    base. Neighbours in the chain do not count, nor do link 6 and the hand.
    """

    def __init__(self, servicer: Servicer | None = None) -> None:
        """Build the servicer alone, its fingers open."""
        s = servicer or Servicer()
        builder = DiagramBuilder()
        plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 0.0)
        instance = add_servicer(plant, s, servos=False)
        plant.Finalize()
        source = plant.get_source_id()
        chain: dict[str, list[GeometryId]] = {"base": [], **{name: [] for name in LINK_NAMES}, "hand": []}
        for name, geometries in chain.items():
            for member in [name, *FINGER_NAMES] if name == "hand" else [name]:
                body = plant.GetBodyByName(member, instance)
                colliding = plant.GetCollisionGeometriesForBody(body)
                for geometry in [] if colliding else plant.GetVisualGeometriesForBody(body):
                    scene_graph.AssignRole(source, geometry, ProximityProperties(), RoleAssign.kNew)
                    geometries.append(geometry)
                geometries += colliding
        capsules = []
        # Link 1 only turns about its own axis.
        for k, name in enumerate(LINK_NAMES[1:], 1):
            frame = plant.GetBodyFrameIdOrThrow(plant.GetBodyByName(name, instance).index())
            X = RigidTransform([0.0, 0.0, s.lengths[k] / 2])
            shape = GeometryInstance(X, Capsule(s.radii[k], s.lengths[k]), f"{name}_capsule")
            shape.set_proximity_properties(ProximityProperties())
            capsules.append(scene_graph.RegisterGeometry(source, frame, shape))
        manager, declaration = scene_graph.collision_filter_manager(), CollisionFilterDeclaration()
        names = list(chain)
        # Links 6 and 7 and the hand are one straight piece.
        for first, second in (*itertools.pairwise(names), ("link_6", "hand")):
            declaration.ExcludeBetween(GeometrySet(chain[first]), GeometrySet(chain[second]))
        declaration.ExcludeWithin(GeometrySet(chain["hand"]))
        arm = [geometry for name in names[1:] for geometry in chain[name]]
        declaration.ExcludeBetween(GeometrySet(capsules), GeometrySet([*arm, *capsules]))
        manager.Apply(declaration)
        self._plant, self._diagram = plant, builder.Build()
        self._context = self._diagram.CreateDefaultContext()
        self._plant_context = plant.GetMyMutableContextFromRoot(self._context)
        self._places = [plant.GetJointByName(name, instance).position_start() for name in ARM_JOINT_NAMES]
        fingers = [plant.GetJointByName(name, instance).position_start() for name in FINGER_JOINT_NAMES]
        self._q = plant.GetPositions(self._plant_context)
        self._q[fingers] = s.opening

    def nearest(self, q: ArrayLike) -> tuple[float, str]:
        """Return the least distance in m at one pose, shape (7,), and what it is between."""
        self._q[self._places] = q
        self._plant.SetPositions(self._plant_context, self._q)
        query: QueryObject = self._plant.get_geometry_query_input_port().Eval(self._plant_context)
        pairs = query.ComputeSignedDistancePairwiseClosestPoints(max_distance=0.5)
        if not pairs:
            return 0.5, "nothing within 0.5 m"
        pair = min(pairs, key=lambda pair: pair.distance)
        return float(pair.distance), " and ".join(self._name(query, k) for k in (pair.id_A, pair.id_B))

    def _name(self, query: QueryObject, geometry: GeometryId) -> str:
        inspector = query.inspector()
        body = self._plant.GetBodyFromFrameId(inspector.GetFrameId(geometry))
        return f"{body.name()}'s {inspector.GetName(geometry).split('::')[-1]}"
