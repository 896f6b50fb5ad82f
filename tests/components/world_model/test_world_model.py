"""Tests of objects, queries, relations and the codec of world models."""

import copy
import pickle
from dataclasses import replace
from typing import ClassVar

import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.systems.framework import DiagramBuilder

from vtbdrake.components.perception.estimate import PoseEstimate
from vtbdrake.components.world_model import (
    WORLD_MODEL_CODEC,
    AttributeValue,
    Relation,
    WorldModel,
    WorldObject,
    position_estimate,
)
from vtbdrake.state import AddressedSystem
from vtbdrake.state.codecs import abstract_state


def tree(identity: str, xyz: list[float], *, diameter: float = 0.3, **fields: object) -> WorldObject:
    attributes = {"trunk_diameter": AttributeValue(diameter, "m", 0.02), "species": AttributeValue("spruce")}
    return WorldObject(identity, "tree", position_estimate(xyz, deviation=0.1), attributes=attributes, **fields)


@pytest.fixture(scope="module")
def stand() -> WorldModel:
    rng = np.random.default_rng(3)
    places = np.column_stack([rng.uniform(0.0, 100.0, (300, 2)), rng.uniform(-2.0, 2.0, 300)])
    trees = [tree(f"t{k}", list(place), diameter=rng.uniform(0.06, 0.41)) for k, place in enumerate(places)]
    rock = WorldObject("boulder", "rock", position_estimate([50.0, 50.0, 0.0]))
    return WorldModel([*trees, rock])


def test_covariance_with_a_negative_eigenvalue_is_refused() -> None:
    for entries, possible in (([[2.0, 1.0], [1.0, 2.0]], True), ([[1.0, 2.0], [2.0, 1.0]], False)):
        covariance = np.eye(6)
        covariance[3:5, 3:5] = entries
        pose = PoseEstimate.of(RigidTransform(), covariance, time=0.0)
        if possible:
            assert WorldObject("a", "tree", pose).pose.covariance[3, 4] == entries[0][1]
            continue
        with pytest.raises(ValueError, match="covariance of a.* is not positive semidefinite"):
            WorldObject("a", "tree", pose)


def test_position_of_a_single_known_axis_is_accepted() -> None:
    covariance = np.diag([np.inf] * 5 + [0.04])
    pose = PoseEstimate.of(RigidTransform([0.0, 0.0, 2.0]), covariance, time=0.0)
    assert WorldObject("a", "tree", pose).pose.covariance[5, 5] == 0.04


def test_queries_equal_a_search_of_all_objects(stand: WorldModel) -> None:
    point = np.array([40.0, 60.0])
    found = stand.find("tree", near=(point, 15.0), attributes={"trunk_diameter": (0.2, 0.3), "species": "spruce"})
    expected = [
        one.identity
        for one in stand
        if one.kind == "tree"
        and np.hypot(*(one.p_WoOo_W[:2] - point)) <= 15.0
        and 0.2 <= one.number("trunk_diameter", unit="m") <= 0.3
    ]
    assert [one.identity for one in found] == expected
    assert len(expected) > 2


def test_region_in_space_and_in_the_plane(stand: WorldModel) -> None:
    places = stand.positions()
    near = np.linalg.norm(places - [50.0, 50.0, 1.0], axis=1) <= 8.0
    assert len(stand.find(near=([50.0, 50.0, 1.0], 8.0))) == near.sum()
    inside = ((places[:, :2] >= [10.0, 20.0]) & (places[:, :2] <= [30.0, 50.0])).all(axis=1)
    assert len(stand.find(box=([10.0, 20.0], [30.0, 50.0]))) == inside.sum() > 0


SQUARE = [(0.0, 0.0), (10.0, 0.0), (10.0, 10.0), (0.0, 10.0)]
POLYGONS = {
    "concave": [[(0.0, 0.0), (10.0, 0.0), (10.0, 10.0), (7.0, 10.0), (7.0, 3.0), (3.0, 3.0), (3.0, 10.0), (0.0, 10.0)]],
    "star": [[(5.0 + r * np.cos(k * np.pi / 5), 5.0 + r * np.sin(k * np.pi / 5)) for k, r in enumerate([2, 5] * 5)]],
    "hole": [SQUARE, [(3.0, 3.0), (7.0, 3.0), (7.0, 7.0), (3.0, 7.0)]],
    "hole that touches the outline": [SQUARE, [(0.0, 5.0), (4.0, 3.0), (4.0, 7.0)]],
    "ends with its first corner": [[*SQUARE, SQUARE[0]]],
}


