"""The variables of a MultibodyPlant: its joints, bodies, frames, actuators, constraints and contact friction."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from math import inf
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from pydrake.geometry import GeometryId, ProximityProperties, RoleAssign, SceneGraph, SceneGraphInspector
from pydrake.math import RollPitchYaw
from pydrake.multibody.plant import CoulombFriction, DistanceConstraintParams, MultibodyPlant
from pydrake.multibody.tree import (
    DeformableBody,
    FixedOffsetFrame,
    FrameIndex,
    Joint,
    JointActuator,
    ModelInstanceIndex,
    MultibodyConstraintId,
    RigidBody,
    SpatialInertia,
    UnitInertia,
    default_model_instance,
    world_model_instance,
)
from pydrake.systems.framework import Context

from vtbdrake.state.declarations import CONTINUOUS, DISCRETE
from vtbdrake.state.systems import POSE_NAMES, POSE_UNIT, pose_from_array, pose_to_array
from vtbdrake.state.variables import A, Place, Variable, VariableError, X

# Name of a model instance -> the dotted prefix of the addresses of its variables.
Prefix = Callable[[str], str]

# The units of a joint's positions, velocities and damping, by Drake's name of its type.
_TURNING = ("rad", "rad/s", "N m s/rad")
_JOINT_UNITS = {
    "revolute": _TURNING,
    "screw": _TURNING,
    "universal": _TURNING,
    "ball_rpy": _TURNING,
    "prismatic": ("m", "m/s", "N s/m"),
    "planar": ("m, m, rad", "m/s, m/s, rad/s", "N s/m, N s/m, N m s/rad"),
    # A unit quaternion, which has no unit, and a position.
    "quaternion_floating": ("1, 1, 1, 1, m, m, m", "rad/s, m/s", "N m s/rad, N s/m"),
}
_MIXED_UNITS = ("rad, m", "rad/s, m/s", "N m s/rad, N s/m")
# What is derived from the pose of a body, with its units: the entries of [x, y, z, roll, pitch, yaw].
POSE_ENTRIES = {"x": "m", "y": "m", "height": "m", "roll": "rad", "pitch": "rad", "yaw": "rad"}
FRICTION = ("material", "coulomb_friction")  # group and name of the property
_ROD = ("bodyA", "p_AP", "bodyB", "p_BQ", "distance", "stiffness", "damping")  # of a distance constraint


def _within_plant(instance: str) -> str:
    return ""


def multibody_variables(plant: MultibodyPlant, *, prefix: Prefix = _within_plant) -> Iterator[Variable]:
    """Yield every variable of ``plant``; derived ones (roll, pitch, yaw, height, x, y) of floating bases only.

    Args:
        plant: The plant, finalized.
        prefix: Name of a model instance -> dotted prefix of its addresses; by default none, so that they are within the
            plant.
    """
    for index in plant.GetJointIndices():
        joint = plant.get_joint(index)
        if joint.num_velocities() > 0:
            yield from _joint_variables(plant, joint, element_address(plant, joint, prefix))
    for body in bodies(plant):
        address = element_address(plant, body, prefix)
        yield from _body_variables(plant, body, address)
        if body.is_floating_base_body():
            yield _floating_pose(plant, body, address)
            for entry in POSE_ENTRIES:
                yield _pose_entry(plant, body, address, entry)
    for index in range(plant.num_frames()):
        frame = plant.get_frame(FrameIndex(index))
        # Names that begin with underscores come from the parser, not from the model.
        named = frame.name() and not frame.name().startswith("__")
        if isinstance(frame, FixedOffsetFrame) and named and not frame.is_ephemeral():
            yield _frame_pose(plant, frame, element_address(plant, frame, prefix))
    for index in plant.GetJointActuatorIndices():
        actuator = plant.get_joint_actuator(index)
        yield from _rotor_variables(plant, actuator, element_address(plant, actuator, prefix))
    if plant.num_constraints():
        yield from _constraint_variables(plant, prefix(plant.GetModelInstanceName(default_model_instance())))
    yield from _deformable_variables(plant, prefix)


def pose_entries_by_demand(plant: MultibodyPlant, *, prefix: Prefix) -> dict[str, Callable[[], Variable]]:
    """Return makers of the derived pose entries of every body that is not a floating base, by address.

    Args:
        plant: The plant, finalized.
        prefix: Name of a model instance -> dotted prefix of its addresses.
    """

    def demand(body: RigidBody, address: str, entry: str) -> Callable[[], Variable]:
        return lambda: _pose_entry(plant, body, address, entry)

    return {
        f"{address}.{entry}": demand(body, address, entry)
        for body in bodies(plant)
        if not body.is_floating_base_body()
        for address in [element_address(plant, body, prefix)]
        for entry in POSE_ENTRIES
    }


def bodies(plant: MultibodyPlant) -> Iterator[RigidBody]:
    """Yield all bodies except the world, by model instance."""
    for instance in range(1, plant.num_model_instances()):
        for index in plant.GetBodyIndices(ModelInstanceIndex(instance)):
            yield plant.get_body(index)


def element_address(
    plant: MultibodyPlant,
    element: RigidBody | DeformableBody | Joint | FixedOffsetFrame | JointActuator,
    prefix: Prefix = _within_plant,
) -> str:
    """Return the address ``prefix.instance.element``, without an instance that Drake itself has named.

    Without a prefix, it is the address within the plant. If an element has the name of its model instance, the name
    occurs once.

    Args:
        plant: The plant to which the element belongs.
        element: A body, joint, fixed frame or actuator.
        prefix: Name of a model instance -> dotted prefix of its addresses; by default none.
    """
    instance = plant.GetModelInstanceName(element.model_instance())
    named = element.model_instance() not in (world_model_instance(), default_model_instance())
    parts = [prefix(instance), instance.replace("::", ".") if named else ""]
    if not named or element.name() != instance.split("::")[-1]:
        parts.append(element.name())
    return ".".join(part for part in parts if part)


def _joint_variables(plant: MultibodyPlant, joint: Joint, address: str) -> Iterator[Variable]:
    nq, nv = joint.num_positions(), joint.num_velocities()
    q = slice(joint.position_start(), joint.position_start() + nq)
    v = slice(joint.velocity_start(), joint.velocity_start() + nv)
    units = _JOINT_UNITS.get(joint.type_name(), _MIXED_UNITS)
    shapes = [() if n == 1 else (n,) for n in (nq, nv)]

    def set_positions(context: Context, value: np.ndarray) -> None:
        positions = plant.GetPositions(context)
        positions[q] = value.ravel()
        plant.SetPositions(context, positions)

    def set_velocities(context: Context, value: np.ndarray) -> None:
        velocities = plant.GetVelocities(context)
        velocities[v] = value.ravel()
        plant.SetVelocities(context, velocities)

    def set_damping(context: Context, value: np.ndarray) -> None:
        joint.SetDampingVector(context, np.atleast_1d(value))

    group = CONTINUOUS if plant.time_step() == 0.0 else DISCRETE
    bounds = (-inf, inf)
    if nq == 1:
        bounds = (float(joint.position_lower_limits()[0]), float(joint.position_upper_limits()[0]))
    variable = partial(_variable, plant)
    # Drake's suffixes, such as "qw" and "vx".
    q_names = tuple(map(joint.position_suffix, range(nq))) if nq > 1 else ()
    v_names = tuple(map(joint.velocity_suffix, range(nv))) if nv > 1 else ()
    yield variable(f"{address}.position", X, shapes[0], units[0], lambda context: plant.GetPositions(context)[q],
                   set_positions, bounds=bounds, place=Place(plant, group, 0, q.start),
                   entry_names=q_names)  # fmt: skip
    yield variable(f"{address}.velocity", X, shapes[1], units[1], lambda context: plant.GetVelocities(context)[v],
                   set_velocities, place=Place(plant, group, 0, plant.num_positions() + v.start),
                   entry_names=v_names)  # fmt: skip
    yield variable(f"{address}.damping", A, shapes[1], units[2], joint.GetDampingVector, set_damping,
                   bounds=(0.0, inf), entry_names=v_names)  # fmt: skip
    if plant.time_step() > 0.0:  # Every supported Drake version locks the joints of discrete plants.
        yield _joint_lock(plant, joint, f"{address}.locked")


def _variable(
    plant: MultibodyPlant,
    address: str,
    kind: str,
    shape: tuple[int, ...],
    unit: str,
    read: Callable[[Context], ArrayLike],
    write: Callable[[Context, np.ndarray], None],
    **options: Any,
) -> Variable:
    """Return a variable that is read and written in the plant's own context."""

    def read_root(root: Context) -> ArrayLike:
        value = read(plant.GetMyContextFromRoot(root))
        return value if shape else np.ravel(value)[0]

    def write_root(root: Context, value: np.ndarray) -> None:
        write(plant.GetMyMutableContextFromRoot(root), value)

    return Variable(address, kind, shape, unit, read_root, write_root, **options)


