"""The localization unit on foot: carried by a worker in the hand or on the back, beside the machine on wheels.

``python -m vtbdrake_diagrams.forest.studies.on_foot`` moves the unit through `FORESTS` forests three times, by each
carrier over the same route, and localizes it with an accurate and with a remote map from what its DPS detects. The
machine drives at 1 m/s, the worker walks at `WALK`. Workers differ in their steps by `STEP_FREQUENCIES`, which the unit
does not know. What is in `FILE` is not simulated again.

The tracker takes roll and pitch from the IMU, as on the machine, and the speed from steps instead of wheels
(`Pedometer`). Scans are de-skewed by this dead reckoning. *Dead reckoning alone* goes on from the true pose at the
first scan with a pose.

The criteria, fixed before any of the forests from `SEED` on was walked through (constants were chosen with forests
300,000 to 300,003): over all forests, with each map and in the hand as on the back, at least `LEAST_LOCALIZED` of the
scans have a pose; there is no wrong claim, as `drives` counts them; the RMS error of the position meets the goal of
`drives` for the map, and is less than the one of dead reckoning alone; and the mean NEES of the last poses, one per
forest, is at most the upper 95 % bound: the claimed errors are not too small. The machine in the same forests has no
criterion: it is what the worker is compared with.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import click
import numpy as np
from threadpoolctl import threadpool_limits

from vtbdrake.cli.output import table
from vtbdrake.common.arrays import rms
from vtbdrake.components.localization.planar import compose, inverse
from vtbdrake_diagrams.forest.scenario import CARRIERS, ForestScenario
from vtbdrake_diagrams.forest.studies.drive import Drive, Track, localize, recorded_drive
from vtbdrake_diagrams.forest.studies.drives import GOALS, forest, nees_bounds
from vtbdrake_diagrams.forest.world.stand import MAPS
from vtbdrake_diagrams.kept_results import add_results, read_results

SEED = 730_000
"""The seed of the first forest. No constant of the walk or of the unit may be chosen with forests from this seed on."""
FORESTS = 20
"""The number of forests."""
LENGTH = 30.0
"""The length of the way in m."""
WALK = 1.2
"""The speed of the worker in m/s."""
HEIGHTS = {"hand": 1.4, "back": 2.0}
"""The height of the unit over the ground in m, by the carrier on foot."""
STEP_FREQUENCIES = (1.7, 2.0)
"""The range of the steps per second of workers at 1.2 m/s."""
MAP_NAMES = ("accurate", "remote")
"""The maps with which the unit localizes."""
LEAST_LOCALIZED = 0.9
"""The least share of the scans with a pose."""
FILE = Path(__file__).with_suffix(".json")
"""The file in which the results are kept."""


@dataclass(frozen=True)
class Way:
    """The results of one way with one map.

    Attributes:
        variant: The carrier, or another name of what is compared.
        map: The name of the map.
        rms: RMS error of the position in m, over the scans with a pose; None without a pose.
        heading: RMS error of the heading in rad; None without a pose.
        reckoned: RMS error of the position in m by dead reckoning alone, at the same scans; None without a pose.
        astray: Its error at the end, as a share of the way since the first pose; None without a pose.
        nees: Mean NEES of all poses; None without a pose.
        last_nees: NEES of the last pose, of 3 degrees of freedom; None without a pose.
        poses: The number of scans with a pose.
        scans: The number of scans.
        losses: The number of times that the pose was lost.
        wrong: The number of wrong claims.
        tilt: RMS error of roll and of pitch by the dead reckoning, in rad.
    """

    variant: str
    map: str
    rms: float | None
    heading: float | None
    reckoned: float | None
    astray: float | None
    nees: float | None
    last_nees: float | None
    poses: int
    scans: int
    losses: int
    wrong: int
    tilt: tuple[float, float]


Ways = Mapping[int, Sequence[Way]]
"""The results by the seed of the forest."""


def carried(seed: int, carrier: str) -> ForestScenario:
    """Return the scenario of a way: the forest, route and start of `drives.forest`, with one of `CARRIERS`."""
    scenario = forest(seed)
    if carrier == "machine":
        return scenario
    frequency = float(np.random.default_rng([seed, 22]).uniform(*STEP_FREQUENCIES))
    return replace(scenario, carrier=carrier, speed=WALK, step_frequency=frequency, scanner_height=HEIGHTS[carrier])


def walked(seed: int, *, length: float = LENGTH, carriers: Sequence[str] = CARRIERS) -> list[Way]:
    """Return the results in the forest of a seed.

    Args:
        seed: Determines forest, route, start, the worker's steps and noise.
        length: The length of the way in m.
        carriers: The carriers of the unit.
    """
    ways = []
    # One thread: matrices are small, and threads that wait for each other take most of the time.
    with threadpool_limits(1):
        for carrier in carriers:
            scenario = carried(seed, carrier)
            drive = recorded_drive(scenario, length=length)
            for name in MAP_NAMES:
                surveyed = replace(scenario, map=name)
                ways.append(judged(localize(drive, surveyed.unit(surveyed.global_map())), carrier, name))
    return ways


def judged(track: Track, variant: str, name: str) -> Way:
    """Return the results of one way.

    Args:
        track: The answers of the unit.
        variant: The name of what is compared.
        name: The name of the map.
    """
    drive, errors, nees = track.drive, track.errors, track.nees
    distances, has_pose = np.hypot(*errors[:, :2].T), bool(len(errors))
    off = _reckoning_errors(track)
    roll, pitch = (rms(angles) for angles in drive.tilts.T)
    way = drive.travelled[-1] - drive.travelled[track.is_localized][0] if has_pose else 0.0
    return Way(
        variant=variant,
        map=name,
        rms=rms(distances) if has_pose else None,
        heading=rms(errors[:, 2]) if has_pose else None,
        reckoned=rms(off) if has_pose else None,
        astray=float(off[-1] / way) if way else None,
        nees=float(nees.mean()) if has_pose else None,
        last_nees=float(nees[-1]) if has_pose else None,
        poses=len(errors),
        scans=len(drive.times),
        losses=track.losses,
        wrong=int((distances > 0.5 + 4.0 * MAPS[name].position).sum()),
        tilt=(roll, pitch),
    )


def _reckoning_errors(track: Track) -> np.ndarray:
    """Return the errors (m) of dead reckoning from the true pose at the first pose on, at the scans with a pose."""
    drive: Drive = track.drive
    rows = np.flatnonzero(track.is_localized)
    if not len(rows):
        return np.zeros(0)
    begin = compose(drive.truth[rows[0]], inverse(drive.reckoned[rows[0]]))
    return np.array([np.hypot(*(compose(begin, drive.reckoned[row]) - drive.truth[row])[:2]) for row in rows])


@dataclass(frozen=True)
class WaySummary:
    """The results over all forests, of one variant with one map.

    Attributes:
        rms: RMS error of the position in m, over all scans with a pose.
        heading: RMS error of the heading in rad.
        reckoned: RMS error of the position by dead reckoning alone, in m.
        astray: Median of its errors at the end, as a share of the way.
        localized: The share of the scans with a pose.
        nees: Mean NEES of all poses.
        last_nees: Mean NEES of the last poses.
        bounds: The 95 % bounds of ``last_nees``.
        losses: The number of times that a pose was lost.
        wrong: The number of wrong claims.
        tilt: RMS error of the vertical in rad, of roll and pitch together.
    """

    rms: float
    heading: float
    reckoned: float
    astray: float
    localized: float
    nees: float
    last_nees: float
    bounds: tuple[float, float]
    losses: int
    wrong: int
    tilt: float

    def meets_goal(self, name: str) -> bool:
        """Return whether error, share of poses, claims and NEES meet the criteria, with a map of this name."""
        return not self.missed(name)

    def missed(self, name: str) -> str:
        """Return which of these criteria are missed, in words; nothing if all are met."""
        goal, bound = GOALS[name].position, self.bounds[1]
        reasons = {
            f"an error above {goal:g} m": not self.rms <= goal,
            f"a pose in less than {LEAST_LOCALIZED:.0%}": self.localized < LEAST_LOCALIZED,
            f"{self.wrong} wrong claims": self.wrong > 0,
            f"NEES {self.last_nees:.2f} above {bound:.2f}": not self.last_nees <= bound,
        }
        return " and ".join(reason for reason, is_missed in reasons.items() if is_missed)


def summary(ways: Ways, variant: str, name: str) -> WaySummary:
    """Return the results over all forests of a variant with a map of this name."""
    cases = [way for of in ways.values() for way in of if (way.variant, way.map) == (variant, name)]
    located = [case for case in cases if case.poses]
    weights = np.array([case.poses for case in located])

    def mean(of: str, power: int = 1) -> float:
        values = np.array([getattr(case, of) for case in located]) ** power
        return float((weights * values).sum() / weights.sum()) ** (1.0 / power) if len(located) else np.nan

    return WaySummary(
        rms=mean("rms", 2),
        heading=mean("heading", 2),
        reckoned=mean("reckoned", 2),
        astray=float(np.median([case.astray for case in located])),
        localized=sum(case.poses for case in cases) / sum(case.scans for case in cases),
        nees=mean("nees"),
        last_nees=float(np.mean([case.last_nees for case in located])),
        bounds=nees_bounds(len(located)),
        losses=sum(case.losses for case in cases),
        wrong=sum(case.wrong for case in cases),
        tilt=rms([np.hypot(*case.tilt) for case in cases]),
    )


def holds(ways: Ways) -> bool:
    """Return whether the criteria hold for the unit in the hand and on the back, with both maps."""
    cases = [(summary(ways, carrier, name), name) for carrier, name in product(CARRIERS[1:], MAP_NAMES)]
    return all(each.meets_goal(name) and each.rms < each.reckoned for each, name in cases)


def report(ways: Ways, variants: Sequence[str] = CARRIERS) -> str:
    """Return the table of the results.

    Args:
        ways: The results.
        variants: The names of what is compared, in the order of the rows.
    """
    header = ("unit", "map", "RMSE m", "deg", "reckoned m", "astray", "localized", "lost", "wrong")
    header = (*header, "NEES", "of last", "95 %", "tilt mrad", "goal")
    rows = []
    for variant, name in product(variants, MAP_NAMES):
        each = summary(ways, variant, name)
        rows.append(
            (
                variant,
                name,
                f"{each.rms:.3f}",
                f"{np.degrees(each.heading):.2f}",
                f"{each.reckoned:.2f}",
                f"{each.astray:.1%}",
                f"{each.localized:.1%}",
                str(each.losses),
                str(each.wrong),
                f"{each.nees:.1f}",
                f"{each.last_nees:.2f}",
                f"{each.bounds[0]:.2f} to {each.bounds[1]:.2f}",
                f"{1e3 * each.tilt:.1f}",
                "yes" if each.meets_goal(name) else "NO",
            )
        )
    return f"{table(header, rows)}\n{len(ways)} forests"


def in_words(ways: Ways) -> str:
    """Return how the unit does on foot, in a few sentences."""
    parts = []
    for carrier in ("hand", "back"):
        each = [summary(ways, carrier, name) for name in MAP_NAMES]
        errors = ", ".join(f"{of.rms:.3f} m with the {name} map" for of, name in zip(each, MAP_NAMES, strict=True))
        parts.append(
            f"{'in the hand' if carrier == 'hand' else 'on the back'} {errors}, a pose in "
            f"{min(of.localized for of in each):.0%}, {sum(of.wrong for of in each)} wrong claims"
        )
    misses = [
        f"{carrier} with the {name} map: {reason}"
        for carrier, name in product(CARRIERS[1:], MAP_NAMES)
        if (reason := summary(ways, carrier, name).missed(name))
    ]
    machine = ", ".join(f"{summary(ways, 'machine', name).rms:.3f} m" for name in MAP_NAMES)
    reckoned = summary(ways, "hand", "accurate").reckoned
    return (
        f"Carried by a worker on foot through {len(ways)} other forests it errs by (RMS) {'; '.join(parts)}. Dead "
        f"reckoning by steps alone errs by {reckoned:.2f} m, the machine in the same forests by {machine}. The "
        f"criteria on foot: {'all met' if holds(ways) else 'NOT met, ' + '; '.join(misses)}."
    )


def load(file: Path = FILE) -> dict[int, list[Way]]:
    """Return the results that are kept in a file.

    Args:
        file: The file, by default `FILE`.

    Raises:
        KeptResultsError: It is missing, or was changed.
    """
    return {
        int(seed): [Way(**{**way, "tilt": tuple(way["tilt"])}) for way in ways]
        for seed, ways in read_results(file).items()
    }


@click.command(context_settings={"show_default": True})
@click.option("--forests", default=FORESTS, help="Number of forests.")
@click.option("--workers", default=2, help="Number of processes.")
def main(forests: int, workers: int) -> None:
    """Go through the forests that the file lacks, and print the table of all."""
    results = load() if FILE.exists() else {}
    command = "python -m vtbdrake_diagrams.forest.studies.on_foot"
    add_results(FILE, results, range(SEED, SEED + forests), walked, command=command, workers=workers)
    print(report(results))
    print(f"on foot: {'holds' if holds(results) else 'does NOT hold'}")


if __name__ == "__main__":
    # Under its own name, so that worker processes find its classes.
    from vtbdrake_diagrams.forest.studies.on_foot import main as program

    program()
