"""Tests that what can be written while a machine runs has bounds, and that the arm is stable at them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from vtbdrake.state import VariableError
from vtbdrake.testbed import DpsAlone, Scenario
from vtbdrake_diagrams.cart_pole import CartPoleScenario
from vtbdrake_diagrams.forest.scenario import ForestScenario
from vtbdrake_diagrams.manipulator import ManipulatorScenario
from vtbdrake_diagrams.manipulator.laws import LAWS
from vtbdrake_diagrams.manipulator.motions import Motion
from vtbdrake_diagrams.satellite.scenario import SatelliteScenario
from vtbdrake_diagrams.space_climber import CraterScenario, SpaceClimberScenario

EXAMPLES: dict[str, Callable[[], Scenario]] = {
    **{law: lambda law=law: ManipulatorScenario(law=law) for law in LAWS},  # type: ignore[misc]
    "cart_pole": CartPoleScenario,
    "satellite": SatelliteScenario,
    "space_climber": SpaceClimberScenario,
    "crater": CraterScenario,
    "forest": ForestScenario,
}


@pytest.mark.one_python
@pytest.mark.parametrize("name", EXAMPLES)
def test_every_parameter_of_a_dps_has_bounds(name: str) -> None:
    dps = DpsAlone(EXAMPLES[name]())
    context = dps.default_context()
    for address, variable in dps.variables().items():
        if variable.kind != "a" or variable.derived:
            continue
        lower, upper = (np.asarray(bound) for bound in variable.bounds)
        value = np.asarray(variable.get(context))
        assert np.isfinite(lower).all() and np.isfinite(upper).all(), address
        assert (lower <= value).all() and (value <= upper).all(), address
        for wild in (1e200, -1e200):
            with pytest.raises(VariableError, match="must lie in"):
                dps.write(context, {address: np.full(value.shape, wild)})


@pytest.mark.one_python
@pytest.mark.parametrize("name", EXAMPLES)
def test_no_two_variables_of_a_testbed_lie_in_one_place(name: str) -> None:
    addresses: dict[tuple[str, str, int, int], str] = {}
    for address, variable in EXAMPLES[name]().build().variables().items():
        if (place := variable.place) is None:
            continue
        for entry in range(place.start, place.start + int(np.prod(variable.shape))):
            other = addresses.setdefault((place.system.GetSystemPathname(), place.group, place.index, entry), address)
            assert other == address


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
