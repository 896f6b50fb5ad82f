"""Which height of the scanner and which number of beams give the least error of the position?

``python -m vtbdrake_diagrams.forest.studies.scanner_choice [--full]`` compares them in the finished testbed: in the
same forests, on the same drives, with as many rays per second. It prints the errors over the grid, and draws them.

To avoid bias, these were fixed before the first result was seen: the grid; the forests, whose seeds begin at `SEED`;
the duration of a drive (`HORIZON`); and the criterion, the error of the present position, averaged over time and
forests. Without a pose, the error is `UNKNOWN`. The map is exact: the errors of a map would be the same for all
scanners, and larger than the differences between them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import click
import numpy as np
from matplotlib.figure import Figure

import vtbdrake as vtb
from vtbdrake.cli.output import table
from vtbdrake.common.arrays import Array
from vtbdrake.rollout import Executor, ProcessExecutor
from vtbdrake.visualization.plots import Picture, draw_mesh, finish, mark_best
from vtbdrake_diagrams.forest.scenario import ForestScenario

SEED = 300_000
HORIZON = 10.0
"""The length of a drive, in s."""
SETTLING = 2.0
"""The error counts from this time on, in s."""
UNKNOWN = 1.0
"""The error of a carrier that does not know its pose, in m [assumed]."""
HEIGHTS = (1.5, 2.0, 3.0, 4.5)
"""The heights of the scanner over the ground that are compared, in m."""
BEAMS = (4, 8, 16, 32)
"""The numbers of beams that are compared, with the same field of view and number of rays per second."""
COMPARED = (
    "time",
    "dps.env.pose.position",
    "dps.env.pose.time",
    "sim.sys.carrier.base.pose",
    "sim.sys.carrier.base.velocity",
)
"""The addresses of the arguments of `position_error`."""


def position_error(time: float, position: Array, stamp: float, truth: Array, velocity: Array) -> float:
    """Return the error of the position of the DPS in m: 0 before `SETTLING`, at most `UNKNOWN`, also without a pose.

    The position is up to one period of the DPS old. The motion of the carrier since then does not count.

    Args:
        time: The time in s.
        position: The position by the DPS, (2,) in m; NaN without a pose.
        stamp: The time in s for which this position holds.
        truth: The true pose of the carrier, (6,) in m and rad.
        velocity: The true velocity of the carrier, angular (rad/s) and linear (m/s), (6,).
    """
    if time < SETTLING:
        return 0.0
    place = np.asarray(truth)[:2] - (time - float(stamp)) * np.asarray(velocity)[3:5]
    error = float(np.hypot(*(np.asarray(position) - place)))
    return min(error, UNKNOWN) if np.isfinite(error) else UNKNOWN


def scanner_problem(beams: int, *, seeds: Sequence[int]) -> vtb.Problem:
    """Return the problem: the height with the least error, in the mean over time and forests.

    Args:
        beams: The number of beams.
        seeds: The seeds of the forests.
    """
    scenario = ForestScenario(map="exact")
    scenario.scanner.rows = beams
    return vtb.Problem(
        scenario=scenario,
        parameters=[vtb.Parameter("scenario.scanner_height", min(HEIGHTS), max(HEIGHTS))],
        quality=vtb.Quality(
            position_error,
            of=COMPARED,
            reading="integral",
            minimize=True,
        ),
        horizon=HORIZON,
        conditions=[{"scenario.seed": seed} for seed in seeds],
        risk="mean",
    )


@dataclass(frozen=True)
class ScannerAnswer:
    """The errors over the grid.

    Attributes:
        errors: Mean errors of the position in m, by height, number of beams and forest, shape (m, n, k).
    """

    errors: Array

    @property
    def mean(self) -> Array:
        """The mean over the forests, shape (m, n)."""
        return self.errors.mean(axis=2)

    @property
    def best(self) -> tuple[float, int]:
        """Height in m and number of beams with the least mean error."""
        row, column = np.unravel_index(np.argmin(self.mean), self.mean.shape)
        return HEIGHTS[row], BEAMS[column]


def find_scanner(seeds: Sequence[int], *, executor: Executor) -> ScannerAnswer:
    """Determine the errors over the grid of `HEIGHTS` and `BEAMS`, in the forests of some seeds."""
    columns = []
    for beams in BEAMS:
        problem = scanner_problem(beams, seeds=seeds)
        sweep = problem.sweep(values=[(height,) for height in HEIGHTS], executor=executor, progress=False)
        errors = np.array([rollout.value for rollout in sweep.rollouts]) / (HORIZON - SETTLING)
        columns.append(errors.reshape(len(HEIGHTS), len(seeds)))
    return ScannerAnswer(np.stack(columns, axis=1))


def plot_answer(answer: ScannerAnswer) -> Figure:
    """Draw the mean error over height and number of beams."""
    figure = Picture(6.0, 4.2)
    axes = figure.subplots()
    columns = np.arange(len(BEAMS), dtype=float)
    figure.colorbar(draw_mesh(axes, columns, np.array(HEIGHTS), 1e3 * answer.mean), ax=axes, label="mean error [mm]")
    height, beams = answer.best
    mark_best(axes, float(BEAMS.index(beams)), height)
    axes.set_xticks(columns, [str(beams) for beams in BEAMS])
    axes.set(xlabel="beams", ylabel="height [m]", title="Which scanner localizes best?")
    finish(axes)
    return figure


@click.command()
@click.option("--full", is_flag=True, help="Eight forests instead of two.")
@click.option("--figure", default="scanner_choice.png", help="File of the picture.", show_default=True)
def main(full: bool, figure: str) -> None:
    """Find height and number of beams, and draw the errors."""
    with ProcessExecutor(2) as executor:
        answer = find_scanner(range(SEED, SEED + (8 if full else 2)), executor=executor)
    rows = [
        (f"{height:g} m", *(f"{1e3 * error:.1f}" for error in errors))
        for height, errors in zip(HEIGHTS, answer.mean, strict=True)
    ]
    click.echo(table(("mean error [mm]", *(f"{beams} beams" for beams in BEAMS)), rows))
    spread = answer.errors.std(axis=2, ddof=1) / np.sqrt(answer.errors.shape[2])
    click.echo(f"standard error over the forests: {1e3 * float(np.median(spread)):.1f} mm (median)")
    height, beams = answer.best
    click.echo(f"least: {height:g} m, {beams} beams")
    plot_answer(answer).savefig(figure, dpi=110)


if __name__ == "__main__":
    # Under its own name, so that worker processes find its functions.
    from vtbdrake_diagrams.forest.studies.scanner_choice import main as program

    program(prog_name="python -m vtbdrake_diagrams.forest.studies.scanner_choice")
