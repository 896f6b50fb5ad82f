"""Dimensions and masses of a six-legged robot in the style of DFKI's SpaceClimber.

Sources of the numbers:

* [P] published: CREX, SpaceClimber's successor, is a six-legged robot 1 m long that weighs 27 kg (Lunar Enterprise
  Daily, 7 March 2013, and engineering.com, "German Robot Team to Explore the Moon", both after DFKI). The
  data sheet of SpaceClimber itself was not found.
* [D] derived: follows from the other numbers by the reason that stands beside it.
* [A] assumed: plausible, not published.

Frames: B (the link ``base``) lies in the torso's centre, x forward, y left, z up. H is a leg's hip: on the axis of its
thorax joint, x outward. At zero joint angles a leg is straight and points outward; positive angles of the
basal and the distal joint lower the foot.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

LEGS = ("front_left", "front_right", "middle_left", "middle_right", "rear_left", "rear_right")
JOINTS = ("thorax", "basal", "distal")
JOINT_NAMES = tuple(f"{leg}_{joint}" for leg in LEGS for joint in JOINTS)
FOOT_LINKS = tuple(f"{leg}_tibia" for leg in LEGS)

LUNAR_GRAVITY = 1.62
"""Acceleration of free fall on the moon's surface (m/s^2)."""

DEFAULT_FRICTION = 0.8
"""Coulomb friction of foot and ground, static and dynamic.

A foot on regolith slips when the soil under it shears, so the soil's friction angle bounds it. Boulder tracks on the
moon gave 24 to 47 deg, 37 deg on average (abstract of "Boulder tracks and nature of lunar soil", 1973, NASA NTRS
19730039283): a coefficient of 0.45 to 1.07, 0.75 on average. Measurements of the Apollo missions are commonly
summarized as 30 to 50 deg (see Carrier, Olhoeft, Mendell, "Physical Properties of the Lunar Surface", Lunar Sourcebook,
chapter 9, 1991), whose middle is 0.84. 0.8 lies between.
"""


@dataclass(frozen=True)
class Morphology:
    """The dimensions (m), masses (kg) and limits of the robot. [P], [D] and [A] are explained above."""

    # Torso: a box, with a plate on its front.
    torso_length: float = 0.80  # [A] leaves 0.2 m of CREX's 1 m [P] to head and legs
    torso_width: float = 0.26  # [A]
    torso_height: float = 0.12  # [A]
    plate_thickness: float = 0.01  # [A] an aluminium plate that carries the attachment
    plate_width: float = 0.20  # [A]
    plate_height: float = 0.12  # [D] as high as the torso

    # Legs: coxa, femur and tibia are tubes; a sphere is the foot.
    hip_x: float = 0.30  # [A] of the front hips; middle hips at 0, rear hips at -hip_x
    hip_y: float = 0.15  # [D] half the torso and the radius of a joint housing
    coxa: float = 0.06  # [A] thorax axis to basal axis
    femur: float = 0.20  # [A] basal axis to distal axis
    tibia: float = 0.25  # [A] distal axis to the centre of the foot
    foot_radius: float = 0.025  # [A]
    tube_radius: float = 0.022  # [A]
    housing_radius: float = 0.04  # [A] a brushless motor with a strain wave gear
    housing_length: float = 0.08  # [A]

    # Masses. They sum to CREX's 27 kg [P]; the split is assumed: half of a walking robot of this kind is legs.
    torso_mass: float = 13.2  # [A]
    plate_mass: float = 0.6  # [A] 0.20 x 0.12 x 0.01 m of aluminium is 0.65 kg
    coxa_mass: float = 0.9  # [A] two joint housings
    femur_mass: float = 0.8  # [A] a tube and the distal joint's housing
    tibia_mass: float = 0.4  # [A]
    foot_mass: float = 0.1  # [A]

    # Nominal stance: centres of the feet in B.
    stance_x: float = 0.40  # [A] of the front feet; middle feet at 0, rear feet at -stance_x
    stance_y: float = 0.40  # [A] sprawled
    torso_clearance: float = 0.20  # [A] from the ground to the torso's centre

    # Joints: range (rad) about the straight leg, speed (rad/s), torque (N m).
    thorax_range: tuple[float, float] = (-1.3, 1.3)  # [A]
    basal_range: tuple[float, float] = (-1.6, 1.2)  # [A]
    distal_range: tuple[float, float] = (0.0, 2.8)  # [A] the knee never bends backwards
    joint_speed: float = 4.0  # [A]
    # [D] On earth the middle leg of a tripod carries half the weight, 132 N, at 0.19 m from its basal axis: 25 N m.
    # Twice that for a stroke's lever and for acceleration, rounded up.
    joint_torque: float = 60.0

    # [A] Position servo of each joint. Under the 25 N m above it deflects by 1.4 deg; well damped for a leg's inertia.
    joint_stiffness: float = 1000.0  # N m/rad
    joint_damping: float = 30.0  # N m s/rad

    # The attachment: a cube that is bolted flat onto the front plate, at the height of the torso's centre.
    # [D] A solid steel cube of 0.20 m weighs 63 kg: the smallest round size that can be any mass up to 60 kg.
    attachment_edge: float = 0.20

    @property
    def leg_mass(self) -> float:
        return self.coxa_mass + self.femur_mass + self.tibia_mass + self.foot_mass

    @property
    def total_mass(self) -> float:
        return self.torso_mass + self.plate_mass + len(LEGS) * self.leg_mass

    @property
    def attachment_x(self) -> float:
        """Return the lever of the attachment: half the torso, the plate, half the cube."""
        return self.torso_length / 2 + self.plate_thickness + self.attachment_edge / 2

    @property
    def hips(self) -> NDArray[np.float64]:
        """Return p_BH of the six hips, (6, 3)."""
        return _grid(self.hip_x, self.hip_y, 0.0)

    @property
    def stance(self) -> NDArray[np.float64]:
        """Return p_BF of the centres of the six feet in the nominal stance, (6, 3)."""
        return _grid(self.stance_x, self.stance_y, self.foot_radius - self.torso_clearance)

    @property
    def joint_lower(self) -> NDArray[np.float64]:
        """Return the lower ends of the joint ranges, (18,)."""
        return np.tile([r[0] for r in (self.thorax_range, self.basal_range, self.distal_range)], len(LEGS))

    @property
    def joint_upper(self) -> NDArray[np.float64]:
        """Return the upper ends of the joint ranges, (18,)."""
        return np.tile([r[1] for r in (self.thorax_range, self.basal_range, self.distal_range)], len(LEGS))


def _grid(x: float, y: float, z: float) -> NDArray[np.float64]:
    return np.array([[sx * x, sy * y, z] for sx in (1, 0, -1) for sy in (1, -1)])
