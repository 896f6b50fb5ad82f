"""A good diagram, and bad ones: each is bad in one way, and fails one check."""

from __future__ import annotations

import os
import sys
import threading
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from drake import lcmt_acrobot_u, lcmt_acrobot_x, lcmt_header
from pydrake.autodiffutils import AutoDiffXd, ExtractValue
from pydrake.common.value import Value
from pydrake.multibody.plant import MultibodyPlantConfig
from pydrake.systems.analysis import SimulatorConfig
from pydrake.systems.framework import BasicVector_, DiagramBuilder, InputPort_, LeafSystem, LeafSystem_, System
from pydrake.systems.primitives import DiscreteTimeIntegrator, Gain, LinearSystem, ZeroOrderHold
from pydrake.systems.scalar_conversion import TemplateSystem

from tests.testbeds import add_deformable_ball
from vtbdrake.control.fallback import Zero
from vtbdrake.deployment import Deployment
from vtbdrake.lcm.maps import LcmMap, vector_map
from vtbdrake.lcm.protocol import Protocol
from vtbdrake.state import AddressedSystem, Quantity
from vtbdrake.state.declarations import NO_DICT, Codec, weakly
from vtbdrake.testbed import Interface, Scenario, Signal, VirtualTestbedBuilder

PERIOD = 0.01


class Pilot(AddressedSystem):
    """A DPS that drives an axis to a target: velocity = gain (target - position), sampled.

    .. pydrake_system::

        name: Pilot
        input_ports:
        - position
        - speed
        - target
        output_ports:
        - velocity
    """

    bounds: Any = (0.0, 10.0)

    def __init__(self) -> None:
        super().__init__()
        self._position = self.DeclareVectorInputPort("position", 1)
        self.DeclareVectorInputPort("speed", 1)
        self._target = self.DeclareVectorInputPort("target", 1)
        self._settings = self.declare_parameters(gain=Quantity(2.0, "1/s", self.bounds))
        self._command = self.declare_discrete_state(velocity=Quantity([0.0], "m/s"))
        self.DeclareStateOutputPort("velocity", self._command.index)
        self.DeclarePeriodicDiscreteUpdateEvent(PERIOD, 0.0, self._update)

    def _update(self, context, discrete):
        error = self._target.Eval(context) - self._position.Eval(context)
        self._command.mutable(discrete).velocity = self.command(self._settings.view(context).gain * error, context)

    def command(self, velocity, context):
        return velocity


class Encoder(AddressedSystem):
    """A sampled sensor of the position.

    .. pydrake_system::

        name: Encoder
        input_ports:
        - truth
        output_ports:
        - position
    """

    def __init__(self) -> None:
        super().__init__()
        self._truth = self.DeclareVectorInputPort("truth", 1)
        self._sample = self.declare_discrete_state(position=Quantity([self.first()], "m"))
        self.DeclareStateOutputPort("position", self._sample.index)
        self.DeclarePeriodicDiscreteUpdateEvent(PERIOD, 0.0, self._update)

    def first(self):
        return 0.0

    def _update(self, context, discrete):
        self._sample.mutable(discrete).position = self._truth.Eval(context) + self.error(context)

    def error(self, context):
        return 0.0


POSITION = {"position": "theta1"}
SPEED = {"speed": "theta1Dot"}


