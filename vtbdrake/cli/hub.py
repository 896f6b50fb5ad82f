"""``vtbdrake hub``: an LCM bus over TCP."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Any

import click

from vtbdrake.cli.completion import complete_scenario
from vtbdrake.cli.options import config_option, converted, option, parse_scenario
from vtbdrake.cli.output import json_option, show
from vtbdrake.common.interrupt import ends_by_itself
from vtbdrake.lcm.hub import HubConfig, HubServer, serve

if TYPE_CHECKING:
    from vtbdrake.testbed import Scenario

_log = logging.getLogger(__name__)

_DEFAULT = HubConfig()
_MEBIBYTE = 1024 * 1024
_SIZES = ("max_message", "max_queue", "max_memory")  # MiB on the command line


@click.command()
@click.argument("scenario", required=False, callback=converted(parse_scenario), shell_complete=complete_scenario)
@config_option(_DEFAULT, "--host ADDRESS")
@config_option(_DEFAULT, "--port N")
@config_option(
    _DEFAULT,
    "--protect CHANNEL",
    "Let only one client publish on this channel: the first one, until another requests it on "
    "VTB_HUB_TAKE/CHANNEL while the owner pauses. May be repeated.",
    multiple=True,
)
@option("--unprotected", "Protect only the channels given by --protect.", is_flag=True)
@config_option(
    _DEFAULT,
    "--user NAME",
    "Name or id of a user that may connect. May be repeated.",
    field="users",
    multiple=True,
)
@config_option(_DEFAULT, "--all-users", is_flag=True)
@config_option(_DEFAULT, "--lease S")
@config_option(_DEFAULT, "--max-message MIB", per=_MEBIBYTE)
@config_option(_DEFAULT, "--max-queue MIB", per=_MEBIBYTE)
@config_option(_DEFAULT, "--max-memory MIB", per=_MEBIBYTE)
@config_option(_DEFAULT, "--max-clients N")
@config_option(_DEFAULT, "--patience S")
@config_option(_DEFAULT, "--priority N")
@config_option(
    _DEFAULT,
    "--cpu N",
    "Processor to run on, if the system grants it. May be repeated.",
    field="cpus",
    type=int,
    multiple=True,
)
@json_option
def hub(scenario: Scenario | None, protect: tuple[str, ...], unprotected: bool, **fields: Any) -> None:
    """Relay LCM messages over TCP, for networks without multicast.

    It runs until Ctrl-C. Only one client at a time may publish on the channels of the actuator commands of SCENARIO.
    LCM has no authentication: on loopback only this user and root may connect, beyond it every machine that reaches the
    address.

    Prints the URL for clients, and publishes statistics as JSON on VTB_HUB.

    \b
    Example:
      vtbdrake hub manipulator
      vtbdrake hub --protect IIWA_COMMAND
    """
    logging.basicConfig(format="%(asctime)s %(message)s", level=logging.INFO)
    channels: tuple[str, ...] = ()
    if scenario is not None:
        from vtbdrake.lcm.protocol import protocol_of

        channels = tuple(map.channel for map in protocol_of(scenario).act)
    defaults = () if unprotected else channels
    sizes = {name: fields.pop(name) * _MEBIBYTE for name in _SIZES}
    config = HubConfig(protect=tuple(dict.fromkeys((*protect, *defaults))), **sizes, **fields)
    server = HubServer(config)
    if not channels and not protect and not unprotected:
        _log.warning(
            "no channel of actuator commands is protected: give a SCENARIO, --protect CHANNEL, or --unprotected"
        )
    _log.info("protected channels: %s", ", ".join(config.protect) or "none")
    ends_by_itself()
    serve(server, ready=lambda: show(server.url, {"url": server.url}))
    statistics = server.statistics()
    show(
        f"{statistics.messages} messages relayed, {statistics.refused} rejected, "
        f"{statistics.dropped} dropped for slow clients",
        statistics,
    )
