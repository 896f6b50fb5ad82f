"""``vtbdrake study``: run a study, show it, and add points to it, also while another process runs it."""

from __future__ import annotations

import json
import logging
from functools import partial
from pathlib import Path
from typing import Any

import click

from vtbdrake.cli import FailedError
from vtbdrake.cli.options import converted, output, parse_choice, parse_field, parse_scaled_range, settings
from vtbdrake.cli.output import table, write_csv
from vtbdrake.cli.problem import executor_options, make_constraint, make_problem, problem_options
from vtbdrake.optimization import Choice, CVaR, Parameter, Quantile, Study
from vtbdrake.optimization.risk import Risk
from vtbdrake.rollout import Constraint
from vtbdrake.testbed import Scenario

_LEVELS = {"quantile": Quantile, "cvar": CVaR}
_file = click.argument("file", type=click.Path(exists=True, dir_okay=False, path_type=Path))
_point = click.argument(
    "point", nargs=-1, required=True, callback=converted(parse_field), metavar="ADDRESS=VALUE [ADDRESS=VALUE ...]"
)


def _risk(text: str) -> str | Risk:
    name, colon, level = text.partition(":")
    if not colon:
        return text
    if name not in _LEVELS:
        raise click.BadParameter(f"expected worst, mean, quantile:LEVEL or cvar:LEVEL, not {text!r}")
    try:
        return _LEVELS[name](float(level))
    except ValueError as error:
        raise click.BadParameter(f"the level of {name} is a number in (0, 1], not {level!r}") from error


@click.group()
def study() -> None:
    """Solve a problem, recorded rollout by rollout in a file that can be resumed.

    \b
    Example:
      vtbdrake study run gait.db vtbdrake_diagrams.space_climber:SpaceClimberScenario --horizon 5 --rollouts 40 \\
          --vary dps.impl.gait.period=1:4 --vary dps.impl.gait.stroke=0.05:0.3 --quality sim.sys.climber.base.x
      vtbdrake study show gait.db
    """


