"""Application O3: which parameters of the robot are best under different lighting?

The docking camera alone leads the capture. What is decided are ten parameters of the robot: speeds, gains and
acceleration of its controller, the process noises of its filter, two settings of its marker detector and the exposure
of its camera. The lights are conditions: the sun in front of the target, where the servicer throws its shadow on it;
beside it; grazing its face; and behind it, where only a lamp on the camera helps. A candidate has two qualities: the
time until the fingers hold the bar, and how far the bar then is from where it is perceived.

The answer has four stages, and each capture of all of them is kept:

* **Screening.** A study with both qualities, of candidates by hand and of a Sobol design, in `SCREENED_ON`: every light
  once. It gives the front, and the best for each light alone.
* **Race.** The best of the screening and the constants that the robot has today are compared in `RACED_ON`, eight
  starts with each light twice, by the mean of the worst quarter (`RISK`). The error of the bar has a bound there. A
  candidate that can no longer win is dropped; what is left of the budget goes to candidates of another design.
* **Judgement.** The winner and today's constants, on `JUDGED_ON`: other starts, the same lights and two others.
* **Sensitivities.** One parameter after the other at the upper end of its range, in `VARIED_ON`: twice to four times
  today's constant, and nothing else.

All of this was fixed before the first capture. ``python -m vtbdrake_diagrams.satellite.studies.lighting --full``
simulates what is missing in ``lighting.json`` beside this module, and keeps each capture: it may be ended and
continued. Without ``--full`` the results are read. The row of the answers reads them, and simulates a few captures
anew.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import click
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from pydrake.systems.framework import Diagram
from scipy.stats import t as student

import vtbdrake as vtb
from vtbdrake.common.arrays import Array
from vtbdrake.optimization import Risk
from vtbdrake.rollout import Executor, RolloutResult, RolloutRunner, RolloutTask, SerialExecutor
from vtbdrake.rollout.pruning import Cutoff
from vtbdrake.rollout.start import Starts
from vtbdrake.state.systems import pose_from_array
from vtbdrake.visualization.plots import Picture, finish
from vtbdrake.visualization.study_plots import BEST
from vtbdrake_diagrams.answers import Answer
from vtbdrake_diagrams.kept_results import KeptResultsError, read_results, write_results
from vtbdrake_diagrams.satellite.bodies import Target
from vtbdrake_diagrams.satellite.relative_motion import Relative
from vtbdrake_diagrams.satellite.scenario import SatelliteScenario
from vtbdrake_diagrams.satellite.start import random_start
from vtbdrake_diagrams.satellite.supervisor import Mode

HORIZON = 36.0
"""How long a capture may take, in s: twice as long as with today's constants and the sun beside."""
FAILURE = 60.0
"""The cost of a capture that was aborted, in s."""
UNFINISHED = 61.0
"""The cost of a capture that neither holds the bar nor was aborted by `HORIZON`, in s; a rollout ends when its cost is
below."""
LARGEST_ERROR = 0.012
"""The largest error of the perceived bar that a grip allows, in m: the supervisor's ``grip_tolerance``. It is also the
error of a capture that failed."""
ACCURACY = 0.006
"""The largest mean error of the perceived bar in any light, in m: half of what the supervisor allows the gripper to be
off, since that comes on top."""
SAMPLE_PERIOD = 0.2
"""Sample period of the costs, in s."""
TELLING = 0.5
"""The least difference of mean times that means anything, in s: the cost has a period of 0.2 s."""
FASTER = "faster than"
"""How the choice compares with today's constants if the interval of its gain is above 0, and reaches `TELLING`."""
AS_FAST = "as fast as"
"""How it compares if that interval is within `TELLING` about 0: then the parameters do not matter."""
TELLING_ERROR = 1e-3
"""The least difference of errors that means anything, in m: today's constants are about as far off."""
MODE = "dps.impl.supervisor.mode"
RECORDED = ("sim.sys.servicer.base.pose", "sim.sys.target.body.pose", "dps.impl.relative.relative")
"""What the error of the bar is found from: the true poses, and a `Relative`."""

_DIRECTION = "sim.env.light.direction"
_INTENSITY = "sim.env.light.intensity"
_EARTH = "sim.env.light.earth_shine"
_LAMP = "sim.sense.docking_camera.lamp"


def _beside(angle_deg: float, *, turned_deg: float = 0.0) -> tuple[float, float, float]:
    """Return the direction of sunlight at an angle from the normal of the face that the camera sees.

    Args:
        angle_deg: The angle from the normal, in deg.
        turned_deg: From which side, in deg: 0 from the right, 90 from below.
    """
    angle, turned = np.radians(angle_deg), np.radians(turned_deg)
    across = np.sin(angle) * np.array([np.cos(turned), np.sin(turned)])
    return float(np.cos(angle)), *across.tolist()


