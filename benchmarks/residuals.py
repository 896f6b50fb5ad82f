"""Delay until a wrong payload of the arm is found, and the rate at which a right one is found wrong.

``python -m benchmarks.residuals 3600`` simulates an hour of nominal operation.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from math import inf

import click

from benchmarks.loop_rig import PERIOD
from benchmarks.measure import LOWER, Benchmark, seconds
from vtbdrake.control.guards import Guards
from vtbdrake.control.runtime import Runtime
from vtbdrake.lcm.hub import Hub
from vtbdrake.lcm.protocol import protocol_of
from vtbdrake.machine import MachineProcess
from vtbdrake.monitoring.residuals import NominalResiduals, ResidualMonitor
from vtbdrake.testbed import DpsAlone
from vtbdrake_diagrams.manipulator import ManipulatorScenario
from vtbdrake_diagrams.manipulator.arm import Arm
from vtbdrake_diagrams.manipulator.motions import Motion
from vtbdrake_diagrams.manipulator.safety import CONTINUITY

# Noise of the machine's sensors, in their units.
NOISE = {"joint_position": 1e-5, "joint_velocity": 1e-3, "joint_torque_measured": 0.1, "wrench": 0.1}
PATIENCE = 60.0  # s that the machine may take for an answer

TOOL = "sim.sys.arm.tool.mass"
ERROR = 0.05

LEARNING, SEARCH = 8.0, 2.0  # s


def payload_alarm(nominal: float = 10.0) -> list[Benchmark]:
    """Seconds from the first judged window to the alarm, for an arm whose tool is 5 % (20 g) heavier than its model.

    Also the alarms in ``nominal`` seconds with the right tool. Arm, loop and residuals are separate processes, in
    lock-step, with noise; scales are calibrated in a run before.

    Raises:
        RuntimeError: The wrong payload was not found.
    """
    with arm_loop(seed=1) as runtime:
        calibration = learn(runtime)
    with arm_loop(seed=2) as runtime:
        begin = runtime.time
        with ResidualMonitor(runtime, "twin", calibration=calibration) as right:
            took = seconds(lambda: runtime.run(cycles=round(nominal / PERIOD)))
        simulated = runtime.time - begin
    with (
        arm_loop(seed=3, mass=(1.0 + ERROR) * Arm().tool_mass) as runtime,
        ResidualMonitor(runtime, "twin", calibration=calibration) as wrong,
    ):
        runtime.run(cycles=round(SEARCH / PERIOD))
    if not wrong.alarms:
        raise RuntimeError(f"a payload that is wrong by {ERROR:.0%} was not found in {SEARCH} s")
    first = wrong.history[0].time - wrong.config.window
    left_out = f"{right.skipped + right.dropped + right.failed} windows of {len(right.history)} left out"
    return [
        Benchmark(
            name="payload_alarm",
            value=wrong.alarms[0].began - first,
            unit="s",
            goal=1.0,
            better=LOWER,
            absolute="simulated time, the same on every machine",
            against=f"a twin whose tool weighs {Arm().tool_mass} kg, {ERROR:.0%} less than the machine's",
            note=str(wrong.alarms[0]),
        ),
        Benchmark(
            name="payload_false_alarms",
            value=float(len(right.alarms)),
            unit="1",
            goal=0.0,
            better=LOWER,
            against=f"{simulated:.0f} s of nominal operation, simulated in {took:.0f} s",
            note="; ".join([left_out, *map(str, right.alarms)]),
        ),
    ]


def learn(runtime: Runtime) -> NominalResiduals:
    """Return the residuals while the arm moves."""
    with ResidualMonitor(runtime, "twin", learn=True) as monitor:
        runtime.run(cycles=round(LEARNING / PERIOD))
    return monitor.calibrate()


@contextmanager
def arm_loop(*, seed: int, mass: float | None = None) -> Iterator[Runtime]:
    """A loop that has a machine draw circles, in lock-step."""
    scenario = ManipulatorScenario(law="joint_impedance")
    values = {} if mass is None else {TOOL: mass}
    with (
        Hub(port=0) as hub,
        MachineProcess(scenario, hub.url, lock_step=True, seed=seed, noise=NOISE, values=values),
    ):
        bridge = protocol_of(scenario).bridge(scenario.interface(), hub.url)
        bridge.open()
        try:
            interface = scenario.interface()
            # In lock-step the machine's stamps tell the time.
            patient = replace(interface, sense=[replace(signal, max_age=inf) for signal in interface.sense])
            runtime = Runtime(
                DpsAlone(scenario),
                bridge,
                period=PERIOD,
                guards=Guards(patient, PERIOD, max_missed=inf),
                # Nothing but the machine's next message begins a cycle.
                pace="joint_position",
                patience=PATIENCE / PERIOD,
                continuity=CONTINUITY,
            )
            while not all(received.count for received in bridge.sensed.values()):
                bridge.poll(PATIENCE)
            runtime.switch("real")
            runtime.write({"u.motion": float(Motion.CIRCLE)})
            runtime.cycle()
            yield runtime
        finally:
            bridge.close()


@click.command()
@click.argument("duration", default=10.0)
def main(duration: float) -> None:
    """Print the benchmark with DURATION seconds of nominal operation."""
    for row in payload_alarm(duration):
        click.echo(f"{row.name}: {row.value:g} {row.unit}, against {row.against}\n    {row.note}")


if __name__ == "__main__":
    main()
