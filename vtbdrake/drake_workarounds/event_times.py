"""How early the events of slow parts are, so that Drake skips none of them.

Fault: Drake computes the number of the next periodic event as (t - offset) / period, rounded up, so that a rounding
error skips an event with an offset when a simulation is advanced to exactly its time. It also skips an event that is
due the last bit of a number after another one. Issues: https://github.com/RobotLocomotion/drake/issues/4325 (the same
arithmetic, mended for events without an offset) and https://github.com/RobotLocomotion/drake/issues/14552 (offsets that
are lost at large times).
"""

from __future__ import annotations

SAMPLED_EARLY = 1e-8
"""The time in s by which a sample is taken before its instant: the result is there at that instant."""

SHOWN_EARLY = 2e-8
"""The time in s by which a result is shown before its instant: earlier than samples of the same instant are taken."""
