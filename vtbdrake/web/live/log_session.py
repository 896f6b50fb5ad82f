"""A session that replays a log, and goes on in simulation from any instant of it."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

from vtbdrake.common.argument_checks import as_number
from vtbdrake.recording.log_reader import ControlLog, read_log
from vtbdrake.web.live.log_player import LogPlayer
from vtbdrake.web.live.session import SessionError
from vtbdrake.web.live.simulation_session import PlayedSession

if TYPE_CHECKING:
    from vtbdrake.optimization import Problem
    from vtbdrake.testbed import Scenario
    from vtbdrake.web.live.player import SessionConfig

_LOOK_PERIOD = 0.5  # s between two looks at whether the session lives


class LogSession(PlayedSession[LogPlayer]):
    """Replays a log in a thread of its own; what is changed in it goes on in simulation.

    While the log is replayed, the DPS repeats what it did, bit by bit, and the switches show what was real. If a
    variable is set, something is driven, or by `go_on`, the simulation goes on from the DPS's recorded state, with all
    switches on sim and the world that the DPS believed in, and the recorded course goes on beside it as a ghost.
    Going back to a time before that returns to the log.

    Args:
        log: The log, or the path of its file.
        scenario: The scenario of the log; None: as the log describes it, if its module is imported already.
        config: How it runs.
        problem: The problem whose quality judges what is driven by hand; it is one of the scenario.

    Attributes:
        log_path: Path of the file of the log.

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
        self.log_path = str(self._log.path)
        super().__init__(scenario or self._log.scenario, config=config, problem=problem)

    def _make_stage(self) -> LogPlayer:
        return LogPlayer(self._log, self.scenario, self.config, self.problem)

    def seek(self, when: float, *, wait: bool = True) -> bool:
        """Pause, and go to the last cycle of the log that ended at or before a time; see `PlayedSession.seek`.

        The way is that from a kept state, which takes less than a second, once states are kept there: a log that is
        opened for the first time is replayed ahead for that while it stands still. Until then a way may be long: frames
        tell its progress, `pause` ends it where it is, and another `seek` takes its place.

        Args:
            when: The time, in seconds.
            wait: Whether to wait until it is there, or its way has ended elsewhere.

        Returns:
            Whether it is there.
        """
        arrived = self._do(lambda: self._stage.begin_way(as_number("the time", when)))
        if not wait:
            return arrived.done() and arrived.result()
        while True:
            try:
                return arrived.result(timeout=_LOOK_PERIOD)
            except TimeoutError:
                if not self._thread.is_alive():
                    raise SessionError("the session has ended") from None

    def go_on(self) -> None:
        """Go on in simulation from the present instant of the log; a simulation that has left it goes on."""
        self._do(lambda: self._stage.leave())
