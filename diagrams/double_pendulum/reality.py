"""The real double pendulum: calibrated with some recordings, and what that predicts of the others.

``python -m vtbdrake_diagrams.double_pendulum.reality FOLDER`` prints it. FOLDER holds the repository
dfki-ric-underactuated-lab/double_pendulum (BSD-3): its excitation runs of 2023-06-29 of the design C.1, each with
positions and torques that were measured at 500 Hz for 10 s, swing-ups of the real acrobot, and published sets of
parameters.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache, partial
from pathlib import Path

import casadi
import click
import numpy as np
import scipy.optimize
import yaml

import vtbdrake as vtb
from vtbdrake.calibration import Calibration, JointModel, JointRecording, calibrate
from vtbdrake.common.arrays import Array
from vtbdrake.components.casadi_system.compiler import compiled_if_possible
from vtbdrake.recording import DrivenScenario, Log
from vtbdrake_diagrams.double_pendulum.scenario import JOINTS, LINKS, DoublePendulumScenario

POSITION = "joint_position"
"""The name of the measured positions in a recording."""
TORQUE = "torque"
"""The name of the torques in a recording."""
PENDULUM = "sim.sys.pendulum"
"""The address of the pendulum."""
DRIVES = "sim.act.drives"
"""The address of its drives."""
HORIZON = 0.5
"""Duration of a prediction, in s."""
RANGES = {
    f"{PENDULUM}.upper.center_of_mass[2]": (-0.5, 0.0),
    f"{PENDULUM}.upper.inertia[1]": (1e-4, 0.2),
    f"{PENDULUM}.lower.center_of_mass[2]": (-0.6, 0.0),
    f"{PENDULUM}.lower.mass": (0.1, 2.0),
    f"{PENDULUM}.lower.inertia[1]": (1e-5, 0.1),
    **{f"{DRIVES}.viscous[{i}]": (0.0, 0.2) for i in (0, 1)},
    **{f"{DRIVES}.coulomb[{i}]": (0.0, 1.0) for i in (0, 1)},
}
"""The numbers that are calibrated, with their ranges."""

# The time between two positions of the fit, in s: faster, what the model lacks (elastic belts, uneven sampling) counts.
_FIT_PERIOD = 0.01
# The runs of the fit; the others are predicted.
_FITTED = slice(0, None, 2)
# Length of the upper link, in m.
_LENGTH = 0.2
# Steps of the integration within a period: friction is steep.
_SUBSTEPS = 4
# Number of samples of the bootstrap interval of a median.
_RESAMPLES = 2000
# Every such sample of a prediction counts in its fit.
_STRIDE = 10
# The influence of errors beyond this is limited, in rad.
_LARGE_ERROR = 0.03
# Largest number of evaluations of that fit.
_EVALUATIONS = 12

Derivative = Callable[[Array, Array], Array]
Prediction = Callable[[Array, Array, Array], Array]
"""A function of states at the begin (w, 4), times (w, n) in s and torques (w, n, 2) -> positions (w, n, 2)."""


def recordings(folder: Path) -> list[Log]:
    """Return the excitation runs, in the order of their times.

    Raises:
        FileNotFoundError: The folder has none.
    """
    paths = sorted(folder.glob("data/experiment_records/design_C.1/sys_id/*/*/trajectory.csv"))
    if not paths:
        raise FileNotFoundError(f"{folder} has no data/experiment_records/design_C.1/sys_id")
    return [_read(path) for path in paths]


def swing_ups(folder: Path) -> list[Log]:
    """Return the swing-ups on the real system, whose shoulder is not driven."""
    return [_read(path) for path in sorted(folder.glob("leaderboard/acrobot/*/src_data/*/*/trajectory.csv"))]


def _read(path: Path) -> Log:
    return vtb.read_table(path, sense={POSITION: ["pos_meas1", "pos_meas2"]}, act={TORQUE: ["tau_meas1", "tau_meas2"]})


def stand_in(count: int = 8, seconds: float = 5.0) -> list[Log]:
    """Return recordings of a simulated pendulum whose numbers are near the real one's, where that is missing."""
    truth = {
        f"{PENDULUM}.lower.mass": 0.65,
        f"{DRIVES}.coulomb": [0.2, 0.15],
        f"{DRIVES}.viscous": [0.03, 0.005],
    }
    logs = []
    for seed in range(count):
        random = np.random.default_rng(seed)
        times = 0.002 * np.arange(round(seconds / 0.002))
        waves = [np.sin(np.outer(times, random.uniform(1.0, 8.0, 2)) + random.uniform(0.0, 6.0, 2)) for _ in range(3)]
        torques = 0.6 * np.sum(waves, axis=0) * (1.0 - np.exp(-times / 0.1))[:, np.newaxis]
        driven = vtb.read_table({"time": times, "u": torques}, sense={}, act={TORQUE: "u"})
        testbed = DrivenScenario(scenario=DoublePendulumScenario(), log=driven).build()
        context = testbed.default_context()
        testbed.write(context, truth)
        simulator, positions = testbed.simulator(context), []
        for time in times:
            simulator.AdvanceTo(time)
            positions.append([float(testbed.read(context, f"{PENDULUM}.{joint}.position")) for joint in JOINTS])
        measured = np.array(positions) + 2e-4 * random.normal(size=(len(times), 2))
        table = {"time": times, "q": measured, "u": torques}
        logs.append(vtb.read_table(table, sense={POSITION: "q"}, act={TORQUE: "u"}))
    return logs


