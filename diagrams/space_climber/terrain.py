r"""A lunar crater as procedural terrain: the same seed gives the same crater.

Heights are over the crater's floor, in the world's frame, whose origin lies on the floor below the crater's axis. With
the distance r from the axis, the azimuth theta, the rim's radius R and the depth d, the ground before gullies is

    z(r, theta) = d (1 - cos(pi s)) / 2,    s = clip((r - r_f) / (R - r_f), 0, 1),    r_f(theta) = R - pi d / (2 tan a).

So the floor is flat up to r_f, the wall is steepest halfway, where its slope is a(theta), and the rim at r = R is
d high in every direction; beyond, the ground is flat. What was chosen, and why:

* R = 40 m, d = 6 m: the rim is within reach of 300 s of walking (57 m on the flat). Fresh craters below 1 km have a
  ratio d / (2 R) of 0.1 to 0.2 (Sun, Yue and Di, Icarus 309, 2018; 0.2 for larger ones: Pike, Geophys. Res. Lett. 1,
  1974); with 0.075, this one has begun to fill.
* a(theta) in [14, 34] deg, every value as likely as another: from a wall that has slumped to one at the angle of repose
  of dry loose material. It is the sum of the first `HARMONICS` harmonics with random amplitudes, made uniform. By slope
  alone, about half of the headings lie below 26 deg, which a robot climbs with the friction 0.6.
* A gully, V-shaped, runs obliquely down the wall, and does not cut the rim. Its banks add up to 34 deg to the slope.
* Fields of boulders: angular blocks, half buried, whose heights h over the ground follow the cumulative power law
  h^-2.5 between 6 and 50 cm. Counts of blocks on the moon follow power laws too (Cintala and McBride, NASA TM 104804,
  1995); the exponent, and how dense the fields are, are assumed.

* Rocks all around, if `Crater.rock_cover` says so: rocks of a diameter of at least D cover the share of the ground
  F(D) = k exp(-q D), q = 1.79 + 0.152 / k (1/m), the fit of Golombek and Rapp, J. Geophys. Res. 102 (E2), 1997, to
  counts at landing sites; k is the rock cover. Those sites have 3 to 18 % (Golombek et al., J. Geophys. Res. 108 (E12),
  2003). Rocks lie between 0.12 and 1 m, half as high as wide or a little less, where the wall is and not at its foot.

First versions were steeper and had more harmonics, gullies and boulders. Rollouts in craters 0 to 8 showed that half of
them had no passable direction, and therefore no decision. So the terrain was made easier twice. The present depth,
slopes and harmonics were chosen by the slopes of 40 craters.

The gully, the boulders and the fine part of the mesh lie in the sector around the x axis that a robot may enter which
sets out from the middle with a heading within 45 deg.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.geometry import Box, Convex, Mesh, ProximityProperties
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import MultibodyPlant
from scipy.interpolate import LinearNDInterpolator
from scipy.spatial import Delaunay
from scipy.special import ndtr

from vtbdrake.common.arrays import Array
from vtbdrake.components.meshes import obj_mesh, surface_mesh

RIM_RADIUS = 40.0
DEPTH = 6.0
WALL_DEG = (14.0, 34.0)
HARMONICS = 5

# How far the sector with details reaches to either side of the x axis, in radians, and the ground beyond the rim, in m.
SECTOR = np.radians(50.0)
BEYOND = 20.0

GULLIES = 1
GULLY_DEPTH = 1.0
GULLY_HALF_WIDTH = 1.5

FIELDS = 3
FIELD_RADIUS = (2.0, 4.0)
FIELD_DISTANCE = (16.0, 34.0)
# Boulders per square metre.
FIELD_DENSITY = (0.5, 1.5)
BOULDER_HEIGHT = (0.06, 0.5)
BOULDER_EXPONENT = 2.5

ROCK_DIAMETER = (0.12, 1.0)
# Height of a rock over the ground by its diameter, from and to.
ROCK_HEIGHT = (0.35, 0.5)
# Distance from the axis from which on there are rocks, and up to which, in m.
ROCK_DISTANCE = (6.0, RIM_RADIUS + 2.0)

# Distance of the mesh's vertices in the sector, in m.
_FINE = 2.5
# Distance of the vertices along gullies, in m.
_ALONG_GULLY = 1.5
# Distance of the vertices elsewhere, in m.
_COARSE = 12.0
_THICKNESS = 1.0

GREY = np.array([0.55, 0.53, 0.50, 1.0])
_BOULDER_GREY = np.array([0.42, 0.40, 0.38, 1.0])


@dataclass(frozen=True)
class Gully:
    """A V-shaped channel along a straight line on the map, with the depth 0 at both of its ends.

    Attributes:
        upper, lower: (x, y) of its ends in m.
    """

    upper: tuple[float, float]
    lower: tuple[float, float]

    def depth(self, x: Array, y: Array) -> Array:
        """Return how far the ground lies below the wall, in m."""
        begin, way = np.array(self.lower), np.subtract(self.upper, self.lower)
        length = float(np.hypot(*way))
        along = ((x - begin[0]) * way[0] + (y - begin[1]) * way[1]) / length
        across = ((x - begin[0]) * way[1] - (y - begin[1]) * way[0]) / length
        lengthwise = np.clip(np.minimum(along, length - along) / (0.25 * length), 0.0, 1.0)
        depth: Array = GULLY_DEPTH * lengthwise * np.clip(1.0 - np.abs(across) / GULLY_HALF_WIDTH, 0.0, 1.0)
        return depth

    def vertices(self) -> Array:
        """Return (x, y) of points along its bottom and its edges, (n, 2): a mesh over them has the V."""
        begin, way = np.array(self.lower), np.subtract(self.upper, self.lower)
        length = float(np.hypot(*way))
        normal = np.array([way[1], -way[0]]) / length
        along = np.linspace(0.0, 1.0, round(length / _ALONG_GULLY) + 1)
        rows = [begin + np.outer(along, way) + side * GULLY_HALF_WIDTH * normal for side in (-1.0, 0.0, 1.0)]
        return np.vstack(rows)


@dataclass(frozen=True)
class Boulder:
    """An angular block, half buried.

    Attributes:
        x, y: Position of its centre, which lies on the ground, in m.
        size: Edges in m; half of the third is its height over level ground.
        rpy: Roll, pitch and yaw in rad.
    """

    x: float
    y: float
    size: tuple[float, float, float]
    rpy: tuple[float, float, float]


@dataclass(frozen=True)
class Crater:
    """A crater of a seed.

    Attributes:
        seed: Determines walls, gullies and boulders.
        gullies: False fills the gullies.
        boulders: False removes the boulders.
        waviness: Standard deviation of the mesh's vertices around the surface, in m. They are `_FINE` apart or more:
            these are waves of metres, and each of the triangles, larger than the robot, is smooth.
        waviness_seed: Determines the waves.
        rock_cover: Share of the ground that rocks cover, beside the fields of boulders; 0 for none.
    """

    seed: int = 0
    gullies: bool = True
    boulders: bool = True
    waviness: float = 0.0
    waviness_seed: int = 0
    rock_cover: float = 0.0

    def wall_slope(self, azimuth: ArrayLike) -> Array:
        """Return a(theta), the largest slope of the wall in rad, at azimuths in rad."""
        rng = np.random.default_rng([self.seed, 0])
        a, b = rng.standard_normal((2, HARMONICS)) / np.sqrt(HARMONICS)
        angles = np.multiply.outer(np.asarray(azimuth, dtype=float), np.arange(1, HARMONICS + 1))
        # A normal variable in every direction, so that its distribution function is uniform in [0, 1].
        share = ndtr(np.cos(angles) @ a + np.sin(angles) @ b)
        lower, upper = np.radians(WALL_DEG)
        slope: Array = lower + (upper - lower) * share
        return slope

    def height(self, x: ArrayLike, y: ArrayLike) -> Array:
        """Return the height of the ground over the floor in m, without boulders and waves."""
        x, y = np.broadcast_arrays(np.asarray(x, dtype=float), np.asarray(y, dtype=float))
        r = np.hypot(x, y)
        foot = RIM_RADIUS - 0.5 * np.pi * DEPTH / np.tan(self.wall_slope(np.arctan2(y, x)))
        s = np.clip((r - foot) / (RIM_RADIUS - foot), 0.0, 1.0)
        z: Array = 0.5 * DEPTH * (1.0 - np.cos(np.pi * s))
        # Where the floor is, no gully goes below it.
        for gully in self.gully_lines:
            z = np.maximum(z - gully.depth(x, y), np.minimum(z, 0.0))
        return z

    @cached_property
    def gully_lines(self) -> tuple[Gully, ...]:
        """Return the gullies; none if they are filled."""
        if not self.gullies:
            return ()
        rng = np.random.default_rng([self.seed, 1])
        lines = []
        for _ in range(GULLIES):
            azimuth = rng.uniform(-SECTOR, SECTOR)
            # Its lower end is 5 to 10 m to the side of where the line of steepest descent ends.
            aside = rng.choice([-1.0, 1.0]) * rng.uniform(5.0, 10.0)
            radial = np.array([np.cos(azimuth), np.sin(azimuth)])
            tangent = np.array([-radial[1], radial[0]])
            upper, lower = (RIM_RADIUS - 2.0) * radial, rng.uniform(18.0, 24.0) * radial + aside * tangent
            lines.append(Gully((float(upper[0]), float(upper[1])), (float(lower[0]), float(lower[1]))))
        return tuple(lines)

    @cached_property
    def blocks(self) -> tuple[Boulder, ...]:
        """Return the boulders and rocks; none if they are removed."""
        if not self.boulders:
            return ()
        return (*self._fields(), *self._rocks())

    def _fields(self) -> list[Boulder]:
        rng = np.random.default_rng([self.seed, 2])
        smallest, largest = np.array(BOULDER_HEIGHT) ** -BOULDER_EXPONENT
        scattered = []
        for _ in range(FIELDS):
            azimuth, distance = rng.uniform(-SECTOR, SECTOR), rng.uniform(*FIELD_DISTANCE)
            radius = rng.uniform(*FIELD_RADIUS)
            count = rng.poisson(rng.uniform(*FIELD_DENSITY) * np.pi * radius**2)
            away, towards = radius * np.sqrt(rng.uniform(size=count)), rng.uniform(-np.pi, np.pi, size=count)
            x = distance * np.cos(azimuth) + away * np.cos(towards)
            y = distance * np.sin(azimuth) + away * np.sin(towards)
            height = rng.uniform(largest, smallest, size=count) ** (-1.0 / BOULDER_EXPONENT)
            size = height[:, None] * np.column_stack([rng.uniform(1.5, 3.0, size=(count, 2)), np.full(count, 2.0)])
            rpy = rng.uniform([-0.3, -0.3, -np.pi], [0.3, 0.3, np.pi], size=(count, 3))
            scattered += [
                Boulder(*row[:2], tuple(row[2:5]), tuple(row[5:]))
                for row in np.column_stack([x, y, size, rpy]).tolist()
            ]
        return scattered

    def _rocks(self) -> list[Boulder]:
        if not self.rock_cover > 0.0:
            return []
        rng = np.random.default_rng([self.seed, 4])
        inner, outer = ROCK_DISTANCE
        edges = np.linspace(*ROCK_DIAMETER, 89)
        middles = 0.5 * (edges[1:] + edges[:-1])
        q = 1.79 + 0.152 / self.rock_cover
        density = self.rock_cover * -np.diff(np.exp(-q * edges)) / (0.25 * np.pi * middles**2)
        counts = rng.poisson(density * SECTOR * (outer**2 - inner**2))
        D = rng.permutation(np.repeat(middles, counts))
        r = np.sqrt(rng.uniform(inner**2, outer**2, size=D.size))
        azimuth = rng.uniform(-SECTOR, SECTOR, size=D.size)
        size = D[:, None] * rng.uniform([0.8, 0.8, 2.0 * ROCK_HEIGHT[0]], [1.2, 1.2, 2.0 * ROCK_HEIGHT[1]], (D.size, 3))
        rpy = rng.uniform([-0.3, -0.3, -np.pi], [0.3, 0.3, np.pi], (D.size, 3))
        rows = np.column_stack([r * np.cos(azimuth), r * np.sin(azimuth), size, rpy]).tolist()
        return [Boulder(*row[:2], tuple(row[2:5]), tuple(row[5:])) for row in rows]

    @cached_property
    def mesh(self) -> tuple[Array, NDArray[np.int64]]:
        """Return the vertices, (n, 3) in m, and the triangles, (m, 3), counterclockwise from above."""
        points = self._map_points()
        triangles = Delaunay(points).simplices.astype(np.int64)
        a, b, c = (points[triangles[:, k]] for k in range(3))
        clockwise = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) < (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
        triangles[clockwise] = triangles[clockwise][:, ::-1]
        z = self.height(*points.T)
        if self.waviness > 0.0:
            z = z + self.waviness * np.random.default_rng([self.waviness_seed, 3]).standard_normal(z.size)
        return np.column_stack([points, z]), triangles

    def mesh_height(self, places: ArrayLike) -> Array:
        """Return the height of the mesh, with its waves, at places (x, y) within it, (n, 2), in m."""
        vertices, _ = self.mesh
        # Over the Delaunay triangulation of the same points.
        z: Array = LinearNDInterpolator(vertices[:, :2], vertices[:, 2])(np.asarray(places, dtype=float))
        return z

    def _map_points(self) -> Array:
        """Return (x, y) of the mesh's vertices, (n, 2): rings, coarse outside the sector, and rows along gullies."""
        rings = [
            _ring(r, -SECTOR, SECTOR, _FINE, shift=k % 2)
            for k, r in enumerate(np.arange(_FINE, RIM_RADIUS + 2.0 * _FINE, _FINE))
        ]
        rings += [_ring(r, SECTOR, 2.0 * np.pi - SECTOR, _COARSE) for r in (10.0, 20.0, 30.0, RIM_RADIUS)]
        points = np.vstack([[[0.0, 0.0]], *rings, _ring(RIM_RADIUS + BEYOND, 0.0, 2.0 * np.pi, _COARSE)])
        for gully in self.gully_lines:
            rows = gully.vertices()
            distance = np.linalg.norm(points[:, None] - rows[None], axis=2).min(axis=1)
            points = np.vstack([points[distance > 0.75 * _ALONG_GULLY], rows])
        return points