@pytest.mark.parametrize("rings", POLYGONS.values(), ids=POLYGONS)
def test_polygons_agree_with_shapely(rings: list[list[tuple[float, float]]]) -> None:
    shapely = pytest.importorskip("shapely")
    # Places anywhere, and on corners and edges.
    corners = [[x, y] for x in range(-1, 12) for y in range(-1, 12)]
    places = np.vstack([np.random.default_rng(5).uniform(-1.0, 11.0, (300, 2)), corners])
    model = WorldModel(
        WorldObject(str(k), "tree", position_estimate([*place, 0.0])) for k, place in enumerate(places.tolist())
    )
    area = shapely.Polygon(rings[0], rings[1:])
    expected = [str(k) for k in np.flatnonzero(shapely.distance(area, shapely.points(places)) <= 1e-9)]
    assert [one.identity for one in model.find(polygon=rings)] == expected
    assert 50 < len(expected) < len(places) - 50


def test_regions_together_and_without_objects(stand: WorldModel) -> None:
    triangle = [(0.0, 0.0), (60.0, 0.0), (0.0, 60.0)]
    both = stand.find(near=([10.0, 10.0], 20.0), box=([10.0, 0.0], [100.0, 100.0]), polygon=[triangle])
    x, y = stand.positions()[:, :2].T
    expected = (np.hypot(x - 10.0, y - 10.0) <= 20.0) & (x >= 10.0) & (x + y <= 60.0)
    assert [one.identity for one in both] == [tuple(stand)[k].identity for k in np.flatnonzero(expected)]
    for model in (WorldModel(), stand):
        assert model.find(polygon=[[(200.0, 0.0), (300.0, 0.0), (300.0, 9.0)]]) == () == model.find(polygon=[])
        assert model.find(box=([200.0, 0.0], [300.0, 9.0])) == ()


def test_nearest_objects_come_first(stand: WorldModel) -> None:
    distances = np.linalg.norm(stand.positions() - [20.0, 20.0, 0.0], axis=1)
    order = [tuple(stand)[row].identity for row in np.argsort(distances)[:5]]
    assert [one.identity for one in stand.nearest([20.0, 20.0, 0.0], 5)] == order
    assert WorldModel().nearest([0.0, 0.0, 0.0]) == () == WorldModel().find(near=([0.0, 0.0], 1.0))


def test_objects_are_told_on_one_line() -> None:
    assert repr(tree("a", [1.0, -2.0, 0.5])) == "<tree a: confirmed, at (1.00, -2.00, 0.50) m>"


def test_status_selects(stand: WorldModel) -> None:
    model = WorldModel([tree("a", [0, 0, 0]), tree("b", [1, 0, 0], status="retired")])
    assert [one.identity for one in model.find(status="retired")] == ["b"]
    assert [one.identity for one in model if one.is_known] == ["a"]


def test_changes_leave_the_model_as_it_was() -> None:
    model = WorldModel([tree("a", [0, 0, 0])])
    larger = model.with_objects(tree("b", [1, 0, 0]), tree("a", [5, 0, 0]))
    assert len(model) == 1 and model["a"].p_WoOo_W[0] == 0.0
    assert [one.p_WoOo_W[0] for one in larger] == [5.0, 1.0]
    assert copy.deepcopy(model) is model
    with pytest.raises(ValueError):
        model["a"].pose.matrix[0, 3] = 1.0
    with pytest.raises(TypeError):
        model["a"].attributes["height"] = AttributeValue(3.0, "m")


def test_relations_lead_to_objects_of_the_model() -> None:
    rock, satellite = tree("rock", [0, 0, 0]), tree("t", [0, 0, 1], relations=(Relation("leans_on", "rock"),))
    model = WorldModel([rock, satellite])
    assert model.related("t", "leans_on") == (rock,) and model.related("t", "stands_on") == ()
    assert model.without(["rock"])["t"].relations == ()
    with pytest.raises(ValueError, match="t leans_on 'rock', which is not an object"):
        WorldModel([satellite])


