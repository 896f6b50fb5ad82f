"""Small scenarios whose motion is known, and a simulation of one, read by name."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import casadi
import numpy as np
from numpy.typing import ArrayLike
from pydrake.geometry import (
    AddCompliantHydroelasticProperties,
    AddContactMaterial,
    AddRigidHydroelasticProperties,
    Box,
    HalfSpace,
    ProximityProperties,
    Sphere,
)
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.multibody.plant import CoulombFriction, MultibodyPlant, MultibodyPlantConfig
from pydrake.multibody.tree import (
    FixedOffsetFrame,
    ModelInstanceIndex,
    PdControllerGains,
    PrismaticJoint,
    PrismaticSpring,
    RevoluteJoint,
    RigidBody,
    RotationalInertia,
    SpatialInertia,
    UnitInertia,
    UniversalJoint,
)
from pydrake.systems.analysis import SimulatorConfig
from pydrake.systems.framework import DiagramBuilder, System
from pydrake.systems.primitives import ConstantVectorSource, PassThrough

from vtbdrake.components.actuators import JointDrives
from vtbdrake.components.casadi_system import CasadiSystem
from vtbdrake.components.sensors import ErrorModel, Imu, JointEncoders, JointTachometers
from vtbdrake.testbed import Interface, Scenario, Signal, VirtualTestbedBuilder
from vtbdrake_diagrams.manipulator.arm import Arm
from vtbdrake_diagrams.manipulator.world import add_arm
from vtbdrake_diagrams.satellite.plant import add_servicer

G = 9.81
MODEL = "sim.sys.model."


def continuous() -> MultibodyPlantConfig:
    """Return a continuous plant with point contact."""
    return MultibodyPlantConfig(time_step=0.0, contact_model="point")


def discrete(time_step: float, approximation: str = "sap", **values: object) -> MultibodyPlantConfig:
    """Return a discrete plant with point contact, whose outputs belong to its present state."""
    settings = {"contact_model": "point", **values}
    return MultibodyPlantConfig(
        time_step=time_step,
        discrete_contact_approximation=approximation,
        use_sampled_output_ports=False,
        **settings,
    )


def scheme(name: str, *, accuracy: float = 1e-4, max_step_size: float = 0.1, fixed: bool = False) -> SimulatorConfig:
    """Return the config of an integrator; ``fixed`` takes steps of ``max_step_size``."""
    return SimulatorConfig(
        integration_scheme=name, accuracy=accuracy, max_step_size=max_step_size, use_error_control=not fixed
    )


def precise(step: float = 2.5e-3) -> SimulatorConfig:
    """Return an integrator of order 5 with fixed steps so small that its error is of rounding, up to 1e-11."""
    return scheme("runge_kutta5", max_step_size=step, fixed=True)


@dataclass
class World(Scenario):
    """Bodies in a model instance ``model``. Its DPS passes the command ``u.force`` on, if the world has actuators."""

    simulator_config: SimulatorConfig = field(default_factory=precise)
    plant_config: MultibodyPlantConfig = field(default_factory=continuous)
    is_compiled: bool = False
    # Number of generalized forces that the DPS commands; 0: there are none.
    forces: ClassVar[int] = 0

    @abstractmethod
    def add_bodies(self, plant: MultibodyPlant, instance: ModelInstanceIndex) -> None:
        """Add the bodies to a plant whose gravity is G."""

    def interface(self) -> Interface:
        n = self.forces
        if not n:
            return Interface(sense=[], act=[])
        return Interface(
            sense=[], act=[Signal("force", size=n, idle=0.0)], commands=[Signal("force", size=n, default=0.0)]
        )

    def make_dps(self) -> System:
        if not self.forces:
            return ConstantVectorSource([0.0])
        builder = DiagramBuilder()
        law = builder.AddNamedSystem("law", PassThrough(self.forces))
        builder.ExportInput(law.get_input_port(), "force")
        builder.ExportOutput(law.get_output_port(), "force")
        return builder.Build()

    def add_world(self, builder: VirtualTestbedBuilder) -> None:
        plant, _ = builder.add_plant(self.plant_config)
        plant.mutable_gravity_field().set_gravity_vector([0.0, 0.0, -G])
        self.add_bodies(plant, plant.AddModelInstance("model"))
        plant.Finalize()
        if self.forces:
            builder.sim_actuator("force", plant.get_applied_generalized_force_input_port())


class Run:
    """A simulation of a world from a start.

    Attributes:
        testbed: The testbed of the scenario.
        context: Its state, which advances.
    """

    def __init__(self, scenario: Scenario, start: Mapping[str, ArrayLike]) -> None:
        """Build the world and set the variables of its model; ``u.`` begins the address of a command."""
        self.testbed = scenario.build()
        self.context = self.testbed.default_context()
        addresses = {name if name.startswith("u.") else MODEL + name: value for name, value in start.items()}
        self.testbed.write(self.context, addresses)
        self._simulator = self.testbed.simulator(self.context)
        self._is_compiled = getattr(scenario, "is_compiled", False)

    def to(self, time: float) -> Run:
        """Simulate up to ``time``; a compiled world in one rollout."""
        begin = self.context.get_time()
        if time > begin and self._is_compiled:
            span = time - begin
            rollouts = self.testbed.compiled(horizon=span, sample_period=span, context=self.context, check=False)
            batch = rollouts.from_z(rollouts.walker.read(self.context)[np.newaxis], begin)
            assert batch.valid.all()
            rollouts.walker.write(batch.final[0], self.context)
            self.context.SetTime(time)
        elif time > begin:
            self._simulator.AdvanceTo(time)
        return self

    def __getitem__(self, name: str) -> np.ndarray:
        return np.asarray(self.testbed.read(self.context, MODEL + name))

    def derivative(self, name: str) -> float:
        """Return the time derivative of the velocity of a joint with one degree of freedom."""
        plant = self.testbed.plant
        joint = plant.GetJointByName(name)
        context = plant.GetMyContextFromRoot(self.context)
        return float(plant.EvalTimeDerivatives(context).CopyToVector()[plant.num_positions() + joint.velocity_start()])

    def pose(self, body: str) -> RigidTransform:
        """Return X_WB."""
        plant = self.testbed.plant
        return plant.GetBodyByName(body).EvalPoseInWorld(plant.GetMyContextFromRoot(self.context))

    def velocity(self, body: str) -> np.ndarray:
        """Return the velocity of the origin of a body, v_WB."""
        return self._spatial_velocity(body).translational()

    def angular_velocity(self, body: str) -> np.ndarray:
        """Return w_WB."""
        return self._spatial_velocity(body).rotational()

    def _spatial_velocity(self, body: str):
        plant = self.testbed.plant
        return plant.GetBodyByName(body).EvalSpatialVelocityInWorld(plant.GetMyContextFromRoot(self.context))


def point_mass(mass: float, position: Sequence[float]) -> SpatialInertia:
    """Return the inertia of a point at ``position`` about the origin of its body."""
    return SpatialInertia(mass, np.array(position), UnitInertia.PointMass(np.array(position)))


def material(
    friction: float, stiffness: float, dissipation: float = 50.0, relaxation: float = 1e-3
) -> ProximityProperties:
    """Return a material in point contact, with its dissipation (s/m) and, for SAP, its relaxation time (s)."""
    properties = ProximityProperties()
    AddContactMaterial(dissipation, stiffness, CoulombFriction(friction, friction), properties)
    properties.AddProperty("material", "relaxation_time", relaxation)
    return properties


def add_hinge(
    plant: MultibodyPlant, name: str, parent: RigidBody, X_PF: RigidTransform, child: RigidBody, axis
) -> None:
    """Add a hinge between the frame F on ``parent`` and the origin of ``child``."""
    frame = plant.AddFrame(FixedOffsetFrame(f"{name}_frame", parent.body_frame(), X_PF))
    plant.AddJoint(RevoluteJoint(name, frame, child.body_frame(), axis))


# -- without contact


@dataclass
class Pendulum(World):
    """A point mass of 1 kg on a rod of 1 m, on a hinge about y; it hangs at the angle 0."""

    length: float = 1.0
    damping: float = 0.0

    def add_bodies(self, plant: MultibodyPlant, instance: ModelInstanceIndex) -> None:
        rod = plant.AddRigidBody("rod", instance, point_mass(1.0, [0.0, 0.0, -self.length]))
        plant.AddJoint(RevoluteJoint("hinge", plant.world_frame(), rod.body_frame(), [0, 1, 0], damping=self.damping))


@dataclass
class DoublePendulum(World):
    """Two rods of 1 m with point masses of 1 kg at their ends; both hang at the angles 0."""

    def add_bodies(self, plant: MultibodyPlant, instance: ModelInstanceIndex) -> None:
        upper, lower = (plant.AddRigidBody(name, instance, point_mass(1.0, [0, 0, -1])) for name in ("upper", "lower"))
        plant.AddJoint(RevoluteJoint("shoulder", plant.world_frame(), upper.body_frame(), [0, 1, 0]))
        X_UE = RigidTransform([0.0, 0.0, -1.0])
        add_hinge(plant, "elbow", upper, X_UE, lower, [0, 1, 0])


@dataclass
class ConicalPendulum(World):
    """A point mass of 1 kg on a rod of 1 m, on a universal joint."""

    def add_bodies(self, plant: MultibodyPlant, instance: ModelInstanceIndex) -> None:
        rod = plant.AddRigidBody("rod", instance, point_mass(1.0, [0.0, 0.0, -1.0]))
        plant.AddJoint(UniversalJoint("hinge", plant.world_frame(), rod.body_frame()))


@dataclass
class Slider(World):
    """A slider of 1 kg with damping, without gravity: v' = -damping v."""

    damping: float = 1.0

    def add_bodies(self, plant: MultibodyPlant, instance: ModelInstanceIndex) -> None:
        plant.mutable_gravity_field().set_gravity_vector([0, 0, 0])
        body = plant.AddRigidBody("body", instance, SpatialInertia.SolidSphereWithMass(1.0, 0.1))
        plant.AddJoint(
            PrismaticJoint("slider", plant.world_frame(), body.body_frame(), [1, 0, 0], damping=self.damping)
        )


