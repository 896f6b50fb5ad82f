"""LCM's tcpq protocol, as liblcm speaks it (``lcm/lcm_tcpq.c``). All integers are unsigned, 32 bits, big-endian.

Client and hub greet each other with (magic, version). A client then sends records

    publish      1, length of the channel, channel, length of the data, data
    subscribe    2, length of the pattern, pattern
    unsubscribe  3, length of the pattern, pattern

and receives publications, in the same form as it sends them.
"""

from __future__ import annotations

import os
import socket
import struct
from collections.abc import Iterator

MAGIC_SERVER = 0x287617FA
MAGIC_CLIENT = 0x287617FB
VERSION = 0x0100

GREET = 0  # not on the wire: what `Reader` makes of a client's greeting
PUBLISH, SUBSCRIBE, UNSUBSCRIBE = 1, 2, 3

# liblcm allows 63 bytes in a channel's name on other transports, and sets no limit here.
MAX_CHANNEL = 255

STATUS_CHANNEL = "VTB_HUB"
TAKE_PREFIX = "VTB_HUB_TAKE/"

_PAIR = struct.Struct(">II")
_LENGTH = struct.Struct(">I")

GREETING = _PAIR.pack(MAGIC_SERVER, VERSION)

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


def publication(channel: bytes, data: bytes) -> bytes:
    """The record that publishes ``data``."""
    return b"".join((_PAIR.pack(PUBLISH, len(channel)), channel, _LENGTH.pack(len(data)), data))


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


class Reader:
    """Makes records of the bytes that come from one client, in whatever pieces they come.

    Its memory grows with what has arrived, not with what was announced.

    Args:
        max_message: the largest data of a publication, in bytes.
    """

    def __init__(self, *, max_message: int) -> None:
        self._max_message = max_message
        self._buffer = bytearray()
        self._needed = _PAIR.size
        self.greeted = False

    @property
    def partial(self) -> bool:
        """Whether a record has begun and not ended."""
        return bool(self._buffer)

    def feed(self, data: bytes | memoryview) -> Iterator[Record]:
        """The records that ``data`` completes; to be taken to the end before the next call.

        Raises:
            ProtocolError: the client is of no use any more, after the records that came before.
        """
        if self._buffer or len(data) < self._needed:
            self._buffer += data
            if len(self._buffer) < self._needed:
                return
            come: bytes | bytearray = self._buffer
        else:
            come = bytes(data)
        have, at = len(come), 0
        if not self.greeted:
            self._check_greeting(come)
            at = _PAIR.size
            yield GREET, b"", bytes(come[:at])
        while True:
            kind, length, size = self._head(come, at, have - at)
            if size > have - at:
                break
            # A large message is handed on as it is, not copied.
            record = come if size == have else bytes(come[at : at + size])
            yield kind, bytes(come[at + 8 : at + 8 + length]), record
            at += size
        self._needed = size
        if at or come is not self._buffer:
            self._buffer = bytearray(come[at:])

    def _check_greeting(self, come: bytes | bytearray) -> None:
        magic, version = _PAIR.unpack_from(come)
        if magic != MAGIC_CLIENT:
            raise ProtocolError("greeting", f"begins with {magic:#010x}, a tcpq client with {MAGIC_CLIENT:#010x}")
        if version != VERSION:
            raise ProtocolError("greeting", f"speaks version {version:#06x} of tcpq, the hub {VERSION:#06x}")
        self.greeted = True

    def _head(self, come: bytes | bytearray, at: int, have: int) -> tuple[int, int, int]:
        """Type and length of the channel of the record that begins here, and its size in bytes; while too little of it
        has come to know, the size of the part that tells."""
        if have < 8:
            return 0, 0, 8
        kind, length = _PAIR.unpack_from(come, at)
        if not PUBLISH <= kind <= UNSUBSCRIBE:
            raise ProtocolError("malformed", f"sends a record of type {kind}, there are 1, 2 and 3")
        if not 0 < length <= MAX_CHANNEL:
            raise ProtocolError("malformed", f"sends a channel of {length} bytes, it has 1 to {MAX_CHANNEL}")
        if kind != PUBLISH:
            return kind, length, 8 + length
        if have < 12 + length:
            return kind, length, 12 + length
        size = _LENGTH.unpack_from(come, at + 8 + length)[0]
        if size > self._max_message:
            raise ProtocolError(
                "too large", f"sends a message of {size} bytes, the largest allowed has {self._max_message}"
            )
        return kind, length, 12 + length + size
