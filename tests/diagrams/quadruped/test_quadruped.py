"""The quadruped trots, perceives itself, and steps aside when it is pushed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from pydrake.multibody.plant import MultibodyPlant

from vtbdrake.common.spline import Spline
from vtbdrake.testbed import ScenarioError
from vtbdrake_diagrams.quadruped import QuadrupedScenario
from vtbdrake_diagrams.quadruped.decision import LIMITS, cost
from vtbdrake_diagrams.quadruped.dps import PERCEIVED
from vtbdrake_diagrams.quadruped.gait import OFFSETS, Trot, desired_state
from vtbdrake_diagrams.quadruped.model import LEGS, QUADRUPED_SDF, Quadruped, quadruped_sdf
from vtbdrake_diagrams.quadruped.scenario import present_angles, present_rates, present_trunk
from vtbdrake_diagrams.quadruped.studies.pushes import PushCase, Raibert, draw_pushes, fall_time, has_fallen

ROBOT, TROT, PLAN = Quadruped(), Trot(), Spline("linear", 4, 0.45)


@pytest.fixture(scope="module")
def testbed():
    return QuadrupedScenario().build()


def feet(plant: MultibodyPlant, angles: np.ndarray) -> dict[str, np.ndarray]:
    """Return where the feet are from their hips, in the frame of the trunk."""
    context = plant.CreateDefaultContext()
    plant.SetPositions(context, np.concatenate([[1.0, 0.0, 0.0, 0.0, 0.0, 0.0, ROBOT.stance], angles]))
    places = {}
    for leg in LEGS:
        hub, tibia = (plant.GetBodyByName(f"{leg}_{link}").EvalPoseInWorld(context) for link in ("hub", "tibia"))
        places[leg] = tibia.multiply(np.array([0.0, 0.0, -ROBOT.link])) - hub.translation()
    return places


def test_the_file_is_the_model() -> None:
    assert QUADRUPED_SDF.read_text() == quadruped_sdf()


def test_masses_and_drives_are_the_models(testbed) -> None:
    plant = testbed.plant
    assert plant.CalcTotalMass(plant.CreateDefaultContext()) == pytest.approx(ROBOT.mass)
    drives = [plant.get_joint_actuator(index) for index in plant.GetJointActuatorIndices()]
    assert {(d.effort_limit(), d.get_controller_gains().p, d.get_controller_gains().d) for d in drives} == {
        (ROBOT.torque, ROBOT.stiffness, ROBOT.damping)
    }


def test_feet_are_where_the_offsets_put_them(testbed) -> None:
    trot = desired_state(ROBOT, TROT, PLAN, lead=0.0)
    offset = np.array([0.05, -0.02, -0.04, 0.03, 0.0, 0.0])
    plan = np.append(0.0, np.tile(offset, PLAN.knots))
    q = trot(plan, [0.0, 0.0], 0.25 * TROT.period)[0].full().ravel()[:12]  # in the middle of the first pair's swing
    places = feet(testbed.plant, q)
    for leg, (_, left) in LEGS.items():
        is_first = leg in ("front_left", "hind_right")
        x, y = offset[:2] if is_first else offset[2:4]
        height = -ROBOT.leg_height + (TROT.lift if is_first else 0.0)
        np.testing.assert_allclose(places[leg], [x, left * ROBOT.hip_length + y, height], atol=1e-12)


def test_feet_that_stand_move_back_with_the_velocity(testbed) -> None:
    trot = desired_state(ROBOT, TROT, PLAN, lead=0.0)
    velocity, dt = np.array([0.4, -0.2]), 0.05
    before, after = (
        feet(testbed.plant, trot(np.zeros(25), velocity, t)[0].full().ravel()[:12])
        for t in (0.7 * TROT.period, 0.7 * TROT.period + dt)
    )
    for leg in ("front_left", "hind_right"):
        np.testing.assert_allclose(after[leg] - before[leg], [*(-dt * velocity), 0.0], atol=1e-12)


def test_rates_are_the_derivatives_of_the_angles() -> None:
    trot = desired_state(ROBOT, TROT, PLAN, lead=0.003)
    plan, velocity, t, h = np.append(0.0, np.tile(0.02 * np.arange(6), PLAN.knots)), [0.3, 0.1], 0.31, 1e-6
    before, now, after = (trot(plan, velocity, t + d)[0].full().ravel() for d in (-h, 0.0, h))
    np.testing.assert_allclose(now[12:], (after - before)[:12] / (2.0 * h), atol=1e-6)


def test_offsets_follow_the_spline_of_the_plan() -> None:
    trot = desired_state(ROBOT, TROT, PLAN, lead=0.01)
    knots = np.random.default_rng(0).uniform(-0.1, 0.1, (PLAN.knots, len(OFFSETS)))
    for t in (0.9, 1.0, 1.17, 1.3, 1.6):
        offset = trot(np.append(1.0, knots.ravel()), [0.0, 0.0], t)[1].full().ravel()
        expected = PLAN.matrix([min(max(t + 0.01 - 1.0, 0.0), PLAN.duration)]) @ knots
        np.testing.assert_allclose(offset, expected[0], atol=1e-12)


def test_another_curve_is_refused() -> None:
    with pytest.raises(ValueError, match="linear"):
        desired_state(ROBOT, TROT, Spline("cubic", 4, 0.45), lead=0.0)
    with pytest.raises(ScenarioError, match="at least 2 knots"):
        QuadrupedScenario(knots=1).build()


def test_it_trots_in_place_and_believes_where_it_is(testbed) -> None:
    context = testbed.default_context()
    simulator = testbed.simulator(context)
    errors = []
    for k in range(1, 11):
        simulator.AdvanceTo(0.1 * k)
        state, seen = (np.array(testbed.read(context, address)) for address in ("plant.state", PERCEIVED))
        assert not has_fallen(state) and abs(state[6] - ROBOT.stance) < 0.05 and np.hypot(*state[4:6]) < 0.3
        late = 2.0 * testbed.scenario.period
        believed = np.concatenate([present_trunk(seen, late=late)[0], present_angles(seen, late=late)])
        errors.append([np.linalg.norm(each - state[:19]) for each in (believed, seen[:19])])
    believed, seen = np.median(errors, axis=0)
    assert believed < 0.3 * seen
    assert np.array_equal(present_rates(seen_rates := np.arange(37.0), late=1.0), seen_rates[25:])


def test_a_hard_push_makes_the_trot_fall(testbed) -> None:
    assert fall_time(testbed, PushCase(40.0, np.pi / 2, 0.1)) == pytest.approx(0.6, abs=0.4)


def test_pushes_of_all_sizes_have_the_same_directions() -> None:
    small, large = (draw_pushes(impulse, 5) for impulse in (10.0, 20.0))
    assert small == [replace(push, impulse=10.0) for push in large]
    assert len({push.direction for push in small}) == 5 and draw_pushes(10.0, 5, seed=1) != small


@pytest.mark.parametrize(("time", "pair"), [(0.05, 0), (0.25, 1)])
def test_raiberts_rule_moves_the_pair_that_swings_with_the_speed(testbed, time: float, pair: int) -> None:
    context, yaw, slip = testbed.default_context(), 0.7, np.array([0.3, -0.2])
    context.SetTime(time)
    state = np.array(testbed.read(context, PERCEIVED))
    state[:4] = [np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)]
    velocity = np.array([0.2, 0.1])
    state[22:24] = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]) @ (velocity + slip)
    testbed.write(context, {PERCEIVED: state, "u.velocity": velocity})
    Raibert(testbed, gain=0.5)(context)
    plan = testbed.read(context, "u.plan")
    knots, expected = plan[1:].reshape(-1, len(OFFSETS)), np.zeros(len(OFFSETS))
    expected[2 * pair : 2 * pair + 2] = 0.5 * slip
    assert plan[0] == time and np.allclose(knots, expected, atol=1e-12)


def test_the_cost_is_zero_where_it_trots_as_it_should() -> None:
    state, yaw, velocity = np.zeros(37), 0.7, np.array([0.4, -0.1])
    state[:7] = [np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2), 3.0, 4.0, ROBOT.stance]
    state[22:24] = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]) @ velocity
    assert cost(state, velocity, np.zeros(6)) == pytest.approx(0.0, abs=1e-8)
    tilted, shifted = state.copy(), 0.5 * LIMITS
    tilted[:4] = [np.cos(0.2), np.sin(0.2), 0.0, 0.0]
    assert cost(tilted, velocity, np.zeros(6)) > 1.0 and cost(state, velocity, shifted) > 0.1


@pytest.mark.slow
def test_with_a_reasoner_on_board_it_does_not_fall_where_the_trot_alone_does(testbed) -> None:
    cases = [PushCase(24.0, np.pi / 2, begin) for begin in (0.4, 1.0)]
    reasoning = QuadrupedScenario(onboard=True).build()
    assert all(fall_time(testbed, case) is not None for case in cases)
    # With another rounding, one of them may end otherwise.
    assert any(fall_time(reasoning, case) is None for case in cases)
