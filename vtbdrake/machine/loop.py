"""Runs a machine on an LCM bus: against a clock, or in lock-step with its controller."""

from __future__ import annotations

import json
import logging
import os
import socket
import threading
import time
from collections.abc import Callable
from math import inf
from typing import Any

from vtbdrake.control.clock import Clock, WallClock
from vtbdrake.control.json_object import json_object
from vtbdrake.control.statistics import Histogram, LoopStatistics
from vtbdrake.lcm.connections import LcmLink
from vtbdrake.machine.faults import InjectedFaultError, fault_from_dict
from vtbdrake.machine.machine import Machine

_log = logging.getLogger(__name__)

DIED = 70
"""Exit code of a machine that was told to die."""

_BURST = 200  # messages to take in at a time
_SLICE = 0.005  # s to wait for commands before looking at requests
_REPEAT = 0.2  # s after which a state is told again, in lock-step on a bus where nobody has commanded yet
_CATCH_UP = 0.05  # s


class MachineLoop:
    """A machine and its connection to the bus.

    Requests come on the config's ``control_channel``, or by ``control``, as JSON: a fault, as `to_dict` gives it
    (``{"fault": "drop", "fraction": 0.5}``), variables of its world to set (``{"set": {"sim.sys.payload.mass": 1}}``),
    or ``{"request": NAME}``:

    * ``status``: nothing else;
    * ``normal``: ends all faults;
    * ``statistics``: the answer has the statistics, too;
    * ``reset statistics``;
    * ``die``: the process ends at once, without a farewell.

    By ``control`` every request is one line and gets one line: the status, or ``{"error": ...}``. On the bus, the
    status goes to ``status_channel``: every ``status_period``, after each request, and when the brake falls in or is
    released.

    Attributes:
        statistics: of its cycles; ``step`` is the simulation.
        state_to_command: from telling a state to the next command's arrival (at the computer: the machine may be at
            work), in seconds; of states that are not answered before the next one, the oldest counts. A command does
            not say which state it answers: where all answers come more than a period late, they are taken for those to
            the next state.
        lost: seconds of the clock that the simulation could not keep up with.
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
        """
        Args:
            url: of the bus.
            clock: the wall's by default.
            control: a connected stream; the loop stops when its other end closes.

        Raises:
            BridgeError: there is no bus at ``url``.
        """
        self.machine = machine
        self.statistics = LoopStatistics(machine.config.period)
        self.state_to_command = Histogram()
        self.lost = 0.0
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
        self._told = inf
        self._next_status = 0
        handlers = {channel: self._receive for channel in machine.channels}
        handlers[machine.config.control_channel] = self._hear
        self._link = LcmLink(url, handlers, connect_timeout=connect_timeout, stamped=True)
        self._link.open()

    def stop(self) -> None:
        """Ends `run` after the present cycle; also from a signal handler."""
        self._stop.set()

    def close(self) -> None:
        """Gives the connection back."""
        self._link.close()

    def run(self, *, lock_step: bool = False, cycles: float = inf, ready: Callable[[], None] = lambda: None) -> None:
        """Tells the state at the beginning of each cycle. With the clock, the commands that have come by then act in
        it, as those of a robot on a fieldbus do: the answer to a state acts a period later. In lock-step, the answer
        acts in the cycle whose state it answers, as a testbed's DPS does in simulation.

        Args:
            lock_step: a cycle begins when one message has arrived on every command channel, instead of with the clock.
            cycles: after how many it ends.
            ready: called when the first state is told.

        Raises:
            RuntimeError: the simulation failed.
        """
        end = self.machine.cycle + cycles
        self.machine.refuse_late(not lock_step)
        self._messages = self.machine.messages()
        begin = self._clock.now() - self.machine.time
        self._tell()
        ready()
        while not self._stop.is_set() and self.machine.cycle < end:
            if lock_step:
                self._await_commands()
                if not self._stop.is_set():
                    self._cycle_in_lock_step()
            else:
                begin = self._cycle_by_clock(begin, end)
            self._serve()

    def _cycle_in_lock_step(self) -> None:
        begin = self._clock.now()
        step = self._advance(1)
        self._tell()
        self.statistics.record(lateness=0.0, step=step, cycle=self._clock.now() - begin)

    def _cycle_by_clock(self, begin: float, end: float) -> float:
        """Where the clock's zero was, and where it is after this cycle."""
        work = self._clock.now()
        begin, steps = self._behind(begin, work)
        step = self._advance(int(min(steps, end - self.machine.cycle)))
        worked = self._clock.now() - work
        deadline = begin + self.machine.time
        woke = self._await(deadline)
        if not self._stop.is_set():
            self._tell()
            self.statistics.record(lateness=woke - deadline, step=step, cycle=worked + self._clock.now() - woke)
            self.statistics.miss(steps - 1)
        return begin

    def _advance(self, cycles: int) -> float:
        """Does cycles, prepares what is to be told then, and gives the seconds that the simulation took."""
        begin = self._clock.now()
        for _ in range(cycles):
            self.machine.advance()
        took = self._clock.now() - begin
        self._messages = self.machine.messages()
        return took

    # -- when a cycle begins

    def _await(self, deadline: float) -> float:
        """Takes in what arrives until the deadline."""
        if isinstance(self._clock, WallClock):
            while (left := deadline - self._clock.now()) > 0.0 and not self._stop.is_set():
                self._link.take(left, _BURST)
        woke = self._clock.wait_until(deadline)
        self._link.take(0.0, _BURST)
        return woke

    def _behind(self, begin: float, now: float) -> tuple[float, int]:
        """Where the clock's zero is, and how many cycles are due: a body does not stop while nobody looks at it."""
        period = self.machine.config.period
        due = int((now - begin) / period + 1e-6) + 1 - self.machine.cycle
        steps = max(1, min(due, int(_CATCH_UP / period)))
        lost = max(0, due - steps) * period
        self.lost += lost
        return begin + lost, steps

    def _await_commands(self) -> None:
        """One message on every command channel."""
        channels = set(self.machine.channels)
        repeat = time.monotonic() + _REPEAT
        while not self._arrived >= channels and not self._stop.is_set():
            # One at a time: what is ahead of its cycle waits on the line.
            self._link.take(_SLICE, 1)
            self._serve()
            # Who comes to a new bus after the state was told would wait for it, and the machine for him.
            self._alone |= self._link.reconnections > self._reconnections
            if self._alone and time.monotonic() >= repeat:
                repeat = time.monotonic() + _REPEAT
                self._reconnections = self._link.reconnections
                self._publish()
        self._arrived.clear()
        self._alone = False

    def _receive(self, channel: str, data: bytes) -> None:
        arrived = self._link.arrived or time.monotonic()
        if self._told <= arrived:
            self.state_to_command.record(arrived - self._told)
            self._told = inf
        self._arrived.add(channel)
        self.machine.receive(channel, data)

    # -- what it tells

    def _tell(self) -> None:
        # Before they leave: where the controller preempts this process, its answer is there before `_publish` returns.
        # A state without an answer counts until one comes.
        self._told = min(self._told, time.monotonic())
        self._publish()
        braking = self.machine.braking
        if self.machine.cycle >= self._next_status or braking != self._braking:
            self._braking = braking
            self._tell_status()

    def _publish(self) -> None:
        self._link.publish(*self._messages)

    def _tell_status(self) -> None:
        config = self.machine.config
        self._next_status = self.machine.cycle + max(1, round(config.status_period / config.period))
        self._link.publish((config.status_channel, json.dumps(self.machine.status().to_dict()).encode()))

    # -- requests

    def _hear(self, channel: str, data: bytes) -> None:
        self._answer(data)
        self._tell_status()

    def _serve(self) -> None:
        if self._control is None:
            return
        try:
            received = self._control.recv(65536)
        except BlockingIOError:
            return
        except OSError:
            received = b""
        if not received:
            _log.info("the one who started the machine is gone")
            self._stop.set()
            return
        *lines, self._lines = (self._lines + received).split(b"\n")
        for line in lines:
            try:
                # Who asks waits for the answer, so that there is room for it.
                self._control.sendall(json.dumps(self._answer(line)).encode() + b"\n")
            except OSError as error:
                _log.warning("an answer could not be given: %s", error)
                self._stop.set()

    def _answer(self, text: bytes) -> dict[str, Any]:
        try:
            more = self._do(json_object(text, InjectedFaultError))
        except ValueError as error:
            _log.warning("request refused: %s", error)
            return {"error": str(error)}
        return {**self.machine.status().to_dict(), **more}

    def _do(self, request: dict[str, Any]) -> dict[str, Any]:
        if "fault" in request:
            self.machine.begin(fault_from_dict(request))
            return {}
        if "set" in request:
            self.machine.write(_values(request["set"]))
            return {}
        name = request.get("request")
        if name == "die":
            os._exit(DIED)
        if name == "normal":
            self.machine.normal()
        elif name == "reset statistics":
            self.statistics = LoopStatistics(self.machine.config.period)
            self.state_to_command = Histogram()
            self.lost = 0.0
        elif name == "statistics":
            return {
                "statistics": self.statistics.to_dict(),
                "state_to_command": self.state_to_command.to_dict(),
                "lost": self.lost,
            }
        elif name != "status":
            raise InjectedFaultError(
                "a request is a fault, values to set, or one of status, normal, statistics, reset statistics, die; it "
                f"cannot be {request!r}"
            )
        return {}


def _values(given: Any) -> dict[str, Any]:
    if not isinstance(given, dict):
        raise InjectedFaultError(f"what is set is given by address, unlike {given!r}")
    return given
