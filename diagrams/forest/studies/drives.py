"""Drives through many forests: the errors of the localization unit with each of the three maps.

``python -m vtbdrake_diagrams.forest.studies.drives [--forests N] [--bias B] [--full]`` simulates the carrier in each
forest once, with its scanner, 50 m far or 500 m, and records what its DPS detects, and its odometry. From these, one
unit per map localizes, as the DPS's would. ``--stereo`` gives the carrier a pair of cameras instead of the
scanner, ``--simulated`` takes simulated detections (`detections`), ``--plain`` drives among rocks instead of trees.

The criteria, fixed before any of the forests from `SEED` on was driven:

* Errors of position and heading are taken over all scans at which the unit is tracking, from the first fix to the end,
  over all forests; nothing is left out.
* The normalized estimation error squared (NEES) has 3 degrees of freedom. Its mean is compared with its 95 % bounds at
  places `INDEPENDENT` m of path apart, the last one of each drive among them: nearer ones share trees, and with them
  the errors of the map.
* A scan without a pose has no error; the share of the scans with a pose is therefore printed, too.
* A pose is a wrong claim if it is farther from the true one than 0.5 m plus four standard deviations of the map.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import click
import numpy as np
from scipy.stats import chi2
from threadpoolctl import threadpool_limits

from vtbdrake.cli.output import table
from vtbdrake.common.arrays import rms
from vtbdrake_diagrams.forest.scenario import CarrierScenario, ForestScenario
from vtbdrake_diagrams.forest.studies.best_estimate import REACH, against_best
from vtbdrake_diagrams.forest.studies.detections import Detector
from vtbdrake_diagrams.forest.studies.drive import Track, localize, recorded_drive, simulated_drive
from vtbdrake_diagrams.forest.world.stand import MAPS
from vtbdrake_diagrams.plain.scenario import PlainScenario
from vtbdrake_diagrams.processes import in_processes

LATE = 10.0
"""The time in s after which errors of the vertical do not belong to the start any more."""

DENSITIES = (605.0, 1210.0)
"""The numbers of trees per hectare of the plots that `stand` cites, before roads are cleared."""
ABUNDANCES = (0.03, 0.1)
"""The shares of the ground that rocks cover: InSight's to twice Spirit's, see `vtbdrake_diagrams.plain.rocks`."""
SOURCES = {
    "scanner": "a scanner in a forest (the default)",
    "stereo": "a pair of cameras instead of a scanner",
    "simulated": "simulated detections instead of a scanner",
    "plain": "a scanner on a plain with rocks, instead of a forest",
}
"""The sources of the detections, and their descriptions."""
SEED = 600_000
"""The seed of the first forest. No constant of the localization may be chosen with forests from this seed on.

