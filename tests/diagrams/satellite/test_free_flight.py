"""Both satellites fly freely: conservation laws."""

from __future__ import annotations

import numpy as np
import pytest
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import Context

from vtbdrake_diagrams.satellite import SatelliteScenario
from vtbdrake_diagrams.satellite.supervisor import Mode


def momentum(plant: MultibodyPlant, context: Context) -> np.ndarray:
    """Angular momentum about the world's origin (N m s), then linear momentum (N s)."""
    return plant.CalcSpatialMomentumInWorldAboutPoint(context, np.zeros(3)).get_coeffs()


def test_motion_of_the_arm_conserves_momentum() -> None:
    testbed = SatelliteScenario(seed=1, tumble_deg=3.0, perception="pose_sensor").build()
    context = testbed.default_context()
    simulator = testbed.simulator(context)
    simulator.AdvanceTo(0.05)
    own = testbed.plant.GetMyContextFromRoot(context)
    before, base = momentum(testbed.plant, own), testbed.plant.GetBodyByName("base")
    simulator.AdvanceTo(3.0)
    assert testbed.read(context, "dps.impl.supervisor.mode") == Mode.APPROACH
    # The arm turns the base on which it stands.
    assert base.EvalPoseInWorld(own).rotation().ToAngleAxis().angle() > 1e-4
    for part in (slice(0, 3), slice(3, 6)):
        error = momentum(testbed.plant, own)[part] - before[part]
        assert np.linalg.norm(error) < 0.02 * np.linalg.norm(before[part])


@pytest.mark.slow
def test_capture_conserves_momentum_and_wheels_hold_the_attitude() -> None:
    turns = []
    for wheels in (False, True):
        testbed = SatelliteScenario(seed=1, tumble_deg=3.0, perception="pose_sensor", wheels=wheels).build()
        context = testbed.default_context()
        simulator = testbed.simulator(context)
        simulator.AdvanceTo(0.05)
        own = testbed.plant.GetMyContextFromRoot(context)
        before = momentum(testbed.plant, own)
        simulator.AdvanceTo(14.0)
        assert testbed.read(context, "dps.impl.supervisor.mode") == Mode.RETREAT  # With contact.
        # At a step of 10 ms the plant is accurate to the first order.
        for part in (slice(0, 3), slice(3, 6)):
            error = momentum(testbed.plant, own)[part] - before[part]
            assert np.linalg.norm(error) < 0.02 * np.linalg.norm(before[part])
        turns.append(testbed.plant.GetBodyByName("base").EvalPoseInWorld(own).rotation().ToAngleAxis().angle())
    assert turns[1] < 0.5 * turns[0]
