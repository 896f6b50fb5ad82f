"""From residuals to alarms."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import inf
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vtbdrake.monitoring.residuals.calibration import Calibration, CalibrationError
from vtbdrake.monitoring.residuals.comparison import ResidualLayout, Window
from vtbdrake.monitoring.residuals.config import ResidualConfig
from vtbdrake.monitoring.residuals.cusum import Cusum, threshold_for

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Alarm:
    """The machine and its model have parted.

    Attributes:
        signal: ``sense.<name>``, or ``act.<name>`` where it is the reported command that differs.
        entry: of the signal, from 0.
        began, ended: DPS's time in seconds; infinite while it lasts.
        residual: measured less predicted in the window at whose end it began, in the signal's unit.
        scale: of the residual in nominal operation.
        statistic: the sum (see `Cusum`) that exceeded the threshold, in scales; at most twice the threshold.
        threshold: that it exceeded.
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
        until = "" if self.ended == inf else f", until {self.ended:.3f} s"
        return (
            f"{self.signal}[{self.entry}] parted from its prediction at {self.began:.3f} s{until}: {self.residual:.3g} "
            f"apart (scale {self.scale:.3g}), statistic {self.statistic:.1f} above {self.threshold:.1f}"
        )


class Judge:
    """Normalizes residuals, adds them up, and raises alarms.

    z = (residual - mean) / scale, with the calibrated mean and the larger of calibrated deviation and tolerance. The
    threshold of `Cusum` follows from the mean time between false alarms that is wanted, of all entries together. An
    alarm ends when its sum is down at half of the threshold.

    Attributes:
        statistic: the larger sum of each entry, after the last window.

    Raises:
        CalibrationError: the calibration is of other signals or windows.
        ValueError: a tolerance is of an unknown signal, or of another size; a residual has neither.
    """

    def __init__(self, layout: ResidualLayout, config: ResidualConfig, calibration: Calibration | None) -> None:
        self._layout = layout
        self.mean = np.zeros(layout.size)
        self.scale = np.zeros(layout.size)
        for name, tolerance in config.tolerance.items():
            self._set(self.scale, name, tolerance, ValueError)
        if calibration is not None:
            _check(calibration, layout, config)
            deviation = np.zeros(layout.size)
            for name in layout.places:
                self._set(self.mean, name, calibration.mean[name], CalibrationError)
                self._set(deviation, name, calibration.deviation[name], CalibrationError)
            self.scale = np.maximum(self.scale, deviation)
        for name, place in layout.places.items():
            if not (self.scale[place] > 0.0).all():
                raise ValueError(
                    f"the residual of {name} has no scale: calibrate it in nominal operation, or give a tolerance"
                )
        windows = config.false_alarm_interval / config.window
        threshold = threshold_for(windows * layout.size, config.allowance)
        self._cusum = Cusum(layout.size, threshold=threshold, allowance=config.allowance)
        self.statistic = np.zeros(layout.size)
        self._on: dict[int, Alarm] = {}

    @property
    def threshold(self) -> float:
        return self._cusum.threshold

    def _set(self, target: Array, name: str, value: Any, error: type[ValueError]) -> None:
        place = _known(self._layout, name)
        size = place.stop - place.start
        if np.shape(value) not in ((), (size,)):
            raise error(f"{name} has {size} entries, but what is given for its residual has shape {np.shape(value)}")
        target[place] = value

    def take(self, window: Window) -> list[Alarm]:
        """The alarms that begin and end with this window; those that begin, the loudest first."""
        z = (window.residual - self.mean) / self.scale
        self.statistic = statistic = self._cusum.take(z)
        changed = []
        for k, alarm in list(self._on.items()):
            if statistic[k] <= 0.5 * self.threshold:
                changed.append(replace(alarm, ended=window.time))
                del self._on[k]
        begun = [int(k) for k in np.flatnonzero(statistic > self.threshold) if int(k) not in self._on]
        for k in sorted(begun, key=lambda k: -abs(z[k])):
            signal, entry = self._layout.where(k)
            alarm = Alarm(
                signal=signal,
                entry=entry,
                began=window.time,
                residual=float(window.residual[k]),
                scale=float(self.scale[k]),
                statistic=float(statistic[k]),
                threshold=self.threshold,
            )
            self._on[k] = alarm
            changed.append(alarm)
        return changed


def _known(layout: ResidualLayout, name: str) -> slice:
    if name not in layout.places:
        raise ValueError(f"there is no residual of {name!r}; there are: {', '.join(layout.places)}")
    return layout.places[name]


def _check(calibration: Calibration, layout: ResidualLayout, config: ResidualConfig) -> None:
    theirs = (calibration.horizon, calibration.period)
    if theirs != (config.horizon, config.period):
        raise CalibrationError(
            f"the calibration is of windows of {theirs[0]} periods of {theirs[1]} s, and not of {config.horizon} of "
            f"{config.period} s: calibrate anew"
        )
    parts: Mapping[str, Mapping[str, Any]] = {"mean": calibration.mean, "deviation": calibration.deviation}
    for part, values in parts.items():
        if values.keys() != layout.places.keys():
            raise CalibrationError(
                f"the calibration's {part} is of {', '.join(values) or 'nothing'}, but there are residuals of "
                f"{', '.join(layout.places)}: calibrate anew"
            )
