"""Application O1: where should the docking camera sit to see as many markers as possible during the capture?

The capture is led by a pose sensor, and the camera looks on: so the motion does not depend on the camera, and is
recorded once for every capture (`vtbdrake.RecordedMotion`). The camera sits at the front face of the base, on which the
arm stands, too. All six numbers of its pose are decided.

The choices that influence the answer were fixed before the first placement was judged:

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
from vtbdrake.components.perception.markers import detect_markers, pose_from_markers
from vtbdrake.rollout import RolloutResult, RolloutRunner
from vtbdrake.state import NamedVector, Quantity
from vtbdrake.state.systems import pose_from_array, pose_later, pose_to_array
from vtbdrake.visualization.plots import Picture, draw_mesh, finish, mark_best
from vtbdrake.visualization.study_plots import BEST
from vtbdrake_diagrams.answers import Answer
from vtbdrake_diagrams.kept_results import Repetition, read_results, repeat, write_results
from vtbdrake_diagrams.satellite.bodies import Servicer, Target
from vtbdrake_diagrams.satellite.perception import target_board
from vtbdrake_diagrams.satellite.scenario import SatelliteScenario
from vtbdrake_diagrams.satellite.start import random_start
from vtbdrake_diagrams.satellite.studies.grips import FAILURE, guided_grips

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
_EXPOSURE = "sim.sense.docking_camera.exposure"
_BODIES = ("sim.sys.servicer.base", "sim.sys.target.body")
_MOTION = tuple(f"{body}.{value}" for body in _BODIES for value in ("pose", "velocity"))

HORIZON = 24.0
"""How long the markers count, in s: from the start until the relative motion has stopped."""
SAMPLE_PERIOD = 4.0
"""How often they are counted, in s."""
TUMBLES = (0.5, 1.0, 1.5, 2.0, 3.0)
"""The tumble rates of the captures, in deg/s: up to the one at which captures must succeed."""
TELLING = 0.3
"""The least difference of mean counts that means anything, in markers."""
GLOBAL = 10
"""The number of placements that the default solver tries, beside those by hand."""
LOCAL = 14
"""The number of placements that COBYLA tries after them."""
GUIDED = 5
"""The number of captures of `JUDGED_ON` that the cameras guide."""
GUIDED_HORIZON = 36.0
"""How long a capture that the camera guides may take, in s."""
GUIDED_RATE = 2.5
"""The images per second of a camera that guides, in Hz: less than usual, because images are what a capture costs."""
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

# The least place of the camera along x of B, in m: 2 cm before the front face; a bracket reaches 10 cm farther.
_X = 0.62
_BRACKET = 0.1
# Largest distance from the middle of the face at which the camera's housing fits on it, in m.
_REACH = 0.45
# How far the view may turn away from straight ahead, and about its axis, in rad.
_TURN = 0.8
_TWIST = 1.2
# How far the camera stays away from the axis of the arm's foot, in m.
_FOOT = 0.18
# How far the base turns down while the arm reaches out, in rad: 17 to 20 deg.
_REACTION = 0.33


@dataclass(frozen=True)
class Capture:
    """A capture: its start and its tumble rate.

    Attributes:
        seed: The seed of the start.
        tumble_deg: The tumble rate in deg/s.
    """

    seed: int
    tumble_deg: float = SatelliteScenario.tumble_deg

    def values(self) -> dict[str, Any]:
        """Return the values that make a rollout start as in a scenario with this seed and rate."""
        start = random_start(self.seed, tumble=np.radians(self.tumble_deg), distance=SatelliteScenario.distance)
        return start.values()


def captures(first: int, count: int) -> tuple[Capture, ...]:
    """Return captures with the seeds from ``first`` on, at all rates of `TUMBLES` in turn."""
    return tuple(Capture(first + k, TUMBLES[k % len(TUMBLES)]) for k in range(count))


FOUND_ON = captures(0, 5)
"""The captures on which placements are found."""
JUDGED_ON = captures(100, 20)
"""The captures on which they are judged."""
LONG_JUDGED_ON = captures(200, 20)
"""The captures on which the long search is judged; nothing else was judged on them."""


def pose(y: float, z: float, *, tilt: float = 0.0, pan: float = 0.0) -> Array:
    """Return [x, y, z, roll, pitch, yaw] of the camera in B, on the front face.

    Args:
        y: To the left, in m.
        z: Up, in m.
        tilt: How far it looks down, in rad.
        pan: How far it looks to the left, in rad.
    """
    return _ENTRIES.array(x=_X, y=y, z=z, roll=-np.pi / 2 - tilt, yaw=-np.pi / 2 + pan)


def aimed(y: float, z: float, p_BQ: Array | None = None) -> Array:
    """Return the pose of a camera on the front face that looks at a point.

    Args:
        y: Place of the camera to the left, in m.
        z: Its place up, in m.
        p_BQ: The point in B, in m; by default the place where the bar is gripped, as if the base stood still.
    """
    if p_BQ is None:
        p_BQ = np.array([SatelliteScenario.distance, 0.0, 0.0]) + Target().X_TH.translation()
    ahead, left, up = p_BQ - [_X, y, z]
    return pose(y, z, tilt=float(np.arctan2(-up, np.hypot(ahead, left))), pan=float(np.arctan2(left, ahead)))


PLACES: dict[str, tuple[float, float]] = {
    "above the arm": Servicer().camera_position[1:],
    "on the left": (0.4, 0.0),
    "on the right": (-0.4, 0.0),
    "in the upper left corner": (0.4, 0.4),
    "beside the foot of the arm": (0.25, -0.35),
}
"""The places by hand: y and z in B, in m."""

BY_HAND: dict[str, Array] = {
    name: pose_to_array(Servicer().X_BC) if name == "above the arm" else aimed(*place) for name, place in PLACES.items()
}
"""The placements by hand as if the base stood still."""

STILL = "as if the base stood still"
TURNED = "turned up by the turn of the base"
RULES = (STILL, TURNED)
"""How placements by hand are aimed. `TURNED` knows how the base reacts to the arm."""


def by_hand(rule: str) -> dict[str, Array]:
    """Return the placements by hand that a rule of `RULES` aims."""
    turn = _REACTION if rule == TURNED else 0.0
    return {name: value + _ENTRIES.array(roll=turn) for name, value in BY_HAND.items()}


def _address(name: str) -> str:
    """Return the address of an entry of the pose."""
    return f"{POSE}[{_ENTRIES.slice_of(name).start}]"


PARAMETERS = (
    vtb.Parameter(_address("x"), _X, _X + _BRACKET),
    vtb.Parameter(_address("y"), -_REACH, _REACH),
    vtb.Parameter(_address("z"), -_REACH, _REACH),
    vtb.Parameter(_address("roll"), -np.pi / 2 - _TURN, -np.pi / 2 + _TURN),
    vtb.Parameter(_address("pitch"), -_TWIST, _TWIST),
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


def mount_problem(
    parameters: Sequence[vtb.Parameter] = PARAMETERS,
    *,
    on: Sequence[Capture] = FOUND_ON,
    reading: str = "integral",
    fixed: Mapping[str, float] | None = None,
    recorded: bool = True,
) -> vtb.Problem:
    """State the question in the paper's five steps.

    Args:
        parameters: Entries of the camera's pose.
        on: The captures over which the quality is averaged.
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
        conditions=[{**capture.values(), **(fixed or {})} for capture in on],
        risk="mean",
        constraints=[vtb.Constraint(distance_from_foot, of=POSE, at_least=_FOOT)],
        motion=vtb.RecordedMotion(memory, while_recording={_EXPOSURE: 0.0}) if recorded else None,
    )


