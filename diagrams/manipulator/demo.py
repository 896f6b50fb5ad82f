"""``make demo-control``: an arm in simulation, in shadow mode and on a machine, which is killed and restarted."""

from __future__ import annotations

import logging
import os
import signal
import socket
import time
from contextlib import closing, suppress
from dataclasses import replace
from typing import Any

import click
import numpy as np

from vtbdrake.cli.output import table
from vtbdrake.common.arrays import rms
from vtbdrake.common.child_process import ChildProcess
from vtbdrake.control import RealTime, Runtime, SimulatedClock, SwitchRefusedError
from vtbdrake.control.stepping import Cycle
from vtbdrake.deployment import Deployment
from vtbdrake.lcm.hub import Hub
from vtbdrake.lcm.lcm_bridge import LcmBridge
from vtbdrake.lcm.protocol import protocol_of
from vtbdrake.machine import MachineProcess
from vtbdrake.testbed import DpsAlone
from vtbdrake_diagrams.manipulator.motions import Motion
from vtbdrake_diagrams.manipulator.safety import CARRY
from vtbdrake_diagrams.manipulator.scenario import ManipulatorScenario
from vtbdrake_diagrams.manipulator.studies.trials import (
    DURATIONS,
    FREE,
    LawAlongX,
    Track,
    run_trial,
    trial_scenario,
)

LAWS = ("cartesian_impedance", "admittance")

# Masses, friction and other parameters of the machine differ from the DPS's by up to this fraction.
PERTURB = 0.05
# Seed by which they are drawn.
SEED = 7

# Consecutive missed deadlines after which the arm floats in place; the machine brakes after 100.
MAX_MISSED = 50

# For how long a reset may be refused, in s, until the reference follows the arm.
PATIENCE = 0.1

# With more latches than this, the figures of a trial mean nothing: the motions were interrupted too often.
MANY_LATCHES = 30

# Priority of the hub in SCHED_FIFO.
HUB_PRIORITY = 80
# Priority of the loop in SCHED_FIFO.
LOOP_PRIORITY = 75
MACHINE: dict[str, Any] = {"priority": 70, "perturb": PERTURB, "seed": SEED}

# Times in the press at which the force is printed, in seconds from its beginning.
INSTANTS = (0.4, 0.6, 0.8, 1.0, 1.5, 2.0, 2.2, 2.4, 2.6)


class Attendant:
    """A watcher of the loop that resets the guards as soon as possible, and collects their faults.

    Where the reference has gone on without the arm, so that commands would jump, it follows the arm until the reset;
    after that, the arm goes home and on to the next motion.
    """

    def __init__(self) -> None:
        self.loop: Runtime | None = None
        self.reasons: list[str] = []
        self._since: float | None = None  # when the guards latched
        self._interrupted: float | None = None  # the commanded motion while the reference follows the arm

    def __call__(self, cycle: Cycle) -> None:
        loop = self.loop
        if loop is None or not loop.guards.latched:
            return
        now = loop.clock.now()
        if self._since is None:
            self._since = now
            self.reasons.append(loop.guards.latched[0].reason)
        try:
            loop.reset()
        except SwitchRefusedError:
            if self._interrupted is None and now - self._since > PATIENCE:
                self._interrupted = float(loop.target.read(loop.context, "u.motion"))
                loop.write({"u.motion": float(Motion.FOLLOW)})
            return
        self._since = None
        if self._interrupted is not None:
            loop.write({"u.motion": self._interrupted})
            self._interrupted = None


