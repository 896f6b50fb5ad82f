"""Plants of different topology, without contact."""

from __future__ import annotations

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import FixedOffsetFrame, PrismaticJoint, RevoluteJoint, SpatialInertia, UnitInertia
from pydrake.systems.analysis import Simulator

from vtbdrake_diagrams.manipulator.arm import Arm
from vtbdrake_diagrams.manipulator.world import add_arm
from vtbdrake_diagrams.space_climber.model import CLIMBER_SDF, PAYLOAD_SDF


def inertia(mass: float, com=(0.1, 0.2, -0.1)) -> SpatialInertia:
    com = np.array(com)
    return SpatialInertia(mass, com, UnitInertia.SolidBox(0.3, 0.4, 0.5).ShiftFromCenterOfMass(com))


def cart_pole(time_step: float, *, stop: float = np.inf) -> MultibodyPlant:
    plant = MultibodyPlant(time_step)
    cart = plant.AddRigidBody("cart", inertia(1.0, (0, 0, 0)))
    pole = plant.AddRigidBody("pole", inertia(0.2, (0, 0, -0.5)))
    slider = PrismaticJoint("slider", plant.world_frame(), cart.body_frame(), [1, 0, 0], -stop, stop, 0.1)
    plant.AddJointActuator("motor", plant.AddJoint(slider), effort_limit=20.0)
    plant.AddJoint(RevoluteJoint("hinge", cart.body_frame(), pole.body_frame(), [0, 1, 0], damping=0.02))
    plant.Finalize()
    return plant


def acrobot(time_step: float) -> MultibodyPlant:
    plant = MultibodyPlant(time_step)
    Parser(plant).AddModelsFromUrl("package://drake/examples/acrobot/Acrobot.urdf")
    plant.Finalize()
    return plant


def arm(time_step: float) -> MultibodyPlant:
    plant = MultibodyPlant(time_step)
    add_arm(plant, Arm())
    plant.Finalize()
    return plant


def floating(time_step: float, *, gravity: bool = True, damping: float = 0.1) -> MultibodyPlant:
    """A floating body with a hinge on an inclined frame, and a slider whose joint begins at its far end."""
    plant = MultibodyPlant(time_step)
    torso, arm, tool = (plant.AddRigidBody(n, inertia(m)) for n, m in (("torso", 3.0), ("arm", 1.0), ("tool", 0.5)))
    X_BF = RigidTransform(RollPitchYaw(0.1, 0.2, 0.3), [0.4, 0.1, 0.2])
    mount = plant.AddFrame(FixedOffsetFrame("mount", torso.body_frame(), X_BF))
    hinge = plant.AddJoint(RevoluteJoint("hinge", mount, arm.body_frame(), [0.6, 0.0, 0.8], damping=damping))
    motor = plant.AddJointActuator("motor", hinge)
    motor.set_default_rotor_inertia(1e-3)
    motor.set_default_gear_ratio(20.0)
    plant.AddJoint(PrismaticJoint("slider", tool.body_frame(), arm.body_frame(), [0, 1, 0], damping=2 * damping))
    if not gravity:
        plant.mutable_gravity_field().set_gravity_vector([0, 0, 0])
    plant.Finalize()
    return plant


def climber(time_step: float) -> MultibodyPlant:
    """The walking robot in free fall, its payload welded on."""
    plant = MultibodyPlant(time_step)
    (robot,) = Parser(plant).AddModels(str(CLIMBER_SDF))
    (payload,) = Parser(plant).AddModels(str(PAYLOAD_SDF))
    plant.WeldFrames(plant.GetFrameByName("attachment", robot), plant.GetBodyByName("payload", payload).body_frame())
    plant.Finalize()
    return plant


def random_plant(time_step: float, seed: int) -> MultibodyPlant:
    """A tree of five links with random joints, frames, motors, effort limits and rotors; it floats for odd seeds."""
    random = np.random.default_rng(seed)
    plant = MultibodyPlant(time_step)
    bodies = [plant.world_body()]
    if seed % 2:
        bodies = [plant.AddRigidBody("base", inertia(random.uniform(1.0, 5.0), random.uniform(-0.2, 0.2, 3)))]
    for k in range(5):
        parent = bodies[random.integers(len(bodies))]
        body = plant.AddRigidBody(f"link_{k}", inertia(random.uniform(0.2, 2.0), random.uniform(-0.2, 0.2, 3)))
        frames = [
            plant.AddFrame(FixedOffsetFrame(f"{side}_{k}", of.body_frame(), _random_pose(random)))
            for side, of in (("inner", parent), ("outer", body))
        ]
        kind = RevoluteJoint if random.random() < 0.7 else PrismaticJoint
        joint = plant.AddJoint(kind(f"joint_{k}", *frames, _direction(random), damping=random.choice([0.0, 0.3])))
        if random.random() < 0.7:
            motor = plant.AddJointActuator(f"motor_{k}", joint, random.choice([0.5, np.inf]))
            motor.set_default_rotor_inertia(random.choice([0.0, 1e-3]))
            motor.set_default_gear_ratio(random.uniform(1.0, 30.0))
        bodies.append(body)
    plant.Finalize()
    return plant


def _random_pose(random: np.random.Generator) -> RigidTransform:
    return RigidTransform(RollPitchYaw(random.uniform(-1.5, 1.5, 3)), random.uniform(-0.3, 0.3, 3))


def _direction(random: np.random.Generator) -> np.ndarray:
    axis = random.normal(size=3)
    return axis / np.linalg.norm(axis)


PLANTS = [cart_pole, acrobot, arm, floating, climber]


def states(plant: MultibodyPlant, count: int = 5):
    """Yield random states and actuations."""
    random = np.random.default_rng(3)
    for _ in range(count):
        yield random.normal(size=plant.num_multibody_states()), random.normal(size=plant.num_actuated_dofs())


def simulate(plant: MultibodyPlant, context, u: np.ndarray, steps: int) -> np.ndarray:
    """The state after each step of Drake, from the state of a context, which stays as it is, shape (steps, nx)."""
    simulator = Simulator(plant, context.Clone())
    own = simulator.get_mutable_context()
    found = []
    for k in range(steps):
        plant.get_actuation_input_port().FixValue(own, u[k])
        simulator.AdvanceTo((k + 1) * plant.time_step())
        found.append(plant.GetPositionsAndVelocities(own))
    return np.array(found)
