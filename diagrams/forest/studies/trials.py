"""Trials of global localization: how often a place is recognized on a map without a guess, and how often wrongly.

``python -m vtbdrake_diagrams.forest.studies.trials [--trials N] [--seed S]`` draws stands, maps with errors and places,
simulates the detections (`detections`), and prints a table: how often the matching of constellations was sure and
right, sure and wrong, or not sure, with its errors, consistency and time.

The criteria, fixed before any result was seen:

* Places and headings are uniform in a stand of 1 ha; in the cases ``inside``, at least `MARGIN` from its edge, and in
  the cases ``edge`` nearer, where fewer trees are within reach: there are none outside of the stand.
* A place ``outside`` lies in another stand of the same kind, which the map does not show: each sure pose is wrong.
* A pose is right if it is nearer to the true one than 0.2 m plus four standard deviations of the map's positions, and
  turned by less than `LARGEST_TURN`.
* With the poor map, landmarks are gathered along a drive of 40 m; in a plantation also with the remote one, beside the
  trials from one place.
* Seeds begin at 100,000. No constant of the matching may be chosen with these trials.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import click
import numpy as np

from vtbdrake.arrays import Array
from vtbdrake.cli.output import table
from vtbdrake.components.localization.constellation import ConstellationMap
from vtbdrake.components.localization.landmarks import Landmarks, map_landmarks
from vtbdrake.components.localization.planar import compose, wrap
from vtbdrake_diagrams.forest.studies.detections import Detector, Odometry, Wood, arc, gathered
from vtbdrake_diagrams.forest.world.stand import MAPS, Stand

SEED = 100_000
MARGIN = 10.0
"""The least distance of a place ``inside`` from the edge of the stand, in m."""
LARGEST_TURN = np.radians(10.0)
DRIVE = 40.0
"""The length of the drive over which landmarks are gathered, in m."""
DENSITIES = (300.0, 600.0, 1000.0)
GOALS = {"accurate": 0.97, "remote": 0.95, "poor": 0.90}
"""The least share of the places inside that must be recognized: right and sure."""
LARGEST_WRONG = 1e-3
"""The limit below which the share of the trials that are wrong and sure must be."""


@dataclass(frozen=True)
class Case:
    """A kind of trial.

    Attributes:
        stand: The kind of stand, ``natural`` or ``plantation``.
        density: Trees per hectare.
        map: The map, ``accurate``, ``remote`` or ``poor``.
        place: The place of the carrier, ``inside``, ``edge`` or ``outside``.
        is_driven: Whether landmarks are gathered along a drive; with the poor map, they always are.
    """

    stand: str
    density: float
    map: str
    place: str
    is_driven: bool = False

    @property
    def way(self) -> float:
        """The distance in m along which landmarks are gathered."""
        return DRIVE if self.is_driven or self.map == "poor" else 0.0

    @property
    def is_judged(self) -> bool:
        """Return whether the share of places recognized has a goal in this case."""
        return self.stand == "natural" and self.place == "inside"


@dataclass(frozen=True)
class Trial:
    """The result of one trial.

    Attributes:
        is_sure: Whether the pose is sure.
        is_right: Whether the pose is sure and right.
        position: Error of the position in m.
        heading: Error of the heading in rad.
        nees: Normalized estimation error squared, of 3 degrees of freedom.
        seconds: CPU time of the matching, the table of the map not included.
    """

    is_sure: bool
    is_right: bool
    position: float
    heading: float
    nees: float
    seconds: float


def cases() -> list[Case]:
    """Return all kinds of trials."""
    natural = [
        Case("natural", density, name, place)
        for place in ("inside", "edge", "outside")
        for name in GOALS
        for density in DENSITIES
    ]
    rows = [Case("plantation", 1000.0, name, place) for place in ("inside", "outside") for name in GOALS]
    driven = [Case("plantation", 1000.0, "remote", place, is_driven=True) for place in ("inside", "outside")]
    return natural + rows + driven


def run(case: Case, *, seed: int, detector: Detector | None = None, odometry: Odometry | None = None) -> Trial:
    """Run one trial.

    Args:
        case: The kind of trial.
        seed: Determines stand, map, place and detections.
        detector: The detector; by default that of `Detector`, with a share of false trunks from 0.3 to 0.4.
        odometry: The drift of the dead reckoning; by default that of `Odometry`.
    """
    rng = np.random.default_rng([seed, 7])
    stand = _stand(case, seed)
    errors = MAPS[case.map]
    detector = detector or Detector(false=rng.uniform(0.3, 0.4))
    wood = Wood.of(_stand(case, seed + 10**6) if case.place == "outside" else stand, false=detector.false, rng=rng)
    poses = _drive(case, stand, rng) if case.way else _place(case, stand, rng)[np.newaxis]
    local, _ = gathered(wood, poses, detector, odometry or Odometry(), rng)
    constellation = ConstellationMap(map_landmarks(stand.map(errors)), correlation=errors.correlation)
    return judged(constellation, local, poses[-1], case)


def judged(constellation: ConstellationMap, local: Landmarks, X_WH: Array, case: Case) -> Trial:
    """Return the result of matching local landmarks whose true pose is known."""
    begin = time.process_time()
    fix = constellation.locate(local)
    seconds = time.process_time() - begin
    if not fix.is_sure:
        return Trial(False, False, np.nan, np.nan, np.nan, seconds)
    error = np.append(fix.pose[:2] - X_WH[:2], wrap(fix.pose[2] - X_WH[2]))
    position, heading = float(np.hypot(*error[:2])), abs(float(error[2]))
    is_near = position < 0.2 + 4.0 * MAPS[case.map].position and heading < LARGEST_TURN
    nees = float(error @ np.linalg.solve(fix.covariance, error))
    return Trial(True, case.place != "outside" and is_near, position, heading, nees, seconds)


def _stand(case: Case, seed: int) -> Stand:
    return Stand(seed=seed, density=case.density, kind=case.stand)


def _place(case: Case, stand: Stand, rng: np.random.Generator) -> Array:
    """Return a pose in the stand, at its edge or not."""
    extent = np.array([stand.length, stand.width])
    while True:
        place = rng.random(2) * extent
        is_at_edge = min(*place, *(extent - place)) < MARGIN
        if is_at_edge == (case.place == "edge"):
            return np.array([*place, rng.uniform(-np.pi, np.pi)])


def _drive(case: Case, stand: Stand, rng: np.random.Generator) -> Array:
    """Return poses of a drive within the stand that ends at a place of the case, every 2 m."""
    extent = np.array([stand.length, stand.width])
    while True:
        end = _place(case, stand, rng)
        # Backwards from the end: turned by half a turn, driven, and turned back.
        back = arc(compose(end, [0.0, 0.0, np.pi]), length=case.way, curvature=rng.uniform(-0.03, 0.03), step=2.0)
        if (back[:, :2] > 0.0).all() and (back[:, :2] < extent).all():
            return np.array([compose(pose, [0.0, 0.0, np.pi]) for pose in back[::-1]])


def trials(cases_to_try: Sequence[Case], *, count: int, seed: int = SEED) -> Iterator[tuple[Case, list[Trial]]]:
    """Run ``count`` trials of each case, and yield them; no two cases share a stand."""
    for number, case in enumerate(cases_to_try):
        first = seed + number * count
        yield case, [run(case, seed=first + k) for k in range(count)]


def row(case: Case, trials_of_case: Sequence[Trial]) -> tuple[str, ...]:
    """Return the row of the table of one case."""
    right = [trial for trial in trials_of_case if trial.is_right]
    wrong = sum(trial.is_sure and not trial.is_right for trial in trials_of_case)
    return (
        case.stand,
        f"{case.density:g}",
        case.map,
        case.place,
        f"{case.way:g}",
        str(len(trials_of_case)),
        f"{len(right) / len(trials_of_case):.1%}",
        str(wrong),
        f"{sum(not trial.is_sure for trial in trials_of_case) / len(trials_of_case):.1%}",
        _rms([trial.position for trial in right], "{:.3f}"),
        _rms([float(np.degrees(trial.heading)) for trial in right], "{:.2f}"),
        f"{np.mean([trial.nees for trial in right]):.1f}" if right else "",
        f"{1e3 * np.median([trial.seconds for trial in trials_of_case]):.0f}",
    )


HEADER = (
    *("stand", "trees/ha", "map", "place", "driven m", "trials"),
    *("right", "wrong", "not sure", "m", "deg", "NEES", "ms"),
)


def _rms(values: Sequence[float], form: str) -> str:
    return form.format(np.sqrt(np.mean(np.square(values)))) if values else ""


def verdicts(results: Sequence[tuple[Case, Sequence[Trial]]]) -> list[tuple[str, float, float, bool]]:
    """Return, for each goal, (what, value, goal, whether it is met)."""
    rows = []
    for name, goal in GOALS.items():
        judged_ = [trial for case, trials_ in results if case.is_judged and case.map == name for trial in trials_]
        if judged_:
            share = float(np.mean([trial.is_right for trial in judged_]))
            rows.append((f"right and sure, {name} map", share, goal, share >= goal))
    every = [trial for _, trials_ in results for trial in trials_]
    wrong = float(np.mean([trial.is_sure and not trial.is_right for trial in every]))
    rows.append((f"wrong and sure, of {len(every)}", wrong, LARGEST_WRONG, wrong < LARGEST_WRONG))
    return rows


@click.command(context_settings={"show_default": True})
@click.option("--trials", "count", default=40, help="Number of trials per case, of which there are 35.")
@click.option("--seed", default=SEED, help="Seed of the trials.")
def main(count: int, seed: int) -> None:
    """Run the trials, and print their table and whether the goals are met."""
    results, rows = [], []
    for case, trials_of_case in trials(cases(), count=count, seed=seed):
        results.append((case, trials_of_case))
        rows.append(row(case, trials_of_case))
        print("  ".join(rows[-1]), flush=True)
    print(table(HEADER, rows))
    for criterion, value, goal, holds in verdicts(results):
        print(f"{criterion}: {value:.2%} (goal {goal:.1%}): {'yes' if holds else 'NO'}")


if __name__ == "__main__":
    main()