def _joint_lock(plant: MultibodyPlant, joint: Joint, address: str) -> Variable:
    def write(context: Context, value: np.ndarray) -> None:
        if value:
            joint.Lock(context)  # This sets the joint's velocity to zero, as Drake requires.
        else:
            joint.Unlock(context)

    # Written last: locking stops the joint, and a locked joint takes no velocity.
    return _flag(plant, address, "0 (free) or 1 (locked)", joint.is_locked, write, order=1)


def _flag(
    plant: MultibodyPlant,
    address: str,
    meaning: str,
    read: Callable[[Context], bool],
    write: Callable[[Context, np.ndarray], None],
    order: int = 0,
) -> Variable:
    """Return a hidden variable that is 0 or 1."""

    def refuse(value: np.ndarray) -> None:
        if float(value) not in (0.0, 1.0):
            raise VariableError(f"{address} is {meaning}, but the value given is {float(value):g}")

    return _variable(plant, address, A, (), "1", read, write, bounds=(0.0, 1.0), carried_by=address, order=order,
                     refuse=refuse)  # fmt: skip


def _constraint_variables(plant: MultibodyPlant, prefix: str) -> Iterator[Variable]:
    """Yield for each constraint, which Drake gives no name, whether it is active, and the rod of a distance constraint.

    Drake keeps them in abstract parameters, which no copy of the numeric groups contains.
    """

    def active(constraint: MultibodyConstraintId, address: str) -> Variable:
        return _flag(
            plant,
            f"{address}.active",
            "0 (not active) or 1 (active)",
            lambda context: plant.GetConstraintActiveStatus(context, constraint),
            lambda context, value: plant.SetConstraintActiveStatus(context, constraint, bool(value)),
        )

    distances = plant.GetDefaultDistanceConstraintParams()
    for number, constraint in enumerate(sorted(plant.GetConstraintIds(), key=MultibodyConstraintId.get_value)):
        address = f"{prefix}.constraint_{number}" if prefix else f"constraint_{number}"
        yield active(constraint, address)
        if constraint in distances:
            yield from _rod_variables(plant, constraint, address)


