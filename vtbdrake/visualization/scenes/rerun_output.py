"""Scenes for Rerun: recordings (.rrd), and a server that viewers connect to."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from time import time_ns as wall_time_ns
from typing import TYPE_CHECKING, Any

import numpy as np

from vtbdrake.common.extras import extra_module
from vtbdrake.visualization.scenes.output import CameraImage, SceneOutput, errors_of_file
from vtbdrake.visualization.scenes.ports import loopback_port
from vtbdrake.visualization.scenes.scene_meshes import triangle_mesh
from vtbdrake.visualization.scenes.scene_model import WORLD

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from pydrake.math import RigidTransform

    from vtbdrake.visualization.scenes.scene_model import SceneFrame, VisualShape
    from vtbdrake.visualization.viewpoint import Viewpoint

RERUN_PORT = 9876
"""The port at which Rerun's viewer looks for a server by default."""

# Names of the timelines: the written times, and, of a server, when something was written. A reset lets the former go
# back, and never the latter.
_TIMELINE = "time"
_WALL_TIMELINE = "wall_time"
# Number of instants that are sent together to a file: a call takes as long as some hundred instants in it.
_BATCH = 512
# Memory for viewers that come later.
_SERVER_MEMORY = "1GiB"


def rerun_sdk() -> Any:
    """Return Rerun's library.

    Raises:
        ModuleNotFoundError: The extra ``rerun`` is not installed.
    """
    try:
        return extra_module("rerun", purpose="a scene for Rerun", extra="rerun")
    except ModuleNotFoundError as error:  # The package is not named like its module.
        raise ModuleNotFoundError(str(error).replace("needs rerun:", "needs rerun-sdk:")) from error


@dataclass
class _Rows:
    """Rows of an entity that are sent together.

    Attributes:
        send: Sends the rows.
        times: Their times, in ns.
        walls: Their wall times, in ns since 1970.
        rows: Their content.
    """

    send: Callable[[list[Any]], Any]
    times: list[int] = field(default_factory=list)
    walls: list[int] = field(default_factory=list)
    rows: list[Any] = field(default_factory=list)


