"""The types of the fields of configurations: looked up, and taken apart."""

from __future__ import annotations

import builtins
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass
from functools import lru_cache
from inspect import get_annotations
from types import UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints


def alternatives(hint: Any) -> tuple[Any, ...]:
    """Return the alternatives of a type: float and NoneType for ``float | None``."""
    return get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)


def is_dataclass_type(hint: Any) -> bool:
    """Return whether a type is a dataclass, not an instance of one."""
    return isinstance(hint, type) and is_dataclass(hint)


def field_types(owner: Any) -> dict[str, Any]:
    """Return the types of the fields that a dataclass or one of Drake's configs is made of, by name; else nothing."""
    if is_dataclass(owner):
        return _dataclass_types(owner if isinstance(owner, type) else type(owner))
    return {item.name: item.type for item in getattr(owner, "__fields__", ())}


@lru_cache(maxsize=1024)
def _dataclass_types(kind: type) -> dict[str, Any]:
    places = {name: base for base in reversed(kind.__mro__) for name in get_annotations(base)}
    return {item.name: _looked_up(item.type, places[item.name]) for item in fields(kind) if item.init}


def _looked_up(annotation: Any, owner: type) -> Any:
    """Return the type that an annotation in a class names."""
    if not isinstance(annotation, str):
        return annotation
    module = sys.modules.get(owner.__module__)
    # Modules import some of these names for their type checker alone.
    names = {**vars(builtins), "Any": Any, "Mapping": Mapping, "Sequence": Sequence, **vars(module or builtins)}
    try:
        return eval(annotation, {}, _Names(names))
    except (TypeError, AttributeError):  # A part of what cannot be looked up.
        return Any


class _Names(dict[str, Any]):
    """The names of a module. In another process, it lacks a notebook's classes: they are of any type there."""

    def __missing__(self, name: str) -> Any:
        return Any


def resolve_types(schema: type) -> None:
    """Replace the names of the types of a dataclass by types, also in the dataclasses of its fields."""
    # Drake's reader needs types; `from __future__ import annotations` leaves their names.
    hints = get_type_hints(schema)
    for item in fields(schema):
        item.type = hints[item.name]
        for part in _parts(item.type):
            if is_dataclass_type(part):
                resolve_types(part)


def _parts(hint: Any) -> Iterator[Any]:
    """Yield a type and its parts: for list[Rock] | None also list[Rock], Rock and None."""
    yield hint
    for argument in get_args(hint):
        yield from _parts(argument)