LIGHTS: dict[str, dict[str, Any]] = {
    "front, own shadow": {_DIRECTION: (1.0, 0.25, -0.25), _LAMP: 0.0},
    "beside, 70 deg": {_DIRECTION: _beside(70.0), _LAMP: 0.0},
    "grazing, 86 deg": {_DIRECTION: _beside(86.0), _LAMP: 0.0},
    "behind, lamp": {_DIRECTION: (-0.9, 0.3, -0.3), _LAMP: 2.0},
}
"""The lights under which candidates are compared, by name."""
OTHER_LIGHTS: dict[str, dict[str, Any]] = {
    "grazing from above, 82 deg": {_DIRECTION: _beside(82.0, turned_deg=-90.0), _LAMP: 0.0},
    "eclipse, lamp": {_INTENSITY: 0.0, _EARTH: 0.0, _LAMP: 2.0},
}
"""Lights for the judgement alone."""


@dataclass(frozen=True)
class Case:
    """A light and a start.

    Attributes:
        light: Name of the light.
        seed: Seed of the start.
    """

    light: str
    seed: int

    def condition(self) -> dict[str, Any]:
        """Return the light, and the values that make the capture start as in a scenario with this seed."""
        scenario = LightingScenario()
        start = random_start(self.seed, tumble=np.radians(scenario.tumble_deg), distance=scenario.distance)
        return {**(LIGHTS | OTHER_LIGHTS)[self.light], **start.values()}


def cases(lights: Sequence[str], seeds: Sequence[int]) -> tuple[Case, ...]:
    """Return a case for each start, with the lights in turn."""
    return tuple(Case(lights[k % len(lights)], seed) for k, seed in enumerate(seeds))


SEEDS = tuple(range(201, 209))
"""The starts of screening and race."""
SCREENED_ON = cases(tuple(LIGHTS), SEEDS[:4])
"""The cases of the screening: four starts, a light each."""
RACED_ON = cases(tuple(LIGHTS), SEEDS)
"""The cases of the race, the screening's included: eight starts, each light twice."""
JUDGED_ON = cases((*OTHER_LIGHTS, *LIGHTS), tuple(range(301, 321)))
"""The cases of the judgement: 20 other starts, three or four for each of the six lights."""
VARIED_ON = SCREENED_ON[1:3]
"""The cases of the sensitivities: the sun beside, and grazing."""
RISK = vtb.CVaR(0.25)
"""The risk of the race: the mean of the worst quarter of its cases."""
CANDIDATES = 5
"""The number of candidates of the screening, with `BY_HAND`, if the kept results have no other."""
FINALISTS = 2
"""How many candidates of the screening race with today's constants."""
RACE_BUDGET = 3 * len(RACED_ON)
"""The number of captures that the race may take, the screening's included."""
RERUN = 3
"""How many captures the row simulates anew."""
CONFIDENCE = 0.9
"""Confidence of the interval."""
RESULTS = Path(__file__).with_suffix(".json")
"""The results that ``--full`` keeps."""
COMMAND = "python -m vtbdrake_diagrams.satellite.studies.lighting --full"

PARAMETERS = (
    vtb.Parameter("dps.impl.controller.speed", 0.06, 0.24, log=True),
    vtb.Parameter("dps.impl.supervisor.closing_speed", 0.03, 0.12, log=True),
    vtb.Parameter("dps.impl.controller.position_gain", 0.5, 2.0, log=True),
    vtb.Parameter("dps.impl.controller.orientation_gain", 0.5, 2.0, log=True),
    vtb.Parameter("dps.impl.controller.acceleration", 0.05, 0.2, log=True),
    vtb.Parameter("dps.env.target.rate_noise", 2.5e-4, 4e-3, log=True),
    vtb.Parameter("dps.env.target.velocity_noise", 2.5e-4, 4e-3, log=True),
    vtb.Parameter("sim.sense.docking_camera.exposure", 0.5, 4.0, log=True),
    vtb.Parameter("scenario.threshold", 2.0, 12.0, log=True),
    vtb.Parameter("scenario.min_width", 6.0, 13.0, log=True),
)
"""The parameters: about half to twice of today's constants, four times for noises and light."""
Values = tuple[float, ...]
TODAY: Values = (0.12, 0.06, 1.0, 1.0, 0.1, 1e-3, 1e-3, 1.0, 7.0, 9.0)
"""The constants that the robot has."""
LOWER_THRESHOLD: Values = (*TODAY[:8], 3.0, 9.0)
"""Today's constants with another threshold of the detector: the best of six candidates from one start, before."""
LONGER_EXPOSURE: Values = (*TODAY[:7], 1.5, *TODAY[8:])
"""Today's constants with a longer exposure: the second of these."""
VARIED: tuple[Values, ...] = tuple((*TODAY[:k], p.upper, *TODAY[k + 1 :]) for k, p in enumerate(PARAMETERS))
"""Today's constants but for one parameter, which is at the upper end of its range, in the order of the parameters."""
BY_HAND = {"today": TODAY, "threshold 3": LOWER_THRESHOLD, "exposure 1.5": LONGER_EXPOSURE}
"""The candidates by hand, first the baseline."""


