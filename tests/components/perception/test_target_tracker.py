"""The filter of a tumbling body, against bodies whose motion is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, DiagramBuilder
from scipy.integrate import solve_ivp
from scipy.stats import chi2

from vtbdrake.components.perception.estimate import PoseEstimate, cross_matrix, rotation_matrix, rotation_vector
from vtbdrake.components.perception.target_tracker import (
    SPHERE,
    MotionModel,
    TargetTracker,
    Track,
    body_state,
    pose_of_state,
)
from vtbdrake.state import AddressedSystem
from vtbdrake.state.systems import pose_from_array

COVARIANCE = np.diag([0.01, 0.01, 0.02, 0.01, 0.01, 0.03]) ** 2
COVARIANCE[0, 4] = COVARIANCE[4, 0] = 5e-5


def moved(X: RigidTransform, w: np.ndarray, v: np.ndarray, dt: float) -> RigidTransform:
    return RigidTransform(RotationMatrix(rotation_matrix(w * dt)) @ X.rotation(), X.translation() + v * dt)


def measured(X: RigidTransform, time: float, generator: np.random.Generator, *, scale: float = 1.0) -> PoseEstimate:
    """Return X with an error of the covariance."""
    error = scale * np.linalg.cholesky(COVARIANCE) @ generator.standard_normal(6)
    R = RotationMatrix(rotation_matrix(-error[:3])) @ X.rotation()
    return PoseEstimate.of(RigidTransform(R, X.translation() - error[3:]), scale**2 * COVARIANCE, time=time)


def distance(track: Track, X: RigidTransform, w: np.ndarray, v: np.ndarray) -> float:
    """Return the normalized estimation error squared, with 12 degrees of freedom."""
    R = X.rotation().matrix()
    e = np.concatenate([rotation_vector(R @ track.R.T), X.translation() - track.p, w - track.w, v - track.v])
    return float(e @ np.linalg.solve(track.P, e))


def run(seed: int, *, late: bool) -> float:
    """Track a body whose velocities do a random walk over 4 s; return the distance at the end."""
    generator, model = np.random.default_rng(seed), MotionModel(rate_noise=5e-3, velocity_noise=5e-3)
    X = RigidTransform(RollPitchYaw(generator.uniform(-2, 2, 3) / [1, 2, 1]), generator.uniform(-2, 2, 3))
    w, v = 0.1 * generator.standard_normal(3), 0.1 * generator.standard_normal(3)
    estimates, dt = [], 0.01
    for k in range(401):
        if k % 20 == 0:
            estimates.append(measured(X, k * dt, generator))
        w_now, v_now = w, v
        if k < 400:
            X = moved(X, w, v, dt)
            w = w_now + model.rate_noise * np.sqrt(dt) * generator.standard_normal(3)
            v = v_now + model.velocity_noise * np.sqrt(dt) * generator.standard_normal(3)
    if late:  # Every other one comes after its successor.
        estimates[1:] = [estimates[k] for pair in zip(range(2, 21, 2), range(1, 21, 2), strict=True) for k in pair]
    track = model.begin(estimates[0])
    for estimate in estimates[1:]:
        track, _ = model.fuse(track, estimate)
    return distance(model.predict(track, 4.0), X, w, v)


@pytest.mark.slow_cases
@pytest.mark.parametrize("late", [True, False])
def test_errors_agree_with_the_covariance_over_many_runs(late: bool) -> None:
    runs = 60
    mean = np.mean([run(seed, late=late) for seed in range(runs)])
    low, high = chi2.ppf([0.025, 0.975], 12 * runs) / runs
    assert low < mean < high


INERTIAS = {
    "long": [1.0, 0.6, 0.4, 0.0, 0.0, 0.0],
    "flat": [1.6, 1.0, 0.7, 0.0, 0.0, 0.0],
    "skew": [1, 0.8, 0.5, 0.1, -0.1, 0.05],
}


def free_flight(
    inertia: list[float], X: RigidTransform, w: np.ndarray, times: np.ndarray
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return R and the angular velocity in the world of a body in free flight, from Euler's equations in the body."""
    xx, yy, zz, xy, xz, yz = inertia
    J = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])

    def rate(_: float, x: np.ndarray) -> np.ndarray:
        R, own = x[:9].reshape(3, 3), x[9:]
        return np.concatenate([(R @ cross_matrix(own)).ravel(), np.linalg.solve(J, -np.cross(own, J @ own))])

    R = X.rotation().matrix()
    begin = np.concatenate([R.ravel(), R.T @ w])
    solution = solve_ivp(rate, (times[0], times[-1]), begin, t_eval=times, rtol=1e-9, atol=1e-11)
    return [(x[:9].reshape(3, 3), x[:9].reshape(3, 3) @ x[9:]) for x in solution.y.T]


