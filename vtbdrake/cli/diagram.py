"""``vtbdrake diagram``: a picture of the testbed."""

from __future__ import annotations

from pathlib import Path

import click

from vtbdrake.cli.options import output as output_file
from vtbdrake.cli.options import scenario_argument
from vtbdrake.cli.text import write_whole
from vtbdrake.testbed import Scenario
from vtbdrake.testbed.testbed import MODES


@click.command("diagram")
@scenario_argument
@click.option(
    "--mode", type=click.Choice(list(MODES)), default="sim", show_default=True, help="Where the switches stand."
)
@click.option("-o", "--output", callback=output_file(), metavar="FILE", help="Write a file instead of to the terminal.")
def draw_diagram(scenario: Scenario, mode: str, output: Path | None) -> None:
    """Draw a testbed as SVG: DPS, switches, both worlds (Figure 4).

    \b
    Example:
      vtbdrake diagram diagrams.space_climber:SpaceClimberScenario -o climber.svg
    """
    from vtbdrake.visualization import svg

    text = svg(scenario.build(mode=mode))
    if output is None:
        click.echo(text)
    else:
        write_whole(output, text.encode())
