"""``vtbdrake rollout``: one simulation of a testbed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import click

from vtbdrake.cli.group import FailedError, one_line
from vtbdrake.cli.options import (
    Setting,
    horizon_option,
    output,
    sample_period_option,
    scenario_argument,
    set_option,
    settings,
    start_option,
)
from vtbdrake.cli.recording import WRITERS, save_recording, summary
from vtbdrake.cli.text import number
from vtbdrake.optimization import Motion
from vtbdrake.rollout import RolloutResult, RolloutRunner, RolloutTask
from vtbdrake.state import Snapshot
from vtbdrake.testbed import Scenario

# The port from which the motion of the simulated world is drawn.
PLANT_STATE = "plant.state"


@click.command("rollout")
@scenario_argument
@horizon_option
@set_option
@click.option("--record", multiple=True, metavar="ADDRESS", help="A variable or output port. May be repeated.")
@sample_period_option
@start_option
@click.option("--save", callback=output(*WRITERS), metavar="FILE", help="Write what is recorded: .csv or .npz.")
@click.option("--snapshot", callback=output(), metavar="FILE", help="Write s(t_end), for --start.")
@click.option("--html", callback=output(".html"), metavar="FILE", help="Write an animation, for any web browser.")
def run_rollout(
    scenario: Scenario,
    horizon: float,
    values: tuple[Setting, ...],
    record: tuple[str, ...],
    sample_period: float,
    start: Snapshot | None,
    save: Path | None,
    snapshot: Path | None,
    html: Path | None,
) -> None:
    """Simulate a testbed once.

    The exit code is 1 if the simulation failed. What was recorded until then is written all the same.

    \b
    Example:
      vtbdrake rollout diagrams.space_climber:SpaceClimberScenario --horizon 15 \\
          --set sim.sys.payload.mass=40 --record sim.sys.climber.base.pitch --save pitch.csv
    """
    if save is not None and not record:
        raise click.UsageError("--save writes what --record names, but nothing is recorded")
    testbed = scenario.build()
    if html is not None and testbed.plant is None:
        raise click.UsageError("--html shows how the simulated world moves, but this testbed has no plant")
    parameters = settings(values)
    for address, value in parameters.items():
        testbed.variables()[address].check(value)
    recorded = tuple(dict.fromkeys([*record, *([PLANT_STATE] if html is not None else [])]))
    task = RolloutTask(scenario, horizon, sample_period=sample_period, record=recorded, start=start)
    runner = RolloutRunner(task, testbed)
    result = runner.run(parameters)

    click.echo(_outcome(result))
    asked = replace(result, record={address: result.record[address] for address in record})
    if asked.times.size and asked.record:
        click.echo("\n" + summary(asked, testbed.variables()))
    if save is not None:
        save_recording(asked, save)
    if html is not None:
        _write_html(Motion(scenario, result.times, result.record[PLANT_STATE]), html)
    if result.failed:
        raise FailedError(f"the rollout failed: {one_line(result.message)}")
    if snapshot is not None:
        testbed.snapshot(runner.context).save(snapshot)


def _outcome(result: RolloutResult) -> str:
    simulated = float(result.times[-1]) if result.times.size else 0.0
    reason = f" ({one_line(result.message)})" if result.message and not result.failed else ""
    return "\n".join(
        (
            f"end               {result.end}{reason}",
            f"simulated time    {number(simulated)} s",
            f"wall time         {result.wall_time:.3f} s",
            f"real-time factor  {simulated / result.wall_time:.3g}",
        )
    )


def _write_html(motion: Motion, path: Path) -> None:
    from vtbdrake.visualization import make_meshcat, show_motion

    show_motion(make_meshcat(), motion).save(path)
