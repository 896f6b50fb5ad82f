"""Checks of bridges: two real transports pass all of them, and a bridge with a mistake fails the check for it."""

from __future__ import annotations

import select
import socket
import threading
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from math import inf, nan
from typing import Any

import lcm
import numpy as np
import pytest

from tests.control.arm import bridge as arm_bridge
from tests.control.arm import command, status
from tests.diagrams.udp_end import UdpEnd
from vtbdrake.control import Inbox
from vtbdrake.control.bridge import Bridge
from vtbdrake.control.message_order import MachineOrder, MessageOrder
from vtbdrake.control.received_signal import ReceivedSignal
from vtbdrake.lcm.hub import Hub
from vtbdrake.testbed import Interface, Signal
from vtbdrake.testing import BridgeCheckError, CheckFailedError, MachineEnd, check_bridge
from vtbdrake.testing.bridge_check import BridgeSubject
from vtbdrake.testing.checks import bridge_checks as checks
from vtbdrake_diagrams.udp_bridge import Address, UdpBridge, decode, encode

pytestmark = pytest.mark.one_python

INTERFACE = Interface(
    sense=[Signal("position", size=2, unit="rad", lower=-3.0, upper=3.0, max_age=0.1), Signal("speed", size=1)],
    act=[Signal("torque", size=2, unit="N m", lower=-5.0, upper=5.0, idle=0.0), Signal("grip", size=1, idle=0.0)],
)


def free_address() -> Address:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        host, port = free.getsockname()
        return host, port


def udp(bridge_class: type[UdpBridge] = UdpBridge) -> tuple[Callable[[], Bridge], Callable[[], MachineEnd]]:
    own, machine = free_address(), free_address()
    return lambda: bridge_class(INTERFACE, own, machine), lambda: UdpEnd(INTERFACE, machine, own)


class LcmEnd(MachineEnd):
    """An arm on an LCM bus, by the lcm library alone."""

    def __init__(self, url: str) -> None:
        self._url = url
        self._lcm: lcm.LCM | None = None
        self._heard: list[Mapping[str, np.ndarray]] = []

    def open(self) -> None:
        self._lcm = lcm.LCM(self._url)
        self._lcm.subscribe("IIWA_COMMAND", self._hear)

    def _hear(self, _: str, data: bytes) -> None:
        self._heard.append(dict(zip(("position", "torque"), command(data), strict=True)))

    def close(self) -> None:
        self._lcm = None

    def send(self, values: Mapping[str, np.ndarray], stamp: float) -> None:
        message = status(round(1e6 * stamp))
        message.joint_position_measured = values["position"].tolist()
        message.joint_torque_external = values["torque"].tolist()
        self.send_bytes(message.encode())

    def send_bytes(self, data: bytes) -> None:
        assert self._lcm is not None
        self._lcm.publish("IIWA_STATUS", data)

    def receive(self, timeout: float) -> Sequence[Mapping[str, np.ndarray]]:
        assert self._lcm is not None
        self._heard.clear()
        while self._lcm.handle_timeout(round(1e3 * (0.0 if self._heard else timeout))) > 0:
            pass
        return list(self._heard)


def test_bridge_over_udp_passes() -> None:
    report = check_bridge(*udp())
    assert {result.status for result in report} == {"passed"}


@pytest.mark.slow
def test_bridge_over_lcm_passes() -> None:
    with Hub(port=0) as hub:
        report = check_bridge(lambda: arm_bridge(hub.url), lambda: LcmEnd(hub.url))
    assert {result.status for result in report} == {"passed"}


# -- bridges with a mistake each


class Taking(UdpBridge):
    """A bridge whose mistake is in how it takes a sample."""

    def _take(self, data: bytes) -> None:
        try:
            stamp, values = decode(self.interface.sense, data)
        except ValueError:
            self._inbox.reject("size")
        else:
            self.take(stamp, values)

    def take(self, stamp: float, values: dict[str, np.ndarray]) -> None:
        raise NotImplementedError


class InventsFirst(UdpBridge):
    def open(self) -> None:
        super().open()
        for signal in self.interface.sense:
            self.sensed[signal.name].accept(np.zeros(signal.size), time.monotonic(), 0.0)


class SwapsEntries(Taking):
    def take(self, stamp: float, values: dict[str, np.ndarray]) -> None:
        self._inbox.take({name: value[::-1] for name, value in values.items()}, sent=stamp, now=time.monotonic())


class TakesTimeOfDay(Taking):
    def take(self, stamp: float, values: dict[str, np.ndarray]) -> None:
        self._inbox.take(values, sent=stamp, now=time.time())


class CountsTwice(Taking):
    def take(self, stamp: float, values: dict[str, np.ndarray]) -> None:
        for received in self.sensed.values():
            received.count += 1
        self._inbox.take(values, sent=stamp, now=time.monotonic())


