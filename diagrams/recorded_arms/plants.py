"""The plants of the recorded arms and legs: kinematics, and inertias as far as they are published.

Lengths in m, angles in rad, masses in kg, inertias in kg m^2 about the centre of mass.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import pi

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    FixedOffsetFrame,
    PrismaticJoint,
    RevoluteJoint,
    RotationalInertia,
    SpatialInertia,
    UnitInertia,
)

X_AXIS = (1.0, 0.0, 0.0)
Y_AXIS = (0.0, 1.0, 0.0)
Z_AXIS = (0.0, 0.0, 1.0)
Triple = tuple[float, float, float]
_ZERO = (0.0, 0.0, 0.0)
TIAGO_LINKS = ("torso", *(f"arm{k}" for k in range(1, 8)))
GO2_JOINTS = ("hip", "thigh", "calf")


@dataclass(frozen=True)
class ArmLink:
    """A link and the joint that carries it; the link's frame is its joint's.

    Attributes:
        name: Name of the link and of its joint.
        place: Where the joint is in the link before.
        angles: Roll, pitch and yaw of the joint in the link before.
        mass: Mass.
        center: Centre of mass.
        inertia: [Ixx, Iyy, Izz, Ixy, Ixz, Iyz].
        axis: Axis of the joint.
        slides: The joint is prismatic.
    """

    name: str
    place: Triple
    angles: Triple = _ZERO
    mass: float = 1.0
    center: Triple = _ZERO
    inertia: tuple[float, float, float, float, float, float] = (0.01, 0.01, 0.01, 0.0, 0.0, 0.0)
    axis: Triple = Z_AXIS
    slides: bool = False


def serial_plant(links: Sequence[ArmLink]) -> MultibodyPlant:
    """Return a continuous plant of a serial chain with a fixed base."""
    plant = MultibodyPlant(0.0)
    parent = plant.world_body()
    for link in links:
        xx, yy, zz, xy, xz, yz = link.inertia
        about_origin = RotationalInertia(xx, yy, zz, xy, xz, yz) + RotationalInertia(link.mass, link.center)
        moments, products = about_origin.get_moments() / link.mass, about_origin.get_products() / link.mass
        # Published inertias need not belong to bodies with positive masses.
        G = UnitInertia(*moments, *products)
        body = plant.AddRigidBody(link.name, SpatialInertia(link.mass, link.center, G, skip_validity_check=True))
        X_PF = RigidTransform(RollPitchYaw(link.angles), link.place)
        mount = plant.AddFrame(FixedOffsetFrame(f"{link.name}_mount", parent.body_frame(), X_PF))
        kind = PrismaticJoint if link.slides else RevoluteJoint
        plant.AddJoint(kind(link.name, mount, body.body_frame(), link.axis))
        parent = body
    plant.Finalize()
    return plant


def pendulum() -> MultibodyPlant:
    """Return DFKI's torque-limited pendulum, which hangs down at 0 and turns about y; its inertia is a guess."""
    return serial_plant([ArmLink("link", _ZERO, mass=0.5, center=(0.0, 0.0, -0.2), axis=Y_AXIS)])


def panda() -> MultibodyPlant:
    """Return Franka's Panda with the masses, centres and inertias of Gaz and others (RA-L 2019).

    Distances and angles follow the modified convention of Denavit and Hartenberg.
    """
    d, a = (0.333, 0.0, 0.316, 0.0, 0.384, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0825, -0.0825, 0.0, 0.088)
    alpha = (0.0, -pi / 2, pi / 2, pi / 2, -pi / 2, pi / 2, pi / 2)
    masses = (4.970684, 0.646926, 3.228604, 3.587895, 1.225946, 1.666555, 0.735522)
    centers = (
        (3.875e-3, 2.081e-3, 0.0),
        (-3.141e-3, -2.872e-2, 3.495e-3),
        (2.7518e-2, 3.9252e-2, -6.6502e-2),
        (-5.317e-2, 1.04419e-1, 2.7454e-2),
        (-1.1953e-2, 4.1065e-2, -3.8437e-2),
        (6.0149e-2, -1.4117e-2, -1.0517e-2),
        (1.0517e-2, -4.252e-3, 6.1597e-2),
    )
    inertias = (
        (7.0337e-1, 7.0661e-1, 9.1170e-3, -1.3900e-4, 6.7720e-3, 1.9169e-2),
        (7.9620e-3, 2.8110e-2, 2.5995e-2, -3.9250e-3, 1.0254e-2, 7.0400e-4),
        (3.7242e-2, 3.6155e-2, 1.0830e-2, -4.7610e-3, -1.1396e-2, -1.2805e-2),
        (2.5853e-2, 1.9552e-2, 2.8323e-2, 7.7960e-3, -1.3320e-3, 8.6410e-3),
        (3.5549e-2, 2.9474e-2, 8.6270e-3, -2.1170e-3, -4.0370e-3, 2.2900e-4),
        (1.9640e-3, 4.3540e-3, 5.4330e-3, 1.0900e-4, -1.1580e-3, 3.4100e-4),
        (1.2516e-2, 1.0027e-2, 4.8150e-3, -4.2800e-4, -1.1960e-3, -7.4100e-4),
    )
    links = [
        ArmLink(
            f"link{k + 1}",
            (a[k], -np.sin(alpha[k]) * d[k], np.cos(alpha[k]) * d[k]),
            (alpha[k], 0.0, 0.0),
            masses[k],
            centers[k],
            inertias[k],
        )
        for k in range(7)
    ]
    return serial_plant(links)