@dataclass
class FreeBody(World):
    """A body of 1 kg in free fall, with principal inertias ``moments`` in kg m^2."""

    moments: list[float] = field(default_factory=lambda: [1.0, 2.0, 3.0])

    def add_bodies(self, plant: MultibodyPlant, instance: ModelInstanceIndex) -> None:
        # The inertias of a verification may violate the triangle inequality.
        inertia = SpatialInertia(1.0, np.zeros(3), UnitInertia(*self.moments), skip_validity_check=True)
        plant.AddRigidBody("body", instance, inertia)


def body_rates(run: Run) -> np.ndarray:
    """Return the angular velocity of the free body in its own axes."""
    return run.pose("body").rotation().matrix().T @ run.angular_velocity("body")


@dataclass
class FourBar(World):
    """A crank on the left, a rocker on the right and a coupler between them, closed by a ball constraint.

    The hinges on the ground are at x = 0 and x = ``ground``; links are thin rods of 1 kg per metre. The crank is at its
    angle from the world's x; the rocker, too; the angle of the coupler is relative to the crank.
    """

    plant_config: MultibodyPlantConfig = field(default_factory=lambda: discrete(1e-3))
    ground: float = 1.0
    crank: float = 0.4
    coupler: float = 1.0
    rocker: float = 0.8

    def add_bodies(self, plant: MultibodyPlant, instance: ModelInstanceIndex) -> None:
        links = {}
        for name in ("crank", "coupler", "rocker"):
            length = getattr(self, name)
            centred = SpatialInertia(length, np.zeros(3), UnitInertia.ThinRod(length, [1, 0, 0]))
            links[name] = plant.AddRigidBody(name, instance, centred.Shift([-length / 2, 0, 0]))
        world, y = plant.world_body(), [0, -1, 0]  # Positive angles lift the end of a link.
        end_of_crank, end_of_coupler, end_of_rocker = (
            RigidTransform([length, 0, 0]) for length in (self.crank, self.coupler, self.rocker)
        )
        add_hinge(plant, "left", world, RigidTransform(), links["crank"], y)
        add_hinge(plant, "middle", links["crank"], end_of_crank, links["coupler"], y)
        add_hinge(plant, "right", world, RigidTransform([self.ground, 0, 0]), links["rocker"], y)
        plant.AddBallConstraint(
            links["coupler"], end_of_coupler.translation(), links["rocker"], end_of_rocker.translation()
        )

    def closed(self, angle: float) -> tuple[float, float]:
        """Return the absolute angles of coupler and rocker at an angle of the crank, by the law of cosines."""
        p = self.crank * np.array([np.cos(angle), np.sin(angle)])
        d = np.array([self.ground, 0.0]) - p
        span = np.linalg.norm(d)
        bend = np.arccos((self.coupler**2 + span**2 - self.rocker**2) / (2 * self.coupler * span))
        coupler = np.arctan2(d[1], d[0]) + bend
        end = p + self.coupler * np.array([np.cos(coupler), np.sin(coupler)]) - [self.ground, 0.0]
        return float(coupler), float(np.arctan2(end[1], end[0]))


