"""Tests of the commands of fallbacks, and of which of them fit which signal."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

from vtbdrake.control.fallback import (
    NO_COMMAND,
    Brake,
    Fallback,
    FallbackController,
    Hold,
    Sample,
    Silence,
    Zero,
    chain,
    default_fallback,
)
from vtbdrake.testbed import Interface, Signal

TORQUE = Signal("joint_torque", size=2, unit="N m", idle=0.0)
LAMP = Signal("lamp", model_value="off", idle="off")
INTERFACE = Interface(
    sense=[Signal("joint_state", size=4, unit="rad"), Signal("picture", model_value="")], act=[TORQUE, LAMP]
)


def test_hold_keeps_the_last_command() -> None:
    assert Hold().command(np.array([1.0, 2.0]), {}, {}, 1e-3).tolist() == [1.0, 2.0]


def test_zero_is_zero() -> None:
    assert Zero().command(np.array([1.0, 2.0]), {}, {}, 1e-3).tolist() == [0.0, 0.0]


def test_brake_acts_against_the_measured_velocity() -> None:
    brake = Brake("joint_state", gain=[2.0, 3.0], entries=slice(2, 4))
    command = brake.command(np.zeros(2), {"joint_state": np.array([9.0, 9.0, 1.0, -0.5])}, {}, 1e-3)
    assert command.tolist() == [-2.0, 1.5]


def test_controller_gets_what_a_fallback_gets() -> None:
    def command(last: Any, sensed: Mapping[str, Any], known: Mapping[str, Sample], dt: float) -> Any:
        return last + dt * sensed["joint_state"][:2] + known["picture"].age

    controller = FallbackController(command, otherwise=Hold())
    sensed, known = {"joint_state": np.array([1.0, 2.0, 0.0, 0.0])}, {"picture": Sample("cat", 7.0)}
    assert controller.command(np.array([1.0, 2.0]), sensed, known, 0.5).tolist() == [8.5, 10.0]


def test_silence_commands_nothing() -> None:
    assert Silence().command(np.zeros(2), {}, {}, 1e-3) is NO_COMMAND


@pytest.mark.parametrize(
    ("unit", "fallback"), [("rad", Hold), ("m", Hold), ("rad/s", Zero), ("N m", Zero), ("N", Zero), ("A", Zero)]
)
def test_default_fallback_follows_from_the_unit(unit: str, fallback: type[Fallback]) -> None:
    assert type(default_fallback(Signal("a", size=1, unit=unit))) is fallback


def test_unknown_unit_has_no_default_fallback() -> None:
    with pytest.raises(ValueError, match=r"'1' of actuator signal gripper .* fallback=\{'gripper': Hold\(\)\}"):
        default_fallback(Signal("gripper", size=1))


def test_chain_contains_replacements_in_order() -> None:
    brake = Brake("joint_state", gain=1.0, entries=slice(2, 4))
    controller = FallbackController(lambda *_: None, otherwise=brake)
    assert [type(f) for f in chain(controller, TORQUE, interface=INTERFACE)] == [FallbackController, Brake, Zero]


def test_cyclic_chain_ends() -> None:
    controller = FallbackController(lambda *_: None, otherwise=Hold())
    controller.otherwise = controller
    assert chain(controller, TORQUE, interface=INTERFACE) == [controller]


@pytest.mark.parametrize(
    "brake",
    [
        Brake("nothing", gain=1.0),
        Brake("picture", gain=1.0),
        Brake("joint_state", gain=1.0),
        Brake("joint_state", gain=[1.0, 2.0, 3.0], entries=slice(2, 4)),
    ],
)
def test_brake_that_does_not_fit_is_rejected(brake: Brake) -> None:
    with pytest.raises(ValueError, match="the brake of joint_torque"):
        chain(brake, TORQUE, interface=INTERFACE)


def test_abstract_signal_has_no_zero() -> None:
    with pytest.raises(ValueError, match="no zero"):
        chain(FallbackController(lambda *_: "off", otherwise=Zero()), LAMP, interface=INTERFACE)


@pytest.mark.parametrize("gain", [-1.0, [1.0, -2.0], float("nan")])
def test_brake_with_negative_gain_is_rejected(gain: object) -> None:
    with pytest.raises(ValueError, match="are not negative"):
        Brake("joint_state", gain=gain)
