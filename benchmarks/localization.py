"""Benchmarks of the localization unit: an update from a scan to the pose, and a start without a guess on large maps."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np

from benchmarks.measure import LOWER, Benchmark, spread
from vtbdrake.components.localization.constellation import ConstellationMap
from vtbdrake.components.localization.landmarks import Landmarks, map_landmarks
from vtbdrake.components.localization.unit import TRACKING
from vtbdrake.testbed.slow_part import slow_parts
from vtbdrake_diagrams.forest.scenario import ForestScenario, scanner_config
from vtbdrake_diagrams.forest.studies.detections import Detector, Wood
from vtbdrake_diagrams.forest.world.stand import ACCURATE, Stand

POINTS = 20_000
DUE = 0.07  # s after the end of a scan, when the localizer has taken it
AGAINST = "real time, on one core"


def localization_update_p50(scans: int = 40, pairs: int = 20, starts: int = 10) -> list[Benchmark]:
    """CPU time from a scan of 20,000 points to the pose on an accurate map, and of starts without a guess.

    An update is the whole function of the slow part ``localizer``: de-skewing, ground, trunks, and the filter, with the
    conversion of scan and memory from and to arrays. Beside it, the update by a pair of images, and the matching of one
    scan with maps of 1, 10 and 100 ha.
    """
    # More than half of the rays go into the sky, or to where nothing returns.
    scanner = scanner_config()
    scanner = replace(scanner, rays_per_second=2.4 * POINTS * scanner.frequency)
    stereo = ForestScenario(seed=100, perception="stereo")
    pixels = stereo.stereo.width * stereo.stereo.height
    return [
        _update("localization_update_p50", ForestScenario(seed=100, scanner=scanner), scans, goal=25.0),
        _update("localization_update_stereo", stereo, pairs, goal=None, size=f"pairs of images of {pixels} pixels"),
        *(_start(hectares, starts) for hectares in (1, 10, 100)),
    ]


def _update(name: str, scenario: ForestScenario, count: int, *, goal: float | None, size: str = "") -> Benchmark:
    """CPU time of the localizer's function at the beginning of a drive."""
    period = 1.0 / (scenario.stereo.fps if scenario.perception == "stereo" else scenario.scanner.frequency)
    testbed = scenario.build()
    (part,) = slow_parts(testbed.diagram).values()
    context = testbed.default_context()
    simulator = testbed.simulator(context)
    seconds, points, tracked = [], [], 0
    for k in range(1, count + 1):
        simulator.AdvanceTo(k * period + DUE)
        (arrays,) = part.waiting(context).values()
        sample = {**arrays, **part.memory(context)}
        begin = time.process_time()
        made = part.function(sample)
        seconds.append(time.process_time() - begin)
        points.append(len(arrays["scan.ranges"]) if "scan.ranges" in arrays else 0)
        tracked += int(made["status"].item()) == TRACKING
    return Benchmark(
        name=name,
        value=1e3 * float(np.median(seconds)),
        unit="ms",
        goal=goal,
        better=LOWER,
        absolute="" if goal is None else "a quarter of the period of a scanner at 10 Hz",
        against=AGAINST,
        note=f"{spread(1e3 * np.array(seconds), unit='ms')}; {size or f'scans of {np.median(points):.0f} points'}, "
        f"{tracked} of {count} while it tracks; {made['matched'].item():.0f} trunks matched in the last",
    )


def _start(hectares: int, starts: int) -> Benchmark:
    """CPU time of the matching of one scan with a map of ``hectares`` hectares, which a row of stands of 1 ha makes."""
    stands = [Stand(seed=k) for k in range(hectares)]
    side = stands[0].length
    maps = [map_landmarks(stand.map(ACCURATE)).seen_from([k * side, 0.0, 0.0]) for k, stand in enumerate(stands)]
    whole = Landmarks.joined(maps)
    begin = time.process_time()
    table = ConstellationMap(whole)
    built = time.process_time() - begin
    rng, detector = np.random.default_rng(0), Detector()
    # Where the carrier stands, in a stand among others.
    wood = Wood.of(stands[-1], false=detector.false, rng=rng)
    seconds, right = [], 0
    for _ in range(starts):
        # All that is seen is in the last stand.
        X_WH = np.array([*rng.uniform(detector.reach, side - detector.reach, 2), rng.uniform(-np.pi, np.pi)])
        local, _ = wood.detected(X_WH, detector, rng)
        begin = time.process_time()
        fix = table.locate(local)
        seconds.append(time.process_time() - begin)
        off = np.linalg.norm(fix.pose[:2] - X_WH[:2] - [(hectares - 1) * side, 0.0])
        right += bool(fix.is_sure and off < 1.0)
    return Benchmark(
        name=f"localization_start_{hectares}ha",
        value=1e3 * float(np.median(seconds)),
        unit="ms",
        goal=None,
        better=LOWER,
        against=AGAINST,
        note=f"{spread(1e3 * np.array(seconds), unit='ms')}; sure and right in {right} of {starts}; "
        f"{len(whole)} trees, whose table takes {built:.2f} s once",
    )
