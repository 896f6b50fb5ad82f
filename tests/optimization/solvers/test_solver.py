"""Tests of every solver of the catalogue: repetition, replay, budgets, failed simulations, an end without remains."""

import importlib.util
import itertools
import subprocess
import sys
import threading
from dataclasses import replace

import numpy as np
import pytest

from tests.optimization.solvers.driver import CONSTRAINED, ROSENBROCK, SPHERE, drive, evaluation, half_plane, solve
from vtbdrake.optimization.parameter import Choice, Parameter
from vtbdrake.optimization.solvers import Evaluation, Solver, SolverError, known_solvers, make_solver
from vtbdrake.optimization.solvers.blocking import BlockingSolver
from vtbdrake.optimization.solvers.solver import Search, ask_within

INSTALLED = [name for name in known_solvers() if name != "GP" or importlib.util.find_spec("torch")]
# What "bayesian" does is the first that "auto" does.
ALL = [pytest.param(name, marks=[pytest.mark.slow] if name == "bayesian" else []) for name in INSTALLED]
AUTO = pytest.param("auto", marks=pytest.mark.slow)
BLOCKING = [name for name in INSTALLED if isinstance(make_solver(name, SPHERE.space), BlockingSolver)]
SEEDED = [
    "sobol",
    "latin-hypercube",
    "random",
    "bayesian",
    "CMA-ES",
    "differential-evolution",
    "TPE",
    "NSGA-II",
    "QMC",
    "auto",
]


pytestmark = pytest.mark.usefixtures("short_model")


@pytest.fixture(autouse=True)
def no_thread_is_left():
    before = set(threading.enumerate())
    yield
    assert set(threading.enumerate()) <= before


@pytest.mark.slow_cases
@pytest.mark.parametrize("name", ALL)
def test_it_asks_for_points_of_the_space_within_its_budget(name):
    solver = make_solver(name, ROSENBROCK.space, budget=90)
    log = drive(solver, ROSENBROCK.cost)
    assert 1 <= len(log) <= 90
    for told in log:
        assert [parameter.as_value(value) for parameter, value in zip(ROSENBROCK.space, told.point, strict=True)] == [
            *told.point
        ]
    assert solver.success is not None and solver.message
    assert solver.ask() == []


# Spaces at the edge of what is allowed, with (objectives, constraints).
EDGES = {
    "one number": ([Parameter("x", -1.0, 2.0)], 1, 0),
    "one number, constrained": ([Parameter("x", -1.0, 2.0)], 1, 1),
    "two integers of few values": ([Parameter("i", 1, 2, integer=True), Parameter("j", 1, 3, integer=True)], 1, 0),
    "an integer on a logarithmic scale": ([Parameter("i", 1, 1000, integer=True, log=True)], 1, 0),
    "one choice": ([Choice("c", [1.0, 0.5])], 1, 0),
    "all kinds": ([Choice("c", [1.0, 0.5]), Parameter("i", 1, 3, integer=True), Parameter("x", -1.0, 2.0)], 1, 0),
    "a range without room": ([Parameter("x", 1.0, np.nextafter(1.0, 2.0)), Parameter("y", 0.0, 1.0)], 1, 0),
    "one range without room": ([Parameter("x", 1.0, np.nextafter(1.0, 2.0))], 1, 0),
    "two objectives": ([Parameter("x", -1.0, 2.0)], 2, 0),
    "two objectives of integers, constrained": ([Parameter("i", 1, 9, integer=True)], 2, 1),
}


@pytest.mark.slow_cases
@pytest.mark.parametrize("edge", EDGES)
@pytest.mark.parametrize("name", INSTALLED)
def test_edge_cases_work_or_are_refused(name, edge):
    space, objectives, constraints = EDGES[edge]
    for budget in (1, 9):
        try:
            solver = make_solver(name, space, objectives=objectives, constraints=constraints, budget=budget)
        except SolverError as refusal:
            assert name in str(refusal) and len(str(refusal)) > 30
            continue
        log = drive(
            solver,
            lambda p: tuple(sum((float(x) - at) ** 2 for x in p) for at in (0.3, 1.2)[:objectives]),
            violations=(lambda p: (0.5 - float(p[0]),)) if constraints else None,
        )
        assert 1 <= len(log) <= budget
        for told in log:
            assert tuple(parameter.as_value(value) for parameter, value in zip(space, told.point, strict=True)) == (
                told.point
            )
        assert solver.success is not None and solver.message


