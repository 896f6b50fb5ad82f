"""A tcpq hub: an LCM bus over TCP for networks without multicast, with channels on which only one client may publish.

Unmodified LCM clients connect to it: ``lcm.LCM(hub.url)``, ``DrakeLcm(hub.url)``. The hub relays every publication,
byte for byte, to all clients that subscribed to its channel, including the publisher. It listens on loopback by
default.

* **Admission.** Clients of the hub's own user and of root may connect, and clients of ``users`` (or ``all_users``). LCM
  has no authentication: the kernel reports the user of a client. Beyond loopback it cannot, and every client is
  admitted. A rejected client is sent the reason.
* **Isolation.** The hub never waits for a client.

  1. Clients are served in turns: only some messages of a busy client are handled before the next client is served.
  2. Messages that a client does not read are queued up to ``max_queue`` bytes; then the oldest are dropped and
     counted. A client is disconnected if it reads nothing of its backlog for ``patience`` seconds, violates the
     protocol, sends a message larger than ``max_message`` or does not complete one in time.
  3. If backlogs and incomplete messages exceed ``max_memory`` bytes, the clients with the most are disconnected.
  4. If ``max_clients`` are connected, a new client replaces one that has neither subscribed nor published for
     ``patience`` seconds. Every user other than the hub's own and root is limited to a quarter of the connections, all
     of them to three quarters.
  5. A client whose patterns take too long to match receives all messages; every client filters again.
  6. Log messages that clients can cause many times per second are rate-limited.
* **Protected channels** have one publisher at a time, the owner.

  1. The first client that publishes on the channel becomes the owner. Each of its publications renews its lease of
     ``lease`` seconds.
  2. Publications of other clients are rejected, counted and reported, even after the lease has expired: a pause of the
     owner does not give the channel to a client that did not request it.
  3. A client requests the channel by publishing anything on ``VTB_HUB_TAKE/<channel>``. It becomes the owner if there
     is none, or if the owner's lease has expired; otherwise the request is rejected and reported. Rule 2 then holds
     for the former owner, if it resumes.
  4. An owner that has nothing to send keeps the channel by publishing anything on ``VTB_HUB_KEEP/<channel>``, which
     counts as a publication that no subscriber receives. From another client it has no effect, unless the channel is
     free (rule 1).
  5. If the owner disconnects, its lease continues: until it expires, only a request gives the channel to a client;
     then the channel is free (rule 1). So no other client gets it while a controller restarts or is replaced.

  Delays of the hub itself extend the leases.
* **Status.** The hub publishes its `HubStatistics` as JSON on ``VTB_HUB`` every ``status_period`` seconds, and within
  10 ms after a change of an owner or a rejection. Clients are named after their sockets, ``127.0.0.1:41234``;
  `client_name` returns the name of a client. Clients cannot publish on ``VTB_HUB``.
* **Next to a control loop** the hub works best on the loop's own processor (``cpus``) at a lower ``priority``. On
  another processor, every actuator command must wake that processor; at a higher priority, the hub interrupts the
  sending cycle.
"""

from vtbdrake.lcm.hub.hub_process import Hub, HubError, serve
from vtbdrake.lcm.hub.hub_server import HubAddressError, HubConfig, HubServer
from vtbdrake.lcm.hub.routing import ChannelStatistics, HubStatistics
from vtbdrake.lcm.hub.tcpq import KEEP_PREFIX, STATUS_CHANNEL, TAKE_PREFIX, client_name

__all__ = [
    "KEEP_PREFIX",
    "STATUS_CHANNEL",
    "TAKE_PREFIX",
    "ChannelStatistics",
    "Hub",
    "HubAddressError",
    "HubConfig",
    "HubError",
    "HubServer",
    "HubStatistics",
    "client_name",
    "serve",
]
