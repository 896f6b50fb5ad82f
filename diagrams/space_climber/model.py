"""Writes the SDF models of the robot and its attachment from the morphology.

``python -m diagrams.space_climber.model`` rewrites the files in ``models/``.
"""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
from pydrake.multibody.tree import SpatialInertia

from diagrams.space_climber.morphology import LEGS, Morphology

MODELS = Path(__file__).parent / "models"
CLIMBER_SDF = MODELS / "space_climber.sdf"
PAYLOAD_SDF = MODELS / "payload.sdf"

_SILVER, _DARK, _ORANGE, _BLACK, _GOLD = (
    "0.75 0.77 0.80 1",
    "0.25 0.27 0.30 1",
    "0.95 0.50 0.10 1",
    "0.08 0.08 0.08 1",
    "0.80 0.65 0.20 1",
)
_RIGHT_ANGLE = "1.5707963267948966"
_ALONG_X = f"0 {_RIGHT_ANGLE} 0"
_ALONG_Y = f"{_RIGHT_ANGLE} 0 0"


def climber_sdf(morphology: Morphology | None = None) -> str:
    """The robot: model ``climber``, floating link ``base``, 18 joints, frames ``imu`` and ``attachment``."""
    m = morphology or Morphology()
    root, model = _model("climber", "base")
    _torso(model, m)
    for k, leg in enumerate(LEGS):
        _leg(model, m, leg, p_BH=m.hips[k])
    _frame(model, "imu", "base", "0 0 0 0 0 0")
    _frame(model, "attachment", "base", f"{_text(m.attachment_x)} 0 0 0 0 0")
    return _document(root)


def payload_sdf(morphology: Morphology | None = None) -> str:
    """The attachment: model ``payload``, one link ``payload``, a cube of 1 kg that collides with nothing.

    The Context's ``SetMass`` scales its inertia with its mass.
    """
    edge = (morphology or Morphology()).attachment_edge
    root, model = _model("payload", "payload")
    link = _link(model, "payload", None, SpatialInertia.SolidBoxWithMass(1.0, edge, edge, edge))
    _visual(link, "cube", _box(edge, edge, edge), "0 0 0 0 0 0", _GOLD)
    return _document(root)


def _torso(model: ET.Element, m: Morphology) -> None:
    torso = SpatialInertia.SolidBoxWithMass(m.torso_mass, m.torso_length, m.torso_width, m.torso_height)
    plate_x = (m.torso_length + m.plate_thickness) / 2
    plate = SpatialInertia.SolidBoxWithMass(m.plate_mass, m.plate_thickness, m.plate_width, m.plate_height)
    base = _link(model, "base", None, _sum(torso, plate.Shift([-plate_x, 0, 0])))
    _visual(base, "hull", _box(m.torso_length, m.torso_width * 0.8, m.torso_height), "0 0 0 0 0 0", _SILVER)
    for k, x in enumerate((m.hip_x, 0.0, -m.hip_x)):
        _visual(base, f"rib_{k}", _box(0.12, m.torso_width, m.torso_height * 0.7), f"{_text(x)} 0 0 0 0 0", _DARK)
    top = m.torso_height / 2
    _visual(base, "deck", _box(m.torso_length * 0.8, 0.14, 0.02), f"0 0 {_text(top + 0.01)} 0 0 0", _ORANGE)
    _visual(
        base, "head", _box(0.08, 0.10, 0.07), f"{_text(m.torso_length / 2 - 0.05)} 0 {_text(top + 0.035)} 0 0 0", _DARK
    )
    for side, y in (("left", 0.03), ("right", -0.03)):
        at = f"{_text(m.torso_length / 2)} {y} {_text(top + 0.04)} {_ALONG_X}"
        _visual(base, f"camera_{side}", _cylinder(0.014, 0.03), at, _BLACK)
    plate_box = _box(m.plate_thickness, m.plate_width, m.plate_height)
    _visual(base, "front_plate", plate_box, f"{_text(plate_x)} 0 0 0 0 0", _SILVER)


