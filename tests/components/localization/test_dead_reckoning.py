"""Dead reckoning and de-skewing against known motions."""

import numpy as np
import pytest
from pydrake.common.eigen_geometry import AngleAxis
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import TrajectorySource
from pydrake.trajectories import PiecewisePolynomial

from vtbdrake.common.scan import Scan
from vtbdrake.components.localization.dead_reckoning import (
    MOTION,
    POSE,
    DeadReckoning,
    DriftModel,
    carrier_pose_at,
    deskewed,
    history_size,
)
from vtbdrake.components.localization.planar import compose, inverse

T = 0.02
G = np.array([0.0, 0.0, -9.81])


class Drive:
    """A carrier that drives over bumps, at rest for the first seconds; what its sensors measure is exact.

    Only the point at x_B = axle does not move sideways.
    """

    def __init__(self, still=1.0, seconds=12.0, fine=20, axle=0.0):
        times = np.arange(0.0, seconds + T, T / fine)
        moving = np.maximum(times - still, 0.0)
        self.speed = 1.2 * np.minimum(moving / 2.0, 1.0)
        self.angles = np.array(
            [0.08 * np.sin(1.7 * moving), 0.1 * np.sin(1.1 * moving), 0.5 * moving**2 / (1.0 + moving)]
        ).T
        self.R_OB = [RotationMatrix(RollPitchYaw(*angles)) for angles in self.angles]
        # The third component of w in B.
        _, pitch_rate, yaw_rate = np.gradient(self.angles, T / fine, axis=0).T
        roll, pitch = self.angles[:, :2].T
        w_z = yaw_rate * np.cos(pitch) * np.cos(roll) - pitch_rate * np.sin(roll)
        v_B = np.array([self.speed, -axle * w_z, 0.0 * w_z]).T
        self.v_O = np.array([R.matrix() @ v for R, v in zip(self.R_OB, v_B, strict=True)])
        steps = (self.v_O[1:] + self.v_O[:-1]) / 2.0 * (T / fine)
        self.p_O = np.vstack([np.zeros(3), np.cumsum(steps, axis=0)])
        self.times, self.fine = times, fine

    def samples(self):
        """Return the samples of the sensors from 0 on: [w, f, v], as an `Imu` defines its means."""
        fine, shown = self.fine, []
        for k in range(0, len(self.times), fine):
            R = self.R_OB[k]
            if k == 0:
                shown.append([0.0, 0.0, 0.0, *(-(R.matrix().T @ G)), self.speed[0]])
                continue
            turn = AngleAxis((self.R_OB[k - fine].inverse() @ R).matrix())
            middle = self.R_OB[k - fine // 2].matrix()
            f = middle.T @ ((self.v_O[k] - self.v_O[k - fine]) / T - G)
            shown.append([*(turn.angle() * turn.axis() / T), *f, self.speed[k]])
        return np.array(shown)

    def pose(self, time):
        """The pose X_OB, in space, at a multiple of the fine step."""
        k = round(time / T * self.fine)
        return RigidTransform(self.R_OB[k], self.p_O[k])


def reckoned(samples, axle=0.0):
    """Return the system and its context after these samples, each received one period after it was taken."""
    builder = DiagramBuilder()
    system = builder.AddSystem(DeadReckoning(period=T, axle=axle))
    times = T * (np.arange(len(samples) + 1) - 0.5)
    for name, part in {"imu": slice(0, 6), "odometry": slice(6, 7)}.items():
        steps = PiecewisePolynomial.ZeroOrderHold(times, np.vstack([samples[0], samples])[:, part].T)
        source = builder.AddSystem(TrajectorySource(steps))
        builder.Connect(source.get_output_port(), system.GetInputPort(name))
    simulator = Simulator(builder.Build())
    simulator.AdvanceTo(T * (len(samples) - 0.5))
    return system, system.GetMyContextFromRoot(simulator.get_context())


def motion_of(samples, axle=0.0):
    system, context = reckoned(samples, axle)
    return system.GetOutputPort("motion").Eval(context)


def value(samples, name):
    system, context = reckoned(samples)
    element = next(one for one in system.variables if one.name == name)
    state = context.get_discrete_state(element.index).value()
    return state[element.start : element.start + int(np.prod(element.shape))]


def test_follows_a_drive_over_bumps():
    drive = Drive()
    time, roll, pitch, x, y, heading, speed, _ = motion_of(drive.samples()[:550])
    assert time == pytest.approx(548 * T)
    truth = drive.pose(time)
    np.testing.assert_allclose([roll, pitch], drive.angles[548 * 20, :2], atol=2e-5)
    assert heading == pytest.approx(drive.angles[548 * 20, 2], abs=3e-4)
    np.testing.assert_allclose([x, y], truth.translation()[:2], atol=2e-3)
    assert speed == pytest.approx(drive.speed[548 * 20])


def test_bumps_beside_a_distant_axle_are_no_tilt():
    """Pitching on a side slope turns B about z_B, but not the heading: the velocity of A follows w_z."""
    drive = Drive(axle=-0.8)
    _, roll, pitch, *_ = motion_of(drive.samples()[:550], axle=-0.8)
    np.testing.assert_allclose([roll, pitch], drive.angles[548 * 20, :2], atol=5e-4)


def test_body_ahead_of_its_axle_swings_out_in_bends():
    axle, v, rate, n = -0.9, 1.5, 0.4, 400
    # Bo is on a circle, too, and its acceleration points to the middle.
    inward = rate**2 * np.array([-axle, 0.0, 0.0]) * -1.0 + rate * v * np.array([0.0, 1.0, 0.0])
    samples = np.tile([0.0, 0.0, rate, *(inward - G), v], (n, 1))
    _, roll, pitch, x, y, heading, _, _ = motion_of(samples, axle)
    turned = rate * T * (n - 1)
    assert heading == pytest.approx(turned, abs=1e-9)
    np.testing.assert_allclose([roll, pitch], 0.0, atol=1e-9)
    at_axle = v / rate * np.array([np.sin(turned), 1.0 - np.cos(turned)])
    start = np.array([axle, 0.0])  # Of A in O, whose origin is where Bo was.
    expected = start + at_axle - axle * np.array([np.cos(turned), np.sin(turned)])
    np.testing.assert_allclose([x, y], expected, atol=1e-4)
    assert np.hypot(*([x, y] - at_axle)) > 1.0


def test_history_holds_the_poses_of_the_last_second():
    drive = Drive()
    system, context = reckoned(drive.samples()[:550])
    history = system.GetOutputPort("history").Eval(context)
    assert history.shape == (history_size(T),) == (50 * POSE,)
    for time in (548 * T, 530.5 * T, 500 * T):
        _, roll, pitch, x, y, heading = carrier_pose_at(history, time)
        np.testing.assert_allclose([x, y], drive.pose(time).translation()[:2], atol=2e-3)
        np.testing.assert_allclose([roll, pitch, heading], drive.angles[round(time / T * 20)], atol=4e-4)


def test_starts_on_a_slope_level():
    tilted = RotationMatrix(RollPitchYaw(0.1, -0.2, 0.0))
    sample = np.array([0.0, 0.0, 0.0, *(-(tilted.matrix().T @ G)), 0.0])
    motion = motion_of(np.tile(sample, (4, 1)))
    np.testing.assert_allclose(motion[1:3], [0.1, -0.2], atol=1e-12)
    np.testing.assert_allclose(motion[3:], 0.0, atol=1e-12)


def test_gravity_need_not_be_known():
    samples = Drive().samples()[:300]
    on_mars = samples.copy()
    resting = np.array([RotationMatrix(R).matrix().T @ G for R in Drive().R_OB[10 : 300 * 20 : 20]])[: len(samples)]
    on_mars[:, 3:6] += 0.62 * resting
    np.testing.assert_allclose(motion_of(on_mars), motion_of(samples), atol=2e-3)


def test_bias_of_gyros_is_learned_at_rest():
    drive, bias = Drive(still=4.0), np.array([0.003, -0.002, 0.006])
    samples = drive.samples()
    rng = np.random.default_rng(3)
    samples[:, :3] += bias + 1e-3 * rng.normal(size=(len(samples), 3))
    # From about 170 samples, with four deviations.
    np.testing.assert_allclose(value(samples[:200], "gyro_bias"), bias, atol=4e-3 / np.sqrt(170))
    heading = drive.angles[548 * 20, 2]
    with_rest = motion_of(samples[:550])[5] - heading
    without = motion_of(samples[180:550])[5] - heading
    assert abs(with_rest) < 4e-3 < 0.03 < abs(without)


@pytest.mark.slow_cases
@pytest.mark.parametrize("seed", range(4))
def test_noisy_wheels_and_rocking_at_rest_are_no_bias(seed):
    drive, bias = Drive(still=3.0), np.array([0.001, -0.001, 0.002])
    samples = drive.samples()[:150]
    rng = np.random.default_rng(seed)
    rocking = np.outer(
        np.exp(-T * np.arange(150) / 0.8) * np.cos(2.0 * np.pi * 1.5 * T * np.arange(150)), [1.0, 0.7, 0.0]
    )
    samples[:, :3] += bias + 0.015 * rocking + 2e-3 * rng.normal(size=(150, 3))
    samples[:, 6] += 0.02 * rng.normal(size=150)
    # The mean of about 120 samples; a single sample of a carrier that rocks has an error of 8e-3.
    np.testing.assert_allclose(value(samples, "gyro_bias"), bias, atol=1e-3)


def test_bias_across_the_vertical_is_learned_on_the_way():
    drive, bias = Drive(still=0.0), np.array([0.004, -0.003, 0.0])
    samples = drive.samples()
    samples[:, :3] += bias
    np.testing.assert_allclose(value(samples[:550], "gyro_bias")[:2], bias[:2], atol=3e-4)
    _, roll, pitch, *_ = motion_of(samples[:550])
    # Without the estimate, a bias of 3 mrad/s for some five seconds tilts the vertical by 15 mrad.
    np.testing.assert_allclose([roll, pitch], drive.angles[548 * 20, :2], atol=2e-3)


def test_turning_on_the_spot_is_no_bias():
    samples = np.tile([0.0, 0.0, 0.0, 0.0, 0.0, 9.81, 0.0], (751, 1))
    samples[251:, 2] = 0.1  # rad/s about the vertical, from 5 to 15 s
    assert motion_of(samples)[5] == pytest.approx(1.0, abs=5e-3)


def test_settling_on_the_springs_is_no_bias():
    """A roll of 20 mrad fades at 6 mrad/s while the carrier stands still."""
    times = T * np.arange(100)
    angles = 0.02 * np.exp(-times / 2.0)
    samples = np.array([[0.0, 0.0, 0.0, *(RotationMatrix.MakeXRotation(-a).matrix() @ -G), 0.0] for a in angles])
    samples[1:, 0] = np.diff(angles) / T
    assert np.abs(value(samples, "gyro_bias")).max() < 1e-3


@pytest.mark.parametrize(("resting", "bounds"), [(2e-3, (0.0, 1e-3)), (8e-3, (0.0, 2e-3)), (0.02, (5e-3, 0.02))])
def test_failed_wheel_sensor_is_no_standstill(resting, bounds):
    """The carrier rests for 2 s and turns slowly for 20 s, while the wheels show no speed: only the shaking shows this.

    With accelerometers that are as noisy at rest, the estimated bias is wrong.
    """
    rng, n = np.random.default_rng(4), 1100
    samples = np.tile([0.0, 0.0, 0.0, *-G, 0.0], (n, 1))
    samples[100:, 2] = 0.015
    samples[:, :3] += 1e-3 * rng.normal(size=(n, 3))
    samples[:, 3:6] += np.where(np.arange(n) < 100, resting, 0.02)[:, None] * rng.normal(size=(n, 3))
    bias = value(samples, "gyro_bias")[2]
    assert bounds[0] <= abs(bias) < bounds[1]


def test_impossible_samples_are_left_out():
    samples = Drive().samples()[:300]
    broken = samples.copy()
    broken[200:204, 2], broken[204, 4], broken[220, 6] = np.nan, 1e300, np.inf
    np.testing.assert_allclose(motion_of(broken), motion_of(samples), atol=0.02)
    assert value(broken, "ignored") == 6.0


def test_periods_must_be_positive():
    with pytest.raises(ValueError, match="period is positive, in s, not 0"):
        DeadReckoning(period=0.0)


def test_points_of_a_moving_scanner_are_corrected():
    drive = Drive()
    system, context = reckoned(drive.samples()[:550])
    history = system.GetOutputPort("history").Eval(context)
    X_BL = RigidTransform(RollPitchYaw(0.02, -0.1, 0.3), [0.4, 0.1, 2.0])
    end, fine = 545 * T, T / 20
    rng = np.random.default_rng(5)
    fired = end - fine * np.arange(199, -1, -1)
    p_OQ = drive.pose(end) @ rng.uniform([-15, -15, -1], [15, 15, 4], (200, 3)).T
    # From the height at which the carrier is at the end: rising is not corrected.
    height = drive.pose(end).translation()[2]
    poses = [drive.pose(time) for time in fired]
    level = [RigidTransform(X.rotation(), [*X.translation()[:2], height]) @ X_BL for X in poses]
    p_LQ = np.array([X.inverse() @ p for X, p in zip(level, p_OQ.T, strict=True)])
    ranges = np.linalg.norm(p_LQ, axis=1)
    scan = Scan(p_LQ / ranges[:, None], ranges, fired - end, 99.0)
    R_OH = RotationMatrix.MakeZRotation(drive.angles[545 * 20, 2])
    expected = R_OH.inverse() @ (p_OQ - drive.pose(end).translation()[:, None])
    np.testing.assert_allclose(deskewed(scan, history, X_BL, time=end), expected.T, atol=5e-3)
    skewed = Scan(scan.directions_L, ranges, np.zeros(200), 99.0)
    assert np.abs(deskewed(skewed, history, X_BL, time=end) - expected.T).max() > 0.2


def test_scans_outside_of_the_history_use_its_ends():
    history = np.array([[1.0, 0.1, 0.0, 2.0, 3.0, 0.5], [0.98, 0.0, 0.0, 1.0, 3.0, 0.5]]).ravel()
    scan = Scan([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], [4.0, 5.0], [-9.0, 0.0], 0.0)
    points = deskewed(scan, history, RigidTransform(), time=1.5)
    # One period before, the carrier was a metre further back, and level.
    expected = [[4.0 - np.cos(0.5), np.sin(0.5), 0.0], [0.0, 5.0 * np.cos(0.1), 5.0 * np.sin(0.1)]]
    np.testing.assert_allclose(points, expected, atol=1e-12)
    # All of it after the newest pose: as from there.
    late = Scan([[1.0, 0.0, 0.0]], [4.0], [0.0], 0.0)
    np.testing.assert_allclose(deskewed(late, history, RigidTransform(), time=9.0), [[4.0, 0.0, 0.0]], atol=1e-12)
    assert deskewed(Scan.empty(), history, RigidTransform(), time=1.0).shape == (0, 3)


def test_long_periods_leave_enough_poses_to_correct_scans():
    scan = Scan([[1.0, 0.0, 0.0]], [4.0], [-1.5], 0.0)
    history = np.zeros(history_size(3.0))
    history[[0, POSE]] = 3.0, 0.0
    history[3] = 2.0
    assert DeadReckoning(period=3.0).GetOutputPort("history").size() == len(history) == 2 * POSE
    # Half way between both poses, the carrier was a metre further back.
    np.testing.assert_allclose(deskewed(scan, history, RigidTransform(), time=3.0), [[3.0, 0.0, 0.0]], atol=1e-12)
    with pytest.raises(ValueError, match="at least 2 poses, not 1"):
        deskewed(scan, history[:POSE], RigidTransform(), time=3.0)


def test_drift_grows_as_a_random_walk_does():
    drift, steps, length, turn, T_step = DriftModel(0.05, 0.03, 0.01, 0.04), 40, 0.25, 0.02, 0.1
    rng = np.random.default_rng(7)
    mean, poses = np.zeros(3), np.zeros((20_000, 3))
    for _ in range(steps):
        mean = compose(mean, [length, 0.0, turn])
        along = length + drift.along * np.sqrt(length) * rng.normal(size=len(poses))
        across = drift.across * np.sqrt(length) * rng.normal(size=len(poses))
        c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
        poses[:, 0] += c * along - s * across
        poses[:, 1] += s * along + c * across
        heading = np.sqrt(drift.heading**2 * T_step + drift.turn**2 * turn)
        poses[:, 2] += turn + heading * rng.normal(size=len(poses))
    sampled = np.cov(poses.T)
    expected = drift.covariance(mean, steps * T_step)
    # An arc of 0.8 rad, whose chord the model takes.
    np.testing.assert_allclose(np.sqrt(np.diag(expected)), np.sqrt(np.diag(sampled)), rtol=0.12)
    normalized = np.linalg.solve(expected, sampled)
    assert np.linalg.eigvals(normalized).real == pytest.approx(1.0, abs=0.3)
    np.testing.assert_allclose(compose(inverse(mean), mean), 0.0, atol=1e-12)


@pytest.mark.parametrize("name", ["along", "across", "heading", "turn"])
def test_drift_is_finite_and_not_negative(name):
    for bad in (-1.0, np.inf, np.nan):
        with pytest.raises(ValueError, match=f"DriftModel.{name} must be a finite number of at least 0 "):
            DriftModel(**{name: bad})


def test_motion_has_the_declared_size():
    assert DeadReckoning(period=T).GetOutputPort("motion").size() == MOTION.size
