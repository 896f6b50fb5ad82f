"""A real lawn mower with wheels and a gyro, beside RTK positions (2 cm): how far its dead reckoning drifts.

``python -m vtbdrake_diagrams.park.mower FOLDER`` prints it. FOLDER holds Plaza1_.mat and Plaza2_.mat, as in the
repository borglab/gtsam. (Djugash, Hamner and Roth, "Navigating with ranging radios: five data sets with ground truth",
Journal of Field Robotics 26, 2009.) Half of a drive calibrates the odometry and its `DriftModel`; the other half
judges.

What the files call odometry must be looked at: the turns of the gyro equal the turns of the RTK path's headings, to the
last digit, and the ways of the second drive are those between the RTK positions. So a drift of the gyro cannot be seen,
only positions judge, and only the first drive's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import click
import numpy as np
from scipy.io import loadmat
from scipy.optimize import least_squares, minimize
from scipy.stats import chi2

from vtbdrake.cli.output import table
from vtbdrake.common.arrays import Array
from vtbdrake.components.estimation import squared_distances
from vtbdrake.components.localization.dead_reckoning import DriftModel
from vtbdrake.components.localization.planar import compose, rotation
from vtbdrake_diagrams.forest.perception import moved

FILES = ("Plaza1_.mat", "Plaza2_.mat")
HORIZONS = (10.0, 30.0, 100.0)
"""How long dead reckoning goes on alone, in s."""

# Number of samples of the odometry that are taken together to a motion, about a second.
_TOGETHER = 5


@dataclass(frozen=True, eq=False)
class Mowing:
    """A recorded drive of a mower.

    Attributes:
        times: Times in s, (n,).
        positions: Positions by RTK in m, (n, 2).
        headings: Headings by the gyro in rad, (n,).
        ways: The distance by the wheels to each time from the one before, (n - 1,) in m.
        turns: The turn by the gyro in the same interval, (n - 1,) in rad.
    """

    times: Array
    positions: Array
    headings: Array
    ways: Array
    turns: Array

    @staticmethod
    def read(path: Path) -> Mowing:
        """Return the drive in a file."""
        content = loadmat(path)
        truth, odometry = content["GT"], content["DR"]
        return Mowing(truth[:, 0], truth[:, 1:3], truth[:, 3], odometry[:, 1], odometry[:, 2])

    def part(self, start: int, end: int) -> Mowing:
        """Return the samples from ``start`` to below ``end``."""
        inner = slice(start, end - 1)
        part = slice(start, end)
        return Mowing(self.times[part], self.positions[part], self.headings[part], self.ways[inner], self.turns[inner])

    @property
    def likeness(self) -> tuple[float, float]:
        """Return the correlations of the odometry with the RTK path: of the turns, and of the distances."""
        steps = np.hypot(*np.diff(self.positions, axis=0).T)
        turns = (np.diff(self.headings) + np.pi) % (2.0 * np.pi) - np.pi
        return float(np.corrcoef(turns, self.turns)[0, 1]), float(np.corrcoef(steps, self.ways)[0, 1])


@dataclass(frozen=True)
class Calibrated:
    """The odometry of a mower.

    Attributes:
        scale: True over measured distance.
        offset: Direction of motion less heading in rad.
        antenna: Position of the antenna ahead of and left of the axle in m.
    """

    scale: float
    offset: float
    antenna: tuple[float, float]

    def motions(self, drive: Mowing) -> tuple[Array, Array]:
        """Return the motions of about a second each, (k, 3), and their durations, (k,) in s."""
        motions, durations = [], []
        steps = np.diff(drive.times)
        for first in range(0, len(drive.ways) - _TOGETHER + 1, _TOGETHER):
            pose = np.zeros(3)
            for k in range(first, first + _TOGETHER):
                turn, way = drive.turns[k], self.scale * drive.ways[k]
                pose = compose(pose, [way * np.cos(0.5 * turn), way * np.sin(0.5 * turn), turn])
            motions.append(pose)
            durations.append(steps[first : first + _TOGETHER].sum())
        return np.array(motions), np.array(durations)


RAW = Calibrated(1.0, 0.0, (0.0, 0.0))
"""The odometry as it was recorded."""


@dataclass(frozen=True, eq=False)
class Windows:
    """Stretches in which dead reckoning goes on alone.

    Attributes:
        errors: Errors of the antenna's position at the end, along and across the heading there, (k, 2) in m.
        motions: The motions and durations of each stretch.
        antenna: The place of the antenna, (2,).
    """

    errors: Array
    motions: Sequence[tuple[Array, Array]]
    antenna: Array

    @staticmethod
    def of(drive: Mowing, odometry: Calibrated, horizon: float) -> Windows:
        """Return the stretches of a drive, which follow one another, in which the mower moves."""
        motions, durations = odometry.motions(drive)
        antenna, ends = np.array(odometry.antenna), np.cumsum(durations)
        errors, parts, first = [], [], 0
        while first < len(motions):
            last = int(np.searchsorted(ends, ends[first] + horizon))
            if last > len(motions):
                break
            a, b = first * _TOGETHER, min(last, len(motions)) * _TOGETHER
            start = drive.headings[a] + odometry.offset
            pose = np.array([*(drive.positions[a] - rotation(start) @ antenna), start])
            for motion in motions[first:last]:
                pose = compose(pose, motion)
            error = pose[:2] + rotation(pose[2]) @ antenna - drive.positions[b]
            if np.hypot(*(drive.positions[b] - drive.positions[a])) > 1.0:
                errors.append(rotation(-pose[2]) @ error)
                parts.append((motions[first:last], durations[first:last]))
            first = last
        return Windows(np.array(errors).reshape(-1, 2), parts, antenna)

    def covariances(self, model: DriftModel, *, start: float) -> Array:
        """Return the covariances of the errors by a model, (k, 2, 2).

        Args:
            model: The model.
            start: Standard deviation of the heading at the start in rad.
        """
        made = []
        for motions, durations in self.motions:
            pose, C = np.zeros(3), np.diag([0.02**2, 0.02**2, start**2])
            for motion, duration in zip(motions, durations.tolist(), strict=True):
                pose, C = moved(pose, C, motion, model, duration)
            arm = rotation(pose[2]) @ self.antenna
            J = np.array([[1.0, 0.0, -arm[1]], [0.0, 1.0, arm[0]]])
            R = rotation(-pose[2])
            made.append(R @ (J @ C @ J.T + 0.02**2 * np.eye(2)) @ R.T)
        return np.array(made)


def calibrated(drive: Mowing) -> Calibrated:
    """Return the odometry that fits a drive best, over stretches of 30 s."""

    def odometry_of(p: Array) -> Calibrated:
        scale, offset, ahead, left = p.tolist()
        return Calibrated(scale, offset, (ahead, left))

    def residuals(p: Array) -> Array:
        return Windows.of(drive, odometry_of(p), 30.0).errors.ravel() / 0.1

    start, sizes = [1.0, 0.0, 0.0, 0.0], [0.01, 0.01, 0.1, 0.1]
    return odometry_of(least_squares(residuals, start, x_scale=sizes, diff_step=1e-4, loss="cauchy").x)


def likeliest(parts: Sequence[Windows]) -> DriftModel:
    """Return the model under which the errors in some stretches are the likeliest, without an error of turns."""

    def model_of(p: Array) -> DriftModel:
        along, across, heading = np.exp(p).tolist()
        return DriftModel(along=along, across=across, heading=heading, turn=0.0)

    def unlikeliness(p: Array) -> float:
        total = 0.0
        for windows in parts:
            C = windows.covariances(model_of(p), start=0.0)
            total += float(np.linalg.slogdet(C)[1].sum() + squared_distances(windows.errors, C).sum())
        return total

    start = np.log([DriftModel().along, DriftModel().across, DriftModel().heading])
    return model_of(minimize(unlikeliness, start, method="Nelder-Mead", options={"xatol": 0.05, "fatol": 0.1}).x)


@click.command()
@click.argument("folder", type=click.Path(exists=True, file_okay=False, path_type=Path))
def main(folder: Path) -> None:
    """Calibrate the dead reckoning of the mower in FOLDER with half of a drive, and judge it in the other half."""
    for name in FILES:
        turns, ways = Mowing.read(folder / name).likeness
        print(f"{name}: correlation with the RTK path: turns {turns:.4f}, ways {ways:.4f}")
    drive = Mowing.read(folder / FILES[0])
    middle = len(drive.times) // 2
    first, second = drive.part(0, middle), drive.part(middle, len(drive.times))
    odometry = calibrated(first)
    ahead, left = odometry.antenna
    print(
        f"first half, {np.ptp(first.times):.0f} s: wheels x {odometry.scale:.4f}, motion "
        f"{odometry.offset:+.4f} rad off the heading, antenna at {ahead:.2f}, {left:.2f} m"
    )
    model = likeliest([Windows.of(first, odometry, horizon) for horizon in HORIZONS[:2]])
    print(
        f"drift: {model.along:.3f} m/sqrt(m) along, {model.across:.3f} across, heading {model.heading:.4f} rad/sqrt(s)"
    )
    rows = []
    for horizon in HORIZONS:
        raw, windows = (Windows.of(second, each, horizon) for each in (RAW, odometry))
        sizes = np.hypot(*windows.errors.T)
        columns = []
        for each in (DriftModel(), model):
            squares = squared_distances(windows.errors, windows.covariances(each, start=0.0))
            columns.append([f"{squares.mean() / 2.0:.2f}", f"{np.mean(squares < chi2.ppf(0.95, 2)):.0%}"])
        rows.append(
            [
                f"{horizon:g}",
                str(len(sizes)),
                f"{np.median(np.hypot(*raw.errors.T)):.2f}",
                f"{np.median(sizes):.2f}, {np.quantile(sizes, 0.9):.2f}",
                *(", ".join(column) for column in columns),
            ]
        )
    head = [
        "s",
        "stretches",
        "as recorded (m)",
        "calibrated: median, 90 % (m)",
        "default: NEES, in 95 %",
        "fitted drift",
    ]
    print("second half:")
    print(table(head, rows))


if __name__ == "__main__":
    main()
