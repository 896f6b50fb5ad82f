"""The real-time loop: a testbed, or the DPS alone, controls the machine cycle by cycle."""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from contextlib import AbstractContextManager, suppress
from functools import partial
from math import inf, isnan
from typing import Any

import numpy as np
from pydrake.systems.framework import Context

from vtbdrake.common.argument_checks import as_number
from vtbdrake.common.closing import Closing
from vtbdrake.common.failures import FAILURES
from vtbdrake.common.interrupt import interrupts_postponed
from vtbdrake.control.bridge import Bridge
from vtbdrake.control.clock import Clock, SimulatedClock, Throttle, WallClock
from vtbdrake.control.cycle_pace import ClockPace, CyclePace, LockStepPace, MessagePace
from vtbdrake.control.fault import Fault, FaultKind
from vtbdrake.control.guards import SOUND, Guards, LoopCondition
from vtbdrake.control.reception import Reception
from vtbdrake.control.slow_parts import SlowParts
from vtbdrake.control.statistics import LoopStatistics
from vtbdrake.control.stepping import ChangeKind, Cycle, Stepped
from vtbdrake.control.switching import (
    Continuity,
    Preparation,
    SwitchRefusedError,
    checked_continuity,
    discontinuities,
    discontinuity,
    perform,
    prepare,
)
from vtbdrake.drake_workarounds.lost_interrupts import Interruptible
from vtbdrake.testbed import DpsAlone, Interface, VirtualTestbed, slow_parts
from vtbdrake.testbed.testbed import Positions

_log = logging.getLogger(__name__)

_POSTPONED = 2.0
"""Time for which Ctrl-C waits at most while the fallbacks bring the machine to rest, in seconds."""

_ENDING = 2.0
"""Time to wait at most for the last cycle of another thread, in seconds."""


