"""A machine in a child process on a hub, observed and commanded through liblcm."""

from __future__ import annotations

import os
import select
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from itertools import count
from pathlib import Path
from threading import Thread

import lcm
import numpy as np
import pytest
from drake import lcmt_iiwa_status

from tests.machine.robot import COMMAND, Listener, RobotScenario, state, torque
from tests.machine.test_machine import PUSHED, recorded
from tests.testbeds import AcrobotScenario
from vtbdrake.lcm.hub import Hub
from vtbdrake.machine import (
    DIED,
    ClockJump,
    Corrupt,
    Delay,
    Drop,
    Duplicate,
    Freeze,
    InjectedFault,
    Machine,
    MachineConfig,
    MachineError,
    MachineLoop,
    MachineProcess,
    MachineStatus,
    NoBrake,
    Reorder,
)
from vtbdrake.machine.injected_faults import CORRUPTIONS

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def hub() -> Iterator[Hub]:
    with Hub(port=0) as running:
        yield running


def ends(pid: int) -> bool:
    """Return whether a process ends within 10 s."""
    try:
        process = os.pidfd_open(pid)
    except ProcessLookupError:
        return True
    ended, _, _ = select.select([process], [], [], 10.0)
    os.close(process)
    return bool(ended)


def is_there(pid: int) -> bool:
    return Path(f"/proc/{pid}").exists()


def utime(data: bytes) -> int:
    return int(lcmt_iiwa_status.decode(data).utime)


def steps(heard: list[bytes]) -> np.ndarray:
    """Return the times from message to message, in microseconds."""
    return np.diff([utime(data) for data in heard])


class Stepper:
    """Commands a machine in lock-step, always alike, and records what it sends in between."""

    def __init__(self, url: str, process: MachineProcess) -> None:
        self.process = process
        self._listener = Listener(url)
        self._cycle = 0
        self._healthy = Machine(RobotScenario(), MachineConfig(values=PUSHED))
        self._told: list[bytes] = []
        self.step()

    def step(self, cycles: int = 1) -> list[bytes]:
        """Return what is heard in some cycles."""
        del self._listener.heard[:]
        for _ in range(cycles):
            self._cycle += 1
            self._listener.command(0.5, self._cycle)
        return self._listener.until_cycle(self._cycle)

    def healthy(self, *ahead: int) -> list[bytes]:
        """Return what a machine without faults sends this number of cycles after the present one."""
        while len(self._told) <= self._cycle + max(ahead, default=0):
            self._told += [data for _, data in self._healthy.messages()]
            self._healthy.receive(COMMAND, torque(0.5, len(self._told)))
            self._healthy.advance()
        return [self._told[self._cycle + k] for k in ahead]


@pytest.fixture(scope="module")
def running() -> Iterator[Stepper]:
    """Run on a bus of its own: it lives on, and would answer the commands of other tests."""
    with Hub(port=0) as hub, MachineProcess(RobotScenario(), hub.url, lock_step=True, values=PUSHED) as process:
        yield Stepper(hub.url, process)


@pytest.fixture
def stepper(running: Stepper) -> Iterator[Stepper]:
    yield running
    running.process.end_faults()


# -- cycles


def test_machine_in_lock_step_and_simulation_agree_bit_for_bit(hub: Hub) -> None:
    commands, states = recorded(300)
    listener = Listener(hub.url)
    with MachineProcess(RobotScenario(), hub.url, lock_step=True, values=PUSHED):
        for k, command in enumerate(commands):
            data = listener.wait(lambda heard, k=k: heard and utime(heard[-1]) == k * 1000)[-1]
            np.testing.assert_array_equal(state(data), states[k])
            listener.command(command, k + 1)


def test_sense_latency_in_lock_step_is_refused(hub: Hub) -> None:
    """The machine would wait for the answer to a state that it holds back."""
    reason = (
        r"no sense_latency, unlike 0\.002 s: .* \(ErrorModel\(latency=\.\.\.\)\), or let the clock begin the cycles"
    )
    with pytest.raises(ValueError, match=reason):
        MachineProcess(RobotScenario(), hub.url, lock_step=True, sense_latency=0.002)
    loop = MachineLoop(Machine(RobotScenario(), MachineConfig(sense_latency=0.002)), hub.url)
    with pytest.raises(ValueError, match=reason):
        loop.run(lock_step=True)
    loop.close()


