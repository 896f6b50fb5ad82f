"""Torque-controlled drives of joints."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import inf
from typing import TYPE_CHECKING

import casadi
import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.systems.framework import Context, DiscreteValues

from vtbdrake.components.casadi_system.kernel import Expression, Kernel, clamp
from vtbdrake.state import AddressedSystem, Quantity

if TYPE_CHECKING:
    from pydrake.multibody.plant import MultibodyPlant
    from pydrake.multibody.tree import Joint

_TINY = float(np.finfo(float).tiny)


class JointDrives(AddressedSystem):
    r"""Motors with current loops behind backlash-free gears, one for each of some joints.

    .. pydrake_system::

        name: JointDrives
        input_ports:
        - command
        - state
        output_ports:
        - torque

    ``command`` holds the wanted torques u (N m, at the joints), ``state`` is the plant's [q; v], ``torque`` what the
    joints feel. At t = 0, T, 2 T, ..., with k counting them:

        r_k = clip(u_{k-delay}, +- limit), no further than rate T from r_{k-1}          (amplifier)
        m_k = m_{k-1} + (1 - exp(-T / time_constant)) (r_k - m_{k-1})                   (current loop)
        torque = m_k - friction(v, m_k)                                                 (friction in gear and bearings)
        friction = viscous v + asymmetry + tanh(v / coulomb_velocity)
                   (coulomb + stribeck exp(-(v / stribeck_velocity)^2) + load_friction |m_k|)

    The current loop is first-order, the exact solution for a reference that is held; with a time constant of 0 it is
    ideal. A gear without backlash multiplies torque and divides speed: everything here is on its output side.
    What remains of it is the rotor's inertia, ``gear_ratio^2 rotor_inertia`` about the joint's axis, which belongs to
    the plant's mass matrix: give both to the plant's JointActuator.

    Friction is larger near rest by ``stribeck``, grows with the motor's torque by ``load_friction``, and is larger by
    ``asymmetry`` in positive direction, and smaller in negative one; these are 0 by default. It is smooth: a joint at
    rest under a load below ``coulomb`` creeps instead of sticking, and with a step T that is not small against
    M coulomb_velocity / coulomb it chatters.

    The output is the system's state. A command that is itself a state of period T is thus read one period after it was
    set, and felt by a discrete plant of that period from then on.

    All values are parameters of the Context, by address; ``delay`` counts whole periods, up to ``max_delay``.
    """

    def __init__(
        self,
        plant: MultibodyPlant,
        joints: Sequence[Joint],
        *,
        period: float,
        limit: ArrayLike = inf,
        rate: ArrayLike = inf,
        time_constant: float = 0.0,
        viscous: ArrayLike = 0.0,
        coulomb: ArrayLike = 0.0,
        coulomb_velocity: ArrayLike = 0.01,
        stribeck: ArrayLike = 0.0,
        stribeck_velocity: ArrayLike = 0.1,
        load_friction: ArrayLike = 0.0,
        asymmetry: ArrayLike = 0.0,
        delay: int = 0,
        max_delay: int = 0,
        initial: ArrayLike = 0.0,
    ) -> None:
        """Declare the drives of ``joints``.

        Args:
            plant: The plant of the joints.
            joints: The n joints; each has exactly one velocity.
            period: The sample period T in seconds.
            limit: The largest torque in N m; a scalar or shape (n,).
            rate: The largest change of the torque in N m/s; a scalar or shape (n,).
            time_constant: Time constant of the current loop in seconds.
            viscous: Viscous friction in N m s/rad; a scalar or shape (n,).
            coulomb: Coulomb friction in N m; a scalar or shape (n,).
            coulomb_velocity: Velocity scale of the Coulomb friction in rad/s; a scalar or shape (n,).
            stribeck: Friction near rest beyond Coulomb friction in N m; a scalar or shape (n,).
            stribeck_velocity: Velocity scale of the friction near rest in rad/s; a scalar or shape (n,).
            load_friction: Friction per torque of the motor; a scalar or shape (n,).
            asymmetry: Torque in N m against positive motion, which helps negative motion; a scalar or shape (n,).
            delay: Delay of the command in whole periods.
            max_delay: The largest delay that can be set in the Context, in whole periods; at least ``delay``.
            initial: The torque in N m before the first sample, both commanded and reached; a scalar or shape (n,).

        Raises:
            ValueError: A value is out of range, or a joint has more than one velocity or none.
        """
        super().__init__()
        _check_joints(joints)
        n = len(joints)
        by_joint = {
            "limit": limit,
            "rate": rate,
            "viscous": viscous,
            "coulomb": coulomb,
            "coulomb_velocity": coulomb_velocity,
            "stribeck": stribeck,
            "stribeck_velocity": stribeck_velocity,
            "load_friction": load_friction,
            "asymmetry": asymmetry,
        }
        entries = {name: np.broadcast_to(np.asarray(value, dtype=float), (n,)) for name, value in by_joint.items()}
        self.max_delay = max(int(delay), int(max_delay))
        _check(period, {**entries, "time_constant": np.array(time_constant), "delay": np.array(delay)})
        self.period: float = float(period)  # sample period T in seconds
        self._n = n
        self.entry_names = tuple(joint.name() for joint in joints)
        self._command = self.DeclareVectorInputPort("command", n)
        self._state_port = self.DeclareVectorInputPort("state", plant.num_multibody_states())
        before = np.array(np.broadcast_to(np.asarray(initial, dtype=float), (n,)))
        self._torque = self.declare_discrete_state(torque=Quantity(before, "N m"))
        self.DeclareStateOutputPort("torque", self._torque.index)
        # One group for all internal state: every group costs more than the arithmetic.
        memory = {"motor_torque": Quantity(before, "N m"), "reference": Quantity(before, "N m")}
        if self.max_delay:
            memory["in_transit"] = Quantity(np.tile(before, (self.max_delay, 1)), "N m")
        self._memory = self.declare_discrete_state(**memory)
        self._settings = self.declare_parameters(
            **{name: Quantity(value, _UNITS[name], (_lowest(name), inf)) for name, value in entries.items()},
            time_constant=Quantity(time_constant, "s", (0.0, inf)),
            delay=Quantity(delay, "period", (0.0, float(self.max_delay))),
        )
        velocities = [plant.num_positions() + joint.velocity_start() for joint in joints]
        self.kernel = _kernel(velocities, plant.num_multibody_states(), period=self.period)
        self.DeclarePeriodicDiscreteUpdateEvent(self.period, 0.0, self._update)

    def resume(self, context: Context, command: ArrayLike) -> None:
        """Go on where drives stand that were given ``command`` (N m, shape (n,)) for some time.

        Args:
            context: The drives' own context, which is changed.
            command: The command that has acted, shape (n,), in N m or N.
        """
        torque = np.asarray(command, dtype=float)
        context.SetDiscreteState(self._torque.index, torque)
        context.SetDiscreteState(self._memory.index, np.tile(torque, 2 + self.max_delay))

    def _update(self, context: Context, state: DiscreteValues) -> None:
        n = self._n
        settings, memory = self._settings.array(context), self._memory.mutable_array(state)
        delayed = u = self._command.Eval(context)
        if self.max_delay:
            in_transit = self._memory.vector.view(memory).in_transit
            if delay := round(self._settings.vector.view(settings).delay):
                delayed = in_transit[delay - 1].copy()
            in_transit[1:] = in_transit[:-1]
            in_transit[0] = u
        # The torques, then what the motors and their references have become.
        y = self.kernel.value((settings, memory[: 2 * n], delayed, self._state_port.Eval(context)))
        self._torque.mutable_array(state)[:] = y[:n]
        memory[: 2 * n] = y[n:]


# Numbers that each joint has, in the order of the parameters.
_UNITS = {
    "limit": "N m",
    "rate": "N m/s",
    "viscous": "N m s/rad",
    "coulomb": "N m",
    "coulomb_velocity": "rad/s",
    "stribeck": "N m",
    "stribeck_velocity": "rad/s",
    "load_friction": "1",
    "asymmetry": "N m",
}
FRICTION = tuple(name for name in _UNITS if name not in ("limit", "rate"))
"""The numbers of the friction's law."""


