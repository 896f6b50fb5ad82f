"""The whole loop with real processes: hub, machine, bridge and runtime, and all that can go wrong between them.

Nothing here depends on how fast this computer is: what has to be exact runs in lock-step with the machine, and what has
to happen some time is waited for.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from math import inf
from pathlib import Path
from typing import Any

import lcm
import numpy as np
import pytest
from drake import lcmt_iiwa_command
from pydrake.systems.framework import Context, System

from tests.machine.robot import COMMAND, PERIOD, RobotScenario, Swing, torque
from vtbdrake.control.guards import Guards
from vtbdrake.control.runtime import Runtime
from vtbdrake.control.switching import SwitchRefusedError
from vtbdrake.lcm.hub import Hub
from vtbdrake.lcm.lcm_bridge import LcmBridge
from vtbdrake.lcm.protocol import protocol_of
from vtbdrake.machine import ClockJump, Corrupt, Delay, Duplicate, Freeze, InjectedFault, MachineProcess, Reorder
from vtbdrake.state import Quantity
from vtbdrake.testbed import DpsAlone, Interface, Signal, VirtualTestbed

ROOT = Path(__file__).resolve().parents[2]
LIMIT = 10.0  # N m
SHORT, LONG = 0.03, 30.0  # s, maximum ages: one that any fault exceeds, and one that none does
PATIENCE = 60.0  # s for whatever has to happen


class TroubledSwing(Swing):
    """A `Swing` that raises, or commands NaN, when it is told to; it has the ports of `Swing`."""

    def __init__(self, period: float) -> None:
        super().__init__(period)
        self._faults = self.declare_parameters(trouble=Quantity(bounds=(0.0, 2.0)))

    def _update(self, context: Context, discrete: Any) -> None:
        trouble = self._faults.view(context).trouble
        if trouble == 1.0:
            raise RuntimeError("out of ideas")
        super()._update(context, discrete)
        if trouble == 2.0:
            discrete.set_value(0, [np.nan])


@dataclass
class LoopScenario(RobotScenario):
    """The acrobot, whose sensor signals grow old."""

    max_age: float = LONG

    def interface(self) -> Interface:
        return Interface(
            sense=[
                Signal("position", size=2, unit="rad", lower=-100.0, upper=100.0, max_age=self.max_age),
                Signal("velocity", size=2, unit="rad/s", max_age=self.max_age),
            ],
            act=[Signal("torque", size=1, unit="N m", lower=-LIMIT, upper=LIMIT, idle=0.0)],
        )

    def make_dps(self) -> System:
        return TroubledSwing(PERIOD)


class Ear:
    """A listener on the bus of its own: what was commanded, whoever did it."""

    def __init__(self, url: str) -> None:
        self._lcm = lcm.LCM(url)
        self.torques: list[float] = []
        self.utimes: list[int] = []
        self._marks = 0
        self._lcm.subscribe(COMMAND, self._hear).set_queue_capacity(0)
        self._lcm.subscribe("MARK", self._mark)
        self.listen()

    def _hear(self, channel: str, data: bytes) -> None:
        message = lcmt_iiwa_command.decode(data)
        self.torques += message.joint_torque
        self.utimes.append(message.utime)

    def _mark(self, channel: str, data: bytes) -> None:
        self._marks += 1

    def listen(self, until: Callable[[], bool] | None = None) -> list[float]:
        """Takes in what has been said up to now, or until enough has."""
        marks = self._marks
        self._lcm.publish("MARK", b"")
        while self._marks == marks or not (until is None or until()):
            assert self._lcm.handle_timeout(round(1e3 * PATIENCE)), "nothing is heard any more"
        return self.torques


class Loop:
    """Hub, machine, and a runtime that steps a target in this process."""

    def __init__(
        self,
        hub: Hub,
        *,
        max_age: float = LONG,
        alone: bool = True,
        lock_step: bool = False,
        machine: MachineProcess | None = None,
    ) -> None:
        self.scenario = LoopScenario(max_age=max_age)
        self.hub = hub
        self.machine = machine or MachineProcess(self.scenario, hub.url, lock_step=lock_step)
        target: DpsAlone | VirtualTestbed = DpsAlone(self.scenario) if alone else self.scenario.build()
        self.bridge: LcmBridge = protocol_of(self.scenario).bridge(self.scenario.interface(), hub.url)
        self.runtime = Runtime(
            target,
            self.bridge,
            # A machine on a busy computer does not keep the pace.
            guards=Guards(self.scenario.interface(), PERIOD, max_missed=inf, pace_tolerance=inf),
            pace="position",
            # In lock-step nothing but the machine's next message begins a cycle.
            patience=PATIENCE / PERIOD if lock_step else 3.0,
        )

    def __enter__(self) -> Loop:
        self.machine.start()
        self.bridge.open()
        self.ear = Ear(self.hub.url)
        return self

    def __exit__(self, *_: object) -> None:
        self.bridge.close()
        self.machine.close()

    @property
    def latched(self) -> str:
        """Why the fallbacks command; empty if they do not."""
        return "; ".join(fault.reason for fault in self.runtime.guards.latched)

    def until(self, condition: Callable[[], bool]) -> None:
        """Cycles until the condition is fulfilled."""
        self.runtime.run(until=condition, seconds=PATIENCE)
        assert condition()

    def sense(self) -> None:
        """Waits until every sensor signal has arrived."""
        for _ in range(round(PATIENCE)):
            if all(received.count for received in self.bridge.sensed.values()):
                return
            self.bridge.poll(1.0)

    def begin(self) -> None:
        """Switches to real, and cycles until the machine follows the DPS's commands."""
        self.sense()
        self.until(lambda: not self.runtime.prepare("real").reasons)
        self.runtime.switch("real")
        self.runtime.cycle()
        self.recover()

    def recover(self) -> None:
        """Resets the guards as soon as they can be, until the DPS commands for some cycles."""
        good = 0

        def commanding() -> bool:
            nonlocal good
            if self.latched:
                with suppress(SwitchRefusedError):
                    self.runtime.reset()
            good = 0 if self.latched else good + 1
            return good >= 20

        self.until(commanding)

    def assert_within_limits(self) -> None:
        """All that was commanded until now."""
        heard = np.array(self.ear.listen())
        assert heard.size
        assert (np.abs(heard) <= LIMIT).all()


