"""A process that works for the loop without holding it up: it writes files, computes what takes long, tells others."""

from __future__ import annotations

import logging
import os
import pickle
import select
import socket
import struct
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable, Iterable
from typing import Any

from vtbdrake.control.streams import Frames
from vtbdrake.interpreter import command
from vtbdrake.pickling import dumps

_log = logging.getLogger(__name__)

_LENGTH = struct.Struct("<Q")
_CHUNK = 1 << 18
_BUFFER = 1 << 20  # of the socket, in bytes; the system may grant less


class FrameConnection:
    """The companion's own end of the line; its calls wait."""

    def __init__(self, line: socket.socket) -> None:
        self._line = line
        self._frames = Frames()

    def fileno(self) -> int:
        """What becomes readable when frames arrive."""
        return self._line.fileno()

    def receive(self, timeout: float | None = None) -> bytes:
        """The next frame.

        Raises:
            EOFError: there are no more.
            TimeoutError: none came within ``timeout`` seconds.
        """
        deadline = None if timeout is None else time.monotonic() + timeout
        while (frame := self._frames.frame()) is None:
            left = None if deadline is None else max(0.0, deadline - time.monotonic())
            if not select.select((self._line,), (), (), left)[0]:
                raise TimeoutError(f"no frame came within {timeout} s")
            if not self._frames.receive(self._line.fileno(), _CHUNK):
                raise EOFError("the loop's end of the line is closed")
        return frame

    def send(self, *parts: bytes) -> None:
        """Sends one frame, of the parts' bytes one after another.

        Raises:
            OSError: the other end is closed.
        """
        self._line.sendall(b"".join((_LENGTH.pack(sum(map(len, parts))), *parts)))


