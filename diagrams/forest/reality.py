"""Real forests: stems of real scans on real field maps, and the detector of trunks in real point clouds.

``python -m vtbdrake_diagrams.forest.reality FOLDER`` prints the tables of docs/reality_forest.md. FOLDER holds the
recordings that `vtbdrake_diagrams.forest.studies.recordings` describes, and point clouds of the R packages TreeLS and
spanner (GPL-3), which need ``laspy[lazrs]``.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, fields, replace
from itertools import pairwise
from math import inf
from pathlib import Path
from typing import Any

import click
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar
from scipy.spatial import cKDTree

from vtbdrake.cli.output import table
from vtbdrake.common.arrays import Array
from vtbdrake.components.estimation import chi_square_quantile, one_to_one, squared_distances
from vtbdrake.components.localization.constellation import ConstellationMap, Fix
from vtbdrake.components.localization.landmarks import Landmarks
from vtbdrake.components.localization.trunks import detect_trunks
from vtbdrake_diagrams.forest.studies.clouds import PARTIAL, STEM, Cloud, Scanner, rings, virtual_scan
from vtbdrake_diagrams.forest.studies.recordings import read_r, rioja, stems

# The displacement of neighbouring plots of La Rioja in their common frame: each plot's shift is a multiple of both.
_STEPS = np.array([[18.976, -6.318], [6.318, 18.976]])
_SAME = 0.02
"""Entries of overlapping inventories that are nearer than this (m) are one tree."""

CLOUDS = {"pine plantation": "treels/pine_plot.laz", "ponderosa, TLS": "spanner/TLS_Clip.laz"}
"""Clouds with the range noise of a terrestrial scanner."""
MOBILE = {"ponderosa, mobile": "spanner/MLS_Clip.laz"}
"""Clouds that were scanned while walking, whose points scatter more."""
NOISE = 0.02
"""Range noise of `CLOUDS`, in m."""
MOBILE_NOISE = 0.03
"""Range noise of `MOBILE`, in m."""
FROM_THE_AIR = {"ponderosa, from the air": ("spanner/UAS_Clip.laz", "ponderosa, mobile", (0.6, -0.01, 0.0))}
"""Clouds that had no part in the detector, the clouds of the same place whose rings are their reference, and by what in
m these are displaced, so that the rings of both coincide."""
ALONE = {"one pine": "treels/pine.laz"}
"""Clouds of single trees, which had no part in the choice of the detector's constants."""
SCANNER = Scanner(rows=32, columns=1800, elevation=np.radians(40.0))
EYE = 2.0
"""Height of the scanner over the ground, in m."""
_BINS = (0.0, 5.0, 10.0, 15.0, 25.0)
# A detection within this distance of a stem is right, in m.
_RIGHT = 0.25
# The `outline` (m) with which the detector runs a second time: covariances are linear in its square.
_OUTLINE = 0.05
# 95 % of the squared errors of positions lie below.
_POSITION_GATE = chi_square_quantile(0.95, 2)
# 95 % of the squared errors of diameters lie below.
_DIAMETER_GATE = chi_square_quantile(0.95, 1)


def rioja_map(inventories: dict[str, Any], *, deviation: float = 0.3, diameter: float = 0.03) -> Landmarks:
    """Return the trees of all plots of La Rioja once, in one frame: plot 1's.

    Overlapping plots repeat trees, to the millimetre: the shift of a plot is the multiple of the steps with which most
    of its trees coincide with those that are placed already.
    """
    plots = {plot: stems(inventories, plot, deviation=deviation, diameter=diameter) for plot in range(1, 17)}
    placed = plots.pop(1)
    shifts = np.array([a * _STEPS[0] + b * _STEPS[1] for a in range(-8, 9) for b in range(-8, 9)])
    while plots:
        tree = cKDTree(placed.positions)
        votes = {
            plot: [int((tree.query(part.positions + shift)[0] < _SAME).sum()) for shift in shifts]
            for plot, part in plots.items()
        }
        plot = max(votes, key=lambda each: max(votes[each]))
        if max(votes[plot]) < 3:
            raise ValueError(f"plots {sorted(plots)} of La Rioja share no three trees with the others")
        moved = plots.pop(plot).seen_from([*shifts[int(np.argmax(votes[plot]))], 0.0])
        placed = Landmarks.joined([placed, moved.select(tree.query(moved.positions)[0] >= _SAME)])
    return placed


