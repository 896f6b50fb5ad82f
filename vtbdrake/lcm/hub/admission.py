"""Who may be a client of a hub, and how many of them."""

from __future__ import annotations

import os
import socket
from collections.abc import Collection
from typing import NamedTuple

from vtbdrake.lcm.hub.clients import ClientConnection
from vtbdrake.lcm.hub.config import HubConfig
from vtbdrake.lcm.hub.tcpq import peer_user

STRANGER, QUOTA, FULL = "user", "quota", "too many"
"""Reasons why a client is not let in, as they are counted."""


class Decision(NamedTuple):
    """What becomes of one that wants to be a client.

    Attributes:
        user: whose it is; None if nobody knows.
        reason: why it is not let in, one of those above; empty if it is.
        message: the same for whoever reads it there.
    """

    user: int | None
    reason: str = ""
    message: str = ""


class Admission:
    """Lets in the hub's own user, root, and those that `HubConfig` names.

    Beyond loopback nobody knows whose a client by TCP is: there whoever reaches the address is let in.

    Args:
        config: users and limits.
        on_loopback: whether the hub listens there alone.
    """

    def __init__(self, config: HubConfig, *, on_loopback: bool) -> None:
        self._own = {0, os.geteuid()}
        self._allowed = self._own | {int(user) for user in config.users}
        self._all = config.all_users
        self._on_loopback = on_loopback
        self._most = config.max_clients
        self._most_of_a_user = max(1, config.max_clients // 4)
        self._most_of_others = max(1, 3 * config.max_clients // 4)

    def decide(self, sock: socket.socket, clients: Collection[ClientConnection]) -> Decision:
        """Whether a client may be one more.

        Args:
            sock: connected to it.
            clients: those that there are.
        """
        local = sock.family == socket.AF_UNIX or self._on_loopback
        user = peer_user(sock) if local else None
        if local and not self._all and user not in self._allowed:
            whose = "a user that the kernel does not tell" if user is None else f"user {user}"
            remedy = "to let others in, start it with --user or --all-users"
            return Decision(user, STRANGER, f"it belongs to {whose}, and the hub is not open to that one ({remedy})")
        if local and user not in self._own:
            others = [client.user for client in clients if client.user not in self._own]
            most = self._most_of_others if user is None else self._most_of_a_user
            if len(others) >= self._most_of_others or others.count(user) >= most:
                limits = f"{self._most_of_a_user} for one, {self._most_of_others} for all others together"
                return Decision(user, QUOTA, f"the hub is full for other users than its own ({limits})")
        if len(clients) >= self._most:
            return Decision(user, FULL, f"the hub is full: max_clients={self._most} are connected; end some")
        return Decision(user)
