"""Maps between messages and signals, and what they refuse when they are made."""

from __future__ import annotations

from types import ModuleType
from typing import Any

import numpy as np
import pytest
from drake import lcmt_iiwa_command, lcmt_iiwa_status

from tests.control.arm import ACT, SENSE, command, status
from vtbdrake.lcm.bridge import LcmBridge
from vtbdrake.lcm.drake_messages import iiwa_command, iiwa_status
from vtbdrake.lcm.maps import LcmMap
from vtbdrake.lcm.vectors import vector_map
from vtbdrake.testbed import Interface, Signal


def signals(**sizes: int) -> list[Signal]:
    return [Signal(name, size=size, idle=0.0) for name, size in sizes.items()]


def test_status_of_an_arm_becomes_its_signals_in_whichever_way_it_is_read() -> None:
    read = iiwa_status(SENSE).reader(signals(position=7, torque=7))
    for utime in (1_500_000, 2_500_000, 3_500_000):  # the first field by field, the others in one go
        sample = read(status(utime, position=utime * 1e-6, torque=-4.0).encode())
        assert sample.sent == utime * 1e-6
        np.testing.assert_array_equal(sample.values["position"], [utime * 1e-6] * 7)
        np.testing.assert_array_equal(sample.values["torque"], [-4.0] * 7)


@pytest.mark.parametrize("names", [("position", "torque"), ("position",), ("torque",)])
def test_command_is_what_lcm_gen_decodes_and_what_is_not_commanded_is_empty(names: tuple[str, ...]) -> None:
    write = iiwa_command(ACT).writer(signals(position=7, torque=7))
    values = {name: np.arange(7.0) + (10.0 if name == "torque" else 0.0) for name in names}
    for utime in (7, 8):
        data = write(values, utime)
        assert lcmt_iiwa_command.decode(data).utime == utime
        positions, torques = command(data)
        np.testing.assert_array_equal(positions, values.get("position", []))
        np.testing.assert_array_equal(torques, values.get("torque", []))


def test_fields_of_a_users_type_travel_both_ways(user_types: ModuleType) -> None:
    fields = {"wind": ["speed", "direction"], "gust": "gust", "level": "level", "height": "where.z"}
    map = vector_map("WIND", user_types.wind_t, fields)
    of = signals(wind=2, gust=2, level=1, height=1)
    values = {"wind": [7.5, 0.3], "gust": [9.0, 9.5], "level": [4.0], "height": [-1.25]}
    data = map.writer(of)(values, 42)
    message = user_types.wind_t.decode(data)
    assert (message.utime, message.speed, message.direction, message.level) == (42, 7.5, 0.3, 4)
    assert (message.gust, message.where.z) == ((9.0, 9.5), -1.25)
    sample = map.reader(of)(data)
    assert sample.sent == pytest.approx(42e-6)
    for name, value in values.items():
        np.testing.assert_array_equal(sample.values[name], value)


def test_arrays_that_share_a_length_are_filled_when_a_status_is_written() -> None:
    data = iiwa_status(SENSE).writer(signals(position=7, torque=7))({"position": [1.0] * 7, "torque": [2.0] * 7}, 3)
    message = lcmt_iiwa_status.decode(data)
    assert message.joint_position_measured == (1.0,) * 7
    assert message.joint_velocity_estimated == (0.0,) * 7


def test_message_that_cannot_leave_out_a_signal_says_so(user_types: ModuleType) -> None:
    write = vector_map("WIND", user_types.wind_t, {"speed": "speed", "gust": "gust"}).writer(signals(speed=1, gust=2))
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
def test_field_that_cannot_be_a_signal_is_refused(user_types: ModuleType, fields: dict[str, str], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        vector_map("WIND", user_types.wind_t, fields)


def test_signal_of_another_size_than_its_fields_is_refused(user_types: ModuleType) -> None:
    with pytest.raises(ValueError, match="gust has 3 entries, but gust of wind_t on channel WIND has 2"):
        vector_map("WIND", user_types.wind_t, {"gust": "gust"}).reader(signals(gust=3))


def test_signals_of_different_sizes_in_arrays_of_one_length_are_refused() -> None:
    with pytest.raises(ValueError, match="position and torque have 7 and 6 entries, but field num_joints"):
        iiwa_status(SENSE).reader(signals(position=7, torque=6))


def test_type_that_lcm_gen_did_not_make_is_refused() -> None:
    with pytest.raises(ValueError, match="is no class made by lcm-gen"):
        LcmMap(channel="A", type=dict, signals=["a"])


@pytest.mark.parametrize("channel", ["", "C" * 64])
def test_channel_name_that_lcm_cannot_carry_is_refused(channel: str) -> None:
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