@pytest.mark.slow
def test_act_latency_in_lock_step_delays_commands(hub: Hub) -> None:
    listener = Listener(hub.url)
    with MachineProcess(RobotScenario(), hub.url, lock_step=True, act_latency=0.002) as process:
        for k in range(5):
            listener.wait(lambda heard, k=k: heard and utime(heard[-1]) == k * 1000)
            listener.command(0.5, k + 1)
        assert process.until(lambda status: status.cycle == 5).accepted["torque"] == 3


def test_machine_sends_its_state_every_period(hub: Hub) -> None:
    listener = Listener(hub.url)
    with MachineProcess(RobotScenario(), hub.url, period=0.01):
        # A busy computer leaves out cycles, but not all of them.
        listener.wait(lambda heard: len(heard) >= 30 and bool((steps(heard) == 10_000).any()))
    assert (steps(listener.heard) > 0).all()
    assert not (steps(listener.heard) % 10_000).any()


@pytest.mark.slow
def test_machine_keeps_up_with_the_clock(hub: Hub) -> None:
    with MachineProcess(RobotScenario(), hub.url) as process:
        process.pause()
        process.resume()
        status = process.until(lambda status: status.cycle > 100)
        statistics = process.statistics()
        assert abs(status.time - 0.001 * status.cycle) < 1e-9
        assert statistics.loop.cycles + statistics.loop.misses >= status.cycle


def test_machine_ends_after_its_cycles(hub: Hub) -> None:
    with MachineProcess(RobotScenario(), hub.url, cycles=50) as process:
        assert process.wait() == 0


# -- injected faults


@pytest.mark.parametrize(
    ("fault", "during", "after"),
    [
        (Drop(), (5, []), (2, [1, 2])),
        (Delay(seconds=0.003), (5, [1, 2]), (4, [-2, 1, -1, 2, 0, 3, 4])),
        (Freeze(), (4, [1, 1, 1, 1]), (1, [1])),
        (Duplicate(copies=2), (2, [1, 1, 1, 2, 2, 2]), (1, [1])),
        (Reorder(), (4, [2, 1, 4, 3]), (1, [1])),
    ],
    ids=lambda value: getattr(value, "name", ""),
)
def test_fault_lasts_until_it_is_ended(
    fault: InjectedFault, during: tuple[int, list[int]], after: tuple[int, list[int]], stepper: Stepper
) -> None:
    """A number of cycles, and the healthy messages that are heard then, counted from before them."""
    stepper.process.begin(fault)
    for cycles, ahead in (during, after):
        expected = stepper.healthy(*ahead)
        assert stepper.step(cycles) == expected
        stepper.process.end_faults()


def test_clock_jump(stepper: Stepper) -> None:
    stepper.process.begin(ClockJump(seconds=-3600.0))
    [expected] = stepper.healthy(1)
    [data] = stepper.step()
    assert utime(data) == utime(expected) - 3600 * 10**6
    np.testing.assert_array_equal(state(data), state(expected))
    stepper.process.end_faults()
    expected = stepper.healthy(1)
    assert stepper.step() == expected


@pytest.mark.parametrize("kind", CORRUPTIONS)
def test_corruption(kind: str, stepper: Stepper) -> None:
    stepper.process.begin(Corrupt(kind=kind))
    whole = stepper.healthy(1, 2, 3)
    heard = stepper.step(3)
    assert len(heard) == 3
    assert not set(heard) & set(whole)
    stepper.process.end_faults()
    expected = stepper.healthy(1)
    assert stepper.step() == expected


def test_fault_of_commands(stepper: Stepper) -> None:
    fault = Corrupt(side="act", kind="type")
    before = stepper.process.begin(fault)
    assert before.faults == [fault.to_dict()]
    stepper.step(5)
    after = stepper.process.end_faults()
    assert (after.accepted, after.rejected) == (before.accepted, {"torque": {"fingerprint": 5}})
    assert after.faults == []


