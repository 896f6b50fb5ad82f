"""The distances that plans of the arm keep, beside the distances of Drake's SceneGraph."""

from __future__ import annotations

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw

from vtbdrake.testbed import ScenarioError
from vtbdrake_diagrams.satellite.arm_move import REACHING, Move, move_space
from vtbdrake_diagrams.satellite.arm_planning import plan_by_casadi, plan_by_drake
from vtbdrake_diagrams.satellite.bodies import Servicer
from vtbdrake_diagrams.satellite.clearance import CLEARANCE, ArmClearance, DrakeClearance
from vtbdrake_diagrams.satellite.studies.arm_motion import ArmMotionScenario

# Starts and goals in rad between which a plan runs into the base, and links 5 and 7 into each other, if the planner
# watches no more than points of the arm; the straight paths are clear.
THROUGH_THE_BASE = (0.0, 1.75, -0.01, 2.41, 0.11, 0.86, -0.19), (-0.8, 0.39, 1.04, 0.89, 0.14, 0.24, -1.84)
INTO_ITSELF = (0.0, 1.94, 0.02, 2.28, 0.0, 1.07, 0.16), (1.96, -1.27, 2.31, -0.19, 1.88, 1.32, 2.51)


@pytest.fixture(scope="module")
def arm() -> ArmClearance:
    return ArmClearance(Servicer())


@pytest.fixture(scope="module")
def drake() -> DrakeClearance:
    return DrakeClearance()


def poses(count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(Servicer().lower, Servicer().upper, (count, 7))


@pytest.mark.slow
def test_spheres_are_never_farther_than_the_shapes(arm, drake):
    """Beyond 6 cm, there are pairs of links that no spheres stand for, as they cannot come closer."""
    q = poses(4000)
    q = q[arm.least(q) > 0.0]  # Nothing is claimed about the others.
    ours, theirs = arm.least(q), np.array([drake.nearest(pose)[0] for pose in q])
    near = (ours > 0.0) & (ours < 0.06)
    assert near.sum() > 200
    assert np.all(ours[near] <= theirs[near] + 1e-4)
    assert np.all(ours[theirs < 0.0] <= 1e-4)
    # They are not so far ahead of the shapes that the arm could not move.
    assert np.max(theirs[near] - ours[near]) < 0.05


def test_smooth_minimum_is_a_lower_bound_near_the_least_distance(arm):
    q = poses(1000, seed=1)
    soft, least = arm.soft(q.T).full().min(axis=0), arm.least(q)
    assert np.all(soft <= least + 1e-12)
    assert np.all(soft >= least - 0.02)


def test_no_distance_changes_faster_than_its_bound(arm):
    q, h = poses(1000, seed=2), 1e-6
    steps = h * np.random.default_rng(3).uniform(-1.0, 1.0, q.shape)
    change = np.abs(arm.distances((q + steps).T).full() - arm.distances(q.T).full())
    assert np.all(change <= (np.abs(steps) @ arm.reaches) * (1.0 + 1e-3) + 1e-12)


@pytest.mark.slow_cases
@pytest.mark.parametrize("seed", range(3))
def test_clearance_of_a_plan_is_that_between_the_instants_too(seed, arm):
    space = move_space(20.0, 9)
    move = Move(space, np.array(Servicer().stowed), np.array(REACHING))
    knots = move.straight.copy()
    knots[2:-2] += 0.6 * np.random.default_rng(seed).standard_normal(knots[2:-2].shape)
    dense = arm.least(space.spline.matrix(np.linspace(0.0, 20.0, 20001)) @ knots).min()
    assert dense - 1e-3 <= space.clearance(knots) <= dense + 1e-9


@pytest.mark.slow
@pytest.mark.one_python
@pytest.mark.parametrize(
    ("solve", "ends"),
    [(plan_by_casadi, THROUGH_THE_BASE), (plan_by_casadi, INTO_ITSELF), (plan_by_drake, THROUGH_THE_BASE)],
)
def test_plans_keep_clear_by_drakes_distances(solve, ends, drake):
    move = Move(move_space(20.0, 9), *map(np.array, ends))
    assert move.excess(move.straight) == {}
    knots = solve(move, attempts=1).knots
    path = move.space.spline.matrix(np.linspace(0.0, 20.0, 1001)) @ knots
    distance, pair = min(map(drake.nearest, path))
    assert distance >= CLEARANCE - 1e-4, pair
    assert move.excess(knots) == {}
    assert move.motion(knots).angle[-1] < move.straight_motion.angle[-1]


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"start": (3.0, 2.0, -0.2, 1.3, 0.0, 0.1, 1.7)}, "the start is in collision, .* link_4 and the base is -"),
        ({"start": (2.2, 1.0, 2.8, 1.8, 0.9, 0.1, -2.4)}, "the start is in collision, .* hand and a panel is -"),
        ({"goal": (0.9, -1.8, 0.2, 1.5, -2.4, -1.8, 2.1)}, "the goal is in collision, .* link_5 and the yoke is -"),
        ({"goal": (0.0, 0.9, 0.0, 1.9, 0.0, 2.0, 0.0)}, "the goal is in collision, .* link_7 and link_5 is -"),
    ],
)
def test_ends_in_collision_are_refused_by_name(fields, message, drake):
    (q,) = fields.values()
    assert drake.nearest(q)[0] < 0.0
    with pytest.raises(ScenarioError, match=message):
        ArmMotionScenario(**fields).build()


def test_distance_from_boxes_of_another_body_is_to_their_surface(arm):
    q, X_TB = np.array(REACHING), RigidTransform(RollPitchYaw(0.1, -0.2, 0.3), [-2.4, 0.1, 0.0])
    boxes = [((0.8, 0.8, 0.8), (0.0, 0.0, 0.0)), ((0.03, 1.0, 0.6), (0.0, 1.0, 0.0))]
    random, distances = np.random.default_rng(0), []
    for edges, center in boxes:
        points = random.uniform(-0.5, 0.5, (200_000, 3))
        points[np.arange(len(points)), random.integers(3, size=len(points))] = random.choice([-0.5, 0.5], len(points))
        surface = points * edges + center
        for p, radius in zip((X_TB @ arm.centers(q).full()).T, arm.radii, strict=True):
            distances.append(np.linalg.norm(surface - p, axis=1).min() - radius)
    assert arm.from_boxes(q, X_TB, boxes) == pytest.approx(min(distances), abs=5e-3)