def _lowest(name: str) -> float:
    return -inf if name == "asymmetry" else 0.0


def friction_torque(v: Expression, motor: Expression, law: Mapping[str, Expression]) -> Expression:
    """Return the torques by which friction resists, in N m, (n, 1).

    Args:
        v: Velocities of the joints in rad/s, (n, 1).
        motor: Torques of their motors in N m, (n, 1).
        law: The numbers of `FRICTION`, by name, (n, 1) each.
    """
    # A velocity of 0 makes the friction a step.
    near_rest = casadi.exp(-((v / casadi.fmax(law["stribeck_velocity"], _TINY)) ** 2))
    size = law["coulomb"] + law["stribeck"] * near_rest + law["load_friction"] * casadi.fabs(motor)
    direction = casadi.tanh(v / casadi.fmax(law["coulomb_velocity"], _TINY))
    return law["viscous"] * v + size * direction + law["asymmetry"]


def _kernel(velocities: Sequence[int], states: int, *, period: float) -> Kernel:
    """Return [torque; m_k; r_k] as a kernel of (parameters, [m_{k-1}; r_{k-1}], delayed command, [q; v]).

    ``velocities`` are the places of the joints' velocities in [q; v], which has ``states`` entries.
    """
    n = len(velocities)
    count = len(_UNITS)
    values, memory = casadi.SX.sym("values", count * n + 2), casadi.SX.sym("memory", 2 * n)
    u, x = casadi.SX.sym("u", n), casadi.SX.sym("x", states)
    by_joint = dict(zip(_UNITS, casadi.vertsplit(values[: count * n], n), strict=True))
    limit, rate = by_joint["limit"], by_joint["rate"]
    motor, last = casadi.vertsplit(memory, n)
    reach = rate * period
    reference = clamp(clamp(u, -limit, limit), last - reach, last + reach)
    # 1 where the time constant is 0.
    gain = -casadi.expm1(-period / values[count * n])
    following = motor + gain * (reference - motor)
    friction = friction_torque(x[velocities], following, by_joint)
    y = casadi.vertcat(following - friction, following, reference)
    return Kernel("drives", [values, memory, u, x], y, compile=False)


def _check_joints(joints: Sequence[Joint]) -> None:
    for joint in joints:
        if joint.num_velocities() != 1:
            raise ValueError(
                f"Joint '{joint.name()}' has {joint.num_velocities()} velocities; "
                "JointDrives drives joints with exactly one."
            )


def _check(period: float, values: Mapping[str, NDArray[np.float64]]) -> None:
    if not 0.0 < period < inf:
        raise ValueError(f"JointDrives: period must be positive, in seconds, not {period}")
    for name, value in values.items():
        if np.isnan(value).any() or (value < _lowest(name)).any():
            raise ValueError(f"JointDrives: {name} must not be negative or NaN, but is {value.tolist()}")
    if values["delay"] != np.round(values["delay"]):
        raise ValueError(f"JointDrives: delay is a whole number of periods, not {values['delay']}")