def _rod_variables(plant: MultibodyPlant, constraint: MultibodyConstraintId, address: str) -> Iterator[Variable]:
    """Yield what a distance constraint holds; its stiffness is 0 where the rod is rigid, as no variable is infinite."""

    def entries(context: Context) -> dict[str, Any]:
        params = plant.GetDistanceConstraintParams(context, constraint)
        return {name: getattr(params, name)() for name in _ROD}

    def change(context: Context, **changed: Any) -> None:
        params = DistanceConstraintParams(**{**entries(context), **changed})
        plant.SetDistanceConstraintParams(context, constraint, params)

    def read_stiffness(context: Context) -> float:
        stiffness = float(entries(context)["stiffness"])
        return stiffness if stiffness < inf else 0.0

    def read_points(context: Context) -> np.ndarray:
        rod = entries(context)
        return np.concatenate([rod["p_AP"], rod["p_BQ"]])

    def refuse_zero(value: np.ndarray) -> None:
        if value <= 0.0:
            raise VariableError(f"{address}.distance is above 0 m, but the value given is {float(value):g}")

    def variable(name: str, *args: Any, **options: Any) -> Variable:
        return _variable(plant, f"{address}.{name}", A, *args, carried_by=f"{address}.{name}", **options)

    yield variable("distance", (), "m", lambda context: entries(context)["distance"],
                   lambda context, value: change(context, distance=float(value)), bounds=(0.0, inf),
                   refuse=refuse_zero)  # fmt: skip
    yield variable("stiffness", (), "N/m", read_stiffness,
                   lambda context, value: change(context, stiffness=float(value) or inf),
                   bounds=(0.0, inf))  # fmt: skip
    yield variable("damping", (), "N s/m", lambda context: entries(context)["damping"],
                   lambda context, value: change(context, damping=float(value)), bounds=(0.0, inf))  # fmt: skip
    yield variable("points", (6,), "m", read_points,
                   lambda context, value: change(context, p_AP=value[:3], p_BQ=value[3:]),
                   entry_names=("a_x", "a_y", "a_z", "b_x", "b_y", "b_z"))  # fmt: skip


