"""A scan is an immutable value that survives its codec."""

import copy

import numpy as np
import pytest

from vtbdrake.common.scan import Scan
from vtbdrake.state.codecs import codec_of


def scan(n: int, *, stamp: float = 2.0) -> Scan:
    angles = np.linspace(0.0, 1.0, n)
    directions = np.stack([np.cos(angles), np.sin(angles), np.zeros(n)], axis=1)
    return Scan(directions, 1.0 + angles, -angles, stamp)


def test_points_lie_at_their_ranges_along_the_rays() -> None:
    half = np.sqrt(0.5)
    points = Scan(np.array([[1.0, 0, 0], [0, -half, half]]), np.array([2.0, 4.0]), np.zeros(2), 0.0).points()
    np.testing.assert_allclose(points, [[2.0, 0, 0], [0, -4.0 * half, 4.0 * half]], rtol=1e-15)


def test_arrays_cannot_be_changed_from_anywhere() -> None:
    ranges = np.ones(3)
    made = Scan(np.tile([1.0, 0, 0], (3, 1)), ranges, np.zeros(3), 0.0)
    ranges[0] = 5.0
    assert made.ranges[0] == 1.0
    with pytest.raises(ValueError, match="read-only"):
        made.ranges[0] = 5.0


def test_scan_prints_on_one_line() -> None:
    assert repr(scan(700)) == "Scan(700 returns, complete at 2 s)"


def test_copies_share_the_scan() -> None:
    made = scan(3)
    assert copy.deepcopy(made) is made


@pytest.mark.parametrize("n", [0, 7])
def test_codec_carries_scans_of_any_size(n: int) -> None:
    codec = codec_of(Scan.empty(), varying=True)
    back = codec.decode({name: np.array(array) for name, array in codec.encode(scan(n)).items()})
    assert isinstance(back, Scan)
    for name in ("directions_L", "ranges", "times"):
        np.testing.assert_array_equal(getattr(back, name), getattr(scan(n), name))
    assert back.stamp == 2.0


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"ranges": [1.0, np.nan]}, "finite"),
        ({"ranges": [1.0, 0.0]}, "positive"),
        ({"times": [0.0, 0.1]}, "before the scan's stamp"),
        ({"times": [0.0]}, r"shape \(2,\), not \(1,\)"),
        ({"directions_L": [[1.0, 0, 0], [1.0, 1.0, 0]]}, "length 1, not 1.41421"),
        ({"stamp": np.inf}, "finite time"),
    ],
)
def test_impossible_scans_are_refused(changed: dict, message: str) -> None:
    values = {"directions_L": [[1.0, 0, 0]] * 2, "ranges": [1.0, 1.0], "times": [0.0, 0.0], "stamp": 0.0} | changed
    with pytest.raises(ValueError, match=message):
        Scan(**values)
