"""The identity of a problem as plain data, and how another one differs."""

from __future__ import annotations

import hashlib
import inspect
import json
import platform
import subprocess
import sys
import textwrap
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import asdict
from functools import cache, partial
from importlib.metadata import PackageNotFoundError, version
from math import inf
from pathlib import Path
from types import BuiltinFunctionType, CellType, CodeType, FunctionType, MethodType, ModuleType
from typing import Any

import numpy as np
from pydrake.systems.framework import Diagram, System

from vtbdrake.argument_checks import check_plain
from vtbdrake.optimization.parameter import Choice, Dimension, Parameter
from vtbdrake.optimization.problem import Problem
from vtbdrake.rollout import Constraint, Quality
from vtbdrake.testbed import Scenario

_PLAIN = (bool, int, float, complex, str, bytes, type(None))
_ARRAYS = (np.generic, np.ndarray)
_MEASURES = ("qualities", "constraints")


def describe(problem: Problem) -> dict[str, Any]:
    """Return a problem as JSON data."""
    task = problem.task
    described = {
        "scenario": check_plain(problem.scenario.record()),
        "parameters": [asdict(parameter) for parameter in problem.parameters],
        "qualities": [_measure(quality) for quality in problem.objectives],
        "constraints": [_measure(constraint) for constraint in problem.constraints],
        "conditions": [{key: np.asarray(value).tolist() for key, value in c.items()} for c in problem.conditions],
        "risk": _object_text(problem.risk),
        "horizon": float(task.horizon),
        "threshold": repr(inf if task.threshold is None else task.threshold),
        "sample_period": float(task.sample_period),
        "start": _start(problem),
        "code": _classes(problem),
    }
    if task.motion is not None:
        described["memory"] = float(task.motion.memory)
    plain: dict[str, Any] = json.loads(json.dumps(described))
    return plain


def plain(values: Mapping[str, Any], what: str) -> dict[str, Any]:
    """Return values as JSON gives them back.

    Args:
        values: What is to be stored, by name.
        what: A word for the values in the error.

    Raises:
        ValueError: One is neither a number, nor a word, nor made of these.
    """
    try:
        found: dict[str, Any] = json.loads(json.dumps(dict(values), default=lambda value: value.tolist()))
    except (AttributeError, TypeError, ValueError) as error:
        raise ValueError(
            f"a study keeps {what}, which are numbers, words, lists and dicts, not {dict(values)}"
        ) from error
    return found


def _measure(measure: Quality | Constraint) -> dict[str, Any]:
    of = list(measure.of)
    about: dict[str, Any] = {"name": measure.name, "of": of, "reading": measure.reading, "code": _code(measure.f)}
    if isinstance(measure, Quality):
        return {**about, "minimize": measure.minimize, "upper": repr(float(measure.upper))}
    return {**about, "at_most": repr(float(measure.at_most)), "at_least": repr(float(measure.at_least))}


def _code(function: Callable[..., Any]) -> str:
    """Return a digest of a function: of its source text and of the values that it uses, see `_text`."""
    return hashlib.sha256(_text(function).encode()).hexdigest()[:16]


def _text(value: Any, seen: set[int] | None = None) -> str:
    """Return a text of a value that is the same in every process.

    Plain data is written out; functions and classes are given by their source and by everything they refer to:
    closure, default values, and the constants, functions and classes of the user's modules. Everything else is given
    by its type and its plain data.
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
        case FunctionType() | type() if id(value) in seen:
            return value.__qualname__
        case type():
            seen.add(id(value))
            parts = (value.__qualname__, _members(value), [base for base in value.__bases__ if _is_own(base)])
        case CodeType():
            parts = (value.co_code, value.co_consts, value.co_names)
        case FunctionType():
            seen.add(id(value))
            parts = (_source(value), value.__defaults__, value.__kwdefaults__, _used(value))
        case BuiltinFunctionType() | np.ufunc():
            return value.__name__
        case _ if _is_own(type(value)):
            return f"{_object_text(value)} of {_text(type(value), seen)}"
        case _:
            return _object_text(value)
    return f"{type(value).__name__}({', '.join(_text(part, seen) for part in parts)})"


def _object_text(value: Any) -> str:
    """Return the type of an object, and the plain data in it."""
    plain = {k: v for k, v in getattr(value, "__dict__", {}).items() if isinstance(v, (*_PLAIN, *_ARRAYS))}
    return f"{type(value).__qualname__}({', '.join(f'{k}={_text(v)}' for k, v in plain.items())})"


def _source(function: FunctionType) -> str | CodeType:
    """Return the source text of a function, or its code if it was typed into an interpreter."""
    try:
        return textwrap.dedent(inspect.getsource(function))
    except (OSError, TypeError):
        return function.__code__


def _used(function: FunctionType) -> list[tuple[str, Any]]:
    """Return the closure and the globals that a function uses, by name; only data and the user's own code count."""
    names, cells = function.__code__.co_freevars, function.__closure__ or ()
    closure = [(name, _content(cell)) for name, cell in zip(names, cells, strict=True)]
    words = _words(function.__code__)
    found = [(name, function.__globals__[name]) for name in words if name in function.__globals__]
    for name, value in list(found):
        if isinstance(value, ModuleType) and _is_own(value):
            found += [(f"{name}.{word}", vars(value)[word]) for word in words if word in vars(value)]
    return closure + [
        (name, value)
        for name, value in found
        if isinstance(value, (*_PLAIN, *_ARRAYS, tuple))
        or (isinstance(value, FunctionType | type) and (value.__module__ == function.__module__ or _is_own(value)))
    ]


