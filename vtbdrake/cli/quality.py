"""The quality of a study, as the command line states it."""

from __future__ import annotations

import importlib
import re
from collections.abc import Callable, Sequence
from typing import Any

import click
import numpy as np

from vtbdrake.rollout import Quality

_FUNCTION = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_]\w*")


def magnitude(value: float | np.ndarray) -> float:
    """f = abs(value); of an array, its largest entry."""
    return float(np.max(np.abs(value)))


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
