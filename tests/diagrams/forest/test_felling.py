"""The trees to fell next, and their drawing on the driver's display."""

from __future__ import annotations

import numpy as np
import pytest

from tests.visualization.meshcat_page import messages
from vtbdrake.components.localization.unit import SEARCHING, TRACKING
from vtbdrake.components.world_model import AttributeValue, WorldModel, WorldObject, position_estimate
from vtbdrake.visualization import make_meshcat
from vtbdrake_diagrams.forest.felling import REACH, marked_trees, next_places
from vtbdrake_diagrams.forest.pictures.display import (
    ADVICE,
    COVARIANCE,
    FOUND_AT,
    HEADING,
    LANDMARKS,
    POSITION,
    STATUS,
    DriverDisplay,
)
from vtbdrake_diagrams.forest.world.routes import Route

pytestmark = pytest.mark.one_python

ANGLES = np.linspace(0.0, 2.0 * np.pi, 400, endpoint=False)
CIRCLE = Route(30.0 * np.column_stack([np.cos(ANGLES), np.sin(ANGLES)]))


def around(degrees: float, radius: float) -> list[float]:
    """Return a place beside the circle, which is driven to the left."""
    return [radius * np.cos(np.radians(degrees)), radius * np.sin(np.radians(degrees))]


def tree(name: str, place: list[float], diameter: float, **marks: float) -> WorldObject:
    attributes = {"trunk_diameter": AttributeValue(diameter, "m")} | {k: AttributeValue(v) for k, v in marks.items()}
    return WorldObject(name, "tree", position_estimate([*place, 0.0], deviation=0.1), attributes=attributes)


def test_next_trees_are_in_reach_and_in_the_order_of_the_route() -> None:
    places = np.array([
        around(-10.0, 28.0),  # behind: comes in the next lap
        around(40.0, 30.0 - 0.9 * REACH),
        around(20.0, 30.0 + 0.9 * REACH),
        around(30.0, 30.0 + 1.1 * REACH),  # out of reach
        around(90.0, 33.0),
    ])  # fmt: skip
    here = around(2.0, 30.4)
    np.testing.assert_array_equal(next_places(places, CIRCLE, here), places[[2, 1, 4, 0]])
    np.testing.assert_array_equal(next_places(places, CIRCLE, here, count=2), places[[2, 1]])
    assert next_places(np.zeros((0, 2)), CIRCLE, here).shape == (0, 2)


def test_marks_of_a_forester_go_before_thinning() -> None:
    sizes = [0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0]
    stand = [tree(f"t{k}", [float(k), 0.0], size) for k, size in enumerate(sizes)]
    assert [each.identity for each in marked_trees(WorldModel(stand))] == ["t0", "t1", "t2"]
    marked = [tree("a", [0.0, 1.0], 0.9, fell=1.0), tree("b", [0.0, 2.0], 0.1, fell=0.0)]
    assert [each.identity for each in marked_trees(WorldModel([*stand, *marked]))] == ["a"]
    assert marked_trees(WorldModel([])) == []


def test_display_draws_the_advised_route_and_the_next_trees() -> None:
    other = Route(CIRCLE.points[::-1])
    thin = [around(20.0, 33.0), around(-20.0, 27.0)]
    trees = [tree(f"thin{k}", place, 0.1) for k, place in enumerate(thin)]
    trees += [tree(f"thick{k}", around(10.0 * k, 35.0), 0.4) for k in range(5)]
    meshcat = make_meshcat()
    display = DriverDisplay(meshcat, WorldModel(trees), [CIRCLE, other])
    known = {
        POSITION: [30.0, 0.0],
        HEADING: np.pi / 2.0,
        COVARIANCE: 0.01 * np.eye(3),
        STATUS: TRACKING,
        FOUND_AT: [30.0, 0.0, np.pi / 2.0],
        LANDMARKS: np.full((4, 3), np.nan),
    }

    def numbers(advice: int, **changed: object) -> dict[int, list[float]]:
        display.show({**known, **changed, ADVICE: advice})
        moved = {m["path"]: m["matrix"] for m in messages(meshcat.StaticHtml()) if m["type"] == "set_transform"}
        paths = {k: f"/drake/display/felled/{k}/number" for k in range(5)}
        return {k: [moved[path][12], moved[path][13]] for k, path in paths.items() if path in moved}

    assert meshcat.HasPath("display/route") is False
    beside = [0.8, 0.0]  # the radius of a ring
    shown = numbers(0)
    assert meshcat.HasPath("display/route") and meshcat.HasPath("display/felled/1/ring")
    np.testing.assert_allclose([shown[0], shown[1]], np.array(thin) + beside)
    turned = numbers(1)
    np.testing.assert_allclose([turned[0], turned[1]], np.array(thin[::-1]) + beside)
    unknown = {POSITION: [np.nan, np.nan], HEADING: np.nan, COVARIANCE: np.diag([np.inf] * 3), STATUS: SEARCHING}
    display.show({**known, **unknown, ADVICE: 1})
    assert not meshcat.HasPath("display/felled") and meshcat.HasPath("display/route")
