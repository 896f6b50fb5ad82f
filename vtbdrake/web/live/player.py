"""Plays a testbed in the thread of its session: time, what is set, what is driven, and ghosts beside it."""

from __future__ import annotations

import time
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from math import floor, inf, isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from vtbdrake.common.failures import FAILURES, one_line
from vtbdrake.common.settings import check_settings, setting
from vtbdrake.visualization.viewpoint import camera_of
from vtbdrake.web.live.changes import Changes
from vtbdrake.web.live.fork import CommandLimits, Simulation
from vtbdrake.web.live.frame_clock import FrameClock
from vtbdrake.web.live.ghosts import Ghosts
from vtbdrake.web.live.history import History
from vtbdrake.web.live.keeping import Keeping
from vtbdrake.web.live.scene import LiveScene
from vtbdrake.web.live.session import Frame, SessionError, Stage
from vtbdrake.web.live.session_pace import Pace
from vtbdrake.web.live.watching import Watching, describe

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from pydrake.systems.framework import Context

    from vtbdrake.optimization import Problem
    from vtbdrake.recording.recorded_course import RecordedCourse
    from vtbdrake.rollout.course import Course
    from vtbdrake.state import Snapshot
    from vtbdrake.testbed import Scenario
    from vtbdrake.visualization.still import Still

# The part of the wall time between two frames that a simulation and a preview may take.
STEPPING_SHARE = 0.8

# The least part of that wall time that is left to a preview.
_PREVIEW_SHARE = 0.25

# A time this close below an instant of the grid is at the instant, in steps of the grid.
_GRID_ROUNDING = 1e-6


@dataclass(frozen=True, kw_only=True)
class SessionConfig:
    """How a session runs."""

    step: float = setting(
        0.0078125,
        "Simulated time between two instants at which the simulation may be watched or changed.",
        unit="s",
        gt=0.0,
        le=1.0,
    )
    frame_rate: float = setting(30.0, "Frames per second of wall time, at most.", unit="Hz", gt=0.0, le=120.0)
    history_period: float = setting(0.2, "Wall time between two states that are kept, to go back to.", unit="s", gt=0.0)
    history_size: int = setting(600, "Number of states that are kept.", ge=2, le=100_000)
    preview_horizon: float = setting(2.0, "How far a preview looks ahead.", unit="s", gt=0.0, le=60.0)

    def __post_init__(self) -> None:
        check_settings(self, error=SessionError)


