"""The integrator: every scheme that a scenario can choose, on models whose solution is elementary.

An error of order p falls by 2^p when the step is halved; the measured order is the binary logarithm of that ratio.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib.metadata import version
from math import factorial

import numpy as np
import pytest
from pydrake.systems.analysis import GetIntegrationSchemes, SimulatorConfig
from scipy.special import ellipj

from tests.components.compiled_plant.plants import floating
from tests.verification.conftest import Verify
from tests.verification.worlds import G, Pendulum, Run, Slider, discrete, scheme
from vtbdrake.common.spline import Spline
from vtbdrake.components.compiled_plant import BaseReaction, MomentumModel

# What Drake 1.58 has changed.
NEW_DRAKE = tuple(int(part) for part in version("drake").split(".")[:2]) >= (1, 58)
CENIC_IS_FRESH, HAS_TAMSI = NEW_DRAKE, not NEW_DRAKE
SCHEMES = GetIntegrationSchemes()
ORDERS = {
    "bogacki_shampine3": 3,
    "cenic": 1,
    "explicit_euler": 1,
    "implicit_euler": 1,
    "radau1": 1,
    "radau3": 3,
    "runge_kutta2": 2,
    "runge_kutta3": 3,
    "runge_kutta5": 5,
    "semi_explicit_euler": 1,
    "velocity_implicit_euler": 1,
}
"""Order of each scheme, as its documentation in Drake states it."""
HALF_STEPS = ("implicit_euler", "velocity_implicit_euler")
WITHOUT_ESTIMATE = {"explicit_euler", "runge_kutta2", "semi_explicit_euler"}
EXPLICIT = {
    "bogacki_shampine3",
    "explicit_euler",
    "runge_kutta2",
    "runge_kutta3",
    "runge_kutta5",
    "semi_explicit_euler",
}


def _taylor(p: int, *further: float) -> Callable[[float], float]:
    coefficients = [1.0 / factorial(k) for k in range(p + 1)] + list(further)
    return lambda z: float(np.polynomial.polynomial.polyval(z, coefficients))


STABILITY: dict[str, Callable[[float], float]] = {
    "bogacki_shampine3": _taylor(3),
    "explicit_euler": _taylor(1),
    "runge_kutta2": _taylor(2),
    "runge_kutta3": _taylor(3),
    "runge_kutta5": _taylor(5, 1.0 / 600.0),
    "semi_explicit_euler": _taylor(1),
    "radau3": lambda z: (1.0 + z / 3.0) / (1.0 - 2.0 * z / 3.0 + z**2 / 6.0),
    **dict.fromkeys(("cenic", "radau1"), lambda z: 1.0 / (1.0 - z)),
    **dict.fromkeys(HALF_STEPS, lambda z: 1.0 / (1.0 - z / 2.0) ** 2),
}
APPROXIMATIONS = ["lagged", "sap", "similar", "tamsi"]
START = 1.2
END = 1.0


def swing(t: float) -> np.ndarray:
    """Return angle and rate of the pendulum of 1 m that is released at rest at START.

    theta = 2 asin(k cd(w t)), with k = sin(START / 2), w = sqrt(g / l) and cd = cn / dn, Jacobi's functions.
    """
    k, w = np.sin(START / 2.0), np.sqrt(G)
    sn, cn, dn, _ = ellipj(w * t, k**2)
    # d/du cd(u) = -(1 - k^2) sn(u) / dn(u)^2
    rate = -2.0 * k * w * (1.0 - k**2) * sn / dn**2 / np.sqrt(1.0 - (k * cn / dn) ** 2)
    return np.array([2.0 * np.arcsin(k * cn / dn), rate])


def _state(run: Run) -> np.ndarray:
    return np.array([run["hinge.position"], run["hinge.velocity"]], dtype=float)


def _error(scenario: Pendulum) -> float:
    return float(np.max(np.abs(_state(Run(scenario, {"hinge.position": START}).to(END)) - swing(END))))


def _fixed(name: str, step: float) -> SimulatorConfig:
    if name == "cenic" and not CENIC_IS_FRESH:
        pytest.skip("scenarios refuse CENIC without error control with this Drake")
    # Newton's method limits the accuracy within a step of the implicit schemes.
    return scheme(name, max_step_size=step, accuracy=1e-10, fixed=True)


def test_all_schemes_have_a_declared_order() -> None:
    """Schemes: a new one in Drake needs a row here."""
    assert sorted(ORDERS) == sorted(SCHEMES)


@pytest.mark.parametrize("name", SCHEMES)
def test_order_of_fixed_steps(verify: Verify, name: str) -> None:
    """Order of fixed steps: a pendulum of 1 m, released at 1.2 rad, after 1 s.

        theta = 2 asin(k cd(w t)),  k = sin(0.6),  w = sqrt(g / l)          error = C h^p (1 + O(h))

    Reference: Jacobi's elliptic functions, and the order p that Drake documents for the scheme. Tolerance: 0.04 p, the
    O(h) at the steps that are taken, from 1/512 s (p = 1) to 1/64 s (p = 5). CENIC has fixed steps
    from Drake 1.58 on.
    """
    p = ORDERS[name]
    step = {1: 1 / 512, 2: 1 / 256, 3: 1 / 128, 5: 1 / 64}[p]
    errors = [_error(Pendulum(simulator_config=_fixed(name, h))) for h in (step, step / 2)]
    verify("order", np.log2(errors[0] / errors[1]), p, tolerance=0.04 * p)


@pytest.mark.slow_cases
@pytest.mark.parametrize("name", [name for name in SCHEMES if name not in WITHOUT_ESTIMATE])
def test_error_follows_the_accuracy(verify: Verify, name: str) -> None:
    """Error control: a pendulum of 1 m, released at 1.2 rad, after 1 s, at accuracies a of 1e-5 and 1e-7.

        error = C a^e,  e = p / q,  where an estimate of order h^q bounds the error of each step

    The embedded estimates of schemes of order 3 and 5 have q = p: e = 1; the schemes of order 1 compare one step with
    two, q = 2: e = 1/2. Radau3 keeps the Jacobian of its Newton iteration for several steps; its error falls in jumps.
    Reference: these exponents; for Radau3 no error. Tolerance: 0.1, as steps change in jumps; for Radau3, 20 a.
    """
    exponent = 0.5 if ORDERS[name] == 1 else 1.0
    coarse, fine = (
        _error(Pendulum(simulator_config=scheme(name, accuracy=a, max_step_size=1.0))) for a in (1e-5, 1e-7)
    )
    if name == "radau3":
        verify("angle, rate at a = 1e-7", fine, 0.0, tolerance=20 * 1e-7, unit="rad, rad/s")
        return
    verify("exponent", np.log10(coarse / fine) / 2.0, exponent, tolerance=0.1)


@pytest.mark.parametrize("name", SCHEMES)
def test_stability_function(verify: Verify, name: str) -> None:
    """Stability function R(z): one step h of v' = -d v multiplies v by R(-d h).

        explicit, order p     sum of z^k / k! up to k = p, and for RK5, which has six stages, z^6 / 600
        Radau1, CENIC         1 / (1 - z)
        Radau3                (1 + z / 3) / (1 - 2 z / 3 + z^2 / 6)
        implicit Euler        1 / (1 - z / 2)^2, as Drake continues from the two half steps of its error estimate

    The damper is a joint of the plant. Semi-explicit Euler advances the velocity as explicit Euler does.
    Reference: Hairer and Wanner, "Solving Ordinary Differential Equations II", sections IV.3 and IV.5. Tolerance:
    rounding; for implicit Euler 5e-3, where its Newton iteration ends (0.05 times the scheme's accuracy of 0.1).
    """
    for z in (-0.7,) if name in EXPLICIT else (-0.7, -50.0):
        h = 0.1
        run = Run(Slider(damping=-z / h, simulator_config=_fixed(name, h)), {"slider.velocity": 1.0}).to(h)
        tolerance = 5e-3 if name in HALF_STEPS else 1e-9
        verify(f"R({z:g})", run["slider.velocity"], STABILITY[name](z), tolerance=tolerance)


@pytest.mark.parametrize("name", APPROXIMATIONS)
def test_discrete_plants_take_steps_of_symplectic_euler(verify: Verify, name: str) -> None:
    """Steps of discrete plants: each of a pendulum of 1 m is one of symplectic Euler, with implicit damping d.

        w_{k+1} = (w_k - h (g / l) sin theta_k) / (1 + h d / (m l^2)),   theta_{k+1} = theta_k + h w_{k+1}

    TAMSI damps explicitly: w_{k+1} = w_k - h (g / l) sin theta_k - h d / (m l^2) w_k.
    Reference: this recursion over 200 steps of 5 ms, d = 0.3 N m s. Tolerance: rounding.
    """
    h, damping = 5e-3, 0.3
    run = Run(_discrete_pendulum(name, h, damping), {"hinge.position": START, "hinge.velocity": 0.7}).to(200 * h)
    angle, rate = START, 0.7
    for _ in range(200):
        if name == "tamsi":
            rate -= h * (G * np.sin(angle) + damping * rate)
        else:
            rate = (rate - h * G * np.sin(angle)) / (1.0 + h * damping)
        angle += h * rate
    verify("angle, rate", _state(run), [angle, rate], tolerance=1e-11, unit="rad, rad/s")


@pytest.mark.parametrize("name", APPROXIMATIONS)
def test_order_of_discrete_plants(verify: Verify, name: str) -> None:
    """Order of discrete plants: a pendulum of 1 m at steps of 1/512 s and 1/1024 s.

        error = C h (1 + O(h))

    Reference: Jacobi's elliptic functions, and the order 1. Tolerance: 0.01, the O(h).
    """
    errors = [_error(_discrete_pendulum(name, h)) for h in (1 / 512, 1 / 1024)]
    verify("order", np.log2(errors[0] / errors[1]), 1.0, tolerance=0.01)


def _discrete_pendulum(approximation: str, step: float, damping: float = 0.0) -> Pendulum:
    scenario = Pendulum(plant_config=discrete(step, approximation), damping=damping)
    if approximation == "tamsi" and not HAS_TAMSI:
        pytest.skip("this Drake has no TAMSI")
    return scenario


def test_order_of_the_momentum_model(verify: Verify) -> None:
    """Order of the momentum model: a free-floating base whose arm follows a spline, in 20 and 40 steps of RK4.

        V_base = -M_bb(q)^-1 M_bm(q) q',   error = C h^4 (1 + O(h))

    Reference: the order 4; the attitude by 320 steps. Tolerance: 0.3, the O(h).
    """
    plant = floating(0.0, gravity=False)
    joints = [plant.GetJointByName(name) for name in ("hinge", "slider")]
    model = MomentumModel(plant, plant.CreateDefaultContext(), joints=joints)
    spline = Spline("bspline", 8, 3.0)
    knots = np.random.default_rng(0).uniform([-1.5, -0.4], [1.5, 0.4], (spline.knots, 2))
    ends = [BaseReaction(model, spline, steps=n, compile=False)(knots).rotation[-1] for n in (20, 40, 320)]
    coarse, fine = (np.max(np.abs(end - ends[-1])) for end in ends[:2])
    verify("order", np.log2(coarse / fine), 4.0, tolerance=0.3)
