"""The problem of application R2, and the plans that solvers find for it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from vtbdrake.optimization.solvers import make_solver
from vtbdrake.optimization.solvers.solver import SolverError
from vtbdrake_diagrams.satellite.arm_move import REACHING, Move, MoveSpace, move_space
from vtbdrake_diagrams.satellite.arm_planning import (
    CALM,
    GOOD_ENOUGH,
    MomentumDescent,
    good_enough,
    plan_by_casadi,
    plan_by_drake,
    plan_calmly,
    plan_near,
)
from vtbdrake_diagrams.satellite.bodies import Servicer
from vtbdrake_diagrams.satellite.kinematics import reaction
from vtbdrake_diagrams.satellite.studies.arm_motion import PLAN, ArmMotionScenario, free_knots


@pytest.fixture(scope="module")
def move() -> Move:
    return Move(move_space(20.0, 9), np.array(Servicer().stowed), np.array(REACHING))


def bent(move: Move, scale: float, seed: int = 0) -> np.ndarray:
    """Return the straight path with noise on its free knots."""
    noise = np.zeros_like(move.straight)
    noise[2:-2] = scale * np.random.default_rng(seed).standard_normal((move.space.free, 7))
    return move.straight + noise


def test_straight_path_keeps_the_limits_and_lies_on_a_line(move):
    assert move.excess(move.straight) == {}
    times = np.linspace(0.0, 20.0, 50)
    share = (move.space.spline.matrix(times) @ move.straight - move.start) @ (move.goal - move.start)
    line = share[:, None] * (move.goal - move.start) / np.sum((move.goal - move.start) ** 2)
    np.testing.assert_allclose(move.space.spline.matrix(times) @ move.straight, move.start + line, atol=1e-12)
    assert np.all(np.abs(move.space.spline.matrix([0.0, 20.0], 1) @ move.straight) < 1e-12)


@pytest.mark.parametrize("weight", [0.0, 0.7])
def test_cost_and_constraints_are_those_of_the_motion(move, weight):
    knots, move = bent(move, 0.2), replace(move, weight=weight)
    value, _ = move.space.functions
    cost, g = (found.full().ravel() for found in value(knots[2:-2].ravel(), move.numbers))
    motion = move.motion(knots)
    squares = 4.0 * np.sin(motion.angle[1:] / 2.0) ** 2
    assert cost[0] == pytest.approx(squares[-1] + weight * squares.mean())
    np.testing.assert_allclose(g[: move.space.steps], squares, atol=1e-12)
    torques = (motion.torque[::3] / Servicer().torques).ravel()
    np.testing.assert_allclose(g[move.space.steps :][: torques.size], torques, atol=1e-12)


@pytest.fixture(scope="module")
def held(move) -> Move:
    """Return the move while wheels hold the base."""
    return replace(move, space=move_space(20.0, 9, wheels=True))


@pytest.mark.parametrize(("kind", "weight"), [("move", 0.0), ("move", 0.7), ("held", 0.0)])
def test_slopes_are_those_of_finite_differences(request, kind, weight):
    move = replace(request.getfixturevalue(kind), weight=weight)
    value, slopes = move.space.functions
    z, h = bent(move, 0.2)[2:-2].ravel(), 1e-6
    way = np.random.default_rng(3).standard_normal(z.size)
    above, below = (value(z + sign * h * way, move.numbers) for sign in (1.0, -1.0))
    _, gradient, _, jacobian = (found.full() for found in slopes(z, move.numbers))
    assert gradient.ravel() @ way == pytest.approx(float(above[0] - below[0]) / (2.0 * h), rel=1e-5)
    difference = (above[1] - below[1]).full().ravel() / (2.0 * h)
    np.testing.assert_allclose(jacobian @ way, difference, atol=1e-6)


def test_wheels_give_what_the_momentum_of_the_arm_changes_by(held):
    knots, spline, h = bent(held, 0.2), held.space.spline, 1e-4
    value, _ = held.space.functions
    g = value(knots[2:-2].ravel(), held.numbers)[1].full().ravel()

    def momentum(t: float) -> np.ndarray:
        q, rates = ((spline.matrix([t], k) @ knots)[0] for k in range(2))
        return np.array(reaction(holding=False).value((q, rates))[:3])

    times = np.linspace(h, 20.0 - h, 13)[1:-1]
    torques = np.array([(momentum(t + h) - momentum(t - h)) / (2.0 * h) for t in times])
    shares = np.sum((torques / Servicer().wheel_torque) ** 2, axis=1)
    # The instants are every half of a piece; the kernel has closed fingers, here they are open.
    np.testing.assert_allclose(g[1:12], shares, rtol=0.05, atol=0.02)
    assert held.space.disturbance(g) == pytest.approx(np.sqrt(g[:13].max()))


def test_plan_near_another_one_needs_few_iterations(held):
    usual = plan_by_casadi(held, attempts=1)
    other = replace(held, goal=held.goal + 0.05)
    plan = plan_near(other, usual, iterations=10)
    assert not plan.move.excess(plan.knots)
    straight = other.space.functions[0](other.straight[2:-2].ravel(), other.numbers)[1].full().ravel()
    assert plan.deviation < 0.5 * other.space.disturbance(straight)
    np.testing.assert_array_equal(plan.knots[-1], other.goal)


def test_bounds_agree_with_the_limits(move):
    """Plans within the bounds of the solvers keep the limits, and plans that exceed a limit are outside."""
    least, most = move.bounds
    for scale in (0.05, 0.4, 1.0, 2.0):
        knots = bent(move, scale, seed=4)
        g = move.space.functions[0](knots[2:-2].ravel(), move.numbers)[1].full().ravel()
        excess = {name for name in move.excess(knots) if name != "position"}
        if ((least <= g) & (g <= most)).all():
            assert not excess
        elif np.max(np.maximum(least - g, g - most)) > 0.06 and excess != {"rate"}:
            # The solvers keep 5 % of the rates, for the servos.
            assert excess


@pytest.mark.parametrize(
    ("joint", "values", "limit"),
    [(3, [2.7] * 5, "position"), (0, [0.0, -2.0, 2.0, 0.0, 0.0], "rate"), (1, [-1.8] * 5, "clearance")],
)
def test_each_limit_is_watched(move, joint, values, limit):
    knots = move.straight.copy()
    knots[2:-2, joint] = values
    assert limit in move.excess(knots)


def test_a_plan_has_a_free_knot():
    with pytest.raises(ValueError, match="more than 4 knots, not 4"):
        MoveSpace(knots=4)


@pytest.mark.slow
@pytest.mark.parametrize(
    "solve",
    [
        pytest.param(plan_by_casadi, marks=pytest.mark.one_python),
        pytest.param(plan_calmly, marks=pytest.mark.one_python),
        plan_by_drake,
    ],
)
def test_solvers_find_a_plan_that_turns_the_base_back(move, solve):
    plan = solve(move, attempts=1)
    assert plan.move.excess(plan.knots) == move.excess(plan.knots) == {}
    assert plan.move.turn == (CALM if solve is plan_calmly else 1.0)
    assert move.motion(plan.knots).angle.max() <= plan.move.turn * move.straight_motion.angle.max() + 1e-9
    assert plan.deviation == pytest.approx(move.motion(plan.knots).angle[-1], abs=1e-6)
    assert plan.deviation < 0.1 * move.motion(move.straight).angle[-1]
    assert plan.time_to(plan.deviation) == plan.history[-1][0]
    assert plan.time_to(0.0) == np.inf
    np.testing.assert_array_equal(plan.knots[[0, 1, -2, -1]], move.straight[[0, 1, -2, -1]])


def test_unknown_solvers_are_refused(move):
    with pytest.raises(ValueError, match="one of SNOPT, IPOPT, not 'NLOPT'"):
        plan_by_drake(move, "NLOPT")


@pytest.mark.slow
@pytest.mark.one_python
def test_the_descent_proposes_its_plan_and_ends_with_it():
    scenario = replace(ArmMotionScenario(), thinking_time=10.0)
    options = {"origin": scenario.start, "goal": scenario.goal, "duration": 20.0, "knots": 9}
    solver = make_solver(MomentumDescent, free_knots(scenario, PLAN), budget=4, **options)
    (point,) = solver.ask()
    move = scenario.move()
    assert move.motion(move.knots(point)).angle[-1] <= good_enough(move) <= GOOD_ENOUGH
    with pytest.raises(SolverError, match="35 free knots, not 34"):
        make_solver(MomentumDescent, free_knots(scenario, PLAN)[1:], budget=4, **options)
