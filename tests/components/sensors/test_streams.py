"""Every sensor has noise of its own, which follows from its name."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest
from pydrake.geometry import Box
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, CoulombFriction
from pydrake.multibody.tree import RevoluteJoint, SpatialInertia
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, DiagramBuilder, DiscreteValues, LeafSystem
from pydrake.systems.sensors import CameraInfo

from vtbdrake.components.ray_casting import RayCaster
from vtbdrake.components.sensors import (
    ContactSensor,
    ErrorModel,
    ForceTorqueSensor,
    Imu,
    JointEncoders,
    JointTachometers,
    JointTorqueSensors,
    SampledSensor,
    connect_to_plant,
)
from vtbdrake.components.sensors.camera import Camera, connect_camera
from vtbdrake.components.sensors.laser_scanner import LaserScanner, LaserScannerConfig, connect_laser_scanner

PERIOD = 0.1
TICKS = 40
NOISE = ErrorModel(noise=1e-3)
FORWARD = RigidTransform(RollPitchYaw(-np.pi / 2, 0.0, 0.0), [0.0, -2.0, 0.0])  # Towards the arm.


class World:
    """An arm at rest without gravity, and named sensors that are added to it."""

    def __init__(self) -> None:
        self.builder = DiagramBuilder()
        self.plant, self.scene_graph = AddMultibodyPlantSceneGraph(self.builder, 0.0)
        self.arm = self.plant.AddRigidBody("arm", SpatialInertia.SolidBoxWithMass(1.0, 1.0, 1.0, 1.0))
        self.plant.AddJoint(RevoluteJoint("joint", self.plant.world_frame(), self.arm.body_frame(), [0, 1, 0]))
        grey = np.array([0.5, 0.5, 0.5, 1.0])
        self.plant.RegisterVisualGeometry(self.arm, RigidTransform(), Box(1.0, 1.0, 1.0), "box", grey)
        self.plant.RegisterCollisionGeometry(
            self.arm, RigidTransform(), Box(1.0, 1.0, 1.0), "box", CoulombFriction(1.0, 1.0)
        )
        self.plant.mutable_gravity_field().set_gravity_vector(np.zeros(3))
        self.plant.Finalize()

    @property
    def joints(self) -> list[RevoluteJoint]:
        return [self.plant.GetJointByName("joint")]


def joint_encoders(world: World, **options: int) -> SampledSensor:
    return JointEncoders(world.plant, world.joints, period=PERIOD, errors=NOISE, **options)


def joint_tachometers(world: World, **options: int) -> SampledSensor:
    return JointTachometers(world.plant, world.joints, period=PERIOD, errors=NOISE, **options)


def joint_torque_sensors(world: World, **options: int) -> SampledSensor:
    return JointTorqueSensors(world.plant, world.joints, period=PERIOD, errors=NOISE, **options)


def force_torque_sensor(world: World, **options: int) -> SampledSensor:
    return ForceTorqueSensor(world.plant, world.joints[0], period=PERIOD, errors=NOISE, **options)


def imu(world: World, **options: int) -> SampledSensor:
    return Imu(world.plant, world.arm.body_frame(), period=PERIOD, errors=NOISE, **options)


def contact_sensor(world: World, **options: int) -> SampledSensor:
    errors = ErrorModel(outlier_probability=1.0, outlier_size=1.0)
    return ContactSensor(world.plant, [world.arm], period=PERIOD, errors=errors, **options)


def camera(world: World, **options: int) -> Camera:
    errors = ErrorModel(noise=3.0)
    info = CameraInfo(16, 16, 0.3)
    return Camera(
        world.plant, world.plant.world_frame(), X_FC=FORWARD, info=info, period=PERIOD, errors=errors, **options
    )


def laser_scanner(world: World, **options: int) -> LaserScanner:
    config = LaserScannerConfig(frequency=1.0 / PERIOD, rays_per_second=200.0, azimuth=0.3, elevation=0.0)
    frame = world.plant.world_frame()
    caster = RayCaster(world.plant, world.scene_graph)
    return LaserScanner(world.plant, frame, caster, config=config, slice_period=PERIOD, errors=NOISE, **options)


KINDS = [
    joint_encoders,
    joint_tachometers,
    joint_torque_sensors,
    force_torque_sensor,
    imu,
    contact_sensor,
    camera,
    laser_scanner,
]
Make = Callable[..., LeafSystem]


def simulation(world: World, sensors: Sequence[LeafSystem], *, root: str = "") -> Simulator:
    """Return a simulation of the world with these sensors in it."""
    for sensor in sensors:
        if isinstance(sensor, Camera):
            connect_camera(world.builder, sensor, world.scene_graph)
        elif isinstance(sensor, LaserScanner):
            connect_laser_scanner(world.builder, sensor, world.plant)
        else:
            connect_to_plant(world.builder, sensor, world.plant)
    diagram = world.builder.Build()
    diagram.set_name(root)
    simulator = Simulator(diagram)
    context = simulator.get_mutable_context()
    for sensor in sensors:
        if isinstance(sensor, LaserScanner):  # From outside of the arm: its pose is its first parameter.
            pose = sensor.GetMyMutableContextFromRoot(context).get_mutable_numeric_parameter(0)
            pose.SetFromVector([-2.0, *pose.value()[1:]])
    return simulator


def numbers(value: Any) -> np.ndarray:
    """Return the numbers of a measurement: an array, an image or a scan."""
    return np.array(getattr(value, "data", getattr(value, "ranges", value)), dtype=float).ravel()


def readings(make: Make, names: Sequence[str], *, root: str = "", **options: int) -> dict[str, np.ndarray]:
    """Return what sensors of these names show at every tick, less the mean, (ticks, n)."""
    world = World()
    sensors = {name: world.builder.AddNamedSystem(name, make(world, **options)) for name in names}
    simulator = simulation(world, list(sensors.values()), root=root)
    context = simulator.get_context()
    shown: dict[str, list[np.ndarray]] = {name: [] for name in names}
    for k in range(TICKS):
        simulator.AdvanceTo((k + 1.5) * PERIOD)
        for name, sensor in sensors.items():
            value = sensor.get_output_port(0).Eval(sensor.GetMyContextFromRoot(context))
            shown[name].append(numbers(value))
    arrays = {name: np.array(values, dtype=float) for name, values in shown.items()}
    return {name: array - array.mean(axis=0) for name, array in arrays.items()}


@pytest.mark.parametrize("make", KINDS)
def test_two_sensors_of_one_kind_have_independent_noise(make: Make) -> None:
    noise = readings(make, ["left", "right"])
    assert noise["left"].any()
    # 3.5 deviations of the correlation of 40 independent pairs; images and wrenches have more.
    assert abs(np.corrcoef(noise["left"].ravel(), noise["right"].ravel())[0, 1]) < 3.5 / TICKS**0.5


@pytest.mark.parametrize("make", KINDS)
def test_noise_follows_from_the_name_and_not_from_the_order(make: Make) -> None:
    noise, other = readings(make, ["left", "right"]), readings(make, ["right", "left"], root="vtb")
    for name in noise:
        np.testing.assert_array_equal(noise[name], other[name])


@pytest.mark.parametrize("make", KINDS)
def test_stream_can_be_fixed_by_hand(make: Make) -> None:
    noise = readings(make, ["left", "right"], stream=3)
    np.testing.assert_array_equal(noise["left"], noise["right"])


def test_noise_of_a_name_is_the_same_in_every_process() -> None:
    code = """
