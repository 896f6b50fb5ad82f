"""Immutable values: their arrays cannot be changed from anywhere, and all copies are shared."""

import copy
import pickle
from dataclasses import FrozenInstanceError

import numpy as np
import pytest
from numpy.typing import NDArray

from vtbdrake.common.arrays import Array, immutable
from vtbdrake.state.codecs import codec_of


@immutable
class Pose:
    position: Array
    marks: NDArray[np.int64]
    time: float = 0.0

    def __post_init__(self) -> None:
        if self.position.shape != (2,):
            raise ValueError(f"a position has two entries, not the shape {self.position.shape}")


@immutable
class Drive:
    pose: Pose
    speed: float


def pose(**changes):
    return Pose(**{"position": [1, 2], "marks": np.array([3, 4]), **changes})


def test_arrays_become_read_only_and_of_the_value_itself():
    marks = np.array([3, 4])
    value = pose(marks=marks)
    marks[0] = 9
    np.testing.assert_array_equal(value.marks, [3, 4])
    assert value.position.dtype == float and value.marks.dtype == np.int64
    with pytest.raises(ValueError, match="read-only"):
        value.position[0] = 0.0
    with pytest.raises(FrozenInstanceError):
        value.time = 1.0


def test_a_read_only_view_of_what_others_change_is_copied():
    base = np.array([1.0, 2.0])
    view = base[:]
    view.flags.writeable = False
    value = pose(position=view)
    base[0] = 7.0
    np.testing.assert_array_equal(value.position, [1.0, 2.0])


def test_an_array_that_nobody_changes_is_shared():
    first = pose()
    assert pose(position=first.position).position is first.position


def test_deep_copies_are_the_value_and_unpickled_ones_are_read_only():
    value = pose()
    assert copy.deepcopy([value])[0] is value
    again = pickle.loads(pickle.dumps(value))
    np.testing.assert_array_equal(again.position, value.position)
    assert not again.position.flags.writeable and not again.marks.flags.writeable


def test_own_checks_see_the_arrays():
    with pytest.raises(ValueError, match=r"two entries, not the shape \(3,\)"):
        pose(position=[1, 2, 3])


def test_codec_nests_dataclasses():
    codec = codec_of(Drive(pose(), 2.0))
    arrays = codec.encode(Drive(pose(position=[5.0, 6.0], time=0.5), 3.0))
    assert [(name, array.tolist()) for name, array in arrays.items()] == [
        ("pose.position", [5.0, 6.0]),
        ("pose.marks", [3, 4]),
        ("pose.time", 0.5),
        ("speed", 3.0),
    ]
    again = codec.decode(arrays)
    assert (again.speed, again.pose.time, again.pose.position.tolist()) == (3.0, 0.5, [5.0, 6.0])
