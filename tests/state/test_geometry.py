"""Geometry that is changed in a Context: a snapshot that would lose it is refused, and friction is none of it."""

import pytest
from pydrake.geometry import (
    AddContactMaterial,
    CollisionFilterDeclaration,
    GeometrySet,
    IllustrationProperties,
    ProximityProperties,
    Rgba,
    Role,
    RoleAssign,
    Sphere,
)
from pydrake.multibody.plant import CoulombFriction

from tests.testbeds import AcrobotScenario
from vtbdrake.state import SnapshotError
from vtbdrake.state.geometry import GeometryWatch


class World:
    """A testbed of the acrobot, with its parts that a test changes."""

    def __init__(self):
        self.testbed = AcrobotScenario(time_step=0.005).build()
        self.plant = self.testbed.plant
        self.scene_graph = self.testbed.diagram.GetSubsystemByName("scene_graph")
        self.context = self.testbed.default_context()
        self.source = self.plant.get_source_id()
        inspector = self.scene_graph.model_inspector()
        self.geometries = sorted(inspector.GetAllGeometryIds(Role.kProximity), key=lambda each: each.get_value())
        self.friction = next(address for address in self.testbed.variables() if address.endswith(".friction"))

    @property
    def own(self):
        return self.scene_graph.GetMyMutableContextFromRoot(self.context)


def change_shape(world):
    world.scene_graph.ChangeShape(world.own, world.source, world.geometries[0], Sphere(0.4))


def change_stiffness(world):
    properties = ProximityProperties()
    AddContactMaterial(dissipation=0.0, friction=CoulombFriction(0.5, 0.5), properties=properties)
    properties.AddProperty("material", "point_contact_stiffness", 200.0)
    world.scene_graph.AssignRole(world.own, world.source, world.geometries[0], properties, RoleAssign.kReplace)


def remove_role(world):
    world.scene_graph.RemoveRole(world.own, world.source, world.geometries[0], Role.kProximity)


def filter_collisions(world):
    pair = GeometrySet(list(next(iter(world.scene_graph.model_inspector().GetCollisionCandidates()))))
    world.scene_graph.collision_filter_manager(world.own).Apply(CollisionFilterDeclaration().ExcludeWithin(pair))


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (change_shape, r"has another shape, Sphere\(radius=0.4\)"),
        (change_stiffness, "has other proximity properties"),
        (remove_role, "1 geometries have got or lost their proximity role"),
        (filter_collisions, "collision filters have been changed"),
    ],
)
def test_snapshot_that_would_lose_a_change_is_refused(change, told):
    world = World()
    world.testbed.snapshot(world.context)
    change(world)
    for _ in range(2):
        with pytest.raises(SnapshotError, match=f"in this context .*{told}.*make it a field of the scenario"):
            world.testbed.snapshot(world.context)
    world.testbed.snapshot(world.testbed.default_context())


def test_friction_is_part_of_a_snapshot():
    world = World()
    for value in (0.25, 0.75):
        world.testbed.write(world.context, {world.friction: value})
        assert world.testbed.snapshot(world.context)[world.friction] == value
    change_shape(world)
    with pytest.raises(SnapshotError, match="another shape"):
        world.testbed.snapshot(world.context)


def test_what_is_only_seen_in_a_viewer_may_change():
    world = World()
    properties = IllustrationProperties()
    properties.AddProperty("phong", "diffuse", Rgba(1.0, 0.0, 0.0))
    world.scene_graph.AssignRole(world.own, world.source, world.geometries[0], properties, RoleAssign.kNew)
    world.testbed.snapshot(world.context)


def test_without_a_context_to_remember_a_default_one_is_made():
    world = World()
    watch = GeometryWatch(world.testbed.diagram)
    watch.check(world.context)
    change_shape(world)
    with pytest.raises(SnapshotError, match="another shape"):
        GeometryWatch(world.testbed.diagram).check(world.context)
