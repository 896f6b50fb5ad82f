"""Solvers find optima that are known."""

import itertools

import numpy as np
import pytest
from scipy.optimize import minimize_scalar

from tests.optimization.solvers.driver import (
    ACKLEY,
    BRANIN,
    CONSTRAINED,
    ROSENBROCK,
    SPHERE,
    Function,
    box,
    drive,
    half_plane,
    solve,
)
from vtbdrake.optimization.parameter import Choice, Parameter
from vtbdrake.optimization.solvers import make_solver
from vtbdrake.optimization.solvers.drake_solvers import ALGORITHMS

pytestmark = pytest.mark.usefixtures("short_model")

# It fits a Gaussian process, and takes a second or two.
AUTO = pytest.param("auto", marks=pytest.mark.slow)
LOCAL = ["SNOPT", "IPOPT", "LD_SLSQP", "LN_BOBYQA", "LN_NELDERMEAD"]


@pytest.mark.slow_cases
@pytest.mark.parametrize("name", ["CMA-ES", "differential-evolution", "auto", *LOCAL])
@pytest.mark.parametrize("function", [SPHERE, ROSENBROCK], ids=["sphere", "rosenbrock"])
def test_it_converges_to_the_minimum_of_a_valley(name, function):
    options = {"tolerance": 1e-6} if name == "differential-evolution" else {}
    solver, best = solve(name, function, **options)
    assert solver.success is True
    np.testing.assert_allclose(best.point, function.best, atol=2e-3)
    assert -best.values[0] == pytest.approx(0.0, abs=1e-5)


@pytest.mark.parametrize("name", ALGORITHMS)
def test_every_algorithm_of_nlopt_comes_near_the_minimum(name):
    solver, best = solve(name, SPHERE, limit=1500)
    np.testing.assert_allclose(best.point, SPHERE.best, atol=0.05)


@pytest.mark.parametrize("name", [AUTO, "differential-evolution"])
def test_global_solvers_find_the_deepest_of_many_minima(name):
    solver, best = solve(name, ACKLEY, seed=3)
    assert solver.success is True
    np.testing.assert_allclose(best.point, ACKLEY.best, atol=2e-3)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["auto", "CMA-ES", "GN_DIRECT_L", "TPE"])
def test_global_solvers_find_the_value_of_branin(name):
    _, best = solve(name, BRANIN, budget=240)
    assert -best.values[0] == pytest.approx(BRANIN.lowest, abs=0.1 if name == "TPE" else 2e-3)


CONSTRAINED_NLOPT = sorted(name for name, takes_constraints in ALGORITHMS.items() if takes_constraints)


@pytest.mark.slow_cases
@pytest.mark.parametrize(
    "name", ["SNOPT", "IPOPT", "CMA-ES", "auto", "differential-evolution", "COBYQA", *CONSTRAINED_NLOPT]
)
def test_under_a_constraint_it_finds_the_kkt_point(name):
    options = {"tolerance": 1e-5} if name == "differential-evolution" else {}
    solver, best = solve(name, CONSTRAINED, violations=half_plane, limit=4000, **options)
    np.testing.assert_allclose(best.point, CONSTRAINED.best, atol=2e-3)
    assert best.violations[0] <= 0.0
    if solver.success:
        np.testing.assert_allclose(best.point, CONSTRAINED.best, atol=2e-2)


@pytest.mark.parametrize("name", ["SNOPT", "LD_SLSQP", "LN_COBYLA", "COBYQA"])
def test_an_optimum_at_the_bounds_is_found(name):
    function = Function(lambda p: (p[0] - 9.0) ** 2 + np.exp(p[1]), SPHERE.space, (4.0, -3.0))
    solver, best = solve(name, function)
    np.testing.assert_allclose(best.point, (4.0, -3.0), atol=1e-5)
    assert solver.success is True


