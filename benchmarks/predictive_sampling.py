"""Planning by predictive sampling on a cart-pole: a compiled mental world beside MuJoCo's `rollout`.

Both plan with the same model, the same step (semi-implicit Euler with implicit damping), the same knots, candidates and
horizon, each in the time that its own way of computing the costs takes.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Protocol

import casadi
import mujoco
import mujoco.rollout
import numpy as np
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant

from benchmarks.measure import HIGHER, Benchmark, interleaved, ratio
from vtbdrake.components.compiled_plant import PlantRollouts, plant_step
from vtbdrake_diagrams.cart_pole.model import CART_POLE_SDF, CartPole

CANDIDATES, STEPS, STEP, KNOTS = 32, 50, 0.02, 6
LIMIT, SPREAD = 60.0, 20.0  # N: of the force, and of the candidates about the plan in use
WEIGHTS = {"pole": 10.0, "cart": 0.1, "velocity": 0.1, "force": 1e-4}
HANGING = np.array([0.0, 0.05, 0.0, 0.0])
TOLERANCE = 1e-9


class Planner(Protocol):
    """Computes the costs of candidates z, shape (n, K), from the state x0 = [q; v]; the result has the shape (n,)."""

    def __call__(self, x0: np.ndarray, z: np.ndarray) -> np.ndarray: ...


def predictive_sampling(repeats: int = 300, seeds: int = 8) -> list[Benchmark]:
    """Plans per second, by a compiled plant and by MuJoCo, and how good the swing-ups are at equal wall time."""
    step = cart_pole_step()
    ours = compiled_planner(step)
    theirs = {f"{n} thread{'s' * (n > 1)}": mujoco_planner(n) for n in (1, 2)}
    apart = max(_difference(ours, planner) for planner in theirs.values())
    if not apart <= TOLERANCE:
        raise ArithmeticError(f"the costs of the two engines are {apart:.2g} apart")
    measured = {name: _race(ours, planner, repeats) for name, planner in theirs.items()}
    fastest = min(measured, key=lambda name: float(np.median(measured[name][1])))
    own, other = measured[fastest]
    micros = ", ".join(f"{name} {1e6 * np.median(t):.0f}" for name, (_, t) in measured.items())
    budget = float(np.median(other))
    costs = {
        name: [swing_up(step, planner, budget, seed=seed) for seed in range(seeds)]
        for name, planner in (("compiled", ours), ("MuJoCo", theirs[fastest]))
    }
    results = ", ".join(
        f"{name} {np.median([cost for cost, _ in runs]):.0f} in {np.median([plans for _, plans in runs]):.0f} plans"
        for name, runs in costs.items()
    )
    return [
        Benchmark(
            name="predictive_sampling",
            value=ratio(other, own),
            unit="1",
            goal=5.0,
            better=HIGHER,
            against=f"plans per second of mujoco.rollout {mujoco.__version__}, {fastest}",
            note=f"us per plan of {CANDIDATES} rollouts of {STEPS * STEP:g} s: compiled {1e6 * np.median(own):.0f}; "
            f"MuJoCo with {micros}; costs {apart:.1g} apart, n = {repeats}",
        ),
        Benchmark(
            name="predictive_sampling_quality",
            value=float(np.median([cost for cost, _ in costs["compiled"]])),
            unit="1",
            goal=None,
            better="lower",
            against=f"MuJoCo at the same wall time, {1e3 * budget:.2g} ms for each {1e3 * STEP:g} ms",
            note=f"cost of a swing-up of 5 s, median of {seeds} seeds: {results} for each sample",
        ),
    ]


def cart_pole_step() -> casadi.Function:
    """The step of Drake's cart-pole, read from its SDF file."""
    plant = MultibodyPlant(STEP)
    Parser(plant).AddModels(str(CART_POLE_SDF))
    plant.Finalize()
    return plant_step(plant, plant.CreateDefaultContext())


def compiled_planner(step: casadi.Function) -> Planner:
    rollouts = PlantRollouts(
        step,
        control=polyline(),
        cost=lambda x, u: _state_cost(x) + WEIGHTS["force"] * casadi.sumsqr(u),
        final_cost=_state_cost,
        compile=True,
    )
    return lambda x0, z: rollouts(x0, z).costs


