"""The real drive in Victoria Park: a map from its first half, localization without a guess in the second.

``python -m vtbdrake_diagrams.park.reality FOLDER`` prints it, and ``--plot FILE`` draws it. FOLDER holds inputs.dat
(speed, steering), measurements.dat (trees that another detector has found) and gps.dat, as in the repository
kykleung/RFS-SLAM. (Guivant and Nebot, "Optimization of the simultaneous localization and map-building algorithm for
real-time implementation", IEEE Transactions on Robotics and Automation 17, 2001.)

Positions by satellites of the first half calibrate the odometry, and tell where the map lies. Trees and wheels of that
half calibrate the direction of the scanner. Positions of the second half judge, and do nothing else.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import click
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial import cKDTree

import vtbdrake as vtb
from vtbdrake.common.arrays import Array
from vtbdrake.components.estimation import squared_distances
from vtbdrake.components.localization.dead_reckoning import SteeringDriftModel
from vtbdrake.components.localization.landmarks import Landmarks
from vtbdrake.components.localization.planar import compose, inverse, rotation, rotations, transform, wrap
from vtbdrake.components.localization.range_bearing import range_bearing_landmarks
from vtbdrake.components.localization.steering import SteeringConfig, bicycle_motion
from vtbdrake.components.localization.unit import TRACKING
from vtbdrake.components.world_model import LocalFrame, save_geojson
from vtbdrake.control import Guards, Zero
from vtbdrake.control.clock import Clock, ScaledClock, SimulatedClock
from vtbdrake.recording import Log, LogBridge, Series
from vtbdrake.recording.replay import ReplayReport
from vtbdrake_diagrams.park.scenario import PERIOD, ROWS, ParkScenario
from vtbdrake_diagrams.park.survey import Survey, SurveyConfig, survey
from vtbdrake_diagrams.park.world import tree_model

# Where Victoria Park lies: the positions of the recording have no origin, and their axes are the map's.
_FRAME = LocalFrame(151.192, -33.886)
# Duration of a window of the odometry's calibration, in s.
_WINDOW = 25.0
# Least distance driven in a window, in m.
_LEAST_WAY = 10.0
# A position by satellites is compared with others within this time, in s.
_NEAR_IN_TIME = 4.0
# It jumps if its distance from them differs from the distance driven by more than this, in m.
_JUMP = 1.0
# A claim is wrong if it is off by more than this distance, in m.
_WRONG = 3.0
# A claim is wrong if it is off by more than this number of its own standard deviations, too.
_DEVIATIONS = 3.0
# Trees of two maps within this distance are the same, in m.
_SAME_TREE = 1.5
# A detection within this distance of a tree shows it, in m.
_MATCHES = 0.6
# The wheels and the survey are compared over this number of scans, about a second.
_SCANS_AHEAD = 5
# A survey whose motion differs more than this from the wheels' jumps, in m.
_SURVEY_JUMP = 0.5
# Standard deviation of the error of the calibrated steering's scale, from curve to curve: 0.045 in the turns of the
# first half (`turn_errors` in `park/few_landmarks.py`).
_STEERING_DEVIATION = 0.05
# The time in s after which a scan is answered: before the next one.
_ANSWERED = 0.2


@dataclass(frozen=True, eq=False)
class Drive:
    """A recorded drive.

    Attributes:
        log: The sensor signals ``odometry`` and ``trees`` of a `ParkScenario`.
        positions: Rows of [time (s), x (m), y (m)] by satellites, (n, 3).
    """

    log: Log
    positions: Array

    def between(self, start: float, end: float) -> Drive:
        """Return the part from ``start`` to below ``end``, in s."""
        is_inside = (self.positions[:, 0] >= start) & (self.positions[:, 0] < end)
        return Drive(self.log.between(start, end), self.positions[is_inside])

    @property
    def steady_positions(self) -> Array:
        """The positions without those that jump against the wheels, (m, 3): no estimate of ours is in this choice."""
        t, v = self.log.sense["odometry"].times, self.log.sense["odometry"].values[:, 0]
        driven = np.interp(self.positions[:, 0], t, np.cumsum(v) * PERIOD)
        jumps = []
        for time, x, y, way in np.column_stack([self.positions, driven]):
            near = abs(self.positions[:, 0] - time) < _NEAR_IN_TIME
            gaps = np.hypot(*(self.positions[near, 1:] - [x, y]).T)
            # The chord of a bend is shorter than the way.
            ways = abs(driven[near] - way)
            jumps.append(np.median(np.maximum(gaps - ways, 0.0)) > _JUMP)
        return self.positions[~np.array(jumps, dtype=bool)]


def victoria_park(folder: Path) -> Drive:
    """Return the drive in a folder; bearings are turned so that 0 is ahead and left is positive."""
    inputs = vtb.read_table(folder / "inputs.dat", sense={"odometry": ["1", "2"]}, time="0")
    detections = np.loadtxt(folder / "measurements.dat")
    times, first = np.unique(detections[:, 0], return_index=True)
    rows = np.zeros((len(times), ROWS, 3))
    for row, scan in zip(rows, np.split(detections, first[1:]), strict=True):
        row[: len(scan)] = (scan[:, 1:] - [0.0, 0.5 * np.pi, 0.0])[:ROWS]
    trees = Series(times, rows.reshape(len(times), -1))
    log = Log(str(folder), {**inputs.sense, "trees": trees}, {}, inputs.remarks)
    return Drive(log, np.loadtxt(folder / "gps.dat"))


def reckoned(odometry: Series, car: SteeringConfig, times: Array) -> Array:
    """Return the poses X_OH by dead reckoning at some times, (n, 3), with a heading that is not wrapped."""
    t, (speed, steering) = odometry.times, odometry.values.T
    motions = np.column_stack(
        bicycle_motion(
            car.speed_scale * speed,
            car.steering_scale * steering + car.steering_offset,
            wheel_base=car.wheel_base,
            wheel_offset=car.wheel_offset,
        )
    )
    v, rate = (0.5 * (motions[1:] + motions[:-1]) * np.diff(t)[:, None]).T
    heading = np.concatenate([[0.0], np.cumsum(rate)])
    middle = heading[:-1] + 0.5 * rate
    path = np.cumsum(np.vstack([[0.0, 0.0], np.column_stack([v * np.cos(middle), v * np.sin(middle)])]), axis=0)
    return np.column_stack([np.interp(times, t, column) for column in (*path.T, heading)])


def calibrated(drive: Drive, car: SteeringConfig) -> tuple[SteeringConfig, Array]:
    """Return the car whose dead reckoning fits the positions best, and the antenna in H, (2,) in m.

    In windows of 25 s, the path is laid onto the positions: only its shape counts.

    Args:
        drive: The drive.
        car: The geometry, and the start.
    """
    starts = np.arange(drive.positions[0, 0], drive.positions[-1, 0], _WINDOW)
    windows = [drive.positions[abs(drive.positions[:, 0] - start - 0.5 * _WINDOW) < 0.5 * _WINDOW] for start in starts]
    windows = [rows for rows in windows if len(rows) >= 30 and np.ptp(rows[:, 1:], axis=0).max() > _LEAST_WAY]

    def residuals(p: Array) -> Array:
        parts = []
        model = replace(car, speed_scale=float(p[0]), steering_scale=float(p[1]), steering_offset=float(p[2]))
        for rows in windows:
            poses = reckoned(drive.log.sense["odometry"], model, rows[:, 0])
            path = poses[:, :2] + rotations(poses[:, 2]) @ p[3:]
            X = laid_onto(path, rows[:, 1:])
            parts.append(transform(X, path) - rows[:, 1:])
        return np.concatenate(parts).ravel() / 0.3

    start = [car.speed_scale, car.steering_scale, car.steering_offset, 0.0, 0.0]
    p = least_squares(residuals, start, loss="cauchy").x
    return replace(car, speed_scale=float(p[0]), steering_scale=float(p[1]), steering_offset=float(p[2])), p[3:]


def laid_onto(points: Array, targets: Array) -> Array:
    """Return the pose (3,) that moves points (n, 2) onto targets (n, 2) with the least squares."""
    a, b = points - points.mean(axis=0), targets - targets.mean(axis=0)
    turn = float(np.arctan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a * b).sum()))
    return np.array([*(targets.mean(axis=0) - rotation(turn) @ points.mean(axis=0)), turn])


def slide(mapped: Survey, odometry: Array) -> float:
    """Return how far left of its heading by the survey the car moves, in rad: so far right the scanner is turned.

    Wheels that do not slip roll along the heading; where the odometry's origin is off the axle, it slides in turns.

    Args:
        mapped: The survey.
        odometry: The poses by dead reckoning at the times of the survey, (n, 3).
    """
    moved, expected = (
        np.array([compose(inverse(a), b) for a, b in zip(path, path[_SCANS_AHEAD:], strict=False)])
        for path in (mapped.poses, odometry)
    )
    off = moved[:, :2] - expected[:, :2]
    # Where the survey jumps, it is wrong.
    is_usual = np.hypot(*off.T) < _SURVEY_JUMP
    terms = np.column_stack([expected[:, 0], wrap(moved[:, 2])])
    return float(np.linalg.lstsq(terms[is_usual], off[is_usual, 1], rcond=None)[0][0])


def surveyed(drive: Drive, scenario: ParkScenario, config: SurveyConfig) -> Survey:
    """Return the survey of a drive, see `vtbdrake_diagrams.park.survey`."""
    trees = drive.log.sense["trees"]
    poses = reckoned(drive.log.sense["odometry"], scenario.car, trees.times)
    scans = [range_bearing_landmarks(row, scenario.detector) for row in trees.values]
    return survey(trees.times, poses, scans, drive.positions, drift=SteeringDriftModel(), config=config)


@dataclass(frozen=True, eq=False)
class Localized:
    """The claims of the car along a drive, cycle by cycle.

    Attributes:
        times: The times of the drive in s, (n,).
        poses: The claimed poses X_WH, (n, 3); NaN without one.
        covariances: Their covariances, (n, 3, 3).
        confirmed: Whether the localizer's last scan was fused, (n,).
    """

    times: Array
    poses: Array
    covariances: Array
    confirmed: NDArray[np.bool_]

    @property
    def has_pose(self) -> NDArray[np.bool_]:
        """Return whether there is a pose, (n,)."""
        return np.isfinite(self.poses[:, 0])

    def at(self, times: Array) -> Localized:
        """Return the claims at some times, (m,): the last ones before."""
        rows = np.maximum(np.searchsorted(self.times, times, side="right") - 1, 0)
        return Localized(times, self.poses[rows], self.covariances[rows], self.confirmed[rows])


def localized(
    drive: Drive, scenario: ParkScenario, path: Path, *, clock: Clock | None = None
) -> tuple[Localized, ReplayReport]:
    """Feed a drive to the DPS through its ports, in its own time, record that, and replay the record.

    Args:
        drive: The drive.
        scenario: The scenario, whose ``map_file`` is the map.
        path: The file of the record.
        clock: The clock of the loop; by default one that waits for nothing but the localizer.
    """
    clock = clock or SimulatedClock()
    dps = vtb.DpsAlone(scenario)
    bridge = LogBridge(drive.log, dps.interface, clock)
    bridge.open()
    # After a fault there is no claim.
    guards = Guards(dps.interface, PERIOD, fallback={"claim": Zero()})
    with (
        vtb.Runtime(dps, bridge, period=PERIOD, clock=clock, guards=guards, continuity={"claim": None}) as runtime,
        vtb.Recorder(runtime, path),
    ):
        runtime.slow_parts.wait_until_ready()
        runtime.take_over()
        runtime.run(until=lambda: runtime.slow_parts.wait(60.0) and bridge.finished)
    names = ("position", "heading", "covariance", "status")
    addresses = [*(f"dps.env.pose.{name}" for name in names), "dps.env.localizer.matched"]
    report = vtb.replay(path, record=addresses)
    position, heading, covariance, status, matched = (np.asarray(report.record[address]) for address in addresses)
    is_tracking = np.ravel(status) == TRACKING
    poses = np.where(is_tracking[:, None], np.column_stack([position, np.ravel(heading)]), np.nan)
    confirmed = is_tracking & (np.ravel(matched) > 0.0)
    return Localized(drive.log.start + report.times, poses, covariance.reshape(-1, 3, 3), confirmed), report


@dataclass(frozen=True)
class Judgement:
    """The distances of claims from something that did not make them.

    Attributes:
        count: The number of claims that were compared.
        rms: Root mean square of the distance in m; all others likewise.
        median: Its median.
        most: Its 99 % quantile.
        nees: Mean of the normalized squared error, over its degrees of freedom: 1 is expected.
        wrong: The number of claims that are off by more than 3 m and 3 claimed deviations.
    """

    count: int
    rms: float
    median: float
    most: float
    nees: float
    wrong: int

    @classmethod
    def of(cls, errors: Array, covariances: Array, *, noise: float = 0.0) -> Judgement:
        """Return the judgement of errors (n, 2 or 3) with claimed covariances, beside noise (m) of the judge."""
        k = errors.shape[1]
        C = covariances[:, :k, :k] + noise**2 * np.diag([1.0, 1.0, 0.0][:k])
        distance = np.hypot(errors[:, 0], errors[:, 1])
        deviation = np.sqrt(np.trace(C[:, :2, :2], axis1=1, axis2=2))
        squares = squared_distances(errors, C)
        return cls(
            len(errors),
            float(np.sqrt(np.mean(distance**2))),
            float(np.median(distance)),
            float(np.quantile(distance, 0.99)),
            float(squares.mean() / k),
            int(((distance > _WRONG) & (distance > _DEVIATIONS * deviation)).sum()),
        )

    def __str__(self) -> str:
        return (
            f"{self.count:6} claims: RMS {self.rms:.2f} m, median {self.median:.2f}, 99 % within {self.most:.2f}; "
            f"NEES {self.nees:.2f}; wrong {self.wrong}"
        )


def judged_by_positions(claims: Localized, positions: Array, antenna: Array, *, noise: float) -> Judgement:
    """Compare claims with positions of the antenna by satellites, (m, 3), whose noise in m the survey tells."""
    at = claims.at(positions[:, 0])
    has = at.has_pose
    errors = at.poses[has, :2] + rotations(at.poses[has, 2]) @ antenna - positions[has, 1:]
    return Judgement.of(errors, _antenna_covariances(at, has, antenna), noise=noise)


def _antenna_covariances(claims: Localized, rows: NDArray[np.bool_], antenna: Array) -> Array:
    arm = rotations(claims.poses[rows, 2]) @ antenna
    J = np.tile(np.eye(2, 3), (len(arm), 1, 1))
    J[:, :, 2] = arm[:, ::-1] * [-1.0, 1.0]
    covariances: Array = J @ claims.covariances[rows] @ J.transpose(0, 2, 1)
    return covariances


def reference(whole: Survey, mapped: Landmarks) -> tuple[Localized, Array]:
    """Return the poses that all data of a whole drive give together, afterwards, and where their map lies, (3,).

    Claims are relative to the map of a part of the drive: the trees of the whole drive are laid onto it.

    Args:
        whole: The survey of the whole drive.
        mapped: The map.
    """
    gaps, rows = cKDTree(whole.trees.positions).query(mapped.positions)
    near = gaps < _SAME_TREE
    X = laid_onto(whole.trees.positions[rows[near]], mapped.positions[near])
    poses = np.array([compose(X, pose) for pose in whole.poses])
    n = len(poses)
    return Localized(whole.times, poses, np.zeros((n, 3, 3)), np.ones(n, dtype=bool)), X


def judged_by_survey(claims: Localized, whole: Localized) -> Judgement:
    """Compare claims with the `reference`, at the times of its scans."""
    inside = (whole.times > claims.times[0]) & (whole.times < claims.times[-1])
    # The claim of a cycle holds for the odometry that it has, which is one period old.
    at = claims.at(whole.times[inside] + PERIOD)
    has = at.has_pose
    errors = at.poses[has] - whole.poses[inside][has]
    errors[:, 2] = wrap(errors[:, 2])
    return Judgement.of(errors, at.covariances[has])


def shares(claims: Localized, drive: Drive, whole: Localized, mapped: Landmarks, scenario: ParkScenario) -> Array:
    """Return shares of the scans of a drive, (3,): with a pose, confirmed by a scan, seeing three trees of the map."""
    trees = drive.log.sense["trees"]
    tree, counts = cKDTree(mapped.positions), []
    poses = whole.poses[np.clip(np.searchsorted(whole.times, trees.times), 0, len(whole.times) - 1)]
    for pose, row in zip(poses, trees.values, strict=True):
        points = transform(pose, range_bearing_landmarks(row, scenario.detector).positions)
        counts.append((tree.query(points)[0] < _MATCHES).sum() if len(points) else 0)
    at = claims.at(trees.times + _ANSWERED)
    return np.array([at.has_pose.mean(), at.confirmed.mean(), np.mean(np.array(counts) >= 3)])


@dataclass(frozen=True, eq=False)
class Prepared:
    """The calibration and the map that the first part of a drive gives.

    Attributes:
        scenario: The scenario with the calibrated car and scanner.
        config: The settings of surveys, with the calibrated place of the antenna.
        mapped: The survey.
        noise: Standard deviation of positions by satellites about the survey, in m per axis.
    """

    scenario: ParkScenario
    config: SurveyConfig
    mapped: Survey
    noise: float

    @property
    def antenna(self) -> Array:
        """The place of the antenna in H, (2,) in m."""
        return np.array([self.config.antenna_x, self.config.antenna_y])

    def with_map(self, folder: Path, *, mirrored: bool = False) -> ParkScenario:
        """Return the scenario with the map as a file in a folder; a mirrored one shows no place of the drive."""
        trees, path = self.mapped.trees, folder / "map.geojson"
        if mirrored:
            flip = np.diag([1.0, -1.0])
            trees = replace(trees, positions=trees.positions @ flip, covariances=flip @ trees.covariances @ flip)
        save_geojson(tree_model(trees, source="survey"), path, frame=_FRAME)
        return replace(self.scenario, map_file=str(path), correlation=self.mapped.correlation)


def prepared(first: Drive) -> Prepared:
    """Calibrate the car and its scanner, and survey the trees, with the first part of a drive."""
    scenario = ParkScenario()
    car, antenna = calibrated(first, scenario.car)
    scenario = replace(scenario, car=car, steering_deviation=_STEERING_DEVIATION)
    config = SurveyConfig(antenna_x=float(antenna[0]), antenna_y=float(antenna[1]))
    mapped = surveyed(first, scenario, config)
    turned = slide(mapped, reckoned(first.log.sense["odometry"], car, mapped.times))
    detector = replace(scenario.detector, heading=scenario.detector.heading - turned)
    scenario = replace(scenario, detector=detector)
    mapped = surveyed(first, scenario, config)
    positions = first.steady_positions
    off = mapped.antenna_at(positions[:, 0], config) - positions[:, 1:]
    return Prepared(scenario, config, mapped, float(np.sqrt(np.mean(off**2))))


@click.command()
@click.argument("folder", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.option("--speed", type=float, default=0.0, help="Multiple of real time; 0 for as fast as it computes.")
@click.option("--plot", type=click.Path(path_type=Path), help="A file for the figure.")
def main(folder: Path, speed: float, plot: Path | None) -> None:
    """Map the first half of the drive in FOLDER, and localize without a guess in the second."""
    drive = victoria_park(folder)
    start, end = drive.log.start, drive.log.end
    middle = 0.5 * (start + end)
    first, second = drive.between(start, middle), drive.between(middle, end + 1.0)
    half = prepared(first)
    car, trees, deviations = half.scenario.car, half.mapped.trees, np.sqrt(half.mapped.trees.covariances[:, 0, 0])
    print(f"first half, {start:.0f} to {middle:.0f} s: {len(first.positions)} positions by satellites")
    print(
        f"  odometry: speed x {car.speed_scale:.4f}, steering x {car.steering_scale:.4f} + "
        f"{car.steering_offset:.5f} rad; antenna at {half.antenna[0]:.2f}, {half.antenna[1]:.2f} m; "
        f"scanner turned by {np.degrees(half.scenario.detector.heading):.2f} deg"
    )
    print(
        f"  map: {len(trees)} trees, deviation {np.median(deviations):.2f} m, shared over "
        f"{half.mapped.correlation:.0f} m; positions deviate from the survey by {half.noise:.2f} m per axis"
    )
    with TemporaryDirectory() as name:
        scenario, clock = half.with_map(Path(name)), ScaledClock(speed) if speed else None
        claims, report = localized(second, scenario, Path(name) / "drive.lcm", clock=clock)
    whole, X = reference(surveyed(drive, half.scenario, half.config), trees)
    steady = second.steady_positions
    print(f"second half, {middle:.0f} to {end:.0f} s: {report}")
    with_pose, confirmed, visible = 100.0 * shares(claims, second, whole, trees, half.scenario)
    print(
        f"  scans with a pose {with_pose:.1f} %, confirmed {confirmed:.1f} %, with 3 trees of the map {visible:.1f} %"
    )
    print(f"  claims against {len(second.positions)} positions by satellites, those that do not jump, and the survey:")
    for label, positions in (("all", second.positions), ("steady", steady)):
        print(f"  {label:7}{judged_by_positions(claims, positions, half.antenna, noise=half.noise)}")
    print(f"  survey {judged_by_survey(claims, whole)}")
    where = claims.at(steady[:, 0]).has_pose
    print("  the survey of the whole drive against the same steady positions:")
    print(f"         {judged_by_positions(whole, steady[where], half.antenna, noise=half.noise)}")
    print(f"  its trees lie {np.hypot(*X[:2]):.2f} m and {np.degrees(X[2]):.2f} deg off the map's")
    with TemporaryDirectory() as name:
        scenario = half.with_map(Path(name), mirrored=True)
        mirrored, _ = localized(second, scenario, Path(name) / "drive.lcm")
    print(f"on the mirrored map, {int(mirrored.has_pose.sum())} of {len(mirrored.times)} cycles have a pose")
    if plot is not None:
        draw(half, second, claims, whole, plot)


def draw(half: Prepared, second: Drive, claims: Localized, whole: Localized, path: Path) -> None:
    """Draw the map, the claims and the positions of the second half to a file."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(7.0, 4.2), layout="constrained")
    later = whole.times > second.log.start
    axes.plot(*whole.poses[later, :2].T, color="0.8", linewidth=4.0, label="all data of the whole drive, afterwards")
    axes.plot(*second.positions[:, 1:].T, ".", color="tab:orange", markersize=1.5, label="satellites (judge only)")
    axes.plot(*claims.poses[::8, :2].T, color="tab:blue", linewidth=1.0, label="claimed, second half")
    axes.plot(*half.mapped.trees.positions.T, "+", color="tab:green", markersize=4.0, label="map of the first half")
    axes.set(xlabel="x in m", ylabel="y in m", aspect="equal", xlim=(-110.0, 205.0), ylim=(-75.0, 115.0))
    axes.legend(loc="lower right", fontsize=7)
    figure.savefig(path, dpi=100)


if __name__ == "__main__":
    main()
