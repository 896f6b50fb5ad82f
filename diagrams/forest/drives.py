"""Drives through many forests: how well the localization unit knows where it is, with each of the three maps.

``python -m vtbdrake_diagrams.forest.drives [--forests N] [--bias B] [--full]`` simulates the carrier in each forest
once, with its scanner, 50 m far or 500 m, and records what its DPS detects, and its odometry. From these, one unit per
map localizes, as that of the DPS would. ``--stereo`` gives the carrier a pair of cameras instead of the scanner,
``--simulated`` takes simulated detections (`detections`), ``--plain`` drives among rocks instead of trees.

What counts, fixed before any of the forests from `SEED` on was driven:

* Errors of position and heading are those of all scans at which the unit says that it is tracking, from the first fix
  to the end, over all forests; nothing is left out.
* NEES is of 3 degrees of freedom. Its mean is compared with its 95 % bounds at places `INDEPENDENT` m of path apart,
  the last one of each drive among them: nearer ones share trees, and with them the errors of the map.
* Where there is no pose, there is no error: the share of the scans with a pose is told beside it.
* A claim is wrong if the pose is farther from the true one than 0.5 m plus four standard deviations of the map.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from multiprocessing import get_context
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree
from scipy.stats import chi2
from threadpoolctl import threadpool_limits

from vtbdrake.cli.output import table
from vtbdrake.components.localization.dead_reckoning import carrier_pose_at
from vtbdrake.components.localization.landmarks import Landmarks
from vtbdrake.components.localization.planar import wrap
from vtbdrake.components.localization.unit import LOST, TRACKING, LocalizationUnit
from vtbdrake_diagrams.forest.detections import Detector, Odometry, Wood, arc, dead_reckoned
from vtbdrake_diagrams.forest.dps import PERIOD
from vtbdrake_diagrams.forest.perception import SETTLED
from vtbdrake_diagrams.forest.scenario import CarrierScenario, ForestScenario, PlainScenario
from vtbdrake_diagrams.forest.stand import MAPS, MapErrors, Stand

Array = NDArray[np.float64]

INDEPENDENT = 100.0
"""Estimates count as independent if they are at least this far apart along the path, in m."""
REACH = 20.0
"""Trees within this distance of the path count as seen, in m; see `least_error_along`. Assumed."""
LATE = 10.0
"""From when on the errors of the vertical are told apart from those of the start, in s."""
STANDING = 2.0
"""How long the carrier stands before it drives, in s: the gyros show their bias, and the attitude settles."""
_SPEED = "sim.act.driver.speed"
_POSE = "sim.sys.carrier.base.pose"
_ARRIVAL = "dps.env.{signal}_arrival"
_HISTORY = "dps.env.dead_reckoning.history"

SCANS = 5.0
"""The number of scans per second."""
DENSITIES = (605.0, 1210.0)
"""The numbers of trees per hectare of the plots that `stand` cites, before roads are cleared."""
ABUNDANCES = (0.03, 0.1)
"""The shares of the ground that rocks cover: InSight's to twice Spirit's, see `vtbdrake_diagrams.forest.plain`."""
SOURCES = {
    "scanner": "a scanner in a forest (the default)",
    "stereo": "a pair of cameras instead of a scanner",
    "simulated": "simulated detections instead of a scanner",
    "plain": "a scanner on a plain with rocks, instead of a forest",
}
"""What units localize by, and what it is."""
SEED = 600_000
"""The seed of the first forest. No constant of the localization may be chosen by forests from this seed on.

