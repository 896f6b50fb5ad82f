"""The landings of the real robot: contact from some of them, and what that predicts of the others.

``python -m vtbdrake_diagrams.cassie_landing.reality FOLDER MODEL`` prints it. FOLDER is ``jumping_data`` of the
repository DAIRLab/cassie_impact_dataset (BSD-3), MODEL the URDF, see `CassieLandingScenario`. A recording begins about
5 ms before the impact and lasts 50 ms; its states come from the robot's own estimator, from encoders and an IMU.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import click
import numpy as np

import vtbdrake as vtb
from vtbdrake.calibration import RolloutCalibration, Window, calibrate_by_rollouts
from vtbdrake.common.arrays import Array
from vtbdrake.recording import Log, Series
from vtbdrake.rollout import RolloutTask, make_executor
from vtbdrake.rollout.executor import run_rollouts
from vtbdrake.testbed import Scenario
from vtbdrake_diagrams.cassie_landing.scenario import MOTORS, PERIOD, SAMPLES, CassieLandingScenario

ROBOT = "sim.sys.cassie"
"""The address of the robot."""
STATE = "plant.state"
"""The name of the measured states in a recording."""
TABLE = "dps.table"
"""The address of the torques that the DPS plays."""
# The joints in the order of the recordings, behind the pelvis. The ankle springs have no encoder.
JOINTS = (
    *MOTORS[:8], "knee_joint_left", "knee_joint_right", "ankle_joint_left", "ankle_joint_right",
    "ankle_spring_joint_left", "toe_left", "ankle_spring_joint_right", "toe_right",
)  # fmt: skip
_ENCODERS = [k for k, joint in enumerate(JOINTS) if not joint.startswith("ankle_spring")]
ENCODED = tuple(JOINTS[k] for k in _ENCODERS)
"""The joints with encoders, in the order of the recordings."""
# Number of positions, pelvis included.
_NQ = 23
# Number of positions of the pelvis: a quaternion and a point.
_BASE_Q = 7
# Number of velocities of the pelvis.
_BASE_V = 6


def landings(folder: Path, scenario: Scenario) -> list[Window]:
    """Return the landings as windows, in the order of their numbers.

    Raises:
        FileNotFoundError: The folder has none.
    """
    rows = _plant_rows(scenario)
    return [_landing(folder / "data", number, rows) for number in _numbers(folder)]


def logs(folder: Path, *, position: str, torque: str) -> list[Log]:
    """Return the landings as logs at their own times, with the joints that have encoders and the motors.

    Args:
        folder: The folder of the recordings.
        position: The name that the positions get, in the order of `ENCODED`.
        torque: The name that the torques get, in the order of `MOTORS`.

    Raises:
        FileNotFoundError: The folder has none.
    """
    recordings = []
    for number in _numbers(folder):
        times, recorded, torques = _arrays(folder / "data", number)
        joints = Series(times, recorded[:, [_BASE_Q + k for k in _ENCODERS]])
        recordings.append(Log(f"landing {number}", {position: joints}, {torque: Series(times, torques)}))
    return recordings


def _numbers(folder: Path) -> list[str]:
    numbers = sorted(path.stem[2:] for path in folder.glob("data/t_*.npy"))
    if not numbers:
        raise FileNotFoundError(f"{folder} has no landings, data/t_00.npy, ...")
    return numbers


def _arrays(folder: Path, number: str) -> tuple[Array, Array, Array]:
    """Return times (n,), states (n, 45) and torques (n, 10) of a landing, as recorded."""
    times, recorded, torques = (np.load(folder / f"{letter}_{number}.npy") for letter in "txu")
    return times, recorded, torques


def _plant_rows(scenario: Scenario) -> Array:
    """Return the entry of the plant's state for each entry of a recorded one, (45,)."""
    plant = scenario.build().plant
    assert plant is not None
    joints = [plant.GetJointByName(joint) for joint in JOINTS]
    positions = [*range(_BASE_Q), *(joint.position_start() for joint in joints)]
    velocities = [*range(_BASE_V), *(joint.velocity_start() for joint in joints)]
    return np.array([*positions, *(plant.num_positions() + k for k in velocities)])


