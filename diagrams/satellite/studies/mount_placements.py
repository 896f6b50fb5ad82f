"""The question of O1: captures, poses of the docking camera, those by hand among them, and the problem to solve."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

import vtbdrake as vtb
from vtbdrake.common.arrays import Array
from vtbdrake.state import NamedVector, Quantity
from vtbdrake.state.systems import pose_to_array
from vtbdrake_diagrams.satellite.bodies import Servicer, Target
from vtbdrake_diagrams.satellite.scenario import SatelliteScenario
from vtbdrake_diagrams.satellite.start import random_start

POSE = "sim.sense.docking_camera.pose"
ENTRIES = NamedVector(
    x=Quantity(unit="m"),
    y=Quantity(unit="m"),
    z=Quantity(unit="m"),
    roll=Quantity(unit="rad"),
    pitch=Quantity(unit="rad"),
    yaw=Quantity(unit="rad"),
)
"""The pose of the camera in B."""
COUNT = "dps.env.markers.count"
_EXPOSURE = "sim.sense.docking_camera.exposure"

HORIZON = 24.0
"""The time over which the markers count, in s: from the start until the relative motion has stopped."""
SAMPLE_PERIOD = 4.0
"""The time between two counts, in s."""
TUMBLES = (0.5, 1.0, 1.5, 2.0, 3.0)
"""The tumble rates of the captures, in deg/s: up to the one at which captures must succeed."""
REACH = 0.45
"""The largest distance from the middle of the face at which the camera's housing fits on it, in m."""
FOOT_DISTANCE = 0.18
"""The least distance of the camera from the axis of the arm's foot, in m."""

# The least place of the camera along x of B, in m: 2 cm before the front face; a bracket reaches 10 cm farther.
_X = 0.62
_BRACKET = 0.1
# How far the view may turn away from straight ahead, and about its axis, in rad.
_TURN = 0.8
_TWIST = 1.2
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
    return ENTRIES.array(x=_X, y=y, z=z, roll=-np.pi / 2 - tilt, yaw=-np.pi / 2 + pan)


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
"""The rules that aim placements by hand. `TURNED` knows how the base reacts to the arm."""


def by_hand(rule: str) -> dict[str, Array]:
    """Return the placements by hand that a rule of `RULES` aims."""
    turn = _REACTION if rule == TURNED else 0.0
    return {name: value + ENTRIES.array(roll=turn) for name, value in BY_HAND.items()}


def _address(name: str) -> str:
    """Return the address of an entry of the pose."""
    return f"{POSE}[{ENTRIES.slice_of(name).start}]"


PARAMETERS = (
    vtb.Parameter(_address("x"), _X, _X + _BRACKET),
    vtb.Parameter(_address("y"), -REACH, REACH),
    vtb.Parameter(_address("z"), -REACH, REACH),
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
    camera = ENTRIES.view(value)
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
        constraints=[vtb.Constraint(distance_from_foot, of=POSE, at_least=FOOT_DISTANCE)],
        motion=vtb.RecordedMotion(memory, while_recording={_EXPOSURE: 0.0}) if recorded else None,
    )
