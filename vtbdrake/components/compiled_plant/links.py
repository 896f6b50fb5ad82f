"""The bodies of a MultibodyPlant as the links of a tree; their numbers are read through a Context, or stay symbols."""

from __future__ import annotations

import difflib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import casadi
import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.geometry import GeometryId
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    FixedOffsetFrame,
    ForceElementIndex,
    Frame,
    Joint,
    JointIndex,
    ModelInstanceIndex,
    RigidBody,
)
from pydrake.systems.framework import Context

from vtbdrake.state.multibody import bodies, element_address

Expression = Any  # casadi.SX
Pose = tuple[Expression, Expression]  # R, shape (3, 3), and p, shape (3, 1)
_OnBody = tuple[GeometryId, RigidBody]

# A number of a constant below this, in SI units, is what rounding left of a zero; in small models, a number below this
# part of the largest one of its kind.
_ROUNDING = 1e-15
_RELATIVE_ROUNDING = 1e-12

REVOLUTE = "revolute"
PRISMATIC = "prismatic"
WELD = "weld"
FLOATING = "quaternion_floating"


class UnsupportedPlantError(ValueError):
    """The plant has parts that cannot be compiled; the message names each of them."""


@dataclass(frozen=True)
class Link:
    """Bodies that are welded together, and the joint that carries them.

    The frame of the link is M, the frame of the joint on its side; F is the joint's frame on the other side.

    Attributes:
        joint: Index of the joint.
        parent: Number of the link that carries the joint; -1 is the world.
        carrier: Index of the body that carries the joint.
        kind: Type name of the joint.
        axis: Axis of the joint, in F and in M, shape (3, 1).
        q: Places of its positions among the plant's positions.
        v: Places of its velocities among the plant's velocities.
        X_PF: Pose of F in the frame of the parent.
        inertia: M_LMo_M of the link L, [angular; linear], shape (6, 6).
        damping: Damping of the joint, shape (nv, 1).
        reflected_inertia: Reflected inertia of the joint's actuator, shape (nv, 1).
    """

    joint: int
    parent: int
    carrier: int
    kind: str
    axis: Expression
    q: slice
    v: slice
    X_PF: Pose
    inertia: Expression
    damping: Expression
    reflected_inertia: Expression


@dataclass(frozen=True)
class LinkTree:
    """The links of a plant, parents first.

    Attributes:
        links: One for each joint that moves.
        mounts: Number of the link that a body B belongs to, and X_MB, by the index of the body. The world's is -1.
        inertias: M_BMo_M of each body, by its index, shape (6, 6).
        welds: Index of the body that carries a welded one, by its index.
        symbols: The inputs, by address.
        values: What the Context holds for them, by address, flat.
        rounding: Length in m below which rounding has left it of a zero.
    """

    links: tuple[Link, ...]
    mounts: dict[int, tuple[int, Pose]]
    inertias: dict[int, Expression]
    welds: dict[int, int]
    symbols: dict[str, Expression]
    values: dict[str, NDArray[np.float64]]
    rounding: float


def read_links(
    plant: MultibodyPlant, context: Context, inputs: Sequence[str] = (), *, controllers: bool = False
) -> LinkTree:
    """Return the links of a finalized plant.

    Args:
        plant: The plant.
        context: The plant's own Context.
        inputs: Addresses within the plant of the values that become symbols: ``mass``, ``center_of_mass``
            and ``inertia`` of a body, ``damping`` of a joint, ``pose`` of a frame that carries a joint, and
            ``rotor_inertia`` and ``gear_ratio`` of an actuator, as in `multibody_variables`.
        controllers: Whether actuators may have PD controllers.

    Raises:
        UnsupportedPlantError: The plant has contact, loops, springs, joints of other types, and so on.
        ValueError: An input is not among the addresses, or given twice.
    """
    reasons = list(_unsupported(plant, context, controllers=controllers))
    if reasons:
        raise UnsupportedPlantError(f"the plant cannot be compiled: {'; '.join(reasons)}.")
    return _LinkReader(plant, context, inputs).tree()


