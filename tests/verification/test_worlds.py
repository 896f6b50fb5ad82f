"""Both together: motions of whole testbeds, with contact, drives, sensors and control, against closed forms.

Where nothing else is said, a continuous plant takes fixed steps of RK5 whose error is of rounding. Discrete plants, and
CENIC, are of the first order in their step h: with the acceleration a, symplectic Euler is a t h / 2 off after the time
t. CENIC continues from the two halves of a step: its h is half of the largest step.

Sliding is verified with the lagged approximation, Drake's default, and with CENIC. SAP and `similar` replace the law of
friction by a convex one, in which a sliding body lifts off a little, and a stiff one tumbles: they have a case of their
own, and are verified where bodies roll, stick and bounce.
"""

from __future__ import annotations

from math import atan2, exp, log, pi, sqrt

import numpy as np
import pytest
from pydrake.multibody.plant import MultibodyPlantConfig
from pydrake.systems.analysis import SimulatorConfig
from scipy.integrate import solve_ivp
from scipy.optimize import brentq
from scipy.special import ellipk

from tests.verification.conftest import Verify
from tests.verification.worlds import (
    RIGID,
    Ball,
    Block,
    Bounce,
    Carts,
    ConicalPendulum,
    DoublePendulum,
    FourBar,
    FreeBody,
    G,
    GearedWheel,
    Impedance,
    Oscillator,
    Pendulum,
    RollingTest,
    Run,
    Servo,
    body_rates,
    continuous,
    discrete,
    precise,
    scheme,
)

# -- without contact


def test_iftomm_pendulum(verify: Verify) -> None:
    """IFToMM pendulum: benchmark A01, 1 kg on 1 m, released horizontally, for four periods (9.5 s).

        theta'' = -(g / l) sin theta,   T = 4 sqrt(l / g) K(k = sin(theta_0 / 2)) = 2.3678419 s

    Reference: the complete elliptic integral K; no change of energy. Tolerance: rounding.
    """
    period = 4.0 / sqrt(G) * ellipk(0.5)
    assert period == pytest.approx(2.3678419, abs=5e-8)
    run = Run(Pendulum(), {"hinge.position": pi / 2}).to(4 * period)
    # At the turning point the rate crosses zero.
    turn = 4 * period - float(run["hinge.velocity"]) / run.derivative("hinge")
    verify("period", turn / 4, period, tolerance=1e-10, unit="s")
    run.to(4.6 * period)
    energy = float(run["hinge.velocity"]) ** 2 / 2 - G * np.cos(run["hinge.position"])
    verify("energy", energy, 0.0, tolerance=1e-10, unit="J")


def test_double_pendulum_to_eight_digits(verify: Verify) -> None:
    """Double pendulum: 1 kg and 1 m each, released horizontally, absolute angles after 2 s and 3 s.

        2 a'' + b'' cos(a - b) + b'^2 sin(a - b) + 2 g sin a = 0
        b'' + a'' cos(a - b) - a'^2 sin(a - b) + g sin b = 0

    Reference: these equations, integrated by SciPy's DOP853 at 1e-13. Tolerance: eight digits.
    """

    def derivatives(t: float, y: np.ndarray) -> list[float]:
        a, b, da, db = y
        c, s = np.cos(a - b), np.sin(a - b)
        forces = [-(db**2) * s - 2 * G * np.sin(a), da**2 * s - G * np.sin(b)]
        return [da, db, *np.linalg.solve([[2.0, c], [c, 1.0]], forces)]

    times = [2.0, 3.0]
    start = [pi / 2, pi / 2, 0.0, 0.0]
    expected = solve_ivp(derivatives, (0.0, 3.0), start, "DOP853", times, rtol=1e-13, atol=1e-13).y.T
    published = [
        [-0.48297153, -1.32404871, 3.06528819, 2.94927155],
        [1.78579552, 1.11810746, 0.32798062, -0.50445510],
    ]
    np.testing.assert_allclose(expected, published, atol=6e-9)
    run = Run(DoublePendulum(), {"shoulder.position": pi / 2})
    for t, reference in zip(times, expected, strict=True):
        run.to(t)
        upper, rate = run["shoulder.position"], run["shoulder.velocity"]
        absolute = [upper, upper + run["elbow.position"], rate, rate + run["elbow.velocity"]]
        verify(f"angles, rates at {t:g} s", absolute, reference, tolerance=1e-8, unit="rad, rad/s")


