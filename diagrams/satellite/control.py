"""Control of the gripper along the moving target, and of the base's attitude by wheels."""

from __future__ import annotations

from functools import lru_cache
from math import hypot
from types import SimpleNamespace

import casadi
import numpy as np
from pydrake.systems.framework import Context, DiscreteValues

from vtbdrake.common.arrays import Array
from vtbdrake.components.casadi_system.kernel import Kernel, clamp
from vtbdrake.state import AddressedSystem, Quantity
from vtbdrake_diagrams.satellite.bodies import ARM_JOINTS, JOINT_NAMES, Servicer
from vtbdrake_diagrams.satellite.estimation import BASE
from vtbdrake_diagrams.satellite.kinematics import joint_rates
from vtbdrake_diagrams.satellite.kinematics import reaction as arm_reaction
from vtbdrake_diagrams.satellite.relative_motion import RELATIVE, gripper_errors
from vtbdrake_diagrams.satellite.supervisor import GUIDANCE, Arrival, Guidance, Mode, stopping_speed

# The distance from the ends of the arm's joints, in rad.
_MARGIN = 0.02
# The number of the rates of the arm's joints and, behind them, of the time since an abort.
_MOTION = ARM_JOINTS + 1
# Share of their opening from which on the fingers release the bar.
_OPEN = 0.9

LARGEST_REACTION = 2.5
"""The largest torque of the arm on the base with wheels, in N m.

They give a fifth of it. With less the base turns less, and the capture takes longer."""
ACCELERATION = 0.1
"""The acceleration of the gripper that goes with it, in m/s^2: the arm has about 20 N m s at 1 m/s."""
UNLIMITED = 1e6
"""A value that stands for no limit of both, since parameters are finite."""
# The share of the largest reaction by which a change of the rates may always add to it, so that the arm can stop.
_LEAST = 0.1


