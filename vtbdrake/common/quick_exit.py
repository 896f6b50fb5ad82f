"""The end of a process without destroying what it has imported, which takes a third as long as to import it."""

from __future__ import annotations

import atexit
import os
import sys
import threading


def quick_exit(code: int = 0) -> None:
    """End this process at once, after the functions that `atexit` knows; return where threads are to be waited for.

    Args:
        code: The exit code.
    """
    threads = [thread for thread in threading.enumerate() if thread is not threading.current_thread()]
    if any(not thread.daemon for thread in threads):
        return
    atexit._run_exitfuncs()
    try:
        for stream in filter(None, (sys.stdout, sys.stderr)):
            stream.flush()
    except (OSError, ValueError):  # Nobody reads it, or it is closed: Python's own end says so.
        return
    os._exit(code)
