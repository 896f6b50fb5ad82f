"""The server of live values: it communicates with the clients on the bus, in a worker process of the loop.

The loop sends `VALUES`, many and quick, and the outcomes of requests. The server sends it requests, each with a number.
"""

from __future__ import annotations

import contextlib
import logging
import select
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from math import prod
from typing import Any

import numpy as np

from vtbdrake.common.argument_checks import suggestion
from vtbdrake.common.frames import FrameConnection
from vtbdrake.control.bridge import BridgeError
from vtbdrake.lcm.connections import LcmLink
from vtbdrake.monitoring.live.messages import (
    ANSWER,
    GET,
    RESET,
    SET,
    STATUS,
    WATCH,
    WATCHED,
    ReadRequest,
    Request,
    RequestError,
    parse_request,
    request_id,
    to_json,
)

_log = logging.getLogger(__name__)

MAX_WAITING = 16
"""Limit on the requests that wait for the loop."""
MAX_WATCHES = 16
"""Limit on the watches."""

_TICK = 0.1  # s; resolution of leases
_BURST = 200  # messages taken at a time
_MEMORY = 1000  # requests to set and get whose repetition is recognized
_CONNECT_TIMEOUT = 2.0  # s
_RETRY_PERIOD = 0.5  # s

# The kinds of messages of the loop, which are pairs of a kind and its content:
VALUES = "values"  # a list of `Record`, tuples, which are written and read in a fraction of a microsecond
OUTCOME = "outcome"  # (number of a request, a dict with ``ok``, ``error``, ``unknown`` (address) or ``shapes``)

# The values of one round: the number of the request, the number of the cycle in which the round ended, the times of the
# DPS when it began and when it ended, and the entries of all values, concatenated.
Record = tuple[int, int, float, float, list[float]]


@dataclass
class _Task:
    """A request that was sent to the loop."""

    request: Request
    channel: str
    ends: float
    shapes: Sequence[tuple[int, ...]] = ()
    answered: bool = False


