"""Checks of arguments, with errors where the arguments are given."""

from __future__ import annotations

import inspect
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from vtbdrake.common.failures import FAILURES, safe_repr
from vtbdrake.common.suggestions import did_you_mean


def as_number(name: str, value: Any) -> float:
    """Return ``value`` as a float; raise a ValueError if it is no number (a text is none, nor is True).

    Args:
        name: The argument's name, for the error message.
        value: The value that the caller gave.
    """
    if not isinstance(value, str | bytes | bool):
        try:
            return float(value)
        except (TypeError, ValueError):
            pass
    raise ValueError(f"{name} must be a number, not {value!r}")


def as_result(value: Any) -> float:
    """Return the result of a user's function as a float; True counts as 1.

    Args:
        value: A number, or an array of one number.

    Raises:
        ValueError: It is no real number: None, a text (also of a number), an array of several. The message goes on
            after the name of the function.
    """
    if isinstance(value, float):
        return float(value)
    has_one = isinstance(value, np.ndarray) and value.size == 1 and not np.ma.is_masked(value)
    number = value.item() if has_one else value
    if not isinstance(number, str | bytes | bytearray | np.ndarray | np.timedelta64):
        try:
            return float(number)
        except FAILURES:
            pass
    is_array = isinstance(number, np.ndarray) and number.size != 1
    said = f"an array of shape {number.shape}" if is_array else safe_repr(value)
    raise ValueError(f"must return a real number, not {said}")


def as_whole(name: str, value: Any) -> int:
    """Return ``value`` as an int; raise a ValueError if it is no whole number (1e4 is one, 1.5 is none).

    Args:
        name: The argument's name, for the error message.
        value: The value that the caller gave.
    """
    if not as_number(name, value).is_integer():
        raise ValueError(f"{name} must be a whole number, not {value!r}")
    return int(value)


def as_array(name: str, value: Any) -> np.ndarray:
    """Return ``value`` as an array of floats; raise a ValueError if it is no array of real numbers.

    A text is none, nor has an array numbers where it is masked.

    Args:
        name: The argument's name, for the error message.
        value: A number, or several in any shape.
    """
    try:
        array = np.asarray(value)
    except ValueError:  # A ragged list.
        array = np.array(None)
    is_masked = isinstance(value, np.ma.MaskedArray) and np.ma.is_masked(value)
    if array.dtype.kind not in "biuf" or is_masked:
        raise ValueError(f"{name} must be a number or several, not {value!r}")
    return array.astype(float)


def as_flag(name: str, value: Any) -> bool:
    """Return ``value``; raise a ValueError if it is neither True nor False (the text "no" would count as true).

    Args:
        name: The argument's name, for the error message.
        value: The value that the caller gave.
    """
    if not isinstance(value, bool):
        raise ValueError(f"{name} must be True or False, not {value!r}")
    return value


def as_addresses(name: str, values: Any) -> tuple[str, ...]:
    """Return one address, or several, as a tuple.

    Args:
        name: The argument's name, for the error message.
        values: The address, or the addresses.

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


def check_takes(function: Any, arguments: Sequence[str], *, name: str) -> None:
    """Raise an error unless a value is a function that takes this number of arguments.

    Args:
        function: What is called; of functions in C that do not tell their arguments, nothing is refused.
        arguments: What it is called with, in words.
        name: What it is, for error messages.

    Raises:
        ValueError: It is no function, or takes another number of values.
    """
    values = ", ".join(arguments)
    if not callable(function):
        raise ValueError(f"{name} is a function of {values}, not {function!r}")
    try:
        # The arguments of a decorated function itself, not of the function in it.
        signature = inspect.signature(function, follow_wrapped=False)
    except (ValueError, TypeError):
        return
    try:
        signature.bind(*arguments)
    except TypeError:
        called = getattr(function, "__name__", type(function).__name__)
        raise ValueError(
            f"{name} is called with {counted(len(arguments), 'value')} ({values}), but {called} takes {signature}"
        ) from None


def counted(number: int, noun: str) -> str:
    """Return a number with its noun, such as 1 recording or 2 recordings.

    Args:
        number: How many there are.
        noun: The noun in the singular, with a regular plural.
    """
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def suggestion(address: str, addresses: Iterable[str]) -> str:
    """Return the end of an error message that suggests addresses similar to ``address``.

    Args:
        address: The address that does not exist.
        addresses: The addresses that do; if none is similar, the message names their beginnings.
    """
    addresses = list(dict.fromkeys(addresses))  # A variable and an output port may share an address.
    if near := did_you_mean(address, addresses):
        return near
    tops = sorted({".".join(name.split(".")[:2]) for name in addresses})
    return "; addresses begin with " + ", ".join(tops) if tops else ""
