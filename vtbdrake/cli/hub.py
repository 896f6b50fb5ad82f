"""``vtbdrake hub``: an LCM bus over TCP."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Any

import click

from vtbdrake.lcm.hub import HubConfig, HubServer, serve
from vtbdrake.lcm.hub.config import MEBIBYTE
from vtbdrake.monitoring.live.messages import RESET, SET

if TYPE_CHECKING:
    from vtbdrake.testbed import Scenario

_log = logging.getLogger(__name__)

_DEFAULT = HubConfig()
_SIZE = click.IntRange(min=1)


def _load_scenario(ctx: click.Context, param: click.Parameter, name: str | None) -> Any:
    if name is None:
        return None
    # A hub without a scenario needs nothing of Drake.
    from vtbdrake.testbed import load_scenario

    return load_scenario(name)


@click.command("hub")
@click.argument("scenario", required=False, callback=_load_scenario)
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
    help="Let one client publish on this channel, too, the first that does; another takes it over on request only, by "
    "a message on VTB_HUB_TAKE/CHANNEL, when the owner has paused. May be repeated.",
)
@click.option("--unprotected", is_flag=True, help="Protect nothing by default, only what --protect names.")
@click.option(
    "--user",
    "users",
    multiple=True,
    metavar="NAME",
    help="Let this user of the machine connect, too, by name or number. May be repeated.",
)
@click.option("--all-users", is_flag=True, help="Let every user of the machine connect.")
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
    "--max-memory",
    type=_SIZE,
    default=_DEFAULT.max_memory // MEBIBYTE,
    show_default=True,
    metavar="MIB",
    help="The largest sum of all backlogs and incomplete messages; beyond that, the client with most is disconnected.",
)
@click.option(
    "--max-clients",
    type=click.IntRange(min=1),
    default=_DEFAULT.max_clients,
    show_default=True,
    metavar="N",
    help="The most clients at a time.",
)
@click.option(
    "--patience",
    type=float,
    default=_DEFAULT.patience,
    show_default=True,
    metavar="S",
    help="Disconnect a client that has not read, or not completed a message, for so many seconds.",
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
    """Relay LCM messages over TCP, where multicast does not work, until Ctrl-C.

    On the command channels of a SCENARIO, one client at a time may publish; on VTB_SET and VTB_RESET, too. LCM has no
    authentication: on loopback only this user and root may connect, beyond it whoever reaches the address.

    Prints the URL that clients connect to. Its statistics are published on VTB_HUB, as JSON.

    \b
    Example:
      vtbdrake hub diagrams.manipulator:ManipulatorScenario
      vtbdrake hub --protect IIWA_COMMAND
    """
    logging.basicConfig(format="%(asctime)s %(message)s", level=logging.INFO)
    known = () if scenario is None else _command_channels(scenario)
    defaults = () if unprotected else (*known, SET, RESET)
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
    if not known and not protect and not unprotected:
        _log.warning(
            "no command channel is protected: name the SCENARIO whose commands it relays, or --protect CHANNEL; or say "
            "--unprotected"
        )
    _log.info("protected: %s", ", ".join(config.protect) or "nothing")
    click.echo(server.url)
    serve(server)
    statistics = server.statistics()
    click.echo(
        f"{statistics.messages} messages relayed, {statistics.refused} refused, "
        f"{statistics.dropped} lost by slow clients"
    )


def _command_channels(scenario: Scenario) -> tuple[str, ...]:
    from vtbdrake.lcm.protocol import protocol_of

    return tuple(map.channel for map in protocol_of(scenario).act)