def test_dzhanibekov_effect(verify: Verify) -> None:
    """Dzhanibekov's wing nut: I = (1, 2, 3) kg m^2 turns about its middle axis with 5 rad/s, and flips over and over.

        flips at (2 k + 1) K(m) / s,  k = 0, 1, ...:  2.633028 s, and every 5.266055 s
        s^2 = (I_2 - I_1) (2 E I_3 - L^2) / (I_1 I_2 I_3)
        m = (I_3 - I_2) (L^2 - 2 E I_1) / ((I_2 - I_1) (2 E I_3 - L^2))

    It starts at w = (0.01, 5, 0) rad/s; L is its angular momentum, E its energy, a flip a zero of w_2.
    Reference: Landau and Lifshitz, "Mechanics", section 37. Tolerance: each turn multiplies an error by
    exp(5.27 s) = 4e6; 1e-6 s asks for an error of rounding in the first one.
    """
    moments, w = np.array([1.0, 2.0, 3.0]), np.array([0.01, 5.0, 0.0])
    energy, momentum = moments @ w**2, moments**2 @ w**2  # 2 E and L^2.
    s2 = (energy * 3.0 - momentum) / 6.0
    quarter = ellipk((momentum - energy) / (energy * 3.0 - momentum)) / sqrt(s2)
    assert quarter == pytest.approx(2.63303, abs=5e-6)
    run = Run(FreeBody(), {"body.velocity": [*w, 0.0, 0.0, 0.0]})
    for k in range(3):
        t = (2 * k + 1) * quarter
        rates = body_rates(run.to(t))
        # By Euler's equation, I_2 w_2' = (I_3 - I_1) w_3 w_1.
        verify(f"flip {k + 1}", t - rates[1] / (rates[2] * rates[0]), t, tolerance=1e-6, unit="s")


@pytest.mark.slow
def test_nasas_tumbling_brick(verify: Verify) -> None:
    """NASA's tumbling brick: a body with three moments of inertia, without drag, from (10, 20, 30) deg/s.

        I_1 w_1' = (I_2 - I_3) w_2 w_3, and so on in turn,   I = (1.894220, 6.211019, 7.194665) 10^-3 slug ft^2

    Reference: case 2 of the check cases of the NASA Engineering and Safety Center, NASA/TM-2015-218675; the
    simulations there spread by 8e-4 deg/s at 30 s. Tolerance: the published digits, 1e-5 deg/s.
    """
    moments = [value * 1.3558179483e-3 for value in (1.894220, 6.211019, 7.194665)]
    start = np.radians([10.0, 20.0, 30.0])
    run = Run(FreeBody(moments=moments), {"body.velocity": [*start, 0.0, 0.0, 0.0]}).to(30.0)
    expected = [12.61839, -17.39747, 31.11959]
    verify("body rates at 30 s", np.degrees(body_rates(run)), expected, tolerance=1e-5, unit="deg/s")


def test_conical_pendulum(verify: Verify) -> None:
    """Conical pendulum: 1 m, it circles at 45 deg, for five turns.

        w = sqrt(g / (l cos theta)) = 3.7247060 rad/s

    The joint is a universal one. Reference: the position of the mass, where it began. Tolerance: rounding.
    """
    rate = sqrt(G / np.cos(pi / 4))
    assert rate == pytest.approx(3.7247060, abs=5e-8)
    run = Run(ConicalPendulum(), {"hinge.position": [0.0, pi / 4], "hinge.velocity": [rate, 0.0]})
    tip = run.to(5 * 2 * pi / rate).pose("rod").multiply([0.0, 0.0, -1.0])
    verify("position", tip, [-sqrt(0.5), 0.0, -sqrt(0.5)], tolerance=1e-10, unit="m")


@pytest.mark.slow_cases
@pytest.mark.parametrize("approximation", ["sap", "lagged"])
def test_four_bar_linkage(verify: Verify, approximation: str) -> None:
    """Four-bar linkage: crank 0.4 m, coupler 1 m, rocker 0.8 m on a base of 1 m, closed by a constraint.

        closure   the end of the coupler is the end of the rocker: the law of cosines
        motion    J(t) t'' + J'(t) t'^2 / 2 + U'(t) = 0
                  J: the inertia that the crank feels at its angle t,  U: the energy of the weight

    Links are thin rods of 1 kg/m. It starts at t = 1 rad with 3 rad/s; the state after 1 s is extrapolated from the
    steps h = 0.5 ms and h / 2.
    Reference: the equation of the one angle, integrated by SciPy's DOP853; its coefficients by differences of closure.
    Tolerance: 2 % of the difference of both states, as an error of the first order, extrapolated, is w h of it, and w
    reaches 40 rad/s while the rocker turns back; for the constraint, w^2 h^2 / 2 at the crank's rate w of 10 rad/s.
    """
    h = 5e-4
    states = []
    for step in (h, h / 2):
        scenario = FourBar(plant_config=discrete(step, approximation))
        coupler, rocker = scenario.closed(1.0)
        slope = (np.array(scenario.closed(1.0 + 1e-6)) - scenario.closed(1.0 - 1e-6)) / 2e-6
        start = {
            "left": (1.0, 3.0),
            "middle": (coupler - 1.0, 3.0 * (slope[0] - 1.0)),
            "right": (rocker, 3.0 * slope[1]),
        }
        run = Run(
            scenario,
            {f"{name}.{part}": x[k] for name, x in start.items() for k, part in enumerate(("position", "velocity"))},
        ).to(1.0)
        angle = float(run["left.position"])
        states.append(np.array([angle, float(run["left.velocity"])]))
        closed = [angle + float(run["middle.position"]), float(run["right.position"])]
        verify("closure", closed, scenario.closed(angle), tolerance=(10.0 * step) ** 2 / 2, unit="rad")
    tolerance = 0.02 * np.max(np.abs(states[1] - states[0]))
    verify("crank", 2 * states[1] - states[0], _four_bar_motion(scenario), tolerance=tolerance, unit="rad, rad/s")


