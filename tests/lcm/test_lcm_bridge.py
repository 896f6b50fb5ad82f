"""The bridge accepts and sends valid messages, alone and on a real bus with other processes."""

from __future__ import annotations

import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from drake import lcmt_iiwa_status, lcmt_robot_state

from tests.control.arm import LIMIT, SENSE, bridge, command, interface, status
from tests.lcm.bus import PATIENCE, Peer, free_port, in_step, wait
from vtbdrake.control.bridge import BridgeError
from vtbdrake.control.received_signal import ReceivedSignal
from vtbdrake.lcm.hub import STATUS_CHANNEL, ChannelStatistics, Hub, HubStatistics
from vtbdrake.lcm.iiwa_messages import iiwa_status
from vtbdrake.lcm.lcm_bridge import ChannelReader, ForeignCommands, LcmBridge
from vtbdrake.lcm.maps import LcmMap, vector_map
from vtbdrake.testbed import Interface, Signal

ROOT = Path(__file__).resolve().parents[2]


class Arm:
    """The reader of an arm's status, and its two signals."""

    def __init__(self, *, reorder_window: float = math.inf) -> None:
        self.position, self.torque = ReceivedSignal(), ReceivedSignal()
        signals = {"position": self.position, "torque": self.torque}
        self.later = 0.0
        self.reader = ChannelReader(
            iiwa_status(SENSE),
            interface().sense,
            signals,
            reorder_window,
            clock=lambda: time.monotonic() + self.later,
        )

    def take(self, *messages: lcmt_iiwa_status | bytes) -> Arm:
        for message in messages:
            self.reader.receive("IIWA_STATUS", message if isinstance(message, bytes) else message.encode())
        return self


def test_accepted_message_updates_its_signals() -> None:
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
def test_rejected_message_is_counted_by_reason(before: int, data: bytes, reason: str | dict[str, str]) -> None:
    arm = Arm().take(*(status(utime) for utime in range(1, before + 1))).take(data)
    reasons = {"position": reason, "torque": reason} if isinstance(reason, str) else reason
    for name in ("position", "torque"):
        received = getattr(arm, name)
        assert (received.count, received.rejected) == (before, {reasons[name]: 1})
    assert arm.position.value is None or arm.position.value.tolist() == [0.1] * 7


def test_signals_of_a_message_are_checked_one_by_one() -> None:
    arm = Arm().take(status(1), status(2, position=2 * LIMIT, torque=5.0))
    assert (arm.position.count, arm.position.rejected) == (1, {"limits": 1})
    assert (arm.torque.count, arm.torque.value.tolist()) == (2, [5.0] * 7)


def test_late_and_repeated_messages_are_rejected() -> None:
    arm = Arm().take(status(1), status(3), status(3), status(2), status(4, position=0.4))
    assert arm.position.count == 3
    assert arm.position.rejected == {"duplicate": 1, "out of order": 1}
    assert arm.position.value.tolist() == [0.4] * 7


def test_clock_set_back_is_accepted_after_the_window() -> None:
    arm = Arm(reorder_window=0.0).take(status(1000), status(1, position=0.5), status(2, position=0.6))
    assert (arm.position.value.tolist(), arm.reader.clock_jumps) == ([0.6] * 7, 1)
    assert arm.take(status(3)).reader.clock_jumps == 1


FAR = 10**15


def test_one_time_far_ahead_is_rejected() -> None:
    arm = Arm().take(status(1), status(FAR, position=0.9), *(status(utime) for utime in range(2, 50)))
    assert (arm.position.count, arm.position.rejected) == (49, {"ahead of time": 1})
    assert arm.position.value.tolist() == [0.1] * 7


@pytest.mark.parametrize("before", [1, 2])
def test_clock_set_ahead_is_accepted_after_the_window(before: int) -> None:
    arm = Arm(reorder_window=0.0).take(*(status(utime) for utime in range(1, before + 1)))
    arm.take(status(FAR), status(FAR + 1, position=0.5), status(FAR + 2, position=0.6))
    assert arm.position.rejected == {"ahead of time": 1}
    assert (arm.position.value.tolist(), arm.reader.clock_jumps) == ([0.6] * 7, 1)


