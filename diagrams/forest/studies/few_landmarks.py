"""Scans that show only a few landmarks: from how many on is a pose safe, and how many scans are located?

``python -m vtbdrake_diagrams.forest.studies.few_landmarks [--pairs N] [--seed S]`` leaves the nearest landmarks of each
scan, `FEW` of them at random, lets `ConstellationMap` claim a pose with so few (``fewest``), and prints for each number
of landmarks how often a pose was claimed: on maps that show the place of the scan, whole or a square of `SIDES` around
it, and on maps that do not: the same ones in a mirror, other stands, other plots. A claim is wrong if the map does not
show the place, or if the pose is farther than `RIGHT` from the true one.

Half of the scans are simulated, with detections 1 to 5 times as inaccurate as `Detector` says, and covariances that say
so, in the stands of `mismatches`; the others are stems of the real scans of La Rioja. Point clouds have no part.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import click
import numpy as np

from vtbdrake.cli.output import table
from vtbdrake.common.arrays import Array
from vtbdrake.components.localization.constellation import ConstellationMap
from vtbdrake.components.localization.landmarks import Landmarks, map_landmarks
from vtbdrake_diagrams.forest.studies.detections import Detector, Wood
from vtbdrake_diagrams.forest.studies.mismatches import DENSITIES, EXTENTS, mirrored
from vtbdrake_diagrams.forest.studies.recordings import FOLDER, rioja, stems
from vtbdrake_diagrams.forest.world.stand import KINDS, MAPS, Stand

SEED = 900_000
FEW = (4, 15)
"""The least and the largest number of landmarks of a scan."""
SIDES = (10.0, 60.0)
"""The range of the sides of the parts of maps, in m."""
RIGHT = 1.0
"""A pose within this distance of the true one is right, in m. A real scan's true pose is the one of all its 26 to 47
stems on all trees of its plot, which is sure (`vtbdrake_diagrams.forest.reality`)."""
PER_BATCH = 12
"""The number of scans that share stands."""


@dataclass(frozen=True)
class Claim:
    """One scan of few landmarks on one map.

    Attributes:
        landmarks: The number of landmarks of the scan.
        is_shown: Whether the map shows the place of the scan.
        is_sure: Whether the pose is sure.
        is_right: Whether the map shows the place, and the pose is right.
    """

    landmarks: int
    is_shown: bool
    is_sure: bool
    is_right: bool


def claimed(local: Landmarks, mapped: Landmarks, place: Array | None) -> Claim:
    """Match a scan with a map that shows it at a place (2,), or does not show it (None)."""
    fix = ConstellationMap(mapped, fewest=FEW[0]).locate(local)
    is_right = place is not None and bool(np.hypot(*(fix.pose[:2] - place)) < RIGHT)
    return Claim(len(local), place is not None, fix.is_sure, is_right)


def simulated_claims(seed: int) -> Iterator[Claim]:
    """Yield the claims of `PER_BATCH` simulated scans: on their own map, on its mirror image, on another stand's."""
    rng = np.random.default_rng([seed, 21])
    kind, side = str(rng.choice(KINDS)), float(rng.uniform(*EXTENTS))
    density = 1000.0 if kind == "plantation" else float(rng.uniform(*DENSITIES))
    stand, other = (
        Stand(seed=seed + shift, density=density, kind=kind, length=side, width=side) for shift in (0, 10**6)
    )
    name = str(rng.choice(["accurate", "remote"]))
    worse = rng.uniform(1.0, 5.0)
    detector = Detector(false=rng.uniform(0.2, 0.4), along=0.03 * worse, across=0.02 * worse, diameter=0.02 * worse)
    wood = Wood.of(stand, false=detector.false, rng=rng)
    whole, foreign = (map_landmarks(each.map(MAPS[name])) for each in (stand, other))
    for _ in range(PER_BATCH):
        pose = np.array([*rng.uniform(0.1 * side, 0.9 * side, 2), rng.uniform(-np.pi, np.pi)])
        local = nearest(wood.detected(pose, detector, rng)[0], rng)
        reach = 0.5 * rng.uniform(*SIDES) if rng.random() < 0.75 else np.inf
        part, away = (each.select(np.abs(each.positions - pose[:2]).max(axis=1) < reach) for each in (whole, foreign))
        if len(part) >= 3:
            yield claimed(local, part, pose[:2])
            yield claimed(local, mirrored(part), None)
        if len(away) >= 3:
            yield claimed(local, away, None)


