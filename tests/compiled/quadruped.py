"""A quadruped on four round feet, and what it may touch, as a Diagram."""

from __future__ import annotations

import numpy as np
from pydrake.geometry import (
    AddContactMaterial,
    Box,
    CollisionFilterDeclaration,
    Convex,
    GeometrySet,
    HalfSpace,
    ProximityProperties,
    Sphere,
)
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import (
    AddMultibodyPlant,
    CoulombFriction,
    MultibodyPlant,
    MultibodyPlantConfig,
)
from pydrake.multibody.tree import (
    FixedOffsetFrame,
    PdControllerGains,
    RevoluteJoint,
    RigidBody,
    RotationalInertia,
    SpatialInertia,
)
from pydrake.systems.framework import Diagram, DiagramBuilder
from pydrake.systems.primitives import AffineSystem, ConstantVectorSource

from vtbdrake.components.sensors import ContactSensor

LEGS = ((1, 1), (1, -1), (-1, 1), (-1, -1))
POSTURE = {"hip": 0.0, "thigh": 0.7, "knee": -1.4}
HEIGHT = 0.33
STIFFNESS = 60.0  # N m/rad
DAMPING = 2.0  # N m s/rad
EFFORT_LIMIT = 12.0  # N m


def inertia(mass: float, z: float, moments: tuple[float, float, float]) -> SpatialInertia:
    return SpatialInertia.MakeFromCentralInertia(mass, [0.0, 0.0, z], RotationalInertia(*moments))


def surface(
    friction: float, stiffness: float | None = None, relaxation: float | None = None, dissipation: float | None = None
) -> ProximityProperties:
    """Return a material; what is left out is the plant's."""
    properties = ProximityProperties()
    AddContactMaterial(dissipation, stiffness, CoulombFriction(friction, friction), properties)
    if relaxation is not None:
        properties.AddProperty("material", "relaxation_time", relaxation)
    return properties


def quadruped(
    approximation: str,
    *,
    time_step: float = 0.005,
    playground: bool = False,
    stops: bool = False,
    drives: bool = False,
    terrain: bool = False,
    contact_period: float | None = None,
    sampled: bool = False,
) -> tuple[Diagram, MultibodyPlant]:
    """Return a Diagram: four legs held by joint PD, a trot's length above the ground.

    Args:
        approximation: Drake's name of the contact approximation.
        time_step: The time step of the plant, and the period of the controller, in s.
        playground: The ground is a slope, feet touch each other, there are a box and two balls, and materials differ.
        stops: The joints have stops.
        terrain: The ground is made of convex pieces of uneven height, 0.4 m long and broad, instead of a plane.
        contact_period: Period of contact switches of the feet, ``switches``, in s; None: there are none.
        sampled: The plant's outputs show its last step.
        drives: The actuators have the joint PD, with effort limits, instead of the DPS; there is a feed-forward.
    """
    builder = DiagramBuilder()
    config = MultibodyPlantConfig(
        time_step=time_step,
        contact_model="point",
        discrete_contact_approximation=approximation,
        use_sampled_output_ports=sampled,
    )
    plant, scene_graph = AddMultibodyPlant(config, builder)
    trunk = plant.AddRigidBody("trunk", inertia(6.0, 0.0, (0.02, 0.06, 0.07)))
    feet = GeometrySet()
    for number, (front, left) in enumerate(LEGS):
        material = surface(0.8, 3e4 + 1e3 * number, 0.05, 0.3) if playground else surface(0.8)
        shank = _leg(plant, trunk, str(number), front, left, stops=stops, drives=drives)
        feet.Add(
            plant.RegisterCollisionGeometry(
                shank, RigidTransform([0, 0, -0.2]), Sphere(0.02), f"foot_{number}", material
            )
        )
    world = plant.world_body()
    if playground:
        slope = RigidTransform(RollPitchYaw(0.1, 0.0, 0.0), [0, 0, 0])
        plant.RegisterCollisionGeometry(world, slope, HalfSpace(), "ground", surface(0.6, 2e5, 0.02, 1.0))
        step = RigidTransform(RollPitchYaw(0.1, 0.3, 0.2), [0.3, 0.1, 0.02])
        plant.RegisterCollisionGeometry(world, step, Box(0.3, 0.2, 0.2), "box", surface(0.5, 1e5, 0.02, 1.0))
        for number in range(2):
            ball = plant.AddRigidBody(f"ball_{number}", inertia(0.5, 0.01, (0.001, 0.0012, 0.0011)))
            offset = RigidTransform([0.01, 0, 0])
            plant.RegisterCollisionGeometry(ball, offset, Sphere(0.08), f"ball_{number}", surface(0.4, 5e4, 0.03, 0.5))
    elif terrain:
        _add_terrain(plant)
    else:
        plant.RegisterCollisionGeometry(world, RigidTransform(), HalfSpace(), "ground", surface(0.8))
    plant.SetDefaultFloatingBaseBodyPose(trunk, RigidTransform([0, 0, HEIGHT]))
    plant.Finalize()
    if not playground:
        scene_graph.collision_filter_manager().Apply(CollisionFilterDeclaration().ExcludeWithin(feet))
    if contact_period is not None:
        shanks = [plant.GetBodyByName(f"knee_{number}_link") for number in range(len(LEGS))]
        switches = builder.AddNamedSystem("switches", ContactSensor(plant, shanks, period=contact_period))
        builder.Connect(plant.get_contact_results_output_port(), switches.get_input_port())
    if drives:
        angles = [
            POSTURE[plant.get_joint_actuator(i).name().partition("_")[0]] for i in plant.GetJointActuatorIndices()
        ]
        desired = builder.AddNamedSystem("desired", ConstantVectorSource([*angles, *[0.1] * len(angles)]))
        builder.Connect(desired.get_output_port(), plant.GetInputPort("DefaultModelInstance_desired_state"))
        law = builder.AddNamedSystem("feed_forward", ConstantVectorSource(np.linspace(-1.0, 1.0, len(angles))))
    else:
        law = builder.AddSystem(_joint_pd(plant, stiffness=STIFFNESS, damping=DAMPING, period=time_step))
        builder.Connect(plant.get_state_output_port(), law.get_input_port())
    builder.Connect(law.get_output_port(), plant.get_actuation_input_port())
    return builder.Build(), plant


