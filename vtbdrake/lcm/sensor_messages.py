"""Ready-made maps for Drake's messages of camera images, point clouds and laser scans."""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np
from drake import (
    lcmt_image,
    lcmt_image_array,
    lcmt_point_cloud,
    lcmt_point_cloud_field,
)

from vtbdrake.common.scan import Scan
from vtbdrake.lcm.maps import Decoder, Encoder, LcmMap, decode
from vtbdrake.lcm.messages import MalformedError
from vtbdrake.testbed import Signal

if TYPE_CHECKING:
    from pydrake.perception import PointCloud


@cache
def _pixels() -> dict[type, tuple[int, int]]:
    # Imported here: a controller without a camera runs without pydrake.geometry.
    from pydrake.systems import sensors

    uint8 = lcmt_image.CHANNEL_TYPE_UINT8
    return {
        sensors.ImageBgr8U: (lcmt_image.PIXEL_FORMAT_BGR, uint8),
        sensors.ImageBgra8U: (lcmt_image.PIXEL_FORMAT_BGRA, uint8),
        sensors.ImageDepth16U: (lcmt_image.PIXEL_FORMAT_DEPTH, lcmt_image.CHANNEL_TYPE_UINT16),
        sensors.ImageDepth32F: (lcmt_image.PIXEL_FORMAT_DEPTH, lcmt_image.CHANNEL_TYPE_FLOAT32),
        sensors.ImageGrey8U: (lcmt_image.PIXEL_FORMAT_GRAY, uint8),
        sensors.ImageLabel16I: (lcmt_image.PIXEL_FORMAT_LABEL, lcmt_image.CHANNEL_TYPE_INT16),
        sensors.ImageRgb8U: (lcmt_image.PIXEL_FORMAT_RGB, uint8),
        sensors.ImageRgba8U: (lcmt_image.PIXEL_FORMAT_RGBA, uint8),
    }


@dataclass(frozen=True, kw_only=True)
class ImageMap(LcmMap):
    """An `LcmMap` of images; `image_map` and `image_array_map` make one.

    A signal's ``model_value`` gives pixel type, width and height. An image is rejected if its size (``size``) or pixel
    type (``type``) differs, or if it is compressed by anything but zlib (``compression``).

    Attributes:
        frames: By signal, the ``frame_name`` of its image.
        compress: Whether the images that are sent are compressed by zlib, as fast as it can.
    """

    frames: Mapping[str, str]
    compress: bool = False

    def decoder(self, signals: Sequence[Signal]) -> Decoder:
        models = self._models(signals)
        array = self.type is lcmt_image_array

        def decode_images(data: bytes) -> tuple[float, Mapping[str, Any]]:
            message = decode(self.type, data)
            by_frame = {image.header.frame_name: image for image in message.images} if array else {}
            images = {name: by_frame.get(frame) if array else message for name, frame in self.frames.items()}
            values = {name: _to_image(image, models[name]) for name, image in images.items() if image is not None}
            return message.header.utime * 1e-6, values

        return decode_images

    def encoder(self, signals: Sequence[Signal]) -> Encoder:
        models = self._models(signals)

        def encode_images(values: Mapping[str, Any], utime: int) -> bytes:
            images = []
            for name, value in values.items():
                if value.shape != models[name].shape:
                    raise ValueError(
                        f"signal {name} on channel {self.channel} has images of shape {models[name].shape}, not "
                        f"{value.shape}"
                    )
                images.append(_to_message(value, self.frames[name], utime, compress=self.compress))
            if self.type is lcmt_image:
                return bytes(images[0].encode())
            message = lcmt_image_array()
            message.header.utime = utime
            message.num_images, message.images = len(images), images
            return bytes(message.encode())

        return encode_images

    def _models(self, signals: Sequence[Signal]) -> dict[str, Any]:
        models = {signal.name: signal.model_value for signal in signals}
        for name, model in models.items():
            if type(model) not in _pixels() or not model.width() * model.height():
                raise ValueError(
                    f"signal {name} on channel {self.channel} needs an image of its size as model_value, such as "
                    f"ImageRgba8U(640, 480), not {model!r}"
                )
        return models


def image_map(channel: str, signal: str, *, compress: bool = False) -> ImageMap:
    """Return a map for one camera by `lcmt_image` messages.

    The name of the signal is the ``frame_name`` of the images that are sent; the name in received images does not
    matter.

    Args:
        channel: Channel of the messages.
        signal: Name of the abstract signal, an image.
        compress: Whether images that are sent are compressed.
    """
    return ImageMap(channel=channel, type=lcmt_image, signals=[signal], frames={signal: signal}, compress=compress)


def image_array_map(channel: str, frames: Mapping[str, str], *, compress: bool = False) -> ImageMap:
    """Return a map for `lcmt_image_array` messages, as Drake's `ImageToLcmImageArrayT` makes them.

    Args:
        channel: Name of the channel.
        frames: By signal, the ``frame_name`` of its image. A message need not have all of them: a signal whose image is
            not in it counts it as ``missing``.
        compress: Whether the images that are sent are compressed by zlib.
    """
    return ImageMap(channel=channel, type=lcmt_image_array, signals=tuple(frames), frames=frames, compress=compress)


