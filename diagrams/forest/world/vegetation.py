"""The vegetation of a forest as meshes for scanners and cameras: trunks, crowns, dead branches and undergrowth.

Everything of one kind is one mesh, because each geometry costs time. Trunks are landmarks; the rest is clutter: it
hides trunks, and is sometimes mistaken for them. All dimensions that the world model does not contain are assumed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vtbdrake.common.arrays import Array
from vtbdrake.common.settings import check_settings, setting
from vtbdrake.components.meshes import Surface, copies, unit_cone, unit_sphere
from vtbdrake.components.world_model import WorldModel
from vtbdrake_diagrams.forest.world.ground import Ground

BREAST_HEIGHT = 1.3
"""The height over the ground in m at which the diameter of a trunk is measured."""

# Number of facets of a trunk.
_FACETS = 24
# Depth of a trunk in the ground, in m.
_ROOTED = 0.5
# Height at which a crown begins, as a share of the tree's height.
_CROWN_BASE = 0.45
# Diameter of a crown, as a share of the tree's height.
_CROWN_DIAMETER = 0.2
# Range of the heights where dead branches leave the trunk, in m.
_BRANCH_HEIGHT = (0.4, 5.0)
# Range of their lengths, in m.
_BRANCH_LENGTH = (0.3, 1.3)
# Range of their radii, in m.
_BRANCH_RADIUS = (0.004, 0.012)
# Their elevation, in rad.
_BRANCH_ELEVATION = 0.35
# Number of blades of a bush.
_BLADES = 30
# Range of the radii of bushes, in m.
_BUSH_RADIUS = (0.2, 0.6)
# Range of their heights, in m.
_BUSH_HEIGHT = (0.3, 1.3)
# Range of the widths of their blades, in m.
_BLADE_WIDTH = (0.01, 0.06)

# Streams of random numbers; `stand`, `ground`, `routes` and `plain` have others.
_BRANCHES = 4
_UNDERGROWTH = 5
_LEAN = 8

# A flat, pointed leaf in the plane of x and z.
_BLADE: Surface = (np.array([(-0.5, 0.0, 0.0), (0.5, 0.0, 0.0), (0.0, 0.0, 1.0)]), np.array([(0, 1, 2)]))


@dataclass(frozen=True)
class Vegetation:
    """The lean of trunks, and the amount of clutter."""

    seed: int = setting(0, "Determines directions and places.", ge=0)
    lean: float = setting(0.01, "Standard deviation of the inclination of trunks, per axis.", unit="rad", ge=0, le=0.2)
    undergrowth: float = setting(300.0, "Bushes per hectare.", unit="1/ha", ge=0, le=5000)
    branches: float = setting(6.0, "Dead branches of a tree below its crown, on average.", ge=0, le=50)

    def __post_init__(self) -> None:
        check_settings(self)

    def leans(self, trees: WorldModel) -> Array:
        """Return the lean of each trunk in x and y, in m per m of height, (n, 2)."""
        return np.random.default_rng([self.seed, _LEAN]).normal(0.0, self.lean, (len(trees), 2))


def feet(trees: WorldModel, ground: Ground) -> Array:
    """Return the feet of the trees, (n, 3) in m: at their x and y in W, on the ground."""
    p = trees.positions()
    return np.column_stack([p[:, :2], ground.height(p[:, 0], p[:, 1])])


def trunks(trees: WorldModel, ground: Ground, vegetation: Vegetation) -> Surface:
    """Return the trunks: cones from below the ground to the top of the tree, which lean a little.

    A cone has the diameter of its tree at `BREAST_HEIGHT` over the ground, and its axis is at the place of the tree
    where it leaves the ground. Real trunks are also crooked, and wider at their feet; these are not.

    Args:
        trees: The trees, with the attributes ``trunk_diameter`` and ``height`` in m.
        ground: The ground.
        vegetation: The vegetation, for the lean of the trunks.
    """
    diameters, heights = _sizes(trees)
    length = heights + _ROOTED
    radius = 0.5 * diameters * length / (heights - BREAST_HEIGHT)
    leans = vegetation.leans(trees)
    shapes = _scaled(radius, radius, length)
    shapes[:, :2, 2] = leans * length[:, np.newaxis]
    below = _ROOTED * np.column_stack([leans, np.ones(len(trees))])
    return copies(unit_cone(_FACETS), shapes, feet(trees, ground) - below)


def crowns(trees: WorldModel, ground: Ground, vegetation: Vegetation) -> Surface:
    """Return the crowns, each a coarse ellipsoid around the upper part of its trunk."""
    _, heights = _sizes(trees)
    radius, half = 0.5 * _CROWN_DIAMETER * heights, 0.5 * (1.0 - _CROWN_BASE) * heights
    axes = np.column_stack([vegetation.leans(trees), np.ones(len(trees))])
    centres = feet(trees, ground) + (heights - half)[:, np.newaxis] * axes
    return copies(unit_sphere(1), _scaled(radius, radius, half), centres)


def branches(trees: WorldModel, ground: Ground, vegetation: Vegetation) -> Surface:
    """Return dead branches that stick out of the trunks below the crowns; straight, thin, and pointed."""
    rng = np.random.default_rng([vegetation.seed, _BRANCHES])
    of = np.repeat(np.arange(len(trees)), rng.poisson(vegetation.branches, len(trees)))
    _, heights = _sizes(trees)
    low, high = _BRANCH_HEIGHT
    axes = np.column_stack([vegetation.leans(trees), np.ones(len(trees))])
    above = rng.uniform(low, np.minimum(high, _CROWN_BASE * heights[of]))
    start = feet(trees, ground)[of] + above[:, np.newaxis] * axes[of]
    directions = _directions(
        rng.uniform(0.0, 2.0 * np.pi, len(of)), _BRANCH_ELEVATION * rng.uniform(-1.0, 1.0, len(of))
    )
    length, radius = _between(rng, _BRANCH_LENGTH, len(of)), _between(rng, _BRANCH_RADIUS, len(of))
    return copies(unit_cone(3), _along(directions, radius, radius, length), start)


def undergrowth(
    ground: Ground, vegetation: Vegetation, *, lower: Array, upper: Array, roads: tuple[Array, float]
) -> Surface:
    """Return bushes: bundles of blades that stand up and lean outwards.

    Args:
        ground: The ground.
        vegetation: The vegetation, for the number of bushes.
        lower: The least x and y of the area in m, shape (2,).
        upper: The largest x and y of the area in m, shape (2,).
        roads: Points of the roads in m, (n, 2), and the distance from them within which nothing grows, in m.
    """
    rng = np.random.default_rng([vegetation.seed, _UNDERGROWTH])
    count = rng.poisson(vegetation.undergrowth * float(np.prod(upper - lower)) / 1e4)
    centres = rng.uniform(lower, upper, (count, 2))
    radius, height = _between(rng, _BUSH_RADIUS, count), _between(rng, _BUSH_HEIGHT, count)
    points, clearance = roads
    if len(points):
        from scipy.spatial import cKDTree

        free = cKDTree(points).query(centres)[0] > clearance
        centres, radius, height = centres[free], radius[free], height[free]
    of = np.repeat(np.arange(len(centres)), _BLADES)
    azimuth, share = rng.uniform(0.0, 2.0 * np.pi, len(of)), np.sqrt(rng.random(len(of)))
    away = (0.5 * radius[of] * share)[:, np.newaxis] * np.column_stack([np.cos(azimuth), np.sin(azimuth)])
    root = centres[of] + away
    start = np.column_stack([root, ground.height(root[:, 0], root[:, 1])])
    # The outermost blades lean as far as the bush is wide.
    lean = np.arctan2(0.5 * radius[of] * share, height[of])
    directions = _directions(azimuth + rng.normal(0.0, 0.5, len(of)), 0.5 * np.pi - lean)
    length = height[of] * rng.uniform(0.5, 1.0, len(of))
    width = _between(rng, _BLADE_WIDTH, len(of))
    return copies(_BLADE, _along(directions, width, width, length, turn=rng.uniform(0.0, np.pi, len(of))), start)


def _sizes(trees: WorldModel) -> tuple[Array, Array]:
    """Return diameters and heights in m, (n,) each."""
    sizes = [(tree.number("trunk_diameter", unit="m"), tree.number("height", unit="m")) for tree in trees]
    for tree, (_, height) in zip(trees, sizes, strict=True):
        if height <= 2.0 * BREAST_HEIGHT:
            raise ValueError(
                f"the tree {tree.identity} of {height:g} m is too low: trees are above {2 * BREAST_HEIGHT} m"
            )
    diameters, heights = np.array(sizes).reshape(-1, 2).T
    return diameters, heights


def _scaled(x: Array, y: Array, z: Array) -> Array:
    """Return the matrices that scale along the axes, (n, 3, 3)."""
    return np.eye(3) * np.stack([x, y, z], axis=-1)[:, np.newaxis]


def _directions(azimuth: Array, elevation: Array) -> Array:
    level = np.cos(elevation)
    return np.column_stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)])


def _along(directions: Array, x: Array, y: Array, z: Array, *, turn: Array | float = 0.0) -> Array:
    """Return the matrices that scale along the axes, turn about z, and turn z into unit vectors (n, 3)."""
    # Any direction across; a direction along this vector has probability zero.
    across = np.cross(directions, np.array([0.6, 0.64, 0.48]))
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    other = np.cross(directions, across)
    c, s = (np.broadcast_to(f(turn), len(x))[:, np.newaxis] for f in (np.cos, np.sin))
    columns = ((c * across + s * other) * x[:, np.newaxis], (c * other - s * across) * y[:, np.newaxis])
    return np.stack([*columns, directions * z[:, np.newaxis]], axis=-1)


def _between(rng: np.random.Generator, limits: tuple[float, float], count: int) -> Array:
    """Return numbers between two limits whose logarithms are uniform, (count,)."""
    low, high = np.log(limits)
    return np.exp(rng.uniform(low, high, count))
