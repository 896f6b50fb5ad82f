"""The uncertainty of a calibration: the covariance of the numbers that were fitted, and samples of them."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING

import casadi
import numpy as np
from numpy.typing import NDArray

from vtbdrake.arrays import Array
from vtbdrake.calibration.model import INERTIA_SIZE, inertia_of
from vtbdrake.testbed.pedigree import Posterior
from vtbdrake.testbed.scenario import ScenarioError

if TYPE_CHECKING:
    from vtbdrake.calibration.filtering import Innovations
    from vtbdrake.calibration.fisher import Information

_BLOCK = 0.2  # s, of the sandwich estimator
# A sample outside the ranges is drawn again, so many times at most.
_DRAWS = 1000
PHYSICAL = ("mass", *(f"center_of_mass[{i}]" for i in range(3)), *(f"inertia[{i}]" for i in range(6)))
"""The ten physical numbers of a body, below its address."""


@cache
def body_function() -> casadi.Function:
    """Return the function z (10,) -> `PHYSICAL` (10,), and their Jacobian."""
    symbol = casadi.SX.sym("z", INERTIA_SIZE)
    physical = casadi.vertcat(*inertia_of(symbol))
    return casadi.Function("inertia", [symbol], [physical, casadi.jacobian(physical, symbol)])


def physical_numbers(body: str, z: Array) -> dict[str, float]:
    """Return the `PHYSICAL` numbers of a body by their addresses."""
    numbers = np.asarray(body_function()(z)[0]).ravel()
    return {f"{body}.{part}": float(number) for part, number in zip(PHYSICAL, numbers, strict=True)}


def sandwich_covariance(innovations: Innovations, used: NDArray[np.bool], period: float, info: Information) -> Array:
    """Return the covariance of the scaled parameters, from scores of blocks that are long against correlations.

    Args:
        innovations: The whitened innovations, and their slopes.
        used: The segments that count.
        period: The time between two steps in s.
        info: What the segments tell about the parameters.
    """
    length, steps = max(round(_BLOCK / period), 10), len(innovations.white)
    spans = [slice(k, k + length) for k in range(0, steps - length + 1, length)]
    scores = np.array(
        [
            np.einsum("twij,twi->wj", innovations.slopes[span][:, used], innovations.white[span][:, used])
            for span in spans
        ]
    ).reshape(-1, len(info.names))
    scores = scores * info.scales
    inverse = info.covariance
    sandwich = inverse @ (scores.T @ scores) @ inverse
    # Never less than what the noise alone leaves: few blocks make a sandwich too small now and then.
    larger = np.sqrt(np.maximum(np.diag(inverse) / np.maximum(np.diag(sandwich), 1e-300), 1.0))
    return np.asarray(sandwich * np.outer(larger, larger))


def samples(posterior: Posterior, count: int, *, seed: int) -> list[dict[str, float]]:
    """Return samples, address -> value; see `Scenario.samples`.

    Raises:
        ScenarioError: The posterior is empty, or its ranges hold next to nothing of it.
    """
    mean = np.array(posterior.mean)
    if not mean.size:
        raise ScenarioError("nothing was calibrated, so that there is nothing to draw: see vtbdrake.calibration")
    values, axes = np.linalg.eigh(np.array(posterior.covariance).reshape(mean.size, mean.size))
    root = axes * np.sqrt(np.maximum(values, 0.0))
    generator = np.random.default_rng(seed)
    return [_physical(posterior, _drawn(posterior, mean, root, generator)) for _ in range(count)]


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
