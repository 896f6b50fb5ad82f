"""Codecs of values of the usual types: there and back without a bit lost, and what they refuse."""

from dataclasses import dataclass, field
from enum import IntEnum
from functools import cached_property

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.perception import BaseField, Fields, PointCloud
from pydrake.systems.sensors import ImageDepth32F, ImageRgba8U

from vtbdrake.state.codecs import codec_of


@dataclass(frozen=True)
class Track:
    """A result of perception, as a dataclass."""

    points: np.ndarray
    count: int
    age: float
    sure: bool


class Level(IntEnum):
    LOW = 1
    HIGH = 2


def back(model, value):
    codec = codec_of(model)
    return codec.decode({name: np.array(array) for name, array in codec.encode(value).items()})


def test_arrays_keep_their_type():
    value = np.arange(6, dtype=np.int16).reshape(2, 3)
    found = back(np.zeros((2, 3), np.int16), value)
    assert found.dtype == np.int16 and np.array_equal(found, value)


def test_a_pose_keeps_every_bit():
    X_AB = RigidTransform(RollPitchYaw(0.1, -1.2, 2.3), [1 / 3, 2 / 3, 1e-17])
    assert np.array_equal(back(RigidTransform(), X_AB).GetAsMatrix34(), X_AB.GetAsMatrix34())


def test_a_rotation_keeps_every_bit():
    R_AB = RotationMatrix(RollPitchYaw(0.1, -1.2, 2.3))
    assert np.array_equal(back(RotationMatrix(), R_AB).matrix(), R_AB.matrix())


@pytest.mark.parametrize("value", ["", "ü\n\0", 7, -0.0, 1 / 3, True])
def test_texts_and_numbers_keep_their_type(value):
    found = back(value, value)
    assert type(found) is type(value) and repr(found) == repr(value)


@pytest.mark.parametrize("fields", [BaseField.kXYZs, BaseField.kXYZs | BaseField.kNormals | BaseField.kRGBs])
def test_a_point_cloud_of_any_size_keeps_every_point(fields):
    cloud = PointCloud(5, Fields(fields))
    cloud.mutable_xyzs()[:] = np.arange(15).reshape(3, 5) / 3
    if cloud.has_rgbs():
        cloud.mutable_rgbs()[:] = np.arange(15).reshape(3, 5)
        cloud.mutable_normals()[:] = -np.arange(15).reshape(3, 5)
    found = back(PointCloud(2, Fields(fields)), cloud)
    assert found.fields() == cloud.fields()
    assert np.array_equal(found.xyzs(), cloud.xyzs())
    if cloud.has_rgbs():
        assert np.array_equal(found.rgbs(), cloud.rgbs()) and np.array_equal(found.normals(), cloud.normals())


@pytest.mark.parametrize("kind", [ImageRgba8U, ImageDepth32F])
def test_an_image_keeps_every_pixel(kind):
    image = kind(7, 5)
    image.mutable_data[:] = np.random.default_rng(0).integers(0, 255, size=image.data.shape)
    found = back(kind(7, 5), image)
    assert type(found) is kind and np.array_equal(found.data, image.data)


def test_a_dataclass_keeps_types_and_lengths_that_vary():
    found = back(Track(np.zeros((0, 3)), 0, 0.0, False), Track(np.ones((4, 3)), 4, 1 / 3, True))
    assert np.array_equal(found.points, np.ones((4, 3)))
    assert (found.count, found.age, found.sure) == (4, 1 / 3, True)
    assert [type(x) for x in (found.count, found.age, found.sure)] == [int, float, bool]


@dataclass
class Mixed:
    """Fields whose defaults have another type than later values, as people write them."""

    total: float = 0
    flag: int = False
    level: Level = Level.LOW
    points: np.ndarray = field(default_factory=lambda: np.zeros(2))


