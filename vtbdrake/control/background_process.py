"""Background processes for slow or blocking tasks of the control loop, which never waits for them."""

from __future__ import annotations

import contextlib
import logging
import os
import select
import socket
import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from typing import Any

from vtbdrake.common.child_process import ChildProcess
from vtbdrake.common.frames import CHUNK, LENGTH, FrameConnection, pack, unpack

_log = logging.getLogger(__name__)

_BUFFER = 1 << 20  # bytes of a socket's send buffer; the system may grant less

START_TIMEOUT = 120.0
"""Seconds within which a background process must have started; a computer with much else to do needs many of them."""


class BackgroundProcess:
    """A child process that runs ``function(connection, *arguments)``, with a `FrameConnection`.

    No call waits for the worker, except `wait_until_ready`, `wait_for_messages`, `drain` and `close`; to start one
    takes some milliseconds. It has ordinary scheduling on all processors, whatever the loop has. `close` ends it, and
    so does the end of this process.

    Args:
        function: A function of a `FrameConnection` and the arguments; it returns or raises EOFError when no more frames
            come. It is sent by cloudpickle.
        arguments: Picklable values.
        name: The name of the worker in errors and logs.
        backlog: The number of bytes that may wait to be sent; frames beyond that are dropped.
    """

    def __init__(self, function: Callable[..., None], *arguments: Any, name: str, backlog: int = 1 << 24) -> None:
        self.dropped = 0  # the number of frames that were dropped
        self.ready = False  # whether the worker is known to have imported its function
        self._backlog = backlog
        self._unsent: deque[memoryview] = deque()
        self._unsent_bytes = 0
        self._received: list[bytes] = []
        self._lost = False
        self._closing = False
        self._child = ChildProcess(_serve, function, arguments, name=name)
        self._socket = self._child.connection
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER)
        self._socket.setblocking(False)
        self._connection = FrameConnection(self._socket)

    @property
    def pid(self) -> int:
        """Return the process id of the worker."""
        return self._child.pid

    @property
    def alive(self) -> bool:
        """Return True while the worker runs and can be reached."""
        return not self._lost and self._child.alive

    @property
    def unsent(self) -> int:
        """Return the number of bytes that wait to be sent."""
        return self._unsent_bytes

    def post(self, message: Any) -> bool:
        """Send a message, without waiting; its arrays must not change until they are sent. See `post_frame`."""
        return self.post_frame(*pack(message))

    def post_frame(self, *parts: bytes) -> bool:
        """Send one frame that consists of the parts, without waiting.

        A frame that is too long to be sent at once is not copied: its parts must not change until they are sent.

        Returns:
            False if the frame was dropped, because the backlog is full or the worker is lost.
        """
        size = sum(map(len, parts))
        if self._lost or (self._unsent_bytes and self._unsent_bytes + size > self._backlog):
            self.dropped += 1
            return False
        pieces: list[bytes | memoryview] = [LENGTH.pack(size), *parts]
        if size <= CHUNK:
            pieces = [memoryview(b"".join(pieces))]
            if not self._unsent:
                pieces = [pieces[0][self._push(pieces[0]) :]]
        self._enqueue(pieces)
        self.flush()
        self.dropped += self._lost
        return not self._lost

    def _enqueue(self, pieces: Iterable[bytes | memoryview]) -> None:
        for piece in pieces:
            if len(piece):
                self._unsent.append(memoryview(piece))
                self._unsent_bytes += len(piece)

    def flush(self) -> None:
        """Send waiting data as far as the socket has room, at most 256 KiB, so that it takes little time."""
        left = CHUNK
        while self._unsent and left > 0 and not self._lost:
            first = self._unsent[0]
            sent = self._push(first[:left])
            self._unsent_bytes -= sent
            left -= sent
            if sent == len(first):
                self._unsent.popleft()
            else:
                self._unsent[0] = first[sent:]
                if not sent:
                    return

    def _push(self, data: bytes | memoryview) -> int:
        try:
            return self._socket.send(data)
        except BlockingIOError:
            return 0
        except OSError as error:
            self._lose(error)
            return 0

    def _lose(self, reason: Exception) -> None:
        if not (self._lost or self._closing):
            _log.error("%s (process %d) is lost: %s", self._child.name, self.pid, reason)
        self._lost = True

    def pop_messages(self) -> list[Any]:
        """Return the messages that the worker has sent since the last call, in order, without waiting."""
        return list(map(unpack, self.pop_frames()))

    def pop_frames(self) -> list[bytes]:
        """Return the frames that the worker has sent since the last call, in order, without waiting."""
        self._receive()
        frames, self._received = self._received, []
        return frames

    def _receive(self) -> None:
        if self._socket.fileno() < 0:
            return
        try:
            frames = self._connection.pop_frames()
        except (EOFError, OSError) as error:
            self._lose(error)
            return
        # The first frame says that it is ready.
        self._received += frames if self.ready else frames[1:]
        self.ready = self.ready or bool(frames)

    def wait_until_ready(self, timeout: float = START_TIMEOUT) -> bool:
        """Wait until the worker has imported its function; return False if it has ended or is late."""
        return self._wait(lambda: self.ready, timeout)

    def wait_for_messages(self, timeout: float) -> list[Any]:
        """Return the messages that the worker has sent, waiting for the first; none if it has ended or is late."""
        self._wait(lambda: bool(self._received), timeout)
        return self.pop_messages()

    def _wait(self, condition: Callable[[], bool], timeout: float) -> bool:
        end = time.monotonic() + timeout
        while not condition() and self.alive and (left := end - time.monotonic()) > 0.0:
            select.select((self._socket,), (self._socket,) if self._unsent else (), (), left)
            self._receive()
            self.flush()
        return condition()

    def fileno(self) -> int:
        """Return the descriptor that becomes readable when frames arrive, or when the worker is lost."""
        return self._socket.fileno()

    def drain(self, timeout: float = 10.0) -> None:
        """Wait until all frames are sent, for ``timeout`` seconds at most."""
        end = time.monotonic() + timeout
        while self._unsent and self.alive and (left := end - time.monotonic()) > 0.0:
            # A worker whose own frames are not taken waits for room, and reads nothing.
            select.select((self._socket,), (self._socket,), (), left)
            self._receive()
            self.flush()

    def close(self, timeout: float = 10.0) -> int:
        """Send what waits, let the worker finish, and return its exit code (negative: ended by that signal).

        After ``timeout`` seconds it is killed. `pop_messages` still returns what it has sent.
        """
        end = time.monotonic() + timeout
        self.drain(timeout)
        try:
            self._socket.shutdown(socket.SHUT_WR)
        except OSError as error:
            self._lose(error)
        self._closing = True
        while not self._lost and (left := end - time.monotonic()) > 0.0:
            select.select((self._socket,), (), (), left)
            self._receive()
        return self._child.close(max(0.0, end - time.monotonic()))

    def kill(self) -> None:
        """End the worker at once; `pop_messages` still returns the data that it has sent."""
        self._closing = True
        self._child.kill()
        self._receive()
        self._lost = True
        self._child.close()


def _serve(connection: socket.socket, function: Callable[..., None], arguments: Sequence[Any]) -> None:
    """Run the child process of a `BackgroundProcess`."""
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    # The loop may have reserved processors, where nothing else should run.
    os.sched_setaffinity(0, range(os.cpu_count() or 1))
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER)
    frames = FrameConnection(connection)
    with contextlib.suppress(BrokenPipeError, ConnectionResetError):
        frames.send_frame()  # If nobody reads it any more, what was sent before is still to be handled.
    try:
        function(frames, *arguments)
    except (EOFError, BrokenPipeError, ConnectionResetError):
        return  # The loop's process has closed the connection, or has ended.
