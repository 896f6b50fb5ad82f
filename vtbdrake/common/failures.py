"""Failures that are kept or logged instead of being raised: what counts as one, and its text."""

from __future__ import annotations

import sysconfig
from collections.abc import Callable
from pathlib import Path
from traceback import walk_tb
from typing import Any

# What a simulation or a function of the user can raise: a failed assertion inside Drake arrives as SystemExit.
FAILURES = (Exception, SystemExit)

# Code that is not the user's: this package, the installed ones, and Python's own.
_NOT_THE_USERS = tuple(
    f"{folder}/" for folder in (Path(__file__).parents[1], *map(sysconfig.get_path, ("purelib", "platlib", "stdlib")))
)


def safe_text(value: Any) -> str:
    """Return ``str(value)`` as text that can be stored and printed, also if a method of the user fails in it."""
    return _safe(str, value)


def safe_repr(value: Any) -> str:
    """Return ``repr(value)`` as `safe_text` returns its text: 1.5 and the text '1.5' look different."""
    return _safe(repr, value)


def _safe(text_of: Callable[[Any], str], value: Any) -> str:
    try:
        text = text_of(value)
    except Exception as error:  # Any class can have a faulty __str__ or __repr__.
        text = f"<{type(value).__name__}, whose text raises {type(error).__name__}>"
    # Half of a pair of surrogates has no bytes.
    return text.encode(errors="backslashreplace").decode()


def one_line(error: object) -> str:
    """Return the message of an error, or any text, on one line; of an error without a message its class."""
    if isinstance(error, OSError) and error.filename:
        return f"{error.filename}: {error.strerror}"
    return " ".join(safe_text(error).split()) or type(error).__name__


def is_users_code(file: str) -> bool:
    """Return whether a file of code is the user's, not one of this package, of installed ones, or of Python."""
    return not file.startswith(_NOT_THE_USERS)


def error_text(error: BaseException) -> str:
    """Return class and message of an error on one line, with the last line of the user's code that led to it."""
    text = f"{type(error).__name__}: {one_line(error)}"
    for frame, line in reversed(list(walk_tb(error.__traceback__))):
        file = frame.f_code.co_filename
        if is_users_code(file):
            return f"{text} ({Path(file).name}, line {line})"
    return text
