"""Tests of a session in its own thread: its course against simulations made by hand."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from math import inf

import pytest

from tests.testbeds import PendulumScenario
from vtbdrake.state import AddressError, VariableError
from vtbdrake.testbed import Interface
from vtbdrake.web import Frame, SessionConfig, SessionError, SimulationSession
from vtbdrake_diagrams.cart_pole import CartPoleScenario

ANGLE, MASS = "sim.sys.cart_pole.pole_pin.position", "sim.sys.cart_pole.pole.mass"
START = {ANGLE: 2.0}
PATIENCE = 120.0  # seconds to wait for another thread
STEP = SessionConfig().step


@pytest.fixture
def session() -> Iterator[SimulationSession]:
    with SimulationSession(CartPoleScenario(), values=START) as running:
        yield running


@dataclass
class HeldPendulumScenario(PendulumScenario):
    """The pendulum with a limit of its torque."""

    def interface(self) -> Interface:
        (torque,) = super().interface().act
        return replace(super().interface(), act=(replace(torque, lower=-5.0, upper=5.0),))


def angle_by_hand(steps: int, changes: dict[int, dict[str, float]] | None = None) -> float:
    """The angle after a number of steps, with values that are set before some of them."""
    testbed = CartPoleScenario().build()
    context = testbed.default_context()
    testbed.write(context, START)
    simulator = testbed.simulator(context)
    simulator.Initialize()
    for step in range(steps):
        testbed.write(context, (changes or {}).get(step, {}))
        simulator.AdvanceTo((step + 1) * STEP)
    return float(testbed.read(context, ANGLE))


def angle(session: SimulationSession) -> float:
    return float(session.snapshot().values[ANGLE])


def frame(session: SimulationSession, condition: Callable[[Frame], bool]) -> Frame:
    """The first frame from now on that fulfils a condition."""
    number = 0
    while True:
        shown = session.wait_for_frame(number, PATIENCE)
        assert shown is not None
        if condition(shown):
            return shown
        number = shown.number


def test_course_is_that_of_a_simulation_by_hand(session: SimulationSession) -> None:
    session.advance(40)
    assert angle(session) == angle_by_hand(40)
    session.set_speed(inf)
    session.play()
    frame(session, lambda shown: shown.time > 1.0)
    session.pause()
    steps = round(session.snapshot().time / STEP)
    assert angle(session) == angle_by_hand(steps)
    session.reset()
    session.advance(40)
    assert angle(session) == angle_by_hand(40)


def test_written_values_act_from_now_on(session: SimulationSession) -> None:
    session.advance(10)
    session.write({MASS: 0.4})
    session.advance(30)
    assert angle(session) == angle_by_hand(40, {10: {MASS: 0.4}}) != angle_by_hand(40)


def test_preview_is_the_future_and_changes_nothing(session: SimulationSession) -> None:
    session.advance(16)
    session.watch("test", [ANGLE])
    session.preview({ANGLE: 1.0})
    preview = frame(session, lambda shown: shown.preview is not None and shown.preview["time"] >= shown.preview["end"])
    assert preview.preview == {"time": 16 * STEP + 2.0, "end": 16 * STEP + 2.0, "refused": ""}
    assert (preview.time, preview.playing) == (16 * STEP, False)
    session.cancel_preview()
    session.advance(24)
    assert angle(session) == angle_by_hand(40)
    assert frame(session, lambda shown: shown.time == 40 * STEP).preview is None


def test_preview_that_breaks_a_limit_or_fails_is_refused(session: SimulationSession) -> None:
    with SimulationSession(HeldPendulumScenario(stiffness=3.0, damping=1.0)) as held:
        held.preview({"u.angle": 2.0})  # 6 N m at once
        refused = frame(held, lambda shown: shown.preview is not None and bool(shown.preview["refused"]))
        assert refused.preview["refused"] == "the command torque is refused: limits"
        assert not refused.warnings  # of the present
        held.write({"u.angle": 2.0})
        assert frame(held, lambda shown: bool(shown.warnings)).warnings == ("the command torque is refused: limits",)
    session.preview({"sim.sys.cart_pole.pole_pin.velocity": 1e200})
    refused = frame(session, lambda shown: shown.preview is not None and bool(shown.preview["refused"]))
    assert not refused.failure


def test_course_without_the_intervention_goes_on_beside_it(session: SimulationSession) -> None:
    session.advance(10)
    session.write({MASS: 0.4}, compare=True)
    session.advance(30)
    assert angle(session) == angle_by_hand(40, {10: {MASS: 0.4}})
    shown = frame(session, lambda shown: shown.comparison is not None and shown.time == 40 * STEP)
    first = dict(shown.comparison["differences"])
    assert first[MASS] == first[ANGLE] == 11 * STEP
    assert all(10 * STEP < time <= 40 * STEP for time in first.values())


def test_going_back_and_on_is_another_branch(session: SimulationSession) -> None:
    for _ in range(20):
        session.advance(2)
        number = session.latest.number
        session.wait_for_frame(number, PATIENCE)
    (begin, end) = session.latest.history
    assert begin == 0.0 and 0.0 < end <= 40 * STEP
    session.seek(0.5 * end)
    when = frame(session, lambda shown: shown.time <= 0.5 * end).time
    steps = round(when / STEP)
    assert angle(session) == angle_by_hand(steps)
    session.write({MASS: 0.4})
    session.advance(20)
    assert angle(session) == angle_by_hand(steps + 20, {steps: {MASS: 0.4}})
    assert frame(session, lambda shown: shown.time == (steps + 20) * STEP).history[1] <= (steps + 20) * STEP


def test_other_branch_goes_on_with_its_own_changes() -> None:
    with SimulationSession(CartPoleScenario(), values=START, config=SessionConfig(history_period=1e-6)) as session:
        for k in range(20):
            if k == 10:
                session.write({MASS: 0.4})  # in what becomes the other branch
            session.advance(2)
            frame(session, lambda shown, k=k: shown.history[1] == 2 * (k + 1) * STEP)
        session.seek(-1.0)  # The oldest state is the one that is nearest.
        session.wait_for_frame(session.latest.number, PATIENCE)
        assert session.latest.time == 0.0
        session.seek(10 * STEP)
        assert frame(session, lambda shown: shown.time == 10 * STEP).comparison is None
        session.write({ANGLE: 1.0})
        shown = frame(session, lambda shown: shown.comparison is not None)
        assert shown.comparison == {"failure": "", "differences": [], "branch": True}
        session.write({ANGLE: 1.2})  # There are still the same two branches.
        session.advance(30)
        assert angle(session) == angle_by_hand(40, {10: {ANGLE: 1.2}})
        first = dict(frame(session, lambda shown: shown.time == 40 * STEP).comparison["differences"])
        assert first[ANGLE] == 11 * STEP
        assert first[MASS] == 22 * STEP  # The first state with it that was kept.


def test_slow_motion_stands_nearly_still(session: SimulationSession) -> None:
    session.advance(1)
    session.set_speed(1e-6)  # A step takes two hours.
    session.play()
    first = frame(session, lambda shown: shown.playing)
    last = frame(session, lambda shown: shown.number > first.number + 2)
    assert (last.time, last.playing, last.speed) == (STEP, True, 1e-6)


def test_failed_simulation_stands_still_until_it_is_reset(session: SimulationSession) -> None:
    session.advance(10)
    session.write({"sim.sys.cart_pole.pole_pin.velocity": 1e200})
    session.set_speed(inf)
    session.play()
    failed = frame(session, lambda shown: bool(shown.failure))
    assert not failed.playing
    # What is watched is still read, and what only now is, too.
    session.watch("test", [ANGLE, MASS])
    failed = frame(session, lambda shown: len(shown.values) == 2)
    assert failed.values[MASS] == session.snapshot().values[MASS] and failed.failure
    with pytest.raises(SessionError, match="the simulation has failed .*: go back, or reset"):
        session.play()
    session.reset()
    session.advance(40)
    assert angle(session) == angle_by_hand(40)


def test_bad_commands_are_refused_and_change_nothing(session: SimulationSession) -> None:
    with pytest.raises(AddressError, match="no variable 'sim.sys.pole'"):
        session.write({"sim.sys.pole": 1.0})
    with pytest.raises(VariableError, match="must lie in"):
        session.write({ANGLE: 1.0, MASS: -1.0})
    with pytest.raises(VariableError, match="must lie in"):
        session.preview({MASS: -1.0})
    with pytest.raises(AddressError):
        session.watch("test", ["nothing"])
    with pytest.raises(ValueError, match=r"nothing feeds real.sense.joint_position"):
        session.switch("real")
    with pytest.raises(SessionError, match="positive"):
        session.set_speed(0.0)
    with pytest.raises(ValueError, match="the speed"):
        session.set_speed("fast")
    with pytest.raises(SessionError, match="1 to 10,000 steps, not 0"):
        session.advance(0)
    with pytest.raises(SessionError, match="goes back to a time"):
        session.seek(float("nan"))
    session.advance(40)
    assert angle(session) == angle_by_hand(40)


def test_watched_values_are_those_of_the_watchers(session: SimulationSession) -> None:
    session.watch("a", [ANGLE, "dps.force"])
    session.watch("b", [MASS])
    values = frame(session, lambda shown: len(shown.values) == 3).values
    assert values[ANGLE] == 2.0 and values["dps.force"] == [0.0]
    session.watch("a", [])
    assert frame(session, lambda shown: len(shown.values) == 1).values == {MASS: values[MASS]}


def test_session_that_has_ended_refuses_commands() -> None:
    session = SimulationSession(CartPoleScenario())
    session.play()
    session.close()
    session.close()
    with pytest.raises(SessionError, match="the session has ended"):
        session.pause()
    with pytest.raises(VariableError, match="must lie in"):
        SimulationSession(CartPoleScenario(), values={MASS: -1.0})
    with pytest.raises(SessionError, match="frame_rate"):
        SessionConfig(frame_rate=0.0)
