"""A batch of rollouts is what the plant does, candidate by candidate."""

from __future__ import annotations

import re
import threading

import casadi
import numpy as np
import pytest
from pydrake.autodiffutils import AutoDiffXd, ExtractGradient, ExtractValue
from pydrake.solvers import MathematicalProgram, SnoptSolver

from tests.components.compiled_plant.plants import arm, cart_pole, simulate
from vtbdrake.components.compiled_plant import PlantRollouts, plant_step

STEPS, KNOTS = 30, 5


@pytest.fixture(autouse=True)
def cache(tmp_path_factory, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.getbasetemp() / "cache"))


def hat_functions() -> np.ndarray:
    """B of a polyline through the knots."""
    t, knots = np.linspace(0.0, 1.0, STEPS, endpoint=False), np.linspace(0.0, 1.0, KNOTS)
    return np.array([np.interp(t, knots, unit) for unit in np.eye(KNOTS)]).T


def cost(x, u):
    return casadi.sumsqr(x) + 0.1 * casadi.sumsqr(u)


def final_cost(x):
    return 10.0 * casadi.sumsqr(x)


def rollouts_of(plant, *, inputs=(), compile=False) -> PlantRollouts:
    step = plant_step(plant, plant.CreateDefaultContext(), inputs=inputs)
    return PlantRollouts(step, control=hat_functions(), cost=cost, final_cost=final_cost, compile=compile)


def by_drake(plant, context, z) -> tuple[float, np.ndarray]:
    """The cost of one candidate, and its final state."""
    u = hat_functions() @ z
    x = np.vstack([plant.GetPositionsAndVelocities(context), simulate(plant, context, u, STEPS)])
    running = sum(float(cost(casadi.DM(x[k]), casadi.DM(u[k]))) for k in range(STEPS))
    return running + float(final_cost(casadi.DM(x[-1]))), x[-1]


@pytest.mark.slow_cases
@pytest.mark.parametrize("compile", [False, True])
@pytest.mark.parametrize("make", [cart_pole, arm])
def test_costs_are_those_of_the_plant(make, compile):
    plant = make(0.01)
    context = plant.CreateDefaultContext()
    n, nu = 3, plant.num_actuated_dofs()
    z = np.random.default_rng(0).normal(size=(n, KNOTS, nu))
    x0 = plant.GetPositionsAndVelocities(context)
    batch = rollouts_of(plant, compile=compile)(x0, z)
    assert batch.valid.all()
    for k in range(n):
        expected, final = by_drake(plant, context, z[k])
        assert batch.costs[k] == pytest.approx(expected, rel=1e-11)
        np.testing.assert_allclose(batch.final[k], final, atol=1e-11)


def test_every_candidate_may_have_its_own_start_and_belief():
    plant = cart_pole(0.01)
    context = plant.CreateDefaultContext()
    rollouts = rollouts_of(plant, inputs=["pole.mass"])
    x0 = 0.3 * np.random.default_rng(0).normal(size=(3, 4))
    masses, z = np.array([0.1, 0.2, 0.7]), np.ones((3, KNOTS))
    batch = rollouts(x0, z, pole_mass=masses[:, None])
    for k in range(3):
        plant.GetBodyByName("pole").SetMass(context, masses[k])
        plant.SetPositionsAndVelocities(context, x0[k])
        assert batch.costs[k] == pytest.approx(by_drake(plant, context, z[k][:, None])[0], rel=1e-11)
    same = rollouts(x0[0], z, pole_mass=0.1)
    np.testing.assert_array_equal(same.costs, same.costs[0])
    assert same.costs[0] == batch.costs[0]


def test_rollout_that_reaches_a_stop_is_marked():
    plant = cart_pole(0.01, stop=0.1)
    batch = rollouts_of(plant)(np.zeros(4), np.array([[0.1] * KNOTS, [15.0] * KNOTS]))
    assert batch.valid.tolist() == [True, False]