class WorkerProcess:
    """A process of its own at the other end of a socket: a fresh interpreter that runs ``function(channel,
    *arguments)``.

    It ends with `close`, and with the process that started it, whose end of the line then closes. No call of it waits,
    except for `close`; to start one takes some milliseconds. It has ordinary scheduling and leaves Ctrl-C to the main
    process.

    Args:
        function: of a `FrameConnection` and the arguments; travels by cloudpickle, with them.
        name: what it is called in errors and logs.
        backlog: bytes that may wait for it; frames beyond that are dropped.

    Attributes:
        dropped: how many frames were not taken.
    """

    def __init__(self, function: Callable[..., None], *arguments: Any, name: str, backlog: int = 1 << 24) -> None:
        self.name = name
        self.dropped = 0
        self._backlog = backlog
        self._waiting: deque[memoryview] = deque()
        self._waits = 0
        self._frames = Frames()
        self._back: list[bytes] = []
        self._gone = False
        self._ending = False  # because we want it to
        self._line, theirs = socket.socketpair()
        with theirs:
            for end in (self._line, theirs):
                end.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER)
            self._line.setblocking(False)
            self._process = subprocess.Popen(
                command("vtbdrake.control.worker_process", str(theirs.fileno())),
                pass_fds=[theirs.fileno()],
                stdin=subprocess.DEVNULL,
            )
        self.post(dumps((function, arguments)))

    @property
    def pid(self) -> int:
        """Of its process."""
        return self._process.pid

    @property
    def alive(self) -> bool:
        """Whether it runs."""
        return not self._gone and self._process.poll() is None

    @property
    def waiting(self) -> int:
        """Bytes that wait to be sent."""
        return self._waits

    def post(self, *parts: bytes) -> bool:
        """Sends one frame, of the parts' bytes one after another; whether it was taken.

        What is too long to go at once is not copied: it waits as it is, and must not change.
        """
        size = sum(map(len, parts))
        if self._gone or (self._waits and self._waits + size > self._backlog):
            self.dropped += 1
            return False
        pieces: list[bytes | memoryview] = [_LENGTH.pack(size), *parts]
        if size <= _CHUNK:
            pieces = [memoryview(b"".join(pieces))]
            if not self._waiting:
                pieces = [pieces[0][self._push(pieces[0]) :]]
        self._keep(pieces)
        self.flush()
        self.dropped += self._gone
        return not self._gone

    def _keep(self, pieces: Iterable[bytes | memoryview]) -> None:
        for piece in pieces:
            if len(piece):
                self._waiting.append(memoryview(piece))
                self._waits += len(piece)

    def flush(self) -> None:
        """Sends what waits, as far as there is room, but not so much that it takes long."""
        left = _CHUNK
        while self._waiting and left > 0 and not self._gone:
            first = self._waiting[0]
            sent = self._push(first[:left])
            self._waits -= sent
            left -= sent
            if sent == len(first):
                self._waiting.popleft()
            else:
                self._waiting[0] = first[sent:]
                if not sent:
                    return

    def _push(self, data: bytes | memoryview) -> int:
        try:
            return self._line.send(data)
        except BlockingIOError:
            return 0
        except OSError as error:
            self._lose(error)
            return 0

    def _lose(self, reason: OSError | str) -> None:
        if not self._gone:
            self._gone = True
            if not self._ending:
                _log.error("%s (process %d) is gone: %s", self.name, self.pid, reason)

    def take(self) -> list[bytes]:
        """The frames that came back since it was asked last, in order."""
        self._receive()
        found, self._back = self._back, []
        return found

    def _receive(self) -> None:
        if self._line.fileno() < 0:
            return
        size = _CHUNK
        while size == _CHUNK:  # a smaller one was all that there was
            try:
                size = self._frames.receive(self._line.fileno(), _CHUNK)
            except OSError as error:
                self._lose(error)
                return
            if not size:
                self._lose("it has closed the line")
            while (frame := self._frames.frame()) is not None:
                self._back.append(frame)

    def fileno(self) -> int:
        """What becomes readable when frames come back."""
        return self._line.fileno()

    def drain(self, timeout: float = 10.0) -> None:
        """Waits until all that waits is sent, for ``timeout`` seconds at most."""
        end = time.monotonic() + timeout
        while self._waiting and self.alive and (left := end - time.monotonic()) > 0.0:
            # Who waits for room to say something does not listen.
            select.select((self._line,), (self._line,), (), left)
            self._receive()
            self.flush()

    def close(self, timeout: float = 10.0) -> int:
        """Sends what waits, tells it the end, and waits for it; after ``timeout`` seconds it is killed.

        Returns:
            The exit code; negative if a signal ended it.
        """
        end = time.monotonic() + timeout
        self.drain(timeout)
        try:
            self._line.shutdown(socket.SHUT_WR)
        except OSError as error:
            self._lose(error)
        self._ending = True
        # What it still has to say is taken in, for else it would wait for room.
        while not self._gone and (left := end - time.monotonic()) > 0.0:
            select.select((self._line,), (), (), left)
            self._receive()
        try:
            self._process.wait(max(0.0, end - time.monotonic()))
        except subprocess.TimeoutExpired:
            _log.error("%s (process %d) does not end, and is killed", self.name, self.pid)
        self.kill()
        return int(self._process.returncode)

    def kill(self) -> None:
        """Ends it at once; what came back before may still be taken."""
        self._ending = True
        self._process.kill()
        self._process.wait()
        if self._line.fileno() >= 0:
            self._receive()
            self._line.close()
        self._gone = True


def main() -> None:
    """The main program of a companion."""
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    # The loop may be confined to processors of its own, where nothing else is to work.
    os.sched_setaffinity(0, range(os.cpu_count() or 1))
    with socket.socket(fileno=int(sys.argv[1])) as line:
        channel = FrameConnection(line)
        try:
            function, arguments = pickle.loads(channel.receive())
            function(channel, *arguments)
        except (EOFError, BrokenPipeError, ConnectionResetError):
            return  # The loop's process has ended, or has closed the line.
