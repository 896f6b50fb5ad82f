"""Tests of simulated worlds that are built from a world model, asked by Drake's own distance queries."""

import numpy as np
import pytest
from pydrake.geometry import Role, Sphere
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, MultibodyPlant
from pydrake.systems.framework import DiagramBuilder

from vtbdrake.components.perception.estimate import PoseEstimate
from vtbdrake.components.world_model import (
    AttributeValue,
    Part,
    WorldModel,
    WorldObject,
    add_to_plant,
    position_estimate,
)
from vtbdrake.components.world_model.geometry import tree_parts


def metres(**values: float) -> dict[str, AttributeValue]:
    return {name: AttributeValue(value, "m") for name, value in values.items()}


def tree(identity: str, xyz: list[float], **fields: object) -> WorldObject:
    return WorldObject(
        identity, "tree", position_estimate(xyz), attributes=metres(trunk_diameter=0.4, height=20.0), **fields
    )


ROCK = WorldObject(
    "rock",
    "rock",
    PoseEstimate.of(RigidTransform(RollPitchYaw(0.0, 0.0, np.pi / 2), [8.0, 0.0, 0.0]), np.zeros((6, 6)), time=0.0),
    attributes=metres(length=3.0, width=1.0, height=1.0),
)


def distances(model: WorldModel, point: list[float], **options: object) -> dict[str, float]:
    """The signed distance of a point from each solid part."""
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 0.001)
    add_to_plant(plant, model, **options)
    plant.Finalize()
    diagram = builder.Build()
    context = scene_graph.GetMyContextFromRoot(diagram.CreateDefaultContext())
    query = scene_graph.get_query_output_port().Eval(context)
    inspector = query.inspector()
    found = query.ComputeSignedDistanceToPoint(np.array(point))
    return {inspector.GetName(d.id_G).split("::")[-1]: d.distance for d in found}


def test_solid_parts_stand_where_the_model_says() -> None:
    found = distances(WorldModel([tree("a", [0.0, 0.0, 2.0]), tree("b", [3.0, 4.0, 2.0]), ROCK]), [0.0, 0.0, 3.0])
    assert found["a/trunk"] == pytest.approx(-0.2)
    assert found["b/trunk"] == pytest.approx(5.0 - 0.2)
    assert set(found) == {"a/trunk", "b/trunk", "rock/rock"}
    # Turned by a quarter, the long axis of the rock lies along y.
    assert distances(WorldModel([ROCK]), [8.0, 2.0, 0.0])["rock/rock"] == pytest.approx(0.5, abs=1e-5)
    assert distances(WorldModel([ROCK]), [6.0, 0.0, 0.0])["rock/rock"] == pytest.approx(1.5, abs=1e-5)


def test_parts_turn_with_their_object() -> None:
    fallen = PoseEstimate.of(RigidTransform(RollPitchYaw(-np.pi / 2, 0.0, 0.0), [1.0, 0.0, 0.2]), np.eye(6), time=0.0)
    lying = WorldObject("a", "tree", fallen, attributes=metres(trunk_diameter=0.4, height=20.0))
    # The trunk of 14.5 m lies along y.
    assert distances(WorldModel([lying]), [1.0, 10.0, 1.0])["a/trunk"] == pytest.approx(0.6)
    assert distances(WorldModel([lying]), [1.0, 15.0, 0.2])["a/trunk"] == pytest.approx(0.5)


def test_crown_is_seen_and_not_felt() -> None:
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 0.001)
    assert add_to_plant(plant, WorldModel([tree("a", [1.0, 2.0, 0.0])])) == 2
    inspector = scene_graph.model_inspector()
    roles = {
        inspector.GetName(geometry).split("::")[-1]
        for geometry in inspector.GetAllGeometryIds()
        if inspector.GetPerceptionProperties(geometry) is not None
    }
    assert roles == {"a/trunk", "a/crown"}
    assert inspector.NumGeometriesWithRole(Role.kProximity) == 1


@pytest.mark.parametrize(
    ("fields", "base", "width"), [({"crown_base": 5.0, "crown_diameter": 6.0}, 5.0, 6.0), ({}, None, None)]
)
def test_crown_reaches_from_its_base_to_the_height_of_the_tree(
    fields: dict[str, float], base: float | None, width: float | None
) -> None:
    values = metres(trunk_diameter=0.4, height=20.0, **fields)
    trunk, crown = tree_parts(WorldObject("a", "tree", position_estimate([0.0, 0.0, 0.0]), attributes=values))
    middle = crown.X_OS.translation()
    assert middle[:2].tolist() == [0.0, 0.0] and crown.shape.a() == crown.shape.b()
    assert middle[2] + crown.shape.c() == pytest.approx(20.0)
    if base is not None and width is not None:
        assert middle[2] - crown.shape.c() == pytest.approx(base)
        assert 2.0 * crown.shape.a() == pytest.approx(width)
    # The trunk stands on the ground, and ends in the middle of the crown.
    assert trunk.shape.radius() == pytest.approx(0.2)
    assert trunk.X_OS.translation().tolist() == pytest.approx([0.0, 0.0, 0.5 * trunk.shape.length()])
    assert trunk.shape.length() == pytest.approx(middle[2])


def test_only_what_is_believed_is_built() -> None:
    model = WorldModel([tree("a", [0, 0, 0]), tree("b", [1, 0, 0], status="retired"), tree("c", [2, 0, 0])])
    model = model.with_objects(tree("c", [2, 0, 0], status="tentative"))
    assert set(distances(model, [0.0, 0.0, 0.0])) == {"a/trunk"}


def test_other_classes_bring_their_parts() -> None:
    post = WorldObject("p", "post", position_estimate([1.0, 0.0, 0.0]))
    parts = {"post": lambda one: [Part("ball", Sphere(0.25), RigidTransform([0.0, 0.0, 1.0]), (1, 0, 0, 1))]}
    assert distances(WorldModel([post]), [1.0, 0.0, 3.0], parts=parts) == {"p/ball": pytest.approx(1.75)}


@pytest.mark.parametrize(
    ("one", "message"),
    [
        (WorldObject("x", "crater rim", position_estimate([0, 0, 0])), "class crater rim of x .*add it"),
        (WorldObject("x", "tree", position_estimate([0, 0, 0])), "tree x has no attribute trunk_diameter"),
    ],
)
def test_what_cannot_be_built_is_named(one: WorldObject, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        add_to_plant(MultibodyPlant(0.001), WorldModel([one]))
