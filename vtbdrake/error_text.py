"""The text of an error that is kept or logged instead of being raised."""

from __future__ import annotations

import sysconfig
from pathlib import Path
from traceback import walk_tb
from typing import Any

# Code that is not the user's: this package, the installed ones, and Python's own.
_NOT_THE_USERS = (Path(__file__).parent, *(Path(sysconfig.get_path(name)) for name in ("purelib", "platlib", "stdlib")))


def safe_text(value: Any) -> str:
    """Return ``str(value)`` as text that can be stored and printed, also if a method of the user fails in it."""
    try:
        text = str(value)
    except Exception as error:  # Any class can have a faulty __str__ or __repr__.
        text = f"<{type(value).__name__}, whose text raises {type(error).__name__}>"
    # Half of a pair of surrogates has no bytes.
    return text.encode(errors="backslashreplace").decode()


def error_text(error: BaseException) -> str:
    """Return class and message of an error on one line, with the last line of the user's code that led to it."""
    text = f"{type(error).__name__}: {' '.join(safe_text(error).split()) or type(error).__name__}"
    for frame, line in reversed(list(walk_tb(error.__traceback__))):
        file = Path(frame.f_code.co_filename)
        if not any(file.is_relative_to(folder) for folder in _NOT_THE_USERS):
            return f"{text} ({file.name}, line {line})"
    return text
