"""Point contact of a discrete plant: spheres against half-spaces, boxes and spheres, solved as Drake's SAP does."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib.resources import files
from typing import Any

import casadi
import numpy as np
from pydrake.geometry import Box, GeometryId, HalfSpace, SceneGraphInspector, Shape, Sphere
from pydrake.math import RigidTransform
from pydrake.multibody.plant import ContactModel, DiscreteContactApproximation, MultibodyPlant
from pydrake.multibody.tree import RigidBody
from pydrake.systems.framework import Context

from vtbdrake.components.casadi_system.compiler import compiled_kernel
from vtbdrake.components.compiled_plant.dynamics import PlantDynamics
from vtbdrake.components.compiled_plant.links import (
    UnsupportedPlantError,
    colliding,
    constant_pose,
    rounding_beside,
    times,
)
from vtbdrake.state.multibody import bodies

Expression = Any  # casadi.SX

_APPROXIMATIONS = (DiscreteContactApproximation.kSap, DiscreteContactApproximation.kLagged)
# m/s, MultibodyPlantConfig's default; a plant does not tell its own. Used by lagged friction.
_STICTION_TOLERANCE = 1e-4
_OTHERS = (Sphere, HalfSpace, Box)


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
    """

    name: str
    body: int
    shape: Shape
    X_BG: RigidTransform
    stiffness: float
    dissipation: float
    friction: float


@dataclass(frozen=True)
class Pair:
    """Two geometries that may touch.

    Attributes:
        sphere: One of them, a sphere.
        other: The other one.
    """

    sphere: Surface
    other: Surface

    def material(self, *, is_lagged: bool) -> tuple[float, float, float]:
        """Return stiffness, dissipation and friction of both together, as Drake combines them."""
        a, b = self.sphere, self.other
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
    in_order = sorted(candidates, key=lambda pair: [geometry.get_value() for geometry, _ in pair])
    return tuple(_pair(*(reader.surface(geometry, body) for geometry, body in pair)) for pair in in_order)


class _SurfaceReader:
    """Reads collision geometries with what their contact takes."""

    def __init__(self, plant: MultibodyPlant, inspector: SceneGraphInspector) -> None:
        self._plant, self._inspector = plant, inspector
        dissipation = "hunt_crossley_dissipation" if _is_lagged(plant) else "relaxation_time"
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
        return Surface(name, int(body.index()), shape, X_BG, stiffness, dissipation, friction)


def _pair(first: Surface, second: Surface) -> Pair:
    for sphere, other in ((first, second), (second, first)):
        if isinstance(sphere.shape, Sphere) and isinstance(other.shape, _OTHERS):
            return Pair(sphere, other)
    raise UnsupportedPlantError(
        f"contact of {first.name} ({type(first.shape).__name__}) and {second.name} ({type(second.shape).__name__}) "
        "is not compiled: let a Sphere touch a HalfSpace, a Box or a Sphere, or exclude the two by a "
        "CollisionFilterDeclaration"
    )


def _is_lagged(plant: MultibodyPlant) -> bool:
    return plant.get_discrete_contact_approximation() == DiscreteContactApproximation.kLagged


