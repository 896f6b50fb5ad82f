"""Tests of the trials of global localization: their criteria, and a few trials."""

from dataclasses import replace

import numpy as np
import pytest

from vtbdrake.components.localization.landmarks import Landmarks
from vtbdrake_diagrams.forest.studies.trials import GOALS, LARGEST_WRONG, Case, Trial, cases, judged, run, verdicts

pytestmark = pytest.mark.one_python

INSIDE = Case("natural", 600.0, "accurate", "inside")


class Claim:
    """Stands for a map of a constellation, and for what it finds: a pose."""

    is_sure = True
    covariance = np.diag([0.01, 0.01, 1e-4])

    def __init__(self, pose: list[float]) -> None:
        self.pose = np.array(pose)

    def locate(self, local: Landmarks) -> "Claim":
        return self


def test_a_pose_is_right_if_it_is_near() -> None:
    truth = np.array([10.0, 20.0, 3.1])
    near = judged(Claim([10.3, 20.0, 3.1 - 2.0 * np.pi]), Landmarks.empty(), truth, INSIDE)
    assert near.is_right and np.isclose(near.position, 0.3) and np.isclose(near.nees, 9.0)
    assert not judged(Claim([10.7, 20.0, 3.1]), Landmarks.empty(), truth, INSIDE).is_right
    assert not judged(Claim([10.0, 20.0, 2.9]), Landmarks.empty(), truth, INSIDE).is_right
    assert judged(Claim([10.7, 20.0, 3.1]), Landmarks.empty(), truth, replace(INSIDE, map="remote")).is_right
    assert not judged(Claim(list(truth)), Landmarks.empty(), truth, replace(INSIDE, place="outside")).is_right


def test_verdicts_count_every_wrong_claim() -> None:
    right, wrong = Trial(True, True, 0.0, 0.0, 3.0, 0.1), Trial(True, False, 9.0, 0.0, 99.0, 0.1)
    edge, outside = replace(INSIDE, place="edge"), replace(INSIDE, place="outside")
    results = [(INSIDE, [right] * 97 + [wrong] * 3), (edge, [wrong] * 50), (outside, [wrong] + [right] * 49)]
    (_, share, goal, is_met), (_, wrongs, limit, _) = verdicts(results)
    assert (share, goal, is_met) == (0.97, GOALS["accurate"], True)
    assert (wrongs, limit) == (54 / 200, LARGEST_WRONG)


def test_there_are_at_least_a_thousand_trials_by_default() -> None:
    assert 40 * len(cases()) >= 1000
    assert sum(case.is_judged for case in cases()) == 9


def test_places_inside_are_found_and_others_are_not_claimed() -> None:
    # Seeds of development; those of the command are for the command alone.
    assert all(run(INSIDE, seed=seed).is_right for seed in range(3))
    for case in (replace(INSIDE, place="outside"), Case("plantation", 1000.0, "remote", "outside")):
        assert not any(run(case, seed=seed).is_sure for seed in range(2))


def test_a_drive_tells_more_of_a_plantation_than_one_place() -> None:
    rows = Case("plantation", 1000.0, "remote", "inside")
    assert not run(rows, seed=0).is_sure
    assert run(replace(rows, is_driven=True), seed=0).is_right


def test_a_drive_ends_where_it_is_judged() -> None:
    trial = run(replace(INSIDE, map="poor"), seed=1)
    assert trial.is_right and trial.position < 2.0