@dataclass
class LightingScenario(SatelliteScenario):
    """A capture that the camera leads alone; two settings of its marker detector are fields."""

    perception: str = "camera"
    # Without them the arm's reaction turns the base, until the target leaves the image.
    wheels: bool = True
    # Slow, because images are what a capture costs.
    camera_fps: float = 2.0
    # What the detector's adaptive threshold subtracts from the mean, see `MarkerDetectorConfig`.
    threshold: float = 7.0
    # The edge of the smallest marker that it finds, in pixels.
    min_width: float = 9.0

    def make_dps(self) -> Diagram:
        detector = replace(self.evaluation.detector, threshold=self.threshold, min_width=self.min_width)
        scenario = replace(self, evaluation=replace(self.evaluation, detector=detector))
        return super(LightingScenario, scenario).make_dps()


# -- the costs


def time_to_grip(mode: float, time: float) -> float:
    """Return the time of the DPS if the fingers hold the bar, else `FAILURE`."""
    return time if mode in (Mode.RETREAT, Mode.HOLD) else FAILURE


def time_to_end(mode: float, time: float) -> float:
    """Return the cost of the time: as `time_to_grip`, but `UNFINISHED` while the capture still goes on."""
    return time_to_grip(mode, time) if mode >= Mode.RETREAT else UNFINISHED


def bar_error(base: Array, target: Array, relative: Array) -> float:
    """Return how far the bar is from where the DPS believes it, seen from the base, in m.

    Args:
        base: The pose of the base in the world, [x, y, z, roll, pitch, yaw] in m and rad.
        target: The pose of the target, likewise.
        relative: A `Relative` as a vector.
    """
    X_BT = pose_from_array(base).InvertAndCompose(pose_from_array(target))
    return float(np.linalg.norm(X_BT @ Target().X_TH.translation() - Relative(relative).p_BH))


def error_at_grip(mode: float, base: Array, target: Array, relative: Array) -> float:
    """Return the cost of the accuracy: the error of the bar while it is held, in m; else `LARGEST_ERROR`."""
    return bar_error(base, target, relative) if mode in (Mode.RETREAT, Mode.HOLD) else LARGEST_ERROR


_TIME = vtb.Quality(time_to_end, of=[MODE, "dps.env.base.time"], minimize=True, unit="s")
_ERROR = vtb.Quality(error_at_grip, of=[MODE, *RECORDED], reading="end", minimize=True, unit="m")
_BOUND = vtb.Constraint(error_at_grip, of=[MODE, *RECORDED], reading="end", at_most=LARGEST_ERROR, unit="m")


def lighting_problem(
    on: Sequence[Case] = RACED_ON, *, two_qualities: bool = False, risk: str | Risk = RISK
) -> vtb.Problem:
    """State the question. A rollout ends when the bar is held or the capture is aborted.

    Args:
        on: The cases, which are its conditions.
        two_qualities: Whether time and error are both qualities; else the error is bounded in every case.
        risk: How the costs in the cases become one.
    """
    return vtb.Problem(
        scenario=LightingScenario(),
        parameters=PARAMETERS,
        quality=[_TIME, _ERROR] if two_qualities else _TIME,
        constraints=[] if two_qualities else [_BOUND],
        horizon=HORIZON,
        sample_period=SAMPLE_PERIOD,
        threshold=UNFINISHED,
        conditions=[case.condition() for case in on],
        risk=risk,
    )


# -- captures


@dataclass(frozen=True)
class Capture:
    """The result of a capture.

    Attributes:
        time: When the fingers held the bar, in s; `FAILURE` or `UNFINISHED` without success.
        error: How far the bar then was from where it was perceived, in m; `LARGEST_ERROR` without success.
    """

    time: float
    error: float

    @property
    def failed(self) -> bool:
        """Return whether the fingers never held the bar."""
        return self.time >= FAILURE


Key = tuple[Values, Case]


