"""The cameras of a testbed: ours and Drake's, their poses and their images."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vtbdrake.components.sensors.camera import Camera
from vtbdrake.state.systems import is_camera, leaves

if TYPE_CHECKING:
    from pydrake.math import RigidTransform
    from pydrake.systems.framework import Context, System
    from pydrake.systems.sensors import CameraInfo

    from vtbdrake.testbed import VirtualTestbed


def cameras(testbed: VirtualTestbed) -> dict[str, System]:
    """Return the cameras of a testbed, by their paths in its Diagram."""
    return {path: s for path, s in leaves(testbed.diagram) if isinstance(s, Camera) or is_camera(s)}


def camera_view(camera: System, context: Context) -> tuple[RigidTransform, CameraInfo]:
    """Return the pose of a camera in the world, and its optics.

    Args:
        camera: A camera of vtbdrake, or Drake's `RgbdSensor`.
        context: The context of the camera, not the root context.
    """
    if isinstance(camera, Camera):
        return camera.X_WC(context), camera.info(context)
    core = camera.GetColorRenderCamera(context).core()
    X_WB = camera.body_pose_in_world_output_port().Eval(context)
    return X_WB @ core.sensor_pose_in_camera_body(), core.intrinsics()
