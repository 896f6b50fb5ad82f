"""The DPS: its interface, and each part against an analytic case."""

from __future__ import annotations

import casadi
import numpy as np
import pytest
from pydrake.common.eigen_geometry import AngleAxis
from pydrake.math import RollPitchYaw, RotationMatrix
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, Diagram, LeafSystem

from vtbdrake_diagrams.space_climber.dps import make_dps
from vtbdrake_diagrams.space_climber.estimation import complementary_filter, rotation, turn, wrap
from vtbdrake_diagrams.space_climber.kinematics import LegKinematics
from vtbdrake_diagrams.space_climber.morphology import Morphology

PERIOD = 0.02
MORPHOLOGY = Morphology()
STANCE = LegKinematics().inverse(MORPHOLOGY.stance).ravel()
LEVEL = np.array([0, 0, 0, 0, 0, 1.62])


def fixed(dps: Diagram, **signals: object) -> Context:
    """A context with the robot standing, level, and with the given signals."""
    context = dps.CreateDefaultContext()
    values = dict(imu=LEVEL, joint_encoders=STANCE, foot_contact=np.ones(6), heading=[0.0], walk=[0.0])
    for name, value in {**values, **signals}.items():
        dps.GetInputPort(name).FixValue(context, value)
    return context


def leaf(dps: Diagram, *path: str) -> LeafSystem:
    system = dps
    for name in path:
        system = system.GetSubsystemByName(name)
    return system


def element(dps: Diagram, context: Context, path: str, name: str) -> np.ndarray:
    system = leaf(dps, *path.split("."))
    (found,) = (e for e in system.variables if e.name == name)
    own = system.GetMyContextFromRoot(context)
    group = own.get_numeric_parameter if found.group == "parameter" else own.get_discrete_state
    values = group(found.index).value()[found.start : found.start + int(np.prod(found.shape))]
    return values.reshape(found.shape).copy()


def set_element(dps: Diagram, context: Context, path: str, name: str, value: object) -> None:
    system = leaf(dps, *path.split("."))
    (found,) = (e for e in system.variables if e.name == name)
    own = system.GetMyMutableContextFromRoot(context)
    group = own.get_mutable_numeric_parameter if found.group == "parameter" else own.get_mutable_discrete_state
    vector = group(found.index)
    values = vector.value().copy()
    values[found.start : found.start + int(np.prod(found.shape))] = np.ravel(value)
    vector.SetFromVector(values)


def test_parts_and_ports() -> None:
    dps = make_dps(period=PERIOD)
    assert [system.get_name() for system in dps.GetSystems()] == ["sense", "env", "impl", "act"]
    sizes = {dps.get_input_port(k).get_name(): dps.get_input_port(k).size() for k in range(dps.num_input_ports())}
    assert sizes == {"imu": 6, "joint_encoders": 18, "foot_contact": 6, "heading": 1, "walk": 1}
    assert dps.get_output_port().get_name() == "joint_position"
    assert dps.get_output_port().size() == 18
    assert not dps.HasAnyDirectFeedthrough()


def test_unknown_gait_is_refused() -> None:
    with pytest.raises(ValueError, match="tripod, ripple, wave"):
        make_dps("gallop", period=PERIOD)


def test_stands_still_from_the_start() -> None:
    dps = make_dps(period=PERIOD)
    simulator = Simulator(dps, fixed(dps))
    for k in range(1, 40):
        simulator.AdvanceTo(k * PERIOD)
        np.testing.assert_allclose(dps.get_output_port().Eval(simulator.get_context()), STANCE, atol=1e-12)


def test_low_pass_reaches_63_percent_after_its_time_constant() -> None:
    dps = make_dps(period=PERIOD)
    context = fixed(dps, imu=[1.0, 0, 0, 0, 0, 1.62])
    set_element(dps, context, "sense.calibration", "imu_time_constant", 10 * PERIOD)
    set_element(dps, context, "sense.calibration", "gyro_bias", [0.5, 0, 0])
    simulator = Simulator(dps, context)
    simulator.AdvanceTo(9.5 * PERIOD)  # ten samples
    filtered = element(dps, simulator.get_context(), "sense.calibration", "imu")
    assert filtered[0] == pytest.approx(0.5 * (1 - np.exp(-1)), rel=1e-12)


def test_first_specific_force_sets_roll_and_pitch() -> None:
    dps = make_dps(period=PERIOD)
    roll, pitch, g = 0.2, -0.3, 3.71
    force = g * np.array([-np.sin(pitch), np.cos(pitch) * np.sin(roll), np.cos(pitch) * np.cos(roll)])
    simulator = Simulator(dps, fixed(dps, imu=[0, 0, 0, *force]))
    simulator.AdvanceTo(1.5 * PERIOD)
    context = simulator.get_context()
    assert element(dps, context, "env", "roll") == pytest.approx(roll, abs=1e-12)
    assert element(dps, context, "env", "pitch") == pytest.approx(pitch, abs=1e-12)


def filtered(attitude: list[float], imu: list[float], *, period: float, trust: float) -> list[float]:
    following = complementary_filter(casadi.DM(attitude), casadi.DM(imu), period=period, trust=trust)
    return following.full().ravel().tolist()


def test_complementary_filter_forgets_with_its_time_constant() -> None:
    attitude, trust = [0.1, 0.1, 0.5], 1.0 - np.exp(-0.02 / 2.0)
    for _ in range(100):  # one time constant of 2 s, at rest and level
        attitude = filtered(attitude, [0, 0, 0, 0, 0, 9.81], period=0.02, trust=trust)
    np.testing.assert_allclose(attitude, [0.1 * np.exp(-1), 0.1 * np.exp(-1), 0.5], rtol=1e-9)


