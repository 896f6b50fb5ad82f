"""``vtbdrake hub``: an LCM bus over TCP."""

from __future__ import annotations

import logging

import click

from vtbdrake.control.hub import HubConfig, HubServer, serve
from vtbdrake.control.hub.config import MEBIBYTE

_DEFAULT = HubConfig()
_SIZE = click.IntRange(min=1)


@click.command("hub")
@click.option(
    "--host",
    default=_DEFAULT.host,
    show_default=True,
    metavar="ADDRESS",
    help="Where to listen; beyond loopback, whoever reaches the address is a client.",
)
@click.option("--port", type=int, default=_DEFAULT.port, show_default=True, metavar="N", help="0 for any that is free.")
@click.option(
    "--protect",
    multiple=True,
    metavar="CHANNEL",
    help="Let one client publish on this channel, the first that does; another takes it over on request only, by a "
    "message on VTB_HUB_TAKE/CHANNEL, when the owner has paused. May be repeated.",
)
@click.option(
    "--lease",
    type=float,
    default=_DEFAULT.lease,
    show_default=True,
    metavar="S",
    help="Seconds after its last message during which an owner cannot be succeeded.",
)
@click.option(
    "--max-message",
    type=_SIZE,
    default=_DEFAULT.max_message // MEBIBYTE,
    show_default=True,
    metavar="MIB",
    help="The largest message.",
)
@click.option(
    "--max-queue",
    type=_SIZE,
    default=_DEFAULT.max_queue // MEBIBYTE,
    show_default=True,
    metavar="MIB",
    help="The largest backlog of a client; it loses its oldest messages beyond that.",
)
@click.option(
    "--patience",
    type=float,
    default=_DEFAULT.patience,
    show_default=True,
    metavar="S",
    help="Disconnect a client that has not read for so many seconds.",
)
@click.option(
    "--priority",
    type=int,
    default=_DEFAULT.priority,
    show_default=True,
    metavar="N",
    help="Of real-time scheduling (SCHED_FIFO), 1 to 99, where the system grants it.",
)
@click.option(
    "--cpu",
    "cpus",
    type=int,
    multiple=True,
    metavar="N",
    help="A processor to run on, where the system grants it; may be given several times.",
)
def run_hub(
    host: str,
    port: int,
    protect: tuple[str, ...],
    lease: float,
    max_message: int,
    max_queue: int,
    patience: float,
    priority: int,
    cpus: tuple[int, ...],
) -> None:
    """Relay LCM messages over TCP, where multicast does not work, until Ctrl-C.

    Prints the URL that clients connect to. Its statistics are published on VTB_HUB, as JSON.

    \b
    Example:
      vtbdrake hub --protect IIWA_COMMAND
    """
    logging.basicConfig(format="%(asctime)s %(message)s", level=logging.INFO)
    config = HubConfig(
        host=host,
        port=port,
        protect=protect,
        lease=lease,
        max_message=max_message * MEBIBYTE,
        max_queue=max_queue * MEBIBYTE,
        patience=patience,
        priority=priority,
        cpus=cpus,
    )
    server = HubServer(config)
    click.echo(server.url)
    serve(server)
    statistics = server.statistics()
    click.echo(
        f"{statistics.messages} messages relayed, {statistics.refused} refused, "
        f"{statistics.dropped} lost by slow clients"
    )
