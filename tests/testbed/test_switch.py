"""Switches select simulation or reality, signal by signal, and the twin beside the machine."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydrake.autodiffutils import ExtractGradient, InitializeAutoDiff
from pydrake.common.value import Value
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.systems.analysis import SimulatorConfig
from pydrake.systems.framework import DiagramBuilder, LeafSystem
from pydrake.systems.primitives import ConstantValueSource, ConstantVectorSource, Integrator, LinearSystem, PassThrough
from pydrake.systems.sensors import ImageRgba8U

from tests.testbeds import AcrobotScenario, PendulumScenario
from vtbdrake.state.systems import read_group, stateful_leaves
from vtbdrake.state.variables import VariableError
from vtbdrake.testbed import ActuatorCommand, Interface, Signal, SignalError, VirtualTestbedBuilder
from vtbdrake.testbed.switch import finite_command

PERIOD = 0.01


class Source(LeafSystem):
    """A simulated sensor that shows what a test writes into its state: a vector, or any value."""

    def __init__(self, value):
        super().__init__()
        if isinstance(value, np.ndarray):
            self.DeclareDiscreteState(value)
            self.DeclareStateOutputPort("out", self.DeclareDiscreteState(value))
        else:
            self.DeclareStateOutputPort("out", self.DeclareAbstractState(Value(value)))

    def show(self, root, value):
        context = self.GetMyMutableContextFromRoot(root)
        if isinstance(value, np.ndarray):
            context.SetDiscreteState(1, value)
        else:
            context.SetAbstractState(0, value)


class PoseCounter(LeafSystem):
    """A DPS with an abstract and a vector input, an abstract and a vector output, and sampled memory."""

    def __init__(self):
        super().__init__()
        self.DeclareDiscreteState(3)
        self._pose = self.DeclareAbstractInputPort("pose", Value(RigidTransform()))
        self._range = self.DeclareVectorInputPort("range", 2)
        self.DeclareVectorOutputPort("speed", 3, lambda c, y: y.SetFromVector(c.get_discrete_state(0).value()))
        self.DeclareAbstractOutputPort("look", lambda: Value(RigidTransform()), self._look)
        self.DeclarePeriodicDiscreteUpdateEvent(PERIOD, 0.0, self._update)

    def _update(self, context, discrete):
        memory = context.get_discrete_state(0).value()
        pose, distance = self._pose.Eval(context), self._range.Eval(context)
        discrete.set_value(
            0, 0.7 * memory + pose.translation() * distance[0] + pose.rotation().matrix()[0] * distance[1]
        )

    def _look(self, context, output):
        output.set_value(self._pose.Eval(context).inverse() @ RigidTransform(context.get_discrete_state(0).value()))


class Sink(LeafSystem):
    """A simulated actuator that takes anything."""

    def __init__(self, signal):
        super().__init__()
        if signal.is_vector:
            self.DeclareVectorInputPort("in", signal.size)
        else:
            self.DeclareAbstractInputPort("in", signal.abstract_value())


def _testbed(dps, sense, act, *, mode="sim", sources=None):
    builder = VirtualTestbedBuilder(Interface(sense, act))
    builder.set_dps(dps)
    shown = {}
    for signal in sense:
        value = np.zeros(signal.size) if signal.is_vector else signal.model_value
        shown[signal.name] = builder.add("sense", signal.name, (sources or {}).get(signal.name) or Source(value))
        builder.sim_sensor(signal.name, shown[signal.name].get_output_port())
    for signal in act:
        builder.sim_actuator(signal.name, builder.add("act", signal.name, Sink(signal)).get_input_port())
    return builder.build(mode=mode), shown


def _record(dps_factory, sense, act, samples, mode):
    """The DPS's outputs at every cycle and its final context, fed through one side."""
    testbed, sources = _testbed(dps_factory(), sense, act, mode=mode)
    context = testbed.default_context()
    for name in sources:
        testbed.diagram.GetInputPort(f"real.sense.{name}")
    simulator = testbed.simulator(context)
    outputs = []
    for k, sample in enumerate(samples):
        for name, value in sample.items():
            if mode == "sim":
                sources[name].show(context, value)
            else:
                testbed.diagram.GetInputPort(f"real.sense.{name}").FixValue(context, value)
        simulator.AdvanceTo(k * PERIOD)
        for signal in act:
            value = testbed.read(context, f"dps.{signal.name}")
            outputs.append(value.tobytes() if signal.is_vector else value.GetAsMatrix34().tobytes())
    memory = {}
    for path, system, groups in stateful_leaves(testbed.diagram, context):
        if path == "dps" or path.startswith("dps."):
            leaf = system.GetMyContextFromRoot(context)
            memory |= {(path, kind, k): read_group(leaf, kind, k).tobytes() for kind, k, _ in groups}
    assert memory
    return outputs, memory


