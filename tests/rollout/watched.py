"""An acrobot that is watched: by a sensor whose place can be chosen, and which moves nothing unless it is asked to."""

from dataclasses import dataclass

import numpy as np
from pydrake.common.value import Value
from pydrake.math import RigidTransform
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlantConfig
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import Adder, FirstOrderLowPassFilter, Gain, ZeroOrderHold

from tests.testbeds import ACROBOT, AcrobotScenario, SampledFeedback
from vtbdrake.components.sensors import ErrorModel, SampledSensor
from vtbdrake.state import AddressedSystem, Quantity
from vtbdrake.testbed import Interface, Signal
from vtbdrake.testbed.slow_part import SlowPart

PERIOD = 0.1  # s, of the sensor and of the detector


class Sight(SampledSensor):
    """Measures the vector from its place to the tip of the acrobot, in W.

    .. pydrake_system::

        name: Sight
        input_ports:
        - body_poses
        output_ports:
        - sight
    """

    def __init__(self, body):
        errors = ErrorModel(noise=0.01, seed=7, latency=1)
        super().__init__(
            "sight", default=np.zeros(3), period=PERIOD, unit="m", noise={"noise": (3, "m")}, errors=errors
        )
        self._body = int(body)
        self._settings = self.declare_parameters(place=Quantity(np.zeros(3), "m"))
        self._poses = self.DeclareAbstractInputPort("body_poses", Value[list[RigidTransform]]())
        self.measured = 0  # counts calls: the result does not depend on it

    def _measure(self, context, state):
        self.measured += 1
        tip = self._poses.Eval(context)[self._body].translation()
        place = self._settings.view(context).place
        SECRET[0] = place[0]
        return tip - place


class Memory(AddressedSystem):
    """Adds up what it is given, for ever.

    .. pydrake_system::

        name: Memory
        input_ports:
        - u
        output_ports:
        - y
    """

    def __init__(self):
        super().__init__()
        self._sum = self.declare_discrete_state(total=Quantity())
        self.DeclareVectorInputPort("u", 1)
        self.DeclareStateOutputPort("y", self._sum.index)
        self.DeclarePeriodicDiscreteUpdateEvent(PERIOD, 0.0, self._add)

    def _add(self, context, state):
        self._sum.mutable(state).total += self.EvalVectorInput(context, 0).value().item()


# What a leaky feedback reads beside its ports: the last place of a sensor.
SECRET = [0.0]


class Leaky(SampledFeedback):
    """A feedback that also depends on what no connection shows."""

    def _update(self, context, discrete):
        super()._update(context, discrete)
        discrete.set_value(0, discrete.value(0) + 1e-9 * SECRET[0])


def closeness(seen):
    return [1.0 / (1.0 + float(np.linalg.norm(seen)))]


@dataclass
class WatchedScenario(AcrobotScenario):
    time_step: float = 0.005
    steered: bool = False  # whether the DPS moves by what it sees
    leaky: bool = False
    filtered: bool = False  # whether the sensor is filtered by a continuous system

    def interface(self):
        own = super().interface()
        return Interface(sense=[*own.sense, Signal("sight", size=3, unit="m")], act=own.act)

    def make_dps(self):
        builder = DiagramBuilder()
        feedback = builder.AddNamedSystem("feedback", (Leaky if self.leaky else SampledFeedback)(self.period))
        detector = SlowPart(
            closeness, inputs={"seen": 3}, outputs={"close": 1}, period=PERIOD, latency=0.03, offset=0.05
        )
        builder.AddNamedSystem("detector", detector)
        memory = builder.AddNamedSystem("memory", Memory())
        torque = builder.AddNamedSystem("torque", Adder(2, 1))
        gain = builder.AddNamedSystem("gain", Gain(1.0, 1))
        builder.Connect(detector.GetOutputPort("close"), memory.get_input_port())
        builder.Connect(feedback.get_output_port(), torque.get_input_port(0))
        moving = detector.GetOutputPort("close") if self.steered else feedback.get_output_port()
        builder.Connect(moving, gain.get_input_port())
        builder.Connect(gain.get_output_port(), torque.get_input_port(1))
        builder.ExportInput(feedback.get_input_port(), "joint_state")
        builder.ExportInput(detector.GetInputPort("seen"), "sight")
        builder.ExportOutput(torque.get_output_port(), "torque")
        return builder.Build()

    def add_world(self, builder):
        plant, _ = builder.add_plant(MultibodyPlantConfig(time_step=self.time_step))
        Parser(plant).AddModelsFromUrl(ACROBOT)
        plant.Finalize()
        sensor = builder.add("sense", "joints", ZeroOrderHold(self.period, 4))
        builder.connect(plant.get_state_output_port(), sensor.get_input_port())
        if self.filtered:
            smooth = builder.add("sense", "filter", FirstOrderLowPassFilter(0.1, 4))
            builder.connect(sensor.get_output_port(), smooth.get_input_port())
            sensor = smooth
        builder.sim_sensor("joint_state", sensor.get_output_port())
        builder.add_sensor("sight", Sight(plant.GetBodyByName("lower_link").index()))
        builder.sim_actuator("torque", plant.get_actuation_input_port())
