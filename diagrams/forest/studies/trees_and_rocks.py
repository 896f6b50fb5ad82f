"""Trees and rocks as landmarks: the unit with trunks alone, with rocks alone, and with both, on the same drives.

``python -m vtbdrake_diagrams.forest.studies.trees_and_rocks`` drives the machine through `FORESTS` forests, once each,
with rocks that cover 3 to 10 % of the ground (`drives.ABUNDANCES`). The scanner is the one for rocks, with 64 rows.
Both detectors work on the same scans, of the whole world: trunks, bushes and branches may be taken for rocks. From what
they detect, the unit is localized three times, with a map of the trees, of the rocks, and of both; one filter takes
both as landmarks, and uses their diameters, not their kinds. What is in `FILE` is not driven again.

The criteria, fixed before any of the forests from `SEED` on was driven (nothing was tuned; forests 300,000, 300,001 and
300,020 were looked at): over all forests, with each map and each kind, the ones of `on_foot` but for dead reckoning: a
pose in 90 % of the scans, no wrong claim, the goal of `drives` for the map, and the mean NEES of the last poses at most
the upper 95 % bound. And both must be no worse than trunks alone: an RMS error of at most `LARGEST_RATIO` times theirs,
and no fewer poses (by more than a percent of the scans).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path

import click
import numpy as np
from threadpoolctl import threadpool_limits

from vtbdrake.components.localization.landmarks import Landmarks, SensorView
from vtbdrake_diagrams.forest.perception import LandmarkSensor
from vtbdrake_diagrams.forest.scenario import LANDMARKS, ForestScenario
from vtbdrake_diagrams.forest.studies.drive import Drive, localize, recorded_drive
from vtbdrake_diagrams.forest.studies.drives import ABUNDANCES, forest
from vtbdrake_diagrams.forest.studies.on_foot import MAP_NAMES, Way, Ways, judged, load, report, summary
from vtbdrake_diagrams.kept_results import add_results
from vtbdrake_diagrams.plain.scenario import scanner_config

SEED = 740_000
"""The seed of the first forest."""
FORESTS = 20
"""The number of forests."""
LENGTH = 12.0
"""The length of a drive in m."""
LARGEST_RATIO = 1.05
"""The largest ratio of the error with both kinds to the error with trunks that counts as no worse."""
LOST_SHARE = 0.01
"""The share of poses that both kinds may have less than trunks."""
FILE = Path(__file__).with_suffix(".json")
"""The file in which the results are kept."""


def rocky(seed: int) -> ForestScenario:
    """Return the scenario of a drive: the forest, route and start of `drives.forest`, with rocks."""
    cover = float(np.random.default_rng([seed, 23]).uniform(*ABUNDANCES))
    return replace(forest(seed), rock_cover=cover, landmarks="both", scanner=scanner_config())


def with_landmarks(drive: Drive, classes: Sequence[str], kinds: Sequence[str]) -> Drive:
    """Return a drive with what some of its views show, joined in one view.

    Args:
        drive: The drive, with one view per class.
        classes: The classes of the views, in their order.
        kinds: The classes that are used.
    """
    used = [classes.index(kind) for kind in kinds]
    landmarks = []
    for views in drive.landmarks:
        shown = [SensorView.of(view) for view in views]
        landmarks.append([replace(shown[0], landmarks=Landmarks.joined([shown[k].landmarks for k in used]))])
    return replace(drive, landmarks=tuple(landmarks))


def driven(seed: int, *, length: float = LENGTH) -> list[Way]:
    """Return the results in the forest of a seed.

    Args:
        seed: Determines forest, rocks, route, start and noise.
        length: The length of the drive in m.
    """
    scenario, ways = rocky(seed), []
    # One thread: matrices are small, and threads that wait for each other take most of the time.
    with threadpool_limits(1):
        detectors = [LandmarkSensor(scenario.detector_of(kind)) for kind in scenario.classes]
        drive = recorded_drive(scenario, length=length, detectors=detectors)
        for (variant, kinds), name in product(LANDMARKS.items(), MAP_NAMES):
            surveyed = replace(scenario, map=name, landmarks=variant)
            shown = with_landmarks(drive, scenario.classes, kinds)
            ways.append(judged(localize(shown, surveyed.unit(surveyed.global_map())), variant, name))
    return ways


def both_no_worse(ways: Ways, name: str) -> bool:
    """Return whether both kinds are no worse than trunks alone, with a map of this name."""
    trees, both = (summary(ways, variant, name) for variant in ("trees", "both"))
    return both.rms <= LARGEST_RATIO * trees.rms and both.localized >= trees.localized - LOST_SHARE


def in_words(ways: Ways) -> str:
    """Return what rocks give beside trunks, in a few sentences."""
    parts = []
    for variant, name in product(LANDMARKS, MAP_NAMES):
        each = summary(ways, variant, name)
        verdict = f" (NOT met: {each.missed(name)})" if each.missed(name) else ""
        parts.append(f"{variant} {name} {each.rms:.3f} m in {each.localized:.0%}{verdict}")
    verdicts = [f"{name}: {'no worse' if both_no_worse(ways, name) else 'WORSE'}" for name in MAP_NAMES]
    return (
        f"By trunks, by rocks and by both as landmarks, in {len(ways)} other forests with rocks, RMS and share of "
        f"poses: {'; '.join(parts)}. Both beside trunks alone: {', '.join(verdicts)}."
    )


@click.command(context_settings={"show_default": True})
@click.option("--forests", default=FORESTS, help="Number of forests.")
@click.option("--workers", default=2, help="Number of processes.")
def main(forests: int, workers: int) -> None:
    """Drive through the forests that the file lacks, and print the table of all."""
    results = load(FILE) if FILE.exists() else {}
    command = "python -m vtbdrake_diagrams.forest.studies.trees_and_rocks"
    add_results(FILE, results, range(SEED, SEED + forests), driven, command=command, workers=workers)
    print(report(results, tuple(LANDMARKS)))
    print(in_words(results))


if __name__ == "__main__":
    # Under its own name, so that worker processes find its classes.
    from vtbdrake_diagrams.forest.studies.trees_and_rocks import main as program

    program()
