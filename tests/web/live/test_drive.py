"""Tests of driving by hand: what moves, what it costs, and what is computed again."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.testbeds import PendulumScenario
from tests.web.live.test_session import frame
from vtbdrake.optimization import Parameter, Problem
from vtbdrake.rollout import Quality
from vtbdrake.rollout.course import task_without_problem
from vtbdrake.rollout.named_function import magnitude
from vtbdrake.testbed import Interface
from vtbdrake.web import SessionConfig, SessionError, SimulationSession
from vtbdrake.web.live.drive import DriveError
from vtbdrake.web.live.written_course import WrittenCourse

ANGLE, COMMAND, TORQUE = "sim.sys.Pendulum.theta.position", "u.angle", "T_act.torque.idle"
STEP = SessionConfig().step


@dataclass
class LimitedPendulumScenario(PendulumScenario):
    """The pendulum, whose command and torque have limits."""

    stiffness: float = 30.0
    damping: float = 3.0

    def interface(self) -> Interface:
        (torque,), (angle,) = super().interface().act, super().interface().commands
        return replace(
            super().interface(),
            act=(replace(torque, lower=-5.0, upper=5.0),),
            commands=(replace(angle, lower=-1.0, upper=1.0, rate=0.8),),
        )


def problem(threshold: float | None = None, *, horizon: float = 1.0) -> Problem:
    return Problem(
        scenario=LimitedPendulumScenario(),
        parameters=[Parameter(ANGLE, -1.0, 1.0)],
        quality=Quality(magnitude, of=ANGLE),
        horizon=horizon,
        threshold=threshold,
        sample_period=0.1,
    )


@pytest.fixture
def session() -> Iterator[SimulationSession]:
    with SimulationSession(LimitedPendulumScenario(), problem=problem()) as running:
        yield running


def read(session: SimulationSession, address: str) -> float:
    return float(session.snapshot().values[address])


def test_handles_are_the_commands_and_actuators_with_their_limits(session: SimulationSession) -> None:
    assert list(session.handles) == [COMMAND, TORQUE]
    command, torque = session.handles.values()
    assert (command.lower[0], command.upper[0], command.rate[0], command.unit) == (-1.0, 1.0, 0.8, "rad")
    assert (torque.lower[0], torque.upper[0], torque.rate[0], torque.unit) == (-5.0, 5.0, 5.0, "N m")


def test_command_moves_at_its_rate_within_its_bounds(session: SimulationSession) -> None:
    session.drive([COMMAND])
    session.deflect({COMMAND: 0.5})
    session.advance(64)
    assert read(session, COMMAND) == pytest.approx(0.5 * 0.8 * 64 * STEP)
    session.deflect({})
    session.advance(4)
    assert read(session, COMMAND) == pytest.approx(0.5 * 0.8 * 64 * STEP)
    session.deflect({COMMAND: [1.0]})
    session.advance(60)
    assert session.end_drive().result.end == "horizon"
    assert read(session, COMMAND) == pytest.approx(0.2 + 0.8 * 60 * STEP)


def test_driven_course_is_scored_and_computed_again_bit_for_bit(session: SimulationSession) -> None:
    session.advance(5)
    session.drive([COMMAND])
    session.deflect({COMMAND: 1.0})
    session.advance(30)
    session.write({"sim.sys.Pendulum.theta.position": 0.1})
    session.deflect({COMMAND: -0.3})
    session.advance(30)
    shown = frame(session, lambda shown: shown.drive is not None and shown.drive["seconds"] == 60 * STEP)
    assert shown.drive["value"] == abs(read(session, ANGLE)) and shown.drive["ended"] == ""
    driven = session.end_drive()
    assert (driven.course.start.time, driven.course.steps) == (5 * STEP, 60)
    assert driven.result.message == "ended by hand" and driven.result.h == max(driven.result.quality) > 0.0
    assert driven.course.rollout(problem().task).identical(driven.result)
    other = replace(driven.course, writes=[(n, v) for n, v in driven.course.writes if n != 30])
    assert not other.rollout(problem().task).identical(driven.result)


def test_drive_ends_where_the_rollout_of_the_problem_does() -> None:
    with SimulationSession(LimitedPendulumScenario(), problem=problem(threshold=0.15)) as session:
        session.drive([COMMAND])
        session.deflect({COMMAND: 1.0})
        session.advance(60)
        ended = frame(session, lambda shown: shown.drive is not None and bool(shown.drive["ended"]))
        assert ended.drive["ended"] == "threshold" and ended.drive["value"] > 0.15
        with pytest.raises(SessionError, match=r"the driven rollout has ended \(threshold\): keep it, or drop it"):
            session.advance(1)
        driven = session.end_drive()
        assert driven.result.t_star == ended.drive["t_star"]
        assert driven.summary()["seconds"] == driven.result.t_star
        session.advance(1)


def test_dropped_drive_leaves_no_trace(session: SimulationSession) -> None:
    session.advance(10)
    before = session.snapshot()
    session.drive([COMMAND, TORQUE])
    session.deflect({COMMAND: 1.0, TORQUE: -1.0})
    session.advance(20)
    session.end_drive(keep=False)
    assert not session.snapshot().compare(before)


def test_actuator_moves_from_the_command_of_the_dps_and_returns_it(session: SimulationSession) -> None:
    session.write({COMMAND: 0.1})
    session.drive([TORQUE], returning=[TORQUE])
    session.advance(1)
    first = frame(session, lambda shown: shown.time == STEP).drive["values"][TORQUE][0]
    assert first == pytest.approx(3.0 - 5.0 * STEP)  # 30 N m/rad times 0.1 rad, on its way to 0
    session.deflect({TORQUE: 1.0})
    session.advance(127)
    session.deflect({})
    assert frame(session, lambda shown: shown.time == 1.0).drive["values"][TORQUE] == [5.0]
    assert frame(session, lambda shown: shown.time == 1.0).positions["act"] == {"torque": "real"}
    session.end_drive()
    assert frame(session, lambda shown: shown.drive is None).positions["act"] == {"torque": "sim"}


def test_course_that_nobody_drives_goes_on_beside_it(session: SimulationSession) -> None:
    session.drive([COMMAND], compare=True)
    session.deflect({COMMAND: 1.0})
    session.advance(20)
    shown = frame(session, lambda shown: shown.comparison is not None and shown.time == 20 * STEP)
    assert dict(shown.comparison["differences"])[COMMAND] == STEP
    with SimulationSession(LimitedPendulumScenario()) as plain:
        plain.advance(20)
        undriven = read(plain, ANGLE)
    session.end_drive(keep=False)
    assert frame(session, lambda shown: shown.drive is None).comparison is None
    session.advance(20)
    assert read(session, ANGLE) == undriven
    session.drive([COMMAND], compare=True)
    session.deflect({COMMAND: 1.0})
    session.advance(20)
    session.end_drive()
    shown = frame(session, lambda shown: shown.drive is None)
    assert dict(shown.comparison["differences"])[COMMAND] == 21 * STEP  # It is compared on.


def test_bad_drives_are_refused(session: SimulationSession) -> None:
    with pytest.raises(DriveError, match=r"u.angel cannot be driven by hand; did you mean u.angle\?"):
        session.drive(["u.angel"])
    with pytest.raises(DriveError, match="nothing is driven"):
        session.drive([])
    with pytest.raises(SessionError, match="nothing is driven: take over first"):
        session.end_drive()
    session.deflect({COMMAND: 1.0})  # a page that is late
    session.drive([COMMAND])
    for action in (lambda: session.drive([COMMAND]), lambda: session.seek(0.0), lambda: session.switch(act="real")):
        with pytest.raises(SessionError, match="has to wait until the drive has ended"):
            action()
    for deflection in (1.5, [0.1, 0.2], np.nan):
        with pytest.raises(DriveError, match="1 numbers from -1 to 1"):
            session.deflect({COMMAND: deflection})
    with pytest.raises(DriveError, match="T_act.torque.idle is not driven, but u.angle"):
        session.deflect({TORQUE: 1.0})
    with pytest.raises(SessionError, match="the problem is one of"):
        SimulationSession(PendulumScenario(), problem=problem())


def test_drive_and_history_are_not_lost_by_a_reset(session: SimulationSession) -> None:
    session.advance(10)
    session.drive([COMMAND])
    session.deflect({COMMAND: 1.0})
    session.advance(8)
    with pytest.raises(SessionError, match="beginning again has to wait until the drive has ended: keep it, or drop"):
        session.reset()
    assert session.end_drive().course.steps == 8
    assert frame(session, lambda shown: shown.drive is None).history[0] == 0.0
    session.reset()
    assert session.snapshot().time == 0.0


def test_sticks_are_released_and_time_stands_still_when_the_driver_is_gone(session: SimulationSession) -> None:
    session.let_go("nobody drives")  # Nothing happens.
    session.drive([COMMAND, TORQUE], returning=[TORQUE])
    session.deflect({COMMAND: 1.0, TORQUE: 1.0})
    session.advance(4)
    assert frame(session, lambda shown: shown.time == 4 * STEP).drive["values"][TORQUE][0] > 0.0
    session.play()
    session.let_go("the page is frozen")
    shown = frame(session, lambda shown: not shown.playing and bool(shown.drive))
    assert shown.drive["notice"] == "the page is frozen"
    command = read(session, COMMAND)
    stopped = shown.time
    session.advance(60)
    assert read(session, COMMAND) == command
    assert frame(session, lambda shown: shown.time > stopped).drive["values"][TORQUE] == [0.0]
    session.play()
    frame(session, lambda shown: shown.playing and shown.drive["notice"] == "")
    session.end_drive(keep=False)


def test_interventions_are_a_course_that_is_saved_as_a_test(session: SimulationSession, tmp_path: Path) -> None:
    with pytest.raises(SessionError, match="there is nothing to save: set something, or drive"):
        session.save_test(tmp_path / "test_nothing.py")
    session.advance(3)
    session.write({COMMAND: 0.3})
    session.write({COMMAND: 0.4})
    session.advance(10)
    session.write({COMMAND: -0.2})
    session.advance(5)
    course = session.course
    assert course is not None and (course.start.time, course.steps) == (3 * STEP, 15)
    assert list(course.writes) == [(0, {COMMAND: 0.4}), (10, {COMMAND: -0.2})]
    session.save_test(tmp_path / "test_command.py", tolerance=1e-4)
    namespace: dict[str, Any] = {"__file__": str(tmp_path / "test_command.py")}
    exec((tmp_path / "test_command.py").read_text(), namespace)
    namespace["test_command"]()
    assert namespace["TASK"]["horizon"] == 1.0 and namespace["TOLERANCE"] == 1e-4
    session.drive([COMMAND])
    with pytest.raises(SessionError, match="saving has to wait"):
        session.save_test(tmp_path / "test_drive.py")
    session.advance(8)
    driven = session.end_drive()
    assert session.course is driven.course
    session.reset()
    assert session.course is None


def test_course_of_many_interventions_is_bounded_and_repeats_its_end() -> None:
    scenario = LimitedPendulumScenario()
    testbed = scenario.build()
    context = testbed.default_context()
    simulator = testbed.simulator(context)
    interventions = WrittenCourse(STEP, longest_part=4)
    for n in range(11):
        for value in (0.9, 0.1 * n):  # The second of an instant counts.
            if interventions.needs_state:
                interventions.begin(testbed.snapshot(context))
            testbed.write(context, {COMMAND: value})
            interventions.add(n * STEP, {COMMAND: value})
        simulator.AdvanceTo((n + 1) * STEP)
    course = interventions.course(11 * STEP)
    assert course is not None
    assert (course.start.time, course.steps) == (6 * STEP, 5)
    assert [(n, values[COMMAND]) for n, values in course.writes] == [
        (n, pytest.approx(0.1 * (6 + n))) for n in range(5)
    ]
    again = course.driven(task_without_problem(scenario)).read([ANGLE])[ANGLE]
    assert again == pytest.approx(float(testbed.variables().read(context, [ANGLE])[ANGLE]), rel=1e-6)


def test_without_a_problem_the_watched_values_are_expected(tmp_path: Path) -> None:
    with SimulationSession(LimitedPendulumScenario()) as session:
        session.watch("test", [ANGLE, "dps.torque"])
        session.write({COMMAND: 0.3})
        session.advance(20)
        angle = read(session, ANGLE)
        session.save_test(tmp_path / "test_angle.py")
    namespace: dict[str, Any] = {"__file__": str(tmp_path / "test_angle.py")}
    exec((tmp_path / "test_angle.py").read_text(), namespace)
    assert namespace["EXPECTED"] == {ANGLE: pytest.approx(angle, rel=1e-9)}
    namespace["test_angle"]()