def test_cobyqa_does_not_creep_in_turned_valleys():
    curvatures = np.geomspace(1.0, 1e3, 7)

    def lowest(seed):
        generator = np.random.default_rng(seed)
        axes, place = np.linalg.qr(generator.standard_normal((7, 7)))[0], generator.uniform(-1.0, 1.0, 7)
        solver = make_solver("COBYQA", box(7, -3.0, 4.0), budget=120)
        log = drive(solver, lambda p: curvatures @ (axes @ (np.array(p) - place)) ** 2)
        return -max(e.values[0] for e in log)

    # At the start it is some 1000.
    assert np.median([lowest(seed) for seed in range(8)]) < 0.7


@pytest.mark.parametrize("name", ["CMA-ES", AUTO, "TPE"])
def test_a_mixed_problem_agrees_with_brute_force(name):
    space = (Parameter("n", -7, 12, integer=True), Parameter("x", -2.0, 2.0), Parameter("k", 1, 40, integer=True))

    def cost(p):
        n, x, k = p
        return 0.3 * (n - 4.4) ** 2 + (x - 0.1 * n) ** 2 + 0.05 * (k - 3 * n) ** 2

    # For given integers, x = 0.1 n.
    brute = min(itertools.product(range(-7, 13), range(1, 41)), key=lambda p: cost((p[0], 0.1 * p[0], p[1])))
    solver = make_solver(name, space, budget=150 if name == "TPE" else 400)
    best = max(drive(solver, cost), key=lambda e: e.values[0])
    assert all(type(value) is kind for value, kind in zip(best.point, (int, float, int), strict=True))
    if name == "TPE":
        assert abs(best.point[0] - brute[0]) <= 2
    else:
        assert (best.point[0], best.point[2]) == brute
        assert best.point[1] == pytest.approx(0.1 * brute[0], abs=1e-3)


@pytest.mark.one_python
@pytest.mark.parametrize("numbers", [1, 2])
def test_cma_es_finds_the_best_words_with_the_best_numbers(numbers):
    space = (Choice("kind", ["up", "down", "left"]), Parameter("n", -7, 12, integer=True), Parameter("x", -2.0, 2.0))
    space = space[: 1 + numbers]

    def cost(p):
        # The best word has the worst start, n = 2.
        word = {"up": 3.0, "down": 0.1 * (p[1] - 9) ** 2, "left": 2.0}[p[0]]
        return word + sum((x - 0.5) ** 2 for x in p[2:])

    solver = make_solver("CMA-ES", space, population=16, seed=1)
    best = max(drive(solver, cost, limit=3000), key=lambda e: e.values[0])
    assert best.point[:2] == ("down", 9)
    np.testing.assert_allclose(best.point[2:], 0.5, atol=1e-4)
    assert solver.success is True


@pytest.mark.one_python
def test_cma_es_keeps_a_front_feasible():
    space = SPHERE.space
    solver = make_solver("CMA-ES", space, objectives=2, constraints=1, budget=600, seed=1)
    log = drive(solver, _two_costs, violations=lambda p: (p[0] - p[1] - 0.2,), fails=lambda p: p[0] < -2.5)
    assert np.mean([e.feasible for e in log[-200:]]) > np.mean([e.feasible for e in log[:200]])
    assert sum(e.feasible for e in log[-200:]) > 100


@pytest.mark.slow
@pytest.mark.one_python
def test_a_categorical_parameter_is_chosen_rightly():
    space = (Choice("kind", ["up", "down", "left"]), Parameter("x", 0.0, 1.0), Choice("flag", [True, 0, 2.5]))

    def cost(p):
        kind, x, flag = p
        return {"up": 2.0, "down": 0.0, "left": 1.0}[kind] + (x - 0.25) ** 2 + (0.0 if flag is True else 0.7)

    solver = make_solver("auto", space, budget=120)
    assert solver.method == "bayesian"
    best = max(drive(solver, cost), key=lambda e: e.values[0])
    assert best.point[0] == "down" and best.point[2] is True
    assert best.point[1] == pytest.approx(0.25, abs=0.1)


