"""One object of a semantic world model: identity, class, pose, attributes, relations, life cycle."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields
from functools import partial
from math import isfinite
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.math import RigidTransform

from vtbdrake.common.arrays import Array
from vtbdrake.components.perception.estimate import PoseEstimate

TENTATIVE = "tentative"
CONFIRMED = "confirmed"
REVISED = "revised"
RETIRED = "retired"
STATUSES = (TENTATIVE, CONFIRMED, REVISED, RETIRED)

_NAME = re.compile(r"[a-z][a-z0-9_]*")
_SYMBOL = r"(?:kg|mol|cd|rad|Pa|Hz|[msAKNJWV])(?:\^-?\d+)?"
_UNIT = re.compile(rf"1|(?:1|{_SYMBOL})(?:[*/]{_SYMBOL})*")


@dataclass(frozen=True)
class AttributeValue:
    """The value of an attribute.

    Attributes:
        value: A finite number in ``unit``, or a text such as a species.
        unit: The SI unit of a number, such as ``"m"`` or ``"kg/m^3"``; ``"1"`` if it has none, as for a text.
        deviation: The standard deviation of a number in ``unit``. 0 means that it is taken as exact: observations do
            not change it and are not compared with it.

    Raises:
        ValueError: The number is not finite, the unit is not SI, or the deviation is negative or one of a text.
    """

    value: float | str
    unit: str = "1"
    deviation: float = 0.0

    def __post_init__(self) -> None:
        if not _UNIT.fullmatch(self.unit):
            raise ValueError(
                f"a unit is made of SI units, such as m, kg/m^3 or 1, not {self.unit!r}: convert the value"
            )
        if isinstance(self.value, str):
            if self.unit != "1" or self.deviation != 0.0:
                raise ValueError(f"the text {self.value!r} has no unit and no deviation")
            return
        if isinstance(self.value, bool) or not isfinite(self.value):
            raise ValueError(f"a quantity is a finite number or a text, not {self.value!r}")
        if not (self.deviation >= 0.0 and isfinite(self.deviation)):
            raise ValueError(f"a standard deviation is finite and at least 0, not {self.deviation}")
        object.__setattr__(self, "value", float(self.value))
        object.__setattr__(self, "deviation", float(self.deviation))

    @property
    def is_measured(self) -> bool:
        """Return whether this is a number with a deviation, which can be compared and fused with another one."""
        return self.deviation > 0.0


@dataclass(frozen=True)
class Relation:
    """A statement about two objects, such as ``Relation("stands_on", "ground")``.

    Attributes:
        kind: What the first object, which holds the relation, is to the second one.
        other: The identity of the second object.
    """

    kind: str
    other: str


@dataclass(frozen=True, eq=False)
class WorldObject:
    """One object O of a semantic world model, in the world frame W of the model. An object is immutable.

    ``pose`` is the estimate of X_WO, with its time. The covariance is infinite where nothing is known: in all three
    rotations (a trunk has no meaningful orientation), or in single translations (the height at which a scan cuts it).
    There, the pose is a convention. A covariance of zero is an exactly known value.

    Attributes:
        identity: A name that no other object of the model has.
        kind: The class of the object, such as ``"tree"``, ``"rock"`` or ``"satellite"``.
        pose: The estimate of X_WO.
        attributes: Quantities by name (lower case, as an identifier).
        relations: Relations to other objects of the same model.
        source: The origin of the knowledge, such as the name of a survey or of a sensor.
        status: ``"tentative"``, ``"confirmed"``, ``"revised"`` or ``"retired"``, see `observe`.
        hits: How many observations have confirmed it.
        misses: How many observations since the last hit expected and did not see it.
        conflicts: How many observations since the last hit saw it displaced.

    Raises:
        ValueError: The identity, the class or an attribute's name is not one, the covariance is none, or the status is
            unknown.
    """

    identity: str
    kind: str
    pose: PoseEstimate
    attributes: Mapping[str, AttributeValue] = field(default_factory=dict)
    relations: tuple[Relation, ...] = ()
    source: str = ""
    status: str = CONFIRMED
    hits: int = 0
    misses: int = 0
    conflicts: int = 0

    def __post_init__(self) -> None:
        if not isinstance(self.identity, str) or not self.identity.strip():
            raise ValueError(f"the identity of an object is a text that is not blank, not {self.identity!r}")
        if not isinstance(self.kind, str) or not self.kind.strip():
            raise ValueError(f"the class of {self.identity} is a text that is not blank, not {self.kind!r}")
        check_pose(self.identity, self.pose)
        object.__setattr__(self, "attributes", checked_attributes(self.identity, self.attributes))
        object.__setattr__(self, "relations", tuple(self.relations))
        if self.status not in STATUSES:
            raise ValueError(f"the status of {self.identity} is one of {', '.join(STATUSES)}, not {self.status!r}")
        if min(self.hits, self.misses, self.conflicts) < 0:
            raise ValueError(f"hits, misses and conflicts of {self.identity} are counts, and not negative")

    @property
    def X_WO(self) -> RigidTransform:
        """The estimated pose X_WO."""
        return self.pose.X

    @property
    def p_WoOo_W(self) -> Array:
        """The estimated position (3,) in m."""
        return self.pose.matrix[:, 3]

    @property
    def is_known(self) -> bool:
        """Return whether the object is believed to be there: neither tentative nor retired."""
        return self.status in (CONFIRMED, REVISED)

    def number(self, attribute: str, *, unit: str) -> float:
        """Return a numeric attribute.

        Args:
            attribute: Its name.
            unit: The unit in which the caller expects it.

        Raises:
            ValueError: The object has no such attribute, or it is a text or in another unit.
        """
        quantity = self.attributes.get(attribute)
        if quantity is None:
            has = ", ".join(self.attributes) or "none"
            raise ValueError(f"the {self.kind} {self.identity} has no attribute {attribute} (it has: {has})")
        if isinstance(quantity.value, str) or quantity.unit != unit:
            raise ValueError(
                f"{attribute} of the {self.kind} {self.identity} is not a number in {unit}, but {quantity}"
            )
        return float(quantity.value)

    def __repr__(self) -> str:
        x, y, z = self.p_WoOo_W
        return f"<{self.kind} {self.identity}: {self.status}, at ({x:.2f}, {y:.2f}, {z:.2f}) m>"

    def __deepcopy__(self, memo: dict[int, Any]) -> WorldObject:
        return self

    def __reduce__(self) -> tuple[Any, ...]:
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return partial(WorldObject, **values | {"attributes": dict(self.attributes)}), ()


def position_estimate(
    p_WoOo_W: ArrayLike, *, deviation: float | Iterable[float] = 0.0, time: float = 0.0
) -> PoseEstimate:
    """Return the estimate of a position, without an orientation.

    Args:
        p_WoOo_W: The position (3,) in m.
        deviation: The standard deviation of each coordinate in m, one number or three; ``inf`` where a coordinate is
            not known.
        time: When it held, in s.

    Raises:
        ValueError: A deviation is negative or NaN.
    """
    deviations = np.broadcast_to(np.asarray(deviation, dtype=float), (3,))
    if not (deviations >= 0.0).all():
        raise ValueError(f"deviations of a position are at least 0 m, not {deviation!r}")
    variances = np.concatenate([np.full(3, np.inf), deviations**2])
    return PoseEstimate.of(RigidTransform(np.asarray(p_WoOo_W, dtype=float)), np.diag(variances), time=time)


def finite_part(covariance: Array) -> NDArray[np.bool_]:
    """Return a mask (6,) of the components [rotation; translation] with a finite variance in a covariance (6, 6)."""
    return np.isfinite(np.diag(covariance))


def check_pose(owner: str, pose: PoseEstimate) -> None:
    """Raise a ValueError if a pose is not an estimate whose covariance is one, possibly infinite in some components.

    Args:
        owner: Whose pose it is, for the error message.
        pose: The pose, with the covariance (6, 6) in rad and m.
    """
    if not pose.valid:
        raise ValueError(f"the pose of {owner} is missing: leave out objects without a known pose")
    if not np.isfinite(pose.matrix).all() or not isfinite(pose.time):
        raise ValueError(f"pose and time of {owner} are finite numbers")
    part = finite_part(pose.covariance)
    diagonal = np.diag(pose.covariance)
    if np.isnan(pose.covariance).any() or (diagonal < 0.0).any():
        raise ValueError(f"the covariance of {owner} has variances of at least 0, not {diagonal}")
    if part[:3].any() and not part[:3].all():
        raise ValueError(f"the variances of the rotation of {owner} are all finite or all infinite, not {diagonal[:3]}")
    if np.count_nonzero(pose.covariance) == np.count_nonzero(diagonal):
        return  # A diagonal matrix, as most maps have it: variances of at least 0 are all that it needs.
    block = pose.covariance[np.ix_(part, part)]
    mixed = pose.covariance[~np.outer(part, part) & ~np.eye(6, dtype=bool)]
    scale = float(np.max(np.abs(block), initial=0.0))
    if mixed.any() or not np.isfinite(block).all() or np.abs(block - block.T).max(initial=0.0) > 1e-9 * scale:
        raise ValueError(f"the covariance of {owner} is symmetric, and zero beside its infinite variances")
    if block.size and np.linalg.eigvalsh(block)[0] < -1e-9 * scale:
        raise ValueError(f"the covariance of {owner} is not positive semidefinite")


def checked_attributes(owner: str, attributes: Mapping[str, AttributeValue]) -> Mapping[str, AttributeValue]:
    """Return a read-only copy of the attributes, after a check of their names and types.

    Args:
        owner: Whose attributes they are, for the error message.
        attributes: The attributes by name, an identifier in lower case.
    """
    for name, quantity in attributes.items():
        if not _NAME.fullmatch(name):
            raise ValueError(f"the attribute {name!r} of {owner} is not named like an identifier in lower case")
        if not isinstance(quantity, AttributeValue):
            raise ValueError(f"the attribute {name} of {owner} is a AttributeValue, not {quantity!r}")
    return MappingProxyType(dict(attributes))
