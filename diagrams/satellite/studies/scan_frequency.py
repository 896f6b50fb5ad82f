"""Application O2: what scan frequency must the laser scanner have to measure the moving target accurately?

The servicer rests, the target comes closer and tumbles, and the DPS follows it with the scanner alone. A frequency
suffices if nine of ten approaches, from random starts, keep the error within the tolerance: the 90 % quantile of the
largest error, with its interval of confidence. Everything that decides the answer was fixed before it was seen; the
reasons are beside the numbers. Only the quantile came later: before, the answer rested on one or two approaches.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from math import ceil, inf, radians

import click
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import ArrayLike, NDArray
from pydrake.common.eigen_geometry import AngleAxis
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import MultibodyPlantConfig
from pydrake.systems.framework import Diagram, DiagramBuilder
from scipy.stats import binom

import vtbdrake as vtb
from vtbdrake.common.arrays import Array
from vtbdrake.common.scan import Scan
from vtbdrake.common.settings import setting
from vtbdrake.components.perception.target_tracker import TargetTracker
from vtbdrake.components.sensors import ErrorModel, Imu
from vtbdrake.components.sensors.laser_scanner import LaserScanner, LaserScannerConfig, connect_laser_scanner
from vtbdrake.rollout import Executor, ProcessExecutor
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

APPROACH = 16.0
"""How long the approach takes, in s."""
CLOSING_SPEED = 0.1
"""At which speed the target comes closer, in m/s [assumed: usual for the last metres of a rendezvous]."""
LAST_DISTANCE = 2.3
"""The distance of its centre from the base's centre in the end, in m: within the reach of the arm."""
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
RAW = (1.0, 2.0, 4.0)
"""Frequencies of the short version with scans as they come, in Hz."""
DESKEWED = (0.5, 1.0, 2.0, 16.0)
"""Frequencies of the short version with de-skewed scans, in Hz."""
TUMBLES = (0.5, 1.0, 2.0, 4.0)
"""The tumble rates, in deg/s: up to the 3 deg/s at which captures must succeed, and one beyond. The short version takes
every other one."""
PATIENCE = 2.0
"""After how many estimates that do not fit the tracker begins anew: a scanner alone may begin with a wrong pose."""
STARTS = tuple(range(30))
"""The seeds of the approaches under which every frequency is tried: with 30, the interval of the quantile has an upper
end. The short version takes the first `FEW`, and its interval has none."""
FEW = 10
QUANTILE = 0.9
"""The share of approaches in which a sufficient frequency keeps the error within the tolerance."""
CONFIDENCE = 0.9
"""Confidence of the interval in which that quantile lies."""


