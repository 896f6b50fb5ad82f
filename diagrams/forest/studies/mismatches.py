"""Pairs of a scan and a map that does not show the place of the scan: how often is a pose claimed all the same?

``python -m vtbdrake_diagrams.forest.studies.mismatches [--pairs N] [--seed S]`` draws random pairs of each kind,
matches them (`ConstellationMap.locate`), and prints how many were sure: each of them is wrong. It also prints the
largest logarithm of the likelihood ratio, and the one that came nearest to what is required. Only poses without a rival
of more than half of it count there: in the rows of plantations many poses have large ratios, and refuse each other. The
kinds:

* ``mirrored``: the map of the same stand in a mirror, so that density, diameters and the kind of pattern are the same;
  whole or only a square of 20 to 60 m around the place.
* ``other``: the map of another stand of the same kind and density.
* ``recorded``: stems of real laser scans against the mirrored inventories of real plots of 40 m, with deviations that
  are assumed at random, and parts of scans and maps left out at random. Half of the mirrored maps of this kind are of
  the scan's own plot.
* ``mixed``: stems of real scans on maps of simulated stands.

Stands are natural (Poisson with a least distance), clustered, windthrown, or plantations with rows.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import click
import numpy as np

from vtbdrake.cli.output import table
from vtbdrake.components.localization.constellation import ConstellationMap, Fix
from vtbdrake.components.localization.landmarks import Landmarks, map_landmarks
from vtbdrake_diagrams.forest.studies.detections import Detector, Wood
from vtbdrake_diagrams.forest.studies.recordings import FOLDER, rioja, stems
from vtbdrake_diagrams.forest.world.stand import KINDS, MAPS, Stand

SEED = 800_000
DENSITIES = (300.0, 1500.0)
"""The range of the densities of natural and clustered stands, in trees per hectare."""
EXTENTS = (40.0, 100.0)
"""The range of the sides of stands, in m."""
SIDES = (20.0, 60.0)
"""The range of the sides of the parts of maps, in m."""
PER_BATCH = 10
"""The number of pairs that share stands and maps."""


@dataclass(frozen=True)
class Pair:
    """One match of a scan with a map that does not show its place.

    Attributes:
        kind: The kind of the pair.
        fix: The result.
        required: The logarithm of the likelihood ratio that a sure pose would need on this map.
    """

    kind: str
    fix: Fix
    required: float


def mirrored(landmarks: Landmarks) -> Landmarks:
    """Return landmarks in a mirror along the x axis."""
    mirror = np.diag([1.0, -1.0])
    return Landmarks(
        landmarks.positions @ mirror,
        mirror @ landmarks.covariances @ mirror,
        landmarks.diameters,
        landmarks.diameter_deviations,
    )


def simulated_pairs(seed: int) -> Iterator[Pair]:
    """Yield `PER_BATCH` pairs from simulated stands, of the kinds ``mirrored`` and ``other``."""
    rng = np.random.default_rng([seed, 12])
    kind = str(rng.choice(KINDS))
    density = 1000.0 if kind == "plantation" else float(rng.uniform(*DENSITIES))
    side = float(rng.uniform(*EXTENTS))
    mapped, other = (
        Stand(seed=seed + shift, density=density, kind=kind, length=side, width=side) for shift in (0, 10**6)
    )
    name = str(rng.choice(["accurate", "remote", "poor"]))
    detector = Detector(false=rng.uniform(0.2, 0.4))
    wood = Wood.of(mapped, false=detector.false, rng=rng)
    whole = mirrored(map_landmarks(mapped.map(MAPS[name])))
    maps = {"other": _prepared(map_landmarks(other.map(MAPS[name])), name), "mirrored": _prepared(whole, name)}
    for k in range(PER_BATCH):
        pose = np.array([*rng.uniform(0.1 * side, 0.9 * side, 2), rng.uniform(-np.pi, np.pi)])
        local, _ = wood.detected(pose, detector, rng)
        label = ("mirrored", "other")[k % 2]
        constellation = maps[label]
        if label == "mirrored" and k % 4:
            reach = np.abs(whole.positions - pose[:2] * [1.0, -1.0]).max(axis=1)
            part = whole.select(reach < 0.5 * rng.uniform(*SIDES))
            if len(part) < 3:
                continue
            constellation = _prepared(part, name)
        yield _matched(label, constellation, local)


def recorded_pairs(seed: int, tables: tuple[dict[str, Any], dict[str, Any]]) -> Iterator[Pair]:
    """Yield `PER_BATCH` pairs with stems of real scans, of the kinds ``recorded`` and ``mixed``."""
    rng = np.random.default_rng([seed, 13])
    scans, inventories = tables
    name = str(rng.choice(["accurate", "remote"]))
    stand = Stand(seed=seed, density=float(rng.uniform(*DENSITIES)), kind=str(rng.choice(KINDS[:2])))
    simulated = _prepared(map_landmarks(stand.map(MAPS[name])), name)
    for k in range(PER_BATCH):
        plot = int(rng.integers(1, 17))
        deviation, diameter = rng.uniform(0.03, 0.2), rng.uniform(0.01, 0.03)
        local = _thinned(stems(scans, plot, deviation=deviation, diameter=diameter), rng)
        if k % 2:
            yield _matched("mixed", simulated, local)
            continue
        mapped = plot if rng.random() < 0.5 else int(rng.integers(1, 17))
        inventory = stems(inventories, mapped, deviation=rng.uniform(0.05, 0.5), diameter=rng.uniform(0.01, 0.04))
        yield _matched("recorded", ConstellationMap(mirrored(_thinned(inventory, rng))), local)


def _thinned(landmarks: Landmarks, rng: np.random.Generator) -> Landmarks:
    """Return landmarks; up to a third are left out."""
    return landmarks.select(rng.random(len(landmarks)) > rng.uniform(0.0, 0.33))


def _prepared(landmarks: Landmarks, name: str) -> ConstellationMap:
    return ConstellationMap(landmarks, correlation=MAPS[name].correlation)


def _matched(kind: str, constellation: ConstellationMap, local: Landmarks) -> Pair:
    return Pair(kind, constellation.locate(local), constellation.required(local))


def pairs(count: int, *, seed: int = SEED, recordings: bool = True) -> Iterator[Pair]:
    """Yield random pairs: half of them with real scans, or none of them.

    Args:
        count: The number of pairs.
        seed: Determines the pairs.
        recordings: Whether real scans take part.

    Raises:
        FileNotFoundError: The recordings are not there.
    """
    tables = rioja() if recordings else None
    produced = 0
    for batch in range(seed, seed + 10 * count):
        for pair in simulated_pairs(batch) if tables is None or batch % 2 else recorded_pairs(batch, tables):
            yield pair
            produced += 1
            if produced == count:
                return


def row(kind: str, pairs: list[Pair]) -> tuple[str, ...]:
    """Return the row of the table of one kind of pairs."""
    alone = [pair for pair in pairs if 2.0 * pair.fix.margin >= pair.fix.log_likelihood]
    nearest = max(alone, key=lambda pair: pair.fix.log_likelihood - pair.required, default=None)
    return (
        kind,
        str(len(pairs)),
        str(sum(pair.fix.is_sure for pair in pairs)),
        f"{max(pair.fix.log_likelihood for pair in pairs):.1f}",
        f"{nearest.fix.log_likelihood:.1f} of {nearest.required:.1f}" if nearest else "",
    )


HEADER = ("kind", "pairs", "wrong and sure", "largest ln L", "nearest to what is required, without a rival")


@click.command(context_settings={"show_default": True})
@click.option("--pairs", "count", default=10_000, help="Number of pairs.")
@click.option("--seed", default=SEED, help="Seed of the pairs.")
def main(count: int, seed: int) -> None:
    """Match pairs, and print the table."""
    has_recordings = (FOLDER / "fortls_rioja").is_dir()
    if not has_recordings:
        print(f"no recordings in {FOLDER}: simulated stands only")
    results: dict[str, list[Pair]] = {}
    for pair in pairs(count, seed=seed, recordings=has_recordings):
        results.setdefault(pair.kind, []).append(pair)
    print(table(HEADER, [row(kind, pairs_of_kind) for kind, pairs_of_kind in results.items()]))
    every = [pair for pairs_of_kind in results.values() for pair in pairs_of_kind]
    print(f"{sum(pair.fix.is_sure for pair in every)} of {len(every)} pairs were wrong and sure")


if __name__ == "__main__":
    main()
