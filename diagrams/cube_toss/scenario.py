"""The testbed of a cube that is tossed onto a plane."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import product

import numpy as np
from pydrake.geometry import (
    AddCompliantHydroelasticProperties,
    AddContactMaterial,
    AddRigidHydroelasticProperties,
    Box,
    HalfSpace,
    ProximityProperties,
    Sphere,
)
from pydrake.math import RigidTransform
from pydrake.multibody.plant import CoulombFriction, MultibodyPlantConfig
from pydrake.multibody.tree import RotationalInertia, SpatialInertia
from pydrake.systems.framework import Diagram, DiagramBuilder
from pydrake.systems.primitives import ZeroOrderHold

from vtbdrake.common.settings import setting
from vtbdrake.testbed import Interface, Scenario, Signal, VirtualTestbedBuilder

PERIOD = 1.0 / 148.0
"""Period of the motion capture, in s."""

# Smaller spheres tell corners from edges no better, and larger ones roll.
_CORNER_RADIUS = 5e-4
_RED = np.array([0.6, 0.0, 0.0, 1.0])


def _point_contact() -> MultibodyPlantConfig:
    return MultibodyPlantConfig(time_step=1e-3, contact_model="point", discrete_contact_approximation="sap")


@dataclass
class CubeTossScenario(Scenario):
    """A free cube above a plane, seen by motion capture; nothing drives it.

    Edge, mass and moment belong to ContactNets' acrylic cube (S. Pfrommer, M. Halm, M. Posa, "ContactNets: Learning
    discontinuous contact dynamics with smooth, implicit representations", CoRL 2020). With point contact, its eight
    corners touch, as a box on a plane has one point of contact only; with hydroelastic contact, it is a compliant box.
    """

    plant_config: MultibodyPlantConfig = field(default_factory=_point_contact)
    period: float = setting(PERIOD, "Period of the motion capture.", unit="s", gt=0)
    edge: float = setting(0.1048, "Edge of the cube.", unit="m", gt=0.01)
    mass: float = setting(0.37, "Mass of the cube.", unit="kg", gt=0)
    moment: float = setting(8.1e-4, "Moment of inertia about any axis.", unit="kg m^2", gt=0)
    friction: float = setting(0.18, "Coefficient of friction between cube and plane.", ge=0)
    stiffness: float = setting(1e4, "Stiffness of each corner in point contact.", unit="N/m", gt=0)
    dissipation: float = setting(0.4, "Dissipation of Hunt and Crossley; SAP ignores it.", unit="s/m", ge=0)
    relaxation_time: float = setting(0.01, "Relaxation time of SAP's contact; the others ignore it.", unit="s", ge=0)
    modulus: float = setting(1e7, "Hydroelastic modulus of the cube.", unit="Pa", gt=0)

    def interface(self) -> Interface:
        return Interface(
            sense=[Signal("cube_state", size=13, unit="1, m, rad/s, m/s", max_age=5 * self.period)], act=[]
        )

    def make_dps(self) -> Diagram:
        """Return a DPS that holds what the motion capture sees."""
        builder = DiagramBuilder()
        sense = builder.AddNamedSystem("sense", ZeroOrderHold(self.period, 13))
        builder.ExportInput(sense.get_input_port(), "cube_state")
        return builder.Build()

    def add_world(self, builder: VirtualTestbedBuilder) -> None:
        plant, _ = builder.add_plant(self.plant_config)
        inertia = SpatialInertia.MakeFromCentralInertia(
            self.mass, np.zeros(3), RotationalInertia(self.moment, self.moment, self.moment)
        )
        cube = plant.AddRigidBody("cube", plant.AddModelInstance("cube"), inertia)
        shape = Box(self.edge, self.edge, self.edge)
        plant.RegisterVisualGeometry(cube, RigidTransform(), shape, "cube", _RED)
        if self.plant_config.contact_model == "point":
            at = 0.5 * self.edge - _CORNER_RADIUS
            for k, corner in enumerate(product((-at, at), repeat=3)):
                place = RigidTransform(np.array(corner))
                plant.RegisterCollisionGeometry(cube, place, Sphere(_CORNER_RADIUS), f"corner{k}", self._material())
        else:
            properties = self._material()
            AddCompliantHydroelasticProperties(0.5 * self.edge, self.modulus, properties)
            plant.RegisterCollisionGeometry(cube, RigidTransform(), shape, "cube", properties)
        ground = self._material(rigid=True)
        if self.plant_config.contact_model != "point":
            AddRigidHydroelasticProperties(ground)
        plant.RegisterCollisionGeometry(plant.world_body(), RigidTransform(), HalfSpace(), "ground", ground)
        plant.Finalize()
        builder.sim_sensor("cube_state", plant.get_state_output_port())

    def _material(self, *, rigid: bool = False) -> ProximityProperties:
        """Return the contact properties of the cube; with ``rigid`` the plane's, which add no compliance."""
        properties = ProximityProperties()
        friction = CoulombFriction(self.friction, self.friction)
        # Drake adds the relaxation times of both bodies, and combines stiffness and dissipation as springs in series.
        AddContactMaterial(
            dissipation=0.0 if rigid else self.dissipation,
            point_stiffness=1e12 if rigid else self.stiffness,
            friction=friction,
            properties=properties,
        )
        properties.AddProperty("material", "relaxation_time", 0.0 if rigid else self.relaxation_time)
        return properties
