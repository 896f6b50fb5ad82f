"""The SDF model of the arm.

``python -m vtbdrake_diagrams.manipulator.model`` rewrites the file in ``models/``.
"""

from __future__ import annotations

from math import pi
from pathlib import Path
from xml.etree import ElementTree as ET

from vtbdrake_diagrams.manipulator.arm import JOINT_NAMES, JOINTS, LINK_NAMES, Arm
from vtbdrake_diagrams.sdf import (
    add_frame,
    add_geometry,
    add_joint,
    add_link,
    add_visual,
    cylinder,
    document,
    sphere,
    start_model,
    text,
)

ARM_SDF = Path(__file__).parent / "models" / "arm.sdf"
NOTE = "Written by diagrams/manipulator/model.py; change the arm, not this file."

_LIGHT = "0.86 0.87 0.88 1"
_DARK = "0.30 0.32 0.35 1"
_ORANGE = "0.95 0.50 0.10 1"
_STEEL = "0.55 0.57 0.60 1"
_ALONG_Y = f"{text(pi / 2)} 0 0"


def arm_sdf(arm: Arm | None = None) -> str:
    """Return the text of the SDF model ``arm``.

    It has the links ``base``, ``link_1`` to ``link_7`` and ``tool``, the joints ``joint_1`` to ``joint_7``, the fixed
    joint ``flange``, which carries the force/torque sensor, and the frame ``tip``. Only the ball at the tip collides.
    """
    arm = arm or Arm()
    root, model = start_model("arm", "base", note=NOTE)
    base = add_link(model, "base", None, arm.base_inertia())
    _tube(base, "pedestal", arm.radii[0] * 1.25, 0.0, arm.base_height, _DARK)
    parent = "base"
    for k in range(JOINTS):
        link = add_link(model, LINK_NAMES[k], (parent, f"0 0 {text(arm.offsets[k])} 0 0 0"), arm.link_inertia(k))
        _show_link(link, arm, k)
        joint = add_joint(
            model,
            JOINT_NAMES[k],
            parent,
            LINK_NAMES[k],
            axis_J=" ".join(map(str, arm.axes[k])),
            limits=(arm.lower[k], arm.upper[k]),
            speed=arm.speeds[k],
            torque=arm.torques[k],
        )
        ET.SubElement(joint, "drake:rotor_inertia").text = text(arm.rotor_inertias[k])
        ET.SubElement(joint, "drake:gear_ratio").text = text(arm.gear_ratio)
        parent = LINK_NAMES[k]
    _tool(model, arm)
    return document(root)


def _show_link(link: ET.Element, arm: Arm, k: int) -> None:
    radius, length = arm.radii[k], arm.lengths[k]
    if arm.axes[k][2]:
        _tube(link, "ring", radius * 1.02, 0.0, 0.02, _ORANGE)
        _tube(link, "tube", radius * 0.95, 0.02, length, _LIGHT)
    else:
        add_visual(link, "housing", cylinder(radius, 2.1 * radius), f"0 0 0 {_ALONG_Y}", _DARK)
        add_visual(link, "cap", sphere(radius * 1.05), "0 0 0 0 0 0", _LIGHT)
        _tube(link, "tube", radius * 0.9, 0.0, length, _LIGHT)


def _tool(model: ET.Element, arm: Arm) -> None:
    tool = add_link(model, "tool", (LINK_NAMES[-1], f"0 0 {text(arm.lengths[-1])} 0 0 0"), arm.tool_inertia())
    tip = f"0 0 {text(arm.tool_length)} 0 0 0"
    _tube(tool, "sensor", 2.0 * arm.tool_radius, 0.0, 0.015, _DARK)
    _tube(tool, "rod", arm.tool_radius, 0.0, arm.tool_length, _STEEL)
    add_visual(tool, "ball", sphere(arm.ball_radius), tip, _ORANGE)
    add_geometry(ET.SubElement(tool, "collision", name="ball"), sphere(arm.ball_radius), tip)
    flange = ET.SubElement(model, "joint", name="flange", type="fixed")
    ET.SubElement(flange, "parent").text = LINK_NAMES[-1]
    ET.SubElement(flange, "child").text = "tool"
    add_frame(model, "tip", "tool", tip)


def _tube(link: ET.Element, name: str, radius: float, start: float, end: float, color: str) -> None:
    add_visual(link, name, cylinder(radius, end - start), f"0 0 {text((start + end) / 2)} 0 0 0", color)


def write() -> None:
    """Write the file in ``models/``."""
    ARM_SDF.parent.mkdir(exist_ok=True)
    ARM_SDF.write_text(arm_sdf())


if __name__ == "__main__":
    write()
