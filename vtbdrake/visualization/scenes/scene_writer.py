"""Writes the states of a testbed into an output: poses, joints, images, scans and signals."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Iterator, Sequence
from math import floor
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vtbdrake.common.argument_checks import as_addresses, as_number
from vtbdrake.common.closing import Closing
from vtbdrake.common.failures import FAILURES
from vtbdrake.components.sensors.laser_scanner import LaserScanner
from vtbdrake.state.systems import leaves
from vtbdrake.testbed.switch import COMMAND, T_SENSE
from vtbdrake.visualization.cameras import camera_view
from vtbdrake.visualization.scenes.foxglove_output import FoxgloveFile
from vtbdrake.visualization.scenes.output import CameraImage, SceneOutput
from vtbdrake.visualization.scenes.rerun_output import RerunFile
from vtbdrake.visualization.scenes.scene_model import SceneModel

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from pydrake.math import RigidTransform
    from pydrake.systems.framework import Context, System

    from vtbdrake.testbed import VirtualTestbed

# Times are sums with rounding errors, in s.
_ROUNDING = 1e-9

SCENES = (".mcap", ".rrd")
"""The suffixes of the files of a scene: MCAP with Foxglove's schemas, and a recording of Rerun."""


def check_scene_path(path: str | os.PathLike[str]) -> None:
    """Raise a ValueError if the suffix of a file is none of a scene's.

    Args:
        path: The path of the file.
    """
    if Path(path).suffix not in SCENES:
        raise ValueError(f"a scene is a file that ends in {' or '.join(SCENES)}, not {os.fspath(path)!r}")


def open_scene_file(path: str | os.PathLike[str], *, suffix: str = "", calendar: bool = False) -> SceneOutput:
    """Return the output of a scene's file.

    Args:
        path: The path of the file, which is overwritten.
        suffix: The suffix that says what it is, instead of the path's.
        calendar: Whether times count since 1970, instead of since the begin of a simulation.

    Raises:
        ValueError: The suffix is none of a scene's.
        ModuleNotFoundError: The extra ``foxglove`` or ``rerun`` is not installed.
    """
    suffix = suffix or Path(path).suffix
    check_scene_path(f"scene{suffix}" if suffix in SCENES else path)
    return FoxgloveFile(path) if suffix == ".mcap" else RerunFile(path, calendar=calendar)