finite = st.floats(-10.0, 10.0)


@settings(max_examples=40)
@given(data=st.data(), discrete=st.booleans())
def test_any_linear_dps_gives_identical_bytes_from_either_side(data, discrete):
    matrix = st.lists(st.lists(st.floats(-0.9, 0.9), min_size=2, max_size=2), min_size=2, max_size=2).map(np.array)
    A, B, C, D = (data.draw(matrix) for _ in range(4))
    samples = [
        {"y": np.array(v)}
        for v in data.draw(st.lists(st.lists(finite, min_size=2, max_size=2), min_size=2, max_size=6))
    ]

    def dps():
        builder = DiagramBuilder()
        system = builder.AddNamedSystem("impl", LinearSystem(A, B, C, D, time_period=PERIOD if discrete else 0.0))
        builder.ExportInput(system.get_input_port(), "y")
        builder.ExportOutput(system.get_output_port(), "u")
        return builder.Build()

    sense, act = [Signal("y", size=2)], [Signal("u", size=2, idle=0.0)]
    assert _record(dps, sense, act, samples, "sim") == _record(dps, sense, act, samples, "real")


@settings(max_examples=15)
@given(poses=st.lists(st.lists(finite, min_size=8, max_size=8), min_size=2, max_size=5))
def test_abstract_signals_give_identical_bytes_from_either_side(poses):
    samples = [{"pose": RigidTransform(RollPitchYaw(v[:3]), v[3:6]), "range": np.array(v[6:])} for v in poses]
    sense = [Signal("pose", model_value=RigidTransform()), Signal("range", size=2)]
    act = [Signal("look", model_value=RigidTransform(), idle=RigidTransform()), Signal("speed", size=3, idle=0.0)]
    assert _record(PoseCounter, sense, act, samples, "sim") == _record(PoseCounter, sense, act, samples, "real")


def test_mode_signal_and_side_throw_what_they_name():
    sense = [Signal("pose", model_value=RigidTransform()), Signal("range", size=2)]
    act = [Signal("look", model_value=RigidTransform(), idle=RigidTransform()), Signal("speed", size=3, idle=0.0)]
    testbed, _ = _testbed(PoseCounter(), sense, act)
    context = testbed.default_context()
    testbed.diagram.GetInputPort("real.sense.pose").FixValue(context, RigidTransform([1.0, 2.0, 3.0]))
    testbed.diagram.GetInputPort("real.sense.range").FixValue(context, [1.0, 2.0])
    sim = {"sense": {"pose": "sim", "range": "sim"}, "act": {"look": "sim", "speed": "sim"}}
    assert testbed.positions(context) == sim
    testbed.switch(context, sense={"range": "real"})
    assert testbed.positions(context) == {**sim, "sense": {"pose": "sim", "range": "real"}}
    testbed.switch(context, act="real", sense="sim")
    assert testbed.positions(context) == {**sim, "act": {"look": "real", "speed": "real"}}
    testbed.switch(context, "shadow")
    assert testbed.positions(context) == {**sim, "sense": {"pose": "real", "range": "real"}}
    testbed.switch(context, "twin")
    assert testbed.positions(context)["act"] == {"look": "twin", "speed": "twin"}
    testbed.switch(context, "sim")
    assert testbed.positions(context) == sim


