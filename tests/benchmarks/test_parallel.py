"""When the rollouts of two cores are quick enough."""

import pytest

from benchmarks.parallel import reached


@pytest.mark.parametrize(
    ("efficiency", "ceiling", "holds"),
    [(0.95, 1.0, True), (0.87, 0.875, True), (0.87, 0.95, False), (0.90, 0.99, True), (0.5, 0.51, True)],
)
def test_an_efficiency_holds_by_itself_or_beside_what_the_machine_gives(efficiency, ceiling, holds):
    assert reached(efficiency, ceiling) is holds
