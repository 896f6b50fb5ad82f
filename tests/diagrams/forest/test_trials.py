"""Tests of the trials of global localization: their criteria, and a few trials."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import vtbdrake_diagrams.forest.studies
from vtbdrake.campaigns import Campaign
from vtbdrake.components.localization.landmarks import Landmarks
from vtbdrake_diagrams.forest.studies.trials import Case, judged, run

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


@pytest.fixture
def campaign() -> Campaign:
    return Campaign.load(Path(vtbdrake_diagrams.forest.studies.__path__[0]) / "trials.yaml")


@pytest.mark.slow
def test_a_rollout_of_the_campaign_is_a_trial(campaign: Campaign) -> None:
    # Seeds of development; the seeds of the file are for the command alone.
    names = ("natural 600 accurate inside", "plantation 1000 remote inside")
    conditions = {name: {**campaign.conditions[name], "sim.sys.trial.first": 0} for name in names}
    criteria = {name: replace(c, conditions=[]) for name, c in campaign.criteria.items()}
    result = replace(campaign, conditions=conditions, criteria=criteria, seeds=replace(campaign.seeds, count=1)).run(
        executor="serial", progress=False
    )
    for rollout in result.rollouts:
        kind, density, name, place = rollout.condition.split()
        trial = run(Case(kind, float(density), name, place), seed=0)
        assert rollout.values["share that is right and sure"] == trial.is_right
        assert rollout.values["not wrong and sure"] == (trial.is_sure and not trial.is_right)
        assert rollout.values["error where it is right"] == (trial.position if trial.is_right else 0.0)
    assert {rollout.values["share that is right and sure"] for rollout in result.rollouts} == {0.0, 1.0}


def test_no_two_conditions_share_a_stand(campaign: Campaign) -> None:
    count, firsts = campaign.seeds.count, [values["sim.sys.trial.first"] for values in campaign.conditions.values()]
    assert min(firsts) == 100_000 and min(np.diff(firsts)) >= count
    assert count * len(firsts) >= 1000
    judged_conditions = [c for criterion in campaign.criteria.values() for c in criterion.conditions]
    inside = [name for name in campaign.conditions if name.startswith("natural") and name.endswith("inside")]
    assert judged_conditions == inside


@pytest.mark.slow
def test_places_inside_are_found_and_others_are_not_claimed() -> None:
    # Seeds of development; the command's seeds are for the command alone.
    assert all(run(INSIDE, seed=seed).is_right for seed in range(3))
    for case in (replace(INSIDE, place="outside"), Case("plantation", 1000.0, "remote", "outside")):
        assert not any(run(case, seed=seed).is_sure for seed in range(2))


@pytest.mark.slow
def test_a_drive_tells_more_of_a_plantation_than_one_place() -> None:
    rows = Case("plantation", 1000.0, "remote", "inside")
    assert not run(rows, seed=0).is_sure
    assert run(replace(rows, is_driven=True), seed=0).is_right


def test_a_drive_ends_where_it_is_judged() -> None:
    trial = run(replace(INSIDE, map="poor"), seed=1)
    assert trial.is_right and trial.position < 2.0