def consistency(model: MotionModel, inertia: list[float], *, rate_deg: float, seeds: int, late: bool = False) -> float:
    """Return the mean distance after 10 s of poses, measured twice a second, of bodies that turn about any axis."""
    times, distances = np.arange(21) * 0.5, []
    for seed in range(seeds):
        generator = np.random.default_rng(seed)
        w, v = generator.standard_normal(3), 0.05 * generator.standard_normal(3)
        w *= np.radians(rate_deg) / np.linalg.norm(w)
        X = RigidTransform(RollPitchYaw(generator.uniform(-2, 2, 3) / [1, 2, 1]), [2.0, 0.0, 0.0])
        flight = free_flight(inertia, X, w, times)
        poses = [
            RigidTransform(RotationMatrix.ProjectToRotationMatrix(R), X.translation() + v * t)
            for (R, _), t in zip(flight, times, strict=True)
        ]
        order = (
            [0, *(k for pair in zip(range(2, 21, 2), range(1, 21, 2), strict=True) for k in pair)]
            if late
            else range(21)
        )
        estimates = [measured(poses[k], times[k], generator) for k in order]
        track = model.begin(estimates[0])
        for estimate in estimates[1:]:
            track, _ = model.fuse(track, estimate)
        distances.append(distance(track, poses[-1], flight[-1][1], v))
    return float(np.mean(distances))


def bounds(seeds: int) -> tuple[float, float]:
    """Return the 99 % interval of the mean distance over runs whose covariance is right."""
    low, high = chi2.ppf([0.005, 0.995], 12 * seeds) / seeds
    return float(low), float(high)


@pytest.mark.slow_cases
@pytest.mark.parametrize("rate_deg", [3.0, 10.0])
@pytest.mark.parametrize("body", INERTIAS)
def test_errors_agree_with_the_covariance_of_a_body_of_known_inertia(body: str, rate_deg: float) -> None:
    seeds, inertia = 40, INERTIAS[body]
    low, high = bounds(seeds)
    quiet = MotionModel(rate_noise=1e-5, velocity_noise=1e-5, inertia=inertia)
    assert low < consistency(quiet, inertia, rate_deg=rate_deg, seeds=seeds) < high
    # Noise that the motion does not have makes the covariance too large, never too small.
    assert consistency(MotionModel(inertia=inertia), inertia, rate_deg=rate_deg, seeds=10) < bounds(10)[1]


@pytest.mark.slow
def test_late_estimates_of_an_asymmetric_body_agree_with_the_covariance() -> None:
    seeds, inertia = 40, INERTIAS["skew"]
    low, high = bounds(seeds)
    quiet = MotionModel(rate_noise=1e-5, velocity_noise=1e-5, inertia=inertia)
    assert low < consistency(quiet, inertia, rate_deg=10.0, seeds=seeds, late=True) < high


@pytest.mark.slow_cases
@pytest.mark.parametrize("rate_deg", [3.0, 10.0])
def test_rate_noise_of_the_docstring_covers_a_body_of_unknown_inertia(rate_deg: float) -> None:
    inertia, high = INERTIAS["long"], bounds(20)[1]
    noise = (1.0 - 0.4) / 0.6 * np.radians(rate_deg) ** 2 * np.sqrt(0.5)
    covering = MotionModel(rate_noise=noise, velocity_noise=1e-5)
    assert consistency(covering, inertia, rate_deg=rate_deg, seeds=20) < high
    # A hundredth of it does not.
    assert consistency(replace(covering, rate_noise=0.01 * noise), inertia, rate_deg=rate_deg, seeds=20) > high


def test_track_moves_as_the_body_does() -> None:
    X, w = RigidTransform(RollPitchYaw(0.3, -0.5, 0.8), [1.0, 2.0, 3.0]), np.radians([6.0, -7.0, 4.0])
    model = MotionModel(inertia=INERTIAS["skew"])
    track = replace(model.begin(measured(X, 0.0, np.random.default_rng(0))), R=X.rotation().matrix(), w=w)
    _, (R, rate) = free_flight(INERTIAS["skew"], X, w, np.array([0.0, 3.0]))
    later = model.predict(track, 3.0)
    np.testing.assert_allclose(later.R, R, atol=2e-4)
    np.testing.assert_allclose(later.w, rate, atol=2e-5)
    back = model.present(later.numbers(), 0.0)
    np.testing.assert_allclose(pose_of_state(back).rotation().matrix(), track.R, atol=2e-4)


