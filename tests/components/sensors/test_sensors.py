"""Sensors against rigid-body motions that are known in closed form."""

from __future__ import annotations

import numpy as np
import pytest
from pydrake.common.eigen_geometry import AngleAxis
from pydrake.geometry import (
    AddCompliantHydroelasticProperties,
    AddContactMaterial,
    AddRigidHydroelasticProperties,
    Box,
    ProximityProperties,
    Sphere,
)
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.multibody.math import SpatialVelocity
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import (
    AddMultibodyPlant,
    AddMultibodyPlantSceneGraph,
    CoulombFriction,
    MultibodyPlant,
    MultibodyPlantConfig,
)
from pydrake.multibody.tree import FixedOffsetFrame, PrismaticJoint, RevoluteJoint, SpatialInertia
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator, SimulatorConfig
from pydrake.systems.framework import Diagram, DiagramBuilder

from vtbdrake.components.sensors import (
    ContactSensor,
    Imu,
    JointEncoders,
    JointTachometers,
    SampledSensor,
    connect_to_plant,
    normal_noise,
)

PERIOD = 0.01
G = 9.81
X_BF = RigidTransform(RollPitchYaw(0.3, -0.5, 0.9), [0.1, -0.2, 0.3])


def free_body() -> tuple[DiagramBuilder, MultibodyPlant]:
    """A ball that flies."""
    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlantSceneGraph(builder, 0.0)
    body = plant.AddRigidBody("body", SpatialInertia.SolidSphereWithMass(1.0, 0.1))
    plant.AddFrame(FixedOffsetFrame("F", body.body_frame(), X_BF))
    plant.mutable_gravity_field().set_gravity_vector([0, 0, -G])
    return builder, plant


def add(builder: DiagramBuilder, plant: MultibodyPlant, sensor: SampledSensor) -> Diagram:
    builder.AddSystem(sensor)
    connect_to_plant(builder, sensor, plant)
    return builder.Build()


def reading(sensor: SampledSensor, simulator: Simulator) -> np.ndarray:
    return sensor.get_output_port().Eval(sensor.GetMyContextFromRoot(simulator.get_context()))


@pytest.mark.parametrize("w_WB", [[0.5, -1.0, 2.0], [0.0, 0.0, 0.0]])
def test_imu_that_resumes_goes_on_as_the_one_before(w_WB: list[float]) -> None:
    builder, plant = free_body()
    plant.Finalize()
    imu = Imu(plant, plant.GetFrameByName("F"), period=PERIOD)
    diagram = add(builder, plant, imu)
    running, resumed = Simulator(diagram), Simulator(diagram)
    plant.SetFreeBodySpatialVelocity(
        plant.GetMyContextFromRoot(running.get_mutable_context()),
        plant.GetBodyByName("body"),
        SpatialVelocity(w_WB, [1.0, 2.0, 3.0]),
    )
    for now, end in ((0.204, 0.215), (0.23, 0.235)):  # Between two samples, and when the next one is due.
        running.AdvanceTo(now)
        context = resumed.get_mutable_context()
        context.SetTime(now)
        own, there = plant.GetMyMutableContextFromRoot(context), plant.GetMyContextFromRoot(running.get_context())
        plant.SetPositionsAndVelocities(own, plant.GetPositionsAndVelocities(there))
        imu.resume(imu.GetMyMutableContextFromRoot(context), reading(imu, running))
        resumed.Initialize()
        np.testing.assert_array_equal(reading(imu, resumed), reading(imu, running))
        for simulator in (running, resumed):
            simulator.AdvanceTo(end)
        np.testing.assert_allclose(reading(imu, resumed), reading(imu, running), atol=2e-3)


def test_imu_resumes_from_a_turn_whose_square_is_zero() -> None:
    builder, plant = free_body()
    plant.Finalize()
    imu = Imu(plant, plant.GetFrameByName("F"), period=PERIOD)
    context = add(builder, plant, imu).CreateDefaultContext()
    context.SetTime(PERIOD / 2.0)
    own = imu.GetMyMutableContextFromRoot(context)
    orientations = []
    for turn in ([3.4e-162 / PERIOD, 0.0, 0.0], [0.0, 0.0, 0.0]):
        imu.resume(own, np.array([*turn, 0.0, 0.0, 9.81]))
        orientations.append(imu.memory.view(own).last_orientation.copy())
    np.testing.assert_array_equal(*orientations)


