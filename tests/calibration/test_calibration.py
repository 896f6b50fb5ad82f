"""Calibrations of a pendulum with a known truth: how near, how often within the interval, and which verdict."""

from __future__ import annotations

from functools import partial

import casadi
import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from tests.calibration.pendulum import ARM, DRIVES, PERIOD, PendulumScenario, recorded
from tests.real import recordings
from vtbdrake.calibration import (
    Calibration,
    CalibrationError,
    Inertia,
    JointModel,
    JointRecording,
    calibrate,
    information,
)
from vtbdrake.calibration.calibration_result import Verdict
from vtbdrake.calibration.filtering import Noise, Segments
from vtbdrake.optimization import Parameter
from vtbdrake.recording import Log, Series
from vtbdrake.testbed import VirtualTestbed
from vtbdrake_diagrams.double_pendulum import reality

MOMENT, FIRST = f"{ARM}.link.inertia[1]", f"{ARM}.link.center_of_mass[2]"
COULOMB, VISCOUS = f"{DRIVES}.coulomb[0]", f"{DRIVES}.viscous[0]"
PARAMETERS = [
    Parameter(FIRST, -0.8, 0.0),
    Parameter(MOMENT, 1e-3, 0.3),
    Parameter(COULOMB, 0.0, 1.0),
    Parameter(VISCOUS, 0.0, 0.5),
]
TRUTH = {
    f"{ARM}.link.center_of_mass": [0.0, 0.0, -0.36],
    f"{ARM}.link.inertia": [0.03] * 3 + [0.0] * 3,
    COULOMB: 0.2,
    VISCOUS: 0.03,
}
VALUES = {FIRST: -0.36, MOMENT: 0.03, COULOMB: 0.2, VISCOUS: 0.03}


def calibrated(log: Log, parameters: list[Parameter] = PARAMETERS, **options: object) -> Calibration:
    # Shorter segments are as honest, and many of them are filtered side by side.
    settings = {"position": "position", "torque": "torque", "segment": 0.25, **options}
    return calibrate(PendulumScenario(), log, parameters, **settings)


@pytest.mark.slow
@pytest.mark.one_python
@pytest.mark.parametrize("disturbance", [0.0, 0.2])
def test_intervals_contain_the_truth(disturbance: float) -> None:
    inside, errors = [], []
    for seed in range(10):
        # Shorter segments are as honest, and many of them are filtered side by side.
        result = calibrated(recorded(TRUTH, seed, seconds=6.0, disturbance=disturbance), segment=0.25)
        assert not result.combinations, result
        for address, value in VALUES.items():
            each = result.parameters[address]
            inside.append(each.lower <= value <= each.upper)
            errors.append(abs(each.value - value) / abs(value))
    # Of 40 intervals of 95 %, fewer than 33 contain the truth with a probability of 0.4 %, if all are independent.
    assert sum(inside) >= 33, f"{sum(inside)} of {len(inside)}"
    # Without a disturbance the position noise alone limits; its deviation is a tenth of the typical torque otherwise.
    assert np.median(errors) < (0.01 if disturbance == 0.0 else 0.1)


