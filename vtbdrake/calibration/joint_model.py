r"""The joints of a testbed as one function of its parameters: plant and drives, written in CasADi.

The drives are `JointDrives`: they feel a command one period after it was given and hold the motor's torque during a
step, and a discrete plant feels it a step of its own later. Their friction is implicit in a discrete plant's step, and
continuous in time with a continuous plant. Other than theirs, the delay may be any time, not only whole periods.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi
import numpy as np
import scipy
from numpy.typing import ArrayLike
from pydrake.systems.framework import Context

from vtbdrake.common.argument_checks import suggestion
from vtbdrake.common.arrays import Array
from vtbdrake.components.actuators import JointDrives
from vtbdrake.components.actuators.joint_drives import FRICTION, end_velocity, friction_size, friction_torque
from vtbdrake.components.casadi_system.compiler import compiled_if_possible
from vtbdrake.components.casadi_system.kernel import Expression
from vtbdrake.components.compiled_plant import PlantDynamics
from vtbdrake.optimization import Parameter
from vtbdrake.state.systems import leaves
from vtbdrake.testbed import VirtualTestbed
from vtbdrake.testbed.inertia import INERTIA_SIZE, inertia_of

_WORLD = re.compile(r"sim\.(?:sys|env)\.(.*?)(?:\[(\d+)\])?$")
_TIMES = ("delay", "time_constant")
# The edge of Coulomb friction is the model's simplification.
_VARIED = "|".join([*(name for name in FRICTION if name != "coulomb_velocity"), *_TIMES])
_DRIVE = re.compile(rf"(sim\.act\.\w+)\.({_VARIED})(?:\[(\d+)\])?$")
_PARTS = ("mass", "center_of_mass", "inertia")
_WHOLE = "whole"
_TINY = 1e-12
# How often the friction of each joint is solved for, given the other joints'.
_SWEEPS = 3


class CalibrationError(ValueError):
    """A testbed, a log or a parameter with which nothing can be calibrated."""


@dataclass(frozen=True)
class Inertia:
    """All ten inertial parameters of a body as one parameter, which is physically consistent whatever its value.

    It is the log-Cholesky parametrization of the body's pseudo-inertia (C. Rucker and P. M. Wensing, "Smooth
    parameterization of rigid-body inertia", IEEE Robotics and Automation Letters 7, 2022): the mass is positive, and
    the moments belong to a distribution of positive masses.

    Attributes:
        address: Address of the body, such as ``sim.sys.arm.payload``.
    """

    address: str


def log_cholesky(mass: float, com: ArrayLike, inertia: ArrayLike) -> Array:
    """Return the ten numbers of a body; the inverse of `inertia_of`.

    Args:
        mass: The mass, in kg.
        com: The centre of mass p_BoBcm_B, (3,), in m.
        inertia: The moments [Ixx, Iyy, Izz, Ixy, Ixz, Iyz] about the centre of mass, in B and kg m^2.

    Raises:
        CalibrationError: No distribution of positive masses has this inertia: a point or a rod, for example.
    """
    c, (xx, yy, zz, xy, xz, yz) = np.asarray(com, dtype=float), np.asarray(inertia, dtype=float)
    I_cm = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    J = np.zeros((4, 4))
    J[:3, :3] = 0.5 * np.trace(I_cm) * np.eye(3) - I_cm + mass * np.outer(c, c)
    J[:3, 3] = J[3, :3] = mass * c
    J[3, 3] = mass
    try:
        # Upper triangular: the Cholesky factor of the matrix with its axes reversed, reversed.
        U = np.linalg.cholesky(J[::-1, ::-1])[::-1, ::-1]
    except np.linalg.LinAlgError:
        raise CalibrationError(
            f"a mass of {mass:g} kg with the moments {I_cm.diagonal().tolist()} kg m^2 is no body: the mass is "
            "positive, and no moment as large as the sum of the two others; give the model a body with some extent"
        ) from None
    alpha = np.log(U[3, 3])
    U = U / U[3, 3]
    return np.array([alpha, *np.log(U.diagonal()[:3]), U[0, 1], U[1, 2], U[0, 2], *U[:3, 3]])


def body_numbers(testbed: VirtualTestbed, context: Context, body: str) -> Array:
    """Return the ten numbers of a body in a context.

    Args:
        testbed: The testbed with the body.
        context: A root context of the testbed.
        body: Address of the body, such as ``sim.sys.arm.payload``.
    """
    mass, com, inertia = (testbed.read(context, f"{body}.{part}") for part in _PARTS)
    return log_cholesky(float(mass), com, inertia)


def at_samples(function: casadi.Function, n: int) -> Callable[..., Array]:
    """Return a function of arrays, one for each argument with n rows, that evaluates one of CasADi at all rows.

    It has a dense result of shape (r, c), and returns (n, r, c). CasADi's own matrices, which copy number by number,
    take as long as the evaluation.

    Args:
        function: The function, of vectors.
        n: The number of rows.
    """
    buffer: Any  # whose stubs ask for a size that it does not take
    buffer, evaluate = function.map(n).buffer()

    def evaluated(*arguments: Array) -> Array:
        rows = [np.ascontiguousarray(argument, dtype=float).reshape(-1) for argument in arguments]
        result = np.empty((n, *reversed(function.size_out(0))))  # CasADi's columns are rows here.
        buffer.set_res(0, result.reshape(-1).data)
        for i, row in enumerate(rows):
            buffer.set_arg(i, row.data)
        evaluate()
        return result.swapaxes(1, 2)

    return evaluated


class JointModel:
    """Plant and drives as a function of the varied parameters z.

    Args:
        testbed: The testbed. What acts on its plant beside the actuation (contact, pushes) is left out.
        parameters: The varied numbers: of the plant (``mass``, ``center_of_mass[i]``, ``inertia[i]``, ``damping``,
            ``rotor_inertia``, ``pose[i]``), and of a `JointDrives` (``viscous[i]``, ``coulomb[i]``, ``stribeck[i]``,
            ``stribeck_velocity[i]``, ``load_friction[i]``, ``asymmetry[i]``, ``time_constant``, ``delay``).
        inertias: The bodies whose inertia is varied as a whole.
        measured_torque: The torques were measured in the drives: they act at once.

    Attributes:
        names: The names of the entries of z.
        start: z in the testbed's default context.
        lower, upper: The range of each entry.
        nq, nu: Numbers of joint positions, and of actuators.
        joint_names: Names of the joints, by position.
        actuated_names: Names of the joints with actuators, by actuator.
        actuator_of: The actuator of each joint, by position; -1 without one.
        friction_parameters: The places in z of numbers of the drives' friction.
        sharpness: (q, z) -> Fc / (I v_c) of each actuator's friction near rest, (nu,), in 1/s.
        step: (x, m, h, z) -> x after a step of h seconds.
        edges: The velocity below which the Coulomb friction of a joint fades, (nq,), in rad/s or m/s.

    Raises:
        CalibrationError: A parameter is none of the model, or given twice; the plant cannot be compiled.
    """

    def __init__(
        self,
        testbed: VirtualTestbed,
        parameters: Sequence[Parameter] = (),
        inertias: Sequence[Inertia] = (),
        *,
        measured_torque: bool = False,
    ) -> None:
        if testbed.plant is None:
            raise CalibrationError("the testbed has no MultibodyPlant")
        plant, context = testbed.plant, testbed.default_context()
        plant_context = plant.CreateDefaultContext()
        plant_context.SetTimeStateAndParametersFrom(plant.GetMyContextFromRoot(context))
        self._is_measured = measured_torque
        self._read_drives(testbed, context)
        variables = testbed.variables()
        self.names: list[str] = []
        start, lower, upper = [], [], []
        for parameter in parameters:
            if not (_WORLD.match(parameter.address) or _DRIVE.match(parameter.address)):
                raise CalibrationError(
                    f"{parameter.address} is no parameter of a plant (sim.sys....) or of JointDrives (sim.act....)"
                    f"{suggestion(parameter.address, list(variables))}"
                )
            if parameter.integer:
                raise CalibrationError(f"{parameter.address} is an integer: the fit takes continuous parameters")
            try:
                parameter.find(variables)
            except ValueError as error:
                raise CalibrationError(str(error)) from error
            if (match := _DRIVE.match(parameter.address)) and match[2] in _TIMES:
                if measured_torque:
                    raise CalibrationError(f"{parameter.address} is not seen in torques that were measured")
                self._drive_names.append(match[2])
                self.drive_parameters.append(len(self.names))
            self.names.append(parameter.address)
            start.append(float(testbed.read(context, parameter.address)))
            lower.append(float(parameter.lower))
            upper.append(float(parameter.upper))
        self.scalars = len(self.names)
        self.bodies = tuple(inertia.address for inertia in inertias)
        for body in self.bodies:
            self.names += [f"{body}.z[{k}]" for k in range(INERTIA_SIZE)]
            start += body_numbers(testbed, context, body).tolist()
        if doubled := {name for name in self.names if self.names.count(name) > 1}:
            raise CalibrationError(f"given twice: {', '.join(sorted(doubled))}")
        infinite = [np.inf] * (len(self.names) - self.scalars)
        self.start = np.array(start)
        self.lower = np.array([*lower, *(-np.array(infinite))])
        self.upper = np.array([*upper, *infinite])
        self._check_ranges()
        self._build(testbed, context, plant, plant_context)

    @property
    def scales(self) -> Array:
        """Return the scales of the parameters: half of a range, and 1 for the numbers of an inertia."""
        half = 0.5 * (self.upper - self.lower)
        return np.where(np.isfinite(half), half, 1.0)

    @cached_property
    def step_with_jacobians(self) -> casadi.Function:
        """Return (x, m, h, z) -> following x, and its Jacobians by x, m and z, side by side, compiled if possible."""
        x, m, h, z = self.step.sx_in()
        following = self.step(x, m, h, z)
        parts = [following, *(casadi.jacobian(following, by) for by in (x, m, z))]
        table = casadi.densify(casadi.horzcat(*parts))
        return compiled_if_possible(casadi.Function("calibration_step", [x, m, h, z], [table], {"cse": True}))

    @property
    def varies_delay(self) -> bool:
        """Return whether the delay of the drives is one of the parameters."""
        return "delay" in self._drive_names

    @property
    def drive_times(self) -> dict[str, int]:
        """Return the places in z of those that are varied of the drives' ``delay`` and ``time_constant``."""
        return dict(zip(self._drive_names, self.drive_parameters, strict=True))

    @property
    def drive_period(self) -> float:
        """Return the sample period of the drives in s, the unit of their delay; 0 without drives."""
        return self._drive_period

    def _check_ranges(self) -> None:
        for name, value, low, high in zip(self.names, self.start, self.lower, self.upper, strict=True):
            if not low <= value <= high:
                raise CalibrationError(f"{name} begins at {value:g}, outside its range [{low:g}, {high:g}]")

    def _read_drives(self, testbed: VirtualTestbed, context: Context) -> None:
        drives = [(path, system) for path, system in leaves(testbed.diagram) if isinstance(system, JointDrives)]
        if len(drives) > 1:
            raise CalibrationError(f"one JointDrives can be calibrated, not {len(drives)}")
        self.drives = drives[0][0] if drives else ""
        self._drive_period = drives[0][1].period if drives else 0.0
        self._drive_names: list[str] = []
        self.drive_parameters: list[int] = []
        self._drive_values = {}
        if drives:
            self._drive_values = {name: float(testbed.read(context, f"{self.drives}.{name}")) for name in _TIMES}

    def _build(self, testbed: VirtualTestbed, context: Context, plant: Any, plant_context: Context) -> None:
        z = casadi.SX.sym("z", len(self.names))
        entries: dict[str, list[tuple[str, Expression]]] = {}  # by address in the plant: index and expression
        for k, name in enumerate(self.names[: self.scalars]):
            if match := _WORLD.match(name):
                entries.setdefault(match[1], []).append((match[2], z[k]))
        for k, body in enumerate(self.bodies):
            first = self.scalars + INERTIA_SIZE * k
            for part, value in zip(_PARTS, inertia_of(z[first : first + INERTIA_SIZE]), strict=True):
                entries.setdefault(f"{_WORLD.match(body)[1]}.{part}", []).append((_WHOLE, value))  # type: ignore[index]
        try:
            dynamics = PlantDynamics(plant, plant_context, inputs=list(entries))
        except ValueError as error:
            raise CalibrationError(str(error)) from error
        if dynamics.nq != dynamics.nv:
            raise CalibrationError("a floating joint cannot be calibrated: fix the base")
        self.nq, self.nu, self.step_size = dynamics.nq, dynamics.nu, float(plant.time_step())
        inputs = {address: _filled(dynamics.values[address], parts) for address, parts in entries.items()}
        joints = [plant.get_joint(index) for index in plant.GetJointIndices()]
        moving = sorted((joint.position_start(), joint.name()) for joint in joints if joint.num_positions())
        self.joint_names = tuple(name for _, name in moving)
        self.actuated_names = tuple(
            plant.get_joint_actuator(index).joint().name() for index in plant.GetJointActuatorIndices()
        )
        self.selection: Array = plant.MakeActuationMatrix()
        self.actuator_of = [int(row.argmax()) if row.any() else -1 for row in self.selection]
        matches = [_DRIVE.match(name) for name in self.names]
        self.friction_parameters = [k for k, match in enumerate(matches) if match and match[2] in FRICTION]
        selection = casadi.SX(casadi.DM(self.selection))
        drive = {name: self._drive_parameter(name, testbed, context, z) for name in FRICTION}
        q, v, m = dynamics.symbols()
        a, h = casadi.SX.sym("a", self.nq), casadi.SX.sym("h")
        x = casadi.vertcat(q, v)

        def friction(velocities: Expression) -> Expression:
            return friction_torque(selection.T @ velocities, m, drive)

        tau = selection @ (m - friction(v))
        needed = dynamics.inverse_dynamics(q, v, a) + dynamics.damping_torque(v) - tau
        held_torque = casadi.SX.sym("tau", self.nq)
        results = [needed, tau, casadi.vertcat(v, dynamics.acceleration(q, v, held_torque))]
        if self.step_size > 0.0:
            rest = m - _friction_at_end(dynamics, (q, v, m), selection, drive, self.step_size)
            results.append(casadi.vertcat(*dynamics.step(q, v, selection @ rest, self.step_size)))
        needed, tau, rate, *step = dynamics.substituted(results, inputs)
        edges = casadi.Function("edges", [z], [drive["coulomb_velocity"]])(self.start)
        self.edges = self.selection @ np.asarray(edges).ravel()
        inertia = casadi.jacobian(dynamics.inverse_dynamics(q, v, a), a)
        (inertia,) = dynamics.substituted([inertia], inputs)
        sharpness = drive["coulomb"] / (selection.T @ casadi.diag(inertia)) / drive["coulomb_velocity"]
        self.sharpness = casadi.Function("sharpness", [q, z], [casadi.densify(sharpness)])
        lost = selection @ friction(v) + dynamics.substituted([dynamics.damping_torque(v)], inputs)[0]
        self.friction = casadi.Function("friction", [v, m, z], [casadi.densify(lost)])
        self.unexplained = casadi.Function("unexplained", [q, v, a, m, z], [casadi.densify(needed)], {"cse": True})
        f = casadi.Function("rate", [x, held_torque, z], [rate])
        driven = casadi.Function("driven", [x, m, z], [tau])
        following = step[0] if step else _runge_kutta(lambda state: f(state, driven(state, m, z), z), x, h)
        self.step = casadi.Function("step", [x, m, h, z], [following], {"cse": True})

    def motor(self, times: Array, u: Array, z: Array) -> tuple[Array, Array]:
        """Return the motors' torques after delay and current loop, (n, nu), and their derivatives (n, k, nu).

        These are by the k varied ones of delay and time constant; `drive_parameters` are their places in z.
        A delay d = i + f in periods gives (1 - f) u_(k-i) + f u_(k-i-1), what a held command is on average.

        Args:
            times: Times of the commands, (n,), in s, equally spaced.
            u: Commands, (n, nu), in N m or N.
            z: The parameters, (nz,).
        """
        values = dict(self._drive_values)
        for name, index in zip(self._drive_names, self.drive_parameters, strict=True):
            values[name] = float(z[index])
        if not self.drives or self._is_measured:
            return u, np.zeros((len(u), 0, self.nu))
        period, time_constant = float(np.median(np.diff(times))), max(values["time_constant"], 0.0)
        delay = ((max(values["delay"], 0.0) + 1.0) * self._drive_period + self.step_size) / period
        whole = min(int(delay), len(u) - 2)
        near, far = _shifted(u, whole), _shifted(u, whole + 1)
        reference = near + (delay - whole) * (far - near)
        decay = np.exp(-period / time_constant) if time_constant > 0.0 else 0.0
        m = _filtered(reference, 1.0 - decay)
        slopes = {"delay": _filtered((far - near) * self._drive_period / period, 1.0 - decay)}
        if time_constant > 0.0:
            # gain = 1 - exp(-period / time_constant)
            by_gain = reference - np.concatenate([reference[:1], m[:-1]])
            change = -decay * period / time_constant**2 * by_gain
            slopes["time_constant"] = scipy.signal.lfilter([1.0], [1.0, -decay], change, axis=0)
        else:
            slopes["time_constant"] = np.zeros_like(u)
        by = [slopes[name] for name in self._drive_names]
        return m, np.stack(by, axis=1) if by else np.zeros((len(u), 0, self.nu))

    def _drive_parameter(self, name: str, testbed: VirtualTestbed, context: Context, z: Expression) -> Expression:
        """Return a parameter of the drives by actuator, (nu, 1)."""
        if not self.drives:
            return casadi.SX(casadi.DM(np.full(self.nu, float(name.endswith("velocity")))))
        numbers = np.asarray(testbed.read(context, f"{self.drives}.{name}"))
        # At a velocity of 0, some derivatives are not finite.
        value = casadi.SX(casadi.DM(np.maximum(numbers, _TINY) if name.endswith("velocity") else numbers))
        for k, parameter in enumerate(self.names[: self.scalars]):
            if (match := _DRIVE.match(parameter)) and match[2] == name:
                value[slice(None) if match[3] is None else int(match[3])] = z[k]
        return value


