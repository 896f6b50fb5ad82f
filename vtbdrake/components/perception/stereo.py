"""Distances from a pair of images, by the shift of each point between them.

The images come from two equal cameras with the same orientation, the right one beside the left one: a rectified
pair. A point at the depth z is shifted by the disparity d = f b / z pixels (focal length f, baseline b). So an error of
the disparity with the deviation sigma_d is one of the depth with sigma_z = z² sigma_d / (f b). OpenCV's semi-global
matching (Hirschmüller, "Stereo Processing by Semiglobal Matching and Mutual Information", PAMI 30, 2008) compares the
images. Its checks leave out most of what has no match, not all: some disparities are wrong by many pixels, so whatever
uses them must bear outliers.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import atan
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vtbdrake.common.arrays import Array
from vtbdrake.common.settings import check_settings, setting
from vtbdrake.components.perception.opencv import grey_image, opencv

if TYPE_CHECKING:
    from pydrake.systems.sensors import CameraInfo, ImageRgba8U


@dataclass(frozen=True)
class StereoCamera:
    """The geometry of a rectified pair of cameras.

    The frame C is the left camera's: x to the right, y down, z forward; the right one stands at [baseline, 0, 0]
    in C. Pixels count as in Drake's `CameraInfo`: the centre of the first one is at (0.5, 0.5).
    """

    width: int = setting(doc="Width of the images.", unit="pixels", ge=1)
    height: int = setting(doc="Height of the images.", unit="pixels", ge=1)
    focal_length: float = setting(doc="Focal length; pixels are square.", unit="pixels", gt=0.0)
    center_x: float = setting(doc="Position of the optical axis in the images, from their left edge.", unit="pixels")
    center_y: float = setting(doc="The same, from their upper edge.", unit="pixels")
    baseline: float = setting(doc="The distance of the cameras.", unit="m", gt=0.0)

    def __post_init__(self) -> None:
        check_settings(self)

    @classmethod
    def of(cls, info: CameraInfo, *, baseline: float) -> StereoCamera:
        """Return the pair of two cameras with these intrinsics, ``baseline`` (m) apart.

        Args:
            info: The intrinsics of either camera, in pixels.
            baseline: The distance of the cameras, in m.

        Raises:
            ValueError: The pixels are not square.
        """
        if abs(info.focal_x() - info.focal_y()) > 1e-6 * info.focal_x():
            raise ValueError(
                f"the pixels of a rectified pair are square: give both focal lengths alike, not {info.focal_x():g} and "
                f"{info.focal_y():g} pixels"
            )
        return cls(info.width(), info.height(), info.focal_x(), info.center_x(), info.center_y(), baseline)

    @property
    def fov_x(self) -> float:
        """The angle from the left edge of the images to the right one, in rad."""
        return atan(self.center_x / self.focal_length) + atan((self.width - self.center_x) / self.focal_length)

    def depth(self, disparity: ArrayLike) -> Array:
        """Return z_C (m) of disparities (pixels): infinite for 0, NaN for NaN."""
        with np.errstate(divide="ignore"):
            depth: Array = self.focal_length * self.baseline / np.asarray(disparity, dtype=float)
        return depth

    def depth_deviation(self, depth: ArrayLike, *, disparity_deviation: float) -> Array:
        """Return the standard deviation (m) of a depth (m) that is measured with a deviation in pixels.

        Args:
            depth: The depth z_C in m, any shape.
            disparity_deviation: The standard deviation of a measured disparity, in pixels.
        """
        deviation: Array = np.square(depth) * disparity_deviation / (self.focal_length * self.baseline)
        return deviation

    def points(self, disparity: NDArray[np.floating]) -> Array:
        """Return the points in C (m) that the pixels of the left image show, shape (h, w, 3).

        Args:
            disparity: The disparity of each pixel, (h, w); NaN where it is unknown. There, and where it is 0, the point
                is NaN.
        """
        if disparity.shape != (self.height, self.width):
            raise ValueError(f"disparities have the shape {(self.height, self.width)}, not {disparity.shape}")
        depth = self.depth(np.where(disparity > 0.0, disparity, np.nan))
        x = (np.arange(self.width) + 0.5 - self.center_x) / self.focal_length
        y = (np.arange(self.height) + 0.5 - self.center_y) / self.focal_length
        return np.stack([depth * x, depth * y[:, np.newaxis], depth], axis=-1)


# Directions from which semi-global matching collects costs, and OpenCV's name of the mode.
_MODES = {3: "STEREO_SGBM_MODE_SGBM_3WAY", 5: "STEREO_SGBM_MODE_SGBM", 8: "STEREO_SGBM_MODE_HH"}


@dataclass(frozen=True)
class StereoMatcher:
    """Semi-global matching of the images of a rectified stereo camera."""

    largest_disparity: int = setting(
        64, "Largest disparity, a multiple of 16; nearer surfaces get none, or a wrong one.", unit="pixels", ge=16
    )
    block: int = setting(5, "The edge of the blocks that are compared, odd.", unit="pixels", ge=1)
    directions: int = setting(
        3,
        "From how many directions semi-global matching collects costs: 3, 5 or 8. Only with 8 are the "
        "disparities of slopes not biased (with 5 by more than 0.1 pixels); it takes twice the time or more. "
        "On upright surfaces all are alike.",
        choices=tuple(_MODES),
    )
    uniqueness: int = setting(10, "By how many per cent the best cost is better than any other disparity's.", ge=0)
    symmetry: int = setting(
        1, "How far the disparities from left to right and from right to left may differ.", unit="pixels", ge=0
    )
    texture: float = setting(
        2.0,
        "The least contrast around a pixel: the mean absolute difference of pixels side by side in counts. "
        "Parts with less (sky, deep shade) get no disparity.",
        ge=0.0,
        finite=False,
    )
    speckle: int = setting(50, "The least number of connected pixels with similar disparities.", ge=0)

    def __post_init__(self) -> None:
        check_settings(self)
        if self.largest_disparity % 16:
            raise ValueError(
                f"StereoMatcher.largest_disparity must be a multiple of 16 pixels, not {self.largest_disparity!r}"
            )
        if self.block % 2 == 0:
            raise ValueError(f"StereoMatcher.block must be an odd number of pixels, not {self.block!r}")

    def disparity(
        self, left: ImageRgba8U | NDArray[np.uint8], right: ImageRgba8U | NDArray[np.uint8]
    ) -> NDArray[np.float32]:
        """Return the disparity (pixels) of each pixel of the left image, (h, w), in steps of 1/16; NaN where unknown.

        Unknown are most pixels that the right camera does not see, pixels without texture, and ambiguous ones. Not all
        wrong matches are found: beside the edges of near bodies three quarters are, and fewer where patterns repeat, in
        mirrors and in glass. In rendered images of textured walls less than 3 % of the disparities are off by more than
        a pixel; expect more in images of real cameras.

        Args:
            left: The image of the left camera: in colours, or an array (h, w) of greys.
            right: The image of the right camera.

        Raises:
            ModuleNotFoundError: OpenCV is missing.
            ValueError: The images differ in size.
        """
        cv2 = opencv()
        greys = [grey_image(image) for image in (left, right)]
        if greys[0].shape != greys[1].shape:
            sizes = " and ".join(f"{grey.shape[1]} x {grey.shape[0]}" for grey in greys)
            raise ValueError(f"left and right image of a rectified pair have the same size, not {sizes} pixels")
        matcher = cv2.StereoSGBM_create(
            minDisparity=0,
            numDisparities=self.largest_disparity,
            blockSize=self.block,
            # As OpenCV's manual proposes for grey images.
            P1=8 * self.block**2,
            P2=32 * self.block**2,
            disp12MaxDiff=self.symmetry,
            preFilterCap=31,
            uniquenessRatio=self.uniqueness,
            speckleWindowSize=self.speckle,
            speckleRange=1,
            mode=getattr(cv2, _MODES[self.directions]),
        )
        # OpenCV leaves out a margin, in which the largest disparities would lead out of the right image.
        margin = (0, 0, self.largest_disparity, 0, cv2.BORDER_REPLICATE)
        sixteenths = matcher.compute(*(cv2.copyMakeBorder(grey, *margin) for grey in greys))[
            :, self.largest_disparity :
        ]
        columns = np.arange(sixteenths.shape[1], dtype=np.float32)
        disparity = sixteenths.astype(np.float32) / 16.0
        # Semi-global matching spreads what is near over what has no texture beside it: a narrow window undoes this.
        change = cv2.absdiff(greys[0][:, 1:], greys[0][:, :-1]).astype(np.float32)
        contrast = cv2.blur(
            cv2.copyMakeBorder(change, 0, 0, 1, 0, cv2.BORDER_REPLICATE),
            (2, 4 * self.block + 1),
            anchor=(0, 2 * self.block),
        )
        unknown = (sixteenths < 0) | (contrast < self.texture) | (disparity > columns)
        disparity[unknown] = np.nan
        return disparity
