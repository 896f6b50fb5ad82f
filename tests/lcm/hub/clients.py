"""Clients of a hub for tests: unmodified LCM, raw sockets, and LCM in processes that can be stopped and killed."""

import contextlib
import json
import os
import signal
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import lcm

from vtbdrake.lcm.hub import Hub, HubStatistics

TIMEOUT = 60.0
MEBIBYTE = 1024 * 1024

GREETING = struct.pack(">II", 0x287617FB, 0x0100)
WELCOME = struct.pack(">II", 0x287617FA, 0x0100)

_PROGRAM = """
import json, lcm, sys
bus = lcm.LCM(sys.argv[1])
print("ready", flush=True)
for line in sys.stdin:
    for channel, text in json.loads(line):
        bus.publish(channel, text.encode())
    print("done", flush=True)
"""


class Client:
    """An unmodified LCM client that keeps the messages it receives."""

    def __init__(self, url: str, *patterns: str) -> None:
        self.bus = lcm.LCM(url)
        self.received: list[tuple[str, bytes]] = []
        self.subscriptions = {pattern: self.bus.subscribe(pattern, self.receive) for pattern in patterns}
        self._turns = 0
        self.sync()

    def receive(self, channel: str, data: bytes) -> None:
        self.received.append((channel, data))

    def publish(self, channel: str, data: bytes = b"") -> None:
        self.bus.publish(channel, data)

    def data(self, channel: str) -> list[bytes]:
        return [data for name, data in self.received if name == channel]

    def sync(self) -> None:
        """Wait until hub and client have handled all messages that they had sent to each other."""
        self._turns += 1
        seen: list[str] = []
        subscription = self.bus.subscribe(f"SYNC_{id(self)}_{self._turns}", lambda channel, _: seen.append(channel))
        self.bus.publish(f"SYNC_{id(self)}_{self._turns}", b"")
        self.wait(lambda: bool(seen))
        self.bus.unsubscribe(subscription)

    def wait(self, condition: Callable[[], bool]) -> None:
        """Receive messages until the condition holds."""
        deadline = time.monotonic() + TIMEOUT
        while not condition():
            assert time.monotonic() < deadline, "timeout"
            self.bus.handle_timeout(100)

    def wait_for_status(self, condition: Callable[[HubStatistics], bool]) -> HubStatistics:
        """Return the first published status for which the condition holds."""
        found: list[HubStatistics] = []

        def look(_: str, data: bytes) -> None:
            status = HubStatistics.from_json(data)
            if condition(status):
                found.append(status)

        subscription = self.bus.subscribe("VTB_HUB", look)
        self.wait(lambda: bool(found))
        self.bus.unsubscribe(subscription)
        return found[0]


class ClientProcess:
    """An unmodified LCM client in a process of its own."""

    def __init__(self, url: str) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-c", _PROGRAM, url],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )
        self._await("ready")

    def begin(self, *messages: tuple[str, str]) -> None:
        """Begin to publish without waiting."""
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps(messages) + "\n")
        self.process.stdin.flush()

    def publish(self, *messages: tuple[str, str]) -> None:
        """Publish, and wait until it is done."""
        self.begin(*messages)
        self.end()

    def end(self) -> None:
        self._await("done")

    def _await(self, word: str) -> None:
        assert self.process.stdout is not None
        assert self.process.stdout.readline().strip() == word

    def stop(self) -> None:
        self.process.send_signal(signal.SIGSTOP)

    def resume(self) -> None:
        self.process.send_signal(signal.SIGCONT)

    def __enter__(self) -> "ClientProcess":
        return self

    def __exit__(self, *_: object) -> None:
        self.process.kill()
        self.process.communicate()


def address(url: str) -> tuple[str, int]:
    host, port = url.removeprefix("tcpq://").split(":")
    return host, int(port)


@contextlib.contextmanager
def raw_client(url: str, greeting: bytes = GREETING) -> Iterator[socket.socket]:
    """Connect a socket on which the test speaks tcpq itself."""
    with socket.create_connection(address(url)) as sock:
        sock.settimeout(TIMEOUT)
        if greeting:  # Sending nothing fails, too, once the hub has closed the connection.
            sock.sendall(greeting)
        yield sock


@contextlib.contextmanager
def stopped(hub: Hub) -> Iterator[None]:
    """Stop the process of the hub meanwhile."""
    os.kill(hub.pid, signal.SIGSTOP)
    try:
        yield
    finally:
        os.kill(hub.pid, signal.SIGCONT)


def resident(pid: int) -> int:
    """Return the resident memory of a process in bytes."""
    line = next(line for line in Path(f"/proc/{pid}/status").read_text().splitlines() if line.startswith("VmRSS"))
    return 1024 * int(line.split()[1])


def record(kind: int, channel: bytes, data: bytes | None = None) -> bytes:
    """Return a record as LCM's ``lcm_tcpq.c`` writes it."""
    text = struct.pack(">II", kind, len(channel)) + channel
    return text if data is None else text + struct.pack(">I", len(data)) + data


def receive(sock: socket.socket, size: int) -> bytes:
    """Receive exactly ``size`` bytes."""
    data = bytearray()
    while len(data) < size:
        part = sock.recv(size - len(data))
        assert part, "disconnected"
        data += part
    return bytes(data)


def is_disconnected(sock: socket.socket) -> bool:
    """Return whether the hub closes the connection before it sends more than any test expects."""
    try:
        for _ in range(1000):
            if not sock.recv(65536):
                return True
    except ConnectionError:
        return True
    return False


def wait_until(condition: Callable[[], bool]) -> None:
    """Ask until the condition holds; every question waits for an answer of the hub or for a message."""
    deadline = time.monotonic() + TIMEOUT
    while not condition():
        assert time.monotonic() < deadline, "timeout"
