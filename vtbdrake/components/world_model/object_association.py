"""Assignment of observations to objects: innovations, gates, and the best one-to-one assignment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import scipy
from numpy.typing import NDArray

from vtbdrake.common.arrays import Array
from vtbdrake.components.estimation import chi_square_quantile, one_to_one, squared_distances
from vtbdrake.components.perception.estimate import PoseEstimate
from vtbdrake.components.world_model.objects import (
    AttributeValue,
    WorldObject,
    check_pose,
    checked_attributes,
    finite_part,
)


@dataclass(frozen=True, eq=False)
class Sighting:
    """One observation of an object, in the world frame of the model.

    Attributes:
        kind: The class of what was seen, such as ``"tree"``.
        pose: The measured pose. Its covariance, (6, 6), is positive definite in what was measured, and infinite in
            the rest: in all rotations, or in single translations.
        attributes: Measured attributes by name. Numbers with a deviation take part in the association.
        source: The name of the sensor or function.

    Raises:
        ValueError: No translation was measured, or the covariance is not as described.
    """

    kind: str
    pose: PoseEstimate
    attributes: Mapping[str, AttributeValue] = field(default_factory=dict)
    source: str = ""

    def __post_init__(self) -> None:
        owner = f"a sighting of a {self.kind}"
        check_pose(owner, self.pose)
        part = finite_part(self.pose.covariance)
        if not part[3:].any() or np.linalg.eigvalsh(self.pose.covariance[np.ix_(part, part)])[0] <= 0.0:
            raise ValueError(
                f"the covariance of {owner} is positive definite in what was measured, a position at least"
            )
        object.__setattr__(self, "attributes", checked_attributes(owner, self.attributes))


def mahalanobis(world_object: WorldObject, sighting: Sighting) -> tuple[float, int]:
    """Return the squared Mahalanobis distance d² of a sighting from an object, and its degrees of freedom.

    With the innovation ν in all that both know (components of the pose, measured attributes) and its covariance S,
    d² = νᵀ S⁻¹ ν. If the sighting is of the object, d² is chi-square distributed, to first order in the rotation.

    Args:
        world_object: The object in the model.
        sighting: The observation, in the world frame of the model.

    Raises:
        ValueError: An attribute was seen in another unit.
    """
    part = finite_part(world_object.pose.covariance) & finite_part(sighting.pose.covariance)
    innovations = [world_object.pose.error_to(sighting.pose.X)[part]]
    covariances = [(world_object.pose.covariance + sighting.pose.covariance)[np.ix_(part, part)]]
    for name, measured in sighting.attributes.items():
        expected = world_object.attributes.get(name)
        if expected is not None and expected.is_measured and measured.is_measured:
            check_units(world_object, name, measured)
            innovations.append(np.array([float(measured.value) - float(expected.value)]))
            covariances.append(np.array([[expected.deviation**2 + measured.deviation**2]]))
    nu, S = np.concatenate(innovations), scipy.linalg.block_diag(*covariances)
    return float(squared_distances(nu, S)), nu.size


def check_units(world_object: WorldObject, name: str, measured: AttributeValue) -> None:
    """Raise a ValueError if a measured attribute has another unit than the object's.

    Args:
        world_object: The object in the model.
        name: Name of the attribute, which the object has.
        measured: The attribute as it was seen.
    """
    unit = world_object.attributes[name].unit
    if unit != measured.unit:
        raise ValueError(
            f"{name} of {world_object.identity} is in {unit}, but was seen in {measured.unit}: use one unit"
        )


def associate(
    objects: Sequence[WorldObject], sightings: Sequence[Sighting], *, probability: float = 0.997
) -> dict[int, int]:
    """Return the object that each sighting shows, as sighting -> object by their places, if there is one.

    Each object is seen once at most, and classes agree. Among all one-to-one assignments within the gate, this is the
    one with the least sum of d² over the pairs plus the gate for each sighting that is left over (global nearest
    neighbours). The gate is the quantile of the chi-square distribution with the pair's degrees of freedom. Nothing
    tells how close the decision was: between two objects that fit equally well, a sighting is of the first.

    Args:
        objects: The objects that may have been seen.
        sightings: The observations of one instant.
        probability: The share of right pairs that the gate lets pass.

    Raises:
        ValueError: One of the sightings is something else.
    """
    for sighting in sightings:
        if not isinstance(sighting, Sighting):
            raise ValueError(
                f"sightings are of the class Sighting, not {type(sighting).__name__}: give class, pose, and attributes "
                "of what was seen, as Sighting(kind, pose, attributes)"
            )
    gain = np.zeros((len(sightings), len(objects)))
    for i, j in np.argwhere(_within_reach(objects, sightings, probability)):
        distance, degrees = mahalanobis(objects[j], sightings[i])
        if degrees:
            gain[i, j] = chi_square_quantile(probability, degrees) - distance
    return {int(i): int(j) for i, j in zip(*one_to_one(gain), strict=True)}


def _within_reach(
    objects: Sequence[WorldObject], sightings: Sequence[Sighting], probability: float
) -> NDArray[np.bool_]:
    """Return a mask, (sightings, objects), of the pairs that can be within the gate at all.

    |ν|² / tr S is at most the d² of the translation, so that most pairs need no d². A coordinate that one of them does
    not know makes the trace infinite, and would let all pairs pass; so it is left out.
    """
    widest = max((len(sighting.attributes) for sighting in sightings), default=0)
    gate = chi_square_quantile(probability, 6 + widest)
    reach = np.array([[world_object.kind == s.kind for world_object in objects] for s in sightings], dtype=bool)
    reach = reach.reshape(len(sightings), len(objects))
    delta2, trace = np.zeros(reach.shape), np.zeros(reach.shape)
    for axis in range(3):
        expected, expected_variance = _coordinate([world_object.pose for world_object in objects], axis)
        measured, measured_variance = _coordinate([sighting.pose for sighting in sightings], axis)
        variance = measured_variance[:, np.newaxis] + expected_variance
        shared = np.isfinite(variance)
        delta2 += np.where(shared, measured[:, np.newaxis] - expected, 0.0) ** 2
        trace += np.where(shared, variance, 0.0)
    return reach & (delta2 <= gate * trace)


def _coordinate(poses: Sequence[PoseEstimate], axis: int) -> tuple[Array, Array]:
    """Return one coordinate of each position, and its variance."""
    return np.array([p.matrix[axis, 3] for p in poses]), np.array([p.covariance[3 + axis, 3 + axis] for p in poses])