@pytest.mark.slow
def test_few_evaluations_are_enough_for_a_model():
    # The best of 40 random points is about 1 above it.
    _, best = solve("bayesian", BRANIN, budget=40, batch=1)
    assert -best.values[0] == pytest.approx(BRANIN.lowest, abs=1e-2)


@pytest.mark.slow
def test_a_model_finds_the_optimum_under_a_constraint_with_few_evaluations():
    _, best = solve("bayesian", CONSTRAINED, violations=half_plane, budget=40)
    assert -best.values[0] == pytest.approx(CONSTRAINED.lowest, abs=2e-2)


def test_a_model_expects_what_it_was_told():
    solver = make_solver("bayesian", SPHERE.space, objectives=2, budget=40, seed=0)
    log = drive(solver, lambda p: (SPHERE.cost(p), 1e3 * p[0]), fails=lambda p: p[1] > 3.0)
    points, usable = np.array([e.point for e in log]), np.array([e.usable for e in log])
    true = np.column_stack([[-SPHERE.cost(p) for p in points], -1e3 * points[:, 0]])
    assert 20 < usable.sum() < len(log)
    expected = solver.mean((points + 3.0) / 7.0)
    ranges = np.ptp(true, axis=0)
    np.testing.assert_allclose(expected[usable] / ranges, true[usable] / ranges, atol=0.005)
    # A rollout that failed counts as the worst one.
    assert (expected[~usable] < np.median(true[usable], axis=0)).all()


@pytest.mark.slow
def test_a_model_remembers_only_so_many_points():
    solver, best = solve("bayesian", SPHERE, budget=80, memory=15)
    np.testing.assert_allclose(best.point, SPHERE.best, atol=1e-2)


def test_exhausted_space_ends_with_success():
    space = (Parameter("i", 1, 3, integer=True), Choice("c", ["a", "b"]))
    solver = make_solver("bayesian", space)
    log = drive(solver, lambda p: p[0])
    assert sorted({told.point for told in log}) == sorted(itertools.product((1, 2, 3), "ab"))
    assert len(log) == 6
    assert (solver.success, solver.message) == (True, "every point of the space is known")


@pytest.mark.parametrize("seed", range(4))
def test_a_space_in_which_all_fails_is_exhausted_too(seed):
    solver = make_solver("bayesian", (Parameter("i", 1, 30, integer=True),), seed=seed)
    log = drive(solver, lambda p: p[0], fails=lambda p: True)
    assert sorted(told.point for told in log) == [(i,) for i in range(1, 31)]
    assert solver.message == "every point of the space is known"


@pytest.mark.slow
def test_one_parameter_is_enough_for_every_method_of_auto():
    function = Function(lambda p: abs(p[0] - 0.3), (Parameter("x", -1.0, 2.0),), (0.3,))
    solver, best = solve("auto", function)
    assert solver.success is True
    assert best.point[0] == pytest.approx(0.3, abs=1e-6)


def test_a_logarithmic_range_is_searched_by_decades():
    space = (Parameter("gain", 1e-4, 1e4, log=True), Parameter("x", -1.0, 1.0))
    function = Function(lambda p: (np.log10(p[0]) + 2.0) ** 2 + p[1] ** 2, space, (1e-2, 0.0))
    for name in ("CMA-ES", "SNOPT"):
        _, best = solve(name, function)
        assert best.point[0] == pytest.approx(1e-2, rel=1e-3)


# ------------------------------------------------------------------------------------- several objectives


def _two_costs(p):
    """Fonseca and Fleming with two parameters: the front is x = y in [-1/sqrt 2, 1/sqrt 2]."""
    x = np.array(p)
    shift = 1.0 / np.sqrt(2.0)
    return 1.0 - np.exp(-np.sum((x - shift) ** 2)), 1.0 - np.exp(-np.sum((x + shift) ** 2))


