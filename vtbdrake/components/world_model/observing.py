"""Updates of a world model from observations: association, fusion, and the life cycle of its objects."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from pydrake.math import RotationMatrix

from vtbdrake.common.arrays import Array
from vtbdrake.common.settings import check_settings, setting
from vtbdrake.components.estimation import kalman_update, one_to_one, weighted_mean
from vtbdrake.components.perception.estimate import PoseEstimate, rotation_matrix
from vtbdrake.components.world_model.object_association import Sighting, associate, check_units
from vtbdrake.components.world_model.objects import (
    CONFIRMED,
    RETIRED,
    REVISED,
    TENTATIVE,
    AttributeValue,
    WorldObject,
    finite_part,
)
from vtbdrake.components.world_model.world_model import WorldModel


@dataclass(frozen=True)
class LifeCycleConfig:
    """The settings by which objects are confirmed, revised and retired; defaults are assumed, not taken from data."""

    gate: float = setting(
        0.997,
        "The share of right pairs of object and sighting that the gate of the association lets pass.",
        gt=0.0,
        lt=1.0,
    )
    confirm: int = setting(3, "The number of hits that confirms a tentative object.", ge=1)
    forget: int = setting(
        2, "The number of misses in a row after which a tentative object is removed from the model.", ge=1
    )
    retire: int = setting(8, "The number of misses in a row after which a confirmed object is retired.", ge=1)
    revise: int = setting(
        3, "The number of conflicts in a row after which a confirmed object is moved to where it is seen.", ge=1
    )
    revise_within: float = setting(
        1.0,
        "The horizontal distance up to which a sighting beyond the gate counts as a conflict with an object "
        "that was expected and not seen; 0 revises nothing.",
        unit="m",
        ge=0.0,
        finite=False,
    )

    def __post_init__(self) -> None:
        check_settings(self)


DEFAULT_LIFE_CYCLE = LifeCycleConfig()


def observe(
    model: WorldModel,
    sightings: Sequence[Sighting],
    *,
    expected: Collection[str] = (),
    rules: LifeCycleConfig = DEFAULT_LIFE_CYCLE,
) -> WorldModel:
    """Return the model after an observation: the sightings of one instant, and the objects expected to be seen.

    1. Sightings are associated with objects that are not retired (`associate`), and fused with them (`fused`). That is
       a *hit*; enough of them confirm a tentative object.
    2. A sighting that is left over near an expected object that was not seen is a *conflict* of the two: the object
       may have been mapped wrongly. Enough of them in a row revise the object: its pose becomes the one seen last.
    3. Every other sighting that is left over begins a tentative object, ``<class>#<number>``.
    4. Every other expected object has a *miss*. Enough of them in a row retire a confirmed object, which stays in the
       model as retired, and remove a tentative one.

    The errors of the sightings must be independent of each other and of the model, or covariances become too small:
    repeated sightings by a robot share the error of its own pose. A filter that estimates both has to update the model
    itself (EKF-SLAM); `associate` and the rules of the life cycle remain of use.

    Args:
        model: The model before.
        sightings: The sightings, in the world frame of the model.
        expected: The identities of the objects that should have been seen: in the field of view and in range, and not
            hidden. That is known to the sensor only.
        rules: The thresholds of the life cycle.

    Raises:
        KeyError: An expected object is not in the model.
        ValueError: One of the sightings is no `Sighting`.
    """
    candidates = [world_object for world_object in model if world_object.status != RETIRED]
    pairs = associate(candidates, sightings, probability=rules.gate)
    changed: dict[str, WorldObject] = {}
    for i, j in pairs.items():
        changed[candidates[j].identity] = _hit(candidates[j], sightings[i], rules)
    unseen = [model[identity] for identity in dict.fromkeys(expected) if identity not in changed]
    unseen = [world_object for world_object in unseen if world_object.status != RETIRED]
    left = [sighting for i, sighting in enumerate(sightings) if i not in pairs]

    conflicts = _conflicts([world_object for world_object in unseen if world_object.is_known], left, rules)
    for identity, sighting in conflicts.items():
        changed[identity] = _conflict(model[identity], sighting, rules)
    forgotten = []
    for world_object in unseen:
        if world_object.identity not in conflicts:
            missed = replace(world_object, misses=world_object.misses + 1, conflicts=0)
            if world_object.status == TENTATIVE and missed.misses >= rules.forget:
                forgotten.append(world_object.identity)
            elif world_object.is_known and missed.misses >= rules.retire:
                changed[world_object.identity] = replace(missed, status=RETIRED)
            else:
                changed[world_object.identity] = missed

    created, explained = model.created, set(map(id, conflicts.values()))
    for sighting in left:
        if id(sighting) not in explained:
            created += 1
            while f"{sighting.kind}#{created}" in model:
                created += 1
            changed[f"{sighting.kind}#{created}"] = _new(f"{sighting.kind}#{created}", sighting, rules)
    updated = model.with_objects(*changed.values(), created=created)
    return updated.without(forgotten) if forgotten else updated


def fused(prior: PoseEstimate, measurement: PoseEstimate) -> PoseEstimate:
    """Return the estimate of a pose from a prior one and an independent measurement, at the time of the later one.

    This is the fusion by information: P⁻¹ = P₁⁻¹ + P₂⁻¹ and P⁻¹ δ = P₂⁻¹ δ₂, where δ is the change from the prior and
    an infinite variance is no information. It is computed by gains, so that the prior may be exact in some components.
    The object is assumed not to move. The rotation is correct to first order in δ.

    Args:
        prior: The estimate before; its covariance may be singular, or infinite in some components.
        measurement: The measurement; its covariance is positive definite, or infinite in some components.
    """
    had, measured = finite_part(prior.covariance), finite_part(measurement.covariance)
    both, new = had & measured, ~had & measured
    P = np.where(np.outer(had, had), prior.covariance, 0.0)
    R = np.where(np.outer(measured, measured), measurement.covariance, 0.0)
    nu = prior.error_to(measurement.X)
    delta, P, _ = kalman_update(P, nu[both], H=np.eye(6)[both], R=R[np.ix_(both, both)])

    # What is known for the first time: the measurement, less its error as far as the other components tell it.
    G = np.linalg.solve(R[np.ix_(both, both)], R[np.ix_(both, new)]).T
    delta[new] = nu[new] - G @ (nu[both] - delta[both])
    across = G @ P[both]
    P[new, :] = across
    P[:, new] = across.T
    P[np.ix_(new, new)] = R[np.ix_(new, new)] - G @ R[np.ix_(both, new)] + across[:, both] @ G.T
    covariance = 0.5 * (P + P.T)
    unknown = ~(had | measured)
    covariance[unknown, unknown] = np.inf
    return PoseEstimate(_moved(prior, delta), covariance, max(prior.time, measurement.time))


def _moved(prior: PoseEstimate, delta: Array) -> Array:
    """Return the matrix (3, 4) of a pose that differs from the prior one by δ."""
    rotation = RotationMatrix.ProjectToRotationMatrix(rotation_matrix(delta[:3]) @ prior.matrix[:, :3]).matrix()
    return np.column_stack([rotation, prior.matrix[:, 3] + delta[3:]])


def _fused_attributes(world_object: WorldObject, sighting: Sighting) -> Mapping[str, AttributeValue]:
    """Return attributes after a sighting: measured numbers are fused, exact ones and texts are kept, new ones added."""
    attributes = dict(world_object.attributes)
    for name, measured in sighting.attributes.items():
        if name not in world_object.attributes:
            attributes[name] = measured
            continue
        prior = world_object.attributes[name]
        check_units(world_object, name, measured)
        if prior.is_measured and measured.is_measured:
            value, deviation = weighted_mean(
                float(prior.value), prior.deviation, float(measured.value), measured.deviation
            )
            attributes[name] = AttributeValue(value, prior.unit, deviation)
    return attributes


def _hit(world_object: WorldObject, sighting: Sighting, rules: LifeCycleConfig) -> WorldObject:
    hits = world_object.hits + 1
    return replace(
        world_object,
        pose=fused(world_object.pose, sighting.pose),
        attributes=_fused_attributes(world_object, sighting),
        status=CONFIRMED if world_object.status == TENTATIVE and hits >= rules.confirm else world_object.status,
        hits=hits,
        misses=0,
        conflicts=0,
    )


def _conflicts(unseen: Sequence[WorldObject], left: Sequence[Sighting], rules: LifeCycleConfig) -> dict[str, Sighting]:
    """Return the sighting nearest to each object that was expected elsewhere; one to one, by horizontal distance."""
    gain = np.zeros((len(unseen), len(left)))
    for i, world_object in enumerate(unseen):
        for j, sighting in enumerate(left):
            if world_object.kind == sighting.kind:
                offset = sighting.pose.matrix[:2, 3] - world_object.pose.matrix[:2, 3]
                gain[i, j] = rules.revise_within - float(np.hypot(*offset))
    return {unseen[i].identity: left[j] for i, j in zip(*one_to_one(gain), strict=True)}


def _conflict(world_object: WorldObject, sighting: Sighting, rules: LifeCycleConfig) -> WorldObject:
    if world_object.conflicts + 1 < rules.revise:
        return replace(world_object, conflicts=world_object.conflicts + 1)
    return replace(
        world_object,
        pose=sighting.pose,
        attributes={**world_object.attributes, **sighting.attributes},
        source=sighting.source,
        status=REVISED,
        hits=1,
        misses=0,
        conflicts=0,
    )


def _new(identity: str, sighting: Sighting, rules: LifeCycleConfig) -> WorldObject:
    return WorldObject(
        identity,
        sighting.kind,
        sighting.pose,
        attributes=sighting.attributes,
        source=sighting.source,
        status=CONFIRMED if rules.confirm == 1 else TENTATIVE,
        hits=1,
    )
