"""The state machine of a loop: our loops keep its rules, and a loop that breaks one is found."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import inf, nan
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from hypothesis.stateful import run_state_machine_as_test
from pydrake.systems.framework import System
from pydrake.systems.primitives import ConstantVectorSource

from tests.control.scripted import PERIOD, Servo, ServoScenario
from tests.control.servo_machine import ServoMachineScenario
from vtbdrake.control.clock import SimulatedClock
from vtbdrake.control.guards import GuardDecision, Guards
from vtbdrake.control.limits import Bounds, PassThrough
from vtbdrake.lcm.protocol import ProtocolError
from vtbdrake.machine import Delay, Machine
from vtbdrake.machine.injected_faults import ACT, SENSE
from vtbdrake.testbed import Interface, Scenario, Signal, VirtualTestbedBuilder, WorldAlone
from vtbdrake.testing.lock_step import MachineBridge
from vtbdrake.testing.stateful import loop_state_machine
from vtbdrake.testing.strategies import bad_samples, commands, injected_faults, samples, sensor_samples
from vtbdrake_diagrams.cart_pole import CartPoleScenario
from vtbdrake_diagrams.manipulator import ManipulatorScenario
from vtbdrake_diagrams.manipulator.motions import Motion

pytestmark = pytest.mark.one_python


@dataclass
class MovedServo(ServoMachineScenario):
    """Two axes, whose velocity departs from the measured one."""

    max_age: float = 0.0105
    leave_time: float = 0.01

    def interface(self) -> Interface:
        targets = [Signal("target", size=2, unit="m", lower=-0.4, upper=0.4)]
        return replace(super().interface(), commands=targets)


FOLLOW = {"u.motion": float(Motion.FOLLOW)}


def run(scenario: Scenario, *, examples: int = 25, **options: Any) -> None:
    machine = loop_state_machine(scenario, **options)
    run_state_machine_as_test(
        machine,
        settings=settings(
            max_examples=examples,
            stateful_step_count=30,
            derandomize=True,
            deadline=None,
            phases=[Phase.generate],
            suppress_health_check=list(HealthCheck),
        ),
    )


# -- loops that keep the rules


@pytest.mark.parametrize(
    ("alone", "examples"), [(False, 8), *(pytest.param(alone, 25, marks=pytest.mark.slow) for alone in (False, True))]
)
def test_servo_keeps_the_rules(alone: bool, examples: int) -> None:
    run(MovedServo(), alone=alone, examples=examples)


@pytest.mark.slow
def test_cart_pole_keeps_the_rules() -> None:
    run(CartPoleScenario(), examples=10)


@pytest.mark.slow
@pytest.mark.parametrize("alone", [False, True])
def test_arm_keeps_the_rules(alone: bool) -> None:
    run(ManipulatorScenario(), examples=4, alone=alone, values=FOLLOW)


@dataclass
class GuidedServo(MovedServo):
    """Two axes whose target comes from inside the testbed."""

    def add_world(self, builder: VirtualTestbedBuilder) -> None:
        super().add_world(builder)
        target = builder.add("env", "target", ConstantVectorSource([0.1, 0.0]))
        builder.command("target", target.get_output_port())


def test_commands_from_inside_are_not_written() -> None:
    run(GuidedServo(), examples=5)


# -- loops that break one

# The search ends with the first. What it tries depends on the modules that are loaded, whose constants it takes.
MANY = 300


@pytest.mark.slow
def test_loop_without_staleness_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vtbdrake.control.guards.faults_at", lambda now, monitors, received: [])
    with pytest.raises(AssertionError, match=r"the DPS commands, although \w+ is .* s old, and 0.0105 s are allowed"):
        run(MovedServo(), examples=MANY)


@pytest.mark.slow
def test_loop_that_forgets_its_faults_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    judge = Guards.judge

    def judge_anew(self: Guards, now: float, received: Any, *arguments: Any, **options: Any) -> GuardDecision:
        self.reset(now, received)
        return judge(self, now, received, *arguments, **options)

    monkeypatch.setattr(Guards, "judge", judge_anew)
    with pytest.raises(AssertionError, match="although|without a reset"):
        run(MovedServo(), examples=MANY)


@pytest.mark.slow
def test_loop_without_limits_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    class Unlimited(PassThrough):
        def __init__(self, signal: Signal, *, period: float) -> None:
            super().__init__()

    monkeypatch.setattr("vtbdrake.control.guarded_signal.RateLimiter", Unlimited)
    with pytest.raises(AssertionError, match="is not within its limits|beyond its rate|does not depart from"):
        run(MovedServo(), examples=MANY)


@pytest.mark.slow
def test_rate_that_counts_cycles_instead_of_time_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vtbdrake.control.cycle_pace.ClockPace.time_of_commands", lambda self, due, now: nan)
    with pytest.raises(AssertionError, match="beyond its rate|does not depart from"):
        run(MovedServo(), examples=MANY, alone=True)


@pytest.mark.slow
def test_command_that_outlasts_its_leave_time_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vtbdrake.control.guarded_signal.GuardedSignal.goes_on_leaving", lambda self, released: True)
    with pytest.raises(AssertionError, match="a command velocity is sent, which has not been on real for"):
        run(MovedServo(), examples=MANY)


class FragileServo(Servo):
    """A DPS that fails for some targets."""

    def _update(self, context: Any, discrete: Any) -> None:
        if self._target.Eval(context)[0] > 0.1:
            raise ZeroDivisionError("it has not been thought of")
        super()._update(context, discrete)


@dataclass
class FragileScenario(MovedServo):
    def make_dps(self) -> System:
        return FragileServo()


def test_dps_that_raises_is_found() -> None:
    with pytest.raises(AssertionError, match="the DPS raised ZeroDivisionError: it has not been thought of"):
        run(FragileScenario(), examples=MANY)


# -- the machine in lock-step


def arrivals(bridge: MachineBridge, clock: SimulatedClock, cycles: int) -> list[int]:
    """The number of messages that arrive in each cycle."""
    counts = []
    for _ in range(cycles):
        clock.advance(PERIOD)
        counts.append(bridge.poll())
    return counts


def test_dead_machine_and_cut_connection_are_silent() -> None:
    scenario, clock = MovedServo(), SimulatedClock()
    bridge = MachineBridge(Machine(scenario), clock)
    command = {"velocity": np.array([0.5, 0.0])}
    assert arrivals(bridge, clock, 2) == [2, 1]  # cycle 0, too
    bridge.cut = True
    assert (arrivals(bridge, clock, 2), bridge.connected, bridge.publish(command)) == ([0, 0], False, ("velocity",))
    bridge.cut = False
    assert (arrivals(bridge, clock, 2), bridge.publish(command)) == ([1, 1], ())
    arrivals(bridge, clock, 5)
    moved = bridge.sensed["position"].value[0]
    assert moved > 0.0
    bridge.dead = True
    assert (arrivals(bridge, clock, 2), bridge.publish(command)) == ([0, 0], ())
    bridge.restart(Machine(scenario, epoch=round(1e6 * clock.now())))
    assert arrivals(bridge, clock, 2) == [2, 1]
    # It is where it started, and its messages are taken for new ones.
    assert bridge.sensed["position"].value[0] == 0.0


# -- strategies

WORLD = WorldAlone(MovedServo())
INTERFACE = Interface(
    sense=[
        Signal("q", size=2, unit="rad", lower=[-1.0, -inf], upper=[inf, 3.0]),
        Signal("frame", model_value="a picture"),
    ],
    act=[Signal("tau", size=1, unit="N m", idle=0.0)],
    commands=[Signal("target", size=2, lower=-1.0, upper=1.0), Signal("mode", size=1, lower=0.0, upper=3.0)],
)


@given(sensor_samples(INTERFACE))
def test_samples_are_plausible(values: dict[str, Any]) -> None:
    for signal in INTERFACE.sense:
        assert Bounds(signal).violation(values[signal.name]) == ""


@given(st.sampled_from(INTERFACE.sense).flatmap(lambda s: st.tuples(st.just(s), bad_samples(s))))
def test_bad_samples_are_not(case: tuple[Signal, Any]) -> None:
    signal, value = case
    assert Bounds(signal).violation(value) != ""


@pytest.mark.slow_cases
@pytest.mark.parametrize("reason", ["not finite", "limits", "size", "type"])
def test_every_kind_of_bad_sample_occurs(reason: str) -> None:
    from hypothesis import find

    signal = INTERFACE.sense[0]
    find(bad_samples(signal), lambda value: Bounds(signal).violation(value) == reason)


@given(commands(replace(INTERFACE)), samples(INTERFACE.act[0]))
def test_commands_are_within_their_limits(values: dict[str, Any], torque: Any) -> None:
    assert set(values) <= {"u.target", "u.mode"}
    assert np.all(np.abs(values.get("u.target", 0.0)) <= 1.0) and 0.0 <= values.get("u.mode", 0.0) <= 3.0
    assert torque.shape == (1,)


@given(st.data())
def test_injected_faults_are_of_the_protocol(data: st.DataObject) -> None:
    protocol = MovedServo().deployment().protocol
    assert protocol is not None
    fault = data.draw(injected_faults(protocol, period=PERIOD, late=5))
    channels = {SENSE: {"IIWA_STATUS"}, ACT: {"IIWA_COMMAND"}}[fault.side]
    assert set(fault.channels) <= channels
    assert not isinstance(fault, Delay) or fault.seconds in [k * PERIOD for k in range(6)]
    Machine(MovedServo(), world=WORLD).begin(fault)


def test_dps_without_protocol_has_no_machine() -> None:
    with pytest.raises(ProtocolError, match="ServoScenario has no protocol for its machine"):
        loop_state_machine(ServoScenario(rate=0.0))