@pytest.fixture(scope="module")
def hub() -> Iterator[Hub]:
    with Hub(port=0, protect=[COMMAND]) as running:
        yield running


def commands_in_lock_step(hub: Hub, *faults: InjectedFault, cycles: int = 100) -> tuple[list[float], LcmBridge]:
    with Loop(hub, lock_step=True) as loop:
        loop.machine.begin(*faults)
        loop.sense()
        loop.runtime.switch("real")
        loop.runtime.cycle()
        loop.runtime.run(cycles=cycles - 1)
        assert not loop.latched
        loop.ear.listen(lambda: len(loop.ear.torques) >= cycles)
        return loop.ear.torques, loop.bridge


# -- nothing is wrong


@pytest.mark.slow
def test_testbed_and_dps_alone_send_the_same_bytes(hub: Hub) -> None:
    commanded, _ = commands_in_lock_step(hub)
    with Loop(hub, lock_step=True, alone=False) as loop:
        loop.sense()
        loop.runtime.switch("real")
        loop.runtime.cycle()
        loop.runtime.run(cycles=99)
        loop.ear.listen(lambda: len(loop.ear.torques) >= 100)
        assert loop.ear.torques == commanded
    assert np.ptp(commanded) > 0.1


def test_nothing_is_sent_while_actuator_is_on_sim(hub: Hub) -> None:
    with Loop(hub, alone=False) as loop:
        loop.sense()
        loop.runtime.run(cycles=100)
        loop.runtime.switch("shadow")
        loop.runtime.run(cycles=100)
        assert loop.ear.listen() == []
        assert loop.machine.status().accepted == {"torque": 0}
        # Whoever hears nothing hears what comes afterwards, and nothing but that.
        loop.until(lambda: not loop.runtime.prepare("real").reasons)
        loop.runtime.switch("real")
        loop.runtime.run(cycles=30)
        sent = loop.bridge.sent["torque"].count
        loop.ear.listen(lambda: len(loop.ear.torques) >= sent)
        assert len(loop.ear.torques) == sent == 30


# -- the machine's messages


@pytest.mark.slow
@pytest.mark.one_python
def test_duplicates_change_nothing(hub: Hub) -> None:
    healthy, _ = commands_in_lock_step(hub)
    commanded, bridge = commands_in_lock_step(hub, Duplicate(copies=2))
    assert commanded == healthy
    assert bridge.sensed["position"].rejected["duplicate"] >= 190


