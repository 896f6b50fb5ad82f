"""A hub in a separate process."""

from __future__ import annotations

import contextlib
import logging
import socket
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from vtbdrake.common.child_process import ChildService, ending_signals, logging_in_thread, report_ready
from vtbdrake.control.realtime import RealTime
from vtbdrake.lcm.hub.hub_server import HubConfig, HubServer, listen
from vtbdrake.lcm.hub.routing import HubStatistics
from vtbdrake.lcm.hub.tcpq import address_name

_log = logging.getLogger(__name__)


class HubError(RuntimeError):
    """The process of a hub does not start, or has ended."""


class Hub(ChildService):
    """A hub in a separate process, which ends with `close`, or with the process that started it.

    ::

        with Hub(port=0, protect=["IIWA_COMMAND"]) as hub:
            bus = lcm.LCM(hub.url)

    Args:
        config: Address, protected channels and limits.
        fields: Fields of `HubConfig` that replace the fields of ``config``.

    Raises:
        ValueError: A field is out of range.
    """

    name, error = "the hub", HubError

    def __init__(self, config: HubConfig | None = None, **fields: Any) -> None:
        self.config = replace(config or HubConfig(), **fields)
        self._url = ""

    def start(self) -> None:
        """Start the hub and wait until clients can connect.

        Raises:
            HubAddressError: The hub cannot listen at its address.
            HubError: Its process does not start.
        """
        with contextlib.ExitStack() as stack:
            listener = stack.enter_context(listen(self.config))
            self._url = f"tcpq://{address_name(listener.getsockname())}"
            self.name = f"the hub at {self._url}"
            self._start(_serve_child, self.config, sockets=[listener])

    @property
    def url(self) -> str:
        """Return the URL for clients, ``tcpq://host:port``.

        Raises:
            HubError: The hub is not running.
        """
        self._running()
        return self._url

    def statistics(self) -> HubStatistics:
        """Return the present statistics.

        Raises:
            HubError: The hub does not answer.
        """
        return HubStatistics.from_json(self._request(b"?"))


def serve(server: HubServer, ready: Callable[[], None] = lambda: None) -> None:
    """Run a hub in the main thread of a process that does nothing else, until SIGTERM (or SIGINT, if not ignored).

    Args:
        server: The hub.
        ready: Called when processors and priority are set.
    """
    config = server.config
    settings = RealTime(
        priority=config.priority or None,
        cpus=set(config.cpus) or None,
        lock_memory=False,
        awake=False,
        switch_interval=None,
        longest_step=None,
    )
    with ending_signals(lambda *_: server.stop()), settings, logging_in_thread():
        for grant in settings.grants:
            if not grant.granted:
                _log.warning("%s", grant)
        ready()
        server.serve_forever()


def _serve_child(connection: socket.socket, config: HubConfig, listener: socket.socket) -> None:
    """Run the child process of a `Hub`."""
    logging.basicConfig(format="hub: %(message)s")
    server = HubServer(config, listener=listener, control=connection)
    serve(server, ready=lambda: report_ready(connection))
