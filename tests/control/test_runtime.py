"""The runtime's loop in lock-step with a simulated clock: what is stepped, sent, missed, refused and survived."""

import re
import signal
import threading
from dataclasses import dataclass, replace

import numpy as np
import pytest
from pydrake.systems.framework import DiagramBuilder, LeafSystem
from pydrake.systems.primitives import ConstantVectorSource, PassThrough

from tests.control.scripted import PERIOD, ScriptedBridge, Servo, ServoScenario
from vtbdrake.common.child_process import ending_signals
from vtbdrake.control.clock import SimulatedClock
from vtbdrake.control.fallback import FallbackController, Silence, Zero
from vtbdrake.control.guards import Guards
from vtbdrake.control.pace import SETTLED
from vtbdrake.control.received_signal import ReceivedSignal
from vtbdrake.control.runtime import Runtime
from vtbdrake.control.statistics import LoopStatistics
from vtbdrake.control.switching import SwitchRefusedError, checked_continuity
from vtbdrake.testbed import DpsAlone, Interface, Signal

TARGET = np.array([0.2, -0.1])


def still(t):
    return {"position": [0.05, 0.0], "speed": [0.0, 0.0]}


def make(*, alone=False, sensors=still, rate=2.0, lateness=(), **more):
    scenario = ServoScenario(rate=rate)
    target = DpsAlone(scenario) if alone else scenario.build()
    clock = SimulatedClock(lateness=lateness)
    bridge = ScriptedBridge(scenario.interface(), clock, sensors)
    runtime = Runtime(target, bridge, period=PERIOD, clock=clock, **more)
    target.write(runtime.context, {"u.target": TARGET})
    return runtime, bridge, clock


def switched(**settings):
    """A runtime on real, whose command departs from the measured speed."""
    runtime, bridge, clock = make(**{"continuity": {"velocity": ("speed", 5.0)}, **settings})
    runtime.run(cycles=SETTLED + 1) if runtime.pace else runtime.cycle()
    runtime.switch("real")
    return runtime, bridge, clock


def sent(bridge):
    return np.array([commands["velocity"] for _, commands in bridge.sent])


def test_on_sim_only_the_world_gets_commands():
    runtime, bridge, _ = make()
    runtime.run(cycles=2000)
    assert bridge.sent == []
    axes = runtime.target.read(runtime.context, "sim.sys.axes.discrete_state_0")
    assert axes == pytest.approx(TARGET, abs=1e-3)
    assert runtime.time == 2000 * PERIOD and runtime.target.read(runtime.context, "dps.ticks") == 2000.0


@pytest.mark.slow_cases
@pytest.mark.parametrize("start", [0.0, 0.5, 2501 * PERIOD, 7.7])
def test_every_cycle_contains_one_update(start):
    dps = DpsAlone(ServoScenario())
    context = dps.default_context()
    context.SetTime(start)
    clock = SimulatedClock()
    runtime = Runtime(dps, ScriptedBridge(dps.interface, clock, still), period=PERIOD, context=context, clock=clock)
    runtime.start_dps()
    ticks = []
    runtime.run(cycles=3000, until=lambda: ticks.append(dps.read(context, "dps.ticks")))
    assert set(np.diff(ticks)) == {1.0}
    assert runtime.time == pytest.approx(start + 3.0, abs=1e-12)


def test_messages_are_received_shortly_before_the_deadline():
    class Early(SimulatedClock):
        def wait_until(self, t, meanwhile=None):
            if meanwhile is not None:
                meanwhile()
            return super().wait_until(t)

    clock, dps = Early(), DpsAlone(ServoScenario())
    runtime = Runtime(dps, ScriptedBridge(dps.interface, clock, still), period=PERIOD, clock=clock)
    counts = []
    runtime.watch(lambda cycle: counts.append(runtime.bridge.sensed["position"].count))
    runtime.run(cycles=4)
    assert np.diff(counts).tolist() == [2, 2, 2]


@pytest.mark.parametrize("alone", [False, True])
def test_machine_gets_the_commands_of_the_dps(alone):
    runtime, bridge, _ = switched(alone=alone, rate=0.0)
    runtime.run(cycles=10)
    expected = 5.0 * (TARGET - [0.05, 0.0])
    assert np.array_equal(sent(bridge), np.tile(expected, (10, 1)))
    assert runtime.guards.latched == ()


def test_testbed_and_dps_alone_send_the_same():
    def moving(t):
        return {**still(t), "position": [0.1 * np.sin(30.0 * t), 0.05 * np.cos(17.0 * t)]}

    (whole, a, _), (alone, b, _) = (switched(alone=alone, sensors=moving) for alone in (False, True))
    whole.run(cycles=300)
    alone.run(cycles=300)
    assert np.array_equal(sent(a), sent(b)) and len(sent(a)) == 300


def test_shadow_mode_sends_nothing():
    runtime, bridge, _ = make()
    runtime.cycle()
    runtime.switch("shadow")
    runtime.run(cycles=50)
    assert bridge.sent == []
    assert np.array_equal(runtime.actuator_command("velocity"), 5.0 * (TARGET - [0.05, 0.0]))


def test_twin_mode_commands_the_simulated_world_too():
    runtime, bridge, _ = make(rate=0.0)
    runtime.cycle()
    before = runtime.target.read(runtime.context, "sim.sys.axes.discrete_state_0")
    runtime.switch("twin")
    runtime.run(cycles=100)
    moved = runtime.target.read(runtime.context, "sim.sys.axes.discrete_state_0") - before
    # The command of each cycle reaches the world in the next one.
    assert moved == pytest.approx(99 * PERIOD * 5.0 * (TARGET - [0.05, 0.0]), rel=0.03)
    assert len(sent(bridge)) == 100


def test_commands_keep_the_rate_limit_at_every_switch():
    runtime, bridge, _ = switched(rate=2.0)
    runtime.run(cycles=700)
    steps = np.abs(np.diff(sent(bridge), axis=0, prepend=[[0.0, 0.0]]))
    assert steps.max() <= 2.0 * PERIOD * (1 + 1e-9)
    assert sent(bridge)[-1] == pytest.approx(5.0 * (TARGET - [0.05, 0.0]))


def test_world_starts_from_belief_after_switch_to_sim():
    runtime, bridge, _ = switched()
    runtime.run(cycles=5)
    runtime.switch("sim")
    axes = runtime.target.read(runtime.context, "sim.sys.axes.discrete_state_0")
    assert np.array_equal(axes, [0.05, 0.0])


# -- leaving real


