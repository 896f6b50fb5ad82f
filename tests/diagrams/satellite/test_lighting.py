"""Application O3: its problem, and what counts as robust."""

from __future__ import annotations

import numpy as np
import pytest

from vtbdrake_diagrams.satellite.lighting import (
    DEFAULT,
    FAILURE,
    GRID,
    LIGHTS,
    PARAMETERS,
    SHORT,
    LightingAnswer,
    LightingScenario,
    Settings,
    lighting_problem,
    plot_answer,
    time_to_grip,
)
from vtbdrake_diagrams.satellite.supervisor import ABORT, GRIP, HOLD, RETREAT


def test_default_is_what_the_robot_does_by_itself() -> None:
    problem = lighting_problem([0])
    context = problem.testbed.default_context()
    for parameter, value in zip(PARAMETERS, DEFAULT.entries(), strict=True):
        if not parameter.is_field:
            assert problem.testbed.read(context, parameter.address) == pytest.approx(value)
    assert LightingScenario().threshold == LightingScenario().evaluation.detector.threshold == DEFAULT.threshold
    assert DEFAULT in GRID
    assert set(SHORT) <= set(GRID)


def test_conditions_are_all_lights_from_all_starts() -> None:
    problem = lighting_problem([0, 1, 2])
    assert len(problem.conditions) == 3 * len(LIGHTS)
    starts = {tuple(condition["sim.sys.target.body.pose"]) for condition in problem.conditions}
    assert len(starts) == 3


def test_only_a_held_bar_counts() -> None:
    assert [time_to_grip(mode, 12.5) for mode in (RETREAT, HOLD)] == [12.5, 12.5]
    assert [time_to_grip(mode, 12.5) for mode in (0.0, GRIP, ABORT)] == [FAILURE] * 3


CANDIDATES = (DEFAULT, Settings(closing_speed=0.09), Settings(gain=1.5))
# Under four lights from two starts.
COSTS = np.array(
    [
        [[10, 12], [15, 15], [30, 30], [20, 20]],
        [[8, 8], [9, 9], [60, 30], [10, 10]],
        [[9, 11], [14, 14], [28, 28], [19, 19]],
    ]
)


def test_robust_choice_is_best_in_its_worst_light() -> None:
    answer = LightingAnswer(CANDIDATES, COSTS.astype(float), COSTS[[0, 2]])
    assert answer.robust == 2
    assert [CANDIDATES.index(settings) for settings in answer.best.values()] == [1, 1, 2, 1]
    assert answer.holds


@pytest.mark.parametrize("worse", [[[9, 11], [16, 16], [28, 28], [19, 19]], [[9, 11], [14, 14], [30, 30], [19, 19]]])
def test_choice_that_is_worse_in_a_light_does_not_hold(worse: list) -> None:
    checked = np.array([COSTS[0], worse])
    assert not LightingAnswer(CANDIDATES, COSTS.astype(float), checked).holds


def test_plot_has_both_comparisons() -> None:
    figure = plot_answer(LightingAnswer(CANDIDATES, COSTS.astype(float), COSTS[[0, 2]]))
    assert [len(axes.get_legend().get_texts()) for axes in figure.axes] == [2, 2]
