"""Injected faults: their effect on messages, given as bytes."""

from __future__ import annotations

import json
import math
from collections import Counter
from typing import Any

import numpy as np
import pytest
from drake import lcmt_iiwa_status

from tests.control.arm import status
from vtbdrake.lcm.maps import decode
from vtbdrake.lcm.messages import MalformedError
from vtbdrake.machine import (
    ClockJump,
    Corrupt,
    Delay,
    Drop,
    Duplicate,
    Freeze,
    InjectedFault,
    InjectedFaultError,
    NoBrake,
    OwnStop,
    Reorder,
    fault_from_dict,
)
from vtbdrake.machine.injected_faults import FAULTS, DelayLine, Packet, whole_cycles

A, B = "A", "B"


def message(number: int) -> bytes:
    return status(number).encode()


def line(*faults: InjectedFault, delay: int = 0, seed: int = 0) -> DelayLine:
    made = DelayLine(delay=delay, period=0.001, random=np.random.default_rng(seed))
    for fault in faults:
        made.begin(fault)
    return made


def deliver(way: DelayLine, cycles: int, *channels: str) -> list[list[tuple[str, int]]]:
    """Send the number of the cycle on each channel; return channel and number of what arrives in each cycle."""
    arrived = []
    for cycle in range(cycles):
        for channel in channels or (A,):
            way.send(Packet(channel, lcmt_iiwa_status, message(cycle), cycle))
        arrived.append([(p.channel, lcmt_iiwa_status.decode(p.data).utime) for p in way.arrivals(cycle)])
    return arrived


def corrupted(kind: str, count: int) -> list[bytes]:
    way = line(Corrupt(kind=kind))
    for _ in range(count):
        way.send(Packet(A, lcmt_iiwa_status, message(1), 0))
    return [packet.data for packet in way.arrivals(0)]


def reason(data: bytes) -> str:
    try:
        decode(lcmt_iiwa_status, data)
    except MalformedError as error:
        return error.reason
    return ""


def test_line_without_faults_delivers_at_once() -> None:
    assert deliver(line(), 3, A, B) == [[(A, k), (B, k)] for k in range(3)]


def test_line_with_a_delay() -> None:
    assert deliver(line(delay=2), 4) == [[], [], [(A, 0)], [(A, 1)]]


def test_drop_of_all() -> None:
    assert deliver(line(Drop()), 3) == [[], [], []]


def test_drop_of_a_fraction() -> None:
    arrived = sum(map(len, deliver(line(Drop(fraction=0.3)), 2000)))
    assert abs(arrived - 1400) < 5 * math.sqrt(2000 * 0.3 * 0.7)


def test_delay_is_whole_cycles_rounded_up() -> None:
    assert deliver(line(Delay(seconds=0.0011)), 4) == [[], [], [(A, 0)], [(A, 1)]]
    assert [whole_cycles(k * 0.1, 0.1) for k in range(1000)] == list(range(1000))


def test_freeze_repeats_the_first_message_of_each_channel() -> None:
    way = line()
    deliver(way, 3, A, B)
    way.begin(Freeze(channels=[A]))
    frozen = deliver(way, 3, A, B)
    assert frozen == [[(A, 0), (B, k)] for k in range(3)]


def test_duplicate() -> None:
    assert deliver(line(Duplicate(copies=2)), 2) == [[(A, k)] * 3 for k in range(2)]


def test_reorder_swaps_two_messages_of_a_channel() -> None:
    arrived = deliver(line(Reorder()), 4, A, B)
    assert arrived == [[], [(A, 1), (A, 0), (B, 1), (B, 0)], [], [(A, 3), (A, 2), (B, 3), (B, 2)]]


def test_faults_act_together() -> None:
    arrived = deliver(line(Delay(seconds=0.001), Duplicate(), Freeze()), 3)
    assert arrived == [[], [(A, 0), (A, 0)], [(A, 0), (A, 0)]]


def test_duplicates_of_a_corrupted_message_are_equal() -> None:
    way = line(Duplicate(), Corrupt(kind="random"))
    way.send(Packet(A, lcmt_iiwa_status, message(1), 0))
    one, other = way.arrivals(0)
    assert one == other


def test_fault_replaces_one_of_the_same_name() -> None:
    way = line(Delay(seconds=0.005), Delay(seconds=0.001))
    assert deliver(way, 3) == [[], [(A, 0)], [(A, 1)]]


def test_packets_on_their_way_arrive_after_faults_end() -> None:
    way = line(Delay(seconds=0.002))
    way.send(Packet(A, lcmt_iiwa_status, message(7), 0))
    way.end_faults()
    assert deliver(way, 3) == [[(A, 0)], [(A, 1)], [(A, 7), (A, 2)]]


