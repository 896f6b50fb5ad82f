"""What a study is about, as plain data: enough to tell another problem from the same one."""

from __future__ import annotations

import hashlib
import inspect
import json
import platform
import subprocess
import textwrap
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from math import inf
from pathlib import Path
from types import BuiltinFunctionType, FunctionType, MethodType
from typing import Any

import numpy as np

from vtbdrake.optimization.parameter import Choice, Dimension, Parameter
from vtbdrake.optimization.problem import Problem
from vtbdrake.rollout import Constraint, Quality
from vtbdrake.testbed import Scenario

_PLAIN = (bool, int, float, complex, str, bytes, type(None))
_ARRAYS = (np.generic, np.ndarray)


def describe(problem: Problem) -> dict[str, Any]:
    """A problem as JSON data."""
    task = problem.task
    described = {
        "scenario": problem.scenario.record(),
        "parameters": [_dimension(parameter) for parameter in problem.parameters],
        "qualities": [_measure(quality) for quality in problem.objectives],
        "constraints": [_measure(constraint) for constraint in problem.constraints],
        "conditions": [{key: np.asarray(value).tolist() for key, value in c.items()} for c in problem.conditions],
        "risk": _text(problem.risk),
        "horizon": float(task.horizon),
        "threshold": repr(inf if task.threshold is None else task.threshold),
        "sample_period": float(task.sample_period),
        "start": _start(problem),
    }
    plain: dict[str, Any] = json.loads(json.dumps(described))
    return plain


def plain_options(options: Mapping[str, Any]) -> dict[str, Any]:
    """The options of a solver as they come back from a file.

    Raises:
        ValueError: one is neither a number, nor a word, nor made of these.
    """
    if not isinstance(options, Mapping):
        raise ValueError(f"the options of a solver are given as {{name: value, ...}}, not as {options!r}")
    return plain(options, "the options of its solver")


def plain(values: Mapping[str, Any], what: str) -> dict[str, Any]:
    """Values as they come back from a file.

    Raises:
        ValueError: one is neither a number, nor a word, nor made of these; the error says of ``what``.
    """
    try:
        found: dict[str, Any] = json.loads(json.dumps(dict(values), default=lambda value: value.tolist()))
    except (AttributeError, TypeError, ValueError) as error:
        raise ValueError(
            f"a study keeps {what}, which are numbers, words, lists and dicts, not {dict(values)}"
        ) from error
    return found


def _dimension(dimension: Dimension) -> dict[str, Any]:
    return asdict(dimension)


def _measure(measure: Quality | Constraint) -> dict[str, Any]:
    of = list(measure.of)
    about: dict[str, Any] = {"name": measure.name, "of": of, "reading": measure.reading, "code": _code(measure.f)}
    if isinstance(measure, Quality):
        return {**about, "minimize": measure.minimize, "upper": repr(float(measure.upper))}
    return {**about, "at_most": repr(float(measure.at_most)), "at_least": repr(float(measure.at_least))}


def _code(function: Callable[..., Any]) -> str:
    """A digest of a function: of its source text and of the values that it uses, see `_text`."""
    return hashlib.sha256(_text(function).encode()).hexdigest()[:16]


def _text(value: Any, seen: set[int] | None = None) -> str:
    """The same text for the same value in every process.

    Plain data as they are; functions by their source and by what they use: closure, default values, constants and
    functions of their module; all else by its type and the plain data in it.
    """
    seen = set() if seen is None else seen
    if isinstance(value, np.generic | np.ndarray):
        return repr(value.tolist())
    if isinstance(value, _PLAIN):
        return repr(value)
    parts: Iterable[Any]
    match value:
        case list() | tuple():
            parts = value
        case dict():
            parts = value.items()
        case partial():
            parts = (value.func, value.args, value.keywords)
        case MethodType():
            parts = (value.__func__, value.__self__)
        case FunctionType() if id(value) in seen:
            return value.__qualname__
        case FunctionType():
            seen.add(id(value))
            parts = (_source(value), value.__defaults__, value.__kwdefaults__, _used(value))
        case BuiltinFunctionType() | np.ufunc():
            return value.__name__
        case _:
            plain = {k: v for k, v in getattr(value, "__dict__", {}).items() if isinstance(v, (*_PLAIN, *_ARRAYS))}
            return f"{type(value).__qualname__}({', '.join(f'{k}={_text(v)}' for k, v in plain.items())})"
    return f"{type(value).__name__}({', '.join(_text(part, seen) for part in parts)})"


