"""Guards between a DPS and a machine: the machine gets commands within limits, or a fallback's commands."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Collection, Iterable, Mapping
from math import inf, isnan, nan
from types import MappingProxyType
from typing import Any, NamedTuple, TypeVar

from numpy.typing import ArrayLike

from vtbdrake.common.argument_checks import as_number
from vtbdrake.common.failures import FAILURES, error_text
from vtbdrake.control.fallback import NO_COMMAND, Fallback, Sample
from vtbdrake.control.fault import Fault, FaultKind
from vtbdrake.control.guarded_signal import GuardedSignal, Limiter, guarded_signal
from vtbdrake.control.limits import ActuationError
from vtbdrake.control.received_signal import ReceivedSignal
from vtbdrake.control.sensor_monitor import SensorMonitor
from vtbdrake.control.staleness import faults_at
from vtbdrake.testbed import Interface, Signal

_Value = TypeVar("_Value")

_log = logging.getLogger(__name__)

_NONE: Mapping[str, ReceivedSignal] = MappingProxyType({})

MOST_UNSENT = 10
"""Number of actuator commands in a row that may fail to leave before that is a fault."""

ACTING_LATENCY = 10.0
"""Number of periods within which an actuator command acts and is reported, unless a deployment says otherwise."""


class LoopCondition(NamedTuple):
    """The condition of DPS, loop and machine in one cycle, as far as it does not show in signals.

    Attributes:
        error: The error that the DPS raised, if it did.
        missed: Number of deadlines missed in a row, up to now.
        blocked: Why the machine is not to be commanded, if it is not.
        pace: How the pace of the cycles differs from the period, if it does.
        released: Whether the machine does without commands, or another one commands it: signals that have left real are
            not commanded any more.
    """

    error: BaseException | None = None
    missed: int = 0
    blocked: str | None = None
    pace: str | None = None
    released: bool = False


SOUND = LoopCondition()
"""The condition in which the DPS may command."""


class GuardDecision(NamedTuple):
    """The guards' decision in one cycle.

    Attributes:
        actuation: The commands to be sent, by actuator signal.
        ok: Whether these are the DPS's commands, limited; otherwise they are the fallbacks'.
        faults: The faults of this cycle. A latch can outlast them.
    """

    actuation: dict[str, Any]
    ok: bool
    faults: tuple[Fault, ...]


class Guards:
    """Limits the commands of a DPS, monitors its sensor signals, and replaces it by fallbacks after a fault.

    In every cycle, `judge` limits the commands of the actuator signals that are on real, unless there is a fault: a
    sensor signal that is stale or implausible; a DPS that raised; a command that is missing, not finite or of a wrong
    size; too many missed deadlines in a row; messages that pace the loop at another pace than its period; a machine
    that must not be commanded, or that reports that it acts on something else than the commands. A fault *latches* in
    the same cycle: from then on the fallbacks command all signals that are on real, until `reset`. While nothing is on
    real, faults are reported, but nothing latches.

    A signal that leaves real is not left alone with its last command: its fallback commands it for ``leave_time``, or
    until the machine is released (see `judge`).

    A signal with a limit of its rate or acceleration needs `start` before it is commanded. A signal that has neither a
    start nor a sent command is not sent at all: there is nothing to hold.

    Fallbacks go on when the machine is gone: they get the sensor signals that are still fresh, and the last accepted
    sample of each with its age. `Brake` turns into `Zero` when its velocity is stale.

    A command that did not leave does not count (see `note_unsent`). From `start` until a first one has left, commands
    depart in every cycle from what `measured_by` measures then, since the machine is free to move meanwhile. So they do
    after more than `MOST_UNSENT` commands in a row that did not leave, or after as long a silence of a fallback or
    of the loop itself. Until the measurement is fresh, nothing is sent. A pause of the loop counts only if it is longer
    than the `max_age` of the measurement, too: in lock-step, where that is infinite, time stands still in the pause.

    Commands that leave need not arrive. What the machine reports as acting (`reported`) is compared with what was sent
    (see `ActingMonitor`): a difference for longer than ``acting_latency`` latches. From then on, in every cycle, the
    fallbacks depart from what acts, so that the first command that arrives again is one step from it. A position that
    the machine has never been sent is not departed from, but what `measured_by` measures. Reports tell it, too, where
    commands go on after a time in which none left.

    Args:
        interface: Signals of the DPS.
        period: Period of the loop, in seconds.
        fallback: By actuator signal; see `default_fallback` for the others.
        jump_tolerance: By sensor signal; see `SensorMonitor`.
        max_delay: By sensor signal, in seconds; see `SensorMonitor`.
        max_missed: More deadlines missed in a row are a fault. So are more commands in a row that did not leave, but
            of those never more than `MOST_UNSENT` are allowed.
        pace_tolerance: For a loop that messages pace, the largest difference between their pace and the period,
            relative to the period (see `PaceMonitor`); more is a fault. The default covers clocks that differ by some
            per cent. Infinite: no pace is a fault.
        leave_time: Seconds for which the fallbacks go on commanding signals that have left real, in cycles of a period:
            longer if the loop misses deadlines, so that limited commands come as far.
        acting_latency: Number of periods within which a command acts on the machine and is reported, rounded up: at
            most 255, and more than the machine's latency. In an outage that is shorter, the command goes on; the first
            one that arrives differs from what acted by up to as many steps.
        acting_tolerance: By actuator signal, the difference between the reported and the sent command that counts as
            none, in the unit of the signal, a scalar or one per entry. By default half of what the rate allows in a
            period, and at most 1 % of the range.
        log_size: Number of faults that `log` keeps.

    Attributes:
        period: Period of the loop, in seconds.
        pace_tolerance: As given.
        leave_time: As given.
        limiters: The limiter of each actuator signal, with its counts.
        monitors: The monitor of each sensor signal.
        log: The newest faults, each once while it lasts.
        measured_by: Actuator signal -> sensor signal that measures what acts there; the `Runtime` takes it from its
            continuity. Without one, commands go on from the last one that left.
        reported: Actuator signal -> what the machine reports as acting; the `Runtime` takes it from its bridge. Signals
            without are not compared.

    Raises:
        ValueError: A fallback is missing, for an unknown signal or does not fit its signal.
    """

    def __init__(
        self,
        interface: Interface,
        period: float,
        *,
        fallback: Mapping[str, Fallback] | None = None,
        jump_tolerance: Mapping[str, ArrayLike] | None = None,
        max_delay: Mapping[str, float] | None = None,
        max_missed: float = 10,
        pace_tolerance: float = 0.1,
        leave_time: float = 1.0,
        acting_latency: float = ACTING_LATENCY,
        acting_tolerance: Mapping[str, ArrayLike] | None = None,
        log_size: int = 1000,
    ) -> None:
        fallback = _by_signal("fallback", fallback, interface.act)
        jump_tolerance = _by_signal("jump_tolerance", jump_tolerance, interface.sense)
        max_delay = _by_signal("max_delay", max_delay, interface.sense)
        acting_tolerance = _by_signal("acting_tolerance", acting_tolerance, interface.act)
        _check_allowances(max_missed, pace_tolerance, leave_time)
        self.period = period
        self.pace_tolerance = pace_tolerance
        self.leave_time = leave_time
        self._signals = {
            signal.name: guarded_signal(
                signal,
                interface,
                period,
                fallback=fallback.get(signal.name),
                latency=acting_latency,
                tolerance=acting_tolerance.get(signal.name),
            )
            for signal in interface.act
        }
        self.limiters: Mapping[str, Limiter] = {name: signal.limiter for name, signal in self._signals.items()}
        self.monitors = {
            s.name: SensorMonitor(s, jump_tolerance=jump_tolerance.get(s.name), max_delay=max_delay.get(s.name))
            for s in interface.sense
        }
        self.log: deque[Fault] = deque(maxlen=log_size)
        self.measured_by: Mapping[str, str] = {}
        self.reported: Mapping[str, ReceivedSignal] = {}
        self._max_missed = max_missed
        self._most_unsent = min(max_missed, MOST_UNSENT)
        self._longest_pause = (MOST_UNSENT + 1) * period
        self._latched: tuple[Fault, ...] = ()
        self._faults: tuple[Fault, ...] = ()
        self._causes: tuple[Fault, ...] = ()  # Those of them that do not concern sensor signals.
        self._begun: set[Fallback] = set()
        self._failed: set[Fallback] = set()
        self._active_names: tuple[str, ...] = ()
        self._active: tuple[GuardedSignal, ...] = ()
        self._leaving: tuple[GuardedSignal, ...] = ()  # They have left real, and their fallbacks still command them.
        self._commanded: tuple[GuardedSignal, ...] = ()  # both
        self._last: float | None = None  # Time of the last cycle.
        # Whether a signal may be irregular: always true if one is.
        self._is_irregular = False
        # Whether `note_unsent` has not been called since the last verdict.
        self._unconfirmed = False
        self._last_commands: Mapping[str, Any] = {}  # of the last verdict

    @property
    def latched(self) -> tuple[Fault, ...]:
        """Return the faults that latched; empty while the DPS commands."""
        return self._latched

    @property
    def driven(self) -> frozenset[str]:
        """Return the actuator signals that were on real in the last cycle."""
        return frozenset(self._active_names)

    @property
    def leaving(self) -> frozenset[str]:
        """Return the actuator signals that have left real, and that their fallbacks still command."""
        return frozenset(signal.name for signal in self._leaving) if self._leaving else frozenset()

    @property
    def silent(self) -> frozenset[str]:
        """Return the actuator signals for which nothing was to be sent in the last cycle, though they are commanded."""
        return frozenset(signal.name for signal in self._signals.values() if signal.is_silent)

    def start(self, name: str, value: Any) -> None:
        """Let the commands of an actuator signal depart from ``value``, at rest.

        Args:
            name: The actuator signal. When its switch is thrown to real, ``value`` is what is measured.
            value: Shape (size,).

        Raises:
            ValueError: The value has another size or is not finite.
        """
        signal = self._signals[name]
        signal.limiter.start_from(value)
        signal.departs = self._is_irregular = True
        signal.begin_comparison()

    def withhold(self, name: str) -> None:
        """Send nothing of an actuator signal until `reset`, not even a fallback's command."""
        signal = self._signals[name]
        signal.limiter.release()
        signal.is_withheld = True

    def sensor_faults(self, name: str, now: float, received: ReceivedSignal) -> list[str]:
        """Return the reasons why a sensor signal cannot be relied on at the time ``now``.

        Args:
            name: Name of the sensor signal.
            now: Present time on the clock of `ReceivedSignal.arrived`, in s.
            received: The last sample of the signal.
        """
        fault = self.monitors[name].fault_at(now, received)
        return [fault.reason] if fault else []

    def judge(
        self,
        now: float,
        received: Mapping[str, ReceivedSignal],
        actuation: Mapping[str, Any],
        active: Collection[str] | None = None,
        *,
        condition: LoopCondition = SOUND,
        at: float = nan,
        all_sensed: Mapping[str, ReceivedSignal] = _NONE,
    ) -> GuardDecision:
        """Judge one cycle. The returned commands count as sent, unless `note_unsent` is called before the next cycle.

        Args:
            now: Present time on the clock of `ReceivedSignal.arrived`, in seconds.
            received: The sensor signals that are on real; no others are monitored.
            actuation: The DPS's commands, by actuator signal.
            active: The actuator signals that are on real, each once; by default the signals of ``actuation``, or, if
                the DPS raised, of the cycle before.
            condition: What DPS, loop and machine are like in this cycle.
            at: Time of the commands in seconds, on the clock by which their rates are limited: a command counts for
                the time since the last one, at most for a period. NaN: every command counts for a period.
            all_sensed: The sensor signals that are not on real, too; fallbacks may use them.
        """
        if self._unconfirmed:
            self.note_unsent(())
        self._unconfirmed = True
        if active is None:
            active = self._active_names if condition.error else actuation
        self._activate(tuple(active))
        if self._leaving:
            self._end_leaving(condition.released)
        sensed = {**all_sensed, **received}
        causes = self._general_faults(now, condition)
        causes += self._depart_anew(now, sensed)
        causes += self._compare_acting(now, sensed)
        commands = self._checked_commands(now, actuation, causes) if condition.error is None else []
        sensor_faults = faults_at(now, self.monitors, received)
        if causes or sensor_faults or self._faults:
            self._note_faults(causes, sensor_faults)
        if self._latched:
            return GuardDecision(self._fall_back(now, sensed, at), False, self._faults)
        actuation = {signal.name: signal.limiter.send(command, at) for signal, command in commands}
        if self._leaving:
            actuation |= self._fallback_commands(self._leaving, now, sensed, at)
        self._note_commands(now, actuation, self._leaving)
        return GuardDecision(actuation, True, self._faults)

    def note_unsent(self, names: Collection[str]) -> None:
        """Record which commands of the last verdict did not leave: they do not count as sent.

        Args:
            names: Actuator signals of these commands; empty if all have left.
        """
        self._unconfirmed = False
        for name in self.reported:
            acting = self._signals[name].acting
            if acting is not None and name in self._last_commands and name not in names:
                acting.note_sent(self._last_commands[name])
        if not names and not self._is_irregular:
            return
        for name in names:
            self.limiters[name].retract()
        for name, signal in self._signals.items():
            signal.note_left(held_back=name in names, commanded=signal in self._commanded)
        self._is_irregular = any(signal.is_irregular for signal in self._signals.values())

    def latch(
        self,
        reason: str,
        now: float,
        received: Mapping[str, ReceivedSignal],
        *,
        at: float = nan,
        level: int = logging.ERROR,
    ) -> GuardDecision:
        """Latch for a reason from outside, whether or not anything is on real; return the verdict of a cycle.

        Args:
            reason: The reason, for the log and the verdict.
            now: Present time on the clock of `ReceivedSignal.arrived`, in s.
            received: The sensor signals that are on real, by name.
            at: The time that the limiters count, in s, as in `judge`.
            level: Level of the message in Python's ``logging``.
        """
        self._depart_anew(now, received)
        fault = Fault(now, None, FaultKind.TOLD, reason)
        self.log.append(fault)
        if not self._latched:
            self._latch((fault,), level=level)
        return GuardDecision(self.fall_back(now, received, at=at), False, (*self._faults, fault))

    def reset(
        self, now: float, received: Mapping[str, ReceivedSignal], against: Collection[str] = ()
    ) -> tuple[str, ...]:
        """Release the latch, unless a cause persists.

        Causes in the DPS and the loop persist as of the last `judge`, those in the sensor signals as of now. A sensor
        signal that has jumped is accepted where it is, if it has been steady there.

        Args:
            now: As in `judge`.
            received: As in `judge`.
            against: Further reasons not to release.

        Returns:
            The reasons why the latch stays; empty if it was released.
        """
        lasting = [
            fault
            for fault in faults_at(now, self.monitors, received)
            if not (fault.kind == FaultKind.JUMP and fault.signal is not None and self.monitors[fault.signal].steady)
        ]
        reasons = (*(fault.reason for fault in (*self._causes, *lasting)), *against)
        if not reasons:
            self._accept_steady()
            if self._latched:
                _log.warning("the DPS commands again: the guards were reset")
            self._latched = ()
            for signal in self._signals.values():
                signal.is_withheld = False
            for name in self.reported:
                self._signals[name].begin_comparison()
        return reasons

    def _activate(self, names: tuple[str, ...]) -> None:
        """Record which signals are on real; let the fallbacks command those that have left it."""
        if names == self._active_names:
            return
        active = tuple(self._signals[name] for name in names)
        for signal in active:
            if signal not in self._commanded:
                signal.begin_comparison()
        for signal in self._active:
            if signal not in active:
                signal.cycles_left = self.leave_time / self.period
                if not self._latched:
                    self._begun -= set(signal.fallbacks)
        self._leaving = tuple(signal for signal in (*self._leaving, *self._active) if signal not in active)
        self._active_names, self._active = names, active
        self._commanded = (*self._active, *self._leaving)

    def _end_leaving(self, released: bool) -> None:
        """Reset the limiters of signals that have left real, and need no command any more."""
        for signal in self._leaving:
            if not signal.goes_on_leaving(released=released):
                signal.release()
                self._leaving = tuple(other for other in self._leaving if other is not signal)
                self._commanded = (*self._active, *self._leaving)

    def _general_faults(self, now: float, condition: LoopCondition) -> list[Fault]:
        faults = []
        if condition.error is not None:
            faults.append(Fault(now, None, FaultKind.RAISED, f"the DPS raised {error_text(condition.error)}"))
        if condition.missed > self._max_missed:
            reason = f"{condition.missed} deadlines were missed in a row, {self._max_missed:g} are allowed"
            faults.append(Fault(now, None, FaultKind.MISSED, reason))
        if condition.blocked is not None:
            reason = f"the machine must not be commanded: {condition.blocked}"
            faults.append(Fault(now, None, FaultKind.BLOCKED, reason))
        if condition.pace is not None:
            faults.append(Fault(now, None, FaultKind.PACE, condition.pace))
        return faults

    def _checked_commands(
        self, now: float, actuation: Mapping[str, Any], causes: list[Fault]
    ) -> list[tuple[GuardedSignal, Any]]:
        """Return the DPS's commands that can be sent, checked; add the faults of the others to ``causes``."""
        commands = []
        for signal in self._active:
            if signal.is_withheld:
                continue
            try:
                commands.append((signal, signal.checked(actuation)))
            except ActuationError as problem:
                reason = f"the actuator command {signal.name} {problem}"
                causes.append(Fault(now, signal.name, problem.kind, reason))
        return commands

    def _depart_anew(self, now: float, sensed: Mapping[str, ReceivedSignal]) -> list[Fault]:
        """Restart the limiters from the measured values where the machine may have moved; return the faults."""
        pause = 0.0 if self._last is None else now - self._last
        if pause > self._longest_pause:
            self._note_pause(pause)
        if not self._is_irregular:
            return []
        faults = []
        for signal in self._commanded:
            is_stuck = signal.unsent > self._most_unsent
            if is_stuck and signal.is_held_back and signal in self._active:
                reason = f"the last {signal.unsent} actuator commands {signal.name} could not be sent"
                faults.append(Fault(now, signal.name, FaultKind.NOT_SENT, reason))
            if is_stuck or signal.departs:
                self._restart(signal, now, sensed)
        return faults

    def _note_pause(self, pause: float) -> None:
        """Let the commands depart anew whose measurement does not cover a pause of the loop, in seconds."""
        for signal in self._commanded:
            sensor = self.measured_by.get(signal.name)
            if sensor is not None and pause > self.monitors[sensor].max_age:
                signal.note_pause()
                self._is_irregular = True

    def _restart(self, signal: GuardedSignal, now: float, sensed: Mapping[str, ReceivedSignal]) -> None:
        """Let the next command of a signal whose commands have not left depart from what acts or is measured."""
        sensor = self.measured_by.get(signal.name)
        if sensor is None or not signal.limiter.needs_start or signal.is_withheld:
            return
        begins = signal.departs and not signal.had_left
        value = None
        if not begins and not signal.is_position:
            value = signal.reported_value(self.reported.get(signal.name))
        if value is None:
            value = self._measured_value(sensor, now, sensed)
        if value is not None:
            signal.limiter.start_from(value)
        else:
            signal.limiter.release()

    def _compare_acting(self, now: float, sensed: Mapping[str, ReceivedSignal]) -> list[Fault]:
        """Compare what the machine reports with what was sent; let commands that it has lost depart from what acts."""
        faults = []
        for name, report in self.reported.items():
            signal = self._signals[name]
            acting = signal.acting
            if acting is None or signal not in self._commanded:
                continue
            if signal.is_silent:
                acting.begin()  # It is right that the machine acts on something else.
            elif acting.compare(report) and signal in self._active:
                faults.append(Fault(now, name, FaultKind.NOT_ACTING, signal.not_acting(report)))
            if signal.is_silent or (acting.is_lost and not acting.is_unreported):
                self._depart_from_acting(signal, now, sensed)
        return faults

    def _depart_from_acting(self, signal: GuardedSignal, now: float, sensed: Mapping[str, ReceivedSignal]) -> None:
        """Let the next command depart from what acts; from the measurement for a position that was never sent."""
        value, sensor = signal.reported_value(self.reported.get(signal.name)), self.measured_by.get(signal.name)
        if signal.is_position and not (signal.acting is not None and signal.acting.is_held):
            value = None if sensor is None else self._measured_value(sensor, now, sensed)
        if value is not None and not signal.is_withheld and signal.limiter.has_start:
            signal.limiter.start_from(value)

    def _measured_value(self, sensor: str, now: float, sensed: Mapping[str, ReceivedSignal]) -> Any:
        """Return the value of a sensor signal that can be relied on; None if it cannot."""
        measured = sensed.get(sensor)
        if measured is None or self.monitors[sensor].fault_at(now, measured) is not None:
            return None
        return measured.value

    def _accept_steady(self) -> None:
        for monitor in self.monitors.values():
            monitor.accept_steady()

    def _note_faults(self, causes: list[Fault], sensor_faults: list[Fault]) -> None:
        """Log the faults that the cycle before did not have; latch if any is there while a signal is on real."""
        previous = {(fault.signal, fault.kind) for fault in self._faults}
        self._faults, self._causes = (*causes, *sensor_faults), tuple(causes)
        self.log.extend(fault for fault in self._faults if (fault.signal, fault.kind) not in previous)
        if self._faults and self._active and not self._latched:
            self._latch(self._faults)
        if not self._active:
            self._accept_steady()

    def _latch(self, faults: tuple[Fault, ...], *, level: int = logging.ERROR) -> None:
        self._latched = faults
        self._begun.clear()
        self._failed.clear()
        _log.log(level, "the fallbacks command from now on: %s", "; ".join(fault.reason for fault in faults))

    def fall_back(self, now: float, received: Mapping[str, ReceivedSignal], *, at: float = nan) -> dict[str, Any]:
        """Return the commands of the fallbacks, within the limits, for all signals that are on real or leave it.

        `judge` does the same while a fault is latched.

        Args:
            now: Present time on the clock of `ReceivedSignal.arrived`, in s.
            received: The sensor signals that are on real, by name.
            at: The time that the limiters count, in s, as in `judge`.
        """
        self._compare_acting(now, received)
        return self._fall_back(now, received, at)

    def _fall_back(self, now: float, received: Mapping[str, ReceivedSignal], at: float) -> dict[str, Any]:
        commands = self._fallback_commands(self._commanded, now, received, at)
        self._note_commands(now, commands, self._commanded)
        return commands

    def _note_commands(self, now: float, commands: Mapping[str, Any], by_fallbacks: tuple[GuardedSignal, ...]) -> None:
        """Remember the commands of this cycle, and which fallbacks were silent."""
        self._last = now
        self._last_commands = commands
        if not by_fallbacks and not self._is_irregular:
            return
        for signal in self._signals.values():
            signal.is_silent = signal in by_fallbacks and signal.name not in commands
            self._is_irregular |= signal.is_silent

    def _fallback_commands(
        self, signals: Iterable[GuardedSignal], now: float, received: Mapping[str, ReceivedSignal], at: float
    ) -> dict[str, Any]:
        """Return the commands of the fallbacks of some signals, within the limits."""
        dt = self.period if self._last is None else now - self._last
        sensed = {
            name: signal.value for name, signal in received.items() if self.monitors[name].fault_at(now, signal) is None
        }
        samples = {
            name: Sample(monitor.value, now - monitor.arrived)
            for name, monitor in self.monitors.items()
            if monitor.arrived > -inf
        }
        actuation = {
            signal.name: self._fallback_command(signal, now, sensed, samples, dt, at)
            for signal in signals
            if signal.limiter.has_start
        }
        return {name: command for name, command in actuation.items() if command is not NO_COMMAND}

    def _fallback_command(
        self,
        signal: GuardedSignal,
        now: float,
        sensed: Mapping[str, Any],
        samples: Mapping[str, Sample],
        dt: float,
        at: float,
    ) -> Any:
        limiter: Any = signal.limiter
        last_sent = limiter.last_sent
        for fallback in signal.fallbacks:
            try:
                if fallback not in self._begun:
                    self._begun.add(fallback)
                    fallback.begin()
                command = fallback.command(last_sent, sensed, samples, dt)
                return command if command is NO_COMMAND else limiter.limit(command, at)
            except FAILURES as error:
                self._note_failed(fallback, signal, now, error)
        return limiter.limit(last_sent, at)

    def _note_failed(self, fallback: Fallback, signal: GuardedSignal, now: float, error: BaseException) -> None:
        if fallback not in self._failed:
            self._failed.add(fallback)
            reason = f"{type(fallback).__name__} cannot command {signal.name}: {error_text(error)}"
            self.log.append(Fault(now, signal.name, FaultKind.FALLBACK, reason))


def _check_allowances(max_missed: float, pace_tolerance: float, leave_time: float) -> None:
    if isnan(as_number("max_missed", max_missed)) or max_missed < 0:
        raise ValueError(f"max_missed is a number of deadlines, not {max_missed}")
    if not as_number("pace_tolerance", pace_tolerance) > 0.0:
        raise ValueError(f"pace_tolerance is a positive share of the period, not {pace_tolerance}")
    if not as_number("leave_time", leave_time) >= 0.0:
        raise ValueError(f"leave_time is a number of seconds from 0 on, not {leave_time}")


def _by_signal(option: str, values: Mapping[str, _Value] | None, signals: Iterable[Signal]) -> dict[str, _Value]:
    """Return values by signal, after a check that there are such signals."""
    names = [signal.name for signal in signals]
    if unknown := sorted(set(values or {}) - set(names)):
        raise ValueError(f"{option} is given for {', '.join(unknown)}, but the signals are {', '.join(names)}")
    return dict(values or {})