def _deformable_variables(plant: MultibodyPlant, prefix: Prefix) -> Iterator[Variable]:
    """Yield for each deformable body whether it is enabled, which Drake keeps in an abstract parameter."""
    model = plant.deformable_model()
    if not model.num_bodies():
        return

    def enabled(body: DeformableBody) -> Variable:
        return _flag(
            plant,
            f"{element_address(plant, body, prefix)}.enabled",
            "0 (disabled) or 1 (enabled)",
            body.is_enabled,
            lambda context, value: body.Enable(context) if value else body.Disable(context),
        )

    for instance in map(ModelInstanceIndex, range(plant.num_model_instances())):
        for body in map(model.GetBody, model.GetBodyIds(instance)):
            yield enabled(body)


def _body_variables(plant: MultibodyPlant, body: RigidBody, address: str) -> Iterator[Variable]:
    inertia = body.CalcSpatialInertiaInBodyFrame

    def read_inertia(context: Context) -> np.ndarray:
        M_BBo_B = inertia(context)
        I_BBcm_B = M_BBo_B.Shift(M_BBo_B.get_com()).CalcRotationalInertia()
        return np.concatenate([I_BBcm_B.get_moments(), I_BBcm_B.get_products()])

    def write_com(context: Context, value: np.ndarray) -> None:
        # SpatialInertia keeps the inertia about the body's origin: without a shift, it would become unphysical.
        M_BBo_B = inertia(context)
        G_BBcm_B = M_BBo_B.get_unit_inertia().ShiftToCenterOfMass(M_BBo_B.get_com())
        M_new = SpatialInertia(M_BBo_B.get_mass(), value, G_BBcm_B.ShiftFromCenterOfMass(value))
        body.SetSpatialInertiaInBodyFrame(context, M_new)

    def write_inertia(context: Context, value: np.ndarray) -> None:
        M_BBo_B = inertia(context)
        mass, com = M_BBo_B.get_mass(), M_BBo_B.get_com()
        if mass <= 0.0:
            raise VariableError(f"{address}.inertia cannot be set while {address}.mass is zero: set the mass first")
        body.SetSpatialInertiaInBodyFrame(context, make_inertia(mass, com, value))

    def make_inertia(mass: float, com: np.ndarray, value: np.ndarray) -> SpatialInertia:
        try:
            return SpatialInertia(mass, com, UnitInertia(*(value / mass)).ShiftFromCenterOfMass(com))
        except RuntimeError as error:
            reason = str(error).splitlines()[0]
            raise VariableError(
                f"{address}.inertia {value.tolist()} belongs to no rigid body: its principal moments must be "
                f"positive and none larger than the sum of the others ({reason})"
            ) from None

    variable = partial(_variable, plant)
    yield variable(f"{address}.mass", A, (), "kg", body.get_mass, lambda context, m: body.SetMass(context, float(m)),
                   bounds=(0.0, inf), order=-3)  # fmt: skip
    yield variable(f"{address}.center_of_mass", A, (3,), "m", lambda context: inertia(context).get_com(), write_com,
                   order=-2, entry_names=("x", "y", "z"))  # fmt: skip
    yield variable(f"{address}.inertia", A, (6,), "kg m^2", read_inertia, write_inertia, order=-1,
                   refuse=lambda value: make_inertia(1.0, np.zeros(3), value),
                   entry_names=("xx", "yy", "zz", "xy", "xz", "yz"))  # fmt: skip


def _floating_pose(plant: MultibodyPlant, body: RigidBody, address: str) -> Variable:
    def read(context: Context) -> np.ndarray:
        return pose_to_array(plant.GetFreeBodyPose(context, body))

    def write(context: Context, value: np.ndarray) -> None:
        plant.SetFreeBodyPose(context, body, pose_from_array(value))

    return _variable(plant, f"{address}.pose", X, (6,), POSE_UNIT, read, write, entry_names=POSE_NAMES)


def _pose_entry(plant: MultibodyPlant, body: RigidBody, address: str, entry: str) -> Variable:
    axis, unit = list(POSE_ENTRIES).index(entry) % 3, POSE_ENTRIES[entry]

    def read(root: Context) -> float:
        X_WB = body.EvalPoseInWorld(plant.GetMyContextFromRoot(root))
        vector = X_WB.translation() if unit == "m" else RollPitchYaw(X_WB.rotation()).vector()
        return float(vector[axis])

    return Variable(f"{address}.{entry}", X, (), unit, read)


