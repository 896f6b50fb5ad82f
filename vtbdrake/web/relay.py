"""Passes Drake's Meshcat page on under an origin of our own, and what it shows, as far as the browser keeps up."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Awaitable, Callable

import msgpack  # type: ignore[import-untyped]

_TRANSFORM, _OBJECT = "set_transform", "set_object"
_HEAD = 1024  # bytes in which type and path of a message stand: objects may be large, and are not unpacked


class Newest:
    """A queue of Meshcat's messages, in which a pose or an object replaces an older one of its path that still waits.

    A transform never overtakes another message: what comes after it may delete its object. An object, such as the
    points of a scan, overtakes transforms and objects alone.
    """

    def __init__(self) -> None:
        self._messages: deque[list[bytes]] = deque()
        # Those that wait and may be replaced, by path.
        self._waiting: dict[str, dict[str, list[bytes]]] = {_TRANSFORM: {}, _OBJECT: {}}
        self._arrived = asyncio.Event()
        self.replaced = 0  # number of messages that were never sent

    def put(self, data: bytes) -> None:
        """Add a message."""
        kind, path = _kind_and_path(data)
        if (waiting := self._waiting.get(kind, {}).get(path)) is not None:
            waiting[0] = data
            self.replaced += 1
            return
        entry = [data]
        self._messages.append(entry)
        if kind != _TRANSFORM:
            self._waiting[_TRANSFORM].clear()
        if kind not in self._waiting:
            self._waiting[_OBJECT].clear()
        else:
            self._waiting[kind][path] = entry
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
        kind, path = _kind_and_path(entry[0])
        if self._waiting.get(kind, {}).get(path) is entry:
            del self._waiting[kind][path]
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

    tasks = [asyncio.create_task(read()), asyncio.create_task(write())]
    try:
        await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


def _kind_and_path(data: bytes) -> tuple[str, str]:
    """Return the type and the path of a message, in which they come first; empty if they do not."""
    unpacker = msgpack.Unpacker(strict_map_key=False)
    unpacker.feed(data[:_HEAD])
    try:
        unpacker.read_map_header()
        names, values = [], []
        for _ in range(2):
            names.append(unpacker.unpack())
            values.append(unpacker.unpack())
    except (ValueError, msgpack.OutOfData, msgpack.UnpackException):
        return "", ""
    return (str(values[0]), str(values[1])) if names == ["type", "path"] else ("", "")
