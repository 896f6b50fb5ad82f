"""Poses in the plane: arrays X_AB = [x, y, heading] (m, rad), shape (3,), of a frame B in a frame A."""

from __future__ import annotations

from math import cos, pi, sin
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike

from vtbdrake.common.arrays import Array

Numbers = TypeVar("Numbers", float, Array)


def rotation(heading: float) -> Array:
    """Return R_AB, shape (2, 2), of a frame B that is turned by ``heading`` (rad)."""
    c, s = cos(heading), sin(heading)
    return np.array([[c, -s], [s, c]])


def rotations(headings: Array) -> Array:
    """Return R_AB of n headings (rad), (n, 2, 2); for a single one, arithmetic of arrays takes ten times as long."""
    c, s = np.cos(headings), np.sin(headings)
    return np.stack([c, -s, s, c], axis=1).reshape(-1, 2, 2)


def wrap(angle: Numbers) -> Numbers:
    """Return the angle (rad) in [-pi, pi) that means the same direction; also of arrays."""
    return (angle + pi) % (2.0 * pi) - pi


def chord(length: float, turn: float) -> Array:
    """Return the motion X_AB, (3,), along a chord (m) that points halfway through a turn (rad).

    Args:
        length: Length of the chord in m, negative backwards.
        turn: The change of the heading on the way, in rad.
    """
    return np.array([length * cos(0.5 * turn), length * sin(0.5 * turn), turn])


def compose(X_AB: ArrayLike, X_BC: ArrayLike) -> Array:
    """Return the pose X_AC of a frame C whose pose in B is X_BC.

    Args:
        X_AB: The pose of B in A, [x, y, heading], (3,) in m and rad.
        X_BC: The pose of C in B, alike.
    """
    ab, bc = np.asarray(X_AB, dtype=float), np.asarray(X_BC, dtype=float)
    return np.array([*(ab[:2] + rotation(ab[2]) @ bc[:2]), wrap(ab[2] + bc[2])])


def inverse(X_AB: ArrayLike) -> Array:
    """Return the pose X_BA of A in B."""
    ab = np.asarray(X_AB, dtype=float)
    return np.array([*(-(rotation(-ab[2]) @ ab[:2])), wrap(-ab[2])])


def transform(X_AB: ArrayLike, points_B: ArrayLike) -> Array:
    """Return points in A, shape (n, 2) in m, that are given in B.

    Args:
        X_AB: The pose of B in A, [x, y, heading], (3,) in m and rad.
        points_B: The points in B, shape (n, 2) in m.
    """
    ab = np.asarray(X_AB, dtype=float)
    points: Array = np.asarray(points_B, dtype=float) @ rotation(ab[2]).T + ab[:2]
    return points