def test_largest_overrun_of_all_steps_counts():
    x, u = casadi.SX.sym("x", 1), casadi.SX.sym("u", 1)
    step = casadi.Function("step", [x, u], [x, u], ["x", "u"], ["x_next", "overrun"])
    rollouts = PlantRollouts(step, control=hat_functions(), cost=cost, compile=False)
    z = np.array([[-1.0, -2.0, 0.5, -2.0, -1.0], [-1.0, -2.0, -0.5, -2.0, -1.0]])
    batch = rollouts([0.0], z)
    np.testing.assert_allclose(batch.overruns, (z @ hat_functions().T).max(axis=1))
    assert batch.valid.tolist() == [False, True]


def test_rollout_that_diverges_is_marked():
    step = casadi.SX.sym("x", 1), casadi.SX.sym("u", 1)
    explosive = casadi.Function("step", list(step), [1e30 * step[0] ** 2, -1.0], ["x", "u"], ["x_next", "overrun"])
    rollouts = PlantRollouts(explosive, control=np.ones((STEPS, 1)), cost=cost, compile=False)
    assert rollouts([[1.0], [0.0]], np.zeros((2, 1))).valid.tolist() == [False, True]


@pytest.mark.parametrize(
    "cost", [lambda x, u: casadi.fmin(x, 1.0), lambda x, u: casadi.fmax(-1.0, casadi.fmin(x, 1.0))]
)
@pytest.mark.parametrize("compile", [False, True])
def test_cost_that_drops_a_nan_does_not_hide_it(cost, compile):
    x, u = casadi.SX.sym("x", 1), casadi.SX.sym("u", 1)
    step = casadi.Function("step", [x, u], [casadi.log(x) + u, -1.0], ["x", "u"], ["x_next", "overrun"])
    rollouts = PlantRollouts(
        step, control=np.ones((3, 1)), cost=cost, final_cost=lambda x: cost(x, 0.0), compile=compile
    )
    batch = rollouts([[1.0], [-1.0], [np.nan], [1.0]], [[2.0], [2.0], [2.0], [np.nan]])
    assert np.isfinite(batch.costs).all()
    assert batch.valid.tolist() == [True, False, False, False]


def test_control_that_the_plant_holds_back_has_to_be_finite():
    """An effort limit makes a finite torque even of an infinite one."""
    batch = rollouts_of(cart_pole(0.01))(np.zeros(4), [[1.0] * KNOTS, [np.inf] * KNOTS, [np.nan] * KNOTS])
    assert batch.valid.tolist() == [True, False, False]


@pytest.mark.parametrize("compile", [False, True])
def test_gradient_is_that_of_the_costs(compile):
    rollouts = rollouts_of(cart_pole(0.01), compile=compile)
    x0, z, h = np.array([0.0, 0.5, 0.1, -0.2]), np.linspace(-1.0, 1.0, KNOTS), 1e-5
    value, slope = rollouts.gradient(x0, z)
    shifted = rollouts(x0, np.concatenate([z + h * np.eye(KNOTS), z - h * np.eye(KNOTS)])).costs
    assert value == rollouts(x0, z[None]).costs[0]
    np.testing.assert_allclose(slope, (shifted[:KNOTS] - shifted[KNOTS:]) / (2 * h), rtol=1e-6)


def test_results_stay_when_the_next_batch_runs():
    rollouts = rollouts_of(cart_pole(0.01))
    first = rollouts(np.zeros(4), np.ones((2, KNOTS)))
    kept = first.costs.copy()
    rollouts(np.ones(4), np.ones((2, KNOTS)))
    np.testing.assert_array_equal(first.costs, kept)


def test_threads_do_not_meet():
    rollouts = rollouts_of(cart_pole(0.01))
    starts = np.linspace(0.0, 1.0, 4)
    alone = [rollouts(np.full(4, s), np.ones((8, KNOTS))).costs for s in starts]
    found: dict[int, list[np.ndarray]] = {k: [] for k in range(4)}

    def work(k: int) -> None:
        for _ in range(20):
            found[k].append(rollouts(np.full(4, starts[k]), np.ones((8, KNOTS))).costs)

    threads = [threading.Thread(target=work, args=(k,)) for k in found]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for k, batches in found.items():
        for costs in batches:
            np.testing.assert_array_equal(costs, alone[k])


