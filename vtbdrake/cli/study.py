"""``vtbdrake study``: run a study, show it, and steer it, also while another process runs it."""

from __future__ import annotations

import json
import logging
from functools import partial
from pathlib import Path
from textwrap import indent
from typing import TYPE_CHECKING, Any

import click
from click.core import ParameterSource

from vtbdrake.cli import FailedError
from vtbdrake.cli.completion import complete_file, complete_parameter
from vtbdrake.cli.options import (
    converted,
    grouped,
    option,
    output,
    parse_choice,
    parse_field,
    parse_limits,
    parse_optional,
    parse_scaled_range,
    schema_option,
    settings,
    trust_option,
)
from vtbdrake.cli.output import emit, json_option, number, say, table, write_csv
from vtbdrake.cli.page import browser_option, page_options, serve
from vtbdrake.cli.problem import (
    executor_options,
    make_constraint,
    make_problem,
    on_error_option,
    problem_or_file_options,
)

if TYPE_CHECKING:
    from vtbdrake.optimization import Choice, Parameter, Problem, ProblemFile, Study
    from vtbdrake.optimization.risk import Risk
    from vtbdrake.rollout import Constraint
    from vtbdrake.testbed import Scenario

_file = click.argument("file", type=click.Path(exists=True, dir_okay=False, path_type=Path))
_solver_options = option(
    "--option NAME=VALUE", "An option of the solver. May be repeated.", name="options", parse=parse_field, multiple=True
)
_point = click.argument(
    "point",
    nargs=-1,
    required=True,
    callback=converted(parse_field),
    metavar="ADDRESS=VALUE [ADDRESS=VALUE ...]",
    shell_complete=complete_parameter,
)


def _risk(text: str) -> Risk:
    from vtbdrake.optimization.risk import make_risk

    try:
        return make_risk(text)
    except ValueError as error:
        raise click.BadParameter(str(error)) from error


@click.group()
def study() -> None:
    """Solve a problem, recorded in a file that can be resumed.

    \b
    Example:
      vtbdrake study run gait.db space_climber --horizon 5 --rollouts 40 \\
          --vary dps.impl.gait.period=1:4 --vary dps.impl.gait.stroke=0.05:0.3 --quality sim.sys.climber.base.x
      vtbdrake study show gait.db
    """


def _schema() -> dict[str, Any]:
    from vtbdrake.optimization import ProblemFile

    return ProblemFile.schema()