class PointContact:
    """The contact of a plant, and one step with it.

    Args:
        plant: The discrete plant, finalized.
        model: The plant's equations.
        pairs: What may touch, see `contact_pairs`; at least one.

    Attributes:
        pairs: What may touch.

    Raises:
        CompilerError: There is no C compiler, or it fails.
    """

    def __init__(self, plant: MultibodyPlant, model: PlantDynamics, pairs: Sequence[Pair]) -> None:
        self._is_lagged = _is_lagged(plant)
        self._plant, self._model, self.pairs = plant, model, tuple(pairs)
        self._kernel = compiled_kernel(*self._source())

    def step(self, q: Expression, v: Expression, tau: Expression) -> tuple[Expression, Expression, Expression]:
        """Return the velocities after one step, the contact forces, and the doubt.

        Args:
            q: Positions, shape (nq, 1).
            v: Velocities, shape (nv, 1).
            tau: Generalized forces, without contact, shape (nv, 1).

        Returns:
            The velocities, shape (nv, 1); the forces on the other geometry of each of the pairs, in the world, shape
            (3, n), in N; and a number that is positive where the solver did not converge.
        """
        period = self._plant.time_step()
        A, p_star = self._model.momentum_balance(q, v, tau, period)
        J, normals, distances = zip(*(self.touch(pair, q) for pair in self.pairs), strict=True)
        material = casadi.DM(np.array([pair.material(is_lagged=self._is_lagged) for pair in self.pairs]))
        arguments = (
            A, p_star, v, casadi.vertcat(*J), casadi.horzcat(*normals), casadi.vertcat(*distances),
            *casadi.horzsplit(casadi.SX(material)),
        )  # fmt: skip
        v_next, forces, doubt = self._kernel(*map(casadi.densify, arguments))
        return v_next, forces, doubt

    def forces_on(self, body: int, forces: Expression, q: Expression) -> Iterator[tuple[Expression, Expression]]:
        """Yield the contact forces on a body: where they act, and what they are; both in the world, shape (3, 1).

        Args:
            body: Index of the body.
            forces: The forces of `step`.
            q: Positions before the step, shape (nq, 1).
        """
        for i, pair in enumerate(self.pairs):
            for surface, sign in ((pair.sphere, 1.0), (pair.other, -1.0)):
                if surface.body == body:
                    yield self._meet(pair, q)[0], sign * forces[:, i]

    # -- where it touches

    def _meet(self, pair: Pair, q: Expression) -> tuple[Expression, Expression, Expression]:
        """Return the point of contact and the normal from the sphere into the other, in the world, and the distance."""
        _, center = self._pose(pair.sphere, q)
        R, p = self._pose(pair.other, q)
        radius, shape = pair.sphere.shape.radius(), pair.other.shape
        if isinstance(shape, Sphere):
            n, distance = _from_point(center - p)
            distance -= shape.radius()
        elif isinstance(shape, HalfSpace):
            n = R[:, 2]
            distance = casadi.dot(n, center - p)
        else:
            n, distance = _from_box(R.T @ (center - p), shape.size() / 2)
            n = R @ n
        on_sphere = center - radius * n
        distance -= radius
        on_other = on_sphere - distance * n
        stiffnesses = np.array([pair.sphere.stiffness, pair.other.stiffness])
        share = stiffnesses / stiffnesses.sum()
        return share[0] * on_sphere + share[1] * on_other, -n, distance

    def touch(self, pair: Pair, q: Expression) -> tuple[Expression, Expression, Expression]:
        """Return Jacobian, normal and distance of a pair.

        Args:
            pair: The pair.
            q: Positions, shape (nq, 1).

        Returns:
            The Jacobian of the velocity of the other geometry against the sphere, at the point of contact, shape
            (3, nv); the normal from the sphere into the other, shape (3, 1), both in the world; and the distance in m,
            below 0 in contact.
        """
        point, normal, distance = self._meet(pair, q)
        J = self._model.point_jacobian(pair.other.body, point, q) - self._model.point_jacobian(
            pair.sphere.body, point, q
        )
        return J, normal, distance

    def _pose(self, surface: Surface, q: Expression) -> tuple[Expression, Expression]:
        rounding = rounding_beside(np.max(np.abs(surface.X_BG.translation())))
        return times(self._model.body_pose(surface.body, q), constant_pose(surface.X_BG, rounding))

    # -- the solver

    def _source(self) -> tuple[str, str]:
        """Return the name and the C code of the kernel for this plant."""
        nv, n = self._model.nv, len(self.pairs)
        columns = [
            sorted({*self._model.way(pair.sphere.body), *self._model.way(pair.other.body)}) for pair in self.pairs
        ]
        rows = (f"{{{', '.join(map(str, row))}}}" for row in columns)
        parents = ", ".join(map(str, _elimination_tree([*map(self._model.way, self._bodies()), *columns], nv)))
        threshold = self._plant.get_sap_near_rigid_threshold()
        text = (
            f"#define NV {nv}\n#define NC {n}\n#define LAGGED {int(self._is_lagged)}\n"
            f"#define DT {self._plant.time_step()!r}\n#define BETA {threshold!r}\n#define VS {_STICTION_TOLERANCE!r}\n"
            f"static const int PARENT[NV] = {{{parents}}}, COUNT[NC] = {{{', '.join(str(len(c)) for c in columns)}}};\n"
            f"static const int COLUMNS[NC][NV] = {{{', '.join(rows)}}};\n"
            + files(__package__).joinpath("sap.c").read_text(encoding="utf-8")
        )
        name = f"sap_{hashlib.sha256(text.encode()).hexdigest()[:16]}"
        shapes_in = [(nv, nv), (nv, 1), (nv, 1), (3 * n, nv), (3, n), (n, 1), (n, 1), (n, 1), (n, 1)]
        return name, f"#define NAME {name}\n{text}{_signature(name, shapes_in, [(nv, 1), (3, n), (1, 1)])}"

    def _bodies(self) -> list[int]:
        return [int(body.index()) for body in bodies(self._plant)]