def halves(landmarks: Landmarks) -> tuple[Landmarks, Landmarks]:
    """Return two maps with every other landmark each, in the order of x: what they say of a pose is independent."""
    order = landmarks.positions[:, 0].argsort()
    return landmarks.select(order[::2]), landmarks.select(order[1::2])


def petawawa(folder: Path) -> tuple[Landmarks, Landmarks]:
    """Return the stems of mobile scanning and the field inventory of the plot PRF025, both around its centre."""
    field = read_r(folder / "treematching_prf/PRF025_Field.rda")["PRF025_Field"]
    scanned = read_r(folder / "treematching_prf/PRF025_Lidar.rda")["PRF025_Lidar"]
    center = np.array([field["Easting"][0], field["Northing"][0]])
    return (
        as_landmarks(np.column_stack([scanned["X"], scanned["Y"]]) - center, scanned["DBH"], deviation=0.1),
        as_landmarks(np.column_stack([field["Field_X"], field["Field_Y"]]), field["DBH"] / 100.0, deviation=0.3),
    )


def airborne(folder: Path) -> tuple[Landmarks, Landmarks]:
    """Return 69 stems measured on the ground, and the map of treetops from the air, without diameters."""
    ground = np.genfromtxt(folder / "treematcher/Ground_Positions.txt", names=True)
    tops = np.genfromtxt(folder / "treematcher/Air_Positions.txt", names=True)
    mapped = as_landmarks(np.column_stack([tops["X"], tops["Y"]]), np.full(len(tops), 0.25), deviation=0.7)
    local = as_landmarks(np.column_stack([ground["X"], ground["Y"]]), ground["STEMDIAM"] / 100.0, deviation=0.2)
    unknown = np.full(len(mapped), 0.2)
    return local, Landmarks(mapped.positions, mapped.covariances, mapped.diameters, unknown)


def as_landmarks(places: Array, diameters: Array, *, deviation: float, diameter: float = 0.03) -> Landmarks:
    """Return stems at places (n, 2) as landmarks, with standard deviations of places, per axis, and diameters in m."""
    n = len(places)
    return Landmarks(places, np.tile(deviation**2 * np.eye(2), (n, 1, 1)), diameters, np.full(n, diameter))


def field_rows(folder: Path) -> Iterator[tuple[str, ...]]:
    """Yield a row for each scan on its field map: is it sure, and the difference between two halves of the map."""
    scans, inventories = rioja(folder)
    surveyed = rioja_map(inventories)
    whole, parts = ConstellationMap(surveyed), [ConstellationMap(half) for half in halves(surveyed)]
    for plot in range(1, 17):
        local = stems(scans, plot, deviation=0.1, diameter=0.03)
        yield _field_row(f"La Rioja {plot}", local, whole, parts)
    local, inventory = petawawa(folder)
    yield _field_row("Petawawa", local, ConstellationMap(inventory), [ConstellationMap(h) for h in halves(inventory)])
    local, tops = airborne(folder)
    yield _field_row("from the air", local, ConstellationMap(tops), [])


def _field_row(name: str, local: Landmarks, whole: ConstellationMap, parts: list[ConstellationMap]) -> tuple[str, ...]:
    fix = whole.locate(local)
    fixes = [part.locate(local) for part in parts]
    difference = ""
    if fix.is_sure and fixes and all(each.is_sure for each in fixes):
        distance, squared = disagreement(*fixes)
        difference = f"{distance:.3f} m, NEES {squared:.1f}"
    elif fixes:
        difference = f"{sum(each.is_sure for each in fixes)} of 2 sure"
    return (
        name,
        str(len(local)),
        "sure" if fix.is_sure else "not sure",
        str(len(fix.pairs)),
        f"{fix.log_likelihood:.0f}",
        f"{np.degrees(fix.pose[2]):.2f}" if fix.is_sure else "",
        difference,
    )


def disagreement(first: Fix, second: Fix) -> tuple[float, float]:
    """Return the distance (m) of two independent fixes, and their squared difference (x, y, heading) by covariance."""
    delta = first.pose - second.pose
    delta[2] = (delta[2] + np.pi) % (2.0 * np.pi) - np.pi
    nees = delta @ np.linalg.solve(first.covariance + second.covariance, delta)
    return float(np.hypot(*delta[:2])), float(nees)


