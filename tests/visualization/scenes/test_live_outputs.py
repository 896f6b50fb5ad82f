"""Live outputs, met by real clients: a WebSocket of Foxglove's protocol, and Rerun's own client."""

from __future__ import annotations

import json
import os
import re
import signal
import socket
import struct
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import foxglove
import numpy as np
import pytest
from mcap.records import Schema
from mcap_protobuf.decoder import DecoderFactory
from pydrake.systems.analysis import Simulator
from websockets.sync.client import ClientConnection, connect

from tests.cli.program import ROOT
from tests.visualization.scenes.reading import Recording, world_poses
from tests.visualization.scenes.shapes import SHAPES, ShapesScenario
from vtbdrake.testbed import VirtualTestbed
from vtbdrake.visualization import FoxgloveServer, RerunServer, SceneWriter
from vtbdrake.web.live.simulation_session import SimulationSession

PATIENCE = 60.0  # s
MOVING = ("world/arm/link", "world/arm/link/slider", "world/arm/ball")


class Client:
    """A client of Foxglove's WebSocket protocol that subscribes to all channels."""

    def __init__(self, connection: ClientConnection) -> None:
        self._connection = connection
        self._channels: dict[int, tuple[str, Any]] = {}
        self.messages: dict[str, list[tuple[int, Any]]] = {}

    def receive(self) -> str:
        """Receive one message; return the topic, or the operation."""
        received = self._connection.recv(timeout=PATIENCE)
        if isinstance(received, str):
            message = json.loads(received)
            for channel in message.get("channels", ()):
                self._subscribe(channel)
            return str(message["op"])
        code, subscription, time = struct.unpack("<BIQ", received[:13])
        assert code == 1
        topic, decode = self._channels[subscription]
        self.messages.setdefault(topic, []).append((time, decode(received[13:])))
        return topic

    def receive_until(self, topic: str, time: int = 0) -> None:
        """Receive until a message of a topic has come that is as late as a time in ns."""
        while not any(at >= time for at, _ in self.messages.get(topic, ())):
            self.receive()

    def _subscribe(self, channel: dict[str, Any]) -> None:
        number, name = channel["id"], channel["schemaName"]
        if channel["encoding"] == "json":
            decode = json.loads
        else:
            schema = getattr(foxglove.messages, name.removeprefix("foxglove.")).get_schema()
            record = Schema(id=number, name=name, encoding="protobuf", data=schema.data)
            decode = DecoderFactory().decoder_for("protobuf", record)
        self._channels[number] = channel["topic"], decode
        subscription = {"op": "subscribe", "subscriptions": [{"id": number, "channelId": number}]}
        self._connection.send(json.dumps(subscription))


@contextmanager
def client_of(address: str) -> Iterator[Client]:
    with connect(address, subprotocols=["foxglove.sdk.v1"], max_size=None, open_timeout=PATIENCE) as connection:
        yield Client(connection)


@pytest.fixture(scope="module")
def testbed() -> VirtualTestbed:
    return ShapesScenario().build()


def simulated(testbed: VirtualTestbed, writer: SceneWriter) -> Simulator:
    simulator = testbed.simulator()
    simulator.set_monitor(writer.monitor)
    simulator.AdvanceTo(0.1)
    return simulator


def listening(port: int) -> set[str]:
    """Return the addresses at which this machine listens at a port, as Linux tells."""
    lines = [line.split() for name in ("tcp", "tcp6") for line in Path(f"/proc/net/{name}").read_text().split("\n")[1:]]
    places = [line[1].split(":") for line in lines if line and line[3] == "0A"]
    return {address for address, number in places if int(number, 16) == port}


def test_client_of_foxglove_gets_the_scene_and_the_poses_from_when_it_comes(testbed: VirtualTestbed) -> None:
    with FoxgloveServer(0) as server:
        assert listening(server.port) == {"0100007F"}  # 127.0.0.1
        writer = SceneWriter(testbed, server)
        simulator = simulated(testbed, writer)
        with client_of(server.address) as client:
            # What was written before it came: the newest of each stream.
            for topic in ("/scene", "/tf_static", "/tf", "/joint_states", "/sense/joint_position"):
                client.receive_until(topic)
            simulator.AdvanceTo(0.3)
            for _ in range(3):  # What stands still is not written again.
                writer.write(simulator.get_context())
            client.receive_until("/tf", 3 * 10**8)
            client.receive_until("/sense/joint_position", 3 * 10**8)
            plant = testbed.plant
            plant_context = plant.GetMyContextFromRoot(simulator.get_context())
            poses = world_poses(client.messages, 3 * 10**8)
            for body in ("link", "slider", "tool", "ball"):
                X_WB = plant.EvalBodyPoseInWorld(plant_context, plant.GetBodyByName(body))
                assert poses[f"arm/{body}"].IsNearlyEqualTo(X_WB, 1e-12)
            simulator.AdvanceTo(0.4)
            client.receive_until("/tf", 38 * 10**7)
            assert [time for time, _ in client.messages["/tf"]].count(3 * 10**8) == 1
            [(_, scene)] = client.messages["/scene"]
            assert {entity.id for entity in scene.entities} == {"arm/link", "arm/ball"}
            assert all(time >= 9 * 10**7 for time, _ in client.messages["/tf"])


