"""Recordings of real robots and sensors, which are kept beside the project, not in it."""

from __future__ import annotations

from pathlib import Path

import pytest

_FOLDER = Path(__file__).resolve().parents[2] / "shared" / "real"


def recordings(pattern: str) -> list[Path]:
    """Return the files that match a pattern below the folder of recordings, sorted; skip the test if there are none."""
    paths = sorted(_FOLDER.glob(pattern))
    if not paths:
        pytest.skip(f"no recording of real robots at {_FOLDER / pattern}")
    return paths