def _four_bar_motion(linkage: FourBar) -> np.ndarray:
    """Return angle and rate of the crank after 1 s, by the equation of its angle alone."""
    crank, coupler, rocker = linkage.crank, linkage.coupler, linkage.rocker
    masses = np.array([crank, crank, coupler, coupler, rocker, rocker, crank**3 / 12, coupler**3 / 12, rocker**3 / 12])

    def coordinates(t: float) -> np.ndarray:
        c, r = linkage.closed(t)
        joint = crank * np.array([np.cos(t), np.sin(t)])
        middle = joint + coupler / 2 * np.array([np.cos(c), np.sin(c)])
        right = np.array([linkage.ground + rocker / 2 * np.cos(r), rocker / 2 * np.sin(r)])
        return np.array([*(joint / 2), *middle, *right, t, c, r])

    def derivatives(time: float, y: np.ndarray) -> list[float]:
        t, rate = y
        e = 1e-3
        x = [coordinates(t + k * e) for k in (-2, -1, 0, 1, 2)]
        first = (x[0] - 8 * x[1] + 8 * x[3] - x[4]) / (12 * e)
        second = (-x[0] + 16 * x[1] - 30 * x[2] + 16 * x[3] - x[4]) / (12 * e**2)
        weight = G * masses[1:6:2] @ first[1:6:2]
        return [rate, -(masses @ (first * second) * rate**2 + weight) / (masses @ first**2)]

    return solve_ivp(derivatives, (0.0, 1.0), [1.0, 3.0], "DOP853", rtol=1e-10, atol=1e-10).y[:, -1]


# -- drives and control


def test_oscillator_with_coulomb_friction(verify: Verify) -> None:
    """Oscillator with Coulomb friction: its drive takes 4 F / k = 0.08 m of each cycle.

        m x'' + k x = -F sign x',   m = 1 kg, k = 100 N/m, F = 2 N

    The drive's friction is F tanh(x' / (1 mm/s)), implicit in each step.
    Reference: 0.5 m less 0.08 m per cycle, at the turning points. Tolerance: the second order in the step of 0.2 ms,
    k x h^2 / m = 2e-6 m, for three cycles.
    """
    run = Run(Oscillator(), {"slider.position": 0.5})
    for cycle in (1, 2, 3):
        run.to(cycle * 2 * pi / 10.0)
        verify("turning point", run["slider.position"], 0.5 - 0.08 * cycle, tolerance=6e-6, unit="m")


def test_geared_wheel_spins_down(verify: Verify) -> None:
    """Geared wheel: behind a gear N = 100, under Coulomb friction F = 0.9 N m in its drive, it slows down linearly.

        (m r^2 / 2 + N^2 I_rotor) w' = -F

    Reference: w = 2 rad/s - F t / I. Tolerance: rounding.
    """
    scenario = GearedWheel()
    run = Run(scenario, {"axle.velocity": 2.0}).to(0.5)
    inertia = 2.0 * 0.5**2 / 2 + scenario.gear**2 * scenario.rotor
    expected = 2.0 - 0.9 / inertia * 0.5
    verify("rate", run["axle.velocity"], expected, tolerance=1e-12, unit="rad/s")


@pytest.mark.parametrize("step", [1e-3, 2e-4], ids=["1 ms", "0.2 ms"])
def test_light_drive_comes_to_rest(verify: Verify, step: float) -> None:
    """Light drive that comes to rest: with I = 0.25 g m^2, T F / (I v_c) is 400 at T = 1 ms, and it does not chatter.

        I w' = -F sign w,   F = 1 N m in the drive, as F tanh(w / (10 mrad/s))

    Reference: from 1,000 rad/s it comes to rest after t = I w / F = 0.25 s and the angle w t / 2, less T w / 2 as
    semi-implicit Euler sums the rates at the ends of the steps, and stays there. Tolerance: v_c t for the edge; of the
    rate at 0.3 s, rounding.
    """
    scenario = GearedWheel(plant_config=discrete(step), coulomb=1.0, gear=1.0, rotor=0.0, wheel=0.002)
    run = Run(scenario, {"axle.velocity": 1000.0}).to(0.3)
    verify("angle", run["axle.position"], 125.0 - step * 1000.0 / 2.0, tolerance=0.01 * 0.25, unit="rad")
    verify("rate", run["axle.velocity"], 0.0, tolerance=1e-9, unit="rad/s")


