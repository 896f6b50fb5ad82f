"""The swing-up by decisions at a receding horizon, in simulation and on a machine."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from pydrake.multibody.plant import MultibodyPlantConfig

import vtbdrake as vtb
from vtbdrake.reasoning import Belief
from vtbdrake.rollout.start import StartContext
from vtbdrake_diagrams.cart_pole import CartPoleScenario
from vtbdrake_diagrams.cart_pole.decision import cost, plan_of
from vtbdrake_diagrams.cart_pole.swing_up import make_reasoner, swing_up, swing_up_on_machine, swing_up_onboard

UPRIGHT, HANGING = np.array([0.0, np.pi, 0.0, 0.0]), np.zeros(4)


def test_the_cost_is_zero_upright_in_the_middle() -> None:
    assert cost(UPRIGHT) == pytest.approx(0.0, abs=1e-15)
    assert cost(HANGING) == pytest.approx(2.0)
    assert all(cost(UPRIGHT + step) > 0.0 for step in 1e-3 * np.eye(4))


@pytest.mark.slow
@pytest.mark.one_python
def test_the_pole_is_swung_up_and_kept_upright() -> None:
    scenario = CartPoleScenario()
    with make_reasoner(scenario, rollouts=32, seed=1, executor="serial") as reasoner:
        swing = swing_up(reasoner, scenario, seconds=4.5)
    assert swing.tilt[0] == pytest.approx(np.pi)
    assert swing.tilt[-5:].max() < 0.4
    assert np.abs(swing.states[:, 0]).max() < 2.0
    # The force is too small to lift the pole in one go: it swings to both sides.
    angles = swing.states[: int(np.argmin(swing.tilt > 0.3)), 1]
    assert angles.min() < -0.2
    assert angles.max() > 0.2
    # The plan in use is a candidate, so that no decision is worse by its own prediction.
    assert all(decision.health.improvement >= 0.0 for decision in swing.decisions)
    knots = np.array([decision.values["u.plan"][1:] for decision in swing.decisions])
    assert (np.abs(knots) <= scenario.force_limit).all()


def test_the_same_seed_decides_the_same_and_another_one_does_not() -> None:
    scenario = CartPoleScenario()
    swings = []
    for seed in (1, 1, 2):
        with make_reasoner(scenario, rollouts=8, seed=seed, executor="serial") as reasoner:
            swings.append(swing_up(reasoner, scenario, seconds=0.3))
    np.testing.assert_array_equal(swings[0].states, swings[1].states)
    assert not np.array_equal(swings[0].states, swings[2].states)


def test_a_mental_copy_as_fine_predicts_the_true_future() -> None:
    scenario = CartPoleScenario(plant_config=MultibodyPlantConfig(time_step=0.02, use_sampled_output_ports=False))
    testbed = scenario.build()
    context = testbed.default_context()
    simulator = testbed.simulator(context)
    simulator.AdvanceTo(10 * scenario.period)
    with make_reasoner(scenario, rollouts=8, executor="serial") as reasoner:
        decision = reasoner.decide(Belief.perfect(testbed, context))
    decision.apply(testbed, context)
    assert not decision.keeps_plan
    times = scenario.period * np.arange(10, 61, 2)
    costs = []
    for time in times:
        simulator.AdvanceTo(time)
        costs.append(cost(np.array(testbed.reader("plant.state")(context))))
    assert decision.quality == pytest.approx(np.trapezoid(costs, times), rel=1e-12)


@pytest.mark.slow
@pytest.mark.one_python
def test_the_dps_swings_up_the_pole_with_a_reasoner_on_board() -> None:
    swing = swing_up_onboard(CartPoleScenario(onboard=True), seconds=3.3)
    assert swing.tilt[-5:].max() < 0.4
    assert np.abs(swing.states[:, 0]).max() < 3.0


@pytest.mark.slow
@pytest.mark.one_python
def test_over_lcm_the_dps_decides_for_a_machine_process(tmp_path: Path) -> None:
    scenario = CartPoleScenario(onboard=True, rollouts=8)
    swing = swing_up_on_machine(scenario, seconds=0.8, record=tmp_path / "swing.lcm")
    assert swing.tilt[0] == pytest.approx(np.pi)
    # Without decisions there is no force, and the pole hangs still.
    assert swing.tilt.min() < np.pi - 0.02
    assert vtb.replay(tmp_path / "swing.lcm").identical


@pytest.mark.parametrize("instant", [0.5, 0.513])
def test_a_mental_copy_begins_at_the_present_not_at_the_last_measurement(instant: float) -> None:
    scenario = CartPoleScenario()
    testbed, mental = scenario.build(), scenario.mental().build()
    context = testbed.default_context()
    testbed.write(context, {"sim.sys.cart_pole.pole_pin.position": 2.0, "u.plan": [0.0, *[20.0] * scenario.knots]})
    testbed.simulator(context).AdvanceTo(instant)
    beginning = StartContext(mental, mental.default_context(), mental.copier_from(mental))
    beginning.set(Belief.of(testbed, context).start(mental))
    true, believed = testbed.reader("plant.state")(context), mental.reader("plant.state")(beginning.context)
    assert abs(true[3]) > 5.0  # In two periods the pole turns by 0.2 rad.
    np.testing.assert_allclose(believed, true, atol=0.05)


def test_the_plan_is_a_trajectory_of_the_testbed() -> None:
    scenario = CartPoleScenario(order="cubic", knots=6, force_limit=30.0)
    plan = plan_of(scenario, "u.plan")
    plan.find(scenario.build().variables())
    assert (plan.lower, plan.upper, plan.duration) == ((-30.0,), (30.0,), scenario.duration)