def _leg(model: ET.Element, m: Morphology, leg: str, *, p_BH: np.ndarray) -> None:
    """Three links in a row; each link's frame is its joint's frame."""
    # Coxa: the thorax joint's housing (upright) and the basal joint's housing (across).
    half = m.coxa_mass / 2
    thorax = SpatialInertia.SolidCylinderWithMass(half, m.housing_radius, m.housing_length, [0, 0, 1])
    basal = SpatialInertia.SolidCylinderWithMass(half, m.housing_radius, m.housing_length, [0, 1, 0])
    outward = _RIGHT_ANGLE if p_BH[1] > 0 else f"-{_RIGHT_ANGLE}"
    pose = f"{' '.join(_text(v) for v in p_BH)} 0 0 {outward}"
    coxa = _link(model, f"{leg}_coxa", ("base", pose), _sum(thorax, basal.Shift([-m.coxa, 0, 0])))
    housing = _cylinder(m.housing_radius, m.housing_length)
    _visual(coxa, "thorax_housing", housing, "0 0 0 0 0 0", _DARK)
    _visual(coxa, "basal_housing", housing, f"{_text(m.coxa)} 0 0 {_ALONG_Y}", _DARK)
    _joint(model, m, f"{leg}_thorax", "base", f"{leg}_coxa", "0 0 1", m.thorax_range)

    # Femur: a tube, and at its end the distal joint's housing.
    half = m.femur_mass / 2
    tube = SpatialInertia.SolidCylinderWithMass(half, m.tube_radius, m.femur, [1, 0, 0])
    distal = SpatialInertia.SolidCylinderWithMass(half, m.housing_radius, m.housing_length, [0, 1, 0])
    inertia = _sum(tube.Shift([-m.femur / 2, 0, 0]), distal.Shift([-m.femur, 0, 0]))
    femur = _link(model, f"{leg}_femur", (f"{leg}_coxa", f"{_text(m.coxa)} 0 0 0 0 0"), inertia)
    _visual(femur, "tube", _cylinder(m.tube_radius, m.femur), f"{_text(m.femur / 2)} 0 0 {_ALONG_X}", _ORANGE)
    _visual(femur, "distal_housing", housing, f"{_text(m.femur)} 0 0 {_ALONG_Y}", _DARK)
    _joint(model, m, f"{leg}_basal", f"{leg}_coxa", f"{leg}_femur", "0 1 0", m.basal_range)

    # Tibia: a tube, and at its end the foot.
    tube = SpatialInertia.SolidCylinderWithMass(m.tibia_mass, m.tube_radius, m.tibia, [1, 0, 0])
    ball = SpatialInertia.SolidSphereWithMass(m.foot_mass, m.foot_radius)
    inertia = _sum(tube.Shift([-m.tibia / 2, 0, 0]), ball.Shift([-m.tibia, 0, 0]))
    tibia = _link(model, f"{leg}_tibia", (f"{leg}_femur", f"{_text(m.femur)} 0 0 0 0 0"), inertia)
    _visual(tibia, "tube", _cylinder(0.8 * m.tube_radius, m.tibia), f"{_text(m.tibia / 2)} 0 0 {_ALONG_X}", _SILVER)
    foot_pose = f"{_text(m.tibia)} 0 0 0 0 0"
    _visual(tibia, "foot", _sphere(m.foot_radius), foot_pose, _BLACK)
    _geometry(ET.SubElement(tibia, "collision", name="foot"), _sphere(m.foot_radius), foot_pose)
    _joint(model, m, f"{leg}_distal", f"{leg}_femur", f"{leg}_tibia", "0 1 0", m.distal_range)
    _frame(model, f"{leg}_foot", f"{leg}_tibia", foot_pose)


def _sum(a: SpatialInertia, b: SpatialInertia) -> SpatialInertia:
    a += b
    return a


