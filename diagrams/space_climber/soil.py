r"""Soil in which the climber's feet sink in, by Bekker's law, and the crater with such soil.

**Law.** Under a plate of the width b, the pressure at the sinkage z is (k_c / b + k_phi) z (Bekker, with the exponent
1). Summed over the part of a sphere of the radius r that is in the ground, with b = r, the force is

    F(z) = pi k (r z^2 - z^3 / 3),   k = k_c / r + k_phi.

**In Drake.** The ground is one rigid mesh, and the feet are compliant: contact is hydroelastic. A sphere of the modulus
E has the pressure E (1 - s / r) at the distance s from its centre, so that the force on a rigid plane is

    F(z) = pi E (z^2 - 2 z^3 / (3 r)).

With E = k r this is the law for small z; E is chosen so that both agree at the load of a tripod. Ground that is
compliant itself, in parts, pushes a foot aside where the parts meet, see
`vtbdrake_diagrams.space_climber.studies.soft_ground`.

**Firm ground.** A sphere bears no more than F(r). Below a depth, the soil counts as firm: a smaller and stiffer sphere
within each foot meets the ground there. Real regolith gets denser with the depth, too.

What this leaves out: feet compact and push aside no soil, so that it springs back and has no resistance to motion but
friction; and rocks yield as the soil does, because it is the foot that yields.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from pydrake.geometry import (
    AddCompliantHydroelasticProperties,
    AddContactMaterial,
    AddRigidHydroelasticProperties,
    Box,
    Mesh,
    ProximityProperties,
    RoleAssign,
    Sphere,
)
from pydrake.math import RigidTransform
from pydrake.multibody.plant import CoulombFriction, MultibodyPlant, MultibodyPlantConfig
from pydrake.systems.analysis import SimulatorConfig
from scipy.optimize import brentq

from vtbdrake.common.settings import setting
from vtbdrake.components.meshes import surface_mesh
from vtbdrake.testbed import VirtualTestbedBuilder
from vtbdrake_diagrams.space_climber.crater_scenario import CraterScenario
from vtbdrake_diagrams.space_climber.morphology import FOOT_LINKS, LUNAR_GRAVITY, Morphology
from vtbdrake_diagrams.space_climber.terrain import GREY, crater_shapes

RADIUS = Morphology().foot_radius
"""Radius of the foot in m."""
LOAD = Morphology().total_mass * LUNAR_GRAVITY / 3.0
"""Load on each foot of a tripod on the moon, in N."""
RESOLUTION = 0.5
"""Edge length of the triangles of a hydroelastic foot, as a share of its radius."""
# A sphere of such triangles is smaller than the sphere, and yields more by this factor [calibrated at `LOAD`].
_COARSENESS = 1.085
# Its modulus in Pa: at the load of a tripod it yields by some 2 mm.
_CORE_MODULUS = 1e6
# Edge length of the triangles of rigid boxes, in m.
_ROCKS = 1.0


@dataclass(frozen=True)
class Soil:
    """Soil by Bekker's law with the exponent 1, and a foot in it.

    Attributes:
        cohesive: k_c in N/m^2.
        frictional: k_phi in N/m^3. The defaults are lunar soil (Lunar Sourcebook, chapter 9, 1991).
    """

    cohesive: float = 1.4e3
    frictional: float = 820e3

    def force(self, z: float) -> float:
        """Return the force in N on a foot at a sinkage z in m, up to its radius."""
        return float(np.pi * (self.cohesive / RADIUS + self.frictional) * (RADIUS * z**2 - z**3 / 3.0))

    def sinkage(self, load: float = LOAD) -> float:
        """Return the sinkage of a foot under a load in N, in m.

        Raises:
            ValueError: The load is more than the soil bears at a sinkage of the foot's radius.
        """
        if not 0.0 < load < self.force(RADIUS):
            raise ValueError(f"the soil bears between 0 and {self.force(RADIUS):.3g} N on a foot, not {load!r}")
        return float(brentq(lambda z: self.force(z) - load, 0.0, RADIUS))

    def stiffness(self) -> float:
        """Return the stiffness of contact at points that gives this sinkage under `LOAD`, in N/m."""
        return LOAD / self.sinkage()

    def modulus(self) -> float:
        """Return the hydroelastic modulus of a foot with this sinkage under `LOAD` on rigid ground, in Pa."""
        z = self.sinkage()
        return float(LOAD / (np.pi * (z**2 - 2.0 * z**3 / (3.0 * RADIUS))))

    def add_to_foot(self, properties: ProximityProperties) -> None:
        """Make a foot so compliant that it sinks into rigid ground as a rigid one would into this soil."""
        AddCompliantHydroelasticProperties(RESOLUTION * RADIUS, _COARSENESS * self.modulus(), properties)


def _on_soil() -> MultibodyPlantConfig:
    return MultibodyPlantConfig(
        time_step=0.01,
        contact_model="hydroelastic_with_fallback",
        discrete_contact_approximation="sap",
        use_sampled_output_ports=False,
    )


@dataclass
class SoilCraterScenario(CraterScenario):
    """A six-legged robot in a crater whose soil yields under its feet, see `Soil`.

    With contact at points, as in `mental`, the ground is the rigid one of `CraterScenario`.
    """

    simulator_config: SimulatorConfig = field(default_factory=SimulatorConfig)
    plant_config: MultibodyPlantConfig = field(default_factory=_on_soil)
    cohesive: float = setting(Soil.cohesive, "Bekker's k_c.", unit="N/m^2", ge=0.0)
    frictional: float = setting(Soil.frictional, "Bekker's k_phi.", unit="N/m^3", ge=700e3)
    firm_depth: float = setting(0.02, "The depth below which the soil is firm.", unit="m", ge=0.005, le=0.024)

    @property
    def yields(self) -> bool:
        """Return whether the soil yields; with contact at points it does not."""
        return bool(self.plant_config.contact_model != "point")

    def add_world(self, builder: VirtualTestbedBuilder) -> None:
        super().add_world(builder)
        if not self.yields:
            return
        plant, scene_graph = builder.plant, builder.scene_graph
        assert plant is not None
        inspector, soil = scene_graph.model_inspector(), Soil(self.cohesive, self.frictional)
        for name in FOOT_LINKS:
            for geometry in plant.GetCollisionGeometriesForBody(plant.GetBodyByName(name)):
                properties = ProximityProperties(inspector.GetProximityProperties(geometry))
                if not inspector.GetName(geometry).endswith("core"):
                    soil.add_to_foot(properties)
                    scene_graph.AssignRole(plant.get_source_id(), geometry, properties, RoleAssign.kReplace)

    def _add_ground(self, plant: MultibodyPlant) -> RigidTransform:
        if not self.yields:
            return super()._add_ground(plant)
        crater, world = self.crater, plant.world_body()
        friction = CoulombFriction(self.friction, self.friction)
        rigid, core = ProximityProperties(), ProximityProperties()
        AddRigidHydroelasticProperties(_ROCKS, rigid)
        AddCompliantHydroelasticProperties(RESOLUTION * (RADIUS - self.firm_depth), _CORE_MODULUS, core)
        for properties in (rigid, core):
            AddContactMaterial(None, None, friction, properties)
        surface = Mesh(surface_mesh(crater.mesh, name="terrain"), 1.0)
        plant.RegisterCollisionGeometry(world, RigidTransform(), surface, "ground", rigid)
        plant.RegisterVisualGeometry(world, RigidTransform(), surface, "ground", GREY)
        for name, shape, X_WS in crater_shapes(crater):
            if isinstance(shape, Box):
                plant.RegisterCollisionGeometry(world, X_WS, shape, name, rigid)
                plant.RegisterVisualGeometry(world, X_WS, shape, name, GREY)
        # The lowest point of the core is the depth of firm ground above the foot's.
        m = Morphology()
        X_TF = RigidTransform([m.tibia, 0.0, 0.0])
        for name in FOOT_LINKS:
            ball = Sphere(RADIUS - self.firm_depth)
            plant.RegisterCollisionGeometry(plant.GetBodyByName(name), X_TF, ball, "core", core)
        return RigidTransform([0.0, 0.0, float(crater.mesh_height(m.stance[:, :2]).max())])
