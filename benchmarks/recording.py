"""Costs of recording and watching a loop, and the speed of the replay of its log."""

from __future__ import annotations

import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from benchmarks.loop_rig import PERIOD, Rig, loop_rig
from benchmarks.measure import LOWER, Benchmark, interleaved_values, processor_time, ratio, spread
from vtbdrake.control.runtime import Runtime
from vtbdrake.control.stepping import RealPorts
from vtbdrake.monitoring.live.service import LiveService
from vtbdrake.recording.log_reader import ControlLog, read_log
from vtbdrake.recording.recorder import Recorder
from vtbdrake.recording.replay import replay
from vtbdrake.testbed import DpsAlone

WATCHED = ("dps.impl.torque", "dps.env.joint_position", "dps.env.contact_wrench")
PATIENCE = 30.0  # s, to wait for a watcher

_WATCH = """
import sys
from vtbdrake.monitoring.live.client import watch
for _ in watch(sys.argv[1], sys.argv[2:], every=10):
    pass
"""


def recording_cost(cycles: int = 6_000, rounds: int = 12) -> list[Benchmark]:
    """Lateness of the 1 kHz loop's commands with a recorder and a live watch, over that without, in turns.

    The lateness is the time from each deadline until the commands have left; the ratio compares the 99th percentiles,
    each the median over the rounds: one round that this computer disturbs does not decide. The watch is in
    another process. Printed only: the same to the end of the cycle, when a cycle is recorded and the watched values are
    read, and the ratio of misses.

    Raises:
        RuntimeError: The recorder lost cycles, or the watch ended, so that its cost was not measured.
        TimeoutError: The other process does not watch.
    """
    # One list of each round.
    commanded: dict[bool, list[list[float]]] = {True: [], False: []}
    ended: dict[bool, list[list[float]]] = {True: [], False: []}
    overheads: dict[bool, list[float]] = {True: [], False: []}
    missed = {True: 0, False: 0}
    with TemporaryDirectory() as folder, loop_rig() as rig:
        runtime = rig.runtime(DpsAlone(rig.scenario))
        for i in range(rounds):
            # The first one alternates, so that other load of this computer affects both equally.
            for on in (True, False) if i % 2 else (False, True):
                with ExitStack() as stack:
                    if on:
                        _watch_and_record(stack, rig, runtime, Path(folder) / f"{i}.lcm")
                    missed[on] += rig.run(runtime, cycles // rounds)
                    commanded[on].append(runtime.commanded.copy())
                    ended[on].append(runtime.lateness.copy())
                    overheads[on] += runtime.overheads
        granted = rig.granted()
    more = 1e6 * (np.median(overheads[True]) - np.median(overheads[False]))
    against = "the loop without recorder and watch"
    return [
        _ratio("recording_cost", commanded, 1.2, f"{against}, commands", f"; {granted}"),
        _ratio(
            "recording_cost_whole",
            ended,
            None,
            f"{against}, ends of cycles",
            f"; a cycle takes {more:.0f} us more (p50)",
        ),
        Benchmark(
            name="recording_misses",
            value=(missed[True] + 1.0) / (missed[False] + 1.0),
            unit="1",
            goal=None,
            better=LOWER,
            against=f"{against}; misses (+ 1) in {cycles} cycles each",
            note=f"{missed[True]} with both, {missed[False]} without",
        ),
    ]


def _ratio(name: str, late: dict[bool, list[list[float]]], goal: float | None, against: str, note: str) -> Benchmark:
    of_rounds = {on: np.percentile(rounds, 99.0, axis=1) for on, rounds in late.items()}
    p99 = {on: float(np.median(values)) for on, values in of_rounds.items()}
    spreads = {on: spread(1e6 * values, unit="us") for on, values in of_rounds.items()}
    return Benchmark(
        name=name,
        value=p99[True] / p99[False],
        unit="1",
        goal=goal,
        better=LOWER,
        against=f"{against}: p99 {1e6 * p99[False]:.0f} us late",
        note=f"with both {spreads[True]}, without {spreads[False]}{note}",
    )


def _watch_and_record(stack: ExitStack, rig: Rig, runtime: Runtime, path: Path) -> None:
    recorder = stack.enter_context(Recorder(runtime, path))
    service = stack.enter_context(LiveService(runtime, rig.hub.url))
    watcher = stack.enter_context(subprocess.Popen([sys.executable, "-c", _WATCH, rig.hub.url, *WATCHED]))
    stack.callback(watcher.kill)
    # Who asks is answered by a loop that runs. It runs on without a pause, in which the watcher would give up.
    runtime.run(until=lambda: service.watches > 0, seconds=PATIENCE)
    if not service.watches:
        raise TimeoutError(f"no watcher after {PATIENCE} s")
    stack.callback(_check_complete, recorder, watcher)


def _check_complete(recorder: Recorder, watcher: subprocess.Popen[bytes]) -> None:
    if watcher.poll() is not None:
        raise RuntimeError(f"the watcher has ended with exit code {watcher.returncode}")
    recorder.close()
    if recorder.lost:
        raise RuntimeError(f"the recorder lost {recorder.lost} cycles")


def replay_cost(simulated: float = 15.0, repeats: int = 5) -> Benchmark:
    """Processor time of replaying the loop's log, over the time of the DPS's own steps in a bare loop, in turns.

    The log comes from the arm on the machine, with the bridge's messages; the replay reads it, compares, and must be
    identical. The bare loop feeds the recorded values. Both build the DPS first.

    Raises:
        RuntimeError: The replay was not identical.
    """
    with TemporaryDirectory() as folder:
        path = Path(folder) / "arm.lcm"
        with loop_rig() as rig:
            scenario, runtime = rig.scenario, rig.runtime(DpsAlone(rig.scenario))
            with Recorder(runtime, path):
                rig.run(runtime, round(simulated / PERIOD))
        log = read_log(path)
        ours, bare = interleaved_values(
            lambda: processor_time(lambda: _replay(path)),
            lambda: processor_time(lambda: _bare_steps(DpsAlone(scenario), log)),
            repeats=repeats,
        )
    duration = len(log) * PERIOD
    speed = duration / float(np.median(ours))
    return Benchmark(
        name="replay_cost",
        value=ratio(ours, bare),
        unit="1",
        goal=2.0,
        better=LOWER,
        against="the DPS's own steps in a bare loop, with the same values",
        note=f"{duration:.3g} s of the arm's DPS at 1 kHz: replayed in {spread(ours)}, stepped in {spread(bare)}; "
        f"{speed:.0f} times real time",
    )


def _bare_steps(target: DpsAlone, log: ControlLog) -> None:
    context = target.default_context()
    simulator, ports = target.simulator(context), RealPorts(target, context)
    outputs = [target.diagram.GetOutputPort(f"real.act.{name}") for name in log.actuation]
    for i in range(len(log)):
        for name, values in log.fed.items():
            ports.feed(name, values[i])
        simulator.AdvanceTo((i + 1) * PERIOD)
        for port in outputs:
            port.Eval(context)


def _replay(path: Path) -> None:
    report = replay(path)
    if not report.identical:
        raise RuntimeError(f"the replay is not identical: {report}")
