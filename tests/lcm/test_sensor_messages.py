"""Images and point clouds travel as Drake's own systems send them."""

from __future__ import annotations

import random
import tracemalloc
import zlib
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from drake import lcmt_image, lcmt_image_array, lcmt_point_cloud
from pydrake.common.value import Value
from pydrake.lcm import DrakeLcm
from pydrake.perception import BaseField, Fields, PointCloud, PointCloudToLcm
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, System
from pydrake.systems.lcm import LcmPublisherSystem
from pydrake.systems.primitives import ConstantValueSource
from pydrake.systems.sensors import (
    ImageBgr8U,
    ImageDepth16U,
    ImageDepth32F,
    ImageGrey8U,
    ImageLabel16I,
    ImageRgb8U,
    ImageRgba8U,
    ImageToLcmImageArrayT,
)

from vtbdrake.common.scan import Scan
from vtbdrake.control.received_signal import ReceivedSignal
from vtbdrake.lcm.lcm_bridge import ChannelReader
from vtbdrake.lcm.maps import LcmMap
from vtbdrake.lcm.sensor_messages import image_array_map, image_map, point_cloud_map, scan_map
from vtbdrake.testbed import Signal

WIDTH, HEIGHT = 6, 4
CHANNEL = "PICTURES"


def sent_by_drake(system: System, values: list[Any], message_type: Any) -> bytes:
    """Return the message that a Drake system publishes at 0.5 s."""
    builder = DiagramBuilder()
    builder.AddSystem(system)
    for port, value in enumerate(values):
        source = builder.AddSystem(ConstantValueSource(Value(value)))
        builder.Connect(source.get_output_port(), system.get_input_port(port))
    bus = DrakeLcm("memq://")
    heard: list[bytes] = []
    bus.Subscribe(CHANNEL, heard.append)
    publisher = LcmPublisherSystem.Make(CHANNEL, message_type, bus, 0.5, use_cpp_serializer=True)
    builder.AddSystem(publisher)
    builder.Connect(system.get_output_port(0), publisher.get_input_port())
    Simulator(builder.Build()).AdvanceTo(0.6)
    while bus.HandleSubscriptions(0):
        pass
    return heard[-1]


def take(map: LcmMap, signals: list[Signal], *messages: bytes) -> dict[str, ReceivedSignal]:
    received = {signal.name: ReceivedSignal() for signal in signals}
    reader = ChannelReader(map, signals, received, 0.1)
    for message in messages:
        reader.receive(CHANNEL, message)
    return received


def noise(image_type: Any) -> Any:
    image = image_type(WIDTH, HEIGHT)
    image.mutable_data[:] = np.random.default_rng(1).integers(0, 200, image.shape)
    return image


def test_images_of_drake_arrive_exactly() -> None:
    types = {"color": ImageRgba8U, "depth": ImageDepth32F, "label": ImageLabel16I}
    images = {name: noise(image_type) for name, image_type in types.items()}
    data = sent_by_drake(ImageToLcmImageArrayT(*types), list(images.values()), lcmt_image_array)
    signals = [Signal(f"camera_{name}", model_value=types[name](WIDTH, HEIGHT)) for name in types]
    received = take(image_array_map(CHANNEL, {f"camera_{name}": name for name in types}), signals, data)
    for name, image in images.items():
        camera = received[f"camera_{name}"]
        np.testing.assert_array_equal(camera.value.data, image.data)
        assert (camera.count, camera.sent) == (1, 0.5)


@pytest.mark.parametrize("compress", [False, True])
def test_images_are_sent_as_drake_sends_them(compress: bool) -> None:
    types = {"color": ImageRgba8U, "depth": ImageDepth32F, "label": ImageLabel16I}
    images = {name: noise(image_type) for name, image_type in types.items()}
    drakes = sent_by_drake(ImageToLcmImageArrayT(*types, compress), list(images.values()), lcmt_image_array)
    map = image_array_map(CHANNEL, {name: name for name in types}, compress=compress)
    signals = [Signal(name, model_value=image_type(WIDTH, HEIGHT)) for name, image_type in types.items()]
    assert map.encoder(signals)(images, 500_000) == drakes