@pytest.mark.slow_cases
@pytest.mark.parametrize("name", ALL)
def test_the_same_seed_asks_for_the_same_points(name):
    count = 20 if name == "bayesian" else 80
    first, second = (drive(make_solver(name, ROSENBROCK.space, seed=5), ROSENBROCK.cost, limit=count) for _ in range(2))
    assert first == second


# The local search that "auto" begins with needs no seed.
@pytest.mark.parametrize("name", [name for name in SEEDED if name != "auto"])
def test_another_seed_asks_for_other_points(name):
    first, second = (drive(make_solver(name, ROSENBROCK.space, seed=seed), ROSENBROCK.cost, limit=1) for seed in (1, 2))
    assert not {told.point for told in first} & {told.point for told in second}


@pytest.mark.slow_cases
@pytest.mark.parametrize("name", ALL)
def test_told_again_it_goes_on_where_another_stopped(name):
    count = 25 if name == "bayesian" else 100
    whole = drive(make_solver(name, ROSENBROCK.space, seed=9), ROSENBROCK.cost, limit=count)
    again = make_solver(name, ROSENBROCK.space, seed=9)
    known = {told.point: told for told in whole[: 3 * count // 5]}
    log = []
    while (points := again.ask()) and len(log) + len(points) <= len(whole):
        told = [known[p] if p in known else evaluation(p, ROSENBROCK.cost) for p in points]
        log += told
        again.tell(told)
    again.close()
    assert len(log) > 0.6 * len(whole)
    assert log == whole[: len(log)]


@pytest.mark.slow_cases
@pytest.mark.parametrize("name", ALL)
def test_failed_simulations_are_survived(name):
    count = 40 if name == "bayesian" else 120
    solver = make_solver(name, SPHERE.space, seed=2, budget=count)
    log = drive(solver, SPHERE.cost, fails=lambda p: p[0] < 0.1 or p[1] > 1.2)
    assert any(told.failed for told in log) or len(log) < count
    assert max(told.values[0] for told in log if not told.failed) > -6.0


@pytest.mark.parametrize("name", [AUTO, "CMA-ES", "differential-evolution", "LN_NELDERMEAD", "SNOPT", "GN_DIRECT_L"])
def test_it_finds_the_optimum_beside_a_region_where_simulations_fail(name):
    solver = make_solver(name, SPHERE.space, budget=1200)
    log = drive(solver, SPHERE.cost, fails=lambda p: p[1] > 1.2 or p[0] < -1.0)
    best = max((told for told in log if not told.failed), key=lambda told: told.values[0])
    np.testing.assert_allclose(best.point, SPHERE.best, atol=1e-2)


@pytest.mark.parametrize("name", ["SNOPT", "IPOPT", "LD_SLSQP", "LN_BOBYQA", "LN_COBYLA", "CMA-ES"])
def test_where_every_simulation_fails_nothing_reports_success(name):
    solver = make_solver(name, SPHERE.space, budget=2000)
    log = drive(solver, SPHERE.cost, fails=lambda p: True)
    assert all(told.failed for told in log)
    assert solver.success is False


def test_a_failed_start_is_named():
    solver = make_solver("SNOPT", SPHERE.space, start=(-2.0, 1.0))
    drive(solver, SPHERE.cost, fails=lambda p: p[0] < 0.0)
    assert solver.success is False
    assert "failed at the start (-2.0, 1.0)" in solver.message


@pytest.mark.parametrize("name", INSTALLED)
def test_points_given_by_hand_change_nothing_that_was_asked(name):
    solver = make_solver(name, SPHERE.space, budget=200)
    by_hand = evaluation((1.0, -0.5), SPHERE.cost)
    solver.tell([by_hand])
    for _ in range(3):
        points = solver.ask()
        solver.tell([*(evaluation(p, SPHERE.cost) for p in points), by_hand, Evaluation((0.0, 0.0), (np.nan,))])
    solver.close()


@pytest.mark.parametrize("name", ["TPE", pytest.param("bayesian", marks=pytest.mark.slow), "auto"])
def test_it_learns_from_points_given_by_hand(name):
    space = SPHERE.space
    spread = [told.point for told in drive(make_solver("sobol", space, points=60), SPHERE.cost)]
    near = [(1.0 + 0.02 * i, -0.5 - 0.02 * i) for i in range(-5, 6)]
    # After the first points, the local search of "auto" is near in any case.
    limit = 5 if name == "auto" else 20

    def typical_cost(given):
        solver = make_solver(name, space, seed=4)
        solver.tell([evaluation(point, SPHERE.cost) for point in given])
        return np.median([SPHERE.cost(told.point) for told in drive(solver, SPHERE.cost, limit=limit)])

    assert typical_cost([*spread, *near]) < 0.3 * typical_cost([])


@pytest.mark.parametrize("name", SEEDED)
def test_it_refuses_to_be_told_of_other_points(name):
    solver = make_solver(name, SPHERE.space, budget=200)
    points = solver.ask()
    with pytest.raises(SolverError, match="not told yet"):
        solver.ask()
    with pytest.raises(SolverError, match="to be told of those first"):
        solver.tell([evaluation((0.123, 0.456), SPHERE.cost)] * len(points))
    with pytest.raises(SolverError, match="1 values and 0 violations, not 2 and 0"):
        solver.tell([Evaluation(p, (0.0, 0.0)) for p in points])
    solver.close()


@pytest.mark.parametrize("name", BLOCKING)
@pytest.mark.parametrize("batches", [0, 3])
def test_closed_in_mid_run_it_leaves_no_thread(name, batches):
    solver = make_solver(name, ROSENBROCK.space)
    for _ in range(batches):
        solver.tell([evaluation(p, ROSENBROCK.cost) for p in solver.ask()])
    solver.ask()
    solver.close()
    # Once more does no harm.
    solver.close()
    assert not any("solver" in thread.name for thread in threading.enumerate())


def test_a_program_that_forgets_to_close_ends_nevertheless():
    program = (
        "from vtbdrake.optimization.parameter import Parameter\n"
        "from vtbdrake.optimization.solvers import make_solver\n"
        "solvers = [make_solver(n, [Parameter('x', 0, 1)]) for n in ('SNOPT', 'IPOPT', 'LN_COBYLA')]\n"
        "print([len(solver.ask()) for solver in solvers])\n"
    )
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=False)
    assert (ended.returncode, ended.stdout.strip()) == (0, "[3, 3, 1]"), ended.stderr


@pytest.mark.parametrize("name", ["SNOPT", "IPOPT", "LD_SLSQP"])
def test_several_of_a_kind_run_side_by_side(name):
    alone = drive(make_solver(name, ROSENBROCK.space), ROSENBROCK.cost)
    solvers = [make_solver(name, ROSENBROCK.space) for _ in range(3)]
    logs = [[] for _ in solvers]
    waiting = set(range(3))
    while waiting:
        for i in sorted(waiting):
            points = solvers[i].ask()
            told = [evaluation(p, ROSENBROCK.cost) for p in points]
            logs[i] += told
            if points:
                solvers[i].tell(told)
            else:
                waiting.discard(i)
    assert logs == [alone] * 3


@pytest.mark.parametrize("name", ["SNOPT", "IPOPT", "LD_SLSQP"])
def test_an_exception_in_the_solvers_thread_reaches_ask_as_itself(name):
    solver = make_solver(name, SPHERE.space, gradient="autodiff")
    assert solver.wants_gradient
    # No gradient is told, which only the solver's callback finds out.
    solver.tell([evaluation(p, SPHERE.cost) for p in solver.ask()])
    with pytest.raises(SolverError, match="needs the gradient of each evaluation"):
        solver.ask()
    assert solver.success is False


class Stuck(BlockingSolver):
    """A method that asks once, and never returns, whatever it is told."""

    grace = 0.05

    def _solve(self):
        self._at(np.array([0.5, 0.5]))
        STUCK.wait()
        return True, "released"


STUCK = threading.Event()


@pytest.fixture
def stuck():
    """A method that has begun to be stuck, and is released after the test."""
    solver = Stuck(Search(SPHERE.space), name="stuck")
    solver.tell([evaluation(p, SPHERE.cost) for p in solver.ask()])
    yield solver
    STUCK.set()
    for thread in threading.enumerate():
        if thread.name == "solver stuck":
            thread.join()
    STUCK.clear()


def test_a_method_that_never_returns_is_left_behind_with_a_warning(stuck, caplog):
    stuck.close()
    assert "stuck does not return: its thread is left behind" in caplog.text


def test_a_method_that_computes_when_its_time_is_over_is_not_waited_for_as_long(stuck, caplog):
    stuck.grace, stuck.late_grace = 1e4, 0.01
    release = threading.Timer(30.0, STUCK.set)
    release.start()
    assert ask_within(stuck, 0.01) is None
    stuck.close()
    assert not STUCK.is_set() and "stuck does not return: its thread is left behind" in caplog.text
    release.cancel()
    release.join()


def test_close_releases_a_waiting_caller(stuck):
    asked = []
    waiting = threading.Thread(target=lambda: asked.append(stuck.ask()))
    waiting.start()
    stuck.close()
    waiting.join()
    assert asked == [[]]
    assert (stuck.success, stuck.message) == (False, "it was closed")


@pytest.mark.slow
def test_a_program_ends_although_a_method_never_returns():
    program = (
        "import threading\n"
        "import numpy as np\n"
        "from vtbdrake.optimization.solvers import Evaluation\n"
        "from vtbdrake.optimization.parameter import Parameter\n"
        "from vtbdrake.optimization.solvers.blocking import BlockingSolver\n"
        "from vtbdrake.optimization.solvers.solver import Search\n"
        "class Stuck(BlockingSolver):\n"
        "    grace = 0.05\n"
        "    def _solve(self):\n"
        "        self._at(np.array([0.5]))\n"
        "        threading.Event().wait()\n"
        "solver = Stuck(Search((Parameter('x', 0, 1),)), name='stuck')\n"
        "solver.tell([Evaluation(p, (0.0,)) for p in solver.ask()])\n"
        "solver.close()\n"
    )
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=120, check=False)
    assert (ended.returncode, ended.stderr.strip()) == (0, "stuck does not return: its thread is left behind")


