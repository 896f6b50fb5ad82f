"""The worker process's part: it speaks with those on the bus, so that the loop need not.

Between the loop and its worker process go frames of `pickle`, and those of `Values`, many and quick.
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

from vtbdrake.control.bridge import BridgeError
from vtbdrake.control.worker_process import FrameConnection
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
    ResetRequest,
    SetRequest,
    nested,
    parse,
    parse_id,
    to_json,
)

_log = logging.getLogger(__name__)

MAX_WAITING = 16
"""Requests that the loop has not fulfilled yet."""
MAX_WATCHES = 16

_TICK = 0.1  # s; leases are no more exact than that
_BURST = 200  # messages to take in at a time
_MEMORY = 1000  # requests to set and get that are known if they are said again
_CONNECT_TIMEOUT = 2.0  # s
_TRY_AGAIN = 0.5  # s

# From the loop:
VALUES = b"v"  # records of what was read
TEXT = b"t"  # a pickled (number of a request, what became of it)
_HEAD = struct.Struct("<IQddI")


def values_record(number: int, cycle: int, since: float, time: float, entries: Sequence[float]) -> bytes:
    """What was read for request ``number``; records, one after another, make a frame of `VALUES`."""
    return struct.pack(f"<IQddI{len(entries)}d", number, cycle, since, time, len(entries), *entries)


def text_frame(number: int, **outcome: Any) -> bytes:
    """A frame of what became of request ``number``: ``ok``, ``error``, ``unknown`` (an address) or ``shapes``."""
    return TEXT + pickle.dumps((number, outcome))


@dataclass
class _Task:
    """A request that the loop has, and who wants it."""

    request: Request
    channel: str
    ends: float
    shapes: Sequence[tuple[int, ...]] = ()
    answered: bool = False


class Desk:
    """Takes in requests from the bus, checks them, hands them to the loop, and sends what comes back.

    Attributes:
        refused: how many requests were.
    """

    def __init__(self, channel: FrameConnection, url: str, addresses: Sequence[str]) -> None:
        self.refused = 0
        self._loop = channel
        self._addresses = addresses
        self._link = LcmLink(url, dict.fromkeys((SET, GET, RESET, WATCH), self._hear), connect_timeout=_CONNECT_TIMEOUT)
        self._open()
        self._tasks: dict[int, _Task] = {}
        self._numbers = 0
        self._heard: deque[str] = deque(maxlen=_MEMORY)
        self._told = 0  # of those refused
        self._tell_next = 0.0

    def _open(self) -> None:
        """Connects to the bus, sooner or later.

        Raises:
            EOFError: the loop's end of the line has closed before that.
        """
        told = False
        while not self._link.is_open:
            try:
                self._link.open()
            except BridgeError as error:
                if not told:
                    _log.error("the live service waits for the bus, nobody can get or set: %s", error)
                told = True
                with contextlib.suppress(TimeoutError):
                    self._loop.receive(_TRY_AGAIN)  # Nothing comes but the end.

    def run(self) -> None:
        """Until the loop's end of the line closes."""
        try:
            while True:
                sources: list[Any] = [self._loop, *self._link.sources]
                select.select(sources, (), (), _TICK)
                while self._link.take(0.0, _BURST) == _BURST:
                    pass
                self._take_frames()
                self._end_leases()
                self._tell_refused()
        except EOFError:
            for task in self._tasks.values():
                self._say(task, ended=True)
        finally:
            self._link.close()

    # -- from the bus

    def _hear(self, channel: str, data: bytes) -> None:
        try:
            request = parse(channel, data)
            self._accept(channel, request)
        except RequestError as error:
            self.refused += 1
            self._publish(channel + ANSWER, {"id": parse_id(data), "error": str(error)})

    def _accept(self, channel: str, request: Request) -> None:
        """
        Raises:
            RequestError: there are too many.
        """
        now = time.monotonic()
        if channel != WATCH:
            if request.id in self._heard:
                return
            self._heard.append(request.id)
        elif isinstance(request, ReadRequest):
            if self._renewed(request, now) or not request.addresses:
                return
            if sum(task.channel == WATCH for task in self._tasks.values()) >= MAX_WATCHES:
                raise RequestError(
                    f"there are {MAX_WATCHES} watches already: end one, or wait for the end of its lease"
                )
        if sum(not task.answered for task in self._tasks.values()) >= MAX_WAITING:
            raise RequestError(f"{MAX_WAITING} requests wait already: try again")
        self._numbers += 1
        lease = request.lease if isinstance(request, ReadRequest) else 0.0
        self._tasks[self._numbers] = _Task(request, channel, now + lease)
        self._loop.send(pickle.dumps((self._numbers, _order(request))))

    def _renewed(self, request: ReadRequest, now: float) -> bool:
        """Whether this is the renewal of a watch; one that has changed, or has ended, is taken away."""
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

    def _tell_refused(self) -> None:
        now = time.monotonic()
        if self.refused > self._told and now >= self._tell_next:
            self._told, self._tell_next = self.refused, now + _TICK
            self._loop.send(pickle.dumps((0, ("refused", self.refused))))

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
                    start = self._tell_values(frame, start)
            else:
                self._conclude(*pickle.loads(frame[1:]))

    def _conclude(self, number: int, outcome: dict[str, Any]) -> None:
        task = self._tasks.get(number)
        if task is None:
            return
        if "unknown" in outcome:
            outcome = {"error": self._unknown(outcome["unknown"])}
        if "shapes" in outcome:
            task.shapes = outcome["shapes"]
            if task.channel == WATCH:
                task.answered = True
                self._say(task, ok=True)
            return
        del self._tasks[number]
        self.refused += "error" in outcome
        self._say(task, **outcome)

    def _unknown(self, address: str) -> str:
        if address in self._addresses:
            return f"{address} is an output port: it is read, not set"
        # Only who mistypes an address pays for Drake.
        from vtbdrake.state.variables import suggestion

        return f"there is no variable and no output port {address!r}{suggestion(address, self._addresses)}"

    def _tell_values(self, frame: bytes, start: int) -> int:
        """Tells the record that begins at ``start``; where the next one does."""
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
            self._say(task, ok=True, time=now, values=values)
        return int(end)

    def _say(self, task: _Task, **outcome: Any) -> None:
        self._publish(task.channel + ANSWER, {"id": task.request.id, **outcome})

    def _publish(self, channel: str, message: dict[str, Any]) -> None:
        self._link.publish((channel, to_json(message)))


def _order(request: Request) -> tuple[Any, ...]:
    if isinstance(request, SetRequest):
        return ("set", request.values)
    if isinstance(request, ResetRequest):
        return ("reset", ())
    return ("read", request.addresses, request.every)


def attend(channel: FrameConnection, url: str, addresses: Sequence[str]) -> None:
    """The main program of the worker process."""
    Desk(channel, url, addresses).run()
