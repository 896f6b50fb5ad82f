"""Alarms: residuals, normalized by a calibration and added up until they exceed a threshold."""

from __future__ import annotations

import json
import warnings
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, replace
from math import expm1, inf
from pathlib import Path
from typing import Any

import numpy as np

from vtbdrake.common.arrays import Array
from vtbdrake.monitoring.residuals.comparison import ResidualConfig, ResidualWindow

_BATCH = 100  # consecutive windows from which a calibration takes one mean and deviation
_MIN_WINDOWS = 2 * _BATCH
_SHARE = 4.0
_LONGEST = 64  # windows of the longest sums whose scatter a calibration determines
_EXCESS = 1.166  # Siegmund's correction for the excess over the threshold, for normal steps


# -- calibration


class NominalResidualsError(ValueError):
    """A calibration cannot be made or read, or does not fit."""


@dataclass(frozen=True)
class NominalResiduals:
    """Mean and deviation of every residual in nominal operation, as plain data.

    Attributes:
        mean, deviation: One number per entry, by signal (``sense.<name>``, ``act.<name>``); the deviation of
            independent values whose sums scatter as much (see `nominal_residuals`).
        windows: Number of windows that it was made of.
        horizon: Length of these windows in periods.
        period: Length of a period in seconds.
    """

    mean: Mapping[str, list[float]]
    deviation: Mapping[str, list[float]]
    windows: int
    horizon: int
    period: float

    def save(self, path: str | Path) -> None:
        """Write the calibration as JSON."""
        Path(path).write_text(json.dumps(asdict(self), indent=2) + "\n")

    @classmethod
    def load(cls, path: str | Path) -> NominalResiduals:
        """Return the calibration in a file that `save` has written.

        Raises:
            NominalResidualsError: The file is not a calibration.
        """
        try:
            calibration = cls(**json.loads(Path(path).read_text()))
            # A number that is not finite would make a residual that never alarms.
            for entries in (*calibration.mean.values(), *calibration.deviation.values()):
                np.asarray_chkfinite(entries, dtype=float)
            return calibration
        except (ValueError, TypeError, AttributeError) as error:
            raise NominalResidualsError(
                f"{path} is not a calibration of residuals as NominalResiduals.save writes it: {error}"
            ) from None


