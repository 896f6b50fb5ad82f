"""Scenes for the viewers of others: Foxglove (MCAP, WebSocket) and Rerun (recordings, gRPC)."""

from vtbdrake.visualization.scenes.foxglove_output import FoxgloveFile, FoxgloveServer
from vtbdrake.visualization.scenes.output import CameraImage, SceneOutput
from vtbdrake.visualization.scenes.rerun_output import RerunFile, RerunServer
from vtbdrake.visualization.scenes.scene_model import SceneModel
from vtbdrake.visualization.scenes.scene_sources import write_rollout, write_scene
from vtbdrake.visualization.scenes.scene_writer import SceneWriter

__all__ = [
    "CameraImage",
    "FoxgloveFile",
    "FoxgloveServer",
    "RerunFile",
    "RerunServer",
    "SceneModel",
    "SceneOutput",
    "SceneWriter",
    "write_rollout",
    "write_scene",
]
