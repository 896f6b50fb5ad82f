"""The real cube: friction and restitution from some tosses, for each contact model, and how it predicts the others.

``python -m vtbdrake_diagrams.cube_toss.reality FOLDER`` prints it. FOLDER holds ContactNets' tosses as the repository
DAIRLab/dair_pll has them (BSD-3): ``assets/contactnets_cube/*.pt``, states of a motion capture at 148 Hz.
"""

from __future__ import annotations

import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import click
import numpy as np
from matplotlib.figure import Figure
from pydrake.multibody.plant import DiscreteContactApproximation, MultibodyPlantConfig
from pydrake.systems.analysis import SimulatorConfig
from scipy.spatial.transform import Rotation

import vtbdrake as vtb
from vtbdrake.calibration import RolloutCalibration, Window, calibrate_by_rollouts
from vtbdrake.common.arrays import Array
from vtbdrake.recording import Log, Series
from vtbdrake.rollout import RolloutTask, make_executor
from vtbdrake.rollout.executor import run_rollouts
from vtbdrake.testbed import Scenario
from vtbdrake_diagrams.cube_toss.scenario import PERIOD, CubeTossScenario

POSITION = "sim.sys.cube.position"
"""The address of the cube's pose."""
VELOCITY = "sim.sys.cube.velocity"
"""The address of the cube's velocities."""
STATE = "cube_state"
"""The name of the measured states in a recording."""
EDGE = CubeTossScenario().edge
FITTED = 50
"""Number of tosses of the fit."""
FAR = 0.01
"""The position error in m up to which a toss counts as predicted."""

# The scatter of a first sample about the free flight before the first impact: rad, m, rad/s, m/s.
_SCATTER = (2e-3, 1e-4, 0.2, 0.01)
# The points of the search before the fit.
_POINTS = 16


def contact_models() -> dict[str, tuple[CubeTossScenario, vtb.Parameter]]:
    """Return a scenario for each contact model of this Drake, by name, and what restitution depends on in it.

    Discrete models step by 1 ms; the continuous one is integrated to an accuracy.
    """
    relaxation = vtb.Parameter("scenario.relaxation_time", 1e-4, 0.1, log=True)
    dissipation = vtb.Parameter("scenario.dissipation", 0.1, 30.0, log=True)

    def discrete(approximation: str, contact_model: str = "point") -> CubeTossScenario:
        config = MultibodyPlantConfig(
            time_step=1e-3, contact_model=contact_model, discrete_contact_approximation=approximation
        )
        return CubeTossScenario(plant_config=config)

    continuous = CubeTossScenario(
        plant_config=MultibodyPlantConfig(time_step=0.0, contact_model="point"),
        simulator_config=SimulatorConfig(integration_scheme="runge_kutta3", accuracy=1e-4, max_step_size=0.01),
    )
    models = {
        "SAP": (discrete("sap"), relaxation),
        "lagged": (discrete("lagged"), dissipation),
        "similar": (discrete("similar"), dissipation),
        "TAMSI": (discrete("tamsi"), dissipation),
        "hydroelastic SAP": (discrete("sap", "hydroelastic"), relaxation),
        "hydroelastic lagged": (discrete("lagged", "hydroelastic"), dissipation),
        "continuous": (continuous, dissipation),
    }
    if not hasattr(DiscreteContactApproximation, "kTamsi"):  # It was removed after 1.51.
        del models["TAMSI"]
    return models


def recordings(folder: Path) -> list[Log]:
    """Return the tosses, in the order of their numbers; their velocities are expressed in the world.

    Raises:
        FileNotFoundError: The folder has none.
    """
    paths = sorted(folder.glob("*.pt"), key=lambda path: int(path.stem))
    if not paths:
        raise FileNotFoundError(f"{folder} has no tosses, 0.pt, 1.pt, ...")
    return [_toss(path) for path in paths]


