"""Punctuality of the loop with a slow part beside it."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
from pydrake.systems.framework import Diagram, DiagramBuilder

from benchmarks.loop import PER, histogram, percentiles
from benchmarks.loop_rig import PERIOD, loop_rig
from benchmarks.measure import LOWER, Benchmark
from vtbdrake.testbed import DpsAlone, SlowPart
from vtbdrake_diagrams.manipulator import ManipulatorScenario
from vtbdrake_diagrams.manipulator.arm import JOINTS

TAKES = 0.05  # s of a processor
SAMPLE_PERIOD, LATENCY = 0.1, 0.2  # s


def perceive(joint_position: np.ndarray) -> np.ndarray:
    """Compute for as long as a perception works on an image."""
    end = time.process_time() + TAKES
    perceived = joint_position
    numbers = np.random.default_rng(0).normal(size=(200, 200))
    while time.process_time() < end:
        perceived = joint_position + np.abs(numbers).sum(axis=0)[:JOINTS]
    return perceived


@dataclass
class PerceivingScenario(ManipulatorScenario):
    """The arm, with a perception beside its control law."""

    def make_dps(self) -> Diagram:
        builder = DiagramBuilder()
        law = builder.AddNamedSystem("law", super().make_dps())
        part = SlowPart(
            perceive,
            inputs={"joint_position": JOINTS},
            outputs={"perceived": JOINTS},
            period=SAMPLE_PERIOD,
            latency=LATENCY,
        )
        builder.AddNamedSystem("perception", part)
        for k in range(law.num_input_ports()):
            builder.ExportInput(law.get_input_port(k), law.get_input_port(k).get_name())
        builder.ConnectInput("joint_position", part.GetInputPort("joint_position"))
        for k in range(law.num_output_ports()):
            builder.ExportOutput(law.get_output_port(k), law.get_output_port(k).get_name())
        return builder.Build()


def slow_part_misses(cycles: int = 6_000, rounds: int = 10) -> Benchmark:
    """Missed deadlines of the 1 kHz loop with a perception, n, and without, m: (n + 1) / (m + 1), for 10,000 cycles.

    The perception takes 50 ms of a processor every 100 ms. In turns, in the full loop with hub and machine.

    Raises:
        RuntimeError: The perception did not work: there was nothing beside the loop.
    """
    misses = {"with": 0, "without": 0}
    late: dict[str, list[float]] = {"with": [], "without": []}
    with loop_rig() as rig, rig.runtime(DpsAlone(PerceivingScenario())) as perceiving:
        if not perceiving.slow_parts.wait(timeout=60.0):
            raise RuntimeError("the perception does not start: measure on a machine with less load")
        runtimes = {"without": rig.runtime(DpsAlone(rig.scenario)), "with": perceiving}
        for _ in range(rounds):
            for name, runtime in runtimes.items():
                misses[name] += rig.run(runtime, cycles // rounds)
                late[name] += runtime.lateness
        (statistics,) = perceiving.slow_parts.statistics.values()
        granted = rig.granted()
    if statistics.took.count < 0.5 * cycles * PERIOD / SAMPLE_PERIOD:
        raise RuntimeError(
            f"the perception has worked {statistics.took.count} times: measure on a machine with less load"
        )
    of, to = (misses[name] * PER / cycles for name in ("with", "without"))
    punctuality = "; ".join(f"{name} {percentiles(histogram(values))}" for name, values in late.items())
    return Benchmark(
        name="slow_part_misses",
        value=(of + 1.0) / (to + 1.0),
        unit="1",
        goal=2.0,
        better=LOWER,
        against=f"the loop without it; missed in {PER} cycles: {of:g} to {to:g}",
        note=f"from the deadline to the end: {punctuality}; {statistics.results} results in time, "
        f"{statistics.missed} missing ({statistics.late} of them late); "
        f"from request to answer: {percentiles(statistics.took)}; {granted}",
    )
