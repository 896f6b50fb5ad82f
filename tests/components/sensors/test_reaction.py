"""Force/torque sensors and joint torque sensors against weights and Newton's and Euler's laws."""

from __future__ import annotations

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import AddMultibodyPlant, MultibodyPlant, MultibodyPlantConfig
from pydrake.multibody.tree import PrismaticJoint, RevoluteJoint, SpatialInertia, UnitInertia, WeldJoint
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, DiagramBuilder

from vtbdrake.components.sensors import (
    ForceTorqueSensor,
    JointTachometers,
    JointTorqueSensors,
    SampledSensor,
    connect_to_plant,
)

PERIOD = 0.001
G = 9.81
TOOL_MASS, TOOL_COM = 1.5, np.array([0.02, -0.03, 0.1])
LINK_MASS, LINK_COM = 2.0, np.array([0.25, 0.0, 0.0])
X_PF = RigidTransform(RollPitchYaw(0.4, -0.7, 1.1), [0.3, 0.05, 0.0])  # where the tool sits on the link
ROTOR, GEAR = 1e-4, 100.0


def compact(mass: float, com: np.ndarray) -> SpatialInertia:
    return SpatialInertia(mass, com, UnitInertia.SolidSphere(0.02).ShiftFromCenterOfMass(com))


def pendulum(*, sampled_ports: bool) -> tuple[DiagramBuilder, MultibodyPlant]:
    """A link on a horizontal, driven axis, with a tool welded to it."""
    builder = DiagramBuilder()
    config = MultibodyPlantConfig(time_step=PERIOD, use_sampled_output_ports=sampled_ports)
    plant, _ = AddMultibodyPlant(config, builder)
    plant.set_name("plant")
    link = plant.AddRigidBody("link", compact(LINK_MASS, LINK_COM))
    tool = plant.AddRigidBody("tool", compact(TOOL_MASS, TOOL_COM))
    joint = plant.AddJoint(RevoluteJoint("joint", plant.world_frame(), link.body_frame(), [0, 1, 0], damping=0))
    plant.AddJoint(WeldJoint("flange", link.body_frame(), tool.body_frame(), X_PF))
    actuator = plant.AddJointActuator("drive", joint)
    actuator.set_default_rotor_inertia(ROTOR)
    actuator.set_default_gear_ratio(GEAR)
    plant.mutable_gravity_field().set_gravity_vector([0, 0, -G])
    plant.Finalize()
    return builder, plant


def moment_about_axis(plant: MultibodyPlant, context: Context) -> float:
    """Gravity's moment about the joint's axis (+y)."""
    total = plant.CalcTotalMass(context)
    x = plant.CalcCenterOfMassPositionInWorld(context)[0]
    return total * G * x


def simulate(
    sensor: SampledSensor, builder: DiagramBuilder, plant: MultibodyPlant, *, q: float, v: float, u: float | None
) -> tuple[np.ndarray, Context]:
    """The reading after a few samples; u None holds the joint with a lock."""
    builder.AddSystem(sensor)
    connect_to_plant(builder, sensor, plant)
    diagram = builder.Build()
    simulator = Simulator(diagram)
    context = plant.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    plant.get_actuation_input_port().FixValue(context, [0.0 if u is None else u])
    plant.SetPositions(context, [q])
    plant.SetVelocities(context, [v])
    if u is None:
        plant.GetJointByName("joint").Lock(context)
    simulator.AdvanceTo(5.5 * PERIOD)
    return sensor.get_output_port().Eval(sensor.GetMyContextFromRoot(simulator.get_context())), context