@study.command()
@click.argument("file", callback=converted(output()), shell_complete=complete_file)
@problem_or_file_options
@option(
    "--vary ADDRESS=LOWER:UPPER[:log][:integer]",
    "A parameter and its range: on a logarithmic scale, or whole numbers only. May be repeated.",
    parse=parse_scaled_range,
    multiple=True,
)
@option(
    "--choose ADDRESS=OPTION,OPTION[,...]",
    "A parameter that takes one of several values without an order: numbers, words, true or false; a variable "
    "or scenario.<field>. May be repeated; in a point, the values of --choose follow the values of --vary.",
    parse=parse_choice,
    multiple=True,
)
@option(
    "--at-most ADDRESS=LIMIT",
    "A constraint: the variable (of an array, its largest entry) never exceeds the limit. Instead of a "
    "variable, a Python function of variables: MODULE:FUNCTION(ADDRESS,...)=LIMIT. May be repeated.",
    parse=partial(make_constraint, limit="at_most"),
    multiple=True,
)
@option(
    "--at-least ADDRESS=LIMIT",
    "A constraint: the variable (of an array, its smallest entry) never falls below the limit. May be repeated.",
    parse=partial(make_constraint, limit="at_least"),
    multiple=True,
)
@grouped(
    "problem",
    option("--minimize", "The quality is a cost: smaller is better.", is_flag=True),
    option(
        "--risk",
        "How the qualities under several conditions become one: worst, mean, quantile:LEVEL or cvar:LEVEL.",
        parse=_risk,
        default="worst",
    ),
)
@grouped(
    "solving",
    option("--solver NAME", "The solver.  [default: auto, or FILE's]"),
    _solver_options,
    option("--seed N", "The seed of the solver.  [default: 0, or FILE's]", type=int),
    option(
        "--parallel N",
        "Ask for enough points at a time for N rollouts side by side.  [default: the solver's own, or FILE's]",
        type=click.IntRange(min=1),
    ),
)
@grouped(
    "running",
    option("--rollouts N", "End when the study has N rollouts.", type=click.IntRange(min=1)),
    option("--seconds S", "End after S seconds of wall time.", type=float),
    option("--target H", "End when a point is at least as good as H.", type=float),
)
@executor_options
@grouped(
    "running",
    option("--time-limit S", "Fail a rollout that takes longer than S seconds.", type=float),
    option(
        "--racing/--no-racing",
        "Drop points that can no longer win before all conditions have run.  [default: with several conditions]",
        default=None,
    ),
)
@on_error_option
@grouped(
    "solving",
    option("--allow-changed-code", "Resume although the code of the problem has changed.", is_flag=True),
)
@schema_option(_schema)
@json_option
def run(
    file: Path,
    scenario: Scenario | ProblemFile,
    vary: tuple[Parameter, ...],
    choose: tuple[Choice, ...],
    at_most: tuple[Constraint, ...],
    at_least: tuple[Constraint, ...],
    problem: dict[str, Any],
    solving: dict[str, Any],
    running: dict[str, Any],
) -> None:
    """Begin a study, or resume the one in FILE. Ctrl-C keeps the finished rollouts.

    Options state a problem with one quality, read as the best over time. A file PROBLEM.yaml states any problem, its
    solver and its budget, which options replace; its modules are imported, which runs their code.

    \b
    Example:
      vtbdrake study run gait.db gait.yaml --workers 4
      vtbdrake study run gait.db space_climber --horizon 5 --rollouts 40 \\
          --vary dps.impl.gait.period=1:4:log --choose scenario.gravity=1.62,9.81 \\
          --quality sim.sys.climber.base.x --at-most sim.sys.climber.base.pitch=0.2
    """
    from vtbdrake.testbed import Scenario

    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s")
    solving["options"] = settings(solving["options"]) or None
    if not isinstance(scenario, Scenario):
        stated, solving, running = _of_file(scenario, solving, running)
    elif not (vary or choose):
        raise click.UsageError("nothing is varied: add --vary or --choose")
    elif missing := [name for name in ("horizon", "quality") if problem[name] is None]:
        raise click.UsageError(f"Missing option '--{missing[0]}'.")
    else:
        stated = make_problem(scenario, [*vary, *choose], **problem, constraints=[*at_most, *at_least])
    with stated.study(file, **solving) as opened:
        opened.run(**running)
        say(opened.summary())
        emit({**_described(opened), "reason": opened.reason})
        if opened.reason == "interrupted":
            raise FailedError("the study was interrupted: the same command resumes it")


def _of_file(
    file: ProblemFile, solving: dict[str, Any], running: dict[str, Any]
) -> tuple[Problem, dict[str, Any], dict[str, Any]]:
    """Return the problem of a file, with how it is solved and run; options of the command replace what it says."""
    context = click.get_current_context()
    typed = [
        parameter
        for parameter in context.command.params
        if context.get_parameter_source(parameter.name or "") == ParameterSource.COMMANDLINE
    ]
    solvable = {*solving, *running}
    for parameter in typed:
        if isinstance(parameter, click.Option) and parameter.name not in solvable and parameter.expose_value:
            raise click.UsageError(f"{file.path} states the problem: leave out {parameter.opts[0]}, or change the file")
    names = {parameter.name for parameter in typed}
    return (
        file.problem,
        {**file.study_arguments, **{name: value for name, value in solving.items() if name in names}},
        {**file.run_arguments, **{name: value for name, value in running.items() if name in names}},
    )


@study.command()
@_file
@option("--csv FILE", "Write all points with their attributes.", parse=output(".csv"))
@json_option
def show(file: Path, csv: Path | None) -> None:
    """Show the results, waiting points and attributes of a study."""
    from vtbdrake.optimization import Study

    with Study.open(file) as opened:
        say(opened.summary())
        queue, attributes = opened.queue, opened.attributes
        if queue:
            header = ["waiting", *(parameter.address for parameter in opened.parameters)]
            rows = [[str(number), *map(str, point.values())] for number, point in queue.items()]
            say("\n" + table(header, rows))
        drives = [
            {"number": d.number, "by": d.name, "value": d.outcome.value, "end": d.outcome.end, "start": d.parameters}
            for d in opened.driven
        ]
        for trial in opened.driven:
            say(f"driven by {trial.name} ({trial.number}): {number(trial.outcome.value)}, {trial.outcome.end}")
        for key, value in attributes.items():
            say(f"attribute {key}: {json.dumps(value)}")
        emit({**_described(opened), "waiting": queue, "driven": drives, "attributes": attributes})
        if csv is not None:
            write_csv(csv, opened.to_dict())