IIWA = (
    # Mass, centre of mass, moments of inertia about it; roll, pitch, yaw and position of the joint in the link before.
    (5.76, (0, -0.03, 0.12), (0.033, 0.0333, 0.0123), (0, 0, 0), (0, 0, 0.1575)),
    (6.35, (0.0003, 0.059, 0.042), (0.0305, 0.0304, 0.011), (np.pi / 2, 0, np.pi), (0, 0, 0.2025)),
    (3.5, (0, 0.03, 0.13), (0.025, 0.0238, 0.0076), (np.pi / 2, 0, np.pi), (0, 0.2045, 0)),
    (3.5, (0, 0.067, 0.034), (0.017, 0.0164, 0.006), (np.pi / 2, 0, 0), (0, 0, 0.2155)),
    (3.5, (0.0001, 0.021, 0.076), (0.01, 0.0087, 0.00449), (-np.pi / 2, np.pi, 0), (0, 0.1845, 0)),
    (1.8, (0, 0.0006, 0.0004), (0.0049, 0.0047, 0.0036), (np.pi / 2, 0, 0), (0, 0, 0.2155)),
    (1.2, (0, 0, 0.02), (0.001, 0.001, 0.001), (-np.pi / 2, np.pi, 0), (0, 0.081, 0)),
)
"""The arm of Drake's benchmark `kuka_iiwa_robot`, which MotionGenesis has solved."""


