"""A localization unit with a scanner and a pair of cameras."""

from __future__ import annotations

from dataclasses import replace
from math import nan
from typing import Any

import numpy as np
import pytest

from vtbdrake.components.localization.landmarks import Landmarks, SensorView
from vtbdrake.testbed import DpsAlone
from vtbdrake_diagrams.forest.perception import LandmarkSensor, Localizer
from vtbdrake_diagrams.forest.scenario import ForestScenario
from vtbdrake_diagrams.forest.stereo import IMAGES
from vtbdrake_diagrams.forest.studies import fusion
from vtbdrake_diagrams.forest.studies.drive import STANDING, Drive
from vtbdrake_diagrams.forest.studies.fusion import (
    CONDITIONS,
    MAP_NAMES,
    SHORT,
    Error,
    holds,
    judged,
    middle,
    report,
    seen_by,
    summary,
)

pytestmark = pytest.mark.one_python

SCENARIO = ForestScenario(seed=1, perception="both", length=60.0, width=60.0, start=12.0)


def at(distances: list[float]) -> Landmarks:
    """Return landmarks straight ahead."""
    n = len(distances)
    places = np.column_stack([distances, np.zeros(n)])
    return Landmarks(places, np.tile(0.01 * np.eye(2), (n, 1, 1)), np.full(n, 0.3), np.full(n, 0.1))


def test_samples_are_fused_once_in_the_order_of_their_times() -> None:
    taken = []

    def scanned(scan: int, history: np.ndarray, time: float) -> Landmarks:
        taken.append(("scan", scan, time))
        return at([4.0, 5.0])

    def pictured(left: int, right: int, history: np.ndarray, time: float) -> Landmarks:
        taken.append(("images", left, time))
        return at([4.0])

    unit = SCENARIO.unit(SCENARIO.global_map())
    cameras = LandmarkSensor(pictured, IMAGES, field_of_view=1.3, is_scan=False)
    localizer = Localizer((LandmarkSensor(scanned), cameras), unit)
    history = np.zeros((3, 6))
    history[:, 0] = [4.0, 2.0, 0.0]

    def call(memory: Any, *, scan: float, images: float) -> tuple[dict[str, Any], Any]:
        times = {"scan_time": scan, **{f"{name}_time": images for name in IMAGES}}
        inputs = {name: np.array([time]) for name, time in times.items()}
        return localizer(
            request=np.ones(1), history=history.ravel(), memory=memory, scan=1, left_image=2, right_image=3, **inputs
        )

    outputs, memory = call(unit.start(), scan=1.0, images=1.0)
    assert outputs["time"] == [1.0] and outputs["detected"] == [3]
    outputs, memory = call(memory, scan=1.2, images=1.0)
    assert outputs["time"] == [1.2] and outputs["detected"] == [2]
    # The images arrived before the next scan, while the localizer was busy.
    outputs, memory = call(memory, scan=1.6, images=1.5)
    assert outputs["time"] == [1.6] and memory.ignored == 0
    assert taken == [
        ("scan", 1, 1.0),
        ("images", 2, 1.0),
        ("scan", 1, 1.2),
        ("images", 2, 1.5),
        ("scan", 1, 1.6),
    ]
    assert call(memory, scan=1.6, images=1.5)[1].ignored == 1


def test_conditions_take_away_what_they_say() -> None:
    times = STANDING + np.array([1.0, 2.0, 3.0, 4.0])
    pose = np.zeros((4, 3))
    views = [SensorView(at([4.0, SHORT + 1.0])), SensorView(at([15.0]), 1.3, is_scan=False)]
    drive = Drive(times, pose, pose, (views[:1], views[1:], views, views[:1]))
    assert middle(drive) == STANDING + 2.0

    def counts(sensors: str, condition: str) -> list[list[int]]:
        return [[len(each.landmarks) for each in at_time] for at_time in seen_by(drive, sensors, condition).landmarks]

    usual, short, silent = CONDITIONS
    assert counts("both", usual) == [[2], [1], [2, 1], [2]]
    assert counts("scanner", usual) == [[2], [], [2], [2]]
    assert counts("cameras", usual) == [[], [1], [1], []]
    assert counts("both", short) == [[1], [1], [1, 1], [1]]
    assert counts("both", silent) == [[2], [1], [1], []]
    assert [each.is_scan for at_time in seen_by(drive, "cameras", usual).landmarks for each in at_time] == [True, True]
    assert [each.is_scan for each in seen_by(drive, "both", usual).landmarks[2]] == [True, False]


