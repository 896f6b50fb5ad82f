"""``vtbdrake hub``: an LCM bus over TCP."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Any

import click

from vtbdrake.lcm.hub import HubConfig, HubServer, serve
from vtbdrake.lcm.hub.server import MEBIBYTE
from vtbdrake.monitoring.live.messages import RESET, SET

if TYPE_CHECKING:
    from vtbdrake.testbed import Scenario

_log = logging.getLogger(__name__)

_DEFAULT = HubConfig()
_SIZE = click.IntRange(min=1)


def _load_scenario(ctx: click.Context, param: click.Parameter, name: str | None) -> Any:
    if name is None:
        return None
    # Without a scenario, the hub starts without Drake.
    from vtbdrake.testbed import load_scenario

    return load_scenario(name)


@click.command("hub")
@click.argument("scenario", required=False, callback=_load_scenario)
@click.option(
    "--host",
    default=_DEFAULT.host,
    show_default=True,
    metavar="ADDRESS",
    help="Address to listen on; beyond loopback, every machine that reaches it can connect.",
)
@click.option("--port", type=int, default=_DEFAULT.port, show_default=True, metavar="N", help="0: any free port.")
@click.option(
    "--protect",
    multiple=True,
    metavar="CHANNEL",
    help="Let only one client publish on this channel: the first one, until another requests it on "
    "VTB_HUB_TAKE/CHANNEL while the owner pauses. May be repeated.",
)
@click.option("--unprotected", is_flag=True, help="Protect only the channels given by --protect.")
@click.option(
    "--user",
    "users",
    multiple=True,
    metavar="NAME",
    help="Name or id of a user that may connect, too. May be repeated.",
)
@click.option("--all-users", is_flag=True, help="Let every user of this machine connect.")
@click.option(
    "--lease",
    type=float,
    default=_DEFAULT.lease,
    show_default=True,
    metavar="S",
    help="Seconds after the owner's last message during which no other client can take over.",
)
@click.option(
    "--max-message",
    type=_SIZE,
    default=_DEFAULT.max_message // MEBIBYTE,
    show_default=True,
    metavar="MIB",
    help="Largest message.",
)
@click.option(
    "--max-queue",
    type=_SIZE,
    default=_DEFAULT.max_queue // MEBIBYTE,
    show_default=True,
    metavar="MIB",
    help="Largest backlog of a client; beyond it, the oldest messages are dropped.",
)
@click.option(
    "--max-memory",
    type=_SIZE,
    default=_DEFAULT.max_memory // MEBIBYTE,
    show_default=True,
    metavar="MIB",
    help="Largest sum of all backlogs and incomplete messages; beyond it, the client with the most is disconnected.",
)
@click.option(
    "--max-clients",
    type=click.IntRange(min=1),
    default=_DEFAULT.max_clients,
    show_default=True,
    metavar="N",
    help="Maximum number of clients at a time.",
)
@click.option(
    "--patience",
    type=float,
    default=_DEFAULT.patience,
    show_default=True,
    metavar="S",
    help="Seconds after which a client is disconnected that does not read, or does not complete a message.",
)
@click.option(
    "--priority",
    type=int,
    default=_DEFAULT.priority,
    show_default=True,
    metavar="N",
    help="Priority of real-time scheduling (SCHED_FIFO), 1 to 99, if the system grants it.",
)
@click.option(
    "--cpu",
    "cpus",
    type=int,
    multiple=True,
    metavar="N",
    help="Processor to run on, if the system grants it. May be repeated.",
)
def run_hub(
    scenario: Scenario | None,
    host: str,
    port: int,
    protect: tuple[str, ...],
    unprotected: bool,
    users: tuple[str, ...],
    all_users: bool,
    lease: float,
    max_message: int,
    max_queue: int,
    max_memory: int,
    max_clients: int,
    patience: float,
    priority: int,
    cpus: tuple[int, ...],
) -> None:
    """Relay LCM messages over TCP until Ctrl-C, for networks without multicast.

    Only one client at a time may publish on the channels of the actuator commands of SCENARIO, on VTB_SET and on
    VTB_RESET. LCM has no authentication: on loopback only this user and root may connect, beyond it every machine that
    reaches the address.

    Prints the URL for clients, and publishes statistics as JSON on VTB_HUB.

    \b
    Example:
      vtbdrake hub diagrams.manipulator:ManipulatorScenario
      vtbdrake hub --protect IIWA_COMMAND
    """
    logging.basicConfig(format="%(asctime)s %(message)s", level=logging.INFO)
    channels = () if scenario is None else _command_channels(scenario)
    defaults = () if unprotected else (*channels, SET, RESET)
    config = HubConfig(
        host=host,
        port=port,
        protect=tuple(dict.fromkeys((*protect, *defaults))),
        users=users,
        all_users=all_users,
        lease=lease,
        max_message=max_message * MEBIBYTE,
        max_queue=max_queue * MEBIBYTE,
        max_memory=max_memory * MEBIBYTE,
        max_clients=max_clients,
        patience=patience,
        priority=priority,
        cpus=cpus,
    )
    server = HubServer(config)
    if not channels and not protect and not unprotected:
        _log.warning(
            "no channel of actuator commands is protected: give a SCENARIO, --protect CHANNEL, or --unprotected"
        )
    _log.info("protected channels: %s", ", ".join(config.protect) or "none")
    click.echo(server.url)
    serve(server)
    statistics = server.statistics()
    click.echo(
        f"{statistics.messages} messages relayed, {statistics.refused} rejected, "
        f"{statistics.dropped} dropped for slow clients"
    )


def _command_channels(scenario: Scenario) -> tuple[str, ...]:
    from vtbdrake.lcm.protocol import protocol_of

    return tuple(map.channel for map in protocol_of(scenario).act)
