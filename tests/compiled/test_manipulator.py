"""The arm's testbed, compiled: plant with reaction forces, its sensors, its drives and its DPS."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from vtbdrake.compiled import CompiledRollouts
from vtbdrake.compiled.agreement import compare
from vtbdrake.compiled.equations import Equations
from vtbdrake.components.sensors import ErrorModel
from vtbdrake.testbed import VirtualTestbed
from vtbdrake_diagrams.manipulator import ManipulatorScenario
from vtbdrake_diagrams.manipulator.laws import LAWS
from vtbdrake_diagrams.manipulator.motions import Motion

PUSH, MASS, DELAY = "sim.env.push.wrench", "sim.sys.arm.tool.mass", "sim.act.drives.delay"
LAW = next(iter(LAWS))
ERRORS = ErrorModel(noise=0.01, bias=0.02, drift=0.1, latency=2, quantization=1e-3)


@cache
def built(law: str) -> VirtualTestbed:
    return ManipulatorScenario(law=law, compile=False).build()


def compiled(testbed: VirtualTestbed, values: dict, parameters: tuple[str, ...] = ()) -> tuple[CompiledRollouts, float]:
    """A compiled testbed, and how far it is from the Diagram in a rollout that begins with these values."""
    context = testbed.default_context()
    testbed.write(context, values)
    rollouts = testbed.compiled(
        horizon=0.06,
        sample_period=0.02,
        parameters=parameters,
        outputs=["plant.state", "dps.joint_torque"],
        context=context,
        compile=False,
        check=False,
    )
    return rollouts, compare(rollouts, context)


@pytest.mark.slow_cases
@pytest.mark.parametrize("law", LAWS)
def test_every_law_is_that_of_the_diagram(law: str) -> None:
    rollouts, apart = compiled(built(law), {"u.motion": float(Motion.HOME), PUSH: [0.1, 0.2, 0.3, 10.0, -5.0, 3.0]})
    assert apart <= Equations.agreement
    state = rollouts().outputs["plant.state"]
    assert np.max(np.abs(state[0, -1] - state[0, 0])) > 1e-4


def test_errors_of_all_sensors_and_a_delay_are_those_of_the_diagram() -> None:
    names = ("position_errors", "velocity_errors", "torque_errors", "wrench_errors")
    scenario = replace(ManipulatorScenario(compile=False), **dict.fromkeys(names, ERRORS))
    _, apart = compiled(scenario.build(), {DELAY: 3.0, MASS: 2.0}, (MASS,))
    assert apart <= Equations.agreement


def test_varies_the_mass_of_the_tool() -> None:
    rollouts, _ = compiled(built(LAW), {}, (MASS,))
    heavy = rollouts({MASS: [1.0, 3.0]}).outputs["plant.state"][1]
    other, _ = compiled(built(LAW), {MASS: 3.0})
    np.testing.assert_allclose(heavy, other().outputs["plant.state"][0], rtol=1e-11, atol=1e-11)


def test_a_delay_is_compiled_in() -> None:
    rollouts, _ = compiled(built(LAW), {})
    with pytest.raises(ValueError, match=r"sim\.act\.drives\.delay cannot be varied .*: a delay is compiled in"):
        rollouts({DELAY: 2.0})
