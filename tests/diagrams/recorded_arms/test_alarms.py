"""The checks of a calibration on recordings whose columns are right, and on the same with a defect."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from tests.real import recordings
from vtbdrake.calibration.log_checks import check_log
from vtbdrake.recording import Log, Series
from vtbdrake_diagrams.cassie_landing.reality import logs
from vtbdrake_diagrams.double_pendulum import DoublePendulumScenario
from vtbdrake_diagrams.recorded_arms.alarms import (
    POSITION,
    TORQUE,
    Recorded,
    column_alarms,
    of_arm,
    of_double_pendulum,
)
from vtbdrake_diagrams.recorded_arms.subjects import go2_recordings, tx40_recording

pytestmark = pytest.mark.one_python

Columns = tuple[np.ndarray, np.ndarray]


def double_pendulum(number: int) -> Recorded:
    return of_double_pendulum(recordings("dfki_double_pendulum")[0])[number]


def with_defect(each: Recorded, change: Callable[[np.ndarray, np.ndarray], Columns]) -> Recorded:
    q, u = each.log.sense[POSITION], each.log.act[TORQUE]
    values = change(q.values.copy(), u.values.copy())
    log = Log(each.log.source, {POSITION: Series(q.times, values[0])}, {TORQUE: Series(u.times, values[1])})
    return replace(each, log=log)


# In 4 and 7, the torques of a joint are lost in its friction: then shifts of columns explain a little more of nothing.
@pytest.mark.slow_cases
@pytest.mark.parametrize("number", [7, 4])
def test_real_double_pendulum_raises_no_alarm(number: int) -> None:
    share, alarms = double_pendulum(number).alarms()
    assert share > 0.5 and not alarms


@pytest.mark.slow
def test_joints_of_a_real_arm_that_rest_in_the_end_are_not_dead() -> None:
    arm = of_arm("TX40", tx40_recording(recordings("figaroh")[0]))
    assert check_log(arm.log, arm.scenario.interface(), position=POSITION, torque=TORQUE).remarks == ()


def test_real_leg_raises_no_alarm() -> None:
    leg = go2_recordings(recordings("go2_leg")[0])[0]
    share, alarms = of_arm("Go2 left", leg).alarms()
    assert share < 0.1 and not alarms


def test_real_landings_raise_no_alarm() -> None:
    landings = logs(recordings("cassie_impact")[0], position=POSITION, torque=TORQUE)
    assert len(landings) == 29 and not any(column_alarms(log) for log in landings)


@pytest.mark.parametrize(
    ("column", "change", "alarm"),
    [
        ("q", lambda values: values + 2.0 * np.pi * (np.arange(len(values)) >= 50)[:, None] * np.eye(14)[3], "wrapped"),
        ("q", lambda values: np.where(np.arange(14) == 6, values[:1], values), r"never changes in the entries 6"),
        ("u", lambda values: 1e3 * values, "beyond its bounds"),
    ],
)
def test_defect_of_a_real_landing_is_noticed(
    column: str, change: Callable[[np.ndarray], np.ndarray], alarm: str
) -> None:
    for log in logs(recordings("cassie_impact")[0], position=POSITION, torque=TORQUE):
        q, u = log.sense[POSITION], log.act[TORQUE]
        q, u = (replace(each, values=change(each.values)) if column == k else each for k, each in (("q", q), ("u", u)))
        said = " ".join(column_alarms(Log(log.source, {POSITION: q}, {TORQUE: u})))
        assert re.search(alarm, said), said


def late(q: np.ndarray, u: np.ndarray) -> Columns:
    q[100:, 1] = q[:-100, 1].copy()
    return q, u


@pytest.mark.slow_cases
@pytest.mark.parametrize(
    ("number", "change", "text"),
    [
        (2, lambda q, u: (q * [1.0, np.rad2deg(1.0)], u), "with position 1 in degrees, alone"),
        (1, lambda q, u: (q, u * [1.0, -1.0]), "with the other sign of torque 1"),
        (1, late, "position 1 seems to be recorded"),
        (2, lambda q, u: (q[:, ::-1], u[:, ::-1]), "with joints 0 and 1 exchanged"),
    ],
)
def test_defects_of_a_real_recording_are_named(
    number: int, change: Callable[[np.ndarray, np.ndarray], Columns], text: str
) -> None:
    _, alarms = with_defect(double_pendulum(number), change).alarms()
    assert any(text in alarm for alarm in alarms), alarms


def test_sensor_that_was_dead_is_told_from_a_joint_that_rested() -> None:
    def dead(q: np.ndarray, u: np.ndarray) -> Columns:
        q[2000:2400, 1] = q[2000, 1]  # 0.8 s
        return q, u

    def rested(q: np.ndarray, u: np.ndarray) -> Columns:
        q[2000:2400, 1] = q[2000, 1]
        q[2400:, 1] -= q[2400, 1] - q[2000, 1]
        return q, u

    text = "does not go on from there: a sensor that was dead"
    interface = DoublePendulumScenario().interface()
    for change, is_dead in ((dead, True), (rested, False)):
        log = with_defect(double_pendulum(1), change).log
        remarks = check_log(log, interface, position=POSITION, torque=TORQUE).remarks
        assert any(text in remark for remark in remarks) == is_dead, remarks