@pytest.mark.slow_cases
@pytest.mark.parametrize(("ratio", "published"), [(0.2, 0.52662), (0.7, 0.04599)], ids=["0.2", "0.7"])
def test_step_of_an_impedance_law(verify: Verify, ratio: float, published: float) -> None:
    """Step of an impedance law: the overshoot, as a DPS computes the law from sampled sensors.

        m x'' + D x' + K x = K target,   zeta = D / (2 sqrt(K m)),   overshoot exp(-pi zeta / sqrt(1 - zeta^2))
        with a delay tau:  D - K tau for D,  m - D tau for m

    At w = sqrt(K / m) = 2 rad/s, with zeta = 0.2 and 0.7. A sensor shows its sample a period T later, and the drive
    holds its torque for T: tau = 1.5 T. The overshoot is measured at T = 2 ms, and extrapolated from 2 and 1 ms to 0.
    Reference: this closed form; without a delay 52.662 and 4.599 %. Tolerance: the second order, (w T)^2 and, with the
    delay, (w tau)^2 with T = 2 ms.
    """

    def overshoot(tau: float) -> float:
        zeta = (4.0 * ratio - 4.0 * tau) / (4.0 * sqrt(1.0 - 4.0 * ratio * tau))
        return exp(-pi * zeta / sqrt(1 - zeta**2))

    assert overshoot(0.0) == pytest.approx(published, abs=5e-6)
    peak = pi / (2.0 * sqrt(1 - ratio**2))
    T = 2e-3
    coarse, fine = (
        float(Run(Impedance(period=period, damping=4.0 * ratio), {"u.target": 1.0}).to(peak)["slider.position"]) - 1.0
        for period in (T, T / 2)
    )
    verify("overshoot at 2 ms", coarse, overshoot(1.5 * T), tolerance=(2.0 * 1.5 * T) ** 2)
    verify("extrapolated", 2 * fine - coarse, overshoot(0.0), tolerance=(2.0 * T) ** 2)


SOLVERS = ["sap", "lagged", "sap, compiled", "lagged, compiled"]


@pytest.mark.parametrize("settings", SOLVERS)
def test_load_hits_a_stop(verify: Verify, settings: str) -> None:
    """Stop of a joint: a load of 1 kg slides at 1 m/s on a resting cart of 2 kg, and hits a stop of its joint.

        m_load v = (m_cart + m_load) v',   and the load rests against the cart, at the stop

    Drake's stops are near-rigid, and dissipate within some time steps. Reference: the plastic impact, v' = 1/3 m/s,
    0.2 s after the hit. Tolerance: rounding.
    """
    run = Run(_with_contact(Carts, settings), {"load_slider.velocity": 1.0}).to(0.3)
    cart, load = float(run["cart_slider.velocity"]), float(run["load_slider.velocity"])
    verify("momentum", 2.0 * cart + (cart + load), 1.0, tolerance=1e-12, unit="N s")
    verify("velocity of the cart", cart, 1.0 / 3.0, tolerance=1e-12, unit="m/s")
    verify("position of the load", float(run["load_slider.position"]), 0.1, tolerance=1e-12, unit="m")


@pytest.mark.parametrize("settings", SOLVERS)
def test_servo_at_its_effort_limit(verify: Verify, settings: str) -> None:
    """Effort limit: a PD controller far from its desired state pushes 1 kg with its limit of 2 N.

        x = F t^2 / 2,   and in steps of h   x = F t (t + h) / 2

    Reference: the closed form in steps, after 0.5 s with h = 0.5 ms. Tolerance: rounding.
    """
    run = Run(_with_contact(Servo, settings), {"u.force": [10.0, 0.0]}).to(0.5)
    verify("position", float(run["slider.position"]), 2.0 * 0.5 * (0.5 + STEP) / 2, tolerance=1e-12, unit="m")
    verify("velocity", float(run["slider.velocity"]), 2.0 * 0.5, tolerance=1e-12, unit="m/s")


