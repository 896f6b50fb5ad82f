"""A testbed that is simulated in a thread of its own, watched and steered from others."""

from __future__ import annotations

import gc
import os
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Collection, Mapping
from concurrent.futures import Future
from dataclasses import dataclass, field
from math import floor, inf, isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from vtbdrake.argument_checks import as_number
from vtbdrake.closing import Closing
from vtbdrake.failures import FAILURES, one_line
from vtbdrake.rollout.course import task_without_problem
from vtbdrake.settings import check_settings, setting
from vtbdrake.testbed import VirtualTestbed
from vtbdrake.visualization.camera import camera_of
from vtbdrake.visualization.drawing import Drawing, Parts
from vtbdrake.visualization.meshcat import make_meshcat
from vtbdrake.web.drive import Driven, Driver, Handle, handles
from vtbdrake.web.fork import CommandLimits, Differences, Fork
from vtbdrake.web.interventions import Interventions
from vtbdrake.web.layers import Layers
from vtbdrake.web.requests import Requests

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray
    from pydrake.geometry import Meshcat
    from pydrake.systems.framework import Context

    from vtbdrake.optimization import Problem
    from vtbdrake.optimization.records import DrivenTrial
    from vtbdrake.rollout.course import Course
    from vtbdrake.state import Snapshot, Variable
    from vtbdrake.testbed import Scenario
    from vtbdrake.visualization.still import Still
    from vtbdrake.web.recorded_course import RecordedCourse

_Result = TypeVar("_Result")

# Colours of the ghosts: a preview, a preview that fails, the course without the intervention, the other branch.
_PREVIEW, _REFUSED, _WITHOUT, _BRANCH = "#009e73", "#d00000", "#0072b2", "#e69f00"
_GHOST_OPACITY = 0.45

# Of the wall time between two frames, what a simulation and a preview may take at most.
_SHARE = 0.8

# Of the wall time, what frames take at most while time runs as fast as it can.
_SHOWN_SHARE = 0.02

# Wall time between frames while nothing moves, and the most that `_SHOWN_SHARE` makes of it.
_IDLE_PERIOD = 0.2


class SessionError(ValueError):
    """A command to a session cannot be carried out."""


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


@dataclass(frozen=True)
class Frame:
    """What a session shows at an instant.

    Attributes:
        number: Counts the frames.
        time: Simulated time, in seconds.
        playing: Whether time runs.
        speed: Simulated seconds per second that are asked for.
        rate: Those that are reached.
        positions: Positions of the switches, by side and signal.
        values: Values of the watched variables and ports, by address.
        history: First and last time of the states that are kept.
        warnings: What a machine's limits would refuse.
        failure: Why the simulation has ended; empty while it can go on.
        preview: What the preview has found: ``time``, ``end``, ``refused``; None if there is none.
        comparison: What the course without the last intervention, or the other branch, shows: ``differences`` (address
            and time), ``failure``, ``branch``, ``recorded``; None if there is none.
        drive: What is driven by hand, see `Driver.status`; None while nothing is.
        log: Of a `LogSession`: whether the log is replayed (``recorded``), when the simulation has ``left`` it, and a
            ``notice``.
        layers: What there is to say about each layer that is shown.
        loop: Of a loop that runs in another process: ``ages`` of its sensor signals' last messages (s), ``reasons`` why
            nothing reaches the machine, ``faults`` with the seconds since then; None of a simulation.
    """

    number: int
    time: float
    playing: bool
    speed: float
    rate: float
    positions: Mapping[str, Mapping[str, str]]
    values: Mapping[str, Any]
    history: tuple[float, float]
    warnings: tuple[str, ...]
    failure: str
    preview: Mapping[str, Any] | None
    comparison: Mapping[str, Any] | None
    drive: Mapping[str, Any] | None = None
    layers: Mapping[str, str] = field(default_factory=dict)
    loop: Mapping[str, Any] | None = None
    log: Mapping[str, Any] | None = None


@dataclass
class _Preview:
    """A fork that runs ahead, and its ghost."""

    fork: Fork
    end: float
    ghost: Drawing | None
    refused: str = ""

    def status(self) -> dict[str, Any]:
        return {"time": self.fork.time, "end": self.end, "refused": self.refused or self.fork.failure}


