"""Drives with maps that are revised on the way: what is counted, and a DPS that revises its map."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2

from tests.diagrams.forest.riding import RidingScenario
from vtbdrake.components.localization.landmarks import Landmarks
from vtbdrake.components.localization.track_state import RATE, TrackState
from vtbdrake.components.localization.unit import TRACKING, UnitState
from vtbdrake_diagrams.forest.scenario import ForestScenario
from vtbdrake_diagrams.forest.studies import revised_maps
from vtbdrake_diagrams.forest.studies.drive import Drive, Track
from vtbdrake_diagrams.forest.studies.revised_maps import (
    DEVIATIONS,
    FORESTS,
    SEED,
    OutAndBack,
    Outdated,
    changes_right,
    is_no_worse,
    joint_nees,
    load,
    report,
    returns_well,
    surveyed,
    wrong_claims,
)
from vtbdrake_diagrams.kept_results import write_results

pytestmark = pytest.mark.one_python

CASE = Outdated(
    map="accurate",
    revises=True,
    rms=0.02,
    poses=0.99,
    losses=0,
    wrong=0,
    nees=3.0,
    added=(20, 19),
    lacking=(10, 9),
    dropped=(20, 19),
    gone=(10, 9),
    moved=(1, 1),
    landmarks=(38.0, 38),
    landmark_error=0.03,
)
RETURN = OutAndBack(
    revises=True,
    poses=1.0,
    out_poses=1.0,
    losses=0,
    wrong=0,
    out=50.0,
    reckoned=0.5,
    error=0.1,
    deviation=0.1,
    back=0.02,
    nees=(3.0, 3.0),
    landmarks=(0.1, 0.05),
    landmark_nees=(100.0, 100),
    added=(50, 49),
)


def test_survey_has_the_errors_and_the_entries_that_it_says() -> None:
    rng = np.random.default_rng(0)
    places = rng.uniform(0.0, 100.0, (500, 2))
    trunks = Landmarks(places, np.zeros((500, 2, 2)), rng.uniform(0.1, 0.4, 500), np.zeros(500))
    survey = surveyed(trunks, np.arange(400), gone=100, area=100.0, name="remote", rng=rng)
    assert survey.lacking.tolist() == list(range(400, 500)) and survey.gone.tolist() == list(range(400, 500))
    errors = survey.landmarks.positions[:400] - places[:400]
    assert np.sqrt((errors**2).mean()) == pytest.approx(0.35, rel=0.08)
    assert np.allclose(survey.landmarks.covariances, 0.35**2 * np.eye(2))
    # Where a tree stood, no other one stands.
    stood = survey.landmarks.positions[400:]
    assert np.median(np.hypot(*(stood[:, None] - places).transpose(2, 0, 1)).min(axis=1)) > 1.0


def test_wrong_claims_are_far_off_and_improbable() -> None:
    n = 4
    truth = np.zeros((n, 3))
    drive = Drive(np.arange(n, dtype=float), truth, truth, (Landmarks.empty(),) * n)
    poses = np.zeros((n, 3))
    poses[:, 0] = [0.6, 0.6, 0.4, 0.6]
    variances = np.array([0.1, 0.3, 0.1, 0.1]) ** 2
    track = Track(drive, poses, variances[:, None, None] * np.eye(3), np.array([TRACKING, TRACKING, TRACKING, 0]))
    # Far beyond three deviations; within them; too near to matter; no claim.
    assert wrong_claims(track) == 1


def test_joint_nees_of_errors_that_are_as_claimed_is_chi_square_distributed() -> None:
    rng, k, first = np.random.default_rng(1), 30, RATE + 1
    root = rng.normal(size=(first + 2 * k, first + 2 * k))
    P = 0.01 * root @ root.T
    places = rng.uniform(0.0, 50.0, (k, 2))
    values = []
    for _ in range(50):
        # Each detection of a landmark has an error of its own in common with its others.
        mean = rng.multivariate_normal(np.zeros(len(P)), P) + 0.3 * rng.normal(size=len(P))
        mean[first:] += places.ravel()
        track = TrackState(mean, P, np.arange(k), np.ones(k, dtype=bool))
        rows = np.array([3, 7, 20])
        square, freedom = joint_nees(UnitState(track=track), rows, places[rows], lasting=0.3)
        assert freedom == 6
        values.append(square)
    low, high = chi2(300).ppf([0.001, 0.999])
    assert low < sum(values) < high


@pytest.mark.parametrize(
    ("changed", "is_good"),
    [({}, True), ({"rms": 0.022}, False), ({"poses": 0.98}, False), ({"wrong": 1}, False)],
)
def test_each_measure_of_the_poses_can_be_worse(changed: dict[str, float], is_good: bool) -> None:
    fixed = [replace(CASE, revises=False)] * 3
    assert is_no_worse(fixed, [replace(CASE, **changed)] * 3) is is_good


@pytest.mark.parametrize("name", ["added", "lacking", "dropped", "gone"])
def test_each_share_of_changes_can_be_too_small(name: str) -> None:
    assert changes_right([CASE] * 2)
    assert not changes_right([CASE, replace(CASE, **{name: (10, 5)})])


@pytest.mark.parametrize("changed", [{"error": 0.6}, {"error": None}, {"landmarks": (0.1, 0.11)}, {"landmarks": None}])
def test_return_that_gains_nothing_is_none(changed: dict[str, object]) -> None:
    assert returns_well([RETURN] * 3)
    assert not returns_well([replace(RETURN, **changed)] * 3)


def test_report_is_the_same_from_a_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(revised_maps, "FILE", tmp_path / "kept.json")
    lost = {"error": None, "deviation": None, "back": None, "nees": None, "landmarks": None, "out_poses": 0.0}
    cases = [replace(CASE, map=name, revises=revises) for name in DEVIATIONS for revises in (False, True)]
    results = {
        "out of date": {1: cases},
        "out and back": {1: [replace(RETURN, revises=False, **lost), RETURN]},
        "out of date, scanner": {},
    }
    write_results(revised_maps.FILE, results, command="none")
    assert report(load()) == report(results)
    assert "95% of 20" in report(results) and "out and back: yes" in report(results)


def test_kept_results_are_of_new_forests() -> None:
    results = load()
    assert sorted(results["out of date"]) == list(range(SEED, SEED + FORESTS))
    driven = sorted(results["out and back"])
    assert driven == list(range(SEED, SEED + len(driven))) and len(driven) >= 14
    # What is right is among all.
    for cases in results["out of date"].values():
        assert [(case.map, case.revises) for case in cases] == [(name, r) for name in DEVIATIONS for r in (False, True)]
        assert all(case.added[1] <= case.added[0] and case.gone[1] <= case.gone[0] for case in cases)


def test_scenario_gives_its_unit_a_map_that_is_revised() -> None:
    scenario = ForestScenario(seed=3, length=60.0, width=60.0)
    units = [replace(scenario, revises_map=revises).unit(scenario.global_map()) for revises in (False, True)]
    assert [unit.tracker.revises for unit in units] == [False, True]


def test_snapshot_of_a_drive_has_the_revised_map() -> None:
    scenario = RidingScenario(revises_map=True)
    testbed, other = scenario.build(), scenario.build()
    simulator = testbed.simulator()
    simulator.AdvanceTo(2.0)
    snapshot = testbed.snapshot(simulator.get_context())
    log_odds = [array for name, array in snapshot.groups.items() if name.endswith("track.revision.log_odds")]
    assert log_odds and max(len(array) for array in log_odds) > 10
    simulator.AdvanceTo(3.0)
    copied = other.default_context()
    other.restore(copied, snapshot)
    other.simulator(copied, restored=True).AdvanceTo(3.0)
    assert other.snapshot(copied).compare(testbed.snapshot(simulator.get_context())) == {}
