"""The trees that a harvester fells next: within reach of its crane, ahead of it on the advised route."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from vtbdrake.common.arrays import Array
from vtbdrake.components.world_model import WorldModel, WorldObject
from vtbdrake_diagrams.forest.world.routes import Route

REACH = 10.0
"""The reach of the crane from the road in m, as of usual harvesters."""
MARK = "fell"
"""The attribute of the trees that a forester has marked on the map: 1 for those to be felled, without a unit."""
THINNED = 0.3
"""The share of the trees, the thinnest, that are felled where the map marks none: thinning from below [assumed]."""


def marked_trees(world_map: WorldModel) -> list[WorldObject]:
    """Return the trees to be felled: those with the attribute `MARK`, or the thinnest if the map marks none."""
    trees = [tree for tree in world_map.find("tree") if tree.is_known]
    marked = [tree for tree in trees if MARK in tree.attributes]
    if marked:
        return [tree for tree in marked if tree.number(MARK, unit="1") > 0.0]
    diameters = [tree.number("trunk_diameter", unit="m") for tree in trees]
    limit = float(np.quantile(diameters, THINNED)) if trees else 0.0
    return [tree for tree, diameter in zip(trees, diameters, strict=True) if diameter <= limit]


def next_places(places: Array, route: Route, position: ArrayLike, *, count: int = 5) -> Array:
    """Return the places of the trees that are felled next, in the order in which the route passes them, (k, 2).

    Args:
        places: The places of the trees that are to be felled, in W in m, shape (n, 2).
        route: The advised route.
        position: The position of the harvester in W in m, shape (2,).
        count: The largest number k of trees.
    """
    near = places[route.distances(places) <= REACH] if len(places) else places
    here = route.nearest(position)
    ahead = np.array([(route.nearest(place) - here) % route.length for place in near])
    # What lies behind comes in the next lap.
    order = np.argsort(ahead, kind="stable")[:count]
    return near[order].reshape(-1, 2)
