"""Other engines: MuJoCo on the same masses, and the compiled plants against Drake's.

No engine's answer is a reference of the other groups: what two engines have in common, a wrong model, say, shows there.
"""

from __future__ import annotations

from collections.abc import Callable

import casadi
import numpy as np
import pytest
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import Context

from tests.components.compiled_plant.plants import PLANTS, cart_pole, floating, random_plant, simulate, states
from tests.verification.conftest import Verify
from tests.verification.mjcf import mjcf
from tests.verification.worlds import FallingArm, FreeServicer, Run
from vtbdrake.components.compiled_plant import PlantDynamics, plant_dynamics, plant_step
from vtbdrake_diagrams.satellite.bodies import Servicer

TORQUES = np.array([2.0, -3.0, 1.5, 2.5, -1.0, 0.8, -0.5])


def _servicer() -> Run:
    """Return the servicer, whose seven joints its DPS turns with constant torques."""
    scenario = FreeServicer()
    return Run(scenario, {"u.force": [*np.zeros(6), *TORQUES, 0.0, 0.0]})


def test_free_floating_servicer_conserves_momentum(verify: Verify) -> None:
    """Momentum of a free-floating servicer: 400 kg, whose arm of 37 kg moves; it stays zero.

        L = sum of (I w + m r x v) = 0,   p = sum of m v = 0

    Reference: zero, by Drake's own sum over the bodies, after 1 s under constant torques of up to 3 N m. Tolerance:
    rounding.
    """
    run = _servicer().to(1.0)
    plant: MultibodyPlant = run.testbed.plant
    context = plant.GetMyContextFromRoot(run.context)
    assert np.abs(plant.GetVelocities(context)[6:13]).max() > 0.1
    momentum = _momentum(plant, context, plant.GetPositionsAndVelocities(context))
    verify("angular momentum", momentum[:3], np.zeros(3), tolerance=1e-9, unit="N m s")
    verify("momentum", momentum[3:], np.zeros(3), tolerance=1e-9, unit="N s")


def test_servicer_moves_as_in_mujoco(verify: Verify) -> None:
    """Servicer in MuJoCo: joints, attitude and place of the base after 1 s.

    Reference: MuJoCo, RK4 with steps of 1 ms, on the masses, frames and axes of the plant. Tolerance: 1e-8, the fourth
    order of both.
    """
    mujoco = pytest.importorskip("mujoco")
    run = _servicer()
    plant: MultibodyPlant = run.testbed.plant
    own = plant.GetMyContextFromRoot(run.context)
    model = mujoco.MjModel.from_xml_string(mjcf(plant, own, time_step=1e-3, integrator="RK4"))
    data = mujoco.MjData(model)
    data.qpos[:] = plant.GetPositions(own)[[4, 5, 6, 0, 1, 2, 3, *range(7, 16)]]
    data.qfrc_applied[6:13] = TORQUES
    mujoco.mj_step(model, data, nstep=1000)
    q = plant.GetPositions(plant.GetMyContextFromRoot(run.to(1.0).context))
    assert np.abs(q[7:14] - Servicer().stowed).max() > 0.1
    verify("joints", q[7:14], data.qpos[7:14], tolerance=1e-8, unit="rad")
    verify("attitude", q[:4], data.qpos[3:7], tolerance=1e-8)
    verify("place", q[4:7], data.qpos[:3], tolerance=1e-8, unit="m")


def test_falling_arm_moves_as_in_mujoco(verify: Verify) -> None:
    """Falling arm in MuJoCo: the manipulator, from its home pose, without torques, with reflected rotors, for 0.5 s.

        (M(q) + diag(N^2 I_rotor)) v' + C(q, v) v = g(q)

    Reference: MuJoCo, RK4 with steps of 1 ms, on the masses, frames and axes of the plant. Tolerance: 1e-8, the fourth
    order of both.
    """
    mujoco = pytest.importorskip("mujoco")
    run = Run(FallingArm(), {})
    plant: MultibodyPlant = run.testbed.plant
    own = plant.GetMyContextFromRoot(run.context)
    model = mujoco.MjModel.from_xml_string(mjcf(plant, own, time_step=1e-3, integrator="RK4"))
    data = mujoco.MjData(model)
    data.qpos[:] = plant.GetPositions(own)
    mujoco.mj_step(model, data, nstep=500)
    own = plant.GetMyContextFromRoot(run.to(0.5).context)
    assert np.abs(data.qvel).max() > 0.3
    verify("joints", plant.GetPositions(own), data.qpos, tolerance=1e-8, unit="rad")
    verify("rates", plant.GetVelocities(own), data.qvel, tolerance=1e-8, unit="rad/s")