def calibrated(logs: Sequence[Log]) -> Calibration:
    """Return the calibration of all that the motion in a plane depends on, but for the upper link's mass.

    With its moment and its centre of mass, this mass is not seen: it is left at the guess.
    """
    parameters = [vtb.Parameter(address, *ends) for address, ends in RANGES.items()]
    return calibrate(
        DoublePendulumScenario(),
        logs,
        parameters,
        position=POSITION,
        torque=TORQUE,
        measured_torque=True,
        period=_FIT_PERIOD,
    )


def fitted_to_predictions(logs: Sequence[Log], start: Mapping[str, float]) -> dict[str, float]:
    """Return the numbers, by address, whose predictions over `HORIZON` from measured states fit recordings best.

    Least squares, with the influence of large errors limited (soft L1); the lower link's mass stays as it is, because
    the motion tells its first moment alone.

    Args:
        logs: The recordings.
        start: Values to begin with, by address, of all numbers of `calibrated`.
    """
    testbed = DoublePendulumScenario().build()
    fixed = f"{PENDULUM}.lower.mass"
    parameters = [vtb.Parameter(a, *ends) for a, ends in RANGES.items() if a != fixed]
    model = JointModel(testbed, parameters, measured_torque=True)
    mass = float(testbed.read(testbed.default_context(), fixed))
    begin = {**start, **_with_mass(start, mass)}
    recordings = [JointRecording.of(log, model, position=POSITION, torque=TORQUE) for log in logs]
    states, times, *series = zip(*(window for each in recordings for window in _windows(each)), strict=True)
    x0, steps = np.stack(states), np.diff(np.stack(times, axis=1), axis=0)
    torques, positions = (np.stack(parts, axis=1) for parts in series)
    x, m, h, z = model.step.sx_in()
    following = model.step(x, m, h, z)
    parts = [following, casadi.jacobian(following, x), casadi.jacobian(following, z)]
    step = casadi.Function("prediction_step", [x, m, h, z], [casadi.densify(casadi.horzcat(*parts))])
    step_of_all = compiled_if_possible(step).map(len(x0))

    @lru_cache(maxsize=1)  # The solver asks for the errors and, at the same values, for their slopes.
    def residuals(key: bytes) -> tuple[Array, Array]:
        values = np.frombuffer(key)
        state, slope = x0, np.zeros((len(x0), 4, len(values)))
        errors, slopes, at = [], [], np.tile(values[:, np.newaxis], len(x0))
        for k in range(len(steps)):
            for _ in range(_SUBSTEPS):
                table = step_of_all(state.T, torques[k].T, steps[k][np.newaxis] / _SUBSTEPS, at)
                following = np.asarray(table).reshape(4, len(x0), -1).swapaxes(0, 1)
                state, slope = following[..., 0], following[..., 1:5] @ slope + following[..., 5:]
            if k % _STRIDE == 0:
                errors.append(state[:, :2] - positions[k + 1])
                slopes.append(slope[:, :2])
        return np.ravel(errors), np.reshape(slopes, (-1, len(values)))

    fit = scipy.optimize.least_squares(
        lambda values: residuals(values.tobytes())[0],
        np.clip([begin[name] for name in model.names], model.lower + 1e-9, model.upper),
        jac=lambda values: residuals(values.tobytes())[1],
        bounds=(model.lower, model.upper),
        x_scale=model.scales,
        loss="soft_l1",
        f_scale=_LARGE_ERROR,
        max_nfev=_EVALUATIONS,
    )
    return {fixed: mass, **dict(zip(model.names, fit.x.tolist(), strict=True))}


