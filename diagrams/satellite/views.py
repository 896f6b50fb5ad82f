"""Pictures of a capture: the scene from outside, and the docking camera's view beside it (the paper's Figure 9)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.framework import Context

from vtbdrake.common.argument_checks import counted
from vtbdrake.state.systems import pose_to_array
from vtbdrake.testbed import VirtualTestbed
from vtbdrake_diagrams.satellite.supervisor import Mode

if TYPE_CHECKING:
    from matplotlib.figure import Figure

CAMERA = "sim.sense.docking_camera"
VIEWPOINT = (1.2, -3.6, 1.6)
"""Where the scene is seen from, in B (m)."""
MIDDLE = (1.3, 0.0, -0.1)
"""What is in the middle of it then, in B (m)."""


def looking(eye: ArrayLike, at: ArrayLike) -> RigidTransform:
    """Return the pose of a camera (x right, y down, z forward) at ``eye`` that looks at ``at``, with z upwards.

    Args:
        eye: Its position, shape (3,), in m.
        at: The point in the middle of its image, shape (3,), in m.
    """
    place = np.asarray(eye, dtype=float)
    z = np.asarray(at, dtype=float) - place
    z /= np.linalg.norm(z)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    return RigidTransform(RotationMatrix(np.column_stack([x, np.cross(z, x), z])), place)


def pictures(testbed: VirtualTestbed, context: Context) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Return the scene from `VIEWPOINT`, and what the docking camera sees now, as arrays (h, w, 3)."""
    camera = testbed.diagram.GetSubsystemByName(CAMERA)
    camera_context = camera.GetMyContextFromRoot(context)
    mounted = np.array(testbed.read(context, f"{CAMERA}.pose"))
    image = np.array(camera.render(camera_context).data[..., :3])
    testbed.write(context, {f"{CAMERA}.pose": pose_to_array(looking(VIEWPOINT, MIDDLE))})
    try:
        scene = np.array(camera.render(camera_context).data[..., :3])
    finally:
        testbed.write(context, {f"{CAMERA}.pose": mounted})
    return scene, image


def film_strip(testbed: VirtualTestbed, times: Sequence[float]) -> Figure:
    """Simulate a capture from its start; return a figure with the scene, and the camera's view below, at some times.

    Args:
        testbed: The testbed of a `SatelliteScenario` with a camera that is not blind.
        times: Times in s, increasing.
    """
    import matplotlib.pyplot as plt

    context = testbed.default_context()
    simulator = testbed.simulator(context)
    figure, axes = plt.subplots(2, len(times), figsize=(3.2 * len(times), 5.0), squeeze=False, layout="constrained")
    for column, time in zip(axes.T, times, strict=True):
        simulator.AdvanceTo(time)
        mode = Mode(int(testbed.read(context, "dps.impl.supervisor.mode"))).label
        for axis, picture in zip(column, pictures(testbed, context), strict=True):
            axis.imshow(picture)
            axis.set_axis_off()
        count = int(testbed.read(context, "dps.env.markers.count"))
        column[0].set_title(f"{time:g} s: {mode}")
        column[1].set_title(f"docking camera, {counted(count, 'marker')}", fontsize="small")
    return figure