def test_switching_while_running_changes_the_side_at_once():
    testbed, sources = _testbed(
        PoseCounter(),
        [Signal("pose", model_value=RigidTransform()), Signal("range", size=2)],
        [Signal("look", model_value=RigidTransform(), idle=RigidTransform()), Signal("speed", size=3, idle=0.0)],
    )
    context = testbed.default_context()
    simulator = testbed.simulator(context)
    sources["pose"].show(context, RigidTransform([1.0, 0.0, 0.0]))
    sources["range"].show(context, np.array([1.0, 0.0]))
    simulator.AdvanceTo(2.5 * PERIOD)
    assert testbed.read(context, "dps.speed") == pytest.approx([1.0 + 0.7 + 0.49, 0.0, 0.0])
    testbed.diagram.GetInputPort("real.sense.range").FixValue(context, [10.0, 0.0])
    testbed.switch(context, sense={"range": "real"})
    simulator.AdvanceTo(3.5 * PERIOD)
    assert testbed.read(context, "dps.speed") == pytest.approx([10.0 + 0.7 * 2.19, 0.0, 0.0])


def test_no_command_leaves_while_the_switch_is_on_sim():
    sense = [Signal("pose", model_value=RigidTransform()), Signal("range", size=2)]
    act = [Signal("look", model_value=RigidTransform(), idle=RigidTransform()), Signal("speed", size=3, idle=0.5)]
    testbed, _ = _testbed(PoseCounter(), sense, act)
    context = testbed.default_context()
    assert np.isnan(testbed.read(context, "real.act.speed")).all()
    assert testbed.read(context, "real.act.look") == ActuatorCommand(None)
    assert testbed.read(context, "real.act.active").tolist() == [0.0, 0.0]
    testbed.switch(context, act={"speed": "real"})
    assert testbed.read(context, "real.act.active").tolist() == [0.0, 1.0]
    assert testbed.read(context, "real.act.speed").tolist() == [0.0, 0.0, 0.0]
    assert testbed.read(context, "real.act.look") == ActuatorCommand(None)
    testbed.switch(context, act={"look": "real"})
    np.testing.assert_array_equal(testbed.read(context, "real.act.look").value.GetAsMatrix34(), np.eye(3, 4))


@pytest.mark.parametrize(("position", "expected"), [("sim", 0.75), ("real", 0.2), ("twin", 0.75)])
def test_the_simulated_actuator_idles_while_the_real_one_is_driven(position, expected):
    scenario = PendulumScenario(stiffness=1.5, idle=0.2)
    testbed = scenario.build()
    context = testbed.default_context()
    testbed.write(context, {"u.angle": 0.5, "T_act.torque": ["sim", "real", "twin"].index(position)})
    plant_input = testbed.plant.get_actuation_input_port().Eval(testbed.plant.GetMyContextFromRoot(context))
    assert plant_input == pytest.approx([expected])


class Trap(LeafSystem):
    """A sensor that must not be read."""

    def __init__(self):
        super().__init__()
        self.DeclareVectorOutputPort("out", 2, self._calc)

    def _calc(self, context, output):
        raise AssertionError("the branch that is not selected was evaluated")


def test_only_the_selected_branch_is_evaluated():
    testbed, _ = _testbed(
        PassThroughDps(), [Signal("y", size=2)], [Signal("u", size=2, idle=0.0)], mode="real", sources={"y": Trap()}
    )
    context = testbed.default_context()
    testbed.diagram.GetInputPort("real.sense.y").FixValue(context, [1.0, 2.0])
    assert testbed.read(context, "real.act.u").tolist() == [1.0, 2.0]
    testbed.switch(context, "sim")
    with pytest.raises(AssertionError, match="was evaluated"):
        testbed.read(context, "dps.u")


