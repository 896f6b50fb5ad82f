"""Inverse dynamics: which torques the model needs for the motion of a recording, and how well the recorded ones fit."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import casadi
import numpy as np
from numpy.typing import NDArray

from vtbdrake.calibration.joint_model import JointModel, at_samples
from vtbdrake.calibration.joint_recording import JointRecording
from vtbdrake.common.arrays import Array

# A direction in which the recordings leave more than this, in units of the parameters' scales, is not determined.
UNDETERMINED = 0.5
# Largest number of iterations.
_ITERATIONS = 25
# The last iteration moves the parameters by less than this, in units of their scales.
_CONVERGED = 1e-3
# Joints are loaded whose torques are at least this share of the largest ones, as root mean squares.
_LOADED = 0.2
# Number of samples left out at each end of a recording, where smoothed positions are bad.
_ENDS = 15
# Between the ends, every third sample is taken.
_STRIDE = 3


class TorqueFit(NamedTuple):
    """Parameters by which inverse dynamics explain the torques of recordings.

    Attributes:
        z: The parameters.
        unexplained: What is left of the torques, (n, nq).
        share: The share of the power of the torques that is not explained, the mean over the joints; about 1 of
            nothing, 0 of everything.
        loaded_share: The same without joints whose torques are small beside the largest ones: these may all be lost in
            the friction of a joint that hardly moves.
    """

    z: Array
    unexplained: Array
    share: float
    loaded_share: float


class InverseDynamics:
    """Fits torques, with one model, to any recordings.

    Args:
        model: The model.
    """

    def __init__(self, model: JointModel) -> None:
        self._model = model
        symbols = model.unexplained.sx_in()
        slope = casadi.densify(casadi.jacobian(model.unexplained(*symbols), symbols[-1]))
        self._slope = casadi.Function("slope", symbols, [slope])

    def fit(self, recordings: Sequence[JointRecording], *, start: Array, most: int | None = None) -> TorqueFit:
        """Return the fit, within the ranges of the parameters.

        Args:
            recordings: The recordings.
            start: Where the parameters begin.
            most: About the largest number of samples to use; None: all.
        """
        model, scales = self._model, self._model.scales
        samples = sum(len(recording.times) for recording in recordings)
        stride = _STRIDE if most is None else max(_STRIDE, samples // most)
        rows = [slice(_ENDS, len(recording.times) - _ENDS, stride) for recording in recordings]
        smoothed = [[part[span] for part in r.smoothed()] for r, span in zip(recordings, rows, strict=True)]
        Q, V, A = (np.concatenate(parts) for parts in zip(*smoothed, strict=True))
        n = len(Q)
        residual, slope = at_samples(model.unexplained, n), at_samples(self._slope, n)
        selection = model.selection

        def motors(at: Array) -> tuple[Array, Array]:
            torques, by = zip(*(model.motor(r.times, r.u, at) for r in recordings), strict=True)
            m = np.concatenate([t[span] for t, span in zip(torques, rows, strict=True)])
            return m, np.concatenate([d[span] for d, span in zip(by, rows, strict=True)])

        def unexplained(at: Array) -> tuple[Array, Array, Array]:
            m, dm = motors(at) if model.drive_parameters else driven
            return residual(Q, V, A, m, np.tile(at, (n, 1)))[..., 0], m, dm

        def slopes_of(at: Array, m: Array, dm: Array) -> Array:
            J = slope(Q, V, A, m, np.tile(at, (n, 1)))
            for k, index in enumerate(model.drive_parameters):
                J[:, :, index] -= dm[:, k] @ selection.T
            return J

        z = np.array(start, dtype=float)
        driven = motors(z)
        e, m, dm = unexplained(z)
        deviation = np.maximum(e.std(axis=0), 1e-9)
        for _ in range(_ITERATIONS):
            white, J = (e / deviation).ravel(), slopes_of(z, m, dm)
            slopes = (J / deviation[:, np.newaxis]).reshape(-1, len(z)) * scales
            step = bounded_step(model, z, slopes.T @ slopes, slopes.T @ white)
            for _ in range(12):
                trial = np.clip(z - step, model.lower, model.upper)
                e_trial, m_trial, dm_trial = unexplained(trial)
                if ((e_trial / deviation) ** 2).sum() <= (white**2).sum():
                    break
                step = 0.5 * step
            else:
                break
            moved, z, e, m, dm = abs(trial - z) / scales, trial, e_trial, m_trial, dm_trial
            deviation = np.maximum(e.std(axis=0), 1e-9)
            if moved.max() < _CONVERGED:
                break
        # By joint, as a wrist's torques are small beside a shoulder's; a passive joint has the torques of its motion.
        acting = m @ selection.T
        power = np.maximum((acting**2).mean(axis=0), ((e + acting) ** 2).mean(axis=0))
        shares = (e**2).mean(axis=0) / np.maximum(power, 1e-12)
        is_loaded = power >= _LOADED**2 * power.max()
        return TorqueFit(z, e, float(shares.mean()), float(shares[is_loaded].mean()))

    def torque_factors(self, recordings: Sequence[JointRecording], z: Array) -> Array:
        """Return by which factor the torques of each actuator would explain the motion best, (nu,).

        Args:
            recordings: The recordings.
            z: The parameters, (nz,).
        """
        parts = [self.torques(recording, z) for recording in recordings]
        tau, needed = (
            np.concatenate(columns) @ self._model.selection for columns in list(zip(*parts, strict=True))[1:]
        )
        return np.asarray((tau * needed).sum(axis=0) / np.maximum((tau**2).sum(axis=0), 1e-300))

    def torques(self, recording: JointRecording, z: Array) -> tuple[Array, Array, Array]:
        """Return times (n,), the motors' torques at the joints and what the model needs for the motion, (n, nq) each.

        Args:
            recording: The recording; its ends, where smoothed positions are bad, are left out.
            z: The parameters, (nz,).
        """
        rows, model = slice(_ENDS, -_ENDS, _STRIDE), self._model
        q, v, a = (part[rows] for part in recording.smoothed())
        m = model.motor(recording.times, recording.u, z)[0][rows]
        lack = at_samples(model.unexplained, len(m))(q, v, a, m, np.tile(z, (len(m), 1)))[..., 0]
        torque = m @ model.selection.T
        return recording.times[rows], torque, lack + torque


def directions_of(H: Array) -> tuple[Array, Array, NDArray[np.bool]]:
    """Return eigenvalues and directions of the information about scaled parameters, and which are determined."""
    values, directions = np.linalg.eigh(H)
    return values, directions, np.asarray(values > 1.0 / UNDETERMINED**2)


def bounded_step(model: JointModel, z: Array, H: Array, g: Array) -> Array:
    """Return the step of Gauss and Newton, to be subtracted from z, in the directions that are determined.

    A parameter at an end of its range that is pulled beyond it stays there, and the others step without it.

    Args:
        model: The model.
        z: The parameters.
        H: The information about the scaled parameters.
        g: The gradient of half the sum of squares by the scaled parameters.
    """
    free = ~outward(model, z, g)
    step = np.zeros(len(z))
    values, directions, determined = directions_of(H[np.ix_(free, free)])
    along = directions.T @ g[free]
    step[free] = directions[:, determined] @ (along[determined] / values[determined])
    return step * model.scales


def outward(model: JointModel, z: Array, g: Array) -> NDArray[np.bool]:
    """Return a mask of the parameters that stand at an end of their range, which the gradient would leave.

    Args:
        model: The model, for the ranges of its parameters.
        z: The parameters, (nz,).
        g: The gradient of half the sum of squares by the scaled parameters, (nz,).
    """
    return np.asarray(((z <= model.lower) & (g > 0.0)) | ((z >= model.upper) & (g < 0.0)))