class LiveServer:
    """Receives requests from the bus, checks them, passes them on to the loop, and publishes the outcomes.

    Args:
        loop: Connection with the loop's process.
        url: LCM URL of the bus.
        addresses: Addresses of the output ports, and of the variables, of the loop's target.

    Raises:
        EOFError: The loop has closed its connection before there was a bus.
    """

    def __init__(self, loop: FrameConnection, url: str, addresses: Sequence[str]) -> None:
        self.rejected = 0  # number of rejected requests
        self._loop = loop
        self._addresses = addresses
        self._link = LcmLink(
            url, dict.fromkeys((SET, GET, RESET, STATUS, WATCH), self._receive), connect_timeout=_CONNECT_TIMEOUT
        )
        self._open()
        self._tasks: dict[int, _Task] = {}
        self._num_tasks = 0
        self._known_ids: deque[str] = deque(maxlen=_MEMORY)
        self._reported = 0  # of those rejected
        self._next_report = 0.0

    def _open(self) -> None:
        logged = False
        while not self._link.is_open:
            try:
                self._link.open()
            except BridgeError as error:
                if not logged:
                    _log.error("the live service waits for the bus, no client can get or set: %s", error)
                logged = True
                with contextlib.suppress(TimeoutError):
                    self._loop.receive_frame(_RETRY_PERIOD)  # The loop sends nothing before the first request.

    def run(self) -> None:
        """Serve until the loop closes its connection."""
        try:
            while True:
                sources: list[Any] = [self._loop, *self._link.sources]
                select.select(sources, (), (), _TICK)
                while self._link.receive(0.0, _BURST) == _BURST:
                    pass
                self._take_messages()
                self._end_leases()
                self._report_rejected()
        except EOFError:
            for task in self._tasks.values():
                self._answer(task, ended=True)
        finally:
            self._link.close()

    # -- from the bus

    def _receive(self, channel: str, data: bytes) -> None:
        try:
            self._accept(channel, parse_request(channel, data))
        except RequestError as error:
            self.rejected += 1
            self._publish(channel + ANSWER, {"id": request_id(data), "error": str(error)})

    def _accept(self, channel: str, request: Request) -> None:
        """Send a request to the loop, unless it repeats an earlier one."""
        now = time.monotonic()
        if channel != WATCH:
            if request.id in self._known_ids:
                return
            self._known_ids.append(request.id)
        elif isinstance(request, ReadRequest):
            if self._renew(request, now) or not request.addresses:
                return
            if sum(task.channel == WATCH for task in self._tasks.values()) >= MAX_WATCHES:
                raise RequestError(
                    f"watch rejected: {MAX_WATCHES} watches are active; end one, or wait for the end of its lease"
                )
        if sum(not task.answered for task in self._tasks.values()) >= MAX_WAITING:
            raise RequestError(f"request rejected: {MAX_WAITING} requests are waiting; try again")
        self._num_tasks += 1
        lease = request.lease if isinstance(request, ReadRequest) else 0.0
        self._tasks[self._num_tasks] = _Task(request, channel, now + lease)
        self._loop.send((self._num_tasks, request))

    def _renew(self, request: ReadRequest, now: float) -> bool:
        """Renew the lease of a watch and return whether there was one; drop a watch that has changed or ended."""
        for number, task in self._tasks.items():
            if task.channel == WATCH and task.request.id == request.id:
                if task.request == request:
                    task.ends = now + request.lease
                    return True
                self._drop(number)
                return False
        return False

    def _end_leases(self) -> None:
        now = time.monotonic()
        for number in [n for n, task in self._tasks.items() if task.channel == WATCH and task.ends < now]:
            self._drop(number)

    def _drop(self, number: int) -> None:
        del self._tasks[number]
        self._loop.send((number, None))

    def _report_rejected(self) -> None:
        now = time.monotonic()
        if self.rejected > self._reported and now >= self._next_report:
            self._reported, self._next_report = self.rejected, now + _TICK
            self._loop.send((0, self.rejected))

    # -- from the loop

    def _take_messages(self) -> None:
        while True:
            try:
                kind, content = self._loop.receive(0.0)
            except TimeoutError:
                return
            if kind == VALUES:
                for record in content:
                    self._publish_values(record)
            else:
                self._finish(*content)

    def _finish(self, number: int, outcome: dict[str, Any]) -> None:
        task = self._tasks.get(number)
        if task is None:
            return
        if "shapes" in outcome:
            task.shapes = outcome["shapes"]
            if task.channel == WATCH:
                task.answered = True
                self._answer(task, ok=True)
            return
        if "unknown" in outcome:
            outcome = {"error": self._unknown(outcome["unknown"])}
        del self._tasks[number]
        self.rejected += "error" in outcome
        self._answer(task, **outcome)

    def _unknown(self, address: str) -> str:
        if address in self._addresses:
            return f"{address} is a port: it can be read, not set"
        return f"there is no variable and no port {address!r}{suggestion(address, self._addresses)}"

    def _publish_values(self, record: Record) -> None:
        number, cycle, since, now, entries = record
        task = self._tasks.get(number)
        if task is None or not isinstance(task.request, ReadRequest):
            return
        values, place = {}, 0
        for address, shape in zip(task.request.addresses, task.shapes, strict=True):
            values[address] = np.reshape(entries[place : place + prod(shape)], shape).tolist()
            place += prod(shape)
        if task.channel == WATCH:
            self._publish(WATCHED + task.request.id, {"cycle": cycle, "since": since, "time": now, "values": values})
        else:
            del self._tasks[number]
            self._answer(task, ok=True, time=now, values=values)

    def _answer(self, task: _Task, **outcome: Any) -> None:
        self._publish(task.channel + ANSWER, {"id": task.request.id, **outcome})

    def _publish(self, channel: str, message: dict[str, Any]) -> None:
        self._link.publish((channel, to_json(message)))


def serve(loop: FrameConnection, url: str, addresses: Sequence[str]) -> None:
    """Run a server in the worker process.

    Args:
        loop: The connection to the process of the loop; the server ends when it is closed.
        url: URL of the LCM bus of the clients.
        addresses: The addresses of the running DPS that a client may name.
    """
    LiveServer(loop, url, addresses).run()