def PassThroughDps():
    builder = DiagramBuilder()
    system = builder.AddNamedSystem("impl", PassThrough(2))
    builder.ExportInput(system.get_input_port(), "y")
    builder.ExportOutput(system.get_output_port(), "u")
    return builder.Build()


def test_images_pass_the_switch():
    image = ImageRgba8U(8, 4)
    image.mutable_data[:] = np.arange(8 * 4 * 4, dtype=np.uint8).reshape(4, 8, 4)

    class Brightness(LeafSystem):
        def __init__(self):
            super().__init__()
            seen = self.DeclareAbstractInputPort("image", Value(ImageRgba8U()))
            self.DeclareVectorOutputPort("brightness", 1, lambda c, y: y.SetFromVector([seen.Eval(c).data.mean()]))

    testbed, sources = _testbed(
        Brightness(), [Signal("image", model_value=ImageRgba8U())], [Signal("brightness", size=1, idle=0.0)]
    )
    context = testbed.default_context()
    sources["image"].show(context, image)
    assert testbed.read(context, "dps.brightness") == image.data.mean()
    testbed.diagram.GetInputPort("real.sense.image").FixValue(context, ImageRgba8U(2, 2, 7))
    testbed.switch(context, "real")
    assert testbed.read(context, "real.act.brightness") == 7.0


def test_a_testbed_of_drakes_systems_keeps_autodiff():
    testbed = PendulumScenario(stiffness=3.0, damping=0.5).build()
    autodiff = testbed.diagram.ToAutoDiffXd()
    context, double = autodiff.CreateDefaultContext(), testbed.default_context()
    testbed.write(double, {"sim.sys.Pendulum.theta.damping": 0.0, "sim.sys.Pendulum.theta.position": 0.3})
    context.SetTimeStateAndParametersFrom(double)
    from pydrake.autodiffutils import InitializeAutoDiff

    x = InitializeAutoDiff(double.get_continuous_state_vector().CopyToVector()).ravel()
    context.SetContinuousState(x)
    gradient = autodiff.EvalTimeDerivatives(context).CopyToVector()[1].derivatives()

    def acceleration(state):
        double.SetContinuousState(state)
        return testbed.diagram.EvalTimeDerivatives(double).CopyToVector()[1]

    step = 1e-6
    numeric = [
        (acceleration([0.3 + d, 0.0 + e]) - acceleration([0.3 - d, 0.0 - e])) / (2 * step)
        for d, e in ((step, 0.0), (0.0, step))
    ]
    np.testing.assert_allclose(gradient, numeric, rtol=1e-6)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"mode": "reel"}, "one of sim, shadow, real, twin, not 'reel'"),
        ({"mode": "real"}, "nothing feeds real.sense.joint_state"),
        ({"mode": "real", "sense": "sim"}, "either the mode"),
        ({"sense": {"joints": "real"}}, "T_sense has no signal 'joints'; it has: joint_state"),
        ({"sense": "twin"}, "goes to one of sim, real, not to 'twin'"),
        ({"sense": ["joint_state"]}, r"T_sense takes one position .*, or {signal: position}, not \['joint_state'\]"),
        ({"act": {"torque": "off"}}, "goes to one of sim, real, twin, not to 'off'"),
    ],
)
def test_a_refused_switch_changes_nothing(arguments, message):
    testbed = AcrobotScenario().build()
    context = testbed.default_context()
    before = testbed.snapshot(context)
    with pytest.raises(ValueError, match=message):
        testbed.switch(context, arguments.pop("mode", None), **arguments)
    assert not testbed.snapshot(context).compare(before)


