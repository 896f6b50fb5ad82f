"""KUKA iiwa: messages have the conventions of its driver, as Drake's systems read and send them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from drake import lcmt_iiwa_command, lcmt_iiwa_status
from pydrake.manipulation import IiwaCommandReceiver, IiwaControlMode
from pydrake.multibody.plant import MultibodyPlant

from tests.lcm.messages_of_drivers import TAU, Q, decode, encode, read_by_drake, weight
from vtbdrake.control.fallback import gravity_compensation
from vtbdrake.lcm.iiwa_messages import iiwa_command, iiwa_status
from vtbdrake.lcm.messages import MalformedError

STATE = {"position": "joint_position_measured", "speed": "joint_velocity_estimated"}


def iiwa_message() -> lcmt_iiwa_status:
    message = lcmt_iiwa_status()
    message.num_joints = 7
    for name in message.__slots__[2:]:
        setattr(message, name, [0.0] * 7)
    # The arm presses its joints with TAU, which includes its weight.
    message.joint_position_measured, message.joint_torque_measured = Q.tolist(), (-TAU).tolist()
    message.joint_torque_external = TAU.tolist()
    return message


def test_iiwa_negates_its_own_torques_only() -> None:
    fields = ["joint_position_measured", "joint_torque_measured", "joint_torque_external"]
    values = decode(iiwa_status(fields), iiwa_message().encode())
    np.testing.assert_array_equal([values[name] for name in fields], [Q, TAU, TAU])
    both = iiwa_status(["joint_torque_commanded", *fields])
    sent = lcmt_iiwa_status.decode(encode(both, {"joint_torque_commanded": Q, **values}))
    assert (sent.joint_torque_measured, sent.joint_torque_commanded) == (tuple(-TAU), tuple(-Q))
    assert (sent.joint_torque_external, sent.joint_position_measured) == (tuple(TAU), tuple(Q))


@pytest.mark.parametrize("fields", [STATE, {}])
def test_torque_on_top_is_without_gravity_compensation(fields: dict[str, str]) -> None:
    map = iiwa_status(fields, on_top={"added": "joint_torque_measured"}, gravity=weight)
    values = decode(map, iiwa_message().encode())
    assert list(values) == [*fields, "added"]
    np.testing.assert_allclose(values["added"], TAU - 10.0 * np.cos(Q), atol=1e-14)


def test_machine_sends_torque_on_top_with_its_weight() -> None:
    map = iiwa_status(STATE, on_top={"added": "joint_torque_measured"}, gravity=weight)
    values = {"position": Q, "speed": 0.0 * Q, "added": TAU}
    data = encode(map, values)
    np.testing.assert_allclose(lcmt_iiwa_status.decode(data).joint_torque_measured, -(TAU + 10.0 * np.cos(Q)))
    np.testing.assert_allclose(decode(map, data)["added"], TAU, atol=1e-14)


def test_whole_torque_and_the_part_on_top_travel_together() -> None:
    whole = {**STATE, "torque": "joint_torque_measured"}
    map = iiwa_status(whole, on_top={"added": "joint_torque_measured"}, gravity=weight)
    values = {"position": Q, "speed": 0.0 * Q, "torque": TAU, "added": np.full(7, np.nan)}
    decoded = decode(map, encode(map, values))
    np.testing.assert_array_equal(decoded["torque"], TAU)
    np.testing.assert_allclose(decoded["added"], TAU - weight(Q), atol=1e-14)


def test_message_of_another_arm_is_malformed() -> None:
    map = iiwa_status({}, on_top={"added": "joint_torque_measured"}, gravity=weight)
    with pytest.raises(MalformedError, match="size"):
        decode(map, iiwa_message().encode(), size=6)


def test_iiwa_commands_are_read_by_drake() -> None:
    map = iiwa_command({"position": "joint_position", "torque": "joint_torque"})
    data = encode(map, {"position": Q, "torque": TAU})
    receiver = IiwaCommandReceiver(7, IiwaControlMode.kPositionAndTorque)
    assert read_by_drake(receiver, lcmt_iiwa_command, data, "position", "torque", "time") == [[*Q], [*TAU], [1.0]]


def _empty() -> MultibodyPlant:
    plant = MultibodyPlant(0.0)
    plant.Finalize()
    return plant


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: iiwa_status(["joint_torque"]), "has no field 'joint_torque'"),
        (lambda: iiwa_status({}, on_top={"added": "joint_torque_measured"}), "needs gravity="),
        (
            lambda: iiwa_status({}, on_top={"added": "joint_torque_external"}, gravity=weight),
            "part of joint_torque_measured or joint_torque_commanded .* not of 'joint_torque_external'",
        ),
        (
            lambda: encode(
                iiwa_status({}, on_top={"added": "joint_torque_measured"}, gravity=weight), {"added": np.zeros(7)}
            ),
            "measured positions: let a signal hold them",
        ),
        (
            lambda: decode(
                iiwa_status({}, on_top={"added": "joint_torque_measured"}, gravity=lambda q: np.append(q, 0.0)), b""
            ),
            r"has the shape \(8,\), not \(7,\)",
        ),
        (
            lambda: decode(
                iiwa_status({}, on_top={"added": "joint_torque_measured"}, gravity=gravity_compensation(_empty())),
                b"",
            ),
            "cannot take 7 positions",
        ),
    ],
)
def test_map_that_does_not_fit_is_refused(make: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()
