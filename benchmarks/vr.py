"""Delay of the commands of a hand in virtual reality, and of the release of a robot when the hand is gone."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from math import inf
from typing import Any

import lcm
import numpy as np
from drake import lcmt_scope
from websockets.exceptions import ConnectionClosed

from benchmarks.loop_rig import HUB_PRIORITY, MACHINE_PRIORITY
from benchmarks.measure import LOWER, Benchmark
from benchmarks.view_client import open_socket
from tests.web.serving.entrance import entered
from vtbdrake.lcm.hub import Hub
from vtbdrake.machine import MachineProcess
from vtbdrake.monitoring.live.client import LiveClient
from vtbdrake.testbed.hand_command import HandCommand
from vtbdrake.web import view_loop
from vtbdrake_diagrams.manipulator import ManipulatorScenario

POSES = 400
RATE = 90.0  # Hz
RELEASES = 12  # of each kind
SHIFT = 1e-4  # m, between two poses, by which they are told apart
PATIENCE = 20.0  # s
CHANNEL = "ARM_HAND"


@dataclass
class QuickArm(ManipulatorScenario):
    """An arm whose commanded pose is the hand's at once, so that each pose is told from the one before."""

    led_by_hand: bool = True
    release_time: float = 0.1

    def hand_command(self) -> HandCommand | None:
        command = super().hand_command()
        assert command is not None
        return replace(command, speed=1e6, turn_rate=1e6, release_time=self.release_time)


class Listener:
    """Keeps when each command of the hand arrived on the bus, and its value."""

    def __init__(self, url: str) -> None:
        self.commands: list[tuple[float, np.ndarray]] = []
        self._lcm = lcm.LCM(url)
        self._lcm.subscribe(CHANNEL, self._note).set_queue_capacity(0)
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._listen, daemon=True)
        self._thread.start()

    def _note(self, _: str, data: bytes) -> None:
        self.commands.append((time.monotonic(), np.array(lcmt_scope.decode(data).value)))

    def _listen(self) -> None:
        while not self._ended.is_set():
            self._lcm.handle_timeout(50)

    def first(self, begin: float, condition: Callable[[np.ndarray], bool]) -> tuple[float, np.ndarray]:
        """Return the first command after ``begin`` that fulfils the condition, and when it arrived."""
        limit, place = time.monotonic() + PATIENCE, 0
        while time.monotonic() < limit:
            while place < len(self.commands):
                when, value = self.commands[place]
                place += 1
                if when >= begin and condition(value):
                    return when, value
            time.sleep(1e-3)
        raise RuntimeError("no such command came")

    def close(self) -> None:
        self._ended.set()
        self._thread.join()


class Headset:
    """A page that sends poses."""

    def __init__(self, url: str, stack: ExitStack) -> None:
        self._socket = stack.enter_context(open_socket(entered(url), "vr"))
        self.close = self._socket.close

    def send(self, message: dict[str, Any]) -> None:
        self._socket.send(json.dumps(message))

    def hold(self, height: float, *, grip: bool) -> float:
        """Send a pose, and return when."""
        hand = {"pose": [1, 0, 0, 0, 0, 0, height], "grip": grip, "buttons": [0.0, float(grip)]}
        now = time.monotonic()
        self.send({"time": now, "head": None, "left": None, "right": hand})
        return now

    def _status(self) -> dict[str, Any]:
        message: dict[str, Any] = json.loads(self._socket.recv(PATIENCE))
        if "armed" not in message:
            raise RuntimeError(f"the server refuses a headset: {message}")
        return message

    def until(self, condition: Callable[[dict[str, Any]], bool]) -> None:
        """Wait for a status."""
        while not condition(self._status()):
            pass

    def lead(self) -> None:
        """Arm the robot, and take a grip; the poses that follow lead."""
        self.send({"do": "disarm"})
        self.until(lambda status: not status["armed"])  # Older ones have waited.
        self.send({"do": "arm"})
        self.until(lambda status: bool(status["armed"]))
        leads = False
        while not leads:  # The motion of the arm changes.
            self.hold(1.0, grip=False)
            self.hold(1.0, grip=True)
            leads = self._status()["leading"]


class _NotMeasuredError(RuntimeError):
    """The loop had latched, or ended: nobody led the robot any more."""


