"""Drives through many forests: how well the localization unit knows where it is, with each of the three maps.

``python -m vtbdrake_diagrams.forest.drives [--forests N] [--bias B] [--full]`` drives 50 m in each forest, with
simulated detections (`detections`), and localizes with one unit per map, from the same detections and odometry. Every
third forest is a clustered one.

What counts, fixed before any result was seen:

* Errors of position and heading are those of all scans at which the unit says that it is tracking, from the first fix
  to the end, over all forests; nothing is left out.
* NEES is of 3 degrees of freedom. Its mean is compared with its 95 % bounds at places `INDEPENDENT` m of path apart,
  which are taken as independent: nearer ones share most of their trees, and with them the errors of the map.
* A claim is wrong if the pose is farther from the true one than 0.5 m plus four standard deviations of the map.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import chi2
from threadpoolctl import threadpool_limits

from vtbdrake.cli.output import table
from vtbdrake.components.localization.constellation import ConstellationMap
from vtbdrake.components.localization.landmarks import Landmarks, map_landmarks
from vtbdrake.components.localization.planar import wrap
from vtbdrake.components.localization.tracking import Tracker
from vtbdrake.components.localization.unit import LOST, TRACKING, LocalizationUnit
from vtbdrake_diagrams.forest.detections import Detector, Odometry, Wood, arc, dead_reckoned
from vtbdrake_diagrams.forest.stand import MAPS, MapErrors, Stand

Array = NDArray[np.float64]

INDEPENDENT = 20.0
"""Distance in m along the path from which on estimates count as independent."""
SCANS = 5.0
"""Scans per second."""
SEED = 200_000
"""Of the first forest. No constant of the localization may be chosen by forests from this seed on."""


@dataclass(frozen=True, eq=False)
class Drive:
    """What a unit gets along a drive, and where it was in truth.

    Attributes:
        times: The times of the scans in s, shape (n,).
        truth: The true poses X_WH, shape (n, 3).
        reckoned: Those of the odometry, X_OH, shape (n, 3).
        landmarks: What was detected in each scan, in H; n of them.
    """

    times: Array
    truth: Array
    reckoned: Array
    landmarks: tuple[Landmarks, ...]

    @property
    def travelled(self) -> Array:
        """How far the carrier has come at each scan, in m, shape (n,)."""
        return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(self.truth[:, :2], axis=0).T))])


@dataclass(frozen=True, eq=False)
class Track:
    """What a unit says along a drive.

    Attributes:
        drive: The drive.
        poses: X_WH, shape (n, 3); NaN without a pose.
        covariances: Their covariances, shape (n, 3, 3).
        status: `SEARCHING`, `TRACKING` or `LOST`, shape (n,).
    """

    drive: Drive
    poses: Array
    covariances: Array
    status: NDArray[np.int_]

    @property
    def is_localized(self) -> NDArray[np.bool_]:
        """Whether the unit claims a pose, shape (n,)."""
        return self.status == TRACKING

    @property
    def errors(self) -> Array:
        """Errors [x, y, heading] in m and rad where a pose is claimed, shape (m, 3)."""
        errors = (self.poses - self.drive.truth)[self.is_localized]
        errors[:, 2] = [wrap(angle) for angle in errors[:, 2]]
        return errors

    @property
    def nees(self) -> Array:
        """Normalized estimation error squared where a pose is claimed, shape (m,)."""
        errors = self.errors
        inverses = np.linalg.inv(self.covariances[self.is_localized])
        return np.einsum("ni,nij,nj->n", errors, inverses, errors)

    @property
    def independent(self) -> NDArray[np.bool_]:
        """Which of the claimed poses are `INDEPENDENT` m apart, the last one among them, shape (m,)."""
        left = (self.drive.travelled[-1] - self.drive.travelled)[self.is_localized]
        marks = np.floor(left / INDEPENDENT)
        chosen: NDArray[np.bool_] = np.append(marks[:-1] != marks[1:], True) if len(marks) else np.zeros(0, dtype=bool)
        return chosen

    @property
    def first_fix(self) -> tuple[float, float]:
        """How long (s) and how far (m) the unit has searched before its first pose; infinite if it never had one."""
        if not self.is_localized.any():
            return np.inf, np.inf
        first = int(np.argmax(self.is_localized))
        return float(self.drive.times[first] - self.drive.times[0]), float(self.drive.travelled[first])

    @property
    def losses(self) -> int:
        """How often the unit lost its pose."""
        return int(((self.status[:-1] == TRACKING) & (self.status[1:] == LOST)).sum())


def localize(drive: Drive, unit: LocalizationUnit) -> Track:
    """Return what a unit says along a drive that begins without a guess."""
    state, answers = unit.start(), []
    for landmarks, X_OH, time in zip(drive.landmarks, drive.reckoned, drive.times, strict=True):
        answer, state = unit.step(state, landmarks, X_OH=X_OH, time=float(time))
        answers.append(answer)
    return Track(
        drive,
        np.array([one.pose for one in answers]),
        np.array([one.covariance for one in answers]),
        np.array([one.status for one in answers]),
    )


def simulated_drive(
    stand: Stand, *, seed: int, length: float, detector: Detector | None = None, odometry: Odometry | None = None
) -> Drive:
    """Return a drive at 1 m/s on a circle in the middle of a stand, with simulated detections.

    Args:
        stand: The stand, in which the circle has a radius of a third of its smaller extent.
        seed: Determines where the drive begins, false trunks, detections and drift.
        length: Its length in m.
        detector: How trunks are detected.
        odometry: How dead reckoning drifts.
    """
    detector, odometry = detector or Detector(), odometry or Odometry()
    rng = np.random.default_rng([seed, 8])
    wood = Wood.of(stand, false=detector.false, rng=rng)
    radius, angle = min(stand.length, stand.width) / 3.0, rng.uniform(-np.pi, np.pi)
    middle = 0.5 * np.array([stand.length, stand.width])
    begin = [*(middle + radius * np.array([np.cos(angle), np.sin(angle)])), angle + np.pi / 2.0]
    truth = arc(begin, length=length, curvature=1.0 / radius, step=1.0 / SCANS)
    return Drive(
        np.arange(len(truth)) / SCANS,
        truth,
        dead_reckoned(truth, odometry, rng),
        tuple(wood.detected(X_WH, detector, rng)[0] for X_WH in truth),
    )


@dataclass(frozen=True)
class Score:
    """What came of drives with one map.

    Attributes:
        forests: The number of drives.
        path: Their length together, in m.
        position: Root mean square error of the position in m, in the plane.
        heading: Root mean square error of the heading in rad.
        wrong: The number of scans with a wrong claim.
        nees: Mean of all NEES.
        independent_nees: Mean of the NEES at independent places.
        bounds: Its 95 % bounds.
        first_fix: Median and largest time to the first fix in s.
        localized: The share of the scans with a pose.
        losses: How often a pose was lost.
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
        """Whether the mean NEES at independent places lies within its bounds."""
        return self.bounds[0] <= self.independent_nees <= self.bounds[1]


