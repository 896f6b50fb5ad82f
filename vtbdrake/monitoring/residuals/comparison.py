"""ResidualGenerator of the measurements of a machine with the predictions of its model, window by window."""

from __future__ import annotations

import logging
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from itertools import accumulate, pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from vtbdrake.common.arrays import Array
from vtbdrake.common.failures import FAILURES, error_text
from vtbdrake.common.settings import check_settings, setting
from vtbdrake.testbed import Interface, Scenario
from vtbdrake.testbed.prediction import Predictor

_log = logging.getLogger(__name__)


SHADOW = "shadow"
TWIN = "twin"
INDEX = 0
TIME = 1


@dataclass(frozen=True, kw_only=True)
class ResidualConfig:
    """Configuration of residuals: of the prediction, beside the scenario, and of the alarms.

    `Scenario.deployment` contains the configuration of a scenario.

    Attributes:
        scenario: Scenario of the predicted world; by default the scenario of the loop's target. It has the latencies of
            the sensors, but no random errors.
        values: Values of variables of the predicted world by address, such as the assumed payload.
        tolerance: By signal (``sense.<name>``, ``act.<name>``), the least scale of a residual, for all entries or
            each; persistent residuals below half of it are not reported.

    Raises:
        ValueError: A value is out of its range.
    """

    scenario: Scenario | None = None
    period: float = setting(1e-3, "Period of the machine's cycles and the DPS's.", unit="s", gt=0.0)
    horizon: int = setting(10, "Length of a prediction, after which it restarts from the belief.", unit="periods", ge=1)
    delay: int = setting(
        0,
        "Periods from the instant of a sample until the actuator command that answers it acts: 0 in "
        "lock-step, where it acts at once; 1 for a machine with a clock of its own, where it acts from the next "
        "period on. A machine whose samples lack the period that simulated sensors take has one less.",
        unit="periods",
        ge=0,
    )
    settle: int = setting(
        10,
        "Windows that are predicted but not used at first and after a gap, while state that the belief does "
        "not cover (currents of drives, samples in transit) follows the actuator commands.",
        unit="windows",
        ge=0,
    )
    values: Mapping[str, Any] = field(default_factory=dict)
    tolerance: Mapping[str, ArrayLike] = field(default_factory=dict)
    allowance: float = setting(0.5, "Allowance k of `Cusum`, in scales.", gt=0.0)
    false_alarm_interval: float = setting(
        3.6e6,
        "Mean time between two false alarms of all signals together, if the calibration includes "
        "all motions, and the sums of residuals are about normal. Outliers alarm more often.",
        unit="s",
        gt=0.0,
    )

    def __post_init__(self) -> None:
        check_settings(self)
        for signal, tolerance in self.tolerance.items():
            if not (np.asarray(tolerance) >= 0.0).all():
                raise ValueError(f"the tolerance of {signal} must not be negative, as {tolerance!r} is")

    @property
    def window(self) -> float:
        """Return the length of a prediction in seconds."""
        return self.horizon * self.period


class RowLayout:
    """The layout of a row with the values of one sample; values that are unknown or not new are NaN.

    Entry 0 is the index of the sample by the machine's own time, in periods since the first; entry 1 the DPS's time at
    the end of the cycle.

    Args:
        interface: The signals.
        reported: Actuator signals whose actuator commands the machine reports.
        estimates: Sizes of the estimates of the DPS, by address.

    Attributes:
        sense: Slices of the measured values, by sensor signal.
        actuation: Slices of the DPS's actuator commands, by actuator signal.
        reported: Slices of the reported actuator commands, which acted in the period before the sample.
        estimates: Slices of the estimates, by address.
        all_sense: Slice of all of ``sense``.
        all_actuation, all_reported: Indices of all of ``actuation`` and ``reported``.
        compared: Indices of the actuator commands that are compared with ``all_reported``.
        width: Number of entries of a row.
    """

    def __init__(self, interface: Interface, reported: Collection[str], estimates: Mapping[str, int]) -> None:
        self.width = 2
        actuators = {signal.name: signal.size or 0 for signal in interface.act}
        self.sense = self._place({signal.name: signal.size or 0 for signal in interface.sense})
        self.all_sense = slice(2, self.width)
        self.actuation = self._place(actuators)
        self.reported = self._place({name: size for name, size in actuators.items() if name in reported})
        self.estimates = self._place(estimates)
        self.all_actuation = _indices(self.actuation.values())
        self.all_reported = _indices(self.reported.values())
        self.compared = _indices(self.actuation[name] for name in self.reported)

    def _place(self, sizes: Mapping[str, int]) -> dict[str, slice]:
        places = slices(sizes, self.width)
        self.width += sum(sizes.values())
        return places

    def empty(self, count: int) -> Array:
        """Return rows of shape (count, width) in which nothing is known yet."""
        return np.full((count, self.width), np.nan)


