"""How a study begins, or is resumed: what its file says of its problem, and whether a problem may go on with it."""

from __future__ import annotations

import logging
import os
from collections.abc import Mapping
from typing import Any

import numpy as np

from vtbdrake.common.argument_checks import as_whole
from vtbdrake.optimization.identity import (
    adds_conditions,
    code_changes,
    describe,
    differences,
    plain,
    revision,
    unreadable_text,
    versions,
)
from vtbdrake.optimization.parameter import Choice
from vtbdrake.optimization.problem import Problem
from vtbdrake.optimization.statement import statement
from vtbdrake.optimization.study.study_error import StudyError
from vtbdrake.optimization.study.study_file import StudyFile
from vtbdrake.optimization.study.study_search import StudySearch

_log = logging.getLogger(__name__)


def begin_or_resume(
    problem: Problem,
    path: str | os.PathLike[str] | None,
    requested: Mapping[str, Any],
    *,
    allow_changed_code: bool,
    more_conditions: bool,
) -> StudyFile:
    """Return the file of the study of a problem: a new one, or the one at the path if it is of the same study.

    Args:
        problem: The problem.
        path: Path of the file; None keeps the study in memory.
        requested: ``solver``, ``seed``, ``options`` and ``parallel`` as they were given, see `Study.of`; None: by
            default, or the file's.
        allow_changed_code: Whether to go on although the code of the problem has changed.
        more_conditions: Whether the problem may have further conditions behind the file's.

    Raises:
        ValueError: The solver is unknown, cannot solve the problem, or does not take what is requested.
        StudyError: The file is of another problem, code or solver, is damaged, or of another version.
    """
    ours = _description(problem, requested)
    file = StudyFile(path, meta=ours)
    try:
        theirs = file.meta
        extended = more_conditions and adds_conditions(theirs["problem"], ours["problem"])
        if not extended and (changed := differences(theirs["problem"], ours["problem"])):
            raise StudyError(
                f"{path} is a study of another problem ({'; '.join(changed)}): give another file, or restore the "
                "problem"
            )
        code = code_changes(theirs["problem"], ours["problem"])
        if code and not allow_changed_code:
            raise StudyError(
                f"{path} was made with other code ({'; '.join(code)}): give another file, restore the code, or, if "
                "its rollouts would come out the same, go on with allow_changed_code=True"
            )
        for key, value in requested.items():
            if value is not None and theirs.get(key) != ours[key]:
                raise StudyError(
                    f"{path} was begun with {key} {theirs.get(key)!r}, not {ours[key]!r}: leave {key} out to resume "
                    "it, or give another file"
                )
        if blind := unreadable_text(ours["problem"]):
            _log.warning("%s", blind)
        if code:
            file.change_code(ours["problem"], code, versions=ours["versions"], revision=ours["revision"])
        if extended:
            file.add_conditions(ours["problem"])
    except BaseException:
        file.close()
        raise
    return file


def _description(problem: Problem, requested: Mapping[str, Any]) -> dict[str, Any]:
    """Return the contents of the file of a new study: the problem, the solver and the software.

    Raises:
        ValueError: The solver is unknown, cannot solve the problem, or does not take what is requested.
    """
    options, parallel, seed = requested["options"], requested["parallel"], requested["seed"]
    if options is not None and not isinstance(options, Mapping):
        raise ValueError(f"the options of a solver are given as {{name: value, ...}}, not as {options!r}")
    if parallel is not None and as_whole("parallel", parallel) < 1:
        raise ValueError(f"parallel is the number of rollouts side by side, at least one, not {parallel}")
    meta: dict[str, Any] = {
        "problem": describe(problem),
        "solver": "auto" if requested["solver"] is None else requested["solver"],
        "seed": 0 if seed is None else as_whole("a seed", seed),
        "options": plain(options or {}, "the options of its solver"),
        "parallel": None if parallel is None else as_whole("parallel", parallel),
        "versions": versions(),
        "revision": revision(problem.scenario),
        "units": list(problem.units),
        "quality_units": [quality.unit for quality in problem.objectives],
        "statement": statement(problem),
        "limits": _limits(problem),
    }
    solver = StudySearch.of(meta).make_solver()
    solver.close()
    return {**meta, "solver": solver.name}


def _limits(problem: Problem) -> list[list[float] | None]:
    """Return the bounds of the varied variables; None for a choice, and for a field of the scenario."""
    variables = problem.testbed.variables()
    return [
        None
        if parameter.is_field or isinstance(parameter, Choice)
        else [float(np.asarray(bound)) for bound in variables[parameter.address].bounds]
        for parameter in problem.parameters
    ]
