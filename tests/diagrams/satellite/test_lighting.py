"""Application O3: its problem, the captures that are kept, its stages, and what its answer claims."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw

import vtbdrake as vtb
from vtbdrake.rollout import RolloutResult, RolloutTask
from vtbdrake.state.systems import pose_to_array
from vtbdrake_diagrams.kept_results import KeptResultsError
from vtbdrake_diagrams.satellite.bodies import Target
from vtbdrake_diagrams.satellite.relative_motion import RELATIVE
from vtbdrake_diagrams.satellite.studies.grips import FAILURE, bar_error, time_to_grip
from vtbdrake_diagrams.satellite.studies.light_answer import ACCURACY, LightingAnswer
from vtbdrake_diagrams.satellite.studies.light_campaign import RACE_BUDGET, Campaign, Race, Screening
from vtbdrake_diagrams.satellite.studies.light_captures import (
    Capture,
    KeptCaptures,
    Key,
    Results,
    agree,
    simulate_capture,
)
from vtbdrake_diagrams.satellite.studies.light_cases import (
    BY_HAND,
    CANDIDATES,
    JUDGED_ON,
    LARGEST_ERROR,
    LIGHTS,
    OTHER_LIGHTS,
    PARAMETERS,
    RACED_ON,
    SCREENED_ON,
    TODAY,
    UNFINISHED,
    VARIED,
    VARIED_ON,
    Case,
    LightingScenario,
    error_at_grip,
    lighting_problem,
    time_to_end,
)
from vtbdrake_diagrams.satellite.studies.light_plots import plot_answer
from vtbdrake_diagrams.satellite.studies.lighting import answer_lighting
from vtbdrake_diagrams.satellite.supervisor import Mode

HELD = Capture(18.0, 0.001)
FAILED = Capture(FAILURE, LARGEST_ERROR)
OTHER = tuple(1.1 * value for value in TODAY)


# -- the problem


def test_todays_constants_are_the_robots() -> None:
    problem = lighting_problem(SCREENED_ON[:1])
    context = problem.testbed.default_context()
    for parameter, value in zip(PARAMETERS, TODAY, strict=True):
        if not parameter.is_field:
            assert problem.testbed.read(context, parameter.address) == pytest.approx(value)
    detector = LightingScenario().evaluation.detector
    assert (detector.threshold, detector.min_width) == TODAY[-2:]
    assert len(PARAMETERS) >= 8
    assert all(p.lower < value < p.upper for p, value in zip(PARAMETERS, TODAY, strict=True))


def test_fields_of_the_scenario_reach_the_detector() -> None:
    dps = replace(LightingScenario(), threshold=3.0, min_width=6.0).make_dps()
    detector = dps.GetSubsystemByName("env").GetSubsystemByName("markers").function.function.detector
    assert (detector.threshold, detector.min_width) == (3.0, 6.0)


def test_starts_of_the_judgement_are_others() -> None:
    assert set(SCREENED_ON) < set(RACED_ON)
    assert len({case.seed for case in RACED_ON}) == 8
    assert {case.light for case in SCREENED_ON} == set(LIGHTS)
    assert len({case.seed for case in JUDGED_ON}) == 20
    assert not {case.seed for case in JUDGED_ON} & {case.seed for case in RACED_ON}
    assert {case.light for case in JUDGED_ON} == set(LIGHTS) | set(OTHER_LIGHTS)


def test_only_a_held_bar_has_a_time() -> None:
    assert [time_to_grip(mode, 12.5) for mode in (Mode.RETREAT, Mode.HOLD)] == [12.5, 12.5]
    assert [time_to_grip(mode, 12.5) for mode in (0.0, Mode.GRIP, Mode.ABORT)] == [FAILURE] * 3


def test_rollout_ends_when_the_bar_is_held_or_the_capture_aborted() -> None:
    threshold = lighting_problem(SCREENED_ON[:1]).task.threshold
    assert threshold == UNFINISHED
    assert time_to_end(Mode.RETREAT, 12.5) == 12.5
    assert time_to_end(Mode.ABORT, 12.5) == FAILURE < threshold
    assert [time_to_end(mode, 12.5) for mode in (Mode.WAIT, Mode.TRACK, Mode.GRIP)] == [threshold] * 3


def test_bar_error_is_seen_from_the_base() -> None:
    X_WB = RigidTransform(RollPitchYaw(0.3, -0.2, 1.0), [1.0, 2.0, 3.0])
    X_BT = RigidTransform(RollPitchYaw(0.1, 0.2, -0.4), [2.5, 0.1, -0.2])
    relative = np.zeros(RELATIVE)
    relative[11:14] = X_BT @ Target().X_TH.translation() + [0.003, 0.0, -0.004]
    poses = pose_to_array(X_WB), pose_to_array(X_WB @ X_BT)
    assert bar_error(*poses, relative) == pytest.approx(0.005)
    assert error_at_grip(Mode.HOLD, *poses, relative) == pytest.approx(0.005)
    assert error_at_grip(Mode.ABORT, *poses, relative) == LARGEST_ERROR


# -- captures that are kept


class Simulated:
    """An executor whose captures take longer with a slower gripper, and fail with a high threshold in grazing light."""

    def __init__(self) -> None:
        self.count = 0

    def run(
        self, task: RolloutTask, points: Sequence[Mapping[str, Any]], *, start: Any = None
    ) -> Iterator[tuple[int, RolloutResult]]:
        for index, point in enumerate(points):
            self.count += 1
            grazing = abs(point.get("sim.env.light.direction", [1.0])[0]) < 0.2
            failed = grazing and point["scenario.threshold"] > 6.0
            time = FAILURE if failed else 12.0 + 0.5 / point["dps.impl.controller.speed"]
            measure, value = task.measures[0], LARGEST_ERROR if failed else 0.001
            limit = measure.at_most if isinstance(measure, vtb.Constraint) else 0.0
            sample = np.ones(1)
            yield (
                index,
                RolloutResult(
                    parameters=point,
                    end="threshold",
                    times=sample,
                    quality=sample,
                    value=time,
                    measures=(value - limit,),
                ),
            )


@pytest.fixture
def simulated(monkeypatch: pytest.MonkeyPatch) -> Simulated:
    simulated = Simulated()
    monkeypatch.setattr("vtbdrake_diagrams.satellite.studies.light_captures.SerialExecutor", lambda: simulated)
    return simulated


@pytest.mark.parametrize("two_qualities", [True, False])
def test_kept_capture_is_not_simulated_again(simulated: Simulated, two_qualities: bool) -> None:
    problem = lighting_problem(SCREENED_ON[:1], two_qualities=two_qualities)
    point = problem.values(TODAY, condition=0)
    captures: dict[Key, Capture] = {}
    results = [next(KeptCaptures(captures, keep=list).run(problem.task, [point]))[1] for _ in range(2)]
    assert simulated.count == 1
    ((key, capture),) = captures.items()
    assert key == (TODAY, SCREENED_ON[0])
    assert (capture.time, capture.error) == pytest.approx((12.0 + 0.5 / 0.12, 0.001))
    limit = 0.0 if two_qualities else LARGEST_ERROR
    for result in results:
        assert result.measures == pytest.approx((0.001 - limit,))
        assert result.value == pytest.approx(12.0 + 0.5 / 0.12)


def test_capture_that_is_missing_is_named() -> None:
    problem = lighting_problem(SCREENED_ON[:1])
    with pytest.raises(KeptResultsError, match=r"start|seed=201.*threshold 7.*--full goes on"):
        list(KeptCaptures({}).run(problem.task, [problem.values(TODAY, condition=0)]))


def test_stages_find_the_candidate_that_never_fails(simulated: Simulated) -> None:
    captures: dict[Key, Capture] = {}
    answer = answer_lighting(captures, keep=lambda: None)
    assert answer.screening.candidates[: len(BY_HAND)] == tuple(BY_HAND.values())
    assert len(answer.screening.candidates) == CANDIDATES
    threshold, speed = answer.choice[8], answer.choice[0]
    assert threshold <= 6.0
    # Among those that never fail, the fastest of the screening has won, or a faster one of the race.
    sure = [values for values in answer.screening.candidates if values[8] <= 6.0]
    assert speed >= max(values[0] for values in sure)
    # Today's constants fail in the grazing sun twice, in the worst quarter of eight cases.
    costs = dict(zip(answer.race.candidates, answer.race.costs, strict=True))
    assert costs[TODAY] == FAILURE
    assert costs[answer.choice] == pytest.approx(12.0 + 0.5 / speed)
    assert len(captures) <= CANDIDATES * len(SCREENED_ON) + RACE_BUDGET + 2 * len(JUDGED_ON) + 2 * len(PARAMETERS)
    assert len(answer.judged) == len(JUDGED_ON)
    # The same again, from what is kept: nothing is simulated.
    count = simulated.count
    again = answer_lighting(captures)
    assert simulated.count == count
    assert again.choice == answer.choice


def test_kept_captures_are_complete() -> None:
    results = Results.read()
    answer = answer_lighting(results.captures, candidates=results.candidates)
    assert len(answer.screening.candidates) == results.candidates >= CANDIDATES
    assert answer.choice in answer.race.candidates
    assert answer.judged == JUDGED_ON


@pytest.mark.slow
@pytest.mark.one_python
def test_kept_capture_comes_out_again() -> None:
    captures = Results.read().captures
    key = TODAY, next(case for case in SCREENED_ON if case.light.startswith("beside"))
    assert agree(captures[key], simulate_capture(key))


def test_captures_agree_within_a_sample() -> None:
    assert agree(HELD, replace(HELD, time=18.2))
    assert not agree(HELD, replace(HELD, time=18.6))
    assert not agree(HELD, FAILED)
    assert not agree(HELD, replace(HELD, error=0.0012))


# -- the answer


def _answer(today: dict[str, list[Capture]], choice: dict[str, list[Capture]]) -> LightingAnswer:
    """Return an answer with these captures by light; all other lights have ones that hold the bar."""
    captures = {(values, case): HELD for values in (TODAY, OTHER) for case in (*RACED_ON, *JUDGED_ON)}
    for values, by_light in ((TODAY, today), (OTHER, choice)):
        for light, results in by_light.items():
            on = [case for case in JUDGED_ON if case.light == light]
            captures |= {(values, case): result for case, result in zip(on, results, strict=False)}
    costs = np.array([[18.0, 0.001], [18.0, 0.002]])
    screening = Screening((TODAY, OTHER), costs, (TODAY, OTHER))
    return LightingAnswer(captures, screening, Race((TODAY, OTHER), costs[:, 0], np.array([True, True]), OTHER))


GRAZING = "grazing, 86 deg"
FAILS = {light: [FAILED] * 3 for light in (GRAZING, "grazing from above, 82 deg")}


def test_answer_holds_with_fewer_failures() -> None:
    answer = _answer(FAILS, {})
    assert answer.holds
    lower, mean, upper = answer.gain
    assert mean == pytest.approx(6 * 42.0 / 20)
    assert 0.0 < lower < mean < upper
    assert answer.verdict.startswith("faster than today's constants: 12.60 s [")


def test_answer_does_not_hold_if_one_capture_decides() -> None:
    answer = _answer({GRAZING: [FAILED]}, {GRAZING: [replace(HELD, time=17.0)] * 2})
    assert answer.gain[0] < 0.0 < answer.gain[1]
    assert list(answer.claims.values()) == [True, True, True, False]
    assert answer.verdict.startswith("not shown to be faster, slower or as fast as today's constants")
    assert not answer.holds


def test_slower_choice_does_not_hold() -> None:
    slower = {light: [replace(HELD, time=19.0)] * 4 for light in LIGHTS | OTHER_LIGHTS}
    answer = _answer({}, slower)
    assert list(answer.claims.values()) == [True, True, True, False]
    assert answer.verdict.startswith("slower than today's constants: -1.00 s")


def test_answer_holds_if_the_parameters_do_not_matter() -> None:
    slightly = _answer({}, {GRAZING: [replace(HELD, time=17.8)]})
    assert slightly.gain[0] < 0.0
    assert slightly.verdict.startswith("as fast as today's constants: 0.01 s")
    assert slightly.holds


def test_answer_does_not_hold_if_another_light_fails_more() -> None:
    answer = _answer(FAILS, {"behind, lamp": [FAILED]})
    assert list(answer.claims.values()) == [True, False, True, True]


def test_time_is_not_bought_with_accuracy() -> None:
    answer = _answer(FAILS, {"eclipse, lamp": [replace(HELD, error=2.0 * ACCURACY)] * 4})
    assert list(answer.claims.values()) == [True, True, False, True]


@pytest.mark.parametrize("lost", [list(JUDGED_ON[7:8]), [c for c in JUDGED_ON if c.light == "eclipse, lamp"]])
def test_answer_does_not_hold_on_fewer_starts(lost: list[Case]) -> None:
    answer = _answer(FAILS, {})
    captures = {key: capture for key, capture in answer.captures.items() if key[1] not in lost}
    fewer = replace(answer, captures=captures)
    assert len(fewer.judged) == len(JUDGED_ON) - len(lost)
    assert not next(iter(fewer.claims.values()))


def test_choice_pays_for_lights_in_which_another_is_faster() -> None:
    answer = _answer({}, {})
    case = next(case for case in SCREENED_ON if case.light == GRAZING)
    captures = {**answer.captures, (TODAY, case): replace(HELD, time=16.0)}
    best = replace(answer, captures=captures).best_alone
    assert best[GRAZING] == (TODAY, 16.0, 18.0)
    assert all(time == now for light, (_, time, now) in best.items() if light != GRAZING)


def test_sensitivities_find_what_decides(simulated: Simulated) -> None:
    answer = answer_lighting({}, keep=lambda: None)
    assert [address for address, matters in answer.telling.items() if matters] == [PARAMETERS[0].address]
    # 0.5 m at 0.24 m/s instead of 0.12 m/s; in the grazing sun, both fail.
    beside, grazing = answer.sensitivities[PARAMETERS[0].address].values()
    assert beside.time - (12.0 + 0.5 / 0.12) == pytest.approx(-0.5 / 0.24)
    assert grazing == FAILED


def test_finalists_are_the_fastest_but_todays() -> None:
    costs = np.array([[10.0, 0.0], [30.0, 0.0], [20.0, 0.002], [20.0, 0.001]])
    values = (TODAY, *((float(k),) * len(TODAY) for k in (1, 2, 3)))
    assert Screening(values, costs, values[:1]).finalists == (values[3], values[2])


def test_plot_shows_sensitivities_once_there_are_any() -> None:
    answer = _answer(FAILS, {})
    front, judgement = plot_answer(answer).axes
    legend = front.get_legend()
    assert legend is not None
    assert [text.get_text() for text in legend.get_texts()] == ["candidates", "front", "today", "choice"]
    assert judgement.get_title() == "judgement: 20 other starts"
    later = {(VARIED[3], case): replace(HELD, time=20.0) for case in VARIED_ON}
    varied = replace(answer, captures={**answer.captures, **later})
    assert varied.telling == {PARAMETERS[3].address: True}
    bars = plot_answer(varied).axes[2].containers
    assert [[bar.get_width() for bar in bars_of_case] for bars_of_case in bars] == [
        [2.0 if k == 3 else 0.0 for k in range(len(PARAMETERS))]
    ] * 2


def test_campaign_without_a_keeper_simulates_nothing() -> None:
    with pytest.raises(KeptResultsError):
        Campaign({}).screen()
