"""The double pendulum testbed: two links that hang from two motors."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from pydrake.geometry import Cylinder
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlantConfig
from pydrake.multibody.tree import FixedOffsetFrame, RevoluteJoint, RotationalInertia, SpatialInertia
from pydrake.systems.framework import Diagram, DiagramBuilder
from pydrake.systems.primitives import PassThrough, ZeroOrderHold

from vtbdrake.components.actuators import JointDrives
from vtbdrake.components.sensors import ErrorModel, JointEncoders
from vtbdrake.settings import setting
from vtbdrake.testbed import Interface, Scenario, ScenarioError, Signal, VirtualTestbedBuilder

if TYPE_CHECKING:
    from pydrake.multibody.plant import MultibodyPlant

JOINTS, LINKS = ("shoulder", "elbow"), ("upper", "lower")
GEAR_RATIO = 6.0
_BLUE = np.array([0.2, 0.4, 0.7, 1.0])


def _continuous() -> MultibodyPlantConfig:
    return MultibodyPlantConfig(time_step=0.0)


@dataclass
class DoublePendulumScenario(Scenario):
    """Two links on two motors, with the lengths of the design C.1 of DFKI's open double pendulum.

    F. Wiebe et al., "Open Source Dual-Purpose Acrobot and Pendubot Platform", IEEE Robotics and Automation Magazine 31
    (2024), tell lengths and gear ratio. All other numbers are guesses, to be calibrated: see `reality`.
    """

    plant_config: MultibodyPlantConfig = field(default_factory=_continuous)
    period: float = setting(0.002, "The sample period of sensors, DPS and drives.", unit="s", gt=0)
    torque_limit: float = setting(10.0, "The largest torque of a motor.", unit="N m", gt=0)
    upper_length: float = setting(0.2, "From the shoulder to the elbow.", unit="m", gt=0)
    masses: list[float] = setting(doc="Masses of the links.", unit="kg", gt=0, default_factory=lambda: [0.6, 0.6])
    centers: list[float] = setting(
        doc="From the joint to the link's centre of mass.", unit="m", ge=0, default_factory=lambda: [0.15, 0.2]
    )
    moments: list[float] = setting(
        doc="Moments about the centre of mass.", unit="kg m^2", gt=0, default_factory=lambda: [0.01, 0.01]
    )
    rotor_inertia: float = setting(5e-5, "Of each motor, before its gear.", unit="kg m^2", ge=0)
    viscous: float = setting(1e-3, "Viscous friction of each drive.", unit="N m s/rad", ge=0)
    coulomb: float = setting(0.1, "Coulomb friction of each drive.", unit="N m", ge=0)
    errors: ErrorModel = field(default_factory=ErrorModel)

    def validate(self) -> None:
        super().validate()
        for name in ("masses", "centers", "moments"):
            if len(getattr(self, name)) != len(LINKS):
                raise ScenarioError(
                    f"DoublePendulumScenario.{name} has one value per link, two, not {getattr(self, name)}"
                )

    def interface(self) -> Interface:
        limit = self.torque_limit
        torque = {"size": 2, "unit": "N m", "lower": -limit, "upper": limit}
        return Interface(
            sense=[Signal("joint_position", size=2, unit="rad", lower=-100.0, upper=100.0, max_age=5 * self.period)],
            act=[Signal("torque", idle=0.0, **torque)],
            commands=[Signal("torques", **torque)],
        )

    def make_dps(self) -> Diagram:
        """Return a DPS that commands the torques that the command u asks for."""
        builder = DiagramBuilder()
        sense = builder.AddNamedSystem("sense", PassThrough(2))
        impl = builder.AddNamedSystem("impl", ZeroOrderHold(self.period, 2))
        builder.ExportInput(sense.get_input_port(), "joint_position")
        builder.ExportInput(impl.get_input_port(), "torques")
        builder.ExportOutput(impl.get_output_port(), "torque")
        return builder.Build()

    def add_world(self, builder: VirtualTestbedBuilder) -> None:
        plant, _ = builder.add_plant(self.plant_config)
        joints = self._add_links(plant)
        plant.Finalize()
        encoders = JointEncoders(plant, joints, period=self.period, errors=self.errors)
        builder.add_sensor("joint_position", encoders)
        drives = JointDrives(
            plant, joints, period=self.period, limit=self.torque_limit, viscous=self.viscous, coulomb=self.coulomb,
            coulomb_velocity=0.02,
        )  # fmt: skip
        builder.add("act", "drives", drives)
        builder.connect(plant.get_state_output_port(), drives.GetInputPort("state"))
        builder.connect(drives.get_output_port(), plant.get_actuation_input_port())
        builder.sim_actuator("torque", drives.GetInputPort("command"))

    def _add_links(self, plant: MultibodyPlant) -> list[RevoluteJoint]:
        """Add links and motors; both links hang down at the angles 0, and turn about y."""
        instance = plant.AddModelInstance("pendulum")
        parent, place = plant.world_body(), RigidTransform()
        joints = []
        for name, link, mass, center, moment in zip(
            JOINTS, LINKS, self.masses, self.centers, self.moments, strict=True
        ):
            rotational = RotationalInertia(moment, moment, moment)
            inertia = SpatialInertia.MakeFromCentralInertia(mass, [0.0, 0.0, -center], rotational)
            body = plant.AddRigidBody(link, instance, inertia)
            mount = plant.AddFrame(FixedOffsetFrame(f"{name}_mount", parent.body_frame(), place, instance))
            joint = plant.AddJoint(RevoluteJoint(name, mount, body.body_frame(), [0.0, 1.0, 0.0]))
            rod = Cylinder(0.012, self.upper_length)
            plant.RegisterVisualGeometry(body, RigidTransform([0.0, 0.0, -0.5 * rod.length()]), rod, link, _BLUE)
            motor = plant.AddJointActuator(name, joint, self.torque_limit)
            motor.set_default_rotor_inertia(self.rotor_inertia)
            motor.set_default_gear_ratio(GEAR_RATIO)
            joints.append(joint)
            parent, place = body, RigidTransform([0.0, 0.0, -self.upper_length])
        return joints
