"""Application O3: its problem, and what counts as robust."""

from __future__ import annotations

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw

from vtbdrake.rollout import SerialExecutor
from vtbdrake.state.systems import pose_to_array
from vtbdrake_diagrams.satellite.bodies import Target
from vtbdrake_diagrams.satellite.relative_motion import RELATIVE
from vtbdrake_diagrams.satellite.studies import lighting
from vtbdrake_diagrams.satellite.studies.lighting import (
    ACCURACY,
    CANDIDATES,
    CHECKED_ON,
    CHOICE,
    CHOSEN_ON,
    DEFAULT,
    FAILURE,
    LIGHTS,
    PARAMETERS,
    RECORDED,
    Captures,
    LightingAnswer,
    LightingScenario,
    Settings,
    bar_error,
    capture_all,
    lighting_problem,
    plot_answer,
    time_to_grip,
)
from vtbdrake_diagrams.satellite.supervisor import Mode


def test_default_is_what_the_robot_does_by_itself() -> None:
    problem = lighting_problem([0])
    context = problem.testbed.default_context()
    for parameter, value in zip(PARAMETERS, DEFAULT.entries(), strict=True):
        if not parameter.is_field:
            assert problem.testbed.read(context, parameter.address) == pytest.approx(value)
    assert LightingScenario().threshold == LightingScenario().evaluation.detector.threshold == DEFAULT.threshold


def test_choice_is_a_candidate_checked_on_other_starts() -> None:
    assert CANDIDATES[0] == DEFAULT
    assert CHOICE in CANDIDATES
    assert not set(CHOSEN_ON) & set(CHECKED_ON)


def test_conditions_are_all_lights_from_all_starts() -> None:
    problem = lighting_problem([0, 1, 2])
    assert len(problem.conditions) == 3 * len(LIGHTS)
    starts = {tuple(condition["sim.sys.target.body.pose"]) for condition in problem.conditions}
    assert len(starts) == 3


def test_only_a_held_bar_counts() -> None:
    assert [time_to_grip(mode, 12.5) for mode in (Mode.RETREAT, Mode.HOLD)] == [12.5, 12.5]
    assert [time_to_grip(mode, 12.5) for mode in (0.0, Mode.GRIP, Mode.ABORT)] == [FAILURE] * 3


def test_bar_error_is_seen_from_the_base() -> None:
    X_WB = RigidTransform(RollPitchYaw(0.3, -0.2, 1.0), [1.0, 2.0, 3.0])
    X_BT = RigidTransform(RollPitchYaw(0.1, 0.2, -0.4), [2.5, 0.1, -0.2])
    relative = np.zeros(RELATIVE)
    relative[11:14] = X_BT @ Target().X_TH.translation() + [0.003, 0.0, -0.004]
    values = pose_to_array(X_WB), pose_to_array(X_WB @ X_BT), relative
    record = {address: [np.full_like(value, np.nan), value] for address, value in zip(RECORDED, values, strict=True)}
    assert bar_error(record) == pytest.approx(0.005)


@pytest.mark.slow
@pytest.mark.one_python
def test_choice_holds_the_bar_in_the_grazing_sun(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lighting, "LIGHTS", {"grazing, 86 deg": LIGHTS["grazing, 86 deg"]})
    found = capture_all([CHOICE], seeds=[1], executor=SerialExecutor())
    assert found.failures.tolist() == [[0]]
    assert 5.0 < found.times.item() < 30.0
    assert found.errors.item() < ACCURACY


TRIED = (DEFAULT, Settings(closing_speed=0.09), Settings(gain=1.5))
# Under four lights from two starts.
COSTS = np.array(
    [
        [[10, 12], [15, 15], [30, 30], [20, 20]],
        [[8, 8], [9, 9], [60, 30], [10, 10]],
        [[9, 11], [14, 14], [28, 28], [19, 19]],
    ],
    dtype=float,
)


def _captures(costs: np.ndarray, error: float = 0.5 * ACCURACY) -> Captures:
    return Captures(costs, np.where(costs < FAILURE, error, np.nan))


def test_robust_choice_is_best_in_its_worst_light() -> None:
    tried = _captures(COSTS)
    assert tried.robust == 2
    assert tried.failures[1].tolist() == [0, 0, 1, 0]
    answer = LightingAnswer(TRIED[2], _captures(COSTS[[0, 2]]), TRIED, tried)
    assert [TRIED.index(settings) for settings in answer.best.values()] == [1, 1, 2, 1]
    assert answer.holds


@pytest.mark.parametrize("worse", [[[9, 11], [16, 16], [28, 28], [19, 19]], [[9, 11], [14, 14], [30, 30], [19, 19]]])
def test_choice_that_is_worse_in_a_light_does_not_hold(worse: list) -> None:
    checked = _captures(np.array([COSTS[0], worse]))
    assert not LightingAnswer(TRIED[2], checked).holds


def test_time_is_not_bought_with_accuracy() -> None:
    errors = np.full(COSTS.shape, 0.5 * ACCURACY)
    errors[2, 3] = 2.0 * ACCURACY
    tried = Captures(COSTS, errors)
    assert tried.accurate.tolist() == [True, True, False]
    # The second loses a capture in the grazing sun, the third is not accurate in one light.
    assert tried.robust == 0
    assert not LightingAnswer(TRIED[2], Captures(COSTS[[0, 2]], errors[[0, 2]])).holds
    assert _captures(COSTS, 2.0 * ACCURACY).robust == 2


def test_plot_has_both_comparisons() -> None:
    checked = _captures(COSTS[[0, 2]])
    both = plot_answer(LightingAnswer(TRIED[2], checked, TRIED, _captures(COSTS)))
    assert [len(axes.get_legend().get_texts()) for axes in both.axes] == [3, 2]
    assert len(plot_answer(LightingAnswer(TRIED[2], checked)).axes) == 1
