"""Calibration: parameters of a testbed from recordings, with their uncertainty and a verdict."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from math import inf, nan

import casadi
import numpy as np
import scipy.stats
from numpy.typing import NDArray

from vtbdrake.arrays import Array
from vtbdrake.calibration.filtering import JointRecording, Noise, Segments
from vtbdrake.calibration.model import INERTIA_SIZE, CalibrationError, Inertia, JointModel, inertia_of
from vtbdrake.optimization import Parameter
from vtbdrake.recording.log import Log
from vtbdrake.testbed import Scenario

_log = logging.getLogger(__name__)

# A direction in which the recordings leave more than this, in units of the parameters' scales, is not determined.
UNDETERMINED = 0.5
# Innovations are called coloured, or a hold-out worse, beyond these; tests of significance reject any real model.
COLOURED, WORSE = 0.2, 1.3
_ITERATIONS, _NOISE_ROUNDS, _CONVERGED = 25, 2, 1e-3
_BLOCK = 0.2  # s, of the sandwich estimator


class Verdict(StrEnum):
    """The outcome of a calibration, for one parameter."""

    ACCEPTED = "accepted"
    DISCREPANT = "discrepant"  # the model does not explain the recordings: innovations are coloured, a hold-out worse
    NOT_IDENTIFIABLE = "not identifiable"  # these recordings do not tell it apart from others
    AT_BOUND = "at a bound"


@dataclass(frozen=True, eq=False)
class Calibrated:
    """One calibrated number.

    Attributes:
        address: Its address.
        start: Its value in the scenario.
        value: Its estimate.
        deviation: Its standard deviation, by the sandwich estimator over blocks of 0.2 s.
        lower, upper: Its interval of 95 %.
        verdict: Whether it may be used.
    """

    address: str
    start: float
    value: float
    deviation: float
    lower: float
    upper: float
    verdict: Verdict


@dataclass(frozen=True, eq=False)
class Calibration:
    """The result of `calibrate`.

    Attributes:
        scenario: The calibrated scenario; its numbers are `values`.
        parameters: The results, by address. An `Inertia` appears as mass, centre of mass and moments.
        combinations: Combinations of parameters that the recordings do not determine, as sentences.
        noise: The noise that explains the innovations.
        fit, holdout: Root mean square of the whitened innovations (1 is expected) in the segments of the fit, and in
            those that were kept back.
        correlation: The largest autocorrelation of the whitened innovations at the first ten lags, of any joint.
        reasons: Why the model is discrepant, as sentences.
        segments: Number of segments of the fit.
        sources: The recordings.
    """

    scenario: Scenario
    parameters: Mapping[str, Calibrated]
    combinations: tuple[str, ...]
    noise: Noise
    fit: float
    holdout: float
    correlation: float
    reasons: tuple[str, ...]
    segments: int
    sources: tuple[str, ...]

    @property
    def accepted(self) -> bool:
        """Return whether every parameter is accepted."""
        return all(each.verdict == Verdict.ACCEPTED for each in self.parameters.values())

    @property
    def values(self) -> dict[str, float]:
        """Return the estimates by address, for `VirtualTestbed.write`; those that are not identifiable are left out."""
        return {
            address: each.value for address, each in self.parameters.items() if each.verdict != Verdict.NOT_IDENTIFIABLE
        }

    def __str__(self) -> str:
        width = max(len(address) for address in self.parameters)
        lines = [
            f"{len(self.sources)} recordings, {self.segments} segments: innovations {self.fit:.3g} (hold-out "
            f"{self.holdout:.3g}, 1 is expected), largest autocorrelation {self.correlation:.2g}",
            f"{'':{width}}       start       value   deviation   interval of 95 %",
        ]
        for each in self.parameters.values():
            lines.append(
                f"{each.address:{width}}{each.start:12.5g}{each.value:12.5g}{each.deviation:12.2g}   "
                f"[{each.lower:.5g}, {each.upper:.5g}] {each.verdict}"
            )
        return "\n".join([*lines, *self.reasons, *self.combinations])


def calibrate(
    scenario: Scenario,
    logs: Log | Sequence[Log],
    parameters: Sequence[Parameter] = (),
    *,
    inertias: Sequence[Inertia] = (),
    position: str,
    torque: str,
    measured_torque: bool = False,
    period: float | None = None,
    segment: float = 1.0,
    holdout: float = 0.2,
) -> Calibration:
    """Fit parameters of a scenario's plant and drives to recordings.

    Inverse dynamics give a start. Then the innovations of a Kalman filter with the model are made small, see
    `vtbdrake.calibration.filtering`. The noise (of the measurement, and a correlated disturbance of the torques) is
    fitted with it: a disturbance that is left out makes the estimates wrong, and their intervals too narrow.

    Args:
        scenario: The scenario; parameters begin at the values of its default context.
        logs: The recordings.
        parameters: Numbers of the plant and of its `JointDrives`, with their ranges, see `JointModel`.
        inertias: Bodies whose ten inertial parameters are varied together.
        position: The sensor signal of the joint positions, in the plant's order.
        torque: The actuator signal of the joint torques.
        measured_torque: The torques were measured in the drives, and act at once; they are no commands.
        period: About the time between two positions that are compared, in s; by default, every one is. With a longer
            one, fast things that the model lacks (elastic gears, uneven sampling) count less.
        segment: Duration in s of a segment of the recordings: they are filtered side by side.
        holdout: Share of the segments that are kept back, to compare with.

    Raises:
        CalibrationError: A parameter is none of the model, a log does not fit the model, or nothing is varied.
    """
    logs = [logs] if isinstance(logs, Log) else list(logs)
    if not (parameters or inertias):
        raise CalibrationError("nothing is varied: give parameters=[Parameter(address, lower, upper)] or inertias=")
    if not 0.0 < holdout < 0.9:
        raise CalibrationError(f"the share that is kept back is above 0 and below 0.9, not {holdout}")
    for name, value in (("period", period), ("segment", segment)):
        if value is not None and not 0.0 < value < inf:
            raise CalibrationError(f"{name} is a positive, finite time in s, not {value}")
    testbed = scenario.build()
    model = JointModel(testbed, parameters, inertias, measured_torque=measured_torque)
    recordings = [JointRecording.of(log, model, position=position, torque=torque, period=period) for log in logs]
    _check_information(model, recordings)
    z, unexplained = _regression(model, recordings)
    segments = Segments(model, recordings, duration=segment)
    held_back = _kept_back(segments.count, holdout)
    noise = Noise.guess(recordings, unexplained)
    for _ in range(_NOISE_ROUNDS):
        noise = segments.likeliest_noise(z, noise)
        z = _gauss_newton(segments, noise, z, ~held_back)
    return _result(scenario, model, segments, noise, z, held_back, tuple(log.source for log in logs))


def _check_information(model: JointModel, recordings: Sequence[JointRecording]) -> None:
    for recording in recordings:
        for name, values in (("position", recording.q), ("torque", recording.u)):
            still = np.flatnonzero(np.ptp(values, axis=0) == 0.0)
            if still.size:
                _log.warning("%s: the %s of joint %s never changes", recording.source, name, ", ".join(map(str, still)))


def _kept_back(count: int, share: float) -> NDArray[np.bool]:
    """Return which segments are kept back, spread over the recordings; one at least, unless there is only one."""
    number = min(max(round(share * count), 1), count - 1)
    held_back = np.zeros(count, bool)
    held_back[np.linspace(0, count - 1, number + 2)[1:-1].astype(int) if number else []] = True
    return held_back


def _scales(model: JointModel) -> Array:
    """Return how far each parameter is from being known: half of its range, and 1 for the numbers of an inertia."""
    half = 0.5 * (model.upper - model.lower)
    return np.where(np.isfinite(half), half, 1.0)


def _regression(model: JointModel, recordings: Sequence[JointRecording]) -> tuple[Array, Array]:
    """Return parameters by which inverse dynamics explain the torques, and what is left of these, (n, nq)."""
    rows = [slice(15, len(recording.times) - 15, 3) for recording in recordings]
    smoothed = [[part[span] for part in r.smoothed()] for r, span in zip(recordings, rows, strict=True)]
    Q, V, A = (np.concatenate(parts).T for parts in zip(*smoothed, strict=True))
    symbols = model.unexplained.sx_in()
    slope = casadi.Function("slope", symbols, [casadi.jacobian(model.unexplained(*symbols), symbols[-1])])
    z, scales = model.start.copy(), _scales(model)
    n = Q.shape[1]
    residual_of_all, slope_of_all = model.unexplained.map(n), slope.map(n)

    def unexplained(at: Array) -> tuple[Array, Array]:
        torques, by = zip(*(model.motor(r.times, r.u, at) for r in recordings), strict=True)
        m = np.concatenate([t[span] for t, span in zip(torques, rows, strict=True)]).T
        dm = np.concatenate([d[span] for d, span in zip(by, rows, strict=True)])
        z_all = np.tile(at[:, np.newaxis], (1, n))
        e = np.asarray(residual_of_all(Q, V, A, m, z_all)).T
        J = np.asarray(slope_of_all(Q, V, A, m, z_all)).reshape(model.nq, n, len(at)).swapaxes(0, 1)
        selection = model.selection
        for k, index in enumerate(model.drive_parameters):
            J[:, :, index] -= dm[:, k] @ selection.T
        return e, J

    e, J = unexplained(z)
    deviation = np.maximum(e.std(axis=0), 1e-9)
    for _ in range(_ITERATIONS):
        white, slopes = (e / deviation).ravel(), (J / deviation[:, np.newaxis]).reshape(-1, len(z)) * scales
        step = _determined_step(slopes.T @ slopes, slopes.T @ white) * scales
        for _ in range(12):
            trial = np.clip(z - step, model.lower, model.upper)
            e_trial, J_trial = unexplained(trial)
            if ((e_trial / deviation) ** 2).sum() <= (white**2).sum():
                break
            step = 0.5 * step
        else:
            break
        moved, z, e, J = abs(trial - z) / scales, trial, e_trial, J_trial
        deviation = np.maximum(e.std(axis=0), 1e-9)
        if moved.max() < _CONVERGED:
            break
    return z, e


def _directions(H: Array) -> tuple[Array, Array, NDArray[np.bool]]:
    """Return eigenvalues and directions of the information about scaled parameters, and which are determined."""
    values, directions = np.linalg.eigh(H)
    return values, directions, np.asarray(values > 1.0 / UNDETERMINED**2)


def _determined_step(H: Array, g: Array) -> Array:
    """Return the step of Gauss and Newton in the directions that are determined; in scaled parameters."""
    values, directions, determined = _directions(H)
    along = directions.T @ g
    return np.asarray(directions[:, determined] @ (along[determined] / values[determined]))


def _gauss_newton(segments: Segments, noise: Noise, z: Array, used: NDArray[np.bool]) -> Array:
    """Return the parameters that minimize the whitened innovations, for this noise."""
    model = segments.model
    scales = _scales(model)
    for _ in range(_ITERATIONS):
        innovations = segments.innovations(noise, segments.linearized(z))
        segments.trajectory = innovations.states
        J = innovations.slopes[:, used].reshape(-1, len(z)) * scales
        # Innovations are measured - expected: their derivatives have the other sign than the step.
        step = _determined_step(J.T @ J, J.T @ innovations.white[:, used].ravel()) * scales
        moved = np.clip(z - step, model.lower, model.upper) - z
        z = z + moved
        if np.max(abs(moved) / scales) < _CONVERGED:
            break
    return z


def _result(
    scenario: Scenario,
    model: JointModel,
    segments: Segments,
    noise: Noise,
    z: Array,
    held_back: NDArray[np.bool],
    sources: tuple[str, ...],
) -> Calibration:
    scales = _scales(model)
    innovations = segments.innovations(noise, segments.linearized(z))
    white, used = innovations.white, ~held_back
    fit, holdout = (float(np.sqrt(np.mean(white[:, part] ** 2))) if part.any() else nan for part in (used, held_back))
    # Scores of blocks that are long against the correlation of what the model lacks.
    length = max(round(_BLOCK / segments.period), 10)
    scores = np.array(
        [
            np.einsum("twij,twi->wj", innovations.slopes[k : k + length, used], white[k : k + length, used]) * scales
            for k in range(0, segments.steps - length + 1, length)
        ]
    ).reshape(-1, len(z))
    J = innovations.slopes[:, used].reshape(-1, len(z)) * scales
    values, directions, determined = _directions(J.T @ J)
    inverse = directions[:, determined] / values[determined] @ directions[:, determined].T
    sandwich = inverse @ (scores.T @ scores) @ inverse
    # Never less than what the noise alone leaves: few blocks make a sandwich too small now and then.
    larger = np.sqrt(np.maximum(np.diag(inverse) / np.maximum(np.diag(sandwich), 1e-300), 1.0))
    covariance = sandwich * np.outer(larger * scales, larger * scales)
    unknown = np.linalg.norm(directions[:, ~determined], axis=1)
    correlation = _autocorrelation(white[:, used])
    reasons = []
    if correlation > COLOURED:
        reasons.append(f"the innovations are coloured (autocorrelation {correlation:.2g}): the model lacks something")
    if holdout > WORSE * fit:
        reasons.append(f"the segments that were kept back fit {holdout / fit:.2g} times worse")
    combinations = [_combination(directions[:, k], model.names, values[k]) for k in np.flatnonzero(~determined)]
    return Calibration(
        scenario=scenario,
        parameters=_reported(model, z, covariance, unknown, discrepant=bool(reasons)),
        combinations=tuple(combinations),
        noise=noise,
        fit=fit,
        holdout=holdout,
        correlation=correlation,
        reasons=tuple(reasons),
        segments=int(used.sum()),
        sources=sources,
    )


def _autocorrelation(white: Array) -> float:
    """Return the largest autocorrelation of the innovations (N, W, nq) over ten lags, of any joint."""
    power = (white**2).sum(axis=(0, 1))
    sums = np.array([(white[lag:] * white[:-lag]).sum(axis=(0, 1)) for lag in range(1, 11)])
    return float(np.max(abs(sums / power)))


def _combination(direction: Array, names: Sequence[str], value: float) -> str:
    order = np.argsort(-abs(direction))
    terms = [f"{direction[k]:+.2f} {names[k]}" for k in order if abs(direction[k]) > 0.2][:6]
    left = inf if value <= 0.0 else 1.0 / np.sqrt(value)
    return f"not determined: {' '.join(terms)} (in scaled parameters; deviation {left:.2g} of the range)"


def _reported(
    model: JointModel, z: Array, covariance: Array, unknown: Array, *, discrepant: bool
) -> dict[str, Calibrated]:
    """Return the numbers by address, of an inertia the physical ones."""
    results: dict[str, Calibrated] = {}

    def add(address: str, start: float, value: float, variance: float, unknown: float, at_bound: bool) -> None:
        verdict = Verdict.DISCREPANT if discrepant else Verdict.ACCEPTED
        verdict = Verdict.AT_BOUND if at_bound else verdict
        verdict = Verdict.NOT_IDENTIFIABLE if unknown > 0.1 else verdict
        deviation = float(np.sqrt(variance))
        wide = scipy.stats.norm.ppf(0.975) * deviation
        results[address] = Calibrated(address, start, value, deviation, value - wide, value + wide, verdict)

    for k in range(model.scalars):
        at_bound = z[k] in (model.lower[k], model.upper[k])
        add(model.names[k], model.start[k], z[k], covariance[k, k], unknown[k], bool(at_bound))
    symbol = casadi.SX.sym("z", INERTIA_SIZE)
    physical = casadi.vertcat(*inertia_of(symbol))
    convert = casadi.Function("inertia", [symbol], [physical, casadi.jacobian(physical, symbol)])
    parts = ["mass", *(f"center_of_mass[{i}]" for i in range(3)), *(f"inertia[{i}]" for i in range(6))]
    for k, body in enumerate(model.bodies):
        rows = slice(model.scalars + INERTIA_SIZE * k, model.scalars + INERTIA_SIZE * (k + 1))
        value, J = (np.asarray(part) for part in convert(z[rows]))
        start = np.asarray(convert(model.start[rows])[0]).ravel()
        C = J @ covariance[rows, rows] @ J.T
        size = np.abs(J) @ np.ones(INERTIA_SIZE)
        doubt = np.abs(J) @ unknown[rows] / np.maximum(size, 1e-300)
        for i, part in enumerate(parts):
            add(f"{body}.{part}", start[i], float(value[i, 0]), float(C[i, i]), float(doubt[i]), False)
    return results
