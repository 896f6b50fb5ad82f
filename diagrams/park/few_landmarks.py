"""The real drive in Victoria Park with most of its trees taken away: localization where a scan shows two landmarks.

``python -m vtbdrake_diagrams.park.few_landmarks FOLDER`` prints it, for the FOLDER of `vtbdrake_diagrams.park.reality`.

The survey of the whole drive has all trees. Some of them are drawn and are the map, each with an error of 0.1 m; only
their detections are left, and a tenth of all others, which show nothing on the map. The unit goes along the whole drive
without a guess. The survey, which uses all detections together, also later ones, judges each claim, but for the places
where it contradicts the wheels (`judging`).

The unit was developed with the draws 0 to 2, and with what the draws 3, 17, 20 and 31 showed; the others judge.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import inf
from pathlib import Path

import click
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from threadpoolctl import threadpool_limits

from vtbdrake.cli.output import table
from vtbdrake.common.arrays import Array, Indices
from vtbdrake.components.estimation import squared_distances
from vtbdrake.components.localization.dead_reckoning import SteeringDriftModel
from vtbdrake.components.localization.landmarks import Landmarks
from vtbdrake.components.localization.planar import compose, inverse, transform
from vtbdrake.components.localization.range_bearing import RangeBearingConfig, range_bearing_landmarks
from vtbdrake.components.localization.unit import TRACKING
from vtbdrake_diagrams.park.reality import Drive, Prepared, prepared, reckoned, surveyed, victoria_park
from vtbdrake_diagrams.park.scenario import ParkScenario
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
# What is detected between these distances of a tree, in m, is something else.
_STRAYS = (0.4, 1.0)
# The survey and the wheels are compared over this number of scans, about a second.
_SCANS_AHEAD = 5
# The survey jumps where they differ by more than this number of standard deviations.
_JUMP = 3.0
# Standard deviation of a motion by the survey, per axis, in m: as of trees that are seen from both ends.
_SURVEYED = 0.05
# Standard deviation of a motion by the wheels for lasting errors, as a share of the way.
_LASTING = 0.02
# Turns are compared over this time, in s.
_CURVE = 3.0
# Only turns of more than this angle are compared, in rad.
_LEAST_TURN = 0.7
# For this time after a jump the survey does not judge, in s.
_AFTER_JUMP = 10.0
# Nor between two jumps within this time, in s: it is displaced from the one to the other.
_BETWEEN_JUMPS = 60.0
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
    def judged(self) -> int:
        """Return the number of claims that the survey judges."""
        return int((self.is_judged & np.isfinite(self.errors)).sum())

    @property
    def is_off(self) -> NDArray[np.bool_]:
        """Return which claims are off by more than 0.5 m and three deviations, judged or not, (n,)."""
        is_off: NDArray[np.bool_] = (self.errors > _WRONG) & (self.errors > 3.0 * self.deviations)
        return is_off

    @property
    def wrong(self) -> int:
        """Return the number of claims that are off, of those that the survey judges."""
        return int((self.is_judged & self.is_off).sum())

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


def stray_density(drive: Drive, mapped: Survey, detector: RangeBearingConfig) -> float:
    """Return the density in 1/m² of detections of something else beside a tree, for each detection of the tree.

    Detections from 0.4 to 1 m beside the nearest tree of a survey show something else, nearer ones the tree.

    Args:
        drive: The surveyed drive.
        mapped: The survey.
        detector: The detector.
    """
    tree, detected = cKDTree(mapped.trees.positions), drive.log.sense["trees"]
    places = [
        transform(pose, range_bearing_landmarks(row, detector).positions)
        for pose, row in zip(_poses_at(mapped, detected.times), detected.values, strict=True)
    ]
    distances, _ = tree.query(np.concatenate(places))
    nearest, farthest = _STRAYS
    strays = int(((distances >= nearest) & (distances < farthest)).sum())
    return strays / float((distances < nearest).sum()) / (np.pi * (farthest**2 - nearest**2))


def as_published(scenario: ParkScenario) -> ParkScenario:
    """Return a scenario with the published car, and a steering that nobody has calibrated."""
    published = ParkScenario()
    return replace(scenario, car=published.car, steering_deviation=published.steering_deviation)


def turn_errors(mapped: Survey, wheels: Array) -> Array:
    """Return by which share of themselves dead reckoning measures turns too large, (m,).

    These are the turns of more than 0.7 rad in 3 s, where the survey judges.

    Args:
        mapped: The survey.
        wheels: The poses by dead reckoning at its times, (n, 3), with headings that are not wrapped.
    """
    times = mapped.times
    first = np.searchsorted(times, np.arange(times[0], times[-1] - _CURVE, _CURVE))
    last = np.searchsorted(times, times[first] + _CURVE)
    is_inside = last < len(times)
    first, last = first[is_inside], last[is_inside]
    measured, true = (np.unwrap(poses[:, 2])[last] - np.unwrap(poses[:, 2])[first] for poses in (wheels, mapped.poses))
    is_judged = judging(mapped, wheels)
    is_curve = np.array([is_judged[i : j + 1].all() for i, j in zip(first, last, strict=True)], dtype=bool)
    is_curve &= np.abs(measured) > _LEAST_TURN
    errors: Array = 1.0 - true[is_curve] / measured[is_curve]
    return errors


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
    told = scenario if case.is_calibrated else as_published(scenario)
    unit = told.unit(tree_model(mapped, source="survey"))
    times = drive.log.sense["trees"].times
    poses, state, answers = reckoned(drive.log.sense["odometry"], told.car, times), unit.start(), []
    with threadpool_limits(1):
        for time, X_OH, scan in zip(times, poses, scans, strict=True):
            answer, state = unit.step(state, scan, X_OH=X_OH, time=time)
            answers.append(answer)
    is_claimed = np.array([answer.status == TRACKING for answer in answers])
    claimed = np.array([answer.pose[:2] for answer in answers])
    off = np.hypot(*(claimed - _poses_at(whole, times)[:, :2]).T)
    deviations = np.sqrt([np.trace(answer.covariance[:2, :2]) for answer in answers])
    is_judged = judging(whole, reckoned(drive.log.sense["odometry"], scenario.car, whole.times))
    rows = np.clip(np.searchsorted(whole.times, times), 0, len(whole.times) - 1)
    return Claims(np.where(is_claimed, off, np.nan), deviations, is_judged[rows])


def judging(whole: Survey, wheels: Array) -> NDArray[np.bool_]:
    """Return at which of its times a survey judges, (n,): where it does not contradict the wheels.

    It jumps where its motion over a second differs from the wheels' by more than three deviations that both together
    allow. From a jump to the next one within a minute it may be displaced, and for ten seconds after each.

    Args:
        whole: The survey.
        wheels: The poses by dead reckoning at its times, (n, 3).
    """
    drift, jumps = SteeringDriftModel(), np.zeros(len(whole.times), dtype=bool)
    for i in range(len(whole.times) - _SCANS_AHEAD):
        j = i + _SCANS_AHEAD
        surveyed_motion, motion = (compose(inverse(poses[i]), poses[j]) for poses in (whole.poses, wheels))
        C = drift.covariance(motion, whole.times[j] - whole.times[i])[:2, :2]
        C += (_SURVEYED**2 + _LASTING**2 * (motion[:2] ** 2).sum()) * np.eye(2)
        if squared_distances((surveyed_motion - motion)[:2], C) > _JUMP**2:
            jumps[i : j + 1] = True
    at = np.concatenate([[-inf], whole.times[jumps], [inf]])
    before = at[np.searchsorted(at, whole.times, side="right") - 1]
    after = at[np.searchsorted(at, whole.times)]
    is_judging: NDArray[np.bool_] = (whole.times - before >= _AFTER_JUMP) & (after - before >= _BETWEEN_JUMPS)
    return is_judging


def _poses_at(whole: Survey, times: Array) -> Array:
    """Return the poses of the survey at the times of scans, (n, 3)."""
    return whole.poses[np.clip(np.searchsorted(whole.times, times), 0, len(whole.times) - 1)]


def report(drive: Drive, seeds: Sequence[int]) -> str:
    """Return the table for some draws of the trees: medians and the worst of them."""
    start, end = drive.log.start, drive.log.end
    first = drive.between(start, 0.5 * (start + end))
    half = prepared(first)
    strays = stray_density(first, half.mapped, half.scenario.detector)
    whole = surveyed(drive, half.scenario, half.config)
    draws = {case: [claims(drive, whole, half.scenario, case, seed=seed) for seed in seeds] for case in CASES}
    is_judged = draws[CASES[0]][0].is_judged
    judge = f"the survey judges {is_judged.sum()} of {len(is_judged)} scans; draws {', '.join(map(str, seeds))}"
    beside = f"first half: {strays:.4f} detections of something else per m^2 beside a tree, for each of the tree"
    return "\n".join([beside, _turned(first, half), judge, tabulated(draws)])


def _turned(first: Drive, half: Prepared) -> str:
    """Return the line on the errors of turns of the first half, with both kinds of steering."""
    parts = []
    for label, car in (("calibrated", half.scenario.car), ("published", as_published(half.scenario).car)):
        errors = turn_errors(half.mapped, reckoned(first.log.sense["odometry"], car, half.mapped.times))
        parts.append(f"{np.sqrt(np.mean(errors**2)):.3f}, {np.abs(errors).max():.3f} {label}")
    return f"first half: error of sharp turns, as a share, RMS and largest: {'; '.join(parts)}"


def tabulated(draws: Mapping[Case, Sequence[Claims]]) -> str:
    """Return the table of the claims by case and draw: each draw, and in the last columns, medians and worst."""
    rows = []
    for case, claimed in draws.items():
        available = 100.0 * np.array([claim.available for claim in claimed])
        errors = [np.array([claim.within(share) for claim in claimed]) for share in (0.5, 0.99)]
        rows.append(
            [
                f"{case.deviation:g} m" + ", mirrored" * case.is_mirrored,
                "calibrated" if case.is_calibrated else "published",
                ", ".join(f"{share:.0f}" for share in available),
                f"{np.median(available):.0f}, {available.min():.0f} %",
                ", ".join(f"{claim.wrong}" for claim in claimed),
                ", ".join(f"{claim.is_off.sum()}" for claim in claimed),
                ", ".join(f"{claim.judged}" for claim in claimed),
                *(f"{np.median(values):.2f}, {values.max():.2f}" for values in errors),
            ]
        )
    worst = "median, worst"
    header = ["told", "steering", "with a pose, %", worst, "wrong", "all", "judged", "error, m", "99 %, m"]
    return table(header, rows)


@click.command()
@click.argument("folder", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.option("--first", type=click.IntRange(min=0), default=3, show_default=True, help="The first draw of the trees.")
@click.option("--seeds", type=click.IntRange(min=1), default=3, show_default=True, help="Draws of the trees.")
def main(folder: Path, first: int, seeds: int) -> None:
    """Localize along the drive in FOLDER where a scan shows two trees of the map."""
    click.echo(report(victoria_park(folder), range(first, first + seeds)))


if __name__ == "__main__":
    main()