class SceneWriter(Closing):
    """Writes states of a testbed to an output, so that Foxglove or Rerun show them.

    What stands still is written once, with the shapes; then, of each state, the poses of the frames, the state of the
    joints, the signals of the DPS, and images and scans that are new::

        with SceneWriter(testbed, "run.mcap") as writer:
            simulator.set_monitor(writer.monitor)
            simulator.AdvanceTo(10.0)

    The streams are ``/scene``, ``/tf_static``, ``/tf``, ``/joint_states``, ``/sense/<signal>`` (what the DPS gets),
    ``/command/<signal>`` (what it commands), ``/u/<signal>`` (its commands u), ``/<path>/color`` and ``/<path>/depth``
    of each camera, ``/points/<path>`` of each laser scanner, and ``/variable/<address>``.

    Args:
        testbed: The testbed.
        output: Where it is written to: a path (.mcap or .rrd), or an open output, which stays open.
        model: What is drawn; None: all that the testbed has, beneath the world.
        rate: States per second that `monitor` writes, of simulated time.
        images: Whether images of cameras and scans of laser scanners are written.
        signals: Whether signals are written.
        record: Addresses of variables and vector ports that are written, too.
        without: Streams of signals that are left out, ``sense/position``.

    Attributes:
        model: What is drawn.
        output: Where it is written to.
        rate: States per second that `monitor` writes.

    Raises:
        ValueError: The path has another suffix, the rate is not positive, or there is no such address.
        ModuleNotFoundError: The extra ``foxglove`` or ``rerun`` is not installed.
    """

    def __init__(
        self,
        testbed: VirtualTestbed,
        output: SceneOutput | str | os.PathLike[str],
        *,
        model: SceneModel | None = None,
        rate: float = 30.0,
        images: bool = True,
        signals: bool = True,
        record: Sequence[str] = (),
        without: Collection[str] = (),
    ) -> None:
        if not as_number("the rate of a scene", rate) > 0.0:
            raise ValueError(f"the rate of a scene is a positive number of states per second, not {rate}")
        self.rate, self._last = rate, -1
        self._readers = _signal_readers(testbed) if signals else {}
        for address in as_addresses("what is recorded in a scene", record):
            self._readers[f"variable/{address}"] = (testbed.reader(address), ())
        for stream in without:
            self._readers.pop(stream, None)
        self.model = model or SceneModel(testbed)
        self._moving = [frame for frame in self.model.frames if frame.moves]
        self._cameras = self.model.cameras if images else {}
        self._scanners = _scanners(testbed) if images else {}
        self._shown: dict[str, Any] = {}  # the newest image and scan, by stream
        self._is_own = not isinstance(output, SceneOutput)
        self.output = output if isinstance(output, SceneOutput) else open_scene_file(output)
        self._last_time: int | None = None
        self._live: tuple[int, bytes] | None = None  # what a live output shows

    def monitor(self, context: Context) -> None:
        """Write a state if it is due: for `Simulator.set_monitor`.

        Args:
            context: A root context of the testbed.
        """
        tick = floor(context.get_time() * self.rate + _ROUNDING)
        if tick != self._last:
            self._last = tick
            self.write(context)

    def write(self, context: Context, *, world: Context | None = None, time: int | None = None) -> None:
        """Write a state; to a live output, unless nothing has moved since.

        Args:
            context: A root context of the testbed, from which the signals are read.
            world: The root context of the world, if that is another one, without images and scans: the world that a
                DPS believes in, for example.
            time: The time in ns, at least 0; None: the one of the context.

        Raises:
            ValueError: The time is negative.
        """
        at = round(1e9 * context.get_time()) if time is None else time
        if at < 0:
            raise ValueError(f"a scene has no times before 0, unlike {1e-9 * at:g} s: give time=, in ns")
        poses = [frame.pose(world or context) for frame in self._moving]
        if self.output.is_live and self._is_same(at, poses):
            return
        self._begin(at, world or context)
        model, output = self.model, self.output
        if poses:
            output.write_poses(model.topic("tf"), at, self._moving, poses)
        if model.joints:
            output.write_joints(model.topic("joint_states"), at, model.joints, *model.joint_state(world or context))
        for name, values, names in self._signals(context):
            output.write_values(model.topic(name), at, values, names)
        if world is None or world is context:
            for image in self._new_images(context):
                output.write_image(at, image)
            for name, points in self._new_points(context):
                output.write_points(model.topic(name), at, points, model.frames[0])
        output.flush()

    def _is_same(self, time: int, poses: Sequence[RigidTransform]) -> bool:
        """Return whether this is what a live output shows already: what stands still would fill its memory."""
        before, self._live = self._live, (time, b"".join(pose.GetAsMatrix34().tobytes() for pose in poses))
        return self._live == before

    def _begin(self, time: int, context: Context) -> None:
        """Write what stands still, before the first state."""
        if self._last_time is None:
            fixed = [(frame, frame.pose(context)) for frame in self.model.frames if not frame.moves]
            self.output.add_frames(self.model.topic("scene"), time, self.model.frames, fixed)
            if (camera := self.model.fitting_camera(context)) is not None:
                self.output.look_from(camera)
        elif time < self._last_time:
            self.output.restart()
        self._last_time = time

    def _signals(self, context: Context) -> Iterator[tuple[str, list[float], Sequence[str]]]:
        """Yield stream, entries and their names of what has a value."""
        for name, (read, names) in self._readers.items():
            try:
                value = np.ravel(np.asarray(read(context), dtype=float))
            except FAILURES:  # For example: nothing feeds the real port of a signal.
                continue
            if not np.isnan(value).all():
                yield name, value.tolist(), names

    def _new_images(self, context: Context) -> Iterator[CameraImage]:
        for name, camera in self._cameras.items():
            mine = camera.GetMyContextFromRoot(context)
            for kind in ("color", "depth"):
                if not camera.HasOutputPort(_IMAGES[kind]):
                    continue
                data = camera.GetOutputPort(_IMAGES[kind]).Eval(mine).data
                stream = f"/{name}/{kind}"
                if stream in self._shown and np.array_equal(self._shown[stream], data):
                    continue
                self._shown[stream] = np.array(data)
                pixels = np.ascontiguousarray(data[..., :3] if kind == "color" else data[..., 0])
                yield CameraImage(f"/{name}", name, camera_view(camera, mine)[1], kind, pixels)

    def _new_points(self, context: Context) -> Iterator[tuple[str, NDArray[np.float64]]]:
        for path, scanner in self._scanners.items():
            mine = scanner.GetMyContextFromRoot(context)
            scan = scanner.GetOutputPort("scan").Eval(mine)
            if self._shown.get(path) is not scan:
                self._shown[path] = scan
                yield f"points/{path}", np.asarray(scanner.points_W(mine))

    def close(self) -> None:
        """Finish the file, if the writer has opened it."""
        if self._is_own:
            self.output.close()


_IMAGES = {"color": "color_image", "depth": "depth_image"}


def _signal_readers(testbed: VirtualTestbed) -> dict[str, tuple[Callable[[Context], Any], Sequence[str]]]:
    """Return the readers of the vector signals, with the names of their entries, by stream."""
    interface, readers = testbed.interface, {}
    addresses = {
        **{f"sense/{s.name}": (s, f"{T_SENSE}{s.name}.value") for s in interface.sense},
        **{f"command/{s.name}": (s, f"dps.{s.name}") for s in interface.act},
        **{f"u/{s.name}": (s, f"{COMMAND}{s.name}") for s in interface.commands},
    }
    for name, (signal, address) in addresses.items():
        if signal.is_vector:
            readers[name] = (testbed.reader(address), signal.entry_names)
    return readers


def _scanners(testbed: VirtualTestbed) -> dict[str, System]:
    return {path: system for path, system in leaves(testbed.diagram) if isinstance(system, LaserScanner)}
