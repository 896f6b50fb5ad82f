"""Distances of innovations, by their covariances."""

import numpy as np
import pytest

from vtbdrake.components.estimation import squared_distances


@pytest.mark.one_python
@pytest.mark.parametrize("shape", [(), (4,), (2, 4)])
@pytest.mark.parametrize("n", [1, 2, 3])
def test_squared_distances_are_those_of_whitened_innovations(n: int, shape: tuple[int, ...]) -> None:
    rng = np.random.default_rng(n)
    nu, roots = rng.normal(size=(*shape, n)), rng.normal(size=(*shape, n, n))
    S = roots @ np.swapaxes(roots, -1, -2) + np.eye(n)
    expected = [
        (np.linalg.solve(np.linalg.cholesky(S[i]), nu[i]) ** 2).sum() for i in np.ndindex(*shape)
    ]  # |L^-1 nu|^2 with S = L L'
    assert squared_distances(nu, S).shape == shape
    assert squared_distances(nu, S).ravel() == pytest.approx(expected)
