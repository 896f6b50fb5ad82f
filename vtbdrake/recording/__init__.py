"""The recorder of a control loop, its logs, and what can be done with them: replay and export.

A log is an LCM event log, which ``lcm-logplayer`` and every other LCM tool reads: all messages that crossed the
boundary, each on its own channel, and what else determined the DPS on channels that begin with ``VTB_`` (`lcm_types`):

* ``VTB_LOG``, ``VTB_STATE``: what was recorded, and the state before the first cycle;
* ``VTB_CYCLE``: one event per cycle, after its messages: what was fed, commanded and sent, exactly, and a checksum
  over all events of the cycle;
* ``VTB_CHANGE``, ``VTB_FAULT``, ``VTB_DIGEST``: changes between two cycles (switches, variables, results of slow
  parts), faults when they begin and end, and now and then a digest of the DPS's state;
* ``VTB_END``, if the log was closed.

Played back onto a bus, a log plays its commands too: ``lcm-logplayer --regexp`` chooses channels, and a hub keeps
others out of those that it protects.
"""