def _landing(folder: Path, number: str, rows: Array) -> Window:
    times, recorded, torques = _arrays(folder, number)
    grid = PERIOD * np.arange(SAMPLES)
    # The times of the recording are the messages' times.
    samples = np.column_stack([np.interp(grid, times, column) for column in recorded.T])
    samples[:, :4] /= np.linalg.norm(samples[:, :4], axis=1, keepdims=True)
    latest = np.maximum(np.searchsorted(times, grid + 0.1 * PERIOD, side="right") - 1, 0)
    start = {
        f"{ROBOT}.pelvis.position": samples[0, :_BASE_Q],
        f"{ROBOT}.pelvis.velocity": samples[0, _NQ : _NQ + _BASE_V],
        TABLE: torques[latest].ravel(),
    }
    for k, joint in enumerate(JOINTS):
        start[f"{ROBOT}.{joint}.position"] = samples[0, _BASE_Q + k]
        start[f"{ROBOT}.{joint}.velocity"] = samples[0, _NQ + _BASE_V + k]
    states = np.empty_like(samples)
    states[:, rows] = samples
    return Window(grid, [start], {STATE: states}, f"landing {number}")


def errors(rows: Array, measured: Array, simulated: Array) -> Array:
    """Return the means over time of the errors of states (n, 45).

    These are the error of the pelvis' velocity in m/s, and the root mean squares over the joints with encoders of their
    positions in rad and velocities in rad/s.
    """
    e = (simulated - measured)[:, rows]
    joints = [_BASE_Q + k for k in _ENCODERS], [_NQ + _BASE_V + k for k in _ENCODERS]
    pelvis = np.linalg.norm(e[:, _NQ + 3 : _NQ + 6], axis=1).mean()
    return np.array([pelvis, *(np.sqrt((e[:, part] ** 2).mean(axis=1)).mean() for part in joints)])


def calibrated(windows: Sequence[Window], scenario: CassieLandingScenario) -> RolloutCalibration:
    """Return the calibration of the contact by the velocities of the joints."""
    rows = _plant_rows(scenario)

    def loss(times: Array, measured: Mapping[str, Array], simulated: Mapping[str, Array]) -> float:
        return float(errors(rows, measured[STATE], simulated[STATE])[2])

    parameters = [
        vtb.Parameter("scenario.friction", 0.1, 1.5),
        vtb.Parameter("scenario.stiffness", 2e3, 2e5, log=True),
        vtb.Parameter("scenario.relaxation_time", 1e-4, 0.1, log=True),
    ]
    return calibrate_by_rollouts(scenario, windows, parameters, loss, points=24, executor="serial")


def predicted(windows: Sequence[Window], scenario: Scenario) -> Array:
    """Return the errors (windows, 3) of landings that are predicted from their first states and their torques."""
    rows = _plant_rows(scenario)
    task = RolloutTask(scenario=scenario, horizon=(SAMPLES - 1) * PERIOD, sample_period=PERIOD, record=(STATE,))
    starts = [window.starts[0] for window in windows]
    with make_executor("serial", testbed=scenario.build(), rollouts=len(starts)) as opened:
        results = run_rollouts(opened, task, starts, progress=False)
    motions = [np.asarray(result.record[STATE]) for result in results if result is not None]
    return np.array([errors(rows, w.record[STATE], x) for w, x in zip(windows, motions, strict=True)])


@click.command()
@click.argument("folder", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.argument("model", type=click.Path(exists=True, dir_okay=False))
def main(folder: Path, model: str) -> None:
    """Calibrate the contact with every second landing in FOLDER, and predict the others."""
    scenario = CassieLandingScenario(model=model)
    windows = landings(folder, scenario)
    fitted, rest = windows[::2], windows[1::2]
    calibration = calibrated(fitted, scenario)
    print(f"{len(rest)} landings that the calibration has not seen, 50 ms each; medians (and the worst)\n")
    print(f"{'':16}{'pelvis / m/s':>22}{'joints / rad':>22}{'joints / rad/s':>22}")
    scenarios = {
        "without contact": CassieLandingScenario(model=model, contact=False),
        "defaults": scenario,
        "calibrated": calibration.scenario,
    }
    for name, each in scenarios.items():
        table = predicted(rest, each)
        cells = (f"{np.median(column):.3f} ({column.max():.3f})".rjust(22) for column in table.T)
        print(f"{name:16}" + "".join(cells))
    print(f"\n{calibration}")


if __name__ == "__main__":
    main()
