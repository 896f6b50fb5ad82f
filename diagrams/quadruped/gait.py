"""The trot of the quadruped, and the angles of its joints, as a function in CasADi."""

from __future__ import annotations

from dataclasses import dataclass

import casadi

from vtbdrake.common.spline import Spline
from vtbdrake_diagrams.quadruped.model import LEGS, Quadruped

OFFSETS = (
    "x of the first pair",
    "y of the first pair",
    "x of the second pair",
    "y of the second pair",
    "roll",
    "pitch",
)
"""The offsets that are added to the trot: to the feet of a diagonal pair (m), and to the height of all feet (rad)."""

# The legs of the diagonal pair that swings first.
_FIRST = ("front_left", "hind_right")
# A leg is never stretched further than to this share of its length, nor bent to less than this.
_LONGEST = 0.98
_SHORTEST = 0.35


@dataclass(frozen=True)
class Trot:
    """A trot: the diagonal pairs of legs swing in turn.

    Attributes:
        period: Time of both swings in s.
        lift: Height of a foot in the middle of its swing, in m.
    """

    period: float = 0.36
    lift: float = 0.06


def desired_state(quadruped: Quadruped, trot: Trot, plan: Spline, *, lead: float) -> casadi.Function:
    """Return the function (plan, velocity, t) -> (desired, offset): what the drives hold at the time t.

    ``plan`` = [t_begin, knots of `OFFSETS`] is a spline that holds its first and its last value before and after it;
    ``velocity``, shape (2,), is the trunk's, forwards and to the left, in m/s; ``t`` is in s. ``offset``, shape (6,),
    is the plan's value at t + lead. ``desired``, shape (24,), has the angles of `JOINT_NAMES` (rad) at t + lead, then
    their derivatives (rad/s) with this offset and velocity.

    The foot of a leg that stands is ``velocity`` times the time to its middle before its hip, and moves backwards; in
    the swing it moves forwards and is lifted by ``lift sin^2(pi s)``, where s is the part of the swing that is over.

    Args:
        quadruped: The robot.
        trot: The trot.
        plan: The curve of a plan, of order ``linear``.
        lead: How far ahead the drives hold what is desired, in s: a drive that holds it for a period is at the end of
            the period where it should be then.

    Raises:
        ValueError: The curve has another order.
    """
    if plan.order != "linear":
        raise ValueError(f"the offsets of a trot follow a linear spline, not one of order {plan.order!r}")
    velocity, now = casadi.SX.sym("velocity", 2), casadi.SX.sym("t")
    knots = casadi.SX.sym("plan", 1 + plan.knots * len(OFFSETS))
    t = now + lead
    place = casadi.fmin(casadi.fmax((t - knots[0]) / plan.step, 0.0), plan.knots - 1)
    weights = casadi.vertcat(*(casadi.fmax(1.0 - casadi.fabs(place - k), 0.0) for k in range(plan.knots)))
    value = casadi.reshape(knots[1:], len(OFFSETS), plan.knots) @ weights
    offset = casadi.SX.sym("offset", len(OFFSETS))
    angles = []
    for leg, (front, left) in LEGS.items():
        is_first = leg in _FIRST
        phase = casadi.fmod(t / trot.period + (0.0 if is_first else 0.5), 1.0)
        s = 2.0 * phase  # In [0, 1] it swings, in [1, 2] it stands.
        swinging = s < 1.0
        # From -1/2 to 1/2 of the way in a swing, with no speed at its ends beyond the ground's.
        forwards = s - 0.5 - casadi.sin(2.0 * casadi.pi * s) / casadi.pi
        way = casadi.if_else(swinging, forwards, 1.5 - s)
        lift = casadi.if_else(swinging, trot.lift * casadi.sin(casadi.pi * s) ** 2, 0.0)
        shift = offset[:2] if is_first else offset[2:4]
        step = 0.5 * trot.period * velocity * way + shift
        tilt = left * (quadruped.hip_y + quadruped.hip_length) * offset[4] - front * quadruped.hip_x * offset[5]
        z = lift - quadruped.leg_height - tilt
        angles.append(_leg_angles(quadruped, left, step[0], left * quadruped.hip_length + step[1], z))
    q = casadi.vertcat(*angles)
    # The rates leave the offset as it is, though it depends on the time, too.
    both = casadi.vertcat(q, casadi.jtimes(q, now, casadi.SX(1.0)))
    desired = casadi.densify(casadi.substitute(both, offset, value))
    arguments, results = [knots, velocity, now], [desired, casadi.densify(value)]
    return casadi.Function("trot", arguments, results, ["plan", "velocity", "t"], ["desired", "offset"])


def _leg_angles(quadruped: Quadruped, left: int, x: casadi.SX, y: casadi.SX, z: casadi.SX) -> casadi.SX:
    """Return the angles of hip, thigh and knee that bring the foot to (x, y, z) from the hip; the knee points back."""
    link, side = quadruped.link, left * quadruped.hip_length
    h = casadi.sqrt(casadi.fmax(y**2 + z**2 - side**2, (_SHORTEST * link) ** 2))
    hip = casadi.atan2(z, y) - casadi.atan2(-h, side)
    reach = casadi.sqrt(x**2 + h**2)
    half = casadi.fmin(casadi.fmax(reach / (2.0 * link), _SHORTEST), _LONGEST)
    bend = casadi.acos(half)
    return casadi.vertcat(hip, casadi.atan2(-x, h) + bend, -2.0 * bend)