def test_codec_is_exact() -> None:
    rng = np.random.default_rng(1)
    root = rng.normal(size=(6, 6))
    pose = PoseEstimate.of(
        RigidTransform(RollPitchYaw(rng.normal(size=3)), rng.normal(size=3)), root @ root.T, time=0.1
    )
    model = WorldModel(
        [
            WorldObject("sat", "satellite", pose, source="käse", hits=3, misses=1, conflicts=2),
            tree("t", [0.1, 0.2, 0.3], status="tentative", relations=(Relation("near", "sat"),)),
        ],
        created=17,
    )
    arrays = WORLD_MODEL_CODEC.encode(model)
    for again in (WORLD_MODEL_CODEC.decode(arrays), pickle.loads(pickle.dumps(model))):
        assert again.created == 17
        for one, other in zip(model, again, strict=True):
            assert np.array_equal(one.pose.matrix, other.pose.matrix)
            assert np.array_equal(one.pose.covariance, other.pose.covariance)
            assert replace(one, pose=other.pose).__getstate__() == other.__getstate__()
    assert len(WORLD_MODEL_CODEC.decode(WORLD_MODEL_CODEC.encode(WorldModel()))) == 0


class Keeper(AddressedSystem):
    """A DPS's environment: a world model as abstract state."""

    codecs: ClassVar = {0: WORLD_MODEL_CODEC}

    def __init__(self) -> None:
        super().__init__()
        self.DeclareStateOutputPort("world_model", self.DeclareAbstractState(Value(WorldModel())))


def test_model_is_state_of_a_context(stand: WorldModel) -> None:
    builder = DiagramBuilder()
    keeper = builder.AddNamedSystem("keeper", Keeper())
    diagram = builder.Build()
    context, other = diagram.CreateDefaultContext(), diagram.CreateDefaultContext()
    keeper.GetMyMutableContextFromRoot(context).SetAbstractState(0, stand)
    seen = keeper.GetOutputPort("world_model").Eval(keeper.GetMyContextFromRoot(context.Clone()))
    assert seen is stand
    arrays = abstract_state("keeper", keeper, keeper.GetMyContextFromRoot(context)).read(
        keeper.GetMyContextFromRoot(context)
    )
    own = keeper.GetMyMutableContextFromRoot(other)
    abstract_state("keeper", keeper, own).writer(arrays)(own)
    restored = keeper.GetOutputPort("world_model").Eval(own)
    assert np.array_equal(restored.positions(), stand.positions())


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: WorldModel([tree("a", [0, 0, 0]), tree("a", [1, 0, 0])]), "two objects have the identity 'a'"),
        (lambda: tree("", [0, 0, 0]), "identity of an object is a text"),
        (lambda: tree("a", [0, np.nan, 0]), "finite numbers"),
        (lambda: tree("a", [0, 0, 0], status="gone"), "tentative, confirmed, revised, retired"),
        (lambda: AttributeValue(31.0, "cm"), "convert the value"),
        (lambda: AttributeValue(np.nan, "m"), "finite number or a text"),
        (lambda: AttributeValue("spruce", "m"), "has no unit"),
        (lambda: WorldObject("a", "tree", PoseEstimate.missing()), "is missing"),
        (
            lambda: WorldObject("a", "tree", PoseEstimate.of(RigidTransform(), -np.eye(6), time=0.0)),
            "variances of at least 0",
        ),
        (
            lambda: WorldObject("a", "tree", PoseEstimate.of(RigidTransform(), np.diag([np.inf, *[1] * 5]), time=0.0)),
            "all finite or all infinite",
        ),
        (lambda: tree("a", [0, 0, 0]).number("height", unit="m"), "has no attribute height"),
        (lambda: tree("a", [0, 0, 0]).number("species", unit="1"), "is not a number"),
    ],
)
def test_what_is_no_object_is_refused(make: object, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()


def test_status_and_deviation_that_cannot_be_are_refused() -> None:
    with pytest.raises(ValueError, match="a status is one of tentative, confirmed, revised, retired, not 'confirmd'"):
        WorldModel().find(status="confirmd")
    for wanted in (5.0, (2.0, 1.0), (1.0, 2.0, 3.0)):
        with pytest.raises(ValueError, match="the condition of height is a text, or the least and the largest number"):
            WorldModel().find(attributes={"height": wanted})
    for rings in (SQUARE, [SQUARE[:2]], [[(0.0, 0.0), (1.0, np.nan), (1.0, 1.0)]]):
        with pytest.raises(ValueError, match="a list of rings of at least 3 corners"):
            WorldModel().find(polygon=rings)
    with pytest.raises(ValueError, match=r"at least 0 m, not -0\.1"):
        position_estimate(np.zeros(3), deviation=-0.1)


@pytest.mark.parametrize("unit", ["m", "kg/m^3", "1", "1/s", "N*m", "rad", "m/s^2"])
def test_si_units_are_accepted(unit: str) -> None:
    assert AttributeValue(1.0, unit).unit == unit
