r"""Gaits of a six-legged robot.

A gait is a duty factor beta (the fraction of a cycle that a leg spends on the ground) and a delay per leg, in cycles.
At the gait's phase phi the leg with delay d has the phase frac(phi - d): it stands while that is less than beta, and
swings for the rest of the cycle. All standing feet move with the twist that is opposite to the body's: they do not
slip against each other, whatever the speed and however it changes. With one stroke per stance and the period P the body
speed is

    v = stroke / (beta P).

Feet are points (x, y, z) in the body's frame B. Arguments and results are numbers or expressions of CasADi.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi

Expression = Any  # casadi.SX, or numbers


@dataclass(frozen=True)
class Gait:
    """A gait.

    Attributes:
        duty: The duty factor beta.
        delays: The delays of the legs in cycles, in the order of LEGS.
    """

    duty: float
    delays: tuple[float, ...]

    def speed(self, stroke: Expression, period: Expression) -> Expression:
        """Return the body speed (m/s) of a walk with this stroke (m) and period (s)."""
        return stroke / (self.duty * period)

    def leg_phases(self, phase: Expression) -> Expression:
        """Return the phases of the legs in [0, 1), (6, 1), at the phase of the gait (cycles)."""
        return fraction(phase - casadi.DM(self.delays))

    def swing(self, leg_phase: Expression) -> Expression:
        """Return the progress of a leg's swing from 0 to 1; 0 for a leg in stance."""
        return casadi.if_else(leg_phase > self.duty, (leg_phase - self.duty) / (1.0 - self.duty), 0.0)

    def heights(self, phase: Expression) -> Expression:
        """Return the heights of the feet over the ground, (6, 1), at the phase of the gait, per unit of clearance."""
        return lift(self.swing(self.leg_phases(phase)))

    def advanced(
        self,
        feet: Expression,
        *,
        nominal: Expression,
        phase: Expression,
        next_phase: Expression,
        forward: Expression,
        turn: Expression,
        stance_steps: Expression,
    ) -> Expression:
        """Return the positions of the feet, shape (6, 2), after one step of the body.

        Standing feet move the opposite way. Swinging feet cover the share of their remaining way that takes them along
        `glide` from where they left the ground, without anyone remembering where that was, to half a stance ahead of
        their nominal place; that target may change meanwhile, and does when the speed does.

        Args:
            feet: The positions before the step, shape (6, 2).
            nominal: The nominal places of the feet, shape (6, 2).
            phase: The phase of the gait before the step, in cycles.
            next_phase: The phase after it.
            forward: The body's motion along its x axis in m.
            turn: The body's motion about its z axis in rad.
            stance_steps: Length of a stance in steps.
        """
        x, y, nominal_x, nominal_y = feet[:, 0], feet[:, 1], nominal[:, 0], nominal[:, 1]
        half = 0.5 * stance_steps
        after = self.leg_phases(next_phase)
        covered = glide(self.swing(self.leg_phases(phase)))
        share = (glide(self.swing(after)) - covered) / (1.0 - covered)
        stands = after <= self.duty
        return casadi.horzcat(
            casadi.if_else(
                stands, x - forward + turn * y, x + share * (nominal_x + half * (forward - turn * nominal_y) - x)
            ),
            casadi.if_else(stands, y - turn * x, y + share * (nominal_y + half * (turn * nominal_x) - y)),
        )


TRIPOD = Gait(1 / 2, (0.0, 1 / 2, 1 / 2, 0.0, 0.0, 1 / 2))
"""Three legs stand, three swing."""

RIPPLE = Gait(2 / 3, (2 / 3, 1 / 6, 1 / 3, 5 / 6, 0.0, 1 / 2))
"""Four legs stand; swings run from rear to front, the sides half a cycle apart."""

WAVE = Gait(5 / 6, (1 / 3, 5 / 6, 1 / 6, 2 / 3, 0.0, 1 / 2))
"""Five legs stand; one after the other swings, from rear to front, side after side."""

GAITS = {"tripod": TRIPOD, "ripple": RIPPLE, "wave": WAVE}


def glide(progress: Expression) -> Expression:
    """Return the share of its way that a swinging foot has covered, from 0 to 1, with zero speed at both ends."""
    return progress * progress * (3.0 - 2.0 * progress)


def lift(progress: Expression) -> Expression:
    """Return the height of a swinging foot, from 0 over 1 in the middle to 0, with zero speed at both ends."""
    rest = progress * (1.0 - progress)
    return 16.0 * rest * rest


def fraction(cycles: Expression) -> Expression:
    """Return the fractional part of ``cycles``, in [0, 1)."""
    part = cycles - casadi.floor(cycles)
    # A little less than a whole number is rounded to the next one.
    return casadi.if_else(part < 1.0, part, 0.0)
