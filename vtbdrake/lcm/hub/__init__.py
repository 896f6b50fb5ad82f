"""A tcpq hub: an LCM bus over TCP for places where multicast does not work, with channels that one client commands.

Unmodified LCM clients use it: ``lcm.LCM(hub.url)``, ``DrakeLcm(hub.url)``. It relays every publication, byte for byte,
to all clients that subscribed to its channel, the publisher included.

* **Clients** are processes of the hub's own user and of root, and of the users that ``users`` names (or ``all_users``).
  LCM itself has no authentication: the kernel says whose a client is. Beyond loopback it cannot, and whoever reaches
  the address is a client. One that is not let in is told why, as far as its LCM library shows it.
* **Nobody holds up the others.** The hub never waits for a client.

  1. Clients take turns: from one that sends much, only some messages are handled before it is another's turn.
  2. What a client does not read is queued, up to ``max_queue`` bytes; beyond that its oldest messages are dropped and
     counted. A client that takes nothing off its queue for ``patience`` seconds is disconnected. So is one that breaks
     the protocol, that sends a message larger than ``max_message``, or that does not complete one in time.
  3. When more than ``max_memory`` bytes are queued or incomplete, the clients with most of them are disconnected.
  4. When there are ``max_clients``, a client that has neither subscribed nor published for ``patience`` seconds makes
     room for the next one. Other users than the hub's own and root have a quarter of the places each, three together.
  5. A client with more patterns than the hub can match quickly gets all messages; every client filters again.
  6. What clients can cause many times a second is logged at a limited rate.
* **Protected channels** have one publisher at a time, the owner.

  1. The first client to publish on the channel becomes the owner. Each of its publications renews its lease, which
     lasts ``lease`` seconds.
  2. What any other client publishes there is dropped, counted and reported. That the owner's lease is over does not
     change this: a pause (or a freeze) of the owner lets nobody in who did not ask.
  3. A client that wants to succeed publishes on ``VTB_HUB_TAKE/<channel>`` (the content does not matter). It becomes
     the owner if there is none, or if the owner's lease is over; otherwise the request is refused and reported. When
     the former owner thaws, it is any other client: rule 2.
  4. When the owner's connection closes, its lease runs on: until it is over, only who asks for the channel gets it;
     then it is free: rule 1. So nobody slips in while a controller is started again or its successor takes over.

  A time in which the hub itself was held up does not count against a lease.
* **Status.** The hub publishes its `HubStatistics` as JSON on ``VTB_HUB``, every ``status_period`` seconds, and within
  10 ms when the owner of a channel changes or something is refused. Clients have the names of their sockets,
  ``127.0.0.1:41234`` or ``local:00a3f``; `client_name` tells a client its own. No client can publish on ``VTB_HUB``.
* **Shortcut.** Beside a loopback address the hub listens on a Unix socket, by which a message costs less; this
  package's own clients take that way by themselves, and are clients like all others.

* **Beside a control loop** it does best on the loop's own processor (``cpus``), at a lower ``priority``. On another
  one, every command that leaves has to wake that up, and at a higher priority the hub interrupts the cycle that sends.

It listens on loopback unless another address is asked for by name.
"""

from vtbdrake.lcm.hub.config import HubConfig
from vtbdrake.lcm.hub.process import Hub, HubError, serve
from vtbdrake.lcm.hub.server import HubAddressError, HubServer
from vtbdrake.lcm.hub.statistics import ChannelStatistics, HubStatistics
from vtbdrake.lcm.hub.tcpq import STATUS_CHANNEL, TAKE_PREFIX, client_name

__all__ = [
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
