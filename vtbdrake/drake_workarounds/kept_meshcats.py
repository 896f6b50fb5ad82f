"""How Meshcats end: in the main thread, if they were made there, and never if their own thread has died.

Fault: Drake aborts the process if a Meshcat ends in another thread than the one that made it, and Python's garbage
collector runs in any thread. One message that a Meshcat cannot read ends the thread of its server, and then its
destructor waits for ever. Issue: https://github.com/RobotLocomotion/drake/issues/20889 (threads; for the message there
is none that we know of)
"""

from __future__ import annotations

import atexit
import ctypes
import logging
import os
import sys
import threading
import time
import weakref
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from pydrake.systems.framework import Diagram

if TYPE_CHECKING:
    from pydrake.geometry import Meshcat

DEATH = "the server of the picture (Meshcat) has died, as it does when a program sends it what it cannot read"
"""What people are told."""

# Wall time, in s, in which a thread that is dying has ended, and between two looks at whether it has.
_DEATH_TIME = 1.0
_DEATH_PERIOD = 0.01


@dataclass
class _KeptMeshcat:
    meshcat: Meshcat
    diagrams: list[weakref.ref[Diagram]] = field(default_factory=list)  # that draw into it, and refer to it in C++

    def is_used(self) -> bool:
        self.diagrams = [diagram for diagram in self.diagrams if diagram() is not None]
        # Nobody else refers to it if there are two references: this object's, and the argument.
        return bool(self.diagrams) or sys.getrefcount(self.meshcat) > 2


_meshcats: list[_KeptMeshcat] = []
_abandoned = 0  # number of Meshcats that have died, and are never ended
_meshcats_of_parent: list[_KeptMeshcat] = []  # Their threads do not exist in this process, which cannot end them.


def _leave_to_parent() -> None:
    _meshcats_of_parent.extend(_meshcats)
    _meshcats.clear()


os.register_at_fork(after_in_child=_leave_to_parent)


def is_running(meshcat: Meshcat) -> bool:
    """Return whether a Meshcat, made in this thread, still serves its scene.

    A message that it cannot read ends the thread of a Meshcat, whoever has sent it. Then nothing is shown any more, and
    each of its methods raises a RuntimeError.
    """
    try:
        meshcat.port()
    except RuntimeError:
        return False
    return True


class _Obituaries(logging.Filter):
    """Counts the Meshcats whose threads die, by the first and the last thing that such a thread does: it logs."""

    def __init__(self) -> None:
        super().__init__()
        self.dying = self.dead = 0

    def filter(self, record: logging.LogRecord) -> bool:
        text = record.getMessage()
        self.dying += "websocket is stopping via an exception" in text
        self.dead += "websocket thread crashed via an exception" in text
        return True


_obituaries = _Obituaries()
logging.getLogger("drake").addFilter(_obituaries)


def abandon_if_dead(meshcat: Meshcat) -> bool:
    """Let a Meshcat that does not run any more live as long as the process; called just before its last reference goes.

    Its destructor would wait with Python's lock for its thread, which waits for that lock to log that it has died.

    Returns:
        Whether it does not run any more.
    """
    global _abandoned
    limit = time.monotonic() + _DEATH_TIME
    # One is dying that nobody has noticed yet, and it may be this one.
    while is_running(meshcat) and _obituaries.dying > _abandoned and time.monotonic() < limit:
        time.sleep(_DEATH_PERIOD)
    if is_running(meshcat):
        return False
    ctypes.pythonapi.Py_IncRef(ctypes.py_object(meshcat))
    _abandoned += 1
    return True


def _abandon_the_dead() -> None:
    _meshcats[:] = [each for each in _meshcats if not abandon_if_dead(each.meshcat)]


@atexit.register
def _wait_for_the_dead() -> None:
    """Wait for the last words of dead threads: Python ends what asks for its lock later, and they abort the process."""
    _abandon_the_dead()
    limit = time.monotonic() + _DEATH_TIME
    while _obituaries.dead < _abandoned and time.monotonic() < limit:
        time.sleep(_DEATH_PERIOD)


def keep_meshcat(meshcat: Meshcat, diagram: Diagram | None = None) -> None:
    """Keep a Meshcat of the main thread as long as anything uses it, and end those that nothing uses any more.

    Drake aborts the process if a Meshcat ends in another thread than the one that made it. Python's garbage collector
    runs in any thread, and ends what is part of a reference cycle: a testbed, or the variables in the traceback of an
    exception. So the last reference is one here, and the main thread gives it up at the next call. Other threads end
    their Meshcats themselves.

    Args:
        meshcat: A server that the calling thread has made.
        diagram: A diagram that draws into it.
    """
    if threading.current_thread() is not threading.main_thread():
        return
    _abandon_the_dead()
    _meshcats[:] = [each for each in _meshcats if each.is_used()]
    entry = next((each for each in _meshcats if each.meshcat is meshcat), None)
    if entry is None:
        _meshcats.append(entry := _KeptMeshcat(meshcat))
    if diagram is not None:
        entry.diagrams.append(weakref.ref(diagram))
