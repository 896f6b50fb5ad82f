"""Histograms agree with numpy within the width of a bin; a loop's statistics count what happened."""

from __future__ import annotations

import json
from fractions import Fraction
from math import ceil, isnan, nan

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vtbdrake.control.statistics import Histogram, LoopStatistics

pytestmark = pytest.mark.one_python

PERCENTS = (0.0, 1.0, 50.0, 90.0, 99.0, 99.9, 100.0)


def filled(durations: np.ndarray) -> Histogram:
    histogram = Histogram()
    for seconds in durations.tolist():
        histogram.record(seconds)
    return histogram


def samples(seed: int, number: int = 5000) -> np.ndarray:
    return np.random.default_rng(seed).lognormal(mean=np.log(2e-4), sigma=1.5, size=number)


@pytest.mark.parametrize("seed", [1, 2])
def test_percentiles_agree_with_numpy_within_a_bin(seed: int) -> None:
    durations = samples(seed, 4987)  # A prime: no percentile falls on the edge between two ranks.
    histogram = filled(durations)
    for percent in PERCENTS:
        exact = np.percentile(durations, percent, method="inverted_cdf")
        bound = max(1e-6, exact * 1.01 * (1 + 1e-9))
        assert exact * (1 - 1e-9) <= histogram.percentile(percent) <= bound


@given(st.lists(st.floats(1e-6, 10.0), min_size=1, max_size=50), st.integers(0, 1000))
def test_percentile_exceeds_the_true_one_by_at_most_a_bin(durations: list[float], permille: int) -> None:
    exact = sorted(durations)[max(1, ceil(Fraction(permille, 1000) * len(durations))) - 1]
    found = filled(np.array(durations)).percentile(permille / 10)
    assert exact * (1 - 1e-9) <= found <= exact * 1.01 * (1 + 1e-9)


def test_mean_least_largest_and_count_are_exact() -> None:
    durations = samples(3)
    histogram = filled(durations)
    assert histogram.count == durations.size
    assert histogram.mean == pytest.approx(durations.mean(), rel=1e-12)
    assert (histogram.least, histogram.largest) == (durations.min(), durations.max())


def test_durations_beyond_both_ends_are_kept() -> None:
    histogram = filled(np.array([-1e-3, 0.0, 1e-9, 1e-6, 10.0, 25.0]))
    assert histogram.percentile(50.0) == 1e-6
    assert histogram.percentile(80.0) == 25.0
    assert (histogram.count, histogram.least, histogram.largest) == (6, -1e-3, 25.0)


def test_percentile_never_exceeds_the_largest() -> None:
    assert filled(np.array([1.004e-3])).percentile(50.0) == 1.004e-3


def test_percentile_rank_is_exact() -> None:
    durations = np.array([1e-3] * 999 + [1.0])
    assert filled(durations).percentile(99.9) < 2e-3


def test_memory_is_constant() -> None:
    histogram = Histogram()
    size = len(histogram.to_dict()["bins"])
    for seconds in samples(4, number=20_000).tolist():
        histogram.record(seconds)
    assert size == 0
    assert len(histogram.to_dict()["bins"]) <= 1622  # 1620 bins between 1 us and 10 s at 1 %, and one at each end.


def test_histogram_shows_itself_in_a_line() -> None:
    histogram = Histogram()
    histogram.record(0.1)
    histogram.record(0.3)
    assert repr(histogram) == "Histogram(2 durations, mean 0.2 s, largest 0.3 s)"


def test_empty_histogram_has_nan_statistics() -> None:
    histogram = Histogram()
    assert all(isnan(x) for x in (histogram.mean, histogram.least, histogram.largest, histogram.percentile(50.0)))


def test_nan_is_rejected() -> None:
    histogram = Histogram()
    with pytest.raises(ValueError, match="NaN"):
        histogram.record(nan)
    assert histogram.count == 0


def test_merged_histograms_equal_joint_histogram() -> None:
    a, b = samples(5), 0.5 * samples(6)
    merged = filled(a)
    merged.merge(filled(b))
    together = filled(np.concatenate([a, b])).to_dict()
    assert merged.to_dict() == {**together, "total": pytest.approx(together["total"], rel=1e-12)}