def test_impossible_inertia_is_refused() -> None:
    with pytest.raises(ValueError, match=r"inertia must be \[Ixx, .*not \[1.0, 1.0, 3.0"):
        TargetTracker(["scan"], starting=["scan"], period=0.02, motion=MotionModel(inertia=[1.0, 1.0, 3.0, 0, 0, 0]))


def test_late_estimate_counts_as_if_it_had_been_in_time() -> None:
    generator, model = np.random.default_rng(0), MotionModel(rate_noise=0.0, velocity_noise=0.0)
    w, v = np.array([0.02, -0.05, 0.03]), np.array([0.01, 0.02, -0.03])
    poses = {t: moved(RigidTransform([1.0, 2.0, 3.0]), w, v, t) for t in (0.0, 0.3, 0.5, 0.8)}
    first, *others = (measured(X, t, generator, scale=1e-2) for t, X in poses.items())
    tracks = []
    for order in ((0, 1, 2), (2, 0, 1)):
        track = model.begin(first)
        for k in order:
            track, _ = model.fuse(track, others[k])
        tracks.append(track)
    one, other = tracks
    assert one.time == other.time == 0.8
    np.testing.assert_allclose(other.P, one.P, rtol=2e-2, atol=1e-9)
    assert np.concatenate([other.w, other.v]) == pytest.approx(np.concatenate([one.w, one.v]), abs=2e-5)


@pytest.mark.parametrize("inertia", [list(SPHERE), *INERTIAS.values()])
def test_deviations_are_those_of_the_predicted_covariance(inertia: list[float]) -> None:
    generator, model = np.random.default_rng(0), MotionModel(inertia=inertia)
    track = model.begin(measured(truth(0.0), 0.0, generator))
    for k in range(1, 6):
        track, _ = model.fuse(track, measured(truth(0.2 * k), 0.2 * k, generator))
    variances = model.predict(track, 2.0).P.diagonal().reshape(4, 3).mean(axis=1)
    assert model.present(track.numbers(), 2.0)[19:] == pytest.approx(np.sqrt(variances[:2]), rel=0.02)


@pytest.mark.parametrize(
    "turn",
    [RollPitchYaw(0.3, -0.5, 2.8), *(RollPitchYaw(0.3, pitch, 0.8) for pitch in (np.pi / 2, 1.5707, -np.pi / 2))],
)
def test_present_is_as_drake_has_it(turn: RollPitchYaw) -> None:
    model, v = MotionModel(), np.array([0.1, -0.2, 0.3])
    track = replace(model.begin(measured(RigidTransform([1.0, 2.0, 3.0]), 1.0, np.random.default_rng(0))), v=v)
    track = replace(track, R=RotationMatrix(turn).matrix())
    present, X = model.present(track.numbers(), 3.0), RigidTransform(turn, track.p + 2.0 * v)
    np.testing.assert_allclose(present[:13], body_state(X, np.zeros(3), v), atol=1e-12)
    # With a pitch of a right angle, roll and yaw are not unique.
    np.testing.assert_allclose(pose_from_array(present[13:19]).GetAsMatrix4(), X.GetAsMatrix4(), atol=1e-12)


def test_error_is_carried_as_two_neighbouring_flights_part() -> None:
    model = MotionModel(rate_noise=0.0, velocity_noise=0.0, inertia=INERTIAS["skew"])
    start = model.begin(
        measured(RigidTransform(RollPitchYaw(0.3, -0.5, 0.8), [1.0, 2.0, 3.0]), 0.0, np.random.default_rng(0))
    )
    start = replace(start, w=np.array([0.1, -0.2, 0.15]), v=np.array([0.1, 0.0, -0.1]))

    def landed(error: np.ndarray) -> Track:
        R = rotation_matrix(error[:3]) @ start.R
        parts = replace(start, R=R, p=start.p + error[3:6], w=start.w + error[6:9], v=start.v + error[9:])
        return model.predict(parts, 1.0)

    def parting(error: np.ndarray) -> np.ndarray:
        a, b = landed(error), landed(-error)
        return np.concatenate([rotation_vector(a.R @ b.R.T), a.p - b.p, a.w - b.w, a.v - b.v]) / 2e-5

    F = np.column_stack([parting(error) for error in 1e-5 * np.eye(12)])
    np.testing.assert_allclose(model.predict(start, 1.0).P, F @ start.P @ F.T, atol=2e-5)


