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

    A function of Drake's does not pickle: it holds a PyCapsule, or is an ``nb_func``. It is sent as an attribute of the
    module that names it, so that scripts that begin with ``from pydrake.all import *`` can send their functions, which
    refer to Drake's ``abs``, ``min`` or ``AddMultibodyPlantSceneGraph``.
    """

    def __init__(self, file: io.BytesIO) -> None:
        super().__init__(file)
        # A metaclass that cannot be imported -> a class of it that can.
        self._bearers: dict[type, type] = {}

    def reducer_override(self, obj: Any) -> Any:
        if obj is dataclasses.MISSING:
            return getattr, (dataclasses, "MISSING")
        if _is_function_of_drake(obj):
            return getattr, (sys.modules[obj.__module__], obj.__name__)
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


def _is_function_of_drake(value: Any) -> bool:
    """Return whether a value is a function of pybind11's or nanobind's that its module has under its name."""
    is_bound = type(value).__name__ == "nb_func" or type(getattr(value, "__self__", None)).__name__ == "PyCapsule"
    return is_bound and getattr(sys.modules.get(value.__module__), value.__name__, None) is value


def dumps(value: Any) -> bytes:
    """Return ``value`` as bytes; `pickle.loads` reads them in any process that can import what ``value`` imports."""
    with io.BytesIO() as file:
        _Pickler(file).dump(value)
        return file.getvalue()
