"""Maps for camera images, as Drake sends them."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from drake import lcmt_image, lcmt_image_array
from pydrake.systems.sensors import (
    ImageBgr8U,
    ImageBgra8U,
    ImageDepth16U,
    ImageDepth32F,
    ImageGrey8U,
    ImageLabel16I,
    ImageRgb8U,
    ImageRgba8U,
)

from vtbdrake.lcm.maps import LcmMap, Reader, Sample
from vtbdrake.lcm.wire import MalformedError, decode
from vtbdrake.testbed import Signal

_FORMATS = {
    ImageBgr8U: (lcmt_image.PIXEL_FORMAT_BGR, lcmt_image.CHANNEL_TYPE_UINT8),
    ImageBgra8U: (lcmt_image.PIXEL_FORMAT_BGRA, lcmt_image.CHANNEL_TYPE_UINT8),
    ImageDepth16U: (lcmt_image.PIXEL_FORMAT_DEPTH, lcmt_image.CHANNEL_TYPE_UINT16),
    ImageDepth32F: (lcmt_image.PIXEL_FORMAT_DEPTH, lcmt_image.CHANNEL_TYPE_FLOAT32),
    ImageGrey8U: (lcmt_image.PIXEL_FORMAT_GRAY, lcmt_image.CHANNEL_TYPE_UINT8),
    ImageLabel16I: (lcmt_image.PIXEL_FORMAT_LABEL, lcmt_image.CHANNEL_TYPE_INT16),
    ImageRgb8U: (lcmt_image.PIXEL_FORMAT_RGB, lcmt_image.CHANNEL_TYPE_UINT8),
    ImageRgba8U: (lcmt_image.PIXEL_FORMAT_RGBA, lcmt_image.CHANNEL_TYPE_UINT8),
}


@dataclass(frozen=True, kw_only=True)
class ImageMap(LcmMap):
    """An `LcmMap` that receives images; `image_map` and `image_array_map` make one. It sends none.

    A signal's ``model_value`` tells pixel type, width and height; an image of another size is rejected (``size``), as
    is one of another pixel type (``type``) or one that is compressed in another way than by zlib (``compression``).

    Attributes:
        select: the images in a message, by signal.
    """

    select: Callable[[Any], Mapping[str, Any]]

    def reader(self, signals: Sequence[Signal]) -> Reader:
        models = {signal.name: signal.model_value for signal in signals}
        for name, model in models.items():
            if type(model) not in _FORMATS or not model.width() * model.height():
                raise ValueError(
                    f"signal {name} on channel {self.channel} needs an image of its size as model_value, such as "
                    f"ImageRgba8U(640, 480), not {model!r}"
                )

        def read(data: bytes) -> Sample:
            message = decode(self.type, data)
            images = self.select(message)
            values = {name: to_image(images[name], model) for name, model in models.items() if name in images}
            return Sample(message.header.utime * 1e-6, values)

        return read


def image_map(channel: str, signal: str) -> ImageMap:
    """A map for one camera that sends `lcmt_image` messages."""
    return ImageMap(channel=channel, type=lcmt_image, signals=[signal], select=lambda message: {signal: message})


def image_array_map(channel: str, frames: Mapping[str, str]) -> ImageMap:
    """A map for `lcmt_image_array` messages, as Drake's `ImageToLcmImageArrayT` makes them.

    Args:
        channel: the channel's name.
        frames: by signal, the ``frame_name`` of its image. A message need not have all of them: a signal whose image is
            not in it counts it as ``missing``.
    """

    def select(message: Any) -> dict[str, Any]:
        found = {image.header.frame_name: image for image in message.images}
        return {signal: found[frame] for signal, frame in frames.items() if frame in found}

    return ImageMap(channel=channel, type=lcmt_image_array, signals=tuple(frames), select=select)


def to_image(message: Any, model: Any) -> Any:
    """The image in an `lcmt_image`, of the type and size of ``model``.

    Raises:
        MalformedError: ``type``, ``size`` or ``compression``, see `ImageMap`.
    """
    image = type(model)(model.width(), model.height())
    pixels = image.mutable_data
    if (message.pixel_format, message.channel_type) != _FORMATS[type(model)]:
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
