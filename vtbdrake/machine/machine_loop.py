"""The loop of a machine on an LCM bus: against a clock, or in lock-step with its controller."""

from __future__ import annotations

import json
import logging
import os
import socket
import threading
import time
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import asdict
from math import inf
from typing import Any

from vtbdrake.common.child_process import ending_signals
from vtbdrake.control.clock import Clock, WallClock
from vtbdrake.control.realtime import RealTime
from vtbdrake.control.statistics import Histogram, LoopStatistics
from vtbdrake.lcm.connections import LcmLink
from vtbdrake.machine.injected_faults import InjectedFaultError, fault_from_dict
from vtbdrake.machine.machine import Machine

_log = logging.getLogger(__name__)

DIED = 70
"""The exit code of a machine after the request ``die``."""

_BURST = 200  # messages to take at a time
_SLICE = 0.005  # s to wait for commands before looking at requests
_REPEAT = 0.2  # s after which a state is sent again, in lock-step on a bus without commands so far
_LONG_WAIT = 5.0  # s for a command in lock-step, after which the log says so
_CATCH_UP = 0.05  # s


class MachineLoop:
    """A machine and its connection to the bus.

    Requests arrive on the config's ``control_channel``, or by ``control``, as JSON: an injected fault
    (``{"fault": "drop", "fraction": 0.5}``, see `InjectedFault.to_dict`), variables of its world to set
    (``{"set": {"sim.sys.payload.mass": 1}}``), or ``{"request": NAME}``:

    * ``status``: do nothing but answer;
    * ``normal``: end all faults;
    * ``statistics``: answer with the statistics too;
    * ``reset statistics``;
    * ``die``: end the process at once, without closing its connections.

    By ``control`` every request is one line and gets one line: the status, or ``{"error": ...}``. On the bus, the
    status is published on ``status_channel`` every ``status_period``, after each request, and when the brake engages or
    is released.

    Args:
        machine: The machine.
        url: The URL of the bus.
        clock: The clock of the cycles; by default the wall clock.
        control: A connected stream; the loop stops when its other end closes.
        connect_timeout: The time to wait for the bus, in seconds.

    Attributes:
        statistics: The statistics of its cycles; ``step`` is the simulation.
        state_to_command: The times in seconds from sending a state to the arrival of the next command at the computer
            (the machine may be simulating then). If a state is not answered before the next one, the older one counts.
            A command does not say which state it answers: if all answers take more than a period, they are taken for
            answers to the next state.
        lost: The time in seconds by which the simulation did not keep up with the clock.

    Raises:
        BridgeError: There is no bus at ``url``.
    """

    def __init__(
        self,
        machine: Machine,
        url: str,
        *,
        clock: Clock | None = None,
        control: socket.socket | None = None,
        connect_timeout: float = 2.0,
    ) -> None:
        self.machine = machine
        self._clock = clock or WallClock()
        self._control = control
        self._lines = b""
        if control is not None:
            control.setblocking(False)
        self._stop = threading.Event()
        self._messages: list[tuple[str, bytes]] = []
        self._braking = False
        self._arrived: set[str] = set()
        self._alone = True
        self._reconnections = 0
        self._sent_at = inf
        self._next_status = 0
        self._reset_statistics()
        handlers = {channel: self._receive for channel in machine.channels}
        handlers[machine.config.control_channel] = self._answer_by_bus
        self._link = LcmLink(url, handlers, connect_timeout=connect_timeout, stamped=True)
        self._link.open()

    def _reset_statistics(self) -> None:
        self.statistics = LoopStatistics(self.machine.period)
        self.state_to_command = Histogram()
        self.lost = 0.0

    def stop(self) -> None:
        """End `run` after the present cycle; safe in a signal handler."""
        self._stop.set()

    def close(self) -> None:
        """Close the connection to the bus."""
        self._link.close()

    def run(self, *, lock_step: bool = False, cycles: float = inf, ready: Callable[[], None] = lambda: None) -> None:
        """Do cycles, and send the state at the beginning of each.

        With the clock, the commands that have arrived by then act in the cycle, as commands of a robot on a fieldbus
        do: the answer to a state acts a period later. In lock-step, the answer acts in the cycle whose state it
        answers, as the DPS of a testbed does in simulation.

        Args:
            lock_step: Begin a cycle when one message has arrived on every command channel, instead of with the clock.
            cycles: The number of cycles.
            ready: Called when the first state is sent.

        Raises:
            RuntimeError: The simulation failed.
            ValueError: The config does not allow lock-step.
        """
        if lock_step:
            self.machine.config.check_lock_step()
        end = self.machine.cycle + cycles
        self.machine.reject_late(not lock_step)
        self._messages = self.machine.messages()
        begin = self._clock.now() - self.machine.time
        self._send_state()
        ready()
        while not self._stop.is_set() and self.machine.cycle < end:
            if lock_step:
                self._await_commands()
                if not self._stop.is_set():
                    self._cycle_in_lock_step()
            else:
                begin = self._cycle_by_clock(begin, end)
            self._answer_by_control()

    def _cycle_in_lock_step(self) -> None:
        begin = self._clock.now()
        step = self._advance(1)
        self._send_state()
        self.statistics.record(lateness=0.0, step=step, cycle=self._clock.now() - begin)

    def _cycle_by_clock(self, begin: float, end: float) -> float:
        """Do the cycles that are due; return the time of cycle 0 on the clock, which moves when time is lost."""
        work = self._clock.now()
        begin, steps = self._behind(begin, work)
        step = self._advance(int(min(steps, end - self.machine.cycle)))
        worked = self._clock.now() - work
        deadline = begin + self.machine.time
        woke = self._await(deadline)
        if not self._stop.is_set():
            self._send_state()
            self.statistics.record(lateness=woke - deadline, step=step, cycle=worked + self._clock.now() - woke)
            self.statistics.miss(steps - 1)
        return begin

    def _advance(self, cycles: int) -> float:
        """Do cycles, prepare the messages that follow, and return the seconds that the simulation took."""
        begin = self._clock.now()
        for _ in range(cycles):
            self.machine.advance()
        took = self._clock.now() - begin
        self._messages = self.machine.messages()
        return took

    # -- when a cycle begins

    def _await(self, deadline: float) -> float:
        """Take messages until the deadline; return the time then."""
        if isinstance(self._clock, WallClock):
            while (left := deadline - self._clock.now()) > 0.0 and not self._stop.is_set():
                self._link.receive(left, _BURST)
        woke = self._clock.wait_until(deadline)
        self._link.receive(0.0, _BURST)
        return woke

    def _behind(self, begin: float, now: float) -> tuple[float, int]:
        """Return the time of cycle 0 on the clock, and the number of cycles to do; the world catches up."""
        period = self.machine.period
        due = int((now - begin) / period + 1e-6) + 1 - self.machine.cycle
        steps = max(1, min(due, int(_CATCH_UP / period)))
        lost = max(0, due - steps) * period
        self.lost += lost
        return begin + lost, steps

    def _await_commands(self) -> None:
        """Wait for one message on every command channel."""
        channels = set(self.machine.channels)
        begin = time.monotonic()
        repeat, tell_at = begin + _REPEAT, begin + _LONG_WAIT
        while not self._arrived >= channels and not self._stop.is_set():
            # One at a time: messages that are ahead of their cycle stay in the connection.
            self._link.receive(_SLICE, 1)
            self._answer_by_control()
            if (now := time.monotonic()) >= tell_at and not self._alone:
                missing = ", ".join(sorted(channels - self._arrived))
                _log.warning("no command on %s for %.0f s: a machine in lock-step waits for it", missing, now - begin)
                tell_at = inf
            # A controller that joins the bus after the state was sent would wait for it, and the machine for a command.
            self._alone |= self._link.reconnections > self._reconnections
            if self._alone and time.monotonic() >= repeat:
                repeat = time.monotonic() + _REPEAT
                self._reconnections = self._link.reconnections
                self._publish()
        self._arrived.clear()
        self._alone = False

    def _receive(self, channel: str, data: bytes) -> None:
        arrived = self._link.arrived or time.monotonic()
        if self._sent_at <= arrived:
            self.state_to_command.record(arrived - self._sent_at)
            self._sent_at = inf
        self._arrived.add(channel)
        self.machine.receive(channel, data)

    # -- sending

    def _send_state(self) -> None:
        # Before they leave: a controller that preempts this process answers before `_publish` returns. A state without
        # an answer counts until one arrives.
        self._sent_at = min(self._sent_at, time.monotonic())
        self._publish()
        braking = self.machine.braking
        if self.machine.cycle >= self._next_status or braking != self._braking:
            self._braking = braking
            self._send_status()

    def _publish(self) -> None:
        self._link.publish(*self._messages)

    def _send_status(self) -> None:
        config = self.machine.config
        self._next_status = self.machine.cycle + max(1, round(config.status_period / self.machine.period))
        self._link.publish((config.status_channel, json.dumps(asdict(self.machine.status())).encode()))

    # -- requests

    def _answer_by_bus(self, channel: str, data: bytes) -> None:
        self._answer(data)
        self._send_status()

    def _answer_by_control(self) -> None:
        if self._control is None:
            return
        try:
            received = self._control.recv(65536)
        except BlockingIOError:
            return
        except OSError:
            received = b""
        if not received:
            _log.info("the parent process has closed the connection: the machine ends")
            self._stop.set()
            return
        *lines, self._lines = (self._lines + received).split(b"\n")
        for line in lines:
            try:
                # The parent waits for the answer, so there is room for it.
                self._control.sendall(json.dumps(self._answer(line)).encode() + b"\n")
            except OSError as error:
                _log.warning("a request could not be answered: %s", error)
                self._stop.set()

    def _answer(self, text: bytes) -> dict[str, Any]:
        try:
            request = json.loads(text)
            if not isinstance(request, dict):
                raise InjectedFaultError(f"a request is a JSON object, not {request!r}")
            more = self._do(request)
        except (ValueError, RecursionError) as error:
            _log.warning("request rejected: %s", error)
            return {"error": str(error)}
        return {**asdict(self.machine.status()), **more}

    def _do(self, request: dict[str, Any]) -> dict[str, Any]:
        if "fault" in request:
            self.machine.begin(fault_from_dict(request))
            return {}
        if "set" in request:
            if not isinstance(request["set"], dict):
                raise InjectedFaultError(f"set needs an object of values by address, not {request['set']!r}")
            self.machine.write(request["set"])
            return {}
        name = request.get("request")
        if name == "die":
            os._exit(DIED)
        if name == "normal":
            self.machine.end_faults()
        elif name == "reset statistics":
            self._reset_statistics()
        elif name == "statistics":
            return {
                "statistics": self.statistics.to_dict(),
                "state_to_command": self.state_to_command.to_dict(),
                "lost": self.lost,
            }
        elif name != "status":
            raise InjectedFaultError(
                "a request must be a fault, values to set, or one of status, normal, statistics, reset statistics and "
                f"die, not {request!r}"
            )
        return {}


