"""Which user of this machine is at the other end of a connection."""

from __future__ import annotations

import contextlib
import socket
import struct

_CREDENTIALS = struct.Struct("iII")  # process, user, group

# <linux/inet_diag.h>, <linux/sock_diag.h>: asks the kernel for one socket by its addresses. To read /proc/net/tcp
# instead takes many milliseconds on a machine with much memory, whose table of sockets is large.
_NETLINK_SOCK_DIAG = 4
_SOCK_DIAG_BY_FAMILY = 20
_NLM_F_REQUEST = 1
_HEADER = struct.Struct("=IHHII")  # length, type, flags, sequence, port
_REQUEST = struct.Struct("=BBBBI")  # family, protocol, extensions, padding, states
_SOCKET = struct.Struct(">HH16s16s")  # own port, peer's port, own address, peer's address
_ANY_COOKIE = struct.pack("=III", 0, 0xFFFFFFFF, 0xFFFFFFFF)  # any interface, any socket
_ANSWER = struct.Struct("=BBBB48sIIIII")  # ..., expires, rqueue, wqueue, user, inode


def peer_user(sock: socket.socket) -> int | None:
    """The user at the other end of a connected socket; None if that is no living socket of this machine, or if the
    kernel does not tell.

    Args:
        sock: a Unix socket, or one of TCP by IPv4.
    """
    if sock.family == socket.AF_UNIX:
        credentials = sock.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size)
        return int(_CREDENTIALS.unpack(credentials)[1])
    with contextlib.suppress(OSError, struct.error):
        return _tcp_user(sock.getpeername(), sock.getsockname())
    return None


def _tcp_user(own: tuple[str, int], peer: tuple[str, int]) -> int | None:
    """Whose the socket of TCP with these addresses is."""
    addresses = _SOCKET.pack(own[1], peer[1], socket.inet_aton(own[0]), socket.inet_aton(peer[0])) + _ANY_COOKIE
    request = _REQUEST.pack(socket.AF_INET, socket.IPPROTO_TCP, 0, 0, 0xFFFFFFFF) + addresses
    header = _HEADER.pack(_HEADER.size + len(request), _SOCK_DIAG_BY_FAMILY, _NLM_F_REQUEST, 1, 0)
    with socket.socket(socket.AF_NETLINK, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK, _NETLINK_SOCK_DIAG) as kernel:
        kernel.send(header + request)  # The kernel answers before it returns.
        answer = kernel.recv(4096)
    if _HEADER.unpack_from(answer)[1] != _SOCK_DIAG_BY_FAMILY:
        return None
    *_, user, inode = _ANSWER.unpack_from(answer, _HEADER.size)
    # A socket that its process has closed belongs to nobody; of such, the kernel may say that they are root's.
    return int(user) if inode else None