class DropsStamps(Taking):
    def take(self, stamp: float, values: dict[str, np.ndarray]) -> None:
        self._inbox.take(values, sent=nan, now=time.monotonic())


class StampsItself(Taking):
    def take(self, stamp: float, values: dict[str, np.ndarray]) -> None:
        self._inbox.take(values, sent=time.time(), now=time.monotonic())


class KeepsOldest(UdpBridge):
    """Reads what waits and keeps the first datagram."""

    def poll(self, timeout: float = 0.0) -> int:
        self.first = True
        return super().poll(timeout)

    def _take(self, data: bytes) -> None:
        if self.first:
            super()._take(data)
        self.first = False


class AnyOrder(MessageOrder):
    def _problem(self, sent: float, now: float, sender: str) -> str:
        return ""

    def note(self, sent: float, now: float, sender: str = "") -> None:
        pass


class NoDuplicates(AnyOrder):
    last = 0.0

    def _problem(self, sent: float, now: float, sender: str) -> str:
        return "duplicate" if sent == self.last else ""

    def note(self, sent: float, now: float, sender: str = "") -> None:
        self.last = sent


class TakesRepeated(UdpBridge):
    def open(self) -> None:
        super().open()
        self._inbox.order = AnyOrder()


class TakesOvertaken(UdpBridge):
    def open(self) -> None:
        super().open()
        self._inbox.order = NoDuplicates()


class NeverTakesNewClock(UdpBridge):
    def open(self) -> None:
        super().open()
        self._inbox.order = MachineOrder(inf)


class TakesNan(Taking):
    def take(self, stamp: float, values: dict[str, np.ndarray]) -> None:
        for name, value in values.items():
            self.sensed[name].accept(value, time.monotonic(), stamp)


class TakesBeyondLimits(Taking):
    def take(self, stamp: float, values: dict[str, np.ndarray]) -> None:
        if all(np.isfinite(value).all() for value in values.values()):
            for name, value in values.items():
                self.sensed[name].accept(value, time.monotonic(), stamp)


class DropsSilently(Taking):
    """Rejects what is beyond limits, and tells nobody."""

    def take(self, stamp: float, values: dict[str, np.ndarray]) -> None:
        rejected = {name: dict(received.rejected) for name, received in self.sensed.items()}
        self._inbox.take(values, sent=stamp, now=time.monotonic())
        for name, received in self.sensed.items():
            received.rejected = rejected[name]


class RaisesAtNoise(UdpBridge):
    def _take(self, data: bytes) -> None:
        stamp, values = decode(self.interface.sense, data)
        self._inbox.take(values, sent=stamp, now=time.monotonic())


class RenewsOld(UdpBridge):
    """Says at every poll that the last sample has arrived now."""

    def poll(self, timeout: float = 0.0) -> int:
        number = super().poll(timeout)
        for received in self.sensed.values():
            if received.value is not None:
                received.arrived = time.monotonic()
        return number


class ScalesCommands(UdpBridge):
    def publish(self, actuation: Mapping[str, Any]) -> Collection[str]:
        return super().publish({name: 0.9 * np.asarray(value) for name, value in actuation.items()})


class SaysUnsent(UdpBridge):
    def publish(self, actuation: Mapping[str, Any]) -> Collection[str]:
        super().publish(actuation)
        return tuple(actuation)


class SendsBad(UdpBridge):
    def publish(self, actuation: Mapping[str, Any]) -> Collection[str]:
        assert self._socket is not None
        if set(actuation) == {signal.name for signal in self.interface.act}:
            self._socket.sendto(encode(self.interface.act, actuation, time.time()), self._machine)
        return tuple(name for name, value in actuation.items() if self._bounds[name].violation(value))


class HidesWithheld(UdpBridge):
    def publish(self, actuation: Mapping[str, Any]) -> Collection[str]:
        super().publish(actuation)
        return ()


class RepeatsInPoll(UdpBridge):
    last: Mapping[str, Any] = {}

    def publish(self, actuation: Mapping[str, Any]) -> Collection[str]:
        self.last = actuation or self.last
        return super().publish(actuation)

    def poll(self, timeout: float = 0.0) -> int:
        if self.last:
            super().publish(self.last)
        return super().poll(timeout)


class RepeatsInThread(UdpBridge):
    """Sends the last command again every 10 ms."""

    def open(self) -> None:
        super().open()
        self.last: Mapping[str, Any] = {}
        self.ended = threading.Event()
        self.thread = threading.Thread(target=self.repeat)
        self.thread.start()

    def repeat(self) -> None:
        while not self.ended.wait(0.01):
            if self.last:
                super().publish(self.last)

    def publish(self, actuation: Mapping[str, Any]) -> Collection[str]:
        self.last = actuation or self.last
        return super().publish(actuation)

    def close(self) -> None:
        if self.connected:
            self.ended.set()
            self.thread.join()
        super().close()


