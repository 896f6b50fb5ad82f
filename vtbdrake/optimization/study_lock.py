"""Who runs a study: one process at a time."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from vtbdrake.optimization.study_error import StudyError


@contextmanager
def claim(path: Path | None) -> Iterator[None]:
    """Holds the lock of a study; the system gives it up when the process dies, however it dies.

    It is a file of its own: to close any handle of the study itself would give up SQLite's locks on it.
    """
    if path is None:
        yield
        return
    lock = path.with_name(path.name + "-lock")
    while True:
        try:
            handle = os.open(lock, os.O_CREAT | os.O_RDWR)
        except OSError as error:
            raise StudyError(f"the study {path} cannot be run, for its lock cannot be made: {error}") from error
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            os.close(handle)
            raise StudyError(
                f"the study {path} is being run by another process: wait for it, or give points to it with `add`"
            ) from error
        try:
            if os.path.samestat(os.fstat(handle), os.stat(lock)):
                break
        except FileNotFoundError:
            pass
        os.close(handle)  # The one who had it has removed it meanwhile.
    try:
        yield
    finally:
        lock.unlink(missing_ok=True)
        os.close(handle)