def score(tracks: Sequence[Track], *, deviation: float) -> Score:
    """Return what came of drives.

    Args:
        tracks: One per forest.
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
        position=_rms(distances),
        heading=_rms(errors[:, 2]),
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


def _rms(values: ArrayLike) -> float:
    squares = np.square(np.asarray(values, dtype=float))
    return float(np.sqrt(squares.mean())) if squares.size else np.nan


@dataclass(frozen=True)
class Goal:
    """What is to be reached with a map.

    Attributes:
        position: Largest root mean square error of the position in m.
        heading: Largest root mean square error of the heading in rad; infinite if there is no such goal.
        is_consistent: Whether NEES must lie within its bounds.
    """

    position: float
    heading: float = np.inf
    is_consistent: bool = False

    def is_met(self, found: Score) -> bool:
        """Return whether the goal is reached, without a wrong claim."""
        return (
            found.position <= self.position
            and not found.heading > self.heading
            and (found.is_consistent or not self.is_consistent)
            and not found.wrong
        )


GOALS = {
    "accurate": Goal(0.05, np.radians(0.2), is_consistent=True),
    "remote": Goal(0.15, is_consistent=True),
    "poor": Goal(0.5),
}


def unit_of(stand: Stand, errors: MapErrors) -> LocalizationUnit:
    """Return a unit with a map of the stand that has these errors."""
    landmarks = map_landmarks(stand.map(errors))
    locator = ConstellationMap(landmarks, correlation=errors.correlation)
    return LocalizationUnit(locator, Tracker(landmarks, correlation=errors.correlation))


HEADER = ("map", "RMSE m", "deg", "NEES", "of places", "95 %", "first fix s", "localized", "lost", "wrong", "goal")


def row(name: str, found: Score) -> tuple[str, ...]:
    """Return the row of the table of one map."""
    low, high = found.bounds
    median, longest = found.first_fix
    return (
        name,
        f"{found.position:.3f}",
        f"{np.degrees(found.heading):.2f}",
        f"{found.nees:.1f}",
        f"{found.independent_nees:.2f}",
        f"{low:.2f} to {high:.2f}",
        f"{median:.1f} to {longest:.1f}",
        f"{found.localized:.1%}",
        str(found.losses),
        str(found.wrong),
        "yes" if GOALS[name].is_met(found) else "NO",
    )


def simulated(seed: int, *, length: float, range_bias: float = 0.0) -> dict[str, Track]:
    """Return what units with each of the maps say along a simulated drive."""
    stand = Stand(seed=seed, kind="clustered" if seed % 3 == 2 else "natural")
    drive = simulated_drive(stand, seed=seed, length=length, detector=Detector(range_bias=range_bias))
    return {name: localize(drive, unit_of(stand, MAPS[name])) for name in GOALS}


def main() -> None:
    """Run the drives, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--forests", type=int, default=20)
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--bias", type=float, default=0.0, help="of the ranges, in m")
    parser.add_argument("--full", action="store_true", help="500 m in each forest instead of 50 m")
    chosen = parser.parse_args()
    length = 500.0 if chosen.full else 50.0
    tracks: dict[str, list[Track]] = {name: [] for name in GOALS}
    # One thread: matrices are small, and threads that wait for each other take most of the time.
    with threadpool_limits(1):
        for k in range(chosen.forests):
            found = simulated(chosen.seed + k, length=length, range_bias=chosen.bias)
            print(
                f"forest {k + 1}: " + ", ".join(f"{n} {_rms(t.errors[:, :2]):.3f} m" for n, t in found.items()),
                flush=True,
            )
            for name, track in found.items():
                tracks[name].append(track)
    scores = {name: score(tracks[name], deviation=MAPS[name].position) for name in GOALS}
    print(table(HEADER, [row(name, found) for name, found in scores.items()]))
    one = scores["accurate"]
    print(f"{one.forests} forests, {one.path:.0f} m of path, range bias {chosen.bias:g} m")


if __name__ == "__main__":
    main()
