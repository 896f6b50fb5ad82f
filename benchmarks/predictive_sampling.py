"""Planning by predictive sampling on a cart-pole: a compiled plant and a compiled testbed, beside MuJoCo's `rollout`.

All plan with the same model, the same step (semi-implicit Euler with implicit damping), the same knots, number of
candidates, horizon and cost.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import casadi
import mujoco
import mujoco.rollout
import numpy as np
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant

from benchmarks.measure import HIGHER, LOWER, Benchmark, interleaved, ratio, seconds
from vtbdrake.common.spline import Spline
from vtbdrake.components.compiled_plant import PlantRollouts, plant_step
from vtbdrake_diagrams.cart_pole import CartPoleScenario
from vtbdrake_diagrams.cart_pole.decision import cost
from vtbdrake_diagrams.cart_pole.model import CART_POLE_SDF, JOINT_NAMES, CartPole
from vtbdrake_diagrams.cart_pole.swing_up import make_reasoner

SCENARIO = CartPoleScenario()
CANDIDATES, STEP = 32, SCENARIO.period
STEPS = round(SCENARIO.duration / STEP)
PLAN: Spline = SCENARIO.plan()
LIMIT, SPREAD = SCENARIO.force_limit, 20.0  # N: of the force, and of the candidates about the plan in use
B = PLAN.matrix(STEP * np.arange(STEPS))
HANGING = np.array([0.0, 0.05, 0.0, 0.0])
TOLERANCE = 1e-9
# judo needs an older MuJoCo than this one.
JUDO, JUDO_ENVIRONMENT = "judo-rai==0.1.0", Path(__file__).parents[1] / ".venv-judo"

# The costs of candidates z, shape (n, K), from the state x0 = [q; v]; the result has the shape (n,).
Planner = Callable[[np.ndarray, np.ndarray], np.ndarray]


def predictive_sampling(repeats: int = 200, seeds: int = 8) -> list[Benchmark]:
    """Plans per second by a compiled plant and by MuJoCo, and how good the swing-ups are at equal wall time."""
    step = cart_pole_step()
    ours = compiled_planner(step)
    theirs = mujoco_planners()
    apart = max(_difference(ours, planner) for planner in theirs.values())
    if not apart <= TOLERANCE:
        raise ArithmeticError(f"the costs of the two engines are {apart:.2g} apart")
    times = {name: interleaved(_planning(ours), _planning(p), repeats=repeats, warm_up=5) for name, p in theirs.items()}
    fastest, (planner_times, mujoco_times) = min(times.items(), key=lambda item: float(np.median(item[1][1])))
    budget = float(np.median(mujoco_times))
    swings = {
        name: [swing_up(step, planner, budget, seed=seed) for seed in range(seeds)]
        for name, planner in (("compiled", ours), ("MuJoCo", theirs[fastest]))
    }
    costs = {name: float(np.median([spent for spent, _ in runs])) for name, runs in swings.items()}
    plans = {name: float(np.median([count for _, count in runs])) for name, runs in swings.items()}
    micros = ", ".join(f"{1e6 * np.median(t):.0f} ({name})" for name, (_, t) in times.items())
    return [
        Benchmark(
            name="predictive_sampling",
            value=ratio(mujoco_times, planner_times),
            unit="1",
            goal=10.0,
            better=HIGHER,
            against=f"plans per second of mujoco.rollout {mujoco.__version__}, {fastest}",
            note=f"us per plan of {CANDIDATES} rollouts of {STEPS * STEP:g} s: {1e6 * np.median(planner_times):.0f}, "
            f"MuJoCo {micros}, {judo(repeats)}; costs {apart:.1g} apart; n = {repeats}",
        ),
        Benchmark(
            name="predictive_sampling_quality",
            value=costs["compiled"] / costs["MuJoCo"],
            unit="1",
            goal=None,
            better=LOWER,
            against=f"MuJoCo's swing-up at the same wall time, {1e3 * budget:.2g} ms for each {1e3 * STEP:g} ms",
            note=f"cost of 5 s, median of {seeds} seeds: {costs['compiled']:.3g} with {plans['compiled']:.0f} plans "
            f"for each sample, MuJoCo {costs['MuJoCo']:.3g} with {plans['MuJoCo']:.0f}",
        ),
    ]


def predictive_sampling_testbed(repeats: int = 200, decisions: int = 40) -> Benchmark:
    """Plans per second in the compiled testbed, with its sensors, switches and DPS, and by MuJoCo with a bare model."""
    testbed = SCENARIO.build()
    ours = compiled_testbed_planner()
    times = {
        name: interleaved(_planning(ours), _planning(planner), repeats=repeats, warm_up=5)
        for name, planner in mujoco_planners().items()
    }
    fastest, (planner_times, mujoco_times) = min(times.items(), key=lambda item: float(np.median(item[1][1])))
    context = testbed.default_context()
    taken = {}
    for executor in ("compiled", "threads"):
        with make_reasoner(SCENARIO, rollouts=CANDIDATES, executor=executor) as reasoner:
            reasoner.decide(testbed, context)
            taken[executor] = [seconds(partial(reasoner.decide, testbed, context)) for _ in range(decisions)]
    return Benchmark(
        name="predictive_sampling_testbed",
        value=ratio(mujoco_times, planner_times),
        unit="1",
        goal=4.0,
        better=HIGHER,
        against=f"plans per second of mujoco.rollout {mujoco.__version__} of the bare model, {fastest}",
        note=f"us per plan of {CANDIDATES} rollouts of {STEPS * STEP:g} s: {1e6 * np.median(planner_times):.0f}, "
        f"MuJoCo {1e6 * np.median(mujoco_times):.0f}; ms per decision of a reasoner with as many rollouts: "
        f"{1e3 * np.median(taken['compiled']):.1f}, in Drake {1e3 * np.median(taken['threads']):.0f}; n = {repeats}",
    )


def compiled_testbed_planner() -> Planner:
    """Planner with rollouts of the mental testbed: the plan goes through the DPS, which has its delays."""
    testbed = SCENARIO.mental().build()
    rollouts = testbed.compiled(
        horizon=STEPS * STEP,
        sample_period=STEP,
        parameters=["u.plan"],
        outputs=["plant.state"],
        compile=True,
        check=True,
    )
    joints = [f"sim.sys.cart_pole.{joint}" for joint in JOINT_NAMES]
    entries = [f"{joint}.{kind}" for kind in ("position", "velocity") for joint in joints]

    def costs(x0: np.ndarray, z: np.ndarray) -> np.ndarray:
        plans = np.column_stack([np.zeros(len(z)), z])
        begin = dict(zip(entries, x0.tolist(), strict=True))
        states = rollouts({"u.plan": plans, **begin}).outputs["plant.state"]
        return STEP * _state_costs(states).sum(axis=1)

    return costs


def cart_pole_step() -> casadi.Function:
    """The step of Drake's cart-pole, read from its SDF file."""
    plant = MultibodyPlant(STEP)
    Parser(plant).AddModels(str(CART_POLE_SDF))
    plant.Finalize()
    return plant_step(plant, plant.CreateDefaultContext())