class KeptCaptures(Executor):
    """Runs captures one after another; those that are kept already are not simulated again.

    Args:
        captures: The captures so far; new ones are added.
        keep: Is called after each new capture; None: nothing is simulated.
    """

    cancels = False

    def __init__(self, captures: dict[Key, Capture], keep: Callable[[], Any] | None = None) -> None:
        self._captures, self._keep, self._serial = captures, keep, SerialExecutor()
        self._cases = {_mark(case.condition()): case for case in {*SCREENED_ON, *RACED_ON, *JUDGED_ON}}

    def key(self, point: Mapping[str, Any]) -> Key:
        """Return the candidate and the case of the values of a rollout, by address."""
        addresses = [parameter.address for parameter in PARAMETERS]
        condition = {address: value for address, value in point.items() if address not in addresses}
        return tuple(float(point[address]) for address in addresses), self._cases[_mark(condition)]

    def run(
        self,
        task: RolloutTask,
        points: Sequence[Mapping[str, Any]],
        *,
        start: Starts = None,
        cutoff: Cutoff | None = None,
    ) -> Iterator[tuple[int, RolloutResult]]:
        """Run one capture per point; see `Executor.run`.

        Raises:
            KeptResultsError: A capture is not kept, and nothing is to be simulated.
        """
        for index, point in enumerate(points):
            values, case = key = self.key(point)
            if key not in self._captures:
                if self._keep is None:
                    raise KeptResultsError(f"{case} with {text(values)} was not simulated: {COMMAND} goes on")
                self._captures[key] = self._simulated(task, point, start)
                self._keep()
            yield index, _as_result(task, point, self._captures[key])

    def _simulated(self, task: RolloutTask, point: Mapping[str, Any], start: Starts) -> Capture:
        ((_, result),) = self._serial.run(task, [point], start=start)
        if result.failed:
            raise RuntimeError(f"the simulation of a capture failed with {dict(point)}: {result.message}")
        (measure,), (value,) = task.measures, result.measures
        limit = measure.at_most if isinstance(measure, vtb.Constraint) else 0.0
        return Capture(result.value, value + limit)

    def close(self) -> None:
        """Release the testbeds."""
        self._serial.close()


def _as_result(task: RolloutTask, point: Mapping[str, Any], capture: Capture) -> RolloutResult:
    """Return the result of a rollout that has this capture."""
    times, quality = np.array([min(capture.time, HORIZON)]), task.quality
    assert quality is not None
    h = quality.quality(np.array([capture.time]))
    return RolloutResult(
        parameters=dict(point),
        end="horizon" if capture.time == UNFINISHED else "threshold",
        times=times,
        quality=h,
        t_star=float(times[0]),
        h=float(h[0]),
        value=capture.time,
        measures=tuple(float(m.read(times, np.array([capture.error]))) for m in task.measures),
    )


def _mark(condition: Mapping[str, Any]) -> tuple[Any, ...]:
    return tuple((address, *np.ravel(value).tolist()) for address, value in sorted(condition.items()))


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
    errors = [
        bar_error(*(r.record[a][-1] for a in RECORDED)) if t < FAILURE else np.nan
        for r, t in zip(rollouts, times, strict=True)
    ]
    return np.array(times), np.array(errors)


# -- the three stages


@dataclass(frozen=True)
class Screening:
    """The result of the screening.

    Attributes:
        candidates: The candidates, first those `BY_HAND`.
        costs: The mean time in s and the mean error in m of each, shape (n, 2).
        front: The candidates that no other one beats in both.
    """

    candidates: tuple[Values, ...]
    costs: Array
    front: tuple[Values, ...]

    @property
    def finalists(self) -> tuple[Values, ...]:
        """Return the fastest candidates but today's constants; of equally fast ones the more accurate."""
        order = np.lexsort((self.costs[:, 1], self.costs[:, 0]))
        return tuple(self.candidates[k] for k in order if self.candidates[k] != TODAY)[:FINALISTS]


@dataclass(frozen=True)
class Race:
    """The result of the race.

    Attributes:
        candidates: The candidates.
        costs: The mean of the worst quarter of each, in s, shape (n,); of one that was dropped a lower bound.
        exact: Whether a candidate was tried in all cases, shape (n,).
        choice: The winner.
    """

    candidates: tuple[Values, ...]
    costs: Array
    exact: NDArray[np.bool_]
    choice: Values


