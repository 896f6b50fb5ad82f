"""Checks of a bridge to a machine over any transport: how they are run, and what they report."""

from __future__ import annotations

import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np

from vtbdrake.common.argument_checks import suggestion
from vtbdrake.common.failures import FAILURES, error_text
from vtbdrake.control.bridge import Bridge
from vtbdrake.testbed import Signal
from vtbdrake.testing.scenario_check import CheckResult, Report
from vtbdrake.testing.subject import CheckFailedError, CheckSkippedError

# Pytest shows none of the frames of this module: what a check has found is its message.
__tracebackhide__ = True

_HUNG = 20.0
"""Multiple of the patience after which a check counts as hung: no check waits so often."""

_CLOSE = 1e-5
"""Relative difference of values that a transport may cause, which sends them as floats of 32 bits, say."""

MICROSECOND = 1e-6
"""Resolution of the machine's time stamps, in seconds."""


class BridgeCheckError(AssertionError):
    """Checks of a bridge failed that were not expected to, or passed that were expected to fail.

    Attributes:
        report: The results of all checks.
    """

    def __init__(self, report: Report) -> None:
        super().__init__(str(report))
        self.report = report


class MachineEnd(ABC):
    """The machine's end of a transport, which a test holds in its hand: what a driver or a firmware does there.

    It sends and receives real messages by real sockets, ports or files. For a machine that is restarted, it is closed
    and opened again.
    """

    @abstractmethod
    def open(self) -> None:
        """Open the end of the transport, as a machine does that is switched on."""

    @abstractmethod
    def close(self) -> None:
        """Close the end of the transport, as a machine does that is switched off; a second call does nothing."""

    @abstractmethod
    def send(self, values: Mapping[str, np.ndarray], stamp: float) -> None:
        """Send the messages of a cycle.

        Args:
            values: The values of all sensor signals, arrays of shape (size,), whatever they are: NaN, too.
            stamp: The machine's time in seconds, for the time stamp of each message.
        """

    @abstractmethod
    def receive(self, timeout: float) -> Sequence[Mapping[str, np.ndarray]]:
        """Return the commands that have arrived since the last call, one mapping by actuator signal for each message.

        Args:
            timeout: The longest time to wait for the first message, in seconds.
        """

    def send_bytes(self, data: bytes) -> None:
        """Send bytes that are no message, as line noise or another program does; checks without it are skipped.

        Args:
            data: The bytes.
        """
        raise CheckSkippedError("its MachineEnd has no send_bytes")


class BridgeSubject:
    """A bridge under test and the machine's end of its transport, new ones for every check.

    Args:
        make_bridge: Returns a bridge that is not yet open.
        make_end: Returns a machine's end that is not yet open.
        patience: The longest time to wait for a message, in seconds.
    """

    def __init__(
        self, make_bridge: Callable[[], Bridge], make_end: Callable[[], MachineEnd], *, patience: float = 5.0
    ) -> None:
        self.make_bridge = make_bridge
        self.make_end = make_end
        self.patience = patience

    @contextmanager
    def connected(self) -> Iterator[BridgeLink]:
        """Yield an open bridge and an open end, between which samples and commands have arrived.

        Raises:
            CheckFailedError: Nothing arrives.
        """
        with self.opened() as link:
            link.meet()
            yield link

    @contextmanager
    def opened(self) -> Iterator[BridgeLink]:
        """Yield an open bridge and an open end, over which nothing was sent yet."""
        end, bridge = self.make_end(), self.make_bridge()
        end.open()
        try:
            bridge.open()
            yield BridgeLink(bridge, end, self.patience)
        finally:
            bridge.close()
            end.close()