@dataclass
class Comparison:
    """Another course beside the simulation, such as the one without an intervention, and its ghost.

    Of a branch, the course had been simulated already, perhaps with interventions of its own: it passes through the
    states that were kept of it.
    """

    fork: Fork | RecordedCourse
    differences: Differences
    ghost: Drawing | None
    later: deque[tuple[float, Snapshot]] = field(default_factory=deque)
    is_branch: bool = False
    is_recorded: bool = False

    def advance_to(self, testbed: VirtualTestbed, when: float) -> None:
        while self.later and self.later[0][0] <= when:
            self.fork = Fork(testbed, self.later.popleft()[1])
        self.fork.advance_to(when)

    def status(self) -> dict[str, Any]:
        differences = [(difference.address, difference.time) for difference in self.differences.first]
        return {
            "failure": self.fork.failure,
            "differences": differences,
            "branch": self.is_branch,
            **({"recorded": True} if self.is_recorded else {}),
        }


@dataclass
class _Pace:
    """Relates simulated to wall time since the pace was set last."""

    speed: float = 1.0
    simulated: float = 0.0
    wall: float = 0.0
    rate: float = 0.0
    _marks: deque[tuple[float, float]] = field(default_factory=lambda: deque(maxlen=32))

    def start(self, simulated: float, wall: float) -> None:
        self.simulated, self.wall, self.rate = simulated, wall, 0.0
        self._marks.clear()

    def target(self, wall: float) -> float:
        """Return the simulated time that is due."""
        return inf if self.speed == inf else self.simulated + self.speed * (wall - self.wall)

    def note(self, simulated: float, wall: float) -> None:
        """Measure the rate over the last frames; what cannot be caught up is let go."""
        self._marks.append((simulated, wall))
        (first, begin), (last, end) = self._marks[0], self._marks[-1]
        if end > begin:
            self.rate = (last - first) / (end - begin)
        if self.target(wall) - simulated > 0.25 * self.speed:
            self.simulated, self.wall = simulated, wall


