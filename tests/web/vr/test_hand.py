"""Tests of a hand that leads: clutch, box, limits and time-outs against closed forms, on simulated clocks."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from pydrake.common.eigen_geometry import AngleAxis, Quaternion
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

from vtbdrake.testbed import Interface, Signal, SignalError
from vtbdrake.testbed.hand_command import HandCommand
from vtbdrake.web.vr.hand import Clutch, ExcessDelay, HandError, HandMessage, Lead

pytestmark = pytest.mark.one_python

LIMITS = HandCommand(
    command="hand", pose="", lower=(0.0, -1.0, 0.0), upper=(1.0, 1.0, 1.0), speed=0.25, turn_rate=1.0, scale=0.5
)
TOOL = RigidTransform(RollPitchYaw(0.1, 0.2, 0.3), [0.5, 0.0, 0.5])
HAND = RigidTransform(RollPitchYaw(-0.4, 1.0, 2.0), [3.0, -2.0, 1.2])


def pose(command: np.ndarray) -> RigidTransform:
    assert command[0] == 1.0
    return RigidTransform(Quaternion(command[1:5]), command[5:])


def closed(command: HandCommand = LIMITS, tool: RigidTransform = TOOL) -> Clutch:
    clutch = Clutch(command)
    clutch.close(HAND, tool, 0.0)
    return clutch


def moved(translation: Any, rotation: RotationMatrix | None = None) -> RigidTransform:
    """The hand after a displacement and a rotation in the world."""
    return RigidTransform((rotation or RotationMatrix()) @ HAND.rotation(), HAND.translation() + translation)


@pytest.mark.parametrize("false", [1e9, -1e9, 1e300])
def test_message_with_a_false_time_locks_a_headset_out_for_one_message(false: float) -> None:
    delay = ExcessDelay()
    delays = [delay.of(false if k == 40 else 0.01 * k, 5.0 + 0.01 * k) for k in range(80)]
    assert [k for k, late in enumerate(delays) if late > 0.1] == ([40] if false < 0.0 else [41])
    assert delay.of(0.8, 6.3) == pytest.approx(0.5)  # What is really late is noticed again.


def test_clock_that_stood_still_in_a_silence_locks_a_headset_out_for_half_a_second() -> None:
    delay = ExcessDelay()
    times = [0.01 * k for k in range(100)]
    assert max(delay.of(time, time) for time in times) == 0.0
    # After ten minutes in which its clock stood still; what had waited comes first.
    delays = [delay.of(1.0 + time, 601.0 + max(time, 0.305)) for time in times]
    assert {time for time, late in zip(times, delays, strict=True) if late > 0.1} == {t for t in times if t < 0.805}


def test_clutch_adds_the_scaled_motion_of_the_hand_to_the_pose_of_the_tool() -> None:
    clutch = closed()
    assert pose(clutch.command(0.0)).IsNearlyEqualTo(TOOL, 1e-12)
    turn = RotationMatrix(AngleAxis(0.03, [0.0, 0.6, 0.8]))
    clutch.follow(moved([0.02, 0.01, -0.02], turn))
    expected = RigidTransform(turn @ TOOL.rotation(), TOOL.translation() + 0.5 * np.array([0.02, 0.01, -0.02]))
    assert pose(clutch.command(0.1)).IsNearlyEqualTo(expected, 1e-9)
    clutch.open()
    np.testing.assert_array_equal(clutch.command(0.2), [0, 1, 0, 0, 0, 0, 0, 0])
    clutch.close(moved([5.0, 5.0, 5.0]), expected, 7.0)  # Taken again elsewhere: nothing jumps.
    assert pose(clutch.command(7.1)).IsNearlyEqualTo(expected, 1e-9)


def test_new_clutch_and_new_lead_do_not_move_a_robot() -> None:
    np.testing.assert_array_equal(Clutch(LIMITS).command(0.0), [0, 1, 0, 0, 0, 0, 0, 0])
    rig = Rig()
    rig.lead = Lead(LIMITS, lambda: TOOL)
    assert not rig.lead.armed and not rig.lead.leading and not rig.closed
    rig.take()
    assert not rig.lead.leading and not rig.closed and rig.lead.notice == "not armed"


def test_turns_are_scaled_about_their_own_axis() -> None:
    clutch = closed(replace(LIMITS, turn_scale=0.5, turn_rate=100.0))
    axis = np.array([2.0, -1.0, 2.0]) / 3
    clutch.follow(moved([0, 0, 0], RotationMatrix(AngleAxis(1.2, axis))))
    expected = RigidTransform(RotationMatrix(AngleAxis(0.6, axis)) @ TOOL.rotation(), TOOL.translation())
    assert pose(clutch.command(0.1)).IsNearlyEqualTo(expected, 1e-9)


def test_pose_moves_no_faster_than_its_limits() -> None:
    clutch = closed()
    clutch.follow(moved([0.4, 0.0, 0.0], RotationMatrix(AngleAxis(0.5, [0, 0, 1]))))
    poses = [pose(clutch.command(0.01 * k)) for k in range(1, 101)]
    x = [X.translation()[0] for X in poses]
    np.testing.assert_allclose(x, np.minimum(0.5 + 0.25 * 0.01 * np.arange(1, 101), 0.7), atol=1e-12)
    angles = [(X.rotation() @ TOOL.rotation().inverse()).ToAngleAxis().angle() for X in poses]
    np.testing.assert_allclose(angles, np.minimum(1.0 * 0.01 * np.arange(1, 101), 0.5), atol=1e-9)
    clutch.follow(moved([-0.4, 0.0, 0.0]))
    assert pose(clutch.command(60.0)).translation()[0] == pytest.approx(0.7 - 0.25 * 0.1)  # A pause is not made up for.


def test_tool_stays_in_the_box() -> None:
    clutch = closed(replace(LIMITS, speed=100.0))
    clutch.follow(moved([4.0, 0.4, -4.0]))
    np.testing.assert_allclose(pose(clutch.command(0.1)).translation(), [1.0, 0.2, 0.0])
    clutch.follow(moved([0.1, 0.4, -0.1]))  # It is the hand's place that counts, not its way.
    np.testing.assert_allclose(pose(clutch.command(0.2)).translation(), [0.55, 0.2, 0.45])


def test_tool_outside_the_box_is_led_inwards_only() -> None:
    outside = RigidTransform(TOOL.rotation(), [1.3, 0.0, 0.5])
    clutch = closed(replace(LIMITS, speed=100.0), outside)
    assert pose(clutch.command(0.1)).IsNearlyEqualTo(outside, 1e-12)
    clutch.follow(moved([1.0, 0.0, 0.0]))
    assert pose(clutch.command(0.2)).translation()[0] == pytest.approx(1.3)
    clutch.follow(moved([-0.8, 0.0, 0.0]))
    assert pose(clutch.command(0.3)).translation()[0] == pytest.approx(0.9)


@pytest.mark.parametrize("offset", [-1e6, 1e6])
def test_delay_does_not_depend_on_which_clock_is_ahead(offset: float) -> None:
    delay = ExcessDelay()
    for k in range(200):
        late = 0.25 if k % 3 else 0.0
        assert delay.of(0.5 * k, offset + 0.5 * k + 0.03 + late) == pytest.approx(late, abs=1e-9)


def test_delay_is_measured_against_the_quickest_message_and_forgets_a_drift() -> None:
    delay = ExcessDelay()
    assert delay.of(1000.0, 5.0) == 0.0
    assert delay.of(1000.01, 5.26) == pytest.approx(0.25)
    assert delay.of(1000.3, 5.3) == 0.0
    for k in range(40_000):  # 100 s at 400 Hz, with a clock that is 1 % slow
        late = delay.of(1001.0 + 0.99 * 0.0025 * k, 6.0 + 0.0025 * k)
        assert 0.0 <= late < 0.21


class Rig:
    """A lead, and headsets that send at 50 Hz."""

    def __init__(self) -> None:
        self.lead, self.now = Lead(LIMITS, lambda: TOOL), 0.0
        self.lead.arm()

    def send(
        self, headset: str = "A", *, grip: bool, side: str = "left", at: Any = (0, 0, 0), late: float = 0.0
    ) -> str:
        self.now += 0.02
        hands = {side: moved(at)}
        message = HandMessage(self.now - late, HAND, hands, {side: grip}, {side: (1.0, 0.5)})
        return self.lead.receive(headset, message, self.now)

    def take(self, headset: str = "A", **options: Any) -> None:
        self.send(headset, grip=False, **options)
        self.send(headset, grip=True, **options)

    @property
    def closed(self) -> bool:
        return bool(self.lead.command(self.now)[0])


def test_grip_that_is_taken_leads_until_it_is_let_go() -> None:
    rig = Rig()
    rig.take()
    assert rig.closed and rig.lead.notice == "the left hand leads" and rig.lead.buttons == (1.0, 0.5)
    rig.send(grip=True, at=(0.004, 0, 0))
    assert rig.lead.command(rig.now)[5] == pytest.approx(0.502)
    rig.send(grip=False)
    assert not rig.closed and rig.lead.armed and "let go" in rig.lead.notice
    rig.send(grip=True, side="right")  # It was held before the right hand was seen.
    assert not rig.closed
    rig.take(side="right")
    assert rig.closed and rig.lead.notice == "the right hand leads"


def test_grip_leads_for_as_long_as_it_is_held() -> None:
    rig = Rig()
    rig.take()
    for k in range(200):  # 4 s
        assert rig.send(grip=True, at=(1e-4 * k, 0, 0)) == "" and rig.closed
    assert rig.lead.headset == "A" and rig.lead.head is HAND
    assert rig.lead.command(rig.now)[5] == pytest.approx(0.5 + 0.5 * 199e-4, abs=2e-4)


def test_grip_that_is_held_when_the_robot_is_armed_does_not_lead() -> None:
    rig = Rig()
    rig.lead.disarm("")
    assert rig.send(grip=False) == rig.send(grip=True) == "the robot is not armed"
    rig.lead.arm()
    assert rig.send(grip=True) == "" and not rig.closed
    rig.take()
    assert rig.closed


def test_silent_headset_releases_after_100_ms_and_disarms_after_2_s() -> None:
    rig = Rig()
    rig.take()
    begin = rig.now
    assert rig.lead.command(begin + 0.0999)[0] == 1.0
    assert rig.lead.command(begin + 0.1001)[0] == 0.0 and "no pose for 100 ms" in rig.lead.notice
    rig.now = begin + 0.3
    rig.send(grip=True)  # The page goes on with the grip still held.
    assert not rig.closed and rig.lead.armed
    rig.take()
    assert rig.closed
    rig.now += 2.11
    assert not rig.closed and not rig.lead.armed and "silent for 2 s" in rig.lead.notice
    assert rig.send(grip=False) == "the robot is not armed"


def test_closed_page_disarms_at_once() -> None:
    rig = Rig()
    rig.take()
    rig.lead.gone("A")
    assert not rig.closed and not rig.lead.armed and "page of the headset is gone" in rig.lead.notice
    rig.lead.arm()
    rig.lead.gone("B")  # It did not lead.
    assert rig.lead.armed


def test_two_headsets_do_not_share_a_robot() -> None:
    rig = Rig()
    rig.take("A")
    assert rig.send("B", grip=False, at=(1, 1, 1)) == rig.send("B", grip=True) == "another headset leads"
    rig.send("A", grip=True, at=(0.001, 0, 0))
    assert rig.closed and rig.lead.command(rig.now)[5] == pytest.approx(0.5005)
    rig.lead.gone("A")
    rig.lead.arm()
    assert rig.send("B", grip=True) == "" and not rig.closed  # held since before
    rig.take("B")
    assert rig.closed


def test_poses_that_have_waited_are_not_followed() -> None:
    rig = Rig()
    rig.take()
    assert rig.send(grip=True, at=(0.3, 0, 0), late=0.15) == "its poses arrive too late"
    assert not rig.closed and "150 ms late" in rig.lead.notice
    rig.send(grip=True)
    assert not rig.closed
    rig.take()
    assert rig.closed


def test_hand_that_is_not_tracked_releases() -> None:
    rig = Rig()
    rig.take()
    rig.send(grip=True, side="right")
    assert not rig.closed and "not tracked" in rig.lead.notice


def test_unknown_pose_of_the_tool_leads_nowhere() -> None:
    def unknown() -> RigidTransform:
        raise HandError("the loop does not answer")

    rig = Rig()
    rig.lead = Lead(LIMITS, unknown)
    rig.lead.arm()
    rig.send(grip=False)
    with pytest.raises(HandError, match="does not answer"):
        rig.send(grip=True)
    assert not rig.closed


GOOD = {
    "time": 1.0,
    "head": [1, 0, 0, 0, 0, 0, 1.6],
    "left": {"pose": [0, 0, 0, 1, 1, 2, 3], "grip": True, "buttons": [0.5]},
}


def test_message_is_read() -> None:
    message = HandMessage.of(GOOD)
    assert message.grips == {"left": True} and message.buttons == {"left": (0.5,)}
    np.testing.assert_allclose(message.hands["left"].translation(), [1, 2, 3])
    np.testing.assert_allclose(message.hands["left"].rotation().matrix(), np.diag([-1, -1, 1]), atol=1e-15)
    assert message.head is not None and message.head.translation()[2] == 1.6
    assert HandMessage.of({"time": 0, "left": None}).hands == {}
    for norm in (0.91, 1.09):  # Rounded on the way
        head = HandMessage.of({"time": 0, "head": [0.6 * norm, 0.8 * norm, 0, 0, 0, 0, 0]}).head
        assert head is not None
        np.testing.assert_allclose(head.rotation().ToQuaternion().wxyz(), [0.6, 0.8, 0, 0], atol=1e-12)


@pytest.mark.parametrize(
    "wrong",
    [
        {"time": None},
        {"time": float("nan")},
        {"head": [1, 0, 0, 0, 0, 0]},
        {"head": [1.1, 0, 0, 0, 0, 0, 0]},
        {"head": [0.9, 0, 0, 0, 0, 0, 0]},
        {"left": {"pose": [1, 0, 0, 0, 0, 0, float("inf")], "grip": True}},
        {"left": {"pose": [True, 0, 0, 0, 0, 0, 0], "grip": True}},
        {"left": {"pose": [1, 0, 0, 0, 0, 0, 0]}},
        {"left": [1, 2]},
        {"left": {"pose": [1, 0, 0, 0, 0, 0, 0], "grip": True, "buttons": ["x"]}},
    ],
)
def test_message_that_is_none_is_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(HandError, match="cannot be understood"):
        HandMessage.of(GOOD | wrong)


def test_command_of_a_hand_releases_a_robot_by_itself() -> None:
    def interface(**options: Any) -> Interface:
        return Interface(sense=[], act=[], commands=[Signal("hand", **({"size": 8, "max_age": 0.1} | options))])

    LIMITS.check_interface(interface())
    with pytest.raises(SignalError, match="8 entries; hand has 7"):
        LIMITS.check_interface(interface(size=7))
    with pytest.raises(SignalError, match="finite max_age"):
        LIMITS.check_interface(interface(max_age=float("inf")))
    with pytest.raises(SignalError, match="finite max_age"):
        LIMITS.check_interface(interface(default=[1.0, *[0.0] * 7]))
    LIMITS.check_interface(interface(default=[0.0, *[1.0] * 7]))
    with pytest.raises(SignalError, match="no command hand"):
        LIMITS.check_interface(Interface(sense=[], act=[]))


def test_commands_of_head_and_buttons_are_checked_too() -> None:
    def check(**signals: int) -> None:
        commands = [Signal("hand", size=8, max_age=0.1), *(Signal(name, size=size) for name, size in signals.items())]
        limits.check_interface(Interface(sense=[], act=[], commands=commands))

    limits = replace(LIMITS, head="gaze", buttons="trigger", begin={"mode": 1.0})
    check(gaze=7, trigger=1, mode=1)
    check(gaze=7, trigger=5, mode=1)
    with pytest.raises(SignalError, match="7 entries; gaze has 8"):
        check(gaze=8, trigger=1, mode=1)
    for name in ("gaze", "trigger", "mode"):
        with pytest.raises(SignalError, match=f"no command {name}: a hand gives one of hand, "):
            check(**{other: 7 if other == "gaze" else 1 for other in ("gaze", "trigger", "mode") if other != name})


def test_hand_leads_a_robot_slowly_and_one_to_one_by_default() -> None:
    command = HandCommand(command="hand", pose="", lower=(0.0, 0.0, 0.0), upper=(1.0, 1.0, 1.0))
    assert command.speed == 0.25  # m/s, the reduced speed of ISO 10218-1
    assert command.scale == command.turn_scale == command.turn_rate == 1.0
    assert command.release_time == 0.1 and command.stand == (0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("name", "greatest", "is_positive"),
    [
        ("scale", 10.0, True),
        ("turn_scale", 3.0, False),
        ("release_time", 10.0, True),
        ("speed", 1e3, True),
        ("turn_rate", 1e3, True),
    ],
)
def test_limits_of_a_hand_are_positive_and_bounded(name: str, greatest: float, is_positive: bool) -> None:
    assert getattr(replace(LIMITS, **{name: greatest}), name) == greatest  # type: ignore[arg-type]
    wrong = [
        float("nan"),
        float("inf"),
        -1e-3,
        *([0.0] if is_positive else []),
        *([1.01 * greatest] * (greatest < 1e3)),
    ]
    for value in wrong:
        with pytest.raises(SignalError, match=name):
            replace(LIMITS, **{name: value})  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("upper", "error"),
    [
        ((1.0, -1.0, 1.0), "is not below"),
        ((0.0, 1.0, 1.0), "is not below"),
        ((1.0, 1.0), "a list of 3 entries"),
        ((1.0, 1.0, float("nan")), "a finite number"),
        ((1.0, 1.0, float("inf")), "a finite number"),
    ],
)
def test_box_without_an_inside_is_refused(upper: tuple[float, ...], error: str) -> None:
    with pytest.raises(SignalError, match=error):
        replace(LIMITS, upper=upper)  # type: ignore[arg-type]
