"""Calibration: parameters of a testbed from recordings, by filtering, with their uncertainty and a verdict."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from math import inf
from typing import Self

import numpy as np
from numpy.typing import NDArray

from vtbdrake.calibration.calibration_result import (
    WORSE,
    Calibrated,
    Calibration,
    Verdict,
    calibrated_scenario,
    kept_back,
)
from vtbdrake.calibration.filtering import Noise, Segments
from vtbdrake.calibration.fisher import Information, information_of
from vtbdrake.calibration.fit_curves import FitCurves
from vtbdrake.calibration.inverse_dynamics import InverseDynamics, bounded_step, outward
from vtbdrake.calibration.joint_model import CalibrationError, Inertia, JointModel
from vtbdrake.calibration.joint_recording import JointRecording
from vtbdrake.calibration.log_checks import check_log, check_torques, currents
from vtbdrake.calibration.missing_terms import lost_friction, missing_terms, named_terms, widening
from vtbdrake.calibration.posterior import sandwich_covariance, torque_disturbances
from vtbdrake.common.argument_checks import counted
from vtbdrake.common.arrays import Array, rms
from vtbdrake.optimization import Parameter
from vtbdrake.recording.log import GAP, Log
from vtbdrake.rollout.executor import watched
from vtbdrake.state import VariableError
from vtbdrake.testbed import Scenario, VirtualTestbed
from vtbdrake.testbed.inertia import INERTIA_SIZE, PHYSICAL, body_function
from vtbdrake.testbed.pedigree import Posterior

_log = logging.getLogger(__name__)

# Innovations with a larger autocorrelation are called coloured; a test of significance rejects any real model.
COLOURED = 0.2
# The quantile of the innovations that is compared, too: where a joint breaks loose, single ones may be many deviations
# with the right model.
_LARGE = 0.95
# Largest number of iterations.
_ITERATIONS = 25
# The last iteration moves the parameters by less than this share of their standard deviations.
_CONVERGED = 0.1
_NOISE_SEGMENTS = 12
# A discrete plant steps by its own step, so that a position that is missing is a gap.
_LONGEST = 1.5
# Half width of an interval of 95 %, in standard deviations.
_WIDE = 1.959964
# Deviance at the ends of such an interval.
_DEVIANCE = 3.841459
# An estimate at a bound is doubted if the optimum lies this many standard deviations beyond it.
_PULLED = 3.0


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
    noise: Noise | None = None,
    progress: bool = False,
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
        noise: The noise, of an earlier calibration of this machine, which is not fitted again: that takes most of the
            time.
        progress: Whether to show what is computed in a terminal or a notebook; the log has it at the level INFO.

    Raises:
        CalibrationError: A parameter is none of the model, a log does not fit the model, or nothing is varied.
    """
    if not 0.0 < holdout < 0.9:
        raise CalibrationError(f"the share that is kept back is above 0 and below 0.9, not {holdout}")
    settings = _Settings(position, torque, measured_torque, period, segment, noise)
    with _one_thread(), _Progress(shown=progress) as line:
        prepared = _Prepared.of(scenario, logs, parameters, inertias, settings, line)
        return prepared.fitted(scenario, holdout)


def information(
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
    noise: Noise | None = None,
) -> Information:
    """Return the information about parameters in recordings, measured or simulated.

    The noise is the likeliest one, or the given one, at the parameters that fit all segments best:
    deviations by the model alone, without verdicts.

    Args:
        scenario: The scenario; the fit begins at the values of its default context.
        logs: The recordings.
        parameters: Numbers of the plant and of its `JointDrives`, with their ranges, see `JointModel`.
        inertias: Bodies whose ten inertial parameters are varied together.
        position: The sensor signal of the joint positions, in the plant's order.
        torque: The actuator signal of the joint torques.
        measured_torque: The torques were measured in the drives, and act at once; they are no commands.
        period: About the time between two positions that are compared, in s; by default, every one is.
        segment: Duration in s of a segment of the recordings.
        noise: The noise, of an earlier calibration of this machine; by default the likeliest one.

    Raises:
        CalibrationError: As in `calibrate`, but for parameters that change nothing.
    """
    settings = _Settings(position, torque, measured_torque, period, segment, noise)
    with _one_thread(), _Progress(shown=False) as line:
        prepared = _Prepared.of(scenario, logs, parameters, inertias, settings, line)
        z, noise = prepared.converged(np.ones(prepared.segments.count, bool))
        return prepared.information(noise, z)


