"""A signal ends a loop while a command is under way: every command that the hub has seen is in the log."""

from __future__ import annotations

import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

import pytest
from drake import lcmt_iiwa_command

from tests.control.servo_machine import COMMAND, ServoMachineScenario
from tests.control.test_loop import Ear
from vtbdrake.lcm.hub import Hub
from vtbdrake.machine.machine_process import MachineProcess
from vtbdrake.recording.log_events import LogEvents
from vtbdrake.recording.log_format import CYCLE
from vtbdrake.recording.log_reader import read_log

# Where the signal comes: before a command is sent, between sending and recording it, in the recorder, behind it.
POINTS = [
    ("call", "LcmBridge.publish"),
    ("return", "TcpqConnection.publish"),
    ("call", "Recorder._tap"),
    ("return", "LcmBridge.publish"),
    ("call", "BackgroundProcess.post_frame"),
    ("return", "BackgroundProcess._push"),
    ("return", "Recorder.__call__"),
]


# So slow a machine does not fill the connection of a loop that a busy computer holds up: the hub would end it.
SLOW = 0.02  # s


@pytest.fixture(scope="module")
def hub() -> Iterator[Hub]:
    with Hub(port=0) as hub, MachineProcess(ServoMachineScenario(), hub.url, period=SLOW):
        yield hub


@contextmanager
def signal_at(event: str, function: str, number: int) -> Iterator[None]:
    """Raise a signal, once, when a function is called next, or returns."""
    raised = False

    def trace(frame: FrameType, kind: str, _: Any) -> Any:
        nonlocal raised
        if frame.f_code.co_qualname != function or raised:
            return None
        if kind == event:
            raised = True
            signal.raise_signal(number)
        return trace

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        yield
    finally:
        sys.settrace(before)
        assert raised


@pytest.mark.parametrize("point", POINTS, ids=lambda point: f"{point[0]}-{point[1]}")
def test_every_command_that_left_is_in_the_log(hub: Hub, tmp_path: Path, point: tuple[str, str]) -> None:
    path, ear = tmp_path / "log.lcm", Ear(hub.url)
    with (
        pytest.raises(KeyboardInterrupt),
        ServoMachineScenario(rate=0.0).deploy(hub.url, record=path) as runtime,
    ):
        runtime.take_over()
        runtime.run(cycles=3)
        with signal_at(*point, signal.SIGTERM):
            runtime.run(cycles=10)
    events = LogEvents(path)
    logged = [lcmt_iiwa_command.decode(events.data(begin, end)).utime for *_, begin, end in events.on(COMMAND)]
    ear.listen(lambda: logged[-1] in ear.utimes)
    assert [utime for utime in logged if utime in ear.utimes] == ear.utimes
    assert read_log(path).closed
    assert len(logged) >= len(events.places(CYCLE)) - 1  # The fallback's command follows.
