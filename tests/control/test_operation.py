"""How a DPS is run on its machine: what the scenario says of it, what is missing, and when it takes over."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import inf
from typing import Any

import numpy as np
import pytest

from tests.control.scripted import PERIOD, ScriptedBridge, ServoScenario
from tests.control.servo_machine import ServoMachineScenario
from vtbdrake.control.bridge import Bridge
from vtbdrake.control.clock import SimulatedClock
from vtbdrake.control.fallback import Hold
from vtbdrake.control.operation import Operation, OperationError, operation_of, take_over
from vtbdrake.control.runtime import Runtime
from vtbdrake.control.switching import SwitchRefusedError
from vtbdrake.testbed import DpsAlone

CONTINUITY = {"velocity": ("speed", 5.0)}


@dataclass
class Told(ServoScenario):
    """Says what it is given to say."""

    def operation(self) -> Any:
        return self.given

    given: Any = None


def told(operation: Any, **fields: Any) -> Told:
    scenario = Told(**fields)
    scenario.given = operation
    return scenario


class Machine:
    """What a bridge leads to: still, after some seconds of silence."""

    def __init__(self, operation: Operation, *, speaks_after: float = 0.0) -> None:
        scenario = told(operation)
        self.clock = SimulatedClock()

        def sensors(t: float) -> dict[str, Any]:
            return {"position": [0.05, 0.0], "speed": [0.3, 0.0]} if t >= speaks_after else {}

        self.bridge = ScriptedBridge(scenario.interface(), self.clock, sensors)
        self.runtime: Runtime = operation.runtime(DpsAlone(scenario), self.bridge, clock=self.clock)
        self.lines: list[str] = []

    def take_over(self, *, timeout: float = 10.0) -> None:
        take_over(self.runtime, timeout=timeout, tell=self.lines.append)


def test_a_scenario_need_not_say_anything_where_defaults_will_do() -> None:
    operation = operation_of(ServoScenario(rate=0.0))
    assert (operation.period, operation.continuity, operation.pace) == (1e-3, {}, "")


def test_a_limit_of_a_rate_has_to_depart_from_something_measured() -> None:
    with pytest.raises(OperationError) as error:
        operation_of(ServoScenario(rate=2.0))
    assert "continuity={'velocity': (sensor signal, largest difference)}" in str(error.value)
    assert "a method operation() that returns an Operation" in str(error.value)


@pytest.mark.parametrize(
    ("operation", "reason"),
    [
        ({"period": 1e-3}, "returns a vtbdrake.control.operation.Operation, not {'period': 0.001}"),
        (Operation(continuity={"velocity": ("velocity", 1.0)}), "not from 'velocity' to 'velocity'"),
        (Operation(continuity={"speed": ("speed", 1.0)}), "not from 'speed' to 'speed'"),
        (Operation(continuity=CONTINUITY, guards={"fallback": {"torque": Hold()}}), "fallback is given for torque"),
    ],
)
def test_what_does_not_fit_the_signals_is_refused(operation: Any, reason: str) -> None:
    with pytest.raises(OperationError) as error:
        operation_of(told(operation))
    assert reason in str(error.value)


def test_machine_whose_silence_nobody_would_notice_is_refused_outside_of_lock_step() -> None:
    interface = ServoScenario().interface()
    ageless = replace(interface, sense=[replace(signal, max_age=inf) for signal in interface.sense])
    operation = Operation(continuity=CONTINUITY)
    with pytest.raises(ValueError, match=r"no sensor signal has a max_age, .* \(position, speed\)"):
        operation.check(ageless)
    operation.check(interface)
    replace(operation, aging=False).check(ageless)


def test_period_and_pace_may_be_chosen() -> None:
    operation = operation_of(ServoMachineScenario(), period=0.002, pace="speed")
    assert (operation.period, operation.pace) == (0.002, "speed")
    assert operation.continuity == ServoMachineScenario().operation().continuity


def test_the_guards_are_those_that_are_asked_for() -> None:
    machine = Machine(Operation(continuity=CONTINUITY, guards={"fallback": {"velocity": Hold()}}))
    machine.take_over()
    machine.runtime.run(cycles=20)
    last = machine.bridge.sent[-1][1]["velocity"]
    machine.runtime.send_fallback("because")
    assert np.array_equal(machine.bridge.sent[-1][1]["velocity"], last)
    assert np.any(last != 0.0)


def test_a_machine_is_commanded_as_soon_as_it_speaks_from_what_is_measured() -> None:
    machine = Machine(Operation(continuity=CONTINUITY), speaks_after=0.5)
    machine.take_over()
    assert machine.clock.now() == pytest.approx(0.5, abs=2 * PERIOD)
    machine.runtime.run(cycles=1)
    [(_, first)] = machine.bridge.sent
    # A cycle's worth of the rate limit away from the measured speed; the DPS wants less.
    assert first["velocity"] == pytest.approx([0.3 - 2.0 * PERIOD, 0.0])
    assert "position" in machine.lines[0]


def test_a_machine_that_is_not_ready_is_waited_for() -> None:
    def ready(bridge: Bridge) -> str | None:
        return None if bridge.sensed["position"].count > 2500 else "its brakes are on"

    machine = Machine(Operation(continuity=CONTINUITY, ready=ready))
    machine.take_over()
    assert machine.clock.now() == pytest.approx(2.5, abs=2 * PERIOD)
    # At once, and then every second.
    assert machine.lines == ["the machine is not ready: its brakes are on"] * 3


def test_one_does_not_wait_for_ever() -> None:
    machine = Machine(Operation(continuity=CONTINUITY, ready=lambda bridge: "its brakes are on"))
    with pytest.raises(SwitchRefusedError, match=r"after 1\.5 s: the machine is not ready: its brakes are on"):
        machine.take_over(timeout=1.5)
    assert machine.bridge.sent == []