def tx40() -> MultibodyPlant:
    """Return Staubli's TX40, with the kinematics and the rough inertias of FIGAROH's model."""
    h = pi / 2
    places = ((0.0, 0.0, 0.32), _ZERO, (0.225, 0.0, 0.035), (0.0, -0.225, 0.0), _ZERO, _ZERO)
    angles = (_ZERO, (-h, 0.0, 0.0), _ZERO, (h, 0.0, 0.0), (-h, 0.0, 0.0), (h, pi, 0.0))
    masses = (10.5, 3.6, 4.07, 3.62, 1.02, 0.2)
    centers = (
        (0.0, 0.02, -0.043),
        (0.109, -0.002, 0.134),
        (0.008, 0.006, 0.041),
        (-0.004, 0.002, -0.107),
        (-0.004, -0.003, -0.001),
        (0.0, 0.0, 0.042),
    )
    inertias = (
        (0.055, 0.047, 0.035, 0.0, 0.0, 0.003),
        (0.038, 0.009, 0.04, 0.0, 0.0, 0.002),
        (0.012, 0.012, 0.004, 0.0, 0.0, 0.0),
        (0.014, 0.013, 0.004, 0.0, 0.0, 0.0),
        (0.001, 0.001, 0.001, 0.0, 0.0, 0.0),
        (1e-4, 1e-4, 1e-4, 0.0, 0.0, 0.0),
    )
    names = [f"link{k}" for k in range(1, 7)]
    return serial_plant([ArmLink(*row) for row in zip(names, places, angles, masses, centers, inertias, strict=True)])


def tiago() -> MultibodyPlant:
    """Return the lift and the arm of PAL Robotics' TIAGo, with the inertias of its URDF.

    The head, which does not move, is a part of the lift, and the gripper is a part of the last link.
    """
    h = pi / 2
    places = (
        (-0.062, 0.0, 0.79),
        (0.15505, 0.014, -0.151),
        (0.125, 0.0195, -0.031),
        (0.0895, 0.0, -0.0015),
        (-0.02, -0.027, -0.222),
        (-0.162, 0.02, 0.027),
        (0.0, 0.0, 0.15),
        _ZERO,
    )
    angles = (
        _ZERO,
        (0.0, 0.0, -h),
        (h, 0.0, 0.0),
        (-h, 0.0, h),
        (-h, -h, 0.0),
        (h, -h, -h),
        (0.0, -h, -h),
        (h, 0.0, h),
    )
    masses = (8.4, 1.563428, 1.800397, 2.343502, 1.432697, 1.655819, 0.370063, 1.2)
    centers = (
        (0.0436, -0.0012, -0.1733),
        (0.061191, -0.022397, -0.012835),
        (0.030432, 0.000229, -0.005942),
        (0.007418, -0.004361, -0.134194),
        (-0.095658, 0.014666, 0.018133),
        (0.001078, -0.000151, -0.077173),
        (-0.000153, -0.003122, 0.000183),
        (0.0, 0.0, 0.07),
    )
    inertias = (
        (0.245, 0.249, 0.09, -0.0015, -0.0097, 0.0083),
        (0.002471, 0.006132, 0.006704, -0.001809, -0.001202, 0.000494),
        (0.001809, 0.004333, 0.004341, 1.5e-5, 0.000254, 1.4e-5),
        (0.019541, 0.019936, 0.002864, -0.000105, -0.001717, 0.000852),
        (0.00204, 0.008424, 0.008686, 0.000725, -0.00115, -0.000204),
        (0.006138, 0.00564, 0.001797, -4e-6, 0.000156, 2.2e-5),
        (0.000215, 0.00017, 0.000174, 0.0, 0.0, 2e-6),
        (0.002, 0.002, 0.001, 0.0, 0.0, 0.0),
    )
    axes, slides = [Z_AXIS] * 8, [True, *[False] * 7]
    rows = zip(TIAGO_LINKS, places, angles, masses, centers, inertias, axes, slides, strict=True)
    return serial_plant([ArmLink(*row) for row in rows])


