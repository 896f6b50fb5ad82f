"""The server of live values: it communicates with the clients on the bus, in a worker process of the loop.

The loop sends frames of two kinds: `VALUES`, many and quick, and pickled outcomes of requests. The server sends it
pickled requests.
"""

from __future__ import annotations

import contextlib
import logging
import pickle
import select
import struct
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from math import prod
from typing import Any

from vtbdrake.argument_checks import suggestion
from vtbdrake.control.background_process import FrameConnection
from vtbdrake.control.bridge import BridgeError
from vtbdrake.lcm.connections import LcmLink
from vtbdrake.monitoring.live.messages import (
    ANSWER,
    GET,
    RESET,
    SET,
    WATCH,
    WATCHED,
    ReadRequest,
    Request,
    RequestError,
    nested,
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

# Frames of the loop:
VALUES = b"v"  # records of values
OUTCOME = b"o"  # a pickled (number of a request, outcome)
_HEAD = struct.Struct("<IQddI")


def values_record(number: int, cycle: int, since: float, time: float, entries: Sequence[float]) -> bytes:
    """Return a record of the values read for request ``number``; concatenated records make a frame of `VALUES`."""
    return struct.pack(f"<IQddI{len(entries)}d", number, cycle, since, time, len(entries), *entries)


def outcome_frame(number: int, **outcome: Any) -> bytes:
    """Return a frame with the outcome of request ``number``: ``ok``, ``error``, ``unknown`` (address) or ``shapes``."""
    return OUTCOME + pickle.dumps((number, outcome))


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
            url, dict.fromkeys((SET, GET, RESET, WATCH), self._receive), connect_timeout=_CONNECT_TIMEOUT
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
                    self._loop.receive(_RETRY_PERIOD)  # The loop sends nothing before the first request.

    def run(self) -> None:
        """Serve until the loop closes its connection."""
        try:
            while True:
                sources: list[Any] = [self._loop, *self._link.sources]
                select.select(sources, (), (), _TICK)
                while self._link.take(0.0, _BURST) == _BURST:
                    pass
                self._take_frames()
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
        self._loop.send(pickle.dumps((self._num_tasks, request)))

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
        self._loop.send(pickle.dumps((number, None)))

    def _report_rejected(self) -> None:
        now = time.monotonic()
        if self.rejected > self._reported and now >= self._next_report:
            self._reported, self._next_report = self.rejected, now + _TICK
            self._loop.send(pickle.dumps((0, self.rejected)))

    # -- from the loop

    def _take_frames(self) -> None:
        while True:
            try:
                frame = self._loop.receive(0.0)
            except TimeoutError:
                return
            if frame[:1] == VALUES:
                start = 1
                while start < len(frame):
                    start = self._publish_values(frame, start)
            else:
                self._finish(*pickle.loads(frame[1:]))

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

    def _publish_values(self, frame: bytes, start: int) -> int:
        """Publish the record that begins at ``start`` and return where the next one begins."""
        number, cycle, since, now, count = _HEAD.unpack_from(frame, start)
        end = start + _HEAD.size + 8 * count
        task = self._tasks.get(number)
        if task is None or not isinstance(task.request, ReadRequest):
            return int(end)
        entries = struct.unpack_from(f"<{count}d", frame, start + _HEAD.size)
        values, place = {}, 0
        for address, shape in zip(task.request.addresses, task.shapes, strict=True):
            values[address] = nested(entries[place : place + prod(shape)], shape)
            place += prod(shape)
        if task.channel == WATCH:
            self._publish(WATCHED + task.request.id, {"cycle": cycle, "since": since, "time": now, "values": values})
        else:
            del self._tasks[number]
            self._answer(task, ok=True, time=now, values=values)
        return int(end)

    def _answer(self, task: _Task, **outcome: Any) -> None:
        self._publish(task.channel + ANSWER, {"id": task.request.id, **outcome})

    def _publish(self, channel: str, message: dict[str, Any]) -> None:
        self._link.publish((channel, to_json(message)))


def serve(loop: FrameConnection, url: str, addresses: Sequence[str]) -> None:
    """Run a server in the worker process."""
    LiveServer(loop, url, addresses).run()