def nominal_residuals(
    residuals: Iterable[Array], places: Mapping[str, slice], *, horizon: int, period: float
) -> NominalResiduals:
    r"""Return the calibration from the windows of a nominal run, which should include all motions of the later runs.

    A cumulative sum test takes a slow change within the run for a shift, and values that resemble the ones before (an
    imperfect model during a motion) add up faster than independent ones. So the deviation is the largest deviation of a
    batch of 100 consecutive windows (a standstill may be noisier than a motion, or the reverse), times the largest
    ratio, over L = 1, 2, 4 .. 64, of the deviation of sums of L consecutive windows to sqrt(L) times the deviation of
    one. For an autocorrelation rho^n, this ratio tends to sqrt((1 + rho) / (1 - rho)). The standard error of the ratio
    in n windows is about e = sqrt(L / (3 n)) of it (from overlapping sums), and L is at most n / 8. A ratio up to 1 + 3
    e is taken for chance, so that independent values keep their deviation; two such errors are added to a larger one.

    The deviation is also at least four times the largest distance of a batch's mean from the overall mean: then a
    lasting offset takes no more than half of the allowance of 1/2 (`Cusum`).

    Weak correlation is found in longer runs than 200 windows only, and correlation over more than an eighth of the run,
    or 64 windows, in part only. Then give a tolerance.

    Args:
        residuals: Residuals of consecutive windows, each of shape (size,).
        places: Slices of a window by signal.
        horizon: Length of a window in periods.
        period: Length of a period in seconds.

    Raises:
        NominalResidualsError: There are too few windows.
    """
    table = np.array(list(residuals))
    if len(table) < _MIN_WINDOWS:
        raise NominalResidualsError(
            f"a calibration needs at least {_MIN_WINDOWS} windows, not {len(table)}: run longer"
        )
    batches = table[: len(table) // _BATCH * _BATCH].reshape(-1, _BATCH, table.shape[1])
    with np.errstate(invalid="ignore", divide="ignore"), warnings.catch_warnings(action="ignore"):  # empty batches
        means, deviations = np.nanmean(batches, axis=1), np.nanstd(batches, axis=1, ddof=1)
        mean = np.nan_to_num(np.nanmean(batches, axis=(0, 1)))
        once, ratio = _scatter(table - mean)
        deviation = np.fmax(np.nan_to_num(deviations).max(axis=0), once) * ratio
        deviation = np.maximum(deviation, _SHARE * np.nan_to_num(np.abs(means - mean)).max(axis=0))
    return NominalResiduals(
        mean={name: mean[place].tolist() for name, place in places.items()},
        deviation={name: deviation[place].tolist() for name, place in places.items()},
        windows=len(table),
        horizon=horizon,
        period=period,
    )


def _scatter(table: Array) -> tuple[Array, Array]:
    """Return the deviation of one window, and the factor by which sums of windows scatter more than independent ones.

    Args:
        table: Deviations of consecutive windows from the mean, of shape (windows, size), NaN where unknown.
    """
    is_number = ~np.isnan(table)
    sums, counts = (
        np.pad(np.cumsum(a, axis=0), ((1, 0), (0, 0))) for a in (np.where(is_number, table, 0.0), is_number)
    )
    once, ratio, length = np.zeros(table.shape[1]), np.ones(table.shape[1]), 1
    while length <= min(_LONGEST, len(table) // 8):
        square = ((sums[length:] - sums[:-length]) ** 2).sum(axis=0) / (counts[length:] - counts[:-length]).sum(axis=0)
        if length == 1:
            once = np.nan_to_num(np.sqrt(square))
        else:
            error = np.sqrt(length / (3.0 * counts[-1]))
            growth = np.sqrt(square) / once
            ratio = np.maximum(ratio, np.where(growth > 1.0 + 3.0 * error, growth * (1.0 + 2.0 * error), 1.0))
        length *= 2
    return once, ratio


# -- the cumulative sum test


def run_length(threshold: float, allowance: float) -> float:
    """Return the mean number of independent N(0, 1) values until `Cusum` exceeds its threshold, on either side.

    For one side, it is (exp(2 k b) - 2 k b - 1) / (2 k^2) with b = h + 1.166 (Siegmund, "Sequential Analysis", 1985,
    eq. 2.57); two sides alarm twice as often.

    Args:
        threshold: The threshold h, in standard deviations.
        allowance: The allowance k > 0 that is subtracted from every value, in standard deviations.
    """
    exponent = 2.0 * allowance * (threshold + _EXCESS)
    return (expm1(exponent) - exponent) / (2.0 * allowance**2) / 2.0


def threshold_for(length: float, allowance: float) -> float:
    """Return the threshold for which `run_length` is ``length``, or 0 if it is longer with any threshold.

    Args:
        length: The mean number of values between two false alarms.
        allowance: The allowance k > 0 of the test, in standard deviations.
    """
    if run_length(0.0, allowance) >= length:
        return 0.0
    # Importing scipy costs 40 MB, which a loop without residuals does not need.
    from scipy.optimize import brentq

    largest = 300.0 / allowance  # run_length exceeds any length there
    return float(brentq(lambda h: np.log(run_length(h, allowance) / length), 0.0, largest))


class Cusum:
    r"""Page's two-sided cumulative sum test for many values at a time ("Continuous Inspection Schemes", 1954).

    With z the normalized residuals of a window, of N(0, 1) in nominal operation,

        S+ <- max(0, S+ + z - k),   S- <- max(0, S- - z - k).

    A shift of z by d > k is found, that is S > h, after about h / (d - k) windows. The sums are limited to 2 h, so that
    they decrease soon after the shift has gone. One window beyond h + k is enough: so the jump of a sensor is found on
    which the belief is based, too, and outliers raise alarms.

    Args:
        size: Number of values.
        threshold: Threshold h.
        allowance: Allowance k.

    Attributes:
        threshold: Threshold h.
        upper, lower: S+ and S-, of shape (size,).
    """

    def __init__(self, size: int, *, threshold: float, allowance: float) -> None:
        self.threshold = threshold
        self.upper = np.zeros(size)
        self.lower = np.zeros(size)
        self._allowance = allowance

    def update(self, z: Array) -> Array:
        """Return the larger of both sums after further values, of shape (size,); a NaN changes nothing."""
        increments = np.where(np.isnan(z), 0.0, z)
        k = np.where(np.isnan(z), 0.0, self._allowance)
        self.upper = np.clip(self.upper + increments - k, 0.0, 2.0 * self.threshold)
        self.lower = np.clip(self.lower - increments - k, 0.0, 2.0 * self.threshold)
        return np.maximum(self.upper, self.lower)


# -- alarms


@dataclass(frozen=True)
class Alarm:
    """A persistent difference between the machine and its model.

    Attributes:
        signal: ``sense.<name>``, or ``act.<name>`` if the reported actuator command differs.
        entry: Index of the entry of the signal.
        began, ended: Time of the DPS in seconds; the end is infinite while the alarm lasts.
        residual: Measured less predicted value in the window at whose end the alarm began, in the signal's unit.
        scale: Scale of the residual in nominal operation.
        statistic: The sum (see `Cusum`) that exceeded the threshold, in scales; at most twice the threshold.
        threshold: Threshold of the statistic.
    """

    signal: str
    entry: int
    began: float
    residual: float
    scale: float
    statistic: float
    threshold: float
    ended: float = inf

    def __str__(self) -> str:
        until = "" if self.ended == inf else f" until {self.ended:.3f} s"
        return (
            f"{self.signal}[{self.entry}] differs from its prediction since {self.began:.3f} s{until}: residual "
            f"{self.residual:.3g} (scale {self.scale:.3g}), statistic {self.statistic:.1f} above {self.threshold:.1f}"
        )


class AlarmDetector:
    """Normalizes residuals, adds them up, and raises alarms.

    z = (residual - mean) / scale, with the calibrated mean and the larger of calibrated deviation and tolerance. The
    threshold of `Cusum` follows from the desired mean time between false alarms of all entries together. An alarm ends
    when its sum has come down to half of the threshold.

    Args:
        places: Slices of a window by signal, as `residual_places` returns them.
        config: Configuration.
        calibration: The residuals of nominal operation; None if there are tolerances for all signals.

    Attributes:
        mean, scale: Mean and scale of the residuals, of shape (size,).
        statistic: The larger sum of each entry after the last window.

    Raises:
        NominalResidualsError: The calibration is of other signals or windows.
        ValueError: A tolerance is of an unknown signal or has another size, or a residual has no scale.
    """

    def __init__(
        self, places: Mapping[str, slice], config: ResidualConfig, calibration: NominalResiduals | None
    ) -> None:
        self._places = places
        size = max(place.stop for place in places.values())
        self.mean, self.scale, self.statistic = np.zeros((3, size))
        for name, tolerance in config.tolerance.items():
            self._set(self.scale, name, tolerance, ValueError)
        if calibration is not None:
            _check_calibration(calibration, places, config)
            deviation = np.zeros(size)
            for name in places:
                self._set(self.mean, name, calibration.mean[name], NominalResidualsError)
                self._set(deviation, name, calibration.deviation[name], NominalResidualsError)
            self.scale = np.maximum(self.scale, deviation)
        for name, place in places.items():
            if not (self.scale[place] > 0.0).all():
                raise ValueError(
                    f"the residual of {name} has no scale: calibrate it in nominal operation, or give a tolerance"
                )
        windows = config.false_alarm_interval / config.window
        threshold = threshold_for(windows * size, config.allowance)
        self._cusum = Cusum(size, threshold=threshold, allowance=config.allowance)
        self._active: dict[int, Alarm] = {}
        self._entries = [(name, k) for name, place in places.items() for k in range(place.stop - place.start)]

    def _set(self, target: Array, name: str, value: Any, error: type[ValueError]) -> None:
        if name not in self._places:
            raise ValueError(f"there is no residual of {name!r}; there are: {', '.join(self._places)}")
        place = self._places[name]
        size = place.stop - place.start
        if np.shape(value) not in ((), (size,)):
            raise error(f"the residual of {name} has {size} entries, but a value of shape {np.shape(value)} was given")
        target[place] = value

    def update(self, window: ResidualWindow) -> list[Alarm]:
        """Return the alarms that end and begin with this window, those with the largest residuals first."""
        threshold = self._cusum.threshold
        z = (window.residual - self.mean) / self.scale
        self.statistic = statistic = self._cusum.update(z)
        changed = []
        for k, alarm in list(self._active.items()):
            if statistic[k] <= 0.5 * threshold:
                changed.append(replace(alarm, ended=window.time))
                del self._active[k]
        begun = [int(k) for k in np.flatnonzero(statistic > threshold) if int(k) not in self._active]
        for k in sorted(begun, key=lambda k: -abs(z[k])):
            signal, entry = self._entries[k]
            alarm = Alarm(
                signal=signal,
                entry=entry,
                began=window.time,
                residual=float(window.residual[k]),
                scale=float(self.scale[k]),
                statistic=float(statistic[k]),
                threshold=threshold,
            )
            self._active[k] = alarm
            changed.append(alarm)
        return changed


def _check_calibration(calibration: NominalResiduals, places: Mapping[str, slice], config: ResidualConfig) -> None:
    if (calibration.horizon, calibration.period) != (config.horizon, config.period):
        raise NominalResidualsError(
            f"the calibration is of windows of {calibration.horizon} periods of {calibration.period} s, not of "
            f"{config.horizon} periods of {config.period} s: calibrate again"
        )
    for part, values in (("mean", calibration.mean), ("deviation", calibration.deviation)):
        if values.keys() != places.keys():
            raise NominalResidualsError(
                f"the calibration has a {part} of {', '.join(values) or 'nothing'}, but there are residuals of "
                f"{', '.join(places)}: calibrate again"
            )