class Demo:
    """The stages of one control law, from the simulation to the machine."""

    def __init__(self, law: str, hub: Hub) -> None:
        self.law = law
        self.scenario = trial_scenario(law)
        self.testbed = self.scenario.build()
        self.along_x = LawAlongX.of(self.testbed)
        self.machine = MachineProcess(self.scenario, hub.url, **MACHINE)
        self.bridge: LcmBridge = protocol_of(self.scenario).bridge(self.scenario.interface(), hub.url)
        self.attendant = Attendant()

    def run(self, *, death: bool) -> None:
        """Run all stages; ``death`` adds those in which the machine is killed and restarted."""
        print(f"\n== {self.law}\n")
        self.bridge.open()
        try:
            simulated, loop = self.simulate()
            successor = ChildProcess(_succeed, self.scenario, self.bridge.url, name="the machine's successor")
            with self.machine, closing(successor), RealTime(priority=LOOP_PRIORITY) as rights:
                if death:
                    print("\n".join(f"  {line}" for line in str(rights).splitlines()))
                loop = self._strip(self._shadow(loop))
                real = self._on_the_machine(loop)
                self.report(simulated, real)
                self._report_timing(loop)
                if death:
                    self._die_and_recover(loop, successor)
        finally:
            self.bridge.close()

    # -- the stages

    def simulate(self) -> tuple[Track, Runtime]:
        """Run the motions in the simulation, as fast as it goes; return their track, and the loop at its end."""
        context = self.testbed.default_context()
        self.testbed.write(context, DURATIONS)
        loop = Runtime(self.testbed, self.bridge, context=context, clock=SimulatedClock())
        begin = time.perf_counter()
        track = run_trial(loop)
        print(f"sim     {loop.time:.1f} s of motions, simulated in {time.perf_counter() - begin:.1f} s")
        return track, loop

    def _shadow(self, simulated: Runtime) -> Runtime:
        loop = self._deployment().runtime(self.testbed, self.bridge, context=simulated.context)
        loop.run(until=lambda: not loop.prepare("shadow").reasons, seconds=10.0)
        loop.switch("shadow")
        loop.run(seconds=1.0)
        command = loop.actuator_command("joint_torque")
        print(f"shadow  real sensors feed the DPS, which commands the simulated arm: {_torque(command)}")
        print(f"        sent to the machine so far: {self.bridge.sent['joint_torque'].count} commands")
        return loop

    def _strip(self, shadowed: Runtime) -> Runtime:
        alone = DpsAlone(self.scenario)
        context = alone.continue_from(self.testbed, shadowed.context)
        loop = self._deployment().runtime(alone, self.bridge, context=context, watchers=(self.attendant,))
        loop.take_over()
        return loop

    def _deployment(self) -> Deployment:
        """Return a new deployment, because its fallback has a state."""
        deployment = self.scenario.deployment()
        return replace(deployment, guards={**deployment.guards, "max_missed": MAX_MISSED})

    def _on_the_machine(self, loop: Runtime) -> Track:
        self.attendant.loop = loop
        track = run_trial(loop)
        self.attendant.loop = None
        print(f"real    the DPS alone commanded the machine (perturbed by up to {PERTURB:.0%}), {loop.cycles} cycles")
        self._print_latches()
        return track

    def _die_and_recover(self, loop: Runtime, successor: ChildProcess) -> None:
        print("\nThe machine is killed in the middle of a circle:")
        loop.target.write(loop.context, {"u.motion": float(Motion.CIRCLE)})
        loop.run(seconds=2.2)
        self._reset_guards(loop)
        killed = time.monotonic()
        os.kill(self.machine.pid, signal.SIGKILL)
        loop.run(until=lambda: bool(loop.guards.latched), seconds=5.0)
        fault = loop.guards.latched[0]
        print(f"  {1e3 * (fault.time - killed):.1f} ms later the guards latch: {fault.reason}")
        loop.run(seconds=0.5 * CARRY)
        print(f"  the loop continues, and carries the arm at its last pose: {_torque(_last_sent(loop))}")
        loop.run(until=lambda: _silence(loop) > 1.1 * CARRY, seconds=10.0 * CARRY)
        sent = self.bridge.sent["joint_torque"].count
        loop.run(seconds=0.5)
        silent = self.bridge.sent["joint_torque"].count == sent
        print(
            f"  {CARRY:g} s after the last sample, it {'stops' if silent else 'DOES NOT STOP'} sending: brakes engage"
        )
        with suppress(SwitchRefusedError):
            loop.reset()
        print(f"  a reset is {'rejected' if loop.guards.latched else 'ACCEPTED'} as long as the sensors are silent")
        successor.connection.sendall(b"begin")
        # The reference follows the arm, wherever the machine starts.
        loop.target.write(loop.context, {"u.motion": float(Motion.FOLLOW)})
        loop.run(until=lambda: not _sensor_faults(loop), seconds=60.0)
        loop.run(seconds=0.1)
        print("  the machine is restarted: its sensors are fresh, the arm floats in place")
        self._reset_guards(loop)
        self.attendant.reasons.clear()
        self.attendant.loop = loop
        errors = run_trial(loop, (Motion.CIRCLE,)).errors((Motion.CIRCLE,))
        print(
            f"  reset; the next circle is tracked to {1e3 * rms(errors):.2f} mm (RMS), {1e3 * errors.max():.2f} at most"
        )
        self._print_latches()

    def _reset_guards(self, loop: Runtime) -> None:
        self.attendant.loop = loop
        loop.run(until=lambda: not loop.guards.latched, seconds=10.0)
        self.attendant.loop = None

    # -- results

    def _print_latches(self) -> None:
        """Print the faults for which the guards latched, if any."""
        reasons = self.attendant.reasons
        if reasons:
            print(f"        latches of the guards, each reset as soon as possible: {len(reasons)}; the first because")
            print(f"        {reasons[0]}")
        if len(reasons) > MANY_LATCHES:
            print("        With this many latches, the figures describe this computer, not the control law: give")
            print("        it real-time rights (see above), or less other load.")

    def report(self, simulated: Track, real: Track) -> None:
        """Print the tracking errors and the forces of the simulation and of the machine, side by side."""
        rows = []
        for motion in FREE:
            both = [track.errors((motion,)) for track in (simulated, real)]
            cells = [f"{1e3 * value:.2f}" for errors in both for value in (rms(errors), errors.max())]
            rows.append((Motion(motion).label, *cells))
        header = ("tracking error of the tip (mm)", "sim RMS", "sim max", "machine RMS", "machine max")
        print("\n" + table(header, rows) + "\n")
        contacts = [track.contact(self.along_x, self.scenario) for track in (simulated, real)]
        # A law without inertia leaves the arm its own: it predicts the force at rest only.
        statics = self.along_x.inertia == 0.0
        rows = []
        for t in INSTANTS:
            (predicted, in_sim), (_, on_machine) = (contact.at(t) for contact in contacts)
            law = "(in motion)" if statics and not contacts[0].rests_at(t) else f"{predicted:.1f}"
            rows.append((f"{t:.1f} s", law, f"{in_sim:.1f}", f"{on_machine:.1f}"))
        apart = [contact.felt - contact.predicted for contact in contacts]
        if statics:
            apart = [values[contact.rests] for values, contact in zip(apart, contacts, strict=True)]
        rows.append(
            (f"RMS from the law{' at rest' if statics else ''}", "", *(f"{rms(values):.1f}" for values in apart))
        )
        print(
            table(("force on the wall (N)", f"{'statics of ' if statics else ''}law and wall", "sim", "machine"), rows)
        )
        print()

    def _report_timing(self, loop: Runtime) -> None:
        machine = self.machine.statistics()
        answer = machine.state_to_command
        print(loop.statistics)
        print(
            f"state to command, as the machine sees it: p50 {1e6 * answer.percentile(50.0):.0f} us, p99 "
            f"{1e6 * answer.percentile(99.0):.0f} us; the machine itself missed {machine.loop.misses} deadlines and "
            f"lost {1e3 * machine.lost:.0f} ms"
        )


