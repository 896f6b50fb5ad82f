"""``vtbdrake view``: watch and steer a testbed in a web browser."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from vtbdrake.cli.options import Setting, option, scenario_argument, set_option, settings, start_option
from vtbdrake.cli.output import json_option
from vtbdrake.cli.page import browser_option, page_options, serve

if TYPE_CHECKING:
    from vtbdrake.state import Snapshot
    from vtbdrake.testbed import Scenario


@click.command()
@scenario_argument
@set_option
@start_option
@page_options
@option("--play", "Let time run at once.", is_flag=True)
@browser_option
@json_option
def view(
    scenario: Scenario,
    values: tuple[Setting, ...],
    start: Snapshot | None,
    page: dict[str, Any],
    play: bool,
    browser: bool,
) -> None:
    """Watch and steer a testbed in a web browser, until Ctrl-C.

    The page is served on this machine alone, and its address has a token: who has both can steer the testbed.

    \b
    Example:
      vtbdrake view vtbdrake_diagrams.cart_pole:CartPoleScenario
    """
    from vtbdrake.web import view as open_view

    with open_view(scenario, start=start, values=settings(values), **page) as running:
        if play:
            running.session.play()
        serve(running.url, browser=browser)
