"""Question R1: the robot decides from its belief, and worlds differ from its model; short horizons."""

from __future__ import annotations

from dataclasses import replace
from functools import partial, partialmethod

import numpy as np
import pytest
from click.testing import CliRunner

from vtbdrake.optimization import Problem
from vtbdrake.rollout import RolloutRunner
from vtbdrake_diagrams.space_climber import CraterScenario
from vtbdrake_diagrams.space_climber.studies import crater
from vtbdrake_diagrams.space_climber.studies.crater import (
    CAUTION,
    COUNTERFACTUALS,
    FRICTION_RANGE,
    HEADING,
    HEADINGS,
    MASS_RANGE,
    POSE,
    STANDING,
    WALK,
    Expedition,
    World,
    differing,
    elevation,
    heading_problem,
    heading_reasoner,
    main,
    model,
)


def test_f_is_the_elevation() -> None:
    assert [elevation(z) for z in (0.2, 6.2, -1.0)] == [0.2, 6.2, 0.0]


def test_worlds_differ_within_what_the_robot_expects() -> None:
    worlds = [differing(seed, difference) for seed in range(4) for difference in range(20)]
    frictions = [world.scenario.friction / CraterScenario().friction for world in worlds]
    masses = [world.mass for world in worlds]
    for found, (lower, upper) in ((frictions, FRICTION_RANGE), (masses, MASS_RANGE)):
        assert lower <= min(found) < lower + 0.02
        assert upper - 0.02 < max(found) <= upper
    assert differing(2, 3) == differing(2, 3)
    assert differing(2, 3) != differing(2, 4)
    assert model(2).friction == pytest.approx(CAUTION * CraterScenario().friction)
    assert model(2).mental().waviness == 0.0
    for fields in COUNTERFACTUALS.values():
        model(2).with_fields(fields)


@pytest.mark.parametrize("seed", [2, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (5, 12, 27))])
def test_the_robot_starts_on_the_ground_and_not_in_it(seed: int) -> None:
    """Waves lift the ground under a foot by up to 9 cm in these worlds; Drake's own contact query is the judge."""
    world = differing(seed, seed).scenario
    testbed = world.build()
    context = testbed.default_context()
    query = testbed.scene_graph.get_query_output_port().Eval(testbed.scene_graph.GetMyContextFromRoot(context))
    assert max((pair.depth for pair in query.ComputePointPairPenetration()), default=0.0) < 2e-4
    lifted = query.ComputeSignedDistancePairwiseClosestPoints(0.002)
    assert any(pair.distance < 2e-4 for pair in lifted)


@pytest.mark.slow
def test_the_robot_decides_while_it_stands_in_a_world_that_differs() -> None:
    world = World(CraterScenario(seed=1, boulders=False, waviness=0.03, friction=0.55), mass=1.05)
    expedition = Expedition(world)
    scenario = replace(model(1), boulders=False)
    with heading_reasoner(scenario, horizon=4.0, executor="serial") as reasoner:
        decision = expedition.decide(reasoner)
        angles = sorted(float(candidate.values[HEADING]) for candidate in decision.candidates)
    np.testing.assert_allclose(angles, HEADINGS, atol=1e-12)
    assert decision.time == pytest.approx(STANDING)
    assert decision
    # The floor is flat: the torso's height.
    assert decision.quality == pytest.approx(0.2, abs=0.02)


@pytest.mark.slow
def test_a_mental_robot_walks_in_the_direction_of_its_heading() -> None:
    problem = heading_problem(replace(model(1), boulders=False))
    task = replace(problem.task, horizon=14.0, record=(POSE,))
    runner = RolloutRunner(task, problem.testbed)
    poses = {angle: runner.run({HEADING: angle, WALK: 1.0}).record[POSE] for angle in (-0.5, 0.4)}
    for angle, pose in poses.items():
        way = pose[-1, :2] - pose[len(pose) // 2, :2]
        assert np.arctan2(way[1], way[0]) == pytest.approx(angle, abs=0.1)
        assert np.hypot(*way) == pytest.approx(0.19 * 6.0, rel=0.15)


@pytest.mark.slow
@pytest.mark.one_python
def test_the_landscape_is_drawn_beside_a_continuous_search(tmp_path, monkeypatch) -> None:
    # A few short rollouts: worker processes would take longest to start.
    monkeypatch.setattr(crater, "heading_reasoner", partial(heading_reasoner, executor="serial"))
    monkeypatch.setattr(Problem, "sweep", partialmethod(Problem.sweep, executor="serial"))
    figure = tmp_path / "headings.png"
    options = ["--step", "45", "--candidates", "3", "--horizon", "4", "--figure", str(figure)]
    result = CliRunner().invoke(main, options, catch_exceptions=False)
    assert "0 of 3 headings pass the rim" in result.output
    assert "CEM, 3 headings" in result.output
    assert "no way seen" in result.output
    assert figure.stat().st_size > 10_000
