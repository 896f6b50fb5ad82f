"""``vtbdrake hub``: an LCM bus over TCP."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import click

from vtbdrake.cli.options import converted, option, parse_scenario
from vtbdrake.lcm.hub import HubConfig, HubServer, serve
from vtbdrake.monitoring.live.messages import RESET, SET

if TYPE_CHECKING:
    from vtbdrake.testbed import Scenario

_log = logging.getLogger(__name__)

_DEFAULT = HubConfig()
_MEBIBYTE = 1024 * 1024
_SIZES = ("max_message", "max_queue", "max_memory")  # MiB on the command line


def _option(usage: str, text: str, **settings: Any) -> Callable[[Any], Any]:
    """Return the option that sets a field of `HubConfig`."""
    field = usage.split()[0].removeprefix("--").replace("-", "_")
    default = getattr(_DEFAULT, field)
    return option(usage, text, default=default // _MEBIBYTE if field in _SIZES else default, **settings)


_POSITIVE = click.IntRange(min=1)


@click.command()
@click.argument("scenario", required=False, callback=converted(parse_scenario))
@_option("--host ADDRESS", "Address to listen on; beyond loopback, every machine that reaches it can connect.")
@_option("--port N", "0: any free port.")
@option(
    "--protect CHANNEL",
    "Let only one client publish on this channel: the first one, until another requests it on "
    "VTB_HUB_TAKE/CHANNEL while the owner pauses. May be repeated.",
    multiple=True,
)
@option("--unprotected", "Protect only the channels given by --protect.", is_flag=True)
@option("--user NAME", "Name or id of a user that may connect, too. May be repeated.", name="users", multiple=True)
@option("--all-users", "Let every user of this machine connect.", is_flag=True)
@_option("--lease S", "Seconds after the owner's last message during which no other client can take over.")
@_option("--max-message MIB", "Largest message.", type=_POSITIVE)
@_option("--max-queue MIB", "Largest backlog of a client; beyond it, the oldest messages are dropped.", type=_POSITIVE)
@_option(
    "--max-memory MIB",
    "Largest sum of all backlogs and incomplete messages; beyond it, the client with the most is disconnected.",
    type=_POSITIVE,
)
@_option("--max-clients N", "Maximum number of clients at a time.", type=_POSITIVE)
@_option("--patience S", "Seconds until a client is disconnected that does not read or complete a message.")
@_option("--priority N", "Priority of real-time scheduling (SCHED_FIFO), 1 to 99, if the system grants it; 0: none.")
@option(
    "--cpu N", "Processor to run on, if the system grants it. May be repeated.", name="cpus", type=int, multiple=True
)
def hub(scenario: Scenario | None, protect: tuple[str, ...], unprotected: bool, **fields: Any) -> None:
    """Relay LCM messages over TCP, for networks without multicast.

    It runs until Ctrl-C. Only one client at a time may publish on the channels of the actuator commands of SCENARIO, on
    VTB_SET and on VTB_RESET. LCM has no authentication: on loopback only this user and root may connect, beyond it
    every machine that reaches the address.

    Prints the URL for clients, and publishes statistics as JSON on VTB_HUB.

    \b
    Example:
      vtbdrake hub vtbdrake_diagrams.manipulator:ManipulatorScenario
      vtbdrake hub --protect IIWA_COMMAND
    """
    logging.basicConfig(format="%(asctime)s %(message)s", level=logging.INFO)
    channels: tuple[str, ...] = ()
    if scenario is not None:
        from vtbdrake.lcm.protocol import protocol_of

        channels = tuple(map.channel for map in protocol_of(scenario).act)
    defaults = () if unprotected else (*channels, SET, RESET)
    sizes = {name: fields.pop(name) * _MEBIBYTE for name in _SIZES}
    config = HubConfig(protect=tuple(dict.fromkeys((*protect, *defaults))), **sizes, **fields)
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
