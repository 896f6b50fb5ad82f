"""The real drive in Victoria Park with most of its trees taken away: localization where a scan shows two landmarks.

``python -m vtbdrake_diagrams.park.few_landmarks FOLDER`` prints it, for the FOLDER of `vtbdrake_diagrams.park.reality`.

The survey of the whole drive has all trees. Some of them are drawn and are the map, each with an error of 0.1 m; only
their detections are left, and a tenth of all others, which show nothing on the map. The unit goes along the whole drive
without a guess. The survey, which uses all detections together, also later ones, judges each claim, but for ten seconds
after it jumps against the wheels: there it contradicts itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import click
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from threadpoolctl import threadpool_limits

from vtbdrake.cli.output import table
from vtbdrake.common.arrays import Array, Indices
from vtbdrake.components.localization.landmarks import Landmarks
from vtbdrake.components.localization.planar import compose, inverse, transform
from vtbdrake.components.localization.range_bearing import range_bearing_landmarks
from vtbdrake.components.localization.unit import TRACKING
from vtbdrake_diagrams.park.reality import Drive, prepared, reckoned, surveyed, victoria_park
from vtbdrake_diagrams.park.scenario import ParkScenario, car
from vtbdrake_diagrams.park.survey import Survey
from vtbdrake_diagrams.park.world import tree_model

# The number of trees on the map; with 90, a scan shows two in the median.
_TREES = 90
# Standard deviation of the errors of the map, per axis, in m.
_DEVIATION = 0.1
# The share of the detections of other trees that is left.
_OTHERS = 0.1
# A detection shows a tree within this distance, in m.
_MATCHES = 1.0
# The survey jumps if its motion from scan to scan differs from dead reckoning's by more than this distance, in m.
_JUMP = 0.5
# For this time after a jump the survey does not judge, in s.
_AFTER_JUMP = 10.0
# A claim is wrong if it is off by more than this distance in m, and by more than three of its deviations.
_WRONG = 0.5


@dataclass(frozen=True)
class Case:
    """The errors that the unit is told of its map, and the steering.

    Attributes:
        deviation: Standard deviation of the map's errors, per axis, in m; the true one is 0.1.
        is_calibrated: Whether the steering is calibrated by the first half of the drive, or as published.
        is_mirrored: Whether the map is mirrored, and shows no place of the drive.
    """

    deviation: float = _DEVIATION
    is_calibrated: bool = True
    is_mirrored: bool = False


CASES = (
    Case(0.03),
    Case(0.1),
    Case(0.3),
    Case(0.03, is_calibrated=False),
    Case(0.1, is_calibrated=False),
    Case(is_mirrored=True),
)
"""The maps of the table."""


@dataclass(frozen=True, eq=False)
class Claims:
    """The errors and deviations of what the unit claims, scan by scan.

    Attributes:
        errors: Distances of the claimed positions from the survey's in m, (n,); NaN without a pose.
        deviations: The claimed standard deviations of these distances in m, (n,); infinite without a pose.
        is_judged: Whether the survey judges, (n,).
    """

    errors: Array
    deviations: Array
    is_judged: NDArray[np.bool_]

    @property
    def available(self) -> float:
        """Return the share of scans with a pose."""
        return float(np.isfinite(self.errors).mean())

    @property
    def wrong(self) -> int:
        """Return the number of claims that are off by more than 0.5 m and three deviations."""
        return int((self.is_judged & (self.errors > _WRONG) & (self.errors > 3.0 * self.deviations)).sum())

    def within(self, share: float) -> float:
        """Return the error in m that a share of the claims does not exceed; NaN without claims."""
        claimed = self.errors[np.isfinite(self.errors) & self.is_judged]
        return float(np.quantile(claimed, share)) if len(claimed) else float("nan")


def thinned(
    drive: Drive, whole: Survey, scenario: ParkScenario, *, seed: int, trees: int = _TREES
) -> tuple[Indices, list[Landmarks]]:
    """Return the trees that are left, as indices of the survey's, and what each scan then shows.

    Args:
        drive: The drive.
        whole: The survey of it.
        scenario: The scenario, which knows the detector.
        seed: Determines trees and detections.
        trees: The number of trees that are left.
    """
    random = np.random.default_rng(seed)
    left = random.permutation(len(whole.trees))[:trees]
    is_left = np.isin(np.arange(len(whole.trees)), left)
    tree, scans = cKDTree(whole.trees.positions), []
    detected = drive.log.sense["trees"]
    for pose, row in zip(_poses_at(whole, detected.times), detected.values, strict=True):
        scan = range_bearing_landmarks(row, scenario.detector)
        distances, nearest = tree.query(transform(pose, scan.positions)) if len(scan) else (np.zeros(0), left[:0])
        is_other = random.random(len(scan)) < _OTHERS
        scans.append(scan.select(np.flatnonzero(np.where(distances < _MATCHES, is_left[nearest], is_other))))
    return left, scans


def claims(
    drive: Drive, whole: Survey, scenario: ParkScenario, case: Case, *, seed: int, trees: int = _TREES
) -> Claims:
    """Return what the unit claims along a drive with few trees.

    Args:
        drive: The drive.
        whole: The survey of it.
        scenario: The scenario, with the calibrated car.
        case: What the unit is told.
        seed: Determines trees, detections and errors of the map.
        trees: The number of trees that are left.
    """
    left, scans = thinned(drive, whole, scenario, seed=seed, trees=trees)
    true = whole.trees.select(left)
    errors = np.random.default_rng([seed, 1]).normal(size=true.positions.shape) * _DEVIATION
    mapped = replace(
        true,
        positions=(true.positions + errors) * [1.0, -1.0 if case.is_mirrored else 1.0],
        covariances=np.tile(case.deviation**2 * np.eye(2), (len(true), 1, 1)),
    )
    unit = scenario.unit(tree_model(mapped, source="survey"))
    steered = scenario.car if case.is_calibrated else car()
    times = drive.log.sense["trees"].times
    poses, state, answers = reckoned(drive.log.sense["odometry"], steered, times), unit.start(), []
    with threadpool_limits(1):
        for time, X_OH, scan in zip(times, poses, scans, strict=True):
            answer, state = unit.step(state, scan, X_OH=X_OH, time=time)
            answers.append(answer)
    is_claimed = np.array([answer.status == TRACKING for answer in answers])
    claimed = np.array([answer.pose[:2] for answer in answers])
    off = np.hypot(*(claimed - _poses_at(whole, times)[:, :2]).T)
    deviations = np.sqrt([np.trace(answer.covariance[:2, :2]) for answer in answers])
    return Claims(np.where(is_claimed, off, np.nan), deviations, _judges(whole, drive, scenario, times))


def _judges(whole: Survey, drive: Drive, scenario: ParkScenario, times: Array) -> NDArray[np.bool_]:
    """Return whether the survey has not jumped within the last seconds before each scan, (n,)."""
    truth, wheels = _poses_at(whole, times), reckoned(drive.log.sense["odometry"], scenario.car, times)
    ways = [
        np.array([compose(inverse(before), after)[:2] for before, after in pairwise(poses)])
        for poses in (truth, wheels)
    ]
    jumps = times[1:][np.hypot(*(ways[0] - ways[1]).T) > _JUMP]
    after = times[:, None] - jumps
    return ~((after >= 0.0) & (after < _AFTER_JUMP)).any(axis=1)


def _poses_at(whole: Survey, times: Array) -> Array:
    """Return the poses of the survey at the times of scans, (n, 3)."""
    return whole.poses[np.clip(np.searchsorted(whole.times, times), 0, len(whole.times) - 1)]


def report(drive: Drive, seeds: Sequence[int]) -> str:
    """Return the table for some draws of the trees."""
    start, end = drive.log.start, drive.log.end
    half = prepared(drive.between(start, 0.5 * (start + end)))
    whole = surveyed(drive, half.scenario, half.config)
    rows = []
    for case in CASES:
        draws = [claims(drive, whole, half.scenario, case, seed=seed) for seed in seeds]
        rows.append(
            [
                f"{case.deviation:g} m" + ", mirrored" * case.is_mirrored,
                "calibrated" if case.is_calibrated else "published",
                ", ".join(f"{100.0 * draw.available:.0f} %" for draw in draws),
                ", ".join(str(draw.wrong) for draw in draws),
                ", ".join(str(int(np.isfinite(draw.errors[draw.is_judged]).sum())) for draw in draws),
                ", ".join(f"{draw.within(0.5):.2f}" for draw in draws),
                ", ".join(f"{draw.within(0.99):.2f}" for draw in draws),
            ]
        )
    header = ["deviation told", "steering", "scans with a pose", "wrong", "judged", "median, m", "99 %, m"]
    return table(header, rows)


@click.command()
@click.argument("folder", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.option("--seeds", type=click.IntRange(min=1), default=3, show_default=True, help="Draws of the trees.")
def main(folder: Path, seeds: int) -> None:
    """Localize along the drive in FOLDER where a scan shows two trees of the map."""
    click.echo(report(victoria_park(folder), range(seeds)))


if __name__ == "__main__":
    main()
