"""``vtbdrake export-fmu``: a testbed, or its DPS, as a functional mock-up unit."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from vtbdrake.cli.completion import complete_file
from vtbdrake.cli.options import converted, option, output, scenario_argument
from vtbdrake.cli.output import json_option, show

if TYPE_CHECKING:
    from vtbdrake.testbed import Scenario

_NAMED = "It gets the name NAME in the FMU, by default its address. May be repeated."


def _addresses(texts: tuple[str, ...]) -> dict[str, str]:
    """Return the addresses by name of texts ``ADDRESS`` or ``NAME=ADDRESS``."""
    return {name: address or name for name, _, address in (text.partition("=") for text in texts)}


@click.command("export-fmu")
@scenario_argument
@click.argument("out", callback=converted(output(".fmu")), shell_complete=complete_file)
@option("--output [NAME=]ADDRESS", f"A variable or vector port to show. {_NAMED}", name="outputs", multiple=True)
@option("--input [NAME=]ADDRESS", f"A variable to set between steps. {_NAMED}", name="inputs", multiple=True)
@option("--parameter [NAME=]ADDRESS", f"A variable to set at the begin. {_NAMED}", name="parameters", multiple=True)
@option(
    "--part",
    "The whole testbed, the DPS alone, or the simulated world alone.",
    type=click.Choice(["testbed", "dps", "world"]),
    default="testbed",
)
@option(
    "--kind",
    "Machine code of the compiled testbed, or Drake in a Python process.",
    type=click.Choice(["native", "coupled"]),
    default="native",
)
@option("--step S", "The communication step that the FMU proposes; by default the least period.", type=float)
@json_option
def export_fmu(
    scenario: Scenario,
    out: Path,
    outputs: tuple[str, ...],
    inputs: tuple[str, ...],
    parameters: tuple[str, ...],
    part: str,
    kind: str,
    step: float | None,
) -> None:
    """Write a testbed, its DPS or its world as an FMU.

    The FMU is for co-simulation by FMI 3.0.

    Without --input, the inputs are the commands u, the sensor signals of the DPS alone, and the actuator signals of the
    world alone. Without --output, the outputs are the actuator signals of the DPS, and the sensor signals of the world.

    \b
    Example:
      vtbdrake export-fmu cart_pole cart_pole.fmu --output plant.state --output dps.force
      vtbdrake export-fmu cart_pole controller.fmu --part dps
    """
    from vtbdrake.common.extras import extra_module
    from vtbdrake.fmi import export_fmu as export

    export(
        scenario,
        out,
        outputs=_addresses(outputs) or None,
        inputs=_addresses(inputs) or None,
        parameters=_addresses(parameters),
        part=part,
        kind=kind,
        step=step,
    )
    fmpy = extra_module("fmpy", purpose="export-fmu", extra="fmi")
    variables = fmpy.read_model_description(str(out)).modelVariables
    rows = [f"{variable.causality:11} {variable.name}" for variable in variables]
    described = [{"name": variable.name, "causality": variable.causality} for variable in variables]
    show("\n".join(rows), {"file": out, "variables": described})