Forests from 200,000 and from 500,000 on were driven before, and do not count any more: the duration of the errors of
the vertical was not considered in the first ones, and the noise of the sensors was the same in all.
"""


@dataclass(frozen=True)
class Score:
    """The results of drives with one map.

    Attributes:
        forests: The number of drives.
        path: The total length of the drives in m.
        position: Root mean square error of the position in m, in the plane.
        heading: Root mean square error of the heading in rad.
        wrong: The number of scans with a wrong claim.
        nees: Mean of all NEES.
        independent_nees: Mean of the NEES at independent places.
        bounds: The 95 % bounds of `independent_nees`.
        first_fix: Median and largest time to the first fix in s.
        localized: The share of the scans with a pose.
        losses: The number of times that a pose was lost.
    """

    forests: int
    path: float
    position: float
    heading: float
    wrong: int
    nees: float
    independent_nees: float
    bounds: tuple[float, float]
    first_fix: tuple[float, float]
    localized: float
    losses: int

    @property
    def is_consistent(self) -> bool:
        """Return whether the mean NEES at independent places lies within its bounds."""
        return self.bounds[0] <= self.independent_nees <= self.bounds[1]


def score(tracks: Sequence[Track], *, deviation: float) -> Score:
    """Return the results of drives.

    Args:
        tracks: The tracks, one per forest.
        deviation: Standard deviation of the positions on the map in m, per axis.
    """
    errors = np.concatenate([track.errors for track in tracks])
    nees = [track.nees for track in tracks]
    independent = np.concatenate([values[track.independent] for values, track in zip(nees, tracks, strict=True)])
    distances = np.hypot(*errors[:, :2].T)
    fixes = [track.first_fix[0] for track in tracks]
    return Score(
        forests=len(tracks),
        path=float(sum(track.drive.travelled[-1] for track in tracks)),
        position=rms(distances),
        heading=rms(errors[:, 2]),
        wrong=int((distances > 0.5 + 4.0 * deviation).sum()),
        nees=float(np.mean(np.concatenate(nees))) if len(errors) else np.nan,
        independent_nees=float(np.mean(independent)) if len(independent) else np.nan,
        bounds=nees_bounds(len(independent)),
        first_fix=(float(np.median(fixes)), max(fixes)),
        localized=float(np.mean(np.concatenate([track.is_localized for track in tracks]))),
        losses=sum(track.losses for track in tracks),
    )


def nees_bounds(count: int) -> tuple[float, float]:
    """Return the 95 % bounds of the mean of ``count`` independent NEES of 3 degrees of freedom."""
    if not count:
        return 0.0, np.inf
    low, high = (chi2(3 * count).ppf([0.025, 0.975]) / count).tolist()
    return low, high


@dataclass(frozen=True)
class Goal:
    """The goal with a map.

    Attributes:
        position: Largest root mean square error of the position in m.
        heading: Largest root mean square error of the heading in rad; infinite if there is no such goal.
        is_consistent: Whether NEES must lie within its bounds.
    """

    position: float
    heading: float = np.inf
    is_consistent: bool = False

    def is_met(self, score: Score) -> bool:
        """Return whether a score meets the goal, without a wrong claim."""
        return (
            score.position <= self.position
            and not score.heading > self.heading
            and (score.is_consistent or not self.is_consistent)
            and not score.wrong
        )


GOALS = {
    "accurate": Goal(0.05, np.radians(0.2), is_consistent=True),
    "remote": Goal(0.15, is_consistent=True),
    "poor": Goal(0.5),
}


HEADER = ("map", "RMSE m", "deg", "NEES", "of places", "95 %", "first fix s", "localized", "lost", "wrong", "goal")


def row(name: str, score: Score) -> tuple[str, ...]:
    """Return the row of the table of one map."""
    low, high = score.bounds
    median, longest = score.first_fix
    return (
        name,
        f"{score.position:.3f}",
        f"{np.degrees(score.heading):.2f}",
        f"{score.nees:.1f}",
        f"{score.independent_nees:.2f}",
        f"{low:.2f} to {high:.2f}",
        f"{median:.1f} to {longest:.1f}",
        f"{score.localized:.1%}",
        str(score.losses),
        str(score.wrong),
        "yes" if GOALS[name].is_met(score) else "NO",
    )


def forest(seed: int, *, range_bias: float = 0.0, perception: str = "scanner") -> ForestScenario:
    """Return the scenario of a drive: a stand as dense as published plots, every third one clustered.

    Args:
        seed: Determines stand, route, the start on it, and the noise of all sensors.
        range_bias: The bias of the scanner's ranges in m.
        perception: The sensor, ``scanner`` or ``stereo``.
    """
    rng = np.random.default_rng([seed, 9])
    scenario = ForestScenario(
        seed=seed,
        perception=perception,
        stand_kind="clustered" if seed % 3 == 2 else "natural",
        density=float(rng.uniform(*DENSITIES)),
    )
    scenario.scanner_errors.bias = range_bias
    scenario.stereo.seed = seed
    return _begun(scenario, rng)


def plain(seed: int, *, range_bias: float = 0.0) -> PlainScenario:
    """Return the scenario of a drive among rocks, of an abundance within `ABUNDANCES`; see `forest`."""
    rng = np.random.default_rng([seed, 9])
    scenario = PlainScenario(seed=seed, abundance=float(rng.uniform(*ABUNDANCES)))
    scenario.scanner_errors.bias = range_bias
    return _begun(scenario, rng)


_Carrier = TypeVar("_Carrier", bound=CarrierScenario)


def _begun(scenario: _Carrier, rng: np.random.Generator) -> _Carrier:
    """Return the scenario with noise of its own, at a random place on a random route."""
    for errors in (scenario.scanner_errors, scenario.imu_errors, scenario.odometry_errors):
        errors.seed = scenario.seed
    routes = scenario.routes()
    number = int(rng.integers(len(routes)))
    return replace(scenario, route=number, start=float(rng.uniform(0.0, routes[number].length)))


@dataclass(frozen=True)
class Drives:
    """The drives of the command, one per forest.

    Attributes:
        length: The length of each drive in m.
        range_bias: The bias of the scanner's ranges in m.
        source: The source of the detections, one of `SOURCES`.
    """

    length: float = 50.0
    range_bias: float = 0.0
    source: str = "scanner"

    def scenario(self, seed: int) -> CarrierScenario:
        """Return the scenario of a seed."""
        if self.source == "plain":
            return plain(seed, range_bias=self.range_bias)
        return forest(seed, range_bias=self.range_bias, perception="stereo" if self.source == "stereo" else "scanner")

    def __call__(self, seed: int) -> dict[str, Track]:
        """Return the tracks of units with each of the maps in the scenario of a seed, by map."""
        scenario = self.scenario(seed)
        # One thread: matrices are small, and threads that wait for each other take most of the time.
        with threadpool_limits(1):
            if self.source == "simulated":
                detector = Detector(range_bias=self.range_bias)
                drive = simulated_drive(forest(seed).stand(), seed=seed, length=self.length, detector=detector)
            else:
                drive = recorded_drive(scenario, length=self.length)
            surveys = {name: replace(scenario, map=name) for name in GOALS}
            return {name: localize(drive, survey.unit(survey.global_map())) for name, survey in surveys.items()}

    def through(self, seeds: Sequence[int], *, workers: int = 2) -> Iterator[dict[str, Track]]:
        """Drive through the forests of some seeds in processes, and yield the tracks by map in the order of seeds."""
        yield from (tracks for _, tracks in in_processes(self, seeds, workers=workers))


def scores(tracks_of_drives: Sequence[Mapping[str, Track]]) -> dict[str, Score]:
    """Return the scores by map of the tracks by map, one per forest."""
    return {name: score([tracks[name] for tracks in tracks_of_drives], deviation=MAPS[name].position) for name in GOALS}


def _source_options(command: Callable[..., None]) -> Callable[..., None]:
    """Give a command an option for each source; without one, it is a scanner."""
    for name, description in reversed(SOURCES.items()):
        command = click.option(
            f"--{name}",
            "source",
            flag_value=name,
            default="scanner",
            show_default=False,
            help=f"{description}.",
        )(command)
    return command


@click.command(context_settings={"show_default": True})
@click.option("--forests", default=20, help="Number of forests.")
@click.option("--seed", default=SEED, help="Seed of the first forest.")
@click.option("--bias", default=0.0, help="Bias of the scanner's ranges, in m.")
@click.option("--full", is_flag=True, help="500 m in each forest instead of 50 m.")
@_source_options
@click.option("--workers", default=2, help="Number of processes.")
def main(forests: int, seed: int, bias: float, full: bool, source: str, workers: int) -> None:
    """Run the drives, and print the table."""
    if source == "stereo" and bias:
        raise click.UsageError("--bias is one of the scanner's ranges: leave it out with --stereo")
    drives = Drives(500.0 if full else 50.0, bias, source)
    tracks_of_drives, seeds = [], range(seed, seed + forests)
    for tracks in drives.through(seeds, workers=workers):
        tracks_of_drives.append(tracks)
        errors = ", ".join(f"{name} {score([track], deviation=0.0).position:.3f} m" for name, track in tracks.items())
        print(f"drive {len(tracks_of_drives)}: {errors}", flush=True)
    results = scores(tracks_of_drives)
    print(table(HEADER, [row(name, score_of_map) for name, score_of_map in results.items()]))
    path = next(iter(results.values())).path
    print(f"{len(tracks_of_drives)} drives, {path:.0f} m of path, range bias {bias:g} m")
    driven = {seed: tracks["poor"] for seed, tracks in zip(seeds, tracks_of_drives, strict=True)}
    tilts = 1e3 * np.concatenate([track.drive.tilts for track in driven.values()])
    if len(tilts):
        late = np.concatenate([track.drive.times for track in driven.values()]) > LATE
        for when, rows in (("", slice(None)), (f", later than {LATE:g} s after the start", late)):
            roll, pitch = (rms(angles) for angles in tilts[rows].T)
            print(f"error of the vertical: {roll:.2f} mrad in roll and {pitch:.2f} mrad in pitch (RMS){when}")
    best = against_best(driven, "poor", scenario=drives.scenario)
    print(f"best unbiased estimate on a poor map, by all landmarks within {REACH:g} m so far: {best.least:.2f} m")
    low, high = best.interval
    print(
        f"its error on these very maps: {best.on_maps:.3f} m; the unit errs {best.ratio:.3f} times as much "
        f"(95 %: {low:.2f} to {high:.2f})"
    )


if __name__ == "__main__":
    # Under its own name, so that worker processes find its classes.
    from vtbdrake_diagrams.forest.studies.drives import main as program

    program()
