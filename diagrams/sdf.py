"""Pieces of SDF files that the diagrams write for their robots."""

from __future__ import annotations

from math import inf
from xml.etree import ElementTree as ET

from pydrake.multibody.tree import SpatialInertia

IIWA_AXES = ((0, 0, 1), (0, 1, 0), (0, 0, 1), (0, -1, 0), (0, 0, 1), (0, 1, 0), (0, 0, 1))
"""Which axis of its link each joint of an arm like KUKA's iiwa turns about."""


def start_model(name: str, canonical_link: str, *, note: str) -> tuple[ET.Element, ET.Element]:
    """Return an SDF document and the model in it; ``note`` becomes a comment."""
    root = ET.Element("sdf", {"version": "1.9", "xmlns:drake": "http://drake.mit.edu"})
    root.append(ET.Comment(f" {note} "))
    return root, ET.SubElement(root, "model", name=name, canonical_link=canonical_link)


def add_link(model: ET.Element, name: str, parent: tuple[str, str] | None, inertia: SpatialInertia) -> ET.Element:
    """Add a link with the inertia M_LLo_L; ``parent`` is the link that its pose is relative to, and the pose."""
    link = ET.SubElement(model, "link", name=name)
    if parent is not None:
        ET.SubElement(link, "pose", relative_to=parent[0]).text = parent[1]
    inertial = ET.SubElement(link, "inertial")
    p_LoLcm = inertia.get_com()
    ET.SubElement(inertial, "pose").text = f"{' '.join(text(v) for v in p_LoLcm)} 0 0 0"
    ET.SubElement(inertial, "mass").text = text(inertia.get_mass())
    I_LLcm = inertia.Shift(p_LoLcm).CalcRotationalInertia().CopyToFullMatrix3()
    tensor = ET.SubElement(inertial, "inertia")
    for name, i, j in (("ixx", 0, 0), ("ixy", 0, 1), ("ixz", 0, 2), ("iyy", 1, 1), ("iyz", 1, 2), ("izz", 2, 2)):
        ET.SubElement(tensor, name).text = text(I_LLcm[i, j])
    return link


def add_joint(
    model: ET.Element,
    name: str,
    parent: str,
    child: str,
    *,
    axis_J: str,
    kind: str = "revolute",
    limits: tuple[float, float] = (-inf, inf),
    speed: float = inf,
    torque: float = inf,
) -> ET.Element:
    """Add a joint; ``speed`` and ``torque`` (a force, where it slides) are the limits of its drive.

    Args:
        model: The model that it belongs to.
        name: Name of the joint.
        parent: The link, or ``world``, that the joint's frame is fixed to.
        child: The link that moves.
        axis_J: Axis in the joint's frame, as text.
        kind: SDFormat's type, ``revolute`` or ``prismatic``.
        limits: Range of the position, in rad or m.
        speed: Limit of the velocity, in rad/s or m/s.
        torque: Limit of the drive, in N m or N; 0 for a joint without a drive.
    """
    joint = ET.SubElement(model, "joint", name=name, type=kind)
    ET.SubElement(joint, "parent").text = parent
    ET.SubElement(joint, "child").text = child
    axis = ET.SubElement(joint, "axis")
    ET.SubElement(axis, "xyz").text = axis_J
    limit = ET.SubElement(axis, "limit")
    for tag, value in zip(("lower", "upper", "velocity", "effort"), (*limits, speed, torque), strict=True):
        ET.SubElement(limit, tag).text = text(value)
    return joint


def add_frame(model: ET.Element, name: str, attached_to: str, pose: str) -> None:
    """Add a frame that is fixed to a link."""
    frame = ET.SubElement(model, "frame", name=name, attached_to=attached_to)
    ET.SubElement(frame, "pose").text = pose


def add_visual(link: ET.Element, name: str, shape: ET.Element, pose: str, color: str) -> None:
    """Add a visual shape; ``color`` is red, green, blue and opacity."""
    visual = ET.SubElement(link, "visual", name=name)
    add_geometry(visual, shape, pose)
    ET.SubElement(ET.SubElement(visual, "material"), "diffuse").text = color


def add_geometry(owner: ET.Element, shape: ET.Element, pose: str) -> None:
    """Add the pose and the shape of a visual or collision element."""
    ET.SubElement(owner, "pose").text = pose
    ET.SubElement(owner, "geometry").append(shape)


def box(x: float, y: float, z: float) -> ET.Element:
    """Return a box; its edges are in metres."""
    element = ET.Element("box")
    ET.SubElement(element, "size").text = f"{text(x)} {text(y)} {text(z)}"
    return element


def cylinder(radius: float, length: float) -> ET.Element:
    """Return a cylinder along z; radius and length are in metres."""
    element = ET.Element("cylinder")
    ET.SubElement(element, "radius").text = text(radius)
    ET.SubElement(element, "length").text = text(length)
    return element


def sphere(radius: float) -> ET.Element:
    """Return a sphere; the radius is in metres."""
    element = ET.Element("sphere")
    ET.SubElement(element, "radius").text = text(radius)
    return element


def text(value: float) -> str:
    """Return a number with 12 digits, so that rounding errors in the last bits do not change the text."""
    return f"{round(float(value), 12) + 0.0:.12g}"


def document(root: ET.Element) -> str:
    """Return the text of the file."""
    ET.indent(root)
    return f'<?xml version="1.0"?>\n{ET.tostring(root, encoding="unicode")}\n'
