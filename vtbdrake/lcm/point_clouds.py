"""Maps for point clouds, as Drake sends them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from drake import lcmt_point_cloud, lcmt_point_cloud_field
from pydrake.perception import PointCloud

from vtbdrake.lcm.maps import LcmMap, Reader, Sample
from vtbdrake.lcm.wire import MalformedError, decode
from vtbdrake.testbed import Signal

_NUMBERS = {
    lcmt_point_cloud_field.INT8: "i1",
    lcmt_point_cloud_field.UINT8: "u1",
    lcmt_point_cloud_field.INT16: "i2",
    lcmt_point_cloud_field.UINT16: "u2",
    lcmt_point_cloud_field.INT32: "i4",
    lcmt_point_cloud_field.UINT32: "u4",
    lcmt_point_cloud_field.FLOAT32: "f4",
    lcmt_point_cloud_field.FLOAT64: "f8",
}
_POSITION = ("x", "y", "z")
_NORMAL = ("normal_x", "normal_y", "normal_z")


@dataclass(frozen=True, kw_only=True)
class CloudMap(LcmMap):
    """An `LcmMap` that receives point clouds; `point_cloud_map` makes one. It sends none.

    The signal's ``model_value`` tells which properties its clouds have: positions, normals, colours. A message that
    lacks one of them is rejected (``missing``), as is one whose data are not as long as it says (``size``). Points may
    be infinite or NaN: that is how a sensor says that it saw nothing there.
    """

    def reader(self, signals: Sequence[Signal]) -> Reader:
        (signal,) = signals
        if not isinstance(signal.model_value, PointCloud):
            raise ValueError(
                f"signal {signal.name} on channel {self.channel} needs a PointCloud as model_value, not "
                f"{signal.model_value!r}"
            )

        def read(data: bytes) -> Sample:
            message = decode(self.type, data)
            return Sample(message.utime * 1e-6, {signal.name: to_cloud(message, signal.model_value)})

        return read


def point_cloud_map(channel: str, signal: str) -> CloudMap:
    """A map for `lcmt_point_cloud` messages, as Drake's `PointCloudToLcm` makes them."""
    return CloudMap(channel=channel, type=lcmt_point_cloud, signals=[signal])


def to_cloud(message: Any, model: PointCloud) -> PointCloud:
    """The cloud in an `lcmt_point_cloud`, with the properties of ``model``.

    Raises:
        MalformedError: ``size``, ``missing`` or ``type``, see `CloudMap`.
    """
    points = _points(message)
    cloud = PointCloud(len(points), model.fields())
    if model.has_xyzs():
        _fill(cloud.mutable_xyzs(), points, _POSITION)
    if model.has_normals():
        _fill(cloud.mutable_normals(), points, _NORMAL)
    if model.has_rgbs():
        # Four bytes in one number, the least significant one first: red, green, blue and nothing.
        packed = _column(points, "rgb")
        if packed.dtype.kind + str(packed.dtype.itemsize) != "u4":
            raise MalformedError("type")
        colours = packed.astype("<u4").view(np.uint8).reshape(-1, 4)
        cloud.mutable_rgbs()[:] = colours[:, :3].T
    return cloud


def _points(message: Any) -> np.ndarray:
    """The points as an array of records.

    The number of points that is announced is not believed before the data are there.
    """
    step = message.point_step
    if min(message.width, message.height) < 0 or step < 1 or message.row_step != message.width * step:
        raise MalformedError("size")
    if len(message.data) != message.height * message.row_step:
        raise MalformedError("size")
    order = ">" if message.flags & lcmt_point_cloud.IS_BIGENDIAN else "<"
    fields = [field for field in message.fields if field.count == 1 and field.datatype in _NUMBERS]
    types = [np.dtype(order + _NUMBERS[field.datatype]) for field in fields]
    # numpy's own check of large offsets overflows, and it reads wherever they point.
    if any(not 0 <= field.byte_offset <= step - type.itemsize for field, type in zip(fields, types, strict=True)):
        raise MalformedError("size")
    names, offsets = [field.name for field in fields], [field.byte_offset for field in fields]
    try:
        record = np.dtype({"names": names, "formats": types, "offsets": offsets, "itemsize": step})
    except ValueError:  # two fields of one name
        raise MalformedError("type") from None
    return np.frombuffer(message.data, record)


def _column(points: np.ndarray, name: str) -> np.ndarray:
    if points.dtype.names is None or name not in points.dtype.names:
        raise MalformedError("missing")
    return points[name]


def _fill(target: np.ndarray, points: np.ndarray, names: Sequence[str]) -> None:
    with np.errstate(over="ignore", invalid="ignore"):  # double to single precision
        for row, name in zip(target, names, strict=True):
            row[:] = _column(points, name)
