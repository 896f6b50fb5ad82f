"""What the commands about problems have in common: how a problem is stated, and the results of a sweep shown."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import reduce
from pathlib import Path
from typing import Any, TypeVar

import click
import numpy as np

from vtbdrake.cli.group import FailedError, one_line
from vtbdrake.cli.options import (
    Setting,
    converted,
    horizon_option,
    output,
    parse_condition,
    sample_period_option,
    scenario_argument,
    set_option,
    settings,
    start_option,
)
from vtbdrake.cli.quality import make_quality
from vtbdrake.cli.text import number, table, write_csv
from vtbdrake.optimization import Boundary, Problem, Sweep
from vtbdrake.optimization.parameter import Dimension
from vtbdrake.optimization.risk import Risk
from vtbdrake.rollout import Constraint
from vtbdrake.rollout.choice import NAMES
from vtbdrake.state import Snapshot
from vtbdrake.testbed import Scenario

F = TypeVar("F", bound=Callable[..., Any])

_PROBLEM = (
    scenario_argument,
    click.option(
        "--quality",
        required=True,
        metavar="ADDRESS|MODULE:FUNCTION",
        help="f, larger is better: abs(value) of a variable or vector port (of an array, its largest entry), or a "
        "Python function of the variables named by --of.",
    ),
    click.option("--of", multiple=True, metavar="ADDRESS", help="An argument of the function. May be repeated."),
    horizon_option,
    set_option,
    click.option(
        "--condition",
        "conditions",
        callback=converted(parse_condition),
        multiple=True,
        metavar="ADDRESS=VALUE[;...]",
        help="A condition that every point is tried under. May be repeated.",
    ),
    sample_period_option,
    start_option,
)

_EXECUTION = (
    click.option("--executor", type=click.Choice(NAMES), default=NAMES[0], show_default=True),
    click.option(
        "--workers", type=click.IntRange(min=1), metavar="N", help="Threads or processes; one per core if left out."
    ),
    click.option("--save", callback=output(), metavar="FILE", help="Write all of it, for vtbdrake.Sweep.load."),
    click.option("--csv", callback=output(".csv"), metavar="FILE", help="Write the table."),
    click.option("--plot", callback=output(".png", ".svg", ".pdf"), metavar="FILE", help="Draw h and the qualities."),
)


def problem_options(command: F) -> F:
    """The options that state a problem."""
    return reduce(lambda wrapped, option: option(wrapped), reversed(_PROBLEM), command)


def execution_options(command: F) -> F:
    """The options about where rollouts run and where the results go."""
    return reduce(lambda wrapped, option: option(wrapped), reversed(_EXECUTION), command)


def make_problem(
    scenario: Scenario,
    parameters: Sequence[Dimension],
    *,
    quality: str,
    of: Sequence[str],
    horizon: float,
    values: Sequence[Setting],
    conditions: Sequence[dict[str, Any]],
    threshold: float | None = None,
    sample_period: float,
    start: Snapshot | None,
    minimize: bool = False,
    risk: str | Risk = "worst",
    constraints: Sequence[Constraint] = (),
) -> Problem:
    """The problem that the options state; ``values`` hold under every condition."""
    common = list(settings(values).items())
    return Problem(
        scenario=scenario,
        parameters=parameters,
        quality=replace(make_quality(quality, of), minimize=minimize),
        horizon=horizon,
        threshold=threshold,
        sample_period=sample_period,
        conditions=[settings([*common, *condition.items()]) for condition in conditions or ({},)],
        start=start,
        risk=risk,
        constraints=constraints,
    )


def points_table(sweep: Sweep) -> str:
    """One row per point and condition: the parameters, h, t*, how the rollout ended; below, why some failed."""
    several = len(sweep.conditions) > 1
    names = [f"{p.address} [{unit}]" for p, unit in zip(sweep.parameters, sweep.units, strict=True)]
    header = [*names, *(["condition"] if several else []), "h", "t* [s]", "end"]
    rows = []
    for point, condition, rollout in zip(sweep.points, sweep.condition, sweep.rollouts, strict=True):
        which = [str(condition)] if several else []
        rows.append([*map(number, point), *which, number(rollout.h), number(rollout.t_star), rollout.end])
    reasons = Counter(one_line(rollout.message) for rollout in sweep.rollouts if rollout.failed)
    return "\n".join([table(header, rows), *(f"failed ({count}): {text}" for text, count in reasons.items())])


def condition_text(index: int, condition: Mapping[str, Any]) -> str:
    """``condition 0 (address = value, ...)``"""
    values = (f"{address} = {json.dumps(np.asarray(value).tolist())}" for address, value in condition.items())
    return f"condition {index} ({', '.join(values)})"


def write_files(
    sweep: Sweep, *, save: Path | None, csv: Path | None, plot: Path | None, boundary: Boundary | None = None
) -> None:
    """Writes what was asked for; the plot shows the boundary, if one was searched for."""
    if save is not None:
        sweep.save(save)
    if csv is not None:
        write_csv(csv, sweep.to_dict())
    if plot is not None:
        (sweep if boundary is None else boundary).plot().savefig(plot)


def refuse_failures(sweep: Sweep) -> None:
    """
    Raises:
        FailedError: not one rollout succeeded.
    """
    if len(sweep) and sweep.failed.all():
        raise FailedError(f"all {len(sweep)} rollouts failed; the first: {one_line(sweep.rollouts[0].message)}")