def _one_thread() -> AbstractContextManager[object]:
    """Return a context in which BLAS computes in this thread alone.

    The filter's matrices are small, and the fit's matrices slim: other threads would mostly wait for work, in a loop
    that takes processor time. And the last digits do not depend on the number of threads.
    """
    from threadpoolctl import threadpool_limits

    limits: AbstractContextManager[object] = threadpool_limits(1, user_api="blas")
    return limits


class _Progress:
    """A line that says what is computed, rewritten in a terminal or a notebook, and logged at the level INFO.

    Args:
        shown: Whether the line is shown, beside the log.
    """

    def __init__(self, *, shown: bool) -> None:
        self._shown = shown and watched()

    def __enter__(self) -> Self:
        from tqdm.auto import tqdm  # Here, because worker processes need none.

        self._bar = tqdm(bar_format="calibration, {elapsed}: {desc}", disable=not self._shown, leave=False)
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.close()

    def tell(self, text: str) -> None:
        """Say what is computed now."""
        _log.info("%s", text)
        self._bar.set_description_str(text)


@dataclass(frozen=True)
class _Settings:
    """The arguments of `calibrate` about the reading and the filtering of recordings."""

    position: str
    torque: str
    measured_torque: bool
    period: float | None
    segment: float
    noise: Noise | None

    def check(self) -> None:
        """Check the times.

        Raises:
            CalibrationError: One is not positive and finite.
        """
        for name, value in (("period", self.period), ("segment", self.segment)):
            if value is not None and not 0.0 < value < inf:
                raise CalibrationError(f"{name} is a positive, finite time in s, not {value}")


@dataclass(frozen=True, eq=False)
class _Prepared:
    """Model and recordings, checked, with a start of the fit and what it can tell.

    Attributes:
        testbed: The testbed of the scenario.
        model: Its model, with the parameters.
        logs: The digests of the recordings, by source.
        remarks: What is worth saying of the recordings.
        doubts: What speaks against a fit to them.
        segments: The recordings in segments.
        some: Some of the segments, by which the noise is found.
        recordings: The recordings, without their gaps.
        dynamics: Inverse dynamics of the model.
        start: The parameters by inverse dynamics.
        noise: The noise that is given; None: it is found.
        guess: Where the search of the noise begins.
        progress: Where it is told what is computed.
    """

    testbed: VirtualTestbed
    model: JointModel
    logs: Mapping[str, str]
    remarks: tuple[str, ...]
    doubts: tuple[str, ...]
    segments: Segments
    some: Segments
    recordings: tuple[JointRecording, ...]
    dynamics: InverseDynamics
    start: Array
    noise: Noise | None
    guess: Noise
    progress: _Progress

    def causes(self) -> list[str]:
        """Return the likely cause of a bad fit, as a sentence, if there is one."""
        return currents(self.model, self.dynamics, self.recordings)

    @classmethod
    def of(
        cls,
        scenario: Scenario,
        logs: Log | Sequence[Log],
        parameters: Sequence[Parameter],
        inertias: Sequence[Inertia],
        settings: _Settings,
        progress: _Progress,
    ) -> _Prepared:
        """Read and check the recordings, and find a start.

        Raises:
            CalibrationError: As in `calibrate`.
        """
        logs = [logs] if isinstance(logs, Log) else list(logs)
        if not (parameters or inertias):
            raise CalibrationError("nothing is varied: give parameters=[Parameter(address, lower, upper)] or inertias=")
        if not logs:
            raise CalibrationError("there is no recording to calibrate with")
        settings.check()
        position, torque = settings.position, settings.torque
        progress.tell("building the model")
        testbed = scenario.build()
        model = JointModel(testbed, parameters, inertias, measured_torque=settings.measured_torque)
        if settings.noise is not None:
            settings.noise.check(model.nq)
        whole = [
            JointRecording.of(log, model, position=position, torque=torque, period=settings.period) for log in logs
        ]
        progress.tell(f"checking {counted(len(logs), 'recording')} by inverse dynamics")
        longest = _LONGEST if model.step_size > 0.0 else GAP
        recordings = [piece for recording in whole for piece in recording.pieces(longest=longest)]
        checks = [check_log(log, scenario.interface(), position=position, torque=torque) for log in logs]
        dynamics = InverseDynamics(model)
        fit = dynamics.fit(recordings, start=model.start)
        checks.append(check_torques(model, dynamics, recordings, fit))
        remarks = tuple(remark for check in checks for remark in check.remarks)
        for remark in remarks:
            _log.warning("%s", remark)
        progress.tell("compiling a step of the model")
        return cls(
            testbed=testbed,
            model=model,
            logs={log.source: log.digest for log in logs},
            remarks=remarks,
            doubts=tuple(doubt for check in checks for doubt in check.doubts),
            segments=Segments(model, recordings, duration=settings.segment),
            some=Segments(model, recordings, duration=settings.segment, most=_NOISE_SEGMENTS),
            recordings=tuple(recordings),
            dynamics=dynamics,
            start=fit.z,
            noise=settings.noise,
            guess=Noise.guess(recordings, fit.unexplained),
            progress=progress,
        )

    def converged(self, used: NDArray[np.bool]) -> tuple[Array, Noise]:
        """Return the parameters that fit the chosen segments best, and the likeliest noise.

        The noise is estimated from some segments, beside the parameters that fit these best.
        """
        try:
            z, noise = self.start, self.noise
            if noise is None:
                z, noise = _gauss_newton(self.some, z, self.guess, self.progress, fits_noise=True)
            return _gauss_newton(self.segments, z, noise, self.progress, used)
        except CalibrationError as error:
            raise CalibrationError(". ".join([str(error), *self.doubts, *self.causes()])) from error

    def information(self, noise: Noise, z: Array) -> Information:
        """Return the information in the recordings with this noise, at these parameters."""
        slopes = self.segments.innovations(noise, self.segments.linearized(z)).slopes
        return information_of(slopes.reshape(-1, len(z)), self.model.names, self.model.scales)

    def fitted(self, scenario: Scenario, holdout: float) -> Calibration:
        """Return the result of the fit.

        Raises:
            CalibrationError: A parameter changes nothing.
        """
        held_back = kept_back(self.segments.count, holdout)
        z, noise = self.converged(~held_back)
        self.progress.tell("verdicts: what the model lacks")
        return _result(scenario, self, noise, z, held_back)


