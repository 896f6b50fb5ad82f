"""Checks of the loop: the DPS commands the simulated machine over its messages, and what happens if they go wrong."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from math import ceil, isfinite

from vtbdrake.control.fallback import chain, default_fallback
from vtbdrake.control.fault import FaultKind
from vtbdrake.control.switching import SwitchRefusedError
from vtbdrake.deployment import Deployment
from vtbdrake.machine.injected_faults import Corrupt, Delay, Drop, Freeze, InjectedFault
from vtbdrake.testbed import Scenario
from vtbdrake.testbed.slow_part import slow_parts
from vtbdrake.testing.checks.repetition_checks import check_simulates
from vtbdrake.testing.lock_step import LockStep
from vtbdrake.testing.subject import CheckFailedError, CheckSkippedError, Subject

# Pytest shows none of the frames of this module: what a check has found is its message.
__tracebackhide__ = True

_FIRST = 20  # cycles in which a loop must command its machine without a fault
_BEFORE = 5  # cycles before a fault
_AFTER = 10  # cycles after it was noticed, in which the fallback must command
_LONGEST = 2000  # cycles after it
_ALLOWED = 3.0  # maximum ages within which a fault must be noticed
_TAKE_OVER = 2.0  # s of the loop's time


def check_deployment_is_safe(subject: Subject) -> None:
    """Check that the deployment fits the signals, and lets nothing jump or go unnoticed.

    `Deployment` says how the DPS runs on its machine: the messages, where commands start from, what takes over after a
    fault. The error says what is missing.
    """
    subject.presuppose_testbed()
    if _deploys_by_default(subject.scenario):
        raise CheckSkippedError("the scenario does not say how it is deployed")
    try:
        Deployment.of(subject.scenario)
    except ValueError as error:
        raise CheckFailedError(str(error)) from error


def check_loop_commands_its_machine(subject: Subject) -> None:
    """Check that the DPS takes over its simulated machine, and commands it without a fault.

    That is the first minute on the machine. A switch that is refused says why: the first command is far from what is
    measured, or a sensor is missing. A fault in the first cycles is one of the DPS, of a limit or of a period.
    """
    _refuse_unsafe(subject)
    subject.presuppose(check_deployment_is_safe)
    with _loop(subject) as loop:
        loop.runtime.run(cycles=_FIRST)
        if faults := loop.runtime.guards.latched:
            raise CheckFailedError(
                f"within {_FIRST} cycles the fallbacks command: {'; '.join(fault.reason for fault in faults)}"
            )


def check_silence_ends_in_the_fallback(subject: Subject) -> None:
    """Check that the fallback commands soon after any channel of sensor signals has fallen silent.

    A DPS that goes on with an old measurement drives the robot blindly. Give every signal that arrives regularly a
    ``max_age``, of a few of its periods.
    """
    for channel, loop in _faulty(subject, Drop()):
        _expect_fallback(loop, f"nothing arrives on {channel} any more")


def check_nan_ends_in_the_fallback(subject: Subject) -> None:
    """Check that the fallback commands after NaN has arrived in any message.

    A sensor or its driver that has lost its value says NaN. Messages of the protocol must not turn it into a number,
    and a fallback must not compute with it.
    """
    subject.presuppose(check_silence_ends_in_the_fallback)
    for channel, loop in _faulty(subject, Corrupt(kind="nan")):
        if not _holds_floats(loop, channel):
            continue
        _expect_fallback(loop, f"the numbers on {channel} are NaN")


def check_repeated_samples_end_in_the_fallback(subject: Subject) -> None:
    """Check that the fallback commands after a message is sent again and again.

    A driver that hangs repeats its last message. It is told from a new one by its time stamp: name the field in the map
    of the channel (``stamp=``).
    """
    subject.presuppose(check_silence_ends_in_the_fallback)
    for channel, loop in _faulty(subject, Freeze()):
        _expect_fallback(loop, f"one message is repeated on {channel}")


def check_late_samples_end_in_the_fallback(subject: Subject) -> None:
    """Check that the fallback commands after messages take longer and longer.

    Messages that queue up somewhere arrive regularly, and are old: their age when they arrive tells nothing. Give the
    guards a ``max_delay`` per signal, if the sender's clock runs as ours does.
    """
    subject.presuppose(check_silence_ends_in_the_fallback, check_repeated_samples_end_in_the_fallback)
    for channel, loop in _faulty(subject, None):
        period, machine = loop.runtime.period, loop.machine
        ages = [s.max_age for s in machine.world.interface.sense if loop.bridge.channels.get(s.name) == channel]
        if not ages:
            continue  # The channel reports the mode, or what acts, which is compared with what was sent as long ago.
        # A queue that grows by one message in two.
        cycles = max(1, round(machine.protocol.periods.get(channel, machine.period) / period))
        longest = max(10.0 * cycles * period, _ALLOWED * max((age for age in ages if isfinite(age)), default=0.0))
        for delay in range(cycles, ceil(longest / period) + cycles, cycles):
            machine.begin(Delay(seconds=delay * period, channels=(channel,)))
            loop.runtime.run(cycles=2 * cycles)
            if loop.runtime.guards.latched:
                break
        else:
            raise CheckFailedError(
                f"messages on {channel} arrive {longest:g} s late, and the DPS still commands: give the guards "
                f"max_delay={{signal: seconds}}"
            )
        _expect_fallback(loop, f"messages on {channel} arrive later and later")


def _deploys_by_default(scenario: Scenario) -> bool:
    return type(scenario).deployment is Scenario.deployment


def _refuse_unsafe(subject: Subject) -> None:
    """Raise a CheckSkippedError if the DPS commands no machine, or cannot be deployed."""
    testbed = subject.testbed
    subject.presuppose(check_simulates)
    if not testbed.interface.act:
        raise CheckSkippedError("the DPS commands nothing")
    if subject.scenario.deployment().protocol is None:
        raise CheckSkippedError("the scenario has no protocol, so no machine")
    if any(not signal.is_vector for signal in testbed.interface.sense):
        raise CheckSkippedError("images and scans are rendered for every cycle: test them beside a MachineProcess")
    if slow_parts(testbed.diagram):
        raise CheckSkippedError("slow parts compute in other processes, beside a clock that runs: use a MachineProcess")


@contextmanager
def _loop(subject: Subject) -> Iterator[LockStep]:
    """Yield a loop that has taken over its machine, in new contexts of the subject's DPS and world."""
    target = subject.dps_alone
    values = {address: value for address, value in subject.values.items() if address in target.variables()}
    with LockStep(subject.scenario, target=target, values=values, world=subject.world_alone) as loop, _quiet():
        try:
            loop.runtime.take_over(timeout=_TAKE_OVER)
        except SwitchRefusedError as error:
            raise CheckFailedError(f"the switch to real is refused: {error}") from error
        yield loop