@pytest.mark.slow_cases
@pytest.mark.parametrize("pace", [None, "position"])
@pytest.mark.parametrize("way", ["sim", "shadow", {"act": "sim"}, {"sense": {"speed": "sim"}, "act": "sim"}])
def test_machine_without_time_out_is_left_at_rest(way, pace):
    """It keeps the last command; here, a velocity."""
    guards = Guards(ServoScenario(rate=2.0).interface(), PERIOD, leave_time=0.5)
    runtime, bridge, clock = switched(rate=2.0, guards=guards, pace=pace)
    runtime.run(cycles=200)
    assert np.abs(sent(bridge)[-1]).max() > 0.2
    runtime.switch(**way) if isinstance(way, dict) else runtime.switch(way)
    begin, count = clock.now(), len(bridge.sent)
    runtime.run(cycles=1000)
    times = np.array([t for t, _ in bridge.sent[count:]]) - begin
    assert times[-1] == pytest.approx(0.5, abs=2 * PERIOD) and len(times) == pytest.approx(500, abs=2)
    assert np.abs(np.diff(sent(bridge), axis=0)).max() <= 2.0 * PERIOD * (1 + 1e-9)
    assert sent(bridge)[-1].tolist() == [0.0, 0.0]
    assert runtime.guards.latched == ()


def test_fallback_ends_when_the_machine_confirms():
    brakes = []
    runtime, bridge, clock = switched(rate=0.0, released_by=lambda: bool(brakes))
    runtime.run(cycles=5)
    runtime.switch("shadow")
    runtime.run(cycles=20)
    assert len(bridge.sent) == 25
    brakes.append("engaged")
    runtime.run(cycles=20)
    assert len(bridge.sent) == 25


@pytest.mark.parametrize("released_by", [lambda: {}["brakes"], lambda: "no", lambda: None])
def test_machine_that_cannot_be_asked_is_brought_to_rest(caplog, released_by):
    guards = Guards(ServoScenario(rate=20.0).interface(), PERIOD, leave_time=0.1)
    runtime, bridge, _ = switched(rate=20.0, guards=guards, released_by=released_by)
    runtime.run(cycles=60)
    assert np.abs(sent(bridge)[-1]).min() > 0.4
    runtime.leave("the loop ended")
    assert sent(bridge)[-1].tolist() == [0.0, 0.0]
    assert [record.message[:18] for record in caplog.records if record.exc_info] == ["released_by raised"]


def test_fallback_ends_when_another_publisher_commands():
    class Contended(ScriptedBridge):
        competing_publisher = None

    scenario, clock = ServoScenario(rate=0.0), SimulatedClock()
    bridge = Contended(scenario.interface(), clock, still)
    runtime = Runtime(scenario.build(), bridge, period=PERIOD, clock=clock)
    runtime.cycle()
    runtime.switch("real")
    runtime.run(cycles=5)
    runtime.switch("shadow")
    runtime.run(cycles=5)
    bridge.competing_publisher = "somebody else commands"
    runtime.run(cycles=5)
    assert len(bridge.sent) == 10
    runtime.leave("the loop ended")
    assert len(bridge.sent) == 10


def test_signal_back_on_real_departs_from_measurement():
    runtime, bridge, _ = switched(rate=2.0)
    runtime.run(cycles=300)
    runtime.switch("sim")
    runtime.run(cycles=10)
    bridge.sensors = lambda t: {"position": [0.05, 0.0], "speed": [-0.3, 0.0]}
    runtime.run(cycles=1)
    count = len(bridge.sent)
    runtime.switch("real")
    runtime.run(cycles=800)
    steps = np.abs(np.diff(sent(bridge)[count:], axis=0, prepend=[[-0.3, 0.0]]))
    assert steps.max() <= 2.0 * PERIOD * (1 + 1e-9)
    assert sent(bridge)[-1] == pytest.approx(5.0 * (TARGET - [0.05, 0.0]))


@pytest.mark.parametrize("alone", [True, False])
@pytest.mark.parametrize("rate", [0.0, 2.0])
def test_interrupted_loop_leaves_the_machine_at_rest(rate, alone):
    guards = Guards(ServoScenario(rate=rate).interface(), PERIOD, leave_time=0.5)
    runtime, bridge, clock = switched(rate=rate, alone=alone, guards=guards)
    runtime.run(cycles=300)
    steps, count = runtime.steps, len(bridge.sent)

    def interrupt():
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        runtime.run(until=interrupt)
    begin = bridge.sent[count][0]
    times = np.array([t for t, _ in bridge.sent[count + 1 :]]) - begin
    assert times[-1] == pytest.approx(0.5, abs=2 * PERIOD) and len(times) == pytest.approx(501, abs=2)
    assert np.abs(np.diff(sent(bridge), axis=0)).max() <= (2.0 * PERIOD * (1 + 1e-9) if rate else np.inf)
    assert sent(bridge)[-1].tolist() == [0.0, 0.0]
    assert runtime.steps == steps + 1  # The DPS is not stepped any more.
    left = len(bridge.sent)
    runtime.leave("again")
    assert len(bridge.sent) == left


@pytest.mark.parametrize("presses", [{1}, {2}, {20, 21}, {1, 37}])
@pytest.mark.parametrize("ends_by_error", [False, True])
def test_ctrl_c_waits_until_the_machine_is_at_rest(ends_by_error, presses):
    guards = Guards(ServoScenario(rate=20.0).interface(), PERIOD, leave_time=0.1)
    runtime, bridge, _ = switched(rate=20.0, guards=guards)
    runtime.run(cycles=60)
    assert np.abs(sent(bridge)[-1]).min() > 0.4
    count, publish = len(bridge.sent), bridge.publish

    def pressed(actuation):
        if len(bridge.sent) - count in presses:
            signal.raise_signal(signal.SIGINT)
        return publish(actuation)

    bridge.publish = pressed
    with pytest.raises(KeyboardInterrupt):
        if ends_by_error:
            runtime.run(until=lambda: 1 / 0)
        runtime.leave("the loop ended")
    assert sent(bridge)[-1].tolist() == [0.0, 0.0] and len(bridge.sent) - count == pytest.approx(101, abs=2)


def test_ctrl_c_ends_fallbacks_that_go_on_for_longer_than_two_seconds():
    guards = Guards(ServoScenario().interface(), PERIOD, leave_time=np.inf)
    runtime, bridge, clock = switched(guards=guards)
    runtime.run(cycles=10)
    begin, publish = clock.now(), bridge.publish

    def pressed(actuation):
        if clock.now() > begin + 0.5:
            signal.raise_signal(signal.SIGINT)
        return publish(actuation)

    bridge.publish = pressed
    with pytest.raises(KeyboardInterrupt):
        runtime.leave("the loop ended")
    assert clock.now() - begin == pytest.approx(2.0, abs=3 * PERIOD)


def test_loop_without_commands_leaves_at_once(caplog):
    runtime, bridge, clock = make()
    runtime.run(cycles=5)
    begin = clock.now()
    runtime.leave("the loop ended")
    assert bridge.sent == [] and clock.now() == begin
    assert not caplog.records  # An end that was asked for is no error.