def slices(sizes: Mapping[str, int], begin: int = 0) -> dict[str, slice]:
    """Return consecutive slices of the given sizes.

    Args:
        sizes: The number of entries of each slice, by name, in their order.
        begin: Where the first slice begins.
    """
    ends = accumulate(sizes.values(), initial=begin)
    return {name: slice(a, b) for name, (a, b) in zip(sizes, pairwise(ends), strict=True)}


def _indices(places: Iterable[slice]) -> list[int]:
    return [k for place in places for k in range(place.start, place.stop)]


class ResidualWindow(NamedTuple):
    """The residuals of one prediction.

    Attributes:
        time: Time of the DPS at its end, in seconds.
        residual: Mean of measured less predicted values over its samples, all signals concatenated; NaN where there was
            no sample.
        statistic: Statistic of each entry that an alarm compares with its threshold; None without alarm detection.
    """

    time: float
    residual: Array
    statistic: Array | None = None


def residual_places(interface: Interface, reported: Collection[str]) -> dict[str, slice]:
    """Return the slices of a window by signal: ``sense.<name>``, and ``act.<name>`` of reported actuator commands.

    Args:
        interface: The interface of the DPS, whose abstract signals get empty slices.
        reported: The names of the actuator signals whose commands the machine reports.
    """
    sizes = {f"sense.{signal.name}": signal.size or 0 for signal in interface.sense}
    sizes |= {f"act.{signal.name}": signal.size or 0 for signal in interface.act if signal.name in reported}
    return slices(sizes)


