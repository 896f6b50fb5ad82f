"""Tests of the choices of a scanner and of a route: their criteria, and the problems that are solved."""

from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest

from vtbdrake.components.localization.landmarks import Landmarks
from vtbdrake.components.localization.unit import DOUBTFUL, TRACKING
from vtbdrake.testbed import ScenarioError
from vtbdrake_diagrams.forest.scenario import ForestScenario
from vtbdrake_diagrams.forest.studies import next_route, scanner_choice
from vtbdrake_diagrams.forest.studies.drive import Drive, Track, localize, simulated_drive
from vtbdrake_diagrams.forest.studies.next_route import (
    COUNTED,
    FOUND,
    HORIZON,
    ROUTE,
    UNKNOWN,
    RouteAnswer,
    RouteScenario,
    late_error,
    summary,
    variance,
)
from vtbdrake_diagrams.forest.studies.scanner_choice import (
    BEAMS,
    HEIGHTS,
    SETTLING,
    ScannerAnswer,
    plot_answer,
    position_error,
    scanner_problem,
)
from vtbdrake_diagrams.forest.studies.scanner_choice import UNKNOWN as FAR
from vtbdrake_diagrams.forest.world.stand import REMOTE, Stand

# The true pose and velocity, and the time of the pose of the DPS: the carrier has come 3 cm and 4 cm since then.
TRUTH, VELOCITY, LAG = np.array([3.03, 4.04, 0.5, 0.0, 0.0, 1.0]), np.array([0.0, 0.0, 9.0, 1.5, 2.0, 0.0]), 0.02


def test_error_counts_from_when_the_pose_has_settled() -> None:
    early, stamp = SETTLING - 0.1, SETTLING - LAG
    assert position_error(early, np.zeros(2), early - LAG, TRUTH, VELOCITY) == 0.0
    assert position_error(SETTLING, np.array([3.3, 4.4]), stamp, TRUTH, VELOCITY) == pytest.approx(0.5)
    assert position_error(SETTLING, np.full(2, np.nan), stamp, TRUTH, VELOCITY) == FAR


def test_the_best_scanner_has_the_least_mean_error() -> None:
    errors = np.full((len(HEIGHTS), len(BEAMS), 2), 0.03)
    errors[1, 2] = [0.0, 0.04]
    # Not the least in one forest, but in the mean.
    errors[0, 0] = [0.01, 0.05]
    answer = ScannerAnswer(errors)
    assert answer.best == (HEIGHTS[1], BEAMS[2])
    assert len(plot_answer(answer).axes) == 2


def test_problem_has_the_number_of_beams(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scanner_choice, "ForestScenario", partial(ForestScenario, length=40.0, width=40.0))
    problem = scanner_problem(BEAMS[0], seeds=[3, 4])
    assert problem.scenario.scanner.rows == BEAMS[0] != ForestScenario().scanner.rows
    assert [condition["scenario.seed"] for condition in problem.conditions] == [3, 4]


def test_imagined_forest_is_that_of_the_map() -> None:
    scenario = RouteScenario(seed=2, length=60.0, width=60.0)
    mental = scenario.mental()
    imagined, mapped = (model.positions() for model in (mental.truth(), scenario.global_map()))
    np.testing.assert_array_equal(imagined, mapped)
    np.testing.assert_array_equal(mental.global_map().positions(), mapped)
    assert len(scenario.truth()) != len(mapped)
    assert mental.undergrowth == 0.0 and mental.mental() == mental


def test_maps_from_files_are_not_imagined() -> None:
    with pytest.raises(ScenarioError, match="map_file must be empty, not .*: what the carrier imagines"):
        RouteScenario(map_file="forest.geojson").validate()


def test_routes_are_judged_after_they_have_parted() -> None:
    late = FOUND + HORIZON - COUNTED
    assert variance(late - 1.0, np.eye(3)) == 0.0
    assert variance(late, np.diag([0.09, 0.16, 1.0])) == pytest.approx(0.25)
    assert variance(late, np.diag([np.inf, np.inf, np.inf])) == UNKNOWN**2


def test_error_of_a_drive_is_that_of_its_end() -> None:
    times = np.array([0.0, 1.0, 2.0, 3.0]) + COUNTED
    times[0] = 1.0
    truth, poses = np.zeros((4, 3)), np.array([[9.0, 9.0, 0.0], [0.3, 0.4, 0.1], [np.nan] * 3, [40.0, 0.0, 0.0]])
    drive = Drive(times, truth, truth, (Landmarks.empty(),) * 4)
    track = Track(drive, poses, np.tile(np.eye(3), (4, 1, 1)), np.array([TRACKING, TRACKING, DOUBTFUL, TRACKING]))
    # Without a pose and far off, it counts as unknown.
    assert late_error(track) == pytest.approx(((0.25 + 2.0 * UNKNOWN**2) / 3.0) ** 0.5)


def test_map_in_use_comes_before_the_other_surveys(monkeypatch: pytest.MonkeyPatch) -> None:
    def drive(one: RouteScenario, *, length: float) -> Drive:
        assert length == one.speed * (FOUND + HORIZON)
        return simulated_drive(one.stand(), seed=one.route, length=6.0)

    monkeypatch.setattr(next_route, "recorded_drive", drive)
    monkeypatch.setattr(next_route, "SURVEYS", 1)
    scenario = RouteScenario(seed=3, length=60.0, width=60.0, stand_kind="natural", density=800.0, map_seed=5)
    found = next_route.errors_by_map(scenario)
    assert found.shape == (2, 2) and (found < 0.3).all() and len(np.unique(found)) == 4
    unit = scenario.unit(Stand(seed=3, length=60.0, width=60.0, density=800.0, road_width=4.0).map(REMOTE, seed=5))
    assert found[0, 1] == late_error(localize(drive(replace(scenario, route=1), length=86.0), unit))


def test_summary_compares_the_choice_with_all_routes() -> None:
    choice, none = SimpleNamespace(values={ROUTE: 1.0}), SimpleNamespace(values={})
    first, second = np.array([0.5, 0.2, 0.1]), np.array([0.1, 0.2, 0.6])
    answers = {
        # Two surveys with the given root mean square; the error with the map in use differs.
        7: RouteAnswer(choice, np.array([0.2, 0.1, 0.3]), np.array([[0.4, 0.3, 0.0], 0.6 * first, 1.64**0.5 * first])),
        8: RouteAnswer(none, np.array([0.3, 0.4, 0.5]), np.array([[0.9, 0.9, 0.9], second, second]), in_use=2),
    }
    assert [answer.choice for answer in answers.values()] == [1, 2]
    assert [answer.rank for answer in answers.values()] == [1, 2]
    mean, use, every, own, promised = summary(answers).splitlines()[-5:]
    assert mean.split() == ["mean", "0.300", "0.400", "0.550", "0.283", "0.100", "1.5"]
    # The gains are 0.3 and 0, and 0.067 and -0.3; with the map in use 0.1 and 0.
    assert use.endswith("in use: 0.150 m, with a standard error of 0.150 m")
    assert every.endswith("routes: -0.117 m, with a standard error of 0.183 m")
    assert own.endswith("with the map in use: 0.050 m, with a standard error of 0.050 m")
    assert promised.endswith(": 0.050 m")