# -- looking on


@dataclass(frozen=True)
class Look:
    """What a camera sees in some captures.

    Attributes:
        counts: The markers at the sample times after the start, shape (captures, samples).
        errors: How far the pose from an image's markers has the bar off, in m, likewise; NaN where there is no pose.
    """

    counts: Array
    errors: Array

    @property
    def means(self) -> Array:
        """Return the mean number of markers over each capture, by the trapezoidal rule, shape (captures,)."""
        from_start = np.concatenate([np.zeros_like(self.counts[:, :1]), self.counts], axis=1)
        means: Array = np.trapezoid(from_start, dx=SAMPLE_PERIOD, axis=1) / HORIZON
        return means

    @property
    def mean(self) -> float:
        """Return the mean number of markers."""
        return float(self.means.mean())

    @property
    def most(self) -> float:
        """Return the mean over the captures of the maximum over time, the paper's quality."""
        return float(self.counts.max(axis=1).mean())

    @property
    def posed(self) -> float:
        """Return the share of the images that give a pose."""
        return float(np.isfinite(self.errors).mean())

    @property
    def accuracy(self) -> float:
        """Return the median error of the bar over the images that give a pose, in m; NaN if none does."""
        return float(np.nanmedian(self.errors)) if self.posed else float("nan")

    @staticmethod
    def of(stored: Mapping[str, Any]) -> Look:
        """Return what was kept."""
        return Look(np.array(stored["counts"], dtype=float), np.array(stored["errors"], dtype=float))


