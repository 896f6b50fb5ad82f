"""Dead reckoning by speed and steering angle, and its drift."""

from math import atan, pi

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import VectorLogSink
from scipy.stats import chi2

from tests.components.localization.drives import PERIOD, drive
from vtbdrake.components.localization.dead_reckoning import POSE, DriftModel, SteeringDriftModel
from vtbdrake.components.localization.landmarks import Landmarks
from vtbdrake.components.localization.planar import chord, compose, inverse
from vtbdrake.components.localization.steering import SteeringConfig, SteeringReckoning
from vtbdrake.components.localization.track_state import RATE, TURN
from vtbdrake.components.localization.tracking import Tracker
from vtbdrake_diagrams.forest.world.stand import ACCURATE

pytestmark = pytest.mark.one_python

T = 0.025


def reckoned(samples, config=None):
    """Return the port ``motion`` after each period in which a sample [speed, angle] was there."""
    builder = DiagramBuilder()
    reckoning = builder.AddNamedSystem("reckoning", SteeringReckoning(period=T, config=config))
    sink = builder.AddNamedSystem("sink", VectorLogSink(8, T))
    builder.Connect(reckoning.GetOutputPort("motion"), sink.get_input_port())
    builder.ExportInput(reckoning.GetInputPort("odometry"), "odometry")
    diagram = builder.Build()
    simulator = Simulator(diagram)
    port = diagram.GetInputPort("odometry")
    for k, sample in enumerate(samples):
        port.FixValue(simulator.get_mutable_context(), sample)
        simulator.AdvanceTo((k + 1) * T - 1e-6)
    root = simulator.get_context()
    own = reckoning.GetMyContextFromRoot(root)
    return reckoning.GetOutputPort("motion").Eval(own), reckoning.GetOutputPort("history").Eval(own)


def test_constant_steering_drives_a_circle():
    """After a quarter of a circle of radius r, the axle is at (r, r); its left wheel has driven r - d on it."""
    radius, base, offset, steps = 10.0, 2.8, 0.7, 400
    speed = 0.5 * pi * radius / (steps * T)
    config = SteeringConfig(wheel_base=base, wheel_offset=offset)
    sample = [speed * (radius - offset) / radius, atan(base / radius)]
    motion, history = reckoned([sample] * (steps + 1), config)
    time, roll, pitch, x, y, heading, v, rate = motion
    np.testing.assert_allclose([x, y, heading], [radius, radius, 0.5 * pi], atol=1e-5)  # On chords.
    np.testing.assert_allclose([v, rate], [speed, speed / radius], rtol=1e-12)
    assert time == pytest.approx((steps - 1) * T) and roll == pitch == 0.0
    np.testing.assert_array_equal(history[:POSE], motion[:POSE])
    earlier = history.reshape(-1, POSE)[20]
    assert np.hypot(earlier[3], earlier[4] - radius) == pytest.approx(radius, abs=1e-5)


def test_calibration_corrects_what_the_sensors_measure():
    exact, _ = reckoned([[2.0, 0.1]] * 100, SteeringConfig())
    config = SteeringConfig(speed_scale=1.25, steering_scale=0.5, steering_offset=0.04)
    corrected, _ = reckoned([[2.0 / 1.25, (0.1 - 0.04) / 0.5]] * 100, config)
    np.testing.assert_allclose(corrected, exact, rtol=1e-12)


@pytest.mark.parametrize("fault", [[np.nan, 0.1], [2.0, np.inf], [1e4, 0.1], [2.0, 1.57]])
def test_faulty_samples_keep_speed_and_turn_rate(fault):
    good = [2.0, 0.1]
    motion, _ = reckoned([good] * 50 + [fault] * 20 + [good] * 30)
    expected, _ = reckoned([good] * 100)
    np.testing.assert_allclose(motion, expected, rtol=1e-12)


def test_drift_grows_with_the_distance_alone():
    model = SteeringDriftModel(along=0.0, across=0.0, heading=0.01, turn=0.0)
    assert not model.covariance([0.0, 0.0, 0.0], duration=100.0).any()
    slow, quick = (model.covariance([5.0, 0.0, 0.0], duration=duration) for duration in (1.0, 60.0))
    np.testing.assert_array_equal(slow, quick)
    # A random walk of the heading along 5 m, integrated.
    rng, n = np.random.default_rng(0), 200
    headings = np.cumsum(0.01 * np.sqrt(5.0 / n) * rng.normal(size=(20_000, n)), axis=1)
    samples = np.column_stack([headings.mean(axis=1) * 5.0, headings[:, -1]])
    np.testing.assert_allclose(slow[1:, 1:], np.cov(samples.T), rtol=0.05)
    assert DriftModel().extent([-3.0, 0.0, 0.0], 2.0) == 2.0
    assert model.extent([-3.0, 4.0, 0.0], 2.0) == -5.0


