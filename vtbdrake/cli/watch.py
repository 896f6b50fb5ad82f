"""``vtbdrake watch``: how variables of a DPS that runs in another process change."""

from __future__ import annotations

import json
from itertools import islice

import click
import numpy as np

from vtbdrake.cli.group import FailedError, one_line
from vtbdrake.cli.options import timeout_option, url_option
from vtbdrake.cli.text import finite
from vtbdrake.control.bridge import BridgeError
from vtbdrake.monitoring.live.client import LiveError, LiveTimeoutError, watch


@click.command("watch")
@click.argument("addresses", nargs=-1, required=True, metavar="ADDRESS...")
@url_option
@click.option(
    "--every",
    type=click.IntRange(min=1),
    default=100,
    show_default=True,
    metavar="N",
    help="Cycles from line to line.",
)
@click.option("--count", type=click.IntRange(min=1), metavar="N", help="End after so many lines; endless by default.")
@timeout_option
def watch_values(addresses: tuple[str, ...], url: str, every: int, count: int | None, timeout: float) -> None:
    """Print variables and output ports of a DPS that runs by vtbdrake run, until Ctrl-C or its end.

    One JSON object a line: the DPS's time in seconds, and the values by address; null for what is not finite.

    \b
    Example:
      vtbdrake watch --url tcpq://127.0.0.1:7700 dps.impl.torque --every 500
    """
    try:
        for time, values in islice(watch(url, addresses, every=every, timeout=timeout), count):
            plain = {address: finite(np.asarray(value).tolist()) for address, value in values.items()}
            click.echo(json.dumps({"time": time, **plain}))
    except (BridgeError, LiveError, LiveTimeoutError) as error:
        raise FailedError(one_line(error)) from error
    except KeyboardInterrupt:
        return
