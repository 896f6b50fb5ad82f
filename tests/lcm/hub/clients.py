"""Clients of a hub: unmodified LCM, raw sockets, and LCM in processes that can be stopped and killed."""

import contextlib
import json
import signal
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Callable

import lcm

from vtbdrake.lcm.hub import HubStatistics

TIMEOUT = 30.0

GREETING = struct.pack(">II", 0x287617FB, 0x0100)

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
    """An unmodified LCM client, and what it has received."""

    def __init__(self, url: str, *patterns: str) -> None:
        self.bus = lcm.LCM(url)
        self.received: list[tuple[str, bytes]] = []
        self.subscriptions = {pattern: self.bus.subscribe(pattern, self._receive) for pattern in patterns}
        self._turns = 0
        self.sync()

    def _receive(self, channel: str, data: bytes) -> None:
        self.received.append((channel, data))

    def publish(self, channel: str, data: bytes = b"") -> None:
        self.bus.publish(channel, data)

    def data(self, channel: str) -> list[bytes]:
        return [data for name, data in self.received if name == channel]

    def sync(self) -> None:
        """Returns when the hub has handled all that this client has sent, and this client all that the hub had sent."""
        self._turns += 1
        seen: list[str] = []
        subscription = self.bus.subscribe(f"SYNC_{id(self)}_{self._turns}", lambda channel, _: seen.append(channel))
        self.bus.publish(f"SYNC_{id(self)}_{self._turns}", b"")
        self.wait(lambda: bool(seen))
        self.bus.unsubscribe(subscription)

    def wait(self, condition: Callable[[], bool]) -> None:
        """Takes in messages until the condition holds."""
        deadline = time.monotonic() + TIMEOUT
        while not condition():
            assert time.monotonic() < deadline, "waited in vain"
            self.bus.handle_timeout(100)

    def wait_for_status(self, condition: Callable[[HubStatistics], bool]) -> HubStatistics:
        """What the hub publishes, as soon as the condition holds."""
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
        """Tells it to publish, and does not wait."""
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps(messages) + "\n")
        self.process.stdin.flush()

    def publish(self, *messages: tuple[str, str]) -> None:
        """Returns when it has published."""
        self.begin(*messages)
        self.end()

    def end(self) -> None:
        self._await("done")

    def _await(self, word: str) -> None:
        assert self.process.stdout is not None
        assert self.process.stdout.readline().strip() == word

    def freeze(self) -> None:
        self.process.send_signal(signal.SIGSTOP)

    def thaw(self) -> None:
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
def raw_client(url: str, greeting: bytes = GREETING):
    """A socket on which the test speaks itself."""
    with socket.create_connection(address(url), timeout=TIMEOUT) as sock:
        sock.sendall(greeting)
        yield sock


def record(kind: int, channel: bytes, data: bytes | None = None) -> bytes:
    """As LCM's ``lcm_tcpq.c`` writes it."""
    text = struct.pack(">II", kind, len(channel)) + channel
    return text if data is None else text + struct.pack(">I", len(data)) + data


def receive(sock: socket.socket, size: int) -> bytes:
    """So many bytes, and no fewer."""
    data = bytearray()
    while len(data) < size:
        part = sock.recv(size - len(data))
        assert part, "disconnected"
        data += part
    return bytes(data)


def is_disconnected(sock: socket.socket) -> bool:
    """Waits for the hub to hang up, or for more than the hub would ever send."""
    try:
        for _ in range(1000):
            if not sock.recv(65536):
                return True
    except ConnectionError:
        return True
    return False


def wait_until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + TIMEOUT
    while not condition():
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.01)
