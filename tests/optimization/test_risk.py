"""Qualities under several conditions: each risk against its definition."""

from fractions import Fraction
from math import ceil

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vtbdrake.optimization import CVaR, Mean, Quantile, Worst
from vtbdrake.optimization.records import Outcome
from vtbdrake.optimization.risk import Risk, aggregate

pytestmark = pytest.mark.one_python

qualities = st.lists(st.floats(0.0, 1.0), min_size=1, max_size=12).map(np.array)
risks = st.one_of(
    st.sampled_from([Mean(), Worst()]),
    st.floats(0.01, 1.0).map(Quantile),
    st.floats(0.01, 1.0).map(CVaR),
)


def cvar_by_definition(h: np.ndarray, level: float) -> float:
    """max over c of c - E[max(c - h, 0)] / level (Rockafellar and Uryasev, 2002); a maximum lies at one of the h."""
    return max(c - np.mean(np.maximum(c - h, 0.0)) / level for c in h)


@given(qualities, st.floats(0.01, 1.0))
def test_cvar_is_the_maximum_of_rockafellar_and_uryasev(h, level):
    assert CVaR(level)(h) == pytest.approx(cvar_by_definition(h, level), abs=1e-9)


@given(qualities, st.floats(0.01, 1.0))
def test_all_but_a_share_reach_the_quantile(h, level):
    value = Quantile(level)(h)
    assert value in h
    assert np.mean(h < value) < level
    assert np.mean(h <= value) >= level - 1e-12


def test_mean_and_worst():
    h = np.array([0.5, 0.25, 1.0])
    assert (Mean()(h), Worst()(h)) == (h.sum() / 3, 0.25)
    assert CVaR(1.0)(h) == Mean()(h)
    assert CVaR(1e-6)(h) == pytest.approx(Worst()(h))


@given(qualities, risks, st.data())
def test_no_risk_falls_when_a_quality_rises(h, risk, data):
    which = data.draw(st.integers(0, h.size - 1))
    higher = h.copy()
    higher[which] += data.draw(st.floats(0.0, 1.0))
    assert risk(higher) >= risk(h) - 1e-12


@pytest.mark.parametrize("make", [lambda: CVaR(0.0), lambda: Quantile(1.5)])
def test_a_level_beyond_its_range_is_refused(make):
    with pytest.raises(ValueError, match=r"lies in \(0, 1\], unlike"):
        make()


def test_the_rank_of_a_quantile_is_that_of_exact_arithmetic():
    # 0.28 * 25 is above 7 in floating point.
    for percent in range(1, 101):
        for count in (1, 7, 25, 50, 100):
            rank = ceil(Fraction(percent, 100) * count)
            assert Quantile(percent / 100)(np.arange(1.0, count + 1.0)) == rank


class OfAUser(Risk):
    def __init__(self, returned):
        self.returned = returned

    def __call__(self, h):
        return self.returned


@pytest.mark.parametrize(
    ("returned", "message"),
    [
        ("1.5", "the risk OfAUser must return a real number, not '1.5'"),
        (None, "the risk OfAUser must return a real number, not None"),
        (float("nan"), r"the risk OfAUser is NaN for the qualities \[1\.0, 2\.0\]"),
    ],
)
def test_a_risk_that_is_no_number_is_refused(returned, message):
    outcomes = [Outcome(h, h, (), 0.0, "horizon", "", 0.0) for h in (1.0, 2.0)]
    with pytest.raises(ValueError, match=message):
        aggregate(outcomes, risk=OfAUser(returned), minimize=[False], constraints=0, bounds=[np.inf])
