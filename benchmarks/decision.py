"""Benchmarks of the time that a decision takes beyond its rollouts."""

from __future__ import annotations

import time
from functools import partial

import numpy as np
from pydrake.systems.framework import Context

from benchmarks.measure import LOWER, Benchmark, processor_time, seconds, spread
from vtbdrake.optimization import Parameter
from vtbdrake.reasoning import Belief, BeliefToStart, Budget, Decision, Reasoner, SearchConfig
from vtbdrake.rollout import Quality, RolloutRunner
from vtbdrake.testbed import VirtualTestbed
from vtbdrake_diagrams.cart_pole import CartPoleScenario
from vtbdrake_diagrams.cart_pole.swing_up import make_reasoner
from vtbdrake_diagrams.manipulator import ManipulatorScenario
from vtbdrake_diagrams.space_climber import SpaceClimberScenario

AHEAD = "sim.sys.climber.base.x"
# The plan in use and two candidates, in one batch.
ROLLOUTS, WORKERS = 3, 2


def _begin_in_workers(reasoner: Reasoner, testbed: VirtualTestbed, context: Context) -> float:
    """Return the seconds beside two rollouts from a belief, without the reasoner's method and its choice."""
    begin = time.perf_counter()
    start = reasoner.belief_to_start.start(Belief.of(testbed, context))
    results = dict(reasoner.executor.run(reasoner.task, [{}] * WORKERS, start=start))
    return time.perf_counter() - begin - max(result.wall_time for result in results.values())


def decision_overhead_compiled(decisions: int = 100, rollouts: int = 32) -> list[Benchmark]:
    """Processor time that a decision takes beyond its compiled rollouts, over the time of these.

    All is done by the process that decides: the belief, the method, the rollouts of the mental testbed, the choice. The
    robot decides again and again, a sample of its DPS later each time, and takes what it chooses. The arm chooses the
    stiffness of its posture by rollouts of 0.1 s, a sample each millisecond. The cart-pole's rollouts are so short that
    the decision takes a multiple of them, in Python; it has no goal.
    """
    arm, cart_pole = ManipulatorScenario(), CartPoleScenario()
    by_arm = Reasoner(
        scenario=arm,
        decision=[Parameter("dps.impl.posture_stiffness", 0.0, 200.0)],
        quality=Quality(np.linalg.norm, of="dps.env.joint_velocity", reading="end", minimize=True),
        horizon=0.1,
        sample_period=0.1,
        budget=Budget(rollouts=rollouts),
        search=SearchConfig(method="random", executor="compiled"),
    )
    by_cart_pole = make_reasoner(cart_pole, rollouts=rollouts, executor="compiled")
    return [
        _overhead_compiled("decision_overhead_compiled", arm, by_arm, 0.5, decisions),
        _overhead_compiled("decision_overhead_cart_pole", cart_pole, by_cart_pole, None, decisions),
    ]


def _overhead_compiled(
    name: str, scenario: ManipulatorScenario | CartPoleScenario, reasoner: Reasoner, goal: float | None, decisions: int
) -> Benchmark:
    """Compare the decisions of a reasoner with their rollouts, made once more by the compiled mental testbed."""
    testbed, task = scenario.build(), reasoner.task
    simulator = testbed.simulator()
    context = simulator.get_mutable_context()
    with reasoner:
        decision = reasoner.decide(testbed, context)
        (varied,) = decision.candidates[0].values
        bare = (
            scenario.mental()
            .build()
            .compiled(
                horizon=task.horizon, sample_period=task.sample_period, parameters=[varied], outputs=["plant.state"]
            )
        )
        values = {varied: np.array([candidate.values[varied] for candidate in decision.candidates])}
        made: list[Decision] = []
        parts = [lambda: made.append(reasoner.decide(testbed, context)), partial(bare, values)]
        times = np.empty((decisions, 2))
        for k in range(decisions):
            simulator.AdvanceTo((k + 1) * scenario.period)
            times[k] = [1e3 * processor_time(part) for part in parts]
            made[-1].apply(testbed, context)
    ours = times[:, 0] - times[:, 1]
    return Benchmark(
        name=name,
        value=float(np.median(ours / times[:, 1])),
        unit="1",
        goal=goal,
        better=LOWER,
        against="the compiled rollouts of the same decisions",
        note=f"processor time beyond the rollouts {spread(ours, unit='ms')}; a decision takes "
        f"{np.median(times[:, 0]):.3g} ms, its {len(values[varied])} rollouts of {task.horizon:g} s "
        f"{np.median(times[:, 1]):.2g} ms",
    )


