"""A plant of Drake for MuJoCo, by its masses, frames and axes."""

from __future__ import annotations

import numpy as np
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import Joint, RigidBody
from pydrake.systems.framework import Context


def mjcf(plant: MultibodyPlant, context: Context, *, time_step: float, integrator: str) -> str:
    """Return the model of a tree of welds, hinges, sliders and floating bodies, without contact, stops and actuators.

    The child frame of a joint is its body's. The joints have their names, damping and reflected inertia.

    Args:
        plant: The plant, finalized.
        context: Its own Context, with the parameters.
        time_step: MuJoCo's time step in seconds.
        integrator: MuJoCo's integrator: ``RK4``, ``implicitfast``, ...
    """
    zero = plant.CreateDefaultContext()
    joints = [plant.get_joint(index) for index in plant.GetJointIndices()]
    for joint in joints:
        if joint.num_positions() == 1:
            joint.Unlock(zero)
            q = plant.GetPositions(zero)
            q[joint.position_start()] = 0.0
            plant.SetPositions(zero, q)
    armature = {}
    for index in plant.GetJointActuatorIndices():
        actuator = plant.get_joint_actuator(index)
        armature[actuator.joint().name()] = actuator.gear_ratio(context) ** 2 * actuator.rotor_inertia(context)
    children: dict[int, list[Joint]] = {}
    for joint in joints:
        children.setdefault(int(joint.parent_body().index()), []).append(joint)

    def element(joint: Joint) -> str:
        body = joint.child_body()
        parent = joint.parent_body()
        X_PB = RigidTransform()
        kind = joint.type_name()
        if kind != "quaternion_floating":
            X_PB = body.body_frame().CalcPose(zero, parent.body_frame())
        below = "".join(element(child) for child in children.get(int(body.index()), []))
        pose = f'pos="{_numbers(X_PB.translation())}" quat="{_numbers(X_PB.rotation().ToQuaternion().wxyz())}"'
        freedom = _freedom(joint, armature.get(joint.name(), 0.0), context)
        return f'<body name="{body.name()}" {pose}>{freedom}{_inertial(body, context)}{below}</body>'

    gravity = _numbers(plant.gravity_field().gravity_vector())
    option = f'<option gravity="{gravity}" timestep="{time_step}" integrator="{integrator}">'
    tree = "".join(element(joint) for joint in children[int(plant.world_body().index())])
    # Mass and inertia are not rounded up, and no pair collides.
    return (
        f'<mujoco><compiler boundmass="0" boundinertia="0" autolimits="false"/>'
        f'{option}<flag contact="disable"/></option><worldbody>{tree}</worldbody></mujoco>'
    )


def _freedom(joint: Joint, armature: float, context: Context) -> str:
    kind = joint.type_name()
    if kind == "weld":
        return ""
    if kind == "quaternion_floating":
        return f'<freejoint name="{joint.name()}"/>'
    axis = joint.revolute_axis() if kind == "revolute" else joint.translation_axis()
    damping = float(joint.GetDampingVector(context)[0])
    return (
        f'<joint name="{joint.name()}" type="{"hinge" if kind == "revolute" else "slide"}" axis="{_numbers(axis)}" '
        f'damping="{damping:.17g}" armature="{armature:.17g}"/>'
    )


def _inertial(body: RigidBody, context: Context) -> str:
    M = body.CalcSpatialInertiaInBodyFrame(context)
    com = M.get_com()
    J = M.Shift(com).CalcRotationalInertia().CopyToFullMatrix3()
    values = _numbers([J[0, 0], J[1, 1], J[2, 2], J[0, 1], J[0, 2], J[1, 2]])
    return f'<inertial pos="{_numbers(com)}" mass="{M.get_mass():.17g}" fullinertia="{values}"/>'


def _numbers(values: object) -> str:
    return " ".join(f"{value:.17g}" for value in np.ravel(values))