@dataclass
class GoodScenario(Scenario):
    """An axis that is commanded by its velocity, and has a machine."""

    simulator_config: SimulatorConfig = field(default_factory=lambda: SimulatorConfig(max_step_size=0.1, accuracy=1e-6))
    offset: float = 0.0

    def interface(self) -> Interface:
        return Interface(
            sense=[
                Signal("position", size=1, unit="m", lower=-2.0, upper=2.0, max_age=5 * PERIOD),
                Signal("speed", size=1, unit="m/s", lower=-2.0, upper=2.0, max_age=5 * PERIOD),
            ],
            act=[Signal("velocity", size=1, unit="m/s", lower=-1.0, upper=1.0, idle=0.0)],
            commands=[Signal("target", size=1, unit="m", lower=-1.0, upper=1.0, default=0.4)],
        )

    def make_dps(self) -> System:
        return Pilot()

    def make_encoder(self) -> System:
        return Encoder()

    def add_world(self, builder: VirtualTestbedBuilder) -> None:
        axis = builder.add("sys", "axis", DiscreteTimeIntegrator(1, PERIOD))
        drive = builder.add("act", "drive", ZeroOrderHold(PERIOD, 1))
        encoder = builder.add("sense", "encoder", self.make_encoder())
        builder.connect(drive.get_output_port(), axis.get_input_port())
        builder.connect(axis.get_output_port(), encoder.get_input_port())
        builder.sim_sensor("position", encoder.get_output_port())
        builder.sim_sensor("speed", drive.get_output_port())
        builder.sim_actuator("velocity", drive.get_input_port())

    def deployment(self) -> Deployment:
        return Deployment(
            protocol=Protocol(
                sense=self.sense_maps(),
                act=[vector_map("COMMAND", lcmt_acrobot_u, {"velocity": "tau"}, stamp="timestamp")],
            ),
            period=PERIOD,
            guards={"fallback": {"velocity": Zero()}, "max_delay": {"position": 3 * PERIOD, "speed": 3 * PERIOD}},
            continuity={"velocity": ("speed", 1.0)},
        )

    def sense_maps(self) -> list[Any]:
        return [
            vector_map("POSITION", lcmt_acrobot_x, POSITION, stamp="timestamp"),
            vector_map("SPEED", lcmt_acrobot_x, SPEED, stamp="timestamp"),
        ]

    def with_signal(self, side: str, name: str, **changes: Any) -> Interface:
        """The good interface with one signal changed."""
        interface = GoodScenario.interface(self)
        signals = [replace(s, **changes) if s.name == name else s for s in getattr(interface, side)]
        return replace(interface, **{side: signals})


# -- plain data


class check_builds(GoodScenario):  # noqa: N801 - every bad scenario is called by the check that it fails
    """The DPS lacks a port."""

    def make_dps(self):
        return Encoder()


class check_no_algebraic_loop(GoodScenario):  # noqa: N801
    """Nothing in the loop is sampled."""

    def interface(self):
        signal = Signal("force", size=1, unit="N", lower=-1.0, upper=1.0)
        return Interface(sense=[replace(signal, max_age=1.0)], act=[replace(signal, idle=0.0)])

    def make_dps(self):
        builder = DiagramBuilder()
        gain = builder.AddNamedSystem("impl", Gain(0.5, 1))
        builder.ExportInput(gain.get_input_port(), "force")
        builder.ExportOutput(gain.get_output_port(), "force")
        return builder.Build()

    def add_world(self, builder):
        plant = builder.add("sys", "plant", Gain(1.0, 1))
        builder.sim_sensor("force", plant.get_output_port())
        builder.sim_actuator("force", plant.get_input_port())


class check_builds_alike_twice(GoodScenario):  # noqa: N801
    """The first sample is drawn anew in each build."""

    def make_encoder(self):
        class Random(Encoder):
            def first(self):
                return float(np.random.default_rng().normal(scale=1e-3))

        return Random()


@dataclass
class check_yaml_round_trip(GoodScenario):  # noqa: N801
    """A field is of a type that no file can hold."""

    axes: Any = frozenset({"x"})


class Unsendable:
    def __reduce__(self):
        raise TypeError("a lock stays where it is")

    def __deepcopy__(self, memo):
        return self


@dataclass
class check_pickle_round_trip(GoodScenario):  # noqa: N801
    """It holds what cannot be sent to other processes."""

    def __post_init__(self):
        self.lock = Unsendable()


@dataclass
class Forgetful(GoodScenario):
    def make_dps(self):
        class WithMemory(Pilot):
            def __init__(self):
                super().__init__()
                self.declare_discrete_state(more=Quantity())

        return WithMemory()


@dataclass
class check_mental_copy_continues(GoodScenario):  # noqa: N801
    """The DPS of the mental copy has another state."""

    def mental(self):
        return Forgetful()


# -- declarations


class check_signals_have_units(GoodScenario):  # noqa: N801
    """A signal is in degrees."""

    def interface(self):
        return self.with_signal("sense", "speed", unit="deg/s")


class check_signals_have_limits(GoodScenario):  # noqa: N801
    """A sensor signal has a lower limit only."""

    def interface(self):
        return self.with_signal("sense", "speed", upper=np.inf)