class _LinkReader:
    """Reads the links of one plant."""

    def __init__(self, plant: MultibodyPlant, context: Context, inputs: Sequence[str]) -> None:
        self._plant = plant
        self._context = context
        self._inputs = tuple(inputs)
        self._symbols: dict[str, Expression] = {}
        self._values: dict[str, NDArray[np.float64]] = {}
        self._offered: set[str] = set()
        self._mounts: dict[int, tuple[int, Pose]] = {}
        self._links: list[Link] = []
        self._inertias: dict[int, Expression] = {}
        self._welds: dict[int, int] = {}
        self._largest = _largest_length(plant, context)
        self._rounding = rounding_beside(self._largest)

    def tree(self) -> LinkTree:
        reflected = self._reflected_inertias()
        self._mounts[int(self._plant.world_body().index())] = -1, constant_pose(RigidTransform(), self._rounding)
        waiting = [self._plant.get_joint(index) for index in self._plant.GetJointIndices()]
        while waiting:
            reached = [[int(b.index()) in self._mounts for b in (j.parent_body(), j.child_body())] for j in waiting]
            k = next((i for i, (parent, child) in enumerate(reached) if parent != child), None)
            if k is None:
                names = ", ".join(joint.name() for joint in waiting)
                raise UnsupportedPlantError(f"the plant cannot be compiled: a loop is closed by the joints {names}.")
            self._mount(waiting.pop(k), reflected, reverse=reached[k][1])
        self._check_inputs()
        symbols = {address: self._symbols[address] for address in self._inputs}
        values = {address: self._values[address] for address in self._inputs}
        return LinkTree(tuple(self._links), self._mounts, self._inertias, self._welds, symbols, values, self._rounding)

    def _mount(self, joint: Joint, reflected: dict[int, Expression], *, reverse: bool) -> None:
        """Add the body that a joint carries; its child, or its parent in ``reverse``."""
        inner, outer = joint.frame_on_parent(), joint.frame_on_child()
        if reverse:
            inner, outer = outer, inner
        body = outer.body()
        parent, X_PB = self._mounts[int(inner.body().index())]
        X_PF = times(X_PB, self._frame_pose(inner))
        X_MB = _inverse(self._frame_pose(outer))
        kind = joint.type_name()
        if kind == WELD:
            X_FM = joint.X_FM()
            X_PB = times(times(X_PF, constant_pose(X_FM.inverse() if reverse else X_FM, self._rounding)), X_MB)
            self._mounts[int(body.index())] = parent, X_PB
            self._welds[int(body.index())] = int(inner.body().index())
            inertia = self._inertia(body, X_PB)
            if parent >= 0:
                link = self._links[parent]
                self._links[parent] = replace(link, inertia=link.inertia + inertia)
            return
        if reverse and kind == FLOATING:
            raise UnsupportedPlantError(
                f"the plant cannot be compiled: the parent of the floating joint {joint.name()} hangs on its child."
            )
        axis = np.zeros(3)
        if kind == REVOLUTE:
            axis = np.asarray(joint.revolute_axis())
        elif kind == PRISMATIC:
            axis = np.asarray(joint.translation_axis())
        q, v, nv = joint.position_start(), joint.velocity_start(), joint.num_velocities()
        self._mounts[int(body.index())] = len(self._links), X_MB
        self._links.append(
            Link(
                joint=int(joint.index()),
                parent=parent,
                carrier=int(inner.body().index()),
                kind=kind,
                # Seen from its child, a joint turns or slides the other way.
                axis=constant(-axis if reverse else axis),
                q=slice(q, q + joint.num_positions()),
                v=slice(v, v + nv),
                X_PF=X_PF,
                inertia=self._inertia(body, X_MB),
                damping=self._input(f"{self._address(joint)}.damping", joint.GetDampingVector(self._context)),
                reflected_inertia=reflected.get(int(joint.index()), casadi.SX(nv, 1)),
            )
        )

    def _inertia(self, body: RigidBody, X_MB: Pose) -> Expression:
        """Return M_BMo_M, as a matrix."""
        address = self._address(body)
        M_BBo_B = body.CalcSpatialInertiaInBodyFrame(self._context)
        p_BoBcm_B = M_BBo_B.get_com()
        G_BBcm_B = M_BBo_B.get_unit_inertia().ShiftToCenterOfMass(p_BoBcm_B).CopyToFullMatrix3()
        I_BBcm_B = M_BBo_B.get_mass() * G_BBcm_B
        mass = self._input(f"{address}.mass", M_BBo_B.get_mass())
        com = self._input(f"{address}.center_of_mass", p_BoBcm_B, self._rounding)
        moments = [(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)]
        rotational = self._input(f"{address}.inertia", [I_BBcm_B[i, j] for i, j in moments])
        if f"{address}.inertia" in self._inputs:
            xx, yy, zz, xy, xz, yz = casadi.vertsplit(rotational)
            I_cm = casadi.blockcat([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        else:
            # As in Drake, a body of another mass keeps its shape.
            I_cm = mass * constant(G_BBcm_B, rounding_beside(self._largest**2))
        R, p = X_MB
        I_cm = R @ I_cm @ R.T
        c = skew(p + R @ com)
        blocks = [[I_cm - mass * (c @ c), mass * c], [mass * c.T, mass * casadi.SX.eye(3)]]
        return self._inertias.setdefault(int(body.index()), symmetric(casadi.blockcat(blocks)))

    def _frame_pose(self, frame: Frame) -> Pose:
        """Return X_BF of a frame F on the body B."""
        X_BF = frame.CalcPoseInBodyFrame(self._context)
        if not isinstance(frame, FixedOffsetFrame):
            return constant_pose(X_BF, self._rounding)
        X_PF = frame.GetPoseInParentFrame(self._context)
        address = f"{self._address(frame)}.pose"
        if address not in self._inputs:
            self._offered.add(address)
            return constant_pose(X_BF, self._rounding)
        if address not in self._symbols:
            self._check_alone(frame, address)
        value = np.concatenate([X_PF.translation(), X_PF.rotation().ToRollPitchYaw().vector()])
        pose = self._input(address, value)
        return times(constant_pose(X_BF @ X_PF.inverse(), self._rounding), (roll_pitch_yaw(pose[3:]), pose[:3]))

    def _check_alone(self, frame: FixedOffsetFrame, address: str) -> None:
        """Refuse a pose on which the poses of further frames depend."""
        moved = self._context.Clone()
        frame.SetPoseInParentFrame(moved, frame.GetPoseInParentFrame(moved) @ RigidTransform([1.0, 0.0, 0.0]))
        for index in self._plant.GetJointIndices():
            joint = self._plant.get_joint(index)
            for other in (joint.frame_on_parent(), joint.frame_on_child()):
                before, after = (other.CalcPoseInBodyFrame(c).translation() for c in (self._context, moved))
                if other.index() != frame.index() and not np.array_equal(before, after):
                    raise ValueError(f"{address} cannot be an input: the frame {other.name()} is attached to it.")

    def _reflected_inertias(self) -> dict[int, Expression]:
        """Return the reflected inertia of each joint's actuator, by the joint's index."""
        inertias: dict[int, Expression] = {}
        for index in self._plant.GetJointActuatorIndices():
            actuator = self._plant.get_joint_actuator(index)
            address = self._address(actuator)
            rotor = self._input(f"{address}.rotor_inertia", actuator.rotor_inertia(self._context))
            gear = self._input(f"{address}.gear_ratio", actuator.gear_ratio(self._context))
            inertias[int(actuator.joint().index())] = gear**2 * rotor
        return inertias

    def _input(self, address: str, value: ArrayLike, rounding: float = 0.0) -> Expression:
        """Return the symbol of an input, or the value itself, shape (n, 1); see `constant`."""
        array = np.asarray(value, dtype=float).ravel()
        self._offered.add(address)
        if address not in self._inputs:
            return constant(array, rounding)
        self._values[address] = array
        return self._symbols.setdefault(address, casadi.SX.sym(input_name(address), array.size))

    def _check_inputs(self) -> None:
        for address in self._inputs:
            if address not in self._symbols:
                near = difflib.get_close_matches(address, self._offered, n=1, cutoff=0.0)
                raise ValueError(f"{address!r} cannot be an input of this plant; did you mean {near[0]!r}?")
            if self._inputs.count(address) > 1:
                raise ValueError(f"the input {address} is given more than once.")

    def _address(self, element: Any) -> str:
        return element_address(self._plant, element)


def _unsupported(plant: MultibodyPlant, context: Context, *, controllers: bool) -> Iterator[str]:
    """Yield the parts of the plant that cannot be compiled."""
    for index in plant.GetJointIndices():
        joint = plant.get_joint(index)
        if joint.type_name() not in (REVOLUTE, PRISMATIC, WELD, FLOATING):
            yield f"the joint {joint.name()} is of type {joint.type_name()}"
        elif joint.is_locked(context):
            yield f"the joint {joint.name()} is locked"
    drives: dict[JointIndex, list[str]] = {}
    for index in plant.GetJointActuatorIndices():
        actuator = plant.get_joint_actuator(index)
        if actuator.has_controller() and not controllers:
            yield f"the actuator {actuator.name()} has a PD controller"
        # By index: joints of two model instances may have one name.
        drives.setdefault(actuator.joint().index(), []).append(actuator.name())
    for joint_index, names in drives.items():
        if len(names) > 1:
            # Drake sums their torques in a continuous plant, but takes the last one's torque in a discrete one; in both
            # it takes the last reflected inertia.
            joint_name = plant.get_joint(joint_index).name()
            yield f"the joint {joint_name} has {len(names)} actuators ({', '.join(names)}): give it one"
    yield from _other_inputs(plant, context)
    if plant.num_constraints():
        yield f"there are {plant.num_constraints()} constraints between bodies or joints"
    if plant.deformable_model().num_bodies():
        yield f"there are {plant.deformable_model().num_bodies()} deformable bodies"
    for k in range(1, plant.num_force_elements()):
        yield f"there is a force element of type {type(plant.get_force_element(ForceElementIndex(k))).__name__}"
    grounded = [body for body in bodies(plant) if not plant.is_gravity_enabled(body.model_instance())]
    if grounded and np.any(plant.gravity_field().gravity_vector()):
        instances = {plant.GetModelInstanceName(ModelInstanceIndex(body.model_instance())) for body in grounded}
        yield f"gravity is disabled for the model instances {', '.join(sorted(instances))}"
    yield from contacts(plant, context)


def _other_inputs(plant: MultibodyPlant, context: Context) -> Iterator[str]:
    """Yield the input ports that act on the plant beside its actuation, which is an argument."""
    # By name: after calls of the getters of these ports, plants stayed alive (tests/testbed/test_memory.py).
    for k in range(plant.num_input_ports()):
        port = plant.get_input_port(k)
        if port.get_name() not in ("actuation", "geometry_query") and port.HasValue(context):
            yield f"the input port {port.get_name()} is connected or has a fixed value"


def colliding(plant: MultibodyPlant, context: Context) -> Iterator[tuple[_OnBody, _OnBody]]:
    """Yield the pairs of collision geometries that may touch each other, each with its body.

    Args:
        plant: The plant, finalized.
        context: The plant's own Context; unless its geometry query is connected, there is no contact.
    """
    port = plant.get_geometry_query_input_port()
    if not plant.num_collision_geometries() or not port.HasValue(context):
        return
    body_of = {
        geometry: body
        for body in (plant.world_body(), *bodies(plant))
        for geometry in plant.GetCollisionGeometriesForBody(body)
    }
    for a, b in port.Eval(context).inspector().GetCollisionCandidates():
        if a in body_of and b in body_of:
            yield (a, body_of[a]), (b, body_of[b])


def contacts(plant: MultibodyPlant, context: Context) -> Iterator[str]:
    """Yield the pairs of bodies that may touch each other.

    Args:
        plant: The plant, finalized.
        context: The plant's own Context; unless its geometry query is connected, there is no contact.
    """
    pairs = {tuple(sorted((body_a.name(), body_b.name()))) for (_, body_a), (_, body_b) in colliding(plant, context)}
    for first, second in sorted(pairs):
        yield f"{first} and {second} can collide (exclude them by a CollisionFilterDeclaration)"


def _largest_length(plant: MultibodyPlant, context: Context) -> float:
    """Return the largest length of a plant in m: of its bodies, and from body to joint."""
    lengths = [0.0]
    for body in bodies(plant):
        M_BBo_B = body.CalcSpatialInertiaInBodyFrame(context)
        lengths += [*np.abs(M_BBo_B.get_com()), *np.sqrt(np.abs(M_BBo_B.get_unit_inertia().get_moments()))]
    for index in plant.GetJointIndices():
        joint = plant.get_joint(index)
        for frame in (joint.frame_on_parent(), joint.frame_on_child()):
            lengths += np.abs(frame.CalcPoseInBodyFrame(context).translation()).tolist()
    return float(np.nanmax(lengths))


# -- small algebra, which keeps structural zeros: they cost nothing later


def constant(values: ArrayLike, rounding: float = _ROUNDING) -> Expression:
    """Return numbers as an expression without structural zeros.

    Args:
        values: The numbers.
        rounding: What is smaller is zero.
    """
    array = np.asarray(values, dtype=float)
    return casadi.sparsify(casadi.SX(casadi.DM(np.where(np.abs(array) < rounding, 0.0, array))))


def rounding_beside(largest: float) -> float:
    """Return the size below which a number beside the largest one of its kind is what rounding left of a zero."""
    return min(_ROUNDING, _RELATIVE_ROUNDING * largest)


def constant_pose(X_AB: RigidTransform, rounding: float) -> Pose:
    """Return a pose of numbers.

    Args:
        X_AB: The pose.
        rounding: A length in m; what is shorter is zero.
    """
    return constant(X_AB.rotation().matrix()), constant(X_AB.translation(), rounding)


def skew(a: Expression) -> Expression:
    """Return the matrix [a] with [a] b = a x b."""
    return casadi.sparsify(casadi.skew(casadi.densify(a)))


def symmetric(M: Expression) -> Expression:
    """Return M, whose lower half is not computed but copied."""
    return casadi.sparsify(casadi.triu2symm(casadi.triu(M)))


def roll_pitch_yaw(angles: Expression) -> Expression:
    """Return R of the angles about the fixed axes x, y and z, one after the other, as in Drake's RollPitchYaw."""
    roll, pitch, yaw = casadi.vertsplit(angles)
    x, y, z = (constant(axis) for axis in np.eye(3))
    return rotation(z, yaw) @ rotation(y, pitch) @ rotation(x, roll)


def rotation(axis: Expression, angle: Expression) -> Expression:
    """Return R of a turn about a unit vector, by Rodrigues' formula.

    Args:
        axis: The unit vector, (3, 1).
        angle: The angle in rad, a scalar.
    """
    along = axis @ axis.T
    across = casadi.sparsify(casadi.SX.eye(3) - along)
    return casadi.sparsify(along + casadi.cos(angle) * across + casadi.sin(angle) * skew(axis))


def input_name(address: str) -> str:
    """Return the name of an input as an argument of a casadi.Function, in which dots are not allowed."""
    return casadi.Function.fix_name(address)


def times(X_AB: Pose, X_BC: Pose) -> Pose:
    """Return X_AC.

    Args:
        X_AB: The pose of frame B in frame A, as rotation and translation (m).
        X_BC: The pose of frame C in frame B.
    """
    return X_AB[0] @ X_BC[0], X_AB[1] + X_AB[0] @ X_BC[1]


def _inverse(X_AB: Pose) -> Pose:
    R, p = X_AB
    return R.T, -(R.T @ p)