@dataclass
class Iiwa(World):
    """The arm of `IIWA`, in its gravity of 9.8 m/s^2."""

    forces: ClassVar[int] = 7

    def add_bodies(self, plant: MultibodyPlant, instance: ModelInstanceIndex) -> None:
        plant.mutable_gravity_field().set_gravity_vector([0, 0, -9.8])
        parent = plant.world_body()
        for k, (mass, com, moments, rpy, offset) in enumerate(IIWA, 1):
            inertia = SpatialInertia.MakeFromCentralInertia(mass, np.array(com), RotationalInertia(*moments))
            link = plant.AddRigidBody(f"link_{k}", instance, inertia)
            X_PF = RigidTransform(RollPitchYaw(rpy), offset)
            add_hinge(plant, f"joint_{k}", parent, X_PF, link, [0, 0, 1])
            parent = link


@dataclass
class FreeServicer(World):
    """The servicer of the satellite testbed, without servos: it floats, with seven joints and two fingers."""

    forces: ClassVar[int] = 15

    def add_bodies(self, plant: MultibodyPlant, instance: ModelInstanceIndex) -> None:
        add_servicer(plant, servos=False)


@dataclass
class FallingArm(World):
    """The arm of the manipulator testbed, without drives."""

    def add_bodies(self, plant: MultibodyPlant, instance: ModelInstanceIndex) -> None:
        add_arm(plant, Arm())


# -- with sensors


def _sink(size: int, signal: str) -> System:
    """Return a DPS that reads a signal and commands nothing."""
    builder = DiagramBuilder()
    sink = builder.AddNamedSystem("sink", PassThrough(size))
    builder.ExportInput(sink.get_input_port(), signal)
    return builder.Build()