def _ring(r: float, begin: float, end: float, distance: float, *, shift: int = 0) -> Array:
    """Return points of a circle between two azimuths, (n, 2), about ``distance`` apart; the end is left out.

    With a shift of 1, they lie half a distance further on: the triangles of successive rings are nearly regular.
    """
    count = max(round((end - begin) * r / distance), 3)
    azimuth = begin + (end - begin) * (np.arange(count) + 0.5 * shift) / count
    points: Array = r * np.column_stack([np.cos(azimuth), np.sin(azimuth)])
    return points


def add_crater(plant: MultibodyPlant, crater: Crater) -> None:
    """Register the crater's ground and boulders on the world body, for contact at points and for Meshcat.

    Drake has no height field, and the contact at points of a mesh is with its convex hull. So each triangle is the top
    of a prism; together they are one continuous surface. Ground and boulders have the friction of the SceneGraph's
    defaults, or each of about a thousand geometries would have a variable of its own.

    Args:
        plant: A plant that is not finalized.
        crater: The crater.
    """
    world, default = plant.world_body(), ProximityProperties()
    vertices, triangles = crater.mesh
    plant.RegisterVisualGeometry(
        world, RigidTransform(), Mesh(surface_mesh((vertices, triangles), name="terrain"), 1.0), "ground", GREY
    )
    for name, shape, X_WS in crater_shapes(crater):
        plant.RegisterCollisionGeometry(world, X_WS, shape, name, default)
        if isinstance(shape, Box):
            plant.RegisterVisualGeometry(world, X_WS, shape, name, _BOULDER_GREY)