def _frame_pose(plant: MultibodyPlant, frame: FixedOffsetFrame, address: str) -> Variable:
    def read(context: Context) -> np.ndarray:
        return pose_to_array(frame.GetPoseInParentFrame(context))

    def write(context: Context, value: np.ndarray) -> None:
        frame.SetPoseInParentFrame(context, pose_from_array(value))

    return _variable(plant, f"{address}.pose", A, (6,), POSE_UNIT, read, write, entry_names=POSE_NAMES)


def _rotor_variables(plant: MultibodyPlant, actuator: JointActuator, address: str) -> Iterator[Variable]:
    yield _variable(
        plant,
        f"{address}.rotor_inertia",
        A,
        (),
        "kg m^2" if actuator.joint().type_name() != "prismatic" else "kg",
        actuator.rotor_inertia,
        lambda context, value: actuator.SetRotorInertia(context, float(value)),
        bounds=(0.0, inf),
    )
    yield _variable(
        plant,
        f"{address}.gear_ratio",
        A,
        (),
        "1" if actuator.joint().type_name() != "prismatic" else "1/m",
        actuator.gear_ratio,
        lambda context, value: actuator.SetGearRatio(context, float(value)),
    )


def friction_variables(plant: MultibodyPlant, scene_graph: SceneGraph, *, prefix: Prefix) -> Iterator[Variable]:
    """Yield a coefficient of friction for every body with collision geometry, and for every geometry of the world.

    Args:
        plant: The plant, finalized.
        scene_graph: The SceneGraph with which the plant is registered as a source.
        prefix: Name of a model instance -> dotted prefix of its addresses.
    """
    inspector = scene_graph.model_inspector()

    def with_friction(geometry: GeometryId) -> bool:
        properties = inspector.GetProximityProperties(geometry)
        return properties is not None and properties.HasProperty(*FRICTION)

    world = plant.world_body()
    world_prefix = prefix(plant.GetModelInstanceName(world.model_instance()))
    for geometry in plant.GetCollisionGeometriesForBody(world):
        if with_friction(geometry):
            name = inspector.GetName(geometry).replace("::", ".")
            address = f"{world_prefix}.{name}" if world_prefix else name
            yield from _friction(address, plant, scene_graph, [geometry])
    for body in bodies(plant):
        geometries = [g for g in plant.GetCollisionGeometriesForBody(body) if with_friction(g)]
        if geometries:
            yield from _friction(element_address(plant, body, prefix), plant, scene_graph, geometries)


def _friction(
    address: str, plant: MultibodyPlant, scene_graph: SceneGraph, geometries: list[GeometryId]
) -> Iterator[Variable]:
    """Yield ``friction``, one coefficient for all geometries, and the static and dynamic ones that carry it.

    The value of ``friction`` is the dynamic coefficient of the first geometry: Drake's discrete and convex contact
    models use the dynamic coefficients only.
    """
    by_geometry = f"{address}.friction_by_geometry"

    def inspect(root: Context) -> SceneGraphInspector:
        context = scene_graph.GetMyContextFromRoot(root)
        return scene_graph.get_query_output_port().Eval(context).inspector()

    def read(root: Context) -> np.ndarray:
        inspector = inspect(root)
        frictions = [inspector.GetProximityProperties(geometry).GetProperty(*FRICTION) for geometry in geometries]
        return np.array([[friction.static_friction(), friction.dynamic_friction()] for friction in frictions])

    def refuse(value: np.ndarray) -> None:
        if (value[:, 0] < value[:, 1]).any():
            raise VariableError(f"{by_geometry} is [static, dynamic] of each geometry, the dynamic one not larger")

    def write(root: Context, value: np.ndarray) -> None:
        inspector = inspect(root)
        changed = [ProximityProperties(inspector.GetProximityProperties(geometry)) for geometry in geometries]
        context = scene_graph.GetMyMutableContextFromRoot(root)
        for geometry, properties, coefficients in zip(geometries, changed, value, strict=True):
            properties.UpdateProperty(*FRICTION, CoulombFriction(*coefficients))
            scene_graph.AssignRole(context, plant.get_source_id(), geometry, properties, RoleAssign.kReplace)

    def write_all(root: Context, value: np.ndarray) -> None:
        write(root, np.full((len(geometries), 2), float(value)))

    first = f"{address}.friction"
    yield Variable(
        first, A, (), "1", lambda root: read(root)[0, 1], write_all, bounds=(0.0, inf), carried_by=by_geometry
    )
    yield Variable(
        by_geometry,
        A,
        (len(geometries), 2),
        "1",
        read,
        write,
        bounds=(0.0, inf),
        carried_by=by_geometry,
        refuse=refuse,
    )
