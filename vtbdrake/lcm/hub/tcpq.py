"""LCM's tcpq protocol as liblcm speaks it (``lcm/lcm_tcpq.c``), and the sockets that carry it.

All integers are unsigned, 32 bits, big-endian. Client and hub greet each other with (magic, version). A client then
sends the records

    publish      1, length of the channel, channel, length of the data, data
    subscribe    2, length of the pattern, pattern
    unsubscribe  3, length of the pattern, pattern

and receives publications in the same form.

Instead of its greeting, this package's hub may send (rejection, length of a text, text) and close the connection.
liblcm's clients report that no hub is listening; this package's clients show the text.
"""

from __future__ import annotations

import contextlib
import os
import socket
import struct
from enum import IntEnum

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

# <linux/inet_diag.h>, <linux/sock_diag.h>: ask the kernel for one socket by its addresses. Reading /proc/net/tcp
# instead takes many milliseconds on a machine with much memory, whose socket table is large.
_NETLINK_SOCK_DIAG = 4
_SOCK_DIAG_BY_FAMILY = 20
_NLM_F_REQUEST = 1
_DIAG_REQUEST = struct.Struct("=IHHII BBBBI HH16s16s III")  # header; requested data; addresses; interface, cookie
_DIAG_ANSWER = struct.Struct("=IHHII BBBB48s III II")  # header; state, addresses; timer, queues; user, inode


class TcpqError(Exception):
    """A client violated the protocol or its limits.

    Args:
        reason: The kind of the violation, as `HubStatistics.disconnected` counts it.
        message: The violation in a sentence.
    """

    def __init__(self, reason: str, message: str) -> None:
        super().__init__(message)
        self.reason = reason  # kind of the violation, as counted in `HubStatistics.disconnected`


def rejection(reason: str) -> bytes:
    """Return the bytes that the hub sends, instead of its greeting, to a client that it rejects."""
    text = reason.encode()[:MAX_REJECTION]
    return _PAIR.pack(MAGIC_REJECTION, len(text)) + text


def client_name(fileno: int) -> str:
    """Return the name by which the hub knows the client with this socket, such as ``lcm.LCM(url).fileno()``."""
    with socket.socket(fileno=os.dup(fileno)) as duplicate:
        return address_name(duplicate.getsockname())


def address_name(address: tuple[str, int]) -> str:
    """Return ``host:port`` for the address of a socket."""
    return f"{address[0]}:{address[1]}"


def peer_user(sock: socket.socket) -> int | None:
    """Return the user id at the other end of a connected socket; None if the kernel does not know it.

    The kernel knows the users of open sockets on this machine.
    """
    with contextlib.suppress(OSError):
        return user_of(sock.getpeername(), sock.getsockname())
    return None


def user_of(address: tuple[str, int], peer: tuple[str, int]) -> int | None:
    """Return the user id of the socket with this IPv4 address that is connected to ``peer``; None if it is not known.

    Args:
        address: Host and port of the socket.
        peer: Host and port of the other end.
    """
    with contextlib.suppress(OSError, struct.error):
        request = _DIAG_REQUEST.pack(
            *(_DIAG_REQUEST.size, _SOCK_DIAG_BY_FAMILY, _NLM_F_REQUEST, 1, 0),
            *(socket.AF_INET, socket.IPPROTO_TCP, 0, 0, 0xFFFFFFFF),  # in any state
            *(socket.htons(address[1]), socket.htons(peer[1]), socket.inet_aton(address[0]), socket.inet_aton(peer[0])),
            *(0, 0xFFFFFFFF, 0xFFFFFFFF),  # any interface, any socket
        )
        with socket.socket(socket.AF_NETLINK, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK, _NETLINK_SOCK_DIAG) as kernel:
            kernel.send(request)  # The kernel answers before it returns.
            _, kind, *_, user, inode = _DIAG_ANSWER.unpack_from(kernel.recv(4096))
        # A socket that its process has closed has no owner; the kernel may report root as its user.
        return int(user) if kind == _SOCK_DIAG_BY_FAMILY and inode else None
    return None
