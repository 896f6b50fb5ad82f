"""Torque-controlled drives of joints."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import exp, inf, pi, sqrt
from typing import TYPE_CHECKING

import casadi
import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.systems.framework import BasicVector, Context, DiscreteValues

from vtbdrake.common.argument_checks import as_array
from vtbdrake.components.casadi_system.kernel import Expression, Kernel, clamp
from vtbdrake.components.sensors.noise import normal_noise, random_stream
from vtbdrake.state import AddressedSystem, Quantity

if TYPE_CHECKING:
    from pydrake.multibody.plant import MultibodyPlant
    from pydrake.multibody.tree import Joint

# Friction below this velocity is linear, whatever coulomb_velocity is, in rad/s or m/s.
_LEAST_EDGE = 1e-9
# Iterations of Newton's method for a velocity: it approaches from one side, and is exact to rounding before.
_ITERATIONS = 6
# Configurations in which the least inertia is looked for.
_CONFIGURATIONS = 16


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
        d_k = r d_{k-1} + sqrt(1 - r^2) disturbance n_k,  r = exp(-T / disturbance_time)    (what no model explains)
        torque_k = m_k + d_k - friction(w)                                              (friction in gear and bearings)
        friction = viscous w + asymmetry + tanh(w / coulomb_velocity)
                   (coulomb + stribeck exp(-(v_k / stribeck_velocity)^2) + load_friction |m_k|)
        w = 2 v_k - v_{k-1} + T / inertia (torque_k - torque_{k-1})

    The friction is implicit: w is the velocity at the end of the period, extrapolated, with what a change of the torque
    does to a joint of this ``inertia`` (by default the least one that its drive feels). So a joint sticks, whatever T
    is, where friction at v_k would turn the velocity around in each period. With a continuous plant, viscous friction
    is the mean of both ends, and what slides through rest within a period has its friction in both directions.

    The current loop is first-order, the exact solution for a reference that is held; with a time constant of 0 it is
    ideal. A gear without backlash multiplies torque and divides speed: everything here is on its output side.
    What remains of it is the rotor's inertia, ``gear_ratio^2 rotor_inertia`` about the joint's axis, which belongs to
    the plant's mass matrix: give both to the plant's JointActuator.

    Friction is larger near rest by ``stribeck``, grows with the motor's torque by ``load_friction``, and is larger by
    ``asymmetry`` in positive direction, and smaller in negative one; these are 0 by default. It is smooth: a joint at
    rest under a load below ``coulomb`` creeps, slower than ``coulomb_velocity``.

    The disturbance is random: n_k of N(0, 1) is a function of ``seed``, the system's name and k, and d_0 = disturbance
    n_0. It is 0 by default. Samples of a calibrated scenario have the one that its recordings showed.

    A continuous plant feels torque_k for a period. A discrete plant feels its friction from its own step on, with that
    step as T, and m_{k-1} and d_{k-1} as state: a command that is itself a state of period T is read one period
    after it was set, and felt by a discrete plant of that period from then on.

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
        disturbance: ArrayLike = 0.0,
        disturbance_time: float = 0.05,
        seed: int = 0,
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
            disturbance: Standard deviation of a random torque in N m; a scalar or shape (n,).
            disturbance_time: Correlation time of that torque in seconds.
            seed: Seed of that torque.
            delay: Delay of the command in whole periods.
            max_delay: The largest delay that can be set in the Context, in whole periods; at least ``delay``.
            initial: The torque in N m before the first sample, both commanded and reached; a scalar or shape (n,).

        Raises:
            ValueError: A value is out of range, or a joint has more than one velocity or none.
        """
        super().__init__()
        _check_joints(joints)
        n = len(joints)
        by_joint = (
            limit, rate, viscous, coulomb, coulomb_velocity, stribeck, stribeck_velocity, load_friction, asymmetry,
            disturbance,
        )  # fmt: skip
        numbers = zip(_UNITS, by_joint, strict=True)
        entries = {name: np.broadcast_to(as_array(f"JointDrives: {name}", value), (n,)) for name, value in numbers}
        self.max_delay = max(int(delay), int(max_delay))
        times = {"time_constant": np.array(time_constant), "disturbance_time": np.array(disturbance_time)}
        _check(period, {**entries, **times, "seed": np.array(seed), "delay": np.array(delay)})
        self.period: float = float(period)  # sample period T in seconds
        self.n = n  # number of joints
        self.entry_names = tuple(joint.name() for joint in joints)
        self._command = self.DeclareVectorInputPort("command", n)
        self._state_port = self.DeclareVectorInputPort("state", plant.num_multibody_states())
        self._declare_state(np.array(np.broadcast_to(as_array("JointDrives: initial", initial), (n,))))
        self.settings = self.declare_parameters(
            **{name: Quantity(value, _UNITS[name], (_lowest(name), inf)) for name, value in entries.items()},
            inertia=Quantity(least_inertia(plant, joints), "kg m^2", (0.0, inf)),
            disturbance_time=Quantity(disturbance_time, "s", (0.0, inf)),
            seed=Quantity(seed, bounds=(0.0, 2.0**53)),
            time_constant=Quantity(time_constant, "s", (0.0, inf)),
            delay=Quantity(delay, "period", (0.0, float(self.max_delay))),
        )
        self.stream = random_stream(self, None)  # function that returns the random stream
        self.velocities = [plant.num_positions() + joint.velocity_start() for joint in joints]  # places in [q; v]
        self.step: float = float(plant.time_step())  # step in s of a discrete plant, 0 of a continuous one
        self.motors = _motors(n, self.period)
        is_discrete, states = self.step > 0.0, plant.num_multibody_states()
        self.kernel = _friction(self.velocities, states, self.step or self.period, is_discrete)
        self._declare_torque()

    def _declare_state(self, before: NDArray[np.float64]) -> None:
        """Declare the discrete state of drives whose torques were ``before``, (n,), in N m."""
        n = self.n
        self._torque = self.declare_discrete_state(torque=Quantity(before, "N m"))
        # One group for all internal state: every group costs more than the arithmetic.
        memory = {"motor_torque": Quantity(before, "N m"), "reference": Quantity(before, "N m")}
        if self.max_delay:
            memory["in_transit"] = Quantity(np.tile(before, (self.max_delay, 1)), "N m")
        memory["disturbing_torque"] = Quantity(np.zeros(n), "N m")
        self._memory = self.declare_discrete_state(**memory)
        # The velocities one period before, and 1 if there are some.
        self._last = self.declare_discrete_state(
            last_velocity=Quantity(np.zeros(n), "rad/s"), has_last=Quantity(0.0, "1")
        )

    def _declare_torque(self) -> None:
        """Declare the output port and the updates: a discrete plant feels friction that is computed at its own step."""
        if not self.step > 0.0:
            self.DeclareStateOutputPort("torque", self._torque.index)
            self.DeclarePeriodicDiscreteUpdateEvent(self.period, 0.0, self._update_all)
            return
        groups = self._torque, self._memory, self._last
        inputs = {self.discrete_state_ticket(group.index) for group in groups}
        inputs |= {self.all_parameters_ticket(), self._state_port.ticket()}
        self.DeclareVectorOutputPort("torque", self.n, self._calc_torque, inputs)
        self.DeclarePeriodicDiscreteUpdateEvent(self.step, 0.0, self._remember)
        self.DeclarePeriodicDiscreteUpdateEvent(self.period, 0.0, self._update)

    def resume(self, context: Context, command: ArrayLike) -> None:
        """Go on where drives stand that were given ``command`` (N m, shape (n,)) for some time.

        Args:
            context: The drives' own context, which is changed.
            command: The command that has acted, shape (n,), in N m or N.
        """
        torque = np.asarray(command, dtype=float)
        context.SetDiscreteState(self._torque.index, torque)
        memory = [np.tile(torque, 2 + self.max_delay), np.zeros(self.n)]
        context.SetDiscreteState(self._memory.index, np.concatenate(memory))
        context.SetDiscreteState(self._last.index, np.zeros(self.n + 1))

    def _calc_torque(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._torque_with(context, self._memory.array(context)))

    def _torque_with(self, context: Context, memory: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the torques (n,) that the joints feel with the torques of motors and disturbances in ``memory``."""
        settings, before, last = (group.array(context) for group in (self.settings, self._torque, self._last))
        motor, disturbance = memory[: self.n], memory[-self.n :]
        return self.kernel.value((settings, motor, disturbance, before, last, self._state_port.Eval(context)))

    def _remember(self, context: Context, state: DiscreteValues) -> None:
        self._set_last(context, state, self.get_output_port().Eval(context))

    def _set_last(self, context: Context, state: DiscreteValues, torque: NDArray[np.float64]) -> None:
        self._torque.mutable_array(state)[:] = torque
        last = self._last.mutable_array(state)
        last[:-1] = self._state_port.Eval(context)[self.velocities]
        last[-1] = 1.0

    def _update(self, context: Context, state: DiscreteValues) -> None:
        n = self.n
        settings, memory = self.settings.array(context), self._memory.mutable_array(state)
        delayed = u = self._command.Eval(context)
        if self.max_delay:
            in_transit = self._memory.vector.view(memory).in_transit
            if delay := round(self.settings.vector.view(settings).delay):
                delayed = in_transit[delay - 1].copy()
            in_transit[1:] = in_transit[:-1]
            in_transit[0] = u
        memory[: 2 * n] = self.motors.value((settings, memory[: 2 * n], delayed))
        memory[-n:] = self._disturbing_torque(context, memory[-n:])

    def _disturbing_torque(self, context: Context, before: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the random torques d_k, (n,), after d_{k-1}."""
        settings = self.settings.view(context)
        if not settings.disturbance.any():
            return np.zeros(self.n)
        tick = round(context.get_time() / self.period)
        noise = normal_noise(self.n, seed=int(settings.seed), stream=self.stream(), tick=tick)
        decay = exp(-self.period / settings.disturbance_time) if settings.disturbance_time > 0.0 else 0.0
        if not self._last.view(context).has_last:  # It begins with what it is in the mean.
            decay = 0.0
        following: NDArray[np.float64] = decay * before + sqrt(1.0 - decay**2) * settings.disturbance * noise
        return following

    def _update_all(self, context: Context, state: DiscreteValues) -> None:
        self._update(context, state)
        self._set_last(context, state, self._torque_with(context, self._memory.mutable_array(state)))


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
    "disturbance": "N m",
}
FRICTION = tuple(name for name in _UNITS if name not in ("limit", "rate", "disturbance"))
"""The numbers of the friction's law."""


