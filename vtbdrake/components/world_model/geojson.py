"""World models as GeoJSON files (RFC 7946), which QGIS and geopandas read.

Every object is a Feature with a Point: its origin as longitude, latitude and height over the ellipsoid, all of WGS84.
Its `id` is the identity; its properties are flat, so that a table shows them:

* ``class``, ``status``, ``source``, ``time`` (s), ``hits``, ``misses``, ``conflicts``;
* every attribute by its name, and ``<name>_deviation`` beside it, unless the deviation is 0;
* ``orientation`` (the quaternion w, x, y, z of R_WO) and ``covariance`` (six rows; null is an infinite variance), both
  in the frame W of the model; ``relations``, a list of ``{"kind": ..., "other": ...}``. These three are texts of JSON,
  because tables of other programs round or lose lists; lists are read, too.

The FeatureCollection has two foreign members: ``local_frame`` is the `LocalFrame` of W, and ``units`` the unit of every
numeric attribute. Other programs drop both when they write; then they are arguments of `load_geojson`.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping
from dataclasses import asdict
from math import hypot, inf, isfinite
from pathlib import Path
from typing import Any, NoReturn, TypeVar

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform, RotationMatrix

from vtbdrake.common.arrays import Array
from vtbdrake.common.json_data import plain
from vtbdrake.components.perception.estimate import PoseEstimate
from vtbdrake.components.world_model.local_frame import LocalFrame
from vtbdrake.components.world_model.objects import (
    CONFIRMED,
    AttributeValue,
    Relation,
    WorldObject,
)
from vtbdrake.components.world_model.world_model import WorldModel
from vtbdrake.state.archive import whole_file

_Read = TypeVar("_Read")

_DEVIATION = "_deviation"
_OWN = (
    *("class", "status", "source", "time", "hits", "misses", "conflicts"),
    *("orientation", "covariance", "relations", "id"),
)
# The names that GDAL gives to WGS84 in GeoJSON, without and with heights.
_WGS84 = ("CRS84", "EPSG::4326", "EPSG::4979")
# A tangent plane is no map of what is farther away than this, in m: such a place is a mistake.
_FARTHEST = 100e3


class GeoJsonError(ValueError):
    """A file that is no world model in GeoJSON; the error names the feature."""


def save_geojson(model: WorldModel, path: str | os.PathLike[str], *, frame: LocalFrame) -> None:
    """Write a world model as a GeoJSON file, whole or not at all.

    Args:
        model: The world model.
        path: The file.
        frame: Where the world frame of the model lies on Earth.

    Raises:
        ValueError: An attribute has the name of another property, or one attribute is in several units.
    """
    units: dict[str, str] = {}
    for world_object in model:
        for name, quantity in world_object.attributes.items():
            if name in _OWN or name.endswith(_DEVIATION):
                raise ValueError(
                    f"the attribute {name} of {world_object.identity} has the name of another property in GeoJSON"
                )
            if not isinstance(quantity.value, str) and units.setdefault(name, quantity.unit) != quantity.unit:
                raise ValueError(f"{name} of {world_object.identity} is in {quantity.unit}, of others in {units[name]}")
    places = frame.to_geographic(model.positions())
    members = {"type": "FeatureCollection", "local_frame": asdict(frame), "units": units}
    features = (_feature(world_object, place) for world_object, place in zip(model, places, strict=True))
    with whole_file(path) as partial, partial.open("w", encoding="utf-8") as file:
        # One after another, because all of them as one text took 0.7 GB for 100,000 objects.
        file.write(json.dumps(members, allow_nan=False).removesuffix("}") + ', "features": [\n')
        for number, feature in enumerate(features):
            file.write((",\n" if number else "") + json.dumps(feature, allow_nan=False))
        file.write("\n]}\n")


def _feature(world_object: WorldObject, place: Array) -> dict[str, Any]:
    properties: dict[str, Any] = {
        "class": world_object.kind,
        "status": world_object.status,
        "source": world_object.source,
        "time": world_object.pose.time,
        "hits": world_object.hits,
        "misses": world_object.misses,
        "conflicts": world_object.conflicts,
    }
    for name, quantity in world_object.attributes.items():
        properties[name] = quantity.value
        if quantity.is_measured:
            properties[name + _DEVIATION] = quantity.deviation
    properties |= {
        "orientation": json.dumps(world_object.X_WO.rotation().ToQuaternion().wxyz().tolist()),
        "covariance": json.dumps(plain(world_object.pose.covariance)),
        "relations": json.dumps([asdict(relation) for relation in world_object.relations]),
    }
    geometry = {"type": "Point", "coordinates": place.tolist()}
    return {"type": "Feature", "id": world_object.identity, "geometry": geometry, "properties": properties}


def load_geojson(
    path: str | os.PathLike[str],
    *,
    frame: LocalFrame | None = None,
    units: Mapping[str, str] | None = None,
    deviation: float = 0.0,
) -> WorldModel:
    """Read a world model from a GeoJSON file.

    Only the property ``class`` is needed: others have the defaults of `WorldObject`, an orientation along W, and
    a covariance that is infinite for the rotation and follows from `deviation` for the position. A property that is
    null is left out.

    Args:
        path: The file.
        frame: The frame W of the model, for a file that does not declare it.
        units: Units of numeric attributes that the file does not declare, by name.
        deviation: Standard deviation in m, per axis, of the positions of features without a covariance. With 0 they are
            exact: then a localization finds nothing, or its covariance is too small.

    Raises:
        FileNotFoundError: There is no such file.
        GeoJsonError: The file is not such a GeoJSON file.
    """
    try:
        data = json.loads(Path(path).read_text("utf-8-sig"), parse_constant=_reject, object_pairs_hook=_unique)
        return _GeoJsonReader(data, frame, units or {}, deviation).model()
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise GeoJsonError(f"{path}: no JSON in UTF-8, convert other formats to GeoJSON: {error}") from error
    except (ValueError, RecursionError) as error:
        raise GeoJsonError(f"{path}: {error}") from error


def _reject(constant: str) -> NoReturn:
    raise ValueError(f"{constant} is not a number of JSON")


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    members = dict(pairs)
    if len(members) < len(pairs):
        raise ValueError(f"one of the members {', '.join(name for name, _ in pairs)} is there twice")
    return members


class _GeoJsonReader:
    """Makes a model of what JSON gave."""

    def __init__(self, data: Any, frame: LocalFrame | None, units: Mapping[str, str], deviation: float) -> None:
        if not 0.0 <= deviation < inf:
            raise ValueError(f"deviation is a standard deviation in m, finite and at least 0, not {deviation!r}")
        self._variance = deviation**2
        if not isinstance(data, dict) or data.get("type") != "FeatureCollection":
            raise ValueError("the file is a GeoJSON FeatureCollection")
        # Programs write this member, which is obsolete since RFC 7946, also for WGS84.
        if "crs" in data and not any(name in json.dumps(data["crs"]) for name in _WGS84):
            raise ValueError("coordinates are longitude and latitude of WGS84 (RFC 7946): convert them, and remove crs")
        if not isinstance(data.get("features"), list):
            raise ValueError("the FeatureCollection has a list of features")
        self._features: list[Any] = data["features"]
        declared = data.get("units", {})
        if not isinstance(declared, dict) or not all(isinstance(unit, str) for unit in declared.values()):
            raise ValueError("units is an object: attribute -> unit")
        self._units = {**declared, **units}
        self._frame = _local_frame(data.get("local_frame"), frame)

    def model(self) -> WorldModel:
        places = [self._named(number, self._place) for number in range(len(self._features))]
        # All at once: one at a time, this took a third of the time of reading.
        positions = self._frame.from_geographic(np.array(places, dtype=float).reshape(-1, 3))
        identities: set[str] = set()
        return WorldModel(self._named(k, self._object, positions[k], identities) for k in range(len(self._features)))

    def _named(self, number: int, read: Callable[..., _Read], *further: Any) -> _Read:
        """Return the result of ``read(number, *further)``; an error names the feature of this number."""
        try:
            return read(number, *further)
        except (ValueError, TypeError, OverflowError) as error:
            feature, name = self._features[number], f"feature {number}"
            if isinstance(feature, dict) and isinstance(feature.get("id"), str | int):
                name = f"feature {number} ({feature['id']})"
            raise ValueError(f"{name}: {error}") from error

    def _place(self, number: int) -> list[float]:
        """Return longitude, latitude (deg) and height (m) of a feature."""
        feature = self._features[number]
        if not isinstance(feature, dict) or feature.get("type") != "Feature":
            raise ValueError("a member of features is a Feature")
        geometry = feature.get("geometry")
        if not isinstance(geometry, dict) or geometry.get("type") != "Point":
            kind = geometry.get("type") if isinstance(geometry, dict) else geometry
            raise ValueError(f"its geometry is a Point, not {kind!r}: give sizes as attributes")
        coordinates = geometry.get("coordinates")
        if not isinstance(coordinates, list) or len(coordinates) not in (2, 3) or not _are_numbers(coordinates):
            raise ValueError(f"its coordinates are longitude, latitude and perhaps height, not {coordinates!r}")
        longitude, latitude, height = [*coordinates, self._frame.height][:3]
        if not (-180.0 <= longitude <= 180.0 and -90.0 <= latitude <= 90.0):
            raise ValueError(f"its coordinates are degrees of longitude and latitude, not {longitude}, {latitude}")
        return [longitude, latitude, height]

    def _object(self, number: int, position: Array, identities: set[str]) -> WorldObject:
        """Return the object of a feature at a position (m); its identity joins the ``identities`` before it."""
        feature = self._features[number]
        properties = feature.get("properties")
        if not isinstance(properties, dict):
            raise ValueError("its properties are an object with a class at least")
        properties = {name: value for name, value in properties.items() if value is not None}
        # Programs that know no member `id` write it as a property.
        identity = feature.get("id", properties.get("id"))
        if isinstance(identity, bool) or not isinstance(identity, str | int) or identity == "":
            raise ValueError(f"its id is a text or a whole number, not {identity!r}")
        if str(identity) in identities:
            raise ValueError("another feature has this id, too")
        identities.add(str(identity))
        kind = properties.get("class")
        if not isinstance(kind, str):
            raise ValueError(f"its property class is a text, such as tree, not {kind!r}")
        return WorldObject(
            str(identity),
            kind,
            self._pose(position, properties),
            attributes=self._attributes(properties),
            relations=_relations(_plain(properties.get("relations", []))),
            source=_text(properties, "source", ""),
            status=_text(properties, "status", CONFIRMED),
            hits=_count(properties, "hits"),
            misses=_count(properties, "misses"),
            conflicts=_count(properties, "conflicts"),
        )

    def _pose(self, position: Array, properties: Mapping[str, Any]) -> PoseEstimate:
        if not np.abs(position).max() < _FARTHEST:
            far, origin = np.abs(position).max() / 1e3, self._frame
            raise ValueError(
                f"it lies {far:.0f} km from the origin of the local frame, at {origin.longitude_deg:g}, "
                f"{origin.latitude_deg:g}: this is a map of another place, or its coordinates are not longitude and "
                "latitude in degrees, in this order"
            )
        covariance = np.diag([np.inf] * 3 + [self._variance] * 3)
        if "covariance" in properties:
            covariance = _covariance(_plain(properties["covariance"]))
        wxyz = _plain(properties.get("orientation", [1.0, 0.0, 0.0, 0.0]))
        shaped = isinstance(wxyz, list) and len(wxyz) == 4 and _are_numbers(wxyz)
        if not shaped or abs(hypot(*wxyz) - 1.0) > 1e-6:
            raise ValueError(f"its orientation is a unit quaternion (w, x, y, z), not {wxyz!r}")
        rotation = RotationMatrix(Quaternion(np.array(wxyz, dtype=float) / hypot(*wxyz)))
        time = properties.get("time", 0.0)
        if not _are_numbers([time]):
            raise ValueError(f"its time is a number in seconds, not {time!r}")
        return PoseEstimate.of(RigidTransform(rotation, position), covariance, time=time)

    def _attributes(self, properties: Mapping[str, Any]) -> dict[str, AttributeValue]:
        attributes: dict[str, AttributeValue] = {}
        names = [name for name in properties if name not in _OWN]
        for name in names:
            value = properties[name]
            owner = name.removesuffix(_DEVIATION)
            if owner != name:
                if owner not in properties:
                    raise ValueError(f"its property {name} is the deviation of an attribute that it does not have")
            elif isinstance(value, str):
                attributes[name] = AttributeValue(value)
            elif not _are_numbers([value]):
                raise ValueError(f"its attribute {name} is a number or a text, not {value!r}")
            elif name not in self._units:
                raise ValueError(f"its attribute {name} has no unit: declare it in units, for example as m, or as 1")
            else:
                deviation = properties.get(name + _DEVIATION, 0.0)
                if not _are_numbers([deviation]):
                    raise ValueError(f"its property {name}{_DEVIATION} is a number, not {deviation!r}")
                try:
                    attributes[name] = AttributeValue(value, self._units[name], deviation)
                except ValueError as error:
                    raise ValueError(f"its attribute {name}: {error}") from error
        return attributes


def _local_frame(data: Any, frame: LocalFrame | None) -> LocalFrame:
    if data is None and frame is None:
        raise ValueError(
            "the member local_frame, which other programs drop, is missing: add its place on Earth to the file, as "
            '"local_frame": {"longitude_deg": ..., "latitude_deg": ...}, or give frame=LocalFrame(...)'
        )
    try:
        declared = frame if data is None else LocalFrame(**data)
    except TypeError:
        raise ValueError(
            f"local_frame has numbers longitude_deg, latitude_deg, height, x_axis_deg, and is not {data!r}"
        ) from None
    if declared is None or frame not in (None, declared):
        raise ValueError(f"the file declares {declared}, and not frame={frame}: leave frame out")
    return declared


def _plain(value: Any) -> Any:
    """Return a list that is given as one, or as a text of JSON."""
    return json.loads(value, parse_constant=_reject) if isinstance(value, str) else value


def _are_numbers(values: list[Any]) -> bool:
    # What JSON gives: no subclasses, and bool is another type.
    return {int, float}.issuperset(map(type, values)) and all(map(isfinite, values))


def _covariance(rows: Any) -> Array:
    shaped = isinstance(rows, list) and len(rows) == 6 and all(isinstance(row, list) and len(row) == 6 for row in rows)
    values = [inf if value is None else value for row in rows for value in row] if shaped else [None]
    if not {int, float}.issuperset(map(type, values)):
        raise ValueError("its covariance has six rows of six numbers, or null for infinite variances")
    return np.array(values, dtype=float).reshape(6, 6)


def _relations(data: Any) -> tuple[Relation, ...]:
    try:
        relations = tuple(Relation(**relation) for relation in data)
    except TypeError:
        relations = None
    if relations is None or not all(
        isinstance(text, str) for relation in relations for text in (relation.kind, relation.other)
    ):
        raise ValueError('its relations are a list of {"kind": ..., "other": ...}')
    return relations


def _text(properties: Mapping[str, Any], name: str, default: str) -> str:
    value = properties.get(name, default)
    if not isinstance(value, str):
        raise ValueError(f"its property {name} is a text, not {value!r}")
    return value


def _count(properties: Mapping[str, Any], name: str) -> int:
    value = properties.get(name, 0)
    if not _are_numbers([value]) or value != int(value):
        raise ValueError(f"its property {name} is a whole number, not {value!r}")
    return int(value)
