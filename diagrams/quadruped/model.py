"""The SDF model of the quadruped: a trunk on four legs with three joints each, whose drives hold desired angles.

``python -m vtbdrake_diagrams.quadruped.model`` rewrites the file in ``models/``.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import acos, pi
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
from pydrake.multibody.tree import SpatialInertia

from vtbdrake_diagrams.sdf import (
    add_geometry,
    add_joint,
    add_link,
    add_visual,
    box,
    cylinder,
    document,
    sphere,
    start_model,
    text,
)

QUADRUPED_SDF = Path(__file__).parent / "models" / "quadruped.sdf"
NOTE = "Written by diagrams/quadruped/model.py; change the quadruped, not this file."
# Which side of the trunk each leg is on: 1 is the front, or the left.
LEGS = {
    "front_left": (1, 1),
    "front_right": (1, -1),
    "hind_left": (-1, 1),
    "hind_right": (-1, -1),
}
RANGES = {
    "hip": (-0.9, 0.9),
    "thigh": (-1.2, 2.6),
    "knee": (-2.6, -0.3),
}
"""The range of each kind of joint, in rad."""
JOINT_NAMES = tuple(f"{leg}_{kind}" for leg in LEGS for kind in RANGES)

_WHITE = "0.86 0.87 0.88 1"
_DARK = "0.16 0.17 0.19 1"
_ORANGE = "0.95 0.50 0.10 1"


@dataclass(frozen=True)
class Quadruped:
    """Dimensions, masses and drives, as a robot of the size of a dog has them; no maker's numbers.

    Attributes:
        trunk: Edges of the trunk, a box, in m.
        trunk_mass: Mass of the trunk in kg.
        hip_x: Distance of a hip from the trunk's centre along x, in m.
        hip_y: The same along y.
        hip_length: Distance from the axis of a hip to the leg's plane, in m.
        link: Length of femur and tibia, in m.
        foot_radius: Radius of a foot in m.
        hub_mass: Mass of a hub in kg.
        femur_mass: Mass of a femur in kg.
        tibia_mass: Mass of a tibia in kg.
        stiffness: Stiffness of a drive in N m/rad.
        damping: Damping of a drive in N m s/rad.
        torque: The largest torque of a drive in N m.
        rotor_inertia: Inertia of a rotor, reflected through its gear, in kg m^2.
        friction: Coefficient of friction of the feet.
        stance: Height of the hips above the ground when it stands, in m.
    """

    trunk: tuple[float, float, float] = (0.42, 0.20, 0.11)
    trunk_mass: float = 7.0
    hip_x: float = 0.19
    hip_y: float = 0.05
    hip_length: float = 0.09
    link: float = 0.21
    foot_radius: float = 0.02
    hub_mass: float = 0.6
    femur_mass: float = 1.0
    tibia_mass: float = 0.2
    stiffness: float = 80.0
    damping: float = 2.0
    torque: float = 24.0
    rotor_inertia: float = 0.01
    friction: float = 0.7
    stance: float = 0.30

    @property
    def mass(self) -> float:
        """Return the mass of the whole robot in kg."""
        return self.trunk_mass + len(LEGS) * (self.hub_mass + self.femur_mass + self.tibia_mass)

    @property
    def leg_height(self) -> float:
        """Return the height of a hip above its foot's centre when the robot stands, in m."""
        return self.stance - self.foot_radius

    @property
    def posture(self) -> np.ndarray:
        """Return the angles of hip, thigh and knee with which the feet stand below the hips, shape (3,), in rad."""
        bend = acos(self.leg_height / (2.0 * self.link))
        return np.array([0.0, bend, -2.0 * bend])


def quadruped_sdf(quadruped: Quadruped | None = None) -> str:
    """Return the text of the SDF model ``quadruped``.

    Its links are ``trunk``, and for each leg of `LEGS` ``<leg>_hub``, ``<leg>_femur`` and ``<leg>_tibia``, at whose end
    is a round foot; its driven joints are `JOINT_NAMES`. At the angles 0 the legs are stretched downwards; x points
    forwards.
    """
    m = quadruped or Quadruped()
    root, model = start_model("quadruped", "trunk", note=NOTE)
    trunk = add_link(model, "trunk", None, SpatialInertia.SolidBoxWithMass(m.trunk_mass, *m.trunk))
    nowhere = "0 0 0 0 0 0"
    add_visual(trunk, "body", box(*m.trunk), nowhere, _WHITE)
    add_visual(trunk, "face", box(0.02, 0.12, 0.06), f"{text(m.trunk[0] / 2 + 0.005)} 0 0 0 0 0", _ORANGE)
    _add_collision(trunk, "body", box(*m.trunk), nowhere, m.friction)
    for leg, (front, left) in LEGS.items():
        _add_leg(model, m, leg, front, left)
    return document(root)