def mujoco_planner(threads: int) -> Planner:
    """The cart-pole in MuJoCo, with the numbers of `CartPole`."""
    m = CartPole()
    model = mujoco.MjModel.from_xml_string(f"""
        <mujoco>
          <option timestep="{STEP}" gravity="0 0 {-m.gravity}" integrator="Euler"/>
          <compiler boundinertia="0" boundmass="0"/>
          <worldbody>
            <body name="cart">
              <joint name="slider" type="slide" axis="1 0 0"/>
              <inertial pos="0 0 0" mass="{m.cart_mass}" diaginertia="0.024 0.06 0.06"/>
              <body name="pole">
                <joint name="pin" type="hinge" axis="0 -1 0"/>
                <inertial pos="0 0 {-m.pole_length}" mass="{m.pole_mass}" diaginertia="1e-12 1e-12 1e-12"/>
              </body>
            </body>
          </worldbody>
          <actuator><motor joint="slider"/></actuator>
        </mujoco>""")
    data = [mujoco.MjData(model) for _ in range(threads)]
    kind = mujoco.mjtState.mjSTATE_FULLPHYSICS
    first = np.zeros(mujoco.mj_stateSize(model, kind))
    states = np.zeros((CANDIDATES, STEPS, first.size))
    sensors = np.zeros((CANDIDATES, STEPS, model.nsensordata))
    B = polyline()
    # One thread is the caller's own.
    pool = mujoco.rollout.Rollout(nthread=threads if threads > 1 else 0)

    def costs(x0: np.ndarray, z: np.ndarray) -> np.ndarray:
        mujoco.mj_getState(model, data[0], first, kind)
        first[0], first[1:5] = 0.0, x0
        u = z @ B.T
        pool.rollout(
            model, data, first[None], u[:, :, None], state=states, sensordata=sensors, skip_checks=False, nstep=STEPS
        )
        x = states[: len(z), :, 1:5]
        cost = WEIGHTS["pole"] * (1.0 + np.cos(x[..., 1])) + WEIGHTS["cart"] * x[..., 0] ** 2
        cost += WEIGHTS["velocity"] * (x[..., 2] ** 2 + x[..., 3] ** 2)
        return cost.sum(axis=1) + WEIGHTS["force"] * (u**2).sum(axis=1) + float(_state_cost(casadi.DM(x0)))

    return costs


def polyline() -> np.ndarray:
    """B of a polyline through knots at equal distances, shape (STEPS, KNOTS)."""
    times, knots = np.arange(STEPS) / STEPS, np.linspace(0.0, 1.0, KNOTS)
    return np.array([np.interp(times, knots, unit) for unit in np.eye(KNOTS)]).T


def plan(planner: Planner, x0: np.ndarray, current: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """The best of the plan in use and of candidates about it, shape (K,)."""
    z = current + SPREAD * random.standard_normal((CANDIDATES, KNOTS))
    z[0] = current
    np.clip(z, -LIMIT, LIMIT, out=z)
    return z[np.argmin(planner(x0, z))]


def swing_up(step: casadi.Function, planner: Planner, budget: float, *, seed: int) -> tuple[float, float]:
    """Cost of 5 s at a receding horizon with ``budget`` seconds of wall time per sample, and plans per sample."""
    random = np.random.default_rng(seed)
    x, current, spent, plans = HANGING, np.zeros(KNOTS), 0.0, 0
    count = round(5.0 / STEP)
    shift = [
        np.interp(np.linspace(0.0, 1.0, KNOTS) + 1 / STEPS, np.linspace(0.0, 1.0, KNOTS), e) for e in np.eye(KNOTS)
    ]
    for _ in range(count):
        begin = time.perf_counter()
        while True:
            current = plan(planner, x, current, random)
            plans += 1
            if time.perf_counter() - begin >= budget:
                break
        spent += float(_state_cost(casadi.DM(x)))
        x = step(x, current[0])[0].full().ravel()
        current = current @ np.array(shift)
    return spent, plans / count


def _state_cost(x: casadi.SX | casadi.DM) -> casadi.SX | casadi.DM:
    pole = WEIGHTS["pole"] * (1 + casadi.cos(x[1]))
    return pole + WEIGHTS["cart"] * x[0] ** 2 + WEIGHTS["velocity"] * casadi.sumsqr(x[2:])


def _difference(a: Planner, b: Planner) -> float:
    """Of the costs, relative."""
    z = SPREAD * np.random.default_rng(0).standard_normal((CANDIDATES, KNOTS))
    ours, theirs = a(HANGING, z), b(HANGING, z)
    return float(np.max(np.abs(ours - theirs) / np.abs(theirs)))


def _race(ours: Planner, theirs: Planner, repeats: int) -> tuple[np.ndarray, np.ndarray]:
    def run(planner: Planner, random: np.random.Generator) -> Callable[[], np.ndarray]:
        return partial(plan, planner, HANGING, np.zeros(KNOTS), random)

    a, b = (run(planner, np.random.default_rng(0)) for planner in (ours, theirs))
    return interleaved(a, b, repeats=repeats, warm_up=5)