def test_tracker_learns_an_error_of_the_curvature():
    one, error = drive(3, ACCURATE, reach=18.0), 0.004
    tracker = Tracker(one.map, rate_deviation=0.004, rate_walk=1e-4)
    model = SteeringDriftModel()
    state, _ = tracker.start(one.poses[0], np.diag([0.1, 0.1, 0.01]) ** 2, one.scans[0])
    for k in range(1, len(one.scans)):
        motion = compose(inverse(one.reckoned[k - 1]), one.reckoned[k])
        extent = model.extent(motion, PERIOD)
        motion[2] += error * extent
        state = tracker.predict(state, motion, model.covariance(motion, PERIOD), extent=extent)
        state, _ = tracker.update(state, one.scans[k])
    deviation = float(np.sqrt(state.covariance[RATE, RATE]))
    assert abs(state.mean[RATE] - error) < 3.0 * deviation and deviation < 0.5 * error


ONE_LANDMARK = Landmarks(np.array([[500.0, 0.0]]), np.zeros((1, 2, 2)), np.array([0.3]), np.zeros(1))


def squares_after_a_curve(scale_error, turn_deviation, drives=200):
    """Return the sums of the normalized squared errors of heading and pose after curves without landmarks.

    In each drive, the steering errs by another scale, with this standard deviation, and dead reckoning drifts.
    """
    rng, model = np.random.default_rng(0), SteeringDriftModel()
    tracker = Tracker(
        ONE_LANDMARK, turn_deviation=turn_deviation, odometry_deviation=0.0, rate_deviation=0.0, rate_walk=0.0
    )
    squares = np.zeros(2)
    for _ in range(drives):
        share, true = scale_error * rng.normal(), np.zeros(3)
        state, _ = tracker.start(true, 1e-12 * np.eye(3))
        for turn in [0.08] * 20 + [0.0] * 20:  # A curve of 1.6 rad in 10 m, and straight on.
            motion = chord(0.5, turn)
            C = model.covariance(motion, 0.2)
            true = compose(true, chord(0.5, (1.0 - share) * turn) + rng.multivariate_normal(np.zeros(3), C))
            state = tracker.predict(state, motion, C, extent=0.5)
            memory = np.exp(-0.5 / tracker.odometry_length)
            share = memory * share + np.sqrt(1.0 - memory**2) * scale_error * rng.normal()
        error = compose(inverse(true), state.pose)
        error[:2] = state.pose[:2] - true[:2]
        P = state.pose_covariance
        squares += error[2] ** 2 / P[2, 2], error @ np.linalg.solve(P, error)
    return squares


def test_heading_is_as_certain_as_claimed_after_curves_with_a_wrong_scale():
    heading, pose = squares_after_a_curve(0.05, 0.05)
    assert chi2(200).ppf(0.001) < heading < chi2(200).ppf(0.999)
    assert chi2(600).ppf(0.001) < pose < chi2(600).ppf(0.999)


def test_heading_is_too_certain_if_the_tracker_takes_the_scale_as_exact():
    heading, _ = squares_after_a_curve(0.05, 0.0)
    assert heading > 3.0 * chi2(200).ppf(0.999)


def test_tracker_learns_an_error_of_the_scale_of_turns():
    one, error = drive(3, ACCURATE, scans=60, reach=18.0), 0.1
    tracker = Tracker(one.map, rate_deviation=1e-4, rate_walk=0.0, turn_deviation=0.1, odometry_length=np.inf)
    model = SteeringDriftModel(heading=1e-3, turn=5e-3)
    state, _ = tracker.start(one.poses[0], np.diag([0.1, 0.1, 0.01]) ** 2, one.scans[0])
    for k in range(1, len(one.scans)):
        motion = compose(inverse(one.reckoned[k - 1]), one.reckoned[k])
        motion[2] /= 1.0 - error
        state = tracker.predict(state, motion, model.covariance(motion, PERIOD), extent=model.extent(motion, PERIOD))
        state, _ = tracker.update(state, one.scans[k])
    deviation = float(np.sqrt(state.covariance[TURN, TURN]))
    assert abs(state.mean[TURN] - error) < 3.0 * deviation < 0.9 * error


def test_error_of_the_scale_is_forgotten_on_the_way():
    tracker = Tracker(ONE_LANDMARK, turn_deviation=0.1)
    state, _ = tracker.start(np.zeros(3), 1e-4 * np.eye(3))
    mean, P = state.mean.copy(), state.covariance.copy()
    mean[TURN], P[TURN, TURN] = 0.2, 0.0
    state = tracker.predict(state.with_arrays(mean=mean, covariance=P), [20.0, 0.0, 0.0], np.zeros((3, 3)), extent=20.0)
    assert state.mean[TURN] == pytest.approx(0.2 / np.e)
    assert state.covariance[TURN, TURN] == pytest.approx(0.1**2 * (1.0 - np.exp(-2.0)))
    assert len(Tracker(ONE_LANDMARK).start(np.zeros(3), np.eye(3))[0].mean) == TURN  # An exact scale needs no place.
