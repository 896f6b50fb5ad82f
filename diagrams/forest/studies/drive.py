"""A drive of a carrier through a forest or among rocks, and the answers of a localization unit along it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.framework import Context

from vtbdrake.common.arrays import Array
from vtbdrake.components.localization.dead_reckoning import carrier_pose_at
from vtbdrake.components.localization.planar import wrap
from vtbdrake.components.localization.unit import LOST, TRACKING, Localization, LocalizationUnit, UnitState, Views
from vtbdrake.testbed import VirtualTestbed
from vtbdrake_diagrams.forest.dps import PERIOD
from vtbdrake_diagrams.forest.perception import LandmarkSensor
from vtbdrake_diagrams.forest.scenario import CarrierScenario
from vtbdrake_diagrams.forest.studies.detections import Detector, Odometry, Wood, arc, dead_reckoned
from vtbdrake_diagrams.forest.world.stand import Stand

INDEPENDENT = 100.0
"""Estimates count as independent if they are at least this far apart along the path, in m."""
STANDING = 2.0
"""The time in s for which the carrier stands before it drives: the gyros show their bias, and the attitude settles."""
SCANS = 5.0
"""The number of scans per second."""
_SPEED = "sim.act.driver.speed"
_POSE = "sim.sys.carrier.base.pose"
_ARRIVAL = "dps.env.{signal}_arrival"
_HISTORY = "dps.env.dead_reckoning.history"


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
