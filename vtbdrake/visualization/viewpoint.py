"""From where a scene is looked at: a camera that shows all of some points, as Meshcat's page sees them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RotationMatrix

if TYPE_CHECKING:
    from vtbdrake.state import Snapshot

FIELD_OF_VIEW = np.deg2rad(75.0)
"""The vertical field of view of Meshcat's camera."""

# Keys of the notes of a snapshot.
_NOTES = ("camera.position", "camera.target")
# Points from the target to the camera: from the front at the right, and above.
_DIRECTION = np.array([0.64, -0.68, 0.36]) / np.linalg.norm([0.64, -0.68, 0.36])


@dataclass(frozen=True)
class Viewpoint:
    """A camera that looks at a point, with the z axis of the world upwards.

    Attributes:
        position: Where it is, in the world frame, in m.
        target: What it looks at, in the world frame, in m.
    """

    position: tuple[float, float, float]
    target: tuple[float, float, float]

    def __post_init__(self) -> None:
        values = np.array([self.position, self.target], dtype=float)
        if values.shape != (2, 3) or not np.isfinite(values).all():
            raise ValueError(f"a camera has a finite position (3,) and target (3,), not {self.position}, {self.target}")
        if float(np.abs(np.diff(values[:, :2], axis=0)).max()) < 1e-9 * (1.0 + float(np.abs(values).max())):
            raise ValueError(
                f"a camera above its target, at {self.position} and {self.target}, has no upward direction"
            )

    @property
    def notes(self) -> dict[str, Any]:
        """Return the notes of this camera in a snapshot, see `camera_of`."""
        return dict(zip(_NOTES, (list(self.position), list(self.target)), strict=True))

    @property
    def pose(self) -> RigidTransform:
        """Return X_WC; the camera looks along its z axis, and its y axis points down in the image."""
        position, target = np.array(self.position), np.array(self.target)
        forward = (target - position) / np.linalg.norm(target - position)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        return RigidTransform(RotationMatrix(np.column_stack([right, np.cross(forward, right), forward])), position)


def camera_of(snapshot: Snapshot) -> Viewpoint | None:
    """Return the camera of the page that has saved a snapshot; None if none is noted.

    Raises:
        ValueError: The note is not a camera.
    """
    position, target = (snapshot.notes.get(key) for key in _NOTES)
    if position is None and target is None:
        return None
    try:
        return Viewpoint(tuple(position or ()), tuple(target or ()))
    except (TypeError, ValueError) as error:
        raise ValueError(f"the snapshot notes a camera at {position!r} towards {target!r}: {error}") from error


def fitting_camera(points_W: NDArray[np.float64], *, margin: float = 1.15, aspect: float = 4.0 / 3.0) -> Viewpoint:
    """Return the nearest camera in a fixed direction of sight that shows all points.

    Args:
        points_W: The points, shape (3, n), n >= 1.
        margin: The field of view in terms of that which the points need.
        aspect: The least width of the view in terms of its height.
    """
    center = 0.5 * (points_W.min(axis=1) + points_W.max(axis=1))
    R_WC = _camera(center, 1.0).pose.rotation()
    x, y, z = R_WC.inverse().matrix() @ (points_W - center[:, np.newaxis])
    tangent = np.tan(0.5 * FIELD_OF_VIEW) / margin
    shift, distances = np.zeros(3), []
    for axis, place, slope in ((0, x, tangent * aspect), (1, y, tangent)):
        # From shift and distance, |place - shift| <= slope (distance + z): both sides hold at the least distance.
        above, below = float((place / slope - z).max()), float((-place / slope - z).max())
        shift[axis] = 0.5 * slope * (above - below)
        distances.append(0.5 * (above + below))
    # A single point is looked at from 1 m.
    distance = max(distances) if np.ptp(points_W, axis=1).max() > 1e-6 else 1.0
    return _camera(center + R_WC.matrix() @ shift, distance)


def _camera(target: NDArray[np.float64], distance: float) -> Viewpoint:
    (x, y, z), (target_x, target_y, target_z) = target + distance * _DIRECTION, target
    return Viewpoint((float(x), float(y), float(z)), (float(target_x), float(target_y), float(target_z)))