@study.command()
@click.argument("file", callback=output())
@problem_options
@click.option(
    "--vary",
    callback=converted(parse_scaled_range),
    multiple=True,
    metavar="ADDRESS=LOWER:UPPER[:log][:integer]",
    help="A parameter and its range: on a logarithmic scale, or whole numbers only. May be repeated.",
)
@click.option(
    "--choose",
    callback=converted(parse_choice),
    multiple=True,
    metavar="ADDRESS=OPTION,OPTION[,...]",
    help="A parameter that takes one of several values without an order: numbers, words, true or false; a variable "
    "or scenario.<field>. May be repeated; in a point, those of --choose follow those of --vary.",
)
@click.option(
    "--at-most",
    callback=converted(partial(make_constraint, limit="at_most")),
    multiple=True,
    metavar="ADDRESS=LIMIT",
    help="A constraint: the variable (of an array, its largest entry) never exceeds the limit. Instead of a "
    "variable, a Python function of variables: MODULE:FUNCTION(ADDRESS,...)=LIMIT. May be repeated.",
)
@click.option(
    "--at-least",
    callback=converted(partial(make_constraint, limit="at_least")),
    multiple=True,
    metavar="ADDRESS=LIMIT",
    help="A constraint: the variable (of an array, its smallest entry) never falls below the limit. May be repeated.",
)
@click.option("--minimize", is_flag=True, help="The quality is a cost: smaller is better.")
@click.option(
    "--risk",
    callback=converted(_risk),
    default="worst",
    show_default=True,
    help="How the qualities under several conditions become one: worst, mean, quantile:LEVEL or cvar:LEVEL.",
)
@click.option("--solver", metavar="NAME", help="The solver.  [default: auto, or that of FILE]")
@click.option(
    "--option",
    "options",
    callback=converted(parse_field),
    multiple=True,
    metavar="NAME=VALUE",
    help="An option of the solver. May be repeated.",
)
@click.option("--seed", type=int, metavar="N", help="The seed of the solver.  [default: 0, or that of FILE]")
@click.option("--rollouts", type=click.IntRange(min=1), metavar="N", help="End when the study has N rollouts.")
@click.option("--seconds", type=float, metavar="S", help="End after S seconds of wall time.")
@click.option("--target", type=float, metavar="H", help="End when a point is at least as good as H.")
@executor_options
@click.option("--time-limit", type=float, metavar="S", help="Fail a rollout that takes longer than S seconds.")
@click.option(
    "--racing/--no-racing",
    default=None,
    help="Drop points that can no longer win before all conditions have run.  [default: with several conditions]",
)
@click.option(
    "--on-error",
    type=click.Choice(["record", "raise"]),
    default="record",
    show_default=True,
    help="If the quality function raises: record the rollout as failed, or end the run.",
)
@click.option("--allow-changed-code", is_flag=True, help="Resume although the code of the problem has changed.")
def run(
    file: Path,
    scenario: Scenario,
    vary: tuple[Parameter, ...],
    choose: tuple[Choice, ...],
    at_most: tuple[Constraint, ...],
    at_least: tuple[Constraint, ...],
    *,
    minimize: bool,
    risk: str | Risk,
    solver: str | None,
    options: tuple[tuple[str, Any], ...],
    seed: int | None,
    rollouts: int | None,
    seconds: float | None,
    target: float | None,
    executor: str,
    workers: int | None,
    time_limit: float | None,
    racing: bool | None,
    on_error: str,
    allow_changed_code: bool,
    **problem: Any,
) -> None:
    """Begin a study, or resume the one in FILE. Ctrl-C keeps the finished rollouts.

    The study has one quality, read as the best over time. Several qualities, other readings, limits of the quality and
    callbacks need a Python program: see Problem.study.

    \b
    Example:
      vtbdrake study run gait.db vtbdrake_diagrams.space_climber:SpaceClimberScenario --horizon 5 --rollouts 40 \\
          --vary dps.impl.gait.period=1:4:log --choose scenario.gravity=1.62,9.81 \\
          --quality sim.sys.climber.base.x --at-most sim.sys.climber.base.pitch=0.2
    """
    if not (vary or choose):
        raise click.UsageError("nothing is varied: add --vary or --choose")
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s")
    stated = make_problem(
        scenario, [*vary, *choose], **problem, minimize=minimize, risk=risk, constraints=[*at_most, *at_least]
    )
    with stated.study(
        file,
        solver=solver,
        seed=seed,
        options=settings(options) if options else None,
        allow_changed_code=allow_changed_code,
    ) as opened:
        opened.run(
            rollouts=rollouts,
            seconds=seconds,
            target=target,
            executor=executor,
            workers=workers,
            time_limit=time_limit,
            racing=racing,
            on_error=on_error,
        )
        click.echo(opened.summary())
        if opened.reason == "interrupted":
            raise FailedError("the study was interrupted: the same command resumes it")


@study.command()
@_file
@click.option("--csv", callback=output(".csv"), metavar="FILE", help="Write all points with their attributes.")
def show(file: Path, csv: Path | None) -> None:
    """Show the results of a study, its waiting points and its attributes."""
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


@study.command()
@_file
@_point
def add(file: Path, point: tuple[tuple[str, Any], ...]) -> None:
    """Add a point, to be evaluated with the next batch."""
    with Study.open(file) as opened:
        opened.add(settings(point))


@study.command()
@_file
@click.argument("number", type=int)
@_point
def edit(file: Path, number: int, point: tuple[tuple[str, Any], ...]) -> None:
    """Replace a waiting point; `show` lists the numbers."""
    with Study.open(file) as opened:
        opened.edit(number, settings(point))


@study.command()
@_file
@click.argument("number", type=int)
def remove(file: Path, number: int) -> None:
    """Remove a waiting point; `show` lists the numbers."""
    with Study.open(file) as opened:
        opened.remove(number)


@study.command("attribute")
@_file
@click.argument("attribute", callback=converted(parse_field), metavar="KEY=VALUE")
@click.option("--trial", type=int, metavar="NUMBER", help="Set it for the point of this trial, not for the study.")
def set_attribute(file: Path, attribute: tuple[str, Any], trial: int | None) -> None:
    """Set an attribute of a study, or of a point."""
    with Study.open(file) as opened:
        trials = opened.trials if trial is not None else ()
        if trial is not None and not 0 <= trial < len(trials):
            raise click.BadParameter(f"the study has {len(trials)} trials, counted from 0, and no trial {trial}")
        opened.set_attribute(*attribute, point=None if trial is None else trials[trial].parameters)