def _toss(path: Path) -> Log:
    with zipfile.ZipFile(path) as archive:
        name = next(name for name in archive.namelist() if name.endswith("data/0"))
        states = np.frombuffer(archive.read(name), dtype=np.float64).reshape(-1, 13).copy()
    # The recorded angular velocity is that in the cube's frame.
    states[:, 7:10] = _rotations(states).apply(states[:, 7:10])
    return Log(path.name, {STATE: Series(PERIOD * np.arange(len(states)), states)}, {})


def _rotations(states: Array) -> Rotation:
    """Return the rotations R_WB of states (n, >= 4) that begin with a quaternion w, x, y, z."""
    return Rotation.from_quat(np.roll(states[:, :4], -1, axis=1))


def window(toss: Log, *, starts: int = 1, samples: int | None = None) -> Window:
    """Return a toss as a window from its first sample, and from others within the scatter of the motion capture.

    Args:
        toss: The recording.
        starts: Number of starts; the first one is as measured.
        samples: Number of samples from the first on; None: all.
    """
    series = toss.sense[STATE]
    x = series.values[0]
    rng = np.random.default_rng(int(Path(toss.source).stem))
    noise = rng.normal(size=(starts, 12)) * np.repeat(_SCATTER, 3)
    noise[0] = 0.0
    starting = []
    for e in noise:
        q = np.roll((Rotation.from_rotvec(e[:3]) * _rotations(x[np.newaxis])[0]).as_quat(), 1)
        starting.append({POSITION: np.concatenate([q, x[4:7] + e[3:6]]), VELOCITY: x[7:] + e[6:]})
    return Window(series.times[:samples], starting, {POSITION: series.values[:samples, :7]}, toss.source)


def position_errors(measured: Array, simulated: Array) -> Array:
    """Return the distances (n,) in m of positions (n, 7) of the cube, with their quaternions."""
    return np.asarray(np.linalg.norm(simulated[:, 4:] - measured[:, 4:], axis=1))


def rotation_errors(measured: Array, simulated: Array) -> Array:
    """Return the angles (n,) in rad between orientations in positions (n, 7) of the cube."""
    return np.asarray((_rotations(simulated) * _rotations(measured).inv()).magnitude())


def loss(times: Array, measured: Mapping[str, Array], simulated: Mapping[str, Array]) -> float:
    """Return the mean distance in edges: of the centres, and of the faces' by the rotation."""
    a, b = measured[POSITION], simulated[POSITION]
    return float(np.mean(position_errors(a, b) / EDGE + 0.5 * rotation_errors(a, b)))


def calibrated(
    tosses: Sequence[Log], scenario: CubeTossScenario, restitution: vtb.Parameter, *, starts: int = 1, **options: Any
) -> RolloutCalibration:
    """Return the calibration of friction, and of the parameter that restitution depends on."""
    windows = [window(toss, starts=starts) for toss in tosses]
    parameters = [vtb.Parameter("scenario.friction", 0.05, 0.4), restitution]
    return calibrate_by_rollouts(scenario, windows, parameters, loss, points=_POINTS, **options)


def errors(tosses: Sequence[Log], scenario: Scenario, *, executor: str = "auto") -> Array:
    """Return errors (tosses, 3) of whole tosses that are predicted from their first samples.

    These are the means over time of the position error in percent of the edge, and of the rotation error in degrees,
    as ContactNets and Acosta et al. have them; and the time in s until the position is wrong by 1 cm.
    """
    longest = max(len(toss.sense[STATE]) for toss in tosses) - 1
    task = RolloutTask(scenario=scenario, horizon=longest * PERIOD, sample_period=PERIOD, record=(POSITION,))
    starts = [window(toss).starts[0] for toss in tosses]
    rows = []
    with make_executor(executor, testbed=scenario.build(), rollouts=len(starts)) as opened:
        for toss, result in zip(tosses, run_rollouts(opened, task, starts, progress=False), strict=True):
            assert result is not None
            measured = toss.sense[STATE].values[:, :7]
            simulated = np.asarray(result.record[POSITION])[: len(measured)]
            far = np.flatnonzero(position_errors(measured, simulated) > FAR)
            rows.append(
                [
                    100.0 * position_errors(measured, simulated).mean() / EDGE,
                    np.degrees(rotation_errors(measured, simulated).mean()),
                    PERIOD * (far[0] if far.size else len(measured)),
                ]
            )
    return np.array(rows)


