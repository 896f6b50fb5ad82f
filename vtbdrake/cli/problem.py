"""``vtbdrake sweep`` and ``boundary``, and how the command line states a problem."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from vtbdrake.cli import FailedError
from vtbdrake.cli.completion import complete_scenario_or_file
from vtbdrake.cli.options import (
    LazyChoice,
    Setting,
    grouped,
    option,
    output,
    parse_condition,
    parse_grid,
    parse_range,
    parse_scenario,
    sample_period_option,
    scenario_argument,
    set_option,
    settings,
    start_option,
)
from vtbdrake.cli.output import emit, json_option, number, say, show, table, write_csv
from vtbdrake.common.failures import one_line

if TYPE_CHECKING:
    from vtbdrake.optimization import Boundary, Parameter, Problem, ProblemFile, Sweep
    from vtbdrake.optimization.parameter import Dimension
    from vtbdrake.rollout import Constraint, Quality, RolloutResult
    from vtbdrake.testbed import Scenario


def _executors() -> tuple[str, ...]:
    from vtbdrake.rollout.executor_choice import NAMES

    return NAMES


def problem_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Give a command a scenario, and what else states a problem as ``problem``, for `make_problem`."""
    return scenario_argument(_statement(required=True)(command))


def problem_or_file_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Give a command a scenario and what states a problem, or the file of a problem as ``scenario``."""
    stated, metavar = _statement(required=False)(command), "SCENARIO|PROBLEM.yaml"
    return scenario_argument(stated, parse=parse_problem, complete=complete_scenario_or_file, metavar=metavar)


def parse_problem(text: str, *, trusted: Sequence[str] | None = None) -> Scenario | ProblemFile:
    """Load a scenario, or the file of a problem; see `ProblemFile.load` for ``trusted``.

    Args:
        text: Short name, ``MODULE:CLASS`` (with an ``@file``, too), or a YAML file of a problem.
        trusted: The only modules, or packages of them, that the file may import; None for all.
    """
    if ":" in text or not text.endswith((".yaml", ".yml")):
        return parse_scenario(text)
    from vtbdrake.optimization import ProblemFile

    return ProblemFile.load(text, trusted=trusted)


def _statement(*, required: bool) -> Callable[[Any], Any]:
    return grouped(
        "problem",
        option(
            "--quality ADDRESS|MODULE:FUNCTION",
            "f, larger is better: abs(value) of a variable or vector port (of an array, its largest entry), or a "
            "Python function of the variables named by --of.",
            required=required,
        ),
        option("--of ADDRESS", "An argument of the function. May be repeated.", multiple=True),
        option("--horizon S", "The horizon t_m, in seconds.", type=float, required=required),
        set_option,
        option(
            "--condition ADDRESS=VALUE[;...]",
            "Evaluate every point under this condition. May be repeated.",
            name="conditions",
            parse=parse_condition,
            multiple=True,
        ),
        sample_period_option,
        start_option,
    )


# For `Problem.sweep`, `Problem.boundary` and `Study.run`.
executor_options = grouped(
    "running",
    option("--executor", "Where rollouts run.", type=LazyChoice(_executors), default="auto"),
    option("--workers N", "The number of threads or processes.  [default: one per core]", type=click.IntRange(min=1)),
)
on_error_option = grouped(
    "running",
    option(
        "--on-error",
        "If the quality function raises: record the rollout as failed, or end the run.",
        type=click.Choice(["record", "raise"]),
        default="record",
    ),
)
_file_options = grouped(
    "files",
    option("--save FILE", "Write the sweep for vtbdrake.optimization.Sweep.load.", parse=output()),
    option("--csv FILE", "Write the table.", parse=output(".csv")),
    option("--plot FILE", "Draw h and the qualities.", parse=output(".png", ".svg", ".pdf")),
)


def make_problem(
    scenario: Scenario,
    parameters: Sequence[Dimension],
    *,
    quality: str,
    of: Sequence[str],
    values: Sequence[Setting],
    conditions: Sequence[dict[str, Any]],
    minimize: bool = False,
    **others: Any,
) -> Problem:
    """Return the problem that the options state.

    Args:
        scenario: The scenario.
        parameters: What is varied.
        quality: The address of a variable, or a function as ``module:function``.
        of: The arguments of the function.
        values: Settings that hold under every condition.
        conditions: The conditions.
        minimize: Whether the quality is a cost.
        others: Other arguments of `Problem`.
    """
    from vtbdrake.optimization import Problem

    common = list(settings(values).items())
    return Problem(
        scenario=scenario,
        parameters=parameters,
        quality=replace(_quality(quality, of), minimize=minimize),
        conditions=[settings([*common, *condition.items()]) for condition in conditions or ({},)],
        **others,
    )


def _quality(text: str, of: Sequence[str]) -> Quality:
    from vtbdrake.rollout import Quality
    from vtbdrake.rollout.named_function import FUNCTION, magnitude, named_function

    if not FUNCTION.fullmatch(text):
        if of:
            raise click.UsageError(f"--of belongs to a quality module:function; {text} is an address")
        return Quality(magnitude, of=text)
    if not of:
        raise click.UsageError(f"--quality {text} needs its arguments: add --of ADDRESS for each")
    return Quality(named_function(text), of=of)


def make_constraint(text: str, *, limit: str) -> Constraint:
    """Return the constraint ``ADDRESS=NUMBER`` or ``module:function(ADDRESS,...)=NUMBER``.

    Args:
        text: The constraint as the user wrote it.
        limit: Which bound the number is, ``at_most`` or ``at_least``.

    Raises:
        click.BadParameter: The text has another form.
        click.UsageError: The function does not exist.
    """
    from vtbdrake.rollout import Constraint
    from vtbdrake.rollout.named_function import FUNCTION, largest, named_function, smallest

    subject, _, bound = (part.strip() for part in text.rpartition("="))
    form = "ADDRESS=LIMIT or MODULE:FUNCTION(ADDRESS,...)=LIMIT"
    try:
        limits: dict[str, Any] = {limit: float(bound)}
    except ValueError as error:
        raise click.BadParameter(f"expected {form}, LIMIT a number, not {text!r}") from error
    call = re.fullmatch(rf"({FUNCTION.pattern})\((.*)\)", subject)
    if call is not None:
        of = [address.strip() for address in call[2].split(",") if address.strip()]
        return Constraint(named_function(call[1]), of=of, **limits)
    if not subject or FUNCTION.fullmatch(subject):
        raise click.BadParameter(f"expected {form}, not {text!r}")
    return Constraint(largest if limit == "at_most" else smallest, of=subject, **limits)


@click.command()
@problem_options
@option(
    "--vary ADDRESS=LOWER:UPPER:POINTS",
    "An element of s0 and the values to evaluate. Once or twice.",
    parse=parse_grid,
    multiple=True,
    required=True,
)
@grouped("problem", option("--threshold F", "f_m: a rollout whose f exceeds it ends there.", default=inf))
@executor_options
@on_error_option
@_file_options
@json_option
def sweep(
    scenario: Scenario,
    vary: tuple[tuple[Parameter, int], ...],
    problem: dict[str, Any],
    running: dict[str, Any],
    files: dict[str, Any],
) -> None:
    """Simulate every point of a grid: which one is best?

    With a threshold and one parameter, it also prints the boundary: the largest value up to which no rollout exceeds
    the threshold. Ctrl-C ends the sweep and keeps the finished rollouts.

    \b
    Example:
      vtbdrake sweep space_climber --horizon 15 \\
          --vary sim.sys.payload.mass=0:60:13 --quality sim.sys.climber.base.pitch --threshold 0.785
    """
    parameters, points = zip(*vary, strict=True)
    swept = make_problem(scenario, parameters, **problem).sweep(points, **running)
    say(_points_table(swept))
    _write_files(swept, **files)
    emit(_described(swept))
    _reject_failures(swept)
    say("\n" + _conclusion(swept))
    if not swept.complete:
        raise FailedError("the sweep was interrupted: the table shows the finished rollouts")


@click.command()
@problem_options
@option(
    "--vary ADDRESS=LOWER:UPPER",
    "The element of s0 whose boundary to find, and its range.",
    parse=parse_range,
    required=True,
)
@grouped("problem", option("--threshold F", "f_m: a rollout whose f exceeds it is bad.", type=float, required=True))
@grouped(
    "search",
    option("--resolution R", "The width of the interval to find.", type=float, required=True),
    option("--coarse C", "The step of the first grid.", type=float, required=True),
    option(
        "--repeats N",
        "Repeat values close to the boundary N times with jitter, down to a safe one and up to an unsafe one.  "
        "[default: 5]",
        type=click.IntRange(min=0),
    ),
    option(
        "--jitter J", "The largest change of the parameter in a repetition, as a fraction of its range.", default=1e-06
    ),
)
@executor_options
@on_error_option
@_file_options
@json_option
def boundary(
    scenario: Scenario,
    vary: Parameter,
    problem: dict[str, Any],
    search: dict[str, Any],
    running: dict[str, Any],
    files: dict[str, Any],
) -> None:
    """Find how far a parameter may go before f exceeds the threshold.

    A coarse grid over the range is refined below the first failure, under each condition.

    \b
    Example:
      vtbdrake boundary space_climber --horizon 15 \\
          --vary sim.sys.payload.mass=0:60 --resolution 1 --coarse 5 \\
          --quality sim.sys.climber.base.pitch --threshold 0.785
    """
    result = make_problem(scenario, [vary], **problem).boundary(**search, **running)
    assert result.sweep is not None
    _write_files(result.sweep, boundary=result, **files)
    _reject_failures(result.sweep)
    show(_report(result, result.sweep), _boundary_data(result, result.sweep))


def _described(sweep: Sweep) -> dict[str, Any]:
    """Return the points with their rollouts, and the best one if there is one."""
    from vtbdrake.optimization.boundary import why_no_boundary

    try:
        best: dict[str, Any] | None = {"point": sweep.best.parameters, "h": sweep.best.value}
    except ValueError:
        best = None
    points = [
        {
            "point": dict(zip((p.address for p in sweep.parameters), point, strict=True)),
            "condition": condition,
            "h": rollout.h,
            "t_star": rollout.t_star,
            "end": rollout.end,
            "message": rollout.message,
        }
        for point, condition, rollout in zip(sweep.points, sweep.condition, sweep.rollouts, strict=True)
    ]
    described: dict[str, Any] = {"conditions": sweep.conditions, "points": points}
    described |= {"best": best, "complete": sweep.complete}
    if not why_no_boundary(sweep):
        described |= {"boundary": [sweep.boundary().lower, sweep.boundary().upper]}
    return described


def _points_table(sweep: Sweep) -> str:
    """Return a row per point and condition, and below the reasons why some rollouts failed."""
    several = len(sweep.conditions) > 1
    names = [f"{p.address} [{unit}]" for p, unit in zip(sweep.parameters, sweep.units, strict=True)]
    header = [*names, *(["condition"] if several else []), "h", "t* [s]", "end"]
    rows = []
    for point, condition, rollout in zip(sweep.points, sweep.condition, sweep.rollouts, strict=True):
        which = [str(condition)] if several else []
        rows.append([*map(number, point), *which, number(rollout.h), number(rollout.t_star), rollout.end])
    reasons = Counter(one_line(rollout.message) for rollout in sweep.rollouts if rollout.failed)
    return "\n".join([table(header, rows), *(f"failed ({count}): {text}" for text, count in reasons.items())])


def _conclusion(sweep: Sweep) -> str:
    from vtbdrake.optimization.boundary import why_no_boundary
    from vtbdrake.optimization.parameter import point_text

    lines = [_condition(i, c) for i, c in enumerate(sweep.conditions)] if len(sweep.conditions) > 1 else []
    try:
        best = sweep.best
    except ValueError as error:
        raise FailedError(one_line(error)) from error
    at = point_text(sweep.parameters, best.point, sweep.units)
    lines.append(f"best: h = {number(best.value)} at {at}")
    if not why_no_boundary(sweep):
        lines.append(f"boundary: {sweep.boundary()}")
    return "\n".join(lines)


def _boundary_data(boundary: Boundary, sweep: Sweep) -> dict[str, Any]:
    names = ("address", "unit", "lower", "upper", "by_condition", "examined", "chances", "safe_beyond", "failed_at")
    described = {name: getattr(boundary, name) for name in names}
    return described | {"conditions": sweep.conditions, "rollouts": len(_rollouts(boundary, sweep))}


def _rollouts(boundary: Boundary, sweep: Sweep) -> list[RolloutResult]:
    return [*sweep.rollouts, *(boundary.repeated.rollouts if boundary.repeated is not None else ())]


def _report(boundary: Boundary, sweep: Sweep) -> str:
    from vtbdrake.state.variables import with_unit

    lines = [str(boundary)]
    several = len(sweep.conditions) > 1
    if several:
        for i, (lower, upper) in enumerate(boundary.by_condition):
            lines.append(f"  {_condition(i, sweep.conditions[i])}: {boundary.interval_text(lower, upper)}")
    for chance in boundary.worst_chances:
        which = f" under condition {chance.condition}" if several else ""
        lines.append(f"  {with_unit(number(chance.value), boundary.unit)}: {chance}{which}")
    if boundary.failed_at:
        values = ", ".join(map(number, boundary.failed_at))
        lines.append(f"counted as unsafe: a rollout failed at {with_unit(values, boundary.unit)}")
    rollouts = _rollouts(boundary, sweep)
    seconds = sum(rollout.wall_time for rollout in rollouts)
    return "\n".join([*lines, f"{len(rollouts)} rollouts, {seconds:.3g} s of simulation"])


def _condition(index: int, condition: Mapping[str, Any]) -> str:
    import numpy as np

    values = (f"{address} = {json.dumps(np.asarray(value).tolist())}" for address, value in condition.items())
    return f"condition {index} ({', '.join(values)})"


def _write_files(
    sweep: Sweep, *, save: Path | None, csv: Path | None, plot: Path | None, boundary: Boundary | None = None
) -> None:
    if save is not None:
        sweep.save(save)
    if csv is not None:
        write_csv(csv, sweep.to_dict())
    if plot is not None:
        (sweep if boundary is None else boundary).plot().savefig(plot)


def _reject_failures(sweep: Sweep) -> None:
    if len(sweep) and sweep.failed.all():
        raise FailedError(f"all {len(sweep)} rollouts failed; the first: {one_line(sweep.rollouts[0].message)}")