@dataclass(frozen=True, eq=False)
class Detection:
    """The detector in one virtual scan, against the rings of the cloud.

    What is counted, all but the last six, is beyond the border of the half that the detector's weights are fitted to.

    Attributes:
        distances: Distances of the stems that the scan shows, (k,) in m.
        right: Which of them are detected, (k,).
        errors: Position error and error of the diameter of the detections that are right, (l, 2) in m.
        beside: Distances of detections of a stem that are off by more than `_RIGHT`.
        false: Distances of detections where the cloud shows no stem, not even one seen from one side.
        visible: Which stems the scan shows from edge to edge, (j,).
        stems: Which stems are detected, (m,).
        matched: Which of the trunks these detections are, (m,).
        trunks: The detections, in the frame of the cloud turned by nothing, around the scanner.
        outlined: The same with covariances for an outline of `_OUTLINE`.
        eye: The position of the scanner, (3,).
    """

    distances: Array
    right: Array
    errors: Array
    beside: Array
    false: Array
    visible: NDArray[np.intp]
    stems: NDArray[np.intp]
    matched: NDArray[np.intp]
    trunks: Landmarks
    outlined: Landmarks
    eye: Array

    def with_outline(self, outline: float) -> Landmarks:
        """Return the detections with the covariances of a detector with this outline (m)."""
        share, trunks, more = (outline / _OUTLINE) ** 2, self.trunks, self.outlined
        variances = trunks.diameter_deviations**2
        return replace(
            trunks,
            covariances=trunks.covariances + share * (more.covariances - trunks.covariances),
            diameter_deviations=np.sqrt(variances + share * (more.diameter_deviations**2 - variances)),
        )


def grid(cloud: Cloud, step: float) -> Iterator[Array]:
    """Yield the places (2,) of a grid in a cloud where there is room for a scanner."""
    low, high = cloud.points[:, :2].min(axis=0), cloud.points[:, :2].max(axis=0)
    obstacles = cKDTree(cloud.points[(cloud.heights > 0.3) & (cloud.heights < 2.5), :2])
    for x in np.arange(low[0] + 1.0, high[0] - 0.5, step):
        for y in np.arange(low[1] + 1.0, high[1] - 0.5, step):
            if obstacles.query([x, y])[0] >= 0.6:
                yield np.array([x, y])


def grid_step(cloud: Cloud) -> float:
    """Return the step of the `grid` of scanners in a cloud, in m."""
    return 2.0 if np.ptp(cloud.points[:, 0]) < 15.0 else 4.0


def around(stem: Array) -> Iterator[Array]:
    """Yield places (2,) around a stem: twelve of them in each bin of distances."""
    for low, high in pairwise(_BINS):
        for azimuth in 2.0 * np.pi * np.arange(12) / 12.0:
            yield stem[:2] + 0.5 * (max(low, 2.0) + high) * np.array([np.cos(azimuth), np.sin(azimuth)])


def detections(
    cloud: Cloud, full: Array, partial: Array, *, noise: float, places: Iterable[Array], border: float = -inf
) -> Iterator[Detection]:
    """Yield the detector's results for scanners at these places (2,), counted at x > ``border``."""
    detector = SCANNER.detector(noise)
    for place in places:
        eye = np.array([*place, cloud.ground(place) + EYE])
        points = virtual_scan(cloud, eye, SCANNER)
        trunks, outlined = (
            detect_trunks(points - eye + [0.0, 0.0, EYE], each, p_HoLo_H=np.array([0.0, 0.0, EYE]))
            for each in (detector, replace(detector, outline=_OUTLINE))
        )
        yield _judged(points, eye, trunks, outlined, full, partial, border)


def _judged(
    points: Array, eye: Array, trunks: Landmarks, outlined: Landmarks, full: Array, partial: Array, border: float
) -> Detection:
    beyond = full[:, 0] > border
    visible = np.array([_is_shown(points, eye, stem) for stem in full], dtype=bool)
    shown = beyond & visible
    places = trunks.positions + eye[:2]
    apart = np.linalg.norm(full[:, None, :2] - places[None], axis=2)
    stem, detection = one_to_one(1.0 - apart)
    near = apart[stem, detection] < _RIGHT
    stem, detection = stem[near], detection[near]
    right = np.zeros(len(full), dtype=bool)
    right[stem] = True
    rest = np.setdiff1d(np.flatnonzero(places[:, 0] > border), detection)
    nearest = cKDTree(np.vstack([full, partial])[:, :2]).query(places[rest])[0] if len(rest) else np.zeros(0)
    away = np.linalg.norm(places[rest] - eye[:2], axis=1)
    errors = np.column_stack([apart[stem, detection], trunks.diameters[detection] - full[stem, 2]])
    distances = np.linalg.norm(full[:, :2] - eye[:2], axis=1)
    return Detection(
        distances=distances[shown],
        right=right[shown],
        errors=errors[beyond[stem]],
        beside=away[nearest < STEM],
        false=away[nearest >= STEM],
        visible=np.flatnonzero(visible),
        stems=stem,
        matched=detection,
        trunks=trunks,
        outlined=outlined,
        eye=eye,
    )