def _source(function: FunctionType) -> str | tuple[Any, ...]:
    """Its source text; what was typed into an interpreter has none, but it has bytecode."""
    try:
        return textwrap.dedent(inspect.getsource(function))
    except (OSError, TypeError):
        code = function.__code__
        return code.co_code, code.co_consts, code.co_names


def _used(function: FunctionType) -> list[tuple[str, Any]]:
    names, cells = function.__code__.co_freevars, function.__closure__ or ()
    closure = [(name, cell.cell_contents) for name, cell in zip(names, cells, strict=True)]
    found = ((name, function.__globals__.get(name)) for name in function.__code__.co_names)
    return closure + [
        (name, value)
        for name, value in found
        if isinstance(value, (*_PLAIN, *_ARRAYS, tuple))
        or (isinstance(value, FunctionType) and value.__module__ == function.__module__)
    ]


def _start(problem: Problem) -> str:
    start = problem.task.start
    if start is None:
        return "defaults"
    digest = hashlib.sha256(repr(start.time).encode())
    for name in sorted(start.groups):
        digest.update(name.encode() + np.ascontiguousarray(start.groups[name]).tobytes())
    for name in sorted(start.values):
        digest.update(name.encode() + np.ascontiguousarray(start.values[name]).tobytes())
    return digest.hexdigest()[:16]


def dimensions(described: Mapping[str, Any]) -> tuple[Dimension, ...]:
    """The parameters of a described problem."""
    return tuple(Choice(**data) if "options" in data else Parameter(**data) for data in described["parameters"])


def differences(theirs: Mapping[str, Any], ours: Mapping[str, Any]) -> list[str]:
    """In what two described problems differ, each in a phrase."""
    found = []
    for key in sorted({*theirs, *ours}):
        a, b = theirs.get(key), ours.get(key)
        if a == b:
            continue
        if isinstance(a, dict) and isinstance(b, dict):
            inner = [k for k in sorted({*a, *b}) if a.get(k) != b.get(k)]
            found += [f"{key} {k}: {a.get(k)!r} there, {b.get(k)!r} here" for k in inner]
        elif key in ("qualities", "constraints") and _without_code(a) == _without_code(b):
            found.append(f"the function {', '.join(q['name'] for q in ours[key])} has other code, or uses other values")
        else:
            found.append(f"{key}: {a!r} there, {b!r} here")
    return found


def _without_code(measures: Any) -> list[dict[str, Any]]:
    return [{key: value for key, value in measure.items() if key != "code"} for measure in measures]


def versions() -> dict[str, str]:
    """Of what decides about the numbers."""
    found = {"python": platform.python_version()}
    for package in ("vtbdrake", "drake", "numpy", "scipy", "cmaes", "optuna", "casadi"):
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            continue
    return found


def revision(scenario: Scenario) -> str:
    """The git revision of the folder that the scenario's class comes from, ``+`` if it was changed; empty without
    git."""
    try:
        folder = Path(inspect.getfile(type(scenario))).parent
    except (OSError, TypeError):
        folder = Path.cwd()
    try:
        call = ["git", "-C", str(folder), "describe", "--always", "--abbrev=40", "--exclude=*", "--dirty=+"]
        return subprocess.run(call, capture_output=True, text=True, check=True, timeout=10).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return ""