@contextmanager
def _loop(url: str) -> Iterator[None]:
    """Start a machine process and a process of the loop that controls it, with real-time priority if that is granted.

    Raises:
        _NotMeasuredError: The loop had latched, or ended, when an error came.
    """
    scenario = ["vtbdrake_diagrams.manipulator:ManipulatorScenario", "--field", "led_by_hand=true"]
    command = [sys.executable, "-m", "vtbdrake", "run", *scenario, "--url", url]
    with MachineProcess(QuickArm(), url, priority=MACHINE_PRIORITY):
        loop = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            with LiveClient(url, timeout=PATIENCE) as live:
                live.get(["dps.impl.tip_pose"])
                try:
                    yield
                except (RuntimeError, TimeoutError, ConnectionClosed) as error:
                    if loop.poll() is not None:
                        raise _NotMeasuredError(f"the loop ended with exit code {loop.returncode}: {error}") from error
                    if latched := live.status().latched:
                        raise _NotMeasuredError(f"the loop has latched: {'; '.join(latched)}") from error
                    raise
        finally:
            loop.terminate()  # Where Ctrl-C is ignored, as in the background of a shell, SIGTERM still ends it.
            loop.wait(PATIENCE)


def vr_pose_to_command() -> list[Benchmark]:
    """Time from a pose that a headset's page sends to its command u on the loop's bus, and to a release's command.

    The page is a client without a browser; the server shows the loop, which controls a machine process. The loop takes
    a command of the bus in its next period. If the loop latches on a busy computer, all is measured once more.

    Raises:
        _NotMeasuredError: The loop has latched both times.
    """
    try:
        delays, releases = _measured()
        again = ""
    except _NotMeasuredError as error:
        delays, releases = _measured()
        again = f"measured once more, because {error}"
    p95 = float(np.percentile(delays, 95.0))
    worst = max(float(np.percentile(times, 95.0)) for times in releases.values())
    note = "; ".join(
        f"{kind}: median {1e3 * np.median(t):.0f} ms, p95 {1e3 * np.percentile(t, 95.0):.0f} ms"
        for kind, t in releases.items()
    )
    return [
        Benchmark(
            name="vr_pose_to_command",
            value=p95,
            unit="s",
            goal=0.05,
            better=LOWER,
            absolute="a hand that feels the robot lag",
            against=f"a pose every {1e3 / RATE:.0f} ms, at p95; the median is {1e3 * np.median(delays):.1f} ms",
            note=again,
        ),
        Benchmark(
            name="vr_release_to_idle",
            value=worst,
            unit="s",
            goal=0.15,
            better=LOWER,
            absolute="safety: 100 ms of silence, and how soon the robot must know of it",
            against="the silence of 100 ms that releases, at p95 of the slowest kind",
            note=note,
        ),
    ]


def _measured() -> tuple[list[float], dict[str, list[float]]]:
    """Return what `_delays` and `_releases` return, of one loop."""
    with ExitStack() as stack:
        hub = stack.enter_context(Hub(port=0, priority=HUB_PRIORITY))
        stack.enter_context(_loop(hub.url))
        listener = Listener(hub.url)
        stack.callback(listener.close)
        return _delays(hub.url, listener), _releases(hub.url, listener)


def _delays(url: str, listener: Listener) -> list[float]:
    """Return the time from each pose to the first command that is at least as new."""
    # Poses that are late on a busy computer are measured, too, and release nothing.
    with ExitStack() as stack:
        running = stack.enter_context(view_loop(QuickArm(release_time=5.0), url, vr=True))
        headset = Headset(running.url, stack)
        headset.lead()
        height = float(listener.first(0.0, _leads)[1][7])
        begin, sent = time.monotonic(), []
        for k in range(1, POSES + 1):
            time.sleep(max(begin + k / RATE - time.monotonic(), 0.0))
            sent.append((headset.hold(1.0 + SHIFT * k, grip=True), height + SHIFT * (k - 0.5)))
        return [listener.first(when, partial(_leads, height=height))[0] - when for when, height in sent]


def _releases(url: str, listener: Listener) -> dict[str, list[float]]:
    """Return the times from the last pose of a hand to the idle command, by what happens after it."""
    times: dict[str, list[float]] = {"let go": [], "silent": [], "closed": []}
    with ExitStack() as stack:
        running = stack.enter_context(view_loop(QuickArm(), url, vr=True))
        headset = Headset(running.url, stack)
        for kind in RELEASES * list(times):
            released = -inf
            while released < 0.0:  # On a busy computer, the clutch may be released before.
                headset.lead()
                begin = time.monotonic()
                when = headset.hold(1.0, grip=kind != "let go")
                if kind == "closed":
                    headset.close()
                    headset = Headset(running.url, stack)
                released = listener.first(begin, lambda value: value[0] == 0.0)[0] - when
            times[kind].append(released)
    return times


def _leads(value: np.ndarray, height: float = -inf) -> bool:
    return bool(value[0] == 1.0 and value[7] >= height)
