"""Point contact of a discrete plant: which geometries may touch, with which materials, and where they do."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import casadi
import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import Box, Convex, GeometryId, Mesh, PolygonSurfaceMesh, SceneGraphInspector, Shape, Sphere
from pydrake.math import RigidTransform
from pydrake.multibody.plant import ContactModel, DiscreteContactApproximation, MultibodyPlant
from pydrake.multibody.tree import RigidBody
from pydrake.systems.framework import Context

from vtbdrake.components.compiled_plant.dynamics import PlantDynamics
from vtbdrake.components.compiled_plant.ground import SLOTS, GroundContact, Piece, Terrain
from vtbdrake.components.compiled_plant.links import (
    UnsupportedPlantError,
    colliding,
    constant_pose,
    rounding_beside,
    times,
)
from vtbdrake.components.compiled_plant.touching import can_touch, is_iterated, touch

Expression = Any  # casadi.SX

# A sphere with more fixed boxes and hulls that it may touch looks for them in a grid.
_MANY_PIECES = 16
_PIECES = (Box, Convex, Mesh)

_APPROXIMATIONS = (DiscreteContactApproximation.kSap, DiscreteContactApproximation.kLagged)


@dataclass(frozen=True)
class Surface:
    """A collision geometry G.

    Attributes:
        geometry: Drake's number of it.
        name: Its name, and its body's.
        body: Index of the body B.
        shape: Its shape.
        X_BG: Its pose in the body's frame.
        stiffness: Stiffness of its material, in N/m.
        dissipation: The material's relaxation time (s), or Hunt and Crossley's dissipation (s/m) if the plant's
            approximation is lagged.
        friction: Coefficient of dynamic friction.
        vertices: Vertices of its convex hull in its frame, shape (n, 3), in m; n is 0 unless it is a mesh.
    """

    geometry: int
    name: str
    body: int
    shape: Shape
    X_BG: RigidTransform
    stiffness: float
    dissipation: float
    friction: float
    vertices: NDArray[np.float64]


@dataclass(frozen=True)
class Pair:
    """Two geometries that may touch.

    Attributes:
        first: A sphere, or any shape if the second one is a half-space.
        second: The other geometry.
    """

    first: Surface
    second: Surface

    def material(self, *, is_lagged: bool) -> tuple[float, float, float]:
        """Return stiffness, dissipation and friction of both together, as Drake combines them."""
        a, b = self.first, self.second
        stiffness = 1.0 / (1.0 / a.stiffness + 1.0 / b.stiffness)
        dissipation = a.dissipation + b.dissipation
        if is_lagged:
            dissipation = stiffness * (a.dissipation / a.stiffness + b.dissipation / b.stiffness)
        both = a.friction + b.friction
        return stiffness, dissipation, 2.0 * a.friction * b.friction / both if both else 0.0


class Contacts(NamedTuple):
    """All contacts that there may be, as expressions: first the pairs, then places for spheres on ground.

    Attributes:
        J_bodies: Angular and linear Jacobians of `PointContact.bodies`, in the world, shape (6 bodies, nv).
        origins: The origins of these bodies in the world, shape (3, bodies), in m.
        normals: The normals from the first into the second geometry in the world, shape (3, n); ground is the second.
        distances: The distances in m, shape (n, 1).
        material: Stiffness, dissipation and friction, each of shape (n, 1).
        points: Where the forces act in the world, shape (3, n), in m.
        doubt: Positive where there are more contacts than places.
    """

    J_bodies: Expression
    origins: Expression
    normals: Expression
    distances: Expression
    material: tuple[Expression, Expression, Expression]
    points: Expression
    doubt: Expression


class FixedPiece(NamedTuple):
    """A piece of a terrain, at its place in the world.

    Attributes:
        shape: A Box or a Convex.
        X_WP: Its pose in the world.
        friction: Its coefficient of friction, which Drake combines with the other body's.
    """

    shape: Shape
    X_WP: RigidTransform
    friction: float


class Ground(NamedTuple):
    """Spheres, and many fixed pieces that each of them may touch.

    Attributes:
        spheres: The spheres.
        pieces: The pieces, in the order of their numbers.
    """

    spheres: tuple[Surface, ...]
    pieces: tuple[Surface, ...]


def contact_pairs(plant: MultibodyPlant, context: Context) -> tuple[Pair, ...]:
    """Return the pairs of geometries that may touch.

    Args:
        plant: The discrete plant, finalized.
        context: The plant's own Context; unless its geometry query is connected, there is no contact.

    Raises:
        UnsupportedPlantError: A shape, a contact model or an approximation is not compiled.
    """
    candidates = list(colliding(plant, context))
    if not candidates:
        return ()
    approximation = plant.get_discrete_contact_approximation()
    if approximation not in _APPROXIMATIONS:
        raise UnsupportedPlantError(
            f"contact approximated as {approximation.name} is not compiled: set discrete_contact_approximation to "
            "'sap' or 'lagged'"
        )
    reader = _SurfaceReader(plant, plant.get_geometry_query_input_port().Eval(context).inspector())
    ordered = (sorted(pair, key=lambda each: each[0].get_value()) for pair in candidates)
    in_order = sorted(ordered, key=lambda pair: [geometry.get_value() for geometry, _ in pair])
    return tuple(_pair(*(reader.surface(geometry, body) for geometry, body in pair)) for pair in in_order)


class _SurfaceReader:
    """Reads collision geometries with what their contact takes."""

    def __init__(self, plant: MultibodyPlant, inspector: SceneGraphInspector) -> None:
        self._plant, self._inspector = plant, inspector
        self._surfaces: dict[GeometryId, Surface] = {}
        dissipation = "hunt_crossley_dissipation" if is_lagged(plant) else "relaxation_time"
        self._kinds = "point_contact_stiffness", dissipation

    def surface(self, geometry: GeometryId, body: RigidBody) -> Surface:
        """Return the geometry with an id on a body."""
        if geometry not in self._surfaces:
            self._surfaces[geometry] = self._new_surface(geometry, body)
        return self._surfaces[geometry]

    def _new_surface(self, geometry: GeometryId, body: RigidBody) -> Surface:
        inspector = self._inspector
        properties = inspector.GetProximityProperties(geometry)
        name = f"{inspector.GetName(geometry)} of {body.name()}"
        # A half-space has no mesh, but what touches it has one if their contact is hydroelastic.
        has_mesh = inspector.maybe_get_hydroelastic_mesh(geometry) is not None
        if has_mesh and self._plant.get_contact_model() != ContactModel.kPoint:
            raise UnsupportedPlantError(f"hydroelastic contact of {name} is not compiled: set contact_model to 'point'")
        missing = [kind for kind in self._kinds if not properties.HasProperty("material", kind)]
        if missing:
            raise UnsupportedPlantError(
                f"{name} has no {' and no '.join(missing)}: give it one (AddContactMaterial), or leave those of "
                "SceneGraphConfig.default_proximity_properties"
            )
        stiffness, dissipation = (float(properties.GetProperty("material", kind)) for kind in self._kinds)
        friction = properties.GetProperty("material", "coulomb_friction").dynamic_friction()
        shape, X_BG = inspector.GetShape(geometry), inspector.GetPoseInFrame(geometry)
        vertices = np.zeros((0, 3))
        if isinstance(shape, Convex | Mesh):
            vertices = _hull(inspector.GetConvexHull(geometry))
        number = geometry.get_value()
        return Surface(number, name, int(body.index()), shape, X_BG, stiffness, dissipation, friction, vertices)


def _hull(hull: PolygonSurfaceMesh) -> NDArray[np.float64]:
    """Return the vertices of a convex hull, shape (n, 3), in m."""
    return np.array([hull.vertex(k) for k in range(hull.num_vertices())])


def _pair(first: Surface, second: Surface) -> Pair:
    for pair in (Pair(first, second), Pair(second, first)):
        if can_touch(pair.first.shape, pair.second.shape):
            return pair
    raise UnsupportedPlantError(
        f"contact of {first.name} ({type(first.shape).__name__}) and {second.name} ({type(second.shape).__name__}) "
        "is not compiled: let a Sphere touch any shape but an Ellipsoid, a HalfSpace a Box, Cylinder, Capsule, Convex "
        "or Mesh, or a Capsule another one, or exclude the two by a CollisionFilterDeclaration"
    )


def is_lagged(plant: MultibodyPlant) -> bool:
    """Return whether a plant's contact is approximated as lagged."""
    return plant.get_discrete_contact_approximation() == DiscreteContactApproximation.kLagged


