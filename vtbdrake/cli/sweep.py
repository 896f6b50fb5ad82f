"""``vtbdrake sweep``: h over one or two parameters."""

from __future__ import annotations

from math import inf
from pathlib import Path
from typing import Any

import click

from vtbdrake.cli.group import FailedError, one_line
from vtbdrake.cli.options import converted, parse_grid
from vtbdrake.cli.problem import (
    condition_text,
    execution_options,
    make_problem,
    points_table,
    problem_options,
    refuse_failures,
    write_files,
)
from vtbdrake.cli.text import number
from vtbdrake.optimization import Parameter, Sweep
from vtbdrake.optimization.boundary import why_no_boundary
from vtbdrake.testbed import Scenario


@click.command("sweep")
@problem_options
@click.option(
    "--vary",
    callback=converted(parse_grid),
    multiple=True,
    required=True,
    metavar="ADDRESS=LOWER:UPPER:POINTS",
    help="An element of s0 and the values to try. Once or twice.",
)
@click.option("--threshold", type=float, default=inf, metavar="F", help="f_m: a rollout whose f exceeds it ends there.")
@execution_options
def run_sweep(
    scenario: Scenario,
    vary: tuple[tuple[Parameter, int], ...],
    executor: str,
    workers: int | None,
    save: Path | None,
    csv: Path | None,
    plot: Path | None,
    **problem: Any,
) -> None:
    """One rollout per point of a grid: which is best?

    With a threshold and one parameter it says the boundary too: the largest value up to which no rollout exceeds it.
    Ctrl-C ends the sweep and keeps what is finished.

    \b
    Example:
      vtbdrake sweep diagrams.space_climber:SpaceClimberScenario --horizon 15 \\
          --vary sim.sys.payload.mass=0:60:13 --quality sim.sys.climber.base.pitch --threshold 0.785
    """
    stated = make_problem(scenario, [parameter for parameter, _ in vary], **problem)
    sweep = stated.sweep([points for _, points in vary], executor=executor, workers=workers)
    click.echo(points_table(sweep))
    write_files(sweep, save=save, csv=csv, plot=plot)
    refuse_failures(sweep)
    click.echo("\n" + _conclusion(sweep))
    if not sweep.complete:
        raise FailedError("the sweep was interrupted: the table shows what is finished")


def _conclusion(sweep: Sweep) -> str:
    lines = []
    if len(sweep.conditions) > 1:
        lines += [condition_text(i, c) for i, c in enumerate(sweep.conditions)]
    try:
        point, h = sweep.best()
    except ValueError as error:
        raise FailedError(one_line(error)) from error
    at = ", ".join(f"{address} = {number(value)}" for address, value in point.items())
    lines.append(f"best: h = {number(h)} at {at}")
    if not why_no_boundary(sweep):
        lines.append(f"boundary: {sweep.boundary()}")
    return "\n".join(lines)