@pytest.mark.parametrize("ways", [["real"], ["twin"], ["sim", "real"]])
def test_repeated_switch_does_not_interrupt_commands(ways):
    runtime, bridge, _ = switched(rate=2.0)
    runtime.run(cycles=300)
    for way in ways:
        runtime.switch(way)
    runtime.run(cycles=100)
    assert np.abs(np.diff(sent(bridge), axis=0)).max() <= 2.0 * PERIOD * (1 + 1e-9)


def test_sensor_back_on_sim_sees_world_at_the_belief():
    runtime, _, _ = make()
    runtime.run(cycles=100)
    runtime.switch("shadow")
    runtime.run(cycles=100)
    runtime.switch(sense={"position": "sim"})
    assert np.array_equal(runtime.target.read(runtime.context, "sim.sys.axes.discrete_state_0"), [0.05, 0.0])


def test_dps_with_invalid_belief_can_be_switched_to_sim(caplog):
    runtime, bridge, _ = switched(rate=0.0)
    bridge.sensors = lambda t: {**still(t), "position": [np.nan, 0.0]}
    runtime.run(cycles=3)
    runtime.switch("sim")
    runtime.cycle()
    assert sent(bridge)[-1].tolist() == [0.0, 0.0]
    assert np.isfinite(runtime.target.read(runtime.context, "sim.sys.axes.discrete_state_0")).all()
    assert "the belief cannot be set" in caplog.text


def test_running_world_is_not_reset_by_a_switch():
    runtime, _, _ = make()
    runtime.run(cycles=100)
    runtime.switch("shadow")
    runtime.run(cycles=100)
    before = runtime.target.read(runtime.context, "sim.sys.axes.discrete_state_0")
    runtime.switch(act="sim")
    assert np.array_equal(runtime.target.read(runtime.context, "sim.sys.axes.discrete_state_0"), before)


# -- what is refused


def refusal(runtime, mode="real"):
    preparation = runtime.prepare(mode)
    positions = getattr(runtime.target, "positions", lambda context: None)(runtime.context)
    with pytest.raises(SwitchRefusedError):
        runtime.perform(preparation)
    assert getattr(runtime.target, "positions", lambda context: None)(runtime.context) == positions
    return "; ".join(preparation.reasons)


def test_switch_to_sensor_without_messages_is_refused():
    runtime, _, _ = make(sensors=lambda t: {})
    runtime.cycle()
    assert "position" in refusal(runtime, "shadow")


@pytest.mark.parametrize(("listens", "stale"), [("shadow", {"position", "speed"}), ("sim", {"speed"})])
def test_switch_to_silent_machine_is_refused(listens, stale):
    runtime, _, _ = make(sensors=lambda t: still(t) if t < 0.02 else {}, continuity={"velocity": ("speed", 5.0)})
    runtime.cycle()
    runtime.switch(listens)
    runtime.run(cycles=100)
    reasons = runtime.prepare(act="real").reasons
    assert {name for name in ("position", "speed") if f"{name} is stale" in "; ".join(reasons)} == stale


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        ({"sense": {"nose": "real"}}, "T_sense has no signal 'nose'"),
        ({"act": {"nose": "sim"}}, "T_act has no signal 'nose'"),
        ({"sense": "twin"}, "sim, real, not to 'twin'"),
        ({"act": {"velocity": "up"}}, "sim, real, twin, not to 'up'"),
        ({"mode": "real", "act": "sim"}, "not both"),
    ],
)
def test_unknown_switches_are_rejected_without_change(asked, message):
    runtime, _, _ = make(continuity={"velocity": ("speed", 5.0)})
    runtime.cycle()
    with pytest.raises(ValueError, match=message):
        runtime.prepare(**asked)


def test_unknown_side_of_a_switch_is_named():
    runtime, _, _ = make()
    with pytest.raises(TypeError, match=r"Runtime.switch\(\) got .* 'sensors'"):
        runtime.switch(sensors="real")


def test_switch_to_unconnected_or_unready_machine_is_refused():
    runtime, bridge, _ = make(rate=0.0, blocked_by=lambda: "its brakes are closed")
    runtime.cycle()
    bridge.up = False
    reasons = refusal(runtime)
    assert "the bridge is not connected" in reasons and "its brakes are closed" in reasons


@pytest.mark.parametrize("answer", [False, True, 3])
def test_machine_that_does_not_say_why_it_is_blocked_is_not_commanded(answer):
    runtime, _, _ = make(rate=0.0, blocked_by=lambda: answer)
    runtime.cycle()
    assert f"blocked_by returns the reason as a text, or None, not {answer}" in refusal(runtime)


def test_outdated_preparation_is_refused():
    runtime, _, _ = make(rate=0.0)
    runtime.cycle()
    preparation = runtime.prepare("real")
    runtime.run(cycles=2)
    with pytest.raises(SwitchRefusedError, match="2 cycles ago: prepare it again"):
        runtime.perform(preparation)
    assert runtime.active == ()


def test_discontinuous_command_is_refused():
    runtime, bridge, _ = make(continuity={"velocity": ("speed", 0.3)})
    runtime.cycle()
    runtime.switch("shadow")
    runtime.run(cycles=3)
    assert "velocity[0] is 0.75 away from speed[0]; 0.3 is allowed" in refusal(runtime)
    runtime.target.write(runtime.context, {"dps.gain": 1.0})
    runtime.run(cycles=3)
    runtime.switch("real")
    runtime.run(cycles=1)
    assert np.abs(sent(bridge)[0]).max() <= 2.0 * PERIOD * (1 + 1e-9), "it departs from what is measured"


class Broken(LeafSystem):
    """A system whose output cannot be computed."""

    def __init__(self):
        super().__init__()
        self.DeclareVectorOutputPort("y", 2, self._calc)

    def _calc(self, context, output):
        raise RuntimeError("no light")


@dataclass
class LitScenario(ServoScenario):
    """The servo with two lamps."""

    broken: bool = False

    def interface(self):
        interface = super().interface()
        return replace(interface, act=[Signal("lamp", size=2, unit="V", idle=0.0), *interface.act])

    def make_dps(self):
        dps = DiagramBuilder()
        servo = dps.AddNamedSystem("servo", Servo())
        for name in ("position", "speed", "target"):
            dps.ExportInput(servo.GetInputPort(name), name)
        dps.ExportOutput(servo.GetOutputPort("velocity"), "velocity")
        lamp = Broken() if self.broken else ConstantVectorSource([12.0, 5.0])
        dps.ExportOutput(dps.AddNamedSystem("lamp", lamp).get_output_port(), "lamp")
        return dps.Build()

    def add_world(self, builder):
        builder.sim_actuator("lamp", builder.add("act", "lamp", PassThrough(2)).get_input_port())
        axes = builder.add("sys", "axes", ConstantVectorSource([0.05, 0.0]))
        builder.sim_sensor("position", axes.get_output_port())
        builder.sim_sensor("speed", builder.add("sys", "rest", ConstantVectorSource([0.0, 0.0])).get_output_port())
        builder.sim_actuator("velocity", builder.add("act", "drives", PassThrough(2)).get_input_port())


