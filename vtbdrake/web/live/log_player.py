"""Plays a log in the thread of its session, and a simulation that has left it."""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping
from concurrent.futures import Future
from dataclasses import dataclass, field
from math import inf, isfinite
from typing import TYPE_CHECKING, Any

from vtbdrake.common.failures import FAILURES, one_line
from vtbdrake.recording.recorded_course import RecordedCourse
from vtbdrake.state.archive import PRIVATE
from vtbdrake.web.live.player import Player, SessionConfig
from vtbdrake.web.live.session import SessionError

if TYPE_CHECKING:
    from vtbdrake.optimization import Problem
    from vtbdrake.recording import ControlLog
    from vtbdrake.state import Snapshot
    from vtbdrake.testbed import Scenario

# Wall time for which a way is gone before other commands are looked at, in seconds.
AT_ONCE = 0.05

_log = logging.getLogger(__name__)


@dataclass
class _Way:
    """The way to a time of the log, which may take longer than a frame.

    Attributes:
        begin, end: The times between which it leads, in seconds.
        arrived: Whether it has arrived, once it has ended.
    """

    begin: float
    end: float
    arrived: Future[bool] = field(default_factory=Future)


class LogPlayer(Player):
    """Plays a log, until something is changed; a simulation goes on from there, with the recorded course as a ghost.

    Args:
        log: The log.
        scenario: Its scenario.
        config: How it runs.
        problem: The problem whose quality judges what is driven by hand, or None.
        notice: What a frame of the log says where the log has nothing to say.
    """

    file_mode = PRIVATE
    plays_log = True

    def __init__(
        self,
        log: ControlLog,
        scenario: Scenario,
        config: SessionConfig,
        problem: Problem | None,
        *,
        notice: str = "",
    ) -> None:
        self._log, self._notice = log, notice
        self._recorded: RecordedCourse | None = None
        self._way: _Way | None = None
        # Whether every way in the log is short.
        self._is_prepared = False
        # The time at which the simulation has left the log; None while it is replayed.
        self._left: float | None = None
        super().__init__(scenario, config, problem)

    def _first(self) -> RecordedCourse:
        self._end_way(arrived=False)
        self._left = None
        self.recorded.seek(-inf)
        return self.recorded

    @property
    def recorded(self) -> RecordedCourse:
        """Return the course of the log."""
        if self._recorded is None:
            self._recorded = RecordedCourse(self._log, self.testbed)
        return self._recorded

    def close(self) -> None:
        """End the way and the replay."""
        self._end_way(arrived=False)
        if self._recorded is not None:
            self._recorded.close()

    # -- frames

    @property
    def _has_work(self) -> bool:
        return self._way is not None or not (self._is_prepared or self.pace.playing or self._left is not None)

    def _work_on(self, deadline: float) -> None:
        if self._way is not None:
            self._go(self._way, deadline)
            return
        try:
            self._is_prepared = self.recorded.prepare(deadline)
        except FAILURES as error:  # The way to the place tells it, too.
            _log.warning("the log is not prepared any further: %s", one_line(error))
            self._is_prepared = True

    def _reach(self) -> tuple[float, float]:
        end = self.recorded.end if self._left is None else super()._reach()[1]
        return self.recorded.begin, end

    def _log_status(self) -> Mapping[str, Any]:
        return {
            "recorded": self._left is None,
            "left": self._left,
            "notice": self.recorded.notice or self._notice if self._left is None else "",
            "seeking": None if self._way is None else self._way.end,
            "progress": None if self._way is None else self._progress(self._way),
            "prepared": self.recorded.prepared,
        }

    def _progress(self, way: _Way) -> float:
        length = max(way.end - way.begin, self._log.header.period)
        return min(max((self.recorded.time - way.begin) / length, 0.0), 1.0)

    # -- the way to a place in the log

    def begin_way(self, when: float) -> Future[bool]:
        """Begin the way to a time; return whether it has arrived, once it has ended."""
        if self._left is not None and when >= self._left and self.history:
            self.seek(when)
            way = _Way(when, when)
            way.arrived.set_result(True)
            return way.arrived
        if not isfinite(when):
            raise SessionError(f"a session goes back to a time in seconds, not to {when}")
        self.changes.refuse_driven("going back")
        self._end_way(arrived=False)
        self.pace.playing, self.failure = False, ""
        self.frames.hurry()
        self.ghosts.end_preview()
        self.ghosts.end_comparison()
        self.changes.written.forget()
        self.history.clear()
        self._left, self.present = None, self.recorded
        end = min(when, self.recorded.end)
        self.recorded.seek(end, deadline=0.0)  # to the kept state from which the way begins
        self._way = way = _Way(self.recorded.time, end)
        self._go(way, time.monotonic() + AT_ONCE)
        return way.arrived

    def _go(self, way: _Way, deadline: float) -> None:
        """Go on to where it is on its way, until a deadline."""
        try:
            arrived = self.recorded.seek(way.end, deadline=deadline)
        except FAILURES as error:
            self.failure, arrived = one_line(error), True
        if arrived:
            self._end_way(arrived=True)
            self.frames.hurry()

    def _end_way(self, *, arrived: bool) -> None:
        way, self._way = self._way, None
        if way is not None:
            way.arrived.set_result(arrived)

    def refuse_on_the_way(self) -> None:
        """Raise a SessionError if the log is on its way to another time."""
        if self._way is not None:
            raise SessionError(f"the log is on its way to {self._way.end:.3f} s: wait, or pause")

    def pause(self) -> None:
        """Let time stand still, and stay where the way has led."""
        super().pause()
        self._end_way(arrived=False)

    # -- leaving the log

    def leave(self) -> None:
        """Go on in simulation from here; what has left the log already goes on."""
        self.refuse_on_the_way()
        if self._left is not None:
            return
        snapshot, playing = self.recorded.what_if(), self.pace.playing
        self._left = snapshot.time
        self.go_on_from(snapshot)
        self.pace.playing = playing

    def go_on_from(self, snapshot: Snapshot) -> None:
        """Pause, and let a simulation go on from a state, with the recorded course as a ghost."""
        super().go_on_from(snapshot)
        self.recorded.seek(snapshot.time)
        self.ghosts.compare_recorded(self.recorded)
