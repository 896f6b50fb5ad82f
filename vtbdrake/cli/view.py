"""``vtbdrake view``: watch and steer a testbed in a web browser."""

from __future__ import annotations

import signal
import threading
import webbrowser
from typing import TYPE_CHECKING

import click

from vtbdrake.cli.options import Setting, option, scenario_argument, set_option, settings, start_option
from vtbdrake.cli.output import json_option, show

if TYPE_CHECKING:
    from vtbdrake.state import Snapshot
    from vtbdrake.testbed import Scenario


@click.command()
@scenario_argument
@set_option
@start_option
@option("--port N", "The port on this machine; 0: any that is free.", type=click.IntRange(0, 65535), default=0)
@option("--host NAME:PORT", "A name under which a proxy offers the page. May be repeated.", name="hosts", multiple=True)
@option("--play", "Let time run at once.", is_flag=True)
@option("--browser/--no-browser", "Open the page in a browser.", name="browser", default=True)
@json_option
def view(
    scenario: Scenario,
    values: tuple[Setting, ...],
    start: Snapshot | None,
    port: int,
    hosts: tuple[str, ...],
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

    ended = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: ended.set())
    with open_view(scenario, start=start, values=settings(values), port=port, hosts=hosts) as running:
        show(running.url, {"url": running.url})
        if play:
            running.session.play()
        if browser:
            webbrowser.open(running.url)
        ended.wait()
