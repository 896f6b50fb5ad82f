"""Fresh interpreters that import the same modules as this one: what workers, hubs and machines run in."""

from __future__ import annotations

import os
import sys
from importlib.machinery import PathFinder
from pathlib import Path


def _current_folder() -> str:
    try:
        return os.getcwd()
    except FileNotFoundError:  # It was deleted; nothing can be imported from it.
        return os.sep


# Where relative entries of sys.path (the "" of a notebook, or of `python -c`) pointed to when vtbdrake was imported.
_FIRST_FOLDER = _current_folder()


def command(module: str, *arguments: str) -> list[str]:
    """Return the command that runs ``main()`` of ``module`` in a new process, which ignores Ctrl-C.

    The new process looks for modules where this one does, and gets the same vtbdrake, also after this one has changed
    its current folder. Ctrl-C reaches a whole group of processes at once; this one decides what it means.

    Args:
        module: dotted name of a module of vtbdrake.
        arguments: the new process finds them in ``sys.argv[1:]``.
    """
    program = (
        f"import sys; sys.path[:] = {_search_path()!r}; "
        "import signal; signal.signal(signal.SIGINT, signal.SIG_IGN); "
        f"from {module} import main; main()"
    )
    return [sys.executable, "-c", program, *arguments]


def _search_path() -> list[str]:
    """Return sys.path, with absolute entries only, so that the first vtbdrake in it is that of this process."""
    folders = (_FIRST_FOLDER, _current_folder())
    # What is no text is ignored by imports.
    entries = [entry for entry in sys.path if isinstance(entry, str)]
    path = list(dict.fromkeys(os.path.join(folder, entry) for entry in entries for folder in folders))
    package = Path(__file__).parent
    found = PathFinder.find_spec(package.name, path)
    if found is None or found.origin is None or not package.samefile(Path(found.origin).parent):
        path.insert(0, str(package.parent))
    return path