def test_switch_positions_are_part_of_the_state():
    testbed = AcrobotScenario().build()
    context = testbed.default_context()
    testbed.diagram.GetInputPort("real.sense.joint_state").FixValue(context, np.zeros(4))
    testbed.switch(context, "twin")
    other = AcrobotScenario().build()
    restored, copied = other.default_context(), other.default_context()
    other.restore(restored, testbed.snapshot(context))
    other.copier_from(testbed).copy(context, copied)
    for target in (restored, copied):
        assert other.positions(target) == {"sense": {"joint_state": "real"}, "act": {"torque": "twin"}}


def test_what_does_not_fit_is_not_switched_to():
    testbed = AcrobotScenario().build()
    context = testbed.default_context()
    testbed.diagram.GetInputPort("real.sense.joint_state").FixValue(context, [0.0, 0.0, np.nan, 0.0])
    with pytest.raises(ValueError, match="signal joint_state: entry 2 is NaN: do not feed unknown values"):
        testbed.switch(context, "real")
    assert set(testbed.positions(context)["act"].values()) == {"sim"}


SEEN = RigidTransform([1.0, 2.0, 3.0])
IDLE = RigidTransform([0.0, 0.0, 9.0])


class Pilot(LeafSystem):
    """Goes where it looks: commands the pose that it sees as an abstract signal, and its position as a vector."""

    def __init__(self):
        super().__init__()
        pose = self.DeclareAbstractInputPort("pose", Value(RigidTransform()))
        self.DeclareAbstractOutputPort("look", lambda: Value(RigidTransform()), lambda c, y: y.set_value(pose.Eval(c)))
        self.DeclareVectorOutputPort("speed", 3, lambda c, y: y.SetFromVector(pose.Eval(c).translation()))


class Silent(LeafSystem):
    """Has the Pilot's ports, but must not be asked."""

    def __init__(self):
        super().__init__()
        self.DeclareAbstractInputPort("pose", Value(RigidTransform()))
        self.DeclareAbstractOutputPort("look", lambda: Value(RigidTransform()), self._calc)
        self.DeclareVectorOutputPort("speed", 3, self._calc)

    def _calc(self, context, output):
        raise AssertionError("it was evaluated")


class Blind(LeafSystem):
    """A simulated sensor that must not be read."""

    def __init__(self):
        super().__init__()
        self.DeclareAbstractOutputPort("out", lambda: Value(RigidTransform()), self._calc)

    def _calc(self, context, output):
        raise AssertionError("it was evaluated")


def _pose_testbed(mode, *, dps=Pilot, sensor=None):
    """A testbed whose simulated and real sensor see the same pose."""
    act = [Signal("look", model_value=RigidTransform(), idle=IDLE), Signal("speed", size=3, idle=[7.0, 8.0, 9.0])]
    builder = VirtualTestbedBuilder(Interface([Signal("pose", model_value=RigidTransform())], act))
    builder.set_dps(dps())
    camera = builder.add("sense", "pose", sensor or ConstantValueSource(Value(SEEN)))
    builder.sim_sensor("pose", camera.get_output_port())
    builder.sim_actuator("look", builder.add("act", "look", PassThrough(Value(RigidTransform()))).get_input_port())
    builder.sim_actuator("speed", builder.add("act", "speed", PassThrough(3)).get_input_port())
    testbed = builder.build()
    context = testbed.default_context()
    testbed.diagram.GetInputPort("real.sense.pose").FixValue(context, SEEN)
    testbed.switch(context, mode)
    return testbed, context


def _matrix(pose):
    return pose.GetAsMatrix34().tolist()


@pytest.mark.parametrize("mode", ["sim", "shadow", "real", "twin"])
def test_the_real_ports_carry_a_command_in_real_and_twin_only(mode):
    testbed, context = _pose_testbed(mode)
    look, speed = testbed.read(context, "real.act.look"), testbed.read(context, "real.act.speed")
    assert isinstance(look, ActuatorCommand)
    if mode in ("real", "twin"):
        assert testbed.read(context, "real.act.active").tolist() == [1.0, 1.0]
        assert _matrix(look.value) == _matrix(SEEN)
        assert speed.tolist() == [1.0, 2.0, 3.0]
    else:
        assert testbed.read(context, "real.act.active").tolist() == [0.0, 0.0]
        assert look.value is None
        assert np.isnan(speed).all()