@dataclass
class ApproachScenario(Scenario):
    """A tumbling target comes closer to a resting servicer, which measures its pose by a laser scanner."""

    # Discrete, as in a capture, with the same step.
    plant_config: MultibodyPlantConfig = field(default_factory=plant_config)
    seed: int = setting(0, "Determines the tumble's axis and the target's attitude.", ge=0)
    tumble_deg: float = setting(
        2.0,
        "The target's angular velocity.",
        unit="deg/s",
        ge=0.0,
        le=4.5,
        remedy="beyond, the first scan sees no front",
    )
    closing_speed: float = setting(CLOSING_SPEED, "The speed at which it comes closer.", unit="m/s", ge=0.0, le=0.5)
    deskew: bool = setting(True, "Whether scans are corrected by the estimated motion of the target.")
    scanner: LaserScannerConfig = field(default_factory=lambda: LaserScannerConfig(**vars(SCANNER)))
    scan_errors: ErrorModel = field(default_factory=lambda: ErrorModel(noise=RANGE_NOISE))
    # Its noise is in rad/s (gyros) and in m/s^2 (accelerometers).
    imu_errors: ErrorModel = field(default_factory=lambda: ErrorModel(noise=1e-4))

    def interface(self) -> Interface:
        return Interface(
            sense=[
                Signal("imu", size=6, unit="rad/s, m/s^2", lower=-10.0, upper=10.0),
                Signal("scan", model_value=Scan.empty()),
            ],
            act=[],
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


def frequency_problem(*, deskew: bool, starts: Sequence[int] = STARTS[:FEW]) -> vtb.Problem:
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
class Errors:
    """The errors at the bar in some approaches, over tumble rates and frequencies.

    Attributes:
        frequencies: In Hz, increasing, shape (n,).
        values: The largest error over time, in m, infinite if the approach failed, shape (tumble rates, n, approaches).
    """

    frequencies: Array
    values: Array

    def quantiles(self) -> tuple[Array, Array, Array]:
        """Return lower bound, estimate and upper bound of the 90 % quantile over the approaches, shape (m, n) each.

        They are order statistics, whatever the distribution: of s approaches, as many as Binomial(s, 0.9) have less
        error than the quantile. A bound that takes more approaches is 0 or infinite.
        """
        s = self.values.shape[2]
        ordered = np.sort(np.concatenate([self.values, np.full_like(self.values[..., :1], inf)], axis=2), axis=2)
        ordered = np.concatenate([np.zeros_like(ordered[..., :1]), ordered], axis=2)  # From the first on, by rank.
        below = binom.cdf(np.arange(s + 1), s, QUANTILE)  # P(at most k of the errors are below the quantile)
        tail = (1.0 - CONFIDENCE) / 2.0
        lower = int((below[:-1] <= tail).sum())
        upper = s + 1 - int((1.0 - below[:-1] <= tail).sum())
        return ordered[..., lower], ordered[..., ceil(QUANTILE * s)], ordered[..., upper]

    def least(self) -> list[tuple[float, float, float]]:
        """Return (lower, estimate, upper) of the least sufficient frequency in Hz, for each tumble rate.

        The estimate is the least frequency of the grid with a quantile below `TOLERANCE`, upper the least with an upper
        bound below it; infinite where there is none. Lower is the frequency before the first with a lower bound below
        it: at lower and below, the frequency does not suffice; 0 if there is none.
        """
        firsts = [[_first(row < TOLERANCE) for row in bound] for bound in self.quantiles()]
        steps = np.concatenate([[0.0], self.frequencies, [inf]])
        return [
            (float(steps[lower]), float(steps[estimate + 1]), float(steps[upper + 1]))
            for lower, estimate, upper in zip(*firsts, strict=True)
        ]


def _first(sufficient: NDArray[np.bool_]) -> int:
    """Return the number of the first that is true, or how many there are."""
    return int(np.argmax(sufficient)) if sufficient.any() else len(sufficient)


@dataclass(frozen=True)
class FrequencyAnswer:
    """The errors at the bar over the grid of tumble rates and frequencies.

    Attributes:
        tumbles: In deg/s, shape (m,).
        raw: Errors with scans as they come.
        deskewed: Those with de-skewed scans.
    """

    tumbles: Array
    raw: Errors
    deskewed: Errors

    @property
    def follows(self) -> bool:
        """Return whether the median raw error is between once and twice the `skew`.

        That counts where the skew is larger than the tolerance and there are enough scans for a track (from 1 Hz).
        """
        is_measurable = (self.raw.frequencies >= 1.0) & (skew(self.raw.frequencies) > TOLERANCE)
        relative = np.median(self.raw.values[:, is_measurable], axis=2) / skew(self.raw.frequencies[is_measurable])
        return bool(is_measurable.any() and ((relative > 1.0) & (relative < 2.0)).all())

    @property
    def helps(self) -> bool:
        """Return whether with de-skewed scans a lower frequency suffices, at each tumble rate."""
        return all(d < r for (_, d, _), (_, r, _) in zip(self.deskewed.least(), self.raw.least(), strict=True))

    @property
    def thins(self) -> bool:
        """Return whether with most scans per second, which have the fewest points, the error is not the smallest."""
        _, quantile, _ = self.deskewed.quantiles()
        return bool((quantile[:, -1] > quantile.min(axis=1)).all())

    @property
    def holds(self) -> bool:
        """Return whether each tumble rate has a least frequency with de-skewed scans, and the trend is explained."""
        least = all(estimate < inf for _, estimate, _ in self.deskewed.least())
        return least and self.follows and self.helps and self.thins


def skew(frequency: ArrayLike) -> Array:
    """Return the error of a target that comes closer, in m, by scans that are taken for instants: v / (2 f).

    The points of a scan are 1 / (2 f) old in the mean when it is complete, so that the target seems farther away.
    """
    return CLOSING_SPEED / (2.0 * np.asarray(frequency, dtype=float))


def find_frequencies(
    *,
    tumbles: Sequence[float] = TUMBLES,
    raw: Sequence[float] = FREQUENCIES,
    deskewed: Sequence[float] = FREQUENCIES,
    starts: Sequence[int] = STARTS,
    executor: Executor,
) -> FrequencyAnswer:
    """Determine the errors over a grid of tumble rates (deg/s) and frequencies (Hz), with and without de-skewing."""

    def errors(deskew: bool, frequencies: Sequence[float]) -> Errors:
        points = [(tumble, frequency) for tumble in tumbles for frequency in frequencies]
        sweep = frequency_problem(deskew=deskew, starts=starts).sweep(values=points, executor=executor, progress=False)
        values = [inf if rollout.failed else rollout.value for rollout in sweep.rollouts]
        return Errors(np.array(frequencies), np.reshape(values, (len(tumbles), len(frequencies), len(starts))))

    return FrequencyAnswer(np.array(tumbles), errors(False, raw), errors(True, deskewed))


def plot_answer(answer: FrequencyAnswer) -> Figure:
    """Draw the quantile of the error over the frequency, and the least sufficient frequency over the tumble rate."""
    figure = Picture(11.0, 4.2)
    left, right = figure.subplots(1, 2, width_ratios=[3, 2])
    kinds = (("raw", answer.raw, "s--"), ("de-skewed", answer.deskewed, "o-"))
    for name, errors, style in kinds:
        lower, quantile, upper = errors.quantiles()
        for k, tumble in enumerate(answer.tumbles):
            reach = np.where(np.isfinite(upper[k]), upper[k], errors.values[k].max(axis=1))
            bars = np.clip([quantile[k] - lower[k], reach - quantile[k]], 0.0, None)
            label = f"{name}, {tumble:g} deg/s"
            left.errorbar(errors.frequencies, quantile[k], bars, fmt=style, color=f"C{k}", capsize=2, label=label)
    some = np.array(FREQUENCIES)
    left.plot(some, skew(some), ":", color="gray", label="v / (2 f)")
    left.axhline(TOLERANCE, color="black", lw=0.8)
    left.set(xscale="log", yscale="log", xlabel="scan frequency [Hz]", ylabel="error at the bar [m]")
    left.set_title(f"{QUANTILE:.0%} quantile of {answer.raw.values.shape[2]} approaches")
    left.legend(fontsize="x-small")
    for name, errors, style in kinds:
        right.plot(answer.tumbles, [estimate for _, estimate, _ in errors.least()], style, label=name)
    right.set(xlabel="tumble rate [deg/s]", ylabel="least frequency of the grid [Hz]", yscale="log")
    right.set_title(f"Error below {1e3 * TOLERANCE:.1f} mm")
    right.legend(fontsize="x-small")
    for axes in (left, right):
        finish(axes)
    return figure


def answer_frequency(*, full: bool = False) -> FrequencyAnswer:
    """Answer O2 with two worker processes; see `TUMBLES`, `RAW`, `DESKEWED` and `FEW` for the short version."""
    with ProcessExecutor(2) as executor:
        if full:
            return find_frequencies(executor=executor)
        return find_frequencies(
            tumbles=TUMBLES[1::2], raw=RAW, deskewed=DESKEWED, starts=STARTS[:FEW], executor=executor
        )


def frequency(full: bool) -> Answer:
    """Answer O2: what scan frequency must the laser scanner have?"""
    result = answer_frequency(full=full)
    least = {"de-skewed": result.deskewed.least(), "raw": result.raw.least()}
    lower, estimate, upper = (max(bounds) for bounds in zip(*least["de-skewed"], strict=True))
    ranges = "; ".join(
        f"{name}: "
        + ", ".join(f"{t:g} deg/s {_range(*bounds)}" for t, bounds in zip(result.tumbles, rows, strict=True))
        for name, rows in least.items()
    )
    claims = {
        "the median raw error is once to twice v / (2 f)": result.follows,
        "de-skewed, a lower frequency suffices": result.helps,
        "most scans per second are not best": result.thins,
    }
    return Answer(
        id="O2",
        question="What scan frequency must the laser scanner have to measure the moving target accurately?",
        answer=estimate,
        unit="Hz",
        interval=(lower, upper),
        paper="none given",
        cases=f"{result.raw.values.shape[2]} approaches at each of {result.tumbles.size} tumble rates",
        held_out="",
        baseline="the same scans, raw",
        refused=sum(bounds[1] == inf for bounds in least["de-skewed"]),
        holds=result.holds,
        note=f"Least frequency for which the error at the bar is below {1e3 * TOLERANCE:.1f} mm in {QUANTILE:.0%} of "
        f"the approaches, at all tumble rates, with de-skewed scans; of {result.raw.values.shape[2]} approaches, with "
        f"the interval of {CONFIDENCE:.0%}. {ranges}. "
        + "; ".join(f"{claim}: {'yes' if true else 'NO'}" for claim, true in claims.items())
        + ".",
    )


def _range(lower: float, estimate: float, upper: float) -> str:
    """Return the least sufficient frequency in words: the estimate, and between what it lies."""
    if estimate == inf:
        return f"none of the grid (above {lower:g} Hz)"
    return f"{estimate:g} Hz (above {lower:g} Hz{'' if upper == inf else f', at most {upper:g} Hz'})"


@click.command()
@click.option("--full", is_flag=True, help="All tumble rates and approaches.")
@click.option("--figure", default="scan_frequency.png", help="File of the picture.", show_default=True)
def main(full: bool, figure: str) -> None:
    """Answer O2, and draw the answer."""
    result = answer_frequency(full=full)
    click.echo(f"{QUANTILE:.0%} quantile of the error at the bar [mm], [lower, upper bound]")
    for name, errors in (("raw", result.raw), ("de-skewed", result.deskewed)):
        for tumble, *bounds in zip(result.tumbles, *errors.quantiles(), strict=True):
            for frequency, lower, quantile, upper in zip(errors.frequencies, *bounds, strict=True):
                numbers = f"{1e3 * quantile:6.1f} [{1e3 * lower:.1f}, {1e3 * upper:.1f}]"
                click.echo(f"{name:>10} {tumble:4g} deg/s {frequency:5g} Hz {numbers}")
        click.echo(f"{name:>10}, least: {', '.join(_range(*bounds) for bounds in errors.least())}")
    click.echo(f"follows: {result.follows}; helps: {result.helps}; thins: {result.thins}; holds: {result.holds}")
    plot_answer(result).savefig(figure, dpi=110)


if __name__ == "__main__":
    # Under its own name, so that worker processes find its functions.
    from vtbdrake_diagrams.satellite.studies.scan_frequency import main as program

    program(prog_name="python -m vtbdrake_diagrams.satellite.studies.scan_frequency")
