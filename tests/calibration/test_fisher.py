"""Information and intervals against SciPy's on a linear case, against finite differences, and against profiles."""

from __future__ import annotations

import numpy as np
import pytest
import scipy

from tests.calibration.pendulum import ARM, DRIVES, PERIOD, PendulumScenario, recorded
from tests.calibration.test_calibration import COULOMB, FIRST, MOMENT, PARAMETERS, TRUTH, VALUES, VISCOUS, calibrated
from vtbdrake.calibration import JointModel, JointRecording, Noise, calibrate, information
from vtbdrake.calibration.calibration_result import Verdict
from vtbdrake.calibration.filtering import Likelihood, Segments
from vtbdrake.calibration.fisher import information_of
from vtbdrake.calibration.inverse_dynamics import directions_of
from vtbdrake.optimization import Parameter
from vtbdrake_diagrams.double_pendulum import DoublePendulumScenario

pytestmark = pytest.mark.one_python

NOISE = Noise(np.array([2e-4]), np.array([1e-6]), 0.05)
RANGES = [Parameter(MOMENT, 0.02, 0.2), Parameter(VISCOUS, 0.0, 0.5)]


def test_intervals_are_those_of_scipy_where_the_model_is_linear() -> None:
    """A balanced wheel: I a = u - b v, with torques that are held for a period, as the drives do.

    Only positions are noisy, and the whole recording is one segment, so that the filter is a least-squares fit of
    positions whose begin is free.
    """
    round_wheel = dict.fromkeys((f"{ARM}.link.inertia[0]", MOMENT, f"{ARM}.link.inertia[2]"), 0.08)
    wheel = PendulumScenario().with_values({**round_wheel, FIRST: 0.0, VISCOUS: 0.05, COULOMB: 0.0})
    log = recorded({}, 31, seconds=6.0, scenario=wheel)
    start = wheel.with_values({MOMENT: 0.07, VISCOUS: 0.04})
    options = {"position": "position", "torque": "torque", "segment": 6.0}
    result = calibrate(start, log, RANGES, noise=NOISE, **options)
    acting = np.concatenate([[0.0], log.act["torque"].values[:-1, 0]])  # read one period after it was given

    def positions(times: np.ndarray, moment: float, viscous: float, q: float, v: float) -> np.ndarray:
        decay = np.exp(-PERIOD * viscous / moment)
        speeds, _ = scipy.signal.lfilter([0.0, (1.0 - decay) / viscous], [1.0, -decay], acting, zi=[v])
        reached = acting / viscous
        steps = PERIOD * reached + (speeds - reached) * (1.0 - decay) * moment / viscous
        return q + np.concatenate([[0.0], np.cumsum(steps[:-1])])

    fit, covariance = scipy.optimize.curve_fit(
        positions,
        log.sense["position"].times,
        log.sense["position"].values[:, 0],
        p0=[0.08, 0.05, 0.0, 0.0],
        sigma=np.full(1500, 2e-4),
        absolute_sigma=True,
    )
    deviations = np.sqrt(np.diag(covariance))
    for k, parameter in enumerate(RANGES):
        each = result.parameters[parameter.address]
        assert each.value == pytest.approx(fit[k], abs=0.1 * deviations[k])
        # By 30 blocks of the sandwich, and never less than without.
        assert 0.99 < each.deviation / deviations[k] < 1.4
    assert result.information is not None
    np.testing.assert_allclose(result.information.together, deviations[:2], rtol=0.07)


def test_information_is_that_of_finite_differences() -> None:
    model = JointModel(PendulumScenario().build(), PARAMETERS)
    recording = JointRecording.of(recorded(TRUTH, 6, seconds=2.0), model, position="position", torque="torque")
    segments, noise = Segments(model, [recording], duration=0.5), Noise(np.array([2e-4]), np.array([0.1]), 0.05)
    z = np.array([-0.35, 0.028, 0.19, 0.03])
    linearized = segments.linearized(z)
    slopes = segments.innovations(noise, linearized).slopes.reshape(-1, 4)
    columns = []
    for k, step in enumerate((1e-5, 1e-6, 1e-5, 1e-5)):
        # The filter has the gain for z.
        ends = [
            segments.innovations(noise, linearized._replace(defects=segments.linearized(at).defects)).white
            for at in (z + step * np.eye(4)[k], z - step * np.eye(4)[k])
        ]
        columns.append((ends[0] - ends[1]).ravel() / (2.0 * step) * model.scales[k])
    J = np.stack(columns, axis=1)
    information = information_of(slopes, model.names, model.scales)
    np.testing.assert_allclose(information.H, J.T @ J, rtol=1e-4)
    np.testing.assert_allclose(information.covariance, np.linalg.inv(J.T @ J), rtol=1e-3)