class ResidualGenerator:
    r"""Predicts the samples of each window from the belief at its beginning and compares them with the measured ones.

    With the machine's samples y_i at instants i T, the belief b_s about its state at s T, the actuator commands c_j
    that act from j T to (j+1) T, and the model's prediction ``\hat y``, a window of H periods that begins at s has the
    residuals

        mean over i = s+1 .. s+H of  y_i - \hat y_i(b_s, c_s, ..., c_{i-1})                  (sense)
        mean over j = s .. s+H-1 of  (reported command of j) - (the DPS's command for j)     (act)

    The DPS's actuator command in the row of y_i is for j = i + delay; the one that is reported beside y_i acted in
    j = i - 1. A twin is driven by the DPS's actuator commands, a shadow by the reported ones: they are what acts.

    Args:
        predictor: The model.
        rows: The layout of the rows, which hold the machine's samples.
        config: The length of a window, and what alarms need.
        mode: ``twin`` or ``shadow``.

    Attributes:
        skipped: Number of windows without a result, because rows, a belief or actuator commands were missing.
        failed: Number of windows whose prediction failed; ``error`` describes the last failure.
    """

    def __init__(self, predictor: Predictor, rows: RowLayout, config: ResidualConfig, *, mode: str) -> None:
        self.skipped = 0
        self.failed = 0
        self.error = ""
        self._predictor = predictor
        self._where = rows
        self._config = config
        self._twin = mode == TWIN
        # A window is predicted this many rows after its end: late rows and beliefs have arrived by then.
        self._wait = max(1, max(predictor.estimates) - config.horizon)
        self._rows: dict[int, Array] = {}
        self._nothing = rows.empty(1)[0]
        self._newest: int | None = None
        self._next = 0
        self._settled = 0
        self._started = False  # Whether the predictor has its time since the last restart.

    def add(self, rows: Array) -> list[ResidualWindow]:
        """Add rows, of shape (n, width), and return the windows that they complete."""
        horizon, windows = self._config.horizon, []
        for row in rows:
            index = int(row[INDEX])
            if self._newest is not None and self._newest - horizon <= index <= self._newest:
                self._complete(index, row)
                continue
            if self._newest is None or not 0 < index - self._newest <= horizon:
                self._restart(index)
            self._newest = index
            self._rows[index] = row
            while index >= self._next + horizon + self._wait:
                window = self._window(self._next)
                self._next += horizon
                if window is not None:
                    windows.append(window)
                oldest = self._next - max(self._config.delay, 1)
                self._rows = {i: values for i, values in self._rows.items() if i >= oldest}
        return windows

    def _complete(self, index: int, late: Array) -> None:
        """Add late values to a row. The second of two actuator commands for one period acts."""
        row = self._rows.get(index)
        if row is None:
            return
        new = np.isnan(row)
        new[self._where.all_actuation] = True
        new &= ~np.isnan(late)
        self._rows[index] = np.where(new, late, row)

    def _restart(self, index: int) -> None:
        """Begin with the first window all of whose rows come from here on."""
        horizon, before = self._config.horizon, self._next
        self._rows.clear()
        self._next = -(-(index + (self._config.delay if self._twin else 0)) // horizon) * horizon
        if self._newest is not None:
            self.skipped += max(0, (self._next - before) // horizon)
        self._settled = -self._config.settle
        self._started = False

    def _window(self, s: int) -> ResidualWindow | None:
        try:
            differences, whole = self._compare(s)
        except FAILURES as error:
            _log.warning("a prediction failed and restarts: %s", error)
            self.failed += 1
            self.error = error_text(error)
            self._predictor.reset()
            self._started = False
            self._settled = -self._config.settle
            return None
        self._settled += 1
        if self._settled <= 0:
            return None
        if not whole:
            self.skipped += 1
            return None
        is_number = ~np.isnan(differences)
        with np.errstate(invalid="ignore"):
            mean = np.where(is_number, differences, 0.0).sum(axis=0) / is_number.sum(axis=0)
        return ResidualWindow(float(self._rows[s + self._config.horizon][TIME]), mean)

    def _compare(self, s: int) -> tuple[Array, bool]:
        """Return the differences, of shape (horizon, all residuals), and whether nothing was missing for them."""
        where, periods = self._where, range(s, s + self._config.horizon)
        commanded = self._block(j - self._config.delay for j in periods)
        measured = self._block(j + 1 for j in periods)
        acting = commanded[:, where.all_actuation] if self._twin else measured[:, where.all_reported]
        actuation = [None if np.isnan(u).any() else u for u in acting]
        missing = bool(np.isnan(measured[:, INDEX]).any()) or any(u is None for u in actuation)
        whole = self._set_belief(s) and not missing
        sense = measured[:, where.all_sense] - np.array([self._predictor.step(u) for u in actuation])
        return np.hstack((sense, measured[:, where.all_reported] - commanded[:, where.compared])), whole

    def _block(self, indices: Iterable[int]) -> Array:
        return np.array([self._rows.get(i, self._nothing) for i in indices])

    def _set_belief(self, s: int) -> bool:
        """Set the predicted world to the belief about instant s; return whether all of the belief is known."""
        if not self._started and s in self._rows:
            self._predictor.set_time(round(self._rows[s][TIME] / self._config.period) - 1)
            self._started = True
        is_complete = self._started
        for age, addresses in self._predictor.estimates.items():
            row = self._rows.get(s + age)
            estimates = {} if row is None else {address: row[self._where.estimates[address]] for address in addresses}
            if not estimates or any(np.isnan(value).any() for value in estimates.values()):
                is_complete = False
            else:
                self._predictor.set_belief(age, estimates)
        return is_complete
