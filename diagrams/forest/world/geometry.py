"""The simulated world as geometry of a plant: a forest on uneven ground."""

from __future__ import annotations

import numpy as np
from pydrake.geometry import (
    GeometryInstance,
    IllustrationProperties,
    Mesh,
    PerceptionProperties,
    RenderLabel,
)
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant

from vtbdrake.common.arrays import Array
from vtbdrake.components.meshes import Surface, surface_mesh
from vtbdrake.components.textures import grain, tiled_mesh
from vtbdrake_diagrams.forest.world.ground import Ground
from vtbdrake_diagrams.forest.world.stand import Stand
from vtbdrake_diagrams.forest.world.vegetation import Vegetation, branches, crowns, trunks, undergrowth

# The ground goes on around a stand by this distance, in m.
_MARGIN = 15.0

# Extents of the grained image of bark, which is stretched upwards, in m.
_BARK_TILE = (2.0, 40.0)
# Extents of all other grained images, in m.
_TILE = (5.0, 5.0)

_SOIL = np.array([0.35, 0.3, 0.2, 1.0])
_BARK = np.array([0.36, 0.27, 0.2, 1.0])
_NEEDLES = np.array([0.15, 0.32, 0.17, 1.0])
_DEAD = np.array([0.4, 0.37, 0.33, 1.0])
_LEAVES = np.array([0.3, 0.5, 0.2, 1.0])


def add_surface(
    plant: MultibodyPlant, name: str, surface: Surface, color: Array, *, tile: tuple[float, float] | None = None
) -> None:
    """Register a surface in W on the world body, for scanners, cameras and Meshcat; nothing collides with it.

    Args:
        plant: A plant that is registered with a SceneGraph, and not finalized.
        name: The name of the geometry.
        surface: Vertices and triangles; one without triangles is left out.
        color: Red, green, blue and opacity, from 0 to 1, shape (4,).
        tile: The extent in m, across and upwards, of an image with grain that covers the surface, see `tiled_mesh`;
            None for a plain surface.
    """
    if not len(surface[1]):
        return
    if tile is None:
        mesh = Mesh(surface_mesh(surface, name=name), 1.0)
        plant.RegisterVisualGeometry(plant.world_body(), RigidTransform(), mesh, name, color)
        return
    geometry = GeometryInstance(RigidTransform(), tiled_mesh(surface, image=grain(color[:3]), tile=tile), name)
    geometry.set_illustration_properties(IllustrationProperties())
    properties = PerceptionProperties()
    properties.AddProperty("label", "id", RenderLabel(int(plant.world_body().index())))  # As a plant labels its own.
    geometry.set_perception_properties(properties)
    plant.RegisterVisualGeometry(plant.world_body(), geometry)


def add_ground(
    plant: MultibodyPlant,
    ground: Ground,
    *,
    length: float,
    width: float,
    color: Array = _SOIL,
    tile: tuple[float, float] | None = None,
) -> None:
    """Register the ground of an area from (0, 0) to (length, width) in m, and some around it, like `add_surface`."""
    lower, upper = np.full(2, -_MARGIN), np.array([length, width]) + _MARGIN
    add_surface(plant, "ground", ground.mesh(lower, upper), color, tile=tile)


def add_forest(
    plant: MultibodyPlant, stand: Stand, ground: Ground, vegetation: Vegetation, *, textured: bool = False
) -> None:
    """Register a stand on its ground, with branches and undergrowth, on the world body of a plant.

    Scanners, cameras and Meshcat show it. Nothing collides with it: the driver keeps away from trees, and the wheels
    compute the forces of the ground from its height.

    Args:
        plant: A plant that is registered with a SceneGraph, and not finalized.
        stand: The stand.
        ground: The ground.
        vegetation: The vegetation, for lean, branches and undergrowth.
        textured: Whether all surfaces are grained, as matching of stereo images needs it; rendering then takes longer.
    """
    even, upright = (_TILE, _BARK_TILE) if textured else (None, None)
    add_ground(plant, ground, length=stand.length, width=stand.width, tile=even)
    trees, routes = stand.trees(), stand.routes()
    if len(trees):
        add_surface(plant, "trunks", trunks(trees, ground, vegetation), _BARK, tile=upright)
        add_surface(plant, "crowns", crowns(trees, ground, vegetation), _NEEDLES, tile=even)
        add_surface(plant, "branches", branches(trees, ground, vegetation), _DEAD, tile=even)
    roads = np.concatenate([np.zeros((0, 2)), *(route.points for route in routes)])
    area = {"lower": np.zeros(2), "upper": np.array([stand.length, stand.width])}
    bushes = undergrowth(ground, vegetation, **area, roads=(roads, 0.5 * stand.road_width))
    add_surface(plant, "undergrowth", bushes, _LEAVES, tile=even)