def test_compiled_cart_pole_moves_as_in_mujoco(verify: Verify) -> None:
    """Compiled cart-pole in MuJoCo: with damping, 200 steps of 10 ms under state feedback.

        v_{k+1} = v_k + h (M + h D)^-1 (B u - C v - D v + g),   q_{k+1} = q_k + h v_{k+1}

    Reference: MuJoCo's integrator `implicitfast`, which takes the same step, with the same feedback. Tolerance:
    rounding.
    """
    mujoco = pytest.importorskip("mujoco")
    plant = cart_pole(0.01)
    context = plant.CreateDefaultContext()
    step = plant_step(plant, context)
    model = mujoco.MjModel.from_xml_string(mjcf(plant, context, time_step=0.01, integrator="implicitfast"))
    data = mujoco.MjData(model)
    joints = {name: data.joint(name) for name in ("slider", "hinge")}
    joints["hinge"].qpos = 0.5
    joints["slider"].qvel = 0.3
    gain = np.array([-1.0, 8.0, -2.0, 1.0])
    x = np.array([0.0, 0.5, 0.3, 0.0])
    for _ in range(200):
        state = np.ravel([[joint.qpos for joint in joints.values()], [joint.qvel for joint in joints.values()]])
        data.qfrc_applied[model.joint("slider").dofadr[0]] = gain @ state
        mujoco.mj_step(model, data)
        x = step(x, gain @ x)[0].full().ravel()
    for (name, joint), values in zip(joints.items(), x.reshape(2, 2).T, strict=True):
        expected = [joint.qpos[0], joint.qvel[0]]
        verify(name, values, expected, tolerance=1e-10, unit="m, m/s" if name == "slider" else "rad, rad/s")


@pytest.mark.parametrize("make", PLANTS)
def test_compiled_derivatives_are_those_of_the_plant(verify: Verify, make: Callable[[float], MultibodyPlant]) -> None:
    """Derivatives of compiled plants: cart-pole, acrobot, arm, a floating tree and the space climber.

        qdot = N(q) v,   v' = (M(q) + diag(N^2 I_rotor))^-1 (B u - D v - C(q, v) v + g(q))

    Reference: Drake's `EvalTimeDerivatives` at five random states. Tolerance: rounding.
    """
    _verify_derivatives(verify, make(0.0), 5, tolerance=1e-12)


@pytest.mark.slow_cases
@pytest.mark.parametrize("seed", range(8))
def test_compiled_random_plants_move_as_those_of_drake(verify: Verify, seed: int) -> None:
    """Random compiled plants: trees of five random links, joints, frames, motors and rotors; half of them float.

    Reference: Drake's derivatives at three random states, and 20 steps of its discrete plant. Tolerance: rounding.
    """
    _verify_derivatives(verify, random_plant(0.0, seed), 3, tolerance=1e-11)
    plant = random_plant(0.002, seed)
    random = np.random.default_rng(seed)
    x = plant.GetPositionsAndVelocities(plant.CreateDefaultContext())
    x[plant.num_positions() :] = 0.3 * random.normal(size=plant.num_velocities())
    _verify_steps(verify, plant, x, random.normal(size=(20, plant.num_actuated_dofs())), tolerance=1e-11)


@pytest.mark.parametrize("make", PLANTS)
def test_compiled_steps_are_those_of_the_discrete_plant(
    verify: Verify, make: Callable[[float], MultibodyPlant]
) -> None:
    """Steps of compiled plants: 40 steps of 5 ms, with random torques.

        v_{k+1} = v_k + h (M + h D)^-1 (B u - C v - D v + g),   q_{k+1} = q_k + h N(q_k) v_{k+1}

    Reference: Drake's discrete plant, by SAP. Tolerance: rounding.
    """
    plant = make(0.005)
    random = np.random.default_rng(1)
    x = plant.GetPositionsAndVelocities(plant.CreateDefaultContext())
    lower, upper = plant.GetPositionLowerLimits(), plant.GetPositionUpperLimits()
    limited = np.isfinite(lower) & np.isfinite(upper)
    x[: limited.size][limited] = (lower[limited] + upper[limited]) / 2
    x[limited.size :] = 0.3 * random.normal(size=plant.num_velocities())
    _verify_steps(verify, plant, x, 0.1 * random.normal(size=(40, plant.num_actuated_dofs())), tolerance=1e-12)


