"""Problem (18) inside CasADi: derivatives, symbolic constraints beside it, and what goes wrong in it."""

import contextlib

import casadi
import numpy as np
import pytest
from pydrake.systems.analysis import SimulatorConfig
from scipy.optimize import minimize_scalar

from tests.optimization.studies import DAMPING, RATE, THETA, pendulum_problem
from tests.testbeds import PendulumScenario
from vtbdrake.optimization import Choice
from vtbdrake.rollout import Quality, QualityError

FIXED = PendulumScenario(
    simulator_config=SimulatorConfig(
        integration_scheme="runge_kutta3", max_step_size=0.005, accuracy=1e-3, use_error_control=False
    )
)
QUIET = {"ipopt.print_level": 0, "print_time": False, "ipopt.hessian_approximation": "limited-memory"}


def miss(theta, rate):
    return (theta - 0.3) ** 2 + 0.1 * (rate - 1.0) ** 2


def problem(**more):
    quality = Quality(miss, [THETA, RATE], minimize=True, reading="end")
    conditions = [{DAMPING: 0.0}, {DAMPING: 0.4}]
    return pendulum_problem(**{"scenario": FIXED, "quality": quality, "conditions": conditions, "risk": "mean", **more})


def test_the_value_is_that_of_the_rollouts():
    stated = problem()
    h = stated.casadi_function()
    values = [stated.rollout([0.4, -0.2], condition=c).value for c in range(2)]
    assert float(h([0.4, -0.2])) == np.mean(values)
    assert h.rollouts == 2


@pytest.mark.parametrize("gradient", ["central", "autodiff"])
def test_the_derivative_of_an_expression_around_it(gradient):
    h = problem().casadi_function(gradient=gradient)
    x = casadi.MX.sym("x", 2)
    slope = casadi.Function("slope", [x], [casadi.gradient(casadi.sin(h(x)) + x[0], x)])
    at = np.array([0.4, -0.2])
    step = 1e-4
    expected = [
        (np.sin(float(h(at + d))) - np.sin(float(h(at - d)))) / (2 * step) + (i == 0)
        for i, d in enumerate(step * np.eye(2))
    ]
    assert slope(at).full().ravel() == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("gradient", ["central", "autodiff"])
def test_opti_solves_it_under_a_symbolic_constraint(gradient):
    stated = problem()
    with_h = stated.casadi_function(gradient=gradient)
    opti = casadi.Opti()
    x = opti.variable(2)
    opti.minimize(with_h(x))
    opti.subject_to(x[0] + x[1] == 0.5)
    opti.subject_to(opti.bounded(-1.5, x, 1.5))
    opti.solver("ipopt", QUIET)
    found = opti.solve().value(x)
    # On the line there is one unknown: a scalar minimizer is a second opinion.
    line = minimize_scalar(
        lambda a: float(with_h([a, 0.5 - a])), bounds=(-1.0, 1.5), method="bounded", options={"xatol": 1e-9}
    )
    assert found == pytest.approx([line.x, 0.5 - line.x], abs=1e-4)
    with_h.raise_error()
    with_h.close()


def test_what_is_raised_inside_comes_out_as_itself():
    def refuses(theta, rate):
        if theta > 0.2:
            raise RuntimeError("out of my range")
        return 1.0 - theta

    h = problem(quality=Quality(refuses, [THETA, RATE], minimize=True, reading="end")).casadi_function()
    x = casadi.MX.sym("x", 2)
    solver = casadi.nlpsol("solver", "ipopt", {"x": x, "f": h(x)}, QUIET)
    with contextlib.suppress(RuntimeError):
        solver(x0=[1.0, 0.0], lbx=-1.5, ubx=1.5)
    with pytest.raises(QualityError, match="out of my range"):
        h.raise_error()


@pytest.mark.parametrize("k", [0, 1])
@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_a_point_outside_its_range_is_an_error_but_not_by_rounding(k, side):
    stated = problem()
    h = stated.casadi_function()
    parameter = stated.parameters[k]
    at, width = np.array([0.4, -0.2]), parameter.upper - parameter.lower
    at[k] = parameter.upper if side > 0.0 else parameter.lower
    at_bound = float(h(at))
    at[k] += side * 1e-8 * width
    assert float(h(at)) == at_bound
    at[k] += side * 1e-3 * width
    with pytest.raises(RuntimeError):
        h(at)
    with pytest.raises(ValueError, match="outside its range"):
        h.raise_error()


@pytest.mark.parametrize(
    ("more", "options", "message"),
    [
        ({"parameters": [Choice(THETA, [0.1, 0.2])]}, {}, "is not continuous"),
        ({"quality": [Quality(miss, [THETA, RATE]), Quality(abs, THETA)]}, {}, "has several qualities"),
        ({}, {"gradient": "forward"}, "central, autodiff, not by 'forward'"),
        ({}, {"step": 0.5}, "in .0, 0.1., not 0.5"),
        ({"scenario": PendulumScenario()}, {"gradient": "autodiff"}, "controls its error"),
    ],
)
def test_what_has_no_derivative_is_refused(more, options, message):
    with pytest.raises(ValueError, match=message):
        problem(**more).casadi_function(**options)
