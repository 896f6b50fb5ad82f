r"""The predefined motions, as references for the control laws.

    0 follow   the reference is where the arm is: it can be led by hand
    1 home     in joint space to the home pose, and waits there
    2 swing    in joint space to another pose and back
    3 press    the tip moves straight ahead, waits, and returns
    4 circle   the tip moves on a circle across the tool's axis
    5 led      the tip follows a hand, see `leading`; only where the scenario is ``led_by_hand``

All start and end at rest, where the one before ended: whatever the command, the reference is continuous with its first
and second derivative. A command is obeyed when the motion under way has ended (motions repeat); `follow` at once, and
what comes after `follow` is always `home`. `led` ends when another motion is commanded and the tip has come to rest.

Everything moves by the minimum-jerk profile P(x) = 10 x^3 - 15 x^4 + 6 x^5 (Flash, Hogan, "The Coordination of Arm
Movements", 1985).
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from math import pi

import casadi

from vtbdrake_diagrams.manipulator.arm import Arm
from vtbdrake_diagrams.manipulator.dynamics import ArmDynamics, Expression
from vtbdrake_diagrams.manipulator.leading import is_at_rest, lead


class Motion(IntEnum):
    """The motions; the command ``motion`` and the state of the same name hold their numbers."""

    FOLLOW = 0
    HOME = 1
    SWING = 2
    PRESS = 3
    CIRCLE = 4
    LED = 5

    @property
    def label(self) -> str:
        """Return the name as users read it."""
        return self.name.lower()


def parameters(arm: Arm) -> dict[str, tuple[object, str, tuple[float, float]]]:
    """Return value, unit and bounds of each parameter of the motions."""
    return {
        "home": (arm.home, "rad", (-pi, pi)),
        "home_duration": (3.0, "s", (0.1, 60.0)),
        "swing": ((0.6, 0.3, -0.4, 0.4, 0.5, -0.3, 0.6), "rad", (-pi, pi)),
        "swing_duration": (5.0, "s", (0.1, 60.0)),
        "press_depth": (0.10, "m", (-0.5, 0.5)),
        "press_duration": (6.0, "s", (0.1, 60.0)),
        "circle_radius": (0.10, "m", (0.0, 0.5)),
        "circle_duration": (4.0, "s", (0.1, 60.0)),
    }


@dataclass(frozen=True)
class Reference:
    """The reference for a control law at one instant, and the next state of the motion.

    Attributes:
        in_joints: 1 while the motion is given in joint space.
        q, v, a: Joint reference (7); where the motion is Cartesian, where it started, at rest.
        dp, dv, da: Displacement of the tip (3) from its place at ``q``, in the world; 0 while the motion is in joint
            space.
        following: 1 during `follow`.
        ease: 0 at the begin and end of a Cartesian motion and at most 1 between, with its first derivative: when the
            arm may do what the tip does not feel.
        state: The next values of ``motion``, ``clock`` and ``start``, and of `leading.STATE` if a hand may lead.
    """

    in_joints: Expression
    q: Expression
    v: Expression
    a: Expression
    dp: Expression
    dv: Expression
    da: Expression
    following: Expression
    ease: Expression
    state: dict[str, Expression]


def reference(
    command: Expression,
    q: Expression,
    state: dict[str, Expression],
    p: dict[str, Expression],
    *,
    period: float,
    hand: Expression | None = None,
    model: ArmDynamics | None = None,
) -> Reference:
    """Return the reference of the motion that is under way.

    Args:
        command: The commanded motion.
        q: The measured joint positions, shape (7,), in rad.
        state: The ``motion`` under way, its ``clock`` (s), the joint positions ``start`` where it began, and the
            ``reference`` of the law at the last instant, shape (7,).
        p: The values of `parameters`.
        period: The sample period, in seconds.
        hand: The command of the hand that may lead, shape (8,); None if none may.
        model: The arm that it leads.
    """
    before = state["motion"]
    follow = command < Motion.FOLLOW + 0.5
    released = before < Motion.FOLLOW + 0.5
    away = casadi.mmax(casadi.fabs(p["home"] - state["start"])) > 1e-6
    durations = [0, away * p["home_duration"], p["swing_duration"], p["press_duration"], p["circle_duration"]]
    # The last instant of a motion, at which it has arrived, is the first of the next one.
    ended = state["clock"] > _choose(before, durations) + period / 2
    if hand is not None:
        let_go = casadi.logic_and(casadi.logic_not(_is(command, Motion.LED)), is_at_rest(state["lead_twist"]))
        ended = casadi.if_else(_is(before, Motion.LED), let_go, ended)
    begins = casadi.logic_or(released, ended)
    motion = casadi.if_else(begins, casadi.if_else(released, Motion.HOME, casadi.floor(command + 0.5)), before)
    motion = casadi.if_else(follow, Motion.FOLLOW, motion)
    clock = casadi.if_else(casadi.logic_or(follow, released), 0, casadi.if_else(begins, period, state["clock"]))
    at = casadi.if_else(casadi.logic_or(follow, released), q, state["reference"])
    start = casadi.if_else(casadi.logic_or(begins, follow), at, state["start"])

    home = _flank(clock / p["home_duration"], p["home_duration"])
    swing = _there_and_back(clock, p["swing_duration"], rise=1 / 2)
    press = _there_and_back(clock, p["press_duration"], rise=1 / 3)
    turn = _flank(clock / p["circle_duration"], p["circle_duration"])
    angle, rate, acceleration = (2 * pi * value for value in turn)
    c, s = casadi.cos(angle), casadi.sin(angle)
    circle = (
        (s, 1 - c),
        (c * rate, s * rate),
        (c * acceleration - s * rate**2, s * acceleration + c * rate**2),
    )
    is_home, is_swing = _is(motion, Motion.HOME), _is(motion, Motion.SWING)
    is_press, is_circle = _is(motion, Motion.PRESS), _is(motion, Motion.CIRCLE)
    joint = [is_home * (p["home"] - start) * home[k] + is_swing * p["swing"] * swing[k] for k in range(3)]
    tip = [
        casadi.vertcat(
            is_press * p["press_depth"] * press[k], *(is_circle * p["circle_radius"] * value for value in circle[k])
        )
        for k in range(3)
    ]
    following = {"motion": motion, "clock": clock + period, "start": start}
    in_joints = 1 - is_press - is_circle
    x = clock / (is_press * p["press_duration"] + is_circle * p["circle_duration"] + in_joints)
    ease = (1 - in_joints) * 8 / 15 * _flank(x, 1)[1]
    joint[0] += start
    if hand is not None and model is not None:
        # Until `led` has ended, whatever is commanded comes after the tip has come to rest.
        is_led, obeyed = _is(motion, Motion.LED), _is(command, Motion.LED)
        last = [state[name] for name in ("reference", "lead_twist", "lead_velocity")]
        led = lead(model, hand, obeyed, *last, p, period=period)
        joint = [casadi.if_else(is_led, *pair) for pair in zip((led.q, led.v, led.a), joint, strict=True)]
        following |= {"lead_twist": is_led * led.twist, "lead_velocity": is_led * led.v, "tip_pose": led.pose}
    return Reference(in_joints, *joint, *tip, _is(motion, Motion.FOLLOW), ease, following)


def _flank(x: Expression, duration: Expression) -> tuple[Expression, Expression, Expression]:
    """Return P(x) and its first two time derivatives, for x = t / duration, limited to [0, 1]."""
    x = casadi.fmin(casadi.fmax(x, 0), 1)
    return (
        x**3 * (10 + x * (6 * x - 15)),
        30 * x**2 * (1 - x) ** 2 / duration,
        60 * x * (1 - x) * (1 - 2 * x) / duration**2,
    )


def _there_and_back(t: Expression, duration: Expression, *, rise: float) -> tuple[Expression, Expression, Expression]:
    """Return a profile from 0 to 1 in ``rise * duration``, and back to 0 in the same time at the end."""
    back = t > duration / 2
    side = casadi.if_else(back, duration - t, t)
    value, speed, acceleration = _flank(side / (rise * duration), rise * duration)
    return value, casadi.if_else(back, -speed, speed), acceleration


def _choose(index: Expression, values: list[Expression]) -> Expression:
    return sum((_is(index, k) * value for k, value in enumerate(values)), casadi.SX(0))


def _is(index: Expression, k: int) -> Expression:
    return casadi.fabs(index - k) < 0.5
