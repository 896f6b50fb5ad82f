"""The body of the robot in a MultibodyPlant, for the scenario and for the benchmarks."""

from __future__ import annotations

import numpy as np
from pydrake.geometry import ProximityProperties, RoleAssign, SceneGraph
from pydrake.math import RigidTransform
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import CoulombFriction, MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex, PdControllerGains

from vtbdrake_diagrams.space_climber.kinematics import LegKinematics
from vtbdrake_diagrams.space_climber.model import CLIMBER_SDF, PAYLOAD_SDF
from vtbdrake_diagrams.space_climber.morphology import FOOT_LINKS, JOINT_NAMES, Morphology


def add_climber(
    plant: MultibodyPlant, *, morphology: Morphology | None = None, joint_stops: bool = False
) -> ModelInstanceIndex:
    """Add the robot with position servos at its joints; its default is the nominal stance, feet on the plane z = 0.

    The servos are Drake's implicit PD controllers (honoured by SAP, the lagged scheme and CENIC, not by explicit
    integrators), limited to the model's joint torque. Their gains cannot change after ``plant.Finalize``.

    Without ``joint_stops`` the joints turn freely: the DPS keeps its commands within the joints' ranges, and the stops,
    which are then never reached, would make a CENIC simulation two to three times slower.
    """
    morphology = morphology or Morphology()
    (climber,) = Parser(plant).AddModels(str(CLIMBER_SDF))
    gains = PdControllerGains(p=morphology.joint_stiffness, d=morphology.joint_damping)
    stance = LegKinematics(morphology).inverse(morphology.stance).ravel()
    for name, angle in zip(JOINT_NAMES, stance, strict=True):
        plant.GetJointActuatorByName(name, climber).set_controller_gains(gains)
        joint = plant.GetJointByName(name, climber)
        joint.set_default_angle(angle)
        if not joint_stops:
            joint.set_position_limits([-np.inf], [np.inf])
    base = plant.GetBodyByName("base", climber)
    plant.SetDefaultFloatingBaseBodyPose(base, RigidTransform([0.0, 0.0, morphology.torso_clearance]))
    return climber


def add_payload(plant: MultibodyPlant, climber: ModelInstanceIndex) -> ModelInstanceIndex:
    """Weld the attachment (1 kg until ``SetMass`` of its body ``payload``) to the front plate."""
    (payload,) = Parser(plant).AddModels(str(PAYLOAD_SDF))
    frame = plant.GetFrameByName("attachment", climber)
    plant.WeldFrames(frame, plant.GetBodyByName("payload", payload).body_frame())
    return payload


def set_foot_friction(
    plant: MultibodyPlant, scene_graph: SceneGraph, climber: ModelInstanceIndex, friction: float
) -> None:
    """Set static and dynamic friction of all feet; to be called before contexts are made.

    Drake combines the frictions a and b of two bodies to 2 a b / (a + b): on ground of the same friction it is that.
    """
    inspector = scene_graph.model_inspector()
    for name in FOOT_LINKS:
        for geometry in plant.GetCollisionGeometriesForBody(plant.GetBodyByName(name, climber)):
            properties = ProximityProperties(inspector.GetProximityProperties(geometry))
            properties.UpdateProperty("material", "coulomb_friction", CoulombFriction(friction, friction))
            scene_graph.AssignRole(plant.get_source_id(), geometry, properties, RoleAssign.kReplace)
