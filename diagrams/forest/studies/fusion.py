"""Scanner and cameras of one localization unit, fused in one filter, beside each of them alone on the same drives.

``python -m vtbdrake_diagrams.forest.studies.fusion [--forests N] [--length M]`` drives a carrier with both sensors
through forests, once each, and localizes it three times from what was recorded: with the scanner, with the cameras,
with both. Three conditions are made from the same recordings (`CONDITIONS`): the sensors as they are, a scanner that
sees `SHORT` m far only, as in dust or snow, and a scanner that is silent in the second half of the drive.

The criteria, fixed before any of the forests from `SEED` on was driven: the error of the position over all sample times
of the judged part at which the unit claims a pose (RMS over all forests), the share of these times with a pose, wrong
claims as `drives` counts them, and the number of forests in which both sensors err less than the better one of the two.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from multiprocessing import get_context

import click
import numpy as np
from threadpoolctl import threadpool_limits

from vtbdrake.cli.output import table
from vtbdrake.components.localization.landmarks import Sighting
from vtbdrake_diagrams.forest.scenario import ForestScenario
from vtbdrake_diagrams.forest.studies.drives import STANDING, Drive, forest, localize, recorded_drive
from vtbdrake_diagrams.forest.world.stand import MAPS

SEED = 700_000
"""The seed of the first forest."""
SHORT = 12.0
"""The distance to which a scanner in dust or snow sees trunks, in m."""
MAP_NAMES = ("accurate", "remote")
"""The maps with which the unit localizes."""
SENSORS = {"scanner": "scanner", "cameras": "stereo", "both": "both"}
"""The perception of the scenario whose unit is used, by the name of the sensors."""


def _as_it_is(sighting: Sighting, time: float, *, middle: float) -> Sighting:
    return sighting


def _short(sighting: Sighting, time: float, *, middle: float) -> Sighting:
    if not sighting.is_scan:
        return sighting
    seen = sighting.landmarks
    return replace(sighting, landmarks=seen.select(np.hypot(*seen.positions.T) < SHORT))


def _silent(sighting: Sighting, time: float, *, middle: float) -> Sighting | None:
    return None if sighting.is_scan and time > middle else sighting


CONDITIONS: Mapping[str, Callable[..., Sighting | None]] = {
    "as it is": _as_it_is,
    f"scanner sees {SHORT:g} m": _short,
    "scanner falls silent": _silent,
}
"""The conditions: functions that return what is left of a sighting at a time, with the middle of the drive."""


def seen_by(drive: Drive, sensors: str, condition: str) -> Drive:
    """Return the drive with what some of the sensors see under a condition.

    Samples without anything are left in, without sightings: the carrier moves on by dead reckoning.

    Args:
        drive: The drive of a carrier with both sensors.
        sensors: ``scanner``, ``cameras`` or ``both``.
        condition: One of `CONDITIONS`.
    """
    see = partial(CONDITIONS[condition], middle=middle(drive))
    wanted = {"scanner": (True,), "cameras": (False,), "both": (True, False)}[sensors]
    landmarks = []
    for time, sightings in zip(drive.times, drive.landmarks, strict=True):
        remaining = [see(sighting, time) for sighting in sightings if sighting.is_scan in wanted]
        # Cameras alone are the sensor whose bias is estimated, as in their scenario.
        landmarks.append([replace(each, is_scan=each.is_scan or sensors == "cameras") for each in remaining if each])
    return replace(drive, landmarks=tuple(landmarks))


def middle(drive: Drive) -> float:
    """Return the time in the middle of the motion, in s."""
    return float(0.5 * (STANDING + drive.times[-1]))


@dataclass(frozen=True)
class Fusion:
    """Errors in one forest.

    Attributes:
        squares: Sum of the squared errors of the position in m^2 and the number of poses, by (condition, map, sensors).
        samples: The number of sample times that count, by condition.
        wrong: The number of wrong claims by (condition, map, sensors).
    """

    squares: Mapping[tuple[str, str, str], tuple[float, int]]
    samples: Mapping[str, int]
    wrong: Mapping[tuple[str, str, str], int]

    def rms(self, key: tuple[str, str, str]) -> float:
        """Return the RMS error of the position in m; infinite without a pose."""
        total, count = self.squares[key]
        return float(np.sqrt(total / count)) if count else np.inf


def compared(seed: int, *, length: float) -> Fusion:
    """Return the errors in the forest of a seed.

    Args:
        seed: Determines forest, route, start and noise.
        length: The length of the drive in m.
    """
    scenario = forest(seed, perception="both")
    with threadpool_limits(1):
        drive = recorded_drive(scenario, length=length)
        return judged(drive, scenario)


def judged(drive: Drive, scenario: ForestScenario) -> Fusion:
    """Return the errors of a drive.

    Args:
        drive: The drive of a carrier with both sensors.
        scenario: Its scenario.
    """
    squares, samples, wrong = {}, {}, {}
    for name, sensors in product(MAP_NAMES, SENSORS):
        of = replace(scenario, perception=SENSORS[sensors], map=name)
        unit = of.unit(of.global_map())
        for condition in CONDITIONS:
            counts = drive.times > (middle(drive) if condition == "scanner falls silent" else STANDING)
            samples[condition] = int(counts.sum())
            track = localize(seen_by(drive, sensors, condition), unit)
            is_claimed = track.is_localized & counts
            errors = np.hypot(*(track.poses - drive.truth)[is_claimed, :2].T)
            key = (condition, name, sensors)
            squares[key] = float((errors**2).sum()), len(errors)
            wrong[key] = int((errors > 0.5 + 4.0 * MAPS[name].position).sum())
    return Fusion(squares, samples, wrong)


def through(seeds: Sequence[int], *, length: float, workers: int = 2) -> Iterator[Fusion]:
    """Drive through the forests of some seeds in processes, and yield the errors in their order."""
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        yield from pool.map(partial(compared, length=length), seeds)


def report(forests: Sequence[Fusion]) -> str:
    """Return the table of some forests."""
    rows = []
    for condition in CONDITIONS:
        for name in MAP_NAMES:
            cells = []
            for sensors in SENSORS:
                key = (condition, name, sensors)
                total, count = np.sum([each.squares[key] for each in forests], axis=0)
                share = count / sum(each.samples[condition] for each in forests)
                false = sum(each.wrong[key] for each in forests)
                cells.append(f"{np.sqrt(total / count):.3f} m in {share:.0%}, {false} wrong" if count else "no pose")
            alone = [min(each.rms((condition, name, one)) for one in ("scanner", "cameras")) for each in forests]
            better = sum(
                each.rms((condition, name, "both")) < least for each, least in zip(forests, alone, strict=True)
            )
            rows.append((condition, name, *cells, f"{better} of {len(forests)}"))
    return table(("condition", "map", *SENSORS, "both better"), rows)


@click.command(context_settings={"show_default": True})
@click.option("--forests", default=20, help="Number of forests.")
@click.option("--seed", default=SEED, help="Seed of the first forest.")
@click.option("--length", default=20.0, help="The length of each drive in m.")
@click.option("--workers", default=2, help="Number of processes.")
def main(forests: int, seed: int, length: float, workers: int) -> None:
    """Run the drives, and print the table."""
    results = []
    for fusion in through(range(seed, seed + forests), length=length, workers=workers):
        results.append(fusion)
        print(f"{len(results)} of {forests}", flush=True)
    print(report(results))


if __name__ == "__main__":
    # Under its own name, so that worker processes find its classes.
    from vtbdrake_diagrams.forest.studies.fusion import main as program

    program()
