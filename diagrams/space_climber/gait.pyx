r"""Gaits of a six-legged robot, compiled.

A gait is a duty factor beta (the fraction of a cycle that a leg spends on the ground) and a delay per leg, in cycles.
At the gait's phase phi the leg with delay d has the phase frac(phi - d): it stands while that is less than beta, and
swings for the rest of the cycle. All standing feet move with the twist that is opposite to the body's: they do not
slip against each other, whatever the speed and however it changes. With one stroke per stance and the period P the body
speed is

    v = stroke / (beta P).

Feet are points (x, y, z) in the body's frame B.
"""

from libc.math cimport floor

cimport numpy as cnp

from vtbdrake.common.array_memory cimport numbers, writable

cnp.import_array()


cdef class Gait:
    """A gait: its duty factor beta, and the delays of the legs in cycles, in the order of LEGS."""

    def __init__(self, double duty, delays):
        self.duty = duty
        self._delays = delays

    @property
    def delays(self):
        """Return the delays of the legs in cycles, six floats."""
        return tuple(self._delays)

    cpdef double speed(self, double stroke, double period) noexcept:
        """Return the body speed (m/s) of a walk with this stroke (m) and period (s)."""
        return stroke / (self.duty * period)

    cpdef double leg_phase(self, Py_ssize_t leg, double phase) noexcept:
        """Return the phase of a leg in [0, 1) at the phase of the gait (cycles)."""
        return fraction(phase - self._delays[leg])

    cpdef double swing(self, double leg_phase) noexcept:
        """Return the progress of a leg's swing from 0 to 1; 0 for a leg in stance."""
        return (leg_phase - self.duty) / (1.0 - self.duty) if leg_phase > self.duty else 0.0

    cpdef double height(self, Py_ssize_t leg, double phase) noexcept:
        """Return the height of a leg's foot over the ground at the phase of the gait, per unit of clearance."""
        return lift(self.swing(self.leg_phase(leg, phase)))

    def advance(self, feet, *, nominal, double phase, double next_phase, double forward, double turn, stance_steps):
        """Move the feet by one step of the body.

        Standing feet move the opposite way. Swinging feet cover the share of their remaining way that takes them along
        `glide` from where they left the ground, without anyone remembering where that was, to half a stance ahead of
        their nominal place; that target may change meanwhile, and does when the speed does.

        Args:
            feet: The positions before the step, shape (6, 2), which those after it overwrite.
            nominal: The nominal places of the feet, shape (6, 2).
            phase: The phase of the gait before the step, in cycles.
            next_phase: The phase after it.
            forward: The body's motion along its x axis in m.
            turn: The body's motion about its z axis in rad.
            stance_steps: Length of a stance in steps.
        """
        cdef double* x = writable(feet, 2 * LEG_COUNT)
        self.move(x, numbers(nominal, 2 * LEG_COUNT), phase, next_phase, forward, turn, stance_steps)

    cdef void move(
        self,
        double* feet,
        const double* nominal,
        double phase,
        double next_phase,
        double forward,
        double turn,
        double stance_steps,
    ) noexcept:
        """Compute `advance`."""
        cdef double half = 0.5 * stance_steps
        cdef double x, y, nx, ny, after, covered, share
        cdef Py_ssize_t k
        for k in range(LEG_COUNT):
            x, y = feet[2 * k], feet[2 * k + 1]
            after = self.leg_phase(k, next_phase)
            if after <= self.duty:
                feet[2 * k] = x - forward + turn * y
                feet[2 * k + 1] = y - turn * x
            else:
                nx, ny = nominal[2 * k], nominal[2 * k + 1]
                covered = glide(self.swing(self.leg_phase(k, phase)))
                share = (glide(self.swing(after)) - covered) / (1.0 - covered)
                feet[2 * k] = x + share * (nx + half * (forward - turn * ny) - x)
                feet[2 * k + 1] = y + share * (ny + half * (turn * nx) - y)


# Whole numbers would be divided as in C.

TRIPOD = Gait(0.5, (0.0, 0.5, 0.5, 0.0, 0.0, 0.5))
"""Three legs stand, three swing."""

RIPPLE = Gait(2.0 / 3.0, (2.0 / 3.0, 1.0 / 6.0, 1.0 / 3.0, 5.0 / 6.0, 0.0, 0.5))
"""Four legs stand; swings run from rear to front, the sides half a cycle apart."""

WAVE = Gait(5.0 / 6.0, (1.0 / 3.0, 5.0 / 6.0, 1.0 / 6.0, 2.0 / 3.0, 0.0, 0.5))
"""Five legs stand; one after the other swings, from rear to front, side after side."""

GAITS = {"tripod": TRIPOD, "ripple": RIPPLE, "wave": WAVE}


cpdef double glide(double progress) noexcept:
    """Return the share of its way that a swinging foot has covered, from 0 to 1, with zero speed at both ends."""
    return progress * progress * (3.0 - 2.0 * progress)


cpdef double lift(double progress) noexcept:
    """Return the height of a swinging foot, from 0 over 1 in the middle to 0, with zero speed at both ends."""
    cdef double rest = progress * (1.0 - progress)
    return 16.0 * rest * rest


cdef double fraction(double cycles) noexcept:
    """Return the fractional part of ``cycles``, in [0, 1)."""
    cdef double part = cycles - floor(cycles)
    # A little less than a whole number is rounded to the next one.
    return part if part < 1.0 else 0.0