@pytest.mark.parametrize("durations", [samples(7), np.array([])])
def test_histogram_survives_json(durations: np.ndarray) -> None:
    histogram = filled(durations)
    again = Histogram.from_dict(json.loads(json.dumps(histogram.to_dict())))
    assert again.to_dict() == histogram.to_dict()
    again.record(0.5)
    histogram.record(0.5)
    assert again.to_dict() == histogram.to_dict()


def test_unknown_bin_is_rejected() -> None:
    data = filled(np.array([1e-3])).to_dict()
    with pytest.raises(ValueError, match="no bin 99999"):
        Histogram.from_dict({**data, "bins": {"99999": 1}})


@pytest.mark.parametrize("percent", [-1.0, 100.1, nan])
def test_percentile_out_of_range_is_rejected(percent: float) -> None:
    with pytest.raises(ValueError, match="0 to 100"):
        Histogram().percentile(percent)


def test_durations_above_thresholds_are_counted_once() -> None:
    statistics = LoopStatistics(2e-4)
    for step in (1e-4, 1.5e-4, 2e-4, 2.5e-4):
        statistics.record(lateness=0.0, step=step, cycle=1e-4)
    assert (statistics.thresholds["step"].warnings, statistics.thresholds["step"].errors) == (2, 1)
    assert statistics.thresholds["cycle"].warnings == 0
    assert statistics.level == "error"


def test_default_thresholds_follow_from_the_period() -> None:
    statistics = LoopStatistics(1e-3)
    statistics.record(lateness=0.6e-3, step=1e-4, cycle=0.4e-3)
    assert statistics.level == "warning"
    statistics.record(lateness=0.0, step=1e-4, cycle=1.1e-3)
    assert statistics.level == "error"
    assert statistics.cycles == 2


def test_misses_in_a_row_are_counted() -> None:
    statistics = LoopStatistics(1e-3)
    runs = []
    for number in (0, 2, 1, 0, 1, 0):
        statistics.record(lateness=0.0, step=0.0, cycle=0.0)
        statistics.miss(number)
        runs.append(statistics.run)
    assert runs == [0, 2, 3, 0, 1, 0]
    assert (statistics.misses, statistics.longest_run) == (4, 3)


def test_cycle_without_misses_ends_the_row() -> None:
    statistics = LoopStatistics(1e-3)
    statistics.miss(2)
    statistics.record(lateness=0.0, step=0.0, cycle=0.0)
    statistics.record(lateness=0.0, step=0.0, cycle=0.0)
    assert (statistics.run, statistics.longest_run) == (0, 2)


def recorded(seed: int) -> LoopStatistics:
    statistics = LoopStatistics(1e-3)
    for a, b in zip(samples(seed, 300).tolist(), samples(seed + 1, 300).tolist(), strict=True):
        statistics.record(lateness=a, step=b, cycle=a + b)
        statistics.miss(int((a + b) / 1e-3))
    statistics.foreign = seed
    return statistics


def test_statistics_survive_json() -> None:
    statistics = recorded(30)
    again = LoopStatistics.from_dict(json.loads(json.dumps(statistics.to_dict())))
    assert again.to_dict() == statistics.to_dict()


def test_table_shows_microseconds_and_misses() -> None:
    statistics = LoopStatistics(1e-3)
    statistics.record(lateness=30e-6, step=100e-6, cycle=1200e-6)
    statistics.miss(1)
    lines = [line.split() for line in str(statistics).splitlines()]
    assert lines[0] == ["us", "mean", "p50", "p99", "p99.9", "max", "warnings", "errors"]
    assert lines[3] == ["cycle", "1200", "1200", "1200", "1200", "1200", "0", ">", "500", "1", ">", "1000"]
    summary = "1 cycles of 1000 us, 1 deadlines missed (1 in a row at most): error (1 x cycle > 1000 us)"
    assert str(statistics).endswith(summary)


@pytest.mark.parametrize("period", [0.0, -1.0, nan])
def test_period_must_be_positive(period: float) -> None:
    with pytest.raises(ValueError, match="positive period"):
        LoopStatistics(period)


def test_number_of_misses_must_not_be_negative() -> None:
    with pytest.raises(ValueError, match="-1"):
        LoopStatistics(1e-3).miss(-1)