@pytest.mark.slow_cases
@pytest.mark.parametrize(
    ("fault", "rejection"),
    [
        (Freeze(), "duplicate"),
        pytest.param(Corrupt(kind="type"), "fingerprint", marks=pytest.mark.one_python),
        (Corrupt(kind="nan"), "not finite"),
        pytest.param(ClockJump(seconds=-3600.0), "out of order", marks=pytest.mark.one_python),
        (Delay(seconds=0.5), None),
    ],
    ids=lambda value: value.name if isinstance(value, InjectedFault) else "",
)
def test_frozen_machine_is_stopped_until_reset(hub: Hub, fault: InjectedFault, rejection: str | None) -> None:
    with Loop(hub, max_age=SHORT) as loop:
        loop.begin()
        loop.machine.begin(fault)
        if rejection is not None:
            loop.until(lambda: loop.bridge.sensed["position"].rejected.get(rejection, 0) > 0)
        # A busy loop may read what is refused so late that the signal is stale before.
        loop.until(lambda: "is stale" in loop.latched or "is refused again and again" in loop.latched)
        loop.runtime.run(cycles=5)
        loop.assert_within_limits()
        assert loop.ear.torques[-1] == 0.0
        loop.machine.end_faults()
        loop.recover()
        loop.assert_within_limits()


@pytest.mark.slow
@pytest.mark.one_python
def test_delayed_messages_are_used_up_to_max_delay(hub: Hub) -> None:
    """Where signals may grow so old, the loop goes on."""
    with Loop(hub) as loop:
        loop.begin()
        loop.machine.begin(Delay(seconds=0.05))
        count = loop.bridge.sensed["position"].count
        loop.until(lambda: loop.bridge.sensed["position"].count > count + 100)
        assert not loop.latched
        loop.assert_within_limits()


@pytest.mark.slow
def test_late_messages_are_rejected(hub: Hub) -> None:
    with Loop(hub) as loop:
        loop.begin()
        loop.machine.begin(Reorder())
        position = loop.bridge.sensed["position"]
        loop.until(lambda: position.rejected.get("out of order", 0) > 20)
        assert not loop.latched
        loop.assert_within_limits()


@pytest.mark.slow
@pytest.mark.parametrize("seconds", [3600.0, pytest.param(-3600.0, marks=pytest.mark.one_python)])
def test_new_time_of_the_sender_is_accepted(hub: Hub, seconds: float) -> None:
    with Loop(hub) as loop:
        loop.begin()
        position = loop.bridge.sensed["position"]
        before = position.sent
        loop.machine.begin(ClockJump(seconds=seconds))
        loop.until(lambda: abs(position.sent - before) > 3000.0)
        count = position.count
        loop.until(lambda: position.count > count + 20)
        assert not loop.latched
        assert loop.bridge.clock_jumps["IIWA_STATUS"] == 1


@pytest.mark.slow
def test_damaged_messages_are_rejected(hub: Hub) -> None:
    with Loop(hub) as loop:
        loop.begin()
        loop.machine.begin(Corrupt(kind="truncate", fraction=0.1))
        position = loop.bridge.sensed["position"]
        loop.until(lambda: sum(position.rejected.values()) > 50)
        assert not loop.latched
        loop.machine.begin(Corrupt(kind="truncate", fraction=0.5))
        loop.until(lambda: "position is refused again and again" in loop.latched)
        loop.assert_within_limits()


# -- processes that end


@pytest.mark.slow
def test_killed_machine_stops_the_dps_and_may_return(hub: Hub) -> None:
    with Loop(hub, max_age=SHORT) as loop:
        loop.begin()
        loop.machine.kill()
        loop.until(lambda: "is stale" in loop.latched)
        assert loop.bridge.connected  # to the hub
        loop.runtime.run(cycles=5)
        loop.assert_within_limits()
        assert loop.ear.torques[-1] == 0.0
        with pytest.raises(SwitchRefusedError, match="is stale"):
            loop.runtime.reset()
        loop.machine.start()
        loop.recover()
        loop.until(lambda: loop.machine.status().accepted["torque"] > 100)
        loop.assert_within_limits()


