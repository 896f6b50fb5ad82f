"""Benchmarks of the satellite: how much faster than real time a capture is simulated."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np

from benchmarks.measure import HIGHER, Benchmark, spread
from vtbdrake_diagrams.satellite import SatelliteScenario
from vtbdrake_diagrams.satellite.supervisor import Mode

MODE = "dps.impl.supervisor.mode"


def capture_rtf_images(repeats: int = 2, duration: float = 15.0) -> list[Benchmark]:
    """Simulated seconds of a capture with camera and laser scanner, per second of CPU time of all threads.

    The camera renders images of 320 x 240 pixels at its rate, with sun, shadows and noise; their markers are detected,
    and scans are cast and registered. Beside it, the same with the camera alone.
    """
    scenario = SatelliteScenario()
    return [
        _real_time_factor("capture_rtf_images", scenario, repeats, duration, goal=2.0),
        _real_time_factor("capture_rtf_camera", replace(scenario, perception="camera"), repeats, duration, goal=None),
    ]


def _real_time_factor(
    name: str, scenario: SatelliteScenario, repeats: int, duration: float, *, goal: float | None
) -> Benchmark:
    testbed = scenario.build()
    factors = []
    for _ in range(repeats):
        context = testbed.default_context()
        simulator = testbed.simulator(context)
        simulator.Initialize()
        begin = time.process_time()
        simulator.AdvanceTo(duration)
        factors.append(duration / (time.process_time() - begin))
    size = f"{scenario.image_width} x {scenario.image_height} pixels, {scenario.camera_fps:g} images/s, "
    return Benchmark(
        name=name,
        value=float(np.median(factors)),
        unit="1",
        goal=goal,
        better=HIGHER,
        absolute="" if goal is None else "real time, which a machine with images in the loop keeps",
        against="real time, on one core",
        note=f"{spread(np.array(factors), unit='x')}; {size if scenario.aboard else ''}"
        f"{duration:g} s, in which the supervisor comes to {Mode(int(testbed.read(context, MODE))).label}",
    )