def test_clock_error_affects_named_channels() -> None:
    way = line(ClockJump(seconds=-2.0, channels=[A]))
    assert (way.clock_error(A), way.clock_error(B)) == (-2.0, 0.0)
    way.end_faults()
    assert way.clock_error(A) == 0.0


def test_flipped_bits_are_one_to_eight() -> None:
    whole = np.frombuffer(message(1), np.uint8)
    flips = Counter(int(np.unpackbits(np.frombuffer(data, np.uint8) ^ whole).sum()) for data in corrupted("bits", 800))
    assert set(flips) == set(range(1, 9))
    assert min(flips.values()) > 50


def test_truncated_messages_are_beginnings() -> None:
    found = corrupted("truncate", 200)
    assert all(message(1).startswith(data) and len(data) < len(message(1)) for data in found)
    assert {reason(data) for data in found} == {"truncated"}


def test_trailing_bytes_follow() -> None:
    found = corrupted("trailing", 50)
    assert all(data.startswith(message(1)) and 1 <= len(data) - len(message(1)) <= 64 for data in found)
    assert {reason(data) for data in found} == {"trailing"}


def test_wrong_type_differs_in_the_fingerprint_only() -> None:
    [data] = corrupted("type", 1)
    assert data[8:] == message(1)[8:]
    assert reason(data) == "fingerprint"


def test_random_bytes() -> None:
    one, other = corrupted("random", 2)
    assert len(one) == len(other) == len(message(1))
    assert len({one, other, message(1)}) == 3


def test_nan_is_in_every_floating_point_number() -> None:
    [data] = corrupted("nan", 1)
    found = decode(lcmt_iiwa_status, data)
    assert (found.utime, found.num_joints) == (1, 7)
    assert np.isnan([getattr(found, name) for name in found.__slots__[2:]]).all()


def test_nan_reaches_messages_in_messages(user_types: Any) -> None:
    wind = user_types.wind_t()
    way = line(Corrupt(kind="nan"))
    way.send(Packet(A, user_types.wind_t, wind.encode(), 0))
    [packet] = way.arrivals(0)
    found = user_types.wind_t.decode(packet.data)
    assert np.isnan([found.speed, *found.gust, found.where.x, found.where.z]).all()
    assert found.level == 0


def test_corruption_of_a_fraction() -> None:
    way = line(Corrupt(kind="type", fraction=0.25))
    for _ in range(1000):
        way.send(Packet(A, lcmt_iiwa_status, message(1), 0))
    count = sum(packet.data != message(1) for packet in way.arrivals(0))
    assert abs(count - 250) < 5 * math.sqrt(1000 * 0.25 * 0.75)


EXAMPLES = [
    Drop(fraction=0.5, channels=[A]),
    Delay(seconds=0.05, side="act"),
    Freeze(),
    Corrupt(kind="nan"),
    Duplicate(copies=3),
    Reorder(),
    ClockJump(seconds=-5.0),
    NoBrake(),
    OwnStop(),
]


@pytest.mark.parametrize("fault", EXAMPLES, ids=lambda fault: fault.name)
def test_faults_survive_json(fault: InjectedFault) -> None:
    assert fault_from_dict(json.loads(json.dumps(fault.to_dict()))) == fault


def test_every_fault_is_an_example() -> None:
    assert {fault.name for fault in EXAMPLES} == set(FAULTS)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ({"fault": "melt"}, "a fault must be one of clock_jump, .*, not 'melt'"),
        ({"fault": ["drop"]}, "a fault must be one of"),
        ({"fault": "drop", "share": 0.5}, "drop has no share; it has: .*fraction"),
        ({"fault": "drop", "fraction": 1.5}, "drop.fraction must be a number from 0 to 1, not 1.5"),
        ({"fault": "drop", "fraction": "all"}, "not 'all'"),
        ({"fault": "drop", "fraction": math.nan}, "not nan"),
        ({"fault": "drop", "side": "left"}, "drop.side must be one of sense, act, not 'left'"),
        ({"fault": "drop", "channels": "A"}, r"drop.channels must be a list, such as \['A'\], not 'A'"),
        ({"fault": "delay"}, "the fault delay is not complete: .*seconds"),
        ({"fault": "delay", "seconds": -1.0}, "delay.seconds must be a number from 0 to 1e.06 s, not -1.0"),
        ({"fault": "duplicate", "copies": 1.5}, "whole number"),
        ({"fault": "corrupt", "kind": "burn"}, "one of bits, truncate, .*, not 'burn'"),
        (
            {"fault": "clock_jump", "seconds": 1.0, "side": "act"},
            "clock_jump.side must be sense, not 'act'",
        ),
    ],
)
def test_impossible_fault_is_refused(data: dict[str, Any], message: str) -> None:
    with pytest.raises(InjectedFaultError, match=message):
        fault_from_dict(data)