def _faulty(subject: Subject, fault: InjectedFault | None) -> Iterator[tuple[str, LockStep]]:
    """Yield, for every channel of sensor signals, a loop that commands its machine, and on which a fault has begun."""
    subject.presuppose(check_loop_commands_its_machine)
    for map in subject.scenario.deployment().protocol.sense:  # type: ignore[union-attr]
        with _loop(subject) as loop:
            loop.runtime.run(cycles=_BEFORE)
            if fault is not None:
                loop.machine.begin(type(fault)(**{**vars(fault), "channels": (map.channel,)}))
            yield map.channel, loop


def _expect_fallback(loop: LockStep, event: str) -> None:
    guards, interface = loop.runtime.guards, loop.machine.world.interface
    ages = [signal.max_age for signal in interface.sense if isfinite(signal.max_age)]
    longest = ceil(_ALLOWED * max(ages, default=0.1) / loop.runtime.period)
    loop.runtime.run(cycles=min(longest, _LONGEST), until=lambda: bool(guards.latched))
    if not guards.latched:
        raise CheckFailedError(f"{event}, and after {loop.clock.now():.3g} s the DPS still commands")
    loop.runtime.run(cycles=_AFTER)
    fallbacks = loop.deployment.guards.get("fallback", {})
    for signal in interface.act:
        links = chain(fallbacks.get(signal.name) or default_fallback(signal), signal, interface=interface)
        failures = [f.reason for f in guards.log if f.kind == FaultKind.FALLBACK and f.signal == signal.name]
        # That one hands over to the next is in order.
        if len(failures) >= len(links):
            raise CheckFailedError(f"{event}, and then every fallback fails: {'; '.join(failures)}")


def _holds_floats(loop: LockStep, channel: str) -> bool:
    """Return whether messages on a channel can hold NaN: integers cannot."""
    message_type = next(map.type for map in loop.machine.protocol.sense if map.channel == channel)
    integers = {"int8_t", "int16_t", "int32_t", "int64_t", "boolean", "byte", "string"}
    return not integers.issuperset(message_type.__typenames__)


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep the alarms of provoked faults out of the log."""
    log = logging.getLogger("vtbdrake.control")
    level = log.level
    log.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        log.setLevel(level)