def test_going_back_in_time_begins_a_new_session_of_foxglove(testbed: VirtualTestbed) -> None:
    with FoxgloveServer(0) as server:
        writer = SceneWriter(testbed, server)
        simulated(testbed, writer)
        with client_of(server.address) as client:
            assert client.receive() == "serverInfo"
            client.receive_until("/scene")
            writer.write(testbed.default_context())
            while client.receive() != "serverInfo":
                pass


def test_live_session_is_mirrored_until_it_ends() -> None:
    server = FoxgloveServer(0)
    with SimulationSession(ShapesScenario()) as session:
        session.mirror(server)
        with client_of(server.address) as client:
            client.receive_until("/scene")
            session.play()
            client.receive_until("/tf", 10**8)
            client.receive_until("/joint_states")
    assert not listening(server.port)


@pytest.mark.slow
def test_command_line_serves_both_viewers_until_it_is_interrupted() -> None:
    command = [sys.executable, "-m", "vtbdrake", "view", "tests.visualization.scenes.shapes:ShapesScenario"]
    program = subprocess.Popen(
        [*command, "--no-browser", "--foxglove", "--rerun", "--json"], stdout=subprocess.PIPE, text=True, cwd=ROOT
    )
    try:
        assert program.stdout is not None
        foxglove_at, rerun_at = (json.loads(program.stdout.readline()) for _ in range(2))
        assert re.fullmatch(r"rerun\+http://127.0.0.1:\d+/proxy", rerun_at["rerun"])
        with client_of(foxglove_at["foxglove"]) as client:
            client.receive_until("/scene")
        assert "url" in json.loads(program.stdout.readline())
        program.send_signal(signal.SIGINT)
        assert program.wait(PATIENCE) == 0
    finally:
        program.kill()
        program.wait()


def has_come(recording: Recording) -> bool:
    """Return whether all shapes and frames, and some states, are there: messages may overtake each other."""
    here = recording.entities()
    shapes = {f"world/arm/link/{name}" for name in SHAPES}
    samples = min(len(recording.times(path, "Transform3D:translation")) for path in MOVING)
    samples = min(samples, len(recording.times("joint_states/position", "Scalars:scalars")))
    return shapes <= here and "world/arm/link/slider/tool" in here and samples > 5


@pytest.mark.filterwarnings("ignore:RRD file has no footer")
def test_client_of_rerun_gets_the_scene_and_the_poses(testbed: VirtualTestbed, tmp_path: Path) -> None:
    saved = tmp_path / "live.rrd"
    with RerunServer(0) as server:
        assert listening(server.port) == {"0100007F"}
        writer = SceneWriter(testbed, server)
        simulator = simulated(testbed, writer)
        # Its own folder, so that it finds no settings, and keeps none.
        client = subprocess.Popen(
            [Path(sys.executable).with_name("rerun"), server.address, "--save", saved, "--bind", "127.0.0.1"],
            env=os.environ | {"HOME": str(tmp_path), "XDG_CONFIG_HOME": str(tmp_path), "XDG_DATA_HOME": str(tmp_path)},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,  # The program in Python starts another one.
        )
        try:
            recording = None
            while recording is None or not has_come(recording):
                simulator.AdvanceTo(simulator.get_context().get_time() + 0.1)
                assert client.poll() is None
                if saved.exists() and saved.stat().st_size > 50_000:
                    with suppress(RuntimeError):  # It ends in the middle of a message: later, then.
                        recording = Recording(saved)
        finally:
            os.killpg(client.pid, signal.SIGKILL)
            client.wait()
    plant = testbed.plant
    times = recording.times("joint_states/position", "Scalars:scalars")
    positions = recording.array("joint_states/position", "Scalars:scalars")
    # The first states were written before the client came.
    assert times[0] == 0 and len(times) > 5
    context = plant.CreateDefaultContext()
    for sample in (0, 4):
        turn, slide = positions[sample]
        plant.GetJointByName("turn").set_angle(context, turn)
        plant.GetJointByName("slide").set_translation(context, slide)
        X_WB = plant.EvalBodyPoseInWorld(context, plant.GetBodyByName("tool"))
        X = recording.world_pose("world/arm/link/slider/tool", times[sample])
        assert X.IsNearlyEqualTo(X_WB, 1e-6)
    assert recording.array("world/arm/link/box", "Boxes3D:half_sizes")[0] == pytest.approx([0.05, 0.1, 0.15])
    assert np.all(np.diff(times) > 0)


@pytest.mark.parametrize("kind", [FoxgloveServer, RerunServer])
def test_port_that_is_taken_is_an_error_with_the_remedy(kind: type[FoxgloveServer | RerunServer]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(OSError, match=rf"port {port} of this machine cannot be taken .*: give another one, or 0"):
            kind(port)