@dataclass
class ImuWorld(World):
    """An IMU on a ball of 1 kg; away from its centre on a hinge about y, or in its centre in free fall."""

    hinged: bool = True
    period: float = 0.01

    def mount(self) -> RigidTransform:
        """Return X_BF, the pose of the IMU in the ball."""
        return RigidTransform(RollPitchYaw(0.3, -0.5, 0.9), [0.1, -0.2, 0.3] if self.hinged else [0, 0, 0])

    def interface(self) -> Interface:
        return Interface(sense=[Signal("imu", size=6)], act=[])

    def make_dps(self) -> System:
        return _sink(6, "imu")

    def add_bodies(self, plant: MultibodyPlant, instance: ModelInstanceIndex) -> None:
        body = plant.AddRigidBody("body", instance, SpatialInertia.SolidSphereWithMass(1.0, 0.1))
        if self.hinged:
            add_hinge(plant, "hinge", plant.world_body(), RigidTransform(), body, [0, 1, 0])
        plant.AddFrame(FixedOffsetFrame("imu", body.body_frame(), self.mount()))

    def add_world(self, builder: VirtualTestbedBuilder) -> None:
        super().add_world(builder)
        builder.add_sensor("imu", Imu(builder.plant, builder.plant.GetFrameByName("imu"), period=self.period))


@dataclass
class Encoders(World):
    """64 hinges at rest, with encoders."""

    plant_config: MultibodyPlantConfig = field(default_factory=lambda: discrete(0.01))
    errors: ErrorModel = field(default_factory=ErrorModel)
    period: float = 0.01

    def interface(self) -> Interface:
        return Interface(sense=[Signal("encoders", size=64)], act=[])

    def make_dps(self) -> System:
        return _sink(64, "encoders")

    def add_bodies(self, plant: MultibodyPlant, instance: ModelInstanceIndex) -> None:
        for k in range(64):
            body = plant.AddRigidBody(f"ball_{k}", instance, SpatialInertia.SolidSphereWithMass(1.0, 0.1))
            add_hinge(plant, f"hinge_{k}", plant.world_body(), RigidTransform(), body, [0, 1, 0])

    def add_world(self, builder: VirtualTestbedBuilder) -> None:
        super().add_world(builder)
        joints = [builder.plant.GetJointByName(f"hinge_{k}") for k in range(64)]
        encoders = JointEncoders(builder.plant, joints, period=self.period, errors=self.errors)
        builder.add_sensor("encoders", encoders)


@dataclass
class Oscillator(World):
    """A slider of 1 kg on a spring of 100 N/m to the origin, whose drive has Coulomb friction of 2 N."""

    plant_config: MultibodyPlantConfig = field(default_factory=lambda: discrete(2e-4))
    coulomb: float = 2.0
    spring: float = 100.0

    forces: ClassVar[int] = 1

    def add_bodies(self, plant: MultibodyPlant, instance: ModelInstanceIndex) -> None:
        body = plant.AddRigidBody("body", instance, SpatialInertia.SolidSphereWithMass(1.0, 0.1))
        slider = plant.AddJoint(PrismaticJoint("slider", plant.world_frame(), body.body_frame(), [1, 0, 0]))
        plant.AddJointActuator("motor", slider)
        plant.AddForceElement(PrismaticSpring(slider, 0.0, self.spring))

    def add_world(self, builder: VirtualTestbedBuilder) -> None:
        add_driven_plant(self, builder, "slider", coulomb=self.coulomb, coulomb_velocity=1e-3)


@dataclass
class GearedWheel(World):
    """A wheel of 0.5 m behind a gear, with Coulomb friction in its drive."""

    plant_config: MultibodyPlantConfig = field(default_factory=lambda: discrete(1e-3))
    coulomb: float = 0.9
    gear: float = 100.0
    rotor: float = 2e-5
    wheel: float = 2.0

    forces: ClassVar[int] = 1

    def add_bodies(self, plant: MultibodyPlant, instance: ModelInstanceIndex) -> None:
        inertia = SpatialInertia.SolidCylinderWithMass(self.wheel, 0.5, 0.1, [0, 0, 1])
        wheel = plant.AddRigidBody("wheel", instance, inertia)
        add_hinge(plant, "axle", plant.world_body(), RigidTransform(), wheel, [0, 0, 1])
        motor = plant.AddJointActuator("motor", plant.GetJointByName("axle"))
        motor.set_default_gear_ratio(self.gear)
        motor.set_default_rotor_inertia(self.rotor)

    def add_world(self, builder: VirtualTestbedBuilder) -> None:
        add_driven_plant(self, builder, "axle", coulomb=self.coulomb, coulomb_velocity=0.01)


