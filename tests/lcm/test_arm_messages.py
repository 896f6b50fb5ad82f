"""Arms and grippers: messages have the conventions of the drivers, as Drake's systems read and send them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
from drake import lcmt_iiwa_command, lcmt_iiwa_status, lcmt_panda_command, lcmt_panda_status, lcmt_schunk_wsg_command
from pydrake.lcm import DrakeLcm
from pydrake.manipulation import (
    IiwaCommandReceiver,
    IiwaControlMode,
    PandaCommandReceiver,
    PandaControlMode,
    SchunkWsgCommandReceiver,
)
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, System
from pydrake.systems.lcm import LcmSubscriberSystem

from vtbdrake.control.fallback import gravity_compensation
from vtbdrake.lcm.arm_messages import (
    iiwa_command,
    iiwa_status,
    panda_command,
    panda_status,
    wsg_command,
    wsg_status,
)
from vtbdrake.lcm.maps import LcmMap
from vtbdrake.lcm.messages import MalformedError
from vtbdrake.testbed import Signal

Q, TAU = np.linspace(-1.0, 1.0, 7), np.arange(7.0) - 2.25
STATE = {"position": "joint_position_measured", "speed": "joint_velocity_estimated"}


def weight(q: np.ndarray) -> np.ndarray:
    return 10.0 * np.cos(q)


def encode(map: LcmMap, values: Mapping[str, Any]) -> bytes:
    return map.encoder([Signal(name, size=len(values[name])) for name in map.signals])(values, 1_000_000)


def decode(map: LcmMap, data: bytes, size: int = 7) -> Mapping[str, Any]:
    return map.decoder([Signal(name, size=size) for name in map.signals])(data)[1]


def read_by_drake(receiver: System, message_type: Any, data: bytes, *ports: str) -> list[np.ndarray]:
    """Return the outputs of one of Drake's receivers after it has received a message."""
    builder, bus = DiagramBuilder(), DrakeLcm("memq://")
    subscriber = builder.AddSystem(LcmSubscriberSystem.Make("C", message_type, bus, use_cpp_serializer=True))
    builder.AddSystem(receiver)
    builder.Connect(subscriber.get_output_port(), receiver.get_input_port(0))
    simulator = Simulator(builder.Build())
    context = receiver.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    if receiver.num_input_ports() > 1:
        receiver.GetInputPort("position_measured").FixValue(context, np.zeros(7))
    bus.Publish("C", data)
    bus.HandleSubscriptions(0)
    simulator.AdvanceTo(0.1)
    return [receiver.GetOutputPort(port).Eval(context).tolist() for port in ports]


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


def test_gripper_is_in_metres() -> None:
    fields = {"opening": "actual_position_mm", "speed": "actual_speed_mm_per_s", "force": "actual_force"}
    map = wsg_status(fields)
    data = encode(map, {"opening": [0.05], "speed": [-0.25], "force": [12.0]})
    assert decode(map, data, size=1) == {"opening": [0.05], "speed": [-0.25], "force": [12.0]}


@pytest.mark.parametrize("force", [40.0, None])
def test_gripper_commands_are_read_by_drake(force: float | None) -> None:
    values = {"opening": [0.05]} if force else {"opening": [0.05], "force": [40.0]}
    map = wsg_command({"opening": "target_position_mm"} | ({} if force else {"force": "force"}), force=force)
    receiver = SchunkWsgCommandReceiver(0.02, 10.0)
    read = read_by_drake(receiver, lcmt_schunk_wsg_command, encode(map, values), "position", "force_limit")
    assert read == [[0.05], [40.0]]


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
        (lambda: wsg_command(), "with one largest force"),
        (lambda: wsg_command(["force"], force=1.0), "with one largest force"),
        (lambda: panda_command(["torque"]), "has no field 'torque'"),
    ],
)
def test_map_that_does_not_fit_is_refused(make: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()
