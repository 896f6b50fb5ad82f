"""The options of commands that serve a page, and its time: until Ctrl-C."""

from __future__ import annotations

import signal
import threading
import webbrowser

import click

from vtbdrake.cli.options import grouped, option
from vtbdrake.cli.output import say, show

page_options = grouped(
    "page",
    option("--port N", "The port on this machine; 0: any that is free.", type=click.IntRange(0, 65535), default=0),
    option(
        "--host NAME:PORT", "A name under which a proxy offers the page. May be repeated.", name="hosts", multiple=True
    ),
)
browser_option = option("--browser/--no-browser", "Open the page in a browser.", name="browser", default=True)


def serve(url: str, *, browser: bool) -> None:
    """Print the address of a page, open it, and return after Ctrl-C."""
    ended = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: ended.set())
    show(url, {"url": url})
    if browser and not webbrowser.open(url):
        say("no browser could be opened: open the address in one")
    ended.wait()
