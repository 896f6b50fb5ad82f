"""Sensors of a floating base show its pose and twist, as Drake has them."""

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.math import SpatialVelocity
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import RigidBody, SpatialInertia

from vtbdrake.components.sensors import BasePoseSensor, BaseTwistSensor

X_WB = RigidTransform(RollPitchYaw(0.1, -0.2, 0.3), [1.0, 2.0, 3.0])
V_WB = SpatialVelocity(w=[0.1, 0.2, 0.3], v=[4.0, 5.0, 6.0])


@pytest.fixture(scope="module")
def plant() -> MultibodyPlant:
    """A plant with another free body before the base, and a welded one."""
    plant = MultibodyPlant(0.001)
    inertia = SpatialInertia.SolidSphereWithMass(1.0, 0.1)
    for name in ("ball", "base", "table"):
        plant.AddRigidBody(name, inertia)
    plant.WeldFrames(plant.world_frame(), plant.GetFrameByName("table"))
    plant.SetDefaultFloatingBaseBodyPose(plant.GetBodyByName("base"), X_WB)
    plant.Finalize()
    return plant


def base(plant: MultibodyPlant) -> RigidBody:
    return plant.GetBodyByName("base")


def test_sensors_show_pose_and_twist(plant: MultibodyPlant) -> None:
    context = plant.CreateDefaultContext()
    plant.SetFreeBodySpatialVelocity(context, base(plant), V_WB)
    state = plant.GetPositionsAndVelocities(context)
    pose, twist = BasePoseSensor(plant, base(plant), period=0.01), BaseTwistSensor(plant, base(plant), period=0.01)
    expected = [*X_WB.rotation().ToQuaternion().wxyz(), *X_WB.translation()]
    for sensor, values in ((pose, expected), (twist, V_WB.get_coeffs())):
        own = sensor.CreateDefaultContext()
        sensor.GetInputPort("state").FixValue(own, state)
        np.testing.assert_allclose(sensor.measurement(own), values, atol=1e-15)


def test_the_default_pose_is_shown_at_first(plant: MultibodyPlant) -> None:
    sensor = BasePoseSensor(plant, base(plant), period=0.01)
    shown = sensor.get_output_port().Eval(sensor.CreateDefaultContext())
    np.testing.assert_allclose(shown[4:], X_WB.translation(), atol=1e-15)


@pytest.mark.parametrize("sensor", [BasePoseSensor, BaseTwistSensor])
def test_welded_bodies_are_refused(plant: MultibodyPlant, sensor: type[BasePoseSensor] | type[BaseTwistSensor]) -> None:
    with pytest.raises(ValueError, match="table is no floating base"):
        sensor(plant, plant.GetBodyByName("table"), period=0.01)