class Source(AddressedSystem):
    """Poses of a body that turns about z, measured every 0.2 s and told 0.15 s later; none after ``until``."""

    def __init__(
        self, *, until: float = np.inf, offset: float = 0.0, flipped: float = np.inf, ahead: float = np.inf
    ) -> None:
        super().__init__()
        self._until, self._offset, self._flipped, self._ahead = until, offset, flipped, ahead
        self.DeclareAbstractOutputPort("estimate", lambda: Value(PoseEstimate.missing()), self._calc)

    def _calc(self, context: Context, output: Value) -> None:
        time = 0.2 * np.floor((context.get_time() - 0.15 - self._offset) / 0.2 + 1e-9) + self._offset
        X = truth(time)
        if time >= self._flipped:
            X = RigidTransform(X.rotation() @ RotationMatrix.MakeXRotation(2.0), X.translation())
        if 0.0 <= time - self._ahead < 0.1:  # The clock of one estimate is wrong.
            time += 1e3
        told = PoseEstimate.of(X, COVARIANCE, time=time) if 0.0 <= time < self._until else PoseEstimate.missing()
        output.set_value(told)


def truth(time: float) -> RigidTransform:
    return moved(RigidTransform([2.0, 0.0, 0.0]), np.array([0.0, 0.0, 0.05]), np.array([0.02, 0.0, 0.0]), time)


def angle_between(X: RigidTransform, Y: RigidTransform) -> float:
    return float(np.linalg.norm(rotation_vector((X.rotation().inverse() @ Y.rotation()).matrix())))


def tracking(**sources: Source) -> tuple[Simulator, TargetTracker, Context]:
    """Return the simulation of a tracker that can begin with its first source only."""
    builder = DiagramBuilder()
    tracker = builder.AddSystem(TargetTracker(list(sources), starting=[next(iter(sources))], period=0.02))
    for name, source in sources.items():
        builder.Connect(builder.AddSystem(source).get_output_port(), tracker.GetInputPort(name))
    simulator = Simulator(builder.Build())
    return simulator, tracker, tracker.GetMyContextFromRoot(simulator.get_context())


def test_state_is_the_target_at_the_present() -> None:
    simulator, tracker, context = tracking(markers=Source(), scan=Source(offset=0.07))
    simulator.AdvanceTo(4.01)
    state = tracker.GetOutputPort("state").Eval(context)
    X_IT = truth(4.0)
    assert pose_of_state(state).translation() == pytest.approx(X_IT.translation(), abs=1e-3)
    assert angle_between(pose_of_state(state), X_IT) < 1e-3
    assert state[7:] == pytest.approx([0.0, 0.0, 0.05, 0.02, 0.0, 0.0], abs=2e-3)
    valid, age, attitude, position = tracker.GetOutputPort("status").Eval(context)
    assert valid == 1.0
    assert age == pytest.approx(0.2)  # At 4.0 s, the pose of 3.8 s is the last one that was told.
    assert 0.0 < attitude < 0.01
    assert 0.0 < position < 0.02


def test_track_is_lost_without_estimates() -> None:
    simulator, tracker, context = tracking(markers=Source(until=1.1))
    simulator.AdvanceTo(3.9)
    assert tracker.GetOutputPort("status").Eval(context)[0] == 1.0
    before = tracker.GetOutputPort("status").Eval(context)[3]
    simulator.AdvanceTo(4.1)
    assert tracker.GetOutputPort("status").Eval(context)[0] == 0.0
    assert tracker.GetOutputPort("status").Eval(context)[3] > before


def test_track_begins_with_a_source_that_needs_no_prediction() -> None:
    simulator, tracker, context = tracking(markers=Source(until=0.0), scan=Source())
    simulator.AdvanceTo(2.0)
    assert tracker.GetOutputPort("status").Eval(context).tolist() == [0.0, np.inf, np.inf, np.inf]


def test_pose_that_is_far_off_is_left_out_until_it_persists() -> None:
    simulator, tracker, context = tracking(markers=Source(flipped=2.0))
    simulator.AdvanceTo(2.3)
    assert angle_between(pose_of_state(tracker.GetOutputPort("state").Eval(context)), truth(2.3)) < 0.01
    simulator.AdvanceTo(4.0)
    flipped = truth(4.0) @ RigidTransform(RotationMatrix.MakeXRotation(2.0), [0.0, 0.0, 0.0])
    assert angle_between(pose_of_state(tracker.GetOutputPort("state").Eval(context)), flipped) < 0.05


def test_estimate_from_the_future_is_ignored() -> None:
    simulator, tracker, context = tracking(markers=Source(ahead=1.0))
    simulator.AdvanceTo(2.3)
    status = tracker.GetOutputPort("status").Eval(context)
    assert status[0] == 1.0 and 0.0 <= status[1] < 1.0
    assert angle_between(pose_of_state(tracker.GetOutputPort("state").Eval(context)), truth(2.3)) < 0.01


def test_source_to_begin_with_must_exist() -> None:
    with pytest.raises(ValueError, match="begins with an estimate of one of the sources scan, not of \\['markers'\\]"):
        TargetTracker(["scan"], starting=["markers"], period=0.02)