class _RerunOutput(SceneOutput):
    """What a file and a server have in common: a recording stream, to which rows are sent in batches.

    The entity of a frame lies beneath the entity of its parent: ``world/arm/base/link_1``, say.

    Args:
        sink: Where the stream goes.
        calendar: Whether times count since 1970.
    """

    def __init__(self, sink: Any, *, calendar: bool) -> None:
        self._rr = rr = rerun_sdk()
        self._calendar = calendar
        self._stream = rr.RecordingStream("vtbdrake")
        self._stream.set_log_time_enabled(False)
        self._stream.set_sinks(sink)
        self._paths = {WORLD: WORLD}  # of the entities, by frame
        self._buffers: dict[str, _Rows] = {}
        self._has_camera = False
        self._instants = 0
        self._last: int | None = None
        self._pinholes: dict[str, tuple[Any, ...]] = {}
        self._stream.log(WORLD, rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True, strict=True)

    # -- rows

    def _append(self, entity: str, time: int, row: Any, make: Callable[[list[Any]], Any]) -> None:
        rows = self._buffers.get(entity)
        if rows is None:
            rows = self._buffers[entity] = _Rows(make)
        if time != self._last:
            self._last = time
            self._instants += 1
            if self._instants > _BATCH:
                self._send()
                self._instants = 1
        rows.times.append(time)
        rows.rows.append(row)
        if self.is_live:
            rows.walls.append(wall_time_ns())

    def _send(self) -> None:
        for entity, rows in self._buffers.items():
            if rows.times:
                self._stream.send_columns(entity, self._times(rows), rows.send(rows.rows), strict=True)
                rows.times, rows.walls, rows.rows = [], [], []
        self._instants = 0

    def _times(self, rows: _Rows) -> list[Any]:
        columns = [self._rr.TimeColumn(_TIMELINE, **self._instant(np.array(rows.times, dtype=np.int64)))]
        if rows.walls:
            walls = np.array(rows.walls, dtype=np.int64).astype("datetime64[ns]")
            columns.append(self._rr.TimeColumn(_WALL_TIMELINE, timestamp=walls))
        return columns

    def _instant(self, time: Any) -> dict[str, Any]:
        """Return times in ns, an array or a number of numpy, in the form of Rerun's library."""
        if self._calendar:
            return {"timestamp": time.astype("datetime64[ns]")}
        return {"duration": time.astype("timedelta64[ns]")}

    def _log(self, entity: str, time: int, *archetypes: Any) -> None:
        """Send what is large at once."""
        self._stream.set_time(_TIMELINE, **self._instant(np.int64(time)))
        if self.is_live:
            self._stream.set_time(_WALL_TIMELINE, timestamp=np.datetime64(wall_time_ns(), "ns"))
        self._stream.log(entity, *archetypes, strict=True)

    # -- what is written

    def add_frames(
        self, topic: str, time: int, frames: Sequence[SceneFrame], fixed: Sequence[tuple[SceneFrame, RigidTransform]]
    ) -> None:
        rr = self._rr
        for frame in frames:
            if frame.parent:
                self._paths[frame.name] = self._path(frame)
            for visual in frame.shapes:
                place = f"{self._paths[frame.name]}/{rr.escape_entity_path_part(visual.name)}"
                self._stream.log(place, *_SHAPES[type(visual.shape).__name__](rr, visual), static=True, strict=True)
        for frame, pose in fixed:
            if frame.parent:
                self._stream.log(self._paths[frame.name], _transform(rr, pose), static=True, strict=True)

    def _path(self, frame: SceneFrame) -> str:
        """Return the path of a frame's entity, in which the parts that its name shares with its parent's stand once."""
        parts = frame.name.split("/")
        for shared in frame.parent.split("/"):
            if len(parts) == 1 or parts[0] != shared:
                break
            parts = parts[1:]
        return "/".join([self._paths[frame.parent], *map(self._rr.escape_entity_path_part, parts)])

    def look_from(self, camera: Viewpoint) -> None:
        """Show the world large, from a camera, and other views in tabs beside it; the first scene counts."""
        if self._has_camera:
            return
        self._has_camera = True
        views = extra_module("rerun.blueprint", purpose="a scene for Rerun", extra="rerun")
        eye = views.EyeControls3D(position=camera.position, look_target=camera.target, eye_up=(0.0, 0.0, 1.0))
        world = views.Spatial3DView(origin=WORLD, name=WORLD, eye_controls=eye)
        self._stream.send_blueprint(views.Blueprint(world, auto_views=True, auto_layout=True))

    def write_poses(self, topic: str, time: int, frames: Sequence[SceneFrame], poses: Sequence[RigidTransform]) -> None:
        for frame, pose in zip(frames, poses, strict=True):
            wxyz = pose.rotation().ToQuaternion().wxyz()
            self._append(self._paths[frame.name], time, (pose.translation(), wxyz), self._transform_columns)

    def _transform_columns(self, rows: list[Any]) -> Any:
        translations, quaternions = (np.array(part) for part in zip(*rows, strict=True))
        return self._rr.Transform3D.columns(translation=translations, quaternion=np.roll(quaternions, -1, axis=1))

    def write_joints(
        self, topic: str, time: int, names: Sequence[str], q: NDArray[np.float64], v: NDArray[np.float64]
    ) -> None:
        self.write_values(f"{topic}/position", time, q.tolist(), names)
        self.write_values(f"{topic}/velocity", time, v.tolist(), names)

    def write_values(self, topic: str, time: int, values: Sequence[float], names: Sequence[str] = ()) -> None:
        entity = topic.removeprefix("/")
        if names and entity not in self._buffers:
            self._stream.log(entity, self._rr.SeriesLines(names=list(names)), static=True, strict=True)
        self._append(entity, time, values, self._scalar_columns)

    def _scalar_columns(self, rows: list[Any]) -> Any:
        columns = self._rr.Scalars.columns(scalars=np.concatenate(rows).astype(float))
        return columns.partition([len(row) for row in rows])

    def write_image(self, time: int, image: CameraImage) -> None:
        rr, info = self._rr, image.info
        entity = self._paths[image.frame]
        optics = (info.width(), info.height(), info.focal_x(), info.focal_y(), info.center_x(), info.center_y())
        if self._pinholes.get(image.name) != optics:
            self._pinholes[image.name] = optics
            width, height, fx, fy, cx, cy = optics
            pinhole = rr.Pinhole(
                image_from_camera=[[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]],
                resolution=[width, height],
                camera_xyz=rr.ViewCoordinates.RDF,
            )
            self._log(entity, time, pinhole)
        content = rr.Image(image.pixels) if image.kind == "color" else rr.DepthImage(image.pixels, meter=1.0)
        self._log(f"{entity}/{image.kind}", time, content)

    def write_points(self, topic: str, time: int, points: NDArray[np.float64], frame: SceneFrame) -> None:
        name = self._rr.escape_entity_path_part(topic.rpartition("/")[2])
        self._log(f"{self._paths[frame.name]}/points/{name}", time, self._rr.Points3D(points.astype(np.float32)))

    def write_text(self, topic: str, time: int, text: str, *, is_error: bool = False) -> None:
        level = self._rr.TextLogLevel.ERROR if is_error else self._rr.TextLogLevel.INFO
        self._log(topic.removeprefix("/"), time, self._rr.TextLog(text, level=level))

    def flush(self) -> None:
        if self.is_live:
            self._send()

    def close(self) -> None:
        """Send what is left, and end the recording.

        Raises:
            OSError: The file could not be written.
        """
        with errors_of_file(self.address):
            self._send()
            self._stream.flush()
            self._stream.disconnect()