def _double_integrator() -> casadi.Function:
    x, u = casadi.SX.sym("x", 2), casadi.SX.sym("u", 1)
    v = x[1] + u / STEPS
    x_next = casadi.vertcat(x[0] + v / STEPS, v)
    return casadi.Function("step", [x, u], [x_next, -1.0], ["x", "u"], ["x_next", "overrun"])


def _least_effort() -> tuple[PlantRollouts, np.ndarray]:
    """Bring a double integrator from rest at 0 to rest at 1 with the least effort, and the linear algebra's answer."""
    weight = 1e6
    rollouts = PlantRollouts(
        _double_integrator(),
        control=np.eye(STEPS),
        cost=lambda x, u: casadi.sumsqr(u),
        final_cost=lambda x: weight * casadi.sumsqr(x - casadi.DM([1.0, 0.0])),
        compile=False,
    )
    k = np.arange(STEPS)
    A = np.array([(STEPS - k) / STEPS**2, np.full(STEPS, 1 / STEPS)])
    answer = np.linalg.solve(np.eye(STEPS) + weight * A.T @ A, weight * A.T @ [1.0, 0.0])
    return rollouts, answer


def test_casadis_solvers_solve_problems_on_it():
    rollouts, answer = _least_effort()
    z = casadi.MX.sym("z", 1, STEPS)
    value = rollouts.function(np.zeros(2), z)[0]
    solver = casadi.nlpsol(
        "solver", "ipopt", {"x": casadi.vec(z), "f": value}, {"ipopt.print_level": 0, "print_time": False}
    )
    np.testing.assert_allclose(solver(x0=np.zeros(STEPS))["x"].full().ravel(), answer, atol=1e-5)


def test_drakes_solvers_solve_problems_on_it():
    rollouts, answer = _least_effort()
    program = MathematicalProgram()
    z = program.NewContinuousVariables(STEPS)

    def by_chain_rule(z):
        if z.dtype == float:
            return rollouts.gradient(np.zeros(2), z)[0]
        value, slope = rollouts.gradient(np.zeros(2), ExtractValue(z).ravel())
        return AutoDiffXd(value, slope @ ExtractGradient(z))

    program.AddCost(by_chain_rule, vars=z)
    result = SnoptSolver().Solve(program, np.zeros(STEPS))
    assert result.is_success()
    np.testing.assert_allclose(result.GetSolution(z), answer, atol=1e-4)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda r: r(np.zeros(4), np.zeros((2, KNOTS + 1)), pole_mass=1.0), f"(n, {KNOTS}, 1)"),
        (lambda r: r(np.zeros(3), np.zeros((2, KNOTS)), pole_mass=1.0), "x0 has the shape (4,)"),
        (lambda r: r(np.zeros((3, 4)), np.zeros((2, KNOTS)), pole_mass=1.0), "x0 has the shape (4,)"),
        (lambda r: r(np.zeros(4), np.zeros((2, KNOTS))), "the inputs of the step are pole_mass"),
        (lambda r: r(np.zeros(4), np.zeros((2, KNOTS)), mass=1.0), "the inputs of the step are pole_mass"),
        (lambda r: r(np.zeros(4), np.zeros((0, KNOTS)), pole_mass=1.0), "knots"),
        (lambda r: r.gradient(np.zeros(4), np.zeros((2, KNOTS)), pole_mass=1.0), f"({KNOTS}, 1)"),
    ],
)
def test_wrong_shape_is_an_error(call, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        call(rollouts_of(cart_pole(0.01), inputs=["pole.mass"]))


@pytest.mark.parametrize("control", [np.zeros(3), np.full((3, 2), np.nan), np.zeros((0, 2))])
def test_control_is_a_matrix(control):
    plant = cart_pole(0.01)
    step = plant_step(plant, plant.CreateDefaultContext())
    with pytest.raises(ValueError, match="matrix"):
        PlantRollouts(step, control=control, cost=cost)
