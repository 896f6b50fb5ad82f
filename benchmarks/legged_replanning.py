"""A quadruped that is pushed replans its steps: decisions in its own testbed, beside the same planner on MuJoCo.

``python -m benchmarks.legged_replanning [PUSHES [SIZE ...]]`` prints how often the robot falls with MuJoCo's plans, for
the pushes of `vtbdrake_diagrams.quadruped.studies.pushes`.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from functools import partial

import casadi
import mujoco
import mujoco.rollout
import numpy as np
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import Context

from benchmarks.measure import HIGHER, LOWER, Benchmark, interleaved_values, processor_time, ratio, spread
from benchmarks.predictive_sampling import judo_answer, without_judo
from vtbdrake.reasoning import Budget, Reasoner
from vtbdrake.testbed import VirtualTestbed
from vtbdrake_diagrams.quadruped.decision import LIMITS, SIGMA, cost, reasoning
from vtbdrake_diagrams.quadruped.dps import PERCEIVED
from vtbdrake_diagrams.quadruped.gait import OFFSETS, Trot, desired_state
from vtbdrake_diagrams.quadruped.model import JOINT_NAMES, LEGS, QUADRUPED_SDF, RANGES, Quadruped
from vtbdrake_diagrams.quadruped.scenario import QuadrupedScenario, present_angles, present_rates, present_trunk
from vtbdrake_diagrams.quadruped.studies.pushes import SIZES, shares

GOAL = 0.015  # s
# The places of the plant's state in MuJoCo's [time, qpos, qvel].
_DRAKE_ORDER = [4, 5, 6, 7, 1, 2, 3, *range(8, 20), 23, 24, 25, 20, 21, 22, *range(26, 38)]
DEADLINE = "a robot that decides at 50 Hz has 20 ms, and a quarter goes to loop and communication"


def legged_replanning(repeats: int = 60) -> list[Benchmark]:
    """Compare the processor time of a decision with a plan by MuJoCo, while the robot recovers from a push."""
    scenario = QuadrupedScenario()
    testbed = scenario.build()
    budget = Budget(rollouts=scenario.rollouts)
    with Reasoner(scenario=scenario, **reasoning(scenario, "u.plan", budget)) as reasoner:
        reasoner.warm_up()
        context = pushed(testbed)
        planner = MujocoPlanner(scenario)
        state = perceived(testbed, context)
        theirs, ours = interleaved_values(
            partial(processor_time, lambda: planner.plan(state, context.get_time())),
            partial(processor_time, lambda: reasoner.decide(testbed, context)),
            repeats=repeats,
            warm_up=3,
        )
        decision = reasoner.decide(testbed, context)
    assert {rollout.computed for each in decision.candidates for rollout in each.rollouts} == {"compiled"}
    per_plan = f"{scenario.rollouts} rollouts of {scenario.duration:g} s in steps of {scenario.mental_period:g} s"
    return [
        Benchmark(
            name="legged_replanning",
            value=float(np.median(ours)),
            unit="s",
            goal=GOAL,
            better=LOWER,
            against="nothing: the processor time of a decision",
            note=f"{per_plan}: {spread(1e3 * ours, unit='ms')}; plans per second of one core: "
            f"{1.0 / np.median(ours):.0f}, with mujoco.rollout {mujoco.__version__} {1.0 / np.median(theirs):.0f}, "
            f"with {judo(planner, state, repeats)}",
            absolute=DEADLINE,
        ),
        Benchmark(
            name="legged_replanning_mujoco",
            value=ratio(theirs, ours),
            unit="1",
            goal=None,
            better=HIGHER,
            against=f"plans per second of mujoco.rollout {mujoco.__version__}, 1 thread, bare model",
        ),
    ]


def judo(planner: MujocoPlanner, state: np.ndarray, repeats: int) -> str:
    """Say how many plans per second of one core judo makes from a state of the plant, or why it does not run here."""
    scenario, present = QuadrupedScenario(), 0.62
    controls, at_state = judo_functions(scenario)
    settings = {
        "model": mjcf(scenario.mental_period),
        "candidates": scenario.rollouts,
        "knots": scenario.knots,
        # judo takes one step more for each that is begun.
        "horizon": scenario.mental_period * (int(scenario.duration / scenario.mental_period + 1e-9) - 0.5),
        "spread": float(SIGMA * 2.0 * LIMITS[0]),
        "limits": LIMITS.tolist(),
        "state": _full_physics(state, present)[1:].tolist(),
        "time": present,
        "controls": controls.serialize(),
        "cost": at_state.serialize(),
        "repeats": repeats,
    }
    try:
        answer = judo_answer(settings)
    except (OSError, subprocess.SubprocessError) as error:
        return without_judo(error)
    expected = float(planner.costs(np.zeros((scenario.rollouts, scenario.knots, len(OFFSETS))), state, present)[0])
    apart = abs(answer["cost"] - expected) / expected
    rate = 1.0 / np.median(answer["processor"])
    return f"judo-rai {answer['version']} {rate:.0f} (cost of the trot without offsets {apart:.1g} apart)"


def judo_functions(scenario: QuadrupedScenario) -> tuple[casadi.Function, casadi.Function]:
    """Return the functions of `benchmarks.judo_plans`: (offsets, t) -> controls, (MuJoCo's [q; v], offsets) -> cost."""
    gains, step = Quadruped(), scenario.mental_period
    offset, t, state = casadi.SX.sym("offset", len(OFFSETS)), casadi.SX.sym("t"), casadi.SX.sym("state", 37)
    # A plan that stays at these offsets.
    plan = casadi.vertcat(t, *[offset] * scenario.knots)
    desired, _ = desired_state(gains, Trot(), scenario.plan(), lead=step)(plan, casadi.SX.zeros(2), t)
    controls = desired[:12] + gains.damping / gains.stiffness * desired[12:]
    drake = casadi.vertcat(t, state)[_DRAKE_ORDER]
    return (
        casadi.Function("controls", [offset, t], [controls]),
        casadi.Function("cost", [state, offset], [casadi.substitute(cost(drake, np.zeros(2), offset), t, 0.0)]),
    )


def pushed(testbed: VirtualTestbed) -> Context:
    """Return a context of a robot that has just been pushed."""
    context = testbed.default_context()
    testbed.write(context, {"sim.env.push.impulse": [0.0, 20.0, 0.0], "sim.env.push.begin": 0.5})
    testbed.simulator(context).AdvanceTo(0.62)
    return context


def perceived(testbed: VirtualTestbed, context: Context) -> np.ndarray:
    """Return the present state of the plant, shape (37,), as the DPS believes it to be."""
    state, late = np.array(testbed.read(context, PERCEIVED)), 2.0 * QuadrupedScenario().period
    pose, twist = present_trunk(state, late=late)
    return np.concatenate([pose, present_angles(state, late=late), twist, present_rates(state, late=late)])


class MujocoPlanner:
    """Predictive sampling with `mujoco.rollout`, as the reasoner does it: the same trot, knots, limits, cost and step.

    Args:
        scenario: The robot's scenario.

    Attributes:
        knots: The plan in use, shape (n, 6).
        begin: The time at which it begins, in s.
    """

    def __init__(self, scenario: QuadrupedScenario) -> None:
        self._scenario, self._spline = scenario, scenario.plan()
        self.knots, self.begin = np.zeros((scenario.knots, len(OFFSETS))), 0.0
        self._random = np.random.default_rng(0)
        self._step = scenario.mental_period
        self._steps = int(scenario.duration / self._step + 1e-9)
        self._model = mujoco.MjModel.from_xml_string(mjcf(self._step))
        self._data = [mujoco.MjData(self._model)]
        n = scenario.rollouts * self._steps
        trot = desired_state(Quadruped(), Trot(), self._spline, lead=self._step)
        self._trot = trot.map(n)

    def plan(self, state: np.ndarray, time: float) -> np.ndarray:
        """Return the best of the plan in use, shifted to ``time``, and of candidates about it: [t_begin, knots].

        Args:
            state: The state of the plant, [q; v], shape (37,).
            time: The present time in s.
        """
        sites = time - self.begin + self._spline.step * np.arange(self._spline.knots)
        mean = self._spline.matrix(sites) @ self.knots
        count = self._scenario.rollouts
        z = mean + SIGMA * 2.0 * LIMITS * self._random.standard_normal((count, *mean.shape))
        z[0] = mean
        np.clip(z, -LIMITS, LIMITS, out=z)
        best = z[np.argmin(self.costs(z, state, time))]
        return np.concatenate([[time], best.ravel()])

    def costs(self, z: np.ndarray, state: np.ndarray, time: float) -> np.ndarray:
        """Return the costs of candidates, shape (count,).

        Args:
            z: The knots of the candidates, shape (count, n, 6).
            state: The state of the plant, shape (37,).
            time: The time of the state, at which the candidates begin, in s. The plan in use holds for a period.
        """
        count, steps = len(z), self._steps
        times = time + self._step * np.arange(steps)
        plans = np.column_stack([np.full(count, time), z.reshape(count, -1)])
        plans = np.repeat(plans[:, np.newaxis], steps, axis=1)
        late = round(self._scenario.thinking_period / self._step)
        plans[:, :late] = np.concatenate([[self.begin], self.knots.ravel()])
        velocity = np.zeros((2, count * steps))
        desired, offset = self._trot(plans.reshape(count * steps, -1).T, velocity, np.tile(times, count)[np.newaxis])
        gains = Quadruped()
        q, v = np.split(desired.full().T.reshape(count, steps, -1), 2, axis=2)
        controls = q + gains.damping / gains.stiffness * v
        states, _ = mujoco.rollout.rollout(self._model, self._data, _full_physics(state, time)[np.newaxis], controls)
        drake = _states_of_drake(states)
        offsets = offset.full().T.reshape(count, steps, -1)
        values = cost(np.moveaxis(drake, -1, 0), np.zeros(2), np.moveaxis(offsets, -1, 0))
        return np.where(np.isfinite(values), values, 1e6).sum(axis=1)


def _full_physics(state: np.ndarray, time: float) -> np.ndarray:
    """Return MuJoCo's [time, qpos, qvel] of a state of the plant."""
    w, x, y, z = state[:4]
    R = np.zeros(9)
    mujoco.mju_quat2Mat(R, np.array([w, x, y, z]))
    rates = R.reshape(3, 3).T @ state[19:22]
    return np.concatenate([[time], state[4:7], state[:4], state[7:19], state[22:25], rates, state[25:]])


def _states_of_drake(states: np.ndarray) -> np.ndarray:
    """Return states in the plant's order, with the trunk's rates in its own frame: the cost takes their length."""
    return states[..., _DRAKE_ORDER]


def mjcf(step: float) -> str:
    """Return the quadruped for MuJoCo, with the same masses, feet and drives; its contact is MuJoCo's.

    Args:
        step: The time step in s.
    """
    m, plant = Quadruped(), MultibodyPlant(step)
    Parser(plant).AddModels(str(QUADRUPED_SDF))
    plant.Finalize()
    legs = ""
    for leg, (front, left) in LEGS.items():
        hub, femur, tibia = (_inertial(plant, f"{leg}_{link}") for link in ("hub", "femur", "tibia"))
        legs += f"""
        <body pos="{front * m.hip_x} {left * m.hip_y} 0">{hub}
          <joint name="{leg}_hip" axis="1 0 0"/>
          <body pos="0 {left * m.hip_length} 0">{femur}
            <joint name="{leg}_thigh" axis="0 1 0"/>
            <body pos="0 0 {-m.link}">{tibia}
              <joint name="{leg}_knee" axis="0 1 0"/>
              <geom type="sphere" size="{m.foot_radius}" pos="0 0 {-m.link}"/>
              <geom type="sphere" size="{m.foot_radius}"/>
            </body>
          </body>
        </body>"""
    names = [f"{leg}_{kind}" for leg in LEGS for kind in RANGES]
    assert tuple(names) == JOINT_NAMES
    drives = "".join(
        f'<position joint="{name}" kp="{m.stiffness}" kv="{m.damping}" forcerange="{-m.torque} {m.torque}"/>'
        for name in names
    )
    size = " ".join(str(0.5 * edge) for edge in m.trunk)
    return f"""
    <mujoco>
      <option timestep="{step}" integrator="implicitfast"/>
      <default>
        <joint armature="{m.rotor_inertia}"/>
        <geom friction="{m.friction}" contype="1" conaffinity="2"/>
      </default>
      <worldbody>
        <geom type="plane" size="50 50 0.1" contype="2" conaffinity="1"/>
        <body pos="0 0 {m.stance}">{_inertial(plant, "trunk")}
          <freejoint/>
          <geom type="box" size="{size}"/>{legs}
        </body>
      </worldbody>
      <actuator>{drives}</actuator>
    </mujoco>"""


def _inertial(plant: MultibodyPlant, link: str) -> str:
    """Return the inertia of a link of the plant for MuJoCo."""
    inertia = plant.GetBodyByName(link).default_spatial_inertia()
    about_com = inertia.Shift(inertia.get_com()).CalcRotationalInertia()
    diagonal, products = about_com.get_moments(), about_com.get_products()
    entries = " ".join(f"{entry:.9g}" for entry in (*diagonal, *products))
    com = " ".join(f"{entry:.9g}" for entry in inertia.get_com())
    return f'<inertial pos="{com}" mass="{inertia.get_mass():.9g}" fullinertia="{entries}"/>'


def replanning(testbed: VirtualTestbed) -> Callable[[Context], None]:
    """Return a planner for `fall_time` that decides ``u.plan`` by MuJoCo, and applies it a period later."""
    scenario = testbed.scenario
    assert isinstance(scenario, QuadrupedScenario)
    planner = MujocoPlanner(scenario)
    decided: np.ndarray | None = None

    def replan(context: Context) -> None:
        nonlocal planner, decided
        if context.get_time() == 0.0:
            planner, decided = MujocoPlanner(scenario), None
        if decided is not None:
            testbed.write(context, {"u.plan": decided})
            planner.begin, planner.knots = decided[0], decided[1:].reshape(planner.knots.shape)
        decided = planner.plan(perceived(testbed, context), context.get_time())

    return replan


def main() -> None:
    """Print the shares of falls with MuJoCo's plans, for pushes of all sizes or of these."""
    count, *sizes = [float(argument) for argument in sys.argv[1:]] or [12.0]
    testbed = QuadrupedScenario().build()
    for size in sizes or SIZES:
        result = shares(testbed, size, int(count), replan=replanning(testbed))
        print(f"{size:g} N s: {result} fall, {result.seconds:.2f} s of processor time per s", flush=True)


if __name__ == "__main__":
    main()
