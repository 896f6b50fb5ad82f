"""Settings are accepted within their documented intervals, up to the ends that belong to them, and refused beyond."""

from collections.abc import Callable
from math import inf, nan, nextafter, pi
from typing import Any

import numpy as np
import pytest

from vtbdrake.common.settings import check_settings
from vtbdrake.components.localization.landmarks import Landmarks
from vtbdrake.components.localization.rocks import RockDetectorConfig
from vtbdrake.components.localization.stereo_trunks import StereoTrunkDetectorConfig
from vtbdrake.components.localization.tracking import Tracker
from vtbdrake.components.localization.trunks import TrunkDetectorConfig
from vtbdrake.components.sensors.errors import ErrorModel
from vtbdrake.components.sensors.laser_scanner import LaserScannerConfig

pytestmark = pytest.mark.one_python

MAP = Landmarks(np.array([[0.0, 0.0], [5.0, 0.0]]), np.array([np.eye(2)] * 2) * 0.01, np.ones(2), np.ones(2))

# Class -> what makes one with settings, and the interval of each setting.
INTERVALS: dict[str, tuple[Callable[..., Any], dict[str, str]]] = {
    "Tracker": (
        lambda **settings: Tracker(MAP, **settings),
        {
            "field_of_view": f"(0, {2.0 * pi!r}]",
            "bias_deviation": "[0, inf)",
            "odometry_deviation": "[0, inf)",
            "odometry_length": "(0, inf]",
            "rate_deviation": "[0, inf)",
            "rate_walk": "[0, inf)",
            "least_deviation": "[0, inf)",
            "scan_deviation": "[0, inf)",
            "correlation": "[0, inf)",
            "correlated_share": "[0, 1)",
            "gate": "(0, 1)",
            "first_gate": "(0, 1)",
            "horizon": "(0, inf]",
            "credit": "(0, inf]",
            "first_credit": "(0, inf]",
            "distortion_gate": "(0, 1)",
        },
    ),
    "TrunkDetectorConfig": (
        TrunkDetectorConfig,
        {
            "azimuth_step": "(0, 0.1)",
            "elevation_step": "(0, 0.5)",
            "range_noise": "(0, inf)",
            "ground_height": "(-inf, inf)",
            "roughness": "[0, inf)",
            "reference_height": "[0, inf)",
            "least_diameter": "(0, 1)",  # the largest diameter
            "largest_diameter": "(0.04, inf)",  # the least diameter
            "upright_share": "[0, 1]",
            "typical_diameter": "(0, inf)",
            "diameter_spread": "(0, inf)",
            "lean": "(0, 0.5)",
            "least_probability": "[0, 1]",
            "position_floor": "[0, inf)",
            "diameter_floor": "[0, inf)",
        },
    ),
    "RockDetectorConfig": (
        RockDetectorConfig,
        {
            "reach": "(0, 200]",
            "cell": "[0.0125, inf)",  # a 2000th of the reach
            "least_height": "(0, inf)",
            "least_roundness": "[0, 1)",
            "least_width": "(0, 3)",  # the largest width
            "largest_width": "(0.2, inf)",  # the least width
            "elongation": "[0, 1)",
        },
    ),
    "StereoTrunkDetectorConfig": (
        StereoTrunkDetectorConfig,
        {
            "extent": "(0, 2.8)",  # the height of the slice
            "reach": "(0, inf)",
            "least_diameter": "[0, 0.7)",  # the largest diameter
            "largest_diameter": "(0.04, inf)",  # the least diameter
            "disparity_deviation": "(0, inf)",
            "disparity_bias": "[0, inf)",
            "middle_deviation": "(0, inf)",
            "width_deviation": "(0, inf)",
            "fattening": "[0, inf)",
            "least_deviation": "[0, inf)",
        },
    ),
    "ErrorModel": (
        lambda **settings: check_settings(ErrorModel(**settings)),
        {
            "noise": "[0, inf)",
            "bias": "(-inf, inf)",
            "drift": "[0, inf)",
            "quantization": "[0, inf)",
            "dropout": "[0, 1]",
            "outlier_probability": "[0, 1]",
            "outlier_size": "[0, inf)",
        },
    ),
    "LaserScannerConfig": (
        lambda **settings: LaserScannerConfig(**settings).check(slice_period=1e-3),
        {
            "azimuth": f"(0, {2.0 * pi!r}]",
            "elevation": f"[0, {pi!r}]",
            "reflectivity": "[0, 1]",
            "divergence": "[0, 0.5)",
        },
    ),
}

CASES = [
    pytest.param(make, name, interval, id=f"{owner}-{name}")
    for owner, (make, intervals) in INTERVALS.items()
    for name, interval in intervals.items()
]


@pytest.mark.parametrize(("make", "name", "interval"), CASES)
def test_setting_is_accepted_within_its_interval_and_refused_beyond(
    make: Callable[..., Any], name: str, interval: str
) -> None:
    lower, upper = (float(end) for end in interval[1:-1].split(","))
    good, bad = [max(nextafter(lower, inf), -1e6), min(nextafter(upper, -inf), 1e6)], [nan]
    for end, belongs, beyond in ((lower, interval[0] == "[", -inf), (upper, interval[-1] == "]", inf)):
        (good if belongs else bad).append(end)
        if belongs and end != beyond:
            bad.append(nextafter(end, beyond))
    for value in good:
        make(**{name: value})
    for value in bad:
        with pytest.raises(ValueError, match=name):
            make(**{name: value})


@pytest.mark.parametrize(
    ("owner", "name", "least"),
    [
        ("Tracker", "most", 1),
        ("Tracker", "patience", 1),
        ("RockDetectorConfig", "least_points", 2),
        ("ErrorModel", "latency", 0),
        ("ErrorModel", "max_latency", 0),
        ("ErrorModel", "seed", 0),
        ("LaserScannerConfig", "rows", 0),
    ],
)
def test_whole_number_is_accepted_from_its_least_on(owner: str, name: str, least: int) -> None:
    make, _ = INTERVALS[owner]
    for value in (least, least + 1):
        make(**{name: value})
    for value in (least - 1, least + 0.5, inf, nan):
        with pytest.raises(ValueError, match=f"{name} must be a whole number"):
            make(**{name: value})
