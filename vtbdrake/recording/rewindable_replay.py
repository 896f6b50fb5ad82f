"""A replay that can be moved to any cycle of its log."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable
from math import inf
from time import monotonic, thread_time

from pydrake.systems.framework import Context

from vtbdrake.common.closing import Closing
from vtbdrake.recording.cycle_replay import CycleReplay
from vtbdrake.recording.kept_states import KeptStates
from vtbdrake.recording.log_format import installed_versions
from vtbdrake.recording.log_reader import ControlLog
from vtbdrake.testbed import VirtualTestbed

KEPT_WORK = 0.25
"""Processor time (s) that a replay takes from one kept state to the next: less than what a person waits for."""
_KEPT_SHARE = 4.0  # least processor time between two kept states, over the time that keeping one takes


class RewindableReplay(Closing):
    """A replay that stands at any cycle of its log, and can be moved to another one.

    States along the log are kept in a file beside it, so that a way of any length takes as long as that from one of
    them to the next: `approach` goes on from the nearest. They come about while it plays, and ahead of it by
    `prepare`. With an integrator with error control the DPS behind a kept state differs from the recorded one by about
    its accuracy.

    Args:
        log: The log.
        testbed: A testbed of its scenario. If the log is of a DPS alone, its simulated world is idle.
        kept_work: Processor time of the replay from one kept state to the next, in seconds; 0 keeps every state.

    Attributes:
        log: The log.
        times: Times of the DPS at the ends of the cycles that can be replayed, in seconds, shape (n,).
        ended: Why not all cycles of the recorded run can be replayed; empty if all can.

    Raises:
        LogError: The log is of another scenario, or of another version of it; the error lists the differences.
    """

    def __init__(self, log: ControlLog, testbed: VirtualTestbed, *, kept_work: float = KEPT_WORK) -> None:
        self._replay, self._testbed, self._kept_work = CycleReplay(log, testbed, {}), testbed, kept_work
        self.log = log
        self.times = log.times[: self._replay.count]
        self.ended = self._replay.ended or log.incomplete
        self._begin = self._replay.state()
        # The processor time of each replay since it stood at a kept state, and the time of keeping one.
        self._work: dict[CycleReplay, float] = {self._replay: 0.0}
        self._keeping = 0.0
        self._ahead: CycleReplay | None = None
        self._states = KeptStates(log.path, {"log": log.identity, "versions": installed_versions()})
        self._check_kept()

    def close(self) -> None:
        """Close the file with the states."""
        self._states.close()

    @property
    def context(self) -> Context:
        """Return the context of the replay, always the same one."""
        return self._replay.context

    @property
    def time(self) -> float:
        """Return the DPS's time, in seconds."""
        return float(self.context.get_time())

    @property
    def index(self) -> int:
        """Return the number of cycles before the present."""
        return self._replay.index

    @property
    def is_over(self) -> bool:
        """Return whether all cycles have been replayed."""
        return self._replay.index >= self._replay.count

    def advance_until(self, time: float) -> None:
        """Replay until the DPS's time is ``time``, in seconds, or to the end."""
        context = self.context
        self._advance(self._replay, lambda: context.get_time() >= time)

    def approach(self, index: int, deadline: float = inf) -> bool:
        """Go towards where ``index`` cycles have been replayed; return whether it stands there.

        Args:
            index: The number of cycles.
            deadline: When it stops on its way, on the clock of ``time.monotonic``; it makes one cycle at least.
        """
        index = min(max(index, 0), self._replay.count)
        self._go_back_or_ahead(self._replay, index)
        self._advance(self._replay, lambda: self._replay.index >= index, deadline)
        return self._replay.index == index

    def go_to(self, index: int) -> None:
        """Go to where ``index`` cycles have been replayed."""
        self.approach(index)

    @property
    def prepared(self) -> float:
        """Return the part of the log, from 0 to 1, up to which states are kept."""
        ahead = 0 if self._ahead is None else self._ahead.index
        return max(ahead, self._states.last) / max(self._replay.count, 1)

    def prepare(self, deadline: float = inf) -> bool:
        """Replay ahead of all kept states, and keep more; return whether they reach to the end of the log.

        Args:
            deadline: As in `approach`.
        """
        ahead = self._ahead
        if ahead is None:
            ahead = self._ahead = CycleReplay(self.log, self._testbed, {})
            self._work[ahead] = 0.0
        self._go_back_or_ahead(ahead, ahead.count)
        self._advance(ahead, lambda: ahead.index >= ahead.count, deadline)
        return ahead.index >= ahead.count

    def _go_back_or_ahead(self, replay: CycleReplay, index: int) -> None:
        """Let a replay go on from the last kept state before ``index``, if it does not stand nearer."""
        last = bisect_right(self._states.cycles, index)
        nearest = self._states.cycles[last - 1] if last else 0
        if replay.index <= index and nearest <= replay.index:
            return
        replay.go_to(self._states.before(index) or self._begin)
        self._work[replay] = 0.0

    def _advance(self, replay: CycleReplay, is_there: Callable[[], bool], deadline: float = inf) -> None:
        """Replay until it is there or the deadline is over, and keep states."""
        begin = thread_time()
        while replay.index < replay.count and not is_there():
            replay.advance()
            work = self._work[replay] + thread_time() - begin
            if work >= self._kept_work and work >= _KEPT_SHARE * self._keeping and replay.index > self._states.last:
                before = thread_time()
                self._states.add(replay.index, replay.state())
                begin = thread_time()
                self._work[replay], self._keeping = 0.0, begin - before if self._kept_work else 0.0
            if monotonic() >= deadline:
                break
        self._work[replay] += thread_time() - begin

    def _check_kept(self) -> None:
        """Discard what another version of the user's code has kept: its first state is not the one of this replay."""
        if not self._states.cycles:
            return
        first = self._states.before(self._states.cycles[0])
        while first is not None and self._replay.index < first.notes["cycles"]:
            self._replay.advance()
        here = self._replay.state()
        if first is None or here.compare(first) or here.notes != first.notes:
            self._states.discard()
        self._replay.go_to(self._begin)