def serve(
    loop: MachineLoop,
    *,
    lock_step: bool = False,
    cycles: float = inf,
    priority: int = 0,
    ready: Callable[[], None] = lambda: None,
) -> None:
    """Run a loop in the main thread of a process that does nothing else, until SIGTERM (or SIGINT, if not ignored).

    Args:
        loop: The loop, which is closed at the end.
        lock_step: See `MachineLoop.run`, as for ``cycles`` and ``ready``.
        cycles: The number of cycles.
        priority: The priority of SCHED_FIFO, where the system grants it; 0 for ordinary scheduling.
        ready: Called when the first state is sent.

    Raises:
        RuntimeError: The simulation failed.
    """
    # Without a longest step: a simulation that cannot keep up computes without a pause.
    real_time = RealTime(priority=priority, longest_step=None) if priority else nullcontext()
    try:
        with ending_signals(lambda *_: loop.stop()), real_time:
            if isinstance(real_time, RealTime):
                _log.info("%s", real_time)
            loop.run(lock_step=lock_step, cycles=cycles, ready=ready)
    finally:
        loop.close()


def epoch(*, lock_step: bool) -> int:
    """Return the time of cycle 0 in microseconds: the time of day, or 0 in lock-step, for equal messages each time."""
    return 0 if lock_step else time.time_ns() // 1000
