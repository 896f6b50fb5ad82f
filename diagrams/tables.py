"""Common parts of the tables of answers and of benchmarks: the choice of the rows to run, and the file of results."""

from __future__ import annotations

import importlib
import json
import sys
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np

from vtbdrake.common.failures import FAILURES, error_text
from vtbdrake.state.archive import whole_file

# Name of a row -> the function that produces it: itself, or as "package.module:function", imported when it is its turn.
Registry = Mapping[str, str | Callable[..., Any]]


@dataclass(frozen=True)
class Crash:
    """A row that is not there, because its function raised."""

    name: str
    error: BaseException

    def __str__(self) -> str:
        return error_text(self.error)


def selected_names(registry: Registry, only: Sequence[str]) -> list[str]:
    """Return the names to run, in the order of the registry; all of them if ``only`` is empty.

    Raises:
        ValueError: A name is unknown.
    """
    unknown = [name for name in only if name not in registry]
    if unknown:
        raise ValueError(f"there is no {', '.join(unknown)}; known are: {', '.join(registry)}")
    return [name for name in registry if not only or name in only]


def run(registry: Registry, name: str, *arguments: Any) -> Any:
    """Return the result of the function ``name``, or a `Crash` whose traceback goes to stderr: the others still run."""
    try:
        return _function(registry[name])(*arguments)
    except FAILURES as error:
        traceback.print_exc(file=sys.stderr)
        return Crash(name, error)


def _function(entry: str | Callable[..., Any]) -> Callable[..., Any]:
    if not isinstance(entry, str):
        return entry
    module, _, function = entry.partition(":")
    loaded: Callable[..., Any] = getattr(importlib.import_module(module), function)
    return loaded


def write_json(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write a JSON list of objects, completely or not at all; infinite values and NaN become null."""
    with whole_file(path) as partial:
        partial.write_text(json.dumps([_plain(dict(row)) for row in rows], indent=2, allow_nan=False) + "\n")


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return None if isinstance(value, float) and not isfinite(value) else value
