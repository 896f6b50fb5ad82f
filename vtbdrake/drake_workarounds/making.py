"""A lock around the making of contexts, without which two threads can wait for each other for ever.

Fault: Drake gives some warnings once, under a lock in C++ (the initialization of a static variable), and pydrake passes
them to Python's `logging`. If two threads come to such a place at once, one holds that lock and waits for the
interpreter, and the other holds the interpreter and waits for that lock. Issue:
https://github.com/RobotLocomotion/drake/issues/19680
"""

from __future__ import annotations

import threading
from contextlib import AbstractContextManager, nullcontext

_MAKING = threading.RLock()
_NOTHING = nullcontext()


def making() -> AbstractContextManager[object]:
    """Return the lock that a thread holds while it makes testbeds and contexts, and begins simulations.

    The main thread waits for the others while they simulate; it holds nothing, as a Ctrl-C could leave that behind.
    """
    return _NOTHING if threading.current_thread() is threading.main_thread() else _MAKING
