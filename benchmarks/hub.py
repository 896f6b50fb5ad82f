"""Time of a message through the hub."""

from __future__ import annotations

import contextlib
import select
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import lcm
import numpy as np

from benchmarks.measure import LOWER, Benchmark
from vtbdrake.control.realtime import RealTime
from vtbdrake.lcm.connections import TcpqConnection
from vtbdrake.lcm.hub import Hub

ROOT = Path(__file__).resolve().parents[1]

TIMEOUT_MS = 10_000
SIZE = 200  # bytes, about as in a robot's state

# Another process that sends back what it gets.
ECHO = """
import lcm, sys
bus = lcm.LCM(sys.argv[1])
bus.subscribe("PING", lambda _, data: bus.publish("PONG", data))
bus.publish("PONG", b"")
while True:
    bus.handle()
"""

# A server of one connection that sends back what it gets, without a protocol.
_TCP_ECHO = """
import socket
server = socket.create_server(("127.0.0.1", 0))
print(server.getsockname()[1], flush=True)
client, _ = server.accept()
client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
while data := client.recv(65536):
    client.sendall(data)
"""


def hub_round_trip_p50(messages: int = 4000, naive_messages: int = 40, rounds: int = 8) -> list[Benchmark]:
    """Time from a client's publication to its arrival at the same client, through the hub, over a TCP echo's.

    Medians, in turns. The client is an unmodified `lcm.LCM`; the echo is of bare bytes. Printed only: the time through
    a naive hub, to another client and back (twice through the hub), and with this package's own client.
    """
    times: dict[str, list[float]] = {"hub": [], "tcp": [], "naive": [], "echo": [], "own": []}
    with Hub(port=0) as hub, _naive_hub() as naive_url, contextlib.ExitStack() as stack:
        rights = stack.enter_context(RealTime(priority=None, lock_memory=False))
        ours, naive, pinger = lcm.LCM(hub.url), lcm.LCM(naive_url), lcm.LCM(hub.url)
        for bus, channel in ((ours, "SELF"), (naive, "SELF"), (pinger, "PONG")):
            bus.subscribe(channel, lambda *_: None)
        stack.enter_context(_echo(hub.url))
        _await(pinger)
        own_turn, tcp_turn = stack.enter_context(_own_client(hub.url)), stack.enter_context(_tcp_echo())
        for _ in range(rounds):
            times["hub"] += _round_trips(_turn(ours, "SELF"), messages // rounds)
            times["tcp"] += _round_trips(tcp_turn, messages // rounds)
            times["naive"] += _round_trips(_turn(naive, "SELF"), naive_messages // rounds)
            times["echo"] += _round_trips(_turn(pinger, "PING"), messages // rounds)
            times["own"] += _round_trips(own_turn, messages // rounds)
    p50 = {name: float(np.median(values)) for name, values in times.items()}
    return [
        Benchmark(
            name="hub_round_trip_p50",
            value=p50["hub"] / p50["tcp"],
            unit="1",
            goal=2.0,
            better=LOWER,
            against=f"a bare TCP echo in another process: {1e6 * p50['tcp']:.3g} us",
            note="; ".join(
                [
                    "naive is without TCP_NODELAY and TCP_QUICKACK",
                    *(f"{name}: {_percentiles(values)}" for name, values in times.items()),
                    *(str(grant) for grant in rights.grants if not grant.granted),
                ]
            ),
        ),
        Benchmark(
            name="hub_echo_round_trip_p50",
            value=p50["echo"],
            unit="s",
            goal=None,
            better=LOWER,
            against="twice through the hub, by way of another process",
        ),
        Benchmark(
            name="hub_own_client_round_trip_p50",
            value=p50["own"],
            unit="s",
            goal=None,
            better=LOWER,
            against=f"an unmodified lcm.LCM through the same hub: {1e6 * p50['hub']:.3g} us",
        ),
    ]


def _round_trips(turn: Callable[[], None], messages: int) -> list[float]:
    """Return the durations of consecutive round trips in seconds."""
    times = []
    for _ in range(messages):
        begin = time.perf_counter()
        turn()
        times.append(time.perf_counter() - begin)
    return times


def _turn(bus: lcm.LCM, channel: str) -> Callable[[], None]:
    data = bytes(SIZE)

    def turn() -> None:
        bus.publish(channel, data)
        bus.handle()

    return turn


@contextlib.contextmanager
def _own_client(url: str) -> Iterator[Callable[[], None]]:
    with contextlib.closing(TcpqConnection(url, {url: lambda *_: None}, 1e-3 * TIMEOUT_MS)) as connection:
        messages = [(url, bytes(SIZE))]  # a channel without another subscriber

        def turn() -> None:
            connection.publish(messages)
            select.select([connection], [], [])
            connection.receive(1)

        yield turn


def _await(bus: lcm.LCM) -> None:
    if not bus.handle_timeout(TIMEOUT_MS):
        raise TimeoutError(f"no message came back within {TIMEOUT_MS} ms")


def _percentiles(times: list[float]) -> str:
    p50, p90, p99 = 1e6 * np.percentile(times, [50, 90, 99])
    return f"p50 {p50:.0f}, p90 {p90:.0f}, p99 {p99:.0f} us (n = {len(times)})"


@contextlib.contextmanager
def _naive_hub() -> Iterator[str]:
    command = [sys.executable, "-m", "benchmarks.naive_hub"]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            yield process.stdout.readline().strip()
        finally:
            process.kill()


@contextlib.contextmanager
def _tcp_echo() -> Iterator[Callable[[], None]]:
    data = bytes(SIZE)
    with subprocess.Popen([sys.executable, "-c", _TCP_ECHO], stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            address = "127.0.0.1", int(process.stdout.readline())
            with socket.create_connection(address, timeout=1e-3 * TIMEOUT_MS) as connection:
                connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

                def turn() -> None:
                    connection.sendall(data)
                    received = 0
                    while received < SIZE:
                        received += len(connection.recv(SIZE))

                yield turn
        finally:
            process.kill()


@contextlib.contextmanager
def _echo(url: str) -> Iterator[None]:
    with subprocess.Popen([sys.executable, "-c", ECHO, url]) as process:
        try:
            yield
        finally:
            process.kill()
