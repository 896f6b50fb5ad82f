"""Commands u of several senders on a real bus: none is lost because the clocks of the senders differ."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import lcm
import numpy as np
import pytest
from drake import lcmt_scope

from tests.control.scripted import PERIOD, ServoScenario
from tests.lcm.bus import PATIENCE, handled
from vtbdrake.control.clock import SimulatedClock
from vtbdrake.control.fault import FaultKind
from vtbdrake.control.received_signal import ReceivedSignal
from vtbdrake.control.runtime import Runtime
from vtbdrake.lcm.command_messages import command_map, command_message
from vtbdrake.lcm.hub import Hub
from vtbdrake.lcm.iiwa_messages import iiwa_command, iiwa_status
from vtbdrake.lcm.lcm_bridge import REJECTED_CHANNEL, LcmBridge
from vtbdrake.lcm.maps import LcmMap, vector_map
from vtbdrake.recording.recorder import Recorder
from vtbdrake.recording.replay import replay

CHANNEL = "TARGET"
GO = [1.0, 0.5]
STOP = [0.0, 0.0]
REPETITIONS = 20


def scope(value: list[float], utime: int, sender: str) -> bytes:
    message = lcmt_scope()
    message.utime, message.size, message.value = utime, len(value), value
    return bytes(message.encode())


def named(value: list[float], utime: int, sender: str) -> bytes:
    return command_message(value, sender=sender, utime=utime)


Encode = Callable[[list[float], int, str], bytes]
KINDS: dict[str, tuple[LcmMap, Encode]] = {
    "scope": (vector_map(CHANNEL, lcmt_scope, {"target": "value"}), scope),
    "named": (command_map(CHANNEL, "target"), named),
}


class Bus:
    """A loop's end of the bus, and two senders with a connection each."""

    def __init__(self, bridge: LcmBridge, encode: Encode) -> None:
        self.bridge = bridge
        self.encode = encode
        self.senders = {name: lcm.LCM(bridge.url) for name in ("planner", "operator")}

    @property
    def target(self) -> ReceivedSignal:
        return self.bridge.commands["target"]

    def send(self, sender: str, value: list[float], *, ahead: float = 0.0, utime: int | None = None) -> None:
        """Send a command from a clock that is ahead, and return when the bridge has received it."""
        before = handled(self.target)
        stamp = int((time.time() + ahead) * 1e6) if utime is None else utime
        end = time.monotonic() + PATIENCE
        self.senders[sender].publish(CHANNEL, self.encode(value, stamp, sender))
        while handled(self.target) == before and time.monotonic() < end:
            self.bridge.poll(0.05)


@pytest.fixture(scope="module")
def shared_hub() -> Iterator[Hub]:
    with Hub(port=0) as hub:
        yield hub


@contextmanager
def bus(hub: Hub, kind: str, *, window: float = 0.1) -> Iterator[Bus]:
    map, encode = KINDS[kind]
    status = iiwa_status({"position": "joint_position_measured", "speed": "joint_velocity_estimated"})
    command = iiwa_command({"velocity": "joint_torque"})
    maps = {"sense": [status], "act": [command], "commands": [map]}
    with closing(LcmBridge(ServoScenario().interface(), hub.url, **maps, reorder_window=window)) as bridge:
        bridge.open()
        yield Bus(bridge, encode)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("ahead", [1.0, 1.4, 3600.0, -1.4, -3600.0])
def test_stop_of_either_sender_stops(shared_hub: Hub, kind: str, ahead: float) -> None:
    with bus(shared_hub, kind) as both:
        for _ in range(REPETITIONS):
            for mover, stopper, its in (("planner", "operator", 0.0), ("operator", "planner", ahead)):
                both.send(mover, GO, ahead=ahead - its)
                assert both.target.value.tolist() == GO
                both.send(stopper, STOP, ahead=its)
                assert both.target.value.tolist() == STOP
        assert both.target.rejected == {}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("stamp", [2**63 - 1, -1, -(2**63), 2**53 + 2])
