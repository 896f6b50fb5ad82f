"""Parameters: their ranges, their values in a unit interval, and what they refuse."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vtbdrake.optimization import Choice, Parameter
from vtbdrake.optimization.parameter import checked_point, checked_points, point_text

pytestmark = pytest.mark.one_python

SPACE = [
    Parameter("a", -2.0, 6.0),
    Parameter("a", 0.01, 100.0, log=True),
    Parameter("a", -3, 4, integer=True),
    Parameter("a", 1, 1000, integer=True, log=True),
    Choice("a", ["red", "green", 3, 2.5, False]),
]


@given(st.sampled_from(SPACE), st.floats(0.0, 1.0))
def test_every_place_of_the_unit_interval_leads_back(dimension, u):
    value = dimension.from_unit(u)
    assert dimension.as_value(value) == value
    again = dimension.from_unit(dimension.to_unit(value))
    assert again == (value if not isinstance(value, float) else pytest.approx(value))


def test_each_integer_and_each_option_has_an_equal_share():
    places = (np.arange(8000) + 0.5) / 8000
    for dimension, count in ((SPACE[2], 8), (Choice("a", list("abcdefgh")), 8)):
        values, counts = np.unique([dimension.from_unit(u) for u in places], return_counts=True)
        assert len(values) == count and (counts == 1000).all()


def test_a_logarithmic_range_has_its_geometric_mean_in_the_middle():
    assert SPACE[1].from_unit(0.5) == pytest.approx(1.0)
    assert SPACE[1].to_unit(10.0) == pytest.approx(0.75)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Parameter("a", 1.0, 1.0), r"lower < upper, but it is \[1\.0, 1\.0\]"),
        (lambda: Parameter("a", 0.0, np.inf), "finite"),
        (lambda: Parameter("a", 0.5, 2, integer=True), "ends in whole numbers"),
        (lambda: Parameter("a", 0.0, 1.0, log=True), "begins above 0"),
        (lambda: Parameter("a", "0", 1.0), "the lower end of a must be a number, not '0'"),
        (lambda: Parameter("a", 0, 1, integer="no"), "integer of a must be True or False, not 'no'"),
        (lambda: Parameter(3, 0.0, 1.0), "named by its address, a text, not by 3"),
        (lambda: Choice("a", "bc"), r"give the options of a as \[option, option, ...\], not as 'bc'"),
        (lambda: Choice("a", [1.0]), "at least two different options"),
        (lambda: Choice("a", [1, True]), "at least two different options"),
        (lambda: Choice("a", [np.nan, 1.0]), "which NaN never equals"),
        (lambda: Choice("a", [1.0, np.zeros(2)]), "numbers, words or booleans"),
        (lambda: Parameter("a", -1.7e308, 1.7e308), r"too wide for floating-point numbers: \[-1.7e\+308, 1.7e\+308\]"),
        (lambda: SPACE[0].as_value("x"), r"takes a number in \[-2, 6\], not 'x'"),
        (lambda: SPACE[0].as_value(7.0), r"a = 7 lies outside its range \[-2, 6\]"),
        (lambda: SPACE[0].as_value(np.nan), "outside its range"),
        (lambda: SPACE[2].as_value(0.5), "takes whole numbers, not 0.5"),
        (lambda: SPACE[4].as_value("blue"), "is one of {'red', 'green', 3, 2.5, False}, not 'blue'"),
        (lambda: SPACE[4].as_value(0), "not 0"),
    ],
)
def test_what_is_no_value_is_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.parametrize(
    ("parameter", "value", "text"),
    [
        (Parameter("kp", 0.0, 400.0), 400.0, "kp = 400 N (the upper end of its range)"),
        (Parameter("kp", 0.0, 400.0), 399.99999, "kp = 400 N (the upper end of its range)"),
        (Parameter("kp", 1e-3, 1e3, log=True), 1e-3, "kp = 0.001 N (the lower end of its range)"),
        (Parameter("kp", 0.0, 400.0), 39.99999999999123, "kp = 40 N"),
        (Parameter("kp", 0, 3, integer=True), 3, "kp = 3 N (the upper end of its range)"),
        (Choice("kp", ["low", "high"]), "high", "kp = 'high'"),
    ],
)
def test_a_value_at_an_end_of_its_range_is_pointed_out(parameter, value, text):
    assert point_text([parameter], [value], ["N"]) == text


@pytest.mark.parametrize(
    "points", [[(0.5, 1.0), (-2.0, 100.0)], [(0.5, 1)], [(0.5, 1.0), (7.0, 1.0)], [(np.nan, 1.0)], [(0.5,)]]
)
def test_many_points_are_checked_as_each_of_them_is(points):
    def outcome(check):
        try:
            return check()
        except ValueError as error:
            return str(error)

    each = outcome(lambda: [checked_point(SPACE[:2], point) for point in points])
    assert outcome(lambda: checked_points(SPACE[:2], points)) == each