class BridgeLink:
    """A bridge and the machine's end, both open, and what is sent over them.

    Args:
        bridge: The bridge.
        end: The machine's end.
        patience: The longest time to wait for a message, in seconds.

    Attributes:
        bridge: The bridge.
        end: The machine's end.
        sense: The sensor signals that are vectors.
        act: The actuator signals that are vectors.
    """

    def __init__(self, bridge: Bridge, end: MachineEnd, patience: float) -> None:
        self.bridge = bridge
        self.end = end
        self.sense = [signal for signal in bridge.interface.sense if signal.is_vector]
        self.act = [signal for signal in bridge.interface.act if signal.is_vector]
        self._patience = patience
        self._random = np.random.default_rng(0)
        self._stamp = 0.0
        self.restart_clock(1000.0)

    def restart_clock(self, stamp: float) -> None:
        """Let the machine's clock go on from a time, in seconds."""
        self._offset = stamp - time.monotonic()
        self._stamp = stamp

    def stamp(self) -> float:
        """Return the next time stamp of the machine, in whole microseconds, later than all before."""
        self._stamp = max(self._stamp + MICROSECOND, self._offset + time.monotonic())
        return round(self._stamp / MICROSECOND) * MICROSECOND

    def sample(self, signals: Sequence[Signal] | None = None) -> dict[str, np.ndarray]:
        """Return values by signal, each within its limits and unlike the last ones; by default of the sensor signals.

        Args:
            signals: Vector signals.
        """
        return {signal.name: self._value(signal) for signal in (self.sense if signals is None else signals)}

    def _value(self, signal: Signal) -> np.ndarray:
        if signal.values is not None:
            return self._random.choice(np.asarray(list(signal.values), dtype=float), signal.size)
        lower, upper = limits(signal)
        return self._random.uniform(lower + 0.05 * (upper - lower), upper - 0.05 * (upper - lower))

    def send(self, values: Mapping[str, np.ndarray] | None = None, stamp: float | None = None) -> dict[str, np.ndarray]:
        """Send a sample from the machine's end, and return it.

        Args:
            values: The values by sensor signal; by default new ones.
            stamp: The machine's time in seconds; by default the present time of its clock.
        """
        values = self.sample() if values is None else dict(values)
        self.end.send(values, self.stamp() if stamp is None else stamp)
        return values

    def poll_until(self, condition: Callable[[], bool]) -> bool:
        """Poll the bridge until the condition holds, and return whether it does."""
        limit = time.monotonic() + self._patience
        while not condition() and time.monotonic() < limit:
            self.bridge.poll(0.02)
        return condition()

    def has(self, values: Mapping[str, np.ndarray]) -> bool:
        """Return whether the newest values of the bridge are these, as exactly as a transport sends them."""
        return all(
            (newest := self.bridge.sensed[signal.name].value) is not None and close(signal, newest, values[signal.name])
            for signal in self.sense
        )

    def exchange(self, reason: str = "a sample that the machine sends does not arrive") -> dict[str, np.ndarray]:
        """Send a new sample, poll until it has arrived, and return it.

        Args:
            reason: What it means that the sample does not arrive.

        Raises:
            CheckFailedError: It does not arrive.
        """
        values = self.send()
        if not self.poll_until(lambda: self.has(values)):
            raise CheckFailedError(f"{reason}: sent {values}, and the bridge has {self.newest}")
        return values

    def meet(self) -> None:
        """Send samples until one arrives, and commands until one arrives: a new connection may lose the first ones.

        Raises:
            CheckFailedError: Nothing arrives.
        """
        limit, counts = time.monotonic() + self._patience, self.counts
        while any(counts[name] == count for name, count in self.counts.items()):
            if time.monotonic() > limit:
                rejected = {signal.name: self.bridge.sensed[signal.name].rejected for signal in self.sense}
                raise CheckFailedError(f"no sample arrives that the machine sends; rejected are {rejected}")
            self.send()
            self.bridge.poll(0.02)
        self.exchange()
        limit, last = time.monotonic() + self._patience, self.sample(self.act)
        while self.act and not any(self.are_commands(command, last) for command in self.end.receive(0.02)):
            if time.monotonic() > limit:
                raise CheckFailedError("no command arrives at the machine's end")
            last = self.sample(self.act)
            self.bridge.publish(last)

    def are_commands(self, command: Mapping[str, Any], values: Mapping[str, np.ndarray]) -> bool:
        """Return whether a command that has arrived holds values, as exactly as a transport sends them.

        Args:
            command: What has arrived, by actuator signal.
            values: What was sent, by actuator signal.
        """
        return all(
            signal.name in command and close(signal, command[signal.name], values[signal.name])
            for signal in self.act
            if signal.name in values
        )

    @property
    def newest(self) -> dict[str, Any]:
        """Return the newest values of the bridge, by sensor signal."""
        return {signal.name: self.bridge.sensed[signal.name].value for signal in self.sense}

    @property
    def counts(self) -> dict[str, int]:
        """Return the numbers of accepted values, by sensor signal."""
        return {signal.name: self.bridge.sensed[signal.name].count for signal in self.sense}

    def commands_until(self, count: int) -> list[Mapping[str, np.ndarray]]:
        """Return the commands that arrive at the machine's end, until there are as many as ``count``."""
        limit = time.monotonic() + self._patience
        commands: list[Mapping[str, np.ndarray]] = []
        while len(commands) < count and time.monotonic() < limit:
            commands += self.end.receive(0.02)
        return commands


