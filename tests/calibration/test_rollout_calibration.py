"""Calibrations by rollouts of a cube on a plane, from motions that closed forms and MuJoCo have made."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache

import numpy as np
import pytest
from pydrake.multibody.plant import MultibodyPlantConfig
from pydrake.systems.analysis import SimulatorConfig
from scipy.optimize import brentq

from vtbdrake.calibration import CalibrationError, RolloutCalibration, Window, calibrate_by_rollouts
from vtbdrake.calibration.calibration_result import Verdict
from vtbdrake.common.arrays import Array
from vtbdrake.optimization import Parameter
from vtbdrake.testbed import ScenarioError
from vtbdrake_diagrams.cart_pole import CartPoleScenario
from vtbdrake_diagrams.cube_toss import CubeTossScenario

POSITION, VELOCITY = "sim.sys.cube.position", "sim.sys.cube.velocity"
FRICTION = Parameter("scenario.friction", 0.05, 0.6)
GRAVITY, PERIOD = 9.81, 0.01
FLAT = np.array([1.0, 0.0, 0.0, 0.0])
# Four corners carry the weight.
REST = 0.5 * 0.1048 - 0.37 * GRAVITY / 4e4


def start(p: Array, v: Array) -> dict[str, Array]:
    return {POSITION: np.concatenate([FLAT, p]), VELOCITY: np.concatenate([np.zeros(3), v])}


def sliding(mu: float, *, starts: int = 1, seed: int = 0, samples: int = 33) -> list[Window]:
    """Return slides of a block, x = v t - mu g t^2 / 2 until it rests, at several speeds, measured to 0.3 mm.

    All of them rest within 33 samples.
    """
    rng = np.random.default_rng(seed)
    times = PERIOD * np.arange(samples)
    windows = []
    for k, speed in enumerate(np.linspace(0.3, 0.8, 10)):
        stopping = np.minimum(times, speed / (mu * GRAVITY))
        x = speed * stopping - 0.5 * mu * GRAVITY * stopping**2
        y, z = np.zeros(samples), np.full(samples, REST)
        position = np.column_stack([np.tile(FLAT, (samples, 1)), x, y, z])
        position[:, 4] += 3e-4 * rng.normal(size=samples)
        values = [start(np.array([0.0, 0.0, REST]), np.array([speed, 0.0, 0.0]))]
        for _ in range(starts - 1):
            values.append(start(np.array([0.0, 0.0, REST]), np.array([speed + 0.01 * rng.normal(), 0.0, 0.0])))
        windows.append(Window(times, values, {POSITION: position}, f"slide {k}"))
    return windows


def distance(times: Array, measured: Mapping[str, Array], simulated: Mapping[str, Array]) -> float:
    return float(np.mean(abs(measured[POSITION][:, 4] - simulated[POSITION][:, 4])))


def calibrated(windows: list[Window], *parameters: Parameter, **options: object) -> RolloutCalibration:
    config = MultibodyPlantConfig(time_step=4e-3, contact_model="point", discrete_contact_approximation="sap")
    scenario = CubeTossScenario(friction=0.1, plant_config=config)
    return calibrate_by_rollouts(scenario, windows, parameters, distance, points=8, executor="serial", **options)


@pytest.mark.slow
def test_friction_of_a_sliding_block_is_that_of_the_closed_form() -> None:
    result = calibrated(sliding(0.25, starts=2), FRICTION)
    mu = result.parameters["scenario.friction"]
    # A step of 4 ms shortens a slide by 1 to 3 %.
    assert mu.value == pytest.approx(0.25, abs=0.005) and mu.start == 0.1
    assert mu.upper - mu.lower < 0.02 and mu.lower < mu.value < mu.upper
    assert result.accepted and result.scenario.friction == mu.value
    assert result.values == {"scenario.friction": mu.value}
    assert "10 recordings, 8 windows: loss" in str(result)
    assert result.scenario.pedigree.numbers["scenario.friction"].source == "calibrated"
    samples = [sample["scenario.friction"] for sample in result.scenario.samples(200)]
    assert np.std(samples) == pytest.approx(mu.deviation, rel=0.3) and len(result.scenario.pedigree.logs) == 10


@pytest.mark.slow
@pytest.mark.one_python
def test_parameter_that_changes_nothing_is_not_identifiable() -> None:
    # SAP has no dissipation of Hunt and Crossley.
    result = calibrated(sliding(0.25, samples=17), FRICTION, Parameter("scenario.dissipation", 0.1, 10.0, log=True))
    assert result.parameters["scenario.dissipation"].verdict == Verdict.NOT_IDENTIFIABLE
    assert result.parameters["scenario.friction"].value == pytest.approx(0.25, abs=0.01)
    assert len(result.combinations) == 1 and "scenario.dissipation" in result.combinations[0]
    assert set(result.values) == {"scenario.friction"} and result.scenario.dissipation == 0.4


@pytest.mark.slow
@pytest.mark.one_python
def test_range_without_the_truth_ends_at_its_bound() -> None:
    result = calibrated(sliding(0.25, samples=17), Parameter("scenario.friction", 0.05, 0.2))
    assert result.parameters["scenario.friction"].verdict == Verdict.AT_BOUND
    assert result.parameters["scenario.friction"].value == pytest.approx(0.2, abs=1e-3)


@pytest.mark.slow
@pytest.mark.one_python
def test_motion_that_the_model_lacks_is_discrepant() -> None:
    windows = sliding(0.25, starts=2)
    for window in windows:  # A drift to the side, which no friction explains.
        window.record[POSITION][:, 4] += 0.05 * np.sin(8.0 * window.times)
    result = calibrated(windows, FRICTION)
    assert result.parameters["scenario.friction"].verdict == Verdict.DISCREPANT
    assert result.outside == 1.0 and "farther from the simulations" in result.reasons[0]


def restitution(dissipation: float, speed: float) -> float:
    """Return e of m x'' = -k x (1 + d x'): the integral of v / (1 + d v) from -e v to v vanishes."""
    a = dissipation * speed
    return float(brentq(lambda e: a - np.log1p(a) + a * e + np.log1p(-a * e), 1e-9, min(1.0, 1.0 / a) - 1e-12))


@pytest.mark.slow
@pytest.mark.one_python
def test_dissipation_of_a_bounce_is_that_of_hunt_and_crossley() -> None:
    # Until all of them have been highest, and before any of them falls on the floor again.
    truth, times, windows = 0.5, PERIOD * np.arange(12), []
    for k, speed in enumerate(np.linspace(0.8, 1.2, 8)):
        # It begins a moment before the impact, and flies freely after it.
        impact = 0.01
        before = speed - GRAVITY * impact
        after = restitution(truth, speed) * speed
        t = times - impact
        z = np.where(t < 0.0, -speed * t - 0.5 * GRAVITY * t**2, after * t - 0.5 * GRAVITY * t**2)
        place = np.array([0.0, 0.0, 0.5 * 0.1048 + speed * impact - 0.5 * GRAVITY * impact**2])
        position = np.column_stack([np.tile(FLAT, (12, 1)), np.zeros((12, 2)), 0.5 * 0.1048 + z])
        windows.append(Window(times, [start(place, np.array([0.0, 0.0, -before]))], {POSITION: position}, f"drop {k}"))

    def apex(record: Mapping[str, Array]) -> float:
        z = record[POSITION][:, 6]
        return float(z[np.argmin(z[:8]) :].max())

    scenario = CubeTossScenario(
        plant_config=MultibodyPlantConfig(time_step=0.0, contact_model="point"),
        simulator_config=SimulatorConfig(integration_scheme="runge_kutta3", accuracy=1e-6, max_step_size=1e-3),
        stiffness=1e6,  # A contact of 0.6 ms
        dissipation=2.0,
    )
    result = calibrate_by_rollouts(
        scenario,
        windows,
        [Parameter("scenario.dissipation", 0.1, 5.0, log=True)],
        lambda times, measured, simulated: abs(apex(measured) - apex(simulated)),
        points=8,
        executor="serial",
    )
    assert result.parameters["scenario.dissipation"].value == pytest.approx(truth, rel=0.05)


@pytest.mark.slow
@pytest.mark.one_python
def test_friction_of_mujoco_is_recovered() -> None:
    mujoco = pytest.importorskip("mujoco")
    truth = 0.3
    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco><option timestep="0.0005" integrator="implicitfast" cone="elliptic" impratio="100"/>
        <worldbody><geom type="plane" size="5 5 .1" friction="{truth} 0 0"/>
        <body><freejoint/><inertial pos="0 0 0" mass="0.37" diaginertia="8.1e-4 8.1e-4 8.1e-4"/>
        <geom type="box" size=".0524 .0524 .0524" friction="{truth} 0 0" condim="3" solref="0.004 1"/>
        </body></worldbody></mujoco>"""
    )
    times, windows = PERIOD * np.arange(33), []
    rng = np.random.default_rng(3)
    for k in range(10):
        # Dropped flat from some millimetres, with a speed along a face: it lands, slides and stops.
        p, v = np.array([0.0, 0.0, 0.0524 + rng.uniform(1e-3, 5e-3)]), np.array([rng.uniform(0.4, 0.8), 0.0, 0.0])
        data = mujoco.MjData(model)
        data.qpos[:3], data.qpos[3:], data.qvel[:3] = p, FLAT, v
        rows = []
        for time in times:
            while data.time < time - 1e-9:
                mujoco.mj_step(model, data)
            rows.append(np.concatenate([data.qpos[3:], data.qpos[:3]]))
        windows.append(Window(times, [start(p, v)], {POSITION: np.array(rows)}, f"mujoco {k}"))
    mu = calibrated(windows, FRICTION).parameters["scenario.friction"]
    assert mu.value == pytest.approx(truth, rel=0.03), mu


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"parameters": []}, CalibrationError, "nothing is varied"),
        ({"holdout": 0.0}, CalibrationError, "kept back is above 0 and below 0.9, not 0.0"),
        ({"windows": 3}, CalibrationError, "3 recordings are too few"),
        ({"parameters": [Parameter("scenario.color", 0.0, 1.0)]}, ScenarioError, "has no field 'color'"),
        ({"parameters": [Parameter("scenario.mass", -2.0, -1.0)]}, ScenarioError, "mass"),
        ({"parameters": [Parameter("sim.sys.ball.mass", 0.1, 1.0)]}, ValueError, "sim.sys.ball.mass"),
    ],
)
def test_what_does_not_fit_is_refused(change: dict[str, object], error: type[Exception], message: str) -> None:
    arguments: dict[str, object] = {"parameters": [FRICTION], "windows": 10, "holdout": 0.2, **change}
    windows, parameters = sliding(0.25)[: arguments["windows"]], arguments["parameters"]
    with pytest.raises(error, match=message):
        calibrate_by_rollouts(
            CubeTossScenario(), windows, parameters, distance, holdout=arguments["holdout"], executor="serial"
        )


@pytest.mark.parametrize("change", [{"starts": 2}, {"record": {VELOCITY: np.zeros((33, 6))}}])
def test_windows_of_two_kinds_are_refused(change: dict[str, object]) -> None:
    windows = sliding(0.25)
    first = windows[0]
    starts, record = list(first.starts) * int(change.get("starts", 1)), change.get("record", first.record)
    windows[0] = Window(first.times, starts, record, first.source)
    with pytest.raises(CalibrationError, match="record the same addresses, and have as many starts"):
        calibrate_by_rollouts(CubeTossScenario(), windows, [FRICTION], distance, executor="serial")


ANGLE, RATE, DAMPING = (f"sim.sys.cart_pole.pole_pin.{name}" for name in ("position", "velocity", "damping"))


@cache
def swings(damping: float) -> list[Window]:
    """Return swings of the cart-pole's pole, as Drake simulates them, measured to 1 mrad."""
    testbed, rng, times = CartPoleScenario().build(), np.random.default_rng(3), 0.02 * np.arange(21)
    windows = []
    for k, angle in enumerate(np.linspace(0.3, 1.0, 8)):
        context = testbed.default_context()
        testbed.write(context, {DAMPING: damping, ANGLE: angle})
        simulator, angles = testbed.simulator(context), []
        for time in times:
            simulator.AdvanceTo(time)
            angles.append(testbed.read(context, ANGLE))
        measured = np.array(angles) + 1e-3 * rng.normal(size=len(times))
        windows.append(Window(times, [{ANGLE: angle, RATE: 0.0}], {ANGLE: measured}, f"swing {k}"))
    return windows


def test_compiled_rollouts_give_the_same_estimates() -> None:
    by_drake, compiled = (
        calibrate_by_rollouts(
            CartPoleScenario(),
            swings(0.2),
            [Parameter(DAMPING, 0.05, 0.6)],
            lambda times, measured, simulated: float(np.mean((measured[ANGLE] - simulated[ANGLE]) ** 2)),
            points=8,
            executor=executor,
        )
        for executor in ("serial", "compiled")
    )
    for name in ("value", "lower", "upper", "deviation"):
        expected = getattr(by_drake.parameters[DAMPING], name)
        assert getattr(compiled.parameters[DAMPING], name) == pytest.approx(expected, rel=1e-6), name
    assert compiled.parameters[DAMPING].value == pytest.approx(0.2, rel=0.05)
    assert compiled.rollouts == by_drake.rollouts and str(compiled) == str(by_drake)


def test_loss_that_is_not_finite_is_named() -> None:
    with pytest.raises(CalibrationError, match="at every point .* its loss failed: the loss of swing . is nan"):
        calibrate_by_rollouts(
            CartPoleScenario(),
            swings(0.2),
            [Parameter(DAMPING, 0.05, 0.6)],
            lambda times, measured, simulated: np.nan,
            points=2,
            executor="compiled",
        )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"starts": []}, "has two samples, a start and a record"),
        ({"times": np.array([0.0, 0.1, 0.3])}, "equally spaced"),
        ({"record": {POSITION: np.zeros((2, 7))}}, "one finite value for each of the 3 times"),
        ({"record": {POSITION: np.full((3, 7), np.nan)}}, "one finite value for each of the 3 times"),
    ],
)
def test_window_that_is_none_is_refused(change: dict[str, object], message: str) -> None:
    arguments = {"times": np.array([0.0, 0.1, 0.2]), "starts": [{}], "record": {POSITION: np.zeros((3, 7))}, **change}
    with pytest.raises(CalibrationError, match=message):
        Window(**arguments, source="a log")
