"""Logs of a control loop: recording, reading, replay and export.

A log is an LCM event log, which ``lcm-logplayer`` and every other LCM tool reads. It holds all messages that crossed
the boundary, each on its own channel. Whatever else determined the DPS is on channels that begin with ``VTB_``
(`lcm_types`):

* ``VTB_LOG``, ``VTB_STATE``: the header, and the state before the first cycle;
* ``VTB_CYCLE``: one event per cycle, after its messages: what was fed, commanded and sent, exactly, and a checksum
  over all events of the cycle;
* ``VTB_CHANGE``, ``VTB_FAULT``, ``VTB_DIGEST``: changes between two cycles (switches, variables, results of slow
  parts), faults when they begin and end, and a periodic digest of the DPS's state;
* ``VTB_END``, if the log was closed.

Playing a log onto a bus plays its actuator commands too: select channels with ``lcm-logplayer --regexp``, or protect
the command channels with a hub.
"""

from vtbdrake.common.lazy_names import attach_names

__getattr__, __dir__, __all__ = attach_names(__name__, __file__)
