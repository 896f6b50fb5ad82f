"""Tests of the commands of fallbacks, and of the signals that each of them fits."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import FixedOffsetFrame, RevoluteJoint, SpatialInertia, UnitInertia

from vtbdrake.control.fallback import (
    NO_COMMAND,
    Brake,
    CarryWeight,
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


MASSES, LENGTHS = (3.0, 2.0), (0.5, 0.4)


def arm(*, actuated: tuple[int, ...] = (1, 0)) -> MultibodyPlant:
    """Two massless links in the vertical plane with a point mass at each end; the elbow has the first actuator."""
    plant = MultibodyPlant(0.0)
    plant.mutable_gravity_field().set_gravity_vector([0.0, 0.0, -9.81])
    joints, parent, offset = [], plant.world_frame(), 0.0
    for i in range(2):
        inertia = SpatialInertia(MASSES[i], [LENGTHS[i], 0.0, 0.0], UnitInertia.PointMass([LENGTHS[i], 0.0, 0.0]))
        link = plant.AddRigidBody(f"link{i}", inertia)
        elbow = plant.AddFrame(FixedOffsetFrame(f"joint{i}_base", parent, RigidTransform([offset, 0.0, 0.0])))
        # A positive angle lifts the link.
        joints.append(plant.AddJoint(RevoluteJoint(f"joint{i}", elbow, link.body_frame(), [0.0, -1.0, 0.0])))
        parent, offset = link.body_frame(), LENGTHS[i]
    for number, i in enumerate(actuated):
        plant.AddJointActuator(f"actuator{number}", joints[i])
    plant.Finalize()
    return plant


def test_weight_is_carried_at_the_last_accepted_position() -> None:
    q, v = np.array([0.3, -0.8]), np.array([0.5, -0.25])
    brake = Brake("joint_state", gain=2.0, entries=slice(3, 1, -1))  # In the order of the actuators.
    carry = CarryWeight(arm(), "joint_state", entries=slice(0, 2), brake=brake)
    assert chain(carry, TORQUE, interface=INTERFACE)[0] is carry
    elbow = 9.81 * MASSES[1] * LENGTHS[1] * np.cos(q.sum())
    shoulder = elbow + 9.81 * sum(MASSES) * LENGTHS[0] * np.cos(q[0])
    state = np.concatenate((q, v))
    fresh = carry.command(np.zeros(2), {"joint_state": state}, {"joint_state": Sample(state, 0.0)}, 1e-3)
    np.testing.assert_allclose(fresh, [elbow, shoulder] - 2.0 * v[::-1])
    stale = carry.command(np.zeros(2), {}, {"joint_state": Sample(state, 0.2)}, 1e-3)
    np.testing.assert_allclose(stale, [elbow, shoulder])
    assert carry.command(np.zeros(2), {}, {"joint_state": Sample(state, 0.21)}, 1e-3) is NO_COMMAND
    patient = CarryWeight(arm(), "joint_state", entries=slice(0, 2), longest=0.5)
    assert patient.command(np.zeros(2), {}, {"joint_state": Sample(state, 0.21)}, 1e-3) is not NO_COMMAND
    assert carry.command(np.zeros(2), {}, {}, 1e-3) is NO_COMMAND


def test_plant_whose_weight_cannot_be_carried_is_rejected() -> None:
    with pytest.raises(ValueError, match="2 positions and 1 actuators cannot be carried"):
        CarryWeight(arm(actuated=(1,)), "joint_state")
    with pytest.raises(ValueError, match="2 positions and 2 actuators cannot be carried"):
        CarryWeight(arm(actuated=(1, 1)), "joint_state")  # Both on one joint.
    with pytest.raises(ValueError, match="with 0 entries of 'nothing'"):
        chain(CarryWeight(arm(), "nothing"), TORQUE, interface=INTERFACE)
    with pytest.raises(ValueError, match="4 entries of 'joint_state'"):
        chain(CarryWeight(arm(), "joint_state"), TORQUE, interface=INTERFACE)


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
    with pytest.raises(ValueError, match="the brake of joint_torque"):
        chain(CarryWeight(arm(), "joint_state", entries=slice(0, 2), brake=brake), TORQUE, interface=INTERFACE)


def test_weight_is_carried_without_a_brake_or_with_one_that_fits() -> None:
    for brake in (None, Brake("joint_state", gain=0.0, entries=slice(2, 4))):
        carry = CarryWeight(arm(), "joint_state", entries=slice(0, 2), brake=brake)
        assert [type(fallback) for fallback in chain(carry, TORQUE, interface=INTERFACE)] == [CarryWeight, Silence]


def test_abstract_signal_has_no_zero() -> None:
    with pytest.raises(ValueError, match="no zero"):
        chain(FallbackController(lambda *_: "off", otherwise=Zero()), LAMP, interface=INTERFACE)


@pytest.mark.parametrize("gain", [-1.0, [1.0, -2.0], float("nan")])
def test_brake_with_negative_gain_is_rejected(gain: object) -> None:
    with pytest.raises(ValueError, match="are not negative"):
        Brake("joint_state", gain=gain)
