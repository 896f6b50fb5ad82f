"""Recordings for a calibration: the positions of joints and the torques that acted between them, from a log."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import scipy
from numpy.typing import NDArray

from vtbdrake.calibration.joint_model import CalibrationError, JointModel
from vtbdrake.common.argument_checks import counted
from vtbdrake.common.arrays import Array
from vtbdrake.recording.log import GAP, Log, Series

# Least number of samples of a recording.
FEWEST_SAMPLES = 50
# Number of samples of a local polynomial of third order.
_SMOOTHED = 15
# Commands with less jitter than this share of their period come by a clock.
_REGULAR = 0.2


@dataclass(frozen=True, eq=False)
class JointRecording:
    """Positions and torques of one recording, from each position to the next.

    Attributes:
        source: Where it is from.
        times: (n,), in s.
        q: Measured positions, (n, nq).
        u: Means of the commands that acted from each time to the next one, (n, nu).
        stride: Number of recorded positions per compared position.
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

        Args:
            log: The recording.
            model: The model of the joints, nq of them.
            position: Name of the sensor signal with the positions, (nq,), in rad or m.
            torque: Name of the actuator signal with the torques, (nu,), in N m or N.
            period: Time between two compared positions, in s; by default every recorded position.

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
        if count < FEWEST_SAMPLES:
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
        spans = [slice(*pair) for pair in pairwise(ends) if pair[1] - pair[0] >= FEWEST_SAMPLES]
        if not spans:
            raise CalibrationError(
                f"{self.source}: {counted(cuts.size, 'gap')} leave no {FEWEST_SAMPLES} positions in a row: the "
                "recording is too sparse"
            )
        return [replace(self, times=self.times[span], q=self.q[span], u=self.u[span]) for span in spans]

    def smoothed(self) -> tuple[Array, Array, Array]:
        """Return positions, velocities and accelerations (n, nq) by local polynomials."""
        q, v, a = (
            scipy.signal.savgol_filter(self.q, _SMOOTHED, 3, deriv=order, delta=self.period, axis=0)
            for order in range(3)
        )
        return q, v, a


def _means(commands: Series, times: Array) -> Array:
    """Return the means of commands from each time to the next, (n, nu); a command acts until the next one."""
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
    """Return at which times the newest command is older than commands of a regular clock can be: some are missing.

    Args:
        commands: The commands, by time.
        times: The times to judge, (n,), in s.
    """
    period, jitter, _ = commands.uniformity
    if not jitter < _REGULAR * period:  # They are recorded when they change.
        return np.zeros(len(times), bool)
    newest = np.searchsorted(commands.times, times, side="right") - 1
    return np.asarray(times - commands.times[np.maximum(newest, 0)] > GAP * period)
