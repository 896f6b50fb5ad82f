"""Compares what a machine tells with what its model predicts, window by window."""

from __future__ import annotations

import logging
from collections.abc import Collection, Iterable
from typing import NamedTuple

import numpy as np

from vtbdrake.monitoring.residuals.config import TWIN, ResidualConfig
from vtbdrake.monitoring.residuals.predictor import Predictor
from vtbdrake.monitoring.residuals.rows import INDEX, TIME, Array, RowLayout
from vtbdrake.testbed import Interface

_log = logging.getLogger(__name__)


class Window(NamedTuple):
    """The residuals of one prediction.

    Attributes:
        time: of the DPS at its end, in seconds.
        residual: mean of measured less predicted over its samples, all signals one after another; NaN where there was
            no sample.
        statistic: of each entry, what an alarm compares with its threshold; None where nobody judges.
    """

    time: float
    residual: Array
    statistic: Array | None = None


class ResidualLayout:
    """Which entries of a window belong to which signal: ``sense.<name>``, and ``act.<name>`` of reported commands.

    Attributes:
        places: by signal.
        size: of all together.
    """

    def __init__(self, interface: Interface, reported: Collection[str]) -> None:
        self.places: dict[str, slice] = {}
        self.size = 0
        known = [signal for signal in interface.act if signal.name in reported]
        for side, signals in (("sense", interface.sense), ("act", known)):
            for signal in signals:
                width = signal.size or 0
                self.places[f"{side}.{signal.name}"] = slice(self.size, self.size + width)
                self.size += width

    def where(self, k: int) -> tuple[str, int]:
        """Signal and entry of it, of entry ``k`` of a window."""
        for name, place in self.places.items():
            if k < place.stop:
                return name, k - place.start
        raise IndexError(k)


class Comparison:
    r"""Predicts the samples of each window from the belief at its begin, and compares them with those that came.

    With the machine's samples y_i at instants i T, the belief b_s about its state at s T, the commands c_j that act
    from j T to (j+1) T, and the model's prediction ``\hat y``, a window of H periods that begins at s has the residuals

        mean over i = s+1 .. s+H of  y_i - \hat y_i(b_s, c_s, ..., c_{i-1})                  (sense)
        mean over j = s .. s+H-1 of  (reported command of j) - (the DPS's command for j)     (act)

    The DPS's command in the row of y_i is for j = i + delay; the one that is reported beside y_i acted in j = i - 1.
    A twin is driven by the DPS's commands, a shadow by those that are reported: they are what acts.

    Attributes:
        layout: of the residuals.
        skipped: windows that were not judged, for rows that are missing, or a belief or command in them.
        failed: those whose prediction failed; ``error`` says how the last one did.
    """

    def __init__(self, predictor: Predictor, rows: RowLayout, config: ResidualConfig, *, mode: str) -> None:
        self.layout = ResidualLayout(predictor.interface, rows.reported)
        self.skipped = 0
        self.failed = 0
        self.error = ""
        self._predictor = predictor
        self._where = rows
        self._config = config
        self._twin = mode == TWIN
        # Rows that have to be there before a window can be predicted, after its end: what comes late comes by then.
        self._wait = max(1, max(predictor.ages) - config.horizon)
        self._rows: dict[int, Array] = {}
        self._nothing = rows.empty(1)[0]
        self._newest: int | None = None
        self._next = 0
        self._settled = 0

    def take(self, rows: Array) -> list[Window]:
        """The windows that further rows complete."""
        horizon, found = self._config.horizon, []
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
                    found.append(window)
                oldest = self._next - max(self._config.delay, 1)
                self._rows = {i: kept for i, kept in self._rows.items() if i >= oldest}
        return found

    def _complete(self, index: int, late: Array) -> None:
        """Adds what came late of a row; of two commands for one period the second one acts."""
        row = self._rows.get(index)
        if row is None:
            return
        commands = self._where.commanded
        new = np.isnan(row)
        new[commands] = True
        new &= ~np.isnan(late)
        self._rows[index] = np.where(new, late, row)

    def _restart(self, index: int) -> None:
        """Begins anew with the first window all of whose rows come from here on."""
        horizon, before = self._config.horizon, self._next
        self._rows.clear()
        self._next = -(-(index + (self._config.delay if self._twin else 0)) // horizon) * horizon
        if self._newest is not None:
            self.skipped += max(0, (self._next - before) // horizon)
        self._settled = -self._config.settle
        self._started = False

    def _window(self, s: int) -> Window | None:
        try:
            differences, whole = self._compare(s)
        except (Exception, SystemExit) as error:  # A failed assertion inside Drake arrives as SystemExit.
            _log.warning("a prediction failed, and begins anew: %s", error)
            self.failed += 1
            self.error = f"{type(error).__name__}: {error}"
            self._predictor.forget()
            self._started = False
            self._settled = -self._config.settle
            return None
        self._settled += 1
        if self._settled <= 0:
            return None
        if not whole:
            self.skipped += 1
            return None
        known = ~np.isnan(differences)
        with np.errstate(invalid="ignore"):
            mean = np.where(known, differences, 0.0).sum(axis=0) / known.sum(axis=0)
        return Window(float(self._rows[s + self._config.horizon][TIME]), mean)

    def _compare(self, s: int) -> tuple[Array, bool]:
        """The differences (horizon, all residuals), and whether all was there that it takes."""
        where, periods = self._where, range(s, s + self._config.horizon)
        commanded = self._block(j - self._config.delay for j in periods)
        told = self._block(j + 1 for j in periods)
        acting = commanded[:, where.commanded] if self._twin else told[:, where.reports]
        commands = [None if np.isnan(u).any() else u for u in acting]
        missing = bool(np.isnan(told[:, INDEX]).any()) or any(u is None for u in commands)
        whole = self._believe(s) and not missing
        sense = told[:, where.sensed] - np.array([self._predictor.step(u) for u in commands])
        return np.hstack((sense, told[:, where.reports] - commanded[:, where.compared])), whole

    def _block(self, indices: Iterable[int]) -> Array:
        """Rows by index; NaN where there is none."""
        return np.array([self._rows.get(i, self._nothing) for i in indices])

    def _believe(self, s: int) -> bool:
        """Sets the predicted world to what was believed of instant s; whether all of it is known."""
        if not self._started and s in self._rows:
            self._predictor.restart(round(self._rows[s][TIME] / self._config.period) - 1)
            self._started = True
        known = self._started
        for age, addresses in self._predictor.ages.items():
            row = self._rows.get(s + age)
            estimates = {} if row is None else {address: row[self._where.estimates[address]] for address in addresses}
            if not estimates or any(np.isnan(value).any() for value in estimates.values()):
                known = False
            else:
                self._predictor.believe(age, estimates)
        return known
