"""What can be wrong with the file of a study, said so that one knows what to do."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


class StudyError(ValueError):
    """A study file that is no study, is damaged, of another version or of another problem, or cannot be used."""


def damaged(path: Path | None, reason: object) -> StudyError:
    """The error for a file that cannot be made sense of."""
    return StudyError(f"{path} cannot be read ({reason}); it was left as it is: restore it from a copy")


@contextmanager
def explained(path: Path | None) -> Iterator[None]:
    """Raises the errors of SQLite as `StudyError`."""
    try:
        yield
    except sqlite3.ProgrammingError as error:
        raise StudyError(f"the study {path} is closed ({error}): open it again") from error
    except sqlite3.OperationalError as error:
        # What SQLite does not understand, or cannot decode, is not what was written.
        if getattr(error, "sqlite_errorcode", sqlite3.SQLITE_ERROR) == sqlite3.SQLITE_ERROR:
            raise damaged(path, error) from error
        raise StudyError(
            f"{path} cannot be used ({error}); what was recorded is kept: see to the space on its disk, and to the "
            "permissions of the file and its folder"
        ) from error
    except (sqlite3.DatabaseError, UnicodeDecodeError) as error:
        raise damaged(path, error) from error