def lit(*, sensors, continuity, broken=False):
    scenario, clock = LitScenario(broken=broken), SimulatedClock()
    testbed = scenario.build()
    bridge = ScriptedBridge(scenario.interface(), clock, sensors)
    runtime = Runtime(testbed, bridge, period=PERIOD, clock=clock, continuity=continuity)
    testbed.write(runtime.context, {"u.target": TARGET})
    runtime.cycle()
    return runtime, bridge


def test_all_signals_that_depart_from_nothing_are_named():
    runtime, _ = lit(
        sensors=lambda t: {"position": [0.05, 0.0]}, continuity={"lamp": ("speed", 1.0), "velocity": ("speed", 0.1)}
    )
    reasons = "; ".join(runtime.prepare("real").reasons)
    for name in ("lamp", "velocity"):
        assert f"the actuator command {name} departs from speed, which has never been measured" in reasons


def test_signal_after_one_that_cannot_be_computed_is_compared():
    runtime, _ = lit(sensors=still, continuity={"lamp": ("speed", 1.0), "velocity": ("speed", 0.1)}, broken=True)
    reasons = "; ".join(runtime.prepare("real").reasons)
    assert re.search("lamp cannot be computed: RuntimeError: no light.*; the actuator command velocity", reasons)


def test_difference_that_is_just_allowed_is_no_jump():
    for limit, reasons in (([12.0, 5.0], 0), ([12.0, 4.9], 1)):
        runtime, _ = lit(sensors=still, continuity={"lamp": ("speed", limit)})
        preparation = runtime.prepare(act={"lamp": "real"})
        assert len(preparation.reasons) == reasons
    assert re.search(r"lamp\[1\] is 5 away from speed\[1\]; 4.9 is allowed", preparation.reasons[0])


def test_signal_after_one_that_may_jump_is_compared():
    runtime, bridge = lit(sensors=still, continuity={"lamp": None, "velocity": ("speed", 0.1)})
    with pytest.raises(SwitchRefusedError, match="velocity.* away from speed"):
        runtime.switch("real")
    runtime.switch(act={"lamp": "real"})
    runtime.cycle()
    (command,) = bridge.sent[-1][1].items()
    assert command[0] == "lamp" and command[1].tolist() == [12.0, 5.0]


def test_largest_difference_may_differ_by_entry():
    runtime, _, _ = make(continuity={"velocity": ("speed", [10.0, 0.4])})
    runtime.cycle()
    runtime.switch("shadow")
    runtime.run(cycles=3)
    assert "velocity[1] is 0.5 away from speed[1]; 0.4 is allowed" in refusal(runtime)


def test_entry_that_exceeds_its_limit_most_is_named():
    runtime, _, _ = make(continuity={"velocity": ("speed", [0.7, 0.1])})
    runtime.cycle()
    runtime.switch("shadow")
    runtime.run(cycles=3)
    assert "velocity[1] is 0.5 away from speed[1]; 0.1 is allowed" in refusal(runtime)


def test_largest_difference_is_what_the_rate_allows_in_a_period_by_default():
    runtime, bridge, _ = make(rate=600.0, continuity={"velocity": "speed"})
    runtime.cycle()
    runtime.switch("shadow")
    runtime.run(cycles=3)
    assert "velocity[0] is 0.75 away from speed[0]; 0.6 is allowed" in refusal(runtime)
    runtime.target.write(runtime.context, {"u.target": [0.15, -0.1]})
    runtime.run(cycles=3)
    runtime.switch("real")
    runtime.run(cycles=1)
    assert sent(bridge)[0] == pytest.approx([0.5, -0.5])


def test_default_largest_difference_needs_a_limited_rate():
    with pytest.raises(ValueError, match="does not follow from its rate, which is not limited: give continuity="):
        make(rate=0.0, continuity={"velocity": "speed"})


def test_measurement_of_the_opposite_sign_is_told():
    commanded = 5.0 * (np.array(TARGET) - [0.05, 0.0])
    against = {"position": [0.05, 0.0], "speed": -commanded + [0.01, 0.0]}
    runtime, _, _ = make(sensors=lambda t: against, continuity={"velocity": ("speed", 0.1)})
    runtime.cycle()
    runtime.switch("shadow")
    runtime.run(cycles=3)
    assert "it would fit with the opposite sign, so the machine may measure with another sign" in refusal(runtime)


@pytest.mark.parametrize("rate", [0.0, 2.0])
@pytest.mark.parametrize("alone", [False, True])
def test_first_command_that_does_not_continue_is_not_sent(alone, rate):
    runtime, bridge, _ = make(alone=alone, rate=rate, continuity={"velocity": ("speed", 0.3)})
    # The DPS alone has no command before the switch; a testbed's comes to rest with its simulated axes.
    runtime.run(cycles=1 if alone else 2000)
    runtime.switch("real")
    runtime.run(cycles=3)
    assert "velocity[0] is 0.75 away from speed[0]; 0.3 is allowed" in runtime.guards.latched[0].reason
    assert bridge.sent == []
    with pytest.raises(SwitchRefusedError, match=r"velocity\[0\] is 0.75 away from speed\[0\]"):
        runtime.reset()
    runtime.write({"u.target": [0.1, -0.05]})
    runtime.run(cycles=3)
    runtime.reset()
    runtime.run(cycles=2)
    assert runtime.guards.latched == ()
    step = 2.0 * PERIOD if rate else 0.3
    assert len(bridge.sent) == 2 and np.abs(sent(bridge)[0]).max() <= step * (1.0 + 1e-9)


def test_rate_limit_without_continuity_is_refused():
    runtime, _, _ = make()
    runtime.cycle()
    assert "give continuity={'velocity'" in refusal(runtime)


# -- what is survived


@pytest.mark.parametrize(("trouble", "kind"), [(1.0, "out of ideas"), (2.0, "not finite")])
def test_failing_dps_is_replaced_in_the_same_cycle(trouble, kind):
    runtime, bridge, _ = switched(rate=0.0)
    runtime.run(cycles=5)
    runtime.target.write(runtime.context, {"dps.trouble": trouble})
    runtime.run(cycles=20)
    commands = sent(bridge)
    assert len(commands) == 25 and np.isfinite(commands).all()
    assert kind in runtime.guards.latched[0].reason
    assert commands[-1] == pytest.approx([0.0, 0.0])
    with pytest.raises(SwitchRefusedError):
        runtime.reset()
    runtime.target.write(runtime.context, {"dps.trouble": 0.0})
    runtime.run(cycles=1)
    runtime.reset()
    runtime.run(cycles=5)
    assert sent(bridge)[-1] == pytest.approx(5.0 * (TARGET - [0.05, 0.0]))


