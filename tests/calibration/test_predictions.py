"""Predictions of the plain pendulum with samples, by its own equations and by the testbed."""

from __future__ import annotations

import numpy as np
import pytest

from tests.calibration.pendulum import ARM, DRIVES, PERIOD, PendulumScenario
from tests.calibration.plain_pendulum import moved
from tests.calibration.predictions import SAMPLE_PERIOD, predicted
from tests.calibration.test_calibration import VALUES
from vtbdrake.components.actuators import JointDrives
from vtbdrake.recording import DrivenScenario
from vtbdrake.state.systems import leaves

pytestmark = pytest.mark.one_python

START = 1.0  # s


@pytest.mark.parametrize("disturbance", [0.0, pytest.param(0.1, marks=pytest.mark.slow)])
def test_testbed_predicts_as_the_plain_equations_do(disturbance: float) -> None:
    """Without a disturbance the positions are the same, with one they spread as far."""
    motion = moved(seed=1020)
    samples = [
        VALUES
        | {f"{DRIVES}.disturbance[0]": disturbance, f"{DRIVES}.disturbance_time": 0.05, f"{DRIVES}.seed": float(seed)}
        for seed in range(40 if disturbance else 1)
    ]
    expected = predicted(motion, samples, (START,))[:, 0]
    testbed = DrivenScenario(scenario=PendulumScenario(coulomb_velocity=0.005), log=motion.log()).build()
    (drives,) = (system for _, system in leaves(testbed.diagram) if isinstance(system, JointDrives))
    first = round(START / PERIOD)
    context = testbed.default_context()
    testbed.simulator(context).AdvanceTo(START)
    positions = np.empty_like(expected)
    for k, sample in enumerate(samples):
        at = context.Clone()
        state = {"position": motion.positions[first], "velocity": motion.velocities[first]}
        testbed.write(at, sample | {f"{ARM}.pivot.{name}": value for name, value in state.items()})
        drives.resume(drives.GetMyMutableContextFromRoot(at), motion.torques[first - 1 : first])
        simulator = testbed.simulator(at)
        for j in range(positions.shape[1]):
            simulator.AdvanceTo(START + SAMPLE_PERIOD * (j + 1))
            positions[k, j] = testbed.read(at, f"{ARM}.pivot.position")
    if not disturbance:
        np.testing.assert_allclose(positions, expected, atol=2e-3)
    else:
        # The deviation of 40 is known to 11 %.
        np.testing.assert_allclose(positions.std(axis=0)[2:], expected.std(axis=0)[2:], rtol=0.5)
        assert positions.std(axis=0)[-1] > 0.02
