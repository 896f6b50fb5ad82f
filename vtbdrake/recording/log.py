"""Recorded signals, whoever recorded them: the newest log of the own loop, or a table of a stranger's robot."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from vtbdrake.common.argument_checks import counted
from vtbdrake.common.arrays import Array, immutable
from vtbdrake.recording.log_format import LogError

# Times are sums with rounding errors: they are the same within this time in s.
_ROUNDING = 1e-9

GAP = 5.0
"""Number of median periods from which on the time between two samples is called a gap."""


class Uniformity(NamedTuple):
    """How regular the times of a series are, in seconds.

    Attributes:
        period: The median time between two samples.
        jitter: The median of the absolute differences from the period.
        longest: The longest time between two samples.
    """

    period: float
    jitter: float
    longest: float


@immutable
class Series:
    """The samples of one vector signal.

    Attributes:
        times: When each sample was taken or each command began to act, (n,), increasing, in s.
        values: The samples, (n, size).
    """

    times: Array
    values: Array

    def __post_init__(self) -> None:
        if self.times.ndim != 1 or self.values.ndim != 2 or len(self.times) != len(self.values):
            raise LogError(
                f"a series has n times and n samples of some entries, not arrays of shape {self.times.shape} and "
                f"{self.values.shape}"
            )
        if not len(self.times):
            raise LogError("a series without samples")
        if not np.isfinite(self.times).all() or (np.diff(self.times) <= 0.0).any():
            raise LogError("the times of a series are finite and increase from sample to sample")

    @classmethod
    def with_last_of_equal_times(cls, times: Array, values: Array) -> Series:
        """Return the samples, of several with the same time the last; times must not decrease.

        Args:
            times: Times in s, shape (n,).
            values: One row per time, shape (n, m).
        """
        last = np.append(np.diff(times) > 0.0, True)
        return cls(times, values) if last.all() else cls(times[last], values[last])

    def __len__(self) -> int:
        return len(self.times)

    @property
    def uniformity(self) -> Uniformity:
        """Return the regularity of the times; NaN for a single sample."""
        steps = np.diff(self.times)
        if not steps.size:
            return Uniformity(np.nan, np.nan, np.nan)
        period = float(np.median(steps))
        return Uniformity(period, float(np.median(abs(steps - period))), float(steps.max()))

    def at(self, times: ArrayLike) -> Array:
        """Return the newest sample at each of the times (m,), (m, size); NaN before the first.

        A sample is there at its own time, however both are rounded.
        """
        indices = np.searchsorted(self.times, np.asarray(times, dtype=float) + _ROUNDING, side="right") - 1
        samples: Array = np.where((indices >= 0)[:, np.newaxis], self.values[np.maximum(indices, 0)], np.nan)
        return samples

    def between(self, start: float, end: float) -> Series:
        """Return the samples from ``start`` to below ``end``, in s; a LogError if there is none.

        Args:
            start: The first time, in s.
            end: The end, which does not belong to the part, in s.
        """
        part = slice(*np.searchsorted(self.times, [start, end]).tolist())
        if part.start >= part.stop:
            raise LogError(
                f"no sample from {start:g} to {end:g} s: they lie from {self.times[0]:g} to {self.times[-1]:g} s"
            )
        return Series(self.times[part], self.values[part])


class Log:
    """Recorded signals, each with its own times, in seconds on a clock that they share.

    Logs with the same names, times and samples are equal.

    Args:
        source: The file, for messages.
        sense: Samples of sensors, by signal.
        act: Commands of actuators that acted on the machine, by signal.
        remarks: What was noticed while the file was read: gaps, repeated times, rows that were left out.

    Raises:
        LogError: There is no signal.
    """

    def __init__(
        self, source: str, sense: Mapping[str, Series], act: Mapping[str, Series], remarks: Sequence[str] = ()
    ) -> None:
        if not (sense or act):
            raise LogError(f"{source}: a log has at least one signal")
        self.source = source
        self.sense = dict(sense)
        self.act = dict(act)
        self.remarks = tuple(remarks)

    def __eq__(self, other: object) -> bool:
        return self.digest == other.digest if isinstance(other, Log) else NotImplemented

    def __hash__(self) -> int:
        return hash(self.digest)

    def __str__(self) -> str:
        lines = [self.source]
        for side, signals in (("sense", self.sense), ("act", self.act)):
            for name, series in signals.items():
                period, jitter, longest = series.uniformity
                lines.append(
                    f"{side}.{name}: {len(series)} samples of {series.values.shape[1]} entries from "
                    f"{series.times[0]:.6g} to {series.times[-1]:.6g} s, every {1e3 * period:.4g} ms "
                    f"(+- {1e3 * jitter:.2g}, longest {1e3 * longest:.4g})"
                )
        return "\n".join([*lines, *self.remarks])

    @property
    def start(self) -> float:
        """Return the time of the first sample of any signal, in s."""
        return min(float(series.times[0]) for series in (*self.sense.values(), *self.act.values()))

    @property
    def end(self) -> float:
        """Return the time of the last sample of any signal, in s."""
        return max(float(series.times[-1]) for series in (*self.sense.values(), *self.act.values()))

    @property
    def digest(self) -> str:
        """Return the SHA-256 of all names, times and samples, in hexadecimal."""
        digest = hashlib.sha256()
        for side, signals in (("sense", self.sense), ("act", self.act)):
            for name in sorted(signals):
                digest.update(f"{side}.{name} {signals[name].values.shape}".encode())
                for array in (signals[name].times, signals[name].values):
                    digest.update(np.ascontiguousarray(array, dtype="<f8").tobytes())
        return digest.hexdigest()

    def between(self, start: float, end: float) -> Log:
        """Return the part from ``start`` to below ``end``, in s; a LogError if a signal has no sample there.

        Args:
            start: The first time, in s.
            end: The end, which does not belong to the part, in s.
        """

        def cut(signals: Mapping[str, Series]) -> dict[str, Series]:
            return {name: series.between(start, end) for name, series in signals.items()}

        return Log(self.source, cut(self.sense), cut(self.act), self.remarks)


def checked_series(label: str, times: Array, values: Array, remarks: list[str]) -> Series:
    """Return the samples that somebody else has recorded, without those that are none.

    Args:
        label: The file and the signal, for messages.
        times: Times in s, shape (n,).
        values: One row per time, shape (n, m); a row that is not finite is no sample.
        remarks: Gets what was left out, gaps, and entries that never change.

    Raises:
        LogError: A time is not finite or runs backwards, or there is no sample.
    """
    if len(times) != len(values):
        raise LogError(f"{label} has {len(values)} rows, its times {len(times)}")
    if not np.isfinite(times).all():
        row = int(np.flatnonzero(~np.isfinite(times))[0])
        raise LogError(f"{label}: the time of row {row} is {times[row]}")
    if (backwards := np.flatnonzero(np.diff(times) < 0.0)).size:
        row = backwards[0]
        raise LogError(
            f"{label}: time runs backwards, first from row {row} ({times[row]:.9g} s) to row {row + 1} "
            f"({times[row + 1]:.9g} s), {backwards.size} times in all: split the recording there, or sort it if only "
            "the order of its rows is wrong"
        )
    # Most recordings are whole: one pass tells, and only others are looked at row by row.
    if not (len(values) and np.isfinite(values).all()):
        whole = np.asarray(np.isfinite(values).all(axis=1))
        if not whole.any():
            raise LogError(
                f"{label} has no row that is whole: in each, an entry is NaN or empty (as those of "
                "real.sense in a simulation, whose measurements are sim.sense)"
            )
        remarks.append(f"{label}: {int((~whole).sum())} of {len(whole)} rows are not whole")
        times, values = times[whole], values[whole]
    series = Series.with_last_of_equal_times(times, values)
    if len(series) < len(times):
        remarks.append(f"{label}: {len(times) - len(series)} of {len(times)} times are repeated; the last row counts")
    steps = np.diff(series.times)
    period = float(np.median(steps)) if steps.size else np.nan
    gaps = np.flatnonzero(steps > GAP * period)
    if gaps.size:
        first = gaps[0]
        remarks.append(
            f"{label}: {counted(gaps.size, 'gap')} of more than {GAP:g} periods of {1e3 * period:.4g} ms, the first "
            f"from {series.times[first]:.6g} to {series.times[first + 1]:.6g} s"
        )
    still = [k for k in range(series.values.shape[1]) if _never_changes(series.values[:, k])]
    if still and len(series) > 1:
        remarks.append(f"{label}: entries that never change: {', '.join(map(str, still))}")
    return series


def _never_changes(entry: Array) -> bool:
    """Return whether all samples of an entry, (n,), are equal; the first and the last one differ in most recordings."""
    return bool(entry[0] == entry[-1] and (entry == entry[0]).all())
