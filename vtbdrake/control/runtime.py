"""Runs a DPS against the machine: the testbed as the controller, cycle by cycle."""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from functools import partial
from math import floor, inf, isnan
from typing import Any, Self

from pydrake.systems.framework import Context

from vtbdrake.control.bridge import Bridge
from vtbdrake.control.clock import Clock, WallClock
from vtbdrake.control.guards import Guards
from vtbdrake.control.slow_parts import SlowParts
from vtbdrake.control.statistics import LoopStatistics
from vtbdrake.control.stepping import RESET, Cycle, Stepped
from vtbdrake.control.switching import Preparation, SwitchRefusedError, check_continuity, discontinuities, prepare
from vtbdrake.testbed import DpsAlone, Interface, VirtualTestbed, slow_parts
from vtbdrake.testbed.interrupt import Interruptible

_log = logging.getLogger(__name__)

_TELL_EVERY = 1.0  # s, of what could be told in every cycle


class Runtime(Stepped):
    """Steps a testbed, or the DPS alone, once per period, with the machine on the other side of a bridge.

    A cycle takes in what has arrived, gives it to the DPS, steps it by one period, lets the guards look at its
    commands and sends them. The DPS's time is the number of cycles times the period, exactly: a cycle that is missed
    is left out and counted, it is never caught up with, so that no burst of old commands goes out.

    A testbed begins with its switches as they stand in ``context``; the DPS alone begins idle: it is stepped, and
    commands, from its switch to ``real`` on.

    The slow parts of the DPS work beside it, each in a process of its own, from the beginning until `close`, or the end
    of a ``with`` block.

    Args:
        target: what is stepped.
        bridge: open; it is polled and publishes in the thread that runs the cycles.
        period: of a cycle, in seconds.
        context: where the target begins; by default its defaults. It is the runtime's own from here on.
        clock: by default the wall clock, which wakes up 0.1 ms early; a `SimulatedClock` makes tests deterministic.
        guards: limits, watchdogs and fallbacks, made for the same period and signals; by default those that follow from
            the interface.
        pace: by default the clock; the name of a sensor signal lets every message of it begin a cycle (lock-step with
            the machine), or the clock, where none comes for ``patience`` periods. Where the machine tells a cycle in
            several messages, name a signal of the last one: a cycle begins with the first message that has the signal,
            and steps with the values that the later ones had a cycle ago.
        patience: in periods, see ``pace``. It has to cover the machine's jitter, and be shorter than the sensor
            signals' largest ages, so that a silent machine is noticed by a cycle. A paced loop that is held up for
            longer has missed cycles.
        continuity: actuator signal -> (sensor signal, largest difference): a switch to real is refused while they
            differ by more. Commands depart from that sensor signal, also after a time in which none left.
        ready: says why the machine is not ready to be commanded, or None.
        statistics: of the loop's timing.
        watchers: called with every `Cycle`; one that raises is left out from then on, and the loop goes on.

    Somebody else who commands the same machine as this loop is an alarm: it is logged and counted in the statistics. No
    signal is switched to real while somebody else is heard to command. Guards cannot keep him from it; a hub can, by
    protected channels.

    Attributes:
        cycles: how many there were.
        slow_parts: of the DPS, with their statistics.
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
        continuity: Mapping[str, tuple[str, float]] | None = None,
        ready: Callable[[], str | None] = lambda: None,
        statistics: LoopStatistics | None = None,
        watchers: tuple[Callable[[Cycle], None], ...] = (),
    ) -> None:
        if not (0.0 < period < inf):
            raise ValueError(f"the period of a loop is positive and finite, not {period} s")
        if pace is not None and pace not in bridge.sensed:
            raise ValueError(f"a loop is paced by a sensor signal ({', '.join(bridge.sensed)}), not by {pace!r}")
        if not (0.0 < patience < inf):
            raise ValueError(f"the patience of a loop is a positive and finite number of periods, not {patience}")
        self.continuity = dict(continuity or {})
        check_continuity(target.interface, self.continuity)
        super().__init__(target, bridge, period=period, context=context)
        self.clock = clock or WallClock(spin=1e-4)
        self.guards = guards or Guards(target.interface, period)
        self.statistics = statistics or LoopStatistics(period)
        _check_made_for(self.guards, self.statistics, target.interface, period)
        self.guards.measured_by = {name: sensor for name, (sensor, _) in self.continuity.items()}
        self.ready = ready
        self.cycles = 0
        self.pace = pace
        self._patience = patience * period
        self._watchers = list(watchers)
        self._requests: deque[tuple[Callable[[], Any], Future[Any]]] = deque()
        self._stop = threading.Event()
        self._foreign = bridge.foreign
        self._told_foreign = -inf
        self.slow_parts = SlowParts(
            slow_parts(target.diagram), self._context, period=period, clock=self.clock, changed=self.note_change
        )

    def close(self) -> None:
        """Ends the processes of slow parts; the last thing to do with it."""
        self.slow_parts.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def missed(self) -> int:
        """How many cycles were left out."""
        return self.statistics.misses

    # -- the loop

    def run(
        self,
        *,
        cycles: int | None = None,
        seconds: float | None = None,
        until: Callable[[], bool] = lambda: False,
    ) -> None:
        """Runs cycles until there were enough, or `stop` is called. Ctrl-C sends the fallback commands once.

        Args:
            cycles: how many.
            seconds: on the clock.
            until: asked after every cycle.

        Raises:
            ValueError: the seconds are no number, so that it would never end.
        """
        if seconds is not None and isnan(seconds):
            raise ValueError(f"a loop runs for a number of seconds, not for {seconds}")
        self._stop.clear()
        self.read_switches()
        begin = self.clock.now()
        deadline, done = begin, 0
        try:
            with Interruptible() as interruptible:
                while not self._stop.is_set():
                    if (cycles is not None and done >= cycles) or (seconds is not None and deadline - begin >= seconds):
                        return
                    due, lateness = self._await(deadline)
                    # One that is paced by messages has just taken them in.
                    self.cycle(lateness=lateness, poll=self.pace is None)
                    interruptible.check()
                    done += 1
                    if until():
                        return
                    deadline = self._next(due, lateness)
        except BaseException:
            self.send_fallback("the loop ended")
            raise

    def watch(self, watcher: Callable[[Cycle], None]) -> None:
        """Has a watcher called with every cycle from the next one on."""
        self._watchers.append(watcher)

    def unwatch(self, watcher: Callable[[Cycle], None]) -> None:
        """Leaves a watcher out from now on; one that is not there is left out already."""
        if watcher in self._watchers:
            self._watchers.remove(watcher)

    def stop(self) -> None:
        """Ends `run` after the present cycle; from any thread."""
        self._stop.set()

    def _await(self, deadline: float) -> tuple[float, float]:
        """Waits for the next cycle; gives when it was due, and how late it is."""
        if self.pace is None:
            # What has come by shortly before need not be taken in, and fed, when the cycle is due.
            return deadline, self.clock.wait_until(deadline, self._take_in) - deadline
        reception = self.bridge.sensed[self.pace]
        count, limit = reception.count, self.clock.now() + self._patience
        while reception.count == count:
            left = limit - self.clock.now()
            if left <= 0.0:
                break
            self.bridge.poll(left)
        woke = self.clock.now()
        return woke, max(woke - limit, 0.0)

    def _take_in(self) -> None:
        self.bridge.poll()
        self.feed()

    def _next(self, due: float, lateness: float) -> float:
        """The next deadline; those that have passed already are left out and counted."""
        now = self.clock.now()
        if self.pace is not None:
            # It has waited for a message until now, late or not, and worked since.
            self.statistics.miss(self._passed(lateness, now - due))
            return now
        # The one that is due just now can still be kept.
        behind = max(floor((now - due) / self.period), 0)
        self.statistics.miss(behind)
        return due + (behind + 1) * self.period

    def cycle(self, *, lateness: float = 0.0, poll: bool = True) -> Cycle:
        """One cycle, now.

        Args:
            lateness: how many seconds after it was due.
            poll: whether to take in first what has arrived.
        """
        begin = self.clock.now()
        if poll:
            self.bridge.poll()
        now = self.clock.now()
        self._serve()
        self.take_commands()
        self.feed()
        self.slow_parts.receive()
        active = self.active
        fed = self.clock.now()
        error, actuation = self.step()
        stepped = self.clock.now()
        verdict = self.guards.check(
            # As old as its samples are when it leaves, so old is a command: a long step makes them stale.
            stepped,
            self.watched,
            actuation,
            active,
            error=error,
            missed=self.statistics.run + self._passed(lateness, stepped - begin),
            blocked=self.blocked_reason() if active else None,
            others=self.bridge.sensed,
        )
        self.guards.note_unsent(self.bridge.publish(verdict.actuation) if verdict.actuation else ())
        self.slow_parts.send()
        if self.bridge.foreign != self._foreign:
            self._tell_foreign()
        self.statistics.record(lateness=lateness, step=stepped - fed, cycle=self.clock.now() - begin)
        changes, new = self.take_record()
        done = Cycle(self.cycles, self.time, now, changes, new, actuation, verdict)
        self.cycles += 1
        for watcher in self._watchers[:]:
            try:
                watcher(done)
            except (Exception, SystemExit):  # A failed assertion inside Drake arrives as SystemExit.
                _log.exception("a watcher of the loop raised, and is left out from now on")
                self._watchers.remove(watcher)
        return done

    def _passed(self, lateness: float, worked: float) -> int:
        """How many deadlines have passed before anything is sent: who slept for long wakes up to old messages, and who
        worked for long answers old ones. A paced loop may work for as long as its patience."""
        if self.pace is not None and worked <= self._patience:
            worked = 0.0
        return int((lateness + worked) / self.period)

    def _tell_foreign(self) -> None:
        """Counts commands of somebody else while this loop commands, and logs them once per second at most."""
        foreign, now = self.bridge.foreign, self.clock.now()
        new, self._foreign = foreign - self._foreign, foreign
        if not self.active:
            return  # Who only listens hears the one who commands.
        self.statistics.foreign += new
        if now - self._told_foreign >= _TELL_EVERY:
            self._told_foreign = now
            who = self.bridge.competing_publisher or "somebody else publishes commands"
            _log.error("ALARM: %s (heard so far: %d)", who, self.statistics.foreign)

    def send_fallback(self, reason: str) -> None:
        """Latches the guards and sends the fallback commands once: the farewell of who ends the loop."""
        verdict = self.guards.latch(reason, self.clock.now(), self.watched)
        # The guards know what was on real in the last cycle, and give nothing for a signal that has not been commanded.
        farewell = {name: command for name, command in verdict.actuation.items() if name in self.active}
        if farewell:
            self.bridge.publish(farewell)

    def blocked_reason(self) -> str | None:
        """Why the machine is not to be commanded at present: it is not ready, or somebody else commands it."""
        return self.bridge.blocked_reason or self.ready()

    # -- switches

    def prepare(self, mode: str | None = None, **sides: Any) -> Preparation:
        """First phase: whether switches (as of `VirtualTestbed.switch`) can be thrown; changes nothing."""
        return prepare(self, mode, **sides)

    def perform(self, preparation: Preparation) -> None:
        """Second phase: throws the switches of a preparation that has nothing against it, between the same two cycles.

        Raises:
            SwitchRefusedError: it has, or there were cycles since: who knows what speaks against it now.
        """
        if preparation.cycle != self.cycles:
            age = self.cycles - preparation.cycle
            raise SwitchRefusedError(f"the switch was prepared {age} cycles ago: prepare it anew")
        if preparation.reasons:
            raise SwitchRefusedError("; ".join(preparation.reasons))
        preparation.perform()

    def switch(self, mode: str | None = None, **sides: Any) -> None:
        """Both phases at once, in the thread that runs the cycles, or between them.

        Raises:
            SwitchRefusedError: something speaks against it; nothing has changed.
        """
        self.perform(self.prepare(mode, **sides))

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
        reported = -inf

        def taken() -> bool:
            nonlocal reported
            preparation = self.prepare("real")
            if not preparation.reasons:
                self.perform(preparation)
                return True
            waited = self.clock.now() - begin
            if waited >= timeout:
                raise SwitchRefusedError(f"after {waited:.1f} s: {'; '.join(preparation.reasons)}")
            if waited >= reported + _TELL_EVERY:
                reported = waited
                report("; ".join(preparation.reasons))
            return False

        self.run(until=taken)
        if self.pace is not None:
            # At once: a machine in lock-step sends nothing new before it gets an actuator command.
            self.cycle()

    def request(self, action: Callable[[], Any]) -> Future[Any]:
        """Has ``action`` (a `switch`, a `write`) done at the beginning of the next cycle; from any thread.

        What changes the context by other means than the runtime's own is not recorded: a replay would lack it.
        """
        future: Future[Any] = Future()
        self._requests.append((action, future))
        return future

    def _serve(self) -> None:
        if not self._requests:
            return
        while self._requests:
            action, future = self._requests.popleft()
            if not future.set_running_or_notify_cancel():
                continue
            try:
                future.set_result(action())
            except (Exception, SystemExit) as error:  # A failed assertion inside Drake arrives as SystemExit.
                future.set_exception(error)
        self.read_switches()

    def reset(self) -> None:
        """Releases the latch of the guards; the DPS's commands go out again from the next cycle on.

        Raises:
            SwitchRefusedError: what they latched for is still there, or a command would not continue what is measured,
                as at a switch to real.
        """
        against = discontinuities(self, self.guards.driven)
        reasons = self.guards.reset(self.clock.now(), self.watched, against)
        if reasons:
            raise SwitchRefusedError("; ".join(reasons))
        self.note_change(RESET, {})


def _check_made_for(guards: Guards, statistics: LoopStatistics, interface: Interface, period: float) -> None:
    """
    Raises:
        ValueError: they are those of a loop with another period, or of another DPS.
    """
    for what, its in (("guards", guards.period), ("statistics", statistics.period)):
        if its != period:
            raise ValueError(f"the {what} of this loop are made for a period of {its} s, and it has {period} s")
    sides = (("actuator", guards.limiters, interface.act), ("sensor", guards.monitors, interface.sense))
    for side, guarded, signals in sides:
        names = [signal.name for signal in signals]
        if set(guarded) != set(names):
            raise ValueError(
                f"the guards of this loop are made for the {side} signals {', '.join(guarded) or 'none'}, and its DPS "
                f"has {', '.join(names) or 'none'}"
            )
