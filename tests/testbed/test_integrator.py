"""Integrators that testbeds give to simulators."""

from __future__ import annotations

import numpy as np
from pydrake.multibody.cenic import CenicIntegrator
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator

from vtbdrake_diagrams.space_climber import SpaceClimberScenario


def reuses_hessians(simulator: Simulator) -> bool:
    integrator = simulator.get_mutable_integrator()
    assert isinstance(integrator, CenicIntegrator)
    return integrator.get_solver_parameters().enable_hessian_reuse


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
