"""Acting commands that a machine reports are compared with the sent ones, and lost commands do not wind up."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from vtbdrake.control.acting import ActingMonitor
from vtbdrake.control.received_signal import ReceivedSignal

LATENCY = 5
TOLERANCE = 0.5


class Link:
    """Commands to a machine and its reports: the command k is k, unless it is given."""

    def __init__(self, **options: float) -> None:
        self.monitor = ActingMonitor(1, **{"latency": LATENCY, "tolerance": TOLERANCE, **options})  # type: ignore[arg-type]
        self.report = ReceivedSignal()
        self.sent: list[float] = []

    def cycle(self, acting: float | None, command: float | None = None) -> bool:
        """Receive a report, compare, and send the next command."""
        if acting is not None:
            self.report.accept(np.array([acting]), 0.0, 0.0)
        departs = self.monitor.compare(self.report)
        self.sent.append(float(len(self.sent)) if command is None else command)
        self.monitor.note_sent(np.array([self.sent[-1]]))
        return departs

    def follow(self, cycles: int, *, delay: int = 2) -> bool:
        """Return whether the reports depart in one of the cycles, if the commands act after a delay."""
        departs = [self.cycle(self.sent[-delay] if len(self.sent) >= delay else 0.0) for _ in range(cycles)]
        return any(departs)


@pytest.mark.parametrize("delay", [1, 2, LATENCY])
def test_machine_that_acts_within_the_latency_does_not_depart(delay: int) -> None:
    link = Link()
    assert not link.follow(300, delay=delay)
    assert not link.monitor.is_lost


def test_machine_that_holds_a_command_has_lost_the_others_after_the_latency() -> None:
    link = Link()
    link.follow(20, delay=1)
    held = link.sent[-1]
    departs = [link.cycle(held) for _ in range(10)]
    assert departs == [False] * LATENCY + [True] * (10 - LATENCY)
    assert link.monitor.is_lost and link.monitor.is_held


def test_machine_that_does_something_else_has_lost_the_commands_at_once() -> None:
    link = Link()
    link.follow(20)
    assert link.cycle(-7.0)
    assert link.monitor.is_lost and not link.monitor.is_held


def test_lost_machine_is_found_again_by_a_command_that_was_sent_meanwhile() -> None:
    link = Link()
    link.follow(20, delay=1)
    held = link.sent[-1]
    for _ in range(20):
        link.cycle(held, held + 3.0)
    assert link.monitor.is_lost
    link.cycle(0.0, 3.0)  # It brakes.
    assert link.monitor.departs
    link.cycle(3.0, 3.0)
    assert (link.monitor.is_lost, link.monitor.departs) == (False, False)


def test_report_that_stays_the_same_while_commands_change_a_little_departs() -> None:
    link = Link(tolerance=10.0)  # The machine reports something that differs much in other ways.
    assert not any(link.cycle(link.sent[-1] + 4.0 if link.sent else 0.0, 0.15 * k) for k in range(50))
    held = float(link.report.value[0])
    departs = [link.cycle(held, 7.5 + 0.15 * k) for k in range(12)]
    assert departs.index(True) == LATENCY + 2  # two commands that differ by more than 0.02 of the tolerance, and n


def test_machine_at_rest_does_not_depart_when_it_starts_to_move() -> None:
    link = Link(tolerance=0.01)
    for k in range(60):
        command = 0.0 if k < 40 else 0.004 * (k - 40)
        assert not link.cycle(link.sent[-LATENCY] if len(link.sent) >= LATENCY else 0.0, command)


def test_machine_that_acts_too_late_departs_but_has_lost_nothing() -> None:
    link = Link()
    link.follow(20, delay=LATENCY)
    assert link.follow(20, delay=LATENCY + 3)
    assert link.monitor.departs and not link.monitor.is_lost


def test_commands_on_their_way_are_no_reason_to_depart_from_them() -> None:
    """A delay begins: at first it looks like an outage. If it is taken for one later, too, motions would repeat."""
    link = Link()
    link.follow(20, delay=1)
    held, delay, states = link.sent[-1], 9, []
    for k in range(40):
        link.cycle(held if k < delay else link.sent[-delay], None if k < LATENCY else held)
        states.append(link.monitor.is_lost)
    assert states == [False] * LATENCY + [True] * (delay - LATENCY) + [False] * (40 - delay)


def test_machine_that_interpolates_between_commands_does_not_depart() -> None:
    link = Link(tolerance=0.0)
    link.follow(20)
    assert not any(link.cycle(link.sent[-3] + 0.4) for _ in range(50))


def test_first_commands_may_be_on_their_way() -> None:
    link = Link()
    assert [link.cycle(-7.0) for _ in range(LATENCY + 2)] == [False] * LATENCY + [True] * 2
    link.monitor.begin()
    assert [link.cycle(-7.0) for _ in range(LATENCY + 2)] == [False] * LATENCY + [True] * 2


def test_machine_that_reports_nothing_any_more_departs() -> None:
    link = Link()
    link.follow(20)
    assert [link.cycle(None) for _ in range(LATENCY + 1)] == [False] * (LATENCY - 1) + [True] * 2
    assert link.monitor.is_unreported and not link.monitor.is_lost
    assert not link.cycle(link.sent[-1])


def test_small_steps_are_noticed_when_they_add_up() -> None:
    """An unnoticed step stays below twice the tolerance, for outages of at least twice the latency."""
    for step in (0.01, 0.05, 0.1, 0.2):
        link = Link()
        for _ in range(20):
            link.cycle(0.0, 0.0)
        for k in range(1, 200):
            departs = link.cycle(0.0, step * k)
            if k > 2 * LATENCY and not departs:
                assert step * k <= 2.0 * TOLERANCE


@pytest.mark.parametrize(
    "wrong", [lambda: Link(latency=0), lambda: Link(latency=256), lambda: Link().monitor.note_sent([1.0])]
)
def test_impossible_arguments_are_refused(wrong: Callable[[], object]) -> None:
    with pytest.raises((ValueError, TypeError), match=r"1 to 255 cycles, not|array of 1 numbers, not \[1.0\]"):
        wrong()
