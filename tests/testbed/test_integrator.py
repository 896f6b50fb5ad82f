"""Integrators that testbeds give to simulators."""

from __future__ import annotations

import numpy as np
import pytest
from pydrake.multibody.cenic import CenicIntegrator
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator, SimulatorConfig

from tests.testbeds import AcrobotScenario, PendulumScenario
from vtbdrake.testbed import Scenario
from vtbdrake_diagrams.space_climber import SpaceClimberScenario

CENIC = AcrobotScenario(time_step=0.0, simulator_config=SimulatorConfig(integration_scheme="cenic"))


def reuses_hessians(simulator: Simulator) -> bool:
    integrator = simulator.get_mutable_integrator()
    assert isinstance(integrator, CenicIntegrator)
    return integrator.get_solver_parameters().enable_hessian_reuse


@pytest.mark.parametrize("scenario", [PendulumScenario(), AcrobotScenario(time_step=0.005), CENIC])
def test_simulation_does_not_advance_to_no_time_or_an_earlier_one(scenario: Scenario) -> None:
    simulator = scenario.build().simulator()
    simulator.AdvanceTo(0.02)
    for time in (np.nan, 0.01, -np.inf):
        with pytest.raises(ValueError, match=f"the simulation is at 0.02 s, and cannot advance to {time} s"):
            simulator.AdvanceTo(time)
    simulator.AdvanceTo(0.03)
    assert simulator.get_context().get_time() == 0.03


def test_cenic_reuses_hessians_and_walks_as_without() -> None:
    testbed = SpaceClimberScenario().build()
    ours, plain = testbed.simulator(), Simulator(testbed.diagram)
    ApplySimulatorConfig(testbed.simulator_config, plain)
    assert (reuses_hessians(ours), reuses_hessians(plain)) == (True, False)
    positions = []
    for simulator in (ours, plain):
        simulator.AdvanceTo(1.0)
        positions.append(testbed.plant.GetPositions(testbed.plant.GetMyContextFromRoot(simulator.get_context())))
    np.testing.assert_allclose(*positions, atol=1e-5)
    testbed.fork(ours)
    assert reuses_hessians(ours)
