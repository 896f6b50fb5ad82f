r"""Which ground lets a foot sink in, without pushing it sideways where its parts meet?

``python -m vtbdrake_diagrams.space_climber.studies.soft_ground`` presses the climber's spherical foot with the load of
a tripod, a third of the weight on the moon, into level soil without friction, at several distances beside a line on
which two triangles of the ground meet. It prints how deep the foot sinks in, and the force to the side over the load.
Both should be the same everywhere: the ground is level, and the line is only in its representation.

**Law of the soil.** Under a plate of the width b, the pressure at the sinkage z is (k_c / b + k_phi) z (Bekker, with
the exponent 1), with k_c = 1.4 kN/m^2 and k_phi = 820 kN/m^3 for the moon (Lunar Sourcebook, chapter 9, 1991). Summed
over the part of a sphere of the radius r that is in the ground, with b = r, the force is

    F(z) = pi k (r z^2 - z^3 / 3),   k = k_c / r + k_phi.

Contact at points is linear: its stiffness is F / z at the load. A foot that is compliant and hydroelastic, on rigid
ground, has the pressure E (1 - s / r) at the distance s from its centre, and so the force

    F(z) = pi E (z^2 - 2 z^3 / (3 r)).

With E = k r this is the soil's law for small z; E is chosen so that both agree at the load.

**What a foot feels beside the line, at points.** The centre is at the height h = r - z and at the distance x from the
line. One part is below it: a force k z upwards. The nearest point of the second part is on the line, at the distance
s = sqrt(x^2 + h^2): a force k (r - s) along (x, h) / s, which pushes the foot away from the line. A rigid foot has
h = r nearly, and s < r only for x below sqrt(2 r z), some tenths of a millimetre. With boxes, Drake computes just this;
the depths and normals that it finds between a sphere and a `Convex` are others (drake 1.51).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from time import process_time

import click
import numpy as np
from pydrake.geometry import (
    AddCompliantHydroelasticProperties,
    AddContactMaterial,
    AddRigidHydroelasticProperties,
    Box,
    Mesh,
    ProximityProperties,
    Shape,
    Sphere,
)
from pydrake.math import RigidTransform
from pydrake.multibody.plant import AddMultibodyPlant, CoulombFriction, MultibodyPlantConfig
from pydrake.multibody.tree import FixedOffsetFrame, PrismaticJoint, SpatialInertia
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from scipy.optimize import brentq

from vtbdrake.cli.output import table
from vtbdrake.common.arrays import Array
from vtbdrake.components.meshes import obj_mesh
from vtbdrake_diagrams.space_climber.morphology import LUNAR_GRAVITY, Morphology
from vtbdrake_diagrams.space_climber.terrain import prism

COHESIVE = 1.4e3
"""Bekker's k_c of lunar soil, in N/m^2."""
FRICTIONAL = 820e3
"""Bekker's k_phi of lunar soil, in N/m^3."""
RADIUS = Morphology().foot_radius
"""Radius of the foot in m."""
LOAD = Morphology().total_mass * LUNAR_GRAVITY / 3.0
"""Load on the foot in N."""
PLACES = (0.0, 0.001, 0.005, 0.01, 0.015, 0.02, 0.03)
"""Distances of the foot beside the line, in m."""
RIGID = 1e6
"""Stiffness of contact at points that counts as rigid, in N/m."""
SLOPE = np.radians(10.0)
"""Slope of the sides of a valley."""
# Half width of the ground in m.
_HALF = 0.5
# Depth of the ground under its surface in m.
_DEPTH = 0.3
# The duration in s after which the foot rests.
_DURATION = 3.0
# The time step of the plant in s.
_STEP = 2e-3
# Edge length of the triangles of a hydroelastic foot, as a share of its radius.
_RESOLUTION = 0.25

Parts = list[tuple[RigidTransform, Shape]]


