"""Meshcats whose last reference is given up in the main thread."""

from __future__ import annotations

import os
import sys
import threading
import weakref
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from pydrake.systems.framework import Diagram

if TYPE_CHECKING:
    from pydrake.geometry import Meshcat


@dataclass
class _KeptMeshcat:
    meshcat: Meshcat
    diagrams: list[weakref.ref[Diagram]] = field(default_factory=list)  # that draw into it, and refer to it in C++

    def is_used(self) -> bool:
        self.diagrams = [diagram for diagram in self.diagrams if diagram() is not None]
        # Nobody else refers to it if there are two references: this object's, and the argument.
        return bool(self.diagrams) or sys.getrefcount(self.meshcat) > 2


_meshcats: list[_KeptMeshcat] = []
_meshcats_of_parent: list[_KeptMeshcat] = []  # Their threads do not exist in this process, which cannot end them.


def _leave_to_parent() -> None:
    _meshcats_of_parent.extend(_meshcats)
    _meshcats.clear()


os.register_at_fork(after_in_child=_leave_to_parent)


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
    _meshcats[:] = [each for each in _meshcats if each.is_used()]
    entry = next((each for each in _meshcats if each.meshcat is meshcat), None)
    if entry is None:
        _meshcats.append(entry := _KeptMeshcat(meshcat))
    if diagram is not None:
        entry.diagrams.append(weakref.ref(diagram))
