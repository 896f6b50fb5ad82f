"""Objects as bytes for other processes, including classes and functions that a notebook or a script defines."""

from __future__ import annotations

import dataclasses
import io
import sys
from typing import Any

import cloudpickle


class _Pickler(cloudpickle.Pickler):
    """The pickler of cloudpickle, extended by classes that are derived from Drake's.

    cloudpickle sends what is defined in ``__main__`` by value, and with a class its metaclass. The metaclass of Drake's
    classes (pybind11's, nanobind's) cannot be imported under its name, and a copy of it is a "metaclass conflict". So
    it is sent as the type of a class that can be imported, for example ``type(LeafSystem)``.

    With a dataclass it sends the fields, in which ``dataclasses.MISSING`` stands for what they do not have. A copy of
    that would be a default: even in the sender, whose class loading gives these fields, no class could derive from it.
    """

    def __init__(self, file: io.BytesIO) -> None:
        super().__init__(file)
        # A metaclass that cannot be imported -> a class of it that can.
        self._bearers: dict[type, type] = {}

    def reducer_override(self, obj: Any) -> Any:
        if obj is dataclasses.MISSING:
            return getattr, (dataclasses, "MISSING")
        if isinstance(obj, type):
            if obj in self._bearers:
                return type, (self._bearers[obj],)
            for base in obj.__mro__:
                if _importable(base) and not _importable(type(base)):
                    self._bearers.setdefault(type(base), base)
        return super().reducer_override(obj)


def _importable(kind: type) -> bool:
    attribute: Any = sys.modules.get(kind.__module__)
    for name in kind.__qualname__.split("."):
        attribute = getattr(attribute, name, None)
    return attribute is kind and kind.__module__ != "__main__"


def dumps(value: Any) -> bytes:
    """Return ``value`` as bytes; `pickle.loads` reads them in any process that can import what ``value`` imports."""
    with io.BytesIO() as file:
        _Pickler(file).dump(value)
        return file.getvalue()
