"""Courses that were driven or changed by hand, saved as tests: a module for pytest, and a snapshot beside it."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vtbdrake.recording.log_format import installed_versions
from vtbdrake.rollout.course import Course, DrivenRollout, task_without_problem
from vtbdrake.rollout.named_function import is_named
from vtbdrake.state import Snapshot
from vtbdrake.state.archive import whole_file
from vtbdrake.state.declarations import PARAMETER
from vtbdrake.state.variables import A, X
from vtbdrake.testbed.scenario_file import scenario_of_text
from vtbdrake.testbed.scenario_text import scenario_text

if TYPE_CHECKING:
    from vtbdrake.rollout import Quality, RolloutResult, RolloutTask
    from vtbdrake.testbed import Scenario, VirtualTestbed

# The lines of a test that expect values of variables.
_CHECKS_OF_VALUES = """\
values = driven.read(list(EXPECTED))
for address, expected in EXPECTED.items():
    assert values[address] == pytest.approx(expected, rel=TOLERANCE, abs=TOLERANCE), address"""


class SavedCourseError(ValueError):
    """A course cannot be saved as a test."""


def drive_again(
    scenario: str,
    text: str,
    *,
    start: Path,
    step: float,
    parameters: Mapping[str, Any],
    writes: Sequence[tuple[int, Mapping[str, Any]]],
    steps: int | None,
    **task: Any,
) -> DrivenRollout:
    """Compute a saved course with the testbed of today, and return the rollout where it ends.

    The state comes from the snapshot. Parameters (masses, gains, frictions) come from today's testbed, except the ones
    that somebody had changed before the course was saved: so a change of the model is a change of the course.

    Args:
        scenario: ``package.module:Class``.
        text: Its fields, as YAML.
        start: The file of the snapshot.
        step: See `Course`.
        parameters: The parameters that had been changed, by address.
        writes: See `Course`.
        steps: See `Course`.
        task: Fields of the `RolloutTask`; none for a course without a problem.

    Raises:
        ValueError: The scenario, its snapshot or an address does not exist any more.
    """
    built = scenario_of_text(scenario, text).build()
    assert built.scenario is not None
    stated = replace(task_without_problem(built.scenario), **task)
    begin = _with_parameters_of_today(Snapshot.load(start), built)
    return _as_saved(Course(begin, step, writes, steps), parameters).driven(stated, testbed=built)


def _as_saved(course: Course, parameters: Mapping[str, Any]) -> Course:
    """Return the course that sets changed parameters before anything else."""
    writes = dict(course.writes)
    if first := {**parameters, **writes.pop(0, {})}:
        writes = {0: first, **writes}
    return replace(course, writes=tuple(writes.items()))


def _with_parameters_of_today(snapshot: Snapshot, testbed: VirtualTestbed) -> Snapshot:
    today = testbed.snapshot(testbed.default_context())
    values = {a: value for a, value in today.values.items() if testbed.variables()[a].kind == A}
    groups = {key: group for key, group in today.groups.items() if _is_parameter(key)}
    return Snapshot(snapshot.time, {**snapshot.values, **values}, {**snapshot.groups, **groups}, snapshot.scenario)


def _is_parameter(group: str) -> bool:
    return group.split("/")[1] == PARAMETER


def _changed_parameters(snapshot: Snapshot, testbed: VirtualTestbed) -> dict[str, Any]:
    """Return the parameters that are not the testbed's defaults, by address.

    Raises:
        SavedCourseError: A parameter without an address has changed.
    """
    context = testbed.default_context()
    default = testbed.snapshot(context).values
    changed = {
        a: snapshot.values[a].tolist()
        for a, v in testbed.variables().items()
        if v.kind == A and not v.derived and not np.array_equal(snapshot.values[a], default[a])
    }
    testbed.write(context, changed)
    rebuilt = testbed.snapshot(context).groups
    for key, group in snapshot.groups.items():
        if _is_parameter(key) and not np.allclose(group, rebuilt[key], rtol=1e-9, atol=1e-12, equal_nan=True):
            raise SavedCourseError(f"the parameters {key} have changed, but have no address: no test can set them")
    return changed


def save_course(
    path: Path,
    course: Course,
    testbed: VirtualTestbed,
    *,
    task: RolloutTask | None = None,
    addresses: Sequence[str] = (),
    tolerance: float = 1e-6,
    mode: int | None = None,
) -> None:
    """Write a course as a test, NAME.py, and its snapshot, NAME.vtb, beside it.

    The course is computed once, as the test will do it: its quality is what the test expects; without a task, the
    values of variables at its end.

    Args:
        path: The file of the test, test_NAME.py.
        course: The course.
        testbed: A testbed of its scenario.
        task: The task whose quality is expected.
        addresses: The variables whose values are expected; by default all that move in the simulated world.
        tolerance: The relative difference that the test allows.
        mode: Permissions of both files, such as `PRIVATE` of a course that begins in the log of a machine, as far as
            the umask leaves them; by default what the umask leaves.

    Raises:
        SavedCourseError: The name is no test's, a file exists, the scenario or the quality cannot be written into a
            file, or the course fails.
    """
    snapshot_path = path.with_suffix(".vtb")
    _check_files(path, snapshot_path)
    if not 0.0 < tolerance < 1.0:
        raise SavedCourseError(f"the tolerance is a relative difference between 0 and 1, not {tolerance}")
    scenario = _checked_scenario(testbed)
    parameters = _changed_parameters(course.start, testbed)
    begin = _with_parameters_of_today(course.start, testbed)
    driven = _as_saved(replace(course, start=begin), parameters).driven(
        task or task_without_problem(scenario), testbed=testbed
    )
    result = driven.end()
    if result.failed:
        raise SavedCourseError(f"the course fails, so that no test can expect anything of it: {result.message}")
    if task is not None:
        stated, f = _task_code(task)
        imports = ["from vtbdrake.rollout import Quality", f]
        checks = _checks_of_quality(result)
    else:
        expected = {a: np.asarray(v).tolist() for a, v in driven.read(addresses or _moving(testbed)).items()}
        lines = "".join(f"    {address!r}: {value!r},\n" for address, value in expected.items())
        stated, imports, checks = f"EXPECTED = {{\n{lines}}}\n", [], _CHECKS_OF_VALUES
    code = _TEMPLATE.format(
        scenario=scenario.name(),
        time=f"{course.start.time:g}",
        versions=", ".join(f"{name} {version}" for name, version in installed_versions().items()),
        imports="\n".join(sorted(("from vtbdrake.testing.saved_course import drive_again", *imports))) + "\n",
        tolerance=tolerance,
        text=scenario_text(scenario).replace("\\", "\\\\").replace('"""', '\\"""'),
        parameters=_literal(parameters),
        writes="".join(f"    ({n}, {_literal(values)}),\n" for n, values in course.writes),
        stated=stated,
        name=path.stem.removeprefix("test_"),
        snapshot=snapshot_path.name,
        step=course.step,
        steps=course.steps,
        task="\n        **TASK," if task is not None else "",
        checks=textwrap.indent(checks, "    "),
    )
    course.start.save(snapshot_path, mode=mode)
    with whole_file(path, mode=mode) as partial:
        partial.write_text(code, "utf-8")


def _check_files(path: Path, snapshot_path: Path) -> None:
    """Refuse files that pytest would not find, or that would be overwritten."""
    if not re.fullmatch(r"test_[a-z0-9_]+\.py", path.name):
        raise SavedCourseError(
            f"pytest finds a test in test_NAME.py, with small letters, digits and _, not {path.name}"
        )
    for file in (path, snapshot_path):
        if file.exists():
            raise SavedCourseError(f"{file} exists, and is not overwritten: give another name, or remove it")
    if not path.parent.is_dir():
        raise SavedCourseError(f"{path} lies in a folder that does not exist")


def _checked_scenario(testbed: VirtualTestbed) -> Scenario:
    """Return the scenario of a testbed; refuse one that a test cannot import."""
    scenario = testbed.scenario
    if scenario is None or scenario.name().startswith("__main__"):
        raise SavedCourseError("the scenario is of a script or a notebook: a test can only import it from a module")
    return scenario


def _checks_of_quality(result: RolloutResult) -> str:
    """Return the lines of a test that expect the result of a task."""
    end = f"assert result.end == {result.end!r}"
    lines = ["result = driven.end()", end, _approx("result.value", result.value)]
    return "\n".join([*lines, _approx("result.t_star", result.t_star)])


def _moving(testbed: VirtualTestbed) -> list[str]:
    return [a for a, v in testbed.variables().items() if v.kind == X and a.startswith("sim.sys.") and not v.derived]


def _approx(subject: str, value: float) -> str:
    return f"assert {subject} == pytest.approx({value!r}, rel=TOLERANCE, abs=TOLERANCE)"


def _literal(values: Mapping[str, Any]) -> str:
    return repr({address: np.asarray(value).tolist() for address, value in values.items()})


def _task_code(task: RolloutTask) -> tuple[str, str]:
    """Return the code of the fields of a task, and the import of its f."""
    quality = task.quality
    assert quality is not None
    fields: dict[str, Any] = {"horizon": task.horizon, "sample_period": task.sample_period}
    if task.threshold is not None:
        fields["threshold"] = task.threshold
    lines = "".join(f"    {name!r}: {value!r},\n" for name, value in fields.items())
    lines += f'    "quality": {_quality_code(quality)},\n'
    return f"TASK = {{\n{lines}}}\n", f"from {quality.f.__module__} import {quality.f.__qualname__}"


def _quality_code(quality: Quality) -> str:
    f = quality.f
    name = f"{getattr(f, '__module__', '')}:{getattr(f, '__qualname__', '')}"
    if not is_named(name, f) or name.startswith("__main__"):
        raise SavedCourseError(
            f"the quality {quality.name} is a function of a script, a notebook or a lambda: a test can only import one "
            "of a module"
        )
    minimize = ", minimize=True" if quality.minimize else ""
    return f"Quality({f.__qualname__}, of={list(quality.of)!r}, reading={quality.reading!r}{minimize})"


_TEMPLATE = '''"""A course of {scenario}, saved from its live page.

It begins with the snapshot beside this file, at t = {time} s, and sets WRITES: the number of the step, and values by
address. Parameters of the model have today's values, except PARAMETERS. What is expected was computed with
{versions}. There the course repeats to the last bit; with another
processor or Drake the last digits differ, which contacts amplify: TOLERANCE is what may differ, relatively.
"""

from pathlib import Path

import pytest
{imports}
TOLERANCE = {tolerance!r}
SCENARIO = """
{text}"""
PARAMETERS = {parameters}
WRITES = [
{writes}]
{stated}

def test_{name}() -> None:
    driven = drive_again(
        "{scenario}",
        SCENARIO,
        start=Path(__file__).with_name("{snapshot}"),
        step={step!r},
        parameters=PARAMETERS,
        writes=WRITES,
        steps={steps},{task}
    )
{checks}
'''
