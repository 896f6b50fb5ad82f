"""The relative motion that controls the capture equals a plant's in the same state."""

from __future__ import annotations

import casadi
import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import JacobianWrtVariable
from pydrake.systems.framework import Context

from vtbdrake_diagrams.satellite.bodies import JOINT_NAMES
from vtbdrake_diagrams.satellite.kinematics import REST, joint_rates
from vtbdrake_diagrams.satellite.plant import add_servicer, add_target, arm_positions
from vtbdrake_diagrams.satellite.relative_motion import Relative, RelativeMotion, gripper_errors

T = 0.02


def moving() -> tuple[MultibodyPlant, Context]:
    """A plant in a random state of motion."""
    plant = MultibodyPlant(0.0)
    add_servicer(plant)
    add_target(plant)
    plant.Finalize()
    context = plant.CreateDefaultContext()
    random = np.random.default_rng(3)
    q = plant.GetPositions(context) + 0.3 * random.normal(size=plant.num_positions())
    for name in ("base", "body"):
        start = plant.GetBodyByName(name).floating_positions_start()
        q[start : start + 4] /= np.linalg.norm(q[start : start + 4])
    plant.SetPositions(context, q)
    plant.SetVelocities(context, 0.1 * random.normal(size=plant.num_velocities()))
    return plant, context


def test_agrees_with_the_plant() -> None:
    plant, context = moving()
    base, body = plant.GetBodyByName("base"), plant.GetBodyByName("body")
    B, H, G = base.body_frame(), plant.GetFrameByName("grapple"), plant.GetFrameByName("gripper")
    q, v = plant.GetPositions(context), plant.GetVelocities(context)
    V_WB = base.EvalSpatialVelocityInWorld(context)
    pose = q[base.floating_positions_start() :][:7]
    # The estimate of the base is one period older; here it has moved at constant velocity since then.
    later = plant.CreateDefaultContext()
    system = RelativeMotion(period=T)
    own = system.CreateDefaultContext()
    target = body.floating_positions_start()
    V_WT = body.EvalSpatialVelocityInWorld(context)
    values = {
        "base": np.concatenate(([0.0], pose, V_WB.rotational(), V_WB.translational())),
        "target": np.concatenate((q[target : target + 7], V_WT.rotational(), V_WT.translational())),
        "status": [1.0, 0.3, 0.0, 0.0],
        "joint_position": [q[plant.GetJointByName(name).position_start()] for name in JOINT_NAMES],
    }
    for name, value in values.items():
        system.GetInputPort(name).FixValue(own, value)
    seen = Relative(system.get_output_port().Eval(own))
    # Move the plant's base on by a small step, as Drake integrates it.
    steps = 1000
    plant.SetPositionsAndVelocities(later, np.concatenate((q, v)))
    only_base = np.zeros_like(v)
    start = base.floating_velocities_start_in_v()
    only_base[start : start + 6] = v[start : start + 6]
    moved = q.copy()
    for _ in range(steps):
        plant.SetPositions(later, moved)
        moved = moved + T / steps * plant.MapVelocityToQDot(later, only_base)
    plant.SetPositions(later, moved)
    X_BH, X_BG = H.CalcPose(later, B), G.CalcPose(later, B)
    np.testing.assert_allclose(seen.R_BH, X_BH.rotation().matrix(), atol=1e-6)
    np.testing.assert_allclose(seen.p_BH, X_BH.translation(), atol=1e-6)
    np.testing.assert_allclose(seen.R_BG, X_BG.rotation().matrix(), atol=1e-9)
    np.testing.assert_allclose(seen.p_BG, X_BG.translation(), atol=1e-9)
    V_BH = H.CalcSpatialVelocity(later, B, B)
    np.testing.assert_allclose(seen.w_BH, V_BH.rotational(), atol=1e-6)
    np.testing.assert_allclose(seen.v_BH, V_BH.translational(), atol=1e-6)
    assert (seen.age, seen.valid) == (0.3, True)


def test_joint_rates_give_the_velocity() -> None:
    plant, context = moving()
    B, G = plant.GetFrameByName("base"), plant.GetFrameByName("gripper")
    servicer = plant.GetModelInstanceByName("servicer")
    wanted = np.array([0.1, -0.05, 0.02, 0.03, 0.04, -0.06])
    q = np.array(REST) + 0.1
    positions = plant.GetPositions(context)
    positions[arm_positions(plant, servicer)] = q
    plant.SetPositions(context, positions)
    columns = [plant.GetJointByName(name).velocity_start() for name in JOINT_NAMES[:7]]
    J = plant.CalcJacobianSpatialVelocity(context, JacobianWrtVariable.kV, G, np.zeros(3), B, B)[:, columns]
    np.testing.assert_allclose(J @ joint_rates().value((q, wanted, [0.3, 0.0])), wanted, atol=1e-9)


@pytest.mark.parametrize("flip", [0.0, 1.0])
def test_errors_of_the_gripper_are_those_of_its_pose(flip: float) -> None:
    X_BH, X_HD = RigidTransform(RollPitchYaw(0.4, -0.7, 1.9), [1.9, 0.1, -0.2]), RigidTransform([0.0, 0.0, -0.25])
    if flip:
        X_HD = X_HD @ RigidTransform(RotationMatrix.MakeZRotation(np.pi))
    X_DG = RigidTransform(RollPitchYaw(0.02, -0.1, 0.05), [0.01, -0.02, 0.03])
    X_BG = X_BH @ X_HD @ X_DG
    poses = [(X.rotation().matrix().ravel(), X.translation()) for X in (X_BH, X_BG)]
    relative = np.concatenate([[0.0, 1.0], *poses[0], np.zeros(6), *poses[1]])
    angle = X_DG.rotation().ToAngleAxis().angle()
    errors = [float(casadi.norm_2(e)) for e in gripper_errors(casadi.DM(relative), 0.25, casadi.DM(flip))]
    assert errors == pytest.approx([np.linalg.norm(X_DG.translation()), angle], abs=1e-12)
