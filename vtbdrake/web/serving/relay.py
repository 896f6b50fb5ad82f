"""Passes Drake's Meshcat page on under an origin of our own, and what it shows, as far as the browser keeps up."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Awaitable, Callable
from typing import Any

import msgpack  # type: ignore[import-untyped]

_TRANSFORM = "set_transform"
_OBJECT = "set_object"
_PROPERTY = "set_property"
_HEAD = 1024  # bytes in which type and path of a message stand: objects may be large, and are not unpacked


class Newest:
    """A queue of Meshcat's messages, in which a pose, an object or a property replaces an older one that still waits.

    What is replaced keeps its place in the queue. Poses and properties never overtake another object, nor anything a
    message of another kind: it may delete what they are of. A pose that is the same as the last one of its path is left
    out: the viewer draws anew for every message, and most of the time nothing moves.
    """

    def __init__(self) -> None:
        self._messages: deque[list[bytes]] = deque()
        # Those that wait and may be replaced, by path (and name of the property).
        self._waiting: dict[str, dict[str, list[bytes]]] = {_TRANSFORM: {}, _OBJECT: {}, _PROPERTY: {}}
        # The last pose of each path, waiting or sent.
        self._poses: dict[str, bytes] = {}
        self._arrived = asyncio.Event()
        self.replaced = 0  # number of messages that were never sent

    def put(self, data: bytes) -> None:
        """Add a message."""
        kind, place = _kind_and_place(data)
        if kind == _TRANSFORM:
            if self._poses.get(place) == data:
                self.replaced += 1
                return
            self._poses[place] = data
        elif kind != _OBJECT:  # It may move something, or delete it.
            self._poses.clear()
        if (waiting := self._waiting.get(kind, {}).get(place)) is not None:
            waiting[0] = data
            self.replaced += 1
            return
        entry = [data]
        self._messages.append(entry)
        if kind == _OBJECT:
            self._waiting[_TRANSFORM].clear()
            self._waiting[_PROPERTY].clear()
        if kind in self._waiting:
            self._waiting[kind][place] = entry
        else:
            for replaceable in self._waiting.values():
                replaceable.clear()
        self._arrived.set()

    async def get(self) -> bytes:
        """Return the next message."""
        while not self._messages:
            self._arrived.clear()
            await self._arrived.wait()
        return self.get_nowait()

    def __len__(self) -> int:
        return len(self._messages)

    def get_nowait(self) -> bytes:
        """Return the next message; there must be one."""
        entry = self._messages.popleft()
        kind, place = _kind_and_place(entry[0])
        if self._waiting.get(kind, {}).get(place) is entry:
            del self._waiting[kind][place]
        return entry[0]


async def relay(receive: Callable[[], Awaitable[bytes | str]], send: Callable[[bytes], Awaitable[None]]) -> None:
    """Pass on messages until one of the two ends fails.

    Args:
        receive: Returns the next message of Meshcat.
        send: Sends a message to the browser, and returns when it may send the next one.
    """
    messages = Newest()

    async def read() -> None:
        while True:
            data = await receive()
            messages.put(data if isinstance(data, bytes) else data.encode())

    async def write() -> None:
        while True:
            await send(await messages.get())
            # Neither of the two need wait, and only in a turn of the event loop is it noticed that the browser is gone.
            await asyncio.sleep(0.0)

    tasks = [asyncio.create_task(read()), asyncio.create_task(write())]
    try:
        await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


def moves_camera(data: bytes | str) -> bool:
    """Return whether a message moves the camera."""
    head = data[:_HEAD] if isinstance(data, bytes) else b""
    return b"set_target" in head[:32] or _kind_and_place(head)[1].startswith("/Cameras/")


def _kind_and_place(data: bytes) -> tuple[str, str]:
    """Return the type of a message, and its path (with the name of the property); empty if they do not come first."""
    unpacker = msgpack.Unpacker()
    unpacker.feed(data[:_HEAD])
    head: dict[str, Any] = {}
    try:
        for _ in range(min(unpacker.read_map_header(), 3 if _PROPERTY.encode() in data[:64] else 2)):
            name = unpacker.unpack()
            head[name] = unpacker.unpack()
    except (ValueError, msgpack.OutOfData, msgpack.UnpackException):
        return "", ""
    kind, path = head.get("type"), head.get("path")
    if not isinstance(kind, str) or not isinstance(path, str):
        return "", ""
    return (kind, f"{path} {head.get('property')}") if kind == _PROPERTY else (kind, path)