def _from_point(d: Expression) -> tuple[Expression, Expression]:
    """Return the direction of d, and its length."""
    length = casadi.sqrt(casadi.sumsqr(d))
    return d / length, length


def _from_box(p: Expression, half: np.ndarray) -> tuple[Expression, Expression]:
    """Return the normal of a box at its point that is nearest to p, and the distance of p, below 0 inside.

    Args:
        p: The point in the box's frame, shape (3, 1).
        half: Half of the box's size, shape (3,), in m.
    """
    nearest = casadi.fmin(casadi.fmax(p, -half), half)
    outside, length = _from_point(p - nearest)
    # Inside, it is the nearest face.
    depth, inside = casadi.SX(np.inf), casadi.SX(3, 1)
    for axis in range(3):
        below = half[axis] - casadi.fabs(p[axis])
        face = casadi.SX(casadi.DM(np.eye(3)[axis])) * casadi.if_else(p[axis] < 0, -1, 1)
        inside = casadi.if_else(below < depth, face, inside)
        depth = casadi.fmin(depth, below)
    is_inside = depth >= 0
    return casadi.if_else(is_inside, inside, outside), casadi.if_else(is_inside, -depth, length)


def _elimination_tree(cliques: Sequence[Sequence[int]], size: int) -> list[int]:
    """Return the row next to each on the way to the root, -1 at a root, where rows of a clique are coupled.

    Rows are eliminated from the last one on; what fills in lies on the ways.
    """
    coupled: list[set[int]] = [set() for _ in range(size)]
    for clique in cliques:
        for row in clique:
            coupled[row].update(other for other in clique if other < row)
    parents = [-1] * size
    for row in reversed(range(size)):
        if coupled[row]:
            parents[row] = max(coupled[row])
            coupled[parents[row]] |= coupled[row] - {parents[row]}
    return parents


def _signature(name: str, shapes_in: Sequence[tuple[int, int]], shapes_out: Sequence[tuple[int, int]]) -> str:
    """Return the C functions that describe a function of dense matrices to CasADi."""
    parts = []
    for kind, shapes in (("in", shapes_in), ("out", shapes_out)):
        table = ", ".join(f"{{{rows}, {columns}, 1}}" for rows, columns in shapes)
        parts.append(
            f"long long int {name}_n_{kind}(void) {{ return {len(shapes)}; }}\n"
            f"const long long int *{name}_sparsity_{kind}(long long int i) {{\n"
            f"    static const long long int dense[][3] = {{{table}}};\n    return dense[i];\n}}\n"
        )
    return "\n" + "".join(parts)
