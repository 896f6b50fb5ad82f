"""Predictive sampling, CEM and MPPI move their distribution as their formulas say."""

import math

import numpy as np
import pytest
from scipy.stats import norm, truncnorm

from tests.optimization.solvers.driver import SPHERE, drive, evaluation, solve
from vtbdrake.optimization.parameter import Choice, Parameter
from vtbdrake.optimization.solvers import Evaluation, SolverError, make_solver
from vtbdrake.optimization.solvers.solver import Search

pytestmark = pytest.mark.one_python

NAMES = ["predictive-sampling", "CEM", "MPPI"]
# A range so wide that nothing is clipped; one unit of it is 1 / WIDTH of the cube.
WIDTH = 200.0
X = Parameter("x", -WIDTH / 2, WIDTH / 2)
MANY = 50_000


def second_batch(name, cost, *, population, sigma, space=(X,), **options):
    """The points of the second batch, after one batch about 0; its first is mu, if mu is new."""
    solver = make_solver(name, space, population=population, sigma=sigma / WIDTH, **options)
    solver.tell([evaluation(point, cost) for point in solver.ask()])
    return np.array(solver.ask())


def test_predictive_sampling_moves_to_the_best_of_n_normal_points():
    # The mean of the largest of 9 standard normal numbers (Teichroew, 1956).
    largest = [
        second_batch("predictive-sampling", lambda p: -p[0], population=10, sigma=2.0, seed=seed).mean()
        for seed in range(800)
    ]
    # Mu itself, 0, is the tenth; all nine others are below it in one of 512 cases.
    assert np.mean(largest) == pytest.approx(2.0 * 1.4850, abs=0.1)


def test_predictive_sampling_stays_at_the_best_point_so_far():
    def cost(p):  # All but the start are the better, the farther from it they are.
        distance = math.dist(p, SPHERE.best)
        return 100.0 - distance if distance > 1e-9 else 0.0

    solver = make_solver("predictive-sampling", SPHERE.space, start=SPHERE.best, population=200, seed=3)
    for _ in range(5):
        points = solver.ask()
        np.testing.assert_allclose(np.mean(points, axis=0), SPHERE.best, atol=0.2)
        solver.tell([evaluation(point, cost) for point in points])


@pytest.mark.slow_cases
@pytest.mark.parametrize("elites", [0.1, 0.3])
def test_cem_takes_mean_and_deviation_of_the_elites_of_a_slope(elites):
    # The best share of a normal distribution is a truncated one: mean sigma phi(z) / share.
    z = norm.isf(elites)
    points = second_batch("CEM", lambda p: -p[0], population=MANY, sigma=3.0, elites=elites, smoothing=1.0)
    assert points[0, 0] == pytest.approx(3.0 * norm.pdf(z) / elites, rel=0.03)
    assert points.std() == pytest.approx(3.0 * truncnorm.std(z, np.inf), rel=0.03)


def test_cem_shrinks_about_the_minimum_of_a_parabola():
    # Elites of x^2 about 0 are the points with |x| < z, symmetrical.
    z = norm.ppf(0.625)
    points = second_batch(
        "CEM", lambda p: p[0] ** 2, population=MANY, sigma=3.0, elites=0.25, sigma_min=1e-6, smoothing=1.0
    )
    assert points[0, 0] == pytest.approx(0.0, abs=0.05)
    assert points.std() == pytest.approx(3.0 * truncnorm.std(-z, z), rel=0.03)


def test_cem_with_smoothing_goes_a_part_of_the_way():
    whole = second_batch("CEM", lambda p: -p[0], population=50, sigma=3.0, smoothing=1.0)
    half = second_batch("CEM", lambda p: -p[0], population=50, sigma=3.0, smoothing=0.5)
    assert half[0, 0] == pytest.approx(0.5 * whole[0, 0])


def test_cem_never_shrinks_below_its_least_deviation():
    points = second_batch("CEM", lambda p: -p[0], population=MANY, sigma=3.0, sigma_min=2.9 / WIDTH)
    assert points.std() == pytest.approx(2.9, rel=0.03)


@pytest.mark.slow_cases
@pytest.mark.parametrize("temperature", [0.2, 1.0])
def test_mppi_weighs_a_parabola_as_the_product_of_two_normal_distributions(temperature):
    # Weights exp(-(x - a)^2 / lambda) times N(0, s^2) are normal, too, with mean a s^2 / (s^2 + lambda / 2).
    a, s = 4.0, 2.0
    deviation = np.sqrt(2.0 * s**4 + 4.0 * s**2 * a**2)  # That of (x - a)^2 for x of N(0, s^2).
    points = second_batch("MPPI", lambda p: (p[0] - a) ** 2, population=MANY, sigma=s, temperature=temperature)
    assert points[0, 0] == pytest.approx(a * s**2 / (s**2 + temperature * deviation / 2.0), rel=0.03)
    assert points.std() == pytest.approx(s, rel=0.03)


