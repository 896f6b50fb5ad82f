"""Benchmark of a study of a camera's pose along a recorded motion."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

import numpy as np

from benchmarks.measure import HIGHER, Benchmark, interleaved_values, spread
from vtbdrake.rollout import RolloutResult, RolloutRunner
from vtbdrake_diagrams.satellite.studies.mount_placements import BY_HAND, FOUND_ON, mount_problem

CANDIDATES = 50


def camera_study_speedup(repeats: int = 2) -> Benchmark:
    """Return how much faster `CANDIDATES` placements of the docking camera are judged along one recorded capture.

    The comparison simulates each of them with its images from the start. Processor time, in one thread. The time of the
    study is the time for the recording and `CANDIDATES` times the time for a placement, each measured on placements by
    hand, in turns with whole rollouts.

    Raises:
        AssertionError: The results differ in any bit.
    """
    along, whole = (mount_problem(on=FOUND_ON[:1], recorded=recorded) for recorded in (True, False))
    runners = [RolloutRunner(problem.task, along.testbed) for problem in (along, whole)]
    points = [along.values(pose.tolist(), condition=0) for pose in BY_HAND.values()]
    results: list[list[RolloutResult]] = [[], []]

    def measure(which: int) -> float:
        point: Mapping[str, Any] = points[len(results[which]) % len(points)]
        begin = time.process_time()
        results[which].append(runners[which].run(point))
        return time.process_time() - begin

    first = measure(0)
    measure(1)
    ours, theirs = interleaved_values(lambda: measure(0), lambda: measure(1), repeats=repeats, warm_up=0)
    assert all(a.identical(b) for a, b in zip(*results, strict=True))
    study = first - float(np.median(ours)) + CANDIDATES * float(np.median(ours))
    return Benchmark(
        name="camera_study_speedup",
        value=CANDIDATES * float(np.median(theirs)) / study,
        unit="1",
        goal=7.0,
        better=HIGHER,
        against="simulating each candidate",
        note=f"{CANDIDATES} candidates, the recording included; {np.median(theirs) / np.median(ours):.3g} without it: "
        f"{spread(ours)} of processor time along the motion, {spread(theirs)} afresh; identical results",
    )
