"""Small testbeds for the tests, on Drake's own example models."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from pydrake.common.value import Value
from pydrake.geometry import AddContactMaterial, GeometryInstance, ProximityProperties, Sphere
from pydrake.math import RigidTransform
from pydrake.multibody.fem import DeformableBodyConfig
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import CoulombFriction, MultibodyPlant, MultibodyPlantConfig
from pydrake.systems.analysis import SimulatorConfig
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, DiscreteValues, LeafSystem, System
from pydrake.systems.primitives import Adder, Demultiplexer, Gain, ZeroOrderHold

from vtbdrake.state import AddressedSystem, Quantity
from vtbdrake.testbed import Interface, Scenario, Signal, VirtualTestbedBuilder

PENDULUM = "package://drake/examples/pendulum/Pendulum.urdf"
ACROBOT = "package://drake/examples/acrobot/Acrobot.urdf"


def _accurate() -> SimulatorConfig:
    return SimulatorConfig(accuracy=1e-6, max_step_size=0.05)


@dataclass
class PendulumScenario(Scenario):
    """Drake's pendulum, held at an angle by a PD law: C++ systems only, and no sampling.

    With gains of zero it swings freely.
    """

    simulator_config: SimulatorConfig = field(
        default_factory=lambda: SimulatorConfig(accuracy=1e-6, max_step_size=0.05)
    )
    stiffness: float = 0.0
    damping: float = 0.0
    idle: float = 0.0

    def interface(self) -> Interface:
        return Interface(
            sense=[Signal("joint_state", size=2, unit="rad, rad/s")],
            act=[Signal("torque", size=1, unit="N m", idle=self.idle)],
            commands=[Signal("angle", size=1, unit="rad", lower=-np.pi, upper=np.pi)],
        )

    def make_dps(self) -> Diagram:
        builder = DiagramBuilder()
        split = builder.AddNamedSystem("sense", Demultiplexer(2, 1))
        error = builder.AddNamedSystem("error", Adder(2, 1))
        spring = builder.AddNamedSystem("spring", Gain(self.stiffness, 1))
        damper = builder.AddNamedSystem("damper", Gain(-self.damping, 1))
        minus = builder.AddNamedSystem("minus", Gain(-1.0, 1))
        torque = builder.AddNamedSystem("act", Adder(2, 1))
        builder.Connect(split.get_output_port(0), minus.get_input_port())
        builder.Connect(minus.get_output_port(), error.get_input_port(0))
        builder.Connect(error.get_output_port(), spring.get_input_port())
        builder.Connect(split.get_output_port(1), damper.get_input_port())
        builder.Connect(spring.get_output_port(), torque.get_input_port(0))
        builder.Connect(damper.get_output_port(), torque.get_input_port(1))
        builder.ExportInput(split.get_input_port(), "joint_state")
        builder.ExportInput(error.get_input_port(1), "angle")
        builder.ExportOutput(torque.get_output_port(), "torque")
        return builder.Build()

    def add_world(self, builder: VirtualTestbedBuilder) -> None:
        plant, _ = builder.add_plant(MultibodyPlantConfig(time_step=0.0))
        Parser(plant).AddModelsFromUrl(PENDULUM)
        plant.Finalize()
        builder.sim_sensor("joint_state", plant.get_state_output_port())
        builder.sim_actuator("torque", plant.get_actuation_input_port())


class SampledFeedback(AddressedSystem):
    """Discrete state feedback with a counter, in Python.

    .. pydrake_system::

        name: SampledFeedback
        input_ports:
        - joint_state
        output_ports:
        - torque
    """

    def __init__(self, period: float) -> None:
        super().__init__()
        self._settings = self.declare_parameters(
            gain=Quantity([0.0, 0.0, -3.0, -1.0], "N m/rad, N m s/rad", (-1e3, 1e3))
        )
        self._command = self.declare_discrete_state(torque=Quantity(unit="N m"))
        self._counter = self.declare_discrete_state(ticks=Quantity())
        self._state = self.DeclareVectorInputPort("joint_state", 4)
        self.DeclareVectorOutputPort(
            "torque",
            1,
            lambda context, output: output.SetFromVector(context.get_discrete_state(0).value()),
            prerequisites_of_calc={self.discrete_state_ticket(self._command.index)},
        )
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)

    def _update(self, context: Context, discrete: DiscreteValues) -> None:
        self._command.mutable(discrete).torque = self._settings.view(context).gain @ self._state.Eval(context)
        self._counter.mutable(discrete).ticks += 1.0


@dataclass
class AcrobotScenario(Scenario):
    """Drake's acrobot with a sampled Python DPS; one joint sensor, held and thereby delayed by a period."""

    simulator_config: SimulatorConfig = field(
        default_factory=lambda: SimulatorConfig(accuracy=1e-6, max_step_size=0.05)
    )
    period: float = 0.02
    time_step: float = 0.0

    def interface(self) -> Interface:
        return Interface(
            sense=[Signal("joint_state", size=4, unit="rad, rad/s", max_age=0.1)],
            act=[Signal("torque", size=1, unit="N m", lower=-10.0, upper=10.0, idle=0.0)],
        )

    def make_dps(self) -> System:
        return SampledFeedback(self.period)

    def add_world(self, builder: VirtualTestbedBuilder) -> None:
        plant, _ = builder.add_plant(MultibodyPlantConfig(time_step=self.time_step))
        Parser(plant).AddModelsFromUrl(ACROBOT)
        plant.Finalize()
        sensor = builder.add("sense", "joints", ZeroOrderHold(self.period, 4))
        builder.connect(plant.get_state_output_port(), sensor.get_input_port())
        builder.sim_sensor("joint_state", sensor.get_output_port())
        builder.sim_actuator("torque", plant.get_actuation_input_port())


class PoseRelay(LeafSystem):
    """A DPS whose sensor signal and actuator signal are abstract: it commands the pose that it sees, mirrored.

    .. pydrake_system::

        name: PoseRelay
        input_ports:
        - seen
        output_ports:
        - commanded
    """

    def __init__(self) -> None:
        super().__init__()
        seen = self.DeclareAbstractInputPort("seen", Value(RigidTransform()))

        def calc(context: Context, output: Value) -> None:  # type: ignore[valid-type]
            output.set_value(seen.Eval(context).inverse())  # type: ignore[attr-defined]

        self.DeclareAbstractOutputPort("commanded", lambda: Value(RigidTransform()), calc)


def add_deformable_ball(plant: MultibodyPlant) -> None:
    """Add a ball that deforms and falls: discrete state 1, after the state of the rigid bodies."""
    properties = ProximityProperties()
    AddContactMaterial(friction=CoulombFriction(0.5, 0.5), properties=properties)
    ball = GeometryInstance(RigidTransform([0.0, 0.0, 3.0]), Sphere(0.1), "ball")
    ball.set_proximity_properties(properties)
    plant.mutable_deformable_model().RegisterDeformableBody(ball, DeformableBodyConfig(), 1.0)