@pytest.mark.parametrize("compress", [False, True])
@pytest.mark.parametrize("image_type", [ImageBgr8U, ImageDepth16U, ImageGrey8U, ImageRgb8U])
def test_sent_image_arrives_exactly(image_type: Any, compress: bool) -> None:
    image, signal = noise(image_type), Signal("camera", model_value=image_type(WIDTH, HEIGHT))
    map = image_map(CHANNEL, "camera", compress=compress)
    received = take(map, [signal], map.encoder([signal])({"camera": image}, 7_000_000))["camera"]
    np.testing.assert_array_equal(received.value.data, image.data)
    assert received.sent == 7.0


def test_image_of_a_single_row_arrives_exactly() -> None:
    image = ImageRgba8U(WIDTH, 1)
    image.mutable_data[:] = np.arange(4 * WIDTH, dtype=np.uint8).reshape(1, WIDTH, 4)
    signal = Signal("camera", model_value=ImageRgba8U(WIDTH, 1))
    map = image_map(CHANNEL, "camera")
    received = take(map, [signal], map.encoder([signal])({"camera": image}, 1))["camera"]
    np.testing.assert_array_equal(received.value.data, image.data)


def test_image_of_another_size_is_not_sent() -> None:
    encode = image_map(CHANNEL, "camera").encoder([camera()])
    with pytest.raises(
        ValueError, match=r"camera on channel PICTURES has images of shape \(4, 6, 4\), not \(6, 4, 4\)"
    ):
        encode({"camera": ImageRgba8U(HEIGHT, WIDTH)}, 1)


def message_of(image: ImageRgba8U) -> lcmt_image:
    message = lcmt_image()
    message.header.utime = 1
    message.width, message.height, message.row_stride = image.width(), image.height(), 4 * image.width()
    message.data = image.data.tobytes()
    message.size = len(message.data)
    message.pixel_format, message.channel_type = lcmt_image.PIXEL_FORMAT_RGBA, lcmt_image.CHANNEL_TYPE_UINT8
    return message


def compress(message: lcmt_image, content: bytes | None = None) -> None:
    message.compression_method = lcmt_image.COMPRESSION_METHOD_ZLIB
    message.data = zlib.compress(message.data if content is None else content)
    message.size = len(message.data)


def camera() -> Signal:
    return Signal("camera", model_value=ImageRgba8U(WIDTH, HEIGHT))


def test_compressed_image_arrives_exactly() -> None:
    image = noise(ImageRgba8U)
    message = message_of(image)
    compress(message)
    received = take(image_map(CHANNEL, "camera"), [camera()], message.encode())["camera"]
    np.testing.assert_array_equal(received.value.data, image.data)


def set_fields(**fields: Any) -> Callable[[lcmt_image], None]:
    def change(message: Any) -> None:
        for name, value in fields.items():
            setattr(message, name, value)

    return change


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (set_fields(width=WIDTH + 1), "size"),
        (set_fields(width=-WIDTH, height=-HEIGHT), "size"),
        (set_fields(row_stride=0), "size"),
        (set_fields(size=10), "size"),
        (set_fields(pixel_format=lcmt_image.PIXEL_FORMAT_BGRA), "type"),
        (set_fields(compression_method=lcmt_image.COMPRESSION_METHOD_JPEG), "compression"),
        (set_fields(compression_method=lcmt_image.COMPRESSION_METHOD_ZLIB), "compression"),
        (lambda message: compress(message, bytes(1_000)), "size"),
    ],
)
def test_image_of_another_kind_is_rejected(change: Callable[[lcmt_image], None], reason: str) -> None:
    message = message_of(noise(ImageRgba8U))
    change(message)
    received = take(image_map(CHANNEL, "camera"), [camera()], message.encode())["camera"]
    assert (received.count, received.rejected) == (0, {reason: 1})


def test_decompression_is_limited() -> None:
    message = message_of(noise(ImageRgba8U))
    compress(message, bytes(50_000_000))
    data = message.encode()
    tracemalloc.start()
    try:
        take(image_map(CHANNEL, "camera"), [camera()], data)
        assert tracemalloc.get_traced_memory()[1] < 1_000_000
    finally:
        tracemalloc.stop()


def test_absent_camera_is_missing() -> None:
    message = lcmt_image_array()
    message.num_images, message.images = 1, [message_of(noise(ImageRgba8U))]
    message.images[0].header.frame_name = "color"
    frames = {"camera": "color", "other": "colour"}
    signals = [camera(), Signal("other", model_value=ImageRgba8U(WIDTH, HEIGHT))]
    received = take(image_array_map(CHANNEL, frames), signals, message.encode())
    assert received["camera"].count == 1
    assert received["other"].rejected == {"missing": 1}


