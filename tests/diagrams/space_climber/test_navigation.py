"""The navigator and the visual odometer, each against what defines them."""

from __future__ import annotations

import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.tree import BodyIndex
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context

from vtbdrake_diagrams.space_climber.navigation import VisualOdometer, make_navigator

PERIOD = 0.04
POSITION, SLIP, SLIPPING, TIPPED = slice(0, 2), slice(2, 4), 4, 5


def navigate(seconds: float, **inputs: object) -> Context:
    """Simulate with constant inputs, and return the context."""
    system = make_navigator(period=PERIOD)
    context = system.CreateDefaultContext()
    values = dict(attitude=[0.0, 0.0, 0.0], leg=[0.0, 0.0, 0.2], heading=[0.0], walk=[1.0], v=[0.0, 0.0, 0.0])
    system.get_input_port().FixValue(context, np.concatenate([*{**values, **inputs}.values()]))
    Simulator(system, context).AdvanceTo(seconds)
    return context


def test_position_integrates_the_velocity() -> None:
    context = navigate(10.0 - 0.5 * PERIOD, attitude=[0.0, 0.0, np.pi / 2], v=[0.2, 0.0, 0.0])
    np.testing.assert_allclose(context.get_discrete_state(2).value()[POSITION], [0.0, 2.0], atol=1e-9)


@pytest.mark.parametrize(("sideways", "correction"), [(0.0, 0.0), (0.1, 0.3 * 0.1 * 5.0), (-1.0, -0.5)])
def test_course_leads_back_to_the_line(sideways: float, correction: float) -> None:
    """It drifts to the left for 5 s: its course turns right by the gain times the distance, up to the limit."""
    context = navigate(5.0 - 0.5 * PERIOD, v=[0.2, sideways, 0.0])
    # The line begins where the first sample is.
    assert context.get_discrete_state(0)[0] == pytest.approx(-correction, abs=0.3 * 0.1 * PERIOD + 1e-12)
    assert context.get_discrete_state(1)[0] == 1.0


def test_backwards_the_course_turns_the_other_way() -> None:
    """It walks backwards along the line and drifts to its left: only a turn to the left takes its rear to the right."""
    context = navigate(5.0 - 0.5 * PERIOD, v=[-0.2, 0.1, 0.0], walk=[-1.0])
    assert context.get_discrete_state(0)[0] == pytest.approx(0.3 * 0.1 * 5.0, abs=0.3 * 0.1 * PERIOD + 1e-12)
    assert context.get_discrete_state(1)[0] == -1.0


def test_standing_legs_that_walk_on_the_spot_slip() -> None:
    """Leg odometry that moves at 0.2 m/s, against eyes that see no motion."""
    system = make_navigator(period=PERIOD)
    context = system.CreateDefaultContext()
    simulator = Simulator(system, context)
    for k in range(250):
        leg = [0.2 * k * PERIOD, 0.0, 0.2]
        system.get_input_port().FixValue(context, [0.0, 0.0, 0.0, *leg, 0.0, 1.0, 0.0, 0.0, 0.0])
        simulator.AdvanceTo((k + 0.5) * PERIOD)
        values = context.get_discrete_state(2).value()
        expected = 0.2 * (1.0 - np.exp(-k * PERIOD / 2.0))
        np.testing.assert_allclose(values[SLIP], [expected, 0.0], atol=1e-9)
        assert values[SLIPPING] == (expected > 0.05)


def test_no_slip_where_legs_and_eyes_agree() -> None:
    context = navigate(10.0)
    assert context.get_discrete_state(2)[SLIPPING] == 0.0


def test_a_robot_that_has_tipped_stops_for_good() -> None:
    assert navigate(1.0, attitude=[0.7, -0.7, 0.0]).get_discrete_state(1)[0] == 1.0
    context = navigate(1.0, attitude=[0.0, -0.9, 0.0])
    assert context.get_discrete_state(2)[TIPPED] == 1.0
    assert context.get_discrete_state(1)[0] == 0.0


def test_odometer_shows_the_displacement_in_the_body_frame() -> None:
    sensor = VisualOdometer(BodyIndex(1), period=0.4)
    context = sensor.CreateDefaultContext()
    simulator = Simulator(sensor, context)
    turn = RollPitchYaw(0.1, 0.2, 1.0)
    for k, p in enumerate(([1.0, 2.0, 3.0], [1.2, 2.1, 3.3])):
        poses = [RigidTransform(), RigidTransform(turn, p)]
        sensor.get_input_port().FixValue(context, Value[list[RigidTransform]](poses))
        simulator.AdvanceTo(0.4 * k + 0.1)
        expected = turn.ToRotationMatrix().matrix().T @ [0.5, 0.25, 0.75] if k else np.zeros(3)
        np.testing.assert_allclose(sensor.get_output_port().Eval(context), expected, atol=1e-12)
