"""``vtbdrake variables``: what a testbed's state consists of."""

from __future__ import annotations

import json
from typing import Any

import click
from pydrake.systems.framework import Context

from vtbdrake.cli.group import BadInputError
from vtbdrake.cli.options import scenario_argument
from vtbdrake.cli.text import finite
from vtbdrake.state import Variable
from vtbdrake.state.variables import suggestion
from vtbdrake.testbed import Scenario


@click.command("variables")
@scenario_argument
@click.option("--match", default="", metavar="TEXT", help="Only addresses that contain this.")
@click.option("--json", "as_json", is_flag=True, help="A JSON list of objects instead of a table.")
def list_variables(scenario: Scenario, match: str, as_json: bool) -> None:
    """List the variables of a testbed.

    A table of address, kind, shape, unit, bounds and the value in s0 of every element of the state.

    Kind x is the dynamic part of the state, a the static part; a derived variable can be read, not set.

    \b
    Example:
      vtbdrake variables diagrams.space_climber:SpaceClimberScenario --match payload
    """
    testbed = scenario.build()
    listed = testbed.variables()
    chosen = [variable for variable in listed.values() if match in variable.address]
    if not chosen:
        raise BadInputError(f"no address contains {match!r}{suggestion(match, listed)}")
    context = testbed.default_context()
    if as_json:
        click.echo(json.dumps([_plain(variable, context) for variable in chosen], indent=2))
    else:
        click.echo(listed.table(context, pattern=match))


def _plain(variable: Variable, context: Context) -> dict[str, Any]:
    """A variable as plain data; null stands for what is not finite, so for an open bound."""
    value = variable.get(context)
    return {
        "address": variable.address,
        "kind": variable.kind,
        "derived": variable.derived,
        "shape": list(variable.shape),
        "unit": variable.unit,
        "bounds": [finite(bound) for bound in variable.bounds],
        "value": finite(value if isinstance(value, float) else value.tolist()),
    }
