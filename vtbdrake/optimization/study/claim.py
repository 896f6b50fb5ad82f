"""Which process runs a study: the lock beside its file."""

from __future__ import annotations

import fcntl
import os
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from vtbdrake.optimization.study.study_error import StudyError


def claimed(path: Path | None, use: Callable[[], None]) -> None:
    """Use a study whose lock this process holds meanwhile; the system releases it when the process dies.

    The lock is a separate file: closing any handle of the study itself would release SQLite's locks on it. (A function
    and no context manager, so that Ctrl-C cannot leave it held, wherever it comes.)

    Args:
        path: The study's file; None: it is in memory, and needs no lock.
        use: Called while the lock is held.

    Raises:
        StudyError: Another process holds it, or it cannot be created.
    """
    if path is None:
        use()
        return
    lock = path.with_name(path.name + "-lock")
    handle, is_owner = -1, False
    try:
        while not is_owner:
            if handle >= 0:
                os.close(handle)  # Its former owner has removed the file meanwhile.
            handle = -1
            try:
                handle = os.open(lock, os.O_CREAT | os.O_RDWR)
            except OSError as error:
                raise StudyError(f"the study {path} cannot be run, as its lock cannot be created: {error}") from error
            try:
                _lock_exclusively(handle)
            except BlockingIOError as error:
                raise StudyError(
                    f"the study {path} is being run by another process: wait for it, or give points to it with `add`"
                ) from error
            with suppress(FileNotFoundError):
                is_owner = os.path.samestat(os.fstat(handle), os.stat(lock))
        use()
    finally:
        try:
            if is_owner:
                lock.unlink(missing_ok=True)
        finally:
            if handle >= 0:
                os.close(handle)


def _lock_exclusively(handle: int) -> None:
    """Take the lock, which a process that asks `is_claimed` holds for some microseconds."""
    for _ in range(10):
        with suppress(BlockingIOError):
            return fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        time.sleep(0.005)
    fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)


def is_claimed(path: Path) -> bool:
    """Return whether a process runs the study."""
    try:
        with open(path.with_name(path.name + "-lock")) as lock:
            fcntl.flock(lock, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except FileNotFoundError:
        return False
    except OSError:
        return True
    return False
