"""The options of commands that serve a page, and its time: until Ctrl-C."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable
from typing import TYPE_CHECKING

import click

from vtbdrake.cli.options import grouped, option
from vtbdrake.cli.output import say, show
from vtbdrake.common.interrupt import ends_well

if TYPE_CHECKING:
    from vtbdrake.web.serving.web_page import WebPage


def _parse_host(text: str) -> str:
    from vtbdrake.web.serving.web_page import check_host

    try:
        check_host(text)
    except ValueError as error:
        raise click.BadParameter(str(error)) from error
    return text


page_options = grouped(
    "page",
    option("--port N", "The port on this machine; 0: any that is free.", type=click.IntRange(0, 65535), default=0),
    option(
        "--host NAME:PORT",
        "A name under which a proxy offers the page. May be repeated.",
        name="hosts",
        parse=_parse_host,
        multiple=True,
    ),
)
browser_option = option("--browser/--no-browser", "Open the page in a browser.", name="browser", default=True)


def serve(page: WebPage, *, browser: bool, ready: Callable[[], object] | None = None) -> None:
    """Print an address of a page, open it, and return after Ctrl-C.

    An address is good for one browser: when one has used it, the next one is printed.

    Args:
        page: The page, which is served already.
        browser: Whether to open it in the user's browser.
        ready: Called when Ctrl-C is the proper end.
    """
    ended = threading.Event()
    ends_well()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        if number != signal.SIGHUP or signal.getsignal(number) is not signal.SIG_IGN:  # `nohup` ignores it.
            signal.signal(number, lambda *_: ended.set())
    if ready is not None:
        ready()

    def print_next() -> None:
        say(f"for another browser: {page.address(used=print_next)}")

    url = page.address(used=print_next)
    show(url, {"url": url})
    if browser and not page.open_browser():
        say("no browser could be opened: open the address in one")
    ended.wait()