def test_silent_machine_activates_fallback_within_max_age_and_a_cycle():
    silent_from = 0.1

    def sensors(t):
        return still(t) if t < silent_from else {}

    runtime, bridge, _ = switched(sensors=sensors, rate=0.0)
    runtime.run(cycles=200)
    assert runtime.guards.latched[0].kind == "stale"
    age = runtime.target.interface.sense[0].max_age
    times = np.array([t for t, _ in bridge.sent])
    stopped = times[np.flatnonzero((np.abs(sent(bridge)) < 1e-12).all(axis=1))[0]]
    last = silent_from - PERIOD
    assert stopped <= last + age + PERIOD + 1e-9


@pytest.mark.parametrize(
    ("took", "kind", "options"),
    [
        (0.005, None, {}),
        (0.0108, "stale", {}),
        (0.03, "missed", {}),
        (0.03, "missed", {"pace": "position"}),
        (0.03, "stale", {"pace": "position", "patience": 60.0}),
    ],
)
def test_age_of_samples_is_checked_after_a_long_step(took, kind, options):
    runtime, bridge, clock = switched(rate=0.0, **options)
    runtime.run(cycles=5)
    step = runtime.step

    def slow():
        runtime.step = step
        clock.advance(took)
        return step()

    runtime.step = slow
    done = runtime.cycle()
    assert (done.verdict.faults[0].kind if done.verdict.faults else None) == kind
    assert (np.linalg.norm(sent(bridge)[-1]) > 0.0) == (kind is None)


def test_reset_with_discontinuous_command_is_refused():
    runtime, bridge, _ = switched(rate=0.0, continuity={"velocity": ("speed", 1.2)})
    runtime.run(cycles=5)
    runtime.leave("told")
    runtime.write({"u.target": [0.9, -0.1]})
    runtime.run(cycles=3)
    with pytest.raises(SwitchRefusedError, match=r"velocity\[0\] is 4.25 away from speed\[0\]; 1.2 is"):
        runtime.reset()
    assert runtime.guards.latched
    runtime.write({"u.target": TARGET})
    runtime.run(cycles=3)
    runtime.reset()
    runtime.run(cycles=1)
    assert sent(bridge)[-1] == pytest.approx(5.0 * (TARGET - [0.05, 0.0]))


def test_missed_deadlines_are_left_out():
    # The fifth waking is 3.4 periods late.
    runtime, bridge, clock = switched(rate=0.0, lateness=[0.0] * 4 + [3.4 * PERIOD])
    begin = clock.now()
    runtime.run(cycles=10)
    times = np.array([t for t, _ in bridge.sent]) - begin
    assert runtime.statistics.misses == 3 and len(times) == 10
    assert np.diff(times).min() >= 0.5 * PERIOD
    assert times[-1] == pytest.approx(12 * PERIOD)
    # The DPS's time counts the cycles that were.
    assert runtime.target.read(runtime.context, "dps.ticks") == 11.0


def test_paced_loop_steps_once_per_message():
    runtime, bridge, clock = switched(rate=0.0, pace="position")
    before = bridge.sensed["position"].count
    runtime.run(cycles=30)
    assert len(bridge.sent) == 30
    assert bridge.sensed["position"].count >= before + 30


@pytest.mark.parametrize(
    "switch", [{"mode": "shadow"}, {"sense": {"position": "real"}}, {"act": {"velocity": "real"}}, {"act": "twin"}]
)
def test_switch_without_connection_is_refused(switch):
    runtime, bridge, _ = make(continuity={"velocity": ("speed", 5.0)})
    runtime.cycle()
    bridge.up = False
    assert "the bridge is not connected" in runtime.prepare(**switch).reasons
    assert runtime.prepare("sim").reasons == ()


@pytest.mark.parametrize("switch", [{"sense": {"position": "sim"}, "act": "real"}, {"act": {"velocity": "twin"}}])
def test_dps_alone_has_no_simulated_side(switch):
    runtime, _, _ = make(alone=True, continuity={"velocity": ("speed", 5.0)})
    with pytest.raises(ValueError, match="the DPS alone has no simulated world"):
        runtime.prepare(**switch)


@pytest.mark.parametrize("lateness", [(), [7 * PERIOD] * 1000])
def test_loop_that_ends_brings_its_command_to_rest_however_late_it_is(lateness):
    guards = Guards(ServoScenario().interface(), PERIOD, max_missed=np.inf, leave_time=0.2)
    runtime, bridge, _ = switched(guards=guards, lateness=lateness)
    runtime.run(cycles=50)
    assert abs(sent(bridge)[-1]).max() > 0.05
    before = len(bridge.sent)
    runtime.leave("the test ends")
    assert len(bridge.sent) - before == 201
    assert sent(bridge)[-1].tolist() == [0.0, 0.0]


def test_blocked_machine_is_not_commanded_until_reset():
    class Contended(ScriptedBridge):
        blocked_reason = None

    scenario, clock = ServoScenario(rate=0.0), SimulatedClock()
    bridge = Contended(scenario.interface(), clock, still)
    runtime = Runtime(scenario.build(), bridge, period=PERIOD, clock=clock)
    runtime.write({"u.target": TARGET})
    runtime.cycle()
    bridge.blocked_reason = "it belongs to somebody else"
    assert "belongs to somebody else" in refusal(runtime)
    bridge.blocked_reason = None
    runtime.switch("real")
    runtime.run(cycles=2)
    bridge.blocked_reason = "it belongs to somebody else"
    runtime.run(cycles=1)
    bridge.blocked_reason = None
    runtime.run(cycles=2)
    assert (np.linalg.norm(sent(bridge), axis=1) > 0.0).tolist() == [True, True, False, False, False]
    assert runtime.guards.latched[0].kind == "blocked"


def test_publisher_that_moved_the_machine_before_the_first_command_is_named():
    class Contended(ScriptedBridge):
        competing_publisher = None

    scenario, clock = ServoScenario(rate=0.0), SimulatedClock()
    bridge = Contended(scenario.interface(), clock, still)
    continuity = {"velocity": ("speed", 0.3)}
    runtime = Runtime(DpsAlone(scenario), bridge, period=PERIOD, clock=clock, continuity=continuity)
    runtime.target.write(runtime.context, {"u.target": TARGET})
    runtime.cycle()
    runtime.switch("real")
    bridge.competing_publisher = "somebody else commands"
    runtime.cycle()
    (fault,) = runtime.guards.latched
    assert "away from speed" in fault.reason and fault.reason.endswith("; somebody else commands")