def kr300(load: float = 151.2) -> MultibodyPlant:
    """Return KUKA's KR300 R2500 with a load in kg, and the numbers of J. Weigand and others (2021).

    These are in the classical convention of Denavit and Hartenberg, whose frames are at the far ends of the links, with
    the base upside down.
    """
    d, a = (-0.675, -0.189, 0.189, -1.0, 0.0, -0.24), (0.35, 1.15, 0.041, 0.0, 0.0, 0.0)
    alpha = (pi / 2, 0.0, -pi / 2, pi / 2, -pi / 2, pi)
    flange = 17.78
    masses = (395.4, 339.12, 105.21, 35.8, 31.46, load + flange)
    centers = (
        (-0.353, 0.174, -0.004),
        (-0.709, -0.001, 0.023),
        (-0.018, -0.018, -0.076),
        (0.0, 0.236, 0.001),
        (0.0, -0.08, -0.009),
        (0.0, 0.0, (0.1 * load - 0.05 * flange) / (load + flange)),
    )
    # Ixx, Iyy, Izz, Ixy, Iyz, Ixz
    inertias = (
        (16.733765, 29.799119, 32.814954, -1.703664, 0.129384, 4.404062),
        (7.507819, 88.886691, 88.673761, 0.430046, 0.173157, -4.396607),
        (10.783798, 10.186135, 1.943179, 0.118474, -0.606384, -0.10195),
        (0.425035, 0.217993, 0.428465, -4e-6, -0.011353, -27e-6),
        (0.283826, 0.229562, 0.258266, -4e-6, -0.019521, -120e-6),
        (0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
    )
    links, X_PF = [], RigidTransform(RollPitchYaw(pi, 0.0, 0.0), [0.0, 0.0, 0.0])
    for k, (xx, yy, zz, xy, yz, xz) in enumerate(inertias):
        X_MD = RigidTransform([0.0, 0.0, d[k]]) @ RigidTransform(RollPitchYaw(alpha[k], 0.0, 0.0), [a[k], 0.0, 0.0])
        R = X_MD.rotation().matrix()
        turned = R @ np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ R.T
        links.append(
            ArmLink(
                f"axis{k + 1}",
                tuple(X_PF.translation()),
                tuple(X_PF.rotation().ToRollPitchYaw().vector()),
                masses[k],
                tuple(X_MD @ np.array(centers[k])),
                tuple(turned[i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))),
            )
        )
        X_PF = X_MD
    return serial_plant(links)


def go2_leg(side: float = 1.0) -> MultibodyPlant:
    """Return a leg of Unitree's Go2 on a fixed trunk, with the inertias of its public model.

    Args:
        side: 1 on the left, -1 on the right.
    """
    hip = ArmLink("hip", _ZERO, mass=0.678, center=(-0.0054, 0.00194 * side, -0.000105), axis=X_AXIS)
    thigh = ArmLink(
        "thigh", (0.0, 0.0955 * side, 0.0), mass=1.152, center=(-0.00374, -0.0223 * side, -0.0327), axis=Y_AXIS
    )
    calf = ArmLink("calf", (0.0, 0.0, -0.213), mass=0.241352, center=(0.0063, -0.00062 * side, -0.1414), axis=Y_AXIS)
    moments = ((0.00048, 0.000884, 0.000596), (0.00584, 0.0058, 0.00103), (0.00149, 0.00146, 0.000053))
    links = zip((hip, thigh, calf), moments, strict=True)
    return serial_plant([replace(link, inertia=(*diagonal, 0.0, 0.0, 0.0)) for link, diagonal in links])