@pytest.mark.parametrize("k", range(12))
def test_imu_turns_alike_in_all_orientations(k: int) -> None:
    """Half a turn about axes between two others: of the orientation's quaternion, two entries are large."""
    builder, plant = free_body()
    plant.Finalize()
    imu = Imu(plant, plant.GetFrameByName("F"), period=PERIOD)
    simulator = Simulator(add(builder, plant, imu))
    context = plant.GetMyContextFromRoot(simulator.get_mutable_context())
    axis = np.roll([0.9239, 0.3827 * (-1.0) ** k, 0.0], k // 2)[:: 1 if k < 6 else -1]
    R_WF, w_W = RotationMatrix(AngleAxis(np.pi, axis / np.linalg.norm(axis))), np.array([0.02, -0.01, 0.03])
    body = plant.GetBodyByName("body")
    plant.SetFreeBodyPose(context, body, RigidTransform(R_WF @ X_BF.rotation().inverse(), [0.0, 0.0, 0.0]))
    plant.SetFreeBodySpatialVelocity(context, body, SpatialVelocity(w_W, [0.0, 0.0, 0.0]))
    simulator.AdvanceTo(2.5 * PERIOD)
    measured = reading(imu, simulator)
    np.testing.assert_allclose(measured[:3], R_WF.matrix().T @ w_W, atol=1e-6)
    # The centre of the ball falls, and the sensor turns about it, as slowly.
    assert np.abs(measured[3:]).max() < 2e-3


def arm(*, angle: float, rate: float = 0.0, discrete: bool = False) -> tuple[DiagramBuilder, MultibodyPlant]:
    """A link that turns about the world's y axis without gravity's torque: its mass is on the axis."""
    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlantSceneGraph(builder, 0.001 if discrete else 0.0)
    link = plant.AddRigidBody("link", SpatialInertia.SolidSphereWithMass(1.0, 0.1))
    joint = RevoluteJoint("joint", plant.world_frame(), link.body_frame(), [0, 1, 0], damping=0)
    joint.set_default_angle(angle)
    plant.AddJoint(joint)
    plant.AddFrame(FixedOffsetFrame("F", link.body_frame(), X_BF))
    plant.mutable_gravity_field().set_gravity_vector([0, 0, -G])
    plant.Finalize()
    return builder, plant


@pytest.mark.parametrize("discrete", [False, True])
def test_imu_at_rest_shows_gravity_from_the_start(discrete: bool) -> None:
    builder, plant = arm(angle=0.7, discrete=discrete)
    imu = Imu(plant, plant.GetFrameByName("F"), period=PERIOD)
    diagram = add(builder, plant, imu)
    simulator = Simulator(diagram)
    R_WF = RotationMatrix.MakeYRotation(0.7) @ X_BF.rotation()
    expected = [0, 0, 0, *(R_WF.matrix().T @ [0, 0, G])]
    np.testing.assert_allclose(reading(imu, simulator), expected, atol=1e-12)
    for k in range(4):
        simulator.AdvanceTo((k + 0.5) * PERIOD)
        np.testing.assert_allclose(reading(imu, simulator), expected, atol=1e-9)


def test_first_sample_takes_the_pose_but_no_velocity_difference() -> None:
    builder, plant = free_body()
    plant.Finalize()
    imu = Imu(plant, plant.GetBodyByName("body").body_frame(), period=PERIOD)
    diagram = add(builder, plant, imu)
    simulator = Simulator(diagram)
    context = plant.GetMyContextFromRoot(simulator.get_mutable_context())
    body = plant.GetBodyByName("body")
    R_WB = RotationMatrix(RollPitchYaw(0.2, 0.4, 0.0))
    plant.SetFreeBodyPose(context, body, RigidTransform(R_WB, [0, 0, 0]))
    plant.SetFreeBodySpatialVelocity(context, body, SpatialVelocity([0, 0, 1.0], [5.0, 0, 0]))
    simulator.AdvanceTo(0.5 * PERIOD)
    np.testing.assert_allclose(reading(imu, simulator), [0, 0, 0, *(R_WB.matrix().T @ [0, 0, G])], atol=1e-12)


def test_encoders_show_a_constant_rate_sampled() -> None:
    builder, plant = arm(angle=0.1)
    encoders = JointEncoders(plant, [plant.GetJointByName("joint")], period=PERIOD)
    diagram = add(builder, plant, encoders)
    simulator = Simulator(diagram)
    assert reading(encoders, simulator) == pytest.approx([0.1])  # the default position, before the first sample
    context = plant.GetMyContextFromRoot(simulator.get_mutable_context())
    plant.SetVelocities(context, [2.0])
    simulator.AdvanceTo(5.7 * PERIOD)
    assert reading(encoders, simulator) == pytest.approx([0.1 + 2.0 * 5 * PERIOD], abs=1e-6)


@pytest.mark.parametrize("names", [["CartSlider", "PolePin"], ["PolePin", "CartSlider"], ["PolePin"]])
def test_joint_sensors_show_their_joints_in_order(names: list[str]) -> None:
    builder = DiagramBuilder()
    plant = builder.AddSystem(MultibodyPlant(0.001))
    Parser(plant).AddModelsFromUrl("package://drake/examples/multibody/cart_pole/cart_pole.sdf")
    plant.Finalize()
    joints = [plant.GetJointByName(name) for name in names]
    sensors = [sensor(plant, joints, period=PERIOD) for sensor in (JointEncoders, JointTachometers)]
    for sensor in sensors:
        builder.AddSystem(sensor)
        builder.Connect(plant.get_state_output_port(), sensor.get_input_port())
    simulator = Simulator(builder.Build())
    context = plant.GetMyContextFromRoot(simulator.get_mutable_context())
    angles, rates = {"CartSlider": 0.3, "PolePin": -0.7}, {"CartSlider": 1.5, "PolePin": -2.5}
    for name in angles:
        joint = plant.GetJointByName(name)
        (joint.set_translation if name == "CartSlider" else joint.set_angle)(context, angles[name])
        (joint.set_translation_rate if name == "CartSlider" else joint.set_angular_rate)(context, rates[name])
    simulator.AdvanceTo(0.5 * PERIOD)
    # The first sample is that after a step of the plant.
    assert reading(sensors[0], simulator) == pytest.approx([angles[name] for name in names], abs=0.02)
    assert reading(sensors[1], simulator) == pytest.approx([rates[name] for name in names], abs=0.2)


def test_units_are_those_of_the_joints() -> None:
    plant = MultibodyPlant(0.001)
    Parser(plant).AddModelsFromUrl("package://drake/examples/multibody/cart_pole/cart_pole.sdf")
    plant.Finalize()
    cart, pole = (plant.GetJointByName(name) for name in ("CartSlider", "PolePin"))
    encoders = JointEncoders(plant, [cart, pole], period=PERIOD)
    assert encoders.variables[0].unit == "m, rad" and encoders.entry_names == (cart.name(), pole.name())
    assert JointTachometers(plant, [pole, cart], period=PERIOD).variables[0].unit == "rad/s, m/s"


def test_encoders_refuse_a_floating_base() -> None:
    builder, plant = free_body()
    plant.Finalize()
    del builder
    with pytest.raises(ValueError, match="7 positions"):
        JointEncoders(plant, [plant.GetJointByName("body")], period=PERIOD)


@pytest.mark.parametrize("sensor", [JointEncoders, JointTachometers])
def test_joint_sensors_refuse_a_plant_before_finalize(sensor) -> None:
    plant = MultibodyPlant(0.001)
    body = plant.AddRigidBody("body", SpatialInertia.SolidSphereWithMass(1.0, 0.1))
    joint = plant.AddJoint(RevoluteJoint("joint", plant.world_frame(), body.body_frame(), [0, 1, 0]))
    with pytest.raises(RuntimeError, match=r"call Finalize\(\) first"):
        sensor(plant, [joint], period=PERIOD)


def noisy_readings(*, seed: float, stream: int, std: float, start: float = 0.0) -> list[float]:
    builder, plant = arm(angle=0.0)
    encoders = JointEncoders(plant, [plant.GetJointByName("joint")], period=PERIOD, stream=stream)
    diagram = add(builder, plant, encoders)
    context = diagram.CreateDefaultContext()
    encoders.GetMyContextFromRoot(context).get_mutable_numeric_parameter(0).SetFromVector([seed, std])
    context.SetTime(start)
    simulator = Simulator(diagram, context)
    values = []
    for k in range(20):
        simulator.AdvanceTo(start + (k + 0.5) * PERIOD)
        values.append(float(reading(encoders, simulator)[0]))
    return values


def test_noise_repeats_and_depends_on_seed_stream_and_tick() -> None:
    noise = noisy_readings(seed=3, stream=1, std=0.1)
    assert noise == noisy_readings(seed=3, stream=1, std=0.1)
    assert len(set(noise)) == 20
    assert not set(noise) & set(noisy_readings(seed=4, stream=1, std=0.1))
    assert not set(noise) & set(noisy_readings(seed=3, stream=2, std=0.1))
    assert noise[10:] == noisy_readings(seed=3, stream=1, std=0.1, start=10 * PERIOD)[:10]
    assert noisy_readings(seed=3, stream=1, std=0.0) == [0.0] * 20


def test_noise_is_standard_normal_and_ticks_are_independent() -> None:
    samples = np.array([normal_noise(40, seed=1, stream=2, tick=tick) for tick in range(1000)])
    assert samples.mean() == pytest.approx(0.0, abs=0.02)
    assert samples.std() == pytest.approx(1.0, abs=0.02)
    assert np.corrcoef(samples[:-1].ravel(), samples[1:].ravel())[0, 1] == pytest.approx(0.0, abs=0.02)
    assert np.unique(samples).size == samples.size


@pytest.mark.parametrize("time_step", [0.0, 0.001])
def test_contact_sensor_feels_weight_above_its_threshold(time_step: float) -> None:
    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlantSceneGraph(builder, time_step)
    balls = []
    for name, mass, height in (("light", 0.2, 0.1), ("heavy", 2.0, 0.1), ("high", 2.0, 1.0)):
        ball = plant.AddRigidBody(name, SpatialInertia.SolidSphereWithMass(mass, 0.1))
        friction = CoulombFriction(1, 1)
        plant.RegisterCollisionGeometry(ball, RigidTransform(), Sphere(0.1), name, friction)
        joint = PrismaticJoint(name, plant.world_frame(), ball.body_frame(), [0, 0, 1])
        joint.set_default_translation(height)
        plant.AddJoint(joint)
        balls.append(ball)
    ground = RigidTransform([0, 0, -0.5])
    plant.RegisterCollisionGeometry(plant.world_body(), ground, Box(10, 10, 1), "ground", CoulombFriction(1, 1))
    plant.Finalize()
    sensor = ContactSensor(plant, balls, threshold=5.0, period=PERIOD)  # between the weights 1.96 N and 19.6 N
    diagram = add(builder, plant, sensor)
    simulator = Simulator(diagram)
    if time_step == 0.0:
        config = SimulatorConfig(integration_scheme="cenic", accuracy=1e-3, max_step_size=0.01, use_error_control=True)
        ApplySimulatorConfig(config, simulator)
    simulator.AdvanceTo(0.3)
    np.testing.assert_array_equal(reading(sensor, simulator), [0.0, 1.0, 0.0])


def test_contact_sensor_feels_hydroelastic_contact() -> None:
    builder = DiagramBuilder()
    config = MultibodyPlantConfig(time_step=0.001, contact_model="hydroelastic")
    plant, _ = AddMultibodyPlant(config, builder)
    soft, hard = ProximityProperties(), ProximityProperties()
    AddCompliantHydroelasticProperties(0.05, 1e6, soft)
    AddRigidHydroelasticProperties(0.5, hard)
    for properties in (soft, hard):
        AddContactMaterial(dissipation=1.0, friction=CoulombFriction(1, 1), properties=properties)
    balls = []
    for name, height in (("low", 0.1), ("high", 1.0)):
        ball = plant.AddRigidBody(name, SpatialInertia.SolidSphereWithMass(2.0, 0.1))
        plant.RegisterCollisionGeometry(ball, RigidTransform(), Sphere(0.1), name, soft)
        joint = PrismaticJoint(name, plant.world_frame(), ball.body_frame(), [0, 0, 1])
        joint.set_default_translation(height)
        plant.AddJoint(joint)
        balls.append(ball)
    plant.RegisterCollisionGeometry(plant.world_body(), RigidTransform([0, 0, -0.5]), Box(10, 10, 1), "ground", hard)
    plant.Finalize()
    sensor = ContactSensor(plant, balls, threshold=5.0, period=PERIOD)
    simulator = Simulator(add(builder, plant, sensor))
    simulator.AdvanceTo(0.2)
    np.testing.assert_array_equal(reading(sensor, simulator), [1.0, 0.0])


def test_period_must_be_positive() -> None:
    _, plant = arm(angle=0.0)
    with pytest.raises(ValueError, match="positive"):
        JointEncoders(plant, [plant.GetJointByName("joint")], period=0.0)
