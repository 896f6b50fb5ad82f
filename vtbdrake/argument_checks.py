"""Checks of arguments, with errors where the arguments are given."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np


def as_number(name: str, value: Any) -> float:
    """Return ``value`` as a float; raise a ValueError if it is no number (a text is none, nor is True)."""
    if not isinstance(value, str | bytes | bool):
        try:
            return float(value)
        except (TypeError, ValueError):
            pass
    raise ValueError(f"{name} must be a number, not {value!r}")


def as_whole(name: str, value: Any) -> int:
    """Return ``value`` as an int; raise a ValueError if it is no whole number (1e4 is one, 1.5 is none)."""
    if not as_number(name, value).is_integer():
        raise ValueError(f"{name} must be a whole number, not {value!r}")
    return int(value)


def as_array(name: str, value: Any) -> np.ndarray:
    """Return ``value`` as an array of floats; raise a ValueError if it is no array of real numbers (a text is none)."""
    try:
        array = np.asarray(value)
    except ValueError:  # A ragged list.
        array = np.array(None)
    if array.dtype.kind not in "biuf":
        raise ValueError(f"{name} must be a number or several, not {value!r}")
    return array.astype(float)


def as_flag(name: str, value: Any) -> bool:
    """Return ``value``; raise a ValueError if it is neither True nor False (the text "no" would count as true)."""
    if not isinstance(value, bool):
        raise ValueError(f"{name} must be True or False, not {value!r}")
    return value


def as_addresses(name: str, values: Any) -> tuple[str, ...]:
    """Return one address, or several, as a tuple.

    Raises:
        ValueError: The argument is neither a string nor an iterable of strings.
    """
    return all_of(str, (values,) if isinstance(values, str) else values, name=name, form="[address, ...]")


def check_plain(record: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return a scenario's record; raise a ValueError if no file can hold a field: one that is no text and no number."""
    for name, value in record.items():
        if not isinstance(value, str | int | float | None):
            raise ValueError(
                f"the scenario's field {name} is a {type(value).__name__}, which no file can hold: make it of numbers, "
                "texts, lists and dataclasses of them"
            )
    return record


def all_of(kind: Any, values: Any, *, name: str, form: str) -> tuple[Any, ...]:
    """Return the values as a tuple, after a check that each is a ``kind``.

    Args:
        kind: The expected type of each value.
        values: The argument to check.
        name: Name of the argument, for error messages.
        form: The expected form of the argument, for error messages.

    Raises:
        ValueError: The argument is not a list, or a value is of another type.
    """
    if not isinstance(values, Iterable) or isinstance(values, str | Mapping):
        raise ValueError(f"give {name} as {form}, not as {values!r}")
    entries = tuple(values)
    for value in entries:
        if not isinstance(value, kind):
            raise ValueError(f"give {name} as {form}; {value!r} does not fit")
    return entries


def counted(number: int, noun: str) -> str:
    """Return a number with its noun, such as 1 recording or 2 recordings."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def suggestion(address: str, addresses: Iterable[str]) -> str:
    """Return the end of an error message that suggests addresses similar to ``address``."""
    addresses = list(dict.fromkeys(addresses))  # A variable and an output port may share an address.
    near = difflib.get_close_matches(address, addresses, n=3, cutoff=0.6)
    if near:
        return "; did you mean " + " or ".join(near) + "?"
    tops = sorted({".".join(name.split(".")[:2]) for name in addresses})
    return "; addresses begin with " + ", ".join(tops) if tops else ""
