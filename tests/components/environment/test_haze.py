"""Haze against the law of Beer and Lambert, and its false returns against their distribution."""

from __future__ import annotations

import numpy as np
import pytest

from vtbdrake.components.environment import Haze
from vtbdrake.components.environment.haze import (
    extinction_of_visibility,
    false_return_ranges,
    hazed,
    transmission,
    two_way_transmission,
)


def test_extinctions_of_layers_multiply() -> None:
    d = np.array([0.0, 1.0, 30.0])
    np.testing.assert_allclose(transmission(0.1, d), [1.0, 0.9048374180359595, 0.049787068367863944])
    np.testing.assert_allclose(transmission(0.1, d) * transmission(0.1, 5.0), transmission(0.1, d + 5.0))
    np.testing.assert_allclose(two_way_transmission(0.1, d), transmission(0.1, d) ** 2)
    np.testing.assert_array_equal(transmission(0.0, np.array([1.0, np.inf])), [1.0, 1.0])


def test_contrast_falls_to_two_percent_at_the_visibility() -> None:
    black_and_sky = np.array([[[0.0] * 3, [200.0] * 3]])
    b = extinction_of_visibility(50.0)
    assert b == pytest.approx(3.912 / 50.0, rel=1e-4)
    seen = hazed(black_and_sky, distance=np.array([[50.0, np.inf]]), extinction=b, airlight=200.0)
    assert (200.0 - seen[0, 0]) / 200.0 == pytest.approx(0.02)
    np.testing.assert_allclose(seen[0, 1], 200.0)
    with pytest.raises(ValueError, match="positive distance in m"):
        extinction_of_visibility(0.0)


@pytest.mark.parametrize(("extinction", "least"), [(0.05, 0.0), (0.05, 0.5), (0.0, 0.5)])
def test_first_false_returns_have_the_distribution_of_a_poisson_process(extinction: float, least: float) -> None:
    n, rate, limit = 200_000, 0.02, 15.0
    u = np.random.default_rng(0).random(n)
    ranges = false_return_ranges(u, extinction=extinction, backscatter=rate, least_range=least)
    assert ranges.min() >= least
    # The expected number of detections before the limit, by numerical integration of the rate.
    r = np.linspace(least, limit, 2000)
    expected = np.trapezoid(rate * np.exp(-2.0 * extinction * r), r)
    share = 1.0 - np.exp(-expected)
    assert (ranges < limit).mean() == pytest.approx(share, abs=4.0 * np.sqrt(share / n))


def test_clear_air_returns_nothing() -> None:
    assert np.isinf(false_return_ranges(np.array([0.0, 0.999]), extinction=0.1, backscatter=0.0)).all()


def test_port_shows_parameters_as_they_are_set() -> None:
    haze = Haze(extinction=0.1, airlight=(0.5, 0.6, 0.7))
    context = haze.CreateDefaultContext()
    np.testing.assert_array_equal(haze.GetOutputPort("haze").Eval(context), [0.1, 0.0, 0.5, 0.6, 0.7])
    context.get_mutable_numeric_parameter(0).SetAtIndex(0, 0.3)
    assert haze.GetOutputPort("haze").Eval(context)[0] == 0.3
    assert [e.name for e in haze.variables] == ["extinction", "backscatter", "airlight"]


@pytest.mark.parametrize("wrong", [{"extinction": -1.0}, {"backscatter": np.nan}, {"airlight": (1.0, 1.0)}])
def test_impossible_haze_is_refused(wrong: dict) -> None:
    with pytest.raises(ValueError, match="finite and not negative"):
        Haze(**wrong)
