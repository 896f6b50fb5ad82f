"""``vtbdrake get``, ``set``, ``watch`` and ``reset``: read and change a DPS that runs in another process."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import islice

import click

from vtbdrake.cli import FailedError
from vtbdrake.cli.options import Setting, converted, option, parse_setting, settings, timeout_option, url_option
from vtbdrake.cli.output import emit, json_option, say, show
from vtbdrake.common.failures import one_line
from vtbdrake.common.json_data import plain

_addresses = click.argument("addresses", nargs=-1, required=True, metavar="ADDRESS...")


@click.command("set")
@click.argument("values", nargs=-1, required=True, callback=converted(parse_setting), metavar="ADDRESS=VALUE...")
@url_option
@timeout_option
@json_option
def set_(values: tuple[Setting, ...], url: str, timeout: float) -> None:
    """Set variables of a running DPS, all in one cycle or none.

    A value is a number or a JSON list of numbers. The exit code is 1 if they are rejected, or without an answer.

    \b
    Example:
      vtbdrake set --url tcpq://127.0.0.1:7700 u.motion=2 "dps.impl.stiffness=[20,20,20,900,900,900]"
    """
    from vtbdrake.monitoring.live.client import LiveClient

    with _failures(), LiveClient(url, timeout=timeout) as client:
        client.set(settings(values))
    emit(settings(values))


@click.command()
@_addresses
@url_option
@timeout_option
@json_option
def get(addresses: tuple[str, ...], url: str, timeout: float) -> None:
    """Print variables and output ports of a running DPS once.

    All are read between the same two cycles of vtbdrake run.

    \b
    Example:
      vtbdrake get --url tcpq://127.0.0.1:7700 u.motion dps.impl.stiffness
    """
    import numpy as np

    from vtbdrake.monitoring.live.client import LiveClient

    with _failures(), LiveClient(url, timeout=timeout) as client:
        values = client.get(addresses)
    for address, value in values.items():
        say(f"{address} = {np.asarray(value).tolist()}")
    emit(values)


@click.command()
@_addresses
@url_option
@option("--every N", "Print every Nth cycle.", type=click.IntRange(min=1), default=100)
@option("--count N", "End after N lines.  [default: endless]", type=click.IntRange(min=1))
@timeout_option
@json_option
def watch(addresses: tuple[str, ...], url: str, every: int, count: int | None, timeout: float) -> None:
    """Print variables and output ports of a running DPS repeatedly.

    It prints until Ctrl-C, or until vtbdrake run ends. Each line is a JSON object with the time of the DPS in seconds
    and the values by address, with --json or without. A value that is not finite is null.

    \b
    Example:
      vtbdrake watch --url tcpq://127.0.0.1:7700 dps.impl.torque --every 500
    """
    from vtbdrake.monitoring.live.client import watch as watch_live

    with _failures():
        try:
            for time, values in islice(watch_live(url, addresses, every=every, timeout=timeout), count):
                click.echo(json.dumps({"time": time, **plain(values)}))
        except KeyboardInterrupt:
            return


@click.command()
@url_option
@timeout_option
@json_option
def reset(url: str, timeout: float) -> None:
    """Let a running DPS command again after a fault that is over.

    Prints the faults that had latched. The exit code is 1 if a cause persists, or without an answer.

    \b
    Example:
      vtbdrake reset --url tcpq://127.0.0.1:7700
    """
    from vtbdrake.monitoring.live.client import LiveClient

    with _failures(), LiveClient(url, timeout=timeout) as client:
        released = client.reset()
    text = "\n".join(f"this fault is over: {reason}" for reason in released)
    show(text or "no fault had latched", {"released": released})


@contextmanager
def _failures() -> Iterator[None]:
    from vtbdrake.monitoring.live.client import LiveError, LiveTimeoutError

    try:
        yield
    except (LiveError, LiveTimeoutError) as error:
        raise FailedError(one_line(error)) from error