def _gauss_newton(
    segments: Segments,
    z: Array,
    noise: Noise,
    progress: _Progress,
    used: NDArray[np.bool] | slice = slice(None),
    *,
    fits_noise: bool = False,
) -> tuple[Array, Noise]:
    """Return the parameters that minimize the whitened innovations of the used segments, and the noise.

    Args:
        segments: The segments, whose trajectories become the filtered ones.
        z: The parameters to begin with.
        noise: The noise, or where to begin.
        progress: Where each iteration is told.
        used: The segments that count.
        fits_noise: Take the likeliest noise at the parameters of each iteration.
    """
    model, purpose = segments.model, "noise and parameters" if fits_noise else "parameters"
    for number in range(1, _ITERATIONS + 1):
        progress.tell(f"{purpose} by {counted(segments.count, 'segment')}, iteration {number}, {_ITERATIONS} at most")
        linearized = segments.linearized(z)
        if fits_noise:
            noise = segments.likeliest_noise(linearized, noise)
        innovations = segments.innovations(noise, linearized)
        segments.trajectory = innovations.states
        J = innovations.slopes[:, used].reshape(-1, len(z)) * model.scales
        gradient = J.T @ innovations.white[:, used].ravel()
        # Innovations are measured - expected: their derivatives have the other sign than the step.
        moved = np.clip(z - bounded_step(model, z, J.T @ J, gradient), model.lower, model.upper) - z
        z = z + moved
        if -gradient @ (moved / model.scales) < _CONVERGED**2:
            break
    return z, noise


