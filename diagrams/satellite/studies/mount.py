"""Application O1: where should the docking camera sit to see as many markers as possible during the capture?

The capture is led by a pose sensor, and the camera looks on: so the motion does not depend on the camera, and is
recorded once for every capture (`vtbdrake.RecordedMotion`). The camera sits on the front face of the base, on which the
arm stands, too. Its position on the face and the direction of its view are decided.

The choices that influence the answer were fixed before the first placement was judged:

* the placements by hand, `BY_HAND`: above the arm, on either side, in a corner, and beside the foot of the arm, all but
  the first aimed at the place where the bar is gripped;
* the captures, `SEEDS`: the first start poses of the scenario, which all succeed;
* the time that counts: from the start until the base and the target rest against each other, `HORIZON`;
* the light: the scenario's own;
* the least difference that counts: `TELLING` markers. The count is a whole number, and its mean varies by some tenths.

``python -m vtbdrake_diagrams.satellite.studies.mount [--full]`` prints the answer and draws it. The DPS keeps the
nominal pose of the camera: the markers that it detects in an image do not depend on it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import click
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from numpy.typing import ArrayLike

import vtbdrake as vtb
from vtbdrake.common.arrays import Array
from vtbdrake.optimization import Sweep
from vtbdrake.rollout import Executor, ProcessExecutor, RolloutResult, RolloutRunner
from vtbdrake.state import NamedVector, Quantity
from vtbdrake.state.systems import pose_to_array
from vtbdrake.visualization.plots import Picture, draw_mesh, finish, mark_best
from vtbdrake.visualization.study_plots import BEST
from vtbdrake_diagrams.answers import Answer
from vtbdrake_diagrams.satellite.bodies import Servicer, Target
from vtbdrake_diagrams.satellite.scenario import SatelliteScenario
from vtbdrake_diagrams.satellite.start import random_start

POSE = "sim.sense.docking_camera.pose"
_ENTRIES = NamedVector(
    x=Quantity(unit="m"),
    y=Quantity(unit="m"),
    z=Quantity(unit="m"),
    roll=Quantity(unit="rad"),
    pitch=Quantity(unit="rad"),
    yaw=Quantity(unit="rad"),
)
IMAGE = "sim.sense.docking_camera.color_image"
COUNT = "dps.env.markers.count"

HORIZON = 24.0
"""How long the markers count, in s: from the start until the relative motion has stopped."""
SAMPLE_PERIOD = 2.0
"""How often they are counted, in s."""
SEEDS = tuple(range(8))
"""The start poses over which the count is averaged; the short version takes the first `FEW`."""
FEW = 3
TELLING = 0.3
"""The least difference of mean counts that means anything, in markers."""

# Place of the camera along x of B, in m: 2 cm before the front face.
_X = 0.62
# Largest distance from the middle of the face at which the camera's housing fits on it, in m.
_REACH = 0.45
# How far the view may turn away from straight ahead, in rad.
_TURN = 0.5
# How far the camera stays away from the axis of the arm's foot, in m.
_FOOT = 0.18


def pose(y: float, z: float, *, tilt: float = 0.0, pan: float = 0.0) -> Array:
    """Return [x, y, z, roll, pitch, yaw] of the camera in B, on the front face.

    Args:
        y: To the left, in m.
        z: Up, in m.
        tilt: How far it looks down, in rad.
        pan: How far it looks to the left, in rad.
    """
    return _ENTRIES.array(x=_X, y=y, z=z, roll=-np.pi / 2 - tilt, yaw=-np.pi / 2 + pan)


def aimed(y: float, z: float) -> Array:
    """Return the pose of a camera on the front face that looks at the place where the bar is gripped."""
    p_BH = np.array([SatelliteScenario().distance, 0.0, 0.0]) + Target().X_TH.translation()
    ahead, left, up = p_BH - [_X, y, z]
    return pose(y, z, tilt=float(np.arctan2(-up, np.hypot(ahead, left))), pan=float(np.arctan2(left, ahead)))


BY_HAND: dict[str, Array] = {
    "above the arm": pose_to_array(Servicer().X_BC),
    "on the left": aimed(0.4, 0.0),
    "on the right": aimed(-0.4, 0.0),
    "in the upper left corner": aimed(0.4, 0.4),
    "beside the foot of the arm": aimed(0.25, -0.35),
}
"""The placements by hand."""

# How far the base turns down while the arm reaches out, in rad: 17 to 20 deg in the first three captures.
_REACTION = 0.33


def _turned_up(value: Array) -> Array:
    higher = np.array(value)
    entries = _ENTRIES.view(higher)
    entries.roll = min(entries.roll + _REACTION, -np.pi / 2 + _TURN)
    return higher


AFTERWARDS: dict[str, Array] = {f"{name}, turned up": _turned_up(value) for name, value in BY_HAND.items()}
"""The same, turned up by as much as the base turns down: thought of after the first answer, which showed why."""


def _address(name: str) -> str:
    """Return the address of an entry of the pose."""
    return f"{POSE}[{_ENTRIES.slice_of(name).start}]"


PARAMETERS = (
    vtb.Parameter(_address("y"), -_REACH, _REACH),
    vtb.Parameter(_address("z"), -_REACH, _REACH),
    vtb.Parameter(_address("roll"), -np.pi / 2 - _TURN, -np.pi / 2 + _TURN),
    vtb.Parameter(_address("yaw"), -np.pi / 2 - _TURN, -np.pi / 2 + _TURN),
)


def markers_seen(count: float) -> float:
    """Return f: the number of markers that the DPS has detected in the last image."""
    return count


def distance_from_foot(value: Array) -> float:
    """Return how far a camera with this pose is from the axis of the arm's foot, in m."""
    _, y, z = Servicer().shoulder
    camera = _ENTRIES.view(value)
    return float(np.hypot(camera.y - y, camera.z - z))


