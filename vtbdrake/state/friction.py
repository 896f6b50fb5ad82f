"""Contact friction: kept by SceneGraph, addressed by body, or by geometry where that is fixed to the world."""

from __future__ import annotations

from collections.abc import Iterator
from math import inf

import numpy as np
from pydrake.geometry import GeometryId, ProximityProperties, RoleAssign, SceneGraph, SceneGraphInspector
from pydrake.multibody.plant import CoulombFriction, MultibodyPlant
from pydrake.systems.framework import Context

from vtbdrake.state.multibody import Prefix, bodies, element_address
from vtbdrake.state.variable import A, Variable

_FRICTION = ("material", "coulomb_friction")


def friction_variables(plant: MultibodyPlant, scene_graph: SceneGraph, *, prefix: Prefix) -> Iterator[Variable]:
    """One coefficient of friction for every body with collision geometry, and for every geometry of the world."""
    inspector = scene_graph.model_inspector()

    def with_friction(geometry: GeometryId) -> bool:
        properties = inspector.GetProximityProperties(geometry)
        return properties is not None and properties.HasProperty(*_FRICTION)

    world = plant.world_body()
    world_prefix = prefix(plant.GetModelInstanceName(world.model_instance()))
    for geometry in plant.GetCollisionGeometriesForBody(world):
        if with_friction(geometry):
            name = inspector.GetName(geometry).replace("::", ".")
            address = f"{world_prefix}.{name}" if world_prefix else name
            yield _friction(address, plant, scene_graph, [geometry])
    for body in bodies(plant):
        geometries = [g for g in plant.GetCollisionGeometriesForBody(body) if with_friction(g)]
        if geometries:
            yield _friction(element_address(plant, body, prefix), plant, scene_graph, geometries)


def _friction(address: str, plant: MultibodyPlant, scene_graph: SceneGraph, geometries: list[GeometryId]) -> Variable:
    """Static and dynamic coefficient alike; what is read is the dynamic one, which Drake's discrete and convex
    contact models use."""

    def inspect(root: Context) -> SceneGraphInspector:
        context = scene_graph.GetMyContextFromRoot(root)
        return scene_graph.get_query_output_port().Eval(context).inspector()

    def read(root: Context) -> float:
        properties = inspect(root).GetProximityProperties(geometries[0])
        return float(properties.GetProperty(*_FRICTION).dynamic_friction())

    def write(root: Context, value: np.ndarray) -> None:
        inspector = inspect(root)
        context = scene_graph.GetMyMutableContextFromRoot(root)
        for geometry in geometries:
            properties = ProximityProperties(inspector.GetProximityProperties(geometry))
            properties.UpdateProperty(*_FRICTION, CoulombFriction(float(value), float(value)))
            scene_graph.AssignRole(context, plant.get_source_id(), geometry, properties, RoleAssign.kReplace)

    return Variable(f"{address}.friction", A, (), "1", read, write, bounds=(0.0, inf), hidden=True)