def test_first_time_far_ahead_is_overcome_after_the_window() -> None:
    arm = Arm(reorder_window=0.0).take(status(FAR), status(1), status(2, position=0.5), status(3, position=0.6))
    assert (arm.position.value.tolist(), arm.reader.clock_jumps) == ([0.6] * 7, 1)


def test_sender_may_be_ahead_by_the_time_that_passed() -> None:
    arm = Arm().take(status(1_000_000))
    arm.later = 3600.0
    assert arm.take(status(3_601_000_000)).position.count == 2


def test_message_after_one_that_waited_is_accepted() -> None:
    arm = Arm().take(status(1_000_000))
    arm.later = 3600.0
    arm.take(status(1_001_000), status(3_601_000_000))  # The first one has waited for an hour.
    assert (arm.position.count, arm.position.rejected, arm.reader.clock_jumps) == (3, {}, 0)


def test_late_messages_are_no_clock_jump() -> None:
    arm = Arm(reorder_window=0.0)
    for utime in range(100, 200):
        arm.take(status(utime), status(utime - 50))
    assert arm.reader.clock_jumps == 0
    assert arm.position.rejected["out of order"] == 100


def test_repeated_time_is_never_accepted_again() -> None:
    arm = Arm(reorder_window=0.0).take(*[status(7)] * 50)
    assert (arm.position.count, arm.position.rejected) == (1, {"duplicate": 49})


def test_time_of_a_rejected_message_is_ignored() -> None:
    arm = Arm().take(status(1), status(10**15, position=math.nan, torque=math.nan), status(2))
    assert arm.position.count == 2


def test_messages_without_a_time_are_all_accepted(user_types: ModuleType) -> None:
    received = ReceivedSignal()
    map = vector_map("POINT", user_types.point_t, {"x": "x"}, stamp="")
    reader = ChannelReader(map, [Signal("x", size=1)], {"x": received}, 0.1)
    for _ in range(3):
        reader.receive("POINT", user_types.point_t().encode())
    assert received.count == 3
    assert math.isnan(received.sent)


def fail(_: Any) -> dict[str, Any]:
    raise ZeroDivisionError


def exit_process(_: Any) -> dict[str, Any]:
    raise SystemExit(1)  # as a failed assertion in Drake's C++ does


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
def test_failing_decoder_of_a_user_is_counted(
    user_types: ModuleType, decode: Callable[[Any], dict[str, Any]], reason: str
) -> None:
    received = ReceivedSignal()
    map = LcmMap(channel="POINT", type=user_types.point_t, signals=["x"], decode=decode)
    ChannelReader(map, [Signal("x", size=1)], {"x": received}, 0.1).receive("POINT", user_types.point_t().encode())
    assert (received.count, received.rejected) == (0, {reason: 1})


def test_messages_of_another_process_arrive(hub: Hub) -> None:
    sender = f"""
import lcm
from tests.control.arm import status
bus = lcm.LCM({hub.url!r})
for utime in range(1, 101):
    bus.publish("IIWA_STATUS", status(utime, position=utime * 0.01).encode())
"""
    with closing(bridge(hub.url)) as arm:
        arm.open()
        subprocess.run([sys.executable, "-c", sender], cwd=ROOT, check=True, timeout=60)
        assert wait(arm, lambda: arm.sensed["position"].count == 100)
        received = arm.sensed["position"]
        np.testing.assert_array_equal(received.value, [1.0] * 7)
        assert 0.0 <= received.age(time.monotonic()) < PATIENCE
        assert (received.sent, received.rejected) == (pytest.approx(100e-6), {})


def test_only_actuator_commands_are_published(hub: Hub) -> None:
    peer = Peer(hub.url)
    with closing(bridge(hub.url)) as arm:
        arm.open()
        in_step(arm, peer)
        arm.publish({})
        arm.publish({"position": np.full(7, 0.5)})
        arm.publish({"position": np.full(7, 0.6), "torque": np.full(7, -1.0)})
        heard = peer.hear(3)
    assert [channel for channel, _ in heard] == ["IIWA_STATUS", "IIWA_COMMAND", "IIWA_COMMAND"]
    np.testing.assert_array_equal(command(heard[1][1])[0], [0.5] * 7)
    assert command(heard[1][1])[1].size == 0
    np.testing.assert_array_equal(command(heard[2][1]), [[0.6] * 7, [-1.0] * 7])
    assert arm.sent["position"].count == 2
    assert arm.sent["torque"].count == 1