@pytest.mark.parametrize("settings", SOLVERS)
def test_servo_holds_a_weight(verify: Verify, settings: str) -> None:
    """Implicit PD controller: critically damped, it holds a weight of 1 N, which pulls it away from its desired state.

        x = x_d + (F / K) (1 - (1 + w t) e^(-w t)),   w = sqrt(K / m) = 10 rad/s

    Reference: this closed form, after 0.2 s. Tolerance: (F / K) w h, the first order of implicit Euler, h = 0.5 ms.
    """
    run = Run(_with_contact(Servo, settings, pull=1.0), {"u.force": [0.0, 0.0]}).to(0.2)
    expected = 0.01 * (1.0 - (1.0 + 2.0) * exp(-2.0))
    verify("position", float(run["slider.position"]), expected, tolerance=0.01 * 10.0 * STEP, unit="m")


# -- contact

STEP = 5e-4


def _cenic(step: float) -> SimulatorConfig:
    return scheme("cenic", accuracy=1e-5, max_step_size=2 * step)


def _contact(settings: str, step: float = STEP) -> tuple[MultibodyPlantConfig, SimulatorConfig]:
    """Return contact settings of a scenario: its configs of plant and integrator, of the first order in ``step``.

    ``settings`` is cenic or an approximation of discrete plants, with ``, hydroelastic`` if contact is no point, or
    ``, compiled`` if the world is.
    """
    name, _, model = settings.partition(", ")
    model = "point" if model in ("", "compiled") else model
    if name == "cenic":
        return MultibodyPlantConfig(time_step=0.0, contact_model=model), _cenic(step)
    return discrete(step, name, contact_model=model), precise()


COMPILED = ["lagged, compiled", "sap, compiled"]
SLIDING = ["lagged", "cenic", "lagged, compiled"]
SLIDING_FACES = [*SLIDING, "lagged, hydroelastic", "cenic, hydroelastic"]


def _with_contact(kind: type, settings: str, *, step: float = STEP, **fields: object):
    plant_config, simulator_config = _contact(settings, step)
    is_compiled = settings.endswith("compiled")
    return kind(plant_config=plant_config, simulator_config=simulator_config, is_compiled=is_compiled, **fields)


def _downhill(angle: float) -> np.ndarray:
    return np.array([np.cos(angle), 0.0, -np.sin(angle)])


@pytest.mark.slow_cases
@pytest.mark.parametrize("settings", ["lagged", "cenic", "sap", "similar", *COMPILED])
def test_ball_rests_on_its_springs(verify: Verify, settings: str) -> None:
    """Resting ball: where the contact of two materials carries its weight, it stays.

        m g = k x,   1 / k = 1 / k_ball + 1 / k_ground,   x = 0.981 mm

    Reference: this depth, after 0.5 s, with k_ball = 30 kN/m and k_ground = 15 kN/m. Tolerance: 1e-9 m, 1e-6 of it.
    """
    depth = G / 1e4
    run = Run(_with_contact(Ball, settings, stiffness=1e4), {}).to(0.5)
    verify("depth", 0.1 - run.pose("ball").translation()[2], depth, tolerance=1e-9, unit="m")


@pytest.mark.slow_cases
@pytest.mark.parametrize("settings", ["lagged", "cenic", "sap", "similar", *COMPILED])
@pytest.mark.parametrize("friction", [0.5, 0.08], ids=["mu 0.5", "mu 0.08"])
def test_ball_rolls_down_a_slope(verify: Verify, settings: str, friction: float) -> None:
    """Rolling ball: on a slope of 15 deg it rolls, for which it needs mu >= 2/7 tan(15 deg) = 0.0766.

        a = 5/7 g sin(15 deg) = 1.8135820 m/s^2,   r w' = a

    Reference: this closed form. Tolerance: a x / r, as the ball sinks in by x = m g cos(15 deg) / k = 1e-6 m.
    """
    reference = 5 / 7 * G * np.sin(np.radians(15.0))
    assert reference == pytest.approx(1.8135820, abs=5e-8)
    linear, angular = _rolling(settings, friction)
    sunk = G / RIGID
    verify("acceleration", linear, reference, tolerance=reference * sunk / 0.1, unit="m/s^2")
    verify("r times angular acceleration", angular, reference, tolerance=reference * sunk / 0.1, unit="m/s^2")


@pytest.mark.parametrize("settings", SLIDING)
def test_ball_slides_down_a_slope(verify: Verify, settings: str) -> None:
    """Sliding ball: a slope of 15 deg with mu = 0.05 is too smooth to roll; it slides and spins up.

        a = g (sin(15 deg) - mu cos(15 deg)),   r w' = 5/2 mu g cos(15 deg)

    Reference: this closed form. Tolerance: a x / r = 2e-5 m/s^2, x how far it sinks in.
    """
    angle, friction = np.radians(15.0), 0.05
    linear, angular = _rolling(settings, friction)
    tolerance = 2e-5
    verify("acceleration", linear, G * (np.sin(angle) - friction * np.cos(angle)), tolerance=tolerance, unit="m/s^2")
    expected = 2.5 * friction * G * np.cos(angle)
    verify("r times angular acceleration", angular, expected, tolerance=tolerance, unit="m/s^2")