def median_with_interval(values: Array, *, seed: int = 0) -> tuple[float, float, float]:
    """Return the median of values (n,), and its interval of 95 % by a bootstrap."""
    rng = np.random.default_rng(seed)
    medians = np.median(rng.choice(values, size=(1000, len(values))), axis=1)
    lower, upper = np.quantile(medians, [0.025, 0.975])
    return float(np.median(values)), float(lower), float(upper)


def split_tosses(tosses: Sequence[Log]) -> tuple[list[Log], list[Log]]:
    """Return the tosses for the calibration, which fits `FITTED` and keeps a fifth back, and all others."""
    count = min(round(FITTED / 0.8), len(tosses) // 2)
    picked = set(np.random.default_rng(0).permutation(len(tosses))[:count])
    parts: tuple[list[Log], list[Log]] = ([], [])
    for k, toss in enumerate(tosses):
        parts[k not in picked].append(toss)
    return parts


@click.command()
@click.argument("folder", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.option("--model", "names", multiple=True, help="A contact model; by default, all.")
@click.option("--figure", type=click.Path(dir_okay=False, path_type=Path), help="Save a figure of the errors.")
@click.option("--starts", type=click.IntRange(1), default=1, help="Starts of a toss within the scatter of the first.")
@click.option("--as-is", is_flag=True, help="Calibrate nothing, which takes minutes for each model.")
def main(folder: Path, names: tuple[str, ...], figure: Path | None, starts: int, as_is: bool) -> None:
    """Calibrate the contact models with some tosses in FOLDER, and predict the others."""
    fitted, rest = split_tosses(recordings(folder))
    print(f"{len(rest)} tosses that no calibration has seen; medians with intervals of 95 % over them, means behind\n")
    print(f"{'':32}{'position error / % of edge':>34}{'rotation error / deg':>34}{'s until 1 cm':>22}")
    curves: dict[str, Array] = {}
    results: dict[str, RolloutCalibration] = {}
    for name, (scenario, restitution) in contact_models().items():
        if names and name not in names:
            continue
        scenarios: dict[str, Scenario] = {f"{name}, friction 0.18": scenario}
        if not as_is:
            results[name] = calibrated(fitted, scenario, restitution, starts=starts)
            scenarios[f"{name}, calibrated"] = results[name].scenario
        for label, each in scenarios.items():
            curves[label] = errors(rest, each)
            print(f"{label:32}" + "".join(_cells(curves[label])), flush=True)
    for name, result in results.items():
        print(f"\n{name}: {result}")
    if figure is not None:
        plot(curves).savefig(figure, dpi=70)


def _cells(rows: Array) -> list[str]:
    cells = []
    for k, digits in enumerate((1, 1, 3)):
        median, lower, upper = median_with_interval(rows[:, k])
        text = f"{median:.{digits}f} [{lower:.{digits}f}, {upper:.{digits}f}]"
        cells.append(f"{text}, {rows[:, k].mean():.1f}".rjust(34) if k < 2 else text.rjust(22))
    return cells


def plot(curves: Mapping[str, Array]) -> Figure:
    """Return a figure of the shares of tosses with at most some position error, by label."""
    figure = Figure(figsize=(7.0, 4.0), layout="constrained")
    axes = figure.subplots()
    models = list(dict.fromkeys(label.partition(",")[0] for label in curves))
    for label, rows in curves.items():
        values = np.sort(rows[:, 0])
        style, color = "-" if label.endswith("calibrated") else ":", f"C{models.index(label.partition(',')[0])}"
        axes.plot(values, np.arange(1, len(values) + 1) / len(values), style, color=color, label=label)
    axes.set(xlabel="mean position error / % of the edge", ylabel="share of tosses", xlim=(0.0, 80.0), ylim=(0.0, 1.0))
    axes.legend(fontsize="x-small")
    return figure


if __name__ == "__main__":
    main()
