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
from dataclasses import dataclass, field, replace
from typing import Any, Self, TypeVar

import click
import numpy as np
from numpy.typing import NDArray
from pydrake.systems.framework import Context
from scipy.linalg import solve_triangular
from scipy.stats import chi2
from threadpoolctl import threadpool_limits

from vtbdrake.cli.output import table
from vtbdrake.common.arrays import Array, rms
from vtbdrake.components.localization.dead_reckoning import carrier_pose_at
from vtbdrake.components.localization.planar import wrap
from vtbdrake.components.localization.unit import LOST, TRACKING, Localization, LocalizationUnit, UnitState, Views
from vtbdrake.testbed import VirtualTestbed
from vtbdrake_diagrams.forest.dps import PERIOD
from vtbdrake_diagrams.forest.perception import LandmarkSensor
from vtbdrake_diagrams.forest.scenario import CarrierScenario, ForestScenario
from vtbdrake_diagrams.forest.studies.detections import Detector, Odometry, Wood, arc, dead_reckoned
from vtbdrake_diagrams.forest.world.stand import MAPS, MapErrors, Stand
from vtbdrake_diagrams.plain.scenario import PlainScenario
from vtbdrake_diagrams.processes import in_processes

INDEPENDENT = 100.0
"""Estimates count as independent if they are at least this far apart along the path, in m."""
REACH = 20.0
"""Trees within this distance of the path count as seen, in m; see `best_estimates`. Assumed."""
LATE = 10.0
"""The time in s after which errors of the vertical do not belong to the start any more."""
NOISE = 0.02
"""Standard deviation in m, per axis, of a tree's position relative to the carrier; see `best_estimates`. Assumed."""
_DRAWS = 4000  # of forests, for an interval
STANDING = 2.0
"""The time in s for which the carrier stands before it drives: the gyros show their bias, and the attitude settles."""
_SPEED = "sim.act.driver.speed"
_POSE = "sim.sys.carrier.base.pose"
_ARRIVAL = "dps.env.{signal}_arrival"
_HISTORY = "dps.env.dead_reckoning.history"

SCANS = 5.0
"""The number of scans per second."""
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


@dataclass(frozen=True, eq=False)
class Drive:
    """The inputs of a unit along a drive, and the true poses.

    Attributes:
        times: The times of the scans in s, shape (n,).
        truth: The true poses X_WH, shape (n, 3).
        reckoned: The poses X_OH by dead reckoning, shape (n, 3).
        landmarks: The detections of each scan, in H, or what several sensors see at that time; n of them.
        tilts: Errors of roll and pitch by the dead reckoning in rad, shape (n, 2); (0, 2) for a simulated drive.
    """

    times: Array
    truth: Array
    reckoned: Array
    landmarks: tuple[Views, ...]
    tilts: Array = field(default_factory=lambda: np.zeros((0, 2)))

    @property
    def travelled(self) -> Array:
        """The distance travelled at each scan, in m, shape (n,)."""
        return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(self.truth[:, :2], axis=0).T))])


@dataclass(frozen=True, eq=False)
class Track:
    """The answers of a unit along a drive.

    Attributes:
        drive: The drive.
        poses: The poses X_WH, shape (n, 3); NaN without a pose.
        covariances: The covariances of the poses, shape (n, 3, 3).
        status: `SEARCHING`, `TRACKING`, `LOST` or `DOUBTFUL`, shape (n,).
    """

    drive: Drive
    poses: Array
    covariances: Array
    status: NDArray[np.int_]

    @property
    def is_localized(self) -> NDArray[np.bool_]:
        """Return whether the unit claims a pose, shape (n,)."""
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
        is_independent: NDArray[np.bool_] = (
            np.append(marks[:-1] != marks[1:], True) if len(marks) else np.zeros(0, dtype=bool)
        )
        return is_independent

    @property
    def first_fix(self) -> tuple[float, float]:
        """The time (s) and the distance travelled (m) until the first pose; infinite if there was none."""
        if not self.is_localized.any():
            return np.inf, np.inf
        first = int(np.argmax(self.is_localized))
        return float(self.drive.times[first] - self.drive.times[0]), float(self.drive.travelled[first])

    @property
    def losses(self) -> int:
        """The number of times that the unit lost its pose."""
        return int(((self.status[:-1] != LOST) & (self.status[1:] == LOST)).sum())


