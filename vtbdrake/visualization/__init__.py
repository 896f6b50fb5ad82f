"""Pictures: plots of sweeps, studies and rollouts, recordings in Meshcat, the drawing of a testbed."""

from vtbdrake.visualization.decisions import GhostMotions, decision_ghosts, plot_decision, show_decision
from vtbdrake.visualization.diagram import svg
from vtbdrake.visualization.log_motion import log_motion
from vtbdrake.visualization.meshcat import Scene, make_meshcat, show_motion, show_motions, show_poses
from vtbdrake.visualization.plots import plot_quality, plot_sweep
from vtbdrake.visualization.scenes import (
    FoxgloveServer,
    RerunServer,
    SceneOutput,
    SceneWriter,
    write_rollout,
    write_scene,
)
from vtbdrake.visualization.world_model_drawing import show_world_model

__all__ = [
    "FoxgloveServer",
    "GhostMotions",
    "RerunServer",
    "Scene",
    "SceneOutput",
    "SceneWriter",
    "decision_ghosts",
    "log_motion",
    "make_meshcat",
    "plot_decision",
    "plot_quality",
    "plot_sweep",
    "show_decision",
    "show_motion",
    "show_motions",
    "show_poses",
    "show_world_model",
    "svg",
    "write_rollout",
    "write_scene",
]
