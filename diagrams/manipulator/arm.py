"""Dimensions, masses and limits of a seven-joint arm in the style of KUKA's LBR iiwa 14 R820.

Sources of the numbers:

* [P] published in the data sheet "LBR iiwa 7 R800, LBR iiwa 14 R820" (KUKA, 2015): lengths between the axes, joint
  ranges, joint speeds, joint torques, 29.9 kg in all.
* [D] derived: follows from the other numbers for the reason given beside it.
* [A] assumed: plausible, not published.

Frames: link i has its origin on the axis of joint i; at zero joint angles all links' axes are parallel to the world's
and the arm points straight up. S (the link ``tool``) is where the force/torque sensor sits, at the flange; T is the
centre of the ball at the tool's tip.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from pydrake.multibody.tree import SpatialInertia

from vtbdrake_diagrams.sdf import IIWA_AXES

JOINTS = 7
JOINT_NAMES = tuple(f"joint_{k}" for k in range(1, JOINTS + 1))
LINK_NAMES = tuple(f"link_{k}" for k in range(1, JOINTS + 1))
GRAVITY = 9.81
"""Acceleration of free fall (m/s^2)."""


def _deg(*angles: float) -> NDArray[np.float64]:
    return np.radians(angles)


@dataclass(frozen=True)
class Arm:
    """The arm. [P], [D] and [A] are explained above; one entry per joint where there are seven."""

    # From each joint to the next, and from the last one to the flange, along z (m).
    base_height: float = 0.1575  # [A] [P] gives 0.36 m from the floor to joint 2
    lengths: tuple[float, ...] = (0.2025, 0.2045, 0.2155, 0.1845, 0.2155, 0.081, 0.045)  # [P] in sums of two
    # Which axis of the link a joint turns about; as in the iiwa.
    axes: tuple[tuple[int, int, int], ...] = IIWA_AXES
    radii: tuple[float, ...] = (0.075, 0.075, 0.07, 0.07, 0.06, 0.06, 0.04)  # [A] of the links, solid cylinders
    base_mass: float = 5.4  # [D] 29.9 kg [P] less the links
    masses: tuple[float, ...] = (5.5, 5.5, 4.0, 4.0, 3.0, 2.0, 0.5)  # [A]

    # The tool: a rod that ends in a ball.
    tool_length: float = 0.12  # [A] from the flange to the ball's centre
    tool_radius: float = 0.015  # [A]
    tool_mass: float = 0.4  # [A] of rod and ball
    ball_radius: float = 0.02  # [A]

    # Drives.
    gear_ratio: float = 100.0  # [A]
    rotor_inertias: tuple[float, ...] = (4e-5, 4e-5, 3e-5, 3e-5, 2e-5, 1e-5, 1e-5)  # [A] kg m^2, of the motors
    viscous_friction: tuple[float, ...] = (1.0, 1.0, 0.7, 0.7, 0.5, 0.3, 0.3)  # [A] N m s/rad, at the joints
    coulomb_friction: tuple[float, ...] = (0.4, 0.4, 0.3, 0.3, 0.2, 0.1, 0.1)  # [A] N m
    current_time_constant: float = 0.0005  # [A] s

    # Limits.
    lower: NDArray[np.float64] = field(default_factory=lambda: -_deg(170, 120, 170, 120, 170, 120, 175))  # [P] rad
    upper: NDArray[np.float64] = field(default_factory=lambda: _deg(170, 120, 170, 120, 170, 120, 175))  # [P] rad
    speeds: NDArray[np.float64] = field(default_factory=lambda: _deg(85, 85, 100, 75, 130, 135, 135))  # [P] rad/s
    torques: tuple[float, ...] = (320.0, 320.0, 176.0, 176.0, 110.0, 40.0, 40.0)  # [P] N m
    torque_rates: tuple[float, ...] = (6400.0, 6400.0, 3520.0, 3520.0, 2200.0, 800.0, 800.0)  # [A] full torque in 50 ms

    # Where the arm waits: the tool points along the world's x.
    home: tuple[float, ...] = (0.0, 0.4, 0.0, -1.7, 0.0, float(np.pi) / 2 - 2.1, 0.0)  # [A] rad

    @property
    def offsets(self) -> tuple[float, ...]:
        """Distance from the origin of the previous link to the origin of each link, along z (m)."""
        return (self.base_height, *self.lengths[:-1])

    @property
    def reflected_inertias(self) -> NDArray[np.float64]:
        """Inertias of the rotors about the axes of the joints, N^2 I, shape (7,), in kg m^2."""
        return self.gear_ratio**2 * np.array(self.rotor_inertias)

    def link_inertia(self, k: int) -> SpatialInertia:
        """Return M_LLo_L of link k (0 is the first), a solid cylinder that reaches to the next joint."""
        length = self.lengths[k]
        return _cylinder(self.masses[k], self.radii[k], length)

    def base_inertia(self) -> SpatialInertia:
        """Return M_BBo_B of the base, which stands on the floor."""
        return _cylinder(self.base_mass, self.radii[0], self.base_height)

    def tool_inertia(self) -> SpatialInertia:
        """Return M_SSo_S of the tool."""
        return _cylinder(self.tool_mass, self.tool_radius, self.tool_length + self.ball_radius)


def _cylinder(mass: float, radius: float, length: float) -> SpatialInertia:
    """Return the inertia about the lower end."""
    centered = SpatialInertia.SolidCylinderWithMass(mass, radius, length, [0.0, 0.0, 1.0])
    return centered.Shift([0.0, 0.0, -length / 2])
