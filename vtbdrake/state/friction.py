"""Contact friction: kept by SceneGraph, addressed by body, or by geometry where that is fixed to the world."""

from __future__ import annotations

from collections.abc import Iterator
from math import inf

import numpy as np
from pydrake.geometry import GeometryId, ProximityProperties, RoleAssign, SceneGraph, SceneGraphInspector
from pydrake.multibody.plant import CoulombFriction, MultibodyPlant
from pydrake.systems.framework import Context

from vtbdrake.state.multibody import Prefix, bodies, element_address
from vtbdrake.state.variable import A, Variable, VariableError

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
            yield from _friction(address, plant, scene_graph, [geometry])
    for body in bodies(plant):
        geometries = [g for g in plant.GetCollisionGeometriesForBody(body) if with_friction(g)]
        if geometries:
            yield from _friction(element_address(plant, body, prefix), plant, scene_graph, geometries)


def _friction(
    address: str, plant: MultibodyPlant, scene_graph: SceneGraph, geometries: list[GeometryId]
) -> Iterator[Variable]:
    """``friction``, one coefficient for all, and what carries it: static and dynamic ones of each geometry.

    What is read of ``friction`` is the first geometry's dynamic one: Drake's discrete and convex contact models use
    the dynamic coefficients only.
    """
    by_geometry = f"{address}.friction_by_geometry"

    def inspect(root: Context) -> SceneGraphInspector:
        context = scene_graph.GetMyContextFromRoot(root)
        return scene_graph.get_query_output_port().Eval(context).inspector()

    def read(root: Context) -> np.ndarray:
        inspector = inspect(root)
        frictions = [inspector.GetProximityProperties(geometry).GetProperty(*_FRICTION) for geometry in geometries]
        return np.array([[friction.static_friction(), friction.dynamic_friction()] for friction in frictions])

    def write(root: Context, value: np.ndarray) -> None:
        if (value[:, 0] < value[:, 1]).any():
            raise VariableError(f"{by_geometry} is [static, dynamic] of each geometry, the dynamic one not larger")
        inspector = inspect(root)
        changed = [ProximityProperties(inspector.GetProximityProperties(geometry)) for geometry in geometries]
        context = scene_graph.GetMyMutableContextFromRoot(root)
        for geometry, properties, coefficients in zip(geometries, changed, value, strict=True):
            properties.UpdateProperty(*_FRICTION, CoulombFriction(*coefficients))
            scene_graph.AssignRole(context, plant.get_source_id(), geometry, properties, RoleAssign.kReplace)

    def write_all(root: Context, value: np.ndarray) -> None:
        write(root, np.full((len(geometries), 2), float(value)))

    first = f"{address}.friction"
    yield Variable(
        first, A, (), "1", lambda root: read(root)[0, 1], write_all, bounds=(0.0, inf), carried_by=by_geometry
    )
    yield Variable(by_geometry, A, (len(geometries), 2), "1", read, write, bounds=(0.0, inf), carried_by=by_geometry)