from tests.components.sensors.test_streams import joint_encoders, readings
print(readings(joint_encoders, ["left"])["left"].tobytes().hex())
"""
    command = [sys.executable, "-c", f"import sys; sys.path[:] = {sys.path!r}\n{code}"]
    other = subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    assert readings(joint_encoders, ["left"])["left"].tobytes().hex() == other


def test_a_noisy_sensor_without_a_name_is_refused() -> None:
    world = World()
    sensor = world.builder.AddSystem(joint_encoders(world))
    connect_to_plant(world.builder, sensor, world.plant)
    with pytest.raises(ValueError, match="JointEncoders has no name.*AddNamedSystem.*stream="):
        Simulator(world.builder.Build()).AdvanceTo(0.1)


def test_a_noisy_sensor_in_a_diagram_without_a_name_is_refused() -> None:
    class Noise(SampledSensor):
        def __init__(self) -> None:
            super().__init__("y", default=[0.0], period=PERIOD, unit="1", noise={"noise": (1, "1")}, errors=NOISE)

        def _measure(self, context: Context, state: DiscreteValues) -> np.ndarray:
            return np.zeros(1)

    inner, outer = DiagramBuilder(), DiagramBuilder()
    inner.AddNamedSystem("noise", Noise())
    outer.AddSystem(inner.Build())
    with pytest.raises(ValueError, match="noise is in a Diagram without a name"):
        Simulator(outer.Build()).AdvanceTo(0.1)


@pytest.mark.parametrize("stream", [-1, 2**64, 0.5])
def test_impossible_streams_are_refused(stream: float) -> None:
    with pytest.raises(ValueError, match="stream is a whole number"):
        joint_encoders(World(), stream=stream)


@pytest.mark.parametrize("stream", [0, 2**64 - 1])
def test_first_and_last_stream_are_streams(stream: int) -> None:
    joint_encoders(World(), stream=stream)


def test_exact_sensors_need_no_name() -> None:
    world = World()
    sensor = world.builder.AddSystem(JointEncoders(world.plant, world.joints, period=PERIOD))
    connect_to_plant(world.builder, sensor, world.plant)
    Simulator(world.builder.Build()).AdvanceTo(0.1)