class Player(Stage):
    """Plays a simulation of a testbed; a subclass may begin with another course, see `_first`.

    The simulation advances from one instant of a grid to the next, whatever the speed, so that its course does not
    depend on when it is watched.

    Args:
        scenario: The scenario whose testbed is simulated.
        config: How it runs.
        problem: The problem whose quality judges what is driven by hand, or None.
        start: A snapshot to start from; s0 if left out.
        values: Variables that are set first, by address.

    Attributes:
        testbed: The testbed.
        present: What is shown, unless something is driven: a simulation, or the course of a log.
        pace: Whether time runs, and how fast.
        history: The states that are kept.
        ghosts: The preview and the other course.
        changes: It sets variables, throws switches and drives by hand.
        keeping: It saves what was changed.
        frames: When the next frame is due.
        failure: Why the simulation has ended; empty while it can go on.
        file_mode: Permissions of the files of a saved test; None: the permissions that the umask leaves. A test of a
            log holds states of a machine, which its owner alone may read.
        plays_log: Whether what is shown first is the course of a log.
    """

    file_mode: ClassVar[int | None] = None
    plays_log: ClassVar[bool] = False

    def __init__(
        self,
        scenario: Scenario,
        config: SessionConfig,
        problem: Problem | None,
        *,
        start: Snapshot | None = None,
        values: Mapping[str, Any] | None = None,
    ) -> None:
        self.config = config
        self._start, self._values = start, dict(values or {})
        self.failure = ""
        self.testbed = scenario.build()
        self.variables = {address: describe(variable) for address, variable in self.testbed.variables().items()}
        self.pace = Pace()
        self.history = History(period=config.history_period, size=config.history_size)
        self.frames = FrameClock(config.frame_rate)
        self.changes = Changes(self, scenario, problem)
        self.keeping = Keeping(self.changes, self.testbed, problem, file_mode=self.file_mode)
        self.watching = Watching(self.testbed)
        self.present: Simulation | RecordedCourse = self._first()
        self._limits = CommandLimits(self.testbed)
        camera = None if start is None else camera_of(start)
        self.scene = LiveScene(self.testbed, self.context, world=self.world, camera=camera)
        self.ghosts = Ghosts(self.testbed, self.scene, self._limits, step=config.step, horizon=config.preview_horizon)

    def _first(self) -> Simulation | RecordedCourse:
        """Return the simulation or log that is shown first, and again after `reset`."""
        return Simulation(self.testbed, self._start, self._values)

    @property
    def context(self) -> Context:
        """Return the context of the present."""
        driver = self.changes.driver
        return self.present.context if driver is None else driver.context

    @property
    def world(self) -> Context:
        """Return the context whose world is drawn."""
        driver = self.changes.driver
        return self.present.world if driver is None else driver.context

    @property
    def time(self) -> float:
        """Return the time of the present, in seconds."""
        return float(self.context.get_time())

    # -- frames

    def idle_time(self) -> float:
        """Return the wall time, in seconds, until there is something to do."""
        if self.ghosts.runs_ahead or self._has_work:
            return 0.0
        now = time.monotonic()
        wait = self.frames.wait(now)
        return min(wait, self.pace.until(self.time + self.config.step, now)) if self.pace.playing else wait

    def work(self) -> Frame | None:
        """Simulate until the next frame is due, and return it then."""
        begin = time.monotonic()
        deadline = begin + STEPPING_SHARE / self.config.frame_rate
        if self.pace.playing:
            self._simulate(deadline)
        if self._has_work:
            self._work_on(deadline)
        if self.ghosts.previews:
            self.ghosts.run_ahead(max(deadline, time.monotonic() + _PREVIEW_SHARE / self.config.frame_rate))
        return self.frame() if self.frames.wait(time.monotonic()) <= 0.0 else None

    @property
    def _has_work(self) -> bool:
        """Return whether `_work_on` has something to do."""
        return False

    def _work_on(self, deadline: float) -> None:
        """Go on with what takes longer than a frame, until a time on the clock of ``time.monotonic``."""

    def _simulate(self, deadline: float) -> None:
        """Advance to the simulated time that is due, until the deadline in wall time."""
        while self.pace.playing and (now := time.monotonic()) < deadline:
            if self.pace.target(now) < self.time + self.config.step:
                return
            self._step()

    def _step(self) -> None:
        """Advance to the next instant of the grid."""
        step = self.config.step
        after = step * (floor(self.time / step + _GRID_ROUNDING) + 1)
        self.history.forget_after(self.time)
        try:
            after = self._advance(after)
        except FAILURES as error:
            self.failure, self.pace.playing = one_line(error), False
            return
        self.ghosts.advance_to(after, self.context)

    def _advance(self, after: float) -> float:
        """Advance to a time, or as far as a driven rollout goes in a step, and return the time."""
        if (driver := self.changes.driver) is not None:
            driver.advance()
            self.pace.playing = self.pace.playing and not driver.ended
            return self.time
        self.present.advance_to(after)
        self.pace.playing = self.pace.playing and not self.present.ended
        return self.present.time

    def frame(self) -> Frame:
        """Draw, and return what is shown."""
        now = time.monotonic()
        self.frames.begin(now, moving=self.pace.playing or self.ghosts.previews)
        driver = self.changes.driver
        warnings = self._draw(now)
        values, errors = self.watching.read(self.context, self.world)
        for error in errors:
            self._fail(error)
        frame = Frame(
            number=0,
            time=self.time,
            playing=self.pace.playing,
            speed=self.pace.speed,
            rate=self.pace.rate if self.pace.playing else 0.0,
            positions=self.testbed.positions(self.context),
            values=values,
            history=self._reach(),
            warnings=warnings,
            failure=self.failure,
            preview=self.ghosts.preview_status(),
            comparison=self.ghosts.comparison_status(),
            layers=self.scene.layers.notes,
            drive=None if driver is None else driver.status(),
            log=self._log_status(),
        )
        if self.pace.playing and self.pace.speed == inf:
            self.frames.end(now, time.monotonic())
        return frame

    def _draw(self, now: float) -> tuple[str, ...]:
        """Keep and draw the present, and return what a machine's limits would refuse."""
        try:
            if self.pace.playing:
                self.pace.note(self.time, now)
            if self.failure:
                return ()
            if not self.present.is_recorded:
                self.history.keep(self.time, lambda: self.testbed.snapshot(self.context), now)
            self.scene.draw(self.context, self.world)
            self.ghosts.pose()
            return tuple(self._limits.violations(self.context))
        except FAILURES as error:  # What draws cannot be computed in this state.
            if self.scene.is_alive():
                self._fail(error)
            return ()

    def _fail(self, error: BaseException) -> None:
        """Let time stand still because of an error, unless it does because of an earlier one."""
        self.failure, self.pace.playing = self.failure or one_line(error), False

    def _reach(self) -> tuple[float, float]:
        """Return the first and the last time to which one can go."""
        return self.history.reach(self.time)

    def _log_status(self) -> Mapping[str, Any] | None:
        """Return the part of a frame about a log."""
        return None

    def lose_picture(self, reason: str) -> None:
        """Release all sticks: nobody drives what was not seen."""
        self.changes.let_go(reason)

    def redraw(self) -> None:
        """Draw what is shown into a new picture."""
        # A state that cannot be simulated any more may not be one that can be drawn.
        context = self.testbed.default_context() if self.failure else self.context
        self.scene.renew(context, world=context if self.failure else self.world)
        self.ghosts.redraw()

    # -- time

    def play(self) -> None:
        """Let time run."""
        self.refuse_ended()
        if self.changes.driver is not None:
            self.changes.driver.notice = ""
        self.pace.playing = True
        self.pace.start(self.time, time.monotonic())

    def refuse_ended(self) -> None:
        """Raise a SessionError if the course does not go on from here."""
        self.refuse_on_the_way()
        driver = self.changes.driver
        if self.failure:
            raise SessionError(f"the simulation has failed ({self.failure}): go back, or reset")
        if driver is not None and driver.ended:
            raise SessionError(f"the driven rollout has ended ({driver.ended}): keep it, or drop it")
        if driver is None and self.present.ended:
            raise SessionError(self.present.ended)

    def refuse_on_the_way(self) -> None:
        """Raise a SessionError if it is on its way to another place of the course, which takes longer than a frame."""

    def leave(self) -> None:
        """Go on in simulation from here, if what is shown was recorded."""

    def pause(self) -> None:
        """Let time stand still."""
        self.pace.playing = False

    def advance(self, steps: int) -> None:
        """Pause, and simulate a number of steps."""
        self.refuse_ended()
        self.pace.playing = False
        driver = self.changes.driver
        for _ in range(steps):
            if driver is None or not driver.ended:
                self._step()
        self.frames.hurry()

    def set_speed(self, speed: float) -> None:
        """Set the simulated seconds per second."""
        self.pace.speed = speed
        self.pace.start(self.time, time.monotonic())

    def reset(self) -> None:
        """Begin again."""
        self.changes.refuse_driven("beginning again")
        self.ghosts.end_preview()
        self.ghosts.end_comparison()
        self.present = self._first()
        self.failure = ""
        self.changes.written.forget()
        self.history.clear()
        self.pace.start(self.time, time.monotonic())
        self.frames.hurry()

    def seek(self, when: float) -> None:
        """Pause, and go back to the last state that was kept at or before a time."""
        if not isfinite(when):
            raise SessionError(f"a session goes back to a time in seconds, not to {when}")
        if not self.history:
            raise SessionError("no state has been kept yet")
        self.changes.refuse_driven("going back")
        self.ghosts.end_preview()
        self.ghosts.end_comparison()
        self.go_on_from(self.history.at(when))

    def go_on_from(self, snapshot: Snapshot) -> None:
        """Pause, and let a simulation go on from a state."""
        self.pace.playing = False
        self.changes.written.forget()
        self.present = Simulation(self.testbed, snapshot)
        self.failure = ""
        self.frames.hurry()

    # -- what is kept and seen

    def course(self) -> Course | None:
        """Return the last course."""
        return self.changes.written.course(self.time)

    def save_test(self, path: Path, *, tolerance: float) -> None:
        """Save the last course as a test.

        Args:
            path: The file, test_NAME.py; the snapshot NAME.vtb comes beside it.
            tolerance: The relative difference that the test allows.
        """
        watched = [address for address in self.watching.addresses if address in self.variables]
        self.keeping.save_test(path, self.course(), watched, tolerance=tolerance)

    def watch(self, watcher: object, addresses: Collection[str]) -> None:
        """Read variables and ports in each frame.

        Args:
            watcher: Who watches; what it has watched before is replaced.
            addresses: Addresses of variables and ports; empty ends it.
        """
        self.watching.watch(watcher, addresses)
        self.frames.hurry()

    def show(self, viewer: object, layers: Collection[str]) -> None:
        """Show layers.

        Args:
            viewer: Who looks; what it has asked for before is replaced.
            layers: Names of layers; empty ends it.
        """
        super().show(viewer, layers)
        self.frames.hurry()

    def camera_image(self, camera: str) -> NDArray[np.uint8]:
        """Return the present image of a camera, (height, width, 3)."""
        return self.scene.layers.image(camera, self.context, self.world)

    def snapshot(self) -> Snapshot:
        """Return s(t) of the present."""
        return self.testbed.snapshot(self.context)

    def still(self) -> Still | None:
        """Return a picture of the present."""
        return self.scene.still(self.context)
