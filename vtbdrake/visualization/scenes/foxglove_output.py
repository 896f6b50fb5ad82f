"""Scenes for Foxglove: MCAP files and a WebSocket server, with Foxglove's published schemas."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vtbdrake.common.extras import extra_module
from vtbdrake.common.json_data import plain
from vtbdrake.visualization.scenes.output import CameraImage, SceneOutput, errors_of_file
from vtbdrake.visualization.scenes.ports import loopback_port
from vtbdrake.visualization.scenes.scene_meshes import triangle_mesh

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from pydrake.math import RigidTransform

    from vtbdrake.visualization.scenes.scene_model import SceneFrame, VisualShape

FOXGLOVE_PORT = 8765
"""The port at which Foxglove looks for a server by default."""

# Foxglove has no schema of plain numbers; its plots read JSON.
_VALUE_SCHEMA = {
    "title": "vtbdrake.Value",
    "type": "object",
    "properties": {
        "value": {"type": "array", "items": {"type": ["number", "null"]}},  # JSON has no NaN.
    },
}


def foxglove_sdk(name: str = "foxglove") -> Any:
    """Return a module of Foxglove's library.

    Args:
        name: Full name of the module.

    Raises:
        ModuleNotFoundError: The extra ``foxglove`` is not installed.
    """
    try:
        return extra_module(name, purpose="a scene for Foxglove", extra="foxglove")
    except ModuleNotFoundError as error:  # The package is not named like its module.
        raise ModuleNotFoundError(str(error).replace("needs foxglove:", "needs foxglove-sdk:")) from error


class _FoxgloveOutput(SceneOutput):
    """What a file and a server have in common: channels of a context of Foxglove's library."""

    def __init__(self) -> None:
        self._context = foxglove_sdk().Context()
        self._messages, self._channels_module = foxglove_sdk("foxglove.messages"), foxglove_sdk("foxglove.channels")
        # A channel is made when its first message comes.
        self._channel = cache(self._new_channel)
        self._value_channel = cache(self._new_value_channel)
        # The newest message of each channel with its time, for whoever comes later to a server.
        self._newest: dict[int, tuple[Any, Any, int]] = {}
        self._calibrations: dict[str, tuple[Any, ...]] = {}

    def _new_channel(self, topic: str, kind: str) -> Any:
        return getattr(self._channels_module, f"{kind}Channel")(topic, context=self._context)

    def _new_value_channel(self, topic: str) -> Any:
        return foxglove_sdk().Channel(topic, schema=_VALUE_SCHEMA, context=self._context)

    def _log(self, topic: str, kind: str, time: int, **fields: Any) -> None:
        self._send(self._channel(topic, kind), getattr(self._messages, kind)(**fields), time)

    def _send(self, channel: Any, message: Any, time: int) -> None:
        if self.is_live:
            self._newest[channel.id()] = channel, message, time
        channel.log(message, log_time=time)

    def _stamp(self, time: int) -> Any:
        return self._messages.Timestamp(sec=time // 10**9, nsec=time % 10**9)

    def _transforms(self, time: int, frames: Sequence[SceneFrame], poses: Sequence[RigidTransform]) -> list[Any]:
        stamp, m = self._stamp(time), self._messages
        return [
            m.FrameTransform(
                timestamp=stamp,
                parent_frame_id=frame.parent,
                child_frame_id=frame.name,
                translation=_vector(m, pose.translation()),
                rotation=_quaternion(m, pose),
            )
            for frame, pose in zip(frames, poses, strict=True)
        ]

    def add_frames(
        self, topic: str, time: int, frames: Sequence[SceneFrame], fixed: Sequence[tuple[SceneFrame, RigidTransform]]
    ) -> None:
        place = topic.removesuffix("scene")
        hanging = [(frame, pose) for frame, pose in fixed if frame.parent]
        if hanging:
            transforms = self._transforms(time, *zip(*hanging, strict=True))
            self._log(f"{place}tf_static", "FrameTransforms", time, transforms=transforms)
        entities = [self._entity(frame, time) for frame in frames if frame.shapes]
        self._log(topic, "SceneUpdate", time, entities=entities)

    def _entity(self, frame: SceneFrame, time: int) -> Any:
        primitives: dict[str, list[Any]] = {}
        for shape in frame.shapes:
            for kind, primitive in _PRIMITIVES[type(shape.shape).__name__](self._messages, shape):
                primitives.setdefault(kind, []).append(primitive)
        return self._messages.SceneEntity(
            timestamp=self._stamp(time), frame_id=frame.name, id=frame.name, frame_locked=True, **primitives
        )

    def write_poses(self, topic: str, time: int, frames: Sequence[SceneFrame], poses: Sequence[RigidTransform]) -> None:
        self._log(topic, "FrameTransforms", time, transforms=self._transforms(time, frames, poses))

    def write_joints(
        self, topic: str, time: int, names: Sequence[str], q: NDArray[np.float64], v: NDArray[np.float64]
    ) -> None:
        joints = [
            self._messages.JointState(name=name, position=position, velocity=velocity)
            for name, position, velocity in zip(names, q.tolist(), v.tolist(), strict=True)
        ]
        self._log(topic, "JointStates", time, timestamp=self._stamp(time), joints=joints)

    def write_values(self, topic: str, time: int, values: Sequence[float], names: Sequence[str] = ()) -> None:
        message = {"value": plain(np.asarray(values, dtype=float))}
        self._send(self._value_channel(topic), json.dumps(message, allow_nan=False).encode(), time)

    def write_image(self, time: int, image: CameraImage) -> None:
        stamp, info = self._stamp(time), image.info
        optics = (info.width(), info.height(), info.focal_x(), info.focal_y(), info.center_x(), info.center_y())
        if self._calibrations.get(image.name) != optics:
            self._calibrations[image.name] = optics
            self._log(f"{image.name}/calibration", "CameraCalibration", time, **_calibration(stamp, image, optics))
        height, width = image.pixels.shape[:2]
        self._log(
            f"{image.name}/{image.kind}",
            "RawImage",
            time,
            timestamp=stamp,
            frame_id=image.frame,
            width=width,
            height=height,
            encoding="rgb8" if image.kind == "color" else "32FC1",
            step=image.pixels.strides[0],
            data=image.pixels.tobytes(),
        )

    def write_points(self, topic: str, time: int, points: NDArray[np.float64], frame: SceneFrame) -> None:
        m = self._messages
        kind = m.PackedElementFieldNumericType.Float32
        fields = [m.PackedElementField(name=axis, offset=4 * k, type=kind) for k, axis in enumerate("xyz")]
        pose = m.Pose(position=m.Vector3(), orientation=m.Quaternion(w=1.0))
        data = points.astype("<f4").tobytes()
        stamp = self._stamp(time)
        cloud = {"frame_id": frame.name, "pose": pose, "point_stride": 12, "fields": fields, "data": data}
        self._log(topic, "PointCloud", time, timestamp=stamp, **cloud)

    def write_text(self, topic: str, time: int, text: str, *, is_error: bool = False) -> None:
        level = self._messages.LogLevel.Error if is_error else self._messages.LogLevel.Info
        self._log(
            topic, "Log", time, timestamp=self._stamp(time), level=level, message=text, name=topic.rpartition("/")[2]
        )


class FoxgloveFile(_FoxgloveOutput):
    """An MCAP file with Foxglove's schemas.

    Args:
        path: The path of the file, which is overwritten.

    Raises:
        ModuleNotFoundError: The extra ``foxglove`` is not installed.
        OSError: The file cannot be written.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        super().__init__()
        self.address = os.fspath(path)
        Path(path).write_bytes(b"")  # An error names the file and the reason.
        self._writer = foxglove_sdk().open_mcap(self.address, allow_overwrite=True, context=self._context)

    def close(self) -> None:
        """Write the file's index.

        Raises:
            OSError: The file could not be written.
        """
        with errors_of_file(self.address):
            self._writer.close()


class FoxgloveServer(_FoxgloveOutput):
    """A WebSocket server for Foxglove, on the loopback interface alone.

    Foxglove opens it by "Open connection". It shows what comes, and takes nothing. It has no password: every program
    on this machine, the pages in its browsers included, can look at it.

    Args:
        port: The port; 0: any that is free; None: `FOXGLOVE_PORT`, or any if that is taken.

    Raises:
        ModuleNotFoundError: The extra ``foxglove`` is not installed.
        OSError: The port is taken.
    """

    is_live = True

    def __init__(self, port: int | None = None) -> None:
        super().__init__()
        self._server = foxglove_sdk().start_server(
            name="vtbdrake",
            host="127.0.0.1",
            port=loopback_port(port, FOXGLOVE_PORT),
            context=self._context,
            server_listener=_Listener(self._repeat),
        )
        self.port: int = self._server.port
        self.address = f"ws://127.0.0.1:{self.port}"

    def _repeat(self, channel_id: int) -> None:
        """Send the message again that whoever subscribes now has missed."""
        if channel_id in self._newest:
            channel, message, time = self._newest[channel_id]
            channel.log(message, log_time=time)

    def restart(self) -> None:
        """Let the viewers forget what lies in the future."""
        self._server.clear_session()

    def close(self) -> None:
        """Stop the server."""
        self._server.stop()


class _Listener:
    """Hears of clients; Foxglove's library calls it in a thread of its own."""

    def __init__(self, subscribed: Callable[[int], None]) -> None:
        self._subscribed = subscribed

    def on_subscribe(self, client: Any, channel: Any) -> None:
        self._subscribed(channel.id)

    def __getattr__(self, name: str) -> Callable[..., None]:
        if name.startswith("on_"):
            return lambda *_: None
        raise AttributeError(name)


# -- Foxglove's primitives


def _vector(m: Any, v: NDArray[np.float64]) -> Any:
    x, y, z = v.tolist()
    return m.Vector3(x=x, y=y, z=z)


def _quaternion(m: Any, X: RigidTransform) -> Any:
    w, x, y, z = X.rotation().ToQuaternion().wxyz().tolist()
    return m.Quaternion(x=x, y=y, z=z, w=w)


def _look(m: Any, shape: VisualShape, *, p_GS: Sequence[float] = (0.0, 0.0, 0.0)) -> dict[str, Any]:
    """Return pose and colour of a primitive whose origin S lies at a place in the shape's frame G."""
    r, g, b, a = shape.color
    position = shape.X_FG @ np.asarray(p_GS, dtype=float)
    pose = m.Pose(position=_vector(m, position), orientation=_quaternion(m, shape.X_FG))
    return {"pose": pose, "color": m.Color(r=r, g=g, b=b, a=a)}


_Primitives = list[tuple[str, Any]]


def _box(m: Any, visual: VisualShape) -> _Primitives:
    return [("cubes", m.CubePrimitive(size=_vector(m, visual.shape.size()), **_look(m, visual)))]


def _spheroid(m: Any, visual: VisualShape, diameters: Sequence[float], z: float = 0.0) -> tuple[str, Any]:
    size = _vector(m, np.array(diameters, dtype=float))
    return "spheres", m.SpherePrimitive(size=size, **_look(m, visual, p_GS=(0.0, 0.0, z)))


def _sphere(m: Any, visual: VisualShape) -> _Primitives:
    return [_spheroid(m, visual, [2.0 * visual.shape.radius()] * 3)]


def _ellipsoid(m: Any, visual: VisualShape) -> _Primitives:
    shape = visual.shape
    return [_spheroid(m, visual, [2.0 * shape.a(), 2.0 * shape.b(), 2.0 * shape.c()])]


def _cylinder(m: Any, visual: VisualShape) -> _Primitives:
    d, length = 2.0 * visual.shape.radius(), visual.shape.length()
    size = m.Vector3(x=d, y=d, z=length)
    return [("cylinders", m.CylinderPrimitive(size=size, bottom_scale=1.0, top_scale=1.0, **_look(m, visual)))]


def _capsule(m: Any, visual: VisualShape) -> _Primitives:
    d, half = 2.0 * visual.shape.radius(), visual.shape.length() / 2.0
    return [*_cylinder(m, visual), *(_spheroid(m, visual, [d] * 3, z) for z in (-half, half))]


def _cone(m: Any, visual: VisualShape) -> _Primitives:
    # Its tip is at the origin, its base at z = height.
    shape = visual.shape
    size = m.Vector3(x=2.0 * shape.a(), y=2.0 * shape.b(), z=shape.height())
    look = _look(m, visual, p_GS=(0.0, 0.0, shape.height() / 2.0))
    return [("cylinders", m.CylinderPrimitive(size=size, bottom_scale=0.0, top_scale=1.0, **look))]


def _mesh(m: Any, visual: VisualShape) -> _Primitives:
    mesh = triangle_mesh(visual.shape, visual.name)
    points = [m.Point3(x=x, y=y, z=z) for x, y, z in mesh.vertices.tolist()]
    colors = []
    if mesh.colors is not None and not visual.is_painted:
        opacity = visual.color[3]
        colors = [m.Color(r=r, g=g, b=b, a=a * opacity) for r, g, b, a in (mesh.colors / 255.0).tolist()]
    indices = mesh.triangles.ravel().tolist()
    look = _look(m, visual)
    return [("triangles", m.TriangleListPrimitive(points=points, colors=colors, indices=indices, **look))]


_PRIMITIVES: Mapping[str, Callable[[Any, VisualShape], _Primitives]] = {
    "Box": _box,
    "Capsule": _capsule,
    "Convex": _mesh,
    "Cylinder": _cylinder,
    "Ellipsoid": _ellipsoid,
    "Mesh": _mesh,
    "MeshcatCone": _cone,
    "Sphere": _sphere,
}


def _calibration(stamp: Any, image: CameraImage, optics: tuple[Any, ...]) -> dict[str, Any]:
    """Return the fields of a calibration; its principal point counts from the centre of the first pixel."""
    width, height, fx, fy, cx, cy = optics
    cx, cy = cx - 0.5, cy - 0.5
    return {
        "timestamp": stamp,
        "frame_id": image.frame,
        "width": width,
        "height": height,
        "K": [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0],
        "R": [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        "P": [fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0],
    }
