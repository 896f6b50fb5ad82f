"""``vtbdrake examples``: the scenarios with short names."""

from __future__ import annotations

import click

from vtbdrake.cli.output import json_option, say, show
from vtbdrake.common.scenario_names import named_scenarios


@click.command()
@json_option
def examples() -> None:
    """List the scenarios with short names, and what each of them shows.

    They come with vtbdrake or with other installed packages: the entry points of the group
    vtbdrake.scenarios in a pyproject.toml.

    \b
    Example:
      vtbdrake examples --json
      vtbdrake view cart_pole
    """
    described = [
        {"name": named.name, "scenario": named.scenario, "shows": named.summary, "package": named.package}
        for named in named_scenarios()
    ]
    width = max((len(entry["name"]) for entry in described), default=0)
    for entry in described:
        show(f"{entry['name']:{width}}  {entry['shows']}", entry)
    say("\nLook at one in a web browser: vtbdrake view NAME" if described else "no installed package has such names")