@pytest.mark.parametrize("mode", ["sim", "shadow", "real", "twin"])
def test_simulated_actuators_get_the_command_unless_real_ones_alone_do(mode):
    testbed, context = _pose_testbed(mode)
    look, speed = testbed.read(context, "sim.act.look.y"), testbed.read(context, "sim.act.speed.y")
    if mode == "real":
        assert _matrix(look) == _matrix(IDLE)
        assert speed.tolist() == [7.0, 8.0, 9.0]
    else:
        assert _matrix(look) == _matrix(SEEN)
        assert speed.tolist() == [1.0, 2.0, 3.0]


def test_idle_commands_are_set_by_the_address_of_their_signal():
    names = ["turn", "lift", "grip"]
    builder = VirtualTestbedBuilder(Interface([], [Signal(n, size=2, idle=float(i)) for i, n in enumerate(names)]))
    dps = DiagramBuilder()
    for name in names:
        dps.ExportOutput(dps.AddSystem(ConstantVectorSource([9.0, 9.0])).get_output_port(), name)
        builder.sim_actuator(name, builder.add("act", name, PassThrough(2)).get_input_port())
    builder.set_dps(dps.Build())
    testbed = builder.build()
    context = testbed.default_context()
    testbed.switch(context, "real")
    for i, name in enumerate(names):
        assert testbed.read(context, f"T_act.{name}.idle").tolist() == [i, i]
        testbed.write(context, {f"T_act.{name}.idle": [i + 0.5, -i]})
        assert testbed.read(context, f"sim.act.{name}.y").tolist() == [i + 0.5, -i]


def test_the_flags_are_those_of_each_signal():
    testbed, context = _pose_testbed("sim")
    testbed.switch(context, act={"look": "twin"})
    assert testbed.read(context, "real.act.active").tolist() == [1.0, 0.0]
    testbed.switch(context, act={"look": "sim", "speed": "twin"})
    assert testbed.read(context, "real.act.active").tolist() == [0.0, 1.0]


def test_an_abstract_sensor_that_is_not_selected_is_not_evaluated():
    testbed, context = _pose_testbed("real", sensor=Blind())
    assert _matrix(testbed.read(context, "dps.look")) == _matrix(SEEN)
    testbed.switch(context, "sim")
    with pytest.raises(AssertionError, match="it was evaluated"):
        testbed.read(context, "dps.look")


def test_an_abstract_command_that_is_not_selected_is_not_evaluated():
    testbed, context = _pose_testbed("real", dps=Silent)
    assert _matrix(testbed.read(context, "sim.act.look.y")) == _matrix(IDLE)
    testbed.switch(context, act="sim")
    assert testbed.read(context, "real.act.look") == ActuatorCommand(None)
    with pytest.raises(AssertionError, match="it was evaluated"):
        testbed.read(context, "sim.act.look.y")


def test_only_vector_commands_are_checked_before_a_continuous_world():
    act = [Signal("look", model_value=RigidTransform(), idle=IDLE), Signal("speed", size=3, idle=[7.0, 8.0, 9.0])]
    interface = Interface([Signal("pose", model_value=RigidTransform())], act)
    builder = VirtualTestbedBuilder(interface, simulator_config=SimulatorConfig(integration_scheme="runge_kutta3"))
    builder.set_dps(Pilot())
    camera = builder.add("sense", "pose", Source(SEEN))
    builder.sim_sensor("pose", camera.get_output_port())
    builder.sim_actuator("look", builder.add("act", "look", PassThrough(Value(RigidTransform()))).get_input_port())
    builder.sim_actuator("speed", builder.add("sys", "place", Integrator(3)).get_input_port())
    testbed = builder.build()
    context = testbed.default_context()
    assert _matrix(testbed.read(context, "sim.act.look.y")) == _matrix(SEEN)
    camera.show(context, RigidTransform([np.nan, 0.0, 0.0]))
    assert np.isnan(testbed.read(context, "sim.act.look.y").translation()[0])
    with pytest.raises(ValueError, match="out of domain"):
        testbed.diagram.EvalTimeDerivatives(context)
    with pytest.raises(SignalError, match=r"the DPS commands speed = \[nan +0. +0.\] at t = 0 s"):
        testbed.simulator(context).AdvanceTo(1.0)


