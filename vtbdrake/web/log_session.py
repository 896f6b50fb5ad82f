"""A session that replays a log, and goes on in simulation from any instant of it."""

from __future__ import annotations

import os
from collections.abc import Mapping
from math import inf, isfinite
from typing import TYPE_CHECKING, Any

from vtbdrake.recording.log_reader import ControlLog, read_log
from vtbdrake.web.fork import Differences
from vtbdrake.web.recorded_course import RecordedCourse
from vtbdrake.web.session import Comparison, Session, SessionConfig, SessionError

if TYPE_CHECKING:
    from pydrake.systems.framework import Context

    from vtbdrake.optimization import Problem
    from vtbdrake.state import Snapshot
    from vtbdrake.testbed import Scenario

_RECORDED = "#9c00c8"  # colour of the ghost of the recorded course


class LogSession(Session):
    """Replays a log in a thread of its own; what is changed in it goes on in simulation.

    While the log is replayed, the DPS repeats what it did, bit by bit, and the switches show what was real. If a
    variable is set, something is driven, or by `go_on`, the simulation goes on from the DPS's recorded state, with all
    switches on sim and the world that the DPS believed in, and the recorded course goes on beside it as a ghost.
    Going back to a time before that returns to the log.

    Args:
        log: The log, or the path of its file.
        scenario: The scenario of the log; None: as the log describes it, if its module is imported already.
        config: How it runs.
        problem: See `Session`.

    Raises:
        OSError: The file cannot be read.
        LogError: The file is not a log, is damaged at its beginning, or its scenario cannot be found or has changed.
    """

    def __init__(
        self,
        log: ControlLog | str | os.PathLike[str],
        *,
        scenario: Scenario | None = None,
        config: SessionConfig | None = None,
        problem: Problem | None = None,
    ) -> None:
        self._log = log if isinstance(log, ControlLog) else read_log(log)
        if scenario is not None:
            self._log.header.check_scenario(scenario)
        self._course: RecordedCourse | None = None
        # The time at which the simulation has left the log; None while it is replayed.
        self._left: float | None = None
        super().__init__(scenario or self._log.scenario, config=config, problem=problem)
        self.log_path = str(self._log.path)

    # -- in the thread of the session

    @property
    def _recorded(self) -> RecordedCourse:
        assert self._course is not None
        return self._course

    def _make_context(self) -> None:
        if self._course is None:
            self._course = RecordedCourse(self._log, self._testbed)
        self._return_to(-inf)

    def _drop(self) -> None:
        self._course = None
        super()._drop()

    def _return_to(self, time: float) -> None:
        self._left = None
        self._recorded.seek(time)
        self._context = self._recorded.context

    @property
    def _world(self) -> Context:
        return self._recorded.world if self._left is None else self._context

    def _refuse_ended(self) -> None:
        super()._refuse_ended()
        if self._left is None and self._recorded.is_over:
            raise SessionError(f"{self._recorded.notice}: go back, or go on in simulation")

    def _advance(self, after: float) -> float:
        if self._left is not None:
            return super()._advance(after)
        self._recorded.advance_to(after)
        self._playing = self._playing and not self._recorded.is_over
        return self._recorded.time

    def _keep(self, now: float) -> None:
        if self._left is not None:
            super()._keep(now)

    def _reach(self) -> tuple[float, float]:
        end = self._recorded.end if self._left is None else super()._reach()[1]
        return self._recorded.begin, end

    def _source(self) -> Mapping[str, Any]:
        return {
            "recorded": self._left is None,
            "left": self._left,
            "notice": self._recorded.notice if self._left is None else "",
        }

    def _seek(self, when: float) -> None:
        if self._left is not None and when >= self._left and self._history:
            super()._seek(when)
            return
        if not isfinite(when):
            raise SessionError(f"a session goes back to a time in seconds, not to {when}")
        self._refuse_driven("going back")
        self._playing, self._failure, self._next_frame = False, "", 0.0
        self._end_preview()
        self._end_comparison()
        self._interventions.forget()
        self._history.clear()
        self._return_to(when)

    def _leave(self) -> None:
        if self._left is not None:
            return
        snapshot, playing = self._recorded.what_if(), self._playing
        self._left = snapshot.time
        self._go_on_from(snapshot)
        self._playing = playing

    def _go_on_from(self, snapshot: Snapshot) -> None:
        super()._go_on_from(snapshot)
        self._end_comparison()
        self._recorded.seek(snapshot.time)
        # What the machine measured differs from any simulation at once: the DPS is compared.
        differences = Differences(self._testbed, only=lambda address: address.startswith(("dps.", "u.")))
        ghost = self._ghost(self._recorded.world, "recorded", _RECORDED)
        self._comparison = Comparison(self._recorded, differences, ghost, is_recorded=True)

    def _fork_state(self) -> Snapshot:
        return self._recorded.what_if() if self._left is None else super()._fork_state()

    def _write(self, values: dict[str, Any], compare: bool) -> None:
        is_recorded = self._left is None
        if is_recorded:
            for address, value in values.items():  # What is refused changes nothing.
                self._testbed.variables()[address].check(value)
        self._leave()
        super()._write(values, compare and not is_recorded)

    def _begin_drive(self, addresses: tuple[str, ...], returning: tuple[str, ...], compare: bool) -> None:
        self._leave()
        super()._begin_drive(addresses, returning, False)

    def _throw(self, mode: str | None, sense: Any, act: Any) -> None:
        if self._left is None:
            raise SessionError("these are the recorded switches: go on in simulation first")
        super()._throw(mode, sense, act)