def _verify_derivatives(verify: Verify, plant: MultibodyPlant, count: int, *, tolerance: float) -> None:
    context = plant.CreateDefaultContext()
    dynamics = plant_dynamics(plant, context)
    for x, u in states(plant, count):
        plant.SetPositionsAndVelocities(context, x)
        plant.get_actuation_input_port().FixValue(context, u)
        expected = plant.EvalTimeDerivatives(context).CopyToVector()
        verify("derivatives", dynamics(x, u).full().ravel(), expected, tolerance=tolerance, relative=True)


def _verify_steps(verify: Verify, plant: MultibodyPlant, x: np.ndarray, u: np.ndarray, *, tolerance: float) -> None:
    context = plant.CreateDefaultContext()
    plant.SetPositionsAndVelocities(context, x)
    step = plant_step(plant, context)
    for k, expected in enumerate(simulate(plant, context, u, len(u))):
        following, overrun = step(x, u[k])
        assert float(overrun) <= 0.0
        x = following.full().ravel()
        verify("states", x, expected, tolerance=tolerance, relative=True)


def test_explicit_damping_would_be_another_step() -> None:
    """Damping at the begin of a step: the comparison above would find it."""
    plant = cart_pole(0.02)
    context = plant.CreateDefaultContext()
    context.SetDiscreteState(np.array([0.0, 1.0, 0.0, 5.0]))
    expected = simulate(plant, context, np.zeros((1, 1)), 1)[0]
    model = PlantDynamics(plant, context)
    q, v, u = model.symbols()
    explicit = casadi.Function("explicit", [q, v, u], [v + 0.02 * model.acceleration(q, v, model.actuation(u))])
    difference = np.abs(explicit([0.0, 1.0], [0.0, 5.0], 0.0).full().ravel() - expected[2:])
    assert difference.max() > 1e-6 * np.abs(expected).max()


def test_compiled_floating_tree_conserves_momentum_and_energy(verify: Verify) -> None:
    """Conservation in a compiled tree: floating, with a hinge and a slider, without gravity and damping, for 2 s.

        L = const,  p = const,  v' M v / 2 = const

    Reference: the values at the start; momentum by Drake. Tolerance: as SUNDIALS' CVODES, 1e-12 per step.
    """
    plant = floating(0.0, gravity=False, damping=0.0)
    context = plant.CreateDefaultContext()
    model = PlantDynamics(plant, context)
    dynamics = plant_dynamics(plant, context)
    q, v, _ = model.symbols()
    energy = casadi.Function("energy", [q, v], [model.energy(q, v)[0]])
    n = plant.num_positions()
    x, _ = next(states(plant))
    x[:4] /= np.linalg.norm(x[:4])
    state = casadi.MX.sym("x", x.size)
    flow = casadi.integrator(
        "flow", "cvodes", {"x": state, "ode": dynamics(state, 0)}, 0.0, 2.0, {"abstol": 1e-12, "reltol": 1e-12}
    )
    end = flow(x0=x)["xf"].full().ravel()
    momenta = [_momentum(plant, context, y) for y in (x, end)]
    verify("momentum", momenta[1], momenta[0], tolerance=1e-8, unit="N m s, N s")
    energies = [float(energy(y[:n], y[n:])) for y in (x, end)]
    verify("energy", energies[1], energies[0], tolerance=1e-8, relative=True)


def _momentum(plant: MultibodyPlant, context: Context, x: np.ndarray) -> np.ndarray:
    """Return [angular; linear] about the world's origin, in the world, by Drake."""
    plant.SetPositionsAndVelocities(context, x)
    return plant.CalcSpatialMomentumInWorldAboutPoint(context, np.zeros(3)).get_coeffs()
