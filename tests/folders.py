"""Folders for tests of what cannot be written."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

NOBODY = 65534


@contextmanager
def open_folder() -> Iterator[Path]:
    """A folder into which everybody can look, unlike pytest's."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        folder.chmod(0o755)
        yield folder


@contextmanager
def that_cannot_be_written(folder: Path) -> Iterator[None]:
    """Takes away the right to write there for a while, from root, too."""
    folder.chmod(0o555)
    privileged = os.geteuid() == 0  # To root, such a folder is like any other.
    if privileged:
        os.seteuid(NOBODY)
    try:
        yield
    finally:
        if privileged:
            os.seteuid(0)
        folder.chmod(0o755)