class PointContact:
    """The geometry of contact: where pairs of geometries touch, as expressions.

    Args:
        plant: The discrete plant, finalized.
        model: The plant's equations.
        pairs: What may touch, see `contact_pairs`.

    Attributes:
        pairs: What may touch, but for spheres that may touch many fixed pieces.
        grounds: These spheres, with their pieces.
        bodies: Indices of the bodies that move and may touch.
    """

    def __init__(self, plant: MultibodyPlant, model: PlantDynamics, pairs: Sequence[Pair]) -> None:
        self._model = model
        self._is_lagged = is_lagged(plant)
        self.pairs, self.grounds = self._divided(pairs)
        on_sides = {body for sides in self._sides() for body in sides}
        self.bodies = tuple(sorted(body for body in on_sides if model.way(body)))
        self._kernels = [self._ground_kernel(ground) for ground in self.grounds]

    def is_iterated(self) -> bool:
        """Return whether Drake iterates for a pair, and ends elsewhere if a pose is rounded otherwise."""
        has_hulls = any(not isinstance(piece.shape, Box) for ground in self.grounds for piece in ground.pieces)
        return has_hulls or any(is_iterated(pair.first.shape, pair.second.shape) for pair in self.pairs)

    def materials(self) -> np.ndarray:
        """Return stiffness, dissipation and friction of each pair, shape (n, 3); see `Pair.material`."""
        return np.array([pair.material(is_lagged=self._is_lagged) for pair in self.pairs]).reshape(-1, 3)

    def places(self) -> list[list[int]]:
        """Return the places of the velocities that move each contact."""
        return [sorted({place for body in sides for place in self._model.way(body)}) for sides in self._sides()]

    def sides(self) -> list[list[int]]:
        """Return the places of both bodies of each contact among `bodies`, -1 of a body that does not move."""
        return [[self.bodies.index(body) if body in self.bodies else -1 for body in sides] for sides in self._sides()]

    def forces_on(self, body: int, forces: Expression, contacts: Contacts) -> Iterator[tuple[Expression, Expression]]:
        """Yield the contact forces on a body: where they act, and what they are; both in the world, shape (3, 1).

        Args:
            body: Index of the body.
            forces: The contact forces of `SapSolver.step`.
            contacts: The contacts of this step.
        """
        for i, pair in enumerate(self.pairs):
            for surface, sign in ((pair.first, 1.0), (pair.second, -1.0)):
                if surface.body == body:
                    yield contacts.points[:, i], sign * forces[:, i]
        for i, sphere in enumerate(self._spheres()):
            if sphere.body == body:
                for at in range(len(self.pairs) + i * SLOTS, len(self.pairs) + (i + 1) * SLOTS):
                    yield contacts.points[:, at], forces[:, at]

    def contacts(self, q: Expression, terrain: Expression = 0.0) -> Contacts:
        """Return all contacts that there may be at positions q, shape (nq, 1).

        Args:
            q: The positions.
            terrain: The number of the terrain under the spheres on ground, see `terrain`; 0: the plant's own.
        """
        touching = [self._touch(pair, q) for pair in self.pairs]
        motions = [self._model.body_motion(body, q) for body in self.bodies]
        poses = [self._pose(sphere, q) for sphere in self._spheres()]
        results, start = [], 0
        for ground, kernel in zip(self.grounds, self._kernels, strict=True):
            R, p = zip(*poses[start : start + len(ground.spheres)], strict=True)
            results.append(kernel.function(*(casadi.densify(casadi.horzcat(*each)) for each in (R, p)), terrain))
            start += len(ground.spheres)
        on_ground = [[result[k] for result in results] for k in range(7)]
        offsets = casadi.horzcat(casadi.SX(3, 0), *on_ground[2])
        centers = casadi.horzcat(casadi.SX(3, 0), *(p for _, p in poses for _ in range(SLOTS)))
        stiffness, dissipation, friction = (
            casadi.vertcat(casadi.SX(casadi.DM(column)), *on_ground[3 + k])
            for k, column in enumerate(self.materials().T)
        )
        return Contacts(
            J_bodies=casadi.vertcat(casadi.SX(0, self._model.nv), *(motion.J for motion in motions)),
            origins=casadi.horzcat(casadi.SX(3, 0), *(motion.p for motion in motions)),
            normals=casadi.horzcat(casadi.SX(3, 0), *(normal for _, normal, _ in touching), *on_ground[1]),
            distances=casadi.vertcat(casadi.SX(0, 1), *(distance for _, _, distance in touching), *on_ground[0]),
            material=(stiffness, dissipation, friction),
            points=casadi.horzcat(casadi.SX(3, 0), *(point for point, _, _ in touching), centers + offsets),
            doubt=casadi.SX(casadi.mmax(casadi.vertcat(0.0, *on_ground[6]))),
        )

    def _spheres(self) -> list[Surface]:
        return [sphere for ground in self.grounds for sphere in ground.spheres]

    def _sides(self) -> list[tuple[int, int]]:
        """Return the indices of the bodies 1 and 2 of each contact."""
        of_pairs = [(pair.first.body, pair.second.body) for pair in self.pairs]
        on_ground = [(ground.spheres, ground.pieces[0].body) for ground in self.grounds]
        return of_pairs + [
            (sphere.body, fixed) for spheres, fixed in on_ground for sphere in spheres for _ in range(SLOTS)
        ]

    def _divided(self, pairs: Sequence[Pair]) -> tuple[tuple[Pair, ...], tuple[Ground, ...]]:
        """Return the pairs without the spheres that may touch many fixed pieces, and these spheres as grounds."""
        partners: dict[int, list[tuple[Surface, Surface, Pair]]] = {}
        for pair in pairs:
            for sphere, piece in ((pair.first, pair.second), (pair.second, pair.first)):
                is_piece = isinstance(piece.shape, _PIECES) and not self._model.way(piece.body)
                if isinstance(sphere.shape, Sphere) and is_piece and self._model.way(sphere.body):
                    partners.setdefault(sphere.geometry, []).append((sphere, piece, pair))
        many = [each for each in partners.values() if len(each) > _MANY_PIECES]
        on_ground = {id(pair) for each in many for _, _, pair in each}
        grounds: dict[tuple[int, ...], Ground] = {}
        for each in many:
            pieces = tuple(sorted((piece for _, piece, _ in each), key=lambda piece: piece.geometry))
            key = tuple(piece.geometry for piece in pieces)
            spheres = grounds[key].spheres if key in grounds else ()
            grounds[key] = Ground((*spheres, each[0][0]), pieces)
        return tuple(pair for pair in pairs if id(pair) not in on_ground), tuple(grounds.values())

    def terrain(self, pieces: Sequence[FixedPiece]) -> Terrain:
        """Return a terrain of other pieces, on which the spheres may stand instead of the plant's own.

        A piece has the stiffness and the dissipation of the plant's first one.

        Args:
            pieces: The pieces.

        Raises:
            ValueError: There are no pieces, or a shape cannot be a piece.
            UnsupportedPlantError: The plant has no ground to replace, or several.
        """
        if len(self.grounds) != 1:
            raise UnsupportedPlantError(
                f"a terrain replaces the only ground of a plant, and this one has {len(self.grounds)}: a ground is "
                f"more than {_MANY_PIECES} fixed pieces that a sphere may touch"
            )
        if not pieces:
            raise ValueError("a terrain has at least one piece, but there are none")
        (ground,), (kernel,) = self.grounds, self._kernels
        sample = ground.pieces[0]
        others = []
        for piece in pieces:
            if not isinstance(piece.shape, Box | Convex):
                raise ValueError(f"a piece of terrain is a Box or a Convex, not a {type(piece.shape).__name__}")
            vertices = np.zeros((0, 3)) if isinstance(piece.shape, Box) else _hull(piece.shape.GetConvexHull())
            others.append(
                replace(
                    sample,
                    shape=piece.shape,
                    X_BG=piece.X_WP,
                    friction=piece.friction,
                    vertices=vertices,
                )
            )
        return kernel.terrain(*self._pieces_with_materials(ground.spheres, others, [each.X_BG for each in others]))

    def _ground_kernel(self, ground: Ground) -> GroundContact:
        """Return the contact of the spheres on a ground."""
        nowhere = casadi.SX.sym("q", self._model.nq)
        poses = []
        for piece in ground.pieces:
            R, p = (casadi.evalf(each).full() for each in self._pose(piece, nowhere))
            poses.append(RigidTransform(np.vstack([np.column_stack([R, p]), [0.0, 0.0, 0.0, 1.0]])))
        spheres = [(sphere.geometry, sphere.shape) for sphere in ground.spheres]
        return GroundContact(spheres, *self._pieces_with_materials(ground.spheres, ground.pieces, poses))

    def _pieces_with_materials(
        self, spheres: Sequence[Surface], pieces: Sequence[Surface], poses: Sequence[RigidTransform]
    ) -> tuple[list[Piece], NDArray[np.float64]]:
        """Return pieces at their poses in the world, and their materials with the spheres, see `GroundContact`."""
        materials = [
            [
                (
                    *Pair(sphere, piece).material(is_lagged=self._is_lagged),
                    sphere.stiffness / (sphere.stiffness + piece.stiffness),
                )
                for piece in pieces
            ]
            for sphere in spheres
        ]
        placed = [
            Piece(piece.geometry, piece.shape, X_WP.rotation().matrix(), X_WP.translation(), piece.vertices)
            for piece, X_WP in zip(pieces, poses, strict=True)
        ]
        return placed, np.array(materials)

    # -- where it touches

    def _touch(self, pair: Pair, q: Expression) -> tuple[Expression, Expression, Expression]:
        """Return the point of contact and the normal from the first to the second, in the world, and the distance."""
        first, second = pair.first, pair.second
        poses = self._pose(first, q), self._pose(second, q)
        on_first, n, distance = touch(first.shape, poses[0], second.shape, poses[1], (first.vertices, second.vertices))
        on_second = on_first - distance * n
        share = np.array([first.stiffness, second.stiffness]) / (first.stiffness + second.stiffness)
        return share[0] * on_first + share[1] * on_second, -n, distance

    def _pose(self, surface: Surface, q: Expression) -> tuple[Expression, Expression]:
        rounding = rounding_beside(np.max(np.abs(surface.X_BG.translation())))
        return times(self._model.body_pose(surface.body, q), constant_pose(surface.X_BG, rounding))