def test_second_publisher_is_an_alarm_and_blocks_only_switches(caplog):
    class Contended(ScriptedBridge):
        foreign, competing_publisher = 0, None

    scenario, clock = ServoScenario(rate=0.0), SimulatedClock()
    bridge = Contended(scenario.interface(), clock, still)
    runtime = Runtime(scenario.build(), bridge, period=PERIOD, clock=clock)
    runtime.cycle()
    bridge.foreign, bridge.competing_publisher = 3, "somebody else commands"
    runtime.run(cycles=5)
    assert refusal(runtime) == "somebody else commands"
    assert runtime.prepare("shadow").reasons == ()
    assert (runtime.statistics.foreign, "ALARM" in caplog.text) == (0, False), "there is only one"
    bridge.competing_publisher = None
    runtime.switch("real")
    runtime.run(cycles=5)
    bridge.foreign, bridge.competing_publisher = 4, "somebody else commands"
    runtime.run(cycles=5)
    assert runtime.guards.latched == () and len(bridge.sent) == 10
    assert runtime.prepare("real").reasons == ()
    assert runtime.statistics.foreign == 1
    assert "ALARM: other publishers commanded the machine, too: 1 of their commands were heard" in str(
        runtime.statistics
    )
    [record] = [record for record in caplog.records if "ALARM" in record.message]
    assert "somebody else commands (heard so far: 1)" in record.message


def test_loop_that_overslept_sends_no_dps_command():
    runtime, bridge, _ = switched(rate=0.0, lateness=[0.0] * 4 + [50.4 * PERIOD])
    runtime.run(cycles=6)
    assert (np.linalg.norm(sent(bridge), axis=1) > 0.0).tolist() == [True] * 4 + [False] * 2
    assert runtime.guards.latched[0].kind == "missed" and runtime.statistics.misses == 50


@pytest.mark.parametrize(("asleep", "pace"), [(True, None), (False, None), (False, "position")])
def test_loop_that_was_held_up_reads_all_that_has_waited(asleep, pace):
    used, waiting = [], [0.05, 0.06, 0.07, 0.08]  # One poll does not read them all.

    def fall_back(last_sent, sensed, known, dt):
        used.append(sensed["position"][0])
        return last_sent

    fallback = {"velocity": FallbackController(fall_back, otherwise=Zero())}
    guards = Guards(ServoScenario(rate=0.0).interface(), PERIOD, fallback=fallback)
    held_up = 50.4 * PERIOD
    lateness = [0.0] * 4 + [held_up] if asleep else ()
    runtime, bridge, clock = switched(rate=0.0, guards=guards, pace=pace, lateness=lateness)
    runtime.run(cycles=3)
    publish = bridge.publish

    def late(commands):
        bridge.publish = publish
        bridge.sensors = lambda t: {"position": [waiting.pop(0), 0.0], "speed": [0.0, 0.0]} if waiting else {}
        clock.advance(0.0 if asleep else held_up)
        return publish(commands)

    bridge.publish = late
    runtime.run(cycles=2)
    assert runtime.guards.latched[0].kind == "missed" and used == [0.08]


def test_received_and_written_values_are_read_by_address():
    runtime, _, _ = make(alone=True, sensors=lambda t: {"position": [0.3, 0.0], "speed": [0.0, 0.0]})
    runtime.write({"u.target": [0.1, 0.2]})
    runtime.cycle()
    assert runtime.read("real.sense.position").tolist() == [0.3, 0.0]
    assert runtime.read("u.target").tolist() == [0.1, 0.2]


@pytest.mark.parametrize("pace", [None, "position"])
def test_run_begins_with_the_newest_of_what_has_waited(pace):
    runtime, bridge, clock = switched(rate=0.0, pace=pace)
    runtime.run(cycles=3)
    waiting = [0.05, 0.06, 0.07, 0.08]  # Since the run before; one poll does not read them all.
    bridge.sensors = lambda t: {"position": [waiting.pop(0), 0.0], "speed": [0.0, 0.0]} if waiting else {}
    begin = clock.now()
    runtime.run(cycles=1)
    assert bridge.sensed["position"].value[0] == 0.08
    assert clock.now() - begin < 1.5 * PERIOD  # A paced loop has its message, and does not wait for another one.


@pytest.mark.parametrize("alive", [True, False])
@pytest.mark.parametrize("between_runs", [True, False])
def test_values_that_waited_in_a_pause_are_not_acted_on(between_runs, alive):
    class Hub(ScriptedBridge):
        """Dates back what waited; a new value comes 0.02 s after the pause, if the machine is alive."""

        paused = None

        def note_pause(self, since, signals):
            assert set(signals) == {"position", "speed"}
            self.paused, self.fresh = since, self._clock.now() + 0.02
            return True

        def poll(self, timeout=0.0):
            count = super().poll(timeout)
            if self.paused is not None and not (alive and self._clock.now() >= self.fresh):
                for received in self.sensed.values():
                    received.arrived = self.paused
            return count

    scenario, clock = ServoScenario(rate=0.0), SimulatedClock()
    bridge = Hub(scenario.interface(), clock, still)
    guards = Guards(scenario.interface(), PERIOD, max_missed=np.inf)
    runtime = Runtime(scenario.build(), bridge, period=PERIOD, clock=clock, guards=guards)
    runtime.cycle()
    runtime.switch("real")
    runtime.run(cycles=3)
    assert bridge.paused is None
    begin = clock.now()
    clock.advance(5.0)
    runtime.run(cycles=1) if between_runs else runtime.cycle()
    assert bridge.paused == pytest.approx(begin, abs=2 * PERIOD)
    assert [fault.kind for fault in guards.latched] == ([] if alive else ["stale", "stale"])
    assert clock.now() - begin < 5.0 + (0.03 if alive else 0.2)


def test_slow_loop_takes_no_period_for_a_pause():
    class Waiting(ScriptedBridge):
        def note_pause(self, since, signals):
            raise AssertionError("no pause")

    scenario, clock, period = ServoScenario(rate=0.0), SimulatedClock(), 0.1
    assert all(signal.max_age < period for signal in scenario.interface().sense)
    bridge = Waiting(scenario.interface(), clock, still)
    runtime = Runtime(DpsAlone(scenario), bridge, period=period, clock=clock)
    runtime.cycle()
    runtime.switch("real")
    runtime.run(cycles=2)
    runtime.run(cycles=2)
    assert runtime.guards.latched == () and len(bridge.sent) == 4


@pytest.mark.parametrize(("held_up", "missed"), [(2.5, 0), (8.5, 8), (50.5, 50)])
@pytest.mark.parametrize("asleep", [False, True])
def test_paced_loop_delayed_beyond_patience_has_missed_cycles(held_up, missed, asleep):
    runtime, bridge, clock = switched(rate=0.0, pace="position")
    # While it waits for a message, or while it works.
    held = "poll" if asleep else "publish"
    call, before = getattr(bridge, held), runtime.cycles

    def stopped(argument=0.0):
        if runtime.cycles == before + 4:
            clock.advance(held_up * PERIOD)
            setattr(bridge, held, call)
        return call(argument)

    setattr(bridge, held, stopped)
    runtime.run(cycles=10)
    assert bool(runtime.guards.latched) == (missed > 10)
    # Who waits for a message may do so for three periods; this one comes a period after the hold-up.
    assert runtime.statistics.misses == (max(missed - 2, 0) if asleep else missed)


