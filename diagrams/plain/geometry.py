"""The simulated world as geometry of a plant: a plain with rocks on uneven ground."""

from __future__ import annotations

import numpy as np
from pydrake.multibody.plant import MultibodyPlant

from vtbdrake.components.world_model import WorldModel
from vtbdrake_diagrams.forest.world.geometry import add_ground, add_surface
from vtbdrake_diagrams.forest.world.ground import Ground
from vtbdrake_diagrams.plain.rocks import RockField, rock_surface

# Red, green, blue and opacity, from 0 to 1.
_SAND = np.array([0.6, 0.42, 0.28, 1.0])
_STONE = np.array([0.42, 0.32, 0.26, 1.0])


def add_plain(plant: MultibodyPlant, rock_field: RockField, ground: Ground) -> None:
    """Register rocks on their ground on the world body of a plant, like `add_forest`; nothing collides with them.

    Args:
        plant: A plant that is registered with a SceneGraph, and not finalized.
        rock_field: The rocks.
        ground: The ground.
    """
    add_ground(plant, ground, length=rock_field.length, width=rock_field.width, color=_SAND)
    add_rocks(plant, rock_field.rocks(), ground)


def add_rocks(plant: MultibodyPlant, rocks: WorldModel, ground: Ground) -> None:
    """Register rocks on their ground, like `add_plain`.

    Args:
        plant: A plant that is registered with a SceneGraph, and not finalized.
        rocks: The rocks, with the attributes of `RockField.rocks`.
        ground: The ground.
    """
    if len(rocks):
        add_surface(plant, "rocks", rock_surface(rocks, ground), _STONE)
