"""Child processes: new Python interpreters that run one function and end with the process that started them."""

from __future__ import annotations

import contextlib
import gc
import logging
import os
import pickle
import queue
import signal
import socket
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from importlib.machinery import PathFinder
from logging.handlers import QueueHandler, QueueListener
from pathlib import Path
from types import FrameType
from typing import Any, Self

from vtbdrake.common.drake_version import UntestedDrakeWarning
from vtbdrake.common.quick_exit import quick_exit

_log = logging.getLogger(__name__)

ANSWER_TIMEOUT = 10.0
"""Time for a service to answer, and to end, in seconds."""

_MAX_LOG = 1000  # log messages that wait to be written; further ones are dropped

# What a terminal, systemd or `timeout` sends to all processes of a group.
_GROUP_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)

# A handler, where a program that the child starts would inherit that a signal is ignored, and could not be terminated.
# Without the garbage collector until all is imported: it would only look at what stays.
_BOOTSTRAP = """\
import gc, os, signal, sys
gc.disable()
def ignore(*_): pass
def restore():
    for number in (signal.SIGTERM, signal.SIGHUP): signal.signal(number, signal.SIG_DFL)
signal.signal(signal.SIGINT, signal.SIG_IGN)
for number in (signal.SIGTERM, signal.SIGHUP): signal.signal(number, ignore)
os.register_at_fork(after_in_child=restore)
signal.pthread_sigmask(signal.SIG_UNBLOCK, (signal.SIGINT, signal.SIGTERM, signal.SIGHUP))
sys.path[:] = {path!r}
from vtbdrake.common.child_process import _run
_run({files!r}, {grace!r})
"""


def _current_directory() -> str:
    try:
        return os.getcwd()
    except FileNotFoundError:  # It was deleted; nothing can be imported from it.
        return os.sep


_is_child = False  # whether this process is a `ChildProcess`

# Relative entries of sys.path (the "" of a notebook, or of `python -c`) refer to it.
_FIRST_DIRECTORY = _current_directory()


class ProcessStartError(RuntimeError):
    """A child process that cannot do its work; raised in the child, and in its parent by `wait_until_ready`."""


