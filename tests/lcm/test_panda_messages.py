"""Franka Panda: messages have the conventions of its driver, as Drake's systems read and send them."""

from __future__ import annotations

import numpy as np
import pytest
from drake import lcmt_panda_command, lcmt_panda_status
from pydrake.manipulation import PandaCommandReceiver, PandaControlMode

from tests.lcm.messages_of_drivers import TAU, Q, decode, encode, read_by_drake, weight
from vtbdrake.lcm.panda_messages import panda_command, panda_status


def test_panda_negates_the_external_torque_only() -> None:
    fields = ["joint_position", "joint_torque", "joint_torque_desired", "joint_torque_external"]
    map = panda_status(fields, on_top={"added": "joint_torque"}, gravity=weight)
    values = dict(zip(fields, (Q, TAU, 2.0 * TAU, 3.0 * TAU), strict=True))
    data = encode(map, {**values, "added": TAU})
    sent = lcmt_panda_status.decode(data)
    assert sent.joint_torque_external == tuple(-3.0 * TAU)
    assert (sent.joint_torque, sent.joint_torque_desired) == (tuple(TAU), tuple(2.0 * TAU))
    decoded = decode(map, data)
    np.testing.assert_array_equal([decoded[name] for name in fields], list(values.values()))
    np.testing.assert_allclose(decoded["added"], TAU - weight(Q), atol=1e-14)


@pytest.mark.parametrize(
    ("field", "mode"),
    [
        ("joint_position", PandaControlMode.kPosition),
        ("joint_velocity", PandaControlMode.kVelocity),
        ("joint_torque", PandaControlMode.kTorque),
    ],
)
def test_panda_commands_name_their_control_mode(field: str, mode: int) -> None:
    data = encode(panda_command([field]), {field: TAU})
    assert lcmt_panda_command.decode(data).control_mode_expected == mode
    port = field.removeprefix("joint_")
    assert read_by_drake(PandaCommandReceiver(7, mode), lcmt_panda_command, data, port) == [[*TAU]]


def test_map_that_does_not_fit_is_refused() -> None:
    with pytest.raises(ValueError, match="has no field 'torque'"):
        panda_command(["torque"])