def _result(
    scenario: Scenario, prepared: _Prepared, noise: Noise, z: Array, held_back: NDArray[np.bool]
) -> Calibration:
    model, segments, used = prepared.model, prepared.segments, ~held_back
    linearized = segments.linearized(z)
    white = (innovations := segments.innovations(noise, linearized)).white
    fit, holdout = rms(white[:, used]), rms(white[:, held_back])
    J = innovations.slopes[:, used].reshape(-1, len(z))
    info = information_of(J, model.names, model.scales)
    _check_told(model, info)
    sandwich = sandwich_covariance(innovations, used, segments.period, info)
    gradient = (J * model.scales).T @ white[:, used].ravel()
    bounds = _Bounds(model, z, gradient, info, np.diag(sandwich))
    correlation = _autocorrelation(white[:, used])
    reasons = [*prepared.doubts, *bounds.reasons]
    if correlation > COLOURED:
        reasons.append(f"the innovations are coloured (autocorrelation {correlation:.2g}): the model lacks something")
    if _is_worse(white, used):
        reasons.append(f"the segments that were kept back fit {holdout / fit:.2g} times worse")
    deviations = np.sqrt(np.diag(sandwich)) * model.scales
    reasons += lost_friction(segments, prepared.start, z, noise, deviations)
    terms = missing_terms(segments, linearized, noise, z, used, info)
    reasons += map(str, named_terms(terms))
    reasons += prepared.causes() if reasons else []
    verdict = Verdict.DISCREPANT if reasons else Verdict.ACCEPTED
    sandwich = sandwich if reasons else sandwich + widening(terms)
    if not reasons and _start_is_as_good(segments, noise, white, held_back):
        verdict = Verdict.NO_EVIDENCE
        reasons.append("the start explains the segments that were kept back as well: nothing speaks for other values")
    covariance = sandwich * np.outer(model.scales, model.scales)
    results = _reported(model, z, sandwich, info, bounds, verdict)
    values = {address: each.value for address, each in results.items()}
    try:
        prepared.testbed.write(prepared.testbed.default_context(), values)
    except VariableError as error:
        reasons.append(f"no testbed takes the estimates: {error}")
        verdict = Verdict.DISCREPANT
        results = _reported(model, z, sandwich, info, bounds, verdict)
    posterior = _posterior(model, z, covariance, noise)
    return Calibration(
        scenario=calibrated_scenario(scenario, results, posterior, logs=prepared.logs, reasons=reasons),
        parameters=results,
        combinations=info.combinations,
        noise=noise,
        fit=fit,
        holdout=holdout,
        correlation=correlation,
        reasons=tuple(reasons),
        remarks=prepared.remarks,
        information=info,
        curves=FitCurves.of(prepared.recordings, prepared.dynamics, z, segments, white, held_back),
        segments=int(used.sum()),
        sources=tuple(prepared.logs),
    )


def _posterior(model: JointModel, z: Array, covariance: Array, noise: Noise) -> Posterior:
    """Return the joint distribution of the parameters, with what else makes predictions uncertain."""
    n = model.scalars
    return Posterior(
        addresses=model.names[:n],
        inertias=list(model.bodies),
        mean=z.tolist(),
        covariance=(0.5 * (covariance + covariance.T)).tolist(),
        lower=model.lower[:n].tolist(),
        upper=model.upper[:n].tolist(),
        disturbances=torque_disturbances(model, noise),
        seed=f"{model.drives}.seed" if model.drives else "",
    )


def _check_told(model: JointModel, info: Information) -> None:
    """Raise an error if a parameter, other than a number of an inertia, changes nothing in the recordings."""
    if nothing := [name for name in info.nothing if name in model.names[: model.scalars]]:
        raise CalibrationError(f"these change nothing in the recordings: {', '.join(nothing)}; leave them out")


def _is_worse(white: Array, used: NDArray[np.bool]) -> bool:
    """Return whether innovations (N, W, nq) are worse where they were not fitted, in the mean and but for outliers."""
    if used.all():
        return False
    parts = white[:, ~used], white[:, used]
    means, large = ([measure(part) for part in parts] for measure in (rms, lambda part: np.quantile(abs(part), _LARGE)))
    return bool(means[0] > WORSE * means[1] and large[0] > WORSE * large[1])


