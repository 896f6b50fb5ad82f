"""The identity of a problem as plain data, and how another one differs."""

from __future__ import annotations

import hashlib
import inspect
import json
import platform
import subprocess
import sys
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from functools import cache, lru_cache
from importlib.metadata import PackageNotFoundError, version
from math import inf
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.systems.framework import Diagram, System

from vtbdrake.common.argument_checks import check_plain
from vtbdrake.optimization.digest import attributes, digest, is_own
from vtbdrake.optimization.parameter import Choice, Dimension, Parameter
from vtbdrake.optimization.problem import Problem
from vtbdrake.rollout import Constraint, Quality
from vtbdrake.state import Snapshot
from vtbdrake.testbed import Scenario

_PLAIN = (bool, int, float, str, type(None))
_MEASURES = ("qualities", "constraints")
# What belongs to the code of a problem; the name of its s0 there.
_CODE = {"code", "python", "unreadable"}
_S0 = "s0"
_CHANGED = "has other code, or uses other values"


def describe(problem: Problem) -> dict[str, Any]:
    """Return a problem as JSON data.

    ``code`` has the digests of its code and of the values in it, ``python`` the version of Python to which they belong,
    and ``unreadable`` the types of objects whose changes would go unnoticed, by the part that holds them.
    """
    task = problem.task
    unreadable: dict[str, list[str]] = {}
    described = {
        "scenario": check_plain(problem.scenario.record()),
        "parameters": [asdict(parameter) for parameter in problem.parameters],
        "qualities": [_measure(quality, unreadable) for quality in problem.objectives],
        "constraints": [_measure(constraint, unreadable) for constraint in problem.constraints],
        "conditions": [{key: np.asarray(value).tolist() for key, value in c.items()} for c in problem.conditions],
        "risk": _object_text(problem.risk),
        "horizon": float(task.horizon),
        "threshold": repr(inf if task.threshold is None else task.threshold),
        "sample_period": float(task.sample_period),
        "start": "defaults" if task.start is None else _state_digest(task.start),
        "code": _testbed_code(problem, unreadable),
        "python": "{}.{}".format(*sys.version_info),
        "unreadable": unreadable,
    }
    if task.motion is not None:
        described["memory"] = float(task.motion.memory)
    plain: dict[str, Any] = json.loads(json.dumps(described))
    return plain


def plain(values: Mapping[str, Any], noun: str) -> dict[str, Any]:
    """Return values as JSON gives them back.

    Args:
        values: What is to be stored, by name.
        noun: A word for the values in the error.

    Raises:
        ValueError: One is neither a number, nor a word, nor made of these.
    """
    try:
        restored: dict[str, Any] = json.loads(json.dumps(dict(values), default=lambda value: value.tolist()))
    except (AttributeError, TypeError, ValueError) as error:
        raise ValueError(
            f"a study keeps {noun}, which are numbers, words, lists and dicts, not {dict(values)}"
        ) from error
    return restored


def _measure(measure: Quality | Constraint, unreadable: dict[str, list[str]]) -> dict[str, Any]:
    code = _digest(f"the function {measure.name}", measure.f, unreadable)
    about: dict[str, Any] = {"name": measure.name, "of": [*measure.of], "reading": measure.reading, "code": code}
    if isinstance(measure, Quality):
        return {**about, "minimize": measure.minimize, "upper": repr(float(measure.upper))}
    return {**about, "at_most": repr(float(measure.at_most)), "at_least": repr(float(measure.at_least))}


def _object_text(value: Any) -> str:
    """Return the type of an object, and the plain data in it."""
    plain = {name: part for name, part in getattr(value, "__dict__", {}).items() if isinstance(part, _PLAIN)}
    return f"{type(value).__qualname__}({', '.join(f'{name}={part!r}' for name, part in plain.items())})"


def _digest(name: str, value: Any, unreadable: dict[str, list[str]]) -> str:
    text, types = digest(value)
    if types:
        unreadable.setdefault(name, []).extend(types)
    return text


def _testbed_code(problem: Problem, unreadable: dict[str, list[str]]) -> dict[str, str]:
    """Return digests of the user's code in a testbed, with its values, and of the scenario's s0.

    They come from the scenario's class, the risk, the systems and what they hold. s0 depends on the files that the
    scenario reads, too.
    """
    parts: dict[str, list[Any]] = {}

    def add(thing: Any, *values: Any) -> None:
        kind = thing if hasattr(thing, "__qualname__") else type(thing)
        if is_own(kind):
            parts.setdefault(f"{kind.__module__}:{kind.__qualname__}", [kind]).extend(values)

    add(type(problem.scenario))
    add(type(problem.risk), problem.risk)
    for system in _systems(problem.testbed.diagram):
        # Ports, plants and other parts of Drake cannot be read. They follow from the scenario.
        readable = {name: value for name, value in attributes(system).items() if not digest(value)[1]}
        add(type(system), *([readable] if is_own(type(system)) else []))
        for value in readable.values():
            function = getattr(value, "__wrapped__", getattr(value, "func", value))
            if callable(value):
                add(function, value)
    s0 = problem.testbed.snapshot(problem.testbed.default_context())
    code = {name: _digest(name, values, unreadable) for name, values in sorted(parts.items())}
    return {**code, _S0: _state_digest(s0, digits=9)}