def sphere_force(z: float) -> float:
    """Return the force in N of the soil on the foot at a sinkage z in m."""
    return float(np.pi * (COHESIVE / RADIUS + FRICTIONAL) * (RADIUS * z**2 - z**3 / 3.0))


def sinkage() -> float:
    """Return the sinkage of the foot under its load in m, by the law of the soil."""
    return float(brentq(lambda z: sphere_force(z) - LOAD, 0.0, RADIUS))


def stiffness() -> float:
    """Return the stiffness of contact at points that gives this sinkage, in N/m."""
    return LOAD / sinkage()


def modulus() -> float:
    """Return the hydroelastic modulus of a foot with this sinkage on rigid ground, in Pa."""
    z = sinkage()
    return float(LOAD / (np.pi * (z**2 - 2.0 * z**3 / (3.0 * RADIUS))))


def corners(slope: float) -> Array:
    """Return the surface of the ground: two triangles over the line x = 0, whose other corners rise, (2, 3, 3)."""
    rise = _HALF * np.tan(slope)
    line = [[0.0, -_HALF, 0.0], [0.0, _HALF, 0.0]]
    return np.array([[line[1], line[0], [_HALF, 0.0, rise]], [line[0], line[1], [-_HALF, 0.0, rise]]])


def one_box(slope: float) -> Parts:
    """Return the ground as one box, which has no valley."""
    return [(RigidTransform([0.0, 0.0, -0.5 * _DEPTH]), Box(2.0 * _HALF, 2.0 * _HALF, _DEPTH))]


def two_boxes(slope: float) -> Parts:
    """Return the ground as two boxes that meet on the line; it has no valley."""
    size = np.array([_HALF, 2.0 * _HALF, _DEPTH])
    return [(RigidTransform([0.5 * side * _HALF, 0.0, -0.5 * _DEPTH]), Box(*size)) for side in (-1.0, 1.0)]


def two_prisms(slope: float) -> Parts:
    """Return the ground as the climber's crater has it: a prism below each triangle."""
    return [prism(triangle) for triangle in corners(slope)]


def one_mesh(slope: float) -> Parts:
    """Return the ground as one mesh."""
    right, left = corners(slope)
    upper = np.array([right[1], right[2], right[0], left[2]])
    lower = upper * [1.0, 1.0, 0.0] - [0.0, 0.0, _DEPTH]
    sides = [(i, i + 4, (i + 1) % 4 + 4, (i + 1) % 4) for i in range(4)]
    faces = [(0, 1, 2), (0, 2, 3), (6, 5, 4), (7, 6, 4), *sides]
    return [(RigidTransform(), Mesh(obj_mesh(np.vstack([upper, lower]), faces, name="ground"), 1.0))]


@dataclass(frozen=True)
class Ground:
    """One representation of the ground.

    Attributes:
        name: Its name.
        parts: Returns its parts, for a slope of both sides in rad.
        stiffness: The stiffness of contact at points in N/m; 0 for a hydroelastic foot on rigid ground.
    """

    name: str
    parts: Callable[[float], Parts]
    stiffness: float


def grounds() -> list[Ground]:
    """Return the representations that are compared."""
    soft = stiffness()
    return [
        Ground("prisms, rigid, at points", two_prisms, RIGID),
        Ground("one box, soft, at points", one_box, soft),
        Ground("two boxes, soft, at points", two_boxes, soft),
        Ground("two prisms, soft, at points", two_prisms, soft),
        Ground("one mesh, soft, at points", one_mesh, soft),
        Ground("two prisms, rigid; hydroelastic foot", two_prisms, 0.0),
        Ground("one mesh, rigid; hydroelastic foot", one_mesh, 0.0),
    ]


@dataclass(frozen=True)
class Pressed:
    """A foot at rest.

    Attributes:
        sinkage: How deep it is below the height at which it touches the level z = 0, in m.
        sideways: The force of the ground on it along x, away from the line, in N.
    """

    sinkage: float
    sideways: float