@pytest.mark.parametrize(
    ("value", "reason"),
    [
        (np.full(7, math.nan), "not finite"),
        (np.full(7, math.inf), "not finite"),
        (np.full(7, 2 * LIMIT), "limits"),
        (np.zeros(6), "size"),
        ("text", "type"),
    ],
)
def test_invalid_command_withholds_its_whole_message(hub: Hub, value: object, reason: str) -> None:
    peer = Peer(hub.url)
    with closing(bridge(hub.url)) as arm:
        arm.open()
        in_step(arm, peer)
        assert arm.publish({"position": value, "torque": np.zeros(7)}) == ("position", "torque")
        assert arm.publish({"torque": np.ones(7)}) == ()
        heard = peer.hear(2)
    assert [command(data)[1].tolist() for _, data in heard[1:]] == [[1.0] * 7]
    assert arm.sent["position"].withheld == {reason: 1}
    assert arm.sent["torque"].withheld == {"same message": 1}


def test_unknown_actuator_signal_is_an_error() -> None:
    with closing(bridge("memq://")) as arm:
        arm.open()
        with pytest.raises(ValueError, match="there is no actuator signal jaw; there are position, torque"):
            arm.publish({"jaw": [0.0]})


@pytest.mark.parametrize("url", ["", "127.0.0.1:7700"])
def test_url_without_provider_is_refused(url: str) -> None:
    with pytest.raises(ValueError, match="provider://network"):
        bridge(url)


def test_private_bus_carries_own_messages() -> None:
    with closing(bridge("memq://", watch=True)) as arm:
        arm.open()
        arm.publish({"position": np.zeros(7)})
        assert arm.poll(1.0) == 1
        assert arm.foreign_messages == {"IIWA_COMMAND": 0}


def test_poll_takes_a_limited_number_of_messages(hub: Hub) -> None:
    peer = Peer(hub.url)
    with closing(bridge(hub.url, burst=10)) as arm:
        arm.open()
        for utime in range(1, 36):
            peer.lcm.publish("IIWA_STATUS", status(utime).encode())
        peer.hear(35)
        counts, position = [], arm.sensed["position"]
        while position.count < 35 and len(counts) < 1000:
            counts.append(arm.poll(1.0))
        assert max(counts) <= 10
        assert position.count == 35


@pytest.mark.parametrize("closed", [False, True])
def test_values_that_waited_in_a_pause_are_dated_back(closed: bool) -> None:
    with Hub(port=0) as hub, closing(bridge(hub.url)) as arm:
        arm.open()
        peer, sensed = Peer(hub.url), arm.sensed
        in_step(arm, peer)
        since = time.monotonic()
        for utime in range(2, 500):  # More than the socket holds; the hub keeps the others.
            peer.lcm.publish("IIWA_STATUS", status(utime).encode())
        peer.hear(499)
        if closed:
            os.kill(hub.pid, signal.SIGSTOP)  # The mark never comes back.
        assert arm.note_pause(since, ["position"])
        if closed:
            os.kill(hub.pid, signal.SIGKILL)
            assert wait(arm, lambda: not arm.connected)
            assert sensed["position"].count > 1
        else:
            assert wait(arm, lambda: sensed["position"].count == 499)
            assert sensed["torque"].arrived > since
        assert sensed["position"].arrived <= since

        def heard_again() -> bool:
            peer.lcm.publish("IIWA_STATUS", status(500 + int(1e6 * time.monotonic())).encode())
            return sensed["position"].arrived > since

        assert closed or wait(arm, heard_again)


def test_copy_of_an_own_message_is_foreign(hub: Hub) -> None:
    peer = Peer(hub.url)
    with closing(bridge(hub.url, watch=True)) as arm:
        arm.open()
        in_step(arm, peer)
        for _ in range(5):
            arm.publish({"position": np.zeros(7)})
        own = peer.hear(6)[-1][1]
        peer.lcm.publish("IIWA_STATUS", status(2).encode())
        assert wait(arm, lambda: arm.sensed["position"].count == 2)  # so all five commands are read
        assert arm.foreign_messages == {"IIWA_COMMAND": 0}
        peer.lcm.publish("IIWA_COMMAND", own)  # a recorded one, byte for byte
        assert wait(arm, lambda: arm.foreign_messages == {"IIWA_COMMAND": 1})


