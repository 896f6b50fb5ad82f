"""The SpaceClimber testbed wired by hand in plain Drake: the yardstick for what the framework costs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pydrake.geometry import Box
from pydrake.math import RigidTransform
from pydrake.multibody.plant import AddMultibodyPlant, CoulombFriction, MultibodyPlant, MultibodyPlantConfig
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator, SimulatorConfig
from pydrake.systems.framework import Diagram, DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource, MatrixGain

from diagrams.space_climber.dps import make_dps
from diagrams.space_climber.morphology import DEFAULT_FRICTION, FOOT_LINKS, JOINT_NAMES, LUNAR_GRAVITY, Morphology
from diagrams.space_climber.plant import add_climber, add_payload, set_foot_friction
from vtbdrake.components.sensors import ContactSensor, Imu, JointEncoders, connect_to_plant


@dataclass(frozen=True)
class PlainClimber:
    """The diagram and its plant; ``climber`` is the robot's model instance."""

    diagram: Diagram
    plant: MultibodyPlant

    def simulator(self, *, accuracy: float = 1e-3, max_step: float = 0.02) -> Simulator:
        """A simulator at t = 0: CENIC if the plant is continuous, else its own steps."""
        simulator = Simulator(self.diagram)
        if self.plant.time_step() == 0.0:
            config = SimulatorConfig(
                integration_scheme="cenic", accuracy=accuracy, max_step_size=max_step, use_error_control=True
            )
            ApplySimulatorConfig(config, simulator)
        return simulator


def build_plain_climber(
    gait: str = "tripod",
    *,
    gravity: float = LUNAR_GRAVITY,
    friction: float = DEFAULT_FRICTION,
    time_step: float = 0.0,
    slope: float = 0.0,
    heading: float = 0.0,
    walk: float = 1.0,
    payload: bool = False,
    joint_stops: bool = False,
    period: float = 0.02,
) -> PlainClimber:
    """The robot in its stance on flat ground, the plane z = 0.

    ``time_step`` 0 is a continuous plant, for CENIC. On a ``slope`` (rad) x points uphill: gravity leans back by it.
    """
    morphology = Morphology()
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlant(MultibodyPlantConfig(time_step=time_step), builder)
    climber = add_climber(plant, morphology=morphology, joint_stops=joint_stops)
    if payload:
        add_payload(plant, climber)
    contact = CoulombFriction(friction, friction)
    X_WG = RigidTransform([0.0, 0.0, -0.5])
    plant.RegisterCollisionGeometry(plant.world_body(), X_WG, Box(200.0, 200.0, 1.0), "ground", contact)
    plant.mutable_gravity_field().set_gravity_vector([-gravity * np.sin(slope), 0.0, -gravity * np.cos(slope)])
    plant.Finalize()
    feet = [plant.GetBodyByName(name, climber) for name in FOOT_LINKS]
    set_foot_friction(plant, scene_graph, climber, friction)

    imu = builder.AddNamedSystem("imu", Imu(plant, plant.GetFrameByName("imu", climber), period=period))
    joints = [plant.GetJointByName(name, climber) for name in JOINT_NAMES]
    encoders = builder.AddNamedSystem("encoders", JointEncoders(plant, joints, period=period))
    contacts = builder.AddNamedSystem("foot_contact", ContactSensor(plant, feet, period=period))
    dps = builder.AddNamedSystem("dps", make_dps(gait, period=period, morphology=morphology))
    for sensor in (imu, encoders, contacts):
        connect_to_plant(builder, sensor, plant)
        builder.Connect(sensor.get_output_port(), dps.GetInputPort(sensor.get_output_port().get_name()))
    for name, value in (("heading", heading), ("walk", walk)):
        source = builder.AddNamedSystem(name, ConstantVectorSource([value]))
        builder.Connect(source.get_output_port(), dps.GetInputPort(name))
    size = len(JOINT_NAMES)
    desired = builder.AddNamedSystem("desired", MatrixGain(np.vstack([np.eye(size), np.zeros((size, size))])))
    builder.Connect(dps.GetOutputPort("joint_position"), desired.get_input_port())
    builder.Connect(desired.get_output_port(), plant.get_desired_state_input_port(climber))
    return PlainClimber(builder.Build(), plant)
