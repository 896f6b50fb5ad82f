"""Servicer and target in a MultibodyPlant, for the scenario, for tests and for studies of the arm alone."""

from __future__ import annotations

import numpy as np
from pydrake.math import RigidTransform
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant, MultibodyPlantConfig
from pydrake.multibody.tree import ModelInstanceIndex, PdControllerGains

from vtbdrake_diagrams.satellite.bodies import ARM_JOINT_NAMES, FINGER_JOINT_NAMES, JOINT_NAMES, Servicer
from vtbdrake_diagrams.satellite.model import SERVICER_SDF, TARGET_SDF, WHEELS_SDF

TIME_STEP = 0.01
"""The plant's time step in s: with the SAP solver half of it gives the same capture."""


def plant_config() -> MultibodyPlantConfig:
    """Return the configuration of the discrete plant."""
    return MultibodyPlantConfig(
        time_step=TIME_STEP,
        contact_model="point",
        discrete_contact_approximation="sap",
        use_sampled_output_ports=False,
    )


def add_servicer(
    plant: MultibodyPlant, servicer: Servicer | None = None, *, wheels: bool = False, servos: bool = True
) -> ModelInstanceIndex:
    """Add the servicer, floating freely, with its arm stowed; and remove gravity, as all is in free fall.

    Args:
        plant: The plant, not yet finalized.
        servicer: Supplies home position and gains; the masses and dimensions come from the SDF file.
        wheels: Whether it has reaction wheels: the model instance ``wheels``, whose actuators take torques.
        servos: Whether arm and fingers have position servos (Drake's implicit PD controllers); otherwise their
            actuators take torques.
    """
    s = servicer or Servicer()
    (instance,) = Parser(plant).AddModels(str(SERVICER_SDF))
    for name, position in zip(JOINT_NAMES, s.home, strict=True):
        joint = plant.GetJointByName(name, instance)
        joint.set_default_positions([position])
        if servos:
            finger = name in FINGER_JOINT_NAMES
            p, d = (s.finger_stiffness, s.finger_damping) if finger else (s.stiffness, s.damping)
            plant.GetJointActuatorByName(name, instance).set_controller_gains(PdControllerGains(p=p, d=d))
    if wheels:
        (wheel_instance,) = Parser(plant).AddModels(str(WHEELS_SDF))
        housing = plant.GetBodyByName("housing", wheel_instance).body_frame()
        plant.WeldFrames(plant.GetFrameByName("base", instance), housing)
    plant.mutable_gravity_field().set_gravity_vector(np.zeros(3))
    return instance


def add_target(plant: MultibodyPlant, X_WT: RigidTransform | None = None) -> ModelInstanceIndex:
    """Add the target, without markers, floating freely at ``X_WT``; by default 2.5 m in front of the servicer.

    Gravity is removed.
    """
    plant.mutable_gravity_field().set_gravity_vector(np.zeros(3))
    (instance,) = Parser(plant).AddModels(str(TARGET_SDF))
    body = plant.GetBodyByName("body", instance)
    plant.SetDefaultFloatingBaseBodyPose(body, X_WT or RigidTransform([2.5, 0.0, 0.0]))
    return instance


def arm_positions(plant: MultibodyPlant, instance: ModelInstanceIndex) -> list[int]:
    """Return where the arm's seven joints are among the plant's positions."""
    return [plant.GetJointByName(name, instance).position_start() for name in ARM_JOINT_NAMES]