def test_image_signal_needs_a_size() -> None:
    with pytest.raises(ValueError, match=r"signal camera on channel PICTURES needs an image of its size"):
        image_map(CHANNEL, "camera").decoder([Signal("camera", model_value=ImageRgba8U())])


def cloud(points: int) -> PointCloud:
    made = PointCloud(points, Fields(BaseField.kXYZs | BaseField.kRGBs | BaseField.kNormals))
    chance = np.random.default_rng(2)
    made.mutable_xyzs()[:] = chance.normal(size=(3, points))
    made.mutable_normals()[:] = chance.normal(size=(3, points))
    made.mutable_rgbs()[:] = chance.integers(0, 256, (3, points))
    return made


@pytest.mark.parametrize("points", [0, 1, 50])
def test_point_cloud_of_drake_arrives_exactly(points: int) -> None:
    sent = cloud(points)
    data = sent_by_drake(PointCloudToLcm("lidar"), [sent], lcmt_point_cloud)
    received = take(point_cloud_map(CHANNEL, "lidar"), [Signal("lidar", model_value=cloud(0))], data)["lidar"]
    assert (received.count, received.sent) == (1, 0.5)
    for name in ("xyzs", "normals", "rgbs"):
        np.testing.assert_array_equal(getattr(received.value, name)(), getattr(sent, name)())


@pytest.mark.parametrize("points", [0, 1, 50])
def test_point_cloud_is_sent_as_drake_sends_it(points: int) -> None:
    cloud_sent = cloud(points)
    drakes = lcmt_point_cloud.decode(sent_by_drake(PointCloudToLcm("lidar"), [cloud_sent], lcmt_point_cloud))
    encode = point_cloud_map(CHANNEL, "lidar").encoder([Signal("lidar", model_value=cloud(0))])
    ours = lcmt_point_cloud.decode(encode({"lidar": cloud_sent}, 500_000))
    drakes.filler_size, drakes.filler = 0, b""  # Drake aligns the data in the message.
    assert ours.encode() == drakes.encode()


def test_infinite_points_are_sent_and_received() -> None:
    sent = PointCloud(2)
    sent.mutable_xyzs()[:] = [[np.inf, 1.0], [0.0, np.nan], [1.0, 2.0]]
    lidar, map = Signal("lidar", model_value=PointCloud(0)), point_cloud_map(CHANNEL, "lidar")
    data = map.encoder([lidar])({"lidar": sent}, 1)
    assert not lcmt_point_cloud.decode(data).flags & lcmt_point_cloud.IS_STRICTLY_FINITE
    np.testing.assert_array_equal(take(map, [lidar], data)["lidar"].value.xyzs(), sent.xyzs())


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (set_fields(width=51, row_step=51 * 28), "size"),
        (set_fields(width=-50, height=-1), "size"),
        (set_fields(point_step=0, row_step=0), "size"),
        (set_fields(point_step=8, row_step=400), "size"),
        (lambda message: set_fields(name="w")(message.fields[0]), "missing"),
        (lambda message: set_fields(byte_offset=2**31 - 1)(message.fields[0]), "size"),
        (lambda message: set_fields(byte_offset=-4)(message.fields[0]), "size"),
        (lambda message: set_fields(name="y")(message.fields[0]), "type"),
        (lambda message: set_fields(datatype=77)(message.fields[0]), "missing"),
        (lambda message: set_fields(datatype=7)(message.fields[3]), "type"),
    ],
)
def test_inconsistent_point_cloud_is_rejected(change: Callable[[Any], None], reason: str) -> None:
    message = lcmt_point_cloud.decode(sent_by_drake(PointCloudToLcm("lidar"), [cloud(50)], lcmt_point_cloud))
    change(message)
    signals = [Signal("lidar", model_value=cloud(0))]
    received = take(point_cloud_map(CHANNEL, "lidar"), signals, message.encode())["lidar"]
    assert (received.count, received.rejected) == (0, {reason: 1})


def test_point_cloud_signal_needs_a_point_cloud() -> None:
    with pytest.raises(ValueError, match="needs a PointCloud as model_value"):
        point_cloud_map(CHANNEL, "lidar").decoder([camera()])