class ArmController(AddressedSystem):
    r"""Resolved-rate control of the gripper, with the base's motion subtracted, and of the fingers.

    .. pydrake_system::

        name: ArmController
        input_ports:
        - relative
        - guidance
        - joint_position
        - arrival (only with ``plans``)
        - plan_position (only with ``plans``)
        output_ports:
        - joint_position
        - reaction

    While the supervisor lets it follow, the gripper is to be at D, at ``distance`` before the fixture H along its z
    axis (turned by pi about it if ``flip``). With the errors e of position and orientation in B,

        V_BG = V_BD + [K_R e_R; s(e_p)],   |K_R e_R| <= turn_rate,   |s(e_p)| <= speed,
        qdot = J+ V_BG + (1 - J+ J) k (rest - q),   J+ = J' (J J' + damping^2)^-1,

    where V_BD is the velocity of D against the base, in which the base's own motion is subtracted already, and s is
    K_p e_p near D and farther away the speed of `stopping_speed`. All rates are scaled down together if one exceeds
    ``joint_rate``. The output integrates qdot, and stays within ``lead`` of the measured positions.

    With ``wheels`` the arm moves less abruptly. Its motion has the angular momentum h_B, see `reaction` in
    ``kinematics.py``, from the mode retreat on with the target. The rates go as far towards what they should be as
    h_B then changes by ``largest_reaction`` (N m) at most. The output ``reaction`` is dh_B/dt (N m), the torque that
    keeps the base's attitude; 0 without wheels.

    With ``plans``, the arm follows ``plan_position`` (7, rad) while ``arrival`` is `Arrival.PLANNED`, within its
    drives' rates; the plan has limits of its own. What its momentum changes by is part of ``reaction``, too.

    Otherwise the rates decay (time constant ``brake_time``). After an abort, when the fingers are open, the gripper
    backs off along its z axis for ``back_off`` seconds, and the arm returns to where it was stowed. The fingers follow
    the guidance's opening with ``finger_rate``.
    """

    def __init__(self, *, period: float, wheels: bool = False, plans: bool = False) -> None:
        super().__init__()
        self._period, self._wheels, self._plans = period, wheels, plans
        servicer = Servicer()
        self._speeds = servicer.speeds
        if plans:
            self._arrival = self.DeclareVectorInputPort("arrival", 1)
            self._plan_position = self.DeclareVectorInputPort("plan_position", ARM_JOINTS)
        self._relative = self.DeclareVectorInputPort("relative", RELATIVE)
        self._guidance = self.DeclareVectorInputPort("guidance", GUIDANCE)
        self._joints = self.DeclareVectorInputPort("joint_position", len(JOINT_NAMES))
        self._command = self.declare_discrete_state(joint_position=Quantity(servicer.home, "rad, m"))
        self.DeclareStateOutputPort("joint_position", self._command.index)
        self._motion = self.declare_discrete_state(
            joint_rate_command=Quantity(np.zeros(ARM_JOINTS), "rad/s"), aborted_for=Quantity(0.0, "s")
        )
        self._measured = self.declare_discrete_state(measured_position=Quantity(servicer.home, "rad, m"))
        # The momentum of the arm's motion, and whether the target is part of it.
        self._momentum = self.declare_discrete_state(
            momentum=Quantity(np.zeros(3), "N m s"), holding=Quantity(0.0, bounds=(0.0, 1.0))
        )
        self._torque = self.declare_discrete_state(reaction=Quantity(np.zeros(3), "N m"))
        self.DeclareStateOutputPort("reaction", self._torque.index)
        settings = {
            # Value, unit, and the largest value. What is written while the arm moves comes to it: a gain times the
            # period stays far below 1, speeds and rates lie within what its drives follow.
            "position_gain": (1.0, "1/s", 10.0),
            "orientation_gain": (1.0, "1/s", 10.0),
            "speed": (0.12, "m/s", 0.5),
            "turn_rate": (0.25, "rad/s", 1.0),
            "acceleration": (ACCELERATION if wheels else UNLIMITED, "m/s^2", UNLIMITED),
            "largest_reaction": (LARGEST_REACTION if wheels else UNLIMITED, "N m", UNLIMITED),
            "joint_rate": (0.4, "rad/s", 1.0),
            "posture_gain": (0.3, "1/s", 10.0),
            "damping": (0.05, "1", 10.0),
            "lead": (0.2, "rad", 1.0),
            "brake_time": (1.5, "s", 60.0),
            "finger_rate": (0.03, "m/s", 0.1),
            "back_off": (4.0, "s", 60.0),
            "back_off_speed": (0.08, "m/s", 0.5),
        }
        self._settings = self.declare_parameters(
            **{name: Quantity(value, unit, (0.0, most)) for name, (value, unit, most) in settings.items()}
        )
        self._rates, self._moved = _rates(tuple(settings), period), _moved(tuple(settings), period)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)

    def _update(self, context: Context, state: DiscreteValues) -> None:
        settings, guidance = self._settings.array(context), self._guidance.Eval(context)
        relative, measured = self._relative.Eval(context), self._joints.Eval(context)
        command, motion = self._command.mutable_array(state), self._motion.mutable_array(state)
        following = self._rates.value((settings, guidance, relative, measured, command, motion))
        most = self._settings.view(context).largest_reaction
        if self._plans and self._arrival.Eval(context).item() == Arrival.PLANNED:
            ahead = (self._plan_position.Eval(context) - command[:ARM_JOINTS]) / self._period
            following[:ARM_JOINTS] = np.clip(ahead, -self._speeds, self._speeds)
            most = UNLIMITED
        if self._wheels:
            rates = self._gentle(context, state, motion[:ARM_JOINTS], following[:ARM_JOINTS], most)
            following[:ARM_JOINTS] = rates
        motion[:] = following
        command[:] = self._moved.value((settings, guidance, measured, command, motion))
        self._measured.mutable_array(state)[:] = measured

    def _gentle(self, context: Context, state: DiscreteValues, before: Array, rates: Array, reaction: float) -> Array:
        """Return the rates on the way from the last period's to ``rates`` whose momentum changes by a reaction at most.

        The momentum and its rate are written to ``state``.
        """
        q, mode = self._joints.Eval(context)[:ARM_JOINTS], Guidance.of(self._guidance.Eval(context)).mode
        most = self._period * reaction
        momentum, holding = self._momentum.mutable(state), mode in (Mode.RETREAT, Mode.HOLD)
        kernel = arm_reaction(holding=holding)
        unchanged = kernel.value((q, before))[:3].copy()
        change = kernel.value((q, rates))[:3] - unchanged
        # When the target is gripped, its momentum comes at once.
        had = momentum.momentum.copy() if holding == (momentum.holding > 0.5) else unchanged
        room = np.maximum(most - np.sign(change) * (unchanged - had), _LEAST * most)
        share = min(1.0, float((room / np.maximum(np.abs(change), 1e-12)).min()))
        has = unchanged + share * change
        momentum.momentum, momentum.holding = has, holding
        self._torque.mutable(state).reaction = (has - had) / self._period
        return before + share * (rates - before)