def _hypervolume(log):
    """The hypervolume of two costs, under the reference (1, 1), by a sweep along the first."""
    volume, ceiling = 0.0, 1.0
    for first, second in sorted((-e.values[0], -e.values[1]) for e in log):
        if second < ceiling:
            volume += (1.0 - first) * (ceiling - second)
            ceiling = second
    return volume


@pytest.mark.parametrize("name", ["NSGA-II", "CMA-ES", AUTO])
def test_a_pareto_front_is_covered_better_than_by_chance(name):
    space = SPHERE.space
    t = np.linspace(-1.0, 1.0, 2001) / np.sqrt(2.0)
    first, second = np.transpose([_two_costs((x, x)) for x in t])
    # Beyond the end of the front, its last point dominates.
    ideal = np.trapezoid(1.0 - second[::-1], first[::-1]) + (1.0 - first.max()) * (1.0 - second.min())
    volumes = {}
    for solver in (name, "random"):
        made = make_solver(solver, space, objectives=2, budget=1000 if name in ("NSGA-II", "CMA-ES") else 60, seed=1)
        volumes[solver] = _hypervolume(drive(made, _two_costs))
    # The hypervolume of the front cannot be exceeded (1e-3: of the trapezoids).
    assert 0.9 * ideal < volumes[name] < ideal + 1e-3
    assert ideal - volumes[name] < 0.6 * (ideal - volumes["random"])


@pytest.mark.slow
@pytest.mark.filterwarnings("error")
def test_a_front_much_smaller_than_the_costs_is_approached():
    # Costs of up to 1000 above a front that is 0.001 wide: expected improvements below the smallest double.
    made = make_solver("bayesian", SPHERE.space, objectives=2, budget=30, seed=0)
    log = drive(made, lambda p: (1e3 * p[1] ** 2 + 1e-3 * p[0], 1e3 * p[1] ** 2 - 1e-3 * p[0]))
    best = min(-e.values[0] for e in log)
    assert best < 1.0 < min(-e.values[0] for e in log[:5])


def _best_on_the_disk(log):
    """The distance of the best point within the unit circle from the least of Rosenbrock's function on that circle."""
    on_circle = minimize_scalar(
        lambda angle: ROSENBROCK.cost((np.cos(angle), np.sin(angle))), bounds=(0.0, 1.5), options={"xatol": 1e-12}
    )
    return min(-e.values[0] for e in log if e.violations[0] <= 0.0) - on_circle.fun


def _beyond_the_disk(p):
    return (p[0] ** 2 + p[1] ** 2 - 1.0,)


@pytest.mark.parametrize(("size", "first"), [(2, 5), (5, 8), (8, 13), (12, 16), (16, 18)])
def test_cobyqa_has_a_model_after_few_points(size, first):
    slope = np.arange(1.0, size + 1.0)
    log = drive(make_solver("COBYQA", box(size, -1.0, 1.0), budget=first + 1), lambda p: slope @ p)
    # The first step along the model of a plane: down its slope, or more by all that differs.
    *design, step = (np.array(e.point) for e in log)
    assert len(design) == first
    assert slope @ step < min(slope @ point for point in design)
    assert sum(np.count_nonzero(point) <= 2 for point in design) == first
    assert np.count_nonzero(step) == size


@pytest.mark.slow_cases
@pytest.mark.parametrize("start", [(0.2, 0.2), (-0.5, 0.5), (0.0, -0.9)])
def test_cobyqa_follows_a_curved_constraint(start):
    solver = make_solver("COBYQA", box(2, -1.5, 1.5), constraints=1, start=start, budget=120)
    assert _best_on_the_disk(drive(solver, ROSENBROCK.cost, violations=_beyond_the_disk)) < 1e-6


@pytest.mark.slow
@pytest.mark.one_python
@pytest.mark.parametrize("seed", [0, 1])
def test_auto_follows_a_curved_constraint(seed):
    solver = make_solver("auto", box(2, -1.5, 1.5), constraints=1, seed=seed, budget=300)
    assert _best_on_the_disk(drive(solver, ROSENBROCK.cost, violations=_beyond_the_disk)) < 1e-6