@pytest.mark.parametrize("sampled_ports", [True, False])
@pytest.mark.parametrize("q", [0.0, 0.8, -2.0])
def test_tool_at_rest_weighs_m_g(q: float, sampled_ports: bool) -> None:
    builder, plant = pendulum(sampled_ports=sampled_ports)
    plant_joint = plant.GetJointByName("flange")
    y, context = simulate(ForceTorqueSensor(plant, plant_joint, period=PERIOD), builder, plant, q=q, v=0.0, u=None)
    R_WT = plant.GetBodyByName("tool").EvalPoseInWorld(context).rotation().matrix()
    weight = R_WT.T @ [0, 0, -TOOL_MASS * G]
    np.testing.assert_allclose(y, [*np.cross(TOOL_COM, weight), *weight], atol=1e-9)


def test_tool_in_uniform_rotation_pulls_outward() -> None:
    """Newton: the force on the tool is m (a - g), a the centripetal acceleration of its centre of mass."""
    builder, plant = pendulum(sampled_ports=False)
    plant.mutable_gravity_field().set_gravity_vector([0, 0, 0])
    sensor = ForceTorqueSensor(plant, plant.GetJointByName("flange"), period=PERIOD)
    y, context = simulate(sensor, builder, plant, q=0.3, v=2.0, u=0.0)
    X_WT = plant.GetBodyByName("tool").EvalPoseInWorld(context)
    p = X_WT @ TOOL_COM
    outward = np.array([p[0], 0.0, p[2]])
    expected = X_WT.rotation().matrix().T @ (TOOL_MASS * 2.0**2 * outward)
    # Off by how far the link turns in the step between the sample and the pose above.
    np.testing.assert_allclose(y[3:], expected, atol=3 * 2.0 * PERIOD * np.linalg.norm(expected))


def test_joint_torque_is_the_drives_less_its_rotors() -> None:
    builder, plant = pendulum(sampled_ports=False)
    sensor = JointTorqueSensors(plant, [plant.GetJointByName("joint")], period=PERIOD)
    y, context = simulate(sensor, builder, plant, q=0.3, v=0.0, u=4.0)
    M = plant.CalcMassMatrix(context)[0, 0]  # with the rotor
    acceleration = (4.0 + moment_about_axis(plant, context)) / M
    assert y == pytest.approx([4.0 - ROTOR * GEAR**2 * acceleration], rel=1e-3)


def test_force_along_a_vertical_slide_carries_its_load() -> None:
    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlant(MultibodyPlantConfig(time_step=PERIOD, use_sampled_output_ports=False), builder)
    plant.set_name("plant")
    load = plant.AddRigidBody("load", compact(TOOL_MASS, TOOL_COM))
    joint = plant.AddJoint(PrismaticJoint("joint", plant.world_frame(), load.body_frame(), [0, 0, 1]))
    plant.AddJointActuator("drive", joint)
    plant.Finalize()
    sensor = JointTorqueSensors(plant, [joint], period=PERIOD)
    y, context = simulate(sensor, builder, plant, q=0.1, v=0.0, u=None)
    gravity = np.linalg.norm(plant.gravity_field().gravity_vector())
    assert y == pytest.approx([TOOL_MASS * gravity])
    assert [element.unit for element in sensor.variables if element.name == "noise"] == ["N"]


def test_joint_torque_sensors_measure_revolute_and_prismatic_joints_only() -> None:
    _, plant = pendulum(sampled_ports=True)
    with pytest.raises(ValueError, match="'flange' is weld"):
        JointTorqueSensors(plant, [plant.GetJointByName("flange")], period=PERIOD)


def test_tachometers_show_the_velocity_of_the_last_sample() -> None:
    builder, plant = pendulum(sampled_ports=False)
    plant.mutable_gravity_field().set_gravity_vector([0, 0, 0])
    sensor = JointTachometers(plant, [plant.GetJointByName("joint")], period=PERIOD)
    y, context = simulate(sensor, builder, plant, q=0.0, v=0.5, u=2.0)
    acceleration = 2.0 / plant.CalcMassMatrix(context)[0, 0]
    # The sample at 5 T is of the state after five steps.
    assert y == pytest.approx([0.5 + 5 * PERIOD * acceleration], rel=1e-9)
