"""The errors of a map that corrections show: against errors that were drawn, and a linear filter in closed form."""

import numpy as np
import pytest
from scipy.stats import chi2

from vtbdrake.components.localization.map_errors import ShownErrors, scatter, shown_errors

COUNT = 40
EXACT = np.zeros((2 * COUNT, 2 * COUNT))


@pytest.mark.parametrize(("told", "expected"), [(0.05, (1.0, 1.4)), (0.02, (3.5, 6.5))])
def test_scatter_is_how_much_worse_a_map_is_than_it_says(told, expected):
    """Errors of 0.05 m, all of them known: the corrections. (0.05 / 0.02)² is 6.25, less what is told."""
    rng = np.random.default_rng(0)
    places = rng.uniform(-30.0, 30.0, (COUNT, 2))
    corrections = 0.05 * rng.normal(size=(COUNT, 2)) + 0.01 * places
    found = shown_errors(places, corrections, np.full(COUNT, told**2), EXACT, np.ones(COUNT))
    assert found.freedom == pytest.approx(2 * (COUNT - 3))
    assert expected[0] <= scatter(found) < expected[1]
    assert found.distortion / scatter(found) > chi2.ppf(0.99999, 6)  # By 1 %, it is distorted all the same.
    correlated = shown_errors(places, corrections, told**2 * np.eye(COUNT), EXACT, np.ones(COUNT))
    for name in ("distortion", "excess", "freedom"):
        assert getattr(correlated, name) == pytest.approx(getattr(found, name))


def filtered(rng, *, M, true, factors, noise):
    """Return what a linear filter shows that measures each of its landmarks once, from a pose that it knows.

    Args:
        M: The covariance of the map's errors that it is told, per axis in m², (n, n).
        true: The true covariance in units of M.
        factors: The variance with which each landmark enters, in units of the map's, (n,).
        noise: The variances of the detections in m², (n,).
    """
    n = len(M)
    places = rng.uniform(-30.0, 30.0, (n, 2))
    S = np.sqrt(np.outer(factors, factors)) * M
    K = S @ np.linalg.inv(S + np.diag(noise))
    errors = np.sqrt(true) * np.linalg.cholesky(M) @ rng.normal(size=(n, 2))
    corrections = K @ (errors + np.sqrt(noise)[:, None] * rng.normal(size=(n, 2)))
    P = np.kron((np.eye(n) - K) @ S, np.eye(2))
    return shown_errors(places, corrections, M, P, factors)


@pytest.mark.parametrize("is_correlated", [False, True])
@pytest.mark.parametrize("true", [0.5, 1.0, 11.0])
def test_scatter_is_right_in_the_mean_although_too_sure_a_map_holds_its_landmarks(true, is_correlated):
    """Half of the landmarks enter as told, half with four times that; detections are worse than the map says to be."""
    rng = np.random.default_rng(1)
    factors, noise = np.repeat([1.0, 4.0], 10), np.linspace(0.5, 6.0, 20) * 0.03**2
    M = 0.03**2 * (0.5 * np.exp(-np.abs(np.subtract.outer(range(20), range(20)))) + 0.5 * np.eye(20))
    M = M if is_correlated else np.diag(np.diagonal(M))
    drawn = [filtered(rng, M=M, true=true, factors=factors, noise=noise) for _ in range(400)]
    excess, freedom = (np.array([getattr(one, name) for one in drawn]) for name in ("excess", "freedom"))
    assert 3.0 < freedom.mean() < 34.0
    # The mean of excess / freedom within four of its standard errors.
    assert abs(excess.mean() / freedom.mean() - true) < 4.0 * excess.std() / freedom.mean() / np.sqrt(len(drawn))


def test_what_has_left_the_state_counts_as_much_as_six_landmarks():
    assert scatter(ShownErrors()) == 1.0
    assert scatter(ShownErrors(excess=110.0, freedom=10.0)) == pytest.approx((12.0 + 110.0) / 22.0)
    assert scatter(ShownErrors(), before=5.0) == 5.0
    assert scatter(ShownErrors(excess=10.0, freedom=10.0), before=5.0) == pytest.approx((60.0 + 10.0) / 22.0)
    assert scatter(ShownErrors(excess=-50.0, freedom=10.0)) == 1.0
