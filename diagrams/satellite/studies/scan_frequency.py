"""Application O2: what scan frequency must the laser scanner have to measure the moving target accurately?

The servicer rests, the target comes closer and tumbles, and the DPS follows it with the scanner alone. A frequency
suffices if nine of ten approaches, from random starts, keep the error within the tolerance: the 90 % quantile of the
largest error, with its interval of confidence. With few scans the target moves on between them, and with many a scan
has few points: so the answer is a window, with two ends, for each tumble rate, and with scans as they come or
de-skewed. Whether the window is the same within captures is asked by ``scanned_captures.py`` beside this module.

Everything that decides the answer was fixed before it was seen; the reasons are beside the numbers. Only the quantile
and the window came later: before, the answer rested on one or two approaches, and was the least frequency.

``python -m vtbdrake_diagrams.satellite.studies.scan_frequency --full`` simulates what is missing in
``scan_frequency.json`` beside this module, in blocks of approaches, the undecided frequencies first, and keeps each
block: it may be ended and continued. Without ``--full`` the results are read. The row of the answers is in
``scan_answer.py``: it reads them, and simulates a tenth of the approaches again.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby
from math import ceil, inf, isfinite, isnan, nan, radians
from pathlib import Path

import click
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import ArrayLike
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
from vtbdrake_diagrams.kept_results import Repetition, read_results, repeat, write_results
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
TUMBLES = (1.0, 4.0)
"""The tumble rates, in deg/s: one of those at which captures must succeed, up to 3, and one beyond."""
PATIENCE = 2.0
"""After how many estimates that do not fit the tracker begins anew: a scanner alone may begin with a wrong pose."""
STARTS = tuple(range(30))
"""The seeds of the approaches under which every frequency is tried: with 30, the interval of the quantile has an upper
end."""
BLOCK = 6
"""How many approaches are simulated before the next decision what is missing most."""
RESULTS = Path(__file__).with_suffix(".json")
"""The results that ``--full`` keeps."""
COMMAND = "python -m vtbdrake_diagrams.satellite.studies.scan_frequency --full"
ROUNDED = 0.15
"""The share of repeated simulations that may come out differently. Registration starts where the track is, so that
rounding grows: of 136 approaches that were simulated again on a later day, four differed by more than `agree`
allows."""
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


def frequency_problem(*, tumble_deg: float, deskew: bool, starts: Sequence[int]) -> vtb.Problem:
    """Return the problem: the scan frequency with the smallest error at the bar, the largest over time and approaches.

    Args:
        tumble_deg: The tumble rate, in deg/s.
        deskew: Whether scans are corrected by the estimated motion of the target.
        starts: The seeds of the approaches.
    """
    approaches = [ApproachScenario(seed=seed, tumble_deg=tumble_deg) for seed in starts]
    return vtb.Problem(
        scenario=ApproachScenario(tumble_deg=tumble_deg, deskew=deskew),
        parameters=[vtb.Parameter("sim.sense.scanner.frequency", min(FREQUENCIES), max(FREQUENCIES), log=True)],
        quality=vtb.Quality(
            grip_error,
            of=["time", "dps.env.target.pose", "sim.sys.target.body.pose"],
            reading="worst",
            minimize=True,
        ),
        horizon=APPROACH,
        conditions=[{**approach.start().values(), "dps.env.target.patience": PATIENCE} for approach in approaches],
    )


def quantile_bounds(errors: ArrayLike) -> tuple[float, float, float]:
    """Return lower bound, estimate and upper bound of the 90 % quantile of the errors in some approaches.

    They are order statistics, whatever the distribution: of s approaches, as many as Binomial(s, 0.9) have less error
    than the quantile. A bound that takes more approaches is 0 or infinite.

    Args:
        errors: The largest error over time of each approach, in m, infinite if it failed, shape (s,).
    """
    ordered = np.concatenate([[0.0], np.sort(np.asarray(errors, dtype=float)), [inf]])  # From the first on, by rank.
    s = len(ordered) - 2
    below = binom.cdf(np.arange(s + 1), s, QUANTILE)  # P(at most k of the errors are below the quantile)
    tail = (1.0 - CONFIDENCE) / 2.0
    lower = int((below[:-1] <= tail).sum())
    upper = s + 1 - int((1.0 - below[:-1] <= tail).sum())
    return float(ordered[lower]), float(ordered[ceil(QUANTILE * s)]), float(ordered[upper])


@dataclass(frozen=True)
class Window:
    """The frequencies that suffice at a tumble rate, in Hz, as far as the approaches tell.

    Attributes:
        lower: (at least, estimate, at most) of its lower end.
        upper: (at least, estimate, at most) of its upper end. An estimate is NaN if no frequency suffices; a bound that
            the approaches cannot give is 0 or infinite, and NaN where it takes a frequency that surely suffices.
    """

    lower: tuple[float, float, float]
    upper: tuple[float, float, float]

    @property
    def is_bounded(self) -> bool:
        """Return whether some frequency surely suffices, and one below and one above surely do not."""
        return bool(np.isfinite([*self.lower, *self.upper]).all()) and self.lower[0] > 0.0

    def __str__(self) -> str:
        (least, first, sure), (sure_too, last, most) = self.lower, self.upper
        if np.isnan(first):
            return "none of the grid"
        ends = f"not at {least:g} Hz" if least else "no lower end shown"
        ends += f" and {most:g} Hz" if most < inf else ", no upper end shown"
        surely = "none surely" if np.isnan(sure_too) else f"surely {range_text(sure, sure_too)}"
        return f"{range_text(first, last)} ({surely}; {ends})"


def range_text(first: float, last: float) -> str:
    """Return a range of frequencies in Hz as text."""
    return f"{first:g} Hz" if first == last else f"{first:g} to {last:g} Hz"


def window(frequencies: Sequence[float], bounds: Sequence[tuple[float, float, float]]) -> Window:
    """Return the window of frequencies that suffice: the longest run of them whose quantile is below `TOLERANCE`.

    A frequency surely suffices if the upper bound of its quantile is below, and surely does not if the lower bound is
    above the tolerance.

    Args:
        frequencies: In Hz, increasing.
        bounds: `quantile_bounds` for each.
    """
    suffices = [estimate < TOLERANCE for _, estimate, _ in bounds]
    runs = [list(run) for good, run in groupby(range(len(bounds)), key=lambda k: suffices[k]) if good]
    if not runs:
        return Window((0.0, nan, nan), (nan, nan, inf))
    run = max(runs, key=len)
    sure = [frequencies[k] for k in run if bounds[k][2] < TOLERANCE]
    below = [frequencies[k] for k in range(run[0]) if bounds[k][0] > TOLERANCE]
    above = [frequencies[k] for k in range(run[-1] + 1, len(bounds)) if bounds[k][0] > TOLERANCE]
    return Window(
        (max(below, default=0.0), frequencies[run[0]], min(sure, default=nan)),
        (max(sure, default=nan), frequencies[run[-1]], min(above, default=inf)),
    )


RAW = "raw"
DESKEWED = "de-skewed"
Key = tuple[str, float, float]  # kind of scans, tumble rate in deg/s, frequency in Hz


@dataclass(frozen=True)
class FrequencyAnswer:
    """The errors at the bar in approaches, over kinds of scans, tumble rates and frequencies.

    Attributes:
        errors: The largest error over time of each approach from the first of `STARTS` on, in m, infinite if the
            approach failed.
    """

    errors: dict[Key, list[float]]

    def frequencies(self, kind: str, tumble: float) -> list[float]:
        """Return the frequencies that were tried, in Hz, increasing."""
        return sorted(f for k, t, f in self.errors if (k, t) == (kind, tumble))

    @property
    def tumbles(self) -> list[float]:
        """Return the tumble rates, in deg/s."""
        return sorted({tumble for _, tumble, _ in self.errors})

    @property
    def fewest(self) -> int:
        """Return the least number of approaches of a frequency."""
        return min(len(errors) for errors in self.errors.values())

    def bounds(self, kind: str, tumble: float) -> list[tuple[float, float, float]]:
        """Return the bounds of the quantile at each frequency."""
        return [quantile_bounds(self.errors[kind, tumble, f]) for f in self.frequencies(kind, tumble)]

    def window(self, kind: str, tumble: float) -> Window:
        """Return the window at a tumble rate, in deg/s."""
        return window(self.frequencies(kind, tumble), self.bounds(kind, tumble))

    @property
    def everywhere(self) -> Window:
        """Return the window of frequencies that suffice at all tumble rates, with de-skewed scans."""
        windows = [self.window(DESKEWED, tumble) for tumble in self.tumbles]
        lower, upper = (np.array([getattr(w, end) for w in windows]) for end in ("lower", "upper"))
        return Window(tuple(lower.max(axis=0).tolist()), tuple(upper.min(axis=0).tolist()))

    @property
    def follows(self) -> bool:
        """Return whether the median raw error is between once and twice the `skew`.

        That counts where the skew is larger than the tolerance and there are enough scans for a track (from 1 Hz).
        """
        ratios = [
            np.median(errors) / float(skew(frequency))
            for (kind, _, frequency), errors in self.errors.items()
            if kind == RAW and frequency >= 1.0 and skew(frequency) > TOLERANCE
        ]
        return bool(ratios) and all(1.0 < ratio < 2.0 for ratio in ratios)

    @property
    def helps(self) -> bool:
        """Return whether with de-skewed scans a lower frequency suffices, at each tumble rate."""
        lower = [[self.window(kind, tumble).lower[1] for tumble in self.tumbles] for kind in (DESKEWED, RAW)]
        return all(d < r or (isfinite(d) and isnan(r)) for d, r in zip(*lower, strict=True))

    @property
    def holds(self) -> bool:
        """Return whether the windows of all tumble rates share a frequency, have two ends, and the trend is explained.

        At each tumble rate, a frequency below the window and one above must surely not suffice.
        """
        windows = [self.window(DESKEWED, tumble) for tumble in self.tumbles]
        ends = all(w.lower[0] > 0.0 and isfinite(w.lower[1]) and w.upper[2] < inf for w in windows)
        shared = self.everywhere.lower[1] <= self.everywhere.upper[1]
        return ends and shared and self.follows and self.helps


def skew(frequency: ArrayLike) -> Array:
    """Return the error of a target that comes closer, in m, by scans that are taken for instants: v / (2 f).

    The points of a scan are 1 / (2 f) old in the mean when it is complete, so that the target seems farther away.
    """
    return CLOSING_SPEED / (2.0 * np.asarray(frequency, dtype=float))


# -- the campaign


def read_answer(path: Path = RESULTS) -> FrequencyAnswer:
    """Return the kept results."""
    results = read_results(path)
    errors = {
        (row["scans"], row["tumble_deg"], row["frequency"]): [inf if e is None else e for e in row["errors"]]
        for row in results["approaches"]
    }
    return FrequencyAnswer(errors)


def keep(answer: FrequencyAnswer, path: Path = RESULTS) -> None:
    """Write the results of the campaign so far."""
    approaches = [
        {"scans": kind, "tumble_deg": tumble, "frequency": frequency, "errors": errors}
        for (kind, tumble, frequency), errors in sorted(answer.errors.items())
    ]
    write_results(path, {"approaches": approaches}, command=COMMAND)


def next_block(errors: Mapping[Key, Sequence[float]]) -> tuple[Key, tuple[int, ...]] | None:
    """Return what is to be simulated next: a frequency, and the starts of its next `BLOCK`; None if nothing is missing.

    Every frequency gets one block, then the undecided ones get theirs up to all `STARTS`, with de-skewed scans before
    raw ones; at last the others.
    """
    keys = [(kind, tumble, f) for kind in (DESKEWED, RAW) for f in FREQUENCIES for tumble in TUMBLES]
    missing = [key for key in keys if len(errors.get(key, ())) < len(STARTS)]
    if not missing:
        return None

    def urgency(key: Key) -> tuple[int, int]:
        done, raw = errors.get(key, ()), 2 * (key[0] == RAW)
        if not done:
            return 0, raw
        lower, _, upper = quantile_bounds(done)
        return (1 + raw if lower < TOLERANCE < upper else 4), len(done)

    key = min(missing, key=urgency)
    done = len(errors.get(key, ()))
    return key, STARTS[done : done + BLOCK]


def approach_errors(key: Key, starts: Sequence[int], executor: str | Executor = "serial") -> list[float]:
    """Simulate approaches, and return the largest error over time of each, in m; infinite if it failed."""
    kind, tumble, frequency = key
    problem = frequency_problem(tumble_deg=tumble, deskew=kind == DESKEWED, starts=starts)
    sweep = problem.sweep(values=[frequency], executor=executor, progress=False)
    return [inf if rollout.failed else rollout.value for rollout in sweep.rollouts]


def continue_campaign(
    answer: FrequencyAnswer, *, blocks: int | None = None, executor: str | Executor = "serial", path: Path = RESULTS
) -> FrequencyAnswer:
    """Simulate what is missing, and keep each block.

    Args:
        answer: The results so far.
        blocks: How many blocks at most; None: all.
        executor: Runs the approaches.
        path: The file of the results.
    """
    number = 0
    while (blocks is None or number < blocks) and (block := next_block(answer.errors)) is not None:
        key, starts = block
        errors = approach_errors(key, starts, executor)
        answer = replace(answer, errors={**answer.errors, key: [*answer.errors.get(key, []), *errors]})
        keep(answer, path)
        number += 1
    return answer


def approaches_again(answer: FrequencyAnswer) -> Repetition:
    """Simulate a tenth of the kept approaches again, and return whether they come out the same, but for `ROUNDED`."""
    by_approach = {
        Approach(*key, start): error
        for key, errors in sorted(answer.errors.items())
        for start, error in zip(STARTS, errors, strict=False)
    }
    return repeat("approaches", by_approach, approach_error, agree, allowed=ROUNDED)


@dataclass(frozen=True)
class Approach:
    """An approach of the campaign.

    Attributes:
        scans: `RAW` or `DESKEWED`.
        tumble_deg: The tumble rate, in deg/s.
        frequency: The scan frequency, in Hz.
        start: Its start, of `STARTS`.
    """

    scans: str
    tumble_deg: float
    frequency: float
    start: int

    def __str__(self) -> str:
        return f"{self.scans}, {self.tumble_deg:g} deg/s, {self.frequency:g} Hz, start {self.start}"


def approach_error(approach: Approach) -> float:
    """Simulate an approach, and return its largest error over time, in m; infinite if it failed."""
    (error,) = approach_errors((approach.scans, approach.tumble_deg, approach.frequency), [approach.start])
    return error


def agree(before: float, now: float) -> bool:
    """Return whether two errors of the same approach, in m, are the same but for rounding on another processor.

    A track that is lost ends anywhere: of two errors far above the tolerance nothing more is compared.
    """
    if min(before, now) > 3.0 * TOLERANCE:
        return True
    return abs(before - now) < 0.1 * TOLERANCE


# -- pictures and words


def plot_answer(answer: FrequencyAnswer) -> Figure:
    """Draw the quantile of the error over the frequency, and the windows over the tumble rate."""
    figure = Picture(11.0, 4.2)
    left, right = figure.subplots(1, 2, width_ratios=[3, 2])
    styles = {RAW: "s--", DESKEWED: "o-"}
    rows = [(kind, tumble) for kind in styles for tumble in answer.tumbles]
    for kind, tumble in rows:
        frequencies, bounds = answer.frequencies(kind, tumble), np.array(answer.bounds(kind, tumble))
        most = [max(e for e in answer.errors[kind, tumble, f] if e < inf) for f in frequencies]
        reach = np.where(np.isfinite(bounds[:, 2]), bounds[:, 2], most)
        bars = np.clip([bounds[:, 1] - bounds[:, 0], reach - bounds[:, 1]], 0.0, None)
        color, label = f"C{answer.tumbles.index(tumble)}", f"{kind}, {tumble:g} deg/s"
        left.errorbar(frequencies, bounds[:, 1], bars, fmt=styles[kind], color=color, capsize=2, label=label)
    some = np.array(FREQUENCIES)
    left.plot(some, skew(some), ":", color="gray", label="v / (2 f)")
    left.axhline(TOLERANCE, color="black", lw=0.8)
    left.set(xscale="log", yscale="log", xlabel="scan frequency [Hz]", ylabel="error at the bar [m]")
    left.set_title(f"{QUANTILE:.0%} quantile of at least {answer.fewest} approaches")
    left.legend(fontsize="x-small")
    for row, (kind, tumble) in enumerate(rows):
        shown = answer.window(kind, tumble)
        color = f"C{answer.tumbles.index(tumble)}"
        if isfinite(shown.lower[1]):
            right.plot([shown.lower[1], shown.upper[1]], [row, row], "|-", color=color, lw=2.0, ms=12.0)
        if isfinite(shown.upper[0]):
            right.plot([shown.lower[2], shown.upper[0]], [row, row], "o-", color=color, lw=6.0)
        for f in (shown.lower[0], shown.upper[2]):
            if 0.0 < f < inf:
                right.plot(f, row, "x", color=color)
    right.set_yticks(range(len(rows)), [f"{kind}, {tumble:g} deg/s" for kind, tumble in rows])
    right.set(xscale="log", xlabel="scan frequency [Hz]", xlim=(0.4, 20.0), ylim=(-0.5, len(rows) - 0.5))
    right.set_title(f"Error below {1e3 * TOLERANCE:.1f} mm: thick surely, x surely not", fontsize="small")
    for axes in (left, right):
        finish(axes)
    return figure


def not_decided(answer: FrequencyAnswer) -> str:
    """Return in words which frequencies the approaches do not decide, or an empty text."""
    undecided = [
        f"{kind} {tumble:g} deg/s {frequency:g} Hz ({len(errors)} approaches)"
        for (kind, tumble, frequency), errors in sorted(answer.errors.items())
        if (bounds := quantile_bounds(errors))[0] < TOLERANCE < bounds[2]
    ]
    return f"Not decided: {', '.join(undecided)}. " if undecided else ""


@click.command()
@click.option("--full", is_flag=True, help="Simulate what is missing first, and keep it.")
@click.option("--blocks", type=int, help="How many blocks of approaches at most; by default all that are missing.")
@click.option("--figure", default="scan_frequency.png", help="File of the picture.", show_default=True)
def main(full: bool, blocks: int | None, figure: str) -> None:
    """Answer O2, and draw the answer."""
    result = read_answer() if RESULTS.exists() else FrequencyAnswer({})
    if full:
        with ProcessExecutor(2) as executor:
            result = continue_campaign(result, blocks=blocks, executor=executor)
    click.echo(f"{QUANTILE:.0%} quantile of the error at the bar [mm], [lower, upper bound], approaches")
    for kind in (RAW, DESKEWED):
        for tumble in result.tumbles:
            frequencies = result.frequencies(kind, tumble)
            for f, (lower, quantile, upper) in zip(frequencies, result.bounds(kind, tumble), strict=True):
                count = len(result.errors[kind, tumble, f])
                numbers = f"{1e3 * quantile:6.1f} [{1e3 * lower:.1f}, {1e3 * upper:.1f}] {count}"
                click.echo(f"{kind:>10} {tumble:4g} deg/s {f:5g} Hz {numbers}")
            click.echo(f"{kind:>10} {tumble:4g} deg/s: {result.window(kind, tumble)}")
    click.echo(not_decided(result))
    click.echo(f"follows: {result.follows}; helps: {result.helps}; holds: {result.holds}")
    plot_answer(result).savefig(figure, dpi=110)


if __name__ == "__main__":
    # Under its own name, so that worker processes find its functions.
    from vtbdrake_diagrams.satellite.studies.scan_frequency import main as program

    program(prog_name="python -m vtbdrake_diagrams.satellite.studies.scan_frequency")
