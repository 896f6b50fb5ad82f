"""The quality and the constraints of a problem, as the command line states them."""

from __future__ import annotations

import importlib
import re
from collections.abc import Callable, Sequence
from typing import Any

import click
import numpy as np

from vtbdrake.rollout import Constraint, Quality

_FUNCTION = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_]\w*")
_CALL = re.compile(rf"({_FUNCTION.pattern})\((.*)\)")


def magnitude(value: float | np.ndarray) -> float:
    """f = abs(value); of an array, its largest entry."""
    return float(np.max(np.abs(value)))


def largest(value: float | np.ndarray) -> float:
    """Return the value; of an array, its largest entry."""
    return float(np.max(value))


def smallest(value: float | np.ndarray) -> float:
    """Return the value; of an array, its smallest entry."""
    return float(np.min(value))


def make_constraint(text: str, *, limit: str) -> Constraint:
    """The constraint that ``limit``, ``at_most`` or ``at_least``, states of ``ADDRESS=NUMBER`` or of a function.

    A function of variables is written ``module:function(ADDRESS,...)=NUMBER``.

    Raises:
        click.BadParameter: it has another form.
        click.UsageError: the function does not exist.
    """
    what, _, number = (part.strip() for part in text.rpartition("="))
    form = "ADDRESS=LIMIT or MODULE:FUNCTION(ADDRESS,...)=LIMIT"
    try:
        limits: dict[str, Any] = {limit: float(number)}
    except ValueError as error:
        raise click.BadParameter(f"it takes {form}, LIMIT a number, not {text!r}") from error
    call = _CALL.fullmatch(what)
    if call is not None:
        of = [address.strip() for address in call[2].split(",") if address.strip()]
        return Constraint(_function(call[1]), of=of, **limits)
    if not what or _FUNCTION.fullmatch(what):
        raise click.BadParameter(f"it takes {form}, not {text!r}")
    return Constraint(largest if limit == "at_most" else smallest, of=what, **limits)


def make_quality(text: str, of: Sequence[str]) -> Quality:
    """``module:function`` of the variables ``of``, or the magnitude of the variable at the address ``text``.

    Raises:
        click.UsageError: the function does not exist, or ``of`` is missing or makes no sense.
    """
    if not _FUNCTION.fullmatch(text):
        if of:
            raise click.UsageError(f"--of belongs to a quality module:function; {text} is an address")
        return Quality(magnitude, of=text)
    if not of:
        raise click.UsageError(f"say with --of ADDRESS of which variables {text} is a function")
    return Quality(_function(text), of=of)


def _function(text: str) -> Callable[..., Any]:
    module_name, _, name = text.partition(":")
    try:
        module = importlib.import_module(module_name)
    except ModuleNotFoundError as error:
        raise click.UsageError(f"cannot import {module_name}, of the quality {text}: {error}") from error
    found = getattr(module, name, None)
    if not callable(found):
        raise click.UsageError(f"{module_name} has no function {name!r}")
    return found
