"""Ports of servers on the loopback interface."""

from __future__ import annotations

import socket
from contextlib import suppress


def loopback_port(port: int | None, usual: int) -> int:
    """Return a port of the loopback interface that is free, before a server of another library takes it.

    Such a server may not say that its port is taken, or take 0 for a port.

    Args:
        port: The port; 0: any that is free; None: the usual one, or any if that is taken.
        usual: The port at which viewers look for a server.

    Raises:
        OSError: It is taken.
    """
    if port is None:
        with suppress(OSError):
            return _free(usual)
        return _free(0)
    try:
        return _free(port)
    except OSError as error:
        text = f"port {port} of this machine cannot be taken ({error.strerror}): give another one, or 0"
        raise OSError(error.errno, text) from error


def _free(port: int) -> int:
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # A server that has just ended is no obstacle.
        probe.bind(("127.0.0.1", port))
        return int(probe.getsockname()[1])
