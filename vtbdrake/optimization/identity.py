"""What a study is about, as plain data: enough to tell another problem from the same one."""

from __future__ import annotations

import hashlib
import inspect
import json
import platform
import subprocess
import textwrap
from collections.abc import Callable, Mapping
from dataclasses import asdict
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

from vtbdrake.optimization.parameter import Choice, Dimension, Parameter
from vtbdrake.optimization.problem import Problem
from vtbdrake.rollout import Constraint, Quality
from vtbdrake.testbed import Scenario


def describe(problem: Problem) -> dict[str, Any]:
    """A problem as JSON data."""
    task = problem.task
    described = {
        "scenario": problem.scenario.record(),
        "parameters": [_dimension(parameter) for parameter in problem.parameters],
        "qualities": [_measure(quality) for quality in problem.objectives],
        "constraints": [_measure(constraint) for constraint in problem.constraints],
        "conditions": [{key: np.asarray(value).tolist() for key, value in c.items()} for c in problem.conditions],
        "risk": repr(problem.risk),
        "horizon": task.horizon,
        "threshold": repr(task.threshold),
        "sample_period": task.sample_period,
        "start": _start(problem),
    }
    plain: dict[str, Any] = json.loads(json.dumps(described))
    return plain


def _dimension(dimension: Dimension) -> dict[str, Any]:
    return asdict(dimension)


def _measure(measure: Quality | Constraint) -> dict[str, Any]:
    of = list(measure.of)
    about: dict[str, Any] = {"name": measure.name, "of": of, "reading": measure.reading, "code": _code(measure.f)}
    if isinstance(measure, Quality):
        return {**about, "minimize": measure.minimize, "upper": repr(measure.upper)}
    return {**about, "at_most": repr(measure.at_most), "at_least": repr(measure.at_least)}


def _code(function: Callable[..., Any]) -> str:
    """A digest of a function's source text; of what has none, its name."""
    try:
        text = textwrap.dedent(inspect.getsource(function))
    except (OSError, TypeError):
        text = getattr(function, "__qualname__", type(function).__qualname__)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


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
            found.append(f"the function {', '.join(q['name'] for q in ours[key])} has other code")
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