@lru_cache
def _rates(settings: tuple[str, ...], period: float) -> Kernel:
    """Return the rates of the joints and the time since an abort, before wheels limit the rates.

    It is a kernel of (settings, guidance, relative, measured positions, commanded positions, rates and time before).
    """
    values, p = _symbols(settings)
    instructions, relative = casadi.SX.sym("guidance", GUIDANCE), casadi.SX.sym("relative", RELATIVE)
    measured, command = (casadi.SX.sym(name, len(JOINT_NAMES)) for name in ("measured", "command"))
    motion = casadi.SX.sym("motion", _MOTION)
    before, aborted_for = motion[:ARM_JOINTS], motion[ARM_JOINTS]
    guidance, servicer = Guidance(*casadi.vertsplit(instructions)), Servicer()

    # Where it follows: the velocity of D, and back to it.
    axis, w_BH, v_BH, tool = relative[4:11:3], relative[14:17], relative[17:20], relative[22:29:3]
    e_p, e_R = gripper_errors(relative, guidance.distance, guidance.flip)
    v_BD = v_BH - casadi.cross(w_BH, guidance.distance * axis) - guidance.rate * axis
    length = casadi.norm_2(e_p)
    speed = casadi.fmin(p.speed, stopping_speed(length, gain=p.position_gain, acceleration=p.acceleration))
    turn = p.orientation_gain * e_R
    turn *= casadi.fmin(1, p.turn_rate / casadi.fmax(casadi.norm_2(turn), 1e-9))
    V_BG = casadi.vertcat(w_BH + turn, v_BD + speed * e_p / casadi.fmax(length, 1e-9))

    # After an abort: back along the gripper's axis, then to where the arm was stowed.
    opened = casadi.mmin(measured[ARM_JOINTS:]) > _OPEN * guidance.opening
    returns = casadi.logic_and(guidance.mode == Mode.ABORT, opened)
    aborted_for += casadi.if_else(returns, period, 0)
    backs_off = casadi.logic_and(returns, aborted_for < p.back_off)
    V_BG = casadi.if_else(backs_off, casadi.vertcat(0, 0, 0, -p.back_off_speed * tool), V_BG)
    gains = casadi.vertcat(casadi.if_else(backs_off, 0, p.posture_gain), p.damping)
    led = joint_rates().expression([measured[:ARM_JOINTS], V_BG, gains])
    stowing = clamp(casadi.DM(servicer.stowed) - command[:ARM_JOINTS], -0.5 * p.joint_rate, 0.5 * p.joint_rate)
    braking = casadi.if_else(
        guidance.mode >= Mode.RETREAT, before * casadi.exp(-period / casadi.fmax(p.brake_time, period)), 0
    )

    rates = casadi.if_else(guidance.follows > 0.5, led, braking)
    rates = casadi.if_else(returns, casadi.if_else(backs_off, led, stowing), rates)
    rates *= casadi.fmin(1, p.joint_rate / casadi.fmax(casadi.mmax(casadi.fabs(rates)), 1e-9))
    arguments = [values, instructions, relative, measured, command, motion]
    return Kernel("rates", arguments, casadi.densify(casadi.vertcat(rates, aborted_for)), compile=None)


