"""Forbidden regions against all points of small spaces, counted one by one."""

from itertools import product

import numpy as np
import pytest

from vtbdrake.optimization import Choice, Parameter
from vtbdrake.optimization.study.forbidden_regions import (
    checked_side,
    contains,
    leave_something,
    overlaps,
    searched_box,
)

SPACE = (
    Parameter("a", 0, 3, integer=True),
    Parameter("b", 0, 2, integer=True),
    Choice("gait", ["walk", "trot", "stand"]),
)
BY_ADDRESS = {parameter.address: parameter for parameter in SPACE}


def all_points(frozen):
    values = [range(4), range(3), ["walk", "trot", "stand"]]
    rows = (dict(zip(BY_ADDRESS, point, strict=True)) for point in product(*values))
    return [row for row in rows if frozen.items() <= row.items()]


def random_region(random):
    ends = {name: sorted(random.integers(-1, 5, 2).tolist()) for name in ("a", "b")}
    sides = {
        name: [None if random.random() < 0.3 else lower, None if random.random() < 0.3 else upper]
        for name, (lower, upper) in ends.items()
    }
    sides["gait"] = random.choice(["walk", "trot", "stand"], size=random.integers(1, 4), replace=False).tolist()
    kept = random.choice(list(sides), size=random.integers(1, 4), replace=False).tolist()
    return {address: checked_side(BY_ADDRESS[address], sides[address]) for address in kept}


@pytest.mark.parametrize("frozen", [{}, {"b": 1}, {"gait": "trot"}])
def test_regions_leave_something_where_a_point_is_left(frozen):
    random = np.random.default_rng(0)
    box, points = searched_box(SPACE, frozen), all_points(frozen)
    answers = []
    for _ in range(300):
        regions = [random_region(random) for _ in range(random.integers(1, 9))]
        left = any(not any(contains(region, BY_ADDRESS, point) for region in regions) for point in points)
        assert leave_something(regions, BY_ADDRESS, box) == left, regions
        inside = any(contains(regions[0], BY_ADDRESS, point) for point in points)
        assert overlaps(regions[0], BY_ADDRESS, box) == inside, regions[0]
        answers.append(left)
    assert set(answers) == {True, False}
