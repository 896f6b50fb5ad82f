"""A machine in a child process."""

from __future__ import annotations

import json
import logging
import os
import signal
import socket
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from math import inf
from typing import Any

import numpy as np

from vtbdrake.common.child_process import ANSWER_TIMEOUT, ChildService, ProcessStartError, report_ready
from vtbdrake.control.bridge import BridgeError
from vtbdrake.control.statistics import Histogram, LoopStatistics
from vtbdrake.machine.config import MachineConfig
from vtbdrake.machine.injected_faults import InjectedFault
from vtbdrake.machine.machine import Machine, MachineStatus
from vtbdrake.machine.machine_loop import MachineLoop, epoch, serve
from vtbdrake.testbed import Scenario

_LEAST_TIMEOUT = 0.1
"""Time for an answer where hardly any is left, in seconds: requests are answered between two cycles."""


class MachineError(RuntimeError):
    """A machine does not start, does not answer, or rejects a request."""


@dataclass(frozen=True)
class MachineStatistics:
    """Statistics of the loop of a machine; see `MachineLoop`.

    Attributes:
        loop: The statistics of its cycles; ``step`` is the simulation.
        state_to_command: The times from sending a state to the arrival of the next command, in seconds.
        lost: The time in seconds by which the simulation did not keep up with the clock.
    """

    loop: LoopStatistics
    state_to_command: Histogram
    lost: float


