"""A hub in a process of its own."""

from __future__ import annotations

import contextlib
import gc
import json
import logging
import os
import queue
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from logging.handlers import QueueHandler, QueueListener
from typing import Any

from vtbdrake.interpreter import command
from vtbdrake.lcm.hub.config import HubConfig
from vtbdrake.lcm.hub.server import HubServer, listen
from vtbdrake.lcm.hub.statistics import HubStatistics
from vtbdrake.lcm.hub.tcpq import address_name

_log = logging.getLogger(__name__)

_START_TIMEOUT = 60.0
_ANSWER_TIMEOUT = 5.0
_MAX_LOG = 1000


class HubError(RuntimeError):
    """A hub that does not start, or does not run any more."""


class Hub:
    """A hub in a process of its own, which ends with `close`, and with the process that started it, however that ends.

        with Hub(port=0, protect=["IIWA_COMMAND"]) as hub:
            bus = lcm.LCM(hub.url)

    Args:
        config: address, protected channels and limits.
        fields: of the config, in its place or to change it.

    Raises:
        ValueError: a field is out of its range.
    """

    def __init__(self, config: HubConfig | None = None, **fields: Any) -> None:
        self.config = replace(config or HubConfig(), **fields)
        self._process: subprocess.Popen[bytes] | None = None
        self._control: socket.socket | None = None
        self._url: str | None = None

    def start(self) -> None:
        """Returns when clients can connect.

        Raises:
            HubAddressError: it cannot listen at its address.
            HubError: its process does not start.
        """
        control, theirs = socket.socketpair()
        try:
            with theirs, contextlib.ExitStack() as stack:
                listeners = [stack.enter_context(listener) for listener in listen(self.config)]
                filenos = [theirs.fileno(), *(listener.fileno() for listener in listeners)]
                self._url = f"tcpq://{address_name(listeners[0].getsockname())}"
                self._process = subprocess.Popen(
                    command("vtbdrake.lcm.hub.process", json.dumps(asdict(self.config)), *map(str, filenos)),
                    pass_fds=filenos,
                    stdin=subprocess.DEVNULL,
                )
            self._control = control
            self._ask(_START_TIMEOUT)
        except BaseException:
            control.close()
            self.close()
            raise

    @property
    def url(self) -> str:
        """What clients are created with: ``tcpq://host:port``.

        Raises:
            HubError: the hub does not run.
        """
        if self._url is None:
            raise HubError("the hub does not run: start it, or use it in a with statement")
        return self._url

    @property
    def pid(self) -> int:
        """Of its process.

        Raises:
            HubError: the hub does not run.
        """
        if self._process is None:
            raise HubError("the hub does not run: start it, or use it in a with statement")
        return self._process.pid

    def statistics(self) -> HubStatistics:
        """Of this moment.

        Raises:
            HubError: the hub does not answer.
        """
        return self._ask(_ANSWER_TIMEOUT)

    def _ask(self, timeout: float) -> HubStatistics:
        if self._control is None:
            raise HubError("the hub does not run: start it, or use it in a with statement")
        self._control.settimeout(timeout)
        answer = b""
        try:
            self._control.sendall(b"?")
            while not answer.endswith(b"\n"):
                part = self._control.recv(65536)
                if not part:
                    raise ConnectionResetError("it has ended")
                answer += part
        except OSError as error:
            raise HubError(f"the hub at {self._url} does not answer: {error}") from error
        return HubStatistics.from_json(answer)

    def close(self) -> None:
        """Ends it; it may be started again."""
        if self._control is not None:
            self._control.close()
        if self._process is not None:
            try:
                self._process.wait(_ANSWER_TIMEOUT)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
        self._process = self._control = self._url = None

    def __enter__(self) -> Hub:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def serve(server: HubServer) -> None:
    """Runs a hub in the main thread of a process that does nothing else, until SIGTERM (or SIGINT, if not ignored)."""
    signal.signal(signal.SIGTERM, lambda *_: server.stop())
    if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
        signal.signal(signal.SIGINT, lambda *_: server.stop())
    if server.config.cpus:
        _ask_for_processors(server.config.cpus)
    if server.config.priority:
        _ask_for_priority(server.config.priority)
    # The hub makes no cycles.
    gc.collect()
    gc.freeze()
    gc.disable()
    with _logging_elsewhere():
        server.serve_forever()


def _ask_for_processors(cpus: Sequence[int]) -> None:
    try:
        os.sched_setaffinity(0, cpus)
    except OSError:
        _log.warning("the system does not grant the processors %s; the hub runs on any", ", ".join(map(str, cpus)))


def _ask_for_priority(priority: int) -> None:
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except PermissionError:
        _log.warning("the system does not grant SCHED_FIFO (see 'ulimit -r'); the hub runs at an ordinary priority")
    else:
        _log.info("runs at SCHED_FIFO %d", priority)


@contextlib.contextmanager
def _logging_elsewhere() -> Iterator[None]:
    """Within, what is logged is written by another thread: a terminal that takes nothing holds up no message."""
    root = logging.getLogger()
    waiting: queue.Queue[logging.LogRecord] = queue.Queue(_MAX_LOG)
    handlers = root.handlers[:] or [logging.StreamHandler()]
    root.handlers[:] = [_DroppingHandler(waiting)]
    listener = QueueListener(waiting, *handlers)
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


def main() -> None:
    """The process of a `Hub`."""
    control, *listeners = (socket.socket(fileno=int(fileno)) for fileno in sys.argv[2:])
    logging.basicConfig(format="hub: %(message)s")
    server = HubServer(HubConfig(**json.loads(sys.argv[1])), listeners=listeners, control=control)
    serve(server)