def scan(*, stamp: float = 3.0) -> Scan:
    chance = np.random.default_rng(4)
    directions = chance.normal(size=(40, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return Scan(directions, chance.uniform(0.5, 30.0, 40), chance.uniform(-0.1, 0.0, 40), stamp)


LASER, LASER_MAP = Signal("laser", model_value=Scan.empty()), scan_map(CHANNEL, "laser")


def test_scan_arrives_in_single_precision() -> None:
    sent = scan()
    received = take(LASER_MAP, [LASER], LASER_MAP.encoder([LASER])({"laser": sent}, 3_000_000))["laser"]
    assert (received.count, received.sent, received.value.stamp) == (1, 3.0, 3.0)
    np.testing.assert_allclose(received.value.points(), sent.points(), rtol=1e-6)
    np.testing.assert_allclose(received.value.times, sent.times, rtol=1e-6)


def test_empty_scan_arrives() -> None:
    data = LASER_MAP.encoder([LASER])({"laser": Scan.empty()}, 1)
    assert take(LASER_MAP, [LASER], data)["laser"].value.ranges.shape == (0,)


def test_points_without_a_return_are_left_out() -> None:
    message = lcmt_point_cloud.decode(LASER_MAP.encoder([LASER])({"laser": scan()}, 1))
    points = np.frombuffer(message.data, np.float32).reshape(-1, 4).copy()
    points[3, 0], points[7, 2], points[9, :3] = np.nan, -np.inf, 0.0
    message.data = points.tobytes()
    received = take(LASER_MAP, [LASER], message.encode())["laser"]
    np.testing.assert_allclose(received.value.points(), np.delete(scan().points(), [3, 7, 9], axis=0), rtol=1e-6)


@pytest.mark.parametrize("time", [1e-3, np.nan])
def test_ray_after_the_stamp_is_rejected(time: float) -> None:
    message = lcmt_point_cloud.decode(LASER_MAP.encoder([LASER])({"laser": scan()}, 1))
    points = np.frombuffer(message.data, np.float32).reshape(-1, 4).copy()
    points[3, 3] = time
    message.data = points.tobytes()
    assert take(LASER_MAP, [LASER], message.encode())["laser"].rejected == {"time": 1}


def test_point_cloud_is_no_scan() -> None:
    data = point_cloud_map(CHANNEL, "lidar").encoder([Signal("lidar", model_value=cloud(0))])({"lidar": cloud(5)}, 1)
    assert take(LASER_MAP, [LASER], data)["laser"].rejected == {"missing": 1}
    with pytest.raises(ValueError, match="needs a Scan as model_value"):
        LASER_MAP.encoder([Signal("laser", model_value=cloud(0))])


@pytest.mark.parametrize("kind", ["images", "cloud", "scan"])
def test_broken_pictures_are_only_counted(kind: str) -> None:
    chance = random.Random(3)
    map: LcmMap
    if kind == "images":
        types = {"color": ImageRgba8U, "depth": ImageDepth32F, "label": ImageLabel16I}
        images = [noise(image_type) for image_type in types.values()]
        good = sent_by_drake(ImageToLcmImageArrayT(*types), images, lcmt_image_array)
        map, signal = image_array_map(CHANNEL, {"camera": "color"}), camera()
    elif kind == "scan":
        good = LASER_MAP.encoder([LASER])({"laser": scan()}, 1)
        map, signal = scan_map(CHANNEL, "camera"), Signal("camera", model_value=Scan.empty())
    else:
        good = sent_by_drake(PointCloudToLcm("lidar"), [cloud(3)], lcmt_point_cloud)
        map, signal = point_cloud_map(CHANNEL, "camera"), Signal("camera", model_value=cloud(0))
    received = ReceivedSignal()
    reader = ChannelReader(map, [signal], {"camera": received}, 0.0)
    for _ in range(5_000):
        data = bytearray(good)
        for _ in range(chance.randrange(1, 6)):
            at = chance.randrange(8, len(data))
            data[at : at + chance.choice((1, 4))] = chance.choice((b"\xff", b"\x7f\xff\xff\xff", b"\0", b"\0\0\0\0"))
        reader.receive(CHANNEL, bytes(data))
    assert received.count + sum(received.rejected.values()) == 5_000
    assert "decode" not in received.rejected
