"""Maps decode strictly, carry vectors both ways, and are refused if they do not fit."""

from __future__ import annotations

import struct
from collections.abc import Callable
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from drake import lcmt_iiwa_command, lcmt_iiwa_status, lcmt_image, lcmt_robot_state, lcmt_scope

from tests.control.arm import ACT, SENSE, command, status
from vtbdrake.lcm.iiwa_messages import iiwa_command, iiwa_status
from vtbdrake.lcm.lcm_bridge import LcmBridge
from vtbdrake.lcm.maps import LcmMap, decode, vector_map
from vtbdrake.lcm.messages import MalformedError
from vtbdrake.testbed import Interface, Signal


def signals(**sizes: int) -> list[Signal]:
    return [Signal(name, size=size, idle=0.0) for name, size in sizes.items()]


def mixed(types: ModuleType) -> Any:
    message = types.mixed_t()
    message.utime, message.name, message.n, message.m = 5, "camera", 2, 3
    message.grid = [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]
    message.blob = b"abc"
    message.points = [types.point_t(), types.point_t()]
    return message


def reason(message_type: Any, data: bytes) -> str:
    with pytest.raises(MalformedError) as caught:
        decode(message_type, data)
    return caught.value.reason


def test_message_is_decoded_as_lcm_gen_does(user_types: ModuleType) -> None:
    data = mixed(user_types).encode()
    assert decode(user_types.mixed_t, data).encode() == data


def test_map_shows_itself_in_a_line() -> None:
    shown = repr(vector_map("STATUS", lcmt_scope, {"angle": "value"}))
    assert shown.startswith("VectorMap(channel='STATUS'") and "signals=('angle',)" in shown and len(shown) < 150


def test_every_truncation_is_rejected(user_types: ModuleType) -> None:
    data = mixed(user_types).encode()
    assert {reason(user_types.mixed_t, data[:length]) for length in range(len(data))} == {"truncated"}


def test_trailing_bytes_and_other_types_are_rejected() -> None:
    assert reason(lcmt_iiwa_status, status(1).encode() + b"\0") == "trailing"
    assert reason(lcmt_iiwa_status, lcmt_robot_state().encode()) == "fingerprint"


def test_negative_length_is_rejected() -> None:
    data = bytearray(lcmt_image().encode())
    at = data.index(struct.pack(">iiii", 0, 0, 0, 0)) + 12
    data[at : at + 4] = struct.pack(">i", -1)
    assert reason(lcmt_image, bytes(data)) == "size"


def test_billions_of_empty_rows_are_not_read(user_types: ModuleType) -> None:
    data = bytearray(user_types.mixed_t().encode())
    at = 8 + 8 + 4 + 1  # fingerprint, utime, name
    data[at : at + 4] = struct.pack(">i", 2**31 - 1)
    assert reason(user_types.mixed_t, bytes(data)) == "size"


def test_status_of_an_arm_becomes_its_signals() -> None:
    sent, values = iiwa_status(SENSE).decoder(signals(position=7, torque=7))(status(9, position=0.5).encode())
    assert sent == 9 * 1e-6
    assert {name: value.tolist() for name, value in values.items()} == {"position": [0.5] * 7, "torque": [0.2] * 7}


@pytest.mark.parametrize("names", [("position", "torque"), ("position",), ("torque",)])
def test_signals_without_a_command_are_empty(names: tuple[str, ...]) -> None:
    write = iiwa_command(ACT).encoder(signals(position=7, torque=7))
    values = {name: np.arange(7.0) + (10.0 if name == "torque" else 0.0) for name in names}
    for utime in (7, 8):
        data = write(values, utime)
        assert lcmt_iiwa_command.decode(data).utime == utime
        positions, torques = command(data)
        np.testing.assert_array_equal(positions, values.get("position", []))
        np.testing.assert_array_equal(torques, values.get("torque", []))


def test_fields_of_a_user_type_travel_both_ways(user_types: ModuleType) -> None:
    fields = {"wind": ["speed", "direction"], "gust": "gust", "level": "level", "height": "where.z"}
    map = vector_map("WIND", user_types.wind_t, fields)
    of = signals(wind=2, gust=2, level=1, height=1)
    values = {"wind": [7.5, 0.3], "gust": [9.0, 9.5], "level": [4.0], "height": [-1.25]}
    data = map.encoder(of)(values, 42)
    message = user_types.wind_t.decode(data)
    assert (message.utime, message.speed, message.direction, message.level) == (42, 7.5, 0.3, 4)
    assert (message.gust, message.where.z) == ((9.0, 9.5), -1.25)
    sent, decoded = map.decoder(of)(data)
    assert sent == pytest.approx(42e-6)
    assert {name: value.tolist() for name, value in decoded.items()} == values


def test_signal_has_another_unit_and_sign_than_its_field(user_types: ModuleType) -> None:
    map = vector_map("WIND", user_types.wind_t, {"level": "level", "gust": "gust"}, scale={"gust": -1e-3})
    of = signals(level=1, gust=2)
    data = map.encoder(of)({"level": [3.0], "gust": [0.25, -0.5]}, 42)
    assert user_types.wind_t.decode(data).gust == (-250.0, 500.0)
    decoded = map.decoder(of)(data)[1]
    assert (decoded["level"].tolist(), decoded["gust"].tolist()) == ([3.0], [0.25, -0.5])


