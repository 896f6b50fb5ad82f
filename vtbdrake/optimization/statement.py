"""The statement of a problem as plain data: what a study file keeps, so that its problem can be stated again."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from math import isinf
from typing import Any

from vtbdrake.common.failures import FAILURES, one_line
from vtbdrake.optimization.identity import dimensions
from vtbdrake.optimization.problem import Problem
from vtbdrake.optimization.risk import RISKS, CVaR, Quantile, Risk
from vtbdrake.rollout import Constraint, Quality, RecordedMotion
from vtbdrake.rollout.named_function import is_named, named_function
from vtbdrake.testbed import ScenarioError
from vtbdrake.testbed.scenario_file import is_trusted, scenario_of_text
from vtbdrake.testbed.scenario_text import scenario_text

_LEVELS: Mapping[str, Callable[[float], Risk]] = {"Quantile": Quantile, "CVaR": CVaR}
_LEVEL = re.compile(r"(\w+)\(level=([^)]*)\)")


class StatementError(ValueError):
    """A problem cannot be stated again from what its study file tells."""


def statement(problem: Problem) -> dict[str, Any]:
    """Return the data for `restated` beside the identity of a problem: the scenario as YAML, its functions by name.

    ``scenario`` is empty if no file can hold it. A function that no module has under its name (a lambda, one of a
    script or a notebook) is None.
    """
    try:
        scenario = scenario_text(problem.scenario)
    except (ScenarioError, TypeError, ValueError):
        scenario = ""
    return {"scenario": scenario, "functions": [_name(m.f) for m in (*problem.objectives, *problem.constraints)]}


def _name(function: Callable[..., Any]) -> str | None:
    name = f"{getattr(function, '__module__', '')}:{getattr(function, '__qualname__', '')}"
    return name if is_named(name, function) else None


def restated(record: Mapping[str, Any], *, trusted: Sequence[str] = ()) -> Problem:
    """Return the problem of a study, stated again from the record of its file.

    Importing a module runs its code. So no module is imported because a file names it, except vtbdrake's.

    Args:
        record: `Study.record`.
        trusted: Modules that may be imported, or packages of them; those that are imported already need not be named.

    Raises:
        StatementError: The file does not tell enough, a module is not trusted, or the problem cannot be stated with
            today's code.
    """
    check_statement(record, trusted=trusted)
    described, stated = record["problem"], record["statement"]
    try:
        return _stated(described, described["scenario"]["scenario"], stated)
    except FAILURES as error:
        raise StatementError(f"its problem cannot be stated with today's code: {one_line(error)}") from error


def check_statement(record: Mapping[str, Any], *, trusted: Sequence[str] = ()) -> None:
    """Check that the record of a study tells enough for `restated`, whose arguments these are; nothing is built.

    Args:
        record: `Study.record`.
        trusted: Modules that may be imported, or packages of them.

    Raises:
        StatementError: The file does not tell enough, or a module is not trusted.
    """
    stated, described = record.get("statement"), record["problem"]
    if stated is None:
        raise StatementError("the file was written by an earlier vtbdrake and does not tell how to build its testbed")
    if not stated["scenario"]:
        raise StatementError("the file does not tell how to build its testbed: no YAML can hold its scenario")
    if described["start"] != "defaults":
        raise StatementError("its rollouts begin from a snapshot, which the file does not hold")
    if None in stated["functions"]:
        measures = [*described["qualities"], *described["constraints"]]
        unnamed = [m["name"] for m, name in zip(measures, stated["functions"], strict=True) if name is None]
        raise StatementError(f"the function {unnamed[0]} is one of a script, a notebook or a lambda")
    scenario_name = described["scenario"]["scenario"]
    _refuse_strangers([scenario_name, *stated["functions"]], trusted)


def _refuse_strangers(names: Sequence[str], trusted: Sequence[str]) -> None:
    for name in names:
        if not is_trusted(name, trusted=trusted):
            raise StatementError(
                f"the file names {name}, and importing its module runs its code: name the module, if you trust it"
            )


def _stated(described: Mapping[str, Any], scenario_name: str, stated: Mapping[str, Any]) -> Problem:
    scenario = scenario_of_text(scenario_name, stated["scenario"])
    functions = iter([named_function(name) for name in stated["functions"]])
    qualities = [
        Quality(next(functions), q["of"], reading=q["reading"], minimize=q["minimize"], upper=float(q["upper"]))
        for q in described["qualities"]
    ]
    constraints = [
        Constraint(
            next(functions),
            c["of"],
            reading=c["reading"],
            at_most=float(c["at_most"]),
            at_least=float(c["at_least"]),
        )
        for c in described["constraints"]
    ]
    threshold = float(described["threshold"])
    return Problem(
        scenario=scenario,
        parameters=dimensions(described),
        quality=qualities,
        horizon=described["horizon"],
        threshold=None if isinf(threshold) else threshold,
        sample_period=described["sample_period"],
        conditions=described["conditions"],
        risk=_risk(described["risk"]),
        constraints=constraints,
        motion=RecordedMotion(described["memory"]) if "memory" in described else None,
    )


def _risk(text: str) -> Risk:
    for risk in RISKS.values():
        if text == f"{type(risk).__name__}()":
            return risk
    level = _LEVEL.fullmatch(text)
    if level is None or level[1] not in _LEVELS:
        raise StatementError(f"its risk {text} is none of vtbdrake's")
    return _LEVELS[level[1]](float(level[2]))