def memories(drive: Drive, unit: LocalizationUnit) -> Iterator[UnitState]:
    """Yield the memory of a unit after each scan of a drive that begins without a guess."""
    state = unit.start()
    for landmarks, X_OH, time in zip(drive.landmarks, drive.reckoned, drive.times, strict=True):
        _, state = unit.step(state, landmarks, X_OH=X_OH, time=float(time))
        yield state


def localize(drive: Drive, unit: LocalizationUnit) -> Track:
    """Return the answers of a unit along a drive that begins without a guess."""
    return track_of(drive, [state.answer for state in memories(drive, unit)])


def track_of(drive: Drive, answers: Sequence[Localization]) -> Track:
    """Return the answers to the scans of a drive, one each, as arrays."""
    return Track(
        drive,
        np.array([answer.pose for answer in answers]),
        np.array([answer.covariance for answer in answers]),
        np.array([answer.status for answer in answers]),
    )


def simulated_drive(
    stand: Stand,
    *,
    seed: int,
    length: float,
    detector: Detector | None = None,
    odometry: Odometry | None = None,
    scans: float = SCANS,
) -> Drive:
    """Return a drive at 1 m/s on a circle in the middle of a stand, with simulated detections.

    Args:
        stand: The stand, in which the circle has a radius of a third of its smaller extent.
        seed: Determines the start of the drive, false trunks, detections and drift.
        length: The length of the drive in m.
        detector: The performance of the detector; by default `Detector`.
        odometry: The drift of the dead reckoning; by default `Odometry`.
        scans: The number of scans per second.
    """
    detector, odometry = detector or Detector(), odometry or Odometry()
    rng = np.random.default_rng([seed, 8])
    wood = Wood.of(stand, false=detector.false, rng=rng)
    radius, angle = min(stand.length, stand.width) / 3.0, rng.uniform(-np.pi, np.pi)
    middle = 0.5 * np.array([stand.length, stand.width])
    begin = [*(middle + radius * np.array([np.cos(angle), np.sin(angle)])), angle + np.pi / 2.0]
    truth = arc(begin, length=length, curvature=1.0 / radius, step=1.0 / scans)
    return Drive(
        np.arange(len(truth)) / scans,
        truth,
        dead_reckoned(truth, odometry, rng),
        tuple(wood.detected(X_WH, detector, rng)[0] for X_WH in truth),
    )


def recorded_drive(scenario: CarrierScenario, *, length: float, detectors: Sequence[LandmarkSensor] = ()) -> Drive:
    """Simulate a carrier that stands at first, and return what its DPS detects in each sample, and its odometry.

    Args:
        scenario: The carrier in its world; its map does not matter.
        length: The length of the drive in m.
        detectors: What detects landmarks in the scans instead of the unit's sensors, each in a view of its own.

    Raises:
        RuntimeError: The drive takes more than twice the time that it should.
    """
    testbed = scenario.build()
    pose, history = (testbed.reader(address) for address in (_POSE, _HISTORY))
    sensors = [_SensorReader.of(testbed, sensor) for sensor in detectors or scenario.sensors()]
    periods = scenario.perception_periods[:1] * len(detectors) if detectors else scenario.perception_periods
    simulator = testbed.simulator()
    context = simulator.get_mutable_context()
    testbed.write(context, {_SPEED: 0.0})
    limit = STANDING + 2.0 * length / scenario.speed + 10.0
    rows: list[tuple[float, Array, Array, Array]] = []
    views: list[Views] = []
    travelled = 0.0
    for due, shown in _due(periods):
        if travelled >= length:
            break
        if due > limit:
            raise RuntimeError(f"the carrier has driven {travelled:.1f} m of {length:g} m in {limit:.0f} s")
        # Just before the plant steps to its next state: due may be later than that by a rounding error.
        simulator.AdvanceTo(due - 1e-9)
        if due > STANDING:
            testbed.write(context, {_SPEED: scenario.speed})
        x, y, _, roll, pitch, yaw = pose(context)
        # By then the sample has arrived, and its time lies within the history.
        simulator.AdvanceTo(due + 2.0 * PERIOD)
        past, samples = history(context), [(sensors[k].sensor, sensors[k](context)) for k in shown]
        sensor, inputs = samples[0]
        taken = sensor.times(inputs)[-1]
        reckoned_pose = carrier_pose_at(past, taken)
        X_OH = np.array([reckoned_pose.x, reckoned_pose.y, reckoned_pose.heading])
        tilt = np.array([reckoned_pose.roll - roll, reckoned_pose.pitch - pitch])
        rows.append((taken, np.array([x, y, yaw]), X_OH, tilt))
        views.append([sensor.view(inputs, past) for sensor, inputs in samples])
        if len(rows) > 1:
            travelled += float(np.hypot(*(rows[-1][1] - rows[-2][1])[:2]))
    times, truths, reckoned, tilts = (np.array(column) for column in zip(*rows, strict=True))
    return Drive(times, truths, reckoned, tuple(views), tilts)