def recorded_claims(
    seed: int, tables: tuple[dict[str, Any], dict[str, Any]], places: dict[int, Array]
) -> Iterator[Claim]:
    """Yield the claims of `PER_BATCH` real scans: on their plot, on its mirror image, on another plot's.

    Args:
        seed: Determines the scans.
        tables: The tables of scans and inventories, see `rioja`.
        places: The place (2,) of the scanner in each plot.
    """
    rng = np.random.default_rng([seed, 22])
    scans, inventories = tables
    for _ in range(PER_BATCH):
        plot, other = 1 + rng.permutation(16)[:2]
        deviation, diameter = rng.uniform(0.05, 0.2), rng.uniform(0.02, 0.06)
        local = nearest(stems(scans, plot, deviation=deviation, diameter=diameter), rng)
        reach = 0.5 * rng.uniform(*SIDES)
        part, away = (
            each.select(np.abs(each.positions).max(axis=1) < reach)
            for each in (stems(inventories, k, deviation=0.1, diameter=0.03) for k in (plot, other))
        )
        if min(len(part), len(away)) >= 3:
            yield claimed(local, part, places[plot])
            yield claimed(local, mirrored(part), None)
            yield claimed(local, mirrored(away), None)


def scanner_places(tables: tuple[dict[str, Any], dict[str, Any]]) -> dict[int, Array]:
    """Return the places (2,) of the scanners of La Rioja, by all stems of each scan on all trees of its plot."""
    places = {}
    for plot in range(1, 17):
        local, inventory = (stems(each, plot, deviation=0.1, diameter=0.03) for each in tables)
        fix = ConstellationMap(inventory).locate(local)
        if not fix.is_sure:
            raise ValueError(f"the scan of plot {plot} is not sure on its plot: its place is unknown")
        places[plot] = fix.pose[:2]
    return places


def nearest(landmarks: Landmarks, rng: np.random.Generator) -> Landmarks:
    """Return the landmarks nearest to the scanner, `FEW` of them at random."""
    order = np.hypot(*landmarks.positions.T).argsort()
    return landmarks.select(order[: rng.integers(FEW[0], FEW[1] + 1)])


def claims(count: int, *, seed: int = SEED, recordings: bool = True) -> Iterator[Claim]:
    """Yield claims: half of the batches with real scans, or none of them.

    Args:
        count: The number of claims.
        seed: Determines them.
        recordings: Whether real scans take part.

    Raises:
        FileNotFoundError: The recordings are not there.
    """
    tables = rioja() if recordings else None
    places = scanner_places(tables) if tables else {}
    produced = 0
    for batch in range(seed, seed + 10 * count):
        real = tables and batch % 2 == 0
        for claim in recorded_claims(batch, tables, places) if real else simulated_claims(batch):
            if claim.landmarks < FEW[0]:
                continue
            yield claim
            produced += 1
            if produced == count:
                return


def row(label: str, results: list[Claim]) -> tuple[str, ...]:
    """Return the row of the table of the claims of one number of landmarks."""
    shown = [each for each in results if each.is_shown]
    sure = [each for each in shown if each.is_sure]
    elsewhere = [each for each in results if not each.is_shown]
    return (
        label,
        f"{sum(each.is_right for each in sure)} of {len(shown)}",
        str(sum(not each.is_right for each in sure)),
        f"{sum(each.is_sure for each in elsewhere)} of {len(elsewhere)}",
    )


HEADER = ("landmarks", "own map: sure and right", "sure and wrong", "other map: sure, all wrong")


@click.command(context_settings={"show_default": True})
@click.option("--pairs", "count", default=20_000, help="Number of scans on maps.")
@click.option("--seed", default=SEED, help="Seed of the scans and maps.")
def main(count: int, seed: int) -> None:
    """Match scans of few landmarks, and print the table."""
    has_recordings = (FOLDER / "fortls_rioja").is_dir()
    if not has_recordings:
        print(f"no recordings in {FOLDER}: simulated stands only")
    results = list(claims(count, seed=seed, recordings=has_recordings))
    numbers = range(FEW[0], FEW[1] + 1)
    rows = [row(str(number), [each for each in results if each.landmarks == number]) for number in numbers]
    print(table(HEADER, [*rows, row("all", results)]))


if __name__ == "__main__":
    main()
