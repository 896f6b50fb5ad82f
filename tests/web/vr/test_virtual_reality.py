"""Tests of headsets that lead a robot through the server: the simulated arm, and the arm of a machine process."""

from __future__ import annotations

import json
import ssl
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from shutil import copy
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest
from pydrake.math import RigidTransform
from websockets.exceptions import InvalidStatus

from tests.meshcats import kill
from tests.web.live.test_session_server import NO_COMMANDS, PATIENCE, base, page
from tests.web.serving.entrance import entered
from vtbdrake.control.runtime import Runtime
from vtbdrake.deployment import Deployment
from vtbdrake.lcm.hub import Hub
from vtbdrake.machine import MachineProcess
from vtbdrake.monitoring.live.client import LiveClient, LiveError
from vtbdrake.testbed.hand_command import HandCommand
from vtbdrake.web import View, view, view_loop
from vtbdrake.web.serving.tls import Tls, TlsError
from vtbdrake.web.vr.hand import HandError, HandMessage
from vtbdrake.web.vr.virtual_reality import LedRobot, VirtualReality
from vtbdrake_diagrams.cart_pole import CartPoleScenario
from vtbdrake_diagrams.manipulator import ManipulatorScenario
from vtbdrake_diagrams.manipulator.leading import REST
from vtbdrake_diagrams.manipulator.motions import Motion

pytestmark = pytest.mark.one_python

TOOL = RigidTransform([0.1, 0.2, 0.3])


@dataclass
class PatientArm(ManipulatorScenario):
    """An arm that a busy computer does not take for released."""

    led_by_hand: bool = True

    def hand_command(self) -> HandCommand | None:
        command = super().hand_command()
        assert command is not None
        return replace(command, release_time=10.0)