def pressed(ground: Ground, place: float, *, slope: float = 0.0) -> Pressed:
    """Press the foot into a ground at a distance (m) beside the line, and return where it rests."""
    builder = DiagramBuilder()
    model = "hydroelastic" if ground.stiffness == 0.0 else "point"
    config = MultibodyPlantConfig(time_step=_STEP, contact_model=model, discrete_contact_approximation="sap")
    plant, _ = AddMultibodyPlant(config, builder)
    plant.mutable_gravity_field().set_gravity_vector([0.0, 0.0, -LUNAR_GRAVITY])
    smooth = CoulombFriction(0.0, 0.0)
    soil, sole = ProximityProperties(), ProximityProperties()
    if ground.stiffness == 0.0:
        AddRigidHydroelasticProperties(0.1, soil)
        AddCompliantHydroelasticProperties(_RESOLUTION * RADIUS, modulus(), sole)
        AddContactMaterial(None, None, smooth, soil)
        AddContactMaterial(None, None, smooth, sole)
    else:  # Two equal stiffnesses in series are half of each.
        for properties in (soil, sole):
            AddContactMaterial(None, 2.0 * ground.stiffness, smooth, properties)
    for k, (X_WG, shape) in enumerate(ground.parts(slope)):
        plant.RegisterCollisionGeometry(plant.world_body(), X_WG, shape, f"ground_{k}", soil)
    mass = LOAD / LUNAR_GRAVITY
    foot = plant.AddRigidBody("foot", SpatialInertia.SolidSphereWithMass(mass, RADIUS))
    plant.RegisterCollisionGeometry(foot, RigidTransform(), Sphere(RADIUS), "foot", sole)
    rail = plant.AddFrame(FixedOffsetFrame("rail", plant.world_frame(), RigidTransform([place, 0.0, 0.0])))
    damping = 2.0 * np.sqrt(stiffness() * mass)
    upward = [0.0, 0.0, 1.0]
    joint = plant.AddJoint(PrismaticJoint("press", rail, foot.body_frame(), upward, -np.inf, np.inf, damping))
    plant.Finalize()
    simulator = Simulator(builder.Build())
    context = plant.GetMyContextFromRoot(simulator.get_mutable_context())
    joint.set_translation(context, RADIUS + max(place * np.tan(slope), 0.0))
    simulator.AdvanceTo(_DURATION)
    if abs(joint.get_translation_rate(context)) > 1e-4:
        raise RuntimeError(f"the foot on {ground.name} moves at {joint.get_translation_rate(context):.2g} m/s")
    (reaction,) = plant.get_reaction_forces_output_port().Eval(context)  # of the only joint
    return Pressed(RADIUS - joint.get_translation(context), -float(reaction.translational()[0]))


def row(ground: Ground) -> tuple[str, ...]:
    """Return the row of one representation: sinkage and force to the side over the load at each place; its time."""
    began = process_time()
    results = [pressed(ground, place) for place in PLACES]
    spent = process_time() - began
    valley = "" if ground.parts in (one_box, two_boxes) else f"{1e3 * pressed(ground, 0.0, slope=SLOPE).sinkage:.1f}"
    cells = [f"{1e3 * each.sinkage:.1f}, {abs(each.sideways) / LOAD:.0%}" for each in results]
    return ground.name, *cells, valley, f"{1e3 * spent / (len(PLACES) * _DURATION / _STEP):.2f}"


HEADER = ("ground", *(f"{1e3 * place:g} mm" for place in PLACES), "in a valley of 10 deg", "ms per step")


@click.command()
def main() -> None:
    """Press the foot into each representation of the ground, and print the table."""
    print(f"load {LOAD:.2f} N, sinkage {1e3 * sinkage():.1f} mm, {stiffness():.0f} N/m, modulus {modulus():.0f} Pa")
    print("Sinkage in mm and force to the side over the load, by the distance beside the line; sinkage in a valley:")
    print(table(HEADER, [row(ground) for ground in grounds()]))


if __name__ == "__main__":
    main()
