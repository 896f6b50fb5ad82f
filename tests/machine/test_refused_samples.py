"""A sensor signal whose samples are refused does not hold up a loop, and is a fault when it happens again and again."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import pytest

from tests.machine.robot import RobotScenario
from vtbdrake.control.fault import FaultKind
from vtbdrake.deployment import Deployment
from vtbdrake.lcm.hub import Hub
from vtbdrake.machine import MachineProcess
from vtbdrake.machine.injected_faults import Corrupt
from vtbdrake.testbed import Interface
from vtbdrake.testing.lock_step import LockStep

LIMIT = 0.5  # rad/s, which the elbow exceeds after a while
MOVING = {"sim.sys.Acrobot.elbow.position": 1.0}


@dataclass
class NarrowScenario(RobotScenario):
    """The acrobot, whose DPS declares speeds that its robot exceeds."""

    def interface(self) -> Interface:
        interface = super().interface()
        position, velocity = interface.sense
        velocity = replace(velocity, lower=-LIMIT, upper=LIMIT)
        return replace(interface, sense=[replace(position, max_age=1.0), velocity])


def check_fault(runtime: Any) -> None:
    (fault,) = runtime.guards.latched
    assert (fault.kind, fault.signal) == (FaultKind.IMPLAUSIBLE, "velocity")
    # More than ten in a row.
    refused = runtime.bridge.sensed["velocity"].refused
    assert refused == 11
    assert "velocity is refused again and again, 11 times so far: velocity[" in fault.reason
    assert f"its limit {LIMIT}" in fault.reason or f"its limit {-LIMIT}" in fault.reason


def test_signal_that_is_refused_again_and_again_latches() -> None:
    with LockStep(NarrowScenario()) as loop:
        loop.machine.write(MOVING)
        loop.runtime.take_over(timeout=1.0)
        loop.runtime.run(cycles=2000, until=lambda: bool(loop.runtime.guards.latched))
        check_fault(loop.runtime)


def test_refused_sample_of_the_pace_signal_does_not_stop_a_loop_in_lock_step() -> None:
    scenario = NarrowScenario()
    deployment = Deployment.of(scenario).in_lock_step("velocity")
    with (
        Hub(port=0) as hub,
        MachineProcess(scenario, hub.url, lock_step=True, values=MOVING) as machine,
        scenario.deploy(hub.url, deployment=deployment) as runtime,
    ):
        runtime.take_over(timeout=30.0)
        runtime.run(cycles=2000, until=lambda: bool(runtime.guards.latched))
        check_fault(runtime)
        runtime.run(cycles=20)  # The fallback commands it; each cycle is one of the machine.
        sent = runtime.bridge.sent["torque"].count  # type: ignore[attr-defined]
        assert sent == runtime.cycles - 1  # all but the one before the switch
        machine.until(lambda status: status.cycle == sent)


@pytest.mark.parametrize("kind", ["nan", "type"])
def test_damaged_messages_do_not_stop_a_loop_in_lock_step(kind: str) -> None:
    with LockStep(NarrowScenario()) as loop:
        deployment = loop.deployment.in_lock_step("velocity")
        runtime = deployment.runtime(loop.runtime.target, loop.bridge, context=loop.runtime.context, clock=loop.clock)
        runtime.take_over(timeout=1.0)
        runtime.run(cycles=5)
        cycles = loop.machine.cycle
        loop.machine.begin(Corrupt(kind=kind))
        runtime.run(cycles=8)
        assert loop.machine.cycle == cycles + 8
        assert len(runtime.guards.latched) == 0
        runtime.run(cycles=8)
        assert [fault.signal for fault in runtime.guards.latched] == ["position", "velocity"]