class RerunFile(_RerunOutput):
    """A recording of Rerun, .rrd.

    Args:
        path: The path of the file, which is overwritten.
        calendar: Whether times count since 1970, instead of since the begin of a simulation.

    Raises:
        ModuleNotFoundError: The extra ``rerun`` is not installed.
        OSError: The file cannot be written.
    """

    def __init__(self, path: str | os.PathLike[str], *, calendar: bool = False) -> None:
        self.address = os.fspath(path)
        Path(path).write_bytes(b"")  # An error names the file and the reason.
        super().__init__(rerun_sdk().FileSink(self.address), calendar=calendar)


class RerunServer(_RerunOutput):
    """A server for viewers of Rerun, on the loopback interface alone: ``rerun ADDRESS`` looks at it.

    It keeps up to 1 GiB for viewers that come later.

    Args:
        port: The port; 0: any that is free; None: `RERUN_PORT`, or any if that is taken.
        calendar: Whether times count since 1970, instead of since the begin of a simulation.

    Raises:
        ModuleNotFoundError: The extra ``rerun`` is not installed.
        OSError: The port is taken.
    """

    is_live = True

    def __init__(self, port: int | None = None, *, calendar: bool = False) -> None:
        rr = rerun_sdk()
        self.port = loopback_port(port, RERUN_PORT)
        # The default is all interfaces.
        sink = rr.GrpcServerSink(bind_ip="127.0.0.1", port=self.port, server_memory_limit=_SERVER_MEMORY)
        self.address: str = sink.uri
        super().__init__(sink, calendar=calendar)


# -- Rerun's shapes


def _transform(rr: Any, X: RigidTransform) -> Any:
    w, x, y, z = X.rotation().ToQuaternion().wxyz()
    return rr.Transform3D(translation=X.translation(), quaternion=rr.Quaternion(xyzw=[x, y, z, w]))


def _placed(rr: Any, visual: VisualShape, archetype: Any) -> tuple[Any, Any]:
    return archetype, _transform(rr, visual.X_FG)


def _rgba(visual: VisualShape) -> list[int]:
    return [round(255.0 * min(max(part, 0.0), 1.0)) for part in visual.color]


def _box(rr: Any, visual: VisualShape) -> tuple[Any, ...]:
    box = rr.Boxes3D(half_sizes=[visual.shape.size() / 2.0], colors=[_rgba(visual)], fill_mode="solid")
    return _placed(rr, visual, box)


def _spheroid(rr: Any, visual: VisualShape, semi_axes: Sequence[float]) -> tuple[Any, ...]:
    return _placed(rr, visual, rr.Ellipsoids3D(half_sizes=[semi_axes], colors=[_rgba(visual)], fill_mode="solid"))


def _sphere(rr: Any, visual: VisualShape) -> tuple[Any, ...]:
    return _spheroid(rr, visual, [visual.shape.radius()] * 3)


def _ellipsoid(rr: Any, visual: VisualShape) -> tuple[Any, ...]:
    return _spheroid(rr, visual, [visual.shape.a(), visual.shape.b(), visual.shape.c()])


def _cylinder(rr: Any, visual: VisualShape) -> tuple[Any, ...]:
    size = {"lengths": [visual.shape.length()], "radii": [visual.shape.radius()]}
    return _placed(rr, visual, rr.Cylinders3D(**size, colors=[_rgba(visual)], fill_mode="solid"))


def _capsule(rr: Any, visual: VisualShape) -> tuple[Any, ...]:
    length = visual.shape.length()
    # Rerun's capsule begins at its origin.
    capsule = rr.Capsules3D(
        lengths=[length],
        radii=[visual.shape.radius()],
        translations=[[0.0, 0.0, -length / 2.0]],
        colors=[_rgba(visual)],
        fill_mode="solid",
    )
    return _placed(rr, visual, capsule)


def _mesh(rr: Any, visual: VisualShape) -> tuple[Any, ...]:
    mesh = triangle_mesh(visual.shape, visual.name)
    look: dict[str, Any] = {"albedo_factor": _rgba(visual)}
    if mesh.colors is not None and not visual.is_painted:
        look = {"vertex_colors": mesh.colors, "albedo_factor": [255, 255, 255, _rgba(visual)[3]]}
    archetype = rr.Mesh3D(vertex_positions=mesh.vertices, triangle_indices=mesh.triangles, **look)
    return _placed(rr, visual, archetype)


_SHAPES: Mapping[str, Callable[[Any, VisualShape], tuple[Any, ...]]] = {
    "Box": _box,
    "Capsule": _capsule,
    "Convex": _mesh,
    "Cylinder": _cylinder,
    "Ellipsoid": _ellipsoid,
    "Mesh": _mesh,
    "MeshcatCone": _mesh,
    "Sphere": _sphere,
}
