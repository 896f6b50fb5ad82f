"""Changes of what a session plays: values that are set, switches that are thrown, and what is driven by hand."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from vtbdrake.rollout.course import task_without_problem
from vtbdrake.web.live.drive import Driven, Driver, handles
from vtbdrake.web.live.fork import Simulation
from vtbdrake.web.live.session import SessionError
from vtbdrake.web.live.written_course import WrittenCourse

if TYPE_CHECKING:
    from vtbdrake.optimization import Problem
    from vtbdrake.state import Snapshot
    from vtbdrake.testbed import Scenario
    from vtbdrake.web.live.player import Player


class Changes:
    """Changes what is played, in the thread of its session, and knows what has been changed.

    Args:
        player: It plays what is changed.
        scenario: The scenario of its testbed.
        problem: The problem whose quality judges what is driven by hand, or None.

    Attributes:
        handles: What can be driven by hand, by address.
        written: What has been set.
        driver: What is driven by hand; None while nothing is.
        driven: The last drive that was ended.
    """

    def __init__(self, player: Player, scenario: Scenario, problem: Problem | None) -> None:
        self._player, self._scenario, self._problem = player, scenario, problem
        self.handles = handles(player.testbed)
        self.written = WrittenCourse(player.config.step)
        self.driver: Driver | None = None
        self.driven: Driven | None = None

    def refuse_driven(self, action: str) -> None:
        """Raise a SessionError if something is driven: the action has to wait."""
        if self.driver is not None:
            raise SessionError(f"{action} has to wait until the drive has ended: keep it, or drop it")

    def write(self, values: dict[str, Any], *, compare: bool) -> None:
        """Set variables now; a log that is replayed is left first.

        Args:
            values: Values by address, in the variables' units.
            compare: Whether the course without this change goes on as a ghost; on leaving a log, the recorded one is
                shown.
        """
        player = self._player
        if self.driver is not None:
            self.driver.set(values)
            player.ghosts.end_preview()
            return
        if player.present.is_recorded:
            compare = False
            for address, value in values.items():  # What is refused changes nothing.
                player.testbed.variables()[address].check(value)
        player.leave()
        simulation = self._simulation()
        before = simulation.fork() if compare or self._is_in_the_past else None
        # Values may come at 100 Hz, from a hand: only the first of a course needs the whole state.
        start = before or simulation.what_if() if self.written.needs_state else None
        when = player.time
        player.testbed.write(player.context, values)
        if start is not None:
            self.written.begin(start)
        self.written.add(when, values)
        player.ghosts.end_preview()
        self._compare(before)
        player.frames.hurry()

    def throw(self, mode: str | None, *, sense: Any, act: Any) -> None:
        """Throw switches, but in a log that is replayed, where they stay as they were recorded.

        Args:
            mode: Position of all switches; None: by ``sense`` and ``act``.
            sense: Positions of the sensor signals, see `VirtualTestbed.switch`.
            act: Positions of the actuator signals, likewise.
        """
        player = self._player
        if player.present.is_recorded:
            raise SessionError("these are the recorded switches: go on in simulation first")
        self.refuse_driven("a switch")
        before = self._simulation().fork() if self._is_in_the_past else None
        player.testbed.switch(player.context, mode, sense=sense, act=act)
        self._compare(before)

    def preview(self, values: dict[str, Any]) -> None:
        """Let a fork of now run ahead with other values."""
        player = self._player
        player.refuse_on_the_way()
        state = player.present.what_if() if self.driver is None else player.testbed.snapshot(player.context)
        player.ghosts.preview(state, values)

    # -- what is driven

    def drive(self, addresses: tuple[str, ...], *, returning: tuple[str, ...], compare: bool) -> None:
        """Let hands move commands u or actuators, in a fork; a log that is replayed is left first.

        Args:
            addresses: The commands u and actuators that hands move, see `Handle`.
            returning: Those of them that return when they are released; the others stay where they are.
            compare: Whether the course that nobody drives goes on as a ghost; beside a log, the recorded one does.
        """
        player = self._player
        self.refuse_driven("another drive")
        player.leave()
        player.refuse_ended()
        task = task_without_problem(self._scenario) if self._problem is None else self._problem.task
        before = self._simulation().fork()
        step = player.config.step
        driver = Driver(player.testbed, before, task, step=step, addresses=addresses, returning=returning)
        player.ghosts.end_preview()
        self._compare(before if (compare and not player.plays_log) or self._is_in_the_past else None)
        self.driver = driver
        player.frames.hurry()

    def deflect(self, deflections: Mapping[str, Any]) -> None:
        """Deflect sticks, if something is driven."""
        if self.driver is not None:
            self.driver.deflect(deflections)

    def let_go(self, reason: str) -> None:
        """Release all sticks and pause, if something is driven."""
        if self.driver is not None:
            self.driver.let_go(reason)
            self._player.pace.playing = False
            self._player.frames.hurry()

    def end_drive(self, *, keep: bool) -> Driven:
        """End the drive, and go on from there or from where it began."""
        if self.driver is None:
            raise SessionError("nothing is driven: take over first")
        driven = self.driver.end()
        snapshot = self.driver.released() if keep else driven.course.start
        self.driver = None
        if not keep:
            self._player.ghosts.end_comparison()
        self._player.go_on_from(snapshot)
        self.written.forget(driven.course)
        self.driven = driven
        return driven

    # -- the course without a change

    def _simulation(self) -> Simulation:
        """Return the simulation that a change belongs to."""
        assert isinstance(self._player.present, Simulation)
        return self._player.present

    @property
    def _is_in_the_past(self) -> bool:
        """Return whether the session has gone back: what is changed begins another branch."""
        return self._player.history.reaches_beyond(self._player.time)

    def _compare(self, before: Snapshot | None) -> None:
        """Let the course from ``before`` on be a ghost; what was kept of it is no future of ours any more."""
        if before is None:
            return
        history, time = self._player.history, self._player.time
        is_branch, later = self._is_in_the_past, history.later(time)
        history.forget_after(time)
        self._player.ghosts.compare(before, later, is_branch=is_branch)
