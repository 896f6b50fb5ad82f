"""``vtbdrake study``: runs a study, shows it, and gives it points, also while another process runs it."""

from __future__ import annotations

import json
import logging
from pathlib import Path
from typing import Any

import click

from vtbdrake.cli.group import FailedError
from vtbdrake.cli.options import converted, output, parse_field, parse_range, settings
from vtbdrake.cli.problem import make_problem, problem_options
from vtbdrake.cli.text import table, write_csv
from vtbdrake.optimization import Parameter, Study
from vtbdrake.rollout.choice import NAMES
from vtbdrake.testbed import Scenario

_file = click.argument("file", type=click.Path(exists=True, dir_okay=False, path_type=Path))


_point = click.argument(
    "point", nargs=-1, required=True, callback=converted(parse_field), metavar="ADDRESS=VALUE [ADDRESS=VALUE ...]"
)


@click.group("study")
def study() -> None:
    """Solve a problem, recorded rollout by rollout in a file that can be resumed.

    \b
    Example:
      vtbdrake study run gait.db diagrams.space_climber:SpaceClimberScenario --horizon 5 --rollouts 40 \\
          --vary dps.impl.gait.period=1:4 --vary dps.impl.gait.stroke=0.05:0.3 --quality sim.sys.climber.base.x
      vtbdrake study show gait.db
    """


@study.command("run")
@click.argument("file", callback=output())
@problem_options
@click.option(
    "--vary",
    callback=converted(parse_range),
    multiple=True,
    required=True,
    metavar="ADDRESS=LOWER:UPPER",
    help="A parameter and its range. May be repeated.",
)
@click.option("--minimize", is_flag=True, help="The quality is a cost: smaller is better.")
@click.option("--risk", default="worst", show_default=True, help="How conditions become one: worst or mean.")
@click.option("--solver", metavar="NAME", help="auto if left out, or that of the file.")
@click.option("--seed", type=int, metavar="N", help="Of the solver; 0 if left out, or that of the file.")
@click.option("--rollouts", type=click.IntRange(min=1), metavar="N", help="How many the study has in the end.")
@click.option("--seconds", type=float, metavar="S", help="Wall time of this run.")
@click.option("--target", type=float, metavar="H", help="End when a point is at least as good.")
@click.option("--executor", type=click.Choice(NAMES), default=NAMES[0], show_default=True)
@click.option(
    "--workers", type=click.IntRange(min=1), metavar="N", help="Threads or processes; one per core if left out."
)
@click.option("--time-limit", type=float, metavar="S", help="A rollout that takes longer fails.")
@click.option("--allow-changed-code", is_flag=True, help="Resume although the code of the problem has changed.")
def run(
    file: Path,
    scenario: Scenario,
    vary: tuple[Parameter, ...],
    *,
    minimize: bool,
    risk: str,
    solver: str | None,
    seed: int | None,
    rollouts: int | None,
    seconds: float | None,
    target: float | None,
    executor: str,
    workers: int | None,
    time_limit: float | None,
    allow_changed_code: bool,
    **problem: Any,
) -> None:
    """Begin a study, or go on with the one in FILE. Ctrl-C keeps what is finished."""
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s")
    stated = make_problem(scenario, vary, **problem, minimize=minimize, risk=risk)
    with stated.study(file, solver=solver, seed=seed, allow_changed_code=allow_changed_code) as opened:
        opened.run(
            rollouts=rollouts,
            seconds=seconds,
            target=target,
            executor=executor,
            workers=workers,
            time_limit=time_limit,
        )
        click.echo(opened.summary())
        if opened.reason == "interrupted":
            raise FailedError("the study was interrupted: the same command goes on with it")


@study.command("show")
@_file
@click.option("--csv", callback=output(".csv"), metavar="FILE", help="Write all points with their attributes.")
def show(file: Path, csv: Path | None) -> None:
    """Show what a study has found, the points that wait, and its attributes."""
    with Study.open(file) as opened:
        click.echo(opened.summary())
        queue, attributes = opened.queue, opened.attributes
        if queue:
            header = ["waiting", *(parameter.address for parameter in opened.parameters)]
            rows = [[str(number), *map(str, point.values())] for number, point in queue.items()]
            click.echo("\n" + table(header, rows))
        for key, value in attributes.items():
            click.echo(f"attribute {key}: {json.dumps(value)}")
        if csv is not None:
            write_csv(csv, opened.to_dict())


@study.command("add")
@_file
@_point
def add(file: Path, point: tuple[tuple[str, Any], ...]) -> None:
    """Give a point, to be judged with the next batch."""
    with Study.open(file) as opened:
        opened.add(settings(point))


@study.command("edit")
@_file
@click.argument("number", type=int)
@_point
def edit(file: Path, number: int, point: tuple[tuple[str, Any], ...]) -> None:
    """Put another point in the place of one that waits; `show` lists their numbers."""
    with Study.open(file) as opened:
        opened.edit(number, settings(point))


@study.command("remove")
@_file
@click.argument("number", type=int)
def remove(file: Path, number: int) -> None:
    """Take back a point that waits; `show` lists their numbers."""
    with Study.open(file) as opened:
        opened.remove(number)


@study.command("attribute")
@_file
@click.argument("attribute", callback=converted(parse_field), metavar="KEY=VALUE")
@click.option("--trial", type=int, metavar="NUMBER", help="Of the point of this trial, not of the study.")
def set_attribute(file: Path, attribute: tuple[str, Any], trial: int | None) -> None:
    """Set an attribute of a study, or of a point."""
    with Study.open(file) as opened:
        trials = opened.trials if trial is not None else ()
        if trial is not None and not 0 <= trial < len(trials):
            raise click.BadParameter(f"the study has {len(trials)} trials, counted from 0, and no trial {trial}")
        opened.set_attribute(*attribute, point=None if trial is None else trials[trial].parameters)
