"""``vtbdrake view``: watch and steer a testbed in a web browser."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from vtbdrake.cli.options import Setting, option, parse_url, scenario_argument, set_option, settings, start_option
from vtbdrake.cli.output import json_option
from vtbdrake.cli.page import browser_option, page_options, serve

if TYPE_CHECKING:
    from vtbdrake.state import Snapshot
    from vtbdrake.testbed import Scenario

_FILE = click.Path(exists=True, dir_okay=False, path_type=Path)


@click.command()
@scenario_argument
@set_option
@start_option
@page_options
@option("--vr", "Let headsets that open the page lead the robot by a hand.", is_flag=True)
@option(
    "--url URL",
    "The LCM bus of a loop (vtbdrake run), which is shown instead of a simulation; with --vr, hands lead its robot.",
    parse=parse_url,
)
@option("--tls NAME", "Serve the page by https, at this name or address of this machine, to its network.")
@option("--certificate FILE", "With --tls, a certificate (PEM); one is made if it is left out.", type=_FILE)
@option("--key FILE", "With --certificate, its private key (PEM).", type=_FILE)
@option("--play", "Let time run at once.", is_flag=True)
@browser_option
@json_option
def view(
    scenario: Scenario,
    values: tuple[Setting, ...],
    start: Snapshot | None,
    page: dict[str, Any],
    vr: bool,
    url: str | None,
    tls: str | None,
    certificate: Path | None,
    key: Path | None,
    play: bool,
    browser: bool,
) -> None:
    """Watch and steer a testbed in a web browser, until Ctrl-C.

    The page is served on this machine alone, unless --tls is given, and its address has a token: who has both can steer
    the testbed.

    \b
    Example:
      vtbdrake view vtbdrake_diagrams.cart_pole:CartPoleScenario
      vtbdrake view vtbdrake_diagrams.cart_pole:CartPoleScenario --url tcpq://127.0.0.1:7700
    """
    from vtbdrake.web import view as open_view
    from vtbdrake.web import view_loop
    from vtbdrake.web.tls import Tls

    if (certificate or key) and not tls:
        raise click.UsageError("--certificate and --key go with --tls")
    page |= {"tls": Tls(name=tls, certificate=certificate, key=key) if tls else None}
    if url and not vr:
        if values or start is not None or play:
            raise click.UsageError("a loop is shown as it is: leave --set, --start and --play out, or --url")
        with view_loop(scenario, url, **page) as watched:
            serve(watched.url, browser=browser)
        return
    page |= {"vr": vr, "url": url or ""}
    with open_view(scenario, start=start, values=settings(values), **page) as running:
        if play:
            running.session.play()
        serve(running.url, browser=browser)
