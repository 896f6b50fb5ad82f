"""Fuzz tests: no broken message of a hundred thousand raises, all are counted, and only valid ones are accepted."""

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
from pathlib import Path

import numpy as np
import pytest
from drake import lcmt_iiwa_status, lcmt_image, lcmt_point_cloud, lcmt_robot_state

from tests.control.arm import LIMIT, SENSE, bridge, interface, status
from tests.lcm.bus import handled
from vtbdrake.control.received_signal import ReceivedSignal
from vtbdrake.lcm.arm_messages import iiwa_status
from vtbdrake.lcm.bridge import ChannelReader
from vtbdrake.lcm.hub import Hub

ROOT = Path(__file__).resolve().parents[2]
MESSAGES = 100_000
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


def stream(seed: int, count: int) -> Iterator[bytes]:
    chance = random.Random(seed)
    for utime in range(1, count + 1):
        yield broken(chance, utime + chance.choice((0, 0, 0, 0, 0, 0, -3, -1, 1)))


class Oracle:
    """Counts by signal which messages are valid, with lcm-gen's decoder and nothing of the bridge.

    All fields of an `lcmt_iiwa_status` are numbers: encoding it again gives the same bytes. The reorder window is zero:
    the second message in a row that is late or ahead is accepted. A message that is ahead is so by at least 2**21 us,
    where a bit of the time has flipped; hardly any time passes here.
    """

    def __init__(self) -> None:
        self.last = -math.inf
        self.unfit = False
        self.accepted = Counter[str]()

    def add(self, data: bytes) -> None:
        try:
            message = lcmt_iiwa_status.decode(data)
        except (ValueError, struct.error, OverflowError, MemoryError):
            return
        sent = message.utime * 1e-6
        if message.encode() != data or sent == self.last:
            return
        if not self.last < sent < self.last + 1.8 and self.last > -math.inf and not self.unfit:
            self.unfit = True
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
            self.last, self.unfit = sent, False


def resident() -> int:
    """Return the resident memory of this process, in bytes."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


@pytest.fixture(scope="module")
def fuzzed() -> tuple[dict[str, ReceivedSignal], Oracle, list[int]]:
    signals = {"position": ReceivedSignal(), "torque": ReceivedSignal()}
    reader = ChannelReader(iiwa_status(SENSE), interface().sense, signals, 0.0)
    oracle, memory = Oracle(), []
    for number, data in enumerate(stream(1, MESSAGES)):
        reader.receive("IIWA_STATUS", data)
        oracle.add(data)
        value = signals["position"].value
        assert value is None or np.abs(value).max() <= LIMIT
        if number in (MESSAGES // 5, MESSAGES - 1):
            memory.append(resident())
    return signals, oracle, memory


def test_every_message_is_counted_once(fuzzed: tuple[dict[str, ReceivedSignal], Oracle, list[int]]) -> None:
    for received in fuzzed[0].values():
        assert received.count + sum(received.rejected.values()) == MESSAGES


def test_exactly_the_valid_messages_are_accepted(fuzzed: tuple[dict[str, ReceivedSignal], Oracle, list[int]]) -> None:
    signals, oracle, _ = fuzzed
    counts = {name: received.count for name, received in signals.items()}
    assert counts == oracle.accepted
    assert min(counts.values()) > MESSAGES // 20


def test_every_kind_of_rejection_occurred(fuzzed: tuple[dict[str, ReceivedSignal], Oracle, list[int]]) -> None:
    expected = {"fingerprint", "truncated", "trailing", "size", "not finite", "limits", "out of order", "duplicate"}
    expected |= {"ahead of time"}
    assert set(fuzzed[0]["position"].rejected) == expected


def test_memory_stays_flat(fuzzed: tuple[dict[str, ReceivedSignal], Oracle, list[int]]) -> None:
    early, late = fuzzed[2]
    assert late - early < 5_000_000


def test_broken_messages_of_another_process_are_only_counted() -> None:
    count = 5_000
    sender = f"""
import lcm, sys
from tests.lcm.test_fuzz import stream
bus = lcm.LCM(sys.argv[1])
for data in stream(2, {count}):
    bus.publish("IIWA_STATUS", data)
"""
    oracle = Oracle()
    for data in stream(2, count):
        oracle.add(data)
    with Hub(port=0) as hub, closing(bridge(hub.url, reorder_window=0.0)) as arm:
        arm.open()
        process = subprocess.Popen([sys.executable, "-c", sender, hub.url], cwd=ROOT)
        try:
            end = time.monotonic() + 60.0
            while handled(arm.sensed["position"]) < count and time.monotonic() < end:
                arm.poll(0.1)
            assert process.wait(60.0) == 0
        finally:
            process.kill()
            process.wait()
        assert handled(arm.sensed["position"]) == count
        for name, received in arm.sensed.items():
            assert received.count == oracle.accepted[name]
            assert received.count + sum(received.rejected.values()) == count
        assert arm.connected