def _rolling(settings: str, friction: float) -> np.ndarray:
    """Return the accelerations between 0.2 s and 0.7 s: downhill, and r times the angular one."""
    run = Run(_with_contact(Ball, settings, angle_deg=15.0, friction=friction), {})
    direction = _downhill(np.radians(15.0))
    speeds = []
    for t in (0.2, 0.7):
        run.to(t)
        speeds.append([run.velocity("ball") @ direction, 0.1 * run.angular_velocity("ball")[1]])
    return (np.array(speeds[1]) - speeds[0]) / 0.5


@pytest.mark.slow
@pytest.mark.parametrize("settings", SLIDING)
def test_bowling_ball_slides_until_it_rolls(verify: Verify, settings: str) -> None:
    """Bowling ball: 6.35 kg, r = 0.10795 m, I = 0.0296 kg m^2, thrown at 8 m/s with a side spin of 8 pi rad/s.

        v = v_0 - mu g t u,   until t = |s_0| / (mu g (1 + m r^2 / I)) = 2.0503 s, and then constant

    s_0 = v_0 + w_0 x (0, 0, -r) is the first slip, u its direction, which stays; mu = 0.12.
    Reference: this closed form; the final velocity is (0.775182, 5.714238, 0) m/s for any friction and gravity.
    Tolerance: a h = 6e-4 m/s, one step of friction, where sliding ends; before, the regularization of 0.1 mm/s.
    """
    mass, radius, inertia, friction = 6.35, 0.10795, 0.0296, 0.12
    v, w = np.array([0.0, 8.0, 0.0]), np.array([0.0, 8.0 * pi, 0.0])
    slip = v + np.cross(w, [0.0, 0.0, -radius])
    u = slip / np.linalg.norm(slip)
    end = np.linalg.norm(slip) / (friction * G * (1 + mass * radius**2 / inertia))
    final = v - friction * G * end * u
    assert final == pytest.approx([0.775182, 5.714238, 0.0], abs=5e-7)
    ball = _with_contact(Ball, settings, friction=friction, mass=mass, radius=radius, inertia=inertia)
    run = Run(ball, {"ball.velocity": [*w, *v]}).to(1.0)
    verify("velocity at 1 s", run.velocity("ball"), v - friction * G * u, tolerance=1e-4, unit="m/s")
    run.to(2.4)
    verify("velocity at the end", run.velocity("ball"), final, tolerance=friction * G * STEP, unit="m/s")


@pytest.mark.slow_cases
@pytest.mark.parametrize("settings", ["lagged", "cenic", "sap", "similar", *COMPILED])
def test_friction_is_mu_times_the_normal_force(verify: Verify, settings: str) -> None:
    """Coulomb's law in a throw of the bowling ball: its impulses after 1 s of sliding.

        |m (v_t(1 s) - v_t(0))| = mu (m g 1 s + m v_n(1 s))

    So it holds for SAP and `similar`, too, with which the ball does not stay at rest along the normal.
    Reference: mu = 0.12. Tolerance: 1e-5, the regularization of 0.1 mm/s over the slip of 4 m/s.
    """
    friction = 0.12
    ball = _with_contact(Ball, settings, friction=friction, mass=6.35, radius=0.10795, inertia=0.0296)
    v = np.array([0.0, 8.0, 0.0])
    run = Run(ball, {"ball.velocity": [0.0, 8.0 * pi, 0.0, *v]}).to(1.0)
    change = run.velocity("ball") - v
    verify("friction", np.linalg.norm(change[:2]) / (G + change[2]), friction, tolerance=1e-5)


@pytest.mark.slow_cases
@pytest.mark.parametrize("settings", SLIDING_FACES)
def test_block_slides_down_a_slope(verify: Verify, settings: str) -> None:
    """Sliding block: on a slope of 30 deg with mu = 0.5, from 1 m/s, on four feet, or hydroelastic on its face.

        a = g (sin(30 deg) - mu cos(30 deg)) = 0.6571454 m/s^2

    Reference: velocity and distance after 1 s. Tolerance: a h for the velocity, and a t h for the distance.
    """
    angle = np.radians(30.0)
    acceleration = G * (np.sin(angle) - 0.5 * np.cos(angle))
    assert acceleration == pytest.approx(0.6571454, abs=5e-8)
    direction = _downhill(angle)
    run = Run(_with_contact(Block, settings), {"block.velocity": [0.0, 0.0, 0.0, *direction]})
    begin = run.pose("block").translation()
    run.to(1.0)
    tolerance = acceleration * STEP
    verify("velocity", run.velocity("block") @ direction, 1.0 + acceleration, tolerance=tolerance, unit="m/s")
    distance = (run.pose("block").translation() - begin) @ direction
    verify("distance", distance, 1.0 + acceleration / 2, tolerance=tolerance, unit="m")


