"""OpenCV, and images as it takes them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vtbdrake.common.extras import extra_module

if TYPE_CHECKING:
    from pydrake.systems.sensors import ImageRgba8U


def opencv() -> Any:
    """Return OpenCV's module.

    Raises:
        ModuleNotFoundError: It is not installed.
    """
    return extra_module("cv2", purpose="markers and stereo vision", extra="perception")


def grey_image(image: ImageRgba8U | NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return a colour image, or an array (h, w) of greys, as contiguous greys, (h, w)."""
    data = image if isinstance(image, np.ndarray) else image.data
    if data.ndim == 2:
        return np.ascontiguousarray(data)
    cv2 = opencv()
    return np.asarray(cv2.cvtColor(np.ascontiguousarray(data[:, :, :3]), cv2.COLOR_RGB2GRAY), dtype=np.uint8)
