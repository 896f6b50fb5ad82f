"""LCM's own player plays our logs."""

from __future__ import annotations

import subprocess
import sys
import threading
from pathlib import Path

import lcm

from tests.control.test_loop import PATIENCE, Loop
from vtbdrake.lcm.hub import Hub
from vtbdrake.recording.log_reader import read_log
from vtbdrake.recording.recorder import Recorder


def test_lcm_logplayer_plays_every_message_onto_a_hub(tmp_path: Path) -> None:
    path = tmp_path / "run.lcm"
    with Hub(port=0) as hub, Loop(hub, lock_step=True) as loop, Recorder(loop.runtime, path):
        loop.sense()
        loop.runtime.switch("real")
        loop.runtime.cycle()
        loop.runtime.run(cycles=100)
    recorded = [(event.channel, event.data) for event in lcm.EventLog(str(path))]
    assert len(recorded) > 300
    heard: list[tuple[str, bytes]] = []
    player = Path(sys.executable).with_name("lcm-logplayer")
    with Hub(port=0) as hub:
        bus = lcm.LCM(hub.url)
        subscription = bus.subscribe("(?!VTB_HUB).*", lambda channel, data: heard.append((channel, data)))
        subscription.set_queue_capacity(0)
        with subprocess.Popen([player, "--lcm-url", hub.url, "--speed", "5", path], stdout=subprocess.DEVNULL) as run:
            guard = threading.Timer(PATIENCE, run.kill)
            guard.start()
            while len(heard) < len(recorded) and bus.handle_timeout(round(1e3 * PATIENCE)):
                pass
            assert run.wait(PATIENCE) == 0
            guard.cancel()
    assert heard == recorded
    assert len(read_log(path)) == 101
