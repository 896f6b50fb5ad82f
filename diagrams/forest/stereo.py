"""The pair of cameras that can replace the laser scanner: its configuration, and the detection of trunks with it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix

from vtbdrake.common.arrays import Array
from vtbdrake.common.settings import check_settings, setting
from vtbdrake.components.localization.dead_reckoning import body_rotation, carrier_pose_at
from vtbdrake.components.localization.landmarks import Landmarks
from vtbdrake.components.localization.stereo_trunks import StereoTrunkDetectorConfig, detect_stereo_trunks
from vtbdrake.components.perception.stereo import StereoCamera, StereoMatcher

if TYPE_CHECKING:
    from pydrake.multibody.tree import Frame
    from pydrake.systems.sensors import CameraInfo, ImageRgba8U

    from vtbdrake.testbed import VirtualTestbedBuilder


IMAGES = ("left_image", "right_image")
"""The names of the signals of the left and the right camera."""

# In the frame of a camera, x points to the right and y down; in L, x points forward and z up.
_R_LC = RotationMatrix(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]))


@dataclass
class StereoConfig:
    """Two cameras side by side, which look along x of the frame L, and the matching of their images."""

    fps: float = setting(2.0, "Pairs of images per second.", unit="Hz", gt=0.0)
    # The size of an image.
    width: int = setting(320, unit="pixels", ge=1)
    height: int = setting(240, unit="pixels", ge=1)
    fov_y: float = setting(
        1.08, "The field of view from top to bottom: from left to right, it is 77 deg.", unit="rad", gt=0.0, lt=np.pi
    )
    baseline: float = setting(0.3, "Distance of the cameras.", unit="m")
    noise: float = setting(1.5, "Standard deviation of the read noise, in counts of 255.", ge=0.0)
    seed: int = setting(0, "Determines the noise.")
    largest_disparity: int = setting(
        32, "The largest disparity, a multiple of 16: nearer objects are not detected.", unit="pixels"
    )

    def check(self) -> None:
        """Check that all values are possible.

        Raises:
            ValueError: A value is outside of its range.
        """
        check_settings(self)
        self.camera()
        self.matcher()

    def info(self) -> CameraInfo:
        """Return size and intrinsics of each camera."""
        from pydrake.systems.sensors import CameraInfo

        return CameraInfo(self.width, self.height, self.fov_y)

    def camera(self) -> StereoCamera:
        """Return the geometry of the pair."""
        return StereoCamera.of(self.info(), baseline=self.baseline)

    def matcher(self) -> StereoMatcher:
        """Return the matcher of the images."""
        return StereoMatcher(largest_disparity=self.largest_disparity)

    def poses(self) -> dict[str, RigidTransform]:
        """Return X_LC of both cameras, by signal: the origin of L lies between them."""
        half = 0.5 * self.baseline
        return {name: RigidTransform(_R_LC, [0.0, y, 0.0]) for name, y in zip(IMAGES, (half, -half), strict=True)}


@dataclass(frozen=True, eq=False)
class StereoLandmarks:
    """Trunks from pairs of images.

    Attributes:
        camera: The geometry of the pair.
        matcher: The matcher that computes disparities.
        detector: The settings of the detector of trunks.
        X_BC: Pose of the left camera in the DPS.
    """

    camera: StereoCamera
    matcher: StereoMatcher
    detector: StereoTrunkDetectorConfig
    X_BC: RigidTransform

    def prepare(self) -> None:
        """Load OpenCV."""
        blank = np.zeros((8, 8), dtype=np.uint8)
        self.matcher.disparity(blank, blank)

    def __call__(self, left: ImageRgba8U, right: ImageRgba8U, history: Array, time: float) -> Landmarks:
        """Return the landmarks in the level frame H at the time of the images.

        Args:
            left: The image of the left camera.
            right: The image of the right camera, of the same time.
            history: The port ``history`` of the `DeadReckoning`.
            time: The time of the images by the clock of the DPS, in s.
        """
        pose = carrier_pose_at(history, time)
        X_HB = RigidTransform(RotationMatrix(body_rotation(pose.roll, pose.pitch)), np.zeros(3))
        disparity = self.matcher.disparity(left, right)
        return detect_stereo_trunks(disparity, self.camera, self.detector, X_HC=X_HB @ self.X_BC)


def add_stereo(builder: VirtualTestbedBuilder, frame: Frame, config: StereoConfig) -> None:
    """Add the cameras ``left_camera`` and ``right_camera`` with the ``light`` to a simulated world.

    Args:
        builder: The builder of the testbed, with a finalized plant.
        frame: The frame L of the pair.
        config: The configuration of the pair.
    """
    from vtbdrake.components.environment.light import Light, LightConfig
    from vtbdrake.components.sensors import ErrorModel
    from vtbdrake.components.sensors.camera import Camera, connect_camera

    light = LightConfig(
        direction=[0.6, 0.4, -0.7],
        intensity=1.6,
        # Light of the sky from the other side, such that no pixel of an image is saturated.
        earth_direction=[-0.7, -0.5, -0.5],
        earth_shine=0.9,
        background=[0.6, 0.7, 0.8],
        shadows=False,
    )
    lit = builder.add("env", "light", Light(light))
    for signal, X_LC in config.poses().items():
        camera = Camera(
            builder.plant,
            frame,
            period=1.0 / config.fps,
            info=config.info(),
            X_FC=X_LC,
            errors=ErrorModel(noise=config.noise, seed=config.seed),
        )
        builder.add("sense", signal.replace("image", "camera"), camera)
        connect_camera(builder.diagram_builder, camera, builder.scene_graph, light=lit)
        builder.sim_sensor(signal, camera.GetOutputPort("color_image"))