def test_status_shows_the_brake_when_commands_stop(hub: Hub) -> None:
    listener = Listener(hub.url)
    utimes = count(1)

    def moving(heard: list[bytes]) -> bool:
        listener.command(0.5, next(utimes))
        last = listener.statuses[-1] if listener.statuses else None
        return last is not None and last["accepted"]["torque"] > 0 and not last["braking"]

    with MachineProcess(RobotScenario(), hub.url, values=PUSHED, timeout=0.05):
        listener.wait(moving)
        first = listener.statuses[-1]
        listener.wait(lambda heard: listener.statuses[-1]["cycle"] > first["cycle"] + 50)
        listener.wait(lambda heard: listener.statuses[-1]["braking"])
        assert listener.statuses[-1]["silent"] == [COMMAND]
        # The elbow is locked; the shoulder swings.
        del listener.heard[:]
        later = np.array([state(data) for data in listener.wait(lambda heard: len(heard) >= 20)])
        assert np.ptp(later[:, 1]) == 0.0
        assert np.ptp(later[:, 0]) > 0.0


@pytest.mark.slow
def test_commands_held_by_a_stopped_hub_are_rejected() -> None:
    with Hub(port=0) as hub, MachineProcess(RobotScenario(), hub.url) as process:
        bus = lcm.LCM(hub.url)

        def command() -> None:
            bus.publish(COMMAND, torque(0.5, round(1e6 * time.time())))

        def heard(status: MachineStatus) -> bool:
            command()
            return not status.braking

        process.until(heard)
        os.kill(hub.pid, signal.SIGSTOP)
        try:
            for _ in range(50):
                command()
            process.until(lambda status: status.braking)
            # Those that wait are older than 0.1 s by then, and so much older than the quickest.
            later = process.status().time + 0.2
            process.until(lambda status: status.time > later)
        finally:
            os.kill(hub.pid, signal.SIGCONT)
        assert process.until(lambda status: "late" in status.rejected["torque"]).braking
        assert process.status().braking
        process.until(heard)


def test_no_brake_while_running(hub: Hub) -> None:
    with MachineProcess(RobotScenario(), hub.url, timeout=0.02) as process:
        process.until(lambda status: status.braking)
        process.begin(NoBrake())
        process.until(lambda status: not status.braking)
        assert process.status().silent == [COMMAND]
        process.end_faults()
        process.until(lambda status: status.braking)


def test_values_are_set_while_it_runs(hub: Hub) -> None:
    mass = "sim.sys.Acrobot.lower_link.mass"
    listener = Listener(hub.url)
    heavy = Machine(RobotScenario(), MachineConfig(values={**PUSHED, mass: 1.5}))
    heavy.receive(COMMAND, torque(0.5, 1))
    heavy.advance()
    with MachineProcess(RobotScenario(), hub.url, lock_step=True, values=PUSHED) as process:
        process.write({mass: 1.5})
        with pytest.raises(MachineError, match="did you mean"):
            process.write({"sim.sys.Acrobot.lower_link.mas": 2.0})
        listener.command(0.5, 1)
        assert listener.until_cycle(1)[-1:] == [data for _, data in heavy.messages()]


def test_requests_over_lcm(hub: Hub) -> None:
    listener = Listener(hub.url)
    statuses = listener.statuses
    with MachineProcess(RobotScenario(), hub.url) as process:
        for nonsense in (
            b"",
            b"\xff\x00",
            b"[1]",
            b'{"fault": "melt"}',
            b'{"set": 5}',
            b"[" * 100_000,
            b'{"request": []}',
        ):
            listener.publish("VTB_MACHINE", nonsense)
        listener.publish("VTB_MACHINE", b'{"fault": "clock_jump", "seconds": 3600}')
        listener.wait(lambda heard: any(status["faults"] for status in statuses))
        assert statuses[-1]["faults"] == [ClockJump(seconds=3600.0).to_dict()]
        listener.publish("VTB_MACHINE", b'{"request": "normal"}')
        listener.wait(lambda heard: not statuses[-1]["faults"])
        listener.publish("VTB_MACHINE", b'{"request": "die"}')
        assert process.wait() == DIED


def test_wait_for_a_status_keeps_its_timeout_when_the_machine_is_frozen(hub: Hub) -> None:
    with MachineProcess(RobotScenario(), hub.url) as process:
        process.pause()
        with pytest.raises(MachineError, match=r"does not answer within 0.2 s: it is stopped, or hangs"):
            process.until(lambda status: True, timeout=0.2)
        process.resume()
        assert process.statistics().lost >= 0.0  # The late answer was a status.


