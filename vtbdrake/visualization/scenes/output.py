"""Where scenes are written to: what every output takes, whatever the viewer."""

from __future__ import annotations

import errno
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from vtbdrake.common.closing import Closing
from vtbdrake.common.failures import one_line

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray
    from pydrake.math import RigidTransform
    from pydrake.systems.sensors import CameraInfo

    from vtbdrake.visualization.scenes.scene_model import SceneFrame
    from vtbdrake.visualization.viewpoint import Viewpoint


@dataclass(frozen=True)
class CameraImage:
    """An image of a camera.

    Attributes:
        name: The camera's stream, ``/sim.sense.camera``.
        frame: The name of the camera's frame: x to the right, y down, z forward.
        info: Its optics.
        kind: ``color`` or ``depth``.
        pixels: Colours, shape (h, w, 3), uint8; or depths in m along z, shape (h, w), float32.
    """

    name: str
    frame: str
    info: CameraInfo
    kind: str
    pixels: NDArray[np.uint8] | NDArray[np.float32]


@contextmanager
def errors_of_file(path: str) -> Iterator[None]:
    """Let an error that the library of a viewer raises about a file be an OSError of the file.

    Args:
        path: The file.
    """
    try:
        yield
    except RuntimeError as error:
        raise OSError(errno.EIO, one_line(error), path) from error


class SceneOutput(Closing, ABC):
    """An output of scenes. Times are whole nanoseconds: since the begin of a simulation, or since 1970.

    Attributes:
        is_live: Whether viewers look at it meanwhile.
        address: How a viewer reaches it, or the path of its file.
    """

    is_live: ClassVar[bool] = False
    address: str

    @abstractmethod
    def add_frames(
        self, topic: str, time: int, frames: Sequence[SceneFrame], fixed: Sequence[tuple[SceneFrame, RigidTransform]]
    ) -> None:
        """Add frames with their shapes, once for all times.

        Args:
            topic: The stream of the shapes, ``/scene``, beside which others have related names.
            time: The time at which they appear.
            frames: All frames of the scene; each one stands after its parent.
            fixed: Those that do not move in their parents, with their poses there.
        """

    def look_from(self, camera: Viewpoint) -> None:
        """Let viewers begin with a camera, if what is written can say so.

        Args:
            camera: The camera.
        """

    @abstractmethod
    def write_poses(self, topic: str, time: int, frames: Sequence[SceneFrame], poses: Sequence[RigidTransform]) -> None:
        """Write the poses of moving frames in their parents.

        Args:
            topic: The stream, ``/tf``.
            time: The time.
            frames: The frames, which were added before.
            poses: Their poses.
        """

    @abstractmethod
    def write_joints(
        self, topic: str, time: int, names: Sequence[str], q: NDArray[np.float64], v: NDArray[np.float64]
    ) -> None:
        """Write the state of joints.

        Args:
            topic: The stream, ``/joint_states``.
            time: The time.
            names: The names of the joints, shape (n,).
            q: Their positions, in rad or m, shape (n,).
            v: Their velocities, in rad/s or m/s, shape (n,).
        """

    @abstractmethod
    def write_values(self, topic: str, time: int, values: Sequence[float], names: Sequence[str] = ()) -> None:
        """Write the entries of a signal.

        Args:
            topic: The stream.
            time: The time.
            values: The entries, always as many of a stream; NaN where there is none.
            names: Their names, if they have some; the first call counts.
        """

    @abstractmethod
    def write_image(self, time: int, image: CameraImage) -> None:
        """Write an image.

        Args:
            time: The time.
            image: The image.
        """

    @abstractmethod
    def write_points(self, topic: str, time: int, points: NDArray[np.float64], frame: SceneFrame) -> None:
        """Write a point cloud.

        Args:
            topic: The stream.
            time: The time.
            points: The points in m, shape (n, 3).
            frame: The frame in which they are given.
        """

    @abstractmethod
    def write_text(self, topic: str, time: int, text: str, *, is_error: bool = False) -> None:
        """Write an event.

        Args:
            topic: The stream.
            time: The time.
            text: What has happened.
            is_error: Whether it is an error.
        """

    def flush(self) -> None:
        """Show what was written, if somebody looks at it."""

    def restart(self) -> None:
        """Note that times go back, as after a reset."""
