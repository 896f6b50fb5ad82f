"""A MultibodyPlant without contact as compiled functions: its dynamics, its steps, many rollouts in one call."""

from vtbdrake.components.compiled_plant.dynamics import (
    AppliedForce,
    FrameMotion,
    PlantDynamics,
    plant_dynamics,
    plant_step,
)
from vtbdrake.components.compiled_plant.links import UnsupportedPlantError
from vtbdrake.components.compiled_plant.momentum import (
    BaseMotion,
    BaseReaction,
    MomentumModel,
    base_poses,
    momentum_world,
    rotation_angle,
)
from vtbdrake.components.compiled_plant.plant_rollouts import PlantRollouts, RolloutBatch

__all__ = [
    "AppliedForce",
    "BaseMotion",
    "BaseReaction",
    "FrameMotion",
    "MomentumModel",
    "PlantDynamics",
    "PlantRollouts",
    "RolloutBatch",
    "UnsupportedPlantError",
    "base_poses",
    "momentum_world",
    "plant_dynamics",
    "plant_step",
    "rotation_angle",
]
