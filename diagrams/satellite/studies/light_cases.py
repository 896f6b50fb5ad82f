"""The problem of application O3: lights, starts, parameters, candidates by hand, scenario and costs.

`vtbdrake_diagrams.satellite.studies.lighting` is the application.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from pydrake.systems.framework import Diagram

import vtbdrake as vtb
from vtbdrake.common.arrays import Array
from vtbdrake.optimization import Risk
from vtbdrake_diagrams.satellite.scenario import SatelliteScenario
from vtbdrake_diagrams.satellite.start import random_start
from vtbdrake_diagrams.satellite.studies.grips import (
    MODE,
    RECORDED,
    SAMPLE_PERIOD,
    TIME,
    bar_error,
    time_to_grip,
)
from vtbdrake_diagrams.satellite.supervisor import Mode

HORIZON = 36.0
"""The longest time of a capture in s: twice as long as with today's constants and the sun beside."""
UNFINISHED = 61.0
"""The cost of a capture that neither holds the bar nor was aborted by `HORIZON`, in s; a rollout ends when its cost is
below."""
LARGEST_ERROR = 0.012
"""The largest error of the perceived bar that a grip allows, in m: the supervisor's ``grip_tolerance``. It is also the
error of a capture that failed."""

# -- lights and starts

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

# -- parameters and candidates

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
CANDIDATES = 5
"""The number of candidates of the screening, with `BY_HAND`, if the kept results have no other."""


def text(values: Values) -> str:
    """Return the values of the parameters in words."""
    return ", ".join(f"{p.address.rpartition('.')[2]} {v:.3g}" for p, v in zip(PARAMETERS, values, strict=True))


def short(parameter: vtb.Parameter) -> str:
    """Return the last part of the address of a parameter."""
    return parameter.address.rpartition(".")[2].replace("_", " ")


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


def time_to_end(mode: float, time: float) -> float:
    """Return the cost of the time: as `time_to_grip`, but `UNFINISHED` while the capture still goes on."""
    return time_to_grip(mode, time) if mode >= Mode.RETREAT else UNFINISHED


def error_at_grip(mode: float, base: Array, target: Array, relative: Array) -> float:
    """Return the cost of the accuracy: the error of the bar while it is held, in m; else `LARGEST_ERROR`."""
    return bar_error(base, target, relative) if mode in (Mode.RETREAT, Mode.HOLD) else LARGEST_ERROR


_TIME = vtb.Quality(time_to_end, of=[MODE, TIME], minimize=True, unit="s")
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