def _succeed(connection: socket.socket, scenario: ManipulatorScenario, url: str) -> None:
    """Start a machine when a message comes, and run it until the connection closes.

    This process is there before the loop runs: starting a process holds up the interpreter of the one that starts it.
    """
    if connection.recv(16):
        with MachineProcess(scenario, url, **MACHINE):
            connection.recv(16)


def _sensor_faults(loop: Runtime) -> list[str]:
    return [
        reason
        for name, value in loop.bridge.sensed.items()
        for reason in loop.guards.sensor_faults(name, loop.clock.now(), value)
    ]


def _silence(loop: Runtime) -> float:
    """Return for how long no position of the arm has arrived, in s."""
    return loop.clock.now() - loop.guards.monitors["joint_position"].arrived


def _last_sent(loop: Runtime) -> np.ndarray:
    return np.array(loop.guards.limiters["joint_torque"].last_sent)


def _torque(values: np.ndarray) -> str:
    return "[" + " ".join(f"{value:.1f}" for value in values) + "] N m"


@click.command()
def main() -> None:
    """Run the demo with each control law on a machine in another process."""
    logging.disable(logging.ERROR)  # The demo prints what the guards would log.
    begin = time.perf_counter()
    print("A seven-joint arm, developed in simulation, then run at 1 kHz on a machine in another process.")
    with Hub(port=0, protect=["IIWA_COMMAND"], priority=HUB_PRIORITY) as hub:
        for law in LAWS:
            Demo(law, hub).run(death=law == LAWS[0])
    print(f"\n{time.perf_counter() - begin:.0f} s in all.")


if __name__ == "__main__":
    main()