def test_paced_loop_keeps_its_channels_while_it_waits():
    quiet = []
    runtime, bridge, clock = switched(
        rate=0.0,
        sensors=lambda t: {} if quiet else still(t),
        pace="position",
        patience=1000.0,
        guards=Guards(ServoScenario(rate=0.0).interface(), PERIOD, fallback={"velocity": Silence()}),
    )
    kept = []
    bridge.keep = lambda signals: kept.append((clock.now(), tuple(signals)))
    runtime.run(cycles=3)
    assert kept == []
    quiet.append(True)
    begin = clock.now()
    runtime.run(cycles=1)  # It begins by the clock, with stale samples: the fallback sends nothing.
    assert runtime.guards.latched
    assert np.diff([begin, *(at for at, _ in kept)]) == pytest.approx(0.1, abs=2 * PERIOD)
    assert len(kept) == 10 and {signals for _, signals in kept} == {("velocity",)}


@pytest.mark.parametrize("error", [OSError("disk full"), SystemExit("a failed assertion in Drake")])
def test_watcher_that_raises_is_removed(error):
    seen = []

    def broken(cycle):
        raise error

    runtime, _, _ = make(watchers=(broken, seen.append))
    runtime.run(cycles=5)
    assert [cycle.number for cycle in seen] == [0, 1, 2, 3, 4]


def test_requests_of_other_threads_run_between_cycles():
    runtime, bridge, _ = switched(rate=0.0)
    futures = []

    def ask():
        futures.append(runtime.request(lambda: runtime.target.write(runtime.context, {"u.target": [0.0, 0.0]})))
        futures.append(runtime.request(lambda: runtime.switch("nowhere")))

    thread = threading.Thread(target=ask)
    thread.start()
    thread.join()
    runtime.run(cycles=3)
    assert futures[0].result(timeout=1) is None
    with pytest.raises(ValueError, match="nowhere"):
        futures[1].result(timeout=1)
    assert sent(bridge)[-1] == pytest.approx(5.0 * np.array([-0.05, 0.0]))


def test_failed_drake_assertion_in_request_does_not_end_the_loop():
    runtime, _, _ = switched()

    def fail():
        raise SystemExit("a failed assertion in Drake")

    future = runtime.request(fail)
    runtime.run(cycles=1)
    with pytest.raises(SystemExit):
        future.result(timeout=1)


def test_cancelled_request_is_left_out():
    runtime, _, _ = switched()
    done = []
    given_up, served = (runtime.request(lambda name=name: done.append(name)) for name in ("given up", "served"))
    assert given_up.cancel()
    runtime.run(cycles=1)
    assert served.done() and done == ["served"]


def test_requests_that_no_cycle_serves_are_cancelled_when_the_runtime_is_closed():
    runtime, _, _ = switched()
    done = []
    before = runtime.request(lambda: done.append("before"))
    runtime.close()
    after = runtime.request(lambda: done.append("after"))
    assert before.cancelled() and after.cancelled() and not done


def test_first_command_after_outage_departs_from_measurement():
    machine = {**still(0.0), "speed": [0.0, 0.0]}
    runtime, bridge, _ = switched(rate=2.0, sensors=lambda t: machine)
    runtime.run(cycles=100)
    assert sent(bridge)[-1] == pytest.approx([0.2, -0.2])
    bridge.up = False
    runtime.run(cycles=300)
    assert runtime.guards.latched[0].kind == "not sent"
    machine["speed"] = [-0.6, 0.0]
    count = len(bridge.sent)
    bridge.up = True
    runtime.run(cycles=2)
    assert np.abs(sent(bridge)[count] - machine["speed"]).max() <= 2.0 * PERIOD * (1 + 1e-9)
    runtime.reset()
    runtime.run(cycles=300)
    assert np.abs(np.diff(sent(bridge)[count:], axis=0)).max() <= 2.0 * PERIOD * (1 + 1e-9)


def test_interruption_sends_the_fallback():
    runtime, bridge, _ = switched(rate=0.0)

    def interrupt():
        if runtime.cycles == 6:
            raise KeyboardInterrupt
        return False

    with pytest.raises(KeyboardInterrupt):
        runtime.run(cycles=100, until=interrupt)
    assert sent(bridge)[-1] == pytest.approx([0.0, 0.0])


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_interruption_dropped_by_pybind11_ends_the_loop(number):
    runtime, bridge, _ = switched(rate=0.0)

    def watch(cycle):
        if runtime.cycles == 6:
            try:
                signal.raise_signal(number)
            except KeyboardInterrupt:
                raise TypeError("incompatible function arguments") from None

    runtime.watch(watch)
    before = signal.signal(number, signal.SIG_DFL)  # Under nohup, SIGHUP is ignored.
    try:
        with pytest.raises(KeyboardInterrupt), ending_signals(signal.default_int_handler):
            runtime.run(cycles=100)
    finally:
        signal.signal(number, before)
    assert runtime.cycles == 6
    assert sent(bridge)[-1] == pytest.approx([0.0, 0.0])


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"period": 0.0}, "positive"),
        ({"pace": "x"}, "position"),
        *(({"patience": patience}, f"periods, not {patience}") for patience in (0.0, -1.0, np.nan, np.inf)),
        ({"continuity": {"velocty": ("speed", 1.0)}}, "not from 'velocty' to 'speed'; there are velocity and"),
        ({"continuity": {"velocity": ("sped", 1.0)}}, "not from 'velocity' to 'sped'"),
        ({"continuity": {"velocity": ("speed", np.nan)}}, "must not be negative, a number or 2 of them, unlike nan"),
        ({"continuity": {"velocity": ("speed", [1.0, -1.0])}}, r"must not be negative, .* unlike \[1.0, -1.0\]"),
        ({"continuity": {"velocity": ("speed", [1.0, 1.0, 1.0])}}, "a number or 2 of them"),
        ({"continuity": {"velocity": ("speed", 1.0, 2.0)}}, r"is \(sensor signal, largest difference\)"),
        (
            {"continuity": {"velocty": None}},
            r"continuity of velocty is \(sensor signal, largest difference\), not None",
        ),
        ({"guards": Guards(ServoScenario().interface(), 1.0)}, "made for a period of 1.0 s, not for 0.001 s"),
        ({"statistics": LoopStatistics(1.0)}, "made for a period of 1.0 s, not for 0.001 s"),
        (
            {"guards": Guards(Interface(sense=[], act=[]), PERIOD)},
            "made for the actuator signals none, but the DPS has velocity",
        ),
    ],
)
def test_invalid_settings_are_rejected(settings, message):
    scenario = ServoScenario()
    clock = SimulatedClock()
    with pytest.raises(ValueError, match=message):
        Runtime(scenario.build(), ScriptedBridge(scenario.interface(), clock, still), clock=clock, **settings)


