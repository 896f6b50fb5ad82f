"""The arm is stable at the bounds of what can be written while it runs."""

from __future__ import annotations

import numpy as np
import pytest

from vtbdrake_diagrams.manipulator import ManipulatorScenario
from vtbdrake_diagrams.manipulator.laws import LAWS
from vtbdrake_diagrams.manipulator.motions import Motion


@pytest.mark.slow_cases
@pytest.mark.parametrize("law", LAWS)
def test_arm_is_stable_at_the_bounds_of_its_gains(law: str) -> None:
    """At 5 times its value, a damping already shakes the joints by radians per second, 13 N m from period to period."""
    testbed = ManipulatorScenario(law=law).build()
    for gain in LAWS[law].parameters:
        for bound in (0, 1):
            context = testbed.default_context()
            address = f"dps.impl.{gain}"
            value = np.asarray(testbed.variables()[address].bounds[bound])
            testbed.write(context, {address: value, "u.motion": float(Motion.CIRCLE)})
            simulator = testbed.simulator(context)
            simulator.AdvanceTo(0.3)
            torque, changes = testbed.read(context, "dps.impl.torque"), []
            for k in range(1, 6):
                simulator.AdvanceTo(0.3 + 1e-3 * k)
                changes.append(np.abs(testbed.read(context, "dps.impl.torque") - torque).max())
                torque = testbed.read(context, "dps.impl.torque")
            assert np.abs(testbed.read(context, "dps.env.joint_velocity")).max() < 0.5, (gain, bound)
            assert max(changes) < 0.1, (gain, bound)
