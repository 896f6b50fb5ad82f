"""The front of a plan: deviations of the base at the end, at most and in the mean, which cost each other."""

import numpy as np
import pytest

from vtbdrake_diagrams.satellite.studies.arm_front import Aim, Front, front
from vtbdrake_diagrams.satellite.studies.arm_motion import ArmMotionScenario


def test_what_is_worse_in_all_three_or_not_planned_is_not_on_the_front():
    aims = Aim(), Aim(turn=0.6), Aim(weight=1.0), Aim(turn=0.3)
    ones = [[0.01, 1.0, 1.0], [0.1, 0.6, 0.8], [0.2, 0.7, 0.9], [np.nan] * 3]
    others = [[0.03, 1.0, 1.0], [0.3, 0.6, 0.8], [0.4, 0.7, 0.9], [0.2, 0.3, 0.5]]
    result = Front(aims, np.array([ones, others]))
    assert result.planned.tolist() == [2, 2, 2, 1]
    np.testing.assert_allclose(result.medians[:3], [[0.02, 1.0, 1.0], [0.2, 0.6, 0.8], [0.3, 0.7, 0.9]])
    rows = str(result).splitlines()[-4:]
    assert ["*" in row for row in rows] == [True, True, False, False]
    assert "20.0 %" in rows[1]
    assert "at most 30% on the way" in rows[3] and "-" in rows[3].split("1 of 2")[1]


@pytest.mark.slow
@pytest.mark.one_python
def test_less_on_the_way_costs_more_at_the_end():
    result = front([ArmMotionScenario(thinking_time=0.2)], (Aim(), Aim(turn=0.5)))
    (end, largest, _), (calm_end, calm_largest, _) = result.shares[0]
    assert end < 0.1 and 0.5 < largest <= 1.05
    assert end < calm_end < 1.0 and calm_largest <= 0.5 * 1.05
