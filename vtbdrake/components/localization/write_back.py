"""Writes what a drive has shown back into the semantic world model that its map came from.

The model then has the landmarks that the survey lacked, with the covariances of the filter, and not the ones that are
gone. So a mental world that is built from it (`add_to_plant`) has them, too.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from pydrake.math import RigidTransform

from vtbdrake.common.arrays import Array
from vtbdrake.components.localization.landmarks import DIAMETERS, Landmarks
from vtbdrake.components.localization.revision import MapChanges
from vtbdrake.components.perception.estimate import PoseEstimate
from vtbdrake.components.world_model import AttributeValue, WorldModel, WorldObject
from vtbdrake.components.world_model.objects import CONFIRMED, RETIRED, REVISED

# The rows of x and y in the covariance of a pose.
_PLANE = [3, 4]


def written_back(
    model: WorldModel, changes: MapChanges, *, kind: str = "tree", time: float, source: str = "drive"
) -> WorldModel:
    """Return the world model of a map with the changes that a drive has shown.

    Landmarks that are gone are retired. Moved ones are revised: they have the position, the covariance and the diameter
    by the drive. Added ones are new objects ``<class>#<number>`` that are confirmed. A drive shows where these are and
    how wide: their height over the ground of the model is the one of the nearest object of the map, with an infinite
    variance, and their other lengths, such as the height of a tree, are taken from the object of the most
    similar diameter.

    The errors of the landmarks are correlated in the filter, with each other and with the map. A world model has no
    such correlations: do not fuse the result with further observations of the same drive.

    Args:
        model: The model that `map_landmarks` made the map of.
        changes: The changes, see `Tracker.changes`.
        kind: The class of the landmarks.
        time: The time of the drive in s, for the poses.
        source: The origin of the knowledge, for the objects that change.

    Raises:
        ValueError: The changes are of another map: they name landmarks that the model does not have.
    """
    mapped = [landmark for landmark in model.find(kind) if landmark.is_known]
    named = [*changes.gone.tolist(), *changes.origins.tolist()]
    if named and max(named) >= len(mapped):
        raise ValueError(
            f"the changes name the landmark {max(named)}, but the model has {len(mapped)} objects of the class {kind}: "
            "the map of the tracker must be made of this model"
        )
    changed = [replace(mapped[k], status=RETIRED, source=source) for k in changes.gone.tolist()]
    for row, k in enumerate(changes.origins.tolist()):
        was = mapped[k]
        attributes = {**was.attributes, **_diameter(changes.moved, row, kind)}
        pose = _pose(changes.moved, row, height=float(was.p_WoOo_W[2]), variance=was.pose.covariance[5, 5], time=time)
        changed.append(replace(was, pose=pose, attributes=attributes, status=REVISED, source=source, misses=0))
    created = model.created
    for row in range(len(changes.added)):
        created += 1
        while f"{kind}#{created}" in model:
            created += 1
        changed.append(_added(changes.added, row, f"{kind}#{created}", kind, mapped, time=time, source=source))
    return model.with_objects(*changed, created=created)


def _added(
    landmarks: Landmarks, row: int, identity: str, kind: str, mapped: list[WorldObject], *, time: float, source: str
) -> WorldObject:
    places = np.array([landmark.p_WoOo_W for landmark in mapped])
    diameters = np.array([landmark.number(DIAMETERS[kind], unit="m") for landmark in mapped])
    nearest = int(np.argmin(np.hypot(*(places[:, :2] - landmarks.positions[row]).T)))
    similar = mapped[int(np.argmin(np.abs(diameters - landmarks.diameters[row])))]
    lengths = {
        name: AttributeValue(value.value, "m") for name, value in similar.attributes.items() if value.unit == "m"
    }
    pose = _pose(landmarks, row, height=float(places[nearest, 2]), variance=np.inf, time=time)
    return WorldObject(
        identity, kind, pose, attributes={**lengths, **_diameter(landmarks, row, kind)}, source=source, status=CONFIRMED
    )


def _pose(landmarks: Landmarks, row: int, *, height: float, variance: float, time: float) -> PoseEstimate:
    """Return the pose of a landmark, of whose rotation nothing is known."""
    covariance: Array = np.diag(np.full(6, np.inf))
    covariance[np.ix_(_PLANE, _PLANE)] = landmarks.covariances[row]
    covariance[5, 5] = variance
    return PoseEstimate.of(RigidTransform([*landmarks.positions[row], height]), covariance, time=time)


def _diameter(landmarks: Landmarks, row: int, kind: str) -> Mapping[str, AttributeValue]:
    deviation = float(landmarks.diameter_deviations[row])
    finite = deviation if np.isfinite(deviation) else 0.0
    return {DIAMETERS[kind]: AttributeValue(float(landmarks.diameters[row]), "m", finite)}
