"""Arrays on disk: they have all rows, wherever these lie."""

from __future__ import annotations

from io import FileIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from vtbdrake.recording.disk_array import DiskArray


@pytest.fixture(autouse=True)
def few_together(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vtbdrake.recording.disk_array.ROWS_TOGETHER", 4)


def filled(folder: Path, rows: np.ndarray) -> np.ndarray:
    kept = DiskArray(rows.dtype, rows.shape[1:], folder)
    for begin in range(0, len(rows), 3):
        kept.append(rows[begin : begin + 3])
    return kept.array()


@pytest.mark.parametrize("count", [0, 1, 6, 7, 100])
@pytest.mark.parametrize("shape", [(), (4,)])
def test_rows_are_those_appended(tmp_path: Path, count: int, shape: tuple[int, ...]) -> None:
    rows = np.random.default_rng(0).integers(-(2**62), 2**62, (count, *shape))
    assert np.array_equal(filled(tmp_path, rows), rows) and filled(tmp_path, rows).shape == rows.shape
    assert not filled(tmp_path, rows).flags.writeable


def test_a_folder_that_is_not_there_is_replaced(tmp_path: Path) -> None:
    assert np.array_equal(filled(tmp_path / "none", np.arange(10.0)), np.arange(10.0))


@pytest.mark.parametrize("writes", [0, 1, 3])
def test_without_space_rows_stay_in_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, writes: int
) -> None:
    left = [writes]

    class FullFile(FileIO):
        def write(self, data: Any) -> int:
            left[0] -= 1
            return super().write(data if left[0] >= 0 else data[:5])

    monkeypatch.setattr("vtbdrake.recording.disk_array.FileIO", FullFile)
    assert np.array_equal(filled(tmp_path, np.arange(61)), np.arange(61))
    assert caplog.text.count("stays in memory: the disk is full") == 1
