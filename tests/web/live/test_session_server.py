"""Tests of the server: who may use it, what its sockets answer, and what it keeps from Meshcat."""

from __future__ import annotations

import asyncio
import json
import random
import socket as socketlib
import threading
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import msgpack
import pytest
import uvicorn
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import SpatialInertia
from pydrake.systems.framework import Context, LeafSystem
from websockets.client import ClientProtocol
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.frames import Frame, Opcode
from websockets.http11 import Response
from websockets.sync.client import ClientConnection, connect
from websockets.uri import parse_uri

from tests.testbeds import PendulumScenario
from tests.web.live.test_drive import LimitedPendulumScenario, problem
from tests.web.serving.entrance import entered
from vtbdrake.state.multibody import multibody_variables
from vtbdrake.testbed import VirtualTestbedBuilder
from vtbdrake.web import View, view
from vtbdrake.web.live.watching import describe
from vtbdrake.web.serving import requests as requests_module
from vtbdrake.web.serving.host import Host, PortError
from vtbdrake.web.serving.relay import Newest, relay
from vtbdrake_diagrams.cart_pole import CartPoleScenario

ANGLE = "sim.sys.cart_pole.pole_pin.position"
PATIENCE = 60.0


class Hanging(LeafSystem):
    """Hangs in the first step, until it is told to end."""

    begun, ended = threading.Event(), threading.Event()

    def __init__(self) -> None:
        super().__init__()
        self.DeclarePeriodicPublishEvent(1e-3, 1e-3, self._hang)

    def _hang(self, context: Context) -> None:
        self.begun.set()
        self.ended.wait()


@dataclass
class HangingScenario(PendulumScenario):
    def add_world(self, builder: VirtualTestbedBuilder) -> None:
        super().add_world(builder)
        builder.add("sys", "hanging", Hanging())


@pytest.fixture(scope="module")
def running() -> Iterator[View]:
    with view(CartPoleScenario()) as opened:
        yield opened


def ask(url: str, headers: dict[str, str] | None = None) -> tuple[int, str, Any]:
    """Status, body and headers of an answer."""
    try:
        with urllib.request.urlopen(urllib.request.Request(url, headers=headers or {}), timeout=PATIENCE) as answer:
            return answer.status, answer.read().decode(), answer.headers
    except urllib.error.HTTPError as error:
        return error.code, error.read().decode(), error.headers


def base(running: View) -> str:
    return running.url.split("#")[0]


def page(running: View, path: str = "session", headers: dict[str, str] | None = None) -> ClientConnection:
    url = entered(running.url).replace("http", "ws", 1) + path
    return connect(url, additional_headers=headers, max_size=None, open_timeout=PATIENCE)


@contextmanager
def steering(running: View) -> Iterator[ClientConnection]:
    """Open a page that steers: the server may still be taking leave of the one before."""
    with page(running) as socket:
        while not receive(socket, "frame")["steers"]:
            pass
        yield socket


def receive(socket: ClientConnection, kind: str) -> dict[str, Any]:
    while True:
        message: dict[str, Any] = json.loads(socket.recv(PATIENCE))
        if message["type"] == kind:
            return message


def command(socket: ClientConnection, do: str, **fields: Any) -> str:
    """The error that a command brings; empty if it is carried out."""
    socket.send(json.dumps({"id": 1, "do": do, **fields}))
    return str(receive(socket, "answer")["error"])


def test_only_who_has_a_ticket_gets_the_page(running: View) -> None:
    url = entered(running.url)
    status, text, headers = ask(url)
    assert status == 200 and "viewer" in text and 'src="page/view.js"' in text
    assert headers["content-security-policy"] == "frame-ancestors 'none'"
    assert headers["referrer-policy"] == "no-referrer" and headers["set-cookie"] is None
    assert ask(f"{url}page/view.js")[0] == 200
    for path in ("page/view.js", "cas-v1/anything", "camera/front", "wrong/", f"{url.split('/')[-2]}"):
        status, text, _ = ask(base(running) + path)
        assert status == 403 and "open an address that vtbdrake has printed" in text
    status, text, _ = ask(base(running))
    assert status == 200 and "viewer" not in text  # the entrance