@pytest.mark.parametrize("total", [1 / 3, -0.0, 7, True, np.float32(0.1), np.uint64(2**63 + 1)])
def test_a_field_keeps_numbers_of_another_type_than_its_default(total):
    found = back(Mixed(), Mixed(total, 3, Level.HIGH))
    assert type(found.total) is type(total) and repr(found.total) == repr(total)
    assert found.flag == 3 and type(found.level) is Level and found.level is Level.HIGH


@dataclass
class Longer(Mixed):
    """A subclass, with a field more."""

    age: float = 0.0


def tagged():
    value = Mixed()
    value.tag = 1.0
    return value


@pytest.mark.parametrize(
    ("value", "told"),
    [
        (Mixed(None), "the field total of a Mixed: a number of at most 64 bits is expected here, not None"),
        (Mixed("1.5"), "the field total of a Mixed: a number of at most 64 bits is expected here, not '1.5'"),
        (Mixed(1 << 70), "the field total of a Mixed: a number of at most 64 bits"),
        (Mixed(np.ones(1)), "the field total of a Mixed: a number of at most 64 bits is expected here, not array"),
        (Mixed(points=None), "the field points of a Mixed: an array of numbers is expected here, not None"),
        (Mixed(points=[1.0]), "the field points of a Mixed: an array of numbers is expected here, not [1.0]"),
        (Longer(), "a Mixed is expected here, not Longer("),
        (None, "a Mixed is expected here, not None"),
        (tagged(), "the attribute tag of a Mixed would be lost: make it a field"),
    ],
)
def test_a_dataclass_that_would_not_come_back_is_refused(value, told):
    with pytest.raises(ValueError) as error:
        codec_of(Mixed()).encode(value)
    assert told in str(error.value)


@dataclass
class Lazy:
    """Attributes beside the fields that can be computed again."""

    side: float = 1.0

    def __post_init__(self):
        self.double = 2.0 * self.side

    @cached_property
    def area(self):
        return self.side**2


def test_attributes_that_are_computed_again_are_no_fields():
    value = Lazy(3.0)
    assert value.area == 9.0
    found = back(Lazy(), value)
    assert (found.side, found.double, found.area) == (3.0, 6.0, 9.0)


@dataclass
class Counted:
    count: int = field(default=0, init=False)


@dataclass
class Named:
    name: str


@pytest.mark.parametrize(
    ("model", "told"),
    [
        ([1.0], "there is no codec for a list"),
        (np.array([None]), "there is no codec for a ndarray"),
        (Named("a"), "there is no codec for a Named: its field name is neither an array nor a number, but a str"),
        (Counted(), "there is no codec for a Counted: its field count is no argument of its constructor"),
        (Track, "there is no codec for a type"),
    ],
)
def test_a_type_without_a_codec_is_refused(model, told):
    with pytest.raises(ValueError) as error:
        codec_of(model)
    assert told in str(error.value)


@pytest.mark.parametrize(
    ("model", "value", "told"),
    [
        (np.zeros(3), np.zeros(2), "an array of shape (3,) is expected here, not one of shape (2,)"),
        (7, 1 << 70, "a number of type int and at most 64 bits is expected here"),
        (7, 7.0, "a number of type int"),
        ("a", 7, "a text is expected here, not 7"),
        (
            PointCloud(1),
            PointCloud(1, Fields(BaseField.kXYZs | BaseField.kRGBs)),
            "a point cloud with xyzs is expected",
        ),
        (ImageRgba8U(4, 3), ImageRgba8U(3, 4), "an image of shape (3, 4, 4) is expected here, not one of shape"),
    ],
)
def test_a_value_of_another_shape_is_refused(model, value, told):
    with pytest.raises(ValueError) as error:
        codec_of(model).encode(value)
    assert told in str(error.value)


@pytest.mark.parametrize("value", [[1.0, 2.0], np.array([None]), 1.0])
def test_array_of_varying_size_holds_numbers_only(value):
    codec = codec_of(np.zeros(3), varying=True)
    assert codec.encode(np.ones((2, 2)))[""].shape == (2, 2)
    with pytest.raises(ValueError, match="an array of numbers is expected here"):
        codec.encode(value)