class RaisesWithoutMachine(UdpBridge):
    def poll(self, timeout: float = 0.0) -> int:
        assert self._socket is not None
        self._socket.connect(self._machine)
        while select.select([self._socket], [], [], timeout)[0]:
            self._take(self._socket.recv(65536))
            timeout = 0.0
        return 0


class ForgetsObjects(UdpBridge):
    def open(self) -> None:
        super().open()
        self.sensed = {name: ReceivedSignal(count=old.count) for name, old in self.sensed.items()}
        self._inbox = Inbox(self.interface.sense, self.sensed)


class RemembersOld(UdpBridge):
    def open(self) -> None:
        super().open()
        for received in self.sensed.values():
            if received.value is not None:
                received.accept(received.value, time.monotonic(), received.sent)


class OpensOnce(UdpBridge):
    def close(self) -> None:
        super().close()
        self.open = lambda: None  # type: ignore[method-assign]


MISTAKES = [
    (InventsFirst, checks.check_opens_without_a_sample, "nothing was sent"),
    (SwapsEntries, checks.check_samples_arrive, "does not arrive"),
    (CountsTwice, checks.check_samples_arrive, "one sample of position was sent, and 2 are counted"),
    (TakesTimeOfDay, checks.check_samples_arrive, "take the time from time.monotonic"),
    (DropsStamps, checks.check_stamps_are_kept, "`sent` is nan s"),
    (StampsItself, checks.check_stamps_are_kept, "send the machine's time with each message"),
    (KeepsOldest, checks.check_newest_sample_counts, "the newest one"),
    (TakesRepeated, checks.check_repeated_samples_are_rejected, "counts as 2 new samples"),
    (TakesOvertaken, checks.check_reordered_samples_are_rejected, "counts as 1 new samples"),
    (TakesNan, checks.check_nan_is_rejected, "nan.* counts as 1 new"),
    (TakesBeyondLimits, checks.check_limits_of_samples, "counts as 1 new"),
    (DropsSilently, checks.check_limits_of_samples, "is not counted"),
    (RaisesAtNoise, checks.check_noise_is_no_message, "a datagram of 1 bytes"),
    (RenewsOld, checks.check_silence_makes_samples_old, "last sample of position counts as a new one"),
    (ScalesCommands, checks.check_commands_arrive, "no command arrives"),
    (SaysUnsent, checks.check_commands_arrive, "torque, grip did not leave"),
    (SendsBad, checks.check_bad_commands_are_withheld, "has arrived at the machine"),
    (HidesWithheld, checks.check_bad_commands_are_withheld, "does not say"),
    (RepeatsInPoll, checks.check_no_command_is_repeated, "nothing was published"),
    (RepeatsInThread, checks.check_no_command_is_repeated, "nothing was published"),
    (RaisesWithoutMachine, checks.check_machine_may_be_gone, "refused"),
    (NeverTakesNewClock, checks.check_machine_may_restart, "out of order"),
    (ForgetsObjects, checks.check_bridge_may_restart, "other objects"),
    (RemembersOld, checks.check_bridge_may_restart, "nothing was sent after"),
    (OpensOnce, checks.check_bridge_may_restart, "no sample arrives"),
    (RenewsOld, checks.check_silence_ends_in_the_fallback, "the DPS still commands|counts as a new one"),
]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("bridge_class", "check", "message"), MISTAKES, ids=[f"{m[0].__name__}-{m[1].__name__}" for m in MISTAKES]
)
def test_mistake_fails_its_check(
    bridge_class: type[UdpBridge], check: Callable[[BridgeSubject], None], message: str
) -> None:
    with pytest.raises((CheckFailedError, OSError, ValueError), match=message):
        check(BridgeSubject(*udp(bridge_class), patience=2.0))


def test_every_check_has_a_mistake() -> None:
    assert {check for _, check, _ in MISTAKES} == set(checks.BRIDGE_CHECKS)


class Hangs(UdpBridge):
    released = threading.Event()

    def poll(self, timeout: float = 0.0) -> int:
        self.released.wait()
        return 0


@pytest.mark.slow
def test_report_names_what_failed_and_what_hangs() -> None:
    reason = "the firmware has no clock"
    report = check_bridge(
        *udp(DropsStamps),
        patience=2.0,
        expected_failed_checks={
            "check_stamps_are_kept": reason,
            "check_repeated_samples_are_rejected": reason,
            "check_reordered_samples_are_rejected": reason,
        },
    )
    assert [result.status for result in report].count("xfail") == 3
    with pytest.raises(BridgeCheckError, match="does not return") as error:
        check_bridge(*udp(Hangs), patience=0.005)
    Hangs.released.set()
    assert {result.status for result in error.value.report} == {"failed"}
    with pytest.raises(ValueError, match="no check 'check_stamps'; did you mean"):
        check_bridge(*udp(), expected_failed_checks={"check_stamps": reason})
