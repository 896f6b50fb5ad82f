"""Shadows of the sun, by shadow mapping: points that are hidden from a camera at the sun are in shadow.

VTK's own shadows are wrong: a surface that faces the sun becomes black where another one lies behind it, also the back
of the same box, unless the scene is many times deeper than the bodies in it. The shadows of this module are right.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import ClippingRange, DepthRange, DepthRenderCamera, QueryObject, RenderCameraCore
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.sensors import CameraInfo

if TYPE_CHECKING:
    from collections.abc import Sequence

# Pixels per side of the sun's depth image.
_SIZE = 512
# How far the sun's camera is away, in radii of what it looks at: its rays diverge by 1/100 (as those of the sun).
_FAR = 100.0
# A point in shadow is farther from the sun than what the sun sees by at least so many of the image's pixels.
_BIAS = 0.75


def sunlit(
    query: QueryObject, *, renderer: str, points_W: NDArray[np.float64], direction: Sequence[float], reach: float
) -> NDArray[np.float64]:
    """Return the share of the sun that each point sees, between 0 and 1, shape (n,).

    The sun's depth image (Williams, "Casting curved shadows on curved surfaces", 1978) is as large as the points need,
    and interpolated between its pixels, so that a plane shades itself nowhere. The edge of a shadow is right to about
    a pixel of it, the 512th part of the extent of the points across the light.

    Args:
        query: The scene.
        renderer: The renderer of the scene to use for the depth image.
        points_W: Points on the surfaces of the scene in metres, shape (n, 3).
        direction: Direction in which the light travels, in W, of any length.
        reach: How far away a body may be that throws a shadow, in metres.
    """
    if not len(points_W):
        return np.zeros(0)
    # The sun's camera S looks along the light.
    R_WS = RotationMatrix.MakeFromOneVector(np.asarray(direction, dtype=float), 2)
    p_S = R_WS.matrix().T @ points_W.T
    low, high = p_S.min(axis=1), p_S.max(axis=1)
    center, radius = (low + high) / 2.0, max(float((high - low).max()) / 2.0, 1e-3)
    distance = max(_FAR * radius, reach)
    focal = 0.49 * _SIZE * (distance - radius) / radius
    core = RenderCameraCore(
        renderer,
        CameraInfo(_SIZE, _SIZE, focal, focal, _SIZE / 2.0, _SIZE / 2.0),
        ClippingRange(0.01 * distance, distance + 2.0 * radius),
        RigidTransform(),
    )
    camera = DepthRenderCamera(core, DepthRange(0.01 * distance, distance + 2.0 * radius))
    X_WS = RigidTransform(R_WS, R_WS @ (center - [0.0, 0.0, distance]))
    nearest = query.RenderDepthImage(camera, query.inspector().world_frame_id(), X_WS).data[..., 0]
    nearest = np.where(np.isinf(nearest), distance + 10.0 * radius, nearest)
    x, y, z = p_S - (center - [0.0, 0.0, distance])[:, np.newaxis]
    seen = _interpolated(nearest, _SIZE / 2.0 + focal * x / z - 0.5, _SIZE / 2.0 + focal * y / z - 0.5)
    pixel = 2.0 * radius / _SIZE
    # Over one more pixel, light becomes shadow.
    return np.clip(1.0 + _BIAS - (z - seen) / pixel, 0.0, 1.0)


def _interpolated(image: NDArray[np.float64], u: NDArray[np.float64], v: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return bilinear interpolations of ``image`` at columns ``u`` and rows ``v``, counted from pixel centres."""
    column, row = u.astype(int), v.astype(int)
    a, b = u - column, v - row
    above = (1.0 - a) * image[row, column] + a * image[row, column + 1]
    below = (1.0 - a) * image[row + 1, column] + a * image[row + 1, column + 1]
    return (1.0 - b) * above + b * below