class ChildProcess:
    """A Python interpreter that runs ``function(connection, *arguments, *sockets)``, supervised through a socket.

    The child finds modules where this process finds them, and imports the same vtbdrake, even after a change of
    ``sys.path`` or of the current directory. It does not run the main module again. It ignores Ctrl-C, SIGTERM and
    SIGHUP, which a terminal, systemd or ``timeout`` send to all processes of a group: the parent decides what they
    mean, and still needs its children until it has ended its work.

    The child ends with its parent. When the parent's end of the connection closes, by `close` or because the parent has
    ended, ``function`` should return; ``grace`` seconds later the child exits, even if ``function`` is still computing.
    To restart a child, close it and create another one.

    Args:
        function: A function of the child's end of the connection and the arguments. It is sent by cloudpickle, so that
            it may be defined in a notebook.
        arguments: Picklable values.
        name: The name of the child in errors and logs, such as "the hub".
        sockets: Sockets that the child gets too, behind the arguments; they stay open here.
        grace: Time in seconds.

    Attributes:
        name: See above.
        connection: This end of the connection. What is sent here is between the parent and ``function``.
    """

    def __init__(
        self,
        function: Callable[..., object],
        *arguments: Any,
        name: str,
        sockets: Sequence[socket.socket] = (),
        grace: float = 10.0,
    ) -> None:
        from vtbdrake.common.pickling import dumps  # Here, because `import vtbdrake` should stay quick.

        self.name = name
        self._unanswered = 0  # the number of requests whose answers have not been read
        self._received = b""  # of answers
        self.connection, child_end = socket.socketpair()
        # A file, because a socket takes only so much before the child reads from it.
        with child_end, tempfile.TemporaryFile() as call:
            call.write(dumps((function, arguments)))
            call.seek(0)
            files = [child_end.fileno(), call.fileno(), *(each.fileno() for each in sockets)]
            program = _BOOTSTRAP.format(path=search_path(), files=files, grace=grace)
            # Blocked, signals wait until the child is ready to ignore them.
            blocked = signal.pthread_sigmask(signal.SIG_BLOCK, _GROUP_SIGNALS)
            try:
                self._process = subprocess.Popen(
                    [sys.executable, "-c", program], pass_fds=files, stdin=subprocess.DEVNULL
                )
            finally:
                signal.pthread_sigmask(signal.SIG_SETMASK, blocked)

    @property
    def pid(self) -> int:
        """Return the process id of the child."""
        return self._process.pid

    @property
    def exit_code(self) -> int | None:
        """Return the exit code: None while the child runs, the negative number of a signal that ended it."""
        return self._process.poll()

    @property
    def alive(self) -> bool:
        """Return True while the process exists, running or stopped."""
        return self.exit_code is None

    def wait_until_ready(self, timeout: float | None = 60.0) -> None:
        """Wait until the child has called `report_ready`. If that fails, or is interrupted, the child is killed.

        Args:
            timeout: Time in seconds; None to wait forever.

        Raises:
            ProcessStartError: The child has ended, with the reason if it raised this error; or it is late.
        """
        try:
            reason = self._read_reason(timeout).decode().strip()
        except BaseException as error:
            self.kill()
            self.connection.close()
            if isinstance(error, TimeoutError):
                raise ProcessStartError(
                    f"{self.name} (process {self.pid}) was not ready within {timeout:g} s"
                ) from error
            if isinstance(error, OSError):
                raise ProcessStartError(
                    f"{self.name} did not start (exit code {self.exit_code}): see its output above"
                ) from error
            raise
        if reason:
            self.close()
            raise ProcessStartError(reason)

    def _read_reason(self, timeout: float | None) -> bytes:
        self.connection.settimeout(timeout)
        line = b""
        while not line.endswith(b"\n"):
            line += self._receive(1)  # Byte by byte: the rest is left to other readers.
        self.connection.settimeout(None)
        return line

    def request(self, line: bytes, *, timeout: float) -> bytes:
        """Send a line to the child, and return the line that it answers.

        An answer that came too late for an earlier request is passed over.

        Args:
            line: The request, ending with a newline.
            timeout: How long to wait for the answer, in s.

        Raises:
            TimeoutError: The child does not answer within ``timeout`` seconds.
            OSError: The child has ended.
        """
        deadline = time.monotonic() + timeout
        self.connection.settimeout(timeout)
        self.connection.sendall(line)
        self._unanswered += 1
        answer = b""
        while self._unanswered:
            while b"\n" not in self._received:
                left = deadline - time.monotonic()
                if left <= 0.0:
                    raise TimeoutError(f"no answer within {timeout:g} s")
                self.connection.settimeout(left)
                self._received += self._receive(65536)
            answer, _, self._received = self._received.partition(b"\n")
            self._unanswered -= 1
        self.connection.settimeout(None)
        return answer + b"\n"

    def _receive(self, size: int) -> bytes:
        part = self.connection.recv(size)
        if not part:
            raise ConnectionResetError("it closed the connection")
        return part

    def wait(self, timeout: float | None = None) -> int:
        """Wait until the child has ended, and return its exit code.

        Raises:
            TimeoutError: It is still running after ``timeout`` seconds.
        """
        try:
            return self._process.wait(timeout)
        except subprocess.TimeoutExpired:
            raise TimeoutError(f"{self.name} (process {self.pid}) has not ended within {timeout:g} s") from None

    def close(self, timeout: float = 10.0) -> int:
        """Close the connection, wait until the child has ended, and return its exit code.

        After ``timeout`` seconds the child is killed.
        """
        self.connection.close()
        try:
            return self.wait(timeout)
        except TimeoutError:
            _log.error("%s (process %d) has not ended in time, and is killed", self.name, self.pid)
            return self.kill()

    def kill(self) -> int:
        """Kill the child (SIGKILL) and return its exit code. Its sent data can still be read from the connection."""
        self._process.kill()
        return self._process.wait()


