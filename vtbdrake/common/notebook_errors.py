"""Errors in IPython and Jupyter without the frames of this package, where its message says all."""

from __future__ import annotations

import dis
import sys
from types import TracebackType
from typing import Any

from vtbdrake.common.failures import is_users_code

_RAISE = dis.opmap["RAISE_VARARGS"]


def shorten_tracebacks() -> None:
    """Let the running IPython show an error that the package raises by the lines of the user's code that led to it.

    ``%tb`` shows the whole. Nothing changes where IPython does not run, or has a handler of the user's already
    (``set_custom_exc``).
    """
    from IPython import get_ipython

    shell = get_ipython()
    if shell is not None and not shell.custom_exceptions:
        shell.set_custom_exc((Exception,), _show)


def users_part(error: BaseException) -> TracebackType | None:
    """Return the traceback of an error up to the last line of the user's code, if the package has raised it on purpose.

    It is the whole traceback if no line is the user's, and of an error that comes about inside a function of the
    package: that one may be a fault of the package's.
    """
    entries = []
    entry = error.__traceback__
    while entry is not None:
        entries.append(entry)
        entry = entry.tb_next
    users = [k for k, entry in enumerate(entries) if _is_users_line(entry)]
    if not users or users[-1] == len(entries) - 1 or not _is_raised(entries[-1]):
        return error.__traceback__
    part: TracebackType | None = None
    for entry in reversed(entries[: users[-1] + 1]):
        part = TracebackType(part, entry.tb_frame, entry.tb_lasti, entry.tb_lineno)
    return part


def _is_own(entry: TracebackType) -> bool:
    """Return whether a line is of this package, which code that was made for one of its classes is, too."""
    return str(entry.tb_frame.f_globals.get("__name__", "")).partition(".")[0] == __name__.partition(".")[0]


def _is_users_line(entry: TracebackType) -> bool:
    return is_users_code(entry.tb_frame.f_code.co_filename) and not _is_own(entry)


def _is_raised(entry: TracebackType) -> bool:
    """Return whether a line of this package raises an error, not something that it calls."""
    code = entry.tb_frame.f_code
    # A function in C has no code.
    return _is_own(entry) and entry.tb_lasti < len(code.co_code) and code.co_code[entry.tb_lasti] == _RAISE


def _show(
    shell: Any, kind: type[BaseException], error: BaseException, traceback: TracebackType, tb_offset: int | None = None
) -> None:
    part = users_part(error)
    if part is traceback:
        shell.showtraceback((kind, error, traceback), tb_offset=tb_offset, running_compiled_code=True)
        return
    # What the error came from is told by its message, unless it is the user's own.
    cause, context, suppressed = error.__cause__, error.__context__, error.__suppress_context__
    if not any(_is_users(origin) for origin in (cause, context)):
        error.__cause__, error.__context__ = None, None
    try:
        shell.showtraceback((kind, error, part), tb_offset=tb_offset, running_compiled_code=True)
        print("The lines of vtbdrake are left out: %tb shows them.", file=sys.stderr)
    finally:
        error.__cause__, error.__context__, error.__suppress_context__ = cause, context, suppressed
        sys.last_traceback = traceback  # for %tb


def _is_users(error: BaseException | None) -> bool:
    """Return whether an error comes from the user's code: its innermost line is there."""
    entry = None if error is None else error.__traceback__
    while entry is not None and entry.tb_next is not None:
        entry = entry.tb_next
    return entry is not None and _is_users_line(entry)