def _add_terrain(plant: MultibodyPlant) -> None:
    """Add eight convex pieces to the world, whose upper sides are triangles between heights of at most 3 cm."""
    random = np.random.default_rng(5)
    heights = random.uniform(-0.03, 0.0, (3, 3))
    for i in range(2):
        for j in range(2):
            corners = np.array(
                [[0.4 * (i + a - 1), 0.4 * (j + b - 1), heights[i + a, j + b]] for a in (0, 1) for b in (0, 1)]
            )
            for k, triangle in enumerate(([0, 1, 3], [0, 3, 2])):
                top = corners[triangle]
                points = np.vstack([top, top * [1.0, 1.0, 0.0] - [0.0, 0.0, 0.3]])
                piece = Convex(points=points.T, label=f"piece_{i}_{j}_{k}")
                material = surface(0.8, 1e5, 0.02, 0.5)
                plant.RegisterCollisionGeometry(
                    plant.world_body(), RigidTransform(), piece, f"ground_{i}_{j}_{k}", material
                )


def _leg(
    plant: MultibodyPlant, trunk: RigidBody, name: str, front: int, left: int, *, stops: bool, drives: bool
) -> RigidBody:
    """Add a leg; return its shank, at whose end, 0.2 m below the knee, is the foot."""
    parts = (
        ("hip", [0.18 * front, 0.05 * left, 0.0], [1, 0, 0], inertia(0.7, 0.0, (0.0005,) * 3)),
        ("thigh", [0.0, 0.09 * left, 0.0], [0, 1, 0], inertia(1.0, -0.1, (0.005, 0.005, 0.001))),
        ("knee", [0.0, 0.0, -0.2], [0, 1, 0], inertia(0.15, -0.1, (0.002, 0.002, 0.0001))),
    )
    parent = trunk
    for kind, place, axis, mass in parts:
        body = plant.AddRigidBody(f"{kind}_{name}_link", mass)
        frame = plant.AddFrame(
            FixedOffsetFrame(f"{kind}_{name}_frame", parent.body_frame(), RigidTransform(np.array(place, dtype=float)))
        )
        joint = plant.AddJoint(RevoluteJoint(f"{kind}_{name}", frame, body.body_frame(), axis, 0.1))
        joint.set_default_angle(POSTURE[kind])
        if stops:
            joint.set_position_limits([POSTURE[kind] - 0.4], [POSTURE[kind] + 0.5])
        actuator = plant.AddJointActuator(f"{kind}_{name}", joint, EFFORT_LIMIT if drives else np.inf)
        actuator.set_default_rotor_inertia(0.01)
        if drives:
            # The thighs have gains that the step does not resolve.
            stiffness, damping = (1e5, 1e3) if kind == "thigh" else (STIFFNESS, DAMPING)
            actuator.set_controller_gains(PdControllerGains(p=stiffness, d=damping))
        parent = body
    return parent


def _joint_pd(plant: MultibodyPlant, *, stiffness: float, damping: float, period: float) -> AffineSystem:
    """Return the law from the state to the actuation that holds the default posture."""
    nq, nv, nu = plant.num_positions(), plant.num_velocities(), plant.num_actuators()
    gains = np.zeros((nu, nq + nv))
    for row, index in enumerate(plant.GetJointActuatorIndices()):
        joint = plant.get_joint_actuator(index).joint()
        gains[row, joint.position_start()] = -stiffness
        gains[row, nq + joint.velocity_start()] = -damping
    nothing, none = np.zeros((0, nq + nv)), np.zeros((nu, 0))
    posture = -gains[:, :nq] @ plant.GetDefaultPositions()
    law = AffineSystem(A=np.zeros((0, 0)), B=nothing, f0=np.zeros(0), C=none, D=gains, y0=posture, time_period=period)
    law.set_name("law")
    return law