@dataclass(frozen=True)
class _SensorReader:
    """The reading of what a sensor of the unit shows to the DPS.

    Attributes:
        sensor: The sensor.
        inputs: The functions that read samples and their times, by the names of the inputs of a `Localizer`.
    """

    sensor: LandmarkSensor
    inputs: Mapping[str, Callable[[Context], Any]]

    @classmethod
    def of(cls, testbed: VirtualTestbed, sensor: LandmarkSensor) -> Self:
        arrivals = {name: _ARRIVAL.format(signal=name) for name in sensor.signals}
        samples = {name: testbed.reader(f"{arrival}.sample") for name, arrival in arrivals.items()}
        times = {f"{name}_time": testbed.reader(f"{arrival}.time") for name, arrival in arrivals.items()}
        return cls(sensor, samples | times)

    def __call__(self, context: Context) -> dict[str, Any]:
        return {name: read(context) for name, read in self.inputs.items()}


def _due(periods: Sequence[float]) -> Iterator[tuple[float, list[int]]]:
    """Yield the times at which sensors with these periods have new samples, and the numbers of these sensors."""
    counts = np.ones(len(periods))
    while True:
        times = counts * periods
        shown = np.flatnonzero(times < times.min() + 1e-6)
        yield float(times.min()), shown.tolist()
        counts[shown] += 1.0


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