def test_a_method_that_goes_round_in_circles_is_ended():
    class Circling(BlockingSolver):
        def _solve(self):
            while True:
                self._at(np.array([0.5, 0.5]))

    solver = Circling(Search(SPHERE.space), name="circling")
    log = drive(solver, SPHERE.cost)
    assert len(log) == 1
    assert (solver.success, solver.message) == (False, "it asked 10000 times in a row for known points only")


def test_an_exception_of_any_kind_reaches_ask_as_itself():
    class Broken(BlockingSolver):
        def _solve(self):
            self._at(np.array([0.5, 0.5]))
            raise ZeroDivisionError("in the method")

    solver = Broken(Search(SPHERE.space), name="broken")
    solver.tell([evaluation(p, SPHERE.cost) for p in solver.ask()])
    with pytest.raises(ZeroDivisionError, match="in the method"):
        solver.ask()


@pytest.mark.parametrize("name", ["SNOPT", "IPOPT", "LD_SLSQP"])
def test_told_gradients_are_in_units_of_the_parameters(name):
    space = (Parameter("gain", 1e-2, 1e3, log=True), Parameter("x", -3.0, 4.0))
    solver = make_solver(name, space, gradient="autodiff")
    asked = 0
    while points := solver.ask():
        (point,) = points
        gain, x = point
        asked += 1
        value = -((np.log(gain) - 1.0) ** 2) - (x - 0.5) ** 2
        gradient = (-2.0 * (np.log(gain) - 1.0) / gain, -2.0 * (x - 0.5))
        solver.tell([Evaluation(point, (value,), gradient=gradient)])
    assert solver.success is True
    np.testing.assert_allclose(point, (np.e, 0.5), rtol=1e-4)
    assert asked < 40


