"""Codecs of values of the usual types: there and back without a bit lost, and what they refuse."""

from dataclasses import dataclass

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.systems.sensors import ImageDepth32F, ImageRgba8U

from vtbdrake.state.codecs import codec_of


@dataclass(frozen=True)
class Track:
    """What a perception may find."""

    points: np.ndarray
    count: int
    age: float
    sure: bool


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
class Named:
    name: str


@pytest.mark.parametrize(
    ("model", "told"),
    [
        ("text", "there is no codec for a str"),
        (Named("a"), "there is no codec for a Named: its field name is neither an array nor a number, but a str"),
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
        (ImageRgba8U(4, 3), ImageRgba8U(3, 4), "an image of shape (3, 4, 4) is expected here, not one of shape"),
    ],
)
def test_a_value_of_another_shape_is_refused(model, value, told):
    with pytest.raises(ValueError) as error:
        codec_of(model).encode(value)
    assert told in str(error.value)
