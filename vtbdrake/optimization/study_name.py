"""By which name SQLite opens the file of a study, also where it can write nothing."""

from __future__ import annotations

import os
from pathlib import Path


def sqlite_name(path: Path | None, *, new: bool) -> str:
    """A name for ``sqlite3.connect(..., uri=True)``.

    Args:
        path: None for a study in memory.
        new: it may be to be made.
    """
    if path is None:
        return ":memory:"
    path = path.absolute()
    if new or os.access(path.parent, os.W_OK, effective_ids=True) or _unfinished(path):
        return str(path)
    # SQLite makes files beside one with a write-ahead log even to read it, unless it is told that nobody writes.
    return f"{path.as_uri()}?immutable=1"


def _unfinished(path: Path) -> bool:
    """Whether something lies beside the file that belongs to it."""
    beside = (path.with_name(path.name + end) for end in ("-wal", "-journal"))
    return any(log.exists() and log.stat().st_size > 0 for log in beside)
