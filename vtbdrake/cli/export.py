"""``vtbdrake export``: the log of a control loop in formats that other tools read."""

from __future__ import annotations

from pathlib import Path

import click

from vtbdrake.cli.options import output
from vtbdrake.recording.export import EXPORTS, export
from vtbdrake.recording.log_reader import read_log


@click.command("export")
@click.argument("log", type=click.Path(dir_okay=False, path_type=Path))
@click.argument("out", callback=output(*EXPORTS))
def export_log(log: Path, out: Path) -> None:
    """Write a LOG as MCAP (for Foxglove), CSV or Parquet; the name of OUT says which.

    \b
    Example:
      vtbdrake export run.lcm run.mcap
    """
    found = read_log(log)
    export(found, out)
    click.echo(found)
