"""The pace of a loop that messages begin: rates go by elapsed time, and another pace than the period is an alarm."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from math import inf, nan
from typing import Any

import numpy as np
import pytest

from tests.control.scripted import PERIOD, ScriptedBridge, ServoScenario
from tests.control.servo_machine import COMMAND, ServoMachineScenario
from tests.control.test_loop import Ear
from vtbdrake.control.clock import SimulatedClock
from vtbdrake.control.guards import Guards
from vtbdrake.control.pace import SETTLED, WINDOW, PaceMonitor
from vtbdrake.control.received_signal import ReceivedSignal
from vtbdrake.control.runtime import Runtime
from vtbdrake.control.switching import SwitchRefusedError
from vtbdrake.deployment import Deployment
from vtbdrake.lcm.hub import Hub
from vtbdrake.machine import MachineProcess
from vtbdrake.testbed import DpsAlone

RATE = 2.0  # m/s^2, of the commanded velocity


def monitor(*times: float, tolerance: float = 0.1) -> PaceMonitor:
    """A monitor that has seen messages with these times between them, in periods."""
    found = PaceMonitor("position", PERIOD, tolerance=tolerance)
    for at in np.cumsum([7.0, *times]):
        found.note(float(at) * PERIOD)
    return found


@pytest.mark.parametrize(
    ("times", "wrong"),
    [
        ([1.0] * WINDOW, False),
        ([0.95] * WINDOW, False),  # a clock that differs by 5 %
        ([1.05] * WINDOW, False),
        ([0.5] * WINDOW, True),
        ([2.0] * WINDOW, True),
        ([0.05] * WINDOW, True),
        ([0.8] * WINDOW, True),
        ([1.25] * WINDOW, True),
        ([0.9] * 15 + [1.3] * (WINDOW - 15), False),  # a machine that loses time on a busy computer
        ([40.0] + [0.05] * SETTLED, True),  # silent at first
        ([40.0] * WINDOW, True),
        ([0.86] * SETTLED, False),  # the first one may have been late by three periods
        ([0.7] * SETTLED, True),
        ([0.1, 1.9] * WINDOW, False),  # in pairs
        ([0.1, 0.9] * WINDOW, True),  # in pairs, too quick
        ([1.0] * (WINDOW - 10) + [9.0] + [0.1] * 9, False),  # a hub that stalled
        ([0.1, 0.1, 0.1, 3.7] * WINDOW, False),  # in bursts
        ([1.0, 1.0, 2.0] * WINDOW, False),  # a quarter of the messages is lost
        ([1.0, 2.5] * WINDOW, False),  # four of seven are lost
        ([1.0, 1.0, 5.0, 8.0] * WINDOW, True),  # more than that, in pauses
        ([1.0] * 80 + [5.0] * 20, False),  # the same, not for long yet
        ([1.0] * WINDOW + [0.2] * (WINDOW // 2), False),
        ([1.0] * WINDOW + [0.2] * (WINDOW // 2 + 1), True),
        ([0.2] * WINDOW + [1.0] * WINDOW, False),
        ([nan, 1.0] * WINDOW, False),
    ],
)
def test_pace_differs_if_most_times_and_their_mean_do(times: list[float], wrong: bool) -> None:
    assert (monitor(*times).problem is not None) == wrong


def test_pace_is_unknown_at_first() -> None:
    assert "19 of 20" in str(monitor(*[0.2] * (SETTLED - 1)).unknown)
    assert monitor(*[0.2] * (SETTLED - 1)).problem is None
    assert monitor(*[0.2] * SETTLED).unknown is None
    assert "about every 0.2 ms, but the period of the DPS is 1 ms" in str(monitor(*[0.2] * SETTLED).problem)
    assert monitor(tolerance=inf).unknown is None
    assert monitor(*[0.2] * WINDOW, tolerance=inf).problem is None


# Times whose sums and products with the tolerance of an eighth have no rounding. Allowed is a difference of the sum by
# 100 / 8 + 3 = 15.5 periods.
@pytest.mark.parametrize(
    ("times", "wrong"),
    [
        ([0.875] * 51 + [0.0] * 49, False),  # shorter by the tolerance is not too short
        ([0.75] * 51 + [0.0] * 49, True),
        ([0.5] * 51 + [1.0] * 39 + [2.0] * 10, False),  # the sum is 84.5 periods
        ([0.5] * 51 + [1.0] * 39 + [2.0] * 9 + [1.75], True),
        ([1.125] * 11 + [1.5] * 89, False),  # longer by the tolerance is not too long
        ([1.0] * 10 + [1.5] * 90, True),  # nine of ten
        ([1.0] * 11 + [1.5] * 89, False),
        ([1.0] * 50 + [3.0] * 50, False),  # the mean is two periods
        ([1.0] * 50 + [3.0] * 49 + [3.25], True),
        ([1.25] * 90 + [0.5] * 6 + [0.0] * 4, False),  # the sum is 115.5 periods
        ([1.25] * 89 + [1.5] + [0.5] * 6 + [0.0] * 4, True),
    ],
)
def test_differences_that_are_just_allowed_are_not_wrong(times: list[float], wrong: bool) -> None:
    pace = PaceMonitor("position", 2.0**-10, tolerance=0.125)
    for at in np.cumsum([0.0, *times]):
        pace.note(float(at) * 2.0**-10)
    assert (pace.problem is not None) == wrong


@pytest.mark.parametrize(
    ("times", "mean"),
    [
        ([1.0] * 100 + [0.2] * 51, 0.592),  # 51 of the last 100
        ([4.0] + [1.0] * 99 + [0.2] * 100, 0.2),  # the oldest time is the first to be forgotten
        ([40.0] * 100, 4.0),  # pauses count for four periods each
    ],
)
def test_reported_pace_is_the_mean_of_the_last_hundred_times(times: list[float], mean: float) -> None:
    assert f"come about every {mean:g} ms" in str(monitor(*times).problem)


@pytest.mark.parametrize("tolerance", [0.0, -1.0, nan])
def test_tolerance_of_the_pace_must_be_positive(tolerance: float) -> None:
    with pytest.raises(ValueError, match="pace_tolerance is a positive share"):
        Guards(ServoScenario().interface(), PERIOD, pace_tolerance=tolerance)


class PacingBridge(ScriptedBridge):
    """A machine whose messages come ``interval`` seconds apart; a poll waits for the next one at most."""

    def __init__(self, clock: SimulatedClock, *, interval: float, stamped: float | None = None) -> None:
        super().__init__(ServoScenario().interface(), clock, lambda t: {"position": [0.05, 0.0], "speed": [0.0, 0.0]})
        self.interval = interval
        self.stamped = stamped  # the time between two messages by the machine's own clock
        self.due = 0.0
        self.number = 0
        self.waits = False  # for a command before it sends again
        self.blocked_until = 0.0

    @property
    def blocked_reason(self) -> str | None:
        return "another client commands" if self._clock.now() < self.blocked_until else None

    def poll(self, timeout: float = 0.0) -> int:
        now = self._clock.now()
        if self.waits and self.number > len(self.sent):
            self._clock.wait_until(now + timeout)
            return 0
        if now < self.due and not timeout:
            return 0
        self._clock.wait_until(min(max(self.due, now), now + timeout))
        if self._clock.now() < self.due:
            return 0
        self.number += 1
        self.due = self._clock.now() + self.interval
        stamp = nan if self.stamped is None else self.number * self.stamped
        for name, value in self.sensors(self._clock.now()).items():
            self.sensed[name].accept(np.asarray(value), self._clock.now(), stamp)
        return 1


def paced(
    interval: float,
    *,
    alone: bool = True,
    lock_step: bool = False,
    stamped: float | None = None,
    ageless: Collection[str] = (),
    **options: Any,
) -> tuple[Runtime, PacingBridge, SimulatedClock]:
    scenario, clock = ServoScenario(rate=RATE), SimulatedClock()
    target = DpsAlone(scenario) if alone else scenario.build()
    bridge = PacingBridge(clock, interval=interval, stamped=stamped)
    interface = scenario.interface()
    ageless = [signal.name for signal in interface.sense] if lock_step else ageless
    sense = [replace(signal, max_age=inf) if signal.name in ageless else signal for signal in interface.sense]
    interface = replace(interface, sense=sense)
    runtime = Runtime(
        target,
        bridge,
        period=PERIOD,
        clock=clock,
        pace="position",
        patience=1e6 if lock_step else 3.0,
        guards=Guards(interface, PERIOD, **options),
        continuity={"velocity": ("speed", 50.0)},
    )
    runtime.write({"u.target": [0.6, -0.4], "dps.gain": 1.0})
    return runtime, bridge, clock


def rates(bridge: ScriptedBridge) -> np.ndarray:
    """The largest rate of each step of the commands, by the clock."""
    times = np.array([time for time, _ in bridge.sent])
    commands = np.array([command["velocity"] for _, command in bridge.sent])
    return np.asarray(np.abs(np.diff(commands, axis=0)).max(axis=1) / np.diff(times))


@pytest.mark.slow_cases
@pytest.mark.parametrize("alone", [True, False])
@pytest.mark.parametrize("interval", [0.05, 0.2, 0.5, 1.0, 2.0])
def test_rate_of_commands_holds_by_the_clock_at_any_pace(interval: float, alone: bool) -> None:
    runtime, bridge, clock = paced(interval * PERIOD, alone=alone, pace_tolerance=inf)
    runtime.take_over(timeout=1.0)
    begin = clock.now()
    runtime.run(seconds=0.15)
    assert rates(bridge).max() <= RATE * (1.0 + 1e-9)
    # As quick as allowed: in 0.15 s by 0.3 m/s, or at half the pace by as much as half of the periods allow.
    reached = bridge.sent[-1][1]["velocity"][0]
    assert reached == pytest.approx(RATE * (clock.now() - begin) * min(1.0, 1.0 / interval), rel=0.03)


def test_clock_tells_the_time_if_only_the_signal_that_paces_may_grow_old() -> None:
    """Its messages have no stamps: in lock-step each would count for a period."""
    runtime, bridge, _ = paced(0.2 * PERIOD, ageless=("position",), pace_tolerance=inf)
    runtime.take_over(timeout=1.0)
    runtime.run(seconds=0.1)
    assert rates(bridge).max() <= RATE * (1.0 + 1e-9)


def test_rate_of_commands_holds_in_bursts() -> None:
    runtime, bridge, clock = paced(PERIOD, pace_tolerance=inf)
    runtime.take_over(timeout=1.0)
    random = np.random.default_rng(3)
    for _ in range(200):
        bridge.interval = PERIOD * random.choice([0.0, 1e-4, 0.01, 0.3, 0.9, 2.5])
        runtime.run(cycles=1)
    times = np.array([time for time, _ in bridge.sent])
    steps = np.abs(np.diff([command["velocity"] for _, command in bridge.sent], axis=0)).max(axis=1)
    # The limiter waits for a thousandth of a period before it counts any time.
    assert (steps <= RATE * np.minimum(np.diff(times) + 1e-3 * PERIOD, PERIOD) * (1.0 + 1e-9)).all()
    assert steps.sum() > 0.5 * RATE * np.minimum(np.diff(times), PERIOD).sum()


def test_cycles_run_by_hand_move_no_faster_than_the_clock() -> None:
    scenario, clock = ServoScenario(rate=RATE), SimulatedClock()
    bridge = ScriptedBridge(scenario.interface(), clock, lambda t: {"position": [0.05, 0.0], "speed": [0.0, 0.0]})
    runtime = Runtime(DpsAlone(scenario), bridge, period=PERIOD, clock=clock, continuity={"velocity": ("speed", 50.0)})
    runtime.write({"u.target": [0.6, -0.4]})
    runtime.cycle()
    runtime.switch("real")
    for _ in range(100):
        runtime.run(cycles=1)  # begins at once
        clock.advance(0.1 * PERIOD)
    commands = np.array([command["velocity"] for _, command in bridge.sent])
    assert np.abs(np.diff(commands, axis=0)).max() <= 0.1 * RATE * PERIOD * (1.0 + 1e-9)
    assert commands[-1, 0] == pytest.approx(RATE * PERIOD * (1.0 + 0.1 * 99))


@pytest.mark.slow_cases
@pytest.mark.parametrize("interval", [0.2, 0.5, 2.0])
@pytest.mark.parametrize("alone", [True, False])
def test_switch_is_refused_at_another_pace(interval: float, alone: bool) -> None:
    runtime, bridge, _ = paced(interval * PERIOD, alone=alone)
    with pytest.raises(SwitchRefusedError, match=f"position come about every {interval:g} ms, but the period"):
        runtime.take_over(timeout=0.5)
    assert bridge.sent == []
    assert runtime.statistics.level == "error"
    assert "came at another pace than the period" in str(runtime.statistics)


@pytest.mark.parametrize("interval", [0.95, 1.0, 1.05])
def test_clock_that_differs_by_some_per_cent_is_accepted(interval: float) -> None:
    runtime, bridge, _ = paced(interval * PERIOD)
    runtime.take_over(timeout=0.5)
    runtime.run(cycles=500)
    assert runtime.guards.latched == () and runtime.statistics.level == "ok"
    assert len(bridge.sent) == 501


@pytest.mark.parametrize("interval", [0.2, 2.0])
def test_pace_that_changes_latches_until_it_is_right_again(interval: float) -> None:
    runtime, bridge, _ = paced(PERIOD)
    runtime.take_over(timeout=0.5)
    runtime.run(cycles=100)
    bridge.interval = interval * PERIOD
    runtime.run(cycles=WINDOW)
    assert [fault.kind for fault in runtime.guards.latched] == ["pace"]
    assert runtime.statistics.level == "error"
    with pytest.raises(SwitchRefusedError, match="give the machine and the deployment the same period"):
        runtime.reset()
    bridge.interval = PERIOD
    runtime.run(cycles=WINDOW)
    runtime.reset()
    runtime.run(cycles=WINDOW)
    assert runtime.guards.latched == ()


@pytest.mark.parametrize("interval", [1e-2, 1.0, 1e3])
def test_in_lock_step_the_stamps_of_the_machine_tell_the_time(interval: float) -> None:
    runtime, bridge, _ = paced(interval * PERIOD, lock_step=True, stamped=PERIOD)
    runtime.take_over(timeout=0.5)
    runtime.run(cycles=100)
    commands = np.array([command["velocity"][0] for _, command in bridge.sent])
    assert commands == pytest.approx(RATE * PERIOD * np.arange(1.0, 102.0).clip(max=275.0))
    assert runtime.guards.latched == ()


def test_in_lock_step_another_period_of_the_machine_latches() -> None:
    runtime, bridge, _ = paced(PERIOD, lock_step=True, stamped=0.2 * PERIOD)
    runtime.take_over(timeout=0.5)
    runtime.run(cycles=SETTLED)
    commands = np.array([command["velocity"] for _, command in bridge.sent])
    assert np.abs(np.diff(commands, axis=0)).max() <= 0.2 * RATE * PERIOD * (1.0 + 1e-9)
    assert [fault.kind for fault in runtime.guards.latched] == ["pace"]


def test_in_lock_step_the_loop_leaves_with_one_command() -> None:
    runtime, bridge, clock = paced(PERIOD, lock_step=True, stamped=PERIOD)
    runtime.take_over(timeout=0.5)
    runtime.run(cycles=50)
    begin, count = clock.now(), len(bridge.sent)
    runtime.leave("the loop ended")
    assert clock.now() == begin and len(bridge.sent) == count + 1
    last = [command["velocity"] for _, command in bridge.sent[-2:]]
    assert np.abs(last[1] - last[0]).max() == pytest.approx(RATE * PERIOD)


def waiting(blocked_until: float) -> tuple[Runtime, PacingBridge, SimulatedClock]:
    """A machine in lock-step that sends nothing more before it gets a command, and is blocked until a time."""
    runtime, bridge, clock = paced(PERIOD, lock_step=True, stamped=PERIOD)
    bridge.waits, bridge.blocked_until = True, blocked_until
    return runtime, bridge, clock


def test_in_lock_step_a_reason_against_the_switch_may_end_while_the_machine_waits() -> None:
    runtime, bridge, clock = waiting(blocked_until=0.33)
    runtime.take_over(timeout=2.0)
    assert 0.33 <= clock.now() < 0.5  # Its patience would be 1,000 s.
    assert runtime.cycles == 2 and len(bridge.sent) == 1  # No cycle of the DPS without one of the machine.
    runtime.run(cycles=10)
    assert len(bridge.sent) == 11 and runtime.guards.latched == ()


def test_in_lock_step_a_take_over_keeps_its_timeout() -> None:
    runtime, bridge, clock = waiting(blocked_until=inf)
    with pytest.raises(SwitchRefusedError, match=r"after 2\.\d s: .*another client commands"):
        runtime.take_over(timeout=2.0)
    assert 2.0 <= clock.now() < 2.2 and bridge.sent == []


def test_in_lock_step_a_loop_that_waits_ends_after_its_time_or_when_it_is_stopped() -> None:
    runtime, bridge, clock = waiting(blocked_until=inf)
    runtime.run(seconds=3.0)
    assert runtime.cycles == 1 and 3.0 <= clock.now() < 3.2

    def until_stopped(timeout: float = 0.0) -> int:
        if clock.now() > 5.0:
            runtime.stop()
        return PacingBridge.poll(bridge, timeout)

    bridge.poll = until_stopped  # type: ignore[method-assign]
    runtime.run(seconds=100.0)
    assert runtime.cycles == 1 and 5.0 < clock.now() < 5.5


def test_in_lock_step_without_stamps_every_message_is_a_period() -> None:
    runtime, bridge, _ = paced(0.1 * PERIOD, lock_step=True)
    runtime.take_over(timeout=0.5)
    runtime.run(cycles=100)
    assert bridge.sent[-1][1]["velocity"][0] == pytest.approx(101 * RATE * PERIOD)


def test_pace_is_reported_while_nothing_is_on_real() -> None:
    runtime, bridge, _ = paced(0.2 * PERIOD, alone=False)
    runtime.run(cycles=WINDOW)
    assert [fault.kind for fault in runtime.guards.log] == ["pace"]
    runtime.switch("shadow")
    runtime.run(cycles=5)
    assert runtime.guards.latched == () and bridge.sent == []


def test_commands_once_per_period_are_limited_as_without_times() -> None:
    sent = []
    for at in (nan, 0.0):
        guards = Guards(ServoScenario(rate=RATE).interface(), PERIOD)
        guards.start("velocity", [0.0, 0.0])
        received = {name: ReceivedSignal(np.zeros(2), arrived=0.0, count=1) for name in ("position", "speed")}
        commands = []
        for k in range(200):
            wanted = {"velocity": np.sin(0.02 * k * np.array([1.0, 3.0]))}
            verdict = guards.judge(0.0, received, wanted, at=at + k * PERIOD)
            commands.append(verdict.actuation["velocity"])
        sent.append(commands)
    assert np.array_equal(*sent)


@pytest.mark.slow
@pytest.mark.parametrize("alone", [True, False])
def test_rate_holds_against_a_real_machine_that_is_five_times_quicker(alone: bool) -> None:
    scenario = ServoMachineScenario(rate=RATE)
    target = DpsAlone(scenario) if alone else scenario.build()
    deployment = Deployment.of(scenario, period=5.0 * PERIOD)
    with Hub(port=0, protect=[COMMAND]) as hub, MachineProcess(scenario, hub.url, period=PERIOD):
        ear = Ear(hub.url)
        values = {"u.target": [0.6, -0.4], "dps.gain": 1.0}
        with scenario.deploy(hub.url, target=target, deployment=deployment, values=values) as runtime:
            runtime.take_over()
            runtime.run(cycles=200)
        heard = len(ear.listen(lambda: len(ear.utimes) > 200)) // 2
    times = 1e-6 * np.array(ear.utimes[:heard])
    commands = np.array(ear.torques).reshape(-1, 2)[:heard]
    # Between any two commands, by their stamps. The first may be stamped late, but then the next counts for a period.
    for later in range(1, heard):
        moved = np.abs(commands[later] - commands[:later]).max(axis=1)
        assert (moved <= RATE * (times[later] - times[:later] + 5.0 * PERIOD) * (1.0 + 1e-6)).all()
    assert np.abs(commands).max() > 0.1