class check_parameters_have_bounds(GoodScenario):  # noqa: N801
    """The gain may be anything."""

    def make_dps(self):
        class Unbounded(Pilot):
            bounds = (0.0, np.inf)

        return Unbounded()


class check_variables_do_not_overlap(GoodScenario):  # noqa: N801
    """The first sample has two names."""

    def make_encoder(self):
        encoder = Encoder()
        encoder.variables = (*encoder.variables, replace(encoder.variables[0], name="again"))
        return encoder


class check_values_fit_their_signals(GoodScenario):  # noqa: N801
    """The DPS commands more than the drive can, for a while."""

    def make_dps(self):
        class Hasty(Pilot):
            def command(self, velocity, context):
                return velocity + 2.0 * (0.05 < context.get_time() < 0.08)

        return Hasty()


# -- repetition


def with_encoder(kind):
    """A method of a scenario whose encoder is a ``kind``."""
    return lambda self: kind()


class Breaking(Encoder):
    def error(self, context):
        if context.get_time() > 0.05:
            raise RuntimeError("the disc is broken")
        return 0.0


class check_simulates(GoodScenario):  # noqa: N801
    """The encoder raises after a while."""

    make_encoder = with_encoder(Breaking)


class Logging(Encoder):
    def error(self, context):
        self.last = context.get_time()
        return 0.0


class check_state_is_in_the_context(GoodScenario):  # noqa: N801
    """The encoder remembers, in itself, what nobody reads."""

    make_encoder = with_encoder(Logging)


class Unseeded(Encoder):
    def __init__(self):
        super().__init__()
        self._bias = self.declare_discrete_state(bias=Quantity([0.0], "m"))
        self.DeclareInitializationDiscreteUpdateEvent(self._begin)

    def _begin(self, context, discrete):
        self._bias.mutable(discrete).bias = np.random.default_rng().normal(scale=1e-3, size=1)

    def error(self, context):
        return self._bias.view(context).bias


class check_runs_repeat(GoodScenario):  # noqa: N801
    """The bias of the encoder is drawn anew in each simulation."""

    make_encoder = with_encoder(Unseeded)


class Local(Encoder):
    def __init__(self):
        super().__init__()
        self._connection = Connection()

    def error(self, context):
        return self._connection.local.value


class Connection:
    """An object that belongs to the thread that has made it, as a connection to a database does."""

    def __init__(self):
        self.local = threading.local()
        self.local.value = 0.0


class check_threads_agree(GoodScenario):  # noqa: N801
    """The encoder works in the thread only in which it was built."""

    make_encoder = with_encoder(Local)


class OfProcess(Encoder):
    def error(self, context):
        return 1e-9 * os.getpid()


class check_processes_agree(GoodScenario):  # noqa: N801
    """The encoder measures otherwise in another process."""

    make_encoder = with_encoder(OfProcess)


class Homing(Encoder):
    system = None

    def error(self, context):
        if self.system is not None and context.get_time() > 0.02:
            self.system.configure_default_state([0.1])
        return 0.0


class check_reset_equals_a_new_build(GoodScenario):  # noqa: N801
    """The encoder changes the default of another system while it is simulated."""

    make_encoder = with_encoder(Homing)

    def add_world(self, builder):
        super().add_world(builder)
        slide = builder.add("sys", "slide", LinearSystem([[1.0]], [[0.0]], [[1.0]], [[0.0]], time_period=PERIOD))
        builder.connect(
            builder.diagram_builder.GetSubsystemByName("sim.sys.axis").get_output_port(), slide.get_input_port()
        )
        builder.diagram_builder.GetSubsystemByName("sim.sense.encoder").system = slide


class PlainPilot(LeafSystem):
    """A DPS whose timing Drake does not tell: 3 ms after the measurements, by an unrestricted update."""

    def __init__(self) -> None:
        super().__init__()
        self.ports = [self.DeclareVectorInputPort(name, 1) for name in ("position", "speed", "target")]
        self.velocity = self.DeclareDiscreteState(1)
        self.DeclareStateOutputPort("velocity", self.velocity)
        self.DeclarePeriodicUnrestrictedUpdateEvent(PERIOD, 0.3 * PERIOD, self.update)

    def update(self, context, state):
        position, _, target = (port.Eval(context) for port in self.ports)
        state.get_mutable_discrete_state(self.velocity).SetFromVector(2.0 * (target - position))


