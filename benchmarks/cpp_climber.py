"""The SpaceClimber with a DPS of Drake's own systems only: it walks by a recorded gait."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pydrake.geometry import Box
from pydrake.math import RigidTransform
from pydrake.multibody.plant import CoulombFriction
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Diagram, DiagramBuilder
from pydrake.systems.primitives import MatrixGain, TrajectorySource, VectorLogSink
from pydrake.trajectories import PiecewisePolynomial

from vtbdrake.testbed import Interface, VirtualTestbedBuilder
from vtbdrake_diagrams.space_climber import SpaceClimberScenario
from vtbdrake_diagrams.space_climber.gait import GAITS
from vtbdrake_diagrams.space_climber.morphology import JOINT_NAMES, Morphology
from vtbdrake_diagrams.space_climber.plant import add_climber, add_payload, set_foot_friction
from vtbdrake_diagrams.space_climber.walking import make_walking

JOINTS = len(JOINT_NAMES)


@dataclass
class CppClimberScenario(SpaceClimberScenario):
    """The same robot on level ground, without sensors: its joints follow what the gait generator commands when the
    torso is level and the heading is kept."""

    # Length of the recorded gait, in seconds.
    duration: float = 15.0

    def interface(self) -> Interface:
        joint_position = next(signal for signal in super().interface().act)
        return Interface(sense=[], act=[joint_position])

    def make_dps(self) -> Diagram:
        builder = DiagramBuilder()
        source = builder.AddNamedSystem("gait", TrajectorySource(self._recorded_gait()))
        builder.ExportOutput(source.get_output_port(), "joint_position")
        return builder.Build()

    def _recorded_gait(self) -> PiecewisePolynomial:
        builder = DiagramBuilder()
        walking = builder.AddSystem(make_walking(GAITS[self.gait], period=self.period, morphology=Morphology()))
        sink = builder.AddSystem(VectorLogSink(JOINTS, publish_period=self.period))
        builder.Connect(walking.get_output_port(), sink.get_input_port())
        diagram = builder.Build()
        simulator = Simulator(diagram)
        context = walking.GetMyMutableContextFromRoot(simulator.get_mutable_context())
        for name, value in (("pose", np.zeros(6)), ("heading", [0.0]), ("walk", [1.0])):
            walking.GetInputPort(name).FixValue(context, value)
        simulator.AdvanceTo(self.duration)
        log = sink.FindLog(simulator.get_context())
        return PiecewisePolynomial.FirstOrderHold(log.sample_times(), log.data())

    def add_world(self, builder: VirtualTestbedBuilder) -> None:
        plant, scene_graph = builder.add_plant(self.plant_config)
        climber = add_climber(plant)
        add_payload(plant, climber)
        friction = CoulombFriction(self.friction, self.friction)
        X_WG = RigidTransform([0.0, 0.0, -0.5])
        plant.RegisterCollisionGeometry(plant.world_body(), X_WG, Box(200.0, 200.0, 1.0), "ground", friction)
        plant.mutable_gravity_field().set_gravity_vector([0.0, 0.0, -self.gravity])
        plant.Finalize()
        set_foot_friction(plant, scene_graph, climber, self.friction)
        rest = np.vstack([np.eye(JOINTS), np.zeros((JOINTS, JOINTS))])
        servos = builder.add("act", "servos", MatrixGain(rest))
        builder.connect(servos.get_output_port(), plant.get_desired_state_input_port(climber))
        builder.sim_actuator("joint_position", servos.get_input_port())
