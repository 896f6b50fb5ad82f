"""The course of a log: what the DPS did, and the world that it believed in."""

from __future__ import annotations

from contextlib import suppress
from math import inf
from typing import TYPE_CHECKING

import numpy as np

from vtbdrake.common.closing import Closing
from vtbdrake.recording.rewindable_replay import KEPT_WORK, RewindableReplay
from vtbdrake.testbed.switch import Position

if TYPE_CHECKING:
    from pydrake.systems.framework import Context

    from vtbdrake.recording.log_reader import ControlLog
    from vtbdrake.state import Snapshot
    from vtbdrake.testbed import VirtualTestbed

_ROUNDING = 1e-9  # s


class RecordedCourse(Closing):
    """The course of a log: the DPS repeats it bit by bit, and the world is what the DPS believed of it.

    If all sensor signals were simulated, the world is the recorded one.

    Args:
        log: The log.
        testbed: A testbed of its scenario.
        kept_work: Processor time of the replay from one kept state to the next, in seconds; inf keeps none.

    Attributes:
        times: Times of the DPS at the ends of the cycles, in seconds, shape (n,).
        end: The last time of the log, in seconds.
        failure: Always empty: an error of the DPS is part of what was recorded.
        is_recorded: True: its states come from a log.

    Raises:
        LogError: The log is of another scenario, or of another version of it.
    """

    is_recorded = True

    def __init__(self, log: ControlLog, testbed: VirtualTestbed, *, kept_work: float = KEPT_WORK) -> None:
        self._testbed, self._replay = testbed, RewindableReplay(log, testbed, kept_work=kept_work)
        self._believed_world, self._believed_at = testbed.default_context(), -1
        self._copier = testbed.copier_from(testbed)
        self.begin = self.time
        self.times = times = self._replay.times
        self.end = float(times[-1]) if len(times) else self.begin
        self.failure = ""

    @property
    def context(self) -> Context:
        """Return the context of the DPS, always the same one."""
        return self._replay.context

    @property
    def time(self) -> float:
        """Return the DPS's time, in seconds."""
        return self._replay.time

    @property
    def ended(self) -> str:
        """Return the reason why it does not go on from here; empty if it does."""
        return f"{self.notice}: go back, or go on in simulation" if self._replay.is_over else ""

    @property
    def notice(self) -> str:
        """Return the notice at this place of the log."""
        if self._replay.is_over:
            return self._replay.ended or "the log ends here"
        if self._of_machine and not self._testbed.believes:
            return (
                "the scenario does not declare what its DPS believes of the world (VirtualTestbedBuilder.believe): the "
                "world that is shown is not the log's"
            )
        return ""

    @property
    def world(self) -> Context:
        """Return a context with the world of this instant."""
        if not (self._of_machine and self._testbed.believes):
            return self.context
        if self._replay.index != self._believed_at:
            self._copier.copy(self.context, self._believed_world)
            # Nothing feeds the real ports of this context.
            self._testbed.switch(self._believed_world, "sim")
            with suppress(ValueError):  # Before the first measurements there is no belief.
                self._testbed.start_from_belief(self._believed_world)
            self._believed_at = self._replay.index
        return self._believed_world

    @property
    def _of_machine(self) -> bool:
        positions = self._testbed.positions(self.context)
        return any(position != Position.SIM for side in positions.values() for position in side.values())

    def advance_to(self, time: float) -> None:
        """Replay until ``time``, or to the end of the log."""
        self._replay.advance_until(time - _ROUNDING)

    def seek(self, time: float, *, deadline: float = inf) -> bool:
        """Go towards the last cycle that ended at or before ``time``; return whether it is reached.

        Args:
            time: The time of the log, in seconds.
            deadline: When it stops on its way, on the clock of ``time.monotonic``.
        """
        return self._replay.approach(int(np.searchsorted(self._replay.times, time + _ROUNDING, side="right")), deadline)

    @property
    def prepared(self) -> float:
        """Return the part of the log, from 0 to 1, to which every way is short."""
        return self._replay.prepared

    def prepare(self, deadline: float) -> bool:
        """Shorten the ways to later parts of the log until the deadline; return whether all are short."""
        return self._replay.prepare(deadline)

    def close(self) -> None:
        """Close the files that the replay holds."""
        self._replay.close()

    def what_if(self) -> Snapshot:
        """Return the state from which a simulation goes on: the DPS's state, and the world that it believes in.

        Raises:
            ValueError: The simulated world does not take what the DPS believes.
        """
        from_machine, context = self._of_machine, self._testbed.default_context()
        self._testbed.restore(context, self._testbed.snapshot(self.context))
        self._testbed.switch(context, "sim")
        if from_machine and self._testbed.believes:
            self._testbed.start_from_belief(context)
        return self._testbed.snapshot(context)