@pytest.mark.parametrize(("address", "last"), [("T_sense.joint_state", 1.0), ("T_act.torque", 2.0)])
def test_a_position_after_the_last_is_refused(address, last):
    testbed = AcrobotScenario().build()
    context = testbed.default_context()
    testbed.diagram.GetInputPort("real.sense.joint_state").FixValue(context, np.zeros(4))
    for position in (0.0, last):
        testbed.write(context, {address: position})
        assert testbed.read(context, address) == position
    for bad in (-1.0, last + 1.0, 0.5):
        with pytest.raises(VariableError, match=address):
            testbed.write(context, {address: bad})
    assert testbed.read(context, address) == last


class PlacedScenario(AcrobotScenario):
    def add_world(self, builder):
        super().add_world(builder)
        builder.place("Acrobot", role="env")


def test_a_place_moves_the_addresses_of_a_model():
    usual, placed = AcrobotScenario().build(), PlacedScenario().build()
    of_acrobot = [address for address in usual.variables() if address.startswith("sim.sys.Acrobot.")]
    assert "sim.sys.Acrobot.shoulder.position" in of_acrobot
    assert not any(address.startswith("sim.sys.Acrobot.") for address in placed.variables())
    moved = {address.replace("sim.sys.", "sim.env.") for address in of_acrobot}
    assert moved == {address for address in placed.variables() if address.startswith("sim.env.Acrobot.")}
    context = placed.default_context()
    placed.write(context, {"sim.env.Acrobot.shoulder.position": 0.4})
    assert placed.plant.GetPositions(placed.plant.GetMyContextFromRoot(context))[0] == 0.4


@pytest.mark.parametrize(
    ("instance", "role", "message"),
    [
        ("Acrobat", "env", "the plant has no model instance Acrobat; it has: .*Acrobot"),
        ("Acrobot", "sense", "Acrobot belongs to sys or env, not to 'sense'"),
    ],
)
def test_a_place_that_is_none_is_refused(instance, role, message):
    class Misplaced(AcrobotScenario):
        def add_world(self, builder):
            super().add_world(builder)
            builder.place(instance, role=role)

    with pytest.raises(ValueError, match=message):
        Misplaced().build()


def test_finite_command_passes_every_bit_and_refuses_what_is_not_finite():
    guard = finite_command(3)
    context = guard.CreateDefaultContext()
    port = guard.get_input_port()
    for values in ([0.0, -0.0, 1.5], [-1.7e308, 5e-324, np.pi], [-np.finfo(float).max, 1e200, -1e-300]):
        port.FixValue(context, values)
        assert guard.get_output_port().Eval(context).tobytes() == np.array(values).tobytes()
    # The state that Drake asks for stays zero.
    assert (
        context.get_continuous_state_vector().CopyToVector()
        == [0.0]
        == guard.EvalTimeDerivatives(context).CopyToVector()
    )
    for bad in (np.nan, np.inf, -np.inf):
        port.FixValue(context, [1.0, 2.0, bad])
        with pytest.raises(ValueError, match="out of domain"):
            guard.get_output_port().Eval(context)


def test_finite_command_passes_derivatives():
    guard = finite_command(2).ToAutoDiffXd()
    context = guard.CreateDefaultContext()
    guard.get_input_port().FixValue(context, InitializeAutoDiff([0.0, -3.0]).ravel())
    assert np.array_equal(ExtractGradient(guard.get_output_port().Eval(context)), np.eye(2))
