"""Fuzz tests: no broken message of a great many raises, all are counted, and only valid ones are accepted."""

from __future__ import annotations

import math
import os
import random
import struct
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from itertools import count
from pathlib import Path

import numpy as np
import pytest
from drake import lcmt_iiwa_status, lcmt_image, lcmt_point_cloud, lcmt_robot_state

from tests.control.arm import LIMIT, SENSE, bridge, interface, status
from tests.lcm.bus import handled
from vtbdrake.control.received_signal import ReceivedSignal
from vtbdrake.lcm.hub import Hub
from vtbdrake.lcm.iiwa_messages import iiwa_status
from vtbdrake.lcm.lcm_bridge import ChannelReader

ROOT = Path(__file__).resolve().parents[2]
ODD = (math.nan, math.inf, -math.inf, 1e308, -0.0, 5e-324, LIMIT, -LIMIT, math.nextafter(LIMIT, 9.0))


def valid(random: random.Random, utime: int) -> bytearray:
    message = status(utime, joints=random.choice((7, 7, 7, 7, 0, 6, 8)))
    joints = message.num_joints
    message.joint_position_measured = [random.uniform(-1.02 * LIMIT, 1.02 * LIMIT) for _ in range(joints)]
    message.joint_torque_external = [random.uniform(-100.0, 100.0) for _ in range(joints)]
    return bytearray(message.encode())


def broken(random: random.Random, utime: int) -> bytes:
    """Return a message that is valid or broken in some way."""
    data = valid(random, utime)
    way = random.randrange(10)
    if way == 0:
        return random.randbytes(random.randrange(600))
    if way == 1:
        return bytes(data[:8]) + random.randbytes(random.choice((len(data) - 8, random.randrange(600))))
    if way == 2:
        for _ in range(random.randrange(1, 9)):
            data[random.randrange(len(data))] ^= 1 << random.randrange(8)
    elif way == 3:
        del data[random.randrange(len(data)) :]
    elif way == 4:
        data += random.randbytes(random.randrange(1, 50))
    elif way == 5:
        return random.choice((lcmt_robot_state, lcmt_image, lcmt_point_cloud))().encode()
    elif way == 6 and len(data) > 20:
        struct.pack_into(">d", data, random.randrange(20, len(data) - 7, 8), random.choice(ODD))
    elif way == 7:
        struct.pack_into(">i", data, 16, random.choice((2**31 - 1, -1, -(2**31), random.randrange(-100, 100))))
    return bytes(data)


def stream(seed: int, number: int) -> Iterator[bytes]:
    chance = random.Random(seed)
    for utime in range(1, number + 1):
        yield broken(chance, utime + chance.choice((0, 0, 0, 0, 0, 0, -3, -1, 1)))


class Oracle:
    """Counts by signal which messages are valid, with lcm-gen's decoder and nothing of the bridge.

    All fields of an `lcmt_iiwa_status` are numbers: encoding it again gives the same bytes. The reorder window is zero:
    of messages that are late or ahead, one that continues an earlier one is accepted, and one more than 1.5 s behind
    that begins anew. A message that is ahead is so by at least 2**21 us, where a bit of the time has flipped.
    """

    def __init__(self) -> None:
        self.last = self.unfit = -math.inf
        self.accepted = Counter[str]()

    def add(self, data: bytes) -> None:
        try:
            message = lcmt_iiwa_status.decode(data)
        except (ValueError, struct.error, OverflowError, MemoryError):
            return
        sent = message.utime * 1e-6
        if message.encode() != data or sent == self.last or not 0 <= message.utime <= 2**53:
            return
        if (
            not self.last < sent < self.last + 1.8
            and self.last > -math.inf
            and not self.unfit < sent < self.unfit + 1.8
        ):
            self.unfit = self.unfit if self.unfit - 1.5 <= sent <= self.unfit else sent
            return
        if message.num_joints != 7:
            return
        good = [
            signal
            for signal, values, limit in (
                ("position", message.joint_position_measured, LIMIT),
                ("torque", message.joint_torque_external, sys.float_info.max),
            )
            if all(-limit <= value <= limit for value in values)
        ]
        self.accepted.update(good)
        if good:
            self.last, self.unfit = sent, -math.inf


def resident() -> int:
    """Return the resident memory of this process, in bytes."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


@dataclass
class Fuzzed:
    """The received and the expected messages, and the memory after a fifth of them and after all."""

    messages: int
    signals: dict[str, ReceivedSignal]
    oracle: Oracle
    memory: list[int]


@pytest.fixture(scope="module", params=[10_000, pytest.param(100_000, marks=pytest.mark.slow)])
def fuzzed(request: pytest.FixtureRequest) -> Fuzzed:
    messages = request.param
    signals = {"position": ReceivedSignal(), "torque": ReceivedSignal()}
    arrivals = count(start=1000.0, step=1e-6)  # as fast as the sender's time, however busy the computer is
    reader = ChannelReader(iiwa_status(SENSE), interface().sense, signals, 0.0, clock=lambda: next(arrivals))
    oracle, memory = Oracle(), []
    for number, data in enumerate(stream(1, messages)):
        reader.receive("IIWA_STATUS", data)
        oracle.add(data)
        value = signals["position"].value
        assert value is None or np.abs(value).max() <= LIMIT
        if number in (messages // 5, messages - 1):
            memory.append(resident())
    return Fuzzed(messages, signals, oracle, memory)


def test_every_message_is_counted_once(fuzzed: Fuzzed) -> None:
    for received in fuzzed.signals.values():
        assert received.count + sum(received.rejected.values()) == fuzzed.messages


def test_exactly_the_valid_messages_are_accepted(fuzzed: Fuzzed) -> None:
    counts = {name: received.count for name, received in fuzzed.signals.items()}
    assert counts == fuzzed.oracle.accepted
    assert min(counts.values()) > fuzzed.messages // 20


def test_every_kind_of_rejection_occurred(fuzzed: Fuzzed) -> None:
    expected = {"fingerprint", "truncated", "trailing", "size", "not finite", "limits", "out of order", "duplicate"}
    expected |= {"ahead of time", "impossible time"}
    assert set(fuzzed.signals["position"].rejected) == expected


def test_memory_stays_flat(fuzzed: Fuzzed) -> None:
    early, late = fuzzed.memory
    assert late - early < 5_000_000


@pytest.mark.slow
def test_broken_messages_of_another_process_are_only_counted() -> None:
    number = 5_000
    sender = f"""
import lcm, sys
from tests.lcm.test_fuzz import stream
bus = lcm.LCM(sys.argv[1])
for data in stream(2, {number}):
    bus.publish("IIWA_STATUS", data)
"""
    oracle = Oracle()
    for data in stream(2, number):
        oracle.add(data)
    with Hub(port=0) as hub, closing(bridge(hub.url, reorder_window=0.0)) as arm:
        arm.open()
        process = subprocess.Popen([sys.executable, "-c", sender, hub.url], cwd=ROOT)
        try:
            end = time.monotonic() + 60.0
            while handled(arm.sensed["position"]) < number and time.monotonic() < end:
                arm.poll(0.1)
            assert process.wait(60.0) == 0
        finally:
            process.kill()
            process.wait()
        assert handled(arm.sensed["position"]) == number
        for name, received in arm.sensed.items():
            assert received.count == oracle.accepted[name]
            assert received.count + sum(received.rejected.values()) == number
        assert arm.connected
