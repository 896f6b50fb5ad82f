"""Trunks of trees from the disparities of a pair of cameras: the positions of their axes, and their diameters.

All pixels of a trunk have about the same disparity, and lie above each other. So pixels are counted by column and
disparity, as a level camera at the same place would see them: a cell with enough of them, one above the other, belongs
to an upright object. Neighbouring cells are one trunk, whose columns give its direction and its width, and whose mean
disparity gives its distance. In columns and disparities the errors are the same near and far, unlike the errors of
points.
Ground, which is spread over many disparities, and twigs need no model: their cells have too few pixels.

The errors of the disparities of one trunk are correlated: the error of its distance does not vanish with the number of
pixels. The standard deviations in `StereoTrunkDetectorConfig` are calibrated.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf, pi

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform
from scipy.ndimage import convolve1d, find_objects, label

from vtbdrake.common.arrays import Array
from vtbdrake.common.settings import check_settings, setting
from vtbdrake.components.localization.landmarks import Landmarks
from vtbdrake.components.perception.stereo import StereoCamera

# Cells per pixel of disparity. A trunk of one disparity is spread over three: a cell, and one on either side.
_CELLS = 2
# Empty cells on either side of all disparities.
_MARGIN = 2
# The number of columns on either side of a trunk that belong to its profile.
_BESIDE = 2
# The face of a cylinder lies before its axis by pi / 4 of its radius, as a mean over the columns that show it.
_FACE = pi / 4.0


@dataclass(frozen=True)
class StereoTrunkDetectorConfig:
    """Settings of the detector of trunks in disparities.

    Raises:
        ValueError: A setting is outside of its range.
    """

    heights: tuple[float, float] = setting(
        (-1.3, 1.5),
        "The lower and the upper end of the slice that is searched, above the camera.",
        unit="m",
        ascending=True,
    )
    extent: float = setting(
        1.8, "The least height of the part of an object that is seen within the slice.", unit="m", gt=0.0
    )
    reach: float = setting(16.0, "The largest distance at which trunks are searched for.", unit="m", gt=0.0)
    least_diameter: float = setting(0.04, "The least diameter of a trunk.", unit="m", ge=0.0, below="largest_diameter")
    largest_diameter: float = setting(0.7, "The largest diameter of a trunk.", unit="m", gt=0.0)
    disparity_deviation: float = setting(
        0.2, "Standard deviation of the mean disparity of a trunk.", unit="pixels", gt=0.0
    )
    disparity_bias: float = setting(
        0.05,
        "Standard deviation of the common error of all disparities: cameras are misaligned.",
        unit="pixels",
        ge=0.0,
    )
    middle_deviation: float = setting(
        1.2, "Standard deviation of the column of the middle of a trunk.", unit="pixels", gt=0.0
    )
    width_deviation: float = setting(3.0, "Standard deviation of the width of a trunk.", unit="pixels", gt=0.0)
    fattening: float = setting(
        1.0, "Number of pixels by which trunks appear too wide, as matching widens near objects.", unit="pixels", ge=0.0
    )
    least_deviation: float = setting(
        0.02,
        "Standard deviation that is added to positions, per axis, and diameters: trunks are not round, nor upright.",
        unit="m",
        ge=0.0,
    )

    def __post_init__(self) -> None:
        check_settings(self)
        low, high = self.heights
        if not self.extent < high - low:
            most = f"below the height of the slice, {high - low:g} m"
            raise ValueError(f"StereoTrunkDetectorConfig.extent must be {most}, not {self.extent!r}")


def detect_stereo_trunks(
    disparity: NDArray[np.floating], camera: StereoCamera, detector: StereoTrunkDetectorConfig, *, X_HC: RigidTransform
) -> Landmarks:
    """Find the trunks in the disparities of an image.

    Args:
        disparity: The disparity of each pixel of the left image, (h, w), NaN where it is unknown.
        camera: The pair of cameras.
        detector: The settings.
        X_HC: The pose of the left camera in the level frame H of the carrier. Its optical axis is about horizontal.

    Returns:
        The trunks in H, with the deviations of the settings. The diameter of a partly hidden trunk is unknown.
    """
    ahead, right, heading = _level(disparity, camera, detector, X_HC)
    if not len(ahead):
        return Landmarks.empty()
    grid = _Grid(camera, ahead, right)
    rows = [row for trunk in grid.trunks(detector.extent) if (row := _measured(trunk, camera, detector)) is not None]
    if not rows:
        return Landmarks.empty()
    distance, bearing, diameter, is_whole = np.array(rows).T
    return _landmarks(distance, heading - bearing, diameter, is_whole > 0.0, camera, detector, X_HC)


def _level(
    disparity: NDArray[np.floating], camera: StereoCamera, detector: StereoTrunkDetectorConfig, X_HC: RigidTransform
) -> tuple[Array, Array, float]:
    """Return the points of the slice as a level camera sees them: ahead and to its right (m), and its heading in H."""
    axis_H = X_HC.rotation().matrix()[:, 2]
    heading = float(np.arctan2(axis_H[1], axis_H[0]))
    c, s = np.cos(heading), np.sin(heading)
    R_LC = np.array([[c, s, 0.0], [s, -c, 0.0], [0.0, 0.0, 1.0]]) @ X_HC.rotation().matrix()
    near = disparity > camera.focal_length * camera.baseline / detector.reach
    ahead, right, above = R_LC @ camera.points(disparity)[near].T
    low, high = detector.heights
    in_slice = (above > low) & (above < high) & (ahead > 2.0 * camera.baseline)
    return ahead[in_slice], right[in_slice], heading


@dataclass(frozen=True, eq=False)
class _Trunk:
    """An upright object: its width and the column of its middle from the optical axis (pixels), and its disparity."""

    middle: float
    width: float
    disparity: float
    is_hidden: bool


class _Grid:
    """The height (m) of what is seen in each column (pixels from the optical axis) at each disparity."""

    def __init__(self, camera: StereoCamera, ahead: Array, right: Array) -> None:
        f = camera.focal_length
        disparity = f * camera.baseline / ahead
        # Columns beyond the image, because it is rolled and pitched.
        self._first = -int(1.2 * camera.center_x)
        columns = np.floor(f * right / ahead).astype(int) - self._first
        self._shape = (int(1.2 * camera.width) + 1, int(disparity.max() * _CELLS) + 1 + 2 * _MARGIN)
        inside = (columns >= 0) & (columns < self._shape[0])
        cells = columns[inside] * self._shape[1] + (disparity[inside] * _CELLS).astype(int) + _MARGIN
        height = ahead[inside] / f
        self._height = self._sum(cells, height)
        self._moment = self._sum(cells, height * disparity[inside])

    def _sum(self, cells: NDArray[np.int64], values: Array) -> Array:
        total = np.bincount(cells, values, minlength=self._shape[0] * self._shape[1])
        return np.asarray(total, dtype=float).reshape(self._shape)

    def trunks(self, extent: float) -> list[_Trunk]:
        """Return the upright objects that are at least ``extent`` (m) high."""
        upright = convolve1d(self._height, np.ones(3), axis=1, mode="constant") > extent
        labels, _ = label(upright, np.ones((3, 3)))
        return [
            self._trunk(labels[part] == number, part, upright) for number, part in enumerate(find_objects(labels), 1)
        ]

    def _trunk(self, mask: NDArray[np.bool_], part: tuple[slice, slice], upright: NDArray[np.bool_]) -> _Trunk:
        columns, cells = part[0], slice(part[1].start - 1, part[1].stop + 1)
        first, last = max(columns.start - _BESIDE, 0), columns.stop + _BESIDE
        profile = self._height[first:last, cells].sum(axis=1)
        share = np.minimum(profile / np.median(profile[columns.start - first : columns.stop - first]), 1.0)
        width = float(share.sum())
        middle = float(share @ np.arange(first, first + len(share))) / width + 0.5 + self._first
        spread = convolve1d(np.pad(mask, ((0, 0), (1, 1))).astype(int), np.ones(3, int), axis=1, mode="constant") > 0
        disparity = float(self._moment[columns, cells][spread].sum() / self._height[columns, cells][spread].sum())
        beside = np.r_[first : columns.start, columns.stop : min(last, self._shape[0])]
        return _Trunk(middle, width, disparity, bool(upright[beside, cells.stop :].any()))


def _measured(
    trunk: _Trunk, camera: StereoCamera, detector: StereoTrunkDetectorConfig
) -> tuple[float, float, float, float] | None:
    """Return distance (m) and bearing to the right (rad) of an axis, its diameter (m), and 1 if all of it is seen."""
    f, width = camera.focal_length, max(trunk.width - detector.fattening, 0.5)
    slant = np.hypot(1.0, trunk.middle / f)
    sine = np.sin(0.5 * width / f / slant**2)
    distance = slant * float(camera.depth(trunk.disparity)) / (1.0 - _FACE * sine)
    diameter = 2.0 * distance * sine
    tolerance = 2.0 * detector.width_deviation * distance / f
    if not detector.least_diameter - tolerance < diameter < detector.largest_diameter + tolerance:
        return None
    # The right camera does not see what is at the left edge of the left image.
    left, right = trunk.disparity - camera.center_x + _BESIDE, camera.width - camera.center_x - _BESIDE
    is_cut = trunk.middle - 0.5 * trunk.width < left or trunk.middle + 0.5 * trunk.width > right
    return distance, float(np.arctan(trunk.middle / f)), diameter, float(not (is_cut or trunk.is_hidden))


def _landmarks(
    distance: Array,
    direction: Array,
    diameter: Array,
    is_whole: NDArray[np.bool_],
    camera: StereoCamera,
    detector: StereoTrunkDetectorConfig,
    X_HC: RigidTransform,
) -> Landmarks:
    """Return landmarks in H at distances (m) in directions (rad) from the camera."""
    along = np.column_stack([np.cos(direction), np.sin(direction)])
    across = np.column_stack([-along[:, 1], along[:, 0]])
    disparity_deviation = np.hypot(detector.disparity_deviation, detector.disparity_bias)
    range_variance = camera.depth_deviation(distance, disparity_deviation=disparity_deviation) ** 2
    pixel = distance / camera.focal_length
    # A hidden part displaces the middle by up to half of the diameter.
    cross_variance = (detector.middle_deviation * pixel) ** 2 + np.where(is_whole, 0.0, (0.5 * diameter) ** 2)
    covariances = sum(
        variance[:, None, None] * axis[:, :, None] * axis[:, None, :]
        for variance, axis in ((range_variance, along), (cross_variance, across))
    )
    landmarks = Landmarks(
        X_HC.translation()[:2] + distance[:, None] * along,
        covariances,
        diameter,
        np.where(is_whole, detector.width_deviation * pixel, inf),
    )
    return landmarks.widened(detector.least_deviation)
