"""Application O2: what scan frequency must the laser scanner have to measure the moving target accurately?

The servicer rests, the target comes closer and tumbles, and the DPS follows it with the scanner alone. Everything that
decides the answer was fixed before it was seen; the reasons are beside the numbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from math import inf, radians

import click
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import ArrayLike, NDArray
from pydrake.common.eigen_geometry import AngleAxis
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import MultibodyPlantConfig
from pydrake.systems.framework import Diagram, DiagramBuilder

import vtbdrake as vtb
from vtbdrake.components.perception.tracking import TargetTracker
from vtbdrake.components.sensors import ErrorModel, Imu
from vtbdrake.components.sensors.laser_scanner import LaserScanner, LaserScannerConfig, connect_laser_scanner
from vtbdrake.rollout import Executor, ProcessExecutor
from vtbdrake.scan import Scan
from vtbdrake.state.systems import pose_from_array
from vtbdrake.testbed import Interface, Scenario, Signal, VirtualTestbedBuilder
from vtbdrake.visualization.plots import Picture, finish
from vtbdrake_diagrams.answers import Answer
from vtbdrake_diagrams.satellite.bodies import Servicer, Target
from vtbdrake_diagrams.satellite.dps import PERIOD
from vtbdrake_diagrams.satellite.estimation import BaseEstimator
from vtbdrake_diagrams.satellite.perception import PerceptionConfig, add_scan_part
from vtbdrake_diagrams.satellite.plant import add_servicer, add_target, plant_config
from vtbdrake_diagrams.satellite.start import Release, Start

Array = NDArray[np.float64]

APPROACH = 16.0
"""How long the approach takes, in s."""
CLOSING_SPEED = 0.1
"""At which speed the target comes closer, in m/s [assumed: usual for the last metres of a rendezvous]."""
LAST_DISTANCE = 2.3
"""The distance of its centre from that of the base in the end, in m: within the reach of the arm."""
SETTLING = 8.0
"""When the error begins to count, in s: by then the track must have begun."""
SCANNER = LaserScannerConfig(rays_per_second=12_000.0, azimuth=1.7, elevation=1.0, divergence=0.002)
"""The scanner, but for its frequency: few rays [assumed], so that many scans have few points each. At the last distance
its field of view still holds the target with its panels: registration would take its border for the edge of a face."""
RANGE_NOISE = 0.01
"""Standard deviation of its ranges, in m [assumed]."""
TOLERANCE = (Servicer().opening - Target().bar_radius) / 2.0
"""The error that a grip allows, in m: half of the clearance between bar and finger. The arm may need the other half."""
FREQUENCIES = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0)
"""The scan frequencies of the grid, in Hz."""
TUMBLES = (0.5, 1.0, 2.0, 4.0)
"""The tumble rates, in deg/s: up to the 3 deg/s at which captures must succeed, and one beyond."""
PATIENCE = 2.0
"""After how many estimates that do not fit the tracker begins anew: a scanner alone may begin with a wrong pose."""
STARTS = (0, 1)
"""The seeds of the approaches under which every frequency is tried."""


@dataclass
class ApproachScenario(Scenario):
    """A tumbling target comes closer to a resting servicer, which measures its pose by a laser scanner."""

    # Discrete, as in a capture, with the same step.
    plant_config: MultibodyPlantConfig = field(default_factory=plant_config)
    # Of the tumble's axis and the target's attitude.
    seed: int = 0
    # The target's angular velocity, in deg/s.
    tumble_deg: float = 2.0
    # The speed at which it comes closer, in m/s.
    closing_speed: float = CLOSING_SPEED
    # Whether scans are corrected by the estimated motion of the target.
    deskew: bool = True
    scanner: LaserScannerConfig = field(default_factory=lambda: LaserScannerConfig(**vars(SCANNER)))
    scan_errors: ErrorModel = field(default_factory=lambda: ErrorModel(noise=RANGE_NOISE))
    # Its noise is in rad/s (gyros) and in m/s^2 (accelerometers).
    imu_errors: ErrorModel = field(default_factory=lambda: ErrorModel(noise=1e-4))

    def validate(self) -> None:
        super().validate()
        self.require(
            seed=(self.seed >= 0, "not negative"),
            tumble_deg=(0.0 <= self.tumble_deg <= 4.5, "within [0, 4.5] deg/s: beyond, the first scan sees no front"),
            closing_speed=(0.0 <= self.closing_speed <= 0.5, "within [0, 0.5] m/s"),
        )

    def interface(self) -> Interface:
        return Interface(
            sense=[Signal("imu", size=6, unit="rad/s, m/s^2"), Signal("scan", model_value=Scan.empty())], act=[]
        )

    def make_dps(self) -> Diagram:
        builder = DiagramBuilder()
        env = builder.AddNamedSystem("env", _make_env(PerceptionConfig(deskew=self.deskew)))
        for signal in ("imu", "scan"):
            builder.ExportInput(env.GetInputPort(signal), signal)
        dps = builder.Build()
        dps.set_name("dps")
        return dps

    def start(self) -> Start:
        """Return how the target moves at first: it faces the servicer, within 10 deg, halfway through the approach."""
        random = np.random.default_rng(self.seed)
        axis, off_axis = (direction / np.linalg.norm(direction) for direction in random.normal(size=(2, 3)))
        off = RotationMatrix(AngleAxis(radians(10.0) * random.uniform(), off_axis))
        rate = radians(self.tumble_deg)
        before = RotationMatrix(AngleAxis(-rate * APPROACH / 2.0, axis))
        distance = LAST_DISTANCE + self.closing_speed * APPROACH
        return Start(RigidTransform(before @ off, [distance, 0, 0]), rate * axis, np.array([-self.closing_speed, 0, 0]))

    def add_world(self, builder: VirtualTestbedBuilder) -> None:
        # Imported here: the DPS runs without Embree.
        from vtbdrake.components.ray_casting import RayCaster

        start = self.start()
        plant, scene_graph = builder.add_plant(self.plant_config)
        servicer, target = add_servicer(plant, servos=False), add_target(plant, start.X_WT)
        plant.Finalize()
        builder.add_sensor(
            "imu", Imu(plant, plant.GetFrameByName("imu", servicer), period=PERIOD, errors=self.imu_errors)
        )
        scanner = LaserScanner(
            plant,
            plant.GetFrameByName("scanner", servicer),
            RayCaster(plant, scene_graph),
            config=self.scanner,
            slice_period=PERIOD,
            errors=self.scan_errors,
        )
        builder.add("sense", "scanner", scanner)
        connect_laser_scanner(builder.diagram_builder, scanner, plant)
        builder.sim_sensor("scan", scanner.get_output_port())
        release = builder.add("env", "release", Release(plant, target, start))
        builder.connect(plant.get_state_output_port(), release.get_input_port())
        builder.connect(release.get_output_port(), plant.get_applied_spatial_force_input_port())


def _make_env(config: PerceptionConfig) -> Diagram:
    """Return the perceived environment: base and target, as in a capture, from scans alone."""
    builder = DiagramBuilder()
    base = builder.AddNamedSystem("base", BaseEstimator(period=PERIOD))
    tracker = TargetTracker(["scan"], starting=["scan"], period=PERIOD, motion=config.motion)
    target = builder.AddNamedSystem("target", tracker)
    builder.ExportInput(base.GetInputPort("imu"), "imu")
    facing = RotationMatrix()
    part = add_scan_part(builder, base, target, config=config, period=PERIOD, attitude=facing)
    builder.Connect(part.GetOutputPort("estimate"), target.GetInputPort("scan"))
    return builder.Build()


_BAR_ENDS = [Target().X_TH @ np.array([0.0, side * Target().bar_length / 2.0, 0.0]) for side in (-1.0, 1.0)]


def grip_error(time: float, perceived: ArrayLike, true: ArrayLike) -> float:
    """Return how far the perceived ends of the grapple bar are from the true ones, in m; 0 while the filter settles.

    The servicer rests at the origin, so that its inertial frame I is the world.

    Args:
        time: In s.
        perceived: X_IT as the DPS has it, [x, y, z, roll, pitch, yaw], in m and rad.
        true: X_WT, likewise.
    """
    if time < SETTLING:
        return 0.0
    X_IT, X_WT = pose_from_array(np.asarray(perceived)), pose_from_array(np.asarray(true))
    return max(float(np.linalg.norm(X_IT @ p - X_WT @ p)) for p in _BAR_ENDS)


def frequency_problem(*, deskew: bool, starts: Sequence[int] = STARTS) -> vtb.Problem:
    """Return the problem: the scan frequency with the smallest error at the bar, the largest over time and approaches.

    Args:
        deskew: Whether scans are corrected by the estimated motion of the target.
        starts: The seeds of the approaches.
    """
    return vtb.Problem(
        scenario=ApproachScenario(deskew=deskew),
        parameters=[
            vtb.Parameter("scenario.tumble_deg", min(TUMBLES), max(TUMBLES)),
            vtb.Parameter("sim.sense.scanner.frequency", min(FREQUENCIES), max(FREQUENCIES), log=True),
        ],
        quality=vtb.Quality(
            grip_error,
            of=["time", "dps.env.target.pose", "sim.sys.target.body.pose"],
            reading="worst",
            minimize=True,
        ),
        horizon=APPROACH,
        conditions=[{"scenario.seed": seed, "dps.env.target.patience": PATIENCE} for seed in starts],
    )


@dataclass(frozen=True)
class FrequencyAnswer:
    """The errors at the bar over the grid of tumble rates and frequencies.

    Attributes:
        tumbles: In deg/s, shape (m,).
        frequencies: In Hz, increasing, shape (n,).
        raw: Errors with scans as they come, in m, the largest over time and approaches, shape (m, n).
        deskewed: Those with de-skewed scans, likewise.
    """

    tumbles: Array
    frequencies: Array
    raw: Array
    deskewed: Array

    def least(self, errors: Array) -> list[tuple[float, float]]:
        """Return between which frequencies of the grid the least sufficient one lies, in Hz, for each tumble rate.

        The error must be below `TOLERANCE` at the upper one and above it at the lower one, 0 if there is none lower;
        the upper one is infinite where no frequency suffices.
        """
        found = []
        for row in errors:
            enough = np.flatnonzero(row < TOLERANCE)
            k = int(enough[0]) if enough.size else len(row)
            upper = float(self.frequencies[k]) if enough.size else inf
            found.append((float(self.frequencies[k - 1]) if k else 0.0, upper))
        return found

    @property
    def explained(self) -> bool:
        """Return whether the errors have the two causes that are expected.

        Where the `skew` is larger than the tolerance and there are enough scans for a track (from 1 Hz), the raw error
        is between once and twice the skew; and without it, by de-skewing, a lower frequency suffices. With most scans
        per second, which have the fewest points, the error of de-skewed ones is not the smallest.
        """
        told = (self.frequencies >= 1.0) & (skew(self.frequencies) > TOLERANCE)
        relative = self.raw[:, told] / skew(self.frequencies[told])
        follows = bool(told.any() and ((relative > 1.0) & (relative < 2.0)).all())
        lower = all(d < r for (_, d), (_, r) in zip(self.least(self.deskewed), self.least(self.raw), strict=True))
        return follows and lower and bool((self.deskewed[:, -1] > self.deskewed.min(axis=1)).all())

    @property
    def holds(self) -> bool:
        """Return whether each tumble rate has a least frequency with de-skewed scans, and the trend is explained."""
        return self.explained and all(upper < inf for _, upper in self.least(self.deskewed))


def skew(frequency: ArrayLike) -> Array:
    """Return the error of a target that comes closer, in m, by scans that are taken for instants: v / (2 f).

    The points of a scan are 1 / (2 f) old in the mean when it is complete, so that the target seems farther away.
    """
    return CLOSING_SPEED / (2.0 * np.asarray(frequency, dtype=float))


def find_frequencies(
    *, tumbles: Sequence[float] = TUMBLES, starts: Sequence[int] = STARTS, executor: Executor
) -> FrequencyAnswer:
    """Determine the errors over the grid of tumble rates (deg/s) and `FREQUENCIES`, with and without de-skewing."""
    points = [(tumble, frequency) for tumble in tumbles for frequency in FREQUENCIES]
    shape = (len(tumbles), len(FREQUENCIES), len(starts))
    errors = {}
    for deskew in (False, True):
        problem = frequency_problem(deskew=deskew, starts=starts)
        sweep = problem.sweep(values=points, executor=executor, progress=False)
        errors[deskew] = np.reshape([rollout.value for rollout in sweep.rollouts], shape).max(axis=2)
    return FrequencyAnswer(np.array(tumbles), np.array(FREQUENCIES), errors[False], errors[True])


def plot_answer(answer: FrequencyAnswer) -> Figure:
    """Draw the errors over the frequency, and the least sufficient frequency over the tumble rate."""
    figure = Picture(11.0, 4.2)
    left, right = figure.subplots(1, 2, width_ratios=[3, 2])
    for k, tumble in enumerate(answer.tumbles):
        left.loglog(answer.frequencies, answer.raw[k], "o--", color=f"C{k}", label=f"raw, {tumble:g} deg/s")
        left.loglog(answer.frequencies, answer.deskewed[k], "o-", color=f"C{k}", label=f"de-skewed, {tumble:g} deg/s")
    left.loglog(answer.frequencies, skew(answer.frequencies), ":", color="gray", label="v / (2 f)")
    left.axhline(TOLERANCE, color="black", lw=0.8)
    left.set(xlabel="scan frequency [Hz]", ylabel="largest error at the bar [m]", title="Error during the approach")
    left.legend(fontsize="x-small")
    for name, errors, style in (("raw", answer.raw, "s--"), ("de-skewed", answer.deskewed, "o-")):
        right.plot(answer.tumbles, [upper for _, upper in answer.least(errors)], style, label=name)
    right.set(xlabel="tumble rate [deg/s]", ylabel="least frequency of the grid [Hz]", yscale="log")
    right.set_title(f"Error below {1e3 * TOLERANCE:.1f} mm")
    right.legend(fontsize="x-small")
    for axes in (left, right):
        finish(axes)
    return figure


def answer_frequency(*, full: bool = False) -> FrequencyAnswer:
    """Answer O2 with two worker processes; in the short version with one approach at every other tumble rate."""
    with ProcessExecutor(2) as executor:
        return find_frequencies(
            tumbles=TUMBLES if full else TUMBLES[1::2], starts=STARTS if full else STARTS[:1], executor=executor
        )


def frequency(full: bool) -> Answer:
    """Answer O2: what scan frequency must the laser scanner have?"""
    found = answer_frequency(full=full)
    least = {"de-skewed": found.least(found.deskewed), "raw": found.least(found.raw)}
    upper = max(upper for _, upper in least["de-skewed"])
    lower = max(lower for lower, _ in least["de-skewed"])
    told = "; ".join(
        f"{name}: "
        + ", ".join(f"{t:g} deg/s {_range(*interval)}" for t, interval in zip(found.tumbles, intervals, strict=True))
        for name, intervals in least.items()
    )
    return Answer(
        id="O2",
        question="What scan frequency must the laser scanner have to measure the moving target accurately?",
        answer=upper,
        unit="Hz",
        interval=(lower, upper),
        paper="none given",
        holds=found.holds,
        note=f"Least frequency for an error at the bar below {1e3 * TOLERANCE:.1f} mm, for all tumble rates, with "
        f"de-skewed scans. {told}. Raw scans are behind by v / (2 f); with many scans per second, each has few points.",
    )


def _range(lower: float, upper: float) -> str:
    return f"above {lower:g} Hz" if upper == inf else f"{lower:g} to {upper:g} Hz"


@click.command()
@click.option("--full", is_flag=True, help="All tumble rates and approaches.")
@click.option("--figure", default="scan_frequency.png", help="File of the picture.", show_default=True)
def main(full: bool, figure: str) -> None:
    """Answer O2, and draw the answer."""
    found = answer_frequency(full=full)
    click.echo("largest error at the bar [mm]    " + " ".join(f"{f:7g} Hz" for f in found.frequencies))
    for name, errors in (("raw", found.raw), ("de-skewed", found.deskewed)):
        for tumble, row in zip(found.tumbles, errors, strict=True):
            click.echo(f"{name:>12} {tumble:10g} deg/s      " + " ".join(f"{1e3 * e:10.1f}" for e in row))
    click.echo(f"explained: {found.explained}; holds: {found.holds}")
    plot_answer(found).savefig(figure, dpi=110)


if __name__ == "__main__":
    # Under its own name, so that worker processes find its functions.
    from vtbdrake_diagrams.satellite.scan_frequency import main as program

    program(prog_name="python -m vtbdrake_diagrams.satellite.scan_frequency")
