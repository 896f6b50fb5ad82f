r"""The torques of a fixed-base plant as a linear function of its inertial parameters and friction, tau = Y(q, v, a) p.

p has more entries than any motion can tell apart. Those that can be told, the base parameters b = p_1 + beta p_2, are
named in words (W. Khalil and E. Dombre, "Modeling, Identification and Control of Robots", 2002, chapter 12).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import casadi
import numpy as np
import scipy
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import Context

from vtbdrake.calibration.joint_model import CalibrationError
from vtbdrake.common.arrays import Array
from vtbdrake.components.casadi_system.kernel import Expression
from vtbdrake.components.compiled_plant import PlantDynamics
from vtbdrake.state.multibody import bodies, element_address
from vtbdrake.testbed.inertia import INERTIA_SIZE

# Names of the inertial parameters of a body: about its origin, in its frame.
INERTIAL = ("m", "mx", "my", "mz", "Ixx", "Iyy", "Izz", "Ixy", "Ixz", "Iyz")
Term = Callable[[Array, Array, Array], Array]
_RANK = 1e-7  # of a column of the regressor that adds nothing, relative to its norm


@dataclass(frozen=True)
class DriveModel:
    """What acts on the joints along a direction, linear in parameters: a motor with its friction, or a spring.

    Attributes:
        direction: Its rate is direction' v, and it acts with direction * torque, (nq,). A motor that a wrist couples to
            two joints has two entries.
        terms: Functions of its angle (rad), rate and acceleration, (n,) each, that its parameters multiply.
    """

    direction: Array
    terms: Mapping[str, Term]


def friction(
    *, coulomb_velocity: float = 0.01, stribeck_velocity: float | None = None, offset: bool = True, rotor: bool = True
) -> dict[str, Term]:
    """Return the terms of a motor: viscous and Coulomb friction, and as asked the others.

    The two velocities are fixed: the torques are not linear in them, and a recording hardly tells them.

    Args:
        coulomb_velocity: Width v_c of Coulomb's friction tanh(v / v_c), in rad/s.
        stribeck_velocity: Range v_s of the friction tanh(v / v_c) exp(-(v / v_s)^2) that a slow motion has in addition.
        offset: A constant torque.
        rotor: The reflected inertia of the motor.
    """

    def sign(rate: Array) -> Array:
        return np.asarray(np.tanh(rate / coulomb_velocity))

    terms: dict[str, Term] = {
        "viscous": lambda angle, rate, acceleration: rate,
        "coulomb": lambda angle, rate, acceleration: sign(rate),
    }
    if stribeck_velocity is not None:
        width = stribeck_velocity
        terms["stribeck"] = lambda angle, rate, acceleration: sign(rate) * np.exp(-((rate / width) ** 2))
    if offset:
        terms["offset"] = lambda angle, rate, acceleration: np.ones_like(rate)
    if rotor:
        terms["rotor"] = lambda angle, rate, acceleration: acceleration
    return terms


class TorqueRegressor:
    """The torques of a plant as tau = Y(q, v, a) p.

    Args:
        plant: A finalized plant with a fixed base, which can be compiled.
        context: The plant's own Context; the default one by default.
        drives: What acts beside the bodies, by name; by default, `friction` at each joint. The plant's own damping and
            reflected inertia are not part of the torques: they are terms of drives.

    Attributes:
        nq: Number of joints.
        bodies: Names of the bodies.
        names: Names of the entries of p: ten of each body, then the drives' entries.
        nominal: p of the plant, with zeros for the drives.

    Raises:
        CalibrationError: The plant cannot be compiled, has a floating joint, or a direction has another size.
    """

    def __init__(
        self, plant: MultibodyPlant, context: Context | None = None, *, drives: Mapping[str, DriveModel] | None = None
    ) -> None:
        context = plant.CreateDefaultContext() if context is None else context
        carried = [body for body in bodies(plant) if not plant.IsAnchored(body)]
        addresses = [element_address(plant, body) for body in carried]
        short = [body.name() for body in carried]
        self.bodies = tuple(short if len(set(short)) == len(short) else addresses)
        inputs = [[f"{address}.{part}" for part in ("mass", "center_of_mass", "inertia")] for address in addresses]
        try:
            dynamics = PlantDynamics(plant, context, inputs=[name for parts in inputs for name in parts])
        except ValueError as error:
            raise CalibrationError(str(error)) from error
        if dynamics.nq != dynamics.nv:
            raise CalibrationError("a floating joint has no torques to be regressed: fix the base")
        self.nq = dynamics.nq
        if drives is None:
            joints = [plant.get_joint(index) for index in plant.GetJointIndices()]
            places = {joint.name(): joint.position_start() for joint in joints if joint.num_positions()}
            drives = {name: DriveModel(np.eye(self.nq)[k], friction()) for name, k in places.items()}
        for name, drive in drives.items():
            if np.shape(drive.direction) != (self.nq,):
                raise CalibrationError(
                    f"the direction of {name} has the shape {np.shape(drive.direction)}, not ({self.nq},)"
                )
        self._drives = dict(drives)
        self.names = tuple(
            [f"{body}.{name}" for body in self.bodies for name in INERTIAL]
            + [f"{name}.{term}" for name, drive in drives.items() for term in drive.terms]
        )
        inertial = [_inertial_parameters(*(dynamics.values[name] for name in parts)) for parts in inputs]
        self.nominal = np.concatenate([*inertial, np.zeros(len(self.names) - INERTIA_SIZE * len(self.bodies))])
        self._regressor = self._compile(dynamics, inputs)

    def _compile(self, dynamics: PlantDynamics, inputs: Sequence[Sequence[str]]) -> casadi.Function:
        """Return the function (q, v, a) -> columns of Y for the bodies."""
        q, v, _ = dynamics.symbols()
        a = casadi.SX.sym("a", self.nq)
        p = casadi.SX.sym("p", INERTIA_SIZE * len(self.bodies))
        values: dict[str, Expression] = {}
        for k, names in enumerate(inputs):
            values |= dict(zip(names, mass_properties(p[INERTIA_SIZE * k : INERTIA_SIZE * (k + 1)]), strict=True))
        (tau,) = dynamics.substituted([dynamics.inverse_dynamics(q, v, a, rotors=False)], values)
        # Linear in p, so that its Jacobian is the same everywhere: here where masses are 1, as they divide.
        Y = casadi.substitute(casadi.jacobian(tau, p), p, np.tile(np.eye(INERTIA_SIZE)[0], len(self.bodies)))
        return casadi.Function("regressor", [q, v, a], [casadi.densify(Y)], {"cse": True})

    def matrix(self, q: Array, v: Array, a: Array) -> Array:
        """Return Y (n, nq, P) for positions, velocities and accelerations (n, nq).

        Args:
            q: Positions, (n, nq), in rad or m.
            v: Velocities, (n, nq), in rad/s or m/s.
            a: Accelerations, (n, nq), in rad/s^2 or m/s^2.
        """
        n = len(q)
        columns = np.asarray(self._regressor.map(n)(q.T, v.T, a.T)).reshape(self.nq, n, -1).swapaxes(0, 1)
        parts = [columns]
        for drive in self._drives.values():
            d = drive.direction
            factors = [term(q @ d, v @ d, a @ d) for term in drive.terms.values()]
            parts += [np.einsum("n,j->nj", factor, d)[:, :, np.newaxis] for factor in factors]
        return np.concatenate(parts, axis=2)

    def vector(self, values: Mapping[str, float]) -> Array:
        """Return p of the plant, with other values for the named entries.

        Raises:
            CalibrationError: A name is no entry of p.
        """
        p = self.nominal.copy()
        for name, value in values.items():
            if name not in self.names:
                raise CalibrationError(f"{name} is no parameter; the parameters are {', '.join(self.names)}")
            p[self.names.index(name)] = value
        return p


def _inertial_parameters(mass: Array, com: Array, inertia: Array) -> Array:
    """Return the ten parameters of a body from mass, centre of mass and moments about it [xx, yy, zz, xy, xz, yz]."""
    x, y, z = com
    shift = mass * np.array([y * y + z * z, x * x + z * z, x * x + y * y, -x * y, -x * z, -y * z])
    return np.concatenate([mass, mass * com, inertia + shift])


def mass_properties(p: Expression) -> tuple[Expression, Expression, Expression]:
    """Return mass, centre of mass and moments [xx, yy, zz, xy, xz, yz] about it, from the ten parameters of a body."""
    m = p[0]
    x, y, z = (p[k] / m for k in (1, 2, 3))
    shift = [y * y + z * z, x * x + z * z, x * x + y * y, -x * y, -x * z, -y * z]
    return m, casadi.vertcat(x, y, z), casadi.vertcat(*(p[4 + k] - m * s for k, s in enumerate(shift)))


@dataclass(frozen=True, eq=False)
class BaseParameters:
    """The combinations b = B p of the parameters of a model that motions can tell.

    Attributes:
        names: Each combination, in words.
        columns: Which parameter leads each combination: Y[:, columns] b = Y p, for all motions.
        B: (b, P).
    """

    names: tuple[str, ...]
    columns: tuple[int, ...]
    B: Array


def base_parameters(model: TorqueRegressor) -> BaseParameters:
    """Return the base parameters of a model, by its regressor at random states.

    Going from the base to the tip, a column of Y that depends on those before (its diagonal entry in a QR
    decomposition is zero) is not kept: its parameter is added to theirs.

    Raises:
        CalibrationError: The numerical rank is not clear.
    """
    samples = 20 + 4 * len(model.names) // model.nq
    states = np.random.default_rng(0).uniform(-np.pi, np.pi, (3, samples, model.nq))
    Y = model.matrix(*states).reshape(-1, len(model.names))
    norms = np.linalg.norm(Y, axis=0)
    moving = np.flatnonzero(norms > _RANK * norms.max())
    Y = Y[:, moving] / norms[moving]
    diagonal = abs(np.diag(np.linalg.qr(Y, mode="r")))
    rank = int((scipy.linalg.svdvals(Y) > _RANK * np.sqrt(len(moving))).sum())
    kept_columns = np.flatnonzero(diagonal > _RANK)
    if len(kept_columns) != rank:
        raise CalibrationError(
            f"the rank of the regressor is not clear: {len(kept_columns)} by QR, {rank} by its singular values"
        )
    beta = np.linalg.lstsq(Y[:, kept_columns], Y, rcond=None)[0]
    B = np.zeros((rank, len(model.names)))
    B[:, moving] = np.where(abs(beta) < 1e-6, 0.0, beta) / norms[moving][kept_columns, np.newaxis] * norms[moving]
    # Relative to what the parameters do, these are rounding errors.
    B[abs(B) < 1e-9] = 0.0
    columns = tuple(int(k) for k in moving[kept_columns])
    return BaseParameters(tuple(_words(row, model.names, k) for row, k in zip(B, columns, strict=True)), columns, B)


def _words(row: Array, names: Sequence[str], leader: int) -> str:
    """Return a combination in words, such as "upper.Iyy + 0.04 lower.m"."""
    rest = [int(k) for k in np.flatnonzero(row) if k != leader]
    terms = [names[leader]]
    for k in rest:
        size = f"{abs(row[k]):.4g} " if abs(abs(row[k]) - 1.0) > 1e-6 else ""
        terms.append(f"{'-' if row[k] < 0.0 else '+'} {size}{names[k]}")
    return " ".join(terms)
