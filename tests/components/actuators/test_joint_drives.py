"""Drives against closed forms: lag, saturation, delay, friction, and the rotor behind its gear."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from pydrake.multibody.plant import AddMultibodyPlant, MultibodyPlant, MultibodyPlantConfig
from pydrake.multibody.tree import RevoluteJoint, RotationalInertia, SpatialInertia
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from vtbdrake.components.actuators import JointDrives

PERIOD = 0.001


def two_joints() -> tuple[DiagramBuilder, MultibodyPlant]:
    """Two wheels on vertical axes, one on the other."""
    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlant(MultibodyPlantConfig(time_step=PERIOD, use_sampled_output_ports=False), builder)
    parent = plant.world_frame()
    for name in ("a", "b"):
        wheel = plant.AddRigidBody(name, SpatialInertia.SolidCylinderWithMass(2.0, 0.5, 0.1, [0, 0, 1]))
        joint = plant.AddJoint(RevoluteJoint(name, parent, wheel.body_frame(), [0, 0, 1], damping=0))
        plant.AddJointActuator(name, joint)
        parent = wheel.body_frame()
    plant.Finalize()
    return builder, plant


def torques(
    steps: int, *, u: Callable[[int], list[float]] = lambda k: [8.0, -4.0], v: tuple[float, float] = (0.0, 0.0), **drive
) -> np.ndarray:
    """Return the output for k = 0, 1, ... while the joints turn at v."""
    _, plant = two_joints()
    drives = JointDrives(plant, [plant.GetJointByName("a"), plant.GetJointByName("b")], period=PERIOD, **drive)
    simulator = Simulator(drives)
    context = simulator.get_mutable_context()
    drives.GetInputPort("state").FixValue(context, [0.0, 0.0, *v])
    shown = []
    for k in range(steps):
        drives.GetInputPort("command").FixValue(context, u(k))
        simulator.AdvanceTo((k + 0.5) * PERIOD)
        shown.append(drives.get_output_port().Eval(context).copy())
    return np.array(shown)


def test_ideal_drive_gives_what_is_commanded() -> None:
    np.testing.assert_array_equal(torques(3), [[8.0, -4.0]] * 3)


def test_a_command_that_is_no_number_is_not_mistaken_for_one() -> None:
    shown = torques(3, u=lambda k: [8.0, np.nan], limit=10.0, rate=1e4)
    np.testing.assert_array_equal(shown, [[8.0, np.nan]] * 3)


def test_current_loop_is_a_first_order_lag() -> None:
    tau = 0.004
    t = (np.arange(30) + 1) * PERIOD  # m_k is the value at the end of the period in which r_k is held
    expected = np.outer(1 - np.exp(-t / tau), [8.0, -4.0])
    np.testing.assert_allclose(torques(30, time_constant=tau), expected, atol=1e-12)


def test_torque_saturates_joint_by_joint() -> None:
    np.testing.assert_array_equal(torques(3, limit=[5.0, 10.0]), [[5.0, -4.0]] * 3)
    np.testing.assert_array_equal(torques(1, u=lambda k: [-80.0, 80.0], limit=5.0), [[-5.0, 5.0]])


def test_torque_changes_no_faster_than_its_rate() -> None:
    expected = [[min(8.0, 1.5 * k), max(-4.0, -1.5 * k)] for k in range(1, 9)]
    np.testing.assert_allclose(torques(8, rate=1500.0), expected, atol=1e-12)


def test_rate_is_that_of_the_saturated_torque() -> None:
    """After an overlong command the torque turns back at once, without winding up."""
    y = torques(6, u=lambda k: [100.0 if k < 3 else 0.0, 0.0], limit=2.0, rate=1000.0)
    np.testing.assert_allclose(y[:, 0], [1.0, 2.0, 2.0, 1.0, 0.0, 0.0], atol=1e-12)


@pytest.mark.parametrize("delay", [0, 1, 4])
def test_delay_counts_periods(delay: int) -> None:
    y = torques(12, u=lambda k: [k + 1.0, -k - 1.0], delay=delay, max_delay=4)
    np.testing.assert_array_equal(y[:delay], np.zeros((delay, 2)))
    np.testing.assert_array_equal(y[delay:, 0], np.arange(1.0, 13.0 - delay))


def test_drive_starts_with_the_torque_it_had() -> None:
    y = torques(4, delay=2, max_delay=2, rate=1000.0, time_constant=0.0, initial=[3.0, -3.0])
    np.testing.assert_allclose(y, [[3.0, -3.0], [3.0, -3.0], [4.0, -4.0], [5.0, -4.0]], atol=1e-12)


def test_friction_opposes_the_motion() -> None:
    v = np.array([0.3, -0.004])
    law = {"viscous": [2.0, 3.0], "coulomb": [1.0, 0.5], "coulomb_velocity": 0.01}
    y = torques(2, v=tuple(v), initial=[8.0, -4.0], **law)
    expected = np.array([8.0, -4.0]) - [2.0 * v[0], 3.0 * v[1]] - np.array([1.0, 0.5]) * np.tanh(v / 0.01)
    np.testing.assert_allclose(y, [expected] * 2, atol=1e-12)


def test_friction_depends_on_speed_load_and_direction() -> None:
    v = np.array([0.3, -0.2])
    law = {"coulomb": 1.0, "coulomb_velocity": 1e-6, "stribeck": [0.5, 0.4], "stribeck_velocity": 0.25}
    y = torques(2, v=tuple(v), initial=[8.0, -4.0], load_friction=0.1, asymmetry=[0.2, -0.3], **law)
    size = 1.0 + np.array([0.5, 0.4]) * np.exp(-((v / 0.25) ** 2)) + 0.1 * np.array([8.0, 4.0])
    np.testing.assert_allclose(y, [np.array([8.0, -4.0]) - size * [1.0, -1.0] - [0.2, -0.3]] * 2, atol=1e-12)


def test_friction_does_not_pass_the_current_loop() -> None:
    np.testing.assert_allclose(
        torques(1, u=lambda k: [0.0, 0.0], v=(1.0, 0.0), viscous=2.0, time_constant=1.0)[0, 0], -2.0
    )


def test_disturbance_has_its_deviation_and_correlation_time() -> None:
    """An Ornstein-Uhlenbeck process, from the first period on."""
    y = torques(3000, u=lambda k: [0.0, 0.0], disturbance=[0.5, 0.0], disturbance_time=0.005, seed=3)
    assert not y[:, 1].any()
    d = y[:, 0]
    # 3 s have 300 independent pieces of 2 T: the deviation is known to 4 %.
    assert d.std() == pytest.approx(0.5, rel=0.12)
    for lag in (1, 5):
        correlation = d[lag:] @ d[:-lag] / (d @ d)
        assert correlation == pytest.approx(np.exp(-lag * PERIOD / 0.005), abs=0.12)
    starts = [torques(1, u=lambda k: [0.0, 0.0], disturbance=0.5, seed=seed)[0] for seed in range(30)]
    assert np.std(starts) == pytest.approx(0.5, rel=0.3)


def test_disturbance_is_the_same_for_the_same_seed() -> None:
    drive = {"disturbance": 0.5, "viscous": 0.1}
    first, again, other = (torques(5, seed=seed, **drive) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert (first != other).all()


def test_every_value_is_a_variable() -> None:
    _, plant = two_joints()
    drives = JointDrives(plant, [plant.GetJointByName("a"), plant.GetJointByName("b")], period=PERIOD, max_delay=3)
    names = [e.name for e in drives.variables]
    assert names == [
        "torque",
        "motor_torque",
        "reference",
        "in_transit",
        "disturbing_torque",
        "last_velocity",
        "has_last",
        "limit",
        "rate",
        "viscous",
        "coulomb",
        "coulomb_velocity",
        "stribeck",
        "stribeck_velocity",
        "load_friction",
        "asymmetry",
        "disturbance",
        "inertia",
        "disturbance_time",
        "seed",
        "time_constant",
        "delay",
    ]


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"limit": -1.0}, "limit must not be negative"),
        ({"limit": "5"}, "JointDrives: limit must be a number or several, not '5'"),
        ({"initial": ["1", "2"]}, "JointDrives: initial must be a number or several, not .'1', '2'"),
        ({"viscous": [0.0, np.nan]}, "viscous must not be negative or NaN"),
        ({"load_friction": -0.1}, "load_friction must not be negative"),
        ({"disturbance": [1.0, -1.0]}, "disturbance must not be negative"),
        ({"delay": 1.5}, "whole number of periods"),
        ({"seed": 0.5}, "seed is a whole number"),
        ({"period": 0.0}, "period must be positive"),
    ],
)
def test_impossible_values_are_refused(values: dict, message: str) -> None:
    _, plant = two_joints()
    with pytest.raises(ValueError, match=message):
        JointDrives(plant, [plant.GetJointByName("a"), plant.GetJointByName("b")], **{"period": PERIOD, **values})


def test_joint_without_its_one_velocity_is_refused() -> None:
    plant = MultibodyPlant(0.0)
    plant.AddRigidBody("free", SpatialInertia.SolidSphereWithMass(1.0, 0.1))
    plant.Finalize()
    with pytest.raises(ValueError, match="6 velocities"):
        JointDrives(plant, [plant.GetJointByName("free")], period=PERIOD)


def test_resumed_drives_stand_where_an_old_command_led_them() -> None:
    drive = {"time_constant": 0.01, "delay": 3, "max_delay": 4, "rate": 500.0, "limit": 20.0}
    expected = torques(200, **drive)[-1]
    _, plant = two_joints()
    drives = JointDrives(plant, [plant.GetJointByName("a"), plant.GetJointByName("b")], period=PERIOD, **drive)
    simulator = Simulator(drives)
    context = simulator.get_mutable_context()
    drives.GetInputPort("state").FixValue(context, np.zeros(4))
    drives.GetInputPort("command").FixValue(context, [8.0, -4.0])
    drives.resume(context, [8.0, -4.0])
    for end in (0.0, 0.0005, 0.0105):
        simulator.AdvanceTo(end)
        np.testing.assert_allclose(drives.get_output_port().Eval(context), expected, rtol=1e-6)


@pytest.mark.parametrize("time_step", [0.0, PERIOD, 0.25 * PERIOD])
@pytest.mark.parametrize("inertia", [2e-5, 2e-3])
def test_light_joint_sticks_and_slides(time_step: float, inertia: float) -> None:
    """T Fc / (I v_c) is up to 5,000: friction at the velocity of the step before would turn it around in each step."""
    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlant(MultibodyPlantConfig(time_step=time_step, use_sampled_output_ports=False), builder)
    rotor = SpatialInertia.MakeFromCentralInertia(0.01, [0, 0, 0], RotationalInertia(inertia, inertia, inertia))
    body = plant.AddRigidBody("rotor", rotor)
    joint = plant.AddJoint(RevoluteJoint("a", plant.world_frame(), body.body_frame(), [0, 0, 1], damping=0))
    plant.AddJointActuator("a", joint)
    plant.Finalize()
    drives = builder.AddSystem(JointDrives(plant, [joint], period=PERIOD, coulomb=1.0, coulomb_velocity=0.01))
    builder.Connect(plant.get_state_output_port(), drives.GetInputPort("state"))
    builder.Connect(drives.get_output_port(), plant.get_actuation_input_port())
    simulator = Simulator(builder.Build())
    context = simulator.get_mutable_context()
    of_drives, of_plant = drives.GetMyMutableContextFromRoot(context), plant.GetMyMutableContextFromRoot(context)
    # Below the friction it creeps at artanh(0.9) coulomb_velocity, and stays there.
    drives.GetInputPort("command").FixValue(of_drives, 0.9)
    simulator.AdvanceTo(0.2)
    for _ in range(20):
        simulator.AdvanceTo(context.get_time() + PERIOD)
        assert joint.get_angular_rate(of_plant) == pytest.approx(0.01 * np.arctanh(0.9), rel=1e-3)
    # Beyond it, the rest accelerates.
    drives.GetInputPort("command").FixValue(of_drives, 1.1)
    simulator.AdvanceTo(0.3)
    before = joint.get_angular_rate(of_plant)
    simulator.AdvanceTo(0.4)
    assert joint.get_angular_rate(of_plant) - before == pytest.approx(0.1 * 0.1 / inertia, rel=1e-6)
    # Back below it, it comes to rest, and never turns around beyond the edge of the friction.
    drives.GetInputPort("command").FixValue(of_drives, 0.0)
    rates = []
    for _ in range(round(before * inertia / PERIOD) + 200):
        simulator.AdvanceTo(context.get_time() + PERIOD)
        rates.append(joint.get_angular_rate(of_plant))
    assert min(rates) > -0.01 and abs(rates[-1]) < 1e-6
