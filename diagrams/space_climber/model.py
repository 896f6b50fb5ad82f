"""Writes the SDF models of the robot and its attachment from the morphology.

``python -m vtbdrake_diagrams.space_climber.model`` rewrites the files in ``models/``.
"""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
from pydrake.multibody.tree import SpatialInertia

from vtbdrake_diagrams.sdf import (
    add_frame,
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
from vtbdrake_diagrams.space_climber.morphology import LEGS, Morphology

MODELS = Path(__file__).parent / "models"
CLIMBER_SDF = MODELS / "space_climber.sdf"
PAYLOAD_SDF = MODELS / "payload.sdf"
NOTE = "Written by diagrams/space_climber/model.py; change the morphology, not this file."

_SILVER = "0.75 0.77 0.80 1"
_DARK = "0.25 0.27 0.30 1"
_ORANGE = "0.95 0.50 0.10 1"
_BLACK = "0.08 0.08 0.08 1"
_GOLD = "0.80 0.65 0.20 1"
_RIGHT_ANGLE = "1.5707963267948966"
_ALONG_X = f"0 {_RIGHT_ANGLE} 0"
_ALONG_Y = f"{_RIGHT_ANGLE} 0 0"


def climber_sdf(morphology: Morphology | None = None) -> str:
    """Return the SDF of the robot: floating link ``base``, 18 joints, frames ``imu`` and ``attachment``."""
    m = morphology or Morphology()
    root, model = start_model("climber", "base", note=NOTE)
    _torso(model, m)
    for k, leg in enumerate(LEGS):
        _leg(model, m, leg, p_BH=m.hips[k])
    add_frame(model, "imu", "base", "0 0 0 0 0 0")
    add_frame(model, "attachment", "base", f"{text(m.attachment_x)} 0 0 0 0 0")
    return document(root)


def payload_sdf(morphology: Morphology | None = None) -> str:
    """Return the SDF of the attachment: one link ``payload``, a cube of 1 kg without collision geometry.

    The Context's ``SetMass`` scales its inertia with its mass.
    """
    edge = (morphology or Morphology()).attachment_edge
    root, model = start_model("payload", "payload", note=NOTE)
    link = add_link(model, "payload", None, SpatialInertia.SolidBoxWithMass(1.0, edge, edge, edge))
    add_visual(link, "cube", box(edge, edge, edge), "0 0 0 0 0 0", _GOLD)
    return document(root)


def _torso(model: ET.Element, m: Morphology) -> None:
    torso = SpatialInertia.SolidBoxWithMass(m.torso_mass, m.torso_length, m.torso_width, m.torso_height)
    plate_x = (m.torso_length + m.plate_thickness) / 2
    plate = SpatialInertia.SolidBoxWithMass(m.plate_mass, m.plate_thickness, m.plate_width, m.plate_height)
    base = add_link(model, "base", None, _sum(torso, plate.Shift([-plate_x, 0, 0])))
    add_visual(base, "hull", box(m.torso_length, m.torso_width * 0.8, m.torso_height), "0 0 0 0 0 0", _SILVER)
    for k, x in enumerate((m.hip_x, 0.0, -m.hip_x)):
        add_visual(base, f"rib_{k}", box(0.12, m.torso_width, m.torso_height * 0.7), f"{text(x)} 0 0 0 0 0", _DARK)
    top = m.torso_height / 2
    add_visual(base, "deck", box(m.torso_length * 0.8, 0.14, 0.02), f"0 0 {text(top + 0.01)} 0 0 0", _ORANGE)
    add_visual(
        base, "head", box(0.08, 0.10, 0.07), f"{text(m.torso_length / 2 - 0.05)} 0 {text(top + 0.035)} 0 0 0", _DARK
    )
    for side, y in (("left", 0.03), ("right", -0.03)):
        at = f"{text(m.torso_length / 2)} {y} {text(top + 0.04)} {_ALONG_X}"
        add_visual(base, f"camera_{side}", cylinder(0.014, 0.03), at, _BLACK)
    plate_box = box(m.plate_thickness, m.plate_width, m.plate_height)
    add_visual(base, "front_plate", plate_box, f"{text(plate_x)} 0 0 0 0 0", _SILVER)


def _leg(model: ET.Element, m: Morphology, leg: str, *, p_BH: np.ndarray) -> None:
    """Return three links in a row; the frame of each link is its joint's."""
    # Coxa: the thorax joint's housing (upright) and the basal joint's housing (across).
    half = m.coxa_mass / 2
    thorax = SpatialInertia.SolidCylinderWithMass(half, m.housing_radius, m.housing_length, [0, 0, 1])
    basal = SpatialInertia.SolidCylinderWithMass(half, m.housing_radius, m.housing_length, [0, 1, 0])
    outward = _RIGHT_ANGLE if p_BH[1] > 0 else f"-{_RIGHT_ANGLE}"
    pose = f"{' '.join(text(v) for v in p_BH)} 0 0 {outward}"
    coxa = add_link(model, f"{leg}_coxa", ("base", pose), _sum(thorax, basal.Shift([-m.coxa, 0, 0])))
    housing = cylinder(m.housing_radius, m.housing_length)
    add_visual(coxa, "thorax_housing", housing, "0 0 0 0 0 0", _DARK)
    add_visual(coxa, "basal_housing", housing, f"{text(m.coxa)} 0 0 {_ALONG_Y}", _DARK)
    _joint(model, m, f"{leg}_thorax", "base", f"{leg}_coxa", "0 0 1", m.thorax_range)

    # Femur: a tube, and at its end the distal joint's housing.
    half = m.femur_mass / 2
    tube = SpatialInertia.SolidCylinderWithMass(half, m.tube_radius, m.femur, [1, 0, 0])
    distal = SpatialInertia.SolidCylinderWithMass(half, m.housing_radius, m.housing_length, [0, 1, 0])
    inertia = _sum(tube.Shift([-m.femur / 2, 0, 0]), distal.Shift([-m.femur, 0, 0]))
    femur = add_link(model, f"{leg}_femur", (f"{leg}_coxa", f"{text(m.coxa)} 0 0 0 0 0"), inertia)
    add_visual(femur, "tube", cylinder(m.tube_radius, m.femur), f"{text(m.femur / 2)} 0 0 {_ALONG_X}", _ORANGE)
    add_visual(femur, "distal_housing", housing, f"{text(m.femur)} 0 0 {_ALONG_Y}", _DARK)
    _joint(model, m, f"{leg}_basal", f"{leg}_coxa", f"{leg}_femur", "0 1 0", m.basal_range)

    # Tibia: a tube, and at its end the foot.
    tube = SpatialInertia.SolidCylinderWithMass(m.tibia_mass, m.tube_radius, m.tibia, [1, 0, 0])
    ball = SpatialInertia.SolidSphereWithMass(m.foot_mass, m.foot_radius)
    inertia = _sum(tube.Shift([-m.tibia / 2, 0, 0]), ball.Shift([-m.tibia, 0, 0]))
    tibia = add_link(model, f"{leg}_tibia", (f"{leg}_femur", f"{text(m.femur)} 0 0 0 0 0"), inertia)
    add_visual(tibia, "tube", cylinder(0.8 * m.tube_radius, m.tibia), f"{text(m.tibia / 2)} 0 0 {_ALONG_X}", _SILVER)
    foot_pose = f"{text(m.tibia)} 0 0 0 0 0"
    add_visual(tibia, "foot", sphere(m.foot_radius), foot_pose, _BLACK)
    add_geometry(ET.SubElement(tibia, "collision", name="foot"), sphere(m.foot_radius), foot_pose)
    _joint(model, m, f"{leg}_distal", f"{leg}_femur", f"{leg}_tibia", "0 1 0", m.distal_range)
    add_frame(model, f"{leg}_foot", f"{leg}_tibia", foot_pose)


def _joint(
    model: ET.Element, m: Morphology, name: str, parent: str, child: str, axis_J: str, limits: tuple[float, float]
) -> None:
    add_joint(model, name, parent, child, axis_J=axis_J, limits=limits, speed=m.joint_speed, torque=m.joint_torque)


def _sum(a: SpatialInertia, b: SpatialInertia) -> SpatialInertia:
    a += b
    return a


def write() -> None:
    """Write the model files that are part of the repository."""
    MODELS.mkdir(exist_ok=True)
    CLIMBER_SDF.write_text(climber_sdf())
    PAYLOAD_SDF.write_text(payload_sdf())


if __name__ == "__main__":
    write()
