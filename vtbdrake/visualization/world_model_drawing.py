"""A semantic world model in Meshcat: classes by colour, covariances as ellipsoids, identities as labels."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.colors import to_hex, to_rgb
from matplotlib.textpath import TextPath
from numpy.typing import NDArray
from pydrake.geometry import Ellipsoid, Meshcat, Rgba, Sphere
from pydrake.math import RigidTransform, RotationMatrix

from vtbdrake.components.perception.estimate import PoseEstimate
from vtbdrake.components.world_model.geometry import PartsOf
from vtbdrake.components.world_model.objects import RETIRED, TENTATIVE
from vtbdrake.components.world_model.world_model import WorldModel
from vtbdrake.visualization.meshcat import Scene

if TYPE_CHECKING:
    from matplotlib.typing import ColorType

# By class, from the palette of Okabe and Ito for all kinds of colour vision.
_COLORS = {"tree": "#009e73", "rock": "#e69f00", "satellite": "#0072b2", "crater rim": "#cc79a7"}
_OTHERS = "#56b4e9"
_TENTATIVE_OPACITY = 0.35
_ELLIPSOID_OPACITY = 0.3
# The least semi-axis of an ellipsoid in m: what is exact, or unknown, is drawn flat.
_FLAT = 1e-3


def show_world_model(
    meshcat: Meshcat,
    model: WorldModel,
    *,
    prefix: str = "world_model",
    colors: Mapping[str, ColorType] | None = None,
    parts: Mapping[str, PartsOf] | None = None,
    marker: float = 0.15,
    deviations: float = 2.0,
    label_height: float = 0.3,
) -> Scene:
    """Draw the objects of a world model, each under ``<prefix>/<class>/<identity>``, instead of what was drawn there.

    Tentative objects are translucent, retired ones are left out. The ellipsoid around an object holds its position
    within this number of standard deviations; it is flat along what is exactly known or not known at all.

    Args:
        meshcat: The server that shows it.
        model: The objects.
        prefix: The Meshcat path under which it is drawn.
        colors: Class -> any matplotlib colour, beside the default ones.
        parts: Class -> function that returns an object's shapes, such as `geometry.PARTS`; objects of other classes are
            spheres.
        marker: Radius of these spheres in m.
        deviations: Size of the ellipsoids in standard deviations; 0 draws none.
        label_height: Height of the letters of the identities in m; 0 draws none. They are read along the y axis.

    Returns:
        The scene, whose legend names the classes; it shows itself in a notebook.

    Raises:
        ValueError: A size is negative, or an object lacks an attribute that its function in ``parts`` needs.
    """
    if not marker > 0.0 or not deviations >= 0.0 or not label_height >= 0.0:
        raise ValueError(
            f"marker is positive, deviations and label_height are at least 0, not {(marker, deviations, label_height)}"
        )
    color_of_kind = _COLORS | {kind: to_hex(color) for kind, color in (colors or {}).items()}
    shown = [each for each in model if each.status != RETIRED]
    meshcat.Delete(prefix)
    for object_ in shown:
        path = f"{prefix}/{object_.kind}/{object_.identity}"
        red, green, blue = to_rgb(color_of_kind.get(object_.kind, _OTHERS))
        opacity = _TENTATIVE_OPACITY if object_.status == TENTATIVE else 1.0
        if parts is not None and object_.kind in parts:
            for part in parts[object_.kind](object_):
                meshcat.SetObject(f"{path}/{part.name}", part.shape, Rgba(red, green, blue, opacity))
                meshcat.SetTransform(f"{path}/{part.name}", object_.X_WO @ part.X_OS)
        else:
            meshcat.SetObject(f"{path}/marker", Sphere(marker), Rgba(red, green, blue, opacity))
            meshcat.SetTransform(f"{path}/marker", object_.X_WO)
        if deviations:
            X_WE, semi_axes = covariance_ellipsoid(object_.pose)
            shape = Ellipsoid(*np.maximum(deviations * semi_axes, _FLAT))
            meshcat.SetObject(f"{path}/covariance", shape, Rgba(red, green, blue, _ELLIPSOID_OPACITY))
            meshcat.SetTransform(f"{path}/covariance", X_WE)
        if label_height:
            start, end = text_strokes(object_.identity, label_height)
            meshcat.SetLineSegments(f"{path}/label", start, end, 1.0, Rgba(red, green, blue, 1.0))
            meshcat.SetTransform(f"{path}/label", RigidTransform(object_.p_WoOo_W + np.array([0.0, 0.0, 2.0 * marker])))
    kinds = sorted({each.kind for each in shown})
    return Scene(meshcat, legend={kind: color_of_kind.get(kind, _OTHERS) for kind in kinds})


def covariance_ellipsoid(estimate: PoseEstimate) -> tuple[RigidTransform, NDArray[np.float64]]:
    """Return the pose in W of the ellipsoid of one standard deviation of the position, and its semi-axes (3,) in m.

    The semi-axis along a coordinate that is not known is 0.
    """
    covariance = estimate.covariance[3:, 3:]
    variances, axes = np.linalg.eigh(np.where(np.isfinite(covariance), covariance, 0.0))
    axes[:, 0] *= np.linalg.det(axes)
    return RigidTransform(RotationMatrix(axes), estimate.matrix[:, 3]), np.sqrt(np.maximum(variances, 0.0))


def text_strokes(text: str, height: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return begin and end of the line segments, each (3, n), of a text in the plane of x and z.

    Args:
        text: The text, in one line.
        height: Size of the font, in m.
    """
    polygons: list[NDArray[np.float64]] = [np.array(p) for p in TextPath((0.0, 0.0), text, size=height).to_polygons()]
    outlines = [polygon[:, [0, 0, 1]] * np.array([1.0, 0.0, 1.0]) for polygon in polygons]
    return np.vstack([outline[:-1] for outline in outlines]).T, np.vstack([outline[1:] for outline in outlines]).T
