"""The weights of `TrunkEvidence`: fitted to one half of what was recorded, and judged by the other.

``python -m vtbdrake_diagrams.forest.studies.trunk_probabilities FOLDER`` prints the weights, how often detections of a
probability are trunks, and what is found in streets. FOLDER holds the recordings that
`vtbdrake_diagrams.forest.reality` and `vtbdrake_diagrams.forest.studies.streets` describe; streets that are missing
there are left out.

Scans that are cut out of the clouds of forests have their detections below the border of a cloud fitted, and those
beyond it judged; of simulated forests, some seeds are fitted and others judged. Each recording counts equally in the
fit. A detection is a trunk if its axis is within 0.25 m of the axis of a full ring, or within the ring. Other
detections less than 0.6 m from a ring are unclear, mostly parts of stems that the cloud shows from one side: they are
counted, but take no part.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import click
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.spatial import cKDTree

from vtbdrake.campaigns.results import interval
from vtbdrake.cli.output import table
from vtbdrake.common.arrays import Array
from vtbdrake.components.localization.dead_reckoning import body_rotation, carrier_pose_at, deskewed
from vtbdrake.components.localization.landmarks import Landmarks
from vtbdrake.components.localization.planar import inverse, transform
from vtbdrake.components.localization.trunks import TrunkDetectorConfig, trunk_candidates
from vtbdrake_diagrams.forest.reality import CLOUDS, EYE, MOBILE, SCANNER, Plot, grid, grid_step, plots
from vtbdrake_diagrams.forest.scenario import ForestScenario
from vtbdrake_diagrams.forest.studies.clouds import STEM, Scanner, virtual_scan
from vtbdrake_diagrams.forest.studies.streets import FILES, FITTED, JUDGES, POLE, TRUNK, StreetScan

SCANNERS = (SCANNER, Scanner(rows=16, columns=1250, elevation=np.pi / 6.0))
"""The scanners whose scans are cut out of clouds."""
FITTED_SEEDS = range(200, 215)
"""Simulated forests that the weights are fitted to."""
JUDGING_SEEDS = range(300, 330)
"""Simulated forests that judge."""
# The distance within which trees of simulated forests are counted, in m.
_REACH = 22.0
# A detection within this distance of a stem's axis is right, in m.
_RIGHT = 0.25
# The sum of the weights of the detections of a recording in the fit.
_WEIGHT = 300.0
# Penalty of the squares of the weights, for terms of unit variance.
_PENALTY = 1.0
# Detections within this distance show one object, in m.
_OBJECT = 1.0
# The recordings that are reported together.
_GROUP = dict.fromkeys((*CLOUDS, *MOBILE), "plots, other halves")
BINS = (0.0, 0.1, 0.3, 0.5, 0.7, 0.9, 1.0)
"""The limits of the bins of probabilities."""


@dataclass(frozen=True, eq=False)
class Sample:
    """The detections of any probability in one scan.

    Attributes:
        recording: The recording.
        terms: The terms of their evidence, (n, 8).
        probabilities: The probabilities with the detector's present weights, (n,).
        is_trunk: Whether they are trunks, (n,).
        is_unclear: Whether that is unclear, (n,).
        judges: Whether they judge the weights, rather than being fitted, (n,).
        places: Their places in the frame of the recording in m, (n, 2).
    """

    recording: str
    terms: Array
    probabilities: Array
    is_trunk: NDArray[np.bool_]
    is_unclear: NDArray[np.bool_]
    judges: NDArray[np.bool_]
    places: Array


def candidates(points_H: Array, detector: TrunkDetectorConfig, eye_H: Array) -> tuple[Landmarks, Array]:
    """Return the detections of any probability, and the terms of their evidence."""
    landmarks, evidence = trunk_candidates(points_H, replace(detector, least_probability=0.0), p_HoLo_H=eye_H)
    return landmarks, evidence.terms()


def plot_samples(plot: Plot) -> Iterator[Sample]:
    """Yield the samples of all scanners in a plot."""
    level = np.array([0.0, 0.0, EYE])
    axes, near = (cKDTree(stems[:, :2]) for stems in (plot.full, np.vstack([plot.full, plot.partial])))
    for scanner in SCANNERS:
        for place in grid(plot.cloud, 0.75 * grid_step(plot.cloud)):
            eye = np.array([*place, plot.cloud.ground(place) + EYE])
            points = virtual_scan(plot.cloud, eye, scanner)
            landmarks, terms = candidates(points - eye + level, scanner.detector(plot.noise), level)
            places = landmarks.positions + eye[:2]
            apart, stem = axes.query(places)
            is_trunk = apart < np.maximum(_RIGHT, 0.5 * plot.full[stem, 2])
            is_unclear = ~is_trunk & (near.query(places)[0] < STEM)
            judges = places[:, 0] > plot.border
            rows = judges | plot.is_fitted
            values = (terms, landmarks.probabilities, is_trunk, is_unclear, judges, places)
            yield Sample(plot.name, *(value[rows] for value in values))


@dataclass(frozen=True, eq=False)
class SimulatedScan:
    """A scan of a simulated forest.

    Attributes:
        seed: The seed of the forest.
        points: The points in the level frame H of the carrier, (n, 3) in m.
        eye: The place of the scanner, (3,) in m.
        trees: The places of the trees, (k, 2) in m.
        detector: The settings of the detector for this scanner.
    """

    seed: int
    points: Array
    eye: Array
    trees: Array
    detector: TrunkDetectorConfig

    @classmethod
    def of(cls, seed: int) -> SimulatedScan:
        """Return the first scan of a carrier in a forest."""
        scenario = ForestScenario(seed=seed, length=60.0, width=60.0, start=12.0)
        testbed = scenario.build()
        context = testbed.default_context()
        testbed.simulator(context).AdvanceTo(0.5)
        names = ("scan_arrival.sample", "scan_arrival.time", "dead_reckoning.history")
        scan, time, history = (testbed.read(context, f"dps.env.{name}") for name in names)
        pose = carrier_pose_at(history, float(time))
        x, y, *_, yaw = testbed.read(context, "sim.sys.carrier.base.pose")
        return cls(
            seed,
            deskewed(scan, history, scenario.X_BL, time=float(time)),
            body_rotation(pose.roll, pose.pitch) @ scenario.X_BL.translation(),
            transform(inverse([x, y, yaw]), scenario.truth().positions()[:, :2]),
            scenario.detector().settings,
        )

    def sample(self) -> Sample:
        """Return the detections of any probability."""
        landmarks, terms = candidates(self.points, self.detector, self.eye)
        is_trunk = cKDTree(self.trees).query(landmarks.positions)[0] < _RIGHT
        judges, unclear = np.full(len(is_trunk), self.seed in JUDGING_SEEDS), np.zeros_like(is_trunk)
        # In a frame of its own for each forest.
        places = landmarks.positions + np.array([1000.0 * self.seed, 0.0])
        return Sample("simulated forest", terms, landmarks.probabilities, is_trunk, unclear, judges, places)

    def counts(self) -> tuple[int, int, int]:
        """Return how many trees are within reach, how many of these are detected, and how many detections are false."""
        places = trunk_candidates(self.points, self.detector, p_HoLo_H=self.eye)[0].positions
        near = self.trees[np.linalg.norm(self.trees - self.eye[:2], axis=1) < _REACH]
        is_detected = cKDTree(places).query(near)[0] < _RIGHT
        return len(near), int(is_detected.sum()), int((cKDTree(self.trees).query(places)[0] >= _RIGHT).sum())


def street_sample(folder: Path, name: str) -> Sample:
    """Return the sample of a scan of a street."""
    scan = StreetScan.read(folder, name)
    landmarks, terms = candidates(scan.points, scan.DETECTOR, scan.EYE)
    is_trunk = np.array(scan.kinds_of(landmarks.positions, landmarks.diameters)) == TRUNK
    judging, unclear = np.full(len(is_trunk), name in JUDGES), np.zeros_like(is_trunk)
    return Sample("streets", terms, landmarks.probabilities, is_trunk, unclear, judging, landmarks.positions)


def fitted(samples: list[Sample]) -> Array:
    """Return the weights that are fitted to the detections that do not judge, (8,)."""
    rows = [~sample.judges & ~sample.is_unclear for sample in samples]
    names = np.array(
        [name for sample, row in zip(samples, rows, strict=True) for name in [sample.recording] * row.sum()]
    )
    X = np.vstack([sample.terms[row] for sample, row in zip(samples, rows, strict=True)])
    y = np.concatenate([sample.is_trunk[row] for sample, row in zip(samples, rows, strict=True)]).astype(float)
    _, which, counts = np.unique(names, return_inverse=True, return_counts=True)
    w = _WEIGHT / counts[which]
    mean, scale = X[:, 1:].mean(axis=0), X[:, 1:].std(axis=0)
    Z = np.column_stack([np.ones(len(X)), (X[:, 1:] - mean) / scale])

    def unlikelihood(b: Array) -> tuple[float, Array]:
        odds, penalty = Z @ b, _PENALTY * np.concatenate([[0.0], b[1:]])
        value = w @ (np.logaddexp(0.0, odds) - y * odds) + 0.5 * penalty @ b
        return float(value), Z.T @ (w * (1.0 / (1.0 + np.exp(-odds)) - y)) + penalty

    b = minimize(unlikelihood, np.zeros(Z.shape[1]), jac=True, method="BFGS").x
    return np.concatenate([[b[0] - (b[1:] * mean / scale).sum()], b[1:] / scale])


RELIABILITY_HEADER = (
    "recordings",
    "probability",
    "mean",
    "clear",
    "places",
    "trunks",
    "95 %",
    "unclear",
    "trunks of all",
)


def reliability_rows(samples: list[Sample]) -> Iterator[tuple[str, ...]]:
    """Yield a row for each group of recordings and bin of probabilities: how many detections that judge are trunks.

    The share is given of what is clear, and of all, as if nothing that is unclear were a trunk. Detections of one
    object are repetitions: the interval is the one of as many trials as there are places.
    """
    groups: dict[str, list[Sample]] = {}
    for sample in samples:
        if sample.judges.any():
            groups.setdefault(_GROUP.get(sample.recording, sample.recording), []).append(sample)
    for name, several in groups.items():
        p, trunk, unclear = (
            np.concatenate([getattr(sample, part)[sample.judges] for sample in several])
            for part in ("probabilities", "is_trunk", "is_unclear")
        )
        places = [
            (sample.recording, *(place // _OBJECT).astype(int))
            for sample in several
            for place in sample.places[sample.judges]
        ]
        for low, high in pairwise(BINS):
            inside = (p >= low) & ((p < high) | (high == 1.0))
            clear = inside & ~unclear
            n, trunks = int(clear.sum()), int(trunk[clear].sum())
            if not n:
                continue
            distinct = len({places[row] for row in np.flatnonzero(clear)})
            limits = interval(round(trunks / n * distinct), distinct, 0.95)
            yield (
                name,
                f"{low:g} to {high:g}",
                f"{p[clear].mean():.2f}",
                str(n),
                str(distinct),
                f"{trunks / n:.0%}",
                f"{limits[0]:.0%} to {limits[1]:.0%}",
                str(int(inside.sum()) - n),
                f"{trunks / inside.sum():.0%}",
            )


STREET_HEADER = ("scan", "part", "stems", "found", "detections", "trunks", "poles", "others")


def street_rows(folder: Path) -> Iterator[tuple[str, ...]]:
    """Yield a row for each scan of a street: what is found by default."""
    for name in _streets(folder):
        scan = StreetScan.read(folder, name)
        landmarks, _ = trunk_candidates(scan.points, scan.DETECTOR, p_HoLo_H=scan.EYE)
        kinds = np.array(scan.kinds_of(landmarks.positions, landmarks.diameters))
        trunks, stems = landmarks.positions[kinds == TRUNK], scan.stems()
        count = sum(bool(len(trunks)) and cKDTree(stem).query(trunks)[0].min() < 2.0 * _RIGHT for stem in stems)
        counts = [str(np.sum(kinds == kind)) for kind in (TRUNK, POLE, "")]
        yield name, "fitted" if name in FITTED else "judges", str(len(stems)), str(count), str(len(kinds)), *counts


def _streets(folder: Path) -> list[str]:
    return [name for name, files in FILES.items() if all((folder / file).exists() for file in files)]


@click.command()
@click.argument("folder", type=click.Path(exists=True, file_okay=False, path_type=Path))
def main(folder: Path) -> None:
    """Fit the weights of the evidence of trunks to recordings in FOLDER, and judge them by others there."""
    simulated = [SimulatedScan.of(seed) for seed in (*FITTED_SEEDS, *JUDGING_SEEDS)]
    streets = [street_sample(folder, name) for name in _streets(folder)]
    samples = [
        *(sample for plot in plots(folder) for sample in plot_samples(plot)),
        *(scan.sample() for scan in simulated),
        *streets,
    ]
    print("weights:", ", ".join(f"{weight:.2f}" for weight in fitted(samples)), "\n")
    print(table(RELIABILITY_HEADER, list(reliability_rows(samples))), "\n")
    print(table(STREET_HEADER, list(street_rows(folder))), "\n")
    trees, detected, false = np.sum([scan.counts() for scan in simulated if scan.seed in JUDGING_SEEDS], axis=0)
    print(f"simulated forests: {detected} of {trees} trees within {_REACH:g} m, {false} false")


if __name__ == "__main__":
    main()