class Session(Closing):
    """Simulates a testbed in a thread of its own, where it can be watched and steered.

    Everything that touches the testbed or its Meshcat happens in that thread. Other threads send commands; each method
    waits for its command, and raises what it raises.

    The simulation advances from one instant of a grid to the next, whatever the speed, so that its course does not
    depend on when it is watched.

    Args:
        scenario: The scenario whose testbed is simulated.
        start: A snapshot to start from, seen from the camera that it notes; s0 if left out.
        values: Variables that are set first, by address.
        config: How it runs.
        problem: The problem whose quality judges what is driven by hand; it is one of the scenario.

    Attributes:
        latest: The last frame.
        variables: What can be watched and set: by address, ``kind``, ``shape``, ``unit``, ``bounds``, ``settable``.
        handles: What can be driven by hand, by address.
        log_path: Path of the log of a `LogSession`, else empty.
        bodies: Paths in Meshcat of what moves.
        followed: The one that the camera follows at first, or nothing.
        layers: The layers that can be shown: name -> title.
        cameras: The cameras whose images can be shown.
        meshcat_url: Address of the Meshcat that shows the testbed; it has no protection of its own.
        loop_url: LCM URL of the loop that is watched instead, see `LoopSession`; empty for a simulation.

    Raises:
        ValueError: The testbed cannot be built, or a value cannot be set.
    """

    def __init__(
        self,
        scenario: Scenario,
        *,
        start: Snapshot | None = None,
        values: Mapping[str, Any] | None = None,
        config: SessionConfig | None = None,
        problem: Problem | None = None,
    ) -> None:
        if problem is not None and problem.scenario.record() != scenario.record():
            raise SessionError(f"the problem is one of {problem.scenario!r}, but what is watched is {scenario!r}")
        self.scenario = scenario
        self.problem = problem
        self.config = config or SessionConfig()
        self.latest: Frame | None = None
        self.variables: Mapping[str, Mapping[str, Any]] = {}
        self.handles: Mapping[str, Handle] = {}
        self.log_path = ""
        self.bodies: tuple[str, ...] = ()
        self.followed = ""
        self.layers: Mapping[str, str] = {}
        self.cameras: tuple[str, ...] = ()
        self.meshcat_url = self.loop_url = ""
        self._start, self._values = start, dict(values or {})
        self._interventions = Interventions(self.config.step)
        self._commands = Requests(SessionError, "the session has ended", _failure)
        self._watched: dict[object, tuple[str, ...]] = {}
        self._shown: dict[object, tuple[str, ...]] = {}
        self._frame_ready = threading.Condition()
        self._closed = False
        ready: Future[None] = Future()
        self._thread = threading.Thread(target=self._run, args=(ready,), name="vtbdrake session", daemon=True)
        self._thread.start()
        ready.result()

    def close(self) -> None:
        """End the simulation and its Meshcat."""
        self._commands.end()
        self._thread.join()

    # -- commands

    def play(self) -> None:
        """Let time run.

        Raises:
            SessionError: The simulation has failed: go back first.
        """
        self._do(self._play)

    def pause(self) -> None:
        """Let time stand still."""
        self._do(self._pause)

    def advance(self, steps: int = 1) -> None:
        """Pause, and simulate a number of steps."""
        if not isinstance(steps, int) or not 1 <= steps <= 10_000:
            raise SessionError(f"a session advances 1 to 10,000 steps, not {steps!r}")
        self._do(lambda: self._advance_steps(steps))

    def reset(self) -> None:
        """Begin again; the speed and what is watched stay."""
        self._do(self._reset)

    def set_speed(self, speed: float) -> None:
        """Set the simulated seconds per second; infinity: as fast as possible."""
        speed = as_number("the speed", speed)
        if not speed > 0.0:
            raise SessionError(f"the speed is a positive number of simulated seconds per second, not {speed}")
        self._do(lambda: self._set_speed(speed))

    def write(self, values: Mapping[str, Any], *, compare: bool = False) -> None:
        """Set variables now.

        Args:
            values: By address.
            compare: Let the course without this intervention go on as a ghost, see `Frame.comparison`.

        Raises:
            ValueError: There is no such variable, or it does not take the value; nothing has been set.
        """
        self._do(lambda: self._write(dict(values), compare))

    def switch(self, mode: str | None = None, *, sense: Any = None, act: Any = None) -> None:
        """Throw switches, as `VirtualTestbed.switch` does."""
        self._do(lambda: self._throw(mode, sense, act))

    def seek(self, when: float) -> None:
        """Pause, and go back to the last state that was kept at or before a time.

        What came later is forgotten at the next step of the simulation. What is changed before that begins another
        branch: the old one goes on as a ghost, see `Frame.comparison`.
        """
        self._do(lambda: self._seek(as_number("the time", when)))

    def preview(self, values: Mapping[str, Any]) -> None:
        """Let a fork of now run ahead with other values, as a ghost; a preview that is under way begins anew."""
        self._do(lambda: self._begin_preview(dict(values)))

    def cancel_preview(self) -> None:
        """End the preview."""
        self._do(self._end_preview)

    def go_on(self) -> None:
        """Go on in simulation from an instant of a log, see `LogSession`; without a log, nothing happens."""
        self._do(self._leave)

    def drive(self, addresses: Collection[str], *, returning: Collection[str] = (), compare: bool = False) -> None:
        """Take over: let hands move commands u or actuators from now on, in a fork.

        The fork is a rollout of the session's problem, and ends as one; without a problem, after an hour.

        Args:
            addresses: Some of `handles`.
            returning: Those of them that return when they are released; the others stay where they are.
            compare: Let the course that nobody drives go on as a ghost, see `Frame.comparison`.

        Raises:
            ValueError: An address cannot be driven, or something is driven already.
        """
        self._do(lambda: self._begin_drive(tuple(addresses), tuple(returning), compare))

    def deflect(self, deflections: Mapping[str, Any]) -> None:
        """Deflect sticks, see `Driver.deflect`; while nothing is driven, nothing happens."""
        self._do(lambda: self._driver.deflect(deflections) if self._driver is not None else None)

    def end_drive(self, *, keep: bool = True) -> Driven:
        """End the drive, pause, and return it; the session goes on from there, or from where the drive began.

        Args:
            keep: Whether the driven course is the present from now on.

        Raises:
            SessionError: Nothing is driven.
        """
        return self._do(lambda: self._end_drive(keep))

    def store_trial(self, study: str | os.PathLike[str], *, by: str | None = None) -> DrivenTrial:
        """Store the last drive that was ended as a trial of a study of the session's problem, see `Study.add_driven`.

        Args:
            study: The file of the study, which is begun if there is none.
            by: Who drove; by default the user of this process.

        Raises:
            ValueError: Nothing has been driven, the session has no problem, or the study is one of another problem.
        """
        return self._do(lambda: self._store_trial(study, by))

    @property
    def course(self) -> Course | None:
        """Return what was done last: the last drive that was ended, or what was set since; None if nothing was.

        What is set one after another is one course, which begins at the first of it, and ends now.
        """
        return self._do(lambda: self._interventions.course(self._context.get_time()))

    def save_test(self, path: str | os.PathLike[str], *, tolerance: float = 1e-6) -> None:
        """Save the last `course` as a test that pytest runs; it takes as long as the course.

        The test expects the quality of the session's problem; without a problem, the values at the end of the course:
        of the watched variables, or if there are none, of all that moves.

        Args:
            path: The file, test_NAME.py; the snapshot NAME.vtb comes beside it.
            tolerance: The relative difference that the test allows.

        Raises:
            ValueError: Nothing has been set or driven, or a reason of `save_course`.
        """
        self._do(lambda: self._save_test(Path(path), tolerance))

    def cancel_comparison(self) -> None:
        """End the course without the last intervention."""
        self._do(self._end_comparison)

    def watch(self, watcher: object, addresses: Collection[str]) -> None:
        """Read variables and ports in each frame, for one of several watchers; an empty list ends it.

        Raises:
            AddressError: There is no such variable or port.
        """
        self._do(lambda: self._watch(watcher, tuple(addresses)))

    def show(self, viewer: object, layers: Collection[str]) -> None:
        """Show layers to one of several viewers; an empty list ends it. A layer that nobody looks at costs nothing.

        Raises:
            LayerError: The testbed has no such layer.
        """
        self._do(lambda: self._show_layers(viewer, tuple(layers)))

    def camera_image(self, camera: str) -> NDArray[np.uint8]:
        """Return the present image of a camera, (height, width, 3).

        Raises:
            LayerError: The testbed has no such camera.
        """
        return self._do(lambda: self._layers.image(camera, self._context, self._world))

    def landmarks(self, near: ArrayLike, count: int = 40) -> list[tuple[str, list[float]]]:
        """Return identity and position in m of the objects of the shown world models, the nearest to a point."""
        point = np.asarray(near, dtype=float)
        if point.shape != (3,) or not np.isfinite(point).all():
            raise SessionError(f"landmarks are near a point (3,) in m, not {near!r}")
        return self._do(lambda: self._layers.landmarks(point, count))

    def snapshot(self) -> Snapshot:
        """Return s(t) of the present."""
        return self._do(lambda: self._testbed.snapshot(self._context))

    def still(self) -> Still | None:
        """Return a picture of how the testbed looks now; None if it has no geometry."""
        return self._do(lambda: None if self._drawing is None else self._drawing.still(self._context))

    def wait_for_frame(self, after: int, timeout: float) -> Frame | None:
        """Return the first frame with a number above ``after``, or None if it does not come in time."""
        with self._frame_ready:
            self._frame_ready.wait_for(lambda: self._closed or (self.latest and self.latest.number > after), timeout)
            return self.latest if self.latest is not None and self.latest.number > after else None

    def _do(self, action: Callable[[], _Result]) -> _Result:
        return self._commands.ask(self._thread, action)

    # -- in the thread of the session

    def _run(self, ready: Future[None]) -> None:
        try:
            self._build()
        except FAILURES as error:  # It is raised where the session is made.
            self._closed = True
            self._drop()
            ready.set_exception(_failure(error))
            return
        ready.set_result(None)
        try:
            while not self._closed:
                self._work()
        finally:
            with self._frame_ready:
                self._closed = True
                self._frame_ready.notify_all()
            self._drop()

    def _build(self) -> None:
        self._testbed: VirtualTestbed = self.scenario.build()
        self._limits = CommandLimits(self._testbed)
        self._pace, self._playing, self._failure = _Pace(), False, ""
        self._preview: _Preview | None = None
        self._comparison: Comparison | None = None
        self._driver: Driver | None = None
        self._driven: Driven | None = None
        self.handles = handles(self._testbed)
        self._readers: dict[str, Callable[..., Any]] = {}
        self._history: deque[tuple[float, Snapshot]] = deque(maxlen=self.config.history_size)
        self._meshcat: Meshcat = make_meshcat()
        self.meshcat_url = self._meshcat.web_url()
        self._begin()
        self._drawing = None
        size = 0.0
        if self._testbed.scene_graph is not None:
            self._drawing = Drawing(self._meshcat, self._testbed, self._context, "now")
            self._drawing.fit_camera(self._world, None if self._start is None else camera_of(self._start))
            self.bodies = self._drawing.places
            self.followed = "" if self._start is not None and camera_of(self._start) else self._drawing.floating
            size = self._drawing.diagonal(self._context)
        self._layers = Layers(self._meshcat, self._testbed, size)
        self.layers, self.cameras = self._layers.titles, self._layers.cameras
        self.variables = {address: describe(variable) for address, variable in self._testbed.variables().items()}
        self._next_frame = 0.0
        self._show(time.monotonic())

    def _begin(self) -> None:
        self._make_context()
        self._failure = ""
        self._interventions.forget()
        self._history.clear()
        self._kept_at = -inf

    def _make_context(self) -> None:
        self._context = self._testbed.default_context()
        if self._start is not None:
            self._testbed.restore(self._context, self._start)
        self._testbed.write(self._context, self._values)
        self._simulator = self._testbed.simulator(self._context, restored=self._start is not None)
        if self._start is None:
            self._simulator.Initialize()

    @property
    def _world(self) -> Context:
        """Return the context whose world is drawn."""
        return self._context

    def _leave(self) -> None:
        """Leave a log."""

    def _source(self) -> Mapping[str, Any] | None:
        """Return what a frame tells of a log."""
        return None

    def _fork_state(self) -> Snapshot:
        """Return where a fork of now begins."""
        return self._testbed.snapshot(self._context)

    def _drop(self) -> None:
        """Give up the Meshcat, which must end in the thread that made it, and all that refers to it."""
        for name in ("_preview", "_comparison", "_driver", "_drawing", "_layers", "_simulator", "_context", "_meshcat"):
            self.__dict__.pop(name, None)
        gc.collect()

    def _work(self) -> None:
        """Carry out commands until the next frame is due, simulate, and show it."""
        if not self._commands.carry_out(max(self._idle_time(), 0.0)):
            self._closed = True
            return
        begin = time.monotonic()
        deadline = begin + _SHARE / self.config.frame_rate
        if self._playing:
            self._simulate(deadline)
        if self._preview is not None:
            self._run_preview(max(deadline, time.monotonic() + 0.25 / self.config.frame_rate))
        now = time.monotonic()
        if now >= self._next_frame:
            self._show(now)

    def _idle_time(self) -> float:
        """Return the wall time, in seconds, until there is something to do."""
        if self._previewing:
            return 0.0
        now = time.monotonic()
        wait = self._next_frame - now
        if self._playing:
            left = self._context.get_time() + self.config.step - self._pace.target(now)
            wait = min(wait, left / self._pace.speed if isfinite(left) else 0.0)
        return wait

    @property
    def _previewing(self) -> bool:
        preview = self._preview
        return preview is not None and not preview.status()["refused"] and preview.fork.time < preview.end

    def _simulate(self, deadline: float) -> None:
        """Advance to the simulated time that is due, until the deadline in wall time."""
        while self._playing and (now := time.monotonic()) < deadline:
            if self._pace.target(now) < self._context.get_time() + self.config.step:
                return
            self._step()

    def _step(self) -> None:
        """Advance to the next instant of the grid."""
        step = self.config.step
        after = step * (floor(self._context.get_time() / step + 1e-6) + 1)
        self._forget_future()
        try:
            after = self._advance(after)
        except FAILURES as error:
            self._failure, self._playing = one_line(error), False
            return
        if (comparison := self._comparison) is not None:
            comparison.advance_to(self._testbed, after)
            if not comparison.fork.failure:
                comparison.differences.compare(self._context, comparison.fork.context)

    def _advance(self, after: float) -> float:
        """Advance to a time, or as far as a driven rollout goes in a step, and return the time."""
        if self._driver is None:
            self._simulator.AdvanceTo(after)
        else:
            self._driver.advance()
            self._playing = self._playing and not self._driver.ended
        return float(self._context.get_time())

    def _forget_future(self) -> None:
        while self._history and self._history[-1][0] > self._context.get_time():
            self._history.pop()

    def _keep(self, now: float) -> None:
        if now - self._kept_at >= self.config.history_period:
            when = self._context.get_time()
            if not self._history or when > self._history[-1][0]:
                self._history.append((when, self._testbed.snapshot(self._context)))
            self._kept_at = now

    def _reach(self) -> tuple[float, float]:
        """Return the first and the last time to which the session can go."""
        if not self._history:
            return self._context.get_time(), self._context.get_time()
        return self._history[0][0], self._history[-1][0]

    def _run_preview(self, deadline: float) -> None:
        preview = self._preview
        assert preview is not None
        while self._previewing and time.monotonic() < deadline:
            preview.fork.advance_to(min(preview.fork.time + self.config.step, preview.end))
            preview.refused = preview.fork.failure or next(iter(self._limits.violations(preview.fork.context)), "")
        if preview.refused and preview.ghost is not None and preview.ghost.path != "ghosts/refused":
            preview.ghost.delete()
            preview.ghost = self._ghost(preview.fork.context, "refused", _REFUSED)

    def _ghost(self, context: Context, name: str, tint: str) -> Drawing | None:
        if self._drawing is None:
            return None
        return Drawing(
            self._meshcat,
            self._testbed,
            context,
            f"ghosts/{name}",
            tint=tint,
            opacity=_GHOST_OPACITY,
            parts=Parts.MOVING,
        )

    def _show(self, now: float) -> None:
        """Draw, and publish a frame."""
        moves = self._playing or self._preview is not None
        period = 1.0 / self.config.frame_rate if moves else _IDLE_PERIOD
        # From when it was due, so that late frames do not lower the rate.
        self._next_frame = period + (self._next_frame if now - self._next_frame < period else now)
        values: dict[str, Any] = {}
        warnings: list[str] = []
        try:
            if self._playing:
                self._pace.note(self._context.get_time(), now)
            if not self._failure:
                self._keep(now)
                self._draw()
                world = self._world
                values = {
                    address: plain(reader(world if address.startswith("sim.") else self._context))
                    for address, reader in self._readers.items()
                }
                warnings = self._limits.violations(self._context)
        except FAILURES as error:  # What draws or is watched cannot be computed in this state.
            self._failure, self._playing = one_line(error), False
        when = self._context.get_time()
        frame = Frame(
            number=1 if self.latest is None else self.latest.number + 1,
            time=when,
            playing=self._playing,
            speed=self._pace.speed,
            rate=self._pace.rate if self._playing else 0.0,
            positions=self._testbed.positions(self._context),
            values=values,
            history=self._reach(),
            warnings=tuple(warnings),
            failure=self._failure,
            preview=None if self._preview is None else self._preview.status(),
            comparison=None if self._comparison is None else self._comparison.status(),
            layers=self._layers.notes,
            drive=None if self._driver is None else self._driver.status(),
            log=self._source(),
        )
        with self._frame_ready:
            self.latest = frame
            self._frame_ready.notify_all()
        if self._playing and self._pace.speed == inf:
            took = time.monotonic() - now
            self._next_frame = max(self._next_frame, now + min(took / _SHOWN_SHARE, _IDLE_PERIOD))

    def _draw(self) -> None:
        if self._drawing is not None:
            self._drawing.pose(self._world)
            self._layers.draw(self._context, self._world)
        for part in (self._preview, self._comparison):
            if part is not None and part.ghost is not None and not part.fork.failure:
                try:
                    part.ghost.pose(part.fork.world)
                except FAILURES as error:  # Its state is not finite.
                    part.fork.failure = one_line(error)

    # -- what the commands do

    def _play(self) -> None:
        self._refuse_ended()
        self._playing = True
        self._pace.start(self._context.get_time(), time.monotonic())

    def _refuse_ended(self) -> None:
        if self._failure:
            raise SessionError(f"the simulation has failed ({self._failure}): go back, or reset")
        if self._driver is not None and self._driver.ended:
            raise SessionError(f"the driven rollout has ended ({self._driver.ended}): keep it, or drop it")

    def _refuse_driven(self, action: str) -> None:
        if self._driver is not None:
            raise SessionError(f"{action} has to wait until the drive has ended: keep it, or drop it")

    def _pause(self) -> None:
        self._playing = False

    def _advance_steps(self, steps: int) -> None:
        self._refuse_ended()
        self._playing = False
        for _ in range(steps):
            if self._driver is None or not self._driver.ended:
                self._step()
        self._next_frame = 0.0

    def _reset(self) -> None:
        self._end_preview()
        self._end_comparison()
        self._driver = None
        self._begin()
        self._pace.start(self._context.get_time(), time.monotonic())
        self._next_frame = 0.0

    def _set_speed(self, speed: float) -> None:
        self._pace.speed = speed
        self._pace.start(self._context.get_time(), time.monotonic())

    def _write(self, values: dict[str, Any], compare: bool) -> None:
        if self._driver is not None:
            self._driver.set(values)
            self._end_preview()
            return
        before = self._before_change(compare)
        # Values may come at 100 Hz, from a hand: only the first of a course needs the whole state.
        needs_state = self._interventions.needs_state
        start = before or self._testbed.snapshot(self._context) if needs_state else None
        when = self._context.get_time()
        self._testbed.write(self._context, values)
        if start is not None:
            self._interventions.begin(start)
        self._interventions.add(when, values)
        self._end_preview()
        self._begin_comparison(before)
        self._next_frame = 0.0

    def _before_change(self, compare: bool = False) -> Snapshot | None:
        """Return where the course without a change begins, if it is to go on as a ghost: the other branch always is."""
        return self._testbed.fork(self._simulator) if compare or self._is_in_the_past() else None

    def _is_in_the_past(self) -> bool:
        return bool(self._history) and self._history[-1][0] > self._context.get_time()

    def _begin_comparison(self, before: Snapshot | None) -> None:
        """Let the course from ``before`` on be a ghost; what was kept of it is no future of ours any more."""
        if before is None:
            return
        self._end_comparison()
        now, is_branch = self._context.get_time(), self._is_in_the_past()
        later = deque(entry for entry in self._history if entry[0] > now)
        self._forget_future()
        fork = Fork(self._testbed, before)
        name, tint = ("branch", _BRANCH) if is_branch else ("without", _WITHOUT)
        ghost = self._ghost(fork.context, name, tint)
        self._comparison = Comparison(fork, Differences(self._testbed), ghost, later, is_branch)

    def _seek(self, when: float) -> None:
        if not isfinite(when):
            raise SessionError(f"a session goes back to a time in seconds, not to {when}")
        if not self._history:
            raise SessionError("no state has been kept yet")
        self._refuse_driven("going back")
        self._end_preview()
        self._end_comparison()
        earlier = [entry for entry in self._history if entry[0] <= when + 1e-9]
        _, snapshot = earlier[-1] if earlier else self._history[0]
        self._go_on_from(snapshot)

    def _go_on_from(self, snapshot: Snapshot) -> None:
        self._playing = False
        self._interventions.forget()
        self._context = self._testbed.default_context()
        self._testbed.restore(self._context, snapshot)
        self._simulator = self._testbed.simulator(self._context, restored=True)
        self._failure = ""
        self._next_frame = 0.0

    def _begin_drive(self, addresses: tuple[str, ...], returning: tuple[str, ...], compare: bool) -> None:
        self._refuse_driven("another drive")
        self._refuse_ended()
        task = task_without_problem(self.scenario) if self.problem is None else self.problem.task
        before = self._testbed.fork(self._simulator)
        driver = Driver(self._testbed, before, task, step=self.config.step, addresses=addresses, returning=returning)
        self._end_preview()
        self._begin_comparison(before if compare or self._is_in_the_past() else None)
        self._driver, self._context = driver, driver.context
        self._next_frame = 0.0

    def _end_drive(self, keep: bool) -> Driven:
        if self._driver is None:
            raise SessionError("nothing is driven: take over first")
        driven = self._driver.end()
        snapshot = self._driver.released() if keep else driven.course.start
        self._driver = None
        if not keep:
            self._end_comparison()
        self._go_on_from(snapshot)
        self._interventions.forget(driven.course)
        self._driven = driven
        return driven

    def _store_trial(self, study: str | os.PathLike[str], by: str | None) -> DrivenTrial:
        problem, driven = self.problem, self._driven
        if problem is None:
            raise SessionError("this session has no problem, so that no study can have trials of it")
        if driven is None:
            raise SessionError("nothing has been driven: take over, and end the drive")
        parameters = problem.values_in(driven.course.start)
        with problem.study(study) as opened:
            return opened.add_driven(driven.course, driven.result, parameters=parameters, by=by)

    def _save_test(self, path: Path, tolerance: float) -> None:
        from vtbdrake.testing.saved_course import save_course

        self._refuse_driven("saving")
        course = self._interventions.course(self._context.get_time())
        if course is None:
            raise SessionError("there is nothing to save: set something, or drive")
        task = None if self.problem is None else self.problem.task
        watched = [a for a in self._readers if a in self._testbed.variables()]
        save_course(path, course, self._testbed, task=task, addresses=watched, tolerance=tolerance)

    def _begin_preview(self, values: dict[str, Any]) -> None:
        fork = Fork(self._testbed, self._fork_state(), values)
        ghost = self._preview.ghost if self._preview is not None and not self._preview.refused else None
        if ghost is None:
            self._end_preview()
            ghost = self._ghost(fork.context, "preview", _PREVIEW)
        self._preview = _Preview(fork, fork.time + self.config.preview_horizon, ghost)

    def _throw(self, mode: str | None, sense: Any, act: Any) -> None:
        self._refuse_driven("a switch")
        before = self._before_change()
        self._testbed.switch(self._context, mode, sense=sense, act=act)
        self._begin_comparison(before)

    def _end_preview(self) -> None:
        if self._preview is not None and self._preview.ghost is not None:
            self._preview.ghost.delete()
        self._preview = None

    def _end_comparison(self) -> None:
        if self._comparison is not None and self._comparison.ghost is not None:
            self._comparison.ghost.delete()
        self._comparison = None

    def _show_layers(self, viewer: object, layers: tuple[str, ...]) -> None:
        elsewhere = [name for other, names in self._shown.items() if other is not viewer for name in names]
        self._layers.show(dict.fromkeys((*elsewhere, *layers)))
        self._shown.pop(viewer, None)
        if layers:
            self._shown[viewer] = layers
        self._next_frame = 0.0

    def _watch(self, watcher: object, addresses: tuple[str, ...]) -> None:
        readers = {address: self._testbed.reader(address) for address in addresses}
        self._watched.pop(watcher, None)
        if addresses:
            self._watched[watcher] = addresses
        wanted_addresses = {address for group in self._watched.values() for address in group}
        self._readers = {a: reader for a, reader in (self._readers | readers).items() if a in wanted_addresses}
        self._next_frame = 0.0


def _failure(error: BaseException) -> Exception:
    """Return what another thread raises for an error of this one, without the objects of this thread."""
    traceback.clear_frames(error.__traceback__)
    return error if isinstance(error, Exception) else SessionError(one_line(error))


def describe(variable: Variable) -> dict[str, Any]:
    """Return what a page needs to know of a variable, for JSON."""
    return {
        "kind": variable.kind,
        "shape": list(variable.shape),
        "unit": variable.unit,
        "bounds": [plain(np.broadcast_to(bound, variable.shape)) for bound in variable.bounds],
        "settable": not variable.derived,
    }


def plain(value: Any) -> Any:
    """Return a value of a variable or a port as plain data, for JSON; of an abstract one its text."""
    if isinstance(value, float | int | bool):
        return float(value) if isfinite(value) else None
    if isinstance(value, np.ndarray):
        return [float(entry) if isfinite(entry) else None for entry in value.ravel()]
    return type(value).__name__
