r"""Which ground lets a foot sink in, without pushing it sideways where its parts meet?

``python -m vtbdrake_diagrams.space_climber.studies.soft_ground`` presses the climber's spherical foot with the load of
a tripod, a third of the weight on the moon, into level soil without friction, at several distances beside a line on
which two triangles of the ground meet. It prints how deep the foot sinks in, and the force to the side over the load.
Both should be the same everywhere: the ground is level, and the line is only in its representation.

The law of the soil is Bekker's, for the moon (`vtbdrake_diagrams.space_climber.soil`). Contact at points is linear: its
stiffness is the one that gives the sinkage of this law at the load. A compliant hydroelastic foot on rigid ground
follows the law itself.

``--craters N`` lets the climber walk 300 s straight ahead in N craters, from ``--seed`` on, on rigid ground and on such
soil (`SoilCraterScenario`), with the same integrator, and prints where it is then.

**What a foot feels beside the line, at points.** The centre is at the height h = r - z and at the distance x from the
line. One part is below it: a force k z upwards. The nearest point of the second part is on the line, at the distance
s = sqrt(x^2 + h^2): a force k (r - s) along (x, h) / s, which pushes the foot away from the line. A rigid foot has
h = r nearly, and s < r only for x below sqrt(2 r z), some tenths of a millimetre. With boxes, Drake computes just this;
the depths and normals that it finds between a sphere and a `Convex` are others (drake 1.51).
"""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import dataclass, replace
from time import process_time

import click
import numpy as np
from pydrake.geometry import (
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

from vtbdrake.cli.output import table
from vtbdrake.common.arrays import Array
from vtbdrake.components.meshes import obj_mesh
from vtbdrake_diagrams.space_climber.morphology import LUNAR_GRAVITY
from vtbdrake_diagrams.space_climber.soil import LOAD, RADIUS, Soil, SoilCraterScenario
from vtbdrake_diagrams.space_climber.terrain import prism

PLACES = (0.0, 0.001, 0.005, 0.01, 0.015, 0.02, 0.03)
"""Distances of the foot beside the line, in m."""
HORIZON = 300.0
"""The longest time of a walk in a crater, in s."""
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

Parts = list[tuple[RigidTransform, Shape]]


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
    soft = Soil().stiffness()
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
        Soil().add_to_foot(sole)
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
    damping = 2.0 * np.sqrt(Soil().stiffness() * mass)
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


def walk_row(seed: int) -> tuple[str, ...]:
    """Return the row of one crater: where the climber is after 300 s at most, on rigid ground and on soil."""
    soil = SoilCraterScenario(seed=seed)
    at_points = copy(soil.plant_config)
    at_points.contact_model = "point"
    rigid = replace(soil, plant_config=at_points)
    cells = []
    for scenario in (rigid, soil):
        testbed = scenario.build()
        context = testbed.default_context()
        testbed.simulator(context).AdvanceTo(HORIZON)
        x, y, z = testbed.read(context, "sim.sys.climber.base.pose")[:3]
        cells.append(f"{np.hypot(x, y):.1f} m from the axis, {z:.1f} m high, {context.get_time():.0f} s")
    return str(seed), *cells


WALK_HEADER = ("crater", "rigid ground", "soil")


@click.command(context_settings={"show_default": True})
@click.option("--craters", default=0, help="Number of craters in which the climber walks.")
@click.option("--seed", default=0, help="The first crater.")
def main(craters: int, seed: int) -> None:
    """Press the foot into each representation of the ground, and print the table."""
    if craters:
        print(table(WALK_HEADER, [walk_row(each) for each in range(seed, seed + craters)]))
        return
    soil = Soil()
    print(
        f"load {LOAD:.2f} N, sinkage {1e3 * soil.sinkage():.1f} mm, {soil.stiffness():.0f} N/m, {soil.modulus():.0f} Pa"
    )
    print("Sinkage in mm and force to the side over the load, by the distance beside the line; sinkage in a valley:")
    print(table(HEADER, [row(ground) for ground in grounds()]))


if __name__ == "__main__":
    main()
