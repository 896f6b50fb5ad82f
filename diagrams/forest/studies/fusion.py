"""Scanner and cameras of one localization unit, fused in one filter, beside each of them alone on the same drives.

``python -m vtbdrake_diagrams.forest.studies.fusion [--forests N]`` drives a carrier with both sensors through forests,
once each, and localizes it three times from what was recorded: with the scanner, with the cameras, with both. What is
in `FILE` is not driven again. Three conditions are made from the same recordings (`CONDITIONS`): the sensors as they
are, a scanner that sees `SHORT` m far only, as in dust or snow, and a scanner that is silent in the second half of the
drive.

The criteria, fixed before any of the forests from `SEED` on was driven: the error of the position, RMS over all
forests, at the sample times of the judged part at which both units claim a pose that are compared; the share of times
with a pose; wrong claims as `drives` counts them; and the number of forests in which both sensors err less than each
alone. Both must be no worse than each alone under each condition and with each map (`Summary.is_no_worse`), and better
in most forests under one of them. (Errors over the times of each unit's own poses cannot be compared: a unit that loses
its pose where it is hard errs less in the mean. A first campaign, from seed 700,000 on, was judged so.)
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from math import nan
from pathlib import Path

import click
import numpy as np
from threadpoolctl import threadpool_limits

from vtbdrake.cli.output import table
from vtbdrake.common.arrays import Array, rms
from vtbdrake.components.localization.landmarks import SensorView
from vtbdrake_diagrams.forest.scenario import ForestScenario
from vtbdrake_diagrams.forest.studies.drive import STANDING, Drive, localize, recorded_drive
from vtbdrake_diagrams.forest.studies.drives import forest
from vtbdrake_diagrams.forest.world.stand import MAPS
from vtbdrake_diagrams.kept_results import add_results, read_results

SEED = 710_000
"""The seed of the first forest."""
LENGTH = 20.0
"""The length of a drive in m."""
FILE = Path(__file__).with_suffix(".json")
"""The file in which the errors are kept."""
SILENT = "scanner falls silent"
"""The condition that is judged from the middle of the drive on."""
LARGEST_RATIO = 1.05
"""The largest ratio of the error with both sensors to the error of the better one, where both count as no worse."""
LOST_SHARE = 0.02
"""The share of poses that both sensors may have less than the one that has more."""
SHORT = 12.0
"""The distance to which a scanner in dust or snow sees trunks, in m."""
MAP_NAMES = ("accurate", "remote")
"""The maps with which the unit localizes."""
SENSORS = {"scanner": "scanner", "cameras": "stereo", "both": "both"}
"""The perception of the scenario whose unit is used, by the name of the sensors."""
ALONE = ("scanner", "cameras")
"""The sensors that both are compared with."""


def _as_it_is(view: SensorView, time: float, *, middle: float) -> SensorView:
    return view


def _short(view: SensorView, time: float, *, middle: float) -> SensorView:
    if not view.is_scan:
        return view
    trunks = view.landmarks
    return replace(view, landmarks=trunks.select(np.hypot(*trunks.positions.T) < SHORT))


def _silent(view: SensorView, time: float, *, middle: float) -> SensorView | None:
    return None if view.is_scan and time > middle else view


CONDITIONS: Mapping[str, Callable[..., SensorView | None]] = {
    "as it is": _as_it_is,
    f"scanner sees {SHORT:g} m": _short,
    SILENT: _silent,
}
"""The conditions: functions that return what is left of a view at a time, with the middle of the drive."""


def seen_by(drive: Drive, sensors: str, condition: str) -> Drive:
    """Return the drive with what some of the sensors see under a condition.

    Samples without anything are left in, without views: the carrier moves on by dead reckoning.

    Args:
        drive: The drive of a carrier with both sensors.
        sensors: ``scanner``, ``cameras`` or ``both``.
        condition: One of `CONDITIONS`.
    """
    see = partial(CONDITIONS[condition], middle=middle(drive))
    kinds = {"scanner": (True,), "cameras": (False,), "both": (True, False)}[sensors]
    landmarks = []
    for time, views in zip(drive.times, drive.landmarks, strict=True):
        remaining = [see(view, time) for view in views if view.is_scan in kinds]
        # Cameras alone are the sensor whose bias is estimated, as in their scenario.
        landmarks.append([replace(each, is_scan=each.is_scan or sensors == "cameras") for each in remaining if each])
    return replace(drive, landmarks=tuple(landmarks))


def middle(drive: Drive) -> float:
    """Return the time in the middle of the motion, in s."""
    return float(0.5 * (STANDING + drive.times[-1]))


@dataclass(frozen=True)
class Error:
    """The errors of the position in one forest, under one condition, with one map and some of the sensors.

    Attributes:
        condition, map, sensors: Their names.
        rms: RMS error of the position in m, None without a pose.
        common: RMS errors in m with these sensors, and with both, at the times at which both units have a pose; None if
            there is none.
        common_poses: The number of these times.
        poses: The number of sample times with a pose.
        samples: The number of sample times.
        wrong: The number of wrong claims.
    """

    condition: str
    map: str
    sensors: str
    rms: float | None
    common: tuple[float, float] | None
    common_poses: int
    poses: int
    samples: int
    wrong: int


Forests = Mapping[int, Sequence[Error]]
"""The errors by the seed of the forest."""


def compared(seed: int, *, length: float = LENGTH) -> list[Error]:
    """Return the errors in the forest of a seed.

    Args:
        seed: Determines forest, route, start and noise.
        length: The length of the drive in m.
    """
    scenario = forest(seed, perception="both")
    with threadpool_limits(1):
        return judged(recorded_drive(scenario, length=length), scenario)


def judged(drive: Drive, scenario: ForestScenario) -> list[Error]:
    """Return the errors of a drive.

    Args:
        drive: The drive of a carrier with both sensors.
        scenario: Its scenario.
    """
    errors = []
    for name, condition in product(MAP_NAMES, CONDITIONS):
        counts = drive.times > (middle(drive) if condition == SILENT else STANDING)
        distances = {
            s: position_errors(drive, replace(scenario, perception=SENSORS[s], map=name), s, condition)[counts]
            for s in SENSORS
        }
        for sensors, of in distances.items():
            is_claimed, is_common = np.isfinite(of), np.isfinite(of + distances["both"])
            wrong = int((of[is_claimed] > 0.5 + 4.0 * MAPS[name].position).sum())
            poses, common_poses = int(is_claimed.sum()), int(is_common.sum())
            error = rms(of[is_claimed]) if poses else None
            common = (rms(of[is_common]), rms(distances["both"][is_common])) if common_poses else None
            errors.append(Error(condition, name, sensors, error, common, common_poses, poses, len(of), wrong))
    return errors


def position_errors(drive: Drive, scenario: ForestScenario, sensors: str, condition: str) -> Array:
    """Return the errors of the position in m at the sample times of a drive, NaN without a pose, shape (n,)."""
    track = localize(seen_by(drive, sensors, condition), scenario.unit(scenario.global_map()))
    return np.where(track.is_localized, np.hypot(*(track.poses - drive.truth)[:, :2].T), nan)


@dataclass(frozen=True)
class Summary:
    """The errors over all forests, under one condition and with one map.

    Attributes:
        rms: RMS error of the position in m by sensors; NaN without a pose.
        ratios: The RMS error with both sensors over the error with one of them, at the times at which both units have a
            pose; only of sensors with such times.
        shares: The share of the sample times with a pose, by sensors.
        wrong: The number of wrong claims, by sensors.
        better: The number of forests in which both sensors err less than each alone, at these times.
        forests: The number of forests.
    """

    rms: Mapping[str, float]
    ratios: Mapping[str, float]
    shares: Mapping[str, float]
    wrong: Mapping[str, int]
    better: int
    forests: int

    @property
    def is_no_worse(self) -> bool:
        """Return whether both are no worse than each alone, in error, share of poses and wrong claims."""
        alone = max(self.shares["scanner"], self.shares["cameras"])
        is_as_accurate = all(ratio <= LARGEST_RATIO for ratio in self.ratios.values())
        return is_as_accurate and self.shares["both"] >= alone - LOST_SHARE and not self.wrong["both"]


def holds(forests: Forests) -> bool:
    """Return whether both sensors are no worse than each alone under all conditions, and better under one of them."""
    summaries = [summary(forests, condition, name) for condition, name in product(CONDITIONS, MAP_NAMES)]
    is_no_worse = all(summary.is_no_worse for summary in summaries)
    return is_no_worse and any(2 * summary.better > summary.forests for summary in summaries)


def summary(forests: Forests, condition: str, name: str) -> Summary:
    """Return the errors over all forests under a condition, with a map of this name."""
    by_sensors = {
        sensors: [
            error
            for errors in forests.values()
            for error in errors
            if (error.condition, error.map, error.sensors) == (condition, name, sensors)
        ]
        for sensors in SENSORS
    }
    poses = {sensors: sum(e.poses for e in errors) for sensors, errors in by_sensors.items()}
    squares = {s: sum(e.poses * (e.rms or 0.0) ** 2 for e in errors) for s, errors in by_sensors.items()}
    return Summary(
        {s: float(np.sqrt(squares[s] / poses[s])) if poses[s] else nan for s in SENSORS},
        {s: ratio for s in ALONE if (ratio := _ratio(by_sensors[s])) is not None},
        {s: poses[s] / sum(e.samples for e in errors) for s, errors in by_sensors.items()},
        {s: sum(e.wrong for e in errors) for s, errors in by_sensors.items()},
        sum(_errs_less(alone) for alone in zip(*(by_sensors[s] for s in ALONE), strict=True)),
        len(forests),
    )


def _ratio(errors: Sequence[Error]) -> float | None:
    """Return the RMS error with both sensors over the error with these, at common times of all forests."""
    pairs = [(error.common_poses, *error.common) for error in errors if error.common is not None]
    if not pairs:
        return None
    counts, alone, both = np.array(pairs).T
    return float(np.sqrt((counts * both**2).sum() / (counts * alone**2).sum()))


def _errs_less(alone: Sequence[Error]) -> bool:
    """Return whether both sensors err less in a forest than each alone that has a pose there."""
    pairs = [error.common for error in alone if error.common is not None]
    return bool(pairs) and all(both < error for error, both in pairs)


def report(forests: Forests) -> str:
    """Return the table of the errors in some forests."""
    rows = []
    for condition, name in product(CONDITIONS, MAP_NAMES):
        each = summary(forests, condition, name)
        cells = [
            f"{each.rms[s]:.3f} m in {each.shares[s]:.0%}, {each.wrong[s]} wrong" if each.shares[s] else "no pose"
            for s in SENSORS
        ]
        ratios = [f"{each.ratios[s]:.2f}" if s in each.ratios else "-" for s in ALONE]
        rows.append((condition, name, *cells, *ratios, f"{each.better} of {each.forests}"))
    ratios = [f"both over {s}" for s in ALONE]
    return table(("condition", "map", *SENSORS, *ratios, "both better"), rows)


def load() -> dict[int, list[Error]]:
    """Return the errors that are kept in `FILE`.

    Raises:
        KeptResultsError: It is missing, or was changed.
    """
    return {int(seed): [Error(**error) for error in errors] for seed, errors in read_results(FILE).items()}


@click.command(context_settings={"show_default": True})
@click.option("--forests", default=20, help="Number of forests.")
@click.option("--workers", default=2, help="Number of processes.")
def main(forests: int, workers: int) -> None:
    """Drive through the forests that the file lacks, and print the table of all."""
    results = load() if FILE.exists() else {}
    command = "python -m vtbdrake_diagrams.forest.studies.fusion"
    add_results(FILE, results, range(SEED, SEED + forests), compared, command=command, workers=workers)
    print(report(results))


if __name__ == "__main__":
    # Under its own name, so that worker processes find its classes.
    from vtbdrake_diagrams.forest.studies.fusion import main as program

    program()