def compiled_planner(step: casadi.Function) -> Planner:
    rollouts = PlantRollouts(
        step,
        control=B,
        cost=lambda x, u: STEP * _state_cost(x),
        final_cost=lambda x: STEP * _state_cost(x),
        compile=True,
    )
    return lambda x0, z: rollouts(x0, z).costs


def mujoco_model() -> str:
    """The cart-pole for MuJoCo, with the numbers of `CartPole`."""
    m = CartPole()
    return f"""
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
          <actuator><motor joint="slider" ctrllimited="true" ctrlrange="-{LIMIT} {LIMIT}"/></actuator>
        </mujoco>"""


def judo(repeats: int) -> str:
    """Say how long a plan of judo takes, or why it does not run here."""
    settings = {
        "model": mujoco_model(),
        "candidates": CANDIDATES,
        "knots": PLAN.knots,
        "horizon": SCENARIO.duration,
        "spread": SPREAD,
        "state": HANGING.tolist(),
        "repeats": repeats,
    }
    try:
        answer = judo_answer(settings)
    except (OSError, subprocess.SubprocessError) as error:
        return without_judo(error)
    expected = float(mujoco_planner(1)(HANGING, np.zeros((1, PLAN.knots)))[0])
    # It leaves out the cost of the present state.
    apart = abs(answer["cost"] + STEP * cost(HANGING) - expected) / expected
    return f"{JUDO} {1e6 * np.median(answer['seconds']):.0f} (cost of a plan without force {apart:.1g} apart)"


