"""Reading data sets of LeRobot, version 3.0, as tables."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vtbdrake.recording import lerobot_format as layout
from vtbdrake.recording.log_format import LogError
from vtbdrake.recording.parquet_reader import ParquetTable

_NO_NUMBERS = ("image", "video", "string")
"""Kinds of features that a table of numbers has not."""


class LeRobotTable(Mapping[str, Any]):
    """The columns of a data set of LeRobot, all episodes one after the other: numbers (n,), or (n, k).

    Beside the features, ``time`` is the time in the episode in s, exactly ``frame_index`` / fps, and
    ``feature.entry`` is an entry of a feature whose entries have names.

    Args:
        path: The folder of the set.

    Raises:
        LogError: The set has another version, or lacks a file.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        info = self._json(layout.INFO)
        version = info.get("codebase_version")
        if version != layout.VERSION:
            raise LogError(
                f"{path} is a data set of LeRobot {version}, not {layout.VERSION}: convert it with lerobot "
                "(python -m lerobot.datasets.v30.convert_dataset_v21_to_v30)"
            )
        try:
            self._fps = float(info["fps"])
            features = {name: feature["dtype"] for name, feature in info["features"].items()}
            self._entries = {
                f"{name}.{entry}": (name, k)
                for name, feature in info["features"].items()
                for k, entry in enumerate(_entry_names(feature.get("names")))
                if feature["dtype"] not in _NO_NUMBERS
            }
        except (KeyError, TypeError, ValueError) as error:
            raise LogError(f"{path / layout.INFO} does not describe a data set of LeRobot: {error!r}") from error
        self._names = [name for name, dtype in features.items() if dtype not in _NO_NUMBERS]
        self._files = [ParquetTable(file) for file in sorted((path / "data").glob("*/*.parquet"))]
        self._check_files(int(info.get("total_frames", 0)))
        left_out = [name for name, dtype in features.items() if dtype in _NO_NUMBERS]
        self.remarks = [f"{path}: {', '.join(left_out)}: images and texts are left out"] if left_out else []

    def _json(self, name: str) -> dict[str, Any]:
        try:
            content: dict[str, Any] = json.loads((self._path / name).read_text("utf-8"))
        except (OSError, ValueError) as error:
            raise LogError(f"{self._path} is no data set of LeRobot: {name} cannot be read: {error}") from error
        if not isinstance(content, dict):
            raise LogError(f"{self._path} is no data set of LeRobot: {name} holds no object")
        return content

    def _check_files(self, total: int) -> None:
        rows = sum(file.rows for file in self._files)
        if rows != total:
            raise LogError(
                f"{self._path} is incomplete: {layout.INFO} tells of {total} rows, and the {len(self._files)} files in "
                f"data have {rows}"
            )

    def __getitem__(self, name: str) -> NDArray[Any]:
        if name == "time":
            return np.asarray(self["frame_index"] / self._fps)
        if name in self._entries:
            feature, k = self._entries[name]
            return self[feature].reshape(len(self[feature]), -1)[:, k]
        if name not in self._names:
            raise KeyError(name)
        return np.concatenate([file[name] for file in self._files])

    def __iter__(self) -> Iterator[str]:
        yield from ("time", *self._names, *self._entries)

    def __len__(self) -> int:
        return sum(1 for _ in self)


def _entry_names(names: Any) -> list[str]:
    """Return the names of the entries of a feature: a list, or, as in older sets, the list of a group."""
    if isinstance(names, Mapping):
        names = next((group for group in names.values() if isinstance(group, list)), None)
    return [str(name) for name in names] if isinstance(names, list) else []