def _model(name: str, canonical_link: str) -> tuple[ET.Element, ET.Element]:
    root = ET.Element("sdf", {"version": "1.9", "xmlns:drake": "http://drake.mit.edu"})
    root.append(ET.Comment(" Written by diagrams/space_climber/model.py; change the morphology, not this file. "))
    return root, ET.SubElement(root, "model", name=name, canonical_link=canonical_link)


def _link(model: ET.Element, name: str, parent: tuple[str, str] | None, inertia: SpatialInertia) -> ET.Element:
    """A link with the inertia M_LLo_L; ``parent`` is the link that its pose is relative to, and the pose."""
    link = ET.SubElement(model, "link", name=name)
    if parent is not None:
        ET.SubElement(link, "pose", relative_to=parent[0]).text = parent[1]
    inertial = ET.SubElement(link, "inertial")
    p_LoLcm = inertia.get_com()
    ET.SubElement(inertial, "pose").text = f"{' '.join(_text(v) for v in p_LoLcm)} 0 0 0"
    ET.SubElement(inertial, "mass").text = _text(inertia.get_mass())
    I_LLcm = inertia.Shift(p_LoLcm).CalcRotationalInertia().CopyToFullMatrix3()
    tensor = ET.SubElement(inertial, "inertia")
    for name, i, j in (("ixx", 0, 0), ("ixy", 0, 1), ("ixz", 0, 2), ("iyy", 1, 1), ("iyz", 1, 2), ("izz", 2, 2)):
        ET.SubElement(tensor, name).text = _text(I_LLcm[i, j])
    return link


def _joint(
    model: ET.Element, m: Morphology, name: str, parent: str, child: str, axis_J: str, limits: tuple[float, float]
) -> None:
    joint = ET.SubElement(model, "joint", name=name, type="revolute")
    ET.SubElement(joint, "parent").text = parent
    ET.SubElement(joint, "child").text = child
    axis = ET.SubElement(joint, "axis")
    ET.SubElement(axis, "xyz").text = axis_J
    limit = ET.SubElement(axis, "limit")
    for tag, value in zip(
        ("lower", "upper", "velocity", "effort"), (*limits, m.joint_speed, m.joint_torque), strict=True
    ):
        ET.SubElement(limit, tag).text = _text(value)


def _frame(model: ET.Element, name: str, attached_to: str, pose: str) -> None:
    frame = ET.SubElement(model, "frame", name=name, attached_to=attached_to)
    ET.SubElement(frame, "pose").text = pose


def _visual(link: ET.Element, name: str, shape: ET.Element, pose: str, color: str) -> None:
    visual = ET.SubElement(link, "visual", name=name)
    _geometry(visual, shape, pose)
    ET.SubElement(ET.SubElement(visual, "material"), "diffuse").text = color


def _geometry(owner: ET.Element, shape: ET.Element, pose: str) -> None:
    ET.SubElement(owner, "pose").text = pose
    ET.SubElement(owner, "geometry").append(shape)


def _box(x: float, y: float, z: float) -> ET.Element:
    box = ET.Element("box")
    ET.SubElement(box, "size").text = f"{_text(x)} {_text(y)} {_text(z)}"
    return box


def _cylinder(radius: float, length: float) -> ET.Element:
    cylinder = ET.Element("cylinder")
    ET.SubElement(cylinder, "radius").text = _text(radius)
    ET.SubElement(cylinder, "length").text = _text(length)
    return cylinder


def _sphere(radius: float) -> ET.Element:
    sphere = ET.Element("sphere")
    ET.SubElement(sphere, "radius").text = _text(radius)
    return sphere


def _text(value: float) -> str:
    """12 digits: the same text whatever the last bits are."""
    return f"{round(float(value), 12) + 0.0:.12g}"


def _document(root: ET.Element) -> str:
    ET.indent(root)
    return f'<?xml version="1.0"?>\n{ET.tostring(root, encoding="unicode")}\n'


def write() -> None:
    """Rewrites the shipped files."""
    MODELS.mkdir(exist_ok=True)
    CLIMBER_SDF.write_text(climber_sdf())
    PAYLOAD_SDF.write_text(payload_sdf())


if __name__ == "__main__":
    write()
