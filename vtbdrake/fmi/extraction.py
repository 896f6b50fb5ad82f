"""Folders into which FMUs are extracted; what killed processes leave behind is removed by the next one."""

from __future__ import annotations

import contextlib
import fcntl
import os
import shutil
import tempfile
from pathlib import Path

_PREFIX = "vtbdrake-fmu-"
# A file in each folder, which its process locks.
_LOCK = "lock"


class ExtractionFolder:
    """A temporary folder of this process, empty at first.

    Worker processes are killed, and could not remove their folders: whoever makes another one does.

    Attributes:
        path: The folder.
    """

    def __init__(self) -> None:
        _remove_abandoned()
        self.path = tempfile.mkdtemp(prefix=_PREFIX)
        unlocked = os.path.join(self.path, "unlocked")
        self._lock = os.open(unlocked, os.O_RDWR | os.O_CREAT, 0o600)
        fcntl.flock(self._lock, fcntl.LOCK_EX)
        # Others see it when it is locked.
        os.rename(unlocked, os.path.join(self.path, _LOCK))

    def remove(self) -> None:
        """Remove the folder with all that is in it."""
        shutil.rmtree(self.path, ignore_errors=True)
        os.close(self._lock)


def _remove_abandoned() -> None:
    """Remove the folders whose processes have ended."""
    for folder in Path(tempfile.gettempdir()).glob(f"{_PREFIX}*"):
        with contextlib.suppress(OSError):  # It is in use, or being made or removed.
            if folder.stat(follow_symlinks=False).st_uid != os.getuid():
                continue
            lock = os.open(folder / _LOCK, os.O_RDWR | os.O_NOFOLLOW)
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                shutil.rmtree(folder, ignore_errors=True)
            finally:
                os.close(lock)
