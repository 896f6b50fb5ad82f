"""Tests of routes along strip roads."""

import numpy as np
import pytest

from vtbdrake_diagrams.forest.world.carrier import Carrier
from vtbdrake_diagrams.forest.world.routes import Route, strip_roads

pytestmark = pytest.mark.one_python


def test_length_of_a_circle() -> None:
    angles = 2.0 * np.pi * np.arange(400) / 400
    circle = Route(10.0 * np.column_stack([np.cos(angles), np.sin(angles)]))
    assert circle.length == pytest.approx(20.0 * np.pi, rel=1e-4)
    quarter = circle.length / 4.0
    assert circle.position(quarter) == pytest.approx([0.0, 10.0], abs=1e-6)
    assert circle.heading(2.0 * quarter) == pytest.approx(-np.pi / 2.0, abs=0.01)
    # Laps follow each other.
    assert circle.position(quarter + 3.0 * circle.length) == pytest.approx(circle.position(quarter))
    assert circle.nearest([0.0, 13.0]) == pytest.approx(quarter)
    assert circle.distances([[0.0, 13.0], [0.0, 0.0]]) == pytest.approx([3.0, 10.0])


@pytest.mark.parametrize("seed", range(3))
def test_strip_roads_are_smooth_and_stay_inside(seed: int) -> None:
    routes = strip_roads(100.0, 80.0, spacing=20.0, seed=seed)
    assert len(routes) == 8
    for route in routes:
        assert (route.points > 2.0).all() and (route.points < [98.0, 78.0]).all()
        headings = np.unwrap([route.heading(s) for s in np.arange(0.0, route.length, 0.5)])
        curvature = np.abs(np.diff(headings)) / 0.5
        # The carrier can drive circles of 3 m.
        assert curvature.max() < Carrier().largest_curvature - 0.05
        assert abs(headings[-1] - headings[0]) == pytest.approx(2.0 * np.pi, abs=0.1)


def test_routes_are_one_road_until_they_part() -> None:
    routes = strip_roads(100.0, 100.0, spacing=20.0)
    left, right, far = routes[0], routes[1], routes[2]
    for along in np.arange(0.0, 9.0):
        assert left.position(along) == pytest.approx(right.position(along), abs=0.05)
        assert left.position(along) == pytest.approx(far.position(along), abs=0.05)
    assert np.linalg.norm(left.position(30.0) - right.position(30.0)) > 15.0
    assert [round(route.length, -1) for route in routes[::2]] == sorted(
        round(route.length, -1) for route in routes[::2]
    )


@pytest.mark.parametrize(
    ("size", "message"),
    [
        ({"length": 20.0, "width": 100.0}, "at least 40 m long and wide, not 20 m x 100 m"),
        ({"length": 100.0, "width": 100.0, "spacing": 5.0}, "at least 12 m apart"),
    ],
)
def test_areas_without_room_for_roads_are_refused(size: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        strip_roads(**size)


def test_two_points_are_no_route() -> None:
    with pytest.raises(ValueError, match="at least three finite points"):
        Route([[0.0, 0.0], [1.0, 0.0]])