def test_continuity_of_each_signal_is_checked_and_may_be_none_or_exact():
    act = [Signal(name, size=2, unit="m/s", idle=0.0) for name in ("free", "exact", "near")]
    interface = Interface(sense=[Signal("speed", size=2)], act=act)
    continuity = {"free": None, "exact": ("speed", 0.0), "near": ("speed", [0.1, 0.2])}
    checked = checked_continuity(interface, continuity, period=PERIOD)
    assert {name: (sensor, limit.tolist()) for name, (sensor, limit) in checked.items()} == {
        "exact": ("speed", [0.0, 0.0]),
        "near": ("speed", [0.1, 0.2]),
    }
    with pytest.raises(ValueError, match="not from 'near' to 'sped'"):
        checked_continuity(interface, {**continuity, "near": ("sped", 0.1)}, period=PERIOD)


def test_paced_loop_on_simulated_clock_is_rejected():
    class Network(ScriptedBridge):
        real_time = True

    scenario, clock = ServoScenario(), SimulatedClock()
    bridge = Network(scenario.interface(), clock, still)
    with pytest.raises(
        ValueError, match=r'SimulatedClock stands still: let the clock begin .* \(Deployment\(pace=""\)'
    ):
        Runtime(scenario.build(), bridge, clock=clock, pace="position")
    assert Runtime(scenario.build(), bridge, clock=clock).pace is None


def test_nan_as_duration_is_rejected():
    runtime, _, _ = make()
    with pytest.raises(ValueError, match="a number of seconds, not for nan"):
        runtime.run(seconds=np.nan)
    with pytest.raises(ValueError, match="not nan"):
        runtime.take_over(timeout=np.nan)
    assert runtime.cycles == 0


def test_cycle_records_changes_and_new_values():
    cycles = []
    runtime, _, _ = make(watchers=(cycles.append,), continuity={"velocity": ("speed", 5.0)})
    runtime.cycle()
    runtime.switch("real")
    runtime.write({"u.target": [0.1, 0.1]})
    runtime.cycle()
    runtime.guards.latch("told", runtime.clock.now(), {})
    runtime.reset()
    runtime.cycle()
    switch, write = cycles[1].changes
    assert switch.kind == "switch"
    assert switch.values == {"sense.position": "real", "sense.speed": "real", "act.velocity": "real"}
    assert write.kind == "write" and write.values == {"u.target": [0.1, 0.1]}
    assert [change.kind for change in cycles[2].changes] == ["reset"]
    assert cycles[0].changes == ()
    assert np.array_equal(cycles[0].fed["position"], [0.05, 0.0])


def test_every_rejected_command_raises_an_alarm(caplog):
    runtime, bridge, _ = make()
    bridge.commands["target"] = ReceivedSignal()
    runtime = Runtime(runtime.target, bridge, period=PERIOD, clock=runtime.clock)
    for reason in ("limits", "limits", "fingerprint", *(3 * ["limits"])):
        bridge.commands["target"].reject(reason)
        runtime.run(cycles=300)  # 0.3 s
    runtime.run(cycles=1000)
    told = [record.getMessage() for record in caplog.records if "the command target were rejected" in record.message]
    assert [message.partition("rejected: ")[2] for message in told] == [
        "1 limits",
        "2 limits, 1 fingerprint",
        "2 limits",
    ]
    assert all(message.startswith("ALARM: ") for message in told)
    assert [f"ALARM: {fault.reason}" for fault in runtime.guards.log if fault.kind == "command"] == told


def test_received_commands_reach_the_dps_or_are_counted():
    runtime, bridge, _ = make()
    bridge.commands["target"] = ReceivedSignal()
    runtime = Runtime(runtime.target, bridge, period=PERIOD, clock=runtime.clock)
    bridge.commands["target"].value, bridge.commands["target"].count = np.array([0.3, 0.2]), 1
    runtime.cycle()
    assert np.array_equal(runtime.target.read(runtime.context, "u.target"), [0.3, 0.2])
    bridge.commands["target"].value, bridge.commands["target"].count = np.array([np.nan, 0.2]), 2
    done = runtime.cycle()
    assert done.changes == () and bridge.commands["target"].rejected == {"refused": 1}
    assert np.array_equal(runtime.target.read(runtime.context, "u.target"), [0.3, 0.2])


class LapsingServo(ServoScenario):
    """The servo, whose target lapses after 20 ms."""

    def interface(self):
        target = Signal("target", size=2, unit="m", default=[0.05, 0.0], max_age=0.0205)
        return replace(super().interface(), commands=[target])


def test_command_that_is_not_renewed_returns_to_its_default(caplog):
    scenario, clock = LapsingServo(), SimulatedClock()
    bridge = ScriptedBridge(scenario.interface(), clock, still)
    received = bridge.commands["target"] = ReceivedSignal()
    runtime = Runtime(scenario.build(), bridge, period=PERIOD, clock=clock)
    cycles = []
    runtime.watch(cycles.append)
    runtime.write({"u.target": [0.1, 0.1]})
    runtime.run(cycles=50)  # It did not come from the bridge, and stays.
    assert np.array_equal(runtime.read("u.target"), [0.1, 0.1])
    for value in (TARGET, TARGET, [0.05, 0.0]):
        received.accept(np.array(value), clock.now(), np.nan)
        runtime.run(cycles=15)
        assert np.array_equal(runtime.read("u.target"), value)
    runtime.run(cycles=50)
    assert "returns to its default" not in caplog.text
    received.accept(TARGET, clock.now(), np.nan)
    sent_at = clock.now()
    cycles.clear()
    runtime.run(cycles=50)
    changes = [(c.now - sent_at, change.values["u.target"].tolist()) for c in cycles for change in c.changes]
    assert [values for _, values in changes] == [TARGET.tolist(), [0.05, 0.0]]
    assert [when for when, _ in changes] == pytest.approx([0.0, 0.021], abs=1e-9)
    assert caplog.text.count("no command target for 0.0205 s: it returns to its default") == 1
    received.accept(TARGET, clock.now() - 1.0, np.nan)  # It has waited somewhere.
    runtime.cycle()
    assert np.array_equal(runtime.read("u.target"), [0.05, 0.0])


@pytest.mark.parametrize("address", ["T_act.velocity", "T_sense.speed", "time"])
def test_switches_and_time_cannot_be_written(address):
    runtime, _, _ = make()
    with pytest.raises(ValueError, match="switch"):
        runtime.write({address: 1.0})
