"""The DPS alone and the world alone compute what they compute in their testbed."""

from __future__ import annotations

import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.math import RigidTransform
from pydrake.systems.analysis import SimulatorConfig
from pydrake.systems.primitives import ConstantValueSource, Gain

from tests.testbeds import AcrobotScenario, PendulumScenario, PoseRelay
from vtbdrake.state import Snapshot, SnapshotError
from vtbdrake.testbed import DpsAlone, Interface, Scenario, Signal, SignalError, VirtualTestbedBuilder, WorldAlone
from vtbdrake.testbed.signal import Feed
from vtbdrake_diagrams.space_climber import SpaceClimberScenario


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


def closed_loop_then_alone(scenario, start, *, until, more, period):
    """Outputs of the DPS in its testbed, and alone with the same sensor values, from ``until`` periods on."""
    testbed, alone = scenario.build(), DpsAlone(scenario)
    simulator = testbed.simulator()
    testbed.write(simulator.get_mutable_context(), start)
    simulator.AdvanceTo(until * period)
    context = alone.continue_from(testbed, simulator.get_context())
    mine = alone.simulator(context, restored=True)
    pairs = []
    for k in range(1, more + 1):
        root = mine.get_mutable_context()
        for signal in scenario.interface().sense:
            value = testbed.read(simulator.get_context(), f"T_sense.{signal.name}.value")
            alone.diagram.GetInputPort(f"real.sense.{signal.name}").FixValue(root, value)
        simulator.AdvanceTo((until + k) * period)
        mine.AdvanceTo((until + k) * period)
        for signal in scenario.interface().act:
            pairs.append(
                (
                    np.ravel(testbed.read(simulator.get_context(), f"dps.{signal.name}")),
                    alone.read(mine.get_context(), f"real.act.{signal.name}"),
                )
            )
    return pairs


@pytest.mark.parametrize(
    ("scenario", "start"),
    [(AcrobotScenario(), {"sim.sys.Acrobot.shoulder.position": 0.5}), (SpaceClimberScenario(), {"u.heading": 0.2})],
)
def test_the_commands_are_those_of_the_whole_testbed(scenario, start):
    pairs = closed_loop_then_alone(scenario, start, until=40, more=20, period=0.02)
    assert all(np.array_equal(a, b) for a, b in pairs)
    assert len({a.tobytes() for a, _ in pairs}) > 10


def test_it_has_the_boundary_of_the_testbed_and_nothing_of_its_world():
    testbed, alone = SpaceClimberScenario().build(), DpsAlone(SpaceClimberScenario())

    def ports(diagram):
        inputs = [diagram.get_input_port(i).get_name() for i in range(diagram.num_input_ports())]
        return inputs, sorted(diagram.get_output_port(i).get_name() for i in range(diagram.num_output_ports()))

    assert ports(alone.diagram) == ports(testbed.diagram)
    ours = {a for a in testbed.variables() if a.startswith(("dps.", "u.")) or a == "time"}
    assert set(alone.variables()) == ours
    assert np.array_equal(alone.read(alone.default_context(), "real.act.active"), [1.0])


@pytest.mark.parametrize(
    ("scenario", "address", "nothing", "value"),
    [
        (AcrobotScenario(), "real.sense.joint_state", [np.nan] * 4, [1.0, 2.0, 3.0, 4.0]),
        (PoseScenario(), "real.sense.seen", None, RigidTransform([1.0, 2.0, 3.0])),
    ],
)
def test_received_values_are_read_by_address(scenario, address, nothing, value):
    target = DpsAlone(scenario)
    context = target.default_context()
    before = target.read(context, address)
    assert before is None if nothing is None else np.array_equal(before, nothing, equal_nan=True)
    target.diagram.GetInputPort(address).FixValue(context, value if nothing is not None else Value(value))
    after = target.read(context, address)
    assert np.array_equal(after, value) if nothing is not None else after.IsExactlyEqualTo(value)
    assert address in target.addresses()