def scenario() -> SatelliteScenario:
    """Return the scenario: a capture that the pose sensor leads, while the docking camera looks on."""
    return SatelliteScenario(perception="pose_sensor", onlookers="camera")


def capture(seed: int) -> dict[str, Any]:
    """Return the values that make the capture start as in a scenario with this seed."""
    defaults = scenario()
    return random_start(seed, tumble=np.radians(defaults.tumble_deg), distance=defaults.distance).values()


def mount_problem(
    parameters: Sequence[vtb.Parameter] = PARAMETERS,
    *,
    seeds: Sequence[int] = SEEDS,
    reading: str = "integral",
    fixed: Mapping[str, float] | None = None,
    recorded: bool = True,
) -> vtb.Problem:
    """State the question in the paper's five steps.

    Args:
        parameters: Entries of the camera's pose.
        seeds: The seeds of the captures over which the quality is averaged.
        reading: The quality of the number of markers over time: ``integral``, in markers times s, or ``best``, the
            paper's maximum.
        fixed: Values of other entries of the pose, by address.
        recorded: Whether candidates are judged along recorded motions.
    """
    capture_scenario = scenario()
    upper = float(len(Target().tags))
    # The count that f reads is of an image that is at most a period of the camera old.
    memory = 1.0 / capture_scenario.camera_fps + 0.02
    return vtb.Problem(
        scenario=capture_scenario,
        parameters=list(parameters),
        quality=vtb.Quality(markers_seen, of=COUNT, reading=reading, upper=upper),
        horizon=HORIZON,
        sample_period=SAMPLE_PERIOD,
        conditions=[{**capture(seed), **(fixed or {})} for seed in seeds],
        risk="mean",
        constraints=[vtb.Constraint(distance_from_foot, of=POSE, at_least=_FOOT)],
        motion=vtb.RecordedMotion(memory) if recorded else None,
    )


def entries(value: ArrayLike) -> tuple[float, ...]:
    """Return the values of `PARAMETERS` in a pose, shape (6,)."""
    camera = _ENTRIES.view(np.asarray(value))
    return camera.y, camera.z, camera.roll, camera.yaw


def mean_count(rollout: RolloutResult) -> float:
    """Return the mean number of markers over the capture."""
    return float(np.trapezoid(rollout.quality, rollout.times)) / HORIZON if not rollout.failed else float("nan")


@dataclass(frozen=True)
class Placement:
    """A placement of the camera, and its result in each capture.

    Attributes:
        name: Its name.
        pose: The pose [x, y, z, roll, pitch, yaw] in B, (6,), in m and rad.
        rollouts: The rollouts, one per capture.
    """

    name: str
    pose: Array
    rollouts: tuple[RolloutResult, ...]

    @property
    def mean(self) -> float:
        """Return the mean number of markers over all captures."""
        return _mean_at(self.rollouts)

    @property
    def most(self) -> float:
        """Return the mean over the captures of the maximum over time, the paper's quality."""
        return _most_at(self.rollouts)


