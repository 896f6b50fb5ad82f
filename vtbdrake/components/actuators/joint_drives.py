"""Torque-controlled drives of joints."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import expm1, inf
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, LeafSystem

from vtbdrake.state import Element, discrete_state, parameter

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
        """
        Args:
            period: T in seconds.
            initial: the torque that was commanded, and reached, before the first sample, in N m.
            limit, rate: of the torque, in N m and N m/s; scalars or one per joint, like the three of friction.
            time_constant: of the current loop, in seconds.
            viscous, coulomb, coulomb_velocity: of the friction, in N m s/rad, N m and rad/s.

        Raises:
            ValueError: a value that no drive can have.
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
        self._velocities = np.array([plant.num_positions() + joint.velocity_start() for joint in joints], dtype=int)
        self._command = self.DeclareVectorInputPort("command", n)
        self._state_port = self.DeclareVectorInputPort("state", plant.num_multibody_states())
        before = np.array(np.broadcast_to(np.asarray(initial, dtype=float), (n,)))
        self._torque = self.DeclareDiscreteState(before)
        self._motor = self.DeclareDiscreteState(before)
        self._reference = self.DeclareDiscreteState(before)
        self.DeclareStateOutputPort("torque", self._torque)
        values = [*np.concatenate(list(entries.values())), float(time_constant), float(delay)]
        self._parameters = self.DeclareNumericParameter(BasicVector(values))
        self.variables = self._elements(before)
        self.DeclarePeriodicDiscreteUpdateEvent(self._period, 0.0, self._update)

    def _elements(self, before: NDArray[np.float64]) -> tuple[Element, ...]:
        n = self._n
        units = {"limit": "N m", "rate": "N m/s", "viscous": "N m s/rad", "coulomb": "N m", "coulomb_velocity": "rad/s"}
        elements = [
            discrete_state("torque", self._torque, shape=(n,), unit="N m"),
            discrete_state("motor_torque", self._motor, shape=(n,), unit="N m"),
            discrete_state("reference", self._reference, shape=(n,), unit="N m"),
            *(
                parameter(name, self._parameters, start=k * n, shape=(n,), unit=unit, bounds=(0.0, inf))
                for k, (name, unit) in enumerate(units.items())
            ),
            parameter("time_constant", self._parameters, start=5 * n, unit="s", bounds=(0.0, inf)),
            parameter("delay", self._parameters, start=5 * n + 1, unit="period", bounds=(0.0, float(self._max_delay))),
        ]
        if self._max_delay:
            self._line = self.DeclareDiscreteState(np.tile(before, self._max_delay))
            elements.append(discrete_state("in_transit", self._line, shape=(self._max_delay, n), unit="N m"))
        return tuple(elements)

    def _update(self, context: Context, state: DiscreteValues) -> None:
        n = self._n
        values = context.get_numeric_parameter(self._parameters).value()
        limit, rate, viscous, coulomb, coulomb_velocity = values[: 5 * n].reshape(5, n)
        time_constant, delay = values[5 * n :].tolist()
        u = self._delayed(context, state, round(delay))
        last = context.get_discrete_state(self._reference).value()
        reach = rate * self._period
        reference = np.minimum(np.maximum(u, -limit), limit)
        reference = np.minimum(np.maximum(reference, last - reach), last + reach)
        motor = context.get_discrete_state(self._motor).value()
        gain = -expm1(-self._period / time_constant) if time_constant > 0.0 else 1.0
        motor = motor + gain * (reference - motor)
        v = self._state_port.Eval(context)[self._velocities]
        # A velocity of 0 makes the friction a step.
        smooth = np.tanh(v / np.maximum(coulomb_velocity, _TINY))
        state.set_value(self._reference, reference)
        state.set_value(self._motor, motor)
        state.set_value(self._torque, motor - viscous * v - coulomb * smooth)

    def _delayed(self, context: Context, state: DiscreteValues, delay: int) -> NDArray[np.float64]:
        """The command of ``delay`` periods ago."""
        u: NDArray[np.float64] = self._command.Eval(context)
        if not self._max_delay:
            return u
        n = self._n
        line = context.get_discrete_state(self._line).value()
        delayed = line[(delay - 1) * n : delay * n].copy() if delay else u
        state.set_value(self._line, np.concatenate((u, line[:-n])))
        return delayed


def _check(period: float, values: Mapping[str, NDArray[np.float64]]) -> None:
    if not 0.0 < period < inf:
        raise ValueError(f"JointDrives: period must be positive, in seconds, not {period}")
    for name, value in values.items():
        if np.isnan(value).any() or (value < 0.0).any():
            raise ValueError(f"JointDrives: {name} must not be negative or NaN, but is {value.tolist()}")
    if values["delay"] != np.round(values["delay"]):
        raise ValueError(f"JointDrives: delay is a whole number of periods, not {values['delay']}")
