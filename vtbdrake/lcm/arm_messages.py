"""Ready-made maps for the arms and grippers that speak Drake's messages, with the conventions of their drivers.

The signals have the conventions of a plant: torques are positive where they accelerate a joint in its positive
direction, external torques are those of the environment on the joints, lengths are in m. The messages have those of the
drivers (``manipulation/README.md`` of Drake, whose simulated drivers follow them, too):

* KUKA iiwa: measured and commanded torque are negated, and include the arm's gravity compensation. The external torque
  is not negated. A torque command is added to the gravity compensation.
* Franka Panda: the external torque is negated. The measured torque includes the arm's gravity compensation, the desired
  one does not. A torque command is added to the gravity compensation.
* Schunk WSG: lengths are in mm. The sign of the force means nothing.

So both arms carry their weight themselves, and a torque command is what comes on top. What a command has to continue
when it takes over is the torque that acts then on top of the gravity compensation: the arguments ``on_top`` and
``gravity``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from drake import (
    lcmt_iiwa_command,
    lcmt_iiwa_status,
    lcmt_panda_command,
    lcmt_panda_status,
    lcmt_schunk_wsg_command,
    lcmt_schunk_wsg_status,
)
from numpy.typing import NDArray

from vtbdrake.failures import FAILURES
from vtbdrake.lcm.maps import Decoder, Encoder, LcmMap, vector_map
from vtbdrake.lcm.messages import MalformedError
from vtbdrake.testbed import Signal

Fields = Mapping[str, str] | Sequence[str]
Gravity = Callable[[NDArray[np.float64]], NDArray[np.float64]]
"""An arm's gravity compensation: torques in N m, as a function of the joint positions in rad."""

_IIWA_SIGNS = {"joint_torque_measured": -1.0, "joint_torque_commanded": -1.0}
_PANDA_SIGNS = {"joint_torque_external": -1.0}
_WSG_UNITS = {"actual_position_mm": 1e-3, "actual_speed_mm_per_s": 1e-3, "target_position_mm": 1e-3}


def iiwa_status(
    fields: Fields,
    *,
    on_top: Mapping[str, str] | None = None,
    gravity: Gravity | None = None,
    channel: str = "IIWA_STATUS",
) -> LcmMap:
    """Return a map for the state of a KUKA iiwa, as drake-iiwa-driver and Drake's `IiwaDriver` send it.

    In the message, ``joint_torque_measured`` and ``joint_torque_commanded`` have the opposite sign; both include
    the arm's gravity compensation. The signals have the sign of a plant.

    Args:
        fields: By signal, the field of `lcmt_iiwa_status` that holds it: ``joint_position_measured``,
            ``joint_velocity_estimated`` (filtered: 40 Hz in drake-iiwa-driver), ``joint_position_commanded``,
            ``joint_position_ipo`` in rad and rad/s; ``joint_torque_measured``, ``joint_torque_commanded`` and
            ``joint_torque_external`` in N m. A sequence, if signals and fields have the same names.
        on_top: By signal, the field of the measured or the commanded torque, of which the signal is the part on top of
            the gravity compensation: what the torque commands of `iiwa_command` add, and what they have to continue.
        gravity: The gravity compensation of the arm with its tool; `vtbdrake.control.gravity_compensation` makes it
            from a plant with the arm's joints alone. Required for ``on_top``.
        channel: Name of the channel.

    Raises:
        ValueError: There is no such field, or ``on_top`` has no ``gravity``.
    """
    return _arm_status(
        channel,
        lcmt_iiwa_status,
        _same_names(fields),
        signs=_IIWA_SIGNS,
        position="joint_position_measured",
        torques=("joint_torque_measured", "joint_torque_commanded"),
        on_top=on_top,
        gravity=gravity,
    )


def iiwa_command(fields: Fields = ("joint_position",), *, channel: str = "IIWA_COMMAND") -> LcmMap:
    """Return a map for the actuator commands to a KUKA iiwa.

    The arm needs positions in position mode, torques in torque-only mode, and both in impedance mode. It adds the
    torques to its gravity compensation: an arm at rest needs a torque of 0, not one against its weight.

    Args:
        fields: By signal, the field of `lcmt_iiwa_command` that holds it: ``joint_position`` in rad, ``joint_torque``
            in N m. A field without a command is empty in the message. A sequence, if signals and fields have the same
            names.
        channel: Name of the channel.

    Raises:
        ValueError: There is no such field.
    """
    return vector_map(channel, lcmt_iiwa_command, _same_names(fields))