def _lowest(name: str) -> float:
    return -inf if name == "asymmetry" else 0.0


def least_inertia(plant: MultibodyPlant, joints: Sequence[Joint]) -> NDArray[np.float64]:
    """Return the least inertia that each drive feels, in kg m^2 or kg, (n,), in the default state and in random ones.

    It is 1 over the sum of the accelerations, without their signs, by which a joint answers torques of 1 N m of all
    drives: with it, no change of the torques turns any combination of velocities around.

    Args:
        plant: The plant, finalized.
        joints: The joints, n of them.
    """
    context, random = plant.CreateDefaultContext(), np.random.default_rng(0)
    q = plant.GetPositions(context)
    starts = [joint.position_start() for joint in joints]
    ends = [(joint.position_lower_limits()[0], joint.position_upper_limits()[0]) for joint in joints]
    lower, upper = np.clip(np.outer([-pi, pi], np.ones(len(joints))) + q[starts], *np.array(ends).reshape(-1, 2).T)
    places = [joint.velocity_start() for joint in joints]
    least = np.full(len(joints), inf)
    for _ in range(_CONFIGURATIONS):
        accelerations = np.linalg.inv(plant.CalcMassMatrix(context))[np.ix_(places, places)]
        least = np.minimum(least, 1.0 / abs(accelerations).sum(axis=1))
        q[starts] = random.uniform(lower, upper)
        plant.SetPositions(context, q)
    return least


