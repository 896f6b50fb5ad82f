"""The SpaceClimber testbed wired by hand in plain Drake: the yardstick for what the framework costs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pydrake.geometry import Box
from pydrake.math import RigidTransform
from pydrake.multibody.plant import AddMultibodyPlant, CoulombFriction, MultibodyPlant
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Diagram, DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource, MatrixGain

from vtbdrake.components.sensors import ContactSensor, Imu, JointEncoders, connect_to_plant
from vtbdrake.testbed.integrator import apply_simulator_config
from vtbdrake_diagrams.space_climber import SpaceClimberScenario
from vtbdrake_diagrams.space_climber.dps import make_dps
from vtbdrake_diagrams.space_climber.morphology import FOOT_LINKS, JOINT_NAMES
from vtbdrake_diagrams.space_climber.plant import add_climber, add_payload, set_foot_friction


@dataclass(frozen=True)
class PlainClimber:
    """The diagram, its plant, and how it is integrated."""

    diagram: Diagram
    plant: MultibodyPlant
    scenario: SpaceClimberScenario

    def simulator(self) -> Simulator:
        """A new simulator at t = 0."""
        simulator = Simulator(self.diagram)
        apply_simulator_config(self.scenario.simulator_config, simulator)
        return simulator


def build_plain_climber(scenario: SpaceClimberScenario, *, heading: float = 0.0, walk: float = 1.0) -> PlainClimber:
    """The same world and DPS as the scenario's, on level ground."""
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlant(scenario.plant_config, builder)
    climber = add_climber(plant)
    add_payload(plant, climber)
    contact = CoulombFriction(scenario.friction, scenario.friction)
    X_WG = RigidTransform([0.0, 0.0, -0.5])
    plant.RegisterCollisionGeometry(plant.world_body(), X_WG, Box(200.0, 200.0, 1.0), "ground", contact)
    plant.mutable_gravity_field().set_gravity_vector([0.0, 0.0, -scenario.gravity])
    plant.Finalize()
    feet = [plant.GetBodyByName(name, climber) for name in FOOT_LINKS]
    set_foot_friction(plant, scene_graph, climber, scenario.friction)

    period = scenario.period
    imu = builder.AddNamedSystem("imu", Imu(plant, plant.GetFrameByName("imu", climber), period=period))
    joints = [plant.GetJointByName(name, climber) for name in JOINT_NAMES]
    encoders = builder.AddNamedSystem("encoders", JointEncoders(plant, joints, period=period))
    contacts = builder.AddNamedSystem("foot_contact", ContactSensor(plant, feet, period=period))
    dps = builder.AddNamedSystem("dps", make_dps(scenario.gait, period=period))
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
    return PlainClimber(builder.Build(), plant, scenario)
