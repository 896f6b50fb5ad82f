"""Worlds in contact and their outcomes: a pushed puck, a gripper that holds a bar, a pushed quadruped, a climber."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.geometry import Box, CollisionFilterDeclaration, Cylinder, GeometrySet, HalfSpace, Sphere
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import AddMultibodyPlant, MultibodyPlant, MultibodyPlantConfig
from pydrake.multibody.tree import FixedOffsetFrame, PdControllerGains, PrismaticJoint, RigidBody
from pydrake.systems.framework import Context, Diagram, DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource

from tests.compiled.quadruped import LEGS, POSTURE, inertia, quadruped, surface
from vtbdrake_diagrams.space_climber import CraterScenario
from vtbdrake_diagrams.space_climber.crater_scenario import TIPPED_OVER
from vtbdrake_diagrams.space_climber.morphology import Morphology


@dataclass(frozen=True)
class Outcome:
    """The outcome of a rollout.

    Attributes:
        happened: Whether the robot fell, or whether the object moved, or was lost.
        distance: How far it went, in m.
        share: The share of the time in which feet slid; 0 without feet.
    """

    happened: bool
    distance: float
    share: float = 0.0

    def is_like(self, other: Outcome) -> bool:
        """Return whether two outcomes are alike: distances within 2 mm or 2 %, shares within 0.02."""
        apart = abs(self.distance - other.distance)
        is_near = apart <= max(0.002, 0.02 * abs(other.distance)) and abs(self.share - other.share) <= 0.02
        return self.happened == other.happened and is_near


@dataclass(frozen=True)
class ContactWorld:
    """A Diagram with a plant in contact.

    Attributes:
        diagram: The Diagram, whose plant is named ``plant``.
        plant: The plant.
        horizon: Length of a rollout, in s.
        randomize: Draws the begin of a rollout in the plant's context.
        outcome: Reads the outcome from the states at the samples, shape (m, nx), and a context of the plant.
    """

    diagram: Diagram
    plant: MultibodyPlant
    horizon: float
    randomize: Callable[[MultibodyPlant, Context, np.random.Generator], None]
    outcome: Callable[[MultibodyPlant, Context, np.ndarray], Outcome]


def _config(approximation: str, time_step: float) -> MultibodyPlantConfig:
    return MultibodyPlantConfig(
        time_step=time_step,
        contact_model="point",
        discrete_contact_approximation=approximation,
        use_sampled_output_ports=False,
    )


def _slider(
    plant: MultibodyPlant, name: str, parent: RigidBody, place: list[float], axis: list[int], **limits: float
) -> RigidBody:
    """Add a body of 0.3 kg on a driven slider; ``limits`` are lower, upper and effort."""
    body = plant.AddRigidBody(name, inertia(0.3, 0.0, (2e-4, 2e-4, 2e-4)))
    frame = plant.AddFrame(FixedOffsetFrame(f"{name}_frame", parent.body_frame(), RigidTransform(place)))
    stops = limits.get("lower", -np.inf), limits.get("upper", np.inf)
    slider = plant.AddJoint(PrismaticJoint(f"{name}_slider", frame, body.body_frame(), axis, *stops))
    motor = plant.AddJointActuator(f"{name}_motor", slider, limits.get("effort", np.inf))
    motor.set_controller_gains(PdControllerGains(p=400.0, d=30.0))
    return body


def _diagram(builder: DiagramBuilder, plant: MultibodyPlant, desired: list[float]) -> Diagram:
    plant.Finalize()
    source = builder.AddNamedSystem("desired", ConstantVectorSource([*desired, *[0.0] * len(desired)]))
    builder.Connect(source.get_output_port(), plant.GetInputPort("DefaultModelInstance_desired_state"))
    rest = builder.AddNamedSystem("feed_forward", ConstantVectorSource(np.zeros(len(desired))))
    builder.Connect(rest.get_output_port(), plant.get_actuation_input_port())
    return builder.Build()


def puck(approximation: str) -> ContactWorld:
    """Return a puck on three feet, which a finger pushes aside until the finger reaches its stop."""
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlant(_config(approximation, 0.002), builder)
    world = plant.world_body()
    plant.RegisterCollisionGeometry(world, RigidTransform(), HalfSpace(), "table", surface(0.4, 1e5, 0.01, 1.0))
    disk = plant.AddRigidBody("puck", inertia(0.4, 0.0, (5e-4, 5e-4, 8e-4)))
    rim = Cylinder(0.06, 0.03)
    plant.RegisterCollisionGeometry(disk, RigidTransform(), rim, "rim", surface(0.3, 1e5, 0.01, 1.0))
    feet = GeometrySet()
    for k in range(3):
        place = [0.05 * np.cos(2.1 * k), 0.05 * np.sin(2.1 * k), -0.018]
        material = surface(0.4, 1e5, 0.01, 1.0)
        feet.Add(plant.RegisterCollisionGeometry(disk, RigidTransform(place), Sphere(0.007), f"foot_{k}", material))
    finger = _slider(plant, "finger", world, [-0.1, 0.0, 0.03], [1, 0, 0], upper=0.2, effort=8.0)
    tip = plant.RegisterCollisionGeometry(finger, RigidTransform(), Sphere(0.02), "tip", surface(0.3, 1e5, 0.01, 1.0))
    diagram = _diagram(builder, plant, [0.3])
    scene_graph.collision_filter_manager().Apply(CollisionFilterDeclaration().ExcludeBetween(feet, GeometrySet(tip)))

    def randomize(plant: MultibodyPlant, context: Context, random: np.random.Generator) -> None:
        turned = RollPitchYaw(0.0, 0.0, random.uniform(-np.pi, np.pi))
        place = [random.uniform(0.02, 0.06), random.uniform(-0.12, 0.12), 0.025 - 1e-5]
        plant.SetFreeBodyPose(context, plant.GetBodyByName("puck"), RigidTransform(turned, place))
        speed = random.choice([0.001, 0.01, 0.1])
        plant.SetVelocities(context, speed * random.standard_normal(plant.num_velocities()))

    def outcome(plant: MultibodyPlant, context: Context, states: np.ndarray) -> Outcome:
        places = _places(plant, context, states, "puck")
        distance = float(np.linalg.norm(places[-1, :2] - places[0, :2]))
        return Outcome(distance > 0.01, distance)

    return ContactWorld(diagram, plant, 0.8, randomize, outcome)


def gripper(approximation: str) -> ContactWorld:
    """Return a gripper that closes on a bar with round ends of its grips, and pulls it up against its weight."""
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlant(_config(approximation, 0.002), builder)
    world = plant.world_body()
    floor = surface(0.5, 1e5, 0.01, 1.0)
    plant.RegisterCollisionGeometry(world, RigidTransform(), HalfSpace(), "floor", floor)
    palm = _slider(plant, "palm", world, [0.0, 0.0, 0.05], [0, 0, 1], lower=-0.01, upper=0.3, effort=18.0)
    pads = GeometrySet()
    for name, side in (("left", 1), ("right", -1)):
        finger = _slider(plant, name, palm, [0.0, 0.05 * side, 0.0], [0, -side, 0], lower=-0.01, upper=0.05, effort=4.0)
        pad = surface(0.6, 5e4, 0.02, 0.5)
        pads.Add(plant.RegisterCollisionGeometry(finger, RigidTransform(), Box(0.06, 0.02, 0.04), f"{name}_pad", pad))
    bar = plant.AddRigidBody("bar", inertia(0.25, 0.0, (3e-4, 2e-4, 3e-4)))
    for k, (x, y) in enumerate(((0.02, 0.02), (-0.02, 0.02), (0.02, -0.02), (-0.02, -0.02))):
        knob = surface(0.5, 5e4, 0.02, 0.5)
        plant.RegisterCollisionGeometry(bar, RigidTransform([x, y, 0.0]), Sphere(0.01), f"knob_{k}", knob)
    diagram = _diagram(builder, plant, [0.15, 0.05, 0.05])
    scene_graph.collision_filter_manager().Apply(CollisionFilterDeclaration().ExcludeWithin(pads))
    floor_id = GeometrySet(plant.GetCollisionGeometriesForBody(world))
    scene_graph.collision_filter_manager().Apply(CollisionFilterDeclaration().ExcludeBetween(pads, floor_id))

    def randomize(plant: MultibodyPlant, context: Context, random: np.random.Generator) -> None:
        turned = RollPitchYaw(0.1 * random.standard_normal(3))
        place = [random.uniform(-0.02, 0.02), random.uniform(-0.005, 0.005), random.uniform(0.04, 0.06)]
        plant.SetPositions(context, np.zeros(plant.num_positions()))
        plant.SetFreeBodyPose(context, plant.GetBodyByName("bar"), RigidTransform(turned, place))
        for name in ("left", "right"):
            plant.GetJointByName(f"{name}_slider").set_translation(context, random.uniform(0.0, 0.012))
        speed = random.choice([0.001, 0.1, 0.5])
        plant.SetVelocities(context, speed * random.standard_normal(plant.num_velocities()))

    def outcome(plant: MultibodyPlant, context: Context, states: np.ndarray) -> Outcome:
        height = float(_places(plant, context, states, "bar")[-1, 2])
        return Outcome(height < 0.1, height)

    return ContactWorld(diagram, plant, 0.6, randomize, outcome)


def climbing_quadruped(approximation: str) -> ContactWorld:
    """Return the pushed quadruped on convex pieces of terrain."""
    return pushed_quadruped(approximation, terrain=True)


def pushed_quadruped(approximation: str, *, terrain: bool = False) -> ContactWorld:
    """Return a quadruped with joint stops and PD controllers, which begins with a push."""
    diagram, plant = quadruped(approximation, stops=True, drives=True, terrain=terrain)

    def randomize(plant: MultibodyPlant, context: Context, random: np.random.Generator) -> None:
        plant.SetPositions(context, plant.GetDefaultPositions())
        turned = RollPitchYaw(0.1 * random.standard_normal(3))
        place = [0.0, 0.0, random.uniform(0.28, 0.36)]
        plant.SetFreeBodyPose(context, plant.GetBodyByName("trunk"), RigidTransform(turned, place))
        for kind, angle in POSTURE.items():
            for leg in range(len(LEGS)):
                joint = plant.GetJointByName(f"{kind}_{leg}")
                joint.set_angle(context, angle + 0.2 * random.standard_normal())
        v = random.choice([0.05, 0.5]) * random.standard_normal(plant.num_velocities())
        v[:6] = random.choice([0.2, 1.0, 2.0]) * random.standard_normal(6)
        plant.SetVelocities(context, v)

    def outcome(plant: MultibodyPlant, context: Context, states: np.ndarray) -> Outcome:
        places = _places(plant, context, states, "trunk")
        sliding = 0
        for state in states:
            plant.SetPositionsAndVelocities(context, state)
            for leg in range(len(LEGS)):
                shank = plant.GetBodyByName(f"knee_{leg}_link")
                foot = shank.EvalPoseInWorld(context) @ np.array([0.0, 0.0, -0.2])
                V = shank.EvalSpatialVelocityInWorld(context)
                origin = shank.EvalPoseInWorld(context).translation()
                v = V.translational() + np.cross(V.rotational(), foot - origin)
                sliding += bool(foot[2] < 0.02 and np.linalg.norm(v[:2]) > 0.05)
        distance = float(np.linalg.norm(places[-1, :2] - places[0, :2]))
        return Outcome(bool(places[-1, 2] < 0.2), distance, sliding / (len(LEGS) * len(states)))

    return ContactWorld(diagram, plant, 1.5, randomize, outcome)


def crater_climber(approximation: str) -> ContactWorld:
    """Return the testbed of the climber in a crater as it reasons, its DPS walking, somewhere on floor and wall."""
    mental = CraterScenario().mental()
    testbed = replace(mental, plant_config=_config(approximation, mental.period)).build()
    crater, morphology = mental.crater, Morphology()
    plant = testbed.plant
    assert plant is not None

    def randomize(plant: MultibodyPlant, context: Context, random: np.random.Generator) -> None:
        plant.SetPositions(context, plant.GetDefaultPositions())
        radius, azimuth = random.uniform(0.0, 36.0), random.uniform(-0.7, 0.7)
        place = radius * np.array([np.cos(azimuth), np.sin(azimuth)])
        height = float(crater.mesh_height(place + morphology.stance[:, :2]).max())
        tilt = [*(0.05 * random.standard_normal(2)), 0.0]
        sunk = random.uniform(0.0, 0.003)
        base = RigidTransform(RollPitchYaw(tilt), [*place, height + morphology.torso_clearance - sunk])
        plant.SetFreeBodyPose(context, plant.GetBodyByName("base"), base)
        speed = random.choice([0.001, 0.05, 0.5])
        plant.SetVelocities(context, speed * random.standard_normal(plant.num_velocities()))

    def outcome(plant: MultibodyPlant, context: Context, states: np.ndarray) -> Outcome:
        places = _places(plant, context, states, "base")
        tilts = np.array([abs(RollPitchYaw(Quaternion(q / np.linalg.norm(q))).vector()[:2]) for q in states[:, :4]])
        return Outcome(bool(tilts.max() > TIPPED_OVER), float(np.linalg.norm(places[-1, :2] - places[0, :2])))

    return ContactWorld(testbed.diagram, plant, 12.0, randomize, outcome)


def _places(plant: MultibodyPlant, context: Context, states: np.ndarray, name: str) -> np.ndarray:
    """Return the positions of a free body at the samples, shape (m, 3)."""
    start = plant.GetBodyByName(name).floating_positions_start() + 4
    return states[:, start : start + 3]


WORLDS = {
    "puck": puck,
    "gripper": gripper,
    "quadruped": pushed_quadruped,
    "terrain": climbing_quadruped,
    "crater": crater_climber,
}
