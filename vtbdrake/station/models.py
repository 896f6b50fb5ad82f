"""The models of a station without their geometry: the arms as their own software knows them, limits, and checks."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from pydrake.manipulation import IiwaDriver
from pydrake.multibody.parsing import ModelInstanceInfo, Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import Joint, RigidBody

from vtbdrake.common.arrays import Array
from vtbdrake.testbed import ScenarioError

_log = logging.getLogger(__name__)
_SMALLEST_INERTIA = 1e-9  # kg m^2 or kg, that a driven joint moves


@dataclass(frozen=True)
class JointLimits:
    """The limits of the joints of a model that its drivers move, in the order of its velocities; infinite if missing.

    Each is an array of shape (n,).

    Attributes:
        lower: The lower ends of the ranges, in rad or m.
        upper: The upper ends of the ranges, in rad or m.
        speed: The largest speeds, in rad/s or m/s.
        acceleration: The largest accelerations, in rad/s^2 or m/s^2.
        effort: The largest torques or forces, in N m or N.
    """

    lower: Array
    upper: Array
    speed: Array
    acceleration: Array
    effort: Array


def driven_joints(
    plant: MultibodyPlant, model: ModelInstanceInfo, *, driver: str, where: str
) -> tuple[list[Joint], JointLimits]:
    """Return the joints of a model that a driver moves, and their limits; warn of missing ones.

    Args:
        plant: The finalized plant of the station.
        model: The model.
        driver: The class of the driver, for messages.
        where: File and line of the driver, for messages.

    Raises:
        ScenarioError: The driver cannot move a joint: it has several degrees of freedom, no actuator, or no inertia.
    """
    instance, name = model.model_instance, model.model_name
    joints = [plant.get_joint(index) for index in plant.GetJointIndices(instance)]
    joints = [joint for joint in joints if joint.num_velocities()]
    actuators = {
        actuator.joint().index(): actuator
        for actuator in map(plant.get_joint_actuator, plant.GetJointActuatorIndices(instance))
    }
    for joint in joints:
        problem = ""
        if joint.num_velocities() != 1 or joint.num_positions() != 1:
            problem = (
                f"is a {joint.type_name()} joint with {joint.num_velocities()} degrees of freedom: make it revolute"
            )
            problem += ", prismatic or fixed"
        elif joint.index() not in actuators:
            problem = "has no actuator: give it an effort limit (SDF) or a transmission (URDF), or make it fixed"
        if problem:
            raise ScenarioError(
                f"{where}: {driver} cannot drive {name}: its joint {joint.name()} ({model.model_path}) {problem}"
            )
    joints.sort(key=lambda joint: int(joint.velocity_start()))
    _check_inertia(plant, model, joints, where)
    limits = JointLimits(
        lower=np.array([joint.position_lower_limit() for joint in joints]),
        upper=np.array([joint.position_upper_limit() for joint in joints]),
        speed=np.array([joint.velocity_upper_limit() for joint in joints]),
        acceleration=np.array([joint.acceleration_upper_limit() for joint in joints]),
        effort=np.array([actuators[joint.index()].effort_limit() for joint in joints]),
    )
    for attribute, word, tag in (
        ("upper", "position", "lower and upper"),
        ("speed", "velocity", "velocity"),
        ("effort", "effort", "effort"),
    ):
        bad = [joint.name() for joint, value in zip(joints, getattr(limits, attribute), strict=True) if np.isinf(value)]
        if bad:
            _log.warning(
                "%s: the joints %s of %s (%s) have no %s limit, so neither have their signals: give them a <limit> "
                "with %s",
                where,
                ", ".join(bad),
                name,
                model.model_path,
                word,
                tag,
            )
    return joints, limits


def _check_inertia(plant: MultibodyPlant, model: ModelInstanceInfo, joints: Sequence[Joint], where: str) -> None:
    context = plant.CreateDefaultContext()
    try:
        inertia = np.diag(plant.CalcMassMatrix(context))
    except RuntimeError as error:
        raise ScenarioError(
            f"{where}: the masses of {model.model_name} ({model.model_path}) are wrong: {error}"
        ) from error
    for joint in joints:
        moved = inertia[joint.velocity_start()]
        if not moved > _SMALLEST_INERTIA:
            raise ScenarioError(
                f"{where}: the joint {joint.name()} of {model.model_name} ({model.model_path}) moves no inertia "
                f"({moved:.3g}): give the link {joint.child_body().name()} an <inertial> with mass and inertia"
            )


def arm_model(
    plant: MultibodyPlant, models: Mapping[str, ModelInstanceInfo], name: str, driver: IiwaDriver
) -> MultibodyPlant:
    """Return the plant of an arm with its hand alone, as its control cabinet knows them.

    It has the same joints, masses and gravity as the model that Drake's driver computes with (`MakeArmControllerModel`,
    which Python cannot reach): what is welded to the arm is part of the body that carries it, at the default positions.

    Args:
        plant: The finalized plant of the station.
        models: Its models, by name.
        name: The arm.
        driver: Its driver.
    """
    arm = models[name]
    context = plant.CreateDefaultContext()
    model = MultibodyPlant(0.0)
    model.mutable_gravity_field().set_gravity_vector(plant.gravity_field().gravity_vector())
    (instance,) = Parser(model).AddModels(arm.model_path)
    base = driver.arm_child_frame_name or arm.child_frame_name
    X_WB = plant.GetFrameByName(base, arm.model_instance).CalcPoseInWorld(context)
    model.WeldFrames(model.world_frame(), model.GetFrameByName(base, instance), X_WB)
    attached: set[int] = set()

    def attach(link: RigidBody, bodies: Iterable[RigidBody]) -> None:
        added = {int(body.index()): body.index() for body in bodies if body.model_instance() != arm.model_instance}
        new = [index for number, index in sorted(added.items()) if number not in attached]
        if not new:
            return
        attached.update(added)
        inertia = plant.CalcSpatialInertia(context, link.body_frame(), new)
        burden = model.AddRigidBody(f"attached_to_{link.name()}", instance, inertia)
        model.WeldFrames(model.GetFrameByName(link.name(), instance), burden.body_frame())

    if driver.hand_model_name:
        hand = models[driver.hand_model_name]
        palm = plant.GetFrameByName(hand.child_frame_name, hand.model_instance).body()
        flange = plant.GetFrameByName(driver.gripper_parent_frame_name or hand.parent_frame_name, arm.model_instance)
        fingers = map(plant.get_body, plant.GetBodyIndices(hand.model_instance))
        attach(flange.body(), [*fingers, *plant.GetBodiesWeldedTo(palm)])
    for index in plant.GetBodyIndices(arm.model_instance):
        link = plant.get_body(index)
        if not plant.IsAnchored(link):
            attach(link, plant.GetBodiesWeldedTo(link))
    model.Finalize()
    return model