def limits(signal: Signal) -> tuple[np.ndarray, np.ndarray]:
    """Return limits of a vector signal, (size,) each: where it has none, at a distance of 1 to 2."""
    lower, upper = signal.vector(signal.lower), signal.vector(signal.upper)
    low = np.where(np.isfinite(lower), lower, np.where(np.isfinite(upper), upper - 2.0, -1.0))
    return low, np.where(np.isfinite(upper), upper, low + 2.0)


def close(signal: Signal, a: Any, b: Any) -> bool:
    """Return whether two values of a signal are the same, as exactly as a transport sends them.

    Args:
        signal: The signal, whose limits tell the size of its values.
        a: A value.
        b: Another value.
    """
    lower, upper = limits(signal)
    return np.shape(a) == np.shape(b) and bool(
        np.allclose(a, b, rtol=_CLOSE, atol=_CLOSE * float(np.max(upper - lower, initial=0.0)))
    )


def check_bridge(
    make_bridge: Callable[[], Bridge],
    make_end: Callable[[], MachineEnd],
    *,
    expected_failed_checks: Mapping[str, str] | None = None,
    patience: float = 5.0,
) -> Report:
    """Put a bridge to a machine through all checks of bridges, and return their results.

    Every check opens a new bridge and a new end of the machine, in one process: messages go through the real transport
    between the two. Nothing is waited for longer than needed; a check that fails may take ``patience``.

    Args:
        make_bridge: Returns a bridge that is not yet open.
        make_end: Returns the machine's end of its transport, not yet open.
        expected_failed_checks: Name of a check -> the reason why it fails.
        patience: The longest time to wait for a message, in seconds.

    Raises:
        BridgeCheckError: A check failed that was not expected to, or passed although it was expected to fail.
        ValueError: There is no check of an expected name.
    """
    from vtbdrake.testing.checks.bridge_checks import BRIDGE_CHECKS

    expected, names = dict(expected_failed_checks or {}), [check.__name__ for check in BRIDGE_CHECKS]
    for name in expected:
        if name not in names:
            raise ValueError(f"there is no check {name!r}{suggestion(name, names)}")
    subject = BridgeSubject(make_bridge, make_end, patience=patience)
    report = Report(_result(check, subject, expected) for check in BRIDGE_CHECKS)
    if not report.ok:
        raise BridgeCheckError(report)
    return report


def _result(check: Callable[[BridgeSubject], None], subject: BridgeSubject, expected: Mapping[str, str]) -> CheckResult:
    name, begin = check.__name__, time.process_time()
    status, message = _outcome(check, subject)
    seconds = time.process_time() - begin
    if status != "skipped" and name in expected:
        status = "xpass" if status == "passed" else "xfail"
    return CheckResult(name, status, message, expected.get(name, ""), seconds)


def _outcome(check: Callable[[BridgeSubject], None], subject: BridgeSubject) -> tuple[str, str]:
    """Return the status of a check and its message; a bridge that hangs is left behind in its thread."""
    outcomes: list[tuple[str, str]] = []

    def run() -> None:
        try:
            check(subject)
            outcomes.append(("passed", ""))
        except CheckSkippedError as error:
            outcomes.append(("skipped", str(error)))
        except CheckFailedError as error:
            outcomes.append(("failed", str(error)))
        except FAILURES as error:
            outcomes.append(("failed", f"an error of the bridge or of the machine's end: {error_text(error)}"))

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    thread.join(_HUNG * subject.patience)
    return (
        outcomes[0] if outcomes else ("failed", "a call of the bridge does not return: none may wait longer than asked")
    )
