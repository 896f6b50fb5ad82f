"""The testbed of a biped that lands."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar
from xml.etree import ElementTree as ET

import numpy as np
from pydrake.geometry import AddContactMaterial, HalfSpace, ProximityProperties, Sphere
from pydrake.math import RigidTransform
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import CoulombFriction, MultibodyPlant, MultibodyPlantConfig
from pydrake.multibody.tree import RevoluteSpring
from pydrake.systems.framework import BasicVector, Context, System

from vtbdrake.common.settings import setting
from vtbdrake.state import AddressedSystem, Quantity
from vtbdrake.testbed import Interface, Scenario, ScenarioError, Signal, VirtualTestbedBuilder

SAMPLES = 100
"""Number of samples of a recording."""
PERIOD = 5e-4
"""Time between two samples, in s."""
MOTORS = (
    "hip_roll_left", "hip_roll_right", "hip_yaw_left", "hip_yaw_right", "hip_pitch_left", "hip_pitch_right",
    "knee_left", "knee_right", "toe_left", "toe_right",
)  # fmt: skip
"""The joints with motors, in the order of the recordings."""

# The robot beside its URDF, as the repository DAIRLab/dairlib has it (examples/Cassie/cassie_utils.cc): rotor inertias
# in kg m^2, gear ratios, and springs in N m/rad.
_ROTORS = (*[6.1e-5] * 4, *[3.65e-4] * 4, *[4.9e-6] * 2)
_GEARS = (*[25.0] * 4, *[16.0] * 4, *[50.0] * 2)
_SPRINGS = {"knee_joint": 1500.0, "ankle_spring_joint": 1250.0}
# Length of the rods that close the loops, in m, from the same file.
_ROD = 0.5012
# Where a rod ends on the heel spring, in m.
_ROD_ON_HEEL = np.array([0.11877, -0.01, 0.0])
# Where it ends on the thigh, in m.
_ROD_ON_THIGH = np.array([0.0, 0.0, 0.045])
_RADIUS = 1e-4


def _discrete() -> MultibodyPlantConfig:
    return MultibodyPlantConfig(time_step=2e-4, contact_model="point", discrete_contact_approximation="sap")


class TorquePlayer(AddressedSystem):
    """A DPS that plays the torques in its parameter ``table``, and looks at no sensor.

    .. pydrake_system::

        name: TorquePlayer
        input_ports:
        - state
        output_ports:
        - torque
    """

    def __init__(self) -> None:
        super().__init__()
        self._settings = self.declare_parameters(table=Quantity(np.zeros(SAMPLES * len(MOTORS)), "N m"))
        self.DeclareVectorInputPort("state", 45)
        self.DeclareVectorOutputPort(
            "torque", len(MOTORS), self._play, prerequisites_of_calc={self.time_ticket(), self.all_parameters_ticket()}
        )

    def _play(self, context: Context, output: BasicVector) -> None:
        row = min(int(context.get_time() / PERIOD + 1e-6), SAMPLES - 1)
        output.SetFromVector(self._settings.view(context).table[row * len(MOTORS) : (row + 1) * len(MOTORS)])


@dataclass
class CassieLandingScenario(Scenario):
    """Agility Robotics' Cassie above a plane, in the moment of its landing; recorded torques drive it.

    Its model is not part of the project: ``model`` is the file examples/Cassie/urdf/cassie_v2.urdf of the repository
    DAIRLab/dairlib (BSD-3). Only the two points of contact of each foot are used.
    """

    _PLACES: ClassVar[tuple[str, ...]] = ("model",)

    plant_config: MultibodyPlantConfig = field(default_factory=_discrete)
    model: str = setting("", "The path of cassie_v2.urdf.")
    contact: bool = setting(True, "Whether there is a plane to land on.")
    friction: float = setting(0.8, "Coefficient of friction between feet and plane.", ge=0)
    stiffness: float = setting(4e4, "Stiffness of each point of contact.", unit="N/m", gt=0)
    relaxation_time: float = setting(0.01, "Relaxation time of SAP's contact.", unit="s", ge=0)

    def validate(self) -> None:
        super().validate()
        if not Path(self.model).is_file():
            raise ScenarioError(
                f"{type(self).__name__}.model is the path of cassie_v2.urdf of the repository DAIRLab/dairlib, "
                f"not {self.model!r}"
            )

    def interface(self) -> Interface:
        return Interface(
            sense=[Signal("state", size=45, unit="1, m, rad, and per s")],
            act=[Signal("torque", size=len(MOTORS), unit="N m", lower=-300.0, upper=300.0, idle=0.0)],
        )

    def make_dps(self) -> System:
        return TorquePlayer()

    def add_world(self, builder: VirtualTestbedBuilder) -> None:
        plant, _ = builder.add_plant(self.plant_config)
        root = ET.parse(self.model).getroot()
        points = _without_shapes(root)
        Parser(plant).AddModelsFromString(ET.tostring(root, encoding="unicode"), "urdf")
        if self.contact:
            for body, p_BC in points:
                name = f"{body}{len(plant.GetCollisionGeometriesForBody(plant.GetBodyByName(body)))}"
                shape, place = Sphere(_RADIUS), RigidTransform(p_BC)
                plant.RegisterCollisionGeometry(plant.GetBodyByName(body), place, shape, name, self._material())
            ground = self._material(rigid=True)
            plant.RegisterCollisionGeometry(plant.world_body(), RigidTransform(), HalfSpace(), "ground", ground)
        _complete(plant)
        plant.Finalize()
        builder.sim_sensor("state", plant.get_state_output_port())
        builder.sim_actuator("torque", plant.get_actuation_input_port())

    def _material(self, *, rigid: bool = False) -> ProximityProperties:
        """Return the contact properties of the feet; with ``rigid`` the plane's, which add no compliance."""
        properties = ProximityProperties()
        AddContactMaterial(
            point_stiffness=1e12 if rigid else self.stiffness,
            friction=CoulombFriction(self.friction, self.friction),
            properties=properties,
        )
        properties.AddProperty("material", "relaxation_time", 0.0 if rigid else self.relaxation_time)
        return properties


def _without_shapes(root: ET.Element) -> list[tuple[str, np.ndarray]]:
    """Remove all shapes, whose meshes are other files, and return the points of contact: body and place."""
    points = []
    for link in root.findall("link"):
        for shape in [*link.findall("visual"), *link.findall("collision")]:
            origin = shape.find("origin")
            if shape.tag == "collision" and origin is not None:
                points.append((link.get("name", ""), np.array([float(x) for x in origin.get("xyz", "").split()])))
            link.remove(shape)
    return points


def _complete(plant: MultibodyPlant) -> None:
    """Add what the URDF lacks: rotors, springs and the rods."""
    for joint, rotor, gear in zip(MOTORS, _ROTORS, _GEARS, strict=True):
        motor = plant.GetJointActuatorByName(f"{joint}_motor")
        motor.set_default_rotor_inertia(rotor)
        motor.set_default_gear_ratio(gear)
    for side, sign in (("left", 1.0), ("right", -1.0)):
        for joint, stiffness in _SPRINGS.items():
            plant.AddForceElement(RevoluteSpring(plant.GetJointByName(f"{joint}_{side}"), 0.0, stiffness))
        heel, thigh = plant.GetBodyByName(f"heel_spring_{side}"), plant.GetBodyByName(f"thigh_{side}")
        plant.AddDistanceConstraint(heel, _ROD_ON_HEEL, thigh, sign * _ROD_ON_THIGH, _ROD)
