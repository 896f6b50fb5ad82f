"""Guards: a fault of any kind latches in its own cycle, and what goes out keeps all limits throughout."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from math import inf, nan
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from vtbdrake.control.bridge import acts_idle
from vtbdrake.control.fallback import NO_COMMAND, Brake, Fallback, FallbackController, Hold, Sample, Silence, Zero
from vtbdrake.control.guards import GuardDecision, Guards, LoopCondition
from vtbdrake.control.received_signal import ReceivedSignal
from vtbdrake.testbed import Interface, Signal

T = 1e-3
RATE = 100.0

VELOCITY = Signal("velocity", size=2, unit="rad/s", lower=-5.0, upper=5.0, max_age=0.02)
TORQUE = Signal("torque", size=2, unit="N m", lower=-10.0, upper=10.0, rate=RATE, idle=0.0)
POSITION = Signal("position", size=1, unit="rad", lower=-1.0, upper=1.0, rate=1.0, acceleration=50.0, idle=0.0)
LAMP = Signal("lamp", model_value="off", idle="off")


@pytest.fixture(autouse=True)
def quiet(caplog: pytest.LogCaptureFixture) -> Iterator[None]:
    with caplog.at_level(logging.CRITICAL, logger="vtbdrake.control.guards"):
        yield


class Loop:
    """Cycles of guards with a sensor that is on time unless it is told to be silent."""

    def __init__(self, *act: Signal, sense: Signal = VELOCITY, start: bool = True, **options: Any) -> None:
        self.guards = Guards(Interface(sense=[sense], act=act), T, **options)
        self.received = {sense.name: ReceivedSignal(value=np.zeros(2), arrived=0.0, count=1)}
        self.now = 0.0
        self.silent = False
        if start:
            for signal in act:
                if signal.is_vector:
                    self.guards.start(signal.name, np.zeros(signal.size))

    def cycle(
        self, commands: Mapping[str, Any], active: list[str] | None = None, at: float = nan, **condition: Any
    ) -> GuardDecision:
        self.now += T
        if not self.silent:
            for signal in self.received.values():
                signal.arrived, signal.count = self.now, signal.count + 1
        return self.guards.judge(self.now, self.received, commands, active, condition=LoopCondition(**condition), at=at)

    def lose(self, commands: Mapping[str, Any]) -> GuardDecision:
        """Run a cycle whose torques do not leave."""
        verdict = self.cycle(commands)
        self.guards.note_unsent(["torque"] if "torque" in verdict.actuation else [])
        return verdict

    def reset(self) -> tuple[str, ...]:
        return self.guards.reset(self.now, self.received)


def measured_loop(max_age: float = 0.02, **options: Any) -> Loop:
    """Return a loop with a sensor "acting" of what acts on the torque."""
    loop = Loop(TORQUE, sense=Signal("acting", size=2, unit="N m", max_age=max_age), **options)
    loop.guards.measured_by = {"torque": "acting"}
    return loop


def kinds(verdict: GuardDecision) -> list[tuple[str | None, str]]:
    return [(fault.signal, fault.kind) for fault in verdict.faults]


def test_limited_commands_are_sent_without_a_fault() -> None:
    loop = Loop(TORQUE, POSITION)
    verdict = loop.cycle({"torque": [0.05, 4.0], "position": [1e-6]})
    assert verdict.ok and not verdict.faults
    assert {name: c.tolist() for name, c in verdict.actuation.items()} == {"torque": [0.05, 0.1], "position": [1e-6]}
    assert loop.guards.limiters["torque"].counts["rate"].changed == 1


FAULTS: list[tuple[dict[str, Any], dict[str, Any], tuple[str | None, str]]] = [
    ({"torque": [0.1, nan]}, {}, ("torque", "not finite")),
    ({"torque": [0.1, inf]}, {}, ("torque", "not finite")),
    ({"torque": [0.1]}, {}, ("torque", "size")),
    ({"torque": None}, {}, ("torque", "size")),
    ({}, {"active": ["torque"]}, ("torque", "missing")),
    ({}, {"error": ZeroDivisionError("at cycle 2")}, (None, "raised")),
    ({"torque": [0.1, 0.1]}, {"missed": 11}, (None, "missed")),
    ({"torque": [0.1, 0.1]}, {"blocked": "its brakes are closed"}, (None, "blocked")),
]


@pytest.mark.parametrize(("commands", "options", "expected"), FAULTS)
def test_fault_activates_fallback_in_same_cycle_and_latches(
    commands: dict[str, Any], options: dict[str, Any], expected: tuple[str | None, str]
) -> None:
    loop = Loop(TORQUE)
    for _ in range(5):
        loop.cycle({"torque": [1.0, 1.0]})
    verdict = loop.cycle(commands, **options)
    assert not verdict.ok and kinds(verdict) == [expected]
    assert verdict.actuation["torque"] == pytest.approx([0.4, 0.4])
    after = loop.cycle({"torque": [1.0, 1.0]})
    assert not after.ok and not after.faults
    assert after.actuation["torque"] == pytest.approx([0.3, 0.3])
    assert [(fault.signal, fault.kind) for fault in loop.guards.latched] == [expected]


def test_allowed_missed_deadlines_are_no_fault() -> None:
    assert Loop(TORQUE).cycle({"torque": [0.0, 0.0]}, missed=10).ok
    assert Loop(TORQUE, max_missed=0).cycle({"torque": [0.0, 0.0]}).ok
    assert kinds(Loop(TORQUE, max_missed=0).cycle({"torque": [0.0, 0.0]}, missed=1)) == [(None, "missed")]


def test_default_options_are_as_documented() -> None:
    guards = Loop(TORQUE).guards
    assert (guards.leave_time, guards.pace_tolerance, guards.log.maxlen) == (1.0, 0.1, 1000)


def test_withheld_signal_is_not_sent_and_others_are() -> None:
    loop = Loop(TORQUE, POSITION)
    loop.guards.withhold("torque")
    assert loop.cycle({"torque": [0.0, 0.0], "position": [0.0]}).actuation.keys() == {"position"}


def test_stale_sensor_is_detected_within_max_age_and_a_cycle() -> None:
    loop = Loop(TORQUE)
    loop.cycle({"torque": [0.0, 0.0]})
    last, loop.silent = loop.now, True
    while (verdict := loop.cycle({"torque": [0.0, 0.0]})).ok:
        assert loop.now < last + 1.0
    assert kinds(verdict) == [("velocity", "stale")]
    assert VELOCITY.max_age < loop.now - last <= VELOCITY.max_age + 1.001 * T


def test_implausible_sensor_is_a_fault() -> None:
    loop = Loop(TORQUE)
    loop.received["velocity"].value = np.array([0.0, 6.0])
    assert kinds(loop.cycle({"torque": [0.0, 0.0]})) == [("velocity", "implausible")]


def test_jumping_sensor_is_a_fault_if_enabled() -> None:
    sensor = Signal("velocity", size=2, rate=100.0)
    loop = Loop(TORQUE, sense=sensor, jump_tolerance={"velocity": 0.01})
    assert loop.cycle({"torque": [0.0, 0.0]}).ok
    loop.received["velocity"].value = np.array([0.0, 1.0])
    assert kinds(loop.cycle({"torque": [0.0, 0.0]})) == [("velocity", "jump")]


def test_steady_level_after_jump_is_accepted_by_reset_or_while_idle() -> None:
    for driven in (True, False):
        loop = Loop(TORQUE, sense=Signal("velocity", size=2, rate=1.0), jump_tolerance={"velocity": 0.01})
        commands = {"torque": [0.0, 0.0]} if driven else {}
        loop.cycle(commands)
        loop.received["velocity"].value = np.array([0.0, 1.0])
        found = [kinds(loop.cycle(commands)) for _ in range(200)]
        assert found[:99] == [[("velocity", "jump")]] * 99
        assert found[-1] == ([("velocity", "jump")] if driven else [])
        assert loop.reset() == ()
        assert loop.cycle({"torque": [0.0, 0.0]}).ok


def test_reset_is_refused_right_after_a_jump_and_by_a_stale_sensor_at_a_steady_level() -> None:
    loop = Loop(TORQUE, sense=Signal("velocity", size=2, rate=1.0, max_age=0.02), jump_tolerance={"velocity": 0.01})
    loop.cycle({"torque": [0.0, 0.0]})
    loop.received["velocity"].value = np.array([0.0, 1.0])
    loop.cycle({"torque": [0.0, 0.0]})
    (reason,) = loop.reset()
    assert "jump" in reason
    for _ in range(200):
        loop.cycle({"torque": [0.0, 0.0]})
    loop.silent = True
    for _ in range(40):
        loop.cycle({"torque": [0.0, 0.0]})
    (reason,) = loop.reset()
    assert "stale" in reason


def test_refused_reset_does_not_accept_level_after_jump() -> None:
    sensor = Signal("velocity", size=2, rate=1.0)
    brake = Brake("velocity", gain=0.01)
    loop = Loop(TORQUE, sense=sensor, jump_tolerance={"velocity": 0.01}, fallback={"torque": brake})
    loop.cycle({"torque": [0.0, 0.0]})
    loop.received["velocity"].value = np.array([0.0, 5.0])
    for _ in range(200):
        loop.cycle({"torque": [nan, 0.0]})
        assert loop.reset() != ()
    assert loop.guards.monitors["velocity"].value.tolist() == [0.0, 0.0]
    assert loop.guards.reset(loop.now, loop.received, ("somebody is in the cell",))[-1] == "somebody is in the cell"
    assert loop.guards.monitors["velocity"].value.tolist() == [0.0, 0.0]


def test_sensor_on_sim_is_not_monitored() -> None:
    loop = Loop(TORQUE)
    assert loop.guards.judge(5.0, {}, {"torque": [0.0, 0.0]}).ok


def test_fault_of_one_signal_activates_all_fallbacks() -> None:
    loop = Loop(TORQUE, POSITION)
    loop.cycle({"torque": [1.0, 1.0], "position": [5e-5]})
    verdict = loop.cycle({"torque": [1.0, 1.0], "position": [nan]})
    assert verdict.actuation["torque"] == pytest.approx([0.0, 0.0], abs=1e-12)
    assert verdict.actuation["position"] == pytest.approx([5e-5])


def test_limiters_ignore_commands_of_a_faulty_cycle() -> None:
    loop = Loop(TORQUE, POSITION, fallback={"torque": Hold()})
    loop.cycle({"torque": [0.1, 0.1], "position": [0.0]})
    verdict = loop.cycle({"torque": [0.2, 0.2], "position": [nan]})
    assert verdict.actuation["torque"].tolist() == [0.1, 0.1]


def test_reset_is_refused_while_cause_persists() -> None:
    loop = Loop(TORQUE)
    loop.cycle({"torque": [nan, 0.0]})
    assert loop.reset() == ("the actuator command torque is not finite: [nan, 0.0]",)
    assert not loop.cycle({"torque": [0.05, 0.0]}).ok
    assert loop.reset() == ()
    verdict = loop.cycle({"torque": [0.05, 0.0]})
    assert verdict.ok and verdict.actuation["torque"].tolist() == [0.05, 0.0]


def test_reset_checks_sensors_again() -> None:
    loop = Loop(TORQUE)
    loop.cycle({"torque": [0.0, 0.0]}, blocked="it is off")
    loop.cycle({"torque": [0.0, 0.0]})
    assert loop.guards.reset(loop.now + 1.0, loop.received) == (
        "sensor signal velocity is stale: 1000.0 ms old, 20 allowed",
    )
    assert loop.guards.latched
    assert loop.reset() == ()


def test_reset_returns_all_causes() -> None:
    loop = Loop(TORQUE)
    loop.silent = True
    loop.received["velocity"].count = 0
    loop.cycle({"torque": [0.0]}, missed=20, blocked="it is off")
    assert loop.reset() == (
        "20 deadlines were missed in a row, 10 are allowed",
        "the machine must not be commanded: it is off",
        "the actuator command torque has the shape (1,) instead of (2,)",
        "sensor signal velocity has never arrived",
    )


def test_commands_after_reset_depart_from_fallback() -> None:
    loop = Loop(TORQUE)
    for _ in range(20):
        loop.cycle({"torque": [2.0, 2.0]})
    loop.cycle({}, error=RuntimeError("once"))
    loop.cycle({"torque": [2.0, 2.0]})
    assert loop.reset() == ()
    assert loop.cycle({"torque": [2.0, 2.0]}).actuation["torque"] == pytest.approx([1.9, 1.9])


def test_reset_is_logged_once(caplog: pytest.LogCaptureFixture) -> None:
    loop = Loop(TORQUE)
    loop.cycle({"torque": [0.0, 0.0]})
    loop.cycle({}, error=RuntimeError("once"))
    with caplog.at_level(logging.WARNING, logger="vtbdrake.control.guards"):
        assert loop.reset() != ()
        assert caplog.text == ""
        loop.cycle({"torque": [0.0, 0.0]})
        assert loop.reset() == loop.reset() == ()
    assert caplog.text.count("the DPS commands again") == 1


def test_fallback_continues_while_dps_raises() -> None:
    loop = Loop(TORQUE)
    for _ in range(3):
        loop.cycle({"torque": [1.0, 1.0]})
    sent = [loop.cycle({}, error=SystemExit(1)).actuation["torque"][0] for _ in range(4)]
    assert sent == pytest.approx([0.2, 0.1, 0.0, 0.0], abs=1e-12)
    assert loop.reset() == ("the DPS raised SystemExit: 1",)


def test_faults_on_sim_are_reported_without_latching() -> None:
    loop = Loop(TORQUE)
    loop.received["velocity"].value = np.array([nan, 0.0])
    verdict = loop.cycle({})
    assert (verdict.actuation, verdict.ok) == ({}, True)
    assert kinds(verdict) == [("velocity", "implausible")]


def test_latch_outlasts_switch_to_sim() -> None:
    loop = Loop(TORQUE, leave_time=0.0)
    loop.cycle({"torque": [nan, 0.0]})
    assert loop.cycle({}).actuation == {}
    assert loop.guards.latched


@pytest.mark.parametrize("latched", [False, True])
def test_fallback_commands_a_signal_that_has_left_real(latched: bool) -> None:
    loop = Loop(TORQUE, POSITION, leave_time=0.0505)
    for k in range(20):
        loop.cycle({"torque": [RATE * T * (k + 1), 0.0], "position": [0.0]})
    if latched:
        loop.guards.latch("told", loop.now, {})
    begin, sent = loop.now, []
    for _ in range(100):
        verdict = loop.cycle({"position": [0.0]})
        assert "position" in verdict.actuation and verdict.ok != latched
        if "torque" in verdict.actuation:
            assert loop.guards.leaving == {"torque"}
            sent.append(verdict.actuation["torque"][0])
    assert begin == pytest.approx(0.02) and len(sent) == 51
    # From 2 N m to zero within the limit of the rate.
    first = 18 if latched else 19
    assert sent[:19] == pytest.approx([RATE * T * max(first - k, 0) for k in range(19)], abs=1e-12)
    assert set(sent[20:]) == {0.0}
    assert loop.guards.leaving == frozenset()
    assert not loop.guards.limiters["torque"].has_start


def test_late_cycles_bring_a_limited_command_as_far_as_punctual_ones() -> None:
    loop = Loop(TORQUE, leave_time=0.0505)
    for k in range(20):
        loop.cycle({"torque": [RATE * T * (k + 1), 0.0]}, at=loop.now + T)
    sent = []
    while True:
        loop.now += 4.0 * T
        actuation = loop.cycle({}, at=loop.now + T).actuation
        if not actuation:
            break
        sent.append(actuation["torque"][0])
    assert len(sent) == 51 and sent[17] > 0.0 and sent[20:] == [0.0] * 31


def test_released_machine_gets_no_fallback() -> None:
    loop = Loop(TORQUE)
    loop.cycle({"torque": [0.05, 0.0]})
    assert set(loop.cycle({}).actuation) == {"torque"}
    assert loop.cycle({}, released=True).actuation == {}
    assert loop.cycle({}).actuation == {}


def test_signal_back_on_real_is_not_left_to_its_fallback() -> None:
    loop = Loop(TORQUE, leave_time=1.0)
    loop.cycle({"torque": [0.05, 0.0]})
    loop.cycle({})
    loop.guards.start("torque", [0.0, 0.0])
    for _ in range(2000):
        assert loop.cycle({"torque": [0.05, 0.0]}).actuation["torque"].tolist() == [0.05, 0.0]
    assert loop.guards.leaving == frozenset()


def test_silent_fallback_leaves_a_signal_at_once() -> None:
    loop = Loop(TORQUE, fallback={"torque": Silence()})
    loop.cycle({"torque": [0.05, 0.0]})
    assert loop.cycle({}).actuation == {}


def test_limited_signal_without_start_is_not_sent() -> None:
    loop = Loop(TORQUE, start=False)
    assert loop.guards.limiters["torque"].needs_start
    verdict = loop.cycle({"torque": [0.0, 0.0]})
    assert kinds(verdict) == [("torque", "not started")] and verdict.actuation == {}
    loop.guards.start("torque", [0.0, 0.0])
    loop.cycle({"torque": [0.0, 0.0]})
    assert loop.reset() == ()
    assert loop.cycle({"torque": [0.0, 0.0]}).ok


def test_first_cycle_comes_after_no_pause() -> None:
    loop = measured_loop(start=False)
    assert kinds(loop.cycle({"torque": [0.1, 0.1]})) == [("torque", "not started")]
    assert not loop.guards.limiters["torque"].has_start


def test_signal_back_on_real_needs_new_start() -> None:
    loop = Loop(TORQUE, leave_time=0.0)
    loop.cycle({"torque": [0.0, 0.0]})
    loop.cycle({})
    assert kinds(loop.cycle({"torque": [0.0, 0.0]})) == [("torque", "not started")]


def test_start_survives_cycles_on_sim() -> None:
    loop = Loop(TORQUE)
    loop.cycle({})
    assert loop.cycle({"torque": [0.0, 0.0]}).ok


def test_brake_fades_to_zero_when_velocity_is_stale() -> None:
    loop = Loop(TORQUE, fallback={"torque": Brake("velocity", gain=0.05)})
    loop.received["velocity"].value = np.array([2.0, -2.0])
    verdict = loop.cycle({"torque": [nan, nan]})
    assert verdict.actuation["torque"] == pytest.approx([-0.1, 0.1])
    loop.silent = True
    sent = [loop.cycle({"torque": [0.0, 0.0]}).actuation["torque"][0] for _ in range(25)]
    assert sent[:18] == pytest.approx([-0.1] * 18) and sent[-1] == 0.0
    assert [fault.kind for fault in loop.guards.log] == ["not finite", "stale"]


def test_fallback_gets_last_accepted_samples_with_age() -> None:
    seen: list[tuple[Mapping[str, Any], Mapping[str, Sample]]] = []

    def look(last_sent: Any, sensed: Mapping[str, Any], known: Mapping[str, Sample], dt: float) -> Any:
        seen.append((dict(sensed), dict(known)))
        return last_sent

    loop = Loop(TORQUE, fallback={"torque": FallbackController(look, otherwise=Zero())})
    loop.received["velocity"].value = np.array([1.0, 2.0])
    loop.cycle({"torque": [0.0, 0.0]})
    loop.received["velocity"].value = np.array([9.0, 9.0])
    loop.cycle({"torque": [0.0, 0.0]})
    sensed, known = seen[-1]
    assert "velocity" not in sensed and known["velocity"].value.tolist() == [1.0, 2.0]
    assert known["velocity"].age == pytest.approx(T)
    loop.received["velocity"].value = np.array([3.0, 4.0])
    loop.cycle({"torque": [0.0, 0.0]})
    assert seen[-1][0]["velocity"].tolist() == [3.0, 4.0] and seen[-1][1]["velocity"].age == 0.0
    loop.silent = True
    for _ in range(30):
        loop.cycle({"torque": [0.0, 0.0]})
    sensed, known = seen[-1]
    assert sensed == {} and known["velocity"].value.tolist() == [3.0, 4.0]
    assert known["velocity"].age == pytest.approx(30 * T)


@pytest.mark.parametrize(("arrived", "ages"), [(-inf, {}), (0.0, {"velocity": T})])
def test_fallback_gets_no_sample_of_a_sensor_that_has_never_arrived(arrived: float, ages: dict[str, float]) -> None:
    samples: list[dict[str, Sample]] = []

    def look(last_sent: Any, sensed: Mapping[str, Any], known: Mapping[str, Sample], dt: float) -> Any:
        samples.append(dict(known))
        return last_sent

    loop = Loop(TORQUE, fallback={"torque": FallbackController(look, otherwise=Zero())})
    loop.silent = True
    loop.received["velocity"].arrived = arrived
    loop.cycle({"torque": [nan, nan]})
    assert [{name: sample.age for name, sample in known.items()} for known in samples] == [ages]


def test_fallback_gets_real_sensors_while_dps_uses_sim() -> None:
    loop = Loop(TORQUE, fallback={"torque": Brake("velocity", gain=0.05)})
    sensed = {"velocity": ReceivedSignal(value=np.array([2.0, -2.0]), arrived=T, count=1)}
    verdict = loop.guards.judge(T, {}, {"torque": [nan, nan]}, all_sensed=sensed)
    assert verdict.actuation["torque"] == pytest.approx([-0.1, 0.1])


def test_command_after_silent_fallback_departs_from_measurement() -> None:
    loop = measured_loop(fallback={"torque": Silence()})
    loop.received["acting"].value = np.array([3.0, -3.0])
    loop.cycle({"torque": [0.0, 0.0]})
    assert loop.cycle({"torque": [nan, 0.0]}).actuation == {}
    for _ in range(20):
        assert loop.cycle({"torque": [0.0, 0.0]}).actuation == {}
    assert loop.reset() == ()
    assert loop.cycle({"torque": [0.0, 0.0]}).actuation["torque"] == pytest.approx([2.9, -2.9])


# -- commands that did not leave


def test_unsent_command_does_not_count() -> None:
    loop = Loop(TORQUE, POSITION)
    for _ in range(3):
        loop.lose({"torque": [1.0, 1.0], "position": [1e-3]})
    verdict = loop.cycle({"torque": [1.0, 1.0], "position": [1e-3]})
    assert verdict.actuation["torque"] == pytest.approx([0.1, 0.1])
    assert verdict.actuation["position"].item() > 50.0 * T**2
    assert loop.cycle({"torque": [1.0, 1.0], "position": [1e-3]}).actuation["torque"] == pytest.approx([0.2, 0.2])


def test_many_unsent_commands_are_a_fault() -> None:
    loop = Loop(TORQUE)
    for _ in range(11):
        assert loop.lose({"torque": [1.0, 1.0]}).ok
    verdict = loop.cycle({"torque": [1.0, 1.0]})
    assert kinds(verdict) == [("torque", "not sent")]
    assert loop.reset() == ("the last 11 actuator commands torque could not be sent",)
    loop.cycle({"torque": [1.0, 1.0]})
    assert loop.reset() == ()


@pytest.mark.parametrize(("max_missed", "allowed"), [(inf, 10), (3, 3), (0, 0)])
def test_as_many_unsent_commands_as_missed_deadlines_are_allowed_but_never_more_than_ten(
    max_missed: float, allowed: int
) -> None:
    loop = Loop(TORQUE, max_missed=max_missed)
    for _ in range(allowed + 1):
        assert loop.lose({"torque": [1.0, 1.0]}).ok
    assert kinds(loop.cycle({"torque": [1.0, 1.0]})) == [("torque", "not sent")]


@pytest.mark.parametrize(("lost", "departs"), [(10, False), (11, True)])
def test_outage_begins_after_eleven_commands(lost: int, departs: bool) -> None:
    loop = Loop(POSITION, TORQUE, sense=Signal("acting", size=2, unit="N m", max_age=0.02), fallback={"torque": Hold()})
    loop.guards.measured_by = {"torque": "acting"}
    for _ in range(20):
        loop.cycle({"position": [0.0], "torque": [2.0, 2.0]})
    for _ in range(lost):
        loop.lose({"position": [0.0], "torque": [2.0, 2.0]})
    loop.received["acting"].value = np.array([-5.0, 1.0])
    start = [-5.0, 1.0] if departs else [2.0, 2.0]
    sent = loop.cycle({"position": [0.0], "torque": [2.0, 2.0]}).actuation["torque"]
    assert abs(sent - start).max() <= RATE * T + 1e-9


@pytest.mark.parametrize(("periods", "departs"), [(10.5, False), (11.5, True)])
def test_pause_begins_after_eleven_periods(periods: float, departs: bool) -> None:
    loop = measured_loop(max_age=0.005, fallback={"torque": Hold()})
    for _ in range(20):
        loop.cycle({"torque": [2.0, 2.0]})
    loop.now += (periods - 1.0) * T
    loop.received["acting"].value = np.array([-5.0, 1.0])
    start = [-5.0, 1.0] if departs else [2.0, 2.0]
    assert abs(loop.cycle({"torque": [2.0, 2.0]}).actuation["torque"] - start).max() <= RATE * T + 1e-9


@pytest.mark.parametrize(
    ("pause", "max_age", "departs"),
    [(11.0, 4.0, False), (12.0, 4.0, True), (12.0, 12.0, False), (13.0, 12.0, True)],
)
def test_pause_begins_beyond_eleven_periods_and_the_age_of_the_measurement(
    pause: float, max_age: float, departs: bool
) -> None:
    """Times in periods of 2^-10 s, whose sums have no rounding."""
    period = 2.0**-10
    signal = Signal("torque", size=1, lower=-10.0, upper=10.0, rate=1.0, idle=0.0)
    acting = Signal("acting", size=1, max_age=max_age * period)
    guards = Guards(Interface(sense=[acting], act=[signal]), period, fallback={"torque": Hold()})
    guards.measured_by = {"torque": "acting"}
    guards.start("torque", [0.0])
    received = {"acting": ReceivedSignal(value=np.zeros(1), arrived=0.0, count=1)}
    guards.judge(0.0, received, {"torque": [0.0]})
    received["acting"] = ReceivedSignal(value=np.array([5.0]), arrived=pause * period, count=2)
    guards.judge(pause * period, received, {"torque": [5.0]})
    assert guards.limiters["torque"].last_sent == pytest.approx([5.0 if departs else period])


def test_signal_goes_on_from_its_last_command_while_another_is_lost() -> None:
    """Even if no lost command is allowed."""
    sense = [Signal("acting", size=2), Signal("at", size=1)]
    guards = Guards(Interface(sense=sense, act=[TORQUE, POSITION]), T, max_missed=0)
    guards.measured_by = {"torque": "acting", "position": "at"}
    commands = {"torque": [0.0, 0.0], "position": [0.0]}
    for name, command in commands.items():
        guards.start(name, command)
    measured = {"acting": np.zeros(2), "at": np.array([0.5])}
    for k in range(3):
        received = {name: ReceivedSignal(value=value, arrived=k * T, count=k + 1) for name, value in measured.items()}
        verdict = guards.judge(k * T, received, commands)
        guards.note_unsent(["torque"] if k == 1 else [])
    # The torque is lost in the second cycle. In the first one, both departed from what is measured.
    assert kinds(verdict) == [("torque", "not sent")]
    assert 0.5 - 4.0 * T < verdict.actuation["position"][0] < 0.5 - 1e-4


@pytest.mark.parametrize("measures", [True, False])
def test_command_after_outage_departs_from_measurement_or_last_sent(measures: bool) -> None:
    loop = measured_loop(fallback={"torque": Hold()})
    if not measures:
        loop.guards.measured_by = {}
    for _ in range(20):
        loop.cycle({"torque": [2.0, 2.0]})
    for _ in range(50):
        loop.lose({"torque": [9.0, 9.0]})
    loop.received["acting"].value = np.array([-5.0, 1.0])
    expected = [-5.0, 1.0] if measures else [2.0, 2.0]
    assert loop.cycle({"torque": [9.0, 9.0]}).actuation["torque"] == pytest.approx(expected)


def test_nothing_is_sent_after_outage_without_fresh_measurement() -> None:
    loop = measured_loop()
    loop.cycle({"torque": [0.1, 0.1]})
    loop.silent = True
    for _ in range(40):
        loop.lose({"torque": [0.1, 0.1]})
    assert loop.cycle({"torque": [0.1, 0.1]}).actuation == {}
    loop.silent = False
    loop.received["acting"].value = np.array([4.0, 4.0])
    assert loop.cycle({"torque": [0.1, 0.1]}).actuation["torque"] == pytest.approx([3.9, 3.9])


@pytest.mark.parametrize("wanted", [[0.0, 0.0], [nan, 0.0]])
def test_commands_depart_from_measurement_until_one_leaves(wanted: list[float]) -> None:
    loop = measured_loop(fallback={"torque": Hold()}, start=False)
    loop.guards.start("torque", [1.0, 1.0])
    for measured in (2.0, 3.0, 4.0):
        loop.received["acting"].value = np.array([measured, measured])
        sent = loop.lose({"torque": wanted}).actuation["torque"]
        assert abs(sent - measured).max() <= RATE * T + 1e-12
    loop.cycle({"torque": [0.0, 0.0]})
    loop.received["acting"].value = np.array([9.0, 9.0])
    assert loop.cycle({"torque": wanted}).actuation["torque"].max() <= 4.0


def test_unsent_first_command_is_not_held() -> None:
    free = Signal("free", size=1, unit="rad", idle=0.0)
    loop = Loop(free, start=False)
    for _ in range(3):
        assert loop.cycle({"free": [0.7]}).actuation["free"].tolist() == [0.7]
        loop.guards.note_unsent(("free",))
    assert loop.cycle({"free": [nan]}).actuation == {}


@pytest.mark.parametrize("max_age", [0.02, inf])
@pytest.mark.parametrize("commands", [[9.0, 9.0], [nan, 9.0]])
def test_command_after_pause_departs_from_measurement_unless_in_lock_step(
    max_age: float, commands: list[float]
) -> None:
    loop = measured_loop(max_age, fallback={"torque": Hold()})
    for _ in range(20):
        loop.cycle({"torque": [2.0, 2.0]})
    loop.now += 0.5
    # The machine has braked by itself.
    loop.received["acting"].value = np.array([-5.0, 1.0])
    start = [-5.0, 1.0] if max_age < inf else [2.0, 2.0]
    sent = loop.cycle({"torque": commands}).actuation["torque"]
    assert abs(sent - start).max() <= RATE * T + 1e-9


def test_start_after_an_interrupted_pause_departs_from_measurement() -> None:
    """The pause ended before a command could leave: the report tells what acted when others commanded."""
    loop = measured_loop(fallback={"torque": Hold()}, leave_time=0.0)
    report = ReceivedSignal(value=np.zeros(2), arrived=0.0, count=1)
    loop.guards.reported = {"torque": report}
    for _ in range(20):
        loop.cycle({"torque": [0.0, 0.0]})
        report.arrived, report.count = loop.now, report.count + 1
    loop.now += 0.5
    loop.lose({"torque": [0.0, 0.0]})
    loop.cycle({}, active=[])
    loop.received["acting"].value, report.value = np.array([5.0, 5.0]), np.array([-5.0, -5.0])
    loop.guards.start("torque", [5.0, 5.0])
    for _ in range(2):
        report.arrived, report.count = loop.now, report.count + 1
        verdict = loop.lose({"torque": [5.0, 5.0]})
    assert abs(verdict.actuation["torque"] - 5.0).max() <= RATE * T + 1e-9


@pytest.mark.parametrize("fresh", [True, False])
def test_last_fallback_after_pause_departs_from_fresh_measurement(fresh: bool) -> None:
    loop = measured_loop(fallback={"torque": Hold()})
    for _ in range(20):
        loop.cycle({"torque": [2.0, 2.0]})
    loop.now += 0.5
    if fresh:
        loop.received["acting"] = ReceivedSignal(value=np.array([-5.0, 1.0]), arrived=loop.now, count=99)
    commands = loop.guards.latch("the time is up", loop.now, loop.received).actuation
    assert [command.tolist() for command in commands.values()] == ([[-5.0, 1.0]] if fresh else [])


def test_fallback_commands_are_limited() -> None:
    loop = Loop(POSITION, fallback={"position": FallbackController(lambda *_: [100.0], otherwise=Hold())})
    loop.cycle({"position": [nan]})
    sent = [loop.cycle({"position": [0.0]}).actuation["position"].item() for _ in range(3000)]
    assert max(np.diff(sent)) == pytest.approx(1.0 * T)
    assert max(abs(np.diff(sent, 2))) <= 50.0 * T**2 * (1 + 1e-9)
    assert sent[-1] == 1.0


def nothing(*_: Any) -> Any:
    raise LookupError("no plan")


@pytest.mark.parametrize("function", [nothing, lambda *_: [nan, 0.0], lambda *_: None, lambda *_: [1.0]])
def test_failing_fallback_is_replaced_and_logged_once(function: Any) -> None:
    loop = Loop(TORQUE, fallback={"torque": FallbackController(function, otherwise=Zero())})
    for _ in range(3):
        loop.cycle({"torque": [1.0, 1.0]})
    sent = [loop.cycle({}, error=RuntimeError("x")).actuation["torque"][0] for _ in range(2)]
    assert sent == pytest.approx([0.2, 0.1])
    assert [fault.kind for fault in loop.guards.log] == ["raised", "fallback"]


def test_last_command_is_held_if_all_fallbacks_fail() -> None:
    class Broken(Fallback):
        def command(self, last_sent: Any, sensed: Mapping[str, Any], known: Mapping[str, Sample], dt: float) -> Any:
            raise SystemExit(1)

    loop = Loop(TORQUE, fallback={"torque": Broken()})
    loop.cycle({"torque": [0.1, 0.1]})
    assert loop.cycle({"torque": [nan, nan]}).actuation["torque"].tolist() == [0.1, 0.1]


def test_fallback_gets_elapsed_time() -> None:
    spans = []

    def note(last_sent: Any, sensed: Mapping[str, Any], known: Mapping[str, Sample], dt: float) -> Any:
        spans.append(dt)
        return last_sent

    loop = Loop(TORQUE, fallback={"torque": FallbackController(note, otherwise=Hold())})
    loop.cycle({"torque": [0.0, 0.0]})
    loop.now += 0.002
    loop.cycle({"torque": [nan, nan]})
    loop.cycle({"torque": [0.0, 0.0]})
    loop.now += 0.005
    loop.cycle({"torque": [0.0, 0.0]})
    assert spans == pytest.approx([0.003, T, 0.006])


class Counting(Hold):
    """A fallback that counts how often it begins."""

    times = 0

    def begin(self) -> None:
        self.times += 1


@pytest.mark.parametrize("latched", [False, True])
def test_fallback_begins_each_time_a_signal_leaves_real(latched: bool) -> None:
    counting = Counting()
    loop = Loop(TORQUE, fallback={"torque": counting})
    loop.cycle({"torque": [0.0, 0.0]})
    if latched:
        loop.cycle({"torque": [nan, 0.0]})
    times = []
    for commands in ({}, {}, {"torque": [0.0, 0.0]}, {}):
        loop.cycle(commands)
        times.append(counting.times)
    # A latched fallback has begun, and goes on.
    assert times == ([1, 1, 1, 1] if latched else [1, 1, 1, 2])


def test_fallback_begins_once_per_latch() -> None:
    counting = Counting()
    loop = Loop(TORQUE, fallback={"torque": counting})
    told = []
    for commands in ([1.0, 1.0], [nan, 0.0], [1.0, 1.0]):
        loop.cycle({"torque": commands})
        told.append(counting.times)
    loop.reset()
    for commands in ([1.0, 1.0], [nan, 0.0]):
        loop.cycle({"torque": commands})
        told.append(counting.times)
    assert told == [0, 1, 1, 1, 2]


def test_latch_from_outside_returns_fallback_commands() -> None:
    loop = Loop(TORQUE)
    loop.cycle({"torque": [0.1, 0.1]})
    verdict = loop.guards.latch("interrupted", loop.now + T, loop.received)
    assert not verdict.ok and kinds(verdict) == [(None, "told")]
    assert verdict.actuation["torque"].tolist() == [0.0, 0.0]
    assert [str(fault) for fault in loop.guards.latched] == ["interrupted"]
    assert loop.reset() == ()


def test_log_contains_lasting_faults_once_and_is_bounded() -> None:
    loop = Loop(TORQUE, log_size=3)
    for commands in ([nan, 0.0], [nan, 1.0], [0.0, 0.0], [nan, 0.0], [0.0], [nan, 0.0]):
        loop.cycle({"torque": commands})
    assert [(round(fault.time, 6), fault.kind) for fault in loop.guards.log] == [
        (0.004, "not finite"),
        (0.005, "size"),
        (0.006, "not finite"),
    ]


def test_sensor_faults_are_those_of_now() -> None:
    loop = Loop(TORQUE)
    assert loop.guards.sensor_faults("velocity", 0.0, loop.received["velocity"]) == []
    assert loop.guards.sensor_faults("velocity", 0.0, ReceivedSignal()) == ["sensor signal velocity has never arrived"]


def test_abstract_actuator_signal_is_passed_and_held() -> None:
    loop = Loop(LAMP, fallback={"lamp": Hold()})
    assert loop.cycle({"lamp": "on"}).actuation == {"lamp": "on"}
    verdict = loop.cycle({"lamp": None})
    assert not verdict.ok and verdict.actuation == {"lamp": "on"}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"fallback": {"torqe": Zero()}}, "fallback is given for torqe, but the signals are torque"),
        ({"jump_tolerance": {"speed": 1.0}}, "jump_tolerance is given for speed, but the signals are velocity"),
        ({"max_missed": -1}, "max_missed"),
        ({"leave_time": -1.0}, "leave_time is a number of seconds"),
        ({"leave_time": nan}, "leave_time is a number of seconds"),
        ({"fallback": {"torque": Brake("speed", gain=1.0)}}, "the brake of torque"),
    ],
)
def test_options_that_do_not_fit_are_rejected(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Loop(TORQUE, **options)


def test_signal_with_unknown_unit_needs_a_fallback() -> None:
    with pytest.raises(ValueError, match="does not tell what is safe"):
        Loop(LAMP)


events = st.sampled_from(["go", "go", "go", "nan", "size", "raise", "silent", "loud", "missed", "reset", "wild"])


@given(st.lists(st.tuples(events, st.integers(1, 40)), max_size=25))
def test_sent_commands_always_keep_all_limits(script: list[tuple[str, int]]) -> None:
    loop = Loop(TORQUE, POSITION, fallback={"torque": Brake("velocity", gain=3.0)})
    loop.received["velocity"].value = np.array([1.0, -4.0])
    torque, position, speed = np.zeros(2), 0.0, 0.0
    for event, times in script:
        for _ in range(times):
            commands: dict[str, Any] = {"torque": [9.0, -9.0], "position": [0.9]}
            options: dict[str, Any] = {}
            if event == "nan":
                commands["position"] = [nan]
            elif event == "size":
                commands["torque"] = [0.0]
            elif event == "wild":
                commands = {"torque": [-1e300, 1e300], "position": [-1e9]}
            elif event == "raise":
                commands, options = {}, {"error": RuntimeError("x"), "active": ["torque", "position"]}
            elif event == "missed":
                options = {"missed": 99}
            elif event == "reset":
                loop.reset()
            loop.silent = {"silent": True, "loud": False}.get(event, loop.silent)
            sent = loop.cycle(commands, **options).actuation
            assert (abs(sent["torque"]) <= 10.0).all()
            assert (abs(sent["torque"] - torque) <= RATE * T + 1e-12).all()
            new = sent["position"].item()
            assert abs(new) <= 1.0
            assert abs(new - position) <= 1.0 * T + 1e-14
            assert abs(new - position - speed) <= 50.0 * T**2 + 1e-14
            torque, position, speed = sent["torque"], new, new - position


happenings = st.sampled_from(["go", "go", "wild", "nan", "raise", "lost", "back", "mute", "talk", "reset", "off", "on"])


@example([("lost", 1, 0.0), ("off", 20, 0.0), ("on", 4, 0.0), ("back", 1, 0.0)])
@given(st.lists(st.tuples(happenings, st.integers(1, 30), st.sampled_from([0.0, 0.0, 0.0, 0.2])), max_size=30))
def test_sent_command_is_always_one_step_from_acting_command(
    script: list[tuple[str, int, float]],
) -> None:
    """The machine moves freely once it has heard nothing for more than ten cycles."""
    mute = False
    quiet = FallbackController(lambda *_: NO_COMMAND if mute else [8.0, -8.0], otherwise=Hold())
    loop = measured_loop(fallback={"torque": quiet})
    acting, lost, on = loop.cycle({"torque": [0.0, 0.0]}).actuation["torque"], False, True
    heard = loop.now
    for event, times, pause in script:
        loop.now += pause
        mute, lost = {"mute": True, "talk": False}.get(event, mute), {"lost": True, "back": False}.get(event, lost)
        for _ in range(times):
            if loop.now - heard > 10.5 * T:
                acting = np.array([acting[1] - 1.0, -0.5 * acting[0]])
            loop.received["acting"].value = acting
            if event == "on" and not on:
                loop.guards.start("torque", acting)
            on = {"on": True, "off": False}.get(event, on)
            wanted = {"wild": [9.0, -9.0], "nan": [nan, 0.0]}.get(event, [0.3, 0.3])
            options: dict[str, Any] = {"error": RuntimeError("x")} if event == "raise" else {}
            if event == "reset":
                loop.reset()
            sent = loop.cycle({"torque": wanted} if on else {}, active=["torque"] if on else [], **options).actuation
            loop.guards.note_unsent(tuple(sent) if lost else ())
            if sent and not lost:
                assert (abs(sent["torque"] - acting) <= RATE * T + 1e-12).all()
                acting, heard = sent["torque"], loop.now


@pytest.mark.parametrize(
    ("idle", "message"),
    [
        ("0", "idle command of torque must be a number or several, not '0'"),
        ([0.0, np.nan], "idle command of torque is"),
    ],
)
def test_an_idle_command_that_no_machine_reports_is_refused(idle, message):
    with pytest.raises(ValueError, match=message):
        acts_idle({"torque": idle})