def _is_shown(points: Array, eye: Array, stem: Array) -> bool:
    """Return whether a scan shows a stem from edge to edge, by at least ten points."""
    arm = stem[:2] - eye[:2]
    forward = arm / np.linalg.norm(arm)
    delta, radius = points[:, :2] - stem[:2], 0.5 * stem[2]
    heights = points[:, 2] - eye[2] + EYE
    on = (np.abs(np.linalg.norm(delta, axis=1) - radius) < 0.06) & (heights > 0.4) & (heights < 3.2)
    on &= delta @ forward < 0.6 * radius
    across = delta[on] @ np.array([-forward[1], forward[0]]) / radius
    return bool(on.sum() >= 10 and (np.histogram(across, [-1.3, -0.6, -0.2, 0.2, 0.6, 1.3])[0] > 0).all())


def cloud_row(name: str, results: list[Detection]) -> tuple[str, ...]:
    """Return the row of the table of one cloud."""
    distances, right = (np.concatenate([getattr(each, part) for each in results]) for part in ("distances", "right"))
    errors = np.vstack([each.errors for each in results])
    beside, false = (np.concatenate([getattr(each, part) for each in results]) for part in ("beside", "false"))
    parts = [
        f"{right[inside].sum()} of {inside.sum()}, {(false[(false >= low) & (false < high)]).size}"
        for low, high in pairwise(_BINS)
        for inside in [(distances >= low) & (distances < high)]
    ]
    return (
        name,
        str(len(results)),
        *parts,
        str(len(beside)),
        f"{np.median(errors[:, 0]):.3f}",
        f"{np.median(errors[:, 1]):+.3f}, {np.sqrt(np.mean(errors[:, 1] ** 2)):.3f}",
    )


@dataclass(frozen=True, eq=False)
class Errors:
    """Errors of positions (n, 2) and diameters (n,), and covariances as a function of the outline: P + (s / S)^2 dP."""

    positions: Array
    diameters: Array
    P: Array
    dP: Array
    variances: Array
    dvariances: Array

    @classmethod
    def of(cls, full: Array, results: list[Detection], *, half: int | None = None) -> Errors:
        """Return the values of every other stem, in the order of x, from the one with the index ``half``; None: all."""
        order = full[:, 0].argsort()
        order = order if half is None else order[half::2]
        parts: list[tuple[Array, ...]] = []
        for each in results:
            rows = np.isin(each.stems, order)
            stem, k = full[each.stems[rows]], each.matched[rows]
            trunks, outlined = each.trunks.select(k), each.outlined.select(k)
            P, variances = trunks.covariances, trunks.diameter_deviations**2
            places, diameters = trunks.positions + each.eye[:2] - stem[:, :2], trunks.diameters - stem[:, 2]
            more = outlined.covariances - P, outlined.diameter_deviations**2 - variances
            parts.append((places, diameters, P, more[0], variances, more[1]))
        return cls(*(np.concatenate(column) for column in zip(*parts, strict=True)))

    @classmethod
    def joined(cls, parts: list[Errors]) -> Errors:
        """Return the values of all parts, one after the other."""
        return cls(*(np.concatenate([getattr(part, each.name) for part in parts]) for each in fields(cls)))

    def squares(self, outline: float) -> tuple[Array, Array, float]:
        """Return the squared errors by their covariances, of positions and diameters, and -2 ln of the likelihood."""
        share = (outline / _OUTLINE) ** 2
        P, variances = self.P + share * self.dP, self.variances + share * self.dvariances
        places = squared_distances(self.positions, P)
        thick = self.diameters**2 / variances
        unlikelihood = places.sum() + thick.sum() + np.log(np.linalg.det(P)).sum() + np.log(variances).sum()
        return places, thick, float(unlikelihood)

    def likeliest(self) -> float:
        """Return the outline of the largest likelihood."""
        return float(minimize_scalar(lambda s: self.squares(s)[2], bounds=(1e-3, 0.5), method="bounded").x)


