"""``vtbdrake boundary``: how far may a parameter go?"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click
import numpy as np

from vtbdrake.cli.options import converted, parse_range
from vtbdrake.cli.study import (
    condition_text,
    execution_options,
    make_problem,
    problem_options,
    refuse_failures,
    write_files,
)
from vtbdrake.cli.text import number
from vtbdrake.optimization import Boundary, Parameter, Sweep
from vtbdrake.testbed import Scenario


@click.command("boundary")
@problem_options
@click.option(
    "--vary",
    callback=converted(parse_range),
    required=True,
    metavar="ADDRESS=LOWER:UPPER",
    help="The element of s0 whose boundary is asked for, and where to look.",
)
@click.option("--threshold", type=float, required=True, metavar="F", help="f_m: a rollout whose f exceeds it is bad.")
@click.option("--resolution", type=float, required=True, metavar="R", help="Width of the interval to be found.")
@click.option("--coarse", type=float, required=True, metavar="C", help="Step of the grid to begin with.")
@execution_options
def find_boundary(
    scenario: Scenario,
    vary: Parameter,
    resolution: float,
    coarse: float,
    executor: str,
    workers: int | None,
    save: Path | None,
    csv: Path | None,
    plot: Path | None,
    **problem: Any,
) -> None:
    """How far may a parameter go before f exceeds the threshold?

    A coarse grid over the range is refined below the first failure, under each condition.

    \b
    Example:
      vtbdrake boundary diagrams.space_climber:SpaceClimberScenario --horizon 15 \\
          --vary sim.sys.payload.mass=0:60 --resolution 1 --coarse 5 \\
          --quality sim.sys.climber.base.pitch --threshold 0.785
    """
    stated = make_problem(scenario, [vary], **problem)
    found = stated.boundary(resolution=resolution, coarse=coarse, executor=executor, workers=workers)
    sweep = found.sweep
    assert sweep is not None
    write_files(sweep, save=save, csv=csv, plot=plot)
    refuse_failures(sweep)
    click.echo(_report(found, sweep))


def _report(found: Boundary, sweep: Sweep) -> str:
    unit = found.unit
    lines = [str(found)]
    if len(sweep.conditions) > 1:
        for i, (lower, upper) in enumerate(found.by_condition):
            lines.append(f"  {condition_text(i, sweep.conditions[i])}: {_interval(lower, upper, unit)}")
    if found.safe_beyond:
        lines.append(f"not monotonic: safe all the same at {_values(found.safe_beyond)} {unit}")
    if found.undecided:
        lines.append(f"undecided, counted as exceeded: the simulation failed at {_values(found.undecided)} {unit}")
    seconds = sum(rollout.wall_time for rollout in sweep.rollouts)
    lines.append(f"{len(sweep)} rollouts, {seconds:.3g} s of simulation")
    return "\n".join(lines)


def _interval(lower: float, upper: float, unit: str) -> str:
    if np.isinf(upper):
        return f"safe up to {number(lower)} {unit}, the largest value examined"
    if np.isinf(lower):
        return f"not safe at {number(upper)} {unit}, the smallest value examined"
    return f"safe up to {number(lower)}, not at {number(upper)} {unit}"


def _values(values: tuple[float, ...]) -> str:
    return ", ".join(map(number, values))