def test_mppi_gives_points_of_equal_cost_equal_weight():
    first = np.array(make_solver("MPPI", [X], population=8).ask())
    solver = make_solver("MPPI", [X], population=8)
    solver.tell([evaluation(point, lambda p: 1.0) for point in solver.ask()])
    assert solver.ask()[0] == pytest.approx(tuple(first.mean(axis=0)))


def test_mppi_gives_no_weight_to_points_that_failed_or_were_dropped():
    solver = make_solver("MPPI", [X], population=3)
    points = solver.ask()
    told = [Evaluation(points[0], (1.0,)), Evaluation(points[1], (np.nan,)), Evaluation(points[2], (9.0,), exact=False)]
    solver.tell(told)
    assert solver.ask()[0] == pytest.approx(points[0])


@pytest.mark.parametrize("name", NAMES)
def test_a_batch_that_failed_moves_nothing(name):
    solver = make_solver(name, [X], start=(7.0,))
    solver.tell([Evaluation(point, (np.nan,)) for point in solver.ask()])
    assert solver.ask()[0] == pytest.approx((7.0,))


@pytest.mark.parametrize("name", NAMES)
def test_a_batch_that_failed_in_part_moves_towards_the_rest(name):
    solver = make_solver(name, [X], start=(7.0,))
    first, *others = solver.ask()
    solver.tell([Evaluation(first, (np.nan,)), *(evaluation(point, lambda p: p[0]) for point in others)])
    assert np.mean(solver.ask()) < 7.0


@pytest.mark.parametrize("name", NAMES)
def test_solvers_descend_a_valley(name):
    costs = [-solve(name, SPHERE, budget=budget, seed=1)[1].values[0] for budget in (20, 60, 180, 400)]
    assert costs == sorted(costs, reverse=True)
    assert costs[-1] < 0.01


@pytest.mark.parametrize("name", NAMES)
def test_a_larger_budget_continues_the_same_sequence(name):
    runs = []
    for budget in (30, 50):
        solver = make_solver(name, SPHERE.space, budget=budget, seed=5)
        asked = []
        while points := solver.ask():
            asked += points
            solver.tell([evaluation(point, SPHERE.cost) for point in points])
        runs.append(asked)
    assert [len(asked) for asked in runs] == [30, 50]
    assert runs[0] == runs[1][:30]


def test_predictive_sampling_asks_for_no_point_twice():
    solver = make_solver("predictive-sampling", SPHERE.space, population=12)
    log = drive(solver, SPHERE.cost, limit=60)
    assert len({told.point for told in log}) == len(log)


def test_integers_are_sampled_as_whole_numbers():
    points = make_solver("CEM", [Parameter("n", 0, 5, integer=True)]).ask()
    assert {type(value) for (value,) in points} == {int}


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("CEM", {"space": [Choice("kind", ["a", "b"])]}, "CEM varies numbers, but kind"),
        ("CEM", {"population": 1}, "at least 2 points, not 1"),
        ("CEM", {"sigma": 0.0}, "sigma is a part of the ranges"),
        ("CEM", {"elites": 1.5}, "elites of CEM lies in"),
        ("CEM", {"smoothing": 0.0}, "smoothing of CEM lies in"),
        ("CEM", {"sigma_min": -0.1}, "sigma_min is a part"),
        ("MPPI", {"temperature": 0.0}, "temperature of MPPI is above 0"),
        ("predictive-sampling", {"objectives": 2}, "takes one objective"),
    ],
)
def test_what_they_cannot_do_is_refused(name, options, message):
    with pytest.raises(SolverError, match=message):
        make_solver(name, options.pop("space", [X]), **options)


@pytest.mark.parametrize(
    "last", [Parameter("c", 1.0, 9.0), Parameter("c", 1.0, 9.0, log=True), Parameter("c", 1, 9, integer=True)]
)
def test_points_of_a_batch_are_those_one_by_one(last):
    search = Search((Parameter("a", -0.3, 0.1), Parameter("b", 2.0, 7.7), last))
    U = np.random.default_rng(0).uniform(-0.2, 1.2, (50, 3))
    assert search.points(U) == [search.point(u) for u in U]
