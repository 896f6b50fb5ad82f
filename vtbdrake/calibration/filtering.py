r"""Filter error: how well a model predicts the next position, given all before, and how that depends on its parameters.

A simulation that runs along a whole recording drifts, and one disturbance of the torques that no log contains makes
its estimates wrong. So the model is run in a Kalman filter (R. E. Maine and K. W. Iliff, "Formulation and
implementation of a practical algorithm for parameter estimation with process and measurement noise", SIAM J. Appl.
Math. 41, 1981). Its state is [q; v; d], with the torque disturbances

    d_(k+1) = r d_k + sqrt(1 - r^2) D w_k,    r = exp(-period / T),

of the deviations D by joint and the correlation time T, and the positions are measured with the deviations s. D, T and
s have the largest likelihood. The filter is linear, about a trajectory x that is improved in each iteration:
its innovations, and their derivatives by the parameters, follow from the defects f(x_k) - x_(k+1).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil, inf
from typing import NamedTuple

import numpy as np
import scipy

from vtbdrake.calibration.joint_model import CalibrationError, JointModel, at_samples
from vtbdrake.calibration.joint_recording import FEWEST_SAMPLES, JointRecording
from vtbdrake.common.arrays import Array

# How far the period of a recording may differ from a multiple of the plant's step, as a share of that step.
_ON_GRID = 0.05
# Largest number of iterations of the search for the likeliest noise.
_SCORINGS = 30
# Least gain of log L in an iteration that is worth another one.
_GAIN = 0.1
# Largest change of the logarithm of a noise in one iteration.
_FARTHEST = 2.0
_LEAST = 1e-9  # of a deviation, in rad or m
# Steps of Runge and Kutta resolve friction near rest up to this product of step and sharpness; 2.8 is unstable.
_RESOLVED = 1.0
# Largest number of such steps within a period.
_MOST_SUBSTEPS = 64


@dataclass(frozen=True)
class Noise:
    """The noise of a recording.

    Attributes:
        measurement: Deviation of the positions, (nq,), in rad or m.
        torque: Deviation of the torque disturbance, (nq,), in N m or N.
        correlation_time: Correlation time of the disturbance, in s.
    """

    measurement: Array
    torque: Array
    correlation_time: float

    @classmethod
    def guess(cls, recordings: Sequence[JointRecording], unexplained: Array) -> Noise:
        """Return the noise to start with: fourth differences are mostly noise, unexplained torques are disturbances.

        Args:
            recordings: The recordings; all their positions are used.
            unexplained: Torques that the model does not explain, (n, nq), in N m or N.
        """
        differences = np.concatenate([np.diff(recording.q, 4, axis=0) for recording in recordings])
        measurement = np.sqrt(np.mean(differences**2, axis=0) / 70.0)
        return cls(np.maximum(measurement, _LEAST), np.maximum(np.std(unexplained, axis=0), 1e-6), 0.05)

    def check(self, joints: int) -> None:
        """Raise an error for a noise that a recording with this number of joints cannot have."""
        sizes = {np.shape(self.measurement), np.shape(self.torque)}
        if sizes != {(joints,)} or not (
            np.min(self.measurement) > 0.0 and np.min(self.torque) >= 0.0 and 0.0 < self.correlation_time < inf
        ):
            raise CalibrationError(
                f"a noise has, for each of {joints} joints, positive deviations of the positions, none below 0 of the "
                f"torques, and a positive correlation time, not {self}"
            )

    @property
    def logs(self) -> Array:
        """Return the logarithms of all numbers in their order, (2 nq + 1,)."""
        return np.log([*self.measurement, *self.torque, self.correlation_time])

    @classmethod
    def of_logs(cls, logs: Array) -> Noise:
        """Return the noise of logarithms; the inverse of `logs`."""
        n = len(logs) // 2
        return cls(np.exp(logs[:n]), np.exp(logs[n : 2 * n]), float(np.exp(logs[-1])))


class Likelihood(NamedTuple):
    """The likelihood L of a noise; derivatives are those by its `Noise.logs`.

    Attributes:
        log: log L, but for a constant.
        gradient: Gradient of log L, (2 nq + 1,).
        information: Information in the recordings, (2 nq + 1, 2 nq + 1).
    """

    log: float
    gradient: Array
    information: Array


class Linearization(NamedTuple):
    """The model along the trajectory of W segments of N steps.

    Attributes:
        A: By the state, (N, W, 2 nq, 2 nq).
        B: By a torque at each joint, (N, W, 2 nq, nq).
        defects: f(x_k) - x_(k+1), (N, W, 2 nq).
        slopes: Derivatives of the defects by the parameters, (N, W, 2 nq, nz).
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
        states: The filtered states, (N + 1, W, 2 nq).
    """

    white: Array
    slopes: Array
    states: Array


class _Pass(NamedTuple):
    """The filter along W segments of N steps.

    Attributes:
        rest: Measured - expected positions, and their derivatives by the parameters, (N, W, nq, 1 + nz).
        whitening: L^-1 of their covariance L L', (N, W, nq, nq).
        gain: Kalman gain, (N, W, 3 nq, nq).
        means: The state after the measurement, relative to the trajectory, (N, W, 3 nq).
        shared: Covariance of the state before the measurement with the disturbances, (N, W, 3 nq, nq).
    """

    rest: Array
    whitening: Array
    gain: Array
    means: Array
    shared: Array


class _Score(NamedTuple):
    """The derivatives r by means and (r r' - M) / 2 by covariances of log L, along W segments of N steps.

    Attributes:
        score: The inverse of the positions' covariance times measured - expected positions, (N, W, nq, 1).
        u, D: As r and M, by each measurement, (N, W, nq, 1) and (N, W, nq, nq).
        r_before: r by each state before its measurement, (N, W, 3 nq, 1).
        M_before: The last nq columns of M by this state, (N, W, 3 nq, nq).
        r, M: By the state at the start, (W, 3 nq, 1) and (W, 3 nq, 3 nq).
    """

    score: Array
    u: Array
    D: Array
    r_before: Array
    M_before: Array
    r: Array
    M: Array


class Segments:
    """Recordings in segments of equal length.

    Args:
        model: The model.
        recordings: The recordings, with the same period.
        duration: Duration of a segment, in s.
        most: About the largest number of segments: then some all over the recordings are taken.

    Attributes:
        model: The model.
        period: The time between two positions, in s.
        steps: Number N of steps of a segment.
        count: Number W of segments.
        sources: The recording of each segment, (W,).
        times: Times of the trajectory, (N + 1, W), in s.
        trajectory: The trajectory x, (N + 1, W, 2 nq).
    """

    def __init__(
        self, model: JointModel, recordings: Sequence[JointRecording], *, duration: float, most: int | None = None
    ) -> None:
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
        self.steps = min(max(round(duration / self.period), FEWEST_SAMPLES), shortest)
        self._recordings = tuple(recordings)
        pieces = [
            (i, slice(k, k + self.steps + 1))
            for i, recording in enumerate(recordings)
            for k in range(0, len(recording.times) - self.steps, self.steps)
        ]
        self._pieces = pieces[:: ceil(len(pieces) / (most or len(pieces)))]
        self.count = len(self._pieces)
        self.sources = np.array([i for i, _ in self._pieces])
        self.times = np.stack([recordings[i].times[span] for i, span in self._pieces], axis=1)
        smoothed = [np.hstack(recording.smoothed()[:2]) for recording in recordings]
        self.trajectory = np.stack([smoothed[i][span] for i, span in self._pieces], axis=1)
        self._q = np.stack([recordings[i].q[span] for i, span in self._pieces], axis=1)
        self._steps = np.diff(self.times, axis=0)
        self._step = at_samples(model.step_with_jacobians, self.steps * self.count)

    def substeps(self, z: Array) -> int:
        """Return the number of steps within a period: a discrete plant's, or enough for friction near rest.

        Args:
            z: The parameters, (nz,).

        Raises:
            CalibrationError: The friction of a joint needs too many.
        """
        model = self.model
        if model.step_size > 0.0 or not model.drives:
            return self._substeps
        sharpness = np.asarray(model.sharpness(self.trajectory[..., : model.nq].mean(axis=(0, 1)), z)).ravel()
        ratios = self.period * sharpness
        if ratios.max(initial=0.0) > _RESOLVED * _MOST_SUBSTEPS:
            name, ratio = model.actuated_names[int(ratios.argmax())], ratios.max()
            raise CalibrationError(
                f"the friction of {name} is too sharp near rest for a continuous plant: T Fc / (I v_c) is {ratio:.2g}, "
                f"and at most {_RESOLVED * _MOST_SUBSTEPS:g} is resolved: make coulomb_velocity "
                f"{ratio / (_RESOLVED * _MOST_SUBSTEPS):.2g} times larger, or take a discrete plant (time_step)"
            )
        self._substeps = max(self._substeps, ceil(ratios.max(initial=0.0) / _RESOLVED))
        return self._substeps

    def linearized(self, z: Array) -> Linearization:
        """Return the model along the trajectory."""
        motors = [self.model.motor(recording.times, recording.u, z) for recording in self._recordings]
        m = np.stack([motors[i][0][span][:-1] for i, span in self._pieces], axis=1)
        by = np.stack([motors[i][1][span][:-1] for i, span in self._pieces], axis=1)
        following, A, by_m, slopes = self._stepped(m, z)
        for k, index in enumerate(self.model.drive_parameters):
            slopes[..., index] += np.einsum("twij,twj->twi", by_m, by[:, :, k])
        return Linearization(A, by_m @ self.model.selection.T, following - self.trajectory[1:], slopes)

    def _stepped(self, m: Array, z: Array) -> tuple[Array, Array, Array, Array]:
        """Return the states a period later, and their derivatives by state, motors' torques m and parameters."""
        n, nu = self.model.nq, self.model.nu
        count, substeps = self.steps * self.count, self.substeps(z)
        h = np.full_like(self._steps, self.model.step_size) if self.model.step_size > 0.0 else self._steps / substeps
        x, derivatives = self.trajectory[:-1], None
        for _ in range(substeps):
            arguments = (each.reshape(count, -1) for each in (x, m, h, np.tile(z, (count, 1))))
            parts = self._step(*arguments).reshape(self.steps, self.count, 2 * n, -1)
            x, by_x, direct = parts[..., 0], parts[..., 1 : 1 + 2 * n], parts[..., 1 + 2 * n :]
            if derivatives is None:
                derivatives = parts[..., 1:].copy()
            else:
                derivatives = by_x @ derivatives
                derivatives[..., 2 * n :] += direct
        assert derivatives is not None
        A, by_m, slopes = np.split(derivatives, [2 * n, 2 * n + nu], axis=3)
        return x, A, by_m, slopes.copy()

    def torques(self, z: Array) -> tuple[Array, Array]:
        """Return the motors' torques and the friction of the drives at the joints, (N, W, nq) each, in N m or N."""
        motors = [self.model.motor(recording.times, recording.u, z)[0] for recording in self._recordings]
        m = np.stack([motors[i][span][:-1] for i, span in self._pieces], axis=1)
        v = self.trajectory[:-1, :, self.model.nq :].reshape(-1, self.model.nq)
        arguments = v.T, m.reshape(len(v), -1).T, np.tile(z[:, np.newaxis], (1, len(v)))
        friction = np.asarray(self.model.friction.map(len(v))(*arguments)).T
        return m @ self.model.selection.T, friction.reshape(*m.shape[:2], self.model.nq)

    def innovations(self, noise: Noise, model: Linearization) -> Innovations:
        """Return the innovations of all segments.

        Args:
            noise: The noise of the recordings.
            model: The model along the trajectory; its slopes give the derivatives of the innovations.
        """
        passed = self._filtered(noise, model)
        white = passed.whitening @ passed.rest
        states = self.trajectory.copy()
        states[1:] += passed.means[:, :, : states.shape[2]]
        return Innovations(white[..., 0], white[..., 1:], states)

    def _filtered(self, noise: Noise, model: Linearization) -> _Pass:
        n = self.model.nq
        A, B, defects, slopes = model
        N, W, nz = len(A), A.shape[1], slopes.shape[3]
        F, Q, P = self._start(noise, W)
        variance = noise.measurement**2
        # The state, relative to the trajectory, and its derivatives by the parameters, side by side.
        X = np.zeros((W, 3 * n, 1 + nz))
        rest, means, whitening = np.zeros((N, W, n, 1 + nz)), np.empty((N, W, 3 * n)), np.empty((N, W, n, n))
        rest[..., 0] = (self._q - self.trajectory[:, :, :n])[1:]
        gain, shared = np.empty((N, W, 3 * n, n)), np.empty((N, W, 3 * n, n))
        for k in range(N):
            F[:, : 2 * n, : 2 * n], F[:, : 2 * n, 2 * n :] = A[k], B[k]
            X = F @ X
            X[:, : 2 * n, 0] += defects[k]
            X[:, : 2 * n, 1:] += slopes[k]
            P = F @ P @ F.mT + Q
            shared[k] = P[:, :, 2 * n :]
            try:
                inverse = whitening[k] = np.linalg.inv(np.linalg.cholesky(P[:, :n, :n] + np.diag(variance)))
            except np.linalg.LinAlgError:
                raise CalibrationError(
                    "the model runs away from the recordings within a step, for the parameters that fit their torques "
                    "best: another machine, other units, or ranges of the parameters that are too wide"
                ) from None
            K = gain[k] = P[:, :, :n] @ inverse.mT @ inverse
            rest[k] -= X[:, :n]
            X += K @ rest[k]
            means[k] = X[:, :, 0]
            # Joseph's form: P stays positive, also where positions are all but exact.
            P -= K @ P[:, :n]
            P += (K * variance - P[:, :, :n]) @ K.mT
        return _Pass(rest, whitening, gain, means, shared)

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

    def likelihood(self, noise: Noise, model: Linearization) -> Likelihood:
        """Return the likelihood of a noise.

        One pass backwards gives the derivatives r and (r r' - M) / 2 of log L by means and covariances (S. J. Koopman
        and N. Shephard, "Exact score for time series models in state space form", Biometrika 79, 1992). With V the
        covariance of all positions, e their deviation from the mean, and V_i the derivative of V by a number of the
        noise, the filter whitens V_i V^-1 e, too. The products of these columns are twice the average of the
        observed and the expected information (A. R. Gilmour, R. Thompson and B. R. Cullis, "Average information
        REML", Biometrics 51, 1995).

        Args:
            noise: The noise, whose numbers the derivatives are by.
            model: The model along the trajectory; its slopes are not used.
        """
        n = self.model.nq
        model = model._replace(slopes=model.slopes[..., :0])
        forwards = self._filtered(noise, model)
        backwards = self._smoothed(noise, model, forwards)
        columns = self._changed_errors(noise, model, forwards, backwards)
        white = (forwards.whitening @ columns).reshape(-1, 2 * n + 1)
        distance = (forwards.rest * backwards.score).sum()
        log = float(np.log(np.einsum("kwii->kwi", forwards.whitening)).sum() - 0.5 * distance)
        return Likelihood(log, self._gradient(noise, forwards, backwards), 0.5 * white.T @ white)

    def _smoothed(self, noise: Noise, model: Linearization, forwards: _Pass) -> _Score:
        """Return the derivatives of log L by means and covariances, from a pass backwards."""
        n = self.model.nq
        information = forwards.whitening.mT @ forwards.whitening
        score = information @ forwards.rest
        N, W = model.A.shape[:2]
        F, _, _ = self._start(noise, W)
        r, M = np.zeros((W, 3 * n, 1)), np.zeros_like(F)
        u, D = np.empty_like(score), np.empty_like(information)
        r_before, M_before = np.empty((N, W, 3 * n, 1)), np.empty((N, W, 3 * n, n))
        for k in range(N - 1, -1, -1):
            K = forwards.gain[k]
            KM = K.mT @ M
            u[k] = score[k] - K.mT @ r
            D[k] = information[k] + KM @ K
            r[:, :n] += u[k]
            M[:, :n] -= KM
            M[:, :, :n] -= M @ K
            M[:, :n, :n] += information[k]
            r_before[k], M_before[k] = r, M[:, :, 2 * n :]
            F[:, : 2 * n, : 2 * n], F[:, : 2 * n, 2 * n :] = model.A[k], model.B[k]
            r, M = F.mT @ r, F.mT @ M @ F
        return _Score(score, u, D, r_before, M_before, r, M)

    def _gradient(self, noise: Noise, forwards: _Pass, backwards: _Score) -> Array:
        """Return the derivatives of log L by the logarithms of the noise's numbers, shape (2 n + 1,)."""
        n = self.model.nq
        means, shared = forwards.means, forwards.shared
        _, u, D, r_before, M_before, r, M = backwards
        # Derivatives by the variances of measurement, start and the noise that drives the disturbances.
        by_R, by_start = (
            0.5 * (vector[..., 0] ** 2 - np.einsum("...ii->...i", matrix)).reshape(-1, vector.shape[-2]).sum(axis=0)
            for vector, matrix in ((u, D), (r, M))
        )
        slope = r_before @ r_before[:, :, 2 * n :].mT - M_before
        by_Q = 0.5 * np.einsum("kwii->i", slope[:, :, 2 * n :])
        decay, variance, torque = np.exp(-self.period / noise.correlation_time), noise.measurement**2, noise.torque**2
        # The covariance before the measurement holds decay times that by which the slope is multiplied, and Q.
        by_decay = decay * np.einsum("kwi,kwi->", r_before[1:, :, 2 * n :, 0], means[:-1, :, 2 * n :])
        by_decay += np.einsum("kwij,kwij->", slope, shared) - 2.0 * float(torque @ by_Q)
        return np.concatenate(
            [
                2.0 * variance * (by_R + by_start[:n] + by_start[n : 2 * n] / self.period**2),
                2.0 * torque * ((1.0 - decay**2) * by_Q + by_start[2 * n :]),
                [by_decay * self.period / noise.correlation_time],
            ]
        )

    def _changed_errors(self, noise: Noise, model: Linearization, forwards: _Pass, backwards: _Score) -> Array:
        """Return V_i V^-1 e, filtered, for the logarithm i of each number of the noise, shape (N, W, n, 2 n + 1)."""
        n = self.model.nq
        A, B = model.A, model.B
        N, W = A.shape[:2]
        F, _, _ = self._start(noise, W)
        u, r, r_before = backwards.u, backwards.r, backwards.r_before
        variance, torque = noise.measurement**2, noise.torque**2
        # Positions and velocities at the start, disturbances in each step, and errors of measurement.
        joints = np.arange(n)
        X, columns = np.zeros((W, 3 * n, 2 * n + 1)), np.zeros((N, W, n, 2 * n + 1))
        X[:, joints, joints] = -2.0 * variance * r[:, :n, 0]
        X[:, n + joints, joints] = -2.0 * variance * r[:, n : 2 * n, 0] / self.period**2
        columns[..., joints, joints] = 2.0 * variance * u[..., 0]
        lags = scipy.linalg.toeplitz(np.arange(N)) * self.period / noise.correlation_time
        forces = torque * (B.mT @ r_before[:, :, : 2 * n])[..., 0]
        by_torque = 2.0 * np.tensordot(np.exp(-lags), forces, 1)
        by_time = np.tensordot(lags * np.exp(-lags), forces, 1)
        for k in range(N):
            F[:, : 2 * n, : 2 * n], F[:, : 2 * n, 2 * n :] = A[k], B[k]
            X = F @ X
            X[:, : 2 * n, n : 2 * n] -= B[k] * by_torque[k, :, np.newaxis]
            X[:, : 2 * n, 2 * n :] -= B[k] @ by_time[k, :, :, np.newaxis]
            columns[k] -= X[:, :n]
            X += forwards.gain[k] @ columns[k]
        return columns

    def likeliest_noise(self, model: Linearization, guess: Noise) -> Noise:
        """Return the noise of the largest likelihood, by Fisher scoring (with the average information).

        Args:
            model: The model along the trajectory.
            guess: The noise to start with.
        """
        n = self.model.nq
        # Correlated for a period at least, for a segment at most.
        lower = np.log([_LEAST] * (2 * n) + [self.period])
        upper = np.array([inf] * (2 * n) + [np.log(self.period * self.steps)])
        logs = np.clip(guess.logs, lower, upper)
        best = self.likelihood(Noise.of_logs(logs), model)
        for _ in range(_SCORINGS):
            g = best.gradient
            free = ~(((logs <= lower) & (g < 0.0)) | ((logs >= upper) & (g > 0.0)))
            step = np.zeros(2 * n + 1)
            # A number that the recordings hardly tell moves little: as if it were known to a factor of e.
            H = best.information[np.ix_(free, free)] + np.eye(free.sum())
            step[free] = np.linalg.solve(H, g[free])
            step = np.clip(logs + step / max(1.0, abs(step).max() / _FARTHEST), lower, upper) - logs
            if g @ step < _GAIN:
                break
            trial = self.likelihood(Noise.of_logs(logs + step), model)
            while trial.log < best.log:
                step = 0.5 * step
                if g @ step < _GAIN:
                    return Noise.of_logs(logs)
                trial = self.likelihood(Noise.of_logs(logs + step), model)
            logs, best = logs + step, trial
        return Noise.of_logs(logs)