class Campaign:
    """The three stages, on captures that are kept.

    Args:
        captures: The captures so far; new ones are added.
        keep: Is called after each new capture; None: nothing is simulated.
        echo: Gets a line for each new capture.
    """

    def __init__(
        self,
        captures: dict[Key, Capture],
        *,
        keep: Callable[[], Any] | None = None,
        echo: Callable[[str], Any] = lambda line: None,
    ) -> None:
        self.captures = captures

        def keep_newest() -> None:
            (values, case), capture = list(captures.items())[-1]
            echo(f"{len(captures)}: {text(values)}; {case.light}, start {case.seed}: {capture}")
            if keep is not None:
                keep()

        self._executor = KeptCaptures(captures, None if keep is None else keep_newest)

    def screen(self, candidates: int = CANDIDATES) -> Screening:
        """Try the candidates of the design, and those `BY_HAND`, ``candidates`` together."""
        problem = lighting_problem(SCREENED_ON, two_qualities=True, risk="mean")
        with problem.study(solver="sobol") as study:
            study.add(*BY_HAND.values())
            study.run(rollouts=candidates * len(SCREENED_ON), executor=self._executor, progress=False)
            trials = study.trials
            front = tuple(trial.point for trial in study.pareto())
        return Screening(tuple(t.point for t in trials), np.array([t.values for t in trials]), front)

    def race(self, screening: Screening) -> Race:
        """Race the constants of today, the best of the screening, and what the budget allows of another design."""
        with lighting_problem(RACED_ON).study(solver="sobol", seed=1) as study:
            study.add(TODAY, *screening.finalists)
            study.run(rollouts=RACE_BUDGET, racing=True, executor=self._executor, progress=False)
            trials, choice = study.trials, study.best.point
        costs, exact = np.array([t.value for t in trials]), np.array([t.exact for t in trials])
        return Race(tuple(t.point for t in trials), costs, exact, choice)

    def judge(self, choice: Values) -> None:
        """Simulate the captures of the judgement, with today's constants and the choice in turn."""
        self._simulate(dict.fromkeys((TODAY, choice)), JUDGED_ON)

    def vary(self) -> None:
        """Simulate the captures of the sensitivities."""
        self._simulate(VARIED, VARIED_ON)

    def _simulate(self, candidates: Iterable[Values], on: Sequence[Case]) -> None:
        problem = lighting_problem(on)
        points = [problem.values(values, condition=k) for k in range(len(on)) for values in candidates]
        for _ in self._executor.run(problem.task, points):
            pass


# -- the answer


@dataclass(frozen=True)
class LightingAnswer:
    """The answer to O3.

    Attributes:
        captures: All captures by candidate and case.
        screening: The result of the screening.
        race: The result of the race.
    """

    captures: Mapping[Key, Capture]
    screening: Screening
    race: Race

    @property
    def choice(self) -> Values:
        """Return the winner of the race."""
        return self.race.choice

    @cached_property
    def judged(self) -> tuple[Case, ...]:
        """Return the cases of the judgement that both today's constants and the choice were tried in."""
        tried = (TODAY, self.choice)
        return tuple(case for case in JUDGED_ON if all((values, case) in self.captures for values in tried))

    def of(self, values: Values, on: Sequence[Case], light: str = "") -> list[Capture]:
        """Return the captures of a candidate in some cases, by default under all lights."""
        return [self.captures[values, case] for case in on if light in ("", case.light)]

    @property
    def gain(self) -> tuple[float, float, float]:
        """Return by how much the choice is faster than today's constants where it is judged: (lower, mean, upper) in s.

        A failure costs `FAILURE`. The interval is Student's for pairs, with `CONFIDENCE`.
        """
        costs = np.array([[min(c.time, FAILURE) for c in self.of(v, self.judged)] for v in (TODAY, self.choice)])
        gains = costs[0] - costs[1]
        mean, n = float(gains.mean()), len(gains)
        half = float(student.ppf(0.5 + CONFIDENCE / 2.0, n - 1) * gains.std(ddof=1) / np.sqrt(n))
        return mean - half, mean, mean + half

    @property
    def comparison(self) -> str:
        """Return in words how the choice compares with today's constants where it is judged, by its `gain`."""
        if len(self.judged) < 2:
            return "not judged yet"
        lower, _, upper = self.gain
        if lower > -TELLING and upper < TELLING:
            return AS_FAST
        if lower > 0.0:
            return FASTER
        return "slower than" if upper < 0.0 else "not shown to be faster, slower or as fast as"

    @property
    def claims(self) -> dict[str, bool]:
        """Return what must be true of the judgement, with its truth."""
        lights = {case.light for case in self.judged}
        ends = {light: [self.of(v, self.judged, light) for v in (TODAY, self.choice)] for light in lights}
        errors = [mean_error(captures) for _, captures in ends.values()]
        return {
            "judged on 20 other starts and two other lights": len(self.judged) >= 20 and lights >= set(OTHER_LIGHTS),
            "no more failures than today in any light": all(
                sum(c.failed for c in now) <= sum(c.failed for c in before) for before, now in ends.values()
            ),
            f"the bar within {1e3 * ACCURACY:g} mm in the mean of every light": not any(e > ACCURACY for e in errors),
            f"faster than today, or as fast within {TELLING:g} s, with confidence": self.comparison
            in (FASTER, AS_FAST),
        }

    @property
    def holds(self) -> bool:
        """Return whether all `claims` are true."""
        return all(self.claims.values())

    @property
    def best_alone(self) -> dict[str, tuple[Values, float, float]]:
        """Return the fastest candidate of the screening under each light alone.

        With its time, and the time that the choice takes in the same case, both in s.
        """
        best = {}
        for case in SCREENED_ON:
            tried = [(c.time, c.error, v) for v in self.screening.candidates if (c := self.captures[v, case])]
            time, _, values = min(tried)
            best[case.light] = values, time, self.captures[self.choice, case].time
        return best

    @property
    def sensitivities(self) -> dict[str, dict[Case, Capture]]:
        """Return the captures with one parameter at the upper end of its range, by address and case.

        Those that were not simulated yet are missing.
        """
        return {
            parameter.address: {
                case: self.captures[values, case] for case in VARIED_ON if (values, case) in self.captures
            }
            for parameter, values in zip(PARAMETERS, VARIED, strict=True)
        }

    @property
    def telling(self) -> dict[str, bool]:
        """Return by address whether a parameter matters: whether its captures come out differently from today's.

        Later or earlier by more than `TELLING`, or with an error that differs by more than `TELLING_ERROR`.
        """
        return {
            address: any(
                abs(capture.time - self.captures[TODAY, case].time) > TELLING
                or abs(capture.error - self.captures[TODAY, case].error) > TELLING_ERROR
                for case, capture in captures.items()
            )
            for address, captures in self.sensitivities.items()
            if len(captures) == len(VARIED_ON)
        }

    @property
    def verdict(self) -> str:
        """Return in words what the choice is worth."""
        if self.choice == TODAY:
            return "no candidate is better than today's constants"
        if len(self.judged) < 2:
            return self.comparison
        lower, mean, upper = self.gain
        return f"{self.comparison} today's constants: {mean:.2f} s [{lower:.2f}, {upper:.2f}] faster in the mean"


