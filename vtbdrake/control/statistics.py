"""Statistics of a loop's timing: histograms of durations, missed deadlines, and durations above thresholds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import accumulate
from math import ceil, exp, inf, log, nan
from typing import Any

RESOLUTION = 0.01
"""Ratio of the ends of a bin of a histogram, less one."""

LOWEST = 1e-6
"""Shorter durations share a bin, negative ones too, in seconds."""
HIGHEST = 10.0
"""Longer durations share a bin, in seconds."""

_SCALE = 1.0 / log(1.0 + RESOLUTION)
_SHIFT = 1.0 - _SCALE * log(LOWEST)


class Histogram:
    """Durations in bins of equal ratio, in constant memory.

    A percentile is the upper end of the bin in which it lies: never below the true one (of the kind "inverted_cdf"),
    and above it by at most a factor of 1 + `RESOLUTION`; below `LOWEST` it is `LOWEST`, above `HIGHEST` the largest.
    Count, total, least and largest are exact.

    Attributes:
        count: Number of durations.
        total: Sum of the durations, in seconds.
        least: Shortest duration in seconds; NaN if there is none.
        largest: Longest duration in seconds; NaN if there is none.
    """

    def __init__(self) -> None:
        self.count, self.total = 0, 0.0
        self.least = self.largest = nan
        # Bin 0 ends at the lowest, bin k > 0 at LOWEST exp(k / scale); the last one starts at the highest, without end.
        self._bins = [0] * (ceil(_SCALE * log(HIGHEST / LOWEST)) + 2)

    def __repr__(self) -> str:
        return f"Histogram({self.count} durations, mean {self.mean:.3g} s, largest {self.largest:.3g} s)"

    def record(self, seconds: float) -> None:
        """Add one duration.

        Raises:
            ValueError: It is NaN.
        """
        if seconds <= LOWEST:
            self._bins[0] += 1
        elif seconds < HIGHEST:
            self._bins[int(log(seconds) * _SCALE + _SHIFT)] += 1
        elif seconds >= HIGHEST:
            self._bins[-1] += 1
        else:
            raise ValueError("a duration is a number of seconds, not NaN")
        self.count += 1
        self.total += seconds
        if not seconds >= self.least:
            self.least = seconds
        if not seconds <= self.largest:
            self.largest = seconds

    @property
    def mean(self) -> float:
        """Return the mean duration in seconds; NaN if there is none."""
        return self.total / self.count if self.count else nan

    def percentile(self, percent: float) -> float:
        """Return the duration in seconds that ``percent`` of all do not exceed; NaN if there is none."""
        if not 0.0 <= percent <= 100.0:
            raise ValueError(f"a percentile lies in 0 to 100, not at {percent}")
        if self.count == 0:
            return nan
        if percent == 100.0:
            return self.largest
        # The rounding corrects products such as 99.9 % of 1000, which is 999.0000000000001.
        rank = max(1, ceil(round(percent / 100.0 * self.count, 6)))
        index = next(index for index, passed in enumerate(accumulate(self._bins)) if passed >= rank)
        end = inf if index == len(self._bins) - 1 else LOWEST * exp(index / _SCALE)
        return min(end, self.largest)

    def merge(self, other: Histogram) -> None:
        """Add all durations of ``other``."""
        if other.count:
            self._bins = [a + b for a, b in zip(self._bins, other._bins, strict=True)]
            self.least = min(self.least if self.count else inf, other.least)
            self.largest = max(self.largest if self.count else -inf, other.largest)
            self.count += other.count
            self.total += other.total

    def to_dict(self) -> dict[str, Any]:
        """Return the histogram as plain data, fit for JSON."""
        return {
            "resolution": RESOLUTION,
            "lowest": LOWEST,
            "highest": HIGHEST,
            "total": self.total,
            "least": self.least if self.count else None,
            "largest": self.largest if self.count else None,
            "bins": {str(index): number for index, number in enumerate(self._bins) if number},
        }

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Histogram:
        """Return the histogram that `to_dict` described.

        Raises:
            ValueError: The data contain a bin that such a histogram does not have.
        """
        histogram = cls()
        for index, number in data["bins"].items():
            if not (0 <= int(index) < len(histogram._bins) and number > 0):
                raise ValueError(f"a histogram of {len(histogram._bins)} bins has no bin {index} with {number} entries")
            histogram._bins[int(index)] = number
        histogram.count = sum(histogram._bins)
        if histogram.count:
            histogram.total, histogram.least, histogram.largest = data["total"], data["least"], data["largest"]
        return histogram


@dataclass
class Threshold:
    """Thresholds of a duration, with counts of the durations above them.

    Attributes:
        warning: Longer durations count as warnings, in seconds.
        error: Longer durations count as errors, in seconds.
        warnings: Number of durations above ``warning``, up to ``error``.
        errors: Number of durations above ``error``.
    """

    warning: float
    error: float
    warnings: int = 0
    errors: int = 0


QUANTITIES = ("lateness", "step", "cycle")
_COUNTS = ("misses", "run", "longest_run", "foreign", "off_pace")


class LoopStatistics:
    """Statistics of a loop with a fixed period, in constant memory.

    Args:
        period: Period of the loop, in seconds.

    Attributes:
        histograms: Histograms of ``lateness`` (from the deadline to the wake-up), ``step`` (of the DPS) and ``cycle``
            (all work of a cycle, from the wake-up on).
        thresholds: Thresholds of the same quantities: warnings above half a period, errors above a whole one.
        misses: Number of deadlines that passed while the loop worked on an earlier cycle.
        run: Number of misses in a row, up to now.
        longest_run: Number of misses in the longest such row.
        foreign: Number of commands of other publishers that were heard while the loop commanded.
        off_pace: Number of cycles in which the messages that begin them came at another pace than the period.
    """

    def __init__(self, period: float) -> None:
        if not 0.0 < period < inf:
            raise ValueError(f"a loop has a positive period, not {period} s")
        self.period = period
        self.histograms = {name: Histogram() for name in QUANTITIES}
        self.thresholds = {name: Threshold(0.5 * period, period) for name in QUANTITIES}
        self.misses = 0
        self.run = 0
        self.longest_run = 0
        self.foreign = 0
        self.off_pace = 0
        self._missed = False
        self._recorders = tuple((self.histograms[name].record, self.thresholds[name]) for name in QUANTITIES)

    def record(self, *, lateness: float, step: float, cycle: float) -> None:
        """Record the durations of one cycle, in seconds.

        Args:
            lateness: Time from the deadline to the begin of the cycle, in s.
            step: Time of the DPS's step, in s.
            cycle: Time of the whole cycle, in s.
        """
        for (record, threshold), seconds in zip(self._recorders, (lateness, step, cycle), strict=True):
            record(seconds)
            if seconds > threshold.warning:
                if seconds > threshold.error:
                    threshold.errors += 1
                else:
                    threshold.warnings += 1
        if not self._missed:
            self.run = 0
        self._missed = False

    def miss(self, number: int) -> None:
        """Record after a cycle how many deadlines passed before it ended; 0 ends the row of misses."""
        if number < 0:
            raise ValueError(f"the number of missed deadlines is not negative, unlike {number}")
        self._missed = number > 0
        self.misses += number
        self.run = self.run + number if number else 0
        self.longest_run = max(self.longest_run, self.run)

    @property
    def cycles(self) -> int:
        """Return the number of recorded cycles."""
        return self.histograms["cycle"].count

    @property
    def level(self) -> str:
        """Return the worst level so far.

        It is ``error`` or ``warning`` if a duration exceeded such a threshold, ``error`` if the pace was another than
        the period, otherwise ``ok``.
        """
        thresholds = self.thresholds.values()
        if self.off_pace or any(t.errors for t in thresholds):
            return "error"
        return "warning" if any(t.warnings for t in thresholds) else "ok"

    def _cause(self) -> str:
        errors = [f"{t.errors} x {name} > {1e6 * t.error:.0f} us" for name, t in self.thresholds.items() if t.errors]
        return f" ({', '.join(errors)})" if errors else ""

    def to_dict(self) -> dict[str, Any]:
        """Return the statistics as plain data, fit for JSON."""
        return {
            "period": self.period,
            "histograms": {name: histogram.to_dict() for name, histogram in self.histograms.items()},
            "thresholds": {name: vars(threshold).copy() for name, threshold in self.thresholds.items()},
            **{name: getattr(self, name) for name in _COUNTS},
        }

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> LoopStatistics:
        """Return the statistics that `to_dict` described."""
        statistics = cls(data["period"])
        for name in QUANTITIES:
            vars(statistics.thresholds[name]).update(data["thresholds"][name])
            statistics.histograms[name].merge(Histogram.from_dict(data["histograms"][name]))
        for name in _COUNTS:
            setattr(statistics, name, data[name])
        return statistics

    def __str__(self) -> str:
        """Return a table, in microseconds; behind the numbers of warnings and errors the durations where they begin."""
        form = "{:9}" + "{:>9}" * 5 + "{:>15}" * 2
        lines = [form.format("us", "mean", "p50", "p99", "p99.9", "max", "warnings", "errors")]
        for name, histogram in self.histograms.items():
            durations = [histogram.mean, *map(histogram.percentile, (50.0, 99.0, 99.9)), histogram.largest]
            threshold = self.thresholds[name]
            cells = [f"{1e6 * seconds:.0f}" for seconds in durations]
            counts = ((threshold.warnings, threshold.warning), (threshold.errors, threshold.error))
            cells += [f"{count} > {1e6 * limit:.0f}" for count, limit in counts]
            lines.append(form.format(name, *cells))
        summary = f"{self.cycles} cycles of {1e6 * self.period:.0f} us, {self.misses} deadlines missed"
        lines.append(f"{summary} ({self.longest_run} in a row at most): {self.level}{self._cause()}")
        if self.off_pace:
            lines.append(
                f"ALARM: in {self.off_pace} cycles the messages that begin them came at another pace than the period"
            )
        if self.foreign:
            lines.append(
                f"ALARM: other publishers commanded the machine, too: {self.foreign} of their commands were heard"
            )
        return "\n".join(lines)