@pytest.mark.parametrize(("gradient", "neighbours"), [("central", 4), ("forward", 2)])
def test_a_point_and_its_neighbours_are_one_batch_within_the_range(gradient, neighbours):
    for start in itertools.product((-3.0, 0.5, 4.0), (-3.0, 4.0)):
        solver = make_solver("SNOPT", SPHERE.space, start=start, gradient=gradient)
        points = solver.ask()
        assert len(set(points)) == 1 + neighbours
        assert points[0] == start
        assert np.min(points) >= -3.0 and np.max(points) <= 4.0
        solver.close()


def test_a_budget_that_ends_a_local_solver_is_no_success():
    for name in ("SNOPT", "IPOPT", "LN_BOBYQA", "GN_DIRECT_L", "CMA-ES"):
        solver, best = solve(name, ROSENBROCK, budget=37)
        assert solver.success is False
        assert solver.message == "the budget of 37 evaluations is spent"


def test_infeasible_points_rank_by_their_violation():
    # Only 1 in 500 of the box is feasible: found by following the violations, without any value to help.
    solver = make_solver("CMA-ES", SPHERE.space, constraints=1, seed=1)
    log = drive(solver, lambda p: 0.0, violations=lambda p: ((p[0] - 3.5) ** 2 + (p[1] + 2.5) ** 2 - 0.03,))
    assert any(told.feasible for told in log)


