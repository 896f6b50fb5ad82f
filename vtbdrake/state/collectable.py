"""What lets the garbage collector free a Diagram with systems in Python (ARCHITECTURE.md, Memory)."""

from __future__ import annotations

import weakref
from collections.abc import Callable
from typing import Any

# The ``__slots__`` of every class that derives from LeafSystem. A dict of its own, beside that of Drake's class, is
# visited twice by the collector (drake 1.51), which then takes it for used from elsewhere. Attributes go into Drake's.
NO_DICT: tuple[str, ...] = ()


def weakly(owner: Any, method: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function that calls ``method(owner, ...)`` and does not keep ``owner`` alive.

    Drake keeps what computes an output port or a cache entry in C++, where Python's garbage collector does not look. A
    bound method there holds its system, which holds the method: neither would ever be freed, nor the Diagram around.
    """
    reference = weakref.ref(owner)

    def call(*arguments: Any) -> Any:
        # The wrapper of a system lives as long as its Diagram does.
        return method(reference(), *arguments)

    return call
