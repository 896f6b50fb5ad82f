"""Passes Drake's Meshcat page on under an origin of our own, and what it shows, as far as the browser keeps up."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Awaitable, Callable

import msgpack  # type: ignore[import-untyped]

_TRANSFORM = "set_transform"


class Newest:
    """A queue of Meshcat's messages, in which a transform replaces an older one of the same path that still waits.

    A transform never overtakes another message: what comes after it may delete its object.
    """

    def __init__(self) -> None:
        self._messages: deque[list[bytes]] = deque()
        self._transforms: dict[str, list[bytes]] = {}
        self._arrived = asyncio.Event()
        self.replaced = 0  # number of transforms that were never sent

    def put(self, data: bytes) -> None:
        """Add a message."""
        path = _path_of_transform(data)
        if path is not None and (waiting := self._transforms.get(path)) is not None:
            waiting[0] = data
            self.replaced += 1
            return
        entry = [data]
        self._messages.append(entry)
        if path is None:
            self._transforms.clear()
        else:
            self._transforms[path] = entry
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
        path = _path_of_transform(entry[0])
        if path is not None and self._transforms.get(path) is entry:
            del self._transforms[path]
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


def _path_of_transform(data: bytes) -> str | None:
    """Return the path of a message that sets a transform, or None of another message."""
    if _TRANSFORM.encode() not in data[:64]:  # Objects may be large: they are not unpacked.
        return None
    message = msgpack.unpackb(data)
    return str(message["path"]) if message.get("type") == _TRANSFORM else None
