"""LCM messages are decoded strictly."""

from __future__ import annotations

import struct
from types import ModuleType
from typing import Any

import pytest
from drake import lcmt_iiwa_status, lcmt_image, lcmt_robot_state

from tests.control.arm import status
from vtbdrake.lcm.wire import Layout, MalformedError, decode


def reason(message_type: Any, data: bytes) -> str:
    with pytest.raises(MalformedError) as caught:
        decode(message_type, data)
    return caught.value.reason


def mixed(types: ModuleType) -> Any:
    message = types.mixed_t()
    message.utime, message.name, message.n, message.m = 5, "camera", 2, 3
    message.grid = [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]
    message.blob = b"abc"
    message.points = [types.point_t(), types.point_t()]
    return message


def test_message_is_decoded_as_lcm_gen_does(user_types: ModuleType) -> None:
    data = mixed(user_types).encode()
    assert decode(user_types.mixed_t, data).encode() == data


def test_every_truncation_is_told(user_types: ModuleType) -> None:
    data = mixed(user_types).encode()
    assert {reason(user_types.mixed_t, data[:length]) for length in range(len(data))} == {"truncated"}


def test_bytes_that_follow_are_told() -> None:
    assert reason(lcmt_iiwa_status, status(1).encode() + b"\0") == "trailing"


def test_another_type_is_told() -> None:
    assert reason(lcmt_iiwa_status, lcmt_robot_state().encode()) == "fingerprint"


def test_negative_length_is_told() -> None:
    message = lcmt_image()
    data = bytearray(message.encode())
    at = data.index(struct.pack(">iiii", 0, 0, 0, 0)) + 12
    data[at : at + 4] = struct.pack(">i", -1)
    assert reason(lcmt_image, bytes(data)) == "size"


def test_thousands_of_millions_of_empty_rows_are_not_read(user_types: ModuleType) -> None:
    message = user_types.mixed_t()
    data = bytearray(message.encode())
    at = 8 + 8 + 4 + 1  # fingerprint, utime, name
    data[at : at + 4] = struct.pack(">i", 2**31 - 1)
    assert reason(user_types.mixed_t, bytes(data)) == "size"


def test_layout_tells_where_lcm_gen_writes_a_field() -> None:
    message = status(5, position=0.5, torque=-2.0)
    place = Layout(message).at["joint_torque_measured"]
    data = struct.unpack_from(f">{place.size}{place.code}", message.encode(), place.offset)
    assert data == tuple(message.joint_torque_measured)


def test_layout_tells_by_what_it_is_known() -> None:
    message = status(5)
    data, layout = message.encode(), Layout(message)
    (begin, size), *lengths = layout.fixed
    assert data[begin : begin + size] == lcmt_iiwa_status._get_packed_fingerprint()
    assert [struct.unpack(">i", data[at : at + n]) for at, n in lengths] == [(message.num_joints,)]


def test_message_that_is_not_numbers_only_has_no_layout(user_types: ModuleType) -> None:
    with pytest.raises(TypeError, match="field name"):
        Layout(mixed(user_types))