class Headset:
    """A page that sends poses, without a browser."""

    def __init__(self, running: View) -> None:
        self._stack = ExitStack()
        self._socket = self._stack.enter_context(page(running, "vr"))
        self.status: dict[str, Any] = dict.fromkeys(("armed", "leading", "mine", "refusal", "notice"), "")

    def close(self) -> None:
        self._stack.close()

    def send(self, message: Any) -> None:
        self.send_frame(json.dumps(message))

    def send_frame(self, content: str | bytes) -> None:
        self._socket.send(content)

    def hold(self, z: float, *, grip: bool, **more: Any) -> None:
        right = {"pose": [1, 0, 0, 0, 0.2, -0.3, z], "grip": grip, "buttons": [0.25]}
        self.send({"time": time.monotonic(), "head": None, "left": None, "right": right, **more})

    def until(self, condition: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
        """Read statuses until one fulfils the condition."""
        while not condition(self.status):
            assert (message := self._read())["type"] == "status", message
        return self.status

    def error(self) -> str:
        while (message := self._read())["type"] != "error":
            pass
        return str(message["error"])

    def _read(self) -> dict[str, Any]:
        message: dict[str, Any] = json.loads(self._socket.recv(PATIENCE))
        if message["type"] == "status":
            self.status = message
        return message

    def lead(self, z: float) -> None:
        self.send({"do": "arm"})
        self.until(lambda status: status["armed"])
        while not self.status["leading"]:  # Until the robot follows.
            self.hold(z, grip=False)
            self.until(lambda status: not status["refusal"])  # Each answer is waited for: nothing piles up.
            self.hold(z, grip=True)
            self.until(lambda status: status["leading"] or status["refusal"])


def test_frame_of_a_headset_that_is_no_message_is_answered(running: View) -> None:
    headset = Headset(running)
    for content, expected in NO_COMMANDS[:7]:
        headset.send_frame(content)
        assert headset.error().startswith(expected)
    headset.send({"do": "explode"})
    assert headset.error() == "there is no command 'explode'; there are: arm, disarm, leave"
    headset.send({"time": 10**400, "head": None})
    assert "cannot be understood" in headset.error()
    headset.send({"do": "arm"})
    assert headset.until(lambda status: status["armed"])
    headset.close()


@pytest.fixture(scope="module")
def opened() -> Iterator[View]:
    with view(PatientArm(), vr=True) as opened:
        yield opened


@pytest.fixture
def running(opened: View) -> Iterator[View]:
    """Yield a page of the arm, which no hand leads before or afterwards."""
    yield opened
    headset = Headset(opened)
    headset.send({"do": "disarm"})
    headset.send({"do": "nothing"})  # It is answered after what was sent before: the next test is not disarmed.
    assert "no command" in headset.error()
    headset.until(lambda status: status["armed"] is False and status["leading"] is False)
    headset.close()


def tip(values: Any) -> np.ndarray:
    return np.array(values["dps.impl.tip_pose"]).reshape(3, 4)[:, 3]


def becomes(condition: Callable[[], bool]) -> bool:
    limit = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < limit
        time.sleep(0.005)  # Leave the processor to the threads that bring it about.
    return True


def test_hand_leads_the_simulated_arm_and_holds_it(running: View) -> None:
    headset, session = Headset(running), running.session
    start = tip(session.snapshot().values)
    goal = start + np.array([0.0, 0.0, 0.05])
    headset.lead(1.0)
    assert headset.until(lambda status: status["mine"])["notice"] == "the right hand leads"
    headset.hold(1.05, grip=True)
    becomes(lambda: np.allclose(tip(session.snapshot().values), goal, atol=1e-3))
    np.testing.assert_allclose(session.snapshot().values["u.hand"][5:], goal, atol=1e-12)
    headset.hold(1.05, grip=False)
    headset.until(lambda status: not status["leading"])
    assert headset.status["armed"] and "holds its position" in headset.status["notice"]
    becomes(lambda: np.array_equal(session.snapshot().values["u.hand"], REST))
    headset.hold(1.5, grip=False)
    held = tip(session.snapshot().values)
    headset.send({"do": "disarm"})
    headset.until(lambda status: not status["armed"])
    np.testing.assert_allclose(tip(session.snapshot().values), held, atol=1e-3)
    headset.close()


def test_page_that_is_gone_leaves_nothing_commanded(running: View) -> None:
    watcher, headset, session = Headset(running), Headset(running), running.session
    headset.lead(1.0)
    headset.hold(1.3, grip=True)
    watcher.until(lambda status: status["leading"])
    watcher.hold(1.0, grip=False)
    watcher.hold(1.0, grip=True)
    assert watcher.until(lambda status: status["refusal"] != "")["refusal"] == "another headset leads"
    headset.close()
    status = watcher.until(lambda status: not status["leading"])
    assert not status["armed"] and "page of the headset is gone" in status["notice"]
    becomes(lambda: np.array_equal(session.snapshot().values["u.hand"], REST))
    watcher.close()


def test_headset_that_leaves_virtual_reality_disarms(running: View) -> None:
    headset = Headset(running)
    headset.lead(1.0)
    headset.send({"do": "leave"})
    headset.until(lambda status: not status["armed"])
    headset.close()


def test_what_cannot_be_understood_is_answered(running: View) -> None:
    headset = Headset(running)
    headset.send({"time": 1.0, "left": {"pose": [1, 2], "grip": True}})
    assert "cannot be understood" in headset.error()
    headset.send({"do": "jump"})
    assert "jump" in headset.error()
    headset.send([1, 2])
    assert headset.error()
    headset.close()


def test_socket_of_a_headset_is_protected(running: View) -> None:
    with pytest.raises(InvalidStatus) as refused:
        page(running, "vr", {"Origin": "http://evil.example"})
    assert refused.value.response.status_code == 403


def test_robot_that_no_hand_leads_is_an_error() -> None:
    with pytest.raises(ValueError, match=r"CartPoleScenario .* hand_command\(\) returns None"):
        view(CartPoleScenario(), vr=True)
    with pytest.raises(ValueError, match="led_by_hand=true"):
        view(ManipulatorScenario(), vr=True)
    with Hub(port=0) as hub, pytest.raises(ValueError, match=r"hand_command\(\) returns None"):
        view_loop(CartPoleScenario(), hub.url, vr=True)


class Toy(LedRobot):
    """A robot that keeps what it is sent, and can be in trouble."""

    def __init__(self) -> None:
        super().__init__(PatientArm())
        self.sent: list[dict[str, Any]] = []
        self.reason, self.is_deaf = "", False
        self.defect: Exception | None = None
        self.closed = False

    def read(self, addresses: tuple[str, ...]) -> dict[str, Any]:
        return {self.command.pose: np.eye(3, 4), **self.command.ready}

    def send(self, commands: Any) -> None:
        if self.defect is not None:
            raise self.defect
        if self.is_deaf:
            raise HandError("nobody listens")
        self.sent.append(dict(commands))

    def trouble(self) -> str:
        return self.reason

    def close(self) -> None:
        self.closed = True


def take(reality: VirtualReality, robot: Toy) -> None:
    reality.arm()
    for grip in (False, True):
        reality.receive("A", HandMessage(time.monotonic(), None, {"left": TOOL}, {"left": grip}, {"left": ()}))
    becomes(lambda: reality.status.leading and robot.sent[-1]["hand"][0] == 1.0)


def test_defect_of_a_robot_is_told_and_disarms(caplog: pytest.LogCaptureFixture) -> None:
    robot = Toy()
    reality = VirtualReality(robot, picture=lambda: "a picture")
    take(reality, robot)
    robot.defect = ZeroDivisionError("a gear of zero teeth")
    becomes(lambda: not reality.status.armed)
    assert reality.status.notice == "a gear of zero teeth"
    assert [record.levelname for record in caplog.records] == ["ERROR"]
    with pytest.raises(ZeroDivisionError, match="zero teeth"):
        reality.arm()
    assert not reality.status.armed
    robot.defect = None
    becomes(lambda: bool(robot.sent[-1]["hand"][0] == 0.0))  # It is released as soon as it can be.
    take(reality, robot)
    with pytest.raises(ZeroDivisionError):
        robot.defect = ZeroDivisionError()
        reality.arm()
    becomes(lambda: not reality.status.armed)
    reality.close()
    assert robot.closed


def test_request_after_the_end_is_refused() -> None:
    reality = VirtualReality(Toy(), picture=lambda: "a picture")
    reality.close()
    for request in (reality.arm, reality.disarm):
        with pytest.raises(HandError, match="the server has ended"):
            request()


def test_robot_in_trouble_is_released_and_not_armed() -> None:
    robot = Toy()
    reality = VirtualReality(robot, picture=lambda: "a picture")
    first = reality.status
    becomes(lambda: reality.status is not first)
    assert not robot.sent  # It is not commanded before a hand leads.
    take(reality, robot)
    robot.reason = "the fallbacks command: position is stale"
    becomes(lambda: not reality.status.armed and robot.sent[-1]["hand"][0] == 0.0)
    assert reality.status.notice == robot.reason
    with pytest.raises(HandError, match="stale"):
        reality.arm()
    robot.reason = ""
    take(reality, robot)
    robot.is_deaf = True  # It is told that it is released as soon as it listens again.
    becomes(lambda: not reality.status.armed)
    assert reality.status.notice == "nobody listens"
    robot.is_deaf = False
    becomes(lambda: bool(robot.sent[-1]["hand"][0] == 0.0))
    take(reality, robot)
    reality.close()
    assert robot.closed and robot.sent[-1]["hand"][0] == 0.0


@pytest.mark.slow
def test_page_that_hangs_is_released_and_a_headset_that_sleeps_is_disarmed() -> None:
    robot = Toy()
    robot.command = replace(robot.command, release_time=0.3)
    reality = VirtualReality(robot, picture=lambda: "a picture")
    reality.arm()
    notices = []
    for grip in (False, True):
        reality.receive("A", HandMessage(time.monotonic(), None, {"left": TOOL}, {"left": grip}, {"left": ()}))
    becomes(lambda: reality.status.leading)
    becomes(lambda: not reality.status.leading)
    notices.append(reality.status.notice)
    assert reality.status.armed
    becomes(lambda: not reality.status.armed)
    notices.append(reality.status.notice)
    reality.close()
    assert "no pose for 300 ms" in notices[0] and "silent for 2 s" in notices[1]


def test_head_and_buttons_are_commands_of_their_own() -> None:
    robot = Toy()
    robot.command = replace(robot.command, head="head", buttons="buttons")
    robot.idle = {**robot.idle, "head": np.zeros(7), "buttons": np.zeros(3)}
    reality = VirtualReality(robot, picture=lambda: "a picture")
    reality.arm()
    for grip in (False, True):
        message = HandMessage(time.monotonic(), TOOL, {"left": TOOL}, {"left": grip}, {"left": (0.5, 1.0)})
        reality.receive("A", message)
    becomes(lambda: reality.status.leading and robot.sent[-1]["hand"][0] == 1.0)
    np.testing.assert_array_equal(robot.sent[-1]["head"], [1, 0, 0, 0, 0.1, 0.2, 0.3])
    np.testing.assert_array_equal(robot.sent[-1]["buttons"], [0.5, 1.0, 0.0])
    reality.close()
    assert not robot.sent[-1]["head"].any() and not robot.sent[-1]["buttons"].any()


# -- the machine


@pytest.mark.slow
def test_hand_leads_the_arm_of_a_machine_process() -> None:
    scenario = PatientArm()
    deployment = Deployment.of(scenario).in_lock_step("wrench")
    with ExitStack() as stack:
        hub = stack.enter_context(Hub(port=0))
        stack.enter_context(MachineProcess(scenario, hub.url, lock_step=True))
        runtime: Runtime = stack.enter_context(scenario.deploy(hub.url, deployment=deployment, live=True))
        runtime.take_over()
        loop = threading.Thread(target=runtime.run)
        loop.start()
        stack.callback(loop.join)
        stack.callback(runtime.stop)
        dps = stack.enter_context(LiveClient(hub.url, timeout=PATIENCE))

        def value(address: str) -> np.ndarray:
            """Read when the loop has time for it: on a busy computer, it may refuse."""
            values: dict[str, Any] = {}

            def read() -> bool:
                with suppress(LiveError):
                    values.update(dps.get([address]))
                return bool(values)

            becomes(read)
            return np.asarray(values[address])

        with view_loop(scenario, hub.url, vr=True) as running:
            headset = Headset(running)
            headset.lead(1.0)
            start = value("dps.impl.tip_pose").reshape(3, 4)[:, 3]
            headset.hold(1.04, grip=True)
            becomes(lambda: bool(value("u.hand")[0] == 1.0))
            goal = start + np.array([0.0, 0.0, 0.04])
            becomes(lambda: np.allclose(value("dps.impl.tip_pose").reshape(3, 4)[:, 3], goal, atol=1e-3))
            assert np.array_equal(value("dps.impl.motion"), Motion.LED)
            kill(running.session.meshcat_url)
            assert "picture of the robot was lost" in headset.until(lambda status: not status["armed"])["notice"]
            becomes(lambda: np.array_equal(value("u.hand"), REST))
            headset.lead(1.0)
            becomes(lambda: bool(value("u.hand")[0] == 1.0))
            headset.close()  # The page is gone.
            becomes(lambda: np.array_equal(value("u.hand"), REST))
        steps = runtime.steps
        becomes(lambda: runtime.steps > steps + 300)
        assert not runtime.guards.latched and runtime.active == ("joint_torque",)
        velocity = np.array(runtime.bridge.sensed["joint_velocity"].value)
        assert np.abs(velocity).max() < 0.05
        # What the machine's own encoders say, by Drake's kinematics.
        testbed = scenario.build()
        plant = testbed.plant
        assert plant is not None
        context = plant.CreateDefaultContext()
        plant.SetPositions(context, np.array(runtime.bridge.sensed["joint_position"].value))
        place = plant.GetFrameByName("tip").CalcPoseInWorld(context).translation()
        np.testing.assert_allclose(place, goal, atol=5e-3)


def test_loop_that_does_not_answer_cannot_be_led() -> None:
    with Hub(port=0) as hub, view_loop(PatientArm(), hub.url, vr=True) as running:
        headset = Headset(running)
        headset.send({"do": "arm"})
        assert "start vtbdrake run" in headset.error()
        assert headset.until(lambda status: status["notice"] != "")["armed"] is False
        headset.close()


# -- https


def test_page_is_served_by_https_when_it_is_asked_for(tmp_path: Path) -> None:
    with Tls(name="127.0.0.1").files() as (certificate, key):
        assert key is not None
        copy(certificate, tmp_path / "certificate.pem")
        copy(key, tmp_path / "key.pem")
    assert not Path(certificate).exists()
    tls = Tls(name="127.0.0.1", certificate=tmp_path / "certificate.pem", key=tmp_path / "key.pem")
    context = ssl.create_default_context(cafile=str(tls.certificate))  # It checks the name in the certificate, too.
    with view(CartPoleScenario(), tls=tls) as running:
        assert urlsplit(running.url).scheme == "https"

        def ask(url: str, **headers: str) -> Any:
            request = urllib.request.Request(url, headers=headers)
            return urllib.request.urlopen(request, timeout=PATIENCE, context=context)

        url = entered(running.url, context=context)
        with ask(url) as answer:
            assert answer.status == 200 and b"page/view.js" in answer.read()
        with pytest.raises(urllib.error.HTTPError, match="403"):
            ask(url, Host="evil.example")
        with pytest.raises(urllib.error.HTTPError, match="403"):
            ask(f"{base(running)}session")


@pytest.mark.parametrize(
    ("tls", "message"),
    [
        (Tls(name="0.0.0.0"), "every interface"),
        (Tls(name="no.such.machine.invalid"), "no name or address of this machine"),
        (Tls(name="127.0.0.1", certificate=Path(__file__)), "cannot be used"),
    ],
)
def test_certificate_or_name_that_is_none_is_an_error(tls: Tls, message: str) -> None:
    with pytest.raises(TlsError, match=message):
        view(CartPoleScenario(), tls=tls)