def judo_answer(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return what `benchmarks.judo_plans` prints for these settings; it installs judo in an environment of its own.

    Raises:
        OSError: Python cannot be run.
        subprocess.SubprocessError: judo cannot be installed, or fails.
    """
    python = JUDO_ENVIRONMENT / "bin" / "python"
    run = partial(subprocess.run, check=True, capture_output=True, text=True, timeout=900)
    if not python.exists():
        run([sys.executable, "-m", "venv", str(JUDO_ENVIRONMENT)])
    run([str(python), "-m", "pip", "install", "--quiet", JUDO, f"casadi=={casadi.__version__}"])
    done = run([str(python), str(Path(__file__).with_name("judo_plans.py"))], input=json.dumps(settings))
    answer: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return answer


def without_judo(error: Exception) -> str:
    """Say why judo does not run here."""
    reason = (getattr(error, "stderr", None) or str(error)).strip().splitlines()
    return f"no {JUDO} here ({reason[-1]})"


def mujoco_planners() -> dict[str, Planner]:
    """Return one planner per number of threads, which the key tells as text."""
    return {"1 thread": mujoco_planner(1), "2 threads": mujoco_planner(2)}


def mujoco_planner(threads: int) -> Planner:
    model = mujoco.MjModel.from_xml_string(mujoco_model())
    data = [mujoco.MjData(model) for _ in range(threads)]
    kind = mujoco.mjtState.mjSTATE_FULLPHYSICS
    first = np.zeros(mujoco.mj_stateSize(model, kind))
    states = np.zeros((CANDIDATES, STEPS, first.size))
    sensors = np.zeros((CANDIDATES, STEPS, model.nsensordata))
    # One thread is the caller's own.
    pool = mujoco.rollout.Rollout(nthread=threads if threads > 1 else 0)

    def costs(x0: np.ndarray, z: np.ndarray) -> np.ndarray:
        mujoco.mj_getState(model, data[0], first, kind)
        first[0], first[1:5] = 0.0, x0
        u = z @ B.T
        pool.rollout(
            model, data, first[None], u[:, :, None], state=states, sensordata=sensors, skip_checks=False, nstep=STEPS
        )
        after = _state_costs(states[: len(z), :, 1:5]).sum(axis=1)
        return STEP * (after + cost(x0))

    return costs


def plan(planner: Planner, x0: np.ndarray, current: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """The best of the plan in use and of candidates about it, shape (K,)."""
    z = current + SPREAD * random.standard_normal((CANDIDATES, PLAN.knots))
    z[0] = current
    np.clip(z, -LIMIT, LIMIT, out=z)
    return z[np.argmin(planner(x0, z))]


def swing_up(step: casadi.Function, planner: Planner, budget: float, *, seed: int) -> tuple[float, float]:
    """Cost of 5 s at a receding horizon with ``budget`` seconds of wall time per sample, and plans per sample."""
    random = np.random.default_rng(seed)
    x, current, spent, plans = HANGING, np.zeros(PLAN.knots), 0.0, 0
    count, shift = round(5.0 / STEP), PLAN.shift(STEP)
    for _ in range(count):
        begin = time.perf_counter()
        while True:
            current = plan(planner, x, current, random)
            plans += 1
            if time.perf_counter() - begin >= budget:
                break
        spent += STEP * cost(x)
        x = step(x, current[0])[0].full().ravel()
        current = shift @ current
    return spent, plans / count


def _state_cost(x: Any) -> Any:
    """The same as `cost`, as an expression of CasADi."""
    return 1.0 + casadi.cos(x[1]) + 0.1 * x[0] ** 2 + 0.01 * casadi.sumsqr(x[2:])


def _state_costs(x: np.ndarray) -> np.ndarray:
    """The same as `cost`, of many states, shape (..., 4)."""
    return 1.0 + np.cos(x[..., 1]) + 0.1 * x[..., 0] ** 2 + 0.01 * (x[..., 2] ** 2 + x[..., 3] ** 2)


def _difference(a: Planner, b: Planner) -> float:
    """Return the largest relative difference between the costs of two planners."""
    z = np.clip(SPREAD * np.random.default_rng(0).standard_normal((CANDIDATES, PLAN.knots)), -LIMIT, LIMIT)
    ours, theirs = a(HANGING, z), b(HANGING, z)
    return float(np.max(np.abs(ours - theirs) / np.abs(theirs)))


def _planning(planner: Planner) -> Callable[[], np.ndarray]:
    return partial(plan, planner, HANGING, np.zeros(PLAN.knots), np.random.default_rng(0))
