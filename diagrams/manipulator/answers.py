"""Row C1 of the table of answers: the tracking error of the arm on the machine and in simulation."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.framework import Context

from vtbdrake.control.bridge import Bridge
from vtbdrake.control.clock import SimulatedClock
from vtbdrake.control.runtime import Runtime
from vtbdrake.control.stepping import Cycle
from vtbdrake.lcm.hub import Hub
from vtbdrake.lcm.protocol import protocol_of
from vtbdrake.machine import MachineProcess
from vtbdrake.testbed import DpsAlone, VirtualTestbed
from vtbdrake_diagrams.answers import Answer
from vtbdrake_diagrams.manipulator.scenario import ManipulatorScenario
from vtbdrake_diagrams.manipulator.trials import DURATIONS, PROGRAM, Track, Trial, rms, run_trial, trial_scenario

LAWS = {"impedance": "cartesian_impedance", "admittance": "admittance"}

# Masses, friction and other parameters of the machine differ from those of the simulation.
PERTURB, SEED = 0.05, 7

# The largest tracking error of the tip on the machine, RMS, in m; and its largest ratio to the error in simulation.
TOLERANCE, RATIO = 0.005, 2.0

# Cycles for which the whole testbed commands the machine, in the short version.
COMPARED = 3000

# The time to wait for the next message of the machine, which begins a cycle, in s.
PATIENCE = 60.0


@dataclass
class Trials:
    """Results of one control law: the same motions in simulation, and on the machine by the DPS alone.

    Attributes:
        simulated, real: The tracks in simulation and on the machine.
        compared: The number of cycles in which the whole testbed commanded a machine of its own.
        identical: Whether the DPS alone sent the same actuator commands in these cycles, bit for bit.
        latched: The faults for which the guards latched; empty if they did not.
    """

    simulated: Track
    real: Track
    compared: int
    identical: bool
    latched: str


def control(full: bool) -> Answer:
    """Measure how well the arm tracks its motions, on the machine and in simulation.

    The loop runs in lock-step with the machine, so the answer does not depend on the load of this computer. The short
    version compares testbed and DPS alone in the first `COMPARED` cycles, the long one in all.
    """
    trials = {name: _trials(law, full) for name, law in LAWS.items()}
    errors = {name: (rms(trial.simulated.errors()), rms(trial.real.errors())) for name, trial in trials.items()}
    followed = all(real <= min(TOLERANCE, RATIO * simulated) for simulated, real in errors.values())
    commanded = all(trial.identical and not trial.latched for trial in trials.values())
    cycles = sum(trial.compared for trial in trials.values())
    same = "identical" if all(trial.identical for trial in trials.values()) else "DIFFERENT"
    latched = "; ".join(trial.latched for trial in trials.values() if trial.latched)
    return Answer(
        id="C1",
        question="How well does an arm follow its motions when the switches of its testbed are thrown to the machine?",
        answer=", ".join(f"{name} {1e3 * real:.2f} mm" for name, (_, real) in errors.items()),
        unit="(RMS of the tip, machine)",
        interval=None,
        paper="done with a real arm, 1 ms; no figures",
        holds=followed and commanded,
        note=(
            "in simulation "
            + ", ".join(f"{name} {1e3 * simulated:.2f} mm" for name, (simulated, _) in errors.items())
            + f"; the machine is perturbed by up to {PERTURB:.0%}. Commands of testbed and DPS alone: {same} in "
            + f"{cycles} cycles. "
            + (f"The guards latched: {latched}." if latched else "The guards never latched.")
        ),
    )


def _trials(law: str, full: bool) -> Trials:
    scenario = trial_scenario(law)
    testbed, alone = scenario.build(), DpsAlone(scenario)
    context = testbed.default_context()
    testbed.write(context, DURATIONS)
    with Hub(port=0, protect=["IIWA_COMMAND"]) as hub:
        bridge = _bridge(scenario, hub)
        simulation = Runtime(testbed, bridge, context=context, clock=SimulatedClock())
        simulated = run_trial(simulation)
        bridge.close()
        stripped = alone.continue_from(testbed, simulation.context)
        with _Real(scenario, hub, testbed, simulation.context) as whole:
            whole.loop.run(until=Trial(whole.loop, PROGRAM), cycles=None if full else COMPARED)
        with _Real(scenario, hub, alone, stripped) as real:
            track = run_trial(real.loop)
    compared = min(len(whole.commands), len(real.commands))
    return Trials(
        simulated,
        track,
        compared,
        np.array_equal(whole.commands[:compared], real.commands[:compared]),
        "; ".join(fault.reason for fault in (*whole.loop.guards.latched, *real.loop.guards.latched)),
    )


def _bridge(scenario: ManipulatorScenario, hub: Hub) -> Bridge:
    bridge = protocol_of(scenario).bridge(scenario.interface(), hub.url)
    bridge.open()
    return bridge


class _Real:
    """A machine and a loop in lock-step with it, whose switches are on real.

    Attributes:
        loop: The loop; the machine waits for its next actuator command.
        commands: All torques that were sent, shape (7,) each.
    """

    def __init__(
        self, scenario: ManipulatorScenario, hub: Hub, target: VirtualTestbed | DpsAlone, context: Context
    ) -> None:
        self.commands: list[NDArray[np.float64]] = []
        self._bridge = _bridge(scenario, hub)
        self._machine = MachineProcess(scenario, hub.url, lock_step=True, perturb=PERTURB, seed=SEED)
        deployment = scenario.deployment().in_lock_step("wrench", wait=PATIENCE)
        self.loop = deployment.runtime(target, self._bridge, context=context, watchers=(self._collect,))

    def __enter__(self) -> _Real:
        self._machine.start()
        deadline = time.monotonic() + PATIENCE
        while not all(received.count for received in self._bridge.sensed.values()):
            if time.monotonic() > deadline:
                raise TimeoutError(f"the machine has not sent its state within {PATIENCE:g} s")
            self._bridge.poll(1.0)
        self.loop.switch("real")
        # The first actuator command begins the exchange.
        self.loop.cycle()
        return self

    def __exit__(self, *_: object) -> None:
        self._machine.close()
        self._bridge.close()

    def _collect(self, cycle: Cycle) -> None:
        self.commands.append(cycle.verdict.actuation["joint_torque"].copy())