def _with_mass(values: Mapping[str, float], mass: float) -> dict[str, float]:
    """Return numbers of both links for another mass of the lower one, with which they move alike."""
    m1 = DoublePendulumScenario().masses[0]
    m2, change = values[f"{PENDULUM}.lower.mass"], mass - values[f"{PENDULUM}.lower.mass"]
    r1, r2 = (values[f"{PENDULUM}.{link}.center_of_mass[2]"] for link in LINKS)
    first, second = r1 + change * _LENGTH / m1, r2 * m2 / mass
    return {
        f"{PENDULUM}.upper.center_of_mass[2]": first,
        f"{PENDULUM}.upper.inertia[1]": values[f"{PENDULUM}.upper.inertia[1]"]
        + m1 * (r1**2 - first**2)
        - change * _LENGTH**2,
        f"{PENDULUM}.lower.center_of_mass[2]": second,
        f"{PENDULUM}.lower.inertia[1]": values[f"{PENDULUM}.lower.inertia[1]"] + m2 * r2**2 - mass * second**2,
    }


def determined(values: Mapping[str, float], upper_mass: float) -> dict[str, float]:
    """Return the combinations that the motion in a plane depends on: m1 r1 + m2 l1 and m2 r2 (kg m), I2 (kg m^2)."""
    m2 = values[f"{PENDULUM}.lower.mass"]
    r1, r2 = (-values[f"{PENDULUM}.{link}.center_of_mass[2]"] for link in LINKS)
    return {
        "m1 r1 + m2 l1": upper_mass * r1 + m2 * _LENGTH,
        "m2 r2": m2 * r2,
        "I2": values[f"{PENDULUM}.lower.inertia[1]"] + m2 * r2**2,
    }


def published(folder: Path) -> dict[str, dict[str, float]]:
    """Return the published sets of parameters, by their names."""
    paths = sorted(folder.glob("data/system_identification/identified_parameters/design_C.1/*/model_parameters.yml"))
    return {path.parent.name: yaml.safe_load(path.read_text()) for path in paths}


def published_model(p: dict[str, float]) -> Derivative:
    """Return the equation of motion of the authors' software with its law of friction, (x (4, w), tau (2, w)) -> xdot.

    Each of the w columns is a motion of its own.
    """

    def derivative(x: Array, tau: Array) -> Array:
        q1, q2, v1, v2 = x
        c2, s2, l1, gear = np.cos(q2), np.sin(q2), p["l1"], p["gr"]
        first, second = p["m1"] * p["r1"], p["m2"] * p["r2"]
        upper = p["I1"] + p["I2"] + p["m2"] * l1**2 + 2.0 * l1 * second * c2 + (gear**2 + 1.0) * p["Ir"]
        coupling = p["I2"] + l1 * second * c2 - gear * p["Ir"]
        lower = p["I2"] + gear**2 * p["Ir"]
        bias = l1 * second * s2 * np.array([-2.0 * v1 * v2 - v2**2, v1**2])
        end = second * np.sin(q1 + q2)
        weight = -p["g"] * np.array([(first + p["m2"] * l1) * np.sin(q1) + end, end])
        viscous, coulomb = (np.array([[p[f"{kind}1"]], [p[f"{kind}2"]]]) for kind in ("b", "cf"))
        f1, f2 = tau - bias + weight - viscous * x[2:] - coulomb * np.arctan(100.0 * x[2:])
        determinant = upper * lower - coupling**2
        return np.array(
            [v1, v2, (lower * f1 - coupling * f2) / determinant, (upper * f2 - coupling * f1) / determinant]
        )

    return derivative


def published_predictions(p: dict[str, float], x: Array, times: Array, torques: Array) -> Array:
    """Return the positions that a published model predicts by Runge-Kutta steps, all motions side by side.

    Args:
        p: The published parameters.
        x: The states at the begin, (w, 4).
        times: In s, (w, n).
        torques: In N m, (w, n, 2); each acts until the next time.

    Returns:
        Shape (w, n, 2), in rad.
    """
    derivative, x = published_model(p), x.T
    positions = [x[:2]]
    for h, tau in zip(np.diff(times).T, np.moveaxis(torques, 0, 2), strict=False):
        for _ in range(_SUBSTEPS):
            step = h / _SUBSTEPS
            k1 = derivative(x, tau)
            k2 = derivative(x + 0.5 * step * k1, tau)
            k3 = derivative(x + 0.5 * step * k2, tau)
            k4 = derivative(x + step * k3, tau)
            x = x + step / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
        positions.append(x[:2])
    return np.array(positions).transpose(2, 0, 1)


