"""Processor time of the calibration of an arm (18 numbers, a recording at 1 kHz) beside MuJoCo's sysid."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from functools import partial
from pathlib import Path

import numpy as np

import vtbdrake as vtb
from benchmarks.measure import LOWER, Benchmark
from tests.verification.mjcf import mjcf
from vtbdrake.calibration import calibrate
from vtbdrake.common.arrays import Array
from vtbdrake.rollout import RolloutRunner, RolloutTask
from vtbdrake_diagrams.manipulator.studies.excited import PLAN, ExcitedArmScenario
from vtbdrake_diagrams.manipulator.studies.self_test import DELAY, PARAMETERS, PAYLOAD, POSITION, TORQUE, arm, motion

SECONDS = 60.0
"""The duration of the recording, in seconds."""
WINDOW = 200
"""Steps of a rollout of MuJoCo's: longer ones run away from the recording."""
RECORD = {POSITION: "dps.env.joint_position", TORQUE: "dps.joint_torque"}
# mujoco.sysid has dependencies that nothing else here needs.
SYSID, SYSID_ENVIRONMENT = "mujoco[sysid]==4.0.0", Path(__file__).parents[1] / ".venv-sysid"


def calibration_time() -> Benchmark:
    """Processor time to calibrate, relative to MuJoCo's sysid with the same recording."""
    scenario = arm()
    testbed = scenario.build()
    default = testbed.default_context()
    start = {p.address: float(testbed.read(default, p.address)) for p in PARAMETERS}
    generator = np.random.default_rng(0)
    truth = {p.address: float(p.lower + (p.upper - p.lower) * generator.uniform(0.2, 0.8)) for p in PARAMETERS}
    truth[DELAY] = 2.0
    times, q, u, full_world = recorded(scenario, truth)
    log = vtb.read_table({"time": times, "q": q, "u": u}, sense={POSITION: "q"}, act={TORQUE: "u"})
    begin = processor_time()
    result = calibrate(scenario, log, PARAMETERS, position=POSITION, torque=TORQUE)
    took = processor_time() - begin
    errors = [abs(result.parameters[address].value / truth[address] - 1.0) for address in truth if address != DELAY]
    sysid = mujoco_sysid(scenario, truth, start, q, u)
    against = "MuJoCo's sysid on the same recording, whose delay it is told"
    if isinstance(sysid, str):
        return Benchmark(
            name="calibration_time", value=took, unit="s", goal=None, better=LOWER, against=f"nothing: {sysid}"
        )
    seconds, evaluations, values = sysid
    others = [abs(value / truth[address] - 1.0) for address, value in values.items()]
    # MuJoCo's optimizer makes its derivatives by differences, too: what it would take with rollouts of the testbed.
    differences = evaluations * full_world
    return Benchmark(
        name="calibration_time",
        value=took / seconds,
        unit="1",
        goal=0.15,
        better=LOWER,
        against=against,
        note=f"{SECONDS:.0f} s of log: {took:.0f} s, MuJoCo {seconds:.0f} s; median error of {len(errors)} numbers "
        f"{np.median(errors):.1g}, MuJoCo {np.median(others):.1g}; its {evaluations} evaluations by rollouts of the "
        f"testbed: {differences:.0f} s, {differences / took:.0f} times ours",
    )


def processor_time() -> float:
    """Return the time in s that this process and its children have computed."""
    return sum(os.times()[:4])


def recorded(scenario: ExcitedArmScenario, truth: dict[str, float]) -> tuple[Array, Array, Array, float]:
    """Return times, positions and torques of a motion that tells the numbers, and how long the simulation computed."""
    plan = motion(scenario).plan(begin=scenario.period)
    runner = RolloutRunner(
        RolloutTask(scenario=scenario, horizon=SECONDS, sample_period=scenario.period, record=list(RECORD.values()))
    )
    begin = processor_time()
    result = runner.run({PLAN: plan, **truth})
    took = processor_time() - begin
    q, u = (np.asarray(result.record[address])[1:] for address in RECORD.values())
    return result.times[1:], q, u, took


def mujoco_sysid(
    scenario: ExcitedArmScenario, truth: dict[str, float], start: dict[str, float], q: Array, u: Array
) -> tuple[float, int, dict[str, float]] | str:
    """Return MuJoCo's seconds, its evaluations and values, installed apart, or why it does not run here."""
    testbed = scenario.build()
    plant = testbed.plant
    context = plant.GetMyContextFromRoot(testbed.default_context())
    joints = [plant.get_joint(index) for index in plant.GetJointIndices()]
    names = [joint.name() for joint in joints if joint.num_positions() == 1]
    model = mjcf(plant, context, time_step=scenario.period, integrator="implicitfast")
    ours, theirs, factors = [], [], []
    for parameter in PARAMETERS:
        name, factor = parameter.address, 1.0
        if name == DELAY:
            continue
        if name == PAYLOAD:
            kind, where = "mass", "tool"
        elif name.endswith("rotor_inertia"):
            kind, where = "armature", name.split(".")[-2]
            actuator = plant.get_joint_actuator(plant.GetJointActuatorIndices()[names.index(where)])
            factor = actuator.gear_ratio(context) ** 2
        else:
            kind = "frictionloss" if "coulomb" in name else "damping"
            where = names[int(name[-2])]
        ours.append(parameter)
        theirs.append(f"{kind} {where}")
        factors.append(factor)
    scale = np.array(factors)
    # The torque acts after the delay, and one period later as the plant is discrete.
    late = round(truth[DELAY]) + 1
    settings = {
        "model": model,
        "joints": names,
        "names": theirs,
        "start": scale * [start[p.address] for p in ours],
        "lower": scale * [p.lower for p in ours],
        "upper": scale * [p.upper for p in ours],
        "q": q[late:],
        "u": u[:-late],
        "period": scenario.period,
        "steps": WINDOW,
    }
    run = partial(subprocess.run, check=True, capture_output=True, text=True, timeout=3600)
    python = SYSID_ENVIRONMENT / "bin" / "python"
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "arm.npz"
        np.savez(file, **settings)
        try:
            if not python.exists():
                run([sys.executable, "-m", "venv", str(SYSID_ENVIRONMENT)])
            run([str(python), "-m", "pip", "install", "--quiet", SYSID])
            done = run([str(python), str(Path(__file__).with_name("mujoco_sysid.py")), str(file)])
        except (OSError, subprocess.SubprocessError) as error:
            reason = (getattr(error, "stderr", None) or str(error)).strip().splitlines()
            return f"no {SYSID} here ({reason[-1]})"
    answer = json.loads(done.stdout.splitlines()[-1])
    values = np.array(answer["values"]) / scale
    return (
        answer["seconds"],
        answer["evaluations"],
        {p.address: float(value) for p, value in zip(ours, values, strict=True)},
    )
