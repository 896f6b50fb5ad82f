"""Abstract sensor signals: recorded as the messages that they come from."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import lcm
import numpy as np
import pytest

from tests.control.scripted import PERIOD, ScriptedBridge
from tests.recording.seeing import HEIGHT, WIDTH, SeeingScenario, brightness, picture
from vtbdrake.control.clock import SimulatedClock
from vtbdrake.control.runtime import Runtime
from vtbdrake.lcm.bridge import LcmBridge
from vtbdrake.lcm.hub import Hub
from vtbdrake.lcm.protocol import protocol_of
from vtbdrake.recording.log_reader import read_log
from vtbdrake.recording.recorder import Recorder
from vtbdrake.recording.replay import replay
from vtbdrake.testbed import DpsAlone

SCENARIO = SeeingScenario()


@pytest.fixture(scope="module")
def hub() -> Iterator[Hub]:
    with Hub(port=0) as running:
        yield running


class Seeing:
    """A loop, and a camera on its bus."""

    def __init__(self, hub: Hub) -> None:
        self.bridge: LcmBridge = protocol_of(SCENARIO).bridge(SCENARIO.interface(), hub.url)
        self.runtime = Runtime(DpsAlone(SCENARIO), self.bridge, period=PERIOD, clock=SimulatedClock())
        self._camera = lcm.LCM(hub.url)
        self._random = np.random.default_rng(0)
        self._utime = 0

    def show(self, *, late: bool = False) -> np.ndarray:
        """A new image, which has come; a late one is rejected."""
        pixels = self._random.integers(0, 256, (HEIGHT, WIDTH))
        self._utime += 1000
        self._camera.publish("CAMERA", picture(self._utime - 5000 * late, pixels))
        for _ in range(60):
            if self.bridge.poll(1.0):
                return pixels
        raise TimeoutError("the image does not come")


def test_images_are_replayed_from_their_messages(hub: Hub, tmp_path: Path) -> None:
    """Of several in one cycle the last good one; of those that were rejected none."""
    loop = Seeing(hub)
    shown = []
    with Recorder(loop.runtime, tmp_path / "run.lcm", digest_period=PERIOD):
        loop.bridge.open()
        for i in range(30):
            if i % 3 == 0:
                loop.show()
                shown.append(loop.show())
                if i:
                    loop.show(late=True)
            if i == 0:
                loop.runtime.switch("real")
            loop.runtime.cycle()
        loop.bridge.close()
    log = read_log(tmp_path / "run.lcm")
    assert sum(1 for _ in log.messages("CAMERA")) == 29
    assert (log.sources["image"] != 0).tolist() == [i % 3 == 0 for i in range(30)]
    report = replay(log)
    assert report.identical and report.digests == 30, report
    assert report.actuation["velocity"][:, 0].tolist() == [brightness(shown[i // 3]) for i in range(30)]


def test_a_recording_that_would_lack_the_present_image_is_refused(hub: Hub, tmp_path: Path) -> None:
    loop = Seeing(hub)
    loop.bridge.open()
    loop.show()
    with pytest.raises(ValueError, match="signal image is abstract, .* start to record before the bridge is opened"):
        Recorder(loop.runtime, tmp_path / "run.lcm")
    loop.bridge.close()
    assert not (tmp_path / "run.lcm").exists()


def test_a_bridge_without_raw_messages_is_refused(tmp_path: Path) -> None:
    clock = SimulatedClock()
    bridge = ScriptedBridge(SCENARIO.interface(), clock, lambda t: {})
    runtime = Runtime(DpsAlone(SCENARIO), bridge, clock=clock)
    with pytest.raises(ValueError, match="by its raw messages, which ScriptedBridge does not have"):
        Recorder(runtime, tmp_path / "run.lcm")
