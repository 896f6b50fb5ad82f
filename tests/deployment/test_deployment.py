"""Tests of the deployment that a scenario describes, of its refusals, and of the call that starts it."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from math import inf
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.control.scripted import PERIOD, ScriptedBridge, ServoScenario
from tests.control.servo_machine import COMMAND, PATIENCE, ServoMachineScenario
from tests.control.test_loop import Ear
from tests.lcm.hub.clients import Client
from tests.machine.looking import LookingScenario
from tests.machine.robot import ELBOW, SENSE, RobotScenario
from vtbdrake.control.bridge import Bridge, BridgeError
from vtbdrake.control.clock import SimulatedClock
from vtbdrake.control.fallback import Hold, Silence
from vtbdrake.control.fault import FaultKind
from vtbdrake.control.received_signal import ReceivedSignal
from vtbdrake.control.runtime import Runtime
from vtbdrake.control.switching import SwitchRefusedError
from vtbdrake.deployment import Deployment, DeploymentError
from vtbdrake.lcm.hub import Hub
from vtbdrake.lcm.iiwa_messages import iiwa_command, iiwa_status
from vtbdrake.lcm.protocol import Protocol, ProtocolError
from vtbdrake.machine import MachineProcess
from vtbdrake.machine.injected_faults import Drop
from vtbdrake.recording.replay import replay
from vtbdrake.testbed import DpsAlone, Interface
from vtbdrake.testing.lock_step import LockStep

CONTINUITY = {"velocity": ("speed", 5.0)}
FAR = {"u.target": [0.1, -0.05], "dps.gain": 0.01}


@dataclass
class Given(ServoScenario):
    """A scenario with the deployment that a test gives it."""

    def deployment(self) -> Any:
        return self.given

    given: Any = None


class Machine:
    """A runtime and a machine that stands still, after some seconds of silence."""

    def __init__(self, deployment: Deployment, *, silent_until: float = 0.0) -> None:
        scenario = ServoScenario()
        self.clock = SimulatedClock()

        def sensors(t: float) -> dict[str, Any]:
            return {"position": [0.05, 0.0], "speed": [0.3, 0.0]} if t >= silent_until else {}

        self.bridge = ScriptedBridge(scenario.interface(), self.clock, sensors)
        self.runtime: Runtime = deployment.runtime(DpsAlone(scenario), self.bridge, clock=self.clock)
        self.lines: list[str] = []

    def take_over(self, *, timeout: float = 10.0) -> None:
        self.runtime.take_over(timeout=timeout, report=self.lines.append)


def test_default_deployment_is_enough_without_limits_and_protocol() -> None:
    deployment = Deployment.of(ServoScenario(rate=0.0))
    assert (deployment.period, deployment.continuity, deployment.pace) == (1e-3, {}, "")


def test_command_that_may_jump_has_to_be_declared() -> None:
    scenario = ServoMachineScenario(rate=0.0)
    with pytest.raises(DeploymentError, match=r"velocity may be anywhere within its limits: .* or {'velocity': None}"):
        Deployment.of(scenario, continuity={})
    Deployment.of(scenario, continuity={"velocity": None})


def test_limited_command_cannot_be_declared_to_jump() -> None:
    scenario = Given(rate=2.0)
    scenario.given = Deployment(continuity={"velocity": None})
    with pytest.raises(DeploymentError, match="has a limited rate or acceleration, but no measurement to start from"):
        Deployment.of(scenario)


def test_limited_rate_without_continuity_is_refused() -> None:
    with pytest.raises(DeploymentError) as error:
        Deployment.of(ServoScenario(rate=2.0))
    assert "continuity={'velocity': (sensor signal, largest difference)}" in str(error.value)
    assert "its method deployment() describes how it runs" in str(error.value)


@pytest.mark.parametrize(
    ("deployment", "reason"),
    [
        ({"period": 1e-3}, "must return a vtbdrake.Deployment, not {'period': 0.001}"),
        (Deployment(continuity={"velocity": ("velocity", 1.0)}), "not from 'velocity' to 'velocity'"),
        (Deployment(continuity={"speed": ("speed", 1.0)}), "not from 'speed' to 'speed'"),
        (Deployment(continuity=CONTINUITY, guards={"fallback": {"torque": Hold()}}), "fallback is given for torque"),
        (
            Deployment(continuity=CONTINUITY, guards={"fallback": {"velocity": Hold}}),
            "a Fallback, Zero() say, not <class",
        ),
        *(
            (Deployment(continuity=CONTINUITY, guards={option: value}), reason)
            for option, value, reason in (
                ("fallback", {"velocity": 0.0}, "the fallback of velocity is a Fallback, Zero() say, not 0.0"),
                ("falback", {}, "the guards have no setting 'falback'; did you mean fallback?"),
                ("max_delay", {"speed": "0.1"}, "the max_delay of speed must be a number, not '0.1'"),
                ("jump_tolerance", {"speed": "0.1"}, "speed must be a number or several, not '0.1'"),
                ("acting_latency", "3", "acting_latency must be a number, not '3'"),
                ("acting_tolerance", {"velocity": "3"}, "velocity must be a number or several, not '3'"),
                ("leave_time", "3", "leave_time must be a number, not '3'"),
                ("max_missed", None, "max_missed must be a number, not None"),
            )
        ),
        (Deployment(continuity=CONTINUITY, protocol=Protocol(sense=[], act=[])), "position"),
        (Deployment(continuity=CONTINUITY, pace="posture"), "(position, speed), not by 'posture'"),
    ],
)
def test_deployment_that_does_not_fit_the_signals_is_refused(deployment: Any, reason: str) -> None:
    scenario = Given()
    scenario.given = deployment
    with pytest.raises(DeploymentError) as error:
        Deployment.of(scenario)
    assert reason in str(error.value)


def test_signals_without_max_age_are_refused_outside_of_lock_step() -> None:
    interface = ServoScenario().interface()
    ageless = replace(interface, sense=[replace(signal, max_age=inf) for signal in interface.sense])
    deployment = Deployment(continuity=CONTINUITY)
    with pytest.raises(ValueError, match=r"no sensor signal has a max_age, .* \(position, speed\)"):
        deployment.check_interface(ageless)
    deployment.check_interface(interface)
    deployment.in_lock_step("speed").check_interface(ageless)


@pytest.mark.parametrize("lock_step", [False, True])
def test_samples_may_be_late_in_lock_step(lock_step: bool) -> None:
    """The time of the machine stands still between two messages: its stamps say nothing about their way."""
    deployment = Deployment(continuity=CONTINUITY, guards={"max_delay": {"speed": 0.01}})
    guards = Machine(deployment.in_lock_step("speed") if lock_step else deployment).runtime.guards
    faults: list[str] = []
    for k, (sent, arrived) in enumerate([(100.0, 5.0), (100.01, 5.5)]):
        sample = ReceivedSignal(value=np.array([0.3, 0.0]), sent=sent, arrived=arrived, count=k + 1)
        faults += guards.sensor_faults("speed", arrived, sample)
    assert ["is stale" in fault for fault in faults] == ([] if lock_step else [True])


def test_signal_that_is_not_sent_in_every_cycle_is_refused_in_lock_step() -> None:
    """Machine and loop would wait for each other."""
    deployment = LookingScenario().deployment()
    with pytest.raises(ValueError, match=r"image is sent every 0\.02 s only, .* a command every 0\.01 s"):
        deployment.in_lock_step("image")
    assert deployment.in_lock_step("speed").pace == "speed"


@pytest.mark.parametrize(("hint", "expected"), [("press the green button", "press the green"), ("", "a command u")])
def test_refused_reset_says_what_to_do(hint: str, expected: str) -> None:
    machine = Machine(Deployment(continuity={"velocity": ("speed", 1.2)}, hint=hint))
    machine.runtime.write({"u.target": [0.05, 0.0]})
    machine.take_over()
    machine.runtime.run(cycles=5)
    machine.runtime.guards.latch("told", machine.clock.now(), {})
    machine.runtime.write({"u.target": [0.9, 0.0]})
    machine.runtime.run(cycles=2)
    with pytest.raises(SwitchRefusedError, match=f"1.2 is allowed: .*{expected}"):
        machine.runtime.reset()


@pytest.mark.parametrize("field", ["period", "patience"])
@pytest.mark.parametrize("value", ["0.01", None, 0.0, np.nan])
def test_times_of_a_loop_are_positive_numbers(field: str, value: Any) -> None:
    with pytest.raises(ValueError, match=rf"the {field} of a loop .* not {value!r}"):
        Deployment(**{field: value})


def test_fields_of_a_deployment_can_be_replaced() -> None:
    deployment = Deployment.of(ServoMachineScenario(), period=0.002, pace="speed")
    assert (deployment.period, deployment.pace) == (0.002, "speed")
    assert deployment.continuity == ServoMachineScenario().deployment().continuity


def test_fallback_is_that_of_the_deployment() -> None:
    machine = Machine(Deployment(continuity=CONTINUITY, guards={"fallback": {"velocity": Hold()}}))
    machine.take_over()
    machine.runtime.run(cycles=20)
    last = machine.bridge.sent[-1][1]["velocity"]
    machine.runtime.leave("because")
    assert np.array_equal(machine.bridge.sent[-1][1]["velocity"], last)
    assert np.any(last != 0.0)


def test_take_over_starts_from_the_first_measurement() -> None:
    machine = Machine(Deployment(continuity=CONTINUITY), silent_until=0.5)
    machine.take_over()
    assert machine.clock.now() == pytest.approx(0.5, abs=2 * PERIOD)
    machine.runtime.run(cycles=1)
    [(_, first)] = machine.bridge.sent
    # The rate limit allows this much in a cycle; the DPS wants less.
    assert first["velocity"] == pytest.approx([0.3 - 2.0 * PERIOD, 0.0])
    assert "position" in machine.lines[0]


def test_take_over_waits_until_the_machine_is_ready() -> None:
    def blocked_by(bridge: Bridge) -> str | None:
        return None if bridge.sensed["position"].arrived >= 2.5 else "its brakes are on"

    machine = Machine(Deployment(continuity=CONTINUITY, blocked_by=blocked_by))
    machine.take_over()
    assert machine.clock.now() == pytest.approx(2.5, abs=2 * PERIOD)
    # At first, and then once per second.
    assert machine.lines == ["the machine must not be commanded: its brakes are on"] * 3


def test_take_over_gives_up_after_its_timeout() -> None:
    machine = Machine(Deployment(continuity=CONTINUITY, blocked_by=lambda bridge: "its brakes are on"))
    with pytest.raises(SwitchRefusedError, match=r"after 1\.5 s: the machine must not be commanded: its brakes are on"):
        machine.take_over(timeout=1.5)
    assert machine.bridge.sent == []


def test_deployed_dps_commands_is_recorded_and_ends_with_the_fallback(tmp_path: Path) -> None:
    scenario = ServoMachineScenario(rate=0.0)
    with Hub(port=0, protect=[COMMAND]) as hub, MachineProcess(scenario, hub.url):
        ear = Ear(hub.url)
        with scenario.deploy(hub.url, record=tmp_path / "servo.lcm", values=FAR) as runtime:
            runtime.take_over()
            runtime.run(cycles=50)
            assert not runtime.guards.latched
        heard = np.array(ear.listen(lambda: ear.torques[-2:] == [0.0, 0.0])).reshape(-1, 2)
        assert not runtime.bridge.connected
    # No velocity at the end, once; before that the DPS is on its way.
    assert len(heard) > 40
    assert np.flatnonzero((heard == 0.0).all(axis=1)).tolist() == [len(heard) - 1]
    report = replay(tmp_path / "servo.lcm")
    assert report.identical and report.cycles == runtime.cycles


@dataclass
class ReportingScenario(RobotScenario):
    """The acrobot, which reports every 30 ms which torque acts."""

    def deployment(self) -> Deployment:
        reports = iiwa_status({"torque_acting": "joint_torque_commanded"}, channel="ACTING")
        protocol = Protocol(
            sense=[iiwa_status(SENSE), reports],
            act=[iiwa_command({"torque": "joint_torque"})],
            reported={"torque": "torque_acting"},
            periods={"ACTING": 0.03},
        )
        return Deployment(protocol=protocol, continuity={"torque": None})

    def interface(self) -> Interface:
        interface = super().interface()
        return replace(interface, sense=[replace(signal, max_age=1.0) for signal in interface.sense])


def test_machine_that_does_not_report_what_acts_is_warned_about(caplog: pytest.LogCaptureFixture) -> None:
    with Hub(port=0) as hub:
        with ServoMachineScenario(rate=0.0).deploy(hub.url):
            pass
        assert (
            "the machine does not report what acts on velocity: the loop will not notice that commands" in caplog.text
        )
        caplog.clear()
        with ReportingScenario().deploy(hub.url):
            pass
        assert "report" not in caplog.text


def test_reports_may_be_as_old_as_the_time_between_two() -> None:
    with LockStep(ReportingScenario()) as loop:
        loop.machine.write({ELBOW: 0.3})
        loop.runtime.take_over(timeout=1.0)
        loop.runtime.run(cycles=300)
        assert loop.runtime.guards.latched == ()
        loop.machine.begin(Drop(side="act"))
        loop.runtime.run(cycles=90)
        assert [fault.kind for fault in loop.runtime.guards.latched] == [FaultKind.NOT_ACTING]


def test_machine_that_is_to_report_what_acts_is_not_taken_over_before() -> None:
    with LockStep(ReportingScenario()) as loop:
        loop.machine.begin(Drop(channels=("ACTING",)))
        loop.runtime.run(cycles=5)
        (reason,) = loop.runtime.prepare("real").reasons
        assert reason == "the machine has never reported what acts on torque, and is to (Protocol.reported)"
        loop.machine.end_faults()
        loop.runtime.take_over(timeout=0.2)


def test_machine_that_does_not_report_any_more_is_a_fault() -> None:
    with LockStep(ReportingScenario()) as loop:
        loop.runtime.take_over(timeout=1.0)
        loop.runtime.run(cycles=100)
        loop.machine.begin(Drop(channels=("ACTING",)))
        loop.runtime.run(cycles=100)
        (fault,) = loop.runtime.guards.latched
        assert fault.reason == "the machine does not report any more what acts on torque"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"acting_latency": 0.0}, "acting_latency is 1 to 255 periods, not 0.0"),
        ({"acting_tolerance": {"velocity": -1.0}}, "acting_tolerance of velocity must not be negative"),
        ({"acting_tolerance": {"speed": 1.0}}, "acting_tolerance is given for speed, but the signals are velocity"),
    ],
)
def test_impossible_comparisons_are_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(DeploymentError, match=message):
        Deployment.of(Given(rate=0.0, given=Deployment(guards=options)))


@pytest.mark.slow
def test_silent_fallback_keeps_its_protected_channel() -> None:
    scenario = ServoMachineScenario(rate=0.0)
    deployment = replace(Deployment.of(scenario), guards={"fallback": {"velocity": Silence()}})
    lease = 1.5
    with Hub(port=0, protect=[COMMAND], lease=lease) as hub, MachineProcess(scenario, hub.url):
        foreign, robot = Client(hub.url), Client(hub.url, COMMAND)
        with scenario.deploy(hub.url, deployment=deployment, values=FAR) as runtime:
            runtime.take_over()
            runtime.run(cycles=10)
            runtime.guards.latch("the test says so", runtime.clock.now(), runtime.watched)
            begin = runtime.clock.now()

            def attack() -> bool:
                if runtime.cycles % 20 == 0:
                    foreign.publish(f"VTB_HUB_TAKE/{COMMAND}")
                    foreign.publish(COMMAND, b"foreign")
                return runtime.clock.now() - begin > 1.2 * lease

            runtime.run(until=attack)
            status = hub.statistics().protected[COMMAND]
            robot.sync()
    assert status.taken == 0 and status.refused > 10
    assert b"foreign" not in robot.data(COMMAND) != []


def fail() -> bool:
    raise RuntimeError


def terminate() -> bool:
    assert signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL  # It would end the tests.
    signal.raise_signal(signal.SIGTERM)
    return False


@pytest.mark.slow_cases
@pytest.mark.parametrize(("fail", "error"), [(terminate, KeyboardInterrupt), (fail, RuntimeError)])
def test_error_in_the_block_sends_the_fallback_once(fail: Callable[[], bool], error: type[BaseException]) -> None:
    scenario = ServoMachineScenario(rate=0.0)
    with Hub(port=0) as hub, MachineProcess(scenario, hub.url):
        ear = Ear(hub.url)
        with pytest.raises(error), scenario.deploy(hub.url, values=FAR) as runtime:
            runtime.take_over()
            runtime.run(cycles=10)
            runtime.run(until=fail)
        heard = np.array(ear.listen(lambda: ear.torques[-2:] == [0.0, 0.0])).reshape(-1, 2)
    assert np.flatnonzero((heard == 0.0).all(axis=1)).tolist() == [len(heard) - 1]
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL


@pytest.mark.slow
@pytest.mark.parametrize("interrupted", [False, True])
def test_machine_without_time_out_is_left_at_rest(interrupted: bool, tmp_path: Path) -> None:
    scenario = ServoMachineScenario(rate=2.0, leave_time=0.4)
    with Hub(port=0, protect=[COMMAND]) as hub, MachineProcess(scenario, hub.url, timeout=1e3, brake="hold"):
        ear = Ear(hub.url)

        def interrupt() -> bool:
            raise KeyboardInterrupt

        with (
            suppress(KeyboardInterrupt),
            scenario.deploy(hub.url, record=tmp_path / "servo.lcm", values={"u.target": [0.1, -0.05]}) as runtime,
        ):
            runtime.take_over()
            runtime.run(cycles=100)
            if interrupted:
                runtime.run(until=interrupt)
        heard = np.array(ear.listen(lambda: ear.torques[-2:] == [0.0, 0.0])).reshape(-1, 2)
    assert np.abs(heard).max() > 0.1
    assert np.abs(np.diff(heard, axis=0)).max() <= 2.0 * PERIOD * (1 + 1e-9)
    assert heard[-1].tolist() == [0.0, 0.0]
    report = replay(tmp_path / "servo.lcm")
    assert report.identical and report.cycles == runtime.cycles


def test_end_of_the_block_ends_a_loop_in_another_thread() -> None:
    scenario = ServoMachineScenario(rate=2.0, leave_time=0.2)
    with Hub(port=0, protect=[COMMAND]) as hub, MachineProcess(scenario, hub.url):
        ear = Ear(hub.url)
        with scenario.deploy(hub.url, values={"u.target": [0.1, -0.05]}) as runtime:
            runtime.take_over()
            thread = threading.Thread(target=runtime.run)
            thread.start()
            ear.listen(lambda: max(map(abs, ear.torques), default=0.0) > 0.1)
        thread.join(PATIENCE)
        runtime.stop()
        assert not runtime.bridge.connected
        heard = np.array(ear.listen(lambda: ear.torques[-2:] == [0.0, 0.0])).reshape(-1, 2)
        status = hub.statistics().protected[COMMAND]
    # One after the other, the loop and the fallback command within the limits, from one connection.
    assert np.abs(np.diff(heard, axis=0)).max() <= 2.0 * PERIOD * (1 + 1e-9)
    assert heard[-1].tolist() == [0.0, 0.0] and status.refused == 0


def test_block_without_take_over_commands_nothing() -> None:
    scenario = ServoMachineScenario()
    with Hub(port=0) as hub, MachineProcess(scenario, hub.url):
        ear = Ear(hub.url)
        with scenario.deploy(hub.url) as runtime:
            runtime.run(cycles=10)
        assert ear.listen() == []


def test_whole_testbed_is_deployed_from_a_snapshot() -> None:
    scenario = ServoMachineScenario()
    testbed = scenario.build()
    context = testbed.default_context()
    testbed.write(context, {"dps.gain": 3.0})
    snapshot, by_the_clock = testbed.snapshot(context), Deployment.of(scenario, pace="")
    options: dict[str, Any] = {"target": testbed, "deployment": by_the_clock, "clock": SimulatedClock()}
    with scenario.deploy("memq://", start=snapshot, **options) as runtime:
        runtime.run(cycles=50)
        assert testbed.read(runtime.context, "dps.gain") == 3.0
        assert runtime.time == pytest.approx(50 * PERIOD)


def test_protocol_of_a_given_deployment_is_used() -> None:
    scenario = ServoMachineScenario()
    given = scenario.deployment()
    assert given.protocol is not None
    maps = {
        side: [replace(m, channel=f"OTHER_{m.channel}") for m in getattr(given.protocol, side)]
        for side in ("sense", "act")
    }
    deployment = replace(given, protocol=Protocol(**maps))
    with Hub(port=0) as hub, scenario.deploy(hub.url, deployment=deployment) as runtime:
        channels = set(runtime.bridge.channels.values())
    assert channels == {m.channel for m in maps["sense"]}


def test_missing_bus_and_missing_protocol_are_errors() -> None:
    with pytest.raises(BridgeError, match="no LCM bus"), ServoMachineScenario().deploy("tcpq://127.0.0.1:1"):
        pass
    with pytest.raises(ProtocolError, match="ServoScenario has no protocol"), ServoScenario(rate=0.0).deploy("memq://"):
        pass
