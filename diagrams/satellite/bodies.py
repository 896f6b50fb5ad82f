"""Dimensions, masses, limits and places of markers of the servicer and of its target: assumed, of plausible size.

Frames, all in metres:

* B, the servicer's base: origin in the centre of its box, x towards the target, z up. The arm stands on the front face.
* G, the gripper: origin between the fingers, z out of the hand (the direction of approach); the fingers close along x.
* T, the target: origin in its centre of mass; its front face looks along -x.
* H, the grapple fixture (``grapple``) of the target: origin in the bar's middle, y along the bar, z into the target.
  The fixture is gripped when G and H coincide, or when G is turned by 180 deg about z.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.tree import SpatialInertia

from vtbdrake_diagrams.sdf import IIWA_AXES

ARM_JOINTS = 7
ARM_JOINT_NAMES = tuple(f"joint_{k}" for k in range(1, ARM_JOINTS + 1))
LINK_NAMES = tuple(f"link_{k}" for k in range(1, ARM_JOINTS + 1))
FINGER_NAMES = ("finger_left", "finger_right")
FINGER_JOINT_NAMES = ("slide_left", "slide_right")
JOINT_NAMES = (*ARM_JOINT_NAMES, *FINGER_JOINT_NAMES)
"""The driven joints of the servicer, in the order of its signals. Where both fingers are at 0, their pads touch."""
WHEEL_JOINT_NAMES = ("wheel_x", "wheel_y", "wheel_z")


def _angles(*degrees: float) -> NDArray[np.float64]:
    return np.radians(degrees)


@dataclass(frozen=True)
class Servicer:
    """The service satellite; one entry per arm joint where there are seven."""

    # Base: a box with two solar panels, which reach from it along +-y.
    box: tuple[float, float, float] = (1.2, 1.0, 1.0)
    box_mass: float = 370.0
    panel: tuple[float, float, float] = (0.8, 1.8, 0.03)
    panel_mass: float = 15.0
    panel_gap: float = 0.3  # between box and panel

    # Arm: its first axis is parallel to B's x, its elbow hangs down so that the camera looks over it.
    shoulder: tuple[float, float, float] = (0.6, 0.0, -0.35)  # p_BoS_B of its foot, on the front face
    foot: float = 0.12  # from the foot to joint 2, along the first axis, is foot + lengths[0]
    lengths: tuple[float, ...] = (0.08, 0.4, 0.4, 0.35, 0.35, 0.08, 0.07)  # from each joint to the next, the last to S
    axes: tuple[tuple[int, int, int], ...] = IIWA_AXES
    masses: tuple[float, ...] = (6.0, 6.5, 6.0, 5.5, 5.0, 3.0, 2.0)
    radii: tuple[float, ...] = (0.08, 0.07, 0.065, 0.065, 0.06, 0.06, 0.055)
    lower: NDArray[np.float64] = field(default_factory=lambda: -_angles(175, 125, 175, 150, 175, 125, 175))
    upper: NDArray[np.float64] = field(default_factory=lambda: _angles(175, 125, 175, 150, 175, 125, 175))
    speeds: NDArray[np.float64] = field(default_factory=lambda: np.full(7, 0.5))  # rad/s
    torques: tuple[float, ...] = (150.0, 150.0, 120.0, 120.0, 80.0, 60.0, 60.0)  # N m
    stiffness: float = 4000.0  # N m/rad, of the position servos
    damping: float = 300.0  # N m s/rad

    # Gripper: two fingers on prismatic joints, each with a lip at its tip that hooks behind the bar.
    hand: tuple[float, float, float] = (0.16, 0.10, 0.06)
    hand_mass: float = 2.0
    finger: tuple[float, float, float] = (0.012, 0.08, 0.10)  # thickness, width along the bar, length
    lip: tuple[float, float, float] = (0.012, 0.08, 0.012)
    finger_mass: float = 0.3
    opening: float = 0.055  # largest distance of a finger's pad from the middle
    finger_force: float = 80.0  # N
    finger_stiffness: float = 4000.0  # N/m
    finger_damping: float = 200.0  # N s/m
    finger_speed: float = 0.05  # m/s
    tool: float = 0.1  # from the hand's flange to G, along z

    # Where the arm waits, and where it is when the bar is in the middle of its workspace (rad).
    stowed: tuple[float, ...] = (0.0, 1.9, 0.0, 2.4, 0.0, 0.9, 0.0)

    # Reaction wheels, one about each axis of B.
    housing_mass: float = 3.0
    wheel_mass: float = 5.0
    wheel_radius: float = 0.15
    wheel_torque: float = 0.5  # N m
    wheel_speed: float = 600.0  # rad/s

    # Mounts of the sensors: X_BC of the docking camera and X_BL of the laser scanner.
    camera_position: tuple[float, float, float] = (0.62, 0.0, 0.40)
    camera_tilt: float = 0.15  # rad, down
    scanner_position: tuple[float, float, float] = (0.62, 0.25, 0.40)

    @property
    def offsets(self) -> tuple[float, ...]:
        """Distance from the origin of the previous link (the foot, for the first) to its own, along z (m)."""
        return (self.foot, *self.lengths[:-1])

    @property
    def home(self) -> NDArray[np.float64]:
        """Positions of all driven joints when the arm is stowed and the gripper open, shape (9,)."""
        return np.array([*self.stowed, self.opening, self.opening])

    @property
    def X_BA(self) -> RigidTransform:
        """Pose of the arm's foot: its z axis is B's x."""
        return RigidTransform(RotationMatrix.MakeYRotation(np.pi / 2), self.shoulder)

    @property
    def X_BC(self) -> RigidTransform:
        """Nominal pose of the docking camera (x right, y down, z forward)."""
        forward = RotationMatrix(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]))
        return RigidTransform(RotationMatrix.MakeYRotation(self.camera_tilt) @ forward, self.camera_position)

    @property
    def X_BL(self) -> RigidTransform:
        """Nominal pose of the laser scanner (x forward, z up)."""
        return RigidTransform(RotationMatrix.MakeYRotation(self.camera_tilt), self.scanner_position)

    def base_inertia(self) -> SpatialInertia:
        """Return M_BBo_B of box and panels."""
        total = SpatialInertia.SolidBoxWithMass(self.box_mass, *self.box)
        for y in self.panel_centers:
            total += _box(self.panel_mass, self.panel, (0.0, y, 0.0))
        return total

    @property
    def panel_centers(self) -> tuple[float, float]:
        """The y coordinates of the panels' centres in B (m)."""
        y = self.box[1] / 2 + self.panel_gap + self.panel[1] / 2
        return y, -y

    def link_inertia(self, k: int) -> SpatialInertia:
        """Return M_LLo_L of link k (0 is the first), a solid cylinder that reaches to the next joint."""
        length = self.lengths[k]
        cylinder = SpatialInertia.SolidCylinderWithMass(self.masses[k], self.radii[k], length, [0.0, 0.0, 1.0])
        return cylinder.Shift([0.0, 0.0, -length / 2])

    def hand_inertia(self) -> SpatialInertia:
        """Return M_SSo_S of the hand, whose back is at S."""
        return _box(self.hand_mass, self.hand, (0.0, 0.0, self.hand[2] / 2))

    def finger_inertia(self) -> SpatialInertia:
        """Return the inertia of a finger about its origin, the middle of its pad's root."""
        return _box(self.finger_mass, self.finger, (0.0, 0.0, self.finger[2] / 2))

    def housing_inertia(self) -> SpatialInertia:
        """Return the inertia of the wheels' housing about its centre, which is Bo."""
        return SpatialInertia.SolidBoxWithMass(self.housing_mass, 0.3, 0.3, 0.3)

    def wheel_inertia(self) -> SpatialInertia:
        """Return the inertia of a wheel that turns about its z axis."""
        return SpatialInertia.SolidCylinderWithMass(self.wheel_mass, self.wheel_radius, 0.05, [0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Tag:
    """A place for a marker: its centre in T, the outward normal of its face, and the direction of its upper edge."""

    id: int
    center: tuple[float, float, float]
    normal: tuple[float, float, float]
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)


@dataclass(frozen=True)
class Target:
    """The satellite to be captured: a box with two panels along +-y, and a grapple fixture on its front face."""

    box: tuple[float, float, float] = (0.8, 0.8, 0.8)
    box_mass: float = 180.0
    panel: tuple[float, float, float] = (0.03, 1.0, 0.6)
    panel_mass: float = 10.0
    panel_gap: float = 0.1

    # The bar: two rows of spheres (one row could turn between the fingers), which the fingers grip with flat pads.
    bar_length: float = 0.26
    bar_radius: float = 0.018
    bar_spheres: int = 7
    row_distance: float = 0.03  # between the two rows, along H's z
    standoff: float = 0.16  # of H from the front face

    tag_size: float = 0.16
    tags: tuple[Tag, ...] = (
        *(
            Tag(2 * j + k, (-0.4, y, z), (-1, 0, 0))
            for j, y in enumerate((-0.28, 0.28))
            for k, z in enumerate((-0.28, 0.28))
        ),
        *(Tag(4 + k, (-0.015, y, 0.0), (-1, 0, 0)) for k, y in enumerate((-1.2, -0.75, 0.75, 1.2))),
        Tag(8, (-0.2, 0.0, 0.4), (0, 0, 1), (1, 0, 0)),
        Tag(9, (-0.2, 0.0, -0.4), (0, 0, -1), (1, 0, 0)),
        Tag(10, (-0.2, 0.4, 0.2), (0, 1, 0)),
        Tag(11, (-0.2, -0.4, 0.2), (0, -1, 0)),
    )

    @property
    def X_TH(self) -> RigidTransform:
        """Pose of the grapple fixture: z into the target, y along the bar."""
        R_TH = RotationMatrix(np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]))
        return RigidTransform(R_TH, [-self.box[0] / 2 - self.standoff, 0.0, 0.0])

    @property
    def panel_centers(self) -> tuple[float, float]:
        """The y coordinates of the panels' centres in T (m)."""
        y = self.box[1] / 2 + self.panel_gap + self.panel[1] / 2
        return y, -y

    @property
    def boxes(self) -> tuple[tuple[tuple[float, float, float], tuple[float, float, float]], ...]:
        """The boxes that the target consists of, (edges, centre in T): body and panels, without the fixture (m)."""
        panels = tuple((self.panel, (0.0, y, 0.0)) for y in self.panel_centers)
        return ((self.box, (0.0, 0.0, 0.0)), *panels)

    def inertia(self) -> SpatialInertia:
        """Return M_TTo_T of body and panels; the fixture has no mass, so that To is the centre of mass."""
        total = SpatialInertia.SolidBoxWithMass(self.box_mass, *self.box)
        for y in self.panel_centers:
            total += _box(self.panel_mass, self.panel, (0.0, y, 0.0))
        return total


def _box(mass: float, edges: tuple[float, float, float], center: tuple[float, float, float]) -> SpatialInertia:
    """Return the inertia of a solid box about a point from which its centre is at ``center``."""
    return SpatialInertia.SolidBoxWithMass(mass, *edges).Shift(-np.array(center))
