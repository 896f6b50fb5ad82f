"""The uncertainty of a calibration: the covariance of the numbers that were fitted."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from vtbdrake.common.arrays import Array

if TYPE_CHECKING:
    from vtbdrake.calibration.filtering import Innovations, Noise
    from vtbdrake.calibration.fisher import Information
    from vtbdrake.calibration.joint_model import JointModel

_BLOCK = 0.2  # s, block length of the sandwich estimator


def sandwich_covariance(innovations: Innovations, used: NDArray[np.bool], period: float, info: Information) -> Array:
    """Return the covariance of the scaled parameters, from scores of blocks that are long against correlations.

    Args:
        innovations: The whitened innovations, and their slopes.
        used: The segments that count.
        period: The time between two steps in s.
        info: What the segments tell about the parameters.
    """
    scores = block_scores(innovations.slopes[:, used], innovations.white[:, used], period) * info.scales
    inverse = info.covariance
    sandwich = inverse @ (scores.T @ scores) @ inverse
    # Never less than what the noise alone leaves: few blocks make a sandwich too small now and then.
    larger = np.sqrt(np.maximum(np.diag(inverse) / np.maximum(np.diag(sandwich), 1e-300), 1.0))
    return np.asarray(sandwich * np.outer(larger, larger))


def block_scores(slopes: Array, white: Array, period: float) -> Array:
    """Return the gradients of half the sum of squares in blocks that are long against correlations, (blocks, nz).

    Args:
        slopes: Derivatives of the whitened innovations, (N, W, nq, nz).
        white: The whitened innovations, (N, W, nq).
        period: The time between two steps in s.
    """
    length, steps = max(round(_BLOCK / period), 10), len(white)
    spans = [slice(k, k + length) for k in range(0, steps - length + 1, length)]
    scores = [np.einsum("twij,twi->wj", slopes[span], white[span]) for span in spans]
    return np.concatenate(scores)


def torque_disturbances(model: JointModel, noise: Noise) -> dict[str, float]:
    """Return the torque disturbances of a calibration as numbers of its `JointDrives`, by address.

    Joints without a drive take none, and a testbed without `JointDrives` has none at all.

    Args:
        model: The model that was fitted.
        noise: The noise that explains its innovations.
    """
    if not model.drives:
        return {}
    deviations = {
        f"{model.drives}.disturbance[{actuator}]": float(noise.torque[joint])
        for joint, actuator in enumerate(model.actuator_of)
        if actuator >= 0
    }
    return deviations | {f"{model.drives}.disturbance_time": noise.correlation_time}