def panda_status(
    fields: Fields,
    *,
    on_top: Mapping[str, str] | None = None,
    gravity: Gravity | None = None,
    channel: str = "PANDA_STATUS",
) -> LcmMap:
    """Return a map for the state of a Franka Panda, as drake-franka-driver sends it.

    In the message, ``joint_torque_external`` has the opposite sign; ``joint_torque`` includes the arm's gravity
    compensation, and ``joint_torque_desired`` does not. The signals have the sign of a plant.

    Args:
        fields: By signal, the field of `lcmt_panda_status` that holds it: ``joint_position``, ``joint_velocity``,
            ``joint_position_desired``, ... in rad, rad/s and rad/s^2; ``joint_torque`` (measured),
            ``joint_torque_desired`` and ``joint_torque_external`` in N m. A sequence, if signals and fields have the
            same names.
        on_top: By signal, ``joint_torque``, of which the signal is the part on top of the gravity compensation: what
            the torque commands of `panda_command` add, and what they have to continue.
        gravity: The arm's gravity compensation, see `iiwa_status`. Required for ``on_top``.
        channel: Name of the channel.

    Raises:
        ValueError: There is no such field, or ``on_top`` has no ``gravity``.
    """
    return _arm_status(
        channel,
        lcmt_panda_status,
        _same_names(fields),
        signs=_PANDA_SIGNS,
        position="joint_position",
        torques=("joint_torque",),
        on_top=on_top,
        gravity=gravity,
    )


def panda_command(fields: Fields = ("joint_position",), *, channel: str = "PANDA_COMMAND") -> LcmMap:
    """Return a map for the actuator commands to a Franka Panda.

    The message says which control mode it is for: that of its fields. The arm adds the torques to its gravity
    compensation (drake-franka-driver without ``--remove_gravity_compensation``).

    Args:
        fields: By signal, the field of `lcmt_panda_command` that holds it: ``joint_position`` in rad,
            ``joint_velocity`` in rad/s, ``joint_torque`` in N m. A sequence, if signals and fields have the same names.
        channel: Name of the channel.

    Raises:
        ValueError: There is no such field.
    """
    fields = _same_names(fields)
    modes = {
        "joint_position": lcmt_panda_status.CONTROL_MODE_POSITION,
        "joint_velocity": lcmt_panda_status.CONTROL_MODE_VELOCITY,
        "joint_torque": lcmt_panda_status.CONTROL_MODE_TORQUE,
    }
    mode = sum(modes.get(name, 0) for name in set(fields.values()))
    return vector_map(channel, lcmt_panda_command, fields, constants={"control_mode_expected": mode})


def wsg_status(fields: Fields, *, channel: str = "SCHUNK_WSG_STATUS") -> LcmMap:
    """Return a map for the state of a Schunk WSG gripper.

    The signals are in m and m/s, the message is in mm. Its force has no reliable sign: take the absolute value.

    Args:
        fields: By signal, the field of `lcmt_schunk_wsg_status` that holds it: ``actual_position_mm`` and
            ``actual_speed_mm_per_s`` of the fingers' distance, ``actual_force`` in N. A sequence, if signals and fields
            have the same names.
        channel: Name of the channel.

    Raises:
        ValueError: There is no such field.
    """
    fields = _same_names(fields)
    return vector_map(channel, lcmt_schunk_wsg_status, fields, scale=_by_signal(_WSG_UNITS, fields))


def wsg_command(
    fields: Fields = ("target_position_mm",), *, force: float | None = None, channel: str = "SCHUNK_WSG_COMMAND"
) -> LcmMap:
    """Return a map for the actuator commands to a Schunk WSG gripper.

    Args:
        fields: By signal, the field of `lcmt_schunk_wsg_command` that holds it: ``target_position_mm``, the distance of
            the fingers (the signal is in m), and ``force``, its largest force in N. A sequence, if signals and fields
            have the same names.
        force: The largest force in N where no signal holds it.
        channel: Name of the channel.

    Raises:
        ValueError: There is no such field, or the force is given twice or never.
    """
    fields = _same_names(fields)
    if ("force" in fields.values()) == (force is not None):
        raise ValueError("a gripper is commanded with one largest force: by a signal of the field force, or by force=")
    constants = {} if force is None else {"force": force}
    return vector_map(
        channel, lcmt_schunk_wsg_command, fields, scale=_by_signal(_WSG_UNITS, fields), constants=constants
    )