def outline_rows(name: str, full: Array, results: list[Detection]) -> Iterator[tuple[str, ...]]:
    """Yield two rows: the outline by one half of the stems, and how often the errors of the other one are covered."""
    halves_of = [Errors.of(full, results, half=half) for half in (0, 1)]
    for fitted, judge in (halves_of, halves_of[::-1]):
        outline = fitted.likeliest()
        cells = []
        for places, thick, _ in (judge.squares(0.0), judge.squares(outline)):
            within = np.mean(places < _POSITION_GATE), np.mean(thick < _DIAMETER_GATE)
            cells += [f"{places.mean() / 2.0:.1f}, {within[0]:.0%}", f"{thick.mean():.1f}, {within[1]:.0%}"]
        yield name, f"{outline:.2f}", str(len(judge.diameters)), *cells


FIELD_HEADER = ("scan", "stems", "pose", "matched", "ln L", "heading, deg", "halves of the map differ by")
CLOUD_HEADER = (
    "cloud",
    "scans",
    *(f"{low:g} to {high:g} m: found, false" for low, high in pairwise(_BINS)),
    "beside a stem",
    "position, m",
    "diameter, m: bias, RMS",
)
OUTLINE_HEADER = (
    "cloud",
    "outline, m",
    "trunks",
    "without: position",
    "diameter",
    "with it: position",
    "diameter",
)


@dataclass(frozen=True, eq=False)
class Plot:
    """A cloud of a plot of forest.

    Attributes:
        name: The name of the cloud.
        cloud: The cloud.
        full: The stems whose full rings are seen, (k, 3), see `rings`.
        partial: The stems whose rings are seen from one side at least, (l, 3).
        noise: The range noise in m.
        is_fitted: Whether the detector's weights are fitted to the half at x below `border`.
    """

    name: str
    cloud: Cloud
    full: Array
    partial: Array
    noise: float
    is_fitted: bool = True

    @property
    def border(self) -> float:
        """The x beyond which the plot judges the detector."""
        return float(np.median(self.full[:, 0]))


def plots(folder: Path) -> Iterator[Plot]:
    """Yield the clouds of plots of forest."""
    by_name: dict[str, Plot] = {}
    for clouds, noise in ((CLOUDS, NOISE), (MOBILE, MOBILE_NOISE)):
        for name, path in clouds.items():
            cloud = Cloud.read(folder / path)
            by_name[name] = Plot(name, cloud, rings(cloud), rings(cloud, arc=PARTIAL, fewest=8), noise)
    yield from by_name.values()
    for name, (path, reference, shift) in FROM_THE_AIR.items():
        full, partial = (stems + np.array(shift) for stems in (by_name[reference].full, by_name[reference].partial))
        yield Plot(name, Cloud.read(folder / path), full, partial, MOBILE_NOISE, is_fitted=False)


def cloud_results(folder: Path) -> Iterator[tuple[str, Array, list[Detection]]]:
    """Yield the name, the stems and the results of each plot."""
    for plot in plots(folder):
        places = grid(plot.cloud, grid_step(plot.cloud))
        results = detections(plot.cloud, plot.full, plot.partial, noise=plot.noise, places=places, border=plot.border)
        yield plot.name, plot.full, list(results)


def alone_results(folder: Path) -> Iterator[tuple[str, Array, list[Detection]]]:
    """Yield the name, the stem and the results of each cloud of a single tree."""
    for name, path in ALONE.items():
        cloud = Cloud.read(folder / path)
        full, partial = rings(cloud), rings(cloud, arc=PARTIAL, fewest=8)
        yield name, full, list(detections(cloud, full, partial, noise=NOISE, places=around(full[0])))


@click.command()
@click.argument("folder", type=click.Path(exists=True, file_okay=False, path_type=Path))
def main(folder: Path) -> None:
    """Locate real scans on real maps, and detect trunks in real clouds, of FOLDER."""
    print(table(FIELD_HEADER, list(field_rows(folder))), "\n")
    results = list(cloud_results(folder))
    alone = list(alone_results(folder))
    print(table(CLOUD_HEADER, [cloud_row(name, scans) for name, _, scans in [*results, *alone]]), "\n")
    rows = [row for name, full, scans in results for row in outline_rows(name, full, scans)]
    print(table(OUTLINE_HEADER, rows))


if __name__ == "__main__":
    main()