def add_driven_plant(world: World, builder: VirtualTestbedBuilder, joint: str, **drive: float) -> JointDrives:
    """Add the plant of a world whose force is the command of the drive of ``joint``."""
    plant, _ = builder.add_plant(world.plant_config)
    plant.mutable_gravity_field().set_gravity_vector([0.0, 0.0, -G])
    world.add_bodies(plant, plant.AddModelInstance("model"))
    plant.Finalize()
    period = world.plant_config.time_step or world.period
    drives = builder.add("act", "drive", JointDrives(plant, [plant.GetJointByName(joint)], period=period, **drive))
    builder.connect(plant.get_state_output_port(), drives.GetInputPort("state"))
    builder.connect(drives.get_output_port(), plant.get_actuation_input_port())
    builder.sim_actuator("force", drives.GetInputPort("command"))
    return drives


@dataclass
class Impedance(World):
    """A slider of 1 kg under the impedance law F = K (u.target - q) - D v, sampled with a period.

    Encoder, tachometer and drive are ideal, but sampled.
    """

    period: float = 1e-3
    stiffness: float = 4.0
    damping: float = 0.8

    def interface(self) -> Interface:
        return Interface(
            sense=[Signal("position", size=1), Signal("velocity", size=1)],
            act=[Signal("force", size=1, idle=0.0)],
            commands=[Signal("target", size=1, default=0.0)],
        )

    def make_dps(self) -> System:
        q, v, target = (casadi.SX.sym(name) for name in ("q", "v", "target"))
        force = self.stiffness * (target - q) - self.damping * v
        return CasadiSystem(
            casadi.Function("law", [q, v, target], [force], ["position", "velocity", "target"], ["force"])
        )

    def add_bodies(self, plant: MultibodyPlant, instance: ModelInstanceIndex) -> None:
        body = plant.AddRigidBody("body", instance, SpatialInertia.SolidSphereWithMass(1.0, 0.1))
        plant.AddJoint(PrismaticJoint("slider", plant.world_frame(), body.body_frame(), [1, 0, 0]))
        plant.AddJointActuator("motor", plant.GetJointByName("slider"))

    def add_world(self, builder: VirtualTestbedBuilder) -> None:
        add_driven_plant(self, builder, "slider")
        joints = [builder.plant.GetJointByName("slider")]
        builder.add_sensor("position", JointEncoders(builder.plant, joints, period=self.period))
        builder.add_sensor("velocity", JointTachometers(builder.plant, joints, period=self.period))


@dataclass
class Carts(World):
    """A cart of 2 kg that rolls freely, and on it a load of 1 kg that slides up to a stop 0.1 m ahead."""

    plant_config: MultibodyPlantConfig = field(default_factory=lambda: discrete(1e-3))

    def add_bodies(self, plant: MultibodyPlant, instance: ModelInstanceIndex) -> None:
        cart, load = (
            plant.AddRigidBody(name, instance, SpatialInertia.SolidSphereWithMass(mass, 0.1))
            for name, mass in (("cart", 2.0), ("load", 1.0))
        )
        plant.AddJoint(PrismaticJoint("cart_slider", plant.world_frame(), cart.body_frame(), [1, 0, 0]))
        stops = -np.inf, 0.1
        plant.AddJoint(PrismaticJoint("load_slider", cart.body_frame(), load.body_frame(), [1, 0, 0], *stops))