def test_command_with_an_absurd_time_changes_nothing(shared_hub: Hub, kind: str, stamp: int) -> None:
    with bus(shared_hub, kind) as both:
        answers: list[dict[str, object]] = []
        ear = lcm.LCM(shared_hub.url)
        ear.subscribe(REJECTED_CHANNEL, lambda _, data: answers.append(json.loads(data)))
        for k in range(REPETITIONS):
            both.send("operator", STOP, ahead=-1.0)
            both.send("planner", GO, utime=stamp)
            assert both.target.value.tolist() == STOP
            assert both.target.rejected == {"impossible time": k + 1}
        both.send("planner", GO, ahead=1.0)
        assert both.target.value.tolist() == GO
        end = time.monotonic() + PATIENCE
        while len(answers) < REPETITIONS and time.monotonic() < end:
            ear.handle_timeout(50)
        sender = "planner" if kind == "named" else ""
        expected = {"channel": CHANNEL, "sender": sender, "rejected": {"target": "impossible time"}, "count": 1}
        assert answers == [expected] * REPETITIONS


def test_overtaken_command_of_a_named_sender_is_rejected(shared_hub: Hub) -> None:
    with bus(shared_hub, "named", window=PATIENCE) as both:  # On a busy computer, 0.1 s may pass between the two.
        both.send("planner", STOP, utime=2_000_000)
        both.send("operator", GO, utime=1_000_000)
        assert both.target.value.tolist() == GO
        both.send("planner", STOP, utime=3_000_000)
        both.send("planner", GO, utime=2_500_000)
        both.send("planner", GO, utime=3_000_000)
        assert both.target.value.tolist() == STOP
        assert both.target.rejected == {"out of order": 1, "duplicate": 1}


@pytest.mark.slow_cases
@pytest.mark.parametrize("kind", KINDS)
def test_commands_of_two_senders_reach_the_dps_and_are_replayed(shared_hub: Hub, kind: str, tmp_path: Path) -> None:
    path = tmp_path / "two.lcm"
    with bus(shared_hub, kind) as both:
        runtime = Runtime(ServoScenario().build(), both.bridge, period=PERIOD, clock=SimulatedClock())
        seen = []
        with runtime, Recorder(runtime, path):
            for k in range(REPETITIONS):
                both.send("planner", [1.0, 0.1 * k], ahead=1.0)
                runtime.cycle()
                both.send("operator", STOP)
                runtime.cycle()
                seen.append(runtime.read("u.target").tolist())
            both.send("planner", GO, utime=2**63 - 1)
            runtime.cycle()
            [fault] = runtime.guards.log
        assert seen == [STOP] * REPETITIONS
        assert (fault.kind, fault.reason) == (
            FaultKind.COMMAND,
            "messages with the command target were rejected: 1 impossible time",
        )
    report = replay(path, record=["u.target"])
    assert report.identical and report.cycles == 2 * REPETITIONS + 1
    np.testing.assert_array_equal(report.record["u.target"][1::2], [STOP] * REPETITIONS)


def test_message_of_an_own_type_names_its_sender(shared_hub: Hub) -> None:
    with pytest.raises(ValueError, match="field value of lcmt_scope is no string"):
        vector_map(CHANNEL, lcmt_scope, {"target": "value"}, sender="value")


def test_command_message_keeps_the_order_of_its_sender() -> None:
    map = command_map(CHANNEL, "target")
    decode = map.decoder(ServoScenario().interface().commands)
    messages = [command_message([0.1, 0.2], sender="planner") for _ in range(100)]
    times = [decode(data)[0] for data in messages]
    assert times == sorted(times) and abs(times[0] - time.time()) < 3600.0
    assert {map.sender_of(data) for data in messages} == {"planner"}
    np.testing.assert_array_equal(decode(messages[0])[1]["target"], [0.1, 0.2])


@pytest.mark.parametrize(
    ("value", "sender", "message"),
    [
        (1.0, "a", r"a vector, not of shape \(\)"),
        (["1.5"], "a", r"the value of a command must be a number or several, not \['1.5'\]"),
        ([1.0], "", "1 to 64 characters, not 0"),
        ([1.0], "a" * 65, "not 65"),
    ],
)
def test_bad_command_message_is_refused(value: object, sender: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        command_message(value, sender=sender)  # type: ignore[arg-type]