def _described(study: Study) -> dict[str, Any]:
    """Return the contents of a study by name, with the points as columns."""
    best = [{"point": trial.parameters, "values": trial.values} for trial in study.pareto()]
    record = {name: study.record[name] for name in ("solver", "seed")}
    return {**record, "rollouts": len(study), "best": best, "points": study.to_dict()}


# The arguments of each kind of intervention, and what it does.
_INTERVENTIONS = {
    "try": ("ADDRESS=VALUE [...]", "try a point with the next batch"),
    "pause": ("", "let the run finish its batch, and wait"),
    "resume": ("", "let a paused run go on"),
    "stop": ("", "end the run after its batch"),
    "range": (
        "ADDRESS=LOWER:UPPER|ADDRESS=OPTION,OPTION[,...]",
        "narrow or widen the range of a parameter; an end that is left out stays: ADDRESS=:2",
    ),
    "freeze": ("ADDRESS[=VALUE]", "hold a parameter at a value, by default at the best point's"),
    "unfreeze": ("ADDRESS", "vary a frozen parameter again"),
    "forbid": (
        "ADDRESS=LOWER:UPPER|ADDRESS=OPTION[,...] [...]",
        "forbid the box of all sides that are given; an end that is left out is open: ADDRESS=2:",
    ),
    "allow": ("NUMBER", "allow the region that intervention NUMBER forbids"),
    "budget": ("ROLLOUTS|none", "set the number of rollouts in the end, for this run and later ones; none: no limit"),
    "solver": ("SOLVER [--option NAME=VALUE]", "go on with another solver"),
    "aspiration": ("VALUE ...|none", "aim at values of several qualities, one each; none: at the whole Pareto front"),
}


def _payload(kind: str, arguments: tuple[str, ...], options: tuple[tuple[str, Any], ...]) -> dict[str, Any]:
    """Return the arguments of `Study.intervene` for the arguments of a command."""
    if options and kind != "solver":
        raise click.UsageError(f"--option is for another solver, not for {kind}")
    match kind, arguments:
        case (("pause" | "resume" | "stop"), ()):
            return {}
        case "try", (_, *_):
            return {"point": settings(map(parse_field, arguments))}
        case "range", (text,):
            address, ends = parse_limits(text)
            return {"address": address, **ends}
        case "freeze", (text,):
            address, value = parse_field(text) if "=" in text else (text, None)
            return {"address": address} | ({} if value is None else {"value": value})
        case "unfreeze", (address,):
            return {"address": address}
        case "forbid", (_, *_):
            sides = dict(map(parse_limits, arguments))
            return {"region": {a: side.get("options") or [side["lower"], side["upper"]] for a, side in sides.items()}}
        case "allow", (text,) if text.isdecimal():
            return {"number": int(text)}
        case "budget", (text,):
            return {"rollouts": parse_optional(text)}
        case "solver", (solver,):
            return {"solver": solver, "options": settings(options)}
        case "aspiration", ("none",):
            return {"targets": None}
        case "aspiration", (_, *_):
            return {"targets": [parse_optional(text) for text in arguments]}
    received = f"not {' '.join(arguments)!r}" if arguments else "and none is given"
    raise click.UsageError(f"{kind} takes {_INTERVENTIONS[kind][0] or 'no argument'}, {received}")


_KINDS_HELP = "\n".join(
    f"  {kind} {usage}".rstrip() + f"\n      {text}" for kind, (usage, text) in _INTERVENTIONS.items()
)


@study.command(
    context_settings={"ignore_unknown_options": True},  # A value may be negative.
    help=f"""Change a study with its next batch.

    Another process may run it meanwhile.

    \b
    KIND is one of these, followed by its arguments:
{indent(_KINDS_HELP, "    ")}

    \b
    Example:
      vtbdrake study intervene gait.db forbid dps.impl.gait.period=:1.5 dps.impl.gait.stroke=0.2:
    """,
)
@_file
@click.argument("kind", type=click.Choice(list(_INTERVENTIONS)), metavar="KIND")
@click.argument("arguments", nargs=-1, shell_complete=complete_parameter)
@_solver_options
@option("--by NAME", "Who makes the change.  [default: your login name]")
@json_option
def intervene(
    file: Path, kind: str, arguments: tuple[str, ...], options: tuple[tuple[str, Any], ...], by: str | None
) -> None:
    """Change a study with its next batch."""
    from vtbdrake.optimization import Study

    payload = _payload(kind, arguments, options)
    with Study.open(file) as opened:
        intervention = opened.intervene(kind, by=by, **payload)
        running = "" if opened.is_running else ", as soon as the study runs"
        say(f"intervention {intervention.number} waits for the next batch{running}: {intervention.text}")
        emit(intervention.to_dict())


