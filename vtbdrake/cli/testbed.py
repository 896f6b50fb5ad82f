"""``vtbdrake variables``, ``diagram`` and ``rollout``: look at a testbed, and simulate it once."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from vtbdrake.cli import BadInputError, FailedError
from vtbdrake.cli.options import (
    LazyChoice,
    Setting,
    film_option,
    horizon_option,
    option,
    output,
    sample_period_option,
    scenario_argument,
    scene_option,
    set_option,
    settings,
    start_option,
)
from vtbdrake.cli.output import (
    RECORDINGS,
    emit,
    entries,
    json_option,
    number,
    save_recording,
    say,
    show,
    table,
    write_whole,
)
from vtbdrake.common.failures import one_line
from vtbdrake.common.settings import schema

if TYPE_CHECKING:
    import numpy as np
    from pydrake.systems.framework import Context

    from vtbdrake.rollout import RolloutResult
    from vtbdrake.state import Snapshot, Variable, Variables
    from vtbdrake.testbed import Scenario

# The number of entries of an array in a table of pedigrees.
_SHOWN = 6
# Larger arrays (images, clouds) get one line for all their entries.
_MANY = 64


@click.command()
@scenario_argument
@option("--match TEXT", "Show only addresses that contain TEXT.", default="")
@json_option
@option("--schema", "Print the JSON Schema of the scenario's fields instead.", name="as_schema", is_flag=True)
@option("--pedigree", "Show where the static numbers of the world are from instead.", name="by_source", is_flag=True)
def variables(scenario: Scenario, match: str, as_schema: bool, by_source: bool) -> None:
    """List the variables of a testbed, or the fields of its scenario.

    The table shows address, kind, shape, unit, bounds and the value in s0 of every element of the state. Kind x is the
    dynamic part of the state, kind a the static part. A derived variable can be read, but not set.

    With --pedigree, the table shows the numbers of the simulated world that do not change, and numeric fields of the
    scenario: their value, where they are from (assumed, datasheet, measured, calibrated), interval of 95 % and note.

    \b
    Example:
      vtbdrake variables space_climber --match payload
    """
    from vtbdrake.common.argument_checks import suggestion

    if as_schema:
        described = schema(type(scenario))
        show(json.dumps(described, indent=2), described)
        return
    testbed = scenario.build()
    listed = testbed.variables()
    matches = [variable for variable in listed.values() if match in variable.address]
    if not matches:
        raise BadInputError(f"no address contains {match!r}{suggestion(match, listed)}")
    context = testbed.default_context()
    if by_source:
        rows = _pedigree(scenario, [variable for variable in matches if not variable.derived], context, match)
        titles = ("address", "value", "source", "interval", "note")
        sources = [row[2] for row in rows]
        counts = ", ".join(f"{sources.count(each)} {each}" for each in dict.fromkeys(sources))
        show(f"{table(titles, rows)}\n{counts}", [dict(zip(titles, row, strict=True)) for row in rows])
    else:
        show(listed.table(context, pattern=match), [_described(variable, context) for variable in matches])


def _pedigree(
    scenario: Scenario, variables: list[Variable], context: Context, match: str
) -> list[tuple[str, str, str, str, str]]:
    """Return rows (address, value, source, interval, note) of the static numbers of the world, and of fields."""
    import numpy as np

    from vtbdrake.state.variables import A
    from vtbdrake.testbed.pedigree import Number

    numbers = scenario.pedigree.numbers
    texts: dict[str, str] = {}
    for variable in variables:
        array = np.ravel(variable.get(context)) + 0.0  # no negative zeros
        entries = [f"{variable.address}[{i}]" for i in range(array.size)]
        if any(entry in numbers for entry in entries):
            texts |= {entry: f"{value:.6g}" for entry, value in zip(entries, array, strict=True)}
        elif variable.address in numbers or (variable.kind == A and variable.address.startswith("sim.")):
            texts[variable.address] = " ".join(f"{value:.6g}" for value in array[:_SHOWN])
            texts[variable.address] += " ..." * (array.size > _SHOWN)
    fields = {f"scenario.{name}": f"{value:.6g}" for name, value in scenario.numeric_fields().items()}
    texts |= {address: text for address, text in fields.items() if match in address}
    rows = []
    for address, text in texts.items():
        number = numbers.get(address, Number())
        ends = [number.lower, number.upper]
        interval = "" if None in ends else f"[{number.lower:.6g}, {number.upper:.6g}]"
        rows.append((address, text, number.source, interval, number.note))
    return rows


def _described(variable: Variable, context: Context) -> dict[str, Any]:
    return {
        "address": variable.address,
        "kind": variable.kind,
        "derived": variable.derived,
        "shape": variable.shape,
        "unit": variable.unit,
        "bounds": variable.bounds,
        "value": variable.get(context),
    }


def _modes() -> list[str]:
    from vtbdrake.testbed.testbed import MODES

    return list(MODES)


@click.command()
@scenario_argument
@option("--mode", "The positions of the switches.", type=LazyChoice(_modes), default="sim")
@option("-o --output FILE", "Write to FILE, not to the terminal.", name="out", parse=output(".svg"))
@json_option
def diagram(scenario: Scenario, mode: str, out: Path | None) -> None:
    """Draw a testbed as SVG: DPS, switches, both worlds (Figure 4).

    \b
    Example:
      vtbdrake diagram space_climber -o climber.svg
    """
    from vtbdrake.visualization import svg

    text = svg(scenario.build(mode=mode))
    if out is None:
        show(text, {"svg": text})
    else:
        write_whole(out, text.encode())
        emit({"file": out})


@click.command()
@scenario_argument
@horizon_option
@set_option
@option("--record ADDRESS", "Record a variable or output port. May be repeated.", multiple=True)
@sample_period_option
@start_option
@option("--save FILE", "Write the recording: .csv or .npz.", parse=output(*RECORDINGS))
@option("--snapshot FILE", "Write s(t_end), for --start.", parse=output())
@option("--html FILE", "Write an animation for any web browser.", parse=output(".html"))
@film_option
@scene_option
@json_option
def rollout(
    scenario: Scenario,
    horizon: float,
    values: tuple[Setting, ...],
    record: tuple[str, ...],
    sample_period: float,
    start: Snapshot | None,
    save: Path | None,
    snapshot: Path | None,
    html: Path | None,
    film: Path | None,
    scene: Path | None,
) -> None:
    """Simulate a testbed once.

    The exit code is 1 if the simulation failed; the recording until then is written anyway.

    \b
    Example:
      vtbdrake rollout space_climber --horizon 15 \\
          --set sim.sys.payload.mass=40 --record sim.sys.climber.base.pitch --save pitch.csv
    """
    from vtbdrake.optimization.problem import PLANT_STATE
    from vtbdrake.rollout import RolloutRunner, RolloutTask

    if save is not None and not record:
        raise click.UsageError("--save writes the addresses of --record, but nothing is recorded")
    testbed = scenario.build()
    shown = [name for name, file in (("--html", html), ("--film", film)) if file is not None]
    if shown and testbed.plant is None:
        raise click.UsageError(f"{' and '.join(shown)} shows the motion of a plant, but this testbed has none")
    parameters = settings(values)
    for address, value in parameters.items():
        testbed.variables()[address].check(value)
    recorded = tuple(dict.fromkeys([*record, *([PLANT_STATE] if shown else [])]))
    task = RolloutTask(scenario, horizon, sample_period=sample_period, record=recorded, start=start)
    runner = RolloutRunner(task, testbed)
    result = runner.run(parameters)

    say(_outcome(result))
    recorded_result = replace(result, record={address: result.record[address] for address in record})
    rows = _extremes_rows(recorded_result, testbed.variables()) if recorded_result.times.size else []
    if rows:
        say("\n" + table(_RECORDED, [(row[0], row[1], *(_cell(value) for value in row[2:])) for row in rows]))
    described = {"end": result.end, "message": result.message, "simulated": _simulated(result)}
    described |= {"wall_time": result.wall_time, "recorded": [dict(zip(_RECORDED, row, strict=True)) for row in rows]}
    emit(described)
    if save is not None:
        save_recording(save, recorded_result.times, recorded_result.record)
    if shown:
        from vtbdrake.optimization import Motion
        from vtbdrake.visualization import make_meshcat, show_motion

        recording = show_motion(make_meshcat(), Motion.of(scenario, result))
        if html is not None:
            recording.save(html)
        if film is not None:
            recording.film(film)
    if scene is not None:
        from vtbdrake.visualization import write_rollout

        write_rollout(task, parameters, scene, testbed=testbed, end=_simulated(result))
    if result.failed:
        raise FailedError(f"the rollout failed: {one_line(result.message)}")
    if snapshot is not None:
        testbed.snapshot(runner.context).save(snapshot)


def _simulated(result: RolloutResult) -> float:
    return float(result.times[-1]) if result.times.size else 0.0


def _outcome(result: RolloutResult) -> str:
    simulated = _simulated(result)
    reason = f" ({one_line(result.message)})" if result.message and not result.failed else ""
    return "\n".join(
        (
            f"end               {result.end}{reason}",
            f"simulated time    {number(simulated)} s",
            f"wall time         {result.wall_time:.3f} s",
            f"real-time factor  {simulated / result.wall_time:.3g}",
        )
    )


# The columns of the table of what was recorded.
_RECORDED = ("recorded", "unit", "final", "min", "max")


def _extremes_rows(result: RolloutResult, variables: Variables) -> list[tuple[Any, ...]]:
    """Return name, unit, final, smallest and largest value of every recorded entry."""
    import numpy as np

    rows: list[tuple[Any, ...]] = []
    for address, values in result.record.items():
        unit = variables[address].unit if address in variables else ""
        if not isinstance(values, np.ndarray):
            rows.append((address, unit, f"{len(values)} values", None, None))
        elif values[0].size > _MANY:
            rows.append((address, unit, f"{values[0].size} entries", *_extremes(values)))
        else:
            rows += [(name, unit, float(column[-1]), *_extremes(column)) for name, column in entries(address, values)]
    return rows


def _cell(value: Any) -> str:
    return "" if value is None else value if isinstance(value, str) else number(value)


def _extremes(values: np.ndarray) -> tuple[float, float]:
    import numpy as np

    numbers = values[~np.isnan(values)]
    return (float(numbers.min()), float(numbers.max())) if numbers.size else (np.nan, np.nan)