def _to_image(message: Any, model: Any) -> Any:
    """Return the image in an `lcmt_image`, of the type and size of ``model``."""
    image = type(model)(model.width(), model.height())
    pixels = image.mutable_data
    if (message.pixel_format, message.channel_type) != _pixels()[type(model)]:
        raise MalformedError("type")
    if (message.width, message.height) != (image.width(), image.height()) or message.row_stride != pixels[0].nbytes:
        raise MalformedError("size")
    content = message.data
    if message.compression_method == lcmt_image.COMPRESSION_METHOD_ZLIB:
        try:
            # Never more than the image has: a few bytes can stand for gigabytes.
            content = zlib.decompressobj().decompress(content, pixels.nbytes + 1)
        except zlib.error:
            raise MalformedError("compression") from None
    elif message.compression_method != lcmt_image.COMPRESSION_METHOD_NOT_COMPRESSED:
        raise MalformedError("compression")
    if len(content) != pixels.nbytes:
        raise MalformedError("size")
    order = ">" if message.bigendian else "<"
    pixels[:] = np.frombuffer(content, pixels.dtype.newbyteorder(order)).reshape(pixels.shape)
    return image


def _to_message(image: Any, frame: str, utime: int, *, compress: bool) -> lcmt_image:
    """Return an image as an `lcmt_image`."""
    message = lcmt_image()
    message.header.utime, message.header.frame_name = utime, frame
    message.pixel_format, message.channel_type = _pixels()[type(image)]
    message.height, message.width = image.height(), image.width()
    message.row_stride = image.data[0].nbytes
    message.data = image.data.tobytes()
    if compress:
        message.compression_method = lcmt_image.COMPRESSION_METHOD_ZLIB
        message.data = zlib.compress(message.data, zlib.Z_BEST_SPEED)
    message.size = len(message.data)
    return message


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


def _signal_of(kind: type, signals: Sequence[Signal], channel: str, *, example: str = "") -> Signal:
    """Return the only signal, whose values are of ``kind``; raise a ValueError if they are not."""
    (signal,) = signals
    if not isinstance(signal.model_value, kind):
        raise ValueError(
            f"signal {signal.name} on channel {channel} needs a {kind.__name__} as model_value{example}, not "
            f"{signal.model_value!r}"
        )
    return signal


class PointCloudMap(LcmMap):
    """An `LcmMap` of point clouds; `point_cloud_map` makes one.

    The signal's ``model_value`` has the properties of its clouds: positions, normals, colours. A message is rejected if
    it lacks one of them (``missing``), or if its data have not the announced length (``size``). Points may be infinite
    or NaN, where a sensor has seen nothing. (Drake's `PointCloudToLcm` leaves such points out.)
    """

    def decoder(self, signals: Sequence[Signal]) -> Decoder:
        signal = self._checked(signals)

        def decode_cloud(data: bytes) -> tuple[float, Mapping[str, Any]]:
            message = decode(self.type, data)
            return message.utime * 1e-6, {signal.name: _to_cloud(message, signal.model_value)}

        return decode_cloud

    def encoder(self, signals: Sequence[Signal]) -> Encoder:
        signal = self._checked(signals)
        return lambda values, utime: _cloud_message(_cloud_points(values[signal.name]), signal.name, utime)

    def _checked(self, signals: Sequence[Signal]) -> Signal:
        from pydrake.perception import PointCloud

        return _signal_of(PointCloud, signals, self.channel)


def point_cloud_map(channel: str, signal: str) -> PointCloudMap:
    """Return a map for `lcmt_point_cloud` messages, as Drake's `PointCloudToLcm` makes them.

    The name of the signal is the ``frame_name`` of the clouds that are sent.

    Args:
        channel: Channel of the messages.
        signal: Name of the abstract signal, a point cloud.
    """
    return PointCloudMap(channel=channel, type=lcmt_point_cloud, signals=[signal])


class ScanMap(LcmMap):
    """An `LcmMap` of laser scans; `scan_map` makes one.

    A message is rejected if it lacks one of the fields (``missing``), if its data have not the announced length
    (``size``), or if a ray is fired after the stamp (``time``).
    """

    def decoder(self, signals: Sequence[Signal]) -> Decoder:
        signal = self._checked(signals)

        def decode_scan(data: bytes) -> tuple[float, Mapping[str, Any]]:
            message = decode(self.type, data)
            stamp = message.utime * 1e-6
            return stamp, {signal.name: _to_scan(message, stamp)}

        return decode_scan

    def encoder(self, signals: Sequence[Signal]) -> Encoder:
        signal = self._checked(signals)

        def encode_scan(values: Mapping[str, Any], utime: int) -> bytes:
            scan = values[signal.name]
            points = np.empty(len(scan.ranges), [(name, "<f4") for name in ("x", "y", "z", "t")])
            points["x"], points["y"], points["z"] = scan.points().T
            points["t"] = scan.times
            return _cloud_message(points, signal.name, utime)

        return encode_scan

    def age(self, values: Mapping[str, Any], time: float) -> float:
        (scan,) = values.values()
        return float(time - scan.stamp)

    def _checked(self, signals: Sequence[Signal]) -> Signal:
        return _signal_of(Scan, signals, self.channel, example=", such as Scan.empty()")


