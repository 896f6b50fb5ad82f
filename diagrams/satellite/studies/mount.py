"""Application O1: where should the docking camera sit to see as many markers as possible during the capture?

The capture is led by a pose sensor, and the camera looks on: so the motion does not depend on the camera, and is
recorded once for every capture (`vtbdrake.RecordedMotion`). The camera sits at the front face of the base, on which the
arm stands, too. All six numbers of its pose are decided.

The choices that influence the answer (here and in `mount_placements`) were fixed before the first placement was judged:

* the captures: placements are found on `FOUND_ON`, and judged on `JUDGED_ON`, each at five tumble rates;
* the placements by hand: the places `PLACES`, each aimed by the rules `RULES`. One rule knows how the base reacts to
  the arm. The best of each rule on `FOUND_ON` is judged beside the placement found;
* the time that counts: from the start until the base and the target rest against each other, `HORIZON`;
* the light: the scenario's own;
* the least difference that counts: `TELLING` markers. The count is a whole number, and its mean varies by some tenths;
* the search: the best of each rule, `GLOBAL` placements by the default solver, then `LOCAL` by NLopt's COBYLA
  in Drake's MathematicalProgram, from the best so far.

Whether a search with more placements finds a better one is asked by ``--search``: it is judged on captures on which
nothing else was judged, `LONG_JUDGED_ON`.

Beside the count of markers, every image gives a pose of the target, or none: how far that pose has the bar off is
judged, too. At last the placements judged guide captures themselves, without wheels.

``python -m vtbdrake_diagrams.satellite.studies.mount --full`` does what is missing in ``mount.json`` beside this
module, keeps it step by step and draws the answer; without ``--full`` the results are read. The row of the answers
reads them, and judges a tenth of the captures again.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import click
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from scipy.stats import t as student

import vtbdrake as vtb
from vtbdrake.common.arrays import Array
from vtbdrake.state.systems import pose_from_array
from vtbdrake.visualization.plots import Picture, draw_mesh, finish, mark_best
from vtbdrake.visualization.study_plots import BEST
from vtbdrake_diagrams.answers import Answer
from vtbdrake_diagrams.kept_results import Repetition, read_results, repeat, write_results
from vtbdrake_diagrams.satellite.bodies import Servicer
from vtbdrake_diagrams.satellite.studies.mount_looks import IMAGE, Guided, Look, Onlooker, guide
from vtbdrake_diagrams.satellite.studies.mount_placements import (
    ENTRIES,
    FOOT_DISTANCE,
    FOUND_ON,
    JUDGED_ON,
    LONG_JUDGED_ON,
    REACH,
    RULES,
    SAMPLE_PERIOD,
    STILL,
    TUMBLES,
    Capture,
    by_hand,
    distance_from_foot,
)

TELLING = 0.3
"""The least difference of mean counts that means anything, in markers."""
GLOBAL = 10
"""The number of placements that the default solver tries, beside those by hand."""
LOCAL = 14
"""The number of placements that COBYLA tries after them."""
GUIDED = 5
"""The number of captures of `JUDGED_ON` that the cameras guide."""
LONG_GLOBAL = 40
"""The number of placements that the default solver tries in the long search."""
LONG_LOCAL = 40
"""The number of placements that COBYLA tries after them."""
RESULTS = Path(__file__).with_suffix(".json")
"""The results that ``--full`` keeps."""
LONG_RESULTS = Path(__file__).with_name("mount_search.json")
"""The results that ``--search`` keeps."""
LONG_COMMAND = "python -m vtbdrake_diagrams.satellite.studies.mount --search"
COMMAND = "python -m vtbdrake_diagrams.satellite.studies.mount --full"


@dataclass(frozen=True, eq=False)
class Placement:
    """A placement of the camera, and its results.

    Attributes:
        name: Its name.
        rule: How it is aimed: one of `RULES`, or ``search``.
        pose: The pose [x, y, z, roll, pitch, yaw] in B, (6,), in m and rad.
        tried: What it sees in `FOUND_ON`.
        judged: What it sees in `JUDGED_ON`; None if it is not judged.
        guided: The captures that it has guided; None if it is not judged.
    """

    name: str
    rule: str
    pose: Array
    tried: Look
    judged: Look | None = None
    guided: Guided | None = None

    @staticmethod
    def of(stored: Mapping[str, Any]) -> Placement:
        """Return what was kept."""
        judged, guided = stored["judged"], stored["guided"]
        return Placement(
            stored["name"],
            stored["rule"],
            np.array(stored["pose"]),
            Look.of(stored["tried"]),
            None if judged is None else Look.of(judged),
            None if guided is None else Guided(*(np.array(guided[k], dtype=float) for k in ("times", "errors"))),
        )


SEARCH = "search"


@dataclass(frozen=True)
class MountAnswer:
    """The answer to O1.

    Attributes:
        placements: The placement that was found, and all by hand.
        candidates: How many placements the search has tried.
        status: How COBYLA ended, in its own words.
        grid: The slice over the position with the view as found: ``y`` and ``z`` in m, ``mean`` and ``most`` markers in
            a capture of `FOUND_ON`, shape (y, z), NaN where the arm is; empty if it is missing.
    """

    placements: tuple[Placement, ...]
    candidates: int
    status: str
    grid: Mapping[str, Array]

    def twin(self, placement: Placement) -> Placement | None:
        """Return another placement with the same pose, if there is one: the search may end where it began."""
        same = [p for p in self.placements if p.rule != placement.rule and np.array_equal(p.pose, placement.pose)]
        return same[0] if same else None

    def with_placement(self, placement: Placement) -> MountAnswer:
        """Return the answer with further results of a placement."""
        key = placement.name, placement.rule
        return replace(self, placements=tuple(placement if (p.name, p.rule) == key else p for p in self.placements))

    @property
    def best(self) -> Placement:
        """Return the placement that was found."""
        return next(placement for placement in self.placements if placement.rule == SEARCH)

    @property
    def judged(self) -> list[Placement]:
        """Return the placements that are judged: the one found, and the best of each rule."""
        return [placement for placement in self.placements if placement.judged is not None]

    @property
    def well_aimed(self) -> Placement:
        """Return the best placement by hand on `FOUND_ON`, which an engineer would take."""
        return max((p for p in self.judged if p.rule != SEARCH), key=lambda p: p.tried.mean)

    def gain(self, placement: Placement | None = None) -> tuple[float, float, float]:
        """Return by how many markers the one found sees more, in the mean of `JUDGED_ON`, and its interval of 90 %.

        Args:
            placement: The placement beside it; by default `well_aimed`.

        Returns:
            (lower, mean, upper), by Student's t of the differences in each capture.
        """
        beside = (placement or self.well_aimed).judged
        assert self.best.judged is not None and beside is not None
        return mean_gain(self.best.judged, beside)

    @property
    def verdict(self) -> str:
        """Return in words what the search is worth beside the best placement by hand."""
        lower, mean, upper = self.gain()
        if self.twin(self.best) is not None:
            return "the search ends at the best placement by hand"
        if lower > 0.0 and mean > TELLING:
            return "better than the best placement by hand"
        if upper < 0.0 and mean < -TELLING:
            return "worse than the best placement by hand"
        return "no better than a well-aimed placement by hand"

    @property
    def holds(self) -> bool:
        """Return whether enough captures were judged, and the placement found is not worse than one by hand.

        A placement that ignores how the base reacts must be worse by what means anything: else nothing was asked.
        """
        still = [placement for placement in self.judged if placement.rule == STILL]
        enough = all(p.judged is not None and len(p.judged.means) >= len(JUDGED_ON) for p in self.judged)
        not_worse = all(self.gain(p)[2] >= 0.0 for p in self.judged if p.rule != SEARCH)
        return enough and not_worse and bool(still) and all(self.gain(p)[0] > TELLING for p in still)

    @staticmethod
    def of(stored: Mapping[str, Any]) -> MountAnswer:
        """Return what was kept."""
        grid = {key: np.array(values, dtype=float) for key, values in stored["grid"].items()}
        placements = tuple(Placement.of(placement) for placement in stored["placements"])
        return MountAnswer(placements, stored["candidates"], stored["status"], grid)


def mean_gain(look: Look, beside: Look) -> tuple[float, float, float]:
    """Return by how many markers one placement sees more than another in the mean, and the interval of 90 %.

    Returns:
        (lower, mean, upper), by Student's t of the differences in each capture.
    """
    gains = look.means - beside.means
    half = float(student.ppf(0.95, len(gains) - 1) * gains.std(ddof=1) / np.sqrt(len(gains)))
    return float(gains.mean()) - half, float(gains.mean()), float(gains.mean()) + half


@dataclass(frozen=True, eq=False)
class LongSearch:
    """A search that tries more placements, and is judged on captures of its own, `LONG_JUDGED_ON`.

    Attributes:
        pose: The best pose on `FOUND_ON`, (6,), in m and rad.
        candidates: How many placements were tried.
        status: How COBYLA ended, in its own words.
        tried: What the best pose sees in `FOUND_ON`.
        judged: What it sees in `LONG_JUDGED_ON`.
        by_hand: What the best placement by hand sees there.
    """

    pose: Array
    candidates: int
    status: str
    tried: Look
    judged: Look
    by_hand: Look

    @staticmethod
    def of(stored: Mapping[str, Any]) -> LongSearch:
        """Return what was kept."""
        looks = (Look.of(stored[name]) for name in ("tried", "judged", "by_hand"))
        return LongSearch(np.array(stored["pose"]), stored["candidates"], stored["status"], *looks)

    def __str__(self) -> str:
        lower, mean, upper = mean_gain(self.judged, self.by_hand)
        return (
            f"A search of {self.candidates} placements sees {self.tried.mean:.2f} markers where it was found, and on "
            f"{len(self.judged.means)} captures of its own {self.judged.mean:.2f}, {mean:+.2f} [{lower:.2f}, "
            f"{upper:.2f}] beside the best by hand"
        )


def long_search(answer: MountAnswer) -> LongSearch:
    """Search from the best placement of each rule with more placements, and judge the best on `LONG_JUDGED_ON`.

    Args:
        answer: The placements by hand.
    """
    onlooker = Onlooker(FOUND_ON)
    starts = [placement.pose for placement in judged_placements(answer.placements) if placement.rule != SEARCH]
    pose, candidates, status = search_mount(onlooker.problem, starts, first=LONG_GLOBAL, then=LONG_LOCAL)
    judge = Onlooker(LONG_JUDGED_ON)
    looks = judge.look(pose), judge.look(answer.well_aimed.pose)
    return LongSearch(pose, candidates, status, onlooker.look(pose), *looks)


def search_mount(
    problem: vtb.Problem, starts: Sequence[Array], *, first: int = GLOBAL, then: int = LOCAL
) -> tuple[Array, int, str]:
    """Search the best placement: by the default solver, then by COBYLA through Drake's MathematicalProgram.

    Args:
        problem: The problem of `mount_problem`.
        starts: Placements that are tried first.
        first: How many placements the default solver tries beside these.
        then: How many COBYLA tries, from the best so far.

    Returns:
        The best pose, how many placements were tried, and how COBYLA ended.
    """
    captures_each, tried = len(problem.conditions), len(starts) + first
    with problem.study() as study:
        for value in starts:
            study.intervene("try", point={p.address: float(v) for p, v in zip(problem.parameters, value, strict=True)})
        study.run(rollouts=tried * captures_each, racing=False, executor="serial", progress=False)
        study.intervene("budget", rollouts=(tried + then) * captures_each)
        study.intervene("solver", solver="LN_COBYLA")
        study.run(rollouts=(tried + then) * captures_each, racing=False, executor="serial", progress=False)
        return np.array(study.best.point), len(study) // captures_each, f"{study.reason}: {study.message}"


def position_slice(look: Callable[[Array], Look], best: Array, points: int = 4) -> dict[str, Array]:
    """Return the counts over the position on the face, with the view as in the best placement.

    Args:
        look: Returns what a placement sees.
        best: The best pose.
        points: The number of points per side.
    """
    axis = np.linspace(-REACH, REACH, points)
    mean, most = np.full((2, points, points), np.nan)
    for i, y in enumerate(axis):
        for k, z in enumerate(axis):
            value = best.copy()
            value[1:3] = y, z
            if distance_from_foot(value) >= FOOT_DISTANCE:
                seen_there = look(value)
                mean[i, k], most[i, k] = seen_there.mean, seen_there.most
    return {"y": axis, "z": axis, "mean": mean, "most": most}


def judged_placements(tried: Sequence[Placement]) -> list[Placement]:
    """Return the placements that are judged: the one found, and the best of each rule on `FOUND_ON`."""
    best = [max((p for p in tried if p.rule == rule), key=lambda p: p.tried.mean) for rule in RULES]
    return [*(p for p in tried if p.rule == SEARCH), *best]


def try_placements(echo: Callable[[str], Any] = print) -> MountAnswer:
    """Try the placements by hand, search a better one, and return all of them, not judged yet."""
    onlooker = Onlooker(FOUND_ON)
    tried = []
    for rule in RULES:
        for name, value in by_hand(rule).items():
            tried.append(Placement(name, rule, value, onlooker.look(value)))
            echo(f"{name}, {rule}: {tried[-1].tried.mean:.2f}")
    value, candidates, status = search_mount(onlooker.problem, [p.pose for p in judged_placements(tried)])
    best = Placement(SEARCH, SEARCH, value, onlooker.look(value))
    echo(f"{_place(best.pose)}: {best.tried.mean:.2f} of {candidates}; {status}")
    return MountAnswer((best, *tried), candidates, status, {})


def answer_mount(
    answer: MountAnswer | None = None,
    *,
    keep: Callable[[MountAnswer], Any] = lambda answer: None,
    echo: Callable[[str], Any] = print,
) -> MountAnswer:
    """Answer O1, which takes about 8 minutes of processor time.

    Args:
        answer: The results so far; None: nothing.
        keep: Gets the answer after each step.
        echo: Gets a line for each step.
    """
    if answer is None:
        answer = try_placements(echo)
        keep(answer)
    onlooker = Onlooker(JUDGED_ON)
    for placement in judged_placements(answer.placements):
        if placement.judged is None:
            twin = answer.twin(placement)
            look = (twin and twin.judged) or onlooker.look(placement.pose)
            echo(f"{placement.name}, {placement.rule}: {look.mean:.2f}")
            answer = answer.with_placement(replace(placement, judged=look))
            keep(answer)
    for placement in answer.judged:
        if placement.guided is None:
            twin = answer.twin(placement)
            guided = (twin and twin.guided) or guide(placement.pose, JUDGED_ON[:GUIDED])
            echo(f"{placement.name}, {placement.rule}: guides {guided.successes} of {GUIDED}")
            answer = answer.with_placement(replace(placement, guided=guided))
            keep(answer)
    if not answer.grid:
        answer = replace(answer, grid=position_slice(Onlooker(FOUND_ON[2:3]).look, answer.best.pose))
        keep(answer)
    return answer


def captures_again(answer: MountAnswer) -> Repetition:
    """Judge the placements on a tenth of the captures again, and return whether the mean counts are the same."""
    looks = [(placement.pose, placement.judged) for placement in answer.judged if placement.judged is not None]
    counts = {number: np.array([look.means[number] for _, look in looks]) for number in range(len(JUDGED_ON))}
    return repeat("captures", counts, partial(mean_counts, tuple(pose for pose, _ in looks)), agree)


def mean_counts(poses: Sequence[Array], number: int) -> Array:
    """Return the mean count of markers from each of some poses in a capture, given by its number in `JUDGED_ON`."""
    onlooker = Onlooker([JUDGED_ON[number]])
    return np.array([onlooker.look(pose).mean for pose in poses])


def agree(before: Array, now: Array) -> bool:
    """Return whether mean counts differ by less than means anything."""
    return bool(np.abs(before - now).max() < TELLING)


# -- pictures and words


def views(poses: Sequence[Array], *, on: Capture = JUDGED_ON[2]) -> list[list[Array]]:
    """Return what a camera sees in one capture from each of some poses, at the sample times: images (h, w, 3)."""
    onlooker = Onlooker([on])
    rollouts = [onlooker.rollout(value) for value in poses]
    return [[image.data[..., :3] for image in rollout.record[IMAGE]] for rollout in rollouts]


def plot_answer(answer: MountAnswer) -> Figure:
    """Draw the slice over the position, the counts over time, and the views of the placements that are judged.

    Left above, if it was computed: the mean count over the position of the camera, with the placements; the view is
    turned as in the one found. Beside it the paper's quality, the maximum over time, which has plateaus. Right: the
    counts over time. Below: what each placement sees in one capture.
    """
    placements = answer.judged
    figure = Picture(14.0, 4.6 + 1.35 * len(placements))
    above, below = figure.subfigures(2, 1, height_ratios=[4.6, 1.35 * len(placements)])
    *slices, time_axes = above.subplots(1, 3 if answer.grid else 1, squeeze=False)[0]
    titles = {"mean": "mean number of markers", "most": "largest number of markers (the paper's)"}
    for axes, (key, title) in zip(slices, titles.items(), strict=False):
        _draw_slice(axes, answer, key, title)
    times = SAMPLE_PERIOD * np.arange(1, 1 + placements[0].tried.counts.shape[1])
    for k, placement in enumerate(placements):
        assert placement.judged is not None
        style = {"color": BEST, "lw": 2.5} if placement.rule == SEARCH else {"color": f"C{k - 1}", "lw": 1.2}
        label = f"{placement.name}, {placement.rule}: {placement.judged.mean:.2f}"
        time_axes.plot(times, placement.judged.counts.mean(axis=0), drawstyle="steps-pre", label=label, **style)
    time_axes.set(xlabel="time [s]", ylabel="markers detected", title=f"Mean of {len(JUDGED_ON)} captures")
    time_axes.set_ylim(0.0, 12.0)
    time_axes.legend(fontsize="x-small", loc="upper right")
    finish(time_axes)
    grid = below.subplots(len(placements), len(times))
    images = views([placement.pose for placement in placements])
    for row, placement, images_of_placement in zip(grid, placements, images, strict=True):
        for axes, image, t in zip(row, images_of_placement[1:], times, strict=True):
            axes.imshow(image)
            axes.set(xticks=[], yticks=[])
            axes.set_xlabel(f"{t:g} s", fontsize="x-small", labelpad=1)
        row[0].set_ylabel(f"{placement.name},\n{placement.rule}".replace(" by ", "\nby "), fontsize="xx-small")
    return figure


def _draw_slice(axes: Axes, answer: MountAnswer, key: str, title: str) -> None:
    y, z, values = (answer.grid[k] for k in ("y", "z", key))
    figure = axes.figure
    figure.colorbar(draw_mesh(axes, y, z, values.T), ax=axes, pad=0.02)
    for k, placement in enumerate(placement for placement in answer.judged if placement.rule != SEARCH):
        axes.plot(*placement.pose[1:3], "o", color=f"C{k}", mec="white")
    mark_best(axes, *answer.best.pose[1:3])
    axes.add_patch(Circle(Servicer().shoulder[1:], FOOT_DISTANCE, fill=False, color="white", ls=":"))
    axes.set(xlabel="y in B [m]", ylabel="z in B [m]", title=title)


def mount(full: bool) -> Answer:
    """Answer O1: where should the docking camera sit?

    The short version reads the kept results. Both judge the placements again on a tenth of the captures, drawn at
    random.
    """
    result = answer_mount() if full else MountAnswer.of(read_results(RESULTS))
    longer = long_search(result) if full else LongSearch.of(read_results(LONG_RESULTS))
    repetition = captures_again(result)
    lower, mean, upper = result.gain()
    looks = "; ".join(_words(placement) for placement in result.judged)
    return Answer(
        id="O1",
        question="Where should the docking camera sit to see the most markers during the capture?",
        answer=f"{_place(result.best.pose)}: {mean:+.2f} markers beside the best by hand; {result.verdict}",
        unit="",
        interval=(lower, upper),
        paper="none given",
        cases=f"{len(FOUND_ON)} captures, one at each of {len(TUMBLES)} tumble rates",
        held_out=f"{len(JUDGED_ON)} others at the same rates",
        baseline=f"{result.well_aimed.name}, {result.well_aimed.rule}: the best by hand",
        holds=result.holds and repetition.same,
        note=f"Interval: of 90 %, of the markers more. {looks}. {longer}. Differences under {TELLING} mean nothing. "
        f"{repetition}.",
    )


def _words(placement: Placement) -> str:
    look, guided = placement.judged, placement.guided
    assert look is not None
    return (
        f"{placement.name}, {placement.rule}: {look.mean:.2f} markers in the mean, {look.most:.1f} at most, a pose in "
        f"{look.posed:.0%} of the images, {1e3 * look.accuracy:.2f} mm off in the median"
    ) + ("" if guided is None else f"; guides {guided.successes} of {len(guided.times)} captures")


def _place(value: Array) -> str:
    """Return where a camera with this pose is, and where it looks."""
    camera = ENTRIES.view(value)
    ahead, left, up = pose_from_array(value).rotation().matrix()[:, 2]
    side = "left" if left >= 0.0 else "right"
    return (
        f"at x = {camera.x:.2f}, y = {camera.y:.2f}, z = {camera.z:.2f} m, "
        f"{np.degrees(np.arctan2(up, np.hypot(ahead, left))):.0f} deg up, "
        f"{abs(np.degrees(np.arctan2(left, ahead))):.0f} deg to the {side}, "
        f"twisted by {np.degrees(camera.pitch):.0f} deg"
    )


@click.command()
@click.option("--full", is_flag=True, help="Do what is missing in the kept results first, and keep it.")
@click.option("--search", is_flag=True, help="Search with more placements, and keep what is found.")
@click.option("--figure", default="mount.png", help="File of the picture.", show_default=True)
def main(full: bool, search: bool, figure: str) -> None:
    """Answer O1, and draw the answer."""
    result = MountAnswer.of(read_results(RESULTS)) if RESULTS.exists() else None
    if full or result is None:
        result = answer_mount(result, keep=lambda answer: write_results(RESULTS, answer, command=COMMAND))
    for placement in result.placements:
        click.echo(f"{placement.name}, {placement.rule}: {placement.tried.mean:.2f} where they were found")
    for placement in result.judged:
        click.echo(f"{_words(placement)}; the one found sees {_gain(result, placement)} more")
    click.echo(f"found {_place(result.best.pose)} by {result.candidates} placements ({result.status})")
    click.echo(f"{result.verdict}; holds: {result.holds}")
    if search:
        write_results(LONG_RESULTS, long_search(result), command=LONG_COMMAND)
    if LONG_RESULTS.exists():
        longer = LongSearch.of(read_results(LONG_RESULTS))
        click.echo(f"{longer}: {_place(longer.pose)}; {longer.status}")
    plot_answer(result).savefig(figure, dpi=110)


def _gain(answer: MountAnswer, placement: Placement) -> str:
    lower, mean, upper = answer.gain(placement)
    return f"{mean:.2f} [{lower:.2f}, {upper:.2f}]"


if __name__ == "__main__":
    # Under its own name, so that worker processes find its functions.
    from vtbdrake_diagrams.satellite.studies.mount import main as program

    program(prog_name="python -m vtbdrake_diagrams.satellite.studies.mount")
