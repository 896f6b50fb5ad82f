"""Shadows of the sun, by shadow mapping: points that are hidden from a camera at the sun are in shadow.

VTK's own shadows are wrong: a surface that faces the sun becomes black where another one lies behind it, also the back
of the same box, unless the scene is many times deeper than the bodies in it. The shadows of this module are right.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import ClippingRange, DepthRange, DepthRenderCamera, QueryObject, RenderCameraCore
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.sensors import CameraInfo

from vtbdrake.common.arrays import Array

if TYPE_CHECKING:
    from collections.abc import Sequence


# Least number of pixels per side of the sun's depth images.
_SMALLEST = 64
# Largest number of them.
_LARGEST = 1024
# The largest size of their pixels, in distances between neighbouring points.
_PIXEL = 2.0
# How often points of different spacings are parted into two halves.
_PARTINGS = 5
# How far the sun's camera is away, in radii of what it looks at: its rays diverge by 1/100 (as the sun's).
_FAR = 100.0
# A point in shadow is farther from the sun than what the sun sees by at least this number of the image's pixels.
_BIAS = 0.75


def sunlit(
    query: QueryObject, *, renderer: str, points_W: Array, spacing: Array, direction: Sequence[float], reach: float
) -> Array:
    """Return the share of the sun that each point sees, between 0 and 1, shape (n,).

    The sun's depth image (Williams, "Casting curved shadows on curved surfaces", 1978) is as large as the points need,
    and interpolated between its pixels, so that a plane shades itself nowhere. Where points lie densely, as those near
    a camera, they have an image of their own ("cascaded shadow maps": Engel, ShaderX5, 2006). So, measured across the
    light, the edge of a shadow is right to about the distance of neighbouring points.

    Args:
        query: The scene.
        renderer: The renderer of the scene to use for the depth image.
        points_W: Points on the surfaces of the scene in metres, shape (3, n).
        spacing: Distance of each point from its neighbours across the line of sight, in metres, shape (n,).
        direction: Direction in which the light travels, in W, of any length.
        reach: How far away a body may be that throws a shadow, in metres.
    """
    # The sun's camera S looks along the light.
    R_WS = RotationMatrix.MakeFromOneVector(np.asarray(direction, dtype=float), 2)
    p_S = R_WS.matrix().T @ points_W
    share = np.ones(points_W.shape[1])
    for part in _parts(p_S, spacing, _PARTINGS):
        share[part] = _share(query, renderer, p_S[:, part], float(spacing[part].min()), R_WS, reach)
    return share


def _parts(p_S: Array, spacing: Array, partings: int) -> Iterator[NDArray[np.intp]]:
    """Yield the indices of the points that share a depth image."""
    waiting = [(np.arange(len(spacing)), partings)] if len(spacing) else []
    while waiting:
        part, left = waiting.pop()
        finest, coarsest = float(spacing[part].min()), float(spacing[part].max())
        if not left or np.ptp(p_S[:2, part], axis=1).max() <= _LARGEST * _PIXEL * finest or coarsest < 1.1 * finest:
            yield part
            continue
        near = spacing[part] < np.sqrt(finest * coarsest)
        waiting += [(part[near], left - 1), (part[~near], left - 1)]


def _share(query: QueryObject, renderer: str, p_S: Array, spacing: float, R_WS: RotationMatrix, reach: float) -> Array:
    """Return the share of the sun that points see, from one depth image with pixels of about twice their spacing."""
    low, high = p_S.min(axis=1), p_S.max(axis=1)
    center, radii = (low + high) / 2.0, np.maximum((high - low) / 2.0, 1e-3)
    size = int(np.clip(2.0 * radii[:2].max() / spacing, _SMALLEST, _LARGEST))
    distance = max(_FAR * radii.max(), reach)
    focal = 0.49 * size * (distance - radii[2]) / radii[:2]
    clip = 0.01 * distance, distance + 2.0 * radii[2]
    info = CameraInfo(size, size, *focal, size / 2.0, size / 2.0)
    core = RenderCameraCore(renderer, info, ClippingRange(*clip), RigidTransform())
    X_WS = RigidTransform(R_WS, R_WS @ (center - [0.0, 0.0, distance]))
    camera = DepthRenderCamera(core, DepthRange(*clip))
    image = query.RenderDepthImage(camera, query.inspector().world_frame_id(), X_WS).data[..., 0]
    x, y, z = p_S - (center - [0.0, 0.0, distance])[:, np.newaxis]
    u, v = (size / 2.0 + f * a / z - 0.5 for f, a in zip(focal, (x, y), strict=True))
    column, row = u.astype(int), v.astype(int)
    a, b = u - column, v - row
    first = row * size + column
    # Where nothing is, it is far behind all points.
    nothing = np.float32(distance + 10.0 * radii.max())
    corners = [np.minimum(image.ravel()[first + k], nothing) for k in (0, 1, size, size + 1)]
    above = (1.0 - a) * corners[0] + a * corners[1]
    below = (1.0 - a) * corners[2] + a * corners[3]
    visible_depth = (1.0 - b) * above + b * below
    pixel = 2.0 * float(radii[:2].max()) / (0.98 * size)
    hidden = z - _BIAS * pixel
    # If pixels are partly in front of the point, the share follows from how far the interpolation lies between
    # them and the point. If all of them are in front of it, the point is in shadow.
    nearest, farthest = (f(f(*corners[:2]), f(*corners[2:])) for f in (np.minimum, np.maximum))
    dark = np.clip((hidden - visible_depth) / np.maximum(hidden - nearest, pixel), 0.0, 1.0)
    return np.where(farthest < hidden, 0.0, 1.0 - dark)
