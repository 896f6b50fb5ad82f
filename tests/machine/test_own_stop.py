"""A machine that stops by itself blocks the commands of its loop, and needs a reset after it was released."""

from __future__ import annotations

import numpy as np
import pytest

from tests.machine.course import Course, course, station
from vtbdrake.control.fault import FaultKind
from vtbdrake.control.switching import SwitchRefusedError
from vtbdrake.machine.injected_faults import Drop, OwnStop
from vtbdrake_diagrams.manipulator.motions import Motion
from vtbdrake_diagrams.satellite.supervisor import STAY


def press_stop(course: Course, seconds: float) -> None:
    """Press the stop of the machine, and run for a while."""
    course.machine.begin(OwnStop())
    course.run(seconds)
    status = course.machine.status()
    assert status.braking and [fault["fault"] for fault in status.faults] == ["own_stop"]


def release_stop(course: Course) -> None:
    course.machine.end_faults()
    course.run(0.1)
    assert course.machine.status().faults == []


def reset_refused(course: Course) -> str:
    with pytest.raises(SwitchRefusedError) as refused:
        course.runtime.reset()
    return str(refused.value)


@pytest.mark.slow
def test_stopped_arm_is_commanded_again_after_a_reset_only() -> None:
    loop = course("free", "joint_torque", "joint_velocity")
    loop.run(0.1)
    loop.runtime.write({"u.motion": float(Motion.CIRCLE)})
    loop.run(1.0)
    begin = loop.cycles
    press_stop(loop, 0.2)
    assert FaultKind.NOT_ACTING in loop.latched  # The mode is reported up to four cycles later.
    assert "its own stop is pressed (it reports the arm_mode 2): release it" in reset_refused(loop)
    assert not loop.acting[-100:].any()
    release_stop(loop)
    assert loop.latched  # The fallback lets the arm float.
    loop.runtime.write({"u.motion": float(Motion.FOLLOW)})
    loop.run(0.2)  # The DPS limits the rate of its own torque.
    loop.runtime.reset()
    loop.run(0.2)
    assert loop.latched == []
    assert loop.largest_step(begin) <= 1.0 + 1e-9
    assert loop.speed(begin) <= 1.2 * loop.speed(0, begin)


def test_stopped_arm_is_not_taken_over() -> None:
    loop = course("free", "joint_torque")
    loop.runtime.leave("the test switches again")
    loop.machine.begin(OwnStop())
    loop.run(0.02)
    assert "its own stop is pressed" in str(loop.runtime.blocked_reason())
    assert any("its own stop is pressed" in reason for reason in loop.runtime.prepare("real").reasons)


def test_stopped_arm_needs_no_fallback() -> None:
    loop = course("free", "joint_torque")
    loop.run(0.05)
    press_stop(loop, 0.05)
    sent = loop.runtime.bridge.sent["joint_torque"].count  # type: ignore[attr-defined]
    loop.runtime.leave("the test ends")
    assert loop.runtime.bridge.sent["joint_torque"].count <= sent + 1  # type: ignore[attr-defined]


@pytest.mark.parametrize("name", ["cart_pole", pytest.param("satellite", marks=pytest.mark.slow)])
def test_stopped_machine_is_commanded_again_after_a_reset_only(name: str) -> None:
    signal = {"cart_pole": "force", "satellite": "joint_position"}[name]
    loop = course(name, signal)
    if name == "satellite":
        loop.runtime.write({"u.capture": STAY})  # Otherwise the plan of its DPS goes on while it stands.
    loop.run(0.5)
    press_stop(loop, 0.5)
    assert FaultKind.BLOCKED in loop.latched
    assert "its own stop is pressed" in reset_refused(loop)
    stopped = loop.acting[-1]
    release_stop(loop)
    assert FaultKind.BLOCKED in loop.latched
    np.testing.assert_allclose(loop.acting[-1], stopped, atol=1e-3)  # The fallback: no force, or the same positions.
    loop.runtime.reset()
    loop.run(0.2)
    assert loop.latched == []


@pytest.mark.slow
@pytest.mark.parametrize("name", ["Torque", "Position"])
def test_arm_whose_messages_do_not_tell_of_its_stop_is_compared(name: str) -> None:
    """An iiwa's messages do not tell of a stop: that its commands do not act is noticed, and so is a stop."""
    loop = station(name)
    begin = loop.cycles
    press_stop(loop, 0.5)
    assert loop.latched == [FaultKind.NOT_ACTING]
    assert "is allowed" in reset_refused(loop)  # The DPS has gone on, away from the arm.
    release_stop(loop)
    assert loop.latched == [FaultKind.NOT_ACTING]
    resting = loop.runtime.bridge.sensed["iiwa_position_measured"].value
    if name == "Position":
        resting = loop.runtime.bridge.reported["iiwa_position"].value
    loop.runtime.write({"u.target": resting})
    loop.run(3.0)
    loop.runtime.reset()
    loop.run(0.3)
    assert loop.latched == []
    assert loop.largest_step(begin) <= 1.0 + 1e-9
    assert loop.speed(begin) <= 1.2 * loop.speed(0, begin)


def test_machine_that_does_not_report_its_mode_any_more_is_not_commanded() -> None:
    loop = course("free", "joint_torque")
    loop.run(0.05)
    loop.machine.begin(Drop(channels=("ARM_MODE",)))
    loop.run(0.1)
    (fault,) = loop.runtime.guards.latched
    assert "it has not reported its mode arm_mode in the last 26 cycles" in fault.reason