class ChildService:
    """A service in a child process, as a context manager that starts it and ends it.

    Attributes:
        name: What errors call the service, such as "the hub"; set by the subclass.
        error: The exception that its methods raise; set by the subclass.
    """

    name: str
    error: type[Exception]
    _child: ChildProcess | None = None

    def start(self) -> None:
        """Start the service, and wait until it is ready."""
        raise NotImplementedError

    def _start(self, function: Callable[..., object], *arguments: Any, **options: Any) -> None:
        """Start the child, see `ChildProcess`, and wait until it is ready."""
        child = ChildProcess(function, *arguments, name=self.name, **options)
        try:
            child.wait_until_ready()
        except ProcessStartError as error:
            raise self.error(str(error)) from error
        self._child = child

    def _running(self) -> ChildProcess:
        if self._child is None:
            raise self.error(f"{self.name} is not running: start it, or use it in a with statement")
        return self._child

    def _request(self, line: bytes, *, timeout: float = ANSWER_TIMEOUT) -> bytes:
        child = self._running()
        try:
            return child.request(line, timeout=timeout)
        except TimeoutError as error:
            raise self.error(
                f"{self.name} (process {child.pid}) does not answer within {timeout:.3g} s: it is stopped, or hangs"
            ) from error
        except OSError as error:
            raise self.error(f"{self.name} does not answer: its process has ended ({error})") from error

    @property
    def pid(self) -> int:
        """Return the process id of the service; it is an error if it is not running."""
        return self._running().pid

    def close(self) -> None:
        """End the service; it can be started again."""
        if self._child is not None:
            self._child.close(ANSWER_TIMEOUT)
        self._child = None

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


@contextlib.contextmanager
def ending_signals(handler: Callable[[int, FrameType | None], Any]) -> Iterator[None]:
    """Within the block, call ``handler`` at SIGTERM, SIGHUP and SIGINT, unless they are ignored. For the main thread.

    In a `ChildProcess` nothing happens: it ends with its parent.
    """
    numbers = [] if _is_child else [n for n in _GROUP_SIGNALS if signal.getsignal(n) is not signal.SIG_IGN]
    before = {number: signal.signal(number, handler) for number in numbers}
    try:
        yield
    finally:
        for number, earlier in before.items():
            signal.signal(number, earlier)


@contextlib.contextmanager
def logging_in_thread() -> Iterator[None]:
    """Write log messages in another thread, so that a blocked terminal does not delay this one."""
    root = logging.getLogger()
    messages: queue.Queue[logging.LogRecord] = queue.Queue(_MAX_LOG)
    handlers = root.handlers[:] or [logging.StreamHandler()]
    root.handlers[:] = [_DroppingHandler(messages)]
    listener = QueueListener(messages, *handlers)
    listener.start()
    try:
        yield
    finally:
        listener.stop()
        root.handlers[:] = handlers


class _DroppingHandler(QueueHandler):
    def enqueue(self, record: logging.LogRecord) -> None:
        with contextlib.suppress(queue.Full):
            self.queue.put_nowait(record)


def report_ready(connection: socket.socket) -> None:
    """Tell the parent that this child is ready; see `ChildProcess.wait_until_ready`.

    Args:
        connection: The child's end of the connection, on which nothing was sent before.
    """
    connection.sendall(b"\n")


def search_path() -> list[str]:
    """Return sys.path with absolute entries only, so that the first vtbdrake in it is the one of this process."""
    directories = (_FIRST_DIRECTORY, _current_directory())
    entries = [entry for entry in sys.path if isinstance(entry, str)]  # Imports ignore all others.
    path = list(dict.fromkeys(os.path.join(directory, entry) for entry in entries for directory in directories))
    package = Path(__file__).parents[1]
    spec = PathFinder.find_spec(package.name, path)
    if spec is None or spec.origin is None or not package.samefile(Path(spec.origin).parent):
        path.insert(0, str(package.parent))
    return path


def _run(files: Sequence[int], grace: float) -> None:
    """Run the child: see `ChildProcess`."""
    global _is_child
    _is_child = True
    warnings.simplefilter("ignore", UntestedDrakeWarning)  # The parent has it.
    from vtbdrake.common.exit_guard import exit_after_hang_up  # Here: `doctor` works without the compiled modules.

    connection, call, *sockets = files
    exit_after_hang_up(os.dup(connection), grace)
    with socket.socket(fileno=connection) as parent:
        try:
            with open(call, "rb") as file:
                function, arguments = pickle.load(file)
            gc.freeze()
            gc.enable()
            function(parent, *arguments, *(socket.socket(fileno=descriptor) for descriptor in sockets))
        except ProcessStartError as error:
            with contextlib.suppress(OSError):
                parent.sendall(" ".join(str(error).split()).encode() + b"\n")
            raise SystemExit(1) from error
    quick_exit()