def errors_of(scanner: tuple[float, int], cameras: tuple[float, int], both: tuple[float, int]) -> list[Error]:
    """Return the errors under all conditions, from the RMS in m and the poses, of 8 samples, of each.

    Both have a pose whenever a sensor alone has one.
    """
    return [
        Error(condition, name, sensors, rms if poses else None, (rms, both[0]) if poses else None, poses, poses, 8, 0)
        for condition in CONDITIONS
        for name in MAP_NAMES
        for sensors, (rms, poses) in {"scanner": scanner, "cameras": cameras, "both": both}.items()
    ]


def test_forests_in_which_both_are_better_are_counted() -> None:
    forests = {
        1: errors_of((0.1, 4), (0.3, 4), (0.09, 4)),
        2: errors_of((0.1, 4), (0.05, 4), (0.06, 4)),
        3: errors_of((0.2, 4), (nan, 0), (0.1, 4)),
    }
    each = summary(forests, "as it is", "remote")
    assert each.better == 2 and each.forests == 3
    assert each.rms["scanner"] == pytest.approx(np.sqrt((0.1**2 + 0.1**2 + 0.2**2) / 3.0))
    assert each.rms["cameras"] == pytest.approx(np.sqrt((0.3**2 + 0.05**2) / 2.0))
    both_squared = 0.09**2 + 0.06**2 + 0.1**2
    assert each.ratios["scanner"] == pytest.approx(np.sqrt(both_squared / (2 * 0.1**2 + 0.2**2)))
    assert each.ratios["cameras"] == pytest.approx(np.sqrt((both_squared - 0.1**2) / (0.3**2 + 0.05**2)))
    assert each.shares == pytest.approx({"scanner": 12 / 24, "cameras": 8 / 24, "both": 12 / 24})
    assert "0.141 m in 50%, 0 wrong" in report(forests).splitlines()[2]


def test_errors_are_compared_where_both_units_have_a_pose(monkeypatch: pytest.MonkeyPatch) -> None:
    """The scanner loses its pose in the second half, where it is hard; both go on, and err more there."""
    times = STANDING + np.arange(1.0, 5.0)
    drive = Drive(times, np.zeros((4, 3)), np.zeros((4, 3)), ((),) * 4)
    alone, both = np.array([0.1, 0.1, nan, nan]), np.array([0.05, 0.05, 0.5, 1.0])
    distances = {"scanner": alone, "cameras": np.full(4, nan), "both": both}
    monkeypatch.setattr(fusion, "position_errors", lambda drive, scenario, sensors, condition: distances[sensors])
    scanner, cameras, together = (
        error for error in judged(drive, SCENARIO) if (error.condition, error.map) == ("as it is", "accurate")
    )
    assert scanner.common == pytest.approx((0.1, 0.05)) and (scanner.common_poses, scanner.poses) == (2, 2)
    assert cameras.rms is None and cameras.common is None and cameras.poses == 0
    assert together.rms == pytest.approx(np.sqrt((2 * 0.05**2 + 0.5**2 + 1.0) / 4)) and together.poses == 4
    assert (scanner.wrong, together.wrong) == (0, 1)


@pytest.mark.parametrize(
    ("changed", "is_good"),
    [
        ({}, True),
        ({"common": (0.1, 0.106)}, False),
        ({"poses": 7}, False),
        ({"wrong": 1}, False),
        ({"common": (0.1, 0.1)}, False),  # no worse, but better nowhere
    ],
)
def test_each_part_of_the_fusion_can_fail(changed: dict[str, Any], is_good: bool) -> None:
    errors = errors_of((0.1, 8), (0.3, 8), (0.09, 8))
    everywhere = changed.get("common") == (0.1, 0.1)
    for k, error in enumerate(errors):
        here = everywhere or (error.condition, error.map) == ("as it is", "remote")
        if here and error.sensors == ("scanner" if "common" in changed else "both"):
            errors[k] = replace(error, **changed)
    assert holds({1: errors}) is is_good


def test_unit_has_a_message_for_each_sensor() -> None:
    interface = SCENARIO.interface()
    assert [signal.name for signal in interface.sense] == ["scan", *IMAGES, "imu", "odometry"]
    periods = SCENARIO.deployment().protocol.periods
    assert periods["SCAN"] == pytest.approx(0.2) and periods["IMAGES"] == pytest.approx(0.5)
    dps = DpsAlone(SCENARIO)
    assert {"left_image", "right_image", "scan"} <= {signal.name for signal in dps.interface.sense}
