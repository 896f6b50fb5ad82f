r"""Filter error: how well a model predicts the next position, given all before, and how that depends on its parameters.

A simulation that runs along a whole recording drifts, and one disturbance of the torques that no log contains makes
its estimates wrong. So the model is run in a Kalman filter (R. E. Maine and K. W. Iliff, "Formulation and
implementation of a practical algorithm for parameter estimation with process and measurement noise", SIAM J. Appl.
Math. 41, 1981). Its state is [q; v; d], with the torque disturbances

    d_(k+1) = r d_k + sqrt(1 - r^2) D w_k,    r = exp(-period / T),

of the deviations D by joint and the correlation time T, and the positions are measured with the deviations s. D, T and
s are those of the largest likelihood. The filter is linear, about a trajectory x that is improved in each iteration:
its innovations, and their derivatives by the parameters, are those of the defects f(x_k) - x_(k+1).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import casadi
import numpy as np
import scipy.optimize
import scipy.signal
from numpy.typing import NDArray

from vtbdrake.arrays import Array
from vtbdrake.calibration.model import CalibrationError, JointModel
from vtbdrake.components.casadi_system.compiler import compiled_if_possible
from vtbdrake.recording.log import Log, Series
from vtbdrake.recording.table_reader import GAP

# How far the period of a recording may differ from a multiple of the plant's step, as a share of that step.
_ON_GRID = 0.05
# The least number of samples, and the number of samples of a local polynomial of third order.
_FEWEST, _SMOOTHED = 50, 15
_NOISE_SEGMENTS = 12
# Commands with less jitter than this share of their period come by a clock.
_REGULAR = 0.2
_DIFFERENCE = 1e-5  # of the logarithm of a deviation
_LEAST = 1e-9  # of a deviation, in rad or m


@dataclass(frozen=True, eq=False)
class JointRecording:
    """Positions and torques of one recording, from each position to the next.

    Attributes:
        source: Where it is from.
        times: (n,), in s.
        q: Measured positions, (n, nq).
        u: Means of the commands that acted from each time to the next one, (n, nu).
        stride: Of how many recorded positions each is one.
    """

    source: str
    times: Array
    q: Array
    u: Array
    stride: int = 1

    @classmethod
    def of(
        cls, log: Log, model: JointModel, *, position: str, torque: str, period: float | None = None
    ) -> JointRecording:
        """Return the two signals of a log, with about the given period.

        Raises:
            CalibrationError: A signal is missing or has another size than the model, or the positions are too few.
        """
        for side, name, size in ((log.sense, position, model.nq), (log.act, torque, model.nu)):
            if name not in side:
                raise CalibrationError(f"{log.source} has no signal {name}, but {', '.join(side) or 'none'}")
            if side[name].values.shape[1] != size:
                raise CalibrationError(
                    f"{log.source}: {name} has {side[name].values.shape[1]} entries, the model {size}: other joints?"
                )
        positions, commands = log.sense[position], log.act[torque]
        rows = (positions.times >= commands.times[0]) & ~stale(commands, positions.times)
        times, q = positions.times[rows], positions.values[rows]
        stride = 1 if period is None or len(times) < 2 else max(round(period / float(np.median(np.diff(times)))), 1)
        count = len(times) // stride
        if count < _FEWEST:
            raise CalibrationError(f"{log.source}: {count} positions with a torque are too few to calibrate with")
        span = slice(0, count * stride, stride)
        return cls(log.source, times[span], q[span], _means(commands, times[span]), stride)

    @property
    def period(self) -> float:
        """Return the median time between two positions, in s."""
        return float(np.median(np.diff(self.times)))

    def pieces(self, *, longest: float) -> list[JointRecording]:
        """Return the parts between gaps, of those that are long enough.

        Args:
            longest: The longest time between two positions that is no gap, in periods.

        Raises:
            CalibrationError: No part is long enough.
        """
        cuts = np.flatnonzero(np.diff(self.times) > longest * self.period) + 1
        ends = [0, *cuts.tolist(), len(self.times)]
        spans = [slice(*pair) for pair in pairwise(ends) if pair[1] - pair[0] >= _FEWEST]
        if not spans:
            raise CalibrationError(
                f"{self.source}: {cuts.size} gaps leave no {_FEWEST} positions in a row: the recording is too sparse"
            )
        return [replace(self, times=self.times[span], q=self.q[span], u=self.u[span]) for span in spans]

    def smoothed(self) -> tuple[Array, Array, Array]:
        """Return positions, velocities and accelerations (n, nq) by local polynomials."""
        q, v, a = (
            scipy.signal.savgol_filter(self.q, _SMOOTHED, 3, deriv=order, delta=self.period, axis=0)
            for order in range(3)
        )
        return q, v, a


@dataclass(frozen=True)
class Noise:
    """The noise of a recording.

    Attributes:
        measurement: Deviation of the positions, (nq,), in rad or m.
        torque: Deviation of the torque disturbance, (nq,), in N m or N.
        correlation_time: Of the disturbance, in s.
    """

    measurement: Array
    torque: Array
    correlation_time: float

    @classmethod
    def guess(cls, recordings: Sequence[JointRecording], unexplained: Array) -> Noise:
        """Return where to start: fourth differences are mostly noise, unexplained torques are disturbances."""
        differences = np.concatenate([np.diff(recording.q, 4, axis=0) for recording in recordings])
        measurement = np.sqrt(np.mean(differences**2, axis=0) / 70.0)
        return cls(np.maximum(measurement, _LEAST), np.maximum(np.std(unexplained, axis=0), 1e-6), 0.05)

    def change(self, before: Noise) -> float:
        """Return the largest change of the logarithm of a deviation."""
        deviations = [np.concatenate([noise.measurement, noise.torque]) for noise in (self, before)]
        return float(np.max(abs(np.log(deviations[0] / deviations[1]))))


class Linearization(NamedTuple):
    """The model along the trajectory of W segments of N steps.

    Attributes:
        A: By the state, (N, W, 2 nq, 2 nq).
        B: By a torque at each joint, (N, W, 2 nq, nq).
        defects: f(x_k) - x_(k+1), (N, W, 2 nq).
        slopes: Of the defects by the parameters, (N, W, 2 nq, nz).
    """

    A: Array
    B: Array
    defects: Array
    slopes: Array


class Innovations(NamedTuple):
    """The differences of the measured positions from the expected ones, whitened.

    Attributes:
        white: (N, W, nq), of unit variance.
        slopes: By the parameters, (N, W, nq, nz).
        log_determinant: Sum of the logarithms of the determinants of their covariances.
        states: The filtered states, (N + 1, W, 2 nq).
    """

    white: Array
    slopes: Array
    log_determinant: float
    states: Array


def _means(commands: Series, times: Array) -> Array:
    """Return the means of commands, each of which acts until the next one, from each time to the next, (n, nu)."""
    # The integral from the first command on bends where a command begins.
    steps = np.diff(commands.times)[:, np.newaxis]
    integral = np.concatenate(
        [np.zeros((1, commands.values.shape[1])), np.cumsum(commands.values[:-1] * steps, axis=0)]
    )
    index = np.searchsorted(commands.times, times, side="right") - 1
    at = integral[index] + commands.values[index] * (times - commands.times[index])[:, np.newaxis]
    means = np.diff(at, axis=0) / np.diff(times)[:, np.newaxis]
    return np.concatenate([means, commands.values[index[-1:]]])


def stale(commands: Series, times: Array) -> NDArray[np.bool]:
    """Return at which times the newest command is older than commands of a regular clock can be: some are missing."""
    period, jitter, _ = commands.uniformity
    if not jitter < _REGULAR * period:  # They are recorded when they change.
        return np.zeros(len(times), bool)
    newest = np.searchsorted(commands.times, times, side="right") - 1
    return np.asarray(times - commands.times[np.maximum(newest, 0)] > GAP * period)


class _Filtered(NamedTuple):
    """As `Innovations`, for K noises: (N, K, W, nq), (N, K, W, nq, nz), (K,) and (N + 1, K, W, 2 nq)."""

    white: Array
    slopes: Array
    log_determinant: Array
    states: Array


class Segments:
    """Recordings in segments of equal length.

    Args:
        model: The model.
        recordings: The recordings, with the same period.
        duration: Of a segment, in s.

    Attributes:
        model: The model.
        period: The time between two positions, in s.
        steps: Number N of steps of a segment.
        count: Number W of segments.
        trajectory: The trajectory x, (N + 1, W, 2 nq).
    """

    def __init__(self, model: JointModel, recordings: Sequence[JointRecording], *, duration: float) -> None:
        self.model = model
        self.period = float(np.median([recording.period for recording in recordings]))
        for recording in recordings:
            if abs(recording.period - self.period) > _ON_GRID * self.period:
                raise CalibrationError(
                    f"{recording.source} has positions every {1e3 * recording.period:.4g} ms, another recording every "
                    f"{1e3 * self.period:.4g} ms: calibrate them one by one"
                )
        # As fine as the recording, or as the plant.
        ratio = self.period / model.step_size if model.step_size > 0.0 else recordings[0].stride
        self._substeps = max(round(ratio), 1)
        if abs(ratio - self._substeps) > _ON_GRID:
            raise CalibrationError(
                f"positions every {1e3 * self.period:.4g} ms are no multiple of the plant's time step of "
                f"{1e3 * model.step_size:.4g} ms: calibrate a continuous plant (time_step=0), or another step"
            )
        shortest = min(len(recording.times) for recording in recordings) - 1
        self.steps = min(max(round(duration / self.period), _FEWEST), shortest)
        self._recordings = tuple(recordings)
        self._pieces = [
            (i, slice(k, k + self.steps + 1))
            for i, recording in enumerate(recordings)
            for k in range(0, len(recording.times) - self.steps, self.steps)
        ]
        self.count = len(self._pieces)
        smoothed = [np.hstack(recording.smoothed()[:2]) for recording in recordings]
        self.trajectory = np.stack([smoothed[i][span] for i, span in self._pieces], axis=1)
        self._q = np.stack([recordings[i].q[span] for i, span in self._pieces], axis=1)
        steps = np.stack([np.diff(recordings[i].times[span]) for i, span in self._pieces], axis=1)
        self._h = steps / self._substeps if model.step_size <= 0.0 else np.full_like(steps, model.step_size)
        self._functions = self._compile()

    def _compile(self) -> casadi.Function:
        """Return the function (x, change, m, h, z) -> following x, and its Jacobians by x, m and z, side by side.

        The change is that of the velocities in the step before, which only the friction of a discrete plant feels.
        """
        x, change, m, h, z = self.model.step.sx_in()
        following, v_before = x, x[self.model.nq :] - change
        for _ in range(self._substeps):
            following, v_before = self.model.step(following, v_before, m, h, z), following[self.model.nq :]
        parts = [following, *(casadi.jacobian(following, by) for by in (x, m, z))]
        table = casadi.densify(casadi.horzcat(*parts))
        return compiled_if_possible(casadi.Function("calibration_step", [x, change, m, h, z], [table], {"cse": True}))

    def linearized(self, z: Array) -> Linearization:
        """Return the model along the trajectory."""
        n, nu, nz = self.model.nq, self.model.nu, len(z)
        motors = [self.model.motor(recording.times, recording.u, z) for recording in self._recordings]
        m = np.stack([motors[i][0][span][:-1] for i, span in self._pieces], axis=1)
        by = np.stack([motors[i][1][span][:-1] for i, span in self._pieces], axis=1)
        count = self.steps * self.count
        mapped = self._functions.map(count)
        v = self.trajectory[:, :, n:]
        change = np.diff(v, axis=0) / self._substeps
        change = np.concatenate([change[:1], change[:-1]])  # That before the first step is about that of the first.
        table = mapped(
            self.trajectory[:-1].reshape(count, -1).T,
            change.reshape(count, -1).T,
            m.reshape(count, -1).T,
            self._h.reshape(1, -1),
            np.tile(z[:, np.newaxis], (1, count)),
        )
        columns = 1 + 2 * n + nu + nz
        rows = np.moveaxis(np.asarray(table).reshape(2 * n, count, columns), 0, 1)
        parts = rows.reshape(self.steps, self.count, 2 * n, columns)
        following, A, by_m, slopes = np.split(parts, [1, 1 + 2 * n, 1 + 2 * n + nu], axis=3)
        for k, index in enumerate(self.model.drive_parameters):
            slopes[..., index] += np.einsum("twij,twj->twi", by_m, by[:, :, k])
        return Linearization(A, by_m @ self.model.selection.T, following[..., 0] - self.trajectory[1:], slopes.copy())

    def innovations(self, noise: Noise, model: Linearization, *, selection: slice = slice(None)) -> Innovations:
        """Return the innovations of the chosen segments."""
        result = self._filtered([noise], model, selection)
        log_determinant = float(result.log_determinant[0])
        return Innovations(result.white[:, 0], result.slopes[:, 0], log_determinant, result.states[:, 0])

    def _filtered(self, noises: Sequence[Noise], model: Linearization, selection: slice) -> _Filtered:
        """Return the innovations for each of K noises, which are filtered side by side.

        An array has K in front of the segments; the logarithm of the determinant is one for each noise, (K,).
        """
        n, K = self.model.nq, len(noises)
        A, B, defects, slopes = (part[:, selection] for part in model)
        trajectory, q = self.trajectory[:, selection], self._q[:, selection]
        N, W, nz = len(A), A.shape[1], slopes.shape[3]
        # With an axis for the segments.
        measurement = np.array([noise.measurement for noise in noises])[:, np.newaxis]
        torque = np.array([noise.torque for noise in noises])[:, np.newaxis]
        decay = np.exp(-self.period / np.array([noise.correlation_time for noise in noises]))[:, np.newaxis, np.newaxis]
        transition = np.zeros((K, W, 3 * n, 3 * n))
        transition[..., 2 * n :, 2 * n :] = decay[..., np.newaxis] * np.eye(n)
        nothing = np.zeros((K, 1, 2 * n))
        Q = _diagonal(np.concatenate([nothing, (1.0 - decay**2) * torque**2], axis=2))
        R = _diagonal(measurement**2)
        # A smoothed velocity is about as good as a difference over a few samples.
        start = np.concatenate([measurement**2, (measurement / self.period) ** 2, torque**2], axis=2)
        P = np.broadcast_to(_diagonal(start), transition.shape).copy()
        # The state, relative to the trajectory, and its derivatives by the parameters, side by side.
        X = np.zeros((K, W, 3 * n, 1 + nz))
        white, by_z = np.empty((N, K, W, n)), np.empty((N, K, W, n, nz))
        states = np.empty((N + 1, K, W, 2 * n))
        states[0] = trajectory[0]
        log_determinant = np.zeros(K)
        for k in range(N):
            transition[..., : 2 * n, : 2 * n] = A[k]
            transition[..., : 2 * n, 2 * n :] = B[k]
            X = transition @ X
            X[..., : 2 * n, 0] += defects[k]
            X[..., : 2 * n, 1:] += slopes[k]
            P = transition @ P @ np.swapaxes(transition, 2, 3) + Q
            try:
                L = np.linalg.cholesky(P[..., :n, :n] + R)
            except np.linalg.LinAlgError:
                raise CalibrationError(
                    "the model runs away from the recordings within a step, for the parameters that fit their torques "
                    "best: another machine, other units, or ranges of the parameters that are too wide"
                ) from None
            # Of the innovations: measured - expected.
            rest = -X[..., :n, :]
            rest[..., 0] += q[k + 1] - trajectory[k + 1, :, :n]
            solved = np.linalg.solve(L, np.concatenate([rest, P[..., :n, :]], axis=3))
            innovation, gain = solved[..., : 1 + nz], solved[..., 1 + nz :]
            transposed = np.swapaxes(gain, 2, 3)
            X = X + transposed @ innovation
            # Joseph's form: P stays positive, also where positions are all but exact.
            K_gain = np.swapaxes(np.linalg.solve(np.swapaxes(L, 2, 3), gain), 2, 3)
            update = np.broadcast_to(np.eye(3 * n), P.shape).copy()
            update[..., :n] -= K_gain
            P = update @ P @ np.swapaxes(update, 2, 3) + K_gain @ R @ np.swapaxes(K_gain, 2, 3)
            white[k], by_z[k] = innovation[..., 0], innovation[..., 1:]
            log_determinant += 2.0 * np.log(np.einsum("kwii->kwi", L)).sum(axis=(1, 2))
            states[k + 1] = trajectory[k + 1] + X[..., : 2 * n, 0]
        return _Filtered(white, by_z, log_determinant, states)

    def likeliest_noise(self, z: Array, guess: Noise) -> Noise:
        """Return the noise of the largest likelihood, in some segments all over the recordings."""
        n = self.model.nq
        selection = slice(0, None, max(self.count // _NOISE_SEGMENTS, 1))
        model = self.linearized(z)
        model = model._replace(slopes=model.slopes[..., :0])

        def noise_of(logs: Array) -> Noise:
            return Noise(np.exp(logs[:n]), np.exp(logs[n : 2 * n]), float(np.exp(logs[-1])))

        def unlikelihood(logs: Array) -> tuple[float, Array]:
            # With its differences by each number: side by side, they cost little more than one of them.
            points = np.vstack([logs, logs + _DIFFERENCE * np.eye(len(logs))])
            filtered = self._filtered([noise_of(point) for point in points], model, selection)
            values = (filtered.white**2).sum(axis=(0, 2, 3)) + filtered.log_determinant
            return float(values[0]), (values[1:] - values[0]) / _DIFFERENCE

        start = np.log([*guess.measurement, *guess.torque, guess.correlation_time])
        widths = np.array([3.0] * n + [6.0] * n)
        bounds = [(max(s - w, np.log(_LEAST)), s + w) for s, w in zip(start[:-1], widths, strict=True)]
        # Correlated for a period at least, for a segment at most.
        bounds.append((np.log(self.period), np.log(self.period * self.steps)))
        options = {"maxiter": 15}
        fit = scipy.optimize.minimize(unlikelihood, start, jac=True, method="L-BFGS-B", bounds=bounds, options=options)
        return noise_of(fit.x)


def _diagonal(values: Array) -> Array:
    """Return diagonal matrices (..., n, n) of the values (..., n)."""
    return np.asarray(values[..., np.newaxis] * np.eye(values.shape[-1]))
