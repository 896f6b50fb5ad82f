"""Point contact of a discrete plant: which geometries may touch, with which materials, and where they do."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import Convex, GeometryId, Mesh, SceneGraphInspector, Shape
from pydrake.math import RigidTransform
from pydrake.multibody.plant import ContactModel, DiscreteContactApproximation, MultibodyPlant
from pydrake.multibody.tree import RigidBody
from pydrake.systems.framework import Context

from vtbdrake.components.compiled_plant.dynamics import PlantDynamics
from vtbdrake.components.compiled_plant.links import (
    UnsupportedPlantError,
    colliding,
    constant_pose,
    rounding_beside,
    times,
)
from vtbdrake.components.compiled_plant.touching import can_touch, is_iterated, touch

Expression = Any  # casadi.SX

_APPROXIMATIONS = (DiscreteContactApproximation.kSap, DiscreteContactApproximation.kLagged)


@dataclass(frozen=True)
class Surface:
    """A collision geometry G.

    Attributes:
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
        dissipation = "hunt_crossley_dissipation" if is_lagged(plant) else "relaxation_time"
        self._kinds = "point_contact_stiffness", dissipation

    def surface(self, geometry: GeometryId, body: RigidBody) -> Surface:
        """Return the geometry with an id on a body."""
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
            hull = inspector.GetConvexHull(geometry)
            vertices = np.array([hull.vertex(k) for k in range(hull.num_vertices())])
        return Surface(name, int(body.index()), shape, X_BG, stiffness, dissipation, friction, vertices)


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
        pairs: What may touch.
    """

    def __init__(self, plant: MultibodyPlant, model: PlantDynamics, pairs: Sequence[Pair]) -> None:
        self._model, self.pairs = model, tuple(pairs)
        self._is_lagged = is_lagged(plant)

    def is_iterated(self) -> bool:
        """Return whether Drake iterates for a pair, and ends elsewhere if a pose is rounded otherwise."""
        return any(is_iterated(pair.first.shape, pair.second.shape) for pair in self.pairs)

    def materials(self) -> np.ndarray:
        """Return stiffness, dissipation and friction of each pair, shape (n, 3); see `Pair.material`."""
        return np.array([pair.material(is_lagged=self._is_lagged) for pair in self.pairs]).reshape(-1, 3)

    def places(self) -> list[list[int]]:
        """Return the places of the velocities that move each pair."""
        return [sorted({*self._model.way(pair.first.body), *self._model.way(pair.second.body)}) for pair in self.pairs]

    def forces_on(self, body: int, forces: Expression, q: Expression) -> Iterator[tuple[Expression, Expression]]:
        """Yield the contact forces on a body: where they act, and what they are; both in the world, shape (3, 1).

        Args:
            body: Index of the body.
            forces: The contact forces of `SapSolver.step`.
            q: Positions before the step, shape (nq, 1).
        """
        for i, pair in enumerate(self.pairs):
            for surface, sign in ((pair.first, 1.0), (pair.second, -1.0)):
                if surface.body == body:
                    yield self._meet(pair, q)[0], sign * forces[:, i]

    # -- where it touches

    def _meet(self, pair: Pair, q: Expression) -> tuple[Expression, Expression, Expression]:
        """Return the point of contact and the normal from the first to the second, in the world, and the distance."""
        first, second = pair.first, pair.second
        poses = self._pose(first, q), self._pose(second, q)
        on_first, n, distance = touch(first.shape, poses[0], second.shape, poses[1], (first.vertices, second.vertices))
        on_second = on_first - distance * n
        share = np.array([first.stiffness, second.stiffness]) / (first.stiffness + second.stiffness)
        return share[0] * on_first + share[1] * on_second, -n, distance

    def touch(self, pair: Pair, q: Expression) -> tuple[Expression, Expression, Expression]:
        """Return Jacobian, normal and distance of a pair.

        Args:
            pair: The pair.
            q: Positions, shape (nq, 1).

        Returns:
            The Jacobian of the velocity of the second geometry against the first, at the point of contact, shape
            (3, nv); the normal from the first into the second, shape (3, 1), both in the world; and the distance in m,
            below 0 in contact.
        """
        point, normal, distance = self._meet(pair, q)
        J = self._model.point_jacobian(pair.second.body, point, q) - self._model.point_jacobian(
            pair.first.body, point, q
        )
        return J, normal, distance

    def _pose(self, surface: Surface, q: Expression) -> tuple[Expression, Expression]:
        rounding = rounding_beside(np.max(np.abs(surface.X_BG.translation())))
        return times(self._model.body_pose(surface.body, q), constant_pose(surface.X_BG, rounding))