def test_commands_go_with_it():
    testbed, alone = PendulumScenario().build(), DpsAlone(PendulumScenario())
    context = testbed.default_context()
    testbed.write(context, {"u.angle": 0.7})
    assert alone.read(alone.continue_from(testbed, context), "u.angle") == 0.7


def in_the_middle(scenario):
    """The testbed after some steps, and its context."""
    testbed = scenario.build()
    simulator = testbed.simulator()
    testbed.write(simulator.get_mutable_context(), {"u.heading": 0.2})
    simulator.AdvanceTo(0.5)
    return testbed, simulator.get_context()


@pytest.mark.parametrize("through_itself", [False, True])
def test_a_snapshot_does_as_well_as_the_testbed(tmp_path, through_itself):
    testbed, context = in_the_middle(SpaceClimberScenario())
    alone = DpsAlone(SpaceClimberScenario())
    expected = alone.snapshot(alone.continue_from(testbed, context))
    source = expected if through_itself else testbed.snapshot(context)
    source.save(tmp_path / "s")

    restored = alone.default_context()
    assert expected.compare(alone.snapshot(restored))
    alone.restore(restored, Snapshot.load(tmp_path / "s"))
    assert not expected.compare(alone.snapshot(restored))
    assert (restored.get_time(), alone.read(restored, "u.heading")) == (0.5, 0.2)


@pytest.mark.parametrize(
    ("scenario", "difference"),
    [(SpaceClimberScenario(gravity=3.71), "gravity: 1.62 there, 3.71 here"), (PendulumScenario(), "PendulumScenario")],
)
def test_a_snapshot_of_another_scenario_is_refused(scenario, difference):
    testbed = SpaceClimberScenario(gravity=1.62).build()
    snapshot = testbed.snapshot(testbed.default_context())
    alone = DpsAlone(scenario)
    with pytest.raises(SnapshotError, match=difference):
        alone.restore(alone.default_context(), snapshot)


def test_a_snapshot_with_another_dps_is_refused():
    testbed = AcrobotScenario().build()
    whole = testbed.snapshot(testbed.default_context())
    alone = DpsAlone(AcrobotScenario())
    key = next(key for key in whole.groups if key.startswith("dps/"))
    lacking = Snapshot(whole.time, whole.values, {k: v for k, v in whole.groups.items() if k != key})
    with pytest.raises(SnapshotError, match=f"{key} has .* entries in this testbed"):
        alone.restore(alone.default_context(), lacking)
    more = Snapshot(whole.time, whole.values, {**whole.groups, "dps/discrete/7": [0.0]})
    with pytest.raises(SnapshotError, match="has a group dps/discrete/7"):
        alone.restore(alone.default_context(), more)


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


def test_what_depends_on_a_port_follows_every_new_value() -> None:
    doubled = Gain(2.0, 3)
    context = doubled.CreateDefaultContext()
    feed = Feed({"force": (Signal("force", size=3), doubled.get_input_port())}, context)
    for value in ([1.0, 2.0, 3.0], [4.0, 5.0, 6.0], [7.0, 8.0, 9.0]):
        feed("force", np.array(value))
        assert doubled.get_output_port().Eval(context).tolist() == [2.0 * entry for entry in value]


def test_value_that_was_given_is_not_changed_by_the_next() -> None:
    doubled = Gain(2.0, 1)
    feed = Feed({"force": (Signal("force", size=1), doubled.get_input_port())}, doubled.CreateDefaultContext())
    first = np.array([1.0])
    feed("force", first)
    feed("force", np.array([2.0]))
    assert first.tolist() == [1.0]


@pytest.mark.parametrize("make", [DpsAlone, WorldAlone])
def test_a_loop_sets_the_pace_of_what_runs_alone(make):
    scenario = AcrobotScenario(simulator_config=SimulatorConfig(target_realtime_rate=1.0))
    assert make(scenario).simulator().get_target_realtime_rate() == 0.0
    assert scenario.build().simulator().get_target_realtime_rate() == 1.0
