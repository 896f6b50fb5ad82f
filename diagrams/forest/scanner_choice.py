"""Which height of the scanner and which number of beams let the carrier know best where it is?

``python -m vtbdrake_diagrams.forest.scanner_choice [--full]`` asks the finished testbed: the same forests, the same
drives, as many rays per second; the error of the present pose counts. It prints the grid, and draws it.

What could bend the answer was fixed before the first result was seen: the grid, the forests, whose seeds begin at
`SEED`, the time (`HORIZON`), and what counts: the error of the position, averaged over time and forests. A carrier
without a pose counts as `UNKNOWN` off. The map is exact: the errors of a map would be the same for all scanners, and
larger than the differences between them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import click
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

import vtbdrake as vtb
from vtbdrake.cli.output import table
from vtbdrake.rollout import Executor, ProcessExecutor
from vtbdrake.visualization.plots import Picture, draw_mesh, finish, mark_best
from vtbdrake_diagrams.forest.scenario import ForestScenario

Array = NDArray[np.float64]

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


def distance_off(time: float, position: Array, told: float, truth: Array, velocity: Array) -> float:
    """Return how far the position that the DPS tells is from the true one at that time, in m; NaN without a pose.

    The DPS told it up to one of its periods ago. How far the carrier has come since then is no error.

    Args:
        time: In s.
        position: Of the DPS, (2,) in m; NaN without a pose.
        told: The time for which it holds, in s.
        truth: The true pose of the carrier, (6,) in m and rad.
        velocity: Its true velocity, angular (rad/s) and linear (m/s), (6,).
    """
    place = np.asarray(truth)[:2] - (time - float(told)) * np.asarray(velocity)[3:5]
    return float(np.hypot(*(np.asarray(position) - place)))


def position_error(time: float, position: Array, told: float, truth: Array, velocity: Array) -> float:
    """Return `distance_off`, but 0 before `SETTLING`, and `UNKNOWN` if it is larger or if there is no pose."""
    if time < SETTLING:
        return 0.0
    error = distance_off(time, position, told, truth, velocity)
    return min(error, UNKNOWN) if np.isfinite(error) else UNKNOWN


def scanner_problem(beams: int, *, seeds: Sequence[int]) -> vtb.Problem:
    """Return the problem: the height with the least error, in the mean over time and forests.

    Args:
        beams: The number of beams.
        seeds: Those of the forests.
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
    from vtbdrake_diagrams.forest.scanner_choice import main as program

    program(prog_name="python -m vtbdrake_diagrams.forest.scanner_choice")
