"""A decision as a search sees it, and as the DPS takes it."""

import numpy as np
import pytest

from vtbdrake.optimization import Choice, Parameter
from vtbdrake.reasoning import Trajectory
from vtbdrake.reasoning.space import DecisionSpace

SPEED = Parameter("u.speed", 0.0, 2.0)
GAIT = Choice("dps.gait", [1.0, 3.0])
# A line through its knots at 0, 1, 2 and 3 s.
PLAN = Trajectory("u.plan", 4, 3.0, "linear", lower=-10.0, upper=10.0)
SPACE = DecisionSpace([SPEED, PLAN, GAIT])
HELD = {"u.speed": 1.0, "u.plan": np.array([5.0, 0.0, 2.0, 4.0, 4.0]), "dps.gait": 3.0}


def test_a_search_varies_the_numbers_and_the_knots():
    assert [p.address for p in SPACE.parameters] == ["u.speed", *(f"u.plan[{k}]" for k in range(1, 5)), "dps.gait"]


def test_a_plan_in_use_is_shifted_to_the_decision():
    # One second later it begins at the second knot, and holds its last one.
    assert SPACE.point(HELD, 6.0) == pytest.approx((1.0, 2.0, 4.0, 4.0, 4.0, 3.0))


def test_a_point_becomes_values_by_address_and_a_trajectory_begins_now():
    values = SPACE.values([(0.5, 1.0, 2.0, 3.0, 4.0, 1.0)], HELD, 6.0)[0]
    assert values.keys() == {"u.speed", "u.plan", "dps.gait"}
    assert (values["u.speed"], values["dps.gait"]) == (0.5, 1.0)
    np.testing.assert_allclose(values["u.plan"], [6.0, 1.0, 2.0, 3.0, 4.0])


def test_a_rate_limited_plan_goes_on_from_the_one_in_use():
    limited = Trajectory("u.plan", 4, 3.0, "linear", lower=-10.0, upper=10.0, rate=2.0)
    space = DecisionSpace([limited])
    values = space.values([(9.0, -9.0, 9.0, -9.0)], {"u.plan": HELD["u.plan"]}, 5.5)[0]
    begin, *knots = values["u.plan"]
    assert begin == 5.5
    assert knots[0] == pytest.approx(1.0)  # Half way from 0 to 2.
    assert 1.999 < np.abs(np.diff(knots)).max() <= 2.0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"u.speed": 3.0}, "u.speed = 3 lies outside its range"),
        ({"dps.gait": 2.0}, "dps.gait is one of"),
        ({"u.other": 1.0}, "wrong about u.other"),
        ({"u.plan": [5.0, 0.0, 2.0, 40.0, 4.0]}, r"u\.plan\[3\] = 40 lies outside its range \[-10, 10\]"),
        ({"u.plan": 3.0}, r"a plan of u.plan is \[t_begin, knots\], 5 finite numbers, not 3.0"),
        ({"u.plan": [np.nan, 1.0, 2.0, 3.0, 4.0]}, "5 finite numbers, not .nan"),
        ({"u.plan": ["0", "1", "2", "3", "4"]}, "a plan of u.plan must be a number or several, not .'0', '1'"),
    ],
)
def test_a_plan_that_cannot_be_decided_is_refused(change, message):
    with pytest.raises(ValueError, match=message):
        SPACE.point(HELD | change, 6.0)
