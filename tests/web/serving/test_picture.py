"""Tests of what happens when the Meshcat of a page dies: who lets go, what people are told, and what goes on."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import msgpack
import numpy as np
import pytest
from websockets.sync.client import ClientConnection, connect

from tests.meshcats import MALFORMED, kill, listening, meshcat_of
from tests.web.live.loops import cart_pole_loop
from tests.web.live.test_drive import COMMAND, LimitedPendulumScenario
from tests.web.live.test_session import ANGLE, MASS, STEP, angle, angle_by_hand, frame
from tests.web.live.test_session_server import PATIENCE, ask, page, receive
from tests.web.serving.entrance import entered
from tests.web.study.studies import cart_pole_problem
from tests.web.vr.test_virtual_reality import Headset, PatientArm, becomes
from vtbdrake.lcm.hub import Hub
from vtbdrake.testbed import VirtualTestbed
from vtbdrake.visualization.drawing import Drawing
from vtbdrake.web import LoopSession, SimulationSession, view, view_study
from vtbdrake.web.serving.host import Host
from vtbdrake.web.vr.virtual_reality import VirtualReality
from vtbdrake_diagrams.cart_pole import CartPoleScenario
from vtbdrake_diagrams.manipulator.leading import REST
from vtbdrake_diagrams.satellite import SatelliteScenario

ROOT = Path(__file__).resolve().parents[3]
CAMERA = "/Cameras/default/rotated/<object>"
CART = "/drake/now/cart_pole/cart"
DIED = "the server of the picture (Meshcat) has died"
END_TIME = 60.0  # s in which a process has to end; without the repair, it never does


def killed(session: SimulationSession, message: bytes = b"") -> None:
    """Kill the Meshcat of a session, and wait for the next one."""
    before = session.meshcat_url
    kill(before, message)
    becomes(lambda: session.meshcat_url not in ("", before))


def scene(socket: ClientConnection, path: str, kind: str = "set_transform") -> dict[str, Any]:
    """Return the next message of a kind about a path."""
    while True:
        message: dict[str, Any] = msgpack.unpackb(socket.recv(PATIENCE))
        if (message["type"], message.get("path")) == (kind, path):
            return message


def paths(url: str, *, until: str) -> set[str]:
    """Return the paths of the objects of a Meshcat up to one of them."""
    found = {""}
    with connect(url.replace("http", "ws", 1), max_size=None, max_queue=None, proxy=None) as socket:
        while not any(path.startswith(until) for path in found):
            message = msgpack.unpackb(socket.recv(PATIENCE))
            if message["type"] == "set_object":
                found.add(message["path"])
    return found


@pytest.mark.parametrize("message", [b"", pytest.param(MALFORMED, marks=pytest.mark.slow)])
def test_simulation_goes_on_in_another_meshcat(message: bytes) -> None:
    with SimulationSession(CartPoleScenario(), values={ANGLE: 2.0}) as session:
        session.advance(10)
        session.write({MASS: 0.4}, compare=True)
        killed(session, message)
        session.advance(30)
        shown = frame(session, lambda shown: shown.time == 40 * STEP)
        assert shown.picture.startswith(DIED) and f"t = {10 * STEP:.2f} s" in shown.picture and not shown.failure
        assert angle(session) == angle_by_hand(40, {10: {MASS: 0.4}})
        # The robot, and the ghost of the course without the change.
        assert paths(session.meshcat_url, until="/drake/now") and paths(session.meshcat_url, until="/drake/ghosts")
        session.reset()
        assert frame(session, lambda shown: shown.time == 0.0).picture == ""


@pytest.mark.slow
def test_layers_are_drawn_again_and_a_failed_simulation_has_a_picture_too() -> None:
    with SimulationSession(SatelliteScenario()) as session:
        session.show("me", ["cameras"])
        killed(session)
        assert paths(session.meshcat_url, until="/drake/layers/cameras")
    with SimulationSession(CartPoleScenario()) as session:
        session.write({"sim.sys.cart_pole.pole_pin.velocity": 1e200})
        session.advance(10)
        frame(session, lambda shown: bool(shown.failure))
        killed(session)
        assert paths(session.meshcat_url, until="/drake/now")
        session.reset()
        session.advance(3)
        assert not frame(session, lambda shown: shown.time == 3 * STEP).failure


def test_drive_is_released_and_paused() -> None:
    with SimulationSession(LimitedPendulumScenario()) as session:
        session.drive([COMMAND])
        session.deflect({COMMAND: 1.0})
        session.play()
        frame(session, lambda shown: bool(shown.drive and shown.drive["seconds"] > 0.0))
        killed(session)
        assert not session.latest.playing or frame(session, lambda shown: not shown.playing)
        held = session.latest.drive["values"][COMMAND]
        session.advance(20)
        assert frame(session, lambda shown: not shown.playing).drive["values"][COMMAND] == held


def test_meshcat_that_dies_in_the_middle_of_a_frame_is_no_failure_of_the_simulation(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with SimulationSession(CartPoleScenario()) as session:
        pose, before = Drawing.pose, session.meshcat_url

        def die(drawing: Drawing, *arguments: Any, **options: Any) -> None:
            monkeypatch.setattr(Drawing, "pose", pose)
            kill(before)
            pose(drawing, *arguments, **options)  # Every method of its Meshcat raises.

        monkeypatch.setattr(Drawing, "pose", die)
        becomes(lambda: session.meshcat_url not in ("", before))
        session.advance(5)
        assert not frame(session, lambda shown: shown.time == 5 * STEP).failure


def test_picture_of_a_loop_goes_on() -> None:
    with (
        Hub(port=0) as hub,
        cart_pole_loop(hub.url, lambda _: {"joint_position": [0.3, 0.0], "joint_velocity": [0.0, 0.0]}),
        LoopSession(CartPoleScenario(), hub.url) as session,
    ):
        frame(session, lambda shown: shown.playing)
        killed(session)
        assert frame(session, lambda shown: bool(shown.picture)).picture.startswith(DIED)
        with connect(session.meshcat_url.replace("http", "ws", 1), max_size=None, max_queue=None, proxy=None) as socket:
            while abs(scene(socket, CART)["matrix"][12] - 0.3) > 1e-6:
                pass


def test_loop_whose_picture_stands_still_is_not_led(monkeypatch: pytest.MonkeyPatch) -> None:
    """The belief cannot be drawn, while values still arrive."""
    with (
        Hub(port=0) as hub,
        cart_pole_loop(hub.url, lambda _: {"joint_position": [0.3, 0.0], "joint_velocity": [0.0, 0.0]}),
        LoopSession(CartPoleScenario(), hub.url) as session,
    ):
        becomes(lambda: session.latest.playing and not session.trouble)

        def refuse(*_: Any, **__: Any) -> None:
            raise ValueError("it does not know where it is")

        monkeypatch.setattr(VirtualTestbed, "belief_of", refuse)
        becomes(lambda: bool(session.trouble))
        assert session.trouble == "the picture stands still: it does not know where it is for 2 s"


def test_hand_is_disarmed_and_leads_again_in_the_next_picture() -> None:
    with view(PatientArm(), vr=True) as running:
        headset, session = Headset(running), running.session
        headset.lead(1.0)
        killed(session)
        status = headset.until(lambda status: not status["armed"])
        assert not status["leading"] and status["notice"].startswith("the picture of the robot was lost")
        becomes(lambda: np.array_equal(session.snapshot().values["u.hand"], REST))
        # Time runs on, and a grip that is still held leads nothing.
        when = session.latest.time
        headset.hold(1.3, grip=True)
        assert frame(session, lambda shown: shown.time > when and shown.playing).picture.startswith(DIED)
        assert not headset.until(lambda status: status["refusal"] != "")["leading"]
        headset.lead(1.0)
        headset.close()


def test_robot_without_a_picture_is_not_armed() -> None:
    from tests.web.vr.test_virtual_reality import Toy
    from vtbdrake.web.vr.hand import HandError

    pictures = ["first"]
    reality = VirtualReality(Toy(), picture=lambda: pictures[-1])
    reality.arm()
    pictures.append("")
    becomes(lambda: not reality.status.armed)
    with pytest.raises(HandError, match="the picture of the robot was lost"):
        reality.arm()
    pictures.append("second")
    reality.arm()
    becomes(lambda: reality.status.armed)
    reality.close()


def test_browser_stays_connected_and_sees_the_next_meshcat() -> None:
    with view(CartPoleScenario()) as running, page(running, "") as socket, page(running) as told:
        scene(socket, CAMERA, "set_property")
        scene(socket, CART)
        killed(running.session)
        scene(socket, "/drake", "delete")
        seen = set()
        while CART not in seen:
            message = msgpack.unpackb(socket.recv(PATIENCE))
            seen.add(message.get("path", message["type"]))
        # A person may have moved the camera since.
        assert CAMERA not in seen and "set_target" not in seen
        while not receive(told, "frame")["picture"].startswith(DIED):
            pass
        status, text, _ = ask(entered(running.url))
        assert status == 200 and "viewer" in text


@pytest.mark.slow
def test_page_that_is_loaded_while_there_is_no_meshcat_waits_for_the_next() -> None:
    with SimulationSession(CartPoleScenario()) as session:
        dead, waited = "http://127.0.0.1:1", []

        def address() -> str:
            waited.append(True)
            return dead if len(waited) < 4 else session.meshcat_url

        host = Host(address)
        try:
            status, text, _ = ask(entered(host.address()))
            assert status == 200 and "viewer" in text and len(waited) == 4
            waited.clear()
            relayed = entered(host.address()).replace("http", "ws", 1)
            with connect(relayed, max_size=None, max_queue=None, proxy=None) as socket:
                scene(socket, CAMERA, "set_property")  # It was not shown anything yet, and gets the camera, too.
        finally:
            host.close()


@pytest.mark.slow
def test_rollouts_of_a_study_are_drawn_again(tmp_path: Path) -> None:
    path = tmp_path / "cart.db"
    with cart_pole_problem().study(path, solver="sobol", seed=2) as study:
        study.run(rollouts=2, executor="serial", progress=False)
    with view_study(path) as opened, page(opened) as socket:
        socket.send(json.dumps({"id": 1, "do": "show", "role": "best", "trial": 0}))
        assert receive(socket, "answer")["error"] == ""
        before = opened.scene.meshcat_url
        kill(before)
        assert receive(socket, "picture")["notice"].startswith(DIED)
        assert opened.scene.meshcat_url != before
        assert paths(opened.scene.meshcat_url, until="/drake/study/best")
        socket.send(json.dumps({"id": 2, "do": "time", "time": 0.5}))
        assert receive(socket, "answer")["error"] == ""


# -- processes


@contextmanager
def command(*arguments: object) -> Iterator[subprocess.Popen[str]]:
    line = [sys.executable, "-m", "vtbdrake", *map(str, arguments), "--no-browser"]
    with subprocess.Popen(line, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as program:
        try:
            yield program
        finally:
            program.kill()


@pytest.mark.slow
@pytest.mark.parametrize("shown", ["view", "study open"])
def test_ctrl_c_ends_the_command_whose_meshcat_has_died(shown: str, tmp_path: Path) -> None:
    arguments: list[object] = ["view", "vtbdrake_diagrams.cart_pole:CartPoleScenario", "--play"]
    if shown == "study open":
        path = tmp_path / "cart.db"
        with cart_pole_problem().study(path, solver="sobol", seed=2) as study:
            study.run(rollouts=2, executor="serial", progress=False)
        arguments = ["study", "open", path, "--trust", "tests.web.study.studies"]
    with command(*arguments) as program:
        assert program.stdout is not None
        url = program.stdout.readline().strip()
        dead = meshcat_of(program.pid)
        kill(dead)
        becomes(lambda: dead not in listening(program.pid) and len(listening(program.pid)) == 2)
        again = meshcat_of(program.pid)
        kill(again)  # The next one too, and at once the end: it may be noticed by then or not.
        program.send_signal(signal.SIGINT)
        text, _ = program.communicate(timeout=END_TIME)
        assert program.returncode == 0, text
        # Where Meshcat listens is told nobody.
        for address in (dead, again):
            assert (urlsplit(address).hostname or "") not in url + text
