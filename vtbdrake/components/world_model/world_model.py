"""The semantic world model: an immutable collection of objects with queries by class, region and attribute."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from functools import partial
from math import inf
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vtbdrake.common.arrays import Array, Indices
from vtbdrake.components.perception.estimate import PoseEstimate
from vtbdrake.components.world_model.objects import STATUSES, AttributeValue, Relation, WorldObject
from vtbdrake.state.declarations import Codec

# What is nearer to the outline of a polygon than this, in m, lies on it.
_ON_OUTLINE = 1e-9


class _Index(NamedTuple):
    """All objects in their order, and the k-d trees of their positions by the number of coordinates."""

    objects: tuple[WorldObject, ...]
    trees: dict[int, Any]


class WorldModel:
    """The objects that are known, as an immutable value.

    Changes return a new model, which shares all objects that are the same. So a copy costs nothing, and a model is
    abstract state of a system, the environment of a DPS for example; `WORLD_MODEL_CODEC` carries it into snapshots.
    The spatial index is built by the first query that needs it, and shared by all who have the model.

    Args:
        objects: The objects, in the order in which queries return them.
        created: How many identities `observe` has given to new objects so far; an identity is never given twice.

    Attributes:
        created: How many identities have been given to objects that observations have added.

    Raises:
        ValueError: Two objects have one identity, or a relation leads to an object that is not there.
    """

    __slots__ = ("_index", "_objects", "created")

    def __init__(self, objects: Iterable[WorldObject] = (), *, created: int = 0) -> None:
        self._objects: dict[str, WorldObject] = {}
        for world_object in objects:
            if world_object.identity in self._objects:
                raise ValueError(f"two objects have the identity {world_object.identity!r}")
            self._objects[world_object.identity] = world_object
        for world_object in self._objects.values():
            for relation in world_object.relations:
                if relation.other not in self._objects:
                    statement = f"{world_object.identity} {relation.kind} {relation.other!r}"
                    raise ValueError(f"{statement}, which is not an object of the model")
        self.created: int = created
        self._index: _Index | None = None

    def __len__(self) -> int:
        return len(self._objects)

    def __iter__(self) -> Iterator[WorldObject]:
        return iter(self._objects.values())

    def __contains__(self, identity: object) -> bool:
        return identity in self._objects

    def __getitem__(self, identity: str) -> WorldObject:
        try:
            return self._objects[identity]
        except KeyError:
            raise KeyError(f"the world model has no object {identity!r}") from None

    def __deepcopy__(self, memo: dict[int, Any]) -> WorldModel:
        return self

    def __reduce__(self) -> tuple[Any, ...]:
        return partial(WorldModel, created=self.created), (tuple(self),)

    def __repr__(self) -> str:
        kinds = [world_object.kind for world_object in self]
        return f"<WorldModel: {', '.join(f'{kinds.count(k)} {k}' for k in dict.fromkeys(kinds)) or 'empty'}>"

    def positions(self) -> Array:
        """Return the positions p_WoOo_W of all objects in m, shape (n, 3)."""
        return np.array([world_object.pose.matrix[:, 3] for world_object in self]).reshape(-1, 3)

    def find(
        self,
        kind: str | None = None,
        *,
        status: str | Iterable[str] | None = None,
        near: tuple[ArrayLike, float] | None = None,
        box: tuple[ArrayLike, ArrayLike] | None = None,
        polygon: Sequence[ArrayLike] | None = None,
        attributes: Mapping[str, str | tuple[float, float]] | None = None,
    ) -> tuple[WorldObject, ...]:
        """Return the objects that meet all given conditions; the borders of regions belong to them.

        Args:
            kind: Their class.
            status: Their status, or several.
            near: A point and a distance in m, which is the largest; the point has the shape (2,) or (3,), and the
                distance is horizontal or in space.
            box: The least and the largest coordinates in m, shapes (2,) or (3,).
            polygon: An area in the plane as its rings, shapes (n, 2) in m: the outline, then the holes, as the
                coordinates of a Polygon in GeoJSON. A ring may end with its first corner, or before.
            attributes: By name, the text that an attribute is, or the least and the largest value of its number.
                Objects without the attribute do not meet the condition.

        Raises:
            ValueError: A point, a box, a polygon, a status or the condition of an attribute is not one.
        """
        candidates: Iterable[WorldObject] = self
        if near is not None or box is not None or polygon is not None:
            index = self._indexed()
            places = index.trees[3].data
            rows = np.arange(len(places)) if near is None else self._near(*near)
            if box is not None:
                rows = rows[_in_box(places[rows], *box)]
            if polygon is not None:
                rows = rows[_in_polygon(places[rows, :2], polygon)]
            candidates = [index.objects[row] for row in rows]
        statuses = (status,) if isinstance(status, str) else None if status is None else tuple(status)
        for one_status in statuses or ():
            if one_status not in STATUSES:
                raise ValueError(f"a status is one of {', '.join(STATUSES)}, not {one_status!r}")
        conditions = [(name, _condition(name, condition)) for name, condition in (attributes or {}).items()]
        return tuple(
            candidate
            for candidate in candidates
            if (kind is None or candidate.kind == kind)
            and (statuses is None or candidate.status in statuses)
            and all(_meets(candidate.attributes.get(name), condition) for name, condition in conditions)
        )

    def nearest(self, p_WoQ_W: ArrayLike, count: int = 1) -> tuple[WorldObject, ...]:
        """Return the ``count`` objects next to a point Q (3,) in m, or all if there are fewer; the nearest first.

        Args:
            p_WoQ_W: The point Q in the world, shape (3,), in m.
            count: Largest number of objects.
        """
        count = min(count, len(self))
        if count < 1:
            return ()
        index = self._indexed()
        _, rows = index.trees[3].query(_point(p_WoQ_W, 3), k=count)
        return tuple(index.objects[row] for row in np.atleast_1d(rows))

    def related(self, identity: str, kind: str | None = None) -> tuple[WorldObject, ...]:
        """Return the objects to which an object has a relation (of ``kind``, if given).

        Args:
            identity: Identity of the object.
            kind: Kind of the relations; None for all.
        """
        return tuple(self[r.other] for r in self[identity].relations if kind is None or r.kind == kind)

    def with_objects(self, *objects: WorldObject, created: int | None = None) -> WorldModel:
        """Return a model in which these objects replace objects of the same identity, or are added.

        Args:
            objects: The new objects.
            created: The new `created`; by default it remains.
        """
        updated = self._objects | {world_object.identity: world_object for world_object in objects}
        return WorldModel(updated.values(), created=self.created if created is None else created)

    def without(self, identities: Iterable[str]) -> WorldModel:
        """Return a model without these objects, and without the relations to them.

        Raises:
            KeyError: One of them is not there.
        """
        gone = {self[identity].identity for identity in identities}
        left = [world_object for world_object in self if world_object.identity not in gone]
        return WorldModel((_cut(world_object, gone) for world_object in left), created=self.created)

    def _near(self, point: ArrayLike, distance: float) -> Indices:
        """Return the objects within a distance of a point, by row."""
        size = np.size(point)
        if size not in (2, 3) or not distance >= 0.0:
            raise ValueError(f"near is a point (2,) or (3,) and a distance of at least 0 m, not {(point, distance)!r}")
        tree = self._indexed().trees[size]
        return np.array(sorted(tree.query_ball_point(_point(point, size), distance)), dtype=np.intp)

    def _indexed(self) -> _Index:
        if self._index is None:
            from scipy.spatial import cKDTree

            # All is made at once and assigned in one step: other threads see either nothing or everything.
            positions = self.positions()
            self._index = _Index(tuple(self), {2: cKDTree(positions[:, :2]), 3: cKDTree(positions)})
        return self._index


def _cut(world_object: WorldObject, gone: set[str]) -> WorldObject:
    """Return an object without its relations to ``gone``."""
    left = tuple(relation for relation in world_object.relations if relation.other not in gone)
    return world_object if len(left) == len(world_object.relations) else replace(world_object, relations=left)


def _point(point: ArrayLike, size: int) -> Array:
    array = np.asarray(point, dtype=float)
    if array.shape != (size,) or not np.isfinite(array).all():
        raise ValueError(f"a point is {size} finite numbers in m, not {point!r}")
    return array


def _in_box(places: Array, low: ArrayLike, high: ArrayLike) -> NDArray[np.bool_]:
    """Return a mask (n,) of the places (n, 3) within the least and the largest coordinates, (2,) or (3,)."""
    least, largest = np.asarray(low, dtype=float), np.asarray(high, dtype=float)
    if least.shape != largest.shape or least.shape not in ((2,), (3,)) or not (least <= largest).all():
        raise ValueError(f"a box is its least and its largest coordinates, (2,) or (3,), not {(low, high)!r}")
    places = places[:, : least.size]
    inside: NDArray[np.bool_] = np.all((least <= places) & (places <= largest), axis=1)
    return inside


def _in_polygon(places: Array, rings: Sequence[ArrayLike]) -> NDArray[np.bool_]:
    """Return a mask (n,) of the places (n, 2) that lie within rings (k, 2), or on them.

    A place is inside if a ray from it along x crosses the rings an odd number of times: holes need no direction.
    """
    inside, on = np.zeros((2, len(places)), dtype=bool)
    x, y = places.T
    for ring in rings:
        corners = np.asarray(ring, dtype=float)
        if corners.ndim != 2 or corners.shape[1] != 2 or len(corners) < 3 or not np.isfinite(corners).all():
            raise ValueError(f"a polygon is a list of rings of at least 3 corners, (n, 2) in m, not {rings!r}")
        for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            side = b - a
            length2 = max(float(side @ side), 1e-300)
            nearest = a + np.clip((places - a) @ side / length2, 0.0, 1.0)[:, np.newaxis] * side
            on |= np.hypot(*(places - nearest).T) <= _ON_OUTLINE
            if a[1] != b[1]:
                inside ^= ((a[1] > y) != (b[1] > y)) & (x < a[0] + (y - a[1]) / side[1] * side[0])
    return inside | on


def _condition(name: str, condition: str | tuple[float, float]) -> str | tuple[float, float]:
    if isinstance(condition, str):
        return condition
    low, high = condition if np.shape(condition) == (2,) else (inf, -inf)
    if not -inf <= low <= high <= inf:
        raise ValueError(f"the condition of {name} is a text, or the least and the largest number, not {condition!r}")
    return (low, high)


def _meets(quantity: AttributeValue | None, condition: str | tuple[float, float]) -> bool:
    if quantity is None or isinstance(quantity.value, str) != isinstance(condition, str):
        return False
    if isinstance(condition, str):
        return quantity.value == condition
    return condition[0] <= float(quantity.value) <= condition[1]


def _encode(model: WorldModel) -> dict[str, np.ndarray]:
    if not isinstance(model, WorldModel):
        raise ValueError(f"a WorldModel is expected here, not {model!r}")
    texts = [
        {
            "identity": world_object.identity,
            "kind": world_object.kind,
            "attributes": {name: asdict(quantity) for name, quantity in world_object.attributes.items()},
            "relations": [asdict(relation) for relation in world_object.relations],
            "source": world_object.source,
            "status": world_object.status,
        }
        for world_object in model
    ]
    return {
        "matrices": np.array([world_object.pose.matrix for world_object in model]).reshape(-1, 3, 4),
        "covariances": np.array([world_object.pose.covariance for world_object in model]).reshape(-1, 6, 6),
        "times": np.array([world_object.pose.time for world_object in model], dtype=float),
        "counts": np.array(
            [(world_object.hits, world_object.misses, world_object.conflicts) for world_object in model], dtype=np.int64
        ).reshape(-1, 3),
        "created": np.array(model.created),
        "texts": np.frombuffer(json.dumps(texts).encode(), dtype=np.uint8),
    }


def _decode(arrays: Mapping[str, np.ndarray]) -> WorldModel:
    columns = (arrays["matrices"], arrays["covariances"], arrays["times"].tolist(), arrays["counts"].tolist())
    objects = [
        WorldObject(
            identity=text["identity"],
            kind=text["kind"],
            pose=PoseEstimate(matrix, covariance, time),
            attributes={name: AttributeValue(**quantity) for name, quantity in text["attributes"].items()},
            relations=tuple(Relation(**relation) for relation in text["relations"]),
            source=text["source"],
            status=text["status"],
            hits=counts[0],
            misses=counts[1],
            conflicts=counts[2],
        )
        for text, matrix, covariance, time, counts in zip(json.loads(arrays["texts"].tobytes()), *columns, strict=True)
    ]
    return WorldModel(objects, created=int(arrays["created"].item()))


# A world model as arrays and back, exact to the last bit: the codec of a system's abstract state.
WORLD_MODEL_CODEC = Codec(_encode, _decode)
