"""The judgement of captures."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from vtbdrake.rollout import SerialExecutor
from vtbdrake_diagrams.satellite import SatelliteScenario
from vtbdrake_diagrams.satellite.studies.campaign import LARGEST_TUMBLE, Capture, captures, report, starts

HELD = Capture(0.02, "hold", "the relative motion has stopped", 20.0, np.zeros(3), 1e-5, 1e-4, 0.1)


def test_campaign_judges_the_true_motion() -> None:
    scenario = SatelliteScenario(perception="pose_sensor")
    ((_, capture),) = captures(scenario, SerialExecutor(), count=1, seed=3)
    assert not capture.failure
    assert capture.tumble == pytest.approx(np.linalg.norm(starts(1, seed=3, distance=2.5)[0].w_WT))
    assert np.abs(capture.offset).max() < 0.015


@pytest.mark.parametrize(
    ("change", "failure"),
    [
        ({"mode": "abort", "reason": "the target is lost"}, "the target is lost"),
        ({"offset": np.array([0.0, 0.0, 0.05])}, "the bar is not between the fingers"),
        ({"creep": 0.002}, "the relative motion has not stopped"),
        ({"joint_creep": 0.01}, "the relative motion has not stopped"),
    ],
)
def test_failures_are_classified(change: dict[str, object], failure: str) -> None:
    found = [HELD, replace(HELD, **change)]
    assert [capture.failure for capture in found] == ["", failure]
    assert report(found).endswith(f"1 of 2 captured\n1 x {failure}")


def test_starts_differ_within_the_limits() -> None:
    drawn = starts(50, seed=0, distance=2.5)
    rates = [np.linalg.norm(start.w_WT) for start in drawn]
    assert max(rates) < LARGEST_TUMBLE
    assert max(rates) > 0.9 * LARGEST_TUMBLE
    directions = np.array([start.w_WT / np.linalg.norm(start.w_WT) for start in drawn])
    assert np.linalg.norm(directions.mean(axis=0)) < 0.4