@dataclass(frozen=True)
class MountAnswer:
    """The answer to O1.

    Attributes:
        best: The placement that was found.
        by_hand: The placements of `BY_HAND`.
        afterwards: The placements of `AFTERWARDS`, which do not count for `holds`.
        landscape: Rollouts on a grid over the position, with the view as in the best placement.
    """

    best: Placement
    by_hand: tuple[Placement, ...]
    afterwards: tuple[Placement, ...]
    landscape: Sweep

    @property
    def gain(self) -> float:
        """Return by how many markers the best placement sees more than the best by hand, in the mean.

        NaN if a capture with one of them failed, so that nothing is claimed.
        """
        return float(self.best.mean - np.max([placement.mean for placement in self.by_hand]))

    @property
    def best_on_grid(self) -> float:
        """Return the mean number of markers at the best point of the grid that keeps off the arm.

        NaN if a rollout failed, so that nothing is claimed.
        """
        if self.landscape.failed.any():
            return float("nan")
        values = [e.values[0] for e in self.landscape.evaluations if e.violations[0] <= 0.0]
        return float(np.max(values)) / HORIZON

    @property
    def holds(self) -> bool:
        """Return whether it sees more than each placement by hand, and no point of the grid sees more."""
        return self.gain > TELLING and self.best_on_grid < self.best.mean + TELLING


def find_mount(*, seeds: Sequence[int], candidates: int, grid: int, executor: Executor) -> MountAnswer:
    """Search the best placement, compare it with those by hand, and with a grid over the position.

    Args:
        seeds: Seeds of the captures.
        candidates: How many placements the search tries.
        grid: The number of points of the grid per side.
        executor: Runs the rollouts.
    """
    problem = mount_problem(seeds=seeds)
    with problem.study() as study:
        study.run(rollouts=candidates * len(seeds), racing=False, executor=executor, progress=False)
        y, z, roll, yaw = study.best.point
    poses = {"found": _ENTRIES.array(x=_X, y=y, z=z, roll=roll, yaw=yaw), **BY_HAND, **AFTERWARDS}
    turns = {_address("roll"): float(roll), _address("yaw"): float(yaw)}
    around = mount_problem(PARAMETERS[:2], seeds=seeds, fixed=turns)
    landscape = around.sweep(grid, executor=executor, progress=False)
    every = problem.sweep(values=[entries(value) for value in poses.values()], executor=executor, progress=False)
    rows = np.reshape(np.array(every.rollouts, dtype=object), (len(poses), len(seeds)))
    placements = [Placement(name, value, tuple(row)) for (name, value), row in zip(poses.items(), rows, strict=True)]
    last = 1 + len(BY_HAND)
    return MountAnswer(placements[0], tuple(placements[1:last]), tuple(placements[last:]), landscape)


def views(poses: Sequence[Array], *, seed: int = SEEDS[0]) -> list[list[Array]]:
    """Return what a camera sees in one capture from each of some poses, at the sample times: images (h, w, 3)."""
    problem = mount_problem(seeds=[seed])
    runner = RolloutRunner(replace(problem.task, record=[IMAGE]), problem.testbed)
    rollouts = [runner.run(problem.values(entries(value), condition=0)) for value in poses]
    return [[image.data[..., :3] for image in rollout.record[IMAGE]] for rollout in rollouts]


def plot_answer(answer: MountAnswer, *, times: Sequence[float] = (2.0, 6.0, 10.0, 14.0, 18.0, 22.0)) -> Figure:
    """Draw the landscape over the position, the counts over time, and the views of all placements.

    Left above: the mean count over the position of the camera, with the placements; the view is turned as in the best.
    Beside it the paper's quality, the maximum over time, which has plateaus. Right: the counts over time. Below: what
    each placement sees in the first capture, at about the time at which the markers were counted.

    Args:
        answer: The answer.
        times: Times of the images in s.
    """
    placements = [answer.best, *answer.by_hand]
    figure = Picture(14.0, 4.6 + 1.35 * len(placements))
    above, below = figure.subfigures(2, 1, height_ratios=[4.6, 1.35 * len(placements)])
    mean_axes, most_axes, time_axes = above.subplots(1, 3)
    _draw_landscape(mean_axes, answer, _mean_at, "mean number of markers")
    _draw_landscape(most_axes, answer, _most_at, "largest number of markers (the paper's)")
    for k, placement in enumerate(placements):
        counts = np.mean([rollout.quality for rollout in placement.rollouts], axis=0)
        best = placement is answer.best
        style = {"color": BEST, "lw": 2.5} if best else {"color": f"C{k - 1}", "lw": 1.2}
        label = f"{placement.name}: {placement.mean:.2f}"
        time_axes.plot(placement.rollouts[0].times, counts, drawstyle="steps-pre", label=label, **style)
    time_axes.set(xlabel="time [s]", ylabel="markers detected", title=f"Mean of {len(answer.best.rollouts)} captures")
    time_axes.set_ylim(0.0, 1.0 + 1.4 * max(placement.most for placement in placements))
    time_axes.legend(fontsize="x-small", loc="upper right")
    finish(time_axes)
    grid = below.subplots(len(placements), len(times))
    images = views([placement.pose for placement in placements])
    for row, placement, images_of_placement in zip(grid, placements, images, strict=True):
        first = placement.rollouts[0]
        for axes, t in zip(row, times, strict=True):
            index = int(np.argmin(np.abs(first.times - t)))
            axes.imshow(images_of_placement[index])
            axes.set(xticks=[], yticks=[])
            axes.set_xlabel(f"{first.times[index]:g} s: {first.quality[index]:g}", fontsize="x-small", labelpad=1)
        row[0].set_ylabel(placement.name.replace(" of ", "\nof ").replace(" corner", "\ncorner"), fontsize="x-small")
    return figure