@dataclass
class Servo(World):
    """A slider of 1 kg whose actuator has a PD controller and an effort limit of 2 N; u.force is its desired state.

    It falls on a slope on which its weight pulls with ``pull``.
    """

    plant_config: MultibodyPlantConfig = field(default_factory=lambda: discrete(1e-3))
    stiffness: float = 100.0
    damping: float = 20.0
    pull: float = 0.0

    forces: ClassVar[int] = 2

    def add_bodies(self, plant: MultibodyPlant, instance: ModelInstanceIndex) -> None:
        plant.mutable_gravity_field().set_gravity_vector([self.pull, 0, 0])
        body = plant.AddRigidBody("body", instance, SpatialInertia.SolidSphereWithMass(1.0, 0.1))
        slider = plant.AddJoint(PrismaticJoint("slider", plant.world_frame(), body.body_frame(), [1, 0, 0]))
        motor = plant.AddJointActuator("motor", slider, 2.0)
        motor.set_controller_gains(PdControllerGains(p=self.stiffness, d=self.damping))

    def add_world(self, builder: VirtualTestbedBuilder) -> None:
        plant, _ = builder.add_plant(self.plant_config)
        instance = plant.AddModelInstance("model")
        self.add_bodies(plant, instance)
        plant.Finalize()
        builder.sim_actuator("force", plant.get_desired_state_input_port(instance))


# -- with contact

RIGID = 1e7
"""Stiffness of contacts that are to be rigid, in N/m."""


def _slope(plant: MultibodyPlant, angle: float, properties: ProximityProperties) -> None:
    """Add a half-space through the world's origin that falls towards x."""
    X_WG = RigidTransform(RotationMatrix.MakeYRotation(angle))
    plant.RegisterCollisionGeometry(plant.world_body(), X_WG, HalfSpace(), "ground", properties)


@dataclass
class Ball(World):
    """A ball on a slope; it starts where the contact carries its weight.

    Ball and ground are of different materials: in series their stiffness is ``stiffness``, and the harmonic mean of
    their friction coefficients is ``friction``.
    """

    plant_config: MultibodyPlantConfig = field(default_factory=lambda: discrete(1e-3))
    angle_deg: float = 0.0
    friction: float = 0.5
    mass: float = 1.0
    radius: float = 0.1
    inertia: float = 0.004
    stiffness: float = RIGID

    def add_bodies(self, plant: MultibodyPlant, instance: ModelInstanceIndex) -> None:
        gyration = self.inertia / self.mass
        ball = plant.AddRigidBody(
            "ball", instance, SpatialInertia(self.mass, np.zeros(3), UnitInertia(gyration, gyration, gyration))
        )
        # 1 / 3 + 1 / 1.5 = 1, and 2 / (1 / 1.5 + 1 / 0.75) = 1.
        of_ball = material(1.5 * self.friction, 3.0 * self.stiffness)
        of_ground = material(0.75 * self.friction, 1.5 * self.stiffness)
        plant.RegisterCollisionGeometry(ball, RigidTransform(), Sphere(self.radius), "ball", of_ball)
        _slope(plant, np.radians(self.angle_deg), of_ground)
        normal = RotationMatrix.MakeYRotation(np.radians(self.angle_deg)).col(2)
        sunk = self.mass * G * normal[2] / self.stiffness
        plant.SetDefaultFloatingBaseBodyPose(ball, RigidTransform((self.radius - sunk) * normal))