def _friction_at_end(
    dynamics: PlantDynamics,
    at: tuple[Expression, Expression, Expression],
    selection: Expression,
    law: Mapping[str, Expression],
    period: float,
) -> Expression:
    """Return the friction of the drives with the velocities at the end of a step, in N m, (nu, 1).

    Joint by joint, the velocity solves its own equation with the friction of the others (Gauss and Seidel).

    Args:
        dynamics: The plant.
        at: Positions, velocities and motors' torques at the begin of the step.
        selection: The actuation matrix, (nv, nu).
        law: The numbers of the friction, see `friction_torque`.
        period: The step, in s.
    """
    q, v, m = at
    A, momentum = dynamics.momentum_balance(q, v, selection @ m, period)
    factor = casadi.chol(A)
    response = casadi.solve(factor, casadi.solve(factor.T, selection))
    free, response = selection.T @ casadi.solve(factor, casadi.solve(factor.T, momentum)), selection.T @ response
    size, friction = friction_size(selection.T @ v, m, law), casadi.SX(free.shape[0], 1)
    for _ in range(_SWEEPS if free.shape[0] > 1 else 1):
        for i in range(free.shape[0]):
            g = period * response[i, i]
            rest = free[i] - period * response[i, :] @ friction + g * (friction[i] - law["asymmetry"][i])
            edge = law["coulomb_velocity"][i]
            w = end_velocity(1.0 + g * law["viscous"][i], g * size[i], rest, edge)
            friction[i] = law["viscous"][i] * w + size[i] * casadi.tanh(w / edge) + law["asymmetry"][i]
    return friction


def _filled(values: Array, parts: Sequence[tuple[str | None, Expression]]) -> Expression:
    """Return the values of an input with the varied ones in their places."""
    filled = casadi.SX(casadi.DM(values))
    for index, expression in parts:
        if index == _WHOLE:
            return expression
        filled[0 if index is None else int(index)] = expression
    return filled


def _runge_kutta(rate: Callable[[Expression], Expression], x: Expression, h: Expression) -> Expression:
    """Return x after one step of the classical method of fourth order."""
    k1 = rate(x)
    k2 = rate(x + h / 2 * k1)
    k3 = rate(x + h / 2 * k2)
    k4 = rate(x + h * k3)
    return x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


def _filtered(u: Array, gain: float) -> Array:
    """Return m with m_k = m_(k-1) + gain (u_k - m_(k-1)), at rest in the beginning."""
    start = (1.0 - gain) * u[:1]
    filtered: Array = scipy.signal.lfilter([gain], [1.0, gain - 1.0], u, axis=0, zi=start)[0]
    return filtered


def _shifted(u: Array, samples: int) -> Array:
    return np.concatenate([np.repeat(u[:1], samples, axis=0), u[: len(u) - samples]])
