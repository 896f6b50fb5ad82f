"""``vtbdrake hub``: an LCM bus over TCP."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import click

from vtbdrake.lcm.hub import HubConfig, HubServer, serve
from vtbdrake.monitoring.live.messages import RESET, SET

if TYPE_CHECKING:
    from vtbdrake.testbed import Scenario

_log = logging.getLogger(__name__)

_DEFAULT = HubConfig()
_MEBIBYTE = 1024 * 1024
_SIZES = ("max_message", "max_queue", "max_memory")  # MiB on the command line


def _load_scenario(ctx: click.Context, param: click.Parameter, name: str | None) -> Any:
    if name is None:
        return None
    # Without a scenario, the hub starts without Drake.
    from vtbdrake.testbed import load_scenario

    return load_scenario(name)


def _option(field: str, kind: Any, metavar: str, text: str) -> Callable[[Any], Any]:
    """Return the option that sets a field of `HubConfig`."""
    default = getattr(_DEFAULT, field)
    if field in _SIZES:
        default //= _MEBIBYTE
    name = "--" + field.replace("_", "-")
    return click.option(name, type=kind, default=default, show_default=True, metavar=metavar, help=text)


_POSITIVE = click.IntRange(min=1)


@click.command()
@click.argument("scenario", required=False, callback=_load_scenario)
@_option("host", str, "ADDRESS", "Address to listen on; beyond loopback, every machine that reaches it can connect.")
@_option("port", int, "N", "0: any free port.")
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
@_option("lease", float, "S", "Seconds after the owner's last message during which no other client can take over.")
@_option("max_message", _POSITIVE, "MIB", "Largest message.")
@_option("max_queue", _POSITIVE, "MIB", "Largest backlog of a client; beyond it, the oldest messages are dropped.")
@_option(
    "max_memory",
    _POSITIVE,
    "MIB",
    "Largest sum of all backlogs and incomplete messages; beyond it, the client with the most is disconnected.",
)
@_option("max_clients", _POSITIVE, "N", "Maximum number of clients at a time.")
@_option("patience", float, "S", "Seconds until a client is disconnected that does not read or complete a message.")
@_option(
    "priority", int, "N", "Priority of real-time scheduling (SCHED_FIFO), 1 to 99, if the system grants it; 0: none."
)
@click.option(
    "--cpu",
    "cpus",
    type=int,
    multiple=True,
    metavar="N",
    help="Processor to run on, if the system grants it. May be repeated.",
)
def hub(scenario: Scenario | None, protect: tuple[str, ...], unprotected: bool, **fields: Any) -> None:
    """Relay LCM messages over TCP until Ctrl-C, for networks without multicast.

    Only one client at a time may publish on the channels of the actuator commands of SCENARIO, on VTB_SET and on
    VTB_RESET. LCM has no authentication: on loopback only this user and root may connect, beyond it every machine that
    reaches the address.

    Prints the URL for clients, and publishes statistics as JSON on VTB_HUB.

    \b
    Example:
      vtbdrake hub vtbdrake_diagrams.manipulator:ManipulatorScenario
      vtbdrake hub --protect IIWA_COMMAND
    """
    logging.basicConfig(format="%(asctime)s %(message)s", level=logging.INFO)
    channels = () if scenario is None else _command_channels(scenario)
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


def _command_channels(scenario: Scenario) -> tuple[str, ...]:
    from vtbdrake.lcm.protocol import protocol_of

    return tuple(map.channel for map in protocol_of(scenario).act)
