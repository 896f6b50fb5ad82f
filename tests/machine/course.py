"""A loop with its simulated machine in lock-step, and what acts in every cycle."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from vtbdrake.control.fault import FaultKind
from vtbdrake.control.runtime import Runtime
from vtbdrake.machine.injected_faults import Drop
from vtbdrake.machine.machine import Machine
from vtbdrake.machine.machine_process import MachineProcess
from vtbdrake.testbed import DpsAlone, Scenario, WorldAlone
from vtbdrake.testing.lock_step import LockStep
from vtbdrake_diagrams.cart_pole import CartPoleScenario
from vtbdrake_diagrams.manipulator import ManipulatorScenario
from vtbdrake_diagrams.satellite import SatelliteScenario
from vtbdrake_diagrams.station import FILE, HOME, ArmStation

_TIMEOUT = 60.0  # s on the clock of the loop, to take over


class Built:
    """The world and the DPS of a scenario, built once: each loop has contexts of its own."""

    def __init__(self, scenario: Scenario) -> None:
        self.scenario, self.world, self.dps = scenario, WorldAlone(scenario), DpsAlone(scenario)


SCENARIOS: dict[str, Scenario] = {
    "free": ManipulatorScenario(),
    "wall": ManipulatorScenario(wall=True),
    "cart_pole": CartPoleScenario(),
    "satellite": SatelliteScenario(perception="pose_sensor"),
    **{key: ArmStation(f"{FILE}#{key}") for key in ("Torque", "Position", "PositionAndTorque")},
}


@cache
def built(name: str) -> Built:
    """Return one of the scenarios, built."""
    return Built(SCENARIOS[name])


class Course:
    """A loop with its machine, and what acts and how fast the joints are in every cycle.

    Args:
        runtime: The loop, which has not taken over yet.
        machine: Its machine.
        signal: The actuator signal that is observed.
        velocity: The sensor signal with the speeds of the joints; empty for none.
    """

    def __init__(self, runtime: Runtime, machine: Machine | MachineProcess, signal: str, velocity: str = "") -> None:
        self.runtime, self.machine = runtime, machine
        (declared,) = (s for s in runtime.target.interface.act if s.name == signal)
        self.step, self._idle = declared.vector(declared.rate) * runtime.period, declared.vector(declared.idle)
        self._acting: list[np.ndarray] = []
        self._speeds: list[np.ndarray] = []
        reports = runtime.bridge.reported[signal]
        velocities = runtime.bridge.sensed[velocity] if velocity else None

        def note(_: Any) -> None:
            self._acting.append(np.array(reports.value))
            if velocities is not None:
                self._speeds.append(np.abs(velocities.value))

        runtime.take_over(timeout=_TIMEOUT)
        runtime.watch(note)

    @property
    def latched(self) -> list[FaultKind]:
        return [fault.kind for fault in self.runtime.guards.latched]

    @property
    def cycles(self) -> int:
        return len(self._acting)

    @property
    def acting(self) -> np.ndarray:
        """Return the commands that acted, by cycle, shape (cycles, size)."""
        return np.array(self._acting)

    def run(self, seconds: float) -> None:
        self.runtime.run(cycles=round(seconds / self.runtime.period))

    def lose(self, seconds: float) -> None:
        """Let no command arrive for a while."""
        self.machine.begin(Drop(side="act"))
        self.run(seconds)
        self.machine.end_faults()

    def largest_step(self, begin: int) -> float:
        """Return the largest step of what acts since a cycle, as a multiple of the allowed one.

        The step to the idle command is the machine's own, when it brakes.
        """
        acting = np.array(self._acting[begin - 1 :])
        own = (acting[1:] == self._idle).all(axis=1)
        return float((np.abs(np.diff(acting, axis=0)) / self.step)[~own].max(initial=0.0))

    def speed(self, begin: int = 0, end: int | None = None) -> float:
        """Return the largest speed of a joint in some cycles, in rad/s."""
        return float(np.array(self._speeds[begin:end]).max())


def course(name: str, signal: str, velocity: str = "", *, compared: bool = True) -> Course:
    """Return the course of a loop and its machine in this process, without a bus.

    Args:
        name: The name of the scenario.
        signal: As in `Course`.
        velocity: As in `Course`.
        compared: Whether the guards compare what acts with what was sent.
    """
    parts = built(name)
    loop = LockStep(parts.scenario, world=parts.world, target=parts.dps)
    if not compared:
        loop.runtime.guards.reported = {}
    return Course(loop.runtime, loop.machine, signal, velocity)


def station(key: str) -> Course:
    """Return the course of a station's arm amid a motion.

    Args:
        key: The name of the station.
    """
    signal = "iiwa_torque" if key == "Torque" else "iiwa_position"
    arm = course(key, signal, "iiwa_velocity_estimated")
    arm.run(0.1)
    arm.runtime.write({"u.target": HOME + 0.3})
    arm.run(0.7)
    return arm