def friction_size(v: Expression, motor: Expression, law: Mapping[str, Expression]) -> Expression:
    """Return the size of the friction beside the viscous one, in N m, (n, 1).

    Args:
        v: Velocities of the joints in rad/s, (n, 1).
        motor: Torques of their motors in N m, (n, 1).
        law: The numbers of `FRICTION`, by name, (n, 1) each.
    """
    # A velocity of 0 makes the friction a step.
    near_rest = casadi.exp(-((v / casadi.fmax(law["stribeck_velocity"], _LEAST_EDGE)) ** 2))
    return law["coulomb"] + law["stribeck"] * near_rest + law["load_friction"] * casadi.fabs(motor)


def friction_torque(v: Expression, motor: Expression, law: Mapping[str, Expression]) -> Expression:
    """Return the torques by which friction resists, in N m, (n, 1).

    Args:
        v: Velocities of the joints in rad/s, (n, 1).
        motor: Torques of their motors in N m, (n, 1).
        law: The numbers of `FRICTION`, by name, (n, 1) each.
    """
    direction = casadi.tanh(v / casadi.fmax(law["coulomb_velocity"], _LEAST_EDGE))
    return law["viscous"] * v + friction_size(v, motor, law) * direction + law["asymmetry"]


def _motors(n: int, period: float) -> Kernel:
    """Return [m_k; r_k] as a kernel of (parameters, [m_{k-1}; r_{k-1}], delayed command)."""
    values, memory, u = (casadi.SX.sym(name, size) for name, size in _sizes(n, values=None, memory=2 * n, u=n))
    by_joint = _by_joint(values, n)
    limit, reach = by_joint["limit"], by_joint["rate"] * period
    motor, last = casadi.vertsplit(memory, n)
    reference = clamp(clamp(u, -limit, limit), last - reach, last + reach)
    # 1 where the time constant is 0.
    gain = -casadi.expm1(-period / values[-2])
    return Kernel(
        "motors", [values, memory, u], casadi.vertcat(motor + gain * (reference - motor), reference), compile=False
    )


