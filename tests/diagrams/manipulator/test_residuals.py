"""The arm beside its model: nothing parts them but what has changed, and that is found."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.monitoring.residuals.line import Together
from vtbdrake.components.sensors import ErrorModel
from vtbdrake.machine.config import MachineConfig
from vtbdrake.machine.machine import Machine
from vtbdrake.monitoring.residuals import ResidualMonitor
from vtbdrake_diagrams.manipulator import ManipulatorScenario
from vtbdrake_diagrams.manipulator.motions import Motion

TOOL = "sim.sys.arm.tool.mass"
MASS = 0.4  # kg
# What `ResidualMonitor.calibrate` says of 8 s of the circle with the noise below; means are not far from zero.
DEVIATION = {
    "sense.joint_position": 1.2e-5,
    "sense.joint_velocity": 1.1e-3,
    "sense.joint_torque_measured": 0.04,
    "sense.wrench": 0.04,
    "act.joint_torque": 0.02,
}


def noisy(latency: int = 0) -> ManipulatorScenario:
    names = ("position_errors", "velocity_errors", "torque_errors", "wrench_errors")
    noise = dict(zip(names, (1e-5, 1e-3, 0.1, 0.1), strict=True))
    errors = {name: ErrorModel(noise=std, latency=latency, seed=k) for k, (name, std) in enumerate(noise.items())}
    return ManipulatorScenario(law="joint_impedance", **errors)


def together_with(scenario: ManipulatorScenario, **values: Any) -> Together:
    machine = Machine(scenario, MachineConfig(values=values))
    return Together(scenario, machine, shadowing=scenario, values={"u.motion": float(Motion.CIRCLE)})


def monitors(together: Together, **options: Any) -> dict[str, ResidualMonitor]:
    assert together.shadow is not None
    loops = {"twin": together.driver, "shadow": together.shadow}
    return {mode: ResidualMonitor(loop, mode, worker=False, **options) for mode, loop in loops.items()}


@pytest.mark.slow
@pytest.mark.parametrize(
    "scenario",
    [
        ManipulatorScenario(law="cartesian_impedance"),
        ManipulatorScenario(
            law="admittance",
            position_errors=ErrorModel(latency=1),
            velocity_errors=ErrorModel(latency=3),
            torque_errors=ErrorModel(latency=2),
        ),
    ],
    ids=lambda scenario: scenario.law,
)
def test_perfect_model_leaves_nothing_whatever_the_latencies(scenario: ManipulatorScenario) -> None:
    together = together_with(scenario)
    both = monitors(together, config=replace(scenario.deployment().residuals, settle=1), learn=True)
    together.run(150)
    for monitor in both.values():
        assert len(monitor.history) == 13
        assert monitor.skipped == monitor.failed == 0
        np.testing.assert_allclose([window.residual for window in monitor.history], 0.0, atol=1e-9)


def monitored(latency: int, mass: float, cycles: int) -> dict[str, ResidualMonitor]:
    scenario = noisy(latency)
    together = together_with(scenario, **{TOOL: mass})
    both = monitors(together, config=replace(scenario.deployment().residuals, tolerance=DEVIATION))
    together.run(cycles)
    return both


with_and_without_latency = pytest.mark.parametrize(
    "latency",
    [2, pytest.param(0, marks=[pytest.mark.one_python, pytest.mark.slow])],
    ids="latency {}".format,
    scope="module",
)


@pytest.fixture(scope="module")
def nominal(latency: int) -> dict[str, ResidualMonitor]:
    return monitored(latency, MASS, 600)


@pytest.fixture(scope="module")
def heavy(latency: int) -> dict[str, ResidualMonitor]:
    return monitored(latency, 1.05 * MASS, 250)


@with_and_without_latency
@pytest.mark.parametrize("mode", ["twin", "shadow"])
def test_heavier_payload_is_found_quickly(heavy: dict[str, ResidualMonitor], mode: str) -> None:
    monitor = heavy[mode]
    alarm = monitor.alarms[0]
    # The wrist's sensor carries 20 g more, all of it along its x at home.
    assert (alarm.signal, alarm.entry) == ("sense.wrench", 3)
    assert alarm.residual == pytest.approx(0.05 * MASS * 9.81, abs=0.1)
    settled = monitor.config.settle * monitor.config.window
    assert settled < alarm.began < settled + 0.1


@pytest.mark.slow
@with_and_without_latency
@pytest.mark.parametrize("mode", ["twin", "shadow"])
def test_nominal_arm_raises_no_alarm(nominal: dict[str, ResidualMonitor], mode: str) -> None:
    monitor = nominal[mode]
    assert not monitor.alarms
    assert len(monitor.history) == 59 - monitor.config.settle
    assert np.abs([window.residual for window in monitor.history]).max() > 0.01


@pytest.mark.slow
def test_sensor_that_drifts_is_named() -> None:
    scenario = noisy()
    together = together_with(scenario)
    both = monitors(together, config=replace(scenario.deployment().residuals, tolerance=DEVIATION))
    machine = together.line.machine
    for k in range(500):
        bias = np.array([0.0, 0.0, 0.0, 0.0, 0.5e-3 * k, 0.0])  # half a newton per second
        machine.write({"sim.sense.wrench.bias": bias})
        together.run(1)
    for monitor in both.values():
        assert {(alarm.signal, alarm.entry) for alarm in monitor.alarms} == {("sense.wrench", 4)}