def best_estimates(
    path: Array, places: Array, displacements: Array, errors: MapErrors, *, noise: float = NOISE
) -> tuple[Array, Array]:
    """Return errors of the best unbiased estimate of the position along a path, and their variances.

    At each point of the path, this estimate (of Gauss and Markov) has seen every tree within `REACH` of the path up to
    there, and knows its position relative to the carrier to ``noise`` per axis. The heading is unknown. The map says
    where the trees are, with the covariances C_ij = s^2 exp(-r_ij^2 / (2 L^2)) + noise^2 delta_ij per axis: what the
    errors of all trees have in common can be inferred only from how they vary from place to place. An error [t; theta]
    of the pose displaces the tree at d from the carrier by t + theta J d, where J is the rotation by a right angle. So

        [t; theta] = (X' C^-1 X)^-1 X' C^-1 e,    X = [I, J d] for each tree,    covariance (X' C^-1 X)^-1.

    Args:
        path: The points in m, shape (m, 2).
        places: The true positions of the trees that are on the map in m, shape (n, 2).
        displacements: Their errors e on the map in m, shape (n, 2).
        errors: The errors of the map.
        noise: Standard deviation of the relative position of a tree, per axis, in m.

    Returns:
        The errors t in m, shape (m, 2), and their variances (of both axes together) in m^2, shape (m,). NaN where fewer
        than two trees have been seen.
    """
    is_near = np.hypot(*(places[:, np.newaxis] - path).transpose(2, 0, 1)) < REACH
    first = np.where(is_near.any(axis=1), is_near.argmax(axis=1), len(path))
    order = np.argsort(first, kind="stable")[: np.count_nonzero(first < len(path))]
    p, e = places[order], displacements[order]
    squares = ((p[:, np.newaxis] - p) ** 2).sum(axis=2)
    shared = np.exp(-0.5 * squares / errors.correlation**2) if errors.correlation > 0.0 else np.eye(len(p))
    # With the trees in the order in which they are seen, those that were seen first are a leading block of C = L L'.
    L = np.linalg.cholesky(errors.position**2 * shared + noise**2 * np.eye(len(p)))
    Y = solve_triangular(L, np.column_stack([np.ones(len(p)), p, e]), lower=True)
    sums = np.cumsum(Y[:, :, np.newaxis] * Y[:, np.newaxis, :], axis=0)
    count = np.searchsorted(first[order], np.arange(len(path)), side="right")
    is_seen = count >= 2
    # Sums over pairs of trees, weighted by C^-1: of 1, x and y (from the carrier), and of their products with e.
    G = np.empty((is_seen.sum(), 5, 5))
    G[:] = sums[count[is_seen] - 1]
    T = np.tile(np.eye(5), (len(G), 1, 1))
    T[:, 1:3, 0] = -path[is_seen]
    G = T @ G @ T.transpose(0, 2, 1)
    zero = np.zeros(len(G))
    A = np.array(
        [
            [G[:, 0, 0], zero, -G[:, 0, 2]],
            [zero, G[:, 0, 0], G[:, 0, 1]],
            [-G[:, 0, 2], G[:, 0, 1], G[:, 1, 1] + G[:, 2, 2]],
        ]
    ).transpose(2, 0, 1)
    b = np.array([G[:, 0, 3], G[:, 0, 4], G[:, 1, 4] - G[:, 2, 3]]).T
    covariance = np.linalg.inv(A)
    estimates, variances = np.full((len(path), 2), np.nan), np.full(len(path), np.nan)
    estimates[is_seen] = (covariance @ b[:, :, np.newaxis])[:, :2, 0]
    variances[is_seen] = covariance[:, 0, 0] + covariance[:, 1, 1]
    return estimates, variances


@dataclass(frozen=True)
class BestError:
    """The errors of a unit beside the errors of the best estimate, `best_estimates`, at the same scans.

    Attributes:
        least: RMS error of the best estimate over all maps of this kind, in m.
        on_maps: RMS error of the best estimate on the very maps of the drives, in m. It differs from ``least`` if the
            maps are few.
        ratio: RMS error of the unit over ``on_maps``.
        interval: The interval of ``ratio`` with 95 % confidence, by drawing the forests again (bootstrap).
    """

    least: float
    on_maps: float
    ratio: float
    interval: tuple[float, float]


def against_best(
    tracks: Mapping[int, Track], name: str, *, scenario: Callable[[int], CarrierScenario] | None = None
) -> BestError:
    """Compare the errors of a unit with the errors of the best estimate on the same maps.

    Args:
        tracks: The tracks by the seed of their scenario.
        name: The name of the map in `MAPS`.
        scenario: The function that returns the scenario of a seed; by default `forest`.
    """
    errors, sums, count = MAPS[name], [], 0
    for seed, track in tracks.items():
        survey = (scenario or forest)(seed).surveyed_map
        # Without errors of the positions, the same survey has the same entries in the same order.
        mapped, places = (
            survey(survey_errors).positions()[:, :2] for survey_errors in (errors, replace(errors, position=0.0))
        )
        # A wrong entry is displaced from nothing.
        is_true = (mapped != places).any(axis=1)
        path = track.drive.truth[:, :2]
        best, variances = best_estimates(path, places[is_true], (mapped - places)[is_true], errors)
        both = track.is_localized & np.isfinite(variances)
        units = (track.poses[:, :2] - path)[both]
        sums.append([(units**2).sum(), (best[both] ** 2).sum(), variances[both].sum()])
        count += int(both.sum())
    unit, on_maps, least = (totals := np.array(sums)).sum(axis=0)
    drawn = totals[np.random.default_rng(0).integers(len(totals), size=(_DRAWS, len(totals)))].sum(axis=1)
    low, high = np.sqrt(np.quantile(drawn[:, 0] / drawn[:, 1], [0.025, 0.975])).tolist()
    return BestError(
        float(np.sqrt(least / count)), float(np.sqrt(on_maps / count)), float(np.sqrt(unit / on_maps)), (low, high)
    )


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
