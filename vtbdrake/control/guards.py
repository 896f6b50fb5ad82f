"""Guards between a DPS and a machine: the machine gets commands within limits, or those of a fallback."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Collection, Iterable, Mapping
from math import inf, isnan, nan
from types import MappingProxyType
from typing import Any, NamedTuple

from numpy.typing import ArrayLike

from vtbdrake.control.fallback import NO_COMMAND, Fallback, Sample, chain, default_fallback
from vtbdrake.control.fault import Fault, FaultKind
from vtbdrake.control.limits import ActuationError, PassThrough, RateLimiter
from vtbdrake.control.received_signal import ReceivedSignal
from vtbdrake.control.sensor_monitor import SensorMonitor
from vtbdrake.control.staleness import faults_at
from vtbdrake.failures import FAILURES, error_text
from vtbdrake.testbed import Interface, Signal

_log = logging.getLogger(__name__)

_NONE: Mapping[str, ReceivedSignal] = MappingProxyType({})

MOST_UNSENT = 10
"""Number of actuator commands in a row that may fail to leave before that is a fault."""


class Verdict(NamedTuple):
    """The guards' decision in one cycle."""

    actuation: dict[str, Any]  # the commands to be sent, by actuator signal
    ok: bool  # whether these are the DPS's commands, limited; otherwise they are the fallbacks'
    faults: tuple[Fault, ...]  # the faults of this cycle. A latch can outlast them.