def first_of(report: Callable[[], str | None]) -> str:
    """Ask for a report that lasts for a second, until it comes."""
    return next(filter(None, (report() for _ in range(1000))))


def test_competing_publisher_is_reported_for_a_while(hub: Hub) -> None:
    peer = Peer(hub.url)
    with closing(bridge(hub.url)) as arm:
        arm.open()
        in_step(arm, peer)
        arm.publish({"position": np.zeros(7)})
        peer.hear(2)
        arm.poll(0.1)
        assert (arm.foreign, arm.competing_publisher) == (0, None)

        def report() -> str | None:
            count = arm.foreign
            peer.lcm.publish("IIWA_COMMAND", b"foreign")
            assert wait(arm, lambda: arm.foreign == count + 1)
            return arm.competing_publisher  # for a second

        assert "another client publishes commands on IIWA_COMMAND" in first_of(report)
        count = arm.foreign
        assert wait(arm, lambda: arm.competing_publisher is None)
        assert arm.foreign == count


def test_publisher_refused_by_the_hub_is_reported() -> None:
    with Hub(port=0, protect=["IIWA_COMMAND"], lease=300.0) as hub, closing(bridge(hub.url)) as arm:
        intruder = Peer(hub.url)
        arm.open()
        arm.publish({"position": np.zeros(7)})
        assert wait(arm, lambda: hub.statistics().protected["IIWA_COMMAND"].owner is not None)

        def report() -> str | None:
            intruder.lcm.publish("IIWA_COMMAND", b"foreign")
            arm.poll(0.02)
            return arm.competing_publisher

        assert "another client publishes commands on IIWA_COMMAND" in first_of(report)
        assert [data for channel, data in intruder.heard if channel == "IIWA_COMMAND"].count(b"foreign") == 0
        assert wait(arm, lambda: arm.competing_publisher is None)
        assert arm.blocked_reason is None


def test_own_and_earlier_refusals_are_not_foreign() -> None:
    foreign = ForeignCommands(["C"], lambda: "me")

    def told(owner: str, refused: int, last: str) -> int:
        state = ChannelStatistics(owner=owner, refused=refused, last_refused=last)
        foreign.receive_status(STATUS_CHANNEL, HubStatistics(protected={"C": state}).to_json())
        return foreign.refused

    assert told("me", 7, "other") == 0  # before the first status
    assert told("me", 9, "other") == 2
    assert told("other", 12, "me") == 2
    assert told("me", 13, "me") == 2
    assert told("me", 0, "other") == 2  # of a restarted hub
    assert told("me", 1, "other") == 3
    assert foreign.recent(60.0) == {"C"} and foreign.recent(0.0) == set()


def test_owner_of_a_protected_channel_blocks_others() -> None:
    with (
        Hub(port=0, protect=["IIWA_COMMAND"]) as hub,
        closing(bridge(hub.url)) as commander,
        closing(bridge(hub.url)) as listener,
    ):
        commander.open()
        listener.open()
        in_step(listener, Peer(hub.url))
        commander.publish({"position": np.zeros(7)})
        assert wait(listener, lambda: listener.foreign == 1 and listener.blocked_reason is not None)
        assert listener.competing_publisher is None


def test_own_messages_that_come_back_late_are_not_foreign() -> None:
    foreign = ForeignCommands(["C"], lambda: None)
    own = [str(number).encode() for number in range(3000)]
    for data in (*own, own[7]):
        foreign.expect("C", data)
    for data in (own[7], *reversed(own)):
        foreign.receive("C", data)
    assert foreign.heard == {"C": 0}
    for data in (own[7], b"foreign"):
        foreign.receive("C", data)
    assert foreign.heard == {"C": 2}


def test_own_messages_that_never_come_back_are_forgotten() -> None:
    foreign = ForeignCommands(["C"], lambda: None)
    for number in range(20_000):
        foreign.expect("C", str(number).encode())
    foreign.receive("C", b"0")
    assert foreign.heard == {"C": 1}


def test_own_message_on_another_channel_is_foreign() -> None:
    foreign = ForeignCommands(["C", "D"], lambda: None)
    foreign.expect("C", b"1")
    foreign.receive("D", b"1")
    assert foreign.heard == {"C": 0, "D": 1}


