"""The arm in the servicer's controllers: its kinematics, and how its motion turns the base."""

from __future__ import annotations

from functools import lru_cache

import casadi
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import FixedOffsetFrame, RevoluteJoint

from vtbdrake.components.casadi_system.kernel import Kernel
from vtbdrake.components.compiled_plant import FrameMotion, MomentumModel, PlantDynamics
from vtbdrake_diagrams.satellite.bodies import ARM_JOINT_NAMES, ARM_JOINTS, LINK_NAMES, Servicer
from vtbdrake_diagrams.satellite.plant import add_servicer, add_target

REST = (0.0, 0.9, 0.0, 1.8, 0.0, 0.9, 0.0)
"""The arm's posture in the middle of its workspace (rad): the free motion of its elbow is drawn there."""


def gripper(q: casadi.SX) -> FrameMotion:
    """Return pose and Jacobian of the gripper G in B, for symbolic positions q (7, 1) of the arm's joints."""
    plant = _arm()
    return PlantDynamics(plant, plant.CreateDefaultContext()).frame(plant.GetFrameByName("gripper"), q)


@lru_cache
def joint_rates() -> Kernel:
    """Return the rates of the arm's joints (7,) as a kernel of (q, V_BG, [posture gain, damping])."""
    q, V, gains = casadi.SX.sym("q", ARM_JOINTS), casadi.SX.sym("V", 6), casadi.SX.sym("gains", 2)
    J = casadi.densify(gripper(q).J)
    drawn = gains[0] * (casadi.DM(REST) - q)
    solved = casadi.solve(J @ J.T + gains[1] ** 2 * casadi.SX.eye(6), V - J @ drawn)
    return Kernel("joint_rates", [q, V, gains], casadi.densify(drawn + J.T @ solved), compile=False)


@lru_cache
def reaction(*, holding: bool) -> Kernel:
    """Return [h_B (3,); J_B (9,)], by which the arm's motion turns the base, as a kernel of (q, qdot), (7,) each.

    See `MomentumModel.reaction`. The wheels are at rest, and open fingers count as closed ones.

    Args:
        holding: Whether the gripper holds the target, with G and H in one place.
    """
    plant = MultibodyPlant(0.0)
    instance = add_servicer(plant, wheels=True, servos=False)
    if holding:
        add_target(plant)
        plant.WeldFrames(plant.GetFrameByName("gripper"), plant.GetFrameByName("grapple"))
    plant.Finalize()
    joints = [plant.GetJointByName(name, instance) for name in ARM_JOINT_NAMES]
    model = MomentumModel(plant, plant.CreateDefaultContext(), joints=joints)
    q, rates = casadi.SX.sym("q", ARM_JOINTS), casadi.SX.sym("rates", ARM_JOINTS)
    h, J = model.reaction(q, rates)
    return Kernel("reaction", [q, rates], casadi.densify(casadi.vertcat(h, J.reshape((9, 1)))), compile=False)


def _arm() -> MultibodyPlant:
    """Return the arm alone, in B, with the frame ``gripper``."""
    servicer = Servicer()
    plant = MultibodyPlant(0.0)
    parent = plant.world_frame()
    X_PJ = servicer.X_BA
    for k, name in enumerate(ARM_JOINT_NAMES):
        link = plant.AddRigidBody(LINK_NAMES[k], servicer.link_inertia(k))
        X_PJ = X_PJ @ RigidTransform([0.0, 0.0, servicer.offsets[k]])
        mount = plant.AddFrame(FixedOffsetFrame(f"mount_{k}", parent, X_PJ))
        plant.AddJoint(RevoluteJoint(name, mount, link.body_frame(), servicer.axes[k]))
        parent, X_PJ = link.body_frame(), RigidTransform()
    reach = RigidTransform([0.0, 0.0, servicer.lengths[-1] + servicer.tool])
    plant.AddFrame(FixedOffsetFrame("gripper", parent, reach))
    plant.Finalize()
    return plant
