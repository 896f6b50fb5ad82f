"""Landmarks from the detections of another detector: range, bearing and diameter."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from vtbdrake.common.settings import check_settings, setting
from vtbdrake.components.localization.landmarks import Landmarks


@dataclass
class RangeBearingConfig:
    """The pose of the sensor in the level frame H, and the accuracy of its detector.

    The standard deviation of a range r is ``hypot(range_noise, range_share r)``, across the ray it is
    ``hypot(range_noise / 2, bearing_noise r)``, and the deviation of a diameter d is ``hypot(diameter_noise,
    diameter_share d)``. The defaults are rounded from the first half of the drive in Victoria Park, see
    `vtbdrake_diagrams.park`.
    """

    x: float = setting(0.0, "Position of the sensor in H, ahead of its origin.", unit="m")
    y: float = setting(0.0, "Position of the sensor in H, to the left.", unit="m")
    heading: float = setting(0.0, "Direction in H of the bearing 0.", unit="rad")
    range_noise: float = setting(0.04, "Standard deviation of short ranges.", unit="m", gt=0)
    range_share: float = setting(0.0035, "Standard deviation over the range, of long ones.", ge=0)
    bearing_noise: float = setting(0.0035, "Standard deviation of bearings.", unit="rad", ge=0)
    diameter_noise: float = setting(0.05, "Standard deviation of small diameters.", unit="m", ge=0, finite=False)
    diameter_share: float = setting(0.2, "Standard deviation over the diameter, of large ones.", ge=0)
    largest_range: float = setting(40.0, "Detections beyond are left out.", unit="m", gt=0, finite=False)

    def __post_init__(self) -> None:
        check_settings(self)


def range_bearing_landmarks(detections: ArrayLike, config: RangeBearingConfig) -> Landmarks:
    """Return detections as landmarks in H.

    Rows with a number that is not finite, or a range that is not positive, hold no detection: a signal of constant size
    is filled up with them.

    Args:
        detections: Rows of [range to the axis (m), bearing (rad, positive to the left), diameter (m)], (n, 3).
        config: Where the sensor is, and how accurate.
    """
    rows = np.asarray(detections, dtype=float).reshape(-1, 3)
    rows = rows[np.isfinite(rows).all(axis=1)]
    r, bearing, diameter = rows[(rows[:, 0] > 0.0) & (rows[:, 0] <= config.largest_range)].T
    direction = bearing + config.heading
    along = np.column_stack([np.cos(direction), np.sin(direction)])
    across = along[:, ::-1] * [-1.0, 1.0]
    deviations = (
        np.hypot(config.range_noise, config.range_share * r),
        np.hypot(0.5 * config.range_noise, config.bearing_noise * r),
    )
    covariances = sum(
        deviation[:, None, None] ** 2 * ray[:, :, None] * ray[:, None, :]
        for deviation, ray in zip(deviations, (along, across), strict=True)
    )
    return Landmarks(
        np.array([config.x, config.y]) + r[:, None] * along,
        np.asarray(covariances).reshape(-1, 2, 2),
        diameter,
        np.hypot(config.diameter_noise, config.diameter_share * diameter),
    )