def test_foreign_publisher_is_heard_on_udpm() -> None:
    url = f"udpm://239.255.76.67:{free_port()}?ttl=0"
    with closing(bridge(url)) as arm:
        try:
            arm.open()
        except BridgeError:
            pytest.skip("no multicast here")
        arm.publish({"position": np.zeros(7)})
        if not arm.poll(1.0):
            pytest.skip("no multicast here")
        assert arm.foreign_messages == {"IIWA_COMMAND": 0}
        code = f"import lcm; lcm.LCM({url!r}).publish('IIWA_COMMAND', b'foreign')"
        subprocess.run([sys.executable, "-c", code], check=True, timeout=60)
        if not wait(arm, lambda: arm.foreign_messages == {"IIWA_COMMAND": 1}):
            pytest.skip("multicast does not pass between processes here")


def test_frozen_owner_is_replaced_only_on_request() -> None:
    with Hub(port=0, protect=["IIWA_COMMAND"], lease=0.05) as hub:
        peer = Peer(hub.url)
        with closing(bridge(hub.url)) as first, closing(bridge(hub.url)) as second:
            first.open()
            second.open()
            in_step(first, peer)
            first.publish({"position": np.full(7, 1.0)})
            peer.hear(2)
            second.publish({"position": np.full(7, 2.0)})
            end = time.monotonic() + PATIENCE
            while len(peer.heard) < 3 and time.monotonic() < end:
                second.claim()
                second.publish({"position": np.full(7, 3.0)})
                peer.lcm.handle_timeout(20)
            positions = [command(data)[0][0] for channel, data in peer.heard if channel == "IIWA_COMMAND"]
            assert positions[:2] == [1.0, 3.0]


def test_commands_refused_by_the_hub_are_counted_and_logged(caplog: pytest.LogCaptureFixture) -> None:
    with (
        Hub(port=0, protect=["IIWA_COMMAND"], lease=300.0) as hub,
        closing(bridge(hub.url)) as first,
        closing(bridge(hub.url)) as second,
    ):
        first.open()
        second.open()

        def both_publish() -> bool:
            for arm in (first, second):
                arm.poll()
                left_out = arm.publish({"position": np.full(7, 1.0)})
            refused = second.sent["position"].withheld.get("refused", 0)
            assert left_out == (("position",) if refused else ())
            return refused >= 3

        first.publish({"position": np.full(7, 1.0)})
        wait(first, lambda: hub.statistics().protected["IIWA_COMMAND"].owner is not None)
        assert wait(second, both_publish)
        assert first.sent["position"].withheld == {}
        assert first.blocked_reason is None
        assert second.blocked_reason == "the hub protects IIWA_COMMAND for another client"
        [record] = [record for record in caplog.records if "refused by the hub" in record.message]
        assert hub.statistics().protected["IIWA_COMMAND"].owner in record.message


@pytest.mark.parametrize("status", [b"", b"{}", b"[]", b"\xff", b'{"protected": {"IIWA_COMMAND": 1}}'])
def test_invalid_hub_status_is_logged_and_ignored(status: bytes, caplog: pytest.LogCaptureFixture) -> None:
    foreign = ForeignCommands(["IIWA_COMMAND"], lambda: "127.0.0.1:1")
    foreign.receive_status("VTB_HUB", status)
    assert foreign.blocked == frozenset()
    assert "no status" in caplog.text


def test_claim_needs_a_hub() -> None:
    with pytest.raises(ValueError, match="only a hub protects channels"):
        bridge("memq://").claim()


def test_commands_u_arrive_over_lcm(hub: Hub, user_types: ModuleType) -> None:
    goal = Interface(
        sense=[], act=[], commands=[Signal("goal", size=3, lower=-1.0, upper=1.0), Signal("local", size=1)]
    )
    map = vector_map("GOAL", user_types.point_t, {"goal": ("x", "y", "z")}, stamp="")
    with closing(LcmBridge(goal, hub.url, sense=[], act=[], commands=[map])) as arm:
        arm.open()
        peer = Peer(hub.url)
        for x in (0.5, 2.0):
            message = user_types.point_t()
            message.x, message.y = x, 0.25
            peer.lcm.publish("GOAL", message.encode())
        assert wait(arm, lambda: arm.commands["goal"].rejected == {"limits": 1})
        np.testing.assert_array_equal(arm.commands["goal"].value, [0.5, 0.25, 0.0])
        assert list(arm.commands) == ["goal"]