def _mean_at(rollouts: Sequence[RolloutResult]) -> float:
    return float(np.mean([mean_count(rollout) for rollout in rollouts]))


def _most_at(rollouts: Sequence[RolloutResult]) -> float:
    return float(np.mean([rollout.quality.max() if not rollout.failed else np.nan for rollout in rollouts]))


def _draw_landscape(
    axes: Axes, answer: MountAnswer, number: Callable[[Sequence[RolloutResult]], float], title: str
) -> None:
    points, groups = np.unique(answer.landscape.points, axis=0, return_inverse=True)
    rollouts = [[answer.landscape.rollouts[i] for i in np.flatnonzero(groups == k)] for k in range(len(points))]
    y, z = np.unique(points[:, 0]), np.unique(points[:, 1])
    values = np.array([number(group) for group in rollouts]).reshape(y.size, z.size).T
    figure = axes.figure
    figure.colorbar(draw_mesh(axes, y, z, values), ax=axes, pad=0.02)
    for k, placement in enumerate(answer.by_hand):
        y_placed, z_placed, *_ = entries(placement.pose)
        axes.plot(y_placed, z_placed, "o", color=f"C{k}", mec="white")
    y_best, z_best, *_ = entries(answer.best.pose)
    mark_best(axes, y_best, z_best)
    axes.add_patch(Circle(Servicer().shoulder[1:], _FOOT, fill=False, color="white", ls=":"))
    axes.set(xlabel="y in B [m]", ylabel="z in B [m]", title=title)


def answer_mount(*, full: bool = False) -> MountAnswer:
    """Answer O1 with two worker processes; see `find_mount`."""
    with ProcessExecutor(2) as executor:
        return find_mount(
            seeds=SEEDS if full else SEEDS[:FEW],
            candidates=200 if full else 36,
            grid=13 if full else 4,
            executor=executor,
        )


def mount(full: bool) -> Answer:
    """Answer O1: where should the docking camera sit?

    The short version averages over the first `FEW` captures, the long one over all of `SEEDS`, with a finer grid.
    """
    result = answer_mount(full=full)
    by_hand, afterwards = (
        "; ".join(f"{p.name} {p.mean:.2f} (largest {p.most:.1f})" for p in placements)
        for placements in (result.by_hand, result.afterwards)
    )
    return Answer(
        id="O1",
        question="Where should the docking camera sit to see the most markers during the capture?",
        answer=f"{_place(result.best)}: {result.best.mean:.2f} markers in the mean",
        unit="",
        interval=None,
        paper="none given",
        cases=f"{len(result.best.rollouts)} captures",
        held_out="",
        baseline=f"by hand: {by_hand}",
        holds=result.holds,
        note=f"Thought of afterwards: {afterwards}. Largest of the one found "
        f"{result.best.most:.1f}. Best of the grid over the position: {result.best_on_grid:.2f}. Mean of "
        f"{len(result.best.rollouts)} captures; differences under {TELLING} mean nothing.",
    )


def _place(placement: Placement) -> str:
    """Return where a placement is, and where it looks."""
    y, z, roll, yaw = entries(placement.pose)
    up, left = np.degrees([roll + np.pi / 2, yaw + np.pi / 2])
    side = "left" if left >= 0.0 else "right"
    return f"at y = {y:.2f} m, z = {z:.2f} m, {up:.0f} deg up, {abs(left):.0f} deg to the {side}"


@click.command()
@click.option("--full", is_flag=True, help="All captures, and a finer grid.")
@click.option("--figure", default="mount.png", help="File of the picture.", show_default=True)
def main(full: bool, figure: str) -> None:
    """Answer O1, and draw the answer."""
    result = answer_mount(full=full)
    click.echo(f"{'placement':38} {'mean':>5} {'largest':>7}")
    for placement in (result.best, *result.by_hand, *result.afterwards):
        click.echo(f"{placement.name:38} {placement.mean:5.2f} {placement.most:7.1f}")
    click.echo(f"found {_place(result.best)}; best of the grid: {result.best_on_grid:.2f}; holds: {result.holds}")
    plot_answer(result).savefig(figure, dpi=110)


if __name__ == "__main__":
    # Under its own name, so that worker processes find its functions.
    from vtbdrake_diagrams.satellite.studies.mount import main as program

    program(prog_name="python -m vtbdrake_diagrams.satellite.studies.mount")