class MachineProcess(ChildService):
    """A machine in a child process, which ends with `close`, and with the process that started it.

        with Hub(port=0) as hub, MachineProcess(scenario, hub.url) as machine:
            machine.begin(Delay(seconds=0.05))

    Requests are answered between two cycles: a fault acts from the next message on.

    Args:
        scenario: The scenario of its world.
        url: The URL of the LCM bus.
        config: The differences from the simulated world.
        lock_step: Begin cycles with commands, instead of with the clock; see `MachineLoop.run`.
        cycles: The number of cycles after which it ends; by default it goes on.
        priority: The priority of SCHED_FIFO, where the system grants it; 0 for ordinary scheduling.
        options: Fields that replace the fields of ``config``.

    Raises:
        ValueError: A value of the config is out of its range, or it does not allow lock-step.
    """

    name, error = "the machine", MachineError

    def __init__(
        self,
        scenario: Scenario,
        url: str,
        config: MachineConfig | None = None,
        *,
        lock_step: bool = False,
        cycles: int | None = None,
        priority: int = 0,
        **options: Any,
    ) -> None:
        self.scenario = scenario
        self.url = url
        self.config = replace(config or MachineConfig(), **options)
        if lock_step:
            self.config.check_lock_step()
        self._run = {"lock_step": lock_step, "cycles": inf if cycles is None else cycles, "priority": priority}
        self._paused = False

    def start(self) -> None:
        """Start the machine; when this returns, it has sent its first state.

        Raises:
            MachineError: It does not start.
        """
        if self.alive:
            raise MachineError("the machine runs already")
        self.close()
        self._start(_serve_child, self.scenario, self.url, self.config, self._run)

    @property
    def alive(self) -> bool:
        """Return True while the process of the machine exists, also while it is paused."""
        return self._child is not None and self._child.alive

    def status(self) -> MachineStatus:
        """Return the present status.

        Raises:
            MachineError: It does not answer.
        """
        return self._status({"request": "status"})

    def statistics(self) -> MachineStatistics:
        """Return the statistics since the start, or since `reset_statistics`."""
        answer = self._ask({"request": "statistics"})
        return MachineStatistics(
            LoopStatistics.from_dict(answer["statistics"]),
            Histogram.from_dict(answer["state_to_command"]),
            answer["lost"],
        )

    def reset_statistics(self) -> None:
        """Reset the statistics, after a warm-up for example."""
        self._ask({"request": "reset statistics"})

    def until(self, condition: Callable[[MachineStatus], bool], *, timeout: float = 10.0) -> MachineStatus:
        """Wait for a status that fulfils the condition, and return it.

        Args:
            condition: The function that tells whether a status fulfils the condition.
            timeout: Longest wait, in s.

        Raises:
            MachineError: There was none within ``timeout`` seconds, or it does not answer.
        """
        limit, left = time.monotonic() + timeout, timeout
        while not condition(status := self._status({"request": "status"}, timeout=left)):
            left = limit - time.monotonic()
            if left <= 0.0:
                raise MachineError(f"the machine did not reach the expected status within {timeout} s; it has {status}")
        return status

    def write(self, values: Mapping[str, Any]) -> MachineStatus:
        """Set variables of its world by address, as if a tool was changed while it runs.

        Raises:
            MachineError: An address is unknown, or a value impossible; nothing has changed.
        """
        return self._status({"set": {address: np.asarray(value).tolist() for address, value in values.items()}})

    # -- faults

    def begin(self, *faults: InjectedFault) -> MachineStatus:
        """Begin faults; each lasts until `end_faults`, or until one of the same name and side replaces it."""
        status = None
        for fault in faults:
            status = self._status(fault.to_dict())
        return status or self.status()

    def end_faults(self) -> MachineStatus:
        """End all injected faults."""
        return self._status({"request": "normal"})

    def die(self) -> int:
        """Let the machine end at once, without closing its connections, and return its exit code."""
        self._running().connection.sendall(_to_line({"request": "die"}))
        return self.wait()

    def kill(self) -> int:
        """Kill the machine from outside (SIGKILL), and return its exit code."""
        return self._running().kill()

    def pause(self) -> None:
        """Stop the process (SIGSTOP)."""
        os.kill(self.pid, signal.SIGSTOP)
        self._paused = True

    def resume(self) -> None:
        """Continue after `pause`. The world catches up with a short pause; the rest of a long one is lost time."""
        os.kill(self.pid, signal.SIGCONT)
        self._paused = False

    def wait(self, timeout: float = 10.0) -> int:
        """Wait until the machine has ended, and return its exit code.

        Raises:
            MachineError: It is still running after ``timeout`` seconds.
        """
        try:
            return self._running().wait(timeout)
        except TimeoutError as error:
            raise MachineError(str(error)) from None

    def close(self) -> None:
        """End the machine; it can be started again."""
        if self._child is not None and self._paused:
            self._child.kill()
        super().close()
        self._paused = False

    # -- requests

    def _status(self, request: dict[str, Any], *, timeout: float = ANSWER_TIMEOUT) -> MachineStatus:
        answer = self._ask(request, timeout=timeout)
        return MachineStatus(**{item.name: answer[item.name] for item in fields(MachineStatus)})

    def _ask(self, request: dict[str, Any], *, timeout: float = ANSWER_TIMEOUT) -> dict[str, Any]:
        timeout = min(max(timeout, _LEAST_TIMEOUT), ANSWER_TIMEOUT)
        answer: dict[str, Any] = json.loads(self._request(_to_line(request), timeout=timeout))
        if "error" in answer:
            raise MachineError(answer["error"])
        return answer


def _to_line(request: dict[str, Any]) -> bytes:
    return json.dumps(request).encode() + b"\n"


def _serve_child(
    connection: socket.socket, scenario: Scenario, url: str, config: MachineConfig, options: Mapping[str, Any]
) -> None:
    """Run the child process of a `MachineProcess`; see `serve` for ``options``."""
    logging.basicConfig(format="machine: %(message)s")
    try:
        machine = Machine(scenario, config, epoch=epoch(lock_step=options["lock_step"]))
        loop = MachineLoop(machine, url, control=connection)
    except (ValueError, BridgeError) as error:
        raise ProcessStartError(str(error)) from error
    serve(loop, ready=lambda: report_ready(connection), **options)
