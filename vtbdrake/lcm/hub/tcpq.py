"""LCM's tcpq protocol, as liblcm speaks it (``lcm/lcm_tcpq.c``). All integers are unsigned, 32 bits, big-endian.

Client and hub greet each other with (magic, version). A client then sends records

    publish      1, length of the channel, channel, length of the data, data
    subscribe    2, length of the pattern, pattern
    unsubscribe  3, length of the pattern, pattern

and receives publications, in the same form as it sends them.

Instead of its greeting, this package's hub may send (refusal, length of a text, text) and close the connection. To
liblcm's clients that is no hub; this package's own show the text.
"""

from __future__ import annotations

import os
import socket
import struct

MAGIC_SERVER = 0x287617FA
MAGIC_CLIENT = 0x287617FB
MAGIC_REFUSAL = 0x287617FC
VERSION = 0x0100
MAX_REFUSAL = 500  # bytes of its text

GREET = 0  # not on the wire: what `reader.Reader` makes of a client's greeting
PUBLISH, SUBSCRIBE, UNSUBSCRIBE = 1, 2, 3

# liblcm allows 63 bytes in a channel's name on other transports, and sets no limit here.
MAX_CHANNEL = 255

STATUS_CHANNEL = "VTB_HUB"
TAKE_PREFIX = "VTB_HUB_TAKE/"

_PAIR = struct.Struct(">II")

GREETING = _PAIR.pack(MAGIC_SERVER, VERSION)


def refusal(reason: str) -> bytes:
    """What a client gets that is not let in."""
    text = reason.encode()[:MAX_REFUSAL]
    return _PAIR.pack(MAGIC_REFUSAL, len(text)) + text


# (type, channel or pattern, the record as it came)
Record = tuple[int, bytes, bytes | bytearray]


class ProtocolError(Exception):
    """A client that does not speak tcpq, or not within the limits.

    Attributes:
        reason: the kind of error, one of a few.
    """

    def __init__(self, reason: str, message: str) -> None:
        super().__init__(message)
        self.reason = reason


def client_name(fileno: int) -> str:
    """The name under which the hub knows the client with this socket, such as that of ``lcm.LCM.fileno``."""
    with socket.socket(fileno=os.dup(fileno)) as own:
        return address_name(own.getsockname())


def address_name(address: tuple[str, int] | str | bytes) -> str:
    """``host:port`` of a TCP socket, ``local:name`` of a Unix socket."""
    if isinstance(address, tuple):
        return f"{address[0]}:{address[1]}"
    name = os.fsencode(address).removeprefix(b"\0")  # of an abstract socket
    return f"local:{repr(name)[2:-1]}"  # It may be any bytes, and it is logged.