def scan_map(channel: str, signal: str) -> ScanMap:
    """Return a map for laser scans by `lcmt_point_cloud` messages.

    The points have the fields ``x``, ``y`` and ``z`` in m, and ``t``: when the ray was fired, in s relative to the
    message's time, at which the scan was complete. Their numbers have 32 bits. Points that are not finite, or at the
    origin, stand for rays without a return, and are left out of the received scan. Its stamp is in the sender's time.

    Args:
        channel: Channel of the messages.
        signal: Name of the abstract signal, a `Scan`.
    """
    return ScanMap(channel=channel, type=lcmt_point_cloud, signals=[signal])


def _to_scan(message: Any, stamp: float) -> Scan:
    """Return the scan in an `lcmt_point_cloud`."""
    points = _points(message)
    with np.errstate(over="ignore", invalid="ignore"):
        columns = [_column(points, name).astype(float) for name in ("x", "y", "z", "t")]
        ranges = np.sqrt(columns[0] ** 2 + columns[1] ** 2 + columns[2] ** 2)
    returned = np.isfinite(ranges) & (ranges > 0.0)
    ranges, times = ranges[returned], columns[3][returned]
    if not (times <= 0.0).all() or not np.isfinite(times).all():
        raise MalformedError("time")
    directions = np.stack([column[returned] for column in columns[:3]], axis=1) / ranges[:, np.newaxis]
    return Scan(directions, ranges, times, stamp)


def _to_cloud(message: Any, model: PointCloud) -> PointCloud:
    """Return the cloud in an `lcmt_point_cloud`, with the properties of ``model``."""
    points = _points(message)
    cloud = type(model)(len(points), model.fields())
    with np.errstate(over="ignore", invalid="ignore"):  # double to single precision
        if model.has_xyzs():
            cloud.mutable_xyzs()[:] = [_column(points, name) for name in ("x", "y", "z")]
        if model.has_normals():
            cloud.mutable_normals()[:] = [_column(points, f"normal_{name}") for name in ("x", "y", "z")]
    if model.has_rgbs():
        # Four bytes in one number, the least significant one first: red, green, blue and nothing.
        packed = _column(points, "rgb")
        if packed.dtype.kind + str(packed.dtype.itemsize) != "u4":
            raise MalformedError("type")
        colours = packed.astype("<u4").view(np.uint8).reshape(-1, 4)
        cloud.mutable_rgbs()[:] = colours[:, :3].T
    return cloud


def _points(message: Any) -> np.ndarray:
    """Return the points as an array of records.

    The announced number of points is checked against the size of the data before any memory is allocated.
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


def _cloud_points(cloud: PointCloud) -> np.ndarray:
    """Return a cloud as an array of records, in the order of Drake's `PointCloudToLcm`."""
    columns: dict[str, np.ndarray] = {}
    if cloud.has_xyzs():
        columns |= dict(zip(("x", "y", "z"), cloud.xyzs(), strict=True))
    if cloud.has_rgbs():
        colours = np.zeros((cloud.size(), 4), np.uint8)
        colours[:, :3] = cloud.rgbs().T
        columns["rgb"] = colours.view("<u4")[:, 0]
    if cloud.has_normals():
        columns |= dict(zip(("normal_x", "normal_y", "normal_z"), cloud.normals(), strict=True))
    points = np.empty(cloud.size(), [(name, column.dtype.newbyteorder("<")) for name, column in columns.items()])
    for name, column in columns.items():
        points[name] = column
    return points


def _cloud_message(points: np.ndarray, frame: str, utime: int) -> bytes:
    """Return an `lcmt_point_cloud` of records with the fields of ``points``."""
    message = lcmt_point_cloud()
    message.utime, message.frame_name = utime, frame
    message.width, message.height = len(points), 1
    message.point_step, message.row_step = points.itemsize, points.nbytes
    kinds = {code: datatype for datatype, code in _NUMBERS.items()}
    fields: Mapping[str, Any] = points.dtype.fields or {}
    for name, (type, offset, *_) in fields.items():
        field = lcmt_point_cloud_field()
        field.name, field.byte_offset, field.count = name, offset, 1
        field.datatype = kinds[type.str[1:]]
        message.fields.append(field)
    message.num_fields = len(message.fields)
    finite = all(np.isfinite(points[name]).all() for name in ("x", "y", "z") if name in fields)
    message.flags = lcmt_point_cloud.IS_STRICTLY_FINITE if finite else 0
    message.data = points.tobytes()
    message.data_size = len(message.data)
    return bytes(message.encode())
