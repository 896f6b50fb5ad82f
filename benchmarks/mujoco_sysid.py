"""MuJoCo's system identification of an arm, timed: a program for an interpreter that has `mujoco[sysid]`, and no Drake.

``python mujoco_sysid.py FILE`` reads a file of NumPy with the model (MJCF without actuators), the recording and the
start, and prints a JSON object: ``{"version", "seconds", "evaluations", "names", "values"}``, with seconds of processor
time, and how often the recording was simulated. Each window of the recording is a rollout from its smoothed state, as
the recording as a whole cannot be followed without a controller.
"""

from __future__ import annotations

import json
import sys
import time
from importlib.metadata import version

import mujoco
import numpy as np
from mujoco import sysid
from scipy.signal import savgol_filter


def main() -> None:
    """Identify the arm of the file."""
    data = np.load(sys.argv[1])
    spec = mujoco.MjSpec.from_string(str(data["model"]))
    joints = [str(name) for name in data["joints"]]
    for name in joints:
        spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        spec.add_sensor(
            name=f"{name}_q", type=mujoco.mjtSensor.mjSENS_JOINTPOS, objname=name, objtype=mujoco.mjtObj.mjOBJ_JOINT
        )
    parameters = sysid.ParameterDict()
    for name, start, lower, upper in zip(data["names"], data["start"], data["lower"], data["upper"], strict=True):
        kind, where = str(name).split(" ")
        parameters.add(
            sysid.Parameter(str(name), float(start), float(lower), float(upper), modifier=modifier(kind, where))
        )
    q, u, period, steps = data["q"], data["u"], float(data["period"]), int(data["steps"])
    v = savgol_filter(q, 15, 3, deriv=1, delta=period, axis=0)
    model = spec.compile()
    sensors = sysid.TimeSeries.compute_all_sensor_mapping(model)
    times = period * np.arange(steps + 1)
    windows = range(0, len(q) - steps, steps)
    sequences = sysid.ModelSequences(
        "arm",
        spec,
        [str(k) for k in windows],
        [sysid.create_initial_state(model, q[k], v[k]) for k in windows],
        [sysid.TimeSeries(times, u[k : k + steps + 1]) for k in windows],
        [sysid.TimeSeries(times, q[k : k + steps + 1], sensors) for k in windows],
    )
    scale, rollouts = 1.0 / np.std(q, axis=0), 0

    def difference(_parameters, predicted, measured, *_arguments, **_options):
        nonlocal rollouts
        rollouts += 1
        # Theirs divides by the norm of each joint's window, so that only windows in which a joint is near zero count.
        predicted = predicted.resample(measured.times)
        return (measured.data - predicted.data)[1:] * scale, predicted, measured

    residual = sysid.build_residual_fn(models_sequences=[sequences], modify_residual=difference)
    begin = time.process_time()
    fitted, _ = sysid.optimize(parameters, residual, optimizer="mujoco", verbose=False)
    took = time.process_time() - begin
    answer = {
        "version": version("mujoco"),
        "seconds": took,
        "evaluations": rollouts // len(windows),
        "names": [str(name) for name in data["names"]],
        "values": fitted.as_vector().tolist(),
    }
    print(json.dumps(answer))


def modifier(kind: str, where: str):
    """Return what sets a number of a model: ``mass`` of a body, or ``frictionloss``, ``damping``, ``armature``."""

    def modify(spec: mujoco.MjSpec, parameter: sysid.Parameter) -> None:
        value = float(np.ravel(parameter.value)[0])
        if kind == "mass":
            body = spec.body(where)
            # A body's inertia grows with its mass.
            body.fullinertia = body.fullinertia * (value / body.mass)
            body.mass = value
        elif kind == "damping":
            spec.joint(where).damping[0] = value
        else:
            setattr(spec.joint(where), kind, value)

    return modify


main()