@dataclass(frozen=True, kw_only=True)
class OnTopOfGravityMap(LcmMap):
    """An `LcmMap` of an arm's state with torques on top of the arm's gravity compensation.

    From a message with the positions q and the torques tau, the signals get tau - g(q), where g is the gravity
    compensation.

    Attributes:
        whole: The map of the same messages with tau in place of tau - g(q), and with the positions.
        position: The name of q in ``whole``.
        on_top: By signal, the name in ``whole`` of the tau that it is a part of.
        gravity: g, as a function of q.
    """

    whole: LcmMap = field(repr=False)
    position: str
    on_top: Mapping[str, str]
    gravity: Gravity = field(repr=False)

    def decoder(self, signals: Sequence[Signal]) -> Decoder:
        size, whole = self._sizes(signals)
        decode_whole = self.whole.decoder(whole)

        def decode_on_top(data: bytes) -> tuple[float, Mapping[str, Any]]:
            sent, values = decode_whole(data)
            if len(values[self.position]) != size:
                raise MalformedError("size")
            weight = self.gravity(values[self.position])
            parts = {name: values[torque] - weight for name, torque in self.on_top.items()}
            return sent, {name: parts[name] if name in parts else values[name] for name in self.signals}

        return decode_on_top

    def encoder(self, signals: Sequence[Signal]) -> Encoder:
        _, whole = self._sizes(signals)
        if self.position not in self.signals:
            raise ValueError(
                f"channel {self.channel} sends {', '.join(self.on_top)} with the gravity compensation, which follows "
                "from the measured positions: let a signal hold them, too"
            )
        encode_whole = self.whole.encoder(whole)

        def encode_on_top(values: Mapping[str, Any], utime: int) -> bytes:
            weight = self.gravity(np.asarray(values[self.position], dtype=float))
            # Where a signal holds the whole torque, that is sent.
            sums = {torque: values[name] + weight for name, torque in self.on_top.items()}
            return encode_whole({**sums, **{name: values[name] for name in values if name not in self.on_top}}, utime)

        return encode_on_top

    def _sizes(self, signals: Sequence[Signal]) -> tuple[int, list[Signal]]:
        """Return the number of joints, and the signals of ``whole``; raise ValueError if the gravity does not fit."""
        by_name = {signal.name: signal for signal in signals}
        (size, *other_sizes) = {by_name[name].size for name in self.on_top}
        if other_sizes or size is None:
            raise ValueError(f"signals {', '.join(self.on_top)} on channel {self.channel} are vectors of one size")
        try:
            shape = np.shape(self.gravity(np.zeros(size)))
        except FAILURES as error:
            raise ValueError(f"the gravity of channel {self.channel} cannot take {size} positions: {error}") from error
        if shape != (size,):
            raise ValueError(f"the gravity of channel {self.channel} has the shape {shape}, not ({size},)")
        return size, [by_name.get(name) or Signal(name, size=size) for name in self.whole.signals]


def _arm_status(
    channel: str,
    message_type: Any,
    fields: Mapping[str, str],
    *,
    signs: Mapping[str, float],
    position: str,
    torques: Sequence[str],
    on_top: Mapping[str, str] | None,
    gravity: Gravity | None,
) -> LcmMap:
    """Return the map of an arm's state.

    Args:
        channel: Name of the channel.
        message_type: Type of the messages.
        fields: Field by signal.
        signs: Factor from message to signal by field, where it is not 1.
        position: The field of the measured positions.
        torques: The fields of torques that include the gravity compensation.
        on_top: Field by signal, see `iiwa_status`.
        gravity: See `iiwa_status`.
    """
    if not on_top:
        return vector_map(channel, message_type, fields, scale=_by_signal(signs, fields))
    if gravity is None:
        raise ValueError(f"channel {channel} needs gravity= for torques on top of it ({', '.join(on_top)})")
    for name, path in on_top.items():
        if path not in torques or name in fields:
            raise ValueError(
                f"signal {name} on channel {channel} is either in fields, or the part of {' or '.join(torques)} on top "
                f"of the gravity compensation, not of {path!r}"
            )
    by_field = {path: name for name, path in fields.items()}
    internal = {path: by_field.get(path, f"{path}@{channel}") for path in (position, *on_top.values())}
    whole_fields = {**fields, **{name: path for path, name in internal.items()}}
    whole = vector_map(channel, message_type, whole_fields, scale=_by_signal(signs, whole_fields))
    return OnTopOfGravityMap(
        channel=channel,
        type=message_type,
        signals=(*fields, *on_top),
        whole=whole,
        position=internal[position],
        on_top={name: internal[path] for name, path in on_top.items()},
        gravity=gravity,
    )


def _same_names(fields: Fields) -> Mapping[str, str]:
    return fields if isinstance(fields, Mapping) else {name: name for name in fields}


def _by_signal(factors: Mapping[str, float], fields: Mapping[str, str]) -> dict[str, float]:
    return {name: factors[path] for name, path in fields.items() if path in factors}