def _friction(velocities: Sequence[int], states: int, period: float, is_discrete: bool) -> Kernel:
    """Return the torques at the joints as a kernel.

    It is one of (parameters, m_k, d_k, torque_{k-1}, [v_{k-1}; has_last], [q; v]).

    Args:
        velocities: The places of the joints' velocities in [q; v].
        states: The number of entries of [q; v].
        period: The time for which the friction is held, in s.
        is_discrete: The plant is discrete: viscous friction acts at the end of a step, as its damping; otherwise in the
            middle of a period.
    """
    n = len(velocities)
    sizes = _sizes(n, values=None, motor=n, disturbance=n, before=n, last=n + 1, x=states)
    values, motor, disturbance, before, last, x = (casadi.SX.sym(name, size) for name, size in sizes)
    law = _by_joint(values, n)
    v, viscous, asymmetry = x[velocities], law["viscous"], law["asymmetry"]
    edge, size = casadi.fmax(law["coulomb_velocity"], _LEAST_EDGE), friction_size(v, motor, law)
    g = period / casadi.fmax(law["inertia"], _LEAST_EDGE)
    # The end velocity without friction, less what does not depend on it: a w + b tanh(w / edge) = rest.
    share = 1.0 if is_discrete else 0.5
    driving = motor + disturbance
    free = 2.0 * v - last[:n] + g * (driving - before)
    rest = free - g * asymmetry - (1.0 - share) * g * viscous * v
    a, b = 1.0 + share * g * viscous, g * size
    passed = casadi.SX.zeros(n)
    if not is_discrete:
        # What slides through rest has one friction before, the other one after: from the share of the period on.
        change, slowing = rest - v, b * casadi.tanh(v / edge)
        turns = v * (rest - slowing) < 0.0
        passed = casadi.if_else(turns, v / casadi.if_else(turns, slowing - change, 1.0), 0.0)
        rest, b = casadi.if_else(turns, (1.0 - passed) * change, rest), (1.0 - passed) * b
    w = end_velocity(a, b, rest, edge)
    w = casadi.if_else(last[n] > 0.5, w, v)
    passed = casadi.if_else(last[n] > 0.5, passed, 0.0)
    direction = passed * casadi.tanh(v / edge) + (1.0 - passed) * casadi.tanh(w / edge)
    torque = driving - (viscous * (share * w + (1.0 - share) * v) + size * direction + asymmetry)
    return Kernel("friction", [values, motor, disturbance, before, last, x], torque, compile=False)


def end_velocity(a: Expression, b: Expression, rest: Expression, edge: Expression) -> Expression:
    """Return the velocities w with a w + b tanh(w / edge) = rest, (n, 1).

    Args:
        a: Positive numbers, (n, 1).
        b: Numbers of 0 or more, (n, 1).
        rest: The right-hand sides, (n, 1).
        edge: The positive velocities below which the friction fades, (n, 1).
    """
    # From the solution with a straight edge, Newton's method comes nearer from one side: tanh is concave.
    slides = casadi.fabs(rest) > a * edge + b
    w = casadi.if_else(slides, (rest - casadi.sign(rest) * b) / a, rest / (a + b / edge))
    for _ in range(_ITERATIONS):
        t = casadi.tanh(w / edge)
        w -= (a * w + b * t - rest) / (a + b * (1.0 - t**2) / edge)
    return w


def _sizes(n: int, **sizes: int | None) -> list[tuple[str, int]]:
    """Return names and sizes of the arguments of a kernel; None stands for all parameters."""
    every = (len(_UNITS) + 1) * n + 4
    return [(name, every if size is None else size) for name, size in sizes.items()]


def _by_joint(values: Expression, n: int) -> dict[str, Expression]:
    return dict(zip([*_UNITS, "inertia"], casadi.vertsplit(values[:-4], n), strict=True))


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
    for name, unit in (("delay", " of periods"), ("seed", "")):
        if values[name] != np.round(values[name]):
            raise ValueError(f"JointDrives: {name} is a whole number{unit}, not {values[name]}")
