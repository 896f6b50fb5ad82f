"""Prediction by a simulated world that is set to a belief."""

from __future__ import annotations

import numpy as np
import pytest

from tests.monitoring.residuals.pendulum import PERIOD, DrivenPendulum
from vtbdrake.testbed import WorldAlone
from vtbdrake.testbed.prediction import Predictor

SCENARIO = DrivenPendulum()
BELIEF = {"dps.seen[0]": 0.3, "dps.seen": np.array([0.3, -0.2])}


def test_prediction_equals_the_simulated_world() -> None:
    world = WorldAlone(SCENARIO)
    context = world.default_context()
    world.write(context, {"sim.sys.Pendulum.theta.position": 0.3, "sim.sys.Pendulum.theta.velocity": -0.2})
    simulator = world.simulator(context)
    predictor = Predictor(SCENARIO, period=PERIOD, values={})
    predictor.set_belief(0, BELIEF)
    for k in range(20):
        torque = np.array([np.sin(k)])
        world.actuate(context, "torque", torque)
        simulator.AdvanceTo((k + 1) * PERIOD)
        expected = [world.diagram.GetOutputPort(f"sense.{name}").Eval(context)[0] for name in ("position", "velocity")]
        np.testing.assert_allclose(predictor.step(torque), expected, atol=1e-12)
    assert np.ptp(expected) > 0.0


def test_last_actuation_holds() -> None:
    def end(*actuation: np.ndarray | None) -> np.ndarray:
        predictor = Predictor(SCENARIO, period=PERIOD, values={})
        return [predictor.step(command) for command in actuation][-1]

    torque = np.array([2.0])
    np.testing.assert_array_equal(end(torque, None, None), end(torque, torque, torque))
    assert not np.array_equal(end(torque, None), end(torque, np.zeros(1)))


def test_beliefs_are_grouped_by_age() -> None:
    assert Predictor(SCENARIO, period=PERIOD, values={}).estimates == {0: ("dps.seen[0]", "dps.seen")}
    late = DrivenPendulum(sampled=True)
    assert list(Predictor(late, period=PERIOD / 2, values={}).estimates) == [2]
    with pytest.raises(ValueError, match="must be a multiple of the period"):
        Predictor(late, period=0.3 * PERIOD, values={})
