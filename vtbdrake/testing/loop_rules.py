"""The rules that a control loop keeps with any machine, whatever happens to messages, machine and clock."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from math import inf
from typing import Any

import numpy as np

from vtbdrake.control.fault import FaultKind
from vtbdrake.control.guards import MOST_UNSENT
from vtbdrake.control.runtime import Runtime
from vtbdrake.control.stepping import Cycle
from vtbdrake.testbed import Signal, VirtualTestbed
from vtbdrake.testbed.switch import Position
from vtbdrake.testing.lock_step import MachineBridge

_ROUNDING = 1e-9  # relative, of times and of changes that are compared with limits

DPS_FAULTS = (FaultKind.RAISED, FaultKind.NOT_FINITE, FaultKind.SIZE, FaultKind.MISSING)
"""Kinds of faults that a DPS must not have, whatever plausible samples it gets."""


class WatchedBridge(MachineBridge):
    """A bridge to a machine in the same process, on which `LoopRules` see what leaves."""

    rules: LoopRules | None = None

    def publish(self, actuation: Mapping[str, Any]) -> Collection[str]:
        unsent = super().publish(actuation)
        if self.rules is not None:
            self.rules.judge_commands({name: value for name, value in actuation.items() if name not in unsent})
        return unsent


class LoopRules:
    """The rules that a loop keeps with any machine; they are computed from what was sent and received alone.

    1. A command is finite and within the limits of its signal, and changes by at most its rate times the time since the
       last one that left. Where it departs anew (after a switch, or after a silence) it does so from what is measured,
       by at most its rate in a period.
    2. The DPS's commands are sent only while the newest sample of every signal that it gets from the machine is fresh;
       else, the fallbacks command, until a reset.
    3. Nothing is sent of a signal that is not on real, after the fallbacks have had their ``leave_time``.
    4. The DPS does not raise, and all its commands are finite, whatever plausible samples it gets.

    Args:
        runtime: The loop.
        bridge: Its bridge.

    Attributes:
        violations: What was against a rule so far, as sentences.
    """

    def __init__(self, runtime: Runtime, bridge: WatchedBridge) -> None:
        self.violations: list[str] = []
        self._runtime = runtime
        self._bridge = bridge
        self._signals = {signal.name: signal for signal in bridge.interface.act}
        self._last: dict[str, tuple[float, np.ndarray, int]] = {}  # (time, command, number of the cycle)
        self._left: dict[str, int] = {}  # The cycle in which a signal left real.
        self._on_real: set[str] = set()
        self._departing: set[str] = set()  # The signals that have sent nothing since they went to real.
        self._latched = False
        bridge.rules = self
        runtime.watch(self._judge_cycle)

    def note_switch(self) -> None:
        """Take note of the positions of the switches, after one may have been thrown."""
        on_real = self._acts_on_real()
        for name in self._on_real - on_real:
            self._left[name] = self._runtime.cycles
        self._departing |= on_real - self._on_real
        self._on_real = on_real

    def note_reset(self) -> None:
        """Take note that the guards have been reset."""
        self._latched = False

    def _positions(self) -> dict[str, dict[str, str]]:
        target = self._runtime.target
        if isinstance(target, VirtualTestbed):
            return target.positions(self._runtime.context)
        position = Position.SIM if self._runtime.idle else Position.REAL
        sides = {"sense": target.interface.sense, "act": target.interface.act}
        return {side: dict.fromkeys([s.name for s in signals], position.value) for side, signals in sides.items()}

    def _acts_on_real(self) -> set[str]:
        return {name for name, position in self._positions()["act"].items() if position != Position.SIM}

    def judge_commands(self, actuation: Mapping[str, Any]) -> None:
        """Judge commands that leave now."""
        now = self._runtime.clock.now()
        leave_cycles = self._runtime.guards.leave_time / self._runtime.period + 1
        for name, command in actuation.items():
            signal = self._signals[name]
            left = self._runtime.cycles - self._left.get(name, -inf)
            if name not in self._on_real and left > leave_cycles:
                self._violation(f"a command {name} is sent, which has not been on real for {left:g} cycles")
            if signal.is_vector:
                self._judge_vector(signal, np.asarray(command, float), now)

    def _judge_vector(self, signal: Signal, command: np.ndarray, now: float) -> None:
        name = signal.name
        lower, upper = signal.vector(signal.lower), signal.vector(signal.upper)
        if not ((command >= lower) & (command <= upper) & np.isfinite(command)).all():
            self._violation(f"{name} = {command} is not within its limits, {lower} to {upper}")
        if np.isfinite(signal.vector(signal.rate)).any():
            self._judge_change(signal, command, now)

    def _judge_change(self, signal: Signal, command: np.ndarray, now: float) -> None:
        name, period, cycle = signal.name, self._runtime.period, self._runtime.cycles
        departs = name in self._departing
        self._departing.discard(name)
        last, self._last[name] = self._last.get(name), (now, command, cycle)
        seconds = inf if last is None else now - last[0]
        if last is not None and self._reaches(command, last[1], signal, seconds):
            return
        sensor, _ = self._runtime.continuity.get(name, ("", None))
        silent = last is None or cycle - last[2] > MOST_UNSENT or seconds > MOST_UNSENT * period
        if (departs or silent) and sensor:
            measured = np.clip(self._bridge.sensed[sensor].value, signal.lower, signal.upper)
            if not self._reaches(command, measured, signal, period):
                self._violation(f"{name} = {command} does not depart from {sensor} = {measured}, within its rate")
        elif last is not None:
            self._violation(f"{name} goes from {last[1]} to {command} in {seconds:.6g} s, beyond its rate")

    @staticmethod
    def _reaches(command: np.ndarray, start: np.ndarray, signal: Signal, seconds: float) -> bool:
        """Return whether a command lies within the rate of its signal from ``start``."""
        allowed = np.asarray(signal.rate) * seconds * (1.0 + _ROUNDING) + _ROUNDING * np.abs(command)
        return bool((np.abs(command - start) <= allowed).all())

    def _judge_cycle(self, cycle: Cycle) -> None:
        verdict = cycle.verdict
        for fault in verdict.faults:
            if fault.kind in DPS_FAULTS:
                self._violation(fault.reason)
        if not self._on_real:
            return
        if verdict.ok and self._latched:
            self._violation("the DPS commands again after a fault, without a reset")
        self._latched = self._latched or not verdict.ok
        if not verdict.ok:
            return
        now = self._runtime.clock.now()
        positions = self._positions()["sense"]
        for signal in self._bridge.interface.sense:
            age = self._bridge.sensed[signal.name].age(now)
            if positions[signal.name] == Position.REAL and age > signal.max_age * (1.0 + _ROUNDING):
                self._violation(
                    f"the DPS commands, although {signal.name} is {age:.6g} s old, and {signal.max_age:g} s are allowed"
                )

    def _violation(self, text: str) -> None:
        self.violations.append(f"cycle {self._runtime.cycles}, t = {self._runtime.clock.now():.6g} s: {text}")