Forests from 200,000 and from 500,000 on were driven before, and do not count any more: the duration of the errors of
the vertical was not considered in the first ones, and the noise of the sensors was the same in all.
"""


@dataclass(frozen=True, eq=False)
class Drive:
    """What a unit gets along a drive, and where it was in truth.

    Attributes:
        times: The times of the scans in s, shape (n,).
        truth: The true poses X_WH, shape (n, 3).
        reckoned: Those of the odometry, X_OH, shape (n, 3).
        landmarks: What was detected in each scan, in H; n of them.
        tilts: Errors of roll and pitch by the dead reckoning in rad, shape (n, 2); none if the drive is simulated.
    """

    times: Array
    truth: Array
    reckoned: Array
    landmarks: tuple[Landmarks, ...]
    tilts: Array = field(default_factory=lambda: np.zeros((0, 2)))

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
        status: `SEARCHING`, `TRACKING`, `LOST` or `DOUBTFUL`, shape (n,).
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
        return int(((self.status[:-1] != LOST) & (self.status[1:] == LOST)).sum())


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


def recorded_drive(scenario: CarrierScenario, *, length: float) -> Drive:
    """Simulate a carrier that stands at first, and return what its DPS detects in each sample, and its odometry.

    Args:
        scenario: The carrier in its world; its map does not matter.
        length: How far it drives, in m.

    Raises:
        RuntimeError: The carrier does not get there in twice the time that it should take.
    """
    testbed, detect = scenario.build(), scenario.detector()
    arrivals = [_ARRIVAL.format(signal=signal.name) for signal in scenario.perception_signals()]
    pose, time, history = (testbed.reader(address) for address in (_POSE, f"{arrivals[-1]}.time", _HISTORY))
    samples = [testbed.reader(f"{arrival}.sample") for arrival in arrivals]
    simulator = testbed.simulator()
    context = simulator.get_mutable_context()
    testbed.write(context, {_SPEED: 0.0})
    period = scenario.eye_period
    limit = STANDING + 2.0 * length / scenario.speed + 10.0
    rows: list[tuple[float, Array, Array, Array]] = []
    landmarks: list[Landmarks] = []
    travelled = 0.0
    while travelled < length:
        due = (len(rows) + 1) * period
        if due > limit:
            raise RuntimeError(f"the carrier has driven {travelled:.1f} m of {length:g} m in {limit:.0f} s")
        # Just before the plant steps to its next state: due may be later than that by a rounding error.
        simulator.AdvanceTo(due - 1e-9)
        if due > STANDING:
            testbed.write(context, {_SPEED: scenario.speed})
        x, y, _, roll, pitch, yaw = pose(context)
        # By then the sample has arrived, and its time lies within the history.
        simulator.AdvanceTo(due + 2.0 * PERIOD)
        taken, past = float(time(context)), history(context)
        _, *tilt, x_O, y_O, heading = carrier_pose_at(past, taken)
        rows.append((taken, np.array([x, y, yaw]), np.array([x_O, y_O, heading]), tilt - np.array([roll, pitch])))
        seen = [sample(context) for sample in samples]
        landmarks.append(detect(*seen, past, taken) if taken >= SETTLED else Landmarks.empty())
        if len(rows) > 1:
            travelled += float(np.hypot(*(rows[-1][1] - rows[-2][1])[:2]))
    times, truths, reckoned, tilts = (np.array(column) for column in zip(*rows, strict=True))
    return Drive(times, truths, reckoned, tuple(landmarks), tilts)


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


def least_error(errors: MapErrors, places: Array, *, noise: float = 0.02) -> float:
    """Return the least RMS error in m, in the plane, of an unbiased estimate of the position by trees on a map.

    It is that of an estimate that knows the heading, and where the trees are around it, up to independent errors. What
    the errors of the map have in common shows only in how they vary from place to place: with the covariances
    C_ij = s^2 exp(-r_ij^2 / (2 L^2)) + noise^2 delta_ij per axis, where s is the standard deviation of the map, the
    best linear estimate (Gauss and Markov) has the error sqrt(2 / (1' C^-1 1)).

    Args:
        errors: Those of the map.
        places: Where the trees are in m, shape (n, 2).
        noise: Standard deviation in m, per axis, by which it is known where each tree is around the carrier [assumed].
    """
    squares = ((places[:, np.newaxis] - places) ** 2).sum(axis=2)
    shared = np.exp(-0.5 * squares / errors.correlation**2) if errors.correlation > 0.0 else np.eye(len(places))
    C = errors.position**2 * shared + noise**2 * np.eye(len(places))
    return float(np.sqrt(2.0 / np.linalg.solve(C, np.ones(len(places))).sum()))


def least_error_along(
    drives: Mapping[int, Drive], errors: MapErrors, *, scenario: Callable[[int], CarrierScenario] | None = None
) -> float:
    """Return the RMS of `least_error` over drives, by the landmarks within `REACH` of each; no map lacks any of them.

    Args:
        drives: By the seed of the scenario.
        errors: Those of the map.
        scenario: Returns the scenario of a seed; by default that of `forest`.
    """
    least = []
    for seed, drive in drives.items():
        places = (scenario or forest)(seed).truth().positions()[:, :2]
        near = cKDTree(drive.truth[:, :2]).query(places)[0] < REACH
        least.append(least_error(errors, places[near]))
    return _rms(least)


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


def forest(seed: int, *, range_bias: float = 0.0, perception: str = "scanner") -> ForestScenario:
    """Return the scenario of a drive: a stand as dense as published plots, every third one clustered.

    Args:
        seed: Determines stand, route, where on it the drive begins, and the noise of all sensors.
        range_bias: Of the scanner, in m.
        perception: ``scanner`` or ``stereo``.
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
        length: Of each, in m.
        range_bias: Of the scanner, in m.
        source: What the unit localizes by, one of `SOURCES`.
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
        """Return what units with each of the maps say in the scenario of a seed."""
        scenario = self.scenario(seed)
        # One thread: matrices are small, and threads that wait for each other take most of the time.
        with threadpool_limits(1):
            if self.source == "simulated":
                detector = Detector(range_bias=self.range_bias)
                drive = simulated_drive(forest(seed).stand(), seed=seed, length=self.length, detector=detector)
            else:
                drive = recorded_drive(scenario, length=self.length)
            surveys = {name: replace(scenario, map=name) for name in GOALS}
            return {name: localize(drive, one.unit(one.global_map())) for name, one in surveys.items()}

    def through(self, seeds: Sequence[int], *, workers: int = 2) -> Iterator[dict[str, Track]]:
        """Drive through the forests of some seeds in processes, and yield the tracks by map in the order of seeds."""
        with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
            yield from pool.map(self, seeds)


def scores(found: Sequence[Mapping[str, Track]]) -> dict[str, Score]:
    """Return the scores by map of the tracks by map, one per forest."""
    return {name: score([tracks[name] for tracks in found], deviation=MAPS[name].position) for name in GOALS}


def main() -> None:
    """Run the drives, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--forests", type=int, default=20)
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--bias", type=float, default=0.0, help="of the scanner's ranges, in m")
    parser.add_argument("--full", action="store_true", help="500 m in each forest instead of 50 m")
    parser.set_defaults(source="scanner")
    source = parser.add_mutually_exclusive_group()
    for name, told in SOURCES.items():
        source.add_argument(f"--{name}", dest="source", action="store_const", const=name, help=told)
    parser.add_argument("--workers", type=int, default=2)
    chosen = parser.parse_args()
    if chosen.source == "stereo" and chosen.bias:
        parser.error("--bias is one of the scanner's ranges: leave it out with --stereo")
    drives = Drives(500.0 if chosen.full else 50.0, chosen.bias, chosen.source)
    found, seeds = [], range(chosen.seed, chosen.seed + chosen.forests)
    for tracks in drives.through(seeds, workers=chosen.workers):
        found.append(tracks)
        told = ", ".join(f"{name} {score([one], deviation=0.0).position:.3f} m" for name, one in tracks.items())
        print(f"drive {len(found)}: {told}", flush=True)
    results = scores(found)
    print(table(HEADER, [row(name, one) for name, one in results.items()]))
    path = next(iter(results.values())).path
    print(f"{len(found)} drives, {path:.0f} m of path, range bias {chosen.bias:g} m")
    driven = {seed: one["poor"].drive for seed, one in zip(seeds, found, strict=True)}
    tilts = 1e3 * np.concatenate([drive.tilts for drive in driven.values()])
    if len(tilts):
        late = np.concatenate([drive.times for drive in driven.values()]) > LATE
        for when, rows in (("", slice(None)), (f", later than {LATE:g} s after the start", late)):
            roll, pitch = (_rms(errors) for errors in tilts[rows].T)
            print(f"the vertical is off by {roll:.2f} mrad in roll and {pitch:.2f} mrad in pitch (RMS){when}")
    least = least_error_along(driven, MAPS["poor"], scenario=drives.scenario)
    print(f"least error of an unbiased estimate on a poor map, by all landmarks within {REACH:g} m: {least:.2f} m")


if __name__ == "__main__":
    # Under its own name, so that worker processes find its classes.
    from vtbdrake_diagrams.forest.drives import main as program

    program()