class Onlooker:
    """Judges placements along recorded captures, one capture and placement at a time.

    Args:
        on: The captures.
    """

    def __init__(self, on: Sequence[Capture]) -> None:
        self.problem = mount_problem(on=on)
        self._count = len(on)
        task = replace(self.problem.task, record=(IMAGE, *_MOTION), catch=False)
        self._runner = RolloutRunner(task, self.problem.testbed)
        info = self.problem.scenario.camera_info  # type: ignore[attr-defined]
        self._intrinsics = np.array([info.focal_x(), info.focal_y(), info.center_x(), info.center_y()])
        self._board = target_board()

    def rollout(self, value: Array, capture: int = 0) -> RolloutResult:
        """Return the rollout with a placement in a capture, with its images and the motion."""
        rollout = self._runner.run(self.problem.values(value.tolist(), condition=capture))
        if rollout.failed:
            raise ValueError(f"the camera at {value.tolist()} cannot be judged: {rollout.message}")
        return rollout

    def look(self, value: Array) -> Look:
        """Return what a camera with this pose sees in all captures."""
        rollouts = [self.rollout(value, k) for k in range(self._count)]
        return Look(
            np.array([rollout.quality[1:] for rollout in rollouts]),
            np.array([self._errors(rollout, value) for rollout in rollouts]),
        )

    def _errors(self, rollout: RolloutResult, value: Array) -> list[float]:
        """Return the error of the bar by each image after the start, in m."""
        X_BC, p_THo = pose_from_array(value), Target().X_TH.translation()
        age = -1.0 / self.problem.scenario.camera_fps  # type: ignore[attr-defined]
        errors = []
        for k in range(1, len(rollout.times)):
            X_WB, X_WT = (
                pose_from_array(
                    pose_later(rollout.record[f"{body}.pose"][k], rollout.record[f"{body}.velocity"][k], age)
                )
                for body in _BODIES
            )
            X_CT = (X_WB @ X_BC).InvertAndCompose(X_WT)
            detections = detect_markers(rollout.record[IMAGE][k]).on(self._board)
            # The tracker's prediction, which decides between two poses of markers in a plane, is near the truth.
            estimate = pose_from_markers(detections, self._board, self._intrinsics, time=0.0, prediction=X_CT)
            errors.append(float(np.linalg.norm(estimate.X @ p_THo - X_CT @ p_THo)) if estimate.valid else np.nan)
        return errors


# -- guiding


@dataclass(frozen=True)
class Guided:
    """The captures that a camera has guided.

    Attributes:
        times: When the fingers held the bar, in s, `FAILURE` if they never did, shape (captures,).
        errors: How far the bar was from where the DPS believed it then, in m; NaN without success.
    """

    times: Array
    errors: Array

    @property
    def successes(self) -> int:
        """Return how many captures succeeded."""
        return int((self.times < FAILURE).sum())


def guide(value: Array, on: Sequence[Capture]) -> Guided:
    """Simulate captures that a camera with this pose guides, alone and without wheels."""
    guided = SatelliteScenario(perception="camera", camera_fps=GUIDED_RATE, camera_pose=value.tolist())
    return Guided(*guided_grips(guided, [capture.values() for capture in on], horizon=GUIDED_HORIZON))


# -- the campaign


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
    axis = np.linspace(-_REACH, _REACH, points)
    mean, most = np.full((2, points, points), np.nan)
    for i, y in enumerate(axis):
        for k, z in enumerate(axis):
            value = best.copy()
            value[1:3] = y, z
            if distance_from_foot(value) >= _FOOT:
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
    axes.add_patch(Circle(Servicer().shoulder[1:], _FOOT, fill=False, color="white", ls=":"))
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
    camera = _ENTRIES.view(value)
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