@pytest.mark.parametrize("settings", ["sap", "similar", "sap, hydroelastic", "similar, hydroelastic", "sap, compiled"])
def test_block_slides_with_convex_friction(verify: Verify, settings: str) -> None:
    """Sliding block with convex friction: the block of the sliding block's case, with SAP and `similar`.

        a = g (sin(30 deg) - mu cos(30 deg)),   and along the normal v_n = mu v_t where a rigid contact slides

    So a block on stiff contact hops, by some millimetres, and turns; what it slides is right in the mean only.
    Reference: the distance after 1 s. Tolerance: 1 % of it, which does not fall with the step.
    """
    angle = np.radians(30.0)
    reference = 1.0 + G * (np.sin(angle) - 0.5 * np.cos(angle)) / 2
    direction = _downhill(angle)
    run = Run(_with_contact(Block, settings), {"block.velocity": [0.0, 0.0, 0.0, *direction]})
    begin = run.pose("block").translation()
    distance = (run.to(1.0).pose("block").translation() - begin) @ direction
    verify("distance", distance, reference, tolerance=0.01, relative=True)


@pytest.mark.slow
@pytest.mark.parametrize("settings", SLIDING_FACES)
def test_block_slides_to_rest(verify: Verify, settings: str) -> None:
    """Stopping block: on flat ground with mu = 0.4, from 2 m/s.

        x = v^2 / (2 mu g) = 0.5096840 m

    It is extrapolated from the steps h and h / 2, whose errors are v h / 2 and v h / 4, h = 0.5 ms.
    Reference: this closed form. Tolerance: 2e-5 m, a fifth of the regularization of 0.1 mm/s, for a second.
    """
    reference = 2.0**2 / (2 * 0.4 * G)
    assert reference == pytest.approx(0.5096840, abs=5e-8)
    distances = []
    for step in (STEP, STEP / 2):
        block = _with_contact(Block, settings, step=step, angle_deg=0.0, friction=0.4)
        run = Run(block, {"block.velocity": [0.0, 0.0, 0.0, 2.0, 0.0, 0.0]}).to(0.6)
        distances.append(run.pose("block").translation()[0])
    verify("distance", 2 * distances[1] - distances[0], reference, tolerance=2e-5, unit="m")


@pytest.mark.slow_cases
@pytest.mark.parametrize("settings", SLIDING_FACES)
def test_block_creeps_on_a_slope(verify: Verify, settings: str) -> None:
    """Creeping block: on a slope of 30 deg with mu = 0.6 it sticks, which regularized friction makes a creep.

        mu N v / sqrt(v^2 + v_s^2) = m g sin(30 deg),   v = v_s r / sqrt(1 - r^2),  r = tan(30 deg) / mu

    Reference: v = 0.35355 mm/s for the stiction tolerance v_s = 0.1 mm/s. Tolerance: 1e-4 of v, where the solvers end.
    """
    ratio = np.tan(np.radians(30.0)) / 0.6
    reference = 1e-4 * ratio / sqrt(1 - ratio**2)
    run = Run(_with_contact(Block, settings, friction=0.6), {}).to(0.5)
    creep = run.velocity("block") @ _downhill(np.radians(30.0))
    verify("creep", creep, reference, tolerance=1e-4, relative=True)


@pytest.mark.parametrize("settings", ["sap", "sap, compiled"])
def test_block_sticks_with_sap(verify: Verify, settings: str) -> None:
    """Sticking block: on a slope of 30 deg with mu = 0.6, with SAP.

        |F_t| = m g sin(30 deg) <= mu N,   creep v ~ sigma mu g h,  sigma = 1e-3

    Reference: no motion (Castro, Permenter, Han, "An unconstrained convex formulation of compliant contact", 2022, for
    the regularization sigma). Tolerance: 4 sigma g h, for four feet.
    """
    run = Run(_with_contact(Block, settings, friction=0.6), {}).to(0.5)
    verify("creep", run.velocity("block"), np.zeros(3), tolerance=4e-3 * G * STEP, unit="m/s")


