"""What a process does that is a machine."""

from __future__ import annotations

import json
import logging
import signal
import socket
import sys
import time
from collections.abc import Callable
from contextlib import nullcontext
from math import inf

from vtbdrake.control.bridge import BridgeError
from vtbdrake.control.realtime import RealTime
from vtbdrake.machine.config import MachineConfig
from vtbdrake.machine.loop import MachineLoop
from vtbdrake.machine.machine import Machine
from vtbdrake.testbed import load_scenario

_log = logging.getLogger(__name__)

_FAILED = 1


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
        ready: called when it is connected.

    Raises:
        BridgeError: there is no bus at ``url``.
        RuntimeError: the simulation failed.
    """
    loop = MachineLoop(machine, url, control=control)
    signal.signal(signal.SIGTERM, lambda *_: loop.stop())
    if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
        signal.signal(signal.SIGINT, lambda *_: loop.stop())
    ready()
    # A simulated world that cannot keep up computes without a pause.
    real_time = RealTime(priority=priority, longest_step=None) if priority else nullcontext()
    try:
        with real_time:
            if isinstance(real_time, RealTime):
                _log.info("%s", real_time)
            loop.run(lock_step=lock_step, cycles=cycles)
    finally:
        loop.close()
    return loop


def epoch(*, lock_step: bool) -> int:
    """What a machine tells as the time of its cycle 0, in microseconds: the time of day; 0 in lock-step, where the
    same commands are to give the same messages."""
    return 0 if lock_step else time.time_ns() // 1000


def main() -> None:
    """The process of a `MachineProcess`."""
    control = socket.socket(fileno=int(sys.argv[1]))
    order = json.loads(sys.argv[2])
    logging.basicConfig(format="machine: %(message)s")
    try:
        scenario = load_scenario(order["scenario"])
        machine = Machine(scenario, MachineConfig(**order["config"]), epoch=epoch(lock_step=order["lock_step"]))
        serve(
            machine,
            order["url"],
            lock_step=order["lock_step"],
            cycles=inf if order["cycles"] is None else order["cycles"],
            priority=order["priority"],
            control=control,
        )
    except (ValueError, BridgeError) as error:
        control.sendall(json.dumps({"error": str(error)}).encode() + b"\n")
        raise SystemExit(_FAILED) from error
