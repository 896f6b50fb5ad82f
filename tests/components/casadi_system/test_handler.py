"""Tests of the compiled parts of a `CasadiSystem`, one by one."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from vtbdrake.components.casadi_system.handler import gather, scatter

ARRAY = np.arange(12.0)


@pytest.mark.parametrize(
    "blocks",
    [
        [ARRAY],
        (ARRAY[:3], ARRAY[5:5], ARRAY[7:9]),
        [ARRAY[::2], ARRAY[::-1]],
        [ARRAY[:2], (0.5,), ARRAY[2:4]],
        [ARRAY[:2], np.arange(3), np.array([True]), np.arange(2.0, dtype=np.float32)],
        [ARRAY[:2].astype(">f8"), ARRAY[:2]],
        [np.frombuffer(b"\0" + ARRAY.tobytes(), np.float64, 12, 1)],
        [()],
    ],
    ids=["one", "several", "strided", "time", "types", "byte order", "unaligned", "nothing"],
)
def test_blocks_are_gathered_as_numpy_concatenates_them(blocks: Any) -> None:
    expected = np.concatenate(blocks).astype(float)
    z = np.full(len(expected) + 2, np.nan)
    gather(blocks, z[1:-1])
    assert np.array_equal(z[1:-1], expected)
    assert np.isnan(z[[0, -1]]).all()


@pytest.mark.parametrize("blocks", [[ARRAY], [ARRAY[:4], ARRAY[:4]], [ARRAY[:2]], [], [ARRAY.reshape(3, 4)]])
def test_blocks_that_do_not_fit_are_refused(blocks: Any) -> None:
    z = np.full(9, np.nan)
    with pytest.raises(ValueError):
        gather(blocks, z[:7])
    assert np.isnan(z[7:]).all()


def test_scattered_blocks_are_the_vector_one_after_the_other() -> None:
    whole = np.full(9, np.nan)
    scatter(ARRAY[:6], [whole[1:4], whole[4:4], whole[5:8]])
    np.testing.assert_array_equal(whole, [np.nan, 0, 1, 2, np.nan, 3, 4, 5, np.nan])


def _read_only() -> Any:
    array = np.zeros(3)
    array.flags.writeable = False
    return array


@pytest.mark.parametrize(
    "block",
    [np.zeros(6)[::2], np.zeros(3, np.float32), np.zeros(3, int), np.frombuffer(bytes(24)), [0.0], None],
    ids=["strided", "floats of 32 bits", "integers", "read-only", "list", "None"],
)
def test_blocks_that_nothing_can_be_scattered_to_are_refused(block: Any) -> None:
    with pytest.raises(ValueError, match="the blocks must be writable"):
        scatter(ARRAY, [block])


def test_nothing_is_scattered_beyond_the_vector() -> None:
    whole = np.full(9, np.nan)
    with pytest.raises(ValueError, match="3 entries at most"):
        scatter(ARRAY[:3], [whole[:2], whole[2:4]])
    assert np.isnan(whole[2:]).all()


@pytest.mark.parametrize("y", [ARRAY[::2], np.arange(3), [0.0], None])
def test_a_vector_that_is_no_array_of_floats_is_not_scattered(y: Any) -> None:
    with pytest.raises(ValueError, match="y must be a contiguous array"):
        scatter(y, [np.zeros(3)])
