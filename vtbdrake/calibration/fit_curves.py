"""The course of a calibration, for its plots: torques beside those that the model needs, and the filter's errors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vtbdrake.calibration.filtering import Segments
from vtbdrake.calibration.inverse_dynamics import InverseDynamics
from vtbdrake.calibration.joint_recording import JointRecording
from vtbdrake.common.arrays import Array

# About the largest number of points of a curve.
_MOST_POINTS = 4000


@dataclass(frozen=True, eq=False)
class FitCurves:
    """Recordings beside the calibrated model; one recording follows the other in time.

    Attributes:
        joints: Names of the joints, by position.
        times: Times of the torques, (n,), in s from the begin of the first recording.
        torque: Torques of the motors at the joints, after delay and current loop, (n, nq), in N m or N.
        needed: Torques that the calibrated model needs for the recorded motion, friction included, (n, nq).
        error_times: Times of the errors, (m,), in s.
        errors: Measured positions minus those that the filter expects, in standard deviations, (m, nq).
        held_back: Whether the segment of an error was kept back from the fit, (m,).
    """

    joints: tuple[str, ...]
    times: Array
    torque: Array
    needed: Array
    error_times: Array
    errors: Array
    held_back: NDArray[np.bool]

    @classmethod
    def of(
        cls,
        recordings: Sequence[JointRecording],
        dynamics: InverseDynamics,
        z: Array,
        segments: Segments,
        white: Array,
        held_back: NDArray[np.bool],
    ) -> FitCurves:
        """Return the curves at an estimate.

        Args:
            recordings: The recordings.
            dynamics: Inverse dynamics of the model.
            z: The estimate, (nz,).
            segments: The recordings in segments.
            white: The whitened innovations, (N, W, nq).
            held_back: The segments that were kept back, (W,).
        """
        starts = np.cumsum([0.0, *(recording.times[-1] - recording.times[0] for recording in recordings)])
        offsets = np.array([start - recording.times[0] for start, recording in zip(starts, recordings, strict=False)])
        at, *parts = zip(*(dynamics.torques(recording, z) for recording in recordings), strict=True)
        times = np.concatenate([time + offset for time, offset in zip(at, offsets, strict=True)])
        torque, needed = (np.concatenate(part) for part in parts)
        by_segment = segments.times[1:] + offsets[segments.sources]
        thin, thin_errors = (slice(None, None, 1 + size // _MOST_POINTS) for size in (times.size, by_segment.size))
        # Segment after segment.
        error_times = by_segment.T.ravel()
        errors = white.swapaxes(0, 1).reshape(error_times.size, -1)
        return cls(
            segments.model.joint_names,
            times[thin],
            torque[thin],
            needed[thin],
            error_times[thin_errors],
            errors[thin_errors],
            np.repeat(held_back, len(white))[thin_errors],
        )