def test_constant_is_in_every_sent_message(user_types: ModuleType) -> None:
    map = vector_map("WIND", user_types.wind_t, {"gust": "gust"}, constants={"level": 7, "where.z": 0.5})
    message = user_types.wind_t.decode(map.encoder(signals(gust=2))({"gust": [1.0, 2.0]}, 42))
    assert (message.level, message.where.z, message.gust) == (7, 0.5, (1.0, 2.0))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"scale": {"gust": 0.0}}, r"scale maps signals of channel WIND \(gust\) .* not 'gust' to 0.0"),
        ({"scale": {"gust": np.nan}}, "not 'gust' to nan"),
        ({"scale": {"speed": 2.0}}, "not 'speed' to 2.0"),
        ({"constants": {"level": 0.5}}, "cannot hold 0.5"),
        ({"constants": {"gust": 0.5}}, "cannot hold 0.5"),
        ({"constants": {"height": 0.5}}, "has no field 'height'"),
    ],
)
def test_scale_and_constants_that_do_not_fit_are_refused(user_types: ModuleType, options: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        vector_map("WIND", user_types.wind_t, {"gust": "gust"}, **options)


def test_fields_beside_arrays_of_messages_travel_both_ways(user_types: ModuleType) -> None:
    assert vector_map("MIXED", user_types.mixed_t, {"n": "n"}).decoder(signals(n=1))(mixed(user_types).encode()) == (
        5 * 1e-6,
        {"n": [2.0]},
    )
    map = vector_map("STATE", lcmt_robot_state, {"positions": "joint_position"})
    message = lcmt_robot_state()
    message.utime, message.num_joints, message.joint_name = 7, 2, ["shoulder", ""]
    message.joint_position = [0.25, -0.5]
    sent, decoded = map.decoder(signals(positions=2))(message.encode())
    assert (sent, decoded["positions"].tolist()) == (7 * 1e-6, [0.25, -0.5])
    message.joint_name = ["", ""]
    assert map.encoder(signals(positions=2))(decoded, 7) == message.encode()


def test_length_of_an_array_cannot_be_sent(user_types: ModuleType) -> None:
    with pytest.raises(ValueError, match="length of an array follows from its signal"):
        vector_map("MIXED", user_types.mixed_t, {"n": "n"}).encoder(signals(n=1))


def test_type_that_contains_itself_is_refused(user_types: ModuleType) -> None:
    with pytest.raises(ValueError, match="tree_t contains itself: write an LcmMap"):
        vector_map("TREE", user_types.tree_t, {"x": "x"}, stamp="")


def test_other_arrays_of_the_same_length_are_zero() -> None:
    data = iiwa_status(SENSE).encoder(signals(position=7, torque=7))({"position": [1.0] * 7, "torque": [2.0] * 7}, 3)
    message = lcmt_iiwa_status.decode(data)
    assert message.joint_position_measured == (1.0,) * 7
    assert message.joint_velocity_estimated == (0.0,) * 7


def test_signal_of_fixed_size_cannot_be_left_out(user_types: ModuleType) -> None:
    write = vector_map("WIND", user_types.wind_t, {"speed": "speed", "gust": "gust"}).encoder(signals(speed=1, gust=2))
    with pytest.raises(LookupError, match="gust"):
        write({"speed": [1.0]}, 1)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"a": "velocity"}, "has no field 'velocity'; it has utime, speed"),
        ({"a": "where.w"}, "has no field 'where.w'"),
        ({"a": "where"}, "is a vtb_test_types.point_t"),
    ],
)
def test_unsuitable_field_is_refused(user_types: ModuleType, fields: dict[str, str], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        vector_map("WIND", user_types.wind_t, fields)


def test_signal_of_another_size_is_refused(user_types: ModuleType) -> None:
    with pytest.raises(ValueError, match="gust has 3 entries, but gust of wind_t on channel WIND has 2"):
        vector_map("WIND", user_types.wind_t, {"gust": "gust"}).decoder(signals(gust=3))


def test_signals_that_share_a_length_have_one_size() -> None:
    with pytest.raises(ValueError, match="position and torque have 7 and 6 entries, but field num_joints"):
        iiwa_status(SENSE).decoder(signals(position=7, torque=6))


@pytest.mark.parametrize(
    "make", [lambda: LcmMap(channel="A", type=dict, signals=["a"]), lambda: vector_map("A", dict, {"a": "a"})]
)
def test_type_not_made_by_lcm_gen_is_refused(make: Callable[[], LcmMap]) -> None:
    with pytest.raises(ValueError, match="is no class made by lcm-gen"):
        make()


@pytest.mark.parametrize("channel", ["", "C" * 64])
def test_impossible_channel_name_is_refused(channel: str) -> None:
    with pytest.raises(ValueError, match="an LCM channel's name has 1 to 63 bytes"):
        iiwa_command(channel=channel)


INTERFACE = Interface(sense=signals(position=7, torque=7), act=signals(joint_position=7))


@pytest.mark.parametrize(
    ("sense", "act", "message"),
    [
        ([iiwa_status({"position": "joint_position_measured"})], [iiwa_command()], "sensor signal torque .* none"),
        (
            [iiwa_status(SENSE), iiwa_status({"torque": "joint_torque_measured"}, channel="B")],
            [iiwa_command()],
            "sensor signal torque .* several: IIWA_STATUS, B",
        ),
        ([iiwa_status(SENSE)], [], "actuator signal joint_position .* none"),
        (
            [iiwa_status(SENSE | {"speed": "joint_velocity_estimated"})],
            [iiwa_command()],
            "channel IIWA_STATUS carries speed, which is no sensor signal; there are: position, torque",
        ),
        ([iiwa_status(SENSE)], [iiwa_command(channel="IIWA_STATUS")], "these have several: IIWA_STATUS"),
        (
            [iiwa_status(SENSE)],
            [LcmMap(channel="C", type=lcmt_iiwa_command, signals=["joint_position"])],
            "channel C has no encode=",
        ),
    ],
)
def test_maps_that_do_not_fit_the_interface_are_refused(sense: Any, act: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        LcmBridge(INTERFACE, "memq://", sense=sense, act=act)