class Runtime(Closing, Stepped):
    """Steps a testbed, or the DPS alone, once per period, with the machine on the other side of a bridge.

    A cycle receives the newest messages, feeds them to the DPS, steps it by one period, lets the guards check its
    actuator commands and sends them. The DPS's time is exactly the number of its steps times the period: a missed
    cycle is left out and counted, and never caught up with, so that no burst of old commands is sent.

    A loop that messages pace checks that they come once per period: by its clock, or by the machine's time stamps if
    no signal has a ``max_age`` (in lock-step, where the machine waits). Another pace prevents a switch to real, and
    is a fault afterwards; how much may differ is an option of the guards. The rates of commands are limited by the time
    that has passed since the last ones, so they hold even if the pace is wrong, or if cycles are run by hand.

    A testbed starts with its switches as they stand in ``context``. The DPS alone starts idle: it is stepped, and
    commands, from its switch to ``real`` on.

    The slow parts of the DPS run beside it, each in a separate process, until `close` or the end of a ``with`` block.

    If another publisher commands the same machine, that is an alarm: it is logged and counted in the statistics. No
    signal is switched to real while another publisher is heard. The guards cannot stop it; a hub can, by protected
    channels.

    Args:
        target: The testbed or the DPS alone.
        bridge: An open bridge; the thread that runs the cycles polls it and publishes by it.
        period: Period of a cycle, in seconds.
        context: Where the target starts; its default context if None. It belongs to the runtime from then on.
        clock: By default the wall clock, which wakes up 0.1 ms early; a `SimulatedClock` makes tests deterministic.
        guards: Guards made for the same period and signals; by default those that follow from the interface.
        pace: By default the clock starts the cycles. With the name of a sensor signal, every message of it starts one,
            or the clock, if none comes for ``patience`` periods. If the machine's cycle
            takes several messages, name a signal of the last one: the first message that contains the signal starts
            the cycle, which gets the values of later messages from the cycle before.
        patience: Number of periods, see ``pace``. It must cover the machine's jitter and be shorter than the sensor
            signals' maximum ages, so that a cycle notices a silent machine. A paced loop that is delayed by more has
            missed cycles.
        continuity: Actuator signal -> (sensor signal, largest difference): a switch to real is refused while they
            differ by more, in any entry. Commands depart from that sensor signal, also after a time in which none left.
            The first command is compared again, and if it differs by more, the guards latch and nothing is sent.
            With the sensor signal alone, the largest difference is what the rate of the actuator signal allows in a
            period. None, as for a signal that is left out: its commands may jump.
        blocked_by: Returns the blocked reason of the machine (why it must not be commanded yet), or None. The mode that
            the machine reports blocks without it (`Bridge.robot_mode`).
        hint: What an operator does where a switch or a reset is refused because a command would not continue what is
            measured. It is a part of the reason.
        released_by: Returns whether the machine confirms that it does without commands, because its brakes have engaged
            for example: the fallbacks end, which otherwise go on for the guards' ``leave_time`` after a signal has left
            real, and after the end of a loop. The mode that the machine reports may confirm it, too.
        statistics: Statistics of the loop's timing, made for the same period.
        watchers: Called with every `Cycle`. One that raises is removed, and the loop goes on.

    Attributes:
        cycles: Number of cycles so far.
        slow_parts: The slow parts of the DPS, with their statistics.
        uncompared: The actuator signals whose first command since their switch to real is still to be compared with
            what is measured.

    Raises:
        ValueError: An argument does not fit the target or the period, or a paced loop has a `SimulatedClock`.
    """

    def __init__(
        self,
        target: VirtualTestbed | DpsAlone,
        bridge: Bridge,
        *,
        period: float = 1e-3,
        context: Context | None = None,
        clock: Clock | None = None,
        guards: Guards | None = None,
        pace: str | None = None,
        patience: float = 3.0,
        continuity: Continuity | None = None,
        blocked_by: Callable[[], str | None] = lambda: None,
        hint: str = "",
        released_by: Callable[[], bool] = lambda: False,
        statistics: LoopStatistics | None = None,
        watchers: tuple[Callable[[Cycle], None], ...] = (),
    ) -> None:
        _check_pace(bridge, clock, period=period, pace=pace, patience=patience)
        self.continuity = checked_continuity(target.interface, continuity or {}, period=period)
        super().__init__(target, bridge, period=period, context=context)
        self.clock = clock or WallClock(spin=1e-4)
        self.guards = guards or Guards(target.interface, period)
        self.statistics = statistics or LoopStatistics(period)
        _check_fit(self.guards, self.statistics, target.interface, period)
        self.guards.measured_by = {name: sensor for name, (sensor, _) in self.continuity.items()}
        self.guards.reported = bridge.reported
        self.blocked_by = blocked_by
        self.hint = hint or "let the DPS command what is measured, by a command u for example, or move the machine"
        self.released_by = released_by
        self.cycles = 0
        self.pace = pace
        self._reception = Reception(bridge, self.clock, self.guards.monitors, period)
        self._pace = self._make_pace(patience * period)
        self._left = -1  # The number of cycles after which the loop left.
        self._watchers = list(watchers)
        self._requests: deque[tuple[Callable[[], Any], Future[Any]]] = deque()
        self._is_closed = False
        self._stop = threading.Event()
        self._interruptible = Interruptible()
        self._runner: threading.Thread | None = None  # that is in `run`
        self._ended = threading.Event()
        self._log_release = Throttle(self.clock)
        self.uncompared: set[str] = set()
        self._foreign = bridge.foreign
        self._log_foreign = Throttle(self.clock)
        self.slow_parts = SlowParts(
            slow_parts(target.diagram), self._context, period=period, clock=self.clock, changed=self.note_change
        )

    def _make_pace(self, patience: float) -> CyclePace:
        """Return the pace of the cycles; ``patience`` is in seconds."""
        if self.pace is None:
            return ClockPace(self.period, self.clock, self.statistics, receive=self._receive_early)
        # The machine's time may stand still then, so the stamps of the messages tell it.
        in_lock_step = all(monitor.max_age == inf for monitor in self.guards.monitors.values())
        return (LockStepPace if in_lock_step else MessagePace)(
            self.period,
            self.clock,
            self.statistics,
            signal=self.pace,
            bridge=self.bridge,
            reception=self._reception,
            guards=self.guards,
            patience=patience,
        )

    def close(self) -> None:
        """End the processes of the slow parts. Nothing can be done with the runtime afterwards.

        Requests that no cycle has served are cancelled.
        """
        self._is_closed = True
        self._cancel_requests()
        self.slow_parts.close()

    # -- the loop

    def run(
        self, *, cycles: int | None = None, seconds: float | None = None, until: Callable[[], bool] = lambda: False
    ) -> None:
        """Run cycles until a limit is reached or `stop` is called; after Ctrl-C or an error, `leave`.

        What has arrived since the last run is read before the first cycle, which gets the newest values. If values that
        have waited may be older than their signal's ``max_age``, newer ones are waited for (``max_age`` or 0.1 s).

        Args:
            cycles: Number of cycles.
            seconds: Time on the clock; a wait for a message ends with it.
            until: Called after every cycle; True ends the run.

        Raises:
            ValueError: ``seconds`` is not a number.
        """
        if seconds is not None and isnan(seconds):
            raise ValueError(f"a loop runs for a number of seconds, not for {seconds}")
        self._run(cycles, seconds, until)

    def _run(
        self,
        cycles: int | None,
        seconds: float | None,
        until: Callable[[], bool],
        meanwhile: Callable[[], bool] = lambda: False,
    ) -> None:
        """Run cycles as `run` does; ``meanwhile`` is called in long waits for a message, and True ends the run, too."""
        self._stop.clear()
        self._ended.clear()
        self._runner = threading.current_thread()
        try:
            self.read_switches()
            begins = self._read_waiting()
            begin = self.clock.now()
            deadline, done = begin, 0

            def ends() -> bool:
                is_over = seconds is not None and self.clock.now() - begin >= seconds
                return is_over or self._stop.is_set() or meanwhile()

            with self._interruptible:
                while not self._stop.is_set():
                    if (cycles is not None and done >= cycles) or (seconds is not None and deadline - begin >= seconds):
                        return
                    begin_of_cycle = (deadline, 0.0) if begins else self._pace.wait(deadline, self.active, ends)
                    if begin_of_cycle is None:
                        return
                    due, lateness = begin_of_cycle
                    begins = False
                    self.cycle(due=due, lateness=lateness, poll=not self._pace.receives)
                    self._interruptible.raise_interrupt()
                    done += 1
                    if until():
                        return
                    deadline = self._pace.next_deadline(due, lateness)
        except BaseException:
            self.leave("the loop ended")
            raise
        finally:
            self._runner = None
            self._ended.set()

    def watch(self, watcher: Callable[[Cycle], None]) -> None:
        """Call a watcher with every `Cycle` from the next one on."""
        self._watchers.append(watcher)

    def unwatch(self, watcher: Callable[[Cycle], None]) -> None:
        """Remove a watcher; one that was removed already (because it raised) is ignored."""
        if watcher in self._watchers:
            self._watchers.remove(watcher)

    def stop(self) -> None:
        """End `run` after the present cycle, or in its wait for a message. May be called from any thread."""
        self._stop.set()

    @property
    def uninterrupted(self) -> AbstractContextManager[None]:
        """Return a context manager within which Ctrl-C waits, for a watcher whose quick steps belong together.

        So what has been sent is also recorded. Within `run` only; it must not last longer than a few milliseconds.
        """
        return self._interruptible.uninterrupted

    def _receive_early(self) -> None:
        self.bridge.poll()
        self.feed()

    def cycle(self, *, due: float | None = None, lateness: float = 0.0, poll: bool = True) -> Cycle:
        """Run one cycle now and return its record.

        Args:
            due: When the cycle was due, on the clock in seconds; None: now.
            lateness: Time since the cycle was due, in seconds.
            poll: Whether to poll the bridge first.
        """
        begin = self.clock.now()
        due = begin if due is None else due
        if poll:
            self.bridge.poll()
        behind = lateness > self.period or self.statistics.run > 0
        now = self._reception.receive(self.watched, since=begin, behind=behind)
        off_pace = self._pace.note_cycle()
        if self.bridge.robot_mode is not None:
            self.bridge.robot_mode.note_cycle()
        self._serve()
        self.apply_commands(now)
        self.feed()
        self.slow_parts.receive()
        active = self.active
        fed = self.clock.now()
        error, actuation = self.step()
        stepped = self.clock.now()
        discontinuous = self._compare_first(actuation) if self.uncompared else None
        verdict = self.guards.judge(
            stepped,  # After the step: a long one makes the samples, and with them the commands, stale.
            self.watched,
            actuation,
            active,
            condition=self._condition(
                error,
                missed=self.statistics.run + self._pace.overrun(lateness, stepped - begin),
                blocked=discontinuous or (self.blocked_reason() if active else None),
                off_pace=off_pace,
            ),
            at=self._pace.time_of_commands(due, stepped),
            all_sensed=self.bridge.sensed,
        )
        with self.uninterrupted:
            unsent = self.bridge.publish(verdict.actuation) if verdict.actuation else ()
            self.guards.note_unsent(unsent)
        if unsent or len(verdict.actuation) < len(active):
            self.bridge.keep([name for name in active if name in unsent or name not in verdict.actuation])
        self.slow_parts.send()
        if self.bridge.foreign != self._foreign:
            self._note_foreign()
        self.statistics.record(lateness=lateness, step=stepped - fed, cycle=self.clock.now() - begin)
        changes, new = self.pop_record()
        done = Cycle(self.cycles, self.time, now, changes, new, actuation, verdict)
        self.cycles += 1
        for watcher in self._watchers[:]:
            try:
                watcher(done)
            except FAILURES:
                _log.exception("a watcher of the loop raised, and is removed")
                self._watchers.remove(watcher)
        return done

    def _condition(
        self, error: BaseException | None, *, missed: int, blocked: str | None, off_pace: str | None
    ) -> LoopCondition:
        """Return the condition of a cycle; made only if it is not the usual one."""
        released = bool(self.guards.leaving) and self._released
        if error is None and blocked is None and off_pace is None and not missed and not released:
            return SOUND
        return LoopCondition(error, missed, blocked, off_pace, released)

    def _compare_first(self, actuation: Mapping[str, Any]) -> str | None:
        """Withhold the first commands of a DPS that do not continue what is measured, and return why."""
        reasons = []
        for name in self.uncompared & actuation.keys():
            command = np.asarray(actuation[name], dtype=float)
            if not np.isfinite(command).all():
                continue  # This is a fault of its own.
            self.uncompared.remove(name)
            if differences := discontinuity(self, name, command):
                reasons += differences
                self.guards.withhold(name)
        if reasons and self.bridge.competing_publisher is not None:
            reasons.append(self.bridge.competing_publisher)  # It may have moved the machine since the switch.
        return "; ".join(reasons) or None

    def _read_waiting(self) -> bool:
        """Receive all that has waited since the last run, and return whether it begins a cycle of a paced loop."""
        messages = self._pace.messages
        self._reception.catch_up(self.watched, patience=inf)
        return self._pace.messages != messages

    def note_rejected(self, now: float, name: str, alarm: str) -> None:
        super().note_rejected(now, name, alarm)
        self.guards.log.append(Fault(now, None, FaultKind.COMMAND, alarm))

    def _note_foreign(self) -> None:
        """Count other publishers' commands while this loop commands, and log them at most once per second."""
        new, self._foreign = self.bridge.foreign - self._foreign, self.bridge.foreign
        if not self.active:
            return  # This loop only listens to the one that commands.
        self.statistics.foreign += new
        reason = self.bridge.competing_publisher or "another publisher commands the machine"
        self._log_foreign(_log.error, "ALARM: %s (heard so far: %d)", reason, self.statistics.foreign)

    def leave(self, reason: str) -> None:
        """Latch the guards, and let the fallbacks command without the DPS, as the last commands of a loop that ends.

        They command for the guards' ``leave_time``, until the machine is released, or until they send nothing more. A
        machine in lock-step gets one command: it stands still afterwards. Without a cycle since the last call, nothing
        is done. A `run` in another thread is stopped first.

        Ctrl-C, SIGTERM and SIGHUP, if they have a handler, are postponed until they have ended, for 2 s at most: a
        press too many, or one that arrives twice, does not leave a machine with half a command.
        """
        if self._runner not in (None, threading.current_thread()):
            self.stop()
            self._ended.wait(_ENDING)
        if self._left == self.cycles:
            return
        with interrupts_postponed() as interrupts:
            self._left = self.cycles
            begin = now = self.clock.now()
            # In cycles: on a busy computer they take longer, and each changes a limited command by a period's worth.
            left = self._pace.cycles_in(self.guards.leave_time)
            verdict = self.guards.latch(
                reason, now, self.bridge.sensed, at=self._pace.time_of_last_commands(now), level=logging.INFO
            )
            commands = verdict.actuation
            while commands:
                self.guards.note_unsent(self.bridge.publish(commands))
                left -= 1.0
                if left < 0.0 or self._released or (interrupts and now - begin > _POSTPONED):
                    return
                now = self.clock.wait_until(now + self.period)
                self.bridge.poll()
                commands = self.guards.fall_back(now, self.bridge.sensed, at=now)

    @property
    def _released(self) -> bool:
        """Return whether the machine needs no fallback: it does without commands, or another publisher commands it."""
        try:
            released = self.released_by()
            if not isinstance(released, bool | np.bool_):  # The text "no" would count as true.
                raise TypeError(f"released_by returns True or False, not {released!r}")
        except FAILURES:
            released = False  # It does not confirm anything; the fallbacks go on.
            self._log_release(_log.exception, "released_by raised, so the machine is not taken for released")
        mode = self.bridge.robot_mode
        return released or (mode is not None and mode.is_released) or self.bridge.competing_publisher is not None

    @property
    def pace_problem(self) -> str | None:
        """Return the reason why the pace of the messages that begin cycles prevents a switch to real, or None.

        In lock-step it is known only after the switch, because the machine waits for commands.
        """
        return self._pace.problem

    def blocked_reason(self) -> str | None:
        """Return the reason why the machine must not be commanded (not ready, or out of reach), or None."""
        mode = self.bridge.robot_mode
        reason: object = self.bridge.blocked_reason or (mode and mode.blocked_reason) or self.blocked_by()
        if reason is None or isinstance(reason, str):
            return reason
        return f"blocked_by returns the reason as a text, or None, not {reason!r}"

    # -- switches

    def prepare(self, mode: str | None = None, *, sense: Positions = None, act: Positions = None) -> Preparation:
        """Check whether switches can be thrown (first phase), without changing anything.

        See `VirtualTestbed.switch` for the arguments.

        Args:
            mode: Mode for all switches: ``sim``, ``shadow``, ``real`` or ``twin``; None to name them one by one.
            sense: Position of the sensor switches, or positions by signal.
            act: Position of the actuator switches, or positions by signal.
        """
        return prepare(self, mode, sense=sense, act=act)

    def perform(self, preparation: Preparation) -> None:
        """Throw the switches of a preparation (second phase), before another cycle has run.

        Raises:
            SwitchRefusedError: The preparation has reasons against it, or is outdated, as there were cycles since.
        """
        if preparation.cycle != self.cycles:
            age = self.cycles - preparation.cycle
            raise SwitchRefusedError(f"the switch was prepared {age} cycles ago: prepare it again")
        if preparation.reasons:
            raise SwitchRefusedError("; ".join(preparation.reasons))
        perform(self, preparation.sense, preparation.act)

    def switch(self, mode: str | None = None, *, sense: Positions = None, act: Positions = None) -> None:
        """Prepare and perform a switch, see `prepare`. Call it in the thread that runs the cycles, or between cycles.

        Args:
            mode: Mode for all switches: ``sim``, ``shadow``, ``real`` or ``twin``; None to name them one by one.
            sense: Position of the sensor switches, or positions by signal.
            act: Position of the actuator switches, or positions by signal.

        Raises:
            SwitchRefusedError: There are reasons against the switch; nothing has changed.
        """
        self.perform(self.prepare(mode, sense=sense, act=act))

    def take_over(self, *, timeout: float = 60.0, report: Callable[[str], None] | None = None) -> None:
        """Run cycles until nothing prevents a switch to real, and switch; `run` goes on from there.

        Args:
            timeout: The time after which to give up, in seconds.
            report: Called with the reasons to wait, at first and then once per second; by default they are logged.

        Raises:
            SwitchRefusedError: Something still prevents the switch after ``timeout``.
            ValueError: The timeout is not a number.
        """
        if isnan(timeout):
            raise ValueError(f"timeout must be a number of seconds, not {timeout}")
        report = report or partial(_log.info, "waiting: %s")
        begin = self.clock.now()
        throttle = Throttle(self.clock)

        def is_on_real() -> bool:
            preparation = self.prepare("real")
            if not preparation.reasons:
                self.perform(preparation)
                return True
            waited = self.clock.now() - begin
            if waited >= timeout:
                raise SwitchRefusedError(f"after {waited:.1f} s: {'; '.join(preparation.reasons)}")
            throttle(report, "; ".join(preparation.reasons))
            return False

        # A machine in lock-step sends nothing while it is not commanded: the reasons may end without a cycle.
        self._run(None, None, until=is_on_real, meanwhile=is_on_real)
        if self.pace is not None:
            # At once: a machine in lock-step sends nothing new before it gets an actuator command.
            with self._interruptible:
                self.cycle()

    def request(self, action: Callable[[], Any]) -> Future[Any]:
        """Call ``action`` (a `switch`, a `write`) at the beginning of the next cycle. May be called from any thread.

        A change of the context by other means than the runtime's methods is not recorded: a replay would lack it. When
        the runtime is closed before the next cycle, the future is cancelled.
        """
        future: Future[Any] = Future()
        self._requests.append((action, future))
        if self._is_closed:
            self._cancel_requests()
        return future

    def _cancel_requests(self) -> None:
        with suppress(IndexError):  # Two threads may do so.
            while True:
                self._requests.popleft()[1].cancel()

    def _serve(self) -> None:
        if not self._requests:
            return
        while self._requests:
            action, future = self._requests.popleft()
            if not future.set_running_or_notify_cancel():
                continue
            try:
                future.set_result(action())
            except FAILURES as error:
                future.set_exception(error)
        self.read_switches()

    def reset(self) -> None:
        """Release the latch of the guards: the DPS's commands are sent again from the next cycle on.

        Raises:
            SwitchRefusedError: A cause of the latch persists, or a command would not continue what is measured.
        """
        against = discontinuities(self, self.guards.driven)
        reasons = self.guards.reset(self.clock.now(), self.watched, against)
        if reasons:
            raise SwitchRefusedError("; ".join(reasons))
        self.note_change(ChangeKind.RESET, {})


