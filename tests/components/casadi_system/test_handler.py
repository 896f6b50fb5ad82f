"""What is compiled of a `CasadiSystem`, part by part."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from vtbdrake.components.casadi_system.handler import gather

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