class Guards:
    """Limits the commands of a DPS, monitors its sensor signals, and replaces it by fallbacks after a fault.

    In every cycle, `judge` limits the commands of the actuator signals that are on real, unless there is a fault: a
    sensor signal that is stale or implausible; a DPS that raised; a command that is missing, not finite or of a wrong
    size; too many missed deadlines in a row; messages that pace the loop at another pace than its period; a machine
    that must not be commanded. A fault *latches* in the same cycle: from then on the fallbacks command all signals that
    are on real, until `reset`. While nothing is on real, faults are reported, but nothing latches.

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
        log_size: int = 1000,
    ) -> None:
        fallback, jump_tolerance, max_delay = dict(fallback or {}), dict(jump_tolerance or {}), dict(max_delay or {})
        _reject_unknown("fallback", fallback, interface.act)
        _reject_unknown("jump_tolerance", jump_tolerance, interface.sense)
        _reject_unknown("max_delay", max_delay, interface.sense)
        if isnan(max_missed) or max_missed < 0:
            raise ValueError(f"max_missed is a number of deadlines, not {max_missed}")
        if not pace_tolerance > 0.0:
            raise ValueError(f"pace_tolerance is a positive share of the period, not {pace_tolerance}")
        if not leave_time >= 0.0:
            raise ValueError(f"leave_time is a number of seconds from 0 on, not {leave_time}")
        self.period = period
        self.pace_tolerance = pace_tolerance
        self.leave_time = leave_time
        self.limiters: dict[str, RateLimiter | PassThrough] = {
            s.name: RateLimiter(s, period=period) if s.is_vector else PassThrough() for s in interface.act
        }
        self.monitors = {
            s.name: SensorMonitor(s, jump_tolerance=jump_tolerance.get(s.name), max_delay=max_delay.get(s.name))
            for s in interface.sense
        }
        self.log: deque[Fault] = deque(maxlen=log_size)
        self.measured_by: Mapping[str, str] = {}
        self._fallbacks = {
            s.name: chain(fallback.get(s.name) or default_fallback(s), s, interface=interface) for s in interface.act
        }
        self._max_missed = max_missed
        self._most_unsent = min(max_missed, MOST_UNSENT)
        self._longest_pause = (MOST_UNSENT + 1) * period
        self._latched: tuple[Fault, ...] = ()
        self._faults: tuple[Fault, ...] = ()
        self._causes: tuple[Fault, ...] = ()  # Those of them that do not concern sensor signals.
        self._begun: set[Fallback] = set()
        self._failed: set[Fallback] = set()
        self._active: tuple[str, ...] = ()
        # Actuator signals that have left real, and for how many more cycles their fallbacks command.
        self._leaving: dict[str, float] = {}
        self._last: float | None = None  # Time of the last cycle.
        # By actuator signal, for how many cycles nothing has left: it could not, or a fallback is silent.
        self._unsent: dict[str, int] = {}
        self._held_back: frozenset[str] = frozenset()
        self._silent: frozenset[str] = frozenset()
        # Actuator signals of which no command has left since their start, or since the loop itself has paused.
        self._departing: frozenset[str] = frozenset()
        self._withheld: frozenset[str] = frozenset()  # actuator signals of which nothing is sent until a reset
        # Whether `note_unsent` has not been called since the last verdict.
        self._unconfirmed = False

    @property
    def latched(self) -> tuple[Fault, ...]:
        """Return the faults that latched; empty while the DPS commands."""
        return self._latched

    @property
    def driven(self) -> frozenset[str]:
        """Return the actuator signals that were on real in the last cycle."""
        return frozenset(self._active)

    @property
    def leaving(self) -> frozenset[str]:
        """Return the actuator signals that have left real, and that their fallbacks still command."""
        return frozenset(self._leaving)

    def start(self, name: str, value: Any) -> None:
        """Let the commands of an actuator signal depart from ``value``, at rest.

        Args:
            name: The actuator signal. When its switch is thrown to real, ``value`` is what is measured.
            value: Shape (size,).

        Raises:
            ValueError: The value has another size or is not finite.
        """
        self.limiters[name].start_from(value)
        self._departing |= {name}

    def withhold(self, name: str) -> None:
        """Send nothing of an actuator signal until `reset`, not even a fallback's command."""
        self.limiters[name].release()
        self._withheld |= {name}

    def sensor_faults(self, name: str, now: float, received: ReceivedSignal) -> list[str]:
        """Return the reasons why a sensor signal cannot be relied on at the time ``now``."""
        fault = self.monitors[name].fault_at(now, received)
        return [fault.reason] if fault else []

    def judge(
        self,
        now: float,
        received: Mapping[str, ReceivedSignal],
        actuation: Mapping[str, Any],
        active: Collection[str] | None = None,
        *,
        error: BaseException | None = None,
        missed: int = 0,
        blocked: str | None = None,
        pace: str | None = None,
        at: float = nan,
        released: bool = False,
        all_sensed: Mapping[str, ReceivedSignal] = _NONE,
    ) -> Verdict:
        """Judge one cycle. The returned commands count as sent, unless `note_unsent` is called before the next cycle.

        Args:
            now: Present time on the clock of `ReceivedSignal.arrived`, in seconds.
            received: The sensor signals that are on real; no others are monitored.
            actuation: The DPS's commands, by actuator signal.
            active: The actuator signals that are on real, each once; by default those of ``actuation``, or if the DPS
                raised, those of the cycle before.
            error: The error that the DPS raised, if it did.
            missed: Number of deadlines missed in a row, up to now.
            blocked: Why the machine is not to be commanded, if it is not.
            pace: How the pace of the cycles differs from the period, if it does.
            at: Time of the commands in seconds, on the clock by which their rates are limited: a command counts for
                the time since the last one, at most for a period. NaN: every command counts for a period.
            released: Whether the machine does without commands, or another one commands it: signals that have left
                real are not commanded any more.
            all_sensed: The sensor signals that are not on real, too; fallbacks may use them.
        """
        if self._unconfirmed:
            self.note_unsent(())
        self._unconfirmed = True
        self._activate(tuple(active if active is not None else self._active if error else actuation))
        self._end_leaving(released)
        causes = self._general_faults(now, error, missed, blocked, pace)
        causes += self._depart_anew(now, received, all_sensed)
        checked_commands = []
        if error is None:
            for name in self._active:
                if name in self._withheld:
                    continue
                limiter: Any = self.limiters[name]
                try:
                    if name not in actuation:
                        raise ActuationError(FaultKind.MISSING, "is missing")
                    if limiter.needs_start and not limiter.has_start:
                        raise ActuationError(
                            FaultKind.NOT_STARTED,
                            "has nothing to depart from within its limits of rate or acceleration: no command of it is "
                            "recent, and no measurement of it is reliable",
                        )
                    checked_commands.append((name, limiter, limiter.checked(actuation[name])))
                except ActuationError as problem:
                    causes.append(Fault(now, name, problem.kind, f"the actuator command {name} {problem}"))
        sensor_faults = faults_at(now, self.monitors, received)
        if causes or sensor_faults or self._faults:
            self._record(causes, sensor_faults)
            if self._faults and self._active and not self._latched:
                self._latch(self._faults)
            if not self._active:
                self._accept_steady()
        if self._latched:
            return Verdict(self.fall_back(now, {**all_sensed, **received}, at=at), False, self._faults)
        commands = {name: limiter.send(values, at) for name, limiter, values in checked_commands}
        if self._leaving:
            commands |= self._fallback_commands(self._leaving, now, {**all_sensed, **received}, at)
        self._last = now
        self._silent = frozenset(self._leaving) - frozenset(commands)
        return Verdict(commands, True, self._faults)

    def note_unsent(self, names: Collection[str]) -> None:
        """Record which commands of the last verdict did not leave: they do not count as sent.

        Args:
            names: Actuator signals of these commands; empty if all have left.
        """
        self._unconfirmed = False
        if not names and not self._unsent and not self._silent and not self._departing:
            return
        for name in names:
            self.limiters[name].retract()
        self._held_back = frozenset(names)
        commanded = frozenset((*self._active, *self._leaving))
        left = commanded - self._held_back - self._silent
        self._unsent = {name: self._unsent.get(name, 0) + 1 for name in commanded - left}
        self._departing -= left

    def latch(
        self,
        reason: str,
        now: float,
        received: Mapping[str, ReceivedSignal],
        *,
        at: float = nan,
        level: int = logging.ERROR,
    ) -> Verdict:
        """Latch for a reason from outside, whether or not anything is on real; return the verdict of a cycle.

        ``at`` is as in `judge`; ``level`` is that of the message in the log of Python's ``logging``.
        """
        self._depart_anew(now, received, _NONE)
        fault = Fault(now, None, FaultKind.TOLD, reason)
        self.log.append(fault)
        if not self._latched:
            self._latch((fault,), level=level)
        return Verdict(self.fall_back(now, received, at=at), False, (*self._faults, fault))

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
            self._latched, self._withheld = (), frozenset()
        return reasons

    def _activate(self, names: tuple[str, ...]) -> None:
        """Record which signals are on real; let the fallbacks command those that have left it."""
        if names != self._active:
            for name in set(self._active) - set(names):
                self._leaving[name] = self.leave_time / self.period
                if not self._latched:
                    self._begun -= set(self._fallbacks[name])
            for name in names:
                self._leaving.pop(name, None)
            self._active = names

    def _end_leaving(self, released: bool) -> None:
        """Reset the limiters of signals that have left real, and need no command any more."""
        for name, left in tuple(self._leaving.items()):
            if not released and left > 0.0 and self.limiters[name].has_start:
                self._leaving[name] = left - 1.0
            else:
                self.limiters[name].release()
                self._departing -= {name}
                self._withheld -= {name}
                del self._leaving[name]

    def _general_faults(
        self, now: float, error: BaseException | None, missed: int, blocked: str | None, pace: str | None
    ) -> list[Fault]:
        faults = []
        if error is not None:
            faults.append(Fault(now, None, FaultKind.RAISED, f"the DPS raised {error_text(error)}"))
        if missed > self._max_missed:
            reason = f"{missed} deadlines were missed in a row, {self._max_missed:g} are allowed"
            faults.append(Fault(now, None, FaultKind.MISSED, reason))
        if blocked is not None:
            faults.append(Fault(now, None, FaultKind.BLOCKED, f"the machine must not be commanded: {blocked}"))
        if pace is not None:
            faults.append(Fault(now, None, FaultKind.PACE, pace))
        return faults

    def _depart_anew(
        self, now: float, received: Mapping[str, ReceivedSignal], all_sensed: Mapping[str, ReceivedSignal]
    ) -> list[Fault]:
        """Restart the limiters from the measured values where the machine may have moved; return the faults."""
        pause = 0.0 if self._last is None else now - self._last
        commanded = (*self._active, *self._leaving)
        if pause > self._longest_pause:
            self._departing |= {
                name
                for name in commanded
                if name in self.measured_by and pause > self.monitors[self.measured_by[name]].max_age
            }
        if not self._unsent and not self._departing:
            return []
        faults = []
        for name in commanded:
            count = self._unsent.get(name, 0)
            if count > self._most_unsent and name in self._held_back and name in self._active:
                reason = f"the last {count} actuator commands {name} could not be sent"
                faults.append(Fault(now, name, FaultKind.NOT_SENT, reason))
            limiter, sensor = self.limiters[name], self.measured_by.get(name)
            free = count > self._most_unsent or name in self._departing
            if not free or sensor is None or not limiter.needs_start or name in self._withheld:
                continue
            measured = received.get(sensor) or all_sensed.get(sensor)
            if measured is not None and self.monitors[sensor].fault_at(now, measured) is None:
                limiter.start_from(measured.value)
            else:
                limiter.release()
        return faults

    def _accept_steady(self) -> None:
        for monitor in self.monitors.values():
            monitor.accept_steady()

    def _record(self, causes: list[Fault], sensor_faults: list[Fault]) -> None:
        """Log the faults that the cycle before did not have."""
        previous = {(fault.signal, fault.kind) for fault in self._faults}
        self._faults, self._causes = (*causes, *sensor_faults), tuple(causes)
        self.log.extend(fault for fault in self._faults if (fault.signal, fault.kind) not in previous)

    def _latch(self, faults: tuple[Fault, ...], *, level: int = logging.ERROR) -> None:
        self._latched = faults
        self._begun.clear()
        self._failed.clear()
        _log.log(level, "the fallbacks command from now on: %s", "; ".join(fault.reason for fault in faults))

    def fall_back(self, now: float, received: Mapping[str, ReceivedSignal], *, at: float = nan) -> dict[str, Any]:
        """Return the commands of the fallbacks, within the limits, for all signals that are on real or leave it.

        The arguments are those of `judge`, which does the same while a fault is latched.
        """
        names = (*self._active, *self._leaving)
        commands = self._fallback_commands(names, now, received, at)
        self._last = now
        self._silent = frozenset(names) - frozenset(commands)
        return commands

    def _fallback_commands(
        self, names: Iterable[str], now: float, received: Mapping[str, ReceivedSignal], at: float
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
            name: self._fallback_command(name, now, sensed, samples, dt, at)
            for name in names
            if self.limiters[name].has_start
        }
        return {name: command for name, command in actuation.items() if command is not NO_COMMAND}

    def _fallback_command(
        self, name: str, now: float, sensed: Mapping[str, Any], samples: Mapping[str, Sample], dt: float, at: float
    ) -> Any:
        limiter: Any = self.limiters[name]
        last_sent = limiter.last_sent
        for fallback in self._fallbacks[name]:
            try:
                if fallback not in self._begun:
                    self._begun.add(fallback)
                    fallback.begin()
                command = fallback.command(last_sent, sensed, samples, dt)
                return command if command is NO_COMMAND else limiter.limit(command, at)
            except FAILURES as error:
                if fallback not in self._failed:
                    self._failed.add(fallback)
                    reason = f"{type(fallback).__name__} cannot command {name}: {error_text(error)}"
                    self.log.append(Fault(now, name, FaultKind.FALLBACK, reason))
        return limiter.limit(last_sent, at)


def _reject_unknown(option: str, by_signal: Iterable[str], signals: Iterable[Signal]) -> None:
    names = [signal.name for signal in signals]
    if unknown := sorted(set(by_signal) - set(names)):
        raise ValueError(f"{option} is given for {', '.join(unknown)}, but the signals are {', '.join(names)}")
