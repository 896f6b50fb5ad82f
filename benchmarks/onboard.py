"""Benchmark of the loop's punctuality beside a reasoner that decides on the same machine."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from pydrake.systems.framework import Diagram, DiagramBuilder

from benchmarks.loop import histogram, percentiles
from benchmarks.loop_rig import loop_rig
from benchmarks.measure import LOWER, Benchmark
from vtbdrake.optimization import Parameter
from vtbdrake.reasoning import Budget, OnboardReasoner, SearchConfig
from vtbdrake.rollout import Quality
from vtbdrake.testbed import DpsAlone, Scenario, VirtualTestbedBuilder
from vtbdrake_diagrams.manipulator import ManipulatorScenario

EVERY = 0.5  # s, from one decision to the next, and until it is shown
HORIZON = 0.6  # s


def speed(joint_velocity: np.ndarray) -> float:
    return float(np.abs(joint_velocity).max())


@dataclass
class ReasoningScenario(ManipulatorScenario):
    """The arm, with a reasoner beside its control law that decides all the time, by rollouts of the whole testbed.

    Its decision is not used, so that the arm does the same with and without it.
    """

    reasons: bool = True

    def mental(self) -> Scenario:
        return replace(self, reasons=False)

    def make_dps(self) -> Diagram:
        builder = DiagramBuilder()
        law = builder.AddNamedSystem("law", super().make_dps())
        reasoner = OnboardReasoner(
            1,
            scenario=self,
            decision=[Parameter("dps.planner.candidate", 0.0, 1.0)],
            quality=Quality(speed, of=["dps.law.env.joint_velocity"], minimize=True),
            horizon=HORIZON,
            # More than there is time for.
            budget=Budget(rollouts=10**6),
            period=EVERY,
            latency=EVERY,
            mental=not self.reasons,
            options={"search": SearchConfig(method="random")},
        )
        builder.AddNamedSystem("planner", reasoner)
        for k in range(law.num_input_ports()):
            builder.ExportInput(law.get_input_port(k), law.get_input_port(k).get_name())
        for k in range(law.num_output_ports()):
            builder.ExportOutput(law.get_output_port(k), law.get_output_port(k).get_name())
        return builder.Build()

    def add_world(self, builder: VirtualTestbedBuilder) -> None:
        super().add_world(builder)
        # The estimates have moved with the law.
        builder.belief_rules[:] = [
            replace(rule, of=tuple(address.replace("dps.", "dps.law.", 1) for address in rule.of))
            for rule in builder.belief_rules
        ]


def loop_p99_beside_reasoner(cycles: int = 6_000, rounds: int = 5) -> Benchmark:
    """Lateness of the 1 kHz loop at the 99th percentile, with a reasoner that decides all the time, over that without.

    The lateness is the time from a deadline to the end of its cycle. In turns, in the full loop with hub and machine.

    Raises:
        RuntimeError: The reasoner was not at work for half of the time: there was nothing beside the loop.
    """
    late: dict[str, list[float]] = {"with": [], "without": []}
    with loop_rig() as rig, rig.runtime(DpsAlone(ReasoningScenario())) as reasoning:
        if not reasoning.slow_parts.wait(timeout=120.0):
            raise RuntimeError("the reasoner does not start: measure on a machine with less load")
        runtimes = {"without": rig.runtime(DpsAlone(rig.scenario)), "with": reasoning}
        for _ in range(rounds):
            for name, runtime in runtimes.items():
                rig.run(runtime, cycles // rounds)
                late[name] += runtime.lateness
        (statistics,) = reasoning.slow_parts.statistics.values()
        granted = rig.granted()
    busy = statistics.took.mean / EVERY
    if busy < 0.5:
        raise RuntimeError(f"the reasoner was at work for {busy:.0%} of the time: measure on a machine with less load")
    with_, without = (float(np.percentile(late[name], 99.0)) for name in ("with", "without"))
    punctuality = "; ".join(f"{name} {percentiles(histogram(values))}" for name, values in late.items())
    return Benchmark(
        name="loop_p99_beside_reasoner",
        value=with_ / without,
        unit="1",
        goal=2.0,
        better=LOWER,
        against=f"the loop alone: {1e6 * with_:.0f} to {1e6 * without:.0f} us",
        note=f"from the deadline to the end: {punctuality}; the reasoner was at work for {busy:.0%} of the time, with "
        f"{statistics.results} decisions, {statistics.missed} missing; {granted}",
    )
