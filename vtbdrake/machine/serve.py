"""What a process does that is a machine."""

from __future__ import annotations

import logging
import signal
import socket
import time
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from math import inf
from typing import Any

from vtbdrake.child_process import StartError, report_ready
from vtbdrake.control.bridge import BridgeError
from vtbdrake.control.realtime import RealTime
from vtbdrake.machine.config import MachineConfig
from vtbdrake.machine.loop import MachineLoop
from vtbdrake.machine.machine import Machine
from vtbdrake.testbed import Scenario

_log = logging.getLogger(__name__)


def serve(
    machine: Machine,
    url: str,
    *,
    lock_step: bool = False,
    cycles: float = inf,
    priority: int = 0,
    control: socket.socket | None = None,
    ready: Callable[[], None] = lambda: None,
) -> MachineLoop:
    """Runs a machine in the main thread of a process that does nothing else, until SIGTERM, or SIGINT if not ignored.

    Args:
        ready: called when it is connected and has told its first state.

    Raises:
        BridgeError: there is no bus at ``url``.
        RuntimeError: the simulation failed.
    """
    loop = MachineLoop(machine, url, control=control)
    signal.signal(signal.SIGTERM, lambda *_: loop.stop())
    if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
        signal.signal(signal.SIGINT, lambda *_: loop.stop())
    # A simulated world that cannot keep up computes without a pause.
    real_time = RealTime(priority=priority, longest_step=None) if priority else nullcontext()
    try:
        with real_time:
            if isinstance(real_time, RealTime):
                _log.info("%s", real_time)
            loop.run(lock_step=lock_step, cycles=cycles, ready=ready)
    finally:
        loop.close()
    return loop


def epoch(*, lock_step: bool) -> int:
    """What a machine tells as the time of its cycle 0, in microseconds: the time of day; 0 in lock-step, where the
    same commands are to give the same messages."""
    return 0 if lock_step else time.time_ns() // 1000


def serve_child(
    connection: socket.socket, scenario: Scenario, url: str, config: MachineConfig, options: Mapping[str, Any]
) -> None:
    """Run the child process of a `MachineProcess`.

    Args:
        options: arguments of `serve`.
    """
    logging.basicConfig(format="machine: %(message)s")
    try:
        machine = Machine(scenario, config, epoch=epoch(lock_step=options["lock_step"]))
        serve(machine, url, control=connection, ready=lambda: report_ready(connection), **options)
    except (ValueError, BridgeError) as error:
        raise StartError(str(error)) from error