def test_slopes_of_the_likelihood_are_those_of_finite_differences() -> None:
    model = JointModel(PendulumScenario().build(), PARAMETERS)
    recording = JointRecording.of(recorded(TRUTH, 6, seconds=2.0), model, position="position", torque="torque")
    segments = Segments(model, [recording], duration=0.5)
    linearized = segments.linearized(np.array([-0.35, 0.028, 0.19, 0.03]))

    def likelihood(logs: np.ndarray) -> Likelihood:
        return segments.likelihood(Noise.of_logs(logs), linearized)

    for noise in ([2e-4, 0.1, 0.05], [1e-3, 0.01, 0.2], [1e-5, 1.0, 0.005]):
        logs = np.log(noise)
        differences = [(likelihood(logs + step).log - likelihood(logs - step).log) / 2e-4 for step in 1e-4 * np.eye(3)]
        np.testing.assert_allclose(likelihood(logs).gradient, differences, rtol=1e-5, atol=1e-3)


def test_likelihood_of_two_joints_is_that_of_the_normal_distribution_of_all_positions() -> None:
    generator, h = np.random.default_rng(3), 0.01
    times = h * np.arange(101)
    q = np.outer(np.sin(3.0 * times), [0.3, -0.4]) + 1e-3 * generator.normal(size=(101, 2))
    model = JointModel(DoublePendulumScenario().build())
    segments = Segments(model, [JointRecording("made", times, q, generator.normal(size=(101, 2)))], duration=0.5)
    assert segments.count == 2
    linearized, N = segments.linearized(np.empty(0)), segments.steps

    def distribution(w: int, logs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mean and covariance of all positions of a segment at once: there is no filter."""
        measurement, torque, correlation = np.exp(logs[:2]), np.exp(logs[2:4]), np.exp(logs[4])
        decay = np.exp(-h / correlation)
        start = np.concatenate([measurement, measurement / h, torque])
        driving = np.concatenate([np.zeros(4), np.sqrt(1.0 - decay**2) * torque])
        # The state (q, v, disturbance) beside the trajectory, as a mean and by all independent normal numbers.
        mean, by_noise = np.zeros(6), np.zeros((6, 6 * (N + 1)))
        by_noise[:, :6] = np.diag(start)
        means, rows = [], []
        for k in range(N):
            F = np.block([[linearized.A[k, w], linearized.B[k, w]], [np.zeros((2, 4)), decay * np.eye(2)]])
            mean, by_noise = F @ mean, F @ by_noise
            mean[:4] += linearized.defects[k, w]
            by_noise[:, 6 * (k + 1) : 6 * (k + 2)] += np.diag(driving)
            means.append(segments.trajectory[k + 1, w, :2] + mean[:2])
            rows.append(by_noise[:2])
        S = np.concatenate(rows)
        return np.concatenate(means), S @ S.T + np.diag(np.tile(measurement**2, N))

    measured = [q[w * N + 1 : (w + 1) * N + 1].ravel() for w in range(2)]

    def log_density(logs: np.ndarray) -> float:
        densities = [scipy.stats.multivariate_normal(*distribution(w, logs)).logpdf(measured[w]) for w in range(2)]
        return sum(densities) + 2 * N * np.log(2.0 * np.pi)

    logs = np.log([1e-3, 2e-3, 0.5, 0.2, 0.05])
    likelihood = segments.likelihood(Noise.of_logs(logs), linearized)
    assert likelihood.log == pytest.approx(log_density(logs), rel=1e-9)
    steps = 1e-4 * np.eye(5)
    differences = [(log_density(logs + step) - log_density(logs - step)) / 2e-4 for step in steps]
    np.testing.assert_allclose(likelihood.gradient, differences, rtol=1e-5, atol=1e-3)
    information = np.zeros((5, 5))
    for w in range(2):
        mean, V = distribution(w, logs)
        by_logs = [(distribution(w, logs + step)[1] - distribution(w, logs - step)[1]) / 2e-4 for step in steps]
        columns = np.stack([V_i @ np.linalg.solve(V, measured[w] - mean) for V_i in by_logs], axis=1)
        information += 0.5 * columns.T @ np.linalg.solve(V, columns)
    np.testing.assert_allclose(likelihood.information, information, rtol=1e-5, atol=1e-6 * information.max())


def test_likeliest_noise_is_that_of_the_simulation_and_stationary() -> None:
    """A disturbance of 0.2 N m, correlated over 50 ms, and encoders with a deviation of 0.2 mrad."""
    model = JointModel(PendulumScenario().build(), PARAMETERS)
    recording = JointRecording.of(recorded(TRUTH, 6, disturbance=0.2), model, position="position", torque="torque")
    segments = Segments(model, [recording], duration=1.0)
    linearized = segments.linearized(np.array([VALUES[parameter.address] for parameter in PARAMETERS]))
    noise = segments.likeliest_noise(linearized, Noise(np.array([1e-5]), np.array([3.0]), 0.5))
    likelihood = segments.likelihood(noise, linearized)
    deviations = np.sqrt(np.diag(np.linalg.inv(likelihood.information)))
    errors = noise.logs - np.log([2e-4, 0.2, 0.05])
    assert np.all(abs(errors) < 3.0 * deviations), (errors, deviations)
    # Less than a third of a deviation is left of the way, in any direction.
    assert likelihood.gradient @ np.linalg.solve(likelihood.information, likelihood.gradient) < 0.1


def test_what_a_recording_will_tell_is_known_beforehand() -> None:
    log, names = recorded(TRUTH, 1, seconds=4.0), {"position": "position", "torque": "torque"}
    noise = Noise(np.array([2e-4]), np.array([3e-3]), 0.05)  # the drives represent friction by one number per period
    told = information(PendulumScenario(), log, PARAMETERS, noise=noise, **names)
    result = calibrated(recorded(TRUTH, 1, seconds=4.0, noise_seed=8), noise=noise, segment=1.0)
    ratios = np.array([each.deviation for each in result.parameters.values()]) / told.together
    # One of four segments is kept back, and the sandwich has few blocks.
    assert np.all((ratios > 0.9) & (ratios < 2.5)), (ratios, told)
    assert set(told.identifiable) == set(result.parameters) and not told.combinations
    assert np.all(told.alone <= told.together)


@pytest.mark.slow
def test_interval_at_a_bound_is_the_profile_of_the_likelihood() -> None:
    # No viscous friction: the best value would be negative in half of all recordings.
    truth = {**TRUTH, VISCOUS: 0.0}
    for seed in range(40, 46):
        log = recorded(truth, seed, seconds=4.0)
        result = calibrated(log, segment=1.0)
        viscous = result.parameters[VISCOUS]
        if viscous.verdict == Verdict.AT_BOUND:
            break
    assert viscous.value == viscous.lower == 0.0 < viscous.upper
    assert not result.reasons  # The bound is right, and the others are accepted.
    assert result.parameters[COULOMB].verdict == Verdict.ACCEPTED

    def squares(value: float) -> float:
        """Return the sum of squares of the fit with the parameter held there."""
        held = PendulumScenario().with_values({VISCOUS: value})
        rest = [each for each in PARAMETERS if each.address != VISCOUS]
        fit = calibrate(held, log, rest, position="position", torque="torque", noise=result.noise)
        assert fit.segments == result.segments
        return fit.fit**2 * fit.segments * round(1.0 / PERIOD)

    risen = squares(viscous.upper) - squares(0.0)
    # 3.84, and more where the sandwich is wider than the information.
    assert 3.5 < risen < 6.0
    assert f"{DRIVES}.viscous" in VISCOUS


def test_direction_is_determined_to_half_of_its_scale() -> None:
    turn, deviations = np.array([[0.6, -0.8], [0.8, 0.6]]), np.array([0.51, 0.49])
    H = turn @ np.diag(deviations**-2.0) @ turn.T
    values, directions, is_determined = directions_of(H)
    assert is_determined.tolist() == [False, True]
    assert values == pytest.approx(deviations**-2.0)
    assert np.abs(directions) == pytest.approx(np.abs(turn))