@lru_cache
def _moved(settings: tuple[str, ...], period: float) -> Kernel:
    """Return the commands after a period with some rates, within the limits of the arm and of ``lead``.

    It is a kernel of (settings, guidance, measured positions, commanded positions, rates and time since an abort).
    """
    values, p = _symbols(settings)
    instructions, motion = casadi.SX.sym("guidance", GUIDANCE), casadi.SX.sym("motion", _MOTION)
    measured, command = (casadi.SX.sym(name, len(JOINT_NAMES)) for name in ("measured", "command"))
    servicer, q, fingers = Servicer(), measured[:ARM_JOINTS], command[ARM_JOINTS:]
    lower, upper = casadi.DM(servicer.lower + _MARGIN), casadi.DM(servicer.upper - _MARGIN)
    arm = clamp(clamp(command[:ARM_JOINTS] + period * motion[:ARM_JOINTS], q - p.lead, q + p.lead), lower, upper)
    fingers += clamp(
        Guidance(*casadi.vertsplit(instructions)).opening - fingers, -period * p.finger_rate, period * p.finger_rate
    )
    return Kernel(
        "moved", [values, instructions, measured, command, motion], casadi.vertcat(arm, fingers), compile=None
    )


def _symbols(names: tuple[str, ...]) -> tuple[casadi.SX, SimpleNamespace]:
    """Return the symbol of a vector, and its entries by name."""
    vector = casadi.SX.sym("settings", len(names))
    return vector, SimpleNamespace(**dict(zip(names, casadi.vertsplit(vector), strict=True)))


class AttitudeController(AddressedSystem):
    r"""Holds the base's attitude by reaction wheels, against the motion of the arm.

    .. pydrake_system::

        name: AttitudeController
        input_ports:
        - base
        - joint_position
        - reaction
        - guidance
        output_ports:
        - wheel_torque

    ``base`` comes from a `BaseEstimator`, ``reaction`` from the `ArmController`. ``wheel_torque``, on the base about
    its axes (N m), is

        tau = dh_B/dt - J_B 2 b (w + u(theta)),   |u(theta)| = `stopping_speed` of |theta|,

    with theta the rotation vector since the start, in B, u along it, the ``bandwidth`` b (gain b / 2, so that small
    turns are critically damped), and the inertia J_B of base and arm; from the mode retreat on, with the target. The
    deceleration on the way back is half of what the wheels can do, so that they do not saturate before the end.
    """

    def __init__(self, *, period: float) -> None:
        super().__init__()
        self._torque = Servicer().wheel_torque
        self._base = self.DeclareVectorInputPort("base", BASE)
        self._joints = self.DeclareVectorInputPort("joint_position", len(JOINT_NAMES))
        self._reaction = self.DeclareVectorInputPort("reaction", 3)
        self._guidance = self.DeclareVectorInputPort("guidance", GUIDANCE)
        self._command = self.declare_discrete_state(wheel_torque=Quantity(np.zeros(3), "N m"))
        self.DeclareStateOutputPort("wheel_torque", self._command.index)
        self._settings = self.declare_parameters(bandwidth=Quantity(0.5, "rad/s", (0.0, 5.0)))
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)

    def _update(self, context: Context, state: DiscreteValues) -> None:
        bandwidth = self._settings.view(context).bandwidth
        base, q = self._base.Eval(context), self._joints.Eval(context)[:ARM_JOINTS]
        holding = Guidance.of(self._guidance.Eval(context)).mode in (Mode.RETREAT, Mode.HOLD)
        J = arm_reaction(holding=holding).value((q, np.zeros(ARM_JOINTS)))[3:].reshape(3, 3)
        # The rotation vector of a small turn, whichever the sign of the quaternion; the same in B and in I. And
        # R_IB' w_IB: for the rate, too, the base's turn is small.
        theta, w = 2.0 * np.copysign(1.0, base[1]) * base[2:5], base[8:11]
        angle = hypot(*theta.tolist())
        brakes = 0.5 * self._torque / float(J.diagonal().max())
        back = stopping_speed(angle, gain=0.5 * bandwidth, acceleration=brakes) * theta / max(angle, 1e-9)
        self._command.mutable(state).wheel_torque = self._reaction.Eval(context) - J @ (2.0 * bandwidth * (w + back))
