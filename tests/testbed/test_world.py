"""The simulated world without its DPS."""

import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.math import RigidTransform
from pydrake.systems.primitives import ConstantValueSource

from tests.testbeds import AcrobotScenario, PoseRelay
from vtbdrake.testbed import Interface, Scenario, Signal, SignalError, VirtualTestbedBuilder, WorldAlone

STEP = 0.02
SCENARIO = AcrobotScenario(time_step=STEP)
ELBOW = "sim.sys.Acrobot.elbow.position"


def test_world_with_the_commands_of_the_dps_moves_as_in_the_testbed() -> None:
    testbed = SCENARIO.build()
    context = testbed.default_context()
    testbed.write(context, {ELBOW: 0.3})
    simulator = testbed.simulator(context)
    simulator.Initialize()
    commands, expected = [], []
    for k in range(1, 101):
        commands.append(testbed.read(context, "dps.torque"))
        simulator.AdvanceTo(k * STEP)
        expected.append(testbed.read(context, "plant.state"))
    assert np.ptp(commands) > 0.1

    world = WorldAlone(SCENARIO)
    own = world.default_context()
    world.write(own, {ELBOW: 0.3})
    simulator = world.simulator(own)
    simulator.Initialize()
    for k, command in enumerate(commands):
        world.actuate(own, "torque", command)
        simulator.AdvanceTo((k + 1) * STEP)
        np.testing.assert_array_equal(world.read(own, "plant.state"), expected[k])


def test_fed_commands_act_as_those_that_are_given_one_by_one() -> None:
    world = WorldAlone(SCENARIO)
    contexts = [world.default_context(), world.default_context()]
    simulators = [world.simulator(context) for context in contexts]
    feed = world.feed(contexts[1])
    for k in range(20):
        torque = np.array([np.sin(k)])
        world.actuate(contexts[0], "torque", torque)
        feed("torque", torque)
        for simulator in simulators:
            simulator.AdvanceTo((k + 1) * STEP)
        one, other = (world.read(context, "plant.state") for context in contexts)
        np.testing.assert_array_equal(one, other)
    assert np.any(one != 0.0)


def test_variables_of_the_world_have_the_addresses_of_the_testbed() -> None:
    everything = SCENARIO.build().variables()
    assert list(WorldAlone(SCENARIO).variables()) == [a for a in everything if a.startswith("sim.") or a == "time"]


def test_sensor_ports_are_those_of_the_simulated_sensors() -> None:
    world = WorldAlone(SCENARIO)
    context = world.default_context()
    simulator = world.simulator(context)
    simulator.AdvanceTo(0.5 * STEP)
    np.testing.assert_array_equal(world.read(context, "sense.joint_state"), world.read(context, "sim.sense.joints.y"))


def test_actuators_begin_with_their_idle_commands() -> None:
    class Idle(AcrobotScenario):
        def interface(self) -> Interface:
            return Interface(super().interface().sense, [Signal("torque", size=1, unit="N m", idle=3.0)])

    world = WorldAlone(Idle(time_step=STEP))
    port = world.diagram.GetInputPort("act.torque")
    np.testing.assert_array_equal(port.Eval(world.default_context()), [3.0])


class PoseScenario(Scenario):
    def interface(self) -> Interface:
        pose = RigidTransform()
        return Interface([Signal("seen", model_value=pose)], [Signal("commanded", model_value=pose, idle=pose)])

    def make_dps(self) -> PoseRelay:
        return PoseRelay()

    def add_world(self, builder: VirtualTestbedBuilder) -> None:
        relay = PoseRelay()
        builder.add("sys", "mirror", relay)
        builder.sim_actuator("commanded", relay.get_input_port())
        builder.sim_sensor("seen", relay.get_output_port())


def test_abstract_commands_can_be_fed() -> None:
    world = WorldAlone(PoseScenario())
    context = world.default_context()
    feed = world.feed(context)
    for x in (1.0, 2.0, 3.0):
        feed("commanded", RigidTransform([x, 0.0, 0.0]))
        assert world.read(context, "sense.seen").translation()[0] == -x


def test_abstract_signals_pass() -> None:
    world = WorldAlone(PoseScenario())
    context = world.default_context()
    world.actuate(context, "commanded", RigidTransform([1.0, 2.0, 3.0]))
    np.testing.assert_array_equal(world.read(context, "sense.seen").translation(), [-1.0, -2.0, -3.0])


def test_world_that_lacks_a_sensor_is_refused() -> None:
    class Blind(PoseScenario):
        def add_world(self, builder: VirtualTestbedBuilder) -> None:
            builder.add("sense", "unused", ConstantValueSource(Value(RigidTransform())))

    with pytest.raises(SignalError, match="no simulated sensor offers seen"):
        WorldAlone(Blind())


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("torque", [np.nan], "signal torque: entry 0 is NaN"),
        ("torque", np.nan, "signal torque: entry 0 is NaN"),
        ("torque", [1.0, 2.0], r"signal torque has 1 entries, not the shape \(2,\)"),
        ("torque", "much", "signal torque"),
        ("torqe", 1.0, "no actuator signal 'torqe'; it has: torque"),
    ],
)
def test_a_command_that_does_not_fit_is_refused(name, value, message):
    world = WorldAlone(AcrobotScenario())
    with pytest.raises(SignalError, match=message):
        world.actuate(world.default_context(), name, value)