def mean_error(captures: Sequence[Capture]) -> float:
    """Return the mean error of the captures that succeeded, in m; NaN if none did."""
    errors = [capture.error for capture in captures if not capture.failed]
    return float(np.mean(errors)) if errors else np.nan


def answer_lighting(
    captures: dict[Key, Capture],
    *,
    candidates: int = CANDIDATES,
    keep: Callable[[], Any] | None = None,
    echo: Callable[[str], Any] = lambda line: None,
) -> LightingAnswer:
    """Answer O3 from the captures so far; a missing one takes about ten seconds of processor time.

    Args:
        captures: The captures so far; new ones are added.
        candidates: The number of candidates of the screening.
        keep: Is called after each new capture; None: nothing is simulated, and the last two stages may be incomplete.
        echo: Gets a line for each new capture.

    Raises:
        KeptResultsError: Captures of screening or race are missing, and nothing is to be simulated.
    """
    campaign = Campaign(captures, keep=keep, echo=echo)
    screening = campaign.screen(candidates)
    race = campaign.race(screening)
    if keep is not None:
        campaign.judge(race.choice)
        campaign.vary()
    return LightingAnswer(captures, screening, race)


def compare_again(captures: Mapping[Key, Capture], numbers: Sequence[int]) -> bool:
    """Simulate some of the captures again, and return whether they come out the same.

    The times may differ by a sample, and the errors by a tenth of a millimetre: renderers round differently.

    Args:
        captures: The kept captures.
        numbers: Which of them, from 0.
    """
    keys = [list(captures)[number] for number in numbers]
    anew: dict[Key, Capture] = {}
    executor = KeptCaptures(anew, keep=lambda: None)
    for values, case in keys:
        problem = lighting_problem([case])
        list(executor.run(problem.task, [problem.values(values, condition=0)]))
    return all(agree(captures[key], anew[key]) for key in keys)


def agree(before: Capture, now: Capture) -> bool:
    """Return whether two simulations of one capture agree."""
    return abs(before.time - now.time) <= 1.5 * SAMPLE_PERIOD and abs(before.error - now.error) <= 1e-4


# -- pictures and words


def text(values: Values) -> str:
    """Return the values of the parameters in words."""
    return ", ".join(f"{p.address.rpartition('.')[2]} {v:.3g}" for p, v in zip(PARAMETERS, values, strict=True))


@dataclass
class Results:
    """What is kept in `RESULTS`.

    Attributes:
        candidates: The number of candidates of the screening.
        captures: The captures by candidate and case.
    """

    candidates: int = CANDIDATES
    captures: dict[Key, Capture] = field(default_factory=dict)

    @staticmethod
    def read() -> Results:
        """Return what is kept.

        Raises:
            KeptResultsError: There is no such file, or it was changed otherwise.
        """
        stored = read_results(RESULTS)
        captures = {
            (tuple(row["values"]), Case(row["light"], row["seed"])): Capture(row["time"], row["error"])
            for row in stored["captures"]
        }
        return Results(stored["candidates"], captures)

    def write(self) -> None:
        """Keep the captures."""
        rows = [{"values": key[0], **vars(key[1]), **vars(capture)} for key, capture in self.captures.items()]
        write_results(RESULTS, {"candidates": self.candidates, "captures": rows}, command=COMMAND)

    def answer(self, *, full: bool = False, echo: Callable[[str], Any] = lambda line: None) -> LightingAnswer:
        """Return the answer; with ``full``, what is missing is simulated and kept before."""
        keep = self.write if full else None
        return answer_lighting(self.captures, candidates=self.candidates, keep=keep, echo=echo)