def test_gyro_alone_integrates_a_turn_of_a_tilted_body() -> None:
    """A body with pitch 0.4 turns about the world's z axis at 0.5 rad/s."""
    pitch, rate, dt = 0.4, 0.5, 1e-3
    attitude = [0.0, pitch, 0.0]
    w_B = [-rate * np.sin(pitch), 0.0, rate * np.cos(pitch)]
    for _ in range(2000):
        attitude = filtered(attitude, [*w_B, 0, 0, 1.0], period=dt, trust=0.0)
    np.testing.assert_allclose(attitude, [0.0, pitch, 1.0], atol=1e-9)


def test_gyro_alone_follows_jolts() -> None:
    """An integrating gyro shows log(R_last' R) / T. Turns of 0.2 rad in a sample, about any axis, add no error."""
    rng, period = np.random.default_rng(3), 0.04
    attitude, R = [0.0, 0.0, 0.0], RotationMatrix()
    for turned in rng.normal(scale=0.12, size=(200, 3)):
        R = R @ RotationMatrix(AngleAxis(float(np.linalg.norm(turned)), turned / np.linalg.norm(turned)))
        attitude = filtered(attitude, [*(turned / period), 0, 0, 1.0], period=period, trust=0.0)
        np.testing.assert_allclose(RollPitchYaw(attitude).ToRotationMatrix().matrix(), R.matrix(), atol=1e-9)
    np.testing.assert_array_equal(turn(casadi.DM.zeros(3)).full(), np.eye(3))


def test_wrap() -> None:
    np.testing.assert_allclose(
        [float(wrap(a)) for a in (0.0, 3.5, -3.5, 7.0)], [0.0, 3.5 - 2 * np.pi, 2 * np.pi - 3.5, 7 - 2 * np.pi]
    )


def test_rotation_is_that_of_roll_pitch_yaw() -> None:
    rpy = [0.3, -0.4, 2.0]
    np.testing.assert_allclose(
        rotation(casadi.DM(rpy)).full(), RollPitchYaw(rpy).ToRotationMatrix().matrix(), atol=1e-15
    )


def test_odometry_counts_the_motion_over_standing_feet() -> None:
    dps = make_dps(period=PERIOD)
    kinematics = LegKinematics()
    context = fixed(dps, foot_contact=[1, 0, 0, 1, 1, 0])
    simulator = Simulator(dps, context)
    for k in range(20):
        moved = MORPHOLOGY.stance + np.array([-0.005, 0.002, -0.001]) * k
        moved[[1, 2, 5]] += 0.02 * k  # feet in the air do not count
        dps.GetInputPort("joint_encoders").FixValue(context, kinematics.inverse(moved).ravel())
        simulator.AdvanceTo(k * PERIOD + 0.5 * PERIOD)
    # Two samples later (sense and env), the estimate belongs to sample 18; standing is known from sample 0 on.
    estimate = element(dps, simulator.get_context(), "env", "position")
    np.testing.assert_allclose(estimate, [0.005 * 18, -0.002 * 18, 0.20 + 0.001 * 18], atol=1e-9)


@pytest.mark.parametrize(("roll", "pitch"), [(0.02, 0.0), (0.0, -0.03)])
def test_posture_leans_against_the_tilt(roll: float, pitch: float) -> None:
    """The feet's plane turns so that the torso turns back: its lean grows at gain * tilt, up to its limit."""
    dps = make_dps(period=PERIOD)
    force = [-np.sin(pitch), np.cos(pitch) * np.sin(roll), np.cos(pitch) * np.cos(roll)]
    simulator = Simulator(dps, fixed(dps, imu=[0, 0, 0, *force]))
    simulator.AdvanceTo(1.0)
    lean = element(dps, simulator.get_context(), "impl.gait", "lean")
    np.testing.assert_allclose(lean, [roll * 1.0, pitch * 1.0], rtol=0.1, atol=1e-12)
    feet = LegKinematics().forward(dps.get_output_port().Eval(simulator.get_context()))
    # Feet on the plane z = 0 of the ground, seen from a torso that has turned by -lean.
    slope = np.linalg.lstsq(np.column_stack([feet[:, :2], np.ones(6)]), feet[:, 2], rcond=None)[0]
    np.testing.assert_allclose(slope[:2], [-lean[1], lean[0]], atol=2e-3)
    simulator.AdvanceTo(30.0)
    assert np.abs(element(dps, simulator.get_context(), "impl.gait", "lean")).max() == pytest.approx(0.15)


def test_commands_keep_joint_range_and_rate() -> None:
    dps = make_dps(period=PERIOD)
    context = fixed(dps, walk=[1.0])
    set_element(dps, context, "act", "rate", 0.5)
    upper = element(dps, context, "act", "upper")
    upper[2::3] = STANCE[2::3] + 0.05
    set_element(dps, context, "act", "upper", upper)
    simulator = Simulator(dps, context)
    last = STANCE
    reached = 0.0
    for k in range(200):
        simulator.AdvanceTo((k + 0.5) * PERIOD)
        q = dps.get_output_port().Eval(simulator.get_context())
        assert np.abs(q - last).max() <= 0.5 * PERIOD + 1e-12
        assert np.all(q <= upper + 1e-12)
        reached = max(reached, float((q[2::3] - STANCE[2::3]).max()))
        last = q
    assert reached == pytest.approx(0.05)


def test_start_phase_is_part_of_the_state() -> None:
    dps = make_dps(period=PERIOD)
    context = fixed(dps, walk=[1.0])
    set_element(dps, context, "impl.gait", "phase", 0.25)
    simulator = Simulator(dps, context)
    simulator.AdvanceTo(0.5)
    assert element(dps, simulator.get_context(), "impl.gait", "phase") == pytest.approx((0.25 + 25 * PERIOD / 2) % 1)
