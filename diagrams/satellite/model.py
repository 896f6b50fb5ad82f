"""The SDF models of the servicer, of its reaction wheels and of the target.

``python -m vtbdrake_diagrams.satellite.model`` rewrites the files in ``models/``.
"""

from __future__ import annotations

from math import pi
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw

from vtbdrake_diagrams.satellite.bodies import (
    ARM_JOINT_NAMES,
    ARM_JOINTS,
    FINGER_JOINT_NAMES,
    FINGER_NAMES,
    LINK_NAMES,
    WHEEL_JOINT_NAMES,
    Servicer,
    Target,
)
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

MODELS = Path(__file__).parent / "models"
SERVICER_SDF = MODELS / "servicer.sdf"
WHEELS_SDF = MODELS / "wheels.sdf"
TARGET_SDF = MODELS / "target.sdf"
NOTE = "Written by diagrams/satellite/model.py; change diagrams/satellite/bodies.py, not this file."

CONTACT_STIFFNESS = 2e5
"""The stiffness of fingers and bar, in N/m [assumed]."""
FRICTION = 0.8
"""Static and dynamic friction of the fingers' pads and of the bar [assumed: rubber on metal]."""

_GOLD = "0.80 0.62 0.24 1"
_WHITE = "0.86 0.87 0.88 1"
_DARK = "0.25 0.27 0.30 1"
_BLUE = "0.10 0.16 0.40 1"
_STEEL = "0.60 0.62 0.65 1"
_ORANGE = "0.95 0.50 0.10 1"


def servicer_sdf(servicer: Servicer | None = None) -> str:
    """Return the text of the model ``servicer``: ``base``, ``link_1`` to ``link_7``, ``hand`` and the two fingers.

    Its frames are ``imu``, ``camera`` (C), ``scanner`` (L), ``arm`` (the arm's foot) and ``gripper`` (G). Only hand and
    fingers collide.
    """
    s = servicer or Servicer()
    root, model = start_model("servicer", "base", note=NOTE)
    base = add_link(model, "base", None, s.base_inertia())
    add_visual(base, "box", box(*s.box), "0 0 0 0 0 0", _GOLD)
    for name, y in zip(("panel_left", "panel_right"), s.panel_centers, strict=True):
        add_visual(base, name, box(*s.panel), f"0 {text(y)} 0 0 0 0", _BLUE)
    length = 2 * (s.box[1] / 2 + s.panel_gap)
    add_visual(base, "yoke", cylinder(0.03, length), f"0 0 0 {text(pi / 2)} 0 0", _STEEL)
    add_frame(model, "imu", "base", "0 0 0 0 0 0")
    add_frame(model, "arm", "base", _pose(s.X_BA))
    add_frame(model, "camera", "base", _pose(s.X_BC))
    add_frame(model, "scanner", "base", _pose(s.X_BL))
    parent, frame = "base", "arm"
    for k in range(ARM_JOINTS):
        link = add_link(model, LINK_NAMES[k], (frame, f"0 0 {text(s.offsets[k])} 0 0 0"), s.link_inertia(k))
        _show_link(link, s, k)
        add_joint(
            model,
            ARM_JOINT_NAMES[k],
            parent,
            LINK_NAMES[k],
            axis_J=" ".join(map(str, s.axes[k])),
            limits=(s.lower[k], s.upper[k]),
            speed=s.speeds[k],
            torque=s.torques[k],
        )
        parent = frame = LINK_NAMES[k]
    _hand(model, s)
    return document(root)


def _show_link(link: ET.Element, s: Servicer, k: int) -> None:
    radius, length = s.radii[k], s.lengths[k]
    if not s.axes[k][2]:
        add_visual(link, "housing", cylinder(radius * 1.1, 2.4 * radius), f"0 0 0 {text(pi / 2)} 0 0", _DARK)
    add_visual(link, "tube", cylinder(radius * 0.9, length), f"0 0 {text(length / 2)} 0 0 0", _WHITE)