def short(parameter: vtb.Parameter) -> str:
    """Return the last part of the address of a parameter."""
    return parameter.address.rpartition(".")[2].replace("_", " ")


def names(answer: LightingAnswer) -> dict[str, Values]:
    """Return the candidates that have names; the choice comes last."""
    return {**BY_HAND, "choice": answer.choice}


def plot_answer(answer: LightingAnswer) -> Figure:
    """Draw the front of the screening, the judgement under each light, and the sensitivities if there are any."""
    pictures = [_draw_front, _draw_judgement, *([_draw_sensitivities] if answer.telling else [])]
    figure = Picture(5.0 * len(pictures), 4.6)
    for axes, draw in zip(figure.subplots(1, len(pictures)), pictures, strict=True):
        draw(axes, answer)
        finish(axes)
    return figure


def _draw_front(axes: Axes, answer: LightingAnswer) -> None:
    screening = answer.screening
    time, error = screening.costs[:, 0], 1e3 * screening.costs[:, 1]
    axes.plot(time, error, "o", color="0.6", label="candidates")
    front = sorted((time[k], error[k]) for k, v in enumerate(screening.candidates) if v in screening.front)
    axes.plot(*np.array(front).T, drawstyle="steps-post", color="black", lw=1.0, label="front")
    for number, (name, values) in enumerate(names(answer).items()):
        if values in screening.candidates:
            k = screening.candidates.index(values)
            is_choice = name == "choice"
            color, marker, size = (BEST, "*", 14.0) if is_choice else (f"C{number}", "s", 7.0)
            axes.plot(time[k], error[k], marker, color=color, ms=size, label=name)
    axes.set(xlabel="mean time to grip, 60 s for a failure [s]", ylabel="mean error of the bar [mm]")
    axes.set_title(f"screening: {len(screening.candidates)} candidates, each light once", fontsize="small")
    axes.legend(fontsize="x-small")


def _draw_sensitivities(axes: Axes, answer: LightingAnswer) -> None:
    rows, width = np.arange(len(PARAMETERS)), 0.8 / len(VARIED_ON)
    for number, case in enumerate(VARIED_ON):
        before = answer.captures[TODAY, case].time
        changes = [
            captures[case].time - before if case in captures else 0.0 for captures in answer.sensitivities.values()
        ]
        axes.barh(rows + (number - 0.5) * width, changes, width, label=f"{case.light}, from {before:.1f} s")
    for limit in (-TELLING, TELLING):
        axes.axvline(limit, color="black", ls=":", lw=1.0)
    labels = [f"{short(p)} {today:g} to {p.upper:g}" for p, today in zip(PARAMETERS, TODAY, strict=True)]
    axes.set_yticks(rows, labels, fontsize="x-small")
    axes.set(xlabel="later by [s]", ylim=(len(rows) - 0.5, -0.5))
    axes.set_title("one parameter at the upper end of its range", fontsize="small")
    axes.legend(fontsize="x-small")


def _draw_judgement(axes: Axes, answer: LightingAnswer) -> None:
    lights = [*LIGHTS, *OTHER_LIGHTS]
    styles = {"today": (TODAY, -0.12, "o", "C0"), "choice": (answer.choice, 0.12, "*", BEST)}
    for name, (values, offset, marker, color) in styles.items():
        spots = [(lights.index(case.light) + offset, answer.captures[values, case].time) for case in answer.judged]
        axes.plot(*np.reshape(spots, (-1, 2)).T, marker, color=color, alpha=0.7, label=name)
    axes.axhline(FAILURE, color="0.5", ls=":", lw=1.0)
    axes.set_xticks(range(len(lights)), [light.replace(", ", ",\n") for light in lights], fontsize="xx-small")
    axes.set(ylabel="time to grip, 60 s for a failure [s]", ylim=(0.0, 1.1 * UNFINISHED))
    axes.set_title(f"judgement: {len(answer.judged)} other starts", fontsize="small")
    axes.legend(fontsize="x-small", loc="lower right")


def by_light(answer: LightingAnswer, values: Values, on: Sequence[Case]) -> str:
    """Return in words the captures of a candidate in some cases, by light."""
    parts = []
    for light in dict.fromkeys(case.light for case in on):
        captures = answer.of(values, on, light)
        times = [capture.time for capture in captures if not capture.failed]
        part = f"{light} {len(times)} of {len(captures)}"
        if times:
            part += f", {np.median(times):.1f} s, {1e3 * mean_error(captures):.1f} mm"
        parts.append(part)
    return "; ".join(parts)


