"""The compiled numerics of a cycle agree with numpy and with the rules."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from vtbdrake.control.kernels import Bins, Bounds, RateLimiter, ReceivedSignal, StalenessMonitor, finite, found

NOT_VECTORS: list[Any] = [
    None,
    [1.0, 2.0],
    (1.0, 2.0),
    np.ones(3),
    np.ones(1),
    np.ones((2, 1)),
    np.array(1.0),
    np.ones(2, dtype=np.float32),
    np.ones(2, dtype=int),
    np.ones(2, dtype=">f8"),
    np.ones(4)[::2],
    np.ma.masked_array([1.0, 2.0], [True, False]),
]


# -- what is a vector


@pytest.mark.parametrize("value", NOT_VECTORS)
def test_only_plain_arrays_of_doubles_are_looked_at(value: Any) -> None:
    assert not finite(value, 2)
    assert not Bounds([-9.0, -9.0], [9.0, 9.0]).contains(value)
    assert RateLimiter([(9.0, 9.0, -9.0, 9.0)] * 2).advance(value, np.zeros(2), np.zeros(2)) is None


def test_arrays_that_cannot_be_written_can_be_looked_at() -> None:
    value = np.ones(2)
    value.flags.writeable = False
    assert finite(value, 2) and Bounds([0.0, 0.0], [1.0, 1.0]).contains(value)


@given(st.lists(st.floats(), min_size=3, max_size=3))
def test_a_vector_is_finite_as_numpy_says(entries: list[float]) -> None:
    assert finite(np.array(entries), 3) == np.isfinite(entries).all()


@given(*[st.lists(st.floats(-2.0, 2.0) | st.sampled_from([math.nan, math.inf]), min_size=3, max_size=3)] * 3)
def test_a_box_contains_what_numpy_says(lower: list[float], entries: list[float], upper: list[float]) -> None:
    inside = np.all((np.array(lower) <= entries) & (np.array(entries) <= upper))
    assert Bounds(lower, upper).contains(np.array(entries)) == inside


def test_what_passes_leaves_its_step_and_what_does_not_leaves_nothing() -> None:
    passage = RateLimiter([(0.5, 0.3, -1.0, 1.0)] * 2)
    sent, step = np.array([0.1, 0.2]), np.array([0.05, 0.0])
    command = np.array([0.3, 0.1])
    passed = passage.advance(command, sent, step)
    assert passed is not command
    np.testing.assert_array_equal([passed, sent], [command, command])
    np.testing.assert_allclose(step, [0.2, -0.1], atol=1e-15)
    assert passage.advance(np.array([0.4, 0.9]), sent, step) is None
    np.testing.assert_array_equal(sent, [0.3, 0.1])


def test_limits_that_do_not_belong_together_are_refused() -> None:
    with pytest.raises(ValueError, match="as many lower limits as upper ones, not 3 and 1"):
        Bounds([0.0] * 3, [1.0])
    with pytest.raises(ValueError, match="values to unpack"):
        RateLimiter([(1.0, 1.0, 0.0)])


# -- ages and histograms


class Examined(StalenessMonitor):
    """Finds fault with values below 0."""

    def __init__(self) -> None:
        super().__init__(0.5)
        self.times: list[float] = []

    def stale(self, now: float, reception: ReceivedSignal) -> Any:
        return "stale"

    def examine(self, now: float, reception: ReceivedSignal) -> Any:
        self.times.append(now)
        return "negative" if reception.value < 0.0 else None


def test_a_value_is_examined_once_and_its_age_in_every_cycle() -> None:
    watch, reception = Examined(), ReceivedSignal()
    assert watch.check(0.0, reception) == "stale"
    reception.accept(-1.0, 1.0, math.nan)
    assert [watch.check(now, reception) for now in (1.0, 1.25, 1.5, 1.75)] == ["negative"] * 3 + ["stale"]
    reception.accept(1.0, 2.0, math.nan)
    assert [watch.check(now, reception) for now in (2.0, 2.25)] == [None, None]
    assert watch.times == [1.0, 2.0]


def test_only_a_reception_has_an_age() -> None:
    nothing: Any = None
    with pytest.raises(TypeError, match="of its ReceivedSignal, not of None"):
        Examined().check(0.0, nothing)
    with pytest.raises(TypeError, match="StalenessMonitor"):
        found(0.0, {"a": nothing}, {"a": ReceivedSignal()})


@given(st.lists(st.floats(1e-9, 1e3), min_size=1, max_size=30))
def test_durations_fall_into_their_bins(durations: list[float]) -> None:
    scale, number = 5.0, 20
    ends = [1e-3 * math.exp(k / scale) for k in range(number - 1)]
    assume(not np.isclose(np.divide.outer(durations, ends), 1.0, rtol=1e-12).any())  # There, rounding decides.
    bins = Bins(ends[0], ends[-1], scale, number)
    for duration in durations:
        bins.record(duration)
    expected = np.bincount(np.searchsorted(ends, durations), minlength=number)
    assert bins.counts() == expected.tolist()
    assert (bins.count, bins.least, bins.largest) == (len(durations), min(durations), max(durations))


def test_bins_that_are_not_divided_take_no_duration() -> None:
    with pytest.raises(RuntimeError, match="have to be divided first"):
        Bins.__new__(Bins).record(1.0)


@pytest.mark.parametrize("scale", [-1.0, 0.0, math.inf, math.nan])
def test_bins_of_no_scale_are_refused(scale: float) -> None:
    with pytest.raises(ValueError, match=f"of the scale {scale}"):
        Bins(1.0, 2.0, scale, 5)


def test_counts_are_added_all_or_none() -> None:
    bins = Bins(1.0, 2.0, 5.0, 3)
    wrong: Any = [1, 2, "three"]
    with pytest.raises(TypeError):
        bins.add(wrong, 3.0, 1.0, 2.0)
    assert (bins.counts(), bins.count, bins.total) == ([0, 0, 0], 0, 0.0)
