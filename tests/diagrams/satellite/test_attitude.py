"""Tests of the attitude: the arm's motion turns the base, and the wheels hold it."""

from __future__ import annotations

import numpy as np
import pytest
from pydrake.multibody.math import SpatialVelocity
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex

from vtbdrake.state.systems import pose_from_array
from vtbdrake.testbed import VirtualTestbed
from vtbdrake_diagrams.satellite import SatelliteScenario
from vtbdrake_diagrams.satellite.bodies import ARM_JOINT_NAMES, ARM_JOINTS
from vtbdrake_diagrams.satellite.kinematics import REST, reaction
from vtbdrake_diagrams.satellite.plant import add_servicer, add_target
from vtbdrake_diagrams.satellite.supervisor import Mode, stopping_speed


@pytest.mark.parametrize("holding", [False, True])
def test_reaction_is_the_momentum_that_drake_computes(holding: bool) -> None:
    plant = MultibodyPlant(0.0)
    instance = add_servicer(plant, wheels=True, servos=False)
    if holding:
        add_target(plant)
    plant.Finalize()
    context, random = plant.CreateDefaultContext(), np.random.default_rng(3)
    q, rates = REST + 0.2 * random.normal(size=ARM_JOINTS), 0.1 * random.normal(size=ARM_JOINTS)
    for name, angle, rate in zip(ARM_JOINT_NAMES, q, rates, strict=True):
        joint = plant.GetJointByName(name, instance)
        joint.set_angle(context, angle)
        joint.set_angular_rate(context, rate)
    base, gripper = plant.GetBodyByName("base", instance), plant.GetFrameByName("gripper")

    def move_target() -> None:
        """Let the target move as if it were a part of the hand."""
        body = plant.GetBodyByName("body")
        X_TH = plant.GetFrameByName("grapple").GetFixedPoseInBodyFrame()
        plant.SetFreeBodyPose(context, body, gripper.CalcPoseInWorld(context) @ X_TH.inverse())
        arm = body.EvalPoseInWorld(context).translation() - gripper.CalcPoseInWorld(context).translation()
        plant.SetFreeBodySpatialVelocity(context, body, gripper.CalcSpatialVelocityInWorld(context).Shift(arm))

    if holding:
        move_target()
    # The base keeps its attitude, and moves so that the linear momentum is zero.
    p = plant.CalcSpatialMomentumInWorldAboutPoint(context, np.zeros(3)).translational()
    v = SpatialVelocity(w=np.zeros(3), v=-p / plant.CalcTotalMass(context))
    plant.SetFreeBodySpatialVelocity(context, base, v)
    if holding:
        move_target()
    center = plant.CalcCenterOfMassPositionInWorld(context)
    momentum = plant.CalcSpatialMomentumInWorldAboutPoint(context, center)
    np.testing.assert_allclose(momentum.translational(), 0.0, atol=1e-9)
    bodies = [BodyIndex(k) for k in range(1, plant.num_bodies())]
    inertia = plant.CalcSpatialInertia(context, plant.world_frame(), bodies).Shift(center)
    y = reaction(holding=holding).value((q, rates))
    # The kernel has closed fingers, here they are open.
    np.testing.assert_allclose(y[:3], momentum.rotational(), atol=0.01 * np.linalg.norm(momentum.rotational()))
    J = inertia.CalcRotationalInertia().CopyToFullMatrix3()
    np.testing.assert_allclose(y[3:].reshape(3, 3), J, atol=1e-3 * J.max())


def test_speed_stops_at_the_goal_with_the_deceleration() -> None:
    gain, a, d, T = 2.0, 0.1, 1.0, 1e-3
    speeds = []
    while d > 1e-3:
        speeds.append(stopping_speed(d, gain=gain, acceleration=a))
        d -= T * speeds[-1]
    assert speeds[0] == pytest.approx(np.sqrt(2.0 * a * (1.0 - 0.5 * a / gain**2)))
    assert -np.diff(speeds).min() / T < 1.01 * a
    assert stopping_speed(0.01, gain=gain, acceleration=a) == pytest.approx(0.02)


@pytest.fixture(scope="module")
def testbed() -> VirtualTestbed:
    return SatelliteScenario(perception="pose_sensor", wheels=True).build()


@pytest.mark.slow
def test_wheels_keep_the_stack_after_the_grip(testbed: VirtualTestbed) -> None:
    context = testbed.default_context()
    simulator = testbed.simulator(context)

    def turned() -> float:
        return float(
            pose_from_array(testbed.read(context, "sim.sys.servicer.base.pose")).rotation().ToAngleAxis().angle()
        )

    modes, peak = [], 0.0
    while not modes or modes[-1] < Mode.HOLD:
        simulator.AdvanceTo(context.get_time() + 0.5)
        assert context.get_time() < 45.0
        modes.append(float(testbed.read(context, "dps.impl.supervisor.mode")))
        peak = max(peak, turned())
    assert Mode.RETREAT in modes
    # In truth, too, the arm rests.
    rates = [testbed.read(context, f"sim.sys.servicer.{name}.velocity") for name in ARM_JOINT_NAMES]
    assert np.abs(rates).max() < 4e-3
    assert peak < np.radians(12.0)
    simulator.AdvanceTo(context.get_time() + 15.0)
    assert turned() < np.radians(0.5)
    simulator.AdvanceTo(context.get_time() + 15.0)
    assert turned() < np.radians(0.1)
    assert np.linalg.norm(testbed.read(context, "sim.sys.servicer.base.velocity")[:3]) < np.radians(0.02)
