"""How a DPS is run on its machine."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import pytest

from tests.control.scripted import PERIOD, ScriptedBridge, ServoScenario
from vtbdrake.control.clock import SimulatedClock
from vtbdrake.control.operation import Operation, take_over
from vtbdrake.control.runtime import Runtime
from vtbdrake.testbed import DpsAlone

OPERATION = Operation(period=PERIOD, continuity={"velocity": ("speed", 5.0)})
PAUSE = 1.0


def waking_up(t: float) -> Mapping[str, Any]:
    """Nothing is sensed before the end of a pause, longer than any signal may be old."""
    return {} if t < PAUSE else {"position": [0.05, 0.0], "speed": [0.0, 0.0]}


def make(operation: Operation) -> tuple[Runtime, ScriptedBridge, SimulatedClock]:
    dps, clock = DpsAlone(ServoScenario()), SimulatedClock()
    bridge = ScriptedBridge(dps.interface, clock, waking_up)
    return operation.runtime(dps, bridge, clock=clock), bridge, clock


def test_in_lock_step_a_message_begins_a_cycle_however_late_it_comes() -> None:
    runtime, _, clock = make(OPERATION.in_lock_step("position"))
    runtime.run(cycles=1)
    assert clock.now() == pytest.approx(PAUSE, abs=2 * PERIOD)


def test_in_lock_step_nobody_waits_for_ever() -> None:
    runtime, _, clock = make(OPERATION.in_lock_step("position", wait=0.5))
    runtime.run(cycles=1)
    assert clock.now() == pytest.approx(0.5, abs=2 * PERIOD)


@pytest.mark.parametrize(("operation", "latched"), [(OPERATION.in_lock_step("position"), False), (OPERATION, True)])
def test_in_lock_step_nothing_grows_old(operation: Operation, latched: bool) -> None:
    runtime, bridge, clock = make(operation)
    take_over(runtime, timeout=2 * PAUSE)
    bridge.sensors = lambda t: {}
    clock.advance(PAUSE)
    runtime.cycle()
    assert bool(runtime.guards.latched) == latched
