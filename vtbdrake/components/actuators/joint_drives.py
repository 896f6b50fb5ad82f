"""Torque-controlled drives of joints."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from math import inf
from typing import TYPE_CHECKING

import casadi
import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, LeafSystem

from vtbdrake.components.casadi_system.kernel import Kernel, clamp
from vtbdrake.state import Element, discrete_state, parameter
from vtbdrake.state.declarations import NO_DICT

if TYPE_CHECKING:
    from pydrake.multibody.plant import MultibodyPlant
    from pydrake.multibody.tree import Joint

_TINY = float(np.finfo(float).tiny)


class JointDrives(LeafSystem):
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
        torque = m_k - viscous v - coulomb tanh(v / coulomb_velocity)                   (friction in gear and bearings)

    The current loop is first-order, the exact solution for a reference that is held; with a time constant of 0 it is
    ideal. A gear without backlash multiplies torque and divides speed: everything here is on its output side.
    What remains of it is the rotor's inertia, ``gear_ratio^2 rotor_inertia`` about the joint's axis, which belongs to
    the plant's mass matrix: give both to the plant's JointActuator. Friction is smooth: a joint at rest under a load
    below ``coulomb`` creeps instead of sticking, and with a step T that is not small against
    M coulomb_velocity / coulomb it chatters.

    The output is the system's state. A command that is itself a state of period T is thus read one period after it was
    set, and felt by a discrete plant of that period from then on.

    All values are parameters of the Context, by address; ``delay`` counts whole periods, up to ``max_delay``.
    """

    __slots__ = NO_DICT

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
            delay: Delay of the command in whole periods.
            max_delay: The largest delay that can be set in the Context, in whole periods; at least ``delay``.
            initial: The torque in N m before the first sample, both commanded and reached; a scalar or shape (n,).

        Raises:
            ValueError: A value is out of range, or a joint has more than one velocity or none.
        """
        super().__init__()
        for joint in joints:
            if joint.num_velocities() != 1:
                raise ValueError(
                    f"Joint '{joint.name()}' has {joint.num_velocities()} velocities; "
                    "JointDrives drives joints with exactly one."
                )
        n = len(joints)
        by_joint = {
            "limit": limit,
            "rate": rate,
            "viscous": viscous,
            "coulomb": coulomb,
            "coulomb_velocity": coulomb_velocity,
        }
        entries = {name: np.broadcast_to(np.asarray(value, dtype=float), (n,)) for name, value in by_joint.items()}
        self._max_delay = max(int(delay), int(max_delay))
        _check(period, {**entries, "time_constant": np.array(time_constant), "delay": np.array(delay)})
        self._period, self._n = float(period), n
        self._command = self.DeclareVectorInputPort("command", n)
        self._state_port = self.DeclareVectorInputPort("state", plant.num_multibody_states())
        before = np.array(np.broadcast_to(np.asarray(initial, dtype=float), (n,)))
        torque = self.DeclareDiscreteState(before)
        self.DeclareStateOutputPort("torque", torque)
        # One group for all internal state: every group costs more than the arithmetic.
        memory = self.DeclareDiscreteState(np.tile(before, 2 + self._max_delay))
        values = [*np.concatenate(list(entries.values())), float(time_constant), float(delay)]
        parameters = self.DeclareNumericParameter(BasicVector(values))
        self._torque, self._memory, self._parameters = int(torque), int(memory), int(parameters)
        self.variables = tuple(self._elements())
        velocities = [plant.num_positions() + joint.velocity_start() for joint in joints]
        self._kernel = _kernel(velocities, plant.num_multibody_states(), period=self._period)
        self.DeclarePeriodicDiscreteUpdateEvent(self._period, 0.0, self._update)

    def resume(self, context: Context, command: ArrayLike) -> None:
        """Go on where drives stand that were given ``command`` (N m, shape (n,)) for some time."""
        torque = np.asarray(command, dtype=float)
        context.SetDiscreteState(self._torque, torque)
        context.SetDiscreteState(self._memory, np.tile(torque, 2 + self._max_delay))

    def _elements(self) -> Iterator[Element]:
        n, index = self._n, self._parameters
        yield discrete_state("torque", self._torque, shape=(n,), unit="N m")
        yield discrete_state("motor_torque", self._memory, shape=(n,), unit="N m")
        yield discrete_state("reference", self._memory, start=n, shape=(n,), unit="N m")
        units = {"limit": "N m", "rate": "N m/s", "viscous": "N m s/rad", "coulomb": "N m", "coulomb_velocity": "rad/s"}
        for k, (name, unit) in enumerate(units.items()):
            yield parameter(name, index, start=k * n, shape=(n,), unit=unit, bounds=(0.0, inf))
        yield parameter("time_constant", index, start=5 * n, unit="s", bounds=(0.0, inf))
        yield parameter("delay", index, start=5 * n + 1, unit="period", bounds=(0.0, float(self._max_delay)))
        if self._max_delay:
            yield discrete_state("in_transit", self._memory, start=2 * n, shape=(self._max_delay, n), unit="N m")

    def _update(self, context: Context, state: DiscreteValues) -> None:
        n = self._n
        values = context.get_numeric_parameter(self._parameters).value()
        memory = context.get_discrete_state(self._memory).value()
        u, x = self._command.Eval(context), self._state_port.Eval(context)
        line = memory[2 * n :]
        delay = round(float(values[-1])) if self._max_delay else 0
        delayed = line[(delay - 1) * n : delay * n] if delay else u
        y = self._kernel.value((values, memory[: 2 * n], delayed, x))
        state.set_value(self._torque, y[:n])
        state.set_value(self._memory, np.concatenate((y[n:], u, line[:-n])) if self._max_delay else y[n:])


def _kernel(velocities: Sequence[int], states: int, *, period: float) -> Kernel:
    """Return [torque; m_k; r_k] as a kernel of (parameters, [m_{k-1}; r_{k-1}], delayed command, [q; v]).

    ``velocities`` are those of the joints in [q; v], of ``states`` entries.
    """
    n = len(velocities)
    values, memory = casadi.SX.sym("values", 5 * n + 2), casadi.SX.sym("memory", 2 * n)
    u, x = casadi.SX.sym("u", n), casadi.SX.sym("x", states)
    limit, rate, viscous, coulomb, coulomb_velocity = casadi.vertsplit(values[: 5 * n], n)
    motor, last = casadi.vertsplit(memory, n)
    reach = rate * period
    reference = clamp(clamp(u, -limit, limit), last - reach, last + reach)
    # 1 where the time constant is 0.
    gain = -casadi.expm1(-period / values[5 * n])
    following = motor + gain * (reference - motor)
    v = x[velocities]
    # A velocity of 0 makes the friction a step.
    friction = viscous * v + coulomb * casadi.tanh(v / casadi.fmax(coulomb_velocity, _TINY))
    y = casadi.vertcat(following - friction, following, reference)
    return Kernel("drives", [values, memory, u, x], y, compile=False)


def _check(period: float, values: Mapping[str, NDArray[np.float64]]) -> None:
    if not 0.0 < period < inf:
        raise ValueError(f"JointDrives: period must be positive, in seconds, not {period}")
    for name, value in values.items():
        if np.isnan(value).any() or (value < 0.0).any():
            raise ValueError(f"JointDrives: {name} must not be negative or NaN, but is {value.tolist()}")
    if values["delay"] != np.round(values["delay"]):
        raise ValueError(f"JointDrives: delay is a whole number of periods, not {values['delay']}")