def _hand(model: ET.Element, s: Servicer) -> None:
    hand = add_link(model, "hand", (LINK_NAMES[-1], f"0 0 {text(s.lengths[-1])} 0 0 0"), s.hand_inertia())
    back = f"0 0 {text(s.hand[2] / 2)} 0 0 0"
    add_visual(hand, "palm", box(*s.hand), back, _DARK)
    _collide(hand, "palm", box(*s.hand), back)
    flange = ET.SubElement(model, "joint", name="flange", type="fixed")
    ET.SubElement(flange, "parent").text = LINK_NAMES[-1]
    ET.SubElement(flange, "child").text = "hand"
    add_frame(model, "gripper", "hand", f"0 0 {text(s.tool)} 0 0 0")
    for name, joint, side in zip(FINGER_NAMES, FINGER_JOINT_NAMES, (1.0, -1.0), strict=True):
        # At position 0 the pad, the inner face of the finger, is in the middle.
        finger = add_link(model, name, ("hand", f"0 0 {text(s.hand[2])} 0 0 0"), s.finger_inertia())
        plate = f"{text(side * s.finger[0] / 2)} 0 {text(s.finger[2] / 2)} 0 0 0"
        lip = f"{text(-side * s.lip[0] / 2)} 0 {text(s.finger[2] - s.lip[2] / 2)} 0 0 0"
        add_visual(finger, "plate", box(*s.finger), plate, _ORANGE)
        add_visual(finger, "lip", box(*s.lip), lip, _ORANGE)
        _collide(finger, "plate", box(*s.finger), plate)
        _collide(finger, "lip", box(*s.lip), lip)
        add_joint(
            model,
            joint,
            "hand",
            name,
            axis_J=f"{text(side)} 0 0",
            kind="prismatic",
            limits=(0.0, s.opening),
            speed=s.finger_speed,
            torque=s.finger_force,
        )


def wheels_sdf(servicer: Servicer | None = None) -> str:
    """Return the text of the model ``wheels``: a ``housing``, to be welded to B, and three wheels in it."""
    s = servicer or Servicer()
    root, model = start_model("wheels", "housing", note=NOTE)
    add_link(model, "housing", None, s.housing_inertia())
    for name, rotation, place in zip(
        WHEEL_JOINT_NAMES,
        (f"0 {text(pi / 2)} 0", f"{text(-pi / 2)} 0 0", "0 0 0"),
        ("0.3 0 0", "0 0.3 0", "0 0 0.3"),
        strict=True,
    ):
        link = f"{name}_rotor"
        add_link(model, link, ("housing", f"{place} {rotation}"), s.wheel_inertia())
        add_joint(model, name, "housing", link, axis_J="0 0 1", torque=s.wheel_torque)
    return document(root)


def target_sdf(target: Target | None = None) -> str:
    """Return the text of the model ``target``: its link ``body`` and the frame ``grapple`` (H), without markers.

    Its box collides, and its bar, as rows of spheres: in point contact a cylinder creeps out of flat pads.
    """
    t = target or Target()
    root, model = start_model("target", "body", note=NOTE)
    body = add_link(model, "body", None, t.inertia())
    add_visual(body, "box", box(*t.box), "0 0 0 0 0 0", _GOLD)
    for name, (edges, (x, y, z)) in zip(("panel_left", "panel_right"), t.boxes[1:], strict=True):
        add_visual(body, name, box(*edges), f"{text(x)} {text(y)} {text(z)} 0 0 0", _BLUE)
    length = 2 * (t.box[1] / 2 + t.panel_gap)
    add_visual(body, "yoke", cylinder(0.03, length), f"0 0 0 {text(pi / 2)} 0 0", _STEEL)
    _collide(body, "box", box(*t.box), "0 0 0 0 0 0")
    add_frame(model, "grapple", "body", _pose(t.X_TH))
    depth = t.row_distance + 2 * t.bar_radius
    bar = t.X_TH
    add_visual(body, "bar", box(2 * t.bar_radius, t.bar_length, depth), _pose(bar), _STEEL)
    posts = t.standoff - depth / 2
    for name, y in (("post_left", t.bar_length / 2), ("post_right", -t.bar_length / 2)):
        X_TP = t.X_TH @ RigidTransform([0.0, y, (t.standoff + depth / 2) / 2 - depth / 2])
        add_visual(body, name, cylinder(0.012, posts + depth), _pose(X_TP), _STEEL)
    reach = t.bar_length / 2 - t.bar_radius
    for row, z in enumerate((-t.row_distance / 2, t.row_distance / 2)):
        for k, y in enumerate(np.linspace(-reach, reach, t.bar_spheres)):
            _collide(body, f"bar_{row}_{k}", sphere(t.bar_radius), _pose(t.X_TH @ RigidTransform([0.0, y, z])))
    return document(root)


def _collide(link: ET.Element, name: str, shape: ET.Element, pose: str) -> None:
    collision = ET.SubElement(link, "collision", name=name)
    add_geometry(collision, shape, pose)
    properties = ET.SubElement(collision, "drake:proximity_properties")
    values = {"point_contact_stiffness": CONTACT_STIFFNESS, "mu_static": FRICTION, "mu_dynamic": FRICTION}
    for tag, value in values.items():
        ET.SubElement(properties, f"drake:{tag}").text = text(value)


def _pose(X: RigidTransform) -> str:
    return " ".join(text(v) for v in (*X.translation(), *RollPitchYaw(X.rotation()).vector()))


def write() -> None:
    """Write the files in ``models/``."""
    MODELS.mkdir(exist_ok=True)
    for path, content in ((SERVICER_SDF, servicer_sdf()), (WHEELS_SDF, wheels_sdf()), (TARGET_SDF, target_sdf())):
        path.write_text(content)


if __name__ == "__main__":
    write()
