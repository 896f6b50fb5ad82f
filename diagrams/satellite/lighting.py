"""Application O3: which parameters of the robot are best under different lighting?

The docking camera alone leads the capture. What is decided are the robot's controller (how fast it closes in, and its
gains), its filter (how much the target's motion may change) and its detector of markers (the threshold). The lights are
the sun in front of the target, where the servicer throws its shadow on it; the sun beside it, and grazing its face; and
the sun behind it, where only a lamp on the camera helps. The cost is the time until the fingers hold the bar.

What could bend the answer was fixed before the candidates were judged. (The grid was laid anew after a first look at
the starts 0 and 100, which therefore do not count.)

* the lights, `LIGHTS`;
* the candidates: the grid `GRID`, in which the defaults of the robot are; the short version takes those of `SHORT`;
* the starts: candidates are chosen on `CHOSEN_ON`, and the choice is compared with the default on the others,
  `CHECKED_ON`;
* a capture that has not succeeded by `HORIZON`, or is aborted, costs `FAILURE`.

The default run chooses among the candidates of `SHORT` on one start: a first look, which never counts as an answer that
holds. ``--starts 8`` does so on eight, and ``--full`` among all candidates on eight, which takes hours.

``python -m vtbdrake_diagrams.satellite.lighting [--starts N] [--full]`` prints the answer and draws it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import click
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from pydrake.systems.framework import Diagram

import vtbdrake as vtb
from vtbdrake.rollout import Executor, ProcessExecutor
from vtbdrake.state.systems import pose_to_array
from vtbdrake.visualization.plots import Picture, finish
from vtbdrake.visualization.study_plots import BEST
from vtbdrake_diagrams.answers import Answer
from vtbdrake_diagrams.satellite.scenario import SatelliteScenario
from vtbdrake_diagrams.satellite.start import random_start
from vtbdrake_diagrams.satellite.supervisor import HOLD, RETREAT

Array = NDArray[np.float64]

HORIZON = 36.0
"""How long a capture may take, in s. With the default and the sun beside it takes half of it."""
FAILURE = 60.0
"""What a capture without success costs, in s."""
SAMPLE_PERIOD = 0.2
"""Of the cost, in s."""

_DIRECTION, _LAMP = "sim.env.light.direction", "sim.sense.docking_camera.lamp"


def _beside(angle_deg: float) -> tuple[float, float, float]:
    """Return the direction of sunlight at an angle from the normal of the face that the camera sees."""
    return float(np.cos(np.radians(angle_deg))), float(np.sin(np.radians(angle_deg))), 0.0


LIGHTS: dict[str, dict[str, Any]] = {
    "front, own shadow": {_DIRECTION: (1.0, 0.25, -0.25), _LAMP: 0.0},
    "beside, 70 deg": {_DIRECTION: _beside(70.0), _LAMP: 0.0},
    "grazing, 86 deg": {_DIRECTION: _beside(86.0), _LAMP: 0.0},
    "behind, lamp": {_DIRECTION: (-0.9, 0.3, -0.3), _LAMP: 2.0},
}
"""The conditions by name."""

CHOSEN_ON, CHECKED_ON = tuple(range(1, 9)), tuple(range(101, 109))
"""Start poses (seeds) for the choice, and for the comparison; the short version takes the first of each."""


@dataclass(frozen=True)
class Settings:
    """What is decided: a candidate.

    Attributes:
        closing_speed: The speed along the fixture's axis, in m/s.
        gain: The gains of position and orientation of the resolved-rate control, in 1/s.
        agility: Factor of the tracker's process noise, of rates and velocities.
        threshold: That of the marker detector, in 8-bit counts.
    """

    closing_speed: float = 0.06
    gain: float = 1.0
    agility: float = 1.0
    threshold: float = 7.0

    def entries(self) -> tuple[float, ...]:
        """Return the values of `PARAMETERS`."""
        noise = 1e-3 * self.agility
        return self.closing_speed, self.gain, self.gain, noise, noise, self.threshold

    def __str__(self) -> str:
        return (
            f"{self.closing_speed:g} m/s, gains {self.gain:g}/s, process noise x{self.agility:g}, "
            f"threshold {self.threshold:g}"
        )


PARAMETERS = (
    vtb.Parameter("dps.impl.supervisor.closing_speed", 0.02, 0.15),
    vtb.Parameter("dps.impl.controller.position_gain", 0.2, 4.0),
    vtb.Parameter("dps.impl.controller.orientation_gain", 0.2, 4.0),
    vtb.Parameter("dps.env.target.rate_noise", 1e-4, 1e-2),
    vtb.Parameter("dps.env.target.velocity_noise", 1e-4, 1e-2),
    vtb.Parameter("scenario.threshold", 1.0, 15.0),
)
DEFAULT = Settings()
GRID = tuple(Settings(*values) for values in product((0.06, 0.075, 0.09), (1.0, 1.5), (1.0, 0.3), (7.0, 3.0)))
SHORT = (
    DEFAULT,
    Settings(closing_speed=0.075),
    Settings(closing_speed=0.075, agility=0.3),
    Settings(closing_speed=0.075, gain=1.5, agility=0.3, threshold=3.0),
)


@dataclass
class LightingScenario(SatelliteScenario):
    """A capture that the camera leads alone; the threshold of its marker detector is a field."""

    perception: str = "camera"
    # What the detector's adaptive threshold subtracts from the mean, see `MarkerDetector`.
    threshold: float = 7.0

    def make_dps(self) -> Diagram:
        detector = replace(self.evaluation.detector, threshold=self.threshold)
        chosen = replace(self, evaluation=replace(self.evaluation, detector=detector))
        return super(LightingScenario, chosen).make_dps()


def time_to_grip(mode: float, time: float) -> float:
    """Return the cost: the time of the DPS if the fingers hold the bar, else `FAILURE`."""
    return time if mode in (RETREAT, HOLD) else FAILURE


def condition(light: str, seed: int) -> dict[str, Any]:
    """Return a light, and what makes the capture start as that of a scenario with this seed does."""
    own = LightingScenario()
    start = random_start(seed, tumble=np.radians(own.tumble_deg), distance=own.distance)
    return {
        **LIGHTS[light],
        "sim.sys.target.body.pose": pose_to_array(start.X_WT),
        "sim.env.release.velocity": np.concatenate((start.w_WT, start.v_WT)),
    }


def lighting_problem(seeds: Sequence[int]) -> vtb.Problem:
    """State the question: the worst case over all lights and starts. A rollout ends when the bar is held."""
    return vtb.Problem(
        scenario=LightingScenario(),
        parameters=list(PARAMETERS),
        quality=vtb.Quality(time_to_grip, of=["dps.impl.supervisor.mode", "dps.env.base.time"], minimize=True),
        horizon=HORIZON,
        sample_period=SAMPLE_PERIOD,
        threshold=FAILURE,
        conditions=[condition(light, seed) for light in LIGHTS for seed in seeds],
        risk="worst",
    )


def times_to_grip(candidates: Sequence[Settings], *, seeds: Sequence[int], executor: Executor) -> Array:
    """Return the cost of each candidate under each light from each start in s, shape (n, lights, starts)."""
    sweep = lighting_problem(seeds).sweep(
        values=[candidate.entries() for candidate in candidates], executor=executor, progress=False
    )
    costs = [FAILURE if rollout.failed else rollout.value for rollout in sweep.rollouts]
    return np.reshape(costs, (len(candidates), len(LIGHTS), len(seeds)))


@dataclass(frozen=True)
class LightingAnswer:
    """The answer to O3.

    Attributes:
        candidates: What was tried; the first is the default.
        costs: Of each under each light from each start, in s, shape (n, lights, starts).
        checked: Of the default and of the robust choice, from other starts, shape (2, lights, starts).
    """

    candidates: tuple[Settings, ...]
    costs: Array
    checked: Array

    @property
    def by_light(self) -> Array:
        """Return the mean cost over the starts, shape (n, lights)."""
        return self.costs.mean(axis=2)

    @property
    def robust(self) -> int:
        """Return the number of the candidate that is best in its worst light; of equal ones, the best in the mean."""
        order = np.lexsort((self.by_light.mean(axis=1), self.by_light.max(axis=1)))
        return int(order[0])

    @property
    def best(self) -> dict[str, Settings]:
        """Return the best candidate for each light."""
        return {light: self.candidates[int(np.argmin(self.by_light[:, k]))] for k, light in enumerate(LIGHTS)}

    @property
    def holds(self) -> bool:
        """Return whether, from the other starts, the choice is no worse in any light and better in the worst."""
        default, robust = self.checked.mean(axis=2)
        return bool((robust <= default).all() and robust.max() < default.max())


def find_settings(
    candidates: Sequence[Settings], *, seeds: Sequence[int], others: Sequence[int], executor: Executor
) -> LightingAnswer:
    """Choose among candidates on some starts, and compare the choice with the default on others.

    Args:
        candidates: What is tried; the first is the default.
        seeds: Start poses for the choice.
        others: Start poses for the comparison.
        executor: Runs the rollouts.
    """
    costs = times_to_grip(candidates, seeds=seeds, executor=executor)
    chosen = LightingAnswer(tuple(candidates), costs, np.empty(0)).robust
    checked = times_to_grip([candidates[0], candidates[chosen]], seeds=others, executor=executor)
    return LightingAnswer(tuple(candidates), costs, checked)


def plot_answer(answer: LightingAnswer) -> Figure:
    """Draw the cost of every candidate over the lights, with the default and the robust choice.

    Left: the mean over the starts on which was chosen, one line per candidate. Right: the two from the other starts.
    """
    figure = Picture(11.0, 4.2)
    chosen_axes, checked_axes = figure.subplots(1, 2, sharey=True)
    lights = range(len(LIGHTS))
    for costs in answer.by_light:
        chosen_axes.plot(lights, costs, color="0.8", lw=1.0)
    named = {"default": (0, "C0"), "robust choice": (answer.robust, BEST)}
    for name, (number, color) in named.items():
        label = f"{name}: {answer.candidates[number]}"
        chosen_axes.plot(lights, answer.by_light[number], "o-", color=color, label=label)
    for costs, (name, (_, color)) in zip(answer.checked, named.items(), strict=True):
        checked_axes.plot(lights, costs.mean(axis=1), "o-", color=color, label=name)
        checked_axes.plot(np.repeat(lights, costs.shape[1]), costs.ravel(), ".", color=color, alpha=0.5)
    titles = f"start poses for the choice: {answer.costs.shape[2]}", f"other start poses: {answer.checked.shape[2]}"
    for axes, title in zip((chosen_axes, checked_axes), titles, strict=True):
        axes.set(ylabel="time to grip [s]", title=title)
        axes.set_xticks(lights, [light.replace(", ", ",\n") for light in LIGHTS])
        axes.axhline(FAILURE, color="0.5", ls=":", lw=1.0)
        axes.legend(fontsize="x-small")
        finish(axes)
    return figure


def answer_lighting(*, full: bool = False, starts: int = 1) -> LightingAnswer:
    """Answer O3 with two worker processes.

    Args:
        full: Whether to try `GRID` on all starts, instead of `SHORT` on some.
        starts: On how many, at most 8.
    """
    candidates = (DEFAULT, *(settings for settings in GRID if settings != DEFAULT)) if full else SHORT
    count = len(CHOSEN_ON) if full else starts
    with ProcessExecutor(2) as executor:
        return find_settings(candidates, seeds=CHOSEN_ON[:count], others=CHECKED_ON[:count], executor=executor)


def _table(answer: LightingAnswer) -> str:
    """Return the costs from the other starts by light, of the default and of the choice."""
    default, robust = answer.checked.mean(axis=2)
    cells = zip(LIGHTS, default.tolist(), robust.tolist(), strict=True)
    return "; ".join(f"{light}: {a:.1f} s by default, {b:.1f} s" for light, a, b in cells)


def lighting(full: bool) -> Answer:
    """Answer O3: which parameters of the robot are best under different lighting?"""
    answer = answer_lighting(full=full)
    enough = answer.checked.shape[2] >= len(CHECKED_ON)
    best = "; ".join(f"{light}: {settings}" for light, settings in answer.best.items())
    return Answer(
        id="O3",
        question="Which controller parameters are best under different lighting?",
        answer=f"{answer.candidates[answer.robust]}: {answer.checked[1].mean(axis=1).max():.1f} s to grip in the worst "
        f"light, by default {answer.checked[0].mean(axis=1).max():.1f} s",
        unit="",
        interval=None,
        paper="none given",
        holds=answer.holds and enough,
        note=f"{'' if enough else 'A first look, too few starts to hold. '}"
        f"Of {len(answer.candidates)} candidates, chosen on {answer.costs.shape[2]} start(s), compared on "
        f"{answer.checked.shape[2]} other(s); without success {FAILURE:g} s. {_table(answer)}. Best for each light: "
        f"{best}",
    )


@click.command()
@click.option("--full", is_flag=True, help="All candidates, from all starts.")
@click.option("--starts", type=click.IntRange(1, len(CHOSEN_ON)), default=1, help="How many starts, without --full.")
@click.option("--figure", default="lighting.png", help="File of the picture.", show_default=True)
def main(full: bool, starts: int, figure: str) -> None:
    """Answer O3, and draw the answer."""
    answer = answer_lighting(full=full, starts=starts)
    for settings, costs in zip(answer.candidates, answer.by_light, strict=True):
        click.echo(f"{'  '.join(f'{cost:5.1f}' for cost in costs)}  {settings}")
    click.echo(f"robust: {answer.candidates[answer.robust]}; {_table(answer)}; holds: {answer.holds}")
    plot_answer(answer).savefig(figure, dpi=110)


if __name__ == "__main__":
    # Under its own name, so that worker processes find its functions.
    from vtbdrake_diagrams.satellite.lighting import main as program

    program(prog_name="python -m vtbdrake_diagrams.satellite.lighting")
