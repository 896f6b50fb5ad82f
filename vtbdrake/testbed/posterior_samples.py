"""Samples of the numbers of a scenario that were calibrated together."""

from __future__ import annotations

import numpy as np

from vtbdrake.common.arrays import Array
from vtbdrake.testbed.inertia import INERTIA_SIZE, physical_numbers
from vtbdrake.testbed.pedigree import Posterior
from vtbdrake.testbed.scenario_identity import ScenarioError

# The largest number of draws for one sample: one outside the ranges is drawn again.
_DRAWS = 1000
# The number of seeds that are drawn from.
_SEEDS = 2**31


def samples(posterior: Posterior, count: int, *, seed: int, disturbances: bool) -> list[dict[str, float]]:
    """Return samples, address -> value; see `Scenario.samples`.

    Args:
        posterior: The joint distribution of the numbers.
        count: Number of samples.
        seed: Determines the samples; the first ones of a larger number are the same.
        disturbances: Whether each sample has the random torques of the recordings, with a seed.

    Raises:
        ScenarioError: The posterior is empty, or its ranges hold next to nothing of it.
    """
    mean = np.array(posterior.mean)
    if not mean.size:
        raise ScenarioError("nothing was calibrated, so that there is nothing to draw: see vtbdrake.calibration")
    values, axes = np.linalg.eigh(np.array(posterior.covariance).reshape(mean.size, mean.size))
    root = axes * np.sqrt(np.maximum(values, 0.0))
    generator = np.random.default_rng(seed)
    numbers = [_physical(posterior, _drawn(posterior, mean, root, generator)) for _ in range(count)]
    if not (disturbances and posterior.disturbances):
        return numbers
    seeds = [float(np.random.default_rng([seed, k]).integers(_SEEDS)) for k in range(count)]
    return [each | posterior.disturbances | {posterior.seed: s} for each, s in zip(numbers, seeds, strict=True)]


def _drawn(posterior: Posterior, mean: Array, root: Array, generator: np.random.Generator) -> Array:
    size = len(posterior.addresses)
    for _ in range(_DRAWS):
        z: Array = mean + root @ generator.standard_normal(mean.size)
        if (z[:size] >= posterior.lower).all() and (z[:size] <= posterior.upper).all():
            return z
    raise ScenarioError(
        f"of {_DRAWS} samples none lies within the ranges of {', '.join(posterior.addresses)}: they exclude what was "
        "estimated"
    )


def _physical(posterior: Posterior, z: Array) -> dict[str, float]:
    size = len(posterior.addresses)
    sample = dict(zip(posterior.addresses, z[:size].tolist(), strict=True))
    for k, body in enumerate(posterior.inertias):
        first = size + INERTIA_SIZE * k
        sample |= physical_numbers(body, z[first : first + INERTIA_SIZE])
    return sample