def test_loop_reconnects_after_the_hub_was_killed() -> None:
    with Hub(port=0, protect=[COMMAND]) as first:
        port = int(first.url.rpartition(":")[2])
        with Loop(first, max_age=SHORT) as loop:
            loop.begin()
            os.kill(first.pid, signal.SIGKILL)
            os.waitid(os.P_PID, first.pid, os.WEXITED | os.WNOWAIT)
            loop.until(lambda: not loop.bridge.connected)  # when it has taken in what the hub had still sent
            assert loop.bridge.link.losses == 1
            loop.until(lambda: "is stale" in loop.latched)
            with Hub(port=port, protect=[COMMAND]):
                loop.until(lambda: loop.bridge.connected)
                assert loop.bridge.link.reconnections == 1
                loop.recover()
                accepted = loop.machine.status().accepted["torque"]
                loop.until(lambda: loop.machine.status().accepted["torque"] > accepted)
                loop.machine.until(lambda status: not status.braking)


CONTROLLER = """
from tests.control.test_loop import Loop, Hub
class Url:
    url = {url!r}
loop = Loop(Url())
loop.bridge.open()
loop.begin()
print("commands", flush=True)
loop.runtime.run()
"""


@pytest.mark.slow
@pytest.mark.parametrize("end", [signal.SIGSTOP, signal.SIGKILL])
def test_machine_brakes_when_the_controller_is_gone(hub: Hub, end: int) -> None:
    with MachineProcess(LoopScenario(), hub.url) as machine:
        command = [sys.executable, "-c", CONTROLLER.format(url=hub.url)]
        with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as controller:
            try:
                assert controller.stdout is not None
                assert controller.stdout.readline() == "commands\n"
                machine.until(lambda status: not status.braking, timeout=PATIENCE)
                controller.send_signal(end)
                status = machine.until(lambda status: status.braking, timeout=PATIENCE)
                assert status.silent == [COMMAND]
                if end == signal.SIGSTOP:
                    controller.send_signal(signal.SIGCONT)
                    machine.until(lambda status: not status.braking, timeout=PATIENCE)
            finally:
                controller.kill()


@pytest.mark.slow
def test_interrupted_controller_sends_the_fallback(hub: Hub) -> None:
    with Loop(hub) as loop:
        loop.begin()
        with pytest.raises(KeyboardInterrupt):
            loop.runtime.run(until=lambda: bool(signal.raise_signal(signal.SIGINT)))
        loop.assert_within_limits()
        assert loop.ear.torques[-1] == 0.0


# -- others


@pytest.mark.slow
def test_second_publisher_is_rejected_and_reported(hub: Hub) -> None:
    with Loop(hub) as loop:
        loop.begin()
        before = hub.statistics().protected[COMMAND]
        heard = len(loop.ear.listen())
        intruder = lcm.LCM(hub.url)
        for k in range(50):
            intruder.publish(COMMAND, torque(7.77, 2**50 + k))
        loop.until(lambda: hub.statistics().protected[COMMAND].refused >= before.refused + 50)
        after = hub.statistics().protected[COMMAND]
        assert after.owner == before.owner
        assert after.last_refused not in (None, after.owner)
        loop.runtime.run(cycles=20)
        assert 7.77 not in loop.ear.listen()
        assert len(loop.ear.torques) > heard
        assert not loop.latched


@pytest.mark.slow
@pytest.mark.parametrize(("trouble", "reason"), [(1.0, "out of ideas"), (2.0, "not finite")])
def test_failing_dps_is_replaced_at_once(hub: Hub, trouble: float, reason: str) -> None:
    with Loop(hub, lock_step=True) as loop:
        loop.sense()
        loop.runtime.switch("real")
        loop.runtime.cycle()
        loop.runtime.run(cycles=20)
        target, context = loop.runtime.target, loop.runtime.context
        target.write(context, {"dps.trouble": trouble})
        loop.runtime.run(cycles=20)
        assert reason in loop.latched
        heard = loop.ear.listen(lambda: len(loop.ear.torques) >= 41)
        assert heard[20] != 0.0
        assert set(heard[21:]) == {0.0}
        target.write(context, {"dps.trouble": 0.0})
        loop.runtime.run(cycles=1)
        loop.runtime.reset()
        loop.runtime.run(cycles=10)
        assert not loop.latched