def _words(code: CodeType) -> list[str]:
    """Return the names that a function uses, with those of its inner functions and comprehensions."""
    inner = [word for constant in code.co_consts if isinstance(constant, CodeType) for word in _words(constant)]
    return list(dict.fromkeys([*code.co_names, *inner]))


def _content(cell: CellType) -> Any:
    try:
        return cell.cell_contents
    except ValueError:  # It is not filled yet.
        return None


def _members(kind: type) -> list[tuple[str, Any]]:
    """Return the constants and functions of a class, without what Python has generated."""
    found = []
    for name, member in vars(kind).items():
        for attribute in ("__func__", "fget", "func"):  # Static and class methods, properties, cached properties.
            member = getattr(member, attribute, member)
        generated = isinstance(member, FunctionType) and member.__code__.co_filename == "<string>"
        hidden = name.startswith("__") and not isinstance(member, FunctionType)
        if isinstance(member, (*_PLAIN, *_ARRAYS, FunctionType)) and not generated and not hidden:
            found.append((name, member))
    return found


def _is_own(thing: Any) -> bool:
    """Return whether a module, class or function is the user's: not of Python, of this package, or installed."""
    return _is_own_module(thing.__name__ if isinstance(thing, ModuleType) else str(thing.__module__))


@cache
def _is_own_module(name: str) -> bool:
    if name.partition(".")[0] in (*sys.stdlib_module_names, "vtbdrake"):
        return False
    file = getattr(sys.modules.get(name), "__file__", None)
    return file is None or not {"site-packages", "dist-packages"} & set(Path(file).parts)


def _classes(problem: Problem) -> dict[str, str]:
    """Return digests of the user's code in a testbed: scenario, risk, systems and the functions that they hold."""
    found: dict[str, Any] = {}
    for kind in (type(problem.scenario), type(problem.risk)):
        found[f"{kind.__module__}:{kind.__qualname__}"] = kind
    for system in _systems(problem.testbed.diagram):
        held = [
            value for value in getattr(system, "__dict__", {}).values() if isinstance(value, FunctionType | partial)
        ]
        things: list[Any] = [type(system), *(value.func if isinstance(value, partial) else value for value in held)]
        found |= {f"{thing.__module__}:{thing.__qualname__}": thing for thing in things}
    return {name: _code(thing) for name, thing in sorted(found.items()) if _is_own(thing)}


def _systems(diagram: Diagram) -> Iterator[System]:
    for system in diagram.GetSystems():
        yield system
        if isinstance(system, Diagram):
            yield from _systems(system)


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
    """Return the parameters of a described problem."""
    return tuple(Choice(**data) if "options" in data else Parameter(**data) for data in described["parameters"])


def differences(theirs: Mapping[str, Any], ours: Mapping[str, Any]) -> list[str]:
    """Return the differences of two described problems except for their code, each as a phrase."""
    found = []
    for key in sorted({*theirs, *ours} - {"code"}):
        a, b = theirs.get(key), ours.get(key)
        if a == b or (key in _MEASURES and _without_code(a) == _without_code(b)):
            continue
        if isinstance(a, dict) and isinstance(b, dict):
            inner = [k for k in sorted({*a, *b}) if a.get(k) != b.get(k)]
            found += [f"{key} {k}: {a.get(k)!r} there, {b.get(k)!r} here" for k in inner]
        else:
            found.append(f"{key}: {a!r} there, {b!r} here")
    return found


def code_changes(theirs: Mapping[str, Any], ours: Mapping[str, Any]) -> list[str]:
    """Return the differences in code of two otherwise equal described problems, each as a phrase."""
    pairs = ((a, b) for key in _MEASURES for a, b in zip(theirs[key], ours[key], strict=True))
    found = [
        f"the function {a['name']} has other code, or uses other values" for a, b in pairs if a["code"] != b["code"]
    ]
    there, here = theirs["code"], ours["code"]
    for name in sorted({*there, *here}):
        if there.get(name) != here.get(name):
            how = "has other code" if name in there and name in here else "is new" if name in here else "is gone"
            found.append(f"{name}, a part of the testbed, {how}")
    return found


def _without_code(measures: Any) -> list[dict[str, Any]]:
    return [{key: value for key, value in measure.items() if key != "code"} for measure in measures]


def versions() -> dict[str, str]:
    """Return the versions of Python and of the packages on which the numbers depend."""
    found = {"python": platform.python_version()}
    for package in ("vtbdrake", "drake", "numpy", "scipy", "cmaes", "optuna", "casadi"):
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            continue
    return found


def revision(scenario: Scenario) -> str:
    """Return the git revision of the folder of the scenario's class, with ``+`` if it was changed.

    Without git it is empty.
    """
    try:
        folder = Path(inspect.getfile(type(scenario))).parent
    except (OSError, TypeError):
        folder = Path.cwd()
    try:
        call = ["git", "-C", str(folder), "describe", "--always", "--abbrev=40", "--exclude=*", "--dirty=+"]
        return subprocess.run(call, capture_output=True, text=True, check=True, timeout=10).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return ""
