"""What a hub is told."""

from __future__ import annotations

import pwd
from collections.abc import Sequence
from dataclasses import dataclass
from math import inf

from vtbdrake.lcm.hub.tcpq import MAX_CHANNEL, STATUS_CHANNEL, TAKE_PREFIX

MEBIBYTE = 1024 * 1024


@dataclass(frozen=True, kw_only=True)
class HubConfig:
    """Address, protected channels and limits of a hub.

    Raises:
        ValueError: a value is out of its range.
    """

    host: str = "127.0.0.1"  # the address to listen on
    port: int = 7700  # LCM's default; 0 for any that is free
    protect: Sequence[str] = ()  # channels with one publisher at a time (names, no patterns)
    lease: float = 0.5  # s after its last publication during which an owner cannot be succeeded
    max_message: int = 16 * MEBIBYTE  # largest data of a message, in bytes
    max_queue: int = 32 * MEBIBYTE  # largest backlog of a client, in bytes
    max_memory: int = 512 * MEBIBYTE  # largest sum of all backlogs and of all incomplete messages, in bytes
    max_clients: int = 128  # of another user at most a quarter, of all others three quarters
    users: Sequence[str | int] = ()  # who may connect besides the hub's own user and root, by name or number
    all_users: bool = False  # whether every user of this machine may connect
    # s after which a client that does not greet or does not read is disconnected, and one that does not complete a
    # message (which may take a second more for each MiB of it)
    patience: float = 5.0
    status_period: float = 1.0  # s between messages on the status channel
    priority: int = 0  # of SCHED_FIFO, 1 to 99, where the system grants it; 0: ordinary scheduling
    cpus: Sequence[int] = ()  # processors to run on, where the system grants them; empty: any

    def __post_init__(self) -> None:
        if isinstance(self.protect, str):
            raise ValueError(f"protect takes a sequence of channels, such as [{self.protect!r}], not a string")
        object.__setattr__(self, "protect", tuple(self.protect))
        for channel in self.protect:
            if channel == STATUS_CHANNEL or channel.startswith(TAKE_PREFIX):
                raise ValueError(f"the channel {channel!r} is the hub's own; protect channels of the clients")
            if not 0 < len((TAKE_PREFIX + channel).encode()) - len(TAKE_PREFIX) <= MAX_CHANNEL - len(TAKE_PREFIX):
                limit = MAX_CHANNEL - len(TAKE_PREFIX)
                raise ValueError(f"a protected channel has a name of 1 to {limit} bytes, unlike {channel!r}")
        object.__setattr__(self, "cpus", tuple(self.cpus))
        if any(not isinstance(cpu, int) or cpu < 0 for cpu in self.cpus):
            raise ValueError(f"processors have the numbers 0, 1, ..., unlike {self.cpus!r}")
        if isinstance(self.users, str):
            raise ValueError(f"users takes a sequence of users, such as [{self.users!r}], not a string")
        object.__setattr__(self, "users", tuple(map(_user_number, self.users)))
        ranges: dict[str, tuple[float, float]] = {
            "port": (0, 65535),
            "max_message": (1, 256 * MEBIBYTE),  # LCM_MAX_MESSAGE_SIZE
            "max_queue": (self.max_message + 12 + MAX_CHANNEL, inf),
            "max_memory": (self.max_queue, inf),
            "max_clients": (1, inf),
            "priority": (0, 99),
        }
        for name, (lower, upper) in ranges.items():
            value = getattr(self, name)
            if not lower <= value <= upper:
                raise ValueError(f"{name} lies between {lower:g} and {upper:g}, it cannot be {value!r}")
        for name in ("lease", "patience", "status_period"):
            value = getattr(self, name)
            if not 0.0 < value < inf:
                raise ValueError(f"{name} is a positive time in seconds, it cannot be {value!r}")


def _user_number(user: str | int) -> int:
    if isinstance(user, str) and not user.isdecimal():
        try:
            return pwd.getpwnam(user).pw_uid
        except KeyError:
            raise ValueError(f"there is no user {user!r} on this machine: give a name or a number") from None
    return int(user)
