"""A shorter way than TCP between a hub and those clients of the same machine that know it.

A message costs about half as much on a Unix socket as on loopback. So beside a loopback address, a hub listens on an
abstract Unix socket, whose name follows from the address. Like loopback itself, such names are those of one network
namespace, and gone with the process that listens. Where there is no such socket, TCP is the way.
"""

from __future__ import annotations

import logging
import os
import socket

from vtbdrake.lcm.hub.peers import peer_user

_log = logging.getLogger(__name__)

LOOPBACK = "127."

# The kernel counts over 1 KiB for a small message: with the buffer that it gives, 200 bytes at 1 kHz would be dropped
# when the hub is held up for 0.17 s. It grants what /proc/sys/net/core/wmem_max allows.
_SEND_BUFFER = 4 * 1024 * 1024


def shortcut_name(host: str, port: int) -> bytes | None:
    """The name of the socket beside a hub's address; None if that is not on loopback."""
    if host == "localhost":
        host = "127.0.0.1"
    return f"\0vtbdrake-hub/{host}:{port}".encode() if host.startswith(LOOPBACK) else None


def open_shortcut(host: str, port: int) -> socket.socket | None:
    """A socket that listens beside a hub's address, for those who `take_shortcut`; None, and a warning, if another has
    its name or there are no such sockets."""
    name = shortcut_name(host, port)
    if name is None:
        return None
    sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        sock.bind(name)
        sock.listen()
    except OSError as error:
        sock.close()
        _log.warning("there is TCP alone: the Unix socket %r is not to be had (%s)", name, error.strerror)
        return None
    return sock


def take_shortcut(host: str, port: int) -> socket.socket | None:
    """A connection to the hub at this address, made without waiting; None if there is no other way than TCP."""
    name = shortcut_name(host, port)
    if name is None:
        return None
    sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    sock.setblocking(False)
    try:
        sock.bind(b"")  # to a name that the kernel chooses, and by which the hub knows the client
        sock.connect(name)
        user = peer_user(sock)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER)
    except OSError:
        sock.close()
        return None
    # Anybody can take the name while no hub has it, and nothing that is said on the socket would tell him from the hub.
    # But the kernel says whose he is. Our own user could as well end the hub and take its port; a stranger could not.
    if user not in (0, os.geteuid()):
        sock.close()
        _log.warning("%r belongs to the user %s, neither to us nor to root: the hub is sought by TCP", name, user)
        return None
    return sock
