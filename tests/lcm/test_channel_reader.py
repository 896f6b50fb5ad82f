"""The reader of a channel accepts messages, or counts why not."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from drake import lcmt_iiwa_status, lcmt_robot_state

from tests.control.arm import LIMIT, SENSE, interface, status
from vtbdrake.control.bridge import ReceivedSignal
from vtbdrake.lcm.bridge import ChannelReader
from vtbdrake.lcm.drake_messages import iiwa_status
from vtbdrake.lcm.maps import LcmMap, vector_map
from vtbdrake.testbed import Signal


class Arm:
    """The reader of the arm's status, and its two signals."""

    def __init__(self, *, reorder_window: float = math.inf) -> None:
        self.position, self.torque = ReceivedSignal(), ReceivedSignal()
        signals = {"position": self.position, "torque": self.torque}
        self.reader = ChannelReader(iiwa_status(SENSE), interface().sense, signals, reorder_window)

    def take(self, *messages: lcmt_iiwa_status | bytes) -> Arm:
        for message in messages:
            self.reader.take("IIWA_STATUS", message if isinstance(message, bytes) else message.encode())
        return self


def test_accepted_message_is_known_by_value_time_and_count() -> None:
    arm = Arm().take(status(1_000_000), status(2_000_000, position=0.5, torque=30.0))
    np.testing.assert_array_equal(arm.position.value, [0.5] * 7)
    np.testing.assert_array_equal(arm.torque.value, [30.0] * 7)
    assert (arm.position.count, arm.position.sent, arm.position.rejected) == (2, 2.0, {})


@pytest.mark.parametrize("before", [0, 2])
@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (lcmt_robot_state().encode(), "fingerprint"),
        (status(9).encode()[:-1], "truncated"),
        (b"", "truncated"),
        (status(9).encode() + b"x", "trailing"),
        (status(9, joints=6).encode(), "size"),
        (status(9, position=math.nan, torque=math.inf).encode(), "not finite"),
        (status(9, position=LIMIT + 1e-9, torque=-math.inf).encode(), {"position": "limits", "torque": "not finite"}),
    ],
)
def test_rejected_message_is_counted_by_its_reason_and_changes_nothing(
    before: int, data: bytes, reason: str | dict[str, str]
) -> None:
    arm = Arm().take(*(status(utime) for utime in range(1, before + 1))).take(data)
    reasons = {"position": reason, "torque": reason} if isinstance(reason, str) else reason
    for name in ("position", "torque"):
        received = getattr(arm, name)
        assert (received.count, received.rejected) == (before, {reasons[name]: 1})
    assert arm.position.value is None or arm.position.value.tolist() == [0.1] * 7


def test_signal_out_of_its_limits_does_not_take_the_others_along() -> None:
    arm = Arm().take(status(1), status(2, position=2 * LIMIT, torque=5.0))
    assert (arm.position.count, arm.position.rejected) == (1, {"limits": 1})
    assert (arm.torque.count, arm.torque.value.tolist()) == (2, [5.0] * 7)


def test_late_and_repeated_messages_are_rejected() -> None:
    arm = Arm().take(status(1), status(3), status(3), status(2), status(4, position=0.4))
    assert arm.position.count == 3
    assert arm.position.rejected == {"duplicate": 1, "out of order": 1}
    assert arm.position.value.tolist() == [0.4] * 7


def test_sender_whose_clock_went_back_is_believed_after_the_window() -> None:
    arm = Arm(reorder_window=0.0).take(status(1000), status(1, position=0.5), status(2, position=0.6))
    assert (arm.position.value.tolist(), arm.reader.clock_jumps) == ([0.6] * 7, 1)
    assert arm.take(status(3)).reader.clock_jumps == 1


FAR = 10**15


def test_one_time_stamp_far_in_the_future_costs_its_own_message_only() -> None:
    arm = Arm().take(status(1), status(FAR, position=0.9), *(status(utime) for utime in range(2, 50)))
    assert (arm.position.count, arm.position.rejected) == (49, {"ahead of time": 1})
    assert arm.position.value.tolist() == [0.1] * 7


@pytest.mark.parametrize("before", [1, 2])
def test_sender_whose_clock_was_set_ahead_is_believed_after_the_window(before: int) -> None:
    arm = Arm(reorder_window=0.0).take(*(status(utime) for utime in range(1, before + 1)))
    arm.take(status(FAR), status(FAR + 1, position=0.5), status(FAR + 2, position=0.6))
    assert arm.position.rejected == {"ahead of time": 1}
    assert (arm.position.value.tolist(), arm.reader.clock_jumps) == ([0.6] * 7, 1)


def test_first_time_stamp_far_in_the_future_is_overcome_after_the_window() -> None:
    arm = Arm(reorder_window=0.0).take(status(FAR), status(1), status(2, position=0.5), status(3, position=0.6))
    assert (arm.position.value.tolist(), arm.reader.clock_jumps) == ([0.6] * 7, 1)


def test_time_that_passed_here_may_have_passed_there(monkeypatch: pytest.MonkeyPatch) -> None:
    arm = Arm().take(status(1_000_000))
    later = time.monotonic() + 3600.0
    monkeypatch.setattr("vtbdrake.lcm.bridge.time.monotonic", lambda: later)
    assert arm.take(status(3_601_000_000)).position.count == 2


def test_late_messages_among_others_never_count_as_a_clock_that_went_back() -> None:
    arm = Arm(reorder_window=0.0)
    for utime in range(100, 200):
        arm.take(status(utime), status(utime - 50))
    assert arm.reader.clock_jumps == 0
    assert arm.position.rejected["out of order"] == 100


def test_frozen_sender_is_never_believed_again() -> None:
    arm = Arm(reorder_window=0.0).take(*[status(7)] * 50)
    assert (arm.position.count, arm.position.rejected) == (1, {"duplicate": 49})


def test_time_of_a_rejected_message_counts_for_nothing() -> None:
    arm = Arm().take(status(1), status(10**15, position=math.nan, torque=math.nan), status(2))
    assert arm.position.count == 2


def test_message_without_a_time_is_new_whenever_it_comes(user_types: ModuleType) -> None:
    received = ReceivedSignal()
    map = vector_map("POINT", user_types.point_t, {"x": "x"}, stamp="")
    reader = ChannelReader(map, [Signal("x", size=1)], {"x": received}, 0.1)
    for _ in range(3):
        reader.take("POINT", user_types.point_t().encode())
    assert received.count == 3
    assert math.isnan(received.sent)


def fail(_: Any) -> dict[str, Any]:
    raise ZeroDivisionError


def exit_process(_: Any) -> dict[str, Any]:
    raise SystemExit(1)  # what a failed assertion in Drake's C++ is


@pytest.mark.parametrize(
    ("decode", "reason"),
    [
        (fail, "decode"),
        (exit_process, "decode"),
        (lambda message: {}, "missing"),
        (lambda message: {"x": "text"}, "type"),
        (lambda message: {"x": [[1.0], [2.0, 3.0]]}, "type"),
        (lambda message: {"x": [1.0, 2.0]}, "size"),
    ],
)
def test_decoder_of_a_user_that_fails_is_counted_and_nothing_is_raised(
    user_types: ModuleType, decode: Callable[[Any], dict[str, Any]], reason: str
) -> None:
    received = ReceivedSignal()
    map = LcmMap(channel="POINT", type=user_types.point_t, signals=["x"], decode=decode)
    ChannelReader(map, [Signal("x", size=1)], {"x": received}, 0.1).take("POINT", user_types.point_t().encode())
    assert (received.count, received.rejected) == (0, {reason: 1})
