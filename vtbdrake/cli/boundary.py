"""``vtbdrake boundary``: how far may a parameter go?"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from vtbdrake.cli.options import converted, parse_range
from vtbdrake.cli.problem import (
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
@click.option(
    "--repeats",
    type=click.IntRange(min=0),
    metavar="N",
    help="Repeat values close to the boundary N times with jitter, down to a safe one and up to an unsafe one; 5 if "
    "left out.",
)
@click.option(
    "--jitter",
    type=float,
    default=1e-6,
    show_default=True,
    metavar="J",
    help="How far these repeats move the parameter at most, as a fraction of its range.",
)
@execution_options
def find_boundary(
    scenario: Scenario,
    vary: Parameter,
    resolution: float,
    coarse: float,
    repeats: int | None,
    jitter: float,
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
    found = stated.boundary(
        resolution=resolution, coarse=coarse, repeats=repeats, jitter=jitter, executor=executor, workers=workers
    )
    sweep = found.sweep
    assert sweep is not None
    write_files(sweep, save=save, csv=csv, plot=plot, boundary=found)
    refuse_failures(sweep)
    click.echo(_report(found, sweep))


def _report(found: Boundary, sweep: Sweep) -> str:
    unit = found.unit
    lines = [str(found)]
    if len(sweep.conditions) > 1:
        for i, (lower, upper) in enumerate(found.by_condition):
            lines.append(f"  {condition_text(i, sweep.conditions[i])}: {found.interval_text(lower, upper)}")
    for chance in found.worst_chances:
        which = f" under condition {chance.condition}" if len(sweep.conditions) > 1 else ""
        lines.append(f"  {number(chance.value)} {unit}: {chance}{which}")
    if found.failed_at:
        lines.append(f"counted as unsafe: the simulation failed at {_values(found.failed_at)} {unit}")
    rollouts = [*sweep.rollouts, *(found.repeated.rollouts if found.repeated is not None else ())]
    seconds = sum(rollout.wall_time for rollout in rollouts)
    lines.append(f"{len(rollouts)} rollouts, {seconds:.3g} s of simulation")
    return "\n".join(lines)


def _values(values: tuple[float, ...]) -> str:
    return ", ".join(map(number, values))
