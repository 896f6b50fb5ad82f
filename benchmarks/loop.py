"""Speed and punctuality of the full loop: machine process, hub, controller, hub, machine process."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress

import lcm
import numpy as np
from drake import lcmt_iiwa_status

from benchmarks.bare_loop import bare_loop
from benchmarks.drake_loop import DrakeLoop
from benchmarks.hub import ECHO
from benchmarks.loop_rig import PERIOD, PRIORITY, WARM_UP, loop_rig
from benchmarks.measure import HIGHER, LOWER, Benchmark
from vtbdrake.control.clock import WallClock
from vtbdrake.control.statistics import Histogram
from vtbdrake.testbed import DpsAlone
from vtbdrake_diagrams.manipulator.arm import JOINTS

PACE = "joint_position"  # comes with the first of the machine's messages
PER = 10_000  # cycles, for which misses are counted
TIMEOUT_MS = 5_000


def loop_state_to_command_p50(cycles: int = 5000, rounds: int = 10) -> list[Benchmark]:
    """Time from a state's departure from the machine to the arrival of a command, with the DPS alone, over an echo's.

    Each state begins a cycle of the loop. In turns with a plain echo at the same rate through the same hub: a message
    of the state's size to another process, which only sends it back. The machine runs throughout.

    Raises:
        RuntimeError: The answers come more than a period late, so that the machine takes them for those to the next
            states: it would measure less time than the controller needs.
    """
    states, echoes = Histogram(), []
    answered, sent = 0, 0
    with loop_rig() as rig, _echo(rig.hub.url) as bus:
        runtime = rig.runtime(DpsAlone(rig.scenario), pace=PACE)
        granted = rig.granted()
        for _ in range(rounds):
            rig.run(runtime, cycles // rounds)
            statistics = rig.machine.statistics()
            states.merge(statistics.state_to_command)
            answered += statistics.state_to_command.count
            sent += statistics.loop.cycles
            echoes += _echoed(bus, cycles // rounds)
    needed = runtime.statistics.histograms["cycle"].percentile(50.0)
    if states.percentile(50.0) < needed:
        raise RuntimeError(
            f"the machine sees an answer after {1e6 * states.percentile(50.0):.0f} us, but it takes the controller "
            f"{1e6 * needed:.0f} us: answers come more than a period late; measure on a machine with less load"
        )
    note = (
        f"{percentiles(states)}; {answered} answers to {sent} states; echo: {percentiles(histogram(echoes))}; {granted}"
    )
    echo = dict(zip((50, 99), np.percentile(echoes, (50, 99)), strict=True))
    return [
        Benchmark(
            name=f"loop_state_to_command_p{percent}",
            value=states.percentile(percent) / echo[percent],
            unit="1",
            goal=goal,
            better=LOWER,
            against=f"a plain LCM echo through the same hub: {1e3 * echo[percent]:.3g} ms",
            note=f"the goal was, besides, {1e3 * most:g} ms: {1e3 * states.percentile(percent):.3g} ms"
            + (f"; {note}" if percent == 50 else ""),
        )
        for percent, most, goal in ((50, 0.4e-3, 2.0), (99, 1e-3, 2.5))
    ]


def loop_misses(cycles: int = 6_000, rounds: int = 10) -> Benchmark:
    """Missed deadlines of our loop, n, and of a bare one in C, m: (n + 1) / (m + 1), both counted for 10,000.

    They have the same priority, and take turns, while hub and machine run. The 1 accounts for a miss that was just not
    observed, and keeps the ratio finite; without any miss it is 1. By the rule of both, a deadline is missed if it
    passes before the cycle of an earlier one has ended. Our cycle is the whole cycle; the C loop only wakes up.
    """
    ours, bare = 0, 0
    late: dict[str, list[float]] = {"ours": [], "C": []}
    with bare_loop() as c, loop_rig() as rig:
        runtime = rig.runtime(DpsAlone(rig.scenario))
        for _ in range(rounds):
            ours += rig.run(runtime, cycles // rounds)
            late["ours"] += runtime.lateness
            run = c.run(priority=PRIORITY, period=PERIOD, cycles=cycles // rounds)
            bare += run.missed
            late["C"] += run.lateness.tolist()
        granted = rig.granted() + f", C {'SCHED_FIFO ' + str(run.priority) if run.priority else 'without SCHED_FIFO'}"
    of, to = (missed * PER / cycles for missed in (ours, bare))
    return Benchmark(
        name="loop_misses",
        value=(of + 1.0) / (to + 1.0),
        unit="1",
        goal=2.0,
        better=LOWER,
        against=f"a bare C loop at the same priority; missed in {PER} cycles: {of:g} to {to:g}",
        note="from the deadline to the end: "
        + "; ".join(f"{name} {percentiles(histogram(values))}" for name, values in late.items())
        + f"; {granted}",
    )


def cycle_overhead(cycles: int = 4000, rounds: int = 8) -> list[Benchmark]:
    """Time of a cycle less the time of the DPS's step, over that step, in the full loop, with the DPS alone. Medians.

    A cycle receives the last messages, checks them, steps the DPS (`Simulator.AdvanceTo` and its output), applies the
    guards, counts, and sends messages. Printed only: the time of a step of the full testbed with both switches on real
    against a step of the DPS alone, in turns.

    Most messages are received shortly before a cycle is due. That is part of the processor time of the loop's thread,
    less the time of the steps, in the note; so is the time for which it polls the clock.
    """
    overheads: list[float] = []
    worked = 0.0
    with loop_rig() as rig:
        alone, full = rig.runtime(DpsAlone(rig.scenario)), rig.runtime(rig.scenario.build())
        for _ in range(rounds):
            rig.run(alone, cycles // rounds)
            overheads += alone.overheads
            worked += alone.worked
            rig.run(full, cycles // rounds)
        granted = rig.granted()
    steps = {name: runtime.statistics.histograms["step"] for name, runtime in (("alone", alone), ("full", full))}
    p50 = {name: histogram.percentile(50.0) for name, histogram in steps.items()}
    step = f"DPS: {percentiles(steps['alone'])}"
    besides = worked / len(overheads) - steps["alone"].mean
    return [
        Benchmark(
            name="cycle_overhead",
            value=float(np.median(overheads)) / p50["alone"],
            unit="1",
            goal=0.6,
            better=LOWER,
            against=f"the DPS's own step: {1e6 * p50['alone']:.0f} us",
            note=f"beyond the step: {percentiles(histogram(overheads))}; processor time beyond it, waiting included: "
            f"{1e6 * besides:.0f} us; {granted}",
        ),
        Benchmark(
            name="strip_step_time",
            value=p50["full"] / p50["alone"],
            unit="1",
            goal=None,
            better=HIGHER,
            against="a step of the DPS alone; the full testbed's in the same loop over it",
            note=f"{step}; testbed: {percentiles(steps['full'])}",
        ),
    ]


def loop_against_drake(cycles: int = 5000, rounds: int = 10) -> list[Benchmark]:
    """A loop of Drake's own parts against ours: lateness at the 99th percentile, and misses. Printed only.

    Drake's parts are `LcmSubscriberSystem`, the same DPS and `LcmPublisherSystem` with
    ``set_target_realtime_rate(1.0)``. The loops take turns, in the same thread. Lateness is the time from a deadline to
    the end of its cycle; misses are counted as in `loop_misses`. Drake's loop catches up, so that it drops no cycle;
    here, each whole period that a cycle ends after its deadline counts.
    """
    ours, theirs, our_misses = [], [], 0
    with loop_rig() as rig:
        runtime = rig.runtime(DpsAlone(rig.scenario))
        other = DrakeLoop(rig.scenario, rig.hub.url, period=PERIOD)
        for _ in range(rounds):
            our_misses += rig.run(runtime, cycles // rounds)
            ours += runtime.lateness
            theirs += other.run(cycles // rounds, warm_up=WARM_UP).tolist()
        granted = rig.granted()
    of, to = (float(np.percentile(late, 99)) for late in (theirs, ours))
    their_misses = sum(late >= PERIOD for late in theirs)
    against = "Drake's LCM systems at a real-time rate of 1, over ours"
    return [
        Benchmark(
            name="loop_against_drake",
            value=of / to,
            unit="1",
            goal=None,
            better=HIGHER,
            against=f"{against}: p99 to the end",
            note=f"ours: {percentiles(histogram(ours))}; Drake: {percentiles(histogram(theirs))}; {granted}",
        ),
        Benchmark(
            name="loop_against_drake_misses",
            value=(their_misses * PER / cycles + 1.0) / (our_misses * PER / cycles + 1.0),
            unit="1",
            goal=None,
            better=HIGHER,
            against=f"{against}: misses (+ 1)",
            note=f"in {cycles} cycles: ours {our_misses}, Drake {their_misses}",
        ),
    ]


@contextmanager
def _echo(url: str) -> Iterator[lcm.LCM]:
    """A client whose messages another process sends back."""
    bus = lcm.LCM(url)
    bus.subscribe("PONG", lambda *_: None)
    with subprocess.Popen([sys.executable, "-c", ECHO, url]) as process:
        try:
            _await(bus)
            # It represents a machine, which has another processor than the controller that starts it.
            os.sched_setaffinity(process.pid, range(os.cpu_count() or 1))
            with suppress(PermissionError):  # Then it is not granted; see `Rig.granted`.
                os.sched_setscheduler(process.pid, os.SCHED_FIFO, os.sched_param(PRIORITY))
            yield bus
        finally:
            process.kill()


def _echoed(bus: lcm.LCM, messages: int) -> list[float]:
    """Seconds from a message's departure to its return, one each period."""
    clock, times = WallClock(), []
    status = lcmt_iiwa_status()
    status.num_joints = JOINTS
    for name in status.__slots__[2:]:
        setattr(status, name, [0.0] * JOINTS)
    data = status.encode()
    deadline = clock.now()
    for _ in range(messages):
        deadline = max(deadline + PERIOD, clock.wait_until(deadline))
        begin = clock.now()
        bus.publish("PING", data)
        _await(bus)
        times.append(clock.now() - begin)
    return times


def _await(bus: lcm.LCM) -> None:
    if not bus.handle_timeout(TIMEOUT_MS):
        raise TimeoutError(f"no message came back within {TIMEOUT_MS} ms")


def histogram(times: list[float]) -> Histogram:
    histogram = Histogram()
    for seconds in times:
        histogram.record(seconds)
    return histogram


def percentiles(times: Histogram) -> str:
    p50, p90, p99 = (1e6 * times.percentile(percent) for percent in (50.0, 90.0, 99.0))
    return f"p50 {p50:.0f}, p90 {p90:.0f}, p99 {p99:.0f} us (n = {times.count})"