def test_a_solver_is_abstract():
    with pytest.raises(TypeError, match="abstract"):
        Solver()


def test_the_slope_of_a_range_agrees_with_differences():
    search = Search((Parameter("gain", 1e-2, 1e3, log=True), Parameter("x", -3.0, 4.0)))
    u, step = np.array([0.3, 0.8]), 1e-6
    differences = (np.array(search.point(u + step)) - np.array(search.point(u - step))) / (2.0 * step)
    np.testing.assert_allclose(search.slope(search.point(u)), differences, rtol=1e-6)


@pytest.mark.parametrize("name", ["SNOPT", "IPOPT", "LD_SLSQP", "LN_COBYLA"])
def test_the_point_to_which_it_converges_keeps_the_constraint(name):
    solver = make_solver(name, CONSTRAINED.space, constraints=1, start=(-1.0, -1.0))
    log = drive(solver, CONSTRAINED.cost, violations=half_plane)
    nearest = min(log, key=lambda told: np.hypot(*(np.array(told.point) - CONSTRAINED.best + 1e-6)))
    assert solver.success is True
    assert nearest.feasible


@pytest.mark.parametrize("name", ["CMA-ES", "differential-evolution", "NSGA-II", "TPE", "sobol", "random", "LN_COBYLA"])
def test_what_evaluations_did_not_take_is_asked_for(name):
    budget, effort, taken, count = 40, 0.25, 0.0, 0
    solver = make_solver(name, ROSENBROCK.space, budget=budget, seed=1)
    while points := solver.ask():
        assert taken + len(points) <= budget + 1e-9
        told = [replace(evaluation(p, ROSENBROCK.cost), effort=effort) for p in points]
        solver.tell(told)
        taken, count = taken + effort * len(points), count + len(points)
    assert solver.message.endswith("is spent") or solver.success
    assert count > 2 * budget or name == "LN_COBYLA"
    assert taken > budget - 1.0 or name == "LN_COBYLA"


def test_a_batch_in_parts_is_learned_as_a_whole():
    whole = make_solver("CMA-ES", ROSENBROCK.space, seed=1)
    parts = make_solver("CMA-ES", ROSENBROCK.space, budget=8, seed=1)
    first, log, sizes = drive(whole, ROSENBROCK.cost, limit=18), [], []
    while points := parts.ask():
        sizes.append(len(points))
        log += [evaluation(p, ROSENBROCK.cost) for p in points]
        # 18 points take less than the budget; but it is charged in full for a generation of six until that is told.
        parts.tell([replace(told, effort=0.4) for told in log[-len(points) :]])
    assert [told.point for told in log[:18]] == [told.point for told in first]
    assert sizes[0] == 6 > min(sizes)


def test_points_given_by_hand_take_from_the_budget():
    solver = make_solver("sobol", SPHERE.space, budget=20)
    solver.tell([evaluation((float(i), 0.0), SPHERE.cost) for i in range(3)])
    assert len(drive(solver, SPHERE.cost)) == 17