# -- its end


def test_waiting_machine_ends_when_its_parent_closes() -> None:
    ours, theirs = socket.socketpair()
    # It hears its own status, takes it for a request, and answers by its status.
    config = MachineConfig(control_channel="TALK", status_channel="TALK")
    loop = MachineLoop(Machine(RobotScenario(), config), "memq://", control=theirs)
    thread = Thread(target=loop.run, kwargs={"lock_step": True})
    thread.start()
    ours.close()
    thread.join(60.0)
    went_on = thread.is_alive()
    loop.stop()
    thread.join()
    loop.close()
    assert not went_on


@pytest.mark.slow
def test_machine_dies_on_request(hub: Hub) -> None:
    with MachineProcess(RobotScenario(), hub.url) as process:
        assert process.die() == DIED
        assert not process.alive
        with pytest.raises(MachineError, match="does not answer"):
            process.status()
        process.start()
        assert process.status().faults == []


@pytest.mark.slow
def test_machine_is_killed_from_outside(hub: Hub) -> None:
    with MachineProcess(RobotScenario(), hub.url) as process:
        assert process.kill() == -signal.SIGKILL
        assert not process.alive


@pytest.mark.slow_cases
@pytest.mark.parametrize("lock_step", [False, True])
def test_closing_leaves_no_process(hub: Hub, lock_step: bool) -> None:
    with MachineProcess(RobotScenario(), hub.url, lock_step=lock_step) as process:
        pid = process.pid
        assert is_there(pid)
    assert not is_there(pid)


@pytest.mark.slow
def test_closing_a_paused_machine_leaves_no_process(hub: Hub) -> None:
    with MachineProcess(RobotScenario(), hub.url) as process:
        pid = process.pid
        process.pause()
    assert not is_there(pid)


def test_machine_ends_with_its_parent(hub: Hub) -> None:
    program = f"""
import os
from tests.machine.robot import RobotScenario
from vtbdrake.machine import MachineProcess
process = MachineProcess(RobotScenario(), {hub.url!r})
process.start()
print(process.pid, flush=True)
os._exit(0)
"""
    result = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert ends(int(result.stdout)), result.stderr


def test_machine_outlives_its_hub() -> None:
    with Hub(port=0) as first:
        port = int(first.url.rpartition(":")[2])
        process = MachineProcess(RobotScenario(), first.url)
        process.start()
    try:
        before = process.status().cycle
        process.until(lambda status: status.cycle > before + 20)
        with Hub(port=port) as second:
            listener = Listener(second.url)
            assert utime(listener.next()) > before * 1000
    finally:
        process.close()


@pytest.mark.slow
def test_late_controller_gets_the_state_in_lock_step() -> None:
    with Hub(port=0) as first:
        port = int(first.url.rpartition(":")[2])
        process = MachineProcess(RobotScenario(), first.url, lock_step=True)
        process.start()
        late = Listener(first.url)
        assert utime(late.next()) == 0
        late.command(0.0, 1)
        process.until(lambda status: status.cycle == 1)
    try:
        with Hub(port=port) as second:
            assert utime(Listener(second.url).next()) == 1000
    finally:
        process.close()


# -- what does not start


def test_machine_without_a_hub_does_not_start() -> None:
    with Hub(port=0) as hub:
        url = hub.url
    with pytest.raises(MachineError, match=f"no LCM bus at {url}"):
        MachineProcess(RobotScenario(), url).start()


@pytest.mark.slow
def test_machine_without_protocol_does_not_start(hub: Hub) -> None:
    with pytest.raises(MachineError, match="AcrobotScenario has no protocol for its machine"):
        MachineProcess(AcrobotScenario(), hub.url).start()


def test_simulation_that_fails_ends_the_machine(hub: Hub) -> None:
    massless = {"sim.sys.Acrobot.lower_link.mass": 0.0}
    with MachineProcess(RobotScenario(time_step=0.0), hub.url, lock_step=True, values=massless) as process:
        Listener(hub.url).command(1.0, 1)
        assert process.wait() == 1
