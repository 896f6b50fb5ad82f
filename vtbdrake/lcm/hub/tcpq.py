"""LCM's tcpq protocol as liblcm speaks it (``lcm/lcm_tcpq.c``), and the sockets that carry it.

All integers are unsigned, 32 bits, big-endian. Client and hub greet each other with (magic, version). A client then
sends the records

    publish      1, length of the channel, channel, length of the data, data
    subscribe    2, length of the pattern, pattern
    unsubscribe  3, length of the pattern, pattern

and receives publications in the same form.

Instead of its greeting, this package's hub may send (rejection, length of a text, text) and close the connection.
liblcm's clients report that no hub is listening; this package's clients show the text.

Shortcut: a message costs about half as much on a Unix socket as on loopback TCP. Beside a loopback address, the hub
therefore listens on an abstract Unix socket whose name follows from the address. Like loopback itself, such a name
belongs to one network namespace and disappears with the process that listens. Clients without the shortcut use TCP.
"""

from __future__ import annotations

import contextlib
import logging
import os
import socket
import struct
from enum import IntEnum

_log = logging.getLogger(__name__)

MAGIC_SERVER = 0x287617FA
MAGIC_CLIENT = 0x287617FB
MAGIC_REJECTION = 0x287617FC
VERSION = 0x0100
MAX_REJECTION = 500  # bytes of the text
MAX_CHANNEL = 255  # bytes; liblcm allows 63 on other transports and sets no limit here


class RecordType(IntEnum):
    """The type of a record."""

    GREETING = 0  # not on the wire: how `TcpqReader` reports a client's greeting
    PUBLISH = 1
    SUBSCRIBE = 2
    UNSUBSCRIBE = 3


STATUS_CHANNEL = "VTB_HUB"
TAKE_PREFIX = "VTB_HUB_TAKE/"
KEEP_PREFIX = "VTB_HUB_KEEP/"
LOOPBACK = "127."

_PAIR = struct.Struct(">II")
GREETING = _PAIR.pack(MAGIC_SERVER, VERSION)

Record = tuple[int, bytes, bytes | bytearray]
"""Type, channel or pattern, and the complete record as received."""

# The kernel counts over 1 KiB for a small message: with the default buffer, messages of 200 bytes at 1 kHz would be
# dropped when the hub is delayed by 0.17 s. The kernel grants at most /proc/sys/net/core/wmem_max.
_SEND_BUFFER = 4 * 1024 * 1024

# <linux/inet_diag.h>, <linux/sock_diag.h>: ask the kernel for one socket by its addresses. Reading /proc/net/tcp
# instead takes many milliseconds on a machine with much memory, whose socket table is large.
_NETLINK_SOCK_DIAG = 4
_SOCK_DIAG_BY_FAMILY = 20
_NLM_F_REQUEST = 1
_DIAG_REQUEST = struct.Struct("=IHHII BBBBI HH16s16s III")  # header; requested data; addresses; interface, cookie
_DIAG_ANSWER = struct.Struct("=IHHII BBBB48s III II")  # header; state, addresses; timer, queues; user, inode


class TcpqError(Exception):
    """A client violated the protocol or its limits."""

    def __init__(self, reason: str, message: str) -> None:
        super().__init__(message)
        self.reason = reason  # kind of the violation, as counted in `HubStatistics.disconnected`


def rejection(reason: str) -> bytes:
    """Return what the hub sends, instead of its greeting, to a client that it rejects."""
    text = reason.encode()[:MAX_REJECTION]
    return _PAIR.pack(MAGIC_REJECTION, len(text)) + text


def client_name(fileno: int) -> str:
    """Return the name by which the hub knows the client with this socket, such as ``lcm.LCM(url).fileno()``."""
    with socket.socket(fileno=os.dup(fileno)) as own:
        return address_name(own.getsockname())


def address_name(address: tuple[str, int] | str | bytes) -> str:
    """Return ``host:port`` for the address of a TCP socket, ``local:name`` for that of a Unix socket."""
    if isinstance(address, tuple):
        return f"{address[0]}:{address[1]}"
    name = os.fsencode(address).removeprefix(b"\0")  # of an abstract socket
    return f"local:{repr(name)[2:-1]}"  # The name may contain any bytes, and it is logged.


def shortcut_name(host: str, port: int) -> bytes | None:
    """Return the name of the Unix socket beside a hub's address; None if the address is not on loopback."""
    if host == "localhost":
        host = "127.0.0.1"
    return f"\0vtbdrake-hub/{host}:{port}".encode() if host.startswith(LOOPBACK) else None


def listen_shortcut(host: str, port: int) -> socket.socket | None:
    """Return the Unix socket that listens beside a hub's address; None, with a warning, if it cannot be opened."""
    name = shortcut_name(host, port)
    if name is None:
        return None
    sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        sock.bind(name)
        sock.listen()
    except OSError as error:
        sock.close()
        _log.warning("clients can connect by TCP only: cannot listen on the Unix socket %r (%s)", name, error.strerror)
        return None
    return sock


def connect_shortcut(host: str, port: int, *, quiet: bool = False) -> socket.socket | None:
    """Connect to the Unix socket of the hub at this address without waiting; return None if only TCP is possible.

    Args:
        host: The hub's address.
        port: Its port.
        quiet: Log no warning if another user listens there.
    """
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
    # While no hub holds the name, any user can take it and imitate a hub; the kernel tells which user listens. This
    # user could also end the hub and take its port; another user could not.
    if user not in (0, os.geteuid()):
        sock.close()
        if not quiet:
            _log.warning("using TCP: the Unix socket %r belongs to user %s, neither this user nor root", name, user)
        return None
    return sock


def peer_user(sock: socket.socket) -> int | None:
    """Return the user id at the other end of a connected socket; None if the kernel does not know it.

    The kernel knows the users of open sockets on this machine.
    """
    if sock.family == socket.AF_UNIX:
        _, user, _ = struct.unpack("iII", sock.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12))
        return int(user)
    with contextlib.suppress(OSError, struct.error):
        return _tcp_user(sock.getpeername(), sock.getsockname())
    return None


def _tcp_user(own: tuple[str, int], peer: tuple[str, int]) -> int | None:
    """Return the user of the TCP socket with the address ``own`` that is connected to ``peer``."""
    request = _DIAG_REQUEST.pack(
        *(_DIAG_REQUEST.size, _SOCK_DIAG_BY_FAMILY, _NLM_F_REQUEST, 1, 0),
        *(socket.AF_INET, socket.IPPROTO_TCP, 0, 0, 0xFFFFFFFF),  # in any state
        *(socket.htons(own[1]), socket.htons(peer[1]), socket.inet_aton(own[0]), socket.inet_aton(peer[0])),
        *(0, 0xFFFFFFFF, 0xFFFFFFFF),  # any interface, any socket
    )
    with socket.socket(socket.AF_NETLINK, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK, _NETLINK_SOCK_DIAG) as kernel:
        kernel.send(request)  # The kernel answers before it returns.
        _, kind, *_, user, inode = _DIAG_ANSWER.unpack_from(kernel.recv(4096))
    # A socket that its process has closed has no owner; the kernel may report root as its user.
    return int(user) if kind == _SOCK_DIAG_BY_FAMILY and inode else None
