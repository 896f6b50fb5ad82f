"""How well a simulation agrees with a recording: numbers per signal, and a verdict by declared tolerances."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from math import acos, hypot, inf, isnan, nan, pi, sqrt
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import scipy

from vtbdrake import upper_layers
from vtbdrake.calibration.report_page import save_page
from vtbdrake.common.argument_checks import suggestion
from vtbdrake.common.arrays import Array
from vtbdrake.common.settings import check_settings, setting
from vtbdrake.recording.log import Log, Series
from vtbdrake.recording.log_format import LogError
from vtbdrake.state.variables import text_table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# The largest delay that is looked for, as a share of the recording.
_LARGEST_DELAY = 0.25
# Largest number of lags of the test of whiteness.
_MOST_LAGS = 40
# Largest number of lags, as a share of the samples.
_LAG_SHARE = 0.2
# Share of the recording that a predicted band is to cover.
BAND = 0.95


COLUMNS = {
    "RMSE": ("rmse", 1.0),
    "% of the range": ("normalized", 100.0),
    "largest": ("largest", 1.0),
    "at (s)": ("largest_at", 1.0),
    "late by (ms)": ("delay", 1e3),
    "magnitude": ("magnitude", 1.0),
    "phase": ("phase", 1.0),
    "coverage": ("coverage", 1.0),
    "whiteness p": ("whiteness", 1.0),
}
"""The columns of tables: title -> field of a `SignalComparison`, and the factor to the unit of the title."""


class ComparisonVerdict(StrEnum):
    """The outcome of a comparison."""

    WITHIN = "within tolerances"
    BEYOND = "beyond tolerances"
    NOT_JUDGED = "not judged"  # there is no tolerance


@dataclass(frozen=True, kw_only=True)
class ToleranceConfig:
    """The differences between a recording and its simulation that are acceptable; infinite: any."""

    rmse: float = setting(inf, "Root mean square of the differences, in the signal's unit.", ge=0, finite=False)
    largest: float = setting(inf, "Largest difference, in the signal's unit.", ge=0, finite=False)
    delay: float = setting(inf, "Largest delay, early or late.", unit="s", ge=0, finite=False)
    magnitude: float = setting(inf, "Largest magnitude error of Sprague and Geers.", ge=0, finite=False)
    phase: float = setting(inf, "Largest phase error of Sprague and Geers.", ge=0, finite=False)
    coverage: float = setting(0.0, "Least share of the samples within the predicted band.", ge=0, le=1)

    def __post_init__(self) -> None:
        check_settings(self)


class SignalComparison(NamedTuple):
    """One entry of a signal: a recording r beside its simulation s, at the times of the recording.

    Attributes:
        name: ``signal``, or ``signal[i]`` for one of several entries.
        samples: Number of compared samples.
        rmse: Root mean square of s - r.
        normalized: `rmse` over the range of r; infinite if r never changes.
        largest: The largest absolute difference.
        largest_at: Its time, in s.
        delay: The time in s by which s is late, from the maximum of the cross-correlation; NaN without any variation.
        magnitude: M of Sprague and Geers, sqrt(sum s^2 / sum r^2) - 1.
        phase: P of Sprague and Geers, acos(sum r s / sqrt(sum r^2 sum s^2)) / pi.
        combined: sqrt(M^2 + P^2).
        coverage: Share of r within the band of several simulations; NaN with one.
        whiteness: The p-value of the residuals' being white, by the test of Ljung and Box.
        beyond: The tolerances that are exceeded, as sentences.
        verdict: Whether it is within its tolerances.
    """

    name: str
    samples: int
    rmse: float
    normalized: float
    largest: float
    largest_at: float
    delay: float
    magnitude: float
    phase: float
    combined: float
    coverage: float
    whiteness: float
    beyond: tuple[str, ...]
    verdict: ComparisonVerdict

    @property
    def cells(self) -> tuple[str, ...]:
        """Return the numbers below `COLUMNS`; what cannot be computed is empty."""
        numbers = (getattr(self, name) * factor for name, factor in COLUMNS.values())
        return tuple("" if isnan(number) else f"{number:.4g}" for number in numbers)


@dataclass(frozen=True, eq=False)
class Comparison:
    """A recording and its simulation, signal by signal.

    Attributes:
        source: What the recording is.
        signals: The results, by name.
        curves: Times (n,), recording (n,), simulation (n,), and lower and upper end of the band (n,), by name.
    """

    source: str
    signals: Mapping[str, SignalComparison]
    curves: Mapping[str, tuple[Array, Array, Array, Array, Array]]

    @property
    def verdict(self) -> ComparisonVerdict:
        """Return the verdict about all signals: beyond, if one is; not judged, if no signal has tolerances."""
        verdicts = {result.verdict for result in self.signals.values()}
        return next(
            (each for each in (ComparisonVerdict.BEYOND, ComparisonVerdict.WITHIN) if each in verdicts),
            ComparisonVerdict.NOT_JUDGED,
        )

    def __str__(self) -> str:
        rows = [[name, *result.cells, str(result.verdict)] for name, result in self.signals.items()]
        reasons = [f"{name}: {reason}" for name, result in self.signals.items() for reason in result.beyond]
        head = ("signal", *COLUMNS, "verdict")
        return "\n".join([f"{self.source}: {self.verdict}", text_table(head, rows), *reasons])

    def _repr_html_(self) -> str:
        return upper_layers.comparison_html(self)

    def plot(self) -> Figure:
        """Return a figure with every signal and its residuals."""
        return upper_layers.plot_comparison(self)

    def save_html(self, path: str | os.PathLike[str]) -> None:
        """Write one HTML file with verdict, numbers and plots."""
        save_page(path, self.source, self._repr_html_())


def compare(
    reference: Log | Mapping[str, Series],
    simulation: Log | Mapping[str, Series] | Sequence[Log | Mapping[str, Series]],
    *,
    tolerances: Mapping[str, ToleranceConfig] | None = None,
) -> Comparison:
    """Compare a simulation, or several, with a recording.

    Every sensor signal that both have is compared at the times of the recording, between which the simulation is
    interpolated. With several simulations (samples of uncertain parameters, or other seeds) the median is compared,
    and their quantiles make the predicted band, of 95 %.

    Args:
        reference: The recording.
        simulation: The simulation, or at least two.
        tolerances: What is acceptable, by signal. A signal without is reported, and not judged.

    Raises:
        LogError: No signal is in both, a size differs, the times do not overlap, or a tolerance is for no such signal.
    """
    recorded = _signals(reference)
    simulations = [_signals(each) for each in ([simulation] if isinstance(simulation, Log | Mapping) else simulation)]
    if not simulations:
        raise LogError("there is no simulation to compare with")
    names = [name for name in recorded if all(name in simulated for simulated in simulations)]
    source = reference.source if isinstance(reference, Log) else "the recording"
    if not names:
        raise LogError(f"{source} has {', '.join(recorded) or 'no signal'}, the simulation {', '.join(simulations[0])}")
    for name in tolerances or {}:
        if name not in names:
            raise LogError(
                f"a tolerance for {name!r}, which is in no recording and its simulation{suggestion(name, names)}"
            )
    results, curves = {}, {}
    for name in names:
        times, references, samples = _common(name, recorded[name], [each[name] for each in simulations])
        tolerance = (tolerances or {}).get(name)
        for k in range(references.shape[1]):
            label = name if references.shape[1] == 1 else f"{name}[{k}]"
            lower, middle, upper = np.quantile(samples[:, :, k], [0.5 - 0.5 * BAND, 0.5, 0.5 + 0.5 * BAND], axis=0)
            curve = (times, references[:, k], middle, lower, upper)
            results[label] = _result(label, curve, len(simulations) > 1, tolerance)
            curves[label] = curve
    return Comparison(source, results, curves)


def _signals(log: Log | Mapping[str, Series]) -> Mapping[str, Series]:
    return log.sense if isinstance(log, Log) else log


def _common(name: str, reference: Series, simulations: Sequence[Series]) -> tuple[Array, Array, Array]:
    """Return the times (n,) where all have values, the recording (n, size), and the simulations (m, n, size)."""
    for simulated in simulations:
        if simulated.values.shape[1] != reference.values.shape[1]:
            raise LogError(
                f"{name} has {reference.values.shape[1]} entries in the recording, {simulated.values.shape[1]} in the "
                "simulation"
            )
    begin = max(each.times[0] for each in simulations)
    end = min(each.times[-1] for each in simulations)
    rows = (reference.times >= begin) & (reference.times <= end)
    times = reference.times[rows]
    if len(times) < 2:
        raise LogError(
            f"{name} is recorded from {reference.times[0]:g} to {reference.times[-1]:g} s and simulated from {begin:g} "
            f"to {end:g} s: fewer than two samples in common"
        )
    samples = [
        np.column_stack([np.interp(times, each.times, each.values[:, k]) for k in range(each.values.shape[1])])
        for each in simulations
    ]
    return times, reference.values[rows], np.array(samples)


def _result(
    name: str, curve: tuple[Array, Array, Array, Array, Array], banded: bool, tolerance: ToleranceConfig | None
) -> SignalComparison:
    times, r, s, lower, upper = curve
    residuals = s - r
    worst = int(np.argmax(abs(residuals)))
    rmse, span = float(np.sqrt(np.mean(residuals**2))), float(np.ptp(r))
    magnitude, phase = sprague_geers(r, s)
    numbers = {
        "rmse": rmse,
        "normalized": rmse / span if span else inf,
        "largest": float(abs(residuals[worst])),
        "largest_at": float(times[worst]),
        "delay": delay(times, r, s),
        "magnitude": magnitude,
        "phase": phase,
        "combined": hypot(magnitude, phase),
        "coverage": float(np.mean((lower <= r) & (r <= upper))) if banded else nan,
        "whiteness": whiteness(residuals),
    }
    beyond = () if tolerance is None else _beyond(numbers, tolerance)
    verdict = (
        ComparisonVerdict.NOT_JUDGED
        if tolerance is None
        else ComparisonVerdict.BEYOND
        if beyond
        else ComparisonVerdict.WITHIN
    )
    return SignalComparison(name=name, samples=len(times), **numbers, beyond=beyond, verdict=verdict)


def _beyond(numbers: Mapping[str, float], tolerance: ToleranceConfig) -> tuple[str, ...]:
    """Return the tolerances that are exceeded; what cannot be computed exceeds its tolerance."""
    reasons = []
    for field in ("rmse", "largest", "delay", "magnitude", "phase"):
        limit, value = getattr(tolerance, field), abs(numbers[field])
        if limit < inf and not value <= limit:
            reasons.append(f"{field} {value:.4g} > {limit:g}")
    if tolerance.coverage > 0.0 and not numbers["coverage"] >= tolerance.coverage:
        reasons.append(f"coverage {numbers['coverage']:.4g} < {tolerance.coverage:g}")
    return tuple(reasons)


def sprague_geers(r: Array, s: Array) -> tuple[float, float]:
    """Return the errors of magnitude and phase of a curve s (n,) beside r (n,), at equal times.

    Source: M. A. Sprague and T. L. Geers, "A spectral-element method for modelling cavitation in transient
    fluid-structure interaction", Int. J. Numer. Meth. Engng. 60 (2004). (NaN, NaN) if a curve is zero.

    Args:
        r: The curve that is compared with, such as the measured one.
        s: The curve that is judged, in the same unit.
    """
    rr, ss, rs = float(r @ r), float(s @ s), float(r @ s)
    if rr == 0.0 or ss == 0.0:
        return nan, nan
    return sqrt(ss / rr) - 1.0, acos(min(1.0, max(-1.0, rs / sqrt(rr * ss)))) / pi


def delay(times: Array, r: Array, s: Array) -> float:
    """Return by which time in s the curve s (n,) is late behind r (n,); NaN if one of them never changes.

    It is the maximum of the normalized cross-correlation, over at most a quarter of the recording, with a parabola
    through its three highest values. Curves are taken at equal distances for it.

    Args:
        times: The times of both curves, (n,), in s; increasing.
        r: The curve that is compared with, such as the measured one.
        s: The curve that is judged.
    """
    step = float(np.median(np.diff(times)))
    grid = np.arange(times[0], times[-1] + 0.5 * step, step)
    a, b = (np.interp(grid, times, curve) for curve in (r, s))
    a, b = a - a.mean(), b - b.mean()
    if not (a.any() and b.any()):
        return nan
    n, most = len(grid), max(int(_LARGEST_DELAY * len(grid)), 1)
    # Sum over the common part, divided by what its energy allows: else, a short common part counts less.
    lags = np.arange(-min(most, n - 1), min(most, n - 1) + 1)
    products = scipy.signal.correlate(b, a, mode="full")[n - 1 + lags]
    energy_a, energy_b = (np.concatenate([[0.0], np.cumsum(curve**2)]) for curve in (a, b))
    late = np.maximum(lags, 0)
    early = np.maximum(-lags, 0)
    norms = np.sqrt((energy_a[n - late] - energy_a[early]) * (energy_b[n - early] - energy_b[late]))
    correlation = np.where(norms > 0.0, products / np.where(norms > 0.0, norms, 1.0), -1.0)
    top = int(np.argmax(correlation))
    if 0 < top < len(lags) - 1:
        before, middle, after = correlation[top - 1 : top + 2]
        curvature = before - 2.0 * middle + after
        return float(step * (lags[top] + (0.5 * (before - after) / curvature if curvature else 0.0)))
    return float(step * lags[top])


def whiteness(residuals: Array) -> float:
    """Return the p-value of the hypothesis that residuals (n,) are white.

    Source: G. M. Ljung and G. E. P. Box, "On a measure of lack of fit in time series models", Biometrika 65 (1978).
    NaN for fewer than eight residuals; 1 if they are all equal.
    """
    n = len(residuals)
    if n < 8:
        return nan
    centred = residuals - residuals.mean()
    if not centred.any():
        return 1.0
    lags = min(_MOST_LAGS, int(_LAG_SHARE * n))
    correlation = scipy.signal.correlate(centred, centred, mode="full")[n : n + lags] / float(centred @ centred)
    statistic = n * (n + 2) * float(np.sum(correlation**2 / (n - np.arange(1, lags + 1))))
    return float(scipy.stats.chi2.sf(statistic, lags))
