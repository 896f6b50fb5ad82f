"""``vtbdrake set``, ``get`` and ``reset``: what others say to a DPS that runs."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import click
import numpy as np

from vtbdrake.cli.group import FailedError, one_line
from vtbdrake.cli.options import Setting, converted, parse_setting, settings, timeout_option, url_option
from vtbdrake.control.bridge import BridgeError
from vtbdrake.monitoring.live.client import LiveClient, LiveError, LiveTimeoutError


@click.command("set")
@click.argument("values", nargs=-1, required=True, callback=converted(parse_setting), metavar="ADDRESS=VALUE...")
@url_option
@timeout_option
def set_values(values: tuple[Setting, ...], url: str, timeout: float) -> None:
    """Set variables of a DPS that runs by vtbdrake run: all of them between two cycles, or none.

    A value is a number or a JSON list of numbers. The exit code is 1 if they are refused, or if nobody answers.

    \b
    Example:
      vtbdrake set --url tcpq://127.0.0.1:7700 u.motion=2 "dps.impl.stiffness=[20,20,20,900,900,900]"
    """
    with _client(url, timeout) as client:
        client.set(settings(values))


@click.command("get")
@click.argument("addresses", nargs=-1, required=True, metavar="ADDRESS...")
@url_option
@timeout_option
def get_values(addresses: tuple[str, ...], url: str, timeout: float) -> None:
    """Print variables and output ports of a DPS that runs by vtbdrake run, as they are between two cycles.

    \b
    Example:
      vtbdrake get --url tcpq://127.0.0.1:7700 u.motion dps.impl.stiffness
    """
    with _client(url, timeout) as client:
        values = client.get(addresses)
    for address, value in values.items():
        click.echo(f"{address} = {np.asarray(value).tolist()}")


@click.command("reset")
@url_option
@timeout_option
def reset_guards(url: str, timeout: float) -> None:
    """Let a DPS that runs by vtbdrake run command again, after a fault that is over.

    Prints what its guards had latched for. The exit code is 1 if a cause persists, or if nobody answers.

    \b
    Example:
      vtbdrake reset --url tcpq://127.0.0.1:7700
    """
    with _client(url, timeout) as client:
        released = client.reset()
    for reason in released:
        click.echo(f"over: {reason}")
    if not released:
        click.echo("nothing had latched")


@contextmanager
def _client(url: str, timeout: float) -> Iterator[LiveClient]:
    """
    Raises:
        FailedError: there is no bus, nobody answers, or what is asked for is refused.
    """
    try:
        with LiveClient(url, timeout=timeout) as client:
            yield client
    except (BridgeError, LiveError, LiveTimeoutError) as error:
        raise FailedError(one_line(error)) from error
