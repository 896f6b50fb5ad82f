"""A simulated world from a world model: the geometry of trees, rocks and other objects on the world body of a plant."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from pydrake.math import RigidTransform

from vtbdrake.components.world_model.objects import WorldObject
from vtbdrake.components.world_model.world_model import WorldModel

if TYPE_CHECKING:
    from pydrake.geometry import ProximityProperties, Shape
    from pydrake.multibody.plant import MultibodyPlant

# Height at which a crown without its own attributes begins, as a share of the tree's height; assumed.
_CROWN_BASE = 0.45
# Diameter of a crown without its own attributes, as a share of the tree's height; assumed.
_CROWN_DIAMETER = 0.2

_BARK = (0.36, 0.27, 0.2, 1.0)
_LEAVES = (0.2, 0.42, 0.2, 1.0)
_STONE = (0.45, 0.43, 0.4, 1.0)
_FOIL = (0.7, 0.6, 0.3, 1.0)


@dataclass(frozen=True)
class Part:
    """One shape of an object O.

    Attributes:
        name: A name that no other part of the object has.
        shape: Any shape of Drake.
        X_OS: The pose of the shape in O.
        color: Red, green, blue and opacity, from 0 to 1.
        solid: Whether it also collides; False for leaves.
        friction: Its coefficient of friction, static and dynamic; None for the default of the SceneGraph.
    """

    name: str
    shape: Shape
    X_OS: RigidTransform
    color: tuple[float, float, float, float]
    solid: bool = True
    friction: float | None = None


def tree_parts(tree: WorldObject) -> Sequence[Part]:
    """Return trunk and crown of a tree, whose origin is on the ground in the middle of the trunk, with z up.

    Attributes: ``trunk_diameter`` and ``height`` (m), and if they are known ``crown_base`` (the height of its lowest
    leaves) and ``crown_diameter`` (m). The trunk is a cylinder; the crown is an ellipsoid, seen but not felt.
    """
    from pydrake.geometry import Cylinder, Ellipsoid

    diameter, height = tree.number("trunk_diameter", unit="m"), tree.number("height", unit="m")
    base = tree.number("crown_base", unit="m") if "crown_base" in tree.attributes else _CROWN_BASE * height
    width = tree.number("crown_diameter", unit="m") if "crown_diameter" in tree.attributes else _CROWN_DIAMETER * height
    if not 0.0 < base < height:
        raise ValueError(f"the crown of {tree.identity} begins below its height of {height} m, not at {base} m")
    # The trunk ends inside the crown.
    trunk, half = 0.5 * (base + height), 0.5 * (height - base)
    return (
        Part("trunk", Cylinder(0.5 * diameter, trunk), RigidTransform([0.0, 0.0, 0.5 * trunk]), _BARK),
        Part(
            "crown", Ellipsoid(0.5 * width, 0.5 * width, half), RigidTransform([0.0, 0.0, base + half]), _LEAVES, False
        ),
    )


def rock_parts(rock: WorldObject) -> Sequence[Part]:
    """Return the ellipsoid of a rock with the attributes ``length``, ``width`` and ``height`` (m) around its origin."""
    from pydrake.geometry import Ellipsoid

    a, b, c = (0.5 * rock.number(name, unit="m") for name in ("length", "width", "height"))
    return (Part("rock", Ellipsoid(a, b, c), RigidTransform(), _STONE),)


def satellite_parts(satellite: WorldObject) -> Sequence[Part]:
    """Return the box of a satellite with the attributes ``length``, ``width`` and ``height`` (m) around its origin."""
    from pydrake.geometry import Box

    size = (satellite.number(name, unit="m") for name in ("length", "width", "height"))
    return (Part("body", Box(*size), RigidTransform(), _FOIL),)


PartsOf = Callable[[WorldObject], Sequence[Part]]

# The parts of an object by its class.
PARTS: Mapping[str, PartsOf] = {"tree": tree_parts, "rock": rock_parts, "satellite": satellite_parts}


def add_to_plant(plant: MultibodyPlant, model: WorldModel, *, parts: Mapping[str, PartsOf] = PARTS) -> int:
    """Register the geometry of all objects that are believed to be there on the world body of a plant.

    Cameras, laser scanners and Meshcat see it, robots collide with its solid parts; it never moves. Each object stands
    where the model estimates it: a belief becomes a simulated world. Geometry is named ``<identity>/<part>``.

    Args:
        plant: A plant that is registered with a SceneGraph, and not finalized.
        model: The objects; tentative and retired ones are left out.
        parts: The function that returns the parts of an object, by the object's class.

    Returns:
        The number of registered parts.

    Raises:
        ValueError: There is no function for a class, or an object lacks an attribute that its function needs.
    """
    from pydrake.geometry import ProximityProperties

    placed = list(placed_parts(model, parts=parts))
    # Drake's defaults of friction: no variables of its own for each of thousands of geometries.
    world, default = plant.world_body(), ProximityProperties()
    for standing, part, X_WS in placed:
        name = f"{standing.identity}/{part.name}"
        plant.RegisterVisualGeometry(world, X_WS, part.shape, name, part.color)
        if part.solid:
            plant.RegisterCollisionGeometry(world, X_WS, part.shape, name, _material(part) or default)
    return len(placed)


def placed_parts(
    model: WorldModel, *, parts: Mapping[str, PartsOf] = PARTS
) -> Iterator[tuple[WorldObject, Part, RigidTransform]]:
    """Yield the parts of all objects that are believed to be there, with their poses in the world.

    Args:
        model: The objects; tentative and retired ones are left out.
        parts: The function that returns the parts of an object, by the object's class.

    Raises:
        ValueError: There is no function for a class, or an object lacks an attribute that its function needs.
    """
    for standing in model:
        if standing.is_known:
            if standing.kind not in parts:
                has = ", ".join(parts)
                raise ValueError(
                    f"no parts are known of the class {standing.kind} of {standing.identity} (known: {has}): add it"
                )
            for part in parts[standing.kind](standing):
                yield standing, part, standing.X_WO @ part.X_OS


def _material(part: Part) -> ProximityProperties | None:
    """Return the properties of a part with a friction of its own."""
    if part.friction is None:
        return None
    from pydrake.geometry import AddContactMaterial, ProximityProperties
    from pydrake.multibody.plant import CoulombFriction

    properties = ProximityProperties()
    AddContactMaterial(properties=properties, friction=CoulombFriction(part.friction, part.friction))
    return properties