def lighting(full: bool) -> Answer:
    """Answer O3: which parameters of the robot are best under different lighting?

    The short version reads the kept captures, and simulates `RERUN` of them anew, drawn at random.
    """
    results = Results.read()
    captures, answer = results.captures, results.answer(full=full)
    numbers = sorted(np.random.default_rng().choice(len(captures), RERUN, replace=False).tolist())
    same = compare_again(captures, numbers)
    today, robust = (answer.of(values, answer.judged) for values in (TODAY, answer.choice))
    claims = {**answer.claims, f"{RERUN} kept captures simulated anew agree": same}
    paid = "; ".join(
        f"{light} {now - time:.1f} s ({text(values)})" for light, (values, time, now) in answer.best_alone.items()
    )
    return Answer(
        id="O3",
        question="Which controller parameters are best under different lighting?",
        answer=f"{text(answer.choice)}; {answer.verdict}",
        unit="",
        interval=(answer.gain[0], answer.gain[2]) if len(answer.judged) > 1 else None,
        paper="none given",
        cases=f"{len(SEEDS)} starts, {len(LIGHTS)} lights: {len(answer.screening.candidates)} candidates screened, "
        f"{len(answer.race.candidates)} raced",
        held_out=f"{len(answer.judged)} other starts, the same lights and {len(OTHER_LIGHTS)} others",
        baseline=f"today's constants: {sum(not c.failed for c in today)} of {len(today)} grips, the choice "
        f"{sum(not c.failed for c in robust)}",
        refused=sum(capture.failed for capture in robust),
        holds=all(claims.values()),
        note=f"Interval: of {CONFIDENCE:.0%}, of the seconds won in the mean, a failure costs {FAILURE:g} s. "
        f"Today: {by_light(answer, TODAY, answer.judged)}. Choice: {by_light(answer, answer.choice, answer.judged)}. "
        f"What the choice pays against the best for each light alone: {paid}. {_sensitive(answer)} "
        + "; ".join(f"{claim}: {'yes' if true else 'NO'}" for claim, true in claims.items())
        + ".",
    )


def _sensitive(answer: LightingAnswer) -> str:
    """Return in words which parameters matter, and how much."""
    if not answer.telling:
        return "Sensitivities: not simulated yet."
    words = [
        f"{short(p)} at {p.upper:g}: "
        + ", ".join(
            f"{case.light} "
            + ("failed" if c.failed else f"{c.time - answer.captures[TODAY, case].time:+.1f} s, {1e3 * c.error:.1f} mm")
            for case, c in answer.sensitivities[p.address].items()
        )
        for p in PARAMETERS
        if answer.telling.get(p.address)
    ]
    rest = [short(p) for p in PARAMETERS if not answer.telling.get(p.address, True)]
    return f"One parameter alone matters: {'; '.join(words) or 'none'}; not: {', '.join(rest) or 'none'}."


@click.command()
@click.option("--full", is_flag=True, help="Simulate what is missing first, and keep it.")
@click.option("--candidates", type=click.IntRange(len(BY_HAND) + 1), help="Screen as many, more than before.")
@click.option("--figure", default="lighting.png", help="File of the picture.", show_default=True)
def main(full: bool, candidates: int | None, figure: str) -> None:
    """Answer O3, and draw the answer."""
    results = Results.read() if RESULTS.exists() else Results()
    results.candidates = candidates or results.candidates
    answer = results.answer(full=full, echo=lambda line: click.echo(line, err=True))
    for values, (time, error) in zip(answer.screening.candidates, answer.screening.costs, strict=True):
        front = ", on the front" if values in answer.screening.front else ""
        click.echo(f"screened: {time:.1f} s, {1e3 * error:.1f} mm{front}: {text(values)}")
        click.echo(f"  {by_light(answer, values, SCREENED_ON)}")
    for values, cost, exact in zip(answer.race.candidates, answer.race.costs, answer.race.exact, strict=True):
        click.echo(f"raced: {cost:.1f} s{'' if exact else ' at least, dropped'}: {text(values)}")
    for light, (values, time, now) in answer.best_alone.items():
        click.echo(f"best for {light} alone: {time:.1f} s, the choice {now:.1f} s: {text(values)}")
    click.echo(_sensitive(answer))
    for name, values in {"today": TODAY, "choice": answer.choice}.items():
        click.echo(f"judged, {name}: {by_light(answer, values, answer.judged)}")
    click.echo(f"{text(answer.choice)}; {answer.verdict}")
    click.echo("; ".join(f"{claim}: {true}" for claim, true in answer.claims.items()))
    plot_answer(answer).savefig(figure, dpi=110)


if __name__ == "__main__":
    # Under its own name, so that there is one class Case.
    from vtbdrake_diagrams.satellite.studies.lighting import main as program

    program(prog_name="python -m vtbdrake_diagrams.satellite.studies.lighting")