def decision_overhead(decisions: int = 100, horizon: float = 0.2) -> Benchmark:
    """Measure what a decision of the walking SpaceClimber takes beyond its rollouts, over what these take.

    The running robot decides about its heading again and again, a sample of its DPS later each time, by rollouts in two
    warm processes: the plan in use beside one candidate, and the other candidate where a worker is free first. What is
    subtracted from the wall time of `Reasoner.decide` is what these rollouts take in this order, as their workers
    measure it, without what each worker does to begin at another start: that is measured apart and not subtracted. So
    all the rest counts: the state of the DPS, the world as it is believed to be, the way to the workers and back, the
    beginning there, and the choice.
    """
    scenario = SpaceClimberScenario()
    testbed = scenario.build()
    simulator = testbed.simulator()
    simulator.AdvanceTo(1.01)
    context = simulator.get_context()
    reasoner = Reasoner(
        scenario=scenario,
        decision=[Parameter("u.heading", -0.5, 0.5)],
        quality=Quality(float, AHEAD, reading="end"),
        horizon=horizon,
        sample_period=horizon,
        budget=Budget(rollouts=ROLLOUTS),
        search=SearchConfig(method="random", executor="processes", workers=WORKERS),
    )
    overheads, rollouts, taken, bare, processor_times = [], [], [], [], []
    with reasoner:
        for k in range(decisions + 3):
            simulator.AdvanceTo(1.01 + (k + 1) * scenario.period)
            begin, used = time.perf_counter(), time.process_time()
            decision = reasoner.decide(testbed, context)
            elapsed, used = time.perf_counter() - begin, time.process_time() - used
            first, second, third = [candidate.rollouts[0].wall_time for candidate in decision.candidates]
            if k >= 3:  # The first ones build the testbeds of the workers.
                rollouts.append(max(min(first, second) + third, first, second))
                overheads.append(elapsed - rollouts[-1])
                taken.append(elapsed)
                processor_times.append(used)
                bare.append(_begin_in_workers(reasoner, testbed, context))
    runner = RolloutRunner(reasoner.task)
    belief_to_start = BeliefToStart(runner.testbed)
    belief = Belief.of(testbed, context)
    first_start, second_start = belief_to_start.start(belief), belief_to_start.start(belief)

    def begin_at(*starts: object) -> None:
        for start in starts:
            runner.run({}, start=start)

    ours, rolled_out = 1e3 * np.array(overheads), 1e3 * np.array(rollouts)
    anew, again = (
        1e3 * np.median([processor_time(partial(begin_at, *starts)) for _ in range(decisions)]) / 2
        for starts in ((first_start, second_start), (first_start, first_start))
    )
    ours += 2 * max(float(anew - again), 0.0)
    parts = {"the belief": lambda: Belief.of(testbed, context), "its start": lambda: belief_to_start.start(belief)}
    costs = ", ".join(f"{name} {1e3 * np.median([seconds(f) for _ in range(200)]):.2f} ms" for name, f in parts.items())
    return Benchmark(
        name="decision_overhead",
        value=float(np.median(ours / rolled_out)),
        unit="1",
        goal=0.15,
        better=LOWER,
        against="the bare rollouts of the same decisions",
        note=f"the goal was 1 ms; "
        f"{spread(ours, unit='ms')}, {1e3 * np.median(bare):.2f} ms of it without the method and its choice; "
        f"{1e3 * np.median(processor_times):.2f} ms of processor time in the process that decides; "
        f"a decision takes {1e3 * np.median(taken):.3g} ms, with {ROLLOUTS} rollouts of {horizon:g} s on "
        f"{WORKERS} workers, which take {np.median(rolled_out):.3g} ms; {costs}, "
        f"{anew - again:.2f} ms to begin elsewhere in a worker",
    )
