"""Sessions whose time is played: simulations, and what a log and a simulation have in common."""

from __future__ import annotations

import os
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from vtbdrake.common.argument_checks import as_number
from vtbdrake.web.live.drive import Driven, Handle
from vtbdrake.web.live.player import Player, SessionConfig
from vtbdrake.web.live.session import Session, SessionError

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from vtbdrake.optimization import Problem
    from vtbdrake.optimization.records import DrivenTrial
    from vtbdrake.rollout.course import Course
    from vtbdrake.state import Snapshot
    from vtbdrake.testbed import Scenario
    from vtbdrake.visualization.still import Still

_Player = TypeVar("_Player", bound=Player)


class PlayedSession(Session[_Player]):
    """A testbed whose time is played: it runs, stands still and goes back; it is changed, driven and previewed.

    Args:
        scenario: The scenario whose testbed is played.
        config: How it runs.
        problem: The problem whose quality judges what is driven by hand; it is one of the scenario.

    Attributes:
        problem: The problem, or None.
        config: How it runs.
        handles: What can be driven by hand, by address.

    Raises:
        ValueError: The testbed cannot be built.
    """

    def __init__(self, scenario: Scenario, *, config: SessionConfig | None, problem: Problem | None) -> None:
        if problem is not None and problem.scenario.record() != scenario.record():
            raise SessionError(f"the problem is one of {problem.scenario!r}, but what is watched is {scenario!r}")
        self.problem = problem
        self.config = config or SessionConfig()
        self.handles: Mapping[str, Handle] = {}
        super().__init__(scenario)

    def _begin(self) -> None:
        super()._begin()
        self.handles = self._stage.changes.handles

    def _begin_again(self) -> None:
        self._picture = ""
        self._stage.reset()

    # -- commands

    def play(self) -> None:
        """Let time run.

        Raises:
            SessionError: The simulation has failed: go back first.
        """
        self._do(lambda: self._stage.play())

    def pause(self) -> None:
        """Let time stand still."""
        self._do(lambda: self._stage.pause())

    def advance(self, steps: int = 1) -> None:
        """Pause, and simulate a number of steps."""
        if not isinstance(steps, int) or not 1 <= steps <= 10_000:
            raise SessionError(f"a session advances 1 to 10,000 steps, not {steps!r}")
        self._do(lambda: self._stage.advance(steps))

    def reset(self) -> None:
        """Begin again; the speed and what is watched stay.

        Raises:
            SessionError: Something is driven: keep it, or drop it.
        """
        self._do(self._begin_again)

    def set_speed(self, speed: float) -> None:
        """Set the simulated seconds per second; infinity: as fast as possible."""
        speed = as_number("the speed", speed)
        if not speed > 0.0:
            raise SessionError(f"the speed is a positive number of simulated seconds per second, not {speed}")
        self._do(lambda: self._stage.set_speed(speed))

    def write(self, values: Mapping[str, Any], *, compare: bool = False) -> None:
        """Set variables now.

        Args:
            values: By address.
            compare: Let the course without this intervention go on as a ghost, see `Frame.comparison`.

        Raises:
            ValueError: There is no such variable, or it does not take the value; nothing has been set.
        """
        self._do(lambda: self._stage.changes.write(dict(values), compare=compare))

    def switch(self, mode: str | None = None, *, sense: Any = None, act: Any = None) -> None:
        """Throw switches, as `VirtualTestbed.switch` does.

        Args:
            mode: Position of all switches: ``sim``, ``real``, ``shadow`` or ``twin``; None: by ``sense`` and ``act``.
            sense: ``sim`` or ``real`` for all sensor signals, or by signal; None: no change.
            act: ``sim``, ``real`` or ``twin`` for all actuator signals, or by signal; None: no change.
        """
        self._do(lambda: self._stage.changes.throw(mode, sense=sense, act=act))

    def seek(self, when: float, *, wait: bool = True) -> bool:
        """Pause, and go back to the last state that was kept at or before a time.

        What came later is forgotten at the next step of the simulation. What is changed before that begins another
        branch: the old one goes on as a ghost, see `Frame.comparison`.

        Args:
            when: The time, in seconds.
            wait: Whether to wait until it is there, for which a `LogSession` may take a while.

        Returns:
            Whether it is there: in a log, another `seek` or a `pause` may have come before.
        """
        self._do(lambda: self._stage.seek(as_number("the time", when)))
        return True

    def preview(self, values: Mapping[str, Any]) -> None:
        """Let a fork of now run ahead with other values, as a ghost; a preview that is under way begins anew."""
        self._do(lambda: self._stage.changes.preview(dict(values)))

    def cancel_preview(self) -> None:
        """End the preview."""
        self._do(lambda: self._stage.ghosts.end_preview())

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
        self._do(lambda: self._stage.changes.drive(tuple(addresses), returning=tuple(returning), compare=compare))

    def deflect(self, deflections: Mapping[str, Any]) -> None:
        """Deflect sticks, see `Driver.deflect`; while nothing is driven, nothing happens."""
        self._do(lambda: self._stage.changes.deflect(deflections))

    def let_go(self, reason: str) -> None:
        """Release all sticks and pause, as whoever drove is gone; while nothing is driven, nothing happens.

        Args:
            reason: Why, for `Frame.drive`, until time runs again.
        """
        self._do(lambda: self._stage.changes.let_go(reason))

    def end_drive(self, *, keep: bool = True) -> Driven:
        """End the drive, pause, and return it; the session goes on from there, or from where the drive began.

        Args:
            keep: Whether the driven course is the present from now on.

        Raises:
            SessionError: Nothing is driven.
        """
        return self._do(lambda: self._stage.changes.end_drive(keep=keep))

    def store_trial(self, study: str | os.PathLike[str], *, by: str | None = None) -> DrivenTrial:
        """Store the last drive that was ended as a trial of a study of the session's problem, see `Study.add_driven`.

        Args:
            study: The file of the study, which is begun if there is none.
            by: Who drove; by default the user of this process.

        Raises:
            ValueError: Nothing has been driven, the session has no problem, or the study is one of another problem.
        """
        return self._do(lambda: self._stage.keeping.store_trial(study, by))

    @property
    def course(self) -> Course | None:
        """Return the last course: the last drive that was ended, or the changes since; None if there is none.

        What is set one after another is one course, which begins at the first of it, and ends now.
        """
        return self._do(lambda: self._stage.course())

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
        self._do(lambda: self._stage.save_test(Path(path), tolerance=tolerance))

    def cancel_comparison(self) -> None:
        """End the course without the last intervention."""
        self._do(lambda: self._stage.ghosts.end_comparison())

    def camera_image(self, camera: str) -> NDArray[np.uint8]:
        """Return the present image of a camera, (height, width, 3).

        Raises:
            LayerError: The testbed has no such camera.
        """
        return self._do(lambda: self._stage.camera_image(camera))

    def landmarks(self, near: ArrayLike, count: int = 40) -> list[tuple[str, list[float]]]:
        """Return identity and position in m of the objects of the shown world models, the nearest to a point.

        Args:
            near: The point, in the world frame, shape (3,), in m.
            count: The largest number of objects of each world model.
        """
        point = np.asarray(near, dtype=float)
        if point.shape != (3,) or not np.isfinite(point).all():
            raise SessionError(f"landmarks are near a point (3,) in m, not {near!r}")
        return self._do(lambda: self._stage.scene.layers.landmarks(point, count))

    def snapshot(self) -> Snapshot:
        """Return s(t) of the present."""
        return self._do(lambda: self._stage.snapshot())

    def still(self) -> Still | None:
        """Return a picture of how the testbed looks now; None if it has no geometry."""
        return self._do(lambda: self._stage.still())


class SimulationSession(PlayedSession[Player]):
    """Simulates a testbed in a thread of its own, where it can be watched, changed and driven.

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
        self._start, self._values = start, dict(values or {})
        super().__init__(scenario, config=config, problem=problem)

    def _make_stage(self) -> Player:
        return Player(self.scenario, self.config, self.problem, start=self._start, values=self._values)
