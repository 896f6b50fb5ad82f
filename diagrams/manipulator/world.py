"""The simulated arm and its environment, as far as they are not in the SDF file."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from pydrake.common.value import Value
from pydrake.geometry import AddContactMaterial, Box, ProximityProperties, RoleAssign, SceneGraph
from pydrake.math import RigidTransform
from pydrake.multibody.math import SpatialForce
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import CoulombFriction, ExternallyAppliedSpatialForce, MultibodyPlant
from pydrake.multibody.tree import FixedOffsetFrame, ModelInstanceIndex, SpatialInertia
from pydrake.systems.framework import Context

from vtbdrake.state import AddressedSystem, Quantity
from vtbdrake_diagrams.manipulator.arm import GRAVITY, JOINT_NAMES, Arm
from vtbdrake_diagrams.manipulator.model import ARM_SDF

if TYPE_CHECKING:
    from vtbdrake_diagrams.manipulator.compiled import PushEquations

BALL_STIFFNESS = 1e8
"""The stiffness of the ball at the tip, in N/m [A], much larger than any wall's."""

WALL_THICKNESS = 0.1


def add_arm(plant: MultibodyPlant, arm: Arm) -> ModelInstanceIndex:
    """Add the arm to a plant, at the origin of the world and in its home pose."""
    (instance,) = Parser(plant).AddModels(str(ARM_SDF))
    plant.WeldFrames(plant.world_frame(), plant.GetFrameByName("base", instance))
    for name, angle in zip(JOINT_NAMES, arm.home, strict=True):
        plant.GetJointByName(name, instance).set_default_angle(angle)
    plant.mutable_gravity_field().set_gravity_vector([0.0, 0.0, -GRAVITY])
    return instance


def add_wall(plant: MultibodyPlant, *, distance: float, stiffness: float, dissipation: float, friction: float) -> None:
    """Add the model instance ``wall``: a slab across the world's x, on the frame ``mount``, which the Context can move.

    Args:
        plant: The plant, not yet finalized.
        distance: Distance of the slab's face from the world's origin (m).
        stiffness: Stiffness of the face (N/m): a ball that penetrates it by x is pushed back with stiffness x, in
            Drake's point contact.
        dissipation: Hunt and Crossley dissipation (s/m).
        friction: Coefficient of static and of dynamic friction.
    """
    wall = plant.AddModelInstance("wall")
    X_WM = RigidTransform([distance, 0.0, 0.5])
    mount = plant.AddFrame(FixedOffsetFrame("mount", plant.world_frame(), X_WM, wall))
    slab = Box(WALL_THICKNESS, 1.0, 1.0)
    body = plant.AddRigidBody("slab", wall, SpatialInertia.SolidBoxWithMass(10.0, *slab.size()))
    plant.WeldFrames(mount, body.body_frame())
    X_MG = RigidTransform([WALL_THICKNESS / 2, 0.0, 0.0])
    material = ProximityProperties()
    AddContactMaterial(dissipation, stiffness, CoulombFriction(friction, friction), material)
    plant.RegisterCollisionGeometry(body, X_MG, slab, "face", material)
    plant.RegisterVisualGeometry(body, X_MG, slab, "slab", np.array([0.45, 0.55, 0.65, 0.6]))


def set_ball_material(plant: MultibodyPlant, scene_graph: SceneGraph, arm: ModelInstanceIndex, friction: float) -> None:
    """Make the ball at the tip stiff; call it before a context is created."""
    material = ProximityProperties()
    AddContactMaterial(0.0, BALL_STIFFNESS, CoulombFriction(friction, friction), material)
    for geometry in plant.GetCollisionGeometriesForBody(plant.GetBodyByName("tool", arm)):
        scene_graph.AssignRole(plant.get_source_id(), geometry, material, RoleAssign.kReplace)


class Push(AddressedSystem):
    """A source of a constant wrench on a frame of a body, a parameter.

    .. pydrake_system::

        name: Push
        output_ports:
        - spatial_force

    The parameter ``wrench``, [torque (N m); force (N)] in the world, acts at the origin of the frame.
    """

    def __init__(self, plant: MultibodyPlant, frame: str) -> None:
        super().__init__()
        pushed = plant.GetFrameByName(frame)
        self.body = pushed.body().index()
        self.p_BoBq_B = pushed.GetFixedPoseInBodyFrame().translation()
        self._push = self.declare_parameters(wrench=Quantity(np.zeros(6), "N m, N"))
        self.DeclareAbstractOutputPort(
            "spatial_force",
            lambda: Value([ExternallyAppliedSpatialForce()]),
            self._calc,
            prerequisites_of_calc={self.numeric_parameter_ticket(self._push.index)},
        )

    def compiled_equations(self, context: Context, varied: frozenset[str]) -> PushEquations:
        """Return the equations for a compiled testbed."""
        from vtbdrake_diagrams.manipulator.compiled import PushEquations

        return PushEquations(self, context, varied)

    def _calc(self, context: Context, output: Value) -> None:  # type: ignore[valid-type]
        force = ExternallyAppliedSpatialForce()
        force.body_index = self.body
        force.p_BoBq_B = self.p_BoBq_B
        values = self._push.view(context).wrench
        force.F_Bq_W = SpatialForce(tau=values[:3], f=values[3:])
        output.set_value([force])  # type: ignore[attr-defined]
