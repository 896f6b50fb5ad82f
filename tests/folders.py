"""Folders for tests of what cannot be written."""

from __future__ import annotations

import ctypes
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_CAPABILITY_VERSION_3 = 0x20080522
_CAP_DAC_OVERRIDE = 1 << 1


@contextmanager
def open_folder() -> Iterator[Path]:
    """A folder into which everybody can look, unlike pytest's."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        folder.chmod(0o755)
        yield folder


@contextmanager
def that_cannot_be_written(folder: Path) -> Iterator[None]:
    """Takes away the right to write there for a while, from root, too.

    Root gives up the one capability that lets it write where the mode forbids it. As another user, it could perhaps not
    enter the folder any more from which Python imports.
    """
    folder.chmod(0o555)
    privileged = os.geteuid() == 0
    if privileged:
        _override_modes(False)
    try:
        yield
    finally:
        if privileged:
            _override_modes(True)
        folder.chmod(0o755)


def _override_modes(allowed: bool) -> None:
    """Changes the effective capability CAP_DAC_OVERRIDE of this thread, see capset(2)."""
    libc = ctypes.CDLL(None, use_errno=True)
    header = (ctypes.c_uint32 * 2)(_CAPABILITY_VERSION_3, 0)
    data = (ctypes.c_uint32 * 6)()  # Twice: effective, permitted, inheritable.
    failed = libc.capget(header, data)
    data[0] = data[0] | _CAP_DAC_OVERRIDE if allowed else data[0] & ~_CAP_DAC_OVERRIDE
    if failed or libc.capset(header, data):
        raise OSError(ctypes.get_errno(), "the capabilities of this process")
