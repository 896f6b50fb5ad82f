"""A session that replays a log, and goes on in simulation from any instant of it."""

from __future__ import annotations

import os
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from vtbdrake.common.argument_checks import as_number
from vtbdrake.recording import ControlLog, Log, feed, read_log
from vtbdrake.recording.log_events import LogEvents
from vtbdrake.web.live.log_player import LogPlayer
from vtbdrake.web.live.session import SessionError
from vtbdrake.web.live.simulation_session import PlayedSession

if TYPE_CHECKING:
    from vtbdrake.optimization import Problem
    from vtbdrake.testbed import Scenario
    from vtbdrake.web.live.player import SessionConfig

_FED = "the DPS was not recorded: it runs again on the recorded sensor signals, and its commands went nowhere"

_LOOK_PERIOD = 0.5  # s between two looks at whether the session lives


class LogSession(PlayedSession[LogPlayer]):
    """Replays a log in a thread of its own; what is changed in it goes on in simulation.

    While the log is replayed, the DPS repeats what it did, bit by bit, and the switches show what was real. If a
    variable is set, something is driven, or by `go_on`, the simulation goes on from the DPS's recorded state, with all
    switches on sim and the world that the DPS believed in, and the recorded course goes on beside it as a ghost.
    Going back to a time before that returns to the log.

    A log of another program has no state of the DPS: the scenario's DPS runs on its sensor samples first (see `feed`),
    into a temporary file, and that run is replayed. Its frames say so.

    Args:
        log: The log, or the path of its file.
        scenario: The scenario of the log; None: as the log describes it, if its module is imported already. A log of
            another program needs it.
        config: How it runs.
        problem: The problem whose quality judges what is driven by hand; it is one of the scenario.

    Attributes:
        log_path: Path of the file of the log.

    Raises:
        OSError: The file cannot be read.
        LogError: The file is not a log, is damaged at its beginning, or its scenario cannot be found or has changed; or
            a log of another program does not feed the DPS.
    """

    def __init__(
        self,
        log: ControlLog | Log | str | os.PathLike[str],
        *,
        scenario: Scenario | None = None,
        config: SessionConfig | None = None,
        problem: Problem | None = None,
    ) -> None:
        if isinstance(log, str | os.PathLike):
            log = read_log(log) if scenario is None or LogEvents(Path(log)).of_loop else read_log(log, scenario)
        self.log_path, self._notice = (log.source, _FED) if isinstance(log, Log) else (str(log.path), "")
        self._folder: TemporaryDirectory[str] | None = None
        if isinstance(log, Log):
            if scenario is None:
                raise SessionError(f"{log.source} does not name its scenario, whose DPS runs on it: give scenario=")
            self._folder = TemporaryDirectory(prefix="vtbdrake-log-")
            log = feed(log, scenario, Path(self._folder.name) / "fed.lcm")
        self._log = log
        if scenario is not None:
            self._log.header.check_scenario(scenario)
        super().__init__(scenario or self._log.scenario, config=config, problem=problem)

    def _make_stage(self) -> LogPlayer:
        return LogPlayer(self._log, self.scenario, self.config, self.problem, notice=self._notice)

    def close(self) -> None:
        super().close()
        if self._folder is not None:
            self._folder.cleanup()

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
