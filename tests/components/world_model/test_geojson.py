"""Tests of the local frame against geodesy, of files against RFC 7946 and geopandas, and of what is refused."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw

from vtbdrake.components.perception.estimate import PoseEstimate
from vtbdrake.components.world_model import (
    AttributeValue,
    GeoJsonError,
    LocalFrame,
    Relation,
    WorldModel,
    WorldObject,
    load_geojson,
    position_estimate,
    save_geojson,
)

pytestmark = pytest.mark.one_python

# Near Evo, Finland.
FRAME = LocalFrame(longitude_deg=25.05, latitude_deg=61.2, height=140.0, x_axis_deg=30.0)
EQUATOR, FLATTENING = 6378137.0, 1.0 / 298.257223563


def model() -> WorldModel:
    rng = np.random.default_rng(0)
    root = rng.normal(size=(6, 6))
    X = RigidTransform(RollPitchYaw(0.3, -0.2, 2.0), [120.0, -35.0, 1.5])
    attributes = {"trunk_diameter": AttributeValue(0.31, "m", 0.02), "species": AttributeValue("Picea abies")}
    rock = WorldObject("rock-1", "rock", PoseEstimate.of(X, root @ root.T, time=5.5), source="survey")
    tree = WorldObject(
        "tree-1",
        "tree",
        position_estimate([10.0, 20.0, -0.5], deviation=[0.35, 0.35, np.inf], time=3.0),
        attributes=attributes,
        relations=(Relation("next_to", "rock-1"),),
        status="revised",
        hits=4,
        misses=1,
        conflicts=2,
    )
    return WorldModel([rock, tree])


def assert_same(first: WorldModel, second: WorldModel) -> None:
    for one, other in zip(first, second, strict=True):
        assert np.allclose(one.pose.matrix, other.pose.matrix, atol=1e-7)
        assert np.array_equal(one.pose.covariance, other.pose.covariance)
        assert one.pose.time == other.pose.time
        for name in ("identity", "kind", "attributes", "relations", "source", "status", "hits", "misses", "conflicts"):
            assert getattr(one, name) == getattr(other, name)


def test_small_steps_follow_the_curvature_of_the_ellipsoid() -> None:
    latitude, e2 = np.radians(60.0), FLATTENING * (2.0 - FLATTENING)
    normal = EQUATOR / np.sqrt(1.0 - e2 * np.sin(latitude) ** 2)
    meridian = normal**3 * (1.0 - e2) / EQUATOR**2
    places = LocalFrame(10.0, 60.0).to_geographic([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    assert places[0, 0] - 10.0 == pytest.approx(np.degrees(1.0 / (normal * np.cos(latitude))), rel=1e-6)
    assert places[1, 1] - 60.0 == pytest.approx(np.degrees(1.0 / meridian), rel=1e-6)
    assert np.allclose(places[2], [10.0, 60.0, 1.0], atol=1e-9)
    (turned,) = LocalFrame(10.0, 60.0, x_axis_deg=90.0).to_geographic([[1.0, 0.0, 0.0]])
    assert np.allclose(turned, places[1], atol=1e-12)


def test_far_points_lie_on_the_ellipsoid() -> None:
    polar = EQUATOR * (1.0 - FLATTENING)
    points = LocalFrame(0.0, 0.0).from_geographic([[90.0, 0.0, 0.0], [0.0, 90.0, 0.0], [180.0, 0.0, 7.0]])
    expected = [[EQUATOR, 0.0, -EQUATOR], [0.0, polar, -EQUATOR], [0.0, 0.0, -2.0 * EQUATOR - 7.0]]
    assert np.allclose(points, expected, atol=1e-6)


def test_conversion_back_is_exact_to_a_micrometre() -> None:
    points = np.random.default_rng(1).uniform(-20e3, 20e3, (200, 3))
    assert np.allclose(FRAME.from_geographic(FRAME.to_geographic(points)), points, rtol=0.0, atol=1e-6)


def test_local_frame_agrees_with_proj() -> None:
    pyproj = pytest.importorskip("pyproj")
    step = f"lon_0={FRAME.longitude_deg} +lat_0={FRAME.latitude_deg} +h_0={FRAME.height} +ellps=WGS84"
    pipeline = pyproj.Transformer.from_pipeline(
        f"+proj=pipeline +step +inv +proj=topocentric +{step} +step +inv +proj=cart +ellps=WGS84 "
        "+step +proj=unitconvert +xy_in=rad +xy_out=deg"
    )
    points = np.random.default_rng(2).uniform(-5e3, 5e3, (50, 3))
    turn = np.radians(FRAME.x_axis_deg)
    east = np.cos(turn) * points[:, 0] - np.sin(turn) * points[:, 1]
    north = np.sin(turn) * points[:, 0] + np.cos(turn) * points[:, 1]
    expected = np.column_stack(pipeline.transform(east, north, points[:, 2]))
    assert np.allclose(FRAME.to_geographic(points)[:, :2], expected[:, :2], rtol=0.0, atol=1e-11)
    assert np.allclose(FRAME.to_geographic(points)[:, 2], expected[:, 2], rtol=0.0, atol=1e-6)


def test_file_gives_the_same_model(tmp_path: Path) -> None:
    path = tmp_path / "map.geojson"
    save_geojson(model(), path, frame=FRAME)
    assert_same(load_geojson(path), model())
    assert_same(load_geojson(path, frame=FRAME), model())
    path.write_text(path.read_text("utf-8"), "utf-8-sig")  # with a byte order mark, as some programs write it
    assert_same(load_geojson(path), model())


def test_places_are_converted_all_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, convert, calls = tmp_path / "map.geojson", LocalFrame.from_geographic, []

    def counted(frame: LocalFrame, points: np.ndarray) -> np.ndarray:
        calls.append(np.shape(points))
        return convert(frame, points)

    monkeypatch.setattr(LocalFrame, "from_geographic", counted)
    points = np.random.default_rng(3).uniform(-500.0, 500.0, (40, 3))
    trees = WorldModel(WorldObject(f"t{k}", "tree", position_estimate(points[k])) for k in range(40))
    for saved in (trees, WorldModel()):
        save_geojson(saved, path, frame=FRAME)
        assert np.allclose(load_geojson(path).positions(), saved.positions(), rtol=0.0, atol=1e-6)
    assert calls == [(40, 3), (0, 3)]


def test_file_keeps_the_rules_of_rfc_7946(tmp_path: Path) -> None:
    path = tmp_path / "map.geojson"
    save_geojson(model(), path, frame=FRAME)
    data = json.loads(path.read_text(), parse_constant=lambda name: pytest.fail(f"{name} is no JSON"))
    assert data["type"] == "FeatureCollection" and "crs" not in data
    # 7.1: members of other types of GeoJSON objects are not allowed beside the own ones.
    assert not {"coordinates", "geometries", "geometry", "properties"} & set(data)
    for feature in data["features"]:
        assert feature["type"] == "Feature" and isinstance(feature["id"], str)
        assert not {"coordinates", "geometries", "features"} & set(feature)
        longitude, latitude, height = feature["geometry"]["coordinates"]
        assert feature["geometry"]["type"] == "Point"
        assert abs(longitude - 25.05) < 0.01 and abs(latitude - 61.2) < 0.01 and abs(height - 140.0) < 3.0


def test_geopandas_reads_and_writes_it(tmp_path: Path) -> None:
    geopandas = pytest.importorskip("geopandas")
    path, copy = tmp_path / "map.geojson", tmp_path / "copy.geojson"
    save_geojson(model(), path, frame=FRAME)
    table = geopandas.read_file(path)
    assert table.crs.to_epsg() in (4326, 4979)  # WGS84 without and with heights, by version
    assert table["class"].tolist() == ["rock", "tree"] and table["id"].tolist() == ["rock-1", "tree-1"]
    assert table["trunk_diameter"].tolist()[1] == 0.31
    # In the projection that is made for the place, they are as far apart as in the model.
    first, second = table.to_crs(table.estimate_utm_crs()).geometry
    assert first.distance(second) == pytest.approx(np.hypot(110.0, 55.0), rel=1e-3)
    table.to_file(copy, driver="GeoJSON", COORDINATE_PRECISION=15)
    assert_same(load_geojson(copy, frame=FRAME, units={"trunk_diameter": "m"}), model())


def test_file_of_other_programs_needs_frame_and_units(tmp_path: Path) -> None:
    path = tmp_path / "map.geojson"
    feature = {
        "type": "Feature",
        "id": 7,
        "geometry": {"type": "Point", "coordinates": [25.05, 61.2]},
        "properties": {"class": "tree", "dbh": 0.2, "height": None},
    }
    path.write_text(json.dumps({"type": "FeatureCollection", "features": [feature]}))
    (tree,) = load_geojson(path, frame=FRAME, units={"dbh": "m"})
    assert tree.identity == "7" and dict(tree.attributes) == {"dbh": AttributeValue(0.2, "m")}
    assert np.allclose(tree.p_WoOo_W, 0.0, atol=1e-6)
    (tree,) = load_geojson(path, frame=FRAME, units={"dbh": "m"}, deviation=0.3)
    assert np.diag(tree.pose.covariance).tolist() == pytest.approx([np.inf] * 3 + [0.09] * 3)
    with pytest.raises(GeoJsonError, match="give frame="):
        load_geojson(path)
    with pytest.raises(GeoJsonError, match="deviation in m, finite and at least 0, not nan"):
        load_geojson(path, frame=FRAME, deviation=np.nan)
    with pytest.raises(GeoJsonError, match=r"feature 0 \(7\): its attribute dbh has no unit"):
        load_geojson(path, frame=FRAME)


def change(path: tuple[Any, ...], value: Any) -> Callable[[dict[str, Any]], None]:
    def apply(data: Any) -> None:
        *way, last = path
        for step in way:
            data = data[step]
        data[last] = value

    return apply


TREE = ("features", 1)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (
            change((*TREE, "geometry", "type"), "Polygon"),
            r"feature 1 \(tree-1\): its geometry is a Point, not 'Polygon'",
        ),
        (change((*TREE, "geometry"), None), "its geometry is a Point, not None"),
        (change((*TREE, "geometry", "coordinates"), [6800000.0, 450000.0]), "tree-1.*degrees of longitude"),
        (change((*TREE, "geometry", "coordinates"), [190.0, 61.2]), "tree-1.*degrees of longitude"),
        (change((*TREE, "geometry", "coordinates"), [25.05, -95.0]), "tree-1.*degrees of longitude"),
        (change((*TREE, "geometry", "coordinates"), [27.5, 61.2]), "tree-1.*it lies 11. km from the origin"),
        (change((*TREE, "geometry", "coordinates"), [25.05, 62.4]), "tree-1.*it lies 11. km from the origin"),
        (change((*TREE, "geometry", "coordinates"), [61.2, 25.05]), "tree-1.*frame, at 25.05, 61.2: .*in this order"),
        (change((*TREE, "geometry", "coordinates"), [25.0, None]), "tree-1.*coordinates are longitude"),
        (change((*TREE, "geometry", "coordinates"), [25.0, float("nan")]), "NaN is not a number of JSON"),
        (change(("units", "trunk_diameter"), "cm"), "tree-1.*trunk_diameter: a unit is made of SI units.*'cm'"),
        (change(("units",), {}), "tree-1.*trunk_diameter has no unit"),
        (change((*TREE, "id"), "rock-1"), r"feature 1 \(rock-1\): another feature has this id"),
        (change((*TREE, "id"), True), "feature 1.*its id is a text"),
        (change((*TREE, "properties", "class"), 3), "tree-1.*class is a text"),
        (change((*TREE, "properties"), None), "tree-1.*properties are an object"),
        (change((*TREE, "properties", "trunk_diameter"), [1]), r"tree-1.*a number or a text, not \[1\]"),
        (change((*TREE, "properties", "trunk_diameter"), 10**400), "tree-1.*too large"),
        (change((*TREE, "properties", "age_deviation"), 1.0), "tree-1.*deviation of an attribute"),
        (change((*TREE, "properties", "trunk_diameter_deviation"), -1.0), "tree-1.*at least 0, not -1"),
        (change((*TREE, "properties", "Species"), "oak"), "tree-1.*identifier in lower case"),
        (change((*TREE, "properties", "covariance"), [[1.0]]), "tree-1.*six rows"),
        (change((*TREE, "properties", "orientation"), [1, 1, 0, 0]), "tree-1.*unit quaternion"),
        (change((*TREE, "properties", "status"), "gone"), "status of tree-1 is one of"),
        (change((*TREE, "properties", "hits"), 1.5), "tree-1.*hits is a whole number"),
        (change((*TREE, "properties", "relations"), [{"to": "rock-1"}]), "tree-1.*relations are a list"),
        (change((*TREE, "properties", "relations"), [{"kind": "on", "other": "x"}]), "tree-1 on 'x'"),
        (change(("local_frame",), {"lon": 1}), "local_frame has numbers"),
        (change(("local_frame", "latitude_deg"), 95.0), "latitude between -90 and 90"),
        (change(("local_frame", "latitude_deg"), "61.2"), "local_frame has numbers .*'61.2'"),
        (change(("local_frame",), None), "local_frame, which other programs drop, is missing: add"),
        (change(("crs",), {"type": "name", "properties": {"name": "EPSG:3067"}}), "convert them, and remove crs"),
        (change(("type",), "Feature"), "FeatureCollection"),
        (change(("features",), {}), "list of features"),
    ],
)
def test_wrong_files_are_refused(damage: Callable[[Any], None], message: str, tmp_path: Path) -> None:
    path = tmp_path / "map.geojson"
    save_geojson(model(), path, frame=FRAME)
    data = json.loads(path.read_text())
    damage(data)
    path.write_text(json.dumps(data))
    with pytest.raises(GeoJsonError, match=message) as error:
        load_geojson(path)
    assert "map.geojson" in str(error.value)


def test_text_that_is_no_json_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "map.geojson"
    for text in ("{", '{"type": 1, "type": 2}', "[" * 100_000, "\0"):
        path.write_text(text)
        with pytest.raises(GeoJsonError, match="map.geojson"):
            load_geojson(path)
    for text in ("id,x,y", "\xe4"):
        path.write_text(text, encoding="latin-1")
        with pytest.raises(GeoJsonError, match="map.geojson: no JSON in UTF-8, convert"):
            load_geojson(path)
    with pytest.raises(FileNotFoundError):
        load_geojson(tmp_path / "none.geojson")


def test_other_frame_than_the_declared_one_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "map.geojson"
    save_geojson(model(), path, frame=FRAME)
    with pytest.raises(GeoJsonError, match="leave frame out"):
        load_geojson(path, frame=LocalFrame(25.0, 61.0))


def test_file_remains_if_saving_fails(tmp_path: Path) -> None:
    path = tmp_path / "map.geojson"
    save_geojson(model(), path, frame=FRAME)
    before = path.read_text()
    place = position_estimate([0.0, 0.0, 0.0])
    named = WorldObject("t", "tree", place, attributes={"hits": AttributeValue(1.0)})
    with pytest.raises(ValueError, match="hits of t has the name of another property"):
        save_geojson(WorldModel([named]), path, frame=FRAME)
    mixed = [WorldObject(u, "tree", place, attributes={"age": AttributeValue(1.0, u)}) for u in ("s", "m")]
    with pytest.raises(ValueError, match="age of m is in m, of others in s"):
        save_geojson(WorldModel(mixed), path, frame=FRAME)
    assert path.read_text() == before and list(tmp_path.iterdir()) == [path]