@pytest.mark.slow
@pytest.mark.parametrize("settings", ["lagged", "cenic"])
@pytest.mark.parametrize("direction_deg", [0.0, 45.0], ids=["0 deg", "45 deg"])
def test_simbenchmark_rolling(verify: Verify, settings: str, direction_deg: float) -> None:
    """SimBenchmark's rolling test: 150 N drag a box of 10 kg with 25 balls of 1 kg on it over ground with mu = 0.4.

        (M + 25 (2/7) m) a = F - mu (M + 25 m) g,   a = 0.7385 m/s^2,  balls 2/7 a = 0.2110 m/s^2

    The balls roll on the box. Along x and at 45 deg it is the same, unless friction is a pyramid.
    Reference: the analytic solution of leggedrobotics' SimBenchmark. Tolerance: 1e-5 of a, as bodies sink in by some
    micrometres.
    """
    reference = (150.0 - 0.4 * 35.0 * G) / (10.0 + 50.0 / 7.0)
    assert reference == pytest.approx(0.7385, abs=5e-5)
    scenario = _with_contact(RollingTest, settings)
    angle = np.radians(direction_deg)
    direction = np.array([np.cos(angle), np.sin(angle), 0.0])
    force = np.zeros(scenario.forces)
    force[3:6] = 150.0 * direction  # The box is the first body.
    run = Run(scenario, {"u.force": force})
    speeds = []
    for t in (0.1, 0.3):
        run.to(t)
        speeds.append([run.velocity(name) @ direction for name in ("box", "ball_0", "ball_12", "ball_24")])
    box, *balls = (np.array(speeds[1]) - speeds[0]) / 0.2
    verify("box", box, reference, tolerance=1e-5, unit="m/s^2")
    verify("balls", balls, 2 / 7 * reference, tolerance=1e-5, unit="m/s^2")


BOUNCES = {
    "runge_kutta5": (continuous(), precise(1e-4), 0.0),
    "runge_kutta3": (continuous(), scheme("runge_kutta3", accuracy=1e-8), 0.0),
    "lagged": (discrete(2e-5, "lagged"), precise(), 2e-5),
    "similar": (discrete(2e-5, "similar"), precise(), 2e-5),
    "cenic": (continuous(), _cenic(2e-5), 2e-5),
}


@pytest.mark.slow_cases
@pytest.mark.parametrize(("dissipation", "published"), [(0.1, 0.93748), (0.5, 0.74843), (1.0, 0.59362)])
@pytest.mark.parametrize("settings", list(BOUNCES))
def test_bounce_by_hunt_and_crossley(verify: Verify, settings: str, dissipation: float, published: float) -> None:
    """Bounce after Hunt and Crossley: the coefficient of restitution e at 1 m/s.

        m x'' = -k x (1 + d x'),   d v (1 + e) = ln((1 + d v) / (1 - e d v)),  for any m and k

    Reference: the root of this equation, e = 0.93748, 0.74843, 0.59362 for d v = 0.1, 0.5, 1. Tolerance: 1e-5; with a
    step h of the first order, e w h pi / 2 at w = sqrt(k / m) = 100 rad/s, as a step of implicit Euler damps by
    1 / sqrt(1 + w^2 h^2).
    """
    e = brentq(lambda e: dissipation * (1 + e) - log((1 + dissipation) / (1 - e * dissipation)), 0.1, 0.999)
    assert e == pytest.approx(published, abs=5e-6)
    plant_config, simulator_config, h = BOUNCES[settings]
    world = Bounce(plant_config=plant_config, simulator_config=simulator_config, dissipation=dissipation)
    verify("restitution", _rebound(world), e, tolerance=1e-5 + e * 100.0 * h * pi / 2)


@pytest.mark.slow_cases
@pytest.mark.parametrize("relaxation", [1e-3, 5e-3, 1e-2], ids=["1 ms", "5 ms", "10 ms"])
def test_bounce_with_sap(verify: Verify, relaxation: float) -> None:
    """Bounce with SAP: at 1 m/s on a spring beside a damper of the relaxation time tau.

        m x'' = -k (x + tau x'),   e = exp(-zeta w t),  zeta = tau w / 2,  w = sqrt(k / m)
        w_d t = atan2(2 zeta sqrt(1 - zeta^2), 2 zeta^2 - 1),  w_d = w sqrt(1 - zeta^2):  the force ends

    Reference: this closed form. Tolerance: e w h pi / 2 at h = 0.02 ms, the damping by implicit Euler.
    """
    w, h = 100.0, 2e-5
    zeta = relaxation * w / 2
    root = sqrt(1 - zeta**2)
    e = exp(-zeta / root * atan2(2 * zeta * root, 2 * zeta**2 - 1))
    world = Bounce(plant_config=discrete(h, "sap"), relaxation=relaxation)
    verify("restitution", _rebound(world), e, tolerance=e * w * h * pi / 2)


def _rebound(world: Bounce) -> float:
    run = Run(world, {"slider.position": 0.1005, "slider.velocity": -1.0}).to(0.05)
    assert run["slider.position"] > 0.1
    return float(run["slider.velocity"])
