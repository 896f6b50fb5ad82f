"""Guards: whatever the DPS does, the machine gets commands within limits, or those of a fallback."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Collection, Iterable, Mapping
from math import inf, isnan
from types import MappingProxyType
from typing import Any, NamedTuple

from numpy.typing import ArrayLike

from vtbdrake.control.bridge import ReceivedSignal
from vtbdrake.control.fallback import NO_COMMAND, Fallback, Sample, chain, default_fallback
from vtbdrake.control.kernels import found
from vtbdrake.control.limits import NOT_STARTED, CommandFault, CommandLimiter, PassThrough
from vtbdrake.control.sensor_monitor import Fault, SensorMonitor
from vtbdrake.testbed import Interface, Signal

_log = logging.getLogger(__name__)

MOST_UNSENT = 10
"""Commands in a row that may fail to leave before that is a fault."""


class Verdict(NamedTuple):
    """What the guards made of a cycle.

    Attributes:
        actuation: what is to be sent, by actuator signal.
        ok: whether these are the DPS's commands, limited; else they are the fallbacks'.
        faults: what is wrong in this cycle; a latch can outlast it.
    """

    actuation: dict[str, Any]
    ok: bool
    faults: tuple[Fault, ...]


class Guards:
    """Stands between a DPS and a machine.

    In every cycle, `check` limits the commands of the actuator signals that are on real, unless there is a fault: a
    sensor signal that is stale or implausible; a DPS that raised; a command that is missing, not finite or of a wrong
    size; too many missed deadlines in a row; a machine that is not ready. A fault *latches* in the same cycle: from
    then on the fallbacks command all signals that are on real, until `reset`. While nothing is on real, faults are
    told, but nothing latches.

    A signal with a limit of its rate or acceleration needs `start` before it is commanded. What has neither a start nor
    a command that was sent is not sent at all: there is nothing to hold.

    Fallbacks go on when the machine is gone: they get the sensor signals that are still fresh, and the last accepted
    sample of each with its age. `Brake` turns into `Zero` when its velocity is stale.

    A command that did not leave does not count (see `note_unsent`). From `start` until a first one has left, commands
    depart in every cycle from what `measured_by` measures then, since the machine is free to move meanwhile. So they do
    after more than `MOST_UNSENT` commands in a row that did not leave, or as long a silence of a fallback or of the
    loop itself. Until what is measured is fresh, nothing is sent. A pause of the loop counts if it is longer than the
    `max_age` of what is measured, too: in lock-step, where that is infinite, time stands still in it.

    Args:
        interface: of the DPS.
        period: of the loop, in seconds.
        fallback: by actuator signal; see `default_fallback` for the others.
        jump_tolerance, max_delay: by sensor signal; see `SensorMonitor`.
        max_missed: more deadlines missed in a row are a fault. So are more commands in a row that did not leave, but
            of those never more than `MOST_UNSENT` are allowed.
        log_size: how many faults `log` keeps.

    Attributes:
        period: of the loop whose cycles they judge, in seconds.
        limiters: the limiter of each actuator signal, with its counts.
        monitors: of each sensor signal.
        log: the newest faults, each once while it lasts.
        measured_by: actuator signal -> sensor signal that measures what acts there; the `Runtime` takes it from its
            continuity. Without one, commands go on from the last one that left.

    Raises:
        ValueError: a fallback is missing, for an unknown signal or does not fit its signal.
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
        log_size: int = 1000,
    ) -> None:
        fallback, jump_tolerance, max_delay = dict(fallback or {}), dict(jump_tolerance or {}), dict(max_delay or {})
        _refuse_unknown("fallback", fallback, interface.act)
        _refuse_unknown("jump_tolerance", jump_tolerance, interface.sense)
        _refuse_unknown("max_delay", max_delay, interface.sense)
        if isnan(max_missed) or max_missed < 0:
            raise ValueError(f"max_missed is a number of deadlines, not {max_missed}")
        self.limiters: dict[str, CommandLimiter | PassThrough] = {
            s.name: CommandLimiter(s, period=period) if s.is_vector else PassThrough(s) for s in interface.act
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
        self.period = period
        self._latched: tuple[Fault, ...] = ()
        self._faults: tuple[Fault, ...] = ()
        self._causes: tuple[Fault, ...] = ()  # Those of them that are not about sensor signals.
        self._begun: set[Fallback] = set()
        self._failed: set[Fallback] = set()
        self._active: tuple[str, ...] = ()
        self._last: float | None = None
        self._most_unsent = min(max_missed, MOST_UNSENT)
        self._longest_pause = (MOST_UNSENT + 1) * period
        # By actuator signal, for how many cycles nothing left: because it could not, or because a fallback is silent.
        self._unsent: dict[str, int] = {}
        self._held_back: frozenset[str] = frozenset()
        # Those of which no command has left since their start, or since the loop itself has paused.
        self._departing: frozenset[str] = frozenset()
        # Whether nobody has said yet which commands of the last verdict did not leave.
        self._unconfirmed = False
        self._silent: frozenset[str] = frozenset()

    @property
    def latched(self) -> tuple[Fault, ...]:
        """The faults that latched; empty while the DPS commands."""
        return self._latched

    @property
    def driven(self) -> frozenset[str]:
        """The actuator signals that were on real in the last cycle."""
        return frozenset(self._active)

    def needs_start(self, name: str) -> bool:
        """Whether an actuator signal has a limit of its rate or acceleration, which counts from somewhere."""
        return self.limiters[name].needs_start

    def start(self, name: str, value: Any) -> None:
        """Lets the commands of an actuator signal depart from ``value``, at rest.

        When its switch is thrown to real, that is what is measured.

        Raises:
            ValueError: it has another size or is not finite.
        """
        self.limiters[name].start_from(value)
        self._departing |= {name}

    def sensor_faults(self, name: str, now: float, reception: ReceivedSignal) -> list[str]:
        """What is wrong with a sensor signal now."""
        fault = self.monitors[name].check(now, reception)
        return [fault.reason] if fault else []

    def check(
        self,
        now: float,
        receptions: Mapping[str, ReceivedSignal],
        actuation: Mapping[str, Any],
        active: Collection[str] | None = None,
        *,
        error: BaseException | None = None,
        missed: int = 0,
        blocked: str | None = None,
        others: Mapping[str, ReceivedSignal] = MappingProxyType({}),
    ) -> Verdict:
        """Judge one cycle. What it returns counts as sent, unless `note_unsent` says otherwise before the next one.

        Args:
            now: the time on the clock of `ReceivedSignal.arrived`, in seconds.
            receptions: of the sensor signals that are on real; no others are watched.
            actuation: commands of the DPS, by actuator signal.
            active: the actuator signals that are on real, each once; by default those of ``actuation``, or if the DPS
                raised, those of the cycle before.
            error: what the DPS raised, if it did.
            missed: how many deadlines were missed in a row, up to now.
            blocked: why the machine is not ready, if it is not.
            others: receptions of sensor signals that are not on real: fallbacks may use them.
        """
        if self._unconfirmed:
            self.note_unsent(())
        self._unconfirmed = True
        driven = self._activate(active if active is not None else self._active if error else actuation)
        causes = self._whole(now, error, missed, blocked)
        causes += self._depart_anew(now, receptions, others)
        wanted = []
        if error is None:
            for name in driven:
                guard: Any = self.limiters[name]
                try:
                    if name not in actuation:
                        raise CommandFault("missing", "is missing")
                    if guard.needs_start and not guard.has_start:
                        raise CommandFault("not started", NOT_STARTED)
                    wanted.append((name, guard, guard.checked(actuation[name])))
                except CommandFault as problem:
                    causes.append(Fault(now, name, problem.kind, f"the command {name} {problem}"))
        sensor_faults = found(now, self.monitors, receptions)
        if causes or sensor_faults or self._faults:
            self._note(causes, sensor_faults)
            if self._faults and driven and not self._latched:
                self._latch(self._faults)
            if not driven:
                self._accept_steady()
        if self._latched:
            return Verdict(self._fall_back(now, {**others, **receptions}), False, self._faults)
        self._last = now
        self._silent = frozenset()
        return Verdict({name: guard.send(values) for name, guard, values in wanted}, True, self._faults)

    def note_unsent(self, names: Collection[str]) -> None:
        """Take note of which commands of the last verdict did not leave: those do not count as sent.

        Args:
            names: their actuator signals; empty if all have left.
        """
        self._unconfirmed = False
        if not names and not self._unsent and not self._silent and not self._departing:
            return
        for name in names:
            self.limiters[name].take_back()
        self._held_back = frozenset(names)
        left = frozenset(self._active) - self._held_back - self._silent
        self._unsent = {name: self._unsent.get(name, 0) + 1 for name in self._active if name not in left}
        self._departing -= left

    def latch(self, reason: str, now: float, receptions: Mapping[str, ReceivedSignal]) -> Verdict:
        """Latches because somebody says so, whether or not anything is on real; the verdict is that of a cycle."""
        self._depart_anew(now, receptions)
        told = Fault(now, None, "told", reason)
        self.log.append(told)
        if not self._latched:
            self._latch((told,))
        return Verdict(self._fall_back(now, receptions), False, (*self._faults, told))

    def reset(
        self, now: float, receptions: Mapping[str, ReceivedSignal], against: Collection[str] = ()
    ) -> tuple[str, ...]:
        """Releases the latch, unless a cause persists: the DPS's and the loop's as of the last `check`, the sensor
        signals' as of now. A sensor signal that has jumped is accepted where it is, if it has been steady there.

        Args:
            now, receptions: as of `check`.
            against: further reasons not to.

        Returns:
            Why it stays; empty if it was released.
        """
        sensor_faults = found(now, self.monitors, receptions)
        lasting = [doubt for doubt in sensor_faults if not (doubt.kind == "jump" and self._steady(doubt))]
        reasons = (*(fault.reason for fault in (*self._causes, *lasting)), *against)
        if not reasons:
            self._accept_steady()
            self._latched = ()
        return reasons

    def _activate(self, names: Iterable[str]) -> tuple[str, ...]:
        """Takes note of what is on real; a signal that no longer is has to start anew."""
        names = tuple(names)
        if names != self._active:
            for name in set(self._active) - set(names):
                self.limiters[name].release()
                self._departing -= {name}
            self._active = names
        return names

    def _whole(self, now: float, error: BaseException | None, missed: int, blocked: str | None) -> list[Fault]:
        """The faults that are not about one signal."""
        faults = []
        if error is not None:
            faults.append(Fault(now, None, "raised", f"the DPS raised {type(error).__name__}: {error}"))
        if missed > self._max_missed:
            reason = f"{missed} deadlines were missed in a row, {self._max_missed:g} are allowed"
            faults.append(Fault(now, None, "missed", reason))
        if blocked is not None:
            faults.append(Fault(now, None, "not ready", f"the machine is not ready: {blocked}"))
        return faults

    def _lapsed(self, pause: float) -> frozenset[str]:
        """Return the actuator signals that the machine need not have kept to in a pause of the loop, in seconds."""
        return frozenset(
            name
            for name in self._active
            if name in self.measured_by and pause > self.monitors[self.measured_by[name]].max_age
        )

    def _depart_anew(
        self,
        now: float,
        receptions: Mapping[str, ReceivedSignal],
        others: Mapping[str, ReceivedSignal] = MappingProxyType({}),
    ) -> list[Fault]:
        """Have commands that have not left for long depart from what is measured now, and return what is wrong."""
        if self._last is not None and now - self._last > self._longest_pause:
            self._departing |= self._lapsed(now - self._last)
        if not self._unsent and not self._departing:
            return []
        causes = []
        for name in self._active:
            count = self._unsent.get(name, 0)
            unsent = count > self._most_unsent
            if unsent and name in self._held_back:
                causes.append(Fault(now, name, "not sent", f"the last {count} commands {name} could not be sent"))
            guard = self.limiters[name]
            sensor = self.measured_by.get(name)
            if not guard.needs_start or sensor is None:
                continue
            if not unsent and name not in self._departing:
                continue
            reception = receptions.get(sensor) or others.get(sensor)
            if reception is not None and self.monitors[sensor].check(now, reception) is None:
                guard.start_from(reception.value)
            else:
                guard.release()
        return causes

    def _steady(self, jump: Fault) -> bool:
        return jump.signal is not None and self.monitors[jump.signal].steady

    def _accept_steady(self) -> None:
        for monitor in self.monitors.values():
            monitor.accept_steady()

    def _note(self, causes: list[Fault], sensor_faults: list[Fault]) -> None:
        """Logs the faults that the cycle before did not have."""
        known = {(fault.signal, fault.kind) for fault in self._faults}
        self._faults, self._causes = (*causes, *sensor_faults), tuple(causes)
        self.log.extend(fault for fault in self._faults if (fault.signal, fault.kind) not in known)

    def _latch(self, faults: tuple[Fault, ...]) -> None:
        self._latched = faults
        self._begun.clear()
        self._failed.clear()
        _log.error("the fallbacks command from now on: %s", "; ".join(fault.reason for fault in faults))

    def _fall_back(self, now: float, receptions: Mapping[str, ReceivedSignal]) -> dict[str, Any]:
        """The fallbacks' commands, within the limits."""
        dt = self.period if self._last is None else now - self._last
        self._last = now
        sensed = {
            name: reception.value
            for name, reception in receptions.items()
            if self.monitors[name].check(now, reception) is None
        }
        known = {
            name: Sample(monitor.value, now - monitor.arrived)
            for name, monitor in self.monitors.items()
            if monitor.arrived > -inf
        }
        commands = {
            name: self._fallback_command(name, now, sensed, known, dt)
            for name in self._active
            if self.limiters[name].has_start
        }
        sent = {name: command for name, command in commands.items() if command is not NO_COMMAND}
        self._silent = frozenset(self._active) - frozenset(sent)
        return sent

    def _fallback_command(
        self, name: str, now: float, sensed: Mapping[str, Any], known: Mapping[str, Sample], dt: float
    ) -> Any:
        guard: Any = self.limiters[name]
        last_sent = guard.last_sent
        for fallback in self._fallbacks[name]:
            try:
                if fallback not in self._begun:
                    self._begun.add(fallback)
                    fallback.take_over()
                command = fallback.command(last_sent, sensed, known, dt)
                return command if command is NO_COMMAND else guard.limit(command)
            except (Exception, SystemExit) as error:  # A failed assertion inside Drake arrives as SystemExit.
                if fallback not in self._failed:
                    self._failed.add(fallback)
                    reason = f"{type(fallback).__name__} cannot command {name}: {type(error).__name__}: {error}"
                    self.log.append(Fault(now, name, "fallback", reason))
        return guard.send(guard.checked(last_sent))


def _refuse_unknown(what: str, given: Iterable[str], signals: Iterable[Signal]) -> None:
    names = [signal.name for signal in signals]
    if unknown := sorted(set(given) - set(names)):
        raise ValueError(f"{what} is given for {', '.join(unknown)}, but the signals are {', '.join(names)}")
