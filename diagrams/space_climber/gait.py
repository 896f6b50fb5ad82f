r"""Gaits of a six-legged robot, as pure functions.

A gait is a duty factor beta (the fraction of a cycle that a leg spends on the ground) and a delay per leg, in cycles.
At the gait's phase phi the leg with delay d has the phase frac(phi - d): it stands while that is less than beta, and
swings for the rest of the cycle. All standing feet move with the twist that is opposite to the body's: they do not
slip against each other, whatever the speed and however it changes. With one stroke per stance and the period P the body
speed is

    v = stroke / (beta P).

Feet are points (x, y, z) in the body's frame B. For six legs, plain floats are faster than numpy.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class Gait:
    """A gait: its duty factor beta, and the delays of the legs in cycles, in the order of LEGS."""

    duty: float
    delays: tuple[float, float, float, float, float, float]

    def speed(self, *, stroke: float, period: float) -> float:
        """Return the body speed (m/s) of a walk with this stroke (m) and period (s)."""
        return stroke / (self.duty * period)

    def leg_phases(self, phase: float) -> list[float]:
        """Return the phases of the legs in [0, 1) at the phase of the gait (cycles)."""
        return [(phase - delay) % 1.0 for delay in self.delays]

    def swing(self, leg_phase: float) -> float:
        """Return the progress of a leg's swing from 0 to 1; 0 for a leg in stance."""
        return (leg_phase - self.duty) / (1.0 - self.duty) if leg_phase > self.duty else 0.0


TRIPOD = Gait(1 / 2, (0.0, 1 / 2, 1 / 2, 0.0, 0.0, 1 / 2))
"""Three legs stand, three swing."""

RIPPLE = Gait(2 / 3, (2 / 3, 1 / 6, 1 / 3, 5 / 6, 0.0, 1 / 2))
"""Four legs stand; swings run from rear to front, the sides half a cycle apart."""

WAVE = Gait(5 / 6, (1 / 3, 5 / 6, 1 / 6, 2 / 3, 0.0, 1 / 2))
"""Five legs stand; one after the other swings, from rear to front, side after side."""

GAITS = {"tripod": TRIPOD, "ripple": RIPPLE, "wave": WAVE}


def glide(progress: float) -> float:
    """Return the share of its way that a swinging foot has covered, from 0 to 1, with zero speed at both ends."""
    return progress * progress * (3.0 - 2.0 * progress)


def lift(progress: float) -> float:
    """Return the height of a swinging foot, from 0 over 1 in the middle to 0, with zero speed at both ends."""
    rest = progress * (1.0 - progress)
    return 16.0 * rest * rest


def advance(
    gait: Gait,
    feet: Sequence[float],
    *,
    nominal: Sequence[tuple[float, float]],
    phase: float,
    next_phase: float,
    step: tuple[float, float, float],
    stance_steps: float,
) -> list[float]:
    """Return the horizontal foot positions [x0, y0, x1, ...] after one step of the body.

    ``step`` is the body's motion in this step, (forward, left, yaw). Standing feet move the opposite way. Swinging feet
    cover the share of their remaining way that takes them along `glide` from where they left the ground, without anyone
    remembering where that was, to half a stance (``stance_steps`` steps) ahead of their nominal place; that target may
    change meanwhile, and does when the speed does.
    """
    dx, dy, turn = step
    half = 0.5 * stance_steps
    moved: list[float] = []
    legs = zip(gait.leg_phases(phase), gait.leg_phases(next_phase), nominal, strict=True)
    for k, (before, after, (nx, ny)) in enumerate(legs):
        x, y = feet[2 * k], feet[2 * k + 1]
        if after <= gait.duty:
            moved += (x - dx + turn * y, y - dy - turn * x)
        else:
            covered = glide(gait.swing(before))
            share = (glide(gait.swing(after)) - covered) / (1.0 - covered)
            target_x, target_y = nx + half * (dx - turn * ny), ny + half * (dy + turn * nx)
            moved += (x + share * (target_x - x), y + share * (target_y - y))
    return moved


def heights(gait: Gait, phase: float) -> list[float]:
    """Return the heights of the feet over the ground, per unit of clearance."""
    return [lift(gait.swing(leg)) for leg in gait.leg_phases(phase)]
