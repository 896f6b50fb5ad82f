"""The double pendulum testbed: two links that hang from two motors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from pydrake.geometry import Cylinder
from pydrake.math import RigidTransform
from pydrake.multibody.tree import FixedOffsetFrame, RevoluteJoint, RotationalInertia, SpatialInertia

from vtbdrake.common.settings import setting
from vtbdrake.testbed import ScenarioError
from vtbdrake_diagrams.torque_driven import TorqueDrivenScenario

if TYPE_CHECKING:
    from pydrake.multibody.plant import MultibodyPlant

JOINTS = ("shoulder", "elbow")
LINKS = ("upper", "lower")
GEAR_RATIO = 6.0
_BLUE = np.array([0.2, 0.4, 0.7, 1.0])


@dataclass
class DoublePendulumScenario(TorqueDrivenScenario):
    """Two links on two motors, with the lengths of the design C.1 of DFKI's open double pendulum.

    F. Wiebe et al., "Open Source Dual-Purpose Acrobot and Pendubot Platform", IEEE Robotics and Automation Magazine 31
    (2024), tell lengths and gear ratio. All other numbers are guesses, to be calibrated: see `reality`.
    """

    size = 2

    upper_length: float = setting(0.2, "From the shoulder to the elbow.", unit="m", gt=0)
    masses: list[float] = setting(doc="Masses of the links.", unit="kg", gt=0, default_factory=lambda: [0.6, 0.6])
    centers: list[float] = setting(
        doc="From the joint to the link's centre of mass.", unit="m", ge=0, default_factory=lambda: [0.15, 0.2]
    )
    moments: list[float] = setting(
        doc="Moments about the centre of mass.", unit="kg m^2", gt=0, default_factory=lambda: [0.01, 0.01]
    )
    rotor_inertia: float = setting(5e-5, "The inertia of each motor, before its gear.", unit="kg m^2", ge=0)

    def validate(self) -> None:
        super().validate()
        for name in ("masses", "centers", "moments"):
            if len(getattr(self, name)) != len(LINKS):
                raise ScenarioError(
                    f"DoublePendulumScenario.{name} has one value per link, two, not {getattr(self, name)}"
                )

    def add_links(self, plant: MultibodyPlant) -> list[RevoluteJoint]:
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