def _add_leg(model: ET.Element, m: Quadruped, leg: str, front: int, left: int) -> None:
    """Add the three links of a leg and their joints."""
    hub, femur, tibia = (f"{leg}_{link}" for link in ("hub", "femur", "tibia"))
    rod = f"0 0 {text(-m.link / 2)} 0 0 0"
    body = add_link(
        model,
        hub,
        ("trunk", f"{text(front * m.hip_x)} {text(left * m.hip_y)} 0 0 0 0"),
        SpatialInertia.SolidCylinderWithMass(m.hub_mass, 0.045, 0.06, [1.0, 0.0, 0.0]),
    )
    add_visual(body, "motor", cylinder(0.045, 0.06), f"0 0 0 0 {text(pi / 2)} 0", _DARK)
    _add_drive(model, m, f"{leg}_hip", "trunk", hub, "1 0 0", RANGES["hip"])
    centre = np.array([0.0, 0.0, -0.25 * m.link])
    inertia = SpatialInertia.SolidBoxWithMass(m.femur_mass, 0.05, 0.04, m.link)
    inertia = SpatialInertia(m.femur_mass, centre, inertia.get_unit_inertia().ShiftFromCenterOfMass(centre))
    body = add_link(model, femur, (hub, f"0 {text(left * m.hip_length)} 0 0 0 0"), inertia)
    add_visual(body, "motor", cylinder(0.045, 0.05), f"0 0 0 {text(pi / 2)} 0 0", _DARK)
    add_visual(body, "rod", box(0.04, 0.03, m.link), rod, _WHITE)
    _add_drive(model, m, f"{leg}_thigh", hub, femur, "0 1 0", RANGES["thigh"])
    centre = np.array([0.0, 0.0, -0.5 * m.link])
    inertia = SpatialInertia.SolidBoxWithMass(m.tibia_mass, 0.025, 0.025, m.link)
    inertia = SpatialInertia(m.tibia_mass, centre, inertia.get_unit_inertia().ShiftFromCenterOfMass(centre))
    below = f"0 0 {text(-m.link)} 0 0 0"
    body = add_link(model, tibia, (femur, below), inertia)
    add_visual(body, "rod", cylinder(0.012, m.link), rod, _WHITE)
    add_visual(body, "foot", sphere(m.foot_radius), below, _DARK)
    _add_collision(body, "foot", sphere(m.foot_radius), below, m.friction)
    _add_collision(body, "knee", sphere(m.foot_radius), "0 0 0 0 0 0", m.friction)
    _add_drive(model, m, f"{leg}_knee", femur, tibia, "0 1 0", RANGES["knee"])


def _add_drive(
    model: ET.Element, m: Quadruped, name: str, parent: str, child: str, axis_J: str, limits: tuple[float, float]
) -> None:
    joint = add_joint(model, name, parent, child, axis_J=axis_J, limits=limits, torque=m.torque)
    ET.SubElement(joint, "drake:rotor_inertia").text = text(m.rotor_inertia)
    ET.SubElement(joint, "drake:controller_gains", p=text(m.stiffness), d=text(m.damping))


def _add_collision(link: ET.Element, name: str, shape: ET.Element, pose: str, friction: float) -> None:
    collision = ET.SubElement(link, "collision", name=name)
    add_geometry(collision, shape, pose)
    properties = ET.SubElement(collision, "drake:proximity_properties")
    for kind in ("dynamic", "static"):
        ET.SubElement(properties, f"drake:mu_{kind}").text = text(friction)


def write() -> None:
    """Write the file in ``models/``."""
    QUADRUPED_SDF.parent.mkdir(exist_ok=True)
    QUADRUPED_SDF.write_text(quadruped_sdf())


if __name__ == "__main__":
    write()
