"""Commands do not arrive for a while: the machine brakes by its time-out, and does not lunge when they arrive again."""

from __future__ import annotations

from contextlib import suppress
from typing import Any

import numpy as np
import pytest

from tests.machine.course import Course, course, station
from vtbdrake.control.bridge import acts_idle
from vtbdrake.control.fault import FaultKind
from vtbdrake.control.switching import SwitchRefusedError
from vtbdrake.machine.injected_faults import Delay, Drop
from vtbdrake_diagrams.manipulator.motions import Motion

OUTAGES = (0.05, 0.12, 0.3, 2.0)
"""Durations of outages, in s; the machine brakes after 0.1 s, and rests before the last of them ends."""
AMID = {Motion.SWING: 1.3, Motion.PRESS: 1.0, Motion.CIRCLE: 2.1}
"""The time from the choice of a motion until the joints of the arm are fastest, in s."""
WAY = 0.001
"""The way of the station's joints in a period, in rad."""


def arm(motion: Motion, **options: Any) -> Course:
    """Return the arm amid a motion."""
    name = "wall" if motion == Motion.PRESS else "free"
    arm = course(name, "joint_torque", "joint_velocity", **options)
    arm.run(0.1)
    arm.runtime.write({"u.motion": float(motion)})
    arm.run(AMID[motion])
    return arm


def take_back(course: Course) -> None:
    """Reset the guards of the arm, which follows first."""
    course.runtime.write({"u.motion": float(Motion.FOLLOW)})
    course.run(0.2)  # The DPS limits the rate of its own torque.
    course.runtime.reset()
    course.run(0.1)
    assert course.latched == []


def check_arm(motion: Motion, outage: float) -> None:
    course = arm(motion)
    begin = course.cycles
    course.lose(outage)
    course.run(0.3)
    if outage > 0.1:
        assert course.latched == [FaultKind.NOT_ACTING]
    if course.latched:
        take_back(course)
    assert course.largest_step(begin) <= 1.0 + 1e-9
    assert course.speed(begin) <= 1.2 * course.speed(0, begin)


def test_arm_that_presses_does_not_lunge_after_an_outage() -> None:
    check_arm(Motion.PRESS, 0.3)


@pytest.mark.slow
@pytest.mark.parametrize("outage", OUTAGES)
@pytest.mark.parametrize("motion", [Motion.SWING, Motion.PRESS, Motion.CIRCLE])
def test_arm_does_not_lunge_after_an_outage(motion: Motion, outage: float) -> None:
    check_arm(motion, outage)


@pytest.mark.slow
def test_arm_lunges_if_nothing_is_compared() -> None:
    """So the assertions above would notice it."""
    course = arm(Motion.CIRCLE, compared=False)
    begin = course.cycles
    course.lose(2.0)
    course.run(0.3)
    # The arm may become so fast that its velocity is refused.
    assert FaultKind.NOT_ACTING not in course.latched
    assert course.largest_step(begin) > 10.0 and course.speed(begin) > 3.0 * course.speed(0, begin)


def reset_at_rest(course: Course) -> None:
    """Reset the guards of a station as soon as its reference is where the arm rests, within 3 s."""
    for _ in range(14):
        course.run(0.2)
        with suppress(SwitchRefusedError):
            course.runtime.reset()
            return
    course.run(0.2)
    course.runtime.reset()


def check_station(key: str, outage: float) -> None:
    course = station(key)
    begin = course.cycles
    course.lose(outage)
    course.run(0.3)
    if outage > 0.1:
        assert course.latched == [FaultKind.NOT_ACTING]
    if course.latched:
        with pytest.raises(SwitchRefusedError, match="is allowed"):
            course.runtime.reset()  # The DPS has gone on, away from the arm.
        resting = course.runtime.bridge.sensed["iiwa_position_measured"].value
        if key != "Torque":
            resting = course.runtime.bridge.reported["iiwa_position"].value
        course.runtime.write({"u.target": resting})
        reset_at_rest(course)
        course.run(0.3)
        assert course.latched == []
    assert course.largest_step(begin) <= 1.0 + 1e-9
    assert course.speed(begin) <= 1.2 * course.speed(0, begin)


@pytest.mark.slow
@pytest.mark.parametrize("outage", OUTAGES)
@pytest.mark.parametrize("key", ["Torque", "Position", "PositionAndTorque"])
def test_arm_of_a_station_does_not_lunge_after_an_outage(key: str, outage: float) -> None:
    check_station(key, outage)


@pytest.mark.slow
def test_stopped_machine_is_not_commanded_before_a_reset() -> None:
    """Its own stop is pressed for half a second, and released: the DPS commands after the reset only."""
    course = station("Torque")
    course.lose(0.5)
    stopped = course.runtime.bridge.sensed["iiwa_position_measured"].value.copy()
    course.run(0.5)
    assert course.latched == [FaultKind.NOT_ACTING]
    np.testing.assert_allclose(course.runtime.bridge.sensed["iiwa_position_measured"].value, stopped, atol=2e-3)


@pytest.mark.slow
def test_reset_is_refused_as_long_as_commands_do_not_arrive() -> None:
    course = arm(Motion.PRESS)
    course.machine.begin(Drop(side="act"))
    course.run(0.2)
    with pytest.raises(
        SwitchRefusedError, match="does not act on the actuator commands joint_torque: it reports 0 for"
    ):
        course.runtime.reset()


def test_machine_that_has_braked_is_left_at_once() -> None:
    course = station("Torque")
    course.machine.begin(Drop(side="act"))
    course.run(0.3)
    sent = course.runtime.bridge.sent["iiwa_torque"].count  # type: ignore[attr-defined]
    course.runtime.leave("the test ends")
    assert course.runtime.bridge.sent["iiwa_torque"].count <= sent + 1  # type: ignore[attr-defined]


@pytest.mark.slow
def test_commands_that_arrive_too_late_come_to_rest() -> None:
    """They act later than declared, in order: fallbacks go on from what was sent, not from what acts."""
    course = station("Position")
    begin = course.cycles
    course.machine.begin(Delay(side="act", seconds=0.04))
    course.run(2.0)
    assert course.latched == [FaultKind.NOT_ACTING]
    # At first it cannot be told from an outage: the way of eight periods acts later, and is taken back.
    assert course.largest_step(begin) * course.step.min() <= 8.5 * WAY
    assert course.speed(course.cycles - 20) < 1e-3


def test_idle_command_that_acts_releases_the_machine() -> None:
    course = station("Torque")
    is_released = acts_idle({"iiwa_torque": 0.0})
    assert not is_released(course.runtime.bridge)
    course.lose(0.3)
    assert is_released(course.runtime.bridge)