class TestbedPrediction:
    """The positions that the testbed itself predicts, as a world that the log drives.

    Called like `published_predictions`, without the parameters.

    Args:
        values: Values of variables by address.
        log: The recording.
    """

    def __init__(self, values: Mapping[str, float], log: Log) -> None:
        scenario = DoublePendulumScenario()
        self._testbed = DrivenScenario(scenario=scenario, log=log, start=log.start, period=scenario.period).build()
        self._values, self._start = dict(values), log.start

    def __call__(self, x: Array, times: Array, torques: Array) -> Array:
        return np.array([self._prediction(*motion) for motion in zip(x, times, strict=True)])

    def _prediction(self, x: Array, times: Array) -> Array:
        testbed = self._testbed
        context = testbed.default_context()
        testbed.write(context, self._values)
        context.SetTime(times[0] - self._start)
        for k, joint in enumerate(JOINTS):
            testbed.write(context, {f"{PENDULUM}.{joint}.position": x[k], f"{PENDULUM}.{joint}.velocity": x[2 + k]})
        simulator, positions = testbed.simulator(context), []
        for time in times:
            simulator.AdvanceTo(time - self._start)
            positions.append([float(testbed.read(context, f"{PENDULUM}.{joint}.position")) for joint in JOINTS])
        return np.array(positions)


def prediction_errors(log: Log, predict: Prediction) -> Array:
    """Return the root mean squares in rad of the errors of predictions over `HORIZON`, all along a recording.

    Args:
        log: The recording.
        predict: Predicts the motions.
    """
    recording = JointRecording.of(log, JointModel(DoublePendulumScenario().build()), position=POSITION, torque=TORQUE)
    x, times, torques, positions = (np.stack(parts) for parts in zip(*_windows(recording), strict=True))
    return np.sqrt(np.mean((predict(x, times, torques) - positions) ** 2, axis=(1, 2)))


def _windows(recording: JointRecording) -> list[tuple[Array, Array, Array, Array]]:
    """Return the state (4,) at the begin of each prediction, times (n,), torques and positions (n, 2)."""
    q, v, _ = recording.smoothed()
    steps = round(HORIZON / recording.period)
    spans = [slice(k, k + steps) for k in range(10, len(q) - steps - 10, steps)]
    return [
        (np.concatenate([q[s.start], v[s.start]]), recording.times[s], recording.u[s], recording.q[s]) for s in spans
    ]


@click.command()
@click.argument("folder", type=click.Path(exists=True, file_okay=False, path_type=Path))
def main(folder: Path) -> None:
    """Calibrate the double pendulum with half of the runs in FOLDER, and predict the others."""
    logs = recordings(folder)
    fitted, held_out = logs[_FITTED], [log for log in logs if log not in logs[_FITTED]]
    calibration = calibrated(fitted)
    print(calibration, "\n")
    values = {address: each.value for address, each in calibration.parameters.items()}
    predicting = fitted_to_predictions(fitted, values)
    print(f"Fitted to predictions over {HORIZON:g} s of the same runs:")
    print("".join(f"{address:45}{value:10.5g}\n" for address, value in predicting.items()))
    sets = published(folder)
    print(f"{'':12}" + "".join(f"{name:>16}" for name in ("m1 r1 + m2 l1", "m2 r2", "I2")))
    mass = DoublePendulumScenario().masses[0]
    rows = {"predictions": determined(predicting, mass), "calibrated": determined(values, mass)}
    for name, p in sets.items():
        rows[name] = {"m1 r1 + m2 l1": p["m1"] * p["r1"] + p["m2"] * p["l1"], "m2 r2": p["m2"] * p["r2"], "I2": p["I2"]}
    for name, row in rows.items():
        print(f"{name:12}" + "".join(f"{value:16.4f}" for value in row.values()))
    predictions: dict[str, Callable[[Log], Prediction]] = {
        "predictions": lambda log: TestbedPrediction(predicting, log),
        "calibrated": lambda log: TestbedPrediction(values, log),
        **{name: lambda log, p=p: partial(published_predictions, p) for name, p in sets.items()},  # type: ignore[misc]
    }
    for text, runs in ((f"{len(held_out)} runs that were not fitted", held_out), ("swing-ups", swing_ups(folder))):
        print(f"\nRMS error in rad of predictions over {HORIZON:g} s, {text}:")
        for name, make in predictions.items():
            errors = np.concatenate([prediction_errors(log, make(log)) for log in runs])
            median, most = np.quantile(errors, [0.5, 0.9])
            drawn = np.random.default_rng(0).choice(errors, (_RESAMPLES, len(errors)))
            low, high = np.quantile(np.median(drawn, axis=1), [0.025, 0.975])
            print(
                f"{name:12} median {median:.4f} [{low:.4f}, {high:.4f}], 90 % within {most:.4f} "
                f"({len(errors)} predictions)"
            )


if __name__ == "__main__":
    main()