def _check_pace(bridge: Bridge, clock: Clock | None, *, period: float, pace: str | None, patience: float) -> None:
    if not (0.0 < as_number("the period of a loop", period) < inf):
        raise ValueError(f"the period of a loop is positive and finite, not {period} s")
    if pace is not None and pace not in bridge.sensed:
        raise ValueError(f"a loop is paced by a sensor signal ({', '.join(bridge.sensed)}), not by {pace!r}")
    if not (0.0 < as_number("the patience of a loop", patience) < inf):
        raise ValueError(f"the patience of a loop is a positive and finite number of periods, not {patience}")
    if pace is not None and bridge.real_time and isinstance(clock, SimulatedClock):
        raise ValueError(
            f"a loop paced by {pace!r} waits in real time, while a SimulatedClock stands still: "
            'let the clock begin the cycles (Deployment(pace="") or Runtime(pace=None)), or use a WallClock'
        )


def _check_fit(guards: Guards, statistics: LoopStatistics, interface: Interface, period: float) -> None:
    for part, its in (("guards", guards.period), ("statistics", statistics.period)):
        if its != period:
            raise ValueError(f"the {part} of this loop are made for a period of {its} s, not for {period} s")
    sides = (("actuator", guards.limiters, interface.act), ("sensor", guards.monitors, interface.sense))
    for side, guarded, signals in sides:
        names = [signal.name for signal in signals]
        if set(guarded) != set(names):
            raise ValueError(
                f"the guards of this loop are made for the {side} signals {', '.join(guarded) or 'none'}, but the DPS "
                f"has {', '.join(names) or 'none'}"
            )
