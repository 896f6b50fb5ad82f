"""The course of a log, replayed in a session or beside it."""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING

import numpy as np

from vtbdrake.recording.replay import RewindableReplay
from vtbdrake.testbed.switch import Position

if TYPE_CHECKING:
    from pydrake.systems.framework import Context

    from vtbdrake.recording import ControlLog
    from vtbdrake.state import Snapshot
    from vtbdrake.testbed import VirtualTestbed

_ROUNDING = 1e-9  # s


class RecordedCourse:
    """The course of a log: the DPS repeats it bit by bit, and the world is what the DPS believed of it.

    If all sensor signals were simulated, the world is the recorded one.

    Args:
        log: The log.
        testbed: A testbed of its scenario.

    Attributes:
        end: The last time of the log, in seconds.
        failure: Always empty: an error of the DPS is part of what was recorded.

    Raises:
        LogError: The log is of another scenario, or of another version of it.
    """

    def __init__(self, log: ControlLog, testbed: VirtualTestbed) -> None:
        self._testbed, self._replay = testbed, RewindableReplay(log, testbed)
        self._believed_world, self._believed_at = testbed.default_context(), -1
        self._copier = testbed.copier_from(testbed)
        self.begin = self.time
        times = self._replay.times
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
    def is_over(self) -> bool:
        """Return whether the log ends here."""
        return self._replay.is_over

    @property
    def notice(self) -> str:
        """Return what is to be known at this place of the log."""
        if self._replay.is_over:
            return self._replay.ended or "the log ends here"
        if self._of_machine and not self._testbed.believes:
            return (
                "the scenario does not declare what its DPS believes of the world (VirtualTestbedBuilder.believe): the "
                "world that is shown is not that of the log"
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
        while self.time < time - _ROUNDING and not self._replay.is_over:
            self._replay.advance()

    def seek(self, time: float) -> None:
        """Go to the last cycle that ended at or before ``time``."""
        self._replay.go_to(int(np.searchsorted(self._replay.times, time + _ROUNDING, side="right")))

    def what_if(self) -> Snapshot:
        """Return the state from which a simulation goes on: that of the DPS, and the world that it believes in.

        Raises:
            ValueError: The simulated world does not take what the DPS believes.
        """
        from_machine, context = self._of_machine, self._testbed.default_context()
        self._testbed.restore(context, self._testbed.snapshot(self.context))
        self._testbed.switch(context, "sim")
        if from_machine and self._testbed.believes:
            self._testbed.start_from_belief(context)
        return self._testbed.snapshot(context)