@dataclass
class Block(World):
    """A block of 1 kg, 0.2 x 0.2 x 0.1 m, on a slope; it starts where the contact carries its weight.

    In point contact it stands on four small feet, in hydroelastic contact on its face.
    """

    plant_config: MultibodyPlantConfig = field(default_factory=lambda: discrete(1e-3))
    angle_deg: float = 30.0
    friction: float = 0.5
    stiffness: float = RIGID

    forces: ClassVar[int] = 6

    def add_bodies(self, plant: MultibodyPlant, instance: ModelInstanceIndex) -> None:
        angle = np.radians(self.angle_deg)
        block = plant.AddRigidBody("block", instance, SpatialInertia.SolidBoxWithMass(1.0, 0.2, 0.2, 0.1))
        if self.plant_config.contact_model == "point":
            properties = material(self.friction, 2.0 * self.stiffness)
            for k, (x, y) in enumerate(((-0.1, -0.1), (-0.1, 0.1), (0.1, -0.1), (0.1, 0.1))):
                foot = RigidTransform([x, y, -0.04])
                plant.RegisterCollisionGeometry(block, foot, Sphere(0.01), f"foot_{k}", properties)
            sunk = G * np.cos(angle) / (4.0 * self.stiffness)
            _slope(plant, angle, properties)
        else:
            modulus, depth = 1e8, 0.05
            soft, hard = ProximityProperties(), ProximityProperties()
            AddCompliantHydroelasticProperties(0.05, modulus, soft)
            AddRigidHydroelasticProperties(hard)
            for properties in (soft, hard):
                AddContactMaterial(
                    dissipation=50.0, friction=CoulombFriction(self.friction, self.friction), properties=properties
                )
            plant.RegisterCollisionGeometry(block, RigidTransform(), Box(0.2, 0.2, 0.1), "face", soft)
            _slope(plant, angle, hard)
            # The pressure grows linearly from the face to the middle of the block, where it is the modulus.
            sunk = G * np.cos(angle) / (modulus / depth * 0.2**2)
        R_WG = RotationMatrix.MakeYRotation(angle)
        plant.SetDefaultFloatingBaseBodyPose(block, RigidTransform(R_WG, (0.05 - sunk) * R_WG.col(2)))


@dataclass
class RollingTest(World):
    """SimBenchmark's rolling test: a force pulls a box of 10 kg, on which 25 balls of 1 kg roll."""

    plant_config: MultibodyPlantConfig = field(default_factory=lambda: discrete(1e-3))
    stiffness: float = RIGID
    ground_friction: float = 0.4
    ball_friction: float = 0.8

    forces: ClassVar[int] = 6 * 26

    def add_bodies(self, plant: MultibodyPlant, instance: ModelInstanceIndex) -> None:
        box = plant.AddRigidBody("box", instance, SpatialInertia.SolidBoxWithMass(10.0, 8.0, 8.0, 1.0))
        below, above = (material(mu, 2.0 * self.stiffness) for mu in (self.ground_friction, self.ball_friction))
        _slope(plant, 0.0, below)
        for k, (x, y) in enumerate(((-4, -4), (-4, 4), (4, -4), (4, 4))):
            plant.RegisterCollisionGeometry(box, RigidTransform([x, y, -0.5]), Sphere(0.05), f"foot_{k}", below)
        plant.RegisterCollisionGeometry(box, RigidTransform(), Box(8.0, 8.0, 1.0), "box", above)
        lowered = 35.0 * G / (4.0 * self.stiffness)
        plant.SetDefaultFloatingBaseBodyPose(box, RigidTransform([0, 0, 0.55 - lowered]))
        for k in range(25):
            ball = plant.AddRigidBody(f"ball_{k}", instance, SpatialInertia.SolidSphereWithMass(1.0, 0.5))
            plant.RegisterCollisionGeometry(ball, RigidTransform(), Sphere(0.5), f"ball_{k}", above)
            x, y = 1.5 * (k % 5 - 2), 1.5 * (k // 5 - 2)
            z = 1.05 - lowered + 0.5 - G / self.stiffness
            plant.SetDefaultFloatingBaseBodyPose(ball, RigidTransform([x, y, z]))


@dataclass
class Bounce(World):
    """A ball of 1 kg on a vertical slider that meets a half-space, without gravity."""

    stiffness: float = 1e4
    dissipation: float = 0.0
    relaxation: float = 0.0

    def add_bodies(self, plant: MultibodyPlant, instance: ModelInstanceIndex) -> None:
        plant.mutable_gravity_field().set_gravity_vector([0, 0, 0])
        ball = plant.AddRigidBody("ball", instance, SpatialInertia.SolidSphereWithMass(1.0, 0.1))
        plant.AddJoint(PrismaticJoint("slider", plant.world_frame(), ball.body_frame(), [0, 0, 1]))
        # The dissipation of a contact is the mean of both, weighted by the other's stiffness; relaxation times add up.
        properties = material(0.0, 2.0 * self.stiffness, self.dissipation, self.relaxation / 2.0)
        plant.RegisterCollisionGeometry(ball, RigidTransform(), Sphere(0.1), "ball", properties)
        _slope(plant, 0.0, properties)