def crater_shapes(crater: Crater) -> Iterator[tuple[str, Box | Convex, RigidTransform]]:
    """Yield the shapes that a robot touches, each with its name and its pose in the world: ground, then boulders."""
    vertices, triangles = crater.mesh
    for k, triangle in enumerate(triangles):
        X_WT, prism_shape = prism(vertices[triangle])
        yield f"ground_{k}", prism_shape, X_WT
    heights = crater.height([b.x for b in crater.blocks], [b.y for b in crater.blocks]).tolist()
    for k, (block, z) in enumerate(zip(crater.blocks, heights, strict=True)):
        yield f"boulder_{k}", Box(*block.size), RigidTransform(RollPitchYaw(block.rpy), [block.x, block.y, z])


def prism(top: Array) -> tuple[RigidTransform, Convex]:
    """Return pose and shape of the prism below a triangle, (3, 3): from the triangle straight down."""
    center = top.mean(axis=0)
    upper = top - center
    lower = upper - [0.0, 0.0, _THICKNESS]
    faces = [(0, 1, 2), (5, 4, 3), (0, 3, 4, 1), (1, 4, 5, 2), (2, 5, 3, 0)]
    return RigidTransform(center), Convex(obj_mesh(np.vstack([upper, lower]), faces, name="terrain"), 1.0)
