"""Poses of scans that are cut out of raw real clouds: they are located on the stems of their plots, without a guess.

``python -m vtbdrake_diagrams.forest.studies.cloud_poses FOLDER`` prints the tables of docs/reality_forest.md. Scans
and stems come from `vtbdrake_diagrams.forest.reality`, turned and moved. Nothing is chosen by what is printed:

* The least number of landmarks of a pose, `FEWEST`, is the one of the car in Victoria Park. With so few, no pose is
  wrong in the scans of `vtbdrake_diagrams.forest.studies.few_landmarks`, where no point cloud has part.
* The outline of trunks (`TrunkDetectorConfig.outline`) of a cloud is the likeliest one in the clouds of other places.
* On the way, landmarks are gathered as the localization unit does (`Submap`), with the drift of a carrier on wheels,
  along a route over the grid of scanners: for each scan as the last one of a route.

A pose is wrong if it is sure and farther than `RIGHT` from the true one. On the mirror image of the stems, which does
not show the place of any scan, each sure pose is wrong.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import click
import numpy as np
from numpy.typing import NDArray

from vtbdrake.cli.output import table
from vtbdrake.common.arrays import Array
from vtbdrake.components.localization.constellation import ConstellationMap, Fix
from vtbdrake.components.localization.dead_reckoning import DriftModel
from vtbdrake.components.localization.landmarks import Landmarks
from vtbdrake.components.localization.planar import compose, inverse, transform
from vtbdrake.components.localization.submap import Submap
from vtbdrake_diagrams.forest.reality import (
    FROM_THE_AIR,
    Detection,
    Errors,
    Plot,
    as_landmarks,
    detections,
    grid,
    grid_step,
    plots,
)
from vtbdrake_diagrams.forest.studies.mismatches import mirrored

FEWEST = 8
"""The least number of landmarks of a pose."""
RIGHT = 0.5
"""A pose within this distance of the true one is right, in m."""
SCANS = (2, 3, 4)
"""The numbers of scans that are gathered on the way."""
FORMER = 16
"""The least number of landmarks by default, with which scans were located before."""
SPEED = 1.0
"""The speed of the carrier in m/s."""
WHEELS = 0.02
"""Standard deviation of the scale of the wheels, constant along a route, which `DriftModel` does not contain."""
SEED = 0
"""Seed of the drift along the routes."""
PRECISE = 0.03
"""Standard deviation of positions, per axis, and diameters that are taken from the rings, in m."""
REASONS = ("few landmarks", "little evidence", "rival or fit")
"""Why a pose is not sure: the first of these that holds."""
# The pose of the cloud in the world of the map.
_X_WC = np.array([100.0, -50.0, 2.0])
# Standard deviation of the stems on the map, per axis, in m.
_MAPPED = 0.05


@dataclass(frozen=True, eq=False)
class Chain:
    """The scans of one cloud, and what they are located on.

    Attributes:
        plot: The cloud.
        scans: The detections in each scan.
        outline: The outline of trunks in m, by other places.
    """

    plot: Plot
    scans: list[Detection]
    outline: float

    def stems(self) -> Landmarks:
        """Return the stems of the plot as a map in W."""
        return as_landmarks(self.plot.full[:, :2], self.plot.full[:, 2], deviation=_MAPPED).seen_from(_X_WC)

    def place(self, scan: Detection) -> Array:
        """Return the true place (2,) of a scanner in W."""
        return transform(_X_WC, scan.eye[None, :2])[0]

    def trunks(self, scan: Detection) -> Landmarks:
        """Return the detections in a scan, with the outline."""
        return scan.with_outline(self.outline)


@dataclass(frozen=True, eq=False)
class Located:
    """One scan, located.

    Attributes:
        fix: The pose.
        landmarks: The number of local landmarks.
        required: The log-likelihood ratio that a sure pose takes.
        delta: The place less the true one in m, (2,).
    """

    fix: Fix
    landmarks: int
    required: float
    delta: Array

    @classmethod
    def of(cls, constellation: ConstellationMap, local: Landmarks, place: Array) -> Located:
        """Return landmarks on a map, if the true place is at (2,)."""
        fix = constellation.locate(local)
        return cls(fix, len(local), constellation.required(local) if len(local) else np.inf, fix.pose[:2] - place)

    @property
    def error(self) -> float:
        """Return the distance from the true place in m."""
        return float(np.hypot(*self.delta))

    @property
    def is_wrong(self) -> bool:
        """Return whether the pose is sure and wrong."""
        return self.fix.is_sure and self.error >= RIGHT

    @property
    def refusal(self) -> str:
        """Return the first reason why the pose is not sure; empty if it is."""
        if self.fix.is_sure:
            return ""
        if self.landmarks < FEWEST:
            return REASONS[0]
        return REASONS[1] if self.fix.log_likelihood <= self.required else REASONS[2]


def place_of(name: str) -> str:
    """Return the name of the place of a cloud: clouds of one place share trees."""
    return FROM_THE_AIR[name][1] if name in FROM_THE_AIR else name


def chains(folder: Path) -> list[Chain]:
    """Return the chains of all clouds."""
    scanned = []
    for plot in plots(folder):
        places = grid(plot.cloud, grid_step(plot.cloud))
        scanned.append((plot, list(detections(plot.cloud, plot.full, plot.partial, noise=plot.noise, places=places))))
    errors = [Errors.of(plot.full, scans) for plot, scans in scanned]
    result = []
    for plot, scans in scanned:
        elsewhere = [
            part
            for part, (other, _) in zip(errors, scanned, strict=True)
            if place_of(other.name) != place_of(plot.name)
        ]
        result.append(Chain(plot, scans, Errors.joined(elsewhere).likeliest()))
    return result


def located(chain: Chain, local_of: Callable[[Detection], Landmarks], *, fewest: int = FEWEST) -> list[Located]:
    """Return each scan on the stems of its plot, by the landmarks that a function returns of it."""
    constellation = ConstellationMap(chain.stems(), fewest=fewest)
    return [Located.of(constellation, local_of(scan), chain.place(scan)) for scan in chain.scans]


def chain_row(chain: Chain) -> tuple[str, ...]:
    """Return the row of one cloud: its scans, one at a time."""
    former, fewer = (located(chain, lambda scan: scan.trunks, fewest=fewest) for fewest in (FORMER, FEWEST))
    results = located(chain, chain.trunks)
    mirror = ConstellationMap(mirrored(chain.stems()), fewest=FEWEST)
    return (
        chain.plot.name,
        str(len(chain.plot.full)),
        f"{np.median([len(scan.trunks) for scan in chain.scans]):.0f}",
        f"{np.median([len(scan.stems) for scan in chain.scans]):.0f}",
        *(_sure(each) for each in (former, fewer)),
        f"{chain.outline:.2f}",
        _sure(results),
        *_errors(results),
        str(sum(mirror.locate(chain.trunks(scan)).is_sure for scan in chain.scans)),
    )


def _sure(results: list[Located]) -> str:
    sure, wrong = sum(each.fix.is_sure for each in results), sum(each.is_wrong for each in results)
    return f"{sure} of {len(results)}, {wrong}"


def _errors(results: list[Located]) -> tuple[str, str]:
    """Return the median distance of sure poses from the true ones, and their mean square by the covariance."""
    sure = [each for each in results if each.fix.is_sure]
    if not sure:
        return "", ""
    squares = [each.delta @ np.linalg.solve(each.fix.covariance[:2, :2], each.delta) for each in sure]
    return f"{np.median([each.error for each in sure]):.3f}", f"{np.mean(squares):.1f}"


def refusal_row(chain: Chain) -> tuple[str, ...]:
    """Return the row of one cloud: why poses are not sure, and how many would be with better detections."""
    results = located(chain, chain.trunks)
    refusals = [each.refusal for each in results]
    oracles = (
        lambda scan: chain.trunks(scan).select(scan.matched),
        lambda scan: _of_rings(chain, scan, scan.stems),
        lambda scan: _of_rings(chain, scan, _in_view(scan)),
    )
    return (
        chain.plot.name,
        *(str(refusals.count(reason)) for reason in REASONS),
        f"{sum(each.error < RIGHT for each in results)} of {len(results)}",
        f"{np.median([len(_in_view(scan)) for scan in chain.scans]):.0f}",
        *(str(sum(each.fix.is_sure for each in located(chain, local_of, fewest=2))) for local_of in oracles),
    )


def _in_view(scan: Detection) -> NDArray[np.intp]:
    """Return the stems that a scan shows from edge to edge, and those that are detected."""
    stems: NDArray[np.intp] = np.union1d(scan.visible, scan.stems)
    return stems


def _of_rings(chain: Chain, scan: Detection, rows: NDArray[np.intp]) -> Landmarks:
    """Return detections of stems as they are on the map, around the scanner."""
    stems = chain.plot.full[rows]
    return as_landmarks(stems[:, :2] - scan.eye[:2], stems[:, 2], deviation=PRECISE, diameter=PRECISE)


def route(places: Array) -> list[int]:
    """Return the indices of places (n, 2) of a grid along a route: up the first column, down the second, and so on."""
    columns = np.unique(places[:, 0])
    turns = [1.0 if k % 2 == 0 else -1.0 for k in range(len(columns))]
    return [
        int(k)
        for x, turn in zip(columns, turns, strict=True)
        for column in [np.flatnonzero(places[:, 0] == x)]
        for k in column[(turn * places[column, 1]).argsort()]
    ]


def windows(order: Sequence[int], count: int) -> Iterator[list[int]]:
    """Yield for each place the route of ``count`` scans that ends there; the first places are reached from behind."""
    for k in range(len(order)):
        way = order[max(k - count + 1, 0) : k + 1] if k >= count - 1 else order[k : k + count][::-1]
        yield list(way)


def gathered(chain: Chain, way: Sequence[int], rng: np.random.Generator) -> Landmarks:
    """Return the landmarks that are gathered along a way of scans, in H of the last one."""
    drift, eyes = DriftModel(), np.array([chain.scans[k].eye[:2] for k in way])
    legs = np.diff(eyes, axis=0)
    headings = np.arctan2(legs[:, 1], legs[:, 0]) if len(legs) else np.zeros(0)
    headings = np.append(headings[:1], headings) if len(legs) else np.zeros(1)
    true = np.column_stack([eyes, headings])
    scale = 1.0 + WHEELS * rng.normal()
    pose, submap = np.zeros(3), Submap.empty()
    for k, index in enumerate(way):
        if k:
            motion = compose(inverse(true[k - 1]), true[k])
            C = drift.covariance(motion, float(np.hypot(*motion[:2])) / SPEED)
            measured = motion * [scale, scale, 1.0] + rng.multivariate_normal(np.zeros(3), C)
            pose = compose(pose, measured)
            submap = submap.moved(pose, drift.covariance(measured, float(np.hypot(*motion[:2])) / SPEED))
        # Detections are in the axes of the cloud.
        trunks = chain.trunks(chain.scans[index]).seen_from([0.0, 0.0, -true[k, 2]])
        submap = submap.with_scan(trunks, least_deviation=0.02)
    return submap.landmarks()


def way_row(chain: Chain) -> tuple[str, ...]:
    """Return the row of one cloud: how many poses are sure after some scans on the way."""
    order = route(np.array([scan.eye[:2] for scan in chain.scans]))
    constellation = ConstellationMap(chain.stems(), fewest=FEWEST)
    mirror = ConstellationMap(mirrored(chain.stems()), fewest=FEWEST)
    cells, results, claims = [], list[Located](), 0
    for count in SCANS:
        rng, results = np.random.default_rng([SEED, count]), []
        for way in windows(order, count):
            local = gathered(chain, way, rng)
            results.append(Located.of(constellation, local, chain.place(chain.scans[way[-1]])))
            claims += mirror.locate(local).is_sure
        cells.append(_sure(results))
    return chain.plot.name, *cells, *_errors(results), str(claims)


CHAIN_HEADER = (
    "cloud",
    "stems on the map",
    "trunks in a scan",
    "on the map",
    f"{FORMER} landmarks, no outline: sure, wrong",
    f"{FEWEST} landmarks: sure, wrong",
    "outline, m",
    "with it: sure, wrong",
    "error, m",
    "squared error",
    "sure on the mirror image",
)
REFUSAL_HEADER = (
    "cloud",
    *REASONS,
    "right pose is the best",
    "stems in view",
    "no false ones: sure",
    "and no errors: sure",
    "and none missed: sure",
)
WAY_HEADER = (
    "cloud",
    *(f"{count} scans: sure, wrong" for count in SCANS),
    "error, m",
    "squared error",
    "sure on the mirror image",
)


@click.command()
@click.argument("folder", type=click.Path(exists=True, file_okay=False, path_type=Path))
def main(folder: Path) -> None:
    """Locate scans out of the clouds of FOLDER on the stems of their plots."""
    every = chains(folder)
    print(table(CHAIN_HEADER, [chain_row(chain) for chain in every]), "\n")
    print(table(REFUSAL_HEADER, [refusal_row(chain) for chain in every]), "\n")
    print(table(WAY_HEADER, [way_row(chain) for chain in every]))


if __name__ == "__main__":
    main()
