"""A DPS that commands NaN or infinity after a quarter of a second, and continuous worlds that become NaN then."""

from dataclasses import dataclass, field

import numpy as np
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlantConfig
from pydrake.systems.analysis import SimulatorConfig
from pydrake.systems.framework import BasicVector, DiagramBuilder, LeafSystem
from pydrake.systems.primitives import (
    ConstantVectorSource,
    Integrator,
    LinearSystem,
    Multiplexer,
    PassThrough,
    TrajectorySource,
    ZeroOrderHold,
)
from pydrake.trajectories import PiecewisePolynomial

from vtbdrake.testbed import Interface, Scenario, Signal

PENDULUM = """
<robot name="pendulum">
  <link name="arm"><inertial><mass value="1"/>
    <inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="pin" type="continuous"><parent link="world"/><child link="arm"/><axis xyz="0 1 0"/></joint>
  <transmission><type>transmission_interface/SimpleTransmission</type><joint name="pin"/><actuator name="pin"/>
  </transmission>
</robot>
"""


class FailingLaw(LeafSystem):
    """Commands 0, and ``bad`` after 0.25 s: at its next sample, or at once."""

    def __init__(self, bad, *, sampled):
        super().__init__()
        self._bad = bad
        self.DeclareVectorInputPort("state", 2)
        if sampled:
            state = self.DeclareDiscreteState(1)
            self.DeclarePeriodicDiscreteUpdateEvent(0.1, 0.0, self._update)
            self.DeclareStateOutputPort("force", state)
        else:
            self.DeclareVectorOutputPort("force", 1, self._calc, {self.time_ticket()})

    def _command(self, context):
        return [self._bad if context.get_time() > 0.25 else 0.0]

    def _update(self, context, discrete):
        discrete.set_value(self._command(context))

    def _calc(self, context, output):
        output.SetFromVector(self._command(context))


def compiled_law(bad, *, sampled):
    """Return `FailingLaw` made of Drake's own systems, without Python."""
    builder = DiagramBuilder()
    state = builder.AddNamedSystem("state", PassThrough(2))
    after = np.nextafter(0.25, 1.0)
    plan = PiecewisePolynomial.ZeroOrderHold([0.0, after, 1e6], [[0.0, bad, bad]])
    output = builder.AddNamedSystem("plan", TrajectorySource(plan)).get_output_port()
    if sampled:
        hold = builder.AddNamedSystem("hold", ZeroOrderHold(0.1, 1))
        builder.Connect(output, hold.get_input_port())
        output = hold.get_output_port()
    builder.ExportInput(state.get_input_port(), "state")
    builder.ExportOutput(output, "force")
    return builder.Build()


class Tank(LeafSystem):
    """The level x of a tank, in m, whose rate is a root until t = 0.25 s: the root of a negative number is NaN."""

    def __init__(self, root):
        super().__init__()
        self._root = root
        self.DeclareContinuousState(BasicVector([0.0625]))
        self.DeclarePeriodicDiscreteUpdateEvent(1.0, 0.25, lambda context, discrete: discrete.set_value([-1.0]))
        self.DeclareDiscreteState(BasicVector([1.0]))

    def DoCalcTimeDerivatives(self, context, derivatives):
        (level,) = context.get_continuous_state_vector().CopyToVector()
        root = {
            "of time": lambda: np.sqrt(0.25 - context.get_time()),
            # Torricelli's law, and a pump that goes on.
            "of state": lambda: -np.sqrt(level) - 0.125,
            # NaN from an event on, at the beginning of a step.
            "of input": lambda: np.sqrt(context.get_discrete_state_vector().value()[0]),
        }[self._root]
        with np.errstate(invalid="ignore"):
            derivatives.get_mutable_vector().SetFromVector([root()])


@dataclass
class NonfiniteScenario(Scenario):
    """A mass (a LinearSystem) or a pendulum (a MultibodyPlant) under a force that is not finite any more."""

    simulator_config: SimulatorConfig = field(default_factory=SimulatorConfig)
    bad: str = "nan"  # as a text: numbers of a scenario are finite
    sampled: bool = True
    compiled: bool = False  # the DPS consists of systems in C++
    plant: bool = False
    time_step: float = 0.0
    # The force comes from a system of the world, and is not finite from the beginning.
    in_world: bool = False
    # There is a `Tank` in the world.
    root: str = ""

    def interface(self):
        return Interface(
            sense=[Signal("state", size=2)], act=[Signal("force", size=1, unit="N", idle=0.0)], commands=[]
        )

    def make_dps(self):
        law = compiled_law if self.compiled else FailingLaw
        return law(0.0 if self.in_world or self.root else float(self.bad), sampled=self.sampled)

    def add_world(self, builder):
        if self.root == "of wind":  # In C++ alone.
            wind = PiecewisePolynomial.ZeroOrderHold([0.0, 0.25, 1e6], [[1.0, np.nan, np.nan]])
            source = builder.add("env", "weather", TrajectorySource(wind))
            hold = builder.add("env", "hold", ZeroOrderHold(0.05, 1))
            tank = builder.add("env", "tank", Integrator(1))
            builder.connect(source.get_output_port(), hold.get_input_port())
            builder.connect(hold.get_output_port(), tank.get_input_port())
        elif self.root:
            builder.add("env", "tank", Tank(self.root))
        if self.plant:
            plant, _ = builder.add_plant(MultibodyPlantConfig(time_step=self.time_step))
            Parser(plant).AddModelsFromString(PENDULUM, "urdf")
            plant.Finalize()
            builder.sim_sensor("state", plant.get_state_output_port())
            builder.sim_actuator("force", plant.get_actuation_input_port())
            if self.in_world:
                wind = builder.add("env", "wind", ConstantVectorSource([float(self.bad)]))
                builder.connect(wind.get_output_port(), plant.get_applied_generalized_force_input_port())
            return
        system = LinearSystem(np.eye(2, k=1), np.array([[0.0, 0.0], [1.0, 1.0]]), np.eye(2), np.zeros((2, 2)))
        mass = builder.add("sys", "mass", system)
        builder.sim_sensor("state", mass.get_output_port())
        forces = builder.add("sys", "forces", Multiplexer(2))
        wind = builder.add("env", "wind", ConstantVectorSource([float(self.bad) if self.in_world else 0.0]))
        builder.connect(wind.get_output_port(), forces.get_input_port(1))
        builder.connect(forces.get_output_port(), mass.get_input_port())
        builder.sim_actuator("force", forces.get_input_port(0))
