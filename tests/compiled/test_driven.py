"""Worlds that a log drives, compiled: the samples of the log are looked up before the rollout."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from pydrake.multibody.plant import MultibodyPlantConfig

from vtbdrake.common.arrays import Array
from vtbdrake.recording import DrivenScenario, Log, read_table
from vtbdrake.rollout import RolloutTask, SerialExecutor
from vtbdrake.testbed import Scenario
from vtbdrake_diagrams.double_pendulum import DoublePendulumScenario
from vtbdrake_diagrams.manipulator import ManipulatorScenario
from vtbdrake_diagrams.manipulator.studies.excited import ExcitedArmScenario

MASS, RATE = "sim.sys.arm.tool.mass", "sim.sys.pendulum.elbow.velocity"
DISCRETE = MultibodyPlantConfig(time_step=0.002, discrete_contact_approximation="sap")


def torques(signal: str, size: int, *, period: float) -> Log:
    """A log of random steps of torque, 0.1 s long, which begins at 5 s."""
    times = 5.0 + period * np.arange(round(0.1 / period))
    steps = np.random.default_rng(size).normal(size=(len(times), size)).cumsum(axis=0)
    columns = {f"u{k}": 0.3 * column for k, column in enumerate(steps.T)}
    return read_table({"time": times, **columns}, sense={}, act={signal: list(columns)})


ARM, PENDULUM = torques("joint_torque", 7, period=0.001), torques("torque", 2, period=0.003)
DRIVEN = {
    "arm": (DrivenScenario(scenario=ManipulatorScenario(compile=False), log=ARM), {MASS: [0.5, 2.0]}),
    "arm in the middle": (
        DrivenScenario(scenario=ExcitedArmScenario(compile=False), log=ARM, start=5.05),
        {MASS: [0.5, 2.0]},
    ),
    "pendulum": (
        DrivenScenario(scenario=DoublePendulumScenario(plant_config=DISCRETE), log=PENDULUM),
        {RATE: [-1.0, 3.0]},
    ),
}


def in_drake(scenario: Scenario, address: str, values: list[float], outputs: list[str]) -> dict[str, Array]:
    task = RolloutTask(scenario, 0.15, sample_period=0.01, record=tuple(outputs))
    with SerialExecutor() as executor:
        results = [result for _, result in executor.run(task, [{address: value} for value in values])]
    return {output: np.array([result.record[output] for result in results]) for output in outputs}


@pytest.mark.parametrize("name", ["pendulum", "arm", pytest.param("arm in the middle", marks=pytest.mark.slow)])
def test_follows_the_log_as_in_drake(name: str) -> None:
    scenario, varied = DRIVEN[name]
    ((address, values),) = varied.items()
    assert scenario.log is not None
    (signal,) = scenario.log.act
    outputs = ["plant.state", f"dps.{signal}"]
    rollouts = scenario.build().compiled(
        horizon=0.15, sample_period=0.01, parameters=[address], outputs=outputs, compile=False
    )
    batch = rollouts({address: values})
    assert batch.valid.all()
    # The log ends before the rollout does.
    for output, expected in in_drake(scenario, address, values, outputs).items():
        np.testing.assert_allclose(batch.outputs[output], expected, rtol=1e-11, atol=1e-11)
    np.testing.assert_array_equal(batch.outputs[outputs[1]][0, -1], scenario.log.act[signal].values[-1])
    assert np.ptp(batch.outputs["plant.state"][:, -1], axis=0).max() > 1e-3


@pytest.mark.parametrize("time_step", [0.002, 0.001])
def test_disturbed_drives_are_as_in_drake(time_step: float) -> None:
    """The drives' period is 2 ms, and their friction is computed at the plant's step."""
    plant = MultibodyPlantConfig(time_step=time_step, discrete_contact_approximation="sap")
    scenario = DrivenScenario(scenario=DoublePendulumScenario(plant_config=plant, period=0.002), log=PENDULUM)
    address, values, outputs = "sim.act.drives.disturbance[1]", [0.0, 0.3], ["plant.state"]
    rollouts = scenario.build().compiled(
        horizon=0.15, sample_period=0.01, parameters=[address], outputs=outputs, compile=False
    )
    batch = rollouts({address: values})
    expected = in_drake(scenario, address, values, outputs)["plant.state"]
    np.testing.assert_allclose(batch.outputs["plant.state"], expected, rtol=1e-10, atol=1e-10)
    assert abs(expected[1] - expected[0]).max() > 1e-3


def test_a_later_begin_reads_the_later_samples() -> None:
    scenario = DRIVEN["pendulum"][0]
    testbed = scenario.build()
    rollouts = testbed.compiled(horizon=0.04, sample_period=0.02, outputs=["plant.state"], compile=False)
    context = testbed.default_context()
    simulator = testbed.simulator(context)
    rollouts()
    for begin in (0.02, 0.08):
        simulator.AdvanceTo(begin)
        final = rollouts(context=context).outputs["plant.state"][0, -1]
        simulator.AdvanceTo(begin + 0.04)
        np.testing.assert_allclose(final, testbed.read(context, "plant.state"), rtol=1e-11, atol=1e-11)


def test_another_log_is_another_motion() -> None:
    scenario = DRIVEN["pendulum"][0]
    others = [replace(scenario, log=torques("torque", 2, period=period)) for period in (0.003, 0.002)]
    ends = [s.build().compiled(horizon=0.1, sample_period=0.1, outputs=["plant.state"], compile=True)() for s in others]
    assert np.max(np.abs(ends[0].outputs["plant.state"] - ends[1].outputs["plant.state"])) > 1e-3