class Offset(GoodScenario):
    """The good diagram with a DPS between the instants that Drake tells."""

    def make_dps(self):
        return PlainPilot()


class Soft(GoodScenario):
    """The good diagram beside a deformable body, which Drake 1.51 does not reset."""

    def add_world(self, builder):
        super().add_world(builder)
        plant, _ = builder.add_plant(MultibodyPlantConfig(time_step=PERIOD))
        add_deformable_ball(plant)
        plant.Finalize()


class Buffer:
    """A value that all copies of a context share, and change."""

    def __init__(self, total=0.0):
        self.total = total

    def __deepcopy__(self, memo):
        return self


class Sharing(Encoder):
    def __init__(self):
        super().__init__()
        self.codecs = {0: Codec(lambda buffer: {"": np.array(buffer.total)}, lambda arrays: Buffer(float(arrays[""])))}
        self._buffer = self.DeclareAbstractState(Value(Buffer()))
        self.DeclareInitializationUnrestrictedUpdateEvent(self._begin)
        self.DeclarePeriodicUnrestrictedUpdateEvent(PERIOD, 0.5 * PERIOD, self._add)

    def _begin(self, context, state):
        state.get_mutable_abstract_state(int(self._buffer)).set_value(Buffer())

    def _add(self, context, state):
        state.get_mutable_abstract_state(int(self._buffer)).get_mutable_value().total += 1.0

    def error(self, context):
        return 1e-6 * context.get_abstract_state(int(self._buffer)).get_value().total


class check_fork_is_the_future(GoodScenario):  # noqa: N801
    """Copies of a context share a value that changes."""

    make_encoder = with_encoder(Sharing)


class Rounding(Encoder):
    def __init__(self):
        super().__init__()
        self.codecs = {0: Codec(lambda value: {"": np.float32(value)}, lambda arrays: float(arrays[""]))}
        self._walk = self.DeclareAbstractState(Value(0.0))
        self.DeclarePeriodicUnrestrictedUpdateEvent(PERIOD, 0.5 * PERIOD, self._add)

    def _add(self, context, state):
        walk = state.get_mutable_abstract_state(int(self._walk))
        walk.set_value(walk.get_value() + 1e-4 / 3.0)

    def error(self, context):
        return context.get_abstract_state(int(self._walk)).get_value()


class check_snapshot_resumes(GoodScenario):  # noqa: N801
    """The codec of a state rounds it to 32 bits."""

    make_encoder = with_encoder(Rounding)


ENCODERS: list[Any] = []


class Listed(Encoder):
    def __init__(self):
        super().__init__()
        ENCODERS.append(self)


class check_dropped_testbed_is_freed(GoodScenario):  # noqa: N801
    """All encoders are in a list."""

    make_encoder = with_encoder(Listed)


class ByLambda(Encoder):
    def __init__(self):
        super().__init__()
        self.again = self.declare_cache("again", lambda context: self.error(context), {self.nothing_ticket()})


class CacheByLambda(GoodScenario):
    """A cache entry of the encoder is declared with a function that refers to the encoder."""

    make_encoder = with_encoder(ByLambda)


LOG: list[Any] = []


class Verbose(Encoder):
    def error(self, context):
        LOG.append([context.get_time()])
        return 0.0


class check_runs_keep_no_memory(GoodScenario):  # noqa: N801
    """All samples are in a list."""

    make_encoder = with_encoder(Verbose)


# -- the boundary of the DPS


class check_sim_and_real_alike(GoodScenario):  # noqa: N801
    """The message rounds what the simulated sensor measures."""

    def sense_maps(self):
        tenths_of_millimetres = vector_map("POSITION", lcmt_header, {"position": "seq"}, scale={"position": 1e-4})
        return [tenths_of_millimetres, super().sense_maps()[1]]