def test_page_of_a_simulation_that_hangs_can_be_closed(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(requests_module, "LONGEST_END", 0.5)
    Hanging.begun.clear()
    Hanging.ended.clear()
    release = threading.Timer(30.0, Hanging.ended.set)
    before = threading.enumerate()
    opened = view(HangingScenario())
    threads = [thread for thread in threading.enumerate() if thread not in before]
    with page(opened) as socket:
        socket.send(json.dumps({"id": 1, "do": "step"}))
        assert Hanging.begun.wait(PATIENCE)
        release.start()
        opened.close()
        assert not Hanging.ended.is_set()
    for part in ("the page's server", "the session's simulation"):
        assert f"{part} does not end within 0.5 s" in caplog.text
    release.cancel()
    Hanging.ended.set()
    for thread in threads:
        if thread.name.startswith("vtbdrake"):
            thread.join(PATIENCE)
            assert not thread.is_alive()


def test_foreign_host_and_foreign_origin_are_refused(running: View) -> None:
    url = entered(running.url)
    status, text, _ = ask(url, {"Host": "evil.example"})  # a name that was bound to 127.0.0.1 later
    assert status == 403 and "not reached as 'evil.example'" in text
    status, text, _ = ask(url, {"Origin": "http://evil.example"})
    assert status == 403 and "pages of http://evil.example" in text
    assert ask(url, {"Origin": base(running).rstrip("/")})[0] == 200
    for path in ("", "session"):
        with pytest.raises(InvalidStatus) as refused:
            page(running, path, {"Origin": "http://evil.example"})
        assert refused.value.response.status_code == 403
    with pytest.raises(InvalidStatus), connect(base(running).replace("http", "ws", 1) + "session"):
        pass


@pytest.mark.parametrize("path", ["", "session"])
def test_page_that_answers_no_ping_stays_connected(path: str, monkeypatch: pytest.MonkeyPatch) -> None:
    quick = partial(uvicorn.Config, ws_ping_interval=0.02, ws_ping_timeout=0.02)
    monkeypatch.setattr("vtbdrake.web.serving.host.uvicorn.Config", quick)
    with view(CartPoleScenario()) as opened:
        client = ClientProtocol(parse_uri(entered(opened.url).replace("http", "ws", 1) + path))
        request = client.connect()
        client.send_request(request)
        parts = urlsplit(opened.url)
        assert parts.hostname is not None and parts.port is not None
        with socketlib.create_connection((parts.hostname, parts.port), PATIENCE) as socket:
            socket.sendall(b"".join(client.data_to_send()))
            pings = 0
            while pings < 20:
                data = socket.recv(65536)
                assert data, "the server has closed the connection"
                client.receive_data(data)
                for event in client.events_received():
                    if isinstance(event, Frame):
                        assert event.opcode is not Opcode.CLOSE
                        pings += event.opcode is Opcode.PING
                    else:
                        assert isinstance(event, Response) and event.status_code == 101
                client.data_to_send()  # Its answers to pings, which are not sent.


def test_port_in_use_is_an_error(running: View) -> None:
    with pytest.raises(PortError, match=r"port \d+ cannot be used .*: give another one"):
        view(CartPoleScenario(), port=urlsplit(running.url).port or 0)


def test_entries_of_a_pose_have_units_of_their_own() -> None:
    plant = MultibodyPlant(0.01)
    plant.AddRigidBody("stone", SpatialInertia.SolidSphereWithMass(1.0, 0.1))
    plant.Finalize()
    position = next(v for v in multibody_variables(plant) if v.shape == (7,))
    described = describe(position)
    assert (described["unit"], described["units"]) == ("1, m", ["1"] * 4 + ["m"] * 3)
    assert described["entries"] == ["qw", "qx", "qy", "qz", "x", "y", "z"]


def test_page_watches_and_steers(running: View) -> None:
    with page(running) as socket:
        hello = receive(socket, "hello")
        while not receive(socket, "frame")["steers"]:
            pass  # The page of an earlier test may not have gone yet.
        assert hello["variables"][ANGLE] == {
            "kind": "x", "shape": [], "unit": "rad", "units": [], "bounds": [[None], [None]], "settable": True,
            "entries": [], "choices": [],
        }  # fmt: skip
        assert hello["variables"]["u.plan"]["entries"][:2] == ["start", "force 1"]
        assert [choice["name"] for choice in hello["variables"]["T_act.force"]["choices"]] == ["sim", "real", "twin"]
        assert hello["opening"] == ["u.plan", "sim.sys.cart_pole.cart_slider.position", ANGLE]
        assert command(socket, "watch", addresses=[ANGLE]) == ""
        assert command(socket, "write", values={ANGLE: 0.5}) == ""
        while (frame := receive(socket, "frame"))["values"] != {ANGLE: 0.5}:
            pass
        assert frame["steers"] and not frame["playing"]
        assert command(socket, "step", steps=3) == ""
        assert running.session.snapshot().time == 3 * running.session.config.step
        assert "no variable" in command(socket, "write", values={"nothing": 1.0})
        assert "there is no command 'explode'" in command(socket, "explode")
        assert command(socket, "seek") == "it lacks 'time'"
        assert command(socket, "reset") == ""


# Frames of every kind that are no command, and what is answered.
NO_COMMANDS = [
    (b"\x00\xff", "a command is a frame of text, not of bytes"),
    (b"", "a command is a frame of text, not of bytes"),
    ("", "a command is a JSON object (Expecting value"),
    ("[1", "a command is a JSON object (Expecting ',' delimiter"),
    ("[1]", "a command is a JSON object, not [1]"),
    ("null", "a command is a JSON object, not None"),
    ("[" * 100_000, "a command is a JSON object (maximum recursion depth"),
    ("{}", "there is no command None; there are: "),
    ('{"do": ["pause"]}', "there is no command ['pause']; there are: "),
    (json.dumps({"do": "x" * 1_000_000}), "there is no command 'xxxxxxxxxxxx...xxxxxxxxxxxxx'; there are: "),
]


@pytest.mark.parametrize(("content", "expected"), NO_COMMANDS)
def test_frame_that_is_no_command_is_answered_and_closes_nothing(
    running: View, content: str | bytes, expected: str, caplog: pytest.LogCaptureFixture
) -> None:
    with steering(running) as socket:
        socket.send(content)
        answer = receive(socket, "answer")
        assert answer["error"].startswith(expected) and answer["id"] is None and len(answer["error"]) < 1000
        for number in ("1e999", "NaN", '"a"', "[]"):
            socket.send(f'{{"id": {number}, "do": "pause"}}')
            answer = receive(socket, "answer")
            assert (answer["id"], answer["error"]) == (None, "")
        assert command(socket, "pause") == ""
    assert not [record for record in caplog.records if record.exc_info]


def test_page_that_drives_and_falls_silent_lets_go() -> None:
    with view(LimitedPendulumScenario(), problem=problem(horizon=600.0)) as running, page(running) as socket:
        assert command(socket, "drive", addresses=["T_act.torque.idle"], returning=["T_act.torque.idle"]) == ""
        assert command(socket, "play") == ""
        assert command(socket, "deflect", deflections={"T_act.torque.idle": 1.0}) == ""
        while (frame := receive(socket, "frame"))["playing"] or not frame["drive"]["notice"]:
            pass
        assert frame["drive"]["notice"] == "the page that drove was silent for 1 s"
        stopped = frame["time"]
        assert command(socket, "step", steps=400) == ""
        while (frame := receive(socket, "frame"))["time"] == stopped:
            pass
        assert frame["drive"]["values"]["T_act.torque.idle"] == [0.0]
        assert command(socket, "end_drive", keep=True) == ""


def test_page_that_only_watches_a_drive_lets_nothing_go(running: View) -> None:
    with steering(running) as socket:
        assert command(socket, "deflect", deflections={}) == ""  # Nothing is driven.
        with page(running) as other:
            assert command(other, "take over") == ""
            assert "another page steers" in command(socket, "deflect", deflections={})


def test_speed_without_a_limit_has_a_word_that_json_knows(running: View) -> None:
    with page(running) as socket:
        for speed, shown in ((float("inf"), "unlimited"), (2.5, 2.5), (1.0, 1.0)):
            running.session.set_speed(speed)
            # The first frames may be older than the command.
            assert shown in (receive(socket, "frame")["speed"] for _ in range(20))


def test_meshcat_that_has_ended_is_told_to_the_browser(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vtbdrake.web.serving.host.NEXT_MESHCAT_TIME", 0.2)

    async def nothing(_: Any) -> None: ...

    with socketlib.socket() as closed:
        closed.bind(("127.0.0.1", 0))  # which does not listen
        address = f"http://127.0.0.1:{closed.getsockname()[1]}"
        host = Host(lambda: address, script="view.js", serve=nothing)
        url = entered(host.address())
        try:
            for path in ("", "favicon.ico"):
                status, text, _ = ask(url + path)
                assert status == 502 and "Meshcat does not answer: " in text
        finally:
            host.close()


def test_one_page_steers_and_the_others_watch(running: View) -> None:
    with steering(running) as first:
        with page(running) as second:
            assert command(first, "pause") == ""
            assert command(second, "pause") == "another page steers this session: take over first"
            assert command(second, "watch", addresses=[ANGLE]) == ""
            assert command(second, "take over") == ""
            assert command(second, "pause") == ""
            assert "another page steers" in command(first, "pause")
        # The one that has steered is gone.
        while not receive(first, "frame")["steers"]:
            pass
        assert command(first, "pause") == ""


def test_meshcat_is_shown_and_gets_nothing_from_the_browser(running: View) -> None:
    with page(running, "") as socket:
        scene = {}
        while "/drake/now/cart_pole/pole" not in scene:
            message = msgpack.unpackb(socket.recv(PATIENCE))
            scene[message.get("path")] = message["type"]
        socket.send(msgpack.packb({"type": "button", "name": "Stop Simulation"}))
        running.session.advance()
        while msgpack.unpackb(socket.recv(PATIENCE)).get("path") != "/drake/now/cart_pole/pole":
            pass


def test_closed_view_closes_its_pages() -> None:
    opened = view(CartPoleScenario())
    with page(opened) as socket:
        opened.close()
        with pytest.raises(ConnectionClosed):
            while True:
                socket.recv(PATIENCE)
    with pytest.raises(urllib.error.URLError):
        ask(base(opened))


@pytest.mark.slow
def test_page_that_does_not_read_holds_nobody_up() -> None:
    with view(CartPoleScenario()) as running, page(running, ""), page(running) as hung:
        receive(hung, "frame")
        assert command(hung, "play") == ""
        # From here on, neither its scene nor its frames are read; it still steers.
        with page(running) as other:
            first = receive(other, "frame")
            assert not first["steers"]
            while receive(other, "frame")["time"] < first["time"] + 0.5:
                pass
            assert command(other, "take over") == "" and command(other, "pause") == ""
            when = running.session.snapshot().time
            assert running.session.snapshot().time == when


@pytest.mark.parametrize("is_killed", [False, True])
def test_paused_view_ends_in_silence_after_its_browser(is_killed: bool, capfd: pytest.CaptureFixture[str]) -> None:
    opened = view(CartPoleScenario())
    with page(opened, "") as scene, page(opened) as session:
        scene.recv(PATIENCE)
        receive(session, "frame")
        if is_killed:
            for socket in (scene, session):
                socket.socket.shutdown(socketlib.SHUT_RDWR)
        opened.close()
    assert capfd.readouterr().err == ""


# -- transforms that wait


def scene_after(messages: list[dict[str, Any]]) -> dict[str, Any]:
    """The last transform and object of each path, and its properties, as a browser keeps them."""
    scene: dict[str, Any] = {}
    for message in messages:
        if message["type"] == "delete":
            scene = {path: value for path, value in scene.items() if not path.startswith(message["path"])}
        else:
            scene.setdefault(message["path"], {})[message["type"], message.get("property")] = message["value"]
    return scene


@pytest.mark.one_python
def test_poses_for_a_browser_that_hangs_take_no_memory() -> None:
    poses = [{"type": "set_transform", "path": f"/drake/{number % 5}", "matrix": [number]} for number in range(5000)]
    messages, awake, sent = iter([*poses, {"type": "delete", "path": "/end"}]), asyncio.Event(), []

    async def receive() -> bytes:
        message = next(messages, None)
        if message is None:
            awake.set()
            await asyncio.Event().wait()
        return msgpack.packb(message)  # type: ignore[no-any-return]

    async def send(data: bytes) -> None:
        await awake.wait()
        sent.append(msgpack.unpackb(data))
        if sent[-1]["type"] == "delete":
            raise OSError("the browser is gone")

    asyncio.run(asyncio.wait_for(relay(receive, send), PATIENCE))
    assert sent[-6:-1] == poses[-5:] and len(sent) <= 7  # At most one was under way.


@pytest.mark.one_python
def test_browser_whose_loss_is_noticed_in_the_next_turn_gets_nothing_more() -> None:
    messages, sent = [msgpack.packb({"type": "delete", "path": f"/{number}"}) for number in range(20)], 0

    async def receive() -> bytes:
        if not messages:
            await asyncio.Event().wait()
        return messages.pop()  # type: ignore[no-any-return]

    async def send(_: bytes) -> None:
        nonlocal sent
        if is_lost:
            raise OSError("the browser is gone")
        sent += 1
        asyncio.get_running_loop().call_soon(is_lost.append, True)

    is_lost: list[bool] = []
    asyncio.run(asyncio.wait_for(relay(receive, send), PATIENCE))
    assert sent == 1


@pytest.mark.one_python
@pytest.mark.parametrize("seed", range(20))
def test_slow_browser_ends_with_the_same_scene(seed: int) -> None:
    rng, queue, sent, received = random.Random(seed), Newest(), [], []
    for number in range(300):
        kind = rng.choices(["set_transform", "set_object", "set_property", "delete"], [20, 2, 4, 1])[0]
        message = {"type": kind, "path": f"/drake/{rng.choice('ab')}/{rng.choice('xyz')}"}
        message |= {"property": rng.choice(["scale", "visible"])} if kind == "set_property" else {}
        message["value"] = rng.randrange(3) if kind == "set_transform" else number  # Most poses stay as they are.
        if kind == "delete":
            message["path"] = message["path"][:8]
        sent.append(message)
        queue.put(msgpack.packb(message))
        if rng.random() < 0.1:
            received.append(msgpack.unpackb(queue.get_nowait()))
    while queue:
        received.append(msgpack.unpackb(queue.get_nowait()))
    assert scene_after(received) == scene_after(sent)
    assert len(received) + queue.replaced == 300 and queue.replaced > 50


@pytest.mark.one_python
def test_arrows_and_scans_do_not_queue_up_for_a_slow_browser() -> None:
    queue = Newest()
    for number in range(100):
        for message in (
            {"type": "set_transform", "path": "/drake/now/robot", "matrix": [float(number)] * 16},
            {"type": "set_property", "path": "/drake/layers/forces/arrow", "property": "scale", "value": [1.0, number]},
            {"type": "set_property", "path": "/drake/layers/forces/arrow", "property": "visible", "value": True},
            {"type": "set_object", "path": "/drake/layers/laser/points", "object": {"points": b"x" * 10_000}},
        ):
            queue.put(msgpack.packb(message))
    # The first object may need what came before it.
    assert len(queue) <= 7


def test_page_drives_and_a_page_that_is_gone_releases_its_keys(tmp_path: Path) -> None:
    with view(LimitedPendulumScenario(), problem=problem(), folder=tmp_path) as running:
        with page(running) as socket:
            hello = receive(socket, "hello")
            assert hello["quality"] == "magnitude"
            assert [handle["address"] for handle in hello["handles"]] == ["u.angle", "T_act.torque.idle"]
            assert command(socket, "end_drive", keep=True) == "nothing is driven: take over first"
            assert command(socket, "drive", addresses=["u.angle"]) == ""
            assert command(socket, "deflect", deflections={"u.angle": 1.0}) == ""
            assert command(socket, "step", steps=8) == ""
            assert "1 numbers from -1 to 1" in command(socket, "deflect", deflections={"u.angle": 2.0})
        moved = 0.8 * 8 * running.session.config.step
        with steering(running) as socket:
            assert command(socket, "step", steps=8) == ""
            assert running.session.snapshot()["u.angle"] == pytest.approx(moved)
            socket.send(json.dumps({"id": 2, "do": "end_drive", "keep": True}))
            driven = receive(socket, "answer")["result"]
            assert (driven["seconds"], driven["end"], driven["failed"]) == (0.125, "ended by hand", False)
            assert command(socket, "save_test", name="left") == ""
            assert "small letters, digits" in command(socket, "save_test", name="../left")
            assert "is not overwritten" in command(socket, "save_test", name="left")
            assert sorted(file.name for file in tmp_path.iterdir()) == ["test_left.py", "test_left.vtb"]