@study.command()
@_file
@click.argument("new_file", callback=converted(output()), shell_complete=complete_file)
@option("--without NUMBER", "Leave out this intervention. May be repeated.", type=int, multiple=True)
@trust_option
@executor_options
@json_option
def replay(
    file: Path, new_file: Path, without: tuple[int, ...], trusted: tuple[str, ...], running: dict[str, Any]
) -> None:
    """Repeat a study in a new file.

    It is repeated from its first batch, with its interventions or without some of them.

    The problem is the one that FILE states. Rollouts that FILE has are not run again. See Study.replay.
    """
    from vtbdrake.optimization import Study
    from vtbdrake.optimization.statement import restated

    with Study.open(file) as opened:
        record = opened.record
    with (
        restated(record, trusted=trusted).study(file) as original,
        original.replay(new_file, without=without, **running) as repeated,
    ):
        say(repeated.summary())
        emit({**_described(repeated), "reason": repeated.reason})


@study.command()
@_file
@json_option
def history(file: Path) -> None:
    """List the interventions, with their batches."""
    from vtbdrake.optimization import Study

    with Study.open(file) as opened:
        interventions = opened.interventions
    rows = [
        [str(i.number), f"{i.time:%Y-%m-%d %H:%M:%S}", i.name, "waits" if i.batch is None else str(i.batch), i.text]
        for i in interventions
    ]
    say(table(["number", "time (UTC)", "name", "batch", "intervention"], rows))
    emit([intervention.to_dict() for intervention in interventions])


@study.command()
@_file
@click.argument("number", type=int)
@_point
@json_option
def edit(file: Path, number: int, point: tuple[tuple[str, Any], ...]) -> None:
    """Replace a waiting point; `show` lists the numbers."""
    from vtbdrake.optimization import Study

    with Study.open(file) as opened:
        opened.edit(number, settings(point))
        emit({"waiting": opened.queue})


@study.command()
@_file
@click.argument("number", type=int)
@json_option
def remove(file: Path, number: int) -> None:
    """Remove an intervention that waits."""
    from vtbdrake.optimization import Study

    with Study.open(file) as opened:
        opened.remove(number)
        emit({"waiting": opened.queue})


@study.command("attribute")
@_file
@click.argument("attribute", callback=converted(parse_field), metavar="KEY=VALUE")
@option("--trial NUMBER", "Set it for the point of this trial, not for the study.", type=int)
@json_option
def set_attribute(file: Path, attribute: tuple[str, Any], trial: int | None) -> None:
    """Set an attribute of a study, or of a point."""
    from vtbdrake.optimization import Study

    with Study.open(file) as opened:
        trials = opened.trials if trial is not None else ()
        if trial is not None and not 0 <= trial < len(trials):
            raise click.BadParameter(f"the study has {len(trials)} trials, counted from 0, and no trial {trial}")
        opened.set_attribute(*attribute, point=None if trial is None else trials[trial].parameters)
        emit(settings([attribute]))


@study.command("open")
@_file
@trust_option
@page_options
@browser_option
@json_option
def open_page(file: Path, trusted: tuple[str, ...], page: dict[str, Any], browser: bool) -> None:
    """Watch and steer a study in a web browser, until Ctrl-C.

    The study in FILE may be run by another process meanwhile, or by none. The page is served on this machine alone. An
    address is good for one browser.

    \b
    Example:
      vtbdrake study open gait.db
    """
    from vtbdrake.web import view_study

    with view_study(file, trusted=trusted, **page) as opened:
        serve(opened, browser=browser)


@study.command("continue")
@_file
@trust_option
@grouped(
    "running",
    option("--rollouts N", "End when the study has N rollouts.  [default: its budget]", type=click.IntRange(min=1)),
    option("--seconds S", "End after S seconds of wall time.", type=float),
)
@executor_options
@json_option
def go_on(file: Path, trusted: tuple[str, ...], running: dict[str, Any]) -> None:
    """Go on with a study whose problem FILE states."""
    from vtbdrake.optimization import Study
    from vtbdrake.optimization.statement import restated

    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s")
    with Study.open(file) as opened:
        record, budget = opened.record, opened.search.budget
    if running["rollouts"] is None and running["seconds"] is None:
        running["rollouts"] = budget
    with restated(record, trusted=trusted).study(file) as resumed:
        resumed.run(**running, racing=record.get("racing"))
        say(resumed.summary())
        emit({**_described(resumed), "reason": resumed.reason})