class check_dps_cannot_tell_the_switch(GoodScenario):  # noqa: N801
    """The target comes from the simulated world."""

    def add_world(self, builder):
        super().add_world(builder)
        ahead = builder.add("sys", "ahead", Gain(0.5, 1))
        builder.connect(
            builder.diagram_builder.GetSubsystemByName("sim.act.drive").get_output_port(), ahead.get_input_port()
        )
        builder.command("target", ahead.get_output_port())

    def make_dps(self):
        class Starting(Pilot):
            def command(self, velocity, context):
                return velocity + 0.1

        return Starting()


@dataclass
class check_dps_alone_commands_the_same(GoodScenario):  # noqa: N801
    """The DPS reads what building the world has left behind."""

    def __post_init__(self):
        self.calibration = [0.0]

    def make_dps(self):
        calibration = self.calibration

        class Calibrated(Pilot):
            def command(self, velocity, context):
                return velocity + calibration[0]

        return Calibrated()

    def add_world(self, builder):
        super().add_world(builder)
        self.calibration[0] = 1e-3


# -- the loop


class check_deployment_is_safe(GoodScenario):  # noqa: N801
    """Nothing tells where the commands start from."""

    def deployment(self):
        return replace(super().deployment(), continuity={})


class check_loop_commands_its_machine(GoodScenario):  # noqa: N801
    """The first command is far from what the machine does."""

    def deployment(self):
        return replace(super().deployment(), continuity={"velocity": ("speed", 1e-3)})


class check_silence_ends_in_the_fallback(GoodScenario):  # noqa: N801
    """One of two sensors may be silent for ever."""

    def interface(self):
        return self.with_signal("sense", "speed", max_age=np.inf)


def position_message(values, utime):
    message = lcmt_acrobot_x()
    message.timestamp, (message.theta1,) = utime, values["position"]
    return message


LENIENT = LcmMap(
    channel="POSITION",
    type=lcmt_acrobot_x,
    signals=["position"],
    decode=lambda message: {"position": np.nan_to_num([message.theta1])},
    encode=position_message,
    sent=lambda message: 1e-6 * message.timestamp,
)


class check_nan_ends_in_the_fallback(GoodScenario):  # noqa: N801
    """NaN becomes zero on its way."""

    def sense_maps(self):
        return [LENIENT, super().sense_maps()[1]]


class check_repeated_samples_end_in_the_fallback(GoodScenario):  # noqa: N801
    """A message has no time."""

    def sense_maps(self):
        return [super().sense_maps()[0], vector_map("SPEED", lcmt_acrobot_x, SPEED, stamp="")]


class check_late_samples_end_in_the_fallback(GoodScenario):  # noqa: N801
    """Nothing limits how late messages may be."""

    def deployment(self):
        return replace(super().deployment(), guards={"fallback": {"velocity": Zero()}})


# -- derivatives


@TemplateSystem.define("Square_", T_list=[float, AutoDiffXd], scope=sys.modules[__name__])
def Square_(T):
    class Impl(LeafSystem_[T]):
        __slots__ = NO_DICT

        def _construct(self, converter=None, wrong=False):
            LeafSystem_[T].__init__(self, converter)
            self.wrong = wrong
            read = weakly(self.DeclareVectorInputPort("x", BasicVector_[T](1)), InputPort_[T].Eval)

            def calc(context, output):
                x = read(context)
                if wrong and T is AutoDiffXd:
                    x = np.array([AutoDiffXd(float(ExtractValue(x)[0, 0]))])
                output.SetAtIndex(0, x[0] * x[0] + 2.0 * x[0])

            self.DeclareVectorOutputPort("y", BasicVector_[T](1), calc)

        def _construct_copy(self, other, converter=None):
            Impl._construct(self, converter=converter, wrong=other.wrong)

    return Impl


@dataclass
class Differentiable(GoodScenario):
    """A good scenario, one of whose systems converts to AutoDiffXd."""

    wrong: bool = False

    def add_world(self, builder):
        super().add_world(builder)
        axis = builder.diagram_builder.GetSubsystemByName("sim.sys.axis")
        builder.connect(
            axis.get_output_port(), builder.add("sys", "square", Square_[float](wrong=self.wrong)).get_input_port()
        )


@dataclass
class check_derivatives_are_right(Differentiable):  # noqa: N801
    """A system computes with plain numbers, although it converts to AutoDiffXd."""

    wrong: bool = True


BAD = {name: kind for name, kind in globals().items() if name.startswith("check_")}
