"""``vtbdrake replay``: a recorded DPS does again what it did."""

from __future__ import annotations

from pathlib import Path

import click
import numpy as np

from vtbdrake.cli.group import FailedError, one_line
from vtbdrake.cli.options import Setting, output, set_option, settings
from vtbdrake.cli.recording import WRITERS
from vtbdrake.recording.log_reader import read_log
from vtbdrake.recording.replay import DIFFERENT, replay
from vtbdrake.testbed import DpsAlone
from vtbdrake.testbed.scenario import class_name
from vtbdrake.testbed.scenario_file import scenario_class


@click.command("replay")
@click.argument("log", type=click.Path(dir_okay=False, path_type=Path))
@click.option(
    "--scenario",
    metavar="MODULE:CLASS",
    help="The scenario that the log is of. Its code runs, so it is you who names it; the log has its fields.",
)
@click.option(
    "--on",
    type=click.Choice(["recorded", "dps", "testbed"]),
    default="recorded",
    show_default=True,
    help="Replay it with what was recorded, the DPS alone or the whole testbed.",
)
@set_option
@click.option("--record", multiple=True, metavar="ADDRESS", help="Read this after every cycle. May be repeated.")
@click.option(
    "--out", callback=output(*WRITERS), metavar="FILE", help="Where to write what was recorded (.csv or .npz)."
)
def replay_log(
    log: Path,
    scenario: str | None,
    on: str,
    values: tuple[Setting, ...],
    record: tuple[str, ...],
    out: Path | None,
) -> None:
    """Replay a LOG and compare: the DPS commands the same, to the last bit, or it fails.

    With --set, a variable has another value throughout, and nothing is compared.

    \b
    Example:
      vtbdrake replay run.lcm --scenario diagrams.manipulator:ManipulatorScenario
    """
    if bool(record) != bool(out):
        raise click.UsageError("--record ADDRESS says what to read, --out FILE where to write it: give both or neither")
    found = read_log(log)
    recorded = found.header.scenario_name
    if scenario is None and recorded:
        raise click.UsageError(
            f"{log} is of the scenario {recorded}, and to import it runs its code: if you trust it, say "
            f"--scenario {recorded}"
        )
    if scenario is not None and (given := class_name(scenario_class(scenario))) != recorded:
        raise click.UsageError(f"{log} is of the scenario {recorded or 'that nobody knows'}, not of {given}")
    target = None if on == "recorded" else DpsAlone(found.scenario) if on == "dps" else found.scenario.build()
    report = replay(found, target, values=settings(values), record=record)
    if out is not None:
        for address, samples in report.record.items():
            if not isinstance(samples, np.ndarray):
                raise ValueError(f"{address} is not numeric, and cannot be written to {out}")
        WRITERS[out.suffix](out, report.times, report.record)
    click.echo(report)
    if report.outcome == DIFFERENT:
        raise FailedError(one_line(f"the replay differs: {report.first_difference}"))
