"""A dictionary of the entries that were used last."""

from __future__ import annotations

from collections import OrderedDict
from typing import TypeVar

K = TypeVar("K")
V = TypeVar("V")


class LruDict(OrderedDict[K, V]):
    """A dictionary of at most ``size`` entries, from which the least recently used one is dropped.

    For what ``functools.lru_cache`` cannot keep: entries that are released when they are dropped, or that are not made
    from their key. `use` and `add` count as uses, other methods do not.
    """

    def __init__(self, size: int) -> None:
        super().__init__()
        self._size = size

    def use(self, key: K) -> V | None:
        """Return the value of a key, which is the last to be dropped now; None if there is no such key."""
        if key in self:
            self.move_to_end(key)
        return self.get(key)

    def add(self, key: K, value: V) -> V | None:
        """Add an entry; return the value of the entry that is dropped for it, or None.

        Args:
            key: The key, which becomes the most recently used one.
            value: The new value of the key.
        """
        self[key] = value
        self.move_to_end(key)
        return self.popitem(last=False)[1] if len(self) > self._size else None
