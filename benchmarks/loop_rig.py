"""The full loop as it is measured: hub, machine and controller, each in a process of its own."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from math import inf
from typing import Any

from vtbdrake.control.bridge import Bridge
from vtbdrake.control.guards import Guards
from vtbdrake.control.realtime import RealTime
from vtbdrake.control.runtime import Runtime
from vtbdrake.control.stepping import Cycle
from vtbdrake.lcm.hub import Hub
from vtbdrake.lcm.protocol import protocol_of
from vtbdrake.machine import MachineProcess
from vtbdrake.testbed import DpsAlone, Scenario, VirtualTestbed
from vtbdrake_diagrams.manipulator import ManipulatorScenario
from vtbdrake_diagrams.manipulator.arm import JOINTS
from vtbdrake_diagrams.manipulator.safety import CONTINUITY

HUB_PRIORITY, PRIORITY, MACHINE_PRIORITY = 72, 75, 70
"""Priorities of SCHED_FIFO; the second is the controller's, the bare C loop's and the echo's."""

# Hub and controller share a processor, so that a command need not wake up another one. The others are the machine's.
CPUS = {max(os.sched_getaffinity(0))}

PERIOD = 1e-3  # s
WARM_UP = 200  # cycles before each round that do not count
PATIENCE = 1.0  # s that a sensor signal may be old
# Damping of the machine's joints in N m s/rad: so large that a stall of the loop has no consequences.
FRICTION = {"sim.act.drives.viscous": [40.0] * JOINTS}


class TimedRuntime(Runtime):
    """A loop that records the times of its cycles, measured from outside.

    Attributes:
        overheads: Time of each cycle, from its call to its return, less the DPS's step, in seconds.
        commanded: Time from each cycle's deadline until its commands had left, in seconds.
        lateness: Time from each cycle's deadline to its end, after all watchers were called, in seconds.
        worked: Processor time of the loop's thread in all these cycles, and while it waited for them, in seconds.
    """

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self.overheads: list[float] = []
        self.commanded: list[float] = []
        self.lateness: list[float] = []
        self.worked = 0.0

    def cycle(self, *, due: float | None = None, lateness: float = 0.0, poll: bool = True) -> Cycle:
        steps, cycles = self.statistics.histograms["step"], self.statistics.histograms["cycle"]
        stepped, cycled, begin = steps.total, cycles.total, self.clock.now()
        done = super().cycle(due=due, lateness=lateness, poll=poll)
        took = self.clock.now() - begin
        self.overheads.append(took - (steps.total - stepped))
        self.commanded.append(lateness + cycles.total - cycled)
        self.lateness.append(lateness + took)
        return done


@dataclass(frozen=True)
class Rig:
    """A machine that runs, and the bridge to it. Several runtimes share the bridge and take turns."""

    scenario: Scenario
    hub: Hub
    machine: MachineProcess
    bridge: Bridge
    real_time: RealTime

    def runtime(self, target: VirtualTestbed | DpsAlone, *, pace: str | None = None) -> TimedRuntime:
        """Return a loop that is switched to real: it commands the machine from its next cycle on."""
        self.drain()
        # How long the system holds up the loop is to be measured: it must not end the measurement.
        patient = [replace(signal, max_age=PATIENCE) for signal in target.interface.sense]
        interface = replace(target.interface, sense=patient)
        guards = Guards(interface, PERIOD, max_missed=inf, pace_tolerance=inf)
        runtime = TimedRuntime(target, self.bridge, period=PERIOD, pace=pace, continuity=CONTINUITY, guards=guards)
        runtime.run(cycles=WARM_UP)
        runtime.switch("real")
        return runtime

    def run(self, runtime: TimedRuntime, cycles: int) -> int:
        """Run one round of a loop, after a warm-up that is not counted; return the number of missed deadlines.

        Raises:
            RuntimeError: The guards have latched: the DPS did not command the machine while it was measured.
        """
        self.drain()
        runtime.run(cycles=WARM_UP)
        self.machine.reset_statistics()
        runtime.overheads.clear()
        runtime.commanded.clear()
        runtime.lateness.clear()
        missed, worked = runtime.statistics.misses, time.thread_time()
        runtime.run(cycles=cycles)
        runtime.worked = time.thread_time() - worked
        if runtime.guards.latched:
            raise RuntimeError(f"the loop ended in a safe stop: {runtime.guards.latched[0]}")
        return runtime.statistics.misses - missed

    def drain(self) -> None:
        """Receive messages until none arrives for a quarter of a period."""
        while self.bridge.poll(PERIOD / 4):
            pass

    def granted(self) -> str:
        """Return a text with the scheduling priorities of hub, machine and controller."""
        pids = {"hub": self.hub.pid, "machine": self.machine.pid, "controller": 0}
        refused = [grant.request for grant in self.real_time.grants if not grant.granted]
        priorities = ", ".join(f"{name} {_priority(pid)}" for name, pid in pids.items())
        return f"{priorities}" + (f"; refused: {', '.join(refused)}" if refused else "")


def _priority(pid: int) -> str:
    policy = os.sched_getscheduler(pid) & ~os.SCHED_RESET_ON_FORK
    return f"SCHED_FIFO {os.sched_getparam(pid).sched_priority}" if policy == os.SCHED_FIFO else "without SCHED_FIFO"


@contextmanager
def loop_rig() -> Iterator[Rig]:
    """Hub and machine run within; this thread is a real-time one, as far as the system grants it."""
    scenario = ManipulatorScenario()
    with Hub(port=0, priority=HUB_PRIORITY, cpus=CPUS) as hub:
        bridge = protocol_of(scenario).bridge(scenario.interface(), hub.url)
        machine_process = MachineProcess(scenario, hub.url, priority=MACHINE_PRIORITY, period=PERIOD, values=FRICTION)
        with machine_process as machine:
            bridge.open()
            try:
                with RealTime(priority=PRIORITY, cpus=CPUS) as real_time:
                    yield Rig(scenario, hub, machine, bridge, real_time)
            finally:
                bridge.close()
