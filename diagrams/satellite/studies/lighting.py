"""Application O3: which parameters of the robot are best under different lighting?

The docking camera alone leads the capture. What is decided are the robot's controller (how fast the gripper comes and
closes in, and the gains), its filter (how much the target's motion may change), its detector of markers (the threshold)
and the exposure of its camera. The lights are the sun in front of the target, where the servicer throws its shadow on
it; the sun beside it, and grazing its face; and the sun behind it, where only a lamp on the camera helps. The cost is
the time until the fingers hold the bar; the error of the bar that is perceived then has a bound, `ACCURACY`, so that
time is not bought with accuracy.

The choices that influence the answer were fixed before the candidates were judged:

* the lights, `LIGHTS`;
* the candidates, `CANDIDATES`; the first are the defaults of the robot;
* the starts: candidates are chosen on `CHOSEN_ON`, and the choice is compared with the default on others, `CHECKED_ON`,
  whose captures had not been looked at before;
* the accuracy that a choice must keep, `ACCURACY`;
* a capture that has not succeeded by `HORIZON`, or is aborted, costs `FAILURE`.

These choices replace earlier ones, twice, and starts that had been looked at are not used again. First the servicer had
no wheels: most failures were not due to the light, but to the arm's reaction, which turned the base until the target
left the image. Then the arm was as abrupt as its gains made it: wheels saturated, twice the speed was the answer, and
the bar was perceived 17 mm off. Now the arm moves as the wheels allow (see `ArmController`), accuracy is a constraint,
and pixels saturate as a camera's do, so that long exposures cost markers in full sun: after they had failed on
the start for the choice, the candidates of 1.5 and 2 and the lower threshold were added. Gains of 2/s are left out:
with them the arm asks the wheels for more than they have, and some captures are aborted.

The choice takes minutes. So the default run takes its result `CHOICE`, and compares it with the default of the robot,
from all starts of `CHECKED_ON`; ``--full`` repeats the choice first.

``python -m vtbdrake_diagrams.satellite.studies.lighting [--starts N] [--full]`` prints the answer and draws it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import click
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from pydrake.systems.framework import Diagram

import vtbdrake as vtb
from vtbdrake.common.arrays import Array
from vtbdrake.rollout import Executor, ProcessExecutor, RolloutRunner, RolloutTask
from vtbdrake.state.systems import pose_from_array, pose_to_array
from vtbdrake.visualization.plots import Picture, finish
from vtbdrake.visualization.study_plots import BEST
from vtbdrake_diagrams.answers import Answer
from vtbdrake_diagrams.satellite.bodies import Target
from vtbdrake_diagrams.satellite.relative_motion import Relative
from vtbdrake_diagrams.satellite.scenario import SatelliteScenario
from vtbdrake_diagrams.satellite.start import random_start
from vtbdrake_diagrams.satellite.supervisor import Mode

HORIZON = 36.0
"""How long a capture may take, in s. With the default and the sun beside it takes half of it."""
FAILURE = 60.0
"""What a capture without success costs, in s."""
ACCURACY = 0.006
"""The largest mean error of the perceived bar at the grip, in any light, in m: half of what the supervisor allows the
gripper to be off (``grip_tolerance``), since that comes on top."""
SAMPLE_PERIOD = 0.2
"""Sample period of the cost, in s."""
RECORDED = ("sim.sys.servicer.base.pose", "sim.sys.target.body.pose", "dps.impl.relative.relative")
"""What the error of the bar is found from: the true poses, and a `Relative`."""

TELLING = 0.5
"""The least difference of mean times that means anything, in s: the cost has a period of 0.2 s."""

_DIRECTION = "sim.env.light.direction"
_LAMP = "sim.sense.docking_camera.lamp"


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

CHOSEN_ON = (21,)
"""Start poses (seeds) for the choice."""
CHECKED_ON = (121, 122, 123)
"""Start poses (seeds) for the comparison."""


@dataclass(frozen=True)
class Settings:
    """The parameters of the robot that are decided: a candidate.

    Attributes:
        speed: The largest speed at which the gripper corrects its position, in m/s, also on the approach.
        closing_speed: The speed along the fixture's axis, in m/s.
        gain: The gains of position and orientation of the resolved-rate control, in 1/s.
        agility: Factor of the tracker's process noise, of rates and velocities.
        exposure: The exposure of the camera; at 1 a white surface in the sun is just not saturated.
        threshold: The threshold of the marker detector, in 8-bit counts.
    """

    speed: float = 0.12
    closing_speed: float = 0.06
    gain: float = 1.0
    agility: float = 1.0
    exposure: float = 1.0
    threshold: float = 7.0

    def entries(self) -> tuple[float, ...]:
        """Return the values of `PARAMETERS`."""
        noise = 1e-3 * self.agility
        return self.speed, self.closing_speed, self.gain, self.gain, noise, noise, self.exposure, self.threshold

    def __str__(self) -> str:
        return (
            f"{self.speed:g} and {self.closing_speed:g} m/s, gains {self.gain:g}/s, process noise x{self.agility:g}, "
            f"exposure {self.exposure:g}, threshold {self.threshold:g}"
        )


PARAMETERS = (
    vtb.Parameter("dps.impl.controller.speed", 0.05, 0.5),
    vtb.Parameter("dps.impl.supervisor.closing_speed", 0.02, 0.15),
    vtb.Parameter("dps.impl.controller.position_gain", 0.2, 4.0),
    vtb.Parameter("dps.impl.controller.orientation_gain", 0.2, 4.0),
    vtb.Parameter("dps.env.target.rate_noise", 1e-4, 1e-2),
    vtb.Parameter("dps.env.target.velocity_noise", 1e-4, 1e-2),
    vtb.Parameter("sim.sense.docking_camera.exposure", 0.1, 30.0),
    vtb.Parameter("scenario.threshold", 1.0, 15.0),
)
DEFAULT = Settings()
CANDIDATES = (
    DEFAULT,
    replace(DEFAULT, exposure=1.5),
    replace(DEFAULT, exposure=2.0),
    replace(DEFAULT, exposure=3.0),
    replace(DEFAULT, threshold=3.0),
    Settings(speed=0.16, closing_speed=0.09, exposure=3.0),
)
CHOICE = replace(DEFAULT, threshold=3.0)
"""What ``--full`` has chosen on `CHOSEN_ON`."""


@dataclass
class LightingScenario(SatelliteScenario):
    """A capture that the camera leads alone; the threshold of its marker detector is a field."""

    perception: str = "camera"
    # Without them the arm's reaction turns the base, until the target leaves the image.
    wheels: bool = True
    # Slow, because images are what a capture costs.
    camera_fps: float = 2.0
    # What the detector's adaptive threshold subtracts from the mean, see `MarkerDetectorConfig`.
    threshold: float = 7.0

    def make_dps(self) -> Diagram:
        detector = replace(self.evaluation.detector, threshold=self.threshold)
        scenario = replace(self, evaluation=replace(self.evaluation, detector=detector))
        return super(LightingScenario, scenario).make_dps()


def time_to_grip(mode: float, time: float) -> float:
    """Return the cost: the time of the DPS if the fingers hold the bar, else `FAILURE`."""
    return time if mode in (Mode.RETREAT, Mode.HOLD) else FAILURE


def condition(light: str, seed: int) -> dict[str, Any]:
    """Return a light, and the values that make the capture start as in a scenario with this seed."""
    scenario = LightingScenario()
    start = random_start(seed, tumble=np.radians(scenario.tumble_deg), distance=scenario.distance)
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


def bar_error(record: Mapping[str, Any]) -> float:
    """Return how far the bar is at the end from where the DPS believes it, seen from the base, in m.

    Args:
        record: What was recorded of a rollout, with the addresses of `RECORDED`.
    """
    base, target, relative = (record[address][-1] for address in RECORDED)
    X_BT = pose_from_array(base).InvertAndCompose(pose_from_array(target))
    return float(np.linalg.norm(X_BT @ Target().X_TH.translation() - Relative(relative).p_BH))


def guided_grips(
    scenario: SatelliteScenario, starts: Sequence[Mapping[str, Any]], *, horizon: float
) -> tuple[Array, Array]:
    """Simulate captures from some starts.

    Args:
        scenario: The satellite, with what guides it.
        starts: The values of the starts by address.
        horizon: How long a capture may take, in s.

    Returns:
        When the fingers held the bar, in s, `FAILURE` if they never did, and how far the bar was from where the DPS
        believed it then, in m, NaN without success; both of shape (starts,).
    """
    task = RolloutTask(
        scenario=scenario,
        horizon=horizon,
        quality=vtb.Quality(time_to_grip, of=["dps.impl.supervisor.mode", "dps.env.base.time"], minimize=True),
        threshold=FAILURE,
        sample_period=0.2,
        record=RECORDED,
    )
    runner = RolloutRunner(task, scenario.build())
    rollouts = [runner.run(start) for start in starts]
    times = [FAILURE if rollout.failed else rollout.value for rollout in rollouts]
    errors = [bar_error(r.record) if t < FAILURE else np.nan for r, t in zip(rollouts, times, strict=True)]
    return np.array(times), np.array(errors)


@dataclass(frozen=True)
class Captures:
    """The results of the captures with some settings.

    Attributes:
        times: The cost of each of the settings under each light from each start, in s, shape (n, lights, starts).
        errors: The error of the bar when it was held, in m, likewise; NaN without success.
    """

    times: Array
    errors: Array

    @property
    def by_light(self) -> Array:
        """Return the mean cost over the starts, shape (n, lights)."""
        return self.times.mean(axis=2)

    @property
    def failures(self) -> Array:
        """Return how many captures did not succeed, shape (n, lights)."""
        return (self.times >= FAILURE).sum(axis=2)

    @property
    def error_by_light(self) -> Array:
        """Return the mean error of the captures that succeeded, in m, shape (n, lights); NaN if none did."""
        succeeded = np.isfinite(self.errors).sum(axis=2)
        return np.nansum(self.errors, axis=2) / np.where(succeeded, succeeded, np.nan)

    @property
    def accurate(self) -> NDArray[np.bool_]:
        """Return whether the mean error is within `ACCURACY` in every light with a success, shape (n,)."""
        return ~(self.error_by_light > ACCURACY).any(axis=1)

    @property
    def robust(self) -> int:
        """Return the number of the accurate settings that are best in their worst light; of equal ones, in the mean.

        If none is accurate, it is the best of all.
        """
        order = np.lexsort((self.by_light.mean(axis=1), self.by_light.max(axis=1), ~self.accurate))
        return int(order[0])


def capture_all(candidates: Sequence[Settings], *, seeds: Sequence[int], executor: Executor) -> Captures:
    """Simulate a capture with each candidate under each light from each start."""
    sweep = lighting_problem(seeds).sweep(
        values=[candidate.entries() for candidate in candidates], executor=executor, record=RECORDED, progress=False
    )
    times = [FAILURE if rollout.failed else rollout.value for rollout in sweep.rollouts]
    errors = [
        bar_error(rollout.record) if time < FAILURE else np.nan
        for rollout, time in zip(sweep.rollouts, times, strict=True)
    ]
    shape = len(candidates), len(LIGHTS), len(seeds)
    return Captures(np.reshape(times, shape), np.reshape(errors, shape))


@dataclass(frozen=True)
class LightingAnswer:
    """The answer to O3.

    Attributes:
        choice: The settings that are best in their worst light.
        checked: The captures with the default and with the choice, from the starts for the comparison.
        candidates: The candidates of the choice; empty if `CHOICE` was taken.
        tried: The captures with these, from the starts for the choice.
    """

    choice: Settings
    checked: Captures
    candidates: tuple[Settings, ...] = ()
    tried: Captures | None = None

    @property
    def best(self) -> dict[str, Settings]:
        """Return the best of the candidates for each light; nothing if none were tried."""
        if self.tried is None:
            return {}
        numbers = self.tried.by_light.argmin(axis=0).tolist()
        return {light: self.candidates[number] for light, number in zip(LIGHTS, numbers, strict=True)}

    @property
    def holds(self) -> bool:
        """Return whether, from the other starts, the choice is accurate, no worse in any light, better in the worst."""
        default, robust = self.checked.by_light
        no_worse = bool((robust <= default + TELLING).all())
        return no_worse and bool(robust.max() < default.max() - TELLING) and bool(self.checked.accurate[1])


def compare(choice: Settings, *, seeds: Sequence[int], executor: Executor) -> LightingAnswer:
    """Compare a choice with the default."""
    return LightingAnswer(choice, capture_all([DEFAULT, choice], seeds=seeds, executor=executor))


def find_settings(
    candidates: Sequence[Settings], *, seeds: Sequence[int], check_seeds: Sequence[int], executor: Executor
) -> LightingAnswer:
    """Choose among candidates on some starts, and compare the choice with the default on others.

    Args:
        candidates: The candidates.
        seeds: Start poses for the choice.
        check_seeds: Start poses for the comparison.
        executor: Runs the rollouts.
    """
    tried = capture_all(candidates, seeds=seeds, executor=executor)
    comparison = compare(candidates[tried.robust], seeds=check_seeds, executor=executor)
    return replace(comparison, candidates=tuple(candidates), tried=tried)


def plot_answer(answer: LightingAnswer) -> Figure:
    """Draw the cost over the lights, of the default and of the choice, from the starts for the comparison.

    If candidates were tried, they are on the left: the mean over the starts for the choice, one line per candidate.
    """
    lights = range(len(LIGHTS))
    figure = Picture(11.0 if answer.tried else 6.0, 4.2)
    *left, right = figure.subplots(1, 2 if answer.tried else 1, sharey=True, squeeze=False)[0]
    for axes in left:
        assert answer.tried is not None
        for settings, costs in zip(answer.candidates, answer.tried.by_light, strict=True):
            axes.plot(lights, costs, "o-", ms=4.0, lw=1.0, label=str(settings))
        axes.set(title=f"chosen from {answer.tried.times.shape[2]} start poses")
    named = {"default": "C0", f"choice: {answer.choice}": BEST}
    for costs, (name, color) in zip(answer.checked.times, named.items(), strict=True):
        right.plot(lights, costs.mean(axis=1), "o-", color=color, label=name)
        right.plot(np.repeat(lights, costs.shape[1]), costs.ravel(), ".", color=color, alpha=0.5)
    right.set(title=f"compared from {answer.checked.times.shape[2]} other start poses")
    for axes in (*left, right):
        axes.set(ylabel="time to grip [s]", ylim=(0.0, 1.35 * FAILURE))
        axes.set_xticks(lights, [light.replace(", ", ",\n") for light in LIGHTS])
        axes.axhline(FAILURE, color="0.5", ls=":", lw=1.0)
        axes.legend(fontsize="xx-small", loc="upper left")
        finish(axes)
    return figure


def answer_lighting(*, full: bool = False, starts: int = len(CHECKED_ON)) -> LightingAnswer:
    """Answer O3 with two worker processes.

    Args:
        full: Whether to choose among `CANDIDATES` from all starts of `CHOSEN_ON` first, instead of taking `CHOICE`.
        starts: From how many starts of `CHECKED_ON` the choice is compared with the default.
    """
    check_seeds = CHECKED_ON[:starts]
    with ProcessExecutor(2) as executor:
        if not full:
            return compare(CHOICE, seeds=check_seeds, executor=executor)
        return find_settings(CANDIDATES, seeds=CHOSEN_ON, check_seeds=check_seeds, executor=executor)


def _table(captures: Captures, number: int) -> str:
    """Return by light the results of the captures with some of the settings."""
    columns = zip(
        LIGHTS, captures.by_light[number], captures.failures[number], captures.error_by_light[number], strict=True
    )
    return "; ".join(
        f"{light} {time:.1f} s{'' if np.isnan(error) else f', {1e3 * error:.0f} mm'}"
        f"{f', {failures} failed' if failures else ''}"
        for light, time, failures, error in columns
    )


def lighting(full: bool) -> Answer:
    """Answer O3: which parameters of the robot are best under different lighting?"""
    answer = answer_lighting(full=full)
    default, robust = answer.checked.by_light.max(axis=1).tolist()
    count = answer.checked.times.shape[2]
    off = [f"{1e3 * np.nanmax(errors):.0f} mm" for errors in answer.checked.error_by_light]
    best_by_light = "; ".join(f"{light}: {settings}" for light, settings in answer.best.items())
    return Answer(
        id="O3",
        question="Which controller parameters are best under different lighting?",
        answer=f"{answer.choice}: {robust:.1f} s to grip in the worst light, the bar perceived {off[1]} off at most; "
        f"by default {default:.1f} s, {off[0]}",
        unit="",
        interval=None,
        paper="none given",
        cases=f"{len(CHOSEN_ON)} start poses, {len(LIGHTS)} lights",
        held_out=f"{count} other start poses, the same lights",
        baseline=f"the default settings, {default:.1f} s in the worst light",
        refused=int(answer.checked.failures[1].sum()),
        holds=answer.holds,
        note=f"Without success {FAILURE:g} s; {1e3 * ACCURACY:g} mm allowed. "
        f"By default: {_table(answer.checked, 0)}. With the choice: {_table(answer.checked, 1)}. "
        + (
            f"Best for each light: {best_by_light}"
            if best_by_light
            else "Chosen beforehand on other starts, FULL=1 chooses anew."
        ),
    )


@click.command()
@click.option("--full", is_flag=True, help="Choose among all candidates first.")
@click.option(
    "--starts",
    type=click.IntRange(1, len(CHECKED_ON)),
    default=len(CHECKED_ON),
    help="From how many starts to compare.",
    show_default=True,
)
@click.option("--figure", default="lighting.png", help="File of the picture.", show_default=True)
def main(full: bool, starts: int, figure: str) -> None:
    """Answer O3, and draw the answer."""
    answer = answer_lighting(full=full, starts=starts)
    if answer.tried is not None:
        for number, settings in enumerate(answer.candidates):
            click.echo(f"{settings}: {_table(answer.tried, number)}")
    click.echo(f"default, compared: {_table(answer.checked, 0)}")
    click.echo(f"{answer.choice}, compared: {_table(answer.checked, 1)}; holds: {answer.holds}")
    plot_answer(answer).savefig(figure, dpi=110)


if __name__ == "__main__":
    # Under its own name, so that worker processes find its functions.
    from vtbdrake_diagrams.satellite.studies.lighting import main as program

    program(prog_name="python -m vtbdrake_diagrams.satellite.studies.lighting")
