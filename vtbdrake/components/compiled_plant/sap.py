"""One step of a discrete plant, solved as Drake's SAP does: contact, stops of joints, PD controllers of actuators."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files
from typing import Any, NamedTuple

import casadi
import numpy as np
from numpy.typing import ArrayLike
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import JointActuator

from vtbdrake.components.casadi_system.compiler import compiled_kernel, kernel_signature
from vtbdrake.components.compiled_plant.contact import Contacts, PointContact, is_lagged
from vtbdrake.components.compiled_plant.dynamics import PlantDynamics
from vtbdrake.state.multibody import bodies

Expression = Any  # casadi.SX

# m/s, MultibodyPlantConfig's default; a plant does not tell its own. Used by lagged friction.
_STICTION_TOLERANCE = 1e-4


@dataclass(frozen=True)
class JointStops:
    """The stops of a joint of one degree of freedom.

    Attributes:
        q: Place of its position among the plant's positions.
        v: Place of its velocity among the plant's velocities.
        lower: The least position, in rad or m; -inf if there is none.
        upper: The largest position, in rad or m; inf if there is none.
    """

    q: int
    v: int
    lower: float
    upper: float


@dataclass(frozen=True)
class Drive:
    """An actuator with a PD controller that has a desired state.

    Attributes:
        u: Place of the actuator in the plant's actuation.
        q: Place of its joint's position among the plant's positions.
        v: Place of its joint's velocity among the plant's velocities.
        p: Gain of the position, in N m/rad or N/m.
        d: Gain of the velocity, in N m s/rad or N s/m.
        effort_limit: Largest torque or force, in N m or N; inf if there is none.
    """

    u: int
    q: int
    v: int
    p: float
    d: float
    effort_limit: float

    @classmethod
    def of(cls, actuator: JointActuator) -> Drive:
        """Return the drive of an actuator with a controller."""
        joint, gains = actuator.joint(), actuator.get_controller_gains()
        return cls(
            int(actuator.input_start()),
            joint.position_start(),
            joint.velocity_start(),
            gains.p,
            gains.d,
            actuator.effort_limit(),
        )


class Solution(NamedTuple):
    """Results of one step of a plant.

    Attributes:
        v_next: Velocities after the step, shape (nv, 1).
        forces: Forces on the other geometry of each of the pairs in contact, in the world, shape (3, n), in N.
        efforts: Actuation of the drives, feed-forward included and within the effort limits, shape (m, 1), in N m or N.
        doubt: Positive where the iteration did not converge, or a sphere touches too many pieces of ground.
        contacts: The contacts that were taken into account.
    """

    v_next: Expression
    forces: Expression
    efforts: Expression
    doubt: Expression
    contacts: Contacts


def stops(plant: MultibodyPlant) -> tuple[JointStops, ...]:
    """Return the joints of a plant that have stops."""
    joints = (plant.get_joint(index) for index in plant.GetJointIndices())
    limited = (
        (joint, joint.position_lower_limits()[0], joint.position_upper_limits()[0])
        for joint in joints
        if joint.num_positions() == joint.num_velocities() == 1
    )
    return tuple(
        JointStops(joint.position_start(), joint.velocity_start(), float(lower), float(upper))
        for joint, lower, upper in limited
        if np.isfinite(lower) or np.isfinite(upper)
    )


class SapSolver:
    """The step of a plant, in C; without contact, it has derivatives.

    Args:
        plant: The discrete plant, finalized.
        model: The plant's equations.
        contact: What may touch.
        drives: The actuators with a PD controller that has a desired state.

    Raises:
        CompilerError: There is no C compiler, or it fails.
    """

    def __init__(
        self, plant: MultibodyPlant, model: PlantDynamics, contact: PointContact, drives: Sequence[Drive] = ()
    ) -> None:
        self._plant, self._model, self._contact = plant, model, contact
        self._stops, self._drives = stops(plant), tuple(drives)
        self._kernel = compiled_kernel(*self._source())

    def step(
        self,
        q: Expression,
        v: Expression,
        tau: Expression,
        *,
        desired: Expression = None,
        feed_forward: Expression | None = None,
        terrain: Expression = 0.0,
    ) -> Solution:
        """Return the velocities after one step, with the forces of contact and actuators.

        Args:
            q: Positions, shape (nq, 1).
            v: Velocities, shape (nv, 1).
            tau: Generalized forces, without contact, stops and drives, shape (nv, 1).
            desired: Desired positions and velocities of the drives, shape (m, 2); needed if there are some.
            feed_forward: Actuation that is added to the drives' controllers, shape (m, 1); by default none.
            terrain: The number of the terrain, see `PointContact.contacts`.
        """
        drives, contacts = self._drives, self._contact.contacts(q, terrain)
        A, p_star = self._model.momentum_balance(q, v, tau, self._plant.time_step())
        pulls = [d.p * (desired[k, 0] - q[d.q]) + d.d * desired[k, 1] for k, d in enumerate(drives)]
        arguments = (
            A,
            p_star,
            v,
            contacts.J_bodies,
            contacts.normals,
            contacts.distances,
            *contacts.material,
            q[[stop.q for stop in self._stops]],
            casadi.vertcat(casadi.SX(0, 1), *pulls),
            casadi.SX.zeros(len(drives), 1) if feed_forward is None else feed_forward,
            contacts.origins,
            contacts.points,
        )
        v_next, forces, efforts, doubt = self._kernel(*map(casadi.densify, arguments))
        forces = casadi.reshape(forces, 3, contacts.distances.numel())
        return Solution(v_next, forces, efforts, casadi.fmax(doubt, contacts.doubt), contacts)

    def _source(self) -> tuple[str, str]:
        """Return the name and the C code of the kernel for this plant."""
        nv, stops, drives = self._model.nv, self._stops, self._drives
        places, count = self._contact.places(), len(self._contact.bodies)
        n, bodies_of = len(places), [self._model.way(int(body.index())) for body in bodies(self._plant)]
        trees = [_elimination_tree(cliques, nv) for cliques in (bodies_of, [*bodies_of, *places])]
        ways = [[_way(parents, row) for row in range(nv)] for parents in trees]
        text = "".join(
            (
                f"#include <math.h>\n#define NV {nv}\n#define NB {count}\n#define NC {n}\n#define NS {len(stops)}\n",
                f"#define ND {len(drives)}\n#define LAGGED {int(is_lagged(self._plant))}\n",
                f"#define DT {self._plant.time_step()!r}\n#define VS {_STICTION_TOLERANCE!r}\n",
                f"#define BETA {self._plant.get_sap_near_rigid_threshold()!r}\n",
                f"static const int DEPTH[2][NV + 1] = {{{', '.join(_row([*map(len, each), 0]) for each in ways)}}};\n",
                f"static const int WAY[2][NV + 1][NV + 1] = {{{', '.join(_rows(each) for each in ways)}}};\n",
                _table("int TREE", self._trees()),
                f"static const int SIDES[NC + 1][2] = {_rows(self._contact.sides())};\n",
                _table("int COUNT", [len(row) for row in places]),
                f"static const int COLUMNS[NC + 1][NV] = {_rows(places)};\n",
                _table("int IS_BETWEEN", [int(not _is_on_way(row, ways[0])) for row in places]),
                _table("int STOP", [stop.v for stop in stops]),
                _table("double LOWER", [stop.lower for stop in stops]),
                _table("double UPPER", [stop.upper for stop in stops]),
                _table("int DRIVE", [drive.v for drive in drives]),
                _table("double KP", [drive.p for drive in drives]),
                _table("double KD", [drive.d for drive in drives]),
                _table("double EFFORT", [drive.effort_limit for drive in drives]),
                files(__package__).joinpath("sap.c").read_text(encoding="utf-8"),
            )
        )
        m = len(drives)
        shapes_in = [
            (nv, nv),
            (nv, 1),
            (nv, 1),
            (6 * count, nv),
            (3, n),
            *[(n, 1)] * 4,
            (len(stops), 1),
            (m, 1),
            (m, 1),
        ]
        shapes_in += [(3, count), (3, n)]
        shapes_out = [(nv, 1), (3, n), (m, 1), (1, 1)]
        name = f"sap_{hashlib.sha256(text.encode()).hexdigest()[:16]}"
        source = f"#define NAME {name}\n{text}{kernel_signature(name, shapes_in, shapes_out)}"
        if n:
            return name, source
        jacobian = files(__package__).joinpath("sap_jacobian.c").read_text(encoding="utf-8")
        blocks = [(a * b, c * d) for a, b in shapes_out for c, d in shapes_in]
        signature = kernel_signature(f"jac_{name}", [*shapes_in, *shapes_out], blocks)
        return name, f"{source}\n#define JACOBIAN jac_{name}\n{jacobian}{signature}"

    def _trees(self) -> list[int]:
        """Return the number of the tree of each velocity: bodies that joints connect without the world."""
        numbers = list(range(self._plant.num_bodies()))
        for index in self._plant.GetJointIndices():
            joint = self._plant.get_joint(index)
            ends = [int(body.index()) for body in (joint.parent_body(), joint.child_body())]
            if int(self._plant.world_body().index()) not in ends:
                first, second = (numbers[end] for end in ends)
                numbers = [first if number == second else number for number in numbers]
        trees: dict[int, int] = {}
        for body in bodies(self._plant):
            for place in self._model.way(int(body.index())):
                trees[place] = numbers[int(body.index())]
        order = sorted(set(trees.values()))
        return [order.index(trees[place]) for place in range(self._model.nv)]


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


def _way(parents: Sequence[int], row: int) -> list[int]:
    """Return the rows on the way from a row to the root, without itself."""
    way = []
    while (row := parents[row]) >= 0:
        way.append(row)
    return way


def _is_on_way(places: Sequence[int], ways: Sequence[Sequence[int]]) -> bool:
    """Return whether sorted places lie on the way from the last of them to the root."""
    return not places or set(places[:-1]) <= set(ways[places[-1]])


def _rows(rows: Sequence[Sequence[int]]) -> str:
    """Return the C initializer of a table, with a row of 0 at its end."""
    return f"{{{', '.join(map(_row, [*rows, [0]]))}}}"


def _row(numbers: ArrayLike) -> str:
    """Return numbers as a C initializer, which is never empty."""
    return f"{{{', '.join(str(x).replace('inf', 'INFINITY') for x in np.asarray(numbers).tolist()) or '0'}}}"


def _table(declarator: str, numbers: Sequence[float]) -> str:
    """Return the C definition of a constant array, with a 0 at its end."""
    return f"static const {declarator}[{len(numbers) + 1}] = {_row([*numbers, 0])};\n"