def _systems(diagram: Diagram) -> Iterator[System]:
    for system in diagram.GetSystems():
        yield system
        if isinstance(system, Diagram):
            yield from _systems(system)


def _state_digest(state: Snapshot, *, digits: int | None = None) -> str:
    """Return a digest of a state, with ``digits`` decimal digits of each mantissa, or all."""
    digest = hashlib.sha256(repr(state.time).encode())
    for arrays in (state.groups, state.values):
        for name in sorted(arrays):
            array = arrays[name] if digits is None else _rounded(arrays[name], digits)
            digest.update(name.encode() + np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()[:16]


def _rounded(array: np.ndarray, digits: int) -> np.ndarray:
    """Return numbers with this many digits of their mantissa: the last ones differ between processors."""
    if array.dtype.kind != "f":
        return array
    mantissa, exponent = np.frexp(array)
    return np.stack([np.round(mantissa, digits), exponent])


def dimensions(described: Mapping[str, Any]) -> tuple[Dimension, ...]:
    """Return the parameters of a described problem."""
    return tuple(Choice(**data) if "options" in data else Parameter(**data) for data in described["parameters"])


def differences(theirs: Mapping[str, Any], ours: Mapping[str, Any]) -> list[str]:
    """Return the differences of two described problems except for their code, each as a phrase.

    Args:
        theirs: What `describe` returned for the other problem, for instance the one in a file.
        ours: What it returns for this problem.
    """
    phrases = []
    for key in sorted({*theirs, *ours} - _CODE):
        a, b = theirs.get(key), ours.get(key)
        if a == b or (key in _MEASURES and _without_code(a) == _without_code(b)):
            continue
        if isinstance(a, dict) and isinstance(b, dict):
            inner = [k for k in sorted({*a, *b}) if a.get(k) != b.get(k)]
            phrases += [f"{key} {k}: {a.get(k)!r} there, {b.get(k)!r} here" for k in inner]
        else:
            phrases.append(f"{key}: {a!r} there, {b!r} here")
    return phrases


def adds_conditions(theirs: Mapping[str, Any], ours: Mapping[str, Any]) -> bool:
    """Return whether two described problems differ in nothing but further conditions behind theirs, and in code.

    Args:
        theirs: What `describe` returned for the other problem, for instance the one in a file.
        ours: What it returns for this problem.
    """
    count = len(theirs["conditions"])
    same, first = {**theirs, "conditions": ours["conditions"]}, ours["conditions"][:count]
    return not differences(same, ours) and first == theirs["conditions"] and len(ours["conditions"]) > count


def code_changes(theirs: Mapping[str, Any], ours: Mapping[str, Any]) -> list[str]:
    """Return the differences in code of two otherwise equal described problems, each as a phrase.

    Args:
        theirs: What `describe` returned for the other problem, for instance the one in a file.
        ours: What it returns for this problem.
    """
    if theirs.get("python") != ours["python"]:
        return [f"Python {theirs.get('python', '')}, whose code cannot be compared with the code of {ours['python']}"]
    pairs = ((a, b) for key in _MEASURES for a, b in zip(theirs[key], ours[key], strict=True))
    phrases = [f"the function {a['name']} {_CHANGED}" for a, b in pairs if a["code"] != b["code"]]
    there, here = theirs["code"], ours["code"]
    for name in sorted({*there, *here}):
        if there.get(name) != here.get(name):
            how = _CHANGED if name in there and name in here else "is new" if name in here else "is gone"
            part = (
                "the scenario builds another s0, perhaps from a changed file"
                if name == _S0
                else f"{name}, a part of the testbed, {how}"
            )
            phrases.append(part)
    return phrases


def unreadable_text(described: Mapping[str, Any]) -> str:
    """Return a text about changes of a described problem's code that would go unnoticed; empty if none would."""
    parts = [f"{', '.join(types)} (in {name})" for name, types in described.get("unreadable", {}).items()]
    return f"changes would go unnoticed inside objects that cannot be read: {'; '.join(parts)}" if parts else ""


def _without_code(measures: Any) -> list[dict[str, Any]]:
    return [{key: value for key, value in measure.items() if key != "code"} for measure in measures]


def versions() -> dict[str, str]:
    """Return the versions of Python and of the packages on which the numbers depend."""
    packages = ("vtbdrake", "drake", "numpy", "scipy", "cmaes", "cobyqa", "optuna", "casadi")
    by_package = {package: installed for package in packages if (installed := _version(package)) is not None}
    return {"python": platform.python_version(), **by_package}


@cache  # Each takes some milliseconds, and every run of a study asks for all.
def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def revision(scenario: Scenario) -> str:
    """Return the git revision of the folder of the scenario's class, with ``+`` if it was changed.

    Without git it is empty. For a class in a file it is the state at the first time: later changes are not imported.
    """
    try:
        return _revision_of(type(scenario))
    except (OSError, TypeError):  # The class has no file.
        return _revision(Path.cwd())


@lru_cache(maxsize=256)
def _revision_of(kind: type) -> str:
    return _revision(Path(inspect.getfile(kind)).parent)


def _revision(folder: Path) -> str:
    try:
        call = ["git", "-C", str(folder), "describe", "--always", "--abbrev=40", "--exclude=*", "--dirty=+"]
        return subprocess.run(call, capture_output=True, text=True, check=True, timeout=10).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return ""
