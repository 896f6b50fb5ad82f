"""Steps with contact in a compiled Diagram and in Drake, on one core each: a quadruped, and a climber in its crater."""

from __future__ import annotations

import mujoco
import numpy as np
from pydrake.systems.analysis import Simulator

from benchmarks.measure import HIGHER, Benchmark, interleaved, interleaved_values, processor_time, ratio
from tests.compiled.quadruped import HEIGHT, LEGS, POSTURE, quadruped
from vtbdrake.compiled import CompiledRollouts
from vtbdrake.state.systems import collect
from vtbdrake_diagrams.space_climber import CraterScenario

STEP = 0.005  # s
HORIZON = 2.0  # s
ROLLOUTS = 64
CLIMB = 20.0  # s
CLIMBS = 8


def compiled_contact(repeats: int = 5) -> list[Benchmark]:
    """Compare the time of a step with the same in Drake, by SAP, and in MuJoCo, by its Newton solver."""
    diagram, plant = quadruped("sap", time_step=STEP)
    context = diagram.CreateDefaultContext()
    rollouts = CompiledRollouts(
        diagram, collect(diagram), context, horizon=HORIZON, sample_period=HORIZON, compile=True
    )
    begin = np.tile(rollouts.walker.read(context), (ROLLOUTS, 1))
    model = mujoco.MjModel.from_xml_string(mjcf())

    def in_drake() -> float:
        simulator = Simulator(diagram, context.Clone())
        simulator.AdvanceTo(HORIZON)
        end = plant.GetMyContextFromRoot(simulator.get_context())
        return float(plant.GetPositions(end)[6])

    def compiled() -> float:
        batch = rollouts.from_z(begin, 0.0)
        assert batch.valid.all()
        return float(batch.final[0, 6])

    def in_mujoco() -> float:
        for _ in range(ROLLOUTS // 4):
            data = mujoco.MjData(model)
            mujoco.mj_resetDataKeyframe(model, data, 0)
            mujoco.mj_step(model, data, nstep=round(HORIZON / STEP))
        return float(data.qpos[2])

    heights = compiled(), in_drake(), in_mujoco()
    if abs(heights[0] - heights[1]) > 1e-6:
        raise ArithmeticError(f"the compiled trunk is at {heights[0]} m, Drake's at {heights[1]} m")
    of_drake, of_compiled = interleaved(in_drake, compiled, repeats=repeats)
    of_mujoco, beside = interleaved(in_mujoco, compiled, repeats=repeats)
    steps = round(HORIZON / STEP)
    drake, ours = of_drake / steps, of_compiled / (steps * ROLLOUTS)
    mujocos, again = of_mujoco / (steps * (ROLLOUTS // 4)), beside / (steps * ROLLOUTS)
    note = (
        f"us per step of {1e3 * STEP:g} ms with four contacts: {1e6 * np.median(ours):.3g}, in Drake "
        f"{1e6 * np.median(drake):.4g}, in MuJoCo {1e6 * np.median(mujocos):.3g}; the trunk at {heights[0]:.4f}, "
        f"{heights[1]:.4f}, {heights[2]:.4f} m; n = {repeats}"
    )
    return [
        Benchmark(
            name=f"compiled_contact_{name}",
            value=ratio(theirs, mine),
            unit="1",
            goal=goal,
            better=HIGHER,
            against=against,
            note=note,
        )
        for name, theirs, mine, goal, against in (
            ("quadruped", drake, ours, 20.0, "the same steps by Drake's SAP, on one core each"),
            ("quadruped_mujoco", mujocos, again, 1.5, "the same robot in MuJoCo, Newton solver, on one core each"),
        )
    ]


def compiled_contact_climber(repeats: int = 3) -> list[Benchmark]:
    """Compare a mental rollout of the climber in a crater, its DPS included, with the same in Drake, by SAP.

    The second row is the simulated time over the processor time of compiled rollouts.
    """
    scenario = CraterScenario().mental()
    testbed, count = scenario.build(), round(CLIMB / scenario.period)
    headings = np.radians(np.linspace(-45.0, 45.0, CLIMBS))
    rollouts = testbed.compiled(
        horizon=CLIMB, sample_period=2.0, parameters=["u.heading"], outputs=["sim.sys.climber.base.height"]
    )

    def in_drake() -> None:
        context = testbed.default_context()
        testbed.write(context, {"u.heading": headings[0]})
        testbed.simulator(context).AdvanceTo(CLIMB)

    def compiled() -> None:
        assert rollouts({"u.heading": headings}).valid.all()

    of_drake, of_compiled = interleaved_values(
        lambda: processor_time(in_drake), lambda: processor_time(compiled), repeats=repeats
    )
    drake, ours = of_drake / count, of_compiled / (count * CLIMBS)
    note = (
        f"us of processor time per step of {1e3 * scenario.period:g} ms with DPS and sensors: "
        f"{1e6 * np.median(ours):.3g}, in Drake {1e6 * np.median(drake):.4g}; n = {repeats}"
    )
    rows = (
        ("compiled_contact_climber", ratio(drake, ours), 20.0, "the same rollout by Drake's SAP, on one core each"),
        ("compiled_contact_climber_rtf", float(scenario.period / np.median(ours)), 600.0, "real time, on one core"),
    )
    return [
        Benchmark(name=name, value=value, unit="1", goal=goal, better=HIGHER, against=against, note=note)
        for name, value, goal, against in rows
    ]


def mjcf() -> str:
    """Return the quadruped for MuJoCo, with the same masses, feet and joint PD; its contact is MuJoCo's."""
    legs = ""
    for number, (front, left) in enumerate(LEGS):
        legs += f"""
        <body pos="{0.18 * front} {0.05 * left} 0">
          <inertial pos="0 0 0" mass="0.7" diaginertia="0.0005 0.0005 0.0005"/>
          <joint name="hip_{number}" axis="1 0 0"/>
          <body pos="0 {0.09 * left} 0">
            <inertial pos="0 0 -0.1" mass="1" diaginertia="0.005 0.005 0.001"/>
            <joint name="thigh_{number}" axis="0 1 0"/>
            <body pos="0 0 -0.2">
              <inertial pos="0 0 -0.1" mass="0.15" diaginertia="0.002 0.002 0.0001"/>
              <joint name="knee_{number}" axis="0 1 0"/>
              <geom type="sphere" size="0.02" pos="0 0 -0.2" contype="1" conaffinity="2"/>
            </body>
          </body>
        </body>"""
    joints = [f"{kind}_{number}" for number in range(len(LEGS)) for kind in POSTURE]
    posture = " ".join(str(angle) for _ in LEGS for angle in POSTURE.values())
    motors = "".join(f'<position joint="{joint}" kp="60" kv="2"/>' for joint in joints)
    return f"""
    <mujoco>
      <option timestep="{STEP}" integrator="implicitfast"/>
      <default><joint armature="0.01" damping="0.1"/><geom friction="0.8"/></default>
      <worldbody>
        <geom type="plane" size="5 5 0.1" contype="2" conaffinity="1"/>
        <body pos="0 0 {HEIGHT}">
          <freejoint/>
          <inertial pos="0 0 0" mass="6" diaginertia="0.02 0.06 0.07"/>{legs}
        </body>
      </worldbody>
      <actuator>{motors}</actuator>
      <keyframe><key qpos="0 0 {HEIGHT} 1 0 0 0 {posture}" ctrl="{posture}"/></keyframe>
    </mujoco>"""