def test_blas_computes_in_one_thread_until_the_result() -> None:
    def threads() -> set[int]:
        return {library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"}

    class Watched(PendulumScenario):
        def build(self) -> VirtualTestbed:
            during.append(threads())
            return super().build()

    during: list[set[int]] = []
    log = recorded(TRUTH, 1, seconds=2.0)
    noise = Noise(np.array([2e-4]), np.array([0.1]), 0.05)
    with threadpool_limits(2, user_api="blas"):
        for fit in (calibrate, information):
            fit(Watched(), log, PARAMETERS, position="position", torque="torque", noise=noise)
            assert threads() == {2}
    assert during and all(numbers == {1} for numbers in during)


def test_noise_is_found() -> None:
    result = calibrated(recorded(TRUTH, 5, disturbance=0.2))
    assert result.noise.measurement[0] == pytest.approx(2e-4, rel=0.1)
    assert result.noise.torque[0] == pytest.approx(0.2, rel=0.25)
    assert result.noise.correlation_time == pytest.approx(0.05, rel=0.5)
    assert result.fit == pytest.approx(1.0, abs=0.1) and result.correlation < 0.1
    assert result.parameters[COULOMB].verdict == Verdict.ACCEPTED and set(result.values) == set(VALUES)


def test_what_the_recording_cannot_tell_is_named() -> None:
    # The pendulum feels m c and I + m c^2: mass, centre and moment are one too many.
    result = calibrated(recorded(TRUTH, 1), [Parameter(f"{ARM}.link.mass", 0.1, 5.0), *PARAMETERS])
    (combination,) = result.combinations
    assert all(name in combination for name in ("link.mass", "center_of_mass[2]"))
    assert result.parameters[f"{ARM}.link.mass"].verdict == Verdict.NOT_IDENTIFIABLE and not result.accepted
    assert f"{ARM}.link.mass" not in result.values
    assert result.parameters[COULOMB].verdict == Verdict.ACCEPTED
    # What is determined is right all the same.
    mass, center = (result.parameters[address].value for address in (f"{ARM}.link.mass", FIRST))
    assert mass * center == pytest.approx(-0.36, rel=0.02)


@pytest.mark.slow
def test_inertia_as_a_whole_reports_the_body() -> None:
    result = calibrated(recorded(TRUTH, 2), PARAMETERS[2:], inertias=[Inertia(f"{ARM}.link")])
    numbers = {
        name: result.parameters[f"{ARM}.link.{name}"].value for name in ("mass", "center_of_mass[2]", "inertia[1]")
    }
    m, c, moment = numbers.values()
    assert m * c == pytest.approx(-0.36, rel=0.02)
    assert moment + m * c**2 == pytest.approx(0.03 + 0.36**2, rel=0.02)
    assert result.combinations and all(
        result.parameters[f"{ARM}.link.{name}"].verdict == Verdict.NOT_IDENTIFIABLE for name in ("mass", "inertia[0]")
    )


@pytest.mark.slow
def test_value_at_the_end_of_its_range_is_not_accepted() -> None:
    result = calibrated(recorded(TRUTH, 3), [*PARAMETERS[:2], Parameter(COULOMB, 0.0, 0.15), PARAMETERS[3]])
    assert result.parameters[COULOMB].value == 0.15 and result.parameters[COULOMB].verdict == Verdict.AT_BOUND


@pytest.mark.slow
def test_model_that_lacks_something_is_discrepant() -> None:
    log = recorded(TRUTH, 4, seconds=4.0)
    torque = log.act["torque"]
    # A spring that nobody modelled, beside the motor: what acts is not what was commanded.
    q = log.sense["position"].values
    wrong = Log(log.source, log.sense, {"torque": Series(torque.times, torque.values + 6.0 * np.roll(q, 25, axis=0))})
    assert calibrated(log).accepted
    result = calibrated(wrong)
    assert Verdict.DISCREPANT in {each.verdict for each in result.parameters.values()} or not result.accepted


def test_derivatives_of_the_innovations_are_those_of_differences() -> None:
    log, scenario = recorded(TRUTH, 6, seconds=2.0), PendulumScenario()
    model = JointModel(scenario.build(), PARAMETERS)
    recording = JointRecording.of(log, model, position="position", torque="torque")
    noise, z = Noise(np.array([2e-4]), np.array([0.1]), 0.05), np.array([-0.35, 0.028, 0.19, 0.03])
    segments = Segments(model, [recording], duration=0.5)
    slopes = segments.innovations(noise, segments.linearized(z)).slopes

    def white(at: np.ndarray) -> np.ndarray:
        # The filter's gain is not differentiated: it is the gain for z.
        defects = segments.linearized(at).defects
        return segments.innovations(noise, segments.linearized(z)._replace(defects=defects)).white

    for k, step in enumerate((1e-5, 1e-6, 1e-5, 1e-5)):
        numeric = (white(z + step * np.eye(4)[k]) - white(z - step * np.eye(4)[k])) / (2.0 * step)
        np.testing.assert_allclose(slopes[..., k], numeric, rtol=1e-4, atol=1e-4 * abs(numeric).max())


def test_steps_in_a_loop_are_those_of_one_long_expression() -> None:
    """Positions every 20 ms of a plant that steps by 1 ms: one step is compiled, and its derivatives are chained."""
    times = 0.02 * np.arange(120)
    signals = np.sin(3.0 * times)[:, np.newaxis], np.cos(5.0 * times)[:, np.newaxis]
    model = JointModel(PendulumScenario(time_step=0.001).build(), PARAMETERS)
    segments = Segments(model, [JointRecording("run.csv", times, *signals)], duration=1.0)
    z = np.array(list(VALUES.values()))
    linearized = segments.linearized(z)
    x, m, h, p = model.step.sx_in()
    following = x
    for _ in range(20):
        following = model.step(following, m, h, p)
    results = [following, *(casadi.jacobian(following, by) for by in (x, p))]
    unrolled = casadi.Function("unrolled", [x, m, h, p], results)
    # The motors' torques come later than the commands, by the delay of the drives.
    motors = model.motor(times, signals[1], z)[0]
    for k in range(segments.steps):
        state = segments.trajectory[k, 0]
        after, A, slopes = (np.asarray(part) for part in unrolled(state, motors[k], 0.001, z))
        np.testing.assert_allclose(linearized.defects[k, 0], after.ravel() - segments.trajectory[k + 1, 0], atol=1e-13)
        np.testing.assert_allclose(linearized.A[k, 0], A, rtol=1e-11, atol=1e-12)
        np.testing.assert_allclose(linearized.slopes[k, 0], slopes, rtol=1e-11, atol=1e-12)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"parameters": []}, "nothing is varied"),
        ({"holdout": 1.0}, "kept back is above 0 and below 0.9, not 1.0"),
        ({"segment": -1.0}, "segment is a positive, finite time in s, not -1.0"),
        ({"position": "elbow"}, "has no signal elbow, but position"),
        ({"log": "two"}, "position has 2 entries, the model 1: other joints?"),
        ({"log": "short"}, "20 positions with a torque are too few"),
        ({"log": "other"}, "are no multiple of the plant's time step"),
        (
            {"noise": Noise(np.zeros(1), np.ones(1), 0.05)},
            "positive deviations of the positions, .*measurement=array.*0",
        ),
        ({"noise": Noise(np.ones(2), np.ones(2), 0.05)}, "for each of 1 joints"),
        ({"noise": Noise(np.ones(1), np.ones(1), -0.05)}, "correlation time, .*correlation_time=-0.05"),
    ],
)
def test_what_does_not_fit_is_refused(change: dict[str, object], message: str) -> None:
    times = PERIOD * np.arange(200)
    q = Series(times, np.sin(times)[:, np.newaxis])
    logs = {
        "good": {"position": q},
        "two": {"position": Series(times, np.tile(q.values, (1, 2)))},
        "short": {"position": q.between(0.0, 19.5 * PERIOD)},
        "other": {"position": Series(0.7 * times, q.values)},
    }
    arguments = {"parameters": PARAMETERS, "position": "position", "log": "good", **change}
    log = Log("run.csv", logs[str(arguments.pop("log"))], {"torque": Series(times, q.values)})
    scenario = PendulumScenario(time_step=PERIOD)
    with pytest.raises(CalibrationError, match=message):
        calibrate(scenario, log, arguments.pop("parameters"), torque="torque", **arguments)


@pytest.mark.slow
@pytest.mark.one_python
def test_real_double_pendulum_is_predicted_better_than_by_the_published_models() -> None:
    folder = next(
        parent
        for parent in recordings("dfki_double_pendulum/**/sys_id/**/trajectory.csv")[0].parents
        if parent.name == "dfki_double_pendulum"
    )
    logs = reality.recordings(folder)
    result = reality.calibrated(logs[::2])
    values = {address: each.value for address, each in result.parameters.items()}
    predicting = reality.fitted_to_predictions(logs[::2], values)
    # Three published sets: 0.158 to 0.160.
    assert reality.determined(predicting, 0.6)["m2 r2"] == pytest.approx(0.159, rel=0.03)
    swing_ups = reality.swing_ups(folder)[:1]
    for runs in (logs[1::4], swing_ups):
        ours = np.concatenate([reality.prediction_errors(r, reality.TestbedPrediction(predicting, r)) for r in runs])
        for name, p in reality.published(folder).items():
            theirs = np.concatenate(
                [reality.prediction_errors(r, partial(reality.published_predictions, p)) for r in runs]
            )
            assert np.median(ours) < np.median(theirs), name
