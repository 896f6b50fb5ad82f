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
from typing import Any, NamedTuple

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


class _Update(NamedTuple):
    """What the filter has done with a measurement, for W segments.

    Attributes:
        gain: Kalman gain, (W, 3 nq, nq).
        inverse: L^-1 of the covariance L L' of the innovations, (W, nq, nq).
        white: The whitened innovations, (W, nq).
        mean: The state after it, relative to the trajectory, (W, 3 nq).
        P: Its covariance, (W, 3 nq, 3 nq).
    """

    gain: Array
    inverse: Array
    white: Array
    mean: Array
    P: Array


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
        self._function = self._compile().map(self.steps * self.count)

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
        n, nu = self.model.nq, self.model.nu
        motors = [self.model.motor(recording.times, recording.u, z) for recording in self._recordings]
        m = np.stack([motors[i][0][span][:-1] for i, span in self._pieces], axis=1)
        by = np.stack([motors[i][1][span][:-1] for i, span in self._pieces], axis=1)
        count = self.steps * self.count
        v = self.trajectory[:, :, n:]
        change = np.diff(v, axis=0) / self._substeps
        change = np.concatenate([change[:1], change[:-1]])  # That before the first step is about that of the first.
        # CasADi's columns are rows here.
        columns = (self.trajectory[:-1], change, m, self._h, np.tile(z, (count, 1)))
        arguments = [np.ascontiguousarray(argument).reshape(-1) for argument in columns]
        table = np.empty((count, 1 + 2 * n + nu + len(z), 2 * n))
        buffer: Any  # whose stubs ask for a size that it does not take
        buffer, evaluate = self._function.buffer()
        for i, argument in enumerate(arguments):
            buffer.set_arg(i, argument.data)
        buffer.set_res(0, table.reshape(-1).data)
        evaluate()
        parts = table.swapaxes(1, 2).reshape(self.steps, self.count, 2 * n, -1)
        following, A, by_m, slopes = np.split(parts, [1, 1 + 2 * n, 1 + 2 * n + nu], axis=3)
        for k, index in enumerate(self.model.drive_parameters):
            slopes[..., index] += np.einsum("twij,twj->twi", by_m, by[:, :, k])
        return Linearization(A, by_m @ self.model.selection.T, following[..., 0] - self.trajectory[1:], slopes.copy())

    def innovations(
        self,
        noise: Noise,
        model: Linearization,
        *,
        selection: slice = slice(None),
        updates: list[_Update] | None = None,
    ) -> Innovations:
        """Return the innovations of the chosen segments; each update is appended to ``updates``, if that is given."""
        n = self.model.nq
        A, B, defects, slopes = (part[:, selection] for part in model)
        trajectory, q = self.trajectory[:, selection], self._q[:, selection]
        N, W, nz = len(A), A.shape[1], slopes.shape[3]
        F, Q, P = self._start(noise, W)
        variance = noise.measurement**2
        # The state, relative to the trajectory, and its derivatives by the parameters, side by side.
        X = np.zeros((W, 3 * n, 1 + nz))
        white, by_z = np.empty((N, W, n)), np.empty((N, W, n, nz))
        states = np.empty((N + 1, W, 2 * n))
        states[0] = trajectory[0]
        log_determinant = 0.0
        for k in range(N):
            F[:, : 2 * n, : 2 * n], F[:, : 2 * n, 2 * n :] = A[k], B[k]
            X = F @ X
            X[:, : 2 * n, 0] += defects[k]
            X[:, : 2 * n, 1:] += slopes[k]
            P = F @ P @ F.mT + Q
            try:
                L = np.linalg.cholesky(P[:, :n, :n] + np.diag(variance))
            except np.linalg.LinAlgError:
                raise CalibrationError(
                    "the model runs away from the recordings within a step, for the parameters that fit their torques "
                    "best: another machine, other units, or ranges of the parameters that are too wide"
                ) from None
            inverse = np.linalg.inv(L)
            # Of the innovations: measured - expected.
            rest = -X[:, :n]
            rest[:, :, 0] += q[k + 1] - trajectory[k + 1, :, :n]
            innovation = inverse @ rest
            gain = P[:, :, :n] @ inverse.mT @ inverse
            X += gain @ rest
            # Joseph's form: P stays positive, also where positions are all but exact.
            P -= gain @ P[:, :n]
            P += (gain * variance - P[:, :, :n]) @ gain.mT
            white[k], by_z[k] = innovation[:, :, 0], innovation[:, :, 1:]
            log_determinant += 2.0 * float(np.log(np.einsum("wii->wi", L)).sum())
            states[k + 1] = trajectory[k + 1] + X[:, : 2 * n, 0]
            if updates is not None:
                updates.append(_Update(gain, inverse, white[k], X[:, :, 0].copy(), P.copy()))
        return Innovations(white, by_z, log_determinant, states)

    def _start(self, noise: Noise, count: int) -> tuple[Array, Array, Array]:
        """Return the transition F (W, ...) but for A and B, its noise Q and the covariance P (W, ...) at the start."""
        n = self.model.nq
        decay = np.exp(-self.period / noise.correlation_time)
        F = np.zeros((count, 3 * n, 3 * n))
        F[:, 2 * n :, 2 * n :] = decay * np.eye(n)
        Q = np.diag(np.concatenate([np.zeros(2 * n), (1.0 - decay**2) * noise.torque**2]))
        # A smoothed velocity is about as good as a difference over a few samples.
        variances = [noise.measurement**2, (noise.measurement / self.period) ** 2, noise.torque**2]
        return F, Q, np.tile(np.diag(np.concatenate(variances)), (count, 1, 1))

    def unlikelihood(
        self, noise: Noise, model: Linearization, *, selection: slice = slice(None)
    ) -> tuple[float, Array]:
        """Return -2 log of the likelihood but for a constant, and its gradient (2 nq + 1,).

        The gradient is that by the logarithms of the noise's deviations of measurement and torque, and of its
        correlation time: one pass backwards gives the derivatives r and (r r' - N) / 2 of the likelihood by means and
        covariances (S. J. Koopman and N. Shephard, "Exact score for time series models in state space form",
        Biometrika 79, 1992).
        """
        n, updates = self.model.nq, list[_Update]()
        model = model._replace(slopes=model.slopes[..., :0])
        innovations = self.innovations(noise, model, selection=selection, updates=updates)
        A, B = model.A[:, selection], model.B[:, selection]
        F, _, P_start = self._start(noise, A.shape[1])
        r, N = np.zeros(F.shape[:2]), np.zeros_like(F)
        by_R, by_Q, by_decay = np.zeros(n), np.zeros(n), 0.0
        start = _Update(*(np.empty(0),) * 3, np.zeros(F.shape[:2]), P_start)
        for k in range(len(A) - 1, -1, -1):
            gain, inverse, white, _, _ = updates[k]
            information = inverse.mT @ inverse
            score = np.einsum("wji,wj->wi", inverse, white)
            u = score - np.einsum("wji,wj->wi", gain, r)
            by_R += 0.5 * (u**2 - np.einsum("wii->wi", information + gain.mT @ N @ gain)).sum(axis=0)
            # Before the measurement.
            r[:, :n] += u
            N[:, :n] -= gain.mT @ N
            N[:, :, :n] -= N @ gain
            N[:, :n, :n] += information
            slope = r[:, 2 * n :, np.newaxis] * r[:, np.newaxis] - N[:, 2 * n :]
            by_Q += 0.5 * np.einsum("wii->i", slope[:, :, 2 * n :])
            # Before the step.
            F[:, : 2 * n, : 2 * n], F[:, : 2 * n, 2 * n :] = A[k], B[k]
            before = updates[k - 1] if k else start
            by_decay += np.einsum("wi,wi->", r[:, 2 * n :], before.mean[:, 2 * n :])
            by_decay += np.einsum("wij,wji->", slope, F @ before.P[:, :, 2 * n :])
            r, N = np.einsum("wji,wj->wi", F, r), F.mT @ N @ F
        by_start = 0.5 * (r**2 - np.einsum("wii->wi", N)).sum(axis=0)
        decay, torque = np.exp(-self.period / noise.correlation_time), noise.torque**2
        by_decay -= 2.0 * decay * float(torque @ by_Q)
        gradient = np.concatenate(
            [
                2.0 * noise.measurement**2 * (by_R + by_start[:n] + by_start[n : 2 * n] / self.period**2),
                2.0 * torque * ((1.0 - decay**2) * by_Q + by_start[2 * n :]),
                [by_decay * decay * self.period / noise.correlation_time],
            ]
        )
        return float((innovations.white**2).sum()) + innovations.log_determinant, -2.0 * gradient

    def likeliest_noise(self, z: Array, guess: Noise) -> Noise:
        """Return the noise of the largest likelihood, in some segments all over the recordings."""
        n = self.model.nq
        selection = slice(0, None, max(self.count // _NOISE_SEGMENTS, 1))
        model = self.linearized(z)

        def noise_of(logs: Array) -> Noise:
            return Noise(np.exp(logs[:n]), np.exp(logs[n : 2 * n]), float(np.exp(logs[-1])))

        def unlikelihood(logs: Array) -> tuple[float, Array]:
            return self.unlikelihood(noise_of(logs), model, selection=selection)

        start = np.log([*guess.measurement, *guess.torque, guess.correlation_time])
        widths = np.array([3.0] * n + [6.0] * n)
        bounds = [(max(s - w, np.log(_LEAST)), s + w) for s, w in zip(start[:-1], widths, strict=True)]
        # Correlated for a period at least, for a segment at most.
        bounds.append((np.log(self.period), np.log(self.period * self.steps)))
        options = {"maxiter": 15}
        fit = scipy.optimize.minimize(unlikelihood, start, jac=True, method="L-BFGS-B", bounds=bounds, options=options)
        return noise_of(fit.x)
