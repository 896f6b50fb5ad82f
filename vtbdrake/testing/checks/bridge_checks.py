"""Checks of a bridge: what must hold between a robot's loop and its machine, over whatever transport."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
from math import inf, nan

import numpy as np
from pydrake.systems.framework import DiagramBuilder, System
from pydrake.systems.primitives import ConstantVectorSource, PassThrough

from vtbdrake.control.fallback import Silence
from vtbdrake.control.fault import FaultKind
from vtbdrake.control.guards import Guards
from vtbdrake.control.runtime import Runtime
from vtbdrake.control.switching import SwitchRefusedError
from vtbdrake.testbed import DpsAlone, Interface, Scenario, Signal, VirtualTestbedBuilder
from vtbdrake.testing.bridge_check import BridgeLink, BridgeSubject, limits
from vtbdrake.testing.subject import CheckFailedError, CheckSkippedError

__tracebackhide__ = True

_STAMP_ERROR = 2e-6
"""Largest error of a time stamp that arrives, in seconds: two units of a count of microseconds."""

_LISTEN = 0.2
"""Time for which the machine listens for commands that nobody has given, in seconds."""

_MAX_AGE = 0.5
"""Largest age of samples in the loop that a check runs, in seconds: longer than a busy computer holds it up."""

_PERIOD = 0.01
"""Period of the loop that a check runs, in seconds."""

_ATTEMPTS = 5
"""Number of attempts to run that loop, which a very busy computer may hold up for longer than `_MAX_AGE`."""

_NO_MESSAGES = (b"\x00", b"\xff" * 7, bytes(range(256)) * 4)
"""Bytes that are no message."""


# -- samples


def check_opens_without_a_sample(subject: BridgeSubject) -> None:
    """Check that a bridge opens, is connected, and has no sample before the machine sends one.

    The guards take the first sample for the machine's state, so none may be invented.
    """
    with subject.opened() as link:
        count = link.bridge.poll()
        if not link.bridge.connected:
            raise CheckFailedError("the bridge is open, and `connected` is False")
        if count or any(link.counts.values()) or any(value is not None for value in link.newest.values()):
            raise CheckFailedError(
                f"nothing was sent, but poll returns {count}, and the newest values are {link.newest}"
            )


def check_samples_arrive(subject: BridgeSubject) -> None:
    """Check that every sample arrives with its values in order, is counted once, and has its time of arrival.

    The age of a sample, by which the guards notice silence, is computed with its ``arrived``.
    """
    with subject.connected() as link:
        for _ in range(3):
            counts, begin = link.counts, time.monotonic()
            link.exchange()
            end = time.monotonic()
            for name, count in link.counts.items():
                arrived = link.bridge.sensed[name].arrived
                if count != counts[name] + 1:
                    raise CheckFailedError(f"one sample of {name} was sent, and {count - counts[name]} are counted")
                if not begin <= arrived <= end:
                    raise CheckFailedError(
                        f"{name} has arrived at {arrived:.6f} s, it says, and not from {begin:.6f} to {end:.6f} s: "
                        "take the time from time.monotonic()"
                    )


def check_stamps_are_kept(subject: BridgeSubject) -> None:
    """Check that ``sent`` is the machine's own time of a sample.

    Without it nobody can tell a late sample, or one that is repeated, from a new one.
    """
    with subject.connected() as link:
        stamp = link.stamp()
        values = link.send(stamp=stamp)
        link.poll_until(lambda: link.has(values))
        for signal in link.sense:
            sent = link.bridge.sensed[signal.name].sent
            if not abs(sent - stamp) <= _STAMP_ERROR:
                raise CheckFailedError(
                    f"the machine's time of {signal.name} was {stamp:.6f} s, and `sent` is {sent:.6f} s: send the "
                    "machine's time with each message, and pass it on"
                )


def check_newest_sample_counts(subject: BridgeSubject) -> None:
    """Check that after a burst of samples, between which others were lost, the newest one is there.

    A loop that was held up must not go on with the oldest message that waits.
    """
    with subject.connected() as link:
        for _ in range(5):
            values = link.send()
            link.stamp()  # The stamp of one that is lost.
        if not link.poll_until(lambda: link.has(values)):
            raise CheckFailedError(f"after a burst of samples the newest one, {values}, is not there: {link.newest}")


def check_repeated_samples_are_rejected(subject: BridgeSubject) -> None:
    """Check that a sample that is sent again is no new sample.

    A driver that hangs repeats its last message. If that counted, the loop would take a frozen machine for a live one.
    """
    with subject.connected() as link:
        stamp = link.stamp()
        values = link.send(stamp=stamp)
        if not link.poll_until(lambda: link.has(values)):
            raise CheckFailedError(f"a sample does not arrive: {values}")
        _expect_rejected(
            link, "a sample that is sent three times", lambda: [link.send(values, stamp) for _ in range(2)]
        )


def check_reordered_samples_are_rejected(subject: BridgeSubject) -> None:
    """Check that a sample that arrives after a later one does not replace it.

    Networks let messages overtake each other, and queues hold old ones.
    """
    with subject.connected() as link:
        early = link.stamp()
        link.exchange()
        _expect_rejected(link, "a sample that a later one has overtaken", lambda: link.send(stamp=early))


def check_nan_is_rejected(subject: BridgeSubject) -> None:
    """Check that NaN and infinity, in any signal, are counted as rejected and do not reach the DPS."""
    with subject.connected() as link:
        for signal in link.sense:
            for number in (nan, inf):
                bad = link.sample()
                bad[signal.name][-1] = number
                _expect_rejected(link, f"{signal.name} = {bad[signal.name]}", lambda: link.send(bad), signal.name)  # noqa: B023 - called at once


def check_limits_of_samples(subject: BridgeSubject) -> None:
    """Check that values beyond the limits of their signal are counted as rejected and do not reach the DPS."""
    with subject.connected() as link:
        bounded = _bounded(link.sense)
        for signal in bounded:
            bad = link.sample() | {signal.name: _beyond(signal)}
            _expect_rejected(link, f"{signal.name} = {bad[signal.name]}", lambda: link.send(bad), signal.name)  # noqa: B023 - called at once
        if not bounded:
            raise CheckSkippedError("no sensor signal has limits")


def check_noise_is_no_message(subject: BridgeSubject) -> None:
    """Check that bytes that are no message change and raise nothing, and that good messages arrive afterwards."""
    with subject.connected() as link:
        for data in _NO_MESSAGES:
            counts = link.counts
            link.end.send_bytes(data)
            link.exchange(f"after the bytes {data[:8]!r} no good message arrives any more")
            _expect_one_more(link, counts, f"the bytes {data[:8]!r}", link.counts)


def check_silence_makes_samples_old(subject: BridgeSubject) -> None:
    """Check that a sample becomes older while the machine is silent, however often the bridge is polled."""
    with subject.connected() as link:
        _expect_old(link)


# -- commands


def check_commands_arrive(subject: BridgeSubject) -> None:
    """Check that commands arrive at the machine in order, with their values, and that ``publish`` says so."""
    with _commanding(subject) as link:
        for _ in range(3):
            values = link.sample(link.act)
            unsent = link.bridge.publish(values)
            commands = link.commands_until(1)
            if unsent or len(commands) != 1 or not link.are_commands(commands[0], values):
                raise CheckFailedError(
                    f"published {values}; the machine received {commands or 'nothing'}, and publish says that "
                    f"{', '.join(unsent) or 'none'} did not leave"
                )


def check_bad_commands_are_withheld(subject: BridgeSubject) -> None:
    """Check that a command that is NaN, or beyond its limits, is never sent, and that ``publish`` says so.

    The guards limit commands before; the bridge is the last one who can.
    """
    with _commanding(subject) as link:
        for signal in link.act:
            bad = [signal.vector(nan)] + [_beyond(each) for each in _bounded([signal])]
            for value in bad:
                if signal.name not in link.bridge.publish(link.sample(link.act) | {signal.name: value}):
                    raise CheckFailedError(f"publish does not say that {signal.name} = {value} did not leave")
        good = link.sample(link.act)
        link.bridge.publish(good)
        if not all(link.are_commands(command, good) for command in link.commands_until(1)):
            raise CheckFailedError("a command that is NaN, or beyond its limits, has arrived at the machine")


def check_no_command_is_repeated(subject: BridgeSubject) -> None:
    """Check that nothing is sent while nothing is published.

    A machine that gets no command for a while brakes. A bridge, or a thread in it, that repeats the last command keeps
    a machine going whose DPS has died.
    """
    with _commanding(subject) as link:
        link.bridge.publish(link.sample(link.act))
        link.commands_until(1)
        link.exchange()
        link.bridge.publish({})
        limit = time.monotonic() + _LISTEN
        while (left := limit - time.monotonic()) > 0.0:
            link.bridge.poll()
            if commands := link.end.receive(min(left, 0.02)):
                raise CheckFailedError(f"nothing was published, and the machine received {commands[0]}")


# -- outages


def check_machine_may_be_gone(subject: BridgeSubject) -> None:
    """Check that neither ``poll`` nor ``publish`` raises while the machine is switched off."""
    with subject.connected() as link:
        link.end.close()
        for _ in range(20):
            link.bridge.poll(0.001)
            link.bridge.publish(link.sample(link.act))


def check_machine_may_restart(subject: BridgeSubject) -> None:
    """Check that samples and commands arrive again after the machine was restarted, whose clock begins anew."""
    with subject.connected() as link:
        link.end.close()
        link.bridge.poll()
        link.bridge.publish(link.sample(link.act))
        link.end.open()
        link.restart_clock(1.0)
        link.meet()


def check_bridge_may_restart(subject: BridgeSubject) -> None:
    """Check that a bridge can be closed and opened again, and that the old sample does not count as a new one then."""
    with subject.connected() as link:
        counts, sensed = link.counts, dict(link.bridge.sensed)
        link.bridge.close()
        link.bridge.open()
        link.bridge.poll()
        if link.counts != counts:
            raise CheckFailedError(f"nothing was sent after the bridge was opened again: {counts} became {link.counts}")
        if any(link.bridge.sensed[name] is not received for name, received in sensed.items()):
            raise CheckFailedError(
                "the bridge has other objects in `sensed` after it was opened again: the loop keeps them"
            )
        link.meet()


def check_silence_ends_in_the_fallback(subject: BridgeSubject) -> None:
    """Check that a loop with this bridge stops commanding after the machine has fallen silent.

    The loop is the real one; its DPS commands constants, and its fallback is silence.
    """
    with _commanding(subject) as link:
        interface = link.bridge.interface
        if link.bridge.reported or link.bridge.robot_mode is not None:
            raise CheckSkippedError("its machine reports what acts, or its mode: use check_scenario")
        if not all(signal.is_vector for signal in (*interface.sense, *interface.act)):
            raise CheckSkippedError("it carries signals that are no vectors")
        scenario = _ConstantScenario(
            signals=Interface(
                sense=[replace(signal, max_age=_MAX_AGE, rate=inf, acceleration=inf) for signal in interface.sense],
                act=[replace(signal, rate=inf, acceleration=inf) for signal in interface.act],
            ),
            commands=link.sample(link.act),
        )
        log = logging.getLogger("vtbdrake.control")
        level = log.level
        log.setLevel(logging.CRITICAL)  # The alarms are provoked.
        try:
            if not any(_falls_back(link, scenario) for _ in range(_ATTEMPTS)):
                raise CheckFailedError("the loop cannot take over: this computer is too busy, or no sample stays fresh")
        finally:
            log.setLevel(level)


BRIDGE_CHECKS: tuple[Callable[[BridgeSubject], None], ...] = (
    check_opens_without_a_sample,
    check_samples_arrive,
    check_stamps_are_kept,
    check_newest_sample_counts,
    check_repeated_samples_are_rejected,
    check_reordered_samples_are_rejected,
    check_nan_is_rejected,
    check_limits_of_samples,
    check_noise_is_no_message,
    check_silence_makes_samples_old,
    check_commands_arrive,
    check_bad_commands_are_withheld,
    check_no_command_is_repeated,
    check_machine_may_be_gone,
    check_machine_may_restart,
    check_bridge_may_restart,
    check_silence_ends_in_the_fallback,
)
"""All checks of bridges, in the order in which they run."""


def _bounded(signals: list[Signal]) -> list[Signal]:
    """Return the signals in which every entry has an upper limit."""
    return [signal for signal in signals if np.isfinite(signal.vector(signal.upper)).all()]


def _beyond(signal: Signal) -> np.ndarray:
    """Return a value beyond the upper limits of a signal."""
    lower, upper = limits(signal)
    return np.asarray(upper + (upper - lower) + 1.0)


def _expect_rejected(link: BridgeLink, event: str, send: Callable[[], object], *names: str) -> None:
    """Send what must be rejected and then a good sample; raise a CheckFailedError if only the good one is not counted.

    Args:
        link: The bridge and the machine's end.
        event: What is sent, in words.
        send: Sends it.
        names: The signals in which it must be rejected; by default all.
    """
    counts, rejected = link.counts, _rejected(link)
    send()
    link.exchange(f"after {event} a good sample does not arrive")
    _expect_one_more(link, counts, event, names or counts.keys())
    for name in names or counts.keys():
        if _rejected(link)[name] == rejected[name]:
            raise CheckFailedError(f"{event} was sent, and is not counted: call reject() of bridge.sensed[{name!r}]")


def _expect_old(link: BridgeLink) -> None:
    """Poll while the machine is silent; raise a CheckFailedError if its last sample counts as a new one."""
    counts, arrived = link.counts, {signal.name: link.bridge.sensed[signal.name].arrived for signal in link.sense}
    for _ in range(20):
        link.bridge.poll()
        link.bridge.poll(0.001)
    for name, count in link.counts.items():
        if count != counts[name] or link.bridge.sensed[name].arrived != arrived[name]:
            raise CheckFailedError(f"the machine is silent, and its last sample of {name} counts as a new one")


def _rejected(link: BridgeLink) -> dict[str, int]:
    return {signal.name: sum(link.bridge.sensed[signal.name].rejected.values()) for signal in link.sense}


def _expect_one_more(link: BridgeLink, counts: Mapping[str, int], event: str, names: Iterable[str]) -> None:
    for name in names:
        if link.counts[name] != counts[name] + 1:
            raise CheckFailedError(
                f"{event} counts as {link.counts[name] - counts[name] - 1} new samples of {name}, and none is allowed"
            )


@contextmanager
def _commanding(subject: BridgeSubject) -> Iterator[BridgeLink]:
    """Yield a connected bridge that carries commands; raise a CheckSkippedError if it carries none."""
    with subject.connected() as link:
        if not link.act:
            raise CheckSkippedError("it carries no actuator signal")
        yield link


class _ConstantScenario(Scenario):
    """A DPS that commands constants, whatever it senses; there is no world."""

    def __init__(self, signals: Interface, commands: Mapping[str, np.ndarray]) -> None:
        super().__init__()
        self.signals = signals
        self.commands = commands

    def interface(self) -> Interface:
        return self.signals

    def add_world(self, builder: VirtualTestbedBuilder) -> None:
        raise NotImplementedError("this scenario has no world")

    def make_dps(self) -> System:
        builder = DiagramBuilder()
        for signal in self.signals.sense:
            unused = builder.AddNamedSystem(f"sense.{signal.name}", PassThrough(signal.size))
            builder.ExportInput(unused.get_input_port(), signal.name)
        for name, value in self.commands.items():
            source = builder.AddNamedSystem(f"act.{name}", ConstantVectorSource(value))
            builder.ExportOutput(source.get_output_port(), name)
        return builder.Build()


def _falls_back(link: BridgeLink, scenario: Scenario) -> bool:
    """Return whether a loop stops commanding when the machine falls silent; False if the computer was too busy to tell.

    Raises:
        CheckFailedError: It goes on.
    """
    dps = DpsAlone(scenario)
    guards = Guards(dps.interface, _PERIOD, fallback={signal.name: Silence() for signal in dps.interface.act})
    with Runtime(dps, link.bridge, period=_PERIOD, guards=guards) as runtime:
        link.exchange()
        with suppress(SwitchRefusedError):
            runtime.take_over(timeout=0.0)
        for _ in range(10):
            link.send()
            runtime.cycle()
        if runtime.idle or guards.latched:
            return False
        limit = time.monotonic() + 3.0 * _MAX_AGE
        while not guards.latched:
            waited = time.monotonic() > limit
            runtime.cycle()
            if waited and not guards.latched:
                raise CheckFailedError(f"the machine is silent, and the DPS still commands {3.0 * _MAX_AGE:g} s later")
        _expect_old(link)
        while link.end.receive(0.02) and time.monotonic() < limit + _MAX_AGE:
            pass  # What was sent before.
        for _ in range(10):
            runtime.cycle()
        if link.end.receive(0.02):
            raise CheckFailedError("the loop sends nothing after a fault, and the machine still receives commands")
        return any(fault.kind == FaultKind.STALE for fault in guards.latched)
