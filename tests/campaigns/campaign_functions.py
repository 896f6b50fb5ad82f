"""Functions that the campaigns of the tests draw with and measure by."""

from __future__ import annotations

import os

import numpy as np

ANGLE = "sim.sys.Pendulum.theta.position"


def start(seed: int) -> dict[str, float]:
    """Draw the angle at the start, in rad."""
    return {ANGLE: float(np.random.default_rng(seed).uniform(-1.0, 1.0))}


def small(angle: float) -> float:
    """Return the magnitude of an angle; a large one is an error."""
    if abs(angle) > 0.9:
        raise ArithmeticError("beyond the scale")
    return abs(angle)


def crashing(angle: float) -> float:
    """Return an angle; a large one kills the process."""
    if angle > 0.9:
        os._exit(3)
    return angle