def _start_is_as_good(segments: Segments, noise: Noise, white: Array, held_back: NDArray[np.bool]) -> bool:
    """Return whether the start explains the segments that were kept back as well as the estimate."""
    if not held_back.any():
        return False
    linearized = segments.linearized(segments.model.start)
    by_start = segments.innovations(noise, linearized._replace(slopes=linearized.slopes[..., :0])).white
    gain = (by_start[:, held_back] ** 2).sum() - (white[:, held_back] ** 2).sum()
    return bool(gain < _DEVIANCE * max((white[:, held_back] ** 2).mean(), 1.0))


class _Bounds:
    """The parameters at an end of their range: how far the optimum lies beyond it, and the interval within it.

    Along a parameter, with the others at their best, the deviance rises from the bound as 2 g d + h d^2 with the
    distance d, the slope g, and the information h that the others leave. The sandwich takes the place of 1 / h where
    it is larger.

    Args:
        model: The model.
        z: The estimate.
        gradient: The gradient of half the sum of squares by the scaled parameters.
        info: The information at the estimate.
        variances: The variances of the scaled parameters.
    """

    def __init__(self, model: JointModel, z: Array, gradient: Array, info: Information, variances: Array) -> None:
        at = outward(model, z, gradient) | (z == model.lower) | (z == model.upper)
        self.intervals: dict[int, tuple[float, float]] = {}
        self.reasons: list[str] = []
        identifiable = info.is_told(np.eye(len(z)), np.sqrt(variances))
        for k in np.flatnonzero(at & identifiable):
            h = 1.0 / info.covariance[k, k]
            excess = variances[k] * h
            g = abs(float(gradient[k]))
            reach = (np.sqrt(g**2 + h * excess * _DEVIANCE) - g) / h * model.scales[k]
            ends = (z[k], z[k] + reach) if z[k] == model.lower[k] else (z[k] - reach, z[k])
            self.intervals[int(k)] = max(ends[0], model.lower[k]), min(ends[1], model.upper[k])
            if g / np.sqrt(h * excess) > _PULLED:
                self.reasons.append(
                    f"{model.names[k]} is pulled {g / np.sqrt(h * excess):.2g} deviations beyond its bound {z[k]:g}: "
                    "the range excludes the best value"
                )


def _autocorrelation(white: Array) -> float:
    """Return the largest autocorrelation of the innovations (N, W, nq) over ten lags, of any joint."""
    power = (white**2).sum(axis=(0, 1))
    sums = np.array([(white[lag:] * white[:-lag]).sum(axis=(0, 1)) for lag in range(1, 11)])
    return float(np.max(abs(sums / power)))


def _reported(
    model: JointModel, z: Array, sandwich: Array, info: Information, bounds: _Bounds, verdict: Verdict
) -> dict[str, Calibrated]:
    """Return the numbers by address, of an inertia the physical ones."""
    results: dict[str, Calibrated] = {}

    def add(addresses: Sequence[str], start: Array, values: Array, gradients: Array) -> None:
        deviations = np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", gradients, sandwich, gradients), 0.0))
        identifiable = info.is_told(gradients, deviations)
        for row in zip(
            addresses, start.tolist(), values.tolist(), deviations.tolist(), identifiable.tolist(), strict=True
        ):
            address, first, value, deviation, is_told = row
            ends = value - _WIDE * deviation, value + _WIDE * deviation
            judged = verdict if is_told else Verdict.NOT_IDENTIFIABLE
            results[address] = Calibrated(address, first, value, deviation, *ends, judged)

    n = model.scalars
    add(model.names[:n], model.start[:n], z[:n], np.diag(model.scales)[:n])
    for k, name in enumerate(model.names[:n]):
        each = results[name]
        lower, upper = bounds.intervals.get(k, (max(each.lower, model.lower[k]), min(each.upper, model.upper[k])))
        judged = Verdict.AT_BOUND if k in bounds.intervals else each.verdict
        results[name] = replace(each, lower=float(lower), upper=float(upper), verdict=judged)
    convert = body_function()
    for k, body in enumerate(model.bodies):
        rows = slice(n + INERTIA_SIZE * k, n + INERTIA_SIZE * (k + 1))
        value, J = (np.asarray(part) for part in convert(z[rows]))
        start = np.asarray(convert(model.start[rows])[0]).ravel()
        gradients = np.zeros((len(PHYSICAL), len(z)))
        gradients[:, rows] = J
        add([f"{body}.{part}" for part in PHYSICAL], start, value.ravel(), gradients * model.scales)
    return results
